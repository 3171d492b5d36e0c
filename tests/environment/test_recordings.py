"""Replayed images, rays and points equal traced ones to the bit, whatever changes between two of them."""

from __future__ import annotations

import functools
import gc
import re
import sys
import weakref
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.environment import bands
from nerg_mi.errors import NergError
from nerg_mi.fields import mlp
from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.fields.gaze_hits import HitKernel, ReaimedHits
from nerg_mi.formats.fields import save_gaze
from nerg_mi.formats.splats import write_ply_splats
from nerg_mi.registration import get_plugin_class
from nerg_mi.transport import recording, splat_lists
from nerg_mi.transport.geometry import Ceiling
from nerg_mi.transport.recording import Recorder
from tests.formats.splats.writers import random_splats
from tests.plugins import fields
from tests.plugins.scenes import camera, make_observer, put, scene_with, stored, with_field


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A radiance field, a gaze field with support, and the same with re-aimed hits."""
    folder, rng = tmp_path_factory.mktemp("recordings"), np.random.default_rng(5)
    fields.radiance(folder / "field.safetensors")
    gaze = fields.gaze(folder / "gaze.safetensors", normalized=True)
    origins = rng.uniform(-0.5, 0.5, (400, 3)).astype(np.float32) + np.float32((0, 0, -2.5))
    gaze.support = RaySupport.from_origins(origins, 0.5)
    save_gaze(gaze, folder / "gaze.safetensors", {})
    points = rng.uniform(-1, 1, (400, 3)).astype(np.float32)
    gaze.hits = ReaimedHits(origins, points, [HitKernel(0.3, 0.2, 30.0), HitKernel(0.2, 0.5, 8.0)])
    save_gaze(gaze, folder / "hits.safetensors", {})
    return folder


@pytest.fixture
def count_traces(monkeypatch):
    """A function that returns how often camera rays were traced."""
    calls = []
    trace = nerg_pixel().RenderContext.trace
    monkeypatch.setattr(nerg_pixel().RenderContext, "trace", lambda *args: calls.append(0) or trace(*args))
    return lambda: len(calls)


def nerg_pixel():
    """The module of the plugins of the current variant."""
    return sys.modules[get_plugin_class("nerg").__module__ + "_pixel"]


def make_settings(mi, files, gaze="hits", **overrides):
    return {
        "gaze": stored("gazefield", files / f"{gaze}.safetensors"),
        "aovs": "depth,opacity,gaze,visibility,observer_depth,support,position",
        "observer": make_observer(mi, -2, 0.3, -2),
        "falloff": 2.0,
        "map_height": 16,
        "directions": 512,
        "jitter": True,
        **overrides,
    }


def make_scene(mi, files, *args, **overrides):
    settings = make_settings(mi, files, *args, **overrides)
    return scene_with(mi, with_field(files, **settings), camera(mi, size=9))


def image(scene, sensor, spp, seed, layers=None):
    (band,) = bands.render_bands(scene, sensor, spp=spp, seed=seed, layers=layers)
    return np.array(band.film.develop())


# ---- Changes of a scene between two images ----


def move_camera(mi, scene, rng):
    params = mi.traverse(scene)
    position = rng.uniform(-0.5, 0.5, 3) + (0, 0, -2.5)
    put(params, "sensor.to_world", mi.ScalarTransform4f().look_at(position.tolist(), [0, 0, 0], [0, 1, 0]))


def change_lens(mi, scene, rng):
    params = mi.traverse(scene)
    params["sensor.x_fov"] = float(rng.uniform(30, 60))
    params["sensor.principal_point_offset_x"] = float(rng.uniform(-0.1, 0.1))
    params["sensor.near_clip"] = float(rng.uniform(0.01, 1.2))
    params["sensor.far_clip"] = float(rng.uniform(2.5, 5))
    params.update()


def move_observer(mi, scene, rng):
    x, y, z = rng.uniform(-0.5, 0.5, 3) + (-1.5, 0, -2)
    to_world = mi.ScalarTransform4f().translate([x, y, z])
    put(mi.traverse(scene), "integrator.observer.to_world", to_world)


def move_observer_to_camera(mi, scene, rng):
    """The image then needs no second march; if the observer is already there, they move away."""
    params = mi.traverse(scene)
    camera, observer = (params[f"{name}.to_world"] for name in ("sensor", "integrator.observer"))
    if np.array_equal(np.array(camera.matrix), np.array(observer.matrix)):
        move_observer(mi, scene, rng)
    else:
        put(params, "integrator.observer.to_world", type(camera)(camera))


def change_falloff(mi, scene, rng):
    put(mi.traverse(scene), "integrator.falloff", float(rng.uniform(2, 4)))


def change_weights(mi, scene, rng):
    params = mi.traverse(scene)
    names = [key for key in params.keys() if key.startswith(("integrator.field.", "integrator.gaze."))]
    name = names[rng.integers(len(names))]
    put(params, name, params[name] * float(rng.uniform(0.8, 1.2)))


def change_film(mi, scene, rng):
    params = mi.traverse(scene)
    width, height = (int(v) for v in rng.integers(6, 9, 2))
    params["sensor.film.size"] = [9, 10]
    params["sensor.film.crop_size"], params["sensor.film.crop_offset"] = [width, height], [1, int(rng.integers(2))]
    params.update()


def change_occlusion(mi, scene, rng):
    scene.integrator().occlusion = not scene.integrator().occlusion


def change_visibility(mi, scene, rng):
    settings = scene.integrator().observer_settings
    chosen = {"depth": "map", "map": "transmittance", "transmittance": "depth"}[settings.visibility]
    scene.integrator().observer_settings = replace(settings, visibility=chosen)


def change_tolerance(mi, scene, rng):
    settings = scene.integrator().observer_settings
    scene.integrator().observer_settings = replace(settings, tolerance=float(rng.uniform(0.01, 0.5)))


def change_steps(mi, scene, rng):
    scene.integrator().settings = replace(scene.integrator().settings, step=float(rng.uniform(0.05, 0.2)))


def change_jitter(mi, scene, rng):
    scene.integrator().jitter = not scene.integrator().jitter


def change_ceiling(mi, scene, rng):
    scene.integrator().ceiling = Ceiling(float(rng.uniform(-0.2, 0.2)), (0, 1, 0))


def change_background(mi, scene, rng):
    scene.integrator().background = mi.Spectrum(float(rng.uniform()))


CHANGES = [
    move_camera,
    change_lens,
    move_observer,
    move_observer_to_camera,
    change_falloff,
    change_weights,
    change_film,
    change_occlusion,
    change_visibility,
    change_tolerance,
    change_steps,
    change_jitter,
    change_ceiling,
    change_background,
]


class Subject:
    """A scene whose images are compared with traced ones."""

    def __init__(self, mi, files, gaze):
        self.mi, self.scene = mi, make_scene(mi, files, gaze)
        self.integrator, self.sensor = self.scene.integrator(), self.scene.sensors()[0]
        self.aovs, self.spp, self.seed = None, 1, 0

    def render(self):
        """The image, which must equal a traced one."""
        layer = bands.AovLayer(self.integrator, self.sensor, self.aovs)
        result = image(self.scene, self.sensor, self.spp, self.seed, layer)
        context = self.integrator.context() if self.aovs is None else self.integrator.make_context(self.aovs, True)
        traced = image(self.scene, self.sensor, self.spp, self.seed, TracedLayer(context, self.sensor))
        assert np.array_equal(result, traced)
        return result

    def record(self):
        """Render until images are replayed."""
        for _ in range(3):
            result = self.render()
        return result


@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test01_each_change_is_noticed(rgb, files, change):
    subject, rng = Subject(rgb, files, "hits"), np.random.default_rng(3)
    for _ in range(2):
        # Only what was recorded before the change could be replayed by mistake.
        subject.integrator.recorder.clear()
        before = subject.record()
        change(rgb, subject.scene, rng)
        after = subject.record()
        assert before.shape != after.shape or not np.array_equal(before, after)


@pytest.mark.parametrize(
    "changed", [{"spp": 2}, {"seed": 9}, {"aovs": ["gaze", "depth"]}, {"aovs": ["depth", "gaze"], "spp": 4}], ids=str
)
def test02_each_argument_is_noticed(rgb, files, changed):
    subject = Subject(rgb, files, "gaze")
    first = subject.record()
    vars(subject).update(changed)
    second = subject.record()
    assert first.shape != second.shape or not np.array_equal(first, second)


@pytest.mark.parametrize("gaze", ["gaze", "hits"])
def test07_constant_weights(rgb, files, gaze, count_traces, monkeypatch):
    """Weights in the kernel belong to the structure; images equal those with variable weights."""
    subject, rng = Subject(rgb, files, gaze), np.random.default_rng(5)
    networks = []
    evaluate = mlp.evaluate_with_constants
    monkeypatch.setattr(mlp, "evaluate_with_constants", lambda *args: networks.append(0) or evaluate(*args))
    expected = subject.record()
    assert not networks
    scene = nerg.Scene(subject.scene)
    scene.set_constant_weights()
    assert np.array_equal(subject.record(), expected) and networks
    moves = (move_camera, move_observer, change_falloff)
    for change in moves:
        change(rgb, subject.scene, rng)
        subject.record()
    for change in moves:
        traced = count_traces()
        change(rgb, subject.scene, rng)
        subject.render()
        # For comparison only.
        assert count_traces() == traced + 1
    for _ in range(3):
        previous = subject.record()
        while np.array_equal(subject.render(), previous):
            change_weights(rgb, subject.scene, rng)
    changed = subject.record()
    scene.set_constant_weights(False)
    assert np.array_equal(subject.record(), changed)


@pytest.mark.parametrize("gaze", ["gaze", "hits"])
def test03_sequences_of_changes_are_noticed(rgb, files, gaze, count_traces):
    """Images of earlier structures are replayed with what has changed since."""
    subject, rng, before = Subject(rgb, files, gaze), np.random.default_rng(3), count_traces()
    changes = [move_camera, move_observer, move_observer_to_camera, change_falloff, change_weights]
    for _ in range(40):
        changes[rng.integers(len(changes))](rgb, subject.scene, rng)
        subject.seed = int(rng.integers(100))
        subject.render()
    # Each image is also traced for comparison.
    assert 40 < count_traces() - before < 50


class TracedLayer:
    """The same image, without recordings and prepared observers."""

    recorder = None

    def __init__(self, context, sensor):
        self.context, self.sensor = context, sensor
        self.channel_names = [context.channel_names(context.aovs)]
        self.num_channels = len(self.channel_names[0])

    def sample(self, scene, sampler, ray, medium, active):
        view = self.context.trace(scene, [self.sensor], sampler, ray, active)
        channels = view.make_pixel().compute_channels(self.context.aovs)
        radiance, shown, _ = view.compute_radiance(scene, sampler, medium)
        return [(radiance, shown, channels)]


def test04_image_equals_that_of_mitsuba(rgb, files, count_traces):
    """The independent reference is ``mi.render``, which traces each image."""
    scene, rng = make_scene(rgb, files), np.random.default_rng(4)
    for seed in range(4):
        move_camera(rgb, scene, rng)
        move_observer(rgb, scene, rng)
        before = count_traces()
        replayed = image(scene, scene.sensors()[0], 2, seed)
        assert (count_traces() > before) == (seed < 2)
        assert np.array_equal(replayed, np.array(rgb.render(scene, spp=2, seed=seed)))


# ---- Calls of the library ----


def test05_pictures_of_several_observers_and_cameras(rgb, files, count_traces):
    scene, rng = nerg.Scene(make_scene(rgb, files)), np.random.default_rng(6)
    quantities = ["color", "depth", "gaze", "visibility"]
    for number in range(5):
        observers = rng.uniform(-0.5, 0.5, (2, 3)) + (0, 0, -2.5)
        view = nerg.Camera(rng.uniform(-0.5, 0.5, 3) + (0, 0, -2.5), (0, 0, 0), fov=40 + number, width=8, height=6)
        ask = functools.partial(nerg.render, scene, observers, quantities, camera=view, seed=number, spp=1)
        before = count_traces()
        replayed = ask()
        assert (count_traces() > before) == (number == 0)
        # Integrals of observers, too.
        scene.integrator.recorder.clear()
        scene.integrator.cache.clear()
        expected = ask()
        assert all(np.array_equal(replayed[name], expected[name]) for name in quantities), number
        # Recorded again, for the next number.
        scene.integrator.cache.clear()
        ask()


def test06_rays_and_points(rgb, files, count_traces):
    scene, rng = nerg.Scene(make_scene(rgb, files)), np.random.default_rng(7)
    for call in ("trace", "trace for origins", "observe"):
        for number in range(4):
            observers = (rng.uniform(-0.5, 0.5, (2, 3)) + (0, 0, -2.5)).astype(np.float32)
            directions = rng.normal(size=(20, 3)) * 0.2 + (0, 0, 1)

            def ask(call=call, observers=observers, directions=directions, seed=number):
                if call == "observe":
                    return nerg.observe(scene, directions * 0.5, observers)
                names = ["color", "depth", "gaze", "visibility", "support"]
                if call == "trace":
                    return nerg.trace(scene, observers[0], directions, names, observers=observers, seed=seed)
                return nerg.trace(scene, np.repeat(observers, 10, axis=0), directions, names, seed=seed)

            replayed = ask()
            scene.integrator.recorder.clear()
            expected = ask()
            assert all(np.array_equal(replayed[name], expected[name]) for name in expected.names), (call, number)
            ask()
            before = count_traces()
            ask()
            assert count_traces() == before


def test10_tensors_equal_those_of_mitsuba(rgb, files, count_traces):
    scene, rng, numbers = make_scene(rgb, files), np.random.default_rng(8), []
    for seed in range(4):
        move_camera(rgb, scene, rng)
        change_weights(rgb, scene, rng)
        before = count_traces()
        replayed = nerg.render_tensor(scene, spp=2, seed=seed)
        numbers.append(count_traces() - before)
        assert np.array_equal(replayed, rgb.render(scene, spp=2, seed=seed))
    assert numbers[0] == numbers[1] == 1 and numbers[3] == 0


# ---- Shapes and lights ----


def make_lit_scene(mi, files, medium=(), **overrides):
    """Shapes, lights and textures of several kinds, with or without a medium."""
    at = lambda *position: mi.ScalarTransform4f().translate(position)
    texture = {"type": "bitmap", "data": mi.TensorXf(np.full((4, 4, 3), 0.5, np.float32)), "raw": True}
    integrator = {
        "type": "nerg",
        "gaze": stored("gazefield", files / "gaze.safetensors"),
        "aovs": "depth,opacity,gaze,visibility,observer_depth,position",
        "observer": make_observer(mi, -2, 0.3, -2),
        "directions": 512,
        "falloff": 0.5,
        **dict(medium),
    }
    shapes = {
        "floor": {"type": "rectangle", "to_world": at(0, -1, 0).rotate([1, 0, 0], -90).scale(3)},
        "cube": {"type": "cube", "to_world": at(0.4, -0.3, 0).scale(0.3), "bsdf": {"type": "diffuse"}},
        "ball": {"type": "sphere", "to_world": at(-0.4, 0, 0).scale(0.3), "bsdf": {"type": "plastic"}},
        "wall": {"type": "rectangle", "to_world": at(0, 0, 1.5).rotate([0, 1, 0], 180).scale(3)},
        "lamp": {
            "type": "rectangle",
            "to_world": at(0, 2, 0).rotate([1, 0, 0], 90),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 5.0}},
        },
        "point": {"type": "point", "position": [0, 1, -1]},
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(np.full((4, 8, 3), 0.2, np.float32))},
        "group": {"type": "shapegroup", "part": {"type": "sphere"}},
        "instance": {
            "type": "instance",
            "shapegroup": {"type": "ref", "id": "group"},
            "to_world": at(0.3, 0.5, 0).scale(0.2),
        },
    }
    shapes["wall"]["bsdf"] = {"type": "roughplastic", "diffuse_reflectance": texture}
    return scene_with(mi, integrator, **({"sensor": camera(mi, size=8)} | shapes | overrides))


def set_parameter(name, change):
    """A function that changes a parameter of a scene; ``change`` takes its value and random numbers."""

    def set_value(mi, scene, rng):
        params = mi.traverse(scene)
        value = change(mi, params[name], rng)
        # Literals would compile kernels.
        dr.make_opaque(getattr(value, "matrix", value))
        put(params, name, value)

    set_value.__name__ = name
    return set_value


scale = lambda mi, value, rng: value * float(rng.uniform(0.7, 1.3))
shift = lambda mi, value, rng: value + mi.Float(rng.uniform(-0.02, 0.02, dr.width(value)))
place = lambda mi, value, rng: mi.Transform4f().translate(rng.uniform(-0.4, 0.4, 3).tolist()).scale(0.3)
LIT_CHANGES = [
    move_camera,
    move_observer,
    change_falloff,
    set_parameter("cube.vertex_positions", shift),
    set_parameter("ball.to_world", place),
    set_parameter("instance.to_world", place),
    set_parameter("lamp.emitter.radiance.value", scale),
    set_parameter("point.intensity.value", scale),
    set_parameter("point.position", lambda mi, value, rng: mi.Point3f(*rng.uniform(-1, 1, 3).tolist())),
    set_parameter("sky.scale", scale),
    set_parameter("sky.data", lambda mi, value, rng: mi.TensorXf(rng.uniform(0, 1, value.shape).astype(np.float32))),
    set_parameter("cube.bsdf.reflectance.value", scale),
    set_parameter("wall.bsdf.alpha", lambda mi, value, rng: mi.Float(rng.uniform(0.1, 0.4))),
    set_parameter(
        "wall.bsdf.diffuse_reflectance.data",
        lambda mi, value, rng: mi.TensorXf(rng.uniform(0, 1, value.shape).astype(np.float32)),
    ),
]
RARE_CHANGES = [
    # These change the program, which is traced again.
    set_parameter("point.sampling_weight", lambda mi, value, rng: float(rng.uniform(0.2, 4))),
    set_parameter("lamp.to_world", lambda mi, value, rng: mi.Transform4f().translate([0, rng.uniform(2.1, 3), 0])),
]
MEDIA = {"": {}, "field": {"depth": "expected"}}


def get_medium(files, name):
    return MEDIA[name] | ({"field": stored("nerf", files / "field.safetensors")} if name == "field" else {})


def render_both(mi, scene, seed):
    """The image, which equals that of Mitsuba."""
    result = image(scene, scene.sensors()[0], 1, seed)
    assert np.array_equal(result, np.array(mi.render(scene, spp=1, seed=seed)))
    return result


@pytest.mark.nightly
@pytest.mark.parametrize("change", LIT_CHANGES + RARE_CHANGES, ids=lambda change: change.__name__)
def test12_each_change_of_shapes_and_lights_is_noticed(rgb, files, change):
    scene, rng = make_lit_scene(rgb, files), np.random.default_rng(3)
    for _ in range(2):
        scene.integrator().recorder.clear()
        before = [render_both(rgb, scene, 1) for _ in range(3)][-1]
        change(rgb, scene, rng)
        after = [render_both(rgb, scene, 1) for _ in range(3)][-1]
        assert not np.array_equal(before, after)


@pytest.mark.parametrize("medium", MEDIA)
def test13_sequences_of_changes_of_shapes_and_lights_are_noticed(rgb, files, medium, count_traces):
    scene, rng = make_lit_scene(rgb, files, get_medium(files, medium)), np.random.default_rng(4)
    for change in LIT_CHANGES:
        # What has changed once is no literal, and needs no other kernel.
        change(rgb, scene, rng)
    before = count_traces()
    for _ in range(40):
        LIT_CHANGES[rng.integers(len(LIT_CHANGES))](rgb, scene, rng)
        render_both(rgb, scene, int(rng.integers(100)))
    # Mitsuba traces each image.
    assert 40 < count_traces() - before < 50


@pytest.mark.parametrize("is_lit", [False, True])
def test17_scenes_are_freed_with_their_recordings(rgb, files, is_lit):
    """Without a garbage collection: large fields have few objects, so that none may happen for long."""
    integrator = with_field(files, aovs="depth")
    shapes = {"ball": {"type": "sphere"}, "lamp": {"type": "point"}} if is_lit else {}
    scene = scene_with(rgb, integrator, camera(rgb, size=6), **shapes)
    for seed in range(3):
        image(scene, scene.sensors()[0], 1, seed)
    held = [weakref.ref(value) for value in (scene.integrator(), scene.integrator().recorder)]
    gc.collect()
    gc.disable()
    try:
        del scene
        assert [value() for value in held] == [None, None]
    finally:
        gc.enable()


# ---- Splats and volumes ----


def make_medium_scene(mi, files, medium, visibility="depth", **lens):
    """Splats, as lists or as a tree, a grid of densities, or a radiance field as a density."""
    data, grid = np.random.default_rng(2).uniform(0, 4, (5, 6, 7)).astype(np.float32), {"type": "gridvolume"}
    box = mi.ScalarTransform4f().translate([-0.5, -0.5, -0.5])
    children = {
        "lists": {"field": stored("splats", files / "splats.ply")},
        "tree": {"field": stored("splats", files / "splats.ply", lists=False)},
        "grid": {
            "density": {**grid, "grid": mi.VolumeGrid(data), "to_world": box},
            "color": {**grid, "grid": mi.VolumeGrid(np.stack([data / 4] * 3, -1)), "to_world": box},
        },
        "field": {"density": stored("nerf", files / "field.safetensors")},
    }[medium]
    integrator = {
        "type": "nerg",
        "gaze": stored("gazefield", files / "gaze.safetensors"),
        "aovs": "depth,opacity,gaze,visibility,position",
        "observer": make_observer(mi, -2, 0.3, -2),
        "falloff": 0.5,
        "visibility": visibility,
        "directions": 512,
        "map_height": 16,
        **children,
    }
    return scene_with(mi, integrator, camera(mi, size=9, **lens))


def change_medium(mi, scene, rng):
    params = mi.traverse(scene)
    names = [key for key in params.keys() if re.match(r"integrator\.(field\.opac|density\.)", key)]
    name = names[rng.integers(len(names))]
    put(params, name, params[name] * float(rng.uniform(0.7, 0.99)))


@pytest.mark.parametrize("visibility", ["depth", "map"])
@pytest.mark.parametrize("kind", ["lists", "tree", "grid", "field"])
def test15_sequences_of_changes_of_media_are_noticed(rgb, files, kind, visibility, count_traces, monkeypatch):
    monkeypatch.setattr(splat_lists, "MIN_GAUSSIANS", 1)
    write_ply_splats(files / "splats.ply", random_splats(60, degree=1))
    scene, rng = make_medium_scene(rgb, files, kind, visibility), np.random.default_rng(4)
    changes, before = [move_camera, move_observer, change_falloff, change_medium], count_traces()
    for _ in range(30):
        changes[rng.integers(len(changes))](rgb, scene, rng)
        render_both(rgb, scene, int(rng.integers(100)))
    # Mitsuba traces each image.
    assert 30 < count_traces() - before < 45


@pytest.mark.parametrize("kind", ["lists", "grid"])
def test16_observers_of_media(rgb, files, kind, monkeypatch):
    monkeypatch.setattr(splat_lists, "MIN_GAUSSIANS", 1)
    write_ply_splats(files / "splats.ply", random_splats(60, degree=1))
    scene, rng = nerg.Scene(make_medium_scene(rgb, files, kind)), np.random.default_rng(6)
    for number in range(4):
        points = rng.uniform(-0.4, 0.4, (20, 3))
        observers = rng.uniform(-0.5, 0.5, (2, 3)) + (0, 0, -2.5)
        ask = functools.partial(nerg.observe, scene, points, observers)
        replayed = ask()
        scene.integrator.recorder.clear()
        scene.integrator.cache.clear()
        expected = ask()
        assert all(np.array_equal(replayed[name], expected[name]) for name in expected.names), number
        ask()


def test18_gaussians_that_exchange_their_places_are_replayed(rgb, files, count_traces):
    """All bounds stay, and with them the recording, which reads another tree."""
    some = random_splats(60, degree=1)
    scales, rotations = np.full((60, 3), 0.2), np.tile([1, 0, 0, 0], (60, 1))
    write_ply_splats(files / "splats.ply", replace(some, scales=scales, rotations=rotations))
    scene, images, before = make_medium_scene(rgb, files, "tree"), [], count_traces()
    for _ in range(6):
        params = rgb.traverse(scene)
        centers = np.array(params["integrator.field.centers"]).reshape(60, 3)
        put(params, "integrator.field.centers", rgb.Float(np.roll(centers, 1, axis=0).ravel()))
        images.append(render_both(rgb, scene, 0))
    assert np.abs(np.diff(images, axis=0)).max(axis=(1, 2, 3)).min() > 0.01
    # Mitsuba traces each image.
    assert count_traces() <= before + 6 + 3


LENSES = {
    "thinlens": {"kind": "thinlens", "aperture_radius": 0.1, "focus_distance": 3},
    "orthographic": {"kind": "orthographic"},
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("has_own_observer", [True, False])
def test19_rays_of_other_cameras_are_sampled_before(rgb, files, count_traces, lens, has_own_observer):
    """Mitsuba 3.9.1 does not list all arrays of these cameras."""
    names = "depth,gaze,visibility,position" if has_own_observer or lens == "thinlens" else "depth,position"
    settings = make_settings(rgb, files, aovs=names)
    if not has_own_observer:
        del settings["observer"]
    sensor = {**camera(rgb, size=9, **LENSES[lens]), "shutter_close": 0.5}
    scene, rng = scene_with(rgb, with_field(files, **settings), sensor), np.random.default_rng(4)
    for number in range(8):
        move_camera(rgb, scene, rng)
        if has_own_observer:
            move_observer(rgb, scene, rng)
        if lens == "thinlens":
            params = rgb.traverse(scene)
            params["sensor.aperture_radius"] = float(rng.uniform(0.01, 0.2))
            put(params, "sensor.focus_distance", float(rng.uniform(1, 4)))
        if number >= 4:
            change_film(rgb, scene, np.random.default_rng(1))
        before = count_traces()
        replayed = image(scene, scene.sensors()[0], 2, number)
        assert (count_traces() > before) == (number % 4 < 2)
        assert np.array_equal(replayed, np.array(rgb.render(scene, spp=2, seed=number)))


@pytest.mark.parametrize("lens", LENSES)
def test20_lists_of_other_cameras_are_replayed(rgb, files, lens, count_traces, monkeypatch):
    monkeypatch.setattr(splat_lists, "MIN_GAUSSIANS", 1)
    write_ply_splats(files / "splats.ply", random_splats(60, degree=1))
    scene, rng = make_medium_scene(rgb, files, "lists", **LENSES[lens]), np.random.default_rng(4)
    before = count_traces()
    for seed in range(8):
        move_camera(rgb, scene, rng)
        move_observer(rgb, scene, rng)
        render_both(rgb, scene, seed)
    # Mitsuba traces each image.
    assert count_traces() <= before + 8 + 3


# ---- What cannot be recorded ----


@pytest.mark.parametrize("is_refused", [True, False])
def test14_arrays_that_are_not_listed_are_traced(rgb, files, recwarn, monkeypatch, is_refused):
    """As may be the case for other plugins."""
    monkeypatch.setattr(recording, "_SAMPLED_SENSORS", ())
    if not is_refused:
        monkeypatch.setattr(recording, "_LISTED_SENSORS", ("ThinLensCamera",))
    scene = scene_with(rgb, with_field(files, aovs="depth"), camera(rgb, size=6, **LENSES["thinlens"]))
    for seed in range(4):
        assert np.array_equal(nerg.render_tensor(scene, seed=seed), rgb.render(scene, seed=seed))
    (warning,) = recwarn
    assert ("sensor" if is_refused else "plugin") in str(warning.message)


def test08_derivatives_are_traced(rgb, files, count_traces):
    scene = scene_with(rgb, with_field(files, aovs="depth"), camera(rgb, size=6))
    params = rgb.traverse(scene)
    for _ in range(3):
        image(scene, scene.sensors()[0], 1, 0)
    dr.enable_grad(params["integrator.falloff"])
    params.update()
    before = count_traces()
    image(scene, scene.sensors()[0], 1, 0)
    assert count_traces() == before + 1


def test09_errors_are_those_of_the_function(rgb):
    recorder, number = Recorder(), rgb.Float([1, 2])
    fail = lambda: (_ for _ in ()).throw(NergError("a test"))
    for _ in range(3):
        with pytest.raises(NergError, match="a test"):
            recorder.run(fail, "fail", list, [number])
