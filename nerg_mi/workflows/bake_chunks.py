"""Parts of a bake: target surfaces and observers, the sums of one part, and the order in which sums are added."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.alignment.check import read_similarity
from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.splats import Splats
from nerg_mi.figures.style import Provenance, find_colormap, make_provenance
from nerg_mi.files.atomic import replace_atomically
from nerg_mi.files.safe_read import read_npy
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.formats.fields import load_gaze, load_radiance
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.splats import read_splats, refuse_unsupported_splats
from nerg_mi.formats.surfaces import extract_mesh as mesh_of_field
from nerg_mi.interruption import Interruption
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.maths.geometry import Similarity
from nerg_mi.progress import Reporter
from nerg_mi.ranges import POSITIVE_VALUES
from nerg_mi.rays.dataset import load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.readers.columns import open_named_table
from nerg_mi.rendering.bands import is_nerg
from nerg_mi.rendering.scene import load_scene
from nerg_mi.surfaces.laplacian import SurfaceSums
from nerg_mi.surfaces.mesh import SURFACE_OPACITY, Mesh, RefinedMesh, SurfaceTarget, refine, weld_mesh
from nerg_mi.surfaces.sources import (
    WEIGHTINGS,
    GazeSumSettings,
    MakeObserver,
    RaySettings,
    TrackedRays,
    WeightedObservers,
    cluster_observers,
    observers_from_field,
    ray_durations,
    ray_weights,
    sum_gaze,
    sum_rays,
)
from nerg_mi.surfaces.splats import integrate_gaze, shortest_axes, splat_densities, sum_rays_on_splats
from nerg_mi.tasks.engines import TaskOutput
from nerg_mi.tasks.execution import prepare_once
from nerg_mi.tasks.task import RENDER_LIBRARIES, Part, Plan
from nerg_mi.train.geometry_files import read_training_alignment
from nerg_mi.transport.extrapolation import warn_extrapolation
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings
from nerg_mi.transport.mitsuba_mesh import Triangles, read_triangles
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_gaze import GazeFieldInstance
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium

from .base import select_backend
from .parts import PartRunner, PlannedScene
from .scene_commands import BakeOptions

# ---- Source of the gaze, and units ----

UNITS = {"share": "share of gaze per square metre [1/m²]", "seconds": "gaze per square metre [s/m²]"}
SOURCES = ("field", "rays")
CONE = 1.5
"""Default cone of a recorded ray in degrees: the error of good trackers and the radius of the fovea."""


def select_source(options: BakeOptions, rays: Rays | None, with_gaze: bool = False) -> str:
    """Return the source of the gaze, one of `SOURCES`.

    ``rays`` are rays in memory; ``with_gaze`` tells whether the surface may have its own gaze field. Raises `NergError`
    for contradictory options.
    """
    people = rays is not None or options.rays is not None
    source = options.source or ("field" if options.gaze is not None or (with_gaze and not people) else "rays")
    if source not in SOURCES:
        raise NergError(f'{parameter("source")} must be {" or ".join(SOURCES)}, got "{source}"')
    if options.unit not in UNITS:
        raise NergError(f'{parameter("unit")} must be {" or ".join(UNITS)}, got "{options.unit}"')
    if source == "rays" and not people:
        raise NergError(
            f"there is no gaze: give a gaze field with {parameter('gaze')}, or rays with {parameter('rays')}"
        )
    if source == "rays" and (options.observer is not None or options.observer_file is not None):
        raise NergError(
            f"{parameter('observer')} and {parameter('observer_file')} need a gaze field; add {parameter('gaze')}, "
            "or leave them out"
        )
    if source == "field" and (options.unit == "seconds" or options.split_half):
        raise NergError(
            f"{parameter('unit', 'seconds')} and {parameter('split_half', True)} apply to rays, which have "
            f"durations; add {parameter('source', 'rays')}"
        )
    return source


def cone_radians(options: BakeOptions, source: str) -> float:
    """Return the standard deviation of the gaze cone in radians."""
    return float(np.radians(CONE if options.cone is None and source == "rays" else options.cone or 0.0))


# ---- Parts ----
#
# A part computes the partial sums of some observers or rays.
#
# A part is a pure function: it can run anywhere, any number of times, with the same result. The size of parts does not
# depend on the machine, and their sums are added in a fixed order.


OBSERVERS = 4
"""Number of observers in a part."""

RAYS = 1 << 16
"""Number of rays in a part."""

Environment = tuple[SceneGeometry, GazeFieldInstance | None]


@dataclass(frozen=True, eq=False)
class BakeScene:
    """Inputs of a part besides the observers. Can be pickled; ``gaze`` and ``scene`` are files.

    Attributes
    ----------
    mesh
        Target surface.
    occluders
        Meshes that only occlude.
    gaze
        Checkpoint of the gaze field. None: that of ``scene``, or of rays.
    scene
        Scene file whose field surrounds the meshes. None: meshes alone.
    """

    mesh: Mesh
    occluders: tuple[Triangles, ...] = ()
    gaze: Path | None = None
    scene: Path | None = None
    gaze_settings: GazeSumSettings = field(default_factory=GazeSumSettings)
    ray_settings: RaySettings = field(default_factory=RaySettings)

    @property
    def empty_sums(self) -> SurfaceSums:
        """Sums without any observer."""
        return SurfaceSums.zeros(len(self.mesh.faces), len(self.mesh.vertices))

    def sums(self, part: WeightedObservers | TrackedRays) -> SurfaceSums:
        """Return the partial sums of the observers or rays in ``part``.

        A Mitsuba variant must be active. Loaded files are cached for the next part. Raises `NergError`.
        """
        target, make, _ = prepare_once(self, self._load)
        if isinstance(part, TrackedRays):
            return sum_rays(target, part, self.ray_settings)
        if make is None:
            raise NergError(
                f"there is no gaze field: name one by {parameter('gaze')}, or take the gaze of the rays, "
                f"{parameter('source', 'rays')}"
            )
        return sum_gaze(target, make, part.positions, part.weights, self.gaze_settings)

    @property
    def environment(self) -> Environment:
        """What the observers see, and the gaze field."""
        return prepare_once(self, self._load)[2]

    def _load(self) -> tuple[SurfaceTarget, MakeObserver | None, Environment]:
        import mitsuba as mi

        medium, settings, falloff, gaze = None, None, 0.0, None
        if self.scene is not None:
            integrator: Any = load_scene(self.scene).integrator()
            if is_nerg(integrator):
                medium, gaze = integrator.medium, integrator.gaze
                settings, falloff = integrator.observer_settings, float(np.ravel(np.array(integrator.falloff))[0])
        target = SurfaceTarget(
            self.mesh, list(self.occluders), medium, settings if medium is not None else None, falloff
        )
        if self.gaze is not None:
            gaze = GazeFieldInstance(load_gaze(self.gaze, namespace(mi.Float))[0])
        make = None if gaze is None else observers_from_field(gaze, target.geometry, target.settings)
        return target, make, (target.geometry, gaze)


def split_into_parts(who: WeightedObservers | TrackedRays) -> Iterator[WeightedObservers | TrackedRays]:
    """Split ``who`` into parts; the split is deterministic."""
    if isinstance(who, TrackedRays):
        for a in range(0, len(who), RAYS):
            yield who.select(a, a + RAYS)
        return
    for a in range(0, len(who.weights), OBSERVERS):
        yield WeightedObservers(who.positions[a : a + OBSERVERS], who.weights[a : a + OBSERVERS])


# ---- Observers: a single one, those of a file, or the recorded positions ----


POSITIONS = 1_000_000
"""Maximum number of observers in a file."""


def read_observer_file(path: Path) -> WeightedObservers:
    """Read observers from a CSV file with columns x, y, z and, optionally, weight. Raises `NergError`."""
    names, table = open_named_table(path, ("x", "y", "z", "weight"), optional=["weight"])
    weighted, blocks = "weight" in names, [b.numbers for b in table]
    rows = np.concatenate(blocks) if blocks else np.zeros((0, 3 + weighted))
    if not 0 < len(rows) <= POSITIONS:
        raise NergError(f'the observer file "{path}" has {len(rows):,} positions; it must have 1 to {POSITIONS:,}')
    check_coordinates(rows[:, :3], f'the positions in "{path}"')
    weights = rows[:, 3] if weighted else np.ones(len(rows))
    if not ((weights >= 0) & (weights <= POSITIVE_VALUES.high)).all() or not weights.sum() > 0:
        raise NergError(f'the observer file "{path}" has weights that are not finite, negative, or all 0; correct them')
    return WeightedObservers(rows[:, :3], weights / weights.sum())


def load_bake_rays(options: BakeOptions, rays: Rays | None) -> Rays | None:
    """Return ``rays``, or those of --rays, or None. Raises `NergError` if there are none in the file."""
    loaded = rays
    if loaded is None and options.rays is not None:
        loaded = load_rays(options.rays, options.max_samples, options.seed)
    if loaded is not None and not len(loaded):
        raise NergError(f"the file of {parameter('rays')} contains no rays; name another one")
    return loaded


def make_observers(options: BakeOptions, rays: Rays | None, align: Similarity, reporter: Reporter) -> WeightedObservers:
    """Return the observers of a gaze field, in scene coordinates. Raises `NergError` for none or several kinds."""
    kinds = [
        name
        for name, value in (
            (parameter("observer"), options.observer),
            (parameter("observer_file"), options.observer_file),
        )
        if value is not None
    ]
    if len(kinds) > 1:
        raise NergError(f"{parameter('observer')} and {parameter('observer_file')} are alternatives; give one of them")
    if options.observer is not None:
        if len(options.observer) != 3:
            raise NergError(f"{parameter('observer')} must be three numbers x,y,z, got {options.observer}")
        return WeightedObservers(np.array([options.observer], np.float64), np.ones(1))
    if options.observer_file is not None:
        return read_observer_file(options.observer_file)
    if rays is None:
        raise NergError(
            f"there is no observer: give {parameter('observer', 'x,y,z')}, an {parameter('observer_file')}, or the "
            f"recorded positions of {parameter('rays')}"
        )
    observers = cluster_observers(
        transform_points(rays.origin, align),
        ray_weights(rays, options.ray_weights),
        options.num_observers,
        options.seed,
    )
    reporter.message(
        f"{len(observers.weights)} observers represent {len(np.unique(rays.person))} participants in {len(rays):,} "
        f"samples; distance from a sample to its observer: {observers.rms_distance / align.scale:.2f} m (root mean "
        f"square), 95 % within {observers.p95_distance / align.scale:.2f} m"
    )
    return observers


def make_gaze_groups(
    options: BakeOptions, source: str, rays: Rays | None, align: Similarity, reporter: Reporter
) -> tuple[list[WeightedObservers | TrackedRays], float]:
    """Return the groups whose gaze is baked, and the factor from shares of gaze to the unit.

    There is one group, or one for each half of the participants with ``options.split_half``. ``rays`` are rays in
    memory.
    """
    tracked = load_bake_rays(options, rays)
    if source == "field":
        return [make_observers(options, tracked, align, reporter)], 1.0
    assert tracked is not None
    who = make_tracked_rays(tracked, align, options.ray_weights)
    factor = float(ray_durations(tracked).sum()) if options.unit == "seconds" else 1.0
    return [*split_halves(who, tracked, options.seed)] if options.split_half else [who], factor


def make_tracked_rays(rays: Rays, align: Similarity, by: str) -> TrackedRays:
    """Return the rays in scene coordinates, with weights of the kind ``by`` (`WEIGHTINGS`) that sum to one."""
    directions = rays.direction @ (align.matrix[:3, :3] / align.scale).T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return TrackedRays(transform_points(rays.origin, align), directions, ray_weights(rays, by))


def transform_points(points: np.ndarray, align: Similarity) -> np.ndarray:
    """Transform points (N, 3) from the frame of the rays to that of the scene."""
    return points @ align.matrix[:3, :3].T + align.matrix[:3, 3]


def check_values(options: BakeOptions) -> None:
    """Raise `NergError` for an unknown weighting or colour map."""
    if options.ray_weights not in WEIGHTINGS:
        raise NergError(f'{parameter("ray_weights")} must be {", ".join(WEIGHTINGS)}, got "{options.ray_weights}"')
    find_colormap(options.cmap)


def load_alignment(options: BakeOptions, reporter: Reporter) -> Similarity:
    """Return the transform from the rays to the scene: --align, or that of the gaze field's training."""
    if options.align is not None:
        return read_similarity(options.align, parameter("align"), "rays to place", reporter.warn)
    return (
        Similarity()
        if options.gaze is None
        else read_training_alignment(read_metadata(options.gaze).get("provenance", {}))
    )


