"""Observers: cached data, and fingerprints of arrays."""

from __future__ import annotations

import gc
from dataclasses import fields, replace
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.maths.geometry import Similarity
from nerg_mi.transport import observer
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.jit import Fingerprint, fingerprint_shapes, gc_paused, is_recording
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.observer import (
    CacheEntry,
    ObserverCache,
    ObserverSettings,
    SupportView,
    fingerprint_geometry,
    observe_view,
    select_nearest,
)
from nerg_mi.transport.volume_medium import VolumeMedium
from tests.plugins.scenes import plugin

# ---- Cached data of observers: for the same position and unchanged dependencies ----


@pytest.fixture
def made():
    """A list, and a function that appends its position to the list."""
    calls = []

    def make(center):
        calls.append(np.array(center).ravel().tolist())
        return len(calls)

    return calls, make


def values(expected):
    return [k.value for k in expected]


def test_entries_are_cached_by_position(rgb, made):
    cache, (calls, make) = ObserverCache(), made
    positions = [rgb.Point3f(1, 2, 3), rgb.Point3f(4, 5, 6)]
    first = cache.get_or_compute_each("thing", positions, 0, make)
    assert values(first) == [1, 2] and calls == [[1, 2, 3], [4, 5, 6]]
    assert np.allclose(np.array(first[1].center).ravel(), [4, 5, 6])
    # In another order, and one of them alone: the other one is then dropped.
    assert values(cache.get_or_compute_each("thing", positions[::-1], 0, make)) == [2, 1]
    assert values(cache.get_or_compute_each("thing", positions[:1], 0, make)) == [1]
    assert values(cache.get_or_compute_each("thing", positions, 0, make)) == [1, 3]
    # Exactly.
    next_to = rgb.Point3f(1, 2, float(np.nextafter(np.float32(3), np.float32(4))))
    assert values(cache.get_or_compute_each("thing", [next_to], 0, make)) == [4]


def test_scalars_of_other_observers_are_kept(rgb, made):
    (calls, make), full = made, ObserverCache()
    separate = lambda entry: make(entry.center)
    at = lambda x: [CacheEntry(rgb.Point3f(x, 0, 0), None)]
    assert [values(full.get_or_compute_scalar("n", at(x), 0, separate)) for x in (1, 2, 1)] == [[1], [2], [1]]
    # A short-lived cache shares scalars with its parent; other values are its own.
    part = ObserverCache(scalar_cache=full)
    assert values(part.get_or_compute_scalar("n", at(2), 0, separate)) == [2]
    assert values(part.get_or_compute("n", at(2), 0, separate)) == [3] and values(
        full.get_or_compute("m", at(2), 0, separate)
    ) == [4]
    # Entries with changed dependencies are dropped, and the oldest of very many.
    assert values(full.get_or_compute_scalar("n", at(1), 1, separate)) == [5] and len(full.peek("n")) == 1
    for x in range(2, 300):
        full.get_or_compute_scalar("n", at(x), 1, separate)
    assert len(full.peek("n")) == 257
    count = len(calls)
    full.get_or_compute_scalar("n", at(298), 1, separate)
    assert len(calls) == count
    full.get_or_compute_scalar("n", at(1), 1, separate)
    assert len(calls) == count + 1


def test_observers_at_one_position_share_an_entry(rgb, made):
    cache, (_, make) = ObserverCache(), made
    assert values(cache.get_or_compute_each("thing", [rgb.Point3f(1, 2, 3)] * 2, 0, make)) == [1, 1]


def test_keys_are_independent(rgb, made):
    cache, (_, make) = ObserverCache(), made
    eye = [rgb.Point3f(1, 2, 3)]
    assert [values(cache.get_or_compute_each(t, eye, 0, make)) for t in ("a", "b", "a")] == [[1], [2], [1]]
    assert values(cache.peek("a")) == [1] and cache.peek("c") == []
    cache.clear()
    assert values(cache.get_or_compute_each("a", eye, 0, make)) == [3] and cache.peek("b") == []


def test_changed_arrays_invalidate_entries(rgb, made):
    cache, (_, make) = ObserverCache(), made
    eye, weights = [rgb.Point3f(1, 2, 3)], rgb.Float([1, 2, 3])
    ask = lambda: values(cache.get_or_compute_each("thing", eye, Fingerprint([weights]), make))
    assert ask() == ask() == [1]
    weights += 0
    # An equal value in another array: the array could differ in each lane.
    weights = rgb.Float(weights.numpy())
    assert ask() == [2]
    dr.scatter(weights, rgb.Float(7), rgb.UInt32(1))
    assert ask() == [3]


