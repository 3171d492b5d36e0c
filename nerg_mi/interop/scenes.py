"""Export of scenes with gaze to Rerun and OpenUSD: geometry, gaze as coloured points and spheres, rays, fixations."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from nerg_mi.environment.bands import is_nerg, render_aovs
from nerg_mi.environment.contents import from_trimesh, is_trimesh, load_content
from nerg_mi.environment.environment import Environment
from nerg_mi.environment.inputs import find_role, name_input
from nerg_mi.environment.kinds import detect_kind
from nerg_mi.environment.scene import Scene
from nerg_mi.environment.scene_loading import activate_mitsuba, load_scene
from nerg_mi.environment.sensors import copy_sampler, make_film, upright_pose, warn_observer
from nerg_mi.environment.trained import TrainedField
from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.fields.splats import Splats
from nerg_mi.figures.overlay import Heat, robust_max
from nerg_mi.figures.style import apply_colormap
from nerg_mi.files.html import Summary
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.formats.exchange import (
    ExchangeCamera,
    ExchangeFixations,
    ExchangeMesh,
    ExchangePoints,
    ExchangeRays,
    ExchangeScene,
    check_exchange,
    unique_names,
    write_exchange,
)
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.splats import read_splats
from nerg_mi.formats.surfaces import extract_points
from nerg_mi.maths.color import decode_srgb
from nerg_mi.maths.transforms import transform_points
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import LENGTHS, POSITIVE_VALUES, Range, check_ranges
from nerg_mi.registration import get_plugin_class
from nerg_mi.surfaces.bake import Bake
from nerg_mi.surfaces.bake_splats import SplatBake
from nerg_mi.surfaces.baked import read_baked
from nerg_mi.tracking.dataset import RayDataset, open_rays
from nerg_mi.tracking.event_settings import EventRules
from nerg_mi.tracking.events import average_fixations, label_fixations, warn_unknown_tracking
from nerg_mi.tracking.measurement import warn_slow_sampling
from nerg_mi.tracking.rays import TRACKING, Rays
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import pixel_directions
from nerg_mi.transport.mitsuba_mesh import read_attribute, read_triangles
from nerg_mi.transport.observer import sensor_center

_SPHERE_RADIUS = 0.15  # metres
_SPHERE_WIDTH = 96
_RAY_LENGTH = 2.0  # of rays without a hit point, in metres


@dataclass(frozen=True, repr=False)
class SceneExport(Summary):
    """What was written: the file ``output``, and its contents ``scene``."""

    output: Path
    scene: ExchangeScene

    def __repr__(self) -> str:
        return f"<SceneExport: {self.output.name}, {_describe(self.scene)}>"


@check_ranges
def export_scene(
    inputs: object | Sequence[object | FilePath],
    output: FilePath,
    *,
    defaults: Mapping[str, str] | None = None,
    up: Literal["z", "y"] = "z",
    meters_per_unit: Annotated[float, LENGTHS] = 1.0,
    max_rays: Annotated[int, Range(1, 10**7)] = 20_000,
    max_points: Annotated[int, Range(1, 10**7)] = 100_000,
    width: Annotated[int, Range(16, 4096)] = 512,
    spp: Annotated[int, Range(1, 4096)] = 4,
    vmax: Annotated[float, POSITIVE_VALUES] | None = None,
    rules: EventRules = EventRules(),
    progress: Progress = None,
) -> SceneExport:
    """Write a scene with its gaze for Rerun (.rrd) or OpenUSD (.usdc, .usda).

    Shapes, fields, splats and cameras of the scene are written, and the gaze of its observer as coloured points on
    surfaces and as a sphere around the observer. Recordings become eyes, rays and fixations of each participant.

    Parameters
    ----------
    inputs : object, path or sequence of these
        A scene (.xml), meshes (with attention if nerg bake has written them), splats, a radiance field and rays, in
        any order and in the same frame.
    output : path
        File to write (.rrd, .usdc, .usda or .usd).
    defaults : mapping of str to str, optional
        Value of a <default> of the scene file, or of $KEY; repeatable. Default: as in the scene file.
    up : str
        Vertical axis of the scene, z or y.
    meters_per_unit : float
        Length of a unit in metres.
    max_rays : int
        Maximum number of rays to write, evenly selected.
    max_points : int
        Maximum number of points of a field or of gaze.
    width : int
        Columns of the panorama in which the gaze of the observer is computed.
    spp : int
        Samples per pixel of the panorama.
    vmax : float, optional
        Upper end of the colours of gaze in 1/sr. Default: the 99.5th percentile.
    rules : EventRules
        Limits between the kinds of events (`nerg_mi.tracking.event_settings.EventRules`).
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    SceneExport
        The written file (``output``) and its contents (``scene``).

    Raises
    ------
    NergError
        An input is unusable, or there is nothing that can be exported.
    ImportError
        The library of the format is not installed: the extra ``rerun``, or ``usd``.

    Examples
    --------
    >>> import nerg_mi as nerg, trimesh
    >>> room = trimesh.creation.box((4, 3, 2.5))
    >>> rays = nerg.Rays.from_arrays([[0, 0, 0]] * 3, [[1, 0, 0]] * 3, times=[0.0, 0.1, 0.2])
    >>> nerg.export_scene([room, rays], folder / "room.usdc")
    <SceneExport: room.usdc, 1 mesh, 3 rays, 1 fixation>
    """
    output = to_path(output)
    check_exchange(output)
    activate_mitsuba()
    items = list(inputs) if isinstance(inputs, (list, tuple)) else [inputs]
    names = unique_names(list(map(_name, items)), str)
    with open_reporter(progress) as reporter:
        settings = _Settings(defaults, max_rays, max_points, width, spp, vmax, rules)
        builder = _Builder(ExchangeScene(up=up, meters_per_unit=meters_per_unit), settings, reporter)
        for number, (item, name) in enumerate(zip(items, names)):
            reporter.progress(number / len(items), f"reading {name}")
            builder.add(item, name)
        write_exchange(builder.scene, output)
        reporter.message(_describe(builder.scene))
        reporter.message(f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB)")
    return SceneExport(output, builder.scene)


@dataclass(frozen=True)
class _Settings:
    """What is written of an input, as in `export_scene`."""

    defaults: Mapping[str, str] | None
    max_rays: int
    max_points: int
    width: int
    spp: int
    vmax: float | None
    rules: EventRules


def _name(item: object) -> str:
    """Return the name of an input in the scene."""
    if isinstance(item, (TrainedField, Scene, Environment)) and item.path is not None:
        item = item.path
    if isinstance(item, (str, os.PathLike)):
        return Path(item).stem
    if isinstance(item, (Rays, RayDataset)):
        return "rays"
    if isinstance(item, TrainedField):
        return "field"
    return "surface" if isinstance(item, (Bake, SplatBake)) else "environment"


def _describe(scene: ExchangeScene) -> str:
    counts = {
        ("mesh", "meshes"): len(scene.meshes),
        ("point cloud", "point clouds"): len(scene.points),
        ("Gaussian", "Gaussians"): 0 if scene.splats is None else len(scene.splats.centers),
        ("camera", "cameras"): len(scene.cameras),
        ("ray", "rays"): sum(len(r.times) for r in scene.rays),
        ("fixation", "fixations"): sum(len(f.times) for f in scene.fixations),
    }
    return ", ".join(f"{count:,} {one if count == 1 else several}" for (one, several), count in counts.items() if count)


class _Builder:
    """Collects the contents of a scene in ``scene``."""

    def __init__(self, scene: ExchangeScene, settings: _Settings, reporter: Reporter) -> None:
        self.scene, self.settings, self.reporter = scene, settings, reporter

    def add(self, item: Any, name: str) -> None:
        """Add an input, in memory or as a file."""
        if isinstance(item, Bake):
            colors = decode_srgb(item.content.vertex_colors())
            mesh = item.mesh
            self._add_meshes(ExchangeMesh(name, mesh.vertices, mesh.faces, colors, item.density, item.content.unit))
            return
        item = item.splats if isinstance(item, SplatBake) else item
        item = item.input if isinstance(item, Environment) and item.has_surfaces else item
        role = find_role(item)
        if role == "rays":
            self._add_rays(open_rays(item), name)
        elif role == "gaze":
            self._refuse(item)
        elif is_trimesh(item):
            meshes = from_trimesh(item, name)
            self._add_meshes(*(ExchangeMesh(n, m.vertices, m.faces, m.colors) for n, m in meshes.items()))
        elif isinstance(item, Splats):
            self._add_splats(item, name)
        elif isinstance(item, (str, os.PathLike)):
            self._add_file(Path(item), name)
        elif isinstance(item, Scene):
            self._add_scene(item.mitsuba, Path(name))
        elif isinstance(item, Mapping) and item.get("type") == "scene":
            self._add_scene(load_content(item), Path(name))
        else:
            self._add_environment(item, name)

    def _add_file(self, path: Path, name: str) -> None:
        """Add an environment in a file."""
        kind = detect_kind(path)
        if kind == "mesh":
            self._add_meshes(_read_mesh(path, name))
        elif kind == "splats":
            self._add_splats(read_splats(path), str(path))
        elif kind == "scene":
            self._add_scene(load_scene(path, self.settings.defaults), path)
        else:
            self._add_environment(path, name)

    def _add_environment(self, item: object, name: str) -> None:
        """Add a radiance field, or a scene or shapes of Mitsuba."""
        opened = Environment.open(item)
        if opened.radiance is not None:
            self._add_points(_surface_points(opened.radiance.network, name, self.settings.max_points))
        elif opened.scene_geometry.scene is not None:
            self._add_scene(opened.scene_geometry.scene, opened.path or Path(name))
        else:
            self._refuse(item)

    def _refuse(self, item: object) -> None:
        raise NergError(
            f"{name_input(item)} is not exported alone; export a scene that shows it, which "
            '"nerg scene" writes, or in Python write_scene'
        )

    def _add_meshes(self, *meshes: ExchangeMesh) -> None:
        self.scene = replace(self.scene, meshes=(*self.scene.meshes, *meshes))

    def _add_points(self, points: ExchangePoints) -> None:
        self.scene = replace(self.scene, points=(*self.scene.points, points))

    def _add_splats(self, splats: Splats, name: str) -> None:
        if self.scene.splats is not None:
            raise NergError(f'"{name}" is a second file of splats, and a scene can have one; name one of them')
        self.scene = replace(self.scene, splats=splats)

    def _add_rays(self, rays: Rays, name: str) -> None:
        """Add the rays and the fixations of each participant."""
        taken = {r.participant for r in self.scene.rays}
        names = tuple(f"{person} ({name})" if person in taken else person for person in rays.persons)
        unit, settings = self.scene.meters_per_unit, self.settings
        shown, fixations = _gaze(replace(rays, persons=names), unit, settings.max_rays, settings.rules, self.reporter)
        self.scene = replace(self.scene, rays=self.scene.rays + shown, fixations=self.scene.fixations + fixations)

    def _add_scene(self, loaded: Any, path: Path) -> None:
        """Add the shapes, cameras, splats or surface points of the field, and gaze of a loaded scene."""
        skipped = [shape.id() for shape in loaded.shapes() if not shape.is_mesh()]
        if skipped:
            self.reporter.warn(f"left out {len(skipped)} shapes that are not meshes, such as {skipped[0]}")
        meshes = tuple(_shape(shape) for shape in loaded.shapes() if shape.is_mesh())
        cameras = tuple(
            _camera(sensor, f"camera_{index}")
            for index, sensor in enumerate(loaded.sensors())
            if sensor.class_name() == "PerspectiveCamera"
        )
        self._add_meshes(*meshes)
        self.scene = replace(self.scene, cameras=self.scene.cameras + cameras)
        nerg = loaded.integrator()
        if not is_nerg(nerg):
            return
        field = nerg.children.get("field")
        if isinstance(field, get_plugin_class("splats")):
            self.scene = replace(self.scene, splats=field.splats.transform(field.similarity))
        if isinstance(nerg.medium, FieldMedium) and isinstance(nerg.medium.field, RadianceNetwork):
            matrix = nerg.medium.to_world.matrix
            points = _surface_points(nerg.medium.field, "field", self.settings.max_points)
            points = replace(points, positions=transform_points(matrix, points.positions))
            self._add_points(points)
        if nerg.children.get("density") is not None:
            self.reporter.warn(
                f'the volume "density" of "{path}" is left out, since only radiance fields, splats and meshes are '
                "exported"
            )
        quantity = next((name for name in ("gaze", "kde") if nerg.children.get(name) is not None), None)
        if quantity is not None:
            self._add_gaze(loaded, quantity, path)

    def _add_gaze(self, loaded: Any, quantity: str, path: Path) -> None:
        """Add the gaze of the scene's observer: as coloured points on surfaces, and as a sphere around the observer."""
        import mitsuba as mi

        settings, sensors = self.settings, loaded.sensors()
        observer = loaded.integrator().observer or (sensors[0] if sensors else None)
        if observer is None:
            raise NergError(
                f'the gaze of "{path}" needs an observer, and the scene has neither an observer nor a camera; add one, '
                "in Python with observer= of make_scene"
            )
        pose = upright_pose(observer)
        panorama = {
            "type": "panorama",
            "to_world": pose,
            "film": make_film(settings.width, settings.width // 2),
            "sampler": copy_sampler(observer),
        }
        warn_observer(loaded, self.reporter)
        self.reporter.progress(0.5, "rendering the gaze of the observer")
        with translate_mitsuba_errors():
            seen = render_aovs(path, loaded, mi.load_dict(panorama), [quantity, "opacity", "position"], settings.spp, 0)
        position = np.stack([seen.aovs[f"position.{axis}"] for axis in "XYZ"], axis=-1)
        values, mask = seen.aovs[quantity], seen.mask
        heat = Heat(settings.vmax or robust_max(values, mask))
        rows = np.flatnonzero(mask)
        if len(rows) > settings.max_points:
            rows = np.random.default_rng(0).choice(rows, settings.max_points, replace=False)
        label = f"{quantity} density [1/sr]"
        color = lambda density: decode_srgb(apply_colormap(heat.colormap, heat.normalize(density)))
        at = values.reshape(-1)[rows]
        points = ExchangePoints("gaze", position.reshape(-1, 3)[rows].astype(float), color(at), at, label)
        # Surfaces have no part in the density over directions, which ends at none.
        center = np.ravel(np.array(sensor_center(observer), np.float64))
        radius = _SPHERE_RADIUS / self.scene.meters_per_unit
        sphere = _sphere(center, np.array(pose.matrix, np.float64).reshape(4, 4)[:3, :3], radius, values)
        self._add_points(points)
        self._add_meshes(replace(sphere, colors=color(sphere.values), label=label))


# ---- Parts of a scene ----


def _surface_points(field: RadianceNetwork, name: str, max_points: int) -> ExchangePoints:
    surface = extract_points(field, count=max_points)
    return ExchangePoints(name, surface.vertices, decode_srgb(surface.colors))


def _read_mesh(path: Path, name: str) -> ExchangeMesh:
    """Read a mesh, with its attention if a bake has written it."""
    mesh = read_mesh_file(path)
    with path.open("rb") as file:
        head = file.read(1 << 14)
    if path.suffix.lower() == ".ply" and b"property float value" in head:
        baked = read_baked(path)
        return ExchangeMesh(name, mesh.vertices, mesh.faces, mesh.colors, baked.values, baked.label)
    return ExchangeMesh(name, mesh.vertices, mesh.faces, mesh.colors)


def _shape(shape: Any) -> ExchangeMesh:
    return ExchangeMesh(shape.id() or "mesh", *read_triangles(shape), read_attribute(shape, "vertex_color"))


def _camera(sensor: Any, name: str) -> ExchangeCamera:
    import mitsuba as mi

    # Mitsuba's cameras look along +z, with x to the left.
    to_world = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    width, height = map(int, sensor.film().crop_size())
    fov = float(np.ravel(np.array(mi.traverse(sensor)["x_fov"]))[0])
    return ExchangeCamera(name if not sensor.id() else sensor.id(), to_world, fov, width, height)


def _sphere(center: np.ndarray, axes: np.ndarray, radius: float, values: np.ndarray) -> ExchangeMesh:
    """Return a sphere around the observer, whose vertices have the values of a panorama (h, w)."""
    step = max(values.shape[1] // _SPHERE_WIDTH, 1)
    local = pixel_directions(values.shape[1], values.shape[0])
    rows = np.unique(np.r_[0 : len(values) : step, len(values) - 1])
    columns = np.arange(0, values.shape[1], step)
    directions, shown = local[np.ix_(rows, columns)], values[np.ix_(rows, columns)]
    h, w = shown.shape
    vertices = center + radius * (directions.reshape(-1, 3) @ axes.T)
    i, j = np.meshgrid(np.arange(h - 1), np.arange(w), indexing="ij")
    a, b, c, d = (i * w + j, i * w + (j + 1) % w, (i + 1) * w + j, (i + 1) * w + (j + 1) % w)
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (b, d, c))])
    return ExchangeMesh("observer", vertices, faces, None, shown.reshape(-1).astype(float))


