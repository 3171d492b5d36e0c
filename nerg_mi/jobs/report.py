"""``nerg report``: Write a report on a gaze field: one HTML file with a verdict, pictures, scores and the place in 3D.

A report on a gaze field: one HTML file of its place, people, gaze, objects, scores, limits and provenance.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.errors import mitsuba_says
from nerg_mi.evaluation.gaze_report import GazeResults
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.figures.style import Provenance
from nerg_mi.figures.style import versions as programs
from nerg_mi.files.atomic import check_writable, file_sha256, write_text
from nerg_mi.formats.areas import Areas, Region, read_areas
from nerg_mi.formats.fields import load_gaze
from nerg_mi.interruption import Interruption
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.rays.dataset_open import load_rays
from nerg_mi.rays.quality import summarise
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import Channels, render_channels
from nerg_mi.rendering.scene import load_scene
from nerg_mi.rendering.scene_writer import default_name, pixel_of
from nerg_mi.report.data import (
    Camera,
    Eyes,
    Labels,
    ObjectAttention,
    Onlooker,
    Picture,
    Run,
    Stage,
    attention_on,
    eyes_of,
    land_rays,
    pack,
    place_proxy,
    rays_without_names,
    results_without_names,
    spread_out,
)
from nerg_mi.report.sections import page
from nerg_mi.statistics.shares import ROUGH, gaze_shares
from nerg_mi.statistics.visits import MARGIN, Box
from nerg_mi.train.geometry import GazePlace
from nerg_mi.transport.geometry import Place
from nerg_mi.transport.observer import center

from .backend import select_backend
from .commands import argument, command, out
from .options.report import ReportOptions
from .options.scene import SceneOptions
from .overlays import basis_words, is_supported
from .reporter import SILENT, Reporter
from .reports.files import ReportFiles, sort_files
from .reports.pictures import Views, gaze_top, pictures_of_rays, pictures_of_views
from .reports.results import given_results, made_results
from .reports.surroundings import company, free_places, panorama_eyes, paths_of
from .reports.words import observer_words, place_words, setting_words
from .scene import SceneResult, write_scene
from .scenes.observers import support_of_rays, to_place
from .versions import versions

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


@command(
    "report",
    "Write a report on a gaze field: one HTML file that opens from disk and needs no network.",
    more="""It shows the place, the data, where people were, the gaze, named objects, the scores beside their baselines
