"""BIDS datasets: eye tracking (``*_physio.tsv.gz``) in the world or in the head, and heads of Motion-BIDS.

See https://bids-specification.readthedocs.io (1.11): "Physiological recordings" and "Motion". The columns of gaze in
the world are a proposal of this package, which :mod:`nerg_mi.tracking.bids` writes; docs/how-to/bids.md describes them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.safe_read import read_json, resolve_path
from nerg_mi.maths.transforms import check_rigid_transforms
from nerg_mi.ranges import TIME_UNITS, ValidatedDataclass

from . import poses
from .base import FROM_DOCUMENTATION, RaysBuilder, Signature, TrackingFrame, option
from .poses import PoseTrack, find_fill_values
from .tables import iterate_table, parse_clock_seconds, read_table_columns

# ---- Names in the files ----

DESCRIPTION = "dataset_description.json"
# Coordinate systems: of rays as written here, and of points. The specification defines gaze-in-world, in which earlier
# versions wrote rays, as gaze in the picture of a scene camera (bids-specification issue 2474).
CUSTOM, GAZE_IN_WORLD = "custom", "gaze-in-world"
WORLD = "WorldCoordinateSystem"  # key of the proposal: axes of the world, of `GazeColumns`
TRACKING_KEY = "Tracking"  # key of the proposal: what directions are, of `nerg_mi.tracking.rays.TRACKING`
TIME = "timestamp"
POINT = ("x_coordinate", "y_coordinate", "z_coordinate")
ORIGIN, DIRECTION, HEAD = (tuple(f"{name}_{a}" for a in "xyz") for name in ("origin", "direction", "head"))
CONFIDENCE = "confidence"
SOURCE_NAME, GROUP = "source_name", "group"  # columns of participants.tsv
_PARTICIPANT = "participant_id"
_MAX_JSON_BYTES = 4 << 20
_MAX_FILES = 1_000_000  # of a dataset
_TICKS = {"s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3, "millisecond": 1e-3, "milliseconds": 1e-3}
_TICKS |= {"us": 1e-6, "\N{MICRO SIGN}s": 1e-6, "\N{GREEK SMALL LETTER MU}s": 1e-6, "microseconds": 1e-6}
_TICKS |= {"ns": 1e-9, "nanosecond": 1e-9, "nanoseconds": 1e-9}
_LENGTHS = {"m": "m", "meter": "m", "meters": "m", "metre": "m", "metres": "m", "cm": "cm", "mm": "mm"}
_HEAD_NAMES = re.compile(r"head|hmd|helmet|glasses|\bcap\b|cent(er|re)_?eye", re.IGNORECASE)
_BOTH = "both"  # the mean of the left and the right eye
_EYES = ("cyclopean", _BOTH, "left", "right")
_MAX_DEPTH_DIFFERENCE = 0.1  # of the points of both eyes, as a fraction of their distance; beyond it they are unknown
_MAX_POSE_GAP = 0.1  # seconds; gaze farther from a pose is dropped


@dataclass(frozen=True, kw_only=True)
class BidsOptions(ValidatedDataclass):
    """Options for what a dataset may leave open. Raises `NergError` for invalid values."""

    task: str | None = option(None, "Label of the task whose recordings are imported.", flag="", default_text="all")
    eye: str | None = option(
        None,
        "Eye whose gaze is imported: cyclopean, both (their mean), left or right.",
        default_text="cyclopean, otherwise both or the only one",
    )
    rigid_body: str | None = option(
        None,
        "Tracked point of Motion-BIDS that is the head.",
        default_text="the only one, or the only one named like a head",
    )
    up: str | None = option(
        None, "Up axis: x, y, z, -x, -y or -z.", default_text="that of the dataset", is_recorded=False
    )
    handedness: str | None = option(
        None, "Handedness: right or left.", flag="--hand", default_text="that of the dataset", is_recorded=False
    )
    forward: str | None = option(
        None, "Forward axis of the head's frame.", default_text="that of the dataset", is_recorded=False
    )
    tick: float | None = option(
        None, "Unit of the time stamps of gaze, in seconds.", default_text="Units of the sidecar", within=TIME_UNITS
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.eye not in (None, *_EYES):
            raise NergError(
                f'{parameter("eye")} is "{sanitize(str(self.eye), 40)}"; it must be cyclopean, both, left or right'
            )
        if self.forward is not None:
            poses.parse_axis(self.forward, "forward")


# ---- Files of a dataset, and sidecars by the inheritance principle ----


@dataclass(frozen=True)
class BidsName:
    """A file name: ``sub-01_task-walk_run-2_recording-eye1_physio.tsv.gz``."""

    entities: frozenset[str]  # {"sub-01", "task-walk", "run-2", "recording-eye1"}
    suffix: str  # "physio"

    @classmethod
    def parse(cls, name: str) -> BidsName:
        *entities, suffix = name.split(".")[0].split("_")
        return cls(frozenset(entities), suffix)

    def get(self, key: str) -> str | None:
        """The label of an entity: ``walk`` for ``task``; None without it."""
        return next((e.partition("-")[2] for e in self.entities if e.startswith(f"{key}-")), None)

    def without(self, *keys: str) -> frozenset[str]:
        """The entities except those with these keys."""
        return frozenset(e for e in self.entities if e.partition("-")[0] not in keys)


class _Dataset:
    """A dataset, of which a folder or file was named; reads sidecars and tables once, and records them as sources."""

    def __init__(self, path: Path, builder: RaysBuilder | None) -> None:
        path = resolve_path(path)
        root = next((p for p in (path, *path.parents) if (p / DESCRIPTION).is_file()), None)
        if root is None:
            raise NergError(
                f'there is no {DESCRIPTION} in "{path}" or a folder above it, so that it is not a BIDS dataset; '
                "specify the folder of one"
            )
        self.root, self.path, self._builder = root, path, builder
        self._json: dict[Path, dict[str, Any]] = {}
        self._names: dict[Path, list[str]] = {}
        self._tables: dict[Path, dict[str, list[str]]] = {}
        self.description = self.read_object(root / DESCRIPTION)

    def list_files(self, suffix: str, extension: str) -> list[Path]:
        """The files of participants with this suffix in the named folder, in the order of their runs."""
        if self.path.is_file() or not self.path.exists():
            candidates: Iterable[Path] = [self.path]
        elif self.path == self.root:
            subjects = sorted(p for p in self.root.iterdir() if p.name.startswith("sub-"))
            candidates = (f for p in subjects for f in ([p] if p.is_file() else p.rglob(f"*{extension}")))
        else:
            candidates = self.path.rglob(f"*{extension}")
        files = []
        for path in candidates:
            if path.name.endswith(f"_{suffix}{extension}"):
                files.append(path)
            if len(files) > _MAX_FILES:
                raise NergError(f'"{self.path}" has more than {_MAX_FILES:,} recordings; specify folders in it')
        return sorted(files, key=lambda path: [_natural_key(part) for part in path.relative_to(self.root).parts])

    def read_sidecar(self, path: Path) -> dict[str, Any]:
        """The metadata of the data file ``path``: of its own JSON file and, for other keys, those that it inherits."""
        name, merged = BidsName.parse(path.name), {}
        folders = [self.root, *reversed([p for p in path.parents if self.root in p.parents])]
        for folder in folders:
            parents = [
                (len(other.entities), file)
                for file in self._list_names(folder)
                if file.endswith(f"{name.suffix}.json")
                and (other := BidsName.parse(file)).suffix == name.suffix
                and other.entities <= name.entities
            ]
            for _, file in sorted(parents):
                merged.update(self.read_object(folder / file))
        return merged

    def _list_names(self, folder: Path) -> list[str]:
        if folder not in self._names:
            self._names[folder] = [p.name for p in folder.iterdir() if p.suffix == ".json" and p.is_file()]
        return self._names[folder]

    def read_object(self, path: Path) -> dict[str, Any]:
        """Read a JSON object, and record its file as a source."""
        if path not in self._json:
            content = read_json(path, "BIDS file", _MAX_JSON_BYTES)
            if not isinstance(content, dict):
                raise NergError(f'"{path}" is not a JSON object; correct it, or copy it again')
            self.begin(path)
            self._json[path] = content
        return self._json[path]

    def begin(self, path: Path) -> None:
        """Begin a source, named by its path in the dataset if its name is not unique."""
        if self._builder is not None:
            self._builder.begin_source(path, path.relative_to(self.root).as_posix())

    def read_texts(self, path: Path, columns: Sequence[str]) -> dict[str, list[str]]:
        """Read text columns of a table with a header; columns that it lacks are absent, all without the file."""
        if path not in self._tables:
            self._tables[path] = {}
            if path.is_file():
                self.begin(path)
                available = [name for name in columns if name in read_table_columns(path)]
                rows = [row for block in iterate_table(path, (), available) for row in block.texts.tolist()]
                self._tables[path] = {name: [row[k] for row in rows] for k, name in enumerate(available)}
                if self._builder is not None:
                    self._builder.count_lines(len(rows))
        return self._tables[path]

    @cached_property
    def participants(self) -> dict[str, dict[str, str]]:
        """Columns of participants.tsv by participant, for the names and groups of participants."""
        table = self.read_texts(self.root / "participants.tsv", [_PARTICIPANT, SOURCE_NAME, GROUP])
        names = table.get(_PARTICIPANT, [])
        return {name: {key: column[k] for key, column in table.items()} for k, name in enumerate(names)}

    def find_acquisition_time(self, path: Path) -> float | None:
        """Seconds of the ``acq_time`` of a data file in the scans.tsv of its session; None without it."""
        session = next((p for p in path.parents if p.name.startswith(("ses-", "sub-"))), None)
        if session is None:
            return None
        for scans in sorted(session.glob("*_scans.tsv")):
            table = self.read_texts(scans, ["filename", "acq_time"])
            texts = dict(zip(table.get("filename", []), table.get("acq_time", [])))
            time = parse_clock_seconds(texts.get(path.relative_to(session).as_posix(), ""))
            if time is not None:
                return time[0]
        return None


def _natural_key(text: str) -> list[tuple[bool, int, str]]:
    """Key that sorts run-2 before run-10."""
    return [(not part.isdigit(), int(part) if part.isdigit() else 0, part) for part in re.split(r"(\d{1,18})", text)]


# ---- Gaze recordings ----


@dataclass(frozen=True, eq=False)
class _Gaze:
    """A recording of gaze: its file and its metadata."""

    path: Path
    name: BidsName
    metadata: dict[str, Any]

    @property
    def eye(self) -> str:
        return str(self.metadata.get("RecordedEye"))

    @property
    def system(self) -> str:
        return str(self.metadata.get("SampleCoordinateSystem"))

    @property
    def has_rays(self) -> bool:
        """Whether the columns have origins and directions in the axes of `WORLD`."""
        has_axes = isinstance(self.metadata.get(WORLD), dict)
        is_in_world = self.system == GAZE_IN_WORLD or (self.system == CUSTOM and has_axes)
        return is_in_world and self.has(*ORIGIN, *DIRECTION)

    @property
    def columns(self) -> list[str]:
        """Names of the columns. Raises `NergError` if the metadata lack them."""
        columns = self.metadata.get("Columns")
        if not isinstance(columns, list) or not columns or not all(isinstance(c, str) for c in columns):
            raise NergError(f'the JSON files of "{self.path}" have no list "Columns", which names its columns; add it')
        if TIME not in columns:
            raise NergError(f'"{self.path}" has no column {TIME}, which eye tracking needs; add it and its name')
        return columns

    def has(self, *names: str) -> bool:
        return set(names) <= set(self.columns)

    def get_units(self, column: str) -> str:
        """The ``Units`` of a column, or an empty string."""
        entry = self.metadata.get(column)
        return str(entry.get("Units", "")).strip() if isinstance(entry, dict) else ""

    def get_length_unit(self, column: str) -> str:
        """The unit of length of a column. Raises `NergError` for another unit, such as pixels."""
        units = self.get_units(column)
        if units.lower() not in _LENGTHS:
            raise NergError(
                f'the {column} of "{self.path}" is in {sanitize(units, 40) or "no units"}, which is not a length in '
                f"the world; a position in the picture of a scene camera ({GAZE_IN_WORLD} of some programs) lacks the "
                "camera's poses: import the original recording with its own preset"
            )
        return _LENGTHS[units.lower()]

    def get_tick(self, options: BidsOptions) -> float:
        """The unit of the time stamps in seconds. Raises `NergError` if it is not stated."""
        units = self.get_units(TIME)
        if options.tick is None and units.lower() not in _TICKS:
            raise NergError(
                f'the JSON files of "{self.path}" state no unit of its {TIME} ("Units" is '
                f'"{sanitize(units, 40)}"); add s, ms, us or ns, or set it ({parameter("tick")})'
            )
        return _TICKS[units.lower()] if options.tick is None else options.tick


def _list_gaze(dataset: _Dataset, options: BidsOptions) -> list[tuple[_Gaze, ...]]:
    """The recordings of gaze of the requested task: of each, the file of one eye, or those of both."""
    recordings: dict[frozenset[str], list[_Gaze]] = {}
    for path in dataset.list_files("physio", ".tsv.gz"):
        gaze = _Gaze(path, BidsName.parse(path.name), dataset.read_sidecar(path))
        is_requested = options.task is None or gaze.name.get("task") == options.task
        if is_requested and gaze.metadata.get("PhysioType") == "eyetrack":
            recordings.setdefault(gaze.name.without("recording"), []).append(gaze)
    return [_choose_eyes(eyes, options.eye) for eyes in recordings.values()]


def _describe_eyes(recordings: Iterable[Sequence[_Gaze]]) -> dict[str, str]:
    """Metadata of rays: the eye that was imported, if it is that of all recordings."""
    chosen = {_BOTH if len(eyes) > 1 else eyes[0].eye for eyes in recordings}
    return {"eye": chosen.pop()} if len(chosen) == 1 and chosen <= set(_EYES) else {}


def _choose_eyes(eyes: Sequence[_Gaze], requested: str | None) -> tuple[_Gaze, ...]:
    for gaze in eyes:
        if not (gaze.system in (GAZE_IN_WORLD, "eye-in-head") or gaze.has_rays):
            raise NergError(
                f'"{gaze.path}" has gaze in the coordinate system {sanitize(gaze.system, 40)}, which does not contain '
                f"the positions of the eyes and of the screen in the world; rays need custom with {WORLD} and the "
                f"columns {ORIGIN[0]} to {DIRECTION[2]}, or eye-in-head with head poses of Motion-BIDS"
            )
    by_eye = {gaze.eye: gaze for gaze in eyes}
    if len(by_eye) < len(eyes):
        raise NergError(
            f'"{eyes[0].path}" and a file next to it record the same eye ("RecordedEye"); correct their JSON files, or '
            "specify one of the files"
        )
    choices = {"cyclopean": ("cyclopean",), _BOTH: ("left", "right"), "left": ("left",), "right": ("right",)}
    for choice in ["cyclopean", _BOTH] if requested is None else [requested]:
        if all(eye in by_eye for eye in choices[choice]):
            return tuple(by_eye[eye] for eye in choices[choice])
    if requested is None and len(eyes) == 1:
        return tuple(eyes)
    recorded = ", ".join(sanitize(eye, 20) for eye in by_eye)
    raise NergError(
        f'"{eyes[0].path}" and the files next to it record the eyes {recorded}; choose one ({parameter("eye")})'
    )


# ---- Heads of Motion-BIDS ----

_QUATERNION = ("quat_x", "quat_y", "quat_z", "quat_w")
_CHANNELS = ("name", "component", "type", "tracked_point", "units", "reference_frame", "placement")
_ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")


@dataclass(frozen=True, eq=False)
class _Motion:
    """A tracked point of a motion recording that is the head, with its channels by component."""

    path: Path
    point: str
    metadata: dict[str, Any]
    names: list[str]  # of all channels, in the order of the columns
    positions: dict[str, str]  # names of the channels by x, y, z
    orientations: dict[str, str]  # by quat_x, ... or x, y, z
    latency: str | None  # name of the channel of times
    units: str  # of length
    angle_units: str
    frame: dict[str, Any]  # SpatialAxes, RotationOrder, RotationRule

    def get_axes(self, options: BidsOptions) -> tuple[TrackingFrame, np.ndarray]:
        """The world's frame, and the forward axis (3,) of the head at rest. Raises `NergError` if it is not stated."""
        axes = str(self.frame.get("SpatialAxes", ""))
        is_stated = re.fullmatch("[APLRSI_]{3}", axes) is not None
        place = lambda positive, negative: next(
            (("-" if a == negative else "") + "xyz"[k] for k, a in enumerate(axes) if a in (positive, negative)), None
        )
        up, forward = (place(*pair) if is_stated else None for pair in ("SI", "AP"))
        up, forward = options.up or up, options.forward or forward
        handedness = options.handedness or (_find_handedness(axes) if is_stated else None)
        if up is None or forward is None or handedness is None:
            raise NergError(
                f'the reference frame of "{self.path}" (SpatialAxes "{sanitize(axes, 20)}" in its channels.json) '
                "does not state all axes; set the up axis, the forward axis of the head at rest and the "
                f"handedness ({parameter('up')}, {parameter('forward')}, {parameter('handedness')})"
            )
        return TrackingFrame(up, handedness, self.units), poses.parse_axis(forward, "forward")

    def rotations(self, values: np.ndarray, handedness: str) -> np.ndarray:
        """Rotations (n, 3, 3) from the head at rest to the world, of the channels of `orientations` (n, 3 or 4)."""
        if set(self.orientations) == set(_QUATERNION):
            matrices = poses.rotations_from_quaternions(values)
        else:
            from scipy.spatial.transform import Rotation

            order = str(self.frame.get("RotationOrder"))
            if order not in _ORDERS:
                raise NergError(f'"{self.path}" has Euler angles, but its channels.json no RotationOrder; add it')
            angles = values[:, ["xyz".index(a) for a in order.lower()]]
            is_valid = np.isfinite(angles).all(axis=1)
            degrees = self.angle_units.lower().startswith("deg")
            matrices = np.full((len(values), 3, 3), np.nan)
            if is_valid.any():
                matrices[is_valid] = Rotation.from_euler(order.lower(), angles[is_valid], degrees=degrees).as_matrix()
        rule = str(self.frame.get("RotationRule", handedness)).partition("-")[0]
        # A positive angle turns by the hand of the axes, unless the other hand is stated.
        return matrices if rule == handedness else np.swapaxes(matrices, 1, 2)


