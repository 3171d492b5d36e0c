"""A training says when its result is worse than it might be."""

from nerg_mi.train.radiance_run import complaints


def looks(*psnr):
    return [{"steps": 100 * (k + 1), "psnr": x} for k, x in enumerate(psnr)]


def test_a_sound_run_has_nothing_to_say():
    assert complaints(looks(18, 22, 25.9, 25.2), 2000, 1, 2.0, 120.0) == []
    assert complaints([], 2000, 1, None) == []


def test_a_fall_below_an_earlier_look_is_named_with_its_numbers():
    (said,) = complaints(looks(18, 24.31, 22, 23.2), 2000, 1, 2.0, 120.0)
    assert "23.20 dB" in said and "step 200 had 24.31 dB" in said and "1.1 dB worse" in said and "--minutes" in said
    assert complaints(looks(18, 24.2, 22, 23.3), 2000, 1, 2.0, 120.0) == []


def test_an_end_at_a_coarse_stride_is_named():
    (said,) = complaints([], 2000, 4, None)
    assert "4 times coarser" in said and "--steps" in said and "--minutes" not in said


def test_few_steps_are_named_with_the_machine_s_rate():
    (said,) = complaints(looks(10, 12.6), 44, 1, 2.0, 120.0)
    assert "only 44 steps (0.37 a second: this machine is slow or busy)" in said and "--minutes" in said
    (said,) = complaints(looks(10, 12.6), 40, 1, None, 2.0)
    assert "only 40 steps," in said and "machine" not in said and "--minutes" not in said
    assert complaints([], 500, 1, None) == [] != complaints([], 499, 1, None)
