"""How tracking lies in a place: found from what there is as evidence, judged, and written for ``--align``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.alignment.check import Alignment, check_alignment, read_similarity
from nerg_mi.alignment.constraints import AlignmentFit, AlignmentTarget, Evidence, read_surface, trace_scene
from nerg_mi.alignment.icp import Twin
from nerg_mi.alignment.points import read_cameras, read_pairs
from nerg_mi.alignment.similarity import transform_points
from nerg_mi.alignment.tracking import Tracking, compare_flips
from nerg_mi.errors import NergError
from nerg_mi.figures.maps import alignment_figure
from nerg_mi.figures.style import make_provenance, save
from nerg_mi.files.atomic import check_writable, file_sha256
from nerg_mi.maths.geometry import Similarity
from nerg_mi.photos.colmap import rotation_to_z
from nerg_mi.rays.direction_checks import DECLARED
from nerg_mi.rays.rays import Rays
from nerg_mi.train import geometry
from nerg_mi.train.geometry import TrainingGeometry

from .base import SILENT, Reporter, select_backend
from .options import parse_point
from .rays_commands import AlignOptions

# ---- How tracking lies in a place: found from what there is as evidence, judged, and written for ``--align`` ----


_AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}


@dataclass(frozen=True, eq=False)
class AlignResult:
    """An alignment that was found, and the files that were written: it, and a picture."""

    alignment: Alignment
    files: list[Path]


def align(
    rays: Rays | str | Path | None,
    output: str | Path | None = None,
    options: AlignOptions | None = None,
    reporter: Reporter = SILENT,
) -> AlignResult:
    """Find the similarity from the frame of ``rays``, or their file, to that of a place.

    ``output``: alignment to write (.json), with a picture of the same name (.png) beside it; None: nothing is written.
    Raises `NergError` for evidence that leaves it open, for a mirrored frame, and for a fit whose median residual is
    beyond ``options.max_residual`` (the last two unless ``options.force``).
    """
    options = options or AlignOptions()
    output = None if output is None else Path(output)
    if output is not None:
        check_writable(output, ".json")
        check_writable(output.with_suffix(".png"))
    reporter.progress(0.0, "reading")
    data = rays if rays is None or isinstance(rays, Rays) else Rays.load(rays)
    evidence = _evidence(options, data, reporter)
    place, target = _target(options, evidence.kind, reporter)
    fit = evidence.fit(target, reporter.progress)
    if options.refine and data is not None:
        _report_notes(fit, reporter)
        evidence = Tracking(data, fit.matrix)
        fit = evidence.fit(target, reporter.progress)
    _report_notes(fit, reporter)
    refused = _refusal(fit, options)
    if refused and not options.force:
        raise NergError(f"{refused}; or write it all the same with --force")
    files = {name: _identity(path) for name, path in _sources(rays, options).items()}
    found = Alignment.from_fit(evidence.kind, fit, files, bool(refused))
    _report_found(found, reporter)
    if place is not None and place.medium is not None and data is not None:
        _report_check(place, data, found.matrix, reporter)
    if target.points is not None and data is not None:
        _report_flips(target.points, data, found.matrix, reporter)
    written: list[Path] = []
    if output is not None:
        picture = output.with_suffix(".png")
        heads = None if data is None else data.origin
        about = make_provenance("nerg align", _sources(rays, options).values(), None, options)
        save(_figure(fit, target, heads, found), picture, about)
        found.save(output)
        written = [output, picture]
        reporter.message(f"wrote {output} (look at {picture.name}); next: --align {output}")
    return AlignResult(found, written)


def _evidence(options: AlignOptions, rays: Rays | None, reporter: Reporter) -> Evidence:
    """What is given as evidence. Raises `NergError` for more than one kind, or none."""
    given = [name for name in ("pairs", "twin", "cameras") if getattr(options, name) is not None]
    if len(given) > 1 or (given and options.init is not None):
        named = ", ".join(f"--{name}" for name in [*given, *(["start"] if options.init else [])])
        raise NergError(f"{named} are different evidence: give one of them, and --refine to go on from it")
    if (options.tracking_cameras is None) != (options.scene_cameras is None):
        raise NergError("cameras are known in both frames by --cameras and --place-cameras: give both")
    if options.refine and rays is None:
        raise NergError("--refine needs the tracking: give a rays file")
    makers: dict[str, Callable[[Path], Evidence]] = {
        "pairs": read_pairs,
        "twin": lambda path: Twin(read_surface(path, on_note=reporter.message), f'the twin "{path}"'),
        "cameras": lambda path: read_cameras(path, _path(options.scene_cameras)),
    }
    if given:
        return makers[given[0]](_path(getattr(options, given[0])))
    if rays is None:
        raise NergError(
            "say what to align by: a rays file (the tracking alone), or --pairs FILE, --twin FILE, or --cameras with "
            "--place-cameras"
        )
    start = None if options.init is None else read_similarity(options.init, "--start", "rays to place").matrix
    return Tracking(rays, start)


def _path(path: Path | None) -> Path:
    assert path is not None
    return path


def _target(options: AlignOptions, kind: str, reporter: Reporter) -> tuple[TrainingGeometry | None, AlignmentTarget]:
    given = [n for n in ("field", "scene", "surface") if getattr(options, n) is not None]
    if len(given) > 1:
        raise NergError(f"the place is one: give --{' or --'.join(given)}")
    up = "z" if options.up is None and kind == Tracking.kind and options.init is None else options.up
    if up is not None and options.up is None:
        reporter.message("z is taken for up in the place; say --up where it is another axis")
    common = {
        "turn": _turn(up),
        "upright": up is not None,
        "floor": options.floor_height,
        "place_floor": options.scene_floor_height,
        "scale": options.scale,
    }
    if not given:
        if kind in (Tracking.kind, Twin.kind) or options.refine:
            raise NergError(
                "the place is missing: give --field FILE, --scene FILE or --surface FILE (a mesh or points)"
            )
        return None, AlignmentTarget(**common)
    if options.surface is not None:
        return None, AlignmentTarget(points=read_surface(options.surface, on_note=reporter.message), **common)
    ns = select_backend(options.mode, options.threads)
    reporter.progress(0.02, "tracing the place")
    place = (
        geometry.load_field_geometry(options.field, ns)
        if options.field is not None
        else geometry.load_scene_geometry(_path(options.scene))
    )
    for note in place.notes:
        reporter.message(f"of {options.field or options.scene}: {note}")
    assert place.medium is not None
    core = place.box.core
    traces = trace_scene(place.medium, np.array(core.lower), np.array(core.upper), seed=options.seed)
    return place, AlignmentTarget(traces=traces, **common)


def _turn(up: str | None) -> np.ndarray:
    """Rotation (4, 4) that takes the axis ``up`` of the place to z."""
    turn = np.eye(4)
    if up is None:
        return turn
    axis = np.array(_AXES.get(up.strip().lower()) or parse_point(up, "--up"), float)
    length = np.linalg.norm(axis)
    if length == 0:
        raise NergError(f"--up is an axis (x, y, z, -x, -y, -z) or three numbers x,y,z that are not all 0, got {up!r}")
    turn[:3, :3] = rotation_to_z(axis / length)
    return turn


def _sources(rays: Rays | str | Path | None, options: AlignOptions) -> dict[str, Path]:
    """The files that an alignment was found from, by what they are."""
    names = ("field", "scene", "surface", "pairs", "twin", "start")
    found = {n: path for n in names if (path := getattr(options, n)) is not None}
    if rays is not None and not isinstance(rays, Rays):
        found["rays"] = Path(rays)
    return found


def _identity(path: Path) -> dict[str, str]:
    return {"file": path.name, "sha256": file_sha256(path)}


def _refusal(fit: AlignmentFit, options: AlignOptions) -> str:
    """Why a fit is refused; empty where it is not."""
    if fit.mirrored is not None:
        return (
            f"the tracking is mirrored: {fit.mirrored}; import it again with the other --hand, or correct the axis "
            "that is negated in the evidence"
        )
    median = float(np.median(fit.residuals_cm)) if len(fit.residuals_cm) else 0.0
    if not median <= options.max_residual:
        return (
            f"the residual is {median:.3g} cm (median), beyond --max-residual {options.max_residual:g}: give other "
            "evidence, or a larger bound"
        )
    return ""


def _report_notes(fit: AlignmentFit, reporter: Reporter) -> None:
    for line in fit.notes:
        reporter.message(line)
    for line in fit.warnings:
        reporter.warn(line)


def _report_found(found: Alignment, reporter: Reporter) -> None:
    r, u = found.residuals, found.uncertainty
    parts = [
        f"{r[f'median_{unit}']:.2g} {unit} (95 %: {r[f'p95_{unit}']:.2g})"
        for unit in ("cm", "degrees")
        if r[f"median_{unit}"] is not None
    ]
    matrix = found.matrix
    reporter.message(f"residuals: {', '.join(parts)} (median); scale {Similarity(matrix).scale:.5g}")
    if u is not None:
        reporter.message(
            f"uncertainty (one standard deviation): {u['cm']:.2g} cm, {u['degrees']:.2g} degrees, "
            f"{u['scale_percent']:.2g} % of the scale"
        )


def _report_check(place: TrainingGeometry, rays: Rays, matrix: np.ndarray, reporter: Reporter) -> None:
    assert place.medium is not None
    check = check_alignment(place.medium, rays, Similarity(matrix))
    reporter.message(
        f"{100 * check.escaped:.1f} % of the gaze meets no surface, {100 * check.inside:.1f} % of the heads are inside "
        f"of something, {100 * check.below:.1f} % below the floor"
    )
    if check.mirrored is not None:
        reporter.warn(check.mirrored)


def _report_flips(points: np.ndarray, rays: Rays, matrix: np.ndarray, reporter: Reporter) -> None:
    flips = compare_flips(points, matrix, rays.origin, rays.direction, rays.head)
    median = float(np.median(flips.degrees[DECLARED]))
    reporter.message(f"the gaze passes {median:.2g} degrees from the nearest point of the place (median)")
    said = flips.warning()
    if said is not None:
        reporter.warn(said)


def _figure(fit: AlignmentFit, target: AlignmentTarget, heads: np.ndarray | None, found: Alignment):
    """Before and after, z up."""
    surface = None if target.traces is None and target.points is None else target.surface
    points = np.zeros((0, 3)) if fit.points is None else fit.points
    same = heads is not None and len(points) == len(heads) and np.array_equal(points, heads)
    median = found.residuals["median_cm"]
    said = "" if median is None else f", residual {median:.2g} cm (median)"
    return alignment_figure(
        None if surface is None else surface.points,
        points,
        None if same else heads,
        target.to_z_up @ found.matrix,
        None if fit.targets is None else transform_points(target.to_z_up, fit.targets),
        f"Aligned by {found.evidence['kind']}{said}",
        None if surface is None else _below_ceiling(surface.points),
    )


def _below_ceiling(points: np.ndarray) -> float:
    low, high = np.percentile(points[:, 2], [2, 98])
    return float(low + 0.75 * (high - low))
