"""Poses of objects that move: tables, motion at any time, and gaze in the frame of an object.

A table of poses (CSV or Parquet) has a row for each time and object, with the columns

- ``time``, in seconds on the clock of the samples or in the unit of its name (``time_ms``);
- ``object``: the id of a shape of the environment, or the name of an area, or of both;
- ``x``, ``y``, ``z`` (or ``position_x``, ...), in metres in the frame of the samples; empty from the time on at which
  the object is taken away;
- optionally ``qw``, ``qx``, ``qy``, ``qz`` (or ``rotation_w``, ...), in any order: a unit quaternion that turns the
  object's frame to that of the samples;
- optionally ``person``, if participants have poses of their own; an empty one stands for all others.

Tables of objects of Aria's HOT3D (object_uid, timestamp[ns], t_wo_x[m], q_wo_w, ...) are read as they are.

The environment shows each object in its pose in the row without a time or, if there is none, in its first row. What
counts is the motion from there, so that the origin of an object's frame does not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.values import FilePath, to_name, to_names, to_numbers, to_path, to_seconds
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.transforms import ROTATION_TOLERANCE, check_rigid_transforms, similarity_scale, transform_points
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.readers.columns import PERSON_NAMES, ColumnFinder, parse_time_unit
from nerg_mi.tracking.readers.tables import iterate_table

MAX_GAP = 1.0
"""Default of the longest time in seconds over which poses are interpolated or continued."""


# ---- Motion ----


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of an object at N times from the place where the environment shows it: x is at R x + b.

    Parameters
    ----------
    rotation, translation
        R (N, 3, 3) and b (N, 3); the identity where the object is absent.
    is_present
        Whether the object is there, (N,).
    is_unknown
        Whether its pose is unknown, (N,); it is not present then.
    """

    rotation: np.ndarray
    translation: np.ndarray
    is_present: np.ndarray
    is_unknown: np.ndarray

    @classmethod
    def unknown(cls, count: int) -> Motion:
        """Return a motion that is unknown at all times."""
        everywhere = np.ones(count, bool)
        return cls(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), ~everywhere, everywhere)

    def select(self, rows: Any) -> Motion:
        """Return the motion at the times with the indices or mask ``rows``."""
        return Motion(self.rotation[rows], self.translation[rows], self.is_present[rows], self.is_unknown[rows])

    def assign(self, rows: np.ndarray, part: Motion) -> None:
        """Replace the motion at the times with the mask ``rows``."""
        self.rotation[rows], self.translation[rows] = part.rotation, part.translation
        self.is_present[rows], self.is_unknown[rows] = part.is_present, part.is_unknown

    def in_frame(self, frame: Similarity) -> Motion:
        """Return the same motion in the coordinates that ``frame`` transforms to."""
        turn = frame.matrix[:3, :3] / frame.scale
        rotation = turn @ self.rotation @ turn.T
        offset = frame.matrix[:3, 3]
        return replace(
            self, rotation=rotation, translation=frame.scale * self.translation @ turn.T + offset - rotation @ offset
        )

    def move(self, points: np.ndarray) -> np.ndarray:
        """Return where points (S, 3) of the object are at each time, (N, S, 3)."""
        return points @ np.swapaxes(self.rotation, 1, 2) + self.translation[:, None]

    def to_rest(self, points: np.ndarray) -> np.ndarray:
        """Return the points of the object that are at ``points`` (N, 3), one for each time."""
        return self.turn_to_rest(points - self.translation)

    def turn_to_rest(self, directions: np.ndarray) -> np.ndarray:
        """Return ``directions`` (N, 3), one for each time, in the frame of the object at rest."""
        return np.einsum("nji,nj->ni", self.rotation, directions)


@dataclass(frozen=True, eq=False)
class _Track:
    """M poses of an object, sorted by time: ``positions`` (M, 3), NaN where it is absent, and unit quaternions x, y, z,
    w (M, 4); ``rest`` are position and quaternion in the environment."""

    times: np.ndarray
    positions: np.ndarray
    quaternions: np.ndarray
    rest: tuple[np.ndarray, np.ndarray]

    def find_motion(self, t: np.ndarray, max_gap: float) -> Motion:
        """Return the motion at the times ``t`` (N,)."""
        from scipy.spatial.transform import Rotation

        last = len(self.times) - 1
        row = np.searchsorted(self.times, t, side="right") - 1
        before, after = np.maximum(row, 0), np.minimum(row + 1, last)
        after = np.where(np.isnan(self.positions[after, 0]), before, after)  # kept until it is taken away
        span = self.times[after] - self.times[before]
        fraction = np.divide(t - self.times[before], span, out=np.zeros(len(t)), where=span > 0)[:, None]
        start, end = self.positions[before], self.positions[after]
        first = Rotation.from_quat(self.quaternions[before])
        turn = (first.inv() * Rotation.from_quat(self.quaternions[after])).as_rotvec()
        has_moved = (np.abs(end - start) > _STILL).any(axis=1) | (np.abs(turn) > _STILL).any(axis=1)
        is_absent = np.isnan(start[:, 0])
        is_unknown = (self.times[0] - t > max_gap) | (has_moved & (span > max_gap))
        is_unknown |= (t - self.times[last] > max_gap) & ~is_absent
        is_there = ~is_unknown & ~is_absent
        motion = replace(Motion.unknown(len(t)), is_present=is_there, is_unknown=is_unknown)
        rotation = first * Rotation.from_rotvec(fraction * turn) * Rotation.from_quat(self.rest[1]).inv()
        position = (1 - fraction) * start + fraction * end
        translation = position - rotation.apply(self.rest[0])
        motion.rotation[is_there], motion.translation[is_there] = rotation.as_matrix()[is_there], translation[is_there]
        return motion


