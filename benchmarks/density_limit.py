"""How near the kernels of Dr.Jit come to density evaluated by hand-written code, and to what the machine can do.

    python benchmarks/density_limit.py [--field FILE.safetensors] [--runs 9] [--threads 2]

The same points of the same field: those that a frame of the demo store marches through, and as many at random in
occupied cells. ``density_limit.cpp`` is built by g++ or clang++ into a temporary folder; its densities are compared
with ours before anything is timed. Operations and bytes of an evaluation are counted by its formula; the peaks of the
machine are measured by loops of the same program. Runs are taken in turns; medians, with the quartiles.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.field.constant_weights import set_constant_weights
from output import print_table
from timing import in_turns, median, spread

import numpy as np

SOURCE = Path(__file__).with_name("density_limit.cpp")
FLAGS = ("-O3", "-ffast-math", "-fPIC", "-pthread")
# Without -ffast-math, which links code that makes the whole process take its smallest numbers for 0: SciPy's trees do
# not end then.
LINKING = ("-shared", "-fPIC", "-pthread")
BLOCK = 64
"""Points that the program takes at once."""


class Field(ctypes.Structure):
    """What ``density_limit.cpp`` knows of a field."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("table", "hidden", "head", "scales", "offsets", "rows", "strides")),
        ("levels", ctypes.c_int32),
        ("width", ctypes.c_int32),
        ("lower", ctypes.c_float * 3),
        ("inverse_side", ctypes.c_float),
        ("density_scale", ctypes.c_float),
    )


def compiler() -> str | None:
    """The C++ compiler of this machine, or None."""
    return next(filter(None, map(shutil.which, ("g++", "clang++"))), None)


