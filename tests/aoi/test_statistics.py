"""`nerg stats` from its files to its tables, against loops over rays."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.aoi import measured
from nerg_mi.aoi import statistics as module
from nerg_mi.aoi.settings import AoiSampling, TrackerError, VisitRules
from nerg_mi.aoi.statistics import statistics
from nerg_mi.aoi.tables import MAX_COMPARED_VALUES
from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.fields import load_gaze, save_gaze
from nerg_mi.maths.geometry import Similarity
from nerg_mi.tracking.rays import Rays
from tests.aoi.place import SIGN, first_box, people, write_place
from tests.formats.test_boxes import write_twin
from tests.recorder import Recorder
from tests.refusals import mentions

SAMPLING = AoiSampling(directions=512, aoi_samples=12)
FAST = {"resamples": 199, "viewpoints": 12, "sampling": SAMPLING}
NARROW = {**FAST, "sampling": replace(SAMPLING, margin=0.001)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("place")
    write_place(made)
    write_place(made / "bare" if (made / "bare").mkdir() is None else made, gaze=False)
    people().save(made / "rays.npz")
    return made


def table(rows, **which):
    return [r for r in rows if all(r[k] == v for k, v in which.items())]


def test01_statistics_match_a_loop_over_rays(folder):
    result = statistics(
        [folder / "bare" / "scene.xml", folder / "rays.npz"],
        folder / "areas.json",
        rules=VisitRules(min_visit=0.0),
        **NARROW,
    )
    rays = people()
    hits = [first_box(o, d) for o, d in zip(rays.origin, rays.direction)]
    for name, kinds in (("the sign", {"sign"}), ("the stand", {"stand"}), ("both", {"sign", "stand"})):
        on = np.array([kind in kinds for kind, _ in hits])
        shares = [on[rays.person == p].mean() for p in range(6)]
        (row,) = table(result.aois, cell="all", aoi=name)
        assert row["source"] == "measured" and row["participants"] == 6
        assert row["share"] == pytest.approx(np.mean(shares)) and row["hit_ratio"] == np.mean([s > 0 for s in shares])
        # Each ray represents 0.2 s, including the last one.
        assert row["dwell"] == pytest.approx(16 * np.mean(shares))
        far = np.array([at for _, at in hits])
        assert row["distance"] == pytest.approx(far[on].mean(), rel=1e-5)
        # Hits separated by at least one ray are two visits, because the gap is at least 0.2 s.
        visits = firsts = 0.0
        reached = 0
        for p in range(6):
            indices = np.flatnonzero(rays.person == p)
            indices = indices[np.argsort(rays.t[indices])]
            seen = on[indices]
            visits += (seen & ~np.r_[False, seen[:-1]]).sum()
            firsts += 0.2 * np.argmax(seen) if seen.any() else 0
            reached += seen.any()
        assert row["visits"] == pytest.approx(visits / 6) and row["time_to_first_visit"] == pytest.approx(
            firsts / reached
        )
        for cohort, code in (("even", 0), ("odd", 1)):
            (row,) = table(result.aois, cell="cohort", value=cohort, aoi=name)
            mine = [s for p, s in enumerate(shares) if p % 2 == code]
            assert row["share"] == pytest.approx(np.mean(mine)) and row["participants"] == 3
    assert {r["cell"] for r in result.differences} == {"cohort"}
    assert sum(r["transitions"] for r in result.transitions if r["cell"] == "all") > 5


def test02_visible_aois_include_visited_aois(folder):
    options = {**FAST, "sampling": replace(SAMPLING, cell_size=0.05)}
    files = [folder / "bare" / "scene.xml", people()]
    result = statistics(files, folder / "areas.json", aoi_visibility=True, **options)
    (sign,) = table(result.aois, cell="all", aoi="the sign")
    (stand,) = table(result.aois, cell="all", aoi="the stand")
    assert 0.05 < sign["share"] < sign["visible"] < stand["visible"] < 1
    sums = result.sums
    assert (sums.dwell_time <= sums.visible_time + 1e-9).all()
    rows = sums.find_participants(sums.cells[0])[0]
    on, could = sums.dwell_time[rows, 0].sum(), sums.visible_time[rows, 0].sum()
    assert sign["share_when_visible"] == pytest.approx(on / could)


def test03_windows_zones_and_cohorts_are_read_from_a_file(folder, tmp_path):
    (tmp_path / "zones.json").write_text(json.dumps({"south": [[0, 0, 0], [6, 2, 0.1]]}))
    (tmp_path / "cohorts.csv").write_text("person,cohort\n" + "".join(f"name {k},{'xy'[k // 3]}\n" for k in range(6)))
    rays, recorder = people(), Recorder()
    result = statistics(
        [folder / "bare" / "scene.xml", rays],
        folder / "areas.json",
        zones=tmp_path / "zones.json",
        cohorts=tmp_path / "cohorts.csv",
        windows={"early": (0, 8), "late": (8, 100), "never": (1e6, 2e6)},
        progress=recorder,
        **NARROW,
    )
    assert [text for text in recorder.messages if "no participants in the window never" in text]
    on = np.array([first_box(o, d)[0] == "sign" for o, d in zip(rays.origin, rays.direction)])
    masks = {
        ("window", "early"): rays.t < 8,
        ("window", "late"): rays.t >= 8,
        ("zone", "south"): rays.origin[:, 1] <= 2,
        ("cohort", "x"): rays.person < 3,
    }
    for (cell, value), mask in masks.items():
        (row,) = table(result.aois, cell=cell, value=value, aoi="the sign")
        mine = [on[mask & (rays.person == p)].mean() for p in np.unique(rays.person[mask])]
        assert row["share"] == pytest.approx(np.mean(mine)), (cell, value)
    assert {r["cell"] for r in result.differences} == {"window", "cohort"}


def test_values_that_are_not_compared_are_named(folder):
    recorder = Recorder()
    windows = {f"w{k}": (k, k + 1) for k in range(MAX_COMPARED_VALUES + 1)}
    scene = folder / "bare" / "scene.xml"
    result = statistics([scene, people()], folder / "areas.json", windows=windows, progress=recorder, **NARROW)
    last = f"w{MAX_COMPARED_VALUES}"
    assert [text for text in recorder.warnings if f'"{last}"' in text]
    assert last not in {row[key] for row in result.differences for key in ("first", "second")}


def test_the_seed_sets_all_intervals(folder, tmp_path, monkeypatch):
    """Equal seeds give equal intervals, in all tables; other seeds give other ones."""
    scene = folder / "bare" / "scene.xml"
    monkeypatch.setattr(module, "power_rows", lambda *args, seed: [{"seed": seed}])
    run = lambda seed: statistics([scene, people()], folder / "areas.json", seed=seed, power=0.5, **FAST)
    one, again, other = run(1), run(1), run(2)
    for name, columns in (("aois", "share_low"), ("differences", "low")):
        values = [[row[columns] for row in getattr(result, name)] for result in (one, again, other)]
        assert values[0] == values[1] != values[2], name
    assert [result.power for result in (one, other)] == [[{"seed": 1}], [{"seed": 2}]]


def test_power_is_a_table_of_the_output(folder, tmp_path):
    scene = folder / "bare" / "scene.xml"
    result = statistics([scene, people()], folder / "areas.json", power=0.5, **FAST)
    files = result.save(tmp_path / "out")
    (row,) = table(result.power, aoi="the sign", measure="share")
    assert (row["cell"], row["effect"]) == ("cohort", 0.5) and 0 <= row["power_8"] <= row["power_96"] <= 1
    assert {tmp_path / "out" / "power.csv", tmp_path / "out" / "power.md"} <= set(files)
    assert "power_96" in (tmp_path / "out" / "power.md").read_text()
    with pytest.raises(NergError, check=mentions("power")):
        statistics([scene], folder / "areas.json", power=0.5, **FAST)


def test04_predicted_and_recorded_statistics_and_what_if(folder, tmp_path):
    changes = {
        "move": [{"shape": "stand", "by": [0, 1.9, 0]}],
        "add": [{"name": "new", "min": [1, 3.5, 1], "max": [2, 3.8, 2]}, {"name": "tile", "mesh": "tile.obj"}],
    }
    (folder / "tile.obj").write_text("usemtl red\nv 5.9 0 0\nv 5.9 1 0\nv 5.9 0 1\nf 1 2 3\n")
    (folder / "changes.json").write_text(json.dumps(changes))
    recorder, options = Recorder(), {"what_if": folder / "changes.json", **FAST}
    files = [folder / "scene.xml", folder / "rays.npz"]
    result = statistics(files, folder / "areas.json", progress=recorder, **options)
    files = result.save(tmp_path / "out")
    assert {"changes.json", "tile.obj"} <= set(result.provenance.inputs)
    # A shape that is an AOI keeps its name in the scene.
    assert result.what_if
    field = table(result.aois, cell="all", source="predicted")
    assert len(field) == 3 and all(0 < r["share"] < 1 and r["visits"] is None for r in field)
    assert field[2]["share"] == pytest.approx(field[0]["share"] + field[1]["share"], rel=0.02)
    rows = {(r["aoi"], r["measure"]): r for r in result.what_if}
    # A field predicts no visits: differences are those of the recordings.
    assert any(r["difference"] is not None for r in table(result.differences, measure="visits"))
    # The stand occluded the sign.
    sign = rows["the sign", "visible"]
    assert sign["source"] == "predicted" and sign["after"] > sign["before"] and sign["participants"] == 6
    assert rows["new", "share"]["before"] is None and rows["new", "share"]["after"] > 0
    assert rows["the sign", "share"]["after"] != rows["the sign", "share"]["before"]
    assert recorder.messages.count(f"of {folder / 'tile.obj'}: unused statements: usemtl") == 1
    # Its checkpoint has no training provenance.
    assert (
        any("does not contain training support" in text for text in recorder.messages) and field[0]["support"] is None
    )
    assert "not in the checkpoint" in (tmp_path / "out" / "what_if.md").read_text()
    names = {p.name for p in files}
    assert {"aois.csv", "aois.md", "what_if.csv", "aois.png", "about.json", "participants.csv"} <= names
    assert all(p.is_file() for p in files)
    with (tmp_path / "out" / "aois.csv").open() as file:
        first = next(csv.DictReader(file))
    assert float(first["share"]) == result.aois[0]["share"] and first["aoi"] == "the sign"  # noqa: RUF069 (stored)
    text = "".join(p.read_text() for p in files if p.suffix in (".csv", ".md", ".json"))
    assert "name 0" not in text


def test05_names_salts_and_a_minimum_of_participants(folder, tmp_path):
    files = [folder / "bare" / "scene.xml", people()]
    (tmp_path / "salt").write_bytes(b"0123456789abcdef")
    areas = folder / "areas.json"
    one, two = (statistics(files, areas, salt=tmp_path / "salt", **FAST).participants for _ in range(2))
    assert list(one) == list(two) and all(r["participant"].startswith("p") and len(r["participant"]) == 17 for r in one)
    named = statistics(files, areas, show_names=True, **FAST)
    assert {r["participant"] for r in named.participants} == {f"name {k}" for k in range(6)}
    result = statistics(files, areas, min_participants=5, **FAST)
    assert not result.participants and result.num_suppressed > 0
    assert all(r["share"] is None for r in table(result.aois, cell="cohort")) and result.aois[0]["share"] is not None


def test06_one_participant_has_no_interval_and_a_warning(folder):
    recorder = Recorder()
    one = people(1, cohorts=False)
    files = [folder / "bare" / "scene.xml", one]
    result = statistics(files, folder / "areas.json", progress=recorder, **FAST)
    assert result.aois[0]["share"] is not None and result.aois[0]["share_low"] is None
    assert any("no confidence intervals" in text and "fewer than 3 participants" in text for text in recorder.messages)


def test07_statistics_without_geometry(folder):
    recorder = Recorder()
    (folder / "boxes.json").write_text(
        json.dumps({"sign": [[4, 1.5, 1], [4.2, 2.5, 2]], "far": [[5, 0, 0], [6, 4, 3]], "tile": {"mesh": "tile.obj"}})
    )
    (folder / "tile.obj").write_text("usemtl red\nv 5.9 0 0\nv 5.9 1 0\nv 5.9 0 1\nf 1 2 3\n")
    rays = people()
    statistics(rays, folder / "boxes.json", progress=recorder, **FAST)
    assert any("AOIs occlude each other" in text for text in recorder.messages)
    assert recorder.messages.count(f"of {folder / 'tile.obj'}: unused statements: usemtl") == 1
    hit = np.array([o + first_box(o, d)[1] * d for o, d in zip(rays.origin, rays.direction)])
    recorder = Recorder()
    with_hits = Rays(rays.t, rays.person, rays.persons, rays.origin, rays.direction, rays.confidence, hit)
    result = statistics(with_hits, folder / "boxes.json", progress=recorder, **FAST)
    assert any("hit points" in text for text in recorder.messages)
    on = np.array([first_box(o, d)[0] == "sign" for o, d in zip(rays.origin, rays.direction)])
    expected = np.mean([on[rays.person == p].mean() for p in range(6)])
    assert result.aois[0]["share"] == pytest.approx(expected, abs=0.01)


def test08_a_scene_alone_has_no_observers(folder):
    with pytest.raises(NergError, match="there are no observers: give rays or a gaze"):
        statistics(folder / "bare" / "scene.xml", folder / "areas.json", **FAST)


def test09_predicted_observers_without_tracking(folder):
    eyes = np.array([(5.5, 1.5, 1.6), (5.5, 3.5, 1.6), (5.5, 0.5, 1.6)])
    result = statistics(folder / "scene.xml", folder / "areas.json", observers=eyes, **FAST)
    assert {r["source"] for r in result.aois} == {"predicted"} and result.aois[0]["participants"] == 3
    # They may face any direction.
    assert [r["visible"] for r in result.aois] == pytest.approx([1, 1, 1])


def test10_datasets_give_the_statistics_of_files(folder, tmp_path):
    pytest.importorskip("pyarrow")
    rays = people()
    lines = ["t,p,x,y,z,a,b,c"]
    for k in range(len(rays)):
        lines.append(",".join(map(repr, [float(rays.t[k]), *rays.origin[k].tolist(), *rays.direction[k].tolist()])))
        lines[-1] = lines[-1].replace(",", f",{rays.persons[rays.person[k]]},", 1)
    (tmp_path / "day.csv").write_text("\n".join(lines))
    import nerg_mi as nerg

    columns = "origin=x,y,z direction=a,b,c t=t person=p"
    nerg.import_rays(tmp_path / "day.csv", columns=columns, output=tmp_path / "day.rays")
    scene, areas = folder / "bare" / "scene.xml", folder / "areas.json"
    a = statistics([scene, tmp_path / "day.rays"], areas, **FAST).aois
    b = statistics([scene, nerg.import_rays(tmp_path / "day.csv", columns=columns)], areas, **FAST).aois
    # A dataset stores origins in single precision.
    assert [r["share"] for r in a] == pytest.approx([r["share"] for r in b], abs=0.01)


@pytest.mark.parametrize(
    ("names", "options", "said"),
    [
        ([], {}, "give rays"),
        (["rays.npz", "rays.npz"], {}, "are both rays"),
        (["rays.npz"], {"aois": None}, "aois"),
        (["rays.npz"], {"windows": {"x": (1,)}}, "window"),
        (["rays.npz"], {"windows": {"x": (2, 1)}}, "window"),
        (["bare/scene.xml", "rays.npz"], {"what_if": "changes"}, "gaze field"),
        (["scene.xml"], {"observers": [(1, 2)]}, "observer"),
        (["rays.npz"], {}, 'no shape "stand"'),
        (["rays.npz"], {"viewpoints": 0}, "viewpoints must lie in"),
        (["rays.npz", "areas.json"], {}, "aois"),
        (["scene.xml", "rays.npz"], {"what_if": "changes"}, "is not one of move, remove, add, swap,"),
    ],
)
def test11_impossible_requests_are_refused(folder, names, options, said):
    made = {"aois": folder / "areas.json", **FAST, **options}
    if "what_if" in options:
        made["what_if"] = folder / "areas.json"
    with pytest.raises(NergError, match=said):
        statistics([folder / name for name in names], **made)


def test_directions_of_heads_are_named(folder):
    recorder = Recorder()
    statistics(
        [folder / "bare" / "scene.xml", people().with_tracking("head")],
        folder / "areas.json",
        progress=recorder,
        **FAST,
    )
    assert any("heads" in text for text in recorder.messages)


@pytest.mark.parametrize("kind", ["head", "eye"])
def test_predictions_of_a_field_of_heads_are_named(folder, tmp_path, kind):
    gaze, recorder = tmp_path / "gaze.safetensors", Recorder()
    field, _ = load_gaze(folder / "gaze.safetensors", namespace("llvm_ad_rgb"))
    save_gaze(field, gaze, {"rays": 9, "tracking": kind})
    options = {"observers": [(1, 1.5, 1.6)], "progress": recorder, **FAST}
    statistics([folder / "bare" / "scene.xml", gaze], folder / "areas.json", **options)
    assert any("heads" in text for text in recorder.warnings + recorder.messages) == (kind == "head")


def test_all_files_are_recorded_with_their_checksums(folder, tmp_path):
    write_twin(tmp_path / "twin")
    (tmp_path / "align.json").write_text(json.dumps(np.eye(4).tolist()))
    (tmp_path / "cohorts.csv").write_text("person,cohort\nname 0,x\nname 1,y\n")
    (tmp_path / "validation.csv").write_text("person,accuracy,precision\nname 0,1,0.5\nname 1,1,0.5\n")
    (tmp_path / "zones.json").write_text(json.dumps({"south": [[0, 0, 0], [6, 2, 0.1]]}))
    options = {name: tmp_path / f"{name}.csv" for name in ("cohorts", "validation")}
    options |= {name: tmp_path / f"{name}.json" for name in ("align", "zones")}
    result = statistics(people(2, 20), tmp_path / "twin", error=TrackerError(draws=2), **options, **FAST)
    files = [*options.values(), *(tmp_path / "twin").iterdir()]
    assert result.provenance.inputs == {path.name: file_sha256(path) for path in files}


def test_the_alignment_of_an_environment_in_memory_is_kept(folder):
    aligned = replace(Environment.open(folder / "bare" / "scene.xml"), align=Similarity(np.diag([2.0, 2, 2, 1])))
    rays = people(2, 20)
    halved = replace(rays, origin=rays.origin / 2)
    result = statistics([aligned, halved], folder / "areas.json", **FAST)
    expected = statistics([folder / "bare" / "scene.xml", rays], folder / "areas.json", **FAST)
    assert result.aois[0]["share"] == pytest.approx(expected.aois[0]["share"]) and result.aois[0]["share"] > 0
    # Parts get it, too.
    assert result.provenance.settings["align"] == aligned.align.matrix.tolist()


def test_all_rays_decide_what_is_reported_of_them(folder, monkeypatch):
    # A block of each participant.
    monkeypatch.setattr(measured.iter_blocks, "__defaults__", (10,))
    rays, recorder = people(2, 20), Recorder()
    hit = np.where(rays.person[:, None] == 1, rays.origin + 9 * rays.direction, np.nan)
    tracking = {"tracking": "mixed", "tracking_by_person": {"name 0": "eye", "name 1": "head"}}
    mixed = replace(rays, hit=hit, metadata=rays.metadata | tracking)
    statistics(mixed, {"sign": SIGN}, progress=recorder, **FAST)
    assert any("heads" in text for text in recorder.messages) and any(
        "hit points" in text for text in recorder.messages
    )
