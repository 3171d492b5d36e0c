"""Tests of `nerg_mi.train.radiance_losses`."""

from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.mlp import stack, unstack
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.train.radiance_losses import (
    PHOTO_PARAMETER,
    PhotoColors,
    color_loss,
    depth_loss,
    evaluate_density,
    evaluate_ray_color,
    evaluate_samples,
    huber_loss,
    make_density_prepass,
    surface_loss,
)
from nerg_mi.train.radiance_sampling import RaySamples, Segments
from nerg_mi.train.radiance_trainer import RadianceTrainer
from tests.tiny import ball_pose

from .ball import BOX, TINY, ball, settings

# ---- What radiance training is fitted to, against NumPy: colours and the place of absorption ----

RAY = np.array([0, 0, 0, 0, 1, 1, 1, 2, 2])
T = np.array([0.5, 1.0, 1.5, 2.0, 0.2, 0.4, 3.0, 1.0, 1.2])
LENGTH = np.array([0.5, 0.5, 0.5, 0.25, 0.2, 0.1, 1.0, 0.2, 0.4])
TAU = np.array([0.1, 0.7, 2.0, 3.0, 0.2, 40.0, 0.5, 0.3, 1.0])


def samples():
    segments = Segments.find(ns.UInt32(RAY), dr.full(ns.Bool, True, len(RAY)), 3)
    return RaySamples(ns.UInt32(RAY), ns.Float(T), ns.Float(LENGTH), None, segments, len(RAY))


def absorbed():
    """Weights of the samples, in float64."""
    weight = -np.expm1(-TAU)
    for r in range(3):
        source = RAY == r
        weight[source] *= np.exp(-np.concatenate([[0], np.cumsum(TAU[source])[:-1]]))
    return weight


@pytest.mark.parametrize("margin", [0.05, 0.3, 10.0])
def test_depth_loss(margin):
    truth, scale = np.array([1.45, 0.46, 0.0]), 0.2
    weight = absorbed()
    near = (T < truth[RAY] + margin) & (T + LENGTH > truth[RAY] - margin)
    # Mean distance of absorption in a step: the integral of s tau exp(-tau s), by the midpoint rule.
    s = (np.arange(200_000) + 0.5) / 200_000
    mean = np.array([(s * np.exp(-tau * s)).sum() / np.exp(-tau * s).sum() for tau in TAU])
    offset = T + LENGTH * mean - truth[RAY]
    caught = np.bincount(RAY, weight * near)
    shift = np.bincount(RAY, weight * near * offset)
    want = np.where(truth > 0, 1 - caught + np.minimum(np.abs(shift) / scale, 10), 0)
    got = depth_loss(ns.Float(weight), ns.Float(TAU), samples(), ns.Float(truth), margin, scale).numpy()
    assert np.allclose(got, want, rtol=1e-5, atol=1e-6)
    assert want[2] == 0 and (want[:2] > 0.01).all()
    missed = surface_loss(ns.Float(weight), samples(), ns.Float(truth), ns.Float([margin] * 3)).numpy()
    assert np.allclose(missed, np.where(truth > 0, 1 - caught, 0), rtol=1e-5, atol=1e-6)


def test_depth_loss_is_bounded_where_all_is_at_the_wrong_place():
    far = ns.Float(100.0, 100.0, 100.0)
    got = depth_loss(ns.Float(absorbed()), ns.Float(TAU), samples(), far, 1e3, 1e-3).numpy()
    assert np.allclose(got, 1 - np.bincount(RAY, absorbed()) + 10, rtol=1e-5)


@pytest.mark.parametrize("alpha", [None, [1.0, 0.25, 0.0]])
def test_color_loss(alpha):
    rng = np.random.default_rng(0)
    color, target, behind = rng.random((3, 3, 3))
    opacity, delta = np.array([0.9, 0.4, 0.0]), 0.2
    pixels = SimpleNamespace(rgb=[ns.Float(c) for c in target], alpha=None if alpha is None else ns.Float(alpha))
    got = color_loss([ns.Float(c) for c in color], ns.Float(opacity), pixels, ns.Array3f(behind), delta).numpy()
    # The colour of a picture with alpha has no background: the background shows through transparent parts.
    goal = target if alpha is None else behind * (1 - np.array(alpha)) + target * np.array(alpha)
    error = np.abs(color + (1 - opacity) * behind - goal)
    want = np.where(error < delta, error**2 / 2, delta * (error - delta / 2)).mean(axis=0)
    assert np.allclose(got, want, rtol=1e-5) and (error < delta).any() and (error > delta).any()


