"""What rays meet and what observers see of points: against pictures, and where the answer is known."""

import numpy as np
import pytest

import nerg_mi as nerg
from tests.plugins import fields
from tests.workflows.recorder import Recorder

BALL = {"type": "sphere", "radius": 0.5}


@pytest.fixture
def ball(files):
    """A ball of radius 1/2 around the origin, with a gaze field."""
    return nerg.make_scene(gaze=files / "gaze.safetensors", shapes=BALL)


def pixel_rays(rgb, scene, camera):
    """Rays through the middles of a camera's pixels."""
    sensor = scene.sensor(camera)
    x, y = np.meshgrid((np.arange(camera.width) + 0.5) / camera.width, (np.arange(camera.height) + 0.5) / camera.height)
    at = rgb.Point2f(np.float32(x.ravel()), np.float32(y.ravel()))
    ray, _ = sensor.sample_ray(0, 0, at, rgb.Point2f(0.5))
    return np.array(ray.o).T, np.array(ray.d).T


def test01_rays_are_those_of_a_fine_picture(scene, rgb):
    # One pixel of half a degree, through whose middle a ray goes.
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


def test03_who_stands_at_the_origin_of_a_ray_looks_along_it(scene):
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
    eyes = [(0.3, -3, 0.4), (2.5, -1, 0.5)]
    there = nerg.trace(
        scene, eyes[0], [(-0.1, 1, -0.1), (-0.1, 1, 0)], ["position", "gaze", "visibility"], observers=eyes
    )
    points = there.position[0]
    seen = nerg.observe(scene, points, eyes)
    # The first observer's own rays meet the points; the second sees some of them.
    assert np.allclose(seen.gaze[0], there.gaze[0], rtol=1e-3) and np.array_equal(seen.visibility[0], [1, 1])
    assert seen.gaze.shape == (2, 2)


def test06_many_are_batches_of_few(scene, monkeypatch):
    from nerg_mi.api import query

    rng = np.random.default_rng(0)
    o, d = np.tile((0.3, -3, 0.4), (50, 1)), rng.normal(size=(50, 3)) * 0.2 + (0, 1, 0)
    whole = nerg.trace(scene, o, d, observers=[(2.5, -1, 0.5)])
    points = nerg.observe(scene, rng.uniform(-1, 1, (50, 3)), (2.5, -1, 0.5))
    monkeypatch.setattr(query, "BATCH", 16)
    rng = np.random.default_rng(0)
    d = rng.normal(size=(50, 3)) * 0.2 + (0, 1, 0)
    parts = nerg.trace(scene, o, d, observers=[(2.5, -1, 0.5)])
    for name in whole:
        assert np.array_equal(whole[name], parts[name]), name
    again = nerg.observe(scene, rng.uniform(-1, 1, (50, 3)), (2.5, -1, 0.5))
    for name in points:
        assert np.array_equal(points[name], again[name]), name


def test07_shapes_of_what_comes_out(scene):
    rays = {"origins": (0, -3, 0), "directions": np.tile((0.0, 1, 0), (5, 1))}
    assert nerg.trace(scene, **rays, quantities=["color", "depth"]).color.shape == (5, 3)
    both = nerg.trace(scene, **rays, quantities=["color", "gaze"], observers=[(0, -3, 0), (1, -3, 0)])
    assert both.color.shape == (2, 5, 3) and both.gaze.shape == (2, 5) and both.axes == ("observer", "ray")
    assert nerg.trace(scene, np.tile((0.0, -3, 0), (5, 1)), (0, 1, 0), "depth").depth.shape == (5,)


def test08_the_scenes_own_observer_sees(files):
    scene = nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors", observer=(0, -3, 0))
    own, given = nerg.observe(scene, (0, -2, 0)), nerg.observe(scene, (0, -2, 0), (0, -3, 0))
    assert np.array_equal(own.gaze, given.gaze) and np.array_equal(own.observers, [(0, -3, 0)])


@pytest.mark.parametrize(
    "call, said",
    [
        (lambda s: nerg.trace(s, (0, 0), (1, 0, 0)), "origins must have the shape"),
        (lambda s: nerg.trace(s, (0, 0, 0), (0, 0, 0)), "directions must not be zero, and row 0 is"),
        (lambda s: nerg.trace(s, np.zeros((2, 3)), np.ones((3, 3))), "one origin or as many as directions, 3, got 2"),
        (lambda s: nerg.trace(s, (0, 0, 0), (0, 0, 1), "gazes"), "gazes"),
        (lambda s: nerg.observe(s, (0, 0, 0)), "scene has no observer"),
        (lambda s: nerg.observe(s, (0, 0, 0), (0, 0, 1), "color"), '"color"'),
        (lambda s: nerg.observe(s, "there", (0, 0, 1)), "points must be numbers"),
    ],
)
def test09_errors_are_sentences(scene, call, said):
    with pytest.raises(nerg.NergError, match=said) as error:
        call(scene)
    assert "\n" not in str(error.value)


def test10_without_gaze_points_are_still_seen(files):
    scene = nerg.make_scene(files / "field.safetensors")
    assert nerg.observe(scene, (0, -2, 0), (0, -3, 0)).names == ("visibility", "distance", "depth")
    with pytest.raises(nerg.NergError, match='no quantity "gaze" here'):
        nerg.observe(scene, (0, -2, 0), (0, -3, 0), "gaze")


def test11_mono(mono, files):
    scene = nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors")
    assert nerg.trace(scene, (0, -3, 0), (0, 1, 0), "color").color.shape == (1, 1)
    camera = nerg.Camera((0, -3, 0), (0, 0, 0), width=4, height=3)
    assert nerg.render(scene, quantities="color", camera=camera, spp=1).color.shape == (1, 3, 4, 1)


@pytest.mark.parametrize(("normalized", "expected"), [(True, [0.5, 1.0]), (False, [])])
def test_progress_is_told_where_every_origin_is_integrated(tmp_path, rgb, normalized, expected):
    fields.gaze(tmp_path / "gaze.safetensors", normalized=normalized)
    scene = nerg.make_scene(gaze=tmp_path / "gaze.safetensors", shapes=BALL)
    told = Recorder()
    nerg.trace(scene, [(0, -3, 0), (0, 3, 0), (0, -3, 0)], (0, 1, 0), "gaze", reporter=told)
    assert [share for share, _ in told.steps] == expected
