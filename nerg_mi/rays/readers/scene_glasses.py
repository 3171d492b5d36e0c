"""Glasses with a scene camera: gaze in its frames, whose poses in the place are known from elsewhere."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import BadLineCallback, read_json
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.photos.cameras import Intrinsics, undistort_with_mask
from nerg_mi.photos.colmap import find_pose_source, estimate_up, read_named_poses
from nerg_mi.ranges import LENGTHS, RATES, ValidatedDataclass, Range

from . import poses
from .base import RaysBuilder, TrackingFrame, option
from .poses import PoseTrack
from .tables import iterate_table

# ---- Which images of a model are frames of a recording's video, and when they were taken, by their names ----

_FIELDS = {
    "{frame0}": r"(?P<frame0>\d{1,12})",
    "{frame1}": r"(?P<frame1>\d{1,12})",
    "{s}": r"(?P<s>\d{1,12}(?:\.\d{1,12})?)",
    "{ns}": r"(?P<ns>\d{1,20})",
}
_HOW = (
    "write the names of the video's frames with {frame0} or {frame1} (their number in the video, counted from 0 or 1), "
    "{s} (seconds from its first frame on) or {ns} (the recording's time stamps), * for what varies besides and "
    '{recording} for the recording\'s name: "frame_{frame1}"'
)


@dataclass(frozen=True)
class FrameNames:
    """``pattern``: the end of a frame's path without its suffix, with one of the fields that `_HOW` names."""

    pattern: str

    def __post_init__(self) -> None:
        if sum(self.pattern.count(field) for field in _FIELDS) != 1:
            raise NergError(f'--frames is "{sanitize(self.pattern, 80)}"; {_HOW}')

    @classmethod
    def parse(cls, text: str) -> FrameNames:
        return cls(text)

    def __str__(self) -> str:
        return self.pattern

    @property
    def of_recording(self) -> bool:
        """Whether names tell which recording a frame is of."""
        return "{recording}" in self.pattern

    @property
    def needs_frames(self) -> bool:
        """Whether names are turned into times by those of the video's frames."""
        return "{ns}" not in self.pattern

    def times(
        self, names: Sequence[str], recording: str, frames: np.ndarray | None, fps: float | None, start: float
    ) -> np.ndarray:
        """Seconds (N,) on the recording's clock at which images of these ``names`` were taken, NaN for those that are
        no frames of the ``recording``.

        ``frames``: seconds of the video's frames, (F,), or None where they are not there. ``fps``: numbers count frames
        of this steady rate, into which FFmpeg's filter of that name has turned the video. ``start``: what {ns} is
        counted from, in nanoseconds. Raises `NergError` where no name fits, or one counts a frame that there is not.
        """
        parts = re.split(r"(\{frame0\}|\{frame1\}|\{s\}|\{ns\}|\{recording\}|\*)", self.pattern)
        known = {**_FIELDS, "{recording}": re.escape(recording), "*": "[^/]*"}
        pattern = re.compile(r"(?:.*/)?" + "".join(known.get(p, re.escape(p)) for p in parts) + r"(?:\.[A-Za-z0-9]+)?")
        out = np.full(len(names), np.nan)
        for i, name in enumerate(names):
            found = pattern.fullmatch(name[:4096])
            if found is not None:
                ((kind, text),) = found.groupdict().items()
                out[i] = self._time(kind, text, name, frames, fps, start)
        if not np.isfinite(out).any():
            shown = ", ".join(sanitize(n, 60) for n in names[:3])
            raise NergError(
                f'no image of the model is called "{sanitize(self.pattern, 80)}" for the recording '
                f'"{sanitize(recording, 60)}" (its first are {shown}); correct --frames: {_HOW}'
            )
        return out

    def _time(
        self, kind: str, text: str, name: str, frames: np.ndarray | None, fps: float | None, start: float
    ) -> float:
        if kind == "ns":
            return (int(text) - int(start)) * 1e-9
        if kind == "s":
            return float(text) + (0.0 if frames is None or not len(frames) else float(frames[0]))
        index = int(text) - (kind == "frame1")
        if frames is None and fps is None:
            raise NergError(
                "the recording has no times of its video's frames, which its numbers count; put the file that has them "
                "beside the gaze (Tobii: the scene video, Neon: world_timestamps.csv), or give a steady rate with --fps"
            )
        if frames is None and fps is not None and index >= 0:
            return index / fps
        position = index if fps is None or frames is None else _resampled(index, frames, fps)
        if frames is None or not 0 <= position < len(frames):
            of = "" if frames is None else f", which has {len(frames)}"
            of += "" if fps is None else f" ({fps:g} a second were counted)"
            raise NergError(
                f'"{sanitize(name, 80)}" is frame {index} of the video, counted from 0{of}; check --frames, and --fps '
                "where not every frame was taken"
            )
        return float(frames[position])


