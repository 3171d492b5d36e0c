"""Gaze on a flat area, such as a poster, a screen or a shelf: its picture from the front, and its coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.environment.arrays import Camera
from nerg_mi.environment.environment import Environment
from nerg_mi.environment.scene import Scene, make_scene
from nerg_mi.environment.scene_loading import activate_mitsuba
from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.figures.overlay import Heat, gaze_figure, robust_max, srgb, write_png
from nerg_mi.figures.pictures import render
from nerg_mi.figures.settings import SMOOTHING, Style
from nerg_mi.figures.style import (
    Provenance,
    changed_arguments,
    check_figure,
    encode,
    existing_files,
    make_provenance,
    save,
    show_figure,
)
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.dataframes import make_dataframe
from nerg_mi.files.html import image, markup, paragraph
from nerg_mi.files.tables import write_csv
from nerg_mi.files.values import FilePath, to_numbers, to_path
from nerg_mi.formats.alignments import AnySimilarity
from nerg_mi.formats.boxes import Region
from nerg_mi.maths.types import Axes, Figure
from nerg_mi.progress import Progress, open_reporter
from nerg_mi.ranges import LENGTHS, POSITIVE_VALUES, SPP, Range, check_ranges
from nerg_mi.tracking.dataset import open_rays
from nerg_mi.tracking.objects import ObjectPoses
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.mitsuba_mesh import read_triangles

from .areas import AnyAreas, AreaGroup, Areas
from .moving import MovingAreas, check_objects, place_objects
from .placed import PlacedAreas, ShapeAoi, open_placed_areas
from .statistics import open_inputs

_MAX_THICKNESS = 0.5  # of a flat area, relative to its shorter side
_MAX_DEVIATION = 0.05  # of four corners from those of a rectangle, relative to its diagonal
_LEVEL = 0.9  # cosine of the angle to the upward direction from which an area lies flat, as a table does
_CAMERA_DISTANCE = 0.1  # of the camera from the area, relative to its diagonal; what is nearer is in the picture
_SIGMA_RATIO = 1.1  # between kernel widths that are computed apart
_GREY = 0.2  # linear, of an area without an environment


# ---- The rectangle ----


@dataclass(frozen=True, eq=False)
class FlatArea:
    """A rectangle seen from the front: its upper left ``corner`` (3,), the unit vectors ``axes`` (2, 3) to the right
    and down, and its ``size`` (2,) along them, in scene units."""

    corner: np.ndarray
    axes: np.ndarray
    size: np.ndarray

    @property
    def normal(self) -> np.ndarray:
        """Unit vector (3,) towards those who see the front."""
        return np.cross(self.axes[1], self.axes[0])

    @classmethod
    def from_corners(cls, corners: ArrayLike) -> FlatArea:
        """Return the rectangle of four corners (4, 3): upper left, upper right, lower right, lower left. Raises
        `NergError` if they are not about those of a rectangle."""
        points = to_numbers(corners, parameter("corners"))
        message = f"{parameter('corners')} must be four points x,y,z of a rectangle, clockwise from the upper left one"
        if points.shape != (4, 3):
            raise NergError(message)
        a, b, c, d = points
        across, down = (b - a + c - d) / 2, (d - a + c - b) / 2
        size = np.linalg.norm([across, down], axis=1)
        diagonal = float(np.linalg.norm(size))
        skew = abs(across @ down) / max(size.prod(), 1e-30) * diagonal
        bend = np.linalg.norm(a - b + c - d) / 2
        if not (size.min() > 0 and max(skew, bend) <= _MAX_DEVIATION * diagonal):
            raise NergError(f"{message}; these are no rectangle")
        right = across / size[0]
        lower = down - (down @ right) * right
        axes = np.stack([right, lower / np.linalg.norm(lower)])
        return cls(points.mean(axis=0) - size / 2 @ axes, axes, size)

    @classmethod
    def from_points(
        cls, name: str, points: np.ndarray, axes: np.ndarray, observers: np.ndarray, up: np.ndarray, is_back: bool
    ) -> FlatArea:
        """Return the rectangle that encloses a flat area, on the side of most observers or, ``is_back``, on the other.

        Parameters
        ----------
        name
            Name of the area in messages.
        points
            Points (P, 3) of the area, of which some are on each of its borders.
        axes
            Vectors (3, 3), one of which the left and right borders follow: the edges of a box, or those of the world.
        observers
            Positions (N, 3). Of an area that lies flat, the lower border is that next to them.
        up
            The upward direction (3,).

        Raises
        ------
        NergError
            The area is not flat.
        """
        center, observer = points.mean(axis=0), np.median(observers, axis=0)
        normal = np.linalg.eigh(np.cov(points.T))[1][:, 0]
        normal = normal if (np.median((observers - center) @ normal) > 0) != is_back else -normal
        upward = center - observer if abs(normal @ up) > _LEVEL else up
        upward = upward - (upward @ normal) * normal
        candidates = np.concatenate([axes, -axes])
        candidates = candidates - np.outer(candidates @ normal, normal)
        lower = candidates[np.argmin(candidates @ upward)]
        lower = lower / np.linalg.norm(lower)
        frame = np.stack([np.cross(normal, lower), lower, normal])
        local = points @ frame.T
        low, high = local.min(axis=0), local.max(axis=0)
        size = high - low
        if not (size[:2].min() > 0 and size[2] <= _MAX_THICKNESS * size[:2].min()):
            raise NergError(
                f'the area "{sanitize(name, 40)}" is not flat, but {" x ".join(f"{v:.3g}" for v in size)} scene units; '
                f"give a thinner one, or its corners with {parameter('corners')}"
            )
        return cls(np.array([low[0], low[1], high[2]]) @ frame, frame[:2], size[:2])

    def intersect(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which rays (N, 3) meet the front, their positions (M, 2) to the right and down from the corner, and
        their distances (M,)."""
        approach = -d @ self.normal
        height = (o - self.corner) @ self.normal
        rows = np.flatnonzero((approach > 0) & (height > 0))
        distance = height[rows] / approach[rows]
        xy = (o[rows] + distance[:, None] * d[rows] - self.corner) @ self.axes.T
        is_inside = ((xy >= 0) & (xy <= self.size)).all(axis=1)
        return rows[is_inside], xy[is_inside], distance[is_inside]

    def count_pixels(self, resolution: int) -> tuple[int, int]:
        """Return height and width of its picture, the longer one of which is ``resolution``."""
        width, height = np.maximum(np.round(self.size * resolution / self.size.max()), 1).astype(int).tolist()
        return height, width

    def make_sensor(self, shape: tuple[int, int], spp: int) -> Any:
        """Return an orthographic camera in front of the area, whose film has the ``shape`` (height, width), with
        ``spp`` samples per pixel."""
        import mitsuba as mi

        target = self.corner + self.size / 2 @ self.axes
        distance = _CAMERA_DISTANCE * float(np.linalg.norm(self.size))
        origin = (target + distance * self.normal).tolist()
        camera = Camera(origin, target.tolist(), (-self.axes[1]).tolist(), width=shape[1], height=shape[0])
        content = {name: value for name, value in camera.to_dict(spp).items() if not name.startswith("fov")}
        half = float(self.size[0]) / 2
        to_world = content["to_world"] @ mi.ScalarTransform4d().scale([half, half, 1])
        clip = {"near_clip": 1e-3 * distance}
        return mi.load_dict({**content, "type": "orthographic", "to_world": to_world, **clip})


