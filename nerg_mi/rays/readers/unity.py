"""Recordings of headsets and eye trackers: whose columns mean what, and in which frame."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain
from nerg_mi.files.line_blocks import OnBadLine
from nerg_mi.rays.rays import Rays

from .builder import RaysBuilder
from .frames import to_rays_frame
from .parsing import poses
from .parsing.column_map import ColumnMap
from .parsing.tables import iterate_table, table_columns
from .table import Paths, person_from_filename, rays_from_table

UNITY = {"up": "y", "handedness": "left", "units": "m"}

# Names met in logs of Unity projects; upper and lower case are one.
_TIMES = ("t", "time", "timestamp", "time_s", "unity_time", "utc_timestamp", "raw_timestamp", "sender_time")
_PERSONS = (
    "person",
    "participant",
    "participant_id",
    "participantid",
    "user",
    "user_id",
    "userid",
    "subject",
    "subject_id",
    "id",
)
_STATUS = ("status", "gaze_status", "gazestatus", "tracking_state", "gaze_valid", "valid")
_VALID = ("valid", "true", "1", "1.0", "tracked", "tracking", "ok")


def unity(paths: Paths, *, tick: float = 1.0, skip_bad_lines: bool = False) -> Rays:
    """Gaze in the world, as Unity projects log it: y up, left-handed, metres.

    Columns, by name: ``gaze_origin_{x,y,z}``; ``gaze_dir_*``, ``gaze_direction_*`` or ``gaze_forward_*``; where there
    are, ``hit_*`` (or ``gaze_hit_*``, ``hit_point_*``), a time, a person, a ``status`` (rows that are not valid are
    dropped) and ``confidence``. Without a person the file is the person. ``tick``: seconds in one unit of the time.
    """
    return _unity(paths, tick, skip_bad_lines, "unity", local=False)


def unity_local(paths: Paths, *, tick: float = 1.0, skip_bad_lines: bool = False) -> Rays:
    """Gaze in the head's frame (z forward) beside the head's pose in the world, as Varjo's and OpenXR's interfaces give
    it.

    As :func:`unity`, with ``head_pos_{x,y,z}`` and ``head_rot_{x,y,z,w}`` (a quaternion); ``gaze_origin_*`` may be
    missing.
    """
    return _unity(paths, tick, skip_bad_lines, "unity_local", local=True)


def unity_head(paths: Paths, *, tick: float = 1.0, skip_bad_lines: bool = False) -> Rays:
    """Heads only: ``head_pos_{x,y,z}`` with ``head_rot_{x,y,z,w}``, in Unity's world; a ray is where the head points
    (z).

    Without a ``head_rot_w``, ``head_rot_{x,y,z}`` are Unity's Euler angles in degrees (pitch, yaw, roll).
    """
    options = {**UNITY, "tick": tick, "forward": "z", "preset": "unity_head", "skip_bad_lines": skip_bad_lines}
    parts = []
    for path in map(Path, paths):
        find = _Finder(path)
        rotation = find.vector("head_rot", "head_rotation", "hmd_rot", axes="xyzw", need=False)
        if rotation is None:
            x, y, z = find.vector("head_rot", "head_rotation", "hmd_rot")
        columns = ColumnMap(
            origin=find.vector("head_pos", "head_position", "hmd_pos"),
            xyzw=rotation,
            ypr=None if rotation else (y, x, z),
            **find.usual(),
        )
        parts.append((path, columns, find.validity()))
    return _same_tables(parts, options)


def _unity(paths: Paths, tick: float, skip_bad_lines: bool, name: str, local: bool) -> Rays:
    options = {**UNITY, "tick": tick, "forward": "z", "preset": name, "skip_bad_lines": skip_bad_lines}
    parts = []
    for path in map(Path, paths):
        find = _Finder(path)
        direction = find.vector("gaze_dir", "gaze_direction", "gaze_forward")
        eye = find.vector("gaze_origin", "gaze_position", "eye_position", need=not local)
        if local:
            where = {
                "origin": find.vector("head_pos", "head_position", "hmd_pos"),
                "eye": eye,
                "xyzw": find.vector("head_rot", "head_rotation", "hmd_rot", axes="xyzw"),
            }
        else:
            where = {"origin": eye}
        parts.append((path, ColumnMap(direction=direction, **where, **find.usual()), find.validity()))
    return _same_tables(parts, options)


def _same_tables(parts: list, options: dict) -> Rays:
    """Tables of one recording have the same columns; where one has others, say so."""
    _, columns, valid = parts[0]
    for path, other, _ in parts:
        if str(other) != str(columns):
            raise NergError(
                f"{path} has other columns ({plain(other)}) than {parts[0][0]} ({plain(columns)}); import them apart, or with one column map (--map)"
            )
    return rays_from_table([path for path, _, _ in parts], columns, valid=valid, **options)


class _Finder:
    """Columns of one table by the names that they usually have."""

    def __init__(self, path: Path) -> None:
        self.path, self.columns = path, table_columns(path)
        self.by_name = {re.sub(r"[ .]", "_", c).lower(): c for c in reversed(self.columns)}

    def vector(self, *stems: str, axes: str = "xyz", need: bool = True) -> tuple[str, ...] | None:
        for stem in stems:
            names = [f"{stem}_{axis}" for axis in axes]
            if all(n in self.by_name for n in names):
                return tuple(self.by_name[n] for n in names)
        if need:
            wanted = " or ".join(f"{s}_{{{','.join(axes)}}}" for s in stems)
            there = ", ".join(plain(c, 40) for c in self.columns[:16])
            raise NergError(f"{self.path} has no columns {wanted}; its columns are {there}; name them with --map")
        return None

    def one(self, names: tuple[str, ...]) -> str | None:
        return next((self.by_name[n] for n in names if n in self.by_name), None)

    def usual(self) -> dict:
        hit = self.vector("hit", "gaze_hit", "hit_point", "hit_pos", "hit_position", need=False)
        return {
            "hit": hit,
            "t": self.one(_TIMES),
            "person": self.one(_PERSONS),
            "confidence": self.one(("confidence",)),
        }

    def validity(self) -> dict:
        status = self.one(_STATUS)
        return {status: _VALID} if status else {}


def varjo(paths: Paths, *, skip_bad_lines: bool = False) -> Rays:
    """The log of Varjo's eye tracking example for Unity: semicolons between cells, vectors as ``(x, y, z)``.

    ``HMDPosition`` and ``HMDRotation`` (x, y, z, w) are the camera's pose in Unity's world, ``CombinedGazePosition``
    and ``CombinedGazeForward`` are in the camera's frame with z forward; ``CaptureTime`` counts nanoseconds; rows whose
    ``GazeStatus`` is not VALID are dropped. The file is the person.
    """
    names = ["HMDPosition", "HMDRotation", "CombinedGazePosition", "CombinedGazeForward", "GazeStatus"]
    builder = RaysBuilder(
        transform=to_rays_frame(**UNITY), preset="varjo", source_frame=UNITY, tick=1e-9, skip_bad_lines=skip_bad_lines
    )
    for path in map(Path, paths):
        builder.source(path)
        first = None
        for values, texts, lines in iterate_table(path, ["CaptureTime"], names, on_bad=builder.on_bad):
            bad = np.zeros(len(lines), bool)
            vectors = [
                _cells(texts[:, i], size, path, name, lines, bad, builder.on_bad)
                for i, (name, size) in enumerate(zip(names, (3, 4, 3, 3)))
            ]
            if bad.all():
                continue
            position, rotation, eye, forward = (v[~bad] for v in vectors)
            turn = poses.rotations_from_quaternions(rotation)
            # Nanoseconds since long ago are known to 0.3 us in float64: fine enough, if they are counted from the
            # first.
            first = values[~bad][0, 0] if first is None else first
            builder.add(
                (values[~bad, 0] - first) * 1e-9,
                person_from_filename(path),
                position + np.einsum("nij,nj->ni", turn, eye),
                np.einsum("nij,nj->ni", turn, forward),
                rows=lines[~bad],
                drop={"GazeStatus is not VALID": np.char.upper(texts[~bad, 4]) != "VALID"},
            )
    return builder.build()


def _cells(
    words: np.ndarray, size: int, path: Path, name: str, lines: np.ndarray, bad: np.ndarray, on_bad: OnBadLine | None
) -> np.ndarray:
    """Vectors written ``(x, y, z)`` in one cell, (n, size); NaN where the cell is empty. Lines in which it is no vector
    are marked in ``bad`` (n,) bool and told to ``on_bad``; without it they raise `NergError`."""
    out = np.full((len(words), size), np.nan)
    for i, word in enumerate(words.tolist()):
        if word and not bad[i]:
            try:
                out[i] = [float(v) for v in word.strip("()").split(",")]
            except ValueError:
                why = f", column {name!r}: {plain(word, 60)!r} is not {size} numbers; mend the cell"
                if on_bad is None:
                    raise NergError(
                        f"{path}, line {lines[i]}{why}, or leave such lines out with --skip-bad-lines"
                    ) from None
                on_bad(int(lines[i]), why)
                bad[i] = True
    return out


_JOINTS = 26  # of a hand, a 4x4 matrix each


def hololens(paths: Paths, *, skip_bad_lines: bool = False) -> Rays:
    """``*_head_hand_eye.csv`` of HoloLens 2's StreamRecorder (github: microsoft/HoloLens2ForCV), which has no header.

    A line: time in ticks of 100 ns; the head's 4x4 matrix; for each hand whether it is seen and 26 matrices; whether
    the gaze is, its origin and direction (homogeneous) and the distance to what was met, 0 for nothing. The world is
    right-handed, y up, metres. Rows in which the eyes were not seen are dropped. The person is the file's name before
    ``_head_hand_eye``; times count from the recording's first row.
    """
    hands = 2 * (1 + 16 * _JOINTS)
    header = [
        "t",
        *(f"head{i}" for i in range(16)),
        *(f"hand{i}" for i in range(hands)),
        "seen",
        *(f"{what}{i}" for what in "od" for i in range(4)),
        "distance",
    ]
    wanted = ["t", *header[17 + hands :]]
    frame = {"up": "y", "handedness": "right", "units": "m"}
    builder = RaysBuilder(
        transform=to_rays_frame(**frame),
        preset="hololens",
        source_frame=frame,
        tick=1e-7,
        skip_bad_lines=skip_bad_lines,
    )
    for path in map(Path, paths):
        builder.source(path)
        first = None
        for v, _, lines in iterate_table(path, wanted, header=header, on_bad=builder.on_bad):
            first = v[0, 0] if first is None else first
            origin, direction, distance = v[:, 2:5], v[:, 6:9], v[:, 10:]
            with np.errstate(invalid="ignore", divide="ignore"):
                unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
            builder.add(
                (v[:, 0] - first) * 1e-7,
                person_from_filename(path).removesuffix("_head_hand_eye"),
                origin,
                direction,
                rows=lines,
                hit=np.where(distance > 0, origin + distance * unit, np.nan),
                drop={"the eyes were not seen": v[:, 1] != 1},
            )
    return builder.build()


_GAP = 0.1  # seconds: between head poses farther apart than this nothing is interpolated


def pupil(
    paths: Paths,
    *,
    marker: float | None = None,
    up: str = "y",
    min_confidence: float = 0.6,
    skip_bad_lines: bool = False,
) -> Rays:
    """Exports of Pupil Core (Pupil Player's raw data and head pose tracker), one folder a recording.

    ``paths``: the folders, or the ``gaze_positions.csv`` in them; ``head_pose_tracker_poses.csv`` must lie beside it.
    Gaze is in the scene camera's frame in millimetres: origin, the mean of the eyeballs' centres; direction, the mean
    of their normals. The head poses (the camera's place and Rodrigues vector) are in the frame of the tracker's
    markers, whose unit is a marker's edge: ``marker`` is its length in metres, ``up`` the axis of that frame that
    points up. Poses are interpolated to the time of the gaze; rows more than 0.1 s from them are dropped, as are those
    below ``min_confidence``. The person is the recording's folder (``anna`` of ``anna/000/exports/000``).
    """
    from scipy.spatial.transform import Rotation, Slerp

    if marker is None or not marker > 0:
        raise NergError(
            "Pupil's head poses count in edges of the tracking markers; give the edge's length in metres (--marker 0.05)"
        )
    frame = {"up": up, "handedness": "right", "units": "m"}
    builder = RaysBuilder(
        transform=to_rays_frame(**frame),
        preset="pupil",
        source_frame=frame,
        marker=marker,
        min_confidence=min_confidence,
        skip_bad_lines=skip_bad_lines,
    )
    normals = [f"gaze_normal{eye}_{axis}" for eye in "01" for axis in "xyz"]
    centres = [f"eye_center{eye}_3d_{axis}" for eye in "01" for axis in "xyz"]
    for given in map(Path, paths):
        path = given / "gaze_positions.csv" if given.is_dir() else given
        poses_path = path.with_name("head_pose_tracker_poses.csv")
        if not poses_path.is_file():
            raise NergError(f"there is no {poses_path}; run the head pose tracker in Pupil Player and export again")
        person = next(
            (p for p in reversed(path.resolve().parent.parts) if not p.isdigit() and p != "exports"), path.stem
        )
        builder.source(poses_path, f"{person}/{poses_path.name}")
        fields = ["timestamp", *(f"{what}_{axis}" for what in ("rotation", "translation") for axis in "xyz")]
        blocks = iterate_table(poses_path, fields, on_bad=builder.on_bad)
        track = np.concatenate([block.numbers for block in blocks] or [np.empty((0, 7))])
        builder.count_lines(len(track))
        track = track[np.isfinite(track).all(axis=1)]
        track = track[np.unique(track[:, 0], return_index=True)[1]]
        if len(track) < 2:
            raise NergError(f"{poses_path} holds {len(track)} head poses; two are needed to interpolate between")
        turns = Slerp(track[:, 0], Rotation.from_rotvec(track[:, 1:4]))
        builder.source(path, f"{person}/{path.name}")
        for v, _, lines in iterate_table(
            path, ["gaze_timestamp", "confidence", *normals, *centres], on_bad=builder.on_bad
        ):
            t = np.clip(np.nan_to_num(v[:, 0]), track[0, 0], track[-1, 0])
            after = np.clip(np.searchsorted(track[:, 0], t), 1, len(track) - 1)
            near = np.abs(v[:, 0, None] - track[np.stack([after - 1, after], axis=1), 0])
            lost = (near.min(axis=1) > _GAP) | (t != v[:, 0])
            R = turns(t).as_matrix()
            place = np.stack([np.interp(t, track[:, 0], track[:, 4 + i]) for i in range(3)], axis=1)
            # An eye that was not seen has no columns filled: the other one stands alone.
            direction, eye = (_mean_of_two(v[:, a : a + 6].reshape(-1, 2, 3)) for a in (2, 8))
            builder.add(
                v[:, 0],
                person,
                marker * place + np.einsum("nij,nj->ni", R, 1e-3 * eye),
                np.einsum("nij,nj->ni", R, direction),
                rows=lines,
                confidence=v[:, 1],
                drop={
                    f"confidence below {min_confidence:g}": v[:, 1] < min_confidence,
                    "there is no head pose at that time": lost,
                },
            )
    return builder.build()


def _mean_of_two(v: np.ndarray) -> np.ndarray:
    """Mean over the eyes of (n, 2, 3), of those that are there; NaN where neither is."""
    there = np.isfinite(v).all(axis=2, keepdims=True)
    with np.errstate(invalid="ignore"):
        return np.where(there, v, 0.0).sum(axis=1) / there.sum(axis=1)
