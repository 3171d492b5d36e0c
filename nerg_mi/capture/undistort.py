"""Between a photo's lens and the pinhole cameras that Mitsuba renders.

Two ways to compare a rendering with a distorted photo: `undistorted` turns the photo into the pinhole picture that it
would have been; `pinhole` and `through_lens` leave the photo alone and bend the rendering to its lens.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from . import lens
from .cameras import Camera, pixel_directions, pixel_grid, sensor_dict
from .images import View
from .intrinsics import Intrinsics

# Beyond this angle from the axis a pinhole picture wastes its pixels.
_WIDEST = np.radians(75)


class Undistorted(NamedTuple):
    """``image``: (h, w, 3 or 4) float32, sRGB, alpha straight; ``mask``: (h, w), where the photo says what is to be
    seen; ``sensor``: dict for ``mi.load_dict`` that renders the same picture."""

    image: np.ndarray
    mask: np.ndarray
    sensor: dict


def undistorted(view: View) -> Undistorted:
    """``view`` as a pinhole camera of the same place, size and principal point would have taken it.

    The focal length stays (the mean of the two where pixels are not square), so that details keep their size at
    the centre. Resampled by cubic splines; without distortion and with square pixels the photo itself. What the photo
    does not show, and what its own mask leaves out, is off in ``mask``.
    """
    i = view.camera.intrinsics
    color = view.color
    own = _own_mask(view)
    if not i.is_distorted and abs(i.fx / i.fy - 1) < 1e-9:
        return Undistorted(color, own, sensor_dict(view.camera))
    focal = float(np.sqrt(i.fx * i.fy))
    plain = Intrinsics(i.width, i.height, focal, focal, i.cx, i.cy)
    xy, shown = lens.image(_forward(plain), i)
    at = xy * [i.fx, i.fy] + [i.cx, i.cy]
    inside = shown & np.all((at >= 0.5) & (at <= [i.width - 0.5, i.height - 0.5]), axis=-1)
    # A lens that folds over shows some places twice; the photo holds the near one only.
    inside &= _unfolded(at, plain, i, inside)
    at = np.where(inside[..., None], at, 0.5)
    if not own.all():
        inside &= _sample(own[..., None].astype(np.float32), at, 1)[..., 0] > 0.999
    return Undistorted(
        np.where(inside[..., None], _resample(color, at), 0).astype(np.float32),
        inside,
        sensor_dict(Camera(plain, view.camera.to_world)),
    )


def pinhole(camera: Camera, oversample: float = 1.0) -> Camera:
    """The smallest pinhole camera at the same place that sees all that ``camera`` does, up to 75 degrees off its axis.

    ``oversample``: its pixels to one of ``camera``'s at the centre.
    """
    d = pixel_directions(camera.intrinsics)
    d = d[-d[..., 2] > np.cos(_WIDEST)]
    x, y = d[:, 0] / -d[:, 2], d[:, 1] / d[:, 2]
    focal = oversample * float(np.sqrt(camera.intrinsics.fx * camera.intrinsics.fy))
    # One pixel more on every side: the outermost centres of the photo lie between pixels here.
    left, top = (int(np.floor(focal * v.min())) - 2 for v in (x, y))
    right, bottom = (int(np.ceil(focal * v.max())) + 2 for v in (x, y))
    return Camera(Intrinsics(right - left, bottom - top, focal, focal, float(-left), float(-top)), camera.to_world)


def through_lens(picture: np.ndarray, source: Camera, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """A rendered ``picture`` (h, w, c) of the pinhole ``source`` as ``camera``, at the same place, would have taken it.

    Returns it (camera's height, width, c), float32, resampled by cubic splines, and a mask of the pixels that
    ``source`` sees. Alpha, as a fourth channel, is not treated apart: give premultiplied colours.
    """
    if not np.allclose(source.to_world, camera.to_world):
        raise ValueError("both cameras must stand at the same place and look the same way")
    i = source.intrinsics
    if picture.shape[:2] != (i.height, i.width):
        raise ValueError(
            f"the picture has {picture.shape[1]} x {picture.shape[0]} pixels, but its camera {i.width} x {i.height}"
        )
    xy, shown = lens.image(_forward(camera.intrinsics), i)
    at = xy * [i.fx, i.fy] + [i.cx, i.cy]
    inside = shown & np.all((at >= 0.5) & (at <= [i.width - 0.5, i.height - 0.5]), axis=-1)
    at = np.where(inside[..., None], at, 0.5)
    return np.where(inside[..., None], _sample(picture, at, 3), 0).astype(np.float32), inside


def _forward(intrinsics: Intrinsics) -> np.ndarray:
    """Directions (h, w, 3) of the pixels in OpenCV's camera frame."""
    return lens.rays(pixel_grid(intrinsics), intrinsics)


def _own_mask(view: View) -> np.ndarray:
    return np.ones(view.shape, bool) if view.mask is None else view.mask


def _unfolded(at: np.ndarray, plain: Intrinsics, i: Intrinsics, inside: np.ndarray) -> np.ndarray:
    """Where the direction that the photo's lens gives for the pixel ``at`` is the one that led there."""
    out = np.zeros(inside.shape, bool)
    if inside.any():
        back = lens.rays((at[inside] - [i.cx, i.cy]) / [i.fx, i.fy], i)
        out[inside] = np.linalg.norm(back - _forward(plain)[inside], axis=-1) < 1e-6
    return out


def _resample(color: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Colours at pixel coordinates ``at``; where there is alpha, colours count by it."""
    if color.shape[2] == 3:
        return np.clip(_sample(color, at, 3), 0, 1)
    alpha = np.clip(_sample(color[..., 3:], at, 3), 0, 1)
    rgb = _sample(color[..., :3] * color[..., 3:], at, 3)
    return np.concatenate([np.clip(np.where(alpha > 0, rgb / np.where(alpha > 0, alpha, 1), 0), 0, 1), alpha], axis=-1)


def _sample(values: np.ndarray, at: np.ndarray, order: int) -> np.ndarray:
    """``values`` (h, w, c) at pixel coordinates (..., 2), by splines."""
    from scipy.ndimage import map_coordinates

    where = [at[..., 1] - 0.5, at[..., 0] - 0.5]
    return np.stack(
        [
            map_coordinates(values[..., k].astype(np.float32), where, order=order, mode="nearest")
            for k in range(values.shape[2])
        ],
        axis=-1,
    )