# ---- Gaze on it ----


@dataclass(frozen=True, eq=False, repr=False)
class AreaGaze:
    """Gaze on a flat area.

    Attributes
    ----------
    samples : dict of str to ndarray
        Columns of the samples whose rays meet the area from the front: ``t`` (seconds), ``participant``, ``x`` to the
        right and ``y`` down from its upper left corner (metres), ``distance`` (metres), ``occluded``: 1 if something
        was in front of it, 0 if not, NaN if this is unknown, and ``x_px`` and ``y_px`` in pixels of the picture.
    color : ndarray of shape (height, width, 3)
        The area from the front, linear.
    density : ndarray of shape (height, width)
        Density of the samples that are not occluded per square metre, smoothed; its integral is 1, less what the
        smoothing moves beyond the borders.
    size : tuple of float
        Width and height in metres.
    """

    samples: dict[str, np.ndarray]
    color: np.ndarray
    density: np.ndarray
    size: tuple[float, float]
    heat: Heat
    title: str
    note: str
    provenance: Provenance

    def to_dataframe(self, library: str | None = None) -> Any:
        """Return the samples as a data frame of ``pandas``, ``polars`` or ``pyarrow``. Default: the first of these that
        is installed."""
        return make_dataframe(self.samples, library)

    def plot(self, axes: Axes | None = None) -> Figure:
        """Draw the density over the picture, in new or given ``axes``, whose units are pixels."""
        mask = np.ones(self.density.shape, bool)
        drawn = gaze_figure(
            self.color, self.density, mask, self.heat, self.title, "gaze density [1/m²]", note=self.note, axes=axes
        )
        return show_figure(drawn.figure) if axes is None else drawn.figure

    def save(
        self, path: FilePath | None = None, samples: FilePath | None = None, image: FilePath | None = None
    ) -> None:
        """Write the figure ``path`` (.png, .svg or .pdf), the table ``samples`` (.csv), and the picture without gaze
        ``image`` (.png), to whose pixels the table refers."""
        check_figure(path)
        for output, suffix in ((samples, ".csv"), (image, ".png")):
            if output is not None:
                check_writable(to_path(output), suffix)
        if path is not None:
            save(self.plot(), path, self.provenance)
        if samples is not None:
            columns = [values.tolist() for values in self.samples.values()]
            write_csv(to_path(samples), (dict(zip(self.samples, row)) for row in zip(*columns)), list(self.samples))
        if image is not None:
            write_png(to_path(image), srgb(self.color), self.provenance.text())

    def __repr__(self) -> str:
        width, height = self.size
        return f"<AreaGaze: {width:.3g} x {height:.3g} m, {self.note}>"

    def _repr_html_(self) -> str:
        return markup([image(encode(self.plot(), ".png", {}), repr(self)), paragraph(repr(self))])


