"""A bake in chunks: the surfaces and what looks at them, the sums of a chunk, and tasks of them in one order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.alignment.check import read_similarity
from nerg_mi.errors import NergError
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
from nerg_mi.ranges import POSITIVE_VALUES
from nerg_mi.rays.dataset import load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.readers.tables import iterate_table, read_table_columns
from nerg_mi.rendering.bands import is_nerg
from nerg_mi.rendering.scene import load_scene
from nerg_mi.surfaces.laplacian import SurfaceSums
from nerg_mi.surfaces.mesh import (
    SURFACE_OPACITY,
    Mesh,
    RefinedMesh,
    SurfaceTarget,
    Triangles,
    refine,
    shape_triangles,
    weld_mesh,
)
from nerg_mi.surfaces.sources import (
    WEIGHTINGS,
    GazeSumSettings,
    MakeObserver,
    RaySettings,
    TrackedRays,
    WeightedObservers,
    cluster_observers,
    sum_gaze,
    observers_from_field,
    ray_durations,
    sum_rays,
    ray_weights,
)
from nerg_mi.surfaces.splats import integrate_gaze, shortest_axes, splat_densities, sum_rays_on_splats
from nerg_mi.tasks.engines import TaskOutput, prepare_once
from nerg_mi.tasks.task import RENDER_LIBRARIES, Part, Plan
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_gaze import GazeFieldInstance
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium

from .base import Reporter, select_backend
from .geometry import read_training_alignment
from .parts import PartRunner, PlannedScene
from .scene_commands import BakeOptions

# ---- Whose gaze a bake is asked for, and in which unit ----

UNITS = {"share": "share of gaze per square metre [1/m²]", "seconds": "gaze per square metre [s/m²]"}
SOURCES = ("field", "rays")
CONE = 1.5
"""Degrees of a tracked ray's: the error of good trackers, and the radius of the fovea."""


def select_source(options: BakeOptions, rays: Rays | None, with_gaze: bool = False) -> str:
    """Whose gaze it is, of `SOURCES`; ``rays`` are those in memory, and ``with_gaze`` says whether the surface may have
    a gaze field of its own. Raises `NergError` for options that contradict each other."""
    people = rays is not None or options.rays is not None
    source = options.source or ("field" if options.gaze is not None or (with_gaze and not people) else "rays")
    if source not in SOURCES:
        raise NergError(f'--from is {" or ".join(SOURCES)}, got "{source}"')
    if options.unit not in UNITS:
        raise NergError(f'--unit is {" or ".join(UNITS)}, got "{options.unit}"')
    if source == "rays" and not people:
        raise NergError("whose gaze is it? give a gaze field by --gaze, or rays by --rays")
    if source == "rays" and (options.observer is not None or options.observer_file is not None):
        raise NergError("--observer and --path look with a gaze field; give --gaze, or leave them out")
    if source == "field" and (options.unit == "seconds" or options.split_half):
        raise NergError("--unit seconds and --halves are of rays, whose time is known; add --from rays")
    return source


def cone_radians(options: BakeOptions, source: str) -> float:
    """Standard deviation in radian of the cone of a look."""
    return float(np.radians(CONE if options.cone is None and source == "rays" else options.cone or 0.0))


# ---- Chunks ----
#
# The work of a bake in parts: a scene's description and some of its observers, or rays, give partial sums.
#
# A part is a plain function of what it is given: it may be computed anywhere, any number of times, with the same
# result. Parts are cut by numbers of this module, not by the machine, and their sums are added in the order of the
# parts.


OBSERVERS = 4
"""Observers of a part."""

RAYS = 1 << 16
"""Rays of a part."""