# ---- Recordings ----


def _gaze(
    rays: Rays, meters_per_unit: float, max_rays: int, rules: EventRules, reporter: Reporter
) -> tuple[tuple[ExchangeRays, ...], tuple[ExchangeFixations, ...]]:
    """Return the rays and the fixations of each participant."""
    length = _RAY_LENGTH / meters_per_unit
    ends = rays.origin + length * rays.direction
    if rays.hit is not None:
        ends = np.where(np.isfinite(rays.hit), rays.hit, ends)
    label, kinds = np.full(len(rays), -1), np.zeros(0, str)
    if rays.tracking in ("head", "mixed"):
        reporter.message(f"no fixations are written, since the rays are {TRACKING[rays.tracking]}")
    else:
        warn_unknown_tracking(rays.tracking, reporter.warn)
        warn_slow_sampling(rays, rules, reporter)
        label, kinds = label_fixations(rays, rules)
    definition = rules.describe()
    out, fixations, without = [], [], []
    step = -(-len(rays) // max_rays)
    for person in np.unique(rays.person):
        rows = np.flatnonzero(rays.person == person)
        rows = rows[np.argsort(rays.t[rows], kind="stable")]
        name = rays.persons[person]
        shown = rows[::step]
        origins = rays.origin[shown].astype(float)
        out.append(ExchangeRays(name, rays.t[shown], origins, ends[shown], rays.tracking))
        rows = rows[label[rows] >= 0]
        if not len(rows):
            without.append(name)
            continue
        mean, durations = average_fixations(rays.select(rows), label[rows])
        at = mean.origin + length * mean.direction
        if mean.hit is not None:
            at = np.where(np.isfinite(mean.hit), mean.hit, at)
        kinds_of_person = kinds[np.unique(label[rows])]
        fixations.append(ExchangeFixations(name, mean.t - durations / 2, durations, at, kinds_of_person, definition))
    if without and rays.tracking not in ("head", "mixed"):
        reporter.message(
            f"no fixation was detected for {len(without)} of {len(out)} participants, such as {without[0]}"
        )
    return tuple(out), tuple(fixations)