def test_huber_is_smooth_where_its_pieces_meet():
    x = ns.Float([-0.3, -0.1001, -0.0999, 0, 0.0999, 0.1001, 0.3])
    dr.enable_grad(x)
    y = huber_loss(x, 0.1)
    dr.backward(dr.sum(y))
    assert np.allclose(dr.grad(x).numpy(), [-0.1, -0.1, -0.0999, 0, 0.0999, 0.1, 0.1], atol=1e-6)
    assert np.allclose(y.numpy()[[0, 3, 6]], [0.1 * 0.25, 0, 0.1 * 0.25])


# ---- Model ----
#
# Forward pass of the training: precomputed features change nothing, and the heads equal those of the field.


def field():
    out, rng = RadianceNetwork.random(TINY, BOX, ns, 0), np.random.default_rng(1)
    out.set_parameters({"grid.table": ns.Float(rng.normal(size=len(out.grid.table)).astype(np.float32))})
    return out


def points():
    rng = np.random.default_rng(2)
    p = ns.Array3f(rng.uniform(-0.9, 0.9, (3, 40)).astype(np.float32))
    return p, dr.normalize(ns.Array3f(rng.normal(size=(3, 40)).astype(np.float32)))


def test_precomputed_features_change_nothing():
    f, (p, d), result = field(), points(), []
    truth = [dr.detach(x) for x in f.grid(BOX.to_unit(p))]
    for features in (None, truth):
        parameters = {k: type(v)(v) for k, v in f.parameters().items()}
        dr.enable_grad(parameters)
        sigma, rgb = evaluate_samples(TINY, BOX, parameters, p, d, ns, features)
        dr.backward(dr.sum(sigma + rgb[0] - 2 * rgb[1] * rgb[2]))
        result.append([dr.detach(sigma).numpy()] + [dr.grad(v).numpy() for v in parameters.values()])
    for a, b in zip(*result):
        assert np.abs(b).max() > 0 and np.allclose(a, b, rtol=1e-4, atol=1e-5)


def test_density_alone_is_that_of_the_field():
    f, (p, _) = field(), points()
    want = f.density(p).numpy()
    assert np.allclose(evaluate_density(TINY, BOX, f.parameters(), p, ns).numpy(), want, rtol=1e-4)
    prepass = make_density_prepass(TINY, BOX)
    for part in (slice(None), slice(150)):  # Recorded, and repeated for fewer points
        q = ns.Array3f(p.numpy()[:, part])
        sigma, features = prepass(f.parameters(), q, True)
        assert np.allclose(sigma.numpy(), want[part], rtol=1e-4)
        assert np.allclose(np.array(features), np.array(f.grid(BOX.to_unit(q))), rtol=1e-5)


def test_rows_are_stacked_and_taken_apart():
    rows = [ns.Float([1, 2, 3]), ns.Float([4, 5, 6])]
    x = stack(rows, ns)
    assert x.shape == (3, 8) and np.array_equal(x.numpy()[:, :2], [[1, 4], [2, 5], [3, 6]])
    assert not x.numpy()[:, 2:].any()
    assert np.array_equal([r.numpy() for r in unstack(x, ns)][:2], [[1, 2, 3], [4, 5, 6]])
    x = ns.TensorXf(ns.Float([1, 4, 2, 5, 3, 6]), (3, 2))
    dr.enable_grad(x)
    a, b = unstack(x, ns)
    dr.backward(dr.sum(a * ns.Float([1, 10, 100]) + 2 * b))
    assert np.array_equal(dr.grad(x).numpy(), [[1, 2], [10, 2], [100, 2]])
    dr.enable_grad(rows)
    dr.backward(dr.sum(stack(rows, ns).array * ns.Float(np.arange(24))))
    assert np.array_equal([dr.grad(r).numpy() for r in rows], [[0, 8, 16], [1, 9, 17]])


def test_tensor_products_equal_the_fields_own_evaluation():
    rng = np.random.default_rng(2)
    field = RadianceNetwork.random(TINY, BOX, ns, 0)
    field.set_parameters({"grid.table": ns.Float(rng.normal(size=len(field.grid.table)).astype(np.float32))})
    p = ns.Array3f(rng.uniform(-0.99, 0.99, (3, 200)).astype(np.float32))
    d = dr.normalize(ns.Array3f(rng.normal(size=(3, 200)).astype(np.float32)))
    sigma, rgb = evaluate_samples(TINY, BOX, field.parameters(), p, d, ns)
    expected, features = field.density_features(p)
    assert np.allclose(sigma.numpy(), expected.numpy(), rtol=1e-4)
    assert np.allclose(np.array([c.numpy() for c in rgb]), field.color(features, d).numpy(), atol=1e-5)


