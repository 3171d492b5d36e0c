"""Tests of `nerg_mi.train.radiance_trainer`."""

from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as ns
import numpy as np
import pytest

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.maths.geometry import Box, ContractedBox
from nerg_mi.photos.cameras import Intrinsics, PosedCamera, pixel_directions
from nerg_mi.photos.dataset import depth_points
from nerg_mi.photos.images import PhotoView
from nerg_mi.photos.observed import ObservedPoints
from nerg_mi.train import radiance_losses, radiance_trainer
from nerg_mi.train.radiance_data import PixelBank
from nerg_mi.train.radiance_losses import (
    color_loss,
    composite,
    depth_loss,
    evaluate_ray_color,
    evaluate_samples,
    feature_decay_gradient,
    surface_loss,
)
from nerg_mi.train.radiance_run import evaluate_views
from nerg_mi.train.radiance_sampling import (
    RussianRoulette,
    StepTable,
    clip_rays,
    damp_near,
    select_visible_samples,
    sum_along_rays,
)
from nerg_mi.train.radiance_settings import (
    MIN_RAYS_TO_REFINE,
    RadianceSettings,
    adapt_ray_count,
    limit_ray_count,
    make_radiance_config,
    refine_stride,
)
from nerg_mi.train.radiance_trainer import RadianceTrainer, render_view

from .ball import BOX, TINY, settings

# ---- The trainer's own pictures against a march in NumPy, pixel by pixel, and PSNR by its definition ----

LENS = Intrinsics(13, 9, 12.0, 12.0, 6.5, 4.5)
STEP, NEAR = 0.1, 0.3


class Lump:
    """A soft ball in a box, brighter to the right, redder towards the camera."""

    box, ns, config = Box((-1, -1, -1), (1, 1, 1)), ns, RadianceConfig()

    def density(self, p, active=True):
        return dr.select(active, 20 * dr.exp(-12 * dr.squared_norm(p)), 0)

    def density_features(self, p):
        return self.density(p), [p.x]

    def color(self, features, d):
        return ns.Array3f(0.5 + 0.4 * features[0], 0.5 - 0.3 * d.x, 0.25)


def view():
    pose = np.eye(4)
    pose[:3, 3] = 0.1, -0.2, 2.5
    return PhotoView("v", PosedCamera(LENS, pose), np.zeros((9, 13, 3), np.uint8))


def expected():
    """Colour, opacity and expected depth of all pixels: steps of the table, shifted by half, of constant density."""
    o = np.array([0.1, -0.2, 2.5])
    d = pixel_directions(LENS).reshape(-1, 3)
    edges = np.arange(0, 45) * STEP + STEP / 2
    t, middle = edges[:-1], edges[:-1] + STEP / 2
    p = o + d[:, None] * middle[:, None]
    sigma = 20 * np.exp(-12 * (p**2).sum(-1)) * (np.abs(p).max(-1) < 1) * (middle > NEAR)
    tau = sigma * STEP
    weight = np.exp(-(np.cumsum(tau, 1) - tau)) * -np.expm1(-tau)
    rgb = np.stack(
        [0.5 + 0.4 * p[..., 0], np.broadcast_to(0.5 - 0.3 * d[:, None, 0], tau.shape), np.full(tau.shape, 0.25)], -1
    )
    small = np.maximum(tau, 1e-9)
    share = np.where(tau > 1e-4, 1 / small - 1 / np.expm1(small), 0.5)
    opacity = weight.sum(1)
    depth = (weight * (t + STEP * share)).sum(1) / np.where(opacity > 0, opacity, 1)
    return (weight[..., None] * rgb).sum(1).reshape(9, 13, 3), opacity.reshape(9, 13), depth.reshape(9, 13)


