"""Imports again: what is there is left, what has changed is replaced, and what was broken off goes on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256, locked
from nerg_mi.rays import dataset_write
from nerg_mi.rays.dataset import HEAD, RayDataset
from nerg_mi.rays.dataset_write import update_dataset
from nerg_mi.rays.readers.registry import read_rays
from tests.conftest import ROOT

from .making import assert_same, recipe, settings, write_source

pytest.importorskip("pyarrow")


def sources(folder: Path, count: int = 3) -> list[Path]:
    paths = [write_source(folder / f"{k}.csv", k, 60) for k in range(count)]
    for path in paths:
        os.utime(path, (1e9, 1e9))
    return paths


def content(folder: Path) -> dict[str, str]:
    """The files of a dataset by their names, but for when its sources were changed and where they lie."""
    found = {str(p.relative_to(folder)): file_sha256(p) for p in folder.rglob("*.parquet")}
    for path in folder.rglob("*.json"):
        about = json.loads(path.read_text())
        found[str(path.relative_to(folder))] = str({**about, "where": "", "stamp": ""})
    return found


def test_again_does_nothing(tmp_path, monkeypatch):
    files, dataset, names = sources(tmp_path), tmp_path / "shop.rays", []
    one = update_dataset(dataset, files, recipe(), on_done=names.append)
    assert (one.imported, one.rays, one.unchanged) == (3, 177, 0) and sorted(names) == ["0.csv", "1.csv", "2.csv"]
    before = {p: p.stat().st_mtime_ns for p in dataset.rglob("*") if p.is_file()}
    monkeypatch.setattr(
        dataset_write, "run_tasks", lambda tasks, workers: iter([]) if not tasks else pytest.fail("work")
    )
    two = update_dataset(dataset, files, recipe())
    assert (two.imported, two.unchanged, two.replaced) == (0, 3, 0)
    assert {p: p.stat().st_mtime_ns for p in dataset.rglob("*") if p.is_file()} == before


def test_the_same_content_is_not_imported_again(tmp_path):
    files, dataset = sources(tmp_path), tmp_path / "shop.rays"
    update_dataset(dataset, files, recipe())
    parts = content(dataset)
    os.utime(files[0])  # touched
    (tmp_path / "moved").mkdir()
    files[1] = files[1].rename(tmp_path / "moved" / files[1].name)
    found = update_dataset(dataset, files, recipe())
    assert (found.imported, found.unchanged, found.replaced) == (0, 3, 0) and content(dataset) == parts
    # From its new place it is known again.
    write_source(files[1], 9, 60)
    assert update_dataset(dataset, files, recipe()).replaced == 1
    (tmp_path / "twice").mkdir()
    (tmp_path / "twice" / "0.csv").write_bytes(files[0].read_bytes())
    found = update_dataset(tmp_path / "other.rays", [files[0], tmp_path / "twice" / "0.csv"], recipe())
    assert (found.imported, found.alike) == (1, 1) and len(RayDataset.open(tmp_path / "other.rays")) == 59


def test_what_has_changed_is_replaced(tmp_path):
    files, dataset = sources(tmp_path), tmp_path / "shop.rays"
    update_dataset(dataset, files, recipe())
    write_source(files[1], 8, 90)
    found = update_dataset(dataset, files, recipe())
    assert (found.imported, found.rays, found.unchanged, found.replaced) == (1, 89, 2, 1)
    assert_same(RayDataset.open(dataset).load(), read_rays("table", files, settings()))
    # And back again; read in another way; at another place.
    write_source(files[1], 1, 60)
    assert update_dataset(dataset, files, recipe()).replaced == 1
    assert update_dataset(dataset, files, recipe(day="2024-01-01")).replaced == 3
    assert RayDataset.open(dataset).days == ("2024-01-01",)
    assert update_dataset(dataset, files[:1], recipe(place="north")).replaced == 1
    assert RayDataset.open(dataset).places == ("north", "shop")
    (tmp_path / "new").mkdir()
    update_dataset(tmp_path / "new" / "shop.rays", files, recipe())
    assert len(RayDataset.open(dataset)) == len(RayDataset.open(tmp_path / "new" / "shop.rays")) == 177


def test_what_is_missing_is_imported_again(tmp_path):
    files, dataset = sources(tmp_path), tmp_path / "shop.rays"
    update_dataset(dataset, files, recipe())
    before = content(dataset)
    next(dataset.rglob("part-*.parquet")).unlink()
    assert update_dataset(dataset, files, recipe()).imported == 1 and content(dataset) == before


def test_one_that_cannot_be_read_does_not_stop_the_others(tmp_path):
    files, dataset = sources(tmp_path), tmp_path / "shop.rays"
    files[1].write_text("t,p\n1,2\n")
    found = update_dataset(dataset, files, recipe())
    assert found.imported == 2 and len(found.errors) == 1 and "1.csv" in found.errors[0]
    assert len(list(dataset.rglob("_sources/*.json"))) == 2
    # Broken in its last line: what was written of it is not left.
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


def test_under_pseudonyms(tmp_path):
    """Equal people have equal names in all sources and imports, and nothing tells the names or the files."""
    files, dataset, key = sources(tmp_path, 2), tmp_path / "shop.rays", bytes(range(32))
    update_dataset(dataset, files[:1], recipe(key=key))
    write_source(files[1], 0, 90)  # the same people
    assert update_dataset(dataset, files, recipe(key=key)).unchanged == 1
    opened = RayDataset.open(dataset)
    assert len(opened.persons) == 3 and all(name.startswith("p") and len(name) == 17 for name in opened.persons)
    assert len(opened.load()) == 59 + 89 and opened.metadata["pseudonyms"] == "HMAC-SHA256, salt of a file"
    from nerg_mi.rays.pseudonyms import pseudonymise

    assert pseudonymise(read_rays("table", files[:1], settings()), key).persons == opened.persons
    written = "".join(p.read_text() for p in dataset.rglob("*.json")) + " ".join(map(str, dataset.rglob("*")))
    for name in ("p0_0", "p0_1", "0.csv", "1.csv", file_sha256(files[0])):
        assert name not in written.replace("f0.csv", "")
    for other, remedy in ((None, "same --pseudonyms --salt"), (bytes(32), "same --pseudonyms --salt")):
        with pytest.raises(NergError, match=remedy):
            update_dataset(dataset, files, recipe(key=other))
    update_dataset(tmp_path / "random.rays", files, recipe(key=key, kept_salt=False))
    with pytest.raises(NergError, match="random salt that nobody has kept"):
        update_dataset(tmp_path / "random.rays", files, recipe(key=key, kept_salt=False))
    update_dataset(tmp_path / "plain.rays", files, recipe())
    with pytest.raises(NergError, match="leave out --pseudonyms"):
        update_dataset(tmp_path / "plain.rays", files, recipe(key=key))


def test_what_stands_in_the_way_of_all(tmp_path):
    files = sources(tmp_path)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "a.txt").write_text("x")
    with pytest.raises(NergError, match="is there and no dataset"):
        update_dataset(tmp_path / "mine", files, recipe())
    with pytest.raises(NergError, match="no tracking file"):
        update_dataset(tmp_path / "a.rays", [*files, tmp_path / "absent.csv"], recipe())
    with pytest.raises(NergError, match="--day"):
        update_dataset(tmp_path / "a.rays", files, recipe(day="monday"))
    with pytest.raises(NergError, match="name one or more"):
        update_dataset(tmp_path / "a.rays", [], recipe())
    assert not (tmp_path / "a.rays").exists()
    update_dataset(tmp_path / "a.rays", files, recipe())
    with locked(tmp_path / "a.rays" / HEAD, "busy"), pytest.raises(NergError, match="another import"):
        update_dataset(tmp_path / "a.rays", files, recipe())


def test_an_import_of_nothing_leaves_no_dataset(tmp_path):
    bad, good = tmp_path / "bad.csv", sources(tmp_path, 1)
    bad.write_text("a,b\n1,2\n")
    for folder in (tmp_path / "new" / "a.rays", tmp_path / "b.rays"):
        assert update_dataset(folder, [bad], recipe()).errors
        assert not (tmp_path / "new").exists() and not (tmp_path / "b.rays").exists()
    # A folder that was there stays, and so does a dataset with a source.
    (tmp_path / "c.rays").mkdir()
    assert update_dataset(tmp_path / "c.rays", [bad], recipe()).errors and not any((tmp_path / "c.rays").iterdir())
    done = update_dataset(tmp_path / "c.rays", [bad, *good], recipe())
    assert done.imported == 1 and done.errors
    assert update_dataset(tmp_path / "c.rays", [bad], recipe()).errors
    assert update_dataset(tmp_path / "c.rays", good, recipe()).unchanged == 1


def test_an_import_that_is_interrupted_leaves_no_empty_dataset(tmp_path, monkeypatch):
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
from nerg_mi.rays.dataset import HEAD
from nerg_mi.rays.dataset_write import update_dataset
from tests.rays.dataset.making import recipe

if __name__ == "__main__":
    update_dataset(Path(sys.argv[1]), sorted(Path(sys.argv[2]).iterdir()), recipe(), workers=2)
"""


def test_killed_in_the_middle_it_goes_on(tmp_path):
    """SIGKILL of the process that imports: its workers end, and the next import gives what one that nobody has
    disturbed gives, to the byte."""
    files = [write_source(tmp_path / "files" / f"{k:02d}.csv", k, 4000) for k in range(24)]
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
    there = accounts()
    assert 3 <= there < len(files)
    # What has an account is whole meanwhile.
    opened = RayDataset.open(dataset)
    assert len(opened.load()) == len(opened) == 3999 * there
    found = update_dataset(dataset, files, recipe())
    assert (found.imported, found.unchanged) == (len(files) - there, there)
    update_dataset(tmp_path / "undisturbed.rays", files, recipe())
    assert content(dataset) == content(tmp_path / "undisturbed.rays")
    assert not list(dataset.rglob("*.part.*"))


def _alive(session: int) -> bool:
    """Whether a process of a session is left."""
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            return True
    return False
