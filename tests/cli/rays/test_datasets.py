"""``nerg rays`` on datasets: a name that ends in .rays, and failures while one is written."""

from __future__ import annotations

import os

import pytest

from nerg_mi.tracking import imports
from nerg_mi.tracking.dataset import RayDataset
from nerg_mi.tracking.rays import Rays
from tests.cli.rays.running import run
from tests.cli.test_outputs import interrupting, is_one_sentence, largest_file, nerg
from tests.tracking.dataset.making import MAP, write_source

pytest.importorskip("pyarrow")


@pytest.fixture(autouse=True)
def one_process(monkeypatch):
    """Imports in this process, where tests let them fail."""
    monkeypatch.setattr(imports, "count_cpus", lambda: 1)


@pytest.fixture
def import_arguments(tmp_path):
    """The arguments of an import of two files, without the output."""
    files = [write_source(tmp_path / "files" / f"{k}.csv", k, 2000) for k in range(2)]
    return ["rays", "import", *files, "--map", MAP, "--environment", "shop"]


def test_a_dataset_is_imported_shown_and_filtered(import_arguments, tmp_path):
    output = tmp_path / "a.rays"
    done = run(*import_arguments[1:], "-o", output)
    shown = " ".join(done.output.split())
    assert done.exit_code == 0 and "imported 2 sources, 3,998 rays" in shown and "3,998 of 4,000 rows" in shown
    assert "2 sources in" in shown and "place shop, day unknown" in shown
    assert "nothing to import; 2 unchanged" in run(*import_arguments[1:], "-o", output).output
    for path in (output, output / "place=shop" / "day=unknown"):
        shown = run("show", path)
        assert shown.exit_code == 0 and "3,998 of 4,000 rows" in shown.output
    done = run("filter", output, "-o", tmp_path / "b.npz", "--person", "p0_1", "--sample", 100)
    assert done.exit_code == 0 and len(Rays.load(tmp_path / "b.npz")) == 100, done.output
    assert run("filter", output, "-o", tmp_path / "b.rays", "--person", "p0_1").exit_code == 0
    assert RayDataset.open(tmp_path / "b.rays").persons == ("p0_1",)


def test_outputs_that_cannot_be_written_are_refused(import_arguments, tmp_path, capsys):
    (tmp_path / "file.rays").write_text("x")
    for output, why in (
        (tmp_path / "file.rays", "one of its parents is a file"),
        (tmp_path / "file.rays" / "a.rays", "one of its parents is a file"),
        (tmp_path / "a.npz", "--environment applies to datasets only"),
    ):
        code, said = nerg(capsys, *import_arguments, "-o", output)
        assert is_one_sentence(code, said) and why in said, said


def test_a_full_disk_and_ctrl_c_keep_finished_work(import_arguments, tmp_path, capsys, monkeypatch):
    """Finished parts are kept; the next import resumes with the same result."""
    arguments, output = [*import_arguments, "-o", tmp_path / "a.rays"], tmp_path / "a.rays"
    with largest_file(20_000):
        code, said = nerg(capsys, *arguments)
    assert is_one_sentence(code, said) and "too large" in said, said
    assert not list(output.rglob("*.parquet")) and not list(output.rglob(".*"))
    with monkeypatch.context() as change:
        calls = []

        def late(handle):
            calls.append(handle)
            return interrupt(handle) if len(calls) > 12 else flush(handle)

        flush, interrupt = os.fsync, interrupting(os.fsync)
        change.setattr(os, "fsync", late)
        code, said = nerg(capsys, *arguments)
    assert code == 130 and said.strip()
    assert not [p for p in output.rglob(".*") if p.is_file()]
    code, _ = nerg(capsys, *arguments)
    assert code == 0 and len(RayDataset.open(output).load()) == 3998
    code, _ = nerg(capsys, *import_arguments, "-o", tmp_path / "b.rays")
    parts = lambda folder: {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*.parquet")}
    assert code == 0 and parts(output) == parts(tmp_path / "b.rays")
    # A filter writes all or nothing.
    for limit, signal in ((3000, False), (None, True)):
        with monkeypatch.context() as change, largest_file(limit or 1 << 40):
            if signal:
                change.setattr(os, "fsync", interrupting(os.fsync))
            code, said = nerg(capsys, "rays", "filter", output, "-o", tmp_path / "c.rays", "--start", "-1e9")
        assert code == (130 if signal else 1) and not list(tmp_path.glob("*c.rays*")), said
