"""From settings to rows: errors, evaluations, memory, and times taken in rounds over all settings.

Time is the median of several renders of a finished kernel; the rounds go over all settings in turn, so that a busy
moment of the machine falls on all of them alike. Evaluations are counted in a render of their own, since counting costs
time.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable

import numpy as np

from . import paper as study_paper
from .errors import NAMES, errors
from .parameters import extent, parameters
from .reference import Truth
from .settings import Setting

COLUMNS = (
    "setting",
    "group",
    "seconds",
    "cpu_seconds",
    "density_evals",
    "color_evals",
    "gaze_evals",
    *NAMES,
    "peak_mb",
    "pareto",
    "reference",
    "quadrature",
    "step",
    "steps",
    "coarse",
    "dt_gamma",
    "stop",
    "extent",
    "color_cutoff",
    "refined",
    "depth",
    "visibility",
    "map_height",
    "integral_tolerance",
    "jitter",
    "radiance",
    "aovs",
    "spp",
    "resolution",
    "precision",
)
MARCHING = ("quadrature", "step", "coarse", "dt_gamma", "stop", "color_cutoff", "refined", "depth", "jitter")
"""The parameters that mean nothing where nothing is marched."""
OF_HITS = ("stop", "depth")
"""Those of them that mean something where Gaussians are met."""
COUNTS = ("density_evals", "color_evals", "gaze_evals")
SEED = 1
# Samples a pixel of the picture that settings with several are compared with.
PIXEL_SPP = 256


def measure(
    subject,
    rows: list[Setting],
    repeats: int,
    pixel_spp: int = PIXEL_SPP,
    on_step: Callable[[str], None] = lambda name: None,
) -> list[dict]:
    """One dict of `COLUMNS` a setting (but ``pareto``); ``on_step`` is told what is measured, ``2 len(rows)`` times."""
    pixels: dict = {}
    # Ray casts at a scene's exact geometry may take a minute, and are the same for all rows.
    exact = subject.exact(SEED)
    table, made = [], []
    for row in rows:
        on_step(row.name)
        integrator = row.integrator(subject)
        values = _parameters(subject, row, subject.integrator(row.params, row.resolution))
        table.append(
            values | _quality(subject, row, integrator, values, exact, pixels, pixel_spp) | _counts(subject, row)
        )
        made.append(integrator)
    times = _times(subject, rows, made, repeats, on_step)
    for line, (wall, cpu) in zip(table, times):
        line["seconds"], line["cpu_seconds"] = statistics.median(wall), statistics.median(cpu)
    return table


def _parameters(subject, row: Setting, integrator) -> dict:
    values = parameters(integrator)
    if row.paper is not None:
        steps, dt_gamma = row.paper
        values |= {
            "quadrature": "paper",
            "step": subject.extent / steps,
            "dt_gamma": dt_gamma,
            "stop": study_paper.STOP,
        }
        values |= {"color_cutoff": 0.0, "coarse": 1.0, "jitter": False, "depth": "unnormalised", "refined": False}
    if values["visibility"] != "map":
        values["map_height"] = ""
    if not subject.marched:
        values |= dict.fromkeys(MARCHING, "")
    if subject.hits:
        values |= dict.fromkeys((n for n in MARCHING if n not in OF_HITS), "") | {"extent": extent(integrator)}
    return {n: values[n] for n in values if n in COLUMNS} | {
        "setting": row.name,
        "group": row.group,
        "steps": subject.extent / values["step"] if subject.marched and not subject.hits else "",
        "aovs": ",".join(integrator.aovs),
        "spp": row.spp,
        "resolution": row.resolution or "",
        "precision": precision(),
    }


def _quality(subject, row: Setting, integrator, values: dict, exact, pixels: dict, pixel_spp: int) -> dict:
    import drjit as dr

    backend = dr.JitBackend.CUDA if _on_cuda() else dr.JitBackend.LLVM
    gc.collect()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    # What other rows keep (their maps, say) is not this one's.
    before = dr.detail.malloc_watermark(backend)
    picture = subject.channels(integrator, row.spp, SEED)
    peak = dr.detail.malloc_watermark(backend) - before
    if row.spp > 1:
        if not pixels:
            pixels["truth"] = _pixel_truth(subject, pixel_spp)
        known, exact = pixels["truth"], None
    else:
        # Unnormalised depths are meant to be expected ones.
        depth = "expected" if row.paper is not None else values["depth"]
        known = subject.truth(SEED, depth, values["visibility"])
    return errors(picture, known, exact) | {"peak_mb": peak / 2**20, "reference": known.source}


def _pixel_truth(subject, spp: int) -> Truth:
    """The mean over many samples of each pixel, at the scene's own setting, with another seed."""
    seen = subject.channels(subject.integrator(), spp, SEED + 1)
    none = np.zeros(len(seen["depth"]))
    return Truth(
        **{n: seen[n] for n in ("color", "opacity", "depth", "visibility")},
        gaze=seen.get("gaze", none),
        source=f"mean of {spp} samples a pixel",
        convergence={},
    )


