"""Tests of `nerg_mi.tracking.dataset`: results compared with the rays of the same files in memory."""

from __future__ import annotations

import json
import os
import shutil
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256
from nerg_mi.tracking import dataset, dataset_write
from nerg_mi.tracking.dataset import Conditions, RayDataset, hash_rays, is_dataset, read_groups
from nerg_mi.tracking.dataset_write import update_dataset
from nerg_mi.tracking.filters import select_mask
from nerg_mi.tracking.quality import summarise, summarise_dataset
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.readers.columns import ColumnMap
from nerg_mi.tracking.readers.registry import make_options
from tests.refusals import mentions
from tests.tracking.dataset.making import DAY, MAP, assert_same, recipe, write_dataset, write_source

pytest.importorskip("pyarrow")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A dataset of small row groups, and the same rays in memory."""
    with pytest.MonkeyPatch.context() as change:
        change.setattr(dataset_write, "GROUP_ROWS", 16)
        return write_dataset(tmp_path_factory.mktemp("made"))


def test_scan_returns_all_rays_of_the_files(made):
    dataset, rays = made
    assert_same(dataset.load(), rays)
    assert len(dataset) == len(rays) and dataset.persons == rays.persons and dataset.places == ("shop",)
    assert dataset.days == ("2024-10-04", "2024-10-05")
    assert dataset.cohorts == {name: int((rays.cohort == k).sum()) for k, name in enumerate(rays.cohorts)}
    metadata = dataset.metadata
    for key in ("rows_read", "frame", "transform", "source_frame", "preset", "columns", "tick"):
        assert metadata[key] == rays.metadata[key]
    by_file = lambda entry: entry["file"]
    assert sorted(metadata["sources"], key=by_file) == rays.metadata["sources"]
    assert sorted(metadata["dropped"], key=by_file) == sorted(rays.metadata["dropped"], key=by_file)


@pytest.mark.parametrize(
    "conditions",
    [
        {"persons": ["p0_1", "p2_0"]},
        {"without_persons": ["p0_1"]},
        {"time": (DAY + 2, DAY + 43_203)},
        {"box": [1.0, 4.5, 0.0, 3.0, 1.5, 1.8]},
        {"min_confidence": 0.7},
        {"with_hit": True},
        {"cohorts": ["y"]},
        {"cohorts": ["y"], "box": [0, 3, 0, 6, 0, 3], "time": (None, DAY + 5), "persons": ["p0_0"]},
    ],
)
def test_conditions_match_select_mask(made, conditions):
    dataset, rays = made
    result = dataset.load(Conditions(**conditions))
    assert 0 < len(result) < len(rays)
    assert_same(result, rays.select(select_mask(rays, **conditions)))
    complete = list(dataset.scan(Conditions(**conditions), whole_parts=True))
    assert sum(map(len, complete)) == len(result)
    for block in complete:
        names = [block.persons[k] for k in block.person]
        assert list(zip(names, block.t)) == sorted(zip(names, block.t))


def test_groups_without_matching_rays_are_not_read(made, monkeypatch):
    dataset, rays = made
    read = []

    def counted(folder, source, part, wanted, hits=True):
        for result in read_groups(folder, source, part, wanted, hits):
            read.append(len(result[1]))
            yield result

    monkeypatch.setattr("nerg_mi.tracking.dataset.read_groups", counted)
    result = sum(map(len, dataset.scan(Conditions(persons=["p1_2"]))))
    assert result == np.sum(np.array(rays.persons)[rays.person] == "p1_2") and sum(read) < result + 32
    read.clear()
    dataset.sample(1)
    assert len(read) == 1
    read.clear()
    assert len(dataset.sample(64, runs=2)) == 64 and sum(read) <= 32 * 2 + 4 * 16 < len(rays) / 4


def test_unknown_names_are_refused(made):
    for cases, why in (
        ({"persons": ["p9"]}, "no person is called 'p9'; there are p0_0, p0_1"),
        ({"without_persons": ["p9"]}, "no person"),
        ({"cohorts": ["z"]}, "no cohort is called 'z'"),
        ({"box": [0, 1, 2]}, "a box needs"),
    ):
        with pytest.raises(NergError, match=why):
            list(made[0].scan(Conditions(**cases)))


def test_tracking_is_that_of_the_selected_sources(tmp_path):
    eyes, heads = (write_source(tmp_path / f"{k}.csv", k) for k in range(2))
    update_dataset(tmp_path / "a.rays", [eyes], recipe())
    options = make_options("table", {"columns": ColumnMap.parse(MAP), "tracking": "head"})
    update_dataset(tmp_path / "b.rays", [heads], recipe(settings=options, key=bytes(32)))
    assert RayDataset.open(tmp_path / "a.rays").load().tracking == "eye"
    dataset = RayDataset.open(tmp_path / "b.rays")
    assert dataset.load().tracking == dataset.sample(10).tracking == Rays.load(tmp_path / "b.rays").tracking == "head"
    assert all(block.tracking == "head" for block in dataset.scan())


def test_participants_are_found_by_another_form_of_their_name(tmp_path):
    composed, decomposed = "J\u00f6rg", "Jo\u0308rg"
    paths = [write_source(tmp_path / f"{k}.csv", k, people=2) for k in range(2)]
    for path, name in zip(paths, (composed, decomposed)):
        path.write_text(path.read_text().replace(f"p{path.stem}_0", name))
    update_dataset(tmp_path / "a.rays", paths, recipe())
    dataset = RayDataset.open(tmp_path / "a.rays")
    assert set(dataset.persons) == {composed, "p0_1", "p1_1"}
    for name in (composed, decomposed):
        assert len(dataset.load(Conditions(persons=[name]))) == 398  # the third row of each file has no confidence
        assert len(dataset.load(Conditions(without_persons=[name]))) == 400


def test_datasets_of_earlier_versions_have_two_forms_of_a_name(tmp_path, monkeypatch):
    composed, decomposed = "J\u00f6rg", "Jo\u0308rg"
    paths = [write_source(tmp_path / f"{k}.csv", k, people=1) for k in range(2)]
    for path, name in zip(paths, (composed, decomposed)):
        path.write_text(path.read_text().replace(f"p{path.stem}_0", name))
    with monkeypatch.context() as change:
        change.setattr("nerg_mi.files.values.unicodedata.normalize", lambda form, text: text)
        update_dataset(tmp_path / "a.rays", paths, recipe())
    dataset = RayDataset.open(tmp_path / "a.rays")
    assert set(dataset.persons) == {composed, decomposed}
    for name in (composed, decomposed):
        rays = dataset.load(Conditions(persons=[name]))
        assert len(rays) == 798 and rays.persons == (composed,)
        assert not len(dataset.load(Conditions(without_persons=[name])))


def test_too_many_rays_are_refused(made):
    dataset, rays = made
    with pytest.raises(NergError, match="1,197.*1,000.*sample"):
        dataset.load(max_rays=1000)
    with pytest.raises(NergError, match="more than .* such rays"):
        dataset.load(Conditions(with_hit=True), max_rays=300)
    assert len(dataset.load(Conditions(persons=["p0_0"]), max_rays=300)) == 134


def test_samples(made):
    dataset, rays = made
    one, two = dataset.sample(200, 3), dataset.sample(200, 3)
    assert np.array_equal(one.t, two.t) and np.array_equal(one.person, two.person) and len(one) == 200
    assert one.metadata["steps"] == [{"step": "sample", "kept": 200, "of": len(rays), "seed": 3}]
    complete = dataset.load()
    key = lambda r: set(zip(r.t.tolist(), (r.persons[k] for k in r.person), r.origin[:, 0].tolist()))
    assert len(key(one)) == 200 and key(one) < key(complete)
    assert not np.array_equal(dataset.sample(200, 4).t, one.t)
    every = dataset.sample(10_000)
    assert np.array_equal(every.t, complete.t) and "steps" not in every.metadata
    assert dataset.sample(200, read_hits=False).hit is None and dataset.load(read_hits=False).hit is None


def test_several_places_are_not_merged(tmp_path):
    write_dataset(tmp_path, 2)
    update_dataset(tmp_path / "shop.rays", [write_source(tmp_path / "n.csv", 7)], recipe(place="north"))
    both = RayDataset.open(tmp_path / "shop.rays")
    for ask in (both.load, lambda: both.sample(3)):
        with pytest.raises(NergError, match="2 environments, each in a frame of its own; select one.*place=north"):
            ask()
    north = RayDataset.open(tmp_path / "shop.rays" / "place=north")
    assert north.persons == ("p7_0", "p7_1", "p7_2") and len(north.load()) == 399 == len(both.select_place("north"))
    day = RayDataset.open(tmp_path / "shop.rays" / "place=shop" / "day=2024-10-04")
    assert day.days == ("2024-10-04",) and 0 < len(day) == len(day.load())
    with pytest.raises(NergError, match="has no rays of place south"):
        RayDataset.open(tmp_path / "shop.rays" / "place=south")


def test_digest_depends_on_the_content(tmp_path):
    dataset, _ = write_dataset(tmp_path, 2)
    shutil.copytree(tmp_path / "shop.rays", tmp_path / "copy.rays")
    assert RayDataset.open(tmp_path / "copy.rays").digest == dataset.digest and len(dataset.digest) == 64
    update_dataset(tmp_path / "shop.rays", [write_source(tmp_path / "n.csv", 7)], recipe())
    assert RayDataset.open(tmp_path / "shop.rays").digest != dataset.digest


def test_other_folders_are_refused(tmp_path):
    for path in (tmp_path, tmp_path / "absent.rays"):
        with pytest.raises(NergError, match="not a dataset; create one"):
            RayDataset.open(path)


def test_damaged_parts(tmp_path):
    """Each is reported in one sentence with the name of the file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    dataset, _ = write_dataset(tmp_path, 1)
    source, part = dataset.parts[0]
    path = dataset.folder / part.path(source.id)
    good, table = path.read_bytes(), pq.read_table(path, partitioning=None)

    def rewritten(change) -> bytes:
        pq.write_table(change(table), tmp_path / "x.parquet")
        return (tmp_path / "x.parquet").read_bytes()

    def exchanged(name, values):
        return lambda t: t.set_column(t.schema.get_field_index(name), name, values)

    n = part.rays
    cases = {
        "bytes, but": good[:-10],
        "cannot be read": bytes(len(good)),
        "has 3 rays, but": rewritten(lambda t: t.slice(0, 3)),
        'no column "t"': rewritten(lambda t: t.drop_columns(["t"])),
        'column "origin_x" has another type': rewritten(exchanged("origin_x", pa.array(["a"] * n))),
        'column "person" has another type': rewritten(exchanged("person", pa.array(range(n)))),
        "a person who is not in the manifest": rewritten(exchanged("person", pa.array(["eve"] * n))),
        "names are missing": rewritten(exchanged("person", pa.array([None] * n, pa.string()))),
        "a direction that is not of unit length": rewritten(exchanged("direction_x", pa.array([9.0] * n))),
        "an origin that is not finite": rewritten(exchanged("origin_y", pa.array([float("nan")] * n))),
    }
    account = dataset.folder / "_sources" / f"{source.id}.json"
    selected = account.read_text()
    for why, content in cases.items():
        path.write_bytes(content)
        if why != "bytes, but":  # otherwise the size is correct
            manifest = json.loads(selected)
            manifest["parts"][part.number]["bytes"] = len(content)
            account.write_text(json.dumps(manifest))
        with pytest.raises(NergError, match=why) as error:
            RayDataset.open(dataset.folder).load()
        assert str(path) in str(error.value) and "\n" not in str(error.value)
        account.write_text(selected)
    path.unlink()
    with pytest.raises(NergError, match="part of a dataset"):
        dataset.load()
    (tmp_path / "elsewhere.parquet").write_bytes(good)
    path.symlink_to(tmp_path / "elsewhere.parquet")
    with pytest.raises(NergError, match="a link to outside"):
        dataset.load()
    os.remove(path)
    path.mkdir()
    with pytest.raises(NergError, match="is a folder"):
        dataset.load()


