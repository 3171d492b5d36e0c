"""Environments, areas and results in memory: no file of the user is needed, and what is saved is complete."""

from __future__ import annotations

import inspect
import json
import re
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import matplotlib.figure
import numpy as np
import pytest
import trimesh

import nerg_mi as nerg
from nerg_mi.environment.scene_loading import list_scene_files, load_scene
from nerg_mi.errors import parameter
from nerg_mi.fields.splats import Splats
from nerg_mi.progress import SilentReporter, open_reporter
from nerg_mi.tasks.settings import Parallel
from nerg_mi.viewer.source import open_viewer_inputs
from tests.conftest import ROOT

QUICK = {"recipe": "small", "steps": 2, "probes": 8, "directions": 64, "min_rays": 8, "validation_zones": 0}
EYE = (2.0, 2.0, 1.6)


def make_room():
    return trimesh.creation.box((6, 4, 3)).apply_translation((3, 2, 1.5))


def make_grid():
    """The room as a density grid, whose cells are 0.1 m large."""
    wall = np.zeros((32, 42, 62), np.float32)
    wall[[0, -1]] = wall[:, [0, -1]] = wall[:, :, [0, -1]] = 200.0
    return nerg.DensityGrid(wall, (-0.1, -0.1, -0.1), (6.1, 4.1, 3.1))


def make_splats():
    """The room as Gaussians on a lattice of its surface."""
    points, _ = trimesh.sample.sample_surface_even(make_room(), 6000, seed=0)
    n = len(points)
    rotations = np.tile([1.0, 0, 0, 0], (n, 1))
    return Splats(points, np.full((n, 3), 0.08), rotations, np.full(n, 0.99), np.zeros((n, 1, 3)))


@pytest.fixture(scope="module")
def room(rgb_module):
    poster = trimesh.creation.box((0.05, 1.2, 0.8)).apply_translation((5.95, 2, 1.5))
    poster.visual.vertex_colors = [255, 0, 0, 255]
    return trimesh.Scene({"room": make_room(), "poster": poster})


@pytest.fixture(scope="module")
def rgb_module():
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    return mi


@pytest.fixture(scope="module")
def rays():
    rng = np.random.default_rng(0)
    eyes = rng.uniform((1, 1, 1.5), (3, 3, 1.7), (600, 3))
    names = np.array(list("abcd"))[np.arange(600) % 4]
    seen = rng.uniform((0, 0, 0), (6, 4, 3), (600, 3))
    return nerg.Rays.from_arrays(eyes, seen - eyes, times=np.arange(600) / 30, participants=names)


@pytest.fixture(scope="module")
def gaze(room, rays):
    return nerg.train_gaze(rays, room, **QUICK)


# ---- Environments ----


def depths(scene):
    directions = [(1, 0, 0), (0, 1, 0), (0, 0, -1), (1, 0.1, -0.05)]
    return nerg.trace(scene, EYE, directions, "depth").depth


@pytest.mark.parametrize("in_memory", ["trimesh", "mitsuba"])
def test_meshes_of_a_saved_scene_are_in_one_folder(rgb, tmp_path, in_memory):
    nodes = {f"wall {k}/{k % 2}": trimesh.creation.box((1, 1, 1)).apply_translation((2 * k, 0, 0)) for k in range(12)}
    room = trimesh.Scene(nodes)
    shapes = room if in_memory == "trimesh" else nerg.make_scene(shapes=room).mitsuba
    saved = nerg.make_scene(shapes=shapes).save(tmp_path / "room.v2.xml")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["room.v2.meshes", "room.v2.xml"]
    assert len(list((tmp_path / "room.v2.meshes").iterdir())) == len(nodes)
    # Both together can be moved.
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in ("room.v2.xml", "room.v2.meshes"):
        (tmp_path / name).rename(moved / name)
    again = {shape.id(): shape.bbox() for shape in nerg.Scene.load(moved / saved.name).mitsuba.shapes()}
    assert set(again) == set(nodes)
    for name, mesh in nodes.items():
        np.testing.assert_allclose(np.array(again[name].min), mesh.bounds[0], atol=1e-6)


