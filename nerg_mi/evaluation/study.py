"""A study of error against run time: its settings, its operations, the paper's march, and the measurement."""

from __future__ import annotations

import functools
import gc
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, cast

import drjit as dr
import numpy as np

from nerg_mi.maths.color import composite_to_linear
from nerg_mi.transport import observer
from nerg_mi.transport.depth import DEPTHS
from nerg_mi.transport.field_medium import make_color_shader
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.observer import visibility
from nerg_mi.transport.quadrature import RULES

from . import study_truth
from .study_subject import read_splat_extent, read_parameters
from .study_truth import ERROR_NAMES, StudyTruth, compute_errors

# ---- How much work a render is, counted: operations traced into its kernels, and evaluations made ----


def count_traced_operations(render) -> int:
    """Operations of all kernels that the call ``render()`` launches.

    Dr.Jit counts the instructions of its intermediate representation, loops counted once: what is not traced
    is not counted, and a count does not depend on the machine or on how busy it is.
    """
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        dr.eval(render())
        dr.sync_thread()
        return sum(kernel.get("operation_count", 0) for kernel in dr.kernel_history())


# ---- Paper ----
#
# The marching of the paper's code, for comparison: an implementation of its rule apart from ``transport``.
#
# As the inference kernels of torch-ngp do it, on which the paper's code rests: at most ``steps`` samples a ray; step
# dt = clamp(t·γ, diagonal/steps, diagonal/128); density and colour sampled at the step's start; α = 1 - exp(-σ dt),
# w = αT; a cell of the occupancy grid that is empty is left in multiples of dt; the march ends where T < 1e-4. Depth is
# Σ w_i t_i with t_i the *end* of step i, and is not divided by the opacity Σ w_i. Every sample gets a colour. The
# observer's ray towards p_d is marched likewise, and its depth compared with the distance.
#
# Not taken over, because they would only make it worse here: fp16 networks, the near distance of 0.2, cascades, a
# comparison tolerance of 1e-5 (ours is the study's), gaze without a surface, and a sign of the shadow that shows what
# is hidden. A normalised gaze field is divided by the integral that ``nerg`` finds: the paper has none.

PAPER_STEPS = 1024
PAPER_DT_GAMMA = 1 / 128  # The step growth that the paper's code has by default for scenes larger than its unit cube
PAPER_STOP = 1e-4


def make_paper_integrator(integrator, sensor, tolerance: float, steps: int = PAPER_STEPS, dt_gamma: float = 0.0):
    """An integrator with the field, gaze, observer and AOVs of ``integrator`` (a ``nerg``) that marches by the paper's
    rule.

    ``sensor``: the camera, which is the observer where there is no other; ``tolerance`` of visibility in scene units;
    ``steps``: to the medium's diagonal, and most samples a ray; ``dt_gamma``: growth γ of steps with distance. Its AOVs
    are depth, opacity, visibility, gaze and the three counts.
    """
    import mitsuba as mi

    return _integrator_class(mi.variant())(integrator, sensor, tolerance, steps, dt_gamma)