@dataclass(frozen=True, eq=False)
class BakeScene:
    """All that a part needs to know besides who looks; it can be pickled, and refers to ``gaze`` and ``scene`` by file.

    ``mesh`` receives, ``others`` hide it. ``gaze``: the field's checkpoint, None for that of the ``scene`` file, whose
    field stands around the meshes; None for a place of meshes alone.
    """

    mesh: Mesh
    occluders: tuple[Triangles, ...] = ()
    gaze: Path | None = None
    scene: Path | None = None
    gaze_settings: GazeSumSettings = field(default_factory=GazeSumSettings)
    ray_settings: RaySettings = field(default_factory=RaySettings)

    @property
    def empty_sums(self) -> SurfaceSums:
        """Of nobody."""
        return SurfaceSums.zeros(len(self.mesh.faces), len(self.mesh.vertices))

    def sums(self, part: WeightedObservers | TrackedRays) -> SurfaceSums:
        """Partial sums of the observers, or of the rays, of ``part``. A variant must be active; what is loaded is kept
        for the next part. Raises `NergError`."""
        target, make = prepare_once(self, self._loaded)
        if isinstance(part, TrackedRays):
            return sum_rays(target, part, self.ray_settings)
        if make is None:
            raise NergError("there is no gaze field: name one by --gaze, or take the gaze of the rays, --from rays")
        return sum_gaze(target, make, part.positions, part.weights, self.gaze_settings)

    def _loaded(self) -> tuple[SurfaceTarget, MakeObserver | None]:
        import mitsuba as mi

        medium, settings, falloff, gaze = None, None, 0.0, None
        if self.scene is not None:
            integrator: Any = load_scene(self.scene).integrator()
            if is_nerg(integrator):
                medium, gaze = integrator.medium, integrator.gaze
                settings, falloff = integrator.observer_settings, float(np.ravel(np.array(integrator.falloff))[0])
        target = SurfaceTarget(self.mesh, list(self.occluders), medium, settings if medium is not None else None, falloff)
        if self.gaze is not None:
            gaze = GazeFieldInstance(load_gaze(self.gaze, namespace(mi.Float))[0])
        return target, None if gaze is None else observers_from_field(gaze, target.geometry, target.settings)


def split_into_parts(who: WeightedObservers | TrackedRays) -> Iterator[WeightedObservers | TrackedRays]:
    """``who`` in parts, always the same."""
    if isinstance(who, TrackedRays):
        for a in range(0, len(who), RAYS):
            yield who.select(a, a + RAYS)
        return
    for a in range(0, len(who.weights), OBSERVERS):
        yield WeightedObservers(who.positions[a : a + OBSERVERS], who.weights[a : a + OBSERVERS])


# ---- Who looks: one observer, a path of them, or the people of tracked rays ----


POSITIONS = 1_000_000
"""A path has so many positions at most."""


def read_observer_file(path: Path) -> WeightedObservers:
    """Observers of a CSV file with columns x, y, z, and weight where they do not all count alike. Raises
    `NergError`."""
    names = ("x", "y", "z")
    columns = read_table_columns(path)
    missing = [name for name in names if name not in columns]
    if missing:
        raise NergError(f'the path "{path}" has no column "{missing[0]}"; it needs x, y, z and may have weight')
    weighted = "weight" in columns
    blocks = [b.numbers for b in iterate_table(path, (*names, "weight") if weighted else names)]
    rows = np.concatenate(blocks) if blocks else np.zeros((0, 3 + weighted))
    if not 0 < len(rows) <= POSITIONS:
        raise NergError(f'the path "{path}" has {len(rows):,} positions; give 1 to {POSITIONS:,}')
    check_coordinates(rows[:, :3], f'the positions of the path "{path}"')
    weights = rows[:, 3] if weighted else np.ones(len(rows))
    if not ((weights >= 0) & (weights <= POSITIVE_VALUES.high)).all() or not weights.sum() > 0:
        raise NergError(f'the path "{path}" has weights that are no numbers, negative, or all 0; correct them')
    return WeightedObservers(rows[:, :3], weights / weights.sum())


def load_bake_rays(options: BakeOptions, given: Rays | None) -> Rays | None:
    """The rays that are ``given``, or those that --rays names, or None. Raises `NergError` where there are none in
    it."""
    found = given
    if found is None and options.rays is not None:
        found = load_rays(options.rays, options.max_samples, options.seed)
    if found is not None and not len(found):
        raise NergError("there are no rays in what --rays names; give some")
    return found


