"""What the paper claims of its variants, over people, positions and seeds: their order, losses, features, beginnings.

    python benchmarks/paper_claims.py [--only supermarket,store] [--folds 4] [--steps 800] [--recipes default,paper]

An ablation (`nerg ablate`) a fold, each with other people (half), other positions (60 in three zones) and another seed
held out or begun with. A row a recipe and variant: means over folds of the paper's loss, KLD + (1 - CC) + MAE, on
positions of the training and on held-out ones, and of held-out KLD and CC; `less` is a variant less the product of emit
and capture of the same recipe, fold by fold, with 95 % of Student's t. Rows are kept, and trained once.
"""

from __future__ import annotations

from dataclasses import fields

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from output import print_table, write_rows
from place_rays import asked_places, parse, place_parser, write_place
from places import interval

import numpy as np

WHOLE = "emit_capture"
SCORES = {"loss": "test_loss", "KLD": "test_KLD", "CC": "test_CC"}


def main(argv=None) -> None:
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.jobs.ablation import ablate
    from nerg_mi.jobs.options.ablation import AblationOptions

    parser = place_parser(__doc__, "paper_claims", folds=4)
    parser.set_defaults(only="supermarket,store")
    parser.add_argument("--steps", type=int, default=800, help="of the recipes but the default one")
    parser.add_argument("--recipes", default="default,paper")
    parser.add_argument("--variant", action="append", default=[], help="only this one; may be given several times")
    args = parse(parser, argv)
    known, each = {f.name for f in fields(AblationOptions)}, []
    for name, make in asked_places(args).items():
        folder, rays, where = write_place(name, make, args)
        for fold in range(args.folds):
            options = AblationOptions(
                **{k: v for k, v in where.items() if k in known},
                recipes=args.recipes,
                variant=tuple(args.variant),
                first=fold,
                seeds=1,
                steps=args.steps,
                people=0.5,
                refit=False,
                cameras=0,
                threads=args.threads,
            )
            with TerminalReporter() as reporter:
                found = ablate(rays, folder / f"fold{fold}", options, reporter)
            each += [{"place": name, "fold": fold, **row} for row in found.rows]
        own = [row for row in each if row["place"] == name]
        print_table(
            f"The paper's variants: {name}",
            ("recipe", "variant", "loss, training", *(h for s in SCORES for h in (s, "less"))),
            summarise(own),
        )
        write_rows(args.out / "folds.csv", each)


def summarise(rows: list[dict]) -> list[list[str]]:
    """Means over folds, and by how much they are above the product's."""
    out = []
    for recipe, variant in dict.fromkeys((r["recipe"], r["variant"]) for r in rows):
        own = {r["fold"]: r for r in rows if (r["recipe"], r["variant"]) == (recipe, variant)}
        whole = {r["fold"]: r for r in rows if (r["recipe"], r["variant"]) == (recipe, WHOLE)}
        cells = [recipe, variant, f"{np.mean([r['train_loss'] for r in own.values()]):.3f}"]
        for key in SCORES.values():
            less = [own[k][key] - whole[k][key] for k in own if k in whole]
            told = f"{np.mean(less):+.3f} ± {interval(less):.3f}" if less and variant != WHOLE else ""
            cells += [f"{np.mean([r[key] for r in own.values()]):.3f}", told]
        out.append(cells)
    return out


if __name__ == "__main__":
    main()