def _find_handedness(axes: str) -> str | None:
    """Handedness of anatomical axes such as ``ALS`` (right) or ``ARS`` (left); None if one is not stated."""
    vectors = {"A": (1, 0, 0), "P": (-1, 0, 0), "L": (0, 1, 0), "R": (0, -1, 0), "S": (0, 0, 1), "I": (0, 0, -1)}
    determinant = np.linalg.det(np.array([vectors.get(a, (0, 0, 0)) for a in axes], float))
    return None if abs(determinant) < 0.5 else "right" if determinant > 0 else "left"


def _find_motions(dataset: _Dataset, options: BidsOptions) -> list[_Motion]:
    """The heads of all motion recordings of the requested task."""
    recordings: dict[tuple[Path, frozenset[str]], list[_Motion]] = {}
    for path in dataset.list_files("motion", ".tsv"):
        name = BidsName.parse(path.name)
        if options.task is None or name.get("task") == options.task:
            key = path.parent, name.without("tracksys")
            recordings[key] = recordings.get(key, []) + _read_heads(dataset, path, options)
    return [_choose_head(folder, heads) for (folder, _), heads in recordings.items() if heads]


def _find_motion(dataset: _Dataset, gaze: _Gaze, options: BidsOptions) -> _Motion:
    """The head of the recording that belongs to ``gaze``. Raises `NergError` without exactly one."""
    session = next((p for p in gaze.path.parents if p.name.startswith(("ses-", "sub-"))), gaze.path.parent)
    key = gaze.name.without("recording", "tracksys")
    files = [p for p in sorted(session.rglob("*_motion.tsv")) if BidsName.parse(p.name).without("tracksys") == key]
    heads = [head for path in files for head in _read_heads(dataset, path, options)]
    if not heads:
        raise NergError(
            f'"{gaze.path}" has gaze in the coordinate system {sanitize(gaze.system, 40)}, and for rays in the world '
            "lacks the pose of the head: a *_tracksys-<label>_motion.tsv of the same task and run with position and "
            "orientation of the head (Motion-BIDS); add it"
        )
    return _choose_head(gaze.path, heads)


