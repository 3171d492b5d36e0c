"""Tests of `nerg_mi.tracking.rays`."""

import importlib.util
import json
import zipfile

import numpy as np
import pytest
from scipy.spatial import cKDTree

from nerg_mi.errors import NergError
from nerg_mi.tracking import rays as module
from nerg_mi.tracking.rays import (
    FRAME,
    VERSION,
    RayIndex,
    Rays,
    merge_metadata,
    merge_rays,
    read_metadata,
    sample_rows,
    write_rays_file,
)

# ---- Index ----


@pytest.mark.parametrize("block", [1 << 21, 64])
def test_query_equals_brute_force(block, monkeypatch):
    monkeypatch.setattr(module, "_INDEX_BLOCK", block)
    rng = np.random.default_rng(0)
    origin, places = rng.random((500, 3)), rng.random((40, 3)) * 1.2
    index = RayIndex(origin)
    distances = np.linalg.norm(origin[None] - places[:, None], axis=2)
    for limit, radius in ((10, 0.2), (1000, 0.3), (7, np.inf)):
        result = index.query(places, limit, radius)
        for q in range(40):
            run = slice(result.offsets[q], result.offsets[q + 1])
            want = np.argsort(distances[q])[: min(limit, (distances[q] <= radius).sum())]
            assert np.array_equal(result.indices[run], want) and np.allclose(result.distances[run], distances[q][want])


def test_radius_is_inclusive_and_invalid_queries_are_refused():
    index = RayIndex(np.array([[0.25, 0, 0], [0.3, 0, 0]]))
    assert index.query([[0, 0, 0]], 5, 0.25).indices.tolist() == [0]
    with pytest.raises(ValueError, match="max_count 0"):
        index.query([[0, 0, 0]], 0)


def test_equally_distant_rays_keep_their_order():
    """The order determines the last bits of every training: it is that of SciPy's default cKDTree."""
    rng = np.random.default_rng(3)
    origin = rng.integers(0, 30, (20_000, 3)).astype(float)  # on a lattice: many distances are equal
    near = RayIndex(origin).query(origin[:50], 300)
    _, indices = cKDTree(origin, balanced_tree=False).query(origin[:50], k=300)
    assert np.array_equal(near.indices, indices.ravel())


# ---- Io ----

ENDINGS = [
    "npz",
    pytest.param(
        "parquet",
        marks=pytest.mark.skipif(
            importlib.util.find_spec("pyarrow") is None, reason="pyarrow is not installed (pip install pyarrow)"
        ),
    ),
]


def some_rays(n=6, **change):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(n, 3))
    values = dict(
        t=np.arange(n) / 7,
        person=np.arange(n) % 2,
        persons=("ann", "bo"),
        origin=rng.random((n, 3)),
        direction=d / np.linalg.norm(d, axis=1, keepdims=True),
        confidence=np.ones(n),
    )
    return Rays(**{**values, **change})


def some(hit):
    points = np.random.default_rng(1).random((9, 3))
    points[4] = np.nan
    heads = np.where(np.isnan(points), points, np.float32([0.6, 0.0, 0.8]))
    metadata = {"frame": dict(FRAME), "dropped": [{"reason": "blink", "count": 2, "rows": [[3, 4]]}]}
    return some_rays(9, metadata=metadata, **({"hit": points, "head": heads} if hit else {}))


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("hit", [True, False])
def test_round_trip(tmp_path, ending, hit):
    rays, path = some(hit), tmp_path / f"rays.{ending}"
    rays.save(path)
    back = Rays.load(path)
    assert back.persons == rays.persons and back.metadata == rays.metadata and (back.hit is None) == (not hit)
    for name in ("t", "person", "origin", "direction", "confidence"):
        assert np.array_equal(getattr(back, name), getattr(rays, name))
    if hit:
        assert np.array_equal(back.hit, rays.hit, equal_nan=True) and back.head.dtype == np.float32
        assert np.array_equal(back.head, rays.head, equal_nan=True)


