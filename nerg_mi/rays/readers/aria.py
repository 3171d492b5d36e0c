"""Project Aria: gaze from its exports, and trajectories of the closed loop."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import BadLineCallback, resolve_path

from . import poses
from .base import RECORDINGS, RaysBuilder, Signature, TrackingFrame, option
from .poses import PoseTrack
from .tables import TableBlock, iterate_table, read_table_columns

# ---- Gaze files of Project Aria: three schemas told apart by their headers, and directions of their angles ----
#
# Angles are in the central pupil frame (CPF), whose origin lies midway between the eyes: x left, y up, z forward,
# metres. Where that frame is on the glasses is known from their construction alone. After projectaria_tools
# (``core/mps/EyeGazeReader``, ``core/calibration/DeviceCadExtrinsics``).

TIME = "tracking_timestamp_us"

_EYES = tuple(f"t{axis}_{side}_eye_cpf" for side in ("left", "right") for axis in "xyz")
_FARTHEST = 4.0  # metres: vergence is clipped there, and says nothing of what is farther


@dataclass(frozen=True)
class GazeSchema:
    """The columns of one kind of gaze file."""

    name: str  # "legacy", "vergence" or "gen2"
    generation: int  # of the glasses: 1 or 2
    columns: tuple[str, ...]  # needed, the time first


LEGACY = GazeSchema("legacy", 1, (TIME, "yaw_rads_cpf", "pitch_rads_cpf", "depth_m"))
VERGENCE = GazeSchema("vergence", 1, (TIME, "left_yaw_rads_cpf", "right_yaw_rads_cpf", "pitch_rads_cpf", "depth_m"))
GEN2 = GazeSchema("gen2", 2, (TIME, "yaw_rads_cpf", "pitch_rads_cpf", *_EYES))


def schema_of(path: Path) -> GazeSchema:
    """The schema of the gaze file ``path`` by its header: a combined yaw beside a pitch of each eye is the second
    generation's. Raises `NergError` for another header."""
    columns = set(read_table_columns(path))
    if {"yaw_rads_cpf", "left_pitch_rads_cpf", "right_pitch_rads_cpf"} <= columns:
        return GEN2
    if {"left_yaw_rads_cpf", "right_yaw_rads_cpf"} <= columns:
        return VERGENCE
    if "yaw_rads_cpf" in columns:
        return LEGACY
    there = ", ".join(sanitize(c, 40) for c in sorted(columns)[:8]) or "none"
    raise NergError(
        f"{path} has no columns of gaze angles (yaw_rads_cpf, or left_yaw_rads_cpf and right_yaw_rads_cpf); its "
        f"columns are {there}; give the folder of an Aria recording, or the gaze file in it"
    )


