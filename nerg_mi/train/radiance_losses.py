"""The model of a radiance field in training, its losses, and colours of single photographs."""

from __future__ import annotations

from typing import Any, cast

import drjit as dr
import numpy as np

from nerg_mi.fields.encoding import encode_direction, encoding_from_parameters
from nerg_mi.fields.mlp import MLP
from nerg_mi.fields.radiance import (
    RadianceConfig,
    density_from_log,
    mean_features,
    decode_color,
    color_network_inputs,
    point_features,
)
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Float, UInt32
from nerg_mi.transport.quadrature import mean_depth_fraction

from .radiance_data import PixelBatch
from .radiance_sampling import RaySamples, sum_along_rays, compute_weights

# ---- What a radiance field is fitted to: the colours of rays and, where it is known, their depth ----


def huber_loss(error, delta: float):
    """Huber's loss, quadratic below ``delta`` and linear above, with unit curvature at 0."""
    size = dr.abs(error)
    return dr.select(size < delta, 0.5 * size * size, delta * (size - 0.5 * delta))


def color_loss(color, opacity, pixels: PixelBatch, background, delta: float):
    """Mean Huber loss a ray (Float, one entry a ray) of composited ``color`` (3 Floats) over ``background``.

    The random ``background`` (Array3f) shows through what is transparent, in the prediction and, by its
    alpha, in the picture: leaving holes in what is opaque then costs.
    """
    loss = 0
    for k in range(3):
        target = pixels.rgb[k]
        if pixels.alpha is not None:
            target = dr.lerp(background[k], target, pixels.alpha)
        loss += huber_loss(color[k] + (1 - opacity) * background[k] - target, delta)
    return loss / 3


def depth_loss(weight: Float, tau: Float, samples: RaySamples, depth: Float, margin: float | Float, scale: Float):
    """Loss a ray of the absorption's place against the true ``depth`` (as in `PixelBatch`); 0 where that is unknown.

    Two terms: the share of the light that is not absorbed within ``margin`` (scene units; a number, or a ray each) of
    the true surface, or within the step that holds it (line-of-sight supervision, Rematas et al. 2022, with a box for
    its Gaussian), which forbids fog, holes and floaters alike; and the distance of the expected depth from the true
    one, in units of ``scale`` (of all rays, or a ray each), which places the surface within the step.
    """
    s = samples.segments
    truth = dr.gather(type(weight), depth, s.ray, s.active)
    if not isinstance(margin, float):
        margin = dr.gather(type(weight), margin, s.ray, s.active)
    near = (samples.t < truth + margin) & (samples.t + samples.length > truth - margin)
    caught = sum_along_rays(dr.select(near, weight, 0), s)
    # Only absorption near the surface is moved: a floater is to vanish, not to drag the surface along.
    offset = samples.t + samples.length * mean_depth_fraction(tau) - truth
    shift = sum_along_rays(dr.select(near, weight * offset, 0), s)
    loss = (1 - caught) + dr.minimum(dr.abs(shift) / scale, 10)
    return dr.select(depth > 0, loss, 0)


def feature_decay_loss(features):
    """Mean square (Float) of a grid's ``features``.

    What many rays see outweighs it, as each feature has one share in millions. Features that few rays have shaped, or
    chance alone, it takes back to 0: Adam moves all alike, however small their derivatives are.
    """
    return dr.mean(dr.square(features))


def distortion_loss(weight, samples: RaySamples, scale: float):
    """Loss a ray that draws its weight together: Σ_ij w_i w_j |m_i - m_j| + Σ_i w_i² δ_i / 3 with midpoints m and
    lengths δ of the samples, in units of ``scale`` (Barron et al. 2022, mip-NeRF 360, eq. 15; summed in O(n) as samples
    are in order). The samples' places have no derivative. Samples that stand for others count as one: the second term
    is then too large by 1/p of each."""
    length = samples.length / scale
    return sum_along_rays(
        dr.custom(_Distortion, weight, samples.t / scale + 0.5 * length, length, samples.segments), samples.segments
    )


