import numpy as np
import pytest

from nerg_mi.rays import quality
from nerg_mi.rays.quality import summarise
from nerg_mi.rays.rays import Rays


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
    "rays, word",
    [
        (walk(1000, 1600.0), "units mm"),
        (walk(1, 0.0), "up axis"),
        (walk(20), "walking pace"),
        (walk(0.001, 0.0016), "larger"),
    ],
)
def test_names_the_likely_mistake(rays, word):
    assert any(word in w for w in summarise(rays).warnings)


def test_no_rays():
    with pytest.raises(ValueError, match="no rays"):
        summarise(walk().select(np.zeros(100, dtype=bool)))


@pytest.mark.parametrize("block", [7, 64, 1 << 18])
def test_figures_do_not_depend_on_order_or_blocks(monkeypatch, block):
    """Against the definitions, on rays of three people in any order, with pauses, duplicates and missing hits."""
    monkeypatch.setattr(quality, "_BLOCK", block)
    rng = np.random.default_rng(0)
    n = 500
    person, t = rng.integers(0, 3, n), np.round(rng.uniform(0, 60, n), 1)
    origin, d = rng.random((n, 3)), np.tile([1.0, 0, 0], (n, 1))
    hit = np.where(rng.random((n, 1)) < 0.3, np.nan, origin + rng.random((n, 1)) * d)
    rays = Rays(t, person, ("a", "b", "c", "nobody"), origin, d, np.ones(n), hit)
    found = summarise(rays)
    step, speed = [], []
    for p in range(3):
        mine = np.flatnonzero(person == p)
        mine = mine[np.argsort(t[mine], kind="stable")]
        dt = np.diff(t[mine])
        step.append(dt)
        moving = (dt > 0) & (dt <= 1)
        speed.append(np.linalg.norm(np.diff(origin[mine], axis=0), axis=1)[moving] / dt[moving])
    step, speed = np.concatenate(step), np.concatenate(speed)
    moving = step[(step > 0) & (step <= 1)]
    assert found.duration == pytest.approx(moving.sum()) and found.rate == pytest.approx(1 / np.median(moving))
    assert found.speed_p95 == pytest.approx(np.percentile(speed, 95)) and found.duplicates == (step == 0).sum() > 0
    distance = np.linalg.norm(hit - origin, axis=1)
    assert found.hit_share == np.isfinite(distance).mean() and found.hit_distance == pytest.approx(
        np.nanmedian(distance)
    )
    assert found.persons == 3


def test_rate_of_rays_far_apart():
    """Rays every two seconds have a rate, although no recorded time."""
    rays = Rays(
        np.arange(9) * 2.0, np.zeros(9, int), ("a",), np.full((9, 3), 1.6), np.tile([1.0, 0, 0], (9, 1)), np.ones(9)
    )
    found = summarise(rays)
    assert (
        found.rate == 0.5 and found.duration == 0 and np.isnan(found.speed_p95) and "--tick 0.001" in found.warnings[-1]
    )
    alone = summarise(rays.select([0]))
    assert np.isnan(alone.rate) and alone.duplicates == 0 and not any("tick" in w or "t=" in w for w in alone.warnings)
