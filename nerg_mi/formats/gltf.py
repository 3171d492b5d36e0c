"""Binary glTF 2.0 (.glb): the container, and the triangles of a file that somebody else wrote.

Not trimesh's (5.2). Its writer has colours of 8 bits, which are too few for linear ones: the darkest step above black
is 5 % of sRGB. Its reader ignores what a file requires: it takes quantised positions for whole numbers, leaves out fans
and the copies of EXT_mesh_gpu_instancing, and ends circles of nodes without a word.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.errors import sanitize
from nerg_mi.fields.splats import quaternions_to_matrices
from nerg_mi.files.safe_read import is_count, parse_json, translate_read_errors

GLTF_MAGIC = b"glTF"  # beginning of a file
MAX_GLTF_BYTES = 1 << 30  # maximum bytes of a file
MAX_NODE_DEPTH = 64  # nodes may be nested so deep
MAX_INSTANCES = 100_000  # so many meshes may stand in a scene
MAX_TRIANGLES = 20_000_000  # so many triangles may be in all of them
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
_INDICES = {5121: "u1", 5123: "<u2", 5125: "<u4"}
_FLOATS = {5126: "<f4"}
_SHARES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2"}
_QUANTIZED = _FLOATS | _SHARES
_QUANTIZATION, _INSTANCING = "KHR_mesh_quantization", "EXT_mesh_gpu_instancing"
# Beginnings of extensions that change how triangles look, and not where they are.
_LOOKS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "EXT_lights_", "KHR_xmp")
_TRIANGLES = 4

Attribute = tuple[str, np.ndarray, bool]
"""Name of a vertex attribute, its values (V,) or (V, components), and whether integers stand for 0 to 1."""

_KINDS = {"float32": 5126, "uint16": 5123, "uint32": 5125}
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
_WIDTHS = {name: width for width, name in _SHAPES.items()}


def encode_unlit_glb(
    attributes: Sequence[Attribute],
    faces: np.ndarray | None,
    up: str = "z",
    extras: Mapping[str, Any] | None = None,
    image: bytes | None = None,
) -> tuple[bytes, ...]:
    """The bytes of a file, in parts, of one mesh (without ``faces`` of points) whose colours are shown as they are.

    ``attributes``: POSITION first; float32 or uint16. ``up``: axis that is up, z or y; glTF's is y, and the node is
    turned for z. ``extras``: what the file says of itself. ``image``: a PNG, of which TEXCOORD_0 takes the colours.
    """
    arrays = [(name, np.ascontiguousarray(values), shared, 34962) for name, values, shared in attributes]
    if faces is not None:
        arrays.append(("indices", np.asarray(faces, "<u4").ravel(), False, 34963))
    views, accessors, data = [], [], b""
    for _, values, shared, target in arrays:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes, "target": target})
        kind, shape = _KINDS[values.dtype.name], _SHAPES[1 if values.ndim == 1 else values.shape[1]]
        accessors.append({"bufferView": len(views) - 1, "componentType": kind, "count": len(values), "type": shape})
        if shared:
            accessors[-1]["normalized"] = True
        data += values.tobytes()
        data += b"\0" * (-len(data) % 4)
    position = arrays[0][1]
    accessors[0] |= {"min": position.min(0).tolist(), "max": position.max(0).tolist()}
    named = {name: number for number, (name, *_) in enumerate(arrays) if name != "indices"}
    primitive: dict[str, Any] = {"attributes": named, "mode": 0 if faces is None else _TRIANGLES, "material": 0}
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
    """The bytes of a file, in parts, of the ``document`` and of its only buffer ``data``."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    head = struct.pack("<4sII", GLTF_MAGIC, 2, 28 + len(text) + len(data))
    return head, struct.pack("<II", len(text), _JSON), text, struct.pack("<II", len(data), _BINARY), data


@dataclass(frozen=True, eq=False)
class GltfTriangles:
    """``vertices`` (V, 3) and ``faces`` (F, 3) of all triangles of a file's scene, its nodes applied, in glTF's frame:
    right-handed, y up. ``colors`` (V, 3), linear in 0..1, of vertices, or None; ``notes`` on what is not used."""

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray | None = None
    notes: tuple[str, ...] = ()


