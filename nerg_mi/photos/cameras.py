"""Cameras: rays of posed ones, OpenCV's lens models and their inverses, intrinsics, and pictures at another size.

Frames: image x right, y down, pixel centres at half-integers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nerg_mi.errors import NergError

# ---- Intrinsics ----
#
# How a photo's lens maps directions to pixels: OpenCV's pinhole and fisheye models.


@dataclass(frozen=True)
class Intrinsics:
    """A lens, for an image of ``width`` x ``height`` pixels.

    ``fx, fy, cx, cy``: pixels, the centre of the first pixel being (0.5, 0.5). The coefficients act on normalised
    coordinates and do not depend on the size of the image. Pinhole lenses: ``k1 .. k3`` radial, ``k4 .. k6`` the
    denominator of OpenCV's rational model, ``p1, p2`` tangential. ``fisheye``: OpenCV's equidistant model, whose
    ``k1 .. k4`` are the coefficients of θ³, θ⁵, θ⁷ and θ⁹; the others are not used.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    fisheye: bool = False

    @property
    def distortion(self) -> tuple[float, ...]:
        """k1, k2, p1, p2, k3, k4, k5, k6: the order of OpenCV."""
        return self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6

    @property
    def is_distorted(self) -> bool:
        """Whether the picture is another than a pinhole's."""
        return self.fisheye or any(self.distortion)

    def resized(self, width: int, height: int) -> Intrinsics:
        """The same lens on an image of another size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )


# ---- OpenCV's lens models and their inverses, in float64 ----
#
# Camera frame here as in OpenCV: x right, y down, z forward. Image coordinates are normalised: pixels less the
# principal point, over the focal length. Pinhole model: OpenCV's ``projectPoints`` with up to eight coefficients
# (radial over radial, tangential); fisheye: ``cv::fisheye``, image radius θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)
# at the angle θ from the axis.

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
    u, good = undistort_with_mask(xy, lens)
    if not good.all():
        names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        listed = ", ".join(f"{k}={v:g}" for k, v in zip(names, lens.distortion) if v)
        raise NergError(
            f"the distortion {listed} cannot be inverted over the whole image; undistort the images beforehand, "
            "or crop them"
        )
    return u


def undistort_with_mask(xy: np.ndarray, lens: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
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


def find_pinhole_limit(lens: Intrinsics) -> float:
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


def find_fisheye_limit(lens: Intrinsics) -> tuple[float, float]:
    """The largest angle that a fisheye lens shows, at most π, and its image radius: no pixel beyond has a direction."""
    radius, slope = _fisheye_radius(_ANGLES, lens)
    falls = np.flatnonzero(slope <= 0)
    last = falls[0] - 1 if len(falls) else len(_ANGLES) - 1
    return float(_ANGLES[last]), float(radius[last])


def image_to_directions(xy: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Unit directions (..., 3) that image coordinates ``xy`` (..., 2) show; a fisheye's last one beyond its limit.

    Raises `NergError` as `undistort` does.
    """
    if not lens.fisheye:
        u = undistort(xy, lens)
        d = np.concatenate([u, np.ones_like(u[..., :1])], axis=-1)
        return d / np.linalg.norm(d, axis=-1, keepdims=True)
    most, end = find_fisheye_limit(lens)
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