def test_geometry_of_a_training_is_one_file_and_one_folder(rgb, tmp_path):
    nodes = {f"wall {k}": trimesh.creation.box((4, 1, 4)).apply_translation((0, 3 + k, 0)) for k in range(7)}
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(300, 3)) + (0, 3, 0)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rays = nerg.Rays.from_arrays(origins=rng.normal(size=(300, 3)) * 0.1, directions=directions, times=np.arange(300.0))
    nerg.train_gaze(rays, trimesh.Scene(nodes), output=tmp_path / "gaze.safetensors", **QUICK)
    made = [p for p in tmp_path.iterdir() if ".environment." in p.name]
    assert sorted(p.suffix for p in made) == [".meshes", ".xml"]
    assert len(list(next(p for p in made if p.suffix == ".meshes").iterdir())) == len(nodes)
    assert len(load_scene(next(p for p in made if p.suffix == ".xml"), merge=False).shapes()) == len(nodes)


def test_meshes_are_shapes_with_names_and_colours(room):
    scene = nerg.make_scene(room)
    assert {shape.id() for shape in scene.mitsuba.shapes()} == {"room", "poster"}
    np.testing.assert_allclose(depths(scene)[:3], [3.925, 2, 1.6], atol=1e-4)
    color = nerg.trace(scene, EYE, [(1, 0, 0), (-1, 0, 0)], "color").color
    assert color[0, 0] > 10 * color[0, 1] + 0.1 and np.isclose(color[1, 0], color[1, 1])


class Impatient(SilentReporter):
    """A reporter that presses Ctrl-C at the first step of a fit."""

    def progress(self, fraction, text=""):
        if "step" in text:
            signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("has_output", [False, True])
def test_ctrl_c_ends_a_loop_over_trainings(rays, tmp_path, has_output):
    """The first training raises, also without an output; the exception has the field so far."""
    fields, output = [], tmp_path / "gaze.safetensors" if has_output else None
    options = {**QUICK, "steps": 50, "output": output, "progress": Impatient()}
    with pytest.raises(KeyboardInterrupt) as end:
        for seed in range(3):
            fields.append(nerg.train_gaze(rays, make_room(), seed=seed, **options))
    assert not fields
    field = end.value.field
    assert 0 < field.provenance["steps"] < 50 and field.provenance["interrupted"]
    assert np.isfinite(field.density(EYE, [(1, 0, 0)])).all()
    if has_output:
        assert nerg.GazeField.load(output).provenance["steps"] == field.provenance["steps"]
        assert field.path == output and len(list(tmp_path.iterdir())) > 2  # The environment, too


