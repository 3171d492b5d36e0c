"""Time and memory of `nerg rays` on ten million rays.

    python -m tools.ray_sizes [--rays 10000000] [--folder FOLDER] [--update docs/trust.md]

The rays are those of 500 people who walk about for as long as it takes at 50 Hz, with hit points. Each command runs in
a process of its own, whose peak memory is compared with the columns of its input: 92 bytes a ray.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from nerg_mi.rays.rays import Rays
from tools.page import table, update

ROOT = Path(__file__).resolve().parents[1]

PEOPLE = 500


def walks(count: int, seed: int = 0) -> Rays:
    """``count`` rays of people who walk about and look ahead of themselves, at what is a few metres away."""
    rng = np.random.default_rng(seed)
    each = -(-count // PEOPLE)
    origin, direction, hit = (np.empty((each * PEOPLE, 3)) for _ in range(3))
    for p in range(PEOPLE):
        rows = slice(p * each, (p + 1) * each)
        heading = np.cumsum(rng.normal(0, 0.03, each))
        way = np.cumsum(0.02 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
        # Within a shop of 40 x 30 m, whose walls mirror them.
        place = np.abs((way + rng.uniform(0, 30, 2)) % [80, 60] - [40, 30])
        origin[rows] = np.column_stack([place, 1.6 + 0.05 * rng.normal(size=each)])
        d = np.column_stack([np.cos(heading), np.sin(heading), np.full(each, -0.2)]) + 0.3 * rng.normal(size=(each, 3))
        direction[rows] = d / np.linalg.norm(d, axis=1, keepdims=True)
        hit[rows] = origin[rows] + direction[rows] * rng.gamma(4, 0.6, (each, 1))
    person = np.repeat(np.arange(PEOPLE), each)[:count]
    t = np.tile(np.arange(each) * 0.02, PEOPLE)[:count]
    names = [f"visitor {p}" for p in range(PEOPLE)]
    return Rays(t, person, names, origin[:count], direction[:count], rng.random(count), hit[:count])


def measured(command: list[str], says: str) -> tuple[float, int]:
    """Seconds and bytes of memory at the peak of a command, which must succeed, and say what it should."""
    start = time.perf_counter()
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(
            [sys.executable, "-c", "from nerg_mi.cli import main; main()", *command], stdout=said
        )
        _, status, used = os.wait4(process.pid, 0)
        said.seek(0)
        if status or says not in said.read():
            raise SystemExit(f"nerg {' '.join(command)} ended with {os.waitstatus_to_exitcode(status)}")
    return time.perf_counter() - start, used.ru_maxrss * 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rays", type=int, default=10_000_000)
    parser.add_argument(
        "--folder", type=Path, help="where the rays are kept, and found again; default: a temporary one"
    )
    parser.add_argument("--update", type=Path, metavar="PAGE")
    options = parser.parse_args()

    with tempfile.TemporaryDirectory() as room:
        folder = (options.folder or Path(room)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        source = folder / f"rays-{options.rays}.npz"
        if not source.is_file():
            # In another process: a child begins with the peak of its parent.
            made = f"from tools.ray_sizes import walks; walks({options.rays}).save({str(source)!r})"
            subprocess.run([sys.executable, "-c", made], check=True, cwd=ROOT)
        columns = 92 * options.rays
        keep = lambda name, least: ["rays", "filter", str(source), "-o", str(folder / name), "--min-confidence", least]
        commands = {
            "rays show": ["rays", "show", str(source)],
            "rays filter, half of them": keep("half.npz", "0.5"),
            "rays filter, all but a few": keep("most.npz", "0.001"),
        }
        rows = []
        for name, command in commands.items():
            seconds, memory = measured(
                command, "wrote" if "filter" in command else f"{options.rays:,} of {options.rays:,} rows"
            )
            rows.append(
                [
                    name,
                    f"{options.rays:,}",
                    f"{source.stat().st_size / 1e6:,.0f}",
                    f"{columns / 1e6:,.0f}",
                    f"{seconds:.1f}",
                    f"{memory / 1e6:,.0f}",
                    f"{memory / columns:.2f}",
                ]
            )
            print(rows[-1], file=sys.stderr, flush=True)
    head = ["command", "rays", "file (MB)", "columns (MB)", "seconds", "peak memory (MB)", "of the columns"]
    update(options.update, "Millions of rays", table(head, rows))


if __name__ == "__main__":
    main()
