"""Gaze of real people in a VR supermarket, end to end: tracking files, rays, a place of hit points, a gaze field, scores.

    python benchmarks/supermarket_gaze.py [--data FOLDER] [--kappa 20] [--folds 2] [--out out/benchmarks/supermarket_gaze.csv]

Runs `nerg rays import --preset vr_supermarket` and, for each fold, `nerg train gaze --geometry hits --test-zones 3`. In
each fold the zones are others; every ray within 2R of a test position is left out of training, of the place and of the
baselines. Truth at a test position is the kernel density (`--kappa`) of the rays within R of it, in 2,048 directions of
equal area. `bits` is the information that the densities, normalised over the sphere, have about 128 of those rays
themselves beyond the position-blind density (kappa 50), a ray, as seen from the test position.

`split half` predicts one half of the people around a test position by the other half: a reference, not a bound, and scored
against its own half (at positions where either half has 64 rays).
KLD is of densities normalised over the sphere, with 1e-6 of the uniform density added to both; MAE and `integral` are of the
densities as they are. Rows are means over folds of means over positions.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

DIRECTIONS = 2048
RAYS = 128  # of each test position, for the information
ROOT = Path(__file__).resolve().parents[1]


def nerg(*arguments) -> None:
    """Run the command `nerg`, as a user would."""
    code = "import sys; from nerg_command import main; sys.exit(main())"
    subprocess.run([sys.executable, "-c", code, *map(str, arguments)], check=True, cwd=ROOT)


def around(rays, centres, radius: float, kappa: float, cap: int = 1024):
    """Probes at ``centres`` (all of them have rays), their densities and ray directions."""
    from nerg_mi.attention.probes import place_probes

    return place_probes(rays, radius, queries=centres, cap=cap, min_rays=1, kappa_rule="fixed", kappa=kappa, centre="query")


def split_half(rays, centres, radius: float, kappa: float, directions) -> dict:
    """Scores of one half of the people against the other, where both have 64 rays."""
    from scipy.spatial import cKDTree

    from nerg_mi.attention.splits import split_by_person
    from nerg_mi.evaluation.gaze_scores import scores

    halves = [rays.select(mask) for mask in split_by_person(rays, seed=0)]
    enough = np.all([cKDTree(h.origin).query_ball_point(centres, radius, return_length=True) >= 64 for h in halves], axis=0)
    if not enough.any():
        return {}
    density = [around(h, centres[enough], radius, kappa).density(directions) for h in halves]
    return {"method": "split half", **scores(*density), "bits": np.nan}


def information(tests, density, blind, positions, directions) -> float:
    """Bits a ray of ``density`` beyond ``blind``, both normalised over ``directions``, at `RAYS` random rays of each test."""
    rng = np.random.default_rng(0)
    which = np.stack([rng.integers(a, b, RAYS) for a, b in zip(tests.offsets[:-1], tests.offsets[1:])])
    at = tests.directions[which]
    tiny = np.finfo(float).eps

    def bits(method):
        sphere = np.maximum(method(positions, directions).astype(float), 0).mean(axis=1)
        return np.log2(np.maximum(method(positions, at).astype(float), 0) / (4 * np.pi * sphere[:, None]) + tiny)

    return float(np.mean(bits(density) - bits(blind)))


def run_fold(rays_file: Path, seed: int, args) -> list[dict]:
    """Train and score one fold."""
    import mitsuba as mi

    from nerg_mi.attention.probes import place_probes
    from nerg_mi.attention.rays import Rays
    from nerg_mi.attention.sphere import fibonacci_directions
    from nerg_mi.attention.splits import purge
    from nerg_mi.evaluation import gaze_baselines as baselines
    from nerg_mi.evaluation.gaze_scores import gaze_field, print_scores, scores
    from nerg_mi.field.backend import namespace
    from nerg_mi.formats.fields import load_gaze
    from nerg_mi.training.hit_geometry import volume_dict
    from nerg_mi.transport.media import VolumeMedium

    file = args.out.parent / f"supermarket_{seed}.safetensors"
    nerg("train", "gaze", rays_file, "--geometry", "hits", "-o", file, "--test-zones", 3, "--test-positions", 60,
         "--kappa", args.kappa, "--seed", seed, "--steps", args.steps)  # fmt: skip
    gaze, meta = load_gaze(file, namespace("llvm_ad_rgb"))
    medium = VolumeMedium(mi.load_dict(volume_dict(file.with_suffix(".vol"))))
    about, rays = meta["provenance"], Rays.load(rays_file)
    centres, radius = np.array(about["test"]["centres"]), about["test"]["radius"]
    train = rays.select(purge(rays, centres, about["test"]["purged_within"]))
    directions = fibonacci_directions(DIRECTIONS)
    probes = place_probes(train, radius, count=about["probes"]["count"], kappa_rule="fixed", kappa=args.kappa, seed=seed)
    blind = baselines.position_blind(train, kappa=50)
    methods = {
        "gaze field": gaze_field(gaze, medium), "position-blind, kappa 50": blind,
        f"position-blind, kappa {args.kappa:g}": baselines.position_blind(train, kappa=args.kappa),
        "1 nearest probe": baselines.nearest_probes(probes, 1), "16 nearest probes": baselines.nearest_probes(probes, 16),
        "4,096 nearest rays": baselines.nearest_rays(train, 4096, kappa=args.kappa),
    }  # fmt: skip
    tests = around(rays, centres, radius, args.kappa)
    truth = tests.density(directions)
    rows = [{"method": name, **scores(truth, density(centres, directions)),
             "bits": information(tests, density, blind, centres, directions)} for name, density in methods.items()]  # fmt: skip
    half = split_half(rays, centres, radius, args.kappa, directions)
    rows += [half] if half else []
    integral = 4 * np.pi * methods["gaze field"](centres, directions).mean(axis=1)
    print_scores(rows, f"fold {seed}: {len(centres)} positions, {len(train):,} of {len(rays):,} rays trained on, kappa {args.kappa:g}")
    print(f"integral of the gaze field over the sphere: mean {integral.mean():.3f}, {integral.min():.3f} to {integral.max():.3f}")
    return rows


def main(argv=None) -> None:
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.evaluation.gaze_scores import EPS, print_scores

    data = Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data")) / "vr_supermarket"
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=data)
    parser.add_argument("--kappa", type=float, default=20.0, help="of the truth, the training and the baselines")
    parser.add_argument("--folds", type=int, default=2)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/supermarket_gaze.csv"))
    args = parser.parse_args(argv)
    args.out = args.out.resolve()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    files = sorted(args.data.glob("*.csv.gz"))
    if not files:
        raise SystemExit(f'no recordings in "{args.data}"; set NERG_DATA to the folder that holds vr_supermarket')
    rays_file = args.out.parent / "supermarket_rays.npz"
    nerg("rays", "import", *files, "--preset", "vr_supermarket", "-o", rays_file)
    folds = [run_fold(rays_file, seed, args) for seed in range(args.folds)]
    found = [{r["method"]: r for r in rows} for rows in folds]
    mean = [{"method": name, **{k: float(np.mean([f[name][k] for f in found if name in f])) for k in row if k != "method"}}
            for name, row in found[0].items()]  # fmt: skip
    print_scores(mean, f"mean of {len(folds)} folds")
    print(f"KLD with eps {EPS:g} of the uniform density")
    with open(args.out, "w", newline="") as file:
        writer = csv.DictWriter(file, mean[0])
        writer.writeheader()
        writer.writerows(mean)
    print(f"wrote {args.out}")


if __name__ == "__main__":
    main()
