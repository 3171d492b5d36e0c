"""Ten million tracked rays through `nerg stats`: seconds, processor seconds and memory of the command.

    python benchmarks/object_size.py [--rays 100000 1000000 10000000] [--seen 100000 1000000] [--min-people N]
                                     [--folder FOLDER]

The rays are walks of the demo store's shoppers, tracked once in 0.8 s, with directions by the store's law; every copy
of the 60 walks is of other people an hour later, ten copies a day, turned by a degree at random. They are written as
Parquet, imported into a dataset with the clock of the day, and counted in the store's 30 goods by the command as it is
called, in a process of its own, without its field. Memory is the most that the process held; FOLDER is left behind.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from object_statistics import Walks

import numpy as np

WALKS, A_FILE = 60, 10
START = 1_780_000_000 // 86_400 * 86_400
COLUMNS = "origin=x,y,z direction=dx,dy,dz t=t person=person"


def made_dataset(folder: Path, count: int) -> Path:
    """A dataset of about ``count`` rays."""
    from nerg_mi.rays.dataset.importing import Recipe
    from nerg_mi.rays.dataset.updating import update_dataset
    from nerg_mi.rays.readers.registry import parse_options, reader_named

    import pyarrow as pa
    import pyarrow.parquet

    dataset = folder / f"{count}.rays"
    if dataset.exists():
        return dataset
    (folder / "sources").mkdir(parents=True, exist_ok=True)
    walks, rng = Walks(WALKS, seed=7), np.random.default_rng(0)
    base = walks.rays(np.arange(WALKS), rng)
    copies = -(-count // len(base))
    files = []
    for first in range(0, copies, A_FILE):
        tables = []
        for c in range(first, min(first + A_FILE, copies)):
            d = base.direction + rng.normal(0, 0.017, base.direction.shape)
            d /= np.linalg.norm(d, axis=1, keepdims=True)
            names = np.array([f"c{c:04d}-{name}" for name in base.persons])[base.person]
            t = START + 86_400 * (c // A_FILE) + 3600 * (8 + c % A_FILE) + base.t
            values = [np.round(t, 3), names, *base.origin.T, *d.T]
            tables.append(pa.table(dict(zip(("t", "person", "x", "y", "z", "dx", "dy", "dz"), values))))
        files.append(folder / "sources" / f"{count}-{first:05d}.parquet")
        pyarrow.parquet.write_table(pa.concat_tables(tables), files[-1])
    recipe = Recipe(reader=reader_named("table"), settings=parse_options("table", {"columns": COLUMNS}), place="store")
    found = update_dataset(dataset, files, recipe, 2)
    if found.errors:
        raise SystemExit(str(found.errors[0]))
    return dataset


def run(arguments: list[str]) -> tuple[float, float, float]:
    """Seconds, processor seconds and GiB of a command."""
    start = time.perf_counter()
    process = subprocess.Popen([str(Path(sys.executable).with_name("nerg")), *arguments], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"nerg {' '.join(arguments)} ended with {os.waitstatus_to_exitcode(status)}")
    return time.perf_counter() - start, used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20


def main() -> None:
    from nerg_mi.jobs.demo import store_scene
    from nerg_mi.rays.dataset.dataset import RayDataset

    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rays", type=int, nargs="*", default=[100_000, 1_000_000, 10_000_000])
    parser.add_argument("--seen", type=int, nargs="*", default=[100_000, 1_000_000])
    parser.add_argument("--min-people", type=int, default=1, help="of the command: 2 or more leave out single people")
    parser.add_argument("--folder", type=Path, help="where datasets are made and kept")
    given = parser.parse_args()
    folder = given.folder or Path(tempfile.mkdtemp())
    mi.set_variant("llvm_ad_rgb")
    store = store_scene().parent
    print("| rays | people | what could be seen | seconds | processor seconds | memory [GiB] |")
    print("| ---: | ---: | --- | ---: | ---: | ---: |", flush=True)
    for seen, counts in ((False, given.rays), (True, given.seen)):
        for count in counts:
            path = made_dataset(folder, count)
            data = RayDataset.open(path)
            out = folder / f"numbers-{count}-{seen}"
            more = ["--min-people", str(given.min_people), *(["--seen"] if seen else [])]
            asked = ["stats", str(path), str(store / "shapes.xml"), "--areas", str(store / "regions.json")]
            wall, cpu, memory = run([*asked, "-o", str(out), *more])
            print(
                f"| {len(data):,} | {len(data.persons):,} | {'yes' if seen else 'no'} | {wall:.1f} | {cpu:.1f} | "
                f"{memory:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