def gaze_in_cpf(schema: GazeSchema, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Eyes and directions (n, 3) in CPF and distances (n,) in metres, NaN where unknown, of the values ``v`` (n, C) of
    ``schema.columns``. Directions are NaN where an angle is 90 degrees or more.

    The first generation's angles are of tangents: (tan yaw, tan pitch, 1); the two eyes' share one pitch, and the line
    to where theirs meet has the mean of their tan yaw. The second's are polar: (sin yaw cos pitch, sin pitch,
    cos yaw cos pitch), from midway between the eyes that the file tells. ``depth_m`` is a distance from the eyes; 0 and
    empty are unknown. Of two eyes it is their lines' crossing, so that it is unknown as well where these part in front
    (the file then has the distance of their crossing behind the head) and where it was clipped.
    """
    eye = np.zeros((len(v), 3))
    if schema is GEN2:
        yaw, pitch, distance = v[:, 1], v[:, 2], np.full(len(v), np.nan)
        eye = v[:, 3:9].reshape(-1, 2, 3).mean(axis=1)
        direction = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], axis=1)
        widest = np.abs(v[:, 1:3]).max(axis=1)
        direction[~(widest < np.pi / 2)] = np.nan
        return eye, direction, distance
    angles, distance = v[:, 1:-1], np.where(v[:, -1] > 0, v[:, -1], np.nan)
    tangents = np.where(np.abs(angles) < np.pi / 2, np.tan(angles), np.nan)
    across = tangents[:, 0]
    if schema is VERGENCE:
        across = 0.5 * (tangents[:, 0] + tangents[:, 1])
        # x is to the left: lines that meet in front have the right eye's turned farther to the left.
        meet = tangents[:, 1] > tangents[:, 0]
        distance = np.where(meet & (distance < _FARTHEST), distance, np.nan)
    direction = np.stack([across, tangents[:, -1], np.ones(len(v))], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return eye, direction, distance


_SIDE = (0.793353, 0.0, -0.608761), (0.607927, -0.052336, 0.792266)
_FRONT = (-0.138127, -0.912873, -0.384166), (0.308866, -0.40824, 0.859034)
# Of each model: its generation, and the device's frame (the left SLAM camera's) in CPF: origin in metres, y, z.
_MODELS = {
    "DVT-S": (1, (0.069051, 0.002372, 0.009254), *_SIDE),
    "DVT-L": (1, (0.071351, 0.002372, 0.008454), *_SIDE),
    "DVT-LL": (2, (0.07107883, 0.005719893, 0.01155452), *_FRONT),
    "DVT-LS": (2, (0.07107883, 0.005719893, 0.01155452), *_FRONT),
    "DVT-SL": (2, (0.067294194, 0.006033819, 0.011768852), _FRONT[0], (0.308866, -0.408244, 0.859034)),
    "DVT-SS": (2, (0.067294194, 0.006033819, 0.011768852), _FRONT[0], (0.308866, -0.408244, 0.859034)),
}


def device_named(given: str | None, generation: int) -> str:
    """The model that is called ``given`` (upper and lower case, - and _ are one), or the usual one of a
    ``generation``. Raises `NergError` for an unknown one, and for one of another generation."""
    if given is None:
        return "DVT-L" if generation == 1 else "DVT-LL"
    name = given.upper().replace("_", "-")
    known = [model for model, about in _MODELS.items() if about[0] == generation]
    if name not in known:
        what = "is of the other generation than the gaze file" if name in _MODELS else "is no model of Aria glasses"
        raise NergError(f'--device "{sanitize(given, 40)}" {what}; choose one of {", ".join(known)}, or leave it out')
    return name


def cpf_in_device(device: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and origin (3,), metres, of CPF in the frame of a device: p_device = R p_cpf + t."""
    _, origin, y, z = _MODELS[device]
    y, z = (np.array(a) / np.linalg.norm(a) for a in (y, z))
    x = np.cross(y, z)
    x /= np.linalg.norm(x)
    device_in_cpf = np.stack([x, np.cross(z, x), z], axis=1)
    return device_in_cpf.T, -device_in_cpf.T @ np.array(origin)


# ---- Trajectories of Project Aria: poses of the glasses, world by world, and which way is up in them ----

_PLACE = [f"t{axis}_world_device" for axis in "xyz"]
_TURN = [f"q{axis}_world_device" for axis in "xyzw"]
_GRAVITY = [f"gravity_{axis}_world" for axis in "xyz"]
_WORLDS = 1000  # a file of more is no trajectory
_EDGE = 1e-3  # seconds: so much before the first pose and after the last, a head is where it is then
_STRAIGHT = np.cos(np.radians(1.0))


def up_axis(path: Path) -> str:
    """The axis that points up in the trajectory ``path``, by the gravity of its first pose: x, y, z, -x, -y or -z.

    Raises `NergError` for a file without poses, or a gravity along no axis.
    """
    # Bad lines are told when the poses are read.
    for block in iterate_table(path, _GRAVITY, on_bad=lambda line, why: None):
        known = block.numbers[np.isfinite(block.numbers).all(axis=1)]
        if len(known):
            return _against(path, known[0])
    raise NergError(f"the trajectory {path} holds no poses with their gravity; have it made again by MPS")


def _against(path: Path, gravity: np.ndarray) -> str:
    """The name of the axis against ``gravity`` (3,)."""
    length = np.linalg.norm(gravity)
    shares = -gravity / length if length > 0 else np.zeros(3)
    k = int(np.abs(shares).argmax())
    if not abs(shares[k]) > _STRAIGHT:
        said = " ".join(f"{x:.3g}" for x in gravity)
        raise NergError(
            f"the gravity of the trajectory {path} ({said}) lies along no axis of its world, so that nobody knows "
            "which way is up; turn its poses and its gravity so that one axis points up"
        )
    return ("-" if shares[k] < 0 else "") + "xyz"[k]


@dataclass
class _World:
    """Poses of one world, as far as they are kept."""

    gravity: np.ndarray  # (3,) of its first pose
    poses: list[np.ndarray] = field(default_factory=list)  # (n, 8): seconds, place, quaternion x, y, z, w


