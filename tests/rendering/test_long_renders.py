"""Renders of many samples: which are prepared, and that nothing else changes."""

import numpy as np
import pytest

from nerg_mi.rendering.aovs import SAMPLES, fields_of, prepare_for
from nerg_mi.rendering.scene import load_scene
from nerg_mi.workflows.demo import store_scene

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
