"""The embedded 3D scene: what the page's own viewer (``viewer.js``) draws, packed into a few bytes a point.

Positions are 16 bits an axis of the points' box, normals and colours 8 bits a component, gaze the square root of its
share of the observer's own scale in 8 bits.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from nerg_mi.formats.regions import Region

from .proxy import Proxy

PATH_POINTS = 16_000
"""Positions of all people's paths together, at most."""

# Angle above the level from which the scene is shown at first, in radians.
_RISE = 0.85
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]


@dataclass(frozen=True)
class Camera:
    """From where the pictures are taken: a camera at ``origin`` that looks at ``target`` (3,)."""

    origin: np.ndarray
    target: np.ndarray


@dataclass(frozen=True, eq=False)
class Stage:
    """What is drawn: the ``proxy`` of the place; ``observers`` (M, 3), of whom it has the gaze; people's ``paths``,
    (n, 3) each; ``boxes``; ``up`` (3,); the ``camera``."""

    proxy: Proxy
    observers: np.ndarray
    paths: Sequence[np.ndarray]
    boxes: Sequence[Region]
    up: np.ndarray
    camera: Camera


def pack(stage: Stage) -> str:
    """The scene as JSON that is safe within a page, its arrays in base64."""
    proxy, M = stage.proxy, len(stage.observers)
    lower, size = _frame(stage)
    place = lambda points: _bits((np.asarray(points, np.float64).reshape(-1, 3) - lower) / size, 16)
    corners = [b.vertices[a] for b in stage.boxes for e in _EDGES for a in e]
    mean = proxy.gaze.mean(axis=0, keepdims=True) if M > 1 else proxy.gaze[:0]
    gaze = np.concatenate([mean, proxy.gaze, np.zeros((int(M == 0), len(proxy.vertices)))])
    tops = np.array([_top(values) for values in gaze])
    heat = np.sqrt(np.clip(gaze / np.where(tops > 0, tops, 1)[:, None], 0, 1))
    arrays = {
        "place": place(proxy.vertices),
        "paths": place(np.concatenate([np.zeros((0, 3)), *stage.paths])),
        "boxes": place(np.array(corners)),
        "marks": place(stage.observers),
        "normal": _bits(proxy.normals * 0.5 + 0.5, 8),
        "color": np.ascontiguousarray(proxy.colors, np.uint8),
        "gaze": _bits(heat, 8),
        "map": _color_map(),
    }
    parts, start = {}, 0
    for name, array in arrays.items():
        parts[name] = [start, array.nbytes]
        start += array.nbytes
    marks = [list(range(M))] if M != 1 else []
    marks += [[k] for k in range(M)]
    ends = np.cumsum([0, *(len(p) for p in stage.paths)]).tolist()
    about = {
        "count": len(proxy.vertices),
        "lower": _rounded(lower),
        "size": _rounded(size),
        "spacing": float(f"{proxy.spacing:.6g}"),
        "up": _rounded(stage.up),
        "reach": float(f"{np.linalg.norm(size):.6g}"),
        "camera": _orbit(stage),
        "observers": [{"marks": m, "top": float(f"{top:.3g}")} for m, top in zip(marks, tops)],
        "marks": M,
        "paths": [[a, b - a] for a, b in pairwise(ends)],
        "parts": parts,
        "data": base64.b64encode(b"".join(a.tobytes() for a in arrays.values())).decode(),
    }
    return json.dumps(about, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _frame(stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """Lower corner and edges of the box that holds everything that is drawn."""
    every = [stage.proxy.vertices, stage.observers, *stage.paths, *(b.bounds for b in stage.boxes)]
    points = np.concatenate([np.reshape(p, (-1, 3)) for p in every])
    lower = points.min(axis=0).astype(np.float64)
    return lower, np.maximum(points.max(axis=0) - lower, 1e-6)


def _top(gaze: np.ndarray) -> float:
    """The end of the scale of ``gaze`` (V,): what all but a few of the points that have any stay below; 0 for none."""
    positive = gaze[gaze > 0]
    return float(np.percentile(positive, 99)) if len(positive) else 0.0


def _orbit(stage: Stage) -> dict:
    """From where the scene is shown at first: above the middle of it, on the side of the camera. The axes beside ``up``
    are made as in ``viewer.js``."""
    up = np.asarray(stage.up, float)
    east = np.cross([0.0, 1, 0] if abs(up[1]) < 0.9 else [1.0, 0, 0], up)
    east /= np.linalg.norm(east)
    # A few points lie far away from all others.
    low, high = np.percentile(stage.proxy.vertices.astype(np.float64), [3, 97], axis=0)
    back = np.subtract(stage.camera.origin, (low + high) / 2)
    turn = math.atan2(float(back @ np.cross(up, east)), float(back @ east))
    away = 1.05 * float(np.linalg.norm(high - low))
    return {"turn": float(f"{turn:.6g}"), "rise": _RISE, "away": away, "target": _rounded((low + high) / 2)}


def _bits(shares: np.ndarray, bits: int) -> np.ndarray:
    """``shares`` in 0..1 as unsigned integers, little-endian."""
    top = (1 << bits) - 1
    return np.ascontiguousarray(np.round(np.clip(shares, 0, 1) * top), "<u2" if bits == 16 else "u1")


def _color_map() -> np.ndarray:
    import matplotlib

    return np.ascontiguousarray(matplotlib.colormaps["inferno"](np.linspace(0, 1, 256))[:, :3] * 255 + 0.5, np.uint8)


def _rounded(values: np.ndarray) -> list[float]:
    return [float(f"{v:.7g}") for v in np.asarray(values, float)]
