"""Tests of `nerg_mi.train.gaze_run`."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.probes.kde import SphericalKde
from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_data import Supervision, TargetNeeds
from nerg_mi.train.gaze_log_density import elevation_density, prior_field
from nerg_mi.train.gaze_run import make_targets
from nerg_mi.train.gaze_settings import GazeSettings
from nerg_mi.train.geometry import GazePlace, voxelise_hits
from nerg_mi.transport.volume_medium import VolumeMedium

from .looks import LIKELIHOOD, LOG, NOWHERE, PROBES, PRODUCT, RAYS, SMALL, looking_at, planned, train
from .views import around

# ---- The field for a place where nobody was tracked: how high people look elsewhere ----


def looking(directions, person=None) -> Rays:
    d = np.asarray(directions, float)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    person = np.zeros(len(d), int) if person is None else np.asarray(person)
    names = tuple(f"p{k}" for k in range(person.max() + 1))
    return Rays(np.arange(len(d)), person, names, np.zeros((len(d), 3)), d, np.ones(len(d)))


def test_it_is_the_kernel_density_of_rays_that_are_turned_to_every_azimuth():
    rng = np.random.default_rng(0)
    rays = looking(rng.normal(size=(5, 3)))
    azimuth = np.arange(720) * np.pi / 360
    up = np.repeat(rays.direction[:, 2], len(azimuth))
    flat = np.sqrt(1 - up**2)
    turned = np.stack([flat * np.tile(np.cos(azimuth), 5), flat * np.tile(np.sin(azimuth), 5), up], axis=1)
    for kappa in (5.0, 30.0):
        sine = np.linspace(-1, 1, 41)
        at = np.stack([np.sqrt(1 - sine**2), 0 * sine, sine], axis=1)
        expected = SphericalKde(turned, np.array([0, len(turned)]), kappa, backend="llvm").evaluate(at)[0]
        # Bins of the sine are two degrees wide at the poles.
        assert elevation_density([rays], sine, kappa) == pytest.approx(expected, rel=2e-2, abs=2e-4)


def test_places_count_alike_and_people_within_them():
    """One place has nine rays up of one person and one down of another; the other place has one up."""
    first = looking(9 * [[0, 0, 1.0]] + [[0, 0, -1.0]], 9 * [0] + [1])
    down, up = elevation_density([first, looking([[0, 0, 1.0]])], np.array([-1.0, 1.0]))
    assert up / down == pytest.approx(3, rel=1e-2)


def test_the_field_is_that_density_wherever_somebody_stands():
    ns, d = namespace("llvm"), fibonacci_directions(20_000)
    rays = looking(np.random.default_rng(1).normal(size=(50, 3)) * [1, 1, 0.3] - [0, 0, 0.2])
    field = prior_field([rays], ns)
    sine = np.linspace(-1, 1, 201)
    expected = np.interp(d[:, 2], sine, elevation_density([rays], sine))
    r = ns.Array3f(np.ascontiguousarray(d.T, np.float32))
    for place in ((0.0, 0.0, 0.0), (40.0, -7.0, 1.6)):
        gaze, _, _ = field.evaluate(r * 3 + ns.Array3f(*place), ns.Array3f(*place), r, integral=ns.Float(1.0))
        found = np.array(gaze)
        assert 4 * np.pi * found.mean() == pytest.approx(1, abs=1e-3)
        # A thousandth is uniform, and the table has rows of 2.8 degrees.
        assert np.abs(found - expected).max() < 0.01
    assert not field.config.needs_surfaces


# ---- Whole runs: validation, the second fit, equal seeds, fresh directions, rays and views in one ----


def test_equal_seeds_train_equal_fields(rays, wall):
    settings = GazeSettings(steps=6, zones=0, probes=2, directions=32, refit=False)
    weights = lambda s: train(wall, s, SMALL, supervision=Supervision(rays)).field.parameters()
    first, second, other = weights(settings), weights(settings), weights(replace(settings, seed=1))
    for name in first:
        np.testing.assert_allclose(np.array(first[name]), np.array(second[name]), atol=1e-6)
    assert np.abs(np.array(first["emit_head.0"]) - np.array(other["emit_head.0"])).max() > 1e-3


def test_validation_stops_and_the_best_is_fitted_again(rgb):
    rays = looking_at((1.5, 0, 1.2), 3000, spread=6.0)
    density, box = voxelise_hits(rays, 0.2)
    data = rgb.TensorXf(density[..., None])
    to_world = rgb.ScalarTransform4f().translate(box.lower).scale([float(u - l) for l, u in zip(box.lower, box.upper)])
    medium = VolumeMedium(rgb.load_dict({"type": "gridvolume", "data": data, "to_world": to_world}))
    settings = GazeSettings(steps=12, looks=4, zones=2, watched=6, probes=4, directions=32)
    states = []
    place = GazePlace(medium, box, "hits")
    field, about = train(place, settings, SMALL, supervision=Supervision(rays), tell=states.append)
    v = about["validation"]
    assert v["best_step"] in [h["steps"] for h in v["history"]] and about["refitted"]
    assert about["steps"] == v["best_step"] and v["loss"] == min(h["loss"] for h in v["history"])
    assert {s.stage for s in states} == {"probes", "fit", "refit"} and states[-1].done == 1
    assert 0 < v["rays_held_out"] < len(rays) and json.loads(json.dumps(about, allow_nan=False)) == about
    assert field.config == SMALL


def test_directions_are_fresh_in_every_epoch(wall, monkeypatch):
    """16 probes, 4 a step: an epoch is four steps. Without it there is one set of directions."""
    from nerg_mi.train import gaze_data

    drawn, sets = [], gaze_data.rotated_sets
    monkeypatch.setattr(gaze_data, "rotated_sets", lambda *given: drawn.append(sets(*given)) or drawn[-1])
    settings = replace(PRODUCT, zones=0, steps=9)
    train(wall, settings, SMALL, replace(PROBES, fresh=True))
    assert len(drawn) == 3 and np.abs(drawn[0] - drawn[1]).max() > 0.1 and np.abs(drawn[1] - drawn[2]).max() > 0.1
    drawn.clear()
    train(wall, settings, SMALL)
    assert len(drawn) == 1


def test_the_blind_density_of_rays_and_views_is_that_of_the_rays():
    needs = TargetNeeds(blind_rows=8)
    plan, views = planned(LOG, LIKELIHOOD), around(4)
    rays = make_targets(Supervision(RAYS), NOWHERE, plan, needs, 3)
    both = make_targets(Supervision(RAYS, views), NOWHERE, plan, needs, 3)
    alone = make_targets(Supervision(None, views), NOWHERE, plan, needs, 3)
    np.testing.assert_array_equal(both.blind, rays.blind)
    assert np.abs(alone.blind - rays.blind).max() > 0.1 and len(both.truth) == len(rays.truth) + 4
