"""Likelihood training: the fast path is the field, gradients, the loss is the divergence, a law is learnt."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from nerg_mi.evaluation import saliency as metrics
from nerg_mi.field.backend import namespace
from nerg_mi.field.gaze.log_density import blind_table, table_directions
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.rays import Rays
from nerg_mi.training.gaze.likelihood import LikelihoodTrainer, _log_mean_exp
from nerg_mi.training.gaze.log_density_model import log_gaze, used_parameters
from nerg_mi.training.gaze.losses import KLD_EPS
from nerg_mi.training.gaze.recipes import gaze_recipe
from nerg_mi.training.gaze.settings import GazeSettings
from nerg_mi.training.gaze.supervision import Supervision, blind_prior
from nerg_mi.transport.observer.integral import nearest_depth
from tests.field.gaze.test_log_density import BOX, SMALL, jit, made, vectors

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


def supervision(probes=6, count=512, seed=0):
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
    return Supervision(
        positions.astype(np.float32),
        d.astype(np.float32),
        truth.astype(np.float32),
        np.where(escaped, 3, t).astype(np.float32),
        escaped,
        blind=np.full((8, 16), -np.log(4 * np.pi)),
    )


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


def test_log_mean_exp():
    x = np.array([[1.0, 2, 3], [900, 901, 899], [-500, -501, -502]])
    found = np.array(_log_mean_exp(namespace("llvm").Float(x.astype(np.float32).ravel()), 3))
    np.testing.assert_allclose(found, x.max(1) + np.log(np.exp(x - x.max(1, keepdims=True)).mean(1)), rtol=1e-6)


def test_the_loss_is_the_cross_entropy():
    """Over all directions and many rays, what is drawn is what it stands for."""
    data, ns = supervision(3), namespace("llvm")
    trainer = LikelihoodTrainer(
        data, BOX, replace(SMALL, mix=0.0), replace(FAST, probes=3, directions=512, rays=8192), ns
    )
    trainer._backward()
    drawn = float(trainer.loss[0])
    scores = trainer.measure(data)
    entropy = -(4 * np.pi * data.truth * np.log(data.truth + 1e-30)).mean()
    assert drawn == pytest.approx(scores.kld + entropy, abs=0.01)
    assert scores.integral == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("mix", [0.0, 0.3])
def test_a_validation_sees_the_density_that_the_field_has(mix):
    """With its share of the blind density, and its integral, taken over the same directions."""
    data, ns = supervision(2), namespace("llvm")
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


def test_a_law_is_learnt_and_holds_elsewhere():
    ns = namespace("llvm")
    trainer = LikelihoodTrainer(supervision(24), BOX, replace(SMALL, mix=0.0), FAST, ns)
    before = trainer.measure(supervision(6, seed=9))
    while trainer.progress < 1:
        trainer.step()
    after = trainer.measure(supervision(6, seed=9))
    assert before.kld > 1.0 and after.kld < 0.25 and after.cc > 0.85
    field = trainer.field()
    np.testing.assert_array_equal(np.array(field.prior.array), np.array(trainer.initial.prior.array))


@pytest.mark.parametrize("variant", ["emit", "capture", "emit_capture"])
def test_equal_seeds_train_equal_fields(variant):
    def train(seed):
        trainer = LikelihoodTrainer(
            supervision(), BOX, replace(SMALL, variant=variant), replace(FAST, seed=seed), namespace("llvm")
        )
        for _ in range(4):
            trainer.step()
        return trainer.weights()

    first, second, other = train(0), train(0), train(1)
    for name in first:
        np.testing.assert_allclose(first[name].numpy(), second[name].numpy(), atol=1e-6)
    name = "capture_net.0" if variant == "capture" else "emit_net.0"
    assert np.abs(first[name].numpy() - other[name].numpy()).max() > 1e-3


def test_holes_take_the_depth_around_them():
    d = fibonacci_directions(2000)
    depth = 2 / np.maximum(np.abs(d).max(axis=1), 1e-9)  # from the middle of a cube of 4 m
    hole = np.arange(2000) % 7 == 0
    found = nearest_depth(d[~hole], depth[~hole], d[hole])
    wrong = np.abs(found - depth[hole])
    assert np.median(wrong) < 0.02 and wrong.max() < 0.3  # most at the corners, which are 3.5 m away
    assert nearest_depth(d[:1], depth[:1], d[5:9]) == pytest.approx(np.full(4, depth[0]))


def test_recipes():
    assert gaze_recipe().settings["zones"] == 0 and GazeSettings(**gaze_recipe("small").settings).zones == 3
    # The one has to be told to look longer where there are views alone; the others' lengths stay their own.
    assert (
        gaze_recipe().views_alone["steps"] > gaze_recipe().settings["steps"] and gaze_recipe().views_alone["zones"] == 3
    )
    assert all("steps" not in gaze_recipe(name).views_alone for name in ("small", "paper"))
    assert gaze_recipe().config.normalized and gaze_recipe("paper").config.activation == "linear"
    assert gaze_recipe("small", "emit").config.variant == "emit"
    with pytest.raises(ValueError, match="default, small, paper"):
        gaze_recipe("best")
    with pytest.raises(ValueError, match="of its own"):
        gaze_recipe("default", activation="exp")


def test_the_blind_density_counts_people_or_rays():
    """Nine rays of one person, one of another, elsewhere: the ratio of the kernels' peaks."""
    direction = np.array(9 * [[1.0, 0, 0]] + [[0, 1.0, 0]])
    rays = Rays(np.arange(10.0), np.array(9 * [0] + [1]), ("a", "b"), np.zeros((10, 3)), direction, np.ones(10))
    for weights, ratio in (("equal", 9), ("person", 1)):
        table = np.exp(blind_prior(rays, 64, weights=weights).astype(np.float64).ravel())
        at = lambda d: table[np.argmax(table_directions(64) @ d)]
        tail = np.exp(-10.0)  # of the other kernel, at a right angle
        expected = (ratio + tail) / (1 + ratio * tail)
        assert at((1, 0, 0)) / at((0, 1, 0)) == pytest.approx(expected, rel=0.02), weights
