"""From step to step: where the next one begins and ends, and how empty space is passed over."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr

from nerg_mi.maths.types import Bool, Float
from nerg_mi.transport.media.cells import VoxelCells
from nerg_mi.transport.media.local_ray import LocalRay
from nerg_mi.transport.media.protocol import Medium, Occupancy

from .settings import MarchSettings

# Least step as a share of the distance: four spacings of single precision.
_SPACING = 2.0**-21


def advance(
    medium: Medium,
    ray: LocalRay,
    t: Float,
    t1: Float,
    share: Float,
    settings: MarchSettings,
    active: Bool,
    cells: VoxelCells | None = None,
    fine_from: Float | None = None,
) -> tuple[Bool, Float, Float, Float]:
    """The next step to evaluate from the distance ``t`` on: ``(active, t, delta, t_next)``, where it begins, how long
    it is and where it ends.

    ``t1``: where the march ends; ``share``: length of the step as a share of a full one; ``cells``: end it where the
    ray leaves a voxel instead; ``fine_from``: distance up to which steps are coarse. Always moves on.
    """
    if cells is not None:
        # Empty cells are left by strides that are too short to pass over any matter beside them.
        stride = min(settings.step, 0.5 * cells.edge, settings.cell_step)
        settings, fine_from = replace(settings, step=stride, dt_gamma=0.0), None
    grid = medium.occupancy
    if grid is not None:
        grid = grid if settings.refined else grid.coarse
        t, share = leap(medium, grid, ray, t, t1, share, settings, active, fine_from)
        active = active & (t < t1)
    if cells is None:
        t_next = t + step_length(t, settings, fine_from) * share
    else:
        # Rounding may put a boundary that has just been reached before t: a march must still go on.
        least = t + dr.maximum(t * _SPACING, settings.step * _SPACING)
        t_next = dr.maximum(dr.minimum(cells.next_boundary(ray, t), t + settings.cell_step), least)
    # The last step ends at the exit.
    t_next = dr.minimum(t_next, t1)
    # What a step covers is what t moves by, rounding included, so that steps leave no gap and no overlap.
    return active, t, t_next - t, t_next


def step_length(t: Float, settings: MarchSettings, fine_from: Float | None = None) -> Float:
    """Length of the step that starts at the distance ``t``; ``fine_from``: distance up to which steps are coarse."""
    # A step must move t: it is at least a few spacings of the floats around it.
    step = dr.maximum(t * max(settings.dt_gamma, _SPACING), settings.step)
    if fine_from is None:
        return step
    return dr.select(t + step * settings.coarse <= fine_from, step * settings.coarse, step)


def leap(
    medium: Medium,
    grid: Occupancy,
    ray: LocalRay,
    t: Float,
    t1: Float,
    share: Float,
    settings: MarchSettings,
    active: Bool,
    fine_from: Float | None,
) -> tuple[Float, Float]:
    """``(t, share)`` of the first step whose midpoint lies in an occupied cell, or from ``t1`` on: ``t`` advanced by
    whole steps, of which the first is ``share`` of a full one long. ``grid``: the medium's occupancy."""
    o, d = medium.to_unit(ray.o), medium.vector_to_unit(ray.d)

    def body(seeking, t, share):
        full = step_length(t, settings, fine_from)
        step = full * share
        middle = t + 0.5 * dr.minimum(step, t1 - t)
        u = o + d * middle
        k = grid.empty_cells(u, seeking)
        # The cells at chessboard distance < k around this one are empty: a box of 2k - 1 cells.
        reach = type(t)(k) - 1
        gap = type(t)(dr.inf)
        for uc, dc, cells in zip((u.x, u.y, u.z), (d.x, d.y, d.z), grid.cells):
            low = dr.floor(uc * cells) - reach
            wall = dr.select(dc > 0, low + 2 * reach + 1, low) - uc * cells
            gap = dr.minimum(gap, dr.select(dc != 0, wall / dr.select(dc != 0, dc * cells, 1), dr.inf))
        # Every step whose midpoint is certainly in that box is passed over. The next one's midpoint is
        # half a step beyond this step's end; at least this step itself is passed.
        whole = dr.maximum(dr.floor((middle + gap - t - step) / full + 0.5), 0)
        jump = seeking & (k > 0)
        landing = t + step + whole * full
        if fine_from is not None:
            # Coarse steps end where fine ones begin.
            landing = dr.select(t < fine_from, dr.minimum(landing, dr.maximum(fine_from, t + step)), landing)
        t = dr.select(jump, landing, t)
        share = dr.select(jump, 1, share)
        return jump & (t < t1), t, share

    _, t, share = dr.while_loop((active, t, share), lambda seeking, *_: seeking, body, label="leap")
    return t, share
