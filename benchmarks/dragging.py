"""What a frame costs while its observer stands still, and while they are dragged.

    python benchmarks/dragging.py [--gaze FILE,...] [--size 320x180] [--runs 9] [--threads 2]
    [--tolerance 5e-3,2e-3,0] [--out out/benchmarks/dragging.csv]

The demo store with colour, depth and gaze, one sample a pixel, for each gaze field, the store's own if none is named.
Frames of an observer who stands, and of one who is somewhere else in each, are rendered in turns; for a normalised
field with each of the integral's tolerances. Medians of seconds by the clock and of the processor.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import nerg_mi as nerg
from nerg_mi.files.tables import markdown_table
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.jobs.demo import store_scene

import numpy as np


def main(argv=None) -> None:
    from output import write_rows

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gaze", default=str(store_scene().parent / "shoppers.safetensors"))
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--tolerance", default="5e-3,2e-3,0")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/dragging.csv"))
    args = parser.parse_args(argv)

    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(args.threads)
    width, height = map(int, args.size.split("x"))
    ways = {}
    for file in args.gaze.split(","):
        about = read_metadata(Path(file))
        normalized = about.get("output", {}).get("normalized", about["architecture"].get("normalized", False))
        for tolerance in args.tolerance.split(",") if normalized else [""]:
            scene = nerg.Scene.load(store_scene(), gaze=file, width=width, height=height, spp=1, aovs="depth,gaze")
            if tolerance:
                set_tolerance(scene.integrator, float(tolerance))
            kind = f"normalised, integral_tolerance {tolerance}" if tolerance else "not normalised"
            ways[f"{Path(file).stem} ({kind})"] = Dragged(scene.mitsuba)
    taken = {(name, moved): [] for name in ways for moved in (False, True)}
    for run in range(-3, args.runs):
        for (name, moved), seconds in taken.items():
            found = ways[name].frame(moved)
            # The first ones compile.
            if run >= 0:
                seconds.append(found)
    rows = []
    for name in ways:
        (wall, cpu), (moved_wall, moved_cpu) = (np.median(taken[name, m], axis=0) for m in (False, True))
        row = {"gaze field": name, "still": wall, "dragged": moved_wall}
        row |= {"still, CPU": cpu, "dragged, CPU": moved_cpu, "dragged / still": moved_cpu / cpu}
        rows.append({"frame": args.size, **row})
    write_rows(args.out, rows)
    cell = lambda v: v if isinstance(v, str) else f"{v:.3f}"
    print(markdown_table(list(rows[0]), [[cell(v) for v in row.values()] for row in rows]))


def set_tolerance(integrator, tolerance: float) -> None:
    from dataclasses import replace

    integrator.observer_settings = replace(integrator.observer_settings, integral_tolerance=tolerance)


class Dragged:
    """A scene whose observer can be moved along a path."""

    def __init__(self, scene):
        import mitsuba as mi

        self.scene, self.params, self.steps = scene, mi.traverse(scene), 0

    def frame(self, moved: bool) -> tuple[float, float]:
        """Seconds of a frame, by the clock and of the processor."""
        import mitsuba as mi

        wall, cpu = time.perf_counter(), time.process_time()
        if moved:
            self.steps += 1
            eye = (4.4 + 0.01 * self.steps, 2.8 + 0.02 * self.steps, 1.6)
            self.params["integrator.observer.to_world"] = mi.Transform4f().look_at(eye, (4.8, 6, 1.2), (0, 0, 1))
            self.params.update()
        np.array(mi.render(self.scene, sensor=0, spp=1))
        return time.perf_counter() - wall, time.process_time() - cpu


if __name__ == "__main__":
    main()