def _choose_head(recording: Path, heads: Sequence[_Motion]) -> _Motion:
    if len(heads) > 1:
        points = ", ".join(sanitize(head.point, 40) for head in heads[:8])
        raise NergError(
            f'several tracked points of "{recording}" may be the head ({points}); choose one '
            f"({parameter('rigid_body')})"
        )
    return heads[0]


def _read_heads(dataset: _Dataset, path: Path, options: BidsOptions) -> list[_Motion]:
    """The tracked points of a motion recording that may be the head: those with a position and an orientation."""
    channels_path = path.with_name(path.name.removesuffix("_motion.tsv") + "_channels.tsv")
    table = dataset.read_texts(channels_path, _CHANNELS)
    if not {"name", "component", "type", "tracked_point"} <= set(table):
        raise NergError(f'"{path}" needs a "{channels_path.name}" with name, component, type and tracked_point; add it')
    empty = [""] * len(table["name"])
    rows = [dict(zip(_CHANNELS, row)) for row in zip(*(table.get(name, empty) for name in _CHANNELS))]
    levels = dataset.read_sidecar(channels_path).get("reference_frame", {})
    levels = levels.get("Levels", {}) if isinstance(levels, dict) else {}
    points = dict.fromkeys(row["tracked_point"] for row in rows)
    motions = []
    for point in points:
        position, orientation = (
            {row["component"]: row for row in rows if row["tracked_point"] == point and row["type"] == kind}
            for kind in ("POS", "ORNT")
        )
        components = _QUATERNION if set(_QUATERNION) <= set(orientation) else tuple("xyz")
        if not (set("xyz") <= set(position) and set(components) <= set(orientation)):
            continue
        units = position["x"]["units"].strip().lower().removeprefix("v")  # virtual metres are metres
        frame = levels.get(position["x"]["reference_frame"], {}) if isinstance(levels, dict) else {}
        motions.append(
            _Motion(
                path,
                point,
                dataset.read_sidecar(path),
                table["name"],
                {a: position[a]["name"] for a in "xyz"},
                {c: orientation[c]["name"] for c in components},
                next((row["name"] for row in rows if row["type"] == "LATENCY"), None),
                str(_LENGTHS.get(units, units)),
                orientation[components[0]]["units"].strip(),
                frame if isinstance(frame, dict) else {},
            )
        )
    if options.rigid_body is not None:
        return [motion for motion in motions if motion.point == options.rigid_body]
    named = [motion for motion in motions if _HEAD_NAMES.search(motion.point)]
    return named or (motions if len(motions) == 1 else [])