@functools.cache
def _integrator_class(variant: str):
    """The class for a variant; Mitsuba's must not be derived from when this module is imported."""
    import mitsuba as mi

    class PaperIntegrator(mi.SamplingIntegrator):
        def __init__(self, like, sensor, tolerance, steps, dt_gamma):
            super().__init__(mi.Properties())
            self._like, self._sensor, self._tolerance = like, sensor, tolerance
            extent = like.medium.length_scale
            self._march = functools.partial(
                march_as_in_paper,
                like.medium,
                steps=steps,
                min_step=extent / steps,
                max_step=max(extent / 128, extent / steps),
                dt_gamma=dt_gamma,
            )

        def aov_names(self):
            return self._like.aov_names()

        def sample(self, scene, sampler, ray, medium=None, active=True):
            like, names = self._like, self._like.aovs
            painter, active = None, mi.Bool(active)
            if like.radiance and like.medium.has_color:
                spectral = like.medium.color_space == "spectrum"
                painter = make_color_shader(like.medium, mi.Spectrum if spectral else mi.Color3f)
            local = like.medium.ray_to_local(ray.o, ray.d)
            t0, t1 = dr.maximum(local.t_near, 0), dr.minimum(local.t_far, ray.maxt)
            alpha, depth, total, n = self._march(local, t0, t1, active, painter)
            surface = alpha >= like.observer_settings.surface_opacity
            out = {
                "depth": depth,
                "opacity": alpha,
                "density_evals": n,
                "color_evals": mi.Float(0) if painter is None else n,
            }
            if painter is not None and like.medium.is_deferred:
                out["color_evals"] = dr.select(alpha > 0, mi.Float(1), 0)
            if {"visibility", "gaze"} & set(names):
                out["density_evals"] = n + self._look(ray.o + ray.d * depth, surface, out, "gaze" in names)
            L = mi.Spectrum(0)
            if like.radiance:
                L = (1 - alpha) * like.background
                if painter is not None:
                    color = painter.resolve_color(like.medium, total, alpha, local, cast("Any", active))
                    L += composite_to_linear(color, alpha, like.medium.color_space)
            return L, alpha > 0, [out[name] for name in names]

        def _look(self, p_d, surface, out, gaze):
            """Visibility, gaze and their count into ``out``; returns the density evaluations made."""
            like = self._like
            p_o = observer.sensor_center(self._sensor if like.observer is None else like.observer)
            distance = dr.norm(p_d - p_o)
            r_o = (p_d - p_o) / (distance + 1e-6)
            local = like.medium.ray_to_local(p_o, r_o)
            alpha, depth, _, n = self._march(local, dr.maximum(local.t_near, 0), local.t_far, surface, None)
            d_o = dr.select(alpha >= like.observer_settings.surface_opacity, depth, distance)
            seen = dr.select(surface, visibility(distance, d_o, like.falloff, self._tolerance), 0)
            out["visibility"] = seen
            if gaze:
                place, attended = SceneGeometry(like.medium), surface & (seen > 0)
                observed = like.gaze.for_observers([p_o], place, like.observer_settings, like.cache)
                density = observed.evaluate(p_o + r_o * d_o, p_o, r_o, attended)[0]
                out["gaze"] = dr.select(attended, density * seen, 0)
                out["gaze_evals"] = dr.select(surface, mi.Float(like.gaze.field.networks), 0.0)
            return n

    return PaperIntegrator


def march_as_in_paper(medium, ray, t0, t1, active, shader, *, steps, min_step, max_step, dt_gamma):
    """``(opacity, depth, sum of what samples contribute, samples)`` of ``ray`` (`LocalRay`) between ``t0`` and ``t1``.

    ``painter``: what samples contribute (``medium.Painter``), or None for a density-only pass.
    """
    Float = type(ray.t_near)
    # The paper's grid knows no parts of cells.
    grid: Any = None if medium.occupancy is None else medium.occupancy.coarse

    def length(t):
        return dr.clip(t * dt_gamma, min_step, max_step)

    def leave(seeking, t):
        """Out of an empty cell in whole steps, at least one."""
        u, v = medium.to_unit(ray.o + ray.d * t), medium.vector_to_unit(ray.d)
        empty = seeking & (grid.distance_to_occupied(u, seeking) > 0)
        gap = Float(dr.inf)
        for uc, vc, cells in zip((u.x, u.y, u.z), (v.x, v.y, v.z), grid.cells):
            wall = dr.floor(uc * cells) + dr.select(vc > 0, 1, 0) - uc * cells
            gap = dr.minimum(gap, dr.select(vc != 0, wall / dr.select(vc != 0, vc * cells, 1), dr.inf))
        dt = length(t)
        t = dr.select(empty, t + dt * dr.maximum(dr.ceil(gap / dt), 1), t)
        return empty & (t < t1), t

    def body(active, t, transmittance, moment, total, n):
        if grid is not None:
            _, t = dr.while_loop((active, t), lambda seeking, *_: seeking, leave, label="paper leap")
        full = active & (t < t1)
        dt = length(t)
        p = ray.o + ray.d * t
        if shader is None:
            sigma, features = medium.density(p, full), None
        else:
            sigma, features = medium.density_features(p, full)
        weight = dr.select(full, (1 - dr.exp(-sigma * dt)) * transmittance, 0)
        moment = moment + weight * (t + dt)
        if shader is not None:
            total = total + weight * shader.paint(medium, features, p, ray.w, full)
        # The kernels test the transmittance in front of the sample, so that one more is taken.
        more = transmittance >= PAPER_STOP
        transmittance, n = transmittance - weight, n + dr.select(full, 1, 0)
        t = t + dt
        return full & (t < t1) & more & (n < steps), t, transmittance, moment, total, n

    start = (
        dr.mask_t(Float)(active) & (t0 < t1),
        Float(t0),
        Float(1),
        Float(0),
        None if shader is None else shader.zero(),
        Float(0),
    )
    _, _, transmittance, moment, total, n = dr.while_loop(start, lambda active, *_: active, body, label="paper march")
    return 1 - transmittance, moment, total, n


