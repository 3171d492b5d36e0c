"""Gaze of real people in a VR supermarket, end to end: tracking files, rays, a place of hit points, a gaze field,
scores.

    python benchmarks/supermarket_gaze.py [--data FOLDER] [--recipe default] [--folds 5] [--first 0] [--out
    out/benchmarks/supermarket_gaze]

Runs what the commands `nerg rays import --preset vr_supermarket` and, for each fold,
`nerg train gaze --geometry hits --test-zones 3 --test-people 0.5` and `nerg eval gaze` for each split do. Half of the
people train, and the other half are scored at 60 positions in three zones; every ray within 2R of a test position is
left out of training, of the place and of the baselines. Splits: `both`, people and positions are new; `pos`, the
training people at new positions; `people`, new people elsewhere. What the columns mean is in each fold's `gaze.md`.
Rows are means over folds. The recipe's settings were chosen on the 24 folds from `--first 100`, other halves of the
people at other zones, and on none of the first five.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from output import write_rows

ROOT = Path(__file__).resolve().parents[1]
SCORES = ("KLD", "CC", "SIM", "MAE", "NSS", "AUC", "sAUC", "bits", "loglik")
OURS, BAR = "gaze field", "4,096 nearest rays"


def run_fold(rays: Path, seed: int, args: argparse.Namespace) -> list[dict]:
    """Train one fold, and score it in every split."""
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.jobs.evaluation import evaluate_gaze
    from nerg_mi.jobs.gaze import train_gaze
    from nerg_mi.jobs.options.evaluation import GazeEvaluationOptions
    from nerg_mi.jobs.options.gaze import GazeOptions

    file, rows = args.out / f"fold_{seed}.safetensors", []
    options = GazeOptions(
        geometry="hits",
        recipe=args.recipe,
        test_zones=3,
        test_positions=60,
        test_people=0.5,
        seed=seed,
        steps=args.steps,
        threads=args.threads,
    )
    with TerminalReporter() as reporter:
        train_gaze(rays, file, options, reporter)
    for split in args.splits.split(","):
        folder = args.out / f"fold_{seed}_{split}"
        scored = GazeEvaluationOptions(split=split, kappa=args.kappa, seed=seed, threads=args.threads)
        found = evaluate_gaze(file, rays, folder, scored)
        rows += [{"fold": seed, "split": split, **row} for row in found.rows]
    return rows


def means(rows: list[dict], split: str) -> list[dict]:
    """Each method's mean over folds."""
    rows = [r for r in rows if r["split"] == split]
    out = []
    for name in dict.fromkeys(r["method"] for r in rows):
        found = [r for r in rows if r["method"] == name]
        out.append(
            {
                "split": split,
                "method": name,
                **{k: sum(r[k] for r in found) / len(found) for k in SCORES},
                "folds": len(found),
            }
        )
    return out


def main(argv=None) -> None:
    from nerg_mi.jobs.tracking import ImportOptions, import_rays

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    data = Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data")) / "vr_supermarket"
    parser.add_argument("--data", type=Path, default=data)
    parser.add_argument("--recipe", default="default")
    parser.add_argument("--kappa", type=float, default=20.0, help="of the truth and the baselines")
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="seed of the first fold")
    parser.add_argument("--splits", default="both,pos,people")
    parser.add_argument("--steps", type=int, help="Default: the recipe's.")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/supermarket_gaze"))
    args = parser.parse_args(argv)
    args.out = args.out.resolve()
    args.out.mkdir(parents=True, exist_ok=True)
    files = sorted(args.data.glob("*.csv.gz"))
    if not files:
        raise SystemExit(f'no recordings in "{args.data}"; set NERG_DATA to the folder that holds vr_supermarket')
    rays = args.out / "rays.npz"
    import_rays(files, ImportOptions(reader="vr_supermarket", output=rays))
    seeds = range(args.first, args.first + args.folds)
    rows = [row for seed in seeds for row in run_fold(rays, seed, args)]
    table = []
    for split in args.splits.split(","):
        table += means(rows, split)
        print(f"\n{split}, mean of {args.folds} folds\n{'method':28s}" + "".join(f"{k:>9s}" for k in SCORES))
        for r in table:
            if r["split"] == split:
                print(f"{r['method']:28s}" + "".join(f"{r[k]:9.4f}" if k == "MAE" else f"{r[k]:9.3f}" for k in SCORES))
        print(f"fold by fold, {OURS} less {BAR}:")
        for seed in seeds:
            ours, bar = (
                next(r for r in rows if (r["fold"], r["split"], r["method"]) == (seed, split, m)) for m in (OURS, BAR)
            )
            print(f"  {seed}: " + ", ".join(f"{name} {ours[name] - bar[name]:+.3f}" for name in ("KLD", "CC", "bits")))
    for name, content in (("folds.csv", rows), ("means.csv", table)):
        write_rows(args.out / name, content)


if __name__ == "__main__":
    main()