def test_refusals(tmp_path):
    with pytest.raises(NergError, match=".npz or .parquet"):
        some(False).save(tmp_path / "rays.csv")
    (tmp_path / "text.npz").write_text("hello")
    with pytest.raises(NergError, match="text.npz.*not a zip archive"):
        Rays.load(tmp_path / "text.npz")


def test_parquet_without_pyarrow(tmp_path, monkeypatch):
    import builtins

    real = builtins.__import__

    def no_pyarrow(name, *args, **kwargs):
        if name.startswith("pyarrow"):
            raise ImportError("no module")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", no_pyarrow)
    with pytest.raises(ImportError, match="nerg-mi\\[parquet\\]"):
        some(False).save(tmp_path / "rays.parquet")


def stored(path, **changes):
    """A rays file with some arrays or metadata keys replaced; None removes one."""
    rays = some(True)
    arrays = {k: getattr(rays, k) for k in ("t", "person", "origin", "direction", "confidence", "hit")}
    metadata = {"version": 1, **rays.metadata, "persons": list(rays.persons)}
    for name, value in changes.items():
        into = arrays if name in (*arrays, "cohort", "metadata") else metadata
        into.pop(name, None)
        if value is not None:
            into[name] = value
    np.savez(path, **{"metadata": np.array(json.dumps(metadata)), **arrays})
    return path


@pytest.mark.parametrize(
    "changes, why",
    [
        ({"person": np.full(9, -1)}, "unknown participant"),
        ({"person": np.full(9, 1 << 32)}, "unknown participant"),
        ({"person": np.zeros(9)}, "person is not integers"),
        ({"direction": np.full((9, 3), np.inf)}, "direction that is not finite"),
        ({"origin": np.zeros((9, 2))}, r"origin has shape \(9, 2\)"),
        ({"t": np.zeros(8)}, "expected"),
        ({"t": np.zeros((3, 3))}, "expected"),
        ({"t": np.array(1.0)}, "expected"),
        ({"hit": np.array(["a"] * 9)}, "expected"),
        ({"confidence": np.ones(9) * 1j}, "not numbers"),
        ({"t": np.arange(9).astype("M8[s]")}, "not numbers"),
        ({"hit": None, "cohort": np.zeros(9, int)}, "unknown cohort"),
        ({"t": None}, "lacks t"),
        ({"metadata": np.array("[" * 5000)}, "nested"),
        ({"metadata": np.zeros(3)}, "not text"),
        ({"version": None}, 'lack "version"'),
    ],
)
def test_invalid_rays_files_are_refused(tmp_path, changes, why):
    path = stored(tmp_path / "changed.npz", **changes)
    with pytest.raises(NergError, match=why) as caught:
        Rays.load(path)
    assert "changed.npz" in str(caught.value) and "\n" not in str(caught.value)


def test_narrow_numbers_and_other_columns_are_read(tmp_path):
    rays = some(True)
    path = stored(
        tmp_path / "narrow.npz",
        person=rays.person.astype(np.uint8),
        confidence=np.ones(9, np.float16),
        t=np.arange(9),
        origin=rays.origin.astype(np.float32),
        notes=[1],
    )
    back = Rays.load(path)
    assert back.t.dtype == np.float64 and np.array_equal(back.person, rays.person) and back.person.dtype == np.int32
    assert np.allclose(back.origin, rays.origin, atol=1e-6) and back.metadata["notes"] == [1]


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_cut_and_every_flipped_byte(tmp_path, ending):
    """A truncated file, or one with a changed byte, is either read or refused with one sentence."""
    complete, path = tmp_path / f"whole.{ending}", tmp_path / f"hurt.{ending}"
    some(True).save(complete)
    data, rng = complete.read_bytes(), np.random.default_rng(0)
    refused = 0
    for at in rng.integers(0, len(data), 120).tolist():
        for hurt in (data[:at], data[:at] + bytes([data[at] ^ 0x41]) + data[at + 1 :], data[:at] + data[at + 7 :]):
            path.write_bytes(hurt)
            try:
                assert len(Rays.load(path)) == 9
            except NergError as error:
                refused += 1
                assert "hurt" in str(error)
    assert refused > 200


