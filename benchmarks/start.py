"""How long it takes until something is there: imports, the command's help, the first picture, the demo.

    python benchmarks/start.py [--runs 5] [--page docs/performance.md]

Each in a process of its own, in turns; medians of wall-clock seconds with their quartiles, and seconds of the
processor. Files are in the system's memory after the first turn, which does not count. "Cold" has no kernels compiled,
"warm" those of the runs before.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from nerg_mi.workflows.demo import store_scene
from timing import median, print_table, spread, write_rows

COMMAND = [str(Path(sys.executable).with_name("nerg"))]
VARIANT = 'import nerg_mi, mitsuba; mitsuba.set_variant("llvm_ad_rgb")'


def works(folder: Path) -> dict[str, tuple[list[str], bool]]:
    """What is run, and whether it begins with no kernels compiled, by name; files are written into ``folder``."""
    picture = [*COMMAND, "render", str(store_scene()), "-o", str(folder / "a.png"), "-m", "llvm_ad_rgb"]
    demo = [*COMMAND, "demo", "-o", str(folder / "demo"), "-m", "llvm_ad_rgb"]
    return {
        "`import nerg_mi`": ([sys.executable, "-c", "import nerg_mi"], False),
        "... and choose a variant": ([sys.executable, "-c", VARIANT], False),
        "`nerg --help`": ([*COMMAND, "--help"], False),
        "`nerg render`, 480 x 320, 4 samples a pixel, warm": (picture, False),
        "... cold": (picture, True),
        "`nerg demo`, warm": (demo, False),
    }


def taken(command: list[str], kernels: Path) -> tuple[float, float]:
    """Wall-clock and processor seconds of ``command``, which keeps compiled ``kernels``. Raises
    ``CalledProcessError`` where it fails."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    environment = {**os.environ, "DRJIT_CACHE_DIR": str(kernels)}
    subprocess.run(command, env=environment, check=True, capture_output=True)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--page", type=Path)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/start.csv"))
    args = parser.parse_args(argv)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "warm").mkdir()
        asked = works(folder)
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in asked}
        for turn in range(args.runs + 1):
            for what, (command, cold) in asked.items():
                with tempfile.TemporaryDirectory(dir=folder) as empty:
                    found = taken(command, Path(empty) if cold else folder / "warm")
                if turn:
                    times[what].append(found)
    for what, found in times.items():
        wall = [w for w, _ in found]
        cpu = f"{median(c for _, c in found):.3g}"
        rows.append({"what": what, "s": f"{median(wall):.3g}", "quartiles": spread(wall), "CPU s": cpu})
    write_rows(args.out, rows)
    print_table("Start", list(rows[0]), [list(r.values()) for r in rows], args.page)


if __name__ == "__main__":
    main()
