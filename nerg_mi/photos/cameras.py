"""Camera models: OpenCV lenses and their inverses, intrinsics, rays of posed cameras, and resizing of images.

Lenses are OpenCV's pinhole model with k1 to k6, p1, p2 (COLMAP: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL,
OPENCV, FULL_OPENCV) and OpenCV's fisheye model with k1 to k4 (OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE,
SIMPLE_FISHEYE, FISHEYE). Others (FOV, division, EUCM, thin prism, equirectangular, f-theta) are refused: undistort
such photos first. Rays leave each pixel through its lens; photos are not resampled.

Frames: image x right, y down, pixel centres at half-integers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from nerg_mi.errors import NergError

# ---- Intrinsics: OpenCV's pinhole and fisheye models ----


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics of a camera with an image of ``width`` x ``height`` pixels.

    The coefficients act on normalised coordinates and do not depend on the image size.

    Attributes
    ----------
    width, height
        Image size in pixels.
    fx, fy, cx, cy
        Focal lengths and principal point in pixels; the centre of the first pixel is (0.5, 0.5).
    k1, k2, k3
        Radial coefficients. For a fisheye lens, k1 to k4 are the coefficients of θ³, θ⁵, θ⁷ and θ⁹.
    k4, k5, k6
        Denominator of OpenCV's rational model.
    p1, p2
        Tangential coefficients.
    fisheye
        Whether the lens follows OpenCV's equidistant fisheye model, which uses only k1 to k4.
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
        """The coefficients k1, k2, p1, p2, k3, k4, k5, k6, in the order of OpenCV."""
        return self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6

    @property
    def is_distorted(self) -> bool:
        """Whether the image differs from that of a pinhole camera."""
        return self.fisheye or any(self.distortion)

    def resized(self, width: int, height: int) -> Intrinsics:
        """Return the intrinsics of the same lens for another image size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )


# ---- OpenCV's lens models and their inverses, in float64 ----
#
# The camera frame is that of OpenCV: x right, y down, z forward. Image coordinates are normalised: (pixel - principal
# point) / focal length. Pinhole model: OpenCV's ``projectPoints`` with up to eight coefficients (rational radial and
# tangential). Fisheye model: ``cv::fisheye``, with image radius θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) at the angle θ
# from the axis.

_NEWTON_STEPS = 20
# Angles at which the monotonicity of the fisheye polynomial is checked.
_ANGLES = np.linspace(0, np.pi, 4097)


