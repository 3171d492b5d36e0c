"""Objects in memory where a workflow needs a file: environments, fields, rays, areas and alignments.

Workflows read files, since worker processes and checkpoints refer to them. An object is therefore written to a folder
of this process, under a name that contains a checksum of its content, and the folder is removed when the process ends.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from nerg_mi.environment.contents import (
    DensityGrid,
    from_trimesh,
    has_nerg,
    is_trimesh,
    to_scene_children,
    write_content,
)
from nerg_mi.environment.kinds import detect_kind
from nerg_mi.environment.trained import TrainedField
from nerg_mi.errors import NergError
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.fields.splats import Splats
from nerg_mi.files.atomic import file_sha256, make_folder, replace_atomically, write_text
from nerg_mi.files.values import to_numbers
from nerg_mi.formats.areas import format_areas
from nerg_mi.formats.splats import write_ply_splats
from nerg_mi.maths.transforms import check_rigid_transforms
from nerg_mi.options import GeometryOptions
from nerg_mi.progress import WarningReporter
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.files import write_mesh
from nerg_mi.rendering.scene import activate_mitsuba, list_scene_files

from .arguments import check_names, resolve_file
from .scene import Scene, make_scene
from .session import CHECKSUM_DIGITS, is_object, session_folder

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def _store(stem: str, suffix: str, write: Callable[[Path], object]) -> Path:
    """Write an object with ``write(path)``, which may also write files and a folder whose names begin with that of
    ``path``.

    Returns the path, whose name consists of ``stem``, a checksum of all written files, and ``suffix``.
    """
    with tempfile.TemporaryDirectory(dir=session_folder()) as folder:
        write(Path(folder) / f"{stem}{suffix}")
        checksums = [file_sha256(file) for file in sorted(Path(folder).rglob("*")) if file.is_file()]
    checksum = hashlib.sha256("".join(checksums).encode()).hexdigest()[:CHECKSUM_DIGITS]
    path = session_folder() / f"{stem}-{checksum}{suffix}"
    if not path.exists():
        # Scenes refer to their files by name, so they are written again under the final name.
        write(path)
    return path


def copy_from_session(path: Path, folder: Path) -> None:
    """Copy ``path`` and the files that it refers to into ``folder``, if they are in the folder of this process."""
    if not is_object(path):
        return
    for file in list_scene_files(path) if path.suffix == ".xml" else [path]:
        if is_object(file) and folder.absolute() != session_folder():
            target = folder / file.relative_to(session_folder())
            make_folder(target.parent)
            with replace_atomically(target) as temporary:
                shutil.copyfile(file, temporary)


# ---- Objects as files ----


def as_file(value: object, name: str) -> Path:
    """Return the file of an argument; an object in memory is written to the folder of this process.

    Parameters
    ----------
    value : object
        A path, an environment (`nerg_mi.api.scene.AnyEnvironment`), a field, `Rays`, areas, changes, an alignment, or
        what `bake` has returned.
    name : str
        Name of the argument, for messages and to tell what a dict or an array contains.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    NergError
        The file does not exist, or ``value`` is something else.
    """
    if isinstance(value, (str, os.PathLike)) or getattr(value, "path", None) is not None:
        return resolve_file(value, name)
    if isinstance(value, Rays):
        return _store("rays", ".npz", value.save)
    if isinstance(value, (TrainedField, RadianceField)):
        field = value if isinstance(value, TrainedField) else TrainedField(value)
        return _store("field" if field.kind == "radiance" else "gaze", ".safetensors", field.save)
    if name in _AREA_NAMES and isinstance(value, Mapping):
        return _store("areas", ".json", lambda path: _write_areas(path, value))
    if name in _JSON_NAMES and isinstance(value, Mapping):
        return _store(name, ".json", lambda path: write_text(path, json.dumps(value, default=_to_json)))
    matrix: Any = getattr(value, "matrix", value)
    if name in _ALIGNMENT_NAMES and isinstance(matrix, (Sequence, np.ndarray)):
        rows = check_rigid_transforms(matrix, f'"{name}"', may_scale=True, shape=(4, 4)).tolist()
        return _store("align", ".json", lambda path: write_text(path, json.dumps(rows)))
    environment = None if name in _AREA_NAMES else _write_environment(value) or _write_baked(value)
    if environment is None:
        kind = _KINDS.get(name, "a file")
        raise NergError(f'"{name}" must be {kind}, given as a string or a path, got {type(value).__name__}')
    return environment


def as_scene_file(value: object, name: str) -> Path:
    """Return the file of an argument as `as_file` does, but a scene with the mesh in place of a mesh file."""
    path = as_file(value, name)
    if detect_kind(path) != "mesh":
        return path
    activate_mitsuba()
    return _store_shapes(path)


_AREA_NAMES, _JSON_NAMES = ("areas", "aois", "zones"), ("what_if",)
_ALIGNMENT_NAMES = ("align", "align_views", "init")
_KINDS: dict[str, str] = {
    **dict.fromkeys(("environment", "field", "scene", "geometry", "surface"), "an environment in memory or a file"),
    **dict.fromkeys(_AREA_NAMES, "a dict of areas by name or a file"),
    "inputs": "environments, gaze fields and rays (of a data frame by Rays.from_dataframe), in memory or as files",
    "rays": "Rays (of a data frame by Rays.from_dataframe) or a file",
}


def _write_environment(value: object) -> Path | None:
    """Write an environment in memory, and return its file; None if ``value`` is something else."""
    if isinstance(value, Splats):
        return _store("environment", ".ply", lambda path: write_ply_splats(path, value))
    if is_trimesh(value):
        meshes = from_trimesh(value, "environment")  # pyright: ignore[reportArgumentType] which is_trimesh has checked
        if len(meshes) == 1:
            (mesh,) = meshes.values()
            return _store("environment", ".ply", lambda path: write_mesh(path, mesh))
    elif not isinstance(value, (Scene, DensityGrid, Mapping)) and not _is_mitsuba(value):
        return None
    activate_mitsuba()
    if isinstance(value, Scene):
        return _store("environment", ".xml", value.save)
    if isinstance(value, DensityGrid):
        return _store("environment", ".xml", make_scene(value).save)
    if isinstance(value, Mapping) and value.get("type") == "scene" and has_nerg(value):
        return _store("environment", ".xml", Scene.coerce(value).save)
    return _store_shapes(value)


def _write_baked(value: object) -> Path | None:
    """Write a surface with attention that `bake` has returned; None if ``value`` is something else."""
    from nerg_mi.workflows.bake import Bake
    from nerg_mi.workflows.bake_splats import SplatBake

    if isinstance(value, SplatBake):
        return _write_environment(value.splats)
    return _store("surface", ".ply", value.save) if isinstance(value, Bake) else None


def _store_shapes(shapes: object) -> Path:
    """Write shapes as a scene file without an integrator."""
    import mitsuba as mi

    children = to_scene_children(shapes, "environment")
    lights = [name for name, child in children.items() if isinstance(child, mi.Emitter)]
    if lights:
        WarningReporter().warn(
            f"{len(lights)} lights of a Mitsuba scene are left out, since objects of Mitsuba cannot be written to a "
            "file; pass the dict or the file of the scene to keep them"
        )
    content = {"type": "scene", **{name: child for name, child in children.items() if name not in lights}}
    return _store("environment", ".xml", lambda path: write_content(path, content, "Shapes of an environment."))


def _is_mitsuba(value: object) -> bool:
    import mitsuba as mi

    return mi.variant() is not None and isinstance(value, mi.Object)


def _to_json(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise NergError(f"a value of {type(value).__name__} cannot be written as JSON; use numbers, texts, lists and dicts")


def _write_areas(path: Path, areas: Mapping[str, Any]) -> None:
    """Write areas by name: boxes (two corners), meshes of trimesh, mesh files, and dicts as in a file of areas."""
    entries = []
    for k, (name, area) in enumerate(areas.items()):
        if is_trimesh(area):
            meshes = from_trimesh(area, str(name))
            if len(meshes) > 1:
                raise NergError(
                    f'the area "{name}" is a trimesh.Scene of {len(meshes)} meshes; pass one trimesh.Trimesh'
                )
            file = path.with_name(f"{path.stem}.{k}.ply")
            write_mesh(file, next(iter(meshes.values())))
            entries.append({"name": str(name), "mesh": file.name})
        elif isinstance(area, Mapping):
            entries.append({"name": str(name), **area})
        elif np.shape(area) == (2, 3):
            lower, upper = np.sort(
                to_numbers(area, f'the area "{name}"'), axis=0
            ).tolist()  # opposite corners in any order
            entries.append({"name": str(name), "min": lower, "max": upper})
        else:
            raise NergError(
                f'the area "{name}" must be a box (two corners of three numbers), a trimesh.Trimesh or a dict as in a '
                f"file of areas, got {type(area).__name__}"
            )
    write_text(path, json.dumps(json.loads(format_areas(())) | {"regions": entries}, default=_to_json))


# ---- Options of workflows ----


Options = TypeVar("Options", bound="DataclassInstance")

_OUTPUT_OPTIONS = {
    *("pictures", "json_file", "store", "output", "train_output", "test_output", "align_output", "color")
}
"""Options that name a file or folder to write."""


def build_options(kind: type[Options], function: str, options: Options | None, overrides: dict[str, Any]) -> Options:
    """Build the options of a workflow for the active variant.

    Parameters
    ----------
    kind : type
        Dataclass of the options.
    function : str
        Name of the API function, for messages.
    options : dataclass instance or None
        Base options; None uses the defaults.
    overrides : dict
        Values by option name. Where an option names a file, an object in memory can be given (`as_file`). An
        environment in memory, as ``geometry``, ``field`` or ``scene``, becomes that of ``field`` and ``scene`` which
        fits its content.

    Returns
    -------
    dataclass instance
        The options.

    Raises
    ------
    NergError
        An option or a file does not exist.
    """
    types = {f.name: str(f.type) for f in fields(kind)}
    if "mode" in overrides:
        raise NergError(f"{function} uses the active variant; call mi.set_variant({overrides['mode']!r}) before it")
    if {"field", "scene"} <= types.keys():
        for name in ("geometry", "field", "scene"):
            overrides = _choose_geometry(overrides, name)
    check_names(function, overrides, [name for name in types if name != "mode"])
    if "mode" in types:
        overrides = {**overrides, "mode": activate_mitsuba().variant()}
    updated = kind(**overrides) if options is None else replace(options, **overrides)
    if isinstance(updated, GeometryOptions) and (updated.field, updated.scene, updated.geometry) == (None, None, None):
        raise NergError(
            f"{function} needs the environment that the participants saw, in memory or as a file, with geometry=; or "
            'geometry="hits" for that of the hit points, or geometry="none"'
        )
    files = {k: getattr(updated, k) for k, type_name in types.items() if "Path" in type_name}
    return replace(
        updated, **{k: Path(v) if k in _OUTPUT_OPTIONS else as_file(v, k) for k, v in files.items() if v is not None}
    )


def _choose_geometry(overrides: dict[str, Any], name: str) -> dict[str, Any]:
    """Replace the option ``name`` by ``field`` or ``scene``, by its content, if it is an environment.

    Files are replaced as ``geometry`` only, since a workflow checks those of ``field`` and ``scene``.
    """
    value = overrides.get(name)
    if isinstance(value, (str, os.PathLike)):
        is_environment = name == "geometry" and str(value) not in ("hits", "none")
        if not is_environment or Path(value).suffix.lower() == ".vol":
            return overrides
    elif value is None:
        return overrides
    path = as_file(value, name)
    kind = detect_kind(path)
    if kind not in ("field", "mesh", "scene"):
        choices = 'an environment, "hits" or "none"' if name == "geometry" else "an environment"
        content = f'"{value}", which contains {kind}' if isinstance(value, (str, os.PathLike)) else type(value).__name__
        raise NergError(f"{name} must be {choices}, got {content}")
    others = {key: option for key, option in overrides.items() if key != name}
    target = "field" if kind == "field" else "scene"
    if others.get(target) is not None:
        raise NergError(f"only one environment can be given, not both {name} and {target}; leave one of them out")
    return {**others, target: path}


def resolve_rays(value: object) -> Rays | Path:
    """Return `Rays` unchanged, or the path of their file. Raises `NergError` for anything else."""
    if isinstance(value, Rays):
        return value
    if not isinstance(value, (str, os.PathLike)):
        raise NergError(
            f"rays must be a Rays object or a file of one, got {type(value).__name__}; make one of a table in memory "
            "with Rays.from_dataframe or Rays.from_arrays, and of other files with import_rays"
        )
    return resolve_file(value, "rays")