# ---- Row groups of a part ----


def test_row_groups_have_first_rows_and_bounds(tmp_path, monkeypatch):
    monkeypatch.setattr(dataset_write, "GROUP_ROWS", 50)
    dataset, _ = write_dataset(tmp_path, 1)
    source, part = max(dataset.parts, key=lambda entry: entry[1].rays)
    seen = []

    def wanted(first, count, bounds):
        seen.append((first, count, bounds))
        return first != 50

    groups = list(read_groups(dataset.folder, source, part, wanted))
    assert [first for first, _ in groups] == [first for first, *_ in seen if first != 50]
    assert sum(count for _, count, _ in seen) == part.rays > 100
    for first, rays in groups:
        _, count, bounds = next(entry for entry in seen if entry[0] == first)
        assert len(rays) == count and bounds["t"] == (rays.t.min(), rays.t.max())
        assert bounds["origin_y"] == (np.float32(rays.origin[:, 1].min()), np.float32(rays.origin[:, 1].max()))
        assert bounds["person"] == (rays.persons[0], rays.persons[-1])
    (_, bare), *_ = read_groups(dataset.folder, source, part, lambda *_: True, read_hits=False)
    assert bare.hit is None and bare.cohort is not None


# ---- Loading rays from a path: a file, a dataset, or a place of one ----


