"""Ablations, folds, bakes and counts on two dask workers of which one is killed, and the scheduler and the command too.

    python benchmarks/killed_work.py [--only ablate] [--elsewhere] [--out out/benchmarks/killed_work]

Each command is run on one machine without a scheduler, then on two workers of one thread each. There, when the first
part is kept, a worker is ended by SIGKILL, with its part in hand; when one more is kept, the scheduler and the command
are; both are started again, and the worker that is left does the rest. What comes out is compared byte by byte with
that of one machine; of trainings without their times. ``--elsewhere``: the worker that is left sees
none of the files, as if it were another machine.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import tempfile
import time
from importlib.resources import files
from pathlib import Path

from output import print_table, write_rows

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
TIMES = ("train_seconds", "frame_seconds", "rays_per_second")


def works(folder: Path) -> dict[str, tuple[str, ...]]:
    """The commands by their names, without output and scheduler; what they read is written into ``folder``."""
    from nerg_mi.formats.ply import write_columns
    from nerg_mi.scenes import store

    import numpy as np
    from tests.evaluation.gaze.test_evaluation import crowd
    from tests.jobs.counting.place import people, write_place
    from tests.surfaces.meshes import box

    crowd(6000, 6).save(folder / "crowd.npz")
    write_place(folder)
    people(40, 15_000, cohorts=False).save(folder / "people.npz")
    vertices, faces = box((0, 0, 0), (8, 6, 3))
    write_columns(folder / "room.ply", dict(zip("xyz", vertices.T)), faces)
    at = np.random.default_rng(0).uniform((2, 2, 1.4), (6, 4, 1.8), (20, 3))
    np.savetxt(folder / "path.csv", at, delimiter=",", header="x,y,z", comments="")
    small = ("--zones", "2", "--positions", "6", "--min-rays", "8", "--radius", "0.5", "--probes", "40")
    variants = ("--recipes", "default", "--variant", "emit_capture", "--variant", "capture", "--default-steps", "40")
    return {
        "ablate": ("ablate", "crowd.npz", "--geometry", "hits", *variants, "--seeds", "2", "--cameras", "0", *small),
        "folds": ("eval", "folds", "crowd.npz", "--geometry", "hits", "--folds", "4", "--steps", "40", *small),
        "bake": (*f"bake room.ply --gaze {files(store) / 'shoppers.safetensors'}".split(), "--path", "path.csv")
        + ("--detail", "0.4"),
        "stats": ("stats", "people.npz", "scene.xml", "--areas", "areas.json", "--seen", "--names"),
    }


def start(folder: Path, name: str, line: tuple[str, ...], *more: str) -> tuple[subprocess.Popen, Path]:
    """A command whose output is called ``name``, and that output's folder."""
    (folder / name).mkdir(exist_ok=True)
    out = folder / name / "out.ply" if line[0] == "bake" else folder / name
    whole = ["-c", "from nerg_mi.cli import main; main()", *line, "-o", str(out), "--threads", "1", *more]
    with (folder / f"{name}.log").open("ab") as log:
        return subprocess.Popen([sys.executable, *whole], cwd=folder, stdout=log, stderr=log), folder / name


def finish(folder: Path, name: str, line: tuple[str, ...], *more: str) -> tuple[float, Path]:
    """Seconds of a command that runs to its end, and its output's folder."""
    begun = time.perf_counter()
    process, out = start(folder, name, line, *more)
    if process.wait():
        raise SystemExit((folder / f"{name}.log").read_text())
    return time.perf_counter() - begun, out


def contents(out: Path) -> dict[str, object]:
    """What has been written that is no time, and tells of no settings: tables, weights, meshes."""
    from safetensors.numpy import load_file

    found: dict[str, object] = {}
    for path in sorted(out.iterdir()):
        if path.suffix == ".csv":
            with path.open(newline="") as file:
                found[path.name] = [{k: v for k, v in r.items() if k not in TIMES} for r in csv.DictReader(file)]
        elif path.suffix == ".safetensors":
            # Its provenance holds the hour.
            found[path.name] = {k: v.tobytes() for k, v in load_file(path).items()}
        elif path.suffix == ".ply":
            found[path.name] = path.read_bytes()
    return found


def disturbed(folder: Path, name: str, line: tuple[str, ...], cluster) -> tuple[float, Path, int]:
    """Seconds, the output's folder, and parts that were kept when the command was killed."""
    from nerg_mi.tasks.store import Store

    from tests.tasks.clusters import wait_until

    more = ("--scheduler", cluster.address, "--store", str(folder / f"{name}.tasks"))
    begun = time.perf_counter()
    process, _ = start(folder, name, line, *more)
    kept = lambda: len(list(Store(folder / f"{name}.tasks").receipts()))
    wait_until(lambda: kept() >= 1, "a part is kept")
    cluster.workers[0].kill()
    already = kept()
    wait_until(lambda: kept() > already, "another part is kept")
    cluster.kill_scheduler()
    process.kill()
    process.wait()
    parts = kept()
    cluster.start_scheduler()
    _, out = finish(folder, name, line, *more)
    return time.perf_counter() - begun, out, parts


def main() -> None:
    from nerg_mi.tasks.store import Store

    from tests.tasks import clusters
    from tests.tasks.clusters import ELSEWHERE, ClusterOfProcesses

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", help="one of the commands")
    parser.add_argument("--elsewhere", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/killed_work"))
    args = parser.parse_args()
    os.environ["PYTHONPATH"] = str(ROOT)
    # A training is a part, and may take minutes beside other work.
    clusters.DEADLINE = 600.0
    rows: list[dict] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for name, line in works(folder).items():
            if args.only not in (None, name):
                continue
            # Scores of folds are always made in parts: of one machine by this process alone.
            alone, whole = finish(folder, f"{name}-alone", line)
            logs = folder / f"{name}-cluster"
            logs.mkdir()
            with ClusterOfProcesses(logs) as cluster:
                cluster.start_worker()
                cluster.start_worker(ELSEWHERE if args.elsewhere else "")
                usual, quiet = finish(folder, f"{name}-usual", line, "--scheduler", cluster.address)
                seconds, out, kept = disturbed(folder, f"{name}-killed", line, cluster)
            parts = len(list(Store(folder / f"{name}-killed.tasks").receipts()))
            same = contents(whole) == contents(quiet) == contents(out) and bool(contents(whole))
            row = {"command": f"nerg {' '.join(line[:2] if name == 'folds' else line[:1])}", "parts": parts}
            row |= {"one machine [s]": f"{alone:.1f}", "two workers [s]": f"{usual:.1f}", "kept when killed": kept}
            rows.append(row | {"with all that [s]": f"{seconds:.1f}", "equal": "yes" if same else "NO"})
            print(*rows[-1].values(), sep="  ", flush=True)
    print_table("Killed work", list(rows[0]), [list(row.values()) for row in rows])
    args.out.mkdir(parents=True, exist_ok=True)
    write_rows(args.out / "killed_work.csv", rows)


if __name__ == "__main__":
    main()
