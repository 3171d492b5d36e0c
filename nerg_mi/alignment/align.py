"""Register tracking with an environment: estimate, check and write the alignment for ``--align``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.scene_loading import activate_mitsuba
from nerg_mi.errors import NergError, parameter
from nerg_mi.figures.maps import alignment_figure
from nerg_mi.figures.style import changed_arguments, make_provenance, save
from nerg_mi.files.atomic import check_writable, file_sha256
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.formats.alignments import Alignment, read_similarity
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.transforms import transform_points
from nerg_mi.options import parse_point
from nerg_mi.photos.colmap import rotation_to_z
from nerg_mi.photos.photo_set import Photos
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import COORDINATES, LENGTHS, SEEDS, Range, check_ranges
from nerg_mi.tracking.direction_checks import DECLARED
from nerg_mi.tracking.rays import Rays

from .check import check_alignment, record_fit
from .constraints import AlignmentFit, AlignmentTarget, Evidence, read_surface, trace_scene
from .icp import Twin
from .points import read_cameras, read_pairs
from .tracking import Tracking, compare_flips

MAX_IN_SOLIDS = 0.5  # maximum share of heads that are more than 10 cm inside solid objects

_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}


@check_ranges
def align(
    rays: Rays | FilePath | None = None,
    environment: object | FilePath | None = None,
    *,
    surface: FilePath | None = None,
    pairs: FilePath | None = None,
    tracking_surface: FilePath | None = None,
    tracking_cameras: Photos | FilePath | None = None,
    scene_cameras: Photos | FilePath | None = None,
    init: Alignment | FilePath | None = None,
    refine: bool = False,
    up: str | None = None,
    floor_height: Annotated[float, COORDINATES] = 0.0,
    scene_floor_height: Annotated[float, COORDINATES] | None = None,
    scale: Annotated[float, LENGTHS] | None = None,
    turn: Annotated[float, Range(-360, 360)] | None = None,
    shift: str | None = None,
    max_residual: Annotated[float, Range(0, 10**9)] = 10.0,
    force: bool = False,
    seed: Annotated[int, SEEDS] = 0,
    output: FilePath | None = None,
    progress: Progress = None,
) -> Alignment:
    """Register tracking with a scene: find the similarity transform from the frame of the rays to that of the scene.

    The transform is found from point correspondences, two surfaces, cameras posed in both frames, or the tracking
    alone: heads are in free space, and gaze ends on surfaces. A mirrored frame is detected and reported. Without hit
    points, the ranges of turns, scales and shifts that fit are reported, and wide ones are rejected.

    Parameters
    ----------
    rays : Rays or path, optional
        Rays file (.npz or .parquet). Not needed with ``pairs``, ``tracking_surface`` or ``tracking_cameras``.
    environment : object or path, optional
        The environment in memory or its file, as `nerg_mi.environment.environment.Environment.open` takes it.
    surface : path, optional
        Surface of the scene, in place of ``environment``: a mesh or points (.ply, .obj, .glb, .npy, .csv with x,y,z, or
        points of Aria).
    pairs : path, optional
        Three or more point correspondences: CSV with columns x,y,z,place_x,place_y,place_z, or JSON.
    tracking_surface : path, optional
        Surface in the frame of the tracking, a mesh or points as for ``surface``; it is registered by ICP.
    tracking_cameras : Photos or path, optional
        Posed photos in the frame of the tracking (transforms.json, COLMAP); needs ``scene_cameras``.
    scene_cameras : Photos or path, optional
        The same photos posed in the frame of the scene (transforms.json, COLMAP).
    init : Alignment or path, optional
        Approximate alignment (.json) that the tracking refines.
    refine : bool
        Refine the alignment found from points, surfaces or cameras with the tracking.
    up : str, optional
        Up axis of the scene: x, y, z, -x, -y, -z or x,y,z. Only rotations about it remain to be found; the tracking is
        z up.
    floor_height : float
        Height of the floor in the frame of the tracking, in metres.
    scene_floor_height : float, optional
        Height of the floor in the scene along ``up``, in scene units. Default: estimated.
    scale : float, optional
        Scene units per metre of the tracking. Default: estimated.
    turn : float, optional
        Rotation about ``up`` from the frame of the tracking to that of the scene, turned to z up, in degrees,
        anticlockwise as seen from above. Default: estimated.
    shift : str, optional
        Position of the origin of the tracking in the scene, x,y,z in scene units. Default: estimated.
    max_residual : float
        Maximum median residual in centimetres; alignments with a larger one are rejected.
    force : bool
        Write the alignment even if it is rejected.
    seed : int
        Seed of the random numbers for rays that sample the scene, and for intervals.
    output : path, optional
        Alignment to write (.json), for ``align`` of other commands; a plot is written next to it.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    Alignment
        The transform and its quality. The residuals are those of the evidence that was fitted, and not of other
        evidence; the uncertainty is that of the transform.

    Raises
    ------
    NergError
        The evidence does not determine the transform; or the frames are mirrored or the median residual exceeds
        ``max_residual``, unless ``force`` is set.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> rows = "0,0,0,1,0,0\\n2,0,0,5,0,0\\n0,1,0,1,2,0\\n0,0,1,1,0,2\\n"
    >>> _ = (folder / "pairs.csv").write_text("x,y,z,place_x,place_y,place_z\\n" + rows)
    >>> alignment = nerg.align(pairs=folder / "pairs.csv")
    >>> (alignment.matrix.round(6) + 0.0)[0].tolist()
    [2.0, 0.0, 0.0, 1.0]
    """
    arguments = locals()
    if environment is not None and surface is not None:
        raise NergError(f"only one scene can be given: use {parameter('environment')} or {parameter('surface')}")
    if (tracking_cameras is None) != (scene_cameras is None):
        raise NergError(f"{parameter('tracking_cameras')} and {parameter('scene_cameras')} must be given together")
    if output is not None:
        output = to_path(output)
        check_writable(output, ".json")
        check_writable(output.with_suffix(".png"))
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading")
        data = rays if rays is None or isinstance(rays, Rays) else Rays.load(to_path(rays))
        if refine and data is None:
            raise NergError(f"{parameter('refine', True)} needs the tracking: give a rays file")
        cameras = None if tracking_cameras is None or scene_cameras is None else (tracking_cameras, scene_cameras)
        evidence = _read_evidence(data, pairs, tracking_surface, cameras, init, seed, reporter.message)
        is_tracking = evidence.kind == Tracking.kind
        if environment is None and surface is None and (is_tracking or refine or evidence.kind == Twin.kind):
            raise NergError(
                f"no scene is given: add {parameter('environment', 'FILE')}, or {parameter('surface', 'FILE')} (a "
                "mesh or points)"
            )
        if up is None and ((is_tracking and init is None) or turn is not None):
            up = "z"
            reporter.message(f"the scene is assumed to be z up; use {parameter('up')} for another axis")
        constraints = _find_constraints(up, floor_height, scene_floor_height, scale, turn, shift)
        scene = None
        if environment is not None:
            activate_mitsuba()
            reporter.progress(0.02, "tracing the scene")
            scene = Environment.open(environment)
            for note in scene.notes:
                reporter.message(f"{environment}: {note}" if isinstance(environment, FilePath) else note)
            assert scene.medium is not None
            core = scene.box.core
            traces = trace_scene(scene.medium, np.array(core.lower), np.array(core.upper), seed=seed)
            target = AlignmentTarget(traces=traces, **constraints)
        elif surface is not None:
            target = AlignmentTarget(points=read_surface(to_path(surface), on_note=reporter.message), **constraints)
        else:
            target = AlignmentTarget(**constraints)
        fit = evidence.fit(target, reporter.progress)
        if refine and data is not None:
            _report_notes(fit, reporter)
            evidence = Tracking(data, fit.matrix, seed)
            fit = evidence.fit(target, reporter.progress)
        _report_notes(fit, reporter)
        rejection = _rejection_reason(fit, max_residual)
        if rejection and not force:
            kind = "mirrored" if fit.mirrored is not None else ""
            raise NergError(f"{rejection}; or add {parameter('force', True)} to write it anyway", kind=kind)
        names = ("environment", "surface", "pairs", "tracking_surface", "init", "rays")
        sources = {n: to_path(arguments[n]) for n in names if isinstance(arguments[n], FilePath)}
        if scene is not None and "environment" in sources:
            sources = {scene.kind: sources.pop("environment"), **sources}
        files = {name: {"file": path.name, "sha256": file_sha256(path)} for name, path in sources.items()}
        result = record_fit(evidence.kind, fit, files, bool(rejection))
        _report_alignment(result, reporter)
        if scene is not None and data is not None:
            _report_check(scene, data, result.matrix, reporter)
        if target.points is not None and data is not None:
            _report_flips(target.points, data, result.matrix, reporter)
        if output is not None:
            picture = output.with_suffix(".png")
            options = {n: path for n, path in sources.items() if n in ("field", "scene")}
            options |= changed_arguments(align, arguments)
            header = make_provenance("nerg align", sources.values(), None, options)
            save(_figure(fit, target, None if data is None else data.origin, result), picture, header)
            result.save(output)
            reporter.message(f"wrote {output} (check {picture.name}); use it with {parameter('align', output)}")
    return result


def _read_evidence(
    rays: Rays | None,
    pairs: FilePath | None,
    tracking_surface: FilePath | None,
    cameras: tuple[Photos | FilePath, Photos | FilePath] | None,
    init: Alignment | FilePath | None,
    seed: int,
    on_note: Callable[[str], None],
) -> Evidence:
    """Return the evidence. Raises `NergError` for several kinds, or none."""
    kinds = {"pairs": pairs, "tracking_surface": tracking_surface, "tracking_cameras": cameras, "init": init}
    named = ", ".join(parameter(name) for name, evidence in kinds.items() if evidence is not None)
    if ", " in named:
        raise NergError(
            f"{named} are alternatives: give one of them, and add {parameter('refine', True)} to refine it with "
            "the tracking"
        )
    if pairs is not None:
        return read_pairs(to_path(pairs))
    if tracking_surface is not None:
        points = read_surface(to_path(tracking_surface), on_note=on_note)
        return Twin(points, f'the tracking surface "{tracking_surface}"')
    if cameras is not None:
        return read_cameras(*cameras)
    if rays is None:
        raise NergError(
            f"no evidence is given: name a rays file (tracking alone), or add {parameter('pairs', 'FILE')}, "
            f"{parameter('tracking_surface', 'FILE')}, or {parameter('tracking_cameras')} with "
            f"{parameter('scene_cameras')}"
        )
    if isinstance(init, Alignment) or init is None:
        return Tracking(rays, None if init is None else init.matrix, seed)
    return Tracking(rays, read_similarity(to_path(init), parameter("init"), "rays to scene").matrix, seed)


def _find_constraints(
    up: str | None,
    floor_height: float,
    scene_floor_height: float | None,
    scale: float | None,
    turn: float | None,
    shift: str | None,
) -> dict[str, Any]:
    """Return what is fixed of the transform, as keywords of `AlignmentTarget`."""
    to_z_up, scene_floor, offset = _turn(up), scene_floor_height, None
    if shift is not None:
        offset = to_z_up[:3, :3] @ parse_point(shift, parameter("shift"))
        if scene_floor is None and (scale is not None or not floor_height):
            scene_floor = offset[2] + (scale or 1) * floor_height
    return {
        "to_z_up": to_z_up,
        "is_upright": up is not None,
        "tracking_floor": floor_height,
        "scene_floor": scene_floor,
        "scale": scale,
        "turn": None if turn is None else np.radians(turn),
        "shift": offset,
    }


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


def _rejection_reason(fit: AlignmentFit, max_residual: float) -> str:
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
    if not median <= max_residual:
        return (
            f"the median residual is {median:.3g} cm, above "
            f"{parameter('max_residual', f'{max_residual:g}')}: give other evidence, or a larger limit"
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
