"""Binary glTF 2.0 (.glb): the container format, and the triangles of files from other programs.

This module does not use trimesh (5.2). Its writer supports only 8-bit colours, which are too coarse for linear values:
the darkest level above black is 5 % of sRGB. Its reader ignores required extensions: it reads quantised positions as
integers, omits triangle fans and the instances of EXT_mesh_gpu_instancing, and does not report cycles of nodes.
"""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.errors import sanitize
from nerg_mi.fields.splats import quaternions_to_matrices
from nerg_mi.files.safe_read import parse_json, translate_read_errors
from nerg_mi.files.schema import INDEX, NUMBER, Items, Names, check_json
from nerg_mi.maths.transforms import ROTATION_TOLERANCE, has_last_row, transform_points

GLTF_MAGIC = b"glTF"  # first bytes of a file
MAX_GLTF_BYTES = 1 << 30  # maximum size of a file in bytes
MAX_NODE_DEPTH = 64  # maximum nesting depth of nodes
MAX_INSTANCES = 100_000  # maximum number of mesh instances in a scene
MAX_TRIANGLES = 20_000_000  # maximum number of triangles of all instances
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_INDICES = {5121: "u1", 5123: "<u2", 5125: "<u4"}
_FLOATS = {5126: "<f4"}
_NORMALIZED = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2"}
_QUANTIZED = _FLOATS | _NORMALIZED
_QUANTIZATION, _INSTANCING = "KHR_mesh_quantization", "EXT_mesh_gpu_instancing"
# Prefixes of extensions that change the appearance of triangles, but not their positions.
_APPEARANCE_PREFIXES = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "EXT_lights_", "KHR_xmp")
_TRIANGLES = 4
_INDICES_LIST = Items(INDEX)
_DOCUMENT = {
    "scene?": INDEX,
    "scenes?": Items({"nodes?": _INDICES_LIST}),
    "nodes?": Items(
        {
            "children?": _INDICES_LIST,
            "mesh?": INDEX,
            "matrix?": Items(NUMBER, 16, 16),
            "rotation?": Items(NUMBER, 4, 4),
            "scale?": Items(NUMBER, 3, 3),
            "translation?": Items(NUMBER, 3, 3),
            "extensions?": dict,
        }
    ),
    "meshes?": Items(
        {"primitives": Items({"attributes": Names(INDEX), "indices?": INDEX, "mode?": INDEX, "extensions?": dict})}
    ),
    "accessors?": Items(
        {
            "bufferView?": INDEX,
            "byteOffset?": INDEX,
            "componentType": INDEX,
            "normalized?": bool,
            "count": INDEX,
            "type": str,
        }
    ),
    "bufferViews?": Items({"buffer?": INDEX, "byteOffset?": INDEX, "byteStride?": INDEX}),
    "buffers?": Items(dict),
    "extensionsUsed?": Items(str),
    "extensionsRequired?": Items(str),
}

Attribute = tuple[str, np.ndarray, bool]
"""Name of a vertex attribute, its values (V,) or (V, components), and whether integers are normalised to 0..1."""

_COMPONENT_TYPES = {"float32": 5126, "uint16": 5123, "uint32": 5125}
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_WIDTHS = {name: width for width, name in _SHAPES.items()}