def make_observers(options: BakeOptions, rays: Rays | None, align: Similarity, reporter: Reporter) -> WeightedObservers:
    """The observers of a gaze field, in the place. Raises `NergError` where none, or several kinds, are given."""
    given = [name for name, value in (("--observer", options.observer), ("--path", options.observer_file)) if value is not None]
    if len(given) > 1:
        raise NergError("--observer is one place and --path are many; give one of them")
    if options.observer is not None:
        if len(options.observer) != 3:
            raise NergError(f"--observer is three numbers x,y,z, got {options.observer}")
        return WeightedObservers(np.array([options.observer], np.float64), np.ones(1))
    if options.observer_file is not None:
        return read_observer_file(options.observer_file)
    if rays is None:
        raise NergError("nobody looks: give --observer x,y,z, a --path, or the --rays of people who were there")
    crowd = cluster_observers(
        transform_points(rays.origin, align), ray_weights(rays, options.ray_weights), options.num_observers, options.seed
    )
    reporter.message(
        f"{len(crowd.weights)} observers stand for {len(np.unique(rays.person))} people at {len(rays):,} moments, who "
        f"were {crowd.rms_distance / align.scale:.2f} m away from them (root mean square; 95 % within "
        f"{crowd.p95_distance / align.scale:.2f} m)"
    )
    return crowd


def make_gaze_groups(
    options: BakeOptions, source: str, rays: Rays | None, align: Similarity, reporter: Reporter
) -> tuple[list[WeightedObservers | TrackedRays], float]:
    """Whose gaze of the ``source`` is put on a surface, of rays two halves of the people where that is asked for; and
    the factor from shares of it to the unit. ``rays``: those in memory."""
    tracked = load_bake_rays(options, rays)
    if source == "field":
        return [make_observers(options, tracked, align, reporter)], 1.0
    assert tracked is not None
    who = make_tracked_rays(tracked, align, options.ray_weights)
    factor = float(ray_durations(tracked).sum()) if options.unit == "seconds" else 1.0
    return [*split_halves(who, tracked, options.seed)] if options.split_half else [who], factor


def make_tracked_rays(rays: Rays, align: Similarity, by: str) -> TrackedRays:
    """The rays themselves in the place, with weights ``by`` one of `WEIGHTS` that add up to one."""
    directions = rays.direction @ (align.matrix[:3, :3] / align.scale).T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return TrackedRays(transform_points(rays.origin, align), directions, ray_weights(rays, by))


def transform_points(points: np.ndarray, align: Similarity) -> np.ndarray:
    """Points (N, 3) of the rays' frame in the place's."""
    return points @ align.matrix[:3, :3].T + align.matrix[:3, 3]


def check_values(options: BakeOptions) -> None:
    """Raise `NergError` for weights, a cone or a scale of colours that are none."""
    if options.ray_weights not in WEIGHTINGS:
        raise NergError(f'--weights is {", ".join(WEIGHTINGS)}, got "{options.ray_weights}"')
    find_colormap(options.cmap)


def load_alignment(options: BakeOptions) -> Similarity:
    """From the rays to the place: what --align says, or as the gaze field was trained."""
    if options.align is not None:
        return read_similarity(options.align, "--align", "rays to place")
    return (
        Similarity() if options.gaze is None else read_training_alignment(read_metadata(options.gaze).get("provenance", {}))
    )


# ---- What receives gaze: a mesh file, shapes of a scene file, or the surface of a radiance field ----


TARGET_FACES = 100_000
"""Triangles that a surface is cut into when nothing is said."""


@dataclass(frozen=True, eq=False)
class BakeTarget:
    """``mesh`` of what receives gaze, as it was given: ``shape`` (F,) the number in ``names`` of what each face is of,
    and ``index`` (F,) its number there; ``others``: what only hides it."""

    mesh: Mesh
    names: tuple[str, ...]
    shape: np.ndarray
    index: np.ndarray
    others: tuple[Triangles, ...] = ()


