"""Parts of a bake: observers, the sums of one part, and the order in which sums are added."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.gaze import GazeField, read_training_alignment
from nerg_mi.environment.planned import PlannedFiles
from nerg_mi.environment.scene import Scene
from nerg_mi.environment.scene_loading import activate_mitsuba, activate_variant
from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.gaze_base import GazeNetwork
from nerg_mi.figures.style import Provenance, existing_files, make_provenance
from nerg_mi.files.atomic import replace_atomically
from nerg_mi.files.safe_read import read_npy
from nerg_mi.formats.alignments import open_similarity
from nerg_mi.interruption import Interruption
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.transforms import transform_points
from nerg_mi.progress import Reporter
from nerg_mi.ranges import POSITIVE_VALUES
from nerg_mi.tasks.engines import TaskOutput
from nerg_mi.tasks.execution import prepare_once
from nerg_mi.tasks.parts import PartRunner
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tasks.task import RENDER_LIBRARIES, Part, Plan
from nerg_mi.tracking.dataset import open_rays, open_recordings
from nerg_mi.tracking.event_settings import read_fixations
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.readers.columns import open_named_table
from nerg_mi.transport.extrapolation import warn_extrapolation
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.mitsuba_mesh import Triangles
from nerg_mi.transport.observer_gaze import GazeFieldInstance

from .laplacian import SurfaceSums
from .mesh import Mesh, SurfaceTarget
from .settings import BakeColors, BakeSampling
from .sources import (
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

# ---- Source of the gaze, and units ----

UNITS = {"share": "share of gaze per square metre [1/m²]", "seconds": "gaze per square metre [s/m²]"}
SOURCES = ("field", "rays")
CONE = 1.5
"""Default cone of a recorded ray in degrees: the error of good trackers and the radius of the fovea."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BakeInputs:
    """Arguments of `nerg_mi.surfaces.bake.bake`."""

    surface: Any
    gaze: Any
    rays: Any
    source: str | None
    observer: Sequence[float] | None
    observer_file: Path | None
    align: Any
    shapes: tuple[str, ...]
    smooth: float
    max_edge: float | None
    unit: str
    split_half: bool
    max_samples: int | None
    seed: int
    sampling: BakeSampling
    colors: BakeColors

    def select_source(self) -> str:
        """Return the source of the gaze, one of `SOURCES`. Raises `NergError` for contradictory arguments."""
        with_gaze = is_scene(self.surface)
        has_rays = self.rays is not None
        source = self.source or ("field" if self.gaze is not None or (with_gaze and not has_rays) else "rays")
        if source not in SOURCES:
            raise NergError(f'{parameter("source")} must be {" or ".join(SOURCES)}, got "{source}"')
        if source == "rays" and not has_rays:
            raise NergError(
                f"there is no gaze: give a gaze field with {parameter('gaze')}, or rays with {parameter('rays')}"
            )
        if source == "rays" and (self.observer is not None or self.observer_file is not None):
            raise NergError(
                f"{parameter('observer')} and {parameter('observer_file')} need a gaze field; add "
                f"{parameter('gaze')}, or leave them out"
            )
        if source == "field" and (self.unit == "seconds" or self.split_half):
            raise NergError(
                f"{parameter('unit', 'seconds')} and {parameter('split_half', True)} apply to rays, which have "
                f"durations; add {parameter('source', 'rays')}"
            )
        return source

    def cone_radians(self, source: str) -> float:
        """Return the standard deviation of the gaze cone in radians."""
        cone = self.sampling.cone
        return float(np.radians(CONE if cone is None and source == "rays" else cone or 0.0))

    def open_gaze(self) -> GazeField | None:
        """Return the gaze field, if there is one."""
        return None if self.gaze is None else GazeField.open(self.gaze)

    def describe_origin(self, changed: Mapping[str, Any]) -> tuple[Provenance, dict[str, Any]]:
        """Return the provenance of the bake, with ``changed`` settings, and the same as JSON for the summary."""
        paths = [getattr(x, "path", x) for x in (self.surface, self.gaze, self.rays, self.observer_file, self.align)]
        reduced = {} if self.rays is None else read_fixations(open_recordings(self.rays).metadata)
        record = make_provenance("nerg bake", existing_files(*paths), self.seed, {**changed, **reduced})
        summary = {"what": record.what, "inputs": dict(record.inputs), "seed": record.seed}
        return record, {**summary, "settings": dict(record.settings), "versions": dict(record.versions)}