# ---- Target surfaces: a mesh file, shapes of a scene file, or the surface of a radiance field ----


TARGET_FACES = 100_000
"""Default number of triangles after subdivision."""


@dataclass(frozen=True, eq=False)
class BakeTarget:
    """Target surface.

    Attributes
    ----------
    mesh
        All target shapes as one mesh, as given.
    names
        Names of the shapes.
    shape
        Index (F,) into ``names`` for each face.
    index
        Number (F,) of each face within its shape.
    occluders
        Shapes that only occlude.
    """

    mesh: Mesh
    names: tuple[str, ...]
    shape: np.ndarray
    index: np.ndarray
    occluders: tuple[Triangles, ...] = ()


def read_target(path: Path, shapes: tuple[str, ...], resolution: int, ns: ModuleType, reporter: Reporter) -> BakeTarget:
    """Read the target surface from ``path``: a mesh, a scene (.xml) or a radiance field (.safetensors).

    ``shapes`` selects shapes of a scene; the others only occlude. Raises `NergError`.
    """
    suffix = path.suffix.lower()
    occluders: tuple[Triangles, ...] = ()
    if suffix == ".xml":
        meshes, occluders = _read_scene_target(path, shapes)
    elif shapes:
        raise NergError(f'{parameter("shapes")} applies to scene files, and "{path}" is not one; leave it out')
    elif suffix == ".safetensors":
        kind = read_metadata(path).get("kind")
        if kind != "radiance":
            raise NergError(
                f'"{path}" is not a radiance field; give the target surface first, and the gaze field with '
                f"{parameter('gaze')}"
            )
        reporter.progress(0.02, "extracting the surface of the field")
        field = load_radiance(path, ns)[0]
        field.require_density(f'"{path}"')
        body = mesh_of_field(field, resolution)
        assert body.faces is not None, "a mesh has faces"
        meshes = {path.stem: (body.vertices, body.faces)}
    else:
        refuse_unsupported_splats(path)
        body = read_mesh_file(path)
        for note in body.notes:
            reporter.message(f"{path}: {note}")
        meshes = {path.stem: (body.vertices, body.faces)}
    return _merge_shapes(path, meshes, occluders, reporter)


