"""Files of Gaussian splats (3DGS PLY, .splat, SPZ, SOG and glTF), and splats that are derived from a radiance field.

- ``.ply``: output of 3DGS trainings, columns in any order, binary or text, degrees 0 to 3. Additional columns are
  kept. Files of 2DGS, without ``scale_2``, become thin. ``filter_3D`` of Mip-Splatting is applied.
- ``.splat``: 32 bytes per Gaussian (antimatter15); ``.spz``: versions 1 to 3; ``.sog``: version 2 (SuperSplat)
- ``.glb``: KHR_gaussian_splatting with nodes and colour space; values out of range are refused

Some programs store opacities instead of logits, or lengths instead of their logarithms. From 64 Gaussians on both
are detected and reported: opacities that are all in 0..1, or in 0..255 and beyond 32 (bytes); scales that are all
non-negative and similar to the distances between Gaussians. ``.ksplat``, ``.sog`` of version 1, compressed ``.ply``
and ``.spz`` of version 4 are refused with the command that converts them. Frame and units are those of the file;
``to_world`` rotates and scales an environment, including colours that depend on the direction.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.fields.splats import (
    Splats,
    concatenate_splats,
    harmonics_from_colors,
    logits_from_opacities,
    matrices_to_quaternions,
    opacities_from_logits,
    scales_from_logs,
    splats_from_raw_parameters,
)
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.html import Summary
from nerg_mi.files.safe_read import MAX_JSON_BYTES, map_bytes, open_file, open_gzip, translate_read_errors
from nerg_mi.files.schema import check_json
from nerg_mi.maths.coordinates import check_near_origin
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import HARMONIC_DEGREES
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import trace_depth

from .gltf import GLTF_MAGIC, MAX_GLTF_BYTES, iter_instances, read_accessor, read_glb_chunks
from .ply import PLY_MAGIC, parse_ply, write_columns
from .sog import read_sog
from .surfaces import extract_points

# ---- .splat files (antimatter15): 32 bytes per Gaussian, colours independent of the direction ----

MAX_SPLAT_BYTES = 4 << 30  # maximum size of a file in bytes
_ROW = np.dtype([("center", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])
_SPLAT_BLOCK = 1 << 14  # Gaussians per chunk of the conversion


def read_splat(path: str | os.PathLike) -> Splats:
    """Read the Gaussian splats in ``path``. Uses about 2.4 times the file size in memory. Raises `NergError` for
    another file.
    """
    with open_file(path, "splat file", "export it again", MAX_SPLAT_BYTES) as file:
        size = os.fstat(file.fileno()).st_size
        count, rest = divmod(size, _ROW.itemsize)
        if rest:
            raise ValueError(f"its {size:,} bytes are not a multiple of {_ROW.itemsize}")
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


# ---- Binary glTF with the extension KHR_gaussian_splatting; y is up ----

EXTENSION = "KHR_gaussian_splatting"
_POINTS = 0
_COLOR_SPACES = {"srgb_rec709_display": "srgb", "lin_rec709_display": "linear"}
_TOLERANCE = 1e-4
_EXTENSION = {"extensions?": dict, "kernel?": str, "colorSpace?": str}


def has_gltf_splats(path: str | os.PathLike) -> bool:
    """Return whether the JSON document of the .glb file ``path``, which may also be a mesh, contains `EXTENSION`."""
    with open_file(path, "splat file") as file:
        head = file.read(20)
        length = int.from_bytes(head[12:16], "little")
        return EXTENSION.encode() in file.read(min(length, MAX_JSON_BYTES))


def read_gltf_splats(path: str | os.PathLike) -> Splats:
    """Read all Gaussian splats of the scene in the .glb file ``path``, with node transforms applied.

    Raises `NergError` for a damaged file, a file without splats, compressed splats, nodes with non-uniform scale,
    splats with different degrees of spherical harmonics, and values outside of the ranges of the extension.
    """
    raw = map_bytes(path, "splat file", MAX_GLTF_BYTES, GLTF_MAGIC, "export it again")
    with translate_read_errors(path, "splat file", "export it again"):
        document, data = read_glb_chunks(raw, path, "splat file")
        parts = []
        for primitive, matrix, _ in iter_instances(document, _POINTS):
            extension = primitive.get("extensions", {}).get(EXTENSION)
            if extension is None:
                continue
            check_json(extension, _EXTENSION, EXTENSION)
            if any("compression" in name for name in extension.get("extensions", {})):
                raise ValueError("its splats are compressed; export it without compression")
            try:
                to_scene = Similarity(matrix)
            except NergError as error:
                raise ValueError(
                    "its node transforms are not similarities (rotation, translation, uniform scale)"
                ) from error
            parts.append(_read_primitive(document, data, primitive["attributes"], extension).transform(to_scene))
        if not parts:
            raise ValueError(f"its scene has no splats of {EXTENSION}")
        return concatenate_splats(parts)


def _read_primitive(
    document: dict[str, Any], data: bytes | memoryview, attributes: dict[str, Any], extension: dict[str, Any]
) -> Splats:
    read_attribute = lambda name, shape: read_accessor(document, data, attributes[name], shape)
    read_extension = lambda name, shape: read_attribute(f"{EXTENSION}:{name}", shape)
    harmonics = []
    for degree in range(4):
        names = [f"SH_DEGREE_{degree}_COEF_{n}" for n in range(2 * degree + 1)]
        if f"{EXTENSION}:{names[0]}" not in attributes:
            break
        harmonics += [read_extension(name, "VEC3") for name in names]
    if not harmonics:
        raise ValueError("its splats have no colour")
    xyzw, scales, opacities = (
        read_extension("ROTATION", "VEC4"),
        read_extension("SCALE", "VEC3"),
        read_extension("OPACITY", "SCALAR")[:, 0],
    )
    kernel, color_space = extension.get("kernel", "ellipse"), extension.get("colorSpace", "srgb_rec709_display")
    if kernel != "ellipse":
        raise ValueError(f'its kernel is "{sanitize(kernel, 40)}", but only "ellipse" is supported')
    if color_space not in _COLOR_SPACES:
        raise ValueError(f'its colour space is "{sanitize(color_space, 40)}"; supported: {" and ".join(_COLOR_SPACES)}')
    _check_range("opacities", opacities, 0, 1, "logits")
    _check_range("scales", scales, 0, np.inf, "logarithms")
    _check_range("rotations' lengths", np.linalg.norm(xyzw, axis=1), 0.9, 1.1, "quaternions that are not normalised")
    used = {"POSITION", *(f"{EXTENSION}:{n}" for n in ("ROTATION", "SCALE", "OPACITY"))}
    unused = [n for n in attributes if n not in used and not re.fullmatch(rf"{EXTENSION}:SH_DEGREE_[0-3]_COEF_\d", n)]
    notes = (f"unused attributes: {sanitize(', '.join(unused))}",) if unused else ()
    shapes = read_attribute("POSITION", "VEC3"), scales, xyzw[:, [3, 0, 1, 2]], opacities
    return Splats(*shapes, np.stack(harmonics, axis=1), color_space=_COLOR_SPACES[color_space], notes=notes)


def _check_range(name: str, values: np.ndarray, low: float, high: float, likely_encoding: str) -> None:
    if not ((values >= low - _TOLERANCE) & (values <= high + _TOLERANCE)).all():
        raise ValueError(
            f"its {name} are in {values.min():.4g} .. {values.max():.4g}, but {EXTENSION} requires {low:g} .. "
            f"{high:g}; the file seems to contain {likely_encoding}"
        )


# ---- PLY files of 3DGS trainings (Kerbl et al. 2023): logarithms of scales, logits of opacities ----
#
# Columns are identified by name, in any order; normals are dropped, other columns are preserved. Files of 2DGS lack
# ``scale_2``: their Gaussians get a thickness of a thousandth of their width. The 3D filter of Mip-Splatting (Yu et al.
# 2024) is applied. Plain opacities and lengths, in place of logits and logarithms, are recognised by their values.

MAX_PLY_BYTES = 8 << 30  # maximum size of a file in bytes
DETECTION_BYTES = 64 << 10  # bytes of the header that are searched to distinguish splats from meshes
_CENTER, _SCALE, _ROTATION = ("x", "y", "z"), ("scale_0", "scale_1", "scale_2"), tuple(f"rot_{i}" for i in range(4))
_BASE, _NORMAL = tuple(f"f_dc_{i}" for i in range(3)), ("nx", "ny", "nz")
_FILTER = "filter_3D"
_RELATIVE_THICKNESS = 1e-3

# Minimum number of Gaussians from which the range of a column is evidence of its encoding.
_MIN_EVIDENCE = 64
_NEIGHBOR, _SAMPLE = 4, 2000
# Training does not produce such logits: the sigmoid of half this value rounds to 1 in float32.
_MAX_LOGIT = 32


def has_ply_splats(path: str | os.PathLike) -> bool:
    """Return whether the header of the PLY file ``path`` contains colours or shapes of Gaussian splats."""
    with open_file(path, "PLY file") as file:
        head = file.read(DETECTION_BYTES).replace(b"\r", b"\n")
        names = re.findall(rb"^property [a-z0-9]+ (\w+)\s*$", head, re.MULTILINE)
        return b"f_dc_0" in names or b"packed_position" in names or {b"opacity", b"scale_0", b"rot_0"} <= set(names)


def read_ply_splats(path: str | os.PathLike) -> Splats:
    """Read the Gaussian splats in the PLY file ``path``. Raises `NergError` for another kind of file, and for a
    damaged one.
    """
    remedy = "export it again as a 3DGS .ply"
    raw = map_bytes(path, "splat file", MAX_PLY_BYTES, PLY_MAGIC, remedy)
    with translate_read_errors(path, "splat file", remedy):
        tables = parse_ply(np.frombuffer(raw, np.uint8)).tables
        if "packed_position" in (tables["vertex"].columns if "vertex" in tables else ()):
            raise ValueError("it is a compressed .ply; convert it by: npx @playcanvas/splat-transform in.ply out.ply")
        first = next(iter(tables), "")
        if first != "vertex":
            raise ValueError(f'its first element is "{first[:40]}", not "vertex"')
        if tables["vertex"].lists:
            raise ValueError("its vertices have list properties")
        columns = {name: values() for name, values in tables["vertex"].columns.items()}
        missing = [name for name in (*_CENTER, "opacity", *_SCALE[:2], *_ROTATION, *_BASE) if name not in columns]
        if missing:
            raise ValueError(f'it lacks the column "{missing[0]}", which Gaussian splats need')
        rest_columns = sorted((int(m[1]), name) for name in columns if (m := re.fullmatch(r"f_rest_(\d{1,3})", name)))
        count = 1 + len(rest_columns) // 3
        if (
            len(rest_columns) % 3
            or count not in HARMONIC_DEGREES
            or [i for i, _ in rest_columns] != list(range(len(rest_columns)))
        ):
            raise ValueError(f"its {len(rest_columns)} columns f_rest_* do not match a degree from 0 to 3")
        stack_columns = lambda names: np.stack([columns.pop(name) for name in names if name in columns], axis=-1)
        base = stack_columns(_BASE)[:, None]
        # Coefficients are stored channel by channel.
        higher_harmonics = (
            stack_columns([n for _, n in rest_columns]).reshape(len(base), 3, count - 1).swapaxes(1, 2)
            if rest_columns
            else base[:, :0]
        )
        centers, rotations = stack_columns(_CENTER), stack_columns(_ROTATION)
        scales, opacities, guesses = _decode_scales_and_opacities(
            centers, stack_columns(_SCALE), columns.pop("opacity")
        )
        if scales.shape[1] == 2:
            scales = np.column_stack([scales, _RELATIVE_THICKNESS * scales.min(axis=1)])
        if _FILTER in columns:
            scales, opacities = _apply_3d_filter(scales, opacities, columns.pop(_FILTER))
        extra = {name: column for name, column in columns.items() if name not in _NORMAL}
        unused = [*extra, *(f"all of {name}" for name in list(tables)[1:])]
        notes = (f"unused columns: {sanitize(', '.join(unused))}",) if unused else ()
        harmonics = np.concatenate([base, higher_harmonics], axis=1)
        return Splats(centers, scales, rotations, opacities, harmonics, extra, assumptions=guesses, notes=notes)


def _decode_scales_and_opacities(
    centers: np.ndarray, scales: np.ndarray, opacities: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Decode the columns to scales and opacities, with sentences about encodings that differ from those of 3DGS
    trainings.
    """
    guesses = []
    if _are_lengths(centers, scales):
        guesses.append(
            "the scales are interpreted as lengths: as logarithms, they would far exceed the distances between "
            "Gaussians"
        )
    else:
        scales = scales_from_logs(scales)
    # Interpreted as logits, all opacities would be between 0.5 and 0.73.
    if len(opacities) >= _MIN_EVIDENCE and 0 <= opacities.min() < opacities.max() <= 1:
        guesses.append("the opacities are not interpreted as logits, because all values are in 0..1")
    elif len(opacities) >= _MIN_EVIDENCE and opacities.min() >= 0 and _MAX_LOGIT < opacities.max() <= 255:
        guesses.append("the opacities are interpreted as 0..255: as logits, they would all be 0.5 or 1")
        opacities = opacities / np.float32(255)
    else:
        opacities = opacities_from_logits(opacities)
    return scales, opacities, tuple(guesses)


