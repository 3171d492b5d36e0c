"""What `make bench` rests on: how growth and spread are fitted, what an evaluation is said to take, and that those
which are compared do the same work."""

import importlib
from pathlib import Path

import numpy as np
import pytest

from tests.conftest import ROOT


@pytest.fixture
def benchmark(monkeypatch):
    """Imports a benchmark by its name, as it is when it is run: beside the others."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module


def test01_exponents_and_turns(benchmark):
    timing = benchmark("timing")
    sizes = [1, 10, 100, 1000]
    assert np.isclose(timing.exponent(sizes, [3 * n**0.5 for n in sizes]), 0.5)
    # A cost of a call flattens the whole, and not its end.
    costs = [n + 30 for n in sizes]
    assert timing.exponent(sizes, costs) < 0.6 < 0.85 < timing.at_the_end(sizes, costs) < 1
    assert timing.spread([4, 1, 2, 3, 5]) == "2, 4"
    called = []
    taken = timing.in_turns({"a": lambda: called.append("a"), "b": lambda: called.append("b")}, 2, warm=1)
    assert called == ["a", "b", "a", "b", "a", "b"] and [len(t) for t in taken.values()] == [2, 2]


def test02_work_of_an_evaluation(benchmark):
    """Counted by hand for one level of the grid and a net of one neuron."""
    from nerg_mi.field.encoding.hashgrid import HashGridConfig
    from nerg_mi.field.radiance import RadianceConfig

    work = benchmark("density_limit").Work.of(RadianceConfig(HashGridConfig(levels=1, log2_rows=4), width=1))
    blend, network = 3 * 3 + 7 * 3 * 2, 2 * (2 + 1) + 1
    assert (work.loads, work.bytes) == (8, 8 * 8 + 16) and work.flops == 6 + blend + network + 11


def processor_flags() -> list[str]:
    """Instruction sets of this processor, by Linux; none where another system runs."""
    description = Path("/proc/cpuinfo")
    return description.read_text().split() if description.is_file() else []


@pytest.fixture(scope="module")
def small():
    """A field of dense and hashed levels, its densities far from one another."""
    import drjit.llvm.ad as ns

    from nerg_mi.field.encoding.hashgrid import HashGridConfig
    from nerg_mi.field.occupancy import OccupancyGrid
    from nerg_mi.field.radiance import RadianceConfig, RadianceField
    from nerg_mi.maths.box import Box

    config = RadianceConfig(HashGridConfig(levels=4, log2_rows=8, base=4, finest=32), width=8, color_hidden=1)
    field = RadianceField.random(config, Box((-1, 0, 0), (1, 2, 1)), ns, march_step=0.01)
    table = field.parameters()["grid.table"]
    field.set_parameters({"grid.table": type(table)(3e4 * table.array)})
    field.occupancy = OccupancyGrid(np.random.default_rng(0).random((16,) * 3) < 0.3, ns, 0.01)
    return field


@pytest.mark.parametrize("target", ["native", "x86-64-v3"])  # the second has AVX2 and no AVX-512
def test03_the_hand_written_density_is_ours(benchmark, small, tmp_path, target):
    limit = benchmark("density_limit")
    if target != "native" and "avx2" not in processor_flags():
        pytest.skip("this processor has no AVX2")
    if limit.compiler() is None:
        pytest.skip("no C++ compiler")
    p = limit.random_points(small, 1024)
    with_hand = limit.Limit(small, limit.build(tmp_path, target), threads=2)
    # All others in this process still have their smallest numbers.
    assert (np.full(4, 1e-310) * 0.5).min() > 0
    ours = np.array(limit.ours(small, p)())
    assert ours.std() > 0.1 * ours.mean()
    assert np.quantile(np.abs(with_hand.density(p) / ours - 1), 0.99) < 1e-4
    with pytest.raises(ValueError, match="so many points"):
        with_hand.density(p[:, :100].copy())


def test04_a_kernel_that_is_not_compiled_is_told(benchmark, monkeypatch, tmp_path):
    limit = benchmark("density_limit")
    if limit.compiler() is None:
        pytest.skip("no C++ compiler")
    wrong = tmp_path / "wrong.cpp"
    wrong.write_text("int main( {")
    monkeypatch.setattr(limit, "SOURCE", wrong)
    with pytest.raises(RuntimeError, match="wrong.cpp was not compiled"):
        limit.build(tmp_path)


def test05_points_lie_where_matter_may_be(benchmark, small):
    limit = benchmark("density_limit")
    o = np.tile([[-2.0, 1.0, 0.5]], (64, 1)) + np.linspace(0, 0.2, 64)[:, None]
    for p in (limit.random_points(small, 640), limit.marched_points(small, o, np.tile([[1.0, 0, 0]], (64, 1)), 640)):
        assert p.shape == (3, 640) and p.dtype == np.float32
        away = np.array(small.occupancy.empty_cells(small.box.to_unit(small.ns.Array3f(p))))
        assert (away == 0).all()


def test06_scipy_and_nerg_have_one_density(benchmark):
    works, apart = benchmark("peers").kernel_densities(40, 300)
    assert apart < 1e-5 and set(works) == {"nerg", "SciPy"}
    # Uniform directions take a mean over the sphere, of what integrates to one.
    assert np.isclose(np.mean(benchmark("peers").kernel_densities(500, 4000)[0]["nerg"]()), 1 / (4 * np.pi), rtol=0.1)


def test07_volpath_and_nerg_have_one_cloud(benchmark, rgb):
    works, error, apart = benchmark("peers").transmittances(24, 64, cells=16)
    ours, theirs = (error(work()) for work in works.values())
    assert apart < 0.02 and ours < 0.06 and theirs < 0.1


def test08_figures(benchmark):
    figures = benchmark("growth_figures")
    curve = {"title": "a", "axis": "n", "sizes": [1, 2], "low": [1, 2], "middle": [1, 2], "high": [1, 3]}
    page = figures.growth_figure([curve | {"exponent": 1.0}] * 4)
    assert len([a for a in page.axes if a.get_visible()]) == 4 and "size^1.00" in page.axes[0].texts[0].get_text()
    page = figures.roofline_figure(200.0, {"memory": 50.0}, 3.0, {"Dr.Jit": 30.0})
    assert page.axes[0].lines[0].get_ydata().max() == 200.0


def test09_a_missing_device_is_one_sentence(benchmark, monkeypatch, capsys):
    bench = benchmark("bench")
    monkeypatch.setattr(bench, "has_cuda", lambda: False)
    bench.main(["--mode", "cuda_ad_rgb"])
    assert capsys.readouterr().out.startswith("No CUDA device is here")
    with pytest.raises(SystemExit):
        bench.main(["--only", "nothing"])
    assert 'there is no part "nothing"' in capsys.readouterr().err


def test10_memory_of_this_process(benchmark):
    memory = benchmark("frame_memory")
    # The kernel counts pages in batches, so that the two may be a few apart.
    assert memory.status("VmHWM") > 0.9 * memory.status("VmRSS") > 9
    with pytest.raises(RuntimeError, match="VmNothing"):
        memory.status("VmNothing")


def test11_steps_in_turns(benchmark, capsys):
    """As many steps of both, and the ratio of what they take."""

    class Trainer:
        steps = 0

        def step(self):
            self.steps += 1

    ours, peer = Trainer(), Trainer()
    benchmark("step_times").take_turns(ours, peer, 3, steps=2, before=5)
    assert ours.steps == peer.steps == 5 + 2 + 3 * 2
    assert capsys.readouterr().out.splitlines()[-1].startswith("PyTorch takes ")
