"""Files of Gaussian splats: 3DGS PLY, .splat, SPZ and glTF, and splats made of a radiance field."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.fields.splats import (
    Splats,
    splats_from_raw_parameters,
    harmonics_from_colors,
    concatenate_splats,
    logits_from_opacities,
    opacities_from_logits,
    matrices_to_quaternions,
    scales_from_logs,
)
from nerg_mi.files.safe_read import MAX_JSON_BYTES, map_bytes, open_file, open_gzip, translate_read_errors
from nerg_mi.maths.coordinates import check_near_origin
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import HARMONIC_DEGREES
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import trace_depth

from .gltf import MAX_GLTF_BYTES, GLTF_MAGIC, read_accessor, iter_instances, read_glb_chunks
from .ply import PLY_MAGIC, parse_ply, write_columns
from .surfaces import extract_points

# ---- Antimatter ----
#
# Gaussian splats as ``.splat`` (antimatter15): 32 bytes each, colours that are the same from everywhere.

MAX_SPLAT_BYTES = 4 << 30  # maximum bytes of a file
_ROW = np.dtype([("center", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])
_SPLAT_BLOCK = 1 << 14  # Gaussians that are converted at once


def read_splat(path: str | os.PathLike) -> Splats:
    """The Gaussian splats in ``path``, in some 2.4 times the memory of the file; `NergError` for what cannot be such a
    file."""
    with open_file(path, "splat file", "export it again", MAX_SPLAT_BYTES) as file:
        size = os.fstat(file.fileno()).st_size
        count, rest = divmod(size, _ROW.itemsize)
        if rest:
            raise ValueError(f"its {size:,} bytes are no multiple of {_ROW.itemsize}")
        centers, scales, harmonics = (np.empty((count, *shape), np.float32) for shape in ((3,), (3,), (1, 3)))
        rotations, opacities = np.empty((count, 4), np.float32), np.empty(count, np.float32)
        for at in range(0, count, _SPLAT_BLOCK):
            block = slice(at, min(at + _SPLAT_BLOCK, count))
            rows = np.frombuffer(file.read(_ROW.itemsize * (block.stop - at)), _ROW)
            centers[block], scales[block] = rows["center"], rows["scale"]
            rotations[block] = (rows["rotation"].astype(np.float64) - 128) / 128
            colors = rows["color"] / 255.0
            opacities[block], harmonics[block] = colors[:, 3], harmonics_from_colors(colors[:, :3])
        return Splats(centers, scales, rotations, opacities, harmonics)


# ---- Khronos ----
#
# Gaussian splats as binary glTF with the extension KHR_gaussian_splatting, in glTF's frame: y up.

EXTENSION = "KHR_gaussian_splatting"
_POINTS = 0
_COLOR_SPACES = {"srgb_rec709_display": "srgb", "lin_rec709_display": "linear"}
_SLACK = 1e-4


def has_gltf_splats(path: str | os.PathLike) -> bool:
    """Whether the document of the .glb file ``path``, which may be a mesh, names `EXTENSION`."""
    with open_file(path, "splat file") as file:
        head = file.read(20)
        length = int.from_bytes(head[12:16], "little")
        return EXTENSION.encode() in file.read(min(length, MAX_JSON_BYTES))


def read_gltf_splats(path: str | os.PathLike) -> Splats:
    """All Gaussian splats of the scene in the .glb file ``path``, its nodes applied.

    Raises `NergError` for a damaged file, for one without splats or with compressed ones, for nodes that scale
    unevenly, for splats that are not all of one degree of harmonics, and for values beyond what the extension says.
    """
    raw = map_bytes(path, "splat file", MAX_GLTF_BYTES, GLTF_MAGIC, "export it again")
    with translate_read_errors(path, "splat file", "export it again", extra_errors=(TypeError, AttributeError)):
        document, data = read_glb_chunks(raw, path, "splat file")
        found = []
        for primitive, matrix in iter_instances(document, _POINTS):
            about = primitive.get("extensions", {}).get(EXTENSION)
            if about is None:
                continue
            if any("compression" in name for name in about.get("extensions", {})):
                raise ValueError("its splats are compressed; export it without compression")
            try:
                where = Similarity(matrix)
            except NergError as error:
                raise ValueError("its nodes do more than to turn, to move and a uniform scale") from error
            found.append(_splats(document, data, primitive["attributes"], about).transform(where))
        if not found:
            raise ValueError(f"its scene has no splats of {EXTENSION}")
        return concatenate_splats(found)


def _splats(
    document: dict[str, Any], data: bytes | memoryview, attributes: dict[str, Any], extension: dict[str, Any]
) -> Splats:
    take = lambda name, shape: read_accessor(document, data, attributes[name], shape)
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
        raise ValueError(f'its kernel is "{sanitize(kernel, 40)}", and "ellipse" is read')
    if color_space not in _COLOR_SPACES:
        raise ValueError(f'its colour space is "{sanitize(color_space, 40)}", and {" and ".join(_COLOR_SPACES)} are read')
    _check_range("opacities", opacities, 0, 1, "logits")
    _check_range("scales", scales, 0, np.inf, "logarithms")
    _check_range("rotations' lengths", np.linalg.norm(xyzw, axis=1), 0.9, 1.1, "quaternions that are not normalised")
    used = {"POSITION", *(f"{EXTENSION}:{n}" for n in ("ROTATION", "SCALE", "OPACITY"))}
    unused = [n for n in attributes if n not in used and not re.fullmatch(rf"{EXTENSION}:SH_DEGREE_[0-3]_COEF_\d", n)]
    notes = (f"attributes that are not used: {sanitize(', '.join(unused))}",) if unused else ()
    shapes = take("POSITION", "VEC3"), scales, xyzw[:, [3, 0, 1, 2]], opacities
    return Splats(*shapes, np.stack(harmonics, axis=1), color_space=_COLOR_SPACES[color_space], notes=notes)


def _check_range(name: str, values: np.ndarray, low: float, high: float, otherwise: str) -> None:
    if not ((values >= low - _SLACK) & (values <= high + _SLACK)).all():
        raise ValueError(
            f"its {name} lie in {values.min():.4g} .. {values.max():.4g}, and {EXTENSION} has them in {low:g} .. "
            f"{high:g}; its writer has stored {otherwise}"
        )


# ---- Gaussian splats as PLY, as 3DGS trainings write them (Kerbl et al ----
#
# 2023): logarithms of scales, logits of opacities.
#
# Columns are found by name, in any order; normals are left out, other columns kept. Files of 2DGS lack ``scale_2``:
# their Gaussians become a thousandth as thick as they are wide. Of Mip-Splatting (Yu et al. 2024) the 3D filter is
# applied. Opacities and lengths where logits and logarithms belong are recognised by values that these cannot have.

MAX_PLY_BYTES = 8 << 30  # maximum bytes of a file
DETECTION_BYTES = 64 << 10  # so many of them tell splats from meshes
_CENTER, _SCALE, _ROTATION = ("x", "y", "z"), ("scale_0", "scale_1", "scale_2"), tuple(f"rot_{i}" for i in range(4))
_BASE, _NORMAL = tuple(f"f_dc_{i}" for i in range(3)), ("nx", "ny", "nz")
_FILTER = "filter_3D"
_THIN = 1e-3

# From so many Gaussians on the range of a column is evidence.
_SOME = 64
_NEIGHBOR, _SAMPLE = 4, 2000
# No training has such a logit: at half of it float32 is 1.
_OPAQUE = 32


def has_ply_splats(path: str | os.PathLike) -> bool:
    """Whether the header of the PLY file ``path`` names what Gaussian splats have: their colours, or their shape."""
    with open_file(path, "PLY file") as file:
        names = re.findall(rb"^property [a-z0-9]+ (\w+)\s*$", file.read(DETECTION_BYTES), re.MULTILINE)
        return b"f_dc_0" in names or {b"opacity", b"scale_0", b"rot_0"} <= set(names)


def read_ply_splats(path: str | os.PathLike) -> Splats:
    """The Gaussian splats in the PLY file ``path``; `NergError` for another kind of file, and for a damaged one."""
    remedy = "export it again as a 3DGS .ply"
    raw = map_bytes(path, "splat file", MAX_PLY_BYTES, PLY_MAGIC, remedy)
    with translate_read_errors(path, "splat file", remedy):
        tables = parse_ply(np.frombuffer(raw, np.uint8)).tables
        first = next(iter(tables), "")
        if first != "vertex":
            raise ValueError(f'other things ("{first[:40]}") stand before its vertices')
        if tables["vertex"].lists:
            raise ValueError("its vertices have properties that are no numbers")
        columns = {name: values() for name, values in tables["vertex"].columns.items()}
        missing = [name for name in (*_CENTER, "opacity", *_SCALE[:2], *_ROTATION, *_BASE) if name not in columns]
        if "packed_position" in columns:
            raise ValueError("it is a compressed .ply; convert it by: npx @playcanvas/splat-transform in.ply out.ply")
        if missing:
            raise ValueError(f'it lacks the column "{missing[0]}", which Gaussian splats have')
        rest = sorted((int(m[1]), name) for name in columns if (m := re.fullmatch(r"f_rest_(\d{1,3})", name)))
        count = 1 + len(rest) // 3
        if len(rest) % 3 or count not in HARMONIC_DEGREES or [i for i, _ in rest] != list(range(len(rest))):
            raise ValueError(f"its {len(rest)} columns f_rest_* are those of no degree from 0 to 3")
        take = lambda names: np.stack([columns.pop(name) for name in names if name in columns], axis=-1)
        base = take(_BASE)[:, None]
        # Stored channel by channel.
        more = take([n for _, n in rest]).reshape(len(base), 3, count - 1).swapaxes(1, 2) if rest else base[:, :0]
        centers, rotations = take(_CENTER), take(_ROTATION)
        scales, opacities, guesses = _activated(centers, take(_SCALE), columns.pop("opacity"))
        if scales.shape[1] == 2:
            scales = np.column_stack([scales, _THIN * scales.min(axis=1)])
        if _FILTER in columns:
            scales, opacities = _filtered(scales, opacities, columns.pop(_FILTER))
        extra = {name: column for name, column in columns.items() if name not in _NORMAL}
        unused = [*extra, *(f"those of {name}" for name in list(tables)[1:])]
        notes = (f"columns that are not used: {sanitize(', '.join(unused))}",) if unused else ()
        harmonics = np.concatenate([base, more], axis=1)
        return Splats(centers, scales, rotations, opacities, harmonics, extra, assumptions=guesses, notes=notes)


def _activated(
    centers: np.ndarray, scales: np.ndarray, opacities: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Scales and opacities of what the columns hold, and sentences where that is not what trainings write."""
    guesses = []
    if _are_lengths(centers, scales):
        guesses.append("its scales are taken as lengths: as logarithms they would far exceed the Gaussians' distances")
    else:
        scales = scales_from_logs(scales)
    # As logits, all opacities of a training would lie between 0.5 and 0.73.
    if len(opacities) >= _SOME and 0 <= opacities.min() < opacities.max() <= 1:
        guesses.append("its opacities are taken as they are, since all lie in 0..1: logits reach further")
    elif len(opacities) >= _SOME and opacities.min() >= 0 and _OPAQUE < opacities.max() <= 255:
        guesses.append("its opacities are taken for 255ths: as logits they would all be opaque or half so")
        opacities = opacities / np.float32(255)
    else:
        opacities = opacities_from_logits(opacities)
    return scales, opacities, tuple(guesses)


