"""Gaze on surfaces: options of a bake, its chunks and sums, on meshes and splats, and its files."""

from __future__ import annotations

import csv
import dataclasses
import inspect
import io
import json
import pickle
import signal
import struct
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import drjit.llvm.ad as ns
import numpy as np
import pytest
import trimesh
from nerg_mi.scenes import store

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.gaze import GazeField
from nerg_mi.errors import NergError
from nerg_mi.figures.style import apply_colormap
from nerg_mi.formats.fields import load_gaze
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import read_splats, write_ply_splats
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.sphere import SH_C0
from nerg_mi.surfaces import bake_parts
from nerg_mi.surfaces.bake import bake, vertex_normals
from nerg_mi.surfaces.bake_parts import (
    CONE,
    BakeInputs,
    MeshBaker,
    bake_part,
    make_observers,
    make_tracked_rays,
    read_observer_file,
    read_sums,
    split_halves,
    split_into_parts,
    sum_directly,
    sum_in_parts,
)
from nerg_mi.surfaces.bake_splats import COLUMN, SplatBaker
from nerg_mi.surfaces.laplacian import merge_sums
from nerg_mi.surfaces.settings import BakeColors, BakeSampling
from nerg_mi.surfaces.sources import GazeSumSettings, RaySettings, TrackedRays, WeightedObservers
from nerg_mi.surfaces.targets import read_target, refine_target
from nerg_mi.tasks.engines import TaskOutput
from nerg_mi.tasks.parts import PartRunner
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tracking.rays import Rays
from tests.aoi.place import write_place
from tests.conftest import ROOT
from tests.formats.splats.writers import random_splats, write_inria
from tests.plugins import fields
from tests.recorder import Recorder
from tests.refusals import mentions
from tests.surfaces.meshes import box, joined, longest_edge, wall
from tests.surfaces.test_splats import falling
from tests.tasks.works import lay_out

# ---- Bakes from files to sums: observers of a field, rays, units, and contradictory options ----


GAZE = files(store) / "shoppers.safetensors"


def inputs(**values):
    """Arguments of a bake, with defaults."""
    names = inspect.signature(bake).parameters
    defaults = {f.name: names[f.name].default for f in dataclasses.fields(BakeInputs)}
    return BakeInputs(**{**defaults, "surface": "room.ply", **values})


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
    sampling = BakeSampling(num_observers=2, max_angle=6.0)
    result = bake(room, gaze=GAZE, rays=rays(), max_edge=2.0, sampling=sampling, progress=recorder)
    assert result.summary["source"] == "field" and result.summary["lookers"] == 1
    assert abs(result.unaccounted) < 1e-3 and result.escaped < 1e-6
    assert np.isclose((result.density * result.mesh.vertex_area).sum(), result.on_surface)
    assert any("unaccounted" in m for m in recorder.messages) and recorder.steps[0][0] == 0


def test02_rays_are_baked_in_fractions_and_seconds(rgb, room):
    sharp = BakeSampling(cone=0.0)
    share = bake(room, rays=rays(), max_edge=2.0, sampling=sharp)
    assert share.summary["source"] == "rays" and np.isclose(share.on_surface, 1) and share.escaped == 0
    seconds = bake(room, rays=rays(), max_edge=2.0, unit="seconds", sampling=sharp)
    # Two participants with twenty rays each, 0.2 seconds apart.
    assert np.isclose((seconds.density * seconds.mesh.vertex_area).sum(), 8.0)
    assert np.allclose(seconds.density, 8 * share.density)
    # All attention is on the wall.
    assert np.isclose(share.share[(share.mesh.corners[:, :, 0] == 8).all(axis=1)].sum(), 1)


@pytest.mark.parametrize("gaze", [GAZE, None])
def test08_recorded_positions_that_are_extrapolated_are_reported_once(rgb, room, gaze):
    sampling = BakeSampling(num_observers=3, max_angle=20.0, cone=0.0)
    inside, origin = rays(), np.full((40, 3), 1.5)
    origin[30:, 0] = 99
    for tracked, count in ((inside, 0), (replace(inside, origin=origin), 1)):
        recorder = Recorder()
        bake(room, gaze=gaze, rays=tracked, max_edge=3.0, sampling=sampling, progress=recorder)
        sentences = [text for text in recorder.warnings if "extrapolated" in text]
        assert len(sentences) == count and all("(99, 1.5, 1.5)" in text for text in sentences)