@pytest.mark.parametrize(
    "kind", ["mesh", "grid", *(pytest.param(k, marks=pytest.mark.nightly) for k in ("dict", "scene", "mitsuba"))]
)
def test_environments_train_alike_in_memory_and_saved(rgb_module, rays, tmp_path, kind):
    environment = {
        "mesh": make_room,
        "dict": lambda: {"type": "scene", "wall": {"type": "sphere", "center": [3, 2, 1.5], "radius": 3.8}},
        "scene": lambda: nerg.make_scene(make_room()),
        "grid": make_grid,
        "mitsuba": lambda: nerg.make_scene(make_room()).mitsuba,
    }[kind]()
    gaze = nerg.train_gaze(rays, environment, **QUICK, output=tmp_path / "gaze.safetensors")
    directions = [(1, 0, 0), (0, 1, 0.2)]
    expected = gaze.density(EYE, directions)
    if kind == "mesh":
        # In another process, from what is in the folder.
        code = f"import nerg_mi as nerg; g = nerg.GazeField.load({str(tmp_path / 'gaze.safetensors')!r}); "
        code += f"print(g.density({EYE}, {directions}).tolist())"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        np.testing.assert_allclose(json.loads(done.stdout), expected, rtol=1e-4, err_msg=done.stderr)
    else:
        loaded = nerg.GazeField.load(tmp_path / "gaze.safetensors")
        np.testing.assert_allclose(loaded.density(EYE, directions), expected, rtol=1e-4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the same environment again has the same checksum
        np.testing.assert_allclose(gaze.density(EYE, directions, environment=environment), expected, rtol=1e-4)


def test_a_saved_scene_is_the_scene(room, gaze, tmp_path):
    camera = nerg.Camera((1, 1, 2), (5.9, 2, 1.5), fov=80, width=12, height=8)
    scene = nerg.make_scene(room, gaze, camera=camera, observer=EYE, falloff=0.3)
    again = nerg.Scene.load(scene.save(tmp_path / "room.xml"))
    for name in ("gaze", "depth", "color"):
        one, other = (nerg.render(s, quantities=name, spp=2)[name] for s in (scene, again))
        np.testing.assert_array_equal(one, other, err_msg=name)
    assert repr(again).splitlines()[1:] == repr(scene).replace("in memory", "room.gaze.safetensors").splitlines()[1:]
    copied = nerg.Scene.load(again.save(tmp_path / "copy.xml"))
    np.testing.assert_array_equal(depths(copied), depths(scene))
    with_values = nerg.Scene.load(nerg_store() / "scene.xml", width=24, height=16)
    width, _ = nerg.Scene.load(with_values.save(tmp_path / "store.xml")).mitsuba.sensors()[0].film().crop_size()
    assert width == 24


# ---- Exports to other programs ----


@pytest.fixture
def written(monkeypatch):
    """Contents of exported scenes, which are not written, since that needs optional libraries."""
    contents = []
    write = lambda scene, path: path.write_bytes(b"") or contents.append(scene)
    monkeypatch.setattr("nerg_mi.interop.scenes.write_exchange", write)
    monkeypatch.setattr("nerg_mi.formats.exchange.import_extra", lambda *arguments: None)
    return contents


def test_scenes_with_gaze_are_exported(room, gaze, rays, tmp_path, written):
    camera = nerg.Camera((1, 1, 2), (5.9, 2, 1.5), fov=80, width=12, height=8)
    scene = nerg.make_scene(room, gaze, camera=camera, observer=EYE)
    made = nerg.export_scene([scene, rays], tmp_path / "a.rrd", width=64, spp=16, max_points=500)
    (content,) = written
    assert made.scene is content and made.output == tmp_path / "a.rrd"
    meshes = {mesh.name: mesh for mesh in content.meshes}
    assert meshes.keys() == {"room", "poster", "observer"}
    np.testing.assert_allclose(np.ptp(meshes["room"].vertices, axis=0), (6, 4, 3), atol=1e-5)
    directions = (meshes["observer"].vertices - EYE) / 0.15
    density = gaze.density(EYE, directions)
    assert np.corrcoef(meshes["observer"].values, density)[0, 1] > 0.99
    np.testing.assert_allclose(meshes["observer"].values.mean(), density.mean(), rtol=0.02)
    (points,) = content.points
    assert len(points.positions) == 500 and points.label.startswith("gaze")
    (shown,) = content.cameras
    assert shown.fov == pytest.approx(80) and np.allclose(shown.to_world[:3, 3], (1, 1, 2), atol=1e-6)
    assert [r.participant for r in content.rays] == list("abcd") and sum(len(r.times) for r in content.rays) == 600
    # The observer is the camera if there is no other, and one of them is needed.
    seen_by_camera = nerg.make_scene(room, gaze, camera=camera)
    content = nerg.export_scene(seen_by_camera, tmp_path / "a.rrd", width=64, spp=1).scene
    sphere = next(mesh for mesh in content.meshes if mesh.name == "observer")
    np.testing.assert_allclose(sphere.vertices.min(axis=0)[2], 2 - 0.15, atol=2e-3)
    with pytest.raises(nerg.NergError, match="observer"):
        nerg.export_scene(nerg.make_scene(room, gaze), tmp_path / "a.rrd")


@pytest.mark.parametrize("kind", ["mesh", "meshes", "mitsuba", "dict", "splats", "field", "file"])
def test_environments_are_exported(room, tmp_path, written, kind):
    splats = Splats(*(np.ones((3, n)) for n in (3, 3, 4)), np.ones(3), np.zeros((3, 1, 3)))
    environment = {
        "mesh": make_room,
        "meshes": lambda: room,
        "mitsuba": lambda: nerg.make_scene(room).mitsuba,
        "dict": lambda: {"type": "scene", "integrator": {"type": "path"}, "wall": {"type": "cube"}},
        "splats": lambda: splats,
        "field": lambda: nerg.RadianceField.load(nerg_store() / "store.safetensors"),
        "file": lambda: Path(make_room().export(tmp_path / "room.ply") and tmp_path / "room.ply"),
    }[kind]()
    nerg.export_scene([environment], tmp_path / "a.usdc", max_points=100)
    (content,) = written
    if kind == "splats":
        np.testing.assert_array_equal(content.splats.centers, splats.centers)
    elif kind == "field":
        (points,) = content.points
        assert 0 < len(points.positions) <= 100
    else:
        assert len(content.meshes) == (2 if kind in ("meshes", "mitsuba") else 1)
        extents = np.array([np.ptp(mesh.vertices, axis=0) for mesh in content.meshes])
        np.testing.assert_allclose(extents.max(axis=0), (2, 2, 2) if kind == "dict" else (6, 4, 3), atol=1e-5)


def test_what_cannot_be_exported_is_reported(rgb_module, gaze, tmp_path, monkeypatch):
    pytest.importorskip("pxr.Usd", reason="usd-core, of the extra usd, is not installed")
    grid = nerg.DensityGrid(np.ones((2, 2, 2)), (0, 0, 0), (1, 1, 1))
    with pytest.raises(nerg.NergError, match="nothing"), pytest.warns(UserWarning, match='"density"'):
        nerg.export_scene(nerg.make_scene(grid), tmp_path / "a.usdc")
    with pytest.raises(nerg.NergError, match="DensityGrid in memory"):
        nerg.export_scene(grid, tmp_path / "a.usdc")
    with pytest.raises(nerg.NergError, match="write_scene"):
        nerg.export_scene(gaze, tmp_path / "a.usdc")
    with pytest.raises(nerg.NergError, match=r"\.rrd"):
        nerg.export_scene(make_room(), tmp_path / "a.fbx")
    with pytest.raises(nerg.NergError, match="inputs.*int"):
        nerg.export_scene([make_room(), 3], tmp_path / "a.usdc")
    for suffix, module in ((".usda", "pxr.Usd"), (".rrd", "rerun")):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(ImportError, match="nerg-mi"):
            nerg.export_scene(make_room(), tmp_path / f"a{suffix}")
    assert not [file for file in tmp_path.iterdir() if file.name.startswith("a.")]


def nerg_store():
    from importlib.resources import files

    return files("nerg_mi.scenes.store")


ENVIRONMENTS = {
    "grid": make_grid,
    "mesh": make_room,
    "splats": make_splats,
    "mitsuba": lambda: nerg.make_scene(make_room()).mitsuba,
    "scene": lambda: nerg.make_scene(make_grid()),
}
QUICK_KINDS = ("grid", "mesh")


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=[pytest.mark.nightly] * (k not in QUICK_KINDS)) for k in ENVIRONMENTS]
)
def test_environments_are_shown(rgb_module, rays, tmp_path, kind):
    """Scene files, reports and the viewer of each kind of environment, with and without gaze."""
    environment = ENVIRONMENTS[kind]()
    gaze = nerg.train_gaze(rays, environment, **QUICK, output=tmp_path / "gaze.safetensors")
    path = tmp_path / "out" / "room.xml"
    path.parent.mkdir()
    written = nerg.write_scene([environment, gaze, rays], path, width=24).load()
    np.testing.assert_allclose(depths(written)[:3], [4, 2, 1.6], atol=0.15)
    assert written.has_gaze and len(written.mitsuba.sensors()) == 3
    # The scene is complete in its folder.
    assert all(path.parent in file.parents for file in list_scene_files(path))
    plain = nerg.write_scene(environment, tmp_path / "plain.xml", observer=EYE, width=24).load()
    np.testing.assert_allclose(depths(plain), depths(written), atol=1e-4)
    if kind in ("grid", "scene"):
        # Without the objects, from the files of the training.
        report = nerg.report(tmp_path / "gaze.safetensors", width=24, spp=1, viewpoints=1)
        assert "density" in written.integrator.children and len(report.html) > 10_000
    shown = open_viewer_inputs([environment, gaze]).load("")
    np.testing.assert_allclose(depths(shown), depths(written), atol=1e-4)


