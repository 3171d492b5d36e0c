"""Volume rendering of samples that lie packed, ray after ray, in flat arrays; differentiable.

Equations of Mildenhall et al. 2020 (eq. 3; Max 1995): weight w_i = T_i (1 - exp(-τ_i)) with
T_i = exp(-Σ_{j<i} τ_j) and τ = σδ; a ray's colour is Σ w_i c_i.

Sums along a ray are differences of one running sum over all samples, in float64, so that rays of
any length cost the same and nothing recompiles. The derivatives are written out: Dr.Jit's own
would add every sample of a ray to one address.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from nerg_mi.maths.types import Float
from nerg_mi.transport.quadrature import absorbed_share

# A denser step changes nothing (exp(-60) is 0 in fp32), but would drown the running sum of the other rays.
_MAX_TAU = 60.0


class Segments:
    """Which samples belong to which ray.

    ``ray``: UInt32 index of each sample's ray, ascending; ``active``: False for padding at the end;
    ``rays``: number of rays. ``start`` and ``stop`` (one entry a ray) bound its samples; both are 0
    for rays without any.
    """

    def __init__(self, ray, active, rays: int):
        UInt32 = type(ray)
        self.ray, self.active, self.rays = ray, active, rays
        count = dr.width(ray)
        j = dr.arange(UInt32, count)
        # Neighbours across the ends count as other rays; so does padding.
        before = dr.gather(UInt32, ray, dr.maximum(j, 1) - 1)
        last = dr.opaque(UInt32, count - 1)
        after = dr.gather(UInt32, ray, dr.minimum(j + 1, last))
        after_active = dr.gather(type(active), active, dr.minimum(j + 1, last))
        first = active & ((j == 0) | (before != ray))
        final = active & ((j == last) | (after != ray) | ~after_active)
        self.start, self.stop = dr.zeros(UInt32, rays), dr.zeros(UInt32, rays)
        dr.scatter(self.start, j, ray, first)
        dr.scatter(self.stop, j + 1, ray, final)
        dr.eval(self.start, self.stop)

    def before(self, x):
        """Sum of ``x`` over the earlier samples of the same ray, one float64 a sample."""
        running = dr.prefix_sum(self._masked(x))
        return running - dr.gather(
            type(running), running, dr.gather(type(self.ray), self.start, self.ray, self.active), self.active
        )

    def after(self, x):
        """Sum of ``x`` over the later samples of the same ray, one float64 a sample."""
        inclusive = dr.cumsum(self._masked(x))
        # `stop` is one past the ray's last sample, so never 0 where there is a sample.
        last = dr.gather(type(self.ray), self.stop, self.ray, self.active) - 1
        return dr.select(self.active, dr.gather(type(inclusive), inclusive, last, self.active) - inclusive, 0)

    def total(self, x):
        """Sum of ``x`` over each ray, one float64 a ray."""
        inclusive = dr.cumsum(self._masked(x))
        some = self.stop > 0
        upper = dr.gather(type(inclusive), inclusive, self.stop - 1, some)
        return upper - dr.gather(type(inclusive), inclusive, self.start - 1, some & (self.start > 0))

    def _masked(self, x):
        Float64: Any = dr.float64_array_t(type(x))
        return dr.select(self.active, Float64(x), 0)


@dataclass
class Thinned:
    """What is known of samples that stand for others: one was kept with probability p, on the sum of all.

    ``copies``: 1 / p of each sample; ``before``: optical depth in front of it, of all samples; ``opacity``: of each
    ray, of all samples.
    """

    copies: Float
    before: Float
    opacity: Float


class _Weights(dr.CustomOp):
    """w of τ; dw_i = c_i T_i exp(-τ_i) dτ_i - w_i Σ_{j<i} c_j dτ_j along one ray, c the copies that a sample stands
    for."""

    def eval(self, tau, segments, thinned):
        self.segments = segments
        Float = type(tau)
        self.copies = 1 if thinned is None else thinned.copies
        capped = dr.minimum(tau, _MAX_TAU)
        before = Float(segments.before(capped)) if thinned is None else thinned.before
        transmitted = dr.select(segments.active, self.copies * dr.exp(-before), 0)
        self.weight = transmitted * absorbed_share(capped)
        self.passed = transmitted * dr.exp(-capped)
        return Float(self.weight)

    def forward(self):
        g: Float = self.grad_in("tau")
        self.set_grad_out(self.passed * g - self.weight * type(g)(self.segments.before(self.copies * g)))

    def backward(self):
        g: Float = self.grad_out()
        self.set_grad_in("tau", self.passed * g - self.copies * type(g)(self.segments.after(g * self.weight)))

    def name(self):
        return "volume rendering weights"


class _RaySum(dr.CustomOp):
    """Σ x_i along each ray."""

    def eval(self, x, segments):
        self.segments = segments
        return type(x)(segments.total(x))

    def forward(self):
        g: Float = self.grad_in("x")
        self.set_grad_out(type(g)(self.segments.total(g)))

    def backward(self):
        g: Float = self.grad_out()
        s = self.segments
        self.set_grad_in("x", dr.gather(type(g), g, s.ray, s.active))

    def name(self):
        return "sum along rays"


def weights(tau: Float, segments: Segments, thinned: Thinned | None = None) -> Float:
    """Weights of samples of optical depth ``tau`` >= 0 (Float); 0 for padding.

    Of ``thinned`` samples each weight is that of all the samples it stands for: sums of them along a ray, and their
    derivatives, are those over all samples on average.
    """
    return dr.custom(_Weights, tau, segments, thinned)


def ray_sum(x: Float, segments: Segments) -> Float:
    """Sum of ``x`` (a Float, one entry a sample) along each ray: a Float, one entry a ray."""
    return dr.custom(_RaySum, x, segments)


def damp_near(values: list, t, reach) -> list:
    """``values`` of samples at distance ``t``, with derivatives scaled by (t / reach)² where they are nearer than
    ``reach``.

    What is near a camera is sampled by many of its rays, and would turn to fog before far surfaces are found (Philip
    and Deschaintre 2023, "Floaters No More").
    """
    share = dr.minimum(dr.square(t / reach), 1)
    return [dr.replace_grad(x, x * share) for x in values]
