"""Tests of `nerg_mi.tracking.readers.base`."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.tracking.quality import make_quality_report, summarise
from nerg_mi.tracking.rays import FRAME, Rays
from nerg_mi.tracking.readers import base as builder_module
from nerg_mi.tracking.readers import registry
from nerg_mi.tracking.readers.base import (
    FROM_DOCUMENTATION,
    FROM_RECORDINGS,
    UNITY,
    UP_AXES,
    NameCodes,
    NoOptions,
    RaysBuilder,
    TickOption,
    TrackingFrame,
    list_options,
    list_recorded_options,
    option,
)
from tests.refusals import mentions
from tests.tracking.readers.examples import EXAMPLES, dropped

# ---- Record of dropped rows ----


def begun(tmp_path, *frame, text="x", **how) -> RaysBuilder:
    """A builder with an open source."""
    (tmp_path / "a.csv").write_text(text)
    builder = RaysBuilder(*frame, **how)
    builder.begin_source(tmp_path / "a.csv")
    return builder


def add(builder, n, gone=(), first=1):
    origin = np.zeros((n, 3))
    origin[list(gone)] = np.nan
    builder.add(np.arange(n) * 0.1, "ann", origin, np.tile([1.0, 0, 0], (n, 1)), rows=np.arange(first, first + n))


def test_listed_runs_are_bounded(tmp_path, monkeypatch):
    """Every other row is a blink: their number is exact, and the file can be read again."""
    monkeypatch.setattr(builder_module, "MAX_LISTED_RUNS", 10)
    builder = begun(tmp_path)
    add(builder, 14, [0, 1, 4, 6, 8, 10])
    add(builder, 14, [0, 2, 4, 6, 8, 10, 11], first=15)
    rays = builder.build()
    (lost,) = rays.metadata["dropped"]
    assert lost["count"] == 13 and len(lost["rows"]) == 10 and lost["rows"][0] == [1, 2]
    assert lost["rows_not_named"] == 13 - sum(b - a + 1 for a, b in lost["rows"]) > 0
    rays.save(tmp_path / "r.npz")
    assert Rays.load(tmp_path / "r.npz").metadata == rays.metadata


def test_bad_lines_are_bounded_per_file(tmp_path):
    """Good lines of one file do not compensate for bad lines of another."""
    for name in "abc":
        (tmp_path / name).write_text("x")
    builder = RaysBuilder(skip_bad_lines=True)
    builder.begin_source(tmp_path / "a")
    add(builder, 1000)
    builder.begin_source(tmp_path / "b")
    add(builder, 198)
    for line in (3, 4):
        builder.on_bad_line(line, ": 2 cells")
    builder.begin_source(tmp_path / "c")
    add(builder, 100)
    for line in (7, 8):
        builder.on_bad_line(line, ": 2 cells")
    with pytest.raises(NergError, match="2.*102.*1.*7.*2"):
        builder.build()
    assert RaysBuilder().on_bad_line is None


def test_checksums_are_computed_at_the_end_of_a_file(tmp_path, monkeypatch):
    """The checksum of a file that is refused while reading is not computed."""
    summed = []
    monkeypatch.setattr(builder_module, "file_sha256", lambda path: summed.append(path.name) or f"of {path.name}")
    builder = RaysBuilder()
    for name in "ab":
        (tmp_path / name).write_text("x")
    builder.begin_source(tmp_path / "a", "ann/a")
    add(builder, 3)
    assert summed == []
    builder.begin_source(tmp_path / "b")
    assert summed == ["a"]
    add(builder, 3)
    with (tmp_path / "c").open("wb") as out:
        out.truncate(64 << 30)
    with pytest.raises(NergError, match="68,719,476,736.*17,179,869,184"):
        builder.begin_source(tmp_path / "c")
    assert builder.build().metadata["sources"] == [{"file": "ann/a", "sha256": "of a"}, {"file": "b", "sha256": "of b"}]


def test_file_of_another_format_ends_early(tmp_path):
    builder = begun(tmp_path, skip_bad_lines=True)
    with pytest.raises(NergError, match="lines are unreadable"):
        for line in range(1, 10**6):
            builder.on_bad_line(line, ": 1 cells")
    assert line < 20_000


def test_lines_of_a_complete_table_are_counted(tmp_path):
    """Two bad lines of three hundred are accepted, although none gives a ray."""
    builder = begun(tmp_path, text="t,x\n" + "1,2\n" * 300 + "1\n\n3\n", skip_bad_lines=True)
    assert builder.read_all(tmp_path / "a.csv", ["x", "t"]).shape == (300, 2)
    (tmp_path / "b.csv").write_text("x")
    builder.begin_source(tmp_path / "b.csv")
    add(builder, 1)
    assert dropped(builder.build()).popitem()[1] == [[302, 302], [304, 304]]


def test_builder_records_dropped_rows(tmp_path):
    d = np.tile([0.0, 0.0, 2.0], (6, 1))
    d[1], d[2], d[4] = 0, np.nan, 0
    builder = begun(tmp_path, TrackingFrame(units="cm"))
    builder.add_metadata(preset="made up")
    builder.add(np.arange(6.0), "ann", np.full((6, 3), 100.0), d, rows=np.arange(2, 8), drop={"late": np.arange(6) > 4})
    rays = builder.build()
    assert len(rays) == 2 and np.allclose(rays.direction, [0, 0, 1]) and np.allclose(rays.origin, 1)
    assert rays.metadata["frame"] == FRAME and rays.metadata["rows_read"] == 6 and rays.metadata["preset"] == "made up"
    assert dropped(rays) == {"late": [[7, 7]], "direction is missing": [[4, 4]], "direction is zero": [[3, 3], [6, 6]]}
    assert rays.metadata["sources"][0]["file"] == "a.csv" and len(rays.metadata["sources"][0]["sha256"]) == 64


@pytest.mark.parametrize("far", [1.1e9, -1e38, 1e200, 1e308])
def test_points_beyond_the_limit_are_recorded(far):
    """The limit is in metres, also for files in centimetres."""
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


def test_builder_without_valid_rows():
    builder = RaysBuilder()
    builder.add(np.zeros(2), "ann", np.zeros((2, 3)), np.zeros((2, 3)), rows=np.arange(2))
    with pytest.raises(NergError, match="none of 2 rows gives a ray .*direction is zero"):
        builder.build()


def test_rays_are_converted_from_the_frame(tmp_path):
    """Mirrored, in centimetres; each source is reported when it begins."""
    names = []
    builder = begun(tmp_path, TrackingFrame(UNITY.up, UNITY.handedness, "cm"), on_source=names.append)
    point, ahead = np.array([[100.0, 160.0, 300.0]]), np.array([[0.0, 0.0, 5.0]])
    builder.add(np.zeros(1), "ann", point, ahead, rows=np.ones(1, int), hit=point + 100 * ahead)
    rays = builder.build()
    assert np.allclose(rays.origin, [1, 3, 1.6]) and np.allclose(rays.direction, [0, 1, 0])
    assert np.allclose(rays.hit, [1, 8, 1.6]) and names == ["a.csv"]


def test_warnings_are_recorded_once(tmp_path):
    builder = begun(tmp_path)
    builder.add(np.arange(3.0), "ann", np.eye(3), np.eye(3), rows=np.arange(3))
    for sentence in ("one", "two", "one"):
        builder.add_warning(sentence)
    rays = builder.build()
    assert rays.metadata["complaints"] == ["one", "two"] and summarise(rays).warnings[:2] == ("one", "two")


def test_heads_and_eyes():
    """Directions of heads in the frame of rays, and the eye distance of each person in metres."""
    builder, ones = RaysBuilder(TrackingFrame(up="y", handedness="left", units="cm")), np.ones((5, 3))
    heads = np.array([[0, 0, 2.0], [0, 5, 0], [0, 0, 0], [np.nan, 0, 1]])
    gone = np.array([[1.0, 1, 1], [np.nan] * 3, [1, 1, 1], [1, 1, 1]])
    builder.add(np.arange(4), ["bo", "bo", "ann", "ann"], gone, ones[:4], rows=np.arange(4), head=heads)
    both_eyes = np.array([6.0, 7.0, np.nan, 6.2, 6.4])
    builder.add(np.arange(5), ["bo", "bo", "bo", "ann", "bo"], ones, ones, rows=np.arange(4, 9), eye_distance=both_eyes)
    rays = builder.build()
    assert np.allclose(rays.head[0], [0, 1, 0]) and np.isnan(rays.head[1:]).all() and len(rays.head) == 8
    assert rays.metadata["eye_distance"] == {"ann": 0.062, "bo": 0.064}


def test_rays_are_streamed(monkeypatch):
    """All blocks together are the rays that are built at once; the last block has the metadata."""
    monkeypatch.setattr("nerg_mi.tracking.readers.base.STREAM_RAYS", 30)
    taken: list = []

    def added(builder):
        for k in range(7):
            t = np.arange(10.0) + 10 * k
            t[3] = np.nan
            ahead = np.tile([1.0, 0.0, 0.0], (10, 1))
            builder.add(t, ["bo", "ann"] * 5, ahead, ahead, rows=np.arange(10) + 10 * k, cohort=["x"] * 10)
        return builder.build()

    complete, last = added(RaysBuilder()), added(RaysBuilder(on_rays=taken.append))
    assert [len(part) for part in taken] == [36] and len(last) == 27 and last.metadata == complete.metadata
    assert np.array_equal(np.concatenate([part.t for part in (*taken, last)]), complete.t)
    assert all(part.persons == ("ann", "bo") and part.cohorts == ("x",) for part in (*taken, last))
    assert taken[0].metadata == {"frame": complete.metadata["frame"]}
    none = RaysBuilder(on_rays=taken.append).build()
    assert len(none) == 0 and none.metadata["rows_read"] == 0


def test_fill_values_are_missing_data_at_any_fraction(tmp_path):
    n = 100
    origin = np.stack([0.1 * np.arange(n), np.full(n, 2.0), np.full(n, 1.6)], axis=1)
    direction = np.tile([0.0, 1.0, 0.0], (n, 1))
    hit = origin + [0, 3, 0]
    hit[10:70] = 0
    hit[70:73] = -1
    direction[80:90] = -1
    origin[90:95] = 0
    # One ray really points at 0, 0, 0.
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


def test_fill_values_are_detected_in_recorded_vectors():
    builder = RaysBuilder(UNITY)
    turned, directions = np.tile([0.0, 0, 1], (4, 1)), np.tile([-1.0, -1, -1], (4, 1))
    directions[0] = [1, 0, 0]
    place = np.array([[1.0, 1, 1], [0, 0, 0], [0, 0, 0], [2, 1, 1]])
    recorded = {"recorded_origin": place, "recorded_direction": directions}
    builder.add(np.arange(4.0), "ann", place + 0.1, turned, rows=np.arange(4), **recorded)
    rays = builder.build()
    assert len(rays) == 1 and [d["count"] for d in rays.metadata["dropped"]] == [2, 1]


def test_fill_values_before_any_valid_position_give_a_warning(tmp_path):
    builder = begun(tmp_path)
    add(builder, 5)
    origin = np.array([[1.0, 1, 1.6], [0, 0, 0]])
    builder.add(np.arange(2.0), "ann", origin, np.ones((2, 3)), rows=np.array([6, 7]))
    rays = builder.build()
    assert len(rays) == 6 and "the first 5 rows of ann in a.csv have one fill" in rays.metadata["complaints"][0]


@pytest.mark.parametrize(
    "text, time, line",
    [
        ("t;x\n0,5;1\n", [0.5], "decimal sign"),
        ("t;x\n0.5;1\n", [0.5], None),
        ("t,x\n23:59:59,1\n0:00:01,1\n", [86399, 86401], "times"),
    ],
)
def test_decimal_commas_and_times_past_midnight_are_reported(tmp_path, text, time, line):
    builder = begun(tmp_path, text=text)
    (block,) = builder.read_table(tmp_path / "a.csv", ["t"], clocks={"t": 1.0})
    assert block.numbers[:, 0].tolist() == time
    add(builder, 2)
    rays = builder.build()
    assert {"decimal sign", "times"} & set(dict(make_quality_report(rays, summarise(rays)))) == (
        {line} if line else set()
    )


@pytest.mark.parametrize("word", ["", "NaN", " nan ", "None", "null", "N/A", "<NA>"])
def test_words_for_missing_names_are_no_participant(word):
    builder = RaysBuilder()
    v = np.ones((3, 3))
    builder.add(np.arange(3.0), ["ann", word, "nana"], v, v, rows=np.arange(3), cohort=[word, "a", "b"])
    rays = builder.build()
    assert rays.persons == ("ann", "nana") and rays.cohorts == ("unknown", "b")
    assert [d["reason"] for d in rays.metadata["dropped"]] == ["person is missing"]


def test_unused_columns_are_listed_once(tmp_path):
    builder = RaysBuilder()
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text("t,x,note,left_valid," + ",".join(f"c{k}" for k in range(20)) + "\n" + "1," * 24)
        builder.begin_source(tmp_path / name)
        assert [len(b.lines) for b in builder.read_table(tmp_path / name, ["t"], also_used=["x"])] == [1]
        add(builder, 2)
    rays = builder.build()
    assert rays.metadata["unused_columns"] == ["note", "left_valid", *(f"c{k}" for k in range(20))]
    (sentence,) = rays.metadata["complaints"]
    assert sentence.startswith("'left_valid' may mark valid rows by their names")
    lines = dict(make_quality_report(rays, summarise(rays)))
    assert lines["unused columns"] == "note, left_valid, c0, c1, c2, c3, c4, c5 and 14 more"


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


@pytest.mark.parametrize("up", UP_AXES)
@pytest.mark.parametrize("hand, sign", [("right", 1), ("left", -1)])
def test_frame_conversion_keeps_up_and_handedness(up, hand, sign):
    R = TrackingFrame(up=up, handedness=hand).to_rays()[:3, :3]
    assert np.isclose(np.linalg.det(R), sign) and np.array_equal(R @ R.T, np.eye(3))
    assert np.array_equal(R @ np.eye(3)["xyz".index(up[-1])] * (-1 if up[0] == "-" else 1), [0, 0, 1])


def test_units_and_invalid_frames():
    assert np.isclose(TrackingFrame(units="mm").to_rays()[0, 0], 1e-3)
    for wrong in ({"up": "w"}, {"handedness": "both"}, {"units": "inch"}):
        with pytest.raises(ValueError, match="known"):
            TrackingFrame(**wrong).to_rays()


# ---- Typed options of readers ----


@dataclass(frozen=True, kw_only=True)
class Some(TickOption):
    min_height: float = option(1.5, "Metres.")
    poses: Path | None = option(None, "A file.")
    pair: tuple[int, int] = option((1, 2), "Two.", flag="--two", default_text="1,2", parse=lambda text: (0, 0))
    rough: bool = option(False, "Whether.")
    secret: str = option("a", "Told elsewhere.", is_recorded=False)


def test_options_have_names_types_and_help():
    tick, height, poses, pair, rough, secret = list_options(Some)
    assert (tick.flag, tick.kind, tick.default_text, tick.default) == ("--tick", float, "1", 1.0)
    assert (height.flag, height.default_text, height.help, height.is_recorded) == (
        "--min-height",
        "1.5",
        "Metres.",
        True,
    )
    assert (poses.kind, poses.default_text, poses.default) == (Path, "", None)
    assert (pair.flag, pair.kind, pair.default_text, pair.parse("9,9")) == ("--two", str, "1,2", (0, 0))
    assert (rough.kind, rough.default_text) == (bool, "") and not secret.is_recorded and list_options(NoOptions) == ()


def test_recorded_options():
    assert list_recorded_options(Some(poses=Path("a"))) == {
        "tick": 1.0,
        "min_height": 1.5,
        "pair": [1, 2],
        "rough": False,
    }
    assert list_recorded_options(NoOptions()) == {}


def test_refusals():
    for tick in (0.0, -1.0, float("nan"), 1e13):
        with pytest.raises(NergError, check=mentions("tick")):
            Some(tick=tick)

    @dataclass(frozen=True)
    class Silent:
        a: int = 1

    with pytest.raises(TypeError, match="Silent.a has no description"):
        list_options(Silent)
    with pytest.raises(TypeError, match="is not a dataclass"):
        list_options(int)


# ---- Requirements on every registered reader ----


@pytest.mark.parametrize("name", registry.list_reader_names())
def test_reader_descriptions_are_valid(name):
    reader = registry.get_reader(name)
    assert reader.name == name and all(
        isinstance(text, str) and text.strip() for text in (reader.files, reader.frame_description)
    )
    assert reader.evidence.startswith((FROM_RECORDINGS, FROM_DOCUMENTATION))
    assert isinstance(reader.frame([], reader.Options()), TrackingFrame)


READABLE = [name for name in registry.list_reader_names() if name != "c3d" or find_spec("c3d")]


@pytest.mark.parametrize("name", READABLE)
def test_all_readers_give_valid_rays(tmp_path, name):
    """The example of each reader: rays in the declared frame, and all rows accounted for."""
    example, reader = EXAMPLES[name], registry.get_reader(name)
    cases, options = example.make(tmp_path), registry.make_options(name, example.options_in(tmp_path))
    begun_files = []
    rays = registry.read_rays(name, cases, options, on_source=begun_files.append)
    content = rays.metadata
    assert len(rays) > 0 and content["preset"] == name
    heads = ("c3d", "motive", "skeleton", "unity_head")
    assert rays.tracking == ("head" if name in heads else "eye")
    assert content["rows_read"] == len(rays) + sum(d["count"] for d in content["dropped"])
    assert content["source_frame"] == reader.frame([cases], options).to_dict()
    assert np.allclose(content["transform"], reader.frame([cases], options).to_rays())
    assert [s["file"] for s in content["sources"]] == begun_files and len(begun_files) == len(example.files)
    # Heads are at eye height: the frame was read correctly.
    assert 0.9 < np.median(rays.origin[:, 2]) < 2.0 or name in ("pupil", "table")
    rays.save(tmp_path / "rays.npz")
    assert Rays.load(tmp_path / "rays.npz").metadata == content
    # The same when bad lines are skipped, of which there are none.
    again = registry.read_rays(reader, [cases], options, skip_bad_lines=True)
    assert np.array_equal(again.origin, rays.origin) and np.array_equal(again.direction, rays.direction)


@pytest.mark.parametrize("name", READABLE)
def test_all_readers_refuse_other_files(tmp_path, name):
    example = EXAMPLES[name]
    cases = example.make(tmp_path)
    cases.write_text("this is a letter\nand no table\n")
    with pytest.raises(NergError, match=cases.name.split(".")[0]):
        registry.read_rays(name, cases, registry.make_options(name, example.options_in(tmp_path)))


@pytest.mark.parametrize("name", READABLE)
def test_all_readers_refuse_circular_links(name, tmp_path):
    """In place of each file of a recording: it is refused, or treated as missing if it is optional. `Path.resolve` of
    Python before 3.13 raises a ``RuntimeError`` for such a link."""
    example = EXAMPLES[name]
    cases, options = example.make(tmp_path), registry.make_options(name, example.options_in(tmp_path))
    for file in example.files:
        content = (tmp_path / file).read_bytes()
        (tmp_path / file).unlink()
        (tmp_path / file).symlink_to(file)
        # Without these two, Neon's gaze is read from its angles, and times start at the first frame.
        may_be_missing = name == "neon" and file in ("info.json", "scene_camera.json")
        with nullcontext() if may_be_missing else pytest.raises(NergError):
            registry.read_rays(name, cases, options)
        (tmp_path / file).unlink()
        (tmp_path / file).write_bytes(content)


def test_codes_of_names_do_not_depend_on_their_form():
    codes = NameCodes()
    assert codes.encode(["J\u00f6rg", "Jo\u0308rg", "1.0", " 1", "nan"], 5).tolist() == [0, 0, 1, 1, 2]
    assert codes.encode("Jo\u0308rg ", 2).tolist() == [0, 0]
    assert codes.sort_codes(np.array([0, 1]))[1] == ("1", "J\u00f6rg")
