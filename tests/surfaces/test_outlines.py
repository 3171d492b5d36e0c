"""Pieces that an outline crosses are cut until what is left out is little."""

import numpy as np

from nerg_mi.surfaces.mesh import Target
from nerg_mi.surfaces.sources import pieces_of, visible_pieces
from tests.surfaces.meshes import joined

FLOOR = (np.array([(-1.0, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]), np.array([(0, 1, 2), (0, 2, 3)]))


def test01_the_edge_of_a_shadow_along_the_cuts_of_a_face(rgb):
    """A plate above the floor hides what lies beyond x, wherever that line falls between two cuts."""
    eye = np.array([0.0, 0.0, 2.0])
    for x in (0.07, 0.13, 0.51):
        plate = FLOOR[0] * [0.5, 1, 1] + [0.5 + x / 2, 0, 1]
        target = Target(joined(FLOOR), [(plate, FLOOR[1])])
        pieces = pieces_of(target.mesh, eye, 0.3)
        parts = list(visible_pieces(target, pieces, lambda some: np.ones(len(some)), 2 * np.pi, 1 << 12))
        found = sum(received.sum() for _, received in parts)
        # Of the strip from -1 to x, by the four corners of half of each of its two parts.
        exact = sum(2 * np.arctan2(a, 2 * np.sqrt(a * a + 5)) for a in (1.0, x))
        assert abs(found - exact) < 1e-3
        uncut = pieces.solid_angle[target.sees(eye, pieces.center, pieces.face)].sum()
        assert abs(uncut - exact) > 1e-3


def test02_a_narrow_density_is_integrated(rgb):
    """Of a density that is narrower than a piece the pieces are cut, too."""
    target, eye = Target(joined(FLOOR)), np.array([0.13, 0.06, 0.5])
    pieces = pieces_of(target.mesh, eye, 0.4)

    def law(some):
        d = some.relative.mean(axis=1)
        cos = -d[:, 2] / np.linalg.norm(d, axis=1)
        return 60 / (2 * np.pi) * np.exp(60 * (cos - 1))

    found = sum(received.sum() for _, received in visible_pieces(target, pieces, law, 1.0, 1 << 12))
    assert abs(found - 1) < 1e-3 and abs((pieces.solid_angle * law(pieces)).sum() - 1) > 1e-2
