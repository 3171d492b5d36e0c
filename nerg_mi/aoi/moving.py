"""Areas and surfaces that move: what samples hit, and what was visible, at the time of each sample.

Each object is traced alone, by rays that are transformed to its frame at rest, and the environment without it. No scene
is built for a time.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.formats.alignments import AnySimilarity
from nerg_mi.progress import Reporter
from nerg_mi.tracking.objects import Motion, ObjectPoses
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.geometry import SceneGeometry

from .areas import Areas, SceneShape
from .placed import (
    AoiTarget,
    HitAssignment,
    PlacedAreas,
    ShapeAoi,
    assign_hits,
    find_nearest_entry,
    open_placed_areas,
    scene_from_shapes,
)
from .shares import SamplePoints, find_visible_points

_FIRST_POINTS = (2, 8)
"""Numbers of points of an AOI after which observers who see one of them are decided."""

_GOLDEN = 0.6180339887498949

# ---- Objects in an environment ----


@dataclass(frozen=True, eq=False)
class MovingObject:
    """An object by its ``name``: the indices of the ``elements`` that move with it, and its ``surfaces`` alone, where
    the environment shows them; None if it is no shape of the environment."""

    name: str
    elements: frozenset[int]
    surfaces: Environment | None


@dataclass(frozen=True, eq=False)
class MovingAreas:
    """Areas and surfaces of which some move.

    Parameters
    ----------
    placed
        Areas where the environment shows them. Each shape is occluded by those that it moves with, or that do not move.
    static
        The environment without what moves.
    objects
        What moves.
    poses
        Its poses.
    """

    placed: PlacedAreas
    static: Environment
    objects: tuple[MovingObject, ...]
    poses: ObjectPoses

    def at(self, rays: Rays) -> AreasAtTimes:
        """Return the areas at the time of each sample."""
        align = self.placed.environment.align
        return AreasAtTimes(self, [self.poses.find_motion(o.name, rays).in_frame(align) for o in self.objects])

    @cached_property
    def sample_points(self) -> list[SamplePoints]:
        """Points on each elementary AOI at rest."""
        return [SamplePoints.sample([aoi], self.placed.sampling.aoi_samples) for aoi in self.placed.aois]

    @property
    def occlusion_margin(self) -> float:
        """Distance in scene units by which the static environment may lie in front of a shape: that of a field is no
        shape, and is less accurate."""
        return self.placed.margin if self.static.scene_geometry.medium is not None else 0.0


@dataclass(frozen=True, eq=False)
class _AoiAtTimes:
    """An AOI that moves with ``motion``, unless that is None. A shape is hit up to the distance ``limit`` (N,), at
    which another object or the environment occludes it."""

    aoi: AoiTarget
    motion: Motion | None
    limit: np.ndarray

    @property
    def is_surface(self) -> bool:
        return self.aoi.is_surface

    def intersect(self, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        motion = self.motion
        if motion is None:
            near, far = self.aoi.intersect(o, d)
        else:
            near, far = self.aoi.intersect(motion.to_rest(o), motion.turn_to_rest(d))
            near, far = np.where(motion.is_present, near, np.inf), np.where(motion.is_present, far, -np.inf)
        return (near, far) if not isinstance(self.aoi, ShapeAoi) else (np.where(near <= self.limit, near, np.inf), far)


@dataclass(frozen=True, eq=False)
class AreasAtTimes:
    """`MovingAreas` at N times, with the ``motions`` of the objects then."""

    moving: MovingAreas
    motions: Sequence[Motion]

    def select(self, rows: Any) -> AreasAtTimes:
        """Return the areas at the times with these indices."""
        return AreasAtTimes(self.moving, [motion.select(rows) for motion in self.motions])

    def _trace(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Return the distance along rays (N, 3) to the static environment, and to each object, (1 + K, N)."""
        depths = [self.moving.static.trace_depth(o, d)]
        for item, motion in zip(self.moving.objects, self.motions):
            depth = np.full(len(o), np.inf)
            if item.surfaces is not None:
                there = motion.select(rows := np.flatnonzero(motion.is_present))
                depth[rows] = item.surfaces.trace_depth(there.to_rest(o[rows]), there.turn_to_rest(d[rows]))
            depths.append(depth)
        return np.stack(depths)

    def look(
        self, o: np.ndarray, d: np.ndarray, hit_depth: np.ndarray | None = None
    ) -> tuple[list[_AoiAtTimes], np.ndarray | None]:
        """Return the AOIs along rays (N, 3), one for each time, and the distance to the first surface: ``hit_depth`` if
        the environment is unknown."""
        depths = self._trace(o, d)
        aois = []
        for k, aoi in enumerate(self.moving.placed.aois):
            owner = next((n for n, item in enumerate(self.moving.objects) if k in item.elements), -1)
            limits = depths.copy()
            limits[0] += self.moving.occlusion_margin
            limits[owner + 1] = np.inf
            aois.append(_AoiAtTimes(aoi, self.motions[owner] if owner >= 0 else None, limits.min(axis=0)))
        is_known = self.moving.placed.environment.has_surfaces
        return aois, depths.min(axis=0) if is_known else hit_depth

    def assign_hits(self, o: np.ndarray, d: np.ndarray, hit_depth: np.ndarray | None = None) -> HitAssignment:
        """Assign rays (N, 3), one for each time, to the AOIs that they hit."""
        aois, depth = self.look(o, d, hit_depth)
        return assign_hits(aois, o, d, depth, self.moving.placed.margin)

    def trace_depth(self, o: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Return the distance (N,) along rays, one for each time, to the surfaces of the environment or, if these are
        unknown, to the nearest AOI."""
        if self.moving.placed.environment.has_surfaces:
            return self._trace(o, d).min(axis=0)
        return find_nearest_entry(self.look(o, d)[0], o, d)

    def find_visible(self, observers: np.ndarray, facing: np.ndarray, fov: float) -> np.ndarray:
        """Return whether each elementary AOI is visible to the observers (N, 3), one for each time, (N, K)."""
        moving, out = self.moving, np.zeros((len(observers), len(self.moving.placed.aois)), bool)
        for k, targets in enumerate(moving.sample_points):
            motion = next((m for item, m in zip(moving.objects, self.motions) if k in item.elements), None)
            rows = np.arange(len(observers)) if motion is None else np.flatnonzero(motion.is_present)
            # Most AOIs that are visible are so at one of a few points, and the others are not traced then.
            for part in np.split(_spread(len(targets.points)), _FIRST_POINTS):
                points, normals = targets.points[part], targets.normals[part]
                here = self.select(rows)
                moved = None if motion is None else motion.select(rows)
                is_visible = find_visible_points(
                    points[None] if moved is None else moved.move(points),
                    normals[None] if moved is None else normals @ np.swapaxes(moved.rotation, 1, 2),
                    observers[rows],
                    lambda subset, o, d, here=here: here.select(subset).trace_depth(o, d),
                    moving.placed.margin,
                    facing=facing[rows],
                    fov=fov,
                ).any(axis=1)
                out[rows[is_visible], k] = True
                rows = rows[~is_visible]
        return out


def _spread(count: int) -> np.ndarray:
    """Return the indices of ``count`` points in an order in which the first ones are spread over all of them."""
    return np.argsort(np.arange(count) * _GOLDEN % 1, kind="stable")


def place_objects(placed: PlacedAreas, poses: ObjectPoses) -> MovingAreas:
    """Let areas and shapes of the environment move by their names: an object is a shape, an area or both.

    An area that is a shape moves with it, and a group with all of its parts. Raises `NergError` for an unknown object,
    and for two objects that move the same.
    """
    environment, areas = placed.environment, placed.areas
    shapes, members = environment.shapes, areas.element_indices()
    owners: dict[str, str] = {}
    objects, of_shapes = [], []
    for name in poses.names:
        if name not in shapes and name not in members:
            available = ", ".join(list(dict.fromkeys([*shapes, *members]))[:20])
            raise NergError(
                f'the object "{sanitize(name, 40)}" of {parameter("objects")} is neither a shape of the environment '
                f"nor an area; those are {available}"
            )
        elements = set(members.get(name, ()))
        parts = {e.shape for k in elements if isinstance(e := areas.elements[k], SceneShape)} | ({name} & {*shapes})
        elements |= {k for k, e in enumerate(areas.elements) if isinstance(e, SceneShape) and e.shape in parts}
        for part in [*parts, *(areas.elements[k].name for k in elements)]:
            if owners.setdefault(part, name) != name:
                raise NergError(
                    f'"{sanitize(part, 40)}" moves with the objects "{owners[part]}" and "{name}"; remove one of them'
                )
        of_shapes.append({shape: shapes[shape] for shape in parts})
        objects.append(MovingObject(name, frozenset(elements), None))
    moved = {shape for parts in of_shapes for shape in parts}
    static = {shape: value for shape, value in shapes.items() if shape not in moved}
    aois = list(placed.aois)

    def keep(parts: dict[str, Any], medium: Any = None) -> Environment:
        scene = scene_from_shapes(parts) if parts else None
        for k, element in enumerate(areas.elements):
            aoi = aois[k]
            if isinstance(aoi, ShapeAoi) and isinstance(element, SceneShape) and element.shape in parts:
                aois[k] = replace(aoi, scene=scene)
        is_empty = scene is None and medium is None
        return replace(environment, medium=None if is_empty else SceneGeometry(medium, scene))

    remaining = keep(static, environment.scene_geometry.medium) if moved else environment
    objects = [replace(item, surfaces=keep(parts)) if parts else item for item, parts in zip(objects, of_shapes)]
    return MovingAreas(replace(placed, aois=aois), remaining, tuple(objects), poses)


# ---- Checks ----


def check_objects(moving: MovingAreas, blocks: Iterable[Rays], reporter: Reporter) -> None:
    """Report the offset of the clocks if poses and recording start together, for how many samples the pose of each
    object is unknown, and poses outside of the recording. Raises `NergError` if no sample has a pose."""
    poses, count = moving.poses, 0
    unknown = dict.fromkeys(poses.names, 0)
    first, last = np.inf, -np.inf
    for rays in blocks:
        count += len(rays)
        first, last = min(first, float(rays.t.min())), max(last, float(rays.t.max()))
        for name in poses.names:
            unknown[name] += int(poses.find_motion(name, rays).is_unknown.sum())
    times = poses.times[np.isfinite(poses.times)]
    offset = first - float(times.min()) if len(times) else 0.0
    together = f"if both start together, {parameter('clock_offset')} must be larger by {offset:.6g} s"
    if all(number == count for number in unknown.values()):
        raise NergError(
            f"no sample ({count:,}, t {first:g} to {last:g} s) has a pose of an object ({poses.describe_times()}); "
            f"check the clocks and the participants: {together}"
        )
    note = f"; {together}" if offset else ""
    reporter.message(f"poses of objects are {poses.describe_times()}, samples t {first:g} to {last:g} s{note}")
    for name, number in unknown.items():
        if number:
            reporter.warn(
                f'the pose of the object "{sanitize(name, 40)}" is unknown for {number:,} of {count:,} samples, in '
                f"which it counts as absent: gaps above {poses.max_gap:g} s ({parameter('pose_gap')}), or before its "
                "first or after its last pose"
            )
    if outside := int(((times < first) | (times > last)).sum()):
        reporter.message(f"{outside:,} of {len(times):,} poses of objects are outside of the recording")


# ---- Gaze in the frame of an object ----


def to_object_frame(
    rays: Rays, poses: ObjectPoses, name: str, environment: Any = None, align: AnySimilarity | None = None
) -> Rays:
    """Return samples in the frame of an object, as if it had stayed where the environment shows it.

    Samples without a pose of the object are dropped. With an environment, so are samples that do not hit its shape
    ``name`` first, and the others have their hit points. The result serves to bake the gaze onto the object's surface.

    Parameters
    ----------
    rays
        Gaze samples.
    poses
        Poses of objects.
    name
        The object.
    environment
        The environment with the object, as for `nerg_mi.Environment.open`.
    align
        Similarity from the rays to the environment.

    Returns
    -------
    Rays
        The samples, in the frame of the rays.

    Raises
    ------
    NergError
        The object is unknown, or no sample is left.
    """
    motion = poses.find_motion(name, rays)
    rows, hits = np.flatnonzero(motion.is_present), rays.hit
    if environment is not None:
        placed = open_placed_areas(environment, None, Areas((SceneShape(name, name),)), align)
        moving, opened = place_objects(placed, poses), placed.environment
        o, d = opened.points_to_field(rays.origin), opened.directions_to_field(rays.direction)
        assigned = moving.at(rays).assign_hits(o, d)
        rows, hits = assigned.rows[0], np.full(rays.origin.shape, np.nan)
        hits[rows] = rays.origin[rows] + rays.direction[rows] * (assigned.distance[0] / placed.scale)[:, None]
    if not len(rows):
        raise NergError(
            f'no sample meets the object "{sanitize(name, 40)}"; its poses are of {poses.describe_times()}: check the '
            "clocks and the frame"
        )
    rays, motion, hits = rays.select(rows), motion.select(rows), None if hits is None else hits[rows]
    return replace(
        rays,
        origin=motion.to_rest(rays.origin),
        direction=motion.turn_to_rest(rays.direction),
        hit=None if hits is None else motion.to_rest(hits),
        head=None if rays.head is None else motion.turn_to_rest(rays.head),
    )
