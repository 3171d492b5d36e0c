"""Reports on gaze fields."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError
from nerg_mi.evaluation.gaze_report import write_report
from nerg_mi.figures.style import make_provenance
from nerg_mi.files.atomic import file_sha256
from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.rays.rays import Rays
from nerg_mi.reports.data import MAX_PATH_POINTS
from nerg_mi.workflows import report
from nerg_mi.workflows.gaze_commands import GazeOptions
from nerg_mi.workflows.report import (
    RenderedViews,
    collect_paths,
    count_participants_near,
    describe_scene,
    draw_rays,
    draw_views,
    find_free_positions,
    gaze_vmax,
    make_report,
    panorama_positions,
    sort_files,
)
from nerg_mi.workflows.scene_commands import ReportOptions
from nerg_mi.workflows.train_gaze import train_gaze
from tests.evaluation.test_gaze import crowd
from tests.evaluation.test_gaze_report import scored
from tests.formats.splats.writers import random_splats, write_inria
from tests.refusals import mentions
from tests.reports.made import packed_scene
from tests.workflows.recorder import Recorder

# ---- The report as a job: from files to a page, without missing sections ----


SMALL = ReportOptions(width=24, spp=1, max_points=600, viewpoints=4, mode="llvm_ad_rgb")
NAMES = ("Ada", "Grace", "Mary", "Edsger")


@pytest.fixture(scope="module")
def run(trained, tmp_path_factory):
    """A folder with rays, a gaze field trained on them and their hit points, an evaluation and AOIs."""
    folder = tmp_path_factory.mktemp("run") / "files"
    shutil.copytree(trained, folder)
    rows = scored((0.9, 0.85, 0.3), reach=0.02)
    persons = [{"method": "gaze field", "person": "Ada", "rays": 9, "bits": 0.1}]
    metadata = {"gaze": "gaze.safetensors", "split": "both", "kappa": 20.0, "positions": 60, "people": 30}
    (folder / "gaze.eval").mkdir()
    write_report(folder / "gaze.eval", rows, persons, metadata, "# notes")
    wall = {"the wall": [[1.2, -0.5, 0.0], [1.8, 0.5, 2.2]], "nothing there": [[-9, -9, -9], [-8, -8, -8]]}
    (folder / "objects.json").write_text(json.dumps(wall))
    return folder


@pytest.fixture
def without_3d(monkeypatch):
    """Skip the 3D scene in tests that do not need it."""
    monkeypatch.setattr(report._ReportWork, "_stage", lambda *_: (None, (0, 0, 0, 0)))


def test_a_report_of_all_files_in_a_folder(run, tmp_path):
    recorder = Recorder()
    options = replace(SMALL, aois=run / "objects.json")
    result = make_report([run], tmp_path / "a.html", options, recorder)
    text = result.path.read_text(encoding="utf-8")
    assert (
        recorder.messages[0]
        == "Better than the nearest rays, the strongest baseline, for held-out participants at held-out positions."
        in text
    )
    assert recorder.messages[-1].startswith(f"wrote {tmp_path / 'a.html'} (") and len(text) < 6_000_000
    contents = result.run
    assert {"color", "own", "sphere", "plan", "layout"} <= set(contents.pictures)
    assert {role for role, *_ in contents.inputs} == {"gaze field", "hit points", "rays", "evaluation", "objects"}
    wall, unseen = contents.objects
    assert wall.recorded.mean > 0.5 and wall.num_could_see == wall.num_participants == 4 and wall.predicted.mean > 0
    assert unseen.predicted.mean == 0 and unseen.num_could_see == unseen.num_looked == 0
    scene = packed_scene(text)
    assert (
        100 < scene["count"] <= 600
        and len(scene["observers"]) == 6
        and contents.nearby_participants
        and min(contents.nearby_participants) >= 1
    )
    # There are no names, neither from rays nor from evaluations.
    assert not any(name in text for name in NAMES) and "participant 1" in text
    # The numbers of rays and participants of the gaze field, and all sources of the report.
    assert (
        re.fullmatch(r"data: [\d,]+ rays of [1-4] participants", contents.support_note)
        and text.count(contents.support_note) >= 2
    )
    made = json.loads(contents.provenance_json)
    assert made["what"] == "nerg report" and set(made["inputs"].values()) == {digest for *_, digest in contents.inputs}
    assert contents.provenance_json.encode("latin-1") in contents.pictures["own"].png and 'name="provenance"' in text


@pytest.mark.nightly
def test_equal_inputs_give_an_equal_report(run, tmp_path):
    files = [run / "gaze.safetensors", run / "rays.npz", run / "gaze.eval"]
    one = make_report(files, tmp_path / "a.html", SMALL).path.read_bytes()
    two = make_report(files[::-1], tmp_path / "b.html", SMALL).path.read_bytes()
    assert one == two and str(tmp_path).encode() not in one


def test_names_are_shown_only_on_request(run, tmp_path):
    options = replace(SMALL, show_names=True, paths=False)
    text = make_report([run], tmp_path / "a.html", options).path.read_text(encoding="utf-8")
    assert "Ada" in text and packed_scene(text)["paths"] == []


@pytest.fixture
def not_evaluated(run, tmp_path):
    """The folder ``run`` without its evaluation."""
    return shutil.copytree(run, tmp_path / "not evaluated", ignore=shutil.ignore_patterns("gaze.eval"))


def test_evaluation_next_to_the_gaze_field_is_used(without_3d, run, tmp_path):
    recorder, gaze = Recorder(), run / "gaze.safetensors"
    contents = make_report([gaze], tmp_path / "a.html", SMALL, recorder).run
    assert len(contents.results) == 1 and contents.results[0].num_positions == 60
    assert any(str(run / "gaze.eval" / "gaze.json") in text for text in recorder.messages)
    # An evaluation of an earlier checkpoint of that name.
    copy = shutil.copytree(run, tmp_path / "copy")
    data = json.loads((copy / "gaze.eval" / "gaze.json").read_text())
    for sha256, count in ((file_sha256(gaze), 1), ("0" * 64, 0)):
        (copy / "gaze.eval" / "gaze.json").write_text(json.dumps({**data, "gaze_sha256": sha256}))
        contents = make_report([copy / "gaze.safetensors"], tmp_path / "b.html", SMALL, recorder).run
        assert len(contents.results) == count
    assert any("trained again" in text for text in recorder.warnings)


def test_extrapolated_observers_are_reported_once(without_3d, run, tmp_path):
    """Of recorded positions, and the one that was chosen."""
    rays = Rays.load(run / "rays.npz")
    origin = rays.origin.copy()
    origin[::3, 1] += 99
    replace(rays, origin=origin).save(tmp_path / "moved.npz")
    cases = [(run / "rays.npz", None, 0), (tmp_path / "moved.npz", None, 1), (run / "rays.npz", (0.0, 99.0, 1.6), 1)]
    for file, observer, count in cases:
        recorder = Recorder()
        options = replace(SMALL, observer=observer, camera=(0.0, 0.0, 1.6), target=(1.5, 0.0, 1.0))
        make_report([run / "gaze.safetensors", file], tmp_path / "a.html", options, recorder)
        assert sum("extrapolated" in text for text in recorder.warnings) == count, (file, observer)
    # Also if no camera is found.
    recorder = Recorder()
    with pytest.raises(NergError, check=mentions("camera")):
        make_report(
            [run / "gaze.safetensors"], tmp_path / "a.html", replace(SMALL, observer=(0.0, 99.0, 1.6)), recorder
        )
    assert [("extrapolated" in text) for text in recorder.warnings] == [True]


def test_a_report_of_a_gaze_field_alone(not_evaluated, tmp_path):
    recorder = Recorder()
    result = make_report([not_evaluated / "gaze.safetensors"], tmp_path / "a.html", SMALL, recorder)
    text = result.path.read_text(encoding="utf-8")
    for sentence in (
        "No evaluation was given",
        "No gaze samples were given, so the report has no data-quality section. The field was trained on",
        "positions are unknown",
        "No AOIs were given. Name a file of AOIs.",
    ):
        assert sentence in text
    assert "there is no evaluation" in recorder.messages[0] and packed_scene(text)["marks"] == 1
    assert result.run.rays is None and result.run.results == ()


def test_a_report_of_objects_without_rays(without_3d, run, tmp_path):
    options = replace(SMALL, aois=run / "objects.json", observer=(-0.5, 0.0, 1.6))
    contents = make_report([run / "gaze.safetensors"], tmp_path / "a.html", options).run
    assert contents.objects[0].recorded is None and 0 < contents.objects[0].predicted.mean < 1
    assert "at the given position, (-0.50, 0.00, 1.60)" in contents.observer


def test_missing_evaluations_are_computed(without_3d, not_evaluated, tmp_path, monkeypatch):
    from nerg_mi.workflows import report

    splits = []
    evaluate = report.evaluate_gaze

    def quick(gaze, rays, output, job, reporter):
        splits.append(job.split)
        return evaluate(gaze, rays, output, replace(job, directions=64, resamples=2, min_rays=8), reporter)

    monkeypatch.setattr(report, "evaluate_gaze", quick)
    files = [not_evaluated / "gaze.safetensors", not_evaluated / "rays.npz"]
    contents = make_report(files, tmp_path / "a.html", replace(SMALL, evaluate=True)).run
    assert splits == ["pos"] and contents.results[0].rows[0]["method"] == "gaze field"
    assert contents.verdicts[0][1].grade == "none"  # of three positions
    with pytest.raises(NergError, check=mentions("evaluate")):
        make_report(files[:1], tmp_path / "a.html", replace(SMALL, evaluate=True))


def test_evaluations_of_another_field_are_refused_or_warned_about(without_3d, run, tmp_path):
    def evaluation(**changes):
        metadata = {"gaze": "gaze.safetensors", "split": "pos", "kappa": 20.0, "positions": 60, "people": 30}
        folder = tmp_path / f"e{len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        write_report(folder, scored((0.9, 0.85, 0.3)), [], {**metadata, **changes}, "# notes")
        return folder

    gaze = run / "gaze.safetensors"
    with pytest.raises(NergError, match="is an evaluation of a gaze field other than"):
        make_report([gaze, evaluation(gaze_sha256="ab")], tmp_path / "a.html", SMALL)
    with pytest.raises(NergError, match='"pos"'):
        make_report([gaze, evaluation(), evaluation()], tmp_path / "a.html", SMALL)
    contents = make_report([gaze, evaluation(gaze="other.safetensors")], tmp_path / "a.html", SMALL).run
    assert "a field named other.safetensors" in contents.warnings[0]


def test_a_report_without_geometry(tmp_path):
    job = GazeOptions(geometry="none", radius=0.5, probes=8, steps=2, directions=64, validation_zones=0, min_rays=8)
    crowd(600).save(tmp_path / "rays.npz")
    train_gaze(tmp_path / "rays.npz", tmp_path / "gaze.safetensors", job)
    (tmp_path / "objects.json").write_text('{"a": [[0, 0, 0], [1, 1, 1]]}')
    options = replace(SMALL, aois=tmp_path / "objects.json")
    result = make_report([tmp_path / "gaze.safetensors", tmp_path / "rays.npz"], tmp_path / "a.html", options)
    text = result.path.read_text(encoding="utf-8")
    assert "The 3D view needs the geometry" in text and result.run.objects == ()
    assert "AOIs need the geometry of the scene, which was not given." in text and "sphere" in result.run.pictures


@pytest.mark.nightly
def test_existing_images_are_not_rendered_again(run, tmp_path, monkeypatch):
    first, rendered = report.render_channels, {}

    def count_rendering(scene, sensor, *rest):
        made = first(scene, sensor, *rest)
        rendered[report.VIEWS[len(rendered)]] = made
        return made

    monkeypatch.setattr(report, "render_channels", count_rendering)
    one = make_report([run / "gaze.safetensors"], tmp_path / "a.html", SMALL).path.read_bytes()
    assert set(rendered) == set(report.VIEWS)

    def never(*_):
        raise AssertionError("rendered again")

    monkeypatch.setattr(report, "render_channels", never)
    two = make_report([run / "gaze.safetensors"], tmp_path / "b.html", SMALL, rendered=rendered).path.read_bytes()
    assert one == two


@pytest.mark.parametrize("name", ["report.pdf", "folder"])
def test_an_unwritable_output_is_refused_first(run, tmp_path, name):
    (tmp_path / "folder").mkdir()
    with pytest.raises(NergError):
        make_report([run], tmp_path / name, SMALL)


def test_damaged_rays_are_refused(run, tmp_path):
    (tmp_path / "rays.npz").write_bytes(b"PK\x03\x04 no")
    with pytest.raises(NergError, match=r"rays\.npz"):
        make_report([run / "gaze.safetensors", tmp_path / "rays.npz"], tmp_path / "a.html", SMALL)
    assert not (tmp_path / "a.html").exists()


# ---- Types of files, detected from their content: in any order, in folders, and unusable ones ----


@pytest.fixture(scope="module")
def folder(standins, tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    for file in standins.values():
        shutil.copy(file, folder)
    crowd(100).save(folder / "rays.npz")
    (folder / "gaze.eval").mkdir()
    (folder / "gaze.eval" / "gaze.json").write_text("{}")
    (folder / "notes.txt").write_text("nothing of ours")
    return folder


def test_files_are_sorted_in_any_order_and_in_folders(folder):
    files = [folder / n for n in ("shoppers.safetensors", "store.safetensors", "rays.npz", "gaze.eval")]
    for paths in (files, files[::-1], [folder], [*files[:2], files[2], files[3] / "gaze.json"]):
        sorted_files = sort_files(paths)
        assert (
            sorted_files.gaze == files[0]
            and sorted_files.scene.environment == files[1]
            and sorted_files.rays == files[2]
        )
        assert sorted_files.results == (files[3] / "gaze.json",) and sorted_files.scene.kind == "field"
        assert sorted_files.shown == [files[1], files[0]]


def test_inputs_have_their_checksums(folder):
    roles = {role: digest for role, _, digest in sort_files([folder]).inputs()}
    assert roles["rays"] == file_sha256(folder / "rays.npz") and roles["radiance field"] != roles["gaze field"]
    assert set(roles) == {"gaze field", "radiance field", "rays", "evaluation"}


def test_splats_are_described(folder, tmp_path):
    write_inria(tmp_path / "place.ply", random_splats(5))
    sorted_files = sort_files([folder / "shoppers.safetensors", tmp_path / "place.ply"])
    assert sorted_files.inputs()[1][0] == "splats" and describe_scene(sorted_files) == "Gaussian splats, place.ply."
    assert describe_scene(sort_files([folder])).startswith("A radiance field")


def test_files_that_make_no_report_are_refused(folder, tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    shutil.copy(folder / "shoppers.safetensors", tmp_path / "again.safetensors")
    cases = [
        ([folder / "rays.npz"], "there is none among these files; name its checkpoint"),
        ([folder / "nowhere"], "there is no file or folder"),
        ([empty], "contains no checkpoint, rays or evaluation"),
        ([folder, tmp_path / "again.safetensors"], "are both a gaze, and a report takes one"),
        ([folder, folder / "notes.txt"], "cannot be shown in a scene"),
    ]
    for paths, why in cases:
        with pytest.raises(NergError, match=why):
            sort_files(paths)


def test_duplicate_files_are_used_once(folder):
    assert sort_files([folder, folder / "shoppers.safetensors"]).gaze == folder / "shoppers.safetensors"
    assert json.loads((folder / "gaze.eval" / "gaze.json").read_text()) == {}


# ---- Pictures of a report: one scale, and no picture if there is nothing to show ----


def view(gaze, **aovs):
    gaze = np.broadcast_to(np.asarray(gaze, float), (32, 48))
    mask = np.ones((32, 48), bool)
    mask[:4] = False
    return SimpleNamespace(color=np.full((32, 48, 3), 0.3), aovs={"gaze": gaze, **aovs}, mask=mask)


def three(observer_value=0.5):
    return {"camera": view(0.2), "own": view(observer_value), "sphere": view(0.1)}


def drawn(seen, top=0.5, has_geometry=True, **fields):
    return draw_views(RenderedViews(seen, **fields), top, has_geometry, PROVENANCE)


PROVENANCE = make_provenance("nerg report", seed=7, settings={"width": 48})


def test_all_images_share_one_scale():
    assert gaze_vmax(three()) == pytest.approx(0.5)
    assert gaze_vmax({"camera": view(0.0)}) is None
    # Gaze does not count if there is no surface.
    assert gaze_vmax({"camera": view(np.where(np.arange(32)[:, None] < 4, 9.0, 0.0))}) is None


def test_images_depend_on_the_rendered_views():
    assert set(drawn(three())) == {"color", "gaze", "own", "sphere"}
    assert set(drawn(three(), has_geometry=False)) == {"own", "sphere"}
    assert set(drawn(three(), None)) == {"color"}
    spread = {**three(), "camera": view(0.2, gaze_std=np.full((32, 48), 0.05))}
    assert "spread" in drawn(spread, marker=(3.0, 4.0))


def test_images_are_reproducible_png_files_with_captions():
    one, two = (drawn(three(), marker=(3.0, 4.0)) for _ in range(2))
    for name, picture in one.items():
        assert picture.png.startswith(b"\x89PNG") and picture.png == two[name].png
        assert picture.alt.endswith(".") and picture.caption.endswith(".")


def test_each_image_records_its_provenance():
    every = drawn(three()) | draw_rays(crowd(300), None, PROVENANCE)
    assert set(every) == {"color", "gaze", "own", "sphere", "plan", "layout"}
    for name, picture in every.items():
        assert PROVENANCE.json().encode("latin-1") in picture.png, name


def hatched(pictures, name):
    """Number of grey pixels in the picture; the colours of the scene and of gaze are not grey."""
    return sum(1 for row in pixels(pictures[name].png) for p in row if p.max() - p.min() < 3 and 60 < p.max() < 240)


def pixels(png):
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    stream = mi.MemoryStream()
    stream.write(png)
    stream.seek(0)
    return np.array(mi.Bitmap(stream).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)).astype(
        int
    )


@pytest.mark.parametrize("name", ["gaze", "own", "sphere"])
def test_unknown_gaze_is_hatched(name):
    """More pixels are hatched where no participant was recorded near the observer."""
    every = {k: view(0.3) for k in ("camera", "own", "sphere")}
    for seen in every.values():
        seen.color[...] = (0.6, 0.1, 0.1)
    supported, alone = (hatched(drawn(every, supported=s), name) for s in (True, False))
    assert alone > 1.5 * supported > 0


def test_the_basis_of_the_gaze_is_printed():
    plain, with_basis = (drawn(three(), basis=b) for b in ("", "made of 300 rays of 3 participants"))
    for name in ("gaze", "own", "sphere"):
        a, b = (pixels(p[name].png) for p in (plain, with_basis))
        # One more line below the picture.
        assert b.shape[0] > a.shape[0] and b.shape[1] == a.shape[1]
        assert (b[-16:] < 128).any() and b[-16:].shape == (16, *b.shape[1:])


def test_floor_plans_are_drawn():
    plans = draw_rays(crowd(300), {"centres": [[-0.5, 0, 1.6]], "radius": 0.5}, PROVENANCE)
    assert set(plans) == {"plan", "layout"} and "held-out" in plans["layout"].caption
    assert "held-out" not in draw_rays(crowd(300), None, PROVENANCE)["layout"].caption


# ---- Viewpoints of a report, and paths of participants ----


BOX = Box((0.0, 0.0, 0.0), (8.0, 6.0, 3.0))
PLACE = Environment(None, BOX, "none")


class Walls:
    """A gaze sampler in a box with a block in its middle."""

    BLOCK = np.array([[3.0, 2.0, 0.0], [5.0, 4.0, 3.0]])

    def trace(self, o, d):
        low, high = np.array(BOX.lower), np.array(BOX.upper)
        with np.errstate(divide="ignore", invalid="ignore"):
            out = np.where(d == 0, np.inf, np.where(d > 0, (high - o) / d, (low - o) / d)).min(axis=1)
            a, b = ((c - o) / d for c in self.BLOCK)
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        within = (near < far) & (far > 0)
        return np.where(within, np.maximum(near, 0), out), np.ones(len(o), bool)


def walkers(count=4, n=400):
    """Participants who walk along x for n steps of 2 cm, ten per second."""
    t = np.tile(np.arange(n) * 0.1, count)
    person = np.repeat(np.arange(count), n)
    origin = np.stack([np.tile(np.arange(n) * 0.02, count), 1.0 + person, np.full(n * count, 1.6)], axis=1)
    ahead = np.tile([1.0, 0, 0], (n * count, 1))
    return Rays(t, person, tuple("abcdefgh"[:count]), origin, ahead, np.ones(n * count))


def test_free_positions_are_inside_the_room_and_outside_the_block():
    positions = find_free_positions(
        Walls(), (np.zeros(3), np.array([8.0, 6, 3])), np.array([0.0, 0, 1]), np.array([1.0, 1, 1.6])
    )
    assert len(positions) > 30 and np.allclose(positions[:, 2], 1.6)
    inside = ((positions[:, :2] > [2.9, 1.9]) & (positions[:, :2] < [5.1, 4.1])).all(axis=1)
    assert not inside.any() and (positions > 0.1).all() and (positions[:, 0] < 7.9).all()


def test_panoramas_start_at_the_observer():
    standing = np.stack([np.linspace(0, 8, 50), np.zeros(50), np.full(50, 1.6)], axis=1)
    positions = panorama_positions(standing, np.array([4.0, 0, 1.6]), 3)
    assert np.allclose(positions, [[4, 0, 1.6], [0, 0, 1.6], [8, 0, 1.6]]) or np.allclose(
        positions, [[4, 0, 1.6], [8, 0, 1.6], [0, 0, 1.6]]
    )
    assert len(panorama_positions(standing[:0], np.zeros(3))) == 1


def test_participants_nearby_are_counted_instead_of_rays():
    rays = walkers()
    positions = np.array([[2.0, 1.0, 1.6], [2.0, 1.5, 1.6], [2.0, 9.0, 1.6]])
    assert count_participants_near(rays, positions, PLACE, 0.55) == (1, 2, 0)
    # In a scene with another unit the radius is still in metres.
    scaled = replace(PLACE, align=Similarity(np.diag([0.1, 0.1, 0.1, 1.0])))
    assert count_participants_near(rays, 0.1 * positions, scaled, 0.55) == (1, 2, 0)


def test_paths_follow_participants_with_gaps():
    rays = walkers(2)
    gap = rays.select(~((rays.person == 0) & (rays.t > 10) & (rays.t < 14)))
    paths = collect_paths(gap, PLACE)
    assert len(paths) == 3
    for path in paths:
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        assert (steps < 0.2).all() and (steps[1:] > 0.1).all() and np.ptp(path[:, 1]) == 0
    assert max(path[:, 0].max() for path in paths) == pytest.approx(7.98, abs=0.16)


def test_a_standing_participant_has_no_path():
    rays = walkers(1)
    assert collect_paths(replace(rays, origin=np.tile([1.0, 1, 1.6], (len(rays), 1))), PLACE) == []


def test_paths_are_limited_in_size():
    rays = walkers(8, 40_000)
    paths = collect_paths(rays, PLACE)
    assert 0 < sum(map(len, paths)) <= MAX_PATH_POINTS and all(len(p) > 1 for p in paths)
