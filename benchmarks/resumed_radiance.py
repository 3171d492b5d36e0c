"""A radiance training killed with SIGKILL and resumed, against one without interruption: final weights and pictures.

    python benchmarks/resumed_radiance.py [--data DIR] [--steps 300] [--width 60]

At one thread and at two, on a posed image set (default: the fox). The killed run is a process of its own that gets
SIGKILL once it has written a state after a third of its steps; a second process resumes from that file. Sums over
threads come in no fixed order, so at two threads a second uninterrupted run gives the scale of that difference.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parent))

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from fox_radiance import default_data

import numpy as np

_RUN = """
import sys
from nerg_mi.jobs.radiance import RadianceOptions, train_radiance
data, width, steps, threads, out, resume = sys.argv[1:]
options = RadianceOptions(width=int(width), steps=int(steps), threads=int(threads), resume=resume == "1",
                          save_every=2.0, depth=False)
train_radiance(data, out, options)
"""


def start(args, threads: int, out: Path, resume: bool = False) -> subprocess.Popen:
    given = [str(args.data), str(args.width), str(args.steps), str(threads), str(out), str(int(resume))]
    return subprocess.Popen([sys.executable, "-c", _RUN, *given])


def finish(process: subprocess.Popen) -> None:
    if process.wait():
        raise SystemExit("a training failed")


def kill_after(process: subprocess.Popen, state: Path, steps: int) -> int:
    """SIGKILL once ``state`` is past ``steps``; returns the steps it holds."""
    from nerg_mi.formats.checkpoint import read_checkpoint

    while process.poll() is None:
        if state.exists():
            done = read_checkpoint(state, "radiance run")[1]["steps"]
            if done >= steps:
                process.send_signal(signal.SIGKILL)
                process.wait()
                return read_checkpoint(state, "radiance run")[1]["steps"]
        time.sleep(0.2)
    raise SystemExit("the run was over before it could be killed; give more --steps")


def compare(a: Path, b: Path) -> str:
    from nerg_mi.formats.checkpoint import read_checkpoint

    (x, about_x), (y, about_y) = read_checkpoint(a, "radiance"), read_checkpoint(b, "radiance")
    same = all(np.array_equal(x[k], y[k]) for k in x)
    gap = np.sqrt(sum(np.sum((x[k] - y[k]).astype(float) ** 2) for k in x if "." in k and "bits" not in k))
    size = np.sqrt(sum(np.sum(x[k].astype(float) ** 2) for k in x if "." in k and "bits" not in k))
    p, q = (m["provenance"]["psnr_held_out"]["mean"] for m in (about_x, about_y))
    return f"{'bit for bit equal' if same else f'relative difference {gap / size:.2e}'}; {p:.3f} and {q:.3f} dB"


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=default_data())
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--width", type=int, default=60)
    parser.add_argument("--threads", default="1,2")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/resumed_radiance"))
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    for threads in (int(t) for t in args.threads.split(",")):
        whole, again, killed = (args.out / f"{name}_{threads}.safetensors" for name in ("whole", "again", "killed"))
        for path in (whole, again, killed):
            path.with_suffix(".run").unlink(missing_ok=True)
        finish(start(args, threads, whole))
        if threads > 1:
            finish(start(args, threads, again))
        at = kill_after(start(args, threads, killed), killed.with_suffix(".run"), args.steps // 3)
        finish(start(args, threads, killed, resume=True))
        print(
            f"{threads} thread(s): killed after step {at} of {args.steps}, resumed: {compare(whole, killed)}",
            flush=True,
        )
        if threads > 1:
            print(f"{threads} threads: two runs without interruption: {compare(whole, again)}", flush=True)


if __name__ == "__main__":
    main()
