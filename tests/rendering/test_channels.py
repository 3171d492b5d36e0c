"""A picture taken apart, against what Mitsuba makes of it."""

import numpy as np
import pytest

from nerg_mi.rendering.bands import Channels, render_channels


@pytest.fixture
def scene(rgb):
    return rgb.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "nerg",
                "density": {"type": "constvolume", "value": 3.0},
                "aovs": "depth,opacity,position",
            },
            "sensor": {
                "type": "perspective",
                "to_world": rgb.ScalarTransform4f().look_at([0.5, 0.5, -2], [0.5, 0.5, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 9, "height": 6, "rfilter": {"type": "box"}},
            },
        }
    )


def test_each_channel_by_its_name(rgb, scene):
    seen = render_channels(scene, scene.sensors()[0], spp=4, seed=3)
    whole = np.array(rgb.render(scene, spp=4, seed=3))
    assert list(seen.aovs) == ["depth", "opacity", "position.X", "position.Y", "position.Z"]
    assert seen.color.shape == (6, 9, 3) and np.array_equal(seen.color, whole[..., :3])
    for k, channel in enumerate(seen.aovs.values()):
        assert np.array_equal(channel, whole[..., 3 + k])
    assert tuple(seen.bitmap.size()) == (9, 6)


def test_one_channel_of_colour_becomes_three(mono):
    scene = mono.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "light": {"type": "constant"},
            "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 3}},
        }
    )
    assert render_channels(scene, scene.sensors()[0], spp=1).color.shape == (3, 4, 3)


def test_a_surface_is_where_half_is_absorbed():
    seen = Channels(np.zeros((1, 3, 3)), {"opacity": np.array([[0.49, 0.5, 1.0]])}, None)
    assert seen.mask.tolist() == [[False, True, True]]


def test_whoever_is_told_may_end_it(scene):
    def end(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_channels(scene, scene.sensors()[0], spp=1, on_strip=end)
