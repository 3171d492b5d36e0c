"""Trainings of products: one probe is learnt, and a whole run with validation is."""

from __future__ import annotations

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.probes.probes import place_probes
from nerg_mi.train.gaze_data import targets_of_probes
from nerg_mi.train.gaze_product import ProductTrainer
from nerg_mi.train.gaze_settings import GazeSettings

from .looks import BOX, SMALL


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
