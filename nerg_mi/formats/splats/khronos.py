"""Gaussian splats as binary glTF with the extension KHR_gaussian_splatting, in glTF's frame: y up."""

from __future__ import annotations

import os
import re
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, plain
from nerg_mi.fields.splats import Splats, joined
from nerg_mi.files.safe_read import JSON_BYTES, map_bytes, open_file, reading
from nerg_mi.formats.gltf import GLTF_BYTES, GLTF_MAGIC, accessor_values, instances, read_parts
from nerg_mi.maths.geometry import Similarity

EXTENSION = "KHR_gaussian_splatting"

_POINTS = 0
_COLOR_SPACES = {"srgb_rec709_display": "srgb", "lin_rec709_display": "linear"}
_SLACK = 1e-4


def has_gltf_splats(path: str | os.PathLike) -> bool:
    """Whether the document of the .glb file ``path``, which may be a mesh, names `EXTENSION`."""
    with open_file(path, "splat file") as file:
        head = file.read(20)
        length = int.from_bytes(head[12:16], "little")
        return EXTENSION.encode() in file.read(min(length, JSON_BYTES))


def read_gltf_splats(path: str | os.PathLike) -> Splats:
    """All Gaussian splats of the scene in the .glb file ``path``, its nodes applied.

    Raises `NergError` for a damaged file, for one without splats or with compressed ones, for nodes that scale
    unevenly, for splats that are not all of one degree of harmonics, and for values beyond what the extension says.
    """
    raw = map_bytes(path, "splat file", GLTF_BYTES, GLTF_MAGIC, "export it again")
    with reading(path, "splat file", "export it again", also=(TypeError, AttributeError)):
        document, data = read_parts(raw, path, "splat file")
        found = []
        for primitive, matrix in instances(document, _POINTS):
            about = primitive.get("extensions", {}).get(EXTENSION)
            if about is None:
                continue
            if any("compression" in name for name in about.get("extensions", {})):
                raise ValueError("its splats are compressed; export it without compression")
            try:
                where = Similarity(matrix)
            except NergError as error:
                raise ValueError("its nodes do more than to turn, to move and a uniform scale") from error
            found.append(_splats(document, data, primitive["attributes"], about).placed(where))
        if not found:
            raise ValueError(f"its scene has no splats of {EXTENSION}")
        return joined(found)


def _splats(
    document: dict[str, Any], data: bytes | memoryview, attributes: dict[str, Any], extension: dict[str, Any]
) -> Splats:
    take = lambda name, shape: accessor_values(document, data, attributes[name], shape)
    own = lambda name, shape: take(f"{EXTENSION}:{name}", shape)
    harmonics = []
    for degree in range(4):
        names = [f"SH_DEGREE_{degree}_COEF_{n}" for n in range(2 * degree + 1)]
        if f"{EXTENSION}:{names[0]}" not in attributes:
            break
        harmonics += [own(name, "VEC3") for name in names]
    if not harmonics:
        raise ValueError("its splats have no colour")
    xyzw, scales, opacities = own("ROTATION", "VEC4"), own("SCALE", "VEC3"), own("OPACITY", "SCALAR")[:, 0]
    kernel, color_space = extension.get("kernel", "ellipse"), extension.get("colorSpace", "srgb_rec709_display")
    if kernel != "ellipse":
        raise ValueError(f'its kernel is "{plain(kernel, 40)}", and "ellipse" is read')
    if color_space not in _COLOR_SPACES:
        raise ValueError(f'its colour space is "{plain(color_space, 40)}", and {" and ".join(_COLOR_SPACES)} are read')
    _check_range("opacities", opacities, 0, 1, "logits")
    _check_range("scales", scales, 0, np.inf, "logarithms")
    _check_range("rotations' lengths", np.linalg.norm(xyzw, axis=1), 0.9, 1.1, "quaternions that are not normalised")
    used = {"POSITION", *(f"{EXTENSION}:{n}" for n in ("ROTATION", "SCALE", "OPACITY"))}
    unused = [n for n in attributes if n not in used and not re.fullmatch(rf"{EXTENSION}:SH_DEGREE_[0-3]_COEF_\d", n)]
    notes = (f"attributes that are not used: {plain(', '.join(unused))}",) if unused else ()
    shapes = take("POSITION", "VEC3"), scales, xyzw[:, [3, 0, 1, 2]], opacities
    return Splats(*shapes, np.stack(harmonics, axis=1), color_space=_COLOR_SPACES[color_space], notes=notes)


def _check_range(name: str, values: np.ndarray, low: float, high: float, otherwise: str) -> None:
    if not ((values >= low - _SLACK) & (values <= high + _SLACK)).all():
        raise ValueError(
            f"its {name} lie in {values.min():.4g} .. {values.max():.4g}, and {EXTENSION} has them in {low:g} .. "
            f"{high:g}; its writer has stored {otherwise}"
        )
