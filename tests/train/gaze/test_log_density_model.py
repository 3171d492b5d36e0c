"""The log density's fast path: it is the field, and its gradients reach what the variant uses."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.mlp import namespace
from nerg_mi.train.gaze_log_density import log_gaze, used_parameters
from tests.fields.gaze.test_log_density import BOX, SMALL, jit, made, vectors


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
@pytest.mark.parametrize("escape", ["constant", "nearest"])
def test_the_fast_path_is_the_field(variant, escape):
    field, ns = made(replace(SMALL, variant=variant, escaped=escape)), namespace("llvm")
    p_o, p_od, r = vectors(12)
    p_o = np.repeat(p_o[:3], 4, axis=0)
    gone = ns.Bool([i % 3 == 0 for i in range(12)])
    fast = log_gaze(field.config, BOX, field.parameters(), jit(p_od), jit(p_o[::4]), jit(r), gone, ns)
    emit, capture = field.unnormalized(jit(p_od), jit(p_o), jit(r), escaped=gone)
    np.testing.assert_allclose(np.array(fast), np.log(np.array(emit * capture)), atol=2e-5)


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
def test_gradients_reach_what_the_variant_uses(variant):
    field, ns = made(replace(SMALL, variant=variant)), namespace("llvm")
    parameters = used_parameters(field.config, field.parameters())
    dr.enable_grad(parameters)
    p_o, p_od, r = vectors(4)
    logit = log_gaze(
        field.config,
        BOX,
        {**field.parameters(), **parameters},
        jit(p_od),
        jit(p_o[:1]),
        jit(r),
        ns.Bool([True] + 3 * [False]),
        ns,
    )
    dr.backward(dr.sum(logit))
    assert "prior" not in parameters
    for name, value in parameters.items():
        assert np.any(np.array(dr.grad(value)) != 0), name