# ---- Settings ----
#
# Which settings a study renders: sweeps of one factor around the scene's own, steps x quadrature, the paper's marching.

STEP_COUNTS = (16, 32, 64, 128, 256, 512, 1024, 2048, 4096)
RESOLUTIONS = (16, 32, 64, 128)
PAPER = "paper"


@dataclass(frozen=True)
class StudyRow:
    """One row of a study."""

    name: str  # As the tables have it
    group: str  # The factor that it belongs to
    params: Mapping = field(default_factory=dict)  # Of the integrator, over the scene's own
    spp: int = 1  # Samples a pixel
    resolution: int = 0  # Of the density as a grid; 0: the scene's own
    paper: tuple[int, float] | None = None  # (steps, γ) of the paper's marching; None: ours
    is_first_frame: bool = False  # What is kept from frame to frame is made anew in each

    def make_integrator(self, subject, **more):
        """The integrator that renders this row; ``more``: further parameters, such as AOVs that count."""
        made = subject.make_integrator({**self.params, **more}, self.resolution)
        return made if self.paper is None else make_paper_integrator(made, subject.sensor, subject.tolerance, *self.paper)


def list_rows(subject, quick: bool = False) -> list[StudyRow]:
    """All rows for ``subject``; ``quick``: one or two of each factor."""

    if not subject.is_marched:
        return [StudyRow("default", "default"), *_observer(subject, quick), *_left_out(subject), *_samples(quick)]

    def some(values):
        return values[:: max(len(values) - 1, 1)] if quick else values

    if subject.has_splats:
        return [*_met(some), *_observer(subject, quick), *_left_out(subject), *_samples(quick)]

    def steps(n):
        return {"step": subject.extent / n}

    rows = [StudyRow("default", "default")]
    for rule in (r.name for r in RULES if not r.ends_at_cells):
        for n in (64, 512) if quick else STEP_COUNTS:
            rows.append(StudyRow(f"{rule}, {n} steps", f"steps, {rule}", {"quadrature": rule, **steps(n)}))
    for g in some((1 / 1024, 1 / 512, 1 / 256, 1 / 128)):
        rows.append(StudyRow(f"dt_gamma 1/{round(1 / g)}", "dt_gamma", {"dt_gamma": g}))
    sweeps = {
        "coarse": (2.0, 4.0, 8.0, 16.0),
        "stop": (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8),
        "color_cutoff": (0.0, 1e-4, 1e-3, 3e-3, 1e-2, 3e-2),
    }
    rows += [StudyRow(f"{name} {v:g}", name, {name: v}) for name, values in sweeps.items() for v in some(values)]
    for k in DEPTHS.names():
        rows.append(StudyRow(f"depth {k}", "depth", {"depth": k}))
        for n in () if quick else (128, 256, 512, 1024):
            rows.append(StudyRow(f"depth {k}, {n} steps", "depth", {"depth": k, **steps(n)}))
    rows.append(StudyRow("unrefined", "refined", {"refined": False}))
    rows.append(StudyRow("jitter", "jitter", {"jitter": True}))
    rows += _observer(subject, quick) + _left_out(subject) + _samples(quick)
    if subject.can_resample:
        for r in RESOLUTIONS[:1] if quick else RESOLUTIONS:
            for rule in RULES.names():
                rows.append(StudyRow(f"grid {r}, {rule}", "resolution", {"quadrature": rule}, resolution=r))
        for n in () if quick else (16, 64, 256):
            for rule in RULES.names():
                rows.append(
                    StudyRow(
                        f"grid 64, {rule}, {n} steps", "resolution", {"quadrature": rule, **steps(n)}, resolution=64
                    )
                )
    rows += [] if quick else _together(subject)
    return rows + _paper(quick)