def encode_unlit_glb(
    attributes: Sequence[Attribute],
    faces: np.ndarray | None,
    up: str = "z",
    extras: Mapping[str, Any] | None = None,
    image: bytes | None = None,
) -> tuple[bytes, ...]:
    """Encode one mesh, or points without ``faces``, with unlit colours. Returns the bytes of the file in parts.

    Parameters
    ----------
    attributes
        Vertex attributes, float32 or uint16; POSITION first.
    faces
        Vertex indices (F, 3); None for points.
    up
        Axis that points up, "z" or "y". The up axis of glTF is y; for z, the node is rotated.
    extras
        JSON metadata of the file.
    image
        A PNG image; its colours are sampled at TEXCOORD_0.
    """
    arrays = [(name, np.ascontiguousarray(values), shared, 34962) for name, values, shared in attributes]
    if faces is not None:
        arrays.append(("indices", np.asarray(faces, "<u4").ravel(), False, 34963))
    views, accessors, data = [], [], b""
    for _, values, is_normalized, target in arrays:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes, "target": target})
        kind, shape = _COMPONENT_TYPES[values.dtype.name], _SHAPES[1 if values.ndim == 1 else values.shape[1]]
        accessors.append({"bufferView": len(views) - 1, "componentType": kind, "count": len(values), "type": shape})
        if is_normalized:
            accessors[-1]["normalized"] = True
        data += values.tobytes()
        data += b"\0" * (-len(data) % 4)
    position = arrays[0][1]
    accessors[0] |= {"min": position.min(0).tolist(), "max": position.max(0).tolist()}
    attribute_accessors = {name: number for number, (name, *_) in enumerate(arrays) if name != "indices"}
    primitive: dict[str, Any] = {
        "attributes": attribute_accessors,
        "mode": 0 if faces is None else _TRIANGLES,
        "material": 0,
    }
    if faces is not None:
        primitive["indices"] = len(arrays) - 1
    surface: dict[str, Any] = {"metallicFactor": 0}
    material: dict[str, Any] = {"extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": surface}
    asset: dict[str, Any] = {"version": "2.0", "generator": "nerg_mi"}
    document: dict[str, Any] = {
        "asset": asset | ({"extras": dict(extras)} if extras else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0} | ({"rotation": [-(0.5**0.5), 0, 0, 0.5**0.5]} if up == "z" else {})],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "extensionsUsed": ["KHR_materials_unlit"],
    }
    if image is not None:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(image)})
        data += image
        surface["baseColorTexture"] = {"index": 0}
        material["doubleSided"] = True
        document |= {
            "textures": [{"source": 0, "sampler": 0}],
            "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
            "images": [{"bufferView": len(views) - 1, "mimeType": "image/png"}],
        }
    document |= {"buffers": [{"byteLength": len(data)}], "bufferViews": views, "accessors": accessors}
    return pack_glb(document, data)


def pack_glb(document: dict[str, Any], data: bytes) -> tuple[bytes, ...]:
    """Encode a ``document`` and its only buffer ``data``. Returns the bytes of the file in parts."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    head = struct.pack("<4sII", GLTF_MAGIC, 2, 28 + len(text) + len(data))
    return head, struct.pack("<II", len(text), _JSON), text, struct.pack("<II", len(data), _BINARY), data


@dataclass(frozen=True, eq=False)
class GltfTriangles:
    """All triangles of the scene of a file, with node transforms applied, in the frame of glTF: right-handed, y up.

    Attributes
    ----------
    vertices
        Positions (V, 3).
    faces
        Vertex indices (F, 3).
    colors
        Linear vertex colours (V, 3) in 0..1, or None.
    notes
        Sentences about parts of the file that are not used.
    parts
        Name of each node with triangles, and the index of its first one.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    parts: tuple[tuple[str, int], ...] = ()


def parse_glb(raw: bytes | memoryview, path: str | os.PathLike) -> GltfTriangles:
    """Parse the triangles in the bytes ``raw`` of the file ``path``.

    Raises `NergError` for a file that is damaged, compressed, quantised without declaring it, or beyond the limits of
    this module, for required extensions that are not supported, and for a file without triangles.
    """
    with translate_read_errors(path, "mesh", "export it again"):
        document, data = read_glb_chunks(raw, path)
        _check_extensions(document)
        quantized = _QUANTIZATION in document.get("extensionsUsed", [])
        primitives = list(iter_instances(document, *_TRIANGLE_INDEXERS))
        vertices: list[np.ndarray] = []
        colors: list[np.ndarray | None] = []
        faces: list[np.ndarray] = []
        count = triangles = 0
        cached: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}
        parts: list[tuple[str, int]] = []
        for primitive, matrix, name in primitives:
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                raise ValueError("its triangles are compressed (Draco); export it without compression")
            key = primitive["attributes"]["POSITION"], primitive.get("indices"), primitive.get("mode", _TRIANGLES)
            if key not in cached:
                cached[key] = _read_triangles(document, data, *key, _QUANTIZED if quantized else _FLOATS)
            corners, index = cached[key]
            parts.append((name, triangles))
            triangles += len(index)
            if triangles > MAX_TRIANGLES:
                raise ValueError(f"it has more than the {MAX_TRIANGLES:,} triangles, the limit")
            vertices.append(transform_points(matrix, corners))
            colors.append(_read_vertex_colors(document, data, primitive["attributes"], len(corners)))
            # A mirrored instance has the opposite winding order.
            faces.append(count + (index if np.linalg.det(matrix[:3, :3]) >= 0 else index[:, ::-1]))
            count += len(corners)
        if not triangles:
            raise ValueError("its scene has no triangles")
        vertex_colors = None
        if any(part is not None for part in colors):
            vertex_colors = np.concatenate([np.ones((len(v), 3)) if c is None else c for v, c in zip(vertices, colors)])
        notes = _describe_unused(document, [primitive for primitive, _, _ in primitives])
        return GltfTriangles(np.concatenate(vertices), np.concatenate(faces), vertex_colors, notes, tuple(parts))


