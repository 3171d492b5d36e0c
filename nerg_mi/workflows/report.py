"""The report on a gaze field: its inputs, scores, pictures and surroundings, computed and written as HTML."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.errors import MissingFile, NergError, translate_mitsuba_errors, sanitize
from nerg_mi.evaluation.gaze_report import GazeResults, read_results
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.figures import maps, overlay
from nerg_mi.figures.overlay import Heat, OverlayLayers, Style, find_overlay, srgb, to_bytes, robust_max, unknown_mask
from nerg_mi.figures.sphere import sphere_figure
from nerg_mi.figures.style import Provenance, encode
from nerg_mi.figures.style import versions as programs
from nerg_mi.files.atomic import check_writable, file_sha256, write_text
from nerg_mi.files.images import encode_png
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.formats.areas import AreaSet, Region, read_areas
from nerg_mi.formats.fields import load_gaze
from nerg_mi.interruption import Interruption
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.rays.dataset import is_dataset, load_rays, hash_rays
from nerg_mi.rays.quality import summarise
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import Channels, render_channels
from nerg_mi.rendering.scene import load_scene
from nerg_mi.rendering.scene_writer import free_default_name, project_to_pixel
from nerg_mi.report.data import (
    MAX_PATH_POINTS,
    EyePositions,
    ParticipantLabels,
    ObjectAttention,
    GazeSampler,
    ReportCamera,
    ReportPicture,
    Run,
    Stage,
    summarize_objects,
    sample_eye_positions,
    assign_ray_hits,
    pack_stage,
    make_proxy,
    anonymize_rays,
    anonymize_results,
    farthest_point_sampling,
)
from nerg_mi.report.sections import render_page
from nerg_mi.statistics.shares import COARSE, gaze_shares
from nerg_mi.statistics.visits import MARGIN, BoxAoi
from nerg_mi.train.geometry import TrainingGeometry
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.observer import sensor_center

from .base import SILENT, Reporter, SilentReporter, select_backend, versions
from .evaluate import evaluate_gaze
from .gaze_commands import GazeEvaluationOptions
from .render import describe_basis, is_supported
from .scene import SceneResult, write_scene
from .scene_cameras import support_of_rays, to_scene_frame
from .scene_commands import ReportOptions, SceneOptions
from .scene_places import KINDS, PLACES, InputFiles, detect_kind, recognise

# ---- What the files are that a report is made of, found from the files themselves ----

RESULTS = "gaze.json"
"""The file of an evaluation that is read."""

_ROLES = {"field": "radiance field", "mesh": "mesh", "hits": "hit points", "scene": "scene"}


@dataclass(frozen=True)
class ReportFiles:
    """``scene``: the place and the gaze field, as a scene is written for; ``gaze``; ``rays``: file or dataset, or None;
    ``results``: files of evaluations."""

    scene: InputFiles
    gaze: Path
    rays: Path | None
    results: tuple[Path, ...]

    @property
    def shown(self) -> list[Path]:
        """What `nerg scene` is given."""
        return [self.gaze] if self.scene.place is None else [self.scene.place, self.gaze]

    def inputs(self) -> list[tuple[str, str, str]]:
        """Role, name and SHA-256 of each file."""
        out = [("gaze field", self.gaze.name, file_sha256(self.gaze))]
        if self.scene.place is not None:
            role = "splats" if self.scene.splats else _ROLES[self.scene.kind]
            out.append((role, self.scene.place.name, file_sha256(self.scene.place)))
        if self.rays is not None:
            out.append(("rays", self.rays.name, hash_rays(self.rays)))
        return out + [("evaluation", f"{p.parent.name}/{p.name}", file_sha256(p)) for p in self.results]


def sort_files(files: Sequence[Path]) -> ReportFiles:
    """What ``files`` are, in any order: a gaze field, its place (found beside it where it is not given), rays,
    evaluations (``gaze.json``, or the folder that holds one). Any other folder stands for what lies in it.

    Raises `NergError` for what does not make a report.
    """
    found: dict[str, Path] = {}
    results: list[Path] = []
    for path in _unfolded(files):
        if path.suffix.lower() == ".json":
            results.append(path)
            continue
        kind = "rays" if is_dataset(path) else detect_kind(path)
        role = "place" if kind in PLACES else kind
        if role in found and resolve_path(found[role]) != resolve_path(path):
            raise NergError(
                f'"{found[role]}" and "{path}" are both a {role}; a report is of one of them: name the files'
            )
        found.setdefault(role, path)
    if "gaze" not in found:
        raise NergError("a report is of a gaze field, and there is none among these files; name its checkpoint")
    shown = [found[role] for role in ("place", "gaze") if role in found]
    return ReportFiles(recognise(shown, None, SILENT), found["gaze"], found.get("rays"), tuple(results))


def _unfolded(files: Sequence[Path]) -> list[Path]:
    """``files`` with what lies in folders in place of these."""
    out: list[Path] = []
    for path in files:
        if not path.exists():
            raise MissingFile(f'there is no file or folder "{path}"; correct its name')
        if not path.is_dir() or is_dataset(path):
            out.append(path)
        elif (path / RESULTS).is_file():
            out.append(path / RESULTS)
        else:
            out += _within(path)
    return out


def _within(folder: Path) -> list[Path]:
    """What a folder holds of which a report is made, in the order of names: checkpoints, rays, evaluations."""
    found = sorted(folder.iterdir())
    kept = [p for p in found if p.suffix.lower() == ".safetensors" and p.is_file()]
    kept += [p for p in found if KINDS.get(p.suffix.lower()) == "rays" and (p.is_file() or is_dataset(p))]
    kept += [p / RESULTS for p in found if p.is_dir() and (p / RESULTS).is_file()]
    if not kept:
        raise NergError(f'the folder "{folder}" holds no checkpoint, rays or evaluation; name others')
    return kept


# ---- The pictures of a report ----


@dataclass(frozen=True, eq=False)
class RenderedViews:
    """What was rendered: ``seen`` from the "camera", the observer's "own" view and the "sphere"; ``marker``: pixel of
    the camera's picture at which the observer is; ``supported``: whether anybody was recorded around there; ``basis``:
    rays and people that the gaze rests on, in words."""

    seen: Mapping[str, Channels]
    marker: tuple[float, float] | None = None
    supported: bool = True
    basis: str = ""

    def layers(self, name: str, quantity: str = "gaze") -> OverlayLayers:
        """A ``quantity`` over the picture ``name``."""
        view, marker = self.seen[name], self.marker if name == "camera" else None
        return OverlayLayers(view.color, view.aovs[quantity], view.mask, marker, self.supported, self.basis)


def gaze_vmax(views: Mapping[str, Channels]) -> float | None:
    """One end of the scale (1/sr) for all pictures of gaze, so that a colour means the same in each; None where there
    is no gaze."""
    tops = [robust_max(v.aovs["gaze"], v.mask) for v in views.values() if np.any(v.aovs["gaze"][v.mask] > 0)]
    return max(tops) if tops else None


def draw_views(
    views: RenderedViews, top: float | None, place_known: bool, about: Provenance
) -> dict[str, ReportPicture]:
    """Colour and gaze from the camera, and the observer's own view and sphere, hatched where nothing is known;
    ``about``: what the header of each says."""
    out, text = {}, about.text()
    camera = views.seen["camera"]
    if place_known:
        out["color"] = ReportPicture(
            _png(srgb(camera.color), text), "The place in colour.", "The place, as the camera sees it."
        )
    if top is None:
        return out
    heat = Heat(top)
    hatched = lambda of: unknown_mask(of, True) if place_known or not of.supported else None

    def draw(name: str, title: str) -> bytes:
        of = views.layers(name)
        arrays = of.color, of.values, of.mask
        drawn = overlay.gaze_figure(*arrays, heat, title, marker=of.marker, unknown=hatched(of), note=of.support_note)
        return encode(drawn, ".png", text)

    if place_known:
        out["gaze"] = ReportPicture(
            draw("camera", "Where the observer looks"),
            "Gaze of the observer over the colours of the place.",
            "The observer's gaze on the place. What the observer cannot see has none.",
        )
        spread = camera.aovs.get("gaze_std")
        if spread is not None and np.any(spread[camera.mask] > 0):
            out["spread"] = _spread(views.layers("camera", "gaze_std"), text)
    out["own"] = ReportPicture(
        draw("own", "The observer's own view"), "Gaze in the observer's own view.", "What the observer sees ahead."
    )
    sphere = views.layers("sphere")
    arrays = sphere.color, sphere.values, sphere.mask
    drawn = sphere_figure(*arrays, heat, unknown=hatched(sphere), note=sphere.support_note)
    out["sphere"] = ReportPicture(
        encode(drawn, ".png", text),
        "Gaze in all directions around the observer.",
        "All that the observer could turn to.",
    )
    return out


def _spread(of: OverlayLayers, text: Mapping[str, str]) -> ReportPicture:
    spread = find_overlay("gaze_std")
    drawn = spread.draw(of, spread.limits(of), Style(colormap="viridis", title="Where the fields disagree"))
    return ReportPicture(
        encode(drawn, ".png", text),
        "Standard deviation of the gaze of the ensemble's members.",
        "How far the members of the ensemble are apart: where this is as large as the gaze itself, nothing is known.",
    )


def draw_rays(rays: Rays, test: Mapping[str, Any] | None, about: Provenance) -> dict[str, ReportPicture]:
    """Plans of the floor. ``test``: what was held out of the training; ``about``: what the header of each says."""
    plan = encode(maps.floor_plan(rays), ".png", about.text())
    held_out = {}
    words = "Each ray's place."
    if test and test.get("centres"):
        held_out = {"centres": np.array(test["centres"], float), "radius": float(test.get("radius", 0.25))}
        words += " Circles: positions that were held out of the training."
    layout = encode(maps.layout_figure(rays, title="Rays", **held_out), ".png", about.text())
    return {
        "plan": ReportPicture(plan, "Plan of how densely the floor is walked.", "How densely the floor is walked."),
        "layout": ReportPicture(layout, "Plan of the places of all rays.", words),
    }


def _png(display: np.ndarray, text: Mapping[str, str]) -> bytes:
    import mitsuba as mi

    return encode_png(mi.Bitmap(to_bytes(display)), text)


# ---- The evaluations that a report shows: those that were given, and those that are made for it ----


def read_matching_results(given: ReportFiles) -> tuple[list[GazeResults], list[str]]:
    """The evaluations that were given, and doubts about them. Raises `NergError` for those of another field."""
    found, doubts, own = [], [], file_sha256(given.gaze)
    for path in given.results:
        results = read_results(path)
        if results.sha256 and results.sha256 != own:
            raise NergError(f'"{path}" is an evaluation of another gaze field than "{given.gaze}"; leave it out')
        if not results.sha256 and results.gaze != given.gaze.name:
            doubts.append(
                f"An evaluation is of a field called {sanitize(results.gaze, 80)}; whether it is this one is not known."
            )
        found.append(results)
    splits = [r.split for r in found]
    twice = next((s for s in splits if splits.count(s) > 1), None)
    if twice is not None:
        raise NergError(f'two of the evaluations are of the split "{sanitize(twice, 40)}"; leave out one of them')
    return found, doubts


def compute_results(
    given: ReportFiles, options: ReportOptions, have: Sequence[GazeResults], reporter: Reporter
) -> list[GazeResults]:
    """Evaluations of the splits that there are and that nobody ``have``."""
    if given.rays is None:
        raise NergError("--evaluate scores the field on rays, and there are none; name the file that it was trained on")
    account = given.scene.about.get("test") or {}
    wanted = ("both", "pos", "people") if account.get("people") else ("pos",)
    place = {"field": "field", "scene": "scene", "hits": "geometry"}.get(given.scene.kind)
    where = {} if place is None else {place: given.scene.place}
    found = []
    for split in wanted:
        if split in {r.split for r in have}:
            continue
        more = {"threads": options.threads, "seed": options.seed, "mode": options.mode or "llvm_ad_rgb"}
        job = GazeEvaluationOptions(split=split, pictures=0, **where, **more)
        reporter.message(f"scoring the split {split}")
        scored = evaluate_gaze(given.gaze, given.rays, None, job, reporter)
        about = given.gaze.name, file_sha256(given.gaze), split, scored.positions, scored.people, job.kappa
        found.append(GazeResults(*about, tuple(scored.rows), tuple(scored.persons)))
    return found


# ---- Surroundings ----
#
# From where a report looks at its place: eyes of people, or, where nobody was recorded, places where people could
# stand; and their paths.


PANORAMAS = 8
"""Panoramas that the 3D scene is made of."""

# Cells along the longer side of the grid on which free places are looked for, and rays that look around each.
_CELLS, _AROUND = 14, 64
# A free place has nothing nearer than this share of the place's height at the eye's level.
_FREE = 0.1
# Nobody is followed over a longer pause, in seconds, or step, in metres.
_PAUSE, _STEP = 2.0, 2.0
# Edge of the cubes by which a path is drawn, in metres.
_STRIDE = 0.15


def panorama_positions(standing: np.ndarray, observer: np.ndarray, count: int = PANORAMAS) -> np.ndarray:
    """Up to ``count`` eyes (K, 3): the ``observer`` (3,), and of the places where people stand (N, 3) those that are
    farthest apart."""
    others = standing[farthest_point_sampling(standing, count - 1, first=observer)]
    return np.concatenate([np.asarray(observer, float)[None], others])


def find_free_positions(
    onlooker: GazeSampler, box: tuple[np.ndarray, np.ndarray], up: np.ndarray, observer: np.ndarray
) -> np.ndarray:
    """Places (N, 3) on the level of the ``observer`` (3,) within a ``box`` (lower and upper corner) where there is
    room, with surfaces in most directions: a grid of them."""
    lower, upper = (np.asarray(c, float) for c in box)
    level = int(np.argmax(np.abs(up)))
    edges = upper - lower
    step = float(np.delete(edges, level).max()) / _CELLS
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(lower, upper)]
    axes[level] = np.array([np.asarray(observer, float)[level]])
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    directions = fibonacci_directions(_AROUND)
    depth, met = onlooker.trace(np.repeat(grid, _AROUND, axis=0), np.tile(directions, (len(grid), 1)))
    depth, met = depth.reshape(-1, _AROUND), met.reshape(-1, _AROUND)
    near = np.where(met, depth, np.inf).min(axis=1)
    return grid[(near > _FREE * edges[level]) & (met.mean(axis=1) > 0.5)]


def count_participants_near(rays: Rays, eyes: np.ndarray, place: TrainingGeometry, radius: float) -> tuple[int, ...]:
    """How many people have a ray from within ``radius`` metres of each of the ``eyes`` (P, 3) of the place."""
    from scipy.spatial import KDTree

    found = KDTree(place.points_to_field(rays.origin)).query_ball_point(eyes, radius * place.align.scale)
    return tuple(len(np.unique(rays.person[rows])) for rows in found)


def collect_paths(rays: Rays, place: TrainingGeometry) -> list[np.ndarray]:
    """People's paths, (n, 3) each, in the coordinates of the place, with gaps where nobody was followed: of more than a
    page can hold evenly chosen ones."""
    parts = []
    for person in np.unique(rays.person):
        own = np.flatnonzero(rays.person == person)
        own = own[np.argsort(rays.t[own], kind="stable")]
        jump = np.diff(rays.t[own]) > _PAUSE
        jump |= np.linalg.norm(np.diff(rays.origin[own], axis=0), axis=1) > _STEP
        parts += [rows for rows in np.split(own, np.flatnonzero(jump) + 1) if len(rows) > 1]
    walked = [path for path in (_walked(rays.origin[rows]) for rows in parts) if len(path) > 1]
    total = sum(map(len, walked))
    if total > MAX_PATH_POINTS:
        # As many whole ones as fit if all are alike, and no more than fit.
        count = max(1, len(walked) * MAX_PATH_POINTS // total)
        walked = [walked[k] for k in np.linspace(0, len(walked) - 1, count).astype(int)]
        ends = np.cumsum([len(path) for path in walked])
        walked = [path for path, end in zip(walked, ends) if end <= MAX_PATH_POINTS] or [walked[0][:MAX_PATH_POINTS]]
    return [place.points_to_field(path) for path in walked]


def _walked(points: np.ndarray) -> np.ndarray:
    """Those of ``points`` (N, 3) of a path at which it enters another cube of edge `_STRIDE`: somebody who stands is
    one point."""
    cell = np.floor(points / _STRIDE)
    return points[np.r_[True, (cell[1:] != cell[:-1]).any(axis=1)]]


# ---- What a report says of its place, its observer and itself ----


def describe_scene(given: ReportFiles) -> str:
    """The place, in a sentence."""
    name = "" if given.scene.place is None else given.scene.place.name
    if given.scene.splats:
        return f"Gaussian splats, {name}."
    return {
        "field": f"A radiance field trained on photos, {name}.",
        "mesh": f"The mesh {name}.",
        "scene": f"The Mitsuba scene {name}.",
        "hits": f"No pictures of the place are at hand: it is made of what people looked at, {name}, in greys.",
        "none": "Nothing is known of the place: directions alone are shown.",
    }[given.scene.kind]


def describe_observer(scene: SceneResult, asked: bool) -> str:
    """The observer, in a sentence; ``asked``: whether somebody said where."""
    if scene.observer is None:
        return "The camera is the observer, for nothing says where people were."
    at = ", ".join(f"{v:.2f}" for v in scene.observer.origin)
    where = "where it was asked for" if asked else "where most rays are"
    return f"The observer stands {where}, at ({at})."


def describe_settings(options: ReportOptions) -> dict[str, str]:
    """What the report was made with, by what it is called."""
    return {
        "width": f"{options.width} pixels",
        "samples a pixel": str(options.spp),
        "seed": str(options.seed),
        "places looked from": f"{options.viewpoints} at most",
        "names of people": "shown" if options.show_names else "numbered",
        "fewest people of a share": str(options.min_participants),
    }


# ---- A report on a gaze field: one HTML file of its place, people, gaze, objects, scores, limits and provenance ----


VIEWS = ("camera", "own", "sphere")
"""The pictures, which are those of the written scene's sensors."""