def parse_glb(raw: bytes | memoryview, path: str | os.PathLike) -> GltfTriangles:
    """The triangles in the bytes ``raw`` of the file ``path``.

    Raises `NergError` for what is damaged, compressed, quantised without saying so or beyond this module's limits,
    for extensions that it requires and that are not read, and where there is no triangle.
    """
    # Whatever stands where another kind of value belongs is the file's mistake.
    with translate_read_errors(path, "mesh", "export it again", extra_errors=(TypeError, AttributeError)):
        document, data = read_glb_chunks(raw, path)
        _check_extensions(document)
        quantized = _QUANTIZATION in document.get("extensionsUsed", [])
        found = list(iter_instances(document, *_CORNERS_OF))
        vertices: list[np.ndarray] = []
        colors: list[np.ndarray | None] = []
        faces: list[np.ndarray] = []
        count = triangles = 0
        known: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}
        for primitive, matrix in found:
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                raise ValueError("its triangles are compressed (Draco); export it without compression")
            key = primitive["attributes"]["POSITION"], primitive.get("indices"), primitive.get("mode", _TRIANGLES)
            if key not in known:
                known[key] = _triangles(document, data, *key, _QUANTIZED if quantized else _FLOATS)
            corners, index = known[key]
            triangles += len(index)
            if triangles > MAX_TRIANGLES:
                raise ValueError(f"it has more than the {MAX_TRIANGLES:,} triangles that are read")
            vertices.append(corners @ matrix[:3, :3].T + matrix[:3, 3])
            colors.append(_vertex_colors(document, data, primitive["attributes"], len(corners)))
            # A mirrored instance is seen from its other side.
            faces.append(count + (index if np.linalg.det(matrix[:3, :3]) >= 0 else index[:, ::-1]))
            count += len(corners)
        if not triangles:
            raise ValueError("its scene has no triangles")
        whole = None
        if any(part is not None for part in colors):
            whole = np.concatenate([np.ones((len(v), 3)) if c is None else c for v, c in zip(vertices, colors)])
        notes = _unused(document, [primitive for primitive, _ in found])
        return GltfTriangles(np.concatenate(vertices), np.concatenate(faces), whole, notes)


def _check_extensions(document: dict[str, Any]) -> None:
    """Raise `ValueError` for extensions without which the triangles are others."""
    for name in document.get("extensionsRequired", []):
        if name != _QUANTIZATION and not str(name).startswith(_LOOKS):
            raise ValueError(f'it requires the extension "{sanitize(name, 60)}", which is not read; export it without it')
    if any(_INSTANCING in node.get("extensions", {}) for node in document.get("nodes", [])):
        raise ValueError(f"it has copies of meshes by {_INSTANCING}, which is not read; export it without it")


def _unused(document: dict[str, Any], primitives: list[dict[str, Any]]) -> tuple[str, ...]:
    """A sentence on what there is besides the triangles."""
    modes = {p.get("mode", _TRIANGLES) for m in document.get("meshes", []) for p in m["primitives"]}
    parts = (["points"] if 0 in modes else []) + (["lines"] if modes & {1, 2, 3} else [])
    parts += [name for name in ("materials", "skins", "animations", "cameras") if document.get(name)]
    parts += ["morph targets"] if any("targets" in p for p in primitives) else []
    parts += sorted({name for p in primitives for name in p["attributes"]} - {"POSITION", "NORMAL", "COLOR_0"})
    parts += [str(name) for name in document.get("extensionsUsed", []) if name != _QUANTIZATION]
    return (f"parts that are not used: {sanitize(', '.join(parts))}",) if parts else ()


def _vertex_colors(
    document: dict[str, Any], data: bytes | memoryview, attributes: dict[str, Any], count: int
) -> np.ndarray | None:
    if "COLOR_0" not in attributes:
        return None
    shape = document["accessors"][_index(attributes["COLOR_0"])]["type"]
    if shape not in ("VEC3", "VEC4"):
        raise ValueError(f'its colours are of the type "{sanitize(shape, 40)}"')
    colors = read_accessor(document, data, attributes["COLOR_0"], shape)[:, :3].astype(np.float64)
    if len(colors) != count or not np.isfinite(colors).all():
        raise ValueError("its colours are not as many as its vertices, or not finite")
    return np.clip(colors, 0, 1)


def read_glb_chunks(
    raw: bytes | memoryview, path: str | os.PathLike, file_kind: str = "mesh"
) -> tuple[dict[str, Any], bytes | memoryview]:
    """The document and the binary chunk of the bytes ``raw`` of the file ``path``, a kind of file called ``what``."""
    magic, version, _ = struct.unpack_from("<4sII", raw)
    if magic != GLTF_MAGIC or version != 2:
        raise ValueError("it is no binary glTF of version 2")
    at, document, data = 12, None, b""
    while at + 8 <= len(raw):
        length, kind = struct.unpack_from("<II", raw, at)
        part = raw[at + 8 : at + 8 + length]
        if len(part) < length:
            raise ValueError("it ends within one of its chunks")
        if kind == _JSON and document is None:
            document = parse_json(part, path, file_kind)
        elif kind == _BINARY and not data:
            data = part
        at += 8 + length
    if not isinstance(document, dict):
        raise ValueError("it has no document")
    return document, data