def refine_target(receivers: BakeTarget, longest: float | None, scale: float) -> RefinedMesh:
    """Subdivide the target to edges of at most ``longest`` metres, or to about `TARGET_FACES` triangles.

    ``scale`` is the number of scene units per metre.
    """
    mesh = receivers.mesh
    if longest is not None:
        return refine(mesh, longest * scale)
    # Edge length of this number of equilateral triangles; halving edges makes triangles up to four times smaller.
    return refine(mesh, float(np.sqrt(4 * mesh.area.sum() / (np.sqrt(3) * TARGET_FACES)) * 1.5))


def _read_scene_target(path: Path, shapes: tuple[str, ...]) -> tuple[dict[str, Triangles], tuple[Triangles, ...]]:
    loaded = load_scene(path)
    # Mitsuba does not return shapes in a fixed order.
    every = dict(sorted(((shape.id(), shape) for shape in loaded.shapes()), key=lambda named: named[0]))
    missing = [name for name in shapes if name not in every]
    if missing:
        remedy = f"it has {', '.join(every)}" if every else "it has no shapes"
        raise NergError(f'the scene "{path}" has no shape "{missing[0]}"; {remedy}')
    if not every:
        raise NergError(f'the scene "{path}" has no shapes; give a mesh, a radiance field or splats as the target')
    targets, occluders = {}, []
    for name, shape in every.items():
        if not shape.is_mesh():
            raise NergError(
                f'the shape "{name}" of "{path}" is a {shape.class_name()}, which has no triangles; replace it by '
                "a mesh"
            )
        triangles = read_triangles(shape)
        if shapes and name not in shapes:
            occluders.append(triangles)
        else:
            targets[name] = triangles
    return targets, tuple(occluders)


