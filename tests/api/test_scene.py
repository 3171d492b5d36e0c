"""Tests of `nerg_mi.api.scene`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import nerg_mi as nerg
from nerg_mi.api.analysis import bake, statistics
from nerg_mi.api.objects import build_options
from nerg_mi.api.scene import resolve_quantities
from nerg_mi.environment.contents import load_content, load_mesh_child, to_scene_children
from nerg_mi.environment.trained import TrainedField
from nerg_mi.errors import NergError
from nerg_mi.formats.surfaces import write_volume
from tests.formats.splats.writers import random_splats, write_inria

# ---- Fields and rays in memory, from files and back ----


def test01_a_field_has_the_data_of_its_file(files):
    field = nerg.load_field(files / "field.safetensors")
    assert field.kind == "radiance" and field.name == "field.safetensors" and field.provenance == {"test": 0}
    assert np.array_equal(field.bounds, [(-1, -1, -1), (1, 1, 1)])
    assert field.num_weights == sum(value.numpy().size for value in field.network.parameters().values())
    assert repr(field).startswith("<radiance field field.safetensors: ") and "box (-1, -1, -1) to (1, 1, 1)>" in repr(
        field
    )


def test02_saved_fields_are_equal(files, tmp_path):
    for load, name in ((nerg.load_field, "field"), (nerg.load_gaze, "gaze")):
        field = load(str(files / f"{name}.safetensors"))
        path = field.save(tmp_path / f"{name}.safetensors")
        again = load(path)
        assert again.provenance == field.provenance
        for key, value in field.network.parameters().items():
            assert np.array_equal(value.numpy(), again.network.parameters()[key].numpy()), key


def test03_half_the_size(files, tmp_path):
    field = nerg.load_field(files / "field.safetensors")
    full, half = (field.save(tmp_path / f"{h}.safetensors", half=h).stat().st_size for h in (False, True))
    assert half < 0.7 * full


@pytest.mark.parametrize(
    "load, name, said",
    [
        (nerg.load_field, "gaze.safetensors", "contains a gaze field"),
        (nerg.load_gaze, "field.safetensors", "contains a radiance field"),
        (nerg.load_field, "nowhere.safetensors", "does not exist"),
        (nerg.load_rays, "nowhere.npz", "nowhere.npz"),
        (nerg.load_rays, "field.safetensors", "rays are saved"),
    ],
)
def test04_errors_are_sentences(files, load, name, said):
    with pytest.raises((nerg.NergError, FileNotFoundError), match=said):
        load(files / name)


def test05_invalid_names_are_refused(files):
    with pytest.raises(nerg.NergError, match="given as a string"):
        nerg.load_field(3)
    with pytest.raises(nerg.NergError, match="saved as .safetensors"):
        nerg.load_field(files / "field.safetensors").save(files / "field.ckpt")


def test06_a_field_without_a_file(files):
    network = nerg.load_gaze(files / "gaze.safetensors").network
    assert repr(TrainedField(network)).startswith("<gaze field in memory: ")


# ---- Options of jobs one by one ----


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of a workflow."""

    steps: int = 5
    folder: Path | None = None
    store: Path | None = None
    seed: int = 0
    mode: str | None = None


def test01_changes_override_options(rgb):
    assert build_options(Options, "job", None, {}) == Options(mode="llvm_ad_rgb")
    assert build_options(Options, "job", Options(steps=9, seed=2), {"seed": 3}) == Options(
        steps=9, seed=3, mode="llvm_ad_rgb"
    )


def test02_active_variant_is_used(mono):
    assert build_options(Options, "job", Options(mode="llvm_ad_rgb"), {}).mode == "llvm_ad_mono"


def test04_files_may_be_named_by_strings(rgb):
    assert build_options(Options, "job", None, {"folder": "tests"}).folder == Path("tests")
    assert build_options(Options, "job", None, {"store": "to be made"}).store == Path("to be made")