def read_target(
    path: Path, shapes: tuple[str, ...], resolution: int, ns: ModuleType, reporter: Reporter
) -> BakeTarget:
    """Those of ``path``: a mesh, a scene (.xml) or a radiance field (.safetensors); of a scene, ``shapes`` alone where
    any are named. Raises `NergError`."""
    suffix = path.suffix.lower()
    others: tuple[Triangles, ...] = ()
    if suffix == ".xml":
        found, others = _of_scene(path, shapes)
    elif shapes:
        raise NergError(f'--shape names shapes of a scene, and "{path}" is none; leave it out')
    elif suffix == ".safetensors":
        kind = read_metadata(path).get("kind")
        if kind != "radiance":
            raise NergError(
                f'"{path}" is no radiance field, of which surfaces could be made; name the place first, and the gaze '
                "field by --gaze"
            )
        reporter.progress(0.02, "looking for the field's surface")
        body = mesh_of_field(load_radiance(path, ns)[0], resolution)
        assert body.faces is not None, "a mesh has faces"
        found = {path.stem: (body.vertices, body.faces)}
    else:
        refuse_unsupported_splats(path)
        body = read_mesh_file(path)
        for note in body.notes:
            reporter.message(f"of {path}: {note}")
        found = {path.stem: (body.vertices, body.faces)}
    return _joined(path, found, others, reporter)


def refine_target(receivers: BakeTarget, longest: float | None, scale: float) -> RefinedMesh:
    """Their mesh with edges of at most ``longest`` metres, or of a length that gives about `FACES` triangles;
    ``scale``: scene units a metre."""
    mesh = receivers.mesh
    if longest is not None:
        return refine(mesh, longest * scale)
    # Equilateral triangles of such edges would be so many; halving makes triangles up to four times smaller.
    return refine(mesh, float(np.sqrt(4 * mesh.area.sum() / (np.sqrt(3) * TARGET_FACES)) * 1.5))


def _of_scene(path: Path, shapes: tuple[str, ...]) -> tuple[dict[str, Triangles], tuple[Triangles, ...]]:
    loaded = load_scene(path)
    # Mitsuba keeps them in no order that is always the same.
    every = dict(sorted(((shape.id(), shape) for shape in loaded.shapes()), key=lambda named: named[0]))
    missing = [name for name in shapes if name not in every]
    if missing:
        known = f"it has {', '.join(every)}" if every else "it has none"
        raise NergError(f'the scene "{path}" has no shape "{missing[0]}"; {known}')
    if not every:
        raise NergError(f'the scene "{path}" has no shapes to put gaze on; name its field, or its splats, in its place')
    found, others = {}, []
    for name, shape in every.items():
        triangles = shape_triangles(shape)
        if triangles is None:
            raise NergError(
                f'the shape "{name}" of "{path}" is a {shape.class_name()}, which has no triangles; give a mesh of it'
            )
        if shapes and name not in shapes:
            others.append(triangles)
        else:
            found[name] = triangles
    return found, tuple(others)


def _joined(path: Path, found: dict[str, Triangles], others: tuple[Triangles, ...], reporter: Reporter) -> BakeTarget:
    """One mesh of all, whose vertices are one where they touch."""
    first = np.cumsum([0, *(len(v) for v, _ in found.values())])
    vertices = np.concatenate([v for v, _ in found.values()])
    faces = np.concatenate([f + start for (_, f), start in zip(found.values(), first)])
    counts = [len(f) for _, f in found.values()]
    mesh, index, repairs = weld_mesh(vertices, faces, f'the mesh "{path}"')
    if repairs.summary:
        reporter.message(f"{path.name}: {repairs.summary}")
    shape = np.repeat(np.arange(len(counts)), counts)
    number = np.concatenate([np.arange(n) for n in counts])
    return BakeTarget(mesh, tuple(found), shape[index], number[index], others)


# ---- The work of a bake of Gaussian splats in parts: as `chunks`, of files alone ----


