"""What observers or rays leave on a surface: sums that are added up in a fixed order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True, eq=False)
class Sums:
    """Attention, weighted by whom it is of, all in float64.

    ``face`` (F,): the integral over each face; ``vertex`` (V,): that of the attention times the hat function of each
    vertex, which adds up to the same. ``elsewhere``: what ended at something else, ``escaped``: at nothing; ``total``:
    what there was; ``weight``: of the observers or rays, ``count`` of them.
    """

    face: np.ndarray
    vertex: np.ndarray
    elsewhere: float = 0.0
    escaped: float = 0.0
    total: float = 0.0
    weight: float = 0.0
    count: int = 0

    @classmethod
    def none(cls, faces: int, vertices: int) -> Sums:
        """Nothing yet."""
        return cls(np.zeros(faces), np.zeros(vertices))

    def plus(self, other: Sums) -> Sums:
        """Both; the order in which sums are added decides their last digits."""
        return Sums(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    @property
    def on_surface(self) -> float:
        """What ended on the surface."""
        return float(self.face.sum())

    @property
    def unaccounted(self) -> float:
        """What there was and was found nowhere: the error of the sums, where they are computed in two ways."""
        return self.total - self.on_surface - self.elsewhere - self.escaped


def merge(parts: Iterable[Sums]) -> Sums:
    """The sum of ``parts``, of which there is one at least, in their order."""
    parts = iter(parts)
    found = next(parts)
    for part in parts:
        found = found.plus(part)
    return found


def deposit(faces: np.ndarray, vertices: int, face: np.ndarray, place: np.ndarray, what: np.ndarray):
    """``(on faces (F,), on vertices (V,))`` of ``what`` (P,) float64 that ends on the faces numbered ``face`` (P,), at
    the barycentric coordinates ``place`` (P, 3); ``faces`` (F, 3)."""
    on_faces = np.bincount(face, what, len(faces))
    corner = faces[face]
    on_vertices = np.bincount(corner.ravel(), (what[:, None] * place).ravel(), vertices)
    return on_faces, on_vertices
