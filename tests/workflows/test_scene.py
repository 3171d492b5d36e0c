"""Scene files for fields, meshes and rays, and scenes for the viewer."""

from __future__ import annotations

import json
import shutil
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

import nerg_mi as nerg
from nerg_mi.errors import NergError
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.fields.splats import Splats
from nerg_mi.formats.checkpoint import write_checkpoint
from nerg_mi.formats.fields import load_gaze, save_gaze, save_radiance
from nerg_mi.formats.gltf import encode_unlit_glb
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.geometry import Box, ContractedBox
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.options import GeometryOptions
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import render_channels
from nerg_mi.rendering.files import read_frames
from nerg_mi.rendering.nested_scene import GAZE_PROPERTY, find_field_file
from nerg_mi.rendering.scene import load_scene
from nerg_mi.train.geometry_files import make_geometry
from nerg_mi.workflows import demo, scene
from nerg_mi.workflows.render import render_file
from nerg_mi.workflows.scene import write_scene
from nerg_mi.workflows.scene_commands import PictureOptions, SceneOptions, ViewOptions
from nerg_mi.workflows.view import make_viewer_scene, write_variants
from tests.formats.splats.writers import random_splats, write_inria, write_spz
from tests.pictures import mitsuba_bitmap
from tests.plugins import fields
from tests.rays.dataset.making import DAY, assert_same, write_dataset
from tests.refusals import mentions
from tests.workflows.recorder import Recorder

# ---- Scenes written for every kind of geometry, each rendered without changes ----


MODE = "llvm_ad_rgb"
SMALL = {"width": "18", "height": "12", "sphere_width": "16", "sphere_height": "8", "spp": "2"}
ROOM = """<scene version="3.0.0">
    <integrator type="path"/>
    <shape type="cube">
        <transform name="to_world"><scale value="2"/></transform><boolean name="flip_normals" value="true"/>
    </shape>
    <emitter type="point"><point name="position" value="0, 0, 1.5"/><rgb name="intensity" value="5"/></emitter>
    <sensor type="perspective"/>
</scene>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Geometries of all kinds around the origin, a gaze field, and rays of two participants."""
    import mitsuba as mi

    mi.set_variant(MODE)
    folder = tmp_path_factory.mktemp("places")
    fields.radiance(folder / "field.safetensors", density_scale=6.0)
    fields.gaze(folder / "gaze.safetensors")
    (folder / "room.xml").write_text(ROOM)
    mesh = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale(2)})
    mesh.write_ply(str(folder / "mesh.ply"))
    rays().save(folder / "rays.npz")
    return folder


