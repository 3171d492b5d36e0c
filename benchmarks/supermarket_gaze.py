"""Gaze of real people in a VR supermarket, end to end: tracking files, rays, a place of hit points, a gaze field,
scores.

    python benchmarks/supermarket_gaze.py [--data FOLDER] [--recipe default] [--folds 5] [--first 0] [--out
    out/benchmarks/supermarket_gaze]

Runs what the commands `nerg rays import --preset vr_supermarket` and `nerg eval folds --geometry hits` do. Half of the
people train, and the other half are scored at 60 positions in three zones; every ray within 2R of a test position is
left out of training, of the place and of the baselines. Splits: `both`, people and positions are new; `pos`, the
training people at new positions; `people`, new people elsewhere. Rows are means over folds, and folds.md has them with
intervals. The recipe's settings were chosen on the 24 folds from `--first 100`, other halves of the people at other
zones, and on none of the first five.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from timing import write_rows

ROOT = Path(__file__).resolve().parents[1]
SCORES = ("KLD", "CC", "SIM", "MAE", "NSS", "AUC", "sAUC", "bits", "loglik")
OURS, BAR = "gaze field", "4,096 nearest rays"


def main(argv=None) -> None:
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.workflows.evaluate import evaluate_folds
    from nerg_mi.workflows.gaze_commands import FoldOptions
    from nerg_mi.workflows.rays import import_rays
    from nerg_mi.workflows.rays_commands import RaysImportOptions

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
    parser.add_argument("--scheduler", help="who trains the folds, as of nerg eval folds")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/supermarket_gaze"))
    args = parser.parse_args(argv)
    args.out = args.out.resolve()
    args.out.mkdir(parents=True, exist_ok=True)
    files = sorted(args.data.glob("*.csv.gz"))
    if not files:
        raise SystemExit(f'no recordings in "{args.data}"; set NERG_DATA to the folder that holds vr_supermarket')
    rays = args.out / "rays.npz"
    import_rays(files, RaysImportOptions(reader="vr_supermarket", output=rays))
    options = FoldOptions(
        geometry="hits",
        recipe=args.recipe,
        folds=args.folds,
        first=args.first,
        splits=args.splits,
        kappa=args.kappa,
        steps=args.steps,
        threads=args.threads,
        scheduler=args.scheduler,
    )
    with TerminalReporter() as reporter:
        found = evaluate_folds(rays, args.out, options, reporter)
    rows, seeds = found.each, range(args.first, args.first + args.folds)
    table = [row for row in found.rows if " less " not in row["method"]]
    for split in args.splits.split(","):
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
    write_rows(args.out / "means.csv", found.rows)


if __name__ == "__main__":
    main()
