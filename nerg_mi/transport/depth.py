"""Kinds of depth: what a ray's optical depth makes of where it ends."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import log1p
from nerg_mi.maths.types import Bool, Float

from .march import march
from .march_primal import LOG2, MarchResult, MarchSettings, step_length
from .medium import LocalRay, Medium
from .quadrature import RULES, Registry

# Most that a surface is moved towards the camera for being soft, as a share of its depth.
_SOFTEST = 1 / 64
# Sub-steps in which a refined depth searches the step that crosses.
_PARTS = 16


@dataclass
class Marched:
    """A march, and what it was asked: all that finding a depth may need. The arguments are those of ``march.march``."""

    result: MarchResult
    medium: Medium
    ray: LocalRay
    t0: Float
    t1: Float
    active: Bool
    settings: MarchSettings
    # Rays that end on something opaque, so that their own opacity is 1; None where none does.
    backed: Bool | None = None


class Profile(Protocol):
    """What closed forms say of the density along rays (N,), for what `Depth.exact` makes of it."""

    @property
    def opacity(self) -> np.ndarray: ...

    @property
    def expected(self) -> np.ndarray:
        """Mean distance of absorption (N,), 0 where nothing absorbs."""
        ...

    def quantile(self, fraction: float) -> np.ndarray:
        """Distance (N,) at which this fraction of the ray's own opacity is reached, 0 where nothing absorbs."""
        ...


class Depth(Protocol):
    """A kind of depth. It holds no state: one object serves every march."""

    @property
    def name(self) -> str:
        """Value of the parameter ``depth`` that chooses it."""
        ...

    @property
    def summary(self) -> str:
        """What it is, in a sentence without its full stop: for the manual."""
        ...

    @property
    def mean_free_paths(self) -> float:
        """How deep in thick matter of constant density the surface lies, in mean free paths."""
        ...

    @property
    def at_half(self) -> bool:
        """Whether it lies in the step in which half of the ray's own opacity is reached."""
        ...

    @property
    def surface_kind(self) -> str:
        """Name of the kind whose surface it finds: its own, unless it finds that of another kind better. `nerg study`
        compares with that kind."""
        ...

    def find_exact(self, profile: Profile) -> np.ndarray:
        """Distance (N,) of the surface where the density is in closed form, for `nerg study`."""
        ...

    def inside(self, marched: Marched) -> Float:
        """Distance of the surface in the medium, in scene units; 0 where nothing absorbs, and on rays that are
        ``backed`` where what is behind is reached first.

        Evaluations that finding it takes are added to the result's ``density_evals``, if that is counted.
        Differentiable in what the march is.
        """
        ...

    def with_shape(self, result: MarchResult, front: Float, inside: Float, hit: Bool, distance: Float) -> Float:
        """Depth on rays that end on a shape, where all light is absorbed that reaches it.

        ``front``: opacity of the medium before it; ``inside``: the depth there; ``hit``: which rays these are, at
        ``distance`` (infinite on the others, which may return anything).
        """
        ...


DEPTHS: Registry[Depth] = Registry("depth")


class Expected:
    """Mean distance of absorption, divided by the opacity."""

    name = "expected"
    summary = "mean distance of absorption"
    mean_free_paths = 1.0
    at_half = False
    surface_kind = "expected"

    def find_exact(self, profile: Profile) -> np.ndarray:
        return profile.expected

    def inside(self, marched: Marched) -> Float:
        return marched.result.expected_depth

    def with_shape(self, result: MarchResult, front: Float, inside: Float, hit: Bool, distance: Float) -> Float:
        return dr.select(hit, (1 - front) * distance, 0) + front * inside


class Median:
    """Where half of this ray's own accumulated opacity is reached: the crossing of transmittance 1/2 for rays that
    became opaque. The others (few) are marched again for theirs."""

    name = "median"
    summary = "where half of the ray's own opacity is reached"
    mean_free_paths = LOG2
    at_half = True
    surface_kind = "median"

    def find_exact(self, profile: Profile) -> np.ndarray:
        return profile.quantile(0.5)

    def inside(self, marched: Marched) -> Float:
        return _Half(marched).depth

    def with_shape(self, result: MarchResult, front: Float, inside: Float, hit: Bool, distance: Float) -> Float:
        # Half of the light, which is all absorbed, may pass the medium: the shape is then the median.
        return dr.select(dr.isfinite(result.half), inside, distance)