@dataclass(frozen=True, eq=False)
class _HeadPoses:
    """Poses of a head: times (n,) in seconds since the start, positions (n, 3), rotations (n, 3, 3), rows (n,)."""

    times: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray
    rows: np.ndarray


def _iterate_poses(dataset: _Dataset, motion: _Motion, handedness: str, builder: RaysBuilder) -> Iterator[_HeadPoses]:
    """Read the poses of a head block by block."""
    rate = motion.metadata.get("SamplingFrequencyEffective", motion.metadata.get("SamplingFrequency"))
    rate = rate if isinstance(rate, (int, float)) else motion.metadata.get("SamplingFrequency")
    if motion.latency is None and (not isinstance(rate, (int, float)) or not rate > 0):
        raise NergError(f'"{motion.path}" has neither a LATENCY channel nor a SamplingFrequency; add one of them')
    dataset.begin(motion.path)
    orientations = [motion.orientations[c] for c in (_QUATERNION if len(motion.orientations) == 4 else "xyz")]
    numbers = [*motion.positions.values(), *orientations, *([motion.latency] if motion.latency else [])]
    for v, _, lines in builder.read_table(motion.path, numbers, header=motion.names, separator="\t"):
        times = v[:, -1] if motion.latency else (lines - 1) / rate
        rotations = motion.rotations(v[:, 3 : 3 + len(orientations)], handedness)
        yield _HeadPoses(times, v[:, :3], rotations, lines)


