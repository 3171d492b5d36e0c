"""Posed image sets, loaded at a chosen size and split into training and held-out views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError

from . import lens
from .cameras import Camera, pixel_directions, pixel_grid, view_tangents
from .posed import DepthFile, Frame, Unused
from .reading import read_depth, read_mask, read_photo
from .resize import all_used, area_average, nearest


@dataclass(frozen=True)
class View:
    """One picture with its camera.

    ``pixels``: (h, w, 3) or (h, w, 4), sRGB as stored, alpha straight (not premultiplied): uint8, uint16 or floats in
    0..1; ``depth``: (h, w) float32 distance along each pixel's ray in scene units, 0 where unknown, or None;
    ``mask``: (h, w) bool, the pixels that count, or None for all; ``left_out``: fraction of the pixels that the mask's
    file leaves out, None without such a file.
    """

    name: str
    camera: Camera
    pixels: np.ndarray
    depth: np.ndarray | None = None
    mask: np.ndarray | None = None
    left_out: float | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.pixels.shape[:2]

    @property
    def color(self) -> np.ndarray:
        """The pixels as float32 in 0..1; made anew at every call."""
        return _as_floats(self.pixels)

    @property
    def has_alpha(self) -> bool:
        return self.pixels.shape[2] == 4

    def over(self, background: float) -> np.ndarray:
        """The picture (h, w, 3), float32, before a grey ``background``."""
        color = self.color
        if not self.has_alpha:
            return color
        alpha = color[..., 3:]
        return color[..., :3] * alpha + (1 - alpha) * background


def split_holdout(frames: list[Frame], every: int) -> tuple[list[Frame], list[Frame]]:
    """Training and held-out frames: every ``every``-th of ``frames`` (sorted by file name), the first
    included, is held out; 0 holds none out."""
    if every < 0 or every == 1:
        raise NergError(f"holdout must be 0 (none) or at least 2 (every so many frames), got {every}")
    if every == 0:
        return list(frames), []
    held = frames[::every]
    train = [f for i, f in enumerate(frames) if i % every]
    if not train:
        raise NergError(f"holding out every {every}th of {len(frames)} frames leaves none to train on; use holdout 0")
    return train, held


def load_usable(
    frames: list[Frame], width: int | None = None, downscale: float | None = None, depth: bool = False
) -> tuple[list[View], list[Unused]]:
    """`load_view` of all ``frames``, and those for which it failed."""
    check_size(width, downscale)
    views, unused = [], []
    for frame in frames:
        try:
            views.append(load_view(frame, width, downscale, depth))
        except ValueError as e:
            unused.append(Unused(frame.name, str(e)))
    return views, unused


def check_size(width: int | None, downscale: float | None) -> None:
    """`NergError` for sizes that no picture can have."""
    if width is not None and downscale is not None:
        raise NergError("give either width or downscale, not both")
    if width is not None and width < 1:
        raise NergError(f"width must be at least 1 pixel, got {width}")
    if downscale is not None and not downscale >= 1:
        raise NergError(f"downscale must be at least 1, got {downscale}")


def load_view(frame: Frame, width: int | None = None, downscale: float | None = None, depth: bool = False) -> View:
    """Load ``frame`` at its own size, at ``width`` pixels, or divided by ``downscale``.

    Pictures are averaged over the area of the new pixels, on their stored (sRGB) values, as other
    trainers do; depth takes the value nearest to each new pixel's centre; a pixel counts where all that it covers is
    on in the mask. ``depth``: read depth files. `NergError` names the file that cannot be used.
    """
    check_size(width, downscale)
    pixels = read_photo(frame)
    h, w = pixels.shape[:2]
    stated = frame.intrinsics(w, h)
    factor = w / width if width is not None else downscale or 1.0
    if factor < 1:
        raise NergError(f'the image "{frame.image}" is only {w} pixels wide; choose a width of at most {w}')
    size = max(1, round(w / factor)), max(1, round(h / factor))
    intrinsics = stated.resized(*size)
    # Every pixel must have a ray; lenses fold over at the borders first.
    view_tangents(intrinsics)
    mask = None if frame.mask is None else all_used(read_mask(frame.mask, (h, w)), *size)
    left_out = None if mask is None else 1 - float(mask.mean())
    if intrinsics.fisheye:
        shown = np.linalg.norm(pixel_grid(intrinsics), axis=-1) < lens.fisheye_limit(intrinsics)[1]
        mask = mask if shown.all() else shown if mask is None else mask & shown
    if mask is not None and not mask.any():
        raise NergError("its mask leaves out every pixel")
    distance = _distances(frame.depth, (h, w), intrinsics) if depth and frame.depth is not None else None
    if size != (w, h):
        pixels = area_average(_as_floats(pixels), *size)
    if pixels.dtype == np.float32:
        # 16 bits tell more than the photo and take half the room.
        pixels = np.round(pixels * 65535).astype(np.uint16)
    return View(frame.name, Camera(intrinsics, frame.to_world), pixels, distance, mask, left_out)


def _as_floats(pixels: np.ndarray) -> np.ndarray:
    """``pixels`` of any of the types of `View.pixels` as float32 in 0..1."""
    if pixels.dtype in (np.uint8, np.uint16):
        return pixels.astype(np.float32) / np.iinfo(pixels.dtype).max
    return pixels.astype(np.float32, copy=False)


def _distances(file: DepthFile, shape: tuple[int, int], intrinsics) -> np.ndarray:
    """Distances along the rays of the resized picture; depth cameras may have fewer pixels than the photo."""
    out, (h, w) = read_depth(file), shape
    if abs(out.shape[1] * h - out.shape[0] * w) > 0.01 * w * out.shape[0]:
        raise NergError(
            f'the depth file "{file.path}" has {out.shape[1]} x {out.shape[0]} pixels, which is not the '
            f"shape of its image, {w} x {h}"
        )
    out = nearest(out, intrinsics.width, intrinsics.height)
    if file.along_axis:
        ahead = -pixel_directions(intrinsics)[..., 2]
        out = np.where(ahead > 1e-3, out / np.maximum(ahead, 1e-3), 0).astype(np.float32)
    return np.ascontiguousarray(out)
