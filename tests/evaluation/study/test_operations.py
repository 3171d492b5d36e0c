"""What is counted: operations that are traced, whatever the machine."""

import drjit as dr
import drjit.llvm.ad as ns

from nerg_mi.evaluation.study import traced_operations


def test_more_work_has_more_operations_and_more_lanes_have_not():
    x = lambda n: dr.arange(ns.Float, n)
    one, two = (traced_operations(lambda f=f: f(x(100))) for f in (dr.sin, lambda v: dr.sin(v) + dr.cos(v * v)))
    assert 0 < one < two
    assert traced_operations(lambda: dr.sin(x(100_000))) == one


def test_what_was_computed_before_is_not_counted():
    y = dr.sin(dr.arange(ns.Float, 100))
    dr.eval(y)
    assert traced_operations(lambda: y) == 0
