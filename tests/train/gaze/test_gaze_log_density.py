"""Tests of `nerg_mi.train.gaze_log_density`."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.evaluation import metrics
from nerg_mi.fields.gaze_base import blind_table
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.train.gaze_data import Targets
from nerg_mi.train.gaze_log_density import LikelihoodTrainer, log_gaze, log_mean_exp, used_parameters
from nerg_mi.train.gaze_settings import KLD_EPS, LOSSES, GazeSettings
from tests.fields.gaze.test_log_density import BOX, SMALL, jit, made, vectors

# ---- Likelihood ----
#
# Likelihood training: the loss is the divergence, a validation sees the field's density, a law is learnt.


FAST = GazeSettings(
    steps=150,
    loss="likelihood",
    integral=0.0,
    probes=4,
    directions=128,
    rays=64,
    learning_rate=1e-2,
    weight_decay=0.1,
    zones=0,
    average=0.9,
)


def targets(probes=6, count=512, seed=0):
    """Everyone looks at one point of a wall, from wherever they stand; the wall x = 1.5 is all there is."""
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
    return Targets(
        positions.astype(np.float32),
        d.astype(np.float32),
        truth.astype(np.float32),
        np.where(escaped, 3, t).astype(np.float32),
        escaped,
        blind=np.full((8, 16), -np.log(4 * np.pi)),
    )


def testlog_mean_exp():
    x = np.array([[1.0, 2, 3], [900, 901, 899], [-500, -501, -502]])
    found = np.array(log_mean_exp(namespace("llvm").Float(x.astype(np.float32).ravel()), 3))
    np.testing.assert_allclose(found, x.max(1) + np.log(np.exp(x - x.max(1, keepdims=True)).mean(1)), rtol=1e-6)


def test_the_loss_is_the_cross_entropy():
    """Over all directions and many rays, what is drawn is what it stands for."""
    data, ns = targets(3), namespace("llvm")
    trainer = LikelihoodTrainer(
        data, BOX, replace(SMALL, mix=0.0), replace(FAST, probes=3, directions=512, rays=8192), ns
    )
    trainer.backward()
    drawn = float(trainer.loss[0])
    scores = trainer.measure(data)
    entropy = -(4 * np.pi * data.truth * np.log(data.truth + 1e-30)).mean()
    assert drawn == pytest.approx(scores.kld + entropy, abs=0.01)
    assert scores.integral == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("mix", [0.0, 0.3])
def test_a_validation_sees_the_density_that_the_field_has(mix):
    """With its share of the blind density, and its integral, taken over the same directions."""
    data, ns = targets(2), namespace("llvm")
    rows = np.random.default_rng(3).normal(size=(SMALL.prior, 2 * SMALL.prior))
    data = replace(data, blind=blind_table(np.exp(rows).ravel(), SMALL.prior, ns, data.directions[0].astype(float)))
    trainer = LikelihoodTrainer(data, BOX, replace(SMALL, mix=mix), replace(FAST, probes=2), ns)
    scores = trainer.measure(data)
    assert scores.integral == pytest.approx(1, abs=1e-4)
    field, kld = trainer.field(), []
    for p_o, d, t, gone, truth in zip(data.positions, data.directions, data.distance, data.escaped, data.truth):
        args = jit(p_o + d * t[:, None]), jit(np.broadcast_to(p_o, d.shape)), jit(d)
        product = np.multiply(*(np.array(v, np.float64) for v in field.unnormalized(*args, escaped=ns.Bool(gone))))
        density = (1 - mix) * product / (4 * np.pi * product.mean()) + mix * np.exp(np.array(field.log_blind(args[2])))
        kld.append(metrics.kld(truth[None], density[None], eps=KLD_EPS)[0])
    assert scores.kld == pytest.approx(np.mean(kld), rel=1e-4)


def test_a_validation_is_judged_by_the_weights_of_its_loss():
    trainer, weight = LikelihoodTrainer(targets(2), BOX, SMALL, FAST, namespace("llvm")), LOSSES["likelihood"]
    weighted = weight["kld"] * 2.0 + weight["cc"] * (1 - 0.25) + weight["mae"] * 0.5
    assert trainer.judge(2.0, 0.25, 0.5, 9.0) == weighted


def test_a_law_is_learnt_and_holds_elsewhere():
    ns = namespace("llvm")
    trainer = LikelihoodTrainer(targets(24), BOX, replace(SMALL, mix=0.0), FAST, ns)
    before = trainer.measure(targets(6, seed=9))
    while trainer.progress < 1:
        trainer.step()
    after = trainer.measure(targets(6, seed=9))
    assert before.kld > 1.0 and after.kld < 0.25 and after.cc > 0.85
    field = trainer.field()
    np.testing.assert_array_equal(np.array(field.prior.array), np.array(trainer.initial.prior.array))


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
def test_equal_seeds_train_equal_fields(variant):
    def train(seed):
        trainer = LikelihoodTrainer(
            targets(), BOX, replace(SMALL, variant=variant), replace(FAST, seed=seed), namespace("llvm")
        )
        for _ in range(4):
            trainer.step()
        return trainer.weights()

    first, second, other = train(0), train(0), train(1)
    for name in first:
        np.testing.assert_allclose(first[name].numpy(), second[name].numpy(), atol=1e-6)
    name = "capture_net.0" if variant == "capture" else "emit_net.0"
    assert np.abs(first[name].numpy() - other[name].numpy()).max() > 1e-3


# ---- The log density's fast path: it is the field, and its gradients reach what the variant uses ----


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
