"""Settings of what is traced from an observer: which of them decide where a ray meets its surface."""

from dataclasses import fields, replace

import pytest

from nerg_mi.transport.march_primal import MarchSettings
from nerg_mi.transport.observer import ObserverSettings

SETTINGS = ObserverSettings(march=MarchSettings(0.1))
OTHERS = {
    "march": MarchSettings(0.2),
    "depth": "expected",
    "surface_opacity": 0.7,
    "visibility": "map",
    "tolerance": 0.1,
    "map_height": 8,
    "directions": 64,
    "integral_tolerance": 0.1,
}
OF_A_POINT = ("visibility", "tolerance", "map_height", "directions", "integral_tolerance")


def test_each_setting_is_tried():
    assert {f.name for f in fields(ObserverSettings)} == set(OTHERS)


@pytest.mark.parametrize("name", list(OTHERS))
def test_surfaces_are_decided_by_the_ray_and_not_by_what_is_compared(name):
    """What an observer sees all around is kept for other visibilities, and made anew for other surfaces."""
    other = replace(SETTINGS, **{name: OTHERS[name]})
    assert (other.surfaces == SETTINGS.surfaces) == (name in OF_A_POINT)
