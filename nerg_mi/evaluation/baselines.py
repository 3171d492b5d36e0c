"""Densities without a gaze field, which a gaze field must outperform, with settings tuned on the training rays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from nerg_mi.fields.gaze_hits import MAX_HITS, HitKernel, ReaimedHits, place_missing_points
from nerg_mi.fields.kde import Backend, SphericalKde, get_default_backend
from nerg_mi.fields.mlp import namespace
from nerg_mi.maths.sphere import aim
from nerg_mi.maths.vmf import log_normaliser
from nerg_mi.tracking.folds import iter_folds, sample_participants_equally
from nerg_mi.tracking.probes import compute_participant_weights
from nerg_mi.tracking.rays import Rays
from nerg_mi.train.gaze_folds import HIT_KERNELS
from nerg_mi.train.prior import select_prior_kappa
from nerg_mi.train.stacking import fit_weights

# Each baseline is a function ``(positions (P, 3), directions) -> (P, D)`` that returns densities in 1/sr, which
# integrate to one; ``directions`` is (D, 3) for all positions or (P, D, 3).
#
# A comparison is only fair if a baseline is tuned as carefully as the field. Number of neighbours, kernels and the
# weight of the position-independent prior are therefore those with the highest log density of held-out rays, over folds
# of the training rays that hold out what the test holds out: participants, positions, or both. The prior is that of a
# gaze field (`train.prior.select_prior_kappa`). The stack is what can be had without a network: a mixture of the prior,
# and of rays and re-aimed hits with kernels of all widths, whose weights are fitted to the same held-out rays.

Baseline = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Densities (P, D), 1/sr, of positions (P, 3) in directions (D, 3) or (P, D, 3)."""

UNIFORM, PRIOR, NEAREST_RAYS = "uniform", "position-independent prior", "nearest rays"
CONDITIONAL_KDE, REAIMED_HITS = "conditional kernel density", "re-aimed hits"
CONDITIONAL_HITS, STACK = "re-aimed hits, weighted by distance", "stack"
"""Names of the baselines."""

UNIFORM_DENSITY = 1.0 / (4.0 * np.pi)  # 1/sr
KAPPAS = (10.0, 20.0, 50.0, 100.0, 200.0, 400.0, 800.0)  # Candidate concentrations of the kernels of neighbours
COUNTS = (16, 64, 256, 1024, 4096)  # Candidate numbers of neighbours
BANDWIDTHS = (0.1, 0.2, 0.4, 0.8, 1.6)  # Candidate standard deviations (m) of kernels over positions
PRIOR_WEIGHTS = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9, 1.0)  # Candidate weights of the prior in a mixture
DEFAULT_SETTINGS: Mapping[str, Mapping[str, float]] = {
    NEAREST_RAYS: {"rays": 1024.0, "kappa": 20.0, "prior weight": 0.2},
    CONDITIONAL_KDE: {"rays": 4096.0, "bandwidth": 0.4, "kappa": 20.0, "prior weight": 0.2},
    REAIMED_HITS: {"rays": 1024.0, "kappa": 50.0, "prior weight": 0.2},
    CONDITIONAL_HITS: {"bandwidth": 0.4, "kappa": 120.0, "prior weight": 0.3},
}
"""Settings of the baselines where there are too few rays to tune them."""
# Of the stack: pseudo-rays of the prior, and of all kernels together, and the minimum weight of a kernel
_PRIOR_PSEUDO_RAYS, _KERNEL_PSEUDO_RAYS, _MIN_KERNEL_WEIGHT = 5.0, 10.0, 0.01
_FOLDS = 4  # Folds of the training rays
_MAX_TEST_RAYS = 256  # Held-out rays of a fold
MIN_AIM_DISTANCE = 0.15  # Metres below which the direction to a hit point is not used: the recorded one is
_MIN_DENSITY = 1e-9  # 1/sr, so that logarithms are finite
_BLOCK = 32  # Positions that are evaluated together
# Points per leaf of a KD-tree. The value decides the order of equally distant points, and so the last bits of sums.
_LEAF_SIZE = 16


