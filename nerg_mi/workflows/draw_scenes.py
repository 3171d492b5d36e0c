"""Figures of scenes: gaze spheres, occlusion, and floor plans.

One more is a `Kind` in the table of `.scene_commands`, and the function that draws it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.figures.maps import ParticipantPath, SightLines, Walls, floor_figure
from nerg_mi.figures.overlay import Overlay, OverlayLayers, find_overlay, occlusion_figure, shared_limits, unknown_mask
from nerg_mi.figures.sphere import find_projection, sphere_figure
from nerg_mi.interruption import Interruption
from nerg_mi.rays.dataset import load_rays
from nerg_mi.rays.filters import find_sessions
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.bands import require_nerg
from nerg_mi.rendering.scene import activate_variant, load_scene
from nerg_mi.rendering.scene_writer import project_to_pixel
from nerg_mi.transport.geometry import SceneGeometry, pixel_solid_angles, trace_depth

from .base import Reporter
from .render import render_layers
from .scene_commands import FloorOptions, SceneFigureOptions, SphereOptions, TriptychOptions

# ---- A kind of figure: what it is called, which files and options it takes, and how it is drawn ----


@dataclass(frozen=True)
class Drawing:
    """A ``figure`` of matplotlib, the files that it was made of (``inputs``), and the ``seed`` of what is random in it,
    or None."""

    figure: Any
    inputs: Sequence[Path]
    seed: int | None = None


# ---- The floor plan of rays in their place: paths, where people looked, and fields of view ----


_GAP = 1.0  # seconds without a ray after which a path begins anew
_JUMP = 1.0  # metres between two rays that nobody walks
_FINEST = 0.02  # metres between points of a path
_REACH = 1.2  # metres that a field of view, or a ray whose hit is not known, is drawn long


def floor(files: Sequence[Path], options: FloorOptions, reporter: Reporter) -> Drawing:
    """The plan of the rays of a file, over the place of ``options.scene`` where there is one."""
    (path,) = files
    rays = _of_people(load_rays(path), options.participants)
    if not len(rays):
        raise NergError(f'"{path}" holds no rays; give a file of rays that has some')
    if not options.cut_height > 0:
        raise NergError(f"--cut is a height above the floor, got {options.cut_height}")
    low, high = _corners(rays)
    inputs, walls = [path], None
    if options.scene is not None:
        from nerg_mi.rendering.bands import require_nerg
        from nerg_mi.rendering.scene import activate_variant, load_scene

        activate_variant(options.mode)
        reporter.progress(0.0, "loading the scene")
        scene = load_scene(options.scene, options.defaults)
        reporter.progress(0.2, "cutting the place")
        nerg = require_nerg(options.scene, scene)
        walls = cut_scene(nerg, scene, low, high, options.floor_height + options.cut_height, options.floor_height)
        inputs.append(options.scene)
    number = {person: k for k, person in enumerate(np.unique(rays.person))}
    walks = _walks(rays, number) if options.paths else []
    people = f"{len(number)} {'person' if len(number) == 1 else 'people'}"
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


def _of_people(rays: Rays, names: str | None) -> Rays:
    if names is None:
        return rays
    wanted = [name.strip() for name in names.split(",")]
    missing = [name for name in wanted if name not in rays.persons]
    if missing:
        some = ", ".join(rays.persons[:8])
        raise NergError(f'the rays have no person "{missing[0]}"; they have {some}{", ..." * (len(rays.persons) > 8)}')
    return rays.select(np.isin(rays.person, [rays.persons.index(name) for name in wanted]))


def _corners(rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a plan that holds where people were and, but for strays, what they looked at."""
    parts = [rays.origin[:, :2]]
    if rays.hit is not None:
        hits = rays.hit[np.isfinite(rays.hit).all(axis=1), :2]
        parts += [np.percentile(hits, [1, 99], axis=0)] if len(hits) else []
    every = np.concatenate(parts)
    low, high = every.min(axis=0), every.max(axis=0)
    edge = max(0.06 * float((high - low).max()), 0.5)
    return low - edge, high + edge


def _walks(rays: Rays, people: Mapping[int, int]) -> list[ParticipantPath]:
    """The path of each person: not finer than can be seen, and with breaks where they were not recorded."""
    sessions = find_sessions(rays)
    order = np.arange(len(rays)) if sessions.order is None else sessions.order
    label, found = sessions.label_rays(), []
    for person in people:
        mine = rays.person[order] == person
        rows, recording = order[mine], label[mine]
        places, t = rays.origin[rows, :2], rays.t[rows]
        step = np.linalg.norm(np.diff(places, axis=0), axis=1)
        breaks = np.r_[True, (np.abs(np.diff(t)) > _GAP) | (step > _JUMP) | (np.diff(recording) != 0)]
        kept = breaks | np.r_[True, np.diff(np.floor(np.cumsum(np.r_[0.0, step]) / _FINEST)) > 0]
        found.append(ParticipantPath(rays.persons[person], places[kept], breaks[kept]))
    return found


