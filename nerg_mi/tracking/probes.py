"""Gaze probes: placement, densities and highest-density regions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.kde import Backend, SphericalKde, compute_silverman_kappas, select_loo_kappas
from nerg_mi.maths import vmf
from nerg_mi.maths.arrays import check_weights

from .rays import Neighbours, RayIndex, Rays

# ---- Placement of probes: on a lattice, at random, at ray origins, or at evenly spaced ray origins (blue noise) ----


def place_queries(
    origin: np.ndarray, placement: str, count: int, spacing: float | None, radius: float, rng: np.random.Generator
) -> np.ndarray:
    """Choose the centres (Q, 3) of probes of radius R among ray origins (N, 3), in metres.

    Parameters
    ----------
    origin : numpy.ndarray
        Ray origins (N, 3).
    placement : str
        ``data``: ``count`` distinct random ray origins. ``grid``: a lattice of ``spacing`` (2R) over the bounding box
        of the origins. ``random``: ``count`` uniform positions in that box. ``blue``: at most ``count`` ray origins at
        least ``spacing`` apart.
    count : int
        Number of centres.
    spacing : float or None
        Distance between centres. For ``blue``, None selects the smallest distance from R on that gives at most
        ``count`` centres.
    radius : float
        Probe radius R.
    rng : numpy.random.Generator
        Random numbers.

    Raises
    ------
    NergError
        For an unknown placement.
    """
    if placement == "data":
        return origin[rng.choice(len(origin), min(count, len(origin)), replace=False)]
    if placement == "grid":
        return _make_lattice(origin, spacing or 2.0 * radius)
    if placement == "random":
        return rng.uniform(origin.min(axis=0), origin.max(axis=0), (count, 3))
    _check_one_of("placement", placement, PLACEMENTS)
    if spacing is not None:
        centres = _sample_poisson_discs(origin, spacing, rng)
        return centres[rng.permutation(len(centres))[:count]]
    spacing = radius
    while len(centres := _sample_poisson_discs(origin, spacing, rng)) > count:
        spacing *= max(1.02, (len(centres) / count) ** 0.4)
    return centres


def _make_lattice(origin: np.ndarray, spacing: float) -> np.ndarray:
    # Centre the lattice in the box.
    axes = []
    for a, b in zip(origin.min(axis=0), origin.max(axis=0)):
        n = max(1, int(np.floor((b - a) / spacing)) + 1)
        axes.append(0.5 * (a + b) + spacing * (np.arange(n) - 0.5 * (n - 1)))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


PLACEMENTS = ("data", "grid", "random", "blue")


def _sample_poisson_discs(origin: np.ndarray, spacing: float, rng: np.random.Generator) -> np.ndarray:
    """Return ray origins in random order, skipping those within ``spacing`` of an earlier one (Poisson-disc
    sampling)."""
    from scipy.spatial import KDTree

    # One candidate per cell that is much smaller than the discs: this reduces millions of origins to some ten thousand.
    cell = np.floor((origin - origin.min(axis=0)) / (0.25 * spacing)).astype(np.int64)
    order = rng.permutation(len(origin))
    size = cell.max(axis=0) + 1
    key = (cell[order, 0] * size[1] + cell[order, 1]) * size[2] + cell[order, 2]
    candidates = origin[order[np.sort(np.unique(key, return_index=True)[1])]]
    tree = KDTree(candidates)
    is_free = np.ones(len(candidates), bool)
    selected = []
    for i, position in enumerate(candidates):
        if is_free[i]:
            selected.append(i)
            is_free[tree.query_ball_point(position, spacing)] = False
    return candidates[selected]


# ---- Probes ----
#
# A probe is the gaze density of the rays whose origins are within R of a position (NeRG, Section 5.1).

KAPPA_RULES = ("silverman", "loo", "fixed")
WEIGHTS = ("equal", "distance", "person")
CENTRES = ("mean", "query")


@dataclass(frozen=True, eq=False)
class Probes:
    """P probes and the n rays that they hold, probe after probe, in metres in the frame of the rays."""

    positions: np.ndarray  # (P, 3) positions to which the densities are assigned
    queries: np.ndarray  # (P, 3) centres of the balls that collect the rays
    radius: float  # radius of the balls
    indices: np.ndarray  # (n,) indices into the rays; nearest first in each probe
    offsets: np.ndarray  # (P + 1,): probe p holds indices[offsets[p]:offsets[p + 1]]
    directions: np.ndarray  # (n, 3) of these rays, unit
    kappa: np.ndarray  # (P,) concentrations of the kernels
    weights: np.ndarray | None = None  # (n,) of these rays, positive; None: equal ones

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def counts(self) -> np.ndarray:
        """Number of rays in each of the P probes, (P,)."""
        return np.diff(self.offsets)

    def kde(self, backend: Backend = None) -> SphericalKde:
        """Return the densities of all P probes as an object of the Dr.Jit ``backend`` (`kde.Backend`), for evaluation
        in kernels."""
        return SphericalKde(self.directions, self.offsets, self.kappa, self.weights, backend)

    def density(self, directions: np.ndarray, backend: Backend = None) -> np.ndarray:
        """Evaluate the densities of all P probes in D directions.

        Parameters
        ----------
        directions
            Unit directions: (D, 3), common to all probes, or (P, D, 3).
        backend
            Dr.Jit backend (LLVM or CUDA) on which the densities are evaluated; None: that of Mitsuba's variant.

        Returns
        -------
        np.ndarray
            Densities (P, D) in 1/sr, float32. Each integrates to one over the sphere.
        """
        return self.kde(backend).evaluate(directions)

    def widen(self, kappa: float) -> Probes:
        """Convolve the densities with a von Mises-Fisher distribution of concentration ``kappa``.

        This converts head rays to gaze: κ of about 37 was measured in a shop. See
        :func:`nerg_mi.maths.vmf.convolve_kappa`.
        """
        return replace(self, kappa=vmf.convolve_kappa(self.kappa, kappa))


def place_probes(
    rays: Rays,
    radius: float = 0.25,
    *,
    placement: str = "data",
    count: int = 4096,
    queries: np.ndarray | None = None,
    spacing: float | None = None,
    max_rays: int = 1024,
    min_rays: int = 64,
    kappa_rule: str = "silverman",
    kappa: float = 20.0,
    kappa_max: float = 1000.0,
    kappa_shared: bool = False,
    eye_kappa: float | None = None,
    weights: str = "equal",
    ray_weights: np.ndarray | None = None,
    centre: str = "mean",
    index: RayIndex | None = None,
    seed: int = 0,
) -> Probes:
    """Make probes from gaze rays.

    Parameters
    ----------
    rays : Rays
        Gaze rays.
    radius : float
        Probe radius R in metres (the paper: 0.1 m for 2.6 million rays; 0.25 m suits some 10^5 rays).
    placement, count, spacing
        See :func:`place_queries`.
    queries : numpy.ndarray, optional
        Explicit centres (P, 3).
    max_rays, min_rays : int
        A centre with fewer than ``min_rays`` rays makes no probe; of more than ``max_rays`` rays the nearest are used
        (the published code: 4,096 and 8).
    kappa_rule : str
        ``silverman`` (the published code), ``fixed`` (``kappa``), or ``loo`` (leave-one-out likelihood over other
        participants, or over other rays if there is only one; ignores weights).
    kappa, kappa_max : float
        Concentration of ``fixed``, and upper bound of the other rules: a participant who stares causes a peak that a
        few thousand directions cannot resolve.
    kappa_shared : bool
        Use one κ for all probes (:mod:`nerg_mi.fields.kde`).
    eye_kappa : float, optional
        Concentration of the eye-in-head distribution to convolve with, see :meth:`Probes.widen`.
    weights : str
        Weights of the rays of a probe: ``equal``, ``distance`` (1 - d/R; the published code has an option that uses the
        distance of the farthest ray as R), or ``person`` (participants have equal total weight in each probe).
    ray_weights : numpy.ndarray, optional
        Additional non-negative factors (N,), such as :func:`compute_participant_weights`. Rays with weight zero are
        left out.
    centre : str
        Position assigned to a density. ``mean``: the weighted mean of the ray origins, as in the published code, which
        is where participants stood, even at the edge of the walkable area. ``query``: the centre of the ball, as in the
        text of the paper. They differ by less than R.
    index : RayIndex, optional
        Existing index of the rays.
    seed : int
        Seed of the placement.

    Raises
    ------
    NergError
        For unknown names, or if no centre has enough rays.
    """
    _check_one_of("placement", placement, PLACEMENTS)
    _check_one_of("kappa_rule", kappa_rule, KAPPA_RULES)
    _check_one_of("centre", centre, CENTRES)
    _check_one_of("weights", weights, WEIGHTS)
    if not radius > 0 or min_rays < 1 or max_rays < min_rays:
        raise NergError(
            f"radius must be positive and 1 <= min_rays <= max_rays, got radius {radius}, min_rays {min_rays}, "
            f"max_rays {max_rays}"
        )
    rng = np.random.default_rng(seed)
    nonzero = None
    if ray_weights is not None:
        ray_weights = check_weights(ray_weights, len(rays), "ray_weights")
        if not ray_weights.all():
            # Rays of weight zero are removed.
            nonzero = np.flatnonzero(ray_weights)
            rays, ray_weights, index = rays.select(nonzero), ray_weights[nonzero], None
    if queries is None:
        queries = place_queries(rays.origin, placement, count, spacing, radius, rng)
    queries = np.asarray(queries, dtype=np.float64).reshape(-1, 3)

    neighbours = (index or RayIndex(rays)).query(queries, max_rays, radius)
    has_enough = np.diff(neighbours.offsets) >= min_rays
    if not has_enough.any():
        raise NergError(
            f"none of {len(queries)} probes has {min_rays} rays within {radius} m; increase {parameter('radius')} or "
            f"reduce {parameter('min_rays')}"
        )
    counts = np.diff(neighbours.offsets)
    is_used, offsets = np.repeat(has_enough, counts), np.concatenate([[0], np.cumsum(counts[has_enough])])
    neighbours = Neighbours(neighbours.indices[is_used], neighbours.distances[is_used], offsets)
    queries, indices = queries[has_enough], neighbours.indices
    directions, persons = rays.direction[indices], rays.person[indices]
    w = _compute_weights(neighbours, persons, radius, weights, None if ray_weights is None else ray_weights[indices])
    if kappa_rule == "fixed":
        kappas = np.full(len(queries), float(kappa))
    elif kappa_rule == "silverman":
        kappas = compute_silverman_kappas(directions, w, offsets, kappa_max, kappa_shared)
    else:
        kappas = select_loo_kappas(directions, persons, offsets, kappa_max, kappa_shared, rng)
    positions = _compute_weighted_means(rays.origin[indices], w, offsets) if centre == "mean" else queries
    if nonzero is not None:
        indices = nonzero[indices]
    probes = Probes(positions, queries, float(radius), indices, offsets, directions, kappas, w)
    return probes if eye_kappa is None else probes.widen(eye_kappa)


def compute_participant_weights(rays: Rays) -> np.ndarray:
    """Compute ray weights (N,) that give each participant the same total weight; their mean is one."""
    counts = np.bincount(rays.person)
    return len(rays) / np.count_nonzero(counts) / counts[rays.person]


def _check_one_of(name: str, value: str, choices: Iterable[str]) -> None:
    if value not in choices:
        raise NergError(f'{name} must be one of {", ".join(choices)}, got "{value}"')


def _compute_weights(
    neighbours: Neighbours, persons: np.ndarray, radius: float, rule: str, ray_weights: np.ndarray | None
) -> np.ndarray | None:
    """Compute the weights (n,) of the rays of all probes; None if they are equal."""
    if rule == "distance":
        # Never zero, because a probe may only hold rays at its rim.
        return np.maximum(1.0 - neighbours.distances / radius, 1e-6) * (1.0 if ray_weights is None else ray_weights)
    if rule == "person":
        counts = np.diff(neighbours.offsets)
        probe = np.repeat(np.arange(len(counts)), counts)
        _, group, rays = np.unique(probe * (1 + persons.max()) + persons, return_inverse=True, return_counts=True)
        return (1.0 if ray_weights is None else ray_weights) / rays[group]
    return ray_weights


def _compute_weighted_means(values: np.ndarray, weights: np.ndarray | None, offsets: np.ndarray) -> np.ndarray:
    """Compute the weighted mean (P, 3) of ``values`` (n, 3) of each probe."""
    if weights is None:
        scale, weighted = 1.0 / np.diff(offsets), values
    else:
        scale, weighted = 1.0 / np.add.reduceat(weights, offsets[:-1]), values * weights[:, None]
    return np.add.reduceat(weighted, offsets[:-1]) * scale[:, None]


# ---- Highest-density regions ----
#
# Highest-density regions (HDR) and their calibration.
#
# A density fitted to the training participants is wider or narrower than that of others, so its 80 % region holds more
# or less than 80 % of their gaze. Held-out rays determine by how much: the nominal level for a coverage is the quantile
# of the levels at which the held-out rays lie (split conformal prediction, Vovk et al. 2005, with highest-density
# regions, Izbicki et al. 2022).

REGION_LEVELS = (0.5, 0.8, 0.95)  # Coverages of the evaluated highest-density regions


def format_level(level: float) -> str:
    """Return the name of a coverage in tables and files."""
    return f"{level:.0%}"


def compute_region_levels(maps: np.ndarray, sample_densities: np.ndarray) -> np.ndarray:
    """Compute the level of the smallest highest-density region that contains each ray (Hyndman 1996).

    Parameters
    ----------
    maps : numpy.ndarray
        Densities (P, D) in directions of equal area.
    sample_densities : numpy.ndarray
        Densities (P, K) at the rays.

    Returns
    -------
    numpy.ndarray
        Levels (P, K): the probability of higher densities, plus half of that of equal ones.
    """
    out = []
    for row, values in zip(np.maximum(maps, 0).astype(np.float64), sample_densities):
        ordered = np.sort(row)
        mass = np.concatenate([[0.0], np.cumsum(ordered)])
        lower, upper = (mass[np.searchsorted(ordered, values, side)] for side in ("left", "right"))
        out.append(1 - 0.5 * (lower + upper) / mass[-1] if mass[-1] > 0 else np.full(len(values), 0.5))
    return np.array(out)


def calibrate_levels(levels: np.ndarray, weights: np.ndarray) -> dict[str, float]:
    """Compute the nominal level of each of `REGION_LEVELS`, by `format_level`.

    These are weighted quantiles of the ``levels`` (n,) of held-out rays (`compute_region_levels`) with ``weights``
    (n,).
    """
    order = np.argsort(levels)
    coverage = np.cumsum(weights[order]) / weights.sum()
    at = lambda level: order[min(np.searchsorted(coverage, level), len(order) - 1)]
    return {format_level(level): float(levels[at(level)]) for level in REGION_LEVELS}


def get_calibrated_level(level: float, calibrated: Mapping[str, float] | None) -> float:
    """Return the nominal level for a coverage ``level``, one of `REGION_LEVELS`; ``level`` itself without
    calibration."""
    return level if calibrated is None else calibrated[format_level(level)]