@check_ranges
def draw_area(
    inputs: Sequence[FilePath | Any] | FilePath | Any,
    *,
    aois: FilePath | AnyAreas | None = None,
    area: str | None = None,
    corners: ArrayLike | None = None,
    align: FilePath | AnySimilarity | None = None,
    objects: FilePath | ObjectPoses | None = None,
    smoothing: Annotated[float, Range(0, 30)] = SMOOTHING,
    smoothing_length: Annotated[float, LENGTHS] | None = None,
    resolution: Annotated[int, Range(16, 4096)] = 800,
    spp: Annotated[int, SPP] = 8,
    vmax: Annotated[float, POSITIVE_VALUES] | None = None,
    style: Style = Style(),
    progress: Progress = None,
) -> AreaGaze:
    """Draw the gaze on a flat area, such as a poster, a screen or a shelf, from its front.

    Every sample counts the same, and those that something occludes do not count. The side of most samples is the front.

    Parameters
    ----------
    inputs : object, path or sequence of these
        Rays or a dataset and, optionally, an environment, in any order. Without one, the area is grey, and recorded
        hit points tell what is occluded.
    aois : Areas, path or mapping, optional
        JSON file of areas of interest (AOIs), of which one is drawn: a thin box, whose side towards the observers is
        the area, or a flat mesh or shape.
    area : str, optional
        Name of the area. Default: the only one.
    corners : array_like of shape (4, 3), optional
        Corners x,y,z of the area in scene units, in place of aois: upper left, upper right, lower right, lower left;
        four times.
    align : path or similarity, optional
        JSON file with the 4x4 similarity from the frame of the rays to that of the scene, as nerg align writes it.
        Default: the identity, or that of an environment in memory.
    objects : ObjectPoses or path, optional
        Table with columns time,object,x,y,z,qw,qx,qy,qz (`nerg_mi.tracking.objects`): poses of shapes and areas that
        move, in the frame of the rays. Gaze is drawn where it was on the area, which is drawn where the scene shows it.
    smoothing : float
        Standard deviation in degrees of the Gaussian that smooths the samples, at the distance of each.
    smoothing_length : float, optional
        Standard deviation in metres on the area, in place of ``smoothing``.
    resolution : int
        Pixels along the longer side of the area.
    spp : int
        Samples per pixel of the picture of the area, in an environment.
    vmax : float, optional
        Upper end of the colour scale, per square metre. Default: the 99.5th percentile.
    style : Style
        Colours (`nerg_mi.figures.settings.Style`); nothing is hatched.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    AreaGaze
        Picture, density and samples, with methods ``plot``, ``to_dataframe`` and ``save``.

    Raises
    ------
    NergError
        An argument is invalid, the area is not flat, or no sample is on it.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> rays = nerg.Rays.from_arrays([[0.0, 0.0, 1.6]] * 2, [[2.0, 0.5, 0.1], [2.0, -0.5, 0.0]], times=[0.0, 0.1])
    >>> poster = nerg.draw_area(rays, aois={"poster": [[2, -1, 1], [2.1, 1, 2]]}, resolution=64)
    >>> poster.samples["x"].round(6).tolist(), poster.samples["y"].round(6).tolist()
    ([0.5, 1.5], [0.3, 0.4])
    """
    changed = changed_arguments(draw_area, locals())
    if (aois is None) == (corners is None):
        raise NergError(f"give either {parameter('aois')} or {parameter('corners')}")
    activate_mitsuba()
    chosen, align = open_inputs(inputs, align)
    if chosen.rays is None:
        raise NergError("there is no gaze to draw; give rays")
    areas = Areas(()) if aois is None else Areas.open(aois, "aois")
    files = existing_files(*chosen, *areas.files, align, objects)
    settings = {name: value for name, value in changed.items() if name not in ("aois", "align", "objects")}
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading")
        rays = open_rays(chosen.rays)
        placed = open_placed_areas(chosen.environment, None, areas, align)
        moving = None if objects is None else place_objects(placed, ObjectPoses.open(objects))
        if moving is not None:
            check_objects(moving, [rays], reporter)
        reporter.progress(0.2, "tracing the gaze")
        if corners is None:
            elements = _find_elements(placed.areas, area)
            view, is_present = _view_at_rest(placed, moving, rays, elements)
            sides = [_fit_area(placed, elements, view[0][is_present], is_back) for is_back in (False, True)]
        else:
            sides, settings["corners"] = [FlatArea.from_corners(corners)], np.asarray(corners).tolist()
            view, is_present = _view_at_rest(placed, None, rays, ())
        listed = [(flat, _list_samples(placed, moving, rays, flat, view, is_present)) for flat in sides]
        flat, samples = max(listed, key=lambda side: np.sum(side[1]["occluded"] != 1))
        shape = flat.count_pixels(resolution)
        scale = np.array(shape[::-1]) / flat.size * placed.scale  # pixels per metre
        samples |= {f"{axis}_px": samples[axis] * scale[k] for k, axis in enumerate("xy")}
        is_seen = samples["occluded"] != 1
        if not is_seen.any():
            raise NergError(
                f"no sample is on the area: of {len(rays):,}, {len(is_seen):,} meet it from the front, and these are "
                "occluded; check the alignment, and the corners or the thickness of the area"
            )
        reporter.progress(0.5, "rendering the area")
        color = _render_front(placed.environment, flat, shape, spp)
        lengths = samples["distance"] * np.tan(np.radians(smoothing))
        lengths = lengths if smoothing_length is None else np.full(len(lengths), smoothing_length)
        pixels = np.column_stack([samples["x_px"], samples["y_px"]])[is_seen]
        density = sum_kernels(pixels, lengths[is_seen] * scale.mean(), shape) / len(pixels) * scale.prod()
        top = vmax or robust_max(density, np.ones(shape, bool))
        hidden = len(is_seen) - len(pixels)
        note = f"{len(pixels):,} samples{f', and {hidden:,} occluded ones' if hidden else ''}"
        reporter.message(f"{note} of {len(rays):,} meet the area from the front")
    kernel = f"{smoothing:g}°" if smoothing_length is None else f"{100 * smoothing_length:g} cm"
    width, height = (flat.size / placed.scale).tolist()
    heat = Heat(top, style.cmap or "inferno", decades=style.log_decades)
    title = style.title or area or ("Gaze" if corners is not None else areas.names[0])
    provenance = make_provenance("nerg draw area", files, None, settings)
    return AreaGaze(samples, color, density, (width, height), heat, title, f"{note}; Gaussian of {kernel}", provenance)