def _sights(rays: Rays, number: dict[int, int], count: int) -> SightLines | None:
    """``count`` rays, evenly taken."""
    if not count:
        return None
    some = np.unique(np.linspace(0, len(rays) - 1, count).astype(int))
    origins, ends = rays.origin[some, :2], _ahead(rays, some)
    if rays.hit is not None:
        hit = rays.hit[some, :2]
        ends = np.where(np.isfinite(hit), hit, ends)
    return SightLines(origins, ends, np.array([number[p] for p in rays.person[some]]))


def _fields(rays: Rays, number: dict[int, int], count: int) -> SightLines | None:
    """Fields of view at ``count`` moments of each person, evenly spread over their rays."""
    if not count:
        return None
    chosen = []
    for person in number:
        mine = np.flatnonzero(rays.person == person)
        mine = mine[np.argsort(rays.t[mine], kind="stable")]
        chosen.append(mine[np.unique(np.linspace(0, len(mine) - 1, count).astype(int))])
    some = np.concatenate(chosen)
    return SightLines(rays.origin[some, :2], _ahead(rays, some), np.array([number[p] for p in rays.person[some]]))


def _ahead(rays: Rays, some: np.ndarray) -> np.ndarray:
    """Places (n, 2) on the floor where the rays ``some`` lead, as far as people look level."""
    return rays.origin[some, :2] + _REACH * rays.direction[some, :2]


# ---- A scene file opened for a figure, and what its cameras see ----

MAX_PIXELS = 1 << 23
"""A figure is drawn in one piece, in double precision, some 200 bytes a pixel; a film of 3,840 x 2,160 is allowed."""


class OpenScene:
    """The scene file ``path`` as it is loaded, its integrator ``nerg`` and its ``camera``.

    ``see`` renders, and tells of it as the next of ``parts`` pictures. Made by `open_scene`.
    """

    def __init__(self, path: Path, scene: Any, options: SceneFigureOptions, tell: Callable[[float], None], parts: int):
        self.path, self.scene, self._options = path, scene, options
        self.nerg = require_nerg(path, scene)
        if not scene.sensors():
            raise NergError(f'"{path}" has no sensor; give it one')
        self._tell, self._parts, self._done = tell, parts, 0

    def camera(self, index: int) -> Any:
        """The sensor with this ``index``. Raises `NergError` for one that is not there."""
        count = len(self.scene.sensors())
        if not 0 <= index < count:
            raise NergError(
                f'"{self.path}" has {count} sensor(s) and number {index} was asked for: choose -s from 0 on'
            )
        return self.scene.sensors()[index]

    def render(self, sensor: Any, overlay: Overlay) -> OverlayLayers:
        """What ``sensor`` sees with the ``overlay``'s quantity."""
        options, first = self._options, self._done
        on_strip = lambda part, total: self._tell((first + part / total) / self._parts)
        found = render_layers(self.path, self.scene, sensor, overlay, options.spp, options.seed, on_strip)
        self._done += 1
        return found


@contextmanager
def open_scene(path: Path, options: SceneFigureOptions, reporter: Reporter, parts: int = 1) -> Iterator[OpenScene]:
    """The scene file ``path``, of which ``parts`` pictures will be rendered within the block, which Ctrl-C ends. Raises
    `NergError` for what is none, or has another integrator than `nerg`."""
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
    """A pose (scalar transform) at the place of ``sensor``, turned to the same side but level: its up is the axis of
    the scene that is nearest to the sensor's."""
    import mitsuba as mi

    matrix = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    eye, up, ahead = matrix[:3, 3], matrix[:3, 1], matrix[:3, 2]
    axis = int(np.argmax(np.abs(up)))
    level = np.zeros(3)
    level[axis] = np.sign(up[axis]) or 1.0
    heading = ahead - level * (ahead @ level)
    if np.linalg.norm(heading) < 1e-3 * np.linalg.norm(ahead):
        heading = np.roll(level, 1)  # it looks straight up or down
    heading = heading / np.linalg.norm(heading)
    look_at = mi.ScalarTransform4f().look_at
    return look_at(origin=eye.tolist(), target=(eye + heading).tolist(), up=level.tolist())


def make_film(width: int, height: int) -> dict[str, Any]:
    """A film of so many pixels on which no value is blended with its neighbours'. Raises `NergError` for too many."""
    if width * height > MAX_PIXELS:
        raise NergError(
            f"a figure of {width:,} x {height:,} pixels is too large to be drawn in one piece; ask for less"
        )
    return {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
        "component_format": "float32",
    }


def copy_sampler(sensor: Any) -> dict[str, Any]:
    """As many samples a pixel as ``sensor`` has, drawn independently."""
    return {"type": "independent", "sample_count": int(sensor.sampler().sample_count())}


# ---- The gaze of a scene's observer over all directions, as a map of the sphere ----


