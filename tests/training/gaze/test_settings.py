"""Settings of a gaze training: their limits, and the learning rate over a run."""

import pytest

from nerg_mi.training.gaze.recipes import gaze_recipe
from nerg_mi.training.gaze.settings import GazeSettings, ProbeSettings, sized_gaze_config


def test_limits_are_where_they_are_said_to_be():
    assert ProbeSettings(count=1, directions=16).count == 1
    for wrong in ({"count": 0}, {"directions": 15}):
        with pytest.raises(ValueError, match="at least one probe and 16 directions"):
            ProbeSettings(**wrong)
    least = {
        "probes": 1,
        "directions": 1,
        "rays": 1,
        "looks": 1,
        "weight_decay": 0.0,
        "integral": 0.0,
        "zones": 0,
        "patience": 0,
    }
    GazeSettings(steps=1, **least)
    for name in least:
        with pytest.raises(ValueError, match="nothing negative"):
            GazeSettings(steps=1, **{**least, name: least[name] - 1})
    for length in ({"steps": 0}, {"minutes": 0.0}, {"minutes": -1.0}):
        with pytest.raises(ValueError, match="longer than 0"):
            GazeSettings(**length)


def test_the_learning_rate_is_held_and_then_falls_to_its_last():
    s = GazeSettings(steps=10, learning_rate=0.02, final_rate=0.04, hold=0.25)
    assert s.rate(0) == s.rate(0.25) == 0.02
    assert s.rate(0.625) == pytest.approx(0.02 * 0.2) and s.rate(1) == s.rate(1.5) == pytest.approx(0.02 * 0.04)


def test_a_larger_field_has_more_of_everything():
    small, paper = sized_gaze_config("small"), sized_gaze_config("paper")
    assert (
        small.grid.size < paper.grid.size
        and small.grid.levels < paper.grid.levels
        and small.grid.log2_rows < paper.grid.log2_rows
    )


def test_the_papers_recipe_is_fifty_epochs_at_a_rate_that_falls_from_the_start():
    """Each probe is drawn fifty times; the rate is lower with every step, down to a tenth."""
    recipe = gaze_recipe("paper")
    assert recipe.settings["steps"] * recipe.settings["probes"] == 50 * recipe.probes["count"]
    settings = GazeSettings(**recipe.settings)
    assert settings.rate(0) == 1e-3 and settings.rate(0.01) < 1e-3
    assert settings.rate(0.5) == pytest.approx(1e-3 * 0.1**0.5) and settings.rate(1) == pytest.approx(1e-4)