def test_files_and_datasets(tmp_path):
    dataset, rays = write_dataset(tmp_path)
    rays.save(tmp_path / "rays.npz")
    for path in (tmp_path / "rays.npz", dataset.folder, dataset.folder / "place=shop"):
        assert_same(Rays.load(path), rays)
        assert is_dataset(path) is (path.suffix != ".npz")
    assert hash_rays(tmp_path / "rays.npz") == file_sha256(tmp_path / "rays.npz")
    assert hash_rays(dataset.folder) == dataset.digest
    some = Rays.load(dataset.folder, 100, seed=2)
    assert np.array_equal(some.t, dataset.sample(100, 2).t) and len(Rays.load(dataset.folder, 5000)) == len(rays)
    assert len(Rays.load(tmp_path / "rays.npz", 100)) == len(rays)


# ---- Quality report of a dataset: that of the same rays in a file, except for figures of a sample ----

EXACT = ("rays", "persons", "duplicates", "rows_read", "dropped", "cohorts")


@pytest.mark.parametrize("max_rays", [10_000, 640])
def test_quality_report_of_a_dataset(made, max_rays):
    dataset, rays = made
    report = summarise_dataset(dataset, "shop", max_rays)
    some, result, lines = report.rays, report.summary, report.notes
    complete = summarise(rays)
    assert [getattr(result, name) for name in EXACT] == [getattr(complete, name) for name in EXACT]
    exact = ("duration", "box_low", "box_high", "hit_fraction")
    for name in exact if max_rays == 640 else (*exact, "eye_height", "speed_p95", "hit_distance", "sampling_rate"):
        assert np.allclose(getattr(result, name), getattr(complete, name), rtol=1e-5), name
    assert abs(result.eye_height[1] - complete.eye_height[1]) < 0.1 and len(some) == min(max_rays, len(rays))
    assert lines[0][0] == "dataset" and lines[0][1].startswith("3 sources in ")
    assert lines[0][1].endswith("place shop, day 2 from 2024-10-04 to 2024-10-05")
    assert [text for _, text in lines[1:]] == ([] if max_rays > 640 else [lines[1][1]]) and (
        max_rays > 640 or "640 rays in 64 runs" in lines[1][1]
    )


