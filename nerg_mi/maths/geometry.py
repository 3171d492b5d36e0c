"""Boxes, bounded and contracted, ray-box intersection, and similarity transforms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.ranges import MAX_COORDINATE

from .coordinates import check_coordinates
from .transforms import check_rigid_transforms, correct_rotation
from .types import Array3f, Bool, Float, Point3f, Vector3f

# ---- The axis-aligned box of a field, and its map to the unit cube ----


@dataclass(frozen=True)
class Box:
    """An axis-aligned box with ``lower`` and ``upper`` corner, in the field's own units.

    One uniform scale about the centre maps points to the unit cube (grid cells stay cubes): the longest edge spans [0,
    1], the others a part of it. ``bound``: the unit cube is [-bound, bound]³ instead, which contains the box, and the
    map is torch-ngp's (p + bound) / (2 bound), with the same rounding: in a fine hash grid the last bit of a coordinate
    is visible.
    """

    lower: tuple[float, ...]  # Three coordinates each; any sequence is converted to a tuple
    upper: tuple[float, ...]
    bound: float | None = None  # Half the edge of the unit cube, if not half of the box's longest edge

    # Whether positions are contracted before they are encoded, and the size of the outer cube (`ContractedBox`).
    is_contracted: ClassVar[bool] = False
    outer_scale: ClassVar[float | None] = None

    def __post_init__(self):
        lower, upper = np.asarray(self.lower, float), np.asarray(self.upper, float)
        if lower.shape != (3,) or upper.shape != (3,) or not (np.abs([lower, upper]) <= MAX_COORDINATE).all():
            raise ValueError(
                f"a box needs two finite corners of 3 numbers within {MAX_COORDINATE:g}, "
                f"got {self.lower} and {self.upper}"
            )
        if not np.all(upper > lower):
            raise ValueError(f"the upper corner {self.upper} of a box must exceed its lower corner {self.lower}")
        farthest = max(np.abs(lower).max(), np.abs(upper).max())
        if self.bound is not None and not (np.isfinite(self.bound) and farthest <= self.bound):
            raise ValueError(f"a box of {self.lower} to {self.upper} does not lie within a bound of {self.bound}")
        object.__setattr__(self, "lower", tuple(lower.tolist()))
        object.__setattr__(self, "upper", tuple(upper.tolist()))

    @property
    def side(self) -> float:
        """Edge of the unit cube in the field's units: the longest edge without a ``bound``."""
        return 2 * self.bound if self.bound is not None else max(u - l for l, u in zip(self.lower, self.upper))

    @property
    def cube_side(self) -> float:
        """Edge, in the field's units, of the cube that `to_cube` maps to the unit cube."""
        return self.side

    @property
    def core(self) -> Box:
        """The part with the highest resolution: all of it."""
        return self

    @property
    def center(self) -> tuple[float, ...]:
        """Centre of the unit cube."""
        return (0.0, 0.0, 0.0) if self.bound is not None else tuple((l + u) / 2 for l, u in zip(self.lower, self.upper))

    @property
    def diagonal(self) -> float:
        return float(np.linalg.norm(np.subtract(self.upper, self.lower)))

    def to_unit(self, p: Any) -> Any:
        """Unit-cube coordinates of ``p`` (Array3f or array (N, 3))."""
        if self.bound is not None:
            return self._divided(p + self.bound, 2 * self.bound)
        if dr.is_array_v(p):
            return (p - type(p)(*self.center)) / self.side + 0.5
        return (np.asarray(p) - np.asarray(self.center)) / self.side + 0.5

    def from_unit(self, u: Array3f) -> Array3f:
        """The points (Array3f) at the unit-cube coordinates ``u``."""
        return (u - 0.5) * self.side + type(u)(*self.center)

    def to_cube(self, p: Array3f) -> Array3f:
        """``p`` (Array3f) in a unit cube in which lines stay straight: equal to `to_unit`."""
        return self.to_unit(p)

    def distance_scale(self, p: Array3f) -> Float | float:
        """Size of cells of the unit cube at ``p`` relative to the core: 1."""
        return 1.0

    def density_from_encoded(self, sigma: Float, p: Array3f) -> Float:
        """Density per unit of the field at ``p``, from ``sigma`` per unit of encoded coordinates: equal."""
        return sigma

    @staticmethod
    def _divided(x, divisor: float):
        """``x / divisor``, correctly rounded; Dr.Jit replaces division by a constant by multiplication with its
        reciprocal."""
        if not dr.is_array_v(x):
            return np.asarray(x) / np.asarray(x).dtype.type(divisor)
        inverse = float(np.float32(1 / divisor))
        quotient = x * inverse
        if np.frexp(divisor)[0] == 0.5:
            return quotient
        return dr.fma(dr.fma(-quotient, divisor, x), inverse, quotient)

    def contains(self, p: Array3f) -> Bool:
        """Mask of the points ``p`` (Array3f) inside the box."""
        return dr.all((p >= type(p)(*self.lower)) & (p <= type(p)(*self.upper)))

    def to_dict(self) -> dict:
        corners = {"lower": list(self.lower), "upper": list(self.upper)}
        return corners if self.bound is None else {**corners, "bound": self.bound}


