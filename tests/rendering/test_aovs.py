"""Tests of `nerg_mi.rendering.aovs`."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rendering.aovs import SAMPLES, fields_of, prepare_for, render_asked
from nerg_mi.rendering.bands import render_channels
from nerg_mi.rendering.scene import load_scene
from nerg_mi.workflows.demo import store_scene
from tests.plugins import fields
from tests.plugins.scenes import camera, observer_at, with_gaze

# ---- The integrator asked for what its own list lacks gives what it gives with a longer list ----


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("fields")
    fields.radiance(folder / "field.safetensors", density_scale=6.0)
    fields.gaze(folder / "gaze.safetensors")
    return folder


@pytest.mark.parametrize("observed", [False, True])
def test_equal_to_a_list_that_has_it(rgb, files, observed):
    observer = {"observer": observer_at(rgb, -0.4, 0.2, -2.5)} if observed else {}
    names = ["gaze", "opacity", "depth"]
    load = lambda aovs: rgb.load_dict(
        {"type": "scene", "integrator": with_gaze(files, aovs=aovs, **observer), "sensor": camera(rgb)}
    )
    own, bare = load(",".join(names)), load("depth")
    wanted = render_channels(own, own.sensors()[0], spp=2, seed=3)
    found = render_asked("a.xml", bare, bare.sensors()[0], names, 2, 3)
    assert found.aovs["gaze"].max() > 0
    np.testing.assert_array_equal(found.color, wanted.color)
    for name in names:
        np.testing.assert_array_equal(found.aovs[name], wanted.aovs[name])


def test_what_cannot_be_asked(rgb, files):
    path = {"type": "scene", "integrator": {"type": "path"}, "sensor": camera(rgb), "shape": {"type": "sphere"}}
    scene = rgb.load_dict(path)
    with pytest.raises(NergError, match='"PathIntegrator".*"nerg scene a.xml -o new.xml"'):
        render_asked("a.xml", scene, scene.sensors()[0], ["depth"])
    scene = rgb.load_dict({"type": "scene", "integrator": with_gaze(files), "sensor": camera(rgb)})
    with pytest.raises(NergError, match='"kde", which needs'):
        render_asked("a.xml", scene, scene.sensors()[0], ["kde"])
    stratified = camera(rgb) | {"sampler": {"type": "stratified", "sample_count": 4}}
    scene = rgb.load_dict({"type": "scene", "integrator": with_gaze(files), "sensor": stratified})
    with pytest.raises(NergError, match="overlay because of the sampler"):
        render_asked("a.xml", scene, scene.sensors()[0], ["gaze"])


# ---- Renders of many samples: which are prepared, and that nothing else changes ----


SMALL = {"width": "24", "height": "16", "spp": "1"}


def networks(scene):
    return [net for field in fields_of(scene.integrator()) for net in field.mlps]


@pytest.mark.nightly
@pytest.mark.parametrize(("samples", "prepared"), [(SAMPLES - 1, False), (SAMPLES, True)])
def test01_long_ones_are_prepared_and_show_the_same_to_the_bit(rgb, samples, prepared):
    plain, scene = load_scene(store_scene(), SMALL), load_scene(store_scene(), SMALL)
    assert prepare_for(samples, scene) is prepared
    assert [net.constant for net in networks(scene)] == [prepared] * 5
    found, expected = (np.array(rgb.render(s, sensor=0, spp=1)) for s in (scene, plain))
    assert expected[..., :3].max() > 0.1 and np.array_equal(found, expected)


def test02_scenes_without_fields_are_left_alone(rgb):
    shapes = rgb.load_dict({"type": "scene", "integrator": {"type": "nerg"}, "ball": {"type": "sphere"}})
    others = rgb.load_dict({"type": "scene", "integrator": {"type": "path"}, "ball": {"type": "sphere"}})
    assert not prepare_for(SAMPLES, shapes) and not prepare_for(SAMPLES, others)
