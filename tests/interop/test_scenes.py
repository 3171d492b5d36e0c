"""Scenes exported with their gaze: contents of each kind of file."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh
from nerg_mi.scenes.store import SCENE_FILE

from nerg_mi.aoi.bids import export_rays
from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.formats.exchange import ExchangeScene
from nerg_mi.formats.fields import load_radiance
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.surfaces import extract_points
from nerg_mi.interop import scenes as module
from nerg_mi.interop.scenes import export_scene
from nerg_mi.maths.color import decode_srgb
from nerg_mi.tracking.event_settings import FIXATIONS, EventRules
from nerg_mi.tracking.rays import Rays
from tests.recorder import Recorder
from tests.refusals import mentions

SENSOR = """<sensor type="perspective" id="view"><float name="fov" value="70"/>
    <transform name="to_world"><lookat origin="0.5, 0, 0" target="1, 0, 0" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="8"/></film></sensor>"""
SCENE = f"""<scene version="3.0.0"><integrator type="nerg">
    <volume type="gazekde" name="kde"><string name="filename" value="rays.npz"/></volume></integrator>
    {SENSOR}<shape type="ply" id="room"><string name="filename" value="room.ply"/></shape>
    <shape type="sphere" id="ball"><float name="radius" value="0.1"/></shape></scene>"""


def rays():
    """Ada looks at (2, 0, 0) for a second, then at (0, 2, 0); Bob sees one sample."""
    n = 60
    targets = np.repeat([[2.0, 0, 0], [0, 2.0, 0]], n // 2, axis=0)
    origins = np.tile([0.5, 0.0, 0.0], (n, 1))
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    person = np.r_[np.zeros(n, int), 1]
    t = np.r_[np.arange(n) / 30 + np.repeat([0.0, 0.5], n // 2), 0.0]
    add = lambda a: np.concatenate([a, a[:1]])
    return Rays(t, person, ("Ada", "Bob"), add(origins), add(directions), np.ones(n + 1), add(targets))


MOVED = '<transform name="to_world"><translate x="10"/></transform>'


@pytest.fixture
def folder(tmp_path):
    rays().save(tmp_path / "rays.npz")
    room = trimesh.creation.box((4, 4, 4))
    room.invert()
    room.export(tmp_path / "room.ply")
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path


def exported(folder, *names, monkeypatch, **options) -> tuple[ExchangeScene, Recorder]:
    recorder, written = Recorder(), []
    monkeypatch.setattr(module, "write_exchange", lambda scene, path: path.write_bytes(b"") or written.append(scene))
    monkeypatch.setattr(module, "check_exchange", lambda path: None)  # libraries may be missing
    files = [folder / name for name in names]
    made = export_scene(files, folder / "out.usdc", **options, progress=recorder)
    assert written == [made.scene]
    return made.scene, recorder


def test_rays_and_fixations_of_each_participant(rgb, folder, monkeypatch):
    scene, recorder = exported(folder, "rays.npz", monkeypatch=monkeypatch)
    assert [r.participant for r in scene.rays] == ["Ada", "Bob"] and len(scene.rays[0].times) == 60
    (fixations,) = scene.fixations
    assert np.allclose(fixations.positions, [[2, 0, 0], [0, 2, 0]], atol=1e-6)
    assert np.allclose(fixations.times, [0, 1.5]) and np.allclose(fixations.durations, 29 / 30)
    assert any("Bob" in line and "no fixation" in line for line in recorder.messages)
    fewer, _ = exported(folder, "rays.npz", monkeypatch=monkeypatch, max_rays=7)
    assert sum(len(r.times) for r in fewer.rays) <= 8 and len(fewer.fixations[0].times) == 2


def test_fixations_are_those_of_other_exports(rgb, folder, monkeypatch):
    """Gaze that rests, jumps and moves at 20 degrees per second, which is a pursuit."""
    angle = np.radians(np.r_[np.zeros(60), 30 + np.arange(60) / 3])
    directions = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    moving = Rays(np.arange(120) / 60, np.zeros(120), ("Ada",), 0 * directions, directions, np.ones(120))
    moving.save(folder / "moving.npz")
    scene, _ = exported(folder, "moving.npz", monkeypatch=monkeypatch)
    counts = export_rays(moving, folder / "bids").events
    (fixations,) = scene.fixations
    assert fixations.kinds.tolist() == ["fixation"] and np.isclose(fixations.durations[0], 1, atol=0.02)
    assert sum(counts.get(kind, 0) for kind in FIXATIONS) == 1 and counts["smooth_pursuit"] == 1
    assert fixations.definition == EventRules().describe()
    # By other rules the pursuit is a fixation, in both.
    rules = EventRules(pursuit_velocity=40.0)
    scene, _ = exported(folder, "moving.npz", monkeypatch=monkeypatch, rules=rules)
    counts = export_rays(moving, folder / "other", rules=rules).events
    (fixations,) = scene.fixations
    assert (
        len(fixations.times) == sum(counts.get(kind, 0) for kind in FIXATIONS) == 2 and "smooth_pursuit" not in counts
    )
    assert fixations.definition == rules.describe()


def test_heads_have_no_fixations_and_are_named(rgb, folder, monkeypatch):
    rays().with_tracking("head").save(folder / "rays.npz")
    scene, recorder = exported(folder, "rays.npz", monkeypatch=monkeypatch)
    assert scene.fixations == () and {r.tracking for r in scene.rays} == {"head"}
    assert scene.rays[0].origin_name == "heads" and any("heads" in line for line in recorder.messages)


@pytest.mark.parametrize("tracking", ["unknown", "eye"])
def test_unknown_tracking_is_reported_once(rgb, folder, monkeypatch, tracking):
    rays().with_tracking(tracking).save(folder / "rays.npz")
    _, recorder = exported(folder, "rays.npz", monkeypatch=monkeypatch)
    assert sum("heads" in line for line in recorder.warnings) == (tracking == "unknown")


def test_a_scene_has_its_meshes_cameras_and_gaze(rgb, folder, monkeypatch):
    options = dict(width=64, spp=2, max_points=500)
    scene, recorder = exported(folder, "scene.xml", monkeypatch=monkeypatch, **options)
    room, sphere = scene.meshes
    assert room.name == "room" and np.isclose(np.abs(room.vertices).max(), 2)
    assert any("not meshes" in line and "ball" in line for line in recorder.warnings)
    (camera,) = scene.cameras
    assert camera.name == "view" and camera.fov == pytest.approx(70) and (camera.width, camera.height) == (12, 8)
    # Right, up and backwards.
    assert np.allclose(camera.to_world[:3], [[0, 0, -1, 0.5], [-1, 0, 0, 0], [0, 1, 0, 0]], atol=1e-6)
    # Gaze on the walls is largest where the participants looked; so it is on the sphere around the observer.
    (points,) = scene.points
    assert len(points.positions) == 500 and points.label.startswith("kde") and points.values.min() >= 0
    top = points.positions[np.argmax(points.values)]
    assert min(np.linalg.norm(top - t) for t in ([2, 0, 0], [0, 2, 0])) < 0.5
    assert np.allclose(np.linalg.norm(sphere.vertices - (0.5, 0, 0), axis=1), 0.15, atol=1e-5)
    direction = (sphere.vertices[np.argmax(sphere.values)] - (0.5, 0, 0)) / 0.15
    assert max(direction @ d for d in rays().direction[[0, -2]]) > 0.95
    # It is not mirrored.
    at = lambda d: sphere.values[np.argmax((sphere.vertices - (0.5, 0, 0)) @ d)]
    assert at(rays().direction[-2]) > 5 * at(rays().direction[-2] * (1, -1, 1))
    assert (decode_srgb(np.ones(3)) >= points.colors).all() and np.ptp(points.colors) > 0.3
    # The triangles face outwards.
    a, b, c = (sphere.vertices[sphere.faces[:, k]] for k in range(3))
    outwards = (np.cross(b - a, c - a) * (a + b + c - 3 * np.array([0.5, 0, 0]))).sum(axis=1)
    assert (outwards > -1e-9).all()


@pytest.mark.slow
def test_a_scene_with_a_radiance_field_has_its_surface_points(rgb, folder, monkeypatch):
    store = SCENE_FILE
    shown = (folder / store.name, folder / "store.safetensors", folder / "shoppers.safetensors")
    for path in shown:
        path.write_bytes((store.parent / path.name).read_bytes())
    text = store.read_text().replace('name="field" type="nerf">', 'name="field" type="nerf">' + MOVED)
    (folder / store.name).write_text(text)
    scene, _ = exported(folder, store.name, monkeypatch=monkeypatch, width=64, spp=1, max_points=2000)
    field, gaze = scene.points
    assert (field.name, gaze.name) == ("field", "gaze") and 1000 < len(field.positions) <= 2000
    # The shop is 8 x 6 x 3 m large.
    low, high = np.percentile(field.positions - (10, 0, 0), [2, 98], axis=0)
    assert (low > -0.2).all() and (high < (8.2, 6.2, 3.2)).all() and (high - low > (7, 5, 2)).all()
    # Colours are linear.
    surface = extract_points(load_radiance(store.parent / "store.safetensors", namespace("llvm"))[0], count=2000)
    assert np.allclose(field.colors, decode_srgb(surface.colors)) and np.ptp(field.colors) > 0.3


def test_a_baked_mesh_keeps_its_attention(rgb, folder, monkeypatch):
    columns = dict(zip("xyz", np.eye(3))) | {"value": np.array([0.1, 0.2, 0.3], np.float32)}
    write_columns(folder / "baked.ply", columns, np.array([[0, 1, 2]]), comments=("value: gaze [1/m²]",))
    scene, _ = exported(folder, "baked.ply", "room.ply", monkeypatch=monkeypatch)
    baked, room = scene.meshes
    assert np.allclose(baked.values, [0.1, 0.2, 0.3]) and baked.label == "gaze [1/m²]" and room.values is None


def test_a_scene_without_nerg_has_its_meshes_and_cameras(rgb, folder, monkeypatch):
    start, end = SCENE.index("<integrator"), SCENE.index("</integrator>")
    (folder / "plain.xml").write_text(SCENE[:start] + '<integrator type="path">' + SCENE[end:])
    scene, _ = exported(folder, "plain.xml", monkeypatch=monkeypatch)
    assert [mesh.name for mesh in scene.meshes] == ["room"] and [c.name for c in scene.cameras] == ["view"]
    assert not scene.points


def test_unsuitable_files_and_options_are_refused(rgb, folder):
    pytest.importorskip("pxr.Usd", reason="usd-core, of the extra usd, is not installed")
    with pytest.raises(NergError, check=mentions("up")):
        export_scene([folder / "room.ply"], folder / "a.usdc", up="x")
    with pytest.raises(NergError, match=r"\.rrd"):
        export_scene([folder / "room.ply"], folder / "a.fbx")
    assert not (folder / "a.usdc").exists()


@pytest.mark.parametrize("suffix, library", [(".rrd", "rerun"), (".usdc", "pxr.Usd")])
def test_missing_libraries_are_named_before_files_are_read(rgb, folder, monkeypatch, suffix, library):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=f"nerg-mi.{'usd' if suffix == '.usdc' else 'rerun'}"):
        export_scene([folder / "no such file.ply"], folder / f"a{suffix}")
