"""Study of error against run time: settings, operation counts, the march of the paper, and measurement."""

from __future__ import annotations

import functools
import gc
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import drjit as dr
import numpy as np

from nerg_mi.maths.color import composite_to_linear
from nerg_mi.transport import observer
from nerg_mi.transport.depth import DEPTHS
from nerg_mi.transport.field_medium import make_color_shader
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.march_primal import SEPARATE_COLOR_CUTOFF
from nerg_mi.transport.occlusion import visibility
from nerg_mi.transport.quadrature import RULES

from . import study_truth
from .study_subject import read_parameters, read_splat_extent
from .study_truth import ERROR_NAMES, StudyTruth, compute_errors

# ---- Amount of work of a render: traced operations and evaluations ----


def count_traced_operations(render) -> int:
    """Count the operations of all kernels that ``render()`` launches.

    Dr.Jit counts the instructions of its intermediate representation, loops once. The count does not depend on the
    machine or its load.
    """
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        dr.eval(render())
        dr.sync_thread()
        return sum(kernel.get("operation_count", 0) for kernel in dr.kernel_history())


# ---- Paper ----
#
# The march of the paper's code for comparison, implemented independently of ``transport``.
#
# It follows the inference kernels of torch-ngp, on which the paper's code is based: at most ``steps`` samples per ray;
# step dt = clamp(t·γ, diagonal/steps, diagonal/128); density and colour sampled at the start of the step; α = 1 -
# exp(-σ dt), w = αT; empty cells of the occupancy grid are skipped in multiples of dt; the march ends where T < 1e-4.
# Depth is Σ w_i t_i with t_i the *end* of step i, and is not divided by the opacity Σ w_i. Every sample evaluates the
# colour. The observer ray towards p_d is marched in the same way, and its depth is compared with the distance.
#
# Omitted, because they would only increase the error here: fp16 networks, the near distance of 0.2, cascades, a
# comparison tolerance of 1e-5 (the tolerance of the study is used), gaze without a surface, and the sign of the shadow
# that shows hidden regions. A normalised gaze field is divided by the integral of ``nerg``, because the paper has none.

PAPER_STEPS = 1024
PAPER_DT_GAMMA = 1 / 128  # Default step growth of the paper's code for scenes larger than its unit cube
PAPER_STOP = 1e-4


class PaperMarch(NamedTuple):
    """Settings of the march of the paper, and two corrections of its depth, which its code does not have."""

    steps: int = PAPER_STEPS  # Steps along the diagonal of the medium, and maximum number of samples per ray
    dt_gamma: float = 0.0  # Growth γ of steps with distance
    depth_at: float = 1.0  # Where in a step its depth is taken: 1 at the end, as in the paper, 0.5 in the middle
    divides_by_opacity: bool = False


def make_paper_integrator(integrator, sensor, tolerance: float, march: PaperMarch):
    """Make an integrator that marches as in the paper, with the field, gaze, observer and AOVs of ``integrator`` (a
    ``nerg``).

    Parameters
    ----------
    integrator : NergIntegrator
        Source of the field and settings.
    sensor : mitsuba.Sensor
        Camera, which is the observer if there is no other.
    tolerance : float
        Tolerance of the visibility in scene units.
    march : PaperMarch
        Steps, and corrections of the depth.

    Notes
    -----
    Available AOVs are depth, opacity, visibility, gaze and the three counts.
    """
    import mitsuba as mi

    return _integrator_class(mi.variant())(integrator, sensor, tolerance, march)


