"""What the marcher asks of a medium: its extent, its density and its colour.

A trained field and any pair of Mitsuba volumes answer the same questions, so that analytic cases, grids from other
tools and neural fields run through one code path. Rays are handed over once (``local``), then every sample is
``o + t d`` in the medium's own coordinates while ``t`` stays the distance in the scene.
"""

from __future__ import annotations

from typing import Any, Protocol

import drjit as dr
import numpy as np

from nerg_mi.maths.types import Array3f, Bool, Color, Float, Point3f, UInt32, Vector3f

from .cells import VoxelCells
from .hits import Hits
from .local_ray import LocalRay

MAX_DENSITY = 1e30
"""Infinite densities count as this one, which is opaque over any length."""


class Occupancy(Protocol):
    """Where there may be density: equal cells of the unit cube."""

    @property
    def cells(self) -> tuple[int, ...]:
        """Cells along x, y and z."""
        ...

    @property
    def coarse(self) -> Occupancy:
        """The grid that this one refines, which holds all that it holds; itself where it refines none."""
        ...

    def empty_cells(self, u: Array3f, active: Bool = True) -> UInt32:
        """How far the cell of ``u`` is from an occupied one, in cells by the chessboard's measure, or less; 0 in an
        occupied one. Points outside of the cube belong to its nearest cell."""
        ...


class Medium(Protocol):
    """Density, colour and features in a box, placed in the scene.

    Two frames: the scene's, in scene units, and the medium's own ("local"), to which ``local`` and ``to_local`` lead.
    On lanes that are not ``active`` anything finite may be returned. What is evaluated is attached to the positions,
    and to the arrays of ``parameters``, wherever these carry derivatives; ``occupancy`` and ``cells`` never carry any.
    """

    @property
    def has_color(self) -> bool:
        """Whether there is a colour to be asked for."""
        ...

    @property
    def deferred(self) -> bool:
        """Whether a ray's colour is that of its samples' mean features, rather than the mean of their colours."""
        ...

    @property
    def color_space(self) -> str:
        """What colours are: ``srgb``, ``linear``, or ``spectrum``, a linear spectrum of the variant in use."""
        ...

    @property
    def feature_count(self) -> int:
        """Geometry features of a point, as ``density_features`` returns them; 0 for a medium that has none."""
        ...

    @property
    def length_scale(self) -> float:
        """Diagonal of the box, in scene units."""
        ...

    @property
    def step(self) -> float | None:
        """Length of a step that suits the medium, in scene units; None where it knows none."""
        ...

    @property
    def growth(self) -> float:
        """Share of its distance that a step is at least, which suits a medium that gets coarser with distance; 0 where
        steps are best of one length."""
        ...

    @property
    def occupancy(self) -> Occupancy | None:
        """Cells outside of which there certainly is no density; None: nothing may be skipped."""
        ...

    @property
    def cells(self) -> VoxelCells | None:
        """Voxels between which the density has no kinks, in the local frame; None for a medium that is no grid."""
        ...

    @property
    def hits(self) -> Hits | None:
        """What rays meet instead of a density, of a medium that has none: its densities may not be asked for. None for
        one that is marched in steps."""
        ...

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the axis-aligned box around the medium, (3,) each, in the scene's frame."""
        ...

    def parameters(self) -> list[Any]:
        """Arrays that densities and colours depend on: those by which derivatives may be asked for."""
        ...

    def refresh(self, anyway: bool = False) -> None:
        """Renew what is derived from ``parameters`` where these are other arrays than before, or ``anyway``; to be
        called after they may have changed."""
        ...

    def local(self, o: Point3f, d: Vector3f) -> LocalRay:
        """The ray of the scene from ``o`` along unit ``d``."""
        ...

    def to_local(self, p: Point3f) -> Point3f:
        """Points of the scene in the local frame."""
        ...

    def to_unit(self, p: Point3f) -> Array3f:
        """Local points in the coordinates of ``occupancy``, whose cells fill the unit cube."""
        ...

    def vector_to_unit(self, v: Vector3f) -> Array3f:
        """Local displacements in the coordinates of ``occupancy``."""
        ...

    def density(self, p: Point3f, active: Bool) -> Float:
        """Density at local points, in 1 / scene unit: finite and not negative."""
        ...

    def density_features(self, p: Point3f, active: Bool) -> tuple[Float, list[Float]]:
        """``density``, and the ``feature_count`` features of the same points, which ``color`` needs."""
        ...

    def color(self, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        """Colour in ``color_space`` at local points ``p`` in the unit local direction ``w`` of the ray. Only to be
        called where ``has_color``. ``features``: of the points, or the index of the hit alone in a medium of hits; in
        a ``deferred`` one the mean along a ray, which may have been gathered anywhere on it."""
        ...

    def background(self, o: Point3f, d: Vector3f) -> Color | None:
        """Colour in ``color_space`` behind the medium along rays of the scene; None for a medium that knows none."""
        ...


def bounded(sigma: Float) -> Float:
    """``sigma`` as a density: 0 where it is negative or NaN, at most ``MAX_DENSITY``."""
    # A negative value of an interpolated or fitted grid would create light; comparing also drops NaN.
    return dr.select(sigma > 0, dr.minimum(sigma, MAX_DENSITY), 0)
