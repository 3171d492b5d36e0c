"""Scenes of fields, shapes, observers and cameras, without XML."""

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.api.scene import TrainedField, asked_quantities
from tests.formats.splats.writers import random_splats, write_inria

BALL = {"type": "sphere", "radius": 0.3}


def test01_what_a_scene_says_of_itself(files, camera):
    scene = nerg.make_scene(
        files / "field.safetensors",
        files / "gaze.safetensors",
        shapes={"ball": BALL},
        camera=camera,
        observer=(0, -2, 0),
    )
    assert repr(scene).splitlines() == [
        "Scene",
        "  field: field.safetensors",
        "  gaze: gaze.safetensors",
        "  shapes: 1",
        "  observer: (0, -2, 0)",
        "  camera 0: 12 x 8 pixels",
    ]
    assert np.array_equal(scene.observer, (0, -2, 0)) and scene.has_gaze
    assert scene.default_quantities == ("color", "depth", "opacity", "gaze", "visibility")
    assert scene.integrator.aov_names() == ["depth.T", "opacity.Y", "gaze.Y", "visibility.Y"]


def test02_a_field_in_memory_is_its_file(files, camera):
    field, gaze = nerg.load_field(files / "field.safetensors"), nerg.load_gaze(files / "gaze.safetensors")
    from_files = nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors", camera=camera)
    expected = nerg.render(from_files, spp=2)
    for made in (
        nerg.make_scene(field, gaze, camera=camera),
        nerg.make_scene(field.network, TrainedField(gaze.network), camera=camera),
    ):
        found = nerg.render(made, spp=2)
        for name in expected:
            assert np.array_equal(found[name], expected[name]), name
    assert "field: field.safetensors" in repr(nerg.make_scene(field)) and "in memory" in repr(
        nerg.make_scene(field.network)
    )


def test02_splats_are_a_place_as_a_field_is(camera, tmp_path):
    splats = random_splats(20)
    write_inria(tmp_path / "place.ply", splats)
    from_file = nerg.make_scene(tmp_path / "place.ply", camera=camera)
    assert "field: place.ply" in repr(from_file)
    expected = nerg.render(from_file, spp=2)
    assert expected.opacity.max() > 0.2
    found = nerg.render(nerg.make_scene(splats, camera=camera), spp=2)
    assert np.allclose(found.depth, expected.depth, atol=1e-4)


def test03_where_the_fields_are_placed(files):
    turned = np.array([(0, -2, 0, 5), (2, 0, 0, 6), (0, 0, 2, 7), (0, 0, 0, 1)], float)
    make = lambda matrix, falloff: nerg.make_scene(
        files / "field.safetensors", files / "gaze.safetensors", to_world=matrix, falloff=falloff
    )
    here, there = make(None, 0.1), make(turned, 0.2)
    o, d = np.array([(0.2, -3, 0.1), (3, 0.1, 0.2)]), np.array([(0, 1, 0), (-1, 0.1, 0)])
    a = nerg.trace(here, o, d)
    b = nerg.trace(there, o @ turned[:3, :3].T + turned[:3, 3], d @ turned[:3, :3].T)
    assert np.allclose(2 * a.depth, b.depth, rtol=1e-3) and np.allclose(a.opacity, b.opacity, atol=1e-4)
    assert a.gaze.max() > 0 and np.allclose(a.gaze, b.gaze, rtol=2e-2)


def test04_shapes_of_every_kind(files, rgb, tmp_path):
    ply = tmp_path / "cube.ply"
    rgb.load_dict({"type": "cube"}).write_ply(str(ply))
    xml = tmp_path / "ball.xml"
    xml.write_text('<scene version="3.0.0"><shape type="sphere" id="ball"/><emitter type="constant"/></scene>')
    for shapes, ids in (
        (BALL, {"shape"}),
        ([BALL, str(ply)], {"shape_0", "shape_1"}),
        ({"a": ply, "b": BALL}, {"a", "b"}),
        (rgb.load_dict({"type": "scene", "x": BALL, "light": {"type": "constant"}}), {"x"}),
        ({"type": "scene", "x": BALL, "y": {"type": "cube"}}, {"x", "y"}),
        (rgb.load_dict(BALL), {"shape"}),
        (xml, {"ball"}),
    ):
        scene = nerg.make_scene(shapes=shapes)
        assert len(scene.mitsuba.shapes()) == len(ids)
        seen = nerg.trace(scene, (0, -5, 0), (0, 1, 0), ["depth", "opacity"])
        assert seen.opacity[0] == 1 and 3 < seen.depth[0] < 5
    assert len(nerg.make_scene(shapes=xml).mitsuba.emitters()) == 1
    assert len(nerg.make_scene(shapes={"type": "scene", "x": BALL, "l": {"type": "constant"}}).mitsuba.emitters()) == 1


def test05_settings_are_the_integrators(files):
    scene = nerg.make_scene(files / "field.safetensors", falloff=0.7, visibility="map", depth="expected", step=0.05)
    i = scene.integrator
    assert np.isclose(i.falloff[0], 0.7) and i.settings.step == 0.05
    assert i.observer_settings.visibility == "map" and i.observer_settings.depth == "expected"


def test06_a_volume_in_place_of_a_field():
    scene = nerg.make_scene(density={"type": "constvolume", "value": 3.0})
    seen = nerg.trace(scene, (0.5, 0.5, -1), (0, 0, 1), "opacity")
    assert np.isclose(seen.opacity[0], 1 - np.exp(-3), atol=1e-5)
    assert "density: a volume" in repr(scene)


