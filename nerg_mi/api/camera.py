"""A camera in a few numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.ranges import FIELDS_OF_VIEW, Range, check_number

from .arrays import points

PIXELS = 1 << 28
"""A picture may have so many pixels, as for the command `nerg render`."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera at ``origin`` that looks at ``target``.

    Positions are in scene units (metres, as a rule), and so is nothing else: ``fov`` is the angle, in degrees, between
    the left and the right border of the picture, ``up`` points to its upper border, ``width`` and ``height`` count
    pixels. Pixels are squares whose colours and other values are plain means (a box filter). Raises `NergError` for
    numbers of which no camera can be made.

    >>> import nerg_mi as nerg
    >>> nerg.Camera(origin=(7.4, 3.4, 2.2), target=(4.8, 4.2, 1.0), fov=78, width=48, height=32)
    Camera(origin=(7.4, 3.4, 2.2), target=(4.8, 4.2, 1.0), up=(0.0, 0.0, 1.0), fov=78, width=48, height=32)
    """

    origin: Sequence[float]
    target: Sequence[float]
    up: Sequence[float] = (0.0, 0.0, 1.0)
    fov: float = 60.0
    width: int = 480
    height: int = 320

    def __post_init__(self) -> None:
        for name in ("origin", "target", "up"):
            if len(points(value := getattr(self, name), f"{name} of a camera")) != 1 or np.ndim(value) != 1:
                raise NergError(f"{name} of a camera must be x, y, z, got {value!r}")
            object.__setattr__(self, name, tuple(float(x) for x in value))
        ahead = np.subtract(self.target, self.origin)
        if not np.any(ahead):
            raise NergError(f"a camera at {self.origin} cannot look at the same point; give it another target")
        if np.linalg.norm(np.cross(ahead, self.up)) <= 1e-6 * np.linalg.norm(ahead) * np.linalg.norm(self.up):
            raise NergError(f"a camera cannot look along its own up {self.up}; give it another up")
        check_number(self.fov, FIELDS_OF_VIEW, "the fov of a camera")
        for name in ("width", "height"):
            check_number(getattr(self, name), Range(1, PIXELS), f"the {name} of a picture", whole=True)
        if self.width * self.height > PIXELS:
            raise NergError(f"a picture has at most {PIXELS:,} pixels, got {self.width:,} x {self.height:,}")

    def to_dict(self, spp: int = 16) -> dict:
        """The camera as Mitsuba takes it (`mi.load_dict`), with ``spp`` samples a pixel; a variant must be set."""
        import mitsuba as mi

        return {
            "type": "perspective",
            "fov": float(self.fov),
            "fov_axis": "x",
            # Positions in double precision until Mitsuba rounds them, as in scene files.
            "to_world": mi.ScalarTransform4d().look_at(list(self.origin), list(self.target), list(self.up)),
            "sampler": {"type": "independent", "sample_count": int(spp)},
            "film": {
                "type": "hdrfilm",
                "width": int(self.width),
                "height": int(self.height),
                "rfilter": {"type": "box"},
                "component_format": "float32",
                "pixel_format": "rgb",
            },
        }
