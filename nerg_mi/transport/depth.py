"""Kinds of depth: how the optical depth along a ray defines the distance of its surface."""

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

# Maximum shift of a soft surface towards the camera, as a fraction of its depth.
_MAX_PENETRATION = 1 / 64
# Sub-steps of a refined depth inside the step with the crossing.
_PARTS = 16


@dataclass
class MarchContext:
    """A march and its arguments (those of `march.march`): the input for finding a depth."""

    result: MarchResult
    medium: Medium
    ray: LocalRay
    t0: Float
    t1: Float
    active: Bool
    settings: MarchSettings
    # Rays that end on an opaque shape, so that their own opacity is 1; None without such rays.
    ends_opaque: Bool | None = None


class DensityProfile(Protocol):
    """Closed-form densities along rays (N,), for `DepthKind.find_exact`."""

    @property
    def opacity(self) -> np.ndarray: ...

    @property
    def expected(self) -> np.ndarray:
        """Mean distance of absorption (N,); 0 without absorption."""
        ...

    def quantile(self, fraction: float) -> np.ndarray:
        """Distance (N,) at which this fraction of the ray's own opacity is reached; 0 without absorption."""
        ...


class DepthKind(Protocol):
    """A kind of depth. It has no state: one object serves all marches."""

    @property
    def name(self) -> str:
        """Value of the parameter ``depth`` that selects the kind."""
        ...

    @property
    def summary(self) -> str:
        """One sentence for the manual, without its full stop."""
        ...

    @property
    def mean_free_paths(self) -> float:
        """Depth of the surface inside thick matter of constant density, in mean free paths."""
        ...

    @property
    def is_at_half_opacity(self) -> bool:
        """Whether the surface lies in the step in which half of the ray's own opacity is reached."""
        ...

    @property
    def surface_kind(self) -> str:
        """Name of the kind that defines the same surface; its own name, unless it locates the surface of another kind
        more accurately. ``nerg study`` compares with that kind."""
        ...

    def find_exact(self, profile: DensityProfile) -> np.ndarray:
        """Distance (N,) of the surface for a closed-form density, for ``nerg study``."""
        ...

    def inside(self, context: MarchContext) -> Float:
        """Distance of the surface in the medium, in scene units; 0 without absorption, and on rays that ``ends_opaque``
        marks if the shape behind is reached first.

        Adds the evaluations of the search to ``density_evals`` of the result, if they are counted. Differentiable like
        the march.
        """
        ...

    def combine_with_shape(self, result: MarchResult, front: Float, inside: Float, hit: Bool, distance: Float) -> Float:
        """Depth on rays that end on a shape, which absorbs all light that reaches it.

        Parameters
        ----------
        front : Float
            Opacity of the medium in front of the shape.
        inside : Float
            Depth in the medium.
        hit, distance : Bool, Float
            Whether a ray ends on a shape, and the distance of the shape (infinite on other rays, whose result is
            arbitrary).
        """
        ...


DEPTHS: Registry[DepthKind] = Registry("depth")


class Expected:
    """Mean distance of absorption, divided by the opacity."""

    name = "expected"
    summary = "mean distance of absorption"
    mean_free_paths = 1.0
    is_at_half_opacity = False
    surface_kind = "expected"

    def find_exact(self, profile: DensityProfile) -> np.ndarray:
        return profile.expected

    def inside(self, context: MarchContext) -> Float:
        return context.result.expected_depth

    def combine_with_shape(self, result: MarchResult, front: Float, inside: Float, hit: Bool, distance: Float) -> Float:
        return dr.select(hit, (1 - front) * distance, 0) + front * inside


