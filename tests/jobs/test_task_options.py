"""Options that parts of a job are named by: none that changes a result may be missing, or stale parts are taken."""

from __future__ import annotations

import pytest

from nerg_mi.aoi.options import StatisticsOptions
from nerg_mi.aoi.parts import OF_COUNTS, OF_FIELDS
from nerg_mi.jobs import folds
from nerg_mi.jobs.ablation_tasks import _OF_TRAINING
from nerg_mi.jobs.film_tasks import OF_PICTURES
from nerg_mi.jobs.options import other_fields
from nerg_mi.jobs.options.folds import FoldOptions
from nerg_mi.jobs.options.parts import FilmOptions, PartOptions

STORE = ("store", "scheduler", "threads")
# Inputs of the parts, by their bytes.
FILES = ("areas", "align", "zones", "cohorts", "field", "scene")
# Of a count: what is done with sums, or parameters of the parts by another name (the positions of eyes, "mode").
AFTERWARDS = ("eyes", "glance", "what_if", "visibility", "observers", "height", "floor", "step", "min_people", "names")
AFTERWARDS += ("salt", "resamples", "seed", "mode")
# Of folds: each of them has a parameter of its own.
NAMED = ("geometry", "splits", "zones", "positions", "people", "folds", "first", "most")


@pytest.mark.parametrize(
    "kind, of_parts, others",
    [
        (FilmOptions, OF_PICTURES, (*STORE, "defaults", "frames", "fps")),
        (StatisticsOptions, (*OF_COUNTS, *OF_FIELDS), (*STORE, *FILES[:4], *AFTERWARDS)),
        (FoldOptions, (*folds._TRAINING, *folds._SCORING), (*STORE, *FILES[1:2], *FILES[4:], *NAMED)),
    ],
)
def test_each_option_changes_the_name_of_a_part_or_none_of_its_bytes(kind, of_parts, others):
    assert set(other_fields(kind, *others)) == set(of_parts)


def test_what_is_not_left_out_names_a_part():
    assert other_fields(PartOptions, "store") == ("scheduler",)
    assert {"law", "refit", "radius", "kappa"} <= set(_OF_TRAINING) and "cameras" not in _OF_TRAINING
    with pytest.raises(ValueError, match="PartOptions has no folder"):
        other_fields(PartOptions, "folder")