def test_a_small_file_does_not_become_a_large_array(tmp_path):
    """Zeros compress to almost nothing: 8 million rays would take three quarters of a gigabyte."""
    n, path = 8_000_000, tmp_path / "zeros.npz"
    metadata = {"version": 1, "persons": ["a"], "frame": dict(FRAME)}
    small = {name: np.zeros(n, np.int8) for name in ("t", "person", "confidence")}
    small |= {name: np.zeros((n, 3), np.int8) for name in ("origin", "direction")}
    np.savez_compressed(path, metadata=np.array(json.dumps(metadata)), **small)
    assert path.stat().st_size < 1 << 20
    with pytest.raises(NergError, match="8,000,000 rays, too many for its size"):
        Rays.load(path)


@pytest.mark.parametrize("column, value", [("person", None), ("t", "x"), ("origin_y", "x")])
def test_parquet_of_other_types(tmp_path, column, value):
    pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed (pip install pyarrow)")
    import pyarrow.parquet as pq

    path = tmp_path / "other.parquet"
    some(False).save(path)
    table = pq.read_table(path)
    at = table.column_names.index(column)
    other = pa.array([value] * 9, pa.int32() if value is None else None)
    pq.write_table(table.set_column(at, column, other).replace_schema_metadata(table.schema.metadata), path)
    with pytest.raises(NergError, match="other.parquet"):
        Rays.load(path)
    pq.write_table(table.replace_schema_metadata(None), path)
    with pytest.raises(NergError, match="lacks the metadata"):
        Rays.load(path)


def test_incompressible_columns_are_stored(tmp_path):
    """Compressing random digits is not worth the time."""
    n = 50_000  # more than the sample that is tested for compressibility
    rays = some_rays(n, t=np.arange(n) * 0.02, origin=np.zeros((n, 3)))
    rays.save(tmp_path / "r.npz")
    with zipfile.ZipFile(tmp_path / "r.npz") as archive:
        kinds = {m.filename.removesuffix(".npy"): m.compress_type for m in archive.infolist()}
    assert kinds.pop("direction") == zipfile.ZIP_STORED and kinds.pop("metadata") is not None
    assert set(kinds.values()) == {zipfile.ZIP_DEFLATED}
    assert np.array_equal(Rays.load(tmp_path / "r.npz").direction, rays.direction)


@pytest.mark.parametrize(
    "metadata, said",
    [
        ({"tick": 0}, '^the metadata of these rays are invalid: "tick" is not '),
        ({"persons": 3}, '^the metadata of these rays are invalid: "persons" is not '),
        ({"note": [[]] * 9_000_000}, "contains more than 8,000,000 values"),
    ],
)
def test_unreadable_metadata_are_not_written(tmp_path, metadata, said):
    rays = some(False)
    columns = {k: getattr(rays, k) for k in ("t", "person", "origin", "direction", "confidence")}
    with pytest.raises(NergError, match=said):
        write_rays_file(tmp_path / "r.npz", columns, {**rays.metadata, "persons": list(rays.persons), **metadata})
    assert not list(tmp_path.iterdir())


# ---- Metadata of a rays file: accepted and refused documents ----

