"""Kernel density estimates on the sphere: bandwidth selection, exact evaluation in one Dr.Jit kernel, and
tabulation."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths import vmf
from nerg_mi.maths.arrays import check_weights, copy_aligned, kahan_add, to_vector
from nerg_mi.maths.types import Array3f, Float, UInt32
from nerg_mi.maths.vmf import log_normaliser

from .mlp import namespace

# ---- Bandwidth ----
#
# Rules for the concentration κ of the kernels of a probe.
#
# ``silverman`` is the rule of the published code (:func:`nerg_mi.maths.vmf.silverman_kappa`). ``loo`` maximises the
# leave-one-out likelihood. Both select κ for each probe, or one value for all probes.

KAPPA_MIN = 1.0
SHARED_KAPPA_PROBES = 256  # Probes sampled to select one common κ


def make_kappa_grid(kappa_max: float, kappa_min: float = KAPPA_MIN) -> np.ndarray:
    """Return the candidate concentrations of ``loo``: a geometric grid with steps of 25 %."""
    return np.geomspace(kappa_min, kappa_max, max(2, 1 + round(np.log(kappa_max / kappa_min) / np.log(1.25))))


def compute_loo_scores(
    directions: np.ndarray,
    groups: np.ndarray | None,
    grid: np.ndarray,
    *,
    max_rays: int = 256,
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Compute the leave-one-out log-likelihood per ray for each κ of ``grid``: Σ_i log mean_j f(x_i; x_j, κ) / n.

    Parameters
    ----------
    directions : numpy.ndarray
        Unit directions (n, 3), at least two.
    groups : numpy.ndarray, optional
        Group (n,) of each ray, such as its participant. j runs over rays of other groups if there are two or more,
        otherwise over j ≠ i.
    grid : numpy.ndarray
        Concentrations (K,).
    max_rays : int
        If there are more rays, a random subset is used.
    rng : numpy.random.Generator, optional
        Random numbers of the subset.

    Returns
    -------
    numpy.ndarray
        Scores (K,) in nats of 1/sr.

    Notes
    -----
    At 50 Hz successive rays are nearly equal, so leaving out only the ray itself would select the largest κ. Therefore
    whole participants are left out.
    """
    rng = rng or np.random.default_rng(0)
    if len(directions) > max_rays:
        subset = rng.choice(len(directions), max_rays, replace=False)
        directions, groups = directions[subset], None if groups is None else np.asarray(groups)[subset]
    if groups is None or len(np.unique(groups)) < 2:
        groups = np.arange(len(directions))
    is_other_group = groups[:, None] != groups[None, :]
    distance = vmf.one_minus_cosine(directions[:, None], directions[None, :])
    distance = np.where(is_other_group, distance, np.inf)
    nearest = distance.min(axis=1, keepdims=True)
    log_count = np.log(is_other_group.sum(axis=1))
    # exp(-κ (a - a_min)) relative to the nearest ray: no ray has log 0, and single precision suffices.
    excess = (distance - nearest).astype(np.float32)
    sums = np.array([np.exp(np.float32(-k) * excess).sum(axis=1) for k in grid], dtype=np.float64)
    return (np.log(sums) - np.multiply.outer(grid, nearest[:, 0]) - log_count).mean(axis=1) + vmf.log_normaliser(grid)


def select_loo_kappa(
    directions: np.ndarray,
    groups: np.ndarray | None = None,
    *,
    kappa_max: float = 1000.0,
    max_rays: int = 256,
    rng: np.random.Generator | None = None,
) -> float:
    """Select κ of one probe, between 1 and ``kappa_max``, by leave-one-out likelihood; 1 for a single ray. The other
    arguments are those of `compute_loo_scores`."""
    if len(directions) < 2:
        return KAPPA_MIN
    grid = make_kappa_grid(kappa_max)
    return float(grid[int(np.argmax(compute_loo_scores(directions, groups, grid, max_rays=max_rays, rng=rng)))])


