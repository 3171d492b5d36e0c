"""Pictures of a field whose colour network is asked once a ray."""

import drjit as dr
import numpy as np
import pytest

from . import fields
from .scenes import camera, channels, named, render


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    path = tmp_path_factory.mktemp("deferred") / "field.safetensors"
    fields.radiance(path, density_scale=1.5, deferred=True, color_space="linear")
    return path


def nerg(path, aovs="opacity", **more):
    field = {"type": "nerf", "filename": str(path)}
    return {"type": "nerg", "field": field, "aovs": aovs, "step": 0.05, "stop": 0.0, "color_cutoff": 0.0, **more}


def still(mi, size=5):
    return {**camera(mi, size=size), "sampler": {"type": "stratified", "sample_count": 1, "jitter": False}}


def test01_colour_is_that_of_the_mean_features(rgb, path):
    """Of the accumulated features, which ``test_nerg_features`` checks, with the network of the field."""
    image = render(rgb, nerg(path), still(rgb))
    with_features = nerg(path, "opacity,features")
    both = render(rgb, with_features, still(rgb))
    assert np.allclose(image, both[..., :4], atol=1e-6)
    seen, opacity = named(rgb, both, with_features), both[..., 3].ravel()
    assert opacity.max() > 0.5 and (opacity > 0).sum() > 10
    medium = rgb.load_dict(nerg(path)["field"]).medium()
    sums = np.stack([seen[f"features.{k}"].ravel() for k in range(medium.feature_count)])
    some = opacity > 0
    y, x = np.mgrid[:5, :5].reshape(2, -1) + 0.5
    ray, _ = rgb.load_dict(still(rgb)).sample_ray(0, 0.5, rgb.Point2f(x / 5, y / 5), 0.5)
    means = [rgb.Float(np.ascontiguousarray((s / np.where(some, opacity, 1)).astype(np.float32))) for s in sums]
    expected = opacity * np.array(medium.field.color(means, ray.d))
    found = image[..., :3].reshape(-1, 3).T
    assert np.allclose(found[:, some], expected[:, some], atol=2e-6) and not found[:, ~some].any()


def test02_one_evaluation_of_colour_a_ray(rgb, path):
    seen = channels(rgb, nerg(path, "opacity,color_evals,density_evals"), still(rgb))
    assert np.array_equal(seen["color_evals.Y"], seen["opacity.Y"] > 0) and seen["density_evals.Y"].max() > 3


@pytest.mark.parametrize("quadrature", ["constant", "linear"])
def test03_a_cutoff_moves_colours_little(rgb, path, quadrature):
    exact, cut = (
        render(rgb, nerg(path, quadrature=quadrature, color_cutoff=c, step=0.02), still(rgb)) for c in (0.0, 1e-2)
    )
    assert 0 < np.abs(exact - cut)[..., :3].max() < 0.02


def test04_a_wall_behind_is_seen_through_it(rgb, path):
    """The network adds nothing to what the wall sends, and is asked where the field is met alone."""
    wide = {**still(rgb), "fov": 60}
    wall = {
        "type": "rectangle",
        "to_world": rgb.ScalarTransform4f().translate([0, 0, 1.5]).rotate([1, 0, 0], 180).scale(9),
        "bsdf": {"type": "diffuse"},
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 0.7}},
    }
    scene = rgb.load_dict(
        {
            "type": "scene",
            "integrator": nerg(path, "opacity,color_evals", shading={"type": "path", "max_depth": 1}),
            "sensor": wide,
            "wall": wall,
        }
    )
    alone = render(rgb, nerg(path), wide)
    image = np.array(rgb.render(scene, spp=1))
    opacity = alone[..., 3:4]
    # Of rays that meet the wall alone no colour is asked.
    assert np.array_equal(image[..., 4:5], opacity > 0) and opacity.min() == 0 < opacity.max()
    assert image[..., 3].min() == 1 and np.allclose(image[..., :3], alone[..., :3] + 0.7 * (1 - opacity), atol=1e-4)


def test05_pictures_are_frozen_and_weights_may_be_constants(rgb, path):
    scene = rgb.load_dict({"type": "scene", "integrator": nerg(path), "sensor": still(rgb)})
    field = {"type": "nerf", "filename": str(path), "constant_weights": True}
    constant = rgb.load_dict({"type": "scene", "integrator": nerg(path, field=field), "sensor": still(rgb)})
    frozen = dr.freeze(lambda scene: rgb.render(scene, spp=1))
    first = np.array(rgb.render(scene, spp=1))
    for other in (frozen(scene), frozen(scene), rgb.render(constant, spp=1)):
        assert np.allclose(np.array(other), first, atol=1e-6)
