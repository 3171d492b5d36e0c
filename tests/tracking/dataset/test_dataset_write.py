"""Tests of `nerg_mi.tracking.dataset_write`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256, lock_file
from nerg_mi.tracking import dataset, dataset_write
from nerg_mi.tracking.dataset import DatasetManifest, RayDataset, read_source_manifests, write_dataset_manifest
from nerg_mi.tracking.dataset_write import (
    ImportTask,
    SourceDigests,
    SourceWriter,
    has_all_parts,
    import_source,
    update_dataset,
)
from nerg_mi.tracking.pseudonyms import pseudonymise
from nerg_mi.tracking.rays import FRAME, Rays
from nerg_mi.tracking.readers.base import NoOptions, Signature, TrackingFrame
from nerg_mi.tracking.readers.registry import read_rays
from tests.conftest import ROOT
from tests.refusals import mentions
from tests.tracking.dataset.making import DAY, assert_same, crowd, recipe, settings, write_source

pq = pytest.importorskip("pyarrow.parquet")

# ---- Repeated imports: unchanged sources are skipped, changed ones replaced, interrupted imports continued ----


def sources(folder: Path, count: int = 3) -> list[Path]:
    paths = [write_source(folder / f"{k}.csv", k, 60) for k in range(count)]
    for path in paths:
        os.utime(path, (1e9, 1e9))
    return paths


def content(folder: Path) -> dict[str, str]:
    """Files of a dataset by name, without modification times and paths of its sources."""
    files = {str(p.relative_to(folder)): file_sha256(p) for p in folder.rglob("*.parquet")}
    for path in folder.rglob("*.json"):
        manifest = json.loads(path.read_text())
        files[str(path.relative_to(folder))] = str({**manifest, "where": "", "stamp": ""})
    return files


def test_second_import_changes_nothing(tmp_path, monkeypatch):
    files, dataset, names = sources(tmp_path), tmp_path / "shop.rays", []
    one = update_dataset(dataset, files, recipe(), on_done=names.append)
    assert (one.num_imported, one.num_rays, one.num_unchanged) == (3, 177, 0) and sorted(names) == [
        "0.csv",
        "1.csv",
        "2.csv",
    ]
    before = {p: p.stat().st_mtime_ns for p in dataset.rglob("*") if p.is_file()}
    monkeypatch.setattr(dataset_write, "import_source", lambda task: pytest.fail("work"))
    two = update_dataset(dataset, files, recipe())
    assert (two.num_imported, two.num_unchanged, two.num_replaced) == (0, 3, 0)
    assert {p: p.stat().st_mtime_ns for p in dataset.rglob("*") if p.is_file()} == before


def test_equal_content_is_not_imported_again(tmp_path):
    files, dataset = sources(tmp_path), tmp_path / "shop.rays"
    update_dataset(dataset, files, recipe())
    parts = content(dataset)
    os.utime(files[0])  # only the modification time changes
    (tmp_path / "moved").mkdir()
    files[1] = files[1].rename(tmp_path / "moved" / files[1].name)
    result = update_dataset(dataset, files, recipe())
    assert (result.num_imported, result.num_unchanged, result.num_replaced) == (0, 3, 0) and content(dataset) == parts
    # It is recognised at its new path.
    write_source(files[1], 9, 60)
    assert update_dataset(dataset, files, recipe()).num_replaced == 1
    (tmp_path / "twice").mkdir()
    (tmp_path / "twice" / "0.csv").write_bytes(files[0].read_bytes())
    result = update_dataset(tmp_path / "other.rays", [files[0], tmp_path / "twice" / "0.csv"], recipe())
    assert (result.num_imported, result.num_duplicates) == (1, 1) and len(
        RayDataset.open(tmp_path / "other.rays")
    ) == 59


def test_changed_source_is_replaced(tmp_path):
    files, dataset = sources(tmp_path), tmp_path / "shop.rays"
    update_dataset(dataset, files, recipe())
    write_source(files[1], 8, 90)
    result = update_dataset(dataset, files, recipe())
    assert (result.num_imported, result.num_rays, result.num_unchanged, result.num_replaced) == (1, 89, 2, 1)
    assert_same(RayDataset.open(dataset).load(), read_rays("table", files, settings()))
    # Change back; other settings; another place.
    write_source(files[1], 1, 60)
    assert update_dataset(dataset, files, recipe()).num_replaced == 1
    assert update_dataset(dataset, files, recipe(day="2024-01-01")).num_replaced == 3
    assert RayDataset.open(dataset).days == ("2024-01-01",)
    assert update_dataset(dataset, files[:1], recipe(place="north")).num_replaced == 1
    assert RayDataset.open(dataset).places == ("north", "shop")
    (tmp_path / "new").mkdir()
    update_dataset(tmp_path / "new" / "shop.rays", files, recipe())
    assert len(RayDataset.open(dataset)) == len(RayDataset.open(tmp_path / "new" / "shop.rays")) == 177


def test_missing_part_is_imported_again(tmp_path):
    files, dataset = sources(tmp_path), tmp_path / "shop.rays"
    update_dataset(dataset, files, recipe())
    before = content(dataset)
    next(dataset.rglob("part-*.parquet")).unlink()
    assert update_dataset(dataset, files, recipe()).num_imported == 1 and content(dataset) == before


def test_unreadable_source_does_not_stop_the_others(tmp_path):
    files, dataset = sources(tmp_path), tmp_path / "shop.rays"
    files[1].write_text("t,p\n1,2\n")
    result = update_dataset(dataset, files, recipe())
    assert result.num_imported == 2 and len(result.errors) == 1 and "1.csv" in result.errors[0]
    assert len(list(dataset.rglob("_sources/*.json"))) == 2
    # The last line is invalid: the parts written so far are removed.
    write_source(files[1], 1, 60)
    with files[1].open("a") as file:
        file.write("x\n")
    assert len(update_dataset(dataset, files, recipe()).errors) == 1
    assert len(list(dataset.rglob("part-*"))) == len(RayDataset.open(dataset).parts)


def test_leftovers_are_removed(tmp_path):
    files, dataset = sources(tmp_path), tmp_path / "shop.rays"
    update_dataset(dataset, files, recipe())
    before, part = content(dataset), next(dataset.rglob("part-*.parquet"))
    for name in (part.with_name(".part-x.1-ab.part.parquet"), part.with_name("part-x-0.parquet")):
        name.write_bytes(b"x")
    (dataset / "_sources" / ".x.1-ab.part.json").write_text("{")
    (dataset / "notes.txt").write_text("mine")
    update_dataset(dataset, files, recipe())
    assert content(dataset) == before and (dataset / "notes.txt").exists()
    assert not [p for p in dataset.rglob(".*") if p.is_file()]


def test_import_with_pseudonyms(tmp_path):
    """Participants have the same pseudonym in all sources and imports, and neither names nor files are revealed."""
    files, dataset, key = sources(tmp_path, 2), tmp_path / "shop.rays", bytes(range(32))
    update_dataset(dataset, files[:1], recipe(key=key))
    write_source(files[1], 0, 90)  # the same participants
    assert update_dataset(dataset, files, recipe(key=key)).num_unchanged == 1
    opened = RayDataset.open(dataset)
    assert len(opened.persons) == 3 and all(name.startswith("p") and len(name) == 17 for name in opened.persons)
    assert len(opened.load()) == 59 + 89 and opened.metadata["pseudonyms"] == "HMAC-SHA256, salt of a file"
    assert pseudonymise(read_rays("table", files[:1], settings()), key).persons == opened.persons
    written = "".join(p.read_text() for p in dataset.rglob("*.json")) + " ".join(map(str, dataset.rglob("*")))
    for name in ("p0_0", "p0_1", "0.csv", "1.csv", file_sha256(files[0])):
        assert name not in written.replace("f0.csv", "")


@pytest.mark.parametrize(
    "before, after, remedy",
    [
        ({"key": bytes(16)}, {}, "the same salt"),
        ({"key": bytes(16)}, {"key": bytes(range(16))}, "the same salt"),
        (
            {"key": bytes(16), "is_salt_stored": False},
            {"key": bytes(16), "is_salt_stored": False},
            "random salt that was discarded",
        ),
        ({}, {"key": bytes(16)}, "leave out pseudonyms"),
    ],
)
def test_other_pseudonyms_are_refused(tmp_path, before, after, remedy):
    files = sources(tmp_path, 1)
    update_dataset(tmp_path / "a.rays", files, recipe(**before))
    with pytest.raises(NergError, match=remedy):
        update_dataset(tmp_path / "a.rays", files, recipe(**after))


def test_errors_that_concern_all_sources(tmp_path):
    files = sources(tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "a.txt").write_text("x")
    for folder, cases, how, message in (
        ("mine", files, {}, "exists but is not a dataset"),
        ("a.rays", [*files, tmp_path / "absent.csv"], {}, "no tracking file"),
        ("a.rays", files, {"day": "monday"}, "(day)"),
        ("a.rays", [], {}, "list one or more"),
    ):
        with pytest.raises(NergError, match=message):
            update_dataset(tmp_path / folder, cases, recipe(**how))
    assert not (tmp_path / "a.rays").exists()
    update_dataset(tmp_path / "a.rays", files, recipe())
    with (
        lock_file(tmp_path / "a.rays" / dataset.DATASET_MANIFEST, "busy"),
        pytest.raises(NergError, match="another import"),
    ):
        update_dataset(tmp_path / "a.rays", files, recipe())


def test_failed_import_leaves_no_dataset(tmp_path):
    bad, good = tmp_path / "bad.csv", sources(tmp_path, 1)
    bad.write_text("a,b\n1,2\n")
    for folder in (tmp_path / "new" / "a.rays", tmp_path / "b.rays"):
        assert update_dataset(folder, [bad], recipe()).errors
        assert not (tmp_path / "new").exists() and not (tmp_path / "b.rays").exists()
    # An existing folder remains, and so does a dataset with a source.
    (tmp_path / "c.rays").mkdir()
    assert update_dataset(tmp_path / "c.rays", [bad], recipe()).errors and not any((tmp_path / "c.rays").iterdir())
    done = update_dataset(tmp_path / "c.rays", [bad, *good], recipe())
    assert done.num_imported == 1 and done.errors
    assert update_dataset(tmp_path / "c.rays", [bad], recipe()).errors
    assert update_dataset(tmp_path / "c.rays", good, recipe()).num_unchanged == 1


def test_interrupted_import_leaves_no_empty_dataset(tmp_path, monkeypatch):
    def interrupt(*_):
        (tmp_path / "a.rays" / "place=x" / "day=y").mkdir(parents=True)
        raise KeyboardInterrupt

    monkeypatch.setattr(dataset_write, "run_tasks", interrupt)
    with pytest.raises(KeyboardInterrupt):
        update_dataset(tmp_path / "a.rays", sources(tmp_path), recipe())
    assert not (tmp_path / "a.rays").exists()


IMPORT = """
import sys
from pathlib import Path
from nerg_mi.tracking.dataset_write import update_dataset
from tests.tracking.dataset.making import recipe