class Trajectory:
    """Poses of the glasses in a recording, of which those around the times that are asked for are kept."""

    def __init__(self, path: Path, times: np.ndarray, on_bad: BadLineCallback | None) -> None:
        """Read ``path`` for gaze at ``times`` (n,) seconds. Raises `NergError` for a file that is no trajectory."""
        self.path, self.lines = path, 0
        self._times = np.sort(times[np.isfinite(times)])
        self._worlds: dict[str, _World] = {}
        for block in iterate_table(path, [TIME, *_PLACE, *_TURN, *_GRAVITY], ["graph_uid"], on_bad=on_bad):
            self._keep(block)
            self.lines += len(block.lines)
        self.tracks = {uid: track for uid, w in self._worlds.items() if (track := _track(w)) is not None}
        if not self.tracks:
            raise NergError(f"{path} holds {self.lines} poses; two of one world are needed to interpolate between")

    def up(self, world: str) -> str:
        """The axis that points up in ``world``, one of `tracks`."""
        return _against(self.path, self._worlds[world].gravity)

    def _keep(self, block: TableBlock) -> None:
        names, which = np.unique(block.texts[:, 0], return_inverse=True)
        for k, name in enumerate(names.tolist()):
            v = block.numbers[which == k]
            v = v[np.isfinite(v).all(axis=1)]
            if not len(v):
                continue
            world = self._worlds.setdefault(name, _World(v[0, 8:]))
            if len(self._worlds) > _WORLDS:
                raise NergError(
                    f"the trajectory {self.path} has more than {_WORLDS:,} worlds (graph_uid); have it made again "
                    "by MPS"
                )
            off = np.abs(v[:, 8:] - world.gravity).max()
            if off > 0.02 * np.linalg.norm(world.gravity):
                raise NergError(
                    f"the gravity of the world {sanitize(name, 40)} changes in the trajectory {self.path}, so that nobody "
                    "knows which way is up; have it made again by MPS"
                )
            v = v[np.argsort(v[:, 0], kind="stable")]
            v[:, 0] *= 1e-6
            # Of a thousand poses a second those around each gaze are needed, and a block's ends for gaze between two.
            near = np.searchsorted(v[:, 0], self._times[slice(*np.searchsorted(self._times, v[[0, -1], 0]))])
            kept = np.unique(np.clip(np.r_[0, near - 1, near, len(v) - 1], 0, len(v) - 1))
            world.poses.append(v[kept, :8])


def _track(world: _World) -> PoseTrack | None:
    from scipy.spatial.transform import Rotation

    v = np.concatenate(world.poses)
    length = np.linalg.norm(v[:, 4:], axis=1)
    v = v[np.isfinite(length) & (length > 1e-12)]
    if not len(v):
        return None
    return PoseTrack.of_samples(v[:, 0], Rotation.from_quat(v[:, 4:]).as_rotvec(), v[:, 1:4])


