"""Samples along training rays, and their compositing with its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Array3f, Float, UInt32
from nerg_mi.transport.quadrature import absorbed_fraction

# ---- Volume rendering of samples that lie packed, ray after ray, in flat arrays; differentiable ----
#
# Equations of Mildenhall et al. 2020 (eq. 3; Max 1995): weight w_i = T_i (1 - exp(-τ_i)) with
# T_i = exp(-Σ_{j<i} τ_j) and τ = σδ; a ray's colour is Σ w_i c_i.
#
# Sums along a ray are differences of one running sum over all samples, in float64, so that rays of
# any length cost the same and nothing recompiles. The derivatives are written out: Dr.Jit's own
# would add every sample of a ray to one address.


# A denser step changes nothing (exp(-60) is 0 in fp32), but would drown the running sum of the other rays.
_MAX_TAU = 60.0


class Segments:
    """Which samples belong to which ray.

    ``ray``: UInt32 index of each sample's ray, ascending; ``active``: False for padding at the end; ``rays``: number of
    rays. ``start`` and ``stop`` (one entry a ray) bound its samples; both are 0 for rays without any.
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
class ThinnedSamples:
    """What is known of samples that stand for others: one was kept with probability p, on the sum of all.

    ``copies``: 1 / p of each sample; ``before``: optical depth in front of it, of all samples; ``opacity``: of each
    ray, of all samples.
    """

    multiplicity: Float
    before: Float
    opacity: Float


class _Weights(dr.CustomOp):
    """w of τ; dw_i = c_i T_i exp(-τ_i) dτ_i - w_i Σ_{j<i} c_j dτ_j along one ray, c the samples' copies."""

    def eval(self, tau, segments, thinned):
        self.segments = segments
        Float = type(tau)
        self.multiplicity = 1 if thinned is None else thinned.multiplicity
        capped = dr.minimum(tau, _MAX_TAU)
        before = Float(segments.before(capped)) if thinned is None else thinned.before
        transmitted = dr.select(segments.active, self.copies * dr.exp(-before), 0)
        self.weight = transmitted * absorbed_fraction(capped)
        self.passed = transmitted * dr.exp(-capped)
        return Float(self.weight)

    def forward(self):
        g: Any = self.grad_in("tau")
        self.set_grad_out(self.passed * g - self.weight * type(g)(self.segments.before(self.copies * g)))

    def backward(self):
        g: Any = self.grad_out()
        self.set_grad_in("tau", self.passed * g - self.copies * type(g)(self.segments.after(g * self.weight)))

    def name(self):
        return "volume rendering weights"


class _RaySum(dr.CustomOp):
    """Σ x_i along each ray."""

    def eval(self, x, segments):
        self.segments = segments
        return type(x)(segments.total(x))

    def forward(self):
        g: Any = self.grad_in("x")
        self.set_grad_out(type(g)(self.segments.total(g)))

    def backward(self):
        g: Any = self.grad_out()
        s = self.segments
        self.set_grad_in("x", dr.gather(type(g), g, s.ray, s.active))

    def name(self):
        return "sum along rays"


def compute_weights(tau: Float, segments: Segments, thinned: ThinnedSamples | None = None) -> Float:
    """Weights of samples of optical depth ``tau`` >= 0 (Float); 0 for padding.

    Of ``thinned`` samples each weight is that of all the samples it stands for: sums of them along a ray, and their
    derivatives, are those over all samples on average.
    """
    return dr.custom(_Weights, tau, segments, thinned)


def sum_along_rays(x: Float, segments: Segments) -> Float:
    """Sum of ``x`` (a Float, one entry a sample) along each ray: a Float, one entry a ray."""
    return dr.custom(_RaySum, x, segments)


def damp_near(values: list, t, distance) -> list:
    """``values`` of samples at distance ``t``, with derivatives scaled by (t / reach)² within ``reach``.

    What is near a camera is sampled by many of its rays, and would turn to fog before far surfaces are found (Philip
    and Deschaintre 2023, "Floaters No More").
    """
    share = dr.minimum(dr.square(t / distance), 1)
    return [dr.replace_grad(x, x * share) for x in values]


# ---- Sampling ----
#
# Samples of training rays: steps in cells that may hold density, in front of what is opaque.
#
# Plain marching with true steps. Every ray shares one table of step edges, shifted by its own jitter;
# steps are kept where the density grid has a bit, then where a density-only pass still sees light.
# What is kept lies packed, ray after ray (see ``compositing``).