def select_loo_kappas(
    directions: np.ndarray,
    persons: np.ndarray,
    offsets: np.ndarray,
    kappa_max: float,
    shared: bool,
    rng: np.random.Generator,
) -> np.ndarray:
    """Select the concentration κ of each of P probes by leave-one-out likelihood, (P,).

    Probe p holds the unit directions ``directions[offsets[p]:offsets[p + 1]]`` of the participants ``persons`` (n,). A
    ray is compared with those of other participants, or with all others if there is one participant. κ is between 1
    and ``kappa_max``. With ``shared`` one κ maximises the joint likelihood of 256 probes that are drawn with ``rng``.
    """
    runs = [slice(a, b) for a, b in zip(offsets[:-1], offsets[1:])]
    if not shared:
        return np.array([select_loo_kappa(directions[r], persons[r], kappa_max=kappa_max, rng=rng) for r in runs])
    grid, total = make_kappa_grid(kappa_max), 0.0
    for p in rng.permutation(len(runs))[:SHARED_KAPPA_PROBES]:
        if runs[p].stop - runs[p].start > 1:
            total = total + compute_loo_scores(directions[runs[p]], persons[runs[p]], grid, rng=rng)
    best = grid[int(np.argmax(total))] if np.ndim(total) else KAPPA_MIN
    return np.full(len(runs), float(best))


def compute_silverman_kappas(
    directions: np.ndarray, weights: np.ndarray | None, offsets: np.ndarray, kappa_max: float, shared: bool
) -> np.ndarray:
    """Compute the concentration κ of each of P probes by the rule of the published code, at most ``kappa_max``, (P,).

    Probe p holds the unit directions ``directions[offsets[p]:offsets[p + 1]]``. With ``weights`` (n,) the rule uses the
    weighted mean resultant length and the effective count (Σw)²/Σw². With ``shared`` all probes have one κ, 1 over the
    mean of 1/κ.
    """
    w = np.ones(len(directions)) if weights is None else weights
    total = np.add.reduceat(w, offsets[:-1])
    count = total**2 / np.add.reduceat(w**2, offsets[:-1])
    resultant = np.linalg.norm(np.add.reduceat(w[:, None] * directions, offsets[:-1]), axis=1) / total
    kappa = np.minimum(vmf.silverman_kappa(np.minimum(resultant, 1.0), np.maximum(count, 1.0)), kappa_max)
    return np.full(len(kappa), 1.0 / np.mean(1.0 / kappa)) if shared else kappa


# ---- Kernel densities on the sphere, evaluated exactly in one Dr.Jit kernel ----
#
# Probe p holds ray directions μ_i with weights w_i that sum to one, and one concentration: p(x) = Σ_i w_i f(x; μ_i,
# κ_p), where f is the von Mises-Fisher density (NeRG, Section 5.1). It integrates to one over the sphere for any κ.

Backend = str | ModuleType | dr.ArrayBase | None
"""Dr.Jit backend (LLVM or CUDA) on which a density is evaluated: a name such as ``"llvm"``, a Dr.Jit namespace, a
Dr.Jit array of that backend, or None for the backend of Mitsuba's variant (:func:`get_default_backend`).
"""

DIRECTIONS_PER_LANE = 16  # Directions evaluated by one lane of `SphericalKde.evaluate`
RAYS_PER_BLOCK = 256  # Rays whose terms are added without compensation: a relative error of up to 4e-6


def get_default_backend() -> str:
    """Return ``"cuda"`` if a CUDA variant of Mitsuba is active, otherwise ``"llvm"``."""
    mitsuba = sys.modules.get("mitsuba")
    variant = (mitsuba.variant() if mitsuba is not None else None) or ""
    return "cuda" if variant.startswith("cuda") else "llvm"


