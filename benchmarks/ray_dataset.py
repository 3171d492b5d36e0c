"""More rays than one file holds: a dataset imported from hundreds of files, and asked.

    python benchmarks/ray_dataset.py [--rays 100000000] [--files 200] [--workers 2] [--data FOLDER]
                                     [--folder FOLDER] [--no-train] [--update docs/tracking.md]

The rays are those of the VR supermarket, resampled: in each file, copies of all recordings an hour apart, each shifted
by some decimetres, jittered by a centimetre and a degree and of people of their own; ten files a day. Every other file
is a CSV, the others are Parquet. They are imported by so many processes, and again; then the dataset is asked for the
rays of a box, a person and an hour, for samples, for its card and for a training. All rays of the files are read once
more with NumPy and pyarrow alone: counts, and sums of all coordinates by person, must be those of the dataset. Seconds
are wall-clock time of first runs, whose files may lie in the cache, and processor time of all processes, which says
more on a machine that does other things besides; memory is the largest that a process ever held (VmHWM). FOLDER needs
some 140 bytes a ray, and is removed in the end.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

ROOT = Path(__file__).resolve().parents[1]
TITLE = "More than one file holds"
HEAD = ("what", "rays", "seconds", "processor seconds", "memory, GiB")
COLUMNS = ("t", "person", "x", "y", "z", "dx", "dy", "dz", "confidence", "hx", "hy", "hz")
MAP = "origin=x,y,z direction=dx,dy,dz t=t person=person confidence=confidence hit=hx,hy,hz"
START = 1_780_000_000 // 86_400 * 86_400  # midnight of the first day, seconds since 1970
PLACE = "supermarket"
_TIMES = ("seconds", "cpu")


def write_sources(source, count: int, files: int, folder: Path) -> list[Path]:
    """Files of ``count`` rays altogether that are made from those of ``source``."""
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for k in range(files):
        n = count * (k + 1) // files - count * k // files
        table = pa.table(resampled(source, n, k))
        paths.append(folder / (f"session{k:04d}.csv" if k % 2 else f"session{k:04d}.parquet"))
        if k % 2:
            pa.csv.write_csv(table, paths[-1], pa.csv.WriteOptions(quoting_style="none"))
        else:
            pa.parquet.write_table(table, paths[-1])
    return paths


def resampled(source, count: int, k: int) -> dict:
    """Columns of a file of ``count`` rays: the ``k``-th."""
    import numpy as np

    rng = np.random.default_rng(k)
    parts: dict[str, list] = {name: [] for name in COLUMNS}
    for copy in range(-(-count // len(source))):
        n = min(len(source), count - copy * len(source))
        shift = rng.normal(0, 0.15, 3) * [1, 1, 0.3]
        origin = source.origin[:n] + shift + rng.normal(0, 0.01, (n, 3))
        d = source.direction[:n] + rng.normal(0, 0.02, (n, 3))
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        hit = origin + d * np.linalg.norm(source.hit[:n] - source.origin[:n], axis=1)[:, None]
        t = START + 86_400 * (k // 10) + 3600 * (8 + copy) + 300 * (k % 10) + source.t[:n] - source.t.min()
        names = np.array([f"{name}_{k}_{copy}" for name in source.persons])
        values = [np.round(t, 3), names[source.person[:n]], *np.round(origin, 5).T, *np.round(d, 6).T]
        for name, value in zip(COLUMNS, [*values, np.round(source.confidence[:n], 2), *np.round(hit, 4).T]):
            parts[name].append(value)
    return {name: np.concatenate(values) for name, values in parts.items()}


def held(pid: int | str = "self") -> float:
    """The most memory that a process has held, GiB; 0 where it is gone."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 2**20 for line in status.splitlines() if line.startswith("VmHWM")), 0.0)


def spent() -> float:
    """Processor seconds of this process and of those that it has ended."""
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def import_all(files: list[Path], dataset: Path, workers: int) -> dict:
    """Import ``files``: seconds, what was done, and the memory of this process and of the largest worker."""
    import multiprocessing

    from nerg_mi.rays.dataset.importing import Recipe
    from nerg_mi.rays.dataset.updating import update_dataset
    from nerg_mi.rays.readers.registry import parse_options, reader_named

    settings = parse_options("table", {"columns": MAP})
    recipe = Recipe(reader=reader_named("table"), settings=settings, place=PLACE)
    most, over = [0.0], threading.Event()

    def watch() -> None:
        while not over.wait(0.1):
            most.append(max([most.pop(), *(held(p.pid) for p in multiprocessing.active_children())]))

    watcher = threading.Thread(target=watch)
    watcher.start()
    start, before = time.perf_counter(), spent()
    found = update_dataset(dataset, files, recipe, workers)
    seconds, cpu = time.perf_counter() - start, spent() - before
    over.set()
    watcher.join()
    assert not found.errors, found.errors[0]
    return {"seconds": seconds, "cpu": cpu, "worker": most[0], "parent": held(), **asdict(found)}


