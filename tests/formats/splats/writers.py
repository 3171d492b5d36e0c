"""Writers of Gaussian splat files, byte by byte after the sources of other programs."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np

from nerg_mi.fields.splats import Splats
from nerg_mi.formats.gltf import pack_glb

C0 = 0.28209479177387814


def random_splats(count: int = 40, degree: int = 3, seed: int = 0, size: float = 0.2) -> Splats:
    """Random Gaussians in the unit cube around the origin."""
    rng = np.random.default_rng(seed)
    return Splats(
        rng.uniform(-1, 1, (count, 3)),
        size * np.exp(rng.normal(0, 0.6, (count, 3))),
        rng.normal(size=(count, 4)),
        rng.uniform(0.05, 0.99, count),
        rng.normal(0, 0.4, (count, (degree + 1) ** 2, 3)),
    )


def write_inria(path: Path, splats: Splats, style: str = "binary_little_endian", shuffled: bool = False) -> None:
    """Write a model as graphdeco-inria/gaussian-splatting does. ``shuffled``: columns in another order, an extra
    column, and no normals, as in other trainings.
    """
    rest = splats.harmonics[:, 1:].transpose(0, 2, 1).reshape(len(splats), -1)
    p = splats.opacities.astype(np.float64)
    columns = {name: splats.centers[:, i] for i, name in enumerate("xyz")}
    columns |= {} if shuffled else {f"n{a}": np.zeros(len(p)) for a in "xyz"}
    columns |= {f"f_dc_{i}": splats.harmonics[:, 0, i] for i in range(3)}
    columns |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    columns |= {"opacity": np.log(p / (1 - p))}
    columns |= {f"scale_{i}": np.log(splats.scales[:, i]) for i in range(3)}
    columns |= {f"rot_{i}": 2 * splats.rotations[:, i] for i in range(4)}
    names = list(columns)
    if shuffled:
        columns["label"] = np.arange(len(p))
        names = list(np.random.default_rng(1).permutation([*columns]))
    head = f"ply\nformat {style} 1.0\ncomment SplatRenderMode: default\nelement vertex {len(p)}\n"
    head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    table = np.stack([columns[name] for name in names], axis=1).astype("<f4")
    text = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in table) + "\n"
    path.write_bytes(head.encode() + (text.encode() if style == "ascii" else table.tobytes()))


def write_antimatter(path: Path, splats: Splats) -> None:
    """Write a file as ``processPlyBuffer`` of antimatter15/splat does."""
    rows = bytearray()
    for c, s, q, a, h in zip(splats.centers, splats.scales, splats.rotations, splats.opacities, splats.harmonics):
        color = np.clip([*((0.5 + C0 * h[0]) * 255), a * 255], 0, 255).astype(np.uint8)
        turn = np.clip(q / np.linalg.norm(q) * 128 + 128, 0, 255).astype(np.uint8)
        rows += struct.pack("<6f", *c, *s) + color.tobytes() + turn.tobytes()
    path.write_bytes(bytes(rows))


def write_spz(path: Path, splats: Splats, version: int = 3, fraction: int = 12) -> None:
    """Write a cloud as nianticlabs/spz packs it."""
    n, degree = len(splats), splats.degree
    if version == 1:
        positions = splats.centers.astype("<f2").tobytes()
    else:
        fixed = np.round(splats.centers.astype(np.float64) * (1 << fraction)).astype(np.int64) & 0xFFFFFF
        positions = b"".join(int(v).to_bytes(3, "little") for v in fixed.ravel())
    byte = lambda v: np.clip(np.round(v), 0, 255).astype(np.uint8).tobytes()
    alphas = byte(splats.opacities * 255)
    colors = byte(splats.harmonics[:, 0] * (0.15 * 255) + 127.5)
    scales = byte((np.log(splats.scales) + 10) * 16)
    xyzw = splats.rotations[:, [1, 2, 3, 0]].astype(np.float64)
    if version < 3:
        signed = np.where(xyzw[:, 3:] < 0, -xyzw, xyzw)[:, :3]
        turns = byte(signed * 127.5 + 127.5)
    else:
        turns = b"".join(struct.pack("<I", _smallest_three(q)) for q in xyzw)
    rest = byte(splats.harmonics[:, 1:] * 128 + 128)
    head = struct.pack("<IIIBBBB", 0x5053474E, version, n, degree, fraction, 0, 0)
    path.write_bytes(gzip.compress(head + positions + alphas + colors + scales + turns + rest, mtime=0))


def _smallest_three(q: np.ndarray) -> int:
    largest = int(np.argmax(np.abs(q)))
    negate = q[largest] < 0
    packed = largest
    for i in range(4):
        if i != largest:
            sign = int((q[i] < 0) ^ negate)
            magnitude = int(511 * (abs(q[i]) / np.sqrt(0.5)) + 0.5)
            packed = packed << 10 | sign << 9 | magnitude
    return packed


def write_khronos(path: Path, splats: Splats, node: dict | None = None, shares: bool = False) -> None:
    """Write a primitive of KHR_gaussian_splatting. ``node``: its node; ``shares``: opacities as normalised bytes."""
    prefixed = "KHR_gaussian_splatting:"
    arrays = {
        "POSITION": splats.centers,
        prefixed + "ROTATION": splats.rotations[:, [1, 2, 3, 0]],
        prefixed + "SCALE": splats.scales,
        prefixed + "OPACITY": np.round(splats.opacities * 255).astype(np.uint8) if shares else splats.opacities,
    }
    k = 0
    for degree in range(splats.degree + 1):
        for n in range(2 * degree + 1):
            arrays[f"{prefixed}SH_DEGREE_{degree}_COEF_{n}"] = splats.harmonics[:, k]
            k += 1
    views, accessors, data = [], [], b""
    for values in arrays.values():
        kind = {"float32": 5126, "uint8": 5121}[values.dtype.name]
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes})
        shape = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        accessors.append({"bufferView": len(views) - 1, "componentType": kind, "count": len(values), "type": shape})
        accessors[-1] |= {"normalized": True} if kind == 5121 else {}
        data += np.ascontiguousarray(values).tobytes()
        data += b"\0" * (-len(data) % 4)
    primitive = {
        "mode": 0,
        "attributes": {name: i for i, name in enumerate(arrays)},
        "extensions": {"KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **(node or {})}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    path.write_bytes(b"".join(pack_glb(document, data)))


def write_sog(path: Path, splats: Splats, **changes) -> None:
    """Write a file of version 2 after the description of PlayCanvas, with codebooks of even steps and a palette entry
    per Gaussian. ``changes``: replaced values of ``meta.json``.
    """
    from PIL import Image

    count, width = len(splats), 8
    files: dict[str, bytes] = {}

    def add(name: str, pixels: np.ndarray) -> str:
        """Add an image (height, width, 4), or one of a pixel (N, channels) per Gaussian."""
        if pixels.ndim == 2:
            image = np.full((-(-len(pixels) // width) * width, 4), 255, np.uint8)
            image[: len(pixels), : pixels.shape[1]] = pixels
            pixels = image.reshape(-1, width, 4)
        stream = io.BytesIO()
        Image.fromarray(pixels).save(stream, "WEBP", lossless=True, exact=True)
        files[f"{name}.webp"] = stream.getvalue()
        return f"{name}.webp"

    def quantize(values: np.ndarray) -> tuple[list[float], np.ndarray]:
        codebook = np.linspace(values.min(), values.max(), 256)
        return codebook.tolist(), np.abs(values[..., None] - codebook).argmin(axis=-1).astype(np.uint8)

    logs = np.sign(splats.centers) * np.log1p(np.abs(splats.centers.astype(np.float64)))
    low, high = logs.min(axis=0), logs.max(axis=0)
    bits = np.rint((logs - low) / (high - low) * 65535).astype(int)
    means = [add("means_l", (bits & 255).astype(np.uint8)), add("means_u", (bits >> 8).astype(np.uint8))]
    q = splats.rotations / np.linalg.norm(splats.rotations, axis=1, keepdims=True)
    largest = np.abs(q).argmax(axis=1)
    q = q * np.sign(q[np.arange(count), largest])[:, None]
    rest = np.array([np.delete(row, k) for row, k in zip(q, largest)]) * np.sqrt(2)
    quats = add("quats", np.column_stack([np.rint((rest + 1) * 127.5), 252 + largest]).astype(np.uint8))
    scale_book, scale_index = quantize(np.log(splats.scales.astype(np.float64)))
    color_book, color_index = quantize(splats.harmonics[:, 0].astype(np.float64))
    alpha = np.rint(255 * splats.opacities.astype(np.float64)).astype(np.uint8)
    meta: dict = {
        "version": 2,
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": means},
        "quats": {"files": [quats]},
        "scales": {"codebook": scale_book, "files": [add("scales", scale_index)]},
        "sh0": {"codebook": color_book, "files": [add("sh0", np.column_stack([color_index, alpha]))]},
    }
    num_higher = splats.harmonics.shape[1] - 1
    if num_higher:
        book, index = quantize(splats.harmonics[:, 1:].astype(np.float64))
        palette = np.full((-(-count // 64) * 64, num_higher, 4), 255, np.uint8)
        palette[:count, :, :3] = index
        entries = np.arange(count)[::-1]  # The last Gaussian has the first entry
        palette[:count] = palette[:count][::-1]
        labels = np.column_stack([entries & 255, entries >> 8]).astype(np.uint8)
        centroids = add("shN_centroids", palette.reshape(-1, 64 * num_higher, 4))
        bands = int(np.sqrt(num_higher + 1)) - 1
        meta["shN"] = {"count": count, "bands": bands, "codebook": book}
        meta["shN"]["files"] = [centroids, add("shN_labels", labels)]
    for name, value in changes.items():
        part, _, key = name.rpartition("__")
        (meta[part] if part else meta)[key] = value
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in {"meta.json": json.dumps(meta).encode(), **files}.items():
            archive.writestr(name, data)