def _read_track(dataset: _Dataset, motion: _Motion, handedness: str, builder: RaysBuilder) -> PoseTrack:
    from scipy.spatial.transform import Rotation

    parts = list(_iterate_poses(dataset, motion, handedness, builder))
    builder.count_lines(sum(len(part.times) for part in parts))
    joined = [np.concatenate([getattr(part, name) for part in parts]) for name in ("times", "positions", "rotations")]
    is_valid = np.isfinite(joined[2]).all(axis=(1, 2))
    times, positions, rotations = (values[is_valid] for values in joined)
    track = None
    if len(times):
        track = PoseTrack.from_samples(times, Rotation.from_matrix(rotations).as_rotvec(), positions)
    if track is None:
        raise NergError(f'"{motion.path}" has fewer than two poses of {sanitize(motion.point, 40)}; copy it again')
    return track


# ---- The reader ----


class Bids:
    """Folders of BIDS datasets (or of participants and sessions in them, or their ``*_physio.tsv.gz``).

    Metadata are inherited from JSON files in the folders above. Recordings with ``PhysioType`` "eyetrack" give rays by
    their ``SampleCoordinateSystem``:

    - custom, with ``WorldCoordinateSystem`` and the columns ``origin_x`` to ``direction_z`` as written by ``nerg rays
      export``: these, and the point x, y, z_coordinate as the hit point.
    - gaze-in-world, in which earlier versions wrote the same. Without these columns, the ray starts at the head's
      position in Motion-BIDS, and leads to the point. A position in the picture of a scene camera is refused.
    - eye-in-head: x and y_coordinate are angles from the head's forward axis, to the right and up, or x, y,
      z_coordinate a direction in its frame; the head's pose is that of Motion-BIDS, at most 0.1 s from the sample.
    - gaze-on-screen and other custom systems are refused, since the poses of screen and eyes in the world are not in
      the dataset.

    A recording with a file of the left and one of the right eye gives the mean of both eyes, and the gaze of one eye
    where the other was not seen (n/a, or confidence 0); a file of the cyclopean eye is preferred. Rows of both eyes
    belong together if their times differ by at most half a sampling interval.

    Gaze and motion are aligned by ``acq_time`` in scans.tsv, otherwise by ``StartTime``. A dataset without eye tracking
    gives the heads of Motion-BIDS as rays. The participant is that of the folder, or its ``source_name`` in
    participants.tsv, and the cohort its ``group``. Events are not read.
    """

    name = "bids"
    files = (
        "folders of BIDS datasets (1.11) with eye tracking (`*_physio.tsv.gz`: gaze in the world, or eye in head with "
        "head poses) or Motion-BIDS (heads)"
    )
    frame_description = "`WorldCoordinateSystem`, or `SpatialAxes` of Motion-BIDS, in the dataset's unit of length"
    evidence = f"{FROM_DOCUMENTATION}; reads what `nerg rays export` writes"
    signature = Signature(files=((DESCRIPTION, "participants.tsv"),), ending="_physio.tsv.gz")
    Options = BidsOptions

    def frame(self, files: Sequence[Path], options: BidsOptions) -> TrackingFrame:
        frames = {self._find_frame(dataset, options) for dataset in (_Dataset(path, None) for path in files)}
        if len(frames) > 1:
            texts = "; ".join(sorted(map(str, frames)))
            raise NergError(f"the datasets have different frames ({texts}); import them separately")
        return frames.pop() if frames else TrackingFrame()

    def _find_frame(self, dataset: _Dataset, options: BidsOptions) -> TrackingFrame:
        gaze = _list_gaze(dataset, options)
        heads = [] if gaze else _find_motions(dataset, options)
        frames = {_frame_of_gaze(dataset, eye, options) for eyes in gaze for eye in eyes}
        frames |= {head.get_axes(options)[0] for head in heads}
        if not frames:
            raise NergError(
                f'"{dataset.path}" has neither eye tracking (*_physio.tsv.gz with PhysioType "eyetrack") nor heads '
                "of Motion-BIDS (*_motion.tsv with position and orientation of a tracked point named like a head; "
                f"otherwise name it with {parameter('rigid_body')}); specify another dataset or task"
            )
        if len(frames) > 1:
            texts = "; ".join(sorted(map(str, frames)))
            raise NergError(
                f'the recordings of "{dataset.path}" have different frames ({texts}); import tasks separately '
                f"({parameter('task')})"
            )
        return frames.pop()

    def read(self, files: Sequence[Path], options: BidsOptions, builder: RaysBuilder) -> None:
        frame = self.frame(files, options)
        for path in files:
            dataset = _Dataset(path, builder)
            recordings = _list_gaze(dataset, options)
            builder.add_metadata(**_describe_eyes(recordings))
            for eyes in recordings:
                _add_gaze(dataset, eyes, frame, options, builder)
            if not recordings:
                builder.add_metadata(floor="unknown")
                for motion in _find_motions(dataset, options):
                    _add_heads(dataset, motion, frame, options, builder)
            if dataset.list_files("physioevents", ".tsv.gz"):
                builder.add_unused_columns(["*_physioevents.tsv.gz (events)"])


