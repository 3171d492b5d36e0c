"""Kernel densities on the sphere: the bandwidth, the exact estimate in one Dr.Jit kernel, and a table of one
density."""

from __future__ import annotations

import math
import sys
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths import vmf
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.types import Array3f, Float, UInt32
from nerg_mi.maths.vmf import log_normaliser

# ---- Bandwidth ----
#
# How wide a kernel: rules for the concentration κ of a probe's density.
#
# ``silverman``: the published code's rule (:func:`nerg_mi.maths.vmf.silverman_kappa`). ``loo``: the κ under which each
# ray is best predicted by the others. Each for every probe, or one for all of them.

KAPPA_MIN = 1.0
SHARED_KAPPA_PROBES = 256  # probes that speak for all where one κ is sought


def make_kappa_grid(kappa_max: float, kappa_min: float = KAPPA_MIN) -> np.ndarray:
    """Concentrations that ``loo`` chooses from: geometric, 25 % steps."""
    return np.geomspace(kappa_min, kappa_max, max(2, 1 + round(np.log(kappa_max / kappa_min) / np.log(1.25))))


def compute_loo_scores(
    directions: np.ndarray,
    groups: np.ndarray | None,
    grid: np.ndarray,
    *,
    max_rays: int = 256,
    rng: np.random.Generator | None = None,
) -> np.ndarray:
    """Mean log-likelihood a ray at each κ of ``grid`` (K,), natural, of 1/sr: Σ_i log mean_j f(x_i; x_j, κ) / n.

    j runs over rays of other ``groups`` (n,) where there are two or more, else over j ≠ i. Leaving out people and not
    only the ray itself matters at 50 Hz: successive rays repeat each other, and the sharpest κ would win.
    ``directions`` (n, 3) unit, at least two; of more than ``most`` a random choice is used.
    """
    rng = rng or np.random.default_rng(0)
    if len(directions) > max_rays:
        chosen = rng.choice(len(directions), max_rays, replace=False)
        directions, groups = directions[chosen], None if groups is None else np.asarray(groups)[chosen]
    if groups is None or len(np.unique(groups)) < 2:
        groups = np.arange(len(directions))
    others = groups[:, None] != groups[None, :]
    apart = vmf.one_minus_cosine(directions[:, None], directions[None, :])
    apart = np.where(others, apart, np.inf)
    nearest = apart.min(axis=1, keepdims=True)
    log_count = np.log(others.sum(axis=1))
    # exp(-κ (a - a_min)) with the nearest taken out: no ray ever has log 0, and single precision suffices.
    beyond = (apart - nearest).astype(np.float32)
    sums = np.array([np.exp(np.float32(-k) * beyond).sum(axis=1) for k in grid], dtype=np.float64)
    return (np.log(sums) - np.multiply.outer(grid, nearest[:, 0]) - log_count).mean(axis=1) + vmf.log_normaliser(grid)


def select_loo_kappa(
    directions: np.ndarray,
    groups: np.ndarray | None = None,
    *,
    kappa_max: float = 1000.0,
    max_rays: int = 256,
    rng: np.random.Generator | None = None,
) -> float:
    """κ between 1 and ``kappa_max`` under which rays are best predicted by the others; 1 for a ray alone."""
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
    """κ (P,) of probes that hold ``directions[offsets[p]:offsets[p + 1]]`` by ``loo``. ``shared``: one for all, under
    which the rays of 256 probes (at random) are best predicted together."""
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
    """κ (P,) by the published code's rule, at most ``kappa_max``; with ``weights`` (n,) from the weighted mean
    resultant and the effective count (Σw)²/Σw². ``shared``: one for all, 1 over the mean of 1/κ."""
    w = np.ones(len(directions)) if weights is None else weights
    total = np.add.reduceat(w, offsets[:-1])
    count = total**2 / np.add.reduceat(w**2, offsets[:-1])
    resultant = np.linalg.norm(np.add.reduceat(w[:, None] * directions, offsets[:-1]), axis=1) / total
    kappa = np.minimum(vmf.silverman_kappa(np.minimum(resultant, 1.0), np.maximum(count, 1.0)), kappa_max)
    return np.full(len(kappa), 1.0 / np.mean(1.0 / kappa)) if shared else kappa


