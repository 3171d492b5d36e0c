"""Integrals over the sphere against closed forms: in as few directions as do, and never worse than is said."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.transport.observer_gaze import FEWEST, FIRST, USUAL, integrate

MOST = 1 << 17


def cap(direction, cos: float, background: float):
    """Values of 1 within a cone, and of ``background`` elsewhere, at all directions; what they integrate to."""
    exact = 2 * np.pi * (1 - cos) + background * 2 * np.pi * (1 + cos)
    return lambda count: np.where(fibonacci_directions(count) @ direction > cos, 1.0, background), exact


def lobe(direction, kappa: float):
    """A von Mises-Fisher density, whose integral is 1."""
    scale = kappa / (2 * np.pi * -np.expm1(-2 * kappa))
    return lambda count: scale * np.exp(kappa * (fibonacci_directions(count) @ direction - 1)), 1.0


@pytest.fixture
def turned():
    rng = np.random.default_rng(0)
    return [v / np.linalg.norm(v) for v in rng.normal(size=(20, 3))]


@pytest.mark.parametrize("tolerance", [1e-2, 2e-3])
def test_jumps_are_integrated_to_the_tolerance(turned, tolerance):
    off, share, counts = [], [], []
    for k, direction in enumerate(turned):
        values, exact = cap(direction, np.cos(0.2 + 0.1 * k), 0.1)
        found = integrate(values, MOST, tolerance)
        off.append(abs(found.value / exact - 1))
        share.append(off[-1] / found.error)
        counts.append(found.directions)
        assert found.error <= tolerance or found.directions == MOST
    # One sum is no proof: the error of four in five is below what is told, and that of all below twice the tolerance.
    assert max(off) <= 2 * tolerance and np.mean(off) < tolerance / 2 and np.mean(np.array(share) < 1) >= 0.75
    assert np.median(counts) < MOST / 4
    if tolerance == 1e-2:
        assert max(counts) <= FIRST


def test_narrow_lobes_take_more_directions(turned):
    counts = []
    for kappa in (1, 100, 1e4):
        values, exact = lobe(turned[0], kappa)
        found = integrate(values, 1 << 18, 5e-3)
        assert found.value == pytest.approx(exact, rel=1e-3)
        counts.append(found.directions)
    assert FIRST == counts[0] < counts[1] < counts[2]


@pytest.mark.parametrize(
    ("tolerance", "first"),
    [(1e-4, FIRST), (USUAL, FIRST), (1.9 * USUAL, FIRST // 2), (4 * USUAL, FIRST // 4), (1.0, FEWEST)],
)
def test_a_wider_tolerance_begins_with_fewer(tolerance, first):
    asked = []

    def even(count):
        asked.append(count)
        return np.ones(count)

    assert integrate(even, MOST, tolerance).value == pytest.approx(4 * np.pi) and asked == [first]
    assert integrate(even, 1000, tolerance).directions == 1000


def test_a_tolerance_of_zero_takes_all(turned):
    values, exact = lobe(turned[0], 10)
    asked = []
    found = integrate(lambda count: (asked.append(count), values(count))[1], 1 << 15, 0.0)
    assert asked == [1 << 15] == [found.directions]
    assert found.value == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize("most", [1, 5, 64, FIRST])
def test_no_more_than_are_allowed(most):
    found = integrate(lambda count: np.arange(count) % 2 + 1.0, most, 1e-9)
    assert found.directions == most and found.value == pytest.approx(4 * np.pi * np.mean(np.arange(most) % 2 + 1))


def test_nothing_at_all_is_zero():
    found = integrate(np.zeros, MOST, 1e-3)
    assert found.value == 0 and found.error == 0 and found.directions == FIRST
