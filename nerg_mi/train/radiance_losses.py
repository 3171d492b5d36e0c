"""Radiance field in training: its forward pass, its losses, and per-photo colour corrections."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any, cast

import drjit as dr
import numpy as np

from nerg_mi.fields.encoding import HashGrid, encode_direction
from nerg_mi.fields.mlp import MLP, stack, unstack
from nerg_mi.fields.radiance import (
    RadianceConfig,
    color_network_inputs,
    decode_color,
    density_from_log,
    mean_features,
    point_features,
)
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Array3f, Float, UInt32
from nerg_mi.transport.jit import gc_paused
from nerg_mi.transport.quadrature import mean_depth_fraction

from .radiance_data import PixelBatch
from .radiance_sampling import RaySamples, compute_weights, damp_near, sum_along_rays
from .radiance_settings import RadianceSettings

# ---- Losses of ray colours and depths ----


def huber_loss(error, delta: float):
    """Huber's loss, quadratic below ``delta`` and linear above, with unit curvature at 0."""
    size = dr.abs(error)
    return dr.select(size < delta, 0.5 * size * size, delta * (size - 0.5 * delta))


def color_loss(color, opacity, pixels: PixelBatch, background, delta: float):
    """Mean Huber loss per ray (Float) of composited ``color`` (3 Floats) over a random ``background`` (Array3f).

    The background shows through transparent parts of the prediction and, by its alpha, of the picture. This penalises
    holes in opaque surfaces.
    """
    loss = 0
    for k in range(3):
        target = pixels.rgb[k]
        if pixels.alpha is not None:
            target = dr.lerp(background[k], target, pixels.alpha)
        loss += huber_loss(color[k] + (1 - opacity) * background[k] - target, delta)
    return loss / 3


def depth_loss(weight: Float, tau: Float, samples: RaySamples, depth: Float, margin: float | Float, scale: Float):
    """Loss per ray of the absorbed light relative to the true ``depth`` (as in `PixelBatch`); 0 where the depth is
    unknown.

    Parameters
    ----------
    weight, tau : Float
        Weights and optical depths of the samples.
    samples : RaySamples
        Samples of the rays.
    depth : Float
        True depth per ray, 0 where unknown.
    margin : float or Float
        Distance from the true surface, in scene units, within which light should be absorbed.
    scale : Float
        Unit of the distance term, one value or one per ray.

    Notes
    -----
    The first term is the fraction of the light that is not absorbed within ``margin`` of the true surface, or within
    the step that holds it (line-of-sight supervision, Rematas et al. 2022, with a box in place of the Gaussian). It
    prevents fog, holes and floaters. The second term is the distance of the expected depth from the true depth, which
    places the surface within the step.
    """
    s = samples.segments
    truth, near = _find_near_samples(samples, depth, margin)
    # Only absorption near the surface is moved: a floater should vanish, not drag the surface along.
    offset = samples.t + samples.length * mean_depth_fraction(tau) - truth
    shift = sum_along_rays(dr.select(near, weight * offset, 0), s)
    return dr.select(depth > 0, surface_loss(weight, samples, depth, margin) + dr.minimum(dr.abs(shift) / scale, 10), 0)


def surface_loss(weight: Float, samples: RaySamples, depth: Float, margin: float | Float) -> Float:
    """Fraction of the light of each ray that is not absorbed near its true ``depth``; 0 where the depth is unknown.

    Parameters
    ----------
    weight, samples, depth, margin
        As for `depth_loss`.
    """
    _, near = _find_near_samples(samples, depth, margin)
    return dr.select(depth > 0, 1 - sum_along_rays(dr.select(near, weight, 0), samples.segments), 0)


def _find_near_samples(samples: RaySamples, depth: Float, margin: float | Float) -> tuple[Float, Any]:
    """Return the true depth of each sample's ray, and the mask of the samples that reach within ``margin`` of it."""
    s = samples.segments
    truth = dr.gather(type(depth), depth, s.ray, s.active)
    if not isinstance(margin, float):
        margin = dr.gather(type(depth), margin, s.ray, s.active)
    return truth, (samples.t < truth + margin) & (samples.t + samples.length > truth - margin)


