"""Basics of `make bench`: fits of growth and spread, and equal work of all compared programs."""

import importlib

import numpy as np
import pytest

from tests.conftest import ROOT
from tests.test_docs import check_command, commands
from tools import results


@pytest.fixture
def benchmark(monkeypatch):
    """Import a benchmark by name, as a script next to the others."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module


def test01_scaling_exponents_and_alternating_runs(benchmark):
    timing = benchmark("timing")
    sizes = [1, 10, 100, 1000]
    assert np.isclose(timing.exponent(sizes, [3 * n**0.5 for n in sizes]), 0.5)
    # A constant cost per call flattens the whole curve, not its end.
    costs = [n + 30 for n in sizes]
    assert timing.exponent(sizes, costs) < 0.6 < 0.85 < timing.at_the_end(sizes, costs) < 1
    assert timing.spread([4, 1, 2, 3, 5]) == "2, 4"
    called = []
    taken = timing.in_turns({"a": lambda: called.append("a"), "b": lambda: called.append("b")}, 2, warm=1)
    assert called == ["a", "b", "a", "b", "a", "b"] and [len(t) for t in taken.values()] == [2, 2]


def test02_scipy_and_nerg_densities_agree(benchmark):
    works, difference = benchmark("bench").kernel_densities(40, 300)
    assert difference < 1e-5 and set(works) == {"nerg", "SciPy"}
    # Uniform directions average over the sphere, a density that integrates to one.
    assert np.isclose(np.mean(benchmark("bench").kernel_densities(500, 4000)[0]["nerg"]()), 1 / (4 * np.pi), rtol=0.1)


def test03_volpath_and_nerg_transmittances_agree(benchmark, rgb):
    works, error, difference = benchmark("bench").transmittances(24, 64, cells=16)
    ours, theirs = (error(work()) for work in works.values())
    assert difference < 0.02 and ours < 0.06 and theirs < 0.1


def test05_missing_device_is_reported(benchmark, monkeypatch, capsys):
    bench = benchmark("bench")
    monkeypatch.setattr(bench, "has_cuda", lambda: False)
    bench.main(["--mode", "cuda_ad_rgb"])
    assert capsys.readouterr().out.startswith("No CUDA device is here")
    with pytest.raises(SystemExit):
        bench.main(["--only", "nothing"])
    assert 'there is no part "nothing"' in capsys.readouterr().err


def test06_peak_memory_of_this_process(benchmark):
    memory = benchmark("processes")
    # The kernel counts pages in batches, so that both can differ by a few.
    assert memory.status("VmHWM") > 0.9 * memory.status("VmRSS") > 9
    with pytest.raises(RuntimeError, match="VmNothing"):
        memory.status("VmNothing")


def test_timed_commands_are_those_of_the_quick_start(benchmark, tmp_path):
    page = (ROOT / "docs" / "tutorials" / "quickstart.md").read_text(encoding="utf-8")
    printed = [words[1:] for words in commands(page) if words[0] == "nerg"]
    for words in benchmark("processes").quick_start(tmp_path / "shoppers.csv", tmp_path):
        check_command("nerg", *words)
        options = [word for word in words if word.startswith("-")]
        assert any(line[0] == words[0] and [w for w in line if w.startswith("-")] == options for line in printed), words


def test07_steps_alternate(benchmark, monkeypatch, tmp_path):
    """Equal numbers of steps of both, and the ratio of their times."""

    class Trainer:
        steps = 0

        def step(self):
            self.steps += 1

    monkeypatch.setattr(results, "LATEST", tmp_path)
    ours, peer = Trainer(), Trainer()
    benchmark("torch_radiance").take_turns(ours, peer, 3, "steps", steps=2, before=5)
    assert ours.steps == peer.steps == 5 + 2 + 3 * 2
    rows = results.read("steps", tmp_path)["rows"]
    assert [row[0] for row in rows] == ["nerg_mi", "PyTorch"] and rows[0][-2:] == ["1.0", "1.0"]
