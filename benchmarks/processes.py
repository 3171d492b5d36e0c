"""Measurements in separate processes: the peak memory of a frame, start-up times, and the commands of a study.

    python benchmarks/processes.py memory [--sizes 640x360,1280x720,1920x1080]
    python benchmarks/processes.py start [--runs 5]
    python benchmarks/processes.py commands

``memory`` measures a frame of the demo store with colour, depth and the gaze of an observer who is not at the camera,
at one sample per pixel. The image is rendered in one piece by ``mi.render``, and in strips by `nerg render`. Resident
memory is the peak of the process (the high-water mark of its resident set) minus its size after the package is imported
and the variant is set. It includes the field, the compiled kernels and the image. The memory of arrays is the maximum
that Dr.Jit held in arrays. Kernels come from the cache: a first process, which is not measured, compiles them.

``start`` measures the time until the package is imported, until the help of the command is printed, and until the first
image and the demo are finished. The commands alternate. The table has medians and quartiles of wall-clock seconds, and
medians of CPU seconds. A first round, which is not measured, loads the files into the cache of the system. "Cold" runs
start without compiled kernels, "warm" runs with those of previous runs.

``commands`` runs those of the quick start once, in their order, on 150,021 samples of 100 simulated participants of the
demo store. The first one starts without compiled kernels. The table has wall-clock and CPU seconds.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from timing import median, save_result, spread

SIZES = ((320, 180), (1280, 720), (1920, 1080))
WAYS = ("mi.render", "nerg render")
HEADS = {
    "memory": ("image size", *(f"`{mode}`: peak memory (arrays), MB" for mode in WAYS)),
    "start": ("command", "time, s", "quartiles, s", "CPU time, s"),
    "commands": ("command", "time, s", "CPU time, s"),
}
"""Titles of columns by benchmark."""
COMMAND = [str(Path(sys.executable).with_name("nerg"))]
VARIANT = 'import nerg_mi, mitsuba; mitsuba.set_variant("llvm_ad_rgb")'


def status(name: str) -> float:
    """An entry of this process's memory, in MB: ``VmRSS`` or ``VmHWM``."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) * 1024 / 1e6
    raise RuntimeError(f'this system does not say "{name}" of a process; measure on Linux')


