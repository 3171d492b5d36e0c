"""Scores of densities in the folds of a place, and their intervals: a bootstrap over the people who are scored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from prior_law import LOG_UNIFORM

import numpy as np

_RESAMPLES = 400
# Of a truth (1/sr), so that its logarithm is finite.
_LEAST = 1e-12


@dataclass(frozen=True, eq=False)
class Scored:
    """A density in a fold. Both KLD and CC are linear in the truth but for what depends on the truth alone, so that of
    each person ``cross`` (P, N), the mean of log q, and ``product`` (P, N), the covariance over q's deviation, are
    enough; ``bits`` (P, K) of each ray."""

    method: str
    people: int
    fold: int
    test: Any
    cross: np.ndarray
    product: np.ndarray
    bits: np.ndarray

    @staticmethod
    def of(method: str, people: int, fold: int, test: Any, logs: tuple[np.ndarray, np.ndarray]) -> Scored:
        """``logs``: of the density in the test's directions (P, D) and at its rays (P, K)."""
        log, at = logs
        q = np.exp(log)
        share = np.log(q / q.sum(axis=1, keepdims=True))
        parts = test.parts / np.maximum(test.parts.sum(axis=2, keepdims=True), 1e-30)
        away = q - q.mean(axis=1, keepdims=True)
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
        # A uniform density has no correlation.
        away[np.ptp(q, axis=1) < 1e-9] = 0
        return Scored(
            method,
            people,
            fold,
            test,
            np.einsum("pnd,pd->pn", parts, share),
            np.einsum("pnd,pd->pn", parts, away),
            (at - LOG_UNIFORM) / np.log(2),
        )

    @staticmethod
    def of_rays(method: str, people: int, fold: int, test: Any, at: np.ndarray) -> Scored:
        """Of a density that differs from ray to ray, known as its log at them (P, K): there is no map to compare."""
        nothing = np.full(test.counts.shape, np.nan)
        return Scored(method, people, fold, test, nothing, nothing, (at - LOG_UNIFORM) / np.log(2))


def summarise(name: str, found: Sequence[Scored], seed: int = 0) -> list[dict]:
    """A row a method and number of people: means over folds and draws of KLD (nats), CC and bits; 95 % intervals of the
    bits, and of by how much they are above those of the blind density of as many people (``less``). People are
    resampled whole, together in all folds."""
    tests = {s.fold: s.test for s in found}
    persons = sorted({p for t in tests.values() for p in t.persons})
    rng = np.random.default_rng(seed)
    draws = [np.ones(len(persons), int)]
    draws += [rng.multinomial(len(persons), np.full(len(persons), 1 / len(persons))) for _ in range(_RESAMPLES)]
    truths = {k: truth_of(t, np.ones(len(t.persons))) for k, t in tests.items()}
    bits = {id(s): np.array([bits_of(s, times, persons) for times in draws]) for s in found}
    rows = []
    groups = list(dict.fromkeys((s.people, s.method) for s in found))
    for people, method in sorted(groups, key=lambda g: g[0]):
        own = [s for s in found if (s.people, s.method) == (people, method)]
        # Beside a method that has fewer draws and folds stands the blind density of all.
        base = [s for s in found if (s.people, s.method) == (people, "blind")] if method != "blind" else []
        value = np.nanmean([bits[id(s)] for s in own], axis=0)
        if len(base) > len(own):
            firsts = {s.fold: s for s in reversed(base)}
            base = [firsts[s.fold] for s in own]
        less = value - np.nanmean([bits[id(s)] for s in base], axis=0) if base else np.full(len(value), np.nan)
        maps = np.mean([maps_of(s, *truths[s.fold]) for s in own], axis=0)
        row = {"place": name, "people": people, "method": method, "KLD": maps[0], "CC": maps[1], "bits": value[0]}
        row |= {"bits.low": np.nanquantile(value[1:], 0.025), "bits.high": np.nanquantile(value[1:], 0.975)}
        row["less"] = less[0]
        low, high = np.quantile(less[1:], (0.025, 0.975)) if base else (np.nan, np.nan)
        rows.append(row | {"less.low": low, "less.high": high})
    return rows


def truth_of(
    test: Any, times: np.ndarray, here: np.ndarray | slice = slice(None)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``(share of each person (P, N), negative entropy (P,), norm of the deviation (P,))`` of the truth at the
    positions ``here``, where each person counts so many ``times`` (N,)."""
    share = test.counts[here] * times
    share = share / share.sum(axis=1, keepdims=True)
    parts = test.parts[here]
    parts = parts / np.maximum(parts.sum(axis=2, keepdims=True), 1e-30)
    p = np.einsum("pn,pnd->pd", share, parts)
    entropy = (p * np.log(np.maximum(p, _LEAST))).sum(axis=1)
    return share, entropy, np.linalg.norm(p - p.mean(axis=1, keepdims=True), axis=1)


def maps_of(
    s: Scored, share: np.ndarray, entropy: np.ndarray, norm: np.ndarray, here: np.ndarray | slice = slice(None)
) -> tuple[float, float]:
    """KLD (nats) and CC, means over the positions ``here``, whose truth is that of `truth_of`."""
    kld = entropy - (share * s.cross[here]).sum(axis=1)
    return float(kld.mean()), float(((share * s.product[here]).sum(axis=1) / norm).mean())


def bits_of(s: Scored, times: np.ndarray, persons: list[str]) -> float:
    """Mean over rays, each as often as its person; NaN where nobody is left."""
    own = times[np.searchsorted(persons, s.test.persons)]
    weight = own[s.test.who[:, : s.bits.shape[1]]]
    total = weight.sum()
    return float((s.bits * weight).sum() / total) if total else float("nan")
