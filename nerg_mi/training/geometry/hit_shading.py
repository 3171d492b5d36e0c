"""Colour for a place of hit points, of which nothing but the shape is known: greys by the way in which a surface faces,
so that floors, walls and shelves can be told apart in a picture."""

from __future__ import annotations

import numpy as np

# Linear grey of surfaces that face along x, y and z, either way.
_GREY = np.array([0.34, 0.16, 0.55])
_CELL = 2
_SMOOTH = 1.2


def shade_hits(density: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour (z, y, x, 3), linear float32, in cells of 2 x 2 x 2 voxels of ``density`` (z, y, x), and the upper corner
    (3,) of the box that they fill, whose ``lower`` (3,) is the same; ``upper``: of the voxels'.

    A surface faces along the axis along which matter changes most, taken over some cells around it.
    """
    from scipy.ndimage import gaussian_filter

    shape = np.array(density.shape)
    pad = (-shape) % _CELL
    solid = np.pad(density > 0, [(0, p) for p in pad])
    cells = (shape + pad) // _CELL
    coarse = solid.reshape(cells[0], _CELL, cells[1], _CELL, cells[2], _CELL).mean(axis=(1, 3, 5), dtype=np.float32)
    # Nothing is beyond a place of one cell: it faces along that axis.
    thin = [(int(n == 1), int(n == 1)) for n in cells]
    padded = np.pad(coarse, thin)
    # Sheets have two sides, on which matter changes in opposite ways.
    slope = [gaussian_filter(np.abs(np.gradient(padded, axis=axis)), _SMOOTH) for axis in (2, 1, 0)]
    within = tuple(slice(before, before + n) for (before, _), n in zip(thin, cells))
    square = np.stack([s * s for s in slope], axis=-1)[within]
    total = square.sum(axis=-1)
    grey = np.divide(
        square @ _GREY.astype(np.float32), total, out=np.full_like(total, _GREY.mean()), where=total > 1e-9
    )
    edge = (np.asarray(upper) - lower) / shape[::-1]
    return np.repeat(grey[..., None], 3, axis=-1).astype(np.float32), lower + cells[::-1] * _CELL * edge
