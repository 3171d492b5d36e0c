"""The import of one source: block by block, under pseudonyms, and without any ray."""

from __future__ import annotations

import pytest

from nerg_mi.rays.dataset.dataset import RayDataset
from nerg_mi.rays.dataset.identity import Marks
from nerg_mi.rays.dataset.importing import Task, has_parts, import_source
from nerg_mi.rays.dataset.manifest import Head, read_sources, write_head
from nerg_mi.rays.readers.registry import read_rays

from .making import assert_same, recipe, settings, write_source

pytest.importorskip("pyarrow")
HEAD = Head(4)


def task(folder, path, **changes) -> Task:
    how = recipe(**changes)
    return Task(folder=folder, head=HEAD, path=path, recipe=how, mark=how.mark, where=Marks(how.key).where(path))


@pytest.mark.parametrize("key", [None, bytes(range(16))])
def test_in_blocks_as_at_once(tmp_path, monkeypatch, key):
    monkeypatch.setattr("nerg_mi.rays.readers.parsing.tables.BLOCK", 50)
    monkeypatch.setattr("nerg_mi.rays.readers.builder.STREAMED", 120)
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
