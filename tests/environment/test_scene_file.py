"""Scene files for environments of each kind, gaze fields and rays, each rendered without changes."""

from __future__ import annotations

import json
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

from nerg_mi.environment import scene_file
from nerg_mi.environment.arrays import Camera
from nerg_mi.environment.bands import render_channels
from nerg_mi.environment.contents import DensityGrid
from nerg_mi.environment.environment import Environment, make_hit_geometry
from nerg_mi.environment.gaze import GazeField
from nerg_mi.environment.observers import ObserverChoice
from nerg_mi.environment.radiance import RadianceField
from nerg_mi.environment.rendering_files import read_frames
from nerg_mi.environment.scene import make_scene
from nerg_mi.environment.scene_cameras import CameraChoice
from nerg_mi.environment.scene_file import open_shown, place_scene, write_scene
from nerg_mi.environment.scene_loading import load_scene
from nerg_mi.errors import NergError
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.fields.splats import Splats
from nerg_mi.formats.fields import load_gaze, save_gaze, save_radiance
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.geometry import Box, ContractedBox
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.tracking.rays import Rays
from tests.formats.splats.writers import write_inria
from tests.plugins import fields
from tests.recorder import Recorder
from tests.refusals import mentions
from tests.tracking.dataset.making import DAY, assert_same, write_dataset

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

    mi.set_variant("llvm_ad_rgb")
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
    result = write_scene([folder / "gaze.safetensors", folder / place], tmp_path / "a.xml", observer=(0.3, 0.2, 0.1))
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
    result = write_scene([folder / "mesh.ply"], tmp_path / "a.xml", progress=recorder)
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
        save_radiance(RadianceNetwork.random(config, box, _ns(), march_step=0.1 * scale), path, {})
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
    result = write_scene([path], tmp_path / "a.xml", observer=eye, progress=recorder)
    for sensor in (0, 1):
        _, image = shown(result.path, sensor)
        assert image.mask.mean() > 0.9 and image.color.mean() > 0.1
    # The observer's own view sees all visible surfaces in any unit; gaze fades within the scene.
    assert image.aovs["visibility"][image.mask].min() == 1
    assert 1e-4 * np.linalg.norm(corner) < float(defaults(result.path)["falloff"]) < 0.1 * np.linalg.norm(corner)
    assert any("light leaks" in line for line in recorder.warnings) == (kind == "scene" and scale < 1)


def test_an_empty_image_is_refused(rgb, folder, tmp_path):
    with pytest.raises(NergError, match="the image of the camera would be empty; choose"):
        write_scene([folder / "mesh.ply"], tmp_path / "a.xml", camera=(9, 0, 0), target=(20, 0, 0))
    assert not (tmp_path / "a.xml").exists()


def test_an_unbounded_field_is_shown(rgb, tmp_path):
    config = RadianceConfig(fields.GRID, width=16, geometry=3, sh_degree=2, density_scale=1.0)
    box = ContractedBox(Box((-2, -2, -2), (2, 2, 2)), 16)
    field = RadianceNetwork.random(config, box, _ns(), march_step=0.1, march_growth=1 / 64)
    save_radiance(field, tmp_path / "far.safetensors", {"up": [0, 1, 0]})
    result = write_scene([tmp_path / "far.safetensors"], tmp_path / "a.xml")
    # The camera is in the inner cube, and up is the direction from the photos.
    assert np.abs(result.camera.origin).max() <= 2 and defaults(result.path)["up"] == "0, 1, 0"
    _, image = shown(result.path)
    assert image.mask.mean() > 0.5


def test_gaze_alone_locates_its_geometry_by_name_and_checksum(rgb, folder, tmp_path):
    place = Environment.open(folder / "field.safetensors")
    gaze = trained(folder, "of_field.safetensors", place.metadata)
    result = write_scene([gaze], tmp_path / "a.xml", observer=(0, 0, 0))
    _, image = shown(result.path)
    assert image.mask.any() and image.aovs["gaze"].max() > 0
    other = trained(folder, "of_other.safetensors", {"field_file": {"file": "gaze.safetensors", "sha256": "0"}})
    with pytest.raises(NergError, match="was trained in; give the one"):
        write_scene([other], tmp_path / "b.xml")
    recorder = Recorder()
    write_scene([other, folder / "field.safetensors"], tmp_path / "c.xml", observer=(0, 0, 0), progress=recorder)
    assert any("was not trained in" in line for line in recorder.warnings)
    with pytest.raises(NergError, match="does not store the geometry"):
        write_scene([folder / "gaze.safetensors"], tmp_path / "d.xml")