@functools.cache
def _integrator_class(variant: str):
    """Return the class for a variant. Mitsuba classes cannot be derived from when this module is imported."""
    import mitsuba as mi

    class PaperIntegrator(mi.SamplingIntegrator):
        def __init__(self, like, sensor, tolerance, settings):
            super().__init__(mi.Properties())
            self._like, self._sensor, self._tolerance = like, sensor, tolerance
            self._march = functools.partial(march_as_in_paper, like.medium, settings=settings)

        def aov_names(self):
            return self._like.aov_names()

        def sample(self, scene, sampler, ray, medium=None, active=True):
            like, names = self._like, self._like.aovs
            shader, active = None, mi.Bool(active)
            if like.radiance and like.medium.has_color:
                spectral = like.medium.color_space == "spectrum"
                shader = make_color_shader(like.medium, mi.Spectrum if spectral else mi.Color3f)
            local = like.medium.ray_to_local(ray.o, ray.d)
            t0, t1 = dr.maximum(local.t_near, 0), dr.minimum(local.t_far, ray.maxt)
            alpha, depth, total, n = self._march(local, t0, t1, active, shader)
            surface = alpha >= like.observer_settings.surface_opacity
            out = {
                "depth": depth,
                "opacity": alpha,
                "density_evals": n,
                "color_evals": mi.Float(0) if shader is None else n,
            }
            if shader is not None and like.medium.is_deferred:
                out["color_evals"] = dr.select(alpha > 0, mi.Float(1), 0)
            if {"visibility", "gaze"} & set(names):
                out["density_evals"] = n + self._look(ray.o + ray.d * depth, surface, out, "gaze" in names)
            L = mi.Spectrum(0)
            if like.radiance:
                L = (1 - alpha) * like.background
                if shader is not None:
                    color = shader.resolve_color(like.medium, total, alpha, local, cast("Any", active))
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
                environment, attended = SceneGeometry(like.medium), surface & (seen > 0)
                observed = like.gaze.for_observers([p_o], environment, like.observer_settings, like.cache)
                density = observed.evaluate(p_o + r_o * d_o, p_o, r_o, attended)[0]
                out["gaze"] = dr.select(attended, density * seen, 0)
                out["gaze_evals"] = dr.select(surface, mi.Float(like.gaze.field.networks), 0.0)
            return n

    return PaperIntegrator


def march_as_in_paper(medium, ray, t0, t1, active, shader, settings: PaperMarch):
    """March ``ray`` (`LocalRay`) between ``t0`` and ``t1``.

    Returns ``(opacity, depth, sum of the sample contributions, number of samples)``. ``shader`` computes the
    contributions; None for a density-only pass.
    """
    Float = type(ray.t_near)
    # The grid of the paper has no refined cells.
    grid: Any = None if medium.occupancy is None else medium.occupancy.coarse
    extent, steps = medium.length_scale, settings.steps

    def length(t):
        return dr.clip(t * settings.dt_gamma, extent / steps, max(extent / 128, extent / steps))

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
        is_active = active & (t < t1)
        dt = length(t)
        p = ray.o + ray.d * t
        if shader is None:
            sigma, features = medium.density(p, is_active), None
        else:
            sigma, features = medium.density_features(p, is_active)
        weight = dr.select(is_active, (1 - dr.exp(-sigma * dt)) * transmittance, 0)
        moment = moment + weight * (t + settings.depth_at * dt)
        if shader is not None:
            total = total + weight * shader.shade(medium, features, p, ray.w, is_active)
        # The kernels test the transmittance in front of the sample, so one more sample is taken.
        continues = transmittance >= PAPER_STOP
        transmittance, n = transmittance - weight, n + dr.select(is_active, 1, 0)
        t = t + dt
        return is_active & (t < t1) & continues & (n < steps), t, transmittance, moment, total, n

    start = (
        dr.mask_t(Float)(active) & (t0 < t1),
        Float(t0),
        Float(1),
        Float(0),
        None if shader is None else shader.zero(),
        Float(0),
    )
    _, _, transmittance, moment, total, n = dr.while_loop(start, lambda active, *_: active, body, label="paper march")
    alpha = 1 - transmittance
    if settings.divides_by_opacity:
        moment = moment / dr.select(alpha > 0, alpha, 1)
    return alpha, moment, total, n


# ---- Settings ----
#
# Which settings a study renders: sweeps of one factor around the scene's own, steps x quadrature, the paper's marching.

STEP_COUNTS = (16, 32, 64, 128, 256, 512, 1024, 2048, 4096)
RESOLUTIONS = (16, 32, 64, 128)
PAPER = "paper"