def _find_elements(areas: Areas, name: str | None) -> tuple[int, ...]:
    """Return the indices of the elementary AOIs of the area ``name``, or of the only one. Raises `NergError`."""
    members = areas.element_indices()
    if name is None and len(members) == 1:
        return next(iter(members.values()))
    if name is None or name not in members:
        what = f"there are {len(members)} areas" if name is None else f'there is no area "{sanitize(name, 40)}"'
        raise NergError(f"{what}; choose one with {parameter('area')}: {', '.join(list(members)[:20])}")
    if name in {area.name for area in areas.areas if isinstance(area, AreaGroup)}:
        raise NergError(f'"{sanitize(name, 40)}" is a group, with gaps between its areas; choose one of them')
    return members[name]


def _view_at_rest(
    placed: PlacedAreas, moving: MovingAreas | None, rays: Rays, elements: tuple[int, ...]
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return origins and directions of the rays in the frame of these elementary AOIs at rest, and whether they are
    present, (N,)."""
    o, d = placed.environment.points_to_field(rays.origin), placed.environment.directions_to_field(rays.direction)
    if moving is None:
        return (o, d), np.ones(len(rays), bool)
    for item in moving.objects:
        if not item.elements.isdisjoint(elements):
            motion = moving.poses.find_motion(item.name, rays).in_frame(placed.environment.align)
            if not item.elements.issuperset(elements):
                raise NergError(f'the object "{sanitize(item.name, 40)}" moves only a part of the area; choose another')
            if not motion.is_present.any():
                raise NergError(f'the object "{sanitize(item.name, 40)}" is not there in any sample; choose others')
            return (motion.to_rest(o), motion.turn_to_rest(d)), motion.is_present
    return (o, d), np.ones(len(rays), bool)


def _fit_area(placed: PlacedAreas, elements: tuple[int, ...], observers: np.ndarray, is_back: bool = False) -> FlatArea:
    """Return the rectangle around these elementary AOIs on the side of ``observers`` (N, 3), or on the other. Raises
    `NergError`."""
    points, axes = [], placed.environment.directions_to_field(np.eye(3))
    for k in elements:
        element, aoi = placed.areas.elements[k], placed.aois[k]
        if isinstance(element, Region):
            points.append(element.vertices)
            axes = element.rotation_matrix.T if len(elements) == 1 else axes
        else:
            assert isinstance(aoi, ShapeAoi)
            points.append(_read_corners(aoi))
    up = placed.environment.directions_to_field(np.array([0.0, 0, 1]))
    return FlatArea.from_points(
        placed.areas.elements[elements[0]].name, np.concatenate(points), axes, observers, up, is_back
    )


def _read_corners(aoi: ShapeAoi) -> np.ndarray:
    """Return the vertices (P, 3) of a shape. Raises `NergError` for a shape without triangles."""
    if not aoi.shape.is_mesh():
        raise NergError(
            f'the area "{sanitize(aoi.name, 40)}" is a {aoi.shape.class_name()}, which has no corners; give four with '
            f"{parameter('corners')}"
        )
    vertices, faces = read_triangles(aoi.shape)
    return vertices[np.unique(faces)]


def _list_samples(
    placed: PlacedAreas,
    moving: MovingAreas | None,
    rays: Rays,
    flat: FlatArea,
    view: tuple[np.ndarray, np.ndarray],
    is_present: np.ndarray,
) -> dict[str, np.ndarray]:
    """Return the columns of `AreaGaze.samples` without pixels. ``view`` is that of `_view_at_rest`."""
    rows, xy, distance = flat.intersect(*view)
    is_valid = is_present[rows]
    rows, xy, distance = rows[is_valid], xy[is_valid], distance[is_valid]
    environment, part, depth = placed.environment, rays.select(rows), np.full(len(rows), np.nan)
    if environment.has_surfaces:
        o, d = environment.points_to_field(part.origin), environment.directions_to_field(part.direction)
        depth = environment.trace_depth(o, d) if moving is None else moving.at(part).trace_depth(o, d)
    elif part.hit is not None:
        depth = np.linalg.norm(part.hit - part.origin, axis=1) * placed.scale
    occluded = np.where(np.isnan(depth), np.nan, depth < distance - placed.margin)
    names = np.array(part.persons, object)[part.person]
    x, y = (xy / placed.scale).T
    return {
        "t": part.t,
        "participant": names,
        "x": x,
        "y": y,
        "distance": distance / placed.scale,
        "occluded": occluded,
    }


def _render_front(environment: Environment, flat: FlatArea, shape: tuple[int, int], spp: int) -> np.ndarray:
    """Return the linear image (height, width, 3) of the area from its front, grey without an environment."""
    if not environment.has_surfaces:
        return np.full((*shape, 3), _GREY)
    source = environment.input
    scene = Scene.coerce(source) if environment.nerg is not None else make_scene(source)
    color = render(scene, quantities="color", camera=flat.make_sensor(shape, spp), progress=False).color[0]
    return np.broadcast_to(color, (*shape, 3))


def sum_kernels(pixels: np.ndarray, sigma: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the sum (height, width) of Gaussians at ``pixels`` (N, 2), x and y, with standard deviations ``sigma``
    (N,) in pixels, rounded to steps of a tenth. Each Gaussian sums to 1, less what is outside."""
    from scipy.ndimage import gaussian_filter

    height, width = shape
    column, row = (np.clip(pixels[:, k].astype(int), 0, n - 1) for k, n in enumerate((width, height)))
    level = np.round(np.log(np.maximum(sigma, 1e-3)) / np.log(_SIGMA_RATIO)).astype(int)
    total = np.zeros(shape)
    for k in np.unique(level).tolist():
        mine = level == k
        counts = np.bincount(row[mine] * width + column[mine], minlength=height * width).reshape(shape)
        total += gaussian_filter(counts.astype(float), float(sigma[mine].mean()), mode="constant")
    return total