@dataclass(frozen=True, eq=False)
class SplatScene:
    """All that a part needs to know besides who looks; it can be pickled, and refers to files: ``splats``, of which
    there are ``count``, and the checkpoint of the ``gaze`` field, or None. ``cone``: standard deviation in radian of
    that through which the field's gaze is seen."""

    splats: Path
    count: int
    gaze: Path | None = None
    cone: float = 0.0
    ray_settings: RaySettings = field(default_factory=RaySettings)

    @property
    def empty_sums(self) -> SurfaceSums:
        """Of nobody."""
        return SurfaceSums.zeros(2 * self.count, 0)

    def sums(self, part: WeightedObservers | TrackedRays) -> SurfaceSums:
        """Partial sums of the observers, or of the rays, of ``part``: ``face`` is, of rays, shares of gaze on the sides
        of the Gaussians, and of observers densities of theirs, which are no part of ``total``. A variant must be
        active; what is loaded is kept for the next part. Raises `NergError`."""
        there, make = prepare_once(self, self._loaded)
        if isinstance(part, TrackedRays):
            return sum_rays_on_splats(there.arrays, there.axes, part, self.ray_settings)
        if make is None:
            raise NergError("there is no gaze field: name one by --gaze, or take the gaze of the rays, --from rays")
        sums = self.empty_sums
        for k, weight in enumerate(part.weights.tolist()):
            eye = part.positions[k : k + 1]
            # What is known of an observer is needed twice, and made once.
            looker = make(eye[0])
            densities = splat_densities(
                there.splats, there.place, lambda _, own=looker: own, eye, np.array([weight]), there.settings, self.cone
            )
            total, escaped = integrate_gaze(there.arrays, looker, eye[0], self.cone)
            sums = sums.add(
                SurfaceSums(densities.ravel(), np.zeros(0), 0.0, weight * escaped, weight * total, weight, 1)
            )
        return sums

    def _loaded(self) -> tuple[SplatGeometry, MakeObserver | None]:
        import mitsuba as mi

        there = make_splat_geometry(read_splats(self.splats))
        if self.gaze is None:
            return there, None
        gaze = GazeFieldInstance(load_gaze(self.gaze, namespace(mi.Float))[0])
        return there, observers_from_field(gaze, there.place, there.settings)


@dataclass(frozen=True, eq=False)
class SplatGeometry:
    """Splats as they are traced: ``arrays`` of them in a ``place``, with ``settings``, and their shortest ``axes``
    (N, 3)."""

    splats: Splats
    arrays: SplatArrays
    place: SceneGeometry
    settings: ObserverSettings
    axes: np.ndarray

    @property
    def tolerance(self) -> float:
        """How far apart two ideas of one surface may be, as of `ObserverSettings.tolerance`."""
        return 2 * self.settings.march.step


def make_splat_geometry(splats: Splats) -> SplatGeometry:
    """That of ``splats``, in the variant in use."""
    import mitsuba as mi

    arrays = SplatArrays(splats, namespace(mi.Float))
    place = SceneGeometry(SplatMedium(arrays))
    settings = ObserverSettings(march=default_march_settings(place), surface_opacity=SURFACE_OPACITY)
    return SplatGeometry(splats, arrays, place, settings, shortest_axes(splats))


# ---- All parts of a bake and their sums, in this process or wherever parts are run: the same to the bit ----


_BEGIN, _END = 0.05, 0.9  # of a bake is this
_NUMBERS = ("elsewhere", "escaped", "total", "weight", "count")


def sum_directly(
    scene: BakeScene | SplatScene, groups: Sequence[WeightedObservers | TrackedRays], reporter: Reporter
) -> list[SurfaceSums]:
    """The sums of each of ``groups``, of which nothing is kept."""
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
    """What all parts of a bake have in common. ``files``: those of the ``scene``'s scene file, where it has one;
    ``mode``: the Mitsuba variant."""

    scene: BakeScene | SplatScene
    files: PlannedScene | None
    mode: str

    @staticmethod
    def plan(scene: BakeScene | SplatScene) -> PlannedBake:
        """That of ``scene``, in the variant in use."""
        import mitsuba as mi

        file = scene.scene if isinstance(scene, BakeScene) else None
        return PlannedBake(scene, None if file is None else PlannedScene.plan(file), str(mi.variant()))


