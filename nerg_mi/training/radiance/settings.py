"""What a radiance field is trained with."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from nerg_mi.errors import NergError
from nerg_mi.field.encoding.hashgrid import HashGridConfig
from nerg_mi.field.radiance import RadianceConfig
from nerg_mi.maths.contraction import AnyBox

# (levels, log2 rows, base and finest resolution, width, hidden layers of the colour net). "paper" has the paper's
# sizes; "small" is what trains in minutes on two CPU cores and stores in 2 MB as fp16; "medium" holds the texture of a
# room, in 7 MB.
_SIZES = {"small": (8, 16, 32, 512, 32, 1), "medium": (8, 18, 32, 512, 32, 1), "paper": (16, 19, 16, 2048, 64, 2)}


def sized_config(size: str, box: AnyBox, deferred: bool = False) -> RadianceConfig:
    """Architecture of a ``size`` for a scene box: an untrained field absorbs about 1 - 1/e across it. Of a contracted
    one, whose inner cube takes half of each edge of the grid, it resolves that as it would a box. ``deferred``: whether
    the colour network is asked once a ray."""
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
class RadianceSettings:
    """Controls of a training run; lengths are shares of the scene box's side. Exactly one of ``steps`` and ``minutes``
    says how long it takes."""

    # How many steps.
    steps: int | None = None
    # Or: how many minutes.
    minutes: float | None = None
    # Of the weights, rays and jitter.
    seed: int = 0
    # Samples a step. Not a power of two: arrays that many bytes apart share their place in the caches, which costs a
    # factor of two.
    batch: int = 2**14 + 240
    # Held for the share ``hold`` of the run.
    learning_rate: float = 1.5e-2
    # What it decays to exponentially after that, times itself.
    final_rate: float = 0.03
    # Share of the run for which the learning rate is held.
    hold: float = 0.4
    # Decay a step of the averaged weights, which are the result.
    average: float = 0.99
    # Shortest step, as instant-ngp has it.
    march_step: float = 3**0.5 / 1024
    # Steps are at least this share of their distance.
    growth: float = 1 / 128
    # Where rays start, and distance to every camera within which nothing is.
    near: float = 0.02
    # Derivatives of samples nearer than this are scaled by the square of their share of it (Philip and Deschaintre
    # 2023, "Floaters No More"); 0: none are.
    reach: float = 0.4
    # Share of the run over which ``reach`` falls to 0, as surfaces come to stand where fog was.
    reach_share: float = 0.5
    # Samples that less light reaches are left out.
    stop: float = 2e-3
    # Weight from which on a sample is always kept; others are by chance, in proportion to their weight.
    thin_sure: float = 1 / 32
    # Least chance of a sample to be kept; 1: all are.
    thin_least: float = 1 / 32
    # Cells of the density grid along an edge.
    resolution: int = 128
    # Steps after which the density grid is looked over.
    grid_every: int = 16
    # Cells that fewer cameras see stay empty.
    min_views: int = 2
    # Share of the run from which on the cells that rendering will visit are found, all of which are then sampled.
    settle: float = 0.8
    # Samples of the density-only pass, in batches: what it costs is then of the order of the rest of a step.
    look_most: float = 8.0
    # How many times coarser the run marches at first, each for a like part of ``stride_share``, which clears early fog
    # cheaply; while the pass has no room for enough rays at the next, it waits, for as long again.
    strides: tuple[int, ...] = (16, 8, 4, 2)
    # Share of the run that is marched coarser.
    stride_share: float = 0.33
    # Error at which the colour loss turns linear; colours are in 0..1.
    huber: float = 1.0
    # Weight of the penalty on density in cells that are not sampled.
    empty_weight: float = 0.003
    # Weight of the mean square of the hash grid's features, which lets go of what few rays have shaped (Barron et al.
    # 2023, Zip-NeRF, there level by level).
    grid_decay: float = 0.1
    # Whether each photo has an exposure and a white balance of its own.
    photo_colors: bool = True
    # Weight of the squares of how far they are from the average, the mean over the photos.
    photo_decay: float = 0.01
    # Weight of the depth terms where depth is known.
    depth_weight: float = 0.02
    # What ``depth_weight`` falls to, times itself.
    final_depth: float = 0.25
    # Distance from the true surface, in march steps, within which a ray's weight should lie.
    depth_margin: float = 1.5
    # Share of the rays drawn from those whose depth was wrong.
    replay: float = 0.25
    # Weight of the loss that draws a ray's weight together (mip-NeRF 360); 0: none.
    distortion_weight: float = 0.0

    def __post_init__(self):
        if (self.steps is None) == (self.minutes is None):
            raise NergError("give the length of the training either in steps or in minutes")
        if (self.steps or self.minutes or 0) <= 0:
            raise NergError(f"a training must last longer than 0, got steps={self.steps}, minutes={self.minutes}")
        given = self.depth_weight, self.distortion_weight, self.grid_decay, self.photo_decay
        if min(given) < 0:
            raise NergError(f"weights of losses must be 0 or more, got {', '.join(map(str, given))}")
        if not (self.thin_sure > 0 and 0 < self.thin_least <= 1):
            raise NergError(
                f"thin_sure must be above 0 and thin_least in (0, 1], got {self.thin_sure} and {self.thin_least}"
            )
        if not (self.stride_share >= 0 and self.reach_share > 0):
            shares = f"{self.stride_share} and {self.reach_share}"
            raise NergError(f"stride_share must be 0 or more and reach_share above 0, got {shares}")
        if self.look_most < 1:
            raise NergError(
                f"look_most must be 1 or more, room for a batch in the density-only pass, got {self.look_most}"
            )
        if self.resolution % 8:
            raise NergError(f"the density grid's resolution must be a multiple of 8, got {self.resolution}")

    @property
    def most_looked(self) -> int:
        """Samples at most of a step's density-only pass."""
        return int(self.look_most * self.batch)

    def rate(self, progress: float) -> float:
        """Learning rate at ``progress`` in 0..1 of the run."""
        late = max(0.0, progress - self.hold) / (1 - self.hold)
        return self.learning_rate * self.final_rate ** min(late, 1.0)

    def damped_within(self, progress: float) -> float:
        """Distance within which derivatives are damped at ``progress`` in 0..1 of the run, a share of the side."""
        return self.reach * max(0.0, 1 - progress / self.reach_share)

    def stride(self, progress: float) -> int:
        """How many times coarser than ``march_step`` the run marches at ``progress`` in 0..1."""
        stage = int(progress / self.stride_share * len(self.strides)) if self.stride_share > 0 else len(self.strides)
        return self.strides[stage] if stage < len(self.strides) else 1

    def to_dict(self) -> dict:
        return asdict(self)
