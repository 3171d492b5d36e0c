"""Gaze on surfaces: options of a bake, its chunks and sums, on meshes and splats, and its files."""

from __future__ import annotations

import csv
import io
import json
import pickle
import struct
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import drjit.llvm.ad as ns
import numpy as np
import pytest
import trimesh
from nerg_mi.scenes import store

from nerg_mi.errors import NergError
from nerg_mi.figures.style import apply_colormap
from nerg_mi.formats.fields import load_gaze
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import read_splats, write_ply_splats
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import SH_C0
from nerg_mi.options import PartOptions
from nerg_mi.rays.rays import Rays
from nerg_mi.surfaces.laplacian import merge_sums
from nerg_mi.surfaces.sources import GazeSumSettings, RaySettings, TrackedRays, WeightedObservers
from nerg_mi.tasks.engines import TaskOutput
from nerg_mi.workflows import bake_chunks
from nerg_mi.workflows.bake import bake, check_texture, vertex_normals
from nerg_mi.workflows.bake_chunks import (
    CONE,
    BakeScene,
    PlannedBake,
    SplatScene,
    bake_part,
    check_values,
    cone_radians,
    make_observers,
    make_splat_geometry,
    make_tracked_rays,
    read_observer_file,
    read_sums,
    read_target,
    refine_target,
    select_source,
    split_halves,
    split_into_parts,
    sum_directly,
    sum_in_parts,
)
from nerg_mi.workflows.bake_splats import COLUMN, bake_splats
from nerg_mi.workflows.parts import PartRunner
from nerg_mi.workflows.scene_commands import BakeOptions
from tests.conftest import ROOT
from tests.formats.splats.writers import random_splats, write_inria
from tests.plugins import fields
from tests.refusals import mentions
from tests.surfaces.meshes import box, joined, longest_edge, wall
from tests.surfaces.test_splats import falling
from tests.tasks.works import lay_out
from tests.workflows.recorder import Recorder

# ---- Bakes from files to sums: observers of a field, rays, units, and contradictory options ----


GAZE = files(store) / "shoppers.safetensors"


@pytest.fixture
def room(tmp_path):
    v, f = box((0, 0, 0), (8, 6, 3))
    write_columns(tmp_path / "room.ply", dict(zip("xyz", v.T)), f)
    return tmp_path / "room.ply"


def rays(n=40, people=2):
    d = np.tile([1.0, 0, 0], (n, 1))
    return Rays(np.arange(n) / 10, np.arange(n) % people, tuple("abc"[:people]), np.full((n, 3), 1.5), d, np.ones(n))


def test01_a_field_is_baked_at_recorded_positions(rgb, room):
    recorder = Recorder()
    options = BakeOptions(gaze=GAZE, num_observers=2, max_angle=6.0, max_edge=2.0, mode="llvm_ad_rgb")
    result = bake(room, (), options, recorder, rays=rays())
    assert result.summary["source"] == "field" and result.summary["lookers"] == 1
    assert abs(result.unaccounted) < 1e-3 and result.escaped < 1e-6
    assert np.isclose((result.density * result.mesh.vertex_area).sum(), result.on_surface)
    assert any("unaccounted" in m for m in recorder.messages) and recorder.steps[0][0] == 0


def test02_rays_are_baked_in_fractions_and_seconds(rgb, room):
    share = bake(room, (), BakeOptions(cone=0.0, max_edge=2.0, mode="llvm_ad_rgb"), rays=rays())
    assert share.summary["source"] == "rays" and np.isclose(share.on_surface, 1) and share.escaped == 0
    seconds = bake(room, (), BakeOptions(cone=0.0, max_edge=2.0, unit="seconds", mode="llvm_ad_rgb"), rays=rays())
    # Two participants with twenty rays each, 0.2 seconds apart.
    assert np.isclose((seconds.density * seconds.mesh.vertex_area).sum(), 8.0)
    assert np.allclose(seconds.density, 8 * share.density)
    # All attention is on the wall.
    assert np.isclose(share.share[(share.mesh.corners[:, :, 0] == 8).all(axis=1)].sum(), 1)


@pytest.mark.parametrize("gaze", [GAZE, None])
def test08_recorded_positions_that_are_extrapolated_are_reported_once(rgb, room, gaze):
    options = BakeOptions(gaze=gaze, num_observers=3, max_angle=20.0, max_edge=3.0, cone=0.0, mode="llvm_ad_rgb")
    inside, origin = rays(), np.full((40, 3), 1.5)
    origin[30:, 0] = 99
    for tracked, count in ((inside, 0), (replace(inside, origin=origin), 1)):
        recorder = Recorder()
        bake(room, (), options, recorder, rays=tracked)
        sentences = [text for text in recorder.warnings if "extrapolated" in text]
        assert len(sentences) == count and all("(99, 1.5, 1.5)" in text for text in sentences)


