"""A session of the viewer: its state, the worker that renders, tracks of people, and sharing."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Generator, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from nerg_mi.api.query import compute_box_shares, compute_mesh_shares, trace
from nerg_mi.api.scene import COLOR, Scene, activate_mitsuba
from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.formats.areas import AreaSet, Region, read_areas
from nerg_mi.maths.geometry import Similarity
from nerg_mi.probes.probes import place_probes
from nerg_mi.ranges import MAX_COORDINATE
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.scene import load_scene
from nerg_mi.statistics.shares import COARSE
from nerg_mi.transport.geometry import Ceiling
from nerg_mi.workflows.render import describe_basis
from nerg_mi.workflows.scene_cameras import check_point
from nerg_mi.workflows.scene_commands import ViewOptions
from nerg_mi.workflows.view import ViewerScene

from . import layers
from .layers import Layer, Scale, Shade
from .points import (
    SIZES,
    BandPace,
    PinholeView,
    PointProxy,
    Points,
    StagePicture,
    ahead_of,
    bake,
    filled,
    gather,
    heading_of,
    refine,
    rough_integrals,
    way_out,
)

# ---- What a session tells of what it finds ----


class Listener(Protocol):
    """Whoever shows what a session finds."""

    def on_proxy(self) -> None:
        """There are points, or more of them."""
        ...

    def on_baked(self) -> None:
        """The points have the gaze of the observer."""
        ...

    def on_shares(self) -> None:
        """The shares of attention are those of the observer."""
        ...

    def on_range(self) -> None:
        """The automatic range of the layer that is shown is another one."""
        ...

    def on_error(self, error: BaseException) -> None:
        """A task has failed."""
        ...


# ---- Shares of attention of named areas and shapes, in steps between which other work is done ----

FACES = 1 << 17
"""Faces of shapes whose shares are counted in one step, but for a shape that has more."""


def iter_attention_shares(
    scene: Scene, at: np.ndarray, regions: Sequence[Region], shapes: Sequence[str]
) -> Iterator[dict[str, float]]:
    """The share of the observer at ``at`` (3,) of each of ``regions``, together, then of the meshes whose ids are
    ``shapes``, so many at a time as a step can count."""
    if regions:
        boxes = compute_box_shares(scene, regions, np.asarray(at, np.float32)[None], rule=COARSE).share[0]
        yield dict(zip([region.name for region in regions], boxes.tolist()))
    for names in shape_groups(scene, shapes):
        with rough_integrals(scene):
            meshes = compute_mesh_shares(scene, names, at, divisions=1, two_sided=True)
        yield dict(zip(names, meshes.tolist()))


def shape_groups(scene: Scene, shapes: Sequence[str]) -> Iterator[list[str]]:
    """The ids ``shapes`` in groups of `FACES` faces at most, but for a shape that has more by itself."""
    faces = {shape.id(): shape.face_count() for shape in scene.mitsuba.shapes() if shape.is_mesh()}
    group: list[str] = []
    for name in shapes:
        if group and sum(faces[n] for n in [*group, name]) > FACES:
            yield group
            group = []
        group.append(name)
    if group:
        yield group


# ---- Tracks ----
#
# People of the rays: their paths, and where they are at a moment.

VERTICES = 20_000
"""Points of all paths together, at most: what a browser draws without effort."""

GAP = 1.0
"""Seconds without a ray that end a path, and that a person is still shown after the last one."""

RAYS = 1 << 11
"""Rays that are drawn at most."""

PROBES = 512
"""Probes that are drawn at most."""

ALL = "everybody"


@dataclass(frozen=True, eq=False)
class PersonPose:
    """``person``, their eye ``at`` (3,) and ``ahead`` (3,), a unit vector, both in the place."""

    person: str
    at: np.ndarray
    ahead: np.ndarray


class Tracks:
    """Rays in the place: ``align`` leads there from their own frame."""

    def __init__(self, rays: Rays, align: Similarity):
        order = np.lexsort((rays.t, rays.person))
        self._rays = rays.select(order)
        matrix = self._matrix = np.asarray(align.matrix, float)
        turn = matrix[:3, :3] / align.scale
        self.at = self._rays.origin @ matrix[:3, :3].T + matrix[:3, 3]
        self.ahead = self._rays.direction @ turn.T

    @property
    def times(self) -> tuple[float, float]:
        """When the first ray and the last one are, in seconds."""
        return (float(self._rays.t.min()), float(self._rays.t.max())) if len(self._rays) else (0.0, 0.0)

    @property
    def groups(self) -> list[str]:
        """Everybody, and the cohorts."""
        return [ALL, *self._rays.cohorts]

    @property
    def people(self) -> list[str]:
        """Names of those who have rays."""
        return [self._rays.persons[k] for k in np.unique(self._rays.person)]

    def segments(self, group: str = ALL) -> tuple[np.ndarray, np.ndarray]:
        """Line segments (S, 2, 3) of the paths of a cohort, and the person's number (S,) of each."""
        rows = np.flatnonzero(self._of(group))
        rows = rows[:: max(len(rows) // VERTICES, 1)]
        person, t = self._rays.person[rows], self._rays.t[rows]
        step = max(np.median(np.diff(t)) if len(t) > 1 else 0.0, 0.0)
        if len(rows) < 2:
            return np.zeros((0, 2, 3), np.float32), person[:0]
        joined = (np.diff(person) == 0) & (np.diff(t) <= max(GAP, 4 * step))
        pairs = np.stack([self.at[rows[:-1]], self.at[rows[1:]]], axis=1)[joined]
        return pairs.astype(np.float32), person[:-1][joined]

    def at_time(self, time: float, group: str = ALL) -> list[PersonPose]:
        """Where those of a cohort are whose nearest ray is within `GAP` of ``time``."""
        near = np.flatnonzero(self._of(group) & (np.abs(self._rays.t - time) <= GAP))
        found = []
        for person in np.unique(self._rays.person[near]):
            own = near[self._rays.person[near] == person]
            k = own[np.argmin(np.abs(self._rays.t[own] - time))]
            found.append(PersonPose(self._rays.persons[person], self.at[k], self.ahead[k]))
        return found

    def sample(self, group: str = ALL, most: int = RAYS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Eyes (K, 3) and unit directions (K, 3) of ``most`` rays of a cohort at most, evenly through each person's
        time, and the person's number (K,)."""
        rows = np.flatnonzero(self._of(group))
        rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)] if len(rows) else rows
        return self.at[rows], self.ahead[rows], self._rays.person[rows]

    def probes(self, group: str = ALL) -> tuple[np.ndarray, np.ndarray]:
        """Positions (P, 3) in the place of the probes that a density of a cohort's rays would have by default, and how
        many rays each holds (P,). Raises `NergError` where nobody stayed long enough for one."""
        rows = np.flatnonzero(self._of(group))
        found = place_probes(self._rays.select(rows), count=PROBES)
        turn, shift = self._matrix[:3, :3], self._matrix[:3, 3]
        return found.positions @ turn.T + shift, found.counts

    def _of(self, group: str) -> np.ndarray:
        if group == ALL or self._rays.cohort is None:
            return np.ones(len(self._rays), bool)
        return self._rays.cohort == self._rays.cohorts.index(group)


# ---- One thread that does all rendering, in small steps, the most urgent first ----
#
# Dr.Jit is used from one thread at a time. A task is a generator: each of its steps is short, between two of them
# another task may be more urgent, and whoever submits one under a name that is taken replaces the other, whose further
# steps are then never made. That is how a picture is cancelled when the view moves.

Result = TypeVar("Result")
Task = Generator[Any, None, None] | Iterator[Any]


class Worker:
    """A thread that runs tasks; ``on_error(error)`` is told of exceptions that tasks raise, which end them alone."""

    def __init__(self, on_error: Callable[[BaseException], None]):
        self._on_error = on_error
        self._tasks: dict[Hashable, tuple[int, int, Task]] = {}
        self._changed = threading.Condition()
        self._turn = itertools.count()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="nerg-view-render", daemon=True)
        self._thread.start()

    def submit(self, name: Hashable, urgency: int, task: Task) -> None:
        """Run ``task`` from now on, in place of one of the same ``name``; smaller ``urgency`` first, tasks of one
        urgency in turns."""
        with self._changed:
            if not self._stopped:
                self._tasks[name] = urgency, next(self._turn), task
                self._changed.notify_all()

    def cancel(self, name: Hashable) -> None:
        """Make no further step of the task ``name``, if there is one."""
        with self._changed:
            self._tasks.pop(name, None)
            self._changed.notify_all()

    def call(self, function: Callable[[], Result]) -> Future[Result]:
        """Call ``function`` on the thread, before any task; its result or its exception is the future's."""
        future: Future[Result] = Future()

        def steps() -> Iterator[None]:
            try:
                future.set_result(function())
            except BaseException as error:
                future.set_exception(error)
            yield

        self.submit(object(), -1, steps())
        return future

    @property
    def names(self) -> list[Hashable]:
        """The tasks that are not done yet."""
        with self._changed:
            return list(self._tasks)

    @property
    def idle(self) -> bool:
        """Whether nothing is left to do."""
        with self._changed:
            return not self._tasks

    def wait_idle(self, timeout: float) -> bool:
        """Wait until nothing is left to do, ``timeout`` seconds at most; whether it is so."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._tasks, timeout)

    def stop(self, timeout: float = 30.0) -> None:
        """End the thread after the step that it is in."""
        with self._changed:
            self._stopped = True
            self._tasks.clear()
            self._changed.notify_all()
        self._thread.join(timeout)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or self._tasks)
                if self._stopped:
                    return
                name = min(self._tasks, key=lambda n: self._tasks[n][:2])
                entry = self._tasks[name]
            over = self._step(entry[2])
            with self._changed:
                # It may have been replaced in the meantime.
                if self._tasks.get(name) is entry:
                    if over:
                        del self._tasks[name]
                    else:
                        self._tasks[name] = entry[0], next(self._turn), entry[2]
                self._changed.notify_all()

    def _step(self, task: Task) -> bool:
        """Make a step of ``task``: whether it was the last."""
        try:
            next(task)
        except StopIteration:
            return True
        except BaseException as error:
            self._on_error(error)
            return True
        return False


# ---- Session ----
#
# What is viewed, whoever looks: the scene, its observer, the layer that is shown, and the tasks that compute them.
#
# All of Mitsuba and Dr.Jit is used on the thread of the `Worker`. What is found is told to a `Listener`, on that
# thread.

URGENCY = 1
"""Of tasks that take turns: the first picture is coarse, and nobody waits long for numbers."""

UNHURRIED = 2
"""Of small pictures, which nobody waits for."""

_COMPUTED = {
    "proxy": "points on surfaces",
    "picture": "picture",
    "gaze": "gaze on the points",
    "shares": "shares of attention",
    "inset": "the observer's views",
    "people": "recorded rays",
    "film": "video",
}
"""Tasks of the worker, in words."""

_MOST_SPP = 256
_SHAPES = 60


class Session:
    """A place that is viewed. ``start`` loads it; until then there is nothing to see."""

    def __init__(self, place: Callable[[], ViewerScene], options: ViewOptions, listener: Listener):
        self.options, self.listener = options, listener
        self._place = place
        self.worker = Worker(listener.on_error)
        self.lock = threading.RLock()
        self.proxy: PointProxy | None = None
        self.baked: dict[str, np.ndarray] = {}
        self.baked_for: np.ndarray | None = None
        # Whose values `baked` and `shares` are: an observer's, with areas or without, of a `version`.
        self._baked_of: tuple[np.ndarray, int] | None = None
        self._shares_of: tuple[np.ndarray, tuple[Region, ...], int] | None = None
        self.shares: dict[str, float] = {}
        self.ceiling: float | None = None
        self.regions: list[Region] = []
        self.other_areas: list[dict[str, Any]] = []
        self.pace = BandPace()
        self.checksums: dict[Path, str] = {}
        self._ranges: dict[str, tuple[float, float]] = {}
        self._busy: set[str] = set()
        self._shares_for: tuple[np.ndarray, tuple[Region, ...], int] | None = None
        # Of the gaze field and its settings: what was begun with others is not kept.
        self.version = 0

    def start(self) -> None:
        """Load the place, and begin to gather its points. Raises `NergError` for what cannot be shown."""
        self.worker.call(self._load).result()
        self.worker.submit("proxy", URGENCY, self._gather())

    def stop(self) -> None:
        """End the render thread."""
        self.worker.stop()

    def _load(self) -> None:
        self.place = self._place()
        self.mode = activate_mitsuba().variant()
        self.gaze_name = next(iter(self.place.variants), "")
        self._use(self.place.scene)
        self.shade = Shade(self._first_layer())
        sensors = self.scene.mitsuba.sensors()
        if not sensors:
            raise NergError(f'"{self.place.scene}" has no sensor to begin with; give it one')
        self.home = PinholeView.of_sensor(sensors[0])
        self.spp = min(self.options.spp or int(sensors[0].sampler().sample_count()), _MOST_SPP)
        given = check_point(self.options.observer, "--observer")
        own = self.scene.observer
        if given is None:
            given = self._ahead_of_home() if own is None else np.asarray(own, float)
        ahead = self.home.ahead if own is None else ahead_of(self.scene)
        self.place_observer(np.asarray(given, float), heading_of(ahead, self.place.up))
        self.falloff = float(np.ravel(np.array(self.scene.integrator.falloff))[0])
        cut = self.scene.integrator.ceiling
        self.cut_up, self.ceiling = (self.place.up, None) if cut is None else (cut.up, cut.height)
        self.tracks = None if self.place.rays is None else Tracks(self.place.rays, self.place.align)
        areas = read_areas(self.options.aois) if self.options.aois is not None else AreaSet(())
        # What is no box is not shown, and is saved again with what is.
        self.regions, self.other_areas = areas.boxes, list(areas.non_boxes)
        shapes = [shape.id() for shape in self.scene.mitsuba.shapes() if shape.is_mesh()]
        self.shapes = [name for name in shapes if name and not name.startswith("__")][:_SHAPES]

    def _use(self, scene_file: Path) -> None:
        """Show the scene of that file from now on."""
        self.scene_file, self.scene = scene_file, Scene(load_scene(scene_file))
        self.layers = layers.list_layers(self.scene)
        self.basis = describe_basis(self.scene.mitsuba)

    def _first_layer(self) -> Layer:
        return next((la for la in self.layers if la.quantity in ("gaze", "kde")), self.layers[0])

    def _ahead_of_home(self) -> np.ndarray:
        """Where the observer stands of a scene whose camera it is: half way to what that looks at, so as to be seen."""
        seen = trace(self.scene, self.home.origin, filled(self.home.ahead[None], SIZES[0]), ["depth"])
        depth = float(seen.depth[0])
        return self.home.origin + (0.5 * depth if np.isfinite(depth) else 0.0) * self.home.ahead

    # What changes

    def place_observer(self, at: np.ndarray, heading: np.ndarray | None = None) -> None:
        """The observer stands at ``at`` (3,), turned by ``heading`` (3, 3): columns ahead, left and up.

        Raises `NergError` for what is no position.
        """
        position = np.asarray(at, float)
        within = position.shape == (3,) and (np.abs(position) <= MAX_COORDINATE).all()
        if not within or not (heading is None or np.isfinite(heading).all()):
            text = ", ".join(f"{v:g}" for v in position.ravel()[:3])
            raise NergError(f"an observer cannot stand at ({text}); give three numbers in scene units")
        with self.lock:
            self.observer = np.array(at, float)
            if heading is not None:
                self.heading = np.array(heading, float)

    def set_falloff(self, value: float) -> None:
        """How far behind a surface is still seen a little, in scene units. Raises `NergError` for what is no length."""
        if not 0 <= value < np.inf:
            raise NergError(f"the fall-off is a length from 0 on, in scene units, got {value:g}")

        def change() -> None:
            self.falloff = float(value)
            self._set_falloff()
            self._forget()

        self.worker.call(change).result()

    def _set_falloff(self) -> None:
        import mitsuba as mi

        with translate_mitsuba_errors():
            params: Any = mi.traverse(self.scene.integrator)
            params["falloff"] = self.falloff
            params.update()

    def set_gaze(self, name: str) -> None:
        """Show the gaze field ``name`` of the place's variants; where it lacks the layer that is shown, its gaze.
        Raises `NergError` for a file that is no longer there."""

        def change() -> None:
            self._use(self.place.variants[name])
            self.gaze_name = name
            self._set_falloff()
            self._forget()
            with self.lock:
                self.baked, self._ranges = {}, {}
                if self.shade.layer not in self.layers:
                    self.shade = Shade(self._first_layer())

        self.worker.call(change).result()

    def _forget(self) -> None:
        """Have the gaze on the points, and the shares, computed anew."""
        with self.lock:
            self.version += 1
            self.baked_for = self._shares_for = None

    def set_shade(self, **changes: Any) -> None:
        """Another layer, other colours, or another range."""
        with self.lock:
            self.shade = replace(self.shade, **changes)

    # What is computed, and what is out of date

    @property
    def stale_points(self) -> str:
        """Why the points do not show the layer as it is for the observer as they stand now; "" where they do."""
        # Without the lock, which the thread that is told of a new range may hold: what was read a moment too early is
        # read again.
        layer, of = self.shade.layer, self._baked_of
        if not layer.quantity:
            return ""
        if layer.quantity not in self.baked:
            return f"the points do not show {layer.title}"
        if of is None or not np.array_equal(of[0], self.observer):
            return f"{layer.title} of an earlier observer"
        return "" if of[1] == self.version else f"{layer.title} of earlier settings"

    @property
    def stale_shares(self) -> bool:
        """Whether the shares of attention are not those of the observer, the areas and the settings of now."""
        of = self._shares_of
        return of is None or not _same(of, self._asked_shares())

    @property
    def has_scale(self) -> bool:
        """Whether the scale of the layer is known: until then it goes from 0 to 1."""
        shade = self.shade
        overlay = shade.layer.overlay
        unscaled = overlay is None or not overlay.needs_limits
        return unscaled or shade.fixed is not None or shade.layer.title in self._ranges

    @property
    def computing(self) -> list[str]:
        """What is being computed, in words."""
        names = {name[0] if isinstance(name, tuple) else name for name in self.worker.names}
        words = _COMPUTED | {"gaze": f"{'gaze' if self.scene.has_gaze else 'visibility'} on the points"}
        return [text for name, text in words.items() if name in names]

    def clear_way(
        self, name: Hashable, at: np.ndarray, free: np.ndarray, deliver: Callable[[np.ndarray], None]
    ) -> None:
        """Call ``deliver`` with ``at`` (3,), or, where that lies within something, with a position before the surface
        that hides it from the ``free`` one (3,)."""
        self.worker.submit(("way", name), URGENCY, self._way(at, free, deliver))

    def _asked_shares(self) -> tuple[np.ndarray, tuple[Region, ...], int]:
        return self.observer, tuple(self.regions), self.version

    def follow_observer(self) -> bool:
        """Begin to compute the gaze on the points, and the shares of attention, of the observer as they stand now,
        where that is not being done yet; whether there is nothing left to begin."""
        with self.lock:
            at = self.observer
            fresh = self.baked_for is not None and np.array_equal(self.baked_for, at)
            if not fresh and self.proxy is not None and "gaze" not in self._busy:
                self._busy.add("gaze")
                self.worker.submit("gaze", URGENCY, self._bake(at))
            return fresh

    def follow_shares(self) -> bool:
        """The same for the shares of attention of named areas and shapes."""
        with self.lock:
            if not self.scene.has_gaze:
                return True
            asked = self._asked_shares()
            fresh = self._shares_for is not None and _same(self._shares_for, asked)
            if not fresh and "shares" not in self._busy:
                self._busy.add("shares")
                self.worker.submit("shares", URGENCY, self._shares(asked))
            return fresh

    def picture(
        self,
        name: Hashable,
        view: PinholeView,
        deliver: Callable[[StagePicture, np.ndarray], None],
        width: int,
        spp: int,
    ) -> None:
        """Refine the picture of ``view`` from now on, in place of one of the same ``name``; ``deliver`` is given each
        with its colours (height, width, 3) uint8."""
        self.worker.submit(("picture", name), URGENCY, self._refined(view, deliver, width, spp))

    def inset(
        self, name: Hashable, view: PinholeView, deliver: Callable[[StagePicture, np.ndarray], None], width: int
    ) -> None:
        """The same for a small picture that nobody waits for."""
        self.worker.submit(("inset", name), UNHURRIED, self._refined(view, deliver, width, 1, False))

    def sphere(self, deliver: Callable[[np.ndarray], None], width: int) -> None:
        """All that the observer could turn to, as an equirectangular picture whose middle is ahead of them."""
        self.worker.submit(("inset", "sphere"), UNHURRIED, self._sphere(deliver, width))

    def cancel(self, name: Hashable) -> None:
        """Refine the picture ``name`` no further."""
        self.worker.cancel(("picture", name))

    def scale(self) -> Scale:
        """The scale of the layer that is shown."""
        shade = self.shade
        return layers.choose_scale(shade.layer, shade.fixed or self._ranges.get(shade.layer.title), shade.colors)

    def points(self, level: int = 0) -> Points | None:
        """The points below the ceiling, coloured as the layer shows them, so many as the proxy has at ``level``; None
        where there are no points yet."""
        with self.lock:
            proxy, baked, shade, ceiling = self.proxy, self.baked, self.shade, self.ceiling
        if proxy is None:
            return None
        count, size = proxy.levels[level]
        points, color = proxy.points[:count], proxy.color[:count]
        values = shade.layer.values(baked)
        if values is not None and len(values) == len(proxy.points):
            layer, values = shade.layer, values[:count]
        else:
            layer, values = layers.layer_of(COLOR), None
        colors = layers.colorize(
            layer, color, values, np.ones(count, bool), self.scale() if values is not None else Scale()
        )
        if self.stale_points:
            colors = layers.greyed(colors)
        if ceiling is not None:
            below = points @ self.cut_up <= ceiling
            points, colors = points[below], colors[below]
        return Points(points, colors, size)

    def _gather(self) -> Iterator[None]:
        for proxy in gather(self.scene, [self.observer, self.home.origin]):
            if proxy is not None:
                with self.lock:
                    self.proxy, self.baked, self.baked_for = proxy, {}, None
                self.listener.on_proxy()
            yield None

    def _bake(self, at: np.ndarray) -> Iterator[None]:
        try:
            proxy, version = self.proxy, self.version
            assert proxy is not None
            for step, found in enumerate(bake(self.scene, proxy, at)):
                with self.lock:
                    if self.proxy is not proxy or self.version != version:
                        return
                    self.baked, self._baked_of = found, (at, version)
                    gone = not np.array_equal(self.observer, at)
                    if step == 0:
                        for name in found:
                            self._learn(name, found, found["visibility"] > 0.5)
                self.listener.on_baked()
                if gone:
                    # Roughly is enough while the observer is dragged on.
                    return
                yield None
            with self.lock:
                if self.version == version:
                    self.baked_for = at
        except NergError:
            self.baked_for = at
            raise
        finally:
            self._busy.discard("gaze")

    def _shares(self, asked: tuple[np.ndarray, tuple[Region, ...], int]) -> Iterator[None]:
        try:
            at, regions, version = asked
            found: dict[str, float] = {}
            for more in iter_attention_shares(self.scene, at, regions, self.shapes):
                found |= more
                yield None
                if version != self.version:
                    return
            with self.lock:
                self.shares, self._shares_for, self._shares_of = found, asked, asked
            self.listener.on_shares()
        except NergError:
            # What cannot be counted is told once, not at each tick of a clock.
            self._shares_for = asked
            raise
        finally:
            self._busy.discard("shares")

    def _way(self, at: np.ndarray, free: np.ndarray, deliver: Callable[[np.ndarray], None]) -> Iterator[None]:
        with self.lock:
            proxy, height = self.proxy, self.ceiling
        found = None
        if proxy is not None and (height is None or at @ self.cut_up <= height):
            found = way_out(self.scene, proxy, at, free)
        deliver(at if found is None else found)
        yield None

    def _refined(
        self,
        view: PinholeView,
        deliver: Callable[[StagePicture, np.ndarray], None],
        width: int,
        spp: int,
        leads: bool = True,
    ) -> Iterator[None]:
        """``leads``: whether the automatic range is taken from it."""
        with self.lock:
            shade, at, height = self.shade, self.observer, self.ceiling
        ceiling = None if height is None else Ceiling(height, self.cut_up)
        layer, asked = shade.layer, layers.quantities(shade.layer)
        for found in refine(self.scene, view, at, asked, width, spp, self.pace, ceiling=ceiling):
            if found is not None:
                mask = found.values["opacity"] > 0.5
                values = layer.values(found.values)
                if leads and values is not None and layer.quantity not in self.baked:
                    with self.lock:
                        self._learn(layer.quantity, found.values, mask)
                deliver(found, layers.colorize(layer, found.values["color"], values, mask, self.scale()))
            yield None

    def _sphere(self, deliver: Callable[[np.ndarray], None], width: int) -> Iterator[None]:
        with self.lock:
            at, heading, layer = self.observer, self.heading, self.shade.layer
        height = width // 2
        across = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi
        rise = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
        across, rise = np.meshgrid(across, rise)
        local = np.stack([np.cos(rise) * np.cos(across), np.cos(rise) * np.sin(across), np.sin(rise)], axis=-1)
        directions = local.reshape(-1, 3) @ heading.T
        asked = layers.quantities(layer)
        seen = trace(self.scene, at, filled(directions, self.pace.rays), asked, observers=at[None])
        count = len(directions)
        values = {k: np.asarray(seen[k][0])[:count].reshape(height, width, *seen[k].shape[2:]) for k in asked}
        yield None
        mask = values["opacity"] > 0.5
        deliver(layers.colorize(layer, values["color"], layer.values(values), mask, self.scale()))

    def _learn(self, quantity: str, by_quantity: Mapping[str, np.ndarray], mask: np.ndarray) -> None:
        """Take the automatic range of the layers of ``quantity`` from its values."""
        for layer in self.layers:
            values = layer.values(by_quantity)
            if layer.quantity == quantity and values is not None:
                found = layers.choose_range(layer, values, mask)
                if found is None:
                    self._ranges.setdefault(layer.title, (0.0, 1.0))
                elif found != self._ranges.get(layer.title):
                    self._ranges[layer.title] = found
                    if layer == self.shade.layer and self.shade.fixed is None:
                        self.listener.on_range()


def _same(one: tuple, other: tuple) -> bool:
    return np.array_equal(one[0], other[0]) and one[1:] == other[1:]
