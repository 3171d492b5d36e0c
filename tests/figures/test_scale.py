"""Ticks say the values of the places at which they stand."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.figures.style import ticks_of

SUPER = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹−", "-0123456789-")


def value(name, factor=""):
    """The number that a tick says, read as a person does."""
    name, factor = name.translate(SUPER), factor.translate(SUPER)
    power = lambda text: 1.0 if text in ("", "1") else 10.0 ** int(text[2:] or 1)
    return (
        power(name)
        if name.startswith("10") and name[2:].startswith(("-", *"23456789"))
        else float(name) * power(factor)
    )


@pytest.mark.parametrize("top", [1.0, 0.8, 1.37, 23.0, 9999.0, 12345.0, 3.3e-4, 7e-12, 4e15, 1e-3])
@pytest.mark.parametrize("most", [3, 5, 9])
def test_linear(top, most):
    places, names, factor = ticks_of(0.0, top, most)
    assert 2 <= len(places) <= most + 1 and len(set(names)) == len(names)
    for place, name in zip(places, names):
        assert -1e-9 <= place <= 1 + 1e-9
        assert value(name, factor) == pytest.approx(place * top, abs=1e-6 * top)
        assert len(name) <= 6


def test_from_one_value_to_another_and_around_zero():
    for low, high in ((2.0, 7.3), (-0.5, 0.5), (-3e-6, 3e-6), (100.0, 100.4)):
        places, names, factor = ticks_of(low, high, 6)
        for place, name in zip(places, names):
            assert value(name, factor) == pytest.approx(low + place * (high - low), abs=1e-6 * max(abs(low), high))
    assert "0.0" in ticks_of(-0.5, 0.5, 6)[1] and not any(n.startswith("−0.0") and float(n[1:]) == 0 for n in names)


@pytest.mark.parametrize("low, high", [(1e-4, 1.0), (3e-12, 0.3), (1e-20, 1e10), (0.05, 700.0)])
def test_logarithmic(low, high):
    places, names, factor = ticks_of(low, high, 5, log=True)
    assert factor == "" and 2 <= len(places) <= 6
    for place, name in zip(places, names):
        text = name.translate(SUPER)
        found = {"1": 1.0, "10": 10.0}.get(text) or 10.0 ** int(text[2:])
        assert np.log10(found) == pytest.approx(np.log10(low) + place * np.log10(high / low), abs=1e-9)


def test_less_than_a_decade():
    places, names, _ = ticks_of(0.2, 0.8, 5, log=True)
    assert places == [0.0, 0.5, 1.0] and names == ["0.2", "0.4", "0.8"]
