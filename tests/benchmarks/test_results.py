"""Results of benchmarks: their files, the page that shows them, and what quick parts of benchmarks write."""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from nerg_mi.scenes.store import SCENE_FILE

from nerg_mi.tracking.rays import Rays
from tests.conftest import ROOT
from tests.test_docs import check_command, commands
from tools import results

PAGES = sorted((ROOT / "docs").rglob("*.md"))
NAMES = sorted(path.stem for path in results.FOLDER.glob("*.json"))


@pytest.fixture
def benchmark(monkeypatch, tmp_path):
    """Import a benchmark by name, as a script next to the others, which writes its results into a folder of the
    test."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.setattr(results, "LATEST", tmp_path)
    return importlib.import_module


def test_every_result_is_shown():
    shown = [name for page in PAGES for name in results.list_markers(page.read_text(encoding="utf-8"))]
    assert sorted(set(shown)) == NAMES


FIGURES = ("accuracy.md", "error-and-time.md", "performance.md")
BY_HAND = {"70.6", "0.015"}
"""Printed by a benchmark next to its table, and measured on a graphics card without a result."""


@pytest.mark.parametrize("page", FIGURES)
def test_figures_of_a_page_are_those_of_results(page):
    cells = " ".join(cell for name in NAMES for row in results.read(name)["rows"] for cell in row)
    measured = set(re.findall(r"[\d,]*\.?\d+(?:e-?\d+)?", cells)) | BY_HAND
    measured |= {f"0{figure}" for figure in measured if figure.startswith(".")}
    text = re.sub(r"\]\(.*?\)", "", (ROOT / "docs" / "explanation" / page).read_text(encoding="utf-8"))
    assert set(re.findall(r"\d+\.\d+(?:e-?\d+)?", text)) <= measured


@pytest.mark.parametrize("name", NAMES)
def test_results_have_provenance_and_a_command(name):
    result = results.read(name)
    assert tuple(result) == results.FIELDS
    assert all(len(row) == len(result["columns"]) for row in result["rows"]) and result["rows"]
    lines = commands("```sh\n" + "\n".join(result["command"]) + "\n```")
    assert len(lines) == len(result["command"])
    for words in lines:
        check_command(*words)
    assert re.match(r"python (benchmarks/|-m tools\.)", result["command"][-1])


def test_results_are_saved_and_shown(monkeypatch, tmp_path):
    monkeypatch.setattr(results, "LATEST", tmp_path)
    monkeypatch.setattr(results, "FOLDER", tmp_path)
    monkeypatch.setattr("sys.argv", [str(ROOT / "benchmarks" / "numbers.py"), "--only", "a b"])
    results.save("one", ("what", "value"), [["a|b", 1.5], ["c", "-2"]], seeds="0, 1")
    saved = results.read("one")
    assert saved["command"] == ["python benchmarks/numbers.py --only 'a b'"]
    assert saved["rows"] == [["a|b", "1.5"], ["c", "-2"]]
    results.write(tmp_path / "one.json", saved | {"load": results.UNKNOWN})
    page = results.insert("# A\n\n<!-- result: one -->\n\nEnd\n")
    assert "| what | value |\n| --- | ---: |\n| a\\|b | 1.5 |\n" in page and page.endswith("\n\nEnd\n")
    assert "seeds: 0, 1. Not recorded: load." in page


def test_commands_run_once_and_replace_their_results(monkeypatch, tmp_path):
    """Those before the last one, which prepare inputs, are kept."""
    latest = tmp_path / "latest"
    latest.mkdir()
    monkeypatch.setattr(results, "LATEST", latest)
    monkeypatch.setattr(results, "FOLDER", tmp_path)
    rest = dict.fromkeys(results.FIELDS[1:-2], "x") | {"columns": ["n"]}
    script = f"""python -c "open('{tmp_path}/runs', 'a').write('.')" """
    for name in ("one", "two"):
        results.write(tmp_path / f"{name}.json", {"command": ["true", script], **rest, "rows": [["1"]]})
        results.write(latest / f"{name}.json", {"command": ["new"], **rest, "rows": [["2"]]})
    results.regenerate(["one", "two"])
    assert (tmp_path / "runs").read_text() == "."
    for name in ("one", "two"):
        assert results.read(name) | rest == {"command": ["true", script], **rest, "rows": [["2"]]}


def latest(name: str) -> dict:
    return json.loads((results.LATEST / f"{name}.json").read_text(encoding="utf-8"))


def test_derivatives(benchmark):
    benchmark("gradients").main(["--case", "silhouette"])
    published, made = results.read("derivatives"), latest("derivatives")
    assert made["columns"] == published["columns"]
    assert len(made["rows"]) == 2 and all(row in published["rows"] for row in made["rows"])


def test_sample_counts_and_opacities(benchmark, rgb):
    numerics, published = benchmark("numerics"), results.read("numerics-steps")
    rows = [row.cells() for case in (numerics.any_number_of_samples, numerics.all_opacities) for row in case(rgb)]
    assert len(rows) == 6 and list(numerics.HEAD) == published["columns"]
    assert {tuple(row[:3]) for row in rows} <= {tuple(row[:3]) for row in published["rows"]}


def test_alignment(benchmark):
    from tests.alignment import rooms

    alignment, published = benchmark("alignment"), results.read("alignment-evidence")
    world = alignment.World(rooms.traces(2000), rooms.traces(2000).end, rooms.people(200))
    assert list(alignment.HEAD) == published["columns"]
    for kind in ("pairs", "cameras"):
        cells = alignment.cells(alignment.measure(world, kind, 2, 1))
        assert cells[2] == "2 of 2" and cells[-2] == "1 of 1"
        assert cells[0] in [row[0] for row in published["rows"]]


def test_alignment_without_hit_points(benchmark, monkeypatch):
    from nerg_mi.alignment import profile
    from tests.alignment import rooms

    monkeypatch.setattr(profile, "_TURNS", np.radians([45, 90, 180]))
    alignment = benchmark("alignment")
    assert list(alignment.HIDDEN_HEAD) == results.read("alignment-hidden")["columns"]
    row = dict(
        zip(alignment.HIDDEN_HEAD, alignment.measure_hidden("room", rooms.traces(), rooms.people(300), "scale", 1, 0))
    )
    assert row["interval contains the truth"] == "1 of 1" and row["accepted and wrong"] == "0 of 1"
    assert float(row["turn interval, degrees"]) > 0 and row["scale error, %"] == ""


def test_the_best_baseline_of_a_score_has_the_best_mean(benchmark):
    """It is compared fold by fold, and the split half is no baseline."""
    places = benchmark("places")
    values = {"gaze field": (0.4, 0.6), "position-independent prior": (0.7, 0.1), "nearest rays": (0.2, 0.5)}
    values["split half"] = (0.0, 0.0)
    each = [
        {"place": "room", "fold": fold, "method": method, **dict.fromkeys(places.SCORES, pair[fold])}
        | {f"{score} gap half width": 0.3 + 0.1 * fold for score in places.SCORES}
        for method, pair in values.items()
        for fold in (0, 1)
    ]
    places.save_places("room", each, "0, 1")
    rows = {row[0]: row[1:] for row in latest("room")["rows"]}
    assert rows["KLD"][2:] == ["0.400", "nearest rays", "0.350", "0.500", "+0.150 ± 0.354", "+0.200, +0.100"]
    assert rows["CC"][2:4] == ["0.400", "position-independent prior"] and rows["CC"][-1] == "-0.300, +0.500"
    assert latest("room")["columns"] == results.read("gaze-recorded")["columns"]


def test_regions_of_a_field_that_is_not_calibrated(benchmark):
    from nerg_mi.evaluation.position_scores import AWAY, RECORDED

    places, levels = benchmark("places"), {"50%": 0.4, "80%": 0.7, "95%": 0.9}
    rows = [{"place": "room", "method": f"{places.OURS}, {kind}", **levels} for kind in (RECORDED, AWAY)]
    places.save_regions("room", rows, "0")
    assert [row[2:] for row in latest("room")["rows"]] == [["40", "70", "90", "", "", ""]] * 2
    ranks = {"signal": "support", "split": "both", "rho": np.nan, "100%": 0.5, "50%": 0.4}
    regions = {"of 80%": 0.7, "of 80%, calibrated": np.nan}
    unsure = [{"place": "room", "error": error, **ranks, **regions} for error in ("KLD", "excess")]
    places.save_uncertainty("unsure", unsure, "0")
    assert latest("unsure")["rows"] == [["room", "too few", "too few", "0.50, 0.40", "70%", ""]]


def test_variants_of_the_paper_are_compared_fold_by_fold(benchmark):
    claims = benchmark("paper_claims")
    cc = {"emit_capture": (0.5, 0.7), "emit": (0.6, 0.6)}
    rows = [
        {"place": "room", "recipe": "paper", "variant": variant, "fold": fold, "test_CC": pair[fold]}
        | {"steps": 640 * (fold + 1), "train_seconds": 10.0}
        for variant, pair in cc.items()
        for fold in (0, 1)
    ]
    (row,) = claims.order(rows)
    assert row[:4] == ["room", "paper", "0.600", "0.500, 0.700"] and row[-2:] == ["960", "10"]
    assert row[4].startswith("+0.000 ± ") and row[5:7] == ["", ""]
    assert claims.order(rows[::2])[0][4] == "+0.100"


def run_alone(folder, code: str) -> None:
    """Run ``code`` in a new process, which has no variant yet, and writes its results into ``folder``."""
    path = os.pathsep.join(map(str, (ROOT, ROOT / "benchmarks")))
    begin = f"from pathlib import Path\nfrom tools import results\nresults.LATEST = Path({str(folder)!r})\n"
    line = [sys.executable, "-c", begin + textwrap.dedent(code)]
    subprocess.run(line, env={**os.environ, "PYTHONPATH": path}, check=True)


def test_environments_of_the_paper_in_a_new_process(tmp_path):
    code = f"""
    import paper_claims

    paper_claims.ablation.main = lambda line: []
    paper_claims.main(["--only", "generated-corridor", "--folds", "1", "--out", {str(tmp_path)!r}])
    """
    run_alone(tmp_path, code)
    assert len(Rays.load(tmp_path / "generated-corridor" / "rays.npz")) > 1000


def test_viewer_frames_of_a_new_process(tmp_path):
    """Without the compiled copy, which takes long to make."""
    pytest.importorskip("viser")
    code = f"""
    import viewer_frames

    arguments = ["--width", "64", "--seconds", "0.5", "--only", "field"]
    viewer_frames.main([{str(SCENE_FILE)!r}, *arguments, "--pictures", {str(tmp_path / "pictures")!r}])
    """
    run_alone(tmp_path, code)
    made, published = results.read("viewer", tmp_path), results.read("viewer")
    assert made["columns"] == published["columns"]
    assert [row[:2] for row in made["rows"]] == [row[:2] for row in published["rows"] if row[0] == "field"]


SCRIPTS = sorted(p.stem for p in (ROOT / "benchmarks").glob("*.py") if "__main__" in p.read_text(encoding="utf-8"))
ON_PAGES = {"ablation", "independent_score"}
"""Benchmarks without a result, which a page names."""


@pytest.mark.parametrize("script", SCRIPTS)
def test_scripts_have_results_and_help(benchmark, monkeypatch, capsys, script):
    lines = [line for name in NAMES for line in results.read(name)["command"]]
    if script in ON_PAGES:
        lines = [page.read_text(encoding="utf-8") for page in PAGES]
    assert any(f"benchmarks/{script}.py" in line for line in lines)
    monkeypatch.setattr("sys.argv", [script, "--help"])
    with pytest.raises(SystemExit):
        benchmark(script).main()
    assert "usage:" in capsys.readouterr().out