class Median:
    """Where half of the ray's own opacity is reached: transmittance 1/2 for rays that became opaque. Other rays (few)
    are marched a second time."""

    name = "median"
    summary = "where half of the ray's own opacity is reached"
    mean_free_paths = LOG2
    is_at_half_opacity = True
    surface_kind = "median"

    def find_exact(self, profile: DensityProfile) -> np.ndarray:
        return profile.quantile(0.5)

    def inside(self, context: MarchContext) -> Float:
        return _Half(context).depth

    def combine_with_shape(self, result: MarchResult, front: Float, inside: Float, hit: Bool, distance: Float) -> Float:
        # If more than half of the light passes the medium, the shape is the median.
        return dr.select(dr.isfinite(result.median_depth), inside, distance)


class RefinedMedian(Median):
    """The median, located with finer steps inside the step with the crossing, for densities that change within a
    step."""

    name = "refined"
    summary = "the median, located with finer steps inside the step that contains it"

    def inside(self, context: MarchContext) -> Float:
        half = _Half(context)
        with dr.suspend_grad():
            moved = self._find_shift(context, half)
        return half.depth + moved

    @staticmethod
    def _find_shift(context: MarchContext, half: _Half) -> Float:
        """Shift of the crossing that the finer march finds."""
        result, settings, t1, second = context.result, context.settings, context.t1, half.again
        start = dr.select(half.rest, second.crossing_start, result.crossing_start)
        remaining = dr.select(half.rest, half.goal - second.crossing_start_tau, LOG2 - result.crossing_start_tau)
        has_crossing = dr.isfinite(dr.select(half.rest, second.median_depth, result.median_depth))
        refinable = context.active & (half.rest | half.opaque) & has_crossing
        # Steps of cells are as long as their voxels and are searched until the crossing is found.
        ends_at_cells = RULES.find(settings.quadrature).ends_at_cells
        end = t1 if ends_at_cells else dr.minimum(start + step_length(start, settings), t1)
        part = settings.step / _PARTS
        fine = march(
            context.medium,
            context.ray,
            start,
            end,
            refinable,
            replace(settings, step=part, cell_step=part),
            until=dr.select(refinable, remaining, 1),
            count=half.count,
        )
        result.add_evaluations(fine)
        # A finer march can find slightly less optical depth in the step than the coarse one.
        return dr.select(refinable & dr.isfinite(fine.median_depth), fine.median_depth - half.depth, 0)


class _Half:
    """Where half of each ray's opacity is reached: ``depth``, and the masks of both cases."""

    def __init__(self, context: MarchContext):
        result, settings, active, ends_opaque = context.result, context.settings, context.active, context.ends_opaque
        opaque = result.tau >= settings.max_optical_depth
        alpha = result.opacity
        remaining = active & (alpha > 0)
        if ends_opaque is not None:
            opaque |= ends_opaque
            remaining &= ~ends_opaque
        opaque &= dr.isfinite(result.median_depth)
        remaining &= ~opaque
        # Rays with the crossing at transmittance 1/2, and rays that are marched again up to an optical depth.
        self.opaque, self.rest, self.goal = opaque, remaining, -log1p(-0.5 * alpha)
        self.count = result.density_evals is not None
        until = dr.select(remaining, self.goal, 1)
        self.again = march(
            context.medium, context.ray, context.t0, context.t1, remaining, settings, until=until, count=self.count
        )
        result.add_evaluations(self.again)
        # Due to rounding, the second march can end just short of its goal; the crossing is then the end of the
        # interval.
        crossing = dr.minimum(self.again.median_depth, context.t1)
        self.depth = dr.select(remaining, crossing, dr.select(opaque & active, result.median_depth, 0))


for _depth in (Expected(), Median(), RefinedMedian()):
    DEPTHS.register(_depth)


def penetration_depth(kind: str, result: MarchResult, depth: Float) -> Float:
    """Penetration depth of light in front of the surface at ``depth`` (of ``kind``), in scene units.

    The mean free paths of the kind at transmittance 1/2; at most 1/64 of ``depth``; 0 if more than half of the light
    passes.
    """
    return dr.minimum(result.median_depth_slope * DEPTHS.find(kind).mean_free_paths, depth * _MAX_PENETRATION)
