"""What it costs to render in strips, between which Ctrl-C is looked for: the demo store in strips, in one, and by
mi.render.

    python benchmarks/strips.py [--width 1280] [--rounds 5]

The three take turns in one process, after a first picture each; medians and the spread are printed.
"""

from __future__ import annotations

import argparse
import statistics
import time

import nerg_mi  # noqa: F401 (before Mitsuba, since it chooses the libLLVM)
from nerg_mi.files.tables import markdown_table


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args(arguments)

    from nerg_mi.jobs.demo import store_scene
    from nerg_mi.rendering.bands import render_bands

    import mitsuba as mi
    import numpy as np

    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file(str(store_scene()), width=options.width, height=options.width * 9 // 16)
    sensor = scene.sensors()[0]

    def whole() -> int:
        mi.render(scene, sensor=0, spp=1, seed=0)
        np.array(sensor.film().bitmap())
        return 1

    def strips(samples: int) -> int:
        calls = []
        for band in render_bands(
            scene, sensor, spp=1, seed=0, strip=samples, on_strip=lambda *done: calls.append(done)
        ):
            np.array(band.film.bitmap())
        return len(calls)

    ways = {"mi.render": whole, "one strip": lambda: strips(1 << 30), "strips": lambda: strips(0)}
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    count = {name: way() for name, way in ways.items()}
    for _ in range(options.rounds):
        for name, way in ways.items():
            start = time.perf_counter()
            count[name] = way()
            seconds[name].append(time.perf_counter() - start)
    base = statistics.median(seconds["mi.render"])
    rows = []
    for name, times in seconds.items():
        median = statistics.median(times)
        span = f"{min(times):.2f} - {max(times):.2f}"
        rows.append([name, count[name], f"{median:.2f}", span, f"{median / base:.2f}"])
    print(markdown_table(["way", "strips", "seconds, median", "from - to", "of mi.render"], rows))


if __name__ == "__main__":
    main()