def _ns():
    import drjit.llvm.ad as ns

    return ns


def test_hit_points_become_coloured_geometry(rgb, folder, tmp_path):
    place = make_hit_geometry(rays(), 0.1).save(folder / "hits")
    gaze = trained(folder, "of_hits.safetensors", {**place.metadata, "rays_file": {}})
    result = write_scene([gaze, folder / "rays.npz"], tmp_path / "a.xml")
    assert [path.name for path in result.files] == ["a.xml", "a.color.vol"]
    np.testing.assert_allclose(result.observer.origin, (0.3, 0.2, 0.1), atol=0.1)
    _, observer_image = shown(result.path, 1)
    # The wall fills the view, at its distance, in the grey of walls along x.
    middle = observer_image.mask[4:8, 7:11]
    assert middle.all() and observer_image.aovs["depth"][6, 9] == pytest.approx(1.7, abs=0.25)
    assert observer_image.color[6, 9, 0] == pytest.approx(0.34, abs=0.03)


@pytest.mark.parametrize("geometry", [None, "none"])
def test_rays_alone_show_attention(rgb, folder, tmp_path, geometry):
    result = write_scene([folder / "rays.npz"], tmp_path / "a.xml", environment=geometry)
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
    result = write_scene([folder / "rays.npz"], tmp_path / "a.xml", environment="none", up=(1.0, 0.0, 0.0))
    ahead = result.observer.target - result.observer.origin
    assert ahead[0] / np.linalg.norm(ahead) > 0.97 and shown(result.path, 1)[0] is not None


def test_rays_in_another_frame_are_aligned(rgb, folder, tmp_path):
    matrix = np.array([[0, 0, 2, 0.5], [2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 0, 1]], float)
    align = tmp_path / "align.json"
    align.write_text(json.dumps(matrix.tolist()))
    files = [folder / "mesh.ply", folder / "rays.npz"]
    result = write_scene(files, tmp_path / "a.xml", align=align, person="Ada", time=4.0)
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
    result = write_scene(files, at, camera=(0, 0, 1.5), target=(0, 0, -1), fov=50, width=30)
    np.testing.assert_allclose(result.camera.target, (0, 0, -1))
    # It looks straight down, and still has an up direction.
    scene = load_scene(at)
    assert np.isfinite(np.array(scene.sensors()[0].world_transform().matrix)).all()
    assert tuple(scene.sensors()[0].film().crop_size()) == (30, 20)
    first_person = write_scene(files, at, observer=(0.5, 0, 0), first_person=True)
    np.testing.assert_allclose(first_person.camera.origin, (0.5, 0, 0))


def test_a_walk_writes_frames(rgb, folder, tmp_path):
    result = write_scene(
        [folder / "mesh.ply", folder / "rays.npz"],
        tmp_path / "a.xml",
        person="Bob",
        time_range=(2.0, 2.4),
        fps=5,
        first_person=True,
    )
    assert result.num_frames == 3 and result.files[-1].name == "a.frames.csv"
    frames = read_frames(result.files[-1])
    assert [set(frame) for frame in frames] == [{"eye", "ahead", "camera", "target"}] * 3
    bob = rays()
    indices = np.flatnonzero(bob.person == 1)
    eye = np.array([float(x) for x in frames[0]["eye"].split(",")])
    wanted = [np.interp(2.0, bob.t[indices], bob.origin[indices, axis]) for axis in range(3)]
    np.testing.assert_allclose(eye, wanted, atol=1e-6)
    shown(result.path, **frames[0])


