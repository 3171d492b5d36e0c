"""A picture is the same however it is divided, and its memory is that of a band."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.rendering import bands
from tests.plugins import fields
from tests.plugins.scenes import camera, constant, observer_at


def neural(mi, folder, sensor, **kwargs):
    fields.radiance(folder / "field.safetensors", density_scale=2.0)
    fields.gaze(folder / "gaze.safetensors")
    integrator = {
        "type": "nerg",
        "field": {"type": "nerf", "filename": str(folder / "field.safetensors")},
        "gaze": {"type": "gazefield", "filename": str(folder / "gaze.safetensors")},
        "aovs": "depth,gaze,visibility,position",
        "jitter": True,
        **kwargs,
    }
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})


def panorama(mi):
    return {
        "type": "panorama",
        "to_world": mi.ScalarTransform4f().translate([0.3, 0, -2]),
        "film": camera(mi)["film"] | {"width": 24, "height": 13},
    }


def lit(mi, film, sensor="perspective", sampler="independent"):
    """A textured ball under `path`, which draws random numbers in a loop of its own."""
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "aov", "aovs": "dd:depth", "in": {"type": "path", "max_depth": 3}},
            "ball": {"type": "sphere", "b": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}},
            "sky": {"type": "constant"},
            "sensor": {
                "type": sensor,
                "to_world": mi.ScalarTransform4f().look_at([0, 0, -4], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", **film},
                "sampler": {"type": sampler, "seed": 11},
            },
        }
    )


def whole(mi, scene, spp, seed=3):
    mi.render(scene, spp=spp, seed=seed)
    return np.array(scene.sensors()[0].film().bitmap())


def divided(scene, spp, seed=3, **kwargs):
    parts = bands.render_bands(scene, scene.sensors()[0], spp=spp, seed=seed, **kwargs)
    return np.concatenate([np.array(band.film.bitmap())[: band.rows] for band in parts])


BOX = {"width": 18, "height": 11, "rfilter": {"type": "box"}, "component_format": "float32"}


@pytest.mark.parametrize("spp", [1, 3, 16])
def test_shapes_are_the_same_to_the_bit(rgb, spp):
    scene = lit(rgb, BOX)
    expected = whole(rgb, scene, spp)
    assert expected.std() > 0.1
    for rows, strip in ((0, 0), (1, 0), (4, 64), (5, 200)):
        assert np.array_equal(divided(scene, spp, rows=rows, strip=strip), expected), (rows, strip)


def test_a_camera_in_fog_is_the_same_to_the_bit(rgb):
    fog = {"type": "homogeneous", "albedo": 0.9, "sigma_t": 0.8}
    scene = rgb.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 4},
            "sky": {"type": "constant"},
            "room": {
                "type": "cube",
                "to_world": rgb.ScalarTransform4f().scale(3),
                "bsdf": {"type": "null"},
                "interior": fog,
            },
            "ball": {"type": "sphere", "radius": 0.5},
            "sensor": {
                "type": "perspective",
                "to_world": rgb.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0]),
                "medium": fog,
                "film": {"type": "hdrfilm", **BOX},
            },
        }
    )
    assert bands.why_whole(scene, scene.sensors()[0]) is None
    assert np.array_equal(divided(scene, 4, rows=4), whole(rgb, scene, 4))


def test_an_integrator_that_renders_in_a_way_of_its_own_is_asked_to(rgb):
    class Own(rgb.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            return rgb.Color3f(0), True, []

        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            return super().render(scene, sensor, seed, spp, develop, evaluate)

    rgb.register_integrator("own_render", Own)
    scene = rgb.load_dict({"type": "scene", "integrator": {"type": "own_render"}, "sensor": {"type": "perspective"}})
    assert "a way of its own" in bands.why_whole(scene, scene.sensors()[0])


@pytest.mark.parametrize("sensor", ["perspective", "panorama"])
def test_fields_seen_by_an_observer_elsewhere_are_the_same_to_the_bit(rgb, tmp_path, sensor):
    eye = camera(rgb, size=17) if sensor == "perspective" else panorama(rgb)
    scene = neural(rgb, tmp_path, eye, observer=observer_at(rgb, -3, 0.5, 0.5), falloff=1.0)
    expected = whole(rgb, scene, 2)
    assert np.any(expected[..., 4] > 0)
    assert np.array_equal(divided(scene, 2, rows=9, strip=256), expected)


def test_the_observer_is_the_camera_of_the_picture_and_not_another(rgb, tmp_path):
    scene = neural(rgb, tmp_path, camera(rgb, size=12), visibility="depth", aovs="gaze,observer_depth")
    other = rgb.load_dict(camera(rgb, (3, 1, 2), size=12))
    rgb.render(scene, sensor=other, spp=1, seed=0)
    expected = np.array(other.film().bitmap())
    parts = [np.array(b.film.bitmap())[: b.rows] for b in bands.render_bands(scene, other, spp=1, rows=5)]
    assert np.array_equal(np.concatenate(parts), expected)


def test_more_than_a_million_values_are_added_in_the_same_way(rgb):
    # Dr.Jit adds to large arrays in another order than to small ones.
    scene = lit(rgb, BOX | {"width": 500, "height": 300})
    expected = whole(rgb, scene, 4)
    assert expected.size > 1e6
    assert np.array_equal(divided(scene, 4, rows=60), expected)


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
    scene = lit(rgb, film)
    expected = whole(rgb, scene, 4)
    window = [list(v) for v in (scene.sensors()[0].film().crop_size(), scene.sensors()[0].film().crop_offset())]
    found = divided(scene, 4, rows=3, strip=128)
    if film["rfilter"]["type"] == "box":
        assert np.array_equal(found, expected)
    else:
        assert np.allclose(found, expected, rtol=1e-4, atol=1e-4)
    # The scene is as it was.
    assert [list(v) for v in (scene.sensors()[0].film().crop_size(), scene.sensors()[0].film().crop_offset())] == window


def test_mono(mono):
    scene = mono.load_dict(
        {"type": "scene", "integrator": constant(0.8, aovs="depth", background=0.2), "sensor": camera(mono, size=9)}
    )
    assert np.array_equal(divided(scene, 2, rows=4), whole(mono, scene, 2))


def test_what_cannot_be_divided_comes_in_one_piece(rgb):
    scene = lit(rgb, BOX, sampler="stratified")
    assert "StratifiedSampler" in bands.why_whole(scene, scene.sensors()[0])
    assert len(list(bands.render_bands(scene, scene.sensors()[0], spp=4, rows=2))) == 1
    assert np.array_equal(divided(scene, 4, rows=2), whole(rgb, scene, 4))


def test_eight_times_the_pixels_take_eight_times_the_bands(rgb):
    memory = 10e6
    small = lit(rgb, BOX | {"width": 200, "height": 400})
    large = lit(rgb, BOX | {"width": 200, "height": 3200})
    rows = [bands.rows_for(s, s.sensors()[0], memory) for s in (small, large)]
    assert rows[0] == rows[1] and 0 < rows[0] < 400
    for scene, count in ((small, -(-400 // rows[0])), (large, -(-3200 // rows[0]))):
        sizes = [
            np.array(b.film.bitmap()).nbytes for b in bands.render_bands(scene, scene.sensors()[0], spp=1, rows=rows[0])
        ]
        assert len(sizes) == count and max(sizes) < memory / 3
    assert bands.rows_for(small, small.sensors()[0], 1.0) == 1


def test_a_wide_filter_is_not_rendered_many_times_for_want_of_memory(rgb):
    """As where the scene itself takes all of it: each band renders the rows around it again."""
    scene = lit(rgb, {"width": 18, "height": 200, "rfilter": {"type": "gaussian"}})
    rows = bands.rows_for(scene, scene.sensors()[0], -1e9)
    told = []
    for _ in bands.render_bands(
        scene, scene.sensors()[0], spp=1, rows=rows, on_strip=lambda done, total: told.append(total)
    ):
        pass
    assert 1 < rows < 50 and told[-1] < 1.3 * 18 * 200


def test_progress_and_stopping(rgb):
    scene, seen = lit(rgb, BOX), []
    divided(scene, 2, rows=4, strip=64, on_strip=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (18 * 11 * 2, 18 * 11 * 2) and len(seen) > 5
    assert [d for d, _ in seen] == sorted(d for d, _ in seen)

    def stop(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        divided(scene, 2, rows=4, strip=64, on_strip=stop)
    assert tuple(scene.sensors()[0].film().crop_size()) == (18, 11)