def test_cached_positions_are_detached(rgb, made):
    cache, (_, make) = ObserverCache(), made
    p = rgb.Point3f(1, 2, 3)
    dr.enable_grad(p)
    (expected,) = cache.get_or_compute_each("thing", [p], 0, make)
    assert not dr.grad_enabled(expected.center)


def test_recordings_are_not_cached(rgb):
    """Values made while a function is recorded belong to the recording and are not cached."""
    cache = ObserverCache()

    @dr.freeze
    def double(p):
        (expected,) = cache.get_or_compute_each("thing", [p], 0, lambda center: center.x * 2)
        return expected.value + 0

    for x in (1.0, 2.0, 3.0):
        assert double(rgb.Point3f(rgb.Float([x]), 0, 0)).numpy()[0] == 2 * x
    assert cache.peek("thing") == []


def test_geometry_fingerprint_covers_shapes_and_medium(rgb):
    scene = rgb.load_dict({"type": "scene", "ball": {"type": "sphere", "radius": 2.0}})
    make = fingerprint_geometry
    first = make(SceneGeometry(None, scene))
    assert first == make(SceneGeometry(None, scene)) != make(SceneGeometry(None))
    params = rgb.traverse(scene)
    params[next(k for k in params.keys() if k.endswith("to_world"))] = rgb.Transform4f().translate([0, 0, 0.5])
    params.update()
    assert make(SceneGeometry(None, scene)) != first
    volume = rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(np.ones((2, 2, 2), np.float32))})
    medium = VolumeMedium(volume)
    before = make(SceneGeometry(medium))
    assert before == make(SceneGeometry(medium))
    params = rgb.traverse(volume)
    params["data"] = params["data"] * 2
    params.update()
    assert make(SceneGeometry(medium)) != before


# ---- Observer settings: which of them determine where a ray meets its surface ----

SETTINGS = ObserverSettings(march=MarchSettings(0.1))


OTHER_VALUES = dict(
    march=MarchSettings(0.2),
    depth="expected",
    surface_opacity=0.7,
    visibility="map",
    tolerance=0.1,
    map_height=8,
    directions=64,
    integral_tolerance=0.1,
)


OF_A_POINT = ("visibility", "tolerance", "map_height", "directions", "integral_tolerance")


def test_all_settings_are_covered():
    assert {f.name for f in fields(ObserverSettings)} == set(OTHER_VALUES)


@pytest.mark.parametrize("name", list(OTHER_VALUES))
def test_surface_settings_exclude_visibility(name):
    """Sphere samples are kept for other visibilities and recomputed for other surfaces."""
    other = replace(SETTINGS, **{name: OTHER_VALUES[name]})
    assert (other.surface_settings == SETTINGS.surface_settings) == (name in OF_A_POINT)


# ---- Centres: that of a sensor, independent of the near plane, and of each member of a batch ----


def camera(mi, origin, target=(0, 0, 0), kind="perspective", **kwargs):
    d = plugin(
        kind,
        to_world=mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0]),
        film={"type": "hdrfilm", "width": 4, "height": 4},
        **kwargs,
    )
    return d


def rays_of(mi, sensor, n=16):
    rng = np.random.default_rng(0)
    xy = mi.Point2f(rng.random((2, n)).astype(np.float32))
    return sensor.sample_ray(mi.Float(0), mi.Float(0.5), xy, mi.Point2f(0.5), True)[0]


@pytest.mark.parametrize("kind", ["perspective", "thinlens", "panorama"])
def test01_center_is_not_the_near_plane(rgb, kind):
    extra = {"aperture_radius": 0.1, "focus_distance": 3.0} if kind == "thinlens" else {}
    extra |= {} if kind == "panorama" else {"near_clip": 1.0}
    sensor = rgb.load_dict(camera(rgb, [1, 2, 3], kind=kind, **extra))
    assert np.allclose(np.array(observer.sensor_center(sensor)).ravel(), [1, 2, 3], atol=1e-6)
    observer.check_center(sensor, "x")
    got = np.array(observer.center_of_ray([sensor], rays_of(rgb, sensor)))
    assert np.allclose(got.reshape(3, -1).T, [1, 2, 3], atol=1e-6)


