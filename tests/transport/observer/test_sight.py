"""What an observer meets on the way to a point: where the point is looked for, and what it costs."""

import math

import numpy as np
import pytest

from nerg_mi.transport.geometry import Place
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.observer import ObserverCache, ObserverSettings
from nerg_mi.transport.occlusion import trace_sight
from nerg_mi.transport.volume_medium import VolumeMedium

STEP = 0.01


def slab(mi, sigma):
    """Matter between z = 0 and z = 1."""
    return Place(VolumeMedium(mi.load_dict({"type": "constvolume", "value": float(sigma)})))


def look(
    mi,
    place,
    kind,
    p_d,
    p_o,
    *,
    camera=(0.5, 0.5, -1),
    penetration=0.0,
    tolerance=0.0,
    falloff=0.0,
    dt_gamma=0.0,
    **more,
):
    """Sight of the point ``p_d`` that a camera sees along its ray, from ``p_o``."""
    o, p_d, p_o = (np.asarray(v, np.float64) for v in (camera, p_d, p_o))
    ray = mi.Ray3f(mi.Point3f(*map(float, o)), mi.Vector3f(*map(float, (p_d - o) / np.linalg.norm(p_d - o))))
    march = MarchSettings(STEP, dt_gamma=dt_gamma)
    settings = ObserverSettings(march=march, visibility=kind, tolerance=tolerance, map_height=64)
    points = (mi.Point3f(*map(float, p)) for p in (p_d, p_o))
    return trace_sight(place, ray, *points, penetration, mi.Bool(True), mi.Float(falloff), settings, **more)


@pytest.mark.parametrize(
    "dt_gamma, tolerance, want",
    [(0.0, 0.0, 2 * STEP), (0.004, 0.0, 2 * STEP), (0.1, 0.0, 2 * 0.1 * 2.5), (0.1, 0.3, 0.3)],
)
def test_a_point_is_looked_for_two_steps_in_front_of_its_surface(rgb, dt_gamma, tolerance, want):
    # Steps grow with the distance from the camera, 2.5, and so does what two of them are; a tolerance that is given
    # stays.
    for penetration in (0.0, 0.05):
        sight = look(
            rgb,
            slab(rgb, 0),
            "transmittance",
            (0.5, 0.5, 0.5),
            (0.5, 0.5, -3),
            camera=(0.5, 0.5, -2),
            penetration=penetration,
            dt_gamma=dt_gamma,
            tolerance=tolerance,
        )
        assert sight.depth[0] == pytest.approx(3.5 - want - penetration, rel=1e-5)


@pytest.mark.parametrize("kind", ["depth", "map", "transmittance"])
def test_who_meets_nothing_sees_the_point_itself(rgb, kind):
    sight = look(rgb, slab(rgb, 0), kind, (0.5, 0.5, 0.5), (0.4, 0.9, -2))
    assert sight.visibility[0] == 1 and np.isfinite(sight.depth[0])
    assert np.allclose(np.array(sight.p_od).ravel(), [0.5, 0.5, 0.5])
    assert abs(sight.depth[0] - math.dist((0.5, 0.5, 0.5), (0.4, 0.9, -2))) < 0.2


def test_what_stands_in_between_is_met_instead(rgb):
    # The observer looks through the slab at a point behind it; its median is ln 2 / 50 deep.
    sight = look(rgb, slab(rgb, 50), "depth", (0.5, 0.5, 2.0), (0.5, 0.5, -2), camera=(0.5, 0.5, 5))
    assert sight.visibility[0] == 0 and sight.depth[0] == pytest.approx(2 + math.log(2) / 50, abs=1e-4)
    assert np.allclose(np.array(sight.p_od).ravel(), [0.5, 0.5, math.log(2) / 50], atol=1e-4)


def test_transmittance_is_what_matter_lets_through(rgb):
    sight = look(rgb, slab(rgb, 0.7), "transmittance", (0.5, 0.5, 2.0), (0.5, 0.5, -2), camera=(0.5, 0.5, 5))
    assert sight.visibility[0] == pytest.approx(math.exp(-0.7), rel=1e-4)
    # Only what lies before the point: half of the slab.
    sight = look(
        rgb, slab(rgb, 0.7), "transmittance", (0.5, 0.5, 0.5), (0.5, 0.5, -2), camera=(0.5, 0.5, -1), tolerance=1e-4
    )
    assert sight.visibility[0] == pytest.approx(math.exp(-0.35), rel=1e-3)


@pytest.mark.parametrize("kind, evals", [("transmittance", 100), ("depth", 100)])
def test_evaluations_are_counted_where_that_is_asked_for(rgb, kind, evals):
    given = {"p_d": (0.5, 0.5, 2.0), "p_o": (0.5, 0.5, -2), "camera": (0.5, 0.5, 5)}
    counted = look(rgb, slab(rgb, 0.0), kind, count=True, **given)
    assert abs(counted.density_evals[0] - evals) <= 2 and look(rgb, slab(rgb, 0.0), kind, **given).density_evals is None


def test_a_map_is_kept_for_as_long_as_it_holds(rgb):
    place, cache = slab(rgb, 50), ObserverCache()
    see = lambda p_o=(0.5, 0.5, -2), place=place: look(rgb, place, "map", (0.5, 0.5, 0.01), p_o, cache=cache)
    kept = lambda: cache.peek("map")[0].value
    see()
    first = kept()
    see()
    assert kept() is first
    see((0.5, 0.5, -1.9))
    other = kept()
    assert other is not first
    see((0.5, 0.5, -1.9), slab(rgb, 50))
    assert kept() is not other