GOOD = {
    "version": VERSION,
    "frame": {"units": "m", "up": "z", "handedness": "right"},
    "persons": ["ann", "bo"],
    "cohorts": [],
    "source_frame": {"units": "cm", "up": "y", "handedness": "left"},
    "transform": np.eye(4).tolist(),
    "rows_read": 12,
    "sources": [{"file": "a.csv", "sha256": "00"}, {"file": "b.csv"}],
    "dropped": [{"reason": "blink", "count": 2, "file": "a.csv", "rows": [[3, 4]]}, {"reason": "other", "count": 1}],
    "steps": [
        {"step": "filter", "kept": 9, "of": 10},
        {"step": "fixations", "kept": 9, "of": 9, "by": "ivt"},
        {"step": "split", "kept": 5, "of": 9, "by": {"position": {"radius": 0.25, "test_centres": [[0, 0, 1.5]]}}},
    ],
    "tick": 0.001,
    "anything": {"else": [1, "two"]},
}


def read(**change):
    metadata = {**GOOD, **change}
    return read_metadata(json.dumps({k: v for k, v in metadata.items() if v is not ...}), "r.npz")


def test_known_and_unknown_metadata():
    assert read() == {k: v for k, v in GOOD.items() if k != "version"}
    minimum = json.dumps({k: GOOD[k] for k in ("version", "frame", "persons")})
    assert set(read_metadata(minimum.encode(), "r.npz")) == {"frame", "persons"}


@pytest.mark.parametrize(
    "change, message",
    [
        ({"version": VERSION + 1}, "another version"),
        ({"version": ...}, 'lack "version"'),
        ({"persons": ...}, '"persons" is missing'),
        ({"frame": ...}, '"frame" is missing'),
        ({"frame": {"units": "m", "up": "z"}}, '"frame" .*frame with units'),
        ({"persons": ["ann", 2]}, '"persons" .*list of names'),
        ({"persons": "ann"}, '"persons" .*list of names'),
        ({"transform": [[1e400]]}, "rotation"),
        ({"transform": 3}, "rotation"),
        ({"transform": np.zeros((4, 4)).tolist()}, "rotation"),
        ({"transform": np.eye(3).tolist()}, "rotation"),
        ({"transform": (np.arange(16).reshape(4, 4) + 1).tolist()}, "rotation"),
        ({"transform": (np.eye(4) + np.eye(4, k=-3)).tolist()}, "rotation"),
        ({"transform": np.diag([1.0, 2, 1, 1]).tolist()}, "rotation"),
        ({"place_from_rays": (np.eye(4) + np.eye(4, k=-3)).tolist()}, "rotation"),
        ({"rows_read": -1}, "number of rows"),
        ({"rows_read": True}, "number of rows"),
        ({"sources": [{"sha256": "00"}]}, "list of files"),
        ({"dropped": [{"reason": "blink", "count": 2, "rows": [[3]]}]}, "list of reasons"),
        ({"dropped": [{"count": 2}]}, "list of reasons"),
        ({"steps": [{"step": "filter", "kept": 1}]}, "list of steps"),
        ({"steps": [{"step": "split", "kept": 1, "of": 2, "by": {"position": {"radius": "far"}}}]}, "list of steps"),
        ({"steps": [{"step": "split", "kept": 1, "of": 2, "by": {"position": {"test_centres": [[1, 2]]}}}]}, "steps"),
        ({"eye_distance": {"ann": "wide"}}, "distances in metres"),
        ({"eye_distance": [0.06]}, "distances in metres"),
        ({"floor": 0}, '"floor" .*text'),
        ({"tick": 0}, "time in seconds"),
        ({"tick": "1"}, "time in seconds"),
    ],
)
def test_metadata_refusals(change, message):
    with pytest.raises(NergError, match=f"r.npz.*{message}|{message}.*r.npz"):
        read(**change)


@pytest.mark.parametrize("text", ["[]", "1", "{", ""])
def test_invalid_documents_are_refused(text):
    with pytest.raises(NergError, match=r"r\.npz"):
        read_metadata(text, "r.npz")


# ---- Rays ----


def broken(name, row, value):
    array = getattr(some_rays(), name).copy()
    array[row] = value
    return {name: array}


