"""Batches: what is gathered of which probe, integrals, and densities given a view."""

from __future__ import annotations

import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.train.gaze_data import TargetArrays, Targets


@pytest.fixture
def drawn():
    """Three probes of four directions, the first of the whole sphere, the others of parts of it; and that on the
    device."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(3, 4, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    positions, truth, distance = rng.uniform(-1, 1, (3, 3)), rng.random((3, 4)), rng.uniform(1, 2, (3, 4))
    extent = np.array([4 * np.pi, 1.5, 0.5], np.float32)
    escaped, semantic = rng.random((3, 4)) < 0.5, rng.normal(size=(3, 4, 2)).astype(np.float16)
    data = Targets(positions, directions, truth, distance, escaped, semantic, extent=extent)
    return data, TargetArrays(data, ns)


def test_a_batch_is_of_its_probes_and_their_directions(drawn):
    data, arrays = drawn
    probe, which = np.array([2, 0, 2]), np.array([[3, 1], [0, 0], [1, 2]])
    batch = arrays.batch(probe, which)
    towards, distance = data.directions[probe[:, None], which], data.distance[probe[:, None], which]
    np.testing.assert_allclose(batch.p_o.numpy().T, data.positions[probe], rtol=1e-6)
    np.testing.assert_allclose(batch.r_o.numpy().T, towards.reshape(-1, 3), rtol=1e-6)
    ends = data.positions[probe][:, None] + towards * distance[..., None]
    np.testing.assert_allclose(batch.p_od.numpy().T, ends.reshape(-1, 3), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(batch.truth.numpy(), data.truth[probe[:, None], which].ravel(), rtol=1e-6)
    np.testing.assert_array_equal(batch.escaped.numpy(), data.escaped[probe[:, None], which].ravel())
    np.testing.assert_allclose(batch.extent.numpy(), data.extent[probe], rtol=1e-6)
    features = np.stack([f.numpy() for f in batch.semantic], axis=-1)
    np.testing.assert_array_equal(features, data.semantic[probe[:, None], which].reshape(-1, 2))


def test_an_integral_is_over_what_each_observer_is_known_in(drawn):
    data, arrays = drawn
    batch = arrays.batch(np.arange(3), np.tile(np.arange(4), (3, 1)))
    np.testing.assert_allclose(batch.integral(batch.truth).numpy(), data.truth.mean(axis=1) * data.extent, rtol=1e-6)


@pytest.mark.parametrize("known", [False, True])
def test_only_views_are_given_what_they_show(drawn, known):
    """A part of the sphere has the truth's integral, or one; the whole sphere and what is zero stay as they are."""
    data, arrays = drawn
    batch = arrays.batch(np.arange(3), np.tile(np.arange(4), (3, 1)))
    density = np.array([[1.0, 2, 3, 4], [0, 1, 0, 2], [0, 0, 0, 0]])
    flat = lambda v: ns.Float(v.ravel().astype(np.float32))
    got = batch.given_view(flat(density), flat(data.truth) if known else None).numpy().reshape(3, 4)
    goal = data.truth[1].mean() * 1.5 if known else 1.0
    np.testing.assert_allclose(got, [density[0], density[1] * goal / (0.75 * 1.5), density[2]], rtol=1e-5)


def test_without_an_observer_there_is_nothing_to_gather():
    none = np.zeros((0, 4), np.float32)
    with pytest.raises(NergError, match="no probes to train on"):
        TargetArrays(Targets(np.zeros((0, 3)), np.zeros((0, 4, 3)), none, none, none.astype(bool)), ns)
