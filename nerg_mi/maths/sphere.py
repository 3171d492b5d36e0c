"""The unit sphere: sets of directions with their solid angles, and real spherical harmonics."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from .types import UInt32, Vector3f, variant_types

# ---- Sets of directions on the unit sphere, with solid angles ----
#
# Directions are (N, 3) float64 unit vectors. Solid angles are in steradian and sum to 4π, so that ``sum(density *
# solid_angle)`` is the integral of a density.

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def fibonacci_directions(count: int, indices: np.ndarray | None = None) -> np.ndarray:
    """``count`` directions of equal area on a golden-angle spiral, (count, 3); ``indices`` (N,): only these, (N, 3).

    Each direction covers 4π/count sr. The spiral runs from +z to -z: direction i has z = 1 - (2i + 1)/count. Neighbours
    are about sqrt(4π/count) rad apart, 4.5 degrees for 2,048 directions; narrower densities are not resolved (Swinbank
    & Purser 2006). Raises ``ValueError`` for a count below 1.
    """
    if count < 1:
        raise ValueError(f"count is {count}; a set of directions needs at least one")
    i = np.arange(count) if indices is None else np.asarray(indices)
    z = 1.0 - (2.0 * i + 1.0) / count
    return _from_height(z, i * _GOLDEN_ANGLE)


def indices_in_cone(count: int, axis: np.ndarray, angle: float) -> np.ndarray:
    """Sorted indices (N,) of the `fibonacci_directions` within ``angle`` (radian) of the unit ``axis`` (3,).

    Only the turns of the spiral at the heights of the cone are evaluated.
    """
    if angle >= np.pi:
        return np.arange(count)
    polar = np.arccos(np.clip(axis[2], -1.0, 1.0))
    top, bottom = np.cos(max(polar - angle, 0.0)), np.cos(min(polar + angle, np.pi))
    first = max(int(np.floor((1.0 - top) * count / 2 - 0.5)), 0)
    last = min(int(np.ceil((1.0 - bottom) * count / 2 - 0.5)), count - 1)
    numbers = np.arange(first, last + 1)
    return numbers[fibonacci_directions(count, numbers) @ axis >= np.cos(angle)]


def fibonacci_directions_jit(count: int, indices: UInt32 | None = None) -> Vector3f:
    """`fibonacci_directions` as a Vector3f of the current Mitsuba variant, in its precision; ``indices``: only these.

    Computed by kernels, since frozen functions cannot contain arrays of NumPy.
    """
    import drjit as dr

    mi = variant_types()
    indices = dr.arange(mi.UInt32, count) if indices is None else indices
    z = 1 - (2 * mi.Float(indices) + 1) / count
    # Whole turns of the golden angle are removed in double precision.
    turns = mi.Float64(indices) * (1.5 - 0.5 * math.sqrt(5))
    sin, cos = dr.sincos(mi.Float(dr.two_pi * (turns - dr.floor(turns))))
    r = dr.sqrt((1 - z) * (1 + z))
    return mi.Vector3f(r * cos, r * sin, z)


@lru_cache(maxsize=8)
def morton_order(count: int) -> np.ndarray:
    """The indices (count,) uint32 of `fibonacci_directions` in Morton order (1966), so that neighbours follow each
    other.

    Rays that are traced together then traverse similar parts of the scene; in spiral order they do not.
    """
    order = sort_directions(fibonacci_directions(count))
    order.flags.writeable = False
    return order


def sort_directions(directions: np.ndarray) -> np.ndarray:
    """The indices (N,) uint32 of unit ``directions`` (N, 3) in Morton order, so that neighbours follow each other."""
    return np.argsort(_morton(directions), kind="stable").astype(np.uint32)


def _morton(d: np.ndarray) -> np.ndarray:
    """Morton index of the cell of unit directions (N, 3), 1024 cells per axis."""
    code = np.zeros(len(d), np.uint32)
    for axis in range(3):
        bits = np.clip((d[:, axis] + 1) * 512, 0, 1023).astype(np.uint32)
        for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
            bits = (bits | (bits << np.uint32(shift))) & np.uint32(mask)
        code |= bits << np.uint32(axis)
    return code


def sample_uniform_directions(count: int, rng: np.random.Generator) -> np.ndarray:
    """``count`` independent uniform directions, (count, 3) (Archimedes)."""
    return _from_height(1.0 - 2.0 * rng.random(count), 2.0 * np.pi * rng.random(count))


def aim(points: np.ndarray, directions: np.ndarray, origins: np.ndarray, min_distance: float) -> np.ndarray:
    """Return unit directions (..., 3) from ``origins`` to ``points``, or ``directions`` where a point is not finite or
    not farther than ``min_distance``."""
    offset = points - origins
    length = np.linalg.norm(offset, axis=-1, keepdims=True)
    is_aimed = np.isfinite(length) & (length > min_distance)
    return np.where(is_aimed, np.where(is_aimed, offset, 0) / np.where(is_aimed, length, 1), directions)


def latlong_to_direction(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Direction (..., 3) that Mitsuba's ``envmap`` shows at the texture position ``u``, ``v`` in [0, 1], in the map's
    own frame (y up).

    Inverse of its u = atan2(x, -z) / 2π, v = acos(y) / π: the centre of the image is +z, its left and right edges are
    -z, its top row is +y.
    """
    phi, theta = 2.0 * np.pi * np.asarray(u), np.pi * np.asarray(v)
    sin = np.sin(theta)
    return np.stack([np.sin(phi) * sin, np.cos(theta) * np.ones_like(phi), -np.cos(phi) * sin], axis=-1)


