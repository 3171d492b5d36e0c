"""Figures of scenes: gaze spheres, occlusion, and floor plans.

A new figure needs an entry in the table of `.scene_commands` and a function that draws it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.figures.maps import ParticipantPath, SightLines, Walls, floor_figure
from nerg_mi.figures.overlay import Overlay, OverlayLayers, find_overlay, occlusion_figure, shared_limits, unknown_mask
from nerg_mi.figures.scanpath import scanpath_figure
from nerg_mi.figures.sphere import find_projection, sphere_figure
from nerg_mi.files.values import find_names
from nerg_mi.interruption import Interruption
from nerg_mi.maths.types import variant_types
from nerg_mi.progress import Reporter
from nerg_mi.rays.dataset import load_rays
from nerg_mi.rays.events import average_fixations, label_fixations, warn_unknown_tracking
from nerg_mi.rays.filters import find_sessions
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import require_nerg
from nerg_mi.rendering.scene import activate_variant, load_scene
from nerg_mi.rendering.scene_writer import project_to_pixel
from nerg_mi.transport.geometry import SceneGeometry, pixel_solid_angles, trace_depth

from .rays_events import warn_slow_sampling
from .render import render_layers, warn_observer
from .scene_commands import FloorOptions, ScanpathOptions, SceneFigureOptions, SphereOptions, TriptychOptions

# ---- Result of drawing ----


@dataclass(frozen=True)
class Drawing:
    """The axes or the figure that was ``drawn``, its input files, and the ``seed`` of its random numbers, or None."""

    drawn: Any
    inputs: Sequence[Path]
    seed: int | None = None


# ---- Floor plan: paths, gaze rays, and fields of view ----


_GAP = 1.0  # seconds without a ray that interrupt a path
_JUMP = 1.0  # metres between two rays that interrupt a path
_FINEST = 0.02  # metres between points of a drawn path
_DRAWN_LENGTH = 1.2  # drawn length in metres of fields of view and of rays without a hit point


def floor(files: Sequence[Path], options: FloorOptions, reporter: Reporter) -> Drawing:
    """Draw the floor plan of a rays file, over the scene of ``options.scene`` if there is one."""
    (path,) = files
    rays = _select_participants(load_rays(path), options.participants)
    if not len(rays):
        raise NergError(f'"{path}" contains no rays; give another file')
    if not options.cut_height > 0:
        raise NergError(f"{parameter('cut_height')} must be above 0, got {options.cut_height}")
    low, high = _corners(rays)
    inputs, walls = [path], None
    if options.scene is not None:
        from nerg_mi.rendering.bands import require_nerg
        from nerg_mi.rendering.scene import activate_variant, load_scene

        activate_variant(options.mode)
        reporter.progress(0.0, "loading the scene")
        scene = load_scene(options.scene, options.defaults)
        reporter.progress(0.2, "cutting the scene")
        nerg = require_nerg(options.scene, scene)
        walls = cut_scene(nerg, scene, low, high, options.floor_height + options.cut_height, options.floor_height)
        inputs.append(options.scene)
    number = {person: k for k, person in enumerate(np.unique(rays.person))}
    walks = _walks(rays, number) if options.paths else []
    people = f"{len(number)} {'participant' if len(number) == 1 else 'participants'}"
    figure = floor_figure(
        low,
        high,
        walls,
        walks,
        _sights(rays, number, options.num_rays),
        _fields(rays, number, options.num_views),
        options.fov,
        f"{len(rays):,} rays of {people}",
    )
    return Drawing(figure, inputs)


def _select_participants(rays: Rays, names: str | None) -> Rays:
    """Select the rays of the participants ``names``."""
    if names is None:
        return rays
    return rays.select(np.isin(rays.person, find_names(names.split(","), rays.persons, "person")))


def _corners(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a plan that contains all positions and all but outlying hit points."""
    parts = [rays.origin[:, :2]]
    if rays.hit is not None:
        hits = rays.hit[np.isfinite(rays.hit).all(axis=1), :2]
        parts += [np.percentile(hits, [1, 99], axis=0)] if len(hits) else []
    every = np.concatenate(parts)
    low, high = every.min(axis=0), every.max(axis=0)
    edge = max(0.06 * float((high - low).max()), 0.5)
    return low - edge, high + edge


