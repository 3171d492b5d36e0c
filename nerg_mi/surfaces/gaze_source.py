r"""What the gaze of observers leaves on a surface, after occlusion.

An observer at p_o looks into the direction ω with the density g(ω), in 1/sr. On a face A they leave

    ∫_A g(ω) V(y, p_o) dω(y),    dω = |cos θ| dA / |y - p_o|²

(Veach 1997, section 8.2.2.2), summed over pieces that are small as seen from p_o, each of which counts with its exact
solid angle (`pieces`), and with g and V at its centre (`nerg_mi.density.received.attended`). Over the sphere of the
same observer directions of equal area tell what g adds up to and how much of it meets something else, or nothing. Both
sums use other points, and what they lack of each other is the error that is told.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.density.received import Density, attended
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.maths.types import Point3f, Vector3f
from nerg_mi.transport.observer.cache import ObserverCache
from nerg_mi.transport.observer.gaze import PlacedGaze

from .cones import blurred
from .pieces import Pieces, pieces_of
from .sums import Sums, deposit, merge
from .target import Target

BATCH = 1 << 20
"""Pieces in one launch."""


@dataclass(frozen=True, kw_only=True)
class GazeSettings:
    """``angle``: radian under which an observer sees a piece at most; ``cone``: standard deviation in radian of the
    cone that gaze is seen through, 0 for none; ``directions`` over the sphere."""

    angle: float = 0.0175
    cone: float = 0.0
    directions: int = 1 << 16


@dataclass(frozen=True, eq=False)
class Looker:
    """An observer at ``center`` (one lane): their ``density`` where they see a surface, as
    `nerg_mi.density.received` wants it, and ``along`` directions, whatever is met there."""

    center: Point3f
    density: Density
    along: Callable[[Vector3f], Any]


MakeLooker = Callable[[np.ndarray], Looker]
"""Of an observer's position (3,)."""


def lookers_of_law(law: Callable[[Vector3f], Any]) -> MakeLooker:
    """Observers whose density depends on the direction alone: ``law`` of unit directions, in 1/sr."""

    def make(eye: np.ndarray) -> Looker:
        return Looker(_center(eye), lambda p_od, p_o, r_o, active: law(r_o), law)

    return make


def lookers_of_field(gaze: PlacedGaze, target: Target) -> MakeLooker:
    """Observers whose gaze is the field ``gaze`` in the place of ``target``."""

    def make(eye: np.ndarray) -> Looker:
        center = _center(eye)
        # Nobody is asked for twice, and what is known of all of them would fill the memory.
        observed = gaze.at([center], target.place, target.settings, ObserverCache())
        return Looker(
            center,
            lambda p_od, p_o, r_o, active: observed.evaluate(p_od, p_o, r_o, active)[0],
            lambda directions: observed.along(center, directions),
        )

    return make


def gaze_sums(
    target: Target, make: MakeLooker, eyes: np.ndarray, weights: Sequence[float] | np.ndarray, settings: GazeSettings
) -> Sums:
    """What observers at ``eyes`` (M, 3), who count by ``weights`` (M,), leave on ``target``: partial sums, which
    `merge` adds up to those of more observers."""
    none = Sums.none(len(target.mesh.faces), len(target.mesh.vertices))
    with dr.suspend_grad():
        return merge([none, *(_of_one(target, make(eye), float(w), eye, settings) for eye, w in zip(eyes, weights))])


def _of_one(target: Target, looker: Looker, weight: float, eye: np.ndarray, settings: GazeSettings) -> Sums:
    mesh = target.mesh
    pieces = pieces_of(mesh, eye, settings.angle)
    received = weight * pieces.solid_angle * _attended(target, looker, pieces, settings.cone)
    on_faces, on_vertices = deposit(mesh.faces, len(mesh.vertices), pieces.face, pieces.place, received)
    directions = fibonacci_directions(settings.directions)
    ends = target.ends(np.broadcast_to(eye, directions.shape), directions)
    along = _along(looker, settings.cone)(_vectors(directions))
    share = weight * 4 * np.pi / len(directions) * np.broadcast_to(np.array(along, np.float64), (len(directions),))
    escaped = share[(ends.face < 0) & ~ends.elsewhere].sum()
    return Sums(
        on_faces, on_vertices, float(share[ends.elsewhere].sum()), float(escaped), float(share.sum()), weight, 1
    )


def _attended(target: Target, looker: Looker, pieces: Pieces, cone: float) -> np.ndarray:
    """Gaze after occlusion, in 1/sr, that reaches the centres of pieces, (P,) float64."""
    out = np.zeros(len(pieces.face))
    normals = target.mesh.normals[pieces.face]
    density = looker.density
    if cone > 0:
        density = lambda p_od, p_o, r_o, active: blurred(looker.along, r_o, cone)
    for a in range(0, len(out), BATCH):
        rows = np.arange(a, min(a + BATCH, len(out)))
        # Most of a place is hidden from wherever one stands, and gaze costs more than rays.
        seen = _launch(target, looker.center, _uniform, pieces.center[rows], normals[rows])
        rows = rows[seen > 0]
        if len(rows):
            out[rows] = _launch(target, looker.center, density, pieces.center[rows], normals[rows])
    return out


def _launch(target: Target, center: Point3f, density: Density, p: np.ndarray, n: np.ndarray) -> np.ndarray:
    import mitsuba as mi

    p_o = center + dr.zeros(mi.Point3f, len(p))
    found = attended(
        target.place, density, p_o, mi.Point3f(_vectors(p)), _vectors(n), target.falloff, target.settings, True
    )
    return np.broadcast_to(np.array(found, np.float64), (len(p),))


def _uniform(p_od: Any, p_o: Any, r_o: Any, active: Any) -> Any:
    return type(r_o.x)(1)


def _along(looker: Looker, cone: float) -> Callable[[Vector3f], Any]:
    return looker.along if cone == 0 else lambda directions: blurred(looker.along, directions, cone)


def _vectors(values: np.ndarray) -> Vector3f:
    import mitsuba as mi

    return mi.Vector3f(np.ascontiguousarray(values.T, np.float32))


def _center(eye: np.ndarray) -> Point3f:
    import mitsuba as mi

    center = mi.Point3f(np.asarray(eye, np.float64).tolist())
    # A position that is a constant of the kernel would be compiled anew for every observer.
    dr.make_opaque(center)
    return center