def sum_in_parts(
    scene: BakeScene | SplatScene, groups: Sequence[WeightedObservers | TrackedRays], parts: PartRunner, what: str
) -> list[SurfaceSums]:
    """The sums of each of ``groups``, whose parts are kept; ``what``: the job, as its user calls it."""
    whole: list[Part] = []
    for group in groups:
        kind, start = "rays" if isinstance(group, TrackedRays) else "observers", 0
        for part in split_into_parts(group):
            whole.append(Part(part, f"{kind} {start + 1} to {start + len(part.weights)}"))
            start += len(part.weights)
    plan = Plan(what, bake_part, PlannedBake.plan(scene), whole, ".npy", (*RENDER_LIBRARIES, "scipy"))
    arriving = parts.run(plan, _BEGIN, _END)
    totals = []
    for group in groups:
        sums = scene.empty_sums
        for _ in split_into_parts(group):
            sums = sums.add(read_sums(next(arriving), len(scene.empty_sums.face_sums)))
        totals.append(sums)
    return totals


def bake_part(common: PlannedBake, part: WeightedObservers | TrackedRays, output: Path) -> dict[str, float]:
    """Sums over faces and vertices (.npy) of some observers, or rays, with the others as notes."""
    select_backend(common.mode)
    if common.files is not None:
        common.files.checked_path()
    sums = common.scene.sums(part)
    with replace_atomically(output) as temporary, temporary.open("wb") as out:
        np.save(out, np.concatenate([sums.face_sums, sums.vertex_sums]))
    return {name: getattr(sums, name) for name in _NUMBERS}


def read_sums(made: TaskOutput, faces: int) -> SurfaceSums:
    """What `bake_part` has written, of so many ``faces``."""
    values = read_npy(made.path, "part of a bake")
    return SurfaceSums(values[:faces], values[faces:], **{name: made.notes[name] for name in _NUMBERS})


def split_halves(who: TrackedRays, rays: Rays, seed: int) -> list[WeightedObservers | TrackedRays]:
    """``who``, which are the ``rays``, as those of two halves of the people, drawn by ``seed``."""
    people = np.unique(rays.person)
    if len(people) < 2:
        raise NergError("--halves needs two people at least, and the rays are of one")
    first = np.isin(rays.person, np.random.default_rng(seed).permutation(people)[: len(people) // 2])
    order = [np.flatnonzero(first), np.flatnonzero(~first)]
    return [
        TrackedRays(who.origins[rows], who.directions[rows], who.weights[rows], start)
        for rows, start in zip(order, [0, len(order[0])])
    ]


def compute_sums(
    scene: BakeScene | SplatScene,
    groups: Sequence[WeightedObservers | TrackedRays],
    options: BakeOptions,
    name: Path,
    reporter: Reporter,
) -> list[SurfaceSums]:
    """The sums of each of ``groups``, in one go or in parts as ``options`` say; ``name``: a file of the bake."""
    if not options.in_parts:
        return sum_directly(scene, groups, reporter)
    parts = PartRunner(options, name, reporter, options.threads)
    return sum_in_parts(scene, groups, parts, f"nerg bake {name.absolute()}")


def describe_origin(surface: Path, options: BakeOptions) -> tuple[Provenance, dict[str, Any]]:
    """What a bake of ``surface`` was made of, and the same as its summary has it (JSON)."""
    given = (surface, options.gaze, options.rays, options.observer_file, options.align)
    about = make_provenance("nerg bake", [p for p in given if p is not None], options.seed, options)
    told = {"what": about.what, "inputs": dict(about.inputs), "seed": about.seed}
    return about, {**told, "settings": dict(about.settings), "versions": dict(about.versions)}
