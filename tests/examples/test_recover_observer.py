"""Recovering an observer, at sizes that take seconds: what is found, not what is printed."""

import numpy as np
import pytest

from examples import recover_observer as example


def test01_distances_of_pictures():
    a = np.random.default_rng(0).exponential(1, (2, 16, 24))
    b, c = (np.roll(a, k, axis=2) for k in (1, 8))
    assert example.distance(a, a) == 0 and example.loss(a, a) == 0
    # A block of 8 averages what moved by one pixel; not so what moved by eight.
    assert 0 < example.distance(a, b) < example.distance(a, c) and example.loss(a, b) > 0
    assert np.allclose(example.pooled(a, 8), a.reshape(2, 2, 8, 3, 8).mean((2, 4)))
    assert example.distance(np.stack([a, b]), a).shape == (2,)


def test02_a_step_solves_a_linear_problem_and_leaves_edges_out():
    """Logarithms linear in the position: one step, but for its damping; pixels dark in either picture have no say."""
    rng = np.random.default_rng(1)
    J, truth = rng.normal(0, 0.1, (2, 6, 8, 3)), np.array([0.1, -0.05, 0.02])
    now = rng.uniform(1, 2, (2, 6, 8))
    given = (now + example.FLOOR) * np.exp(J @ truth) - example.FLOOR
    slope = (now + example.FLOOR)[..., None] * J
    assert np.allclose(example.gauss_newton_step(now, slope, given, 1e3), truth, rtol=0.02, atol=1e-3)
    given[:, ::2] = 0
    now[:, :, ::3] = 0
    assert np.allclose(example.gauss_newton_step(now, slope, given, 1e3), truth, rtol=0.03, atol=2e-3)
    far = example.gauss_newton_step(now, slope * 0.01, given, 1e3)
    assert np.linalg.norm(far) <= example.LONGEST * 1.0001


@pytest.mark.nightly
def test03_an_observer_is_found_again(rgb):
    pictures, truth = example.Pictures((24, 16), cameras=example.CAMERAS[2:3]), np.array([4.4, 2.8, 1.6])
    start = truth + (0.1, 0.2, 0.05)
    derivatives = pictures.derivatives(truth)
    # Where all pictures around are bright no edge passes: there the derivatives are those of the pictures.
    # Far enough for what directions add to the integral over the sphere where edges pass them.
    h = 1e-2
    ends = [[pictures.at(truth + s * h * e) for s in (1, -1)] for e in np.eye(3)]
    differences = np.stack([(a - b) / (2 * h) for a, b in ends], -1)
    bend = np.max([np.abs(a + b - 2 * pictures.at(truth)) for a, b in ends], axis=0) / h
    smooth = bend < 0.02
    assert np.abs(differences[smooth]).max() > 0.1 and smooth.mean() > 0.5
    assert np.linalg.norm((derivatives - differences)[smooth]) < 0.1 * np.linalg.norm(differences[smooth])

    found = example.descend(pictures, pictures.given(truth, seed=1), start, 5)
    end, least = found.answer()
    assert np.linalg.norm(end - truth) < 0.06 and least < found.losses[0]


def test04_guesses_and_observers_stand_where_one_can_stand():
    for points, clearance in ((example.first_guesses(0.8), 0.15), (example.true_observers(5, 0), 0.22)):
        assert len(points) >= 5 and points.shape[1] == 3 and example.standing(points[:, :2], clearance).all()
    assert not np.array_equal(example.true_observers(5, 0), example.true_observers(5, 1))