if __name__ == "__main__":
    update_dataset(Path(sys.argv[1]), sorted(Path(sys.argv[2]).iterdir()), recipe(), workers=2)
"""


def test_killed_import_is_continued(tmp_path):
    """After SIGKILL of the importing process its workers end, and the next import gives the same bytes as an
    undisturbed one."""
    files = [write_source(tmp_path / "files" / f"{k:02d}.csv", k, 3000) for k in range(16)]
    (tmp_path / "import.py").write_text(IMPORT)
    dataset = tmp_path / "shop.rays"
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "import.py"), str(dataset), str(tmp_path / "files")],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        start_new_session=True,
    )
    accounts = lambda: len([p for p in dataset.glob("_sources/*.json") if not p.name.startswith(".")])
    begun = time.monotonic()
    while accounts() < 3:
        assert process.poll() is None and time.monotonic() - begun < 300, "it came to an end"
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    ended = time.monotonic()
    while _alive(process.pid):
        assert time.monotonic() - ended < 60, "processes were left"
        time.sleep(0.05)
    present = accounts()
    assert 3 <= present < len(files)
    # Sources with a manifest are complete at any time.
    opened = RayDataset.open(dataset)
    assert len(opened.load()) == len(opened) == 2999 * present
    result = update_dataset(dataset, files, recipe())
    assert (result.num_imported, result.num_unchanged) == (len(files) - present, present)
    update_dataset(tmp_path / "undisturbed.rays", files, recipe())
    assert content(dataset) == content(tmp_path / "undisturbed.rays")
    assert not list(dataset.rglob("*.part.*"))


def _alive(session: int) -> bool:
    """Whether a process of a session is running."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            return True
    return False


