"""Project Aria: gaze files of MPS and Aria Digital Twin, with closed loop trajectories.

- Files: ``personalized_eye_gaze.csv``, else ``general_eye_gaze.csv``, in the folder or its ``eye_gaze``;
  ``closed_loop_trajectory.csv`` next to it or in ``slam``; older names, ``.gz``, ``mps_*_vrs`` and the ground truth
  of Aria Digital Twin (``aria_trajectory.csv``, ``eyegaze.csv``). A gaze file instead of a folder selects that file.
  Open-loop trajectories drift and are refused.
- Both generations are distinguished by the header: the first stores tangent angles, the second polar ones. The
  device frame follows the glasses' construction; ``device`` (the VRS file states the model) moves the eye by 2 to
  4 mm.
- Poses are interpolated to gaze times; rows farther than 0.05 s from a pose are dropped.
- Up is against the trajectory's gravity: z in MPS, y in Aria Digital Twin. MPS sets height 0 at the start of the
  recording, so eye heights are near 0.
- Of a recording in several worlds, the one with the most gaze is used, or ``world`` in Python. Recordings of
  different worlds are refused together.
- Hit points exist where the file has a depth: nearly everywhere in Aria Digital Twin, nowhere in the first
  generation's general gaze. A crossing of both eyes' lines counts only in front and nearer than the 4 m at which it
  was clipped.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.safe_read import BadLineCallback, resolve_path

from . import poses
from .base import FROM_RECORDINGS, RaysBuilder, Signature, TrackingFrame, option
from .poses import PoseTrack
from .tables import TableBlock, iterate_table, read_table_columns

# ---- Gaze files of Project Aria: three schemas, recognised by their headers, and directions from their angles ----
#
# Angles are in the central pupil frame (CPF), whose origin is midway between the eyes: x left, y up, z forward, metres.
# Its pose on the glasses is only known from their CAD. See projectaria_tools (``core/mps/EyeGazeReader``,
# ``core/calibration/DeviceCadExtrinsics``).

TIME = "tracking_timestamp_us"

_EYE_COLUMNS = tuple(f"t{axis}_{side}_eye_cpf" for side in ("left", "right") for axis in "xyz")
_MAX_VERGENCE = 4.0  # metres; vergence is clipped to this, so that larger distances are unknown


@dataclass(frozen=True)
class GazeSchema:
    """Columns of one kind of gaze file."""

    name: str  # "legacy", "vergence" or "gen2"
    generation: int  # of the glasses: 1 or 2
    columns: tuple[str, ...]  # required columns, the time first


LEGACY = GazeSchema("legacy", 1, (TIME, "yaw_rads_cpf", "pitch_rads_cpf", "depth_m"))
VERGENCE = GazeSchema("vergence", 1, (TIME, "left_yaw_rads_cpf", "right_yaw_rads_cpf", "pitch_rads_cpf", "depth_m"))
GEN2 = GazeSchema("gen2", 2, (TIME, "yaw_rads_cpf", "pitch_rads_cpf", *_EYE_COLUMNS))


def find_schema(path: Path) -> GazeSchema:
    """Find the schema of the gaze file ``path`` by its header: a combined yaw with a pitch per eye is that of the
    second generation. Raises `NergError` for an unknown header."""
    columns = set(read_table_columns(path))
    if {"yaw_rads_cpf", "left_pitch_rads_cpf", "right_pitch_rads_cpf"} <= columns:
        return GEN2
    if {"left_yaw_rads_cpf", "right_yaw_rads_cpf"} <= columns:
        return VERGENCE
    if "yaw_rads_cpf" in columns:
        return LEGACY
    available = ", ".join(sanitize(c, 40) for c in sorted(columns)[:8]) or "none"
    raise NergError(
        f"{path} has no columns of gaze angles (yaw_rads_cpf, or left_yaw_rads_cpf and right_yaw_rads_cpf); its "
        f"columns are {available}; specify the folder of an Aria recording, or the gaze file in it"
    )


def compute_gaze_in_cpf(schema: GazeSchema, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Convert gaze values to eye positions and directions (n, 3) in CPF and distances (n,) in metres, NaN if unknown.

    Parameters
    ----------
    schema
        Schema of the values.
    v
        Values (n, C) of ``schema.columns``.

    Notes
    -----
    Angles of the first generation define tangents: (tan yaw, tan pitch, 1). With a yaw per eye, both have one pitch,
    and the direction to the crossing of their lines has the mean of tan yaw. Angles of the second generation are polar:
    (sin yaw cos pitch, sin pitch, cos yaw cos pitch), from the point midway between the eyes in the file.
    Directions are NaN for angles of 90 degrees or more.

    ``depth_m`` is the distance from the eyes; 0 and empty are unknown. With a yaw per eye it is that of the crossing,
    which is also unknown if the lines diverge (the file then has the distance of their crossing behind the head) or if
    it was clipped.
    """
    eye = np.zeros((len(v), 3))
    if schema is GEN2:
        yaw, pitch, distance = v[:, 1], v[:, 2], np.full(len(v), np.nan)
        eye = v[:, 3:9].reshape(-1, 2, 3).mean(axis=1)
        direction = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], axis=1)
        max_angle = np.abs(v[:, 1:3]).max(axis=1)
        direction[~(max_angle < np.pi / 2)] = np.nan
        return eye, direction, distance
    angles, distance = v[:, 1:-1], np.where(v[:, -1] > 0, v[:, -1], np.nan)
    tangents = np.where(np.abs(angles) < np.pi / 2, np.tan(angles), np.nan)
    across = tangents[:, 0]
    if schema is VERGENCE:
        across = 0.5 * (tangents[:, 0] + tangents[:, 1])
        # x is to the left: lines that cross in front have the right eye's turned farther to the left.
        has_crossing = tangents[:, 1] > tangents[:, 0]
        distance = np.where(has_crossing & (distance < _MAX_VERGENCE), distance, np.nan)
    direction = np.stack([across, tangents[:, -1], np.ones(len(v))], axis=1)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return eye, direction, distance


