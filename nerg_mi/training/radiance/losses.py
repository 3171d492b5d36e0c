"""What a radiance field is fitted to: the colours of rays and, where it is known, their depth."""

from __future__ import annotations

import drjit as dr

from nerg_mi.maths.types import Float
from nerg_mi.transport.quadrature import mean_depth_share

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


def depth_loss(weight: Float, tau: Float, samples: Samples, depth: Float, margin: float | Float, scale: Float):
    """Loss a ray of the absorption's place against the true ``depth`` (as in `PixelBatch`); 0 where that is unknown.

    Two terms: the share of the light that is not absorbed within ``margin`` (scene units; a number, or a ray each) of
    the true surface, or within the step that holds it (line-of-sight supervision, Rematas et al. 2022, with a
    box for its Gaussian), which forbids fog, holes and floaters alike; and the distance of the expected
    depth from the true one, in units of ``scale`` (of all rays, or a ray each), which places the surface within the
    step.
    """
    s = samples.segments
    truth = dr.gather(type(weight), depth, s.ray, s.active)
    if not isinstance(margin, float):
        margin = dr.gather(type(weight), margin, s.ray, s.active)
    near = (samples.t < truth + margin) & (samples.t + samples.length > truth - margin)
    caught = ray_sum(dr.select(near, weight, 0), s)
    # Only absorption near the surface is moved: a floater is to vanish, not to drag the surface along.
    offset = samples.t + samples.length * mean_depth_share(tau) - truth
    shift = ray_sum(dr.select(near, weight * offset, 0), s)
    loss = (1 - caught) + dr.minimum(dr.abs(shift) / scale, 10)
    return dr.select(depth > 0, loss, 0)


def feature_decay(features):
    """Mean square (Float) of a grid's ``features``.

    What many rays see outweighs it, as each feature has one share in millions. Features that few rays have shaped, or
    chance alone, it takes back to 0: Adam moves all alike, however small their derivatives are.
    """
    return dr.mean(dr.square(features))


def distortion_loss(weight, samples: Samples, scale: float):
    """Loss a ray that draws its weight together: Σ_ij w_i w_j |m_i - m_j| + Σ_i w_i² δ_i / 3 with midpoints m and
    lengths δ of the samples, in units of ``scale`` (Barron et al. 2022, mip-NeRF 360, eq. 15; summed in O(n) as samples
    are in order). The samples' places have no derivative. Samples that stand for others count as one: the second term
    is then too large by 1/p of each."""
    length = samples.length / scale
    return ray_sum(
        dr.custom(_Spread, weight, samples.t / scale + 0.5 * length, length, samples.segments), samples.segments
    )


class _Spread(dr.CustomOp):
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
        g: Float = self.grad_in("weight")
        w, kind = self.weight, type(g)
        self.set_grad_out(kind(2 * (g * self._before(w) + w * self._before(g))) + 2 * w * g * self.length / 3)

    def backward(self):
        g: Float = self.grad_out()
        w, kind = self.weight, type(g)
        a = g * w
        later = self.segments.after(a * self.middle) - self.middle * self.segments.after(a)
        self.set_grad_in("weight", kind(2 * (g * self._before(w) + later)) + 2 * g * w * self.length / 3)

    def name(self):
        return "distortion of a ray"


def composite(sigma: Float, parts: list, samples: Samples) -> tuple[Float, Float, list[Float], Float]:
    """Weights, optical depths, sums of the ``parts`` of samples (colours, as a rule) and opacity of every ray.

    Of thinned samples the opacity is that of all, and a sum their mean times it: both without the noise of the
    sums of weights. Derivatives are those of the plain sums, which are right on average.
    """
    s, thinned = samples.segments, samples.thinned
    tau = dr.select(s.active, sigma * samples.length, 0)
    weight = weights(tau, s, thinned)
    sums, opacity = [ray_sum(weight * x, s) for x in parts], ray_sum(weight, s)
    if thinned is not None:
        scale = dr.detach(thinned.opacity / dr.maximum(opacity, 1e-6))
        sums = [dr.replace_grad(x * scale, x) for x in sums]
        opacity = dr.replace_grad(thinned.opacity, opacity)
    return weight, tau, sums, opacity