def iter_instances(document: dict[str, Any], *modes: int) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Primitives of ``modes``, and where each stands: the matrix (4, 4) of its node in the scene."""
    nodes = document.get("nodes", [])
    scenes = document.get("scenes")
    roots = scenes[_index(document.get("scene", 0))]["nodes"] if scenes else range(len(nodes))
    waiting = [(_index(k), np.eye(4), 0) for k in roots]
    seen = 0
    while waiting:
        number, above, depth = waiting.pop()
        seen += 1
        if depth > MAX_NODE_DEPTH or seen > MAX_INSTANCES:
            raise ValueError("its nodes are nested too deep, or in a circle")
        node = nodes[number]
        here = above @ _matrix(node)
        waiting += [(_index(k), here, depth + 1) for k in reversed(node.get("children", []))]
        if "mesh" in node:
            for primitive in document["meshes"][_index(node["mesh"])]["primitives"]:
                if primitive.get("mode", _TRIANGLES) in modes:
                    yield primitive, here


def _matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        out = np.array(node["matrix"], np.float64).reshape(4, 4).T
    else:
        x, y, z, w = (float(v) for v in node.get("rotation", (0, 0, 0, 1)))
        out = np.eye(4)
        rotation = quaternions_to_matrices(np.array([[w, x, y, z]]))[0]
        out[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64).reshape(3)
        out[:3, 3] = np.array(node.get("translation", (0, 0, 0)), np.float64).reshape(3)
    if not np.isfinite(out).all():
        raise ValueError("one of its nodes stands nowhere")
    return out


def _triangles(
    document: dict[str, Any],
    data: bytes | memoryview,
    position: object,
    indices: object,
    mode: int,
    kinds: Mapping[int, str],
) -> tuple[np.ndarray, np.ndarray]:
    corners = read_accessor(document, data, position, "VEC3", kinds).astype(np.float64)
    if indices is None:
        index = np.arange(len(corners))
    else:
        index = read_accessor(document, data, indices, "SCALAR", _INDICES).reshape(-1).astype(np.int64)
    if len(index) and index.max() >= len(corners):
        raise ValueError("its triangles have corners that are none of its vertices")
    return corners, index[_CORNERS_OF[mode](len(index))]


def _separate(count: int) -> np.ndarray:
    if count % 3:
        raise ValueError(f"its triangles have {count:,} corners, no multiple of three")
    return np.arange(count).reshape(-1, 3)


def _strip(count: int) -> np.ndarray:
    first = np.arange(max(count - 2, 0))
    # Every other triangle of a strip is turned around.
    return np.stack([first, first + 1 + first % 2, first + 2 - first % 2], axis=1)


def _fan(count: int) -> np.ndarray:
    second = np.arange(1, max(count - 1, 1))
    return np.stack([0 * second, second, second + 1], axis=1)


_CORNERS_OF = {_TRIANGLES: _separate, 5: _strip, 6: _fan}
"""How the corners of a primitive, by its mode, make triangles."""


def read_accessor(
    document: dict[str, Any], data: bytes | memoryview, number: object, shape: str, kinds: Mapping[int, str] = _FLOATS
) -> np.ndarray:
    """An accessor's values (N, components), as far as the bytes that are there hold them. ``kinds``: NumPy's type of
    each component type that is read. Integers that stand for 0 to 1, or for -1 to 1, become floats."""
    accessor = document["accessors"][_index(number)]
    shared = bool(accessor.get("normalized")) and kinds is not _INDICES
    known = _SHARES if shared else kinds
    if accessor["type"] != shape or accessor["componentType"] not in known or "sparse" in accessor:
        raise ValueError(
            "its positions or indices are of a kind that is not read; export it again, without compression"
        )
    view = document["bufferViews"][_index(accessor["bufferView"])]
    if _index(view.get("buffer", 0)) != 0 or "uri" in document["buffers"][0]:
        raise ValueError("its triangles are in another file; export it as one .glb")
    dtype, width = np.dtype(known[accessor["componentType"]]), _WIDTHS[shape]
    count, step = _index(accessor["count"]), _index(view.get("byteStride", 0)) or dtype.itemsize * width
    start = _index(view.get("byteOffset", 0)) + _index(accessor.get("byteOffset", 0))
    if step < dtype.itemsize * width or (count and start + (count - 1) * step + dtype.itemsize * width > len(data)):
        raise ValueError("it ends before the values that it announces")
    if not count:
        return np.zeros((0, width), dtype)
    values = np.ndarray((count, width), dtype, data, start, (step, dtype.itemsize)).copy()
    return np.maximum(values / np.float32(np.iinfo(dtype).max), -1) if shared else values


def _index(value: object) -> int:
    if not is_count(value):
        raise ValueError("it numbers its parts by what is no whole number")
    return int(value)  # pyright: ignore[reportArgumentType] is_count has looked
