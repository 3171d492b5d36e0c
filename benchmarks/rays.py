"""Millions of rays: import, index, probes, a picture's ground truth.

    python benchmarks/rays.py [--rays 2600000] [--data FOLDER] [--out out/benchmarks/rays.csv]

The rays are those of the VR supermarket, resampled: every copy of a recording is shifted by some decimetres and
jittered by a centimetre and a degree. They are written as a CSV of nine columns, imported through a column map, saved,
and asked for 4,096 probes (R 0.1 m and 0.25 m, at most 1,024 rays) and for the kernel density of a picture of 1280 x
720 pixels (70 degrees wide) around an observer. `seconds` is wall-clock time, `cpu` processor time of all threads: on a
machine that does other things besides, the second says more. Peak memory is that of the whole process.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from functools import partial
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

ROOT = Path(__file__).resolve().parents[1]


def write_resampled(source, count: int, path: Path) -> None:
    """A CSV of ``count`` rays made from those of ``source``."""
    import numpy as np

    rng = np.random.default_rng(0)
    with open(path, "w") as out:
        out.write("time,person,x,y,z,dx,dy,dz,confidence\n")
        for copy in range(-(-count // len(source))):
            n = min(len(source), count - copy * len(source))
            shift = rng.normal(0, 0.15, 3) * [1, 1, 0.3]
            origin = source.origin[:n] + shift + rng.normal(0, 0.01, (n, 3))
            d = source.direction[:n] + rng.normal(0, 0.02, (n, 3))
            d /= np.linalg.norm(d, axis=1, keepdims=True)
            rows = zip(
                source.t[:n] + 1000 * copy, source.person[:n], origin.tolist(), d.tolist(), source.confidence[:n]
            )
            for t, person, o, v, c in rows:
                out.write(
                    f"{t:.3f},{source.persons[person]}_{copy},"
                    + ",".join([*(f"{x:.5f}" for x in o), *(f"{x:.6f}" for x in v), f"{c:.2f}\n"])
                )


def picture(width: int = 1280, height: int = 720, degrees: float = 70.0):
    """Directions (height, width, 3) of a perspective picture that looks along -x, z up."""
    import numpy as np

    half = np.tan(np.radians(degrees / 2))
    y, z = np.meshgrid(np.linspace(-half, half, width), np.linspace(half, -half, height) * height / width)
    d = np.stack([-np.ones_like(y), y, z], axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def main() -> None:
    from output import write_rows

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rays", type=int, default=2_600_000)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data")))
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "benchmarks" / "rays.csv")
    options = parser.parse_args()

    import mitsuba as mi
    import numpy as np

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.density.kde.frame import kde_frame, probe_at
    from nerg_mi.density.probes import place_probes
    from nerg_mi.rays.index import RayIndex
    from nerg_mi.rays.rays import Rays
    from nerg_mi.rays.readers.registry import parse_options, read_rays
    from nerg_mi.rays.summary import summarise

    table = []

    def timed(name: str, work, repeats: int = 1):
        best = None
        for _ in range(repeats):
            wall, cpu = time.perf_counter(), time.process_time()
            result = work()
            spent = time.perf_counter() - wall, time.process_time() - cpu
            best = spent if best is None or spent < best else best
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        table.append({"what": name, "seconds": f"{best[0]:.2f}", "cpu": f"{best[1]:.2f}", "peak_gib": f"{peak:.2f}"})
        print("{what:<58}{seconds:>8} s {cpu:>8} s cpu {peak_gib:>6} GiB".format(**table[-1]), flush=True)
        return result

    files = sorted((options.data / "vr_supermarket").glob("*.csv.gz"))
    if not files:
        raise SystemExit(f"there is no vr_supermarket in {options.data}; say where it is with --data or NERG_DATA")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    raw, saved = options.out.with_name("rays-raw.csv"), options.out.with_name("rays-imported.npz")
    write_resampled(read_rays("vr_supermarket", files), options.rays, raw)
    print(f"{options.rays:,} rays, {raw.stat().st_size / 1e6:.0f} MB")

    mapping = "origin=x,y,z direction=dx,dy,dz t=time person=person confidence=confidence"
    rays = timed("import CSV", lambda: read_rays("table", raw, parse_options("table", {"columns": mapping})))
    timed("save .npz", lambda: rays.save(saved))
    rays = timed("load .npz", lambda: Rays.load(saved))
    timed("sanity card", lambda: summarise(rays))
    index = timed("index: build", lambda: RayIndex(rays))
    queries = rays.origin[np.random.default_rng(1).choice(len(rays), min(4096, len(rays)), replace=False)]
    for radius in (0.1, 0.25):
        timed(f"index: 4,096 queries, R {radius} m, 1,024 rays", partial(index.nearest, queries, 1024, radius), 3)
        timed(
            f"4,096 probes, R {radius} m",
            partial(place_probes, rays, radius, queries=queries, index=index, kappa_rule="fixed"),
            3,
        )
    directions = picture()
    observer = np.median(rays.origin[np.abs(rays.origin[:, 0] + 4.8) < 0.2], axis=0)
    for cap in (256, 1024, 4096):
        probe = probe_at(rays, observer, 0.25, cap=cap, kappa_rule="fixed", kappa=50.0, index=index)
        frames = {}
        for method in ("exact", "table"):
            name = f"720p density of {probe.counts[0]:,} rays, {method}"
            frames[method] = timed(name, partial(kde_frame, probe, directions, method=method), 4)
        off = np.abs(frames["table"] - frames["exact"]).max() / frames["exact"].max()
        print(f"  table against exact: {off:.1e} of the largest density")
    write_rows(options.out, table)
    raw.unlink()


if __name__ == "__main__":
    main()
