"""Re-aimed hits: the part of a gaze field that is a mixture of kernel densities of training samples.

q(r_o | p_o) = Σ_k v_k q_k(r_o | p_o) / Σ_k v_k
q_k(r_o | p_o) = u / 4π + (1 - u) Σ_j w_j f(r_o; a_j, κ_k) / Σ_j w_j,
w_j = exp(-|o_j - p_o|² / 2b_k²),  a_j = (h_j - p_o) / |h_j - p_o|,  u = 1 - exp(-min_j |o_j - p_o|² / 2R²)

Sample j was recorded at o_j and hit a surface at h_j. Seen from the observer p_o, it points in the direction a_j, so
that the kernels f (von Mises-Fisher, concentration κ) follow the parallax of the surfaces. Without the re-aiming it is
the conditional kernel density of Rosenblatt (1969). It resolves what attracts attention as finely as the samples do,
but says little where nobody stood nearby, where the networks of a gaze field still generalise: farther from all
samples than half the diagonal R of their bounding box it becomes uniform. A gaze field
mixes both, with kernels of several bandwidths b and concentrations κ, whose weights v are fitted
(`nerg_mi.train.stacking`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from types import ModuleType
from typing import Any, NamedTuple

import drjit as dr
import numpy as np

from nerg_mi.maths.arrays import copy_aligned
from nerg_mi.maths.sphere import aim
from nerg_mi.maths.types import Float, Point3f, Vector3f
from nerg_mi.maths.vmf import log_normaliser
from nerg_mi.ranges import KAPPAS, LENGTHS, MAX_COORDINATE

from .kde import SphericalKde, SphericalKdeTable

MAX_HITS = 1 << 15  # Maximum number of samples that a field stores, 24 bytes each
MAX_KERNELS = 64  # Maximum number of kernels
# Maximum number of samples that an observer's density is the sum of. They are the nearest ones: of all samples for a
# small bandwidth, and of a random subset if more are within _NEIGHBOURHOOD bandwidths.
MAX_NEIGHBOURS = 1024
_NEIGHBOURHOOD = 2.5  # Bandwidths
_BLOCK = 64  # Observers whose kernels are evaluated together
_NUM_THINNING_CENTRES = 256  # Samples at which neighbours are counted
FAR = 1e4  # Maximum distance, in bandwidths, at which the point of a sample without a hit is placed
# Distance from the observer, in bandwidths, below which the direction to a point is that of the recording: the gaze on
# a nearby point says nothing about observers next to it.
_MIN_DISTANCE = 0.25
_UNIFORM = 1 / (4 * np.pi)  # 1/sr
_TABLE_SPACING = 0.2  # Texels of a table in units of 1/sqrt(κ): errors below 3e-4 of the maximum of a kernel
_MIN_TABLE_LANES = 8192  # Number of directions below which a table is not considered


class HitKernel(NamedTuple):
    """One of the kernel densities that re-aimed hits mix."""

    weight: float  # Weight of its density in the gaze field
    bandwidth: float  # Standard deviation of the weights over the distance between observers, in the field's units
    kappa: float  # Concentration of the kernels


class HitNeighbours(NamedTuple):
    """The k samples nearest to each of P positions."""

    directions: np.ndarray  # Unit directions from the position to the hit point (P, k, 3)
    weights: np.ndarray  # (P, k)
    inverse_distance: np.ndarray  # Inverse distance of the hit point (P, k); 0 for a direction of the recording
    offsets: np.ndarray  # From the position to the origin of the sample (P, k, 3), nearest first
    uniform_weight: np.ndarray  # Weight (P,) of the uniform density far from all samples


class _NearestSamples(NamedTuple):
    """The k samples nearest to each of P positions, before they are weighted."""

    distance: np.ndarray  # From the position to the origin of the sample (P, k), nearest first
    offsets: np.ndarray  # The same as a vector (P, k, 3)
    to_point: np.ndarray  # From the position to the hit point (P, k, 3)
    recorded: np.ndarray  # Recorded directions (P, k, 3)

    def weigh(self, bandwidth: float, extent: float) -> HitNeighbours:
        # Relative to the nearest sample, so that the weights do not vanish far from all samples.
        weights = np.exp(0.5 * (self.distance[:, :1] ** 2 - self.distance**2) / bandwidth**2)
        min_distance = _MIN_DISTANCE * bandwidth
        directions = aim(self.to_point, self.recorded, np.zeros(3, np.float32), min_distance)
        weights *= directions.any(axis=-1)
        # If no sample has a direction, there is nothing to aim at; the density must still be one.
        is_lost = ~weights.any(axis=1)
        directions[is_lost, 0], weights[is_lost, 0] = (0, 0, 1), 1
        length = np.linalg.norm(self.to_point, axis=-1)
        inverse = np.where(length > min_distance, 1 / np.maximum(length, min_distance), 0)
        uniform_weight = -np.expm1(-0.5 * (self.distance[:, 0] / extent) ** 2)
        return HitNeighbours(directions, weights.astype(np.float32), inverse, self.offsets, uniform_weight)


class ReaimedHits:
    """Hit points of training samples, whose density is mixed into a gaze field.

    Parameters
    ----------
    origins : array (n, 3)
        Positions of the observers of the samples, in the field's frame and units.
    points : array (n, 3)
        Hit points; `place_missing_points` replaces missing ones.
    kernels : sequence of HitKernel
        Kernel densities, whose weights sum to at most one.

    Raises
    ------
    ValueError
        For arrays that do not match or are not finite, and for kernels out of range.
    """

    # Only the kernels are evaluated on devices.
    UNRECORDED = ("origins", "points", "extent", "_tree", "_thinned", "_levels", "_recorded_directions")

    def __init__(self, origins: np.ndarray, points: np.ndarray, kernels: Sequence[HitKernel]):
        self.origins, self.points = (np.ascontiguousarray(a, np.float32).reshape(-1, 3) for a in (origins, points))
        self.kernels = tuple(HitKernel(*map(float, kernel)) for kernel in kernels)
        if not 0 < len(self.origins) == len(self.points) <= MAX_HITS:
            raise ValueError(
                f"re-aimed hits need one point for each of 1 to {MAX_HITS} origins, got {len(self.points)} and "
                f"{len(self.origins)}"
            )
        if not all(np.abs(a).max() <= MAX_COORDINATE for a in (self.origins, self.points)):
            raise ValueError(f"re-aimed hits need finite coordinates up to {MAX_COORDINATE:g}")
        if not 0 < len(self.kernels) <= MAX_KERNELS or not self.weight <= 1 + 1e-6:
            raise ValueError(
                f"re-aimed hits need 1 to {MAX_KERNELS} kernels whose weights sum to at most 1, got "
                f"{len(self.kernels)} and {self.weight:g}"
            )
        for weight, bandwidth, kappa in self.kernels:
            if not 0 < weight <= 1 + 1e-6 or bandwidth not in LENGTHS or kappa not in KAPPAS:
                raise ValueError(
                    "re-aimed hits need a weight from 0 to 1, a positive bandwidth and a positive concentration, got "
                    f"{weight}, {bandwidth} and {kappa}"
                )

    @property
    def weight(self) -> float:
        """Weight of the density in the gaze field, the sum of the weights of the kernels."""
        return sum(kernel.weight for kernel in self.kernels)

    @cached_property
    def extent(self) -> float:
        """Half the diagonal of the bounding box of the origins, but at least the largest bandwidth: the distance at
        which an observer is far from all samples."""
        diagonal = np.linalg.norm(np.ptp(self.origins.astype(np.float64), axis=0))
        return max(0.5 * float(diagonal), *(kernel.bandwidth for kernel in self.kernels))

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import KDTree

        return KDTree(self.origins.astype(np.float64))

    @cached_property
    def _thinned(self) -> dict[int, tuple[np.ndarray, Any]]:
        # Indices of the samples of each level of thinning, and their tree
        return {0: (np.arange(len(self.origins)), self._tree)}

    def _thin(self, bandwidth: float) -> int:
        """Return the level of thinning at which `MAX_NEIGHBOURS` samples cover the neighbourhood of ``bandwidth``."""
        centres = self.origins[:: -(-len(self.origins) // _NUM_THINNING_CENTRES)].astype(np.float64)
        counts = self._tree.query_ball_point(centres, _NEIGHBOURHOOD * bandwidth, return_length=True)
        level = max(0, int(np.ceil(np.log2(np.median(counts) / MAX_NEIGHBOURS))))
        if level not in self._thinned:
            from scipy.spatial import KDTree

            subset = np.random.default_rng(level).permutation(len(self.origins))[: len(self.origins) >> level]
            self._thinned[level] = subset, KDTree(self.origins[subset].astype(np.float64))
        return level

    @cached_property
    def _levels(self) -> dict[float, int]:
        """Level of thinning of each bandwidth."""
        return {bandwidth: self._thin(bandwidth) for bandwidth in {kernel.bandwidth for kernel in self.kernels}}

    @cached_property
    def _recorded_directions(self) -> np.ndarray:
        # A point at the observer who looked at it has no direction.
        offset = self.points.astype(np.float64) - self.origins
        return aim(offset, np.zeros(3), np.zeros(3), 0.0).astype(np.float32)

    def find(self, positions: np.ndarray) -> list[HitNeighbours]:
        """Find the samples nearest to each of ``positions`` (P, 3), in the field's frame, with their weights and
        directions, for each of the kernels."""
        positions = np.asarray(positions, np.float64).reshape(-1, 3)
        nearest: dict[int, _NearestSamples] = {}
        neighbours: dict[float, HitNeighbours] = {}
        for bandwidth, level in self._levels.items():
            if level not in nearest:
                nearest[level] = self._find_nearest(positions, level)
            neighbours[bandwidth] = nearest[level].weigh(bandwidth, self.extent)
        return [neighbours[kernel.bandwidth] for kernel in self.kernels]

    def _find_nearest(self, positions: np.ndarray, level: int) -> _NearestSamples:
        """Find the samples nearest to each of ``positions`` (P, 3) among those of a ``level`` of thinning."""
        subset, tree = self._thinned[level]
        distance, index = tree.query(positions, k=np.arange(1, min(MAX_NEIGHBOURS, len(subset)) + 1))
        index = subset[index]
        to_point = (self.points[index] - positions[:, None]).astype(np.float32)
        offsets = (self.origins[index] - positions[:, None]).astype(np.float32)
        return _NearestSamples(distance, offsets, to_point, self._recorded_directions[index])

    def evaluate_kernels(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Evaluate the density of each of K kernels for the observers at ``positions`` (n, 3) in one unit direction
        each, ``directions`` (n, 3), in NumPy: (n, K)."""
        densities = np.empty((len(positions), len(self.kernels)))
        directions = np.asarray(directions, np.float32)
        for start in range(0, len(positions), _BLOCK):
            rows = slice(start, start + _BLOCK)
            # Kernels of one bandwidth have the same neighbours.
            distances: dict[float, np.ndarray] = {}
            for k, (near, (_, bandwidth, kappa)) in enumerate(zip(self.find(positions[rows]), self.kernels)):
                if bandwidth not in distances:
                    offset = directions[rows, None] - near.directions
                    distances[bandwidth] = np.einsum("pkc,pkc->pk", offset, offset)
                terms = near.weights * np.exp(np.float32(-0.5 * kappa) * distances[bandwidth])
                density = np.exp(log_normaliser(kappa)) * terms.sum(axis=1) / near.weights.sum(axis=1)
                densities[rows, k] = density + near.uniform_weight * (_UNIFORM - density)
        return densities

    def mix(self, gaze: Float, density: Float) -> Float:
        """Mix the ``density`` of the hits into the ``gaze`` of the networks."""
        return (1 - self.weight) * gaze + self.weight * density

    def observe(self, positions: np.ndarray, ns: ModuleType) -> ObservedHits:
        """Make the density of the observers at ``positions``, (3,) or (P, 3) in the field's frame, on the backend
        ``ns``."""
        return ObservedHits(self.kernels, self.find(positions), self.extent, ns)


