"""Building blocks of the store: axis-aligned boxes whose faces are coloured patches, and areas of interest.

Frame: x east, y north, z up, metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from nerg_mi.maths.color import decode_srgb

SOUTH, NORTH, WEST, EAST = (0, -1, 0), (0, 1, 0), (-1, 0, 0), (1, 0, 0)


def parse_srgb(code: str) -> np.ndarray:
    """Return the linear reflectance (3,) of an sRGB colour written as six hex digits."""
    return decode_srgb(np.array([int(code[i : i + 2], 16) for i in (0, 2, 4)]) / 255.0)


@dataclass(frozen=True)
class Region:
    """An area of interest: an axis-aligned box in metres, and the direction that its goods face.

    ``focus`` is the box of its eye-catcher (the special offer of a shelf bay, the till of a counter), lo and hi.
    """

    name: str
    category: str
    lo: tuple
    hi: tuple
    facing: tuple
    focus: tuple

    def to_json(self) -> dict:
        r = lambda v: [round(float(x), 4) for x in v]
        return {
            "name": self.name,
            "category": self.category,
            "min": r(self.lo),
            "max": r(self.hi),
            "facing": list(self.facing),
            "focus": {"min": r(self.focus[0]), "max": r(self.focus[1])},
        }


@dataclass
class StoreBuilder:
    """Coloured quads and solid boxes under construction.

    ``quads`` (N, 4, 3) corners in metres, counter-clockwise seen from outside; ``colors`` (N, 3) linear reflectances;
    ``lights`` (M, 4, 3) emitting quads; ``solids`` (K, 2, 3) obstacles to walking.
    """

    quads: list = field(default_factory=list)
    colors: list = field(default_factory=list)
    lights: list = field(default_factory=list)
    solids: list = field(default_factory=list)
    regions: list = field(default_factory=list)

    def add_patch(self, axis: int, sign: int, at: float, lo2, hi2, color) -> None:
        """Add a rectangle in the plane ``axis = at``, facing ``sign``; lo2, hi2 are in the two other axes in ascending
        order.
        """
        a, b = [k for k in range(3) if k != axis]
        corners = np.empty((4, 3))
        corners[:, axis] = at
        corners[:, a] = (lo2[0], hi2[0], hi2[0], lo2[0])
        corners[:, b] = (lo2[1], lo2[1], hi2[1], hi2[1])
        # e_a x e_b is +e_axis for x and z, and -e_y for y
        if sign * (-1 if axis == 1 else 1) < 0:
            corners = corners[::-1]
        self.quads.append(corners)
        self.colors.append(np.asarray(color, float))

    def add_grid(self, axis: int, sign: int, at: float, lo2, hi2, cells, color_of) -> None:
        """Add a rectangle divided into ``cells`` (n, m) patches; ``color_of(i, j)`` returns a colour, or None for a
        light panel.
        """
        us, vs = np.linspace(lo2[0], hi2[0], cells[0] + 1), np.linspace(lo2[1], hi2[1], cells[1] + 1)
        for i in range(cells[0]):
            for j in range(cells[1]):
                color = color_of(i, j)
                self.add_patch(axis, sign, at, (us[i], vs[j]), (us[i + 1], vs[j + 1]), 0 if color is None else color)
                if color is None:
                    self.lights.append(self.quads.pop())
                    self.colors.pop()

    def add_box(self, lo, hi, color, skip=(), fronts=None, solid=True) -> None:
        """Add a box.

        ``skip`` lists faces (axis, sign) that are left out because something else covers them. ``fronts`` maps faces
        with a pattern to (cells, color_of).
        """
        lo, hi = np.minimum(lo, hi), np.maximum(lo, hi)
        for axis in range(3):
            other_axes = [k for k in range(3) if k != axis]
            for sign in (-1, 1):
                if (axis, sign) in skip:
                    continue
                at = (hi if sign > 0 else lo)[axis]
                cells, color_of = (fronts or {}).get((axis, sign), ((1, 1), lambda i, j: color))
                self.add_grid(axis, sign, at, lo[other_axes], hi[other_axes], cells, color_of)
        if solid:
            self.solids.append(np.stack([lo, hi]))
