"""The observer's sphere of a scene file."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.transport.geometry import pixel_directions
from nerg_mi.workflows.draw import draw

from .scenes import MODE, write_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_scene(tmp_path_factory.mktemp("scene"))


def test_it_shows_the_observers_gaze(rgb, scene):
    """Against the API's rays from the observer's eye, in directions of the panorama that it has turned itself."""
    import nerg_mi as nerg

    figure = draw("sphere", scene, width=64, spp=1, mode=MODE, projection="equirectangular", top=0.5)
    assert "integral" in figure.axes[0].get_title().replace("\n", " ")
    assert figure.axes[-1].get_ylabel().replace("\n", " ") == "gaze density [1/sr]"
    shown = figure.axes[0].images[0].get_array()
    assert shown.shape == (32, 64, 3)
    eye = np.array([0.2, 0.1, -2.5])
    # Level, towards the middle of the place: up is y. Right of a camera of Mitsuba's is -x of its own.
    ahead = -eye * (1, 0, 1)
    ahead /= np.linalg.norm(ahead)
    up = np.array([0.0, 1.0, 0.0])
    own = pixel_directions(64, 32)
    world = own[..., :1] * np.cross(up, ahead) + own[..., 1:2] * up + own[..., 2:] * ahead
    seen = nerg.trace(nerg.Scene.load(str(scene)), eye, world.reshape(-1, 3), ["depth", "opacity", "gaze"])
    met = (seen.opacity.reshape(32, 64) > 0.9) & (seen.gaze.reshape(32, 64) > 0.3)
    void = seen.opacity.reshape(32, 64) < 0.1
    assert met.sum() > 20 and void.sum() > 500
    # The paper's pale hatching where nothing is met, dark or hot colours where something is.
    grey = np.ptp(shown, axis=-1) < 0.01
    rows = np.rint((np.arange(32) + 0.5) / 32 * 31).astype(int)
    inner = lambda m: m & np.roll(m, 1, 0) & np.roll(m, -1, 0) & np.roll(m, 1, 1) & np.roll(m, -1, 1)
    assert grey[inner(void)[rows]].mean() > 0.95 and grey[inner(met)[rows]].mean() < 0.2


def test_what_is_refused(scene):
    for given, said in (
        ({"projection": "globe"}, 'no projection "globe"'),
        ({"sensor": 7}, "has 1 sensor"),
        ({"cmap": "jet"}, '"jet" is no'),
        ({"color": 1}, 'has no option "color"'),
    ):
        with pytest.raises(NergError, match=said):
            draw("sphere", scene, mode=MODE, width=64, **given)
