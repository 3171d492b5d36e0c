"""Tests of `nerg_mi.train.radiance_diagnosis`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from nerg_mi.photos.cameras import Intrinsics, PosedCamera
from nerg_mi.photos.images import PhotoView
from nerg_mi.photos.observed import ObservedPoints
from nerg_mi.train.radiance_diagnosis import Outcome, find_causes, find_problems


def make_outcome(*psnr, steps=2000, stride=1, minutes: float | None = 2.0, seconds=120.0, result=None, training=None):
    history = [{"steps": 100 * (k + 1), "psnr": x, "psnr_train": training} for k, x in enumerate(psnr)]
    row = None if not psnr else history[-1 if result is None else result]
    return Outcome(history, row, psnr[-1] if psnr else None, steps, stride, minutes, seconds)


def test_a_fall_of_held_out_views_is_reported():
    (line,) = find_problems(make_outcome(21, 24.31, 22, 23.2, result=1), [])
    assert "step 200 with 24.31 dB" in line and "23.20 dB" in line
    assert find_problems(make_outcome(21, 24.2, 22, 23.3, result=1), []) == []


def test_a_short_training_is_not_said_to_fall():
    (line,) = find_problems(make_outcome(21, 24.31, 22, steps=499, result=1), [])
    assert "499 steps" in line and "24.31" not in line


def test_a_coarse_final_stride_is_reported():
    (line,) = find_problems(make_outcome(stride=4, minutes=None), [])
    assert "4 times coarser" in line and "steps" in line and "minutes" not in line


def test_too_few_steps_are_reported_with_the_rate():
    (line,) = find_problems(make_outcome(10, 12.6, steps=44), [])
    assert "only 44 steps (0.37 per second: this machine is slow)" in line and "minutes" in line
    (line,) = find_problems(replace(make_outcome(10, 12.6, steps=44), waiting_fraction=0.45), [])
    assert "other programs used 45% of the processor time" in line
    (line,) = find_problems(make_outcome(10, 12.6, steps=40, minutes=None), [])
    assert "only 40 steps," in line and "machine" not in line and "minutes" not in line
    assert find_problems(make_outcome(steps=500, minutes=None), []) == []


@pytest.mark.parametrize(
    "psnr, training, is_poor",
    [(19.0, 21.0, True), (23.0, 28.5, True), (23.0, 26.0, False), (23.0, None, False), (29.0, 35.0, False)],
)
def test_poor_fields_are_named_with_their_causes(psnr, training, is_poor):
    outcome = make_outcome(psnr, training=training)
    lines = find_problems(outcome, ["few photos"])
    assert outcome.is_poor == is_poor == any("poor" in line and "few photos" in line for line in lines)


# ---- Causes ----


POINTS = ObservedPoints(np.zeros((1, 3)), np.zeros(1))


def make_views(count=60, focal=lambda k: 50.0, picture=None, points=POINTS):
    rng = np.random.default_rng(0)
    views = []
    for k in range(count):
        color = rng.random((48, 64, 3)).astype(np.float32) if picture is None else picture(k, rng).astype(np.float32)
        lens = Intrinsics(64, 48, focal(k), focal(k), 32.0, 24.0)
        views.append(PhotoView(f"photo {k}", PosedCamera(lens, np.eye(4)), color, points=points))
    return views


def test_views_that_chose_the_state_do_not_judge_it():
    """The views that chose have 26 dB, and the others 18 dB."""
    outcome = replace(make_outcome(26.0, training=27.0), psnr=18.0)
    assert outcome.is_poor and outcome.gap == pytest.approx(9)
    (line,) = find_problems(outcome, [])
    assert "held-out views have 18.0 dB, training views 9.0 dB more" in line


def test_sound_photos_have_no_causes():
    assert find_causes(make_views()) == []


def test_causes_are_found():
    """Each in photos that have no other problem."""
    cases = {
        "only 12 training photos": find_causes(make_views(12)),
        "factor of 2.00": find_causes(make_views(focal=lambda k: 50.0 if k % 2 else 100.0)),
        "0.5 stops": find_causes(make_views(), exposure_stops=0.5),
        "80%": find_causes(make_views(), outside_fraction=0.8),
        "nerg poses": find_causes(make_views(points=None)),
    }

    def object_on_white(k, rng):
        out = np.full((48, 64, 3), 0.9)
        out[16:32, 16:32] = rng.random((16, 16, 3))
        return out

    def one_in_five_blurred(k, rng):
        out = rng.random((48, 64, 3))
        return gaussian_filter(out, (1.5, 1.5, 0)) if k % 5 == 0 else out

    cases["92% of the photos' area"] = find_causes(make_views(picture=object_on_white))
    cases["12 photos are blurred: remove photo 0, photo 5"] = find_causes(make_views(picture=one_in_five_blurred))
    for text, causes in cases.items():
        assert len(causes) == 1 and text in causes[0], (text, causes)