def _check_extensions(document: dict[str, Any]) -> None:
    """Raise `ValueError` for extensions that change the triangles."""
    for name in document.get("extensionsRequired", []):
        if name != _QUANTIZATION and not str(name).startswith(_APPEARANCE_PREFIXES):
            raise ValueError(
                f'it requires the extension "{sanitize(name, 60)}", which is not supported; export it without this '
                "extension"
            )
    if any(_INSTANCING in node.get("extensions", {}) for node in document.get("nodes", [])):
        raise ValueError(f"it has instances of {_INSTANCING}, which is not supported; export it without this extension")


def _describe_unused(document: dict[str, Any], primitives: list[dict[str, Any]]) -> tuple[str, ...]:
    """Return a sentence about the parts of the file besides the triangles."""
    modes = {p.get("mode", _TRIANGLES) for m in document.get("meshes", []) for p in m["primitives"]}
    parts = (["points"] if 0 in modes else []) + (["lines"] if modes & {1, 2, 3} else [])
    parts += [name for name in ("materials", "skins", "animations", "cameras") if document.get(name)]
    parts += ["morph targets"] if any("targets" in p for p in primitives) else []
    parts += sorted({name for p in primitives for name in p["attributes"]} - {"POSITION", "NORMAL", "COLOR_0"})
    parts += [str(name) for name in document.get("extensionsUsed", []) if name != _QUANTIZATION]
    return (f"parts that are not used: {sanitize(', '.join(parts))}",) if parts else ()


def _read_vertex_colors(
    document: dict[str, Any], data: bytes | memoryview, attributes: dict[str, Any], count: int
) -> np.ndarray | None:
    if "COLOR_0" not in attributes:
        return None
    shape = _get(document, "accessors", attributes["COLOR_0"])["type"]
    if shape not in ("VEC3", "VEC4"):
        raise ValueError(f'its colours have the type "{sanitize(shape, 40)}"')
    colors = read_accessor(document, data, attributes["COLOR_0"], shape)[:, :3].astype(np.float64)
    if len(colors) != count or not np.isfinite(colors).all():
        raise ValueError("its colours are not finite, or their number differs from that of the vertices")
    return np.clip(colors, 0, 1)


def read_glb_chunks(
    raw: bytes | memoryview, path: str | os.PathLike, file_kind: str = "mesh"
) -> tuple[dict[str, Any], bytes | memoryview]:
    """Parse the JSON document and the binary chunk of the bytes ``raw`` of the file ``path``."""
    magic, version, _ = struct.unpack_from("<4sII", raw)
    if magic != GLTF_MAGIC or version != 2:
        raise ValueError("it is not binary glTF, version 2")
    offset, document, data = 12, None, b""
    while offset + 8 <= len(raw):
        length, kind = struct.unpack_from("<II", raw, offset)
        part = raw[offset + 8 : offset + 8 + length]
        if len(part) < length:
            raise ValueError("it is truncated within a chunk")
        if kind == _JSON and document is None:
            document = parse_json(part, path, file_kind)
        elif kind == _BINARY and not data:
            data = part
        offset += 8 + length
    if document is None:
        raise ValueError("it has no JSON document")
    return check_json(document, _DOCUMENT), data


def _get(document: dict[str, Any], kind: str, index: int) -> dict[str, Any]:
    """Return the entry that the document calls by its ``index``, such as an accessor."""
    entries = document.get(kind, [])
    if index >= len(entries):
        raise ValueError(f"it refers to number {index:,} of {len(entries):,} {kind}, counted from 0")
    return entries[index]


def iter_instances(document: dict[str, Any], *modes: int) -> Iterator[tuple[dict[str, Any], np.ndarray, str]]:
    """Iterate over the primitives of the scene with one of these ``modes``, each with the matrix (4, 4) of its node and
    its name: that of the node, or of the mesh."""
    roots = range(len(document.get("nodes", [])))
    if document.get("scenes"):
        roots = _get(document, "scenes", document.get("scene", 0)).get("nodes", [])
    pending = [(k, np.eye(4), 0) for k in roots]
    visited = 0
    while pending:
        number, parent, depth = pending.pop()
        visited += 1
        if depth > MAX_NODE_DEPTH or visited > MAX_INSTANCES:
            raise ValueError("its nodes are nested too deeply, or form a cycle")
        node = _get(document, "nodes", number)
        to_scene = parent @ _read_node_matrix(node)
        pending += [(k, to_scene, depth + 1) for k in reversed(node.get("children", []))]
        if "mesh" in node:
            mesh = _get(document, "meshes", node["mesh"])
            for primitive in mesh["primitives"]:
                if primitive.get("mode", _TRIANGLES) in modes:
                    yield primitive, to_scene, str(node.get("name") or mesh.get("name") or "")