def _walks(rays: Rays, people: Mapping[int, int]) -> list[ParticipantPath]:
    """Return the path of each participant, simplified, and interrupted where there are no rays."""
    sessions = find_sessions(rays)
    order = np.arange(len(rays)) if sessions.order is None else sessions.order
    label, walks = sessions.label_rays(), []
    for person in people:
        mine = rays.person[order] == person
        rows, recording = order[mine], label[mine]
        places, t = rays.origin[rows, :2], rays.t[rows]
        step = np.linalg.norm(np.diff(places, axis=0), axis=1)
        breaks = np.r_[True, (np.abs(np.diff(t)) > _GAP) | (step > _JUMP) | (np.diff(recording) != 0)]
        selected = breaks | np.r_[True, np.diff(np.floor(np.cumsum(np.r_[0.0, step]) / _FINEST)) > 0]
        walks.append(ParticipantPath(rays.persons[person], places[selected], breaks[selected]))
    return walks


def _sights(rays: Rays, number: dict[int, int], count: int) -> SightLines | None:
    """Return ``count`` evenly selected rays."""
    if not count:
        return None
    some = np.unique(np.linspace(0, len(rays) - 1, count).astype(int))
    origins, ends = rays.origin[some, :2], _ahead(rays, some)
    if rays.hit is not None:
        hit = rays.hit[some, :2]
        ends = np.where(np.isfinite(hit), hit, ends)
    return SightLines(origins, ends, np.array([number[p] for p in rays.person[some]]))


def _fields(rays: Rays, number: dict[int, int], count: int) -> SightLines | None:
    """Return fields of view at ``count`` evenly selected samples of each participant."""
    if not count:
        return None
    selected = []
    for person in number:
        mine = np.flatnonzero(rays.person == person)
        mine = mine[np.argsort(rays.t[mine], kind="stable")]
        selected.append(mine[np.unique(np.linspace(0, len(mine) - 1, count).astype(int))])
    some = np.concatenate(selected)
    return SightLines(rays.origin[some, :2], _ahead(rays, some), np.array([number[p] for p in rays.person[some]]))


def _ahead(rays: Rays, some: np.ndarray) -> np.ndarray:
    """Return floor positions (n, 2) at a fixed distance along the rays ``some``."""
    return rays.origin[some, :2] + _DRAWN_LENGTH * rays.direction[some, :2]


# ---- Rendering a scene file for a figure ----

MAX_PIXELS = 1 << 23
"""Maximum number of pixels: a figure is drawn in one piece in double precision, with about 200 bytes per pixel."""


class OpenScene:
    """A loaded scene file with its integrator ``nerg`` and its ``camera``.

    `see` renders one of ``parts`` images and reports progress. Created by `open_scene`.
    """

    def __init__(self, path: Path, scene: Any, options: SceneFigureOptions, tell: Callable[[float], None], parts: int):
        self.path, self.scene, self._options = path, scene, options
        self.nerg = require_nerg(path, scene)
        if not scene.sensors():
            raise NergError(f'"{path}" has no sensor; add a <sensor>, or in Python a camera by make_scene')
        self._tell, self._parts, self._done = tell, parts, 0

    def camera(self, index: int) -> Any:
        """Return the sensor with this ``index``. Raises `NergError` if there is none."""
        count = len(self.scene.sensors())
        if not 0 <= index < count:
            raise NergError(f'"{self.path}" has {count} sensor(s), and index {index} is out of range: -s counts from 0')
        return self.scene.sensors()[index]

    def render(self, sensor: Any, overlay: Overlay) -> OverlayLayers:
        """Render ``sensor`` with the AOV of ``overlay``."""
        options, first = self._options, self._done
        on_strip = lambda part, total: self._tell((first + part / total) / self._parts)
        layers = render_layers(
            self.path, self.scene, sensor, overlay, options.spp, options.seed, on_strip, options.smoothing
        )
        self._done += 1
        return layers