def test03_scene_units_are_converted_to_metres(rgb, tmp_path):
    """Twice as many units per metre: the same share on the same square metres."""
    (tmp_path / "align.json").write_text("[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]")
    v, f = box((0, 0, 0), (8, 6, 3))
    for name, scale in (("a", 1), ("b", 2)):
        write_columns(tmp_path / f"{name}.ply", dict(zip("xyz", scale * v.T)), f)
    options = {"cone": 1.5, "max_edge": 0.9, "smooth": 0.3, "mode": "llvm_ad_rgb"}
    first = bake(tmp_path / "a.ply", (), BakeOptions(**options), rays=rays())
    second = bake(tmp_path / "b.ply", (), BakeOptions(**options, align=tmp_path / "align.json"), rays=rays())
    assert np.allclose(first.density, second.density, rtol=1e-4, atol=1e-6)


def test06_unused_outputs_are_not_computed(rgb, room, monkeypatch):
    """Without smoothing no Laplacian is imported, and without a texture no xatlas."""
    from nerg_mi.surfaces import laplacian
    from nerg_mi.workflows import bake as outputs

    def never(*args, **kwargs):
        raise AssertionError("nobody asked for this")

    monkeypatch.setattr(laplacian, "make_laplacian", never)
    monkeypatch.setattr(outputs, "unwrap_uv", never)
    bake(room, [room.with_name("a.glb")], BakeOptions(max_edge=3.0, mode="llvm_ad_rgb"), rays=rays())
    with pytest.raises(AssertionError):
        bake(room, (), BakeOptions(max_edge=3.0, smooth=0.1, mode="llvm_ad_rgb"), rays=rays())


def test07_a_mesh_in_millimetres_causes_a_warning(rgb, tmp_path):
    v, f = box((0, 0, 0), (8000, 6000, 3000))
    write_columns(tmp_path / "mm.ply", dict(zip("xyz", v.T)), f)
    (tmp_path / "align.json").write_text("[[1e3,0,0,0],[0,1e3,0,0],[0,0,1e3,0],[0,0,0,1]]")
    recorder, aligned_recorder = Recorder(), Recorder()
    options = {"max_edge": 5e3, "cone": 0.0, "mode": "llvm_ad_rgb"}
    bake(tmp_path / "mm.ply", (), BakeOptions(**options), recorder, rays=rays(4))
    assert any("10,440 m across" in said and "align" in said for said in recorder.warnings)
    options["max_edge"] = 5.0
    bake(tmp_path / "mm.ply", (), BakeOptions(**options, align=tmp_path / "align.json"), aligned_recorder, rays=rays(4))
    assert not aligned_recorder.warnings


# ---- Options and contradictions ----


GAZE_FILE, RAYS_FILE = Path("gaze.safetensors"), Path("rays.npz")


@pytest.mark.parametrize(
    "options, with_gaze, source",
    [
        ({"gaze": GAZE_FILE, "rays": RAYS_FILE}, False, "field"),
        ({"gaze": GAZE_FILE, "rays": RAYS_FILE, "source": "rays"}, False, "rays"),
        ({"rays": RAYS_FILE}, True, "rays"),
        ({}, True, "field"),
    ],
)
def test01_the_source_of_gaze_is_selected(options, with_gaze, source):
    assert select_source(BakeOptions(**options), None, with_gaze) == source


@pytest.mark.parametrize(
    "options, said",
    [
        ({}, "there is no gaze: give a gaze field with"),
        ({"source": "eyes"}, "source must be field or rays, got"),
        ({"rays": RAYS_FILE, "unit": "hours"}, "unit"),
        ({"gaze": GAZE_FILE, "split_half": True}, "unit=.seconds. and split_half=True apply to rays,"),
        ({"rays": RAYS_FILE, "observer": (0.0, 0.0, 0.0)}, "observer and observer_file need a gaze"),
    ],
)
def test02_contradictory_options_are_refused(options, said):
    with pytest.raises(NergError, match=said):
        select_source(BakeOptions(**options), None)


def test03_cones():
    assert cone_radians(BakeOptions(), "rays") == np.radians(CONE) and cone_radians(BakeOptions(), "field") == 0
    assert cone_radians(BakeOptions(cone=3.0), "field") == np.radians(3.0)


