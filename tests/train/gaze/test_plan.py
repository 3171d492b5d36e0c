"""Plans: what a run must agree on to be gone on with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.maths.geometry import Box, Similarity
from nerg_mi.train.gaze_data import Supervision
from nerg_mi.train.gaze_trainer import StateSettings, alignment

from .looks import LOG, NOWHERE, PROBES, PRODUCT, RAYS, SMALL, planned
from .views import around

MOVED = replace(NOWHERE, align=Similarity(np.diag([2.0, 2, 2, 1])))


@pytest.mark.parametrize(
    "name, plan, supervision, place, about",
    [
        ("settings", planned(SMALL, replace(PRODUCT, seed=1)), None, NOWHERE, {}),
        ("probes", planned(SMALL, PRODUCT, replace(PROBES, kappa=9.0)), None, NOWHERE, {}),
        ("architecture", planned(replace(SMALL, variant="emit"), PRODUCT), None, NOWHERE, {}),
        ("rays", None, Supervision(RAYS.select(np.arange(100))), NOWHERE, {}),
        ("views", None, Supervision(RAYS, around(2)), NOWHERE, {}),
        ("box", None, None, replace(NOWHERE, box=Box((0, 0, 0), (1, 1, 1))), {}),
        ("align", None, None, MOVED, {}),
        ("place", None, None, NOWHERE, {"place": "elsewhere"}),
    ],
)
def test_runs_differ_in_what_they_are_made_of(name, plan, supervision, place, about):
    base = planned(SMALL, PRODUCT).identity(Supervision(RAYS), NOWHERE, StateSettings())
    other = (plan or planned(SMALL, PRODUCT)).identity(
        supervision or Supervision(RAYS), place, StateSettings(about=about)
    )
    assert {k for k in other if other[k] != base.get(k)} == {name}


def test_an_alignment_that_moves_nothing_is_none():
    assert alignment(NOWHERE) is None and alignment(MOVED) == np.diag([2.0, 2, 2, 1]).tolist()


def test_settings_are_changed_by_name():
    plan = planned(LOG, replace(PRODUCT, loss="likelihood"))
    assert plan.with_settings(seed=7) == replace(plan, settings=replace(plan.settings, seed=7))