# ---- Worker processes: the same dataset as from one process, without Mitsuba and Dr.Jit ----


def test_two_workers_give_the_same_result_as_one(tmp_path):
    files = sources(tmp_path, 4)
    files[2].write_text("nothing\n")
    one = update_dataset(tmp_path / "one.rays", files, recipe())
    two = update_dataset(tmp_path / "two.rays", files, recipe(), workers=2)
    assert content(tmp_path / "one.rays") == content(tmp_path / "two.rays")
    assert (two.num_imported, two.num_rays) == (one.num_imported, one.num_rays) == (3, 177) and len(
        two.errors
    ) == 1 == len(one.errors)


def ended(task):
    os._exit(1)


def test_killed_worker_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(dataset_write, "import_source", ended)
    with pytest.raises(NergError, check=mentions("workers")):
        update_dataset(tmp_path / "a.rays", sources(tmp_path, 2), recipe(), workers=2)


# ---- Import of one source: in blocks, with pseudonyms, and without any rays ----
HEAD = DatasetManifest(4)


def task(folder, path, **changes) -> ImportTask:
    how = recipe(**changes)
    return ImportTask(
        folder=folder,
        head=HEAD,
        path=path,
        recipe=how,
        recipe_digest=how.digest,
        path_digest=SourceDigests(how.key).digest_path(path),
    )


