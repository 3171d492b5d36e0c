"""The settings of an integrator as they are read back."""

from __future__ import annotations

import re

import numpy as np

from nerg_mi.evaluation.study_subject import parameters

NONE_OF_A_STUDY = {"aovs", "ceiling", "up"}


def test_all_settings_are_read_back_and_make_the_same_integrator(rgb):
    given = {
        "occlusion": False,
        "radiance": False,
        "jitter": True,
        "step": 0.25,
        "dt_gamma": 0.125,
        "stop": 0.5,
        "color_cutoff": 0.25,
        "quadrature": "linear",
        "coarse": 2.0,
        "refined": False,
        "falloff": 0.75,
        "depth": "expected",
        "surface_opacity": 0.25,
        "visibility": "transmittance",
        "tolerance": 0.5,
        "map_height": 64,
        "directions": 4096,
        "integral_tolerance": 0.125,
        "background": [0.25, 0.5, 0.75],
    }
    density = {"type": "constvolume", "value": 3.0}
    first = rgb.load_dict({"type": "nerg", "density": density, **given})
    found = parameters(first)
    assert found == given
    assert parameters(rgb.load_dict({"type": "nerg", "density": density, **found})) == given
    # None is forgotten of those that the manual page names.
    rows = re.findall(r"^ \* - ([\w, ]+)\n   - (?!:paramtype)", type(first).__doc__, re.MULTILINE)
    named = {name for row in rows for name in row.split(", ")}
    assert named - NONE_OF_A_STUDY == set(given) and NONE_OF_A_STUDY < named and np.isfinite(found["step"])
