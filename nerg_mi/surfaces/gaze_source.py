r"""What the gaze of observers leaves on a surface, after occlusion.

An observer at p_o looks into the direction ω with the density g(ω), in 1/sr. On a face A they leave

    ∫_A g(ω) V(y, p_o) dω(y),    dω = |cos θ| dA / |y - p_o|²

(Veach 1997, section 8.2.2.2), summed over pieces that are small as seen from p_o, each of which counts with its exact
solid angle (`pieces`), with g at its centre, and with the share of it that is seen, for which it is cut where outlines
pass (`outlines`). In a medium, or with a fall-off behind outlines, V is that of
`nerg_mi.probes.surface_attention.attended` at the centre. Over the sphere of the same observer directions
(`sphere_rule`) tell what g adds up to and how much of it meets something else, or nothing. Both sums use other points,
and what they lack of each other is the error that is told.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import vector_of
from nerg_mi.maths.types import Point3f, Vector3f
from nerg_mi.probes.surface_attention import Density, attended
from nerg_mi.transport.observer.cache import ObserverCache
from nerg_mi.transport.observer.gaze import PlacedGaze
from nerg_mi.transport.observer.settings import ObserverSettings
from nerg_mi.transport.place import Place

from .cones import blurred
from .outlines import visible_pieces
from .pieces import Pieces, pieces_of
from .sphere_rule import sphere_rule
from .sums import Sums, deposit, merge
from .target import Target

BATCH = 1 << 18
"""Pieces in one launch."""

FACES = 1 << 16
"""Faces that are cut into pieces together."""


@dataclass(frozen=True, kw_only=True)
class GazeSettings:
    """``angle``: radian under which an observer sees a piece at most; ``cone``: standard deviation in radian of the
    cone that gaze is seen through, 0 for none; ``directions`` over the sphere, about."""

    angle: float = 0.035
    cone: float = 0.0
    directions: int = 1 << 16


@dataclass(frozen=True, eq=False)
class Looker:
    """An observer at ``center`` (one lane): their ``density`` where they see a surface, as
    `nerg_mi.probes.surface_attention` wants it, and ``along`` directions, whatever is met there."""

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


def lookers_of_field(gaze: PlacedGaze, place: Place, settings: ObserverSettings) -> MakeLooker:
    """Observers whose gaze is the field ``gaze`` in ``place``, traced with ``settings``."""

    def make(eye: np.ndarray) -> Looker:
        center = _center(eye)
        # Nobody is asked for twice, and what is known of all of them would fill the memory.
        observed = gaze.at([center], place, settings, ObserverCache())
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
    import mitsuba as mi

    mesh, eye = target.mesh, np.asarray(eye, np.float64)
    along = along_through(looker, settings.cone)
    everywhere = lambda d: np.broadcast_to(np.array(along(vector_of(mi.Vector3f, d)), np.float64), (len(d),))
    directions, angles = sphere_rule(everywhere, settings.directions)
    share = weight * angles * everywhere(directions)
    ends = target.ends(np.broadcast_to(eye, directions.shape), directions)
    total, escaped = float(share.sum()), float(share[(ends.face < 0) & ~ends.elsewhere].sum())
    on_faces, on_vertices = np.zeros(len(mesh.faces)), np.zeros(len(mesh.vertices))
    for a in range(0, len(mesh.faces), FACES):
        pieces = pieces_of(mesh, eye, settings.angle, slice(a, a + FACES))
        for some, received in _received(target, looker, pieces, total / weight if weight else 0.0, settings.cone):
            found = deposit(mesh.faces, len(mesh.vertices), some.face, some.place, weight * received)
            on_faces, on_vertices = on_faces + found[0], on_vertices + found[1]
    return Sums(on_faces, on_vertices, float(share[ends.elsewhere].sum()), escaped, total, weight, 1)


def _received(
    target: Target, looker: Looker, pieces: Pieces, total: float, cone: float
) -> Iterator[tuple[Pieces, np.ndarray]]:
    """Pieces, some of which may be cut again, and the gaze (P,) that each receives."""
    density = density_through(looker, cone)
    if target.sharp:
        yield from visible_pieces(target, pieces, lambda some: _of_pieces(looker, density, some), total, BATCH)
        return
    for a in range(0, len(pieces), BATCH):
        # Most of a place is hidden from wherever one stands, and gaze costs more than rays.
        some = pieces.part(slice(a, a + BATCH))
        some = some.part(_launch(target, looker.center, _uniform, some) > 0)
        if len(some):
            yield some, some.solid_angle * _launch(target, looker.center, density, some)


def unhidden(looker: Looker, density: Density, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """``density`` (N,) of ``looker`` at ``points`` (N, 3), along unit ``directions`` (N, 3), in 1/sr, whatever may
    stand between."""
    import mitsuba as mi

    r_o, p_od = vector_of(mi.Vector3f, directions), vector_of(mi.Point3f, points)
    p_o = looker.center + dr.zeros(mi.Point3f, len(points))
    found = density(p_od, p_o, r_o, dr.full(mi.Bool, True, len(points)))
    return np.broadcast_to(np.array(found, np.float64), (len(points),))


def density_through(looker: Looker, cone: float) -> Density:
    """The density of ``looker`` seen through a cone of standard deviation ``cone`` in radian; 0: itself."""
    if cone == 0:
        return looker.density
    return lambda p_od, p_o, r_o, active: blurred(looker.along, r_o, cone)


def _of_pieces(looker: Looker, density: Density, pieces: Pieces) -> np.ndarray:
    middle = pieces.relative.mean(axis=1)
    return unhidden(looker, density, pieces.center, middle / np.linalg.norm(middle, axis=1, keepdims=True))


def _launch(target: Target, center: Point3f, density: Density, pieces: Pieces) -> np.ndarray:
    """``density`` (P,) after occlusion by what may be a medium, at the centroids of ``pieces``, in 1/sr."""
    import mitsuba as mi

    p_o, p = center + dr.zeros(mi.Point3f, len(pieces)), vector_of(mi.Point3f, pieces.center)
    normals = vector_of(mi.Vector3f, target.mesh.normals[pieces.face])
    found = attended(target.place, density, p_o, p, normals, target.falloff, target.settings, True)
    return np.broadcast_to(np.array(found, np.float64), (len(pieces),))


def _uniform(p_od: Any, p_o: Any, r_o: Any, active: Any) -> Any:
    return type(r_o.x)(1)


def along_through(looker: Looker, cone: float) -> Callable[[Vector3f], Any]:
    """The density of ``looker`` in unit directions, seen through a cone as `density_through` has it."""
    return looker.along if cone == 0 else lambda directions: blurred(looker.along, directions, cone)


def _center(eye: np.ndarray) -> Point3f:
    import mitsuba as mi

    center = mi.Point3f(np.asarray(eye, np.float64).tolist())
    # A position that is a constant of the kernel would be compiled anew for every observer.
    dr.make_opaque(center)
    return center