# ---- Files of a bake open elsewhere, with the same mesh, colours and values ----


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    import mitsuba as mi

    from nerg_mi.formats.ply import write_columns

    mi.set_variant("llvm_ad_rgb")
    folder, (v, f) = tmp_path_factory.mktemp("baked"), box((0, 0, 0), (4, 3, 2.5))
    write_columns(folder / "room.ply", dict(zip("xyz", v.T)), f)
    n, rng = 300, np.random.default_rng(0)
    d = rng.normal((1.0, 0.4, -0.1), 0.2, (n, 3))
    rays = Rays(
        np.arange(n) / 10,
        np.arange(n) // 75,
        tuple("abcd"),
        np.tile([1.0, 1, 1.5], (n, 1)),
        d / np.linalg.norm(d, axis=1, keepdims=True),
        np.ones(n),
    )
    names = [folder / f"a{suffix}" for suffix in (".ply", ".glb", ".csv", ".json")]
    options = BakeOptions(max_edge=0.5, smooth=0.1, split_half=True, unit="seconds", mode="llvm_ad_rgb")
    return folder, bake(folder / "room.ply", names, options, rays=rays)


def test01_ply_and_glb_are_the_same_to_trimesh(baked):
    folder, result = baked
    ply = trimesh.load(folder / "a.ply", process=False)
    glb = trimesh.load(folder / "a.glb", process=False, force="mesh")
    assert np.array_equal(ply.faces, result.mesh.faces) and np.array_equal(glb.faces, result.mesh.faces)
    assert np.allclose(ply.vertices, result.mesh.vertices, atol=1e-6)
    # The node turns z up into glTF's y.
    assert np.allclose(
        glb.vertices, np.stack([ply.vertices[:, 0], ply.vertices[:, 2], -ply.vertices[:, 1]], 1), atol=1e-5
    )
    values = ply.metadata["_ply_raw"]["vertex"]["data"]["value"]
    assert np.allclose(np.ravel(values), result.density, rtol=1e-6)
    # For a mesh with a material, trimesh stores linear colours separately; colours of a PLY are display values.
    (inner,) = trimesh.load(folder / "a.glb", process=False).geometry.values()
    linear = np.array(inner.visual.vertex_attributes["color"], float)[:, :3] / 65535
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.abs(shown - np.array(ply.visual.vertex_colors)[:, :3] / 255).max() < 0.6 / 255
    assert np.allclose(np.ravel(inner.vertex_attributes["_VALUE"]), result.density, rtol=1e-6)
    assert len(np.unique(ply.visual.vertex_colors, axis=0)) > 20


def test02_the_table_adds_up_and_the_summary_records_the_options(baked):
    folder, result = baked
    rows = list(csv.DictReader(io.StringIO((folder / "a.csv").read_text())))
    assert (
        len(rows) == 12 and [int(r["face"]) for r in rows] == list(range(12)) and {r["shape"] for r in rows} == {"room"}
    )
    share = np.array([float(r["share"]) for r in rows])
    assert np.isclose(share.sum(), result.on_surface) and np.isclose(result.on_surface, 1, atol=1e-6)
    # 300 samples of a tenth of a second.
    assert np.allclose([float(r["value"]) * float(r["area_m2"]) for r in rows], 30 * share, rtol=1e-6)
    assert np.isclose(sum(float(r["area_m2"]) for r in rows), 2 * (12 + 10 + 7.5))
    summary = json.loads((folder / "a.json").read_text())
    assert (
        summary["lookers"] == 300
        and 0.3 < summary["halves_cc"] <= 1
        and summary["shapes"] == {"room": pytest.approx(1)}
    )
    assert list(summary["provenance"]["inputs"]) == ["room.ply"] and summary["provenance"]["settings"]["smooth"] == 0.1  # noqa: RUF069 (stored)
    raw = (folder / "a.glb").read_bytes()
    document = json.loads(raw[20 : 20 + struct.unpack_from("<I", raw, 12)[0]])
    assert document["asset"]["extras"]["provenance"]["what"] == "nerg bake"
    assert b"comment nerg_mi" in (folder / "a.ply").read_bytes()[:4000]


def test03_a_texture_is_written(baked, tmp_path):
    pytest.importorskip("xatlas", reason="xatlas is not installed")
    folder, _ = baked
    rays = Rays([0.0, 0.1], [0, 0], ("a",), np.ones((2, 3)), np.array([[1.0, 0, 0], [0, 1, 0]]), np.ones(2))
    options = BakeOptions(max_edge=0.4, texture_size=128, mode="llvm_ad_rgb")
    bake(folder / "room.ply", [tmp_path / "t.glb"], options, rays=rays)
    loaded = trimesh.load(tmp_path / "t.glb", process=False, force="mesh")
    picture = np.asarray(loaded.visual.material.baseColorTexture)
    assert picture.shape[:2] == (128, 128) and len(loaded.faces) == 12
    # Surfaces with gaze are brighter than surfaces without.
    assert picture[..., 0].max() > picture[..., 0][picture[..., 0] > 0].min() + 50


