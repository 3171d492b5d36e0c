"""Run time of bakes and AOI statistics on a cluster of one and of two workers, compared with a single process.

    python benchmarks/scaling.py [--observers 48] [--rays 1500000] [--out out/benchmarks/scaling]

The environment is a room of 8 x 6 x 3 m with the gaze field of the demo store. The workloads are bakes of a path of
observers on a coarse and on a fine mesh, and AOI statistics of synthetic rays. Each runs on dask with one worker and
with two, of one thread each, after a run that warms up. The benchmark ends with an error if a result differs from that
of a single process. The manifest of each task states its computing time. The overhead of a task is the rest of the
elapsed time, per task.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path

from timing import save_result

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
DETAILS = (0.4, 0.15)


def room(folder: Path, observers: int, count: int) -> None:
    """The room as a mesh and a scene, a path in it, and rays of 40 participants who look around."""
    from nerg_mi.formats.ply import write_columns
    from nerg_mi.tracking.rays import Rays

    from tests.aoi.place import write_place
    from tests.surfaces.meshes import box

    vertices, faces = box((0, 0, 0), (8, 6, 3))
    write_columns(folder / "room.ply", dict(zip("xyz", vertices.T)), faces)
    rng = np.random.default_rng(0)
    at = rng.uniform((2, 2, 1.4), (6, 4, 1.8), (observers, 3))
    np.savetxt(folder / "path.csv", at, delimiter=",", header="x,y,z", comments="")
    write_place(folder, gaze=False)
    person = np.repeat(np.arange(40), count // 40)
    d = rng.normal((1, 0, 0), 0.4, (len(person), 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    origin = np.column_stack([rng.uniform((0.3, 0.3), (2.2, 3.7), (len(person), 2)), np.full(len(person), 1.6)])
    t = np.tile(0.02 * np.arange(count // 40), 40)
    names = tuple(f"person {k:02d}" for k in range(40))
    Rays(t, person, names, origin, d, np.ones(len(person))).save(folder / "rays.npz")


def bake(folder: Path, detail: float, name: str, **overrides) -> tuple[int, bytes]:
    """Observers and the bytes of the results."""
    from nerg_mi.scenes import store
    from nerg_mi.surfaces.bake import bake
    from nerg_mi.tasks.settings import Parallel

    out = folder / f"{name}.ply"
    gaze = files(store) / "shoppers.safetensors"
    parallel, path = Parallel(**overrides), folder / "path.csv"
    result = bake(folder / "room.ply", gaze=gaze, observer_file=path, max_edge=detail, parallel=parallel)
    result.save(out)
    return len(result.mesh.faces), out.read_bytes()


def count(folder: Path, name: str, **overrides) -> tuple[int, bytes]:
    """Rays and the bytes of the table."""
    from nerg_mi.aoi.statistics import statistics as stats
    from nerg_mi.tasks.settings import Parallel

    files, parallel = [folder / "scene.xml", folder / "rays.npz"], Parallel(**overrides)
    result = stats(files, folder / "areas.json", resamples=199, show_names=True, parallel=parallel)
    result.save(folder / name)
    return 0, (folder / name / "aois.csv").read_bytes()


def main() -> None:
    from nerg_mi.tasks.store import Store

    from tests.tasks.clusters import ClusterOfProcesses

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--observers", type=int, default=48, help="Number of observers of a bake. Default: %(default)s."
    )
    parser.add_argument(
        "--rays", type=int, default=1_500_000, help="Number of gaze samples of the statistics. Default: %(default)s."
    )
    args = parser.parse_args()
    os.environ["PYTHONPATH"] = str(ROOT)
    rows: list[dict] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        room(folder, args.observers, args.rays)
        works: dict[str, tuple[int, str, Callable]] = {
            f"bake of {args.observers} observers, detail {d:g}": (args.observers, "observers", partial(bake, folder, d))
            for d in DETAILS
        }
        works[f"counts of {args.rays:,} rays"] = (args.rays, "rays", partial(count, folder))
        full = {what: work(f"whole {what}", threads=1) for what, (_, _, work) in works.items()}
        with ClusterOfProcesses(folder) as cluster:
            for workers in (1, 2):
                cluster.start_worker()
                for what, (units, unit, work) in works.items():
                    arguments = {"scheduler": cluster.address, "threads": 1}
                    work(f"warm {what}", **arguments, store=folder / f"warm {what} {workers}")
                    store = folder / f"{what} {workers}"
                    start = time.perf_counter()
                    faces, made = work(f"{what} {workers}", **arguments, store=store)
                    seconds = time.perf_counter() - start
                    receipts = list(Store(store).iter_manifests())
                    each = [r.seconds for r in receipts]
                    size = sum(r.size for r in receipts) / len(receipts)
                    if made != full[what][1]:
                        raise SystemExit(f"{what}: {workers} workers make something else than one process")
                    row = {
                        "work": f"{what}, {faces:,} triangles" if faces else what,
                        "workers": workers,
                        "parts": len(each),
                        "waited": f"{seconds:.1f} s",
                        "computed a part": f"{statistics.median(each):.2f} s",
                        "besides a part": f"{(workers * seconds - sum(each)) / len(each):.2f} s",
                        "output of a part": f"{size / 1000:,.0f} kB",
                        "throughput": f"{units / seconds:,.{2 if units / seconds < 1000 else 0}f} {unit} a second",
                    }
                    rows.append(row)
                    print(row, flush=True)
    titles = {
        "work": "workload",
        "parts": "tasks",
        "waited": "wall-clock time",
        "computed a part": "computation per task",
        "besides a part": "overhead per task",
        "output of a part": "output per task",
    }
    save_result("scaling", [titles.get(key, key) for key in rows[0]], [list(row.values()) for row in rows])


if __name__ == "__main__":
    main()
