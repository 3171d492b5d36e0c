"""Tests of `nerg_mi.environment.scene`."""

import re
import sys

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.environment.gaze import GazeField
from nerg_mi.environment.integrator_settings import IntegratorSettings
from nerg_mi.environment.radiance import RadianceField
from nerg_mi.environment.scene import resolve_quantities
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.registration import get_plugin_class
from tests.formats.splats.writers import random_splats, write_inria

BALL = {"type": "sphere", "radius": 0.3}


def test01_scene_representation(files, camera):
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
    field, gaze = nerg.RadianceField.load(files / "field.safetensors"), nerg.GazeField.load(files / "gaze.safetensors")
    from_files = nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors", camera=camera)
    expected = nerg.render(from_files, spp=2)
    for made in (
        nerg.make_scene(field, gaze, camera=camera),
        nerg.make_scene(RadianceField(field.network), GazeField(gaze.network), camera=camera),
    ):
        result = nerg.render(made, spp=2)
        for name in expected:
            assert np.array_equal(result[name], expected[name]), name
    assert "field: field.safetensors" in repr(nerg.make_scene(field)) and "in memory" in repr(
        nerg.make_scene(RadianceField(field.network))
    )


def test02_splats_replace_a_field(camera, tmp_path):
    splats = random_splats(20)
    write_inria(tmp_path / "place.ply", splats)
    from_file = nerg.make_scene(tmp_path / "place.ply", camera=camera)
    assert "field: place.ply" in repr(from_file)
    expected = nerg.render(from_file, spp=2)
    assert expected.opacity.max() > 0.2
    result = nerg.render(nerg.make_scene(splats, camera=camera), spp=2)
    assert np.allclose(result.depth, expected.depth, atol=1e-4)


def test03_where_the_fields_are_placed(files):
    turned = np.array([(0, -2, 0, 5), (2, 0, 0, 6), (0, 0, 2, 7), (0, 0, 0, 1)], float)
    make = lambda matrix, falloff: nerg.make_scene(
        files / "field.safetensors", files / "gaze.safetensors", to_world=matrix, falloff=falloff
    )
    position, is_valid = make(None, 0.1), make(turned, 0.2)
    o, d = np.array([(0.2, -3, 0.1), (3, 0.1, 0.2)]), np.array([(0, 1, 0), (-1, 0.1, 0)])
    a = nerg.trace(position, o, d)
    b = nerg.trace(is_valid, o @ turned[:3, :3].T + turned[:3, 3], d @ turned[:3, :3].T)
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
    assert np.isclose(i.falloff[0], 0.7) and i.settings.step == 0.05  # noqa: RUF069 (stored)
    assert i.observer_settings.visibility == "map" and i.observer_settings.depth == "expected"


def test05_settings_are_those_of_the_page():
    page = sys.modules[get_plugin_class("nerg").__module__].__doc__ or ""
    rows = re.findall(r"^ \* - ([a-z_]+(?:, [a-z_]+)*)$", page, re.MULTILINE)
    names = {name for row in rows for name in row.split(", ")}
    # Children with an argument of their own are no settings; the nested integrator has no name on the page.
    assert names - {"field", "gaze", "observer"} == IntegratorSettings.__annotations__.keys() - {"integrator"}


def test06_a_volume_in_place_of_a_field():
    scene = nerg.make_scene(density={"type": "constvolume", "value": 3.0})
    seen = nerg.trace(scene, (0.5, 0.5, -1), (0, 0, 1), "opacity")
    assert np.isclose(seen.opacity[0], 1 - np.exp(-3), atol=1e-5)
    assert "density: a volume" in repr(scene)


@pytest.mark.parametrize(
    "arguments, said",
    [
        ({}, "make_scene"),
        ({"environment": "nowhere.safetensors"}, 'file "nowhere.safetensors" of "environment" does not exist'),
        ({"environment": 3}, "got int"),
        ({"field": "nowhere.safetensors"}, "environment"),
        ({"shapes": "x.stl"}, '"x.stl" is not a supported mesh'),
        ({"shapes": "x.ply"}, 'there is no mesh "x.ply"'),
        ({"shapes": 3}, "shapes must be mesh files"),
        ({"shapes": BALL, "falloff": -1}, '"falloff" must lie in'),
        ({"shapes": BALL, "fall_off": 1}, "fall_off"),
        ({"shapes": BALL, "observer": (0, 1)}, "the observer must have the shape"),
        ({"shapes": BALL, "observer": [(0, 0, 1), (0, 0, 2)]}, "a scene has a single observer"),
        ({"shapes": BALL, "gaze": "GAZE", "to_world": np.diag([1, 2, 1, 1])}, '"to_world"'),
        ({"shapes": BALL, "gaze": "GAZE", "to_world": np.eye(3)}, '"to_world".*4.*4'),
        ({"environment": "GAZE"}, "contains a gaze field"),
    ],
)
def test07_errors_are_sentences(files, arguments, said):
    arguments = {
        key: files / "gaze.safetensors" if isinstance(value, str) and value == "GAZE" else value
        for key, value in arguments.items()
    }
    with pytest.raises(nerg.NergError, match=said) as error:
        nerg.make_scene(**arguments)
    assert "\n" not in str(error.value)


