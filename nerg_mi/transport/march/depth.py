"""Which distance along a ray is "the surface": expected, median or refined depth."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr

from nerg_mi.maths.elementary import log1p

from .primal import LOG2, MarchResult, MarchSettings, march, step_length

KINDS = ("expected", "median", "refined")

# Most that a surface is moved towards the camera for being soft, as a share of its depth.
_SOFTEST = 1 / 64
# Sub-steps in which a refined depth searches the step that crosses.
_PARTS = 16


def surface_depth(kind: str, result: MarchResult, medium, ray, t0, t1, active, settings: MarchSettings, backed=None):
    """Depth of ``kind`` from a march's result, 0 where nothing absorbs.

    Evaluations that finding it takes are added to ``result.density_evals``, if that is counted.

    The median is where half of this ray's own accumulated opacity is reached, which is the crossing
    of transmittance 1/2 for rays that became opaque. The others (few) are marched again for theirs.
    ``refined`` searches the crossing step again with finer steps, for densities that change within one.
    ``backed``: rays that end on something opaque, whose own opacity is 1; 0 where they reach it first.
    """
    if kind == "expected":
        return result.expected_depth
    opaque = result.tau >= settings.opaque
    alpha = result.opacity
    rest = active & (alpha > 0)
    if backed is not None:
        opaque |= backed
        rest &= ~backed
    opaque &= dr.isfinite(result.half)
    rest &= ~opaque
    goal = -log1p(-0.5 * alpha)
    count = result.density_evals is not None
    again = march(medium, ray, t0, t1, rest, settings, until=dr.select(rest, goal, 1), count=count)
    if count:
        result.density_evals = result.density_evals + again.density_evals
    # Rounding can leave the second march a hair short of its goal: the crossing is then the far end.
    crossing = dr.minimum(again.half, t1)
    depth = dr.select(rest, crossing, dr.select(opaque & active, result.half, 0))
    if kind == "median":
        return depth
    with dr.suspend_grad():
        enter = dr.select(rest, again.enter, result.enter)
        missing = dr.select(rest, goal - again.enter_tau, LOG2 - result.enter_tau)
        found = active & (rest | opaque) & (missing > 0) & dr.isfinite(dr.select(rest, again.half, result.half))
        # Steps of cells are as long as their voxels: they are searched until the crossing is found.
        end = t1 if settings.quadrature == "cells" else dr.minimum(enter + step_length(enter, settings), t1)
        part = settings.step / _PARTS
        fine = march(
            medium,
            ray,
            enter,
            end,
            found,
            replace(settings, step=part, cell_step=part),
            until=dr.select(found, missing, 1),
            count=count,
        )
        if count:
            result.density_evals = result.density_evals + fine.density_evals
        # A finer march may find a little less in the step than the coarse one did.
        moved = dr.select(found & dr.isfinite(fine.half), fine.half - depth, 0)
    return depth + moved


def escape_distance(kind: str, result: MarchResult, depth):
    """How far light goes into the matter before it meets the surface at ``depth`` (of ``kind``).

    In mean free paths where transmittance is 1/2: 1 for the expected depth of thick matter, ln 2 for its median.
    At most 1/64 of ``depth``; 0 where half of the light passes.
    """
    paths = 1 if kind == "expected" else LOG2
    return dr.minimum(result.half_slope * paths, depth * _SOFTEST)