def _are_lengths(centers: np.ndarray, scales: np.ndarray) -> bool:
    """Whether ``scales`` (N, 2 or 3) fit the distances of the ``centers`` as they are, and not at all as logarithms."""
    if len(centers) < _SOME or not np.isfinite(centers).all() or not (scales >= 0).all():
        return False
    from scipy.spatial import KDTree

    some = centers[:: max(len(centers) // _SAMPLE, 1)]
    distance = float(np.median(KDTree(centers).query(some, k=_NEIGHBOR + 1)[0][:, -1]))
    usual = np.median(scales.max(axis=1))
    # Logarithms that all lie in 0..1 are suspicious by themselves: no training leaves all sizes within a factor of 2.7.
    overlap = 2 if scales.max() <= 1 else 16
    return bool(distance > 0 and usual < 4 * distance and overlap * distance < scales_from_logs(usual))


def _filtered(scales: np.ndarray, opacities: np.ndarray, deviation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gaussians convolved with one of the standard ``deviation`` (N,), of the same mass along a ray: what a training of
    Mip-Splatting renders."""
    squares = np.asarray(scales, np.float64) ** 2
    widened = squares + np.asarray(deviation, np.float64)[:, None] ** 2
    return np.sqrt(widened), opacities * np.sqrt(np.prod(squares / widened, axis=1))


def write_ply_splats(path: str | os.PathLike, splats: Splats, comments: tuple[str, ...] = ()) -> None:
    """Write ``splats`` as viewers and Mitsuba read them: float32, normals of 0, further columns at the end (Mitsuba
    reads no file with such)."""
    columns = {name: splats.centers[:, i] for i, name in enumerate(_CENTER)}
    columns |= {name: np.zeros(len(splats), np.float32) for name in _NORMAL}
    columns |= {name: splats.harmonics[:, 0, i] for i, name in enumerate(_BASE)}
    rest = splats.harmonics[:, 1:].swapaxes(1, 2).reshape(len(splats), -1)
    columns |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    columns["opacity"] = logits_from_opacities(splats.opacities)
    logs = np.log(splats.scales.astype(np.float64))
    columns |= {name: logs[:, i] for i, name in enumerate(_SCALE)}
    columns |= {name: splats.rotations[:, i] for i, name in enumerate(_ROTATION)}
    write_columns(path, columns | dict(splats.extra), comments=comments)


# ---- Spz ----
#
# Gaussian splats as SPZ (Niantic), versions 1 to 3: columns of few bytes each, compressed by gzip.
#
# Axes are the file's: x right, y up, z back, unless its writer was told otherwise.

MAX_SPZ_GAUSSIANS = 50_000_000  # a file may hold so many Gaussians
_MAGIC = 0x5053474E
_COLOR_SCALE = 0.15


def read_spz(path: str | os.PathLike) -> Splats:
    """The Gaussian splats in ``path``; `NergError` for a damaged file and for a later version."""
    with open_file(path, "splat file") as file:
        start = file.read(4)
    convert = f'convert it by: npx @playcanvas/splat-transform "{Path(path).name}" out.ply'
    with translate_read_errors(path, "splat file", convert):
        if start == struct.pack("<I", _MAGIC):
            raise ValueError("it is SPZ of version 4 or later, and versions 1 to 3 are read")
        with open_gzip(path, "splat file") as stream:
            head = stream.read(16)
            magic, version, count, degree, fraction = struct.unpack_from("<IIIBB", head)
            if magic != _MAGIC or not 1 <= version <= 3 or degree > 3 or fraction > 23 or len(head) < 16:
                raise ValueError("it is no SPZ of version 1 to 3")
            if count > MAX_SPZ_GAUSSIANS:
                raise ValueError(f"it announces {count:,} Gaussians, more than the {MAX_SPZ_GAUSSIANS:,} that are read")
            more = (degree + 1) ** 2 - 1
            widths = (6 if version == 1 else 9, 1, 3, 3, 4 if version == 3 else 3, 3 * more)
            data = stream.read(count * sum(widths))
        if len(data) < count * sum(widths):
            raise EOFError
        columns, at = [], 0
        for width in widths:
            columns.append(np.frombuffer(data, np.uint8, count * width, at).reshape(count, width))
            at += count * width
        center, alpha, color, scale, rotation, rest = columns
        centers = center.view("<f2").astype(np.float64) if version == 1 else _fixed(center) / (1 << fraction)
        base = (color / 255.0 - 0.5) / _COLOR_SCALE
        shaped = (rest.reshape(count, more, 3) - 128.0) / 128
        harmonics = np.concatenate([base[:, None], shaped], axis=1)
        rotations = _smallest_three(rotation) if version == 3 else _vector_part(rotation)
        return splats_from_raw_parameters(centers, scale / 16.0 - 10, rotations, logits_from_opacities(alpha[:, 0] / 255.0), harmonics)


def _fixed(data: np.ndarray) -> np.ndarray:
    """Whole numbers (N, 3) of 24 bits with a sign, of their bytes (N, 9)."""
    b = data.reshape(-1, 3, 3).astype(np.int64)
    value = b[..., 0] | b[..., 1] << 8 | b[..., 2] << 16
    return value - ((value >> 23) << 24)


def _vector_part(data: np.ndarray) -> np.ndarray:
    xyz = data / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz * xyz).sum(axis=1, keepdims=True)))
    return np.concatenate([w, xyz], axis=1)


def _smallest_three(data: np.ndarray) -> np.ndarray:
    """Quaternions, w first, of 32 bits each: which of x, y, z, w is the largest, and the others with 10 bits."""
    bits = np.ascontiguousarray(data).view("<u4")[:, 0].astype(np.int64)
    largest = bits >> 30
    xyzw = np.zeros((len(bits), 4))
    for i in (3, 2, 1, 0):
        here = largest != i
        value = np.sqrt(0.5) * (bits & 511) / 511
        xyzw[:, i] = np.where(here, np.where(bits >> 9 & 1, -value, value), 0)
        bits = np.where(here, bits >> 10, bits)
    rest = np.sqrt(np.maximum(0, 1 - (xyzw * xyzw).sum(axis=1)))
    xyzw[np.arange(len(xyzw)), largest] = rest
    return xyzw[:, [3, 0, 1, 2]]


# ---- Gaussian splats of a file, whichever of the formats it is in ----

READERS: dict[str, Callable[[str | os.PathLike], Splats]] = {
    ".ply": read_ply_splats,
    ".splat": read_splat,
    ".spz": read_spz,
    ".glb": read_gltf_splats,
}
"""Reader by the ending of a file's name."""

_OTHERS = (".sog", ".ksplat", ".lcc")
_AMONG_OTHERS = (*_OTHERS, ".gltf", ".json")


def is_splat_file(path: str | os.PathLike) -> bool:
    """Whether ``path`` is a file of Gaussian splats, by its name; a ``.ply`` or ``.glb``, which may be a mesh, by its
    header."""
    suffix = Path(path).suffix.lower()
    tell = {".ply": has_ply_splats, ".glb": has_gltf_splats}.get(suffix)
    return suffix in READERS if tell is None else tell(path)


def choose_plugin(path: str | os.PathLike) -> str:
    """The volume plugin that shows the file of a place: that of splats, or that of radiance fields."""
    return "splats" if is_splat_file(path) else "nerf"


def refuse_unsupported_splats(path: str | os.PathLike) -> None:
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


# ---- Surfels ----
#
# Gaussian splats of a radiance field: flat ones on the surface that rays meet.
#
# No training: where a lattice crosses the field's surface a Gaussian is laid along it, as wide as its neighbours are
# far, in the colour that the field has there from in front. Depths are then those of the field to a fraction of a cell.

SURFEL_WIDTH = 0.7
"""Standard deviation along the surface, in distances to the nearest neighbours: one more widely smears colours, one
less leaves gaps."""

_SURFELS_THIN, _OPACITY = 0.1, 0.9
_NEIGHBORS, _NEAREST = 12, 4


def make_splats(
    field: RadianceField, resolution: int = 256, threshold: float | None = None
) -> tuple[Splats, dict[str, float]]:
    """Gaussians in the field's own frame, and what was done: ``cell`` of the lattice and ``moved``, the median distance
    by which Gaussians were moved to the depth that rays find, both in the field's units.

    ``resolution``: cells along the longest edge; ``threshold``: density at which the surface lies (default: that of
    ``points``). Raises `NergError` where there is none.
    """
    surface = extract_points(field, resolution, threshold)
    cell = surface.report["cell"]
    p, normals = surface.vertices, surface.normals
    lost = np.linalg.norm(normals, axis=1) < 0.5
    normals[lost] = (0, 0, 1)
    spacing, normals = _laid_flat(p, normals)
    # A ray against the normal, from a cell in front: it meets the surface at about that distance.
    depth, opacity = trace_depth(FieldMedium(field), (p + cell * normals), -normals)
    met = (opacity >= 0.5) & (depth < 2 * cell)
    shift = np.where(met, cell - depth, 0)
    p = p + shift[:, None] * normals
    wide = SURFEL_WIDTH * np.clip(spacing, 0.25 * cell, 2 * cell)
    scales = np.stack([wide, wide, _SURFELS_THIN * wide / SURFEL_WIDTH], axis=1)
    opacities = np.full(len(p), _OPACITY)
    splats = Splats(p, scales, matrices_to_quaternions(_frames(normals)), opacities, harmonics_from_colors(surface.colors))
    return splats, {"cell": float(cell), "moved": float(np.median(np.abs(shift)))}


def _laid_flat(p: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each point's nearest neighbours, and the mean normals of all around it that face its way."""
    from scipy.spatial import KDTree

    count = min(_NEIGHBORS + 1, len(p))
    apart, near = (v.reshape(len(p), -1) for v in KDTree(p).query(p, k=count))
    for _ in range(2):
        alike = np.clip(np.einsum("nkc,nc->nk", normals[near], normals), 0, 1) ** 4
        total = np.einsum("nk,nkc->nc", alike, normals[near])
        normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    if count == 1:
        return np.full(len(p), np.inf), normals
    return np.median(apart[:, 1 : _NEAREST + 1], axis=1), normals


def _frames(normals: np.ndarray) -> np.ndarray:
    """Rotations (N, 3, 3) whose third axis is the normal."""
    aside = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(normals, aside)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], axis=2)
