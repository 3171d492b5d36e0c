"""Tests of `nerg_mi.transport.observer_gaze`."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError
from nerg_mi.fields import gaze_hits
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_log_density import LogGazeField
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead
from nerg_mi.fields.mlp import namespace
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings
from nerg_mi.transport.jit import gc_paused
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.observer import ObserverCache, ObserverSettings
from nerg_mi.transport.observer_gaze import (
    FIRST_DIRECTIONS,
    MIN_DIRECTIONS,
    USUAL_TOLERANCE,
    GazeFieldInstance,
    integrate_sphere,
    interpolate_nearest_depth,
)
from nerg_mi.transport.occlusion import get_observer_map, trace_from_observer
from tests.evaluation.gaze_fields import made
from tests.fields.gaze.test_log_density import BOX, SMALL
from tests.plugins.scenes import plugin

# ---- Gaze ----
#
# A gaze field in the scene, which is evaluated for observers; its integral over an observer's sphere.

SETTINGS = ObserverSettings(march=MarchSettings(0.1))


def integral_at(mi, gaze, place, p, settings=SETTINGS, count=1 << 12, **overrides):
    p_o = mi.Point3f(*map(float, p))
    return float(
        gaze.for_observers([p_o], place, replace(settings, directions=count), **overrides).integrals(p_o)[0][0]
    )


@pytest.fixture(scope="module")
def speckled(tmp_path_factory):
    """A room whose walls are only partly known, like those of hit points."""
    mi.set_variant("llvm_ad_rgb")
    rng = np.random.default_rng(3)
    density = 1e4 * (rng.random((24, 32, 32)) < 0.003)
    density[8:16, 12:20, 12:20] = 0
    path = tmp_path_factory.mktemp("place") / "hits.vol"
    write_volume(path, density, BOX.lower, BOX.upper)
    return Environment.open(path).medium


@pytest.mark.parametrize("escaped", ["constant", "nearest"])
def test_integral_converges(speckled, escaped):
    config, ns = replace(SMALL, escaped=escaped), namespace("llvm_ad_rgb")
    field = LogGazeField.random(config, BOX, ns, 1)
    rng = np.random.default_rng(1)
    # Steep, so that the end of escaping rays matters.
    field.set_parameters({"grid.table": ns.Float(10 * rng.normal(size=len(field.grid.table)).astype(np.float32))})
    place, settings = SceneGeometry(speckled), ObserverSettings(march=default_march_settings(speckled))
    integral = lambda count, p: integral_at(mi, GazeFieldInstance(field), place, p, settings, count)
    for p in ((0, 0, 1.5), (0.3, -0.2, 1.6)):
        assert integral(1 << 17, p) == pytest.approx(integral(1 << 19, p), rel=3e-4), p


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
def test_integral_over_traced_surfaces(rgb, variant):
    """In a room of shapes with walls in closed form."""
    ns, rng = namespace("llvm_ad_rgb"), np.random.default_rng(1)
    field = LogGazeField.random(
        replace(SMALL, variant=variant, mix=0.0), BOX, ns, 1, rng.normal(size=(SMALL.prior, 2 * SMALL.prior))
    )
    field.set_parameters({"grid.table": ns.Float(3 * rng.normal(size=len(field.grid.table)).astype(np.float32))})
    room = rgb.load_dict(
        plugin(
            "scene",
            walls=plugin("cube", to_world=rgb.ScalarTransform4f().translate([0, 0, 1.5]).scale([1.9, 1.9, 1.4])),
        )
    )
    o = np.array([0.4, -0.7, 1.7])
    result = integral_at(rgb, GazeFieldInstance(field), SceneGeometry(None, room), o, SETTINGS, 1 << 16)
    d = fibonacci_directions(20_000)
    walls = np.where(d > 0, [1.9, 1.9, 2.9], [-1.9, -1.9, 0.1])
    # A direction parallel to a wall never meets it.
    distance = np.divide(walls - o, d, out=np.full(d.shape, np.inf), where=d != 0).min(axis=1)
    array = lambda v: ns.Array3f(np.ascontiguousarray(v.T, np.float32))
    emit, capture = field.unnormalized(array(o + d * distance[:, None]), array(np.broadcast_to(o, d.shape)), array(d))
    assert result == pytest.approx(4 * np.pi * np.mean(np.array(emit * capture, np.float64)), rel=3e-3)


def room(mi):
    return SceneGeometry(None, mi.load_dict({"type": "scene", "walls": {"type": "cube"}}))


def normalized():
    field = LogGazeField.random(SMALL, BOX, namespace("llvm_ad_rgb"), 1)
    rng = np.random.default_rng(1)
    table = namespace("llvm_ad_rgb").Float(3 * rng.normal(size=len(field.grid.table)).astype(np.float32))
    field.set_parameters({"grid.table": table})
    return field


def test_recorded_frames_refuse_reaimed_hits(rgb):
    """Their neighbours are found outside of kernels."""
    gaze, geometry, d = GazeFieldInstance(made("re-aimed hits", BOX)), room(rgb), rgb.Vector3f(0, 0, 1)

    @dr.freeze
    def look(p_o):
        with gc_paused():
            return gaze.for_observers([p_o], geometry, SETTINGS).evaluate_along(p_o, d)

    with pytest.raises(RuntimeError) as caught:
        look(rgb.Point3f(0.1, 0, 1))
    assert isinstance(caught.value.__cause__, NergError) and "reaimed_hits" in str(caught.value.__cause__)


@pytest.mark.parametrize("min_table_lanes", [1 << 13, 1])
def test_several_observers_equal_single_ones_with_reaimed_hits(rgb, monkeypatch, min_table_lanes):
    """With tables (from one lane) and without; each lane has the hits of its own observer."""
    monkeypatch.setattr(gaze_hits, "_MIN_TABLE_LANES", min_table_lanes)
    monkeypatch.setattr(gaze_hits.SphericalKdeTable, "is_worthwhile", lambda kde, lanes: True)
    gaze, geometry = GazeFieldInstance(made("re-aimed hits", BOX)), room(rgb)
    eyes = [rgb.Point3f(0.1, 0, 1), rgb.Point3f(-0.3, 0.2, 0.8)]
    settings, d = replace(SETTINGS, directions=1 << 10), rgb.Vector3f(fibonacci_directions(40).T.astype(np.float32))
    index = dr.arange(rgb.UInt32, 40) % 2
    lanes = dr.select(index == 0, eyes[0], eyes[1])
    look = lambda observers, p_o: (
        gaze.for_observers(observers, geometry, settings).evaluate(p_o + d, p_o, d, rgb.Bool(True))[0].numpy()
    )
    single = [look([eye], eye + dr.zeros(rgb.Point3f, 40)) for eye in eyes]
    np.testing.assert_allclose(look(eyes, lanes), np.where(index.numpy() == 0, *single), rtol=1e-4)
    assert np.abs(single[0] - single[1]).max() > 1e-3


def test_gradients_include_reaimed_hits(rgb):
    """With the networks' weight near zero, they are those of the hits."""
    field = made("re-aimed hits", BOX)
    kernels = [kernel._replace(weight=kernel.weight / field.hits.weight) for kernel in field.hits.kernels]
    field.hits = gaze_hits.ReaimedHits(field.hits.origins, field.hits.points, kernels)
    gaze, geometry = GazeFieldInstance(field, Similarity(np.diag([2.0, 2, 2, 1]))), room(rgb)
    d = rgb.Vector3f(fibonacci_directions(30).T.astype(np.float32))

    def total(p):
        p_o = rgb.Point3f(*p.tolist())
        dr.enable_grad(p_o)
        lanes = p_o + dr.zeros(rgb.Point3f, 30)
        observed = gaze.for_observers([p_o], geometry, replace(SETTINGS, directions=1 << 10))
        value = dr.sum(observed.evaluate(lanes + d, lanes, d, rgb.Bool(True))[0])
        dr.backward(value)
        return value[0], np.array(dr.grad(p_o)).ravel()

    p, step = np.array((0.2, -0.1, 0.9)), 1e-2
    _, gradient = total(p)
    for axis, slope in zip(np.eye(3), gradient):
        difference = (total(p + step * axis)[0] - total(p - step * axis)[0]) / (2 * step)
        assert slope == pytest.approx(difference, rel=0.02, abs=0.05)
    assert np.abs(gradient).max() > 0.2


