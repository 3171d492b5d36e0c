"""Settings of a radiance field's training, and the pace of its steps."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from nerg_mi.errors import NergError
from nerg_mi.ranges import LEARNING_RATES, LOSS_WEIGHTS, MINUTES, SEEDS, STEPS, ValidatedDataclass, Range, range_field, setting

if TYPE_CHECKING:
    from nerg_mi.fields.radiance import RadianceConfig
    from nerg_mi.maths.geometry import AnyBox

# ---- What settings of all trainings have ----


class RunSettings(ValidatedDataclass):
    """Base of the settings of a training, a dataclass with these fields."""

    steps: int | None  # Of both one is set
    minutes: float | None
    # Held for the share ``hold`` of the run; then it decays exponentially to ``final_rate`` times itself.
    learning_rate: float
    lr_final_ratio: float
    lr_hold_fraction: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.steps is None) == (self.minutes is None):
            raise NergError("give the length of the training either in steps or in minutes")

    def learning_rate_at(self, progress: float) -> float:
        """Learning rate at ``progress`` in 0..1 of the run."""
        late = max(0.0, progress - self.lr_hold_fraction) / (1 - self.lr_hold_fraction)
        return self.learning_rate * self.lr_final_ratio ** min(late, 1.0)

    def to_dict(self) -> dict:
        """As JSON, for the provenance."""
        return asdict(self)  # pyright: ignore[reportArgumentType] it is a dataclass


# ---- How much one step of a radiance training takes on, from what the last one found ----
#
# Everything here follows the number of samples, and nothing the clock: equal steps do equal work on every machine.


# Fewer rays a step are too noisy to learn from; marching waits to get finer until so many are affordable.
MIN_RAYS_TO_REFINE = 256
_MOST_RAYS, _LEAST_RAYS = 2**14, 64
_FILLED = 0.95  # A batch that is filled to this share seldom overflows, and what overflows is dropped


def adapt_ray_count(rays: int, samples_per_ray: float, prepass_samples_per_ray: float, batch: int, max_prepass_samples: int) -> int:
    """Rays of the next step: as many as fill a batch of ``batch`` samples, or the ``most`` of the density-only pass.

    ``rays``: of the last step; ``kept``, ``looked``: samples a ray in its batch, and in the pass before it.
    """
    wanted = _FILLED * min(batch / max(samples_per_ray, 1e-3), max_prepass_samples / max(prepass_samples_per_ray, 1e-3))
    # Damped, because a batch of few rays is a noisy estimate.
    wanted = min(max(0.5 * (rays + wanted), rays / 2), 2 * rays)
    return int(min(max(wanted, _LEAST_RAYS), _MOST_RAYS))


def limit_ray_count(rays: int, prepass_samples_per_ray: float, steps: int, max_prepass_samples: int, max_candidates: int) -> int:
    """``rays``, or as many of them as keep the density-only pass within ``most`` samples and their ``steps`` each
    within ``candidates``.

    ``looked``: samples a ray that the pass is expected to look at.
    """
    return max(1, min(rays, int(_FILLED * max_prepass_samples / max(prepass_samples_per_ray, 1e-3)), max_candidates // steps))


def refine_stride(stride: int, strides: tuple[int, ...], scheduled: int, prepass_samples_per_ray: float, max_prepass_samples: int, wait_for_clearing: bool = True) -> int:
    """The stride of the next step: ``stride``, or the next finer one of ``strides`` and 1.

    It is refined when the schedule has come to a finer one (``scheduled``), and free space is cleared far enough that
    the pass has room for ``FEW_RAYS`` rays at it. ``looked``: samples a ray that the pass last looked at, at
    ``stride``; ``most``: of its samples a step. ``waits``: False refines without regard to what is cleared.
    """
    if scheduled >= stride:
        return stride
    finer = max(s for s in (*strides, 1) if s < stride)
    fits = prepass_samples_per_ray * stride / finer * MIN_RAYS_TO_REFINE <= max_prepass_samples
    return finer if fits or not wait_for_clearing else stride


# ---- What a radiance field is trained with ----

# (levels, log2 rows, base and finest resolution, width, hidden layers of the colour net). "paper" has the paper's
# sizes; "small" is what trains in minutes on two CPU cores and stores in 2 MB as fp16; "medium" holds the texture of a
# room, in 7 MB.
_SIZES = {"small": (8, 16, 32, 512, 32, 1), "medium": (8, 18, 32, 512, 32, 1), "paper": (16, 19, 16, 2048, 64, 2)}


def make_radiance_config(size: str, box: AnyBox, deferred: bool = False) -> RadianceConfig:
    """Architecture of a ``size`` for a scene box: an untrained field absorbs about 1 - 1/e across it. Of a contracted
    one, whose inner cube takes half of each edge of the grid, it resolves that as it would a box. ``deferred``: whether
    the colour network is asked once a ray."""
    # The options of a training are read without them, which load Dr.Jit.
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
    """Controls of a training run; lengths are shares of the scene box's side. Exactly one of ``steps`` and ``minutes``
    says how long it takes."""

    minutes: float | None = setting(None, "Train for this long. Default: 5.", allowed=MINUTES)
    steps: int | None = setting(None, "Or: train for so many steps.", allowed=STEPS)
    seed: int = setting(0, "Seed of the weights, rays and jitter.", allowed=SEEDS)
    # Samples a step. Not a power of two: arrays that many bytes apart share their place in the caches, which costs a
    # factor of two.
    batch: int = range_field(2**14 + 240, Range(1, 1 << 26))
    learning_rate: float = range_field(1.5e-2, LEARNING_RATES)  # Held for the share ``hold`` of the run
    lr_final_ratio: float = range_field(0.03, Range(0, 1))  # What it decays to exponentially after that, times itself
    lr_hold_fraction: float = range_field(0.4, Range(0, 0.999))  # Share of the run for which the learning rate is held
    ema_decay: float = range_field(0.99, Range(0, 1))  # Decay a step of the averaged weights, which are the result
    march_step: float = range_field(3**0.5 / 1024, Range(1e-6, 1))  # Shortest step, as instant-ngp has it
    step_growth: float = range_field(1 / 128, Range(0, 1))  # Steps are at least this share of their distance
    near: float = range_field(0.02, Range(0, 1))  # Where rays start, and distance to every camera within which nothing is
    # Derivatives of samples nearer than this are scaled by the square of their share of it (Philip and Deschaintre
    # 2023, "Floaters No More"); 0: none are.
    damping_distance: float = range_field(0.4, Range(0, 1000))
    # Share of the run over which ``reach`` falls to 0, as surfaces come to stand where fog was.
    damping_fraction: float = range_field(0.5, Range(1e-6, 1e6))
    min_transmittance: float = range_field(2e-3, Range(0, 1))  # Samples that less light reaches are left out
    # Weight from which on a sample is always kept; others are by chance, in proportion to their weight.
    rr_weight: float = range_field(1 / 32, Range(1e-30, 1e30))
    rr_min_probability: float = range_field(1 / 32, Range(1e-30, 1))  # Least chance of a sample to be kept; 1: all are
    resolution: int = range_field(128, Range(8, 2048))  # Cells of the density grid along an edge
    grid_interval: int = range_field(16, Range(1, 10**6))  # Steps after which the density grid is looked over
    min_views: int = range_field(2, Range(0, 10**6))  # Cells that fewer cameras see stay empty
    # Share of the run from which on the cells that rendering will visit are found, all of which are then sampled.
    extraction_start: float = range_field(0.8, Range(0, 1e6))
    # Samples of the density-only pass, in batches: what it costs is then of the order of the rest of a step.
    max_prepass_batches: float = range_field(8.0, Range(1, 1e6))
    # How many times coarser the run marches at first, each for a like part of ``stride_share``, which clears early fog
    # cheaply; while the pass has no room for enough rays at the next, it waits, for as long again.
    strides: tuple[int, ...] = range_field((16, 8, 4, 2), Range(1, 10**6))
    stride_fraction: float = range_field(0.33, Range(0, 1e6))  # Share of the run that is marched coarser
    huber_delta: float = range_field(1.0, Range(0, 1e6))  # Error at which the colour loss turns linear; colours are in 0..1
    empty_weight: float = range_field(0.003, LOSS_WEIGHTS)  # Weight of the penalty on density in cells that are not sampled
    # Weight of the mean square of the hash grid's features, which lets go of what few rays have shaped (Barron et al.
    # 2023, Zip-NeRF, there level by level).
    grid_decay: float = range_field(0.1, LOSS_WEIGHTS)
    photo_colors: bool = setting(True, "Learn the exposure and white balance of each photo.")
    # Weight of the squares of how far they are from the average, the mean over the photos.
    photo_decay: float = range_field(0.01, LOSS_WEIGHTS)
    depth_weight: float = setting(0.02, "Weight of the depth's loss, where depth is known.", allowed=LOSS_WEIGHTS)
    depth_weight_final_ratio: float = range_field(0.25, Range(0, 1e6))  # What ``depth_weight`` falls to, times itself
    # Distance from the true surface, in march steps, within which a ray's weight should lie.
    depth_margin: float = range_field(1.5, Range(0, 1e6))
    hard_pixel_fraction: float = range_field(0.25, Range(0, 1))  # Share of the rays drawn from those whose depth was wrong
    distortion_weight: float = setting(
        0.0, "Weight of mip-NeRF 360's distortion loss, against fog; 0 is none.", allowed=LOSS_WEIGHTS
    )

    def __post_init__(self):
        super().__post_init__()
        if self.resolution % 8:
            raise NergError(f"the density grid's resolution must be a multiple of 8, got {self.resolution}")

    @property
    def max_prepass_samples(self) -> int:
        """Samples at most of a step's density-only pass."""
        return int(self.max_prepass_batches * self.batch)

    def damping_distance_at(self, progress: float) -> float:
        """Distance within which derivatives are damped at ``progress`` in 0..1 of the run, a share of the side."""
        return self.damping_distance * max(0.0, 1 - progress / self.damping_fraction)

    def stride_at(self, progress: float) -> int:
        """How many times coarser than ``march_step`` the run marches at ``progress`` in 0..1."""
        stage = int(progress / self.stride_fraction * len(self.strides)) if self.stride_fraction > 0 else len(self.strides)
        return self.strides[stage] if stage < len(self.strides) else 1