CALLS = [
    (lambda: nerg.train_gaze("no.npz", scene="no.xml", test_particpants=0.3), 'did you mean "test_participants"'),
    (
        lambda: nerg.train_gaze("no.npz", scene="no.xml", test_participants=0.3),
        'file "no.xml" of "scene" does not exist',
    ),
    (lambda: nerg.train_gaze("no.npz", geometry="none"), 'file "no.npz" of "rays" does not exist'),
    (
        lambda: nerg.train_gaze(np.zeros(3), geometry="none"),
        "rays must be a Rays object .* got ndarray; .* import_rays",
    ),
    (lambda: nerg.train_gaze("no.npz"), "train_gaze needs the environment .* geometry="),
    (lambda: nerg.train_gaze(None, scene=3), '"scene" must be an environment in memory or a file, .* got int'),
    (lambda: nerg.train_radiance(None), '"photos" must be a file, given as a string or a path, got NoneType'),
    (lambda: nerg.train_radiance("no"), 'file "no" of "photos" does not exist'),
    (lambda: nerg.evaluate_gaze("no.safetensors", "no.npz"), "no.npz"),
    (lambda: nerg.evaluate_radiance(3, "."), '"field" must be .* a file, .* got int'),
    (lambda: nerg.align("no.npz", "no.xml"), "no.npz"),
    (lambda: nerg.study(3, "new"), '"scene" must be .* a file, .* got int'),
    (lambda: nerg.import_rays(np.zeros(3)), "reads files, .* got ndarray; use Rays.from_dataframe"),
    (lambda: nerg.import_rays("no.csv", colums="t=t"), 'has no option "colums"; did you mean "columns"'),
    (lambda: nerg.import_rays(["no.csv"], "unity"), 'file "no.csv" of "files" does not exist'),
    (lambda: nerg.make_scene("no.safetensors", falof=0.1), 'no setting "falof"; did you mean "falloff"?'),
    (lambda: nerg.make_scene("no.safetensors"), '^the file "no.safetensors" of "environment" does not exist'),
    (lambda: nerg.render("no.xml"), 'there is no scene file "no.xml"'),
    (lambda: nerg.render(None), "a scene must be a Scene.* got NoneType"),
    (lambda: nerg.trace(3, [0, 0, 0], [1, 0, 0]), "a scene must be a Scene.* got int"),
    (lambda: bake("no.ply", gaze="no.safetensors"), "no.safetensors"),
    (lambda: statistics("no.npz", "no.json"), "no.json"),
]


@pytest.mark.parametrize("call, said", CALLS)
def test_names_are_checked_before_files_and_files_before_work(rgb, tmp_path, monkeypatch, call, said):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(NergError, match=said) as messages:
        call()
    assert len(str(messages.value)) < 300 and not any(tmp_path.iterdir())


def test_natural_arguments_are_accepted(rgb, tmp_path):
    import mitsuba as mi

    path = tmp_path / "room.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="nerg"/><shape type="cube"/><sensor type="perspective"><film '
        'type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film></sensor></scene>'
    )
    scene = nerg.Scene.load(path)
    pictures = [
        nerg.render(options, quantities="opacity").opacity for options in (path, str(path), scene, scene.mitsuba)
    ]
    assert all((picture == pictures[0]).all() for picture in pictures)
    assert build_options(Options, "job", None, {"folder": scene}).folder == path
    # Values of `<default>`s change the scene of the file.
    assert nerg.Scene.load(path).path == path and nerg.Scene(mi.load_file(str(path))).path is None


def test03_unknown_options_are_refused(rgb):
    with pytest.raises(NergError, match='job has no option "step"; did you mean "steps"?'):
        build_options(Options, "job", None, {"step": 3})
    with pytest.raises(NergError, match="mi.set_variant"):
        build_options(Options, "job", None, {"mode": "scalar_rgb"})
    with pytest.raises(NergError, match='"xyz"'):
        build_options(Options, "job", None, {"xyz": 1})