@dataclass(frozen=True)
class StudyRow:
    """One setting of a study."""

    name: str  # Name in the tables
    group: str  # Factor that it varies
    params: Mapping = field(default_factory=dict)  # Parameters of the integrator that override the scene's
    spp: int = 1  # Samples per pixel
    resolution: int = 0  # Resolution of the density as a grid; 0: the density of the scene
    voxels: int = 0  # Resolution of the voxels to which the field is compiled; 0: the field itself
    paper: PaperMarch | None = None  # The march of the paper; None: that of this package
    is_first_frame: bool = False  # Whether caches are cleared before each frame

    def make_integrator(self, subject, **extra_params):
        """Make the integrator of this row; ``extra_params`` are further parameters, such as AOVs that count."""
        integrator = subject.make_integrator({**self.params, **extra_params}, self.resolution, self.voxels)
        return (
            integrator
            if self.paper is None
            else make_paper_integrator(integrator, subject.sensor, subject.tolerance, self.paper)
        )


def list_rows(subject, quick: bool = False) -> list[StudyRow]:
    """List all rows for ``subject``; with ``quick`` only one or two of each factor."""

    if not subject.is_marched:
        return [
            StudyRow("default", "default"),
            *_observer_rows(subject, quick),
            *_reduced_rows(subject),
            *_sample_rows(quick),
        ]

    def thin_out(values):
        return values[:: max(len(values) - 1, 1)] if quick else values

    if subject.has_splats:
        return [*_splat_rows(thin_out), *_observer_rows(subject, quick), *_reduced_rows(subject), *_sample_rows(quick)]

    def steps(n):
        return {"step": subject.extent / n}

    rows = [StudyRow("default", "default")]
    for rule in (r.name for r in RULES if not r.ends_at_cells):
        for n in (64, 512) if quick else STEP_COUNTS:
            rows.append(StudyRow(f"{rule}, {n} steps", f"steps, {rule}", {"quadrature": rule, **steps(n)}))
    for g in thin_out((1 / 1024, 1 / 512, 1 / 256, 1 / 128)):
        rows.append(StudyRow(f"dt_gamma 1/{round(1 / g)}", "dt_gamma", {"dt_gamma": g}))
    sweeps = {
        "coarse": (2.0, 4.0, 8.0, 16.0),
        "stop": (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-8),
        "color_cutoff": (0.0, 1e-4, 1e-3, 3e-3, 1e-2, 3e-2),
    }
    rows += [StudyRow(f"{name} {v:g}", name, {name: v}) for name, values in sweeps.items() for v in thin_out(values)]
    for k in DEPTHS.names():
        rows.append(StudyRow(f"depth {k}", "depth", {"depth": k}))
        for n in () if quick else (128, 256, 512, 1024):
            rows.append(StudyRow(f"depth {k}, {n} steps", "depth", {"depth": k, **steps(n)}))
    rows.append(StudyRow("unrefined", "refined", {"refined": False}))
    rows.append(StudyRow("jitter", "jitter", {"jitter": True}))
    rows += _compiled_rows(thin_out(subject.voxel_resolutions))
    rows += _observer_rows(subject, quick) + _reduced_rows(subject) + _sample_rows(quick)
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
    rows += [] if quick else _combined_rows(subject)
    return rows + _paper_rows(quick)


def _splat_rows(some) -> list[StudyRow]:
    """List the rows for Gaussian splats, which are intersected individually and not marched."""
    rows = [StudyRow("default", "default")]
    rows += [StudyRow(f"stop {s:g}", "stop", {"stop": s}) for s in some(study_truth.SPLAT_STOPS)]
    rows += [StudyRow(f"extent {e:g}", "extent", {"extent": e}) for e in some(study_truth.SPLAT_EXTENTS)]
    # Estimators that refine another kind of depth give the same result here.
    rows += [StudyRow(f"depth {d.name}", "depth", {"depth": d.name}) for d in DEPTHS if d.surface_kind == d.name]
    loose = [(2.0, 1e-2), (2.5, 1e-2), (2.5, 1e-3)]
    return rows + [StudyRow(f"extent {e:g}, stop {s:g}", "together", {"extent": e, "stop": s}) for e, s in some(loose)]