def peak(direction: str, width: int, height: int) -> dict[str, float]:
    """Memory of one frame in this process."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.environment.scene_loading import load_scene
    from nerg_mi.figures.films import render_film
    from nerg_mi.scenes.store import SCENE_FILE

    dr.eval(mi.Float([0.0, 1.0]) + 1)
    dr.sync_thread()
    # Resets the high-water mark.
    Path("/proc/self/clear_refs").write_text("5")
    before = status("VmRSS")
    values = {"width": str(width), "height": str(height), "spp": "1", "aovs": "depth,gaze"}
    if direction == "mi.render":
        np.array(mi.render(load_scene(SCENE_FILE, values), spp=1))
    else:
        with tempfile.TemporaryDirectory() as folder:
            render_film(SCENE_FILE, Path(folder) / "a.exr", spp=1, defaults=values)
    arrays = dr.detail.malloc_watermark(dr.JitBackend.LLVM) / 1e6
    return {"resident": status("VmHWM") - before, "arrays": arrays}


def memory(sizes=SIZES) -> list[list[str]]:
    """A row for each of ``sizes``."""
    rows = []
    for width, height in sizes:
        row = [f"{width} x {height}"]
        for direction in WAYS:
            command = [sys.executable, __file__, "memory", "--one", direction, "--sizes", f"{width}x{height}"]
            for _ in range(2):
                peaks = json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)
            row.append(f"{peaks['resident']:.0f} ({peaks['arrays']:.0f})")
        rows.append(row)
    return rows


def works(folder: Path) -> dict[str, tuple[list[str], bool]]:
    """Commands by name, and whether they start without compiled kernels; files are written into ``folder``."""
    # Loads Dr.Jit, whose cache of kernels `torch_frames` must choose before.
    from nerg_mi.scenes.store import SCENE_FILE

    picture = [*COMMAND, "render", str(SCENE_FILE), "-o", str(folder / "a.png"), "-m", "llvm_ad_rgb"]
    demo = [*COMMAND, "demo", "-o", str(folder / "demo"), "-m", "llvm_ad_rgb"]
    return {
        "`import nerg_mi`": ([sys.executable, "-c", "import nerg_mi"], False),
        "... and choose a variant": ([sys.executable, "-c", VARIANT], False),
        "`nerg --help`": ([*COMMAND, "--help"], False),
        "`nerg render`, 480 x 320, 4 samples a pixel, warm": (picture, False),
        "... cold": (picture, True),
        "`nerg demo`, warm": (demo, False),
    }


def seconds_of(command: list[str], kernels: Path) -> tuple[float, float]:
    """Wall-clock and CPU seconds of ``command``, which caches compiled ``kernels``. Raises ``CalledProcessError`` if it
    fails."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    environment = {**os.environ, "DRJIT_CACHE_DIR": str(kernels)}
    subprocess.run(command, env=environment, check=True, capture_output=True)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def start(runs: int) -> list[list[str]]:
    """A row for each of `works`."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "warm").mkdir()
        commands = works(folder)
        times: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
        for turn in range(runs + 1):
            for what, (command, cold) in commands.items():
                with tempfile.TemporaryDirectory(dir=folder) as empty:
                    seconds = seconds_of(command, Path(empty) if cold else folder / "warm")
                if turn:
                    times[what].append(seconds)
    rows = []
    for what, seconds in times.items():
        wall, cpu = zip(*seconds)
        rows.append([what, f"{median(wall):.3g}", spread(wall), f"{median(cpu):.3g}"])
    return rows


def quick_start(tracking: Path, folder: Path) -> list[list[str]]:
    """Arguments of the commands of the quick start, each of which reads files of those before it in ``folder``."""
    from nerg_mi.scenes.store import SCENE_FILE

    field, areas = (str(SCENE_FILE.with_name(name)) for name in ("store.safetensors", "regions.json"))
    names = ("rays.npz", "gaze.safetensors", "gaze.eval", "scene.xml", "report.html", "numbers")
    rays, gaze, scores, scene, report, numbers = (str(folder / name) for name in names)
    return [
        ["rays", "import", str(tracking), "--preset", "skeleton", "--tick", "0.001", "-o", rays],
        ["train", "gaze", rays, "--environment", field, "--test-zones", "3", "--test-participants", "0.5", "-o", gaze],
        ["eval", "gaze", gaze, rays, "--environment", field],
        ["scene", field, gaze, rays, "-o", scene],
        ["report", field, gaze, rays, scores, "--aois", areas, "-o", report],
        ["stats", rays, scene, "--aois", areas, "-o", numbers],
    ]


def commands() -> list[list[str]]:
    """A row for each command of `quick_start`."""
    from nerg_mi.scenes.store import make

    tracking, rows = Path(make.__file__).parent / "build" / "shoppers.csv", []
    if not tracking.is_file():
        make.main(["--stage", "shoppers"])
    with tempfile.TemporaryDirectory() as name:
        kernels = Path(name) / "kernels"
        kernels.mkdir()
        for words in quick_start(tracking, Path(name)):
            wall, cpu = seconds_of([*COMMAND, *words], kernels)
            title = " ".join(words[: 2 if words[0] in ("rays", "train", "eval") else 1])
            rows.append([f"`nerg {title}`", f"{wall:.3g}", f"{cpu:.3g}"])
    return rows


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=HEADS, help="Measurement; see above.")
    parser.add_argument(
        "--sizes",
        default=",".join(f"{w}x{h}" for w, h in SIZES),
        help="Sizes of the images in pixels, WIDTHxHEIGHT, separated by commas (memory). Default: %(default)s.",
    )
    parser.add_argument(
        "--runs", type=int, default=5, help="Number of runs of each command (start). Default: %(default)s."
    )
    parser.add_argument(
        "--one",
        choices=WAYS,
        help="Print the memory of one frame, measured in this process, by the given renderer. Default: none.",
    )
    args = parser.parse_args(argv)
    sizes = [tuple(map(int, size.split("x"))) for size in args.sizes.split(",")]
    if args.one:
        print(json.dumps(peak(args.one, *sizes[0])))
        return
    measure = {"memory": lambda: memory(sizes), "start": lambda: start(args.runs), "commands": commands}
    save_result(args.what, HEADS[args.what], measure[args.what]())


if __name__ == "__main__":
    main()
