"""What samples contribute to the sum that a march gathers along a ray beside its optical depth: colour, as a rule."""

from __future__ import annotations

from typing import Protocol

from nerg_mi.maths.types import Bool, Color, Float, Point3f, Vector3f

from .local_ray import LocalRay
from .protocol import Medium


class Painter(Protocol):
    """What samples contribute. Sums are arrays that can be added, and scaled by a Float."""

    def zero(self) -> Color:
        """A sum of nothing, of one lane."""
        ...

    def paint(self, medium: Medium, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        """The contribution of a sample that absorbs all light, attached to whatever carries derivatives.

        ``features``: of the same point, as ``medium.density_features`` returned them, or the index of a hit (`hits`);
        ``p``, ``w``: the point and the
        unit direction of the ray in the medium's coordinates.
        """
        ...

    def color(self, medium: Medium, sums: Color, opacity: Float, ray: LocalRay, active: Bool) -> Color | None:
        """Colour, times ``opacity``, of rays that gathered ``sums``; None where no colour is gathered."""
        ...


class ColorPainter:
    """The medium's own colour, as an ``array_type`` such as ``Color3f``; in the medium's ``color_space``. Not for a
    medium that is ``deferred``: see ``features.color_painter``."""

    def __init__(self, array_type: type):
        self.array_type = array_type

    def zero(self) -> Color:
        return self.array_type(0)

    def paint(self, medium: Medium, features: list[Float], p: Point3f, w: Vector3f, active: Bool) -> Color:
        return self.array_type(medium.color(features, p, w, active))

    def color(self, medium: Medium, sums: Color, opacity: Float, ray: LocalRay, active: Bool) -> Color:
        return sums