def _met(some) -> list[StudyRow]:
    """Of Gaussian splats, which are met one by one and not marched."""
    rows = [StudyRow("default", "default")]
    rows += [StudyRow(f"stop {s:g}", "stop", {"stop": s}) for s in some(study_truth.SPLAT_STOPS)]
    rows += [StudyRow(f"extent {e:g}", "extent", {"extent": e}) for e in some(study_truth.SPLAT_EXTENTS)]
    # What finds the depth of another kind, finds the same here.
    rows += [StudyRow(f"depth {d.name}", "depth", {"depth": d.name}) for d in DEPTHS if d.surface_kind == d.name]
    loose = [(2.0, 1e-2), (2.5, 1e-2), (2.5, 1e-3)]
    return rows + [StudyRow(f"extent {e:g}, stop {s:g}", "together", {"extent": e, "stop": s}) for e, s in some(loose)]


def _visibility(quick: bool) -> list[StudyRow]:
    rows = [StudyRow(f"visibility {k}", "visibility", {"visibility": k}) for k in ("depth", "transmittance")]
    for h in (16,) if quick else (64, 128, 256, 512, 1024):
        params = {"visibility": "map", "map_height": h}
        rows.append(StudyRow(f"visibility map {h}", "visibility", params))
        rows.append(StudyRow(f"visibility map {h}, first frame", "visibility", params, is_first_frame=True))
    return rows


def _observer(subject, quick: bool) -> list[StudyRow]:
    """What is found out for each observer: visibility, and the integral of a gaze that is divided by one."""
    if not subject.is_normalized:
        return _visibility(quick)
    return _visibility(quick) + [
        StudyRow(f"integral_tolerance {t:g}, first frame", "integral", {"integral_tolerance": t}, is_first_frame=True)
        for t in ((0.0, 5e-3) if quick else (0.0, 3.125e-4, 1.25e-3, 5e-3, 2e-2))
    ]


def _samples(quick: bool) -> list[StudyRow]:
    return [StudyRow(f"spp {k}", "spp", spp=k) for k in ((2,) if quick else (4, 16, 64))]


def _left_out(subject) -> list[StudyRow]:
    """What a scene does not need, taken away piece by piece."""
    rows = [
        StudyRow("no colour", "leave out", {"radiance": False}),
        StudyRow("no observer", "leave out", {"aovs": "depth,opacity"}),
        StudyRow("depth only", "leave out", {"aovs": "depth,opacity", "radiance": False}),
    ]
    if subject.has_gaze:
        rows.insert(1, StudyRow("no gaze", "leave out", {"aovs": "depth,opacity,visibility"}))
    return rows


def _together(subject) -> list[StudyRow]:
    """Several factors at once, to find the front."""
    rows = []
    for n in (128, 256, 512, 1024, 2048):
        step = {"step": subject.extent / n}
        rows.append(StudyRow(f"{n} steps, coarse 4", "together", {**step, "coarse": 4.0}))
        loose = {**step, "stop": 1e-4, "color_cutoff": 1e-2}
        for name, more in (("", {}), (", linear", {"quadrature": "linear"}), (", refined", {"depth": "refined"})):
            rows.append(StudyRow(f"{n} steps, stop 1e-4, cutoff 1e-2{name}", "together", {**loose, **more}))
    return rows


