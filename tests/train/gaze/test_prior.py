"""The field for a place where nobody was tracked: how high people look elsewhere."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.probes.kde import SphericalKde
from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_log_density import elevation_density, prior_field


def looking(directions, person=None) -> Rays:
    d = np.asarray(directions, float)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    person = np.zeros(len(d), int) if person is None else np.asarray(person)
    names = tuple(f"p{k}" for k in range(person.max() + 1))
    return Rays(np.arange(len(d)), person, names, np.zeros((len(d), 3)), d, np.ones(len(d)))


def test_it_is_the_kernel_density_of_rays_that_are_turned_to_every_azimuth():
    rng = np.random.default_rng(0)
    rays = looking(rng.normal(size=(5, 3)))
    azimuth = np.arange(720) * np.pi / 360
    up = np.repeat(rays.direction[:, 2], len(azimuth))
    flat = np.sqrt(1 - up**2)
    turned = np.stack([flat * np.tile(np.cos(azimuth), 5), flat * np.tile(np.sin(azimuth), 5), up], axis=1)
    for kappa in (5.0, 30.0):
        sine = np.linspace(-1, 1, 41)
        at = np.stack([np.sqrt(1 - sine**2), 0 * sine, sine], axis=1)
        expected = SphericalKde(turned, np.array([0, len(turned)]), kappa, backend="llvm").evaluate(at)[0]
        # Bins of the sine are two degrees wide at the poles.
        assert elevation_density([rays], sine, kappa) == pytest.approx(expected, rel=2e-2, abs=2e-4)


def test_places_count_alike_and_people_within_them():
    """One place has nine rays up of one person and one down of another; the other place has one up."""
    first = looking(9 * [[0, 0, 1.0]] + [[0, 0, -1.0]], 9 * [0] + [1])
    down, up = elevation_density([first, looking([[0, 0, 1.0]])], np.array([-1.0, 1.0]))
    assert up / down == pytest.approx(3, rel=1e-2)


def test_the_field_is_that_density_wherever_somebody_stands():
    ns, d = namespace("llvm"), fibonacci_directions(20_000)
    rays = looking(np.random.default_rng(1).normal(size=(50, 3)) * [1, 1, 0.3] - [0, 0, 0.2])
    field = prior_field([rays], ns)
    sine = np.linspace(-1, 1, 201)
    expected = np.interp(d[:, 2], sine, elevation_density([rays], sine))
    r = ns.Array3f(np.ascontiguousarray(d.T, np.float32))
    for place in ((0.0, 0.0, 0.0), (40.0, -7.0, 1.6)):
        gaze, _, _ = field.evaluate(r * 3 + ns.Array3f(*place), ns.Array3f(*place), r, integral=ns.Float(1.0))
        found = np.array(gaze)
        assert 4 * np.pi * found.mean() == pytest.approx(1, abs=1e-3)
        # A thousandth is uniform, and the table has rows of 2.8 degrees.
        assert np.abs(found - expected).max() < 0.01
    assert not field.config.needs_surfaces