@pytest.mark.parametrize("kind", ["orthographic", "distant", "irradiancemeter"])
def test02_sensors_without_a_center(rgb, kind):
    if kind == "irradiancemeter":
        shape = rgb.load_dict({"type": "rectangle", "s": {"type": "irradiancemeter", "film": {"type": "hdrfilm"}}})
        sensor = shape.sensor()
    else:
        sensor = rgb.load_dict(
            {"type": kind, "film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}}
        )
    with pytest.raises(ValueError, match='"observer"'):
        observer.check_center(sensor, "the camera")
    with pytest.raises(ValueError, match="no centre"):
        observer.center_of_ray([sensor], rays_of(rgb, rgb.load_dict(camera(rgb, [0, 0, 1]))))


def batch(mi, *cameras):
    d = {"type": "batch", "film": {"type": "hdrfilm", "width": 4 * len(cameras), "height": 4}}
    return mi.load_dict(d | {f"c{i}": c for i, c in enumerate(cameras)})


@pytest.mark.parametrize("near", [0.01, 1.0, 8.0])
def test03_batch_rays_are_assigned_to_their_camera(rgb, near):
    origins = [[0, 0, 3], [0.5, 0, 3], [-3, 1, 0], [0, 0, -3]]
    sensor = batch(rgb, *(camera(rgb, o, near_clip=near) for o in origins))
    ray = rays_of(rgb, sensor, 200)
    got = np.array(observer.center_of_ray([sensor], ray)).T
    # The camera of the ray: its line passes through exactly one of the centres.
    o, d = np.array(ray.o).T, np.array(ray.d).T
    v = o[:, None] - np.array(origins)
    along = (v * d[:, None]).sum(-1, keepdims=True)
    separate = np.linalg.norm(v - along * d[:, None], axis=-1).argmin(-1)
    assert len(set(separate)) == 4 and np.allclose(got, np.array(origins)[separate], atol=1e-5)


def test04_same_center(rgb):
    a, b = rgb.load_dict(camera(rgb, [1, 2, 3], near_clip=1.0)), rgb.load_dict(camera(rgb, [1, 2, 3.001]))
    turned = rgb.load_dict(camera(rgb, [1, 2, 3], target=(5, 0, 1), fov=70))
    assert observer.have_same_center([a], observer.sensor_center(turned)) and not observer.have_same_center(
        [a], observer.sensor_center(b)
    )
    assert not observer.have_same_center([a, b], observer.sensor_center(a)) and not observer.have_same_center(
        [], observer.sensor_center(a)
    )
    ortho = rgb.load_dict({"type": "orthographic"})
    assert not observer.have_same_center([ortho], observer.sensor_center(ortho))
    assert observer.have_same_center(
        [batch(rgb, camera(rgb, [1, 2, 3]), camera(rgb, [1, 2, 3]))], observer.sensor_center(a)
    )


def test05_no_sensor(rgb):
    ray = rays_of(rgb, rgb.load_dict(camera(rgb, [0, 0, 1])))
    with pytest.raises(ValueError, match='"observer"'):
        observer.center_of_ray([], ray)


def test06_center_is_attached_to_to_world(rgb):
    sensor = rgb.load_dict(camera(rgb, [1, 2, 3]))
    params = rgb.traverse(sensor)
    x = rgb.Float(0)
    dr.enable_grad(x)
    params["to_world"] = rgb.Transform4f().translate([x, 2 * x, 0]) @ rgb.Transform4f(params["to_world"])
    params.update()
    c = observer.sensor_center(sensor)
    dr.backward(c.x + c.y)
    assert np.isclose(dr.grad(x).numpy()[0], 3)


@pytest.mark.parametrize("near", [0.5, 1.5])
def test_collinear_cameras_are_distinguished_by_near_planes(rgb, near):
    """Both look along the line through both: a ray on it starts on the near plane of its own camera."""
    sensor = batch(rgb, camera(rgb, [0, 0, 3], near_clip=near), camera(rgb, [0, 0, 1], [0, 0, -1], near_clip=near))
    for z in (3, 1):
        ray = rgb.Ray3f(rgb.Point3f(0, 0, z - near), rgb.Vector3f(0, 0, -1))
        assert np.allclose(np.array(observer.center_of_ray([sensor], ray)).ravel(), [0, 0, z], atol=1e-5)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_lanes_select_the_nearest_observer(rgb, count):
    rng = np.random.default_rng(count)
    centers, p = rng.normal(size=(count, 3)), rng.normal(size=(60, 3))
    expected = [CacheEntry(rgb.Point3f(*map(float, c)), rgb.Float(k)) for k, c in enumerate(centers)]
    lanes = rgb.Point3f(np.ascontiguousarray(p.T, np.float32))
    result = observer.select_nearest(expected, lanes, lambda value: value).numpy()
    assert np.array_equal(np.broadcast_to(result, 60), np.linalg.norm(p[:, None] - centers, axis=2).argmin(axis=1))


# ---- Views of observers: created once per observer, and selected lane by lane ----


class Counting:
    """A view that counts its creations; its value is the x of the observer plus that of the direction."""

    is_occluded = True

    def __init__(self):
        self.made = 0

    def for_position(self, p_o):
        self.made += 1
        return CountedValue(p_o.x)


class CountedValue:
    def __init__(self, x):
        self.x = x

    def evaluate(self, r_o):
        return self.x + r_o.x


def test_view_is_created_once_per_observer(rgb):
    view, cache = Counting(), ObserverCache()
    positions = [rgb.Point3f(1, 0, 0), rgb.Point3f(5, 0, 0)]
    p_o, r_o = rgb.Point3f([1, 5, 5], 0, 0), rgb.Vector3f([0.1, 0.2, 0.3], 0, 0)
    for _ in range(2):
        value = select_nearest(observe_view(view, positions, cache), p_o, lambda value: value.evaluate(r_o))
        assert np.allclose(value.numpy(), [1.1, 5.2, 5.3])
        assert view.made == 2


def test_views_are_refused_in_frozen_functions(rgb):
    cache = ObserverCache()

    @dr.freeze
    def frozen(p):
        return observe_view(Counting(), [p], cache)[0].value.evaluate(rgb.Vector3f(0, 0, 1))

    with pytest.raises(RuntimeError) as refused:
        frozen(rgb.Point3f(rgb.Float([1]), 0, 0))
    assert isinstance(refused.value.__cause__, NergError) and 'from "aovs"' in str(refused.value.__cause__)


def test_support_uses_scene_positions(rgb):
    origins = np.random.default_rng(0).normal(size=(100, 3))
    support = RaySupport.from_origins(origins, 2.0)
    m = np.array([[0, -2.0, 0, 5], [2, 0, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]])
    p = np.array([0.2, -0.3, 0.4])
    alone = support.evaluate(rgb.Point3f(*map(float, p)))[0]
    moved = rgb.Point3f(*map(float, (m @ [*p, 1])[:3]))
    result = SupportView(support, Similarity(m)).for_position(moved).evaluate(rgb.Vector3f(0, 0, 1))
    assert result[0] == pytest.approx(alone, rel=1e-5) and alone > 1


# ---- Fingerprints compare arrays by identity, also after an object is assigned to ----


def test01_fingerprints_are_equal_until_assignment(rgb):
    a, b = dr.opaque(rgb.Float, 1, 10), rgb.TensorXf(np.zeros((2, 3), np.float32))
    first = Fingerprint([a, b])
    assert Fingerprint([a, b]) == first and Fingerprint([b, a]) != first and Fingerprint([a]) != first


def test02_fingerprints_hold_their_variables(rgb):
    """Without copies Dr.Jit would reuse the index of a freed variable for the next one."""
    volume = rgb.load_dict({"type": "gridvolume", "grid": rgb.VolumeGrid(np.ones((4, 4, 4), np.float32))})
    params = rgb.traverse(volume)
    first = Fingerprint([params["data"]])
    for k in range(20):
        params["data"] = rgb.TensorXf(np.full((4, 4, 4, 1), k + 2, np.float32))
        params.update()
        assert Fingerprint([params["data"]]) != first


def test03_fingerprint_of_moved_shapes(rgb):
    scene = rgb.load_dict({"type": "scene", "s": {"type": "sphere"}})
    first, params = fingerprint_shapes(SceneGeometry(None, scene)), rgb.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("to_world"))
    for k in range(4):
        params[key] = rgb.Transform4f().translate([1 + k, 0, 0])
        params.update()
        assert fingerprint_shapes(SceneGeometry(None, scene)) != first
    assert fingerprint_shapes(SceneGeometry(None)) == []


