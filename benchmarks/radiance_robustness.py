"""Radiance training on a machine that is slow or busy: steps, how long they take, and PSNR on held-out photos.

    python benchmarks/radiance_robustness.py [--rows 1,2,40s,400s] [--threads 1,2] [--busy 0,2] [--validate] [--new]
                                             [--update docs/radiance-training.md]

``--rows``: minutes, or steps with an "s". Each is run once for each number of ``--threads`` and of ``--busy`` loops
beside it, in a process of its own, by ``train_field`` as the command runs it; held-out photos are rendered by the
trainer. ``--validate`` never opens them: every 8th of the training photos takes their place. The CSV keeps the rows of
earlier calls (``--new``: drops them), so that the table can be measured in parts, and the table of all is printed.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

# BLAS threads wait in a busy loop, in the way of the others.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from fox_radiance import default_data, parse_settings  # noqa: E402

from tools.page import table, update  # noqa: E402

HEADING = "On slow and busy machines"

_RUN = """
import json, sys
from pathlib import Path
job = json.loads(sys.argv[1])
sys.path.insert(0, job["benchmarks"])
import nerg_mi, drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
dr.set_thread_count(job["threads"])
from fox_radiance import validation
from nerg_mi.capture.dataset import open_dataset
from nerg_mi.field.backend import namespace
from nerg_mi.files.tables import write_json
from nerg_mi.formats.fields import save_radiance
from nerg_mi.training.radiance.run import train_field
from nerg_mi.training.radiance.settings import RadianceSettings, sized_config
data = open_dataset(Path(job["data"]), None, job["width"])
data = validation(data) if job["validate"] else data
out = Path(job["out"])
settings = RadianceSettings(minutes=job["minutes"], steps=job["steps"], seed=job["seed"], **job["set"])
_, about = train_field(data, sized_config("small", data.box), settings, namespace("llvm_ad_rgb"), depth=False,
                       state=out.with_suffix(".run"), preview=out.with_suffix(".preview.png"),
                       write=lambda field, about: save_radiance(field, out, about))
write_json(out.with_suffix(".json"), about)
"""


@contextmanager
def busy(loops: int):
    """So many processes that do nothing but keep a core busy."""
    running = [subprocess.Popen(["sh", "-c", "while :; do :; done"]) for _ in range(loops)]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def length(row: str) -> dict:
    """``"2"`` as minutes, ``"400s"`` as steps."""
    return {"minutes": None, "steps": int(row[:-1])} if row.endswith("s") else {"minutes": float(row), "steps": None}


def measure(row: str, threads: int, loops: int, args) -> dict:
    out = args.out / f"{row}_{threads}_{loops}.safetensors"
    job = length(row) | {
        "benchmarks": str(HERE),
        "threads": threads,
        "data": str(args.data),
        "width": args.width,
        "validate": args.validate,
        "seed": args.seed,
        "set": parse_settings(args.set),
        "out": str(out),
    }
    with busy(loops):
        subprocess.run([sys.executable, "-c", _RUN, json.dumps(job)], check=True)
    about = json.loads(out.with_suffix(".json").read_text())
    ms = about["step_ms"]
    return {
        "length": f"{row[:-1]} steps" if row.endswith("s") else f"{row} min",
        "threads": threads,
        "beside": f"{loops} loops" if loops else "nothing",
        "steps": about["steps"],
        "seconds": about["seconds"],
        "evaluations_a_second": about["evaluations_a_second"],
        "ms_min": ms["min"],
        "ms_median": ms["median"],
        "ms_max": ms["max"],
        "max_by_median": round(ms["max"] / ms["median"], 1),
        "psnr": about["psnr_held_out"]["mean"],
        "warnings": len(about["complaints"]),
    }


def _order(row: dict) -> tuple:
    number, unit = row["length"].split()
    return unit, float(number), -int(row["threads"]), row["beside"] != "nothing"


def printed(rows: list[dict]) -> str:
    """The table of ``rows`` in Markdown."""
    head = (
        "run",
        "threads",
        "beside",
        "steps",
        "seconds",
        "million evaluations a second",
        "least, median, most ms a step",
        "most / median",
        "PSNR, dB",
        "warnings",
    )
    return table(
        head,
        [
            (
                r["length"],
                r["threads"],
                r["beside"],
                f"{int(r['steps']):,}",
                f"{float(r['seconds']):.0f}",
                f"{float(r['evaluations_a_second']) / 1e6:.2f}",
                f"{r['ms_min']}, {r['ms_median']}, {r['ms_max']}",
                r["max_by_median"],
                f"{float(r['psnr']):.2f}",
                r["warnings"],
            )
            for r in sorted(rows, key=_order)
        ],
    )


def main(argv=None) -> None:
    from output import write_rows

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", default="1,2,4,40s,400s")
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--busy", default="0,2")
    parser.add_argument("--data", type=Path, default=default_data())
    parser.add_argument("--width", type=int, default=270)
    parser.add_argument("--validate", action="store_true")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--update", type=Path, help="page whose table to replace, such as docs/radiance-training.md")
    parser.add_argument("--new", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/radiance_robustness"))
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / "radiance_robustness.csv"
    rows = []
    if path.exists() and not args.new:
        with path.open(newline="") as file:
            rows = list(csv.DictReader(file))
    for row in args.rows.split(",") if args.rows else []:
        for threads in (int(t) for t in args.threads.split(",")):
            for loops in (int(n) for n in args.busy.split(",")):
                new = measure(row, threads, loops, args)
                same = ("length", "threads", "beside")
                rows = [r for r in rows if any(str(r[k]) != str(new[k]) for k in same)] + [new]
                write_rows(path, rows)
    update(args.update, HEADING, printed(rows))


if __name__ == "__main__":
    main()
