"""SOG files (PlayCanvas, version 2): Gaussian splats in lossless WebP images within a zip archive."""

from __future__ import annotations

import io
import os
import warnings
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np

from nerg_mi.errors import sanitize
from nerg_mi.fields.splats import Splats, scales_from_logs
from nerg_mi.files.safe_read import open_zip, parse_json, read_member, translate_read_errors
from nerg_mi.files.schema import NUMBER, Items, Number, check_json

# Each pixel of an image belongs to one Gaussian, in rows from the top. Positions have 16 bits per axis in two images,
# scales and colours are indices into codebooks, and higher harmonics are indices into a palette, whose image has 64
# entries per row. The format is described at developer.playcanvas.com (user manual, Gaussian splatting).

MAX_SOG_GAUSSIANS = 50_000_000
_MAX_PIXELS = 1 << 26  # Of an image
_CODEBOOK = 256  # Entries of a codebook
_PALETTE_COLUMNS, _MAX_PALETTE = 64, 1 << 16
_LARGEST_IS_FIRST = 252  # Alpha of a quaternion whose largest component is w; 253 to 255: x, y, z
_KIND = "splat file"
_FILES, _ENDS, _VALUES = Items(str, 1), Items(NUMBER, 3, 3), Items(NUMBER, _CODEBOOK, _CODEBOOK)
_META = {
    "count": Number(1, MAX_SOG_GAUSSIANS, is_integer=True),
    "means": {"mins": _ENDS, "maxs": _ENDS, "files": Items(str, 2)},
    "scales": {"codebook": _VALUES, "files": _FILES},
    "quats": {"files": _FILES},
    "sh0": {"codebook": _VALUES, "files": _FILES},
    "shN?": {
        "count": Number(1, _MAX_PALETTE, is_integer=True),
        "bands": Number(1, 3, is_integer=True),
        "codebook": _VALUES,
        "files": Items(str, 2),
    },
}


def read_sog(path: str | os.PathLike) -> Splats:
    """Read the Gaussian splats in ``path``. Raises `NergError` for a damaged file and for other versions."""
    convert = f'convert it by: npx @playcanvas/splat-transform "{Path(path).name}" out.ply'
    with open_zip(path, _KIND) as archive, translate_read_errors(path, _KIND, convert):
        meta: Any = parse_json(bytes(read_member(archive, "meta.json", path, _KIND)), path, _KIND)
        version = check_json(meta, {}).get("version")
        if version != 2:
            raise ValueError(f"its version is {sanitize(version, 40)}, not 2")
        count = check_json(meta, _META)["count"]
        read = lambda part, index=0: _read_image(archive, path, meta[part]["files"][index])
        pixels = lambda part, index=0: _take_gaussians(read(part, index), count, part)
        low, high = pixels("means", 0)[:, :3], pixels("means", 1)[:, :3]
        ends = np.array([meta["means"]["mins"], meta["means"]["maxs"]], np.float64).reshape(2, 3)
        logs = ends[0] + (low + 256.0 * high) / 65535 * (ends[1] - ends[0])
        centers = np.copysign(np.expm1(np.abs(logs)), logs)
        base = pixels("sh0")
        harmonics = _read_codebook(meta["sh0"])[base[:, None, :3]]
        if "shN" in meta:
            palette = _read_palette(read("shN"), meta["shN"])
            labels = pixels("shN", 1)
            index = labels[:, 0] + 256 * labels[:, 1].astype(np.int64)
            if index.max() >= len(palette):
                raise ValueError(f"a Gaussian has the palette entry {index.max()} of {len(palette)}")
            harmonics = np.concatenate([harmonics, palette[index]], axis=1)
        scales = scales_from_logs(_read_codebook(meta["scales"])[pixels("scales")[:, :3]])
        return Splats(centers, scales, _decode_quaternions(pixels("quats")), base[:, 3] / 255.0, harmonics)


def _read_image(archive: ZipFile, path: str | os.PathLike, name: str) -> np.ndarray:
    """Read an image of the archive: (height, width, 4), bytes."""
    from PIL import Image

    with warnings.catch_warnings():
        # Pillow's own limit is a warning and then an error that is no `ValueError`; ours is lower.
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        try:
            with Image.open(io.BytesIO(read_member(archive, name, path, _KIND))) as image:
                if image.width * image.height <= _MAX_PIXELS:
                    return np.asarray(image.convert("RGBA"))
        except Image.DecompressionBombError:
            pass
    raise ValueError(f'its image "{sanitize(name)}" has more than {_MAX_PIXELS:,} pixels, the limit')


def _take_gaussians(image: np.ndarray, count: int, part: str) -> np.ndarray:
    """Return the pixels (count, 4) of the Gaussians."""
    pixels = image.reshape(-1, 4)
    if len(pixels) < count:
        raise ValueError(f'its image of "{part}" has {len(pixels):,} pixels for {count:,} Gaussians')
    return pixels[:count]


def _read_codebook(part: dict) -> np.ndarray:
    return np.array(part["codebook"], np.float64)


def _read_palette(image: np.ndarray, part: dict) -> np.ndarray:
    """Return the palette (P, K, 3) of the K harmonics above degree 0."""
    size, bands = part["count"], part["bands"]
    num_harmonics = (bands + 1) ** 2 - 1
    rows = -(-size // _PALETTE_COLUMNS)
    if image.shape[0] < rows or image.shape[1] != _PALETTE_COLUMNS * num_harmonics:
        raise ValueError(f"the image of its palette has {image.shape[1]} x {image.shape[0]} pixels")
    return _read_codebook(part)[image[:rows, :, :3].reshape(-1, num_harmonics, 3)[:size]]


def _decode_quaternions(pixels: np.ndarray) -> np.ndarray:
    """Decode quaternions (N, 4), w first, from their three smaller components."""
    largest = pixels[:, 3].astype(int) - _LARGEST_IS_FIRST
    if largest.min() < 0:
        raise ValueError("a rotation has no largest component")
    smaller = (pixels[:, :3] / 127.5 - 1) * np.sqrt(0.5)
    out = np.empty((len(pixels), 4))
    columns = np.arange(4)
    out[columns != largest[:, None]] = smaller.ravel()
    out[np.arange(len(out)), largest] = np.sqrt(np.maximum(0, 1 - (smaller**2).sum(axis=1)))
    return out
