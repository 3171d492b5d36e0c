"""The array types of a backend, and arrays at addresses that Dr.Jit reads fast."""

import drjit.cuda.ad
import drjit.llvm.ad
import drjit.scalar
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import aligned, is_cuda, namespace


def test_types_of_a_variant_or_an_array(rgb):
    for source in ("llvm_ad_rgb", "llvm", drjit.llvm.ad.Float, drjit.llvm.ad.Float(1), rgb.Point3f, rgb.TensorXf):
        assert namespace(source) is drjit.llvm.ad
    for source in ("cuda_ad_spectral", "cuda", drjit.cuda.ad.Float):
        assert namespace(source) is drjit.cuda.ad
    assert is_cuda(drjit.cuda.ad) and not is_cuda(drjit.llvm.ad)


@pytest.mark.parametrize("source", ["scalar_rgb", drjit.scalar.Array3f])
def test_scalar_variants_have_none(source):
    with pytest.raises(NergError, match='"llvm_ad_rgb"'):
        namespace(source)


@pytest.mark.parametrize("dtype", [np.float32, np.uint32])
def test_arrays_are_aligned_copies(dtype):
    source = np.arange(24).reshape(2, 3, 4)[:, ::2]
    for _ in range(8):
        copy = aligned(source, dtype)
        assert copy.ctypes.data % 64 == 0 and copy.dtype == dtype and np.array_equal(copy, source)
        assert not np.shares_memory(copy, source)
    assert aligned(np.zeros((0, 3))).shape == (0, 3)