class SphericalKde:
    """P kernel density estimates on one Dr.Jit backend.

    Parameters
    ----------
    rays : numpy.ndarray
        Unit directions (n, 3), probe after probe.
    offsets : numpy.ndarray
        Offsets (P + 1,): probe p holds ``rays[offsets[p]:offsets[p + 1]]``, at least one ray.
    kappa : numpy.ndarray or float
        Concentrations (P,) of the kernels.
    weights : numpy.ndarray, optional
        Non-negative weights (n,), normalised per probe. Default: equal.
    backend : Backend
        Dr.Jit backend (LLVM or CUDA) on which the densities are evaluated. Default: that of Mitsuba's variant.

    Raises
    ------
    ValueError
        If the shapes do not match.
    NergError
        If a probe has no rays, or only rays with weight zero, and for values that are not finite or negative.
    """

    def __init__(
        self,
        rays: np.ndarray,
        offsets: np.ndarray,
        kappa: np.ndarray | float,
        weights: np.ndarray | None = None,
        backend: Backend = None,
    ) -> None:
        rays, offsets = np.asarray(rays, dtype=np.float64), np.asarray(offsets, dtype=np.int64)
        counts = np.diff(offsets)
        if (
            rays.ndim != 2
            or rays.shape[1] != 3
            or offsets.ndim != 1
            or len(counts) == 0
            or offsets[0] != 0
            or offsets[-1] != len(rays)
        ):
            raise ValueError(
                f"rays {rays.shape} and offsets {offsets.shape} do not match: offsets must run from 0 to the number of "
                "rays"
            )
        if counts.min() < 1:
            raise NergError(f"probe {int(np.argmin(counts))} has no rays; increase min_rays")
        kappa = np.broadcast_to(np.asarray(kappa, dtype=np.float64), counts.shape)
        if not np.isfinite(rays).all() or not (np.isfinite(kappa) & (kappa >= 0)).all():
            raise NergError(
                "the directions and concentrations of kernels must be finite, and concentrations not negative"
            )
        if weights is None:
            ray_weights = np.repeat(1.0 / counts, counts)
        else:
            weights = check_weights(weights, len(rays))
            total = np.add.reduceat(weights, offsets[:-1])
            if not (total > 0).all():
                raise NergError(f"all weights of probe {int(np.argmin(total))} are zero; remove the probe")
            ray_weights = weights / np.repeat(total, counts)

        self.count = len(counts)
        self.ns: ModuleType = (
            backend if isinstance(backend, ModuleType) else namespace(backend or get_default_backend())
        )
        # Four floats per ray, so that direction and weight are loaded by one gather.
        packed = np.concatenate([rays, ray_weights[:, None]], axis=1)
        # Aligned alike for all probes: recordings of dr.freeze distinguish arrays by their alignment.
        self._rays = self.ns.Float(copy_aligned(packed.ravel(), np.float32))
        self._offsets = self.ns.UInt32(copy_aligned(offsets, np.uint32))
        # Also kept here: to read it from a device would wait for all kernels.
        self.kappa = copy_aligned(kappa, np.float32)
        """Concentration κ of the von Mises-Fisher kernel of each of the P probes, (P,) float32."""
        self._kappa = self.ns.Float(self.kappa)
        self._log_c = self.ns.Float(copy_aligned(log_normaliser(kappa), np.float32))

    def select_range(self, first: int, last: int) -> SphericalKde:
        """Return the kernel density estimates of the probes with indices ``first`` to ``last`` - 1."""
        if (first, last) == (0, self.count):
            return self
        offsets = np.array(self._offsets)[first : last + 1].astype(np.int64)
        packed = np.array(self._rays).reshape(-1, 4)[offsets[0] : offsets[-1]]
        return SphericalKde(packed[:, :3], offsets - offsets[0], self.kappa[first:last], packed[:, 3], self.ns)

    def density(self, probe: UInt32, direction: Array3f) -> Float:
        """Evaluate M densities of single probes in single directions. The computation is traced, not started.

        Parameters
        ----------
        probe
            Index of the probe, 0 to P - 1, of each of M lanes.
        direction
            Unit direction of each lane.

        Returns
        -------
        Float
            Density in 1/sr of each lane.

        Notes
        -----
        The order of the lanes does not change the result. It is faster if lanes of the same probe are adjacent: lanes
        of one SIMD packet or warp loop over the rays of their probes together.
        """
        ns = self.ns
        first = dr.gather(ns.UInt32, self._offsets, probe)
        last = dr.gather(ns.UInt32, self._offsets, probe + 1)
        kappa = dr.gather(ns.Float, self._kappa, probe)
        log_c = dr.gather(ns.Float, self._log_c, probe)

        def add(ray, total, direction, kappa):
            offset = direction - ns.Array3f(ray.x, ray.y, ray.z)
            return [dr.fma(ray.w, dr.exp(-0.5 * kappa * dr.squared_norm(offset)), total[0])]

        zero = dr.zeros(ns.Float, dr.width(direction))
        (total,) = self._sum_rays(first, last, [zero], add, ns.Array3f(direction), kappa)
        return total * dr.exp(log_c)

    def _sum_rays(self, first: UInt32, last: UInt32, zeros: list[Float], add: Callable[..., list[Float]], *values: Any):
        """Sum over the rays ``first`` to ``last`` - 1: ``add(ray, sums, *values)`` returns ``sums`` with one more ray.

        Blocks of rays are summed, and then their sums with compensation. A million plain additions in single precision
        would have a relative error of 1 %.
        """
        ns = self.ns

        def add_ray(i, end, sums, values):
            return i + 1, end, add(dr.gather(ns.Array4f, self._rays, i), sums, *values), values

        def add_block(i, last, totals, compensations, values):
            state = i, dr.minimum(i + RAYS_PER_BLOCK, last), [dr.zeros(ns.Float, dr.width(z)) for z in zeros], values
            i, _, sums, values = dr.while_loop(state, lambda i, end, *_: i < end, add_ray, label="block of rays")
            pairs = [kahan_add(*terms) for terms in zip(totals, compensations, sums)]
            return i, last, [total for total, _ in pairs], [compensation for _, compensation in pairs], values

        state = first, last, zeros, [ns.Float(zero) for zero in zeros], list(values)
        # An enclosing derivative, of which this sum may be no part, evaluates loops: each ray would be a kernel.
        is_symbolic = dr.flag(dr.JitFlag.SymbolicLoops) or not dr.grad_enabled(values)
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, is_symbolic):
            return dr.while_loop(state, lambda i, last, *_: i < last, add_block, label="spherical KDE")[2]

    def evaluate(self, directions: np.ndarray) -> np.ndarray:
        """Evaluate the densities of all probes in many directions in one kernel.

        Parameters
        ----------
        directions : numpy.ndarray
            Unit directions (D, 3), common to all probes, or (P, D, 3).

        Returns
        -------
        numpy.ndarray
            Densities (P, D) in 1/sr, float32.
        """
        directions = np.asarray(directions, dtype=np.float32)
        if (
            directions.shape[-1:] != (3,)
            or directions.ndim not in (2, 3)
            or (directions.ndim == 3 and len(directions) != self.count)
        ):
            raise ValueError(f"directions have shape {directions.shape}; expected (D, 3) or ({self.count}, D, 3)")
        # A lane evaluates several directions of one probe, so that each ray is loaded once for all of them: four times
        # as fast.
        D = directions.shape[-2]
        G = min(DIRECTIONS_PER_LANE, D)
        groups = -(-D // G)
        ns = self.ns
        lane = dr.arange(ns.UInt32, self.count * groups)
        probe = lane // groups
        first = (lane - probe * groups) * G
        base = 0 if directions.ndim == 2 else probe * D
        flat = ns.Float(np.ascontiguousarray(directions).ravel())
        x = [dr.gather(ns.Array3f, flat, base + dr.minimum(first + j, D - 1)) for j in range(G)]
        scale = dr.gather(ns.Float, self._kappa, probe) * (-0.5 / math.log(2.0))
        start, end = (dr.gather(ns.UInt32, self._offsets, probe + k) for k in range(2))

        def add(ray, total):
            mu = ns.Array3f(ray.x, ray.y, ray.z)
            return [dr.fma(ray.w, dr.exp2(scale * dr.squared_norm(a - mu)), t) for a, t in zip(x, total)]

        total = self._sum_rays(start, end, [dr.zeros(ns.Float, dr.width(lane)) for _ in x], add)
        c = dr.exp(dr.gather(ns.Float, self._log_c, probe))
        total = [t * c for t in total]
        dr.eval(total)
        return np.stack([np.array(t) for t in total], axis=-1).reshape(self.count, groups * G)[:, :D]


# ---- Table ----
#
# One kernel density tabulated over the sphere, practically exact for pictures and independent of the number of
# directions.
#
# A kernel density is smooth on the scale 1/sqrt(κ). It is evaluated at the texels of a cube map with a spacing of a
# fraction of that scale, as the sum of the kernels that are not negligible there, and interpolated cubically in
# between: a lookup reads sixteen values, however many rays the probe holds.

TEXEL_SPACING = 0.15
"""Distance of the texels in units of 1/sqrt(κ). The error of cubic interpolation scales with its fourth power; at 0.15
it is below 1e-4 of the maximum of a single kernel (measured in the tests).
"""
_PADDING = 2  # Padding of a face in texels, so that the interpolation never crosses faces
_MAX_RESOLUTION = 4096
_NEGLIGIBLE_EXPONENT = 11.0  # Kernels are neglected below 2e-5 of their maximum
_MAX_CELLS = 128  # Maximum number of cells along an axis


class SphericalKdeTable:
    """The density of probe ``probe`` of ``kde``, tabulated on a cube map.

    Parameters
    ----------
    kde : SphericalKde
        Kernel densities.
    probe : int
        Index of the probe.
    spacing : float
        Distance of the texels in units of 1/sqrt(κ).

    Raises
    ------
    ValueError
        If the concentration needs too many texels (κ above about 1.5e5).

    Notes
    -----
    A face of the cube is divided into equal angles, u = (4/π) atan(x/z).
    """

    def __init__(self, kde: SphericalKde, probe: int = 0, spacing: float = TEXEL_SPACING) -> None:
        self.ns = ns = kde.ns
        kappa = float(kde.kappa[probe])
        self.resolution = n = _count_texels(kappa, spacing)
        if n > _MAX_RESOLUTION:
            raise ValueError(
                f"κ = {kappa:.3g} needs {6 * n * n:,} texels; evaluate the density directly (SphericalKde.evaluate)"
            )
        self.padded_resolution = width = n + 2 * _PADDING
        texel = dr.arange(ns.UInt32, 6 * width * width)
        row, column = (texel // width) % width, texel % width
        centres = ns.Float(np.tan(0.25 * math.pi * ((np.arange(width) - _PADDING + 0.5) * 2 / n - 1)))
        u, v = (dr.gather(ns.Float, centres, k) for k in (column, row))
        direction = ns.Array3f(*_to_direction(texel // (width * width), u, v))
        self._values = _sum_near_rays(kde.select_range(probe, probe + 1), direction)
        dr.eval(self._values)

    @staticmethod
    def is_worthwhile(kde: SphericalKde, count: int) -> bool:
        """Return whether a table of the first probe is at most as dense as ``count`` directions over the sphere."""
        n = _count_texels(float(kde.kappa[0]), TEXEL_SPACING)
        return n <= _MAX_RESOLUTION and 6 * n * n <= 16 * count

    def _locate(self, d: Array3f) -> tuple[UInt32, list[Float]]:
        """Return the index of the first of a lookup's 4 x 4 texels, and the position between the middle ones in [0,
        1)."""
        ns = self.ns
        a = dr.abs(d)
        on_x, on_y = (a.x >= a.y) & (a.x >= a.z), (a.y > a.x) & (a.y >= a.z)
        major = dr.select(on_x, d.x, dr.select(on_y, d.y, d.z))
        face = dr.select(on_x, ns.UInt32(0), dr.select(on_y, ns.UInt32(2), ns.UInt32(4)))
        face += dr.select(major < 0, ns.UInt32(1), ns.UInt32(0))
        u = dr.select(on_x, d.y, d.x) / dr.abs(major)
        v = dr.select(on_x | on_y, d.z, d.y) / dr.abs(major)
        position = [dr.fma(dr.atan(w), 2.0 / math.pi, 0.5) * self.resolution + (_PADDING - 0.5) for w in (u, v)]
        base = [dr.clip(dr.floor(p), 1, self.padded_resolution - 3) for p in position]
        i, j = (ns.UInt32(w) - 1 for w in base)
        return (face * self.padded_resolution + j) * self.padded_resolution + i, [p - w for p, w in zip(position, base)]

    def density(self, direction: Array3f) -> Float:
        """Density in 1/sr in the unit ``direction`` of each lane. The computation is traced, not started, and is
        differentiable."""
        first, (s, t) = self._locate(direction)
        ws, wt = _cubic_weights(s), _cubic_weights(t)
        total: Any = 0
        for j in range(4):
            row = 0
            for i in range(4):
                row = dr.fma(
                    dr.gather(self.ns.Float, self._values, first + (j * self.padded_resolution + i)), ws[i], row
                )
            total = dr.fma(row, wt[j], total)
        return dr.maximum(total, 0)  # Interpolation errors may make the density negative

    def evaluate(self, directions: np.ndarray) -> np.ndarray:
        """Evaluate the density of the tabulated probe in unit ``directions`` (N, 3); returns (N,) float32 in 1/sr."""
        d = to_vector(self.ns.Array3f, directions)
        return np.array(self.density(d))


def _count_texels(kappa: float, spacing: float) -> int:
    """Return the number of texels along the edge of a face."""
    return max(8, math.ceil(0.5 * math.pi / spacing * math.sqrt(kappa)))


def _cubic_weights(t: Float) -> tuple[Float, Float, Float, Float]:
    """Return the Lagrange weights of four equidistant values at -1, 0, 1, 2 for a position t between the middle two."""
    a, b, c = t + 1, t - 1, t - 2
    return -t * b * c / 6, a * b * c / 2, -a * t * c / 2, a * t * b / 6


def _to_direction(face: UInt32, u: Float, v: Float) -> tuple[Float, Float, Float]:
    """Return the unit directions of positions on the cube faces +x, -x, +y, -y, +z, -z."""
    sign = 1 - 2 * type(u)(face & 1)
    on_x, on_z = face < 2, face >= 4
    x = dr.select(on_x, sign, u)
    y = dr.select(on_x, u, dr.select(on_z, v, sign))
    z = dr.select(on_z, sign, v)
    length = dr.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length


def _sum_near_rays(kde: SphericalKde, direction: Array3f) -> Float:
    """Evaluate the density of a single probe in each of the unit directions ``direction``, without rays whose kernels
    are negligible there.

    The rays are sorted into cubic cells whose edge is the distance beyond which a kernel is negligible. A direction
    needs those of its cell and of the adjacent ones: nine runs, since the cells of a row follow each other.
    """
    ns, kappa = kde.ns, float(kde.kappa[0])
    count = int(np.clip(2.0 / math.sqrt(2.0 * _NEGLIGIBLE_EXPONENT / max(kappa, 1e-6)), 1, _MAX_CELLS))
    packed = np.array(kde._rays).reshape(-1, 4)
    cell = np.clip((packed[:, :3] + 1) * (0.5 * count), 0, count - 1).astype(np.int64) @ (1, count, count * count)
    order = np.argsort(cell, kind="stable")
    rays = SphericalKde(packed[order, :3], np.array([0, len(packed)]), kappa, packed[order, 3], ns)
    starts = ns.UInt32(np.searchsorted(cell[order], np.arange(count**3 + 1)).astype(np.uint32))
    x, y, z = (ns.UInt32(dr.clip((w + 1) * (0.5 * count), 0, count - 1)) for w in direction)
    left, right = dr.maximum(x, 1) - 1, dr.minimum(x + 2, count)
    zero = dr.zeros(ns.Float, dr.width(direction))

    def add(ray, total, direction):
        offset = direction - ns.Array3f(ray.x, ray.y, ray.z)
        return [dr.fma(ray.w, dr.exp(-0.5 * kappa * dr.squared_norm(offset)), total[0])]

    def add_run(k, total, direction, y, z, left, right):
        row, layer = y + k % 3, z + k // 3  # One more than their index
        is_inside = (row >= 1) & (row <= count) & (layer >= 1) & (layer <= count)
        base = ((layer - 1) * count + row - 1) * count
        first, last = (dr.gather(ns.UInt32, starts, base + end, is_inside) for end in (left, right))
        (part,) = rays._sum_rays(first, last, [zero], add, direction)
        return k + 1, total + part, direction, y, z, left, right

    state = dr.zeros(ns.UInt32, dr.width(direction)), zero, direction, y, z, left, right
    total = dr.while_loop(state, lambda k, *_: k < 9, add_run, label="near rays")[1]
    return total * float(np.exp(log_normaliser(kappa)))
