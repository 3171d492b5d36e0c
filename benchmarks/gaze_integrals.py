"""Integral of a normalised gaze field over the sphere, compared with a finer integral at random positions.

    python benchmarks/gaze_integrals.py GAZE PLACE.vol|FIELD.safetensors [--positions 300]

A normalised field is divided by the integral that the integrator computes for each observer. The benchmark computes it
with several numbers of directions, and for tolerances that determine the number of directions, at positions that are
uniform in the bounding box of the training's head positions. The errors are relative to the integral over the largest
number of directions.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np


def main(argv=None) -> None:
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
        "--positions", type=int, default=300, help="Number of random observer positions. Default: %(default)s."
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
    rng = np.random.default_rng(0)
    sweep(integral, rng.uniform(low, high, (args.positions, 3)).tolist())


TOLERANCES = (5e-3, 2e-3, 1e-3, 3e-4)


def sweep(integral, positions: list[list[float]]) -> None:
    """Save error and time of an integral by its number of directions, and by its tolerance."""
    from timing import save_result

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
    head = ("directions", "mean error", "99 % quantile", "maximum error", "time", "CPU time")
    save_result("gaze-integrals", head, rows, "0")


if __name__ == "__main__":
    main()
