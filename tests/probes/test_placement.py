import numpy as np
import pytest

from nerg_mi.probes.probes import place_queries


@pytest.fixture(scope="module")
def origin():
    """A walk, most of it standing in one corner."""
    rng = np.random.default_rng(0)
    return np.concatenate(
        [rng.uniform([0, 0, 1.5], [4, 3, 1.7], (3000, 3)), rng.normal([1, 1, 1.6], 0.02, (20_000, 3))]
    )


def test_blue_noise_is_even_and_covers(origin):
    rng = np.random.default_rng(1)
    found = place_queries(origin, "blue", 10_000, 0.3, 0.25, rng)
    apart = np.linalg.norm(found[:, None] - found[None], axis=2) + 10 * np.eye(len(found))
    assert apart.min() > 0.3
    # Where someone was, a probe is near: no gap wider than the discs (and the cells of the candidates).
    assert np.linalg.norm(origin[:, None] - found[None], axis=2).min(axis=1).max() < 0.3 * 1.5
    assert {tuple(p) for p in found} <= {tuple(p) for p in origin}
    # Random origins crowd where people stood.
    crowd = lambda p: (np.linalg.norm(p[:, :2] - [1, 1], axis=1) < 0.1).mean()
    assert crowd(place_queries(origin, "data", 500, None, 0.25, rng)) > 0.5 > 10 * crowd(found)


@pytest.mark.parametrize("count", [20, 200])
def test_blue_noise_of_a_number(origin, count):
    found = place_queries(origin, "blue", count, None, 0.1, np.random.default_rng(2))
    assert 0.4 * count <= len(found) <= count


def test_lattice_and_box(origin):
    rng = np.random.default_rng(3)
    grid = place_queries(origin, "grid", 1, None, 0.25, rng)
    assert np.allclose(np.diff(np.unique(grid[:, 0].round(9))), 0.5)
    # As far from one wall as from the other.
    assert np.allclose(grid.min(axis=0) + grid.max(axis=0), origin.min(axis=0) + origin.max(axis=0))
    box = place_queries(origin, "random", 300, None, 0.25, rng)
    assert len(box) == 300 and (box >= origin.min(axis=0)).all() and (box <= origin.max(axis=0)).all()
    with pytest.raises(ValueError, match="placement"):
        place_queries(origin, "hexagons", 1, None, 0.25, rng)


def test_places_that_are_far_enough_apart_all_have_a_probe():
    """Few, down a steep line, where the cells of candidates are easily taken for one another."""
    steps = np.arange(5.0)
    for axes in ([0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1]):
        down = np.stack([0 * steps, 0.26 * steps, 1.26 * (4 - steps)], axis=1)[:, axes]
        found = place_queries(np.repeat(down, 7, axis=0), "blue", 100, 1.0, 0.25, np.random.default_rng(0))
        assert sorted(map(tuple, found)) == sorted(map(tuple, down))
