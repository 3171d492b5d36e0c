"""Options of folds: those of places and of parts among them."""

from pathlib import Path

from nerg_mi.workflows.gaze_commands import FoldOptions


def test_they_say_a_place_and_who_makes_parts():
    options = FoldOptions(geometry="hits", store=Path("kept"))
    assert options.in_parts and (options.folds, options.first, options.people) == (5, 0, 0.5)
    assert set(options.splits.split(",")) == {"both", "pos", "people"}
