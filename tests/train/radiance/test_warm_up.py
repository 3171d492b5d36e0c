"""Compiling before a run's clock starts changes nothing of the run, and leaves nothing to be compiled in it."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.train.radiance_run import warm_up

from .ball import state, trainer


def kernels_of_a_run(t) -> list[tuple[int, int, int]]:
    """Step, size and operations of each kernel that the rest of a run compiles, or loads from the cache on the disk."""
    found = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        while t.progress < 1:
            t.step()
            found += [
                (t.steps, k["size"], k["operation_count"])
                for k in dr.kernel_history([dr.KernelType.JIT])
                if not k["cache_hit"] or k["cache_disk"]
            ]
    # Those of a few operations take no longer than a step.
    return [k for k in found if k[2] > 20]


@pytest.mark.parametrize("depth", [True, False])
def test_a_run_is_the_same_bit_for_bit(dataset, one_thread, depth):
    plain, warm = (trainer(dataset, steps=24, depth=depth) for _ in range(2))
    warm_up(warm)
    assert warm.steps == warm.settling.at == 0 and not warm.clock.durations
    for t in (plain, warm):
        while t.progress < 1:
            t.step()
    expected, got = state(plain), state(warm)
    for name, value in expected.items():
        assert np.array_equal(value, got[name]), name


@pytest.mark.parametrize("depth", [True, False])
def test_nothing_is_compiled_in_a_run(dataset, depth):
    """Through all strides, grid updates, the drawing of hard pixels, the end of damping near cameras, and settling."""
    t = trainer(dataset, steps=120, depth=depth, settle=0.4)
    # Other trainings of this process have made most kernels already.
    dr.flush_kernel_cache()
    warm_up(t)
    assert not kernels_of_a_run(t)
    assert t.stride == 1 and t.settling.done


def test_nothing_is_compiled_once_fog_has_cleared(dataset):
    """Where all is fog at first nothing is known to be empty, and the bound of rendering holds nothing."""
    t = trainer(dataset, steps=60, depth=False, settle=0.4)
    value = type(t.grid.value)(t.grid.value)
    t.grid.value, t.grid.grown = (
        dr.full(type(value), 1, len(value)),
        lambda found: np.zeros((t.grid.resolution,) * 3, bool),
    )
    dr.eval(t.grid.value)
    dr.flush_kernel_cache()
    warm_up(t)
    t.grid.value = value
    del t.grid.grown
    assert not kernels_of_a_run(t)
