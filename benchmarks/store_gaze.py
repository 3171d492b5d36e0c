"""The store's trained gaze field compared with the true law, at positions without nearby training rays.

    python benchmarks/store_gaze.py [--gaze FILE] [--field FILE] [--rays FILE]

The test positions are those that the gaze checkpoint lists as held out (`nerg train gaze --test-zones`). Shoppers were
there, and all rays within 2R were excluded from the training. The truth is the attention law in closed form, in 2,048
directions of equal area. The baselines use the field's training rays and are those of `nerg eval gaze`
(`nerg_mi.evaluation.baselines`), tuned on folds of them.

KLD compares densities that are normalised over the sphere, with 1e-6 of the uniform density added to both. MAE and
`integral` use the densities without normalisation. `law, seen by as many rays` is the kernel density of new samples of
the law at the test position, as many as in a probe. It is the score of a probe with perfect data.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

DIRECTIONS = 2048


def fresh_draws(law, count: int, kappa: float):
    """Baseline: kernel densities of ``count`` samples of ``law`` at each position."""
    from nerg_mi.fields.kde import SphericalKde

    def evaluate(positions, directions):
        rng = np.random.default_rng(1)
        draws = law.sample(np.repeat(positions, count, axis=0), rng)
        return SphericalKde(draws, np.arange(len(positions) + 1) * count, kappa).evaluate(directions)

    return evaluate


def main(argv=None) -> None:
    from timing import save_result

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.environment.environment import Environment
    from nerg_mi.evaluation.baselines import make_tuned_baselines
    from nerg_mi.evaluation.gaze import EPS, FieldDensity, compute_map_scores
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.formats.fields import load_gaze
    from nerg_mi.maths.sphere import fibonacci_directions
    from nerg_mi.scenes import store
    from nerg_mi.scenes.store.attention_law import AttentionLaw
    from nerg_mi.tracking.filters import purge
    from nerg_mi.tracking.rays import Rays
    from nerg_mi.train.gaze_data import find_hit_points
    from nerg_mi.train.trainer import use_current_names

    local = Path(store.__file__).resolve().parent
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--gaze",
        type=Path,
        default=local / "shoppers.safetensors",
        help="Checkpoint of the gaze field. Default: that of the store.",
    )
    parser.add_argument(
        "--field",
        type=Path,
        default=local / "store.safetensors",
        help="Checkpoint of the radiance field. Default: that of the store.",
    )
    parser.add_argument(
        "--rays",
        type=Path,
        default=local / "build" / "rays.npz",
        help="Gaze samples of the training. Default: those of the store's shoppers.",
    )
    args = parser.parse_args(argv)

    ns = namespace("llvm_ad_rgb")
    gaze, meta = load_gaze(args.gaze, ns)
    metadata = use_current_names(meta["provenance"])
    if "test" not in metadata:
        raise SystemExit(f'"{args.gaze}" was trained without held-out positions; train it with --test-zones 8')
    rays, law = Rays.load(args.rays), AttentionLaw()
    geometry = Environment.open(args.field)
    positions, radius = np.array(metadata["test"]["centres"]), metadata["test"]["radius"]
    train = rays.select(purge(rays, positions, metadata["test"]["purged_within"]))
    directions = fibonacci_directions(DIRECTIONS)
    truth = law.density(positions, directions)

    probe_settings = metadata["probes"]
    # The silverman and loo rules have no single kappa; the default is used instead.
    narrow = probe_settings["kappa"]
    methods = {"gaze field": FieldDensity(gaze, geometry.medium, depth_kind=probe_settings["depth"])}
    tuned = make_tuned_baselines(train, radius, find_hit_points(train, geometry), participants=False)
    methods |= {name: baseline.density for name, baseline in tuned.items()}
    methods[f"law, seen by {probe_settings['max_rays']:,} rays, kappa {narrow:g}"] = fresh_draws(
        law, probe_settings["max_rays"], narrow
    )
    rows = []
    for name, method in methods.items():
        maps = method(positions, directions)
        rows.append({"method": name, **compute_map_scores(truth, maps), "integral": float(4 * np.pi * np.mean(maps))})
    print(f"{len(positions)} held-out positions; trained on {len(train):,} of {len(rays):,} rays")
    table = [[r["method"], *(f"{r[k]:.3f}" for k in ("KLD", "CC", "SIM")), f"{r['MAE']:.4f}"] for r in rows]
    save_result("gaze-store-law", ("method", "KLD", "CC", "SIM", "MAE, 1/sr"), table)
    integral = 4 * np.pi * methods["gaze field"](positions, directions).mean(axis=1)
    print(
        f"integral of the gaze field over the sphere: mean {integral.mean():.3f}, "
        f"{integral.min():.3f} to {integral.max():.3f}; KLD with eps {EPS:g} of the uniform density"
    )


if __name__ == "__main__":
    main()