def _paper(quick: bool) -> list[StudyRow]:
    counts = (64, PAPER_STEPS) if quick else (128, 256, 512, PAPER_STEPS, 2048, 4096)
    # The rule is one of depth comparison and of expected depth, whatever the scene prefers.
    params = {"depth": "expected", "visibility": "depth"}
    rows = [StudyRow(f"paper, {n} steps", PAPER, params, paper=(n, 0.0)) for n in counts]
    return rows + [StudyRow(f"paper, {PAPER_STEPS} steps, dt_gamma 1/128", PAPER, params, paper=(PAPER_STEPS, PAPER_DT_GAMMA))]


# ---- Measure ----
#
# From settings to rows: errors, evaluations, memory, and times taken in rounds over all settings.
#
# Time is the median of several renders of a finished kernel; the rounds go over all settings in turn, so that a busy
# moment of the machine falls on all of them alike. Evaluations are counted in a render of their own, since counting
# costs time.

COLUMNS = (
    *"setting group seconds cpu_seconds density_evals color_evals gaze_evals".split(),
    *ERROR_NAMES,
    *"""
        peak_mb pareto reference quadrature step steps coarse dt_gamma stop extent color_cutoff refined
        depth visibility map_height integral_tolerance jitter radiance aovs spp resolution precision
    """.split(),
)
MARCH_PARAMETERS = ("quadrature", "step", "coarse", "dt_gamma", "stop", "color_cutoff", "refined", "depth", "jitter")
"""The parameters that mean nothing where nothing is marched."""
SPLAT_PARAMETERS = ("stop", "depth")  # Those of them that mean something where Gaussians are met
COUNTS = ("density_evals", "color_evals", "gaze_evals")
SEED = 1
PIXEL_SPP = 256  # Samples a pixel of the picture that settings with several are compared with


def measure_rows(
    subject,
    rows: list[StudyRow],
    repeats: int,
    pixel_spp: int = PIXEL_SPP,
    on_step: Callable[[str], None] = lambda name: None,
) -> list[dict]:
    """One dict of `COLUMNS` a setting (but ``pareto``); ``on_step`` is told what is measured, ``2 len(rows)`` times."""
    pixels: dict = {}
    # Ray casts at a scene's exact geometry may take a minute, and are the same for all rows.
    exact = subject.find_exact_hits(SEED)
    table, made = [], []
    for row in rows:
        on_step(row.name)
        integrator = row.make_integrator(subject)
        values = _parameters(subject, row, subject.make_integrator(row.params, row.resolution))
        table.append(
            values | _quality(subject, row, integrator, values, exact, pixels, pixel_spp) | _counts(subject, row)
        )
        made.append(integrator)
    times = _times(subject, rows, made, repeats, on_step)
    for line, (wall, cpu) in zip(table, times):
        line["seconds"], line["cpu_seconds"] = statistics.median(wall), statistics.median(cpu)
    return table


def _parameters(subject, row: StudyRow, integrator) -> dict:
    values = read_parameters(integrator)
    if row.paper is not None:
        steps, dt_gamma = row.paper
        values |= {"quadrature": "paper", "step": subject.extent / steps, "dt_gamma": dt_gamma, "stop": PAPER_STOP}
        values |= {"color_cutoff": 0.0, "coarse": 1.0, "jitter": False, "depth": "unnormalised", "refined": False}
    if values["visibility"] != "map":
        values["map_height"] = ""
    if not subject.is_marched:
        values |= dict.fromkeys(MARCH_PARAMETERS, "")
    if subject.has_splats:
        values |= dict.fromkeys((n for n in MARCH_PARAMETERS if n not in SPLAT_PARAMETERS), "") | {"extent": read_splat_extent(integrator)}
    return {n: values[n] for n in values if n in COLUMNS} | {
        "setting": row.name,
        "group": row.group,
        "steps": subject.extent / values["step"] if subject.is_marched and not subject.has_splats else "",
        "aovs": ",".join(integrator.aovs),
        "spp": row.spp,
        "resolution": row.resolution or "",
        "precision": describe_precision(),
    }


