import numpy as np
import pytest

from nerg_mi.maths.sphere import uniform_directions
from nerg_mi.probes.kde_view import directions_to, kde_frame, probe_at
from nerg_mi.rays.rays import RayIndex, Rays
from tests.reference.kde import kde as reference

OBSERVER = np.array([1.0, 1.0, 1.6])


@pytest.fixture(scope="module")
def rays():
    rng = np.random.default_rng(3)
    n = 4000
    return Rays(
        np.arange(n) * 0.1,
        np.arange(n) % 4,
        tuple("abcd"),
        rng.uniform([0, 0, 1.5], [2, 2, 1.7], (n, 3)),
        uniform_directions(n, rng),
        np.ones(n),
    )


def wall(h=60, w=90):
    """Points of a wall before the observer, of which a corner is open sky."""
    x, z = np.meshgrid(np.linspace(-2, 4, w), np.linspace(3, 0, h))
    points = np.stack([x, np.full_like(x, 4.0), z], axis=-1)
    points[:10, :10] = np.nan
    return points


@pytest.mark.parametrize("method", ["exact", "table", "auto"])
def test_every_pixel_has_the_density_of_its_direction(rays, method):
    probe = probe_at(rays, OBSERVER, 0.3, kappa_rule="fixed", kappa=25.0, index=RayIndex(rays))
    points = wall()
    picture = kde_frame(probe, observer=OBSERVER, points=points, method=method, backend="llvm")
    assert picture.shape == (60, 90) and (picture[:10, :10] == 0).all()
    d = points - OBSERVER
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    want = reference(d[20:].reshape(-1, 3), probe.directions, probe.offsets, probe.kappa)[0].reshape(40, 90)
    assert np.allclose(picture[20:], want, rtol=2e-3)
    there = np.isfinite(points).all(axis=-1)
    again = kde_frame(probe, np.where(there[..., None], d, (0, 0, 1)), mask=there, method=method, backend="llvm")
    assert np.allclose(again, picture, rtol=1e-4, atol=1e-6)


def test_directions_to_points():
    d, there = directions_to(OBSERVER, np.array([[[1, 1, 3.6], OBSERVER, [np.nan, 0, 0]]]))
    assert there.tolist() == [[True, False, False]] and np.allclose(d, [0, 0, 1])


def test_refusals(rays):
    probe = probe_at(rays, OBSERVER)
    with pytest.raises(ValueError, match="say where the pixels look"):
        kde_frame(probe)
    with pytest.raises(ValueError, match="say where the pixels look"):
        kde_frame(probe, points=wall())
    with pytest.raises(ValueError, match="method"):
        kde_frame(probe, observer=OBSERVER, points=wall(), method="guess")
    with pytest.raises(ValueError, match="enlarge the radius"):
        probe_at(rays, [50, 0, 0])
