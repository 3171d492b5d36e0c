"""Errors of pictures whose distance from the truth is known."""

import math

import numpy as np

from nerg_mi.evaluation import study_truth as study_reference
from nerg_mi.evaluation.study_truth import errors


def test_errors_of_known_pictures():
    n = 1000
    one, none = np.ones(n), np.zeros(n)
    known = study_reference.Truth(np.full((n, 3), 0.5), one, 2 * one, one, np.linspace(1, 2, n), "", {})
    seen = {
        "color": np.full((n, 3), 0.6),
        "opacity": one,
        "depth": np.where(np.arange(n) < 100, 2.5, 2.0),
        "visibility": one,
        "gaze": np.linspace(1, 2, n),
    }
    off = errors(seen, known, (2 * one, np.arange(n) >= 250))
    assert math.isclose(off["color_rmse"], 0.1, rel_tol=1e-9) and math.isclose(off["color_psnr"], 20, rel_tol=1e-9)
    assert math.isclose(off["depth_mae"], 0.05) and off["depth_p99"] == 0.5
    assert off["visibility_mae"] == 0 and off["visibility_wrong"] == 0.25
    assert off["gaze_mae"] == 0 and abs(off["gaze_kld"]) < 1e-12
    # Errors of either sign; and half seen is seen.
    half = np.where(np.arange(n) % 2, 0.4, 0.6)
    off = errors({"opacity": 0.5 + half, "visibility": half}, known, (2 * one, one > 0))
    assert math.isclose(off["opacity_mae"], 0.1) and off["visibility_wrong"] == 0.5
    # A ray that met nothing counts in full; what was not rendered has no error.
    off = errors({"depth": none, "color": none[:, None]}, known)
    assert off["depth_mae"] == 2 and "color_rmse" not in off and "gaze_mae" not in off
