import numpy as np
import pytest
from scipy.spatial import cKDTree

from nerg_mi.rays import rays as module
from nerg_mi.rays.rays import RayIndex


@pytest.mark.parametrize("block", [1 << 21, 64])
def test_nearest_against_all_distances(block, monkeypatch):
    monkeypatch.setattr(module, "_INDEX_BLOCK", block)
    rng = np.random.default_rng(0)
    origin, places = rng.random((500, 3)), rng.random((40, 3)) * 1.2
    index = RayIndex(origin)
    apart = np.linalg.norm(origin[None] - places[:, None], axis=2)
    for most, radius in ((10, 0.2), (1000, 0.3), (7, np.inf)):
        found = index.nearest(places, most, radius)
        for q in range(40):
            run = slice(found.offsets[q], found.offsets[q + 1])
            want = np.argsort(apart[q])[: min(most, (apart[q] <= radius).sum())]
            assert np.array_equal(found.indices[run], want) and np.allclose(found.distances[run], apart[q][want])


def test_the_rim_counts_and_nonsense_is_refused():
    index = RayIndex(np.array([[0.25, 0, 0], [0.3, 0, 0]]))
    assert index.nearest([[0, 0, 0]], 5, 0.25).indices.tolist() == [0]
    with pytest.raises(ValueError, match="at least one ray"):
        index.nearest([[0, 0, 0]], 0)


def test_rays_that_are_equally_far_keep_their_order():
    """It decides bits of every training: that of scipy's cKDTree as it is by default."""
    rng = np.random.default_rng(3)
    origin = rng.integers(0, 30, (20_000, 3)).astype(float)  # on a lattice: many are equally far
    near = RayIndex(origin).nearest(origin[:50], 300)
    _, indices = cKDTree(origin, balanced_tree=False).query(origin[:50], k=300)
    assert np.array_equal(near.indices, indices.ravel())