def test_recordings_are_aligned_with_a_grid(rgb_module):
    rng = np.random.default_rng(0)
    eyes, seen = rng.uniform((1, 1, 1.5), (5, 3, 1.7), (1500, 3)), rng.uniform((0, 0, 0), (6, 4, 3), (1500, 3))
    axis = rng.integers(0, 3, 1500)
    seen[np.arange(1500), axis] = np.array([6, 4, 3])[axis] * rng.integers(0, 2, 1500)
    names = np.array(list("abcd"))[np.arange(1500) % 4]
    shift = np.array([0.3, -0.2, 0])
    moved = nerg.Rays.from_arrays(
        eyes + shift, seen - eyes, times=np.arange(1500) / 30, participants=names, hits=seen + shift
    )
    alignment = nerg.align(moved, make_grid(), turn=0, scale=1)
    np.testing.assert_allclose(alignment.matrix[:3, 3], -shift, atol=0.06)


def test_objects_are_exported_under_readable_names(rgb_module, room, rays, gaze, tmp_path, written):
    make_room().export(tmp_path / "kitchen.ply")
    both = [make_room(), trimesh.creation.box((1, 2, 3)), tmp_path / "kitchen.ply"]
    made = nerg.export_scene([*both, rays, rays[:300], rays[300:]], tmp_path / "a.usdc").scene
    assert [mesh.name for mesh in made.meshes] == ["environment", "environment_2", "kitchen"]
    names = [r.participant for r in made.rays]
    assert len(set(names)) == len(names) == 12 and not re.search("[0-9a-f]{12}", " ".join(names))