with a verdict in a sentence, uncertainty, settings, limits, provenance and the place in 3D. What is missing is left
out, and said so.""",
    options=ReportOptions,
    files=argument(
        "In any order: a gaze field, and what there is of its place, rays, evaluations (gaze.json, or the folder of "
        "nerg eval gaze); a folder stands for what lies in it.",
        list[Path],
        metavar="RUN",
    ),
    output=out("File to write (.html).", default=Path("report.html")),
)
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
    areas = Areas(()) if options.objects is None else _objects(options.objects, reporter)
    results, doubts = given_results(given)
    ns = select_backend(options.mode, options.threads)
    if options.evaluate:
        results += made_results(given, options, results, reporter)
    with Interruption() as stop:
        work = _Work(given, ns, options, reporter, stop)
        run = work.run(areas, results, doubts, rendered)
    write_text(output, page(run))
    size = output.stat().st_size / 1e6
    for _, verdict in run.verdicts:
        reporter.message(verdict.sentence)
    if not run.results:
        reporter.message("no evaluation is at hand, so that the report has no verdict; --evaluate makes one of rays")
    reporter.message(f"wrote {output} ({size:.1f} MB)")
    return ReportResult(output, run)


class _Work:
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
        areas: Areas,
        results: Sequence[GazeResults],
        doubts: Sequence[str],
        rendered: Mapping[str, Channels] | None,
    ) -> Run:
        """All that is shown."""
        given, options = self.given, self.options
        labels = Labels(self.rays, results)
        rays = self.rays if self.rays is None or options.names else rays_without_names(self.rays, labels)
        hide = (lambda text: text) if options.names else labels.hide
        with tempfile.TemporaryDirectory() as folder:
            scene = self._scene(Path(folder))
            views = self._views(scene, rendered)
            place = self._place(scene)
            onlooker = Onlooker(self.field, place, self._kind())
            eyes = self._eyes(place, scene)
            objects = observed = self._objects(areas, onlooker, place, eyes, self.rays)
            if self.rays is not None and options.observer is not None:
                observed = self._objects(areas, onlooker, place, self._observer(scene), None)
            top = gaze_top(views.seen)
            stage, sizes = self._stage(scene, onlooker, place, eyes, areas.boxes)
        known = given.scene.kind != "none"
        inputs = tuple((role, hide(name), digest) for role, name, digest in self._inputs())
        settings = setting_words(options)
        about = Provenance("nerg report", {n: d for _, n, d in inputs}, options.seed, settings, programs())
        pictures: dict[str, Picture] = pictures_of_views(views, top, known, about)
        self._step(0.95, "writing")
        around: tuple[int, ...] = ()
        if rays is not None and self.rays is not None:
            test = given.scene.about.get("test")
            pictures |= pictures_of_rays(rays, test if isinstance(test, dict) else None, about)
            radius = (given.scene.about.get("probes") or {}).get("radius")
            around = company(self.rays, eyes.positions, place, radius if isinstance(radius, (int, float)) else 0.5)
        shown = results if options.names else [results_without_names(r, labels) for r in results]
        return Run(
            options.title or hide(f"The gaze field “{given.gaze.stem}”"),
            self.about,
            hide(place_words(given)),
            given.scene.kind,
            given.scene.field_about,
            observer_words(scene, options.observer is not None),
            rays,
            None if rays is None else summarise(rays),
            tuple(shown),
            tuple(doubts),
            objects,
            len(eyes.positions),
            options.min_persons,
            around,
            pictures,
            stage,
            *sizes,
            inputs,
            versions(_variant()),
            settings,
            views.basis,
            about.json(),
            observed,
        )

    def _inputs(self) -> list[tuple[str, str, str]]:
        found = self.given.inputs()
        if self.options.objects is not None:
            path = Path(self.options.objects)
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
            observer = tuple(to_place(support_of_rays(self.rays).densest(), self.align).tolist())
        if observer is None and self.field.support is None and self.given.scene.kind != "none":
            self.reporter.message(
                "nothing says where people were: the camera is the observer; --observer x,y,z places one"
            )
        chosen = SceneOptions(
            observer=observer, camera_from=o.camera_from, camera_to=o.camera_to, fov=o.fov, width=o.width, mode=o.mode
        )
        return write_scene(self.given.shown, folder / "scene.xml", chosen, _Quiet(self.reporter))

    def _load(self, scene: SceneResult, **values: object):
        named = {default_name(name, scene.taken): str(value) for name, value in values.items()}
        return load_scene(scene.path, named)

    def _views(self, scene: SceneResult, rendered: Mapping[str, Channels] | None) -> Views:
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
            with mitsuba_says():
                views[name] = render_channels(
                    loaded, loaded.sensors()[number], o.spp, o.seed, lambda done, total: self.stop.check()
                )
        marker = None
        if scene.observer is not None:
            camera, width = loaded.sensors()[0], views["camera"].mask.shape[1]
            found = pixel_of(camera, center(loaded.sensors()[1]))
            share = width / camera.film().crop_size()[0]
            marker = None if found is None else tuple((v + 0.5) * share - 0.5 for v in found)
        return Views(views, marker, is_supported(loaded, loaded.sensors()[0]), basis_words(loaded))

    def _place(self, scene: SceneResult) -> GazePlace:
        """The place as the scene has it, in which depths are traced."""
        kind = self.given.scene.kind
        if kind == "none":
            return GazePlace(None, self.field.box, kind, align=self.align)
        loaded = self._load(scene, radiance="false", aovs="opacity")
        return GazePlace(Place(loaded.integrator().medium, loaded), self.field.box, kind, align=self.align)

    def _eyes(self, place: GazePlace, scene: SceneResult) -> Eyes:
        """Where people stood, or where the observer is."""
        if self.rays is not None:
            return eyes_of(self.rays, place, self.options.eyes)
        return self._observer(scene)

    def _observer(self, scene: SceneResult) -> Eyes:
        at = scene.camera if scene.observer is None else scene.observer
        return Eyes(np.asarray(at.origin, float)[None], np.zeros(1, int))

    def _objects(
        self, areas: Areas, onlooker: Onlooker, place: GazePlace, eyes: Eyes, rays: Rays | None
    ) -> tuple[ObjectAttention, ...]:
        if not areas.solids or self.given.scene.kind == "none":
            return ()
        things, members = [Box(box) for box in areas.boxes], list(areas.solids.values())
        count, margin = len(eyes.positions), MARGIN * self.align.scale
        told = lambda done: self._step(0.55 + 0.2 * done / count, f"objects: place {done} of {count}")
        shares = gaze_shares(onlooker.look_from, eyes.positions, things, members, margin, ROUGH, told)
        recorded = None
        if rays is not None:
            recorded = land_rays(rays, place, onlooker, RAYS, things, members, margin)
        return attention_on(list(areas.solids), shares, eyes.person, recorded)

    def _stage(
        self, scene: SceneResult, onlooker: Onlooker, place: GazePlace, eyes: Eyes, boxes: Sequence[Region]
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
            standing = np.concatenate([at[None], free_places(onlooker, _corners(self.field.box), up, at)])
        loaded = self._load(scene, aovs="opacity,position")
        others = standing[spread_out(standing, OBSERVERS - 1, first=at)] if self.rays is not None else at[None][:0]
        observers = np.concatenate([at[None], others])
        told = lambda done, total: self._step(0.75 + 0.15 * done / total, f"3D: panorama {done} of {total}")
        with mitsuba_says():
            looked_from = panorama_eyes(standing, at)
            proxy = place_proxy(loaded, looked_from, up, observers, onlooker.on_points, o.points, on_eye=told)
        if proxy is None:
            return nothing
        paths = paths_of(self.rays, place) if self.rays is not None and o.paths else []
        camera = Camera(np.asarray(scene.camera.origin, float), np.asarray(scene.camera.target, float))
        packed = pack(Stage(proxy, observers, paths, boxes, up, camera))
        return packed, (len(observers), len(paths), len(proxy.vertices), len(boxes))

    def _up(self) -> np.ndarray:
        """Which way is up in the place: that of the rays."""
        return self.align.matrix[:3, 2] / self.align.scale


class _Quiet:
    """Passes on only what may be wrong: the lines of a job within this one name files that nobody keeps."""

    def __init__(self, reporter: Reporter):
        self._reporter = reporter

    def message(self, text: str) -> None:
        pass

    def warn(self, text: str) -> None:
        self._reporter.warn(text)

    def progress(self, share: float, text: str = "") -> None:
        pass


def _objects(path: Path, reporter: Reporter) -> Areas:
    areas = read_areas(path)
    if len(areas.solids) < len(areas.areas):
        reporter.warn(
            f"{len(areas.areas) - len(areas.solids)} of {len(areas.areas)} areas are no boxes and no groups of boxes, "
            "and a report leaves them out; nerg stats counts them"
        )
    return areas


def _load(given: ReportFiles, path: Path) -> Rays:
    """The rays; of a dataset the sample that the field was trained on."""
    trained = given.scene.about.get("rays_file", {})
    return load_rays(path, trained.get("most"), trained.get("seed", 0))


def _corners(box: AnyBox) -> tuple[np.ndarray, np.ndarray]:
    return np.array(box.core.lower, float), np.array(box.core.upper, float)


def _variant() -> str:
    import mitsuba as mi

    return str(mi.variant())
