"""Register tracking with a scene: estimate, check and write the alignment for ``--align``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.alignment.check import Alignment, check_alignment, read_similarity
from nerg_mi.alignment.constraints import AlignmentFit, AlignmentTarget, Evidence, read_surface, trace_scene
from nerg_mi.alignment.icp import Twin
from nerg_mi.alignment.points import read_cameras, read_pairs
from nerg_mi.alignment.similarity import transform_points
from nerg_mi.alignment.tracking import Tracking, compare_flips
from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError, parameter
from nerg_mi.figures.maps import alignment_figure
from nerg_mi.figures.style import make_provenance, save
from nerg_mi.files.atomic import check_writable, file_sha256
from nerg_mi.maths.geometry import Similarity
from nerg_mi.options import parse_point
from nerg_mi.photos.colmap import rotation_to_z
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.direction_checks import DECLARED
from nerg_mi.rays.rays import Rays

from .base import select_backend
from .rays_commands import AlignOptions

# ---- Alignment of tracking with a scene ----


MAX_IN_SOLIDS = 0.5  # maximum share of heads that are more than 10 cm inside solid objects

_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}


@dataclass(frozen=True, eq=False)
class AlignResult:
    """An alignment, and the files that were written: the alignment and a plot."""

    alignment: Alignment
    files: list[Path]


def align(
    rays: Rays | str | Path | None,
    output: str | Path | None = None,
    options: AlignOptions | None = None,
    reporter: Reporter = SILENT,
) -> AlignResult:
    """Find the similarity transform from the frame of ``rays``, or of a file of rays, to that of a scene.

    Parameters
    ----------
    rays
        Rays or their file; None with evidence that needs none.
    output
        Alignment file to write (.json); a plot (.png) is written next to it. None writes nothing.
    options
        Scene, evidence and constraints.
    reporter
        Receives messages and progress.

    Raises
    ------
    NergError
        If the evidence does not determine the transform; if the frame is mirrored or the median residual exceeds
        ``options.max_residual``, unless ``options.force`` is set.
    """
    options = options or AlignOptions()
    output = None if output is None else Path(output)
    if output is not None:
        check_writable(output, ".json")
        check_writable(output.with_suffix(".png"))
    reporter.progress(0.0, "reading")
    data = rays if rays is None or isinstance(rays, Rays) else Rays.load(rays)
    evidence = _evidence(options, data, reporter)
    environment, target = _target(options, evidence.kind, reporter)
    fit = evidence.fit(target, reporter.progress)
    if options.refine and data is not None:
        _report_notes(fit, reporter)
        evidence = Tracking(data, fit.matrix, options.seed)
        fit = evidence.fit(target, reporter.progress)
    _report_notes(fit, reporter)
    rejection = _rejection_reason(fit, options)
    if rejection and not options.force:
        kind = "mirrored" if fit.mirrored is not None else ""
        raise NergError(f"{rejection}; or add {parameter('force', True)} to write it anyway", kind=kind)
    files = {name: _identity(path) for name, path in _sources(rays, options).items()}
    result = Alignment.from_fit(evidence.kind, fit, files, bool(rejection))
    _report_alignment(result, reporter)
    if environment is not None and environment.medium is not None and data is not None:
        _report_check(environment, data, result.matrix, reporter)
    if target.points is not None and data is not None:
        _report_flips(target.points, data, result.matrix, reporter)
    written: list[Path] = []
    if output is not None:
        picture = output.with_suffix(".png")
        heads = None if data is None else data.origin
        header = make_provenance("nerg align", _sources(rays, options).values(), None, options)
        save(_figure(fit, target, heads, result), picture, header)
        result.save(output)
        written = [output, picture]
        reporter.message(f"wrote {output} (check {picture.name}); use it with {parameter('align', output)}")
    return AlignResult(result, written)


def _evidence(options: AlignOptions, rays: Rays | None, reporter: Reporter) -> Evidence:
    """Return the evidence given by ``options``. Raises `NergError` for several kinds, or none."""
    evidence = {
        parameter("pairs"): options.pairs,
        parameter("tracking_surface"): options.tracking_surface,
        parameter("tracking_cameras"): options.tracking_cameras,
        parameter("init"): options.init,
    }
    kinds = [flag for flag, path in evidence.items() if path is not None]
    if len(kinds) > 1:
        named = ", ".join(kinds)
        raise NergError(
            f"{named} are alternatives: give one of them, and add {parameter('refine', True)} to refine it with "
            "the tracking"
        )
    if (options.tracking_cameras is None) != (options.scene_cameras is None):
        raise NergError(f"{parameter('tracking_cameras')} and {parameter('scene_cameras')} must be given together")
    if options.refine and rays is None:
        raise NergError(f"{parameter('refine', True)} needs the tracking: give a rays file")
    if options.pairs is not None:
        return read_pairs(options.pairs)
    if (path := options.tracking_surface) is not None:
        return Twin(read_surface(path, on_note=reporter.message), f'the tracking surface "{path}"')
    if options.tracking_cameras is not None:
        return read_cameras(options.tracking_cameras, _path(options.scene_cameras))
    if rays is None:
        raise NergError(
            f"no evidence is given: name a rays file (tracking alone), or add {parameter('pairs', 'FILE')}, "
            f"{parameter('tracking_surface', 'FILE')}, or {parameter('tracking_cameras')} with "
            f"{parameter('scene_cameras')}"
        )
    start = None if options.init is None else read_similarity(options.init, parameter("init"), "rays to scene").matrix
    return Tracking(rays, start, options.seed)


def _path(path: Path | None) -> Path:
    assert path is not None
    return path


def _target(options: AlignOptions, kind: str, reporter: Reporter) -> tuple[Environment | None, AlignmentTarget]:
    kinds = [n for n in ("field", "scene", "surface") if getattr(options, n) is not None]
    if len(kinds) > 1:
        raise NergError(f"only one scene can be given: use {' or '.join(map(parameter, kinds))}")
    is_upright = (kind == Tracking.kind and options.init is None) or options.turn is not None
    up = "z" if options.up is None and is_upright else options.up
    if up is not None and options.up is None:
        reporter.message(f"the scene is assumed to be z up; use {parameter('up')} for another axis")
    to_z_up = _turn(up)
    scene_floor, shift = options.scene_floor_height, None
    if options.shift is not None:
        shift = to_z_up[:3, :3] @ parse_point(options.shift, parameter("shift"))
        if scene_floor is None and (options.scale is not None or not options.floor_height):
            scene_floor = shift[2] + (options.scale or 1) * options.floor_height
    common = {
        "to_z_up": to_z_up,
        "is_upright": up is not None,
        "tracking_floor": options.floor_height,
        "scene_floor": scene_floor,
        "scale": options.scale,
        "turn": None if options.turn is None else np.radians(options.turn),
        "shift": shift,
    }
    if not kinds:
        if kind in (Tracking.kind, Twin.kind) or options.refine:
            raise NergError(
                f"no scene is given: add {parameter('field', 'FILE')}, {parameter('scene', 'FILE')} or "
                f"{parameter('surface', 'FILE')} (a mesh or points)"
            )
        return None, AlignmentTarget(**common)
    if options.surface is not None:
        return None, AlignmentTarget(points=read_surface(options.surface, on_note=reporter.message), **common)
    select_backend(options.mode, options.threads)
    reporter.progress(0.02, "tracing the scene")
    environment = Environment.open(options.field or _path(options.scene))
    for note in environment.notes:
        reporter.message(f"{options.field or options.scene}: {note}")
    assert environment.medium is not None
    core = environment.box.core
    traces = trace_scene(environment.medium, np.array(core.lower), np.array(core.upper), seed=options.seed)
    return environment, AlignmentTarget(traces=traces, **common)


def _turn(up: str | None) -> np.ndarray:
    """Return the rotation (4, 4) that turns the ``up`` axis of the scene to z."""
    turn = np.eye(4)
    if up is None:
        return turn
    axis = np.array(_AXES.get(up.strip().lower()) or parse_point(up, parameter("up")), float)
    length = np.linalg.norm(axis)
    if length == 0:
        raise NergError(
            f"{parameter('up')} must be an axis (x, y, z, -x, -y, -z) or three numbers x,y,z that are not all 0, "
            f"got {up!r}"
        )
    turn[:3, :3] = rotation_to_z(axis / length)
    return turn


def _sources(rays: Rays | str | Path | None, options: AlignOptions) -> dict[str, Path]:
    """Return the input files of an alignment by their kind."""
    names = ("field", "scene", "surface", "pairs", "tracking_surface", "init")
    sources = {n: path for n in names if (path := getattr(options, n)) is not None}
    if rays is not None and not isinstance(rays, Rays):
        sources["rays"] = Path(rays)
    return sources


def _identity(path: Path) -> dict[str, str]:
    return {"file": path.name, "sha256": file_sha256(path)}


def _rejection_reason(fit: AlignmentFit, options: AlignOptions) -> str:
    """Return why an alignment is rejected, or an empty string."""
    if fit.mirrored is not None:
        return (
            f"the tracking is mirrored: {fit.mirrored}; import it again with the other {parameter('handedness')}, "
            "or correct the negated axis in the evidence"
        )
    if fit.interval is not None:
        if reason := fit.interval.rejection_reason():
            return reason
        if fit.metadata["heads_in_solids"] > MAX_IN_SOLIDS:
            return (
                f"{100 * fit.metadata['heads_in_solids']:.0f} % of the heads are inside solid objects: check "
                f"{parameter('up')}, {parameter('scale')} and {parameter('floor_height')}, or give other evidence"
            )
    median = float(np.median(fit.residuals_cm)) if len(fit.residuals_cm) else 0.0
    if not median <= options.max_residual:
        return (
            f"the median residual is {median:.3g} cm, above "
            f"{parameter('max_residual', f'{options.max_residual:g}')}: give other evidence, or a larger limit"
        )
    return ""


def _report_notes(fit: AlignmentFit, reporter: Reporter) -> None:
    for line in fit.notes:
        reporter.message(line)
    for line in fit.warnings:
        reporter.warn(line)


def _report_alignment(alignment: Alignment, reporter: Reporter) -> None:
    r, u = alignment.residuals, alignment.uncertainty
    parts = [
        f"{r[f'median_{unit}']:.2g} {unit} (95 %: {r[f'p95_{unit}']:.2g})"
        for unit in ("cm", "degrees")
        if r[f"median_{unit}"] is not None
    ]
    matrix = alignment.matrix
    residuals = f"residuals: {', '.join(parts)} (median)" if parts else "no residuals, since there are no hit points"
    reporter.message(f"{residuals}; scale {Similarity(matrix).scale:.5g}")
    if u is not None and "cm" in u:
        reporter.message(
            f"uncertainty (one standard deviation): {u['cm']:.2g} cm, {u['degrees']:.2g} degrees, "
            f"{u['scale_percent']:.2g} % of the scale"
        )


def _report_check(environment: Environment, rays: Rays, matrix: np.ndarray, reporter: Reporter) -> None:
    assert environment.medium is not None
    check = check_alignment(environment.medium, rays, Similarity(matrix))
    reporter.message(
        f"{100 * check.escaped:.1f} % of the gaze hits no surface, {100 * check.inside:.1f} % of the heads are "
        f"inside an object, {100 * check.below:.1f} % below the floor"
    )
    if check.mirrored is not None:
        reporter.warn(check.mirrored)


def _report_flips(points: np.ndarray, rays: Rays, matrix: np.ndarray, reporter: Reporter) -> None:
    flips = compare_flips(points, matrix, rays.origin, rays.direction, rays.head)
    median = float(np.median(flips.degrees[DECLARED]))
    reporter.message(f"median angle between the gaze and the nearest point of the scene: {median:.2g} degrees")
    warning = flips.warning()
    if warning is not None:
        reporter.warn(warning)


def _figure(fit: AlignmentFit, target: AlignmentTarget, heads: np.ndarray | None, alignment: Alignment):
    """Return the figure of the tracking before and after alignment, z up."""
    surface = None if target.traces is None and target.points is None else target.surface
    points = np.zeros((0, 3)) if fit.points is None else fit.points
    same = heads is not None and len(points) == len(heads) and np.array_equal(points, heads)
    median = alignment.residuals["median_cm"]
    residual_note = "" if median is None else f", residual {median:.2g} cm (median)"
    return alignment_figure(
        None if surface is None else surface.points,
        points,
        None if same else heads,
        target.to_z_up @ alignment.matrix,
        None if fit.targets is None else transform_points(target.to_z_up, fit.targets),
        f"Aligned by {alignment.evidence['kind']}{residual_note}",
        None if surface is None else _below_ceiling(surface.points),
    )


def _below_ceiling(points: np.ndarray) -> float:
    low, high = np.percentile(points[:, 2], [2, 98])
    return float(low + 0.75 * (high - low))
