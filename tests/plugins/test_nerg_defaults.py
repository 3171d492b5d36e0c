"""What the manual says of the integrator's defaults is what it does without a say."""

import re
import sys

import numpy as np
import pytest

from .scenes import constant

NAMES = [
    "occlusion",
    "falloff",
    "tolerance",
    "visibility",
    "map_height",
    "directions",
    "integral_tolerance",
    "depth",
    "surface_opacity",
    "radiance",
    "background",
    "aovs",
    "step",
    "quadrature",
    "coarse",
    "dt_gamma",
    "stop",
    "color_cutoff",
    "refined",
    "jitter",
]


def manual(mi):
    """Name of each parameter with a default -> that default, as the plugin's documentation spells it."""
    mi.load_dict({"type": "nerg"})
    text = sys.modules["nerg_mi.plugins.nerg"].__doc__
    entries = re.split(r"^ \* - ", text, flags=re.MULTILINE)[1:]
    found = {e.split("\n")[0].strip(): re.search(r"\(Default:\s*([^;,:) ]+(?:,opacity)?)", e) for e in entries}
    # A ceiling is none by default, and its up says nothing without one: tests/plugins/test_nerg_ceiling.py.
    return {name: m[1].strip("`\n ") for name, m in found.items() if m and name not in ("ceiling", "up")}


def test01_every_parameter_has_its_default_in_the_manual(rgb):
    assert list(manual(rgb)) == NAMES


def told(integrator):
    s = integrator.settings
    return {
        **vars(s),
        **vars(integrator.observer_settings),
        "text": str(integrator),
        "background": np.array(integrator.background).tolist(),
    }


@pytest.mark.parametrize("name", NAMES)
def test02_a_default_that_is_given_changes_nothing(rgb, name):
    plain = {"type": "nerg", "density": {"type": "constvolume", "value": 1.0}}
    value = manual(rgb)[name]
    integers, numbers = (
        ("map_height", "directions"),
        ("falloff", "tolerance", "integral_tolerance", "surface_opacity", "background")
        + ("step", "coarse", "dt_gamma", "stop", "color_cutoff"),
    )
    value = (
        int(value)
        if name in integers
        else float(value)
        if name in numbers
        else {"true": True, "false": False}.get(value, value)
    )
    assert told(rgb.load_dict({**plain, name: value})) == told(rgb.load_dict(plain))
    other = {
        "visibility": "map",
        "depth": "refined",
        "quadrature": "linear",
        "aovs": "opacity",
        "surface_opacity": 0.25,
        "integral_tolerance": 0.5,
        "dt_gamma": 0.5,
        "stop": 0.5,
        "color_cutoff": 0.5,
    }
    other = other[name] if name in other else not value if isinstance(value, bool) else value + 2
    assert told(rgb.load_dict({**plain, name: other})) != told(rgb.load_dict(plain))


def test03_a_step_that_is_not_given_is_a_share_of_the_diagonal(rgb):
    integrator = rgb.load_dict(constant())
    assert integrator.settings.step == pytest.approx(
        3**0.5 / 1024, rel=1e-5
    ) and integrator.settings.cell_step == float("inf")
    given = rgb.load_dict(constant(step=0.25)).settings
    assert given.step == given.cell_step == 0.25