def test03_scene_units_are_converted_to_metres(rgb, tmp_path):
    """Twice as many units per metre: the same share on the same square metres."""
    (tmp_path / "align.json").write_text("[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]")
    v, f = box((0, 0, 0), (8, 6, 3))
    for name, scale in (("a", 1), ("b", 2)):
        write_columns(tmp_path / f"{name}.ply", dict(zip("xyz", scale * v.T)), f)
    options = {"rays": rays(), "max_edge": 0.9, "smooth": 0.3}
    first = bake(tmp_path / "a.ply", **options)
    second = bake(tmp_path / "b.ply", **options, align=tmp_path / "align.json")
    assert np.allclose(first.density, second.density, rtol=1e-4, atol=1e-6)


def test06_unused_outputs_are_not_computed(rgb, room, monkeypatch):
    """Without smoothing no Laplacian is imported, and without a texture no xatlas."""
    from nerg_mi.surfaces import laplacian

    def never(*args, **kwargs):
        raise AssertionError("nobody asked for this")

    monkeypatch.setattr(laplacian, "make_laplacian", never)
    monkeypatch.setattr("nerg_mi.surfaces.bake.unwrap_uv", never)
    bake(room, rays=rays(), max_edge=3.0).save(room.with_name("a.glb"))
    with pytest.raises(AssertionError):
        bake(room, rays=rays(), max_edge=3.0, smooth=0.1)


def test09_ctrl_c_in_the_only_part_is_noticed(rgb, room, monkeypatch):
    make_sums, calls = MeshBaker.sums, []

    def press(*arguments):
        calls.append(make_sums(*arguments))
        signal.raise_signal(signal.SIGINT)
        return calls[-1]

    monkeypatch.setattr(MeshBaker, "sums", press)
    with pytest.raises(KeyboardInterrupt):
        bake(room, rays=rays(), max_edge=3.0)
    assert len(calls) == 1


def test07_a_mesh_in_millimetres_causes_a_warning(rgb, tmp_path):
    v, f = box((0, 0, 0), (8000, 6000, 3000))
    write_columns(tmp_path / "mm.ply", dict(zip("xyz", v.T)), f)
    (tmp_path / "align.json").write_text("[[1e3,0,0,0],[0,1e3,0,0],[0,0,1e3,0],[0,0,0,1]]")
    recorder, aligned_recorder = Recorder(), Recorder()
    options = {"rays": rays(4), "sampling": BakeSampling(cone=0.0)}
    bake(tmp_path / "mm.ply", **options, max_edge=5e3, progress=recorder)
    assert any("10,440 m across" in said and "align" in said for said in recorder.warnings)
    align = tmp_path / "align.json"
    bake(tmp_path / "mm.ply", **options, max_edge=5.0, align=align, progress=aligned_recorder)
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
    surface = "room.xml" if with_gaze else "room.ply"
    assert inputs(surface=surface, **options).select_source() == source


@pytest.mark.parametrize(
    "options, said",
    [
        ({}, "there is no gaze: give a gaze field with"),
        ({"source": "eyes"}, "source must be field or rays, got"),
        ({"gaze": GAZE_FILE, "split_half": True}, "unit=.seconds. and split_half=True apply to rays,"),
        ({"rays": RAYS_FILE, "observer": (0.0, 0.0, 0.0)}, "observer and observer_file need a gaze"),
    ],
)
def test02_contradictory_options_are_refused(options, said):
    with pytest.raises(NergError, match=said):
        inputs(**options).select_source()


def test03_cones():
    assert inputs().cone_radians("rays") == np.radians(CONE) and inputs().cone_radians("field") == 0
    assert inputs(sampling=BakeSampling(cone=3.0)).cone_radians("field") == np.radians(3.0)


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
    result = bake(folder / "room.ply", rays=rays, max_edge=0.5, smooth=0.1, split_half=True, unit="seconds")
    for suffix in (".ply", ".glb", ".csv", ".json"):
        result.save(folder / f"a{suffix}")
    return folder, result


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
    colors = BakeColors(texture_size=128)
    bake(folder / "room.ply", rays=rays, max_edge=0.4, colors=colors).save(tmp_path / "t.glb")
    loaded = trimesh.load(tmp_path / "t.glb", process=False, force="mesh")
    picture = np.asarray(loaded.visual.material.baseColorTexture)
    assert picture.shape[:2] == (128, 128) and len(loaded.faces) == 12
    # Surfaces with gaze are brighter than surfaces without.
    assert picture[..., 0].max() > picture[..., 0][picture[..., 0] > 0].min() + 50