READERS = (Bids(),)


def _frame_of_gaze(dataset: _Dataset, gaze: _Gaze, options: BidsOptions) -> TrackingFrame:
    """The frame of the rays of a recording. Raises `NergError` if it is not stated."""
    if not gaze.has_rays:
        motion = _find_motion(dataset, gaze, options)
        frame = motion.get_axes(options)[0]
        if gaze.system == GAZE_IN_WORLD and gaze.get_length_unit(POINT[0]) != frame.units:
            raise NergError(f'"{gaze.path}" and "{motion.path}" have different units of length; convert one of them')
        return frame
    world = gaze.metadata.get(WORLD)
    world = world if isinstance(world, dict) else {}
    up, handedness = options.up or world.get("UpAxis"), options.handedness or world.get("Handedness")
    if up is None or handedness is None:
        raise NergError(
            f'the JSON files of "{gaze.path}" do not state the axes of its world ({WORLD} with UpAxis and '
            f"Handedness); set them ({parameter('up')}, {parameter('handedness')})"
        )
    return TrackingFrame(str(up), str(handedness), gaze.get_length_unit(ORIGIN[0]))


@dataclass(frozen=True, eq=False)
class _Samples:
    """n samples of an eye, or of both, in the world of the dataset."""

    times: np.ndarray  # (n,) seconds
    origin: np.ndarray  # (n, 3)
    direction: np.ndarray  # (n, 3), of any length
    lines: np.ndarray  # (n,)
    confidence: np.ndarray | None = None  # (n,)
    hit: np.ndarray | None = None  # (n, 3)
    head: np.ndarray | None = None  # (n, 3)
    drop: dict[str, np.ndarray] = field(default_factory=dict)  # reasons and masks (n,)

    def select(self, rows: np.ndarray) -> _Samples:
        """The samples of a mask or of indices."""
        return self._from_columns({name: v[rows] for name, v in self._to_columns().items()})

    @classmethod
    def join(cls, parts: Sequence[_Samples]) -> _Samples:
        """Join the parts of a file, of which there is at least one."""
        columns = [part._to_columns() for part in parts]
        return cls._from_columns({name: np.concatenate([c[name] for c in columns]) for name in columns[0]})

    def _to_columns(self) -> dict[str, np.ndarray]:
        """The columns that exist, by name, and the masks, by reason."""
        columns = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "drop"}
        return {name: values for name, values in columns.items() if values is not None} | self.drop

    @classmethod
    def _from_columns(cls, columns: dict[str, np.ndarray]) -> _Samples:
        arguments = {f.name: columns[f.name] for f in fields(cls) if f.name in columns}
        return cls(**arguments, drop={reason: mask for reason, mask in columns.items() if reason not in arguments})

    @property
    def is_seen(self) -> np.ndarray:
        """Whether the eye has a direction with a confidence above 0, (n,) bool."""
        values = np.c_[self.origin, self.direction]
        is_seen = np.isfinite(values).all(axis=1) & (self.direction != 0).any(axis=1)
        is_seen &= np.isnan(find_fill_values(self.direction))
        return is_seen if self.confidence is None else is_seen & (self.confidence > 0)