def sphere(files: Sequence[Path], options: SphereOptions, reporter: Reporter) -> Drawing:
    """The sphere of the observer of the scene file, or of its camera where it has none, turned to where they look."""
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
        seen = opened.render(mi.load_dict(panorama), overlay)
    limits = shared_limits([overlay.limits(seen)], options.vmax)
    overlay.check_limits(limits)
    heat = overlay.heat(limits, style)
    integral = float((seen.values.astype(np.float64) * pixel_solid_angles(width, width // 2)).sum())
    title = f"All that the observer can turn to: integral {integral:.3g}"
    unknown = unknown_mask(seen, True) if style.hatch_unknown else None
    figure = sphere_figure(
        seen.color, seen.values, seen.mask, heat, title, options.projection, unknown, note=seen.support_note
    )
    return Drawing(figure, [path], options.seed)


# ---- Triptych ----
#
# The paper's occlusion figure of any scene: the observer's view, and another camera without and with occlusion.


def triptych(files: Sequence[Path], options: TriptychOptions, reporter: Reporter) -> Drawing:
    """Three pictures with one scale; the scene file needs an observer who is not the camera."""
    from nerg_mi.transport.observer import sensor_center

    style = options.style()
    (path,) = files
    overlay = find_overlay("gaze")
    with open_scene(path, options, reporter, 3) as opened:
        camera, nerg = opened.camera(options.sensor), opened.nerg
        if nerg.observer is None:
            raise NergError(
                f'"{path}" has no observer beside its camera, so that nothing is hidden from either; give its '
                'integrator a <sensor name="observer">'
            )
        if camera.class_name() != "PerspectiveCamera":
            raise NergError(f'sensor {options.sensor} of "{path}" is no perspective camera; choose another with -s')
        own = opened.render(_own_camera(nerg.observer, camera), overlay)
        with_occlusion, nerg.occlusion = nerg.occlusion, False
        try:
            without = opened.render(camera, overlay)
        finally:
            nerg.occlusion = with_occlusion
        seen = opened.render(camera, overlay)
        marker = project_to_pixel(camera, sensor_center(nerg.observer))
    limits = shared_limits([overlay.limits(of) for of in (own, without, seen)], options.vmax)
    overlay.check_limits(limits)
    heat = overlay.heat(limits, style)
    first, second, third = ((of.color, of.values, of.mask) for of in (own, without, seen))
    figure = occlusion_figure(first, second, third, heat, marker, style.hatch_unknown, seen.support_note)
    return Drawing(figure, [path], options.seed)


def _own_camera(observer: Any, camera: Any) -> Any:
    """A camera with the field of view and film of ``camera`` where the ``observer`` is, turned as they are."""
    import mitsuba as mi

    width, height = map(int, camera.film().crop_size())
    matrix = np.array(observer.world_transform().matrix, np.float64).reshape(4, 4)
    own = {
        "type": "perspective",
        "fov": float(np.ravel(np.array(mi.traverse(camera)["x_fov"]))[0]),
        "fov_axis": "x",
        "near_clip": camera.near_clip(),
        "far_clip": camera.far_clip(),
        "to_world": mi.ScalarTransform4f(matrix.tolist()),
        "film": make_film(width, height),
        "sampler": copy_sampler(camera),
    }
    return mi.load_dict(own)


# ---- A place cut at a height, seen from above: what a floor plan of it shows ----


CELLS = 360
"""Cells along the longer side of a plan."""

_SURFACE = 0.5


def cut_scene(nerg: Any, scene: Any, low: np.ndarray, high: np.ndarray, level: float, floor: float) -> Walls:
    """The place of the integrator ``nerg`` in ``scene`` between the corners ``low`` and ``high`` (2,), cut at the
    height ``level``; all in scene units, +z up.

    From each cell's centre rays go down, to the height of what they meet, and to the next cells: the cut goes through
    what lies between. A cell in the midst of thick matter meets it at once. ``floor``: the height from which others are
    counted.
    """
    place = SceneGeometry(nerg.medium, scene)
    side = float(max(high - low)) / CELLS
    nx, ny = (max(int(np.ceil(v / side)), 1) for v in high - low)
    x, y = low[0] + (np.arange(nx) + 0.5) * side, low[1] + (np.arange(ny) + 0.5) * side
    centres = np.stack([*np.meshgrid(x, y), np.full((ny, nx), level)], axis=-1).reshape(-1, 3)

    def met(direction: tuple[float, float, float]) -> np.ndarray:
        depth, opacity = trace_depth(place, centres, np.broadcast_to(direction, centres.shape), nerg.settings)
        return np.where(opacity >= _SURFACE, depth, np.inf).reshape(ny, nx)

    down = met((0, 0, -1))
    height = np.where(np.isfinite(down), level - floor - down, np.nan)
    cut = (met((1, 0, 0)) < side) | (met((0, 1, 0)) < side) | (met((-1, 0, 0)) < side) | (met((0, -1, 0)) < side)
    return Walls(low, low + side * np.array([nx, ny]), height, cut, level - floor)