def is_scene(surface: Any) -> bool:
    """Return whether ``surface`` is a scene, which may have a gaze field: a file (.xml), or one in memory."""
    import mitsuba as mi

    if isinstance(surface, (str, os.PathLike)):
        return Path(surface).suffix.lower() == ".xml"
    if isinstance(surface, Mapping):
        return surface.get("type") == "scene"
    return isinstance(surface, (Scene, mi.Scene))


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


class Baker(ABC):
    """Sums the gaze of observers, or of recorded rays, on a surface."""

    gaze: GazeNetwork | None

    @property
    @abstractmethod
    def empty_sums(self) -> SurfaceSums:
        """Sums without any observer."""

    @abstractmethod
    def sums(self, part: WeightedObservers | TrackedRays) -> SurfaceSums:
        """Return the partial sums of the observers or rays in ``part``. Raises `NergError` without a gaze field."""

    @property
    @abstractmethod
    def observed(self) -> tuple[SceneGeometry, GazeFieldInstance | None]:
        """What the observers see, and the gaze field."""

    @abstractmethod
    def plan(self, inputs: BakeInputs, folder: Path) -> Any:
        """Return the inputs of parts, whose method ``open`` returns the baker in the variant ``mode``. What is in
        memory only is written to ``folder``. Raises `NergError` for a scene that is not a file."""

    def plan_gaze(self, inputs: BakeInputs, folder: Path) -> Path | None:
        """Return the file of the gaze field, which is written to ``folder`` if it has none."""
        if self.gaze is None:
            return None
        field = inputs.open_gaze()
        assert field is not None
        return field.path or field.save(folder / "gaze.safetensors")


@dataclass(frozen=True, eq=False)
class MeshBaker(Baker):
    """Sums the gaze on the faces of a mesh.

    Attributes
    ----------
    mesh
        Target surface.
    occluders
        Meshes that only occlude.
    gaze
        Gaze field. None: that of ``nerg``, or of rays.
    nerg
        Integrator of a scene, whose field surrounds the meshes. None: meshes alone.
    """

    mesh: Mesh
    occluders: tuple[Triangles, ...] = ()
    gaze: GazeNetwork | None = None
    nerg: Any = None
    gaze_settings: GazeSumSettings = field(default_factory=GazeSumSettings)
    ray_settings: RaySettings = field(default_factory=RaySettings)

    @property
    def empty_sums(self) -> SurfaceSums:
        return SurfaceSums.zeros(len(self.mesh.faces), len(self.mesh.vertices))

    def sums(self, part: WeightedObservers | TrackedRays) -> SurfaceSums:
        if isinstance(part, TrackedRays):
            return sum_rays(self.target, part, self.ray_settings)
        return sum_gaze(self.target, self.make_observer, part.positions, part.weights, self.gaze_settings)

    @cached_property
    def make_observer(self) -> MakeObserver:
        """Makes observers of the gaze field."""
        return observers_from_field(require_gaze(self.observed[1]), self.target.geometry, self.target.settings)

    @cached_property
    def target(self) -> SurfaceTarget:
        """The surface as it is traced."""
        medium, settings, falloff = None, None, 0.0
        if self.nerg is not None:
            medium, settings = self.nerg.medium, self.nerg.observer_settings
            falloff = float(np.ravel(np.array(self.nerg.falloff))[0])
        return SurfaceTarget(self.mesh, list(self.occluders), medium, settings if medium is not None else None, falloff)

    @cached_property
    def observed(self) -> tuple[SceneGeometry, GazeFieldInstance | None]:
        gaze = None if self.nerg is None else self.nerg.gaze
        return self.target.geometry, gaze if self.gaze is None else GazeFieldInstance(self.gaze)

    def plan(self, inputs: BakeInputs, folder: Path) -> PlannedBake:
        files, surface = None, inputs.surface
        if self.nerg is not None:
            path = surface.path if isinstance(surface, Scene) else surface
            if not isinstance(path, (str, os.PathLike)):
                raise NergError("parts read the scene from a file; save the scene, and pass its path")
            files = PlannedFiles.plan(Path(path))
        mode = str(activate_mitsuba().variant())
        return PlannedBake(replace(self, gaze=None, nerg=None), self.plan_gaze(inputs, folder), files, mode)