def _read_node_matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        out = np.array(node["matrix"], np.float64).reshape(4, 4).T
        if not has_last_row(out[None])[0]:
            raise ValueError("the matrix of a node has another last row than 0, 0, 0, 1; glTF stores its columns")
    else:
        x, y, z, w = (float(v) for v in node.get("rotation", (0, 0, 0, 1)))
        if not abs(math.hypot(x, y, z, w) - 1) <= ROTATION_TOLERANCE:
            raise ValueError("the rotation of a node is not a quaternion of length 1")
        out = np.eye(4)
        rotation = quaternions_to_matrices(np.array([[w, x, y, z]]))[0]
        out[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64).reshape(3)
        out[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64).reshape(3)
    if not np.isfinite(out).all():
        raise ValueError("the transform of a node is not finite")
    return out


def _read_triangles(
    document: dict[str, Any],
    data: bytes | memoryview,
    position: int,
    indices: int | None,
    mode: int,
    kinds: Mapping[int, str],
) -> tuple[np.ndarray, np.ndarray]:
    corners = read_accessor(document, data, position, "VEC3", kinds).astype(np.float64)
    if indices is None:
        index = np.arange(len(corners))
    else:
        index = read_accessor(document, data, indices, "SCALAR", _INDICES).reshape(-1).astype(np.int64)
    if len(index) and index.max() >= len(corners):
        raise ValueError("its triangles refer to vertices that do not exist")
    return corners, index[_TRIANGLE_INDEXERS[mode](len(index))]


def _index_triangles(count: int) -> np.ndarray:
    if count % 3:
        raise ValueError(f"its triangles have {count:,} corners, which is not a multiple of three")
    return np.arange(count).reshape(-1, 3)


def _index_strip(count: int) -> np.ndarray:
    first = np.arange(max(count - 2, 0))
    # Every second triangle of a strip has the opposite winding order.
    return np.stack([first, first + 1 + first % 2, first + 2 - first % 2], axis=1)


def _index_fan(count: int) -> np.ndarray:
    second = np.arange(1, max(count - 1, 1))
    return np.stack([0 * second, second, second + 1], axis=1)


_TRIANGLE_INDEXERS = {_TRIANGLES: _index_triangles, 5: _index_strip, 6: _index_fan}
"""Functions that convert the corners of a primitive to triangles, by mode."""


def read_accessor(
    document: dict[str, Any], data: bytes | memoryview, number: int, shape: str, kinds: Mapping[int, str] = _FLOATS
) -> np.ndarray:
    """Read the values (N, components) of an accessor.

    Parameters
    ----------
    document, data
        The file, from `read_glb_chunks`.
    number
        Index of the accessor.
    shape
        Required type, such as "VEC3".
    kinds
        NumPy type of each supported component type. Normalised integers become floats.

    Raises
    ------
    ValueError
        For another type, and if the buffer is too short.
    """
    accessor = _get(document, "accessors", number)
    is_normalized = bool(accessor.get("normalized")) and kinds is not _INDICES
    component_types = _NORMALIZED if is_normalized else kinds
    if accessor["type"] != shape or accessor["componentType"] not in component_types or "sparse" in accessor:
        raise ValueError("its positions or indices have an unsupported type; export it again without compression")
    view = _get(document, "bufferViews", accessor["bufferView"])
    if view.get("buffer", 0) != 0 or "uri" in _get(document, "buffers", 0):
        raise ValueError("its triangles are in another file; export it as one .glb")
    dtype, width = np.dtype(component_types[accessor["componentType"]]), _WIDTHS[shape]
    count, step = accessor["count"], view.get("byteStride", 0) or dtype.itemsize * width
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    if step < dtype.itemsize * width or (count and start + (count - 1) * step + dtype.itemsize * width > len(data)):
        raise ValueError("it is truncated: it has fewer values than it claims")
    if not count:
        return np.zeros((0, width), dtype)
    values = np.ndarray((count, width), dtype, data, start, (step, dtype.itemsize)).copy()
    return np.maximum(values / np.float32(np.iinfo(dtype).max), -1) if is_normalized else values
