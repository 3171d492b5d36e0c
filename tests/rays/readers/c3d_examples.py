"""C3D files, written after the format's manual (c3d.org) and without the package that reads them."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np


def _entry(name: str, number: int, body: bytes) -> bytes:
    return struct.pack("bb", len(name), number) + name.encode() + struct.pack("<h", len(body) + 3) + body + b"\0"


def _words(*texts: str) -> bytes:
    width = max(map(len, texts))
    shape = [width, len(texts)] if len(texts) > 1 else [width]
    return bytes([0xFF, len(shape), *shape]) + "".join(t.ljust(width) for t in texts).encode()


def write_c3d(
    path: Path,
    labels: Sequence[str],
    positions: np.ndarray,
    *,
    rate: float = 100.0,
    units: str | None = "mm",
    up: str | None = "+Z",
    frames: int | None = None,
) -> None:
    """Write ``positions`` (F, M, 3), NaN where a marker was not seen. ``frames``: how many the header claims."""
    count, markers = positions.shape[:2]
    claimed = count if frames is None else frames
    parameters = [
        _entry("POINT", -1, b""),
        _entry("USED", 1, b"\2\0" + struct.pack("<H", markers)),
        _entry("SCALE", 1, b"\4\0" + struct.pack("<f", -1.0)),
        _entry("RATE", 1, b"\4\0" + struct.pack("<f", rate)),
        _entry("FRAMES", 1, b"\2\0" + struct.pack("<H", claimed)),
        _entry("LABELS", 1, _words(*labels)),
    ]
    if units is not None:
        parameters.append(_entry("UNITS", 1, _words(units)))
    if up is not None:
        parameters += [_entry("X_SCREEN", 1, _words("+X")), _entry("Y_SCREEN", 1, _words(up))]
    blocks = -(-(4 + sum(map(len, parameters)) + 2) // 512)
    parameters.append(_entry("DATA_START", 1, b"\2\0" + struct.pack("<H", 2 + blocks)))
    header = struct.pack("<BBHHHHHfHHf", 2, 0x50, markers, 0, 1, claimed, 10, -1.0, 2 + blocks, 0, rate)
    unseen = np.asarray(np.isnan(positions).any(axis=2))
    points = np.concatenate([np.where(unseen[..., None], 0, positions), np.where(unseen, -1.0, 0.0)[..., None]], axis=2)
    body = bytes([1, 0x50, blocks, 84]) + b"".join(parameters)
    path.write_bytes(header.ljust(512, b"\0") + body.ljust(512 * blocks, b"\0") + points.astype("<f4").tobytes())


def write_heads(path: Path) -> None:
    """A head with the four markers of Plug-in Gait that walks along x and looks along it, and a marker of the trunk."""
    head = np.array([[70, 60, 1700], [70, -60, 1700], [-90, 60, 1700], [-90, -60, 1700], [0, 0, 1300]], float)
    walk = np.arange(20)[:, None, None] * [10.0, 0, 0]
    write_c3d(path, ["LFHD", "RFHD", "LBHD", "RBHD", "C7"], head + walk)
