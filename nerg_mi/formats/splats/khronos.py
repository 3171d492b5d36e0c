"""Gaussian splats as binary glTF with the extension KHR_gaussian_splatting, in glTF's frame: y up."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from nerg_mi.field.splats import Splats, joined
from nerg_mi.files.bounded import JSON_BYTES, read_bytes, reading
from nerg_mi.formats.gltf import BYTES, accessor_values, instances, read_parts
from nerg_mi.maths.similarity import Similarity

EXTENSION = "KHR_gaussian_splatting"

_POINTS = 0


def has_gltf_splats(path: str | os.PathLike) -> bool:
    """Whether the document of the .glb file ``path``, which may be a mesh, names `EXTENSION`."""
    with reading(path, "splat file"), open(path, "rb") as file:
        head = file.read(20)
        length = int.from_bytes(head[12:16], "little")
        return EXTENSION.encode() in file.read(min(length, JSON_BYTES))


def read_gltf_splats(path: str | os.PathLike) -> Splats:
    """All Gaussian splats of the scene in the .glb file ``path``, its nodes applied.

    Raises `NergError` for a damaged file, for one without splats or with compressed ones, for nodes that scale
    unevenly, and for splats that are not all of one degree of harmonics.
    """
    raw = read_bytes(path, "splat file", BYTES)
    with reading(path, "splat file", "export it again", also=(TypeError, AttributeError)):
        document, data = read_parts(raw, path, "splat file")
        found = []
        for primitive, matrix in instances(document, _POINTS):
            about = primitive.get("extensions", {}).get(EXTENSION)
            if about is None:
                continue
            if any("compression" in name for name in about.get("extensions", {})):
                raise ValueError("its splats are compressed; export it without compression")
            found.append(_splats(document, data, primitive["attributes"]).placed(Similarity(matrix)))
        if not found:
            raise ValueError(f"its scene has no splats of {EXTENSION}")
        return joined(found)


def _splats(document: dict[str, Any], data: bytes, attributes: dict[str, Any]) -> Splats:
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
    xyzw = own("ROTATION", "VEC4")
    return Splats(
        take("POSITION", "VEC3"),
        own("SCALE", "VEC3"),
        xyzw[:, [3, 0, 1, 2]],
        own("OPACITY", "SCALAR")[:, 0],
        np.stack(harmonics, axis=1),
    )
