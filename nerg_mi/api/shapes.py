"""Shapes as a user has them (files, dicts, scenes, objects), as children of a Mitsuba scene."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, mitsuba_says
from nerg_mi.formats.meshes import read_mesh_file


def mesh_child(path: str | os.PathLike[str]) -> Any:
    """The mesh file ``path`` as a child of a Mitsuba scene, in its colours or in grey, and seen from both sides: a
    dict, or a mesh of what Mitsuba does not show as it is. What of the file is not used goes to Mitsuba's log. Raises
    `NergError` for a file that is missing or damaged."""
    import mitsuba as mi

    from nerg_mi.surfaces.mesh import mitsuba_mesh

    mesh = read_mesh_file(path)
    log: Any = mi.Log  # of which the stubs know nothing
    for note in mesh.notes:
        log(mi.LogLevel.Warn, f"{path}: {note}")
    name, colors = ("face_color", mesh.face_colors) if mesh.colors is None else ("vertex_color", mesh.colors)
    tint = {} if colors is None else {"reflectance": {"type": "mesh_attribute", "name": name}}
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", **tint}}
    if mesh.is_plain:
        return {"type": Path(path).suffix.lower()[1:], "filename": str(path), "bsdf": bsdf}
    shown = mitsuba_mesh(mesh.vertices, mesh.faces, Path(path).stem, bsdf)
    if colors is not None:
        shown.add_attribute(name, 3, colors.astype(np.float32).ravel())
    return shown


def box_dict(lower: np.ndarray, upper: np.ndarray, turn: np.ndarray | None = None) -> dict:
    """The box between two corners as a mesh that Mitsuba takes, turned about its middle by the rotation ``turn`` (3, 3)
    if there is one; a variant must be set."""
    import mitsuba as mi

    center, half = (lower + upper) / 2, (upper - lower) / 2
    frame = np.eye(4)
    frame[:3, :3] = (np.eye(3) if turn is None else turn) * half
    frame[:3, 3] = center
    return {"type": "cube", "to_world": mi.ScalarTransform4d(frame.tolist())}


def scene_children(shapes: object, name: str = "shape") -> dict[str, Any]:
    """``shapes`` by their names, as a scene's dict takes them; the variant must be active.

    ``shapes``: a mesh file, a scene file, what `mi.load_dict` takes for a shape or a scene, a Mitsuba shape or scene,
    or several of these in a list or in a dict by name. ``name``: of those that bring none. Raises `NergError` for
    anything else.
    """
    import mitsuba as mi

    if shapes is None:
        return {}
    if isinstance(shapes, (str, os.PathLike)):
        if Path(shapes).suffix.lower() != ".xml":
            return {name: mesh_child(shapes)}
        from nerg_mi.rendering.scene import load_scene

        return _of_scene(load_scene(Path(shapes)), name)
    if isinstance(shapes, mi.Scene):
        return _of_scene(shapes, name)
    if isinstance(shapes, mi.Object):
        return {name: shapes}
    if isinstance(shapes, Mapping):
        if shapes.get("type") == "scene":
            with mitsuba_says():
                return _of_scene(mi.load_dict(dict(shapes), optimize=False), name)
        if "type" in shapes:
            return {name: dict(shapes)}
        named = [scene_children(child, str(key)) for key, child in shapes.items()]
    elif isinstance(shapes, (list, tuple)):
        named = [scene_children(child, f"{name}_{i}") for i, child in enumerate(shapes)]
    else:
        raise NergError(
            f"shapes are mesh or scene files, dicts for mi.load_dict or Mitsuba objects, got {type(shapes).__name__}"
        )
    return {key: child for children in named for key, child in children.items()}


def _of_scene(scene, name: str) -> dict[str, Any]:
    """Shapes of a scene, and those of its lights that are no shapes."""
    shapes = list(scene.shapes())
    found = {shape.id() or f"{name}_{i}": shape for i, shape in enumerate(shapes)}
    if len(found) < len(shapes):
        found = {f"{name}_{i}": shape for i, shape in enumerate(shapes)}
    lights = [light for light in scene.emitters() if not any(s.is_emitter() and s.emitter() is light for s in shapes)]
    return found | {f"{name}_light_{i}": light for i, light in enumerate(lights)}