_STILL = 1e-6  # metres, or radians, by which an object at rest may seem to move


# ---- Poses ----


@dataclass(frozen=True, eq=False, repr=False)
class ObjectPoses:
    """Poses of objects that move, in the frame of the samples. Raises `NergError` for invalid ones.

    Attributes
    ----------
    names : tuple of str
        Names of the objects.
    objects : ndarray of shape (M,)
        The object of each row, an index into ``names``.
    times : ndarray of shape (M,)
        Times in seconds; NaN: the pose in which the environment shows the object.
    positions : ndarray of shape (M, 3)
        Positions in metres; NaN: the object is absent.
    quaternions : ndarray of shape (M, 4)
        Unit quaternions x, y, z, w.
    participants : tuple of str
        The participant of each row; "": all participants without poses of the object. Empty: all rows are so.
    max_gap : float
        Longest time in seconds over which poses are interpolated, or continued before the first and after the last
        row. In longer gaps the pose is unknown, unless the object has not moved or is absent afterwards.

    Examples
    --------
    >>> from nerg_mi.tracking.objects import ObjectPoses
    >>> poses = ObjectPoses.from_arrays(["box"] * 3, [0, 1, 2], [[1, 0, 0], [1, 2, 0], [float("nan")] * 3])
    >>> poses
    <ObjectPoses: box, t 0 to 2 s>
    """

    names: tuple[str, ...]
    objects: np.ndarray
    times: np.ndarray
    positions: np.ndarray
    quaternions: np.ndarray
    participants: tuple[str, ...] = ()
    max_gap: float = field(default=MAX_GAP, kw_only=True)

    def __post_init__(self) -> None:
        if not 0 <= self.max_gap:
            raise NergError(f"max_gap must be seconds from 0, got {self.max_gap}")
        is_missing = np.isnan(self.positions)
        is_present = ~is_missing.any(axis=1)
        if (is_partial := is_missing.any(axis=1) & ~is_missing.all(axis=1)).any():
            row = int(np.flatnonzero(is_partial)[0]) + 1
            raise NergError(f"a part of the position of pose {row} is missing; give all three numbers, or none")
        check_coordinates(self.positions[is_present], "the positions of objects")
        lengths = np.linalg.norm(self.quaternions[is_present], axis=1)
        if not (np.abs(lengths - 1) <= ROTATION_TOLERANCE).all():
            row = np.flatnonzero(is_present)[~(np.abs(lengths - 1) <= ROTATION_TOLERANCE)][0]
            raise NergError(
                f"the quaternion of pose {row + 1}, {self.quaternions[row].tolist()}, does not have the length 1; "
                "check its columns"
            )
        for k, name in enumerate(self.names):
            if not (is_present & (self.objects == k)).any():
                raise NergError(f'the object "{sanitize(name, 40)}" has no pose; give it one, or remove its rows')

    @classmethod
    def open(cls, poses: FilePath | ObjectPoses) -> ObjectPoses:
        """Return poses as they are, and others as `load` does."""
        return poses if isinstance(poses, ObjectPoses) else cls.load(poses)

    @classmethod
    def from_arrays(
        cls,
        objects: Sequence[str],
        times: ArrayLike,
        positions: ArrayLike,
        quaternions: ArrayLike | None = None,
        participants: Sequence[str] = (),
        *,
        max_gap: float = MAX_GAP,
    ) -> ObjectPoses:
        """Make poses of M rows: the name of the object, the time in seconds (NaN: the pose in which the environment
        shows it), positions (M, 3), quaternions x, y, z, w (M, 4), and the participants. Raises `NergError` for
        invalid ones."""
        positions = to_numbers(positions, "the positions of objects").reshape(-1, 3)
        turns = np.tile((0.0, 0.0, 0.0, 1.0), (len(positions), 1))
        turns = turns if quaternions is None else to_numbers(quaternions, "the quaternions of objects").reshape(-1, 4)
        seconds = to_seconds(times, "the times of poses")
        lengths = {len(objects), len(seconds), len(positions), len(turns), len(participants) or len(positions)}
        if len(lengths) > 1 or not len(positions):
            raise NergError(f"poses need the same number of objects, times, positions and quaternions, got {lengths}")
        names, codes = np.unique(to_names(objects, "the names of objects"), return_inverse=True)
        people = tuple(to_names(participants, "the participants of poses").tolist()) if len(participants) else ()
        return cls(tuple(names.tolist()), codes, seconds, positions, turns, people, max_gap=max_gap)

    @classmethod
    def load(cls, path: FilePath, *, max_gap: float = MAX_GAP) -> ObjectPoses:
        """Read a table of poses as described above. Raises `NergError` for missing columns and invalid rows."""
        path = to_path(path)
        table = ColumnFinder(path)
        time, position = (
            table.require_time("time", "t", "timestamp"),
            table.require_vector("", "position", "pos", "t_wo"),
        )
        turn = table.find_vector("q", "quaternion", "rotation", "rot", "orientation", "q_wo", axes="xyzw") or ()
        name, person = table.find("object", "object_name", "name", "object_uid"), table.find(*PERSON_NAMES)
        if name is None:
            raise NergError(f'"{path}" has no column object; name the object of each row in it')

        def refuse(line: int, reason: str) -> None:
            raise NergError(f"{path}, line {line}{reason}")

        columns = (time, *position, *turn)
        blocks = list(iterate_table(path, columns, (name, *([person] if person else [])), on_bad_line=refuse))
        if not blocks:
            raise NergError(f'"{path}" contains no poses; write a row for each time and object')
        numbers, texts = (np.concatenate(v) for v in zip(*((b.numbers, b.texts) for b in blocks)))
        numbers[:, 0] *= parse_time_unit(time) or 1.0
        try:
            return cls.from_arrays(
                texts[:, 0].tolist(),
                numbers[:, 0],
                numbers[:, 1:4],
                numbers[:, 4:] if turn else None,
                texts[:, 1].tolist() if person else (),
                max_gap=max_gap,
            )
        except NergError as error:
            raise NergError(f'"{path}": {error}') from error

    def shift(self, seconds: float) -> ObjectPoses:
        """Return poses whose times are later by ``seconds``: the difference of the clocks."""
        return replace(self, times=self.times + seconds)

    def transform(self, matrix: ArrayLike) -> ObjectPoses:
        """Return poses in another frame, to which the 4x4 ``matrix`` transforms, such as ``rays.metadata["transform"]``
        from the frame of a recording's files. It may scale and mirror. Raises `NergError` for others."""
        from scipy.spatial.transform import Rotation

        m = check_rigid_transforms(matrix, "the transform", may_scale=True, may_mirror=True, shape=(4, 4))
        linear = m[:3, :3] / similarity_scale(m)
        turns = np.where(np.isfinite(self.quaternions).all(axis=1, keepdims=True), self.quaternions, (0, 0, 0, 1))
        turned = linear @ Rotation.from_quat(turns).as_matrix() @ linear.T
        quaternions = Rotation.from_matrix(turned).as_quat()
        return replace(self, positions=transform_points(m, self.positions), quaternions=quaternions)

    @cached_property
    def _tracks(self) -> dict[tuple[str, str], _Track]:
        """The poses by participant ("": all) and object."""
        people = np.array(self.participants or [""] * len(self.times))
        turns = np.where(np.isfinite(self.positions[:, :1]), self.quaternions, (0.0, 0.0, 0.0, 1.0))
        tracks = {}
        for k, name in enumerate(self.names):
            is_object = self.objects == k
            poses = np.flatnonzero(is_object & np.isfinite(self.positions[:, 0]))
            rests = poses[np.isnan(self.times[poses])]
            rest = (rests if len(rests) else poses)[0]
            for person in np.unique(people[is_object]).tolist():
                rows = np.flatnonzero(is_object & (people == person) & np.isfinite(self.times))
                rows = rows[np.argsort(self.times[rows], kind="stable")]
                if len(rows):
                    place = self.positions[rest], turns[rest]
                    tracks[person, name] = _Track(self.times[rows], self.positions[rows], turns[rows], place)
        return tracks

    def find_motion(self, name: str, rays: Rays) -> Motion:
        """Return the motion of the object ``name`` at the times of the samples, in their frame. Raises `NergError` for
        an unknown object."""
        if name not in self.names:
            raise NergError(
                f'there is no object "{sanitize(name, 40)}" in the poses; they are of {", ".join(self.names[:20])}'
            )
        motion = Motion.unknown(len(rays))
        for code in np.unique(rays.person).tolist():
            track = self._tracks.get((to_name(rays.persons[code]), name)) or self._tracks.get(("", name))
            if track is not None:
                rows = rays.person == code
                motion.assign(rows, track.find_motion(rays.t[rows], self.max_gap))
        return motion

    def find_motion_at(self, name: str, time: float, person: str = "") -> Motion:
        """Return the motion of the object ``name`` at one time, for a participant."""
        track = self._tracks.get((person, name)) or self._tracks.get(("", name))
        return Motion.unknown(1) if track is None else track.find_motion(np.array([float(time)]), self.max_gap)

    def describe_times(self) -> str:
        """Return the first and the last time."""
        times = self.times[np.isfinite(self.times)]
        return f"t {times.min():g} to {times.max():g} s" if len(times) else "no times"

    def __repr__(self) -> str:
        names = ", ".join((*self.names[:5], *(["..."] if len(self.names) > 5 else [])))
        return f"<ObjectPoses: {names}, {self.describe_times()}>"
