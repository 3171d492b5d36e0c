"""What files contain: environments, gaze fields and rays."""

from __future__ import annotations

from pathlib import Path

from nerg_mi.errors import MissingFile, NergError, sanitize
from nerg_mi.files.safe_read import check_regular_file
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.formats.meshes import READERS
from nerg_mi.formats.splats import is_splat_file, refuse_unsupported_splats
from nerg_mi.tracking.dataset import is_dataset

KINDS = {".npz": "rays", ".parquet": "rays", **dict.fromkeys(READERS, "mesh"), ".vol": "hits", ".xml": "scene"}
"""Kinds of files by suffix, except checkpoints."""

ROLES = {"gaze": "gaze", "rays": "rays"}
"""Roles of the files that are no environments, by kind."""


def detect_kind(path: Path) -> str:
    """Return what ``path`` contains: "field", "splats", "gaze", or a value of `KINDS`.

    Raises `NergError` for other files.
    """
    if not path.exists():
        raise MissingFile(f'there is no file "{path}"; correct its name')
    if is_dataset(path):
        return "rays"
    check_regular_file(path)
    suffix = path.suffix.lower()
    if suffix == ".safetensors":
        kind = read_metadata(path).get("kind")
        if kind not in ("radiance", "gaze"):
            raise NergError(
                f'"{path}" contains a {sanitize(kind, 40)} field; a scene can show radiance and gaze fields'
            )
        return {"radiance": "field", "gaze": "gaze"}[kind]
    if is_splat_file(path):
        return "splats"
    refuse_unsupported_splats(path)
    if suffix in (".pth", ".pt"):
        raise NergError(f'"{path}" is a PyTorch checkpoint; convert it with "nerg import"')
    if suffix not in KINDS:
        raise NergError(
            f'"{path}" cannot be shown in a scene; give checkpoints (.safetensors), splats, rays, datasets of '
            f"rays, meshes or scenes ({', '.join(KINDS)}); convert meshes of other formats, with Blender or trimesh"
        )
    return KINDS[suffix]