def rays():
    """Two participants near (0.3, 0.2, 0.1), who look at the wall x = 2 from inside a cube of ±2."""
    rng = np.random.default_rng(0)
    n = 800
    origin = rng.normal((0.3, 0.2, 0.1), 0.05, (n, 3))
    direction = rng.normal((1, 0, 0), 0.15, (n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    hit = origin + direction * ((2 - origin[:, 0]) / direction[:, 0])[:, None]
    return Rays(np.arange(n) / 50, np.arange(n) % 2, ("Ada", "Bob"), origin, direction, np.ones(n), hit)


def trained(folder, name, metadata):
    """Save the gaze field with a different provenance."""
    import drjit.llvm.ad as ns

    field = load_gaze(folder / "gaze.safetensors", ns)[0]
    save_gaze(field, folder / name, metadata)
    return folder / name


def shown(path, sensor=0, **values):
    """The image of a sensor of a written scene."""
    scene = load_scene(path, {**SMALL, **values})
    return scene, render_channels(scene, scene.sensors()[sensor])


def position(sensor):
    return np.array(sensor.world_transform().matrix, float).reshape(4, 4)[:3, 3]


def defaults(path):
    return {d.get("name"): d.get("value") for d in ElementTree.parse(path).iter("default")}


@pytest.mark.parametrize("place", ["field.safetensors", "room.xml"])
def test_geometry_with_gaze_and_an_observer(rgb, folder, tmp_path, place):
    options = SceneOptions(observer=(0.3, 0.2, 0.1), mode=MODE)
    result = write_scene([folder / "gaze.safetensors", folder / place], tmp_path / "a.xml", options)
    assert result.quantity == "gaze" and result.path.is_file()
    scene, image = shown(result.path)
    np.testing.assert_allclose(
        np.ravel(scene.integrator().observer.world_transform().translation()), (0.3, 0.2, 0.1), atol=1e-6
    )
    np.testing.assert_allclose(position(scene.sensors()[1]), (0.3, 0.2, 0.1), atol=1e-6)
    np.testing.assert_allclose(position(scene.sensors()[0]), result.camera.origin, atol=1e-6)
    assert image.mask.mean() > 0.5 and image.aovs["gaze"].max() > 0 and image.color.max() > 0.01
    # Nothing is occluded in the observer's own view.
    _, observer_image = shown(result.path, 1)
    assert observer_image.mask.any() and observer_image.aovs["visibility"][observer_image.mask].min() == 1
    # Written paths are relative to the folder of the scene.
    named = defaults(result.path)["gaze"]
    assert not named.startswith("/") and (tmp_path / named).samefile(folder / "gaze.safetensors")


def test_geometry_alone_has_the_best_overview_camera(rgb, folder, tmp_path):
    recorder = Recorder()
    result = write_scene([folder / "mesh.ply"], tmp_path / "a.xml", SceneOptions(mode=MODE), recorder)
    scene, image = shown(result.path)
    assert result.observer is None and result.quantity is None and scene.integrator().observer is None
    assert image.mask.mean() > 0.5 and image.color[image.mask].mean() > 0.05
    assert f"wrote {result.path}" in recorder.messages and any("best overview" in line for line in recorder.messages)


def written_place(folder, kind, scale):
    """A room of 6 x 4 x 3 metres, or a cloud in it, in units of 1/scale metres: its file, and its upper corner."""
    corner = np.array([3, 2, 1.5]) * scale
    path = folder / ("place" + {"hits": ".vol", "scene": ".xml", "field": ".safetensors"}.get(kind, ".ply"))
    if kind == "mesh":
        trimesh.creation.box(2 * corner).export(path)
    elif kind == "hits":
        walls = np.pad(np.zeros((10, 14, 18), np.float32), 1, constant_values=50 / scale)
        write_volume(path, walls, -corner, corner)
    elif kind == "scene":
        size = '<transform name="to_world"><scale value="{}, {}, {}"/></transform>'.format(*corner)
        path.write_text(f'<scene version="3.0.0"><shape type="cube">{size}</shape></scene>')
    elif kind == "field":
        config = RadianceConfig(fields.GRID, width=16, geometry=3, sh_degree=2, density_scale=6 / scale)
        box = Box(tuple(-corner), tuple(corner))
        save_radiance(RadianceField.random(config, box, _ns(), march_step=0.1 * scale), path, {})
    else:
        n, centers = 2000, fibonacci_directions(2000) * corner
        write_inria(path, Splats(centers, [[0.1 * scale] * 3] * n, [[1, 0, 0, 0]] * n, [0.99] * n, np.ones((n, 1, 3))))
    return path, corner


@pytest.mark.nightly
@pytest.mark.parametrize("scale", [1e-4, 1e6])
@pytest.mark.parametrize("kind", ["mesh", "scene", "field", "splats", "hits"])
def test_geometry_of_any_unit_is_visible(rgb, tmp_path, kind, scale):
    path, corner = written_place(tmp_path, kind, scale)
    recorder, eye = Recorder(), tuple(0.1 * corner)
    result = write_scene([path], tmp_path / "a.xml", SceneOptions(observer=eye, mode=MODE), recorder)
    for sensor in (0, 1):
        _, image = shown(result.path, sensor)
        assert image.mask.mean() > 0.9 and image.color.mean() > 0.1
    # The observer's own view sees all visible surfaces in any unit; gaze fades within the scene.
    assert image.aovs["visibility"][image.mask].min() == 1
    assert 1e-4 * np.linalg.norm(corner) < float(defaults(result.path)["falloff"]) < 0.1 * np.linalg.norm(corner)
    assert any("light leaks" in line for line in recorder.warnings) == (kind == "scene" and scale < 1)


def test_an_empty_image_is_refused(rgb, folder, tmp_path):
    away = SceneOptions(camera=(9, 0, 0), target=(20, 0, 0), mode=MODE)
    with pytest.raises(NergError, match="the image of the camera would be empty; choose"):
        write_scene([folder / "mesh.ply"], tmp_path / "a.xml", away)
    assert not (tmp_path / "a.xml").exists()


def test_an_unbounded_field_is_shown(rgb, tmp_path):
    config = RadianceConfig(fields.GRID, width=16, geometry=3, sh_degree=2, density_scale=1.0)
    box = ContractedBox(Box((-2, -2, -2), (2, 2, 2)), 16)
    field = RadianceField.random(config, box, _ns(), march_step=0.1, march_growth=1 / 64)
    save_radiance(field, tmp_path / "far.safetensors", {"up": [0, 1, 0]})
    result = write_scene([tmp_path / "far.safetensors"], tmp_path / "a.xml", SceneOptions(mode=MODE))
    # The camera is in the inner cube, and up is the direction from the photos.
    assert np.abs(result.camera.origin).max() <= 2 and defaults(result.path)["up"] == "0, 1, 0"
    _, image = shown(result.path)
    assert image.mask.mean() > 0.5


def test_gaze_alone_locates_its_geometry_by_name_and_checksum(rgb, folder, tmp_path):
    place = make_geometry(GeometryOptions(field=folder / "field.safetensors"), None, (), None)
    gaze = trained(folder, "of_field.safetensors", place.metadata)
    result = write_scene([gaze], tmp_path / "a.xml", SceneOptions(observer=(0, 0, 0), mode=MODE))
    _, image = shown(result.path)
    assert image.mask.any() and image.aovs["gaze"].max() > 0
    other = trained(folder, "of_other.safetensors", {"field_file": {"file": "gaze.safetensors", "sha256": "0"}})
    with pytest.raises(NergError, match="was trained in; name the right file: nerg scene"):
        write_scene([other], tmp_path / "b.xml", SceneOptions(mode=MODE))
    recorder = Recorder()
    options = SceneOptions(observer=(0, 0, 0), mode=MODE)
    write_scene([other, folder / "field.safetensors"], tmp_path / "c.xml", options, recorder)
    assert any("was not trained in" in line for line in recorder.warnings)
    with pytest.raises(NergError, match="does not store the geometry"):
        write_scene([folder / "gaze.safetensors"], tmp_path / "d.xml", SceneOptions(mode=MODE))


def _ns():
    import drjit.llvm.ad as ns

    return ns


def test_hit_points_become_coloured_geometry(rgb, folder, tmp_path):
    place = make_geometry(GeometryOptions(geometry="hits"), rays(), (), folder / "hits.vol", 0.1)
    gaze = trained(folder, "of_hits.safetensors", {**place.metadata, "rays_file": {}})
    result = write_scene([gaze, folder / "rays.npz"], tmp_path / "a.xml", SceneOptions(mode=MODE))
    assert [path.name for path in result.files] == ["a.xml", "a.color.vol"]
    np.testing.assert_allclose(result.observer.origin, (0.3, 0.2, 0.1), atol=0.1)
    _, observer_image = shown(result.path, 1)
    # The wall fills the view, at its distance, in the grey of walls along x.
    middle = observer_image.mask[4:8, 7:11]
    assert middle.all() and observer_image.aovs["depth"][6, 9] == pytest.approx(1.7, abs=0.25)
    assert observer_image.color[6, 9, 0] == pytest.approx(0.34, abs=0.03)


@pytest.mark.parametrize("geometry", [None, "none"])
def test_rays_alone_show_attention(rgb, folder, tmp_path, geometry):
    options = SceneOptions(geometry=geometry, mode=MODE)
    result = write_scene([folder / "rays.npz"], tmp_path / "a.xml", options)
    assert result.quantity == "kde"
    made = ["a.xml"] if geometry == "none" else ["a.xml", "a.vol", "a.color.vol"]
    assert [path.name for path in result.files] == made
    ahead = result.observer.target - result.observer.origin
    assert ahead[0] / np.linalg.norm(ahead) > 0.97
    scene, sphere = shown(result.path, 2)
    if geometry == "none":
        np.testing.assert_allclose(sphere.aovs["depth"], 2, atol=1e-3)
        np.testing.assert_allclose(result.camera.origin, result.observer.origin)
    # Attention is at the viewed point, the centre of the panorama, and not behind the observer.
    assert sphere.aovs["kde"][3:5, 7:9].min() > 10 * max(sphere.aovs["kde"][:, 0].max(), 1e-6)


def test_an_observer_facing_along_up_is_valid(rgb, folder, tmp_path):
    """Before and after the observer is turned to the gaze, which all points up."""
    options = SceneOptions(geometry="none", up=(1.0, 0.0, 0.0), mode=MODE)
    result = write_scene([folder / "rays.npz"], tmp_path / "a.xml", options)
    ahead = result.observer.target - result.observer.origin
    assert ahead[0] / np.linalg.norm(ahead) > 0.97 and shown(result.path, 1)[0] is not None


def test_rays_in_another_frame_are_aligned(rgb, folder, tmp_path):
    matrix = np.array([[0, 0, 2, 0.5], [2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 0, 1]], float)
    align = tmp_path / "align.json"
    align.write_text(json.dumps(matrix.tolist()))
    options = SceneOptions(align=align, person="Ada", time=4.0, mode=MODE)
    result = write_scene([folder / "mesh.ply", folder / "rays.npz"], tmp_path / "a.xml", options)
    nearest = rays().origin[200]
    np.testing.assert_allclose(result.observer.origin, matrix[:3, :3] @ nearest + matrix[:3, 3], atol=1e-6)
    ahead = result.observer.target - result.observer.origin
    np.testing.assert_allclose(ahead, matrix[:3, :3] @ rays().direction[200], atol=1e-6)
    # The up direction +z of the rays is +x of the scene, and a metre is two units.
    values = defaults(result.path)
    assert values["up"] == "1, 0, 0" and values["falloff"] == "0.1"
    _, observer_image = shown(result.path, 1)
    assert observer_image.aovs["kde"].max() > 0.5


def test_explicit_cameras_are_used(rgb, folder, tmp_path):
    files, at = [folder / "mesh.ply"], tmp_path / "a.xml"
    options = SceneOptions(camera=(0, 0, 1.5), target=(0, 0, -1), fov=50, width=30, mode=MODE)
    result = write_scene(files, at, options)
    np.testing.assert_allclose(result.camera.target, (0, 0, -1))
    # It looks straight down, and still has an up direction.
    scene = load_scene(at)
    assert np.isfinite(np.array(scene.sensors()[0].world_transform().matrix)).all()
    assert tuple(scene.sensors()[0].film().crop_size()) == (30, 20)
    first_person = write_scene(files, at, SceneOptions(observer=(0.5, 0, 0), first_person=True, mode=MODE))
    np.testing.assert_allclose(first_person.camera.origin, (0.5, 0, 0))


def test_a_walk_writes_frames(rgb, folder, tmp_path):
    options = SceneOptions(person="Bob", time_range=(2.0, 2.4), fps=5, first_person=True, mode=MODE)
    result = write_scene([folder / "mesh.ply", folder / "rays.npz"], tmp_path / "a.xml", options)
    assert result.frames == 3 and result.files[-1].name == "a.frames.csv"
    frames = read_frames(result.files[-1])
    assert [set(frame) for frame in frames] == [{"eye", "ahead", "camera", "target"}] * 3
    bob = rays()
    indices = np.flatnonzero(bob.person == 1)
    eye = np.array([float(x) for x in frames[0]["eye"].split(",")])
    wanted = [np.interp(2.0, bob.t[indices], bob.origin[indices, axis]) for axis in range(3)]
    np.testing.assert_allclose(eye, wanted, atol=1e-6)
    pictures = PictureOptions(overlay="kde", frames=result.files[-1], defaults=SMALL, mode=MODE)
    made = render_file(result.path, tmp_path / "walk.png", pictures)
    assert [p.name for p in made.files] == ["walk_0001.png", "walk_0002.png", "walk_0003.png"]
    assert len({p.read_bytes() for p in made.files}) == 3 and made.vmax > 0
    sizes = {tuple(mitsuba_bitmap(p).size()) for p in made.files}
    assert len(sizes) == 1


@pytest.mark.parametrize(
    "names, options, said",
    [
        ([], {}, "a scene needs a field"),
        (["nowhere.ply"], {}, "there is no file"),
        (["room.xml", "mesh.ply"], {}, "have the same role"),
        (["rays.npz"], {"geometry": "hit"}, 'geometry.*"hits".*"none"'),
        (["mesh.ply"], {"geometry": "hits"}, "geometry"),
        (["mesh.ply"], {"person": "Ada"}, "person needs one of time and time_range,"),
        (["mesh.ply"], {"person": "Ada", "time": 1.0}, "person"),
        (["rays.npz"], {"person": "Eve", "time": 1.0}, "Eve"),
        (["mesh.ply"], {"target": (0, 0, 1)}, "the camera is set by camera and target, by"),
        (["mesh.ply"], {"photo": "1"}, "photo needs the photos of the training; add"),
        (["mesh.ply"], {"observer": (1, 2)}, "observer must be three numbers x,y,z, got"),
        (["mesh.ply"], {"camera": (1, 2, 3), "target": (1, 2, 3)}, "camera position and target are the same; choose"),
        (["mesh.ply"], {"first_person": True}, "first_person=True needs an observer; add"),
        (["mesh.ply"], {"up": (0, 0, 0)}, "up must be a direction"),
        (["mesh.ply"], {"fov": 200.0}, "fov must lie in"),
    ],
)
def test_files_that_make_no_scene_are_refused(rgb, folder, tmp_path, names, options, said):
    with pytest.raises(NergError, match=said):
        write_scene([folder / name for name in names], tmp_path / "a.xml", SceneOptions(mode=MODE, **options))
    assert not (tmp_path / "a.xml").exists()


def test_a_gaze_field_alone_needs_an_observer(rgb, folder, tmp_path):
    gaze = trained(folder, "of_nothing.safetensors", {"geometry": "none"})
    with pytest.raises(NergError, check=mentions("observer")):
        write_scene([gaze], tmp_path / "a.xml", SceneOptions(mode=MODE))
    result = write_scene([gaze], tmp_path / "a.xml", SceneOptions(observer=(0.1, 0, 0), mode=MODE))
    _, image = shown(result.path)
    assert image.mask.all() and image.aovs["gaze"].max() > 0 and len(np.unique(image.color.round(3))) > 1


# ---- Rays of a file and of a dataset in a scene ----


@pytest.fixture
def parquet():
    pytest.importorskip("pyarrow", reason="datasets need the extra parquet")


def test_rays_of_a_file_are_used_unchanged(tmp_path):
    rays = Rays(np.zeros(1), np.zeros(1, int), ("Ada",), np.zeros((1, 3)), np.eye(3)[:1], np.ones(1))
    rays.save(tmp_path / "rays.npz")
    loaded = scene.load_scene_rays(tmp_path / "rays.npz", tmp_path / "a.xml", Recorder())
    assert (
        loaded.file == tmp_path / "rays.npz"
        and loaded.written_files == ()
        and loaded.select_person("Ada") is loaded.rays
    )
    none = scene.load_scene_rays(None, tmp_path / "a.xml", Recorder())
    assert none.rays is None and none.file is None and none.select_person("Ada") is None


def test_a_sample_of_a_dataset_is_stored_next_to_the_scene(parquet, tmp_path, monkeypatch):
    """All rays of a participant are read for the eye position, since a sample would miss most times."""
    _, rays = write_dataset(tmp_path)
    recorder = Recorder()
    loaded = scene.load_scene_rays(tmp_path / "shop.rays", tmp_path / "a.xml", recorder)
    assert loaded.file == tmp_path / "a.rays.npz" and loaded.written_files == (loaded.file,)
    assert_same(Rays.load(loaded.file), rays)
    assert any(f"{len(rays):,} rays" in line for line in recorder.messages)
    monkeypatch.setattr(scene, "MAX_SCENE_RAYS", 100)
    some = scene.load_scene_rays(tmp_path / "shop.rays", tmp_path / "a.xml", recorder)
    assert some.rays is not None and len(some.rays) == 100 == len(Rays.load(loaded.file))
    person_rays = some.select_person("p1_0")
    assert person_rays is not None and person_rays.persons == ("p1_0",)
    assert len(person_rays) == int((rays.person == rays.persons.index("p1_0")).sum())


def test_a_scene_is_written_from_a_dataset(parquet, rgb, tmp_path):
    """The dataset can also be named by a path in it; the scene renders, and contains a participant."""
    write_dataset(tmp_path)
    options = SceneOptions(person="p2_1", time=DAY + 2 * 43_200 + 3.0, geometry="none")
    made = write_scene([tmp_path / "shop.rays" / "place=shop"], tmp_path / "a.xml", options)
    assert made.quantity == "kde" and tmp_path / "a.rays.npz" in made.files
    assert made.observer is not None and load_scene(made.path, {"spp": "1"}).sensors()
    with pytest.raises(NergError, match="Eve"):
        write_scene([tmp_path / "shop.rays"], tmp_path / "b.xml", SceneOptions(person="Eve", time=1.0))


def test_a_folder_with_the_output_name_is_refused(parquet, tmp_path):
    write_dataset(tmp_path, files=1)
    (tmp_path / "a.rays.npz").mkdir()
    with pytest.raises(NergError, match=r"a\.rays\.npz"):
        scene.check_rays(tmp_path / "shop.rays", tmp_path / "a.xml")


# ---- From files and folders to the scene of the viewer ----


MESH = "v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def rays_file(tmp_path):
    path = tmp_path / "rays.npz"
    ahead = [[1.0, 0, 0]] * 3
    nerg.Rays([0, 1, 2], [0, 0, 0], ("Ada",), [[0, 0, 1.6]] * 3, ahead, np.ones(3)).save(path)
    return path


def test01_a_scene_with_nerg_is_used_unchanged(rgb, tmp_path, rays_file):
    store = demo.find_store_scene()
    place = make_viewer_scene([store, rays_file], tmp_path / "new", ViewOptions(up=(0, 0, 2)))
    assert place.scene == store and not place.made and len(place.rays) == 3
    assert np.array_equal(place.up, [0, 0, 1]) and place.name == f"{store.name} + rays.npz"


def test02_other_files_get_a_new_scene(rgb, tmp_path):
    (tmp_path / "a.obj").write_text(MESH)
    recorder = Recorder()
    place = make_viewer_scene([tmp_path / "a.obj"], tmp_path, ViewOptions(up=(0, 1, 0)), recorder)
    assert place.made and place.rays is None and np.allclose(place.up, [0, 1, 0])
    assert type(nerg.Scene.load(place.scene)).__name__ == "Scene"


def test03_a_folder_is_replaced_by_its_files(rgb, tmp_path, rays_file):
    run = tmp_path / "run"
    run.mkdir()
    with pytest.raises(NergError, match="contains nothing that the viewer can show; name"):
        make_viewer_scene([run], tmp_path)
    (run / "a.obj").write_text(MESH)
    (run / "notes.txt").write_text("x")
    (run / "mesh.glb").write_bytes(b"".join(encode_unlit_glb([("POSITION", np.eye(3, dtype="<f4"), False)], None)))
    assert make_viewer_scene([run], tmp_path).name == "a.obj"
    for name in ("scene.xml", "other.xml"):
        shutil.copy(demo.find_store_scene().parent / "shapes.xml", run / name)
    for name in ("twin.ply", "twin_lights.ply", "display.xml"):
        shutil.copy(demo.find_store_scene().parent / name, run / name)
    (run / "scene.xml").unlink()
    with pytest.raises(NergError, match="name one of them"):
        make_viewer_scene([run], tmp_path)


def test03_splats_in_a_folder_are_recognised(rgb, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    write_spz(run / "a.spz", random_splats(9))
    place = make_viewer_scene([run], tmp_path, ViewOptions(observer=(0.0, 0.0, -3.0)))
    assert place.made and place.name == "a.spz" and 'type="splats"' in place.scene.read_text()


def test04_two_files_of_one_kind_are_reported(rgb, tmp_path, rays_file):
    shutil.copy(rays_file, tmp_path / "more.npz")
    with pytest.raises(NergError, match="both rays"):
        make_viewer_scene([rays_file, tmp_path / "more.npz"], tmp_path)
    with pytest.raises(NergError, match="nothing to view"):
        make_viewer_scene([], tmp_path)
    with pytest.raises(NergError, match="up must be a direction"):
        make_viewer_scene([demo.find_store_scene()], tmp_path, ViewOptions(up=(0, 0, 0)))


def test05_one_place_of_a_dataset_is_shown(parquet, rgb, tmp_path):
    """As in all commands, a dataset is named by its folder, or by a folder of an environment in it."""
    _, rays = write_dataset(tmp_path)
    (tmp_path / "a.obj").write_text(MESH)
    for name in ("shop.rays", "shop.rays/place=shop"):
        place = make_viewer_scene([tmp_path / "a.obj", tmp_path / name], tmp_path, ViewOptions(up=(0, 0, 1)))
        assert place.rays is not None and len(place.rays) == len(rays) and place.made


@pytest.mark.nightly
def test06_several_gaze_fields_are_variants(rgb, tmp_path):
    store = demo.find_store_scene()
    run, recorder = tmp_path / "run", Recorder()
    run.mkdir()
    for name in ("a", "b"):
        shutil.copy(store.parent / "shoppers.safetensors", run / f"{name}.safetensors")
    place = make_viewer_scene([store, run], tmp_path, reporter=recorder)
    assert list(place.variants) == ["shoppers", "a", "b"] and place.scene == place.variants["shoppers"]
    assert (
        find_field_file(place.variants["b"], GAZE_PROPERTY) == (run / "b.safetensors").resolve()
        and place.made
        and not recorder.warnings
    )
    # A repeated name gets the folder's name as a prefix; a field with another geometry is reported.
    shutil.copy(run / "a.safetensors", tmp_path / "a.safetensors")
    metadata = {"provenance": {"field_file": {"file": "x", "sha256": "y"}}}
    write_checkpoint(tmp_path / "c.safetensors", "gaze", {"a": np.zeros(1, np.float32)}, metadata)
    files = [run / "a.safetensors", tmp_path / "a.safetensors", tmp_path / "c.safetensors"]
    variants = write_variants(store, files, tmp_path, recorder)
    assert list(variants) == ["a", f"{tmp_path.name}/a", "c"]
    assert len(recorder.warnings) == 1 and "another scene" in recorder.warnings[0]
    # For fields alone a scene is made with the geometry of their training.
    shutil.copy(store.parent / "store.safetensors", run / "store.safetensors")
    place = make_viewer_scene([run], tmp_path)
    assert place.made and list(place.variants) == ["a", "b"]
