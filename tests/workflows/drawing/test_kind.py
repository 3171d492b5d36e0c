"""Options that kinds of figures share."""

import pytest

from nerg_mi.errors import NergError
from nerg_mi.figures.overlay import Style, find_overlay
from nerg_mi.workflows.draw_scenes import ScaleOptions


def test_a_style_of_options():
    assert ScaleOptions(cmap="viridis", decades=3, hatching=False).style("a") == Style("viridis", 3, False, "a")
    for given, said in (({"top": 0.0}, "--top"), ({"decades": -1}, "--decades"), ({"cmap": "jet"}, '"jet" is no')):
        with pytest.raises(NergError, match=said):
            ScaleOptions(**given).style()


def test_a_scale_is_needed():
    find_overlay("visibility").check_limits(None)
    find_overlay("gaze").check_limits((0, 1))
    with pytest.raises(NergError, match='"gaze" is 0 wherever'):
        find_overlay("gaze").check_limits(None)
