"""Parts of a bake as tasks: what a worker runs for some of the observers, or of the rays."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.files.atomic import replacing
from nerg_mi.files.safe_read import read_npy
from nerg_mi.jobs.backend import select_backend
from nerg_mi.jobs.parts import Parts
from nerg_mi.rendering.scene_file import files_of_scene
from nerg_mi.surfaces.laplacian import Sums
from nerg_mi.surfaces.mesh import Mesh, Triangles
from nerg_mi.surfaces.sources import Crowd, GazeSettings, RaySettings, TrackedRays
from nerg_mi.tasks.code import RENDERS, versions
from nerg_mi.tasks.inputs import InputFile, name_of, read_input, read_inputs
from nerg_mi.tasks.run import Output
from nerg_mi.tasks.task import Task, canonical
from nerg_mi.threads import use_share

from .chunks import BakeScene, bake_chunk, parts_of

_NUMBERS = ("elsewhere", "escaped", "total", "weight", "count")
_GAZE = "of-the-job/gaze.safetensors"
_RAYS = "of-the-job/rays.npy"

_last: dict[str, BakeScene] = {}


def bake_part(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> dict[str, float]:
    """Sums over faces and vertices (.npy), with the others as notes. ``parameters``: ``mode``, ``around`` (all that
    `_describe` says of the scene) with its ``digest``, and ``positions`` and ``weights`` of observers, or the number of
    the ``first`` of the rays that are among ``inputs``."""
    select_backend(parameters["mode"])
    use_share()
    return write_sums(bake_chunk(_scene(parameters, inputs), part_of(parameters, inputs)), output)


def write_sums(sums: Sums, output: Path) -> dict[str, float]:
    """``sums`` as a task leaves them: arrays in a file, and the others, which are returned, as notes."""
    with replacing(output) as temporary, temporary.open("wb") as out:
        np.save(out, np.concatenate([sums.face, sums.vertex]))
    return {name: getattr(sums, name) for name in _NUMBERS}


def read_sums(made: Output, faces: int) -> Sums:
    """What `write_sums` has written, of so many ``faces``."""
    values = read_npy(made.path, "part of a bake")
    return Sums(values[:faces], values[faces:], **{name: made.notes[name] for name in _NUMBERS})


def tasks_of(scene: BakeScene, who: Crowd | TrackedRays, mode: str, parts: Parts) -> list[Task]:
    """A task for each part of ``who``, in their order; meshes and rays are held by the store of ``parts``."""
    around, inputs = _describe(scene, parts)
    return tasks_around(f"{__name__}:bake_part", around, inputs, who, mode, parts)


def tasks_around(
    function: str,
    around: dict[str, Any],
    inputs: tuple[InputFile, ...],
    who: Crowd | TrackedRays,
    mode: str,
    parts: Parts,
) -> list[Task]:
    """A task for ``function`` for each part of ``who``, ``around`` which is what is the same for all of them, of which
    it reads ``inputs``."""
    files = {file.name: file.sha256 for file in inputs}
    common = {"mode": mode, "around": around, "digest": hashlib.sha256(canonical([around, files]).encode()).hexdigest()}
    found, start = [], 0
    for part in parts_of(who):
        count = len(part.weights)
        label = f"{'rays' if isinstance(part, TrackedRays) else 'observers'} {start + 1} to {start + count}"
        own, more = _given(part, parts)
        needed = versions(*RENDERS, "scipy")
        found.append(Task(function, {**common, **own}, (*inputs, *more), ".npy", needed, label))
        start += count
    return found


def _given(part: Crowd | TrackedRays, parts: Parts) -> tuple[dict[str, Any], tuple[InputFile, ...]]:
    if isinstance(part, TrackedRays):
        values = np.column_stack([part.origins, part.directions, part.weights])
        return {"first": part.first}, (parts.hold(_RAYS, values),)
    return {"positions": part.positions.tolist(), "weights": part.weights.tolist()}, ()


def part_of(parameters: Mapping[str, Any], inputs: Mapping[str, Path]) -> Crowd | TrackedRays:
    """The observers, or the rays, of a task that `tasks_around` made."""
    if "first" not in parameters:
        return Crowd(np.array(parameters["positions"]), np.array(parameters["weights"]))
    values = read_npy(inputs[_RAYS], "rays of a bake")
    origins, directions, weights = (np.ascontiguousarray(v) for v in (values[:, :3], values[:, 3:6], values[:, 6]))
    return TrackedRays(origins, directions, weights, parameters["first"])


def _describe(scene: BakeScene, parts: Parts) -> tuple[dict[str, Any], tuple[InputFile, ...]]:
    """``scene`` as JSON has it, and the files that it refers to, meshes among them."""
    meshes = [(scene.mesh.vertices, scene.mesh.faces), *scene.others]
    files: list[InputFile] = []
    for k, mesh in enumerate(meshes):
        files += [parts.hold(name, values) for name, values in zip(_names(k), mesh)]
    found: dict[str, Any] = {"meshes": len(meshes), "gaze": scene.gaze is not None, "scene": None}
    found |= {"of_gaze": asdict(scene.of_gaze), "of_rays": asdict(scene.of_rays)}
    if scene.gaze is not None:
        files.append(read_input(_GAZE, scene.gaze))
    if scene.scene is not None:
        named = read_inputs(files_of_scene(scene.scene))
        files += named
        found["scene"] = name_of(scene.scene, named)
    return found, tuple(files)


def _scene(parameters: Mapping[str, Any], inputs: Mapping[str, Path]) -> BakeScene:
    """The scene that `_describe` described; the last one is kept for the next part."""
    digest, around = parameters["digest"], parameters["around"]
    if digest not in _last:
        _last.clear()
        mesh, *others = (_triangles(inputs, k) for k in range(around["meshes"]))
        _last[digest] = BakeScene(
            Mesh(*mesh),
            tuple(others),
            inputs[_GAZE] if around["gaze"] else None,
            None if around["scene"] is None else inputs[around["scene"]],
            GazeSettings(**around["of_gaze"]),
            RaySettings(**around["of_rays"]),
        )
    return _last[digest]


def _triangles(inputs: Mapping[str, Path], k: int) -> Triangles:
    vertices, faces = (read_npy(inputs[name], "mesh of a bake") for name in _names(k))
    return vertices, faces


def _names(k: int) -> tuple[str, str]:
    return f"of-the-job/vertices-{k}.npy", f"of-the-job/faces-{k}.npy"
