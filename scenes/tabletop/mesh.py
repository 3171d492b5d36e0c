"""Mesh construction: triangles with normals and texture coordinates, grouped by material.

Frame: x east, y north, z up, metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

FULL_PATCH = (0.0, 0.0, 1.0, 1.0)
"""Texture coordinates of a face that shows the whole texture: u0, v0, u1, v1."""
_QUAD = np.array([(0, 2, 3), (0, 3, 1)])


class Mesh(NamedTuple):
    """``points`` (V, 3) in metres, unit ``normals`` (V, 3), ``uv`` (V, 2), ``faces`` (F, 3)."""

    points: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    faces: np.ndarray

    @property
    def triangles(self) -> np.ndarray:
        """Corners (F, 3, 3)."""
        return self.points[self.faces]


@dataclass
class MeshBuilder:
    """Geometry under construction: ``parts``, lists of meshes by the name of their material."""

    parts: dict[str, list[Mesh]] = field(default_factory=dict)

    def join_meshes(self) -> dict[str, Mesh]:
        """Join the meshes of each material."""
        return {material: _join(parts) for material, parts in self.parts.items()}

    def add_surface(self, material: str, points, patch=FULL_PATCH) -> None:
        """Add a smooth surface through a grid of ``points`` (N, M, 3); u runs along the second axis, v along the first.

        Its normals are those of the derivatives along both axes; shading does not depend on their sign.
        """
        points = np.asarray(points, float)
        n, m = points.shape[:2]
        normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        v, u = np.meshgrid(np.linspace(patch[1], patch[3], n), np.linspace(patch[0], patch[2], m), indexing="ij")
        corner = (np.arange(n - 1)[:, None] * m + np.arange(m - 1)).reshape(-1, 1)
        faces = np.concatenate([corner + (0, m, m + 1), corner + (0, m + 1, 1)])
        uv = np.stack([u, v], axis=-1).reshape(-1, 2)
        self.parts.setdefault(material, []).append(Mesh(points.reshape(-1, 3), normals.reshape(-1, 3), uv, faces))

    def add_quad(self, material: str, corner, along, up, tile: float | None = None, patch=FULL_PATCH) -> None:
        """Add a parallelogram. Its texture repeats every ``tile`` metres from the origin, or shows ``patch`` once."""
        corner, along, up = (np.asarray(v, float) for v in (corner, along, up))
        if tile is not None:
            size = np.sqrt(along @ along), np.sqrt(up @ up)
            first = corner @ along / size[0] / tile, corner @ up / size[1] / tile
            patch = (*first, first[0] + size[0] / tile, first[1] + size[1] / tile)
        points = np.stack([corner, corner + along, corner + up, corner + along + up])
        a, b = up, along
        normal = np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
        normals = np.tile(normal / np.sqrt(normal @ normal), (4, 1))
        u0, v0, u1, v1 = patch
        uv = np.array([(u0, v0), (u1, v0), (u0, v1), (u1, v1)])
        self.parts.setdefault(material, []).append(Mesh(points, normals, uv, _QUAD))

    def add_box(
        self, material: str, lo, hi, tile: float | None = None, patch=FULL_PATCH, yaw: float = 0.0, skip=""
    ) -> None:
        """Add a box with upright sides, textured as in `add_quad`.

        ``yaw`` rotates it about its vertical axis (radians). ``skip`` lists faces that are left out, of "wensbt" (west,
        east, north, south, bottom, top).
        """
        lo, hi = np.minimum(lo, hi).astype(float), np.maximum(lo, hi).astype(float)
        x, y, z = np.diag(hi - lo)
        sides = {
            "w": (lo + y, -y, z),
            "e": (lo + x, y, z),
            "n": (hi - z, -x, z),
            "s": (lo, x, z),
            "b": (lo + y, x, -y),
            "t": (lo + z, x, y),
        }
        middle = (lo + hi) / 2
        rotation = rotate_about_z(yaw)
        for name, (corner, along, up) in sides.items():
            if name not in skip:
                self.add_quad(
                    material, middle + rotation @ (corner - middle), rotation @ along, rotation @ up, tile, patch
                )

    def add_revolved(self, material: str, centre, profile, around: int = 48, patch=FULL_PATCH) -> None:
        """Add the surface of revolution of a ``profile`` of radii and heights (N, 2) about the vertical through
        ``centre``.
        """
        r, h = np.asarray(profile, float).T
        angle = np.linspace(0, 2 * np.pi, around + 1)
        ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
        self.add_surface(material, centre + r[:, None, None] * ring + h[:, None, None] * np.array([0, 0, 1.0]), patch)

    def add_ball(
        self, material: str, centre, radius, lumps: float = 0.0, rng=None, patch=FULL_PATCH, steps: int = 24
    ) -> None:
        """Add an ellipsoid of ``radius`` (a number or three). ``lumps`` is the displacement by waves drawn from
        ``rng``, in radii.
        """
        polar, azimuth = np.meshgrid(np.linspace(np.pi - 0.01, 0.01, steps), np.linspace(0, 2 * np.pi, 2 * steps))
        r, z = np.sin(polar.T), np.cos(polar.T)
        d = np.stack([r * np.cos(azimuth.T), r * np.sin(azimuth.T), z], axis=-1)
        gain = np.ones(d.shape[:2])
        if lumps:
            for wave, phase in zip(rng.normal(0, 5, (6, 3)), rng.uniform(0, 2 * np.pi, 6)):
                gain += lumps / 2 * np.sin(d @ wave + phase)
        self.add_surface(material, centre + gain[..., None] * d * np.broadcast_to(radius, 3), patch)

    def add_tube(self, material: str, path, radius: float, around: int = 10) -> None:
        """Add a tube along a ``path`` (N, 3), open at its ends."""
        path = np.asarray(path, float)
        along = np.gradient(path, axis=0)
        side = np.cross(along, (0.31, 0.87, 0.38))
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        other = np.cross(along, side)
        other /= np.linalg.norm(other, axis=1, keepdims=True)
        angle = np.linspace(0, 2 * np.pi, around + 1)[:, None]
        ring = np.cos(angle) * side[:, None] + np.sin(angle) * other[:, None]
        self.add_surface(material, path[:, None] + radius * ring)


def rotate_about_z(yaw: float) -> np.ndarray:
    """Return the rotation (3, 3) about z by ``yaw`` radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([(c, -s, 0), (s, c, 0), (0, 0, 1.0)])


def _join(parts: list[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(p.points) for p in parts[:-1])])
    faces = np.concatenate([p.faces + s for p, s in zip(parts, starts)])
    points, normals, uv = (np.concatenate([getattr(p, k) for p in parts]) for k in ("points", "normals", "uv"))
    return Mesh(points, normals, uv, faces)
