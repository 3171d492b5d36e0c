"""Claims of the paper about its variants, tested over participants, positions and seeds.

    python benchmarks/paper_claims.py [--only supermarket,store] [--folds 4] [--steps 800] [--recipes default,paper]
        [--variant emit_capture] [--result paper]

The benchmark runs one ablation (`ablation.py`) per fold, in which other participants (half), other positions (60 in
three zones) and another seed are held out. It compares emit, capture and their product, the losses, the semantic
features, and the initialisations of the paper.

The table of a scene has one row per recipe and variant. Its columns are means over folds: the paper's loss, KLD + (1 -
CC) + MAE, on training positions; its increase on held-out positions; KLD and CC on held-out positions, and their
difference from the product of the same recipe, computed fold by fold, with 95 % intervals of Student's t. The last
table has the CC of all scenes, one row per scene and recipe: the CC of the product, also by fold, the differences of
the variants from it, and the median number of steps and training time of the product. Trainings are stored in the
output folder, and a second run does not repeat them.
"""

from __future__ import annotations

import ablation
import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from places import interval, parse, parse_environments, place_parser, write_place
from timing import save_result

import numpy as np

WHOLE = "emit_capture"
# Of the last table; only the paper's recipe has another loss.
ORDER = ("emit", "capture", "loss code")


def main(argv=None) -> None:
    parser = place_parser(__doc__, "paper_claims", folds=4, only="supermarket,store")
    parser.add_argument(
        "--steps",
        type=int,
        default=800,
        help="Number of training steps of all recipes but the default one. Default: %(default)s.",
    )
    parser.add_argument(
        "--recipes",
        default="default,paper",
        help="Training recipes to compare, separated by commas: default, small, paper. Default: %(default)s.",
    )
    parser.add_argument(
        "--variant", action="append", default=[], help="Name of a variant to train; can be repeated. Default: all."
    )
    parser.set_defaults(result="paper")
    args = parse(parser, argv)
    each: list[dict] = []
    for name, make in parse_environments(args).items():
        folder, rays, where = write_place(name, make, args)
        for fold in range(args.folds):
            line = [str(rays), "--environment", str(where), "--out", str(folder / f"fold{fold}")]
            line += ["--seed", str(fold), "--test-participants", "0.5", "--no-refit"]
            line += [] if args.threads is None else ["--threads", str(args.threads)]
            line += [word for variant in args.variant for word in ("--variant", variant)]
            for recipe in args.recipes.split(","):
                steps = [] if recipe == "default" else ["--steps", str(args.steps)]
                rows = ablation.main([*line, "--recipes", recipe, *steps])
                each += [{"place": name, "fold": fold, **row} for row in rows]
    seeds = ", ".join(map(str, range(args.folds)))
    heads = ("scene", "recipe", "variant", "training loss", "held-out minus training loss")
    heads += ("KLD", "KLD minus product", "CC", "CC minus product")
    save_result(f"{args.result}-variants", heads, summarise(each), seeds)
    heads = ("scene", "recipe", "product", "product by fold", *(f"{v} minus product" for v in ORDER))
    save_result(f"{args.result}-claims", (*heads, "steps", "training time, s"), order(each), seeds)


def summarise(rows: list[dict]) -> list[list[str]]:
    """Means over folds, and their difference from the product."""
    out = []
    for place, recipe, variant in dict.fromkeys((r["place"], r["recipe"], r["variant"]) for r in rows):
        in_place = [r for r in rows if r["place"] == place]
        separate = [r for r in in_place if (r["recipe"], r["variant"]) == (recipe, variant)]
        cells = [place, recipe, variant, f"{np.mean([r['train_loss'] for r in separate]):.3f}"]
        cells.append(print_row([r["test_loss"] - r["train_loss"] for r in separate]))
        for key in ("test_KLD", "test_CC"):
            above = "" if variant == WHOLE else print_row(less(in_place, recipe, variant, key))
            cells += [f"{np.mean([r[key] for r in separate]):.3f}", above]
        out.append(cells)
    return out


def order(rows: list[dict]) -> list[list[str]]:
    """CC of the product in each scene and fold, the differences of the variants of `ORDER` from it, and its steps and
    seconds."""
    out = []
    for place, recipe in dict.fromkeys((r["place"], r["recipe"]) for r in rows):
        separate = [r for r in rows if r["place"] == place]
        full = [r for r in separate if (r["recipe"], r["variant"]) == (recipe, WHOLE)]
        cc = f"{np.mean([r['test_CC'] for r in full]):.3f}" if full else ""
        by_fold = ", ".join(f"{r['test_CC']:.3f}" for r in full)
        cost = [f"{np.median([r[key] for r in full]):.0f}" if full else "" for key in ("steps", "train_seconds")]
        above = (print_row(less(separate, recipe, variant, "test_CC")) for variant in ORDER)
        out.append([place, recipe, cc, by_fold, *above, *cost])
    return out


def less(rows: list[dict], recipe: str, variant: str, key: str) -> list[float]:
    """The score ``key`` of a variant minus that of the product, in each fold with both."""
    result = {(r["variant"], r["fold"]): r[key] for r in rows if r["recipe"] == recipe}
    folds = sorted({fold for name, fold in result if name == variant and (WHOLE, fold) in result})
    return [result[variant, fold] - result[WHOLE, fold] for fold in folds]


def print_row(values: list[float]) -> str:
    """Mean of ``values`` with its interval, which needs two of them; empty without values."""
    if not values:
        return ""
    return f"{np.mean(values):+.3f} ± {interval(values):.3f}" if len(values) > 1 else f"{values[0]:+.3f}"


if __name__ == "__main__":
    main()