def _merge_shapes(
    path: Path, meshes: dict[str, Triangles], occluders: tuple[Triangles, ...], reporter: Reporter
) -> BakeTarget:
    """Merge all shapes into one mesh with shared vertices where they touch."""
    first = np.cumsum([0, *(len(v) for v, _ in meshes.values())])
    vertices = np.concatenate([v for v, _ in meshes.values()])
    faces = np.concatenate([f + start for (_, f), start in zip(meshes.values(), first)])
    counts = [len(f) for _, f in meshes.values()]
    mesh, index, repairs = weld_mesh(vertices, faces, f'the mesh "{path}"')
    if repairs.summary:
        reporter.message(f"{path.name}: {repairs.summary}")
    shape = np.repeat(np.arange(len(counts)), counts)
    number = np.concatenate([np.arange(n) for n in counts])
    return BakeTarget(mesh, tuple(meshes), shape[index], number[index], occluders)


# ---- Parts of a bake of Gaussian splats ----


@dataclass(frozen=True, eq=False)
class SplatScene:
    """Inputs of a part besides the observers. Can be pickled, and refers to files.

    Attributes
    ----------
    splats
        File of the Gaussians.
    count
        Number of Gaussians.
    gaze
        Checkpoint of the gaze field, or None.
    cone
        Standard deviation of the gaze cone of a field in radians.
    """

    splats: Path
    count: int
    gaze: Path | None = None
    cone: float = 0.0
    ray_settings: RaySettings = field(default_factory=RaySettings)

    @property
    def empty_sums(self) -> SurfaceSums:
        """Sums without any observer."""
        return SurfaceSums.zeros(2 * self.count, 0)

    def sums(self, part: WeightedObservers | TrackedRays) -> SurfaceSums:
        """Return the partial sums of the observers or rays in ``part``.

        For rays, ``face_sums`` holds shares of gaze on both sides of the Gaussians. For observers it holds densities,
        which are not part of ``total``. A Mitsuba variant must be active. Loaded files are cached for the next part.
        Raises `NergError`.
        """
        geometry, make, _ = prepare_once(self, self._load)
        if isinstance(part, TrackedRays):
            return sum_rays_on_splats(geometry.arrays, geometry.axes, part, self.ray_settings)
        if make is None:
            raise NergError(
                f"there is no gaze field: name one by {parameter('gaze')}, or take the gaze of the rays, "
                f"{parameter('source', 'rays')}"
            )
        sums = self.empty_sums
        for k, weight in enumerate(part.weights.tolist()):
            eye = part.positions[k : k + 1]
            # The observer is used twice.
            observer = make(eye[0])
            densities = splat_densities(
                geometry.splats,
                geometry.environment,
                lambda _, bound=observer: bound,
                eye,
                np.array([weight]),
                geometry.settings,
                self.cone,
            )
            total, escaped = integrate_gaze(geometry.arrays, observer, eye[0], self.cone)
            sums = sums.add(
                SurfaceSums(densities.ravel(), np.zeros(0), 0.0, weight * escaped, weight * total, weight, 1)
            )
        return sums

    @property
    def environment(self) -> Environment:
        """What the observers see, and the gaze field."""
        return prepare_once(self, self._load)[2]

    def _load(self) -> tuple[SplatGeometry, MakeObserver | None, Environment]:
        import mitsuba as mi

        geometry = make_splat_geometry(read_splats(self.splats))
        if self.gaze is None:
            return geometry, None, (geometry.environment, None)
        gaze = GazeFieldInstance(load_gaze(self.gaze, namespace(mi.Float))[0])
        return (
            geometry,
            observers_from_field(gaze, geometry.environment, geometry.settings),
            (geometry.environment, gaze),
        )


