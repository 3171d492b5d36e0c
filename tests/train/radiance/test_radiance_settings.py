"""Tests of `nerg_mi.train.radiance_settings`."""

import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.maths.geometry import ContractedBox
from nerg_mi.train.radiance_settings import (
    FEW_RAYS,
    RadianceSettings,
    adapted_rays,
    affordable_rays,
    refined,
    sized_config,
)

from .ball import BOX

# ---- How much a training step takes on follows samples, within its bounds ----


STRIDES = (16, 8, 4, 2)


def test_rays_fill_the_batch_or_the_pass_before_it_whichever_is_full_first():
    assert adapted_rays(1000, kept=10, looked=20, batch=16000, most=128000) == 1260  # half way to .95 * 1600
    assert adapted_rays(1000, kept=10, looked=100, batch=16000, most=128000) == 1108  # half way to .95 * 1280
    rays = 1000
    for _ in range(40):
        rays = adapted_rays(rays, kept=2, looked=300, batch=16000, most=128000)
    assert rays * 300 <= 0.95 * 128000 < (rays + 2) * 300


def test_rays_change_by_a_factor_of_two_at_most_and_stay_in_bounds():
    assert adapted_rays(1000, kept=0, looked=0, batch=16000, most=128000) == 2000
    assert adapted_rays(1000, kept=1e6, looked=1e6, batch=16000, most=128000) == 500
    assert adapted_rays(2**14, kept=0, looked=0, batch=16000, most=128000) == 2**14
    assert adapted_rays(64, kept=1e6, looked=1e6, batch=16000, most=128000) == 64


@pytest.mark.parametrize(
    "rays, looked, steps, expected",
    [
        (500, 100, 340, 500),
        (5000, 100, 340, 1216),  # the pass
        (5000, 1, 3400, 617),  # the steps on the way
        (5000, 0, 10**9, 1),
    ],
)
def test_rays_of_a_step_are_those_that_are_affordable(rays, looked, steps, expected):
    assert affordable_rays(rays, looked, steps, most=128000, candidates=2_100_000) == expected


def test_marching_gets_finer_by_one_stride_a_step_when_it_is_time_to():
    assert refined(16, STRIDES, 16, 1, 128000) == 16
    assert refined(16, STRIDES, 8, 1, 128000) == 8
    assert refined(16, STRIDES, 1, 1, 128000) == 8
    assert refined(2, STRIDES, 1, 1, 128000) == 1
    assert refined(1, STRIDES, 1, 1, 128000) == 1
    # Never coarser again.
    assert refined(2, STRIDES, 4, 1, 128000) == 2
    assert refined(4, (), 1, 1, 128000) == 1


def test_marching_waits_while_the_next_stride_has_no_room_for_enough_rays():
    most = 128000
    fits = most / FEW_RAYS / 2  # samples a ray, of which the finer stride has twice as many
    assert refined(8, STRIDES, 1, 0.99 * fits, most) == 4
    assert refined(8, STRIDES, 1, 1.01 * fits, most) == 8
    assert refined(8, STRIDES, 1, 1.01 * fits, most, waits=False) == 4
    # From 16 to 1 is sixteen times as many.
    assert refined(16, (16,), 1, 0.99 * fits, most) == 16
    assert refined(16, (16,), 1, 0.99 * fits / 8, most) == 1


# ---- What a radiance training is asked for: sizes, schedules, and what is refused ----


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
