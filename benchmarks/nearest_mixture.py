"""What a gaze field gains by the nearest rays, mixed into it beside the blind density or in its place.

    python benchmarks/nearest_mixture.py [--only office,room] [--folds 1] [--out out/benchmarks/nearest_mixture]

Places are those of `places.py`: half of the people train, the others are scored at 60 positions in three zones. As in
`training.gaze.mixing`, inner folds choose how much is mixed in of a density that needs no field, the largest share
that is worse than the best by no more than half a standard error. That density is the blind one (kernels of 10, as the
recipe has it, or of 20), half of it that of the 4,096 nearest rays (kernels of 20), or as much of these as the folds
choose.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from output import print_table, write_rows
from place_rays import asked_places, parse, place_parser, write_place

import numpy as np

BLIND, WIDE, NEAREST = "blind, kappa 20", "blind, kappa 10", "4,096 nearest rays"
# By name, the densities that are mixed: parts of the nearest rays that may be chosen, and the blind density beside.
RULES = {
    "blind, kappa 10": (WIDE, (0.0,)),
    "blind, kappa 20": (BLIND, (0.0,)),
    "half nearest": (BLIND, (0.5,)),
    "folds choose": (BLIND, (0.0, 0.5, 1.0)),
}
ZONES, POSITIONS, MIN_RAYS, KAPPA = 3, 60, 64, 20.0
SCORES = ("KLD", "CC", "bits")


def main(argv=None) -> None:
    from nerg_mi.jobs.backend import select_backend

    args, rows = parse(place_parser(__doc__, "nearest_mixture", folds=1), argv), []
    ns = select_backend("llvm_ad_rgb", args.threads)
    for name, make in asked_places(args).items():
        _, path, where = write_place(name, make, args)
        for fold in range(args.folds):
            for row in score(path, where, fold, ns):
                rows.append({"place": name, "fold": fold, **row})
                print(name, fold, row["rule"], *(f"{s} {row[s]:.3f}" for s in SCORES), row["chosen"], flush=True)
        write_rows(args.out / "rules.csv", rows)
    mean = lambda rule, s: np.mean([r[s] for r in rows if r["rule"] == rule])
    names = dict.fromkeys(r["rule"] for r in rows)
    print_table(
        "Means over places", ("mixed in", *SCORES), [(n, *(f"{mean(n, s):.3f}" for s in SCORES)) for n in names]
    )


def score(path: Path, where: dict, fold: int, ns):
    """A row a rule."""
    from nerg_mi.evaluation.gaze import evaluation
    from nerg_mi.evaluation.gaze.baselines import position_blind
    from nerg_mi.evaluation.gaze.scores import gaze_field, scores
    from nerg_mi.evaluation.saliency import information_gain
    from nerg_mi.jobs.gaze_places import make_place
    from nerg_mi.jobs.gaze_plan import plan_gaze
    from nerg_mi.jobs.options.gaze import GazeOptions
    from nerg_mi.rays.rays import Rays
    from nerg_mi.training.gaze.recipes import gaze_recipe
    from nerg_mi.training.gaze.run import train_gaze
    from nerg_mi.training.gaze.splits import hold_out
    from nerg_mi.training.gaze.supervision import Supervision

    rays, options = Rays.load(path), GazeOptions(**where, seed=fold, mode="llvm_ad_rgb")
    radius = gaze_recipe().probe_settings().radius
    _, account = hold_out(rays, radius, ZONES, POSITIONS, fold, MIN_RAYS, 0.5)
    train, scored, centres = evaluation.held_out_rays(rays, account, "both", fold)
    place = make_place(options, train, [], path.with_suffix(".vol"), ns)
    plan = plan_gaze(options, place)
    plan = replace(plan, config=replace(plan.config, mix=0.0))
    curves = inner_curves(train, place, plan, ns)
    field, _ = train_gaze(Supervision(train), place, plan.with_settings(mix_folds=0), ns)
    test = evaluation.make_test(scored, centres, radius, KAPPA, min_rays=MIN_RAYS, seed=fold)
    of_field = gaze_field(field, place.medium, place.align)
    told = {name: density(test.centres, test.directions) for name, density in without_field(train).items()}
    at = {name: density(test.centres, test.at) for name, density in without_field(train).items()}
    maps, own = of_field(test.centres, test.directions), of_field(test.centres, test.at)
    blind = position_blind(train)(test.centres, test.at)
    for rule, (beside, parts) in RULES.items():
        share, part = chosen(curves[rule], parts)
        mixed = lambda f, of, share=share, part=part, beside=beside: (
            (1 - share) * f + share * ((1 - part) * of[beside] + part * of[NEAREST])
        )
        found = scores(test.truth, mixed(maps, told))
        bits = float(information_gain(mixed(own, at), blind).mean())
        yield {"rule": rule, "KLD": found["KLD"], "CC": found["CC"], "bits": bits, "chosen": f"{share:.2f}, {part:g}"}


def without_field(rays) -> dict:
    """Densities of ``rays`` that need no field, by name."""
    from nerg_mi.evaluation.gaze.baselines import nearest_rays, position_blind

    return {
        WIDE: position_blind(rays, kappa=10.0),
        BLIND: position_blind(rays, kappa=20.0),
        NEAREST: nearest_rays(rays, 4096, kappa=20.0),
    }


def inner_curves(rays, place, plan, ns) -> dict[str, np.ndarray]:
    """KLD (F, parts, shares) of each rule in the folds of `training.gaze.mixing`, for every share that is tried."""
    from nerg_mi.errors import NergError
    from nerg_mi.evaluation.saliency import kld
    from nerg_mi.training.gaze.likelihood import LikelihoodTrainer, heads_box
    from nerg_mi.training.gaze.mixing import SHARES, inner_folds
    from nerg_mi.training.gaze.ray_targets import targets_of_rays
    from nerg_mi.training.gaze.targets import TargetNeeds

    settings, needs = replace(plan.settings, steps=-(-plan.settings.steps // 2)), TargetNeeds.of(plan.config)
    probes = replace(plan.probes, count=min(plan.probes.count, 512), fresh=False)
    box, curves = heads_box(place.points_from_rays(rays.origin), place.box), {name: [] for name in RULES}
    for learn, held, centres in inner_folds(rays, plan):
        try:
            targets = targets_of_rays(learn, place, probes, needs, seed=settings.seed)
        except NergError as error:
            print(f"a fold says nothing: {error}", flush=True)
            continue
        judged = replace(probes, directions=1024, min_rays=1)
        truth = targets_of_rays(held, place, judged, needs, centres, settings.seed + 3)
        trainer = LikelihoodTrainer(replace(targets, heads=box), place.box, plan.config, settings, ns)
        while trainer.progress < 1:
            trainer.step()
        field, _ = trainer.densities(truth)
        inverse = np.linalg.inv(place.align.matrix)
        at = truth.positions @ inverse[:3, :3].T + inverse[:3, 3]
        along = place.directions_to_rays(truth.directions.reshape(-1, 3)).reshape(truth.directions.shape)
        told = {name: density(at, along) for name, density in without_field(learn).items()}
        for name, (beside, parts) in RULES.items():
            mixed = [(1 - p) * told[beside] + p * told[NEAREST] for p in parts]
            each = [[float(kld(truth.truth, (1 - s) * field + s * m).mean()) for s in SHARES] for m in mixed]
            curves[name].append(each)
    return {name: np.array(found) for name, found in curves.items()}


def chosen(curves: np.ndarray, parts: tuple[float, ...]) -> tuple[float, float]:
    """Share and part of the nearest rays: of those that are worse than the best of ``curves`` (F, parts, shares) by no
    more than half a standard error the largest share, and of these the smallest part."""
    from nerg_mi.training.gaze.mixing import SHARES, nearly_best

    kept = nearly_best(curves.reshape(len(curves), -1))
    found = max((SHARES[k % len(SHARES)], -parts[k // len(SHARES)]) for k in kept.tolist())
    return float(found[0]), float(-found[1])


if __name__ == "__main__":
    main()
