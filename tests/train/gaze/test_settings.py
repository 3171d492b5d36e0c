"""Settings of a gaze training: their limits, and the learning rate over a run."""

from __future__ import annotations

import json

import pytest

from nerg_mi.errors import NergError
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings


def test_the_learning_rate_is_held_and_then_falls_to_its_last():
    s = GazeSettings(steps=10, learning_rate=0.02, final_rate=0.04, hold=0.25)
    assert s.rate(0) == s.rate(0.25) == 0.02
    assert s.rate(0.625) == pytest.approx(0.02 * 0.2) and s.rate(1) == s.rate(1.5) == pytest.approx(0.02 * 0.04)


@pytest.mark.parametrize("wrong", [{}, {"steps": 1, "minutes": 1.0}, {"steps": 1, "loss": "mse"}])
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(NergError):
        GazeSettings(**wrong)


def test_settings_are_kept_as_json():
    for settings in (GazeSettings(steps=3, loss="code"), ProbeSettings(radius=0.3, spacing=0.1)):
        assert type(settings)(**json.loads(json.dumps(settings.to_dict()))) == settings
