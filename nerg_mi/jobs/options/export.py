"""Options of the exports of a radiance field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerg_mi.ranges import VALUES, Checked, Range

from . import option


@dataclass(frozen=True, kw_only=True)
class LatticeOptions(Checked):
    """Where a radiance field is evaluated."""

    resolution: int = option(256, "Lattice cells along the longest edge of the field's box.", within=Range(2, 2048))
    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")


@dataclass(frozen=True, kw_only=True)
class SurfaceOptions(LatticeOptions):
    """Where the surface of a field lies."""

    density: float | None = option(
        None,
        "Density, 1/unit, at which the surface lies.  [default: half of the light absorbed in a cell]",
        within=VALUES,
    )
    up: str = option("z", "Up axis of the field, for .glb: z or y.")


@dataclass(frozen=True, kw_only=True)
class MeshOptions(SurfaceOptions):
    """What is left out of a mesh, and what is added to it."""

    fill: int = option(1, "Close holes of up to twice so many cells; 0: none.", within=Range(0, 2048))
    keep: float = option(0.001, "Drop pieces with less than this share of the largest one's area.", within=Range(0, 1))
    unseen: bool = option(False, "Keep the backs and insides that training never looked at.")


@dataclass(frozen=True, kw_only=True)
class PointOptions(SurfaceOptions):
    """Which points of a surface are written."""

    count: int | None = option(None, "Points at most.  [default: all]", within=Range(1, 10**9))


@dataclass(frozen=True, kw_only=True)
class SplatOptions(LatticeOptions):
    """How many Gaussians a surface becomes, and where it lies."""

    density: float | None = option(
        None,
        "Density, 1/unit, at which the surface lies.  [default: half of the light absorbed in a cell]",
        within=VALUES,
    )


@dataclass(frozen=True, kw_only=True)
class VolumeOptions(LatticeOptions):
    """What a grid volume holds."""

    color: Path | None = option(None, "Also write the colour, to this .vol file.")


@dataclass(frozen=True, kw_only=True)
class TorchNgpOptions(Checked):
    """How a field is read that becomes a torch-ngp checkpoint."""

    mode: str = option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")