def _quality(subject, row: StudyRow, integrator, values: dict, exact, pixels: dict, pixel_spp: int) -> dict:
    import drjit as dr

    backend = dr.JitBackend.CUDA if _on_cuda() else dr.JitBackend.LLVM
    gc.collect()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    # What other rows keep (their maps, say) is not this one's.
    before = dr.detail.malloc_watermark(backend)
    picture = subject.render_channels(integrator, row.spp, SEED)
    peak = dr.detail.malloc_watermark(backend) - before
    if row.spp > 1:
        if not pixels:
            pixels["truth"] = _pixel_truth(subject, pixel_spp)
        known, exact = pixels["truth"], None
    else:
        # Unnormalised depths are meant to be expected ones.
        depth = "expected" if row.paper is not None else values["depth"]
        known = subject.get_truth(SEED, depth, values["visibility"])
    return compute_errors(picture, known, exact) | {"peak_mb": peak / 2**20, "reference": known.source}


def _pixel_truth(subject, spp: int) -> StudyTruth:
    """The mean over many samples of each pixel, at the scene's own setting, with another seed."""
    seen = subject.render_channels(subject.make_integrator(), spp, SEED + 1)
    none = np.zeros(len(seen["depth"]))
    return StudyTruth(
        **{n: seen[n] for n in ("color", "opacity", "depth", "visibility")},
        gaze=seen.get("gaze", none),
        source=f"mean of {spp} samples a pixel",
        convergence={},
    )


def _counts(subject, row: StudyRow) -> dict:
    """Mean evaluations a pixel. The count keeps what the setting asks for, so that the same passes are made."""
    names = row.params.get("aovs", subject.aov_names()).split(",")
    counted = [n for n in COUNTS if n != "gaze_evals" or "gaze" in names]
    seen = subject.render_channels(row.make_integrator(subject, aovs=",".join([*names, *counted])), 1, SEED)
    return {n: row.spp * float(seen[n].mean()) if n in counted else 0.0 for n in COUNTS}


def _times(subject, rows, made, repeats: int, on_step) -> list[tuple[list[float], list[float]]]:
    taken = [([], []) for _ in rows]
    for row, integrator in zip(rows, made):
        # The first frame was one of quality; the next reads what that kept of the observer, and is another kernel.
        if not row.is_first_frame:
            subject.render(integrator, row.spp, SEED)
    for k in range(repeats):
        for row, integrator, (wall, cpu) in zip(rows, made, taken):
            if k == 0:
                on_step(f"time of {row.name}")
            if row.is_first_frame:
                integrator.parameters_changed()
            seconds, busy = time_render(subject, integrator, row.spp)
            wall.append(seconds)
            cpu.append(busy)
    return taken


def time_render(subject, integrator, spp: int = 1) -> tuple[float, float]:
    """Wall-clock and processor seconds of one render."""
    start, busy = time.perf_counter(), time.process_time()
    subject.render(integrator, spp, SEED)
    return time.perf_counter() - start, time.process_time() - busy


def describe_precision() -> str:
    """Of the variant in use: networks are fp16 on CUDA, where matrix units need it; all else is fp32."""
    return "fp32, networks fp16" if _on_cuda() else "fp32"


def _on_cuda() -> bool:
    import mitsuba as mi

    return str(mi.variant()).startswith("cuda")


# ---- Cost against size ----


def measure_scaling(
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
    if subject.is_marched and not subject.has_splats:
        plan += [("extent", k, {"step": subject.step / k}) for k in ((1, 2) if quick else (1, 2, 4, 8, 16))]
    out = []
    for axis, value, params in plan:
        on_step(f"{axis} {value}")
        if axis == "pixels":
            subject.resize(value, 2 * value // 3)
        setting = StudyRow("", axis, params, spp=value if axis == "samples" else 1)
        integrator = setting.make_integrator(subject)
        for _ in range(2):  # the second frame reads what the first keeps of the observer, and is another kernel
            subject.render(integrator, setting.spp, SEED)
        seconds = statistics.median(time_render(subject, integrator, setting.spp)[0] for _ in range(repeats))
        counts = _counts(subject, setting)
        amount = value * (2 * value // 3) if axis == "pixels" else value
        out.append({"axis": axis, "value": amount, "seconds": seconds, "density_evals": counts["density_evals"]})
        if axis == "pixels":
            subject.resize(*size)
    return out