# ---- Scenes of fields, shapes, observers and cameras, without XML ----


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
    field, gaze = nerg.load_field(files / "field.safetensors"), nerg.load_gaze(files / "gaze.safetensors")
    from_files = nerg.make_scene(files / "field.safetensors", files / "gaze.safetensors", camera=camera)
    expected = nerg.render(from_files, spp=2)
    for made in (
        nerg.make_scene(field, gaze, camera=camera),
        nerg.make_scene(field.network, TrainedField(gaze.network), camera=camera),
    ):
        result = nerg.render(made, spp=2)
        for name in expected:
            assert np.array_equal(result[name], expected[name]), name
    assert "field: field.safetensors" in repr(nerg.make_scene(field)) and "in memory" in repr(
        nerg.make_scene(field.network)
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
    field, gaze = nerg.load_field(files / "field.safetensors"), nerg.load_gaze(files / "gaze.safetensors")
    with pytest.raises(nerg.NergError, match="pass it with gaze="):
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


# ---- Shapes from files, dicts and objects, by name ----


def test01_names(rgb):
    ball = {"type": "sphere"}
    assert to_scene_children(None) == {}
    assert list(to_scene_children(ball, "thing")) == ["thing"]
    assert list(to_scene_children([ball, [ball, ball]])) == ["shape_0", "shape_1_0", "shape_1_1"]
    assert list(to_scene_children({"left": ball, "right": rgb.load_dict(ball)})) == ["left", "right"]


@pytest.mark.parametrize(
    "name", ["Cube.001", "camera", "integrator", "type", "$x", "a\x1b[31m", "", "x" * 300, "OTHER"]
)
def test03_names_that_scenes_use_or_forbid(tmp_path, name):
    trimesh = pytest.importorskip("trimesh")
    room = trimesh.Scene()
    for k, node in enumerate((name, "other")):
        room.add_geometry(trimesh.creation.box((1, 1, k + 1)), node_name=node)
    scene = nerg.make_scene(room, shapes=[room, room], camera=nerg.Camera((0, 0, 0), (1, 0, 0), width=8, height=8))
    scene.save(tmp_path / "scene.xml")
    # Files that differ by case only are one file in some folders.
    assert len({file.name.casefold() for file in (tmp_path / "scene.meshes").iterdir()}) == 6
    for each in (scene, nerg.Scene.load(tmp_path / "scene.xml")):
        shapes = each.mitsuba.shapes()
        assert sorted(round(shape.bbox().extents().z) for shape in shapes) == [1, 1, 1, 2, 2, 2]
        assert all(shape.id().isprintable() for shape in shapes)


def test02_a_scene_gives_its_shapes_and_lights(rgb):
    lamp = {"type": "sphere", "emitter": {"type": "area"}}
    scene = rgb.load_dict({"type": "scene", "lamp": lamp, "sky": {"type": "constant"}, "spot": {"type": "point"}})
    children = to_scene_children(scene)
    # The lamp has its own light.
    assert set(children) == {"lamp", "shape_light_0", "shape_light_1"}
    again = rgb.load_dict({"type": "scene", **children})
    assert len(again.emitters()) == 3 and len(again.shapes()) == 1


PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property {0} red
property {0} green
property {0} blue
property float quality
element face 1
property list uchar int vertex_indices
end_header
0 0 0 {1}
1 0 0 {1}
0 1 0 {1}
3 0 1 2
"""


def test04_files_are_checked_first(rgb, tmp_path):
    path = tmp_path / "cube.ply"
    rgb.load_dict({"type": "cube"}).write_ply(str(path))
    assert rgb.load_dict(load_mesh_child(path)).face_count() == 12
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(NergError, match="cube.ply"):
        load_mesh_child(path)
    # Mitsuba does not read quads; mesh arguments support them, with the material of other meshes.
    (tmp_path / "quad.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf -4 -3 -2 -1\n")
    shape = load_content({"type": "scene", **to_scene_children(tmp_path / "quad.obj", "quad")}).shapes()[0]
    assert shape.face_count() == 2 and shape.id() == "quad" and shape.bsdf().class_name() == "TwoSidedBRDF"
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    with pytest.raises(NergError, match="empty.obj"):
        load_mesh_child(tmp_path / "empty.obj")


@pytest.mark.parametrize(
    "name, text, said",
    [
        ("a.obj", "mtllib a.mtl\nv 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nf 1 2 3\n", "mtllib"),
        ("a.ply", PLY.format("uchar", "255 0 0 7"), "quality"),
        ("a.ply", PLY.format("float", "1 0 0 7"), "quality"),
    ],
)
def test_colours_of_files_are_used_and_other_content_is_reported(rgb, monkeypatch, tmp_path, name, text, said):
    (tmp_path / name).write_text(text)
    notes = []
    monkeypatch.setattr(rgb, "Log", lambda level, note: notes.append(note))
    child = load_mesh_child(tmp_path / name)
    (note,) = notes
    assert said in note and str(tmp_path / name) in note
    scene = load_content({"type": "scene", "a": child})
    si = scene.ray_intersect(rgb.Ray3f((0.2, 0.2, 1), (0, 0, -1)))
    assert np.allclose(np.ravel(si.bsdf().eval_diffuse_reflectance(si)), (1, 0, 0), atol=1e-4)


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