def _counts(subject, row: Setting) -> dict:
    """Mean evaluations a pixel. The count keeps what the setting asks for, so that the same passes are made."""
    names = row.params.get("aovs", subject.aovs()).split(",")
    counted = [n for n in COUNTS if n != "gaze_evals" or "gaze" in names]
    seen = subject.channels(row.integrator(subject, aovs=",".join([*names, *counted])), 1, SEED)
    return {n: row.spp * float(seen[n].mean()) if n in counted else 0.0 for n in COUNTS}


def _times(subject, rows, made, repeats: int, on_step) -> list[tuple[list[float], list[float]]]:
    taken = [([], []) for _ in rows]
    for k in range(repeats):
        for row, integrator, (wall, cpu) in zip(rows, made, taken):
            if k == 0:
                on_step(f"time of {row.name}")
            if row.first_frame:
                integrator.parameters_changed()
            seconds, busy = timed(subject, integrator, row.spp)
            wall.append(seconds)
            cpu.append(busy)
    return taken


def timed(subject, integrator, spp: int = 1) -> tuple[float, float]:
    """Wall-clock and processor seconds of one render."""
    start, busy = time.perf_counter(), time.process_time()
    subject.render(integrator, spp, SEED)
    return time.perf_counter() - start, time.process_time() - busy


def precision() -> str:
    """Of the variant in use: networks are fp16 on CUDA, where matrix units need it; everything else is fp32
    everywhere."""
    return "fp32, networks fp16" if _on_cuda() else "fp32"


def _on_cuda() -> bool:
    import mitsuba as mi

    return str(mi.variant()).startswith("cuda")


# ----------------------------------------------------------------------------
# Cost against size
# ----------------------------------------------------------------------------


def scaling(
    subject, repeats: int, quick: bool = False, on_step: Callable[[str], None] = lambda name: None
) -> list[dict]:
    """Cost of the default against pixels, samples a pixel, and the scene's extent: rows of ``axis``, ``value``,
    ``seconds``, ``density_evals`` (mean a pixel).

    A scene s times as large, marched with steps of the same length, is by the scaling law of densities (σ/s) this scene
    marched with steps s times shorter: that is how its extent is varied.
    """
    size = subject.size
    plan = [("pixels", k, {}) for k in ((16, 32) if quick else (16, 32, 64, 128, 256, 512))]
    plan += [("samples", k, {}) for k in ((1, 2) if quick else (1, 2, 4, 8, 16, 32))]
    if subject.marched and not subject.hits:
        plan += [("extent", k, {"step": subject.step / k}) for k in ((1, 2) if quick else (1, 2, 4, 8, 16))]
    out = []
    for axis, value, params in plan:
        on_step(f"{axis} {value}")
        if axis == "pixels":
            subject.resize(value, 2 * value // 3)
        setting = Setting("", axis, params, spp=value if axis == "samples" else 1)
        integrator = setting.integrator(subject)
        timed(subject, integrator, setting.spp)
        seconds = statistics.median(timed(subject, integrator, setting.spp)[0] for _ in range(repeats))
        counts = _counts(subject, setting)
        amount = value * (2 * value // 3) if axis == "pixels" else value
        out.append({"axis": axis, "value": amount, "seconds": seconds, "density_evals": counts["density_evals"]})
        if axis == "pixels":
            subject.resize(*size)
    return out
