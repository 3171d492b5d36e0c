"""A gaze field at positions, and of people, that it was not trained on, beside what needs no field.

Truth at a test position is the kernel density of the rays within R of it. Maps are compared over directions of equal
area, rays one by one as they are. What is uncertain is which people came: intervals are a bootstrap over persons, who
are drawn whole, with all of their rays (Efron & Tibshirani 1993).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.evaluation import saliency as metrics
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.probes.kde import SphericalKde
from nerg_mi.probes.probes import place_probes
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.splits import purge, split_by_person

from .baselines import Baseline
from .scores import EPS

SPLITS = ("both", "pos", "people")
"""What may be new to a field: positions and people, positions, or people."""
MAPS, RAYS = ("KLD", "CC", "SIM", "MAE"), ("NSS", "AUC", "sAUC", "bits", "loglik")
SCORES = MAPS + RAYS
"""KLD in nats and CC, SIM of densities normalised over the sphere; MAE in 1/sr of densities as they are; NSS; AUC-Judd;
sAUC against rays of other test positions; bits a ray beyond the blind density; mean log density (nats of 1/sr) of a
ray."""
# Share of an evaluation's time that goes to the densities of methods that are quick; the rest goes to resamples.
_ANSWERS = 0.2
# Rays that are drawn at each test position, and scored one by one.
_PER_POSITION = 128


@dataclass(frozen=True, eq=False)
class GazeTest:
    """What a density is scored on at P positions, of N persons, in D directions and by K rays each."""

    # Positions (P, 3), metres, in the rays' frame.
    centres: np.ndarray
    # Directions (D, 3) of equal area, in which maps are compared.
    directions: np.ndarray
    # True densities (P, D), 1/sr.
    truth: np.ndarray
    # Those of each person alone (P, N, D).
    parts: np.ndarray
    # Rays of each person at each position (P, N).
    counts: np.ndarray
    # Names of the persons.
    persons: tuple[str, ...]
    # Rays drawn at each position (P, K, 3).
    at: np.ndarray
    # Whose they are (P, K), indices of the persons.
    who: np.ndarray
    # Rays drawn at other positions (P, K, 3).
    others: np.ndarray

    @cached_property
    def drawn(self) -> np.ndarray:
        """Rays that densities are asked for, (P, 2 K, 3): those drawn at each position, then those at others."""
        return np.concatenate([self.at, self.others], axis=1)


def held_out_rays(rays: Rays, account: dict, split: str = "both", seed: int = 0) -> tuple[Rays, Rays, np.ndarray]:
    """``(training rays, test rays, test centres)`` of a checkpoint's ``account`` of what it held out (``hold_out``).

    ``split``: ``both``: positions and people that are new; ``pos``: people who were trained on, at new positions;
    ``people``: new people where others were trained on. Raises ``NergError`` where nobody was held out.
    """
    if split not in SPLITS:
        raise NergError(f'the split must be one of {", ".join(SPLITS)}, got "{split}"')
    centres, unseen = np.array(account["centres"]), np.zeros(len(rays), bool)
    if account.get("people"):
        unseen = split_by_person(rays, test_persons=account["people"])[1]
    elif split != "pos":
        raise NergError(
            f'no people were held out of this training, so that there is no split "{split}"; train with --test-people'
        )
    away = purge(rays, centres, account["purged_within"])
    train = rays.select(~unseen & away)
    if split == "people":
        scored = rays.select(unseen & away)
        return train, scored, scored.origin[np.random.default_rng(seed).permutation(len(scored))[: len(centres)]]
    return train, rays.select(unseen if split == "both" else ~unseen), centres


def make_test(
    rays: Rays,
    centres: np.ndarray,
    radius: float,
    kappa: float = 20.0,
    directions: int = 2048,
    min_rays: int = 64,
    cap: int = 1024,
    seed: int = 0,
) -> GazeTest:
    """Truth around those of ``centres`` that have ``min_rays`` rays within ``radius`` metres, with a kernel of
    ``kappa``.

    ``directions``: that maps are compared in; ``cap``: rays that a truth is made of at most, the nearest; ``seed``: of
    the rays that are drawn. Raises `NergError` where none has.
    """
    enough = _enough(rays, centres, radius, min_rays)
    if not enough.any():
        raise NergError(f"none of {len(centres)} test positions has {min_rays} rays within {radius} m; lower min_rays")
    probes = place_probes(
        rays, radius, queries=centres[enough], cap=cap, min_rays=1, kappa_rule="fixed", kappa=kappa, centre="query"
    )
    d, rng = fibonacci_directions(directions), np.random.default_rng(seed)
    person = rays.person[probes.indices]
    present = np.unique(person)
    P, N = len(probes), len(present)
    parts, counts = np.zeros((P, N, directions), np.float32), np.zeros((P, N))
    probe = np.repeat(np.arange(P), probes.counts)
    # Runs of one person at one position are mixtures of their own.
    order = np.lexsort((person, probe))
    pair = np.stack([probe[order], np.searchsorted(present, person[order])], axis=1)
    runs, first = np.unique(pair, axis=0, return_index=True)
    kde = SphericalKde(probes.directions[order], np.append(first, len(order)), kappa)
    parts[runs[:, 0], runs[:, 1]] = kde.evaluate(d)
    counts[runs[:, 0], runs[:, 1]] = np.diff(np.append(first, len(order)))
    which = np.stack([rng.integers(a, b, _PER_POSITION) for a, b in zip(probes.offsets[:-1], probes.offsets[1:])])
    at = probes.directions[which]
    # From farther away than 2R where there is such a position, so that no ray is on both sides.
    apart = np.linalg.norm(probes.queries[:, None] - probes.queries[None], axis=2)
    far = [np.flatnonzero(row > 2 * radius) if (row > 2 * radius).any() else np.flatnonzero(row > 0) for row in apart]
    others = np.stack(
        [
            at[rng.choice(f, _PER_POSITION), rng.integers(0, _PER_POSITION, _PER_POSITION)] if len(f) else at[i]
            for i, f in enumerate(far)
        ]
    )
    truth = np.einsum("pn,pnd->pd", counts / counts.sum(axis=1, keepdims=True), parts)
    names = tuple(rays.persons[i] for i in present)
    return GazeTest(
        centres[enough], d, truth, parts, counts, names, at, np.searchsorted(present, person[which]), others
    )


def _enough(rays: Rays, centres: np.ndarray, radius: float, min_rays: int) -> np.ndarray:
    """Which of ``centres`` (P,) have ``min_rays`` rays within ``radius`` metres."""
    from scipy.spatial import KDTree

    return KDTree(rays.origin).query_ball_point(centres, radius, return_length=True) >= min_rays


def evaluate_gaze(
    test: GazeTest,
    methods: dict[str, Baseline],
    blind: Baseline,
    resamples: int = 200,
    seed: int = 0,
    on_part: Callable[[float], None] | None = None,
) -> list[dict]:
    """One row a method: the scores of ``SCORES``, each with ``.low`` and ``.high`` of its 95 % interval, and the
    integral.

    ``blind``: the density that bits are counted from. An interval is 1.96 standard errors of the bootstrap either way;
    not its quantiles, since the truth of a resample has fewer persons and narrower peaks, which every map meets worse.
    The resamples are the same for all methods: the last method is the bar, and of the first one the row has ``.less``,
    how much it is above the bar, with ``.less.low`` and ``.less.high``. The row of every other method has ``.gap``, how
    much the first method is above it, likewise. With fewer than three persons there are no intervals. ``on_part`` is
    told the share that is done.
    """
    rng, N = np.random.default_rng(seed), len(test.persons)
    told = on_part or (lambda share: None)
    answers = _answers(test, methods, blind, lambda share: told(_ANSWERS * share))
    rows = [
        {"method": name, **map_scores(test.truth, maps), **{k: float(v.mean()) for k, v in values.items()}}
        for name, maps, values in answers
    ]
    boot = [[] for _ in answers]
    for number in range(resamples if N >= 3 else 0):
        told(_ANSWERS + (1 - _ANSWERS) * number / resamples)
        times = rng.multinomial(N, np.full(N, 1 / N))
        share = test.counts * times
        held = share.sum(axis=1) > 0
        share = share[held] / share[held].sum(axis=1, keepdims=True)
        truth, weight = np.einsum("pn,pnd->pd", share, test.parts[held]), times[test.who].astype(float)
        for kept, (_, maps, values) in zip(boot, answers):
            kept.append(
                {
                    **map_scores(truth, maps[held]),
                    **{k: float((v * weight).sum() / weight.sum()) for k, v in values.items()},
                }
            )
    for row, kept, (_, maps, _) in zip(rows, boot, answers):
        for k in SCORES if kept else ():
            reach = 1.96 * np.std([b[k] for b in kept])
            row[f"{k}.low"], row[f"{k}.high"] = float(row[k] - reach), float(row[k] + reach)
        row["integral"] = float(4 * np.pi * maps.mean())
    for other, kept in zip(rows[1:], boot[1:]):
        for k in SCORES:
            other |= _difference(f"{k}.gap", rows[0][k] - other[k], [a[k] - b[k] for a, b in zip(boot[0], kept)])
    if len(rows) > 1:
        for k in SCORES:
            rows[0] |= {key.replace(".gap", ".less"): v for key, v in rows[-1].items() if key.startswith(f"{k}.gap")}
    return rows


def _difference(name: str, value: float, resampled: list[float]) -> dict[str, float]:
    """``value`` by ``name``, and the ends of its 95 % interval, where it was ``resampled``."""
    if not resampled:
        return {name: value}
    reach = 1.96 * np.std(resampled)
    return {name: value, f"{name}.low": float(value - reach), f"{name}.high": float(value + reach)}


def _answers(
    test: GazeTest, methods: dict[str, Baseline], blind: Baseline, on_part: Callable[[float], None] | None = None
) -> list[tuple[str, np.ndarray, dict[str, np.ndarray]]]:
    """``(name, maps (P, D), ray scores (P, K) by name)`` of each method. ``on_part`` is told the share that is done."""
    K = test.at.shape[1]
    ask = lambda method: [np.asarray(method(test.centres, v), np.float64) for v in (test.directions, test.drawn)]
    maps, at = ask(blind)
    log_blind, out = _log(at[:, :K], maps), []
    for name, method in methods.items():
        maps, at = ask(method)
        out.append((name, maps, ray_scores(maps, at[:, :K], at[:, K:], log_blind)))
        if on_part is not None:
            on_part(len(out) / len(methods))
    return out


def person_rows(test: GazeTest, methods: dict[str, Baseline], blind: Baseline, min_rays: int = 64) -> list[dict]:
    """One row a method and person: the person's rays, scored; map scores at positions where the person has ``min_rays``
    rays."""
    rows = []
    for name, maps, values in _answers(test, methods, blind):
        for i, person in enumerate(test.persons):
            own, enough = test.who == i, test.counts[:, i] >= min_rays
            scores = dict.fromkeys(MAPS, float("nan"))
            if enough.any():
                scores = map_scores(test.parts[enough, i], maps[enough])
            rays = {k: float(v[own].mean()) if own.any() else float("nan") for k, v in values.items()}
            rows.append({"method": name, "person": person, "rays": int(test.counts[:, i].sum()), **scores, **rays})
    return rows


def split_half(
    test_side: Rays,
    centres: np.ndarray,
    radius: float,
    kappa: float,
    blind: Baseline,
    min_rays: int = 64,
    seed: int = 0,
) -> dict | None:
    """Scores of one half of the people of ``test_side`` as predicted by the other, where both have ``min_rays`` rays: a
    reference and no bound. None where there is no such position, or only one person."""
    if len(np.unique(test_side.person)) < 2:
        return None
    halves = [test_side.select(mask) for mask in split_by_person(test_side, seed=seed)]
    both = np.logical_and(*(_enough(half, centres, radius, min_rays) for half in halves))
    if not both.any():
        return None
    first = make_test(halves[0], centres[both], radius, kappa, min_rays=min_rays)
    probes = place_probes(
        halves[1], radius, queries=first.centres, min_rays=1, kappa_rule="fixed", kappa=kappa, centre="query"
    )
    predicted = lambda positions, directions: probes.density(directions)
    row = evaluate_gaze(first, {"split half": predicted}, blind, resamples=0)[0]
    return {k: v for k, v in row.items() if "." not in k}


def map_scores(truth: np.ndarray, maps: np.ndarray) -> dict[str, float]:
    """Means over positions of the scores of ``MAPS``."""
    return {
        "KLD": float(metrics.kld(truth, maps, eps=EPS).mean()),
        "CC": float(metrics.cc(truth, maps).mean()),
        "SIM": float(metrics.sim(truth, maps).mean()),
        "MAE": float(metrics.mae(truth, maps).mean()),
    }


def ray_scores(maps: np.ndarray, at: np.ndarray, others: np.ndarray, log_blind: np.ndarray) -> dict[str, np.ndarray]:
    """The scores of ``RAYS`` of each ray, (P, K), from the densities ``maps`` (P, D), at the rays ``at`` (P, K), and at
    rays that were seen from elsewhere, ``others`` (P, M). AUC of a ray: the share of the sphere whose density is lower,
    ties half; their mean is AUC-Judd with as many thresholds as there are values."""
    log = _log(at, maps)
    below = lambda among: np.stack([_share_below(a, g) for a, g in zip(among, at)])
    return {
        "NSS": metrics.nss(maps, at),
        "AUC": below(maps),
        "sAUC": below(others),
        "bits": (log - log_blind) / np.log(2),
        "loglik": log,
    }


def _log(at: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Log of densities at rays, normalised over the sphere; what is negative or zero counts as the smallest that is
    known."""
    sphere = 4 * np.pi * np.maximum(maps, 0).mean(axis=1, keepdims=True)
    return np.log(np.maximum(at, 0) / np.where(sphere > 0, sphere, 1) + np.finfo(float).eps)


def _share_below(row: np.ndarray, gaze: np.ndarray) -> np.ndarray:
    ordered = np.sort(row)
    return 0.5 * (np.searchsorted(ordered, gaze, "left") + np.searchsorted(ordered, gaze, "right")) / len(row)