@contextmanager
def open_scene(path: Path, options: SceneFigureOptions, reporter: Reporter, parts: int = 1) -> Iterator[OpenScene]:
    """Load the scene file ``path`` for rendering ``parts`` images within the block, which Ctrl-C ends.

    Raises `NergError` for other files, and if the integrator is not `nerg`.
    """
    activate_variant(options.mode)
    with Interruption() as stop:

        def tell(share: float) -> None:
            stop.check()
            reporter.progress(share, f"rendering, {100 * share:.0f} %")

        loaded = load_scene(path, options.defaults)
        stop.check()
        yield OpenScene(path, loaded, options, tell, parts)
        stop.check()


def upright_pose(sensor: Any) -> Any:
    """Return the pose (scalar transform) of ``sensor`` levelled.

    Its up direction is the scene axis that is nearest to the sensor's.
    """
    import mitsuba as mi

    matrix = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    eye, up, ahead = matrix[:3, 3], matrix[:3, 1], matrix[:3, 2]
    axis = int(np.argmax(np.abs(up)))
    level = np.zeros(3)
    level[axis] = np.sign(up[axis]) or 1.0
    heading = ahead - level * (ahead @ level)
    if np.linalg.norm(heading) < 1e-3 * np.linalg.norm(ahead):
        heading = np.roll(level, 1)  # the sensor looks straight up or down
    heading = heading / np.linalg.norm(heading)
    look_at = mi.ScalarTransform4f().look_at
    return look_at(origin=eye.tolist(), target=(eye + heading).tolist(), up=level.tolist())


def make_film(width: int, height: int) -> dict[str, Any]:
    """Return a film with a box filter. Raises `NergError` for too many pixels."""
    if width * height > MAX_PIXELS:
        raise NergError(f"a figure of {width:,} x {height:,} pixels is too large; reduce its size")
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
        "component_format": "float32",
    }


def copy_sampler(sensor: Any) -> dict[str, Any]:
    """Return an independent sampler with the sample count of ``sensor``."""
    return {"type": "independent", "sample_count": int(sensor.sampler().sample_count())}


# ---- Gaze sphere: the gaze of the observer over all directions ----