def test04_normals():
    mesh = joined(box((0, 0, 0), (1, 1, 1)))
    normals = vertex_normals(mesh)
    # At the corners of a cube they point along the diagonals.
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    assert np.all(np.abs(np.abs((normals * np.sign(mesh.vertices - 0.5)).sum(axis=1))) > 1.6)


# ---- Bakes in parts: bit-identical to a bake in one piece, for any worker, without repeated work ----


ROOM = joined(box((0, 0, 0), (8, 6, 3)))
OF_RAYS = RaySettings(cone_sigma=0.03, rays_per_cone=4)


@pytest.fixture
def engine(rgb, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setattr(bake_parts, "RAYS", 300)
    monkeypatch.setattr(bake_parts, "OBSERVERS", 2)


def crowd(n):
    at = np.random.default_rng(1).uniform((3, 2, 1.4), (5, 4, 1.8), (n, 3))
    return WeightedObservers(at, np.full(n, 1 / n))


def directed(n, seed=0):
    d = np.random.default_rng(seed).normal(size=(n, 3))
    return TrackedRays(np.full((n, 3), 1.5), d / np.linalg.norm(d, axis=1, keepdims=True), np.full(n, 1 / n))


def parts(folder, reporter=None, **options):
    return PartRunner(Parallel(store=folder, threads=1, **options), None, reporter or Recorder())


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
    coarse = GazeSumSettings(max_angle=0.5, directions=1024)
    baker = MeshBaker(ROOM, gaze=load_gaze(GAZE, ns)[0], gaze_settings=coarse, ray_settings=OF_RAYS)
    common = baker.plan(inputs(gaze=GAZE), tmp_path)
    groups = [crowd(3), directed(500)]
    expected = sum_directly(baker, groups, Recorder())
    assert equal(sum_in_parts(baker, common, groups, parts(tmp_path, scheduler="local:2"), "a bake"), expected)
    # With two more observers one part changes, and one is new.
    recorder = Recorder()
    extended = [WeightedObservers(np.r_[groups[0].positions, groups[0].positions[:2]], np.full(5, 1 / 3)), groups[1]]
    sum_in_parts(baker, common, extended, parts(tmp_path, recorder), "a bake")
    assert recorder.steps[-1][1].startswith("5 of 5 parts") and made(recorder) == 2


@pytest.mark.usefixtures("engine")
def test_a_part_depends_only_on_its_inputs(tmp_path):
    def bake_rays(baker, who):
        recorder = Recorder()
        sum_in_parts(baker, baker.plan(inputs(), tmp_path), [who], parts(tmp_path, recorder), "a bake")
        return made(recorder)

    baker = MeshBaker(ROOM, ray_settings=OF_RAYS)
    who = directed(900)
    assert bake_rays(baker, who) == 3 and bake_rays(baker, who) == 0
    # Some rays of the second part change.
    who.directions[400:500] *= -1
    assert bake_rays(baker, who) == 1
    # The mesh changes.
    higher = replace(ROOM, vertices=ROOM.vertices * (1, 1, 1.5))
    assert bake_rays(replace(baker, mesh=higher), who) == 3
    assert bake_rays(replace(baker, ray_settings=RaySettings(cone_sigma=0.02, rays_per_cone=4)), who) == 3


@pytest.mark.usefixtures("engine")
def test_transferred_files_give_equal_sums(tmp_path):
    """A worker on another machine has its inputs in its own folder."""
    plain = wall(0.0, 0.4, 0.05)
    write_ply_splats(tmp_path / "wall.ply", plain)
    coarse = GazeSumSettings(max_angle=0.5, directions=1024)
    room = MeshBaker(ROOM, (box((1, 1, 0), (2, 2, 1)),), load_gaze(GAZE, ns)[0], gaze_settings=coarse)
    splats = SplatBaker(read_splats(tmp_path / "wall.ply"), ray_settings=OF_RAYS)
    for baker, arguments, who in (
        (room, inputs(gaze=GAZE), crowd(1)),
        (splats, inputs(surface=tmp_path / "wall.ply"), falling(100)),
    ):
        planned = baker.plan(arguments, tmp_path)
        copied = lay_out(planned, tmp_path / "there")
        notes = bake_part(copied, who, tmp_path / "a.npy")
        sums = read_sums(TaskOutput(tmp_path / "a.npy", notes), len(baker.empty_sums.face_sums))
        assert copied != planned and equal([sums], sum_directly(baker, [who], Recorder()))


def test_objects_in_memory_are_parts_as_well(rgb, tmp_path):
    """A gaze field and splats without files, which are written to the store for as long as parts need them."""
    splats = wall(0.0, 0.4, 0.05)
    fields.gaze(tmp_path / "gaze.safetensors")
    gaze = GazeField(load_gaze(tmp_path / "gaze.safetensors", ns)[0])
    store, eye = tmp_path / "store", (0.0, 0.0, -3.0)
    one = bake(splats, gaze=gaze, observer=np.array(eye), align=np.eye(4))
    parts = bake(splats, gaze=gaze, observer=eye, parallel=Parallel(store=store))
    # Files store logarithms of scales and opacities.
    assert np.allclose(one.attention, parts.attention, rtol=1e-5) and not list(store.rglob("*.safetensors"))


@pytest.mark.usefixtures("engine")
@pytest.mark.nightly
def test_two_processes_give_equal_sums_of_splats(tmp_path):
    plain = wall(0.0, 0.4, 0.05)
    write_ply_splats(tmp_path / "wall.ply", plain)
    fields.gaze(tmp_path / "gaze.safetensors")
    gaze = tmp_path / "gaze.safetensors"
    baker = SplatBaker(read_splats(tmp_path / "wall.ply"), load_gaze(gaze, ns)[0], ray_settings=OF_RAYS)
    common = baker.plan(inputs(surface=tmp_path / "wall.ply", gaze=gaze), tmp_path)
    groups = [falling(500, 0.5), crowd(2)]
    in_parts = sum_in_parts(baker, common, groups, parts(tmp_path, scheduler="local:2"), "a bake")
    assert equal(in_parts, sum_directly(baker, groups, Recorder()))


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
    common = {"rays": tmp_path / "rays.npz", "max_edge": 2.0, "split_half": True}
    for folder, parallel in (("one", Parallel()), ("parts", Parallel(store=tmp_path / "store"))):
        result = bake(tmp_path / "room.ply", **common, parallel=parallel)
        for suffix in (".ply", ".glb", ".csv", ".json"):
            result.save(tmp_path / folder / f"a{suffix}")
    names = sorted(p.name for p in (tmp_path / "one").iterdir())
    assert len(names) == 4 and names == sorted(p.name for p in (tmp_path / "parts").iterdir())
    for name in names:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name


# ---- Parts of a bake: equal on any worker and in any repetition ----


def test01_parts_are_reproducible_and_scenes_can_be_pickled(rgb, monkeypatch):
    monkeypatch.setattr(bake_parts, "RAYS", 300)
    baker = MeshBaker(ROOM, ray_settings=RaySettings(cone_sigma=0.03, rays_per_cone=4))
    parts = list(split_into_parts(directed(1000)))
    assert [len(p) for p in parts] == [300, 300, 300, 100] and [p.first_index for p in parts] == [0, 300, 600, 900]
    first = [baker.sums(part) for part in parts]
    again = pickle.loads(pickle.dumps(baker.plan(inputs(), Path()))).open()
    late = [again.sums(part) for part in reversed(parts)][::-1]
    assert np.array_equal(merge_sums(first).vertex_sums, merge_sums(late).vertex_sums)
    assert np.isclose(merge_sums(first).face_sums.sum(), 1)


def test02_observers_of_a_field(rgb):
    baker = MeshBaker(ROOM, gaze=load_gaze(GAZE, ns)[0], gaze_settings=GazeSumSettings(max_angle=0.2))
    crowd = WeightedObservers(np.array([(4.4, 2.8, 1.6)] * 5), np.full(5, 0.2))
    parts = list(split_into_parts(crowd))
    assert [len(p.weights) for p in parts] == [4, 1]
    sums = baker.sums(parts[1])
    assert 0.5 < sums.on_surface / sums.weight < 1.5 and sums.count == 1 and abs(sums.escaped) < 1e-6


def test03_without_a_field_there_are_no_observers(rgb):
    with pytest.raises(NergError, match="there is no gaze field"):
        MeshBaker(ROOM).sums(WeightedObservers(np.ones((1, 3)), np.ones(1)))


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
    observers = make_observers(inputs(sampling=BakeSampling(num_observers=4)), rays_lookers(), TURNED, recorder)
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
    assert make_observers(inputs(observer=(1, 2, 3)), None, TURNED, Recorder()).positions.tolist() == [[1, 2, 3]]
    for arguments, said in (
        (inputs(), "there is no observer: give observer=x,y,z, an"),
        (inputs(observer=(1, 2)), "three numbers"),
        (inputs(observer=(1, 2, 3), observer_file="a.csv"), "give one of them"),
    ):
        with pytest.raises(NergError, match=said):
            make_observers(arguments, None, TURNED, Recorder())
    with pytest.raises(NergError, match="ray_weights"):
        BakeSampling(ray_weights="money")
    with pytest.raises(NergError, match="not a perceptually"):
        bake("room.ply", rays="rays.npz", colors=BakeColors(cmap="jet"))


# ---- Target surfaces ----


def read_shapes(path, *names):
    return read_target(path, Environment.open(path, keep_shapes=True), names, 16, Recorder())


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
    target = read_target(tmp_path / "a.ply", None, (), 16, recorder)
    assert target.names == ("a",) and target.index.tolist() == list(range(12)) and not target.occluders
    assert len(recorder.messages) == 1 and recorder.messages[0].startswith("a.ply: 2 ")
    # Two scene units per metre.
    assert longest_edge(refine_target(target, 0.25, 2.0).mesh) <= 0.5
    assert 50_000 < len(refine_target(target, None, 1.0).mesh.faces) < 250_000


def test02_shapes_of_a_scene_receive_gaze_or_occlude(rgb, tmp_path):
    (tmp_path / "a.xml").write_text(SCENE.format(more=""))
    both = read_shapes(tmp_path / "a.xml")
    assert both.names == ("sign", "wall") and np.bincount(both.shape).tolist() == [12, 2]
    sign = read_shapes(tmp_path / "a.xml", "sign")
    assert sign.names == ("sign",) and len(sign.mesh.faces) == 12 and len(sign.occluders) == 1
    with pytest.raises(NergError, match='"door"'):
        read_shapes(tmp_path / "a.xml", "door")
    (tmp_path / "b.xml").write_text(SCENE.format(more='<shape type="sphere" id="ball"/>'))
    with pytest.raises(NergError, match='"ball" .* is a Sphere'):
        read_shapes(tmp_path / "b.xml")
    (tmp_path / "c.xml").write_text('<scene version="3.0.0"/>')
    with pytest.raises(NergError, match="has no shapes"):
        read_shapes(tmp_path / "c.xml")


def test_shapes_of_equal_materials_keep_their_names(rgb, tmp_path):
    target = read_shapes(write_place(tmp_path, gaze=False), "stand")
    assert target.names == ("stand",) and len(target.occluders) == 2


def test03_the_surface_of_a_field_is_extracted(rgb, tmp_path):
    pytest.importorskip("skimage", reason="scikit-image is not installed")
    fields.radiance(tmp_path / "f.safetensors")
    target = read_target(tmp_path / "f.safetensors", None, (), 8, Recorder())
    assert target.names == ("f",) and len(target.mesh.faces) > 10
    with pytest.raises(NergError, check=mentions("shapes")):
        read_target(tmp_path / "f.safetensors", None, ("a",), 8, Recorder())


# ---- Parts of a bake of splats: equal on any worker and in any repetition ----


@pytest.fixture
def baker(rgb):
    plain = wall(0.0, 0.4, 0.05)
    return SplatBaker(plain, ray_settings=OF_RAYS)


def test01_sums_of_rays_have_both_sides_of_gaussians(baker):
    sums = baker.sums(falling(100, 0.5))
    assert len(sums.face_sums) == len(baker.empty_sums.face_sums) == 2 * 64 and not len(sums.vertex_sums)


def test02_without_a_field_there_are_no_observers(baker):
    with pytest.raises(NergError, match="there is no gaze field"):
        baker.sums(WeightedObservers(np.ones((1, 3)), np.ones(1)))


def test03_the_surface_tolerance_of_splats(rgb):
    assert np.isclose(SplatBaker(wall(0.0, 0.2)).tolerance, 2 * 1e-3)


# ---- Gaze per Gaussian: from files to a file ----


OPTIONS = {"observer": (0.0, 0.0, -3.0)}


@pytest.fixture
def place(tmp_path):
    """A few balls that do not occlude each other, and a gaze field."""
    splats = random_splats(30, size=0.02)
    write_inria(tmp_path / "place.ply", splats, shuffled=True)
    fields.gaze(tmp_path / "gaze.safetensors")
    return tmp_path


def bake_place(place, **changes):
    return bake(place / "place.ply", **({"gaze": place / "gaze.safetensors"} | OPTIONS | changes))


def test01_each_gaussian_gets_its_attention_and_keeps_other_columns(rgb, place):
    recorder = Recorder()
    result = bake_place(place, progress=recorder)
    result.save(place / "out.ply")
    original, back = read_splats(place / "place.ply"), read_splats(place / "out.ply")
    assert "30 of 30 Gaussians receive gaze from 1 observer;" in recorder.messages[1]
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
    walk = {"observer": None, "observer_file": place / "walk.csv", "align": place / "align.json"}
    many = bake_place(place, **walk, colors=BakeColors(vmax=0.5, log_decades=2.0))
    assert many.observers == 3 and np.allclose(many.attention, 4 * one.attention, rtol=1e-5)


@pytest.mark.parametrize(
    "options, said",
    [
        ({"sampling": BakeSampling(resolution=32)}, "resolution does not apply"),
        ({"shapes": ("a",)}, "shapes does not apply to Gaussian splats;"),
        ({"source": "field", "gaze": None}, "nerg train gaze RAYS"),
    ],
)
def test03_unsupported_options_of_splats_are_refused(rgb, place, options, said):
    with pytest.raises(NergError, match=said):
        bake_place(place, **options)


def make_wall_rays(n=600):
    """Rays of two participants in front of a wall of one square metre, towards it."""
    rng = np.random.default_rng(0)
    d = np.concatenate([rng.normal(0, 0.12, (n, 2)), np.ones((n, 1))], axis=1)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return Rays(np.arange(n) / 10, np.arange(n) % 2, ("a", "b"), np.tile([0.0, 0, -1], (n, 1)), d, np.ones(n))


def test04_rays_give_equal_files_with_and_without_parts(rgb, tmp_path, monkeypatch):
    """Shares, seconds, split halves and smoothing; the files are byte-identical."""
    monkeypatch.setattr(bake_parts, "RAYS", 200)
    write_ply_splats(tmp_path / "wall.ply", wall(0.0, 1.0, 0.03, 0.0005))
    make_wall_rays().save(tmp_path / "rays.npz")
    common = {"rays": tmp_path / "rays.npz", "split_half": True, "smooth": 0.05}
    common |= {"sampling": BakeSampling(cone_samples=4)}
    stored = Parallel(store=tmp_path / "store")
    for folder, parallel in (("one", Parallel()), ("parts", stored)):
        recorder = Recorder()
        result = bake(tmp_path / "wall.ply", **common, parallel=parallel, progress=recorder)
        for suffix in (".ply", ".json"):
            result.save(tmp_path / folder / f"a{suffix}")
    with pytest.raises(NergError, match=".ply"):
        result.save(tmp_path / "out.glb")
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
    seconds = bake(tmp_path / "wall.ply", **common, unit="seconds", parallel=stored)
    assert np.allclose(seconds.attention, 120 * result.attention, rtol=0.01) and seconds.summary["unit"].endswith(
        "[s/m^2]"
    )


def test05_a_smoothed_field_in_parts(rgb, place):
    (place / "walk.csv").write_text("x,y,z\n0,0,-3\n0,1,-3\n1,0,-3\n")
    common = {"observer": None, "observer_file": place / "walk.csv"}
    one, parts = bake_place(place, **common), bake_place(place, **common, parallel=Parallel(store=place / "store"))
    assert np.array_equal(one.attention, parts.attention)
    # Separate balls have no neighbours to share attention with.
    smoothed = bake_place(place, smooth=0.01, **common)
    assert np.median(np.abs(smoothed.attention / one.attention - 1)) < 0.01


def test_rays_in_memory_and_in_a_file_are_one(rgb, tmp_path):
    v, f = box((0, 0, 0), (4, 3, 2.5))
    write_columns(tmp_path / "room.ply", dict(zip("xyz", v.T)), f)
    rays = Rays([0.0, 0.1], [0, 0], ("a",), np.ones((2, 3)), np.array([[1.0, 0, 0], [0, 1, 0]]), np.ones(2))
    rays.save(tmp_path / "a.npz")
    first = bake(tmp_path / "room.ply", rays=rays, max_edge=1.0)
    second = bake(str(tmp_path / "room.ply"), rays=str(tmp_path / "a.npz"), max_edge=1.0)
    assert np.array_equal(first.density, second.density)