@dataclass(frozen=True, eq=False)
class SplatGeometry:
    """Gaussian splats with what tracing needs: ``arrays``, geometry, ``settings``, and shortest ``axes`` (N, 3)."""

    splats: Splats
    arrays: SplatArrays
    environment: SceneGeometry
    settings: ObserverSettings
    axes: np.ndarray

    @property
    def tolerance(self) -> float:
        """Distance within which two estimates of a surface agree, see `ObserverSettings.tolerance`."""
        return 2 * self.settings.march.step


def make_splat_geometry(splats: Splats) -> SplatGeometry:
    """Prepare ``splats`` for tracing in the active variant."""
    import mitsuba as mi

    arrays = SplatArrays(splats, namespace(mi.Float))
    environment = SceneGeometry(SplatMedium(arrays))
    settings = ObserverSettings(march=default_march_settings(environment), surface_opacity=SURFACE_OPACITY)
    return SplatGeometry(splats, arrays, environment, settings, shortest_axes(splats))


# ---- Sums of all parts, in this process or elsewhere, bitwise the same ----


_BEGIN, _END = 0.05, 0.9  # progress at the begin and end of this stage
_NUMBERS = ("elsewhere", "escaped", "total", "weight", "count")


def sum_directly(
    scene: BakeScene | SplatScene, groups: Sequence[WeightedObservers | TrackedRays], reporter: Reporter
) -> list[SurfaceSums]:
    """Return the sums of each of ``groups``; nothing is stored."""
    parts = [list(split_into_parts(group)) for group in groups]
    count, done, totals = sum(map(len, parts)), 0, []
    with Interruption() as stop:
        for group in parts:
            sums = scene.empty_sums
            for part in group:
                stop.check()
                sums = sums.add(scene.sums(part))
                done += 1
                reporter.progress(_BEGIN + (_END - _BEGIN) * done / count, f"part {done} of {count}")
            totals.append(sums)
    return totals