class StepTable:
    """Edges t_0 < t_1 < ... from ``near`` to ``far``, in scene units.

    A step is ``step`` long, or ``growth`` times its distance where that is longer: pixels widen with
    distance, and so may steps. The rule is scale-free, as ``transport.march_primal`` has it.
    """

    def __init__(self, ns, near: float, far: float, step: float, growth: float):
        edges = [near]
        while edges[-1] < far:
            edges.append(edges[-1] + max(step, growth * edges[-1]))
        # One more, because jitter shifts every edge by up to one step.
        edges.append(edges[-1] + max(step, growth * edges[-1]))
        self.steps = len(edges) - 1
        self.edges = ns.Float(copy_aligned(np.array(edges)))
        # As literals they would compile the kernels anew for every table.
        self._steps = dr.opaque(ns.UInt32, self.steps)
        self._share = dr.opaque(ns.Float64, 1 / self.steps)

    def split(self, index):
        """Ray and step (UInt32) of candidates ``index`` = ray * steps + step."""
        # Division of integers is slow; in float64 half a step outweighs all rounding.
        Float64: Any = dr.float64_array_t(index)
        ray = type(index)((Float64(index) + 0.5) * self._share)
        return ray, index - ray * self._steps

    def interval(self, k, offset):
        """Start and length of step ``k``, shifted by ``offset`` in [0, 1) of a step."""
        Float = type(offset)
        a, b = dr.gather(Float, self.edges, k), dr.gather(Float, self.edges, k + 1)
        c = dr.gather(Float, self.edges, dr.minimum(k + 2, self._steps))
        # The edge after the last repeats it: a step of no length beyond the far end.
        start, stop = dr.lerp(a, b, offset), dr.lerp(b, dr.maximum(c, b), offset)
        return start, stop - start


@dataclass
class CameraRays:
    """``o``, ``d``: Array3f origins and unit directions, world frame; ``t0``, ``t1``: where each crosses
    the box (empty where t1 <= t0); ``count``: how many."""

    o: Array3f
    d: Array3f
    t0: Float
    t1: Float
    count: int


def clip_rays(o, d, box: AnyBox, near: float) -> CameraRays:
    """Rays clipped to ``box``, from ``near`` on."""
    # Not maths.ray_box: of rays along a face a training may lose some, and is spared the selects that keep them.
    Float = type(d.x)
    t0: Any = Float(near)
    t1: Any = Float(dr.inf)
    for axis in range(3):
        inverse = dr.rcp(d[axis])
        a, b = (box.lower[axis] - o[axis]) * inverse, (box.upper[axis] - o[axis]) * inverse
        # fmin/fmax pass over the NaN of a ray that runs within a face.
        t0, t1 = dr.fmax(t0, dr.fmin(a, b)), dr.fmin(t1, dr.fmax(a, b))
    dr.eval(o, d, t0, t1)
    return CameraRays(o, d, t0, t1, dr.width(o))


@dataclass
class RaySamples:
    """Packed steps of rays: ``ray`` index, ``t`` start and ``length`` (scene units), ``p`` midpoint (Array3f, world),
    and the rays' ``segments``. ``count``: real ones, the rest being padding; ``features``: what the density pass knew
    of them, or None; ``thinned``: of samples that stand for others; ``looked``: samples a ray of the density pass."""

    ray: UInt32
    t: Float
    length: Float
    p: Array3f
    segments: Segments
    count: int
    features: list | None = None
    thinned: ThinnedSamples | None = None
    prepass_samples_per_ray: float = 0.0


@dataclass(frozen=True)
class RussianRoulette:
    """Which samples to keep: those of a weight of ``sure`` or more all, others with a probability in proportion to
    their weight, but ``least`` at least. ``seed``: of the choices. They are independent of one another, because
    derivatives hold products of two samples, whose average is right only if so."""

    weight: float
    min_probability: float
    seed: int


def find_occupied_steps(rays: CameraRays, table: StepTable, offset, is_occupied, max_steps: int | None = None) -> tuple | None:
    """Steps whose midpoints lie in the box and in an occupied cell: (ray, t, length, p), evaluated; rays covered.

    ``offset``: each ray's jitter, [0, 1); ``occupied``: function of points (Array3f) and a mask, giving a mask.
    ``most``: bound of their number; the last rays, whose steps do not fit, are dropped. None without one step.
    """
    UInt32 = dr.uint32_array_t(type(offset))
    total = rays.count * table.steps
    if total >= 2**32:
        raise ValueError(f"{rays.count} rays of {table.steps} steps are too many for one batch")
    ray, k = table.split(dr.arange(UInt32, total))
    _, _, p, inside = _step(rays, table, offset, ray, k)
    kept = dr.compress(is_occupied(p, inside))
    count, covered = dr.width(kept), rays.count
    if count == 0:
        return None
    if max_steps is not None and count > max_steps:
        # Rays lie one after another: the first step that does not fit tells which ray is incomplete.
        covered = int(dr.gather(UInt32, kept, UInt32(max_steps)).numpy()[0]) // table.steps
        if covered == 0:
            raise NergError(f"a single ray has more than {max_steps} steps; enlarge the batch, look_most or the step")
        count = dr.width(dr.compress(kept < dr.opaque(UInt32, covered * table.steps)))
        kept = dr.gather(UInt32, kept, dr.arange(UInt32, count))
    ray, k = table.split(kept)
    t, length, p, _ = _step(rays, table, offset, ray, k)
    dr.eval(ray, t, length, p)
    return ray, t, length, p, covered


