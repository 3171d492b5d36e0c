"""Observers of a written scene: at a given position, at that of a participant, on a walk, or where most rays are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.gaze_base import RaySupport
from nerg_mi.files.values import find_names
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.transforms import transform_points
from nerg_mi.progress import Reporter
from nerg_mi.tracking.rays import Rays

from .arrays import check_point
from .gaze import GazeField
from .scene_writer import LookAt

MAX_GAP = 0.5
"""Longest gap between rays of a participant in seconds that is no pause, or two intervals of slower recordings."""

RADIUS = 0.5
"""Radius in metres within which ray origins count as one position."""

MAX_FRAMES = 100_000
"""Maximum number of frames of a walk."""


@dataclass(frozen=True)
class ObserverPath:
    """Positions of a person at equidistant times: ``eyes`` at ``times`` (F,) in seconds.

    ``missing`` is the number of frames without data.
    """

    times: np.ndarray
    eyes: list[LookAt]
    missing: int


@dataclass(frozen=True, eq=False)
class PlacedObserver:
    """An observer: ``eye``, the ``walk`` that it is the middle of, and a sentence on them; None and "" without one."""

    eye: LookAt | None = None
    walk: ObserverPath | None = None
    note: str = ""


@dataclass(frozen=True)
class ObserverChoice:
    """Where the observer of a written scene is, as in `nerg_mi.environment.scene_file.write_scene`."""

    point: Sequence[float] | None
    person: str | None = None
    time: float | None = None
    time_range: Sequence[float] | None = None
    fps: float = 10.0

    def __post_init__(self) -> None:
        check_point(self.point, parameter("observer"))
        moment = self.time is not None or self.time_range is not None
        if moment != (self.person is not None) or (self.time is not None and self.time_range is not None):
            raise NergError(
                f"{parameter('person')} needs one of {parameter('time')} and {parameter('time_range')}, and these need "
                f"{parameter('person')}; give both, or neither"
            )
        if self.person is not None and self.point is not None:
            raise NergError(
                f"{parameter('observer')} and {parameter('person')} both place the observer; leave out one of them"
            )
        if self.time_range is not None and len(self.time_range) != 2:
            raise NergError(f"{parameter('time_range')} must be two times A,B, got {len(self.time_range)}")

    def place(
        self, rays: Rays | None, gaze: GazeField | None, align: Similarity, has_geometry: bool, reporter: Reporter
    ) -> PlacedObserver:
        """Return the observer in the scene.

        Parameters
        ----------
        rays
            Rays of all participants or of the person, or None.
        gaze
            Gaze field of the scene, or None.
        align
            Transform from the rays to the scene.
        has_geometry
            Whether the scene shows surfaces, so that it needs no observer.
        reporter
            Receives messages.
        """
        point = check_point(self.point, parameter("observer"))
        if point is not None:
            eye = LookAt(point, point + np.array([1.0, 0, 0]))
            return PlacedObserver(eye, note="The observer's eye as given, turned to the main direction of gaze.")
        if self.person is not None:
            if rays is None:
                raise NergError(f"{parameter('person')} needs rays; name their file")
            return self._follow(rays, self.person, align)
        if rays is not None:
            at = to_scene_frame(support_of_rays(rays).find_densest_position(), align)
            note = "The observer where the density of rays is highest, turned to the main direction of gaze."
            return PlacedObserver(LookAt(at, at + align.matrix[:3, 0]), note=note)
        support = None if gaze is None else gaze.network.support
        if support is not None:
            at = support.find_densest_position()
            note = "The observer where the support of the gaze field is highest, turned to the main direction of gaze."
            return PlacedObserver(LookAt(at, at + np.array([1.0, 0, 0])), note=note)
        if gaze is not None and not has_geometry:
            raise NergError(
                f"{gaze.label} stores neither geometry nor recorded positions; place the observer with "
                f"{parameter('observer')}"
            )
        if gaze is not None:
            reporter.message(
                f"no recorded positions are known: the camera is the observer; use {parameter('observer', 'x,y,z')} to "
                "place one"
            )
        return PlacedObserver()

    def _follow(self, rays: Rays, person: str, align: Similarity) -> PlacedObserver:
        """Return the eye of a ``person`` at a time, or its walk."""
        if self.time_range is None:
            assert self.time is not None
            eye, when = find_eye(rays, person, self.time, align)
            return PlacedObserver(eye, note=f"The eye of {person} at {when:.6g} s, and a point ahead of it.")
        first, last = self.time_range
        walk = interpolate_walk(rays, person, first, last, self.fps, align)
        middle = len(walk.eyes) // 2
        note = f"The eye of {person} at {walk.times[middle]:.6g} s, the middle of the walk."
        return PlacedObserver(walk.eyes[middle], walk, note)


def find_eye(rays: Rays, person: str, time: float, align: Similarity) -> tuple[LookAt, float]:
    """Return the eye of ``person`` in the scene at the ray nearest to ``time`` (seconds), and the time of that ray.

    ``align`` transforms from the rays to the scene. Raises `NergError` for an unknown person, and for a time in a
    pause of the rays.
    """
    rows = _find_person_rows(rays, person)
    nearest = rows[np.argmin(np.abs(rays.t[rows] - time))]
    if abs(rays.t[nearest] - time) > (gap := _find_max_gap(rays.t[rows])):
        raise NergError(_describe_missing(rays, rows, person, f"at {time:g} s", gap))
    (eye,) = _make_eyes(rays.origin[nearest : nearest + 1], rays.direction[nearest : nearest + 1], align)
    return eye, float(rays.t[nearest])


def interpolate_walk(rays: Rays, person: str, first: float, last: float, fps: float, align: Similarity) -> ObserverPath:
    """Interpolate the eye of ``person`` from ``first`` to ``last`` (seconds) at ``fps`` frames per second.

    Positions are interpolated linearly between two rays, directions by their weighted mean. There is no frame between
    rays with a pause in between, nor in one before the first or after the last ray. Raises `NergError`
    if there is no frame.
    """
    if not first < last:
        raise NergError(f"{parameter('time_range')} must be two times, the earlier first, got {first:g},{last:g}")
    if (last - first) * fps > MAX_FRAMES:
        raise NergError(
            f"a walk can have at most {MAX_FRAMES:,} frames, and {last - first:g} s at {fps:g} frames per second "
            f"have more; reduce {parameter('fps')}, or the time range"
        )
    rows = _find_person_rows(rays, person)
    rows = rows[np.argsort(rays.t[rows], kind="stable")]
    times = first + np.arange(int(np.floor((last - first) * fps + 1e-9)) + 1) / fps
    t, gap = rays.t[rows], _find_max_gap(rays.t[rows])
    after = np.searchsorted(t, times)
    before, after = np.maximum(after - 1, 0), np.minimum(after, len(rows) - 1)
    between = t[after] - t[before]
    outside = np.maximum(t[before] - times, times - t[after])
    # A time of a ray needs no interpolation.
    valid = ((between <= gap) & (outside <= gap)) | (t[after] == times)
    if not valid.any():
        raise NergError(_describe_missing(rays, rows, person, f"from {first:g} to {last:g} s", gap))
    share = np.clip(np.divide(times - t[before], between, out=np.zeros(len(times)), where=between > 0), 0, 1)[:, None]
    mix = lambda values: values[rows[before]] * (1 - share) + values[rows[after]] * share
    origin, direction = mix(rays.origin)[valid], mix(rays.direction)[valid]
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    # Opposite directions have no mean: use that of the nearer ray.
    nearer = np.where(share < 0.5, rays.direction[rows[before]], rays.direction[rows[after]])[valid]
    direction = np.where(length > 1e-3, direction / np.maximum(length, 1e-3), nearer)
    return ObserverPath(times[valid], _make_eyes(origin, direction, align), int(np.sum(~valid)))


def support_of_rays(rays: Rays) -> RaySupport:
    """Return the support of rays at each position, in metres of their frame."""
    return RaySupport.from_origins(rays.origin, RADIUS)


def to_scene_frame(points: np.ndarray, align: Similarity) -> np.ndarray:
    """Transform points (..., 3) from the frame of the rays to that of the scene."""
    return transform_points(align.matrix, np.asarray(points, float))


def _find_person_rows(rays: Rays, person: str) -> np.ndarray:
    """Return the indices of the rays of ``person``."""
    rows = np.flatnonzero(rays.person == find_names([person], rays.persons, "person")[0])
    if not len(rows):
        raise NergError(f'"{person}" has no rays; choose another person')
    return rows


def _find_max_gap(times: np.ndarray) -> float:
    """Return the longest gap between rays at ``times`` (N,) in seconds that is no pause."""
    return max(MAX_GAP, 2 * float(np.median(np.diff(np.sort(times)))) if len(times) > 1 else 0.0)


def _describe_missing(rays: Rays, rows: np.ndarray, person: str, when: str, gap: float) -> str:
    first, last = float(rays.t[rows].min()), float(rays.t[rows].max())
    return (
        f'there is no ray of "{person}" within {gap:g} s {when}; its rays are from {first:.10g} to {last:.10g} s, '
        "and their pauses are not bridged"
    )


def _make_eyes(origins: np.ndarray, directions: np.ndarray, align: Similarity) -> list[LookAt]:
    """Return eyes in scene coordinates with targets one metre ahead."""
    at, ahead = to_scene_frame(origins, align), to_scene_frame(origins + directions, align)
    return [LookAt(origin, target) for origin, target in zip(at, ahead)]
