"""Where a gaze field errs: near surfaces, far ones, and where there is none.

    python benchmarks/gaze_distance.py [--only supermarket,office] [--folds 3] [--out out/benchmarks/places]

Places, folds and options are those of `places.py`, whose kept fields are read where they are in the same folder. A row
a place and band of distance, from a test position to the surface in a direction: the band's share of the sphere, of
the true gaze, and of the field's; its part of the KLD, the integral of p log(p / q) - p + q over the band, which is
never negative and sums to the KLD over the bands (nats), of the field, of the position-blind density and of the
4,096 nearest rays; and by how many bits a ray is better told there than by the blind density. Means over folds.
"""

from __future__ import annotations

import argparse

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from output import print_table, write_rows
from place_fields import FoldField, fold_fields
from place_rays import Make, asked_places, parse, place_parser, write_place
from places import BLIND, OURS

import numpy as np

# Metres at which a band begins; what meets no surface is a band of its own.
EDGES = (0.0, 1.5, 3.0, 6.0, 12.0)
BANDS = (*(f"{a:g} to {b:g} m" for a, b in zip(EDGES[:-1], EDGES[1:])), f"{EDGES[-1]:g} m and more", "no surface")
NEAREST = "4,096 nearest rays"
METHODS = {"field": OURS, "blind": BLIND, "nearest": NEAREST}


def main(argv=None) -> None:
    from nerg_mi.jobs.backend import select_backend

    args, rows = parse(place_parser(__doc__, "places", folds=3), argv), []
    ns = select_backend("llvm_ad_rgb", args.threads)
    for name, make in asked_places(args).items():
        rows += measure(name, make, args, ns)
    write_rows(args.out / "distance.csv", rows)


def measure(name: str, make: Make, args: argparse.Namespace, ns) -> list[dict]:
    """A row a band of one place, which are printed; none of a place without surfaces."""
    folder, rays, where = write_place(name, make, args)
    if where.get("geometry") == "none":
        return []
    each = [bands(fold) for fold in fold_fields(folder, rays, where, args, ns)]
    rows = []
    for band in BANDS:
        own = [fold[band] for fold in each]
        # Of a fold without a ray in the band there are no bits.
        mean = lambda values: float(np.mean([v for v in values if v == v] or [np.nan]))
        rows.append({"place": name, "distance": band, **{k: mean([r[k] for r in own]) for k in own[0]}})
    table = [
        (r["distance"], *(f"{r[k]:.0%}" for k in ("sphere", "gaze", "of the field")))
        + tuple(f"{r[f'KLD {m}']:.3f}" for m in METHODS)
        + tuple("" if np.isnan(r[f"bits {m}"]) else f"{r[f'bits {m}']:+.2f}" for m in ("field", "nearest"))
        for r in rows
        if r["sphere"] > 0.0005
    ]
    print_table(
        f"{name}: by the distance of what is looked at",
        ("distance", "sphere", "gaze", "field", "KLD field", "KLD blind", "KLD nearest", "bits field", "bits nearest"),
        table,
    )
    return rows


def bands(fold: FoldField) -> dict[str, dict[str, float]]:
    """Of one fold's field, the numbers of each band."""
    from nerg_mi.evaluation.gaze.baselines import standard_baselines
    from nerg_mi.evaluation.gaze.scores import EPS
    from nerg_mi.training.geometry.surfaces import surface_distances

    train, test = fold.test("both")
    place, of = fold.place, fold.scoring
    blind, others = standard_baselines(train, fold.account["radius"], of.kappa, of.blind_kappa, fold.seed)
    methods = {k: fold.density() if name == OURS else others[name] for k, name in METHODS.items()}

    origins = place.points_from_rays(test.centres)

    def band_of(directions: np.ndarray) -> np.ndarray:
        """Which of `BANDS` each of directions (P, D, 3) ends in."""
        distance, escaped = surface_distances(place, origins, place.directions_from_rays(directions))
        return np.where(escaped, len(EDGES), np.searchsorted(EDGES, distance / place.align.scale, "right") - 1)

    maps_band = band_of(np.broadcast_to(test.directions, (len(origins), *test.directions.shape)))
    rays_band = band_of(test.at)
    shares = lambda density: density / density.sum(axis=1, keepdims=True)
    p = shares(np.asarray(test.truth, np.float64))
    q = {k: shares(np.maximum(np.asarray(m(test.centres, test.directions), float), 0)) for k, m in methods.items()}
    log_blind = np.log(_at(blind, test))
    bits = {k: (np.log(_at(m, test)) - log_blind) / np.log(2) for k, m in methods.items()}
    least, P = EPS / p.shape[1], len(p)
    out = {}
    for b, name in enumerate(BANDS):
        of, own = maps_band == b, rays_band == b
        row = {"sphere": of.mean(), "gaze": p[of].sum() / P, "of the field": q["field"][of].sum() / P}
        for k, density in q.items():
            a, c = p[of] + least, density[of] + least
            row[f"KLD {k}"] = (a * np.log(a / c) - a + c).sum() / P
            row[f"bits {k}"] = bits[k][own].mean() if own.any() else np.nan
        out[name] = row
    return out


def _at(method, test) -> np.ndarray:
    """Densities (P, K) at the test's rays, normalised by the map over the sphere, and never zero."""
    maps, at = (np.asarray(method(test.centres, d), np.float64) for d in (test.directions, test.at))
    sphere = 4 * np.pi * np.maximum(maps, 0).mean(axis=1, keepdims=True)
    return np.maximum(at, 0) / sphere + np.finfo(float).eps


if __name__ == "__main__":
    main()
