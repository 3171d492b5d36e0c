import numpy as np
import pytest

from nerg_mi.attention.rays import Rays
from nerg_mi.attention.summary import summarise


def walk(scale=1.0, height=1.6, n=100):
    t = np.arange(n) * 0.02
    origin = np.stack([t * scale, 0 * t, np.full(n, height)], axis=1)
    d = np.tile([1.0, 0, 0], (n, 1))
    return Rays(t, np.zeros(n), ("ann",), origin, d, np.ones(n), hit=origin + 2 * d)


def test_figures_of_a_walk():
    s = summarise(walk())
    assert (s.rays, s.persons, s.duplicates, s.warnings) == (100, 1, 0, ())
    assert np.isclose(s.rate, 50) and np.isclose(s.duration, 1.98) and np.isclose(s.speed_p95, 1)
    assert np.isclose(s.hit_distance, 2) and s.hit_share == 1 and np.isclose(s.eye_height[1], 1.6)


@pytest.mark.parametrize(
    "rays, word", [(walk(1000, 1600.0), "units mm"), (walk(1, 0.0), "up axis"), (walk(20), "walking pace"), (walk(0.001, 0.0016), "larger")]
)
def test_names_the_likely_mistake(rays, word):
    assert any(word in w for w in summarise(rays).warnings)


def test_no_rays():
    with pytest.raises(ValueError, match="no rays"):
        summarise(walk().select(np.zeros(100, dtype=bool)))
