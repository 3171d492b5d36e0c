"""Rendering in bands, additional AOVs, and long renderings."""

from __future__ import annotations

import numpy as np
import pytest
from nerg_mi.scenes.store import SCENE_FILE

from nerg_mi.environment import bands
from nerg_mi.environment.bands import (
    LONG_RENDER_SAMPLES,
    MIN_STRIP_SAMPLES,
    PACKET_SIZE,
    Channels,
    ConstantWeightsTrial,
    IntegratorLayer,
    SamplePace,
    get_trained_fields,
    render_aovs,
    render_bands,
    render_channels,
)
from nerg_mi.environment.scene_loading import load_scene
from nerg_mi.errors import NergError
from tests.plugins import fields
from tests.plugins.scenes import camera, constant, make_observer, plugin, with_gaze

# ---- Divided images ----


def make_neural_scene(mi, folder, sensor, **kwargs):
    fields.radiance(folder / "field.safetensors", density_scale=2.0)
    fields.gaze(folder / "gaze.safetensors")
    integrator = plugin(
        "nerg",
        field={"type": "nerf", "filename": str(folder / "field.safetensors")},
        gaze={"type": "gazefield", "filename": str(folder / "gaze.safetensors")},
        jitter=True,
        **{"aovs": "depth,gaze,visibility,position", **kwargs},
    )
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})


def make_panorama(mi):
    return plugin(
        "panorama",
        to_world=mi.ScalarTransform4f().translate([0.3, 0, -2]),
        film=camera(mi)["film"] | {"width": 24, "height": 13},
    )


def make_lit_scene(mi, film, sensor="perspective", sampler="independent"):
    """A textured ball under `path`, which draws random numbers in its own loop."""
    return mi.load_dict(
        plugin(
            "scene",
            integrator={"type": "aov", "aovs": "dd:depth", "in": {"type": "path", "max_depth": 3}},
            ball={"type": "sphere", "b": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}},
            sky={"type": "constant"},
            sensor=plugin(
                sensor,
                to_world=mi.ScalarTransform4f().look_at([0, 0, -4], [0, 0, 0], [0, 1, 0]),
                film={"type": "hdrfilm", **film},
                sampler={"type": sampler, "seed": 11},
            ),
        )
    )


def render_undivided(mi, scene, spp, seed=3):
    mi.render(scene, spp=spp, seed=seed)
    return np.array(scene.sensors()[0].film().bitmap())


def render_divided(scene, spp, seed=3, strip=0, **kwargs):
    parts = bands.render_bands(scene, scene.sensors()[0], spp=spp, seed=seed, pace=bands.SamplePace(strip), **kwargs)
    return np.concatenate([np.array(band.film.bitmap())[: band.rows] for band in parts])


BOX = {"width": 18, "height": 11, "rfilter": {"type": "box"}, "component_format": "float32"}


@pytest.mark.parametrize("spp", [1, 3, 16])
def test_divided_shapes_are_bitwise_equal(rgb, spp):
    scene = make_lit_scene(rgb, BOX)
    expected = render_undivided(rgb, scene, spp)
    assert expected.std() > 0.1
    for rows, strip in ((0, 0), (1, 0), (4, 64), (5, 200)):
        assert np.array_equal(render_divided(scene, spp, rows=rows, strip=strip), expected), (rows, strip)


def test_divided_fog_is_bitwise_equal(rgb):
    fog = {"type": "homogeneous", "albedo": 0.9, "sigma_t": 0.8}
    scene = rgb.load_dict(
        plugin(
            "scene",
            integrator={"type": "volpath", "max_depth": 4},
            sky={"type": "constant"},
            room=plugin("cube", to_world=rgb.ScalarTransform4f().scale(3), bsdf={"type": "null"}, interior=fog),
            ball={"type": "sphere", "radius": 0.5},
            sensor=plugin(
                "perspective",
                to_world=rgb.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0]),
                medium=fog,
                film={"type": "hdrfilm", **BOX},
            ),
        )
    )
    assert bands.undividable_reason(scene, scene.sensors()[0]) is None
    assert np.array_equal(render_divided(scene, 4, rows=4), render_undivided(rgb, scene, 4))


