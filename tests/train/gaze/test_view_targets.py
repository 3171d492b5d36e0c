"""Views as targets: what they hold, likelihood and losses given a view, a law learnt from views."""

from __future__ import annotations

from dataclasses import replace

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.photos.salience import pixel_solid_angles
from nerg_mi.train.gaze_data import Supervision, TargetNeeds, Targets, concatenate, targets_of_views
from nerg_mi.train.gaze_log_density import LikelihoodTrainer
from nerg_mi.train.gaze_product import ProductTrainer
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings
from nerg_mi.train.geometry import GazePlace
from tests.fields.gaze.test_log_density import BOX, SMALL

from .looks import SMALL as PLAIN
from .looks import looking_at, train
from .views import LENS, around, lobe

PLACE = GazePlace(None, BOX, "none")
PROBES = ProbeSettings(directions=512, radius=0.25, min_rays=1)


def test_directions_and_densities_of_a_view():
    views = around(3)
    found = targets_of_views(views, PLACE, PROBES)
    assert found.truth.shape == (3, 512) and found.blind is None
    np.testing.assert_allclose(found.truth.mean(axis=1) * found.extent, 1, rtol=1e-5)
    np.testing.assert_allclose(found.extent, pixel_solid_angles(LENS).sum(), rtol=1e-5)
    for k, v in enumerate(views):
        np.testing.assert_allclose(found.positions[k], v.camera.center, atol=1e-6)
        assert v.look_up(found.directions[k])[1].all()
        # Pixels of 6 degrees are averages: the law is as steep as it is.
        given = lobe(v.camera.center, found.directions[k].astype(float))
        given /= given.mean() * found.extent[k]
        assert np.corrcoef(given, found.truth[k])[0, 1] > 0.9


def test_the_likelihood_is_given_the_view():
    """Drawn loss and validation against the field's own densities, divided by their sum over the view in NumPy."""
    data = targets_of_views(around(4), PLACE, PROBES, TargetNeeds.of(SMALL))
    settings = GazeSettings(steps=1, loss="likelihood", integral=0.0, probes=4, directions=512, rays=2048, zones=0)
    trainer = LikelihoodTrainer(data, BOX, replace(SMALL, mix=0.0, geometry="none"), settings, ns)
    field = trainer.initial
    r_o, p_o = data.directions.reshape(-1, 3), np.repeat(data.positions, 512, axis=0)
    jit = lambda v: ns.Array3f(np.ascontiguousarray(v.T, np.float32))
    emit, capture = field.unnormalized(jit(p_o), jit(p_o), jit(r_o))
    density = np.array(emit * capture, np.float64).reshape(4, 512)
    density /= density.mean(axis=1, keepdims=True) * data.extent[:, None]
    part = data.truth.astype(float) * data.extent[:, None] / 512
    scores = trainer.measure(data)
    assert scores.kld == pytest.approx(np.mean(np.sum(part * np.log(data.truth / density), axis=1)), abs=1e-4)
    assert scores.mae == pytest.approx(np.abs(density - data.truth).mean(), rel=1e-3)
    assert scores.integral == pytest.approx(1, abs=1e-5)
    trainer.backward()
    assert float(trainer.loss[0]) == pytest.approx(np.mean(np.sum(-part * np.log(density), axis=1)), abs=0.02)


def test_the_losses_of_a_density_do_not_see_its_scale_through_views():
    """But do for probes of rays that are beside them."""
    data = targets_of_views(around(3), PLACE, PROBES)
    sphere = Targets(
        data.positions,
        np.broadcast_to(fibonacci_directions(512), (3, 512, 3)).astype(np.float32),
        np.full((3, 512), 1 / (4 * np.pi), np.float32),
        data.distance,
        data.escaped,
    )
    settings = GazeSettings(steps=1, zones=0)
    of = lambda data, scale: ProductTrainer(data, BOX, replace(PLAIN, emit_scale=scale), settings, ns).measure(data)
    np.testing.assert_allclose(of(data, 0.1), of(data, 0.7), rtol=1e-4, atol=1e-6)
    assert of(data, 0.1).integral == pytest.approx(1, abs=1e-5)
    both = concatenate(sphere, data)
    assert both.truth.shape == (6, 512) and both.extent[0] == pytest.approx(4 * np.pi)
    for scale in (0.1, 0.7):
        parts = np.array(of(sphere, scale)), np.array(of(data, scale))
        np.testing.assert_allclose(of(both, scale), np.mean(parts, axis=0), rtol=1e-4, atol=1e-6)
    assert of(sphere, 0.7).mae > 2 * of(sphere, 0.1).mae


@pytest.mark.nightly
def test_a_law_is_learnt_from_views_alone_and_holds_around():
    settings = GazeSettings(
        steps=120,
        loss="likelihood",
        integral=0.0,
        probes=12,
        directions=128,
        rays=64,
        learning_rate=1e-2,
        weight_decay=0.1,
        zones=2,
        average=0.9,
        looks=4,
    )
    config = replace(SMALL, mix=0.05, geometry="none", prior=16)
    views = Supervision(None, around(90))
    field, about = train(PLACE, settings, config, replace(PROBES, radius=0.1), views)
    assert about["rays"] == 0 and about["salience_views"] == 90 and about["validation"]["views_held_out"] >= 10
    from nerg_mi.evaluation.gaze import gaze_field

    rng, d = np.random.default_rng(5), fibonacci_directions(1024)
    positions = rng.uniform((-0.9, -0.9, 1.45), (0.9, 0.9, 1.75), (8, 3))
    truth = np.stack([lobe(p, d) for p in positions])
    found = gaze_field(field, None)(positions, d)
    # Of 1,024 directions and of an integral that errs by 2e-3 at most, as a rule.
    np.testing.assert_allclose(4 * np.pi * found.mean(axis=1), 1, atol=4e-3)
    kld = lambda q: np.mean(truth * np.log(truth / q)) * 4 * np.pi
    cc = np.mean([np.corrcoef(a, b)[0, 1] for a, b in zip(truth, found)])
    assert kld(np.full(1024, 1 / (4 * np.pi))) > 0.8
    assert kld(found) < 0.25 and cc > 0.85


def test_rays_and_views_train_one_field():
    both = Supervision(looking_at((1.5, 0.4, 1.2)), around(6))
    settings = GazeSettings(steps=4, probes=4, directions=32, zones=1, watched=4, looks=2)
    probes = ProbeSettings(radius=0.25, count=8, cap=64, min_rays=4, directions=64)
    for config, more in ((PLAIN, {}), (SMALL, {"loss": "likelihood"})):
        field, about = train(PLACE, replace(settings, **more), config, probes, both)
        assert about["rays"] == 400 and about["salience_views"] == 6 and about["probes_made"] == 14
        assert all(np.isfinite(np.array(v)).all() for v in field.parameters().values())