def in_own_process(what: str, *arguments: object) -> dict:
    """What this script prints as JSON when it is run with ``--only`` and these arguments: memory is then its own."""
    command = [sys.executable, str(Path(__file__).resolve()), "--only", json.dumps([what, *map(str, arguments)])]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def ask(dataset: Path, what: str) -> dict:
    """One question to a dataset: how many rays, seconds, memory."""
    from nerg_mi.rays.dataset.card import summarise_dataset
    from nerg_mi.rays.dataset.conditions import Conditions
    from nerg_mi.rays.dataset.dataset import RayDataset

    opened = RayDataset.open(dataset)
    person = opened.persons[len(opened.persons) // 2]
    x, y, _ = next(opened.scan()).origin[0]  # where somebody was
    conditions = {
        "box": Conditions(box=[x - 0.25, x + 0.25, y - 0.25, y + 0.25, 0.0, 3.0]),
        "person": Conditions(persons=[person]),
        "hour": Conditions(time=(START + 10 * 3600, START + 11 * 3600)),
        "all": Conditions(),
    }
    asked: dict[str, Callable[[RayDataset], int]] = {
        "open": len,
        **{name: lambda d, c=c: sum(len(block) for block in d.scan(c)) for name, c in conditions.items()},
        "sample": lambda d: len(d.sample(1_000_000)),
        "runs": lambda d: len(d.sample(1_000_000, runs=64)),
        "card": lambda d: summarise_dataset(d)[1].rays,
    }
    start, before = time.perf_counter(), spent()
    count = asked[what](RayDataset.open(dataset))
    return {"rays": count, "seconds": time.perf_counter() - start, "cpu": spent() - before, "memory": held()}


def sums_of_files(files: list[Path]) -> dict:
    """Counts and sums of the columns of numbers by person, of the files, with NumPy and pyarrow alone."""
    import numpy as np
    import pyarrow.parquet

    total: dict[str, np.ndarray] = {}
    for path in files:
        if path.suffix == ".csv":
            numbers = np.loadtxt(path, delimiter=",", skiprows=1, usecols=[k for k in range(12) if k != 1])
            names = np.loadtxt(path, delimiter=",", skiprows=1, usecols=1, dtype=str)
        else:
            table = pyarrow.parquet.read_table(path)
            names = np.array(table.column("person").to_pylist())
            numbers = np.stack([table.column(c).to_numpy() for c in COLUMNS if c != "person"], axis=1)
        add_sums(total, names, numbers)
    return total


def sums_of_dataset(dataset: Path) -> dict:
    """The same of the dataset."""
    from nerg_mi.rays.dataset.dataset import RayDataset

    import numpy as np

    total: dict[str, np.ndarray] = {}
    for block in RayDataset.open(dataset).scan():
        columns = [block.t[:, None], block.origin, block.direction, block.confidence[:, None], block.hit]
        add_sums(total, np.array(block.persons)[block.person], np.concatenate(columns, axis=1))
    return total


def add_sums(total: dict, names, numbers) -> None:
    import numpy as np

    known, codes = np.unique(names, return_inverse=True)
    numbers = np.nan_to_num(numbers)
    # Times would drown what is written of them in rounding.
    numbers[:, 0] -= START
    sums = np.stack([np.bincount(codes), *(np.bincount(codes, column) for column in numbers.T)], axis=1)
    for name, row in zip(known.tolist(), sums):
        total[name] = total.get(name, 0) + row


def check(files: list[Path], dataset: Path) -> str:
    """That the dataset holds the files' rays. Raises ``AssertionError``."""
    import numpy as np

    one, two = sums_of_files(files), sums_of_dataset(dataset)
    assert set(one) == set(two), "other people"
    a, b = (np.array([found[name] for name in sorted(one)]) for found in (one, two))
    assert np.array_equal(a[:, 0], b[:, 0]), "other numbers of rays"
    off = (np.abs(a - b) / a[:, :1])[:, 1:].max(axis=0)
    # Directions are of unit length to the digits that they were written with; float32 does the rest.
    assert off[0] < 1e-6 and off[1:].max() < 2e-6, off
    return f"{len(one):,} people, {int(a[:, 0].sum()):,} rays; means of a person off by {off.max():.1e} at most"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rays", type=int, default=100_000_000)
    parser.add_argument("--files", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data")))
    parser.add_argument("--folder", type=Path, default=ROOT / "out" / "benchmarks" / "ray-dataset")
    parser.add_argument("--no-train", action="store_true", help="leave out the training")
    parser.add_argument("--update", type=Path, help="page whose table is replaced: docs/tracking.md")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.only:
        what, folder, *rest = json.loads(options.only)
        files = sorted((Path(folder) / "files").iterdir())
        dataset = Path(folder, "shop.rays")
        print(json.dumps(import_all(files, dataset, int(rest[0])) if what == "import" else ask(dataset, what)))
        return

    from nerg_mi.rays.readers.registry import read_rays
    from output import print_table

    recordings = sorted((options.data / "vr_supermarket").glob("*.csv.gz"))
    if not recordings:
        raise SystemExit(f"there is no vr_supermarket in {options.data}; say where it is with --data or NERG_DATA")
    if options.folder.exists():
        raise SystemExit(f"{options.folder} is there already; remove it, or name another --folder")
    try:
        start = time.perf_counter()
        source = read_rays("vr_supermarket", recordings)
        files = write_sources(source, options.rays, options.files, options.folder / "files")
        size = sum(path.stat().st_size for path in files)
        print(f"{len(files)} files, {size / 1e9:.2f} GB, made in {time.perf_counter() - start:.0f} s", flush=True)
        rows = measured(options, size)
        print(check(files, options.folder / "shop.rays"), flush=True)
        print_table(TITLE, HEAD, rows, options.update)
    finally:
        shutil.rmtree(options.folder, ignore_errors=True)


def measured(options: argparse.Namespace, size: int) -> list[tuple[str, ...]]:
    """The rows of the table."""
    dataset = options.folder / "shop.rays"
    rows: list[tuple[str, ...]] = []

    def row(what: str, rays: int, found: dict, memory: str) -> None:
        rows.append(
            (what, f"{rays:,}", *(f"{found[s]:.2g}" if found[s] < 10 else f"{found[s]:.0f}" for s in _TIMES), memory)
        )
        print(*rows[-1], sep="  ", flush=True)

    done = in_own_process("import", options.folder, options.workers)
    parts = list(dataset.rglob("*.parquet"))
    kept = sum(path.stat().st_size for path in dataset.rglob("*") if path.is_file())
    what = f"import of {options.files} files ({size / 1e9:.2g} GB), {options.workers} processes"
    row(what, done["rays"], done, f"{done['worker']:.2f} a process, {done['parent']:.2f} the first")
    print(f"{len(parts)} parts, {kept / 1e9:.2f} GB, {kept / done['rays']:.1f} bytes a ray", flush=True)
    again = in_own_process("import", options.folder, options.workers)
    assert again["unchanged"] == options.files and not again["imported"]
    row("the same import again", 0, again, f"{again['parent']:.2f}")
    for what, name in (
        ("open: people, times, boxes of all parts", "open"),
        ("rays of a box of 0.5 m", "box"),
        ("rays of a person", "person"),
        ("rays of an hour", "hour"),
        ("a sample, each ray as likely", "sample"),
        ("a sample in 64 runs", "runs"),
        ("the sanity card", "card"),
        ("all, block by block", "all"),
    ):
        found = in_own_process(name, options.folder)
        row(what, found["rays"], found, f"{found['memory']:.2f}")
    if not options.no_train:
        what, found = training(dataset)
        row(what, found["rays"], found, f"{found['memory']:.2f}")
    return rows


def training(dataset: Path) -> tuple[str, dict]:
    """``nerg train gaze`` as it is by default."""
    output = dataset.with_name("gaze.safetensors")
    command = ["-m", "nerg_mi.cli", "train", "gaze", str(dataset), "-o", str(output), "--geometry", "hits"]
    program = f"import sys; sys.argv = ['nerg', *{command[2:]!r}]; from nerg_mi.cli import main; main()"
    start, before = time.perf_counter(), spent()
    with subprocess.Popen([sys.executable, "-c", program]) as process:
        most = 0.0
        while process.poll() is None:
            most = max(most, held(process.pid))
            time.sleep(0.2)
    assert process.returncode == 0
    found = {"seconds": time.perf_counter() - start, "cpu": spent() - before, "memory": most}
    from nerg_mi.formats.checkpoint import read_checkpoint

    about = read_checkpoint(output, "gaze")[1]["provenance"]
    what = f"`nerg train gaze --geometry hits`, {about['steps']} steps"
    return what, {**found, "rays": about["rays_file"]["rays"]}


if __name__ == "__main__":
    main()
