"""Intervals over people of what `places.py` scores, and what a known head tells beside it.

    python benchmarks/place_people.py [--only room,office] [--folds 3] [--out out/benchmarks/places]

Places, folds and options are those of `places.py`, whose kept fields are read where they are in the same folder. The
field less the best of the methods that need no field, with 1.96 standard errors of a bootstrap over the people who are
scored: they are drawn whole, together in all folds, and the truth is made of those who were drawn. `heads` is a density
about the direction in which the head points at that moment, as wide as that of the people who trained, with a tenth of
the uniform one; it has no map, since it is another one for each look. Bits of it, as all, are beyond the blind density.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from gaze_prior import forward
from output import print_table, write_rows
from place_fields import FoldField, fold_fields
from place_rays import Make, asked_places, parse, place_parser, write_place
from places import OURS, SCORES
from prior_cases import cosines_to_heads
from prior_law import LOG_UNIFORM, concentration
from prior_scores import Scored, bits_of, maps_of, truth_of

import numpy as np

HEADS, BLIND = "heads", "position-blind, kappa 50"
_RESAMPLES = 400


def main(argv=None) -> None:
    from nerg_mi.jobs.backend import select_backend

    args, rows = parse(place_parser(__doc__, "places", folds=3), argv), []
    ns = select_backend("llvm_ad_rgb", args.threads)
    for name, make in asked_places(args).items():
        rows.append(measure(name, make, args, ns))
        write_rows(args.out / "people.csv", rows)
    told = lambda r, s: f"{r[f'{s} less']:+.3f} ± {r[f'{s} reach']:.3f}"
    table = [
        (r["place"], r["people"], *(cell for s in SCORES for cell in (f"{r[s]:.3f}", told(r, s))))
        + ("" if np.isnan(r[HEADS]) else f"{r[HEADS]:.2f}",)
        for r in rows
    ]
    print_table(
        "Intervals over people", ("place", "people", *(h for s in SCORES for h in (s, "less best")), HEADS), table
    )


def measure(name: str, make: Make, args: argparse.Namespace, ns) -> dict:
    """The row of a place."""
    folder, rays, where = write_place(name, make, args)
    found = [s for k, fold in enumerate(fold_fields(folder, rays, where, args, ns)) for s in scored(k, fold)]
    return {"place": name, **summarise(found)}


def scored(number: int, fold: FoldField) -> list[Scored]:
    """Every method in a fold."""
    from nerg_mi.evaluation.gaze.baselines import standard_baselines
    from nerg_mi.evaluation.gaze.scores import EPS

    train, test = fold.test("both")
    of, out = fold.scoring, []
    _, others = standard_baselines(train, fold.account["radius"], of.kappa, of.blind_kappa, fold.seed)
    for method, density in {OURS: fold.density(), **others}.items():
        maps = np.maximum(np.asarray(density(test.centres, test.directions), float), 0)
        sphere = 4 * np.pi * maps.mean(axis=1, keepdims=True)
        at = np.maximum(np.asarray(density(test.centres, test.at), float), 0)
        logs = np.log(maps / sphere + EPS * np.exp(LOG_UNIFORM)), np.log(at / sphere + np.finfo(float).eps)
        out.append(Scored.of(method, 0, number, test, logs))
    if train.head is not None:
        mean = float(np.nanmean((train.head * train.direction).sum(axis=1)))
        people = fold.rays.select(np.isin(fold.rays.person, [fold.rays.persons.index(p) for p in test.persons]))
        at = forward(cosines_to_heads(people, test.at), concentration(mean))
        out.append(Scored.of_rays(HEADS, 0, number, test, at))
    return out


def summarise(found: Sequence[Scored]) -> dict:
    """Of the field: the means of its scores over folds, and by how much it is above the best other, with how far 95 %
    reach over people."""
    folds = sorted({s.fold for s in found})
    by = {(s.method, s.fold): s for s in found}
    tests = {k: by[OURS, k].test for k in folds}
    persons = sorted({p for t in tests.values() for p in t.persons})
    rng, count = np.random.default_rng(0), len(persons)
    draws = [np.ones(count, int), *rng.multinomial(count, np.full(count, 1 / count), _RESAMPLES)]
    methods = [m for m in dict.fromkeys(s.method for s in found) if m != HEADS]
    each = {m: np.full((len(draws), len(folds), len(SCORES)), np.nan) for m in (*methods, HEADS)}
    for i, times in enumerate(draws):
        for j, k in enumerate(folds):
            own = times[np.searchsorted(persons, tests[k].persons)]
            # Positions where none of those who were drawn stood have no truth.
            here = (tests[k].counts * own).sum(axis=1) > 0
            if not here.any():
                continue
            truth = truth_of(tests[k], own, here)
            for m in methods:
                s = by[m, k]
                each[m][i, j] = (*maps_of(s, *truth, here), bits_of(s, times, persons))
            if (HEADS, k) in by:
                each[HEADS][i, j, -1] = bits_of(by[HEADS, k], times, persons)
    values = {m: np.nanmean(v, axis=1) if np.isfinite(v).any() else v[:, 0] for m, v in each.items()}
    row: dict = {"people": count, "folds": len(folds)}
    for c, (s, high) in enumerate(SCORES.items()):
        others = {m: values[m][0, c] for m in methods if m != OURS}
        best = max(others, key=lambda m: others[m] if high else -others[m])
        zero = values[BLIND][:, c] if s == "bits" else 0.0
        less = values[OURS][:, c] - values[best][:, c]
        row |= {s: float((values[OURS][:, c] - zero)[0]), f"{s} best is": best, f"{s} less": float(less[0])}
        row[f"{s} reach"] = float(1.96 * np.nanstd(less[1:]))
    row[HEADS] = float((values[HEADS] - values[BLIND])[0, -1])
    return row


if __name__ == "__main__":
    main()
