"""Peak memory of a frame, each figure of a process of its own.

    python benchmarks/frame_memory.py [--sizes 640x360,1280x720,1920x1080] [--page docs/performance.md]

The demo store: colour, depth and gaze of an observer who is not the camera, one sample a pixel. Resident: the most
memory of the process (high-water mark of its resident set) beyond what it held with the package imported and the
variant chosen; the field, the compiled kernels and the picture are in it. Arrays: the most that Dr.Jit held in arrays.
In one piece by ``mi.render``, and by `nerg render`, which renders in strips. Kernels come from the cache: a first
process, which is not counted, compiles them.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from timing import print_table

SIZES = ((320, 180), (1280, 720), (1920, 1080))
WAYS = ("mi.render", "nerg render")
HEAD = ("frame", *(f"`{way}`, MB resident (MB of arrays)" for way in WAYS))


def status(name: str) -> float:
    """An entry of this process's memory, in MB: ``VmRSS`` or ``VmHWM``."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) * 1024 / 1e6
    raise RuntimeError(f'this system does not say "{name}" of a process; measure on Linux')


def peak(way: str, width: int, height: int) -> dict[str, float]:
    """Of one frame in this process."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.rendering.scene import load_scene
    from nerg_mi.workflows.demo import store_scene
    from nerg_mi.workflows.render import render_file
    from nerg_mi.workflows.scene_commands import PictureOptions

    dr.eval(mi.Float([0.0, 1.0]) + 1)
    dr.sync_thread()
    # What was held for a moment before counts no more.
    Path("/proc/self/clear_refs").write_text("5")
    before = status("VmRSS")
    values = {"width": str(width), "height": str(height), "spp": "1", "aovs": "depth,gaze"}
    if way == "mi.render":
        np.array(mi.render(load_scene(store_scene(), values), spp=1))
    else:
        with tempfile.TemporaryDirectory() as folder:
            options = PictureOptions(spp=1, defaults=values, mode="llvm_ad_rgb")
            render_file(store_scene(), Path(folder) / "a.exr", options)
    arrays = dr.detail.malloc_watermark(dr.JitBackend.LLVM) / 1e6
    return {"resident": status("VmHWM") - before, "arrays": arrays}


def measured(width: int, height: int) -> list[str]:
    """A row of the table."""
    row = [f"{width} x {height}"]
    for way in WAYS:
        command = [sys.executable, __file__, "--one", way, "--sizes", f"{width}x{height}"]
        for _ in range(2):
            found = json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout)
        row.append(f"{found['resident']:.0f} ({found['arrays']:.0f})")
    return row


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", default=",".join(f"{w}x{h}" for w, h in SIZES))
    parser.add_argument("--one", choices=WAYS, help="print one figure, measured in this process")
    parser.add_argument("--page", type=Path)
    args = parser.parse_args(argv)
    sizes = [tuple(map(int, size.split("x"))) for size in args.sizes.split(",")]
    if args.one:
        print(json.dumps(peak(args.one, *sizes[0])))
        return
    print_table("Memory", HEAD, [measured(*size) for size in sizes], args.page)


if __name__ == "__main__":
    main()
