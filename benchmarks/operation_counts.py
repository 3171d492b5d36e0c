"""Cost of each part of an image of the store: traced operations, evaluations, seconds.

    python benchmarks/operation_counts.py [--width 240] [--runs 5]

Saves the result `operations`. The counts do
not depend on the machine. CPU times are medians over several runs, and only their ratios are meaningful.
"""

from __future__ import annotations

import argparse
import statistics
import time
from functools import partial
from pathlib import Path

import nerg_mi.scenes.store
from nerg_mi.evaluation.study import count_traced_operations
from timing import save_result

import mitsuba as mi

STORE = Path(nerg_mi.scenes.store.__file__).parent
CAMERA, OBSERVER, TARGET = [1.0, 0.8, 1.6], [1.0, 2.8, 1.6], [1.2, 5.0, 1.2]

# The store's twin, unlit, and a box in the aisle.
SHAPES = {"field": None, "shapes": {"store": {"type": "ply", "filename": str(STORE / "twin.ply")}}}
BOX = {"box": {"type": "cube", "to_world": mi.scalar_rgb.Transform4f().translate([1.2, 4, 0.6]).scale(0.3)}}


def look_at(origin):
    return mi.ScalarTransform4f().look_at(origin, TARGET, [0, 0, 1])


def configurations() -> dict[str, dict]:
    """Name of each configuration and its additions to a bare integrator."""
    moved = {"observer": {"type": "perspective", "to_world": look_at(OBSERVER)}}
    local = {"observer": {"type": "perspective", "to_world": look_at(CAMERA)}}
    dark = {"radiance": False}
    return {
        "nothing": dark | {"aovs": ""},
        "depth": dark | {"aovs": "depth,opacity"},
        "expected depth": dark | {"aovs": "depth,opacity", "depth": "expected"},
        "colour, depth": {"aovs": "depth,opacity"},
        "gaze given, not asked for": {"aovs": "depth,opacity"} | moved,
        "gaze, camera is the observer": {"aovs": "depth,opacity,gaze"},
        "gaze, observer at the camera": {"aovs": "depth,opacity,gaze"} | local,
        "gaze, observer elsewhere": {"aovs": "depth,opacity,gaze"} | moved,
        "... without occlusion": {"aovs": "depth,opacity,gaze", "occlusion": False} | moved,
        "... by transmittance": {"aovs": "depth,opacity,gaze", "visibility": "transmittance"} | moved,
        "... by a map, first frame": {"aovs": "depth,opacity,gaze", "visibility": "map"} | moved,
        "... by a map, next frames": {"aovs": "depth,opacity,gaze", "visibility": "map"} | moved,
        "shapes in place of the field: depth": dark | {"aovs": "depth,opacity"} | SHAPES,
        "... gaze, observer elsewhere": dark | {"aovs": "depth,opacity,gaze"} | moved | SHAPES,
        "... albedo, depth": {"aovs": "depth,opacity"} | SHAPES,
        "field and a shape: depth": dark | {"aovs": "depth,opacity", "shapes": BOX},
        "... gaze, observer elsewhere ": dark | {"aovs": "depth,opacity,gaze", "shapes": BOX} | moved,
    }


def scene(width: int, options: dict):
    integrator = {
        "type": "nerg",
        "field": {"type": "nerf", "filename": str(STORE / "store.safetensors")},
        "gaze": {"type": "gazefield", "filename": str(STORE / "shoppers.safetensors")},
        **options,
    }
    shapes = integrator.pop("shapes", {})
    integrator = {k: v for k, v in integrator.items() if v is not None}
    film = {
        "type": "hdrfilm",
        "width": width,
        "height": width * 3 // 4,
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    sensor = {"type": "perspective", "fov": 75, "to_world": look_at(CAMERA), "film": film}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **shapes})


def evaluations(width: int, options: dict) -> list[float]:
    """Mean density, colour and gaze evaluations per pixel, counted in a separate rendering."""
    requested = [a for a in options["aovs"].split(",") if a]
    if not requested:
        return [0.0, 0.0, 0.0]
    counts = ["density_evals", "color_evals"] + (["gaze_evals"] if "gaze" in requested else [])
    image = mi.render(scene(width, options | {"aovs": ",".join(requested + counts)}), spp=1).numpy()
    means = image[..., 3 + len(requested) :].mean((0, 1)).tolist()
    return means + [0.0] * (3 - len(means))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=240, help="Width of the image in pixels. Default: %(default)s.")
    parser.add_argument("--runs", type=int, default=5, help="Number of timed frames of each row. Default: %(default)s.")
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb", help="Mitsuba variant. Default: %(default)s.")
    args = parser.parse_args()
    mi.set_variant(args.mode)

    rows = []
    for name, options in configurations().items():
        place = scene(args.width, options)
        if "first" not in name:
            mi.render(place, spp=1).numpy()
        operations = count_traced_operations(partial(mi.render, place, spp=1))
        seconds = []
        for run in range(args.runs):
            if "first" in name:
                place = scene(args.width, options)
            start = time.process_time()
            mi.render(place, spp=1, seed=run).numpy()
            seconds.append(time.process_time() - start)
        rows.append([name, operations, *evaluations(args.width, options), statistics.median(seconds)])

    shown = [
        [name, f"{operations:,}", f"{density:.1f}", f"{color:.1f}", f"{gaze:.2f}", f"{seconds:.3f}"]
        for name, operations, density, color, gaze, seconds in rows
    ]
    head = ("configuration", "traced operations", "density evaluations", "colour evaluations", "gaze evaluations")
    save_result("operations", (*head, "CPU time, s"), shown)


if __name__ == "__main__":
    main()
