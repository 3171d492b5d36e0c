"""Attention on things: the share of observers' gaze that lands on a box, a mesh or a shape of the scene.

Of a box it is the share of the gaze whose first surface lies in it, summed over directions
(`nerg_mi.statistics.shares`), as statistics, reports and the viewer have it. Of a mesh or a shape it is the share that
ends on its own surface, in area form (`nerg_mi.probes.surface_attention`), which also tells where on it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, mitsuba_says
from nerg_mi.formats.areas import Region
from nerg_mi.formats.meshes import READERS
from nerg_mi.maths.types import variant_types
from nerg_mi.ranges import FARTHEST, Range, check_number
from nerg_mi.statistics.shares import Shares, SumRule, gaze_shares
from nerg_mi.statistics.visits import MARGIN, Box
from nerg_mi.workflows.base import SILENT, Reporter

from . import arrays
from .arrays import Floats
from .fields import FilePath
from .observed import ObserverOf
from .queries import given_observers
from .scene import Scene
from .shapes import mesh_child
from .variant import active_mitsuba

FINE = SumRule()
"""How finely the share of a box is summed, unless another tolerance is asked for."""

PIECE = 4
"""A piece of a surface is so many times shorter than its distance from the nearest observer."""

MOST = 32
"""A triangle is cut into so many parts a side at most, unless more are asked for."""


@dataclass(frozen=True, eq=False, repr=False)
class Attention:
    """Attention that a thing receives from M observers.

    ``share`` (M,): of each observer's gaze, the part whose first surface lies in the box, or is the mesh or the shape;
    all of the gaze, with what meets no surface, is 1. ``error`` (M,): the one that a share of a box is likely to have
    at most; None for meshes. ``escaped`` (M,): the share that meets no surface at all; None for meshes. ``observers``
    (M, 3).
    """

    share: Floats
    observers: Floats
    error: Floats | None = None
    escaped: Floats | None = None

    @property
    def mean(self) -> float:
        """Mean share over the observers."""
        return float(np.mean(self.share, dtype=np.float64))

    def __repr__(self) -> str:
        return f"<Attention: mean share {self.mean:.4g} of {len(self.observers)} observers>"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SurfaceAttention(Attention):
    """Attention that a surface, cut into K flat pieces, receives from M observers.

    ``density`` (M, K): in area form, in 1 / square scene unit; times ``area`` (K,) it adds up to ``share``. ``points``,
    ``normals`` (K, 3): centres of the pieces and their outward unit normals.
    """

    density: Floats
    points: Floats
    normals: Floats
    area: Floats

    def __repr__(self) -> str:
        return (
            f"<Attention: mean share {self.mean:.4g} of {len(self.observers)} observers "
            f"on {float(self.area.sum()):.4g} square units in {len(self.area):,} pieces>"
        )


def attention(
    scene: Scene | FilePath,
    surface: ArrayLike | os.PathLike[str] | str | Mapping[str, Any] | object,
    observers: ArrayLike | None = None,
    *,
    margin: float = MARGIN,
    tolerance: float = FINE.tolerance,
    divisions: int | None = None,
    two_sided: bool = False,
    reporter: Reporter = SILENT,
) -> Attention:
    """How much of their gaze observers give a thing.

    ``surface``: a box, as its lower and upper corner (2, 3); the id of a mesh of the scene; a mesh file (.ply, .obj,
    .glb); a dict for ``mi.load_dict``, or a Mitsuba mesh. ``observers`` (M, 3), or None for the scene's own.

    A box has the gaze whose first surface lies in it, whatever stands there, so that a larger box never has less, and
    one in free air has none. ``margin``, in scene units: how far in front of the box, or behind it, on a ray that
    crosses it, that surface may lie; with 0, boxes that fill space without overlap, none of whose faces runs along a
    surface, add up to 1 with ``escaped``.
    ``tolerance``: directions are added until the error of a share is less than this part of it (or 1e-5), or until a
    million lie around the observer.

    A mesh is a surface of its own, and the result a `SurfaceAttention`, which says where on it: one that is not of the
    scene is looked at as if it stood there: the scene hides it, and it hides nothing but its own back. ``divisions``:
    each triangle is cut into so many parts a side, whose centres stand for them; None: so many that pieces are no
    longer than a quarter of the distance to the nearest observer, which is right to some thousandths, and 32 at most.
    ``two_sided``: count both sides of an open surface; otherwise the one whose vertices run counter-clockwise. The
    scene's fall-off has no part in it: what is hidden is not looked at. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scene = nerg.make_scene(store / "store.safetensors", store / "shoppers.safetensors", falloff=0.05)
    >>> shelf = [(3.79, 5.4, 0.0), (5.31, 6.0, 1.9)]
    >>> seen = nerg.attention(scene, shelf, observers=[(4.4, 2.8, 1.6), (6.3, 3.0, 1.6)])
    >>> seen.share.shape, bool((seen.share > 0).all() and (seen.error < 0.1 * seen.share).all())
    ((2,), True)
    """
    import drjit as dr

    from nerg_mi.probes.surface_attention import patches

    scene = Scene.of(scene)
    _check(scene)
    check_number(margin, Range(0, FARTHEST), "margin")
    check_number(tolerance, Range(1e-9, 1), "tolerance")
    if (region := _box(surface)) is not None:
        if divisions is not None or two_sided:
            raise NergError("divisions and two_sided are of meshes, and this is a box; leave them out, or give a mesh")
        eyes = given_observers(scene, observers)
        rule = SumRule(tolerance=float(tolerance))
        found = box_shares(scene, [region], eyes, margin=float(margin), rule=rule, reporter=reporter)
        single = lambda v: np.ascontiguousarray(v, np.float32)
        return Attention(single(found.share[:, 0]), eyes, single(found.error[:, 0]), single(found.escaped))
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
            each.append(_density(scene, eye, pieces, two_sided))
            reporter.progress((number + 1) / len(eyes), f"observer {number + 1} of {len(eyes)}")
        where, normals = (np.ascontiguousarray(np.array(v, np.float32).T) for v in (pieces.p, pieces.n))
    density = np.stack(each)
    share = (density.astype(np.float64) @ area.astype(np.float64)).astype(np.float32)
    if not np.isfinite(share).all():
        raise NergError("the attention on this mesh is not finite; give one, and observers, of the scene's size")
    return SurfaceAttention(share, eyes, density=density, points=where, normals=normals, area=area)


def box_shares(
    scene: Scene,
    regions: Sequence[Region],
    observers: Floats,
    *,
    margin: float = MARGIN,
    rule: SumRule = FINE,
    reporter: Reporter = SILENT,
) -> Shares:
    """The shares of ``observers`` (M, 3) on N boxes, which may be turned, all of them at once, (M, N), as finely as
    the ``rule`` says; arguments and errors as of `attention`."""
    from nerg_mi.transport.observer_gaze import look_from

    _check(scene)
    i, place, count = scene.integrator, scene.place, len(observers)
    told = lambda done: reporter.progress(done / count, f"observer {done} of {count}")
    with mitsuba_says():
        return gaze_shares(
            lambda eye: look_from(i.gaze, place, i.observer_settings, eye),
            observers,
            [Box(region) for region in regions],
            [(k,) for k in range(len(regions))],
            margin,
            rule,
            told,
        )


def mesh_shares(
    scene: Scene, surfaces: Sequence[Any], observer: ArrayLike, *, divisions: int, two_sided: bool = False
) -> Floats:
    """The share (N,) of one observer's gaze that each of N meshes, ``surfaces``, receives, all of them at once.

    Arguments and errors as of `attention`; ``observer`` (3,).
    """
    import drjit as dr

    mi = variant_types()
    from nerg_mi.probes.surface_attention import Patches, patches

    _check(scene)
    if not len(surfaces):
        return np.zeros(0, np.float32)
    eye = given_observers(scene, observer)[0]
    with mitsuba_says(), dr.suspend_grad():
        each = [patches(_mesh(scene, surface), divisions) for surface in surfaces]
        area = [np.array(pieces.area, np.float64) for pieces in each]
        lanes = lambda name: np.concatenate([np.array(getattr(pieces, name), np.float32) for pieces in each], axis=1)
        pieces = Patches(mi.Point3f(lanes("p")), mi.Vector3f(lanes("n")), mi.Float(np.concatenate(area)))
        density = _density(scene, eye, pieces, two_sided)
    starts = np.cumsum([0, *(len(a) for a in area[:-1])])
    return np.add.reduceat(density * np.concatenate(area), starts).astype(np.float32)


def _check(scene: Scene) -> None:
    active_mitsuba()
    if not scene.has_gaze:
        raise NergError("attention needs a gaze field; give make_scene gaze=")


def _density(scene: Scene, eye: Floats, pieces: Any, two_sided: bool) -> Floats:
    """Share of the gaze (K,) per area that ``pieces`` receive from the observer at ``eye`` (3,)."""
    from nerg_mi.probes.surface_attention import arriving

    observer = ObserverOf(scene, eye)
    settings = observer.integrator.observer_settings
    found = arriving(observer.place, observer.density, observer.center, pieces.p, pieces.n, 0.0, settings, two_sided)
    if not observer.integrator.gaze.field.config.normalized:
        whole = box_shares(scene, [], eye[None]).whole[0]
        found /= whole if whole > 0 else 1
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


def _box(surface: Any) -> Region | None:
    """``surface`` as a box; None for what is a mesh, or the name of one."""
    import mitsuba as mi

    if isinstance(surface, Region):
        return surface
    if isinstance(surface, (str, os.PathLike, Mapping, mi.Object)):
        return None
    corners = arrays.points(surface, "the corners of a box").astype(np.float64)
    if len(corners) != 2 or not np.all(corners[0] < corners[1]):
        raise NergError(f"a box is a lower corner and an upper one, got {corners.tolist()}")
    return Region.of("box", *corners)


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
    return mi.load_dict(dict(surface)) if isinstance(surface, Mapping) else surface
