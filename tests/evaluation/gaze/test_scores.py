"""What is scored is what is rendered: the field's densities at positions against the integrator's pictures, for every
kind of field."""

from __future__ import annotations

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.evaluation.gaze import gaze_field, scores
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.train.geometry import place_of_field, place_of_scene
from tests.evaluation.gaze_fields import KINDS, made, saved
from tests.plugins import fields
from tests.plugins.scenes import channels

BOX = Box((-1, -1, -1), (1, 1, 1))
EYES = [(0.1, -0.2, 0.3), (-0.4, 0.3, -0.1)]
ROOM = """<scene version="3.0.0">
  <shape type="cube"><boolean name="flip_normals" value="true"/>
    <transform name="to_world"><scale value="0.9"/></transform></shape>
  <shape type="cube"><transform name="to_world"><scale value="0.2"/><translate x="0.5"/></transform></shape></scene>"""


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """What gaze fields are evaluated in, and the same as children of an integrator and of a scene."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("places")
    (folder / "room.xml").write_text(ROOM)
    shapes = {f"s{i}": s for i, s in enumerate(mi.load_string(ROOM).shapes())}
    fields.radiance(folder / "field.safetensors", density_scale=30.0)
    volume = {"type": "nerf", "filename": str(folder / "field.safetensors")}
    return {
        "shapes": (place_of_scene(folder / "room.xml").medium, {}, shapes),
        "field": (place_of_field(folder / "field.safetensors", ns).medium, {"field": volume}, {}),
    }


def pictured(mi, gaze, children: dict, shapes: dict, eye) -> tuple[np.ndarray, np.ndarray]:
    """Directions (N, 3) in which the observer at ``eye`` meets a surface, and the gaze (N,) that a panorama shows
    there."""
    sensor = {
        "type": "panorama",
        "to_world": mi.ScalarTransform4f().translate(list(eye)),
        "sampler": {"type": "independent", "sample_count": 1},
        "film": {
            "type": "hdrfilm",
            "width": 32,
            "height": 16,
            "component_format": "float32",
            "rfilter": {"type": "box"},
        },
    }
    integrator = {
        "type": "nerg",
        "aovs": "opacity,position,gaze",
        "radiance": False,
        "gaze": {"type": "gazefield", "filename": str(gaze)},
        **children,
    }
    out = channels(mi, integrator, sensor, **shapes)
    met = out["opacity.Y"] >= 0.5
    way = np.stack([out[f"position.{c}"][met] for c in "XYZ"], axis=-1) - np.array(eye)
    return way / np.linalg.norm(way, axis=-1, keepdims=True), out["gaze.Y"][met]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("place", ["shapes", "field"])
def test01_is_what_is_rendered(rgb, places, tmp_path, place, kind):
    """To 2e-4 of the largest density: directions are read back from positions in single precision."""
    medium, children, shapes = places[place]
    field = saved(tmp_path / "g.safetensors", kind, BOX)
    density = gaze_field(field, medium)
    for eye in EYES:
        directions, expected = pictured(rgb, tmp_path / "g.safetensors", children, shapes, eye)
        assert len(expected) > 50 and np.ptp(expected) > 0.2 * expected.max()
        found = density(np.array([eye]), directions)
        assert found.shape == (1, len(expected))
        np.testing.assert_allclose(found[0], expected, atol=2e-4 * expected.max())


@pytest.mark.parametrize("kind", ["normalised", "default recipe", "ensemble"])
def test02_other_positions_have_integrals_of_their_own(rgb, places, kind):
    """As many of them as the first ones: nothing is kept by how many there are."""
    medium, field, d = places["shapes"][0], made(kind, BOX), fibonacci_directions(256)
    density = gaze_field(field, medium)
    first, second = (np.array([eye]) for eye in EYES)
    alone = gaze_field(field, medium)(second, d)
    a = density(first, d)
    np.testing.assert_array_equal(density(second, d), alone)
    # Kept, and in an order of their own.
    np.testing.assert_array_equal(density(np.concatenate([second, first]), d), np.concatenate([alone, a]))
    integral = density(first, fibonacci_directions(4096)).mean() * 4 * np.pi
    assert integral == pytest.approx(1, abs=5e-3)


@pytest.mark.parametrize("kind", ["linear", "default recipe"])
def test03_alignment_moves_turns_and_scales(rgb, places, kind):
    medium, field, d = places["shapes"][0], made(kind, BOX), fibonacci_directions(64)
    scaled = np.array([[0, -0.5, 0, 0.1], [0.5, 0, 0, -0.2], [0, 0, 0.5, 0.05], [0, 0, 0, 1]])
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    at = np.array(EYES)
    inside = gaze_field(field, medium)(at @ scaled[:3, :3].T + scaled[:3, 3], d @ turn.T)
    np.testing.assert_allclose(gaze_field(field, medium, Similarity(scaled))(at, d), inside, rtol=2e-4)
    assert np.ptp(inside) > 1e-2


def test04_each_position_may_have_its_own_directions(rgb, places):
    medium, field, d = places["shapes"][0], made("default recipe", BOX), fibonacci_directions(64)
    density, own = gaze_field(field, medium), np.stack([d, d[::-1]])
    common, found = density(np.array(EYES), d), density(np.array(EYES), own)
    np.testing.assert_array_equal(found[0], common[0])
    np.testing.assert_allclose(found[1], common[1][::-1], rtol=1e-5)


def test05_a_field_of_surfaces_needs_a_place(rgb):
    with pytest.raises(NergError, match="there is no place"):
        gaze_field(made("default recipe", BOX), None)
    without = made("default recipe", BOX, geometry="none", reach=1.5)
    d = fibonacci_directions(2048)
    assert gaze_field(without, None)(np.array(EYES), d).mean() * 4 * np.pi == pytest.approx(1, abs=5e-3)


def test06_semantic_features_are_those_of_the_render(rgb, places, tmp_path):
    """Of the place's field, as the integrator hands them over."""
    medium, children, shapes = places["field"]
    for kind in ("snapshot", "accumulated"):
        field = saved(tmp_path / "g.safetensors", "linear", BOX, semantic=kind)
        directions, expected = pictured(rgb, tmp_path / "g.safetensors", children, shapes, EYES[0])
        found = gaze_field(field, medium)(np.array(EYES[:1]), directions)[0]
        np.testing.assert_allclose(found, expected, atol=2e-3 * expected.max())


def test07_scores_of_a_map_and_of_itself():
    truth = np.abs(np.random.default_rng(0).normal(size=(3, 100)))
    found = scores(truth, 2 * truth)
    assert found["KLD"] < 1e-6 and found["CC"] == pytest.approx(1) and found["SIM"] == pytest.approx(1)
    assert found["MAE"] == pytest.approx(truth.mean()) and found["integral"] == pytest.approx(8 * np.pi * truth.mean())


def test_a_density_of_zero_costs_what_a_millionth_of_the_uniform_one_does():
    """Half of the sphere is empty, the other twice as dense: ½ ln 1/2 + ½ ln 1e6."""
    half = np.repeat([0.0, 2.0], 32)[None] / (4 * np.pi)
    flat = np.ones((1, 64)) / (4 * np.pi)
    millionth = np.where(half > 0, half, 1e-6 / (4 * np.pi))
    assert scores(flat, half)["KLD"] == pytest.approx(0.5 * np.log(1e6 / 2), abs=1e-5)
    assert scores(flat, half)["KLD"] == pytest.approx(np.mean(np.log(flat / millionth)), abs=1e-5)
    # The other way round nothing hinges on it.
    assert scores(half, flat)["KLD"] == pytest.approx(np.log(2), abs=2e-5)