@pytest.mark.parametrize(
    "given, said",
    [
        ({}, "make_scene"),
        ({"field": "nowhere.safetensors"}, 'there is no file "nowhere.safetensors"'),
        ({"field": 3}, "radiance field in memory"),
        ({"shapes": "x.stl"}, '"x.stl" is no mesh that is read'),
        ({"shapes": "x.ply"}, 'there is no mesh "x.ply"'),
        ({"shapes": 3}, "shapes are mesh"),
        ({"shapes": BALL, "falloff": -1}, '"falloff" must lie in'),
        ({"shapes": BALL, "fall_off": 1}, "fall_off"),
        ({"shapes": BALL, "observer": (0, 1)}, "the observer must have the shape"),
        ({"shapes": BALL, "observer": [(0, 0, 1), (0, 0, 2)]}, "a scene has one observer"),
        ({"shapes": BALL, "gaze": "GAZE", "to_world": np.diag([1, 2, 1, 1])}, '"to_world"'),
        ({"shapes": BALL, "gaze": "GAZE", "to_world": np.eye(3)}, '"to_world".*4.*4'),
        ({"field": "GAZE"}, "holds a gaze field"),
    ],
)
def test07_errors_are_sentences(files, given, said):
    given = {
        key: files / "gaze.safetensors" if isinstance(value, str) and value == "GAZE" else value
        for key, value in given.items()
    }
    with pytest.raises(nerg.NergError, match=said) as error:
        nerg.make_scene(**given)
    assert "\n" not in str(error.value)


def test08_kinds_are_not_confused(files):
    field, gaze = nerg.load_field(files / "field.safetensors"), nerg.load_gaze(files / "gaze.safetensors")
    with pytest.raises(nerg.NergError, match="radiance field in memory"):
        nerg.make_scene(gaze)
    with pytest.raises(nerg.NergError, match="gaze field in memory"):
        nerg.make_scene(field, field)


def test09_other_scenes(rgb):
    with pytest.raises(nerg.NergError, match='"nerg".*"PathIntegrator"'):
        nerg.Scene(rgb.load_dict({"type": "scene", "integrator": {"type": "path"}, "ball": BALL}))
    wrapped = nerg.Scene(rgb.load_dict({"type": "scene", "integrator": {"type": "nerg"}, "ball": BALL}))
    assert nerg.trace(wrapped, (0, -5, 0), (0, 1, 0)).depth.shape == (1,)


def test10_a_file_with_values(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><default name="r" value="1"/><integrator type="nerg"/>'
        '<shape type="sphere"><float name="radius" value="$r"/></shape></scene>'
    )
    depth = lambda scene: nerg.trace(scene, (0, -5, 0), (0, 1, 0), "depth").depth[0]
    assert np.isclose(depth(nerg.Scene.load(path)), 4) and np.isclose(depth(nerg.Scene.load(path, r=2)), 3)
    with pytest.raises(nerg.NergError, match="asks for no .*q"):
        nerg.Scene.load(path, q=2)


def test11_cameras(scene, camera, rgb):
    other = nerg.Camera((0, -2, 0), (0, 0, 0), width=5, height=4)
    assert tuple(scene.sensor(other).film().size()) == (5, 4) and tuple(scene.sensor().film().size()) == (12, 8)
    assert scene.sensor(0) is scene.sensor() or tuple(scene.sensor(0).film().size()) == (12, 8)
    mine = rgb.load_dict(other.to_dict())
    assert scene.sensor(mine) is mine
    for wrong in (1, -1):
        with pytest.raises(nerg.NergError, match=f"has 1 of its own, and camera {wrong} was asked for"):
            scene.sensor(wrong)
    with pytest.raises(nerg.NergError, match="Camera, a number"):
        scene.sensor("first")


def test12_quantities(scene):
    assert asked_quantities(scene, None) == scene.default_quantities
    assert asked_quantities(scene, "gaze") == ("gaze",)
    assert asked_quantities(scene, ["depth", "gaze", "depth"]) == ("depth", "gaze")
    for wrong in ([], 3, ["depth", 3]):
        with pytest.raises(nerg.NergError, match="quantities are names"):
            asked_quantities(scene, wrong)
    with pytest.raises(nerg.NergError, match='"gazes"'):
        asked_quantities(scene, "gazes", ("gaze", "depth"))


def test_constant_weights_change_nothing_and_are_taken_back(files, camera):
    scene = nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors", camera=camera, observer=(0, -2, 0))
    nets = [*scene.integrator.medium.field.mlps, *scene.integrator.gaze.field.mlps]
    expected = nerg.render(scene, spp=2)
    scene.set_constant_weights()
    assert all(net.constant for net in nets)
    found = nerg.render(scene, spp=2)
    assert expected.color.max() > 0 and np.array_equal(found.color, expected.color)
    scene.set_constant_weights(False)
    assert not any(net.constant for net in nets)


@pytest.mark.parametrize("scale", [1e-4, 1, 1e6])
def test_a_camera_sees_a_scene_of_any_unit(rgb, scale):
    import mitsuba as mi

    box = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(scale)}
    camera = nerg.Camera((4 * scale, 3 * scale, 0), (0, 0, 0), width=6, height=4)
    scene = nerg.make_scene(shapes=box, camera=camera)
    for number in (0, camera):
        assert nerg.render(scene, quantities=["opacity"], camera=number).opacity[..., 1:3, 2:4].min() == 1


@pytest.mark.parametrize("radius", [float("nan"), 1e30, 1.1e7])
def test_shapes_beyond_all_places_are_refused(rgb, radius):
    with pytest.raises(nerg.NergError, match="corners of the shape .* must have coordinates from"):
        nerg.make_scene(shapes={"type": "sphere", "radius": radius})