@dataclass(frozen=True)
class PlannedBake:
    """Inputs that all parts share.

    ``files`` are those of the scene file, if there is one; ``mode`` is the Mitsuba variant.
    """

    scene: BakeScene | SplatScene
    files: PlannedScene | None
    mode: str

    @staticmethod
    def plan(scene: BakeScene | SplatScene) -> PlannedBake:
        """Return the inputs for ``scene`` in the active variant."""
        import mitsuba as mi

        file = scene.scene if isinstance(scene, BakeScene) else None
        return PlannedBake(scene, None if file is None else PlannedScene.plan(file), str(mi.variant()))


def sum_in_parts(
    scene: BakeScene | SplatScene, groups: Sequence[WeightedObservers | TrackedRays], parts: PartRunner, job: str
) -> list[SurfaceSums]:
    """Return the sums of each of ``groups`` from stored parts; ``job`` is its name."""
    all_parts: list[Part] = []
    for group in groups:
        kind, start = "rays" if isinstance(group, TrackedRays) else "observers", 0
        for part in split_into_parts(group):
            all_parts.append(Part(part, f"{kind} {start + 1} to {start + len(part.weights)}"))
            start += len(part.weights)
    plan = Plan(job, bake_part, PlannedBake.plan(scene), all_parts, ".npy", (*RENDER_LIBRARIES, "scipy"))
    arriving = parts.run(plan, _BEGIN, _END)
    totals = []
    for group in groups:
        sums = scene.empty_sums
        for _ in split_into_parts(group):
            sums = sums.add(read_sums(next(arriving), len(scene.empty_sums.face_sums)))
        totals.append(sums)
    return totals


