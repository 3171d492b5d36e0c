"""Density evaluations of a frame, and the time and error of each setting that saves some of them.

    python benchmarks/evaluations.py SCENE.xml [-D KEY=VALUE] [--width 640] [--height 360] [--repeats 7]
    [--compiled FIELD.safetensors]

Each row of the table is the scene with some parameters of the integrator. Errors and speed-ups are relative to the
first row, which marches all occupied cells and each observer ray to its end. With --compiled (repeatable) the rows are
the scene's field and these compiled copies of it, which the value "field" of the scene file names. Times are CPU times
for colour and gaze together, medians over rounds in which all rows take turns.
"""

from __future__ import annotations

import argparse
import statistics
import time
from functools import partial
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

AOVS = "depth,opacity,gaze,visibility"
WHOLE = AOVS + ",observer_depth"
ROWS = (
    # Name, AOVs, parameters of the integrator.
    ("cells, whole rays", WHOLE, {"refined": False}),
    ("cells", AOVS, {"refined": False}),
    ("parts, whole rays", WHOLE, {}),
    ("parts (default)", AOVS, {}),
    ("parts, stop 1e-4", AOVS, {"stop": 1e-4}),
    ("parts, stop 1e-3", AOVS, {"stop": 1e-3}),
    ("parts, color_cutoff 1e-2", AOVS, {"color_cutoff": 1e-2}),
    ("parts, dt_gamma 1/256", AOVS, {"dt_gamma": 1 / 256}),
    ("parts, map of the observer", AOVS, {"visibility": "map"}),
)
HEAD = (
    "variant",
    "density evaluations",
    "colour evaluations",
    "CPU time, µs",
    "speed-up",
    "PSNR, dB",
    "depth MAE, mm",
    "depth error, 99.9 % quantile, mm",
    "gaze MAE",
)
COMPILED_HEAD = (*HEAD, "depth error, median, mm", "visibility differs by over 0.5, % of pixels")


def main(argv=None) -> None:
    from timing import save_result

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.evaluation.study_subject import load_subject

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="Scene file with the integrator nerg.")
    parser.add_argument(
        "-D",
        "--define",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="Value of a parameter of the scene file; can be repeated. Default: the values in the file.",
    )
    parser.add_argument("--width", type=int, default=640, help="Width of the image in pixels. Default: %(default)s.")
    parser.add_argument("--height", type=int, default=360, help="Height of the image in pixels. Default: %(default)s.")
    parser.add_argument(
        "--repeats", type=int, default=7, help="Number of timed frames of each row. Default: %(default)s."
    )
    parser.add_argument(
        "--compiled", type=Path, action="append", default=[], help="Compiled copy of the scene's field. Default: none."
    )
    args = parser.parse_args(argv)
    defaults = dict(word.split("=", 1) for word in args.define)
    load = lambda **values: load_subject(args.scene, args.width, args.height, {**defaults, **values})
    subject = load()
    settings = [(subject, *row) for row in ROWS]
    if args.compiled:
        fields = {"field": subject, **{path.stem: load(field=str(path.absolute())) for path in args.compiled}}
        settings = [(of_field, name, AOVS, {}) for name, of_field in fields.items()]
        settings += [(of_field, f"{name}, map", AOVS, {"visibility": "map"}) for name, of_field in fields.items()]
    pixels = args.width * args.height

    def aovs(names: str) -> str:
        return names if subject.has_gaze else names.replace(",gaze", "")

    made, rows, first = [], [], None
    for of_field, name, wanted, params in settings:
        counts = f"{aovs(wanted)},density_evals,color_evals"
        seen = of_field.render_channels(of_field.make_integrator({**params, "aovs": counts}), 1, 1)
        render = partial(of_field.render, of_field.make_integrator({**params, "aovs": aovs(wanted)}), 1, 1)
        for _ in range(2):  # the second frame uses cached data of the observer, with another kernel
            render()
        made.append(render)
        first = first or seen
        off = np.abs(seen["depth"] - first["depth"])
        square = np.mean((seen["color"] - first["color"]) ** 2)
        rows.append(
            {
                "setting": name,
                "density": float(seen["density_evals"].mean()),
                "colour": float(seen["color_evals"].mean()),
                "db": float(-10 * np.log10(square)) if square > 0 else float("inf"),
                "depth_mae": float(off.mean()),
                "depth_999": float(np.quantile(off, 0.999)),
                "gaze_mae": float(np.abs(seen["gaze"] - first["gaze"]).mean()) if subject.has_gaze else 0.0,
                "depth_median": float(np.median(off)),
                "wrong": float(np.mean(np.abs(seen["visibility"] - first["visibility"]) > 0.5)),
            }
        )
    taken = [[] for _ in made]
    for _ in range(args.repeats):
        for render, times in zip(made, taken):
            started = time.process_time()
            render()
            times.append(time.process_time() - started)
    for row, times in zip(rows, taken):
        row["us"] = 1e6 * statistics.median(times) / pixels
    shown = [
        [
            r["setting"],
            f"{r['density']:.2f}",
            f"{r['colour']:.2f}",
            f"{r['us']:.2f}",
            f"{rows[0]['us'] / r['us']:.2f}",
            f"{r['db']:.1f}",
            f"{1e3 * r['depth_mae']:.4f}",
            f"{1e3 * r['depth_999']:.3f}",
            f"{r['gaze_mae']:.1e}",
            *([f"{1e3 * r['depth_median']:.2f}", f"{100 * r['wrong']:.2f}"] if args.compiled else ()),
        ]
        for r in rows
    ]
    name, head = ("compiled-fields", COMPILED_HEAD) if args.compiled else ("evaluations", HEAD)
    save_result(name, head, shown, "1")


if __name__ == "__main__":
    main()
