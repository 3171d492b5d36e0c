"""Drafts with fewer rays than pixels: every second or fourth pixel is traced, and the others lie between these."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from nerg_mi.maths.types import variant_types


@dataclass(frozen=True)
class Lattice:
    """The traced pixels of an image.

    Parameters
    ----------
    width, height : int
        Size of the image in pixels.
    pixels_per_ray : int
        1: all pixels; 2: those of one colour of a chessboard; 4: every second one of every second row.
    """

    width: int
    height: int
    pixels_per_ray: int = 1

    @property
    def columns(self) -> int:
        """Rays of a row."""
        return self.width if self.pixels_per_ray == 1 else (self.width + 1) // 2

    @property
    def num_rays(self) -> int:
        """Number of rays."""
        return self.columns * (self.height if self.pixels_per_ray < 4 else (self.height + 1) // 2)

    @cached_property
    def numbers(self) -> list[Any]:
        """What kernels read: another lattice uses the same ones."""
        import drjit as dr

        steps = {1: (1, 1, 0), 2: (2, 1, 1), 4: (2, 2, 0)}[self.pixels_per_ray]
        numbers = [variant_types().UInt32(v) for v in (self.width, self.height, self.columns, *steps)]
        dr.make_opaque(numbers)
        return numbers

    def locate(self, ray: Any) -> tuple[Any, Any]:
        """Column and row of the pixels of ``ray`` numbers (UInt32). At an odd width, some are one column outside."""
        _, _, columns, step_x, step_y, shift = self.numbers
        row = ray // columns
        y = row * step_y
        return (ray - row * columns) * step_x + (y & shift), y

    def interpolate(self, channels: list[Any], x: Any, y: Any, has_mean: bool = True) -> list[Any]:
        """Values of the pixels (x, y) from those of all rays, which are evaluated unless they are those of all pixels.

        A pixel without a ray has the mean of two opposite neighbours, or the value of one if numbers of classes have no
        mean: of those that differ least, so that edges stay sharp.
        """
        import drjit as dr

        if self.pixels_per_ray == 1:
            return channels
        mi: Any = variant_types()
        x, y = mi.Int32(x), mi.Int32(y)
        width, height, columns = map(mi.Int32, self.numbers[:3])

        def gather(step_x: Any, step_y: Any) -> list[Any]:
            u, v = _mirror(x + step_x, width), _mirror(y + step_y, height)
            number = (v >> (self.pixels_per_ray // 4)) * columns + (u >> 1)
            return [dr.gather(mi.Float, channel, mi.UInt32(number)) for channel in channels]

        if self.pixels_per_ray == 2:
            odd = (x + y) & 1
            steps = (odd, 0), (0, odd)
        else:
            steps = (x & 1, y & 1), (x & 1, -(y & 1))
        pairs = [(gather(i, j), gather(-i, -j)) for i, j in steps]
        first, second = (sum(dr.abs(a - b) for a, b in zip(*pair)) for pair in pairs)
        means = ([0.5 * (a + b) if has_mean else a for a, b in zip(*pair)] for pair in pairs)
        return [dr.select(first < second, a, b) for a, b in zip(*means)]


def _mirror(c: Any, count: Any) -> Any:
    """Coordinates mirrored at the first and the last of ``count`` pixels."""
    import drjit as dr

    c = dr.abs(c)
    return dr.maximum(dr.minimum(c, 2 * (count - 1) - c), 0)
