"""Would a share of the blind density that falls with support be better than one share a place?

    python benchmarks/support_mixture.py [--only room,truck] [--folds 3] [--out out/benchmarks/places-before]

Places, folds and people are those of `places.py` with `--mix-folds 0`, whose kept fields are read where they are in the
same folder. The people who are held out are scored at new positions, where there is next to no support, and where
others stood, where there is; for every share of the blind density that a training tries. "One share" is the best of
all positions of a fold together, "by support" the best at new positions and the best at the others, each chosen by the
very people who are scored: more than a rule that has to choose by others could gain.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from output import print_table, write_rows
from places import ROOT, makers

import numpy as np

SPLITS = {"both": "new positions", "people": "where others stood"}


def main(argv=None) -> None:
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.jobs.backend import select_backend
    from nerg_mi.jobs.folds import evaluate_folds
    from nerg_mi.jobs.options.folds import FoldOptions

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    data = Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=data, help="folder of vr_supermarket and eyenavgs")
    parser.add_argument("--only", help="names of places, with commas between. Default: all whose data is there.")
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/places-before"))
    args = parser.parse_args(argv)
    args.out = args.out.resolve()
    args.out.mkdir(parents=True, exist_ok=True)
    ns, places, rows = select_backend("llvm_ad_rgb", args.threads), makers(args.data), []
    for name in args.only.split(",") if args.only else places:
        if name not in places:
            raise SystemExit(f'no place is called "{name}" here; there are {", ".join(places)}')
        folder = args.out / name
        folder.mkdir(exist_ok=True)
        path, where = places[name](folder)
        options = FoldOptions(**where, folds=args.folds, splits="both", mix_folds=0, threads=args.threads)
        with TerminalReporter() as reporter:
            fields = evaluate_folds(path, folder / "eval", options, reporter).fields
        for fold, field in enumerate(fields):
            rows.append({"place": name, "fold": fold, **compare(field, path, where, fold, ns)})
    write_rows(args.out / "support_mixture.csv", rows)
    keys = [k for k in rows[0] if k not in ("place", "fold")]
    mean = lambda name, key: np.mean([r[key] for r in rows if name in (None, r["place"])])
    table = [
        (name or "mean", *(f"{mean(name, k):.{3 if k.startswith('KLD') else 2}f}" for k in keys))
        for name in (*dict.fromkeys(r["place"] for r in rows), None)
    ]
    print_table("Shares of the blind density by support", ("place", *keys), table)


def compare(field: Path, rays_path: Path, where: dict, fold: int, ns) -> dict[str, float]:
    """Best shares and KLD (nats) of one field."""
    from nerg_mi.evaluation.gaze import evaluation
    from nerg_mi.evaluation.gaze.scores import EPS, gaze_field
    from nerg_mi.evaluation.saliency import kld
    from nerg_mi.formats.fields import load_gaze
    from nerg_mi.jobs.gaze_places import place_of_training
    from nerg_mi.jobs.options.evaluation import GazeEvaluationOptions
    from nerg_mi.rays.rays import Rays
    from nerg_mi.training.gaze.mixing import SHARES, give_mix

    loaded, metadata = load_gaze(field, ns)
    about, rays = metadata["provenance"], Rays.load(rays_path)
    scoring = GazeEvaluationOptions(**{k: v for k, v in where.items() if k in ("field", "scene")}, seed=fold)
    account = about["test"]
    place = place_of_training(field, about, loaded.box, scoring, ns)
    curves = {}
    for split in SPLITS:
        _, scored, centres = evaluation.held_out_rays(rays, account, split, fold)
        test = evaluation.make_test(
            scored, centres, account["radius"], scoring.kappa, scoring.directions, scoring.min_rays, seed=fold
        )
        densities = []
        for share in (0.0, 1.0):
            give_mix(loaded, share)
            densities.append(gaze_field(loaded, place.medium, place.align)(test.centres, test.directions))
        mixed = [kld(test.truth, (1 - m) * densities[0] + m * densities[1], eps=EPS).mean() for m in SHARES]
        curves[split] = np.array(mixed)
    whole = np.mean(list(curves.values()), axis=0)
    shared = int(whole.argmin())
    out = {"one share": SHARES[shared]}
    for split, name in SPLITS.items():
        best = int(curves[split].argmin())
        out |= {f"share, {name}": SHARES[best], f"KLD, one share, {name}": curves[split][shared]}
        out |= {f"KLD, by support, {name}": curves[split][best]}
    return out


if __name__ == "__main__":
    main()
