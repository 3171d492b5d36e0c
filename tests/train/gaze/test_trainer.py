"""What all trainers share: averaged weights, the schedule, seeds, frozen weights."""

from __future__ import annotations

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.probes.probes import place_probes
from nerg_mi.train.gaze_data import targets_of_probes
from nerg_mi.train.gaze_product import ProductTrainer
from nerg_mi.train.gaze_settings import GazeSettings
from nerg_mi.train.gaze_trainer import GazeTrainer

from .looks import BOX, SMALL


@pytest.fixture
def targets(rays, wall):
    """Of one probe in 64 directions."""
    probes = place_probes(rays, 0.5, queries=[[-0.6, 0, 1.6]], min_rays=8, kappa_rule="fixed", kappa=20.0)
    return targets_of_probes(probes, wall, 64)


@pytest.mark.parametrize("average", [0.0, 0.3, 0.999])
def test_what_is_kept_is_the_average_of_the_weights_so_far(targets, average):
    """An exponential one, whose memory is short at first: of (k + 1) in (k + 10) after k steps, of ``average``
    later."""
    settings = GazeSettings(steps=5, learning_rate=1e-2, zones=0, average=average)
    trainer = ProductTrainer(targets, BOX, SMALL, settings, ns)
    expected = {k: v.numpy().astype(float) for k, v in trainer.optimiser.items()}
    for k in range(1, 6):
        trainer.step()
        memory = min(average, (k + 1) / (k + 10))
        for name, value in trainer.optimiser.items():
            expected[name] = memory * expected[name] + (1 - memory) * value.numpy()
    for name, value in trainer.weights().items():
        np.testing.assert_allclose(value.numpy(), expected[name], atol=1e-6)
    assert average == 0 or np.abs(expected["emit_head.0"] - trainer.optimiser["emit_head.0"].numpy()).max() > 1e-4


def test_equal_seeds_draw_equal_batches(targets):
    def weights(seed):
        settings = GazeSettings(steps=6, zones=0, directions=32, seed=seed)
        trainer = ProductTrainer(targets, BOX, SMALL, settings, ns)
        while trainer.progress < 1:
            trainer.step()
        return {name: value.numpy() for name, value in trainer.weights().items()}

    first, second, other = weights(0), weights(0), weights(1)
    for name, value in first.items():
        np.testing.assert_allclose(value, second[name], atol=1e-6)
    assert np.abs(first["emit_head.0"] - other["emit_head.0"]).max() > 1e-3


def test_the_schedule_may_be_longer_than_the_run(targets):
    """As that of a second fit is, which ends where the first one was best."""
    trainer = ProductTrainer(targets, BOX, SMALL, GazeSettings(steps=2, zones=0), ns, schedule=10)
    trainer.step()
    assert trainer.progress == pytest.approx(0.1) and trainer.steps == 1


def test_weights_that_are_given_and_frozen_stay(targets):
    field = ProductTrainer(targets, BOX, SMALL, GazeSettings(steps=1, zones=0), ns).initial
    given = {"grid.table": field.grid.table * 0 + 0.25}
    for frozen in (True, False):
        trainer = ProductTrainer(targets, BOX, SMALL, GazeSettings(steps=1, zones=0, frozen=frozen), ns, initial=given)
        trainer.step()
        same = np.array_equal(trainer.field().grid.table.numpy(), given["grid.table"].numpy())
        assert same == frozen and ("grid.table" in trainer.optimiser.keys()) != frozen


def test_a_kind_of_field_must_say_how_it_is_trained():
    with pytest.raises(TypeError, match="abstract"):
        GazeTrainer(None, BOX, SMALL, GazeSettings(steps=1), ns)
