"""The report on a gaze field: inputs, scores, figures and a 3D view, written as HTML."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.kinds import ENVIRONMENTS, KINDS, detect_kind
from nerg_mi.errors import MissingFile, NergError, parameter, sanitize, translate_mitsuba_errors
from nerg_mi.evaluation.gaze_report import GazeResults, read_results
from nerg_mi.fields.gaze_base import AnyGazeField, tracking_suffix
from nerg_mi.figures import maps, overlay
from nerg_mi.figures.overlay import Heat, OverlayLayers, Style, find_overlay, robust_max, srgb, to_bytes, unknown_mask
from nerg_mi.figures.sphere import sphere_figure
from nerg_mi.figures.style import Provenance, encode
from nerg_mi.figures.style import versions as programs
from nerg_mi.files.atomic import check_writable, file_sha256, write_text
from nerg_mi.files.html import element
from nerg_mi.files.images import encode_png
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.formats.areas import AreaSet, Region, read_areas
from nerg_mi.formats.fields import load_gaze
from nerg_mi.interruption import Interruption
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.measures.shares import COARSE, gaze_shares
from nerg_mi.measures.visits import MARGIN, BoxAoi
from nerg_mi.progress import SILENT, Reporter, SilentReporter
from nerg_mi.rays.dataset import hash_rays, is_dataset, load_rays
from nerg_mi.rays.quality import summarise
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import Channels, render_channels
from nerg_mi.rendering.scene import load_scene
from nerg_mi.rendering.scene_writer import free_default_name, project_to_pixel
from nerg_mi.reports.data import (
    MAX_PATH_POINTS,
    EyePositions,
    GazeSampler,
    ObjectAttention,
    ParticipantLabels,
    ReportCamera,
    ReportPicture,
    Run,
    Stage,
    anonymize_rays,
    anonymize_results,
    assign_ray_hits,
    farthest_point_sampling,
    make_proxy,
    pack_stage,
    sample_eye_positions,
    summarize_objects,
)
from nerg_mi.reports.sections import render_page
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.observer import sensor_center

from .base import select_backend, versions
from .evaluate import default_output, evaluate_gaze
from .gaze_commands import GazeEvaluationOptions
from .render import describe_basis, describe_smoothing, is_supported, smooth_gaze
from .scene import SceneResult, write_scene
from .scene_cameras import support_of_rays, to_scene_frame
from .scene_commands import ReportOptions, SceneOptions
from .scene_environments import InputFiles, recognise

# ---- Input files, recognised by their content ----

RESULTS = "gaze.json"
"""Name of the file with the results of an evaluation."""

_ROLES = {"field": "radiance field", "mesh": "mesh", "hits": "hit points", "scene": "scene"}


@dataclass(frozen=True)
class ReportFiles:
    """Input files of a report.

    ``scene`` holds the scene and the gaze field as `nerg scene` takes them; ``rays`` is a file, a dataset or None;
    ``results`` are files of evaluations.
    """

    scene: InputFiles
    gaze: Path
    rays: Path | None
    results: tuple[Path, ...]

    @property
    def shown(self) -> list[Path]:
        """Files for `nerg scene`."""
        return [self.gaze] if self.scene.environment is None else [self.scene.environment, self.gaze]

    def inputs(self) -> list[tuple[str, str, str]]:
        """Return role, name and SHA-256 of each file."""
        out = [("gaze field", self.gaze.name, file_sha256(self.gaze))]
        if self.scene.environment is not None:
            role = "splats" if self.scene.splats else _ROLES[self.scene.kind]
            out.append((role, self.scene.environment.name, file_sha256(self.scene.environment)))
        if self.rays is not None:
            out.append(("rays", self.rays.name, hash_rays(self.rays)))
        return out + [("evaluation", f"{p.parent.name}/{p.name}", file_sha256(p)) for p in self.results]


def sort_files(files: Sequence[Path]) -> ReportFiles:
    """Recognise ``files`` in any order: a gaze field, its scene, rays, and evaluations (``gaze.json``, or its folder).

    The scene is looked up next to the gaze field if it is not given. Other folders are replaced by the files in them.
    Raises `NergError` for files that do not make a report.
    """
    by_role: dict[str, Path] = {}
    results: list[Path] = []
    for path in _expand_folders(files):
        if path.suffix.lower() == ".json":
            results.append(path)
            continue
        kind = "rays" if is_dataset(path) else detect_kind(path)
        role = "environment" if kind in ENVIRONMENTS else kind
        if role in by_role and resolve_path(by_role[role]) != resolve_path(path):
            raise NergError(f'"{by_role[role]}" and "{path}" are both a {role}, and a report takes one; name the files')
        by_role.setdefault(role, path)
    if "gaze" not in by_role:
        raise NergError("a report needs a gaze field, and there is none among these files; name its checkpoint")
    shown = [by_role[role] for role in ("environment", "gaze") if role in by_role]
    return ReportFiles(recognise(shown, None, SILENT), by_role["gaze"], by_role.get("rays"), tuple(results))


def _expand_folders(files: Sequence[Path]) -> list[Path]:
    """Return ``files`` with folders replaced by the files in them."""
    out: list[Path] = []
    for path in files:
        if not path.exists():
            raise MissingFile(f'there is no file or folder "{path}"; correct its name')
        if not path.is_dir() or is_dataset(path):
            out.append(path)
        elif (path / RESULTS).is_file():
            out.append(path / RESULTS)
        else:
            out += _list_inputs(path)
    return out


def _list_inputs(folder: Path) -> list[Path]:
    """Return checkpoints, rays and evaluations in a folder, sorted by name."""
    entries = sorted(folder.iterdir())
    selected = [p for p in entries if p.suffix.lower() == ".safetensors" and p.is_file()]
    selected += [p for p in entries if KINDS.get(p.suffix.lower()) == "rays" and (p.is_file() or is_dataset(p))]
    selected += [p / RESULTS for p in entries if p.is_dir() and (p / RESULTS).is_file()]
    if not selected:
        raise NergError(f'the folder "{folder}" contains no checkpoint, rays or evaluation; name another one')
    return selected


# ---- Images of a report ----


@dataclass(frozen=True, eq=False)
class RenderedViews:
    """Rendered images.

    Attributes
    ----------
    images
        Images of the "camera", the observer's "own" view and the "sphere".
    marker
        Pixel of the observer in the camera's image.
    supported
        Whether rays were recorded around the observer.
    basis
        Description of the data behind the gaze.
    """

    images: Mapping[str, Channels]
    marker: tuple[float, float] | None = None
    supported: bool = True
    basis: str = ""

    def layers(self, name: str, quantity: str = "gaze") -> OverlayLayers:
        """Return a ``quantity`` over the image ``name``."""
        view, marker = self.images[name], self.marker if name == "camera" else None
        is_smoothed = quantity == "gaze" and name != "sphere"
        basis = describe_smoothing(self.basis) if is_smoothed else self.basis
        return OverlayLayers(view.color, view.aovs[quantity], view.mask, marker, self.supported, basis)


def gaze_vmax(views: Mapping[str, Channels]) -> float | None:
    """Return the upper end of the common colour scale (1/sr) of all images of gaze; None if there is no gaze."""
    tops = [robust_max(v.aovs["gaze"], v.mask) for v in views.values() if np.any(v.aovs["gaze"][v.mask] > 0)]
    return max(tops) if tops else None


def draw_views(
    views: RenderedViews, top: float | None, has_geometry: bool, record: Provenance
) -> dict[str, ReportPicture]:
    """Draw colour and gaze from the camera, and the observer's view and sphere, hatched where the gaze is unknown.

    ``record`` is the provenance for image headers.
    """
    out, text = {}, record.text()
    camera = views.images["camera"]
    if has_geometry:
        out["color"] = ReportPicture(
            _png(srgb(camera.color), text), "The scene in colour.", "The scene from the camera."
        )
    if top is None:
        return out
    heat = Heat(top)
    hatched = lambda values: unknown_mask(values, True) if has_geometry or not values.has_support else None

    def draw(name: str, title: str) -> bytes:
        layers = views.layers(name)
        arrays = layers.color, layers.values, layers.mask
        drawn = overlay.gaze_figure(
            *arrays, heat, title, marker=layers.marker, unknown=hatched(layers), note=layers.support_note
        )
        return encode(drawn, ".png", text)

    if has_geometry:
        out["gaze"] = ReportPicture(
            draw("camera", "Where the observer looks"),
            "Gaze of the observer over the colours of the scene.",
            "The observer's gaze on the scene. There is none where the observer's view is occluded.",
        )
        spread = camera.aovs.get("gaze_std")
        if spread is not None and np.any(spread[camera.mask] > 0):
            out["spread"] = _spread(views.layers("camera", "gaze_std"), text)
    out["own"] = ReportPicture(
        draw("own", "The observer's own view"), "Gaze in the observer's own view.", "The view straight ahead."
    )
    sphere = views.layers("sphere")
    arrays = sphere.color, sphere.values, sphere.mask
    drawn = sphere_figure(*arrays, heat, unknown=hatched(sphere), note=sphere.support_note)
    out["sphere"] = ReportPicture(
        encode(drawn, ".png", text),
        "Gaze in all directions around the observer.",
        "All directions that the observer could turn to.",
    )
    return out


def _spread(layers: OverlayLayers, text: Mapping[str, str]) -> ReportPicture:
    spread = find_overlay("gaze_std")
    drawn = spread.draw(layers, spread.limits(layers), Style(colormap="viridis", title="Disagreement of the ensemble"))
    return ReportPicture(
        encode(drawn, ".png", text),
        "Standard deviation of the gaze of the ensemble's members.",
        "Standard deviation of the ensemble members: where it is as large as the gaze itself, the gaze is unknown.",
    )


def draw_rays(rays: Rays, test: Mapping[str, Any] | None, record: Provenance) -> dict[str, ReportPicture]:
    """Draw floor plans. ``test`` describes the held-out data; ``record`` is the provenance for image headers."""
    plan = encode(maps.floor_plan(rays), ".png", record.text())
    held_out = {}
    words = "Position of each ray."
    if test and test.get("centres"):
        held_out = {"centres": np.array(test["centres"], float), "radius": float(test.get("radius", 0.25))}
        words += " Circles: held-out positions."
    layout = encode(maps.layout_figure(rays, title="Rays", **held_out), ".png", record.text())
    return {
        "plan": ReportPicture(plan, "Plan of the density of recorded positions.", "Density of recorded positions."),
        "layout": ReportPicture(layout, "Plan of the positions of all rays.", words),
    }


def _png(display: np.ndarray, text: Mapping[str, str]) -> bytes:
    import mitsuba as mi

    return encode_png(mi.Bitmap(to_bytes(display)), text)


# ---- Evaluations: given files, and those that are computed ----


def read_matching_results(files: ReportFiles) -> tuple[list[GazeResults], list[str]]:
    """Read the given evaluations; return them with warnings. Raises `NergError` for those of another field."""
    evaluations, doubts, gaze_sha256 = [], [], file_sha256(files.gaze)
    for path in files.results:
        results = read_results(path)
        if results.sha256 and results.sha256 != gaze_sha256:
            raise NergError(f'"{path}" is an evaluation of a gaze field other than "{files.gaze}"; leave it out')
        if not results.sha256 and results.gaze != files.gaze.name:
            doubts.append(f"An evaluation is of a field named {sanitize(results.gaze, 80)}, which may be another one.")
        evaluations.append(results)
    splits = [r.split for r in evaluations]
    twice = next((s for s in splits if splits.count(s) > 1), None)
    if twice is not None:
        raise NergError(f'two evaluations are of the split "{sanitize(twice, 40)}"; leave out one of them')
    return evaluations, doubts


def _find_results(gaze: Path, reporter: Reporter) -> tuple[Path, ...]:
    """Return the evaluation that `nerg eval gaze` has written next to the checkpoint ``gaze``, if it is of this one."""
    path = default_output(gaze) / RESULTS
    if not path.is_file():
        return ()
    if read_results(path).sha256 not in ("", file_sha256(gaze)):
        reporter.warn(f'"{path}" is not used: "{gaze.name}" was trained again since; run nerg eval gaze')
        return ()
    reporter.message(f"the evaluation is {path}")
    return (path,)


def compute_results(
    files: ReportFiles, options: ReportOptions, have: Sequence[GazeResults], reporter: Reporter
) -> list[GazeResults]:
    """Compute the evaluations of the splits that are not in ``have``."""
    if files.rays is None:
        raise NergError(f"{parameter('evaluate', True)} needs the rays of the training; name their file")
    account = files.scene.gaze_provenance.get("test") or {}
    splits = ("both", "pos", "people") if account.get("people") else ("pos",)
    environment = {"field": "field", "scene": "scene", "hits": "geometry"}.get(files.scene.kind)
    where = {} if environment is None else {environment: files.scene.environment}
    evaluations = []
    for split in splits:
        if split in {r.split for r in have}:
            continue
        common = {"threads": options.threads, "seed": options.seed, "mode": options.mode or "llvm_ad_rgb"}
        job = GazeEvaluationOptions(split=split, pictures=0, **where, **common)
        reporter.message(f"scoring the split {split}")
        scored = evaluate_gaze(files.gaze, files.rays, None, job, reporter)
        identity = files.gaze.name, file_sha256(files.gaze), split, scored.positions, scored.people, job.kappa
        evaluations.append(GazeResults(*identity, tuple(scored.rows), tuple(scored.persons), scored.split_half_note))
    return evaluations


# ---- Viewpoints and paths ----
#
# The viewpoints of a report are recorded positions or, without rays, free positions in the scene.


PANORAMAS = 8
"""Number of panoramas from which the 3D view is built."""

# Grid cells along the longer side when looking for free positions, and rays around each position.
_CELLS, _AROUND = 14, 64
# Minimum distance of a free position to surfaces, as a fraction of the scene's height.
_FREE = 0.1
# A path is interrupted by a longer pause, in seconds, or a longer step, in metres.
_PAUSE, _STEP = 2.0, 2.0
# Resolution of drawn paths in metres.
_STRIDE = 0.15


def panorama_positions(standing: np.ndarray, observer: np.ndarray, count: int = PANORAMAS) -> np.ndarray:
    """Return up to ``count`` viewpoints (K, 3): the ``observer`` (3,), and those of ``standing`` (N, 3) that are
    farthest apart."""
    farthest = standing[farthest_point_sampling(standing, count - 1, first=observer)]
    return np.concatenate([np.asarray(observer, float)[None], farthest])


def find_free_positions(
    sampler: GazeSampler, box: tuple[np.ndarray, np.ndarray], up: np.ndarray, observer: np.ndarray
) -> np.ndarray:
    """Return free positions (N, 3) on a grid at the height of the ``observer`` (3,) within a ``box``.

    A position is free if it is far enough from surfaces, and if there are surfaces in most directions.
    """
    lower, upper = (np.asarray(c, float) for c in box)
    level = int(np.argmax(np.abs(up)))
    edges = upper - lower
    step = float(np.delete(edges, level).max()) / _CELLS
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(lower, upper)]
    axes[level] = np.array([np.asarray(observer, float)[level]])
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    directions = fibonacci_directions(_AROUND)
    depth, hit = sampler.trace(np.repeat(grid, _AROUND, axis=0), np.tile(directions, (len(grid), 1)))
    depth, hit = depth.reshape(-1, _AROUND), hit.reshape(-1, _AROUND)
    near = np.where(hit, depth, np.inf).min(axis=1)
    return grid[(near > _FREE * edges[level]) & (hit.mean(axis=1) > 0.5)]


def count_participants_near(
    rays: Rays, viewpoints: np.ndarray, environment: Environment, radius: float
) -> tuple[int, ...]:
    """Count the participants with a ray within ``radius`` metres of each of the ``viewpoints`` (P, 3)."""
    from scipy.spatial import KDTree

    neighbours = KDTree(environment.points_to_field(rays.origin)).query_ball_point(
        viewpoints, radius * environment.align.scale
    )
    return tuple(len(np.unique(rays.person[rows])) for rows in neighbours)


def collect_paths(rays: Rays, environment: Environment) -> list[np.ndarray]:
    """Return the paths of participants, (n, 3) each, in scene coordinates, interrupted where there are no rays.

    If there are more than a page can hold, evenly selected ones are returned.
    """
    parts = []
    for person in np.unique(rays.person):
        person_rows = np.flatnonzero(rays.person == person)
        person_rows = person_rows[np.argsort(rays.t[person_rows], kind="stable")]
        jump = np.diff(rays.t[person_rows]) > _PAUSE
        jump |= np.linalg.norm(np.diff(rays.origin[person_rows], axis=0), axis=1) > _STEP
        parts += [rows for rows in np.split(person_rows, np.flatnonzero(jump) + 1) if len(rows) > 1]
    walked = [path for path in (_simplify_path(rays.origin[rows]) for rows in parts) if len(path) > 1]
    total = sum(map(len, walked))
    if total > MAX_PATH_POINTS:
        # Evenly selected paths, and no more than fit.
        count = max(1, len(walked) * MAX_PATH_POINTS // total)
        walked = [walked[k] for k in np.linspace(0, len(walked) - 1, count).astype(int)]
        ends = np.cumsum([len(path) for path in walked])
        walked = [path for path, end in zip(walked, ends) if end <= MAX_PATH_POINTS] or [walked[0][:MAX_PATH_POINTS]]
    return [environment.points_to_field(path) for path in walked]


def _simplify_path(points: np.ndarray) -> np.ndarray:
    """Return those of ``points`` (N, 3) at which a path enters another cube of edge `_STRIDE`."""
    cell = np.floor(points / _STRIDE)
    return points[np.r_[True, (cell[1:] != cell[:-1]).any(axis=1)]]


# ---- Texts on the scene, the observer and the settings ----


def describe_scene(files: ReportFiles) -> str:
    """Describe the scene in a sentence."""
    name = "" if files.scene.environment is None else files.scene.environment.name
    if files.scene.splats:
        return f"Gaussian splats, {name}."
    return {
        "field": f"A radiance field trained on photos, {name}.",
        "mesh": f"The mesh {name}.",
        "scene": f"The Mitsuba scene {name}.",
        "hits": f"The scene consists of the hit points of rays, {name}, in grey; there are no photos of it.",
        "none": "There is no geometry: only directions are shown.",
    }[files.scene.kind]


def describe_observer(scene: SceneResult, is_given: bool) -> str:
    """Describe the observer in a sentence; ``is_given`` tells whether its position was given."""
    if scene.observer is None:
        return "The camera is the observer, because no recorded positions are known."
    at = ", ".join(f"{v:.2f}" for v in scene.observer.origin)
    where = "at the given position" if is_given else "where the density of rays is highest"
    return f"The observer is {where}, ({at})."


def describe_settings(options: ReportOptions) -> dict[str, str]:
    """Return the settings of the report by their names."""
    return {
        "width": f"{options.width} pixels",
        "samples per pixel": str(options.spp),
        "seed": str(options.seed),
        "viewpoints": f"at most {options.viewpoints}",
        "names of participants": "shown" if options.show_names else "numbered",
        "minimum number of participants": str(options.min_participants),
    }


# ---- The report ----


VIEWS = ("camera", "own", "sphere")
"""Names of the images of the sensors of the written scene."""

OBSERVERS = 5
"""Number of observers with gaze in the 3D view."""

RAYS = 50_000
"""Maximum number of rays whose hits are assigned to AOIs."""


@dataclass(frozen=True, eq=False)
class ReportResult:
    """``path`` of the report; ``run`` is its content."""

    path: Path
    run: Run

    def __repr__(self) -> str:
        return f'<ReportResult: "{self.run.title}", {self.path}>'

    def _repr_html_(self) -> str:
        """The report in a frame, for notebooks."""
        return element("iframe", srcdoc=render_page(self.run), width="100%", height=800)


def make_report(
    files: Sequence[str | Path],
    output: str | Path,
    options: ReportOptions | None = None,
    reporter: Reporter = SILENT,
    rendered: Mapping[str, Channels] | None = None,
) -> ReportResult:
    """Write the report ``output`` (.html) on a gaze field.

    Parameters
    ----------
    files
        The gaze field and, in any order, its scene, rays and evaluations, or folders of these. The scene and the
        evaluation are looked up next to the gaze field if they are not given.
    output
        HTML file.
    options
        Content of the report.
    reporter
        Receives messages and progress.
    rendered
        Images that have been rendered already, for the observer and camera of ``options``: "camera", "own" and
        "sphere".

    Raises
    ------
    NergError
        For errors that the user can correct.
    """
    options, output = options or ReportOptions(), Path(output)
    check_writable(output, ".html", ".htm")
    report_files = sort_files([Path(file) for file in files])
    if not report_files.results:
        report_files = replace(report_files, results=_find_results(report_files.gaze, reporter))
    areas = AreaSet(()) if options.aois is None else _load_aois(options.aois, reporter)
    results, doubts = read_matching_results(report_files)
    ns = select_backend(options.mode, options.threads)
    if options.evaluate:
        results += compute_results(report_files, options, results, reporter)
    with Interruption() as stop:
        work = _ReportWork(report_files, ns, options, reporter, stop)
        run = work.run(areas, results, doubts, rendered)
    write_text(output, render_page(run))
    size = output.stat().st_size / 1e6
    for _, verdict in run.verdicts:
        reporter.message(verdict.sentence)
    if not run.results:
        reporter.message(
            f"there is no evaluation, so the report has no verdict; add {parameter('evaluate', True)} to compute "
            "one from rays"
        )
    reporter.message(f"wrote {output} ({size:.1f} MB)")
    return ReportResult(output, run)


class _ReportWork:
    """Computes the content of a report, with shared scene, field, geometry and rays."""

    def __init__(
        self, files: ReportFiles, ns: ModuleType, options: ReportOptions, reporter: Reporter, stop: Interruption
    ):
        self.files, self.options, self.reporter, self.stop = files, options, reporter, stop
        self.field: AnyGazeField
        self.field, self.metadata = load_gaze(files.gaze, ns)
        reporter.progress(0.0, "reading")
        self.rays = None if files.rays is None else _load(files, files.rays)
        self.align = files.scene.align

    def run(
        self,
        areas: AreaSet,
        results: Sequence[GazeResults],
        doubts: Sequence[str],
        rendered: Mapping[str, Channels] | None,
    ) -> Run:
        """Compute all content."""
        import mitsuba as mi

        files, options = self.files, self.options
        labels = ParticipantLabels(self.rays, results)
        rays = self.rays if self.rays is None or options.show_names else anonymize_rays(self.rays, labels)
        hide = (lambda text: text) if options.show_names else labels.anonymize
        with tempfile.TemporaryDirectory() as folder:
            scene = self._scene(Path(folder))
            views = self._views(scene, rendered)
            environment = self._environment(scene)
            sampler = GazeSampler(self.field, environment, self._kind())
            viewpoints = self._viewpoints(environment, scene)
            # The observer was reported with the scene.
            if not sampler.describe_extrapolation(self._observer(scene).positions):
                if sentence := sampler.describe_extrapolation(viewpoints.positions):
                    self.reporter.warn(sentence)
            objects = observed = self._aoi_attention(areas, sampler, environment, viewpoints, self.rays)
            if self.rays is not None and options.observer is not None:
                observed = self._aoi_attention(areas, sampler, environment, self._observer(scene), None)
            top = gaze_vmax(views.images)
            stage, sizes = self._stage(scene, sampler, environment, viewpoints, areas.boxes)
        has_geometry = files.scene.kind != "none"
        inputs = tuple((role, hide(name), digest) for role, name, digest in self._inputs())
        settings = describe_settings(options)
        record = Provenance("nerg report", {n: d for _, n, d in inputs}, options.seed, settings, programs())
        pictures: dict[str, ReportPicture] = draw_views(views, top, has_geometry, record)
        self._step(0.95, "writing")
        participants_near: tuple[int, ...] = ()
        if rays is not None and self.rays is not None:
            test = files.scene.gaze_provenance.get("test")
            pictures |= draw_rays(rays, test if isinstance(test, dict) else None, record)
            radius = (files.scene.gaze_provenance.get("probes") or {}).get("radius")
            participants_near = count_participants_near(
                self.rays, viewpoints.positions, environment, radius if isinstance(radius, (int, float)) else 0.5
            )
        shown = results if options.show_names else [anonymize_results(r, labels) for r in results]
        return Run(
            options.title or hide(f"The gaze field “{files.gaze.stem}”{tracking_suffix(files.scene.gaze_provenance)}"),
            self.metadata,
            hide(describe_scene(files)),
            files.scene.kind,
            files.scene.field_metadata,
            describe_observer(scene, options.observer is not None),
            rays,
            None if rays is None else summarise(rays),
            tuple(shown),
            tuple(doubts),
            objects,
            len(viewpoints.positions),
            options.min_participants,
            participants_near,
            pictures,
            stage,
            *sizes,
            inputs,
            versions(str(mi.variant())),
            settings,
            views.basis,
            record.json(),
            observed,
        )

    def _inputs(self) -> list[tuple[str, str, str]]:
        inputs = self.files.inputs()
        if self.options.aois is not None:
            path = Path(self.options.aois)
            inputs.append(("objects", path.name, file_sha256(path)))
        return inputs

    def _step(self, share: float, text: str) -> None:
        self.stop.check()
        self.reporter.progress(share, text)

    def _kind(self) -> str:
        return self.files.scene.gaze_provenance.get("probes", {}).get("depth", "median")

    def _scene(self, folder: Path) -> SceneResult:
        """Write the scene of the geometry and the gaze field to ``folder``."""
        self._step(0.05, "looking for a camera")
        o = self.options
        observer = o.observer
        if observer is None and self.rays is not None:
            observer = tuple(to_scene_frame(support_of_rays(self.rays).find_densest_position(), self.align).tolist())
        if observer is None and self.field.support is None and self.files.scene.kind != "none":
            self.reporter.message(
                "no recorded positions are known: the camera is the observer; use "
                f"{parameter('observer', 'x,y,z')} to place one"
            )
        scene_options = SceneOptions(
            observer=observer, camera=o.camera, target=o.target, fov=o.fov, width=o.width, mode=o.mode
        )
        return write_scene(self.files.shown, folder / "scene.xml", scene_options, _Quiet(self.reporter))

    def _load(self, scene: SceneResult, **values: object):
        named = {free_default_name(name, scene.taken): str(value) for name, value in values.items()}
        return load_scene(scene.path, named)

    def _views(self, scene: SceneResult, rendered: Mapping[str, Channels] | None) -> RenderedViews:
        """Render the camera, the observer's view and the sphere."""
        o = self.options
        spread = len(self.field.members) > 1
        aovs = "depth,opacity,gaze,visibility" + (",gaze_std" if spread else "")
        loaded = self._load(scene, aovs=aovs, sphere_width=o.width, sphere_height=o.width // 2)
        views = dict(rendered or {})
        for number, name in enumerate(VIEWS):
            if name in views:
                continue
            self._step(0.2 + 0.12 * number, f"rendering: {name}")
            with translate_mitsuba_errors():
                views[name] = render_channels(
                    loaded, loaded.sensors()[number], o.spp, o.seed, lambda done, total: self.stop.check()
                )
        views = {name: smooth_gaze(views[name], loaded, loaded.sensors()[number]) for number, name in enumerate(VIEWS)}
        marker = None
        if scene.observer is not None:
            camera, width = loaded.sensors()[0], views["camera"].mask.shape[1]
            pixel = project_to_pixel(camera, sensor_center(loaded.sensors()[1]))
            share = width / camera.film().crop_size()[0]
            marker = None if pixel is None else tuple((v + 0.5) * share - 0.5 for v in pixel)
        return RenderedViews(views, marker, is_supported(loaded, loaded.sensors()[0]), describe_basis(loaded))

    def _environment(self, scene: SceneResult) -> Environment:
        """Return the geometry of the scene, in which depths are traced."""
        kind = self.files.scene.kind
        if kind == "none":
            return Environment(None, self.field.box, kind, align=self.align)
        loaded = self._load(scene, radiance="false", aovs="opacity")
        return Environment(SceneGeometry(loaded.integrator().medium, loaded), self.field.box, kind, align=self.align)

    def _viewpoints(self, environment: Environment, scene: SceneResult) -> EyePositions:
        """Return recorded positions, or that of the observer."""
        if self.rays is not None:
            return sample_eye_positions(self.rays, environment, self.options.viewpoints)
        return self._observer(scene)

    def _observer(self, scene: SceneResult) -> EyePositions:
        at = scene.camera if scene.observer is None else scene.observer
        return EyePositions(np.asarray(at.origin, float)[None], np.zeros(1, int))

    def _aoi_attention(
        self,
        areas: AreaSet,
        sampler: GazeSampler,
        environment: Environment,
        viewpoints: EyePositions,
        rays: Rays | None,
    ) -> tuple[ObjectAttention, ...]:
        if not areas.box_indices or self.files.scene.kind == "none":
            return ()
        boxes, members = [BoxAoi(box) for box in areas.boxes], list(areas.box_indices.values())
        count, margin = len(viewpoints.positions), MARGIN * self.align.scale
        report_viewpoint = lambda done: self._step(0.55 + 0.2 * done / count, f"AOIs: viewpoint {done} of {count}")
        shares = gaze_shares(sampler.query_from, viewpoints.positions, boxes, members, margin, COARSE, report_viewpoint)
        recorded = None
        if rays is not None:
            recorded = assign_ray_hits(rays, environment, sampler, RAYS, boxes, members, margin)
        return summarize_objects(list(areas.box_indices), shares, viewpoints.participant, recorded)

    def _stage(
        self,
        scene: SceneResult,
        sampler: GazeSampler,
        environment: Environment,
        viewpoints: EyePositions,
        boxes: Sequence[Region],
    ) -> tuple[str | None, tuple[int, int, int, int]]:
        """Return the packed 3D view, None if there are no surfaces, and its numbers of observers, paths, points and
        boxes."""
        empty = None, (0, 0, 0, 0)
        if self.files.scene.kind == "none":
            return empty
        o, up = self.options, self._up()
        at = np.asarray((scene.observer or scene.camera).origin, float)
        standing = viewpoints.positions
        if self.rays is None:
            standing = np.concatenate([at[None], find_free_positions(sampler, _corners(self.field.box), up, at)])
        loaded = self._load(scene, aovs="opacity,position")
        farthest = (
            standing[farthest_point_sampling(standing, OBSERVERS - 1, first=at)]
            if self.rays is not None
            else at[None][:0]
        )
        observers = np.concatenate([at[None], farthest])
        report_panorama = lambda done, total: self._step(0.75 + 0.15 * done / total, f"3D: panorama {done} of {total}")
        with translate_mitsuba_errors():
            panorama_origins = panorama_positions(standing, at)
            proxy = make_proxy(
                loaded,
                panorama_origins,
                up,
                observers,
                sampler.density_at_points,
                o.max_points,
                on_panorama=report_panorama,
            )
        if proxy is None:
            return empty
        paths = collect_paths(self.rays, environment) if self.rays is not None and o.paths else []
        camera = ReportCamera(np.asarray(scene.camera.origin, float), np.asarray(scene.camera.target, float))
        packed = pack_stage(Stage(proxy, observers, paths, boxes, up, camera))
        return packed, (len(observers), len(paths), len(proxy.vertices), len(boxes))

    def _up(self) -> np.ndarray:
        """Return the up direction of the scene, which is that of the rays."""
        return self.align.matrix[:3, 2] / self.align.scale


class _Quiet(SilentReporter):
    """Passes on warnings only: messages would name temporary files."""

    def __init__(self, reporter: Reporter):
        self._reporter = reporter

    def warn(self, text: str) -> None:
        self._reporter.warn(text)


def _load_aois(path: Path, reporter: Reporter) -> AreaSet:
    areas = read_areas(path)
    if len(areas.box_indices) < len(areas.areas):
        reporter.warn(
            f"{len(areas.areas) - len(areas.box_indices)} of {len(areas.areas)} AOIs are not boxes or groups of "
            "boxes and are left out of the report; nerg stats supports them"
        )
    return areas


def _load(files: ReportFiles, path: Path) -> Rays:
    """Load the rays; from a dataset, the sample of the training."""
    trained = files.scene.gaze_provenance.get("rays_file", {})
    return load_rays(path, trained.get("most"), trained.get("seed", 0))


def _corners(box: AnyBox) -> tuple[np.ndarray, np.ndarray]:
    return np.array(box.core.lower, float), np.array(box.core.upper, float)
