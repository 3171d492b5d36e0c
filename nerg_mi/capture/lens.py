"""OpenCV's lens models and their inverses, in float64.

Camera frame here as in OpenCV: x right, y down, z forward. Image coordinates are normalised: pixels less the
principal point, over the focal length. Pinhole model: OpenCV's ``projectPoints`` with up to eight coefficients
(radial over radial, tangential); fisheye: ``cv::fisheye``, image radius θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)
at the angle θ from the axis.
"""

from __future__ import annotations

import numpy as np

from nerg_mi.errors import NergError

from .intrinsics import Intrinsics

_NEWTON = 20
# Samples of the angle that decide how far a fisheye's polynomial rises.
_ANGLES = np.linspace(0, np.pi, 4097)


def distort(xy: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Image coordinates (..., 2) of the directions (x, y, 1) of a pinhole lens."""
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = _ratio(r2, lens)[0]
    return np.stack(
        [
            x * radial + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * x * x),
            y * radial + lens.p1 * (r2 + 2 * y * y) + 2 * lens.p2 * x * y,
        ],
        axis=-1,
    )


def undistort(xy: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """The inverse of `distort`, by Newton's iteration.

    Raises `NergError` where the model folds over inside the image, so that no inverse exists.
    """
    u, good = undistort_where(xy, lens)
    if not good.all():
        names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        listed = ", ".join(f"{k}={v:g}" for k, v in zip(names, lens.distortion) if v)
        raise NergError(
            f"the distortion {listed} cannot be inverted over the whole image; undistort the images beforehand, "
            "or crop them"
        )
    return u


def undistort_where(xy: np.ndarray, lens: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """As `undistort`, (..., 2), and a mask (...) of the coordinates that have an inverse; elsewhere it is none."""
    goal = np.asarray(xy, np.float64)
    if not any(lens.distortion):
        return goal.copy(), np.asarray(np.isfinite(goal).all(axis=-1))
    u = goal.copy()
    # Beside the fold a step may overflow; what comes of it is found out below.
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_NEWTON):
            residual = distort(u, lens) - goal
            if np.abs(residual).max(initial=0.0) < 1e-13:
                break
            a, b, d = _jacobian(u, lens)
            det = a * d - b * b
            det = np.where(np.abs(det) > 1e-6, det, 1e-6)
            u = (
                u
                - np.stack(
                    [d * residual[..., 0] - b * residual[..., 1], a * residual[..., 1] - b * residual[..., 0]], axis=-1
                )
                / det[..., None]
            )
        a, b, d = _jacobian(u, lens)
        # Past the fold the picture runs backwards: another point with the same image, that the lens does not show.
        good = np.all(np.abs(distort(u, lens) - goal) < 1e-6, axis=-1) & (a * d - b * b > 0) & (a + d > 0)
    return u, good


def _ratio(r2, lens: Intrinsics):
    """The radial factor at the squared radius, and its derivative."""
    over = 1 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    slope = lens.k1 + r2 * (2 * lens.k2 + r2 * 3 * lens.k3)
    if not (lens.k4 or lens.k5 or lens.k6):
        return over, slope
    under = 1 + r2 * (lens.k4 + r2 * (lens.k5 + r2 * lens.k6))
    under_slope = lens.k4 + r2 * (2 * lens.k5 + r2 * 3 * lens.k6)
    return over / under, (slope - over / under * under_slope) / under


def pinhole_limit(lens: Intrinsics) -> float:
    """Squared tangent of the angle at which a pinhole lens folds over: what lies beyond is not in the photo, though the
    model gives it a pixel. The radial part alone; infinite where it never does."""
    # With t = r², the image radius is r N(t)/D(t); its slope has the sign of N D + 2 t (N' D - N D').
    over = np.polynomial.Polynomial([1, lens.k1, lens.k2, lens.k3])
    under = np.polynomial.Polynomial([1, lens.k4, lens.k5, lens.k6])
    slope = over * under + np.polynomial.Polynomial([0, 2]) * (over.deriv() * under - over * under.deriv())
    roots = np.concatenate([p.trim().roots() for p in (slope, under)])
    real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots))].real
    return float(min(real[real > 0], default=np.inf))


def _jacobian(xy, lens: Intrinsics):
    """∂x'/∂x, ∂x'/∂y = ∂y'/∂x and ∂y'/∂y of `distort`."""
    x, y = xy[..., 0], xy[..., 1]
    radial, slope = _ratio(x * x + y * y, lens)
    return (
        radial + 2 * x * x * slope + 2 * lens.p1 * y + 6 * lens.p2 * x,
        2 * x * y * slope + 2 * lens.p1 * x + 2 * lens.p2 * y,
        radial + 2 * y * y * slope + 6 * lens.p1 * y + 2 * lens.p2 * x,
    )


def _fisheye_radius(theta, lens: Intrinsics):
    """Image radius at the angle θ, and its derivative."""
    t = theta * theta
    return (
        theta * (1 + t * (lens.k1 + t * (lens.k2 + t * (lens.k3 + t * lens.k4)))),
        1 + t * (3 * lens.k1 + t * (5 * lens.k2 + t * (7 * lens.k3 + t * 9 * lens.k4))),
    )


def fisheye_limit(lens: Intrinsics) -> tuple[float, float]:
    """The largest angle that a fisheye lens shows, at most π, and its image radius: no pixel beyond has a direction."""
    radius, slope = _fisheye_radius(_ANGLES, lens)
    falls = np.flatnonzero(slope <= 0)
    last = falls[0] - 1 if len(falls) else len(_ANGLES) - 1
    return float(_ANGLES[last]), float(radius[last])


def rays(xy: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Unit directions (..., 3) that image coordinates ``xy`` (..., 2) show; a fisheye's last one beyond its limit.

    Raises `NergError` as `undistort` does.
    """
    if not lens.fisheye:
        u = undistort(xy, lens)
        d = np.concatenate([u, np.ones_like(u[..., :1])], axis=-1)
        return d / np.linalg.norm(d, axis=-1, keepdims=True)
    most, end = fisheye_limit(lens)
    r = np.linalg.norm(xy, axis=-1)
    goal = np.minimum(r, end)
    # The polynomial rises from 0 to the limit: a table finds the place, Newton's iteration the digits.
    angles = _ANGLES[_ANGLES <= most]
    theta = np.interp(goal, _fisheye_radius(angles, lens)[0], angles)
    for _ in range(_NEWTON):
        radius, slope = _fisheye_radius(theta, lens)
        step = (radius - goal) / np.maximum(slope, 1e-9)
        theta = np.clip(theta - step, 0, most)
        if np.abs(step).max() < 1e-14:
            break
    across = np.where(r > 0, np.sin(theta) / np.where(r > 0, r, 1), 1.0)
    return np.concatenate([xy * across[..., None], np.cos(theta)[..., None]], axis=-1)


def image(d: np.ndarray, lens: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Image coordinates (..., 2) of directions ``d`` (..., 3) of any length, and a mask of those that the lens can
    show."""
    d = np.asarray(d, np.float64)
    if not lens.fisheye:
        front = d[..., 2] > 1e-9
        xy = d[..., :2] / np.where(front, d[..., 2], 1.0)[..., None]
        front &= np.sum(xy * xy, axis=-1) < pinhole_limit(lens)
        return distort(np.where(front[..., None], xy, 0.0), lens), front
    r = np.linalg.norm(d[..., :2], axis=-1)
    theta = np.arctan2(r, d[..., 2])
    radius, _ = _fisheye_radius(theta, lens)
    scale = np.where(r > 0, radius / np.where(r > 0, r, 1), 0.0)
    return d[..., :2] * scale[..., None], theta <= fisheye_limit(lens)[0]
