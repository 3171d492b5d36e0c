"""Real spherical harmonics up to degree 3, and what a rotation does to their coefficients, in float64.

Order and signs are those of Gaussian splats, of instant-ngp and of Dr.Jit's ``sh_eval``: l = 0..3, m = -l..l, with the
Condon-Shortley phase.
"""

from __future__ import annotations

import numpy as np

from .sphere import fibonacci_directions

C0 = 0.28209479177387814
"""The harmonic of degree 0, a constant: 1 / (2 sqrt(pi))."""

DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}
"""Degree by the number of coefficients."""


def harmonics(directions: np.ndarray, degree: int) -> np.ndarray:
    """The ``(degree + 1)**2`` harmonics (N, K) of unit ``directions`` (N, 3); ``degree``: 0 to 3."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    of_degrees = [
        [np.full_like(x, C0)],
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


def rotated_harmonics(coefficients: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """``coefficients`` (N, K, channels) of functions that are turned by ``rotation`` (3, 3).

    f'(d) = f(R^T d). A rotation does not mix degrees; the matrix of each is found from its values in more directions
    than it has harmonics, which fixes it to rounding.
    """
    coefficients = np.asarray(coefficients, np.float64)
    degree = DEGREES[coefficients.shape[1]]
    directions = fibonacci_directions(48)
    here, there = harmonics(directions, degree), harmonics(directions @ np.asarray(rotation, np.float64), degree)
    out = np.empty_like(coefficients)
    for order in range(degree + 1):
        part = slice(order * order, (order + 1) ** 2)
        turn = np.linalg.lstsq(here[:, part], there[:, part], rcond=None)[0]
        out[:, part] = np.einsum("kj,njc->nkc", turn, coefficients[:, part])
    return out
