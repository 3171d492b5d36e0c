"""Settings of a radiance field's training, and the pace of its steps."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from nerg_mi.errors import NergError
from nerg_mi.ranges import LEARNING_RATES, LOSS_WEIGHTS, MINUTES, SEEDS, STEPS, Checked, Range, ranged, setting

if TYPE_CHECKING:
    from nerg_mi.fields.radiance import RadianceConfig
    from nerg_mi.maths.geometry import AnyBox

# ---- What settings of all trainings have ----


class RunSettings(Checked):
    """Base of the settings of a training, a dataclass with these fields."""

    steps: int | None  # Of both one is set
    minutes: float | None
    # Held for the share ``hold`` of the run; then it decays exponentially to ``final_rate`` times itself.
    learning_rate: float
    final_rate: float
    hold: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.steps is None) == (self.minutes is None):
            raise NergError("give the length of the training either in steps or in minutes")

    def rate(self, progress: float) -> float:
        """Learning rate at ``progress`` in 0..1 of the run."""
        late = max(0.0, progress - self.hold) / (1 - self.hold)
        return self.learning_rate * self.final_rate ** min(late, 1.0)

    def to_dict(self) -> dict:
        """As JSON, for the provenance."""
        return asdict(self)  # pyright: ignore[reportArgumentType] it is a dataclass


# ---- How much one step of a radiance training takes on, from what the last one found ----
#
# Everything here follows the number of samples, and nothing the clock: equal steps do equal work on every machine.


# Fewer rays a step are too noisy to learn from; marching waits to get finer until so many are affordable.
FEW_RAYS = 256
_MOST_RAYS, _LEAST_RAYS = 2**14, 64
_FILLED = 0.95  # A batch that is filled to this share seldom overflows, and what overflows is dropped


def adapted_rays(rays: int, kept: float, looked: float, batch: int, most: int) -> int:
    """Rays of the next step: as many as fill a batch of ``batch`` samples, or the ``most`` of the density-only pass.

    ``rays``: of the last step; ``kept``, ``looked``: samples a ray in its batch, and in the pass before it.
    """
    wanted = _FILLED * min(batch / max(kept, 1e-3), most / max(looked, 1e-3))
    # Damped, because a batch of few rays is a noisy estimate.
    wanted = min(max(0.5 * (rays + wanted), rays / 2), 2 * rays)
    return int(min(max(wanted, _LEAST_RAYS), _MOST_RAYS))


def affordable_rays(rays: int, looked: float, steps: int, most: int, candidates: int) -> int:
    """``rays``, or as many of them as keep the density-only pass within ``most`` samples and their ``steps`` each
    within ``candidates``.

    ``looked``: samples a ray that the pass is expected to look at.
    """
    return max(1, min(rays, int(_FILLED * most / max(looked, 1e-3)), candidates // steps))


def refined(stride: int, strides: tuple[int, ...], scheduled: int, looked: float, most: int, waits: bool = True) -> int:
    """The stride of the next step: ``stride``, or the next finer one of ``strides`` and 1.

    It is refined when the schedule has come to a finer one (``scheduled``), and free space is cleared far enough that
    the pass has room for ``FEW_RAYS`` rays at it. ``looked``: samples a ray that the pass last looked at, at
    ``stride``; ``most``: of its samples a step. ``waits``: False refines without regard to what is cleared.
    """
    if scheduled >= stride:
        return stride
    finer = max(s for s in (*strides, 1) if s < stride)
    fits = looked * stride / finer * FEW_RAYS <= most
    return finer if fits or not waits else stride


# ---- What a radiance field is trained with ----

# (levels, log2 rows, base and finest resolution, width, hidden layers of the colour net). "paper" has the paper's
# sizes; "small" is what trains in minutes on two CPU cores and stores in 2 MB as fp16; "medium" holds the texture of a
# room, in 7 MB.
_SIZES = {"small": (8, 16, 32, 512, 32, 1), "medium": (8, 18, 32, 512, 32, 1), "paper": (16, 19, 16, 2048, 64, 2)}


def sized_config(size: str, box: AnyBox, deferred: bool = False) -> RadianceConfig:
    """Architecture of a ``size`` for a scene box: an untrained field absorbs about 1 - 1/e across it. Of a contracted
    one, whose inner cube takes half of each edge of the grid, it resolves that as it would a box. ``deferred``: whether
    the colour network is asked once a ray."""
    # The options of a training are read without them, which load Dr.Jit.
    from nerg_mi.fields.encoding import HashGridConfig
    from nerg_mi.fields.radiance import RadianceConfig

    if size not in _SIZES:
        raise NergError(f'size must be one of {", ".join(_SIZES)}, got "{size}"')
    levels, rows, base, finest, width, color_hidden = _SIZES[size]
    if box.contracted:
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

    minutes: float | None = setting(None, "Train for this long. Default: 5.", within=MINUTES)
    steps: int | None = setting(None, "Or: train for so many steps.", within=STEPS)
    seed: int = setting(0, "Seed of the weights, rays and jitter.", within=SEEDS)
    # Samples a step. Not a power of two: arrays that many bytes apart share their place in the caches, which costs a
    # factor of two.
    batch: int = ranged(2**14 + 240, Range(1, 1 << 26))
    learning_rate: float = ranged(1.5e-2, LEARNING_RATES)  # Held for the share ``hold`` of the run
    final_rate: float = ranged(0.03, Range(0, 1))  # What it decays to exponentially after that, times itself
    hold: float = ranged(0.4, Range(0, 0.999))  # Share of the run for which the learning rate is held
    average: float = ranged(0.99, Range(0, 1))  # Decay a step of the averaged weights, which are the result
    march_step: float = ranged(3**0.5 / 1024, Range(1e-6, 1))  # Shortest step, as instant-ngp has it
    growth: float = ranged(1 / 128, Range(0, 1))  # Steps are at least this share of their distance
    near: float = ranged(0.02, Range(0, 1))  # Where rays start, and distance to every camera within which nothing is
    # Derivatives of samples nearer than this are scaled by the square of their share of it (Philip and Deschaintre
    # 2023, "Floaters No More"); 0: none are.
    reach: float = ranged(0.4, Range(0, 1000))
    # Share of the run over which ``reach`` falls to 0, as surfaces come to stand where fog was.
    reach_share: float = ranged(0.5, Range(1e-6, 1e6))
    stop: float = ranged(2e-3, Range(0, 1))  # Samples that less light reaches are left out
    # Weight from which on a sample is always kept; others are by chance, in proportion to their weight.
    thin_sure: float = ranged(1 / 32, Range(1e-30, 1e30))
    thin_least: float = ranged(1 / 32, Range(1e-30, 1))  # Least chance of a sample to be kept; 1: all are
    resolution: int = ranged(128, Range(8, 2048))  # Cells of the density grid along an edge
    grid_every: int = ranged(16, Range(1, 10**6))  # Steps after which the density grid is looked over
    min_views: int = ranged(2, Range(0, 10**6))  # Cells that fewer cameras see stay empty
    # Share of the run from which on the cells that rendering will visit are found, all of which are then sampled.
    settle: float = ranged(0.8, Range(0, 1e6))
    # Samples of the density-only pass, in batches: what it costs is then of the order of the rest of a step.
    look_most: float = ranged(8.0, Range(1, 1e6))
    # How many times coarser the run marches at first, each for a like part of ``stride_share``, which clears early fog
    # cheaply; while the pass has no room for enough rays at the next, it waits, for as long again.
    strides: tuple[int, ...] = ranged((16, 8, 4, 2), Range(1, 10**6))
    stride_share: float = ranged(0.33, Range(0, 1e6))  # Share of the run that is marched coarser
    huber: float = ranged(1.0, Range(0, 1e6))  # Error at which the colour loss turns linear; colours are in 0..1
    empty_weight: float = ranged(0.003, LOSS_WEIGHTS)  # Weight of the penalty on density in cells that are not sampled
    # Weight of the mean square of the hash grid's features, which lets go of what few rays have shaped (Barron et al.
    # 2023, Zip-NeRF, there level by level).
    grid_decay: float = ranged(0.1, LOSS_WEIGHTS)
    photo_colors: bool = setting(True, "Learn the exposure and white balance of each photo.")
    # Weight of the squares of how far they are from the average, the mean over the photos.
    photo_decay: float = ranged(0.01, LOSS_WEIGHTS)
    depth_weight: float = setting(0.02, "Weight of the depth's loss, where depth is known.", within=LOSS_WEIGHTS)
    final_depth: float = ranged(0.25, Range(0, 1e6))  # What ``depth_weight`` falls to, times itself
    # Distance from the true surface, in march steps, within which a ray's weight should lie.
    depth_margin: float = ranged(1.5, Range(0, 1e6))
    replay: float = ranged(0.25, Range(0, 1))  # Share of the rays drawn from those whose depth was wrong
    distortion_weight: float = setting(
        0.0, "Weight of mip-NeRF 360's distortion loss, against fog; 0 is none.", within=LOSS_WEIGHTS
    )

    def __post_init__(self):
        super().__post_init__()
        if self.resolution % 8:
            raise NergError(f"the density grid's resolution must be a multiple of 8, got {self.resolution}")

    @property
    def most_looked(self) -> int:
        """Samples at most of a step's density-only pass."""
        return int(self.look_most * self.batch)

    def damped_within(self, progress: float) -> float:
        """Distance within which derivatives are damped at ``progress`` in 0..1 of the run, a share of the side."""
        return self.reach * max(0.0, 1 - progress / self.reach_share)

    def stride(self, progress: float) -> int:
        """How many times coarser than ``march_step`` the run marches at ``progress`` in 0..1."""
        stage = int(progress / self.stride_share * len(self.strides)) if self.stride_share > 0 else len(self.strides)
        return self.strides[stage] if stage < len(self.strides) else 1
