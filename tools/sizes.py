"""What memory pictures of the demo store take: peak of a process that renders one, from 1080p to 8K.

python -m tools.sizes [--only 1080p,4K] [--memory GB] [--update docs/trust.md]      (8K: some ten minutes on two cores)
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from tools.page import table, update

SIZES = {"1080p": (1920, 1080), "4K": (3840, 2160), "8K": (7680, 4320)}

_CHILD = """
import json, resource, sys, time
from nerg_mi.jobs.demo import store_scene
from nerg_mi.jobs.pictures import PictureOptions, render_file
from nerg_mi.rendering import bands

output, width, height, memory = sys.argv[1], *map(int, sys.argv[2:4]), float(sys.argv[4])
counted = []
render_bands = bands.render_bands

def count(*args, **kwargs):
    for band in render_bands(*args, **kwargs):
        counted.append(band.rows)
        yield band

bands.render_bands = count
start = time.perf_counter()
size = {"width": str(width), "height": str(height)}
render_file(store_scene(), output, PictureOptions(defaults=size, spp=1, memory=memory))
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
print(json.dumps({"bands": len(counted), "peak": peak, "seconds": time.perf_counter() - start}))
"""


def measure(width: int, height: int, memory: float) -> dict:
    """``bands``, ``peak`` (bytes) and ``seconds`` of a process that renders the store, one sample a pixel, to an EXR
    file."""
    with tempfile.TemporaryDirectory() as folder:
        arguments = [sys.executable, "-c", _CHILD, str(Path(folder) / "a.exr"), str(width), str(height), str(memory)]
        done = subprocess.run(arguments, check=True, capture_output=True, text=True)
        size = (Path(folder) / "a.exr").stat().st_size
    return json.loads(done.stdout) | {"file": size}


def row(name: str, width: int, height: int, memory: float) -> tuple[str, ...]:
    """A line of the table."""
    found = measure(width, height, memory)
    return (
        f"{name} ({width} x {height})",
        f"{memory:g} GB",
        str(found["bands"]),
        f"{found['peak'] / 1e6:,.0f} MB",
        f"{found['file'] / 1e6:,.0f} MB",
    )


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", default=",".join(SIZES), help="comma-separated sizes")
    parser.add_argument("--memory", type=float, default=1.0, help="GB, as of nerg render")
    parser.add_argument("--update", metavar="PAGE", help="page to put the table into")
    options = parser.parse_args(arguments)
    names = options.only.split(",")
    for name in names:
        if name not in SIZES:
            parser.error(f'there is no size "{name}"; there are {", ".join(SIZES)}')
    head = ("picture, 1 sample a pixel, 7 channels", "--memory", "bands", "peak of the process", "file")
    update(options.update, "Large requests", table(head, [row(n, *SIZES[n], options.memory) for n in names]))


if __name__ == "__main__":
    main()
