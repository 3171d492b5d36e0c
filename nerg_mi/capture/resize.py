"""Pictures, masks and depth at another size."""

from __future__ import annotations

import numpy as np


def area_average(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Area average of ``image`` (h, w, c), float32 in 0..1; of four channels the first three count by the fourth."""
    h, w, c = image.shape
    if c == 4:
        image = np.concatenate([image[..., :3] * image[..., 3:], image[..., 3:]], axis=2)
    out = (overlap(h, height) @ image.reshape(h, w * c)).reshape(height, w, c)
    out = out.transpose(1, 0, 2).reshape(w, height * c)
    out = (overlap(w, width) @ out).reshape(width, height, c).transpose(1, 0, 2)
    if c == 4:
        alpha = out[..., 3:]
        color = np.where(alpha > 0, out[..., :3] / np.where(alpha > 0, alpha, 1), 0)
        out = np.concatenate([color, alpha], axis=2)
    return np.ascontiguousarray(np.clip(out, 0, 1), np.float32)


def overlap(old: int, new: int):
    """Sparse matrix (new, old): the share that each old pixel has in each new one."""
    from scipy.sparse import csr_array

    edges = np.arange(new + 1) * (old / new)
    reach = int(np.ceil(old / new)) + 1
    pixel = np.floor(edges[:-1, None] + 1e-9).astype(int) + np.arange(reach)
    share = np.minimum(edges[1:, None], pixel + 1) - np.maximum(edges[:-1, None], pixel)
    share = np.clip(share, 0, None) * (pixel < old) * (new / old)
    rows = np.repeat(np.arange(new), reach)
    return csr_array((share.ravel().astype(np.float32), (rows, np.minimum(pixel, old - 1).ravel())), shape=(new, old))


def nearest(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """The value of ``values`` (h, w) at each new pixel's centre."""
    h, w = values.shape
    y = ((np.arange(height) + 0.5) * h / height).astype(int)
    x = ((np.arange(width) + 0.5) * w / width).astype(int)
    return values[np.ix_(y, x)]


def all_used(mask: np.ndarray, width: int, height: int) -> np.ndarray:
    """Where all that a new pixel covers is on in ``mask`` (h, w, bool)."""
    if mask.shape == (height, width):
        return mask
    return area_average(mask[..., None].astype(np.float32), width, height)[..., 0] > 0.9999
