"""Arrays of checkpoints as parts of fields, and the other way."""

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.mlp import MLP
from nerg_mi.formats.fields import LARGEST, StoredArrays, stored

GRID = HashGridConfig(levels=1, log2_rows=3, base=1, finest=1)


def test_arrays_are_float32_of_the_shape_that_is_asked_for():
    arrays = StoredArrays({"a": np.ones((2, 3), np.float16), "n": np.array([1, np.nan]), "big": np.array([1e300])}, ns)
    found = arrays.array("a", 2, None)
    assert found.dtype == np.float32 and found.ctypes.data % 64 == 0
    assert arrays.raw("a").dtype == np.float16
    for shape in ((3, 2), (2,), (2, 3, 1)):
        with pytest.raises(ValueError, match='"a".*2.*3'):
            arrays.array("a", *shape)
    for name, size in (("n", 2), ("big", 1)):
        with pytest.raises(ValueError, match=f'"{name}" is not finite'):
            arrays.array(name, size)
    with pytest.raises(KeyError, match="b"):
        arrays.array("b", 1)


@pytest.mark.parametrize("value, largest", [(1e30, LARGEST), (-1.1e6, LARGEST), (81.0, 80.0)])
def test_values_whose_products_single_precision_cannot_hold_are_refused(value, largest):
    arrays = StoredArrays({"a": np.array([0.0, value])}, ns)
    with pytest.raises(ValueError, match=f'"a" holds values beyond {largest:g}'.replace("+", ".")):
        arrays.array("a", 2, largest=largest)
    assert arrays.array("a", 2, largest=2 * abs(value)).shape == (2,)


def test_networks_and_encodings():
    net = MLP.random([3, 4, 2], ns, np.random.default_rng(0), normalized=True)
    (size,) = GRID.shapes()["table"]
    tensors = {f"net.{k}": v.numpy() for k, v in net.named().items()} | {"grid.table": np.arange(size, dtype="f4")}
    arrays = StoredArrays(tensors, ns)
    again = arrays.net("net", [3, 4, 2], normalized=True)
    assert all(np.array_equal(again.named()[k].numpy(), v.numpy()) for k, v in net.named().items())
    assert arrays.net("net", [3, 4, 2]).norms is None
    assert arrays.grid(GRID).table.numpy().tolist() == list(range(size))
    with pytest.raises(ValueError, match='"grid.table" has the shape'):
        arrays.grid(HashGridConfig(levels=2, log2_rows=3, base=1, finest=2))


def test_members_have_names_of_their_own():
    arrays = StoredArrays({"0.a": np.zeros(1), "1.a": np.ones(1), "10.a": np.full(1, 10)}, ns)
    about, own = arrays.member(1, {"width": 4})
    assert about == {"width": 4} and own.array("a", 1).tolist() == [1]
    with pytest.raises(ValueError, match="width"):
        arrays.member(0, {"width": 0})


def test_what_is_stored_is_finite():
    values = {"a": ns.Float([1.0, 70000.0])}
    assert stored(values, False)["a"].dtype == np.float32
    with pytest.raises(NergError, match='"a".*fp16.*--half'):
        stored(values, True)
    with pytest.raises(NergError, match='"a" is not finite.*diverged'):
        stored({"a": ns.Float([np.inf])}, False)
    with pytest.raises(NergError, match='"a".*06'):
        stored({"a": ns.Float([-2e6])}, True)
    assert stored({"a": ns.TensorXf(np.ones((2, 2), np.float32))}, True)["a"].dtype == np.float16