def _compiled_rows(resolutions) -> list[StudyRow]:
    """List the rows of a compiled field, with its own default of the colour's cutoff and with lower ones."""
    rows = []
    for n in resolutions:
        for name, cutoff in (("", SEPARATE_COLOR_CUTOFF), (", color_cutoff 0.01", 0.01)):
            rows.append(StudyRow(f"voxels {n}{name}", "compiled", {"color_cutoff": cutoff}, voxels=n))
        params = {"color_cutoff": SEPARATE_COLOR_CUTOFF, "visibility": "map"}
        rows.append(StudyRow(f"voxels {n}, visibility map", "compiled", params, voxels=n))
    return rows


def _visibility_rows(quick: bool) -> list[StudyRow]:
    rows = [StudyRow(f"visibility {k}", "visibility", {"visibility": k}) for k in ("depth", "transmittance")]
    for h in (16,) if quick else (64, 128, 256, 512, 1024):
        params = {"visibility": "map", "map_height": h}
        rows.append(StudyRow(f"visibility map {h}", "visibility", params))
        rows.append(StudyRow(f"visibility map {h}, first frame", "visibility", params, is_first_frame=True))
    return rows


def _observer_rows(subject, quick: bool) -> list[StudyRow]:
    """List the rows that vary observer computations: visibility, and the integral of a normalised gaze field."""
    if not subject.is_normalized:
        return _visibility_rows(quick)
    return _visibility_rows(quick) + [
        StudyRow(f"integral_tolerance {t:g}, first frame", "integral", {"integral_tolerance": t}, is_first_frame=True)
        for t in ((0.0, 5e-3) if quick else (0.0, 3.125e-4, 1.25e-3, 5e-3, 2e-2))
    ]


def _sample_rows(quick: bool) -> list[StudyRow]:
    return [StudyRow(f"spp {k}", "spp", spp=k) for k in ((2,) if quick else (4, 16, 64))]


def _reduced_rows(subject) -> list[StudyRow]:
    """List the rows that leave out optional outputs."""
    rows = [
        StudyRow("no colour", "leave out", {"radiance": False}),
        StudyRow("no observer", "leave out", {"aovs": "depth,opacity"}),
        StudyRow("depth only", "leave out", {"aovs": "depth,opacity", "radiance": False}),
    ]
    if subject.has_gaze:
        rows.insert(1, StudyRow("no gaze", "leave out", {"aovs": "depth,opacity,visibility"}))
    return rows


def _combined_rows(subject) -> list[StudyRow]:
    """List the rows that vary several factors at once, to find the Pareto front."""
    rows = []
    for n in (128, 256, 512, 1024, 2048):
        step = {"step": subject.extent / n}
        rows.append(StudyRow(f"{n} steps, coarse 4", "together", {**step, "coarse": 4.0}))
        loose = {**step, "stop": 1e-4, "color_cutoff": 1e-2}
        for name, extra_params in (
            ("", {}),
            (", linear", {"quadrature": "linear"}),
            (", refined", {"depth": "refined"}),
        ):
            rows.append(StudyRow(f"{n} steps, stop 1e-4, cutoff 1e-2{name}", "together", {**loose, **extra_params}))
    return rows


def _paper_rows(quick: bool) -> list[StudyRow]:
    counts = (64, PAPER_STEPS) if quick else (128, 256, 512, PAPER_STEPS, 2048, 4096)
    # The march of the paper compares expected depths, whatever the scene uses.
    params = {"depth": "expected", "visibility": "depth"}
    rows = [StudyRow(f"paper, {n} steps", PAPER, params, paper=PaperMarch(n)) for n in counts]
    return rows + [
        StudyRow(
            f"paper, {PAPER_STEPS} steps, dt_gamma 1/128", PAPER, params, paper=PaperMarch(dt_gamma=PAPER_DT_GAMMA)
        )
    ]