def test08_wrong_kinds_are_refused(files):
    field, gaze = nerg.RadianceField.load(files / "field.safetensors"), nerg.GazeField.load(files / "gaze.safetensors")
    with pytest.raises(nerg.NergError, match="pass it with gaze="):
        nerg.make_scene(gaze)
    with pytest.raises(nerg.NergError, match="gaze must be a gaze field.*radiance field field.safetensors"):
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
    with pytest.raises(nerg.NergError, match="does not use .*q"):
        nerg.Scene.load(path, q=2)


def test11_cameras(scene, camera, rgb):
    other = nerg.Camera((0, -2, 0), (0, 0, 0), width=5, height=4)
    assert tuple(scene.resolve_sensor(other).film().size()) == (5, 4) and tuple(
        scene.resolve_sensor().film().size()
    ) == (12, 8)
    assert scene.resolve_sensor(0) is scene.resolve_sensor() or tuple(scene.resolve_sensor(0).film().size()) == (12, 8)
    mine = rgb.load_dict(other.to_dict())
    assert scene.resolve_sensor(mine) is mine
    for wrong in (1, -1):
        with pytest.raises(nerg.NergError, match=f"no camera {wrong}, the scene has 1 sensor"):
            scene.resolve_sensor(wrong)
    with pytest.raises(nerg.NergError, match="Camera, an index"):
        scene.resolve_sensor("first")


def test12_quantities(scene):
    assert resolve_quantities(scene, None) == scene.default_quantities
    assert resolve_quantities(scene, "gaze") == ("gaze",)
    assert resolve_quantities(scene, ["depth", "gaze", "depth"]) == ("depth", "gaze")
    for wrong in ([], 3, ["depth", 3]):
        with pytest.raises(nerg.NergError, match="quantities must be names"):
            resolve_quantities(scene, wrong)
    with pytest.raises(nerg.NergError, match='"gazes"'):
        resolve_quantities(scene, "gazes", ("gaze", "depth"))


def test_constant_weights_change_nothing_and_are_undone(files, camera):
    scene = nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors", camera=camera, observer=(0, -2, 0))
    nets = [*scene.integrator.medium.field.mlps, *scene.integrator.gaze.field.mlps]
    expected = nerg.render(scene, spp=2)
    scene.set_constant_weights()
    assert all(net.has_constant_weights for net in nets)
    result = nerg.render(scene, spp=2)
    assert expected.color.max() > 0 and np.array_equal(result.color, expected.color)
    scene.set_constant_weights(False)
    assert not any(net.has_constant_weights for net in nets)


@pytest.mark.parametrize("scale", [1e-4, 1, 1e6])
def test_cameras_support_any_unit(rgb, scale):
    import mitsuba as mi

    box = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(scale)}
    camera = nerg.Camera((4 * scale, 3 * scale, 0), (0, 0, 0), width=6, height=4)
    scene = nerg.make_scene(shapes=box, camera=camera)
    for number in (0, camera):
        assert nerg.render(scene, quantities=["opacity"], camera=number).opacity[..., 1:3, 2:4].min() == 1


@pytest.mark.parametrize("radius", [float("nan"), 1e30, 1.1e7])
def test_shapes_at_extreme_positions_are_refused(rgb, radius):
    with pytest.raises(nerg.NergError, match="corners of the shape .* must have coordinates from"):
        nerg.make_scene(shapes={"type": "sphere", "radius": radius})


# ---- Hit points ----


def test01_hit_points_are_a_field(rgb, tmp_path):
    """A floor of two layers and a wall: depths to the faces of their voxels, in the place of the volume.

    Interpolation moves faces forward by less than half a voxel.
    """
    density = np.zeros((8, 10, 12), np.float32)
    density[:2] = density[:, :, 10:] = 400.0
    write_volume(tmp_path / "hits.vol", density, (0, 0, 0), (1.2, 1.0, 0.8))
    to_world = np.array([[0, -2, 0, 1.0], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]])
    eye, directions = np.array([0.5, 0.5, 0.5]), np.array([(0, 0, -1), (1, 0, 0), (0, 0, 1)])
    local = nerg.make_scene(tmp_path / "hits.vol")
    world = nerg.make_scene(str(tmp_path / "hits.vol"), to_world=to_world)
    first = nerg.trace(local, eye, directions, ["depth", "color", "opacity"])
    turned = directions @ (to_world[:3, :3] / 2).T
    second = nerg.trace(world, to_world[:3, :3] @ eye + to_world[:3, 3], turned, ["depth", "color", "opacity"])
    for scale, result in ((1, first), (2, second)):
        np.testing.assert_allclose(result.opacity, [1, 1, 0], atol=1e-4)
        before_face = np.array([0.3, 0.5]) - result.depth[:2] / scale
        assert (before_face > -0.005).all() and (before_face < 0.05).all()
        # Grey by orientation: a floor is brighter than a wall.
        assert np.ptp(result.color, axis=1).max() < 1e-4 and result.color[0, 0] > result.color[1, 0] > 0.1


def test02_other_volumes_are_refused(rgb, tmp_path):
    write_volume(tmp_path / "color.vol", np.zeros((2, 2, 2, 3)), (0, 0, 0), (1, 1, 1))
    with pytest.raises(nerg.NergError, match="not a volume of hit points"):
        nerg.make_scene(tmp_path / "color.vol")
    with pytest.raises(nerg.NergError, match='file ".*no.vol" of "environment" does not exist'):
        nerg.make_scene(tmp_path / "no.vol")