@pytest.mark.parametrize("inputs", ["environment", "gaze", "both"])
def test_grids_are_viewed(rgb_module, rays, inputs):
    pytest.importorskip("viser", reason="viser, of the extra viewer, is not installed")
    grid = make_grid()
    gaze = None if inputs == "environment" else nerg.train_gaze(rays, grid, **QUICK)
    with nerg.view({"environment": grid, "gaze": gaze, "both": [grid, gaze, rays]}[inputs], port=0) as viewer:
        assert viewer.address.startswith("http://127.0.0.1")


def test_scenes_with_gaze_are_viewed_from_their_camera(gaze, room):
    pytest.importorskip("viser", reason="viser, of the extra viewer, is not installed")
    with pytest.raises(nerg.NergError, match="camera"):
        nerg.view(nerg.make_scene(room, gaze), port=0)


def test_scenes_that_show_gaze_are_not_environments_alone(gaze, room, rays, tmp_path):
    camera = nerg.Camera((1, 1, 2), (5.9, 2, 1.5), width=12, height=8)
    scene = nerg.make_scene(room, gaze, camera=camera, observer=EYE, falloff=0.3)
    for inputs in (scene, [scene, rays]):
        with pytest.raises(nerg.NergError, match='"gaze"'):
            nerg.write_scene(inputs, tmp_path / "a.xml")
    other, recorder = nerg.train_gaze(rays, room, **{**QUICK, "steps": 3}), Recorder()
    again = nerg.write_scene([scene, other], tmp_path / "a.xml", observer=EYE, width=24, progress=recorder).load()
    assert any({"gaze", "observer", "falloff"} <= set(re.findall(r"\w+", line)) for line in recorder.lines)
    ahead = [(1, 0, 0), (0, 1, 0)]
    shown = nerg.trace(again, EYE, ahead, "gaze").gaze
    np.testing.assert_allclose(shown, other.density(EYE, ahead), rtol=0.01)
    assert not np.allclose(shown, gaze.density(EYE, ahead), rtol=0.01)


@pytest.mark.parametrize("kind", ["meshes", pytest.param("grid", marks=pytest.mark.nightly)])
def test_gaze_is_shown_in_a_scene(gaze, rays, room, tmp_path, kind):
    """What is not replaced is kept, and the result can be saved like any scene."""
    camera = nerg.Camera((1, 1, 2), (5.9, 2, 1.5), width=12, height=8)
    plain = nerg.make_scene(room if kind == "meshes" else make_grid(), camera=camera, falloff=0.3)
    directly = nerg.make_scene(room if kind == "meshes" else make_grid(), gaze, camera=camera, falloff=0.3)
    shown = nerg.make_scene(plain, gaze)
    assert not plain.has_gaze and shown.default_quantities == directly.default_quantities
    for name in ("color", "gaze"):
        expected = nerg.render(directly, quantities=name, spp=2)[name]
        for scene in (shown, nerg.Scene.load(shown.save(tmp_path / "a.xml"))):
            np.testing.assert_allclose(nerg.render(scene, quantities=name, spp=2)[name], expected, rtol=1e-5)
    other = nerg.train_gaze(rays, room, **{**QUICK, "steps": 3})
    again = nerg.make_scene(shown, other, observer=EYE, camera=nerg.Camera((2, 2, 2), (5, 2, 1), width=6, height=4))
    np.testing.assert_allclose(nerg.trace(again, EYE, [(1, 0, 0)], "gaze").gaze, other.density(EYE, [(1, 0, 0)]), 0.01)
    assert len(again.mitsuba.sensors()) == 1 and nerg.render(again, spp=1).color.shape[-3:-1] == (4, 6)
    np.testing.assert_allclose(again.observer, EYE)
    box = {"type": "cube"}
    with_box = nerg.make_scene(shown, shapes=box)
    assert len(with_box.mitsuba.shapes()) == len(shown.mitsuba.shapes()) + 1 and with_box.has_gaze
    # A name that is taken gets a number.
    assert len(nerg.make_scene(with_box, shapes=box).mitsuba.shapes()) == len(with_box.mitsuba.shapes()) + 1


