"""How a photo's lens maps directions to pixels: OpenCV's pinhole and fisheye models."""

from __future__ import annotations

from dataclasses import dataclass, replace


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