def _add_gaze(
    dataset: _Dataset, eyes: Sequence[_Gaze], frame: TrackingFrame, options: BidsOptions, builder: RaysBuilder
) -> None:
    """Add the rays of a recording, of one eye or of both."""
    first = eyes[0]
    person, cohort = _find_person(dataset, first.name, first.metadata)
    world = first.metadata.get(WORLD)
    world = world if isinstance(world, dict) else {}
    if world.get("FloorHeight") != 0:
        builder.add_metadata(floor="unknown")
    if world.get("EnvironmentFromWorld") is not None:
        name = f'EnvironmentFromWorld of "{first.path}"'
        matrix = world["EnvironmentFromWorld"]
        check_rigid_transforms(matrix, name, may_scale=True, may_mirror=True, shape=(4, 4))
        builder.add_metadata(place_from_rays=matrix)

    def add(samples: _Samples, eye_distance: np.ndarray | None = None) -> None:
        builder.add(
            samples.times,
            person,
            samples.origin,
            samples.direction,
            rows=samples.lines,
            tracking="unknown" if eyes[0].metadata.get(TRACKING_KEY) == "unknown" else "eye",
            confidence=samples.confidence,
            hit=samples.hit,
            cohort=None if cohort is None else np.full(len(samples.times), cohort),
            head=samples.head,
            eye_distance=eye_distance,
            drop=samples.drop,
        )

    tracks: dict[Path, PoseTrack] = {}
    iterate = lambda gaze: _iterate_samples(dataset, gaze, frame, options, builder, tracks)
    if len(eyes) == 1:
        for samples in iterate(first):
            add(samples)
        return
    parts = list(iterate(eyes[1]))
    if not parts:
        raise NergError(
            f'"{eyes[1].path}" has no samples; copy it again, or import the other eye alone ({parameter("eye")})'
        )
    second = _Samples.join(parts)
    tolerance = _find_interval(second.times) / 2
    # Rows of the second eye become rays of their own only at times without a row of the first eye.
    is_alone = ~_find_nearest(_read_times(first, options, builder), second.times, tolerance)[1]
    builder.count_lines(int((~is_alone).sum()))
    add(second.select(is_alone))
    for samples in iterate(first):
        nearest, is_paired = _find_nearest(second.times, samples.times, tolerance)
        add(*_average_eyes(samples, second.select(nearest), is_paired))


def _read_times(gaze: _Gaze, options: BidsOptions, builder: RaysBuilder) -> np.ndarray:
    """Read the times of a file in seconds, (n,), without its other columns."""
    skip = None if builder.on_bad_line is None else lambda line, reason: None  # recorded when its samples are read
    blocks = iterate_table(gaze.path, [TIME], (), gaze.columns, skip, separator="\t")
    return gaze.get_tick(options) * np.concatenate([np.zeros(0), *(block.numbers[:, 0] for block in blocks)])


def _find_interval(times: np.ndarray) -> float:
    """The median interval of times (n,) that increase; 0 if none does."""
    steps = np.diff(times)
    steps = steps[steps > 0]
    return float(np.median(steps)) if len(steps) else 0.0


