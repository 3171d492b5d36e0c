"""What parts cost: overhead a task, a fly-through whole and in parts, and what a worker or a scheduler that dies costs.

    python benchmarks/tasks.py [--count 200] [--frames 12] [--width 240] [--rounds 3] [--out out/benchmarks/tasks]

Overhead: tasks that write a line, through each scheduler. Fly-through: frames of the demo store by `nerg render`,
alternating: one go, parts in this process, dask with two workers (one thread each, and the same cores). A fly-through
in parts is then begun again with a worker killed by SIGKILL in the middle, and with the scheduler killed and started
again. Every output is compared byte by byte with that of one go. Medians over rounds, and their spread.
"""

from __future__ import annotations

import argparse
import csv
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from output import write_rows

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
SCENE = ROOT / "scenes" / "store" / "scene.xml"


def overhead(scheduler: str | None, count: int, folder: Path) -> float:
    """Seconds a task, the start of the scheduler left out."""
    from nerg_mi.tasks.opening import open_scheduler
    from nerg_mi.tasks.plan import Plan
    from nerg_mi.tasks.run import carry_out
    from nerg_mi.tasks.store import Store
    from nerg_mi.tasks.task import Task

    def run(name: str, number: int) -> float:
        tasks = [Task("tests.tasks.works:hashed", {"number": k, "run": name}, (), ".txt") for k in range(number)]
        start = time.perf_counter()
        carry_out(Plan(name, tasks), Store(folder / name), open_scheduler(scheduler))
        return time.perf_counter() - start

    # A run of few has the same start; workers are warm after the first.
    run("warm", 4)
    few, many = run("few", 4), run("many", count + 4)
    return (many - few) / count


def frames_file(path: Path, count: int) -> None:
    """A walk down an aisle."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["eye"])
        writer.writerows([[f"4.4, {2 + 2 * k / count:.3f}, 1.6"] for k in range(count)])


def render(folder: Path, name: str, frames: Path, width: int, *more: str) -> tuple[float, Path]:
    """Seconds of a command, and its pictures' folder."""
    out = folder / name
    line = ["render", SCENE, "--frames", frames, "-o", out / "a.png", "-D", f"width={width}"]
    line += ["-D", f"height={2 * width // 3}", *more]
    command = [sys.executable, "-c", "from nerg_mi.cli import main; main()", *map(str, line)]
    start = time.perf_counter()
    subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.perf_counter() - start, out


def same(one: Path, other: Path) -> bool:
    return {p.name: p.read_bytes() for p in one.iterdir()} == {p.name: p.read_bytes() for p in other.iterdir()}


def later(seconds: float, what) -> None:
    timer = threading.Timer(seconds, what)
    timer.daemon = True
    timer.start()


def main() -> None:
    from tests.tasks.clusters import ClusterOfProcesses

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/tasks"))
    args = parser.parse_args()
    os.environ["PYTHONPATH"] = str(ROOT)
    rows: list[dict] = []

    def note(what: str, seconds: list[float], unit: float, equal: bool = True, workers: str = "") -> None:
        middle = statistics.median(seconds)
        row = {"what": what, "workers": workers, "median_s": f"{middle:.4g}", "ratio": f"{middle / unit:.3f}"}
        rows.append({**row, "low_s": f"{min(seconds):.4g}", "high_s": f"{max(seconds):.4g}", "equal": equal})
        print(*rows[-1].values(), sep="  ", flush=True)

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        frames = folder / "frames.csv"
        frames_file(frames, args.frames)
        with ClusterOfProcesses(folder) as cluster:
            cluster.start_worker(), cluster.start_worker()
            for name, scheduler in (("local", None), ("local:2", "local:2"), ("dask", cluster.address)):
                found = [
                    overhead(scheduler, args.count, folder / f"{name[:5]}{name[-1]}{k}") for k in range(args.rounds)
                ]
                note(f"overhead of a task, {name}", found, found[0])
            taken: dict[str, list[float]] = {"one go": [], "parts, local": [], "parts, dask": []}
            equal = True
            render(folder, "warm", frames, args.width, "--scheduler", cluster.address)
            for k in range(args.rounds):
                seconds, whole = render(folder, f"whole{k}", frames, args.width)
                taken["one go"].append(seconds)
                for kind, scheduler in (("parts, local", "local"), ("parts, dask", cluster.address)):
                    store = ("--store", folder / f"store-{kind[-4:]}{k}", "--scheduler", scheduler)
                    seconds, out = render(folder, f"{kind[-4:]}{k}", frames, args.width, *map(str, store))
                    taken[kind].append(seconds)
                    equal = equal and same(whole, out)
            unit = statistics.median(taken["one go"])
            for kind, seconds in taken.items():
                note(f"{args.frames} frames, {kind}", seconds, unit, equal)
            half = statistics.median(taken["parts, dask"]) / 2
            again = ("--store", str(folder / "store-dask0"), "--scheduler", cluster.address)
            seconds, out = render(folder, "again", frames, args.width, *again)
            note("started again when all is done", [seconds], unit, same(whole, out))
            later(half, cluster.workers[0].kill)
            killed = ("--store", str(folder / "killed"), "--scheduler", cluster.address)
            seconds, out = render(folder, "killed-out", frames, args.width, *killed)
            note("a worker killed in the middle", [seconds], unit, same(whole, out))
            cluster.start_worker()
            time.sleep(5)
            later(half, lambda: (cluster.kill_scheduler(), cluster.start_scheduler()))
            restarted = ("--store", str(folder / "restarted"), "--scheduler", cluster.address)
            seconds, out = render(folder, "restarted-out", frames, args.width, *restarted)
            note("the scheduler killed and started again", [seconds], unit, same(whole, out))
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
    args.out.mkdir(parents=True, exist_ok=True)
    write_rows(args.out / "tasks.csv", rows)


if __name__ == "__main__":
    main()