@pytest.mark.parametrize("key", [None, bytes(range(16))])
def test_import_in_blocks_equals_import_at_once(tmp_path, monkeypatch, key):
    monkeypatch.setattr("nerg_mi.tracking.readers.tables.BLOCK_ROWS", 50)
    monkeypatch.setattr("nerg_mi.tracking.readers.base.STREAM_RAYS", 120)
    path, folder = write_source(tmp_path / "a.csv", people=5), tmp_path / "a.rays"
    write_dataset_manifest(folder, HEAD)
    result = import_source(task(folder, path, key=key))
    assert (result.rays, result.is_unchanged, result.error) == (399, False, None)
    (source,) = read_source_manifests(folder, HEAD)
    assert source.id == result.source and len(source.parts) > 4 and has_all_parts(folder, source)
    assert sum(d["count"] for d in source.metadata["dropped"]) == 1 and source.metadata["rows_read"] == 400
    rays = read_rays("table", path, settings())
    if key is not None:
        rays = pseudonymise(rays, key)
        assert all(source.metadata[key] == rays.metadata[key] for key in ("sources", "dropped"))
        assert source.file == rays.metadata["sources"][0]["file"]
    assert_same(RayDataset.open(folder).load(), rays)
    assert import_source(task(folder, path, key=key)).is_unchanged


class Headset:
    """A reader of heads and eye distances, in cm, with synthetic rays."""

    name, files, world, checked_on, Options = "headset", "", "", "", NoOptions
    signature = Signature()

    def frame(self, files, options):
        return TrackingFrame(units="cm")

    def read(self, files, options, builder):
        builder.begin_source(files[0])
        for k, (name, metres) in enumerate((("ann", 6.0), ("bo", 6.4), ("ann", 7.0))):
            ahead = np.tile([0.0, 2.0, 0.0], (50, 1))
            heads = np.where(np.arange(50)[:, None] < 25, ahead, np.nan)
            t, eye_distance = np.arange(50) + 50.0 * k, np.full(50, metres)
            builder.add(t, name, ahead, ahead, rows=np.arange(50), head=heads, eye_distance=eye_distance)
        builder.add_warning("the headset was put on askew")


@pytest.mark.parametrize("key", [None, bytes(range(16))])
def test_heads_eye_distances_and_warnings_are_stored(tmp_path, monkeypatch, key):
    monkeypatch.setattr("nerg_mi.tracking.readers.base.STREAM_RAYS", 40)
    (tmp_path / "a.bin").write_bytes(b"x")
    write_dataset_manifest(tmp_path / "a.rays", HEAD)
    options = task(tmp_path / "a.rays", tmp_path / "a.bin", reader=Headset(), settings=None, key=key)
    assert import_source(options).rays == 150
    rays = RayDataset.open(tmp_path / "a.rays").load()
    assert rays.metadata["complaints"] == ["the headset was put on askew"]
    expected = np.isfinite(rays.head).all(axis=1)
    assert rays.head.dtype == np.float32 and (rays.head[expected] == [0, 1, 0]).all()
    assert np.array_equal(expected, rays.t % 50 < 25)
    # Those of the first block of each.
    both_eyes = rays.metadata["eye_distance"]
    assert set(both_eyes) == set(rays.persons) and np.allclose(sorted(both_eyes.values()), [0.06, 0.064])
    assert (set(both_eyes) == {"ann", "bo"}) is (key is None)


def test_source_without_rays_has_a_manifest(tmp_path):
    path, folder = write_source(tmp_path / "a.csv", count=1), tmp_path / "a.rays"
    path.write_text(path.read_text().replace("0.000,", ",", 1))
    write_dataset_manifest(folder, HEAD)
    assert import_source(task(folder, path)).rays == 0
    (source,) = read_source_manifests(folder, HEAD)
    assert source.parts == [] and source.metadata["dropped"][0]["reason"] == "time is missing"


