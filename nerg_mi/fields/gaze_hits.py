"""Re-aimed hits: the part of a gaze field that is a kernel density of training samples.

q(r_o | p_o) = Σ_j w_j f(r_o; a_j, κ) / Σ_j w_j,  w_j = exp(-|o_j - p_o|² / 2b²),  a_j = (h_j - p_o) / |h_j - p_o|

Sample j was recorded at o_j and hit a surface at h_j. Seen from the observer p_o, it points in the direction a_j, so
that the kernels f (von Mises-Fisher, concentration κ) follow the parallax of the surfaces. Without the re-aiming it is
the conditional kernel density of Rosenblatt (1969). It resolves what attracts attention as finely as the samples do,
but says little where nobody stood nearby, where the networks of a gaze field still generalise. A gaze field
mixes both.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from types import ModuleType
from typing import Any, NamedTuple

import drjit as dr
import numpy as np

from nerg_mi.maths.sphere import aim
from nerg_mi.maths.types import Float, Point3f, Vector3f
from nerg_mi.maths.vmf import log_normaliser
from nerg_mi.ranges import KAPPAS, LENGTHS, MAX_COORDINATE

from .kde import SphericalKde, SphericalKdeTable

MAX_HITS = 1 << 15  # Maximum number of samples that a field stores, 24 bytes each
MAX_NEIGHBOURS = 1024  # Maximum number of samples that an observer's density is the sum of: the nearest
FAR = 1e4  # Maximum distance, in bandwidths, at which the point of a sample without a hit is placed
# Distance from the observer, in bandwidths, below which the direction to a point is that of the recording: the gaze on
# a nearby point says nothing about observers next to it.
_MIN_DISTANCE = 0.25
_TABLE_SPACING = 0.2  # Texels of a table in units of 1/sqrt(κ): errors below 3e-4 of the maximum of a kernel
_MIN_TABLE_LANES = 8192  # Number of directions below which a table is not considered


class NearestOrigins(NamedTuple):
    """The k samples with the origins nearest to each of P positions, nearest first."""

    distance: np.ndarray  # Distance of the origin (P, k)
    index: np.ndarray  # Index of the sample (P, k)


class HitNeighbours(NamedTuple):
    """The k samples nearest to each of P positions."""

    directions: np.ndarray  # Unit directions from the position to the hit point (P, k, 3)
    weights: np.ndarray  # (P, k)
    inverse_distance: np.ndarray  # Inverse distance of the hit point (P, k); 0 for a direction of the recording
    offsets: np.ndarray  # From the position to the origin of the sample (P, k, 3)


class ReaimedHits:
    """Hit points of training samples, whose density is mixed into a gaze field.

    Parameters
    ----------
    origins : array (n, 3)
        Positions of the observers of the samples, in the field's frame and units.
    points : array (n, 3)
        Hit points; `place_missing_points` replaces missing ones.
    weight : float
        Weight of the density in the mixture.
    bandwidth : float
        Standard deviation b of the weights over the distance between observers, in the field's units.
    kappa : float
        Concentration of the kernels.

    Raises
    ------
    ValueError
        For arrays that do not match or are not finite, and for parameters out of range.
    """

    def __init__(self, origins: np.ndarray, points: np.ndarray, weight: float, bandwidth: float, kappa: float):
        self.origins, self.points = (np.ascontiguousarray(a, np.float32).reshape(-1, 3) for a in (origins, points))
        self.weight, self.bandwidth, self.kappa = float(weight), float(bandwidth), float(kappa)
        if not 0 < len(self.origins) == len(self.points) <= MAX_HITS:
            raise ValueError(
                f"re-aimed hits need one point for each of 1 to {MAX_HITS} origins, got {len(self.points)} and "
                f"{len(self.origins)}"
            )
        if not all(np.abs(a).max() <= MAX_COORDINATE for a in (self.origins, self.points)):
            raise ValueError(f"re-aimed hits need finite coordinates up to {MAX_COORDINATE:g}")
        if not 0 <= self.weight <= 1 or self.bandwidth not in LENGTHS or self.kappa not in KAPPAS:
            raise ValueError(
                "re-aimed hits need a weight from 0 to 1, a positive bandwidth and a positive concentration, got "
                f"{weight}, {bandwidth} and {kappa}"
            )

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import KDTree

        return KDTree(self.origins.astype(np.float64))

    @cached_property
    def _recorded_directions(self) -> np.ndarray:
        # A point at the observer who looked at it has no direction.
        return aim(self.points.astype(np.float64), np.zeros(3), self.origins.astype(np.float64), 0.0)

    def find_nearest(self, positions: np.ndarray) -> NearestOrigins:
        """Find the samples nearest to each of ``positions`` (P, 3), in the field's frame."""
        positions = np.atleast_2d(np.asarray(positions, np.float64))
        k = min(MAX_NEIGHBOURS, len(self.origins))
        return NearestOrigins(*self._tree.query(positions, k=np.arange(1, k + 1)))

    def find(self, positions: np.ndarray, nearest: NearestOrigins | None = None) -> HitNeighbours:
        """Find the samples nearest to each of ``positions`` (P, 3), in the field's frame, with their weights and
        directions.

        ``nearest``: what `find_nearest` returns for these positions, of any hits with these origins.
        """
        positions = np.atleast_2d(np.asarray(positions, np.float64))
        distance, index = nearest or self.find_nearest(positions)
        # Relative to the nearest sample, so that the weights do not vanish far from all samples.
        weights = np.exp(0.5 * (distance[:, :1] ** 2 - distance**2) / self.bandwidth**2)
        origins, points = self.origins[index].astype(np.float64), self.points[index].astype(np.float64)
        recorded = self._recorded_directions[index]
        min_distance = _MIN_DISTANCE * self.bandwidth
        directions = aim(points, recorded, positions[:, None], min_distance)
        weights = np.where(directions.any(axis=-1), weights, 0)
        # If no sample has a direction, there is nothing to aim at; the density must still be one.
        is_lost = ~weights.any(axis=1)
        directions[is_lost, 0], weights[is_lost, 0] = (0, 0, 1), 1
        length = np.linalg.norm(points - positions[:, None], axis=-1)
        inverse = np.where(length > min_distance, 1 / np.maximum(length, min_distance), 0)
        return HitNeighbours(directions, weights, inverse, origins - positions[:, None])

    def make_kde(self, neighbours: HitNeighbours, ns: ModuleType) -> SphericalKde:
        """Make the densities of P positions, on the backend ``ns``, in the field's frame."""
        count, size = neighbours.weights.shape
        return SphericalKde(
            neighbours.directions.reshape(-1, 3),
            np.arange(count + 1) * size,
            self.kappa,
            neighbours.weights.ravel(),
            ns,
        )

    def mix(self, gaze: Float, density: Float) -> Float:
        """Mix the ``density`` of the hits into the ``gaze`` of the networks."""
        return (1 - self.weight) * gaze + self.weight * density

    def observe(self, position: np.ndarray, ns: ModuleType) -> ObservedHits:
        """Make the density of the observer at ``position`` (3,), in the field's frame."""
        return ObservedHits(self, self.find(position), ns)


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

    def __init__(self, hits: ReaimedHits, neighbours: HitNeighbours, ns: ModuleType):
        self._kde = hits.make_kde(neighbours, ns)
        self._table: SphericalKdeTable | None = None
        self._hits, self._neighbours = hits, neighbours

    @classmethod
    def merge(cls, observed: Sequence[ObservedHits]) -> ObservedHits:
        """The density for all observers of ``observed``, in their order."""
        first = observed[0]
        neighbours = HitNeighbours(*(np.concatenate(arrays) for arrays in zip(*(o._neighbours for o in observed))))
        return cls(first._hits, neighbours, first._kde.ns)

    @property
    def is_tabulated(self) -> bool:
        return self._table is not None

    def prepare(self, lanes: int) -> None:
        """Tabulate the density of a single observer if that is faster for ``lanes`` directions."""
        is_single = self._kde.count == 1
        is_worthwhile = is_single and lanes >= _MIN_TABLE_LANES and SphericalKdeTable.is_worthwhile(self._kde, lanes)
        if self._table is None and is_worthwhile:
            self._table = SphericalKdeTable(self._kde, spacing=_TABLE_SPACING)

    def density(self, r_o: Vector3f, p_o: Point3f, observer: Any = None) -> Float:
        """Density (1/sr) in unit directions ``r_o``, in the field's frame, for the observers with the indices
        ``observer`` (UInt32; None: the first).

        Differentiable in ``r_o`` and in the position ``p_o`` of the observer (one lane or one per direction), to first
        order and for constant neighbours.
        """
        ns, lanes = self._kde.ns, dr.width(r_o)
        d = ns.Array3f(*(dr.detach(c) for c in (r_o.x, r_o.y, r_o.z)))
        observer = dr.zeros(ns.UInt32, lanes) if observer is None else ns.UInt32(observer)
        with dr.suspend_grad():
            # Within a recorded branch or loop nothing can be evaluated.
            if not dr.flag(dr.JitFlag.SymbolicScope):
                self.prepare(lanes)
            value = self._table.density(d) if self._table else self._kde.density(observer, d)
        if not dr.grad_enabled(r_o, p_o):
            return value
        with dr.suspend_grad():
            slope_r, slope_p = self._compute_slopes(d, value, observer)
        moved = lambda v: type(v)(v - dr.detach(v))
        attach = lambda slope, v: slope.x * v.x + slope.y * v.y + slope.z * v.z
        return value + attach(slope_r, moved(r_o)) + attach(slope_p, moved(p_o))

    def _compute_slopes(self, d: Any, value: Any, observer: Any) -> tuple[Any, Any]:
        """Derivatives of the density ``value`` in directions ``d`` with respect to ``d`` and to the position."""
        ns, near, kappa = self._kde.ns, self._neighbours, self._hits.kappa
        size = near.weights.shape[1]
        offsets = near.offsets / self._hits.bandwidth**2
        weights = near.weights / near.weights.sum(axis=1, keepdims=True)
        packed = np.concatenate(
            [near.directions, weights[..., None], offsets, near.inverse_distance[..., None]], axis=2
        )
        rows = ns.Float(packed.astype(np.float32).ravel())
        peak = float(np.exp(log_normaliser(kappa)))

        def body(i, by_r, by_p, d, value, first):
            at = lambda k: dr.gather(ns.Float, rows, (first + i) * 8 + k)
            aim, offset = ns.Array3f(at(0), at(1), at(2)), ns.Array3f(at(4), at(5), at(6))
            weight, inverse = at(3), at(7)
            kernel = peak * dr.exp(-0.5 * kappa * dr.squared_norm(d - aim))
            slope = weight * kernel * kappa
            by_p += weight * (kernel - value) * offset - slope * inverse * (d - dr.dot(d, aim) * aim)
            return i + 1, by_r + slope * aim, by_p, d, value, first

        zero = dr.zeros(ns.Array3f, dr.width(d))
        _, by_r, by_p, *_ = dr.while_loop(
            state=(dr.zeros(ns.UInt32, dr.width(d)), zero, ns.Array3f(zero), d, value, observer * size),
            cond=lambda i, by_r, by_p, d, value, first: i < size,
            body=body,
            labels=("i", "by_r", "by_p", "d", "value", "first"),
            label="slopes of re-aimed hits",
        )
        return by_r, by_p