# ---- Measure ----
#
# Measurement of each setting: errors, evaluations, memory and times.
#
# Time is the median of several renders with compiled kernels. The rounds cycle over all settings, so that a load peak
# of the machine affects all settings alike. Evaluations are counted in a separate render, because counting costs time.

COLUMNS = (
    *"setting group seconds cpu_seconds density_evals color_evals gaze_evals".split(),
    *ERROR_NAMES,
    *"""
        peak_mb pareto reference quadrature step steps coarse dt_gamma stop extent color_cutoff refined
        depth visibility map_height integral_tolerance jitter radiance aovs spp resolution voxels voxels_mb precision
    """.split(),
)
MARCH_PARAMETERS = ("quadrature", "step", "coarse", "dt_gamma", "stop", "color_cutoff", "refined", "depth", "jitter")
"""Parameters without effect if nothing is marched."""
SPLAT_PARAMETERS = ("stop", "depth")  # Those that have an effect for splats
COUNTS = ("density_evals", "color_evals", "gaze_evals")
SEED = 1
PIXEL_SPP = 256  # Samples per pixel of the reference for settings with several samples


def measure_rows(
    subject,
    rows: list[StudyRow],
    repeats: int,
    pixel_spp: int = PIXEL_SPP,
    on_step: Callable[[str], None] = lambda name: None,
) -> list[dict]:
    """Measure all settings.

    Returns one dict of `COLUMNS` per setting (without ``pareto``). ``on_step`` is called with the name of each
    measurement, ``2 len(rows)`` times.
    """
    pixels: dict = {}
    # Exact ray casts may take a minute, and are the same for all rows.
    exact = subject.find_exact_hits(SEED)
    table, integrators = [], []
    for row in rows:
        on_step(row.name)
        integrator = row.make_integrator(subject)
        values = _collect_parameters(subject, row, subject.make_integrator(row.params, row.resolution, row.voxels))
        table.append(
            values
            | _measure_quality(subject, row, integrator, values, exact, pixels, pixel_spp)
            | _count_evaluations(subject, row)
        )
        integrators.append(integrator)
    times = _measure_times(subject, rows, integrators, repeats, on_step)
    for line, (wall, cpu) in zip(table, times):
        line["seconds"], line["cpu_seconds"] = statistics.median(wall), statistics.median(cpu)
    return table


def _collect_parameters(subject, row: StudyRow, integrator) -> dict:
    values = read_parameters(integrator)
    if row.paper is not None:
        step, depth = subject.extent / row.paper.steps, "expected" if row.paper.divides_by_opacity else "unnormalised"
        values |= {"quadrature": "paper", "step": step, "dt_gamma": row.paper.dt_gamma, "stop": PAPER_STOP}
        values |= {"color_cutoff": 0.0, "coarse": 1.0, "jitter": False, "depth": depth, "refined": False}
    if values["visibility"] != "map":
        values["map_height"] = ""
    if not subject.is_marched:
        values |= dict.fromkeys(MARCH_PARAMETERS, "")
    if subject.has_splats:
        values |= dict.fromkeys((n for n in MARCH_PARAMETERS if n not in SPLAT_PARAMETERS), "") | {
            "extent": read_splat_extent(integrator)
        }
    return {n: values[n] for n in values if n in COLUMNS} | {
        "setting": row.name,
        "group": row.group,
        "steps": subject.extent / values["step"] if subject.is_marched and not subject.has_splats else "",
        "aovs": ",".join(integrator.aovs),
        "spp": row.spp,
        "resolution": row.resolution or "",
        "voxels": row.voxels or "",
        "precision": describe_precision(),
        **({"voxels_mb": subject.compile_field(row.voxels)[1] / 1e6} if row.voxels else {}),
    }


