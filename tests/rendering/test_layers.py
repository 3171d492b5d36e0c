"""Several pictures of the same rays: each is the one that an integrator makes alone."""

import numpy as np
import pytest

from nerg_mi.rendering.bands import OwnLayer, render_bands


@pytest.fixture
def scene(rgb):
    film = {"type": "hdrfilm", "width": 9, "height": 7, "rfilter": {"type": "box"}, "component_format": "float32"}
    camera = {"type": "perspective", "to_world": rgb.ScalarTransform4f().translate([0, 0, -4]), "film": film}
    integrator = {"type": "nerg", "aovs": "depth,opacity"}
    return rgb.load_dict({"type": "scene", "integrator": integrator, "camera": camera, "ball": {"type": "sphere"}})


class Both:
    """The scene's own picture, and one of twice its depths."""

    def __init__(self, integrator):
        self.integrator, self.names, self.count = integrator, [integrator.aov_names(), ["twice.T"]], 3

    def sample(self, *ray):
        radiance, valid, aovs = self.integrator.sample(*ray)
        yield radiance, valid, aovs
        yield 0, valid, [2 * aovs[0]]


def test01_the_picture_of_an_integrator_is_one_layer(rgb, scene):
    layer = OwnLayer(scene.integrator())
    assert layer.names == [["depth.T", "opacity.Y"]] and layer.count == 2
    (band,) = render_bands(scene, scene.sensors()[0], spp=4, layers=layer)
    assert band.layer == 0
    assert np.array_equal(np.array(band.film.develop()), np.array(rgb.render(scene, spp=4)))


@pytest.mark.parametrize("rows", [0, 3])
def test02_layers_follow_each_other_in_each_band(rgb, scene, rows):
    expected, pictures = np.array(rgb.render(scene, spp=4)), ([], [])
    for band in render_bands(scene, scene.sensors()[0], spp=4, rows=rows, layers=Both(scene.integrator())):
        pictures[band.layer].append(np.array(band.film.develop())[: band.rows])
    own, twice = (np.concatenate(parts) for parts in pictures)
    assert np.array_equal(own, expected)
    assert np.allclose(twice[..., 3], 2 * expected[..., 3]) and not twice[..., :3].any()
