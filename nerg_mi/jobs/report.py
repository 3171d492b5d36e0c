"""A report on a gaze field: one HTML file of its place, people, gaze, objects, scores, limits and provenance."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError, mitsuba_says, plain
from nerg_mi.evaluation.gaze.results import GazeResults, read_results
from nerg_mi.field.gaze.protocol import AnyGazeField
from nerg_mi.files.atomic import check_writable, write_text
from nerg_mi.files.checksum import file_sha256
from nerg_mi.formats.fields import load_gaze
from nerg_mi.interruption import Interruption
from nerg_mi.maths.contraction import AnyBox
from nerg_mi.rays.dataset.opening import load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.summary import summarise
from nerg_mi.rendering.channels import Channels, render_channels
from nerg_mi.rendering.pictures import load_scene
from nerg_mi.rendering.projection import pixel_of
from nerg_mi.rendering.scene_parts import default_name
from nerg_mi.report.boxes import Box, read_boxes
from nerg_mi.report.glances import Eyes, Onlooker, eyes_of, points_of_rays
from nerg_mi.report.names import Labels, rays_without_names, results_without_names
from nerg_mi.report.objects import ObjectAttention, attention_on
from nerg_mi.report.page import page
from nerg_mi.report.proxy import place_proxy, spread_out
from nerg_mi.report.run import Picture, Run
from nerg_mi.report.stage import Camera, Stage, pack
from nerg_mi.training.geometry.places import GazePlace
from nerg_mi.transport.observer.viewpoint import center
from nerg_mi.transport.place import Place

from .backend import select_backend
from .evaluation import evaluate_gaze
from .options.evaluation import GazeEvaluationOptions
from .options.report import ReportOptions
from .options.scene import SceneOptions
from .reporter import SILENT, Reporter
from .reports.files import ReportFiles, sort_files
from .reports.pictures import gaze_top, pictures_of_rays, pictures_of_views
from .reports.surroundings import company, free_places, panorama_eyes, paths_of
from .scene import SceneResult, write_scene
from .scenes.observers import support_of_rays, to_place
from .versions import versions

MARGIN = 0.03
"""Metres by which boxes of objects are taken to be larger: surfaces are known no better."""

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
    files: Sequence[str | Path], output: str | Path, options: ReportOptions | None = None, reporter: Reporter = SILENT
) -> ReportResult:
    """Write the report ``output`` (.html) of a gaze field, of which ``files`` are the checkpoint and, in any order,
    what there is besides: its place, rays, evaluations, or folders of these.

    The place is found beside the gaze field where it is not given. Raises `NergError` for what the user can mend.
    """
    options, output = options or ReportOptions(), Path(output)
    check_writable(output, ".html", ".htm")
    given = sort_files([Path(file) for file in files])
    boxes = () if options.objects is None else read_boxes(options.objects)
    results, doubts = _results(given)
    ns = select_backend(options.mode, options.threads)
    if options.evaluate:
        results += _evaluated(given, options, results, reporter)
    with Interruption() as stop:
        work = _Work(given, ns, options, reporter, stop)
        run = work.run(boxes, results, doubts)
    write_text(output, page(run))
    size = output.stat().st_size / 1e6
    for _, verdict in run.verdicts:
        reporter.message(verdict.sentence)
    if not run.results:
        reporter.message("no evaluation is at hand, so that the report has no verdict; --evaluate makes one of rays")
    reporter.message(f"wrote {output} ({size:.1f} MB)")
    return ReportResult(output, run)


def _results(given: ReportFiles) -> tuple[list[GazeResults], list[str]]:
    """The evaluations that were given, and doubts about them. Raises `NergError` for those of another field."""
    found, doubts, own = [], [], file_sha256(given.gaze)
    for path in given.results:
        results = read_results(path)
        if results.sha256 and results.sha256 != own:
            raise NergError(f'"{path}" is an evaluation of another gaze field than "{given.gaze}"; leave it out')
        if not results.sha256 and results.gaze != given.gaze.name:
            doubts.append(
                f"An evaluation is of a field called {plain(results.gaze, 80)}; whether it is this one is not known."
            )
        found.append(results)
    splits = [r.split for r in found]
    twice = next((s for s in splits if splits.count(s) > 1), None)
    if twice is not None:
        raise NergError(f'two of the evaluations are of the split "{plain(twice, 40)}"; leave out one of them')
    return found, doubts


def _evaluated(
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

    def run(self, boxes: Sequence[Box], results: Sequence[GazeResults], doubts: Sequence[str]) -> Run:
        """All that is shown."""
        given, options = self.given, self.options
        labels = Labels(self.rays, results)
        rays = self.rays if self.rays is None or options.names else rays_without_names(self.rays, labels)
        hide = (lambda text: text) if options.names else labels.hide
        with tempfile.TemporaryDirectory() as folder:
            scene = self._scene(Path(folder))
            views, marker = self._views(scene)
            place = self._place(scene)
            onlooker = Onlooker(self.field, place, self._kind())
            eyes = self._eyes(place, scene)
            objects = self._objects(boxes, onlooker, place, eyes)
            top = gaze_top(views)
            stage, sizes = self._stage(scene, onlooker, place, eyes, boxes)
        known = given.scene.kind != "none"
        pictures: dict[str, Picture] = pictures_of_views(views, top, marker, known)
        self._step(0.95, "writing")
        around: tuple[int, ...] = ()
        if rays is not None and self.rays is not None:
            test = given.scene.about.get("test")
            pictures |= pictures_of_rays(rays, test if isinstance(test, dict) else None)
            radius = (given.scene.about.get("probes") or {}).get("radius")
            around = company(self.rays, eyes.positions, place, radius if isinstance(radius, (int, float)) else 0.5)
        shown = results if options.names else [results_without_names(r, labels) for r in results]
        return Run(
            options.title or hide(f"The gaze field {given.gaze.stem}"),
            self.about,
            hide(_words(given)),
            given.scene.kind,
            given.scene.field_about,
            _observer_words(scene, options, self.rays is not None),
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
            tuple((role, hide(name), digest) for role, name, digest in self._inputs()),
            versions(_variant()),
            _settings(options),
        )

    def _inputs(self) -> list[tuple[str, str, str]]:
        found = self.given.inputs()
        if self.options.objects is not None:
            found.append(("objects", self.options.objects.name, file_sha256(self.options.objects)))
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

    def _views(self, scene: SceneResult) -> tuple[dict[str, Channels], tuple[float, float] | None]:
        """The pictures of the camera, of the observer's own view and sphere, and where in the first the observer is."""
        o = self.options
        spread = len(self.field.members) > 1
        aovs = "depth,opacity,gaze" + (",gaze_std" if spread else "")
        loaded = self._load(scene, aovs=aovs, sphere_width=o.width, sphere_height=o.width // 2)
        views = {}
        for number, name in enumerate(("camera", "own", "sphere")):
            self._step(0.2 + 0.12 * number, f"rendering: {name}")
            check = lambda done, total: self.stop.check()
            with mitsuba_says():
                views[name] = render_channels(loaded, loaded.sensors()[number], o.spp, o.seed, check)
        marker = None
        if scene.observer is not None:
            marker = pixel_of(loaded.sensors()[0], center(loaded.sensors()[1]))
        return views, marker

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
        at = scene.camera if scene.observer is None else scene.observer
        return Eyes(np.asarray(at.origin, float)[None], np.zeros(1, int))

    def _objects(
        self, boxes: Sequence[Box], onlooker: Onlooker, place: GazePlace, eyes: Eyes
    ) -> tuple[ObjectAttention, ...]:
        if not boxes or self.given.scene.kind == "none":
            return ()
        told = lambda done, total: self._step(0.55 + 0.2 * done / total, f"objects: place {done} of {total}")
        glances = onlooker.glances(eyes, on_eye=told)
        recorded = None
        if self.rays is not None:
            recorded = points_of_rays(self.rays, place, onlooker, RAYS)
        return attention_on(boxes, glances, MARGIN * self.align.scale, recorded)

    def _stage(
        self, scene: SceneResult, onlooker: Onlooker, place: GazePlace, eyes: Eyes, boxes: Sequence[Box]
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


def _load(given: ReportFiles, path: Path) -> Rays:
    """The rays; of a dataset the sample that the field was trained on."""
    trained = given.scene.about.get("rays_file", {})
    return load_rays(path, trained.get("most"), trained.get("seed", 0))


def _corners(box: AnyBox) -> tuple[np.ndarray, np.ndarray]:
    return np.array(box.core.lower, float), np.array(box.core.upper, float)


def _variant() -> str:
    import mitsuba as mi

    return str(mi.variant())


def _words(given: ReportFiles) -> str:
    name = "" if given.scene.place is None else given.scene.place.name
    return {
        "field": f"A radiance field trained on photos, {name}.",
        "mesh": f"The mesh {name}.",
        "scene": f"The Mitsuba scene {name}.",
        "hits": f"No pictures of the place are at hand: it is made of what people looked at, {name}, in greys.",
        "none": "Nothing is known of the place: directions alone are shown.",
    }[given.scene.kind]


def _observer_words(scene: SceneResult, options: ReportOptions, recorded: bool) -> str:
    if scene.observer is None:
        return "The camera is the observer, for nothing says where people were."
    at = ", ".join(f"{v:.2f}" for v in scene.observer.origin)
    where = "where it was asked for" if options.observer is not None else "where most rays are"
    return f"The observer stands {where}, at ({at})."


def _settings(options: ReportOptions) -> dict[str, str]:
    return {
        "width": f"{options.width} pixels",
        "samples a pixel": str(options.spp),
        "seed": str(options.seed),
        "places looked from": f"{options.eyes} at most",
        "names of people": "shown" if options.names else "numbered",
        "fewest people of a share": str(options.min_persons),
    }
