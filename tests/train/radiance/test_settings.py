"""What a radiance training is asked for: sizes, schedules, and what is refused."""

import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.maths.geometry import ContractedBox
from nerg_mi.train.radiance_settings import RadianceSettings, sized_config

from .ball import BOX


def test_settings_and_sizes_are_checked():
    for wrong in (
        {},
        {"steps": 5, "minutes": 1.0},
        {"steps": 0},
        {"steps": 5, "resolution": 100},
        {"steps": 5, "thin_least": 0},
        {"steps": 5, "reach_share": 0},
    ):
        with pytest.raises(ValueError):
            RadianceSettings(**wrong)
    with pytest.raises(ValueError, match="small, medium, paper"):
        sized_config("huge", BOX)
    assert sized_config("paper", BOX).grid.log2_rows == 19


def test_damping_near_cameras_ends_when_surfaces_stand():
    s = RadianceSettings(steps=5, reach=0.4, reach_share=0.5)
    assert [s.damped_within(p) for p in (0, 0.25, 0.5, 1)] == pytest.approx([0.4, 0.2, 0, 0])


def test_a_march_takes_1024_steps_through_the_box():
    """From corner to corner of a cube, as the paper's."""
    assert RadianceSettings(steps=1).march_step * BOX.side * 1024 == pytest.approx(BOX.diagonal)


def test_a_size_is_a_grid_and_a_contracted_box_has_one_twice_as_fine():
    """Its inner cube takes half of each edge."""
    small = sized_config("small", BOX)
    assert small.grid == HashGridConfig(levels=8, log2_rows=16, base=32, finest=512) and small.density_scale == 0.5
    around = sized_config("small", ContractedBox(BOX))
    assert around.grid == HashGridConfig(levels=8, log2_rows=16, base=64, finest=1024)
    assert around.density_scale == small.density_scale