def test_unnormalised_instance_and_missing_observers_are_refused(rgb):
    """Neither the densities of the field itself nor those of unknown observers are available."""
    gaze = GazeFieldInstance(normalized())
    assert not any(hasattr(gaze, name) for name in ("evaluate", "spread", "along"))
    with pytest.raises(ValueError, match="needs at least one observer"):
        gaze.for_observers([], room(rgb), SETTINGS)


def test_observed_gaze_is_immutable(rgb):
    """Requests for other observers with the same cache do not change it."""
    gaze, place, cache = GazeFieldInstance(normalized()), room(rgb), ObserverCache()
    positions = [rgb.Point3f(0.1, 0.2, 0.3), rgb.Point3f(-0.4, 0.1, 0)]
    point, d = rgb.Point3f(0.2, 0.9, 0.4), rgb.Vector3f(0, 1, 0)
    first = gaze.for_observers(positions[:1], place, replace(SETTINGS, directions=1 << 10), cache)
    before = first.evaluate(point, positions[0], d, True)[0].numpy()
    second = gaze.for_observers(positions[1:], place, replace(SETTINGS, directions=1 << 10), cache)
    assert first.evaluate(point, positions[0], d, True)[0].numpy() == before
    assert first.integrals(positions[0])[0].numpy() != second.integrals(positions[1])[0].numpy()
    # For both together, each lane uses its own observer.
    both = gaze.for_observers(positions, place, replace(SETTINGS, directions=1 << 10), cache)
    lanes = rgb.Point3f([0.1, -0.4], [0.2, 0.1], [0.3, 0.0])
    each = np.concatenate([o.integrals(eye)[0].numpy() for o, eye in zip((first, second), positions)])
    assert np.array_equal(both.integrals(lanes)[0].numpy(), each)


