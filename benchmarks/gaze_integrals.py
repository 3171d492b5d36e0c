"""Integral of a normalised gaze field over the sphere, compared with a finer integral at random positions.

    python benchmarks/gaze_integrals.py GAZE PLACE.vol|FIELD.safetensors [--positions 1000] [--out
    out/benchmarks/gaze_integrals.csv]

A normalised field is divided by the integral that the integrator computes for each observer. If this integral is
accurate, the normalised density integrates to one. The benchmark computes it again with twice as many and other
directions, at positions that are uniform in the bounding box of the training's head positions. It prints the maximum
and the mean difference from one, the fraction of positions with a difference of at most 1e-3, and the time of an
integral. ``--sweep`` prints the same for other numbers of directions, with the largest number as the reference, and for
tolerances that determine the number of directions.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.files.tables import format_markdown_table

import numpy as np


def main(argv=None) -> None:
    from timing import write_rows

    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.environment.environment import Environment
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.formats.fields import load_gaze
    from nerg_mi.transport.geometry import SceneGeometry, default_march_settings
    from nerg_mi.transport.observer import MAX_DIRECTIONS as COUNT
    from nerg_mi.transport.observer import ObserverSettings
    from nerg_mi.transport.observer_gaze import GazeFieldInstance

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("gaze", type=Path, help="Checkpoint of the gaze field.")
    parser.add_argument(
        "place", type=Path, help="Geometry of the environment: a volume (.vol) or the checkpoint of a radiance field."
    )
    parser.add_argument(
        "--positions", type=int, default=1000, help="Number of random observer positions. Default: %(default)s."
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/benchmarks/gaze_integrals.csv"),
        help="CSV file to write. Default: %(default)s.",
    )
    parser.add_argument(
        "--sweep",
        action="store_true",
        help="Print errors and times for several numbers of directions and tolerances instead, without a CSV file.",
    )
    args = parser.parse_args(argv)
    ns = namespace("llvm_ad_rgb")
    field, _ = load_gaze(args.gaze, ns)
    medium = Environment.open(args.place).medium
    gaze, place, settings = (
        GazeFieldInstance(field),
        SceneGeometry(medium),
        ObserverSettings(march=default_march_settings(medium)),
    )

    def integral(p: list[float], count: int = COUNT, tolerance: float = 0.0) -> float:
        p_o = mi.Point3f(*p)
        # Opaque like a scene's: a literal would be compiled again.
        dr.make_opaque(p_o)
        requested = replace(settings, directions=count, integral_tolerance=tolerance)
        return float(gaze.for_observers([p_o], place, requested).integrals(p_o)[0][0])

    low, high = np.array(field.config.heads)
    rng, rows = np.random.default_rng(0), []
    if args.sweep:
        sweep(integral, rng.uniform(low, high, (args.positions, 3)).tolist())
        return
    for p in rng.uniform(low, high, (args.positions, 3)).tolist():
        started = time.perf_counter()
        ours = integral(p, COUNT)
        seconds = time.perf_counter() - started
        fine = integral(p, 2 * COUNT + 13)
        rows.append({"x": p[0], "y": p[1], "z": p[2], "integral": fine / ours, "seconds": seconds})
    off = np.abs([r["integral"] - 1 for r in rows])
    print(
        f"{len(rows)} positions: mean error {off.mean():.1e}, 99 % quantile {np.quantile(off, 0.99):.1e}, "
        f"maximum {off.max():.1e}; "
        f"{np.mean(off <= 1e-3):.1%} within 1e-3; "
        f"{np.median([r['seconds'] for r in rows]):.3f} s per integral of {COUNT:,} directions (median)"
    )
    write_rows(args.out, rows)


TOLERANCES = (5e-3, 2e-3, 1e-3, 3e-4)


def sweep(integral, positions: list[list[float]]) -> None:
    """Print error and time of an integral by its number of directions, and by its tolerance."""
    counts = [1 << k for k in range(9, 19)]
    true = np.array([integral(p, (1 << 20) + 13) for p in positions])
    variants = {f"{count:,}": {"count": count} for count in counts}
    variants |= {f"tolerance {tolerance:g}": {"tolerance": tolerance} for tolerance in TOLERANCES}
    rows = []
    for name, options in variants.items():
        for p in positions[:4]:
            integral(p, **options)  # compiles its kernels
        result = np.empty((len(positions), 3))
        for k, p in enumerate(positions):
            wall, cpu = time.perf_counter(), time.process_time()
            value = integral(p, **options)
            result[k] = value, time.perf_counter() - wall, time.process_time() - cpu
        off, (wall, cpu) = np.abs(result[:, 0] / true - 1), 1e3 * np.median(result[:, 1:], axis=0)
        errors = (f"{v:.1e}" for v in (off.mean(), np.quantile(off, 0.99), off.max()))
        rows.append((name, *errors, f"{wall:.0f} ms", f"{cpu:.0f} ms"))
    print(
        format_markdown_table(("directions", "mean error", "99 % quantile", "maximum error", "time", "CPU time"), rows)
    )


if __name__ == "__main__":
    main()