OBSERVERS = 5
"""Observers whose gaze the 3D scene has."""

RAYS = 50_000
"""Rays of which it is found out what they end at, at most."""


@dataclass(frozen=True, eq=False)
class ReportResult:
    """``path`` of the report; ``run``: all that it shows."""

    path: Path
    run: Run


def make_report(
    files: Sequence[str | Path],
    output: str | Path,
    options: ReportOptions | None = None,
    reporter: Reporter = SILENT,
    rendered: Mapping[str, Channels] | None = None,
) -> ReportResult:
    """Write the report ``output`` (.html) of a gaze field, of which ``files`` are the checkpoint and, in any order,
    what there is besides: its place, rays, evaluations, or folders of these.

    The place is found beside the gaze field where it is not given. ``rendered``: pictures with the gaze of the observer
    that somebody has rendered already, of the "camera", of the observer's "own" view and of the "sphere"; they must be
    of the observer and the camera in ``options``. Raises `NergError` for what the user can mend.
    """
    options, output = options or ReportOptions(), Path(output)
    check_writable(output, ".html", ".htm")
    given = sort_files([Path(file) for file in files])
    areas = AreaSet(()) if options.aois is None else _objects(options.aois, reporter)
    results, doubts = read_results(given)
    ns = select_backend(options.mode, options.threads)
    if options.evaluate:
        results += compute_results(given, options, results, reporter)
    with Interruption() as stop:
        work = _ReportWork(given, ns, options, reporter, stop)
        run = work.run(areas, results, doubts, rendered)
    write_text(output, render_page(run))
    size = output.stat().st_size / 1e6
    for _, verdict in run.verdicts:
        reporter.message(verdict.sentence)
    if not run.results:
        reporter.message("no evaluation is at hand, so that the report has no verdict; --evaluate makes one of rays")
    reporter.message(f"wrote {output} ({size:.1f} MB)")
    return ReportResult(output, run)


