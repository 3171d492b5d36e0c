"""How much a training step takes on follows samples, within its bounds."""

import pytest

from nerg_mi.train.radiance_settings import FEW_RAYS, adapted_rays, affordable_rays, refined

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