# ---- Recording of frozen functions: detection, and paused garbage collection ----


def test01_recording_is_detected(rgb):
    seen = []
    # A list that the function refers to would be an input with a varying length.
    note = SimpleNamespace(of=seen.append)

    @dr.freeze
    def twice(x):
        note.of(is_recording())
        return 2 * x

    assert not is_recording()
    for value in (1, 2, 3, 4):
        assert twice(dr.opaque(rgb.Float, value, 16))[0] == 2 * value
    # Later calls replay.
    assert seen == [True] and not is_recording()


def test02_gc_runs_outside_of_recordings():
    assert gc.isenabled()
    with gc_paused():
        assert gc.isenabled()
    assert gc.isenabled()


def test03_gc_is_paused_while_recording(rgb):
    seen = []

    @dr.freeze
    def add(x):
        with gc_paused():
            seen.append(gc.isenabled())
        seen.append(gc.isenabled())
        return x + 1

    assert add(rgb.Float([1, 2]))[1] == 3
    assert seen == [False, True] and gc.isenabled()


def test04_disabled_gc_stays_disabled(rgb):
    seen = []

    @dr.freeze
    def add(x):
        with gc_paused():
            pass
        seen.append(gc.isenabled())
        return x + 1

    gc.disable()
    try:
        add(rgb.Float([1, 2]))
        assert seen == [False] and not gc.isenabled()
    finally:
        gc.enable()
