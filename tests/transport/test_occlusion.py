"""Tests of `nerg_mi.transport.occlusion`."""

import math

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.observer import ObserverCache, ObserverSettings
from nerg_mi.transport.occlusion import ObserverDepthMap, get_observer_map, trace_from_observer, visibility
from nerg_mi.transport.volume_medium import VolumeMedium

# ---- Depth map ----
#
# The map around an observer: depths and gaze between its entries, across the seam of azimuth 0 and at the poles.

HEIGHT = 32
SETTINGS = ObserverSettings(march=MarchSettings(0.1), depth="expected", map_height=HEIGHT)


@pytest.fixture
def around(rgb):
    """The map of an observer at the centre of a sphere of radius 2."""
    ball = rgb.load_dict({"type": "scene", "ball": {"type": "sphere", "radius": 2.0}})
    return ObserverDepthMap(SceneGeometry(None, ball), rgb.Point3f(0.0), SETTINGS)


def unit(phi, theta):
    phi, theta = np.broadcast_arrays(np.asarray(phi, float), theta)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]).astype(np.float32)


def directions():
    """Azimuths all around, many of them near 0 and pi, from pole to pole."""
    rng, width = np.random.default_rng(0), np.pi / HEIGHT
    seams = np.concatenate([c + width * np.linspace(-1.3, 1.3, 27) for c in (0, np.pi, -np.pi, 2 * np.pi)])
    phi = np.concatenate([seams, rng.uniform(-np.pi, np.pi, 500)])
    return phi, np.concatenate(
        [rng.uniform(0.2, np.pi - 0.2, len(phi) - 40), np.geomspace(1e-3, 0.2, 20), np.pi - np.geomspace(1e-3, 0.2, 20)]
    )


def interpolated(table, phi, theta):
    """Bilinear in NumPy: rows from pole to pole with centres at half spacings, periodic columns."""
    width = np.pi / HEIGHT
    x, y = (phi / width - 0.5) % (2 * HEIGHT), np.clip(theta / width - 0.5, 0, HEIGHT - 1)
    i, j = np.floor(x).astype(int), np.minimum(np.floor(y).astype(int), HEIGHT - 2)
    fx, fy = x - i, y - j
    at = lambda column, row: table[row, column % (2 * HEIGHT)]
    rows = [(1 - fx) * at(i, j + k) + fx * at(i + 1, j + k) for k in (0, 1)]
    return (1 - fy) * rows[0] + fy * rows[1]


def test_map_depths_match_directions(rgb, around):
    assert np.allclose(around.depth.numpy(), 2, rtol=1e-5) and around.spacing == pytest.approx(np.pi / HEIGHT)
    around.center = rgb.Point3f(0.0)
    width = np.pi / HEIGHT
    theta, phi = np.meshgrid((np.arange(HEIGHT) + 0.5) * width, (np.arange(2 * HEIGHT) + 0.5) * width, indexing="ij")
    assert np.allclose(np.array(around._directions()), unit(phi.ravel(), theta.ravel()), atol=1e-6)


def test_visibility_is_interpolated_between_entries_and_across_the_seam(rgb, around):
    table = np.random.default_rng(1).uniform(0, 4, (HEIGHT, 2 * HEIGHT)).astype(np.float32)
    around.depth = rgb.Float(table.ravel())
    phi, theta = directions()
    nearest, seen = around.eval_visibility(
        rgb.Vector3f(unit(phi, theta)), dr.full(rgb.Float, 2.0, len(phi)), 0.0, 0.5, True
    )
    # A point is hidden by surfaces nearer than the tolerance.
    assert np.allclose(seen.numpy(), interpolated((table >= 1.5).astype(float), phi, theta), atol=2e-4)
    width = np.pi / HEIGHT
    column, row = (
        np.floor(phi / width).astype(int) % (2 * HEIGHT),
        np.clip(np.floor(theta / width).astype(int), 0, HEIGHT - 1),
    )
    inside = (
        np.maximum(np.abs(phi / width % 1 - 0.5), np.abs(theta / width % 1 - 0.5)) < 0.49
    )  # no tie between two entries
    assert np.allclose(nearest.numpy()[inside], table[row, column][inside])


def test_visibility_falls_off_softly(rgb, around):
    around.depth = dr.full(rgb.Float, 2.0, 2 * HEIGHT**2)
    d = rgb.Vector3f(unit(np.full(5, 1.0), 1.0))
    for falloff, want in ((0.5, [1, 1, 0.8, 0.4, 0]), (0.0, [1, 1, 0, 0, 0])):
        seen = around.eval_visibility(d, rgb.Float([1.9, 2.1, 2.2, 2.4, 2.9]), falloff, 0.1, True)[1].numpy()
        assert np.allclose(seen, want, atol=1e-5)


