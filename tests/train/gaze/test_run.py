"""Whole runs: validation, the second fit, equal seeds, fresh directions, rays and views in one."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np

from nerg_mi.train.gaze_data import Supervision, TargetNeeds
from nerg_mi.train.gaze_run import make_targets
from nerg_mi.train.gaze_settings import GazeSettings
from nerg_mi.train.geometry import GazePlace, voxelise_hits
from nerg_mi.transport.volume_medium import VolumeMedium

from .looks import LIKELIHOOD, LOG, NOWHERE, PROBES, PRODUCT, RAYS, SMALL, looking_at, planned, train
from .views import around


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