# ---- Contraction ----
#
# Unbounded environments: a cube at full resolution, surrounded by contracted space up to a far bound.
#
# The map is that of mip-NeRF 360 (Barron et al. 2022, equation 10) with the maximum norm: for x in half edges of the
# inner cube and m = max |x_k|,
#
#     contract(x) = x where m <= 1,   (2 - 1 / m) x / m elsewhere,
#
# which fills the cube [-2, 2]^3 for unbounded m. Only the encoding uses contracted positions. Positions, distances and
# densities are those of the scene, and rays are straight.

DEFAULT_OUTER_SCALE = 64.0
"""Half edge of the outer cube, in half edges of the inner one. Objects beyond it move by less than a pixel as cameras
move within the inner cube."""


@dataclass(frozen=True)
class ContractedBox:
    """An inner cube around ``core``, with ``core``'s longest edge, and an outer cube ``outer_scale`` times as large.

    Same interface as `Box`. ``lower`` and ``upper`` bound everything that is marched; ``side``, the edge of the inner
    cube, is the length scale of the scene. ``outer_scale``: a power of two, at least 2. Raises ``ValueError`` for other
    values.
    """

    core: Box
    outer_scale: float = DEFAULT_OUTER_SCALE

    is_contracted: ClassVar[bool] = True
    bound: ClassVar[float | None] = None  # No `Box.bound`: the unit cube follows from the core

    def __post_init__(self):
        if not (2 <= self.outer_scale <= 2**12 and np.frexp(self.outer_scale)[0] == 0.5):
            raise ValueError(
                f"the outer scale of a contracted box must be a power of two from 2 to 4096, got {self.outer_scale}"
            )
        if self.core.bound is not None:
            raise ValueError("the core of a contracted box cannot have a bound of its own")

    @property
    def side(self) -> float:
        """Edge of the inner cube in the field's units."""
        return self.core.side

    @property
    def cube_side(self) -> float:
        """Edge of the outer cube in the field's units."""
        return self.core.side * self.outer_scale

    @property
    def center(self) -> tuple[float, ...]:
        return self.core.center

    @property
    def lower(self) -> tuple[float, ...]:
        return tuple(c - self.cube_side / 2 for c in self.center)

    @property
    def upper(self) -> tuple[float, ...]:
        return tuple(c + self.cube_side / 2 for c in self.center)

    @property
    def diagonal(self) -> float:
        """Diagonal of the outer cube."""
        return 3**0.5 * self.cube_side

    def _halves(self, p):
        """``p`` (Array3f) relative to the centre in half edges of the inner cube, and its maximum norm, at least 1."""
        x = (p - type(p)(*self.center)) * (2 / self.side)
        return x, dr.maximum(dr.maximum(dr.maximum(dr.abs(x.x), dr.abs(x.y)), dr.abs(x.z)), 1)

    def to_unit(self, p: Any) -> Any:
        """Encoded position of ``p`` (Array3f) in the unit cube, of which the inner cube is the middle half."""
        x, m = self._halves(p)
        inverse = dr.rcp(m)
        return x * ((2 - inverse) * inverse * 0.25) + 0.5

    def from_unit(self, u: Array3f) -> Array3f:
        """The points (Array3f) with encoded positions ``u``; those beyond the outer cube are moved to its faces."""
        y = (u - 0.5) * 4
        n = dr.maximum(dr.maximum(dr.maximum(dr.abs(y.x), dr.abs(y.y)), dr.abs(y.z)), 1)
        scale = dr.rcp(n * dr.maximum(2 - n, 1 / self.outer_scale))
        return y * (scale * (0.5 * self.side)) + type(y)(*self.center)

    def distance_scale(self, p: Array3f) -> Float | float:
        """Distance of ``p`` (Array3f) from the centre relative to the face of the inner cube; 1 inside the cube."""
        return self._halves(p)[1]

    def density_from_encoded(self, sigma: Float, p: Array3f) -> Float:
        """Density per unit of the field at ``p`` (Array3f), from ``sigma`` per unit of encoded coordinates along the
        radius: σ / m².

        A field without structure then absorbs no more outside than inside.
        """
        return sigma * dr.rcp(dr.square(self._halves(p)[1]))

    def to_cube(self, p: Array3f) -> Array3f:
        """``p`` (Array3f) in coordinates in which the outer cube is the unit cube; lines stay straight."""
        return (p - type(p)(*self.center)) / self.cube_side + 0.5

    contains = Box.contains

    def to_dict(self) -> dict:
        return {**self.core.to_dict(), "reach": self.outer_scale}


AnyBox = Box | ContractedBox  # The domain of a field; both have the same interface