@dataclass(frozen=True, eq=False)
class PlannedBake:
    """Inputs that all parts share: a `MeshBaker` with files in place of the gaze field and the integrator."""

    baker: MeshBaker
    gaze: Path | None
    files: PlannedFiles | None
    mode: str

    def open(self) -> MeshBaker:
        """Load the files."""
        nerg = None if self.files is None else Environment.open(self.files.checked_path(), keep_shapes=True).nerg
        return replace(self.baker, gaze=None if self.gaze is None else GazeField.load(self.gaze).network, nerg=nerg)


def require_gaze(gaze: GazeFieldInstance | None) -> GazeFieldInstance:
    """Return ``gaze``. Raises `NergError` if there is none."""
    if gaze is None:
        raise NergError(
            f"there is no gaze field: name one by {parameter('gaze')}, or take the gaze of the rays, "
            f"{parameter('source', 'rays')}"
        )
    return gaze


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


def make_observers(inputs: BakeInputs, rays: Rays | None, align: Similarity, reporter: Reporter) -> WeightedObservers:
    """Return the observers of a gaze field, in scene coordinates. Raises `NergError` for none or several kinds."""
    kinds = [
        name
        for name, value in (
            (parameter("observer"), inputs.observer),
            (parameter("observer_file"), inputs.observer_file),
        )
        if value is not None
    ]
    if len(kinds) > 1:
        raise NergError(f"{parameter('observer')} and {parameter('observer_file')} are alternatives; give one of them")
    if inputs.observer is not None:
        if len(inputs.observer) != 3:
            raise NergError(f"{parameter('observer')} must be three numbers x,y,z, got {inputs.observer}")
        return WeightedObservers(np.array([inputs.observer], np.float64), np.ones(1))
    if inputs.observer_file is not None:
        return read_observer_file(inputs.observer_file)
    if rays is None:
        raise NergError(
            f"there is no observer: give {parameter('observer', 'x,y,z')}, an {parameter('observer_file')}, or the "
            f"recorded positions of {parameter('rays')}"
        )
    observers = cluster_observers(
        transform_points(align.matrix, rays.origin),
        ray_weights(rays, inputs.sampling.ray_weights),
        inputs.sampling.num_observers,
        inputs.seed,
    )
    reporter.message(
        f"{len(observers.weights)} observers represent {len(np.unique(rays.person))} participants in {len(rays):,} "
        f"samples; distance from a sample to its observer: {observers.rms_distance / align.scale:.2f} m (root mean "
        f"square), 95 % within {observers.p95_distance / align.scale:.2f} m"
    )
    return observers


def make_gaze_groups(
    inputs: BakeInputs, source: str, align: Similarity, reporter: Reporter
) -> tuple[list[WeightedObservers | TrackedRays], float]:
    """Return the groups whose gaze is baked, and the factor from shares of gaze to the unit.

    There is one group, or one for each half of the participants with ``split_half``.
    """
    tracked = inputs.rays
    if tracked is not None and not isinstance(tracked, Rays):
        tracked = open_rays(tracked, inputs.max_samples, inputs.seed)
    if tracked is not None and not len(tracked):
        raise NergError(f"the file of {parameter('rays')} contains no rays; name another one")
    if source == "field":
        return [make_observers(inputs, tracked, align, reporter)], 1.0
    assert tracked is not None
    who = make_tracked_rays(tracked, align, inputs.sampling.ray_weights)
    factor = float(ray_durations(tracked).sum()) if inputs.unit == "seconds" else 1.0
    return [*split_halves(who, tracked, inputs.seed)] if inputs.split_half else [who], factor