@dataclass(frozen=True)
class TunedBaseline:
    """A baseline and its settings.

    Attributes
    ----------
    density : Baseline
        The density.
    settings : mapping
        Settings by name; empty if there are none.
    folds : int
        Number of folds that tuned them; 0: the settings are those of `DEFAULT_SETTINGS`.
    """

    density: Baseline
    settings: Mapping[str, float] = field(default_factory=dict)
    folds: int = 0


# ---- Densities ----


def make_uniform_baseline() -> Baseline:
    """Return the uniform density, 1/(4π)."""

    def evaluate(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return np.full((len(np.atleast_2d(positions)), np.shape(directions)[-2]), UNIFORM_DENSITY)

    return evaluate


def make_prior_baseline(
    rays: Rays, *, kappa: float = 50.0, weights: np.ndarray | None = None, backend: Backend = None
) -> Baseline:
    """Return the kernel density of all training rays with concentration ``kappa``, independent of the position.

    ``weights`` (n,) are those of the rays; None: equal.
    """
    # Runs of rays are separate mixtures, averaged in float64: one float32 sum of 10^5 terms would lose precision and
    # run in a single lane.
    runs = np.array_split(np.arange(len(rays)), max(1, len(rays) // 4096))
    offsets = np.concatenate([[0], np.cumsum([len(r) for r in runs])])
    kde = SphericalKde(rays.direction, offsets, kappa, weights, backend)
    fractions = np.diff(offsets) / len(rays)
    if weights is not None:
        fractions = np.add.reduceat(weights, offsets[:-1]) / weights.sum()

    def evaluate(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        P = len(np.atleast_2d(positions))
        directions = np.asarray(directions)
        density = fractions @ kde.evaluate(directions.reshape(-1, 3)).astype(np.float64)
        return np.broadcast_to(density, (P, len(density))) if directions.ndim == 2 else density.reshape(P, -1)

    return evaluate


class CachedBaseline:
    """Caches the densities of a baseline for each pair of position and direction arrays.

    Arrays are compared by identity and must not change. The returned arrays are read-only.
    """

    def __init__(self, method: Baseline):
        self._method = method
        self._answers: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def __call__(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        for p, d, answer in self._answers:
            if p is positions and d is directions:
                return answer
        answer = np.asarray(self._method(positions, directions))
        answer.setflags(write=False)
        self._answers.append((positions, directions, answer))
        return answer


class NearestRays:
    """The training rays nearest to a position, as seen from it.

    Parameters
    ----------
    rays : Rays
        Training rays.
    hits : numpy.ndarray, optional
        Hit points (n, 3) of the rays in metres; not finite: none. With them, directions are those from the position to
        the hit points ("re-aimed"), otherwise the recorded ones.
    """

    def __init__(self, rays: Rays, hits: np.ndarray | None = None):
        from scipy.spatial import KDTree

        self._directions, self._hits = np.asarray(rays.direction, np.float64), hits
        # SciPy's stubs lack sequences of ranks.
        self._tree: Any = KDTree(rays.origin, leafsize=_LEAF_SIZE)

    def find(self, positions: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Find up to ``count`` rays of each of ``positions`` (P, 3): distances (P, k) in metres, nearest first, and
        directions (P, k, 3)."""
        distance, recorded, aimed = self.find_both(positions, count)
        return distance, recorded if aimed is None else aimed

    def find_both(self, positions: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Find the same rays: distances, recorded directions, and directions to the hit points, None without them."""
        k = min(count, len(self._directions))
        # A sequence of ranks, so that one neighbour also has an axis of its own.
        distance, index = self._tree.query(positions, k=np.arange(1, k + 1))
        directions = self._directions[index]
        if self._hits is None:
            return distance, directions, None
        return distance, directions, aim(self._hits[index], directions, positions[:, None], MIN_AIM_DISTANCE)


class NeighbourDensity:
    """Kernel density of the rays nearest to a position, mixed with the prior.

    Parameters
    ----------
    neighbours : NearestRays
        Training rays.
    prior : Baseline
        Position-independent prior.
    count : int
        Number of neighbours.
    kappa : float
        Concentration of the kernel around each direction.
    prior_weight : float
        Weight of the prior.
    bandwidth : float, optional
        Standard deviation in metres of a normal weight of the distance to the position. None: equal weights.
    backend : Backend
        Where the kernels are evaluated.
    """

    def __init__(
        self,
        neighbours: NearestRays,
        prior: Baseline,
        *,
        count: int,
        kappa: float,
        prior_weight: float,
        bandwidth: float | None = None,
        backend: Backend = None,
    ):
        self._neighbours, self._prior, self._count, self._kappa = neighbours, prior, int(count), kappa
        self._prior_weight, self._bandwidth, self._backend = prior_weight, bandwidth, backend

    def __call__(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Evaluate the densities (P, D) of positions (P, 3) in unit directions (D, 3) or (P, D, 3)."""
        positions, directions = np.atleast_2d(np.asarray(positions, np.float64)), np.asarray(directions)
        prior = self._prior(positions, directions)
        if self._prior_weight == 1:
            return np.asarray(prior)
        parts = []
        for start in range(0, len(positions), _BLOCK):
            rows = slice(start, start + _BLOCK)
            distance, aimed = self._neighbours.find(positions[rows], self._count)
            weights = None if self._bandwidth is None else _weigh(distance, self._bandwidth).ravel()
            offsets = np.arange(len(aimed) + 1) * aimed.shape[1]
            kde = SphericalKde(aimed.reshape(-1, 3), offsets, self._kappa, weights, self._backend)
            parts.append(kde.evaluate(directions if directions.ndim == 2 else directions[rows]))
        return (1 - self._prior_weight) * np.concatenate(parts).astype(np.float64) + self._prior_weight * prior


def _weigh(distance: np.ndarray, bandwidth: float) -> np.ndarray:
    """Return normal weights of ``distance`` (P, k), sorted, relative to that of the nearest."""
    return np.exp(0.5 * (distance[:, :1] ** 2 - distance**2) / bandwidth**2)


class KernelMixture:
    """Mixture of the prior and of kernels of training rays, with Gaussian weights of the distance to the position.

    Parameters
    ----------
    prior : Baseline
        Position-independent prior, whose weight is that left by ``parts``.
    parts : sequence of ReaimedHits
        Kernels of re-aimed hits and of rays, in metres.
    """

    def __init__(self, prior: Baseline, parts: Sequence[ReaimedHits]):
        self._prior, self._parts = prior, parts
        self._prior_weight = max(0.0, 1 - sum(part.weight for part in parts))

    def __call__(self, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Evaluate the densities (P, D) of positions (P, 3) in unit directions (D, 3) or (P, D, 3)."""
        positions, directions = np.atleast_2d(np.asarray(positions, np.float64)), np.asarray(directions)
        density = self._prior_weight * np.asarray(self._prior(positions, directions))
        ns = namespace(get_default_backend())
        for start in range(0, len(positions), _BLOCK):
            rows = slice(start, start + _BLOCK)
            d = directions if directions.ndim == 2 else directions[rows]
            for part in self._parts:
                density[rows] += part.weight * part.observe(positions[rows], ns).evaluate(d)
        return density


def _make_kernels(rays: Rays, is_aimed: bool, weights: Sequence[float]) -> ReaimedHits | None:
    """Make the kernels `HIT_KERNELS` with positive ``weights`` of rays, or of hits if ``is_aimed``; None if there are
    none."""
    kernels = [HitKernel(weight, *kernel) for weight, kernel in zip(weights, HIT_KERNELS) if weight > 0]
    if not kernels:
        return None
    # A point far away has the recorded direction from all positions.
    points, width = rays.hit if is_aimed else None, max(kernel.bandwidth for kernel in kernels)
    return ReaimedHits(rays.origin, place_missing_points(rays.origin, rays.direction, points, width), kernels)


# ---- Tuning ----


class _Candidates(NamedTuple):
    """Log densities (nats of 1/sr) of each held-out ray by candidate settings."""

    settings: list[dict[str, float]]
    log_density: np.ndarray  # (candidates, rays)


def make_tuned_baselines(
    rays: Rays,
    radius: float,
    hits: np.ndarray | None = None,
    *,
    participants: bool = True,
    positions: bool = True,
    prior_kappa: float | None = None,
    seed: int = 0,
) -> dict[str, TunedBaseline]:
    """Make the baselines of the training ``rays``, each with the settings that predict held-out training rays best.

    Parameters
    ----------
    rays : Rays
        Training rays.
    radius : float
        Radius of a held-out position in metres.
    hits : numpy.ndarray, optional
        Hit points (n, 3) of the rays, not finite for a ray without one; None without surfaces.
    participants, positions : bool
        What the test holds out, and therefore also the folds.
    prior_kappa : float, optional
        Concentration of the prior's kernels. None: selected by leaving out participants.
    seed : int
        Seed of the folds.

    Returns
    -------
    dict of str to TunedBaseline
        The uniform density, the position-independent prior, the nearest rays, the conditional kernel density, with
        ``hits`` the re-aimed hits (nearest, and weighted by distance), and the stack.

    Notes
    -----
    If no fold has enough rays, the settings are `DEFAULT_SETTINGS`, and not tuned.
    """
    kinds = {NEAREST_RAYS: (False, False), CONDITIONAL_KDE: (True, False)}
    if hits is not None and np.isfinite(hits).all(axis=1).any():
        kinds[REAIMED_HITS] = (False, True)
        rays = replace(rays, hit=np.asarray(hits, np.float64))
    if prior_kappa is None:
        prior_kappa = select_prior_kappa(rays, "person", seed)
    aims = (False, True) if REAIMED_HITS in kinds else (False,)
    scores: dict[str, list[np.ndarray]] = {name: [] for name in kinds}
    columns: list[np.ndarray] = []
    participant: list[np.ndarray] = []
    settings: dict[str, list[dict[str, float]]] = {}
    # All baselines evaluate it.
    make_prior = lambda rays: CachedBaseline(
        make_prior_baseline(rays, kappa=prior_kappa, weights=compute_participant_weights(rays))
    )
    for k, fold in enumerate(iter_folds(rays, radius, _FOLDS, seed, participants=participants, positions=positions)):
        # At recorded and at new positions alike: settings for the few positions far from all others do worse elsewhere.
        test = fold.sample(_MAX_TEST_RAYS, seed + k)
        prior_densities = make_prior(fold.train)(np.zeros((1, 3)), test.direction)[0]
        neighbours = _find_neighbours(fold.train, test, REAIMED_HITS in kinds)
        for name, (is_conditional, is_aimed) in kinds.items():
            scored = _score_neighbours(neighbours, test, prior_densities, is_conditional, is_aimed)
            scores[name].append(_average_participants(scored.log_density, test))
            settings[name] = scored.settings
        columns.append(np.column_stack([prior_densities, *_evaluate_kernels(fold.train, test, aims)]))
        participant.append(test.person + k * len(rays.persons))
    prior = make_prior(rays)
    tuned = {
        UNIFORM: TunedBaseline(make_uniform_baseline()),
        PRIOR: TunedBaseline(prior, {"kappa": prior_kappa}, len(np.unique(rays.person))),
    }
    for name, (_, is_aimed) in kinds.items():
        folds = len(scores[name])
        best = DEFAULT_SETTINGS[name]
        if folds:
            best = settings[name][int(np.concatenate(scores[name], axis=1).mean(axis=1).argmax())]
        neighbours = NearestRays(rays, rays.hit if is_aimed else None)
        tuned[name] = TunedBaseline(_make_neighbour_density(neighbours, prior, best), best, folds)
    sample = sample_participants_equally(rays, MAX_HITS, 0)
    make_mixture = lambda weights: KernelMixture(
        prior,
        [
            part
            for aimed, of_kind in zip(aims, weights[1:].reshape(len(aims), -1))
            if (part := _make_kernels(sample, aimed, of_kind)) is not None
        ],
    )
    densities = np.concatenate(columns) if columns else None
    units = np.concatenate(participant) if columns else None
    if len(aims) > 1:
        best, weights = _tune_single_kernel(densities, units)
        tuned[CONDITIONAL_HITS] = TunedBaseline(make_mixture(weights), best, len(columns))
    weights = _fit_stack(densities, units, len(aims))
    shown = {"prior weight": round(float(weights[0]), 2), "kernels": float(np.count_nonzero(weights[1:]))}
    tuned[STACK] = TunedBaseline(make_mixture(weights), shown, len(columns))
    return tuned


def _evaluate_kernels(train: Rays, test: Rays, aims: Sequence[bool]) -> list[np.ndarray]:
    """Evaluate `HIT_KERNELS` of the rays ``train``, and of their hits, at the rays ``test`` (n, K)."""
    sample, out = sample_participants_equally(train, MAX_HITS, 0), []
    for is_aimed in aims:
        part = _make_kernels(sample, is_aimed, [1 / len(HIT_KERNELS)] * len(HIT_KERNELS))
        assert part is not None
        out.append(part.evaluate_kernels(test.origin, test.direction))
    return out


def _tune_single_kernel(
    densities: np.ndarray | None, participant: np.ndarray | None
) -> tuple[Mapping[str, float], np.ndarray]:
    """Return the settings of the kernel of re-aimed hits that is best with the prior, and the weights of the columns of
    ``densities``: of the prior, of rays and of re-aimed hits."""
    best, size = DEFAULT_SETTINGS[CONDITIONAL_HITS], len(HIT_KERNELS)
    if densities is not None and participant is not None:
        prior, aimed = densities[:, :1], densities[:, 1 + size :]
        candidates = []
        for weight in PRIOR_WEIGHTS:
            log = np.log(np.maximum((1 - weight) * aimed + weight * prior, _MIN_DENSITY))
            means = np.mean([log[participant == p].mean(axis=0) for p in np.unique(participant)], axis=0)
            candidates.append((means.max(), weight, int(means.argmax())))
        _, weight, k = max(candidates)
        best = dict(zip(("bandwidth", "kappa"), HIT_KERNELS[k])) | {"prior weight": weight}
    weights = np.zeros(1 + 2 * size)
    weights[0] = best["prior weight"]
    weights[1 + size + HIT_KERNELS.index((best["bandwidth"], best["kappa"]))] = 1 - weights[0]
    return best, weights


def _fit_stack(densities: np.ndarray | None, participant: np.ndarray | None, kinds: int) -> np.ndarray:
    """Fit the weights of the columns of ``densities``: of the prior, and of the kernels of each of the ``kinds``."""
    default, size = DEFAULT_SETTINGS[CONDITIONAL_HITS], kinds * len(HIT_KERNELS)
    weights = np.zeros(1 + size)
    if densities is None or participant is None:
        kernel = HIT_KERNELS.index((default["bandwidth"], default["kappa"]))
        weights[[0, 1 + size - len(HIT_KERNELS) + kernel]] = default["prior weight"], 1 - default["prior weight"]
        return weights
    log, index = np.log(np.maximum(densities, _MIN_DENSITY)).T, np.arange(1 + size)
    for _ in range(2):
        pseudo_rays = np.array([_PRIOR_PSEUDO_RAYS, *[_KERNEL_PSEUDO_RAYS / size] * (len(index) - 1)])
        fitted = fit_weights(log[index], participant, pseudo_rays)
        weights[:] = 0
        weights[index] = fitted
        index = np.flatnonzero((weights >= _MIN_KERNEL_WEIGHT) | (np.arange(1 + size) == 0))
    return weights


def format_settings(baselines: Mapping[str, TunedBaseline]) -> str:
    """Format the settings of ``baselines`` as a sentence."""
    with_settings = {name: baseline for name, baseline in baselines.items() if baseline.settings}
    parts = [
        f"{name} ({', '.join(f'{key} {value:g}' for key, value in baseline.settings.items())})"
        for name, baseline in with_settings.items()
    ]
    if all(baseline.folds for baseline in with_settings.values()):
        source = "tuned on folds of the training rays, with or without zones of positions, whichever is better here"
    else:
        source = "not tuned, because there are too few training rays for folds"
    return f"Settings of the baselines, {source}: {'; '.join(parts)}."


def _make_neighbour_density(
    neighbours: NearestRays, prior: Baseline, settings: Mapping[str, float]
) -> NeighbourDensity:
    return NeighbourDensity(
        neighbours,
        prior,
        count=int(settings["rays"]),
        kappa=settings["kappa"],
        prior_weight=settings["prior weight"],
        bandwidth=settings.get("bandwidth"),
    )


class _Neighbours(NamedTuple):
    """The k training rays nearest to some held-out rays."""

    distance: np.ndarray  # (b, k), nearest first
    cosine: np.ndarray  # Of the angle between each held-out ray and the recorded directions (b, k)
    aimed_cosine: np.ndarray | None  # The same of the directions to the hit points; None without them


def _find_neighbours(train: Rays, test: Rays, is_aimed: bool) -> list[_Neighbours]:
    """Find the neighbours of the rays ``test`` in blocks of `_BLOCK`; to the hit points as well if ``is_aimed``."""
    near, blocks = NearestRays(train, train.hit if is_aimed else None), []
    for start in range(0, len(test), _BLOCK):
        rows = slice(start, start + _BLOCK)
        distance, recorded, aimed = near.find_both(test.origin[rows], COUNTS[-1])
        compare = lambda directions, rows=rows: np.einsum("bkc,bc->bk", directions, test.direction[rows])
        blocks.append(_Neighbours(distance, compare(recorded), None if aimed is None else compare(aimed)))
    return blocks


def _score_neighbours(
    neighbours: Sequence[_Neighbours], test: Rays, prior: np.ndarray, is_conditional: bool, is_aimed: bool
) -> _Candidates:
    """Score the densities of the ``neighbours`` of the n rays ``test``; ``prior`` (n,) are the prior's."""
    counts = COUNTS[-1:] if is_conditional else COUNTS
    keys = [
        {"rays": float(counts[-1]), "bandwidth": h} if is_conditional else {"rays": float(k)}
        for h in (BANDWIDTHS if is_conditional else (0.0,))
        for k in counts
    ]
    plain = np.empty((len(KAPPAS), len(keys), len(test)))
    for block, (distance, recorded, aimed) in enumerate(neighbours):
        rows, cosine = slice(block * _BLOCK, (block + 1) * _BLOCK), aimed if is_aimed else recorded
        assert cosine is not None
        weights = [_weigh(distance, h) for h in BANDWIDTHS] if is_conditional else []
        for i, kappa in enumerate(KAPPAS):
            kernel = np.exp(kappa * (cosine - 1) + log_normaliser(kappa))
            if is_conditional:
                values = [(w * kernel).sum(axis=1) / w.sum(axis=1) for w in weights]
            else:
                total = np.cumsum(kernel, axis=1)
                values = [total[:, min(k, total.shape[1]) - 1] / min(k, total.shape[1]) for k in counts]
            plain[i, :, rows] = values
    settings, log_density = [], []
    for i, kappa in enumerate(KAPPAS):
        for j, key in enumerate(keys):
            for weight in PRIOR_WEIGHTS:
                settings.append({**key, "kappa": kappa, "prior weight": weight})
                log_density.append(np.log(np.maximum((1 - weight) * plain[i, j] + weight * prior, _MIN_DENSITY)))
    return _Candidates(settings, np.array(log_density))


def _average_participants(log_density: np.ndarray, test: Rays) -> np.ndarray:
    """Return the mean ``log_density`` (candidates, n) of each participant's rays (candidates, N)."""
    return np.stack([log_density[:, test.person == p].mean(axis=1) for p in np.unique(test.person)], axis=1)
