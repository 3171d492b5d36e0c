"""Partial sums."""

import numpy as np

from nerg_mi.surfaces.laplacian import Sums, deposit, merge


def test01_a_deposit_is_divided_among_corners_and_keeps_its_sum():
    faces = np.array([(0, 1, 2), (2, 1, 3)])
    place = np.array([(0.2, 0.3, 0.5), (1.0, 0, 0), (0, 0.25, 0.75)])
    on_faces, on_vertices = deposit(faces, 5, np.array([0, 1, 1]), place, np.array([1.0, 2.0, 4.0]))
    assert on_faces.tolist() == [1, 6]
    assert np.allclose(on_vertices, [0.2, 0.3 + 1.0, 0.5 + 2.0, 3.0, 0])


def test02_sums_add_up_in_their_order():
    rng = np.random.default_rng(0)
    parts = [Sums(rng.random(3), rng.random(4), *rng.random(4), 1) for _ in range(5)]
    whole = merge(parts)
    assert np.array_equal(
        whole.face, ((((parts[0].face + parts[1].face) + parts[2].face) + parts[3].face) + parts[4].face)
    )
    assert whole.count == 5 and np.isclose(whole.weight, sum(p.weight for p in parts))
    assert np.isclose(whole.unaccounted, whole.total - whole.face.sum() - whole.elsewhere - whole.escaped)
    assert Sums.none(2, 3).on_surface == 0