def test_sphere_samples_are_traced_once_per_observer(rgb, monkeypatch):
    """For any weights; traced again for another observer, geometry or settings."""
    traced, trace = [], SceneGeometry.trace
    monkeypatch.setattr(SceneGeometry, "trace", lambda *a, **k: (traced.append(a), trace(*a, **k))[1])
    field = normalized()
    gaze, place, cache = GazeFieldInstance(field), room(rgb), ObserverCache()
    counts = []

    def ask(p=(0.1, 0.2, 0.3), place=place, **overrides):
        value = integral_at(rgb, gaze, place, p, replace(SETTINGS, **overrides), cache=cache)
        counts.append(len(traced))
        return value

    first = ask()
    assert ask() == first and counts == [1, 1]
    field.set_parameters({"prior": field.prior + 1})
    assert ask() == pytest.approx(np.e * first, rel=1e-4) and counts[-1] == 1
    # Settings of surfaces matter; settings of visibility do not.
    ask(visibility="map", tolerance=0.1, map_height=8)
    assert counts[-1] == 1
    ask(surface_opacity=0.7)
    ask()
    ask((0.1, 0.2, 0.2))
    ask((0.1, 0.2, 0.2), room(rgb))
    assert counts[-4:] == [2, 3, 4, 5]


def test_attached_integrals_are_not_cached(rgb):
    field, eye = normalized(), rgb.Point3f(0.1, 0.2, 0.3)
    gaze, place, cache = GazeFieldInstance(field), room(rgb), ObserverCache()
    prior = field.prior
    for _ in range(2):
        shift = rgb.Float(0)
        dr.enable_grad(shift)
        field.set_parameters({"prior": prior + shift})
        value = gaze.for_observers([eye], place, replace(SETTINGS, directions=1 << 10), cache).integrals(eye)[0]
        dr.forward_from(shift)
        assert dr.grad(value)[0] == pytest.approx(float(value[0]), rel=1e-4)
    assert cache.peek((gaze, "integral", field)) == []


def test_gaze_rotates_and_is_scale_invariant(rgb):
    ns, grid = namespace("llvm_ad_rgb"), HashGridConfig(levels=2, log2_rows=10, base=4, finest=16)
    g = ProductHead.random(GazeConfig(grid, width=16), Box((0, 0, 0), (1, 1, 2)), ns)
    table = np.random.default_rng(0).normal(size=len(g.grid.table)).astype(np.float32)
    g.set_parameters({"grid.table": ns.Float(table)})
    p_o, p_od = np.array([0.2, 0.3, 0.1]), np.array([0.7, 0.6, 1.5])
    r = (p_od - p_o) / np.linalg.norm(p_od - p_o)

    def evaluate(gaze, p_od, p_o, r):
        p_od, p_o, r = (kind(v.tolist()) for kind, v in zip((rgb.Point3f, rgb.Point3f, rgb.Vector3f), (p_od, p_o, r)))
        return [
            v.numpy()[0] for v in gaze.for_observers([p_o], SceneGeometry(None), SETTINGS).evaluate(p_od, p_o, r, True)
        ]

    plain = evaluate(GazeFieldInstance(g), p_od, p_o, r)
    m = np.array([[0, -50.0, 0, 3], [50, 0, 0, -7], [0, 0, 50, 11], [0, 0, 0, 1]])
    moved = evaluate(GazeFieldInstance(g, Similarity(m)), (m @ [*p_od, 1])[:3], (m @ [*p_o, 1])[:3], m[:3, :3] @ r / 50)
    assert np.allclose(plain, moved, rtol=1e-4)


