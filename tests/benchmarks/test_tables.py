"""Tables of benchmarks have the headers of those in the manual, as far as this can be tested quickly."""

import importlib

import numpy as np
import pytest

from tests.conftest import ROOT
from tools.page import cells


@pytest.fixture
def benchmark(monkeypatch):
    """Import a benchmark by name, as a script next to the others."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module


def lines(text: str) -> list[str]:
    """Lines of the tables in ``text``."""
    return [f"| {' | '.join(cells(line))} |" for line in text.splitlines() if line.startswith("|")]


def page(name: str) -> list[str]:
    return lines((ROOT / "docs" / "explanation" / name).read_text(encoding="utf-8"))


def test01_derivative_errors(benchmark, capsys):
    benchmark("gradients").main(["--case", "silhouette"])
    head, rule, *rows = lines(capsys.readouterr().out)
    assert {head, *rows} <= set(page("numerics.md")) and len(rows) == 2


def test02_sample_counts_and_opacities(benchmark, rgb):
    numerics, moved = benchmark("numerics"), page("numerics.md")
    rows = [row.cells() for case in (numerics.any_number_of_samples, numerics.all_opacities) for row in case(rgb)]
    assert len(rows) == 6 and all(any(f"| {' | '.join(row[:3])} |" in line for line in moved) for row in rows)


def test03_alignment_tables(benchmark):
    from tests.alignment import rooms

    alignment = benchmark("alignment")
    world = alignment.World(rooms.traces(2000), rooms.traces(2000).end, rooms.people(200))
    moved = page("accuracy.md")
    assert f"| {' | '.join(alignment.HEAD)} |" in moved
    for kind in ("pairs", "cameras"):
        cells = alignment.cells(alignment.measure(world, kind, 2, 1))
        assert cells[2] == "2 of 2" and cells[-2] == "1 of 1"
        assert any(line.startswith(f"| {cells[0]} |") for line in moved)


def test_alignment_without_hit_points(benchmark, monkeypatch):
    from nerg_mi.alignment import profile
    from tests.alignment import rooms

    monkeypatch.setattr(profile, "_TURNS", np.radians([45, 90, 180]))
    alignment = benchmark("alignment")
    assert f"| {' | '.join(alignment.HIDDEN_HEAD)} |" in page("accuracy.md")
    row = dict(
        zip(alignment.HIDDEN_HEAD, alignment.measure_hidden("room", rooms.traces(), rooms.people(300), "scale", 1, 0))
    )
    assert row["interval contains the truth"] == "1 of 1" and row["accepted and wrong"] == "0 of 1"
    assert float(row["turn interval, degrees"]) > 0 and row["scale error, %"] == ""


SCRIPTS = sorted(p.stem for p in (ROOT / "benchmarks").glob("*.py") if "__main__" in p.read_text(encoding="utf-8"))


@pytest.mark.parametrize("script", SCRIPTS)
def test04_scripts_are_documented_with_their_options(benchmark, monkeypatch, capsys, script):
    assert any(f"benchmarks/{script}.py" in p.read_text(encoding="utf-8") for p in (ROOT / "docs").rglob("*.md")) or (
        script == "bench"
    )
    monkeypatch.setattr("sys.argv", [script, "--help"])
    with pytest.raises(SystemExit):
        benchmark(script).main()
    assert "usage:" in capsys.readouterr().out
