"""Compiling before a run's clock starts changes nothing of the run, and leaves nothing to be compiled in it."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.training.radiance.warm_up import warm_up
from tests.training.common.test_run_state import one_thread, state, trainer  # noqa: F401  (fixture)

from .test_trainer import dataset, settings  # noqa: F401  (fixture)


@pytest.mark.parametrize("depth", [True, False])
def test_a_run_is_the_same_bit_for_bit(dataset, one_thread, depth):  # noqa: F811
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
def test_nothing_is_compiled_in_a_run(dataset, depth):  # noqa: F811
    """Through all strides, grid updates, the drawing of hard pixels, the end of damping near cameras, and settling."""
    t = trainer(dataset, steps=120, depth=depth, settle=0.4)
    warm_up(t)
    strides, compiled = set(), []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        while t.progress < 1:
            t.step()
            strides.add(t.stride)
            compiled += [
                (t.steps, k["size"], k["operation_count"])
                for k in dr.kernel_history([dr.KernelType.JIT])
                if not k["cache_hit"]
            ]
    assert strides == {16, 8, 4, 2, 1} and t.settling.done
    assert not compiled