@pytest.mark.parametrize("trained", [False, True])
def test_observer_derivatives_include_the_integral(rgb, trained):
    """Against central differences of sums over closed-form walls, in many directions."""
    field = normalized()
    # Steep, so that the position of walls matters.
    field.set_parameters({k: 16 * v for k, v in field.parameters().items() if k in ("emit_net.2", "capture_net.2")})
    gaze, place, o = GazeFieldInstance(field), room(rgb), np.array([0.3, -0.2, 0.4])
    array = lambda v: namespace("llvm_ad_rgb").Array3f(np.ascontiguousarray(v.T, np.float32))
    d = fibonacci_directions(200_000)

    def integral(at):
        walls = np.where(d > 0, 1.0, -1.0)
        distance = np.divide(walls - at, d, out=np.full(d.shape, np.inf), where=d != 0).min(axis=1)
        points = (at + d * distance[:, None], np.broadcast_to(at, d.shape), d)
        emit, capture = field.unnormalized(*map(array, points))
        return 4 * np.pi * np.mean(np.array(emit * capture, np.float64))

    h = 0.02
    true = [(integral(o + h * e) - integral(o - h * e)) / (2 * h) for e in np.eye(3)]
    p_o = rgb.Point3f(o)
    dr.enable_grad(p_o)
    if trained:
        dr.enable_grad(field.grid.table)
    result = gaze.for_observers([p_o], place, replace(SETTINGS, directions=1 << 15)).integrals(p_o)[0]
    assert float(dr.detach(result)[0]) == pytest.approx(integral(o), rel=2e-3)
    dr.backward(result)
    assert np.linalg.norm(true) > 0.1 * integral(o)
    assert np.linalg.norm(np.array(dr.grad(p_o)).ravel() - true) < 0.03 * np.linalg.norm(true)
    assert not trained or np.abs(np.array(dr.grad(field.grid.table))).max() > 0


def test_cache_distinguishes_integral_tolerances(rgb):
    """Of integrals, and of the densities in a map."""
    field, eye = normalized(), rgb.Point3f(0.1, 0.2, 0.3)
    # Steep, so that sums over few directions are inaccurate.
    field.set_parameters({k: 16 * v for k, v in field.parameters().items() if k in ("emit_net.2", "capture_net.2")})
    gaze, place, cache = GazeFieldInstance(field), room(rgb), ObserverCache()
    point, ray = rgb.Point3f(0.2, 1, 0.4), rgb.Ray3f(rgb.Point3f(0.2, 0, 0.4), rgb.Vector3f(0, 1, 0))

    def ask(cache, **settings):
        selected = replace(SETTINGS, directions=1 << 15, visibility="map", map_height=16, **settings)
        observed = gaze.for_observers([eye], place, selected, cache)
        around = get_observer_map(place, eye, selected, observed, cache)
        sight = trace_from_observer(
            place, ray, point, eye, rgb.Float(0), rgb.Bool(True), 0.0, selected, observer_map=around
        )
        return float(observed.integrals(eye)[0][0]), float(sight.gaze[0])

    rough, exact = {"integral_tolerance": 0.9}, {"integral_tolerance": 0.0}
    alone = [ask(ObserverCache(), **s) for s in (rough, exact)]
    assert alone[0][0] != alone[1][0] and alone[0][1] != alone[1][1] and min(alone[0][1], alone[1][1]) > 0
    for s, expected in zip((rough, exact, rough, exact), 2 * alone):
        assert ask(cache, **s) == expected


# ---- Integral ----
#
# Integrals over the sphere against closed forms: with as few directions as possible, within the estimated error.

MAX_DIRECTIONS = 1 << 17


def cap(direction, cos: float, background: float):
    """Values of 1 within a cone and of ``background`` elsewhere, in all directions, and their integral."""
    exact = 2 * np.pi * (1 - cos) + background * 2 * np.pi * (1 + cos)
    return lambda count: np.where(fibonacci_directions(count) @ direction > cos, 1.0, background), exact


def lobe(direction, kappa: float):
    """A von Mises-Fisher density, whose integral is 1."""
    scale = kappa / (2 * np.pi * -np.expm1(-2 * kappa))
    return lambda count: scale * np.exp(kappa * (fibonacci_directions(count) @ direction - 1)), 1.0