@pytest.mark.parametrize(
    "names, options, said",
    [
        ([], {}, "a scene needs a field"),
        (["nowhere.ply"], {}, "there is no file"),
        (["room.xml", "mesh.ply"], {}, "are both environments"),
        (["rays.npz"], {"environment": "hit"}, 'there is no file "hit"'),
        (["mesh.ply"], {"environment": "hits"}, "already an environment"),
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
        write_scene([folder / name for name in names], tmp_path / "a.xml", **options)
    assert not (tmp_path / "a.xml").exists()


def test_a_gaze_field_alone_needs_an_observer(rgb, folder, tmp_path):
    gaze = trained(folder, "of_nothing.safetensors", {"geometry": "none"})
    with pytest.raises(NergError, check=mentions("observer")):
        write_scene([gaze], tmp_path / "a.xml")
    result = write_scene([gaze], tmp_path / "a.xml", observer=(0.1, 0, 0))
    _, image = shown(result.path)
    assert image.mask.all() and image.aovs["gaze"].max() > 0 and len(np.unique(image.color.round(3))) > 1


# ---- Rays of a file and of a dataset in a scene ----


@pytest.fixture
def parquet():
    pytest.importorskip("pyarrow", reason="datasets need the extra parquet")


def test_a_sample_of_a_dataset_is_stored_next_to_the_scene(parquet, rgb, tmp_path, monkeypatch):
    """All rays of a participant are read for the eye position, since a sample would miss most times."""
    _, rays = write_dataset(tmp_path)
    written, recorder = tmp_path / "a.rays.npz", Recorder()
    made = write_scene(tmp_path / "shop.rays", tmp_path / "a.xml", environment="none", progress=recorder)
    assert made.files == (tmp_path / "a.xml", written)
    assert_same(Rays.load(written), rays)
    assert any(f"{len(rays):,} rays" in line for line in recorder.messages)
    monkeypatch.setattr(scene_file, "MAX_SCENE_RAYS", 100)
    moment = {"person": "p1_0", "time": float(rays.t[rays.person == rays.persons.index("p1_0")][-1])}
    made = write_scene(tmp_path / "shop.rays", tmp_path / "a.xml", environment="none", **moment)
    assert len(Rays.load(written)) == 100
    last = rays.origin[rays.person == rays.persons.index("p1_0")][-1]
    np.testing.assert_allclose(made.observer.origin, last, atol=1e-5)


def test_a_scene_is_written_from_a_dataset(parquet, rgb, tmp_path):
    """The dataset can also be named by a path in it; the scene renders, and contains a participant."""
    write_dataset(tmp_path)
    made = write_scene(
        [tmp_path / "shop.rays" / "place=shop"],
        tmp_path / "a.xml",
        person="p2_1",
        time=DAY + 2 * 43_200 + 3.0,
        environment="none",
    )
    assert made.quantity == "kde" and tmp_path / "a.rays.npz" in made.files
    assert made.observer is not None and load_scene(made.path, {"spp": "1"}).sensors()
    with pytest.raises(NergError, match="Eve"):
        write_scene([tmp_path / "shop.rays"], tmp_path / "b.xml", person="Eve", time=1.0)


def test_a_folder_with_the_output_name_is_refused(parquet, rgb, tmp_path):
    write_dataset(tmp_path, files=1)
    (tmp_path / "a.rays.npz").mkdir()
    with pytest.raises(NergError, match=r"a\.rays\.npz"):
        write_scene(tmp_path / "shop.rays", tmp_path / "a.xml")


# ---- Scenes in memory ----


def objects_in_memory():
    """Environments that have no file, of each kind."""
    room = trimesh.creation.box((4, 4, 4))
    cube = {"type": "cube", "to_world": rgb_scale(2), "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
    density = np.pad(np.zeros((6, 6, 6)), 1, constant_values=9)
    shell = DensityGrid(density, (-2, -2, -2), (2, 2, 2), np.full((*density.shape, 3), 0.4))
    config = RadianceConfig(fields.GRID, width=16, geometry=3, sh_degree=2, density_scale=6.0)
    field = RadianceNetwork.random(config, Box((-2, -2, -2), (2, 2, 2)), _ns(), march_step=0.1)
    return {
        "mesh": room,
        "meshes": trimesh.Scene(
            [room, trimesh.creation.box((1, 1, 1), trimesh.transformations.translation_matrix((1, 1, -1)))]
        ),
        "scene": {"type": "scene", "cube": cube},
        "nerg": make_scene(shell, headlight=0.3, camera=Camera((0, 0, 0), (1, 0, 0), width=9, height=6)),
        "grid": shell,
        "field": RadianceField(field),
        "splats": Splats(
            fibonacci_directions(500) * 2, [[0.1] * 3] * 500, [[1, 0, 0, 0]] * 500, [0.99] * 500, np.ones((500, 1, 3))
        ),
        "hits": make_hit_geometry(rays(), 0.1),
    }


def rgb_scale(factor):
    import mitsuba as mi

    return mi.ScalarTransform4f().scale(factor)


@pytest.mark.parametrize("kind", ["mesh", "meshes", "scene", "nerg", "grid", "field", "splats", "hits"])
def test_a_scene_in_memory_shows_what_its_file_shows(rgb, folder, tmp_path, kind):
    environment, eye = objects_in_memory()[kind], (0.3, 0.2, 0.1)
    inputs = [environment, GazeField.load(folder / "gaze.safetensors")]
    before = set(tmp_path.iterdir())
    placed = place_scene(open_shown(inputs), ObserverChoice(eye), CameraChoice((0, 0, 0.5), (2, 0.1, 0)), width=18)
    scene = placed.load(**SMALL)
    assert set(tmp_path.iterdir()) == before
    written = write_scene(inputs, tmp_path / "a.xml", observer=eye, camera=(0, 0, 0.5), target=(2, 0.1, 0), width=18)
    for number in range(3):
        _, image = shown(written.path, number)
        memory = render_channels(scene, scene.sensors()[number])
        assert image.mask.any()
        np.testing.assert_allclose(memory.color, image.color, atol=1e-3)
        for name, values in image.aovs.items():
            np.testing.assert_allclose(memory.aovs[name], values, atol=1e-3, err_msg=name)


def test_rays_in_memory_are_shown_in_memory(rgb, folder, tmp_path):
    at = {"align": np.diag([2.0, 2, 2, 1])}
    placed = place_scene(open_shown([folder / "mesh.ply", rays()], **at), ObserverChoice(None), CameraChoice(None), 18)
    scene = placed.load(**SMALL)
    written = write_scene([folder / "mesh.ply", rays()], tmp_path / "a.xml", **at, width=18)
    assert [file.name for file in written.files] == ["a.xml", "a.rays.npz"]
    np.testing.assert_allclose(placed.text.camera.origin, written.camera.origin)
    memory = render_channels(scene, scene.sensors()[1]).aovs["kde"]
    np.testing.assert_allclose(memory, shown(written.path, 1)[1].aovs["kde"], rtol=1e-4)


# ---- Gaze and its environment ----


@pytest.mark.parametrize("environment", ["hits", "none"])
def test_a_gaze_field_is_not_shown_in_another_kind_of_environment(rgb, folder, tmp_path, environment):
    gaze = trained(folder, "of_field.safetensors", Environment.open(folder / "field.safetensors").metadata)
    with pytest.raises(NergError, match="is evaluated there; leave out environment"):
        write_scene([gaze, folder / "rays.npz"], tmp_path / "a.xml", environment=environment)


def test_a_gaze_field_without_geometry_is_doubtful_in_one(rgb, folder, tmp_path):
    gaze, recorder = trained(folder, "of_nothing.safetensors", {"geometry": "none"}), Recorder()
    write_scene([gaze, folder / "mesh.ply"], tmp_path / "a.xml", observer=(0.1, 0, 0), progress=recorder)
    assert any("without geometry" in line for line in recorder.warnings)


def test_rays_without_hit_points_have_no_geometry(rgb, folder, tmp_path):
    replace(rays(), hit=None).save(tmp_path / "rays.npz")
    assert write_scene(tmp_path / "rays.npz", tmp_path / "a.xml").environment.kind == "none"
