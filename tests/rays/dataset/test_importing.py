"""The import of one source: block by block, under pseudonyms, and without any ray."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.rays.dataset import Head, RayDataset, read_sources, write_head
from nerg_mi.rays.dataset_write import Marks, Task, has_parts, import_source
from nerg_mi.rays.readers.base import Frame, NoOptions, Signature
from nerg_mi.rays.readers.registry import read_rays

from .making import assert_same, recipe, settings, write_source

pytest.importorskip("pyarrow")
HEAD = Head(4)


def task(folder, path, **changes) -> Task:
    how = recipe(**changes)
    return Task(folder=folder, head=HEAD, path=path, recipe=how, mark=how.mark, where=Marks(how.key).where(path))


@pytest.mark.parametrize("key", [None, bytes(range(16))])
def test_in_blocks_as_at_once(tmp_path, monkeypatch, key):
    monkeypatch.setattr("nerg_mi.rays.readers.tables.BLOCK", 50)
    monkeypatch.setattr("nerg_mi.rays.readers.base.STREAMED", 120)
    path, folder = write_source(tmp_path / "a.csv", people=5), tmp_path / "a.rays"
    write_head(folder, HEAD)
    found = import_source(task(folder, path, key=key))
    assert (found.rays, found.unchanged, found.error) == (399, False, None)
    (source,) = read_sources(folder, HEAD)
    assert source.id == found.source and len(source.parts) > 4 and has_parts(folder, source)
    assert sum(d["count"] for d in source.metadata["dropped"]) == 1 and source.metadata["rows_read"] == 400
    rays = read_rays("table", path, settings())
    if key is not None:
        from nerg_mi.rays.pseudonyms import pseudonymise

        rays = pseudonymise(rays, key)
        assert (
            source.metadata["sources"] == rays.metadata["sources"]
            and source.file == rays.metadata["sources"][0]["file"]
        )
        assert source.metadata["dropped"] == rays.metadata["dropped"]
    assert_same(RayDataset.open(folder).load(), rays)
    assert import_source(task(folder, path, key=key)).unchanged


class Headset:
    """A reader of heads and distances of eyes, in cm, that makes its rays itself."""

    name, files, world, checked_on, Options = "headset", "", "", "", NoOptions
    signature = Signature()

    def frame(self, files, options):
        return Frame(units="cm")

    def read(self, files, options, builder):
        builder.source(files[0])
        for k, (name, metres) in enumerate((("ann", 6.0), ("bo", 6.4), ("ann", 7.0))):
            ahead = np.tile([0.0, 2.0, 0.0], (50, 1))
            heads = np.where(np.arange(50)[:, None] < 25, ahead, np.nan)
            t, eyes = np.arange(50) + 50.0 * k, np.full(50, metres)
            builder.add(t, name, ahead, ahead, rows=np.arange(50), head=heads, eye_distance=eyes)
        builder.complain("the headset was put on askew")


@pytest.mark.parametrize("key", [None, bytes(range(16))])
def test_heads_eyes_and_complaints(tmp_path, monkeypatch, key):
    monkeypatch.setattr("nerg_mi.rays.readers.base.STREAMED", 40)
    (tmp_path / "a.bin").write_bytes(b"x")
    write_head(tmp_path / "a.rays", HEAD)
    given = task(tmp_path / "a.rays", tmp_path / "a.bin", reader=Headset(), settings=None, key=key)
    assert import_source(given).rays == 150
    rays = RayDataset.open(tmp_path / "a.rays").load()
    assert rays.metadata["complaints"] == ["the headset was put on askew"]
    known = np.isfinite(rays.head).all(axis=1)
    assert rays.head.dtype == np.float32 and (rays.head[known] == [0, 1, 0]).all()
    assert np.array_equal(known, rays.t % 50 < 25)
    # Of the first block of each.
    eyes = rays.metadata["eye_distance"]
    assert set(eyes) == set(rays.persons) and np.allclose(sorted(eyes.values()), [0.06, 0.064])
    assert (set(eyes) == {"ann", "bo"}) is (key is None)


def test_a_source_without_a_ray_has_an_account(tmp_path):
    path, folder = write_source(tmp_path / "a.csv", count=1), tmp_path / "a.rays"
    path.write_text(path.read_text().replace("0.000,", ",", 1))
    write_head(folder, HEAD)
    assert import_source(task(folder, path)).rays == 0
    (source,) = read_sources(folder, HEAD)
    assert source.parts == [] and source.metadata["dropped"][0]["reason"] == "time is missing"


def test_what_can_be_mended_is_told(tmp_path):
    write_head(tmp_path / "a.rays", HEAD)
    assert "absent.csv" in (import_source(task(tmp_path / "a.rays", tmp_path / "absent.csv")).error or "")


def test_what_is_no_recording_is_refused_before_all_of_it_is_read(tmp_path, monkeypatch):
    folder, path = tmp_path / "a.rays", tmp_path / "a.csv"
    write_head(folder, HEAD)
    monkeypatch.setattr(Marks, "source", lambda *_: pytest.fail("it was read to its end"))
    with path.open("wb") as out:
        out.truncate(3 << 30)
    assert "characters that are read" in (import_source(task(folder, path)).error or "")


def test_a_copy_of_an_imported_source_is_known_by_its_first_rays(tmp_path, monkeypatch):
    monkeypatch.setattr("nerg_mi.rays.readers.tables.BLOCK", 50)
    monkeypatch.setattr("nerg_mi.rays.readers.base.STREAMED", 120)
    path, folder = write_source(tmp_path / "a.csv", people=5), tmp_path / "a.rays"
    write_head(folder, HEAD)
    first = import_source(task(folder, path))
    (tmp_path / "b").mkdir()
    copy = write_source(tmp_path / "b" / "a.csv", people=5)
    monkeypatch.setattr("nerg_mi.rays.dataset_write.SourceWriter", lambda *_: pytest.fail("it was written again"))
    again = import_source(task(folder, copy))
    assert again.unchanged and again.source == first.source and len(read_sources(folder, HEAD)) == 1
