import numpy as np
import pytest

from nerg_mi.rays.direction_checks import DECLARED, hit_shares, mirror_warning


def counter(origins, directions):
    """A plane z = 0 and a wall x = 3 up to 2.2; nothing else: distances in closed form."""
    with np.errstate(divide="ignore", invalid="ignore"):
        down = np.where(directions[:, 2] < 0, -origins[:, 2] / directions[:, 2], np.inf)
        wall = np.where(directions[:, 0] > 0, (3 - origins[:, 0]) / directions[:, 0], np.inf)
        wall[origins[:, 2] + wall * directions[:, 2] > 2.2] = np.inf
    nearest = np.minimum(down, wall)
    return np.where(nearest < 20, nearest, np.inf)


@pytest.fixture
def gaze():
    """People before the wall who look at it or down."""
    rng = np.random.default_rng(0)
    d = rng.normal(size=(4000, 3)) * 0.1 + (1, 0, -0.2)
    return np.tile([1.0, 1, 1.6], (4000, 1)), d / np.linalg.norm(d, axis=1, keepdims=True)


def test_shares_and_names(gaze):
    origins, d = gaze
    shares = hit_shares(counter, origins, d)
    assert set(shares) == {DECLARED, "x", "y", "z", "x and y", "x and z", "y and z", "x and y and z"}
    assert shares["z"] == np.isfinite(counter(origins, d * (1, 1, -1))).mean()
    assert shares[DECLARED] > 0.99 and mirror_warning(shares, 4000) is None
    for axis in (0, 2):
        signs = np.where(np.arange(3) == axis, -1, 1)
        said = mirror_warning(hit_shares(counter, origins, d * signs), 4000)
        assert f"with {'xyz'[axis]} of the directions negated" in said and "--hand" in said
    # A wall that is not there tells nothing of y.
    assert mirror_warning(hit_shares(counter, origins, d * (1, -1, 1)), 4000) is None


def test_axes_of_the_file(gaze):
    """A file with y up, left-handed: its y is our z."""
    origins, d = gaze
    to_source = np.eye(3)[[0, 2, 1]]
    assert "with y of the dir" in mirror_warning(hit_shares(counter, origins, d * (1, 1, -1), to_source), 4000)


def test_chance_is_no_mirror():
    shares = dict.fromkeys([DECLARED, "x", "y", "z"], 0.80)
    assert mirror_warning({**shares, "y": 0.85}, 100) is None and mirror_warning({**shares, "y": 0.85}, 5000)
    assert mirror_warning({**shares, "y": 0.81}, 10**7) is None
