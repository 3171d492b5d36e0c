"""Probes of a gaze field's training: their radius, and how wide their kernels are; scored where nobody was trained on.

    python benchmarks/gaze_probes.py [--only supermarket,store] [--folds 3] [--steps N]

The default recipe without a chosen share of the blind density, on the rays of half of the people that are 2R (0.5 m)
and more from 60 positions in three zones, whatever radius is tried: all variants have the same rays, are scored at the
same positions against the same people, and the truth's kernel is the same. `less` is a variant less the recipe's own,
fold by fold, with 95 % of Student's t.
"""

from __future__ import annotations

from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from output import print_table, write_rows
from place_rays import asked_places, parse, place_parser, write_place

import numpy as np

VARIANTS: dict[str, dict] = {
    "recipe: R 0.25 m, kappa 30": {},
    "R 0.125 m": {"radius": 0.125},
    "R 0.5 m": {"radius": 0.5},
    "kappa 10": {"kappa": 10.0},
    "kappa 100": {"kappa": 100.0},
    "Silverman's rule": {"kappa_rule": "silverman"},
    "leave-one-out": {"kappa_rule": "loo"},
}
SCORES = ("KLD", "CC", "bits")
ZONES, POSITIONS, MIN_RAYS, KAPPA = 3, 60, 64, 20.0


def main(argv=None) -> None:
    from nerg_mi.jobs.backend import select_backend

    parser = place_parser(__doc__, "gaze_probes", folds=3)
    parser.set_defaults(only="supermarket,store")
    parser.add_argument("--steps", type=int, help="Default: the recipe's.")
    args, each = parse(parser, argv), []
    ns = select_backend("llvm_ad_rgb", args.threads)
    for name, make in asked_places(args).items():
        folder, path, where = write_place(name, make, args)
        for fold in range(args.folds):
            for row in score(path, where, fold, folder / "gaze.safetensors", ns, args.steps):
                each.append({"place": name, "fold": fold, **row})
                print(name, fold, *(f"{k} {v:.3f}" if k in SCORES else v for k, v in row.items()), flush=True)
        rows = [row for row in each if row["place"] == name]
        print_table(f"Probes: {name}", ("variant", *(h for s in SCORES for h in (s, "less"))), summarise(rows))
    write_rows(args.out / "folds.csv", each)


def score(path: Path, where: dict, fold: int, checkpoint: Path, ns, steps: int | None):
    """A row a variant."""
    from nerg_mi.evaluation.gaze import evaluation
    from nerg_mi.evaluation.gaze.baselines import position_blind
    from nerg_mi.evaluation.gaze.scores import gaze_field, scores
    from nerg_mi.evaluation.saliency import information_gain
    from nerg_mi.formats.fields import load_gaze
    from nerg_mi.jobs.gaze import train_gaze
    from nerg_mi.jobs.gaze_places import place_of_training
    from nerg_mi.jobs.options.evaluation import GazeEvaluationOptions
    from nerg_mi.jobs.options.gaze import GazeOptions
    from nerg_mi.rays.rays import Rays
    from nerg_mi.training.gaze.recipes import gaze_recipe
    from nerg_mi.training.gaze.splits import hold_out

    rays, radius = Rays.load(path), gaze_recipe().probe_settings().radius
    _, account = hold_out(rays, radius, ZONES, POSITIONS, fold, MIN_RAYS, 0.5)
    train, scored, centres = evaluation.held_out_rays(rays, account, "both", fold)
    test = evaluation.make_test(scored, centres, radius, KAPPA, min_rays=MIN_RAYS, seed=fold)
    blind = position_blind(train)(test.centres, test.at)
    place_of = GazeEvaluationOptions(**{k: v for k, v in where.items() if k != "geometry"})
    for name, variant in VARIANTS.items():
        options = GazeOptions(**where, **variant, mix_folds=0, steps=steps, seed=fold, mode="llvm_ad_rgb")
        train_gaze(train, checkpoint, options)
        field, meta = load_gaze(checkpoint, ns)
        place = place_of_training(checkpoint, meta["provenance"], field.box, place_of, ns)
        density = gaze_field(field, place.medium, place.align)
        found = scores(test.truth, density(test.centres, test.directions))
        bits = float(information_gain(density(test.centres, test.at), blind).mean())
        yield {"variant": name, "KLD": found["KLD"], "CC": found["CC"], "bits": bits}


def summarise(rows: list[dict]) -> list[list[str]]:
    """Means over folds, and how far they are from the recipe's."""
    from scipy.stats import t

    first, out = next(iter(VARIANTS)), []
    for name in VARIANTS:
        cells = [name]
        for s in SCORES:
            values, own = (np.array([r[s] for r in rows if r["variant"] == v]) for v in (name, first))
            less = values - own
            reach = t.ppf(0.975, len(less) - 1) * less.std(ddof=1) / np.sqrt(len(less)) if len(less) > 1 else np.nan
            cells += [f"{values.mean():.3f}", "" if name == first else f"{less.mean():+.3f} ± {reach:.3f}"]
        out.append(cells)
    return out


if __name__ == "__main__":
    main()