def test_gaze_lookup_uses_visible_entries(rgb, around):
    rng = np.random.default_rng(2)
    gaze = rng.uniform(0, 1, (HEIGHT, 2 * HEIGHT)).astype(np.float32)
    # The point's own surface is at 2; at 1 an occluder, at 3 the surface behind an edge.
    depth = rng.choice(np.float32([1, 2, 2, 3]), (HEIGHT, 2 * HEIGHT))
    around.depth, table = rgb.Float(depth.ravel()), rgb.Float(gaze.ravel())
    phi, theta = directions()
    d, distance = rgb.Vector3f(unit(phi, theta)), dr.full(rgb.Float, 2.0, len(phi))
    result = around.eval_gaze(table, d, distance, 0.0, 0.1, True).numpy()
    expected = (depth == 2).astype(float)
    share = interpolated(expected, phi, theta)
    certain = share > 0.02
    assert np.allclose(
        result[certain],
        (interpolated(expected * gaze, phi, theta) / np.where(certain, share, 1))[certain],
        rtol=2e-2,
        atol=2e-3,
    )
    around.depth = dr.full(rgb.Float, 3.0, 2 * HEIGHT**2)
    assert (around.eval_gaze(table, d, distance, 0.0, 0.1, True).numpy() == -1).all()


def test_gaze_table_matches_directions(rgb):
    """0 without a surface, for any field."""

    class Gaze:
        def evaluate(self, p_od, p_o, r_o, active):
            return (p_od.x + 10 * r_o.z + 100 * p_o.y,)

    half = {"type": "disk", "to_world": rgb.ScalarTransform4f().translate([0, 0, 2]).scale(1e3)}
    around = ObserverDepthMap(
        SceneGeometry(None, rgb.load_dict({"type": "scene", "half": half})), rgb.Point3f(0, 1, 0), SETTINGS
    )
    width = np.pi / HEIGHT
    theta, phi = np.meshgrid((np.arange(HEIGHT) + 0.5) * width, (np.arange(2 * HEIGHT) + 0.5) * width, indexing="ij")
    x, _, z = unit(phi.ravel(), theta.ravel()).astype(float)
    has_surface = np.isfinite(around.depth.numpy())
    assert np.array_equal(has_surface[z > 0.01], np.ones((z > 0.01).sum(), bool)) and not has_surface[z < 0].any()
    want = np.where(has_surface, x * 2 / np.where(z > 0, z, 1) + 10 * z + 100, 0)
    assert np.allclose(around.make_gaze_table(Gaze()).numpy(), want, rtol=1e-3, atol=1e-3)


# ---- Rays from an observer to a point: their target, and their cost ----

STEP = 0.01


def slab(mi, sigma):
    """Density between z = 0 and z = 1."""
    return SceneGeometry(VolumeMedium(mi.load_dict({"type": "constvolume", "value": float(sigma)})))


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
    cache=None,
    **overrides,
):
    """What an observer at ``p_o`` sees of the point ``p_d`` on a camera's ray."""
    o, p_d, p_o = (np.asarray(v, np.float64) for v in (camera, p_d, p_o))
    ray = mi.Ray3f(mi.Point3f(*map(float, o)), mi.Vector3f(*map(float, (p_d - o) / np.linalg.norm(p_d - o))))
    march = MarchSettings(STEP, dt_gamma=dt_gamma)
    settings = ObserverSettings(march=march, visibility=kind, tolerance=tolerance, map_height=64)
    points = [mi.Point3f(*map(float, p)) for p in (p_d, p_o)]
    if cache is not None:
        overrides["observer_map"] = get_observer_map(place, points[1], settings, None, cache)
    return trace_from_observer(
        place, ray, *points, penetration, mi.Bool(True), mi.Float(falloff), settings, **overrides
    )


@pytest.mark.parametrize(
    "dt_gamma, tolerance, want",
    [(0.0, 0.0, 2 * STEP), (0.004, 0.0, 2 * STEP), (0.1, 0.0, 2 * 0.1 * 2.5), (0.1, 0.3, 0.3)],
)
def test_target_lies_two_steps_in_front_of_the_surface(rgb, dt_gamma, tolerance, want):
    # Steps grow with the distance from the camera, 2.5, and with them the default tolerance; an explicit tolerance does
    # not.
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
def test_unoccluded_observer_sees_the_point(rgb, kind):
    sight = look(rgb, slab(rgb, 0), kind, (0.5, 0.5, 0.5), (0.4, 0.9, -2))
    assert sight.visibility[0] == 1 and np.isfinite(sight.depth[0])
    assert np.allclose(np.array(sight.p_od).ravel(), [0.5, 0.5, 0.5])
    assert abs(sight.depth[0] - math.dist((0.5, 0.5, 0.5), (0.4, 0.9, -2))) < 0.2