def feature_decay_gradient(features, weight: float):
    """Gradient of ``weight`` times the mean square of the ``features`` of a grid.

    Features seen by many rays hardly change, because each has a share of one in millions. Features shaped by few rays
    or by chance decay to 0; Adam would otherwise move them as much as all others.
    """
    return features * (2 * weight / int(np.prod(features.shape)))


def distortion_loss(weight, samples: RaySamples, scale: float):
    """Distortion loss per ray, which concentrates its weight: Σ_ij w_i w_j |m_i - m_j| + Σ_i w_i² δ_i / 3.

    m are midpoints and δ lengths of the samples in units of ``scale`` (Barron et al. 2022, mip-NeRF 360, eq. 15;
    evaluated in O(n) for sorted samples). Sample positions have no derivative. Russian-roulette samples count as single
    samples, which makes the second term too large by 1/p each.
    """
    length = samples.length / scale
    return sum_along_rays(
        dr.custom(_Distortion, weight, samples.t / scale + 0.5 * length, length, samples.segments), samples.segments
    )


class _Distortion(dr.CustomOp):
    """Distortion per sample: 2 w_i (m_i Σ_{j<i} w_j - Σ_{j<i} w_j m_j) + w_i² δ_i / 3."""

    def eval(self, weight, middle, length, segments):
        Float = type(weight)
        self.weight, self.length, self.segments = weight, length, segments
        # Relative to the first sample of the ray, so that the two sums have similar size and cancel accurately.
        start = dr.gather(Float, middle, dr.gather(type(segments.ray), segments.start, segments.ray, segments.active))
        self.middle = dr.select(segments.active, middle - start, 0)
        return Float(2 * weight * self._before(weight)) + weight * weight * length / 3

    def _before(self, x):
        moment = x * self.middle
        return self.middle * self.segments.before(x) - self.segments.before(moment)

    def forward(self):
        g: Any = self.grad_in("weight")
        w, kind = self.weight, type(g)
        self.set_grad_out(kind(2 * (g * self._before(w) + w * self._before(g))) + 2 * w * g * self.length / 3)

    def backward(self):
        g: Any = self.grad_out()
        w, kind = self.weight, type(g)
        a = g * w
        later = self.segments.after(a * self.middle) - self.middle * self.segments.after(a)
        self.set_grad_in("weight", kind(2 * (g * self._before(w) + later)) + 2 * g * w * self.length / 3)

    def name(self):
        return "distortion of a ray"


def composite(sigma: Float, parts: list, samples: RaySamples) -> tuple[Float, Float, list[Float], Float]:
    """Composite samples along rays.

    Returns the weights, the optical depths, the sums of the ``parts`` (colours, usually) and the opacity of each ray.

    Notes
    -----
    With Russian roulette the opacity is that of all samples, and a sum is the mean of the survivors times it, so that
    neither has the noise of the sum of weights. Derivatives are those of the plain sums, which are unbiased.
    """
    s, thinned = samples.segments, samples.thinned
    tau = dr.select(s.active, sigma * samples.length, 0)
    weight = compute_weights(tau, s, thinned)
    sums, opacity = [sum_along_rays(weight * x, s) for x in parts], sum_along_rays(weight, s)
    if thinned is not None:
        scale = dr.detach(thinned.opacity / dr.maximum(opacity, 1e-6))
        sums = [cast("Float", dr.replace_grad(x * scale, x)) for x in sums]
        opacity = cast("Float", dr.replace_grad(thinned.opacity, opacity))
    return weight, tau, sums, opacity


# ---- Forward pass with the networks as tensor products, which trains fastest ----


