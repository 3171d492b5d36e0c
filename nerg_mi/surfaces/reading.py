"""Shapes of Mitsuba scenes as triangles."""

from __future__ import annotations

from typing import Any

import numpy as np

Triangles = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) float64 and faces (F, 3) int64."""


def shape_triangles(shape: Any) -> Triangles | None:
    """Those of a shape of a Mitsuba scene, in the scene; None of a shape that has none."""
    if not shape.is_mesh():
        return None
    vertices = np.array(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    return vertices, np.array(shape.faces_buffer(), np.int64).reshape(-1, 3)