def test_a_deferred_field_composites_features_and_colours_rays():
    config, (p, d) = replace(TINY, deferred=True), points()
    made = RadianceNetwork.random(config, BOX, ns, 0)
    sigma, parts = evaluate_samples(config, BOX, made.parameters(), p, d, ns)
    expected, features = made.density_features(p)
    assert np.allclose(sigma.numpy(), expected.numpy(), rtol=1e-4) and len(parts) == TINY.geometry
    assert np.allclose([x.numpy() for x in parts], [x.numpy() for x in features], atol=1e-6)
    opacity = ns.Float(np.linspace(0, 1, 40).astype(np.float32))
    rgb = evaluate_ray_color(config, made.parameters(), [opacity * f for f in features], opacity, d, ns)
    assert np.allclose([c.numpy() for c in rgb], opacity.numpy() * made.color(features, d).numpy(), atol=1e-5)
    assert evaluate_ray_color(TINY, {}, parts, opacity, d, ns) is parts


# ---- Photo colors ----
#
# Photos of one scene with different exposure and white balance: the field learns the average photo.


def numbers(count=3):
    return np.random.default_rng(0).normal(size=12 * count).astype(np.float32)


def test_colors_change_by_a_matrix_and_an_offset_of_each_photo():
    """Compared with NumPy; the mean over the photos is the identity."""
    photos, options = PhotoColors(ns, 3), numbers()
    matrices = photos.compute_matrices(ns.Float(options))
    shifted = 0.01 * (options.reshape(3, 3, 4) - options.reshape(3, 3, 4).mean(axis=0))
    assert np.allclose(matrices, np.eye(3, 4) + shifted, atol=1e-6)
    assert np.allclose(matrices.mean(axis=0), np.eye(3, 4), atol=1e-6)
    color, opacity, frame = np.random.default_rng(1).random((3, 5)), np.linspace(0, 1, 5), [0, 2, 1, 2, 0]
    out = photos.apply(
        photos.compute_changes(ns.Float(options)), [ns.Float(c) for c in color], ns.Float(opacity), ns.UInt32(frame)
    )
    m = matrices[frame]
    expected = np.einsum("nij,jn->in", m[..., :3], color) + m[..., 3].T * opacity
    assert np.allclose(np.array([c.numpy() for c in out]), expected, atol=1e-6)
    assert photos.decay_loss(photos.compute_changes(ns.Float(options)))[0] == pytest.approx(
        np.sum(shifted**2) / 3, rel=1e-5
    )


def test_stops_of_photos_with_twice_and_half_the_light():
    photos, gain = PhotoColors(ns, 2), 2 ** (1 / 2.2)
    # Their mean is the identity: one photo is brighter by as much as the other is darker.
    half = (gain - 1) / (gain + 1)
    options = np.zeros((2, 3, 4), np.float32)
    for k, sign in enumerate((1, -1)):
        options[k, :, :3] = sign * half / 0.01 * np.eye(3)
    assert photos.compute_exposure_spread(ns.Float(options.ravel())) == pytest.approx(0.5, rel=1e-5)


@pytest.mark.nightly
@pytest.mark.slow
def test_exposures_are_recovered():
    """From photos of the same content, so that nothing else explains their differences."""
    gains = np.linspace(0.9, 1.1, 6)[:, None] * (1 + np.random.default_rng(0).uniform(-0.02, 0.02, (6, 3)))
    view, views = ball(ball_pose(np.array([0, -2.0, 0])), depth=False), []
    for gain in gains:
        pixels = view.pixels.copy()
        pixels[..., :3] *= gain.astype(np.float32)
        views.append(replace(view, pixels=np.clip(pixels, 0, 1)))
    trainer = RadianceTrainer(views, BOX, TINY, settings(steps=500, photo_decay=1e-4), ns, depth=False)
    while trainer.progress < 1:
        trainer.step()
    result = trainer.photos.compute_matrices(trainer.averaged[PHOTO_PARAMETER])
    # The corrected mean colour of the ball.
    mean = view.pixels[view.pixels[..., 3] > 0.5][:, :3].mean(axis=0)
    changed = (result[..., :3] @ mean + result[..., 3]) / mean
    assert np.allclose(changed, gains / gains.mean(axis=0), atol=0.005)


def test_a_single_photo_has_no_correction(dataset):
    alone = RadianceTrainer(dataset.train[:1], BOX, TINY, settings(), ns, depth=False)
    without = RadianceTrainer(dataset.train, BOX, TINY, settings(photo_colors=False), ns, depth=False)
    assert alone.photos is None and without.photos is None and PHOTO_PARAMETER not in without.averaged
    alone.step()
    without.step()


def test_the_field_excludes_photo_corrections(dataset):
    trainer = RadianceTrainer(dataset.train, BOX, TINY, settings(), ns, depth=False)
    trainer.step()
    trainer.averaged[PHOTO_PARAMETER] = ns.Float(numbers(len(dataset.train)))
    assert PHOTO_PARAMETER not in trainer.make_field(with_occupancy=False).parameters()