def test04_normals_and_unsupported_textures(tmp_path):
    mesh = joined(box((0, 0, 0), (1, 1, 1)))
    normals = vertex_normals(mesh)
    # At the corners of a cube they point along the diagonals.
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    assert np.all(np.abs(np.abs((normals * np.sign(mesh.vertices - 0.5)).sum(axis=1))) > 1.6)
    with pytest.raises(NergError, match=r"\.glb"):
        check_texture([tmp_path / "a.ply"], 64)


# ---- Bakes in parts: bit-identical to a bake in one piece, for any worker, without repeated work ----


ROOM = joined(box((0, 0, 0), (8, 6, 3)))
OF_RAYS = RaySettings(cone_sigma=0.03, rays_per_cone=4)


@pytest.fixture
def engine(rgb, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setattr(bake_chunks, "RAYS", 300)
    monkeypatch.setattr(bake_chunks, "OBSERVERS", 2)


def crowd(n):
    at = np.random.default_rng(1).uniform((3, 2, 1.4), (5, 4, 1.8), (n, 3))
    return WeightedObservers(at, np.full(n, 1 / n))


def directed(n, seed=0):
    d = np.random.default_rng(seed).normal(size=(n, 3))
    return TrackedRays(np.full((n, 3), 1.5), d / np.linalg.norm(d, axis=1, keepdims=True), np.full(n, 1 / n))


def parts(folder, reporter=None, **options):
    return PartRunner(PartOptions(store=folder, **options), folder / "a.ply", reporter or Recorder(), 1)


def made(recorder):
    """Return the number of parts that were computed, not read from the store."""
    return int(recorder.steps[-1][1].split()[0]) - int(recorder.steps[0][1].split()[0])


def equal(one, other):
    return all(
        np.array_equal(a.face_sums, b.face_sums)
        and np.array_equal(a.vertex_sums, b.vertex_sums)
        and (a.elsewhere, a.escaped, a.total, a.weight, a.count) == (b.elsewhere, b.escaped, b.total, b.weight, b.count)
        for a, b in zip(one, other, strict=True)
    )


@pytest.mark.usefixtures("engine")
@pytest.mark.nightly
def test_two_processes_give_equal_sums_and_reuse_stored_parts(tmp_path):
    scene = BakeScene(
        ROOM, gaze=GAZE, gaze_settings=GazeSumSettings(max_angle=0.5, directions=1024), ray_settings=OF_RAYS
    )
    groups = [crowd(3), directed(500)]
    expected = sum_directly(scene, groups, Recorder())
    assert equal(sum_in_parts(scene, groups, parts(tmp_path, scheduler="local:2"), "a bake"), expected)
    # With two more observers one part changes, and one is new.
    recorder = Recorder()
    extended = [WeightedObservers(np.r_[groups[0].positions, groups[0].positions[:2]], np.full(5, 1 / 3)), groups[1]]
    sum_in_parts(scene, extended, parts(tmp_path, recorder), "a bake")
    assert recorder.steps[-1][1].startswith("5 of 5 parts") and made(recorder) == 2


@pytest.mark.usefixtures("engine")
def test_a_part_depends_only_on_its_inputs(tmp_path):
    def bake_rays(scene, who):
        recorder = Recorder()
        sum_in_parts(scene, [who], parts(tmp_path, recorder), "a bake")
        return made(recorder)

    scene = BakeScene(ROOM, ray_settings=OF_RAYS)
    who = directed(900)
    assert bake_rays(scene, who) == 3 and bake_rays(scene, who) == 0
    # Some rays of the second part change.
    who.directions[400:500] *= -1
    assert bake_rays(scene, who) == 1
    # The mesh changes.
    higher = replace(ROOM, vertices=ROOM.vertices * (1, 1, 1.5))
    assert bake_rays(replace(scene, mesh=higher), who) == 3
    assert bake_rays(replace(scene, ray_settings=RaySettings(cone_sigma=0.02, rays_per_cone=4)), who) == 3


@pytest.mark.usefixtures("engine")
def test_transferred_files_give_equal_sums(tmp_path):
    """A worker on another machine has its inputs in its own folder."""
    plain = wall(0.0, 0.4, 0.05)
    write_ply_splats(tmp_path / "wall.ply", plain)
    for scene, who in (
        (
            BakeScene(
                ROOM, (box((1, 1, 0), (2, 2, 1)),), GAZE, gaze_settings=GazeSumSettings(max_angle=0.5, directions=1024)
            ),
            crowd(1),
        ),
        (SplatScene(tmp_path / "wall.ply", len(plain), ray_settings=OF_RAYS), falling(100)),
    ):
        copied = lay_out(PlannedBake.plan(scene), tmp_path / "there")
        notes = bake_part(copied, who, tmp_path / "a.npy")
        sums = read_sums(TaskOutput(tmp_path / "a.npy", notes), len(scene.empty_sums.face_sums))
        assert copied != PlannedBake.plan(scene) and equal([sums], sum_directly(scene, [who], Recorder()))


@pytest.mark.usefixtures("engine")
@pytest.mark.nightly
def test_two_processes_give_equal_sums_of_splats(tmp_path):
    plain = wall(0.0, 0.4, 0.05)
    write_ply_splats(tmp_path / "wall.ply", plain)
    fields.gaze(tmp_path / "gaze.safetensors")
    scene = SplatScene(tmp_path / "wall.ply", len(plain), tmp_path / "gaze.safetensors", ray_settings=OF_RAYS)
    groups = [falling(500, 0.5), crowd(2)]
    in_parts = sum_in_parts(scene, groups, parts(tmp_path, scheduler="local:2"), "a bake")
    assert equal(in_parts, sum_directly(scene, groups, Recorder()))


@pytest.mark.usefixtures("engine")
def test_halves_split_participants():
    n = 40
    rays = Rays(
        np.arange(n) / 10, np.arange(n) % 4, tuple("abcd"), np.ones((n, 3)), np.eye(3)[np.arange(n) % 3], np.ones(n)
    )
    first, second = split_halves(directed(n), rays, 0)
    assert len(first) == len(second) == 20 and (first.first_index, second.first_index) == (0, 20)
    with pytest.raises(NergError, match="split_half=True needs at least two participants,"):
        split_halves(directed(n), replace(rays, person=np.zeros(n, int)), 0)


@pytest.mark.usefixtures("engine")
def test_baked_files_are_byte_identical_in_parts(tmp_path):
    v, f = box((0, 0, 0), (8, 6, 3))
    write_columns(tmp_path / "room.ply", dict(zip("xyz", v.T)), f)
    n = 1000
    d = directed(n).directions
    rays = Rays(np.arange(n) / 10, np.arange(n) % 2, ("a", "b"), np.full((n, 3), 1.5), d, np.ones(n))
    rays.save(tmp_path / "rays.npz")
    common = {"rays": tmp_path / "rays.npz", "max_edge": 2.0, "split_half": True, "mode": "llvm_ad_rgb"}
    for folder, extra in (("one", {}), ("parts", {"store": tmp_path / "store"})):
        outputs = [tmp_path / folder / f"a{suffix}" for suffix in (".ply", ".glb", ".csv", ".json")]
        bake(tmp_path / "room.ply", outputs, BakeOptions(**common, **extra))
    names = sorted(p.name for p in (tmp_path / "one").iterdir())
    assert len(names) == 4 and names == sorted(p.name for p in (tmp_path / "parts").iterdir())
    for name in names:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name


# ---- Parts of a bake: equal on any worker and in any repetition ----


def test01_parts_are_reproducible_and_scenes_can_be_pickled(rgb, monkeypatch):
    monkeypatch.setattr(bake_chunks, "RAYS", 300)
    scene = BakeScene(ROOM, ray_settings=RaySettings(cone_sigma=0.03, rays_per_cone=4))
    parts = list(split_into_parts(directed(1000)))
    assert [len(p) for p in parts] == [300, 300, 300, 100] and [p.first_index for p in parts] == [0, 300, 600, 900]
    first = [scene.sums(part) for part in parts]
    again = pickle.loads(pickle.dumps(scene))
    late = [again.sums(part) for part in reversed(parts)][::-1]
    assert np.array_equal(merge_sums(first).vertex_sums, merge_sums(late).vertex_sums)
    assert np.isclose(merge_sums(first).face_sums.sum(), 1)


def test02_observers_of_a_field(rgb):
    scene = BakeScene(ROOM, gaze=files(store) / "shoppers.safetensors", gaze_settings=GazeSumSettings(max_angle=0.2))
    crowd = WeightedObservers(np.array([(4.4, 2.8, 1.6)] * 5), np.full(5, 0.2))
    parts = list(split_into_parts(crowd))
    assert [len(p.weights) for p in parts] == [4, 1]
    sums = scene.sums(parts[1])
    assert 0.5 < sums.on_surface / sums.weight < 1.5 and sums.count == 1 and abs(sums.escaped) < 1e-6


def test03_without_a_field_there_are_no_observers(rgb):
    with pytest.raises(NergError, match="there is no gaze field"):
        BakeScene(ROOM).sums(WeightedObservers(np.ones((1, 3)), np.ones(1)))


# ---- Observers ----


TURNED = Similarity(np.array([[0, -2, 0, 1], [2, 0, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1.0]]))


def rays_lookers():
    n = 20
    t = np.arange(n) / 10
    return Rays(t, np.zeros(n), ("a",), np.stack([t, 0 * t, 0 * t + 1.6], 1), np.tile([1.0, 0, 0], (n, 1)), np.ones(n))


def test01_an_observer_file_is_read(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\n4,5,6\n")
    observers = read_observer_file(tmp_path / "a.csv")
    assert observers.positions.tolist() == [[1, 2, 3], [4, 5, 6]] and observers.weights.tolist() == [0.5, 0.5]
    (tmp_path / "b.csv").write_text("Weight;X;y;z\n3;1;2;3\n1;4;5;6\n")
    assert read_observer_file(tmp_path / "b.csv").weights.tolist() == [0.75, 0.25]


@pytest.mark.parametrize(
    "text, said",
    [
        ("x,y\n1,2\n", "no column z"),
        ("x,y,z\n", "0 positions"),
        ("x,y,z\n1,2,nan\n", "correct it, or move the origin closer"),
        ("x,y,z\n1,2,3\n1,2,1e200\n", r"correct it, or move the origin closer"),
        ("x,y,z\n-1.1e7,2,3\n", "row 0 is"),
        ("x,y,z,weight\n1,2,3,inf\n", "has weights that are not finite, negative, or"),
        ("x,y,z,weight\n1,2,3,nan\n", "has weights that are not finite, negative, or"),
        ("x,y,z,weight\n1,2,3,-1\n", "negative"),
    ],
)
def test02_invalid_observer_files_are_refused(tmp_path, text, said):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(NergError, match=said):
        read_observer_file(tmp_path / "a.csv")


def test03_observers_are_in_scene_coordinates():
    recorder = Recorder()
    observers = make_observers(BakeOptions(num_observers=4), rays_lookers(), TURNED, recorder)
    assert (
        len(observers.weights) == 4
        and np.allclose(observers.positions[:, 0], 1)
        and np.allclose(observers.positions[:, 2], 3.2)
    )
    # Messages are in metres; the scene has two units per metre.
    assert (
        f"{observers.rms_distance / 2:.2f} m (root mean square)" in recorder.messages[0]
        and "1 participants in 20 samples" in recorder.messages[0]
    )
    who = make_tracked_rays(rays_lookers(), TURNED, "time")
    assert np.allclose(who.directions, [0, 1, 0]) and np.allclose(who.origins[:, 1], 2 * rays_lookers().origin[:, 0])
    assert np.isclose(who.weights.sum(), 1)


def test04_one_observer_is_required():
    assert make_observers(BakeOptions(observer=(1, 2, 3)), None, TURNED, Recorder()).positions.tolist() == [[1, 2, 3]]
    for options, said in (
        (BakeOptions(), "there is no observer: give observer=x,y,z, an"),
        (BakeOptions(observer=(1, 2)), "three numbers"),
        (BakeOptions(observer=(1, 2, 3), observer_file="a.csv"), "give one of them"),
    ):
        with pytest.raises(NergError, match=said):
            make_observers(options, None, TURNED, Recorder())
    for options, said in (
        (BakeOptions(ray_weights="money"), "ray_weights"),
        (BakeOptions(cmap="jet"), "not a perceptually"),
    ):
        with pytest.raises(NergError, match=said):
            check_values(options)


# ---- Target surfaces ----


SCENE = """<scene version="3.0.0">
    <shape type="cube" id="sign"/>
    <shape type="rectangle" id="wall"><transform name="to_world"><translate z="5"/></transform></shape>
    {more}
</scene>
"""


def test01_a_mesh_is_refined_to_an_edge_length_in_metres(rgb, tmp_path):
    v, f = box((0, 0, 0), (2, 2, 2))
    write_columns(tmp_path / "a.ply", dict(zip("xyz", v.T)), np.concatenate([f, f[:2, ::-1]]))
    recorder = Recorder()
    target = read_target(tmp_path / "a.ply", (), 16, ns, recorder)
    assert target.names == ("a",) and target.index.tolist() == list(range(12)) and not target.occluders
    assert len(recorder.messages) == 1 and recorder.messages[0].startswith("a.ply: 2 ")
    # Two scene units per metre.
    assert longest_edge(refine_target(target, 0.25, 2.0).mesh) <= 0.5
    assert 50_000 < len(refine_target(target, None, 1.0).mesh.faces) < 250_000


def test02_shapes_of_a_scene_receive_gaze_or_occlude(rgb, tmp_path):
    (tmp_path / "a.xml").write_text(SCENE.format(more=""))
    both = read_target(tmp_path / "a.xml", (), 16, ns, Recorder())
    assert both.names == ("sign", "wall") and np.bincount(both.shape).tolist() == [12, 2]
    sign = read_target(tmp_path / "a.xml", ("sign",), 16, ns, Recorder())
    assert sign.names == ("sign",) and len(sign.mesh.faces) == 12 and len(sign.occluders) == 1
    with pytest.raises(NergError, match='"door"'):
        read_target(tmp_path / "a.xml", ("door",), 16, ns, Recorder())
    (tmp_path / "b.xml").write_text(SCENE.format(more='<shape type="sphere" id="ball"/>'))
    with pytest.raises(NergError, match='"ball" .* is a Sphere'):
        read_target(tmp_path / "b.xml", (), 16, ns, Recorder())
    (tmp_path / "c.xml").write_text('<scene version="3.0.0"/>')
    with pytest.raises(NergError, match="has no shapes"):
        read_target(tmp_path / "c.xml", (), 16, ns, Recorder())


def test03_the_surface_of_a_field_is_extracted(rgb, tmp_path):
    pytest.importorskip("skimage", reason="scikit-image is not installed")
    fields.radiance(tmp_path / "f.safetensors")
    target = read_target(tmp_path / "f.safetensors", (), 8, ns, Recorder())
    assert target.names == ("f",) and len(target.mesh.faces) > 10
    with pytest.raises(NergError, check=mentions("shapes")):
        read_target(tmp_path / "f.safetensors", ("a",), 8, ns, Recorder())


# ---- Parts of a bake of splats: equal on any worker and in any repetition ----


@pytest.fixture
def scene(tmp_path, rgb):
    plain = wall(0.0, 0.4, 0.05)
    write_ply_splats(tmp_path / "wall.ply", plain)
    return SplatScene(tmp_path / "wall.ply", len(plain), ray_settings=OF_RAYS)


def test01_scenes_can_be_pickled_and_are_identified_by_file(scene):
    rays = falling(100, 0.5)
    first = scene.sums(rays)
    again = pickle.loads(pickle.dumps(scene))
    assert np.array_equal(again.sums(rays).face_sums, first.face_sums)
    assert len(first.face_sums) == len(scene.empty_sums.face_sums) == 2 * 64 and not len(first.vertex_sums)
    write_ply_splats(scene.splats, wall(0.1, 0.4, 0.05))
    moved = replace(scene)
    assert not np.array_equal(moved.sums(rays).face_sums, first.face_sums)


def test02_without_a_field_there_are_no_observers(scene):
    with pytest.raises(NergError, match="there is no gaze field"):
        scene.sums(WeightedObservers(np.ones((1, 3)), np.ones(1)))


def test03_the_surface_tolerance_of_splats(rgb):
    assert np.isclose(make_splat_geometry(wall(0.0, 0.2)).tolerance, 2 * 1e-3)


# ---- Gaze per Gaussian: from files to a file ----


OPTIONS = {"mode": "llvm_ad_rgb", "observer": (0.0, 0.0, -3.0)}


@pytest.fixture
def place(tmp_path):
    """A few balls that do not occlude each other, and a gaze field."""
    splats = random_splats(30, size=0.02)
    write_inria(tmp_path / "place.ply", splats, shuffled=True)
    fields.gaze(tmp_path / "gaze.safetensors")
    return tmp_path


def bake_place(place, output="out.ply", reporter=None, **changes):
    options = BakeOptions(gaze=place / "gaze.safetensors", **(OPTIONS | changes))
    return bake_splats(place / "place.ply", [place / output], options, reporter or Recorder())


def test01_each_gaussian_gets_its_attention_and_keeps_other_columns(rgb, place):
    recorder = Recorder()
    result = bake_place(place, reporter=recorder)
    original, back = read_splats(place / "place.ply"), read_splats(place / "out.ply")
    assert (
        result.files == (place / "out.ply",)
        and "30 of 30 Gaussians receive gaze from 1 observer;" in recorder.messages[1]
    )
    assert recorder.messages[0].endswith("place.ply: unused columns: label")
    to = original.centers - np.array(OPTIONS["observer"])
    distance = np.linalg.norm(to, axis=1)
    w = to / distance[:, None]
    scaled = np.einsum("nji,nj->ni", original.axes(), w) / original.scales
    area = np.linalg.norm(scaled, axis=1) * original.scales.min(axis=1)
    field = load_gaze(place / "gaze.safetensors", ns)[0]
    array = lambda rows: ns.Array3f(np.ascontiguousarray(np.asarray(rows, np.float32).T))
    origins = array(np.tile(OPTIONS["observer"], (30, 1)))
    gaze = np.array(field.evaluate(array(original.centers), origins, array(w), ns.Bool(True))[0])
    assert np.allclose(result.attention, gaze * area / distance**2, rtol=1e-3)
    assert np.allclose(back.extra[COLUMN], result.attention, rtol=1e-6)
    assert np.array_equal(back.extra["label"], original.extra["label"]) and back.degree == 0
    for name in ("centers", "scales", "rotations", "opacities"):
        assert np.allclose(getattr(back, name), getattr(original, name), rtol=1e-5, atol=1e-6)
    # The maximum has nine tenths of the last colour of the map.
    hot = 0.5 + SH_C0 * back.harmonics[result.attention.argmax(), 0]
    assert np.abs(hot - apply_colormap("inferno", np.ones(1))[0]).max() < 0.1


def test02_observer_paths_and_other_units(rgb, place):
    (place / "walk.csv").write_text("x,y,z,weight\n0,0,-3,1\n0,0,-3,3\n0,3,0,0\n")
    (place / "align.json").write_text("[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]")
    one = bake_place(place)
    many = bake_place(
        place, observer=None, observer_file=place / "walk.csv", align=place / "align.json", vmax=0.5, log_decades=2.0
    )
    assert many.observers == 3 and np.allclose(many.attention, 4 * one.attention, rtol=1e-5)


@pytest.mark.parametrize(
    "options, said",
    [
        ({"texture_size": 512}, "texture"),
        ({"shapes": ("a",)}, "shapes does not apply to Gaussian splats;"),
        ({"source": "field", "gaze": None}, "--field SPLATS"),
    ],
)
def test03_unsupported_options_of_splats_are_refused(rgb, place, options, said):
    bake_options = BakeOptions(**({"gaze": place / "gaze.safetensors"} | OPTIONS | options))
    with pytest.raises(NergError, match=said):
        bake_splats(place / "place.ply", [place / "out.ply"], bake_options)
    with pytest.raises(NergError, match=".ply"):
        bake_place(place, "out.glb")
    assert not (place / "out.ply").exists()


def make_wall_rays(n=600):
    """Rays of two participants in front of a wall of one square metre, towards it."""
    rng = np.random.default_rng(0)
    d = np.concatenate([rng.normal(0, 0.12, (n, 2)), np.ones((n, 1))], axis=1)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return Rays(np.arange(n) / 10, np.arange(n) % 2, ("a", "b"), np.tile([0.0, 0, -1], (n, 1)), d, np.ones(n))


def test04_rays_give_equal_files_with_and_without_parts(rgb, tmp_path, monkeypatch):
    """Shares, seconds, split halves and smoothing; the files are byte-identical."""
    monkeypatch.setattr(bake_chunks, "RAYS", 200)
    write_ply_splats(tmp_path / "wall.ply", wall(0.0, 1.0, 0.03, 0.0005))
    make_wall_rays().save(tmp_path / "rays.npz")
    common = {
        "rays": tmp_path / "rays.npz",
        "mode": "llvm_ad_rgb",
        "cone_samples": 4,
        "split_half": True,
        "smooth": 0.05,
    }
    for folder, extra in (("one", {}), ("parts", {"store": tmp_path / "store"})):
        recorder = Recorder()
        outputs = [tmp_path / folder / f"a{suffix}" for suffix in (".ply", ".json")]
        result = bake_splats(tmp_path / "wall.ply", outputs, BakeOptions(**common, **extra), recorder)
    for name in ("a.ply", "a.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name
    summary = json.loads((tmp_path / "one" / "a.json").read_text())
    assert abs(summary["on_splats"] + summary["escaped"] - 1) < 1e-3 and summary["on_splats"] > 0.9
    assert 0.7 < summary["halves_cc"] <= 1 and summary["lookers"] == 600
    assert any("of the gaze is on Gaussians" in line for line in recorder.messages)
    # The maximum: a Gaussian of the gaze density, the cone and the smoothing.
    peak = 1 / (2 * np.pi * (0.12**2 + np.radians(1.5) ** 2 + 0.05**2))
    middle = np.linalg.norm(result.splats.centers[:, :2], axis=1) < 0.06
    assert np.isclose(np.median(result.attention[middle]), peak, rtol=0.15)
    seconds = bake_splats(tmp_path / "wall.ply", (), BakeOptions(**common, unit="seconds", store=tmp_path / "store"))
    assert np.allclose(seconds.attention, 120 * result.attention, rtol=0.01) and seconds.summary["unit"].endswith(
        "[s/m^2]"
    )


def test05_a_smoothed_field_in_parts(rgb, place):
    (place / "walk.csv").write_text("x,y,z\n0,0,-3\n0,1,-3\n1,0,-3\n")
    common = {"observer": None, "observer_file": place / "walk.csv"}
    one, parts = (bake_place(place, "one.ply", **common), bake_place(place, "two.ply", store=place / "store", **common))
    assert np.array_equal(one.attention, parts.attention)
    # Separate balls have no neighbours to share attention with.
    smoothed = bake_place(place, "three.ply", smooth=0.01, **common)
    assert np.median(np.abs(smoothed.attention / one.attention - 1)) < 0.01