class RefinedMedian(Median):
    """The median, searched again with finer steps in the step that crosses, for densities that change within one."""

    name = "refined"
    summary = "the median, searched again inside the step that reaches it"

    def inside(self, marched: Marched) -> Float:
        half = _Half(marched)
        with dr.suspend_grad():
            moved = self._moved(marched, half)
        return half.depth + moved

    @staticmethod
    def _moved(marched: Marched, half: _Half) -> Float:
        """How much farther the finer march finds the crossing."""
        result, settings, t1, again = marched.result, marched.settings, marched.t1, half.again
        enter = dr.select(half.rest, again.enter, result.enter)
        missing = dr.select(half.rest, half.goal - again.enter_tau, LOG2 - result.enter_tau)
        met = dr.isfinite(dr.select(half.rest, again.half, result.half))
        found = marched.active & (half.rest | half.opaque) & met
        # Steps of cells are as long as their voxels: they are searched until the crossing is found.
        ends_at_cells = RULES.find(settings.quadrature).ends_at_cells
        end = t1 if ends_at_cells else dr.minimum(enter + step_length(enter, settings), t1)
        part = settings.step / _PARTS
        fine = march(
            marched.medium,
            marched.ray,
            enter,
            end,
            found,
            replace(settings, step=part, cell_step=part),
            until=dr.select(found, missing, 1),
            count=half.count,
        )
        result.count_in(fine)
        # A finer march may find a little less in the step than the coarse one did.
        return dr.select(found & dr.isfinite(fine.half), fine.half - half.depth, 0)


class _Half:
    """Where half of each ray's opacity is reached: ``depth``, and how it was found."""

    def __init__(self, marched: Marched):
        result, settings, active, backed = marched.result, marched.settings, marched.active, marched.backed
        opaque = result.tau >= settings.opaque
        alpha = result.opacity
        rest = active & (alpha > 0)
        if backed is not None:
            opaque |= backed
            rest &= ~backed
        opaque &= dr.isfinite(result.half)
        rest &= ~opaque
        # Rays whose crossing of transmittance 1/2 it is, and rays that are marched again up to an optical depth.
        self.opaque, self.rest, self.goal = opaque, rest, -log1p(-0.5 * alpha)
        self.count = result.density_evals is not None
        until = dr.select(rest, self.goal, 1)
        self.again = march(
            marched.medium, marched.ray, marched.t0, marched.t1, rest, settings, until=until, count=self.count
        )
        result.count_in(self.again)
        # Rounding can leave the second march a hair short of its goal: the crossing is then the far end.
        crossing = dr.minimum(self.again.half, marched.t1)
        self.depth = dr.select(rest, crossing, dr.select(opaque & active, result.half, 0))


for _depth in (Expected(), Median(), RefinedMedian()):
    DEPTHS.register(_depth)


def surface_depth(
    kind: str,
    result: MarchResult,
    medium: Medium,
    ray: LocalRay,
    t0: Float,
    t1: Float,
    active: Bool,
    settings: MarchSettings,
    backed: Bool | None = None,
) -> Float:
    """Depth of ``kind`` (a name in ``DEPTHS``) from a march's result: ``Depth.inside``."""
    return DEPTHS.find(kind).inside(Marched(result, medium, ray, t0, t1, active, settings, backed))


def escape_distance(kind: str, result: MarchResult, depth: Float) -> Float:
    """How far light goes into the matter before it meets the surface at ``depth`` (of ``kind``), in scene units.

    As many mean free paths as the kind has, where transmittance is 1/2. At most 1/64 of ``depth``; 0 where half of the
    light passes.
    """
    return dr.minimum(result.half_slope * DEPTHS.find(kind).mean_free_paths, depth * _SOFTEST)