@pytest.mark.parametrize(
    "change, message",
    [
        (broken("direction", 2, np.nan), r"1 of 6 rays have a direction that is not finite \(rays 2\)"),
        (broken("direction", 3, 0.0), r"zero direction \(rays 3\)"),
        (broken("direction", 4, 0.5), "not of unit length"),
        (broken("origin", 1, np.inf), r"origin that is not finite or beyond 1e\+07 m \(rays 1\)"),
        (broken("origin", 1, 1e38), r"beyond 1e\+07 m \(rays 1\)"),
        ({"hit": np.full((6, 3), -1e8)}, r"a hit point beyond 1e\+07 m \(rays 0, 1"),
        (broken("t", 5, np.nan), r"time that is not finite \(rays 5\)"),
        (broken("person", 0, 7), r"unknown participant \(rays 0\)"),
        (broken("confidence", 0, 1.5), r"confidence outside \[0, 1\]"),
        ({"head": np.tile([[0.0, 0, 2], [np.nan, 0, 0]], (3, 1))}, r"head that is not of unit length \(rays 0, 2, 4\)"),
        ({"origin": np.zeros((5, 3))}, r"origin has shape \(5, 3\)"),
        ({"t": ["now"] * 6}, '"t" of rays must contain numbers'),
        ({"head": [["x"] * 3] * 6}, '"head"'),
        ({"person": ["ann"] * 5 + ["cy"]}, r"'cy' is a person of the rays but not in persons"),
        ({"cohort": ["old"] * 6}, "'old'"),
        ({"persons": "ann"}, "persons needs a sequence of names"),
        ({"metadata": {}}, "state units, up axis and handedness"),
    ],
)
def test_invalid_rows_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        some_rays(**change)


@pytest.mark.parametrize("kind", [list, tuple, np.array, lambda names: np.array(names, object)])
def test_persons_may_be_given_by_name(kind):
    rays = some_rays(
        person=kind(["bo", "ann", "bo", "bo", "ann", "ann"]), cohort=kind(["old"] * 6), cohorts=("new", "old")
    )
    assert rays.person.tolist() == [1, 0, 1, 1, 0, 0] and rays.person.dtype == np.int32
    assert rays.cohort is not None and rays.cohort.tolist() == [1] * 6


def test_integer_codes_of_any_type():
    ones = np.ones((4, 3), int)
    rays = Rays(np.arange(4), np.zeros(4, np.int8), ("ann",), 0 * ones, ones * [0, 0, 1], ones[:, 0], ones)
    assert {a.dtype for a in (rays.t, rays.origin, rays.direction, rays.hit)} == {np.dtype(float)}
    assert (rays.t + 0.5).tolist() == [0.5, 1.5, 2.5, 3.5]


def test_select_keeps_codes_and_provenance():
    part = some_rays().select(some_rays().person == 1)
    assert len(part) == 3 and part.persons == ("ann", "bo") and part.metadata == some_rays().metadata


def test_filter_in_place():
    """The same rays as from `select`, in the memory of the original."""
    rng = np.random.default_rng(0)
    n = 700_000  # more than one block
    rays = some_rays(n, t=rng.random(n), confidence=rng.random(n), hit=rng.random((n, 3)))
    mask = rng.random(n) < 0.6
    want = rays.select(mask)
    selected = rays.filter_in_place(mask)
    for name in ("t", "person", "origin", "direction", "confidence", "hit"):
        assert np.array_equal(getattr(selected, name), getattr(want, name))
        assert np.shares_memory(getattr(selected, name), getattr(rays, name))
    assert selected.cohort is None and len(selected) == mask.sum()


# ---- Merging rays and their metadata ----

AHEAD = np.array([[0.0, 1.0, 0.0]])


def ray(t: float, name: str, other_values=(), **extra) -> Rays:
    persons = tuple(sorted({name, *other_values}))
    return Rays([t], [persons.index(name)], persons, AHEAD, AHEAD, [1.0], **extra)


