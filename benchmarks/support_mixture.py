"""Would a share of the blind density that falls with support be better than one share a place?

    python benchmarks/support_mixture.py [--only room,truck] [--folds 3] [--out out/benchmarks/support_mixture]

Places, folds and people are those of `places.py`, fields those of the recipe before a share is chosen; a field that is
kept in the same folder is read. The people who are held out are scored at new positions, where there is next to no
support, and where others stood, where there is; for every share of the blind density that a training tries. "One share"
is the best of all positions of a fold together, "by support" the best at new positions and the best at the others, each
chosen by the very people who are scored: more than a rule that has to choose by others could gain.
"""

from __future__ import annotations

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from output import print_table, write_rows
from place_fields import FoldField, fold_fields
from place_rays import asked_places, parse, place_parser, write_place

import numpy as np

SPLITS = {"both": "new positions", "people": "where others stood"}


def main(argv=None) -> None:
    from nerg_mi.jobs.backend import select_backend

    args, rows = parse(place_parser(__doc__, "support_mixture", folds=3), argv), []
    ns = select_backend("llvm_ad_rgb", args.threads)
    for name, make in asked_places(args).items():
        for fold in fold_fields(*write_place(name, make, args), args, ns, mix_folds=0):
            rows.append({"place": name, "fold": fold.seed, **compare(fold)})
    write_rows(args.out / "support_mixture.csv", rows)
    keys = [k for k in rows[0] if k not in ("place", "fold")]
    mean = lambda name, key: np.mean([r[key] for r in rows if name in (None, r["place"])])
    table = [
        (name or "mean", *(f"{mean(name, k):.{3 if k.startswith('KLD') else 2}f}" for k in keys))
        for name in (*dict.fromkeys(r["place"] for r in rows), None)
    ]
    print_table("Shares of the blind density by support", ("place", *keys), table)


def compare(fold: FoldField) -> dict[str, float]:
    """Best shares and KLD (nats) of one field."""
    from nerg_mi.evaluation.gaze.scores import EPS
    from nerg_mi.evaluation.saliency import kld
    from nerg_mi.training.gaze.mixing import SHARES, give_mix

    curves = {}
    for split in SPLITS:
        _, test = fold.test(split)
        densities = []
        for share in (0.0, 1.0):
            give_mix(fold.loaded, share)
            densities.append(fold.density()(test.centres, test.directions))
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
