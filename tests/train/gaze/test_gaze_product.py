"""Tests of `nerg_mi.train.gaze_product`."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.gaze_product import GazeField
from nerg_mi.fields.mlp import namespace
from nerg_mi.probes.probes import place_probes
from nerg_mi.train.gaze_data import targets_of_probes
from nerg_mi.train.gaze_product import ProductTrainer, gaze_density, used_parameters
from nerg_mi.train.gaze_settings import GazeSettings

from .looks import BOX, SMALL

# ---- Trainings of products: one probe is learnt, and a whole run with validation is ----


def test_one_probe_is_learnt(rays, wall):
    probes = place_probes(rays, 0.5, queries=[[-0.6, 0, 1.6]], min_rays=8, kappa_rule="fixed", kappa=20.0)
    targets = targets_of_probes(probes, wall, 256)
    np.testing.assert_allclose(4 * np.pi * targets.truth.mean(), 1, atol=0.01)
    settings = GazeSettings(steps=200, learning_rate=1e-2, weight_decay=0.0, zones=0)
    trainer = ProductTrainer(targets, BOX, SMALL, settings, ns)
    before = trainer.measure(targets)
    for _ in range(200):
        trainer.step()
    after = trainer.measure(targets)
    assert before.kld > 0.5
    assert after.kld < 0.05 and after.cc > 0.97 and abs(after.integral - 1) < 0.15


@pytest.mark.parametrize("loss, judged", [("paper", 0.5 + 0.25 + 0.01), ("code", 0.1 * 0.25 + 0.01)])
def test_a_validation_is_judged_by_the_loss_that_is_trained(rays, wall, loss, judged):
    probes = place_probes(rays, 0.5, queries=[[-0.6, 0, 1.6]], min_rays=8, kappa_rule="fixed", kappa=20.0)
    settings = GazeSettings(steps=1, loss=loss, integral=2.0, zones=0)
    trainer = ProductTrainer(targets_of_probes(probes, wall, 64), BOX, SMALL, settings, ns)
    assert trainer.judge(kld=0.5, cc=0.75, mae=0.01, off=0.1) == pytest.approx(judged + 0.2)


# ---- The product's fast path: it is the field, and its gradients reach what the variant uses ----


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