def test_scenes_that_were_loaded_give_their_shapes(gaze, room, tmp_path):
    path = nerg.make_scene(room, gaze, observer=EYE).save(tmp_path / "a.xml")
    for environment in (path, nerg.Scene.load(path), nerg.Scene.load(path).mitsuba):
        scene = nerg.make_scene(environment, gaze)
        np.testing.assert_allclose(depths(scene)[:3], [3.925, 2, 1.6], atol=1e-4)
    store = nerg_store() / "scene.xml"
    for environment in (store, nerg.Scene.load(store), nerg.Scene.load(store).mitsuba):
        with pytest.raises(nerg.NergError, match="write_scene"):
            nerg.make_scene(environment, gaze)


def test_lights_of_mitsuba_scenes_are_left_out_with_a_warning(rgb_module, tmp_path):
    light = {"type": "point", "position": [3, 2, 2], "intensity": 5.0}
    content = {"type": "scene", "light": light, "box": {"type": "cube"}}
    with pytest.warns(UserWarning, match="lights"):
        scene = nerg.write_scene(rgb_module.load_dict(content), tmp_path / "a.xml", observer=(0, 0, 0), width=24).load()
    assert len(scene.mitsuba.shapes()) == 1 and not scene.mitsuba.emitters()
    from_dict = nerg.write_scene(content, tmp_path / "b.xml", observer=(0, 0, 0), width=24).load()
    assert len(from_dict.mitsuba.emitters()) == 1


def test_grids_are_refused_if_they_are_wrong():
    for changes, name in (
        ({"density": np.ones((2, 2))}, "density"),
        ({"density": -np.ones((2, 2, 2))}, "density"),
        ({"lower": (1, 0, 0)}, "lower"),
        ({"color": np.ones((2, 2, 2))}, "color"),
        ({"density": np.full((2, 2, 2), np.nan)}, "density"),
    ):
        values = {"density": np.ones((2, 2, 2)), "lower": (0, 0, 0), "upper": (1, 1, 1), **changes}
        with pytest.raises(nerg.NergError, match=name):
            nerg.DensityGrid(**values)


@pytest.mark.parametrize("matrix", [np.eye(4) + np.eye(4, k=-3), [[1, 0], [0]], np.eye(3), np.diag([1, 2, 1, 1])])
def test_alignments_in_memory_are_checked(rays, room, matrix):
    with pytest.raises(nerg.NergError, match="align"):
        nerg.train_gaze(rays, room, align=matrix)


# ---- Results ----


def test_statistics_of_areas_in_memory(room, rays, gaze):
    poster = room.geometry["poster"]
    areas = {"box": [[5.8, 1.4, 1.1], [6.0, 2.6, 1.9]], "mesh": poster, "shape": {"shape": "poster"}}
    result = nerg.statistics([rays, gaze], areas, resamples=200, viewpoints=4)
    table = result.to_dataframe("aois")
    measured = table[table["source"] == "measured"].set_index("aoi")
    assert len(table) == 6 and (measured["share_low"] <= measured["share"]).all()
    np.testing.assert_allclose(measured.loc["mesh", "share"], measured.loc["shape", "share"])
    assert "share_high" in result._repr_html_() and "aois 6" in repr(result)
    with pytest.raises(nerg.NergError, match='"nothing"'):
        result.to_dataframe("nothing")
    with pytest.raises(nerg.NergError, match='"mesh"'):
        nerg.statistics(rays, {"mesh": room})


