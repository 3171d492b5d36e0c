"""The product's fast path: it is the field, and its gradients reach what the variant uses."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.fields.gaze_product import GazeField
from nerg_mi.fields.mlp import namespace
from nerg_mi.train.gaze_product import gaze_density, used_parameters

from .looks import BOX, SMALL


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
@pytest.mark.parametrize("activation", ["softplus", "linear"])
def test_the_fast_path_is_the_field(variant, activation):
    ns, rng = namespace("llvm"), np.random.default_rng(3)
    field = GazeField.random(replace(SMALL, variant=variant, activation=activation, emit_scale=0.3), BOX, ns, 5)
    # Random tables are near zero: features of size one show an index that is wrong.
    field.set_parameters({"grid.table": ns.Float(rng.normal(size=len(field.grid.table)).astype(np.float32))})
    B, D = 3, 7
    p_o, p_od = rng.uniform(0, 1.9, (3, B)), rng.uniform(-0.5, 2.5, (3, B * D))
    r_o = rng.normal(size=(3, B * D))
    r_o /= np.linalg.norm(r_o, axis=0)
    p_o, p_od, r_o = (ns.Array3f(np.ascontiguousarray(v, np.float32)) for v in (p_o, p_od, r_o))
    fast = gaze_density(field.config, BOX, field.parameters(), p_od, p_o, r_o, ns)
    each = dr.gather(ns.Array3f, p_o, dr.arange(ns.UInt32, B * D) // D)
    np.testing.assert_allclose(np.array(fast), np.array(field.evaluate(p_od, each, r_o)[0]), rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
def test_gradients_reach_what_the_variant_uses(variant):
    ns = namespace("llvm")
    config = replace(SMALL, variant=variant)
    parameters = used_parameters(config, GazeField.random(config, BOX, ns, 5).parameters())
    dr.enable_grad(parameters)
    p_o, r_o = ns.Array3f([0.1], [0.2], [1.0]), ns.Array3f([0, 0.6], [0.8, 0], [0.6, 0.8])
    dr.backward(dr.sum(gaze_density(config, BOX, parameters, ns.Array3f([0.1, 1], [1, 0.2], [2, 2]), p_o, r_o, ns)))
    for name, value in parameters.items():
        assert np.any(np.array(dr.grad(value)) != 0), name