def test_merge_keeps_occurring_persons_and_fills_missing_columns():
    blocks = [ray(0, "b", ["a", "z"]), ray(1, "a", hit=2 * AHEAD, cohort=[1], cohorts=("x", "y")), ray(2, "b")]
    result = merge_rays(blocks)
    assert result.persons == ("a", "b") and [result.persons[k] for k in result.person] == ["b", "a", "b"]
    assert result.t.tolist() == [0, 1, 2] and np.isnan(result.hit[[0, 2]]).all() and result.hit[1].tolist() == [0, 2, 0]
    assert [result.cohorts[k] for k in result.cohort] == ["unknown", "y", "unknown"]
    assert result.metadata == {"frame": FRAME}
    headed = merge_rays([ray(0, "b"), ray(1, "b", head=AHEAD)])
    assert headed.head.dtype == np.float32 and np.isnan(headed.head[0]).all() and headed.head[1].tolist() == [0, 1, 0]
    without = merge_rays([ray(0, "b"), ray(1, "b")])
    assert without.hit is None and without.cohort is None and without.cohorts == ()


def test_tracking_survives_selection_merging_and_files(tmp_path):
    eyes, heads, old = (ray(k, name).with_tracking(kind) for k, (name, kind) in enumerate(KINDS_OF_RAYS))
    assert ray(0, "a").tracking == old.tracking == "unknown"
    for kinds, expected in (([eyes], "eye"), ([eyes, heads], "mixed"), ([heads, old], "mixed")):
        for merged in (merge_rays(kinds), Rays.concatenate(kinds)):
            assert merged.tracking == expected
            assert [merged[k].tracking for k in range(len(kinds))] == [part.tracking for part in kinds]
            for suffix in (".npz", ".parquet") if importlib.util.find_spec("pyarrow") else (".npz",):
                merged.save(tmp_path / f"rays{suffix}")
                loaded = Rays.load(tmp_path / f"rays{suffix}")
                assert loaded.tracking == expected and loaded[0].tracking == kinds[0].tracking
                loaded[0].save(tmp_path / f"rays{suffix}")
                assert Rays.load(tmp_path / f"rays{suffix}").tracking == kinds[0].tracking
    mixed = merge_rays([eyes, heads])
    assert merge_rays([mixed[0], old]).tracking == "unknown"
    assert merge_rays([mixed, ray(3, "a").with_tracking("head")]).tracking_by_person == {"a": "mixed", "b": "head"}
    assert mixed.with_tracking("eye")[1].tracking == "eye"
    assert merge_rays([eyes, old]).tracking == "unknown"
    assert merge_rays([heads.select(slice(0)), eyes]).tracking == "eye"
    with pytest.raises(NergError, match="'ear'"):
        eyes.with_tracking("ear")
    with pytest.raises(NergError, match="tracking"):
        write_rays_file(tmp_path / "bad.npz", eyes.columns(), {**eyes.metadata, "persons": ["a"], "tracking": ["eye"]})
    for kinds in ({"a": "ear"}, {"a": 1}, ["eye"]):
        with pytest.raises(NergError, match="tracking_by_person"):
            metadata = {**eyes.metadata, "persons": ["a"], "tracking_by_person": kinds}
            write_rays_file(tmp_path / "bad.npz", eyes.columns(), metadata)


KINDS_OF_RAYS = (("a", "eye"), ("b", "head"), ("c", "unknown"))


