"""Tests of `nerg_mi.environment.queries`."""

import drjit as dr
import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.environment.queries import SceneObserver
from tests.plugins import fields
from tests.recorder import Recorder

# ---- One observer of a scene, and the density of their gaze ----


def test01_the_density_is_the_fields(scene, rgb):
    observer = SceneObserver(scene, np.float32((0.3, -3, 0.4)))
    p_od, r_o = rgb.Point3f(0.2, -0.5, 0.1), dr.normalize(rgb.Vector3f(-0.1, 2.5, -0.3))
    field = nerg.GazeField.load(scene.integrator.children["gaze"].filename).network
    expected = field.evaluate(p_od, rgb.Point3f(0.3, -3, 0.4), r_o)[0]
    assert np.isclose(observer.eval_gaze(p_od, observer.center, r_o, True)[0], expected[0], rtol=1e-5)


def test02_one_kernel_serves_all_observers(scene, rgb):
    points = rgb.Point3f([0.1, 0.2, 0.3], [-1, -1, -1], [0, 0, 0.1])
    kernels = []
    for eye in ((0.3, -3, 0.4), (2.5, -1, 0.5), (0, -2, 0)):
        observer = SceneObserver(scene, np.float32(eye))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(observer.observe(points, True))
            kernels.append({k["hash"] for k in dr.kernel_history() if "hash" in k})
    assert kernels[0] and kernels[0] == kernels[1] == kernels[2]


def test03_without_a_gaze_field_there_is_no_density(files):
    observer = SceneObserver(nerg.make_scene(files / "field.safetensors"), np.float32((0, -3, 0)))
    with pytest.raises(ValueError, match="without a gaze field"):
        observer.eval_gaze(None, None, None, True)


# ---- Hits of rays and visibility of points: compared with pictures and closed forms ----


BALL = {"type": "sphere", "radius": 0.5}


@pytest.fixture
def ball(files):
    """A ball of radius 1/2 around the origin, with a gaze field."""
    return nerg.make_scene(gaze=files / "gaze.safetensors", shapes=BALL)


def pixel_rays(rgb, scene, camera):
    """Rays through the pixel centres of a camera."""
    sensor = scene.resolve_sensor(camera)
    x, y = np.meshgrid((np.arange(camera.width) + 0.5) / camera.width, (np.arange(camera.height) + 0.5) / camera.height)
    at = rgb.Point2f(np.float32(x.ravel()), np.float32(y.ravel()))
    ray, _ = sensor.sample_ray(0, 0, at, rgb.Point2f(0.5))
    return np.array(ray.o).T, np.array(ray.d).T


def test01_rays_are_those_of_a_fine_picture(scene, rgb):
    # A pixel of half a degree, with a ray through its centre.
    camera = nerg.Camera((0.3, -3, 0.4), (0, 0, 0), fov=0.01, width=1, height=1)
    o, d = pixel_rays(rgb, scene, camera)
    eye = (2.5, -1, 0.5)
    quantities = ("color", "depth", "gaze", "visibility", "position", "opacity")
    picture = nerg.render(scene, eye, quantities, camera=camera, spp=4)
    seen = nerg.trace(scene, o, d, quantities, observers=eye)
    for name in quantities:
        assert np.allclose(seen[name][0, 0], picture[name][0, 0, 0], rtol=2e-2, atol=1e-3), name


def test02_depth_and_position_on_a_ball(ball):
    seen = nerg.trace(ball, [(0, -3, 0), (0, 3, 0.1), (0, 3, 1)], [(0, 2, 0), (0, -1, 0), (0, -1, 0)])
    assert np.allclose(seen.depth, [2.5, 3 - np.sqrt(0.25 - 0.01), 0], atol=1e-5)
    assert np.array_equal(seen.opacity, [1, 1, 0])
    where = nerg.trace(ball, (0, -3, 0), (0, 1, 0), "position")
    assert np.allclose(where.position, [(0, -0.5, 0)], atol=1e-5) and where.names == ("position",)


def test03_an_observer_at_the_ray_origin_sees_along_it(scene):
    o = np.array([(0.3, -3, 0.4), (2.5, -1, 0.5), (0.3, -3, 0.4)])
    d = -o + [(0, 0, 0), (0, 0, 0), (0.1, 0, 0.1)]
    seen = nerg.trace(scene, o, d, ["gaze", "visibility", "depth"])
    assert seen.gaze.shape == (3,) and seen.observers is None
    for i in range(3):
        alone = nerg.trace(scene, o[i], d[i], ["gaze", "visibility", "depth"], observers=o[i])
        assert np.allclose([alone.gaze[0, 0], alone.depth[0, 0]], [seen.gaze[i], seen.depth[i]], rtol=1e-4)
        assert seen.visibility[i] == 1
    assert seen.gaze.min() > 0


def test04_points_before_on_and_behind_a_ball(ball):
    eye, points = (0, -3, 0), [(0, -1, 0), (0, -0.5, 0), (0, 0.5, 0), (0, 2, 0), (2, 0, 0)]
    seen = nerg.observe(ball, points, eye)
    assert np.array_equal(seen.visibility, [[1, 1, 0, 0, 1]])
    assert np.allclose(seen.distance, [[2, 2.5, 3.5, 5, np.sqrt(13)]])
    assert np.allclose(seen.depth[0, 2:4], 2.5, atol=1e-4) and np.isclose(seen.depth[0, 4], np.sqrt(13), atol=1e-3)
    assert np.array_equal(seen.gaze[0] > 0, [True, True, False, False, True])