# ---- Kernel densities on the sphere, evaluated exactly in one Dr.Jit kernel ----
#
# A probe p holds a run of ray directions μ_i with weights w_i that sum to one, and one concentration: p(x) = Σ_i w_i
# f(x; μ_i, κ_p), f von Mises-Fisher (NeRG, Section 5.1). It integrates to one over the sphere whatever κ is.

Backend = str | ModuleType | dr.ArrayBase | None
"""Where a density is evaluated: a name such as ``"llvm"``, a namespace of Dr.Jit's arrays, an array, or None for that
of Mitsuba's variant (:func:`default_backend`)."""

DIRECTIONS_PER_LANE = 16  # Directions that a lane of `SphericalKde.evaluate` takes at once


def get_default_backend() -> str:
    """``"cuda"`` where Mitsuba was switched to a CUDA variant, else ``"llvm"``."""
    mitsuba = sys.modules.get("mitsuba")
    variant = (mitsuba.variant() if mitsuba is not None else None) or ""
    return "cuda" if variant.startswith("cuda") else "llvm"


class SphericalKde:
    """P kernel densities on one Dr.Jit backend.

    ``rays`` (n, 3): unit directions, probe after probe; ``offsets`` (P + 1,): probe p holds
    ``rays[offsets[p]:offsets[p + 1]]``, at least one; ``kappa`` (P,) or a number; ``weights`` (n,) not negative,
    normalised here per probe, or ``None`` for equal ones. ``backend``: see `Backend`. Raises ``ValueError`` for shapes
    that do not fit, `NergError` for a probe without rays, or whose rays all have weight zero.
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
                f"rays {rays.shape} and offsets {offsets.shape} do not fit: offsets run from 0 to the number of rays"
            )
        if counts.min() < 1:
            raise NergError(f"probe {int(np.argmin(counts))} has no ray; raise min_rays")
        kappa = np.broadcast_to(np.asarray(kappa, dtype=np.float64), counts.shape)
        if weights is None:
            share = np.repeat(1.0 / counts, counts)
        else:
            weights = np.asarray(weights, dtype=np.float64)
            if weights.shape != (len(rays),) or not (weights >= 0).all():
                raise ValueError(f"weights {weights.shape} must be {len(rays)} non-negative numbers, one a ray")
            total = np.add.reduceat(weights, offsets[:-1])
            if not (total > 0).all():
                raise NergError(f"the weights of probe {int(np.argmin(total))} are all zero; leave the probe out")
            share = weights / np.repeat(total, counts)

        self.count = len(counts)
        self.ns: ModuleType = backend if isinstance(backend, ModuleType) else namespace(backend or get_default_backend())
        # One packet of four floats a ray: direction and weight come in one gather.
        packed = np.concatenate([rays, share[:, None]], axis=1).astype(np.float32)
        self._rays = self.ns.Float(packed.ravel())
        self._offsets = self.ns.UInt32(offsets.astype(np.uint32))
        self._kappa = self.ns.Float(kappa.astype(np.float32))
        self._log_c = self.ns.Float(log_normaliser(kappa).astype(np.float32))

    @property
    def kappa(self) -> np.ndarray:
        """Concentrations of the kernels, (P,) float32."""
        return np.array(self._kappa)

    def select_range(self, first: int, last: int) -> SphericalKde:
        """The densities of probes ``first`` to ``last`` - 1 as an object of their own."""
        if (first, last) == (0, self.count):
            return self
        offsets = np.array(self._offsets)[first : last + 1].astype(np.int64)
        packed = np.array(self._rays).reshape(-1, 4)[offsets[0] : offsets[-1]]
        return SphericalKde(packed[:, :3], offsets - offsets[0], self.kappa[first:last], packed[:, 3], self.ns)

    def density(self, probe: UInt32, direction: Array3f) -> Float:
        """Density of probe ``probe`` (M lanes) in ``direction`` (unit, M lanes), in 1/sr, M lanes: traced, not
        evaluated. Lanes of one probe should be neighbours: they then share their loop."""
        ns = self.ns
        first = dr.gather(ns.UInt32, self._offsets, probe)
        last = dr.gather(ns.UInt32, self._offsets, probe + 1)
        kappa = dr.gather(ns.Float, self._kappa, probe)
        log_c = dr.gather(ns.Float, self._log_c, probe)

        def body(i, total, direction, kappa, last):
            ray = dr.gather(ns.Array4f, self._rays, i)
            offset = direction - ns.Array3f(ray.x, ray.y, ray.z)
            return i + 1, dr.fma(ray.w, dr.exp(-0.5 * kappa * dr.squared_norm(offset)), total), direction, kappa, last

        _, total, *_ = dr.while_loop(
            state=(first, dr.zeros(ns.Float, dr.width(direction)), ns.Array3f(direction), kappa, last),
            cond=lambda i, total, direction, kappa, last: i < last,
            body=body,
            labels=("i", "total", "direction", "kappa", "last"),
            label="spherical KDE",
        )
        return total * dr.exp(log_c)

    def evaluate(self, directions: np.ndarray) -> np.ndarray:
        """Densities of every probe in many directions, (P, D) float32, 1/sr, in one kernel.

        ``directions``: (D, 3), the same for all, or (P, D, 3), each its own.
        """
        directions = np.asarray(directions, dtype=np.float32)
        if (
            directions.shape[-1:] != (3,)
            or directions.ndim not in (2, 3)
            or (directions.ndim == 3 and len(directions) != self.count)
        ):
            raise ValueError(f"directions have shape {directions.shape}, expected (D, 3) or ({self.count}, D, 3)")
        # A lane takes several directions of one probe, so that a ray is fetched once for all of them: four times as
        # fast.
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
        last = dr.gather(ns.UInt32, self._offsets, probe + 1)

        def body(i, total):
            ray = dr.gather(ns.Array4f, self._rays, i)
            mu = ns.Array3f(ray.x, ray.y, ray.z)
            return i + 1, [dr.fma(ray.w, dr.exp2(scale * dr.squared_norm(a - mu)), t) for a, t in zip(x, total)]

        _, total = dr.while_loop(
            state=(dr.gather(ns.UInt32, self._offsets, probe), [dr.zeros(ns.Float, dr.width(lane)) for _ in x]),
            cond=lambda i, total: i < last,
            body=body,
            label="spherical KDE of many directions",
        )
        c = dr.exp(dr.gather(ns.Float, self._log_c, probe))
        total = [t * c for t in total]
        dr.eval(total)
        return np.stack([np.array(t) for t in total], axis=-1).reshape(self.count, groups * G)[:, :D]


# ---- Table ----
#
# One kernel density on a table over the sphere: as good as exact for pictures, and for any number of directions.
#
# A density of kernels is smooth on the scale 1/sqrt(κ). So it is evaluated exactly at the texels of a cube map whose
# spacing is a fraction of that, and in between by cubic interpolation: a lookup costs sixteen values, however many rays
# the probe holds.

TEXEL_SPACING = 0.15
"""Texels' distance in units of 1/sqrt(κ). The error of the cubic interpolation goes with its fourth power; at 0.15 it
is below 1e-4 of the highest density that the kernel of one ray reaches (measured in the tests)."""
_PAD = 2  # texels that a face has beyond its edge, so that the interpolation never crosses from one face to another
_MOST = 4096


class SphericalKdeTable:
    """The density of probe ``probe`` of ``kde``, tabulated.

    ``used`` (N, 3): the directions that will be asked for, where they are known; other texels are then not evaluated,
    and lookups there are wrong. A face of the cube is divided in equal angles, u = (4/π) atan(x/z). Raises
    ``ValueError`` for a concentration whose texels would be too many (above about 1.5e5).
    """

    def __init__(
        self, kde: SphericalKde, probe: int = 0, directions: np.ndarray | None = None, spacing: float = TEXEL_SPACING
    ) -> None:
        self.ns = ns = kde.ns
        kappa = float(kde.kappa[probe])
        self.resolution = n = _texels(kappa, spacing)
        if n > _MOST:
            raise ValueError(
                f"κ = {kappa:.3g} needs {6 * n * n:,} texels; evaluate the density directly (SphericalKde.evaluate)"
            )
        self.padded_resolution = n + 2 * _PAD
        wanted = np.ones((6, self.padded_resolution, self.padded_resolution), bool) if directions is None else self._touched(directions)
        at = np.flatnonzero(wanted.ravel())
        face, row = np.divmod(at, self.padded_resolution * self.padded_resolution)
        j, i = np.divmod(row, self.padded_resolution)
        angle = lambda k: np.tan(0.25 * math.pi * ((k - _PAD + 0.5) * 2.0 / n - 1.0))
        values = np.zeros(wanted.size, np.float32)
        values[at] = kde.select_range(probe, probe + 1).evaluate(_from_face(face, angle(i), angle(j)))[0]
        self.num_evaluated = len(at)
        self._values = ns.Float(values)

    @staticmethod
    def is_worthwhile(kde: SphericalKde, count: int) -> bool:
        """Whether a table of the first probe has texels no denser than ``count`` directions over the sphere."""
        n = _texels(float(kde.kappa[0]), TEXEL_SPACING)
        return n <= _MOST and 6 * n * n <= 16 * count

    def _touched(self, directions: np.ndarray) -> np.ndarray:
        """Texels (6, width, width) that lookups in ``directions`` read."""
        ns = self.ns
        hit = dr.zeros(ns.UInt32, 6 * self.padded_resolution * self.padded_resolution)
        first = self._cell(to_vector(ns.Array3f, directions.reshape(-1, 3)))[0]
        dr.scatter(hit, ns.UInt32(1), first)
        corner = np.array(hit).reshape(6, self.padded_resolution, self.padded_resolution) > 0
        out = corner.copy()
        for dj in range(4):
            for di in range(4):
                out[:, dj:, di:] |= corner[:, : self.padded_resolution - dj, : self.padded_resolution - di]
        return out

    def _cell(self, d: Array3f) -> tuple[UInt32, list[Float]]:
        """Index of the first of a lookup's 4 x 4 texels, and where between the middle ones it lies, in [0, 1)."""
        ns = self.ns
        a = dr.abs(d)
        on_x, on_y = (a.x >= a.y) & (a.x >= a.z), (a.y > a.x) & (a.y >= a.z)
        major = dr.select(on_x, d.x, dr.select(on_y, d.y, d.z))
        face = dr.select(on_x, ns.UInt32(0), dr.select(on_y, ns.UInt32(2), ns.UInt32(4)))
        face += dr.select(major < 0, ns.UInt32(1), ns.UInt32(0))
        u = dr.select(on_x, d.y, d.x) / dr.abs(major)
        v = dr.select(on_x | on_y, d.z, d.y) / dr.abs(major)
        place = [dr.fma(dr.atan(w), 2.0 / math.pi, 0.5) * self.resolution + (_PAD - 0.5) for w in (u, v)]
        whole = [dr.clip(dr.floor(p), 1, self.padded_resolution - 3) for p in place]
        i, j = (ns.UInt32(w) - 1 for w in whole)
        return (face * self.padded_resolution + j) * self.padded_resolution + i, [p - w for p, w in zip(place, whole)]

    def density(self, direction: Array3f) -> Float:
        """Density in ``direction`` (unit), in 1/sr: traced, not evaluated, differentiable."""
        first, (s, t) = self._cell(direction)
        ws, wt = _cubic(s), _cubic(t)
        total: Any = 0
        for j in range(4):
            row = 0
            for i in range(4):
                row = dr.fma(dr.gather(self.ns.Float, self._values, first + (j * self.padded_resolution + i)), ws[i], row)
            total = dr.fma(row, wt[j], total)
        return dr.maximum(total, 0)  # Interpolation may fall below zero by the size of its error

    def evaluate(self, directions: np.ndarray) -> np.ndarray:
        """Densities (N,) float32 in ``directions`` (N, 3), 1/sr."""
        d = to_vector(self.ns.Array3f, directions)
        return np.array(self.density(d))


def _texels(kappa: float, spacing: float) -> int:
    """Texels along a face's edge."""
    return max(8, math.ceil(0.5 * math.pi / spacing * math.sqrt(kappa)))


def _cubic(t: Float) -> tuple[Float, Float, Float, Float]:
    """Weights of four equidistant values at -1, 0, 1, 2 (Lagrange) for a place t between the middle two."""
    a, b, c = t + 1, t - 1, t - 2
    return -t * b * c / 6, a * b * c / 2, -a * t * c / 2, a * t * b / 6


def _from_face(face: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Unit directions (N, 3) of places on the cube's faces +x, -x, +y, -y, +z, -z."""
    out = np.empty((len(face), 3))
    axis = face // 2
    n = np.arange(len(face))
    out[n, axis] = np.where(face % 2, -1.0, 1.0)
    out[n, np.where(axis == 0, 1, 0)] = u
    out[n, np.where(axis == 2, 1, 2)] = v
    return out / np.linalg.norm(out, axis=1, keepdims=True)
