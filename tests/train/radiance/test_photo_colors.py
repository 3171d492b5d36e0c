"""Photos of one place that differ in exposure and white balance: what is learnt is the place of the average photo."""

from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.train.radiance_losses import PHOTOS, PhotoColors
from nerg_mi.train.radiance_trainer import RadianceTrainer
from tests.tiny import ball_pose

from .ball import BOX, TINY, ball, settings


def numbers(count=3):
    return np.random.default_rng(0).normal(size=12 * count).astype(np.float32)


def test_colors_change_by_a_matrix_and_an_offset_of_each_photo():
    """Against NumPy; the mean over the photos is no change."""
    photos, given = PhotoColors(ns, 3), numbers()
    matrices = photos.matrices(ns.Float(given))
    shifted = 0.01 * (given.reshape(3, 3, 4) - given.reshape(3, 3, 4).mean(axis=0))
    assert np.allclose(matrices, np.eye(3, 4) + shifted, atol=1e-6)
    assert np.allclose(matrices.mean(axis=0), np.eye(3, 4), atol=1e-6)
    color, opacity, frame = np.random.default_rng(1).random((3, 5)), np.linspace(0, 1, 5), [0, 2, 1, 2, 0]
    out = photos.apply(
        photos.changes(ns.Float(given)), [ns.Float(c) for c in color], ns.Float(opacity), ns.UInt32(frame)
    )
    m = matrices[frame]
    expected = np.einsum("nij,jn->in", m[..., :3], color) + m[..., 3].T * opacity
    assert np.allclose(np.array([c.numpy() for c in out]), expected, atol=1e-6)
    assert photos.decay(photos.changes(ns.Float(given)))[0] == pytest.approx(np.sum(shifted**2) / 3, rel=1e-5)


def test_photos_that_agree_change_nothing():
    photos = PhotoColors(ns, 2)
    assert np.array_equal(photos.matrices(photos.start()), np.tile(np.eye(3, 4), (2, 1, 1)))
    assert photos.stops(photos.start()) == 0


def test_stops_of_photos_with_twice_and_half_the_light():
    photos, gain = PhotoColors(ns, 2), 2 ** (1 / 2.2)
    # Their mean is to be no change: one photo is brighter by what the other is darker.
    half = (gain - 1) / (gain + 1)
    given = np.zeros((2, 3, 4), np.float32)
    for k, sign in enumerate((1, -1)):
        given[k, :, :3] = sign * half / 0.01 * np.eye(3)
    assert photos.stops(ns.Float(given.ravel())) == pytest.approx(0.5, rel=1e-5)


def test_derivatives_are_those_of_the_formula():
    photos, given = PhotoColors(ns, 3), numbers()
    color, frame = np.random.default_rng(1).random((3, 4)), np.array([0, 1, 2, 1])

    def value(x):
        parameter = ns.Float(x)
        dr.enable_grad(parameter)
        out = photos.apply(photos.changes(parameter), [ns.Float(c) for c in color], ns.Float(1), ns.UInt32(frame))
        loss = sum(dr.sum(dr.square(c)) for c in out)
        dr.backward(loss)
        return loss[0], dr.grad(parameter).numpy()

    gradient = value(given)[1]
    for k in (0, 7, 13, 30):
        step = np.zeros_like(given)
        step[k] = 0.5
        # A quadratic: central differences are exact.
        assert gradient[k] == pytest.approx(value(given + step)[0] - value(given - step)[0], abs=2e-4)


@pytest.mark.nightly
@pytest.mark.slow
def test_exposures_are_found():
    """Of photos that show the same, so that nothing else can explain how they differ."""
    gains = np.linspace(0.9, 1.1, 6)[:, None] * (1 + np.random.default_rng(0).uniform(-0.02, 0.02, (6, 3)))
    view, views = ball(ball_pose(np.array([0, -2.0, 0])), depth=False), []
    for gain in gains:
        pixels = view.pixels.copy()
        pixels[..., :3] *= gain.astype(np.float32)
        views.append(replace(view, pixels=np.clip(pixels, 0, 1)))
    trainer = RadianceTrainer(views, BOX, TINY, settings(steps=500, photo_decay=1e-4), ns, depth=False)
    while trainer.progress < 1:
        trainer.step()
    found = trainer.photos.matrices(trainer.averaged[PHOTOS])
    # What becomes of the mean colour of the ball.
    mean = view.pixels[view.pixels[..., 3] > 0.5][:, :3].mean(axis=0)
    changed = (found[..., :3] @ mean + found[..., 3]) / mean
    assert np.allclose(changed, gains / gains.mean(axis=0), atol=0.005)


def test_a_single_photo_has_nothing_to_differ_from(dataset):
    alone = RadianceTrainer(dataset.train[:1], BOX, TINY, settings(), ns, depth=False)
    without = RadianceTrainer(dataset.train, BOX, TINY, settings(photo_colors=False), ns, depth=False)
    assert alone.photos is None and without.photos is None and PHOTOS not in without.averaged
    alone.step()
    without.step()


def test_the_field_is_the_place_without_any_photos_colors(dataset):
    trainer = RadianceTrainer(dataset.train, BOX, TINY, settings(), ns, depth=False)
    trainer.step()
    trainer.averaged[PHOTOS] = ns.Float(numbers(len(dataset.train)))
    assert PHOTOS not in trainer.field(bound=False).parameters()
