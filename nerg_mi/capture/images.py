"""Posed image sets, loaded at a chosen size and split into training and held-out views."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..formats.transforms import Frame, Transforms
from .cameras import Camera


@dataclass(frozen=True)
class View:
    """One picture with its camera.

    ``color``: (h, w, 3) or (h, w, 4) float32, sRGB as stored, alpha straight (not premultiplied);
    ``depth``: (h, w) float32 distance along each pixel's ray in scene units, 0 where unknown, or None.
    """

    name: str
    camera: Camera
    color: np.ndarray
    depth: np.ndarray | None = None

    @property
    def has_alpha(self) -> bool:
        return self.color.shape[2] == 4

    def over(self, background: float) -> np.ndarray:
        """The picture (h, w, 3) before a grey ``background``."""
        rgb = self.color[..., :3]
        if not self.has_alpha:
            return rgb
        alpha = self.color[..., 3:]
        return rgb * alpha + (1 - alpha) * background


def split_holdout(frames: list[Frame], every: int) -> tuple[list[Frame], list[Frame]]:
    """Training and held-out frames: every ``every``-th of ``frames`` (sorted by file name), the first
    included, is held out; 0 holds none out."""
    if every < 0 or every == 1:
        raise ValueError(f"holdout must be 0 (none) or at least 2 (every so many frames), got {every}")
    if every == 0:
        return list(frames), []
    held = frames[::every]
    train = [f for i, f in enumerate(frames) if i % every]
    if not train:
        raise ValueError(f"holding out every {every}th of {len(frames)} frames leaves none to train on; use holdout 0")
    return train, held


def load_views(
    frames: list[Frame], width: int | None = None, downscale: float | None = None, depth: bool = False
) -> list[View]:
    """Load ``frames`` at their own size, at ``width`` pixels, or divided by ``downscale``.

    Pictures are averaged over the area of the new pixels, on their stored (sRGB) values, as other
    trainers do; depth takes the value nearest to each new pixel's centre. ``depth``: read depth files.
    """
    if width is not None and downscale is not None:
        raise ValueError("give either width or downscale, not both")
    if width is not None and width < 1:
        raise ValueError(f"width must be at least 1 pixel, got {width}")
    if downscale is not None and downscale < 1:
        raise ValueError(f"downscale must be at least 1, got {downscale}")
    views = []
    for frame in frames:
        color = read_image(frame.image)
        h, w = color.shape[:2]
        lens = frame.intrinsics(w, h)
        factor = w / width if width is not None else downscale or 1.0
        if factor < 1:
            raise ValueError(f'the image "{frame.image}" is only {w} pixels wide; choose a width of at most {w}')
        size = max(1, round(w / factor)), max(1, round(h / factor))
        distance = read_depth(frame.depth, (h, w)) if depth and frame.depth is not None else None
        if size != (w, h):
            color = _resize(color, *size)
            if distance is not None:
                distance = _nearest(distance, *size)
        views.append(View(frame.name, Camera(lens.resized(*size), frame.to_world), color, distance))
    return views


def read_image(path: str | Path) -> np.ndarray:
    """The image (h, w, 3 or 4), float32, sRGB in 0..1; linear files (EXR) are converted."""
    import mitsuba as mi

    try:
        bitmap = mi.Bitmap(str(path))
    except RuntimeError as e:
        raise ValueError(f'the image "{path}" cannot be read: {str(e).strip().splitlines()[-1]}') from e
    alpha = bitmap.has_alpha()
    formats = (mi.Bitmap.PixelFormat.RGB, mi.Bitmap.PixelFormat.RGBA)
    most = {mi.Struct.Type.UInt8: 255, mi.Struct.Type.UInt16: 65535}.get(bitmap.component_format())
    if most is not None and bitmap.srgb_gamma() and bitmap.pixel_format() in formats:
        # The usual case needs no conversion, which Mitsuba would make by way of linear values.
        out = np.array(bitmap).astype(np.float32) / most
    else:
        pixels = formats[alpha]
        out = np.array(bitmap.convert(pixels, mi.Struct.Type.Float32, srgb_gamma=True), np.float32)
    if not np.all(np.isfinite(out)):
        raise ValueError(f'the image "{path}" holds values that are not finite')
    return np.clip(out, 0, 1)


def read_depth(path: str | Path, shape: tuple[int, int]) -> np.ndarray:
    """Distances along the rays (h, w) in scene units from ``.npy`` or ``.exr`` (first channel); 0: unknown."""
    path = Path(path)
    if path.suffix == ".npy":
        out = np.load(path, allow_pickle=False)
    elif path.suffix == ".exr":
        import mitsuba as mi

        out = np.array(mi.Bitmap(str(path)).convert(component_format=mi.Struct.Type.Float32))
        out = out[..., 0] if out.ndim == 3 else out
    else:
        raise ValueError(f'the depth file "{path}" must be .npy or .exr, holding distances along the rays')
    out = np.asarray(out, np.float32)
    if out.shape != shape:
        raise ValueError(f'the depth file "{path}" has shape {out.shape} but its image is {shape} (height, width)')
    return np.where(np.isfinite(out) & (out > 0), out, 0).astype(np.float32)


def _overlap(old: int, new: int):
    """Sparse matrix (new, old): the share that each old pixel has in each new one."""
    from scipy.sparse import csr_array

    edges = np.arange(new + 1) * (old / new)
    reach = int(np.ceil(old / new)) + 1
    pixel = np.floor(edges[:-1, None] + 1e-9).astype(int) + np.arange(reach)
    share = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    share = np.clip(share, 0, None) * (pixel < old) * (new / old)
    rows = np.repeat(np.arange(new), reach)
    return csr_array((share.ravel().astype(np.float32), (rows, np.minimum(pixel, old - 1).ravel())), shape=(new, old))


def _resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average of ``image`` (h, w, c); colours count by their alpha where there is one."""
    h, w, c = image.shape
    if c == 4:
        image = np.concatenate([image[..., :3] * image[..., 3:], image[..., 3:]], axis=2)
    out = (_overlap(h, height) @ image.reshape(h, w * c)).reshape(height, w, c)
    out = out.transpose(1, 0, 2).reshape(w, height * c)
    out = (_overlap(w, width) @ out).reshape(width, height, c).transpose(1, 0, 2)
    if c == 4:
        alpha = out[..., 3:]
        color = np.where(alpha > 0, out[..., :3] / np.where(alpha > 0, alpha, 1), 0)
        out = np.concatenate([color, alpha], axis=2)
    return np.ascontiguousarray(np.clip(out, 0, 1), np.float32)


def _nearest(values: np.ndarray, width: int, height: int) -> np.ndarray:
    h, w = values.shape
    y = ((np.arange(height) + 0.5) * h / height).astype(int)
    x = ((np.arange(width) + 0.5) * w / width).astype(int)
    return values[np.ix_(y, x)]


def describe_missing(transforms: Transforms, most: int = 5) -> str | None:
    """A sentence naming the listed images that do not exist, or None."""
    if not transforms.missing:
        return None
    names = ", ".join(transforms.missing[:most]) + (", ..." if len(transforms.missing) > most else "")
    total = len(transforms.missing) + len(transforms.frames)
    return f"{len(transforms.missing)} of the {total} images that {transforms.path.name} lists do not exist: {names}"