def evaluate_samples(config: RadianceConfig, box: AnyBox, parameters: dict, p, d, ns, features: list | None = None):
    """Evaluate density and composited quantities at samples; the same model as ``RadianceNetwork.density_features`` and
    ``color``.

    Parameters
    ----------
    config : RadianceConfig
        Configuration of the field.
    box : AnyBox
        Bounds of the field; must contain ``p``.
    parameters : dict
        Parameter arrays by their names in the field. Gradients reach every entry.
    p, d : Array3f
        World points and ray directions.
    ns : module
        Dr.Jit backend.
    features : list of Float, optional
        Output of the grid at ``p``, if already evaluated.

    Returns
    -------
    sigma : Float
        Density in 1/unit.
    parts : list of Float
        Colour (3 Floats in 0..1), or for a deferred field the features for `evaluate_ray_color`.
    """
    h = unstack(
        _make_network(parameters, "density_net").tensor(_evaluate_features(config, box, parameters, p, ns, features)),
        ns,
    )
    sigma = box.density_from_encoded(density_from_log(h[0], config.density_scale), p)
    features = point_features(h[1:], config.deferred)
    return sigma, features if config.deferred else _evaluate_color(config, parameters, features, d, ns)


def evaluate_ray_color(config: RadianceConfig, parameters: dict, sums: list, opacity, d, ns) -> list:
    """Return the colour (3 Floats, times opacity) of rays along ``d`` from the composited ``sums`` of
    `evaluate_samples`.
    """
    if not config.deferred:
        return sums
    return [opacity * c for c in _evaluate_color(config, parameters, mean_features(sums, opacity), d, ns)]


def _evaluate_color(config: RadianceConfig, parameters: dict, features: list, d, ns) -> list:
    inputs = color_network_inputs(features, config.deferred)
    c = _make_network(parameters, "color_net").tensor(stack(encode_direction(d, config.sh_degree) + inputs, ns))
    return decode_color(unstack(c, ns), inputs, config.deferred)


def evaluate_density(config: RadianceConfig, box: AnyBox, parameters: dict, p, ns):
    """Evaluate the density (1/unit) at world points ``p`` in ``box``; see `evaluate_samples`."""
    head = _make_density_head(parameters)
    log_density = head.tensor(_evaluate_features(config, box, parameters, p, ns)).array
    return box.density_from_encoded(density_from_log(log_density, config.density_scale), p)


def make_density_prepass(config: RadianceConfig, box: AnyBox) -> Callable[..., tuple[Float, list[Float]]]:
    """Return a function of detached parameters, world points and a mask, which evaluates the density (1/unit) and the
    grid features, for `evaluate_samples`.

    Dr.Jit records its kernels once; to trace them for each batch takes as long as the networks.
    """

    @dr.freeze
    def evaluate(parameters: dict, head: MLP, p: Array3f, active) -> tuple[Float, list[Float]]:
        with gc_paused():
            features = HashGrid.from_parameters(config.grid, parameters).evaluate_eagerly(box.to_unit(p), active)
            return box.density_from_encoded(density_from_log(head(features)[0], config.density_scale), p), features

    def prepass(parameters: dict, p: Array3f, active) -> tuple[Float, list[Float]]:
        head = _make_density_head(parameters)
        head.pack()  # Dr.Jit cannot record this
        return evaluate({k: v for k, v in parameters.items() if k.startswith("grid.")}, head, p, active)

    return prepass


def _make_density_head(parameters: dict) -> MLP:
    net = _make_network(parameters, "density_net")
    return MLP(net.weights[:-1] + [net.weights[-1][0:1, :]])


def _evaluate_features(config: RadianceConfig, box: AnyBox, parameters: dict, p, ns, features: list | None = None):
    grid, p = HashGrid.from_parameters(config.grid, parameters, mode=dr.ReduceMode.Expand), box.to_unit(p)
    if features is None:
        with dr.suspend_grad():
            features = grid.evaluate_eagerly(p)
    return stack(grid.attach(features, p), ns)


def _make_network(parameters: dict, name: str) -> MLP:
    count = sum(k.startswith(name + ".") for k in parameters)
    return MLP([parameters[f"{name}.{i}"] for i in range(count)])


# ---- Per-photo colour corrections ----
#
# Each photo has its own exposure and white balance.
#
# A photo shows A c + b of a scene colour c in sRGB, with its own matrix A (3, 3) and offset b (Rematas et al. 2022,
# Urban Radiance Fields, sec. 4.1, where they are decoded from a latent code). Their mean over the photos is the
# identity, so that the scene has the colours of the average photo.