def _find_nearest(times: np.ndarray, wanted: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Indices (n,) of the nearest of ``times`` (m,) for each of the times ``wanted`` (n,), and whether it is within the
    ``tolerance``, (n,) bool."""
    rows = np.flatnonzero(np.isfinite(times))
    if not len(rows):
        return np.zeros(len(wanted), np.int64), np.zeros(len(wanted), bool)
    rows = rows[np.argsort(times[rows], kind="stable")]
    after = np.clip(np.searchsorted(times[rows], wanted), 1, max(len(rows) - 1, 1))
    candidates = rows[np.minimum(np.stack([after - 1, after]), len(rows) - 1)]
    distances = np.abs(times[candidates] - wanted)
    is_after = distances[1] < distances[0]
    return np.where(is_after, candidates[1], candidates[0]), distances.min(axis=0) <= tolerance


def _average_eyes(first: _Samples, second: _Samples, is_paired: np.ndarray) -> tuple[_Samples, np.ndarray]:
    """One sample for each of both eyes (n): from midway between these along the mean of their directions, or of the eye
    that was seen, if the other was not or is not paired; and the distance between the eyes, (n,), NaN if unknown."""
    is_seen = np.stack([first.is_seen, second.is_seen & is_paired], axis=1)
    is_both = is_seen.all(axis=1)

    def average(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return poses.average_eyes(np.where(is_seen[..., None], np.stack([a, b], axis=1), np.nan))

    normalize = lambda v: v / np.linalg.norm(v, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        direction = average(normalize(first.direction), normalize(second.direction))
    origin = average(first.origin, second.origin)
    hit, head = first.hit, first.head
    if first.hit is not None and second.hit is not None:
        hit = average(first.hit, second.hit)
        # Between points on two surfaces there is no surface.
        depths = [np.linalg.norm(point - origin, axis=1) for point in (first.hit, second.hit)]
        hit[is_both & (np.abs(depths[0] - depths[1]) > _MAX_DEPTH_DIFFERENCE * np.minimum(*depths))] = np.nan
    if first.head is not None and second.head is not None:
        head = average(first.head, second.head)
    confidence = first.confidence
    if first.confidence is not None and second.confidence is not None:
        values = np.stack([first.confidence, second.confidence], axis=1)
        confidence = np.where(is_seen, values, 1.0).min(axis=1)
    distance = np.linalg.norm(second.origin - first.origin, axis=1)
    distance[~is_both | (distance == 0)] = np.nan  # 0: both are the position of the head
    drop = {**first.drop, "no eye was seen": ~is_seen.any(axis=1)}
    samples = _Samples(first.times, origin, direction, first.lines, confidence, hit, head, drop)
    return samples, distance


def _iterate_samples(
    dataset: _Dataset,
    gaze: _Gaze,
    frame: TrackingFrame,
    options: BidsOptions,
    builder: RaysBuilder,
    tracks: dict[Path, PoseTrack],
) -> Iterator[_Samples]:
    """Iterate over the samples of a file of gaze block by block; ``tracks`` caches the poses of the head."""
    has_rays = gaze.has_rays
    track, start, forward = None, 0.0, np.zeros(3)
    if not has_rays:
        motion = _find_motion(dataset, gaze, options)
        forward = motion.get_axes(options)[1]
        if motion.path not in tracks:
            tracks[motion.path] = _read_track(dataset, motion, frame.handedness, builder)
        track = tracks[motion.path]
        start = _find_start(dataset, gaze, motion)
    has_point = gaze.has(*POINT)
    angles = gaze.system == "eye-in-head" and not has_point
    if not has_rays and not has_point and not (angles and gaze.has(*POINT[:2])):
        raise NergError(f'"{gaze.path}" has no columns {", ".join(POINT)}; rays in the world need them')
    groups = [group for group in (ORIGIN, DIRECTION) if has_rays]
    groups += [POINT[: 2 if angles else 3]] if angles or has_point else []
    groups += [HEAD] if has_rays and gaze.has(*HEAD) else []
    numbers = [TIME, *(name for group in groups for name in group), *([CONFIDENCE] if gaze.has(CONFIDENCE) else [])]
    take = lambda v, names: v[:, [numbers.index(name) for name in names]]
    tick, first = gaze.get_tick(options), None
    dataset.begin(gaze.path)
    for v, _, lines in builder.read_table(gaze.path, numbers, header=gaze.columns, separator="\t"):
        t, drop, head = tick * v[:, 0], {}, None
        point = take(v, POINT) if has_point else None
        if track is None:
            origin, direction = take(v, ORIGIN), take(v, DIRECTION)
            head = take(v, HEAD) if HEAD in groups else None
        else:
            finite = v[:, 0][np.isfinite(v[:, 0])]
            first = finite[0] if first is None and len(finite) else first
            since = np.full(len(t), np.nan) if first is None else start + tick * (v[:, 0] - first)
            rotation, origin, has_no_pose = track.interpolate(since, _MAX_POSE_GAP)
            drop = {"there is no pose of the head at that time": has_no_pose}
            head = rotation @ forward
            if gaze.system == GAZE_IN_WORLD:
                assert point is not None
                direction = point - origin
            else:
                local = _directions_in_head(gaze, take(v, POINT[:2]), frame, forward) if angles else point
                assert local is not None
                direction, point = poses.rotate(rotation, local), None
        confidence = v[:, -1] if gaze.has(CONFIDENCE) else None
        yield _Samples(t, origin, direction, lines, confidence, point, head, drop)


def _directions_in_head(gaze: _Gaze, angles: np.ndarray, frame: TrackingFrame, forward: np.ndarray) -> np.ndarray:
    """Directions (n, 3), in the frame of the head at rest, of angles (n, 2) to the right and up."""
    units = gaze.get_units(POINT[0]).lower()
    if not units.startswith(("deg", "rad")):
        raise NergError(
            f'"{gaze.path}" has the eye in the head in {sanitize(units, 40) or "no units"}; rays need angles (deg or '
            "rad), or a direction with z_coordinate"
        )
    name = next(name for name, axis in poses.AXES.items() if np.array_equal(axis, forward))
    return poses.directions_from_azimuths(angles, frame.up, name, frame.handedness, degrees=units.startswith("deg"))


def _add_heads(
    dataset: _Dataset, motion: _Motion, frame: TrackingFrame, options: BidsOptions, builder: RaysBuilder
) -> None:
    """Add the directions of a head as rays."""
    person, cohort = _find_person(dataset, BidsName.parse(motion.path.name), motion.metadata)
    forward = motion.get_axes(options)[1]
    for block in _iterate_poses(dataset, motion, frame.handedness, builder):
        builder.add(
            block.times,
            person,
            block.positions,
            block.rotations @ forward,
            rows=block.rows,
            tracking="head",
            cohort=None if cohort is None else np.full(len(block.times), cohort),
        )


def _find_start(dataset: _Dataset, gaze: _Gaze, motion: _Motion) -> float:
    """Seconds from the first pose to the first sample of gaze. Raises `NergError` if it is not stated."""
    times = [dataset.find_acquisition_time(path) for path in (gaze.path, motion.path)]
    if times[0] is not None and times[1] is not None:
        return times[0] - times[1]
    start = gaze.metadata.get("StartTime")
    if not isinstance(start, (int, float)):
        raise NergError(
            f'neither "StartTime" of "{gaze.path}" nor acq_time in scans.tsv states when it starts; add one of them'
        )
    return float(start)


def _find_person(dataset: _Dataset, name: BidsName, metadata: dict[str, Any]) -> tuple[str, str | None]:
    """Name and cohort of the participant of a file."""
    label = name.get("sub")
    if not label:
        raise NergError(f'"{dataset.path}" has a recording without a participant (sub-<label>) in its name; rename it')
    row = dataset.participants.get(f"sub-{label}", {})
    stated = lambda text: text if text and text != "n/a" else None
    cohort = metadata.get("Cohort")
    return stated(row.get(SOURCE_NAME)) or f"sub-{label}", str(cohort) if cohort else stated(row.get(GROUP))