def latlong_grid(width: int, height: int, to_world: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Directions of pixel centres and exact solid angles of the pixels of a panorama.

    Pixel (row j, column i) is at u = (i + 1/2)/width, v = (j + 1/2)/height in the mapping of Mitsuba's ``envmap``
    (whose bitmap has the same columns, but rows at v = j/(height - 1)). ``to_world``: (3, 3) or (4, 4), whose rotation
    is applied like the ``to_world`` of the envmap; see :data:`Z_UP`. Returns directions (height * width, 3), row by
    row, and solid angles (height * width,) in sr: (2π/width)(cos θ_j - cos θ_{j+1}), summing to 4π.
    """
    if width < 1 or height < 1:
        raise ValueError(f"a panorama of {width} x {height} pixels has no directions; give at least 1 x 1")
    u = (np.arange(width) + 0.5) / width
    v = (np.arange(height) + 0.5) / height
    V, U = np.meshgrid(v, u, indexing="ij")
    direction = latlong_to_direction(U.ravel(), V.ravel())
    if to_world is not None:
        direction = direction @ np.asarray(to_world, dtype=np.float64)[:3, :3].T
    # cos a - cos b as a product: exact near the poles, where both are close to 1.
    band = 2.0 * np.sin(np.pi * v) * np.sin(0.5 * np.pi / height)
    return direction, np.repeat(2.0 * np.pi / width * band, width)


# Rotates the envmap's y up to z up: (x, y, z) becomes (x, -z, y), so that the edges of the panorama show +y and its
# centre column -y.
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def _from_height(z: np.ndarray, phi: np.ndarray) -> np.ndarray:
    r = np.sqrt((1.0 - z) * (1.0 + z))
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)


# ---- Real spherical harmonics up to degree 3, and the rotation of their coefficients, in float64 ----
#
# Order and signs are those of Gaussian splats, of instant-ngp and of Dr.Jit's ``sh_eval``: l = 0..3, m = -l..l, with
# the Condon-Shortley phase.

SH_C0 = 0.28209479177387814  # The constant harmonic of degree 0: 1 / (2 sqrt(pi))

HARMONIC_DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}  # Degree by number of coefficients


def eval_harmonics(directions: np.ndarray, degree: int) -> np.ndarray:
    """The ``(degree + 1)**2`` harmonics (N, K) of unit ``directions`` (N, 3); ``degree``: 0 to 3."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    of_degrees = [
        [np.full_like(x, SH_C0)],
        [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x],
        [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ],
        [
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
    ]
    return np.stack([h for group in of_degrees[: degree + 1] for h in group], axis=-1)


def rotate_harmonics(coefficients: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """``coefficients`` (N, K, channels) of functions that are rotated by ``rotation`` (3, 3).

    f'(d) = f(R^T d). A rotation does not mix degrees. The matrix of each degree is solved from values in more
    directions than it has harmonics, which determines it to rounding.
    """
    coefficients = np.asarray(coefficients, np.float64)
    degree = HARMONIC_DEGREES[coefficients.shape[1]]
    directions = fibonacci_directions(48)
    values, rotated_values = (
        eval_harmonics(directions, degree),
        eval_harmonics(directions @ np.asarray(rotation, np.float64), degree),
    )
    out = np.empty_like(coefficients)
    for order in range(degree + 1):
        part = slice(order * order, (order + 1) ** 2)
        matrix = np.linalg.lstsq(values[:, part], rotated_values[:, part], rcond=None)[0]
        out[:, part] = np.einsum("kj,njc->nkc", matrix, coefficients[:, part])
    return out