def build(folder: Path, target: str = "native") -> ctypes.CDLL:
    """Compile the program in ``folder`` for a processor (``target`` of ``-march``) and load it.

    Raises ``RuntimeError`` with the compiler's message where it fails.
    """
    path, part = folder / "density_limit.so", folder / "density_limit.o"
    for options in ((*FLAGS, f"-march={target}", "-c", SOURCE, "-o", part), (*LINKING, part, "-o", path)):
        done = subprocess.run([compiler() or "g++", *options], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{SOURCE.name} was not compiled: {done.stderr.strip()}")
    library = ctypes.CDLL(str(path))
    for name in ("peak_products", "peak_reads", "peak_pairs"):
        getattr(library, name).restype = ctypes.c_float
    return library


class Limit:
    """The hand-written evaluation of the density of ``field``, whose density net has one hidden layer. Raises
    ``ValueError`` for fields of other kinds."""

    def __init__(self, field, library: ctypes.CDLL, threads: int):
        grid, weights = field.config.grid, field.density_net.weights
        if grid.kind != "hashgrid" or grid.features != 2 or len(weights) != 2 or field.box.bound is not None:
            raise ValueError("the hand-written kernel knows hash grids with two features and one hidden layer only")
        self.library, self.threads = library, threads
        hashed = np.array([field.grid.is_hashed(k) for k in range(grid.levels)])
        arrays = {
            "table": np.array(field.grid.table, np.float32),
            "hidden": np.array(weights[0], np.float32),
            "head": np.array(weights[1], np.float32)[0].copy(),
            "scales": grid.level_scales(),
            "offsets": np.array(grid.offsets()[:-1], np.uint32),
            "rows": np.array(grid.level_rows(), np.uint32),
            "strides": np.where(hashed, 0, np.ceil(grid.level_scales()) + 2).astype(np.uint32),
        }
        if np.any(arrays["rows"][hashed] & (arrays["rows"][hashed] - 1)):
            raise ValueError("the hand-written kernel hashes into tables of a power of two only")
        self.arrays = {name: np.ascontiguousarray(value) for name, value in arrays.items()}
        side = field.box.side
        lower = np.asarray(field.box.center) - side / 2
        self.field = Field(
            *(self.arrays[name].ctypes.data for name, _ in Field._fields_[:7]),
            grid.levels,
            len(self.arrays["head"]),
            (ctypes.c_float * 3)(*lower),
            1 / side,
            field.config.density_scale,
        )

    def density(self, p: np.ndarray) -> np.ndarray:
        """Densities of points ``p`` (3, N), float32 and inside of the box, N a multiple of 64."""
        out = np.empty(p.shape[1], np.float32)
        rows = [ctypes.c_void_p(row.ctypes.data) for row in p]
        where = ctypes.c_void_p(out.ctypes.data)
        if self.library.densities(ctypes.byref(self.field), *rows, where, ctypes.c_int64(len(out)), self.threads):
            raise ValueError("the hand-written kernel does not know a field of this size, or so many points")
        return out


@dataclass(frozen=True)
class Work:
    """What an evaluation of density takes: operations on floats, and bytes that it reads and writes."""

    flops: int
    bytes: int
    loads: int
    """Loads of a row of the table."""

    @staticmethod
    def of(config) -> Work:
        """By the formula: a product with a sum is two operations, an exponential function is ten."""
        grid = config.grid
        corners = 2**grid.dimensions
        # Place in the cell: 3 a coordinate. A linear blend: 3 a feature.
        encoding = grid.levels * (3 * grid.dimensions + (corners - 1) * 3 * grid.features)
        sizes = [*config.density_sizes[:-1], 1]
        network = sum(2 * a * b for a, b in zip(sizes, sizes[1:])) + sum(sizes[1:-1])
        loads = grid.levels * corners
        to_unit = 2 * grid.dimensions
        return Work(to_unit + encoding + network + 11, 4 * (grid.dimensions + 1) + 4 * grid.features * loads, loads)


def marched_points(field, o: np.ndarray, d: np.ndarray, count: int) -> np.ndarray:
    """Places (3, count) at which rays from ``o`` along ``d`` (N, 3) step through occupied cells, as packets of 16 rays
    come to them; from the first, again where there are fewer."""
    bits = field.occupancy.bits
    side, n = field.box.side, bits.shape[0]
    lower = np.asarray(field.box.center) - side / 2
    parts, total = [], 0
    for k in range(0, len(o) - 15, 16):
        t = (np.arange(1024) + 0.5) * field.march_step
        p = (o[k : k + 16, None] + d[k : k + 16, None] * t[:, None]).swapaxes(0, 1).reshape(-1, 3)
        p = p[np.all((p > field.box.lower) & (p < field.box.upper), axis=1)]
        x, y, z = ((p - lower) * (n / side)).astype(int).clip(0, n - 1).T
        parts.append(p[bits[z, y, x]])
        total += len(parts[-1])
        if total >= count:
            break
    return np.ascontiguousarray(np.resize(np.concatenate(parts), (count, 3)).T, np.float32)


def random_points(field, count: int, seed: int = 0) -> np.ndarray:
    """Places (3, count), uniform in the occupied cells that lie in the field's box."""
    bits, rng = field.occupancy.bits, np.random.default_rng(seed)
    side, n = field.box.side, bits.shape[0]
    cells = np.argwhere(bits)[:, ::-1]
    p = (cells[rng.integers(0, len(cells), 2 * count)] + rng.random((2 * count, 3))) * (side / n)
    p += np.asarray(field.box.center) - side / 2
    p = p[np.all((p > field.box.lower) & (p < field.box.upper), axis=1)]
    return np.ascontiguousarray(np.resize(p, (count, 3)).T, np.float32)


def ours(field, p: np.ndarray, constant: bool = False):
    """A function that evaluates the density of the field at ``p`` (3, N), and waits for it; ``constant``: with the
    weights of its networks as constants of the kernel."""
    import drjit as dr

    ns = field.ns
    points = ns.Array3f(*map(ns.Float, p))
    dr.eval(points)

    def evaluate():
        set_constant_weights(field, constant)
        out = field.density(points)
        set_constant_weights(field, False)
        dr.eval(out)
        dr.sync_thread()
        return out

    return evaluate


def peaks(limit: Limit, runs: int) -> dict[str, float]:
    """What the machine can do with the threads of ``limit``: ``flops`` and ``dram`` and ``table`` bytes a second, and
    ``pairs``, loads of eight bytes a second at random rows of a table of that size."""
    library, threads, i64 = limit.library, limit.threads, ctypes.c_int64
    table, large = limit.arrays["table"], np.ones(1 << 26, np.float32)
    rows = 1 << (len(table) // 2).bit_length() - 1
    where = lambda a: ctypes.c_void_p(a.ctypes.data)
    rounds, again, loads = 1 << 22, 32, 1 << 22
    work = {
        "flops": lambda: library.peak_products(i64(rounds), threads),
        "dram": lambda: library.peak_reads(where(large), i64(len(large)), i64(1), 0, threads),
        "table": lambda: library.peak_reads(where(table), i64(len(table)), i64(again), 1, threads),
        "pairs": lambda: library.peak_pairs(where(table), ctypes.c_uint32(rows), i64(loads), threads),
    }
    amount = {
        "flops": 2.0 * 16 * 12 * rounds * threads,
        "dram": 4.0 * len(large),
        "table": 4.0 * len(table) * again * threads,
        "pairs": 16.0 * loads * threads,
    }
    # The quickest run, by processor seconds: what else the machine does can only take away from a peak.
    return {name: amount[name] / min(c / threads for _, c in taken) for name, taken in in_turns(work, runs).items()}


def ceilings(found: dict[str, float], work: Work, threads: int) -> list[list[str]]:
    """Cells of the table of what the machine can do, and how long an evaluation takes at least by each."""
    kinds = (
        ("flops", "products and sums in registers", "GFLOP/s", work.flops),
        ("table", "reading the table in order", "GB/s", work.bytes),
        ("dram", "reading memory in order", "GB/s", work.bytes),
        ("pairs", "loads of 8 bytes at random in the table", "10^9/s", work.loads),
    )
    rows = []
    for name, what, unit, amount in kinds:
        if name in found:
            least = f"{1e9 * amount / found[name] * threads:.1f}"
            rows.append([what, f"{found[name] / 1e9:.3g} {unit}", f"{amount:,}", least])
    return rows


def measure(field, points: dict[str, np.ndarray], runs: int, threads: int) -> tuple[list[dict], dict[str, float]]:
    """A row for each of ``points`` (3, N) by name and each evaluation, and the machine's peaks; the peaks and the rows
    of the hand-written program are missing where no compiler is there."""
    work, rows, found = Work.of(field.config), [], {}
    with tempfile.TemporaryDirectory() as folder:
        limit = Limit(field, build(Path(folder)), threads) if compiler() else None
        for name, p in points.items():
            functions = {"Dr.Jit": ours(field, p), "Dr.Jit, constant weights": ours(field, p, constant=True)}
            apart = 0.0
            if limit is not None:
                functions[HAND] = lambda p=p: limit.density(p)
                a, b = np.array(functions["Dr.Jit"]()), limit.density(p)
                # Places are rounded to 1e-7 of the box, which the finest level and the exponential function enlarge.
                off = np.abs(a - b) / np.maximum(a, 1e-3)
                apart = float(np.quantile(off, 0.999))
                if not (apart < 1e-3 and off.max() < 1e-2):
                    raise SystemExit(f"the hand-written kernel gives other densities: {apart:.1e} apart")
            taken = in_turns(functions, runs)
            for who, times in taken.items():
                cpu = 1e9 * median(c for _, c in times) / p.shape[1]
                rows.append(
                    {
                        "points": name,
                        "evaluation": who,
                        "ns CPU": cpu,
                        "quartiles": spread([1e9 * c / p.shape[1] for _, c in times]),
                        "gflops": work.flops / cpu * threads,
                        "apart": apart if who == HAND else 0.0,
                    }
                )
        if limit is not None:
            found = peaks(limit, runs)
    return rows, found


HAND = "C++ by hand"
CEILINGS = ("what", "at most", "an evaluation takes", "ns of CPU at least")
HEAD = ("points", "evaluation", "ns of CPU", "quartiles", "GFLOP/s", "of the roof", "times by hand")


def table(rows: list[dict], found: dict[str, float], work: Work) -> list[list[str]]:
    """Cells of the table of evaluations; the roof is the least of what products and bytes of the table allow."""
    roof = min(found["flops"], found["table"] / work.bytes * work.flops) / 1e9 if found else None
    cells = []
    for row in rows:
        hand = [r for r in rows if r["points"] == row["points"] and r["evaluation"] == HAND]
        cells.append(
            [
                row["points"],
                row["evaluation"],
                f"{row['ns CPU']:.1f}",
                row["quartiles"],
                f"{row['gflops']:.1f}",
                f"{row['gflops'] / roof:.0%}" if roof else "no compiler",
                f"{row['ns CPU'] / hand[0]['ns CPU']:.2f}" if hand else "no compiler",
            ]
        )
    return cells


def main(argv=None) -> None:
    import mitsuba as mi

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--field", type=Path)
    parser.add_argument("--points", type=int, default=1 << 19)
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--threads", type=int, default=min(2, os.cpu_count() or 1))
    args = parser.parse_args(argv)
    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.field.backend import namespace
    from nerg_mi.formats.fields import load_radiance
    from nerg_mi.jobs.demo import store_scene
    from torch_frames import camera_rays

    import drjit as dr

    dr.set_thread_count(args.threads)
    path = args.field or store_scene().parent / "store.safetensors"
    field = load_radiance(path, namespace("llvm_ad_rgb"))[0]
    points = {
        "of a frame": marched_points(field, *camera_rays(320, 180), args.points),
        "at random": random_points(field, args.points),
    }
    work = Work.of(field.config)
    rows, found = measure(field, points, args.runs, args.threads)
    print_table("Evaluations of density", HEAD, table(rows, found, work))
    print_table("The machine", CEILINGS, ceilings(found, work, args.threads))


if __name__ == "__main__":
    main()