class _ReportWork:
    """What is computed for a report, with what its parts have in common: the scene, the field, its place, the rays."""

    def __init__(
        self, given: ReportFiles, ns: ModuleType, options: ReportOptions, reporter: Reporter, stop: Interruption
    ):
        self.given, self.options, self.reporter, self.stop = given, options, reporter, stop
        self.field: AnyGazeField
        self.field, self.about = load_gaze(given.gaze, ns)
        reporter.progress(0.0, "reading")
        self.rays = None if given.rays is None else _load(given, given.rays)
        self.align = given.scene.align

    def run(
        self,
        areas: AreaSet,
        results: Sequence[GazeResults],
        doubts: Sequence[str],
        rendered: Mapping[str, Channels] | None,
    ) -> Run:
        """All that is shown."""
        import mitsuba as mi

        given, options = self.given, self.options
        labels = ParticipantLabels(self.rays, results)
        rays = self.rays if self.rays is None or options.show_names else anonymize_rays(self.rays, labels)
        hide = (lambda text: text) if options.show_names else labels.anonymize
        with tempfile.TemporaryDirectory() as folder:
            scene = self._scene(Path(folder))
            views = self._views(scene, rendered)
            place = self._place(scene)
            onlooker = GazeSampler(self.field, place, self._kind())
            eyes = self._eyes(place, scene)
            objects = observed = self._objects(areas, onlooker, place, eyes, self.rays)
            if self.rays is not None and options.observer is not None:
                observed = self._objects(areas, onlooker, place, self._observer(scene), None)
            top = gaze_vmax(views.seen)
            stage, sizes = self._stage(scene, onlooker, place, eyes, areas.boxes)
        known = given.scene.kind != "none"
        inputs = tuple((role, hide(name), digest) for role, name, digest in self._inputs())
        settings = describe_settings(options)
        about = Provenance("nerg report", {n: d for _, n, d in inputs}, options.seed, settings, programs())
        pictures: dict[str, ReportPicture] = draw_views(views, top, known, about)
        self._step(0.95, "writing")
        around: tuple[int, ...] = ()
        if rays is not None and self.rays is not None:
            test = given.scene.about.get("test")
            pictures |= draw_rays(rays, test if isinstance(test, dict) else None, about)
            radius = (given.scene.about.get("probes") or {}).get("radius")
            around = count_participants_near(self.rays, eyes.positions, place, radius if isinstance(radius, (int, float)) else 0.5)
        shown = results if options.show_names else [anonymize_results(r, labels) for r in results]
        return Run(
            options.title or hide(f"The gaze field “{given.gaze.stem}”"),
            self.about,
            hide(describe_scene(given)),
            given.scene.kind,
            given.scene.field_about,
            describe_observer(scene, options.observer is not None),
            rays,
            None if rays is None else summarise(rays),
            tuple(shown),
            tuple(doubts),
            objects,
            len(eyes.positions),
            options.min_participants,
            around,
            pictures,
            stage,
            *sizes,
            inputs,
            versions(str(mi.variant())),
            settings,
            views.basis,
            about.json(),
            observed,
        )

    def _inputs(self) -> list[tuple[str, str, str]]:
        found = self.given.inputs()
        if self.options.aois is not None:
            path = Path(self.options.aois)
            found.append(("objects", path.name, file_sha256(path)))
        return found

    def _step(self, share: float, text: str) -> None:
        self.stop.check()
        self.reporter.progress(share, text)

    def _kind(self) -> str:
        return self.given.scene.about.get("probes", {}).get("depth", "median")

    def _scene(self, folder: Path) -> SceneResult:
        """The scene of the place and the gaze field, in ``folder``."""
        self._step(0.05, "looking for a camera")
        o = self.options
        observer = o.observer
        if observer is None and self.rays is not None:
            observer = tuple(to_scene_frame(support_of_rays(self.rays).find_densest_position(), self.align).tolist())
        if observer is None and self.field.support is None and self.given.scene.kind != "none":
            self.reporter.message(
                "nothing says where people were: the camera is the observer; --observer x,y,z places one"
            )
        chosen = SceneOptions(
            observer=observer, camera=o.camera, target=o.target, fov=o.fov, width=o.width, mode=o.mode
        )
        return write_scene(self.given.shown, folder / "scene.xml", chosen, _Quiet(self.reporter))

    def _load(self, scene: SceneResult, **values: object):
        named = {free_default_name(name, scene.taken): str(value) for name, value in values.items()}
        return load_scene(scene.path, named)

    def _views(self, scene: SceneResult, rendered: Mapping[str, Channels] | None) -> RenderedViews:
        """The pictures of the camera, of the observer's own view and sphere, and what is known of the observer."""
        o = self.options
        spread = len(self.field.members) > 1
        aovs = "depth,opacity,gaze" + (",gaze_std" if spread else "")
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
        marker = None
        if scene.observer is not None:
            camera, width = loaded.sensors()[0], views["camera"].mask.shape[1]
            found = project_to_pixel(camera, sensor_center(loaded.sensors()[1]))
            share = width / camera.film().crop_size()[0]
            marker = None if found is None else tuple((v + 0.5) * share - 0.5 for v in found)
        return RenderedViews(views, marker, is_supported(loaded, loaded.sensors()[0]), describe_basis(loaded))

    def _place(self, scene: SceneResult) -> TrainingGeometry:
        """The place as the scene has it, in which depths are traced."""
        kind = self.given.scene.kind
        if kind == "none":
            return TrainingGeometry(None, self.field.box, kind, align=self.align)
        loaded = self._load(scene, radiance="false", aovs="opacity")
        return TrainingGeometry(SceneGeometry(loaded.integrator().medium, loaded), self.field.box, kind, align=self.align)

    def _eyes(self, place: TrainingGeometry, scene: SceneResult) -> EyePositions:
        """Where people stood, or where the observer is."""
        if self.rays is not None:
            return sample_eye_positions(self.rays, place, self.options.viewpoints)
        return self._observer(scene)

    def _observer(self, scene: SceneResult) -> EyePositions:
        at = scene.camera if scene.observer is None else scene.observer
        return EyePositions(np.asarray(at.origin, float)[None], np.zeros(1, int))

    def _objects(
        self, areas: AreaSet, onlooker: GazeSampler, place: TrainingGeometry, eyes: EyePositions, rays: Rays | None
    ) -> tuple[ObjectAttention, ...]:
        if not areas.box_indices or self.given.scene.kind == "none":
            return ()
        things, members = [BoxAoi(box) for box in areas.boxes], list(areas.box_indices.values())
        count, margin = len(eyes.positions), MARGIN * self.align.scale
        told = lambda done: self._step(0.55 + 0.2 * done / count, f"objects: place {done} of {count}")
        shares = gaze_shares(onlooker.query_from, eyes.positions, things, members, margin, COARSE, told)
        recorded = None
        if rays is not None:
            recorded = assign_ray_hits(rays, place, onlooker, RAYS, things, members, margin)
        return summarize_objects(list(areas.box_indices), shares, eyes.participant, recorded)

    def _stage(
        self, scene: SceneResult, onlooker: GazeSampler, place: TrainingGeometry, eyes: EyePositions, boxes: Sequence[Region]
    ) -> tuple[str | None, tuple[int, int, int, int]]:
        """The packed 3D scene, None where there are no surfaces, and how many observers, paths, points and boxes it
        has."""
        nothing = None, (0, 0, 0, 0)
        if self.given.scene.kind == "none":
            return nothing
        o, up = self.options, self._up()
        at = np.asarray((scene.observer or scene.camera).origin, float)
        standing = eyes.positions
        if self.rays is None:
            standing = np.concatenate([at[None], find_free_positions(onlooker, _corners(self.field.box), up, at)])
        loaded = self._load(scene, aovs="opacity,position")
        others = standing[farthest_point_sampling(standing, OBSERVERS - 1, first=at)] if self.rays is not None else at[None][:0]
        observers = np.concatenate([at[None], others])
        told = lambda done, total: self._step(0.75 + 0.15 * done / total, f"3D: panorama {done} of {total}")
        with translate_mitsuba_errors():
            looked_from = panorama_positions(standing, at)
            proxy = make_proxy(loaded, looked_from, up, observers, onlooker.density_at_points, o.max_points, on_panorama=told)
        if proxy is None:
            return nothing
        paths = collect_paths(self.rays, place) if self.rays is not None and o.paths else []
        camera = ReportCamera(np.asarray(scene.camera.origin, float), np.asarray(scene.camera.target, float))
        packed = pack_stage(Stage(proxy, observers, paths, boxes, up, camera))
        return packed, (len(observers), len(paths), len(proxy.vertices), len(boxes))

    def _up(self) -> np.ndarray:
        """Which way is up in the place: that of the rays."""
        return self.align.matrix[:3, 2] / self.align.scale


class _Quiet(SilentReporter):
    """Passes on only what may be wrong: the lines of a job within this one name files that nobody keeps."""

    def __init__(self, reporter: Reporter):
        self._reporter = reporter

    def warn(self, text: str) -> None:
        self._reporter.warn(text)


def _objects(path: Path, reporter: Reporter) -> AreaSet:
    areas = read_areas(path)
    if len(areas.box_indices) < len(areas.areas):
        reporter.warn(
            f"{len(areas.areas) - len(areas.box_indices)} of {len(areas.areas)} areas are no boxes and no groups of boxes, "
            "and a report leaves them out; nerg stats counts them"
        )
    return areas


def _load(given: ReportFiles, path: Path) -> Rays:
    """The rays; of a dataset the sample that the field was trained on."""
    trained = given.scene.about.get("rays_file", {})
    return load_rays(path, trained.get("most"), trained.get("seed", 0))


def _corners(box: AnyBox) -> tuple[np.ndarray, np.ndarray]:
    return np.array(box.core.lower, float), np.array(box.core.upper, float)