def bake_part(common: PlannedBake, part: WeightedObservers | TrackedRays, output: Path) -> dict[str, float]:
    """Write sums over faces and vertices (.npy) of some observers or rays; return the other sums."""
    select_backend(common.mode)
    if common.files is not None:
        common.files.checked_path()
    sums = common.scene.sums(part)
    with replace_atomically(output) as temporary, temporary.open("wb") as out:
        np.save(out, np.concatenate([sums.face_sums, sums.vertex_sums]))
    return {name: getattr(sums, name) for name in _NUMBERS}


def read_sums(made: TaskOutput, faces: int) -> SurfaceSums:
    """Read what `bake_part` has written for this number of ``faces``."""
    values = read_npy(made.path, "part of a bake")
    return SurfaceSums(values[:faces], values[faces:], **{name: made.notes[name] for name in _NUMBERS})


def split_halves(who: TrackedRays, rays: Rays, seed: int) -> list[WeightedObservers | TrackedRays]:
    """Split ``who``, which are the ``rays``, into two random halves of the participants."""
    people = np.unique(rays.person)
    if len(people) < 2:
        raise NergError(f"{parameter('split_half', True)} needs at least two participants, and the rays are of one")
    first = np.isin(rays.person, np.random.default_rng(seed).permutation(people)[: len(people) // 2])
    order = [np.flatnonzero(first), np.flatnonzero(~first)]
    return [
        TrackedRays(who.origins[rows], who.directions[rows], who.weights[rows], start)
        for rows, start in zip(order, [0, len(order[0])])
    ]


_CHECKED_RAYS = 1024  # of each group of rays, whose origins are checked


def compute_sums(
    scene: BakeScene | SplatScene,
    groups: Sequence[WeightedObservers | TrackedRays],
    options: BakeOptions,
    name: Path,
    reporter: Reporter,
) -> list[SurfaceSums]:
    """Return the sums of each of ``groups``, directly or in parts; ``name`` is a file of the bake."""
    eyes = []
    for group in groups:
        if isinstance(group, WeightedObservers):
            eyes.append(group.positions)
            continue
        # Evenly spaced in the recording, since each position is compared with all solids.
        rows = np.linspace(0, len(group) - 1, min(len(group), _CHECKED_RAYS)).astype(int)
        eyes.append(group.origins[rows])
    warn_extrapolation(reporter.warn, *scene.environment, np.concatenate(eyes))
    if not options.in_parts:
        return sum_directly(scene, groups, reporter)
    parts = PartRunner(options, name, reporter, options.threads)
    return sum_in_parts(scene, groups, parts, f"nerg bake {name.absolute()}")


def describe_origin(surface: Path, options: BakeOptions) -> tuple[Provenance, dict[str, Any]]:
    """Return the provenance of a bake of ``surface``, and the same as JSON for the summary."""
    inputs = (surface, options.gaze, options.rays, options.observer_file, options.align)
    record = make_provenance("nerg bake", [p for p in inputs if p is not None], options.seed, options)
    summary = {"what": record.what, "inputs": dict(record.inputs), "seed": record.seed}
    return record, {**summary, "settings": dict(record.settings), "versions": dict(record.versions)}