def make_tracked_rays(rays: Rays, align: Similarity, by: str) -> TrackedRays:
    """Return the rays in scene coordinates, with weights of the kind ``by`` (`WEIGHTINGS`) that sum to one."""
    directions = rays.direction @ (align.matrix[:3, :3] / align.scale).T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return TrackedRays(transform_points(align.matrix, rays.origin), directions, ray_weights(rays, by))


def load_alignment(inputs: BakeInputs, gaze: GazeField | None, reporter: Reporter) -> Similarity:
    """Return the transform from the rays to the scene: ``align``, or that of the training of the gaze field."""
    if inputs.align is None:
        return Similarity() if gaze is None else read_training_alignment(gaze.provenance)
    return open_similarity(inputs.align, "rays to place", reporter.warn)


# ---- Sums of all parts, in this process or elsewhere, bitwise the same ----


_BEGIN, _END = 0.05, 0.9  # progress at the begin and end of this stage
_NUMBERS = ("elsewhere", "escaped", "total", "weight", "count")


def sum_directly(
    baker: Baker, groups: Sequence[WeightedObservers | TrackedRays], reporter: Reporter
) -> list[SurfaceSums]:
    """Return the sums of each of ``groups``; nothing is stored."""
    parts = [list(split_into_parts(group)) for group in groups]
    count, done, totals = sum(map(len, parts)), 0, []
    with Interruption() as stop:
        for group in parts:
            sums = baker.empty_sums
            for part in group:
                sums = sums.add(baker.sums(part))
                done += 1
                reporter.progress(_BEGIN + (_END - _BEGIN) * done / count, f"part {done} of {count}")
                stop.check()
            totals.append(sums)
    return totals


def sum_in_parts(
    baker: Baker, common: Any, groups: Sequence[WeightedObservers | TrackedRays], parts: PartRunner, job: str
) -> list[SurfaceSums]:
    """Return the sums of each of ``groups`` from stored parts, planned as ``common``; ``job`` is its name."""
    all_parts: list[Part] = []
    for group in groups:
        kind, start = "rays" if isinstance(group, TrackedRays) else "observers", 0
        for part in split_into_parts(group):
            all_parts.append(Part(part, f"{kind} {start + 1} to {start + len(part.weights)}"))
            start += len(part.weights)
    plan = Plan(job, bake_part, common, all_parts, ".npy", (*RENDER_LIBRARIES, "scipy"))
    arriving = parts.run(plan, _BEGIN, _END)
    totals = []
    for group in groups:
        sums = baker.empty_sums
        for _ in split_into_parts(group):
            sums = sums.add(read_sums(next(arriving), len(baker.empty_sums.face_sums)))
        totals.append(sums)
    return totals


def bake_part(common: Any, part: WeightedObservers | TrackedRays, output: Path) -> dict[str, float]:
    """Write sums over faces and vertices (.npy) of some observers or rays; return the other sums."""
    activate_variant(common.mode)
    sums = prepare_once(common, common.open).sums(part)
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
    baker: Baker,
    groups: Sequence[WeightedObservers | TrackedRays],
    inputs: BakeInputs,
    parallel: Parallel,
    reporter: Reporter,
) -> list[SurfaceSums]:
    """Return the sums of each of ``groups``, directly or in parts."""
    eyes = []
    for group in groups:
        if isinstance(group, WeightedObservers):
            eyes.append(group.positions)
            continue
        # Evenly spaced in the recording, since each position is compared with all solids.
        rows = np.linspace(0, len(group) - 1, min(len(group), _CHECKED_RAYS)).astype(int)
        eyes.append(group.origins[rows])
    warn_extrapolation(reporter.warn, *baker.observed, np.concatenate(eyes))
    if not parallel.in_parts:
        return sum_directly(baker, groups, reporter)
    parts = PartRunner(parallel, None, reporter)
    name = Path(inputs.surface).name if isinstance(inputs.surface, (str, os.PathLike)) else "a surface in memory"
    with parts.store.make_scratch_folder() as folder:
        return sum_in_parts(baker, baker.plan(inputs, folder), groups, parts, f"nerg bake {name}")