def _step(rays: CameraRays, table: StepTable, offset, ray, k):
    Float = type(offset)
    t, length = table.interval(k, dr.gather(Float, offset, ray))
    middle = t + 0.5 * length
    o, d = (dr.gather(type(rays.o), v, ray) for v in (rays.o, rays.d))
    inside = (middle > dr.gather(Float, rays.t0, ray)) & (middle < dr.gather(Float, rays.t1, ray)) & (length > 0)
    return t, length, o + d * middle, inside


def select_visible_samples(
    rays: CameraRays,
    table: StepTable,
    offset,
    is_occupied,
    density,
    min_transmittance: float,
    pad: int | None = None,
    roulette: RussianRoulette | None = None,
    max_prepass_samples: int | None = None,
    with_features: bool = False,
) -> tuple[RaySamples | None, int]:
    """Samples that may matter, and the number of leading rays that they cover completely.

    ``density``: function of points and a mask giving σ without a gradient, and with ``with_features`` also a list of
    Floats that the samples are to keep; samples that less than ``stop`` of the light reaches are dropped. ``pad``: make
    exactly so many samples, dropping the last rays that do not fit. ``thinning``: let few samples stand for the many
    that hardly absorb. ``most``: samples at most at which ``density`` is evaluated, by the same means.
    Returns (None, rays) when no ray meets anything.
    """
    steps = find_occupied_steps(rays, table, offset, is_occupied, max_prepass_samples)
    if steps is None:
        return None, rays.count
    ray, t, length, p, covered = steps
    Bool, Float, UInt32 = dr.mask_t(t), type(t), type(ray)
    everywhere = dr.full(Bool, True, dr.width(t))
    segments = Segments(ray, everywhere, rays.count)
    sigma, features = density(p, everywhere) if with_features else (density(p, everywhere), None)
    tau = dr.minimum(sigma * length, 60.0)
    # At once: each on its own would evaluate the field again.
    dr.eval(tau, features)
    before = Float(segments.before(tau))
    light = dr.exp(-before)
    chosen, thinned = light > min_transmittance, None
    if roulette is not None:
        weight = light * absorbed_fraction(tau)
        share = dr.clip(weight / roulette.weight, roulette.min_probability, 1)
        ns = namespace(t)
        random = ns.PCG32(dr.width(t), dr.opaque(ns.UInt64, roulette.seed)).next_float32()
        chosen &= random < share
        thinned = ThinnedSamples(dr.rcp(share), before, absorbed_fraction(Float(segments.total(tau))))
        dr.eval(chosen, thinned.multiplicity, before, thinned.opacity)
    kept = dr.compress(chosen)
    count, looked = dr.width(kept), dr.width(t) / covered
    if count == 0:
        return None, covered
    if pad is not None and count > pad:
        # The ray in which the limit falls is incomplete: it and all later ones wait for another batch.
        covered = int(dr.gather(UInt32, ray, dr.gather(UInt32, kept, UInt32(pad))).numpy()[0])
        if covered == 0:
            raise NergError(f"a single ray has more than {pad} samples; enlarge the batch or the step")
    j = dr.arange(UInt32, pad if pad is not None else count)
    source = dr.gather(UInt32, kept, dr.minimum(j, dr.opaque(UInt32, count - 1)))
    ray = dr.gather(UInt32, ray, source)
    active = (j < dr.opaque(UInt32, count)) & (ray < dr.opaque(UInt32, covered))
    t, length, p = (dr.gather(type(v), v, source) for v in (t, length, p))
    if features is not None:
        features = [dr.gather(type(f), f, source) for f in features]
    if thinned is not None:
        thinned.multiplicity, thinned.before = (dr.gather(Float, v, source) for v in (thinned.multiplicity, thinned.before))
        dr.eval(thinned.multiplicity, thinned.before)
    dr.eval(ray, active, t, length, p, features)
    segments = Segments(ray, active, rays.count)
    return RaySamples(ray, t, length, p, segments, min(count, pad or count), features, thinned, looked), covered