_SIDE = (0.793353, 0.0, -0.608761), (0.607927, -0.052336, 0.792266)
_FRONT = (-0.138127, -0.912873, -0.384166), (0.308866, -0.40824, 0.859034)
# Per model: generation, and the device frame (that of the left SLAM camera) in CPF: origin in metres, y, z.
_MODELS = {
    "DVT-S": (1, (0.069051, 0.002372, 0.009254), *_SIDE),
    "DVT-L": (1, (0.071351, 0.002372, 0.008454), *_SIDE),
    "DVT-LL": (2, (0.07107883, 0.005719893, 0.01155452), *_FRONT),
    "DVT-LS": (2, (0.07107883, 0.005719893, 0.01155452), *_FRONT),
    "DVT-SL": (2, (0.067294194, 0.006033819, 0.011768852), _FRONT[0], (0.308866, -0.408244, 0.859034)),
    "DVT-SS": (2, (0.067294194, 0.006033819, 0.011768852), _FRONT[0], (0.308866, -0.408244, 0.859034)),
}


def resolve_device(requested: str | None, generation: int) -> str:
    """The model with the ``requested`` name (ignoring case, - and _), or the usual model of a ``generation``. Raises
    `NergError` for an unknown model, or one of another generation."""
    if requested is None:
        return "DVT-L" if generation == 1 else "DVT-LL"
    name = requested.upper().replace("_", "-")
    models = [model for model, entry in _MODELS.items() if entry[0] == generation]
    if name not in models:
        what = "is of another generation than the gaze file" if name in _MODELS else "is not a model of Aria glasses"
        raise NergError(
            f'{parameter("device")} "{sanitize(requested, 40)}" {what}; choose one of {", ".join(models)}, or '
            "leave it out"
        )
    return name


