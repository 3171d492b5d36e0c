"""Export of scenes with gaze to Rerun and OpenUSD: geometry, gaze as coloured points and spheres, rays, fixations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.environment.kinds import detect_kind
from nerg_mi.errors import NergError, parameter, translate_mitsuba_errors
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.figures.overlay import Heat, robust_max
from nerg_mi.figures.style import apply_colormap
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
from nerg_mi.formats.fields import load_radiance
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.splats import is_splat_file, read_splats
from nerg_mi.formats.surfaces import extract_points
from nerg_mi.maths.color import decode_srgb
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.dataset import load_rays
from nerg_mi.rays.events import average_fixations, label_fixations, warn_unknown_tracking
from nerg_mi.rays.rays import TRACKING, Rays
from nerg_mi.registration import get_plugin_class
from nerg_mi.rendering.bands import is_nerg, render_aovs
from nerg_mi.rendering.scene import activate_variant, load_scene
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import pixel_directions
from nerg_mi.transport.mitsuba_mesh import read_attribute, read_triangles
from nerg_mi.transport.observer import sensor_center

from .base import select_backend
from .draw import read_baked
from .draw_scenes import copy_sampler, make_film, upright_pose
from .radiance_commands import SceneExportOptions
from .rays_events import warn_slow_sampling
from .render import warn_observer

_SPHERE_RADIUS = 0.15  # metres
_SPHERE_WIDTH = 96
_RAY_LENGTH = 2.0  # of rays without a hit point, in metres
_GREY = 0.5


@dataclass(frozen=True)
class SceneExport:
    """What was written: the file ``output``, and its contents ``scene``."""

    output: Path
    scene: ExchangeScene

    def __repr__(self) -> str:
        return f"<SceneExport: {self.output.name}, {_describe(self.scene)}>"


def export_scene(
    files: Sequence[str | Path],
    output: str | Path,
    options: SceneExportOptions | None = None,
    reporter: Reporter = SILENT,
    *,
    names: Sequence[str] | None = None,
) -> SceneExport:
    """Write a scene and its gaze for Rerun (.rrd) or OpenUSD (.usdc, .usda, .usd).

    Parameters
    ----------
    files
        In any order: a scene (.xml), meshes (values of a mesh of ``nerg bake`` become attention), splats, a radiance
        field (as surface points), and rays (.npz, .parquet or a dataset), all in the same frame.
    output
        File to write.
    options
        Options. Default: all defaults.
    reporter
        Receives messages and progress.
    names
        Names of the files in the scene. Default: those of the files, without suffixes.

    Raises
    ------
    NergError
        For unusable files; `ImportError` if the library of the format is not installed.
    """
    options, output = options or SceneExportOptions(), Path(output)
    check_exchange(output)
    if options.up not in ("y", "z"):
        raise NergError(f'{parameter("up")} must be z or y, got "{options.up}"')
    activate_variant(options.mode)
    scene = ExchangeScene(up=options.up, meters_per_unit=options.meters_per_unit)
    paths = [Path(file) for file in files]
    names = unique_names([path.stem for path in paths] if names is None else list(names), str)
    for number, (path, name) in enumerate(zip(paths, names)):
        reporter.progress(number / len(files), f"reading {name}")
        scene = _add_file(scene, path, name, options, reporter)
    write_exchange(scene, output)
    reporter.message(_describe(scene))
    reporter.message(f"wrote {output} ({output.stat().st_size / 1e6:.1f} MB)")
    return SceneExport(output, scene)


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


def _add_file(
    scene: ExchangeScene, path: Path, name: str, options: SceneExportOptions, reporter: Reporter
) -> ExchangeScene:
    kind = detect_kind(path)
    if kind == "rays":
        rays = load_rays(path)
        taken = {r.participant for r in scene.rays}
        names = tuple(f"{person} ({name})" if person in taken else person for person in rays.persons)
        rays, fixations = _gaze(replace(rays, persons=names), options, reporter)
        return replace(scene, rays=scene.rays + rays, fixations=scene.fixations + fixations)
    if kind == "mesh":
        return replace(scene, meshes=(*scene.meshes, _mesh(path, name)))
    if kind == "scene":
        return _add_scene(scene, path, options, reporter)
    if kind == "field" and is_splat_file(path):
        if scene.splats is not None:
            raise NergError(f'"{path}" is a second file of splats, and a scene can have one; name one of them')
        return replace(scene, splats=read_splats(path))
    if kind == "field":
        field = load_radiance(path, select_backend(options.mode))[0]
        field.require_density(f'"{path}"')
        return replace(scene, points=(*scene.points, _surface_points(field, name, options)))
    raise NergError(
        f'"{path}" is exported as part of a scene, not alone; make one with "nerg scene", or in Python with '
        "write_scene, and export that"
    )


def _surface_points(field: RadianceField, name: str, options: SceneExportOptions) -> ExchangePoints:
    surface = extract_points(field, count=options.max_points)
    return ExchangePoints(name, surface.vertices, decode_srgb(surface.colors))


def _mesh(path: Path, name: str) -> ExchangeMesh:
    mesh = read_mesh_file(path)
    with path.open("rb") as file:
        head = file.read(1 << 14)
    if path.suffix.lower() == ".ply" and b"property float value" in head:
        baked = read_baked(path)
        return ExchangeMesh(name, mesh.vertices, mesh.faces, mesh.colors, baked.values, baked.label)
    return ExchangeMesh(name, mesh.vertices, mesh.faces, mesh.colors)


# ---- Gaze recordings ----


def _gaze(
    rays: Rays, options: SceneExportOptions, reporter: Reporter
) -> tuple[tuple[ExchangeRays, ...], tuple[ExchangeFixations, ...]]:
    """Return the rays and the fixations of each participant."""
    length = _RAY_LENGTH / options.meters_per_unit
    ends = rays.origin + length * rays.direction
    if rays.hit is not None:
        ends = np.where(np.isfinite(rays.hit), rays.hit, ends)
    label, kinds = np.full(len(rays), -1), np.zeros(0, str)
    if rays.tracking in ("head", "mixed"):
        reporter.message(f"no fixations are written, since the rays are {TRACKING[rays.tracking]}")
    else:
        warn_unknown_tracking(rays.tracking, reporter.warn)
        warn_slow_sampling(rays, options, reporter)
        label, kinds = label_fixations(rays, options.event_rules(), options.dispersion_threshold)
    definition = options.event_rules().describe(options.dispersion_threshold)
    out, fixations, without = [], [], []
    step = -(-len(rays) // options.max_rays)
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


# ---- Scene files ----


def _add_scene(scene: ExchangeScene, path: Path, options: SceneExportOptions, reporter: Reporter) -> ExchangeScene:
    """Add the shapes, cameras, splats or surface points of the field, and gaze of the scene file ``path``."""
    loaded = load_scene(path, options.defaults)
    skipped = [shape.id() for shape in loaded.shapes() if not shape.is_mesh()]
    if skipped:
        reporter.warn(f"left out {len(skipped)} shapes that are not meshes, such as {skipped[0]}")
    meshes = tuple(_shape(shape) for shape in loaded.shapes() if shape.is_mesh())
    cameras = tuple(
        _camera(sensor, f"camera_{index}")
        for index, sensor in enumerate(loaded.sensors())
        if sensor.class_name() == "PerspectiveCamera"
    )
    scene = replace(scene, meshes=scene.meshes + meshes, cameras=scene.cameras + cameras)
    nerg = loaded.integrator()
    if not is_nerg(nerg):
        return scene
    field = nerg.children.get("field")
    if isinstance(field, get_plugin_class("splats")):
        scene = replace(scene, splats=field.splats.transform(field.similarity))
    if isinstance(nerg.medium, FieldMedium) and isinstance(nerg.medium.field, RadianceField):
        points, matrix = _surface_points(nerg.medium.field, "field", options), nerg.medium.to_world.matrix
        points = replace(points, positions=points.positions @ matrix[:3, :3].T + matrix[:3, 3])
        scene = replace(scene, points=(*scene.points, points))
    if nerg.children.get("density") is not None:
        reporter.warn(
            f'the volume "density" of "{path}" is left out, since only radiance fields, splats and meshes are exported'
        )
    quantity = next((name for name in ("gaze", "kde") if nerg.children.get(name) is not None), None)
    return scene if quantity is None else _add_gaze(scene, path, loaded, quantity, options, reporter)


def _shape(shape: Any) -> ExchangeMesh:
    return ExchangeMesh(shape.id() or "mesh", *read_triangles(shape), read_attribute(shape, "vertex_color"))


def _camera(sensor: Any, name: str) -> ExchangeCamera:
    import mitsuba as mi

    # Mitsuba's cameras look along +z, with x to the left.
    to_world = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    width, height = map(int, sensor.film().crop_size())
    fov = float(np.ravel(np.array(mi.traverse(sensor)["x_fov"]))[0])
    return ExchangeCamera(name if not sensor.id() else sensor.id(), to_world, fov, width, height)


def _add_gaze(
    scene: ExchangeScene, path: Path, loaded: Any, quantity: str, options: SceneExportOptions, reporter: Reporter
) -> ExchangeScene:
    """Add the gaze of the scene's observer: as coloured points on surfaces, and as a sphere around the observer."""
    import mitsuba as mi

    sensors = loaded.sensors()
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
        "film": make_film(options.width, options.width // 2),
        "sampler": copy_sampler(observer),
    }
    warn_observer(loaded, reporter)
    reporter.progress(0.5, "rendering the gaze of the observer")
    with translate_mitsuba_errors():
        seen = render_aovs(path, loaded, mi.load_dict(panorama), [quantity, "opacity", "position"], options.spp, 0)
    position = np.stack([seen.aovs[f"position.{axis}"] for axis in "XYZ"], axis=-1)
    values, mask = seen.aovs[quantity], seen.mask
    heat = Heat(options.vmax or robust_max(values, mask))
    rows = np.flatnonzero(mask)
    if len(rows) > options.max_points:
        rows = np.random.default_rng(options.seed).choice(rows, options.max_points, replace=False)
    label = f"{quantity} density [1/sr]"
    color = lambda density: decode_srgb(apply_colormap(heat.colormap, heat.normalize(density)))
    at = values.reshape(-1)[rows]
    points = ExchangePoints("gaze", position.reshape(-1, 3)[rows].astype(float), color(at), at, label)
    # Surfaces have no part in the density over directions, which ends at none.
    center = np.ravel(np.array(sensor_center(observer), np.float64))
    sphere = _sphere(center, np.array(pose.matrix, np.float64).reshape(4, 4)[:3, :3], values, options)
    sphere = replace(sphere, colors=color(sphere.values), label=label)
    return replace(scene, points=(*scene.points, points), meshes=(*scene.meshes, sphere))


def _sphere(center: np.ndarray, axes: np.ndarray, values: np.ndarray, options: SceneExportOptions) -> ExchangeMesh:
    """Return a sphere around the observer, whose vertices have the values of a panorama (h, w)."""
    step = max(values.shape[1] // _SPHERE_WIDTH, 1)
    local = pixel_directions(values.shape[1], values.shape[0])
    rows = np.unique(np.r_[0 : len(values) : step, len(values) - 1])
    columns = np.arange(0, values.shape[1], step)
    directions, shown = local[np.ix_(rows, columns)], values[np.ix_(rows, columns)]
    h, w = shown.shape
    vertices = center + _SPHERE_RADIUS / options.meters_per_unit * (directions.reshape(-1, 3) @ axes.T)
    i, j = np.meshgrid(np.arange(h - 1), np.arange(w), indexing="ij")
    a, b, c, d = (i * w + j, i * w + (j + 1) % w, (i + 1) * w + j, (i + 1) * w + (j + 1) % w)
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (b, d, c))])
    return ExchangeMesh("observer", vertices, faces, None, shown.reshape(-1).astype(float))