@pytest.fixture
def turned():
    rng = np.random.default_rng(0)
    return [v / np.linalg.norm(v) for v in rng.normal(size=(20, 3))]


@pytest.mark.parametrize("tolerance", [1e-2, 2e-3])
def test_discontinuous_integrands_meet_the_tolerance(turned, tolerance):
    off, share, counts = [], [], []
    for k, direction in enumerate(turned):
        values, exact = cap(direction, np.cos(0.2 + 0.1 * k), 0.1)
        result = integrate_sphere(values, MAX_DIRECTIONS, tolerance)
        off.append(abs(result.value / exact - 1))
        share.append(off[-1] / result.error)
        counts.append(result.directions)
        assert result.error <= tolerance or result.directions == MAX_DIRECTIONS
    # Several sums: the error of four in five is below the estimate, and that of all below twice the tolerance.
    assert max(off) <= 2 * tolerance and np.mean(off) < tolerance / 2 and np.mean(np.array(share) < 1) >= 0.75
    assert np.median(counts) < MAX_DIRECTIONS / 4
    if tolerance == 1e-2:  # noqa: RUF069 (stored)
        assert max(counts) <= FIRST_DIRECTIONS


def test_narrow_lobes_need_more_directions(turned):
    counts = []
    for kappa in (1, 100, 1e4):
        values, exact = lobe(turned[0], kappa)
        result = integrate_sphere(values, 1 << 18, 5e-3)
        assert result.value == pytest.approx(exact, rel=1e-3)
        counts.append(result.directions)
    assert FIRST_DIRECTIONS == counts[0] < counts[1] < counts[2]


@pytest.mark.parametrize(
    ("tolerance", "first"),
    [
        (1e-4, FIRST_DIRECTIONS),
        (USUAL_TOLERANCE, FIRST_DIRECTIONS),
        (1.9 * USUAL_TOLERANCE, FIRST_DIRECTIONS // 2),
        (4 * USUAL_TOLERANCE, FIRST_DIRECTIONS // 8),
        (1.0, MIN_DIRECTIONS),
    ],
)
def test_larger_tolerance_starts_with_fewer_directions(tolerance, first):
    requested = []

    def even(count):
        requested.append(count)
        return np.ones(count)

    assert integrate_sphere(even, MAX_DIRECTIONS, tolerance).value == pytest.approx(4 * np.pi) and requested == [first]
    assert integrate_sphere(even, 1000, tolerance).directions == 1000


def test_zero_tolerance_uses_all_directions(turned):
    values, exact = lobe(turned[0], 10)
    requested = []
    result = integrate_sphere(lambda count: (requested.append(count), values(count))[1], 1 << 15, 0.0)
    assert requested == [1 << 15] == [result.directions]
    assert result.value == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize("max_directions", [1, 5, 64, FIRST_DIRECTIONS])
def test_number_of_directions_is_limited(max_directions):
    result = integrate_sphere(lambda count: np.arange(count) % 2 + 1.0, max_directions, 1e-9)
    assert result.directions == max_directions and result.value == pytest.approx(
        4 * np.pi * np.mean(np.arange(max_directions) % 2 + 1)
    )


def test_zero_integrand():
    result = integrate_sphere(np.zeros, MAX_DIRECTIONS, 1e-3)
    assert result.value == 0 and result.error == 0 and result.directions == FIRST_DIRECTIONS


# ---- Sphere samples, and the depths of escaping rays ----


@pytest.mark.parametrize("count", [1, 5, 8, 40])
def test_escaped_rays_take_depths_of_neighbours(count):
    """Reference: weighted mean of the logarithm over the eight nearest directions, or all if there are fewer."""
    rng = np.random.default_rng(count)
    unit = lambda n: (lambda v: v / np.linalg.norm(v, axis=1, keepdims=True))(rng.normal(size=(n, 3)))
    reference, wanted, depth = unit(count), unit(30), rng.uniform(0.2, 9.0, count)
    expected = []
    for w in wanted:
        difference = np.linalg.norm(reference - w, axis=1)
        near = np.argsort(difference)[:8]
        weight = 1 / (difference[near] ** 2 + 1e-3)
        expected.append(np.exp(np.sum(weight * np.log(depth[near])) / weight.sum()))
    np.testing.assert_allclose(interpolate_nearest_depth(reference, depth, wanted), expected, rtol=1e-5)
    # A depth of zero must have a finite logarithm.
    assert interpolate_nearest_depth(reference, np.zeros(count), wanted) == pytest.approx(1e-6)