def place_missing_points(
    origins: np.ndarray, directions: np.ndarray, points: np.ndarray | None, bandwidth: float
) -> np.ndarray:
    """Replace missing hit points, so that their samples keep their direction for all observers.

    Parameters
    ----------
    origins, directions : array (n, 3)
        Samples, in one frame.
    points : array (n, 3), optional
        Hit points; not finite: missing. None: all are missing.
    bandwidth : float
        Bandwidth in the same units.

    Returns
    -------
    array (n, 3)
        Hit points, the missing ones `FAR` away, or less where coordinates would be too large.
    """
    distance = min(FAR * bandwidth, MAX_COORDINATE - np.abs(origins).max())
    far = origins + distance * directions
    return far if points is None else np.where(np.isfinite(points).all(axis=1, keepdims=True), points, far)


class ObservedHits:
    """The density of re-aimed hits for one observer, or for several without a table."""

    # Derivatives need them.
    UNRECORDED = ("_neighbours",)

    def __init__(
        self, kernels: Sequence[HitKernel], neighbours: Sequence[HitNeighbours], extent: float, ns: ModuleType
    ):
        self._kernels, self._neighbours, self._extent, self._ns = kernels, neighbours, extent, ns
        self._uniform_weights = [ns.Float(copy_aligned(near.uniform_weight, np.float32)) for near in neighbours]
        self._kdes = [_make_kde(near, kernel.kappa, ns) for kernel, near in zip(kernels, neighbours)]
        self._tables: list[SphericalKdeTable | None] = [None] * len(kernels)
        total = sum(kernel.weight for kernel in kernels)
        self._shares = [kernel.weight / total for kernel in kernels]

    @classmethod
    def merge(cls, observed: Sequence[ObservedHits]) -> ObservedHits:
        """The density for all observers of ``observed``, in their order."""
        first = observed[0]
        neighbours = [
            HitNeighbours(*(np.concatenate(arrays) for arrays in zip(*of_kernel)))
            for of_kernel in zip(*(o._neighbours for o in observed))
        ]
        return cls(first._kernels, neighbours, first._extent, first._ns)

    @property
    def is_tabulated(self) -> bool:
        return None not in self._tables

    def prepare(self, lanes: int) -> None:
        """Tabulate the kernels of a single observer for which that is faster for ``lanes`` directions."""
        # A function that dr.freeze records cannot read the kernels: it takes the tables that there are.
        if lanes < _MIN_TABLE_LANES or self._kdes[0].count > 1 or dr.flag(dr.JitFlag.FreezingScope):
            return
        for k, kde in enumerate(self._kdes):
            if self._tables[k] is None and SphericalKdeTable.is_worthwhile(kde, lanes):
                self._tables[k] = SphericalKdeTable(kde, spacing=_TABLE_SPACING)

    def evaluate(self, directions: np.ndarray) -> np.ndarray:
        """Densities (P, D) of all P observers in unit ``directions`` (D, 3), or (P, D, 3), float64."""
        densities = [kde.evaluate(directions).astype(np.float64) for kde in self._kdes]
        return self._add(
            [d + near.uniform_weight[:, None] * (_UNIFORM - d) for d, near in zip(densities, self._neighbours)]
        )

    def density(self, r_o: Vector3f, p_o: Point3f, observer: Any = None) -> Float:
        """Density (1/sr) in unit directions ``r_o``, in the field's frame, for the observers with the indices
        ``observer`` (UInt32; None: the first).

        Differentiable in ``r_o`` and in the position ``p_o`` of the observer (one lane or one per direction), to first
        order and for constant neighbours.
        """
        ns, lanes = self._ns, dr.width(r_o)
        d = ns.Array3f(*(dr.detach(c) for c in (r_o.x, r_o.y, r_o.z)))
        observer = dr.zeros(ns.UInt32, lanes) if observer is None else ns.UInt32(observer)
        with dr.suspend_grad():
            # Within a recorded branch or loop nothing can be evaluated.
            if not dr.flag(dr.JitFlag.SymbolicScope):
                self.prepare(lanes)
            values = [
                kde.density(observer, d) if table is None else table.density(d)
                for kde, table in zip(self._kdes, self._tables)
            ]
            uniform = [dr.gather(ns.Float, weight, observer) for weight in self._uniform_weights]
            total = self._add([dr.lerp(value, _UNIFORM, weight) for value, weight in zip(values, uniform)])
        if not dr.grad_enabled(r_o, p_o):
            return total
        with dr.suspend_grad():
            slopes = [
                _compute_slopes(ns, near, kernel, self._extent, d, value, observer)
                for kernel, near, value in zip(self._kernels, self._neighbours, values)
            ]
            slope_r, slope_p = (self._add(parts) for parts in zip(*slopes))
        moved = lambda v: type(v)(v - dr.detach(v))
        attach = lambda slope, v: slope.x * v.x + slope.y * v.y + slope.z * v.z
        return total + attach(slope_r, moved(r_o)) + attach(slope_p, moved(p_o))

    def _add(self, values: Sequence[Any]) -> Any:
        total = self._shares[0] * values[0]
        for share, value in zip(self._shares[1:], values[1:]):
            total += share * value
        return total