# ---- Layout and columns of parts ----


def test_days_are_in_utc():
    moments = [datetime(2024, 2, 29, 23, 59, 59, tzinfo=timezone.utc), datetime(2024, 3, 1, tzinfo=timezone.utc)]
    days = dataset_write.utc_days(np.array([m.timestamp() for m in moments]))
    assert [str(np.datetime64(int(d), "D")) for d in days] == ["2024-02-29", "2024-03-01"]


@pytest.mark.parametrize("t", [[0.0, 12.5], [1.7e9, 3.0], [1.7e18], [], [-5.0]])
def test_other_clocks_give_no_day(t):
    assert dataset_write.utc_days(np.array(t)) is None


def test_buckets_depend_only_on_the_name_and_are_uniform():
    result = [dataset.compute_bucket(f"user{k}", 16) for k in range(4000)]
    counts = np.bincount(result, minlength=16)
    assert len(counts) == 16 and counts.min() > 180 and counts.max() < 320
    # Buckets are part of the file format.
    assert [dataset.compute_bucket(name, 16) for name in ("ann", "bo", "名")] == [2, 0, 3]


def test_place_names_may_have_any_characters():
    for place in ("北 hall", "a/b", "..", "x=1", "100 %"):
        folder = Path("d.rays") / dataset.partition_folder(dataset.check_place(place), "unknown", 3)
        assert len(folder.parts) == 4 and ".." not in folder.parts
        assert dataset.split_partition_path(folder) == (
            Path("d.rays"),
            {"place": place, "day": "unknown", "bucket": "3"},
        )


@pytest.mark.parametrize("place", ["", " a", "a\n", "x" * 65, "\x1b[2J"])
def test_invalid_places_are_refused(place):
    with pytest.raises(NergError, check=mentions("environment")):
        dataset.check_place(place)


@pytest.mark.parametrize("day", ["", "2024-13-01", "2023-02-29", "today", "2024-1-1", "../x"])
def test_invalid_days_are_refused(day):
    with pytest.raises(NergError, check=mentions("day")):
        dataset.check_day(day)
    assert dataset.check_day("2024-02-29") == "2024-02-29" and dataset.check_day("unknown") == "unknown"


def test_columns():
    ahead = np.tile([0.0, 1.0, 0.0], (3, 1))
    rays = Rays([1.7e9 + 1e-6, 0.1, 2.0], [2, 0, 2], ("a", "b", "c"), ahead * 0.1, ahead, [0.7, 1, 1])
    table = dataset_write.make_part_table(rays, np.array([2, 0]))
    assert table.schema == dataset_write.part_schema()
    assert table.column("person").to_pylist() == ["c", "c"] and table.column("t").to_pylist() == [2.0, 1.7e9 + 1e-6]
    # Confidences are exact, so that rays at the threshold are kept.
    assert table.column("confidence").to_pylist() == [1.0, 0.7]
    assert table.column("cohort").null_count == 2 and np.isnan(table.column("hit_x").to_numpy()).all()
    assert table.column("origin_y").to_pylist() == [float(np.float32(0.1))] * 2