def test_occluder_is_returned(rgb):
    # The observer looks through the slab at a point behind it; its median is at a depth of ln 2 / 50.
    sight = look(rgb, slab(rgb, 50), "depth", (0.5, 0.5, 2.0), (0.5, 0.5, -2), camera=(0.5, 0.5, 5))
    assert sight.visibility[0] == 0 and sight.depth[0] == pytest.approx(2 + math.log(2) / 50, abs=1e-4)
    assert np.allclose(np.array(sight.p_od).ravel(), [0.5, 0.5, math.log(2) / 50], atol=1e-4)


def test_visibility_by_transmittance(rgb):
    sight = look(rgb, slab(rgb, 0.7), "transmittance", (0.5, 0.5, 2.0), (0.5, 0.5, -2), camera=(0.5, 0.5, 5))
    assert sight.visibility[0] == pytest.approx(math.exp(-0.7), rel=1e-4)
    # Only the part in front of the point: half of the slab.
    sight = look(
        rgb, slab(rgb, 0.7), "transmittance", (0.5, 0.5, 0.5), (0.5, 0.5, -2), camera=(0.5, 0.5, -1), tolerance=1e-4
    )
    assert sight.visibility[0] == pytest.approx(math.exp(-0.35), rel=1e-3)


@pytest.mark.parametrize("kind, evals", [("transmittance", 100), ("depth", 100)])
def test_evaluations_are_counted_on_request(rgb, kind, evals):
    arguments = {"p_d": (0.5, 0.5, 2.0), "p_o": (0.5, 0.5, -2), "camera": (0.5, 0.5, 5)}
    counted = look(rgb, slab(rgb, 0.0), kind, count=True, **arguments)
    assert (
        abs(counted.density_evals[0] - evals) <= 2
        and look(rgb, slab(rgb, 0.0), kind, **arguments).density_evals is None
    )


def test_map_is_cached_while_valid(rgb):
    place, cache = slab(rgb, 50), ObserverCache()
    see = lambda p_o=(0.5, 0.5, -2), place=place: look(rgb, place, "map", (0.5, 0.5, 0.01), p_o, cache=cache)
    selected = lambda: cache.peek("map")[0].value
    see()
    first = selected()
    see()
    assert selected() is first
    see((0.5, 0.5, -1.9))
    other = selected()
    assert other is not first
    see((0.5, 0.5, -1.9), slab(rgb, 50))
    assert selected() is not other


# ---- Visibility: sign, ramp, and zero fall-off ----


def seen(d_expected, d_observed, falloff, tolerance=0.0):
    return (
        visibility(ns.Float(d_expected), ns.Float(d_observed), ns.Float(falloff), ns.Float(tolerance)).numpy().tolist()
    )


def test01_visibility_sign():
    # The observer's ray meets a surface at 2: a point at 5 is hidden, points at 2 or nearer are visible.
    assert seen([5, 2, 1], 2, 1) == [0, 1, 1]


def test02_visibility_ramp():
    d = np.linspace(1.5, 3.5, 21)
    expected = 1 - np.clip((d - 2 - 0.25) / 0.5, 0, 1)
    assert np.allclose(seen(d, 2, 0.5, 0.25), expected, atol=1e-6)


def test03_falloff_zero_is_a_step():
    assert seen([2, 2.25, 2.2500005, 9], 2, 0, 0.25) == [1, 1, 0, 0]


@pytest.mark.parametrize("falloff", [1e-38, 1e-6, 1e6, 3e38])
def test04_extreme_falloffs(falloff):
    values = seen([0, 1, 2, 1e6], 1, falloff)
    assert np.all(np.isfinite(values)) and values[:2] == [1, 1] and min(values) >= 0
    assert values[2] == (0 if falloff <= 1e-6 else pytest.approx(1 - 1 / falloff))


def test05_no_surface_is_visible():
    assert seen([1, 1e30], np.inf, 0) == [1, 1] and seen([1, 1e30], np.inf, 0.5) == [1, 1]


@pytest.mark.parametrize("falloff", [0.0, 0.5])
def test06_gradients(falloff):
    f = ns.Float(falloff)
    d = ns.Float([1, 2, 2.25, 5])
    dr.enable_grad(f, d)
    y = visibility(d, ns.Float(2), f, ns.Float(0.1))
    dr.backward(dr.sum(y), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    # d/dd_f of 1 - 0.15 / d_f = 0.15 / d_f²; only the point on the ramp has a derivative
    assert np.allclose(dr.grad(f).numpy(), 0 if falloff == 0 else 0.15 / 0.25, rtol=1e-5)
    assert np.allclose(dr.grad(d).numpy(), [0, 0, 0 if falloff == 0 else -2, 0], rtol=1e-5)


def test07_gradients_are_finite_at_the_edge():
    d = ns.Float([2.25, 2.0, 3.0])
    dr.enable_grad(d)
    y = visibility(d, ns.Float(2), ns.Float(0), ns.Float(0.25))
    assert y.numpy().tolist() == [1, 1, 0]
    dr.backward(dr.sum(y), dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
    assert not dr.grad(d).numpy().any()