def sphere(files: Sequence[Path], options: SphereOptions, reporter: Reporter) -> Drawing:
    """Draw the gaze sphere of the scene's observer, or of its camera if there is no observer."""
    import mitsuba as mi

    find_projection(options.projection)
    style = options.style()
    (path,) = files
    overlay = find_overlay("gaze")
    with open_scene(path, options, reporter) as opened:
        camera = opened.camera(options.sensor)
        width = options.width // 2 * 2
        panorama = {
            "type": "panorama",
            "to_world": upright_pose(opened.nerg.observer or camera),
            "film": make_film(width, width // 2),
            "sampler": copy_sampler(camera),
        }
        warn_observer(opened.scene, reporter)
        seen = opened.render(mi.load_dict(panorama), overlay)
    limits = shared_limits([overlay.limits(seen)], options.vmax)
    overlay.check_limits(limits)
    heat = overlay.heat(limits, style)
    integral = float((seen.values.astype(np.float64) * pixel_solid_angles(width, width // 2)).sum())
    title = f"Gaze in all directions: integral {integral:.3g}"
    unknown = unknown_mask(seen, True) if style.hatch_unknown else None
    figure = sphere_figure(
        seen.color, seen.values, seen.mask, heat, title, options.projection, unknown, note=seen.support_note
    )
    return Drawing(figure, [path], options.seed)


# ---- Triptych ----
#
# The occlusion figure of the paper: the observer's view, and another camera without and with occlusion.


def triptych(files: Sequence[Path], options: TriptychOptions, reporter: Reporter) -> Drawing:
    """Draw three images with a common colour scale; the scene needs an observer other than the camera."""
    from nerg_mi.transport.observer import sensor_center

    style = options.style()
    (path,) = files
    overlay = find_overlay("gaze")
    with open_scene(path, options, reporter, 3) as opened:
        camera, nerg = opened.camera(options.sensor), opened.nerg
        if nerg.observer is None:
            raise NergError(
                f'"{path}" has no observer other than its camera, so nothing is occluded; add a <sensor '
                'name="observer"> to its integrator'
            )
        if camera.class_name() != "PerspectiveCamera":
            raise NergError(f'sensor {options.sensor} of "{path}" is not a perspective camera; choose another with -s')
        warn_observer(opened.scene, reporter)
        own_view = opened.render(_observer_camera(nerg.observer, camera), overlay)
        with_occlusion, nerg.occlusion = nerg.occlusion, False
        try:
            without = opened.render(camera, overlay)
        finally:
            nerg.occlusion = with_occlusion
        seen = opened.render(camera, overlay)
        marker = project_to_pixel(camera, sensor_center(nerg.observer))
    limits = shared_limits([overlay.limits(view) for view in (own_view, without, seen)], options.vmax)
    overlay.check_limits(limits)
    heat = overlay.heat(limits, style)
    first, second, third = ((view.color, view.values, view.mask) for view in (own_view, without, seen))
    figure = occlusion_figure(first, second, third, heat, marker, style.hatch_unknown, seen.support_note)
    return Drawing(figure, [path], options.seed)


# ---- Scanpaths ----


def scanpath(files: Sequence[Path], options: ScanpathOptions, reporter: Reporter) -> Drawing:
    """Draw the fixations of participants of a rays file over a view of ``options.scene``."""
    from nerg_mi.transport.observer import sensor_center

    (path,) = files
    if options.scene is None:
        raise NergError(f"a scanpath is drawn over a view of a scene; name its file with {parameter('scene')}")
    rays = load_rays(path)
    rays = _select_participants(rays, rays.persons[0] if options.participants is None else options.participants)
    low, high = (-np.inf if options.start is None else options.start), (np.inf if options.end is None else options.end)
    rays = rays.select((rays.t >= low) & (rays.t <= high))
    if not len(rays):
        raise NergError(
            f'"{path}" has no rays of these participants in this time; change {parameter("participants")} or '
            f"{parameter('start')}"
        )
    warn_unknown_tracking(rays.tracking, reporter.warn)
    warn_slow_sampling(rays, options, reporter)
    rules, dispersion = options.event_rules(), options.dispersion_threshold
    fixations, durations = average_fixations(rays, label_fixations(rays, rules, dispersion)[0])
    order = np.lexsort((fixations.t, fixations.person))
    rank = np.arange(len(order)) - np.searchsorted(fixations.person[order], fixations.person[order])
    rows = order[rank < options.max_fixations]
    view = SceneFigureOptions(
        defaults=options.defaults, spp=options.spp, seed=options.seed, mode=options.mode, smoothing=0
    )
    with open_scene(options.scene, view, reporter) as opened:
        camera = opened.camera(options.sensor)
        if camera.class_name() != "PerspectiveCamera":
            raise NergError(f'sensor {options.sensor} of "{options.scene}" is not a perspective camera; choose another')
        layers = opened.render(camera, find_overlay("depth"))
        geometry = SceneGeometry(opened.nerg.medium, opened.scene)
        origins, directions = fixations.origin[rows], fixations.direction[rows]
        depth, opacity = trace_depth(geometry, origins, directions, opened.nerg.settings)
        targets = np.where(opacity[:, None] >= _SURFACE, origins + depth[:, None] * directions, np.nan)
        pixels = _visible_pixels(camera, targets, layers.values, np.ravel(np.array(sensor_center(camera))))
    hidden = int(np.isnan(pixels[:, 0]).sum())
    people, index = np.unique(fixations.person[rows], return_inverse=True)
    threshold = f"I-VT, {rules.velocity_threshold:g}°/s" if dispersion is None else f"I-DT, {dispersion:g}°"
    note = f"{len(rows)} fixations ({threshold}, at least {rules.min_fixation:g} s)"
    note += f"; {hidden} outside of the image or hidden" if hidden else ""
    names = tuple(rays.persons[p] for p in people)
    axes = scanpath_figure(layers.color, pixels, durations[rows], index, names, "Scanpath", note)
    return Drawing(axes, [path, options.scene], options.seed)


def _visible_pixels(camera: Any, points: np.ndarray, depth: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) of ``points`` (N, 3) in the image of ``camera``; NaN outside of it, or if they are more
    than 3 % farther than the surface at the pixel."""
    mi = variant_types()
    out = np.full((len(points), 2), np.nan)
    for row, point in enumerate(points):
        pixel = project_to_pixel(camera, mi.Point3f(*point.tolist())) if np.isfinite(point).all() else None
        if pixel is None:
            continue
        column, line = (int(np.clip(round(v), 0, n - 1)) for v, n in zip(pixel, depth.shape[::-1]))
        if not 0 < 1.03 * depth[line, column] < np.linalg.norm(point - center):
            out[row] = pixel
    return out


def _observer_camera(observer: Any, camera: Any) -> Any:
    """Return a camera at the pose of ``observer`` with the field of view and film of ``camera``."""
    import mitsuba as mi

    width, height = map(int, camera.film().crop_size())
    matrix = np.array(observer.world_transform().matrix, np.float64).reshape(4, 4)
    settings = {
        "type": "perspective",
        "fov": float(np.ravel(np.array(mi.traverse(camera)["x_fov"]))[0]),
        "fov_axis": "x",
        "near_clip": camera.near_clip(),
        "far_clip": camera.far_clip(),
        "to_world": mi.ScalarTransform4f(matrix.tolist()),
        "film": make_film(width, height),
        "sampler": copy_sampler(camera),
    }
    return mi.load_dict(settings)


# ---- Horizontal cut through a scene, for floor plans ----


CELLS = 360
"""Number of grid cells along the longer side of a plan."""

_SURFACE = 0.5


def cut_scene(nerg: Any, scene: Any, low: np.ndarray, high: np.ndarray, level: float, floor: float) -> Walls:
    """Cut the scene horizontally between the corners ``low`` and ``high`` (2,) at the height ``level``, +z up.

    From the centre of each cell rays are traced down, which gives the height of what is below, and to the neighbouring
    cells, which tells where the cut passes through objects. A cell inside an object hits it immediately. ``floor`` is
    the height from which heights are counted. All lengths are in scene units.
    """
    place = SceneGeometry(nerg.medium, scene)
    side = float(max(high - low)) / CELLS
    nx, ny = (max(int(np.ceil(v / side)), 1) for v in high - low)
    x, y = low[0] + (np.arange(nx) + 0.5) * side, low[1] + (np.arange(ny) + 0.5) * side
    centres = np.stack([*np.meshgrid(x, y), np.full((ny, nx), level)], axis=-1).reshape(-1, 3)

    def trace_hits(direction: tuple[float, float, float]) -> np.ndarray:
        depth, opacity = trace_depth(place, centres, np.broadcast_to(direction, centres.shape), nerg.settings)
        return np.where(opacity >= _SURFACE, depth, np.inf).reshape(ny, nx)

    down = trace_hits((0, 0, -1))
    height = np.where(np.isfinite(down), level - floor - down, np.nan)
    cut = (
        (trace_hits((1, 0, 0)) < side)
        | (trace_hits((0, 1, 0)) < side)
        | (trace_hits((-1, 0, 0)) < side)
        | (trace_hits((0, -1, 0)) < side)
    )
    return Walls(low, low + side * np.array([nx, ny]), height, cut, level - floor)