def directions_to_image(d: np.ndarray, lens: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Image coordinates (..., 2) of directions ``d`` (..., 3) of any length, and a mask of those that the lens can
    show."""
    d = np.asarray(d, np.float64)
    if not lens.fisheye:
        front = d[..., 2] > 1e-9
        xy = d[..., :2] / np.where(front, d[..., 2], 1.0)[..., None]
        front &= np.sum(xy * xy, axis=-1) < find_pinhole_limit(lens)
        return distort(np.where(front[..., None], xy, 0.0), lens), front
    r = np.linalg.norm(d[..., :2], axis=-1)
    theta = np.arctan2(r, d[..., 2])
    radius, _ = _fisheye_radius(theta, lens)
    scale = np.where(r > 0, radius / np.where(r > 0, r, 1), 0.0)
    return d[..., :2] * scale[..., None], theta <= find_fisheye_limit(lens)[0]


# ---- Rays of posed cameras ----
#
# Frames: image x right, y down, pixel centres at half-integers; camera OpenGL (x right,
# y up, looking along -z); world the data set's own.


# OpenGL cameras look along -z with x to the right, Mitsuba's along +z with x to the left.
OPENGL_FROM_MITSUBA = np.diag([-1.0, 1.0, -1.0, 1.0])
# OpenCV's cameras look along +z with y down.
_OPENGL_FROM_OPENCV = np.array([1.0, -1.0, -1.0])
_WIDEST = float(np.tan(np.radians(85)))


@dataclass(frozen=True)
class PosedCamera:
    """A posed camera. ``to_world``: (4, 4) rigid OpenGL camera-to-world."""

    intrinsics: Intrinsics
    to_world: np.ndarray

    @property
    def center(self) -> np.ndarray:
        return self.to_world[:3, 3]

    @property
    def axis(self) -> np.ndarray:
        """Unit viewing direction."""
        return -self.to_world[:3, 2]


def pixel_grid(intrinsics: Intrinsics) -> np.ndarray:
    """Normalised image coordinates (height, width, 2) of the pixels' centres."""
    i = intrinsics
    x, y = np.meshgrid((np.arange(i.width) + 0.5 - i.cx) / i.fx, (np.arange(i.height) + 0.5 - i.cy) / i.fy)
    return np.stack([x, y], axis=-1)


def pixel_directions(intrinsics: Intrinsics) -> np.ndarray:
    """Unit directions (height, width, 3), float64, of the pixels' centres in the OpenGL camera frame."""
    return image_to_directions(pixel_grid(intrinsics), intrinsics) * _OPENGL_FROM_OPENCV


def find_view_tangents(intrinsics: Intrinsics) -> tuple[float, float, float, float]:
    """How far a picture reaches left, right, up and down: tangents of the angles from its axis, lens included.

    At most tan 85°: what a fisheye sees beyond that no frustum holds.
    """
    i = intrinsics
    x = np.linspace(0, i.width, 33)
    y = np.linspace(0, i.height, 33)
    border = [(u, v) for u in x for v in (0, i.height)] + [(u, v) for v in y for u in (0, i.width)]
    xy = (np.array(border) - [i.cx, i.cy]) / [i.fx, i.fy]
    d = image_to_directions(xy, i)
    ahead = np.maximum(d[:, 2], 1e-9)
    tangent = np.clip(d[:, :2] / ahead[:, None], -_WIDEST, _WIDEST)
    left, up = -tangent.min(axis=0)
    right, down = tangent.max(axis=0)
    return float(left), float(right), float(up), float(down)


def project(points: np.ndarray, camera: PosedCamera) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates (N, 2) of world ``points`` (N, 3), and a mask (N,) of those that the lens can show."""
    i = camera.intrinsics
    local = (np.asarray(points) - camera.center) @ camera.to_world[:3, :3]
    xy, shown = directions_to_image(local * _OPENGL_FROM_OPENCV, i)
    return xy * [i.fx, i.fy] + [i.cx, i.cy], shown


def make_sensor_dict(camera: PosedCamera) -> dict:
    """A Mitsuba ``perspective`` sensor (dict for ``mi.load_dict``) that takes this camera's picture.

    Box filter, float32 RGB, one ray through each pixel's footprint. Raises `NergError` for what
    that sensor cannot express: distortion, and pixels that are not square to 0.1 %.
    """
    import mitsuba as mi

    i = camera.intrinsics
    if i.is_distorted:
        raise NergError(
            "Mitsuba's perspective sensor has no lens distortion, but this camera has "
            f"{'a fisheye lens' if i.fisheye else f'k1, k2, p1, p2 = {i.distortion[:4]}'}; undistort the images first"
        )
    if abs(i.fx / i.fy - 1) > 1e-3:
        raise NergError(
            f"Mitsuba's perspective sensor has square pixels, but this camera has fx={i.fx:g}, fy={i.fy:g}; "
            "resize the images first"
        )
    return {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f((camera.to_world @ OPENGL_FROM_MITSUBA).tolist()),
        "fov": float(np.degrees(2 * np.arctan(i.width / (2 * i.fx)))),
        "fov_axis": "x",
        # Mitsuba counts the offset from the principal point to the film's centre.
        "principal_point_offset_x": float(0.5 - i.cx / i.width),
        "principal_point_offset_y": float(0.5 - i.cy / i.height),
        "near_clip": 1e-3,
        "far_clip": 1e5,
        "film": {
            "type": "hdrfilm",
            "width": i.width,
            "height": i.height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        },
        "sampler": {"type": "independent", "sample_count": 1},
    }


# ---- Pictures, masks and depth at another size ----


def resize_by_area(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average of ``image`` (h, w, c), float32 in 0..1; of four channels the first three count by the fourth."""
    h, w, c = image.shape
    if c == 4:
        image = np.concatenate([image[..., :3] * image[..., 3:], image[..., 3:]], axis=2)
    out = (make_area_weights(h, height) @ image.reshape(h, w * c)).reshape(height, w, c)
    out = out.transpose(1, 0, 2).reshape(w, height * c)
    out = (make_area_weights(w, width) @ out).reshape(width, height, c).transpose(1, 0, 2)
    if c == 4:
        alpha = out[..., 3:]
        color = np.where(alpha > 0, out[..., :3] / np.where(alpha > 0, alpha, 1), 0)
        out = np.concatenate([color, alpha], axis=2)
    return np.ascontiguousarray(np.clip(out, 0, 1), np.float32)


def make_area_weights(old: int, new: int):
    """Sparse matrix (new, old): the share that each old pixel has in each new one."""
    from scipy.sparse import csr_array

    edges = np.arange(new + 1) * (old / new)
    reach = int(np.ceil(old / new)) + 1
    pixel = np.floor(edges[:-1, None] + 1e-9).astype(int) + np.arange(reach)
    share = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    share = np.clip(share, 0, None) * (pixel < old) * (new / old)
    rows = np.repeat(np.arange(new), reach)
    return csr_array((share.ravel().astype(np.float32), (rows, np.minimum(pixel, old - 1).ravel())), shape=(new, old))


def resize_nearest(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """The value of ``values`` (h, w) at each new pixel's centre."""
    h, w = values.shape
    y = ((np.arange(height) + 0.5) * h / height).astype(int)
    x = ((np.arange(width) + 0.5) * w / width).astype(int)
    return values[np.ix_(y, x)]


def resize_mask(mask: np.ndarray, width: int, height: int) -> np.ndarray:
    """Where all that a new pixel covers is on in ``mask`` (h, w, bool)."""
    if mask.shape == (height, width):
        return mask
    return resize_by_area(mask[..., None].astype(np.float32), width, height)[..., 0] > 0.9999