def test_statistics_of_objects_in_parts(room, rays, gaze, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    areas = {"box": [[5.8, 1.4, 1.1], [6.0, 2.6, 1.9]], "mesh": room.geometry["poster"], "shape": {"shape": "poster"}}
    options = {"resamples": 199, "viewpoints": 4, "zones": {"west": np.array([[0, 0, 0], [2, 4, 3]])}}
    options |= {"what_if": {"move": [{"shape": "poster", "by": np.array([0, 0.5, 0])}]}, "align": np.eye(4)}
    whole = nerg.statistics([rays, gaze, room], areas, **options)
    parts = nerg.statistics([rays, gaze], areas, parallel=Parallel(store=tmp_path / "store"), **options)
    parts.save(tmp_path / "out")
    assert parts.aois == whole.aois and parts.what_if == whole.what_if and parts.what_if[4]["difference"]
    metadata = json.loads((tmp_path / "out" / "about.json").read_text())
    assert metadata["settings"]["zones"] == {"west": [[0, 0, 0], [2, 4, 3]]}
    with pytest.raises(nerg.NergError, match="not one of move"):
        nerg.statistics([rays, gaze], areas, what_if={"turn": []})


def test_hit_points_need_no_file(rays):
    hits = rays.origin + 1.5 * rays.direction
    with_hits = nerg.Rays.from_arrays(rays.origin, rays.direction, times=rays.t, hits=hits)
    gaze = nerg.train_gaze(with_hits, "hits", **QUICK)
    assert gaze.density(EYE, (1, 0, 0)).shape == (1,) and gaze.environment.path is None


def test_fields_are_densities(gaze, rays):
    drawn = gaze.sample(EYE, 4000, seed=1)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1, atol=1e-6)
    regions = gaze.regions(EYE, levels=(0.25, 0.5, 1.0))
    share = regions.density[regions.inside[1]].sum() / regions.density.sum()
    assert share == pytest.approx(0.5, abs=1e-3) and regions.solid_angle[2] == pytest.approx(4 * np.pi, rel=1e-3)
    # The share of samples in a region is that of the gaze.
    nearest = (drawn @ regions.directions.T.astype(np.float32)).argmax(axis=1)
    assert regions.inside[1][nearest].mean() == pytest.approx(0.5, abs=0.04)
    some = rays[:20]
    density = gaze.density(some.origin, some.direction)
    assert gaze.score(some) == pytest.approx(np.log(density).mean(), abs=1e-6)
    np.testing.assert_allclose(gaze.score_samples(some), np.log(density), atol=1e-6)
    for call in (lambda: gaze.sample([EYE, EYE], 3), lambda: gaze.regions(EYE, [2.0]), lambda: gaze.score(rays[[]])):
        with pytest.raises(nerg.NergError):
            call()


def test_pictures_are_labelled_arrays_and_figures(room, gaze):
    xarray = pytest.importorskip("xarray")
    camera = nerg.Camera((1, 1, 2), (5.9, 2, 1.5), fov=80, width=12, height=8)
    scene = nerg.make_scene(room, gaze, camera=camera)
    quantities = ["color", "opacity", "gaze", "position"]
    pictures = nerg.render(scene, [EYE, (1, 1, 1.6)], quantities, spp=1)
    data = pictures.to_xarray()
    assert isinstance(data, xarray.Dataset) and data.gaze.dims == ("observer", "row", "column")
    assert data.gaze.attrs["units"] == "1/sr" and data.color.sel(channel="R").dims == data.gaze.dims
    assert data.position.sel(axis="z").shape == (2, 8, 12)
    np.testing.assert_allclose(data.observer_position.sel(observer=1), (1, 1, 1.6))
    assert np.array_equal(data.gaze.isel(observer=1), pictures.gaze[1])
    html = pictures._repr_html_()
    assert html is not None and "data:image/png" in html
    assert len(scene.show(spp=1).axes) == 2 and len(pictures.plot("color").axes) >= 1
    figure = matplotlib.figure.Figure()
    first, second, third = figure.subplots(1, 3)
    for name, axes in (("color", first), ("gaze", second)):
        assert pictures.plot(name, axes=axes) is figure and axes.get_images(), name
    assert scene.show("depth", axes=third, spp=1) is figure and third.get_images()
    with pytest.raises(nerg.NergError, match='"depth"'):
        pictures.plot("depth")
    empty = figure.add_subplot()
    for name, observer in (("depth", 0), ("gaze", 2), ("position", 0)):
        with pytest.raises(nerg.NergError):
            pictures.plot(name, observer, axes=empty)
    assert not empty.get_images(), "nothing is drawn before a request is refused"
    # Every result can be drawn, also without colour or opacity.
    for quantities in ("gaze", "color", "depth", ["position", "depth"], ["visibility", "opacity"]):
        drawn = nerg.render(scene, EYE, quantities, spp=1).plot()
        assert any(axes.get_images() for axes in drawn.axes), quantities
    rays = nerg.trace(scene, EYE, [(1, 0, 0)]).to_xarray()
    assert rays.depth.dims == ("ray",)


# ---- Messages ----


def test_tables_in_place_of_rays_are_refused_with_the_way_to_rays(gaze, room):
    table = pytest.importorskip("pandas").DataFrame({"x": [0.0], "y": [0.0]})
    calls = [
        lambda: nerg.train_gaze(table, room),
        lambda: nerg.statistics([table, gaze], {"a": [[0, 0, 0], [1, 1, 1]]}),
        lambda: nerg.check_rays(table),
        lambda: gaze.score(table),
        lambda: gaze.score_samples(table),
    ]
    for call in calls:
        with pytest.raises(nerg.NergError, match=r"Rays\.from_dataframe"):
            call()
    with pytest.raises(nerg.NergError, match="columns="):
        nerg.Rays.from_dataframe(table)


