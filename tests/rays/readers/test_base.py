"""Tests of `nerg_mi.rays.readers.base`."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.quality import make_quality_report, summarise
from nerg_mi.rays.rays import FRAME, Rays
from nerg_mi.rays.readers import base as builder_module
from nerg_mi.rays.readers import registry
from nerg_mi.rays.readers.base import (
    UNITY,
    UPS,
    NoOptions,
    RaysBuilder,
    TickOption,
    TrackingFrame,
    option,
    list_options,
    recorded_options,
)
from tests.rays.readers.examples import EXAMPLES, dropped

# ---- The account of what an import leaves out ----


def begun(tmp_path, *frame, text="x", **how) -> RaysBuilder:
    """A builder that has begun a file."""
    (tmp_path / "a.csv").write_text(text)
    builder = RaysBuilder(*frame, **how)
    builder.source(tmp_path / "a.csv")
    return builder


def add(builder, n, gone=(), first=1):
    origin = np.zeros((n, 3))
    origin[list(gone)] = np.nan
    builder.add(np.arange(n) * 0.1, "ann", origin, np.tile([1.0, 0, 0], (n, 1)), rows=np.arange(first, first + n))


def test_more_runs_than_are_named(tmp_path, monkeypatch):
    """Every other row is a blink: their number is exact, and the file can be read again."""
    monkeypatch.setattr(builder_module, "NAMED_RUNS", 10)
    builder = begun(tmp_path)
    add(builder, 14, [0, 1, 4, 6, 8, 10])
    add(builder, 14, [0, 2, 4, 6, 8, 10, 11], first=15)
    rays = builder.build()
    (lost,) = rays.metadata["dropped"]
    assert lost["count"] == 13 and len(lost["rows"]) == 10 and lost["rows"][0] == [1, 2]
    assert lost["rows_not_named"] == 13 - sum(b - a + 1 for a, b in lost["rows"]) > 0
    rays.save(tmp_path / "r.npz")
    assert Rays.load(tmp_path / "r.npz").metadata == rays.metadata


def test_bad_lines_are_bounded_by_file(tmp_path):
    """The lines of one file do not make up for those of another."""
    for name in "abc":
        (tmp_path / name).write_text("x")
    builder = RaysBuilder(skip_bad_lines=True)
    builder.source(tmp_path / "a")
    add(builder, 1000)
    builder.source(tmp_path / "b")
    add(builder, 198)
    for line in (3, 4):
        builder.on_bad(line, ": 2 cells")
    builder.source(tmp_path / "c")
    add(builder, 100)
    for line in (7, 8):
        builder.on_bad(line, ": 2 cells")
    with pytest.raises(NergError, match="2.*102.*1.*7.*2"):
        builder.build()
    assert RaysBuilder().on_bad is None


def test_checksums_are_computed_at_the_end_of_a_file(tmp_path, monkeypatch):
    """What is refused while it is read was not read to its end before."""
    summed = []
    monkeypatch.setattr(builder_module, "file_sha256", lambda path: summed.append(path.name) or f"of {path.name}")
    builder = RaysBuilder()
    for name in "ab":
        (tmp_path / name).write_text("x")
    builder.source(tmp_path / "a", "ann/a")
    add(builder, 3)
    assert summed == []
    builder.source(tmp_path / "b")
    assert summed == ["a"]
    add(builder, 3)
    with (tmp_path / "c").open("wb") as out:
        out.truncate(64 << 30)
    with pytest.raises(NergError, match="68,719,476,736.*17,179,869,184"):
        builder.source(tmp_path / "c")
    assert builder.build().metadata["sources"] == [{"file": "ann/a", "sha256": "of a"}, {"file": "b", "sha256": "of b"}]


def test_a_file_of_another_kind_ends_early(tmp_path):
    builder = begun(tmp_path, skip_bad_lines=True)
    with pytest.raises(NergError, match="lines cannot be read"):
        for line in range(1, 10**6):
            builder.on_bad(line, ": 1 cells")
    assert line < 20_000


def test_lines_of_a_whole_table_count(tmp_path):
    """Two bad ones of three hundred are few, though none gives a ray."""
    builder = begun(tmp_path, text="t,x\n" + "1,2\n" * 300 + "1\n\n3\n", skip_bad_lines=True)
    assert builder.read_whole(tmp_path / "a.csv", ["x", "t"]).shape == (300, 2)
    (tmp_path / "b.csv").write_text("x")
    builder.source(tmp_path / "b.csv")
    add(builder, 1)
    assert dropped(builder.build()).popitem()[1] == [[302, 302], [304, 304]]


def test_builder_drops_with_an_account(tmp_path):
    d = np.tile([0.0, 0.0, 2.0], (6, 1))
    d[1], d[2], d[4] = 0, np.nan, 0
    builder = begun(tmp_path, TrackingFrame(units="cm"))
    builder.note(preset="made up")
    builder.add(np.arange(6.0), "ann", np.full((6, 3), 100.0), d, rows=np.arange(2, 8), drop={"late": np.arange(6) > 4})
    rays = builder.build()
    assert len(rays) == 2 and np.allclose(rays.direction, [0, 0, 1]) and np.allclose(rays.origin, 1)
    assert rays.metadata["frame"] == FRAME and rays.metadata["rows_read"] == 6 and rays.metadata["preset"] == "made up"
    assert dropped(rays) == {"late": [[7, 7]], "direction is missing": [[4, 4]], "direction is zero": [[3, 3], [6, 6]]}
    assert rays.metadata["sources"][0]["file"] == "a.csv" and len(rays.metadata["sources"][0]["sha256"]) == 64


@pytest.mark.parametrize("far", [1.1e9, -1e38, 1e200, 1e308])
def test_points_beyond_all_places_are_accounted_for(far):
    """The bound is in metres, of what files have in centimetres."""
    builder, points, d = (
        RaysBuilder(TrackingFrame(units="cm")),
        np.full((3, 3), 100.0),
        np.tile([0.0, 0.0, 1.0], (3, 1)),
    )
    hits = points.copy()
    points[1, 2], hits[2, 0] = far, far
    builder.add(np.arange(3.0), "ann", points, d, rows=np.arange(3), hit=hits)
    rays = builder.build()
    assert [(d["reason"], d["rows"]) for d in rays.metadata["dropped"]] == [("origin is beyond 1e+07 m", [[1, 1]])]
    assert np.isnan(rays.hit).all(axis=1).tolist() == [False, True]
    assert rays.metadata["missing"] == {"hit points beyond 1e+07 m": 1}


def test_builder_with_nothing_left():
    builder = RaysBuilder()
    builder.add(np.zeros(2), "ann", np.zeros((2, 3)), np.zeros((2, 3)), rows=np.arange(2))
    with pytest.raises(NergError, match="no ray is left of 2 rows .*direction is zero"):
        builder.build()


def test_rays_are_taken_out_of_the_frame(tmp_path):
    """Mirrored, in centimetres; each source is told as it is begun."""
    names = []
    builder = begun(tmp_path, TrackingFrame(UNITY.up, UNITY.handedness, "cm"), on_source=names.append)
    point, ahead = np.array([[100.0, 160.0, 300.0]]), np.array([[0.0, 0.0, 5.0]])
    builder.add(np.zeros(1), "ann", point, ahead, rows=np.ones(1, int), hit=point + 100 * ahead)
    rays = builder.build()
    assert np.allclose(rays.origin, [1, 3, 1.6]) and np.allclose(rays.direction, [0, 1, 0])
    assert np.allclose(rays.hit, [1, 8, 1.6]) and names == ["a.csv"]


def test_complaints_are_kept_once_and_stand_on_the_card(tmp_path):
    builder = begun(tmp_path)
    builder.add(np.arange(3.0), "ann", np.eye(3), np.eye(3), rows=np.arange(3))
    for sentence in ("one", "two", "one"):
        builder.complain(sentence)
    rays = builder.build()
    assert rays.metadata["complaints"] == ["one", "two"] and summarise(rays).warnings[:2] == ("one", "two")


def test_heads_and_eyes():
    """Where heads point in the frame of rays; how far the eyes are apart, in metres, one number a person."""
    builder, ones = RaysBuilder(TrackingFrame(up="y", handedness="left", units="cm")), np.ones((5, 3))
    heads = np.array([[0, 0, 2.0], [0, 5, 0], [0, 0, 0], [np.nan, 0, 1]])
    gone = np.array([[1.0, 1, 1], [np.nan] * 3, [1, 1, 1], [1, 1, 1]])
    builder.add(np.arange(4), ["bo", "bo", "ann", "ann"], gone, ones[:4], rows=np.arange(4), head=heads)
    eyes = np.array([6.0, 7.0, np.nan, 6.2, 6.4])
    builder.add(np.arange(5), ["bo", "bo", "bo", "ann", "bo"], ones, ones, rows=np.arange(4, 9), eye_distance=eyes)
    rays = builder.build()
    assert np.allclose(rays.head[0], [0, 1, 0]) and np.isnan(rays.head[1:]).all() and len(rays.head) == 8
    assert rays.metadata["eye_distance"] == {"ann": 0.062, "bo": 0.064}


def test_rays_are_handed_over_as_they_come(monkeypatch):
    """In blocks, whose rows are together those that are built at once; the metadata come with the last."""
    monkeypatch.setattr("nerg_mi.rays.readers.base.STREAMED", 30)
    taken: list = []

    def added(builder):
        for k in range(7):
            t = np.arange(10.0) + 10 * k
            t[3] = np.nan
            ahead = np.tile([1.0, 0.0, 0.0], (10, 1))
            builder.add(t, ["bo", "ann"] * 5, ahead, ahead, rows=np.arange(10) + 10 * k, cohort=["x"] * 10)
        return builder.build()

    whole, last = added(RaysBuilder()), added(RaysBuilder(on_rays=taken.append))
    assert [len(part) for part in taken] == [36] and len(last) == 27 and last.metadata == whole.metadata
    assert np.array_equal(np.concatenate([part.t for part in (*taken, last)]), whole.t)
    assert all(part.persons == ("ann", "bo") and part.cohorts == ("x",) for part in (*taken, last))
    assert taken[0].metadata == {"frame": whole.metadata["frame"]}
    none = RaysBuilder(on_rays=taken.append).build()
    assert len(none) == 0 and none.metadata["rows_read"] == 0


def test_fill_values_are_missing_data_at_any_share(tmp_path):
    n = 100
    origin = np.stack([0.1 * np.arange(n), np.full(n, 2.0), np.full(n, 1.6)], axis=1)
    direction = np.tile([0.0, 1.0, 0.0], (n, 1))
    hit = origin + [0, 3, 0]
    hit[10:70] = 0
    hit[70:73] = -1
    direction[80:90] = -1
    origin[90:95] = 0
    # One looks at 0, 0, 0 indeed.
    direction[20], direction[90:95] = -origin[20], [1, 0, 0]
    builder = begun(tmp_path)
    builder.add(np.arange(n) * 0.1, "ann", origin, direction, rows=np.arange(n), hit=hit)
    rays = builder.build()
    assert {d["reason"]: d["count"] for d in rays.metadata["dropped"]} == {
        "origin is a repeated fill value": 5,
        "direction is the fill value -1, -1, -1": 10,
    }
    assert rays.metadata["missing"] == {
        "hit points that are the fill value 0, 0, 0": 59,
        "hit points that are the fill value -1, -1, -1": 3,
    }
    assert np.isnan(rays.hit[10:73]).all(axis=1).sum() == 62 and (rays.hit[20] == 0).all()
    rays.save(tmp_path / "r.npz")
    assert Rays.load(tmp_path / "r.npz").metadata == rays.metadata


def test_fill_values_are_looked_for_in_what_was_recorded():
    builder = RaysBuilder(UNITY)
    turned, looks = np.tile([0.0, 0, 1], (4, 1)), np.tile([-1.0, -1, -1], (4, 1))
    looks[0] = [1, 0, 0]
    place = np.array([[1.0, 1, 1], [0, 0, 0], [0, 0, 0], [2, 1, 1]])
    recorded = {"recorded_origin": place, "recorded_direction": looks}
    builder.add(np.arange(4.0), "ann", place + 0.1, turned, rows=np.arange(4), **recorded)
    rays = builder.build()
    assert len(rays) == 1 and [d["count"] for d in rays.metadata["dropped"]] == [2, 1]


def test_fill_values_before_any_other_place_are_named(tmp_path):
    builder = begun(tmp_path)
    add(builder, 5)
    origin = np.array([[1.0, 1, 1.6], [0, 0, 0]])
    builder.add(np.arange(2.0), "ann", origin, np.ones((2, 3)), rows=np.array([6, 7]))
    rays = builder.build()
    assert len(rays) == 6 and "the first 5 rows of ann in a.csv have one exact fill" in rays.metadata["complaints"][0]


@pytest.mark.parametrize(
    "text, time, line",
    [
        ("t;x\n0,5;1\n", [0.5], "numbers"),
        ("t;x\n0.5;1\n", [0.5], None),
        ("t,x\n23:59:59,1\n0:00:01,1\n", [86399, 86401], "times"),
    ],
)
def test_decimal_commas_and_times_past_midnight_are_named(tmp_path, text, time, line):
    builder = begun(tmp_path, text=text)
    (block,) = builder.read_table(tmp_path / "a.csv", ["t"], clocks={"t": 1.0})
    assert block.numbers[:, 0].tolist() == time
    add(builder, 2)
    rays = builder.build()
    assert {"numbers", "times"} & set(dict(make_quality_report(rays, summarise(rays)))) == ({line} if line else set())


@pytest.mark.parametrize("word", ["", "NaN", " nan ", "None", "null", "N/A", "<NA>"])
def test_words_for_no_name_are_no_participant(word):
    builder = RaysBuilder()
    v = np.ones((3, 3))
    builder.add(np.arange(3.0), ["ann", word, "nana"], v, v, rows=np.arange(3), cohort=[word, "a", "b"])
    rays = builder.build()
    assert rays.persons == ("ann", "nana") and rays.cohorts == ("unknown", "b")
    assert [d["reason"] for d in rays.metadata["dropped"]] == ["person is missing"]


def test_unused_columns_are_named_once(tmp_path):
    builder = RaysBuilder()
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text("t,x,note,left_valid," + ",".join(f"c{k}" for k in range(20)) + "\n" + "1," * 24)
        builder.source(tmp_path / name)
        assert [len(b.lines) for b in builder.read_table(tmp_path / name, ["t"], also_used=["x"])] == [1]
        add(builder, 2)
    rays = builder.build()
    assert rays.metadata["unused_columns"] == ["note", "left_valid", *(f"c{k}" for k in range(20))]
    (sentence,) = rays.metadata["complaints"]
    assert sentence.startswith("'left_valid' may say by name which rows are valid")
    lines = dict(make_quality_report(rays, summarise(rays)))
    assert lines["not used"] == "note, left_valid, c0, c1, c2, c3, c4, c5 and 14 more"


# ---- Frames ----


@pytest.mark.parametrize(
    "up, hand, want",
    [
        ("z", "right", (1, 2, 3)),
        ("y", "right", (1, -3, 2)),
        ("y", "left", (1, 3, 2)),
        ("z", "left", (1, -2, 3)),
        ("-y", "right", (1, 3, -2)),
    ],
)
def test_usual_frames(up, hand, want):
    assert np.array_equal(TrackingFrame(up=up, handedness=hand).to_rays() @ [1.0, 2.0, 3.0, 1.0], [*want, 1])


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("hand, sign", [("right", 1), ("left", -1)])
def test_up_goes_up_and_hands_are_kept(up, hand, sign):
    R = TrackingFrame(up=up, handedness=hand).to_rays()[:3, :3]
    assert np.isclose(np.linalg.det(R), sign) and np.array_equal(R @ R.T, np.eye(3))
    assert np.array_equal(R @ np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1), [0, 0, 1])


def test_units_and_refusals():
    assert np.isclose(TrackingFrame(units="mm").to_rays()[0, 0], 1e-3)
    for wrong in ({"up": "w"}, {"handedness": "both"}, {"units": "inch"}):
        with pytest.raises(ValueError, match="known"):
            TrackingFrame(**wrong).to_rays()


# ---- Typed options of readers ----


@dataclass(frozen=True, kw_only=True)
class Some(TickOption):
    min_height: float = option(1.5, "Metres.")
    poses: Path | None = option(None, "A file.")
    pair: tuple[int, int] = option((1, 2), "Two.", flag="--two", shown="1,2", parse=lambda text: (0, 0))
    rough: bool = option(False, "Whether.")
    secret: str = option("a", "Told elsewhere.", recorded=False)


def test_what_is_said_of_each():
    tick, height, poses, pair, rough, secret = list_options(Some)
    assert (tick.flag, tick.kind, tick.shown, tick.default) == ("--tick", float, "1", 1.0)
    assert (height.flag, height.shown, height.help, height.recorded) == ("--min-height", "1.5", "Metres.", True)
    assert (poses.kind, poses.shown, poses.default) == (Path, "", None)
    assert (pair.flag, pair.kind, pair.shown, pair.parse("9,9")) == ("--two", str, "1,2", (0, 0))
    assert (rough.kind, rough.shown) == (bool, "") and not secret.recorded and list_options(NoOptions) == ()


def test_what_goes_into_the_metadata():
    assert recorded_options(Some(poses=Path("a"))) == {"tick": 1.0, "min_height": 1.5, "pair": [1, 2], "rough": False}
    assert recorded_options(NoOptions()) == {}


def test_refusals():
    for tick in (0.0, -1.0, float("nan"), 1e13):
        with pytest.raises(NergError, match="--tick"):
            Some(tick=tick)

    @dataclass(frozen=True)
    class Silent:
        a: int = 1

    with pytest.raises(TypeError, match="Silent.a says nothing of itself"):
        list_options(Silent)
    with pytest.raises(TypeError, match="is no dataclass"):
        list_options(int)


# ---- What every reader keeps to, of those that are registered ----


@pytest.mark.parametrize("name", registry.list_reader_names())
def test_what_they_say_of_themselves(name):
    reader = registry.get_reader(name)
    assert reader.name == name and all(
        isinstance(text, str) and text.strip() for text in (reader.files, reader.world, reader.checked_on)
    )
    assert isinstance(reader.frame([], reader.Options()), TrackingFrame)


READABLE = [name for name in registry.list_reader_names() if name != "c3d" or find_spec("c3d")]


@pytest.mark.parametrize("name", READABLE)
def test_what_all_readers_keep(tmp_path, name):
    """Of the example of each: rays in the frame that is declared, with an account of all rows."""
    example, reader = EXAMPLES[name], registry.get_reader(name)
    given, options = example.make(tmp_path), registry.make_options(name, example.options_in(tmp_path))
    begun_files = []
    rays = registry.read_rays(name, given, options, on_source=begun_files.append)
    about = rays.metadata
    assert len(rays) > 0 and about["preset"] == name
    assert about["rows_read"] == len(rays) + sum(d["count"] for d in about["dropped"])
    assert about["source_frame"] == reader.frame([given], options).to_dict()
    assert np.allclose(about["transform"], reader.frame([given], options).to_rays())
    assert [s["file"] for s in about["sources"]] == begun_files and len(begun_files) == len(example.files)
    # Heads are where heads are: the frame was not taken for another.
    assert 0.9 < np.median(rays.origin[:, 2]) < 2.0 or name in ("pupil", "table")
    rays.save(tmp_path / "rays.npz")
    assert Rays.load(tmp_path / "rays.npz").metadata == about
    # The same where bad lines are left out, of which there are none.
    again = registry.read_rays(reader, [given], options, skip_bad_lines=True)
    assert np.array_equal(again.origin, rays.origin) and np.array_equal(again.direction, rays.direction)


@pytest.mark.parametrize("name", READABLE)
def test_a_file_that_is_none_of_theirs(tmp_path, name):
    example = EXAMPLES[name]
    given = example.make(tmp_path)
    given.write_text("this is a letter\nand no table\n")
    with pytest.raises(NergError, match=given.name.split(".")[0]):
        registry.read_rays(name, given, registry.make_options(name, example.options_in(tmp_path)))


@pytest.mark.parametrize("name", READABLE)
def test_a_link_in_a_circle_is_no_file(name, tmp_path):
    """In the place of each file of a recording: it is refused, or missing where it may be. `Path.resolve` of Python
    before 3.13 raises a ``RuntimeError`` for it."""
    example = EXAMPLES[name]
    given, options = example.make(tmp_path), registry.make_options(name, example.options_in(tmp_path))
    for file in example.files:
        content = (tmp_path / file).read_bytes()
        (tmp_path / file).unlink()
        (tmp_path / file).symlink_to(file)
        # Without these two, Neon's gaze is read by its angles, and times count from the first frame.
        may_be_missing = name == "neon" and file in ("info.json", "scene_camera.json")
        with nullcontext() if may_be_missing else pytest.raises(NergError):
            registry.read_rays(name, given, options)
        (tmp_path / file).unlink()
        (tmp_path / file).write_bytes(content)