def poses_at(track: PoseTrack, t: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `PoseTrack.at`, with times up to a millisecond outside taken as the track's ends: ground truth has its gaze
    some microseconds before its poses."""
    ends = track.times[[0, -1]]
    near = np.clip(t, *ends)
    return track.at(np.where(np.abs(t - near) <= _EDGE, near, t), gap)


# ---- Recordings of Project Aria's glasses, as Machine Perception Services (MPS) and Aria Digital Twin give them ----

_GAP = 0.05  # seconds: gaze farther than this from a pose is left out
_SUFFIXES = (".csv", ".csv.gz")
# Names of MPS, the older ones and those of ADT after the present ones; personalized gaze before general.
_PERSONALIZED = ("personalized_eye_gaze", "calibrated_eye_gaze")
_GENERAL = ("general_eye_gaze", "generalized_eye_gaze", "generalized_gaze", "eyegaze")
_TRAJECTORIES = ("closed_loop_trajectory", "aria_trajectory")
_GAZE_FOLDERS = ("eye_gaze", "eye_gaze_vergence", ".")
_POSE_FOLDERS = (".", "slam", "trajectory", "../slam", "../trajectory", "..")
_OTHER_WORLD = "the pose is in another world (graph_uid)"
_WORLDS_NAMED = 20


@dataclass(frozen=True, kw_only=True)
class AriaOptions:
    """What the recordings do not say."""

    device: str | None = option(
        None,
        "Model of the glasses: DVT-S or DVT-L; of the second generation DVT-LL, DVT-LS, DVT-SL or DVT-SS.",
        shown="DVT-L, or DVT-LL where the gaze is of the second generation",
        recorded=False,
    )
    world: str | None = option(
        None, "The graph_uid of the world that is taken.", shown="that of the most gaze", recorded=False
    )


@dataclass
class _Recording:
    """A gaze file with the poses that belong to it."""

    gaze: Path
    schema: GazeSchema
    device: str
    person: str
    trajectory: Trajectory
    rows: Counter[str]  # of gaze that have a pose, by world


class Aria:
    """Folders of recordings, or their gaze files, with the closed loop trajectory beside them.

    Gaze angles are in the central pupil frame of the glasses; how they become directions is told at
    :func:`nerg_mi.rays.readers.aria.gaze_in_cpf`. The trajectory tells where the glasses were, a thousand
    times a second (ground truth of Aria Digital Twin: thirty); poses are interpolated to the time of the gaze, and rows
    more than 0.05 s from one are dropped. Up is against the gravity of the trajectory. A world (``graph_uid``) is a
    frame of its own: rows in another one than ``world`` are dropped. Where there is both, personalized gaze is read,
    and not the general. Where a depth is known, it makes the hit point. Times are of the device's clock, in seconds.
    The person is the recording's folder (``anna`` of ``anna/eye_gaze`` or ``mps_anna_vrs/eye_gaze``).
    """

    name = "aria"
    files = (
        "folders of Project Aria recordings as MPS or Aria Digital Twin give them, of both generations (or the gaze "
        "files in them), with `closed_loop_trajectory.csv` or `aria_trajectory.csv`"
    )
    world = "right-handed, m, up by the trajectory's gravity"
    checked_on = f"{RECORDINGS}; of the second generation gaze alone"
    signature = Signature(columns=(("tracking_timestamp_us", "pitch_rads_cpf"),))
    Options = AriaOptions

    def frame(self, files: Sequence[Path], options: AriaOptions) -> TrackingFrame:
        if not files:
            return TrackingFrame()
        return TrackingFrame(up=up_axis(_find_trajectory(_find_gaze(files[0]))))

    def read(self, files: Sequence[Path], options: AriaOptions, builder: RaysBuilder) -> None:
        recordings = [_open(_find_gaze(given), options, builder) for given in files]
        world, up = _choose_world(recordings, options.world), up_axis(recordings[0].trajectory.path)
        # A recording that has the gravity of another world along another axis would be turned by the wrong frame.
        for recording in recordings:
            if world in recording.trajectory.tracks and recording.trajectory.up(world) != up:
                raise NergError(
                    f"{recording.trajectory.path} has {recording.trajectory.up(world)} up in the world {sanitize(world)}, "
                    f"and {recordings[0].trajectory.path} begins with {up} up; import recordings with one up axis "
                    "together, the others apart"
                )
        others = sum((r.rows for r in recordings), Counter())
        builder.note(
            floor="unknown",  # a world begins where the glasses were
            world=world,
            other_worlds={w: n for w, n in others.most_common(_WORLDS_NAMED + 1) if w != world},
            gaze=[
                {"file": f"{r.person}/{r.gaze.name}", "schema": r.schema.name, "device": r.device} for r in recordings
            ],
        )
        for recording in recordings:
            _add(recording, world, builder)


READERS = (Aria(),)


def _open(gaze: Path, options: AriaOptions, builder: RaysBuilder) -> _Recording:
    """The poses for the gaze file ``gaze``, which is not read yet but for its times."""
    schema, person = schema_of(gaze), _person(gaze)
    device = device_named(options.device, schema.generation)
    # Lines that cannot be read are told when all of the file is read.
    tolerant = None if builder.on_bad is None else lambda line, why: None
    blocks = [block.numbers[:, 0] * 1e-6 for block in iterate_table(gaze, [TIME], on_bad=tolerant)]
    times = np.concatenate(blocks or [np.empty(0)])
    path = _find_trajectory(gaze)
    builder.source(path, f"{person}/{path.name}")
    trajectory = Trajectory(path, times, builder.on_bad)
    builder.count_lines(trajectory.lines)
    rows = Counter({w: int((~poses_at(track, times, _GAP)[2]).sum()) for w, track in trajectory.tracks.items()})
    return _Recording(gaze, schema, device, person, trajectory, rows)


def _choose_world(recordings: Sequence[_Recording], wanted: str | None) -> str:
    """The world that is wanted, or that of the most gaze; `NergError` where a recording has none of it."""
    rows = sum((r.rows for r in recordings), Counter())
    named = ", ".join(sanitize(w, 40) for w, _ in rows.most_common(4))
    if wanted is not None:
        if wanted not in rows and not any(wanted in r.trajectory.tracks for r in recordings):
            raise NergError(f'there is no world "{sanitize(wanted, 40)}" (--world) in these recordings; there are {named}')
        return wanted
    world = min((w for r in recordings for w in r.trajectory.tracks), key=lambda w: (-rows[w], w))
    for recording in recordings:
        if world not in recording.trajectory.tracks:
            raise NergError(
                f"{recording.gaze} was recorded in another world (graph_uid) than {sanitize(world, 40)}, each a frame of "
                f"its own ({named}); import them apart, have MPS make one world of them (Multi-SLAM), or choose one "
                "with --world"
            )
    return world


def _add(recording: _Recording, world: str, builder: RaysBuilder) -> None:
    """Add the gaze of ``recording`` that is in ``world``."""
    tracks = recording.trajectory.tracks
    builder.source(recording.gaze, f"{recording.person}/{recording.gaze.name}")
    R, t = cpf_in_device(recording.device)
    for v, _, lines in builder.read_table(recording.gaze, recording.schema.columns):
        time = v[:, 0] * 1e-6
        eye, direction, distance = gaze_in_cpf(recording.schema, v)
        if world in tracks:
            turn, place, lost = poses_at(tracks[world], time, _GAP)
        else:
            turn, place, lost = np.broadcast_to(np.eye(3), (len(v), 3, 3)), np.zeros((len(v), 3)), np.ones(len(v), bool)
        elsewhere = np.zeros(len(v), bool)
        for other, track in tracks.items():
            if other != world and lost.any():
                elsewhere |= ~poses_at(track, time, _GAP)[2]
        origin = place + poses.rotate(turn, eye @ R.T + t)
        direction = poses.rotate(turn, direction @ R.T)
        builder.add(
            time,
            recording.person,
            origin,
            direction,
            rows=lines,
            head=turn @ R[:, 2],
            hit=origin + distance[:, None] * direction,
            drop={_OTHER_WORLD: lost & elsewhere, "there is no pose of the glasses at that time": lost},
        )


def _find_gaze(given: Path) -> Path:
    """The gaze file that is given, or that of the recording in the folder ``given``."""
    if "open_loop" in given.name or any(given.name == n + s for n, s in product(_TRAJECTORIES, _SUFFIXES)):
        raise NergError(
            f"{given} is a trajectory, and holds no gaze; give the recording's folder, which needs a closed loop "
            "trajectory as well"
        )
    if not given.is_dir():
        return given
    roots = [given, given / "mps", *sorted(p for p in given.glob("mps_*_vrs") if p.is_dir())]
    found = _first(_in_folders(roots, _GAZE_FOLDERS, [*_PERSONALIZED, *_GENERAL]))
    if found is None:
        raise NergError(
            f"there is no gaze file ({', '.join((*_PERSONALIZED, *_GENERAL))}; .csv or .csv.gz) in {given} or its "
            "folder eye_gaze; ask MPS for the eye gaze of the recording, or give the gaze file"
        )
    return found


def _find_trajectory(gaze: Path) -> Path:
    """The closed loop trajectory that belongs to a gaze file."""
    beside = _in_folders([gaze.parent], _POSE_FOLDERS, _TRAJECTORIES)
    found = _first(beside)
    if found is not None:
        return found
    if not gaze.is_file():
        raise NergError(f"there is no {gaze}; correct its name")
    if _first(_in_folders([gaze.parent], _POSE_FOLDERS, ["open_loop_trajectory"])) is not None:
        raise NergError(
            f"{gaze} has an open loop trajectory alone, which drifts and is no frame of a place; ask MPS for the "
            "closed loop trajectory (SLAM) of the recording"
        )
    raise NergError(
        f"there is no trajectory for {gaze} ({' or '.join(f'{n}.csv' for n in _TRAJECTORIES)}, .gz too, beside it, or "
        "in slam or trajectory beside its folder); ask MPS for the closed loop trajectory (SLAM) of the recording"
    )


def _in_folders(roots: Sequence[Path], folders: Sequence[str], names: Sequence[str]) -> Iterator[Path]:
    """Where such a file may be: names first, so that of two the one that is named first is found anywhere."""
    for name, root, folder, suffix in product(names, roots, folders, _SUFFIXES):
        yield root / folder / f"{name}{suffix}"


def _first(paths: Iterator[Path]) -> Path | None:
    return next((p for p in paths if p.is_file()), None)


def _person(gaze: Path) -> str:
    """The recording's folder: the first above ``gaze`` that is not one of MPS."""
    folders = (re.sub(r"^mps_(.+)_vrs$", r"\1", p) for p in reversed(resolve_path(gaze).parent.parts))
    return next((p for p in folders if p not in (*_GAZE_FOLDERS, "mps")), gaze.stem)