def _are_lengths(centers: np.ndarray, scales: np.ndarray) -> bool:
    """Return whether ``scales`` (N, 2 or 3) match the distances of the ``centers`` as lengths, but not as
    logarithms.
    """
    if len(centers) < _MIN_EVIDENCE or not np.isfinite(centers).all() or not (scales >= 0).all():
        return False
    from scipy.spatial import KDTree

    samples = centers[:: max(len(centers) // _SAMPLE, 1)]
    distance = float(np.median(KDTree(centers).query(samples, k=_NEIGHBOR + 1)[0][:, -1]))
    typical_scale = np.median(scales.max(axis=1))
    # Logarithms that are all in 0..1 are unlikely: a training does not leave all sizes within a factor of 2.7.
    overlap = 2 if scales.max() <= 1 else 16
    return bool(distance > 0 and typical_scale < 4 * distance and overlap * distance < scales_from_logs(typical_scale))


def _apply_3d_filter(scales: np.ndarray, opacities: np.ndarray, deviation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convolve Gaussians with an isotropic one of standard ``deviation`` (N,), preserving the mass along a ray, as the
    renderer of Mip-Splatting does.
    """
    squares = np.asarray(scales, np.float64) ** 2
    widened = squares + np.asarray(deviation, np.float64)[:, None] ** 2
    return np.sqrt(widened), opacities * np.sqrt(np.prod(squares / widened, axis=1))


def write_ply_splats(path: str | os.PathLike, splats: Splats, comments: tuple[str, ...] = ()) -> None:
    """Write ``splats`` for viewers and Mitsuba: float32, zero normals, extra columns last. Mitsuba does not read files
    with extra columns.
    """
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


# ---- SPZ files (Niantic), versions 1 to 3: quantised columns, compressed with gzip ----
#
# Axes are those of the file; by default x right, y up, z back.

MAX_SPZ_GAUSSIANS = 50_000_000  # maximum number of Gaussians in a file
_MAGIC = 0x5053474E
_COLOR_SCALE = 0.15


def read_spz(path: str | os.PathLike) -> Splats:
    """Read the Gaussian splats in ``path``. Raises `NergError` for a damaged file and for later versions."""
    with open_file(path, "splat file") as file:
        start = file.read(4)
    convert = f'convert it by: npx @playcanvas/splat-transform "{Path(path).name}" out.ply'
    with translate_read_errors(path, "splat file", convert):
        if start == struct.pack("<I", _MAGIC):
            raise ValueError("it is SPZ version 4 or later; versions 1 to 3 are supported")
        with open_gzip(path, "splat file") as stream:
            head = stream.read(16)
            magic, version, count, degree, fraction = struct.unpack_from("<IIIBB", head)
            if magic != _MAGIC or not 1 <= version <= 3 or degree > 3 or fraction > 23 or len(head) < 16:
                raise ValueError("it is not SPZ of version 1 to 3")
            if count > MAX_SPZ_GAUSSIANS:
                raise ValueError(f"it claims {count:,} Gaussians; the limit is {MAX_SPZ_GAUSSIANS:,}")
            num_higher = (degree + 1) ** 2 - 1
            widths = (6 if version == 1 else 9, 1, 3, 3, 4 if version == 3 else 3, 3 * num_higher)
            data = stream.read(count * sum(widths))
        if len(data) < count * sum(widths):
            raise EOFError
        columns, at = [], 0
        for width in widths:
            columns.append(np.frombuffer(data, np.uint8, count * width, at).reshape(count, width))
            at += count * width
        center, alpha, color, scale, rotation, rest = columns
        centers = (
            center.view("<f2").astype(np.float64) if version == 1 else _decode_fixed_point(center) / (1 << fraction)
        )
        base = (color / 255.0 - 0.5) / _COLOR_SCALE
        higher_harmonics = (rest.reshape(count, num_higher, 3) - 128.0) / 128
        harmonics = np.concatenate([base[:, None], higher_harmonics], axis=1)
        rotations = _decode_smallest_three(rotation) if version == 3 else _decode_vector_part(rotation)
        return splats_from_raw_parameters(
            centers, scale / 16.0 - 10, rotations, logits_from_opacities(alpha[:, 0] / 255.0), harmonics
        )


def _decode_fixed_point(data: np.ndarray) -> np.ndarray:
    """Decode signed 24-bit integers (N, 3) from their bytes (N, 9)."""
    b = data.reshape(-1, 3, 3).astype(np.int64)
    value = b[..., 0] | b[..., 1] << 8 | b[..., 2] << 16
    return value - ((value >> 23) << 24)


def _decode_vector_part(data: np.ndarray) -> np.ndarray:
    xyz = data / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - (xyz * xyz).sum(axis=1, keepdims=True)))
    return np.concatenate([w, xyz], axis=1)


def _decode_smallest_three(data: np.ndarray) -> np.ndarray:
    """Decode quaternions, w first, from 32 bits each: the index of the largest component, and 10 bits for each
    other one.
    """
    bits = np.ascontiguousarray(data).view("<u4")[:, 0].astype(np.int64)
    largest = bits >> 30
    xyzw = np.zeros((len(bits), 4))
    for i in (3, 2, 1, 0):
        is_stored = largest != i
        value = np.sqrt(0.5) * (bits & 511) / 511
        xyzw[:, i] = np.where(is_stored, np.where(bits >> 9 & 1, -value, value), 0)
        bits = np.where(is_stored, bits >> 10, bits)
    rest = np.sqrt(np.maximum(0, 1 - (xyzw * xyzw).sum(axis=1)))
    xyzw[np.arange(len(xyzw)), largest] = rest
    return xyzw[:, [3, 0, 1, 2]]


# ---- All formats ----

READERS: dict[str, Callable[[str | os.PathLike], Splats]] = {
    ".ply": read_ply_splats,
    ".splat": read_splat,
    ".spz": read_spz,
    ".sog": read_sog,
    ".glb": read_gltf_splats,
}
"""Reader by file suffix."""

_UNSUPPORTED_SUFFIXES = (".ksplat", ".lcc")
_CONVERTIBLE_SUFFIXES = (*_UNSUPPORTED_SUFFIXES, ".gltf", ".json")


def is_splat_file(path: str | os.PathLike) -> bool:
    """Return whether ``path`` is a file of Gaussian splats, by its suffix; a ``.ply`` or ``.glb``, which may be a mesh,
    by its header.
    """
    suffix = Path(path).suffix.lower()
    detect = {".ply": has_ply_splats, ".glb": has_gltf_splats}.get(suffix)
    return suffix in READERS if detect is None else detect(path)


def choose_plugin(path: str | os.PathLike) -> str:
    """Return the volume plugin that renders the file of an environment: "splats" or "nerf"."""
    return "splats" if is_splat_file(path) else "nerf"


def refuse_unsupported_splats(path: str | os.PathLike) -> None:
    """Raise `NergError`, which names a converter, for splats in an unsupported format."""
    if Path(path).suffix.lower() in _UNSUPPORTED_SUFFIXES:
        read_splats(path)


def read_splats(path: str | os.PathLike) -> Splats:
    """Read the Gaussian splats in ``path``, in the frame and units of the file.

    Raises `NergError` for a file that is missing, damaged, too large or of another format, and for coordinates too far
    from the origin for single precision.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in READERS:
        suffixes = ", ".join(READERS)
        hint = f'npx @playcanvas/splat-transform "{Path(path).name}" out.ply'
        conversion = f"; convert it: {hint}" if suffix in _CONVERTIBLE_SUFFIXES else ""
        raise NergError(f'"{path}" is not a file of Gaussian splats; supported formats: {suffixes}{conversion}')
    # Overflows become infinite and raise an error later.
    with np.errstate(all="ignore"):
        splats = READERS[suffix](path)
    check_near_origin(splats.centers, f'the splat file "{path}"')
    return splats


# ---- Surfels: flat Gaussian splats on the surface of a radiance field ----
#
# No training is involved. At each crossing of a lattice edge with the surface, a Gaussian is placed along the surface.
# Its width is the distance to its neighbours, and its colour is that of the field seen from the front. Rendered depths
# agree with the field to a fraction of a cell.

SURFEL_WIDTH = 0.7
"""Standard deviation along the surface, relative to the distance of the nearest neighbours. Larger values blur colours,
smaller ones leave gaps."""

_SURFEL_THICKNESS, _OPACITY = 0.1, 0.9
_NEIGHBORS, _NEAREST = 12, 4


@dataclass(frozen=True, repr=False)
class SurfaceSplats(Summary, Splats):
    """Gaussians on the surface of a radiance field.

    Attributes
    ----------
    cell
        Size of a cell, in the units of the field.
    shift
        Median distance by which Gaussians were moved to the depth that rays see, in the same units.
    """

    cell: float = 0.0
    shift: float = 0.0

    def save(self, path: str | os.PathLike) -> None:
        """Write the Gaussians (.ply). Raises `NergError` for another suffix, or if the file cannot be written."""
        check_writable(path := Path(path), ".ply")
        write_ply_splats(path, self, comments=("Gaussian splats of a radiance field, by nerg_mi",))


def make_splats(field: RadianceNetwork, resolution: int = 256, threshold: float | None = None) -> SurfaceSplats:
    """Make Gaussians from the surface of a radiance field, in the frame of the field.

    Parameters
    ----------
    field
        The radiance field.
    resolution
        Cells along the longest edge.
    threshold
        Density at the surface. Default: that of `extract_points`.

    Raises
    ------
    NergError
        If there is no surface.
    """
    surface = extract_points(field, resolution, threshold)
    cell = surface.report["cell"]
    p, normals = surface.vertices, surface.normals
    has_no_normal = np.linalg.norm(normals, axis=1) < 0.5
    normals[has_no_normal] = (0, 0, 1)
    spacing, normals = _smooth_normals(p, normals)
    # A ray against the normal that starts one cell in front of the surface hits it at about that distance.
    depth, opacity = trace_depth(FieldMedium(field), (p + cell * normals), -normals)
    has_hit = (opacity >= 0.5) & (depth < 2 * cell)
    shift = np.where(has_hit, cell - depth, 0)
    p = p + shift[:, None] * normals
    widths = SURFEL_WIDTH * np.clip(spacing, 0.25 * cell, 2 * cell)
    scales = np.stack([widths, widths, _SURFEL_THICKNESS * widths / SURFEL_WIDTH], axis=1)
    opacities = np.full(len(p), _OPACITY)
    rotations, colors = matrices_to_quaternions(_make_frames(normals)), harmonics_from_colors(surface.colors)
    return SurfaceSplats(
        p, scales, rotations, opacities, colors, cell=float(cell), shift=float(np.median(np.abs(shift)))
    )


def _smooth_normals(p: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance of each point to its nearest neighbours, and the mean normal of the neighbours with
    similar normals.
    """
    from scipy.spatial import KDTree

    count = min(_NEIGHBORS + 1, len(p))
    distances, neighbors = (v.reshape(len(p), -1) for v in KDTree(p).query(p, k=count))
    for _ in range(2):
        weights = np.clip(np.einsum("nkc,nc->nk", normals[neighbors], normals), 0, 1) ** 4
        total = np.einsum("nk,nkc->nc", weights, normals[neighbors])
        normals = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    if count == 1:
        return np.full(len(p), np.inf), normals
    return np.median(distances[:, 1 : _NEAREST + 1], axis=1), normals


def _make_frames(normals: np.ndarray) -> np.ndarray:
    """Return rotations (N, 3, 3) whose third axis is the normal."""
    reference = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(normals, reference)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], axis=2)
