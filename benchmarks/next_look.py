"""How well do the last looks predict the next one, alone and together with a gaze field?

    python benchmarks/next_look.py [--only supermarket,office,gallery,room,truck] [--folds 3] [--seed 1]
        [--out out/benchmarks/next_look]

In each fold half of the participants train a gaze field, without three zones, and determine the weights of the next
look (`nerg eval next`) in these zones, where the other half is scored. Bits per look over the position-independent
prior: means over folds, and `more`: the next look minus the better of the last look and the field, with 95 % of
Student's t over folds.

For generated scenes, `law` is what the target of the look one elapsed time before adds to the exact gaze field of the
law of attention, and `law, preferences` what it adds together with the participant's preferences: mutual information of
targets, which directions cannot exceed.
"""

from __future__ import annotations

from pathlib import Path

from generated_places import NEW_TARGET_PROBABILITY, PLACES, RATE, draw_preferences
from places import interval, parse, parse_environments, place_parser, write_place
from timing import print_table, write_rows

import numpy as np

METHODS = {
    "field": "gaze field",
    "last look": "last look",
    "next look": "next look",
    "no products": "next look without products",
    "no heading": "next look without heading",
    "no field": "next look with the prior as field",
}


def main(argv=None) -> None:
    parser = place_parser(__doc__, "next_look", folds=3)
    parser.add_argument("--seed", type=int, default=1, help="seed of the first fold")
    args = parse(parser, argv)
    from nerg_mi.workflows.base import select_backend

    select_backend("llvm_ad_rgb", args.threads)
    each: list[dict] = []
    for name, make in parse_environments(args).items():
        folder, rays, where = write_place(name, make, args)
        for seed in range(args.seed, args.seed + args.folds):
            each += evaluate(name, folder, rays, where, seed, args.threads)
    write_rows(args.out / "folds.csv", each)
    bounds = {place.name: place for place in (make() for make in PLACES)}
    rows = []
    for name, elapsed in dict.fromkeys((row["place"], row["elapsed"]) for row in each):
        folds = [row for row in each if (row["place"], row["elapsed"]) == (name, elapsed)]
        mean = {key: np.mean([row[key] for row in folds]) for key in METHODS}
        more = [row["next look"] - max(row["field"], row["last look"]) for row in folds]
        row = {"place": name, "elapsed": f"{elapsed:g} s"} | {key: f"{value:.2f}" for key, value in mean.items()}
        row["more"] = f"{np.mean(more):+.2f} ± {interval(more):.2f}"
        if name in bounds:
            law = compute_law_gain(bounds[name], args.out / name / "scene.xml", elapsed)
            row |= {"law": f"{law[0]:.2f}", "law, preferences": f"{law[1]:.2f}"}
        rows.append(row)
    write_rows(args.out / "next_look.csv", rows)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    print_table("The next look", columns, [[row.get(key, "") for key in columns] for row in rows])


def evaluate(name: str, folder: Path, rays: Path, where: dict, seed: int, threads: int | None) -> list[dict]:
    """Bits of each method and elapsed time in a fold. A field that an earlier run trained is used again."""
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.workflows.gaze_commands import GazeOptions, NextLookOptions
    from nerg_mi.workflows.next_look import evaluate_next_look
    from nerg_mi.workflows.train_gaze import train_gaze

    gaze = folder / f"{seed}.safetensors"
    with TerminalReporter() as reporter:
        if not gaze.is_file():
            options = GazeOptions(**where, test_zones=3, test_participants=0.5, seed=seed, threads=threads)
            train_gaze(rays, gaze, options, reporter)
        files = {key: value for key, value in where.items() if key in ("scene", "field")}
        result = evaluate_next_look(gaze, rays, None, NextLookOptions(**files, threads=threads), reporter)
    rows: dict[float, dict] = {}
    for row in result.rows:
        rows.setdefault(row["elapsed"], {"place": name, "fold": seed, "elapsed": row["elapsed"]})[row["method"]] = row
    return [
        {key: row[key] for key in ("place", "fold", "elapsed")} | {k: row[m]["bits"] for k, m in METHODS.items()}
        for row in rows.values()
    ]


def compute_law_gain(place, scene: Path, elapsed: float) -> tuple[float, float]:
    """Bits that the target one elapsed time before adds to the law at the position, without and with the participant's
    preferences."""
    count, rng = round(elapsed * RATE), np.random.default_rng(1)
    targets: list = []
    place.record(scene, targets=targets)
    gains = []
    for weight, preferences, target in targets:
        share = lambda factor, weight=weight: weight * factor / (weight * factor).sum(axis=1, keepdims=True)
        others = [np.r_[draw_preferences(rng, len(place.things)), 1.0, 1.0] for _ in range(64)]
        preferred, population = share(preferences), np.mean([share(p) for p in others], axis=0)
        now = np.arange(count, len(target))
        last, next_ = target[now - count], target[now]
        # A target that is no longer visible is dropped.
        stays = np.all([weight[now - k, last] > 0 for k in range(count)], axis=0)
        stay = np.where(stays, (1 - NEW_TARGET_PROBABILITY) ** count, 0.0)
        for law in (population, preferred):
            chance = (1 - stay) * law[now, next_] + stay * (next_ == last)
            gains.append(np.log2(chance / population[now, next_]).mean())
    return float(np.mean(gains[::2])), float(np.mean(gains[1::2]))


if __name__ == "__main__":
    main()
