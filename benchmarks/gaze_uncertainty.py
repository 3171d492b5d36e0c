"""Does a gaze field know what it does not know? Ranks of errors, risk and regions in many places.

    python benchmarks/gaze_uncertainty.py [--only office,room] [--folds 3] [--zones 6] [--ensemble 5] [--out FOLDER]

Places and protocol are those of `places.py`, with more zones, since positions of a zone are neighbours. A row a place
and error: Spearman's rho of little support with the error, at new positions ("both") and at any where held-out
people stood ("anywhere"), with 95 % of resamples of zones; the mean error of all and of the surest half; and the
share of held-out rays in the smallest regions that are said to hold 80 % of the gaze, and in those that should hold it
by what the training held out. With `--ensemble` fields are means of so many, and the spread of these, which the AOV
`gaze_std` shows, has a row as support has.
"""

from __future__ import annotations

import argparse

from places import Make, asked_places, parse, place_parser, write_place
from timing import write_rows


def main(argv=None) -> None:
    parser = place_parser(__doc__, "uncertainty", folds=3)
    parser.add_argument("--zones", type=int, default=6)
    parser.add_argument("--ensemble", type=int, default=0, help="members of each fold's field")
    args, rows = parse(parser, argv), []
    for name, make in asked_places(args).items():
        rows += measure(name, make, args)
        write_rows(args.out / "uncertainty.csv", rows)


def measure(name: str, make: Make, args: argparse.Namespace) -> list[dict]:
    """A row a population and error of one place, which is printed."""
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.workflows.base import select_backend
    from nerg_mi.workflows.evaluate import evaluate_folds
    from nerg_mi.workflows.gaze_commands import FoldOptions

    select_backend("llvm_ad_rgb", args.threads)
    folder, rays, where = write_place(name, make, args)
    common = {"splits": "both,people", "folds": args.folds, "zones": args.zones, "threads": args.threads}
    common["ensemble"] = args.ensemble
    with TerminalReporter() as reporter:
        found = evaluate_folds(rays, folder / "eval", FoldOptions(**where, **common), reporter)
    held = {(r["split"], r["method"]): r["80%"] for r in found.calibration}
    rows = []
    for rank in found.uncertainty:
        if rank["split"] == "people":
            continue
        low, high = rank.get("rho.low", float("nan")), rank.get("rho.high", float("nan"))
        row = {"place": name, **{k: rank[k] for k in ("signal", "split", "error", "positions", "rho", "100%", "50%")}}
        row |= {"rho.low": low, "rho.high": high, "of 80%": held["both", "gaze field"]}
        row["of 80%, calibrated"] = held.get(("both", "gaze field, calibrated"), float("nan"))
        rows.append(row)
        print(
            f"{name:12s}{rank['signal']:8s}{rank['split']:9s}{rank['error']:7s}{rank['positions']:5d}  "
            f"rho {rank['rho']:+.2f} [{low:+.2f}, {high:+.2f}]  "
            f"error {rank['100%']:.3f}, surest half {rank['50%']:.3f}; "
            f"80 % regions hold {row['of 80%']:.0%}, calibrated {row['of 80%, calibrated']:.0%}"
        )
    return rows


if __name__ == "__main__":
    main()