def box_from_dict(data: dict) -> AnyBox:
    """The inverse of ``to_dict``. Raises ``ValueError`` or ``TypeError`` for invalid data."""
    fields = dict(data)
    outer_scale = fields.pop("reach", None)
    return Box(**fields) if outer_scale is None else ContractedBox(Box(**fields), float(outer_scale))


# ---- Ray-box intersection (slab method) ----


def intersect_box(o: Array3f, d: Array3f, lower: Sequence[Any], upper: Sequence[Any]) -> tuple[Float, Float]:
    """Parameters ``(t_near, t_far)`` at which ``o + t d`` enters and leaves the box.

    The ray misses the box if ``t_near >= t_far``; ``t_near`` can be negative. A zero component of ``d`` never divides:
    such a ray is inside that slab for all t or for none.

    Parameters
    ----------
    o, d : Array3f
        Origin and direction, of any length.
    lower, upper : sequence
        3 numbers each, which become literals of the kernel, or 3 Floats, which are variables.
    """
    Float = type(o.x)
    lower, upper = ([v if dr.is_array_v(v) else float(v) for v in corner] for corner in (lower, upper))
    near, far = Float(-dr.inf), Float(dr.inf)
    for oc, dc, lo, hi in zip((o.x, o.y, o.z), (d.x, d.y, d.z), lower, upper):
        parallel = dc == 0
        inverse = 1 / dr.select(parallel, 1, dc)
        a, b = (lo - oc) * inverse, (hi - oc) * inverse
        outside = parallel & ((oc < lo) | (oc > hi))
        t_in = dr.select(parallel, -dr.inf, dr.minimum(a, b))
        t_out = dr.select(parallel, dr.select(outside, -dr.inf, dr.inf), dr.maximum(a, b))
        near, far = dr.maximum(near, t_in), dr.minimum(far, t_out)
    return near, far


def intersect_box_numpy(
    o: ArrayLike, d: ArrayLike, lower: ArrayLike, upper: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """`intersect_box` for NumPy rays: ``o``, ``d`` broadcast to (N, 3); returns ``t_near`` and ``t_far`` (N,), infinite
    for a ray that never leaves its slabs."""
    near, far = -np.inf, np.inf
    # Per axis: NumPy reductions over three numbers take several times as long.
    for oc, dc, lo, hi in zip(*(np.moveaxis(np.asarray(v), -1, 0) for v in (o, d, lower, upper))):
        parallel = dc == 0
        divisor = np.where(parallel, 1, dc)
        with np.errstate(over="ignore"):
            a, b = (lo - oc) / divisor, (hi - oc) / divisor
        outside = parallel & ((oc < lo) | (oc > hi))
        near = np.maximum(near, np.where(parallel, -np.inf, np.minimum(a, b)))
        far = np.minimum(far, np.where(parallel, np.where(outside, -np.inf, np.inf), np.maximum(a, b)))
    return np.asarray(near), np.asarray(far)


# ---- Similarity transforms: placement of a field in a scene ----


class Similarity:
    """A rotation, uniform scale and translation: the ``to_world`` of a field.

    ``matrix``: (4, 4), local (field) to world (scene); default: the identity. ``scale``: length in the scene of one
    unit of the field. Raises ``NergError`` for a shear, a reflection or a non-uniform scale, for which densities and
    directions have no single scale, and for a translation beyond `MAX_COORDINATE`. Rounding errors of the rotation up
    to `ROTATION_TOLERANCE` are removed.
    """

    def __init__(self, matrix: np.ndarray | None = None):
        name = '"to_world" of a field or an alignment'
        matrix = np.eye(4) if matrix is None else matrix
        m = check_rigid_transforms(matrix, name, may_scale=True, shape=(4, 4)).copy()
        check_coordinates(m[None, :3, 3], 'the translation of "to_world"')
        m[:3, :3], m[3] = correct_rotation(m[:3, :3]), (0, 0, 0, 1)
        self.matrix, self.scale = m, float(np.linalg.det(m[:3, :3]) ** (1 / 3))
        self.inverse = np.linalg.inv(m)
        self.is_identity = bool(np.array_equal(m, np.eye(4)))

    def point_to_local(self, p: Point3f) -> Point3f:
        """A scene point in field coordinates."""
        return p if self.is_identity else self._apply(self.inverse, p, 1)

    def vector_to_local(self, v: Vector3f) -> Vector3f:
        """A scene vector in field coordinates; a unit vector gets the length 1 / scale."""
        return v if self.is_identity else self._apply(self.inverse, v, 0)

    def direction_to_local(self, v: Vector3f) -> Vector3f:
        """A unit scene direction as a unit field direction."""
        return v if self.is_identity else self._apply(self.inverse * self.scale, v, 0)

    def bounds(self, lower: Sequence[float], upper: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner, (3,) each, of the scene's axis-aligned box around the field's box with corners
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
