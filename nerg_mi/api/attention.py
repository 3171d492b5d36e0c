"""Attention on things: the share of observers' gaze that lands on a box, a mesh or a shape of the scene."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, mitsuba_says
from nerg_mi.formats.meshes import READERS
from nerg_mi.jobs.reporter import SILENT, Reporter

from . import arrays
from .arrays import Floats
from .observed import ObserverOf
from .queries import given_observers
from .scene import Scene
from .shapes import box_dict, mesh_child
from .variant import active_mitsuba

PIECE = 4
"""A piece of a surface is so many times shorter than its distance from the nearest observer."""

MOST = 32
"""A triangle is cut into so many parts a side at most, unless more are asked for."""


@dataclass(frozen=True, eq=False, repr=False)
class Attention:
    """Attention that a surface, cut into K flat pieces, receives from M observers.

    ``share`` (M,): of each observer's gaze, the integral of the density over the directions in which the surface is
    seen: a probability where the gaze field integrates to one, as normalised fields do. ``density`` (M, K): the same in
    area form, in 1 / square scene unit; times ``area`` (K,) it adds up to ``share``. ``points``, ``normals`` (K, 3):
    centres of the pieces and their outward unit normals. ``observers`` (M, 3).
    """

    share: Floats
    density: Floats
    points: Floats
    normals: Floats
    area: Floats
    observers: Floats

    @property
    def mean(self) -> float:
        """Mean share over the observers."""
        return float(np.mean(self.share, dtype=np.float64))

    def __repr__(self) -> str:
        return (
            f"<Attention: mean share {self.mean:.4g} of {len(self.observers)} observers "
            f"on {float(self.area.sum()):.4g} square units in {len(self.area):,} pieces>"
        )


def attention(
    scene: Scene,
    surface: ArrayLike | os.PathLike[str] | str | Mapping[str, Any] | object,
    observers: ArrayLike | None = None,
    *,
    divisions: int | None = None,
    two_sided: bool = False,
    reporter: Reporter = SILENT,
) -> Attention:
    """How much of their gaze observers give a thing, and where on it.

    ``surface``: a box, as its lower and upper corner (2, 3); the id of a mesh of the scene; a mesh file (.ply, .obj,
    .glb); a dict for ``mi.load_dict``, or a Mitsuba mesh. One that is not of the scene is looked at as if it stood
    there: the scene hides it, and it hides nothing but its own back. ``observers`` (M, 3), or None for the scene's own.
    ``divisions``: each triangle is cut into so many parts a side, whose centres stand for them; None: so many that
    pieces are no longer than a quarter of the distance to the nearest observer, which is right to some thousandths, and
    32 at most. ``two_sided``: count both sides of an open surface; otherwise the one whose vertices run
    counter-clockwise. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scene = nerg.make_scene(store / "store.safetensors", store / "shoppers.safetensors", falloff=0.05)
    >>> box = [(4.4, 4.65, 0), (4.9, 5.0, 1.45)]
    >>> seen = nerg.attention(scene, box, observers=[(4.4, 2.8, 1.6), (6.3, 3.0, 1.6)], divisions=2)
    >>> seen.share.shape, seen.density.shape, bool((seen.share >= 0).all() and (seen.share < 1).all())
    ((2,), (2, 48), True)
    """
    import drjit as dr

    from nerg_mi.density.received import patches

    active_mitsuba()
    if not scene.has_gaze:
        raise NergError("attention needs a gaze field; give make_scene gaze=")
    whole = isinstance(divisions, (int, np.integer)) and not isinstance(divisions, bool)
    if not (divisions is None or (whole and 1 <= divisions <= 4096)):
        raise NergError(f"divisions must be a whole number from 1 to 4,096, got {divisions!r}")
    eyes = given_observers(scene, observers)
    each = []
    with mitsuba_says(), dr.suspend_grad():
        mesh = _mesh(scene, surface)
        pieces = patches(mesh, _enough_divisions(mesh, eyes) if divisions is None else int(divisions))
        area = np.array(pieces.area, np.float32)
        for number, eye in enumerate(eyes):
            each.append(_density(ObserverOf(scene, eye), pieces, two_sided))
            reporter.progress((number + 1) / len(eyes), f"observer {number + 1} of {len(eyes)}")
        where, normals = (np.ascontiguousarray(np.array(v, np.float32).T) for v in (pieces.p, pieces.n))
    density = np.stack(each)
    share = (density.astype(np.float64) @ area.astype(np.float64)).astype(np.float32)
    return Attention(share, density, where, normals, area, eyes)


def shares(
    scene: Scene, surfaces: Sequence[Any], observer: ArrayLike, *, divisions: int, two_sided: bool = False
) -> Floats:
    """The share (N,) of one observer's gaze that each of N ``surfaces`` receives, all of them at once.

    Arguments and errors as of `attention`; ``observer`` (3,).
    """
    import drjit as dr
    import mitsuba as mi

    from nerg_mi.density.received import Patches, patches

    active_mitsuba()
    if not scene.has_gaze:
        raise NergError("attention needs a gaze field; give make_scene gaze=")
    if not len(surfaces):
        return np.zeros(0, np.float32)
    eye = given_observers(scene, observer)[0]
    with mitsuba_says(), dr.suspend_grad():
        each = [patches(_mesh(scene, surface), divisions) for surface in surfaces]
        area = [np.array(pieces.area, np.float64) for pieces in each]
        lanes = lambda name: np.concatenate([np.array(getattr(pieces, name), np.float32) for pieces in each], axis=1)
        pieces = Patches(mi.Point3f(lanes("p")), mi.Vector3f(lanes("n")), mi.Float(np.concatenate(area)))
        density = _density(ObserverOf(scene, eye), pieces, two_sided)
    starts = np.cumsum([0, *(len(a) for a in area[:-1])])
    return np.add.reduceat(density * np.concatenate(area), starts).astype(np.float32)


def _density(observer: ObserverOf, pieces: Any, two_sided: bool) -> Floats:
    """Attention (K,) per area that ``pieces`` receive from ``observer``."""
    from nerg_mi.density.received import arriving

    i = observer.integrator
    settings = i.observer_settings
    found = arriving(
        observer.place, observer.density, observer.center, pieces.p, pieces.n, i.falloff, settings, two_sided
    )
    return np.array(found, np.float32)


def _enough_divisions(mesh: Any, eyes: Floats) -> int:
    """A power of two, so that meshes of different sizes have kernels in common."""
    import mitsuba as mi

    if not isinstance(mesh, mi.Mesh):
        return 1  # no mesh, as will be said
    positions, faces = (np.reshape(np.array(v), (-1, 3)) for v in (mesh.vertex_positions_buffer(), mesh.faces_buffer()))
    corners = positions[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
    beside = np.maximum(np.maximum(corners.min((0, 1)) - eyes, eyes - corners.max((0, 1))), 0)
    nearest = np.linalg.norm(beside, axis=1).min()
    wanted = PIECE * longest / nearest if nearest > 0 else np.inf
    return int(2 ** np.ceil(np.log2(np.clip(wanted, 1, MOST))))


def _mesh(scene: Scene, surface: Any) -> Any:
    """``surface`` as a Mitsuba mesh."""
    import mitsuba as mi

    if isinstance(surface, str) and Path(surface).suffix.lower() not in READERS:
        by_id = {shape.id(): shape for shape in scene.mitsuba.shapes()}
        if surface not in by_id:
            known = f"it has {', '.join(by_id)}" if by_id else "it has none"
            raise NergError(f'the scene has no shape "{surface}"; {known}')
        return by_id[surface]
    if isinstance(surface, (str, os.PathLike)):
        surface = mesh_child(surface)
    if isinstance(surface, mi.Object):
        return surface
    if isinstance(surface, Mapping):
        return mi.load_dict(dict(surface))
    corners = arrays.points(surface, "the corners of a box")
    if len(corners) != 2 or not np.all(corners[0] < corners[1]):
        raise NergError(f"a box is a lower corner and an upper one, got {corners.tolist()}")
    return mi.load_dict(box_dict(*corners.astype(np.float64)))