def _make_kde(neighbours: HitNeighbours, kappa: float, ns: ModuleType) -> SphericalKde:
    """Make the densities of P positions, on the backend ``ns``, in the field's frame."""
    count, size = neighbours.weights.shape
    directions, offsets = neighbours.directions.reshape(-1, 3), np.arange(count + 1) * size
    return SphericalKde(directions, offsets, kappa, neighbours.weights.ravel(), ns)


def _compute_slopes(
    ns: ModuleType, near: HitNeighbours, kernel: HitKernel, extent: float, d: Any, value: Any, observer: Any
) -> tuple[Any, Any]:
    """Derivatives of the density of a kernel with respect to the directions ``d`` and to the position; ``value`` is the
    density without the uniform one."""
    size, kappa = near.weights.shape[1], kernel.kappa
    offsets = near.offsets / kernel.bandwidth**2
    weights = near.weights / near.weights.sum(axis=1, keepdims=True)
    packed = np.concatenate([near.directions, weights[..., None], offsets, near.inverse_distance[..., None]], axis=2)
    rows = ns.Float(packed.astype(np.float32).ravel())
    peak = float(np.exp(log_normaliser(kappa)))

    def body(i, by_r, by_p, d, value, first):
        at = lambda k: dr.gather(ns.Float, rows, (first + i) * 8 + k)
        aim, offset = ns.Array3f(at(0), at(1), at(2)), ns.Array3f(at(4), at(5), at(6))
        weight, inverse = at(3), at(7)
        density = peak * dr.exp(-0.5 * kappa * dr.squared_norm(d - aim))
        slope = weight * density * kappa
        by_p += weight * (density - value) * offset - slope * inverse * (d - dr.dot(d, aim) * aim)
        return i + 1, by_r + slope * aim, by_p, d, value, first

    zero = dr.zeros(ns.Array3f, dr.width(d))
    _, by_r, by_p, *_ = dr.while_loop(
        state=(dr.zeros(ns.UInt32, dr.width(d)), zero, ns.Array3f(zero), d, value, observer * size),
        cond=lambda i, by_r, by_p, d, value, first: i < size,
        body=body,
        labels=("i", "by_r", "by_p", "d", "value", "first"),
        label="slopes of re-aimed hits",
    )
    rest = (1 - near.uniform_weight[:, None]) * np.concatenate([np.ones((len(offsets), 1)), near.offsets[:, 0]], axis=1)
    columns = ns.Float((rest / [1, extent**2, extent**2, extent**2]).astype(np.float32).ravel())
    share, *slope = (dr.gather(ns.Float, columns, observer * 4 + k) for k in range(4))
    return share * by_r, share * by_p + (value - _UNIFORM) * ns.Array3f(*slope)
