"""What receives gaze: a mesh file, shapes of a scene file, or the surface of a radiance field."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.formats.fields import load_radiance
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.splats import refuse_others
from nerg_mi.formats.surfaces import mesh as mesh_of_field
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.rendering.scene import load_scene
from nerg_mi.surfaces.mesh import Mesh, Refined, Triangles, refine, shape_triangles, weld

FACES = 100_000
"""Triangles that a surface is cut into when nothing is said."""


@dataclass(frozen=True, eq=False)
class Receivers:
    """``mesh`` of what receives gaze, as it was given: ``shape`` (F,) the number in ``names`` of what each face is of,
    and ``index`` (F,) its number there; ``others``: what only hides it."""

    mesh: Mesh
    names: tuple[str, ...]
    shape: np.ndarray
    index: np.ndarray
    others: tuple[Triangles, ...] = ()


def read_receivers(
    path: Path, shapes: tuple[str, ...], resolution: int, ns: ModuleType, reporter: Reporter
) -> Receivers:
    """Those of ``path``: a mesh, a scene (.xml) or a radiance field (.safetensors); of a scene, ``shapes`` alone where
    any are named. Raises `NergError`."""
    suffix = path.suffix.lower()
    others: tuple[Triangles, ...] = ()
    if suffix == ".xml":
        found, others = _of_scene(path, shapes)
    elif shapes:
        raise NergError(f'--shape names shapes of a scene, and "{path}" is none; leave it out')
    elif suffix == ".safetensors":
        kind = read_metadata(path).get("kind")
        if kind != "radiance":
            raise NergError(
                f'"{path}" is no radiance field, of which surfaces could be made; name the place first, and the gaze '
                "field by --gaze"
            )
        reporter.progress(0.02, "looking for the field's surface")
        body = mesh_of_field(load_radiance(path, ns)[0], resolution)
        assert body.faces is not None, "a mesh has faces"
        found = {path.stem: (body.vertices, body.faces)}
    else:
        refuse_others(path)
        body = read_mesh_file(path)
        for note in body.notes:
            reporter.message(f"of {path}: {note}")
        found = {path.stem: (body.vertices, body.faces)}
    return _joined(path, found, others, reporter)


def cut(receivers: Receivers, longest: float | None, scale: float) -> Refined:
    """Their mesh with edges of at most ``longest`` metres, or of a length that gives about `FACES` triangles;
    ``scale``: scene units a metre."""
    mesh = receivers.mesh
    if longest is not None:
        return refine(mesh, longest * scale)
    # Equilateral triangles of such edges would be so many; halving makes triangles up to four times smaller.
    return refine(mesh, float(np.sqrt(4 * mesh.area.sum() / (np.sqrt(3) * FACES)) * 1.5))


def _of_scene(path: Path, shapes: tuple[str, ...]) -> tuple[dict[str, Triangles], tuple[Triangles, ...]]:
    loaded = load_scene(path)
    # Mitsuba keeps them in no order that is always the same.
    every = dict(sorted(((shape.id(), shape) for shape in loaded.shapes()), key=lambda named: named[0]))
    missing = [name for name in shapes if name not in every]
    if missing:
        known = f"it has {', '.join(every)}" if every else "it has none"
        raise NergError(f'the scene "{path}" has no shape "{missing[0]}"; {known}')
    if not every:
        raise NergError(f'the scene "{path}" has no shapes to put gaze on; name its field, or its splats, in its place')
    found, others = {}, []
    for name, shape in every.items():
        triangles = shape_triangles(shape)
        if triangles is None:
            raise NergError(
                f'the shape "{name}" of "{path}" is a {shape.class_name()}, which has no triangles; give a mesh of it'
            )
        if shapes and name not in shapes:
            others.append(triangles)
        else:
            found[name] = triangles
    return found, tuple(others)


def _joined(path: Path, found: dict[str, Triangles], others: tuple[Triangles, ...], reporter: Reporter) -> Receivers:
    """One mesh of all, whose vertices are one where they touch."""
    first = np.cumsum([0, *(len(v) for v, _ in found.values())])
    vertices = np.concatenate([v for v, _ in found.values()])
    faces = np.concatenate([f + start for (_, f), start in zip(found.values(), first)])
    counts = [len(f) for _, f in found.values()]
    mesh, index, repairs = weld(vertices, faces, f'the mesh "{path}"')
    if repairs.sentence:
        reporter.message(f"{path.name}: {repairs.sentence}")
    shape = np.repeat(np.arange(len(counts)), counts)
    number = np.concatenate([np.arange(n) for n in counts])
    return Receivers(mesh, tuple(found), shape[index], number[index], others)