class _Distortion(dr.CustomOp):
    """Each sample's part of the distortion: 2 w_i (m_i Σ_{j<i} w_j - Σ_{j<i} w_j m_j) + w_i² δ_i / 3."""

    def eval(self, weight, middle, length, segments):
        Float = type(weight)
        self.weight, self.length, self.segments = weight, length, segments
        # From the ray's first sample on: the two sums are of like size, and cancel.
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
    """Weights, optical depths, sums of the ``parts`` of samples (colours, as a rule) and opacity of every ray.

    Of thinned samples the opacity is that of all, and a sum their mean times it: both without the noise of the
    sums of weights. Derivatives are those of the plain sums, which are right on average.
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


# ---- The radiance field's forward pass in the form that trains fastest: networks as tensor products ----


def stack(rows: list, ns):
    """Rows (Floats of one length, or constants) as a TensorXf (N, rows)."""
    flat = dr.ravel(ns.ArrayXf(rows), order="F")
    return ns.TensorXf(flat, (dr.width(flat) // len(rows), len(rows)))


def unstack(x, ns) -> list:
    """Columns of a TensorXf (N, rows) as Floats.

    A plain slice would send its gradient back through atomic additions; no two columns share an
    entry, so that ``Permute`` (plain stores) is right.
    """
    width, rows = x.shape
    index = dr.arange(ns.UInt32, width)
    return [
        dr.gather(ns.Float, x.array, index * rows + dr.opaque(ns.UInt32, k), mode=dr.ReduceMode.Permute)
        for k in range(rows)
    ]


def evaluate_samples(config: RadianceConfig, box: AnyBox, parameters: dict, p, d, ns, features: list | None = None):
    """Density (1/unit) at world points ``p`` seen along ``d``, and what a ray composites of them (list of Floats):
    colour (3 in 0..1), or of a deferred field the features that `ray_color` makes colour of.

    The same maths as ``RadianceField.density_features`` and ``color`` on ``parameters`` spelt as the field spells them;
    points must lie in ``box``. Gradients reach every entry of ``parameters``. ``features``: what the grid returns at
    ``p``, where that has been looked up already.
    """
    h = unstack(_net(parameters, "density_net").tensor(_features(config, box, parameters, p, ns, features)), ns)
    sigma = box.density_from_encoded(density_from_log(h[0], config.density_scale), p)
    features = point_features(h[1:], config.deferred)
    return sigma, features if config.deferred else _color(config, parameters, features, d, ns)


def evaluate_ray_color(config: RadianceConfig, parameters: dict, sums: list, opacity, d, ns) -> list:
    """Colour (3 Floats, times opacity) of rays along ``d`` that composited ``sums`` of what `density_summand` returns,
    with this ``opacity``."""
    if not config.deferred:
        return sums
    return [opacity * c for c in _color(config, parameters, mean_features(sums, opacity), d, ns)]


def _color(config: RadianceConfig, parameters: dict, features: list, d, ns) -> list:
    given = color_network_inputs(features, config.deferred)
    c = _net(parameters, "color_net").tensor(stack(encode_direction(d, config.sh_degree) + given, ns))
    return decode_color(unstack(c, ns), given, config.deferred)


def evaluate_density(config: RadianceConfig, box: AnyBox, parameters: dict, p, ns):
    """Density (1/unit) alone, at world points ``p`` in ``box``; see `density_summand`."""
    head = _head(parameters)
    log_density = head.tensor(_features(config, box, parameters, p, ns)).array
    return box.density_from_encoded(density_from_log(log_density, config.density_scale), p)


def evaluate_density_from_features(config: RadianceConfig, box: AnyBox, parameters: dict, p, features: list):
    """Density (1/unit) at ``p`` where the grid returns ``features`` (list of Floats); no weight gradients, one
    kernel."""
    return box.density_from_encoded(density_from_log(_head(parameters)(features)[0], config.density_scale), p)


def _head(parameters: dict) -> MLP:
    net = _net(parameters, "density_net")
    return MLP(net.weights[:-1] + [net.weights[-1][0:1, :]])


def _features(config: RadianceConfig, box: AnyBox, parameters: dict, p, ns, known: list | None = None):
    rows = encoding_from_parameters(config.grid, parameters, mode=dr.ReduceMode.Expand)(box.to_unit(p))
    return stack(rows if known is None else [dr.replace_grad(a, b) for a, b in zip(known, rows)], ns)


def _net(parameters: dict, name: str) -> MLP:
    count = sum(k.startswith(name + ".") for k in parameters)
    return MLP([parameters[f"{name}.{i}"] for i in range(count)])


# ---- Photo colors ----
#
# Colours as each photo has them: a camera chooses exposure and white balance anew for every picture.
#
# Where the scene's colour is c, a photo has A c + b in sRGB values, with a matrix A (3, 3) and an offset b of its own
# (Rematas et al. 2022, Urban Radiance Fields, sec. 4.1, there decoded from a latent code). Over the photos their mean
# is no change at all, so that the scene has the colours of the average photo.

PHOTO_PARAMETER = "photos"  # Name of the optimiser's parameter
# The optimiser moves a number by up to its learning rate a step, which is much for a colour.
_UNIT = 0.01
_GREY = 0.5


class PhotoColors:
    """What becomes of colours in each of ``frames`` photos; 12 numbers each, which the optimiser holds as `PHOTOS`."""

    def __init__(self, ns, frames: int):
        self.ns, self.frames = ns, frames

    def init_parameter(self) -> Float:
        """The parameter where no photo changes anything."""
        return dr.zeros(self.ns.Float, 12 * self.frames)

    def compute_changes(self, parameter: Float) -> Float:
        """The entries of [A - 1 | b], photo by photo and row by row."""
        ns, each = self.ns, dr.arange(self.ns.UInt32, 12 * self.frames) % 12
        mean = dr.zeros(ns.Float, 12)
        dr.scatter_add(mean, parameter / self.frames, each)
        return _UNIT * (parameter - dr.gather(ns.Float, mean, each))

    def apply(self, changes: Float, color: list[Float], opacity: Float, frame: UInt32) -> list[Float]:
        """``color`` (3 Floats), composited with ``opacity``, as it is in the photos ``frame``."""
        rows = [dr.gather(self.ns.Array4f, changes, 3 * frame + k) for k in range(3)]
        return [c + r[0] * color[0] + r[1] * color[1] + r[2] * color[2] + r[3] * opacity for c, r in zip(color, rows)]

    def decay_loss(self, changes: Float) -> Float:
        """Mean over the photos of the squares of their ``changes``, summed."""
        return dr.sum(dr.square(changes)) / self.frames

    def compute_exposure_spread(self, parameter: Float) -> float:
        """How far the photos' exposures are apart: the standard deviation of what becomes of a middle grey, in f-stops.

        A stop, twice the light, multiplies sRGB values of middle greys by about 2^(1/2.2).
        """
        m = self.compute_matrices(parameter)
        grey = (m[..., :3].sum(axis=-1) * _GREY + m[..., 3]).mean(axis=-1) / _GREY
        return float(2.2 * np.std(np.log2(np.maximum(grey, 1e-3))))

    def compute_matrices(self, parameter: Float) -> np.ndarray:
        """[A | b] of every photo, (frames, 3, 4)."""
        return np.eye(3, 4) + self.compute_changes(parameter).numpy().reshape(-1, 3, 4)
