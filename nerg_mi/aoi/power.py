"""Power of differences between cells: how often the test of differences detects an effect, by number of participants.

Participants are drawn with replacement from the recorded ones, together if they are in both cells. An effect of known
size is injected into the second cell, and each simulated data set is tested like the recorded one. The power is the
fraction of data sets with p <= 0.05, before the adjustment for several tests (Efron and Tibshirani, An Introduction to
the Bootstrap, 1993, section 25.4). Recorded participants replace the population, so that few of them, such as a pilot
study of five, say little about participants who differ from them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from .estimates import MIN_FOR_INTERVAL, Pair, estimate_proportion_differences, estimate_ratio_differences
from .tables import COMPARED_MEASURES, MAX_COMPARED_VALUES, MEASURED, MEASURES, MinParticipantsFilter, Participants, Row
from .visits import ALL, Cell

PARTICIPANT_COUNTS = (8, 12, 16, 24, 32, 48, 64, 96)
"""Numbers of participants of the table."""

SIMULATIONS = 400  # simulated data sets per number of participants: a standard error of at most 0.025
_RESAMPLES = 399  # bootstrap draws of each test
_SIGNIFICANCE = 0.05


def estimate_power(
    first: Pair,
    second: Pair,
    effect: float,
    counts: Sequence[int] = PARTICIPANT_COUNTS,
    *,
    is_proportion: bool = False,
    upper_limit: float = np.inf,
    simulations: int = SIMULATIONS,
    seed: int = 0,
) -> np.ndarray:
    """Estimate how often the difference of two ratios is detected (p <= 0.05), for each number of participants.

    Parameters
    ----------
    first, second
        Numerators and denominators (P,) of one area over the same P recorded participants, with denominator 0 for
        participants without data.
    effect
        Relative difference: the second ratio is ``1 + effect`` times the first one. Numerators of the second are scaled
        to this ratio; for proportions, successes of the second are added or removed at random.
    counts
        Numbers of participants (C,) in the larger of the two; the other one is smaller in the same ratio as recorded.
    is_proportion
        Whether the numerators are 0 or 1.
    upper_limit
        Largest possible ratio.
    simulations
        Number of simulated data sets S.
    seed
        Seed of the draws.

    Returns
    -------
    np.ndarray
        Power (C,); NaN if fewer than three participants contribute to a ratio, or the effect exceeds the limit.
    """
    if find_power_fault(first, second, effect, upper_limit):
        return np.full(len(counts), np.nan)
    (x, y), (u, v) = first, second
    recorded, target = u.sum() / v.sum(), x.sum() / y.sum() * (1 + effect)
    strata = (y > 0).astype(int) + 2 * (v > 0)
    num_larger = max((y > 0).sum(), (v > 0).sum())
    power = []
    for count in counts:
        rng = np.random.default_rng((seed, count))
        members = [np.flatnonzero(strata == k) for k in (1, 2, 3)]
        drawn = np.concatenate(
            [rng.choice(m, (round(count * len(m) / num_larger), simulations)) for m in members if len(m)]
        )
        outcome = u[drawn]
        if is_proportion:
            # Successes become failures, or failures successes, with the probability that leads to the target.
            change = target - recorded
            probability = np.where(outcome > 0, -change / recorded, change / max(1 - recorded, 1e-9))
            is_changed = (rng.random(drawn.shape) < probability) & (v[drawn] > 0)
            pairs = (x[drawn], y[drawn]), (np.where(is_changed, 1 - outcome, outcome), v[drawn])
            p = estimate_proportion_differences(*pairs).p
        else:
            pairs = (x[drawn], y[drawn]), (outcome * (target / recorded), v[drawn])
            p = estimate_ratio_differences(*pairs, resamples=_RESAMPLES, seed=seed).p
        power.append(np.mean(p <= _SIGNIFICANCE))
    return np.array(power)


def find_power_fault(first: Pair, second: Pair, effect: float, upper_limit: float = np.inf) -> str:
    """Return why `estimate_power` has no result for these arguments; "" if it has one."""
    (x, y), (u, _) = first, second
    if min((x != 0).sum(), (u != 0).sum()) < MIN_FOR_INTERVAL:
        return f"undefined, fewer than {MIN_FOR_INTERVAL} participants with values other than 0"
    target = x.sum() / y.sum() * (1 + effect)
    return f"undefined, the effect leads to {target:.3g}, above {upper_limit:g}" if target > upper_limit else ""


def power_rows(
    areas: Sequence[str],
    cells: Mapping[Cell, Mapping[str, Participants]],
    suppression: MinParticipantsFilter,
    effect: float,
    *,
    seed: int,
    simulations: int = SIMULATIONS,
    measures: Sequence[str] = COMPARED_MEASURES,
) -> list[Row]:
    """Return the power of the differences between recorded cells, for each area and measure.

    Without two cells of a dimension, the table is for two independent groups of which each is like all participants. A
    row has the first keys of those of `nerg_mi.aoi.tables.difference_rows`, the ``effect``, and ``power_N`` for
    N participants; None if the power is undefined or suppressed, and the ``note`` says why.
    """
    pairs = []
    for dimension in dict.fromkeys(cell.dimension for cell in cells):
        values = [c for c in cells if c.dimension == dimension and MEASURED in cells[c] and cells[c][MEASURED].names]
        pairs += [
            (dimension, (a.value, b.value), (cells[a][MEASURED], cells[b][MEASURED]))
            for a, b in combinations(values[:MAX_COMPARED_VALUES], 2)
        ]
    if not pairs and MEASURED in cells.get(ALL, {}):
        everyone = cells[ALL][MEASURED]
        groups = [replace(everyone, names=tuple(f"{k} {name}" for name in everyone.names)) for k in (1, 2)]
        pairs = [("all", ("one group", "another group"), tuple(groups))]
    rows: list[Row] = []
    for dimension, values, groups in pairs:
        names = sorted({name for group in groups for name in group.names})
        aligned = [group.align_to(names) for group in groups]
        for measure in (m for m in MEASURES if m.name in measures):
            first, second = (measure.numerator_denominator(group) for group in aligned)
            if first is None or second is None:
                continue
            for k, area in enumerate(areas):
                one, other = ((x[:, k], y[:, k]) for x, y in (first, second))
                row: Row = {"cell": dimension, "first": values[0], "second": values[1], "aoi": area}
                row |= {"measure": measure.name, "effect": effect}
                note = find_power_fault(one, other, effect, measure.upper_limit)
                if not suppression.admit(int(min((one[1] > 0).sum(), (other[1] > 0).sum()))):
                    note = suppression.reason
                power = np.full(len(PARTICIPANT_COUNTS), np.nan)
                if not note:
                    power = estimate_power(
                        one,
                        other,
                        effect,
                        is_proportion=measure.is_proportion,
                        upper_limit=measure.upper_limit,
                        simulations=simulations,
                        seed=seed,
                    )
                row |= {f"power_{n}": float(p) if np.isfinite(p) else None for n, p in zip(PARTICIPANT_COUNTS, power)}
                rows.append(row | {"note": note})
    return rows
