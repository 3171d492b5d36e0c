"""Settings of radiance training, and the control of its step size and number of rays."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from nerg_mi.errors import NergError
from nerg_mi.ranges import (
    LEARNING_RATES,
    LOSS_WEIGHTS,
    MINUTES,
    SEEDS,
    STEPS,
    Range,
    ValidatedDataclass,
    range_field,
    setting,
)

if TYPE_CHECKING:
    from nerg_mi.fields.radiance import RadianceConfig
    from nerg_mi.maths.geometry import AnyBox

# ---- Common settings of all trainings ----


class RunSettings(ValidatedDataclass):
    """Base class of training settings, a dataclass with these fields."""

    steps: int | None  # Exactly one of both is set
    minutes: float | None
    # Constant for the fraction ``lr_hold_fraction`` of the run; then it decays exponentially by the factor
    # ``lr_final_ratio``.
    learning_rate: float
    lr_final_ratio: float
    lr_hold_fraction: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.steps is None) == (self.minutes is None):
            raise NergError("set the length of the training either in steps or in minutes")

    def to_dict(self) -> dict:
        """Return the settings as JSON, for the provenance."""
        return asdict(self)  # pyright: ignore[reportArgumentType] it is a dataclass


# ---- Number of rays and march stride of a step, adapted to the previous one ----
#
# All decisions depend on numbers of samples and not on the clock, so that equal steps do equal work on every machine.


# Gradients of fewer rays per step are too noisy; the march is not refined until this many rays are affordable.
MIN_RAYS_TO_REFINE = 256
_MAX_RAYS, _MIN_RAYS = 2**14, 64
_FILL_TARGET = 0.95  # Target fill of a batch, which seldom overflows; samples that overflow are dropped


def adapt_ray_count(
    rays: int, samples_per_ray: float, prepass_samples_per_ray: float, batch: int, max_prepass_samples: int
) -> int:
    """Return the number of rays of the next step.

    It fills the batch, or the density pass if that fills first.

    Parameters
    ----------
    rays : int
        Rays of the last step.
    samples_per_ray, prepass_samples_per_ray : float
        Samples per ray in its batch, and in its density pass.
    batch, max_prepass_samples : int
        Sample limits of the batch and of the density pass.
    """
    target = _FILL_TARGET * min(
        batch / max(samples_per_ray, 1e-3), max_prepass_samples / max(prepass_samples_per_ray, 1e-3)
    )
    # Damped, because the estimate from a batch of few rays is noisy.
    target = min(max(0.5 * (rays + target), rays / 2), 2 * rays)
    return int(min(max(target, _MIN_RAYS), _MAX_RAYS))


def limit_ray_count(
    rays: int, prepass_samples_per_ray: float, steps: int, max_prepass_samples: int, max_candidates: int
) -> int:
    """Limit ``rays`` so that the density pass stays within ``max_prepass_samples`` and all steps within
    ``max_candidates``.

    ``prepass_samples_per_ray`` is the expected number of samples per ray of the density pass, ``steps`` the number of
    steps per ray.
    """
    return max(
        1,
        min(
            rays, int(_FILL_TARGET * max_prepass_samples / max(prepass_samples_per_ray, 1e-3)), max_candidates // steps
        ),
    )


def refine_stride(
    stride: int,
    strides: tuple[int, ...],
    scheduled: int,
    prepass_samples_per_ray: float,
    max_prepass_samples: int,
    wait_for_clearing: bool = True,
) -> int:
    """Return the march stride of the next step: ``stride``, or the largest smaller value among ``strides`` and 1.

    The stride is refined if the schedule (``scheduled``) is finer and free space is cleared far enough that the density
    pass has room for ``MIN_RAYS_TO_REFINE`` rays.

    Parameters
    ----------
    stride : int
        Current stride.
    strides : tuple of int
        Available strides.
    scheduled : int
        Stride of the schedule.
    prepass_samples_per_ray : float
        Samples per ray of the last density pass, at ``stride``.
    max_prepass_samples : int
        Sample limit of the density pass.
    wait_for_clearing : bool
        False refines even if free space is not cleared.
    """
    if scheduled >= stride:
        return stride
    finer = max(s for s in (*strides, 1) if s < stride)
    is_affordable = prepass_samples_per_ray * stride / finer * MIN_RAYS_TO_REFINE <= max_prepass_samples
    return finer if is_affordable or not wait_for_clearing else stride


# ---- Settings of a radiance training ----

# (levels, log2 rows, base and finest resolution, width, hidden layers of the colour network). "paper" has the sizes of
# the paper; "small" trains in minutes on two CPU cores and takes 2 MB as fp16; "medium" resolves the texture of a room,
# in 7 MB.
_SIZES = {"small": (8, 16, 32, 512, 32, 1), "medium": (8, 18, 32, 512, 32, 1), "paper": (16, 19, 16, 2048, 64, 2)}


def make_radiance_config(size: str, box: AnyBox, deferred: bool = False) -> RadianceConfig:
    """Return the architecture of a ``size`` for a scene box.

    An untrained field absorbs about 1 - 1/e across the box. In a contracted box, whose inner cube takes half of each
    edge of the grid, the resolution is doubled, so that the inner cube is resolved like a box. With ``deferred`` the
    colour network is evaluated once per ray.
    """
    # Imported here, so that reading the options does not load Dr.Jit.
    from nerg_mi.fields.encoding import HashGridConfig
    from nerg_mi.fields.radiance import RadianceConfig

    if size not in _SIZES:
        raise NergError(f'size must be one of {", ".join(_SIZES)}, got "{size}"')
    levels, rows, base, finest, width, color_hidden = _SIZES[size]
    if box.is_contracted:
        base, finest = 2 * base, 2 * finest
    return RadianceConfig(
        grid=HashGridConfig(levels=levels, log2_rows=rows, base=base, finest=finest),
        width=width,
        color_hidden=color_hidden,
        density_scale=1 / box.side,
        deferred=deferred,
    )


@dataclass(frozen=True)
class RadianceSettings(RunSettings):
    """Settings of a radiance training. Lengths are fractions of the side of the scene box.

    Exactly one of ``steps`` and ``minutes`` is set.
    """

    minutes: float | None = setting(
        None, "Training time in minutes.  [default: 5, unless --steps is given]", allowed=MINUTES
    )
    steps: int | None = setting(None, "Number of training steps, in place of --minutes.", allowed=STEPS)
    seed: int = setting(0, "Seed of initial weights, rays and jitter.", allowed=SEEDS)
    # Samples per step. Not a power of two: arrays with such distances in memory share cache sets, which costs a factor
    # of two.
    batch: int = range_field(2**14 + 240, Range(1, 1 << 26))
    # Constant for the fraction ``lr_hold_fraction`` of the run
    learning_rate: float = range_field(1.5e-2, LEARNING_RATES)
    # Final learning rate as a fraction of the initial one; the decay is exponential
    lr_final_ratio: float = range_field(0.03, Range(0, 1))
    lr_hold_fraction: float = range_field(0.4, Range(0, 0.999))  # Fraction of the run with constant learning rate
    # Decay per step of the exponential moving average of the weights, which is the result
    ema_decay: float = range_field(0.99, Range(0, 1))
    march_step: float = range_field(3**0.5 / 1024, Range(1e-6, 1))  # Minimum step, as in instant-ngp
    step_growth: float = range_field(1 / 128, Range(0, 1))  # Minimum step as a fraction of its distance
    # Near distance of rays; space within this distance of any camera is empty
    near: float = range_field(0.02, Range(0, 1))
    # Distance within which derivatives of samples are scaled by the square of their relative distance (Philip and
    # Deschaintre 2023, "Floaters No More"); 0 disables the scaling.
    damping_distance: float = range_field(0.4, Range(0, 1000))
    # Maximum of this distance as a fraction of the distance of cameras that look at a common point from it. The box of
    # such photos can be much larger, and what they show must not be scaled.
    max_focus_damping: float = range_field(1.75, Range(1e-6, 1e6))
    # Fraction of the run over which ``damping_distance`` falls to 0, when surfaces have replaced fog.
    damping_fraction: float = range_field(0.5, Range(1e-6, 1e6))
    min_transmittance: float = range_field(2e-3, Range(0, 1))  # Samples reached by less light are dropped
    # Russian roulette: samples of at least this weight are always kept, others with a probability proportional to their
    # weight.
    rr_weight: float = range_field(1 / 32, Range(1e-30, 1e30))
    # Russian roulette: minimum probability of keeping a sample; 1 keeps all
    rr_min_probability: float = range_field(1 / 32, Range(1e-30, 1))
    resolution: int = range_field(128, Range(8, 2048))  # Cells of the density grid along an edge
    grid_interval: int = range_field(16, Range(1, 10**6))  # Steps between updates of the density grid
    min_views: int = range_field(2, Range(0, 10**6))  # Cells seen by fewer cameras stay empty
    # Fraction of the run after which the occupancy for rendering is extracted, all of whose cells are then sampled.
    extraction_start: float = range_field(0.8, Range(0, 1e6))
    # Sample limit of the density pass in batches, so that it costs about as much as the rest of a step.
    max_prepass_batches: float = range_field(8.0, Range(1, 1e6))
    # March strides at the start, each for an equal part of ``stride_fraction``. Coarse marching clears early fog at low
    # cost. If the density pass has no room for enough rays at the next stride, the run waits, at most as long again.
    strides: tuple[int, ...] = range_field((16, 8, 4, 2), Range(1, 10**6))
    stride_fraction: float = range_field(0.33, Range(0, 1e6))  # Fraction of the run with coarse strides
    # Error at which the colour loss becomes linear; colours are in 0..1
    huber_delta: float = range_field(1.0, Range(0, 1e6))
    # Weight of the penalty on density in cells that are not sampled
    empty_weight: float = range_field(0.003, LOSS_WEIGHTS)
    # Weight of the mean square of the hash-grid features, which removes features shaped by few rays (Barron et al.
    # 2023, Zip-NeRF, there per level).
    grid_decay: float = range_field(0.1, LOSS_WEIGHTS)
    photo_colors: bool = setting(True, "Fit the exposure and white balance of each photo.")
    # Weight of the squared deviation of the photo colours from their average, a mean over the photos.
    photo_decay: float = range_field(0.01, LOSS_WEIGHTS)
    depth_weight: float = setting(0.02, "Weight of the depth loss, for photos with depth.", allowed=LOSS_WEIGHTS)
    # Final ``depth_weight`` as a fraction of the initial one
    depth_weight_final_ratio: float = range_field(0.25, Range(0, 1e6))
    # Distance from the true surface, in march steps, within which light should be absorbed.
    depth_margin: float = range_field(1.5, Range(0, 1e6))
    # Weight of the mean loss over rays to points of the reconstruction (Deng et al. 2022, "Depth-supervised NeRF", with
    # the loss of line-of-sight depth), if the photos have no depth.
    point_weight: float = setting(
        0.1,
        "Weight of the depth loss at points of the COLMAP model, for photos without depth; 0 disables it.",
        allowed=LOSS_WEIGHTS,
    )
    # Final ``point_weight`` as a fraction of the initial one: points prevent fog; later colour is more precise
    point_weight_final_ratio: float = range_field(0.02, Range(0, 1))
    point_fraction: float = range_field(1 / 8, Range(0, 0.9))  # Fraction of the rays that are drawn from points
    # Distance from a point, in standard errors of its distance, within which light should be absorbed
    point_margin: float = range_field(3.0, Range(0, 1000))
    # Empty space, as `FreeSpace` describes: in view of the cameras up to this fraction of the distance to the nearest
    # points of their photos, and around cameras up to this fraction of their distance to the point that they look at
    clear_fraction: float = setting(
        0.25,
        "Fraction of the distance to the nearest points of the COLMAP model in a photo up to which the view of its "
        "camera is empty in the first half of the training; 0 disables it.",
        allowed=Range(0, 1),
    )
    surrounding_fraction: float = setting(
        0.35,
        "Fraction of the distance to a common point of all views up to which the space around a camera is empty in "
        "the first half of the training; 0 disables it.",
        allowed=Range(0, 1),
    )
    # Fraction of the run after which this space may have density, because surfaces without texture, of which there are
    # no points, may be near a camera. Until then it prevents fog.
    free_space_end: float = range_field(0.5, Range(0, 1))
    # Fraction of the rays drawn from pixels with a large depth error
    hard_pixel_fraction: float = range_field(0.25, Range(0, 1))
    distortion_weight: float = setting(
        0.0,
        "Weight of the distortion loss of mip-NeRF 360, which reduces floaters; 0 disables it.",
        allowed=LOSS_WEIGHTS,
    )

    def __post_init__(self):
        super().__post_init__()
        if self.resolution % 8:
            raise NergError(f"the density grid's resolution must be a multiple of 8, got {self.resolution}")

    @property
    def max_prepass_samples(self) -> int:
        """Maximum number of samples of the density pass of a step."""
        return int(self.max_prepass_batches * self.batch)

    def damping_factor_at(self, progress: float) -> float:
        """Damping distance at ``progress`` in 0..1 of the run, as a fraction of that at the start."""
        return max(0.0, 1 - progress / self.damping_fraction)

    def stride_at(self, progress: float) -> int:
        """March stride in units of ``march_step`` at ``progress`` in 0..1 of the run."""
        stage = (
            int(progress / self.stride_fraction * len(self.strides)) if self.stride_fraction > 0 else len(self.strides)
        )
        return self.strides[stage] if stage < len(self.strides) else 1