PHOTO_PARAMETER = "photos"  # Name of the parameter in the optimiser
# Scale of the parameter: an optimiser step of the size of the learning rate is large for a colour.
_UNIT = 0.01
_GREY = 0.5


class PhotoColors:
    """Affine colour corrections of ``frames`` photos, 12 numbers each, optimised as the parameter `PHOTO_PARAMETER`."""

    def __init__(self, ns, frames: int):
        self.ns, self.frames = ns, frames

    def init_parameter(self) -> Float:
        """Return the parameter of identity corrections."""
        return dr.zeros(self.ns.Float, 12 * self.frames)

    def compute_changes(self, parameter: Float) -> Float:
        """Return the entries of [A - 1 | b], photo by photo and row by row."""
        ns, each = self.ns, dr.arange(self.ns.UInt32, 12 * self.frames) % 12
        mean = dr.zeros(ns.Float, 12)
        dr.scatter_add(mean, parameter / self.frames, each)
        return _UNIT * (parameter - dr.gather(ns.Float, mean, each))

    def apply(self, changes: Float, color: list[Float], opacity: Float, frame: UInt32) -> list[Float]:
        """Apply the corrections of photos ``frame`` to ``color`` (3 Floats), composited with ``opacity``."""
        rows = [dr.gather(self.ns.Array4f, changes, 3 * frame + k) for k in range(3)]
        return [c + r[0] * color[0] + r[1] * color[1] + r[2] * color[2] + r[3] * opacity for c, r in zip(color, rows)]

    def decay_loss(self, changes: Float) -> Float:
        """Return the mean over the photos of the squared norm of their ``changes``."""
        return dr.sum(dr.square(changes)) / self.frames

    def compute_exposure_spread(self, parameter: Float) -> float:
        """Return the standard deviation of the photos' exposure in f-stops, measured on a middle grey.

        A stop doubles the light, which multiplies sRGB values of middle greys by about 2^(1/2.2).
        """
        m = self.compute_matrices(parameter)
        grey = (m[..., :3].sum(axis=-1) * _GREY + m[..., 3]).mean(axis=-1) / _GREY
        return float(2.2 * np.std(np.log2(np.maximum(grey, 1e-3))))

    def compute_matrices(self, parameter: Float) -> np.ndarray:
        """Return [A | b] of each photo, (frames, 3, 4)."""
        return np.eye(3, 4) + self.compute_changes(parameter).numpy().reshape(-1, 3, 4)


# ---- Loss of a step, and its gradients ----


@dataclass
class LossInputs:
    """Inputs of the loss that change from step to step. Numbers are arrays of one entry, because `TrainingLoss` is
    recorded.

    Attributes
    ----------
    samples : RaySamples
        Samples of the rays.
    pixels : PixelBatch
        Pixels of the rays.
    background : Array3f
        Random background per ray.
    covered : UInt32
        Number of leading rays that are covered completely.
    stride : Float
        March stride.
    damping_distance : Float
        Distance of `damp_near` in scene units.
    depth_weight, point_weight : Float
        Weights of the losses of depth and of points.
    point_depth : tuple of Float, optional
        Distance of each ray's point, 0 for other rays, and its standard error.
    empty_points : Array3f, optional
        World points in cells that are not sampled.
    """

    samples: RaySamples
    pixels: PixelBatch
    background: Array3f
    covered: UInt32
    stride: Float
    damping_distance: Float
    depth_weight: Float
    point_weight: Float
    point_depth: tuple[Float, Float] | None
    empty_points: Array3f | None


