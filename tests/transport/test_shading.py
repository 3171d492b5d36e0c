"""What light comes from behind a field: from shapes, lit or in their plain albedo, from an environment, or from the
background."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.transport.geometry import Place, Shading
from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.volume_medium import VolumeMedium

BACKGROUND = 0.125
SAMPLES = 1 << 14


def scene_of(mi, *emitters, shapes=True):
    """A square in the plane z = 2 of albedo 0.25, 0.5, 0.75, whose half with x > 0 rays along +z meet."""
    square = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([1, 0, 2]).rotate([1, 0, 0], 180),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.25, 0.5, 0.75]}},
    }
    lights = {f"light{i}": emitter for i, emitter in enumerate(emitters)}
    return mi.load_dict({"type": "scene", **({"square": square} if shapes else {}), **lights})


def shade(mi, scene, nested=None, medium=None, hide=False):
    """``(radiance, AOVs, shown)`` of a ray that meets the square and of one that does not, each the mean of many
    samples; arrays a row each."""
    place = Place(medium, scene)
    across = mi.Float(np.repeat(np.float32([0.5, -0.5]), SAMPLES))
    ray = mi.RayDifferential3f(mi.Point3f(across, 0.5, -1), mi.Vector3f(0, 0, 1))
    active = dr.full(mi.Bool, True, 2 * SAMPLES)
    view = place.trace(ray, active, MarchSettings(0.01))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 2 * SAMPLES)
    shading = Shading(None if nested is None else mi.load_dict(nested))
    color, aovs, shown = shading.radiance(scene, sampler, ray, None, view, mi.Color3f(BACKGROUND), hide, active)
    of_two = lambda value: np.array(value + dr.zeros(mi.Float, 2 * SAMPLES)).reshape(2, SAMPLES).mean(axis=1)
    shown = of_two(dr.select(shown, mi.Float(1), 0))
    return np.stack([of_two(c) for c in color], axis=1), [of_two(a) for a in aovs], shown, shading


SKY = {"type": "constant", "radiance": 2.0}


def test01_shapes_without_light_show_their_albedo(rgb):
    color, aovs, shown, shading = shade(rgb, scene_of(rgb))
    assert np.allclose(color, [[0.25, 0.5, 0.75], [BACKGROUND] * 3], atol=1e-6)
    assert shown.tolist() == [True, False] and aovs == [] and shading.aov_names() == []


def test02_shapes_in_light_are_lit_by_paths(rgb):
    color, _, shown, _ = shade(rgb, scene_of(rgb, SKY))
    # Under a sky of radiance 2 all around, a plane that sees nothing but it reflects twice its albedo.
    assert np.allclose(color, [[0.5, 1.0, 1.5], [2, 2, 2]], rtol=0.02) and shown.tolist() == [True, True]


def test03_a_sky_that_is_hidden_leaves_the_background(rgb):
    color, _, shown, _ = shade(rgb, scene_of(rgb, SKY), hide=True)
    assert np.allclose(color, [[0.5, 1.0, 1.5], [BACKGROUND] * 3], rtol=0.02) and shown.tolist() == [True, False]


def test04_a_sky_without_shapes(rgb):
    color, _, shown, _ = shade(rgb, scene_of(rgb, SKY, shapes=False), medium=fog(rgb, 1.0))
    assert np.allclose(color, 2) and shown.tolist() == [True, True]


def fog(mi, sigma):
    to_world = mi.ScalarTransform4f().translate([-1, 0, 0]).scale([2, 1, 1])
    return VolumeMedium(mi.load_dict({"type": "constvolume", "value": sigma, "to_world": to_world}))


def test05_what_opaque_matter_hides_is_not_shaded(rgb):
    color, _, _, _ = shade(rgb, scene_of(rgb, SKY), medium=fog(rgb, 1e6))
    # What is there will be multiplied by nothing: no path was followed to the square.
    assert np.allclose(color[0], 2)


def test06_a_nested_integrator_lights_and_brings_its_aovs(rgb):
    nested = {"type": "aov", "aovs": "far:depth", "light": {"type": "direct"}}
    color, aovs, shown, shading = shade(rgb, scene_of(rgb, SKY), nested)
    assert np.allclose(color, [[0.5, 1.0, 1.5], [2, 2, 2]], rtol=0.02)
    assert shading.aov_names()[-1] == "far.T" and np.allclose(aovs[-1], [3, 0]) and shown.tolist()[0]


def test07_a_nested_integrator_leaves_the_background_where_nothing_is(rgb):
    lamp = {"type": "point", "position": [0.5, 0.5, 0], "intensity": 4.0}
    color, _, shown, _ = shade(rgb, scene_of(rgb, lamp), {"type": "direct"})
    # Straight above the point that is met, two units away: albedo / π times 4 / 2².
    assert np.allclose(color, [np.array([0.25, 0.5, 0.75]) / np.pi, [BACKGROUND] * 3], rtol=1e-4)
    assert shown.tolist() == [True, False]


def test08_integrators_that_cannot_be_asked_ray_by_ray_are_refused(rgb):
    with pytest.raises(NergError, match="AdjointIntegrator, which cannot be asked"):
        Shading(rgb.load_dict({"type": "ptracer"}))