def distort(xy: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Return the distorted image coordinates (..., 2) of undistorted ones, for a pinhole lens."""
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = _radial_factor(r2, lens)[0]
    return np.stack(
        [
            x * radial + 2 * lens.p1 * x * y + lens.p2 * (r2 + 2 * x * x),
            y * radial + lens.p1 * (r2 + 2 * y * y) + 2 * lens.p2 * x * y,
        ],
        axis=-1,
    )


def undistort(xy: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Invert `distort` by Newton's method.

    Raises `NergError` if the lens model is not injective within the image.
    """
    u, is_valid = undistort_with_mask(xy, lens)
    if not is_valid.all():
        names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        listed = ", ".join(f"{k}={v:g}" for k, v in zip(names, lens.distortion) if v)
        raise NergError(
            f"the distortion {listed} cannot be inverted over the whole image; undistort or crop the images first"
        )
    return u


def undistort_with_mask(xy: np.ndarray, lens: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Invert `distort` for normalised image coordinates of a pinhole lens.

    Returns the coordinates (..., 2) and a mask (...) that is true where an inverse exists.
    """
    target = np.asarray(xy, np.float64)
    if not any(lens.distortion):
        return target.copy(), np.asarray(np.isfinite(target).all(axis=-1))
    u = target.copy()
    # Near the fold of the lens model, a step may overflow; such results are masked below.
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_NEWTON_STEPS):
            residual = distort(u, lens) - target
            if np.abs(residual).max(initial=0.0) < 1e-13:
                break
            a, b, d = _distortion_jacobian(u, lens)
            det = a * d - b * b
            det = np.where(np.abs(det) > 1e-6, det, 1e-6)
            u = (
                u
                - np.stack(
                    [d * residual[..., 0] - b * residual[..., 1], a * residual[..., 1] - b * residual[..., 0]], axis=-1
                )
                / det[..., None]
            )
        a, b, d = _distortion_jacobian(u, lens)
        # Beyond the fold, the model maps other directions to the same image point, which the lens does not show.
        is_valid = np.all(np.abs(distort(u, lens) - target) < 1e-6, axis=-1) & (a * d - b * b > 0) & (a + d > 0)
    return u, is_valid


def _radial_factor(r2, lens: Intrinsics):
    """Return the radial factor at the squared radius, and its derivative."""
    over = 1 + r2 * (lens.k1 + r2 * (lens.k2 + r2 * lens.k3))
    slope = lens.k1 + r2 * (2 * lens.k2 + r2 * 3 * lens.k3)
    if not (lens.k4 or lens.k5 or lens.k6):
        return over, slope
    under = 1 + r2 * (lens.k4 + r2 * (lens.k5 + r2 * lens.k6))
    under_slope = lens.k4 + r2 * (2 * lens.k5 + r2 * 3 * lens.k6)
    return over / under, (slope - over / under * under_slope) / under


def find_pinhole_limit(lens: Intrinsics) -> float:
    """Return the squared tangent of the angle at which the radial part of a pinhole model folds over; infinite without
    a fold.

    The model also assigns pixels to directions beyond this angle, but the photo does not show them.
    """
    # With t = r², the image radius is r N(t)/D(t); its slope has the sign of N D + 2 t (N' D - N D').
    over = np.polynomial.Polynomial([1, lens.k1, lens.k2, lens.k3])
    under = np.polynomial.Polynomial([1, lens.k4, lens.k5, lens.k6])
    slope = over * under + np.polynomial.Polynomial([0, 2]) * (over.deriv() * under - over * under.deriv())
    roots = np.concatenate([p.trim().roots() for p in (slope, under)])
    real = roots[np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots))].real
    return float(min(real[real > 0], default=np.inf))


def _distortion_jacobian(xy, lens: Intrinsics):
    """Return ∂x'/∂x, ∂x'/∂y = ∂y'/∂x and ∂y'/∂y of `distort`."""
    x, y = xy[..., 0], xy[..., 1]
    radial, slope = _radial_factor(x * x + y * y, lens)
    return (
        radial + 2 * x * x * slope + 2 * lens.p1 * y + 6 * lens.p2 * x,
        2 * x * y * slope + 2 * lens.p1 * x + 2 * lens.p2 * y,
        radial + 2 * y * y * slope + 6 * lens.p1 * y + 2 * lens.p2 * x,
    )


def _fisheye_radius(theta, lens: Intrinsics):
    """Return the image radius at the angle θ, and its derivative."""
    t = theta * theta
    return (
        theta * (1 + t * (lens.k1 + t * (lens.k2 + t * (lens.k3 + t * lens.k4)))),
        1 + t * (3 * lens.k1 + t * (5 * lens.k2 + t * (7 * lens.k3 + t * 9 * lens.k4))),
    )


def find_fisheye_limit(lens: Intrinsics) -> tuple[float, float]:
    """Return the largest angle that a fisheye lens shows, at most π, and its image radius."""
    radius, slope = _fisheye_radius(_ANGLES, lens)
    decreasing = np.flatnonzero(slope <= 0)
    last = decreasing[0] - 1 if len(decreasing) else len(_ANGLES) - 1
    return float(_ANGLES[last]), float(radius[last])


def image_to_directions(xy: np.ndarray, lens: Intrinsics) -> np.ndarray:
    """Return the unit directions (..., 3) of image coordinates ``xy`` (..., 2).

    Beyond the limit of a fisheye lens, the direction at the limit is returned. Raises the error of `undistort`.
    """
    if not lens.fisheye:
        u = undistort(xy, lens)
        d = np.concatenate([u, np.ones_like(u[..., :1])], axis=-1)
        return d / np.linalg.norm(d, axis=-1, keepdims=True)
    max_angle, max_radius = find_fisheye_limit(lens)
    r = np.linalg.norm(xy, axis=-1)
    target = np.minimum(r, max_radius)
    # The polynomial increases from 0 to the limit. A table gives the initial value of Newton's method.
    angles = _ANGLES[_ANGLES <= max_angle]
    theta = np.interp(target, _fisheye_radius(angles, lens)[0], angles)
    for _ in range(_NEWTON_STEPS):
        radius, slope = _fisheye_radius(theta, lens)
        step = (radius - target) / np.maximum(slope, 1e-9)
        theta = np.clip(theta - step, 0, max_angle)
        if np.abs(step).max() < 1e-14:
            break
    across = np.where(r > 0, np.sin(theta) / np.where(r > 0, r, 1), 1.0)
    return np.concatenate([xy * across[..., None], np.cos(theta)[..., None]], axis=-1)


def directions_to_image(d: np.ndarray, lens: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Return the image coordinates (..., 2) of directions ``d`` (..., 3) of any length, and a mask of the visible
    ones.
    """
    d = np.asarray(d, np.float64)
    if not lens.fisheye:
        is_visible = d[..., 2] > 1e-9
        xy = d[..., :2] / np.where(is_visible, d[..., 2], 1.0)[..., None]
        is_visible &= np.sum(xy * xy, axis=-1) < find_pinhole_limit(lens)
        return distort(np.where(is_visible[..., None], xy, 0.0), lens), is_visible
    r = np.linalg.norm(d[..., :2], axis=-1)
    theta = np.arctan2(r, d[..., 2])
    radius, _ = _fisheye_radius(theta, lens)
    scale = np.where(r > 0, radius / np.where(r > 0, r, 1), 0.0)
    return d[..., :2] * scale[..., None], theta <= find_fisheye_limit(lens)[0]


# ---- Rays of posed cameras ----
#
# Camera frame: OpenGL (x right, y up, viewing direction -z). World frame: that of the data set.


# OpenGL cameras look along -z with x to the right, Mitsuba cameras along +z with x to the left.
OPENGL_FROM_MITSUBA = np.diag([-1.0, 1.0, -1.0, 1.0])
# OpenCV cameras look along +z with y down.
_OPENGL_FROM_OPENCV = np.array([1.0, -1.0, -1.0])
_MAX_TANGENT = float(np.tan(np.radians(85)))


@dataclass(frozen=True)
class PosedCamera:
    """A camera with a pose. ``to_world``: rigid OpenGL camera-to-world transform (4, 4)."""

    intrinsics: Intrinsics
    to_world: np.ndarray

    @property
    def center(self) -> np.ndarray:
        return self.to_world[:3, 3]

    @property
    def axis(self) -> np.ndarray:
        """Unit viewing direction (3,)."""
        return -self.to_world[:3, 2]


def pixel_grid(intrinsics: Intrinsics) -> np.ndarray:
    """Return the normalised image coordinates (height, width, 2) of the pixel centres."""
    i = intrinsics
    x, y = np.meshgrid((np.arange(i.width) + 0.5 - i.cx) / i.fx, (np.arange(i.height) + 0.5 - i.cy) / i.fy)
    return np.stack([x, y], axis=-1)


def pixel_directions(intrinsics: Intrinsics) -> np.ndarray:
    """Return the unit directions (height, width, 3), float64, of the pixel centres in the OpenGL camera frame."""
    return image_to_directions(pixel_grid(intrinsics), intrinsics) * _OPENGL_FROM_OPENCV


def find_view_tangents(intrinsics: Intrinsics) -> tuple[float, float, float, float]:
    """Return the field of view as tangents of the angles to the left, right, top and bottom, including distortion.

    The tangents are at most tan 85°, because a frustum cannot contain larger angles of a fisheye lens.
    """
    i = intrinsics
    x = np.linspace(0, i.width, 33)
    y = np.linspace(0, i.height, 33)
    border = [(u, v) for u in x for v in (0, i.height)] + [(u, v) for v in y for u in (0, i.width)]
    xy = (np.array(border) - [i.cx, i.cy]) / [i.fx, i.fy]
    d = image_to_directions(xy, i)
    depth = np.maximum(d[:, 2], 1e-9)
    tangent = np.clip(d[:, :2] / depth[:, None], -_MAX_TANGENT, _MAX_TANGENT)
    left, up = -tangent.min(axis=0)
    right, down = tangent.max(axis=0)
    return float(left), float(right), float(up), float(down)


def project(points: np.ndarray, camera: PosedCamera) -> tuple[np.ndarray, np.ndarray]:
    """Project world ``points`` (N, 3) to pixel coordinates (N, 2). Also returns a mask (N,) of the visible points."""
    i = camera.intrinsics
    local = (np.asarray(points) - camera.center) @ camera.to_world[:3, :3]
    xy, is_visible = directions_to_image(local * _OPENGL_FROM_OPENCV, i)
    return xy * [i.fx, i.fy] + [i.cx, i.cy], is_visible


def make_sensor_dict(camera: PosedCamera) -> dict:
    """Make a Mitsuba ``perspective`` sensor (dict for ``mi.load_dict``) for this camera.

    The sensor has a box filter and a float32 RGB film. Raises `NergError` for what it cannot represent: distortion, and
    pixels that are not square to 0.1 %.
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
        # Mitsuba's offset points from the principal point to the centre of the film.
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


# ---- Resizing of images, masks and depth ----


def resize_by_area(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize ``image`` (h, w, c), float32 in 0..1, by area averaging. With four channels, colours are weighted by
    alpha.
    """
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
    """Return the sparse matrix (new, old) of the overlap of old pixels with new pixels; each row sums to 1."""
    from scipy.sparse import csr_array

    edges = np.arange(new + 1) * (old / new)
    window = int(np.ceil(old / new)) + 1
    pixel = np.floor(edges[:-1, None] + 1e-9).astype(int) + np.arange(window)
    weight = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    weight = np.clip(weight, 0, None) * (pixel < old) * (new / old)
    rows = np.repeat(np.arange(new), window)
    return csr_array((weight.ravel().astype(np.float32), (rows, np.minimum(pixel, old - 1).ravel())), shape=(new, old))


def resize_nearest(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the value of ``values`` (h, w) at the centre of each new pixel."""
    h, w = values.shape
    y = ((np.arange(height) + 0.5) * h / height).astype(int)
    x = ((np.arange(width) + 0.5) * w / width).astype(int)
    return values[np.ix_(y, x)]


def resize_mask(mask: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize ``mask`` (h, w, bool). A new pixel is set if all pixels that it covers are set."""
    if mask.shape == (height, width):
        return mask
    return resize_by_area(mask[..., None].astype(np.float32), width, height)[..., 0] > 0.9999
