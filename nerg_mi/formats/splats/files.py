"""Gaussian splats of a file, whichever of the formats it is in."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.splats import Splats
from nerg_mi.maths.coordinates import check_near_origin

from .antimatter import read_splat
from .khronos import has_gltf_splats, read_gltf_splats
from .ply import has_splats, read_ply_splats
from .spz import read_spz

READERS: dict[str, Callable[[str | os.PathLike], Splats]] = {
    ".ply": read_ply_splats,
    ".splat": read_splat,
    ".spz": read_spz,
    ".glb": read_gltf_splats,
}
"""Reader by the ending of a file's name."""

_OTHERS = (".sog", ".ksplat", ".lcc")
_AMONG_OTHERS = (*_OTHERS, ".gltf", ".json")


def is_splats(path: str | os.PathLike) -> bool:
    """Whether ``path`` is a file of Gaussian splats, by its name; a ``.ply`` or ``.glb``, which may be a mesh, by its
    header."""
    suffix = Path(path).suffix.lower()
    tell = {".ply": has_splats, ".glb": has_gltf_splats}.get(suffix)
    return suffix in READERS if tell is None else tell(path)


def plugin_of_field(path: str | os.PathLike) -> str:
    """The volume plugin that shows the file of a place: that of splats, or that of radiance fields."""
    return "splats" if is_splats(path) else "nerf"


def refuse_others(path: str | os.PathLike) -> None:
    """Raise `NergError`, which names the converter, for splats in a format that is not read."""
    if Path(path).suffix.lower() in _OTHERS:
        read_splats(path)


def read_splats(path: str | os.PathLike) -> Splats:
    """The Gaussian splats in ``path``, in the file's own frame and units.

    Raises `NergError` for a file that is missing, damaged, of another format, or larger than is read, and for
    coordinates too far from the origin for single precision.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in READERS:
        known = ", ".join(READERS)
        hint = f'npx @playcanvas/splat-transform "{Path(path).name}" out.ply'
        other = f"; convert it: {hint}" if suffix in _AMONG_OTHERS else ""
        raise NergError(f'"{path}" is no file of Gaussian splats, which are read from {known}{other}')
    # What overflows is not finite, and refused as that.
    with np.errstate(all="ignore"):
        splats = READERS[suffix](path)
    check_near_origin(splats.centers, f'the splat file "{path}"')
    return splats
