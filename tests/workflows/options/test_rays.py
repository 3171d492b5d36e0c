"""Options of filtering and splitting; what they do to rays is tried in tests/workflows/test_rays.py."""

import pytest

from nerg_mi.errors import NergError
from nerg_mi.workflows.rays_commands import FilterOptions, SplitOptions


def test_options_that_ask_for_nothing_say_what_can_be_asked():
    with pytest.raises(NergError, match="say which rays to keep"):
        FilterOptions()
    with pytest.raises(NergError, match="say how to split"):
        SplitOptions()


def test_a_detector_is_a_known_one():
    with pytest.raises(NergError, match='"dbscan"'):
        FilterOptions(fixations="dbscan")
    with pytest.raises(NergError, match="add --fixations"):
        FilterOptions(one_ray=True, thin=1.0)


def test_conditions_are_what_was_asked_for():
    assert FilterOptions(end=2.0, persons=("Ada",), thin=1.0).conditions == {"time": (None, 2.0), "persons": ["Ada"]}
    assert FilterOptions(thin=1.0).conditions == {}
    assert FilterOptions(box=(0, 1, 0, 1, 0, 1)).conditions == {"box": [0, 1, 0, 1, 0, 1]}
