"""Tests of `nerg_mi.train.gaze_log_density`."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.evaluation import metrics
from nerg_mi.fields.gaze_base import make_prior_table
from nerg_mi.fields.gaze_product import ProductHead
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.tracking.probes import place_probes
from nerg_mi.train.gaze_data import GazeTargets, make_targets_from_probes
from nerg_mi.train.gaze_log_density import LikelihoodTrainer, evaluate_log_density, log_mean_exp
from nerg_mi.train.gaze_product import ProductTrainer, evaluate_gaze_density
from nerg_mi.train.gaze_settings import GazeSettings
from nerg_mi.train.gaze_trainer import KLD_EPS
from tests.fields.gaze.test_log_density import BOX, SMALL, jit, made, vectors

from .looks import SMALL as PRODUCT

# ---- Likelihood training: the loss is the divergence, a validation sees the field's density, a law is learnt ----

FAST = GazeSettings(
    steps=150,
    loss="likelihood",
    integral_weight=0.0,
    probes=4,
    directions=128,
    rays=64,
    learning_rate=1e-2,
    weight_decay=0.1,
    validation_zones=0,
    ema_decay=0.9,
)


def targets(probes=6, count=512, seed=0):
    """All look at one point of a wall, from any position; the wall x = 1.5 is the only surface."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform((-1, -1, 1.4), (1, 1, 1.8), (probes, 3))
    d = np.broadcast_to(fibonacci_directions(count), (probes, count, 3))
    mean = np.array([1.5, 0.5, 1.6]) - positions
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    truth = np.exp(20 * (np.einsum("pdi,pi->pd", d, mean) - 1))
    truth /= 4 * np.pi * truth.mean(axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        t = (1.5 - positions[:, None, 0]) / d[..., 0]
    escaped = ~((t > 0) & (t < 10))
    return GazeTargets(
        positions.astype(np.float32),
        d.astype(np.float32),
        truth.astype(np.float32),
        np.where(escaped, 3, t).astype(np.float32),
        escaped,
        prior_table=np.full((8, 16), -np.log(4 * np.pi)),
    )


def testlog_mean_exp():
    x = np.array([[1.0, 2, 3], [900, 901, 899], [-500, -501, -502]])
    result = np.array(log_mean_exp(namespace("llvm").Float(x.astype(np.float32).ravel()), 3))
    np.testing.assert_allclose(result, x.max(1) + np.log(np.exp(x - x.max(1, keepdims=True)).mean(1)), rtol=1e-6)


def test_the_loss_is_the_cross_entropy():
    """With all directions and many rays, the sampled loss converges."""
    data, ns = targets(3), namespace("llvm")
    trainer = LikelihoodTrainer(
        data, BOX, replace(SMALL, mix=0.0), replace(FAST, probes=3, directions=512, rays=8192), ns
    )
    drawn = float(trainer.compute_loss(trainer.draw_batch())[0])
    scores = trainer.evaluate(data)
    entropy = -(4 * np.pi * data.truth * np.log(data.truth + 1e-30)).mean()
    assert drawn == pytest.approx(scores.kld + entropy, abs=0.01)
    assert scores.integral == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("mix", [0.0, 0.3])
def test_validation_uses_the_density_of_the_field(mix):
    """With the prior weight and its integral over the same directions."""
    data, ns = targets(2), namespace("llvm")
    rows = np.random.default_rng(3).normal(size=(SMALL.prior, 2 * SMALL.prior))
    data = replace(
        data, prior_table=make_prior_table(np.exp(rows).ravel(), SMALL.prior, ns, data.directions[0].astype(float))
    )
    trainer = LikelihoodTrainer(data, BOX, replace(SMALL, mix=mix), replace(FAST, probes=2), ns)
    scores = trainer.evaluate(data)
    assert scores.integral == pytest.approx(1, abs=1e-4)
    field, kld = trainer.make_field(), []
    for p_o, d, t, gone, truth in zip(data.positions, data.directions, data.distance, data.misses, data.truth):
        args = jit(p_o + d * t[:, None]), jit(np.broadcast_to(p_o, d.shape)), jit(d)
        product = np.multiply(*(np.array(v, np.float64) for v in field.unnormalized(*args, escaped=ns.Bool(gone))))
        density = (1 - mix) * product / (4 * np.pi * product.mean()) + mix * np.exp(np.array(field.log_prior(args[2])))
        kld.append(metrics.kld(truth[None], density[None], eps=KLD_EPS)[0])
    assert scores.kld == pytest.approx(np.mean(kld), rel=1e-4)


def test_a_law_is_learnt_and_holds_elsewhere():
    ns = namespace("llvm")
    trainer = LikelihoodTrainer(targets(24), BOX, replace(SMALL, mix=0.0), FAST, ns)
    before = trainer.evaluate(targets(6, seed=9))
    while trainer.progress < 1:
        trainer.step()
    after = trainer.evaluate(targets(6, seed=9))
    assert before.kld > 1.0 and after.kld < 0.25 and after.cc > 0.85
    field = trainer.make_field()
    np.testing.assert_array_equal(np.array(field.prior.array), np.array(trainer.initial_field.prior.array))


# ---- The log density's fast path: it is the field, and its gradients reach what the variant uses ----


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
@pytest.mark.parametrize("escape", ["constant", "nearest"])
def test_the_fast_path_is_the_field(variant, escape):
    field, ns = made(replace(SMALL, variant=variant, escaped=escape)), namespace("llvm")
    p_o, p_od, r = vectors(12)
    p_o = np.repeat(p_o[:3], 4, axis=0)
    gone = ns.Bool([i % 3 == 0 for i in range(12)])
    batch: Any = SimpleNamespace(p_od=jit(p_od), p_o=jit(p_o[::4]), r_o=jit(r), misses=gone)
    fast = evaluate_log_density(field, batch, field.parameters(), ns)
    emit, capture = field.unnormalized(jit(p_od), jit(p_o), jit(r), escaped=gone)
    np.testing.assert_allclose(np.array(fast), np.log(np.array(emit * capture)), atol=2e-5)


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
def test_gradients_reach_what_the_variant_uses(variant):
    field, ns = made(replace(SMALL, variant=variant)), namespace("llvm")
    trained = LikelihoodTrainer(targets(1), BOX, field.config, FAST, ns).optimiser
    parameters = {name: field.parameters()[name] for name in trained.keys()}
    dr.enable_grad(parameters)
    p_o, p_od, r = vectors(4)
    batch: Any = SimpleNamespace(p_od=jit(p_od), p_o=jit(p_o[:1]), r_o=jit(r), misses=ns.Bool([True] + 3 * [False]))
    logit = evaluate_log_density(field, batch, {**field.parameters(), **parameters}, ns)
    dr.backward(dr.sum(logit))
    assert "prior" not in parameters
    for name, value in parameters.items():
        assert np.any(np.array(dr.grad(value)) != 0), name


# ---- Trainings of products: one probe is learnt, and a whole run with validation is ----


def test_one_probe_is_learnt(rays, wall):
    probes = place_probes(rays, 0.5, queries=[[-0.6, 0, 1.6]], min_rays=8, kappa_rule="fixed", kappa=20.0)
    targets = make_targets_from_probes(probes, wall, 256)
    np.testing.assert_allclose(4 * np.pi * targets.truth.mean(), 1, atol=0.01)
    settings = GazeSettings(steps=200, learning_rate=1e-2, weight_decay=0.0, validation_zones=0)
    trainer = ProductTrainer(targets, BOX, PRODUCT, settings, ns)
    before = trainer.evaluate(targets)
    for _ in range(200):
        trainer.step()
    after = trainer.evaluate(targets)
    assert before.kld > 0.5
    assert after.kld < 0.05 and after.cc > 0.97 and abs(after.integral - 1) < 0.15


@pytest.mark.parametrize("loss, judged", [("paper", 0.5 + 0.25 + 0.01), ("code", 0.1 * 0.25 + 0.01)])
def test_validation_objective_is_the_training_loss(rays, wall, loss, judged):
    probes = place_probes(rays, 0.5, queries=[[-0.6, 0, 1.6]], min_rays=8, kappa_rule="fixed", kappa=20.0)
    settings = GazeSettings(steps=1, loss=loss, integral_weight=2.0, validation_zones=0)
    trainer = ProductTrainer(make_targets_from_probes(probes, wall, 64), BOX, PRODUCT, settings, ns)
    assert trainer.validation_objective(kld=0.5, cc=0.75, mae=0.01, off=0.1) == pytest.approx(judged + 0.2)


# ---- The product's fast path: it is the field, and its gradients reach what the variant uses ----


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
@pytest.mark.parametrize("activation", ["softplus", "linear"])
def test_the_fast_path_is_the_field_product(variant, activation):
    ns, rng = namespace("llvm"), np.random.default_rng(3)
    field = ProductHead.random(replace(PRODUCT, variant=variant, activation=activation, emit_scale=0.3), BOX, ns, 5)
    # Random tables are near zero; features of size one reveal wrong indices.
    field.set_parameters({"grid.table": ns.Float(rng.normal(size=len(field.grid.table)).astype(np.float32))})
    B, D = 3, 7
    p_o, p_od = rng.uniform(0, 1.9, (3, B)), rng.uniform(-0.5, 2.5, (3, B * D))
    r_o = rng.normal(size=(3, B * D))
    r_o /= np.linalg.norm(r_o, axis=0)
    p_o, p_od, r_o = (ns.Array3f(np.ascontiguousarray(v, np.float32)) for v in (p_o, p_od, r_o))
    fast = evaluate_gaze_density(field.config, BOX, field.parameters(), p_od, p_o, r_o, ns)
    each = dr.gather(ns.Array3f, p_o, dr.arange(ns.UInt32, B * D) // D)
    np.testing.assert_allclose(np.array(fast), np.array(field.evaluate(p_od, each, r_o)[0]), rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
def test_gradients_reach_what_the_variant_uses_product(variant):
    ns = namespace("llvm")
    config = replace(PRODUCT, variant=variant)
    trained = ProductTrainer(targets(1), BOX, config, GazeSettings(steps=1), ns).optimiser
    field = ProductHead.random(config, BOX, ns, 5).parameters()
    parameters = {name: field[name] for name in trained.keys()}
    dr.enable_grad(parameters)
    p_o, r_o = ns.Array3f([0.1], [0.2], [1.0]), ns.Array3f([0, 0.6], [0.8, 0], [0.6, 0.8])
    dr.backward(
        dr.sum(evaluate_gaze_density(config, BOX, parameters, ns.Array3f([0.1, 1], [1, 0.2], [2, 2]), p_o, r_o, ns))
    )
    for name, value in parameters.items():
        assert np.any(np.array(dr.grad(value)) != 0), name
