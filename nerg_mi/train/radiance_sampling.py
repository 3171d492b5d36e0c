"""Samples along training rays, and compositing with its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.types import Array3f, Bool, Float, UInt32
from nerg_mi.transport.quadrature import absorbed_fraction

# ---- Differentiable volume rendering of samples packed ray after ray in flat arrays ----
#
# Equations of Mildenhall et al. 2020 (eq. 3; Max 1995): weight w_i = T_i (1 - exp(-τ_i)) with T_i = exp(-Σ_{j<i} τ_j)
# and τ = σδ; the colour of a ray is Σ w_i c_i.
#
# Sums along a ray are differences of one running sum over all samples, in float64, so that the cost does not depend on
# the lengths of the rays and nothing is recompiled. The derivatives are explicit, because those of Dr.Jit would add all
# samples of a ray atomically to one address.


# Higher optical depths change nothing (exp(-60) is 0 in fp32), but would dominate the running sum of the other rays.
_MAX_TAU = 60.0


@dataclass
class Segments:
    """Assignment of packed samples to rays.

    ``ray`` (UInt32, ascending) is the ray index of each sample, ``active`` is False for padding at the end. ``start``
    and ``stop`` (one entry per ray) bound its samples; both are 0 for rays without any.
    """

    ray: UInt32
    active: Bool
    start: UInt32
    stop: UInt32

    @staticmethod
    def find(ray, active, rays: int) -> Segments:
        """Find the samples of each of ``rays`` rays."""
        UInt32 = type(ray)
        count = dr.width(ray)
        j = dr.arange(UInt32, count)
        # Neighbours beyond the ends count as other rays, and so does padding.
        before = dr.gather(UInt32, ray, dr.maximum(j, 1) - 1)
        last = dr.opaque(UInt32, count - 1)
        after = dr.gather(UInt32, ray, dr.minimum(j + 1, last))
        after_active = dr.gather(type(active), active, dr.minimum(j + 1, last))
        first = active & ((j == 0) | (before != ray))
        final = active & ((j == last) | (after != ray) | ~after_active)
        start, stop = dr.zeros(UInt32, rays), dr.zeros(UInt32, rays)
        dr.scatter(start, j, ray, first)
        dr.scatter(stop, j + 1, ray, final)
        dr.eval(start, stop)
        return Segments(ray, active, start, stop)

    def before(self, x):
        """Sum of ``x`` over the earlier samples of the same ray, one float64 per sample."""
        running = dr.prefix_sum(self._masked(x))
        return running - dr.gather(
            type(running), running, dr.gather(type(self.ray), self.start, self.ray, self.active), self.active
        )

    def after(self, x):
        """Sum of ``x`` over the later samples of the same ray, one float64 per sample."""
        inclusive = dr.cumsum(self._masked(x))
        # `stop` is one past the ray's last sample, so never 0 where there is a sample.
        last = dr.gather(type(self.ray), self.stop, self.ray, self.active) - 1
        return dr.select(self.active, dr.gather(type(inclusive), inclusive, last, self.active) - inclusive, 0)

    def total(self, x):
        """Sum of ``x`` over each ray, one float64 per ray."""
        inclusive = dr.cumsum(self._masked(x))
        some = self.stop > 0
        upper = dr.gather(type(inclusive), inclusive, self.stop - 1, some)
        return upper - dr.gather(type(inclusive), inclusive, self.start - 1, some & (self.start > 0))

    def _masked(self, x):
        Float64: Any = dr.float64_array_t(type(x))
        return dr.select(self.active, Float64(x), 0)


@dataclass
class ThinnedSamples:
    """Data of samples that survived Russian roulette with probability p.

    ``multiplicity`` is 1 / p of each sample, ``before`` the optical depth in front of it including discarded samples,
    and ``opacity`` that of each ray including discarded samples.
    """

    multiplicity: Float
    before: Float
    opacity: Float


class _Weights(dr.CustomOp):
    """w of τ; dw_i = c_i T_i exp(-τ_i) dτ_i - w_i Σ_{j<i} c_j dτ_j along one ray, where c are the multiplicities."""

    def eval(self, tau, segments, thinned):
        self.segments = segments
        Float = type(tau)
        self.multiplicity = 1 if thinned is None else thinned.multiplicity
        capped = dr.minimum(tau, _MAX_TAU)
        before = Float(segments.before(capped)) if thinned is None else thinned.before
        transmitted = dr.select(segments.active, self.multiplicity * dr.exp(-before), 0)
        self.weight = transmitted * absorbed_fraction(capped)
        self.transmitted_after = transmitted * dr.exp(-capped)
        return Float(self.weight)

    def forward(self):
        g: Any = self.grad_in("tau")
        self.set_grad_out(
            self.transmitted_after * g - self.weight * type(g)(self.segments.before(self.multiplicity * g))
        )

    def backward(self):
        g: Any = self.grad_out()
        self.set_grad_in(
            "tau", self.transmitted_after * g - self.multiplicity * type(g)(self.segments.after(g * self.weight))
        )

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
    """Compute the weights of samples of optical depth ``tau`` >= 0 (Float); 0 for padding.

    The weights of ``thinned`` samples include 1 / p, so that their sums along a ray, and the derivatives of these sums,
    are unbiased.
    """
    return dr.custom(_Weights, tau, segments, thinned)


def sum_along_rays(x: Float, segments: Segments) -> Float:
    """Sum ``x`` (Float, one entry per sample) along each ray; returns Float, one entry per ray."""
    return dr.custom(_RaySum, x, segments)


def damp_near(values: list, t, distance) -> list:
    """Scale the derivatives of ``values`` at distance ``t`` by (t / distance)² within ``distance``. Values do not
    change.

    Space near a camera is sampled by many of its rays and would become foggy before distant surfaces are learned
    (Philip and Deschaintre 2023, "Floaters No More").
    """
    scale = dr.minimum(dr.square(t / distance), 1)
    return [dr.replace_grad(x, x * scale) for x in values]


# ---- Sampling ----
#
# Samples of training rays: steps in occupied cells, in front of opaque surfaces.
#
# All rays share one table of step edges, shifted by their own jitter. A step is kept if the density grid is set there,
# and then if a density-only pass still finds light. Samples are packed ray after ray (see `Segments`).


class StepTable:
    """Edges t_0 < t_1 < ... from ``near`` to ``far``, in scene units.

    The length of a step is the larger of ``step`` and ``growth`` times its distance, because pixels widen with
    distance. The rule is scale-free, as in ``transport.march_primal``.
    """

    def __init__(self, ns, near: float, far: float, step: float, growth: float):
        edges = [near]
        while edges[-1] < far:
            edges.append(edges[-1] + max(step, growth * edges[-1]))
        # One more edge, because jitter shifts every edge by up to one step.
        edges.append(edges[-1] + max(step, growth * edges[-1]))
        self.steps = len(edges) - 1
        self.edges = ns.Float(copy_aligned(np.array(edges)))
        # Literals would compile new kernels for each table.
        self._steps = dr.opaque(ns.UInt32, self.steps)
        self._share = dr.opaque(ns.Float64, 1 / self.steps)

    def split(self, index):
        """Split candidate indices ray * steps + step into ray and step (UInt32)."""
        # Integer division is slow. In float64, half a step exceeds all rounding errors.
        Float64: Any = dr.float64_array_t(index)
        ray = type(index)((Float64(index) + 0.5) * self._share)
        return ray, index - ray * self._steps

    def interval(self, k, offset):
        """Return the start and length of step ``k``, shifted by ``offset`` in [0, 1) of a step."""
        Float = type(offset)
        a, b = dr.gather(Float, self.edges, k), dr.gather(Float, self.edges, k + 1)
        c = dr.gather(Float, self.edges, dr.minimum(k + 2, self._steps))
        # The last edge is repeated, which gives a step of length zero beyond the far end.
        start, stop = dr.lerp(a, b, offset), dr.lerp(b, dr.maximum(c, b), offset)
        return start, stop - start


@dataclass
class CameraRays:
    """Rays clipped to the box: origins ``o`` and unit directions ``d`` (Array3f, world), interval ``t0`` to ``t1``
    (empty if t1 <= t0), and their number ``count``.
    """

    o: Array3f
    d: Array3f
    t0: Float
    t1: Float
    count: int


def clip_rays(o, d, box: AnyBox, near: float | Float) -> CameraRays:
    """Clip rays to ``box``, starting at distance ``near``, one value or one per ray."""
    # Not maths.ray_box: training may lose rays along a face, and saves the selects that keep them.
    Float = type(d.x)
    t0: Any = Float(near)
    t1: Any = Float(dr.inf)
    for axis in range(3):
        inverse = dr.rcp(d[axis])
        a, b = (box.lower[axis] - o[axis]) * inverse, (box.upper[axis] - o[axis]) * inverse
        # fmin and fmax ignore the NaN of a ray within a face.
        t0, t1 = dr.fmax(t0, dr.fmin(a, b)), dr.fmin(t1, dr.fmax(a, b))
    dr.eval(o, d, t0, t1)
    return CameraRays(o, d, t0, t1, dr.width(o))


@dataclass
class RaySamples:
    """Packed samples of rays.

    Attributes
    ----------
    ray : UInt32
        Ray index.
    t, length : Float
        Start and length of the step in scene units.
    p : Array3f
        Midpoint, world.
    segments : Segments
        Assignment to rays.
    count : int
        Number of samples without padding.
    features : list, optional
        Grid features from the density pass.
    thinned : ThinnedSamples, optional
        Data of samples that survived Russian roulette.
    prepass_samples_per_ray : float
        Samples per ray of the density pass.
    """

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
    """Russian roulette of samples.

    Samples of at least ``weight`` are always kept; others with a probability proportional to their weight, but at least
    ``min_probability``. ``seed`` is that of the decisions. They are independent, because derivatives contain products
    of two samples, whose mean is only then unbiased.
    """

    weight: float
    min_probability: float
    seed: int


def find_occupied_steps(
    rays: CameraRays, table: StepTable, offset, is_occupied, max_steps: int | None = None
) -> tuple | None:
    """Find the steps whose midpoints are in the box and in an occupied cell.

    Parameters
    ----------
    rays : CameraRays
        Clipped rays.
    table : StepTable
        Step edges.
    offset : Float
        Jitter of each ray in [0, 1).
    is_occupied : callable
        Maps points (Array3f) and a mask to a mask.
    max_steps : int, optional
        Maximum number of steps. The last rays, whose steps do not fit, are dropped.

    Returns
    -------
    tuple or None
        (ray, t, length, p, number of rays covered), evaluated; None without any step.
    """
    UInt32 = dr.uint32_array_t(type(offset))
    total = rays.count * table.steps
    if total >= 2**32:
        raise ValueError(f"{rays.count} rays with {table.steps} steps each exceed the size of a batch")
    ray, k = table.split(dr.arange(UInt32, total))
    _, _, p, inside = _compute_step(rays, table, offset, ray, k)
    indices = dr.compress(is_occupied(p, inside))
    count, covered = dr.width(indices), rays.count
    if count == 0:
        return None
    if max_steps is not None and count > max_steps:
        # Steps are sorted by ray: the first step that does not fit belongs to the first incomplete ray.
        covered = int(dr.gather(UInt32, indices, UInt32(max_steps)).numpy()[0]) // table.steps
        if covered == 0:
            raise NergError(
                f"a single ray has more than {max_steps} steps; increase batch, max_prepass_batches or march_step"
            )
        count = dr.width(dr.compress(indices < dr.opaque(UInt32, covered * table.steps)))
        indices = dr.gather(UInt32, indices, dr.arange(UInt32, count))
    ray, k = table.split(indices)
    t, length, p, _ = _compute_step(rays, table, offset, ray, k)
    dr.eval(ray, t, length, p)
    return ray, t, length, p, covered


def _compute_step(rays: CameraRays, table: StepTable, offset, ray, k):
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
    """Select the samples that contribute to the rays.

    Parameters
    ----------
    rays, table, offset, is_occupied
        As for `find_occupied_steps`.
    density : callable
        Maps points and a mask to σ without gradient and, with ``with_features``, to a list of Floats that is stored
        with the samples.
    min_transmittance : float
        Samples reached by less light are dropped.
    pad : int, optional
        Exact number of samples to return. The last rays that do not fit are dropped.
    roulette : RussianRoulette, optional
        Russian roulette for samples that hardly absorb.
    max_prepass_samples : int, optional
        Maximum number of evaluations of ``density``. The last rays that do not fit are dropped.
    with_features : bool
        Whether ``density`` also returns features.

    Returns
    -------
    samples : RaySamples or None
        Selected samples; None if there are none.
    covered : int
        Number of leading rays that are covered completely.
    """
    steps = find_occupied_steps(rays, table, offset, is_occupied, max_prepass_samples)
    if steps is None:
        return None, rays.count
    ray, t, length, p, covered = steps
    Bool, Float, UInt32 = dr.mask_t(t), type(t), type(ray)
    segments = Segments.find(ray, dr.full(Bool, True, dr.width(t)), rays.count)
    sigma, features = density(p, True) if with_features else (density(p, True), None)
    tau = dr.minimum(sigma * length, 60.0)
    # Evaluate both in one kernel; separate evaluations would evaluate the field twice.
    dr.eval(tau, features)
    before = Float(segments.before(tau))
    light = dr.exp(-before)
    is_kept, thinned = light > min_transmittance, None
    if roulette is not None:
        weight = light * absorbed_fraction(tau)
        probability = dr.clip(weight / roulette.weight, roulette.min_probability, 1)
        ns = namespace(t)
        random = ns.PCG32(dr.width(t), dr.opaque(ns.UInt64, roulette.seed)).next_float32()
        is_kept &= random < probability
        thinned = ThinnedSamples(dr.rcp(probability), before, absorbed_fraction(Float(segments.total(tau))))
        dr.eval(is_kept, thinned.multiplicity, before, thinned.opacity)
    indices = dr.compress(is_kept)
    count, prepass_samples_per_ray = dr.width(indices), dr.width(t) / covered
    if count == 0:
        return None, covered
    if pad is not None and count > pad:
        # The ray at the limit is incomplete; it and all later ones are dropped.
        covered = int(dr.gather(UInt32, ray, dr.gather(UInt32, indices, UInt32(pad))).numpy()[0])
        if covered == 0:
            raise NergError(f"a single ray has more than {pad} samples; increase batch or march_step")

    j = dr.arange(UInt32, pad if pad is not None else count)
    source = dr.gather(UInt32, indices, dr.minimum(j, dr.opaque(UInt32, count - 1)))
    ray = dr.gather(UInt32, ray, source)
    active = (j < dr.opaque(UInt32, count)) & (ray < dr.opaque(UInt32, covered))
    t, length, p = (dr.gather(type(v), v, source) for v in (t, length, p))
    if features is not None:
        features = [dr.gather(type(f), f, source) for f in features]
    if thinned is not None:
        thinned.multiplicity, thinned.before = (
            dr.gather(Float, v, source) for v in (thinned.multiplicity, thinned.before)
        )
        dr.eval(thinned.multiplicity, thinned.before)
    dr.eval(ray, active, t, length, p, features)
    segments = Segments.find(ray, active, rays.count)
    return RaySamples(
        ray, t, length, p, segments, min(count, pad or count), features, thinned, prepass_samples_per_ray
    ), covered
