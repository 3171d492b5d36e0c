"""Tables that benchmarks print have the heads of those on the pages, as far as that is quick to find out."""

import importlib

import pytest

from tests.conftest import ROOT
from tools.page import cells


@pytest.fixture
def benchmark(monkeypatch):
    """Imports a benchmark by its name, as it is when it is run: beside the others."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module


def lines(text: str) -> list[str]:
    """Lines of the tables in ``text``, whether their columns are padded or not."""
    return [f"| {' | '.join(cells(line))} |" for line in text.splitlines() if line.startswith("|")]


def page(name: str) -> list[str]:
    return lines((ROOT / "docs" / "explanation" / name).read_text(encoding="utf-8"))


def test01_errors_of_derivatives(benchmark, capsys):
    benchmark("gradients").main(["--case", "silhouette"])
    head, rule, *rows = lines(capsys.readouterr().out)
    assert {head, *rows} <= set(page("numerics.md")) and len(rows) == 2


def test02_samples_and_opacities(benchmark, rgb):
    numerics, there = benchmark("numerics"), page("numerics.md")
    rows = [row.cells() for case in (numerics.any_number_of_samples, numerics.all_opacities) for row in case(rgb)]
    assert len(rows) == 6 and all(any(f"| {' | '.join(row[:3])} |" in line for line in there) for row in rows)


def test03_alignments(benchmark):
    from tests.alignment import rooms

    alignment = benchmark("alignment")
    world = alignment.World(rooms.traces(2000), rooms.traces(2000).end, rooms.people(200))
    there = page("accuracy.md")
    assert f"| {' | '.join(alignment.HEAD)} |" in there
    for kind in ("pairs", "cameras"):
        cells = alignment.cells(alignment.measure(world, kind, 2, 1))
        assert cells[2] == "2 of 2" and cells[-2] == "1 of 1"
        assert any(line.startswith(f"| {cells[0]} |") for line in there)


SCRIPTS = sorted(p.stem for p in (ROOT / "benchmarks").glob("*.py") if "__main__" in p.read_text(encoding="utf-8"))


@pytest.mark.parametrize("script", SCRIPTS)
def test04_every_script_stands_on_a_page_and_says_its_options(benchmark, monkeypatch, capsys, script):
    assert any(f"benchmarks/{script}.py" in p.read_text(encoding="utf-8") for p in (ROOT / "docs").rglob("*.md")) or (
        script == "bench"
    )
    monkeypatch.setattr("sys.argv", [script, "--help"])
    with pytest.raises(SystemExit):
        benchmark(script).main()
    assert "usage:" in capsys.readouterr().out
