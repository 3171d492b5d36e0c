"""Rotations, uniform scales and translations: what places a field in a scene."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError

from .coordinates import check_coordinates
from .types import Array3f, Point3f, Vector3f


class Similarity:
    """A rotation, uniform scale and translation: a field's ``to_world``.

    ``matrix``: (4, 4), local (the field's) to world (the scene's); the identity by default. ``scale``: length in the
    scene of one unit of the field. Raises ``NergError`` when it shears, mirrors or scales
    unevenly: densities and directions would then have no single scale; and for a translation beyond `FARTHEST`.
    """

    def __init__(self, matrix: np.ndarray | None = None):
        m = np.eye(4) if matrix is None else np.asarray(matrix, float)
        linear = m[:3, :3]
        determinant = np.linalg.det(linear) if np.all(np.isfinite(m)) else np.nan
        scale = abs(determinant) ** (1 / 3)
        if not (
            determinant > 0
            and np.array_equal(m[3], [0, 0, 0, 1])
            and np.allclose(linear @ linear.T, scale**2 * np.eye(3), atol=1e-4 * scale**2)
        ):
            raise NergError(
                '"to_world" of a field must be a rotation, a uniform scale and a translation; bake any other '
                "transform into the field's training data"
            )
        check_coordinates(m[None, :3, 3], 'the translation of "to_world"')
        self.matrix, self.scale = m, float(scale)
        self.inverse = np.linalg.inv(m)
        self.identity = bool(np.array_equal(m, np.eye(4)))

    def point_to_local(self, p: Point3f) -> Point3f:
        """A scene point in field coordinates."""
        return p if self.identity else self._apply(self.inverse, p, 1)

    def vector_to_local(self, v: Vector3f) -> Vector3f:
        """A scene vector in field coordinates; a unit vector becomes 1 / scale long."""
        return v if self.identity else self._apply(self.inverse, v, 0)

    def direction_to_local(self, v: Vector3f) -> Vector3f:
        """A unit scene direction as a unit field direction."""
        return v if self.identity else self._apply(self.inverse * self.scale, v, 0)

    def bounds(self, lower: Sequence[float], upper: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner, (3,) each, of the scene's axis-aligned box around the field's box with the corners
        ``lower`` and ``upper``."""
        corners = np.array(
            [[x, y, z, 1] for x in (lower[0], upper[0]) for y in (lower[1], upper[1]) for z in (lower[2], upper[2])]
        )
        p = (corners @ self.matrix.T)[:, :3]
        return p.min(0), p.max(0)

    @staticmethod
    def _apply(m: np.ndarray, v: Array3f, w: float) -> Array3f:
        """``m`` (4, 4) times ``v``, whose fourth coordinate is ``w``."""
        rows = [dr.fma(a, v.x, dr.fma(b, v.y, dr.fma(c, v.z, w * e))) for a, b, c, e in m[:3].tolist()]
        return type(v)(*rows)