def compute_cpf_in_device(device: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation R (3, 3) and origin t (3,), metres, of CPF in the frame of a device: p_device = R p_cpf + t."""
    _, origin, y, z = _MODELS[device]
    y, z = (np.array(a) / np.linalg.norm(a) for a in (y, z))
    x = np.cross(y, z)
    x /= np.linalg.norm(x)
    device_in_cpf = np.stack([x, np.cross(z, x), z], axis=1)
    return device_in_cpf.T, -device_in_cpf.T @ np.array(origin)


# ---- Trajectories of Project Aria: poses of the glasses per world, and its up axis ----

_POSITION_COLUMNS = [f"t{axis}_world_device" for axis in "xyz"]
_QUATERNION_COLUMNS = [f"q{axis}_world_device" for axis in "xyzw"]
_GRAVITY_COLUMNS = [f"gravity_{axis}_world" for axis in "xyz"]
_MAX_WORLDS = 1000  # a file with more is not a trajectory
_EDGE_SECONDS = 1e-3  # times this much outside of a trajectory use its first or last pose
_MIN_AXIS_COSINE = np.cos(np.radians(1.0))


def read_up_axis(path: Path) -> str:
    """Read the up axis of the trajectory ``path`` from the gravity of its first pose: x, y, z, -x, -y or -z.

    Raises `NergError` for a file without poses, or if gravity is not along an axis.
    """
    # Bad lines are reported when the poses are read.
    for block in iterate_table(path, _GRAVITY_COLUMNS, on_bad_line=lambda line, why: None):
        rows = block.numbers[np.isfinite(block.numbers).all(axis=1)]
        if len(rows):
            return _find_up_axis(path, rows[0])
    raise NergError(f"the trajectory {path} has no poses with gravity; re-run MPS on the recording")


def _find_up_axis(path: Path, gravity: np.ndarray) -> str:
    """Name of the axis opposite to ``gravity`` (3,)."""
    length = np.linalg.norm(gravity)
    components = -gravity / length if length > 0 else np.zeros(3)
    k = int(np.abs(components).argmax())
    if not abs(components[k]) > _MIN_AXIS_COSINE:
        vector_text = " ".join(f"{x:.3g}" for x in gravity)
        raise NergError(
            f"the gravity of the trajectory {path} ({vector_text}) is not along an axis of its world, so that the up "
            "axis is unknown; rotate its poses and its gravity to an axis"
        )
    return ("-" if components[k] < 0 else "") + "xyz"[k]


@dataclass
class _World:
    """Poses of one world that are needed for the gaze."""

    gravity: np.ndarray  # (3,) of its first pose
    poses: list[np.ndarray] = field(default_factory=list)  # (n, 8): seconds, position, quaternion x, y, z, w


class Trajectory:
    """Poses of the glasses in a recording around the times of its gaze."""

    def __init__(self, path: Path, times: np.ndarray, on_bad: BadLineCallback | None) -> None:
        """Read ``path`` for gaze at ``times`` (n,) seconds. Raises `NergError` if it is not a trajectory."""
        self.path, self.lines = path, 0
        self._times = np.sort(times[np.isfinite(times)])
        self._worlds: dict[str, _World] = {}
        for block in iterate_table(
            path, [TIME, *_POSITION_COLUMNS, *_QUATERNION_COLUMNS, *_GRAVITY_COLUMNS], ["graph_uid"], on_bad_line=on_bad
        ):
            self._add_block(block)
            self.lines += len(block.lines)
        self.tracks = {uid: track for uid, w in self._worlds.items() if (track := _make_track(w)) is not None}
        if not self.tracks:
            raise NergError(f"{path} has {self.lines} poses; interpolation needs at least two poses of one world")

    def find_up_axis(self, world: str) -> str:
        """The up axis of ``world``, one of `tracks`."""
        return _find_up_axis(self.path, self._worlds[world].gravity)

    def _add_block(self, block: TableBlock) -> None:
        names, which = np.unique(block.texts[:, 0], return_inverse=True)
        for k, name in enumerate(names.tolist()):
            v = block.numbers[which == k]
            v = v[np.isfinite(v).all(axis=1)]
            if not len(v):
                continue
            world = self._worlds.setdefault(name, _World(v[0, 8:]))
            if len(self._worlds) > _MAX_WORLDS:
                raise NergError(
                    f"the trajectory {self.path} has more than {_MAX_WORLDS:,} worlds (graph_uid); re-run MPS on the "
                    "recording"
                )
            deviation = np.abs(v[:, 8:] - world.gravity).max()
            if deviation > 0.02 * np.linalg.norm(world.gravity):
                raise NergError(
                    f"the gravity of the world {sanitize(name, 40)} changes in the trajectory {self.path}, so that the "
                    "up axis is unknown; re-run MPS on the recording"
                )
            v = v[np.argsort(v[:, 0], kind="stable")]
            v[:, 0] *= 1e-6
            # Of a thousand poses per second, keep those around each gaze sample, and the first and last of a block.
            near = np.searchsorted(v[:, 0], self._times[slice(*np.searchsorted(self._times, v[[0, -1], 0]))])
            rows = np.unique(np.clip(np.r_[0, near - 1, near, len(v) - 1], 0, len(v) - 1))
            world.poses.append(v[rows, :8])


def _make_track(world: _World) -> PoseTrack | None:
    from scipy.spatial.transform import Rotation

    v = np.concatenate(world.poses)
    length = np.linalg.norm(v[:, 4:], axis=1)
    v = v[np.isfinite(length) & (length > 1e-12)]
    if not len(v):
        return None
    return PoseTrack.from_samples(v[:, 0], Rotation.from_quat(v[:, 4:]).as_rotvec(), v[:, 1:4])


def interpolate_poses(track: PoseTrack, t: np.ndarray, max_gap: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As `PoseTrack.interpolate`, but times up to a millisecond outside of the track use its first or last pose: gaze
    of the ground truth starts some microseconds before the poses."""
    ends = track.times[[0, -1]]
    near = np.clip(t, *ends)
    return track.interpolate(np.where(np.abs(t - near) <= _EDGE_SECONDS, near, t), max_gap)


# ---- Recordings of Project Aria glasses, from Machine Perception Services (MPS) or Aria Digital Twin (ADT) ----

_MAX_GAP = 0.05  # seconds; gaze farther from a pose is dropped
_SUFFIXES = (".csv", ".csv.gz")
# File names of MPS: current names first, then older ones and those of ADT; personalized gaze before general gaze.
_PERSONALIZED = ("personalized_eye_gaze", "calibrated_eye_gaze")
_GENERAL = ("general_eye_gaze", "generalized_eye_gaze", "generalized_gaze", "eyegaze")
_TRAJECTORIES = ("closed_loop_trajectory", "aria_trajectory")
_GAZE_FOLDERS = ("eye_gaze", "eye_gaze_vergence", ".")
_POSE_FOLDERS = (".", "slam", "trajectory", "../slam", "../trajectory", "..")
_OTHER_WORLD = "the pose is in another world, by its graph_uid (option world)"
_MAX_LISTED_WORLDS = 20


@dataclass(frozen=True, kw_only=True)
class AriaOptions:
    """Options for what the recordings do not contain."""

    device: str | None = option(
        None,
        "Model of the glasses: DVT-S or DVT-L; for the second generation DVT-LL, DVT-LS, DVT-SL or DVT-SS.",
        flag="",
        default_text="DVT-L, or DVT-LL for gaze of the second generation",
        is_recorded=False,
    )
    world: str | None = option(
        None,
        "The graph_uid of the world to import.",
        flag="",
        default_text="the one with the most gaze",
        is_recorded=False,
    )


@dataclass
class _AriaRecording:
    """A gaze file with its poses."""

    gaze: Path
    schema: GazeSchema
    device: str
    person: str
    trajectory: Trajectory
    rows: Counter[str]  # number of gaze rows with a pose, by world


class Aria:
    """Folders of recordings, or their gaze files, with the closed loop trajectory next to them.

    Gaze angles are in the central pupil frame of the glasses; see
    :func:`nerg_mi.tracking.readers.aria.compute_gaze_in_cpf` for their directions. The trajectory contains the poses of
    the glasses, a thousand per second (ground truth of Aria Digital Twin: thirty); they are interpolated to the times
    of the gaze, and rows more than 0.05 s from a pose are dropped. Up is opposite to the gravity of the trajectory.
    Each world (``graph_uid``) is a frame of its own: rows in worlds other than ``world`` are dropped. Personalized gaze
    is preferred to general gaze. A depth gives the hit point. Times are seconds of the device's clock. The participant
    is the recording's folder (``anna`` for ``anna/eye_gaze`` or ``mps_anna_vrs/eye_gaze``).
    """

    name = "aria"
    files = (
        "folders of Project Aria recordings from MPS or Aria Digital Twin, of both generations (or the gaze "
        "files in them), with `closed_loop_trajectory.csv` or `aria_trajectory.csv`"
    )
    frame_description = "right-handed, m, up from the trajectory's gravity"
    evidence = f"{FROM_RECORDINGS}; of the second generation, gaze only"
    signature = Signature(columns=(("tracking_timestamp_us", "pitch_rads_cpf"),))
    Options = AriaOptions

    def frame(self, files: Sequence[Path], options: AriaOptions) -> TrackingFrame:
        if not files:
            return TrackingFrame()
        return TrackingFrame(up=read_up_axis(_find_trajectory(_find_gaze(files[0]))))

    def read(self, files: Sequence[Path], options: AriaOptions, builder: RaysBuilder) -> None:
        recordings = [_open_recording(_find_gaze(path), options, builder) for path in files]
        world, up = _choose_world(recordings, options.world), read_up_axis(recordings[0].trajectory.path)
        # A recording with another gravity in this world would be rotated incorrectly.
        for recording in recordings:
            if world in recording.trajectory.tracks and recording.trajectory.find_up_axis(world) != up:
                raise NergError(
                    f"{recording.trajectory.path} has {recording.trajectory.find_up_axis(world)} up in the world "
                    f"{sanitize(world)}, but {recordings[0].trajectory.path} begins with {up} up; import recordings "
                    "with different up axes separately"
                )
        rows_by_world = sum((r.rows for r in recordings), Counter())
        builder.add_metadata(
            floor="unknown",  # the origin of a world is the first position of the glasses
            world=world,
            other_worlds={w: n for w, n in rows_by_world.most_common(_MAX_LISTED_WORLDS + 1) if w != world},
            gaze=[
                {"file": f"{r.person}/{r.gaze.name}", "schema": r.schema.name, "device": r.device} for r in recordings
            ],
        )
        for recording in recordings:
            _add_gaze(recording, world, builder)


READERS = (Aria(),)


def _open_recording(gaze: Path, options: AriaOptions, builder: RaysBuilder) -> _AriaRecording:
    """Read the poses for the gaze file ``gaze``, of which only the times are read yet."""
    schema, person = find_schema(gaze), _find_person(gaze)
    device = resolve_device(options.device, schema.generation)
    # Unreadable lines are reported when the complete file is read.
    ignore_bad_line = None if builder.on_bad_line is None else lambda line, why: None
    blocks = [block.numbers[:, 0] * 1e-6 for block in iterate_table(gaze, [TIME], on_bad_line=ignore_bad_line)]
    times = np.concatenate(blocks or [np.empty(0)])
    path = _find_trajectory(gaze)
    builder.begin_source(path, f"{person}/{path.name}")
    trajectory = Trajectory(path, times, builder.on_bad_line)
    builder.count_lines(trajectory.lines)
    rows = Counter(
        {w: int((~interpolate_poses(track, times, _MAX_GAP)[2]).sum()) for w, track in trajectory.tracks.items()}
    )
    return _AriaRecording(gaze, schema, device, person, trajectory, rows)


def _choose_world(recordings: Sequence[_AriaRecording], requested: str | None) -> str:
    """The ``requested`` world, or the one with the most gaze. Raises `NergError` if a recording has no pose in it."""
    rows = sum((r.rows for r in recordings), Counter())
    worlds_text = ", ".join(sanitize(w, 40) for w, _ in rows.most_common(4))
    if requested is not None:
        if requested not in rows and not any(requested in r.trajectory.tracks for r in recordings):
            raise NergError(
                f'there is no world "{sanitize(requested, 40)}" ({parameter("world")}) in these recordings; there '
                f"are {worlds_text}"
            )
        return requested
    world = min((w for r in recordings for w in r.trajectory.tracks), key=lambda w: (-rows[w], w))
    for recording in recordings:
        if world not in recording.trajectory.tracks:
            raise NergError(
                f"{recording.gaze} was recorded in another world (graph_uid) than {sanitize(world, 40)}, each with "
                f"a frame of its own ({worlds_text}); import them separately, combine them with MPS (Multi-SLAM), "
                f"or choose one with {parameter('world')}"
            )
    return world


def _add_gaze(recording: _AriaRecording, world: str, builder: RaysBuilder) -> None:
    """Add the gaze of ``recording`` with poses in ``world``."""
    tracks = recording.trajectory.tracks
    builder.begin_source(recording.gaze, f"{recording.person}/{recording.gaze.name}")
    R, t = compute_cpf_in_device(recording.device)
    for v, _, lines in builder.read_table(recording.gaze, recording.schema.columns):
        time = v[:, 0] * 1e-6
        eye, direction, distance = compute_gaze_in_cpf(recording.schema, v)
        if world in tracks:
            rotation, position, has_no_pose = interpolate_poses(tracks[world], time, _MAX_GAP)
        else:
            rotation, position, has_no_pose = (
                np.broadcast_to(np.eye(3), (len(v), 3, 3)),
                np.zeros((len(v), 3)),
                np.ones(len(v), bool),
            )
        is_in_other_world = np.zeros(len(v), bool)
        for other, track in tracks.items():
            if other != world and has_no_pose.any():
                is_in_other_world |= ~interpolate_poses(track, time, _MAX_GAP)[2]
        origin = position + poses.rotate(rotation, eye @ R.T + t)
        direction = poses.rotate(rotation, direction @ R.T)
        builder.add(
            time,
            recording.person,
            origin,
            direction,
            rows=lines,
            tracking="eye",
            head=rotation @ R[:, 2],
            hit=origin + distance[:, None] * direction,
            drop={
                _OTHER_WORLD: has_no_pose & is_in_other_world,
                "there is no pose of the glasses at that time": has_no_pose,
            },
        )


def _find_gaze(path: Path) -> Path:
    """The gaze file ``path``, or the gaze file of the recording in that folder."""
    if "open_loop" in path.name or any(path.name == n + s for n, s in product(_TRAJECTORIES, _SUFFIXES)):
        raise NergError(
            f"{path} is a trajectory and contains no gaze; specify the recording's folder, which also needs a closed "
            "loop trajectory"
        )
    if not path.is_dir():
        return path
    roots = [path, path / "mps", *sorted(p for p in path.glob("mps_*_vrs") if p.is_dir())]
    gaze = _find_first_file(_iterate_candidates(roots, _GAZE_FOLDERS, [*_PERSONALIZED, *_GENERAL]))
    if gaze is None:
        raise NergError(
            f"there is no gaze file ({', '.join((*_PERSONALIZED, *_GENERAL))}; .csv or .csv.gz) in {path} or its "
            "folder eye_gaze; request the eye gaze of the recording from MPS, or specify the gaze file"
        )
    return gaze


def _find_trajectory(gaze: Path) -> Path:
    """Find the closed loop trajectory of a gaze file."""
    candidates = _iterate_candidates([gaze.parent], _POSE_FOLDERS, _TRAJECTORIES)
    trajectory = _find_first_file(candidates)
    if trajectory is not None:
        return trajectory
    if not gaze.is_file():
        raise NergError(f"{gaze} does not exist; correct its name")
    if _find_first_file(_iterate_candidates([gaze.parent], _POSE_FOLDERS, ["open_loop_trajectory"])) is not None:
        raise NergError(
            f"{gaze} only has an open loop trajectory, which drifts and has no fixed frame; request the "
            "closed loop trajectory (SLAM) of the recording from MPS"
        )
    raise NergError(
        f"there is no trajectory for {gaze} ({' or '.join(f'{n}.csv' for n in _TRAJECTORIES)}, or .gz, next to it, or "
        "in slam or trajectory next to its folder); request the closed loop trajectory (SLAM) from MPS"
    )


def _iterate_candidates(roots: Sequence[Path], folders: Sequence[str], names: Sequence[str]) -> Iterator[Path]:
    """Iterate over possible paths of a file; all paths of the first name precede those of the next."""
    for name, root, folder, suffix in product(names, roots, folders, _SUFFIXES):
        yield root / folder / f"{name}{suffix}"


def _find_first_file(paths: Iterator[Path]) -> Path | None:
    return next((p for p in paths if p.is_file()), None)


def _find_person(gaze: Path) -> str:
    """The recording's folder: the first above ``gaze`` that is not a folder of MPS."""
    folders = (re.sub(r"^mps_(.+)_vrs$", r"\1", p) for p in reversed(resolve_path(gaze).parent.parts))
    return next((p for p in folders if p not in (*_GAZE_FOLDERS, "mps")), gaze.stem)