def test_invalid_recording_is_refused_before_reading_all_of_it(tmp_path, monkeypatch):
    folder, path = tmp_path / "a.rays", tmp_path / "a.csv"
    write_dataset_manifest(folder, HEAD)
    monkeypatch.setattr(SourceDigests, "digest_source", lambda *_: pytest.fail("it was read to its end"))
    with path.open("wb") as out:
        out.truncate(3 << 30)
    assert "1,048,576 characters" in (import_source(task(folder, path)).error or "")


def test_copy_of_a_source_is_recognised_at_its_first_rays(tmp_path, monkeypatch):
    monkeypatch.setattr("nerg_mi.tracking.readers.tables.BLOCK_ROWS", 50)
    monkeypatch.setattr("nerg_mi.tracking.readers.base.STREAM_RAYS", 120)
    path, folder = write_source(tmp_path / "a.csv", people=5), tmp_path / "a.rays"
    write_dataset_manifest(folder, HEAD)
    first = import_source(task(folder, path))
    (tmp_path / "b").mkdir()
    copy = write_source(tmp_path / "b" / "a.csv", people=5)
    monkeypatch.setattr("nerg_mi.tracking.dataset_write.SourceWriter", lambda *_: pytest.fail("it was written again"))
    again = import_source(task(folder, copy))
    assert again.is_unchanged and again.source == first.source and len(read_source_manifests(folder, HEAD)) == 1


# ---- Identity of sources ----


@pytest.fixture
def source(tmp_path) -> Path:
    (tmp_path / "a.csv").write_text("x")
    os.utime(tmp_path / "a.csv", (1e9, 1e9))
    return tmp_path / "a.csv"


def test_digests_of_path_content_and_name(source, tmp_path):
    marks = SourceDigests()
    before = marks.digest_path(source), marks.digest_stamp(source), marks.digest_source(source, "r")
    assert len(set(before)) == 3 and all(len(mark) == 32 for mark in before)
    source.write_text("y")
    os.utime(source, (1e9, 1e9))
    # The content differs although the modification time does not.
    assert marks.digest_stamp(source) == before[1] and marks.digest_source(source, "r") != before[2]
    (tmp_path / "b.csv").write_text("y")
    assert (
        marks.digest_source(tmp_path / "b.csv", "r")
        != marks.digest_source(source, "r")
        != marks.digest_source(source, "s")
    )
    (tmp_path / "link.csv").symlink_to(source)
    assert marks.digest_path(tmp_path / "link.csv") == before[0]
    with pytest.raises(NergError, match="no tracking file"):
        marks.digest_stamp(tmp_path / "absent.csv")


def test_recently_modified_source_has_no_stamp(source):
    os.utime(source)
    assert SourceDigests().digest_stamp(source) is None


def test_folders(tmp_path):
    for name in ("b/2.csv", "a.csv"):
        (tmp_path / "session" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "session" / name).write_text(name)
        os.utime(tmp_path / "session" / name, (1e9, 1e9))
    marks, folder = SourceDigests(), tmp_path / "session"
    one = marks.digest_stamp(folder), marks.digest_source(folder, "r")
    os.utime(folder / "b/2.csv", (1e9, 2e8))
    assert marks.digest_stamp(folder) != one[0] and marks.digest_source(folder, "r") == one[1]
    (folder / "b/2.csv").rename(folder / "b/3.csv")
    assert marks.digest_source(folder, "r") != one[1]


def test_digest_of_import_settings(tmp_path):
    marks = SourceDigests()
    assert marks.digest_recipe("table", settings()) == marks.digest_recipe("table", settings())
    result = {
        marks.digest_recipe("table", settings()),
        marks.digest_recipe("other", settings()),
        marks.digest_recipe("table", NoOptions()),
    }
    assert len(result | {marks.digest_recipe("table", settings(), day="2024-01-01")}) == 4


def test_digests_depend_on_the_salt(source):
    one, two = SourceDigests(bytes(16)), SourceDigests(bytes(range(16)))
    for name in ("digest_path", "digest_stamp"):
        assert len({getattr(marks, name)(source) for marks in (SourceDigests(), one, two)}) == 3
    assert len({marks.digest_source(source, "r") for marks in (SourceDigests(), one, two)}) == 3


# ---- Parts of a source, as read by other programs ----

