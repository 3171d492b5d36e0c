"""The embedded 3D scene: what the page's own viewer (``viewer.js``) draws, packed into a few bytes a point.

Positions are 16 bits an axis of the points' box, normals and colours 8 bits a component, gaze the square root of its
share of a common scale in 8 bits.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .boxes import Box
from .proxy import Proxy

PATH_POINTS = 6000
"""Positions of all people's paths together, at most."""

_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)]


@dataclass(frozen=True)
class Camera:
    """From where the scene is shown at first: a camera at ``origin`` that looks at ``target`` (3,)."""

    origin: np.ndarray
    target: np.ndarray


@dataclass(frozen=True, eq=False)
class Stage:
    """What is drawn: the ``proxy`` of the place; ``observers`` (M, 3), of whom it has the gaze; people's ``paths``,
    (n, 3) each; ``boxes``; ``up`` (3,); the ``camera``; ``top``: gaze (1/sr) at the end of the scale."""

    proxy: Proxy
    observers: np.ndarray
    paths: Sequence[np.ndarray]
    boxes: Sequence[Box]
    up: np.ndarray
    camera: Camera
    top: float


def pack(stage: Stage) -> str:
    """The scene as JSON that is safe within a page, its arrays in base64."""
    proxy, M = stage.proxy, len(stage.observers)
    lower, size = _frame(stage)
    place = lambda points: _bits((np.asarray(points, np.float64).reshape(-1, 3) - lower) / size, 16)
    corners = [
        np.where([[a >> k & 1 for k in range(3)]], b.upper, b.lower)[0] for b in stage.boxes for e in _EDGES for a in e
    ]
    gaze = np.concatenate([np.zeros((0, len(proxy.vertices))), proxy.gaze])
    mean = gaze.mean(axis=0, keepdims=True) if M > 1 else gaze[:0]
    heat = np.sqrt(np.clip(np.concatenate([mean, gaze]) / stage.top, 0, 1)) if M else np.zeros((1, len(proxy.vertices)))
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
    names = [{"marks": [k]} for k in range(M)]
    everyone = [{"marks": list(range(M))}] if M != 1 else []
    ends = np.cumsum([0, *(len(p) for p in stage.paths)]).tolist()
    about = {
        "count": len(proxy.vertices),
        "lower": _rounded(lower),
        "size": _rounded(size),
        "spacing": float(f"{proxy.spacing:.6g}"),
        "up": _rounded(stage.up),
        "reach": float(f"{np.linalg.norm(size):.6g}"),
        "camera": _orbit(stage),
        "observers": [*everyone, *names],
        "marks": M,
        "paths": [[a, b - a] for a, b in pairwise(ends)],
        "parts": parts,
        "data": base64.b64encode(b"".join(a.tobytes() for a in arrays.values())).decode(),
    }
    return json.dumps(about, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def thin_path(points: np.ndarray, most: int) -> np.ndarray:
    """Up to ``most`` of ``points`` (n, 3), evenly chosen, with the first and the last."""
    return (
        points[np.unique(np.linspace(0, len(points) - 1, max(2, most)).round().astype(int))] if len(points) else points
    )


def _frame(stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """Lower corner and edges of the box that holds everything that is drawn."""
    every = [stage.proxy.vertices, stage.observers, *stage.paths, *(b.lower for b in stage.boxes)]
    points = np.concatenate([np.reshape(p, (-1, 3)) for p in [*every, *(b.upper for b in stage.boxes)]])
    lower = points.min(axis=0).astype(np.float64)
    return lower, np.maximum(points.max(axis=0) - lower, 1e-6)


def _orbit(stage: Stage) -> dict:
    """The camera as the viewer has it: angles around a target. Its axes beside ``up`` are made as in ``viewer.js``."""
    up = np.asarray(stage.up, float)
    east = np.cross([0.0, 1, 0] if abs(up[1]) < 0.9 else [1.0, 0, 0], up)
    east /= np.linalg.norm(east)
    back = np.subtract(stage.camera.origin, stage.camera.target)
    away = float(np.linalg.norm(back))
    rise = math.asin(float(np.clip(back @ up / max(away, 1e-9), -1, 1)))
    turn = math.atan2(float(back @ np.cross(up, east)), float(back @ east))
    return {"turn": turn, "rise": rise, "away": away, "target": _rounded(stage.camera.target)}


def _bits(shares: np.ndarray, bits: int) -> np.ndarray:
    """``shares`` in 0..1 as unsigned integers, little-endian."""
    top = (1 << bits) - 1
    return np.ascontiguousarray(np.round(np.clip(shares, 0, 1) * top), "<u2" if bits == 16 else "u1")


def _color_map() -> np.ndarray:
    import matplotlib

    return np.ascontiguousarray(matplotlib.colormaps["inferno"](np.linspace(0, 1, 256))[:, :3] * 255 + 0.5, np.uint8)


def _rounded(values: np.ndarray) -> list[float]:
    return [float(f"{v:.7g}") for v in np.asarray(values, float)]
