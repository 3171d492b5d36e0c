"""Arrays for Dr.Jit: the same values, and the same kernels for any number of them."""

import drjit as dr
import numpy as np
import pytest

from nerg_mi.maths.arrays import ALIGNMENT, aligned, vector_of


@pytest.mark.parametrize("count", [0, 1, 15, 16, 1003])
def test01_values_are_those_given_and_begin_at_packets(rgb, count):
    rows = np.random.default_rng(count).normal(size=(count, 3))
    assert np.array_equal(np.array(vector_of(rgb.Point3f, rows)), rows.astype(np.float32).T)
    assert np.array_equal(np.array(vector_of(rgb.Vector3f, rows[:, ::-1])), rows[:, ::-1].astype(np.float32).T)
    for dtype in (np.float32, np.uint32, np.float64):
        values = aligned(np.arange(count), dtype)
        # Nothing begins nowhere.
        assert values.dtype == dtype and (count == 0 or values.ctypes.data % ALIGNMENT == 0)
        assert np.array_equal(values, np.arange(count))


def test02_what_is_given_may_change_afterwards(rgb):
    rows = np.ones((20, 3), np.float32)
    made, column = vector_of(rgb.Point3f, rows), rgb.Float(aligned(rows[:, 0]))
    rows[:] = 7
    assert np.all(np.array(made) == 1) and np.all(np.array(column) == 1)


def test03_another_number_is_no_other_kernel(rgb):
    kernels = set()
    for count in (1000, 1003, 1999, 2048):
        # Wherever the memory happens to lie.
        spare = [np.empty(k) for k in range(1, 9)]
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            v, w = vector_of(rgb.Point3f, np.ones((count, 3))), rgb.UInt32(aligned(np.ones(count), np.uint32))
            dr.eval(dr.norm(v) + rgb.Float(w) * rgb.Float(aligned(np.ones(count))))
            kernels |= {kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])}
        del spare
    assert len(kernels) == 1