def test_integrator_with_own_render_is_undivided(rgb):
    class OverridingIntegrator(rgb.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            return rgb.Color3f(0), True, []

        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            return super().render(scene, sensor, seed, spp, develop, evaluate)

    rgb.register_integrator("own_render", OverridingIntegrator)
    scene = rgb.load_dict({"type": "scene", "integrator": {"type": "own_render"}, "sensor": {"type": "perspective"}})
    assert "overrides render()" in bands.undividable_reason(scene, scene.sensors()[0])


@pytest.mark.parametrize("sensor", ["perspective", "panorama"])
def test_divided_fields_with_observer_are_bitwise_equal(rgb, tmp_path, sensor):
    eye = camera(rgb, size=17) if sensor == "perspective" else make_panorama(rgb)
    scene = make_neural_scene(rgb, tmp_path, eye, observer=make_observer(rgb, -3, 0.5, 0.5), falloff=1.0)
    expected = render_undivided(rgb, scene, 2)
    assert np.any(expected[..., 4] > 0)
    assert np.array_equal(render_divided(scene, 2, rows=9, strip=256), expected)


def test_observer_is_the_rendering_camera(rgb, tmp_path):
    scene = make_neural_scene(rgb, tmp_path, camera(rgb, size=12), visibility="depth", aovs="gaze,observer_depth")
    other = rgb.load_dict(camera(rgb, (3, 1, 2), size=12))
    rgb.render(scene, sensor=other, spp=1, seed=0)
    expected = np.array(other.film().bitmap())
    parts = [np.array(b.film.bitmap())[: b.rows] for b in bands.render_bands(scene, other, spp=1, rows=5)]
    assert np.array_equal(np.concatenate(parts), expected)


def test_accumulation_matches_for_a_million_values(rgb):
    # Dr.Jit accumulates into large arrays in another order.
    scene = make_lit_scene(rgb, BOX | {"width": 500, "height": 300})
    expected = render_undivided(rgb, scene, 4)
    assert expected.size > 1e6
    assert np.array_equal(render_divided(scene, 4, rows=60), expected)


@pytest.mark.parametrize(
    "film",
    [
        BOX | {"crop_width": 9, "crop_height": 7, "crop_offset_x": 5, "crop_offset_y": 2},
        BOX | {"pixel_format": "rgba"},
        BOX | {"pixel_format": "luminance"},
        BOX | {"rfilter": {"type": "tent"}, "sample_border": True},
        BOX | {"rfilter": {"type": "gaussian"}},
    ],
)
def test_other_films(rgb, film):
    scene = make_lit_scene(rgb, film)
    expected = render_undivided(rgb, scene, 4)
    window = [list(v) for v in (scene.sensors()[0].film().crop_size(), scene.sensors()[0].film().crop_offset())]
    image = render_divided(scene, 4, rows=3, strip=128)
    if film["rfilter"]["type"] == "box":
        assert np.array_equal(image, expected)
    else:
        assert np.allclose(image, expected, rtol=1e-4, atol=1e-4)
    # The scene is unchanged.
    assert [list(v) for v in (scene.sensors()[0].film().crop_size(), scene.sensors()[0].film().crop_offset())] == window


def test_mono(mono):
    scene = mono.load_dict(
        {"type": "scene", "integrator": constant(0.8, aovs="depth", background=0.2), "sensor": camera(mono, size=9)}
    )
    assert np.array_equal(render_divided(scene, 2, rows=4), render_undivided(mono, scene, 2))


def test_undividable_image_is_one_band(rgb):
    scene = make_lit_scene(rgb, BOX, sampler="stratified")
    assert "StratifiedSampler" in bands.undividable_reason(scene, scene.sensors()[0])
    assert len(list(bands.render_bands(scene, scene.sensors()[0], spp=4, rows=2))) == 1
    assert np.array_equal(render_divided(scene, 4, rows=2), render_undivided(rgb, scene, 4))


def test_bands_scale_with_pixels(rgb):
    memory = 10e6
    small = make_lit_scene(rgb, BOX | {"width": 200, "height": 400})
    large = make_lit_scene(rgb, BOX | {"width": 200, "height": 3200})
    rows = [bands.fit_rows_to_memory(s, s.sensors()[0], memory) for s in (small, large)]
    assert rows[0] == rows[1] and 0 < rows[0] < 400
    for scene, count in ((small, -(-400 // rows[0])), (large, -(-3200 // rows[0]))):
        sizes = [
            np.array(b.film.bitmap()).nbytes for b in bands.render_bands(scene, scene.sensors()[0], spp=1, rows=rows[0])
        ]
        assert len(sizes) == count and max(sizes) < memory / 3
    assert bands.fit_rows_to_memory(small, small.sensors()[0], 1.0) == 1


def test_wide_filter_has_a_minimum_band(rgb):
    """Even if the scene exhausts the memory: each band renders the rows around it again."""
    scene = make_lit_scene(rgb, {"width": 18, "height": 200, "rfilter": {"type": "gaussian"}})
    rows = bands.fit_rows_to_memory(scene, scene.sensors()[0], -1e9)
    totals = []
    for _ in bands.render_bands(
        scene, scene.sensors()[0], spp=1, rows=rows, on_strip=lambda done, total: totals.append(total)
    ):
        pass
    assert 1 < rows < 50 and totals[-1] < 1.3 * 18 * 200


def test_progress_and_interruption(rgb):
    scene, seen = make_lit_scene(rgb, BOX), []
    render_divided(scene, 2, rows=4, strip=64, on_strip=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (18 * 11 * 2, 18 * 11 * 2) and len(seen) > 5
    assert [d for d, _ in seen] == sorted(d for d, _ in seen)

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_divided(scene, 2, rows=4, strip=64, on_strip=stop)
    assert tuple(scene.sensors()[0].film().crop_size()) == (18, 11)


# ---- Channels ----


@pytest.fixture
def scene_channels(rgb):
    return rgb.load_dict(
        plugin(
            "scene",
            integrator=plugin("nerg", density={"type": "constvolume", "value": 3.0}, aovs="depth,opacity,position"),
            sensor=plugin(
                "perspective",
                to_world=rgb.ScalarTransform4f().look_at([0.5, 0.5, -2], [0.5, 0.5, 0], [0, 1, 0]),
                film={"type": "hdrfilm", "width": 9, "height": 6, "rfilter": {"type": "box"}},
            ),
        )
    )


def test_channels_by_name(rgb, scene_channels):
    seen = render_channels(scene_channels, scene_channels.sensors()[0], spp=4, seed=3)
    render_undivided = np.array(rgb.render(scene_channels, spp=4, seed=3))
    assert list(seen.aovs) == ["depth", "opacity", "position.X", "position.Y", "position.Z"]
    assert seen.color.shape == (6, 9, 3) and np.array_equal(seen.color, render_undivided[..., :3])
    for k, channel in enumerate(seen.aovs.values()):
        assert np.array_equal(channel, render_undivided[..., 3 + k])
    assert tuple(seen.bitmap.size()) == (9, 6)


def test_mono_becomes_rgb(mono):
    scene = mono.load_dict(
        plugin(
            "scene",
            integrator={"type": "direct"},
            light={"type": "constant"},
            sensor={"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 3}},
        )
    )
    assert render_channels(scene, scene.sensors()[0], spp=1).color.shape == (3, 4, 3)


def test_mask_is_half_opacity():
    seen = Channels(np.zeros((1, 3, 3)), {"opacity": np.array([[0.49, 0.5, 1.0]])}, None)
    assert seen.mask.tolist() == [[False, True, True]]


# ---- Layers ----


@pytest.fixture
def scene_layers(rgb):
    film = {"type": "hdrfilm", "width": 9, "height": 7, "rfilter": {"type": "box"}, "component_format": "float32"}
    camera = {"type": "perspective", "to_world": rgb.ScalarTransform4f().translate([0, 0, -4]), "film": film}
    integrator = {"type": "nerg", "aovs": "depth,opacity"}
    return rgb.load_dict({"type": "scene", "integrator": integrator, "camera": camera, "ball": {"type": "sphere"}})


class TwoLayers:
    """The image of the scene, and one with twice its depths."""

    def __init__(self, integrator):
        self.integrator, self.channel_names, self.num_channels = integrator, [integrator.aov_names(), ["twice.T"]], 3
        self.recorder = None

    def sample(self, *ray):
        radiance, valid, aovs = self.integrator.sample(*ray)
        yield radiance, valid, aovs
        yield 0, valid, [2 * aovs[0]]


def test01_integrator_is_one_layer(rgb, scene_layers):
    layer = IntegratorLayer(scene_layers.integrator())
    assert layer.channel_names == [["depth.T", "opacity.Y"]] and layer.num_channels == 2
    (band,) = render_bands(scene_layers, scene_layers.sensors()[0], spp=4, layers=layer)
    assert band.layer == 0
    assert np.array_equal(np.array(band.film.develop()), np.array(rgb.render(scene_layers, spp=4)))


@pytest.mark.parametrize("rows", [0, 3])
def test02_layers_alternate_in_each_band(rgb, scene_layers, rows):
    expected, pictures = np.array(rgb.render(scene_layers, spp=4)), ([], [])
    for band in render_bands(
        scene_layers, scene_layers.sensors()[0], spp=4, rows=rows, layers=TwoLayers(scene_layers.integrator())
    ):
        pictures[band.layer].append(np.array(band.film.develop())[: band.rows])
    first, twice = (np.concatenate(parts) for parts in pictures)
    assert np.array_equal(first, expected)
    assert np.allclose(twice[..., 3], 2 * first[..., 3]) and not twice[..., :3].any()


# ---- Strips ----


class Clock:
    """A clock that advances only by ``take``."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr(bands.time, "perf_counter", lambda: self.now)

    def take(self, it, seconds, times=1):
        for _ in range(times):
            self.now += seconds
            it.wait()


@pytest.mark.parametrize(("fixed", "spp"), [(1 << 12, 1), (1 << 12, 3), (100, 1), (0, 4)])
def test03_strips_consist_of_whole_packets_and_pixels(rgb, fixed, spp):
    start, stop = 1000 * spp, 1000 * spp + 50_000 * spp
    strips = list(SamplePace(fixed).iter_strips(start, stop, spp))
    assert strips[0][0] == start - start % PACKET_SIZE and sum(strips[-1]) == stop
    assert all(a + n == b for (a, n), (b, _) in zip(strips, strips[1:]))
    assert all((a + n) % PACKET_SIZE == 0 == (a + n) % spp for a, n in strips[:-1])


def first_strip(it):
    return next(iter(it.iter_strips(0, 1 << 22, 1)))[1]


def test04_strip_size_adapts_within_limits(rgb, monkeypatch):
    clock, it = Clock(monkeypatch), SamplePace()
    before = first_strip(it)
    # The first two strips do not count, because of compilation.
    clock.take(it, 0.01, 2)
    assert first_strip(it) == before
    clock.take(it, 0.01)
    assert first_strip(it) == 2 * before
    clock.take(it, 0.7 * bands.STRIP_SECONDS)
    assert first_strip(it) == 2 * before
    clock.take(it, 0.01, 20)
    assert first_strip(it) == 1 << 18
    clock.take(it, 2 * bands.STRIP_SECONDS, 40)
    assert first_strip(it) == MIN_STRIP_SAMPLES


def test05_fixed_strip_size(rgb, monkeypatch):
    clock, it = Clock(monkeypatch), SamplePace(1 << 13)
    clock.take(it, 0.01, 10)
    assert first_strip(it) == 1 << 13


def test06_pace_carries_over_to_next_image(rgb, monkeypatch):
    clock, it = Clock(monkeypatch), SamplePace()
    before = first_strip(it)
    clock.take(it, 0.01, 4)
    grown = first_strip(it)
    assert grown > before
    # Loading the next scene does not count.
    it.begin()
    clock.take(it, 10 * bands.STRIP_SECONDS)
    clock.take(it, 10 * bands.STRIP_SECONDS)
    assert first_strip(it) == grown
    clock.take(it, 2 * bands.STRIP_SECONDS)
    assert first_strip(it) == grown // 2


# ---- Random numbers of a range of samples ----


@pytest.mark.parametrize("base, seed", [(0, 0), (5, 9), (4294967295, 3)])
def test_random_numbers_equal_undivided_image(rgb, base, seed):
    sampler = rgb.load_dict({"type": "independent", "seed": base, "sample_count": 2})
    assert bands.get_base_seed(sampler) == base
    sampler.seed(seed, 1000)
    theirs = np.array([sampler.next_1d(), *sampler.next_2d()])
    part = bands.make_sampler(2, rgb.UInt32((base + seed) & 0xFFFFFFFF), rgb.UInt64(137), 500)
    assert np.array_equal(np.array([part.next_1d(), *part.next_2d()]), theirs[:, 137:637])


def test_sampler_clone_is_independent(rgb):
    sampler = bands.make_sampler(1, rgb.UInt32(0), rgb.UInt64(0), 10)
    copy = sampler.clone()
    first = np.array(sampler.next_1d())
    assert np.array_equal(np.array(copy.next_1d()), first)
    assert not np.array_equal(np.array(copy.next_1d()), first)


def test_random_numbers_beyond_2_to_32(rgb):
    near, far = (
        np.array(bands.make_sampler(1, rgb.UInt32(0), rgb.UInt64(first), 64).next_1d()) for first in (0, 1 << 32)
    )
    assert not np.any(near == far)


def test_other_samplers_have_no_base_seed(rgb):
    assert bands.get_base_seed(rgb.load_dict({"type": "stratified"})) is None


# ---- Additional AOVs ----


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("fields")
    fields.radiance(folder / "field.safetensors", density_scale=6.0)
    fields.gaze(folder / "gaze.safetensors")
    return folder


@pytest.mark.parametrize("observed", [False, True])
def test_render_aovs_equals_scene_with_aovs(rgb, files, observed):
    observer = {"observer": make_observer(rgb, -0.4, 0.2, -2.5)} if observed else {}
    names = ["gaze", "opacity", "depth"]
    load = lambda aovs: rgb.load_dict(
        {"type": "scene", "integrator": with_gaze(files, aovs=aovs, **observer), "sensor": camera(rgb)}
    )
    expected, bare = load(",".join(names)), load("depth")
    wanted = render_channels(expected, expected.sensors()[0], spp=2, seed=3)
    channels = render_aovs("a.xml", bare, bare.sensors()[0], names, 2, 3)
    assert channels.aovs["gaze"].max() > 0
    np.testing.assert_array_equal(channels.color, wanted.color)
    for name in names:
        np.testing.assert_array_equal(channels.aovs[name], wanted.aovs[name])


def test_invalid_aov_requests_are_refused(rgb, files):
    path = {"type": "scene", "integrator": {"type": "path"}, "sensor": camera(rgb), "shape": {"type": "sphere"}}
    scene = rgb.load_dict(path)
    with pytest.raises(NergError, match='"PathIntegrator".*"nerg scene a.xml -o new.xml"'):
        render_aovs("a.xml", scene, scene.sensors()[0], ["depth"])
    scene = rgb.load_dict({"type": "scene", "integrator": with_gaze(files), "sensor": camera(rgb)})
    with pytest.raises(NergError, match='"kde", which needs'):
        render_aovs("a.xml", scene, scene.sensors()[0], ["kde"])
    stratified = camera(rgb) | {"sampler": {"type": "stratified", "sample_count": 4}}
    scene = rgb.load_dict({"type": "scene", "integrator": with_gaze(files), "sensor": stratified})
    with pytest.raises(NergError, match="overlay because of the sampler"):
        render_aovs("a.xml", scene, scene.sensors()[0], ["gaze"])


# ---- Long renderings ----

SMALL = {"width": "24", "height": "16", "spp": "1"}


def list_networks(scene):
    return [net for field in get_trained_fields(scene.integrator()) for net in field.mlps]


def run_trial(scene, images, samples, seconds):
    """Return whether the weights of each of ``images`` images were constant, if those with constant weights take
    ``seconds`` and the others 1 s."""
    trial, chosen = ConstantWeightsTrial(images), []
    for _ in range(images):
        chosen.append(trial.prepare(samples, scene))
        # The first image of each kind compiles.
        compiles = chosen.count(chosen[-1]) == 1
        trial.record(chosen[-1], samples, 100 if compiles else seconds if chosen[-1] else 1.0)
    return chosen


@pytest.mark.nightly
def test07_constant_weights_are_used_where_they_are_faster_and_equal(rgb):
    plain, scene = load_scene(SCENE_FILE, SMALL), load_scene(SCENE_FILE, SMALL)
    long = LONG_RENDER_SAMPLES // 20
    # Short sequences, by their samples and by their images
    assert not any(run_trial(plain, 20, long - 1, 0.5) + run_trial(plain, 5, 4 * long, 0.5))
    assert not any(net.has_constant_weights for net in list_networks(plain))
    slower, faster = (run_trial(load_scene(SCENE_FILE, SMALL), 21, long, s) for s in (1.5, 0.5))
    assert slower == [False] * 3 + [True] * 3 + [False] * 15 and faster == [False] * 3 + [True] * 18
    trial = ConstantWeightsTrial(21)
    for _ in range(3):
        trial.record(trial.prepare(long, plain), long, 1.0)
    assert trial.prepare(long, scene) and [net.has_constant_weights for net in list_networks(scene)] == [True] * 5
    before, expected = (np.array(rgb.render(s, sensor=0, spp=1)) for s in (scene, plain))
    assert expected[..., :3].max() > 0.1 and np.array_equal(before, expected)


def test08_scene_without_fields_has_no_trial(rgb):
    shapes = rgb.load_dict({"type": "scene", "integrator": {"type": "nerg"}, "ball": {"type": "sphere"}})
    scenes = rgb.load_dict({"type": "scene", "integrator": {"type": "path"}, "ball": {"type": "sphere"}})
    for scene in (shapes, scenes):
        assert not any(run_trial(scene, 20, LONG_RENDER_SAMPLES, 0.5))