def test05_gaze_at_a_point_is_that_of_the_ray_that_meets_it(scene):
    origins = [(0.3, -3, 0.4), (2.5, -1, 0.5)]
    is_valid = nerg.trace(
        scene, origins[0], [(-0.1, 1, -0.1), (-0.1, 1, 0)], ["position", "gaze", "visibility"], observers=origins
    )
    points = is_valid.position[0]
    seen = nerg.observe(scene, points, origins)
    # The rays of the first observer hit the points; the second observer sees some of them.
    assert np.allclose(seen.gaze[0], is_valid.gaze[0], rtol=1e-3) and np.array_equal(seen.visibility[0], [1, 1])
    assert seen.gaze.shape == (2, 2)


def test06_large_queries_equal_batches(scene, monkeypatch):
    from nerg_mi.environment import queries as query

    rng = np.random.default_rng(0)
    o, d = np.tile((0.3, -3, 0.4), (50, 1)), rng.normal(size=(50, 3)) * 0.2 + (0, 1, 0)
    full = nerg.trace(scene, o, d, observers=[(2.5, -1, 0.5)])
    points = nerg.observe(scene, rng.uniform(-1, 1, (50, 3)), (2.5, -1, 0.5))
    monkeypatch.setattr(query, "BATCH_SIZE", 16)
    rng = np.random.default_rng(0)
    d = rng.normal(size=(50, 3)) * 0.2 + (0, 1, 0)
    parts = nerg.trace(scene, o, d, observers=[(2.5, -1, 0.5)])
    for name in full:
        assert np.array_equal(full[name], parts[name]), name
    again = nerg.observe(scene, rng.uniform(-1, 1, (50, 3)), (2.5, -1, 0.5))
    for name in points:
        assert np.array_equal(points[name], again[name]), name


def test07_output_shapes(scene):
    rays = {"origins": (0, -3, 0), "directions": np.tile((0.0, 1, 0), (5, 1))}
    assert nerg.trace(scene, **rays, quantities=["color", "depth"]).color.shape == (5, 3)
    both = nerg.trace(scene, **rays, quantities=["color", "gaze"], observers=[(0, -3, 0), (1, -3, 0)])
    assert both.color.shape == (2, 5, 3) and both.gaze.shape == (2, 5) and both.axes == ("observer", "ray")
    assert nerg.trace(scene, np.tile((0.0, -3, 0), (5, 1)), (0, 1, 0), "depth").depth.shape == (5,)


def test08_the_scenes_own_observer_sees(files):
    scene = nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors", observer=(0, -3, 0))
    individual, options = nerg.observe(scene, (0, -2, 0)), nerg.observe(scene, (0, -2, 0), (0, -3, 0))
    assert np.array_equal(individual.gaze, options.gaze) and np.array_equal(individual.observers, [(0, -3, 0)])


@pytest.mark.parametrize(
    "call, said",
    [
        (lambda s: nerg.trace(s, (0, 0), (1, 0, 0)), "origins must have the shape"),
        (lambda s: nerg.trace(s, (0, 0, 0), (0, 0, 0)), "directions must not be zero, but row 0 is"),
        (
            lambda s: nerg.trace(s, np.zeros((2, 3)), np.ones((3, 3))),
            "number of origins must be 1 or that of the directions .3., got 2",
        ),
        (lambda s: nerg.trace(s, (0, 0, 0), (0, 0, 1), "gazes"), "gazes"),
        (lambda s: nerg.observe(s, (0, 0, 0)), "scene has no observer"),
        (lambda s: nerg.observe(s, (0, 0, 0), (0, 0, 1), "color"), '"color"'),
        (lambda s: nerg.observe(s, "there", (0, 0, 1)), "points must be x, y, z"),
    ],
)
def test09_errors_are_sentences(scene, call, said):
    with pytest.raises(nerg.NergError, match=said) as error:
        call(scene)
    assert "\n" not in str(error.value)


def test10_without_gaze_points_are_still_seen(files):
    scene = nerg.make_scene(files / "field.safetensors")
    assert nerg.observe(scene, (0, -2, 0), (0, -3, 0)).names == ("visibility", "distance", "depth")
    with pytest.raises(nerg.NergError, match='quantity "gaze" is not available'):
        nerg.observe(scene, (0, -2, 0), (0, -3, 0), "gaze")


def test11_mono(mono, files):
    scene = nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors")
    assert nerg.trace(scene, (0, -3, 0), (0, 1, 0), "color").color.shape == (1, 1)
    camera = nerg.Camera((0, -3, 0), (0, 0, 0), width=4, height=3)
    assert nerg.render(scene, quantities="color", camera=camera, spp=1).color.shape == (1, 3, 4, 1)


@pytest.mark.parametrize(("normalized", "expected"), [(True, [0.5, 1.0]), (False, [])])
def test_progress_is_reported_for_integrals_of_all_origins(tmp_path, rgb, normalized, expected):
    fields.gaze(tmp_path / "gaze.safetensors", normalized=normalized)
    scene = nerg.make_scene(gaze=tmp_path / "gaze.safetensors", shapes=BALL)
    messages = Recorder()
    nerg.trace(scene, [(0, -3, 0), (0, 3, 0), (0, -3, 0)], (0, 1, 0), "gaze", progress=messages)
    assert [share for share, _ in messages.steps] == expected