@pytest.mark.parametrize("name", [n for n in nerg.__all__ if n.islower() and not n.startswith("register_")])
def test_other_objects_as_the_first_argument_are_refused(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function = getattr(nerg, name)
    parameters = list(inspect.signature(function).parameters.values())[1:]
    required = {p.name: "missing.npz" for p in parameters if p.default is p.empty and p.kind is not p.VAR_KEYWORD}
    for value in (3, object(), pytest.importorskip("pandas").DataFrame({"x": [0.0]})):
        with pytest.raises(nerg.NergError):
            function(value, **required)


def test_objects_in_place_of_outputs_are_refused(gaze, room):
    for call in (lambda: nerg.write_scene(room, gaze), lambda: nerg.export_scene(room, gaze)):
        with pytest.raises(nerg.NergError, match="must be .* got GazeField"):
            call()


def test_gaze_fields_are_not_exported_as_radiance_fields(gaze):
    with pytest.raises(nerg.NergError, match="radiance field is needed"):
        nerg.export_mesh(gaze)


def test_messages_name_objects_in_place_of_their_files(gaze, rays, room, tmp_path):
    for call, name in (
        (lambda: nerg.next_look(gaze, rays), "gaze field"),
        (lambda: nerg.evaluate_gaze(gaze, rays), "gaze field"),
    ):
        with pytest.raises(nerg.NergError, match=f"the {name} in memory"):
            call()
    # Copies of the user are files.
    saved = nerg.train_gaze(rays, room, **QUICK, output=tmp_path / "own.safetensors")
    with pytest.raises(nerg.NergError, match="own.safetensors"):
        nerg.evaluate_gaze(saved, rays)


def test_observers_behind_all_faces_are_reported(gaze):
    scene = nerg.make_scene(make_room(), gaze, observer=EYE)
    with pytest.warns(UserWarning, match="two_sided"):
        assert nerg.attention(scene, "environment").share == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_allclose(nerg.attention(scene, "environment", two_sided=True).share, 1, atol=0.01)


def test_baked_surfaces_are_exported_and_drawn(gaze, tmp_path, written):
    baked = nerg.bake(make_room(), gaze=gaze, observer=EYE, max_edge=1.0)
    (mesh,) = nerg.export_scene(baked, tmp_path / "a.usdc").scene.meshes
    (read,) = nerg.export_scene(baked.save(tmp_path / "b.ply"), tmp_path / "b.usdc").scene.meshes
    assert mesh.name == "surface" and mesh.label == read.label
    for name, error in (("vertices", 1e-6), ("faces", 0), ("values", 1e-6), ("colors", 0.005)):
        np.testing.assert_allclose(getattr(mesh, name), getattr(read, name), rtol=1e-6, atol=error)
    assert len(nerg.draw_surface(baked, width=48).axes) > 0 and len(repr(baked)) < 200
    with pytest.raises(nerg.NergError, match=r"\.glb"):
        baked.save(tmp_path / "b.obj")


def test_rays_of_a_file_are_scored(gaze, rays, tmp_path):
    rays.save(tmp_path / "a.npz")
    assert gaze.score(tmp_path / "a.npz", max_rays=20) == gaze.score(rays, max_rays=20)


def test_corners_of_boxes_have_any_order(rays):
    boxes = {"a": [[5, 1, 1], [7, 3, 2]], "b": [[7, 1, 2], [5, 3, 1]]}
    first, second = nerg.statistics(rays, boxes).aois
    assert first["share"] == second["share"] > 0
    with pytest.raises(nerg.NergError, match="by name"):
        nerg.statistics(rays, list(boxes.values()))


class Recorder:
    def __init__(self):
        self.lines = []

    def message(self, text):
        self.lines.append(text)

    def warn(self, text):
        self.lines.append(text)

    def progress(self, fraction, text=""):
        pass


def test_messages_name_arguments():
    recorder, text = Recorder(), f"add {parameter('test_zones', 3)} or {parameter('geometry', 'hits')}"
    with pytest.raises(nerg.NergError) as error, open_reporter(recorder) as reporter:
        reporter.message(text)
        reporter.warn(text)
        raise nerg.NergError(text)
    assert {*recorder.lines, str(error.value)} == {'add test_zones=3 or geometry="hits"'}


def test_warnings_are_those_of_python_at_the_caller():
    with pytest.warns(UserWarning, match="test_zones") as caught, open_reporter(None) as reporter:
        reporter.warn(f"few {parameter('test_zones')}")
    assert caught[0].filename == __file__
    with pytest.raises(nerg.NergError, match="progress"), open_reporter("yes"):
        pass
