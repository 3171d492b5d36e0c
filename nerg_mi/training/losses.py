"""What a radiance field is fitted to: the colours of rays and, where it is known, their depth."""
from __future__ import annotations

import drjit as dr

from ..transport.quadrature import mean_depth_share
from .compositing import ray_sum, weights
from .pixels import PixelBatch
from .sampling import Samples


def huber(error, delta: float):
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
        loss += huber(color[k] + (1 - opacity) * background[k] - target, delta)
    return loss / 3


def depth_loss(weight, tau, samples: Samples, pixels: PixelBatch, margin: float, scale: float):
    """Loss a ray of the absorption's place against the true depth; 0 where that is unknown.

    Two terms: the share of the light that is not absorbed within ``margin`` (scene units) of the true
    surface, or within the step that holds it (line-of-sight supervision, Rematas et al. 2022, with a
    box for its Gaussian), which forbids fog, holes and floaters alike; and the distance of the expected
    depth from the true one, in units of ``scale``, which places the surface within the step.
    """
    s = samples.segments
    Float = type(weight)
    truth = dr.gather(Float, pixels.depth, s.ray, s.active)
    near = (samples.t < truth + margin) & (samples.t + samples.length > truth - margin)
    caught = ray_sum(dr.select(near, weight, 0), s)
    # Only absorption near the surface is moved: a floater is to vanish, not to drag the surface along.
    offset = samples.t + samples.length * mean_depth_share(tau) - truth
    shift = ray_sum(dr.select(near, weight * offset, 0), s)
    loss = (1 - caught) + dr.minimum(dr.abs(shift) / scale, 10)
    return dr.select(pixels.depth > 0, loss, 0)


def composite(sigma, rgb: list, samples: Samples):
    """Weights, optical depths, colour (3 Floats) and opacity of every ray."""
    s = samples.segments
    tau = dr.select(s.active, sigma * samples.length, 0)
    weight = weights(tau, s)
    return weight, tau, [ray_sum(weight * c, s) for c in rgb], ray_sum(weight, s)