def test_concatenation():
    first = ray(0, "a", metadata={"frame": FRAME, "rows_read": 3, "sources": [{"file": "a"}], "preset": "table"})
    second = ray(1, "b", metadata={"frame": FRAME, "rows_read": 4, "sources": [{"file": "b"}], "preset": "unity"})
    both = Rays.concatenate(rays for rays in (first, second))
    assert both.persons == ("a", "b") and both.t.tolist() == [0, 1]
    assert both.metadata["rows_read"] == 7 and len(both.metadata["sources"]) == 2 and "preset" not in both.metadata
    with pytest.warns(UserWarning, match="a is a participant of several sets"):
        assert len(Rays.concatenate([first, second, first])) == 3
    aligned = ray(2, "c", metadata={"frame": FRAME, "place_from_rays": np.eye(4).tolist()})
    inches = ray(2, "c", metadata={"frame": {**FRAME, "units": "in"}})
    for bad, reason in (
        ([], "no rays"),
        ([first, "rays.npz"], "element 1 must be Rays"),
        ([first, aligned], "alignment"),
        ([first, inches], "another frame"),
    ):
        with pytest.raises(NergError, match=reason):
            Rays.concatenate(bad)


def test_merge_metadata_keeps_common_values():
    metadata = {"frame": dict(FRAME), "preset": "table", "tick": 1.0, "rows_read": 4, "sources": [{"file": "a"}]}
    metadata["dropped"] = [{"reason": "blink", "file": "a", "count": 1, "rows": [[1, 1]]}]
    metadata["eye_distance"] = {"ann": 0.06}
    metadata["complaints"] = ["the frame is mirrored", "the clock jumps"]
    other = {
        **metadata,
        "complaints": ["the clock jumps", "the gaze is frozen"],
        "eye_distance": {"bo": 0.07},
        "tick": 2.0,
        "rows_read": 5,
        "sources": [{"file": "b"}],
        "dropped": [],
        "missing": {"hit points": 2},
    }
    result = merge_metadata([metadata, other])
    assert result["rows_read"] == 9 and result["sources"] == [{"file": "a"}, {"file": "b"}]
    assert result["eye_distance"] == {"ann": 0.06, "bo": 0.07}
    assert result["complaints"] == ["the frame is mirrored", "the clock jumps", "the gaze is frozen"]
    assert result["dropped"] == metadata["dropped"] and result["preset"] == "table" and "tick" not in result
    assert result["missing"] == {"hit points": 2}


# ---- Uniform sampling of rows ----


@pytest.mark.parametrize("n, runs", [(7, None), (20, None), (33, None), (8, 4), (20, 3)])
def test_rows_are_sampled_uniformly(n, runs):
    counts, each = np.zeros(40), None
    for seed in range(1000):
        rows = sample_rows(40, n, seed, runs)
        assert (np.diff(rows) > 0).all() and rows[0] >= 0 and rows[-1] < 40
        assert each in (None, len(rows))
        each = len(rows)
        counts[rows] += 1
    assert each == (n if runs is None else n // runs * runs)
    # Chi-square with 39 degrees of freedom: 72.1 at p = 0.001; samples without replacement vary less.
    expected = 1000 * each / 40
    assert ((counts - expected) ** 2 / expected).sum() < 72.1


def test_pairs_of_rows_are_sampled_uniformly():
    together = np.zeros((6, 6))
    for seed in range(1500):
        rows = sample_rows(6, 2, seed)
        together[rows[0], rows[1]] += 1
    result = together[np.triu_indices(6, 1)]
    assert result.sum() == 1500 and ((result - 100) ** 2 / 100).sum() < 36.1


def test_runs_consist_of_neighbours():
    rows = sample_rows(10_000, 600, 1, runs=6)
    jumps = np.count_nonzero(np.diff(rows) > 1)
    assert len(rows) == 600 and jumps <= 6


def test_all_rows_and_equal_seeds():
    assert sample_rows(5, 5).tolist() == sample_rows(5, 9, 3, runs=2).tolist() == [0, 1, 2, 3, 4]
    assert np.array_equal(sample_rows(10**12, 50, 4), sample_rows(10**12, 50, 4))
    assert not np.array_equal(sample_rows(10**12, 50, 4), sample_rows(10**12, 50, 5))