@dataclass(frozen=True)
class TrainingLoss:
    """Loss of a step, whose constants are those of a run.

    Parameters
    ----------
    config : RadianceConfig
        Configuration of the field.
    box : AnyBox
        Bounds of the field.
    settings : RadianceSettings
        Training settings.
    ns : module
        Dr.Jit backend.
    photos : PhotoColors, optional
        Colour corrections of the photos.
    use_depth : bool
        Whether the depth of pixels is supervised.
    cell_size_at : callable
        Maps world points to the edge of their cell of the density grid.
    """

    config: RadianceConfig
    box: AnyBox
    settings: RadianceSettings
    ns: ModuleType
    photos: PhotoColors | None
    use_depth: bool
    cell_size_at: Callable[[Array3f], Float | float]

    def compute_gradients(self, weights: dict[str, Any], inputs: LossInputs) -> tuple[Float, Float | None, dict]:
        """Return the loss of the rays, the depth loss of each ray or None, and the gradients of all ``weights``.

        Only arrays change between two calls, so that Dr.Jit can record the kernels (`dr.freeze`): to trace them takes
        as long as a quarter of their execution.
        """
        with gc_paused():
            parameters = {name: type(value)(value) for name, value in weights.items()}
            dr.enable_grad(parameters)
            loss, depth_errors, penalty = self._compute_losses(parameters, inputs)
            dr.backward(loss + penalty)
        return dr.detach(loss), depth_errors, {name: dr.grad(value) for name, value in parameters.items()}

    def _compute_losses(self, parameters: dict, inputs: LossInputs) -> tuple[Float, Float | None, Any]:
        """Return the loss of the rays, the depth loss of each ray, and the penalties without rays."""
        s, ns, depth_errors = self.settings, self.ns, None
        samples, pixels, march_step = inputs.samples, inputs.pixels, s.march_step * self.box.side
        d = dr.gather(ns.Array3f, pixels.d, samples.ray)
        sigma, parts = evaluate_samples(self.config, self.box, parameters, samples.p, d, ns, samples.features)
        if s.damping_distance > 0:
            sigma, *parts = damp_near([sigma, *parts], samples.t, inputs.damping_distance)
        # Evaluate now; otherwise each sum along the rays would evaluate the networks again.
        dr.eval(sigma, parts)
        weight, tau, sums, opacity = composite(sigma, parts, samples)
        color = evaluate_ray_color(self.config, parameters, sums, opacity, pixels.d, ns)
        penalty = self._compute_empty_penalty(parameters, inputs.empty_points)
        if self.photos is not None:
            changes = self.photos.compute_changes(parameters[PHOTO_PARAMETER])
            color = self.photos.apply(changes, color, opacity, pixels.frame)
            penalty += s.photo_decay * self.photos.decay_loss(changes)
        loss = color_loss(color, opacity, pixels, inputs.background, s.huber_delta)
        if self.use_depth and pixels.depth is not None:
            # In units of the current step: a coarse march cannot place surfaces more precisely.
            step = march_step
            if self.box.is_contracted:
                step = dr.maximum(s.step_growth * pixels.depth, march_step)
            depth_term = depth_loss(weight, tau, samples, pixels.depth, step * s.depth_margin, step * inputs.stride)
            loss += inputs.depth_weight * depth_term
            depth_errors = dr.detach(depth_term)
        if inputs.point_depth is not None:
            distance, error = inputs.point_depth
            step = dr.maximum(s.step_growth * distance, march_step) * inputs.stride
            margin = dr.maximum(s.point_margin * error, s.depth_margin * step)
            loss += inputs.point_weight / s.point_fraction * surface_loss(weight, samples, distance, margin)
        if s.distortion_weight > 0:
            loss += s.distortion_weight * distortion_loss(weight, samples, self.box.side)
        complete = dr.arange(ns.UInt32, dr.width(pixels.d)) < inputs.covered
        return dr.sum(dr.select(complete, loss, 0)) / ns.Float(inputs.covered), depth_errors, penalty

    def _compute_empty_penalty(self, parameters: dict, p: Array3f | None):
        """Return the penalty on density at points ``p`` in cells that are not sampled.

        Without it nothing would keep these cells empty, and hash collisions fill them with artefacts of surfaces
        elsewhere. The logarithm acts on fog and artefacts alike.
        """
        if p is None:
            return 0
        sigma = evaluate_density(self.config, self.box, parameters, p, self.ns)
        return self.settings.empty_weight * dr.mean(dr.log(1 + sigma * self.cell_size_at(p)))
