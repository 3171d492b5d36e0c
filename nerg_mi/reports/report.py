"""The report on a gaze field: inputs, scores, figures and a 3D view, as HTML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from nerg_mi.aoi.areas import AnyAreas, Areas
from nerg_mi.aoi.placed import MARGIN, BoxAoi
from nerg_mi.aoi.shares import COARSE, gaze_shares
from nerg_mi.environment.bands import Channels, render_channels
from nerg_mi.environment.environment import Environment
from nerg_mi.environment.gaze import read_training_alignment
from nerg_mi.environment.observers import ObserverChoice, support_of_rays, to_scene_frame
from nerg_mi.environment.sampler import GazeSampler
from nerg_mi.environment.scene_cameras import CameraChoice
from nerg_mi.environment.scene_file import PlacedScene, open_shown, place_scene
from nerg_mi.environment.scene_loading import activate_mitsuba, list_library_versions
from nerg_mi.environment.scene_writer import project_to_pixel
from nerg_mi.errors import parameter, translate_mitsuba_errors
from nerg_mi.evaluation.gaze_report import GazeResults
from nerg_mi.fields.gaze_base import tracking_suffix
from nerg_mi.figures.layers import describe_basis, is_supported, smooth_gaze
from nerg_mi.figures.style import Provenance
from nerg_mi.figures.style import versions as programs
from nerg_mi.files.atomic import check_writable, file_sha256, write_text
from nerg_mi.files.html import element
from nerg_mi.files.values import FilePath, hash_arrays
from nerg_mi.formats.boxes import Region
from nerg_mi.interruption import Interruption
from nerg_mi.progress import Progress, Reporter, SilentReporter, open_reporter
from nerg_mi.ranges import COORDINATES, FIELDS_OF_VIEW, SEEDS, SPP, Range, check_ranges
from nerg_mi.tracking.dataset import hash_rays
from nerg_mi.tracking.quality import summarise
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.observer import sensor_center

from .data import (
    RAYS,
    EyePositions,
    ObjectAttention,
    ParticipantLabels,
    ReportCamera,
    Run,
    Stage,
    anonymize_rays,
    anonymize_results,
    assign_ray_hits,
    farthest_point_sampling,
    make_proxy,
    make_report_sampler,
    pack_stage,
    sample_eye_positions,
    summarize_objects,
)
from .inputs import ReportInputs, compute_evaluations, open_evaluations, open_inputs
from .pictures import RenderedViews, draw_rays, draw_views, gaze_vmax
from .sections import render_page
from .viewpoints import collect_paths, count_participants_near, find_free_positions, panorama_positions

SUFFIXES = (".html", ".htm")

VIEWS = ("camera", "own", "sphere")
"""Names of the images of the sensors of the written scene."""

OBSERVERS = 5
"""Number of observers with gaze in the 3D view."""

_ROLES = {"field": "radiance field", "hits": "hit points"}
_IN_MEMORY = "in memory"


@dataclass(frozen=True, eq=False, repr=False)
class Report:
    """A report on a gaze field; ``run`` is its content."""

    run: Run

    @property
    def html(self) -> str:
        """The page."""
        return render_page(self.run)

    def save(self, path: FilePath) -> Path:
        """Write the page (.html). Raises `NergError` for another suffix."""
        check_writable(path, *SUFFIXES)
        write_text(Path(path), self.html)
        return Path(path)

    def __repr__(self) -> str:
        return f'<Report: "{self.run.title}">'

    def _repr_html_(self) -> str:
        """The report in a frame, for notebooks."""
        return element("iframe", srcdoc=self.html, width="100%", height=800)


@dataclass(frozen=True, kw_only=True)
class ReportSettings:
    """What a report shows, and how: keywords of `report`, which describes them."""

    observer: Sequence[float] | None
    camera: Sequence[float] | None
    target: Sequence[float] | None
    fov: float | None
    viewpoints: int
    min_participants: int
    show_names: bool
    paths: bool
    title: str | None
    width: int
    spp: int
    max_points: int
    seed: int

    def describe(self) -> dict[str, str]:
        """Return the settings that the report lists, by their names."""
        return {
            "width": f"{self.width} pixels",
            "samples per pixel": str(self.spp),
            "seed": str(self.seed),
            "viewpoints": f"at most {self.viewpoints}",
            "names of participants": "shown" if self.show_names else "numbered",
            "minimum number of participants": str(self.min_participants),
        }


@check_ranges
def report(
    inputs: FilePath | Any | Sequence[FilePath | Any],
    *,
    aois: FilePath | AnyAreas | None = None,
    evaluate: bool = False,
    observer: Annotated[Sequence[float], COORDINATES] | None = None,
    camera: Annotated[Sequence[float], COORDINATES] | None = None,
    target: Annotated[Sequence[float], COORDINATES] | None = None,
    fov: Annotated[float, FIELDS_OF_VIEW] | None = None,
    viewpoints: Annotated[int, Range(1, 10_000)] = 200,
    min_participants: Annotated[int, Range(1, 10**6)] = 1,
    show_names: bool = False,
    paths: bool = True,
    title: str | None = None,
    width: Annotated[int, Range(24, 1200)] = 480,
    spp: Annotated[int, SPP] = 2,
    max_points: Annotated[int, Range(100, 100_000)] = 80_000,
    seed: Annotated[int, SEEDS] = 0,
    rendered: Mapping[str, Any] | None = None,
    progress: Progress = None,
) -> Report:
    """Write a report on a gaze field: one HTML file that opens from disk and needs no network.

    The report shows the scene, the data, recorded positions, the gaze, areas of interest, scores next to baselines with
    a verdict, uncertainty, settings, limits, provenance, and a 3D view. Sections without data are left out, with a
    note.

    Parameters
    ----------
    inputs : object, path or sequence of these
        A gaze field and, in any order, its environment, rays and evaluations (gaze.json, or the folder of nerg eval
        gaze); or a folder with these files. Default: environment and evaluation next to the gaze field.
    aois : Areas, path or mapping, optional
        JSON file of areas of interest (AOIs), boxes with names: {"shelf": [[x0, y0, z0], [x1, y1, z1]], ...}.
    evaluate : bool
        Score the field on the rays held out of its training (about a minute per split).
    observer : sequence of float, optional
        Position of the observer in the images, x,y,z. Default: where the density of rays is highest.
    camera : sequence of float, optional
        Position of the camera, x,y,z. Default: the best overview.
    target : sequence of float, optional
        Point that the camera at ``camera`` looks at, x,y,z. Default: the centre of what the observer looks at.
    fov : float, optional
        Horizontal field of view in degrees. Default: 70.
    viewpoints : int
        Number of recorded positions from which the attention on AOIs is evaluated.
    min_participants : int
        Minimum number of participants who could see an AOI; values of other AOIs are hidden.
    show_names : bool
        Show the names of participants. Without it, they are numbered.
    paths : bool
        Draw the paths of participants in the 3D view. Movement patterns can identify a person.
    title : str, optional
        Title of the report. Default: the name of the gaze field.
    width : int
        Width of the images in pixels.
    spp : int
        Samples per pixel.
    max_points : int
        Maximum number of points in the 3D view.
    seed : int
        Seed of the random numbers for sampling.
    rendered : mapping, optional
        Channels of the images camera, own and sphere, if they have been rendered for this observer and camera.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    Report
        The report, with a method ``save`` (.html); a notebook shows it.

    Raises
    ------
    NergError
        An argument or an input is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> made = nerg.report(store / "shoppers.safetensors", width=24, spp=1, viewpoints=1)
    >>> made.save(folder / "report.html").name
    'report.html'
    """
    keywords = dict(locals())
    settings = ReportSettings(**{field.name: keywords[field.name] for field in fields(ReportSettings)})
    with open_reporter(progress) as reporter:
        sources = open_inputs(inputs, reporter)
        areas = Areas(()) if aois is None else _open_boxes(aois, reporter)
        results, doubts = open_evaluations(sources)
        activate_mitsuba()
        if evaluate:
            results += compute_evaluations(sources, seed, results, reporter)
        with Interruption() as stop:
            run = ReportBuilder(sources, settings, reporter, stop).build(areas, results, doubts, rendered)
        for _, verdict in run.verdicts:
            reporter.message(verdict.sentence)
        if not run.results:
            reporter.message(
                f"there is no evaluation, so the report has no verdict; add {parameter('evaluate', True)} to compute "
                "one from rays"
            )
    return Report(run)


def _open_boxes(aois: FilePath | AnyAreas, reporter: Reporter) -> Areas:
    areas = Areas.open(aois, "aois")
    if len(areas.box_indices) < len(areas.areas):
        reporter.warn(
            f"{len(areas.areas) - len(areas.box_indices)} of {len(areas.areas)} AOIs are not boxes or groups of "
            "boxes and are left out of the report; nerg stats supports them"
        )
    return areas


class ReportBuilder:
    """Computes the content of a report, with shared scene, field, geometry and rays."""

    def __init__(self, inputs: ReportInputs, settings: ReportSettings, reporter: Reporter, stop: Interruption):
        self.inputs, self.settings, self.reporter, self.stop = inputs, settings, reporter, stop
        self.field, self.training = inputs.gaze.network, inputs.gaze.provenance
        reporter.progress(0.0, "reading")
        self.rays = inputs.load_rays()
        self.align = read_training_alignment(self.training)

    def build(
        self,
        areas: Areas,
        results: Sequence[GazeResults],
        doubts: Sequence[str],
        rendered: Mapping[str, Channels] | None,
    ) -> Run:
        """Compute all content."""
        import mitsuba as mi

        settings = self.settings
        labels = ParticipantLabels(self.rays, results)
        rays = self.rays if self.rays is None or settings.show_names else anonymize_rays(self.rays, labels)
        hide = (lambda text: text) if settings.show_names else labels.anonymize
        scene = self._scene()
        views = self._views(scene, rendered)
        environment = self._environment(scene)
        sampler = make_report_sampler(self.field, environment, self.training.get("probes", {}).get("depth", "median"))
        viewpoints = self._observer(scene)
        if self.rays is not None:
            viewpoints = sample_eye_positions(self.rays, environment, settings.viewpoints)
        # The observer was reported with the scene.
        if not sampler.describe_extrapolation(self._observer(scene).positions):
            if sentence := sampler.describe_extrapolation(viewpoints.positions):
                self.reporter.warn(sentence)
        objects = observed = self._aoi_attention(areas, sampler, environment, viewpoints, self.rays)
        if self.rays is not None and settings.observer is not None:
            observed = self._aoi_attention(areas, sampler, environment, self._observer(scene), None)
        stage, sizes = self._stage(scene, sampler, environment, viewpoints, areas.boxes)
        source, gaze = scene.shown.environment, self.inputs.gaze
        files = self._list_inputs(source, areas)
        inputs = tuple((role, hide(name), digest) for role, name, digest in files)
        versions = list_library_versions(str(mi.variant()))
        record = Provenance("nerg report", {n: d for _, n, d in inputs}, settings.seed, settings.describe(), programs())
        pictures = draw_views(views, gaze_vmax(views.images), environment.has_surfaces, record)
        self._step(0.95, "writing")
        participants_near: tuple[int, ...] = ()
        if rays is not None and self.rays is not None:
            test = self.training.get("test")
            pictures |= draw_rays(rays, test if isinstance(test, dict) else None, record)
            radius = (self.training.get("probes") or {}).get("radius")
            participants_near = count_participants_near(
                self.rays, viewpoints.positions, environment, radius if isinstance(radius, (int, float)) else 0.5
            )
        shown = results if settings.show_names else [anonymize_results(r, labels) for r in results]
        path = gaze.path
        name = "Gaze field" if path is None else f"The gaze field “{path.stem}”{tracking_suffix(self.training)}"
        provenance = {**(source.metadata if path is None else {}), **gaze.provenance}
        radiance = source.radiance
        return Run(
            settings.title or hide(name),
            {"architecture": self.field.architecture(), "box": self.field.box.to_dict(), "provenance": provenance},
            hide(source.description),
            environment.kind,
            {} if radiance is None else {"box": radiance.network.box.to_dict(), "provenance": radiance.provenance},
            describe_observer(scene, settings.observer is not None),
            rays,
            None if rays is None else summarise(rays),
            tuple(shown),
            tuple(doubts),
            objects,
            len(viewpoints.positions),
            settings.min_participants,
            participants_near,
            pictures,
            stage,
            *sizes,
            inputs,
            versions,
            settings.describe(),
            views.basis,
            record.json(),
            observed,
        )

    def _list_inputs(self, environment: Environment, areas: Areas) -> list[tuple[str, str, str]]:
        """Return role, name and SHA-256 of each input: of its file, or of the arrays in memory."""
        gaze, rays = self.inputs.gaze, self.inputs.rays
        describe = lambda role, path: (role, path.name, file_sha256(path))
        kind = _ROLES.get(environment.kind, environment.kind)
        out = [("gaze field", _IN_MEMORY, gaze.digest) if gaze.path is None else describe("gaze field", gaze.path)]
        if environment.path is not None:
            out.append(describe(kind, environment.path))
        elif environment.has_surfaces:
            out.append((kind, _IN_MEMORY, environment.digest))
        if isinstance(rays, Rays):
            out.append(("rays", _IN_MEMORY, hash_arrays(rays.columns())))
        elif rays is not None:
            out.append(("rays", Path(rays).name, hash_rays(rays)))
        files = [e for e in self.inputs.evaluations if isinstance(e, Path)]
        out += [("evaluation", f"{path.parent.name}/{path.name}", file_sha256(path)) for path in files]
        return [*out, *(describe("objects", path) for path in areas.files)]

    def _step(self, share: float, text: str) -> None:
        self.stop.check()
        self.reporter.progress(share, text)

    def _scene(self) -> PlacedScene:
        """Place the observer and the camera among the geometry and the gaze field."""
        self._step(0.05, "looking for a camera")
        settings, inputs = self.settings, self.inputs
        observer = settings.observer
        if observer is None and self.rays is not None:
            observer = tuple(to_scene_frame(support_of_rays(self.rays).find_densest_position(), self.align).tolist())
        shown = open_shown(inputs.gaze, inputs.environment, reporter=_Quiet(self.reporter))
        cameras = CameraChoice(settings.camera, settings.target, fov=settings.fov)
        scene = place_scene(shown, ObserverChoice(observer), cameras, settings.width, reporter=_Quiet(self.reporter))
        if scene.text.observer is None:
            self.reporter.message(
                "no recorded positions are known: the camera is the observer; use "
                f"{parameter('observer', 'x,y,z')} to place one"
            )
        return scene

    def _views(self, scene: PlacedScene, rendered: Mapping[str, Channels] | None) -> RenderedViews:
        """Render the camera, the observer's view and the sphere."""
        settings = self.settings
        spread = len(self.field.members) > 1
        aovs = "depth,opacity,gaze,visibility" + (",gaze_std" if spread else "")
        loaded = scene.load(aovs=aovs, sphere_width=settings.width, sphere_height=settings.width // 2)
        views = dict(rendered or {})
        for number, name in enumerate(VIEWS):
            if name in views:
                continue
            self._step(0.2 + 0.12 * number, f"rendering: {name}")
            with translate_mitsuba_errors():
                views[name] = render_channels(
                    loaded, loaded.sensors()[number], settings.spp, settings.seed, lambda done, total: self.stop.check()
                )
        views = {name: smooth_gaze(views[name], loaded, loaded.sensors()[number]) for number, name in enumerate(VIEWS)}
        marker = None
        if scene.text.observer is not None:
            camera, width = loaded.sensors()[0], views["camera"].mask.shape[1]
            pixel = project_to_pixel(camera, sensor_center(loaded.sensors()[1]))
            share = width / camera.film().crop_size()[0]
            marker = None if pixel is None else tuple((v + 0.5) * share - 0.5 for v in pixel)
        return RenderedViews(views, marker, is_supported(loaded, loaded.sensors()[0]), describe_basis(loaded))

    def _environment(self, scene: PlacedScene) -> Environment:
        """Return the geometry of the scene, in which depths are traced."""
        if not scene.shown.environment.has_surfaces:
            return Environment(None, self.field.box, "none", align=self.align)
        loaded = scene.load(radiance="false", aovs="opacity")
        geometry = SceneGeometry(loaded.integrator().medium, loaded)
        return Environment(geometry, self.field.box, scene.shown.environment.kind, align=self.align)

    def _observer(self, scene: PlacedScene) -> EyePositions:
        at = scene.text.camera if scene.text.observer is None else scene.text.observer
        return EyePositions(np.asarray(at.origin, float)[None], np.zeros(1, int))

    def _aoi_attention(
        self, areas: Areas, sampler: GazeSampler, environment: Environment, viewpoints: EyePositions, rays: Rays | None
    ) -> tuple[ObjectAttention, ...]:
        if not areas.box_indices or not environment.has_surfaces:
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
        scene: PlacedScene,
        sampler: GazeSampler,
        environment: Environment,
        viewpoints: EyePositions,
        boxes: Sequence[Region],
    ) -> tuple[str | None, tuple[int, int, int, int]]:
        """Return the packed 3D view, None if there are no surfaces, and its numbers of observers, paths, points and
        boxes."""
        empty = None, (0, 0, 0, 0)
        if not environment.has_surfaces:
            return empty
        # The up direction is that of the rays.
        settings, up = self.settings, self.align.matrix[:3, 2] / self.align.scale
        at = np.asarray((scene.text.observer or scene.text.camera).origin, float)
        standing = viewpoints.positions
        if self.rays is None:
            box = self.field.box.core
            corners = np.array(box.lower, float), np.array(box.upper, float)
            standing = np.concatenate([at[None], find_free_positions(sampler, corners, up, at)])
        loaded = scene.load(aovs="opacity,position")
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
                settings.max_points,
                on_panorama=report_panorama,
            )
        if proxy is None:
            return empty
        paths = collect_paths(self.rays, environment) if self.rays is not None and settings.paths else []
        camera = ReportCamera(np.asarray(scene.text.camera.origin, float), np.asarray(scene.text.camera.target, float))
        packed = pack_stage(Stage(proxy, observers, paths, boxes, up, camera))
        return packed, (len(observers), len(paths), len(proxy.vertices), len(boxes))


class _Quiet(SilentReporter):
    """Passes on warnings only: the report has its own progress."""

    def __init__(self, reporter: Reporter):
        self.warn = reporter.warn


# ---- Texts on the scene and the observer ----


def describe_observer(scene: PlacedScene, is_given: bool) -> str:
    """Describe the observer in a sentence; ``is_given`` tells whether its position was given."""
    if scene.text.observer is None:
        return "The camera is the observer, because no recorded positions are known."
    at = ", ".join(f"{v:.2f}" for v in scene.text.observer.origin)
    where = "at the given position" if is_given else "where the density of rays is highest"
    return f"The observer is {where}, ({at})."