@pytest.mark.parametrize("chunk", [2**22, 1000])
@pytest.mark.parametrize("every", [1, 2, 3])
def test_pictures(every, chunk, monkeypatch):
    monkeypatch.setattr(radiance_trainer, "_CHUNK", chunk)
    table = StepTable(ns, 0.0, 4.4, STEP, 0.0)
    seen = render_view(Lump(), lambda p, active: active, table, view(), NEAR, every=every, min_transmittance=0.0)
    color, opacity, depth = (v[every // 2 :: every, every // 2 :: every] for v in expected())
    assert seen.color.shape == color.shape and np.allclose(seen.color, color, atol=2e-5)
    assert np.allclose(seen.opacity, opacity, atol=2e-5) and 0.8 < opacity.max()
    assert np.allclose(seen.depth[opacity > 0.01], depth[opacity > 0.01], rtol=1e-4)


def test_a_deferred_field_has_the_colour_of_its_mean_features():
    """For a colour that is linear in the features this is the mean of colours."""
    lump = Lump()
    lump.config = RadianceConfig(deferred=True)
    table, anywhere = StepTable(ns, 0.0, 4.4, STEP, 0.0), lambda p, active: active
    seen = render_view(lump, anywhere, table, view(), NEAR, min_transmittance=0.0)
    assert np.allclose(seen.color, expected()[0], atol=2e-5)
    lump.color = lambda features, d: ns.Array3f(dr.square(features[0]))
    squares = render_view(
        lump, lambda p, a: a, StepTable(ns, 0.0, 4.4, STEP, 0.0), view(), NEAR, min_transmittance=0.0
    ).color[..., 0]
    opacity = expected()[1]
    mean = (expected()[0][..., 0] - 0.5 * opacity) / 0.4 / np.where(opacity > 0, opacity, 1)
    assert np.allclose(squares, opacity * mean**2, atol=2e-5)


def test_empty_cells_and_empty_pictures():
    table = StepTable(ns, 0.0, 4.4, STEP, 0.0)
    seen = render_view(Lump(), lambda p, active: active & False, table, view(), NEAR)
    assert not seen.color.any() and not seen.opacity.any() and not seen.depth.any() and seen.color.shape == (9, 13, 3)


# ---- The radiance trainer on a tiny scene: reproducibility, and correct gradients ----

DEFERRED = replace(TINY, deferred=True)


@pytest.mark.parametrize("average", [0.0, 0.5, 0.999])
def test_result_is_the_average_of_every_fourth_step(dataset, average):
    """Exponential average with a short memory at first: (k + 1) / (k + 10) per step after k steps, at most
    ``average``."""
    trainer = RadianceTrainer(dataset.train, BOX, TINY, settings(ema_decay=average), ns)
    expected = {k: v.numpy().astype(float) for k, v in trainer.optimiser.items()}
    for k in range(1, 13):
        trainer.step()
        memory = min(average, (k + 1) / (k + 10)) ** 4
        if k % 4 == 0:
            for name, value in trainer.optimiser.items():
                expected[name] = memory * expected[name] + (1 - memory) * value.numpy()
    for name, value in trainer.averaged.items():
        assert np.allclose(value.numpy(), expected[name], atol=1e-6)
    assert average == 0 or np.abs(expected["density_net.0"] - trainer.optimiser["density_net.0"].numpy()).max() > 1e-4


@pytest.mark.parametrize("config", [TINY, DEFERRED])
def test_gradient_of_the_whole_loss_agrees_with_finite_differences(dataset, config):
    """Fixed samples, all loss terms, a direction through all weights: central differences to 1 %."""
    rng = np.random.default_rng(6)
    field = RadianceNetwork.random(config, BOX, ns, 0)
    table = rng.normal(size=len(field.grid.table)).astype(np.float32)
    field.set_parameters({"grid.table": ns.Float(table)})
    pixels = PixelBank(ns, dataset.train).gather_batch(ns.UInt32(rng.integers(0, 24 * 24, 64).astype(np.uint32)))
    rays = clip_rays(pixels.o, pixels.d, BOX, 0.01)
    offset = ns.Float(rng.random(64).astype(np.float32))
    background = ns.Array3f(rng.random((3, 64)).astype(np.float32))
    with dr.suspend_grad():
        samples, covered = select_visible_samples(
            rays, StepTable(ns, 0.01, 4, 0.03, 0), offset, lambda p, a: a, field.density, 2e-3, pad=2**13
        )
    assert covered == 64
    start = {k: dr.detach(v) for k, v in field.parameters().items()}

    def loss(parameters):
        d = dr.gather(ns.Array3f, pixels.d, samples.ray)
        sigma, parts = evaluate_samples(config, BOX, parameters, samples.p, d, ns)
        weight, tau, sums, opacity = composite(sigma, parts, samples)
        color = evaluate_ray_color(config, parameters, sums, opacity, pixels.d, ns)
        terms = color_loss(color, opacity, pixels, background, 0.1)
        terms += 0.1 * depth_loss(weight, tau, samples, pixels.depth, 0.1, 0.1)
        return dr.sum(ns.Float64(terms))

    parameters = {k: type(v)(v) for k, v in start.items()}
    dr.enable_grad(parameters)
    dr.backward(loss(parameters))
    # Along the signs of the gradient the terms of the slope do not cancel.
    direction = {
        k: type(v)(dr.sign(dr.grad(v))) * type(v)(rng.random(v.shape).astype(np.float32)) for k, v in parameters.items()
    }
    slope = sum(float(np.sum(dr.grad(parameters[k]).numpy() * direction[k].numpy())) for k in parameters)
    h = 3e-4
    up, down = (loss({k: v + s * h * direction[k] for k, v in start.items()}).numpy()[0] for s in (1, -1))
    assert slope == pytest.approx((up - down) / (2 * h), rel=0.01)


@pytest.mark.parametrize("depth", [True, False])
def test_recorded_kernels_have_the_gradients_of_traced_ones(dataset, depth):
    views = dataset.train if depth else [with_points(v) for v in dataset.train]
    trainer = RadianceTrainer(views, BOX, TINY, settings(steps=12, strides=(2,)), ns, depth)
    recorded, rays = trainer._compute_gradients, set()

    def compare(weights, inputs):
        loss, depth_errors, gradients = recorded(weights, inputs)
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
            traced = recorded(weights, inputs)
        assert float(loss[0]) == pytest.approx(float(traced[0][0]), rel=1e-4)
        if depth:
            assert np.allclose(depth_errors.numpy(), traced[1].numpy(), rtol=1e-4, atol=1e-6)
        for name, gradient in gradients.items():
            expected = traced[2][name].numpy()
            assert np.allclose(gradient.numpy(), expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max()), name
        rays.add(dr.width(inputs.pixels.d))
        return loss, depth_errors, gradients

    trainer._compute_gradients = compare
    for _ in range(12):
        trainer.step()
    assert trainer.steps == 12 and len(rays) > 2 and recorded.n_recordings < 6


@pytest.mark.nightly
def test_a_deferred_field_learns_the_same_pictures(dataset):
    """As well as a field that evaluates colour at each sample; it is stored, evaluated and rendered."""
    errors = []
    for config in (TINY, DEFERRED):
        trainer = RadianceTrainer(dataset.train, BOX, config, settings(steps=150), ns)
        while trainer.progress < 1:
            trainer.step()
        field = trainer.make_field()
        assert field.config == config
        errors.append(evaluate_views(trainer, dataset.held_out, field=field).mean)
    assert min(errors) > 22 and errors[1] > errors[0] - 1.5, errors


def test_russian_roulette_is_unbiased():
    """Averaged over many decisions, opacity is exact, colours (a ratio) nearly and derivatives exactly those of all
    samples.
    """
    rng = np.random.default_rng(8)
    o = ns.Array3f(np.tile([[0.0], [0.0], [-2.0]], 16).astype(np.float32))
    d = dr.normalize(
        ns.Array3f(*[ns.Float(rng.normal(size=16).astype(np.float32) * 0.3) for _ in range(2)], ns.Float(np.ones(16)))
    )
    rays, table = clip_rays(o, d, BOX, 0.01), StepTable(ns, 0.01, 4, 0.03, 0)
    offset, per_ray = ns.Float(rng.random(16).astype(np.float32)), ns.Float(rng.normal(size=16).astype(np.float32))
    density = lambda p, active=True: 0.3 + 20 * dr.exp(-40 * dr.square(p.z - 0.3 * p.x))

    def render(thinning):
        samples, _ = select_visible_samples(rays, table, offset, lambda p, a: a, density, 1e-9, roulette=thinning)
        gain = ns.Float(1)
        dr.enable_grad(gain)
        rgb = [0.5 + 0.4 * dr.sin(4 * samples.p.z + k) for k in range(3)]
        weight, _, color, opacity = composite(gain * density(samples.p), rgb, samples)
        plain = sum(sum_along_rays(weight * c, samples.segments) for c in rgb)
        dr.backward(dr.sum((plain + opacity) * per_ray))
        return (samples.count, np.array([c.numpy() for c in color]), opacity.numpy(), dr.grad(gain).numpy()[0])

    count, color, opacity, slope = render(None)
    result = [render(RussianRoulette(1 / 16, 1 / 32, k)) for k in range(400)]
    assert max(f[0] for f in result) < 0.5 * count
    for f in result[::40]:
        assert np.allclose(f[2], opacity, atol=1e-6)
    assert np.allclose(np.mean([f[1] for f in result], 0), color, atol=0.03)
    slopes = [f[3] for f in result]
    assert abs(np.mean(slopes) - slope) < 4 * np.std(slopes) / 20 and np.std(slopes) > 0


def test_damping_near_cameras(dataset):
    """Derivatives within the distance are scaled by its square, values do not change; a step of the trainer follows."""
    t, x = ns.Float([0.1, 0.2, 0.4, 3]), ns.Float([1, 2, 3, 4])
    dr.enable_grad(x)
    (y,) = damp_near([x], t, 0.4)
    dr.backward(dr.sum(2 * y))
    assert np.array_equal(y.numpy(), x.numpy()) and np.allclose(dr.grad(x).numpy(), [2 / 16, 2 / 4, 2, 2])

    def first_step(views, **changes):
        # All samples are within a distance of a thousand sides: no gradient of the pictures reaches the weights.
        trainer = RadianceTrainer(
            views, BOX, TINY, settings(empty_weight=0.0, photo_colors=False, **changes), ns, False
        )
        trainer.step()
        return max(np.abs(state[3][1].numpy()).max() for state in trainer.optimiser.state.values())

    assert first_step(dataset.train, damping_distance=1000.0) < 1e-4 * first_step(dataset.train, damping_distance=0.0)
    # For cameras without depth that look at a common point, their distance from it limits that of the scaling.
    views = [replace(view, depth=None) for view in dataset.train]
    limited = first_step(views, damping_distance=1000.0)
    assert limited > 0.1 * first_step(views, damping_distance=0.0)
    assert first_step(views, damping_distance=1000.0, max_focus_damping=1e5) < 1e-4 * limited


def test_a_box_outside_all_views_is_refused(dataset):
    with pytest.raises(ValueError, match="aabb"):
        RadianceTrainer(dataset.train, Box((50, 50, 50), (51, 51, 51)), TINY, settings(), ns)


def test_unused_features_decay(dataset):
    assert np.allclose(feature_decay_gradient(ns.Float([1, -2, 0, 4]), 2.0).numpy(), [1, -2, 0, 4])
    tensor = ns.TensorXf(ns.Float([1, -2, 0, 4]), (2, 2))
    assert np.allclose(feature_decay_gradient(tensor, 1.0).numpy(), [[0.5, -1], [0, 2]])

    def left(weight):
        # Within a distance of a thousand sides: no gradient of the pictures reaches the features.
        trainer = RadianceTrainer(
            dataset.train,
            BOX,
            TINY,
            settings(damping_distance=1000.0, empty_weight=0.0, grid_decay=weight),
            ns,
            depth=False,
        )
        trainer.optimiser["grid.table"] = dr.full(ns.Float, 0.5, len(trainer.current_field.parameters()["grid.table"]))
        for _ in range(10):
            trainer.step()
        return float(dr.mean(dr.abs(trainer.optimiser["grid.table"]))[0])

    assert left(0.1) < 0.4 < left(0.0)
    with pytest.raises(ValueError, match="grid_decay must lie in"):
        settings(grid_decay=-1.0)


@pytest.mark.parametrize("depth", [True, False])
def test_free_space_is_carved_with_full_depth(dataset, depth):
    """Cells far in front of the surface are then empty from the start; without depth they are unknown."""
    views = [replace(v, depth=np.where(v.depth > 0, v.depth, 9).astype(np.float32)) for v in dataset.train]
    trainer = RadianceTrainer(views, BOX, TINY, settings(), ns, depth=depth)
    assert trainer.is_carved == depth and trainer.pixels.has_full_depth
    # Between the cameras and the ball: at least four cells in front of its surface.
    p = dr.normalize(ns.Array3f(*np.random.default_rng(0).normal(size=(3, 500)).astype(np.float32))) * 0.9
    seen = trainer.grid.is_occupied(p, dr.full(ns.Bool, True, 500)).numpy()
    assert (seen.mean() < 0.2) == depth
    if depth:
        num_cells, trainer.steps = trainer.grid.seen_count, int(0.9 * trainer.settings.steps)
        trainer.step()
        assert trainer.grid.seen_count == num_cells


@pytest.mark.parametrize("use_points", [True, False])
def test_space_near_cameras_is_empty_at_first(dataset, use_points):
    """In the last part of a run, also of a resumed one, density is allowed there, and rays start near the camera."""
    views = [with_points(v) if use_points else replace(v, depth=None) for v in dataset.train]
    options = settings(
        steps=100, free_space_end=0.3, clear_fraction=0.9, surrounding_fraction=0.0 if use_points else 0.35
    )
    reference = RadianceTrainer(views, BOX, TINY, replace(options, clear_fraction=0.0, surrounding_fraction=0.0), ns)
    trainer, resumed = (RadianceTrainer(views, BOX, TINY, options, ns) for _ in range(2))
    starts = dr.min(trainer._ray_starts)[0]
    assert starts > 1.5 * dr.max(reference._ray_starts)[0] and trainer.grid.seen_count < reference.grid.seen_count
    trainer.steps = 29
    trainer.step()
    assert dr.min(trainer._ray_starts)[0] == starts and trainer.grid.seen_count < reference.grid.seen_count
    trainer.step()
    resumed.restore(*trainer.get_state())
    resumed.step()
    for other in (trainer, resumed):
        assert dr.all(other._ray_starts == reference._ray_starts) and dr.all(other.grid.seen == reference.grid.seen)


def test_depth_weight_decays(dataset, monkeypatch):
    """The loss of depth alone, one per ray: its weight, which decreases over the run."""
    monkeypatch.setattr(radiance_losses, "color_loss", lambda *options: 0 * color_loss(*options))
    monkeypatch.setattr(radiance_losses, "depth_loss", lambda *options: 0 * depth_loss(*options) + 1)
    for steps in (0, 49, 99):
        options = settings(steps=100, depth_weight=0.3, depth_weight_final_ratio=0.04, distortion_weight=0.0)
        trainer = RadianceTrainer(dataset.train, BOX, TINY, options, ns)
        trainer.steps = steps
        trainer.step()
        assert float(trainer.loss[0]) == pytest.approx(0.3 * 0.04 ** ((steps + 1) / 100), rel=1e-4)


def with_points(view):
    """``view`` without depth, with its surface as points of a reconstruction that are off by a thousandth."""
    points = depth_points(view.camera, view.depth, 200)
    return replace(view, depth=None, points=ObservedPoints(points, np.full(len(points), 1e-3)))


def test_point_weight_decays(dataset, monkeypatch):
    """The loss of points alone, one per ray: its weight over the fraction of the rays that have a point."""
    monkeypatch.setattr(radiance_losses, "color_loss", lambda *options: 0 * color_loss(*options))
    monkeypatch.setattr(radiance_losses, "surface_loss", lambda *options: 0 * surface_loss(*options) + 1)
    views = [with_points(v) for v in dataset.train]
    for steps in (0, 49, 99):
        options = settings(steps=100, point_weight=0.3, point_weight_final_ratio=0.04, point_fraction=0.25)
        trainer = RadianceTrainer(views, BOX, TINY, options, ns)
        trainer.steps = steps
        trainer.step()
        assert float(trainer.loss[0]) == pytest.approx(0.3 * 0.04 ** ((steps + 1) / 100) / 0.25, rel=1e-4)
    assert not RadianceTrainer(dataset.train, BOX, TINY, settings(), ns).use_points


def test_points_place_the_surface(dataset):
    """With the same steps, the expected depth on held-out views is better with points than without."""
    errors = {}
    for weight in (0.0, 0.1):
        options = settings(steps=60, point_weight=weight, clear_fraction=0.0, surrounding_fraction=0.0)
        trainer = RadianceTrainer([with_points(v) for v in dataset.train], BOX, TINY, options, ns)
        while trainer.progress < 1:
            trainer.step()
        field = trainer.make_field()
        pairs = [(trainer.render(v, 1, field), v.depth) for v in dataset.held_out]
        errors[weight] = np.mean([np.abs(r.depth - d)[d > 0].mean() for r, d in pairs])
    assert errors[0.1] < 0.7 * errors[0.0]


def test_incomplete_rays_do_not_count(dataset, monkeypatch):
    """With a loss of 1 per ray the mean over complete rays is 1."""
    from nerg_mi.train import radiance_trainer as module

    monkeypatch.setattr(radiance_losses, "color_loss", lambda _, opacity, *rest: dr.ones(ns.Float, dr.width(opacity)))
    trainer = RadianceTrainer(dataset.train, BOX, TINY, settings(batch=2**10), ns, depth=False)
    trainer.rays, seen = 2**10, []
    visible = module.select_visible_samples
    monkeypatch.setattr(
        module,
        "select_visible_samples",
        lambda rays, *a, **k: seen.append((rays.count, visible(rays, *a, **k))) or seen[-1][1],
    )
    trainer.step()
    count, (_, covered) = seen[0]
    assert 0 < covered < count and trainer.loss.numpy()[0] == pytest.approx(1, rel=1e-5)


# ---- The number of rays per step follows the number of samples, within limits ----

STRIDES = (16, 8, 4, 2)


def test_ray_count_fills_the_batch_or_the_density_pass():
    # halfway to 0.95 * 1600
    assert (
        adapt_ray_count(1000, samples_per_ray=10, prepass_samples_per_ray=20, batch=16000, max_prepass_samples=128000)
        == 1260
    )
    # halfway to 0.95 * 1280
    assert (
        adapt_ray_count(1000, samples_per_ray=10, prepass_samples_per_ray=100, batch=16000, max_prepass_samples=128000)
        == 1108
    )
    rays = 1000
    for _ in range(40):
        rays = adapt_ray_count(
            rays, samples_per_ray=2, prepass_samples_per_ray=300, batch=16000, max_prepass_samples=128000
        )
    assert rays * 300 <= 0.95 * 128000 < (rays + 2) * 300


def test_ray_count_changes_at_most_by_a_factor_of_two():
    assert (
        adapt_ray_count(1000, samples_per_ray=0, prepass_samples_per_ray=0, batch=16000, max_prepass_samples=128000)
        == 2000
    )
    assert (
        adapt_ray_count(1000, samples_per_ray=1e6, prepass_samples_per_ray=1e6, batch=16000, max_prepass_samples=128000)
        == 500
    )
    assert (
        adapt_ray_count(2**14, samples_per_ray=0, prepass_samples_per_ray=0, batch=16000, max_prepass_samples=128000)
        == 2**14
    )
    assert (
        adapt_ray_count(64, samples_per_ray=1e6, prepass_samples_per_ray=1e6, batch=16000, max_prepass_samples=128000)
        == 64
    )


@pytest.mark.parametrize(
    "rays, looked, steps, expected",
    [
        (500, 100, 340, 500),
        (5000, 100, 340, 1216),  # limited by the density pass
        (5000, 1, 3400, 617),  # limited by the steps
        (5000, 0, 10**9, 1),
    ],
)
def test_ray_count_is_limited(rays, looked, steps, expected):
    assert limit_ray_count(rays, looked, steps, max_prepass_samples=128000, max_candidates=2_100_000) == expected


def test_stride_is_refined_on_schedule():
    assert refine_stride(16, STRIDES, 16, 1, 128000) == 16
    assert refine_stride(16, STRIDES, 8, 1, 128000) == 8
    assert refine_stride(16, STRIDES, 1, 1, 128000) == 8
    assert refine_stride(2, STRIDES, 1, 1, 128000) == 1
    assert refine_stride(1, STRIDES, 1, 1, 128000) == 1
    # Never coarser again.
    assert refine_stride(2, STRIDES, 4, 1, 128000) == 2
    assert refine_stride(4, (), 1, 1, 128000) == 1


def test_stride_refinement_waits_for_clearing():
    limit = 128000
    fits = limit / MIN_RAYS_TO_REFINE / 2  # samples per ray; the finer stride has twice as many
    assert refine_stride(8, STRIDES, 1, 0.99 * fits, limit) == 4
    assert refine_stride(8, STRIDES, 1, 1.01 * fits, limit) == 8
    assert refine_stride(8, STRIDES, 1, 1.01 * fits, limit, wait_for_clearing=False) == 4
    # From 16 to 1 there are sixteen times as many.
    assert refine_stride(16, (16,), 1, 0.99 * fits, limit) == 16
    assert refine_stride(16, (16,), 1, 0.99 * fits / 8, limit) == 1


# ---- Settings of a radiance training: sizes, schedules, and refused values ----


def test_settings_and_sizes_are_checked():
    for wrong in (
        {},
        {"steps": 5, "minutes": 1.0},
        {"steps": 0},
        {"steps": 5, "resolution": 100},
        {"steps": 5, "rr_min_probability": 0},
        {"steps": 5, "damping_fraction": 0},
    ):
        with pytest.raises(ValueError):
            RadianceSettings(**wrong)
    with pytest.raises(ValueError, match="small, medium, paper"):
        make_radiance_config("huge", BOX)
    assert make_radiance_config("paper", BOX).grid.log2_rows == 19


def test_damping_near_cameras_ends():
    s = RadianceSettings(steps=5, damping_fraction=0.5)
    assert [s.damping_factor_at(p) for p in (0, 0.25, 0.5, 1)] == pytest.approx([1, 0.5, 0, 0])


def test_a_size_is_a_grid_and_a_contracted_box_has_one_twice_as_fine():
    """The inner cube takes half of each edge."""
    small = make_radiance_config("small", BOX)
    assert small.grid == HashGridConfig(levels=8, log2_rows=16, base=32, finest=512) and small.density_scale == 0.5  # noqa: RUF069 (stored)
    around = make_radiance_config("small", ContractedBox(BOX))
    assert around.grid == HashGridConfig(levels=8, log2_rows=16, base=64, finest=1024)
    assert around.density_scale == small.density_scale