def _measure_quality(subject, row: StudyRow, integrator, values: dict, exact, pixels: dict, pixel_spp: int) -> dict:
    import drjit as dr

    backend = dr.JitBackend.CUDA if _is_cuda() else dr.JitBackend.LLVM
    gc.collect()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    # Subtract memory held by other rows, such as their maps.
    before = dr.detail.malloc_watermark(backend)
    picture = subject.render_channels(integrator, row.spp, SEED)
    peak = dr.detail.malloc_watermark(backend) - before
    if row.spp > 1:
        if not pixels:
            pixels["truth"] = _render_pixel_truth(subject, pixel_spp)
        truth, exact = pixels["truth"], None
    else:
        # Compare unnormalised depths with expected depths.
        depth = "expected" if row.paper is not None else values["depth"]
        truth = subject.get_truth(SEED, depth, values["visibility"])
    return compute_errors(picture, truth, exact) | {"peak_mb": peak / 2**20, "reference": truth.source}


def _render_pixel_truth(subject, spp: int) -> StudyTruth:
    """Render the mean over many samples per pixel with the scene's settings and another seed."""
    channels = subject.render_channels(subject.make_integrator(), spp, SEED + 1)
    none = np.zeros(len(channels["depth"]))
    return StudyTruth(
        **{n: channels[n] for n in ("color", "opacity", "depth", "visibility")},
        gaze=channels.get("gaze", none),
        source=f"mean of {spp} samples per pixel",
        convergence={},
    )


def _count_evaluations(subject, row: StudyRow) -> dict:
    """Count the mean evaluations per pixel, with the AOVs of the setting, so that the same passes run."""
    names = row.params.get("aovs", subject.aov_names()).split(",")
    counted = [n for n in COUNTS if n != "gaze_evals" or "gaze" in names]
    channels = subject.render_channels(row.make_integrator(subject, aovs=",".join([*names, *counted])), 1, SEED)
    return {n: row.spp * float(channels[n].mean()) if n in counted else 0.0 for n in COUNTS}


def _measure_times(subject, rows, integrators, repeats: int, on_step) -> list[tuple[list[float], list[float]]]:
    times = [([], []) for _ in rows]
    for row, integrator in zip(rows, integrators):
        # The first frame rendered the errors; the next one reads its caches and is another kernel.
        if not row.is_first_frame:
            subject.render(integrator, row.spp, SEED)
    for k in range(repeats):
        for row, integrator, (wall, cpu) in zip(rows, integrators, times):
            if k == 0:
                on_step(f"time of {row.name}")
            if row.is_first_frame:
                integrator.parameters_changed()
            seconds, cpu_seconds = time_render(subject, integrator, row.spp)
            wall.append(seconds)
            cpu.append(cpu_seconds)
    return times


def time_render(subject, integrator, spp: int = 1) -> tuple[float, float]:
    """Measure wall-clock and processor seconds of one render."""
    start, cpu_start = time.perf_counter(), time.process_time()
    subject.render(integrator, spp, SEED)
    return time.perf_counter() - start, time.process_time() - cpu_start


def describe_precision() -> str:
    """Describe the precision of the active variant: networks are fp16 on CUDA for its matrix units, everything else is
    fp32.
    """
    return "fp32, networks fp16" if _is_cuda() else "fp32"


def _is_cuda() -> bool:
    import mitsuba as mi

    return str(mi.variant()).startswith("cuda")


# ---- Cost against size ----


def measure_scaling(
    subject, repeats: int, quick: bool = False, on_step: Callable[[str], None] = lambda name: None
) -> list[dict]:
    """Measure the cost of the default against pixels, samples per pixel, and scene extent.

    Returns rows of ``axis``, ``value``, ``seconds`` and ``density_evals`` (mean per pixel).

    Notes
    -----
    A scene scaled by s and marched with the same step is equivalent, by the scaling law of densities (σ/s), to this
    scene marched with steps s times shorter. This is how the extent is varied.
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
        for _ in range(2):  # the second frame reads the observer caches of the first, and is another kernel
            subject.render(integrator, setting.spp, SEED)
        seconds = statistics.median(time_render(subject, integrator, setting.spp)[0] for _ in range(repeats))
        counts = _count_evaluations(subject, setting)
        amount = value * (2 * value // 3) if axis == "pixels" else value
        out.append({"axis": axis, "value": amount, "seconds": seconds, "density_evals": counts["density_evals"]})
        if axis == "pixels":
            subject.resize(*size)
    return out