def _resampled(index: int, frames: np.ndarray, fps: float) -> int:
    """Which of the ``frames`` (F,) FFmpeg's filter fps shows as its frame ``index``; F where there is none.

    Each frame goes to the nearest tick of the steady rate, and a tick shows the last frame that came to it or before:
    at five a second of 25, the third, eighth, thirteenth frame, 0.08 s later than a fifth of a second times the index.
    """
    ticks = np.floor((frames - frames[0]) * fps + 0.5)
    # The last frame lasts as long as the others do.
    lasting = np.median(np.diff(frames)) if len(frames) > 1 else 0.0
    if index > np.floor((frames[-1] - frames[0] + lasting) * fps + 0.5):
        return len(frames)
    return int(np.searchsorted(ticks, index, side="right")) - 1


# ---- From the coordinates of a model's file to those in which a place was trained from it ----


@dataclass(frozen=True, eq=False)
class PlaceFrame:
    """``scale``: length in the place of one unit of the file; ``rotation`` (3, 3), ``shift`` (3,) in the place's units:
    place = scale rotation file + shift. ``up``: (3,) in the place, where its training knew it. ``sha256``: of the model
    that it was trained on."""

    scale: float
    rotation: np.ndarray
    shift: np.ndarray
    up: np.ndarray | None = None
    sha256: str | None = None

    @classmethod
    def scaled(cls, scale: float) -> PlaceFrame:
        """The file's own coordinates, in another unit. Raises `NergError` for what is no scale."""
        if not (np.isfinite(scale) and 1e-9 <= scale <= 1e9):
            raise NergError(f"the length of the model's unit in metres is a positive number, got {scale} (--scale)")
        return cls(scale, np.eye(3), np.zeros(3))

    @classmethod
    def of_checkpoint(cls, path: Path) -> PlaceFrame:
        """As the provenance of a radiance checkpoint tells. Raises `NergError` for one that does not."""
        about = read_checkpoint(path, "radiance")[1].get("provenance")
        about = about if isinstance(about, dict) else {}
        try:
            to_file = np.array(about["to_file"], np.float64).reshape(4, 4)
            up = None if about.get("up") is None else np.array(about["up"], np.float64).reshape(3)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise NergError(
                f'the place "{path}" does not say in which coordinates it was trained; give --scale in place of '
                "--place if it was trained in those of its file, or train it anew"
            ) from error
        scale = float(np.cbrt(np.linalg.det(to_file[:3, :3]))) if np.isfinite(to_file).all() else 0.0
        rotation = to_file[:3, :3].T / scale if scale > 1e-9 else np.zeros((3, 3))
        if not np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3:
            raise NergError(f'the coordinates that the place "{path}" names are no similarity; train it anew')
        sha256 = about.get("sha256")
        up = up if up is not None and np.isfinite(up).all() and np.linalg.norm(up) > 0.5 else None
        return cls(
            1 / scale, rotation, -rotation @ to_file[:3, 3] / scale, up, sha256 if isinstance(sha256, str) else None
        )

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the file in the place."""
        return self.scale * points @ self.rotation.T + self.shift


# ---- Where a pixel, or a pair of angles, of a scene camera looks, in OpenCV's frame: x right, y down, z forward ----

_COEFFICIENTS = 8  # k1 k2 p1 p2 k3 k4 k5 k6
_LARGEST = 1e6  # of a calibration's numbers


@dataclass(frozen=True)
class SceneCamera:
    """A calibrated camera: pixels are OpenCV's, the centre of the first one being (0, 0)."""

    lens: Intrinsics

    @classmethod
    def of_opencv(
        cls, matrix: object, coefficients: object, size: Sequence[float] | None = None, where: str = "the calibration"
    ) -> SceneCamera:
        """Of a camera matrix (3, 3) and at most eight coefficients, k1 k2 p1 p2 k3 k4 k5 k6 (those of thin prisms and
        tilted sensors, which follow, must be zero). ``size``: width and height in pixels; without it any pixel is
        taken. Raises `NergError`, naming ``where`` they stand, for what is no calibration."""
        try:
            k = np.asarray(matrix, np.float64).reshape(3, 3)
            d = np.zeros(0) if coefficients is None else np.asarray(coefficients, np.float64).ravel()
            w, h = (0.0, 0.0) if size is None else (float(x) for x in size)
        except (TypeError, ValueError, OverflowError) as error:
            raise NergError(f"{where} needs a camera matrix of 3 x 3 numbers and distortion coefficients") from error
        numbers = np.concatenate([k.ravel(), d, [w, h]])
        if not (np.isfinite(numbers).all() and np.abs(numbers).max() <= _LARGEST and min(k[0, 0], k[1, 1]) > 1e-3):
            raise NergError(f"{where} has no positive focal lengths, or numbers that no camera has; export it again")
        if k[0, 1] != 0 or d[_COEFFICIENTS:].any():
            raise NergError(
                f"{where} has a skew, or coefficients beyond OpenCV's rational model of eight, which are not supported"
            )
        k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(d[:_COEFFICIENTS], (0, max(0, _COEFFICIENTS - len(d)))).tolist()
        fx, fy, cx, cy = (float(x) for x in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
        return cls(Intrinsics(int(w), int(h), fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6))

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (n, 3) of ``pixels`` (n, 2); NaN beyond the picture, and where the lens shows nothing."""
        lens = self.lens
        good = np.isfinite(pixels).all(axis=1)
        if lens.width and lens.height:
            with np.errstate(invalid="ignore"):
                good &= ((pixels >= -0.5) & (pixels <= [lens.width - 0.5, lens.height - 0.5])).all(axis=1)
        out = np.full((len(pixels), 3), np.nan)
        xy, shown = undistort_with_mask((pixels[good] - [lens.cx, lens.cy]) / [lens.fx, lens.fy], lens)
        d = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        out[good] = np.where(shown[:, None], d / np.linalg.norm(d, axis=1, keepdims=True), np.nan)
        return out


def directions_from_angles(angles: np.ndarray) -> np.ndarray:
    """Unit directions (n, 3) of azimuths (to the right) and elevations (up), (n, 2) in degrees."""
    azimuth, elevation = np.radians(angles).T
    return np.stack(
        [np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)], axis=1
    )


def angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees (n,) between vectors (n, 3) of any length; exact for small angles too. NaN where one is not finite."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))


# ---- Timed poses ----
#
# Poses of a scene camera with their times, as tag-aligner and Pupil Cloud's Reference Image Mapper write them.
#
# Both are of each interval of the recording the camera-to-world pose, in OpenCV's axes and in the unit of a tag, or of
# no known unit. Seconds count from the recording's start. ``poses.p``, which the same tools keep, runs code when it is
# opened, and is never read.

_PLACE = tuple(f"translation_{a}" for a in "xyz")
_QUATERNION = tuple(f"rotation_{a}" for a in "xyzw")
_VECTOR = _QUATERNION[:3]


def is_timed(path: Path) -> bool:
    """Whether the name is that of poses with times, and not of a model's."""
    return path.suffix.lower() in (".csv", ".p") or path.name == "camera_pose.json"


def read_timed_poses(path: Path, on_bad: BadLineCallback | None = None) -> tuple[PoseTrack, int]:
    """The track in ``aligned_poses.csv`` or ``camera_pose.json``, and how many poses the file lists.

    A pose holds from ``start_timestamp``, when its frame was taken. Raises `NergError` for a file that is neither, or
    holds fewer than two poses.
    """
    if path.suffix.lower() == ".p":
        raise NergError(f"{path} is a pickle, which may run code, and is not read; give aligned_poses.csv beside it")
    times, vectors, places = _of_csv(path, on_bad) if path.suffix.lower() == ".csv" else _of_json(path)
    track = PoseTrack.of_samples(times, vectors, places)
    if track is None:
        raise NergError(f"{path} holds {len(times)} poses; two that are whole are needed to interpolate between")
    return track, len(times)


def _of_csv(path: Path, on_bad: BadLineCallback | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    from scipy.spatial.transform import Rotation

    blocks = iterate_table(path, ["start_timestamp", *_PLACE, *_QUATERNION], on_bad=on_bad)
    rows = np.concatenate([block.numbers for block in blocks] or [np.empty((0, 8))])
    length = np.linalg.norm(rows[:, 4:], axis=1)
    good = np.isfinite(length) & (length > 1e-12)
    vectors = np.full((len(rows), 3), np.nan)
    if good.any():
        vectors[good] = Rotation.from_quat(rows[good, 4:]).as_rotvec()
    return rows[:, 0], vectors, rows[:, 1:4]


def _of_json(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    found: Any = read_json(path, "file of camera poses")
    if isinstance(found, dict):
        found = found.get("result")
    try:
        rows = np.array(
            [[float(pose[key]) for key in ("start_timestamp", *_VECTOR, *_PLACE)] for pose in found], np.float64
        ).reshape(-1, 7)
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise NergError(
            f'"{path}" is no list of camera poses with start_timestamp, translation_x, y, z and rotation_x, y, z; '
            "download camera_pose.json again"
        ) from error
    return rows[:, 0], rows[:, 1:4], rows[:, 4:]


# ---- Scene gaze ----
#
# What readers of glasses with a scene camera have in common: where that camera was, and gaze in its frame as rays.
#
# The poses come from a model in which frames of the scene video were registered together with the photos of the place,
# so that nothing has to be aligned: rays are in the coordinates that the place was trained in.

_OPENCV = np.diag([1.0, -1.0, -1.0])  # from an OpenCV camera's frame to an OpenGL one's
_AT_A_FRAME = 1e-6  # seconds: so near to a posed frame nothing has to be interpolated
_LEVEL = 25.0  # degrees between up as the place tells it and as it is declared
_DIFFER = 1.0  # degrees between two accounts of one gaze
_COMPARED = 1 << 20  # rows of a recording whose two accounts are compared


@dataclass(frozen=True, kw_only=True)
class SceneCameraOptions(ValidatedDataclass):
    """Where the scene camera was. Raises `NergError` for a scale beside a place, or a rate or gap that is none."""

    poses: Path | None = option(  # needed
        None,
        "The model that holds frames of the scene video and the place's photos: its transforms.json, or the folder of "
        "a COLMAP model; or aligned_poses.csv of tag-aligner, camera_pose.json of the Reference Image Mapper.",
    )
    frames: FrameNames | None = option(
        None,
        'Names of the video\'s frames in the model: "frame_{frame1}" (number from 1; {frame0}: from 0), {s} '
        "(seconds) or {ns} (time stamps); * for anything, {recording} for the recording's name.",
        parse=FrameNames.parse,
        recorded=False,
    )
    fps: float | None = option(
        None,
        "Numbers count frames that ffmpeg's -vf fps=5 took, this many a second, not each frame of the video.",
        within=RATES,
    )
    place: Path | None = option(
        None, "Checkpoint of the place (nerg train radiance): rays are in the coordinates that it was trained in."
    )
    scale: float = option(
        1.0, "Without --place: length of a unit of the model in metres, as in training.", within=LENGTHS
    )
    gap: float = option(
        0.2, "Seconds between posed frames; farther apart, nothing is interpolated.", within=Range(1e-06, 3600)
    )
    up: str = option("z", "Up axis: x, y, z, -x, -y or -z.", recorded=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.place is not None and self.scale != 1.0:
            raise NergError("the checkpoint of the place knows its scale; leave out --scale, or --place")

    @property
    def frame(self) -> TrackingFrame:
        """The frame of the place, whose up is declared."""
        return TrackingFrame(up=self.up)


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """What a reader has found of a recording: its ``name`` (of its folder), the ``person`` who wore the glasses, the
    seconds of the scene video's ``frames`` (F,) on the clock of the gaze, or None, and ``start``, the nanoseconds at
    which that clock is 0: the recording's start, or, where that is not said (``starts_with_video``), the first frame.
    """

    name: str
    person: str
    frames: np.ndarray | None = None
    start: float = 0.0
    starts_with_video: bool = False


@dataclass(frozen=True, eq=False)
class GazeBlock:
    """n rows of a recording: seconds ``t``, gaze ``direction`` (n, 3) in the scene camera's frame (OpenCV), NaN beyond
    its picture, the 1-based ``rows`` of the file, and reasons of the format's own to ``drop`` some. ``other``: the
    direction by another account of the file, to be compared."""

    t: np.ndarray
    direction: np.ndarray
    rows: np.ndarray
    drop: Mapping[str, np.ndarray]
    other: np.ndarray | None = None


class SceneGaze:
    """Gaze of one recording, to be added block by block, with the camera's poses in the place's coordinates."""

    def __init__(
        self, options: SceneCameraOptions, recording: Recording, builder: RaysBuilder, about: list[dict[str, Any]]
    ) -> None:
        """``about``: what is known of the recordings before, to which this one is added."""
        self._builder, self._options, self._about = builder, options, about
        self._person = recording.person
        self._angles: list[np.ndarray] = []
        self._compared = 0
        self._track = _camera_track(options, recording, builder)

    def add(self, block: GazeBlock) -> None:
        """Add rows as rays of the place, and compare the two accounts of them where there are two."""
        turn, place, lost = self._at(block.t)
        direction = block.direction
        beyond = np.asarray(~np.isfinite(direction).all(axis=1))
        drop = {**block.drop, "gaze lies beyond the scene camera's picture": beyond}
        if block.other is not None and self._compared < _COMPARED:
            self._compared += len(block.t)
            with np.errstate(invalid="ignore"):
                angles = angles_between(direction, block.other)
            self._angles.append(angles[np.isfinite(angles) & ~np.any(list(drop.values()), axis=0)])
        drop["no frame of the scene camera near that time has a pose"] = lost
        ray = poses.rotate(turn, direction)
        self._builder.add(block.t, self._person, place, ray, rows=block.rows, head=turn[:, :, 2], drop=drop)

    def finish(self, accounts: str) -> None:
        """Keep in the metadata how many frames were posed and how far the two ``accounts`` of the gaze differ ("pixels
        and angles"), if there were two; beyond a degree, at the median, it is a complaint."""
        about: dict[str, Any] = {"posed_frames": len(self._track.times)}
        found = np.concatenate(self._angles or [np.empty(0)])
        middle = 0.0
        if found.size:
            middle, most = (round(float(x), 4) for x in np.percentile(found, [50, 95]))
            about |= {"compared": accounts, "median_degrees": middle, "p95_degrees": most}
        self._about.append(about)
        self._builder.note(scene_camera=self._about, frames=str(self._options.frames or ""), floor="unknown")
        if middle > _DIFFER:
            self._builder.complain(
                f"{accounts} of the same gaze differ by {middle:.1f} degrees (median): is the calibration that of "
                "these glasses, and of pictures of this size?"
            )

    def _at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `PoseTrack.at`; lost is, too, what lies between posed frames farther apart than the gap."""
        turn, place, lost = self._track.at(t, self._options.gap)
        times = self._track.times
        after = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
        nearest = np.minimum(np.abs(t - times[after]), np.abs(t - times[after - 1]))
        apart = times[after] - times[after - 1] > self._options.gap
        return turn, place, lost | (apart & (nearest > _AT_A_FRAME))


def _camera_track(options: SceneCameraOptions, recording: Recording, builder: RaysBuilder) -> PoseTrack:
    """Where the camera was in the place, OpenCV's axes to the place's."""
    from scipy.spatial.transform import Rotation

    if options.poses is None:
        raise NergError(
            "the scene camera's poses are needed: name the model in which frames of its video were registered with the "
            "place's photos (--poses transforms.json)"
        )
    to_place = PlaceFrame.scaled(options.scale)
    if options.place is not None:
        to_place = PlaceFrame.of_checkpoint(options.place)
        builder.source(options.place)
    if is_timed(options.poses):
        if recording.starts_with_video:
            raise NergError(
                f'the poses of "{options.poses}" count from the start of the recording "{sanitize(recording.name, 60)}", '
                "which no file of it says; put its info.json beside the gaze"
            )
        builder.source(options.poses)
        track, count = read_timed_poses(options.poses, builder.on_bad)
        builder.count_lines(count)
        up = to_place.up
    else:
        track, up = _of_model(options, recording, to_place, builder)
    _check_up(up, options, builder)
    turned = Rotation.from_matrix(to_place.rotation) * Rotation.from_rotvec(track.vectors)
    return PoseTrack(track.times, turned.as_rotvec(), to_place.points(track.places))


def _of_model(
    options: SceneCameraOptions, recording: Recording, to_place: PlaceFrame, builder: RaysBuilder
) -> tuple[PoseTrack, np.ndarray | None]:
    """The track of the model's frames in its own coordinates, and up in the place."""
    from scipy.spatial.transform import Rotation

    assert options.poses is not None
    model = read_named_poses(find_pose_source(options.poses))
    builder.source(model.path)
    for note in model.notes:
        builder.complain(note)
    if options.frames is None:
        raise NergError(
            f'which images of "{model.path}" are frames of the video, and when they were taken, has to be said, such '
            f'as --frames "frame_{{frame1}}"; its first are {", ".join(sanitize(n, 60) for n in model.names[:3])}'
        )
    times = options.frames.times(model.names, recording.name, recording.frames, options.fps, recording.start)
    if recording.frames is None and options.frames.needs_frames:
        rate = "" if options.fps is None else f", {options.fps:g} a second exactly"
        builder.complain(
            f"the recording has no times of its video's frames: they are counted from the start of its clock{rate}; "
            "put the file that has them beside the gaze (Tobii: the scene video, Neon: world_timestamps.csv)"
        )
    turns = Rotation.from_matrix(model.to_world[:, :3, :3] @ _OPENCV)
    track = PoseTrack.of_samples(times, turns.as_rotvec(), model.to_world[:, :3, 3])
    if track is None:
        raise NergError(
            f'one image of "{model.path}" alone is a frame of the recording "{sanitize(recording.name, 60)}"; two are '
            "needed to interpolate between: register more of them"
        )
    if to_place.sha256 is not None and to_place.sha256 != model.sha256:
        builder.complain(
            f'the place was trained on another file than "{model.path.name}": are its coordinates the same? If it was '
            "registered anew, train the place on it"
        )
    if to_place.up is None:
        found = estimate_up(model.to_world, np.zeros((0, 3)))
        up = to_place.rotation @ found.direction if found.is_reliable else None
    else:
        up = to_place.up
    return track, up


def _check_up(up: np.ndarray | None, options: SceneCameraOptions, builder: RaysBuilder) -> None:
    if up is None:
        return
    up = up / np.linalg.norm(up)
    off = float(np.degrees(np.arccos(np.clip(up @ poses.axis(options.up, "up"), -1, 1))))
    if off > _LEVEL:
        axis = max(poses.AXES, key=lambda name: poses.AXES[name] @ up)
        builder.complain(
            f"up in the place is ({', '.join(f'{x:.2f}' for x in up)}), {off:.0f} degrees from {options.up}: train it "
            f"with --coordinates upright, or import with --up {axis} and give training the matrix of --write-align"
        )


# ---- Scene reader ----
#
# What readers of glasses with a scene camera share: a folder a recording, read against the poses of its camera.

R = TypeVar("R", bound=Recording)  # What a reader knows of a recording


POSES = {"--poses": "MODEL", "--frames": "frame_{frame1}"}
"""Options of its readers that no file says, with a word in place of the value."""

WHERE_CAMERA = (
    "where the scene camera was: --poses names the model that holds its frames and the place's photos, --frames how "
    "they are called; --place the place that was trained on it"
)
"""What these are."""


class SceneReader(ABC, Generic[R]):
    """A reader of folders, each a recording of glasses whose scene camera's poses are known in the place.

    A format says what its file of the gaze is called, opens a recording, and gives its gaze block by block in the scene
    camera's frame; whose rays that are in the place is worked out here (`nerg_mi.rays.readers.base.Reader`).
    """

    gaze_file: str
    """Name of the file of the gaze in the folder."""

    accounts: str = ""
    """The two accounts of one gaze that are compared, as "pixels and angles"; empty where there is one."""

    world = "the place's, whose axis `--up` points up"
    Options = SceneCameraOptions

    @abstractmethod
    def open(self, folder: Path, builder: RaysBuilder) -> R:
        """What is known of the recording in ``folder``; each file that is read is named to ``builder.source``."""

    @abstractmethod
    def blocks(self, gaze: Path, recording: R, builder: RaysBuilder) -> Iterable[GazeBlock]:
        """The rows of the file ``gaze`` of an open recording."""

    def frame(self, files: Sequence[Path], options: SceneCameraOptions) -> TrackingFrame:
        return options.frame

    def read(self, files: Sequence[Path], options: SceneCameraOptions, builder: RaysBuilder) -> None:
        if len(files) > 1 and (options.frames is None or not options.frames.of_recording):
            raise NergError(
                "frames of several recordings are told apart by {recording} in their names (--frames); import them one "
                'by one, or name them as in --frames "{recording}/frame_{frame1}"'
            )
        about: list[dict[str, Any]] = []
        for given in files:
            gaze = given / self.gaze_file if given.is_dir() else given
            if not gaze.is_file():
                raise NergError(f"there is no {gaze}; give the folder of a recording, or the {self.gaze_file} in it")
            recording = self.open(gaze.parent, builder)
            scene = SceneGaze(options, recording, builder, about)
            builder.source(gaze, f"{recording.person}/{gaze.name}")
            for block in self.blocks(gaze, recording, builder):
                scene.add(block)
            scene.finish(self.accounts)