ID = "0" * 32
MANIFEST_FIELDS = {"file": "a.csv", "where": "w", "stamp": None, "recipe": "r", "generation": 0}


def test_parts_are_by_day_and_bucket_and_sorted(tmp_path):
    import pyarrow.dataset

    rays = crowd(start=DAY + 86_350)  # fifty seconds before midnight
    writer = SourceWriter(tmp_path, ID, 4)
    writer.add(rays, "shop / 1")
    writer.add(rays.select(rays.t < 0))
    source = writer.finish({"frame": dict(FRAME)}, **MANIFEST_FIELDS)
    write_dataset_manifest(tmp_path, DatasetManifest(4))
    assert read_source_manifests(tmp_path, DatasetManifest(4)) == [source] and source.rays == 1000
    names = np.array(rays.persons)[rays.person]
    assert source.persons == {name: int((names == name).sum()) for name in sorted(rays.persons)}
    for part in source.parts:
        path = tmp_path / part.path(ID)
        table = pq.read_table(path, partitioning=None)
        who, t = table.column("person").to_pylist(), table.column("t").to_pylist()
        assert list(zip(who, t)) == sorted(zip(who, t)) and len(t) == part.rays
        assert {dataset.compute_bucket(name, 4) for name in who} == {part.bucket} and (part.first, part.last) == (
            who[0],
            who[-1],
        )
        assert (part.start, part.end, part.bytes) == (min(t), max(t), path.stat().st_size)
        same = np.array(who[1:]) == np.array(who[:-1])
        steps = np.diff(t)[same]
        assert np.isclose(part.recorded, steps[steps <= 1].sum()) and part.duplicates == 0 and part.hits == 0
        for k, axis in enumerate("xyz"):
            column = table.column(f"origin_{axis}").to_numpy()
            assert (part.low[k], part.high[k]) == (column.min(), column.max())
    # Other programs read the folders as columns.
    result = pyarrow.dataset.dataset(tmp_path, format="parquet", partitioning="hive").to_table()
    assert set(result.column("day").to_pylist()) == {"2024-10-04", "2024-10-05"}
    assert set(result.column("place").to_pylist()) == {"shop / 1"} and result.num_rows == 1000


def test_given_and_unknown_days(tmp_path):
    for id, cases, present in (("0" * 32, "2020-01-01", "2020-01-01"), ("1" * 32, None, "unknown")):
        writer = SourceWriter(tmp_path, id, 4)
        writer.add(crowd(start=DAY if cases else 0.0), day=cases)
        assert {part.day for part in writer.finish({"frame": dict(FRAME)}, **MANIFEST_FIELDS).parts} == {present}


def test_parts_and_groups_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(dataset_write, "PART_ROWS", 300)
    monkeypatch.setattr(dataset_write, "GROUP_ROWS", 100)
    writer = SourceWriter(tmp_path, ID, 1)
    writer.add(crowd())
    parts = writer.finish({"frame": dict(FRAME)}, **MANIFEST_FIELDS).parts
    assert [part.rays for part in parts] == [300, 300, 300, 100] and [part.number for part in parts] == [0, 1, 2, 3]
    assert pq.ParquetFile(tmp_path / parts[0].path(ID)).metadata.num_row_groups == 3


def test_rays_that_a_dataset_cannot_store_are_refused(tmp_path):
    rays = crowd(3)
    far = Rays(rays.t, rays.person, rays.persons, rays.origin * 0 + 9000, rays.direction, rays.confidence)
    with pytest.raises(NergError, match=r"9e\+03 m from zero.*units"):
        SourceWriter(tmp_path, ID, 1).add(far)
    odd = Rays(rays.t, rays.person, ("a", "b", "c", "\udce4"), rays.origin, rays.direction, rays.confidence)
    with pytest.raises(NergError, match="not valid Unicode"):
        SourceWriter(tmp_path, ID, 1).add(odd)
    assert not list(tmp_path.iterdir())


def test_many_runs_of_dropped_rows_are_counted(tmp_path):
    rows = [[2 * k, 2 * k] for k in range(1500)]
    dropped = [{"reason": "blink", "file": "a", "count": 1500, "rows": rows}]
    result = SourceWriter(tmp_path, ID, 1).finish({"frame": dict(FRAME), "dropped": dropped}, **MANIFEST_FIELDS)
    (entry,) = result.metadata["dropped"]
    assert len(entry["rows"]) == 1000 and entry["rows_not_named"] == 500 and entry["count"] == 1500
