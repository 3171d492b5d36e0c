"""Glasses with a scene camera: gaze in its frame, with camera poses from a reconstruction of the environment.

- ``--frames`` names the video's frames in the model: ``{frame1}`` is the frame number from 1 (as ffmpeg counts),
  ``{frame0}`` from 0, ``{s}`` seconds from the first frame, ``{ns}`` a time stamp; ``*`` matches anything,
  ``{recording}`` the name of the recording's folder.
- Numbers count all frames of the video, with the recording's own times. With ``--fps`` they count what ffmpeg's
  ``fps`` filter shows, up to half a frame later. An offset of one frame is not detected and costs the head's
  rotation in 1/30 s.
- ``--field`` applies the training's rotation and scale. Without it, rays are in the file's coordinates times
  ``--scale``.
- ``--poses`` may be ``aligned_poses.csv`` of tag-aligner (github: pupil-labs/tag-aligner) or ``camera_pose.json`` of
  the Reference Image Mapper; both need an alignment.
- A ray starts at the scene camera's centre and passes through the gaze point of the video. Poses are interpolated
  between frames at most 0.2 s apart (``gap`` in Python); rows farther away are dropped, as are blinks, glasses not
  worn, and gaze outside the image.
- Pixels through the lens are compared with the angles (Neon) or 3D gaze (Tobii) of the file; a median difference
  above one degree is reported as a foreign calibration.
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.safe_read import BadLineCallback, read_json
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.maths.transforms import check_rigid_transforms
from nerg_mi.photos.cameras import Intrinsics, undistort_with_mask
from nerg_mi.photos.colmap import estimate_up, find_pose_source, read_named_poses
from nerg_mi.ranges import LENGTHS, RATES, Range, ValidatedDataclass

from . import poses
from .base import RaysBuilder, TrackingFrame, option
from .poses import PoseTrack
from .tables import iterate_table

# ---- Frames of a recording's video among the images of a model, and their times, by file names ----

_FIELDS = {
    "{frame0}": r"(?P<frame0>\d{1,12})",
    "{frame1}": r"(?P<frame1>\d{1,12})",
    "{s}": r"(?P<s>\d{1,12}(?:\.\d{1,12})?)",
    "{ns}": r"(?P<ns>\d{1,20})",
}
_FRAMES_HELP = (
    "write the names of the video's frames with {frame0} or {frame1} (frame number in the video, from 0 or 1), "
    "{s} (seconds since its first frame) or {ns} (the recording's time stamps), * for other varying parts and "
    '{recording} for the recording\'s name: "frame_{frame1}"'
)


@dataclass(frozen=True)
class FrameNames:
    """``pattern``: the end of a frame's path without its suffix, with one of the fields in `_FRAMES_HELP`."""

    pattern: str

    def __post_init__(self) -> None:
        if sum(self.pattern.count(field) for field in _FIELDS) != 1:
            raise NergError(f'{parameter("frames")} is "{sanitize(self.pattern, 80)}"; {_FRAMES_HELP}')

    @classmethod
    def parse(cls, text: str) -> FrameNames:
        return cls(text)

    def __str__(self) -> str:
        return self.pattern

    @property
    def has_recording(self) -> bool:
        """Whether names contain the recording of a frame."""
        return "{recording}" in self.pattern

    @property
    def needs_frame_times(self) -> bool:
        """Whether times follow from the times of the video's frames."""
        return "{ns}" not in self.pattern

    def compute_times(
        self, names: Sequence[str], recording: str, frames: np.ndarray | None, fps: float | None, start: float
    ) -> np.ndarray:
        """Times (N,) in seconds on the recording's clock of images, NaN for images that are not frames of its video.

        Parameters
        ----------
        names
            Names of the images.
        recording
            Name of the recording.
        frames
            Times of the video's frames (F,) in seconds, or None if unknown.
        fps
            Constant rate to which the video was resampled with FFmpeg's filter ``fps``, and to which numbers refer.
        start
            Origin of {ns}, in nanoseconds.

        Raises
        ------
        NergError
            If no name matches, or a frame number does not exist.
        """
        parts = re.split(r"(\{frame0\}|\{frame1\}|\{s\}|\{ns\}|\{recording\}|\*)", self.pattern)
        patterns = {**_FIELDS, "{recording}": re.escape(recording), "*": "[^/]*"}
        pattern = re.compile(
            r"(?:.*/)?" + "".join(patterns.get(p, re.escape(p)) for p in parts) + r"(?:\.[A-Za-z0-9]+)?"
        )
        out = np.full(len(names), np.nan)
        for i, name in enumerate(names):
            match = pattern.fullmatch(name[:4096])
            if match is not None:
                ((kind, text),) = match.groupdict().items()
                out[i] = self._compute_time(kind, text, name, frames, fps, start)
        if not np.isfinite(out).any():
            names_text = ", ".join(sanitize(n, 60) for n in names[:3])
            raise NergError(
                f'no image of the model is called "{sanitize(self.pattern, 80)}" for the recording '
                f'"{sanitize(recording, 60)}" (its first are {names_text}); correct {parameter("frames")}: '
                f"{_FRAMES_HELP}"
            )
        return out

    def _compute_time(
        self, kind: str, text: str, name: str, frames: np.ndarray | None, fps: float | None, start: float
    ) -> float:
        if kind == "ns":
            return (int(text) - int(start)) * 1e-9
        if kind == "s":
            return float(text) + (0.0 if frames is None or not len(frames) else float(frames[0]))
        index = int(text) - (kind == "frame1")
        if frames is None and fps is None:
            raise NergError(
                "the times of the video's frames are unknown, but the names contain frame numbers; put the file "
                "with them next to the gaze (Tobii: the scene video, Neon: world_timestamps.csv), or set a "
                f"constant rate with {parameter('fps')}"
            )
        if frames is None and fps is not None and index >= 0:
            return index / fps
        position = index if fps is None or frames is None else _find_resampled_frame(index, frames, fps)
        if frames is None or not 0 <= position < len(frames):
            detail = "" if frames is None else f", which has {len(frames)}"
            detail += "" if fps is None else f" (at {fps:g} per second)"
            raise NergError(
                f'"{sanitize(name, 80)}" is frame {index} of the video, counted from 0{detail}; check '
                f"{parameter('frames')}, and {parameter('fps')} if not every frame was extracted"
            )
        return float(frames[position])


def _find_resampled_frame(index: int, frames: np.ndarray, fps: float) -> int:
    """Index of the frame among ``frames`` (F,) that FFmpeg's filter fps shows as its frame ``index``; F if none.

    Each frame is assigned to the nearest tick of the constant rate, and a tick shows the last frame assigned to it or
    to a previous tick: at 5 of 25 frames per second, the third, eighth, thirteenth frame, 0.08 s later than index / 5.
    """
    ticks = np.floor((frames - frames[0]) * fps + 0.5)
    # The duration of the last frame is assumed to be the median.
    lasting = np.median(np.diff(frames)) if len(frames) > 1 else 0.0
    if index > np.floor((frames[-1] - frames[0] + lasting) * fps + 0.5):
        return len(frames)
    return int(np.searchsorted(ticks, index, side="right")) - 1


# ---- From the coordinates of a model's file to those of a scene that was trained from it ----


@dataclass(frozen=True, eq=False)
class SceneCoordinates:
    """Coordinates of a trained scene: x_scene = scale * rotation @ x_file + shift.

    ``scale`` is the length of a unit of the file in the scene, ``rotation`` is (3, 3), ``shift`` (3,) in units of the
    scene. ``up`` is the up direction (3,) in the scene, if known from training; ``sha256`` is that of the model that
    the scene was trained on.
    """

    scale: float
    rotation: np.ndarray
    shift: np.ndarray
    up: np.ndarray | None = None
    sha256: str | None = None

    @classmethod
    def from_scale(cls, scale: float) -> SceneCoordinates:
        """Coordinates of the file in another unit. Raises `NergError` for an invalid scale."""
        if not (np.isfinite(scale) and 1e-9 <= scale <= 1e9):
            raise NergError(
                f"the length of the model's unit in metres must be positive, got {scale} ({parameter('scale')})"
            )
        return cls(scale, np.eye(3), np.zeros(3))

    @classmethod
    def from_checkpoint(cls, path: Path) -> SceneCoordinates:
        """Read the coordinates from the provenance of a radiance checkpoint. Raises `NergError` if they are missing."""
        provenance = read_checkpoint(path, "radiance")[1].get("provenance")
        provenance = provenance if isinstance(provenance, dict) else {}
        try:
            to_file = provenance["to_file"]
            up = None if provenance.get("up") is None else np.array(provenance["up"], np.float64).reshape(3)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise NergError(
                f'the checkpoint "{path}" does not contain the coordinates of its training; use '
                f"{parameter('scale')} instead of {parameter('place')} if it was trained in those of its file, or "
                "train it again"
            ) from error
        to_file = check_rigid_transforms(to_file, f'"to_file" of the checkpoint "{path}"', may_scale=True, shape=(4, 4))
        scale = float(np.cbrt(np.linalg.det(to_file[:3, :3])))
        rotation = to_file[:3, :3].T / scale
        sha256 = provenance.get("sha256")
        up = up if up is not None and np.isfinite(up).all() and np.linalg.norm(up) > 0.5 else None
        return cls(
            1 / scale, rotation, -rotation @ to_file[:3, 3] / scale, up, sha256 if isinstance(sha256, str) else None
        )

    def transform_points(self, points: np.ndarray) -> np.ndarray:
        """Transform points (N, 3) of the file to the scene."""
        return self.scale * points @ self.rotation.T + self.shift


# ---- Directions of pixels and angles of a scene camera, in OpenCV's frame: x right, y down, z forward ----

_NUM_COEFFICIENTS = 8  # k1 k2 p1 p2 k3 k4 k5 k6
_MAX_CALIBRATION_VALUE = 1e6


@dataclass(frozen=True)
class SceneCamera:
    """A calibrated camera. Pixels are those of OpenCV: the centre of the first one is (0, 0)."""

    lens: Intrinsics

    @classmethod
    def from_opencv(
        cls, matrix: object, coefficients: object, size: Sequence[float] | None = None, where: str = "the calibration"
    ) -> SceneCamera:
        """Make a camera from OpenCV's calibration.

        Parameters
        ----------
        matrix
            Camera matrix (3, 3).
        coefficients
            At most eight distortion coefficients, k1 k2 p1 p2 k3 k4 k5 k6. Further ones, those of thin prisms and
            tilted sensors, must be zero.
        size
            Width and height in pixels. Default: any pixel is inside.
        where
            Source of the calibration, for messages.

        Raises
        ------
        NergError
            For an invalid calibration.
        """
        try:
            k = np.asarray(matrix, np.float64).reshape(3, 3)
            d = np.zeros(0) if coefficients is None else np.asarray(coefficients, np.float64).ravel()
            w, h = (0.0, 0.0) if size is None else (float(x) for x in size)
        except (TypeError, ValueError, OverflowError) as error:
            raise NergError(f"{where} needs a camera matrix of 3 x 3 numbers and distortion coefficients") from error
        numbers = np.concatenate([k.ravel(), d, [w, h]])
        if not (
            np.isfinite(numbers).all()
            and np.abs(numbers).max() <= _MAX_CALIBRATION_VALUE
            and min(k[0, 0], k[1, 1]) > 1e-3
        ):
            raise NergError(f"{where} has no positive focal lengths, or implausible numbers; export it again")
        if k[0, 1] != 0 or d[_NUM_COEFFICIENTS:].any():
            raise NergError(
                f"{where} has a skew, or coefficients beyond OpenCV's rational model of eight, which are not supported"
            )
        k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(d[:_NUM_COEFFICIENTS], (0, max(0, _NUM_COEFFICIENTS - len(d)))).tolist()
        fx, fy, cx, cy = (float(x) for x in (k[0, 0], k[1, 1], k[0, 2], k[1, 2]))
        return cls(Intrinsics(int(w), int(h), fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6))

    def compute_directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (n, 3) of ``pixels`` (n, 2); NaN outside the image or the field of view of the lens."""
        lens = self.lens
        is_inside = np.isfinite(pixels).all(axis=1)
        if lens.width and lens.height:
            with np.errstate(invalid="ignore"):
                is_inside &= ((pixels >= -0.5) & (pixels <= [lens.width - 0.5, lens.height - 0.5])).all(axis=1)
        out = np.full((len(pixels), 3), np.nan)
        xy, is_visible = undistort_with_mask((pixels[is_inside] - [lens.cx, lens.cy]) / [lens.fx, lens.fy], lens)
        d = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        out[is_inside] = np.where(is_visible[:, None], d / np.linalg.norm(d, axis=1, keepdims=True), np.nan)
        return out


def directions_from_angles(angles: np.ndarray) -> np.ndarray:
    """Unit directions (n, 3) of azimuths (to the right) and elevations (up), (n, 2) in degrees."""
    azimuth, elevation = np.radians(angles).T
    return np.stack(
        [np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)], axis=1
    )


def angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles (n,) in degrees between vectors (n, 3) of any length, also accurate for small angles. NaN for NaN."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1)))


# ---- Timed poses ----
#
# Poses of a scene camera with their times, from tag-aligner or Pupil Cloud's Reference Image Mapper.
#
# Both contain the camera-to-world pose of each interval of the recording, in OpenCV's axes, and in the unit of a tag or
# in an unknown unit. Times are seconds from the recording's start. ``poses.p`` of the same tools is a pickle, which can
# execute code, and is never read.

_POSITION_KEYS = tuple(f"translation_{a}" for a in "xyz")
_QUATERNION_KEYS = tuple(f"rotation_{a}" for a in "xyzw")
_ROTATION_VECTOR_KEYS = _QUATERNION_KEYS[:3]


def is_timed_pose_file(path: Path) -> bool:
    """Whether the name is that of a file of timed poses, instead of a model."""
    return path.suffix.lower() in (".csv", ".p") or path.name == "camera_pose.json"


def read_timed_poses(path: Path, on_bad_line: BadLineCallback | None = None) -> tuple[PoseTrack, int]:
    """Read the track in ``aligned_poses.csv`` or ``camera_pose.json``, and the number of poses in the file.

    A pose is that of the frame at ``start_timestamp``. Raises `NergError` for another file, or fewer than two poses.
    """
    if path.suffix.lower() == ".p":
        raise NergError(f"{path} is a pickle, which can execute code; use aligned_poses.csv next to it instead")
    times, vectors, positions = (
        _read_csv_poses(path, on_bad_line) if path.suffix.lower() == ".csv" else _read_json_poses(path)
    )
    track = PoseTrack.from_samples(times, vectors, positions)
    if track is None:
        raise NergError(f"{path} has {len(times)} poses; interpolation needs at least two complete ones")
    return track, len(times)


def _read_csv_poses(path: Path, on_bad: BadLineCallback | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    from scipy.spatial.transform import Rotation

    blocks = iterate_table(path, ["start_timestamp", *_POSITION_KEYS, *_QUATERNION_KEYS], on_bad_line=on_bad)
    rows = np.concatenate([block.numbers for block in blocks] or [np.empty((0, 8))])
    length = np.linalg.norm(rows[:, 4:], axis=1)
    is_valid = np.isfinite(length) & (length > 1e-12)
    vectors = np.full((len(rows), 3), np.nan)
    if is_valid.any():
        vectors[is_valid] = Rotation.from_quat(rows[is_valid, 4:]).as_rotvec()
    return rows[:, 0], vectors, rows[:, 1:4]


def _read_json_poses(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    content: Any = read_json(path, "file of camera poses")
    if isinstance(content, dict):
        content = content.get("result")
    try:
        rows = np.array(
            [
                [float(pose[key]) for key in ("start_timestamp", *_ROTATION_VECTOR_KEYS, *_POSITION_KEYS)]
                for pose in content
            ],
            np.float64,
        ).reshape(-1, 7)
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise NergError(
            f'"{path}" is not a list of camera poses with start_timestamp, translation_x, y, z and rotation_x, y, z; '
            "download camera_pose.json again"
        ) from error
    return rows[:, 0], rows[:, 1:4], rows[:, 4:]


# ---- Scene gaze ----
#
# Common part of the readers of glasses with a scene camera: camera poses, and the conversion of gaze in its frame.
#
# The poses are from a model in which frames of the scene video were registered together with the photos of the
# environment, so that no alignment is needed: rays are in the coordinates of the trained scene.

_OPENCV = np.diag([1.0, -1.0, -1.0])  # from an OpenCV camera's frame to an OpenGL one's
_FRAME_TOLERANCE = 1e-6  # seconds; nearer to a frame with a pose, no interpolation is needed
_MAX_TILT = 25.0  # degrees between the up direction of the scene and the declared one
_MAX_DIFFERENCE = 1.0  # degrees between two representations of the same gaze
_MAX_COMPARED_ROWS = 1 << 20  # rows of a recording for this comparison


@dataclass(frozen=True, kw_only=True)
class SceneCameraOptions(ValidatedDataclass):
    """Options for the poses of the scene camera. Raises `NergError` for invalid or contradictory values."""

    poses: Path | None = option(  # required
        None,
        "Poses of the scene camera: the transforms.json or the COLMAP folder of a structure-from-motion model of the "
        "environment's photos and frames of the scene video; for recordings of Neon also aligned_poses.csv (written by "
        "tag-aligner) or camera_pose.json (by the Reference Image Mapper).",
    )
    frames: FrameNames | None = option(
        None,
        'Names of the video\'s frames in the model: "frame_{frame1}" (number from 1; {frame0}: from 0), {s} '
        "(seconds) or {ns} (time stamps); * for other parts, {recording} for the recording's name.",
        parse=FrameNames.parse,
        is_recorded=False,
    )
    fps: float | None = option(
        None,
        "Frames per second to which the video was resampled (ffmpeg -vf fps=5), if frame numbers count these frames.",
        default_text="they count the video's frames",
        within=RATES,
    )
    place: Path | None = option(
        None,
        "Radiance field of the scene (.safetensors of nerg train radiance). Rays are in the coordinates of its "
        "training.",
        flag="--field",
    )
    scale: float = option(
        1.0, "Without --field: length of one unit of the camera model in metres, as in training.", within=LENGTHS
    )
    gap: float = option(
        0.2,
        "Maximum time between two posed frames to interpolate over, in seconds.",
        flag="",
        within=Range(1e-06, 3600),
    )
    up: str = option("z", "Up axis: x, y, z, -x, -y or -z.", is_recorded=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.place is not None and self.scale != 1.0:
            raise NergError(
                f"the checkpoint contains the scale; leave out {parameter('scale')}, or {parameter('place')}"
            )

    @property
    def frame(self) -> TrackingFrame:
        """Frame of the scene, with the declared up axis."""
        return TrackingFrame(up=self.up)


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """A recording: its ``name`` (that of its folder), the ``person`` who wore the glasses, the times of the scene
    video's ``frames`` (F,) in seconds on the clock of the gaze, or None, and ``start``, the zero of this clock in
    nanoseconds: the recording's start or, if that is unknown (``starts_with_video``), the first frame.
    """

    name: str
    person: str
    frames: np.ndarray | None = None
    start: float = 0.0
    starts_with_video: bool = False


@dataclass(frozen=True, eq=False)
class GazeBlock:
    """n rows of a recording: times ``t`` in seconds, gaze ``direction`` (n, 3) in the scene camera's frame (OpenCV),
    NaN outside its image, row numbers ``rows`` from 1, and reasons of the format to ``drop`` rows. ``other_direction``
    is another representation of the gaze in the file, for comparison."""

    t: np.ndarray
    direction: np.ndarray
    rows: np.ndarray
    drop: Mapping[str, np.ndarray]
    other_direction: np.ndarray | None = None


class SceneGaze:
    """Converts the gaze of one recording block by block, with camera poses in the coordinates of the scene."""

    def __init__(
        self, options: SceneCameraOptions, recording: Recording, builder: RaysBuilder, summaries: list[dict[str, Any]]
    ) -> None:
        """``summaries`` are those of the previous recordings; that of this one is appended."""
        self._builder, self._options, self._summaries = builder, options, summaries
        self._person = recording.person
        self._angles: list[np.ndarray] = []
        self._num_compared = 0
        self._track = _make_camera_track(options, recording, builder)

    def add(self, block: GazeBlock) -> None:
        """Add rows as rays in the scene, and compare the two representations of their gaze, if there are two."""
        rotation, position, has_no_pose = self._interpolate(block.t)
        direction = block.direction
        is_outside = np.asarray(~np.isfinite(direction).all(axis=1))
        drop = {**block.drop, "gaze lies beyond the scene camera's picture": is_outside}
        if block.other_direction is not None and self._num_compared < _MAX_COMPARED_ROWS:
            self._num_compared += len(block.t)
            with np.errstate(invalid="ignore"):
                angles = angles_between(direction, block.other_direction)
            self._angles.append(angles[np.isfinite(angles) & ~np.any(list(drop.values()), axis=0)])
        drop["no frame of the scene camera near that time has a pose (option gap)"] = has_no_pose
        ray = poses.rotate(rotation, direction)
        head = rotation[:, :, 2]
        self._builder.add(block.t, self._person, position, ray, rows=block.rows, tracking="eye", head=head, drop=drop)

    def finish(self, compared: str) -> None:
        """Add to the metadata the number of frames with a pose, and the difference between the two representations of
        the gaze, named by ``compared``, if there are two; a median above `_MAX_DIFFERENCE` gives a warning."""
        summary: dict[str, Any] = {"posed_frames": len(self._track.times)}
        differences = np.concatenate(self._angles or [np.empty(0)])
        median = 0.0
        if differences.size:
            median, p95 = (round(float(x), 4) for x in np.percentile(differences, [50, 95]))
            summary |= {"compared": compared, "median_degrees": median, "p95_degrees": p95}
        self._summaries.append(summary)
        self._builder.add_metadata(
            scene_camera=self._summaries, frames=str(self._options.frames or ""), floor="unknown"
        )
        if median > _MAX_DIFFERENCE:
            self._builder.add_warning(
                f"{compared} of the same gaze differ by {median:.1f} degrees (median): is the calibration that of "
                "these glasses, and for images of this size?"
            )

    def _interpolate(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `PoseTrack.interpolate`, but without poses between frames that are farther apart than the maximum gap."""
        rotation, position, is_missing = self._track.interpolate(t, self._options.gap)
        times = self._track.times
        after = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
        nearest = np.minimum(np.abs(t - times[after]), np.abs(t - times[after - 1]))
        is_gap = times[after] - times[after - 1] > self._options.gap
        return rotation, position, is_missing | (is_gap & (nearest > _FRAME_TOLERANCE))


def _make_camera_track(options: SceneCameraOptions, recording: Recording, builder: RaysBuilder) -> PoseTrack:
    """Make the track of camera poses in the scene, with OpenCV's camera axes."""
    from scipy.spatial.transform import Rotation

    if options.poses is None:
        raise NergError(
            "the poses of the scene camera are required: specify the model in which frames of its video were "
            f"registered with the photos of the environment ({parameter('poses', 'transforms.json')})"
        )
    to_scene = SceneCoordinates.from_scale(options.scale)
    if options.place is not None:
        to_scene = SceneCoordinates.from_checkpoint(options.place)
        builder.begin_source(options.place)
    if is_timed_pose_file(options.poses):
        if recording.starts_with_video:
            raise NergError(
                f'the poses of "{options.poses}" are relative to the start of the recording '
                f'"{sanitize(recording.name, 60)}", which is unknown; put its info.json next to the gaze'
            )
        builder.begin_source(options.poses)
        track, count = read_timed_poses(options.poses, builder.on_bad_line)
        builder.count_lines(count)
        up = to_scene.up
    else:
        track, up = _read_model_track(options, recording, to_scene, builder)
    _check_up_axis(up, options, builder)
    rotation = Rotation.from_matrix(to_scene.rotation) * Rotation.from_rotvec(track.rotation_vectors)
    return PoseTrack(track.times, rotation.as_rotvec(), to_scene.transform_points(track.positions))


def _read_model_track(
    options: SceneCameraOptions, recording: Recording, to_scene: SceneCoordinates, builder: RaysBuilder
) -> tuple[PoseTrack, np.ndarray | None]:
    """Read the track of the model's frames in its own coordinates, and the up direction in the scene."""
    from scipy.spatial.transform import Rotation

    assert options.poses is not None
    model = read_named_poses(find_pose_source(options.poses))
    builder.begin_source(model.path)
    for note in model.notes:
        builder.add_warning(note)
    if options.frames is None:
        raise NergError(
            f'the images of "{model.path}" that are frames of the video, and their times, must be specified, as '
            f"with {parameter('frames', 'frame_{frame1}')}; first images: "
            f"{', '.join(sanitize(n, 60) for n in model.names[:3])}"
        )
    times = options.frames.compute_times(model.names, recording.name, recording.frames, options.fps, recording.start)
    if recording.frames is None and options.frames.needs_frame_times:
        rate = "" if options.fps is None else f", at exactly {options.fps:g} per second"
        builder.add_warning(
            f"the times of the video's frames are unknown; they are counted from the start of the gaze's clock{rate}; "
            "put the file with them next to the gaze (Tobii: the scene video, Neon: world_timestamps.csv)"
        )
    rotations = Rotation.from_matrix(model.to_world[:, :3, :3] @ _OPENCV)
    track = PoseTrack.from_samples(times, rotations.as_rotvec(), model.to_world[:, :3, 3])
    if track is None:
        raise NergError(
            f'only one image of "{model.path}" is a frame of the recording "{sanitize(recording.name, 60)}"; '
            "interpolation needs at least two: register more of them"
        )
    if to_scene.sha256 is not None and to_scene.sha256 != model.sha256:
        builder.add_warning(
            f'the scene was trained on another file than "{model.path.name}": are its coordinates the same? If it was '
            "registered again, train the scene on the new file"
        )
    if to_scene.up is None:
        estimate = estimate_up(model.to_world, np.zeros((0, 3)))
        up = to_scene.rotation @ estimate.direction if estimate.is_reliable else None
    else:
        up = to_scene.up
    return track, up


def _check_up_axis(up: np.ndarray | None, options: SceneCameraOptions, builder: RaysBuilder) -> None:
    if up is None:
        return
    up = up / np.linalg.norm(up)
    tilt = float(np.degrees(np.arccos(np.clip(up @ poses.parse_axis(options.up, "up"), -1, 1))))
    if tilt > _MAX_TILT:
        axis = max(poses.AXES, key=lambda name: poses.AXES[name] @ up)
        builder.add_warning(
            f"the up direction of the scene is ({', '.join(f'{x:.2f}' for x in up)}), {tilt:.0f} degrees from "
            f"{options.up}: train it with {parameter('coordinates', 'upright')}, or import with "
            f"{parameter('up', axis)} and pass the matrix of {parameter('align_output')} to the training"
        )


# ---- Scene reader ----
#
# Base of readers of glasses with a scene camera: one folder per recording, converted with the poses of its camera.

R = TypeVar("R", bound=Recording)  # Data of a recording that a reader provides


POSE_OPTIONS = {"--poses": "MODEL", "--frames": "frame_{frame1}"}
"""Options of these readers that only the user can set, with placeholders as values."""

POSE_QUESTION = (
    f"the poses of the scene camera: {parameter('poses')} is the model with its frames and the photos of the "
    f"environment, {parameter('frames')} the pattern of their names, {parameter('place')} the scene that was "
    "trained on it"
)
"""Description of these options."""


class SceneReader(ABC, Generic[R]):
    """Base of readers of folders, one per recording of glasses with a scene camera, whose poses are known.

    A format defines the name of its gaze file, opens a recording, and iterates over its gaze in the scene camera's
    frame; this class converts it to rays (see `nerg_mi.tracking.readers.base.Reader`).
    """

    gaze_file: str
    """Name of the gaze file in the folder."""

    compared: str = ""
    """The two representations of the gaze that are compared, as "pixels and angles"; empty if there is only one."""

    frame_description = "that of the scene; `--up` points up"
    Options = SceneCameraOptions

    @abstractmethod
    def open_recording(self, folder: Path, builder: RaysBuilder) -> R:
        """Open the recording in ``folder``; each file that is read is passed to ``builder.begin_source``."""

    @abstractmethod
    def iterate_gaze(self, gaze: Path, recording: R, builder: RaysBuilder) -> Iterable[GazeBlock]:
        """Iterate over the rows of the file ``gaze`` of an open recording."""

    def frame(self, files: Sequence[Path], options: SceneCameraOptions) -> TrackingFrame:
        return options.frame

    def read(self, files: Sequence[Path], options: SceneCameraOptions, builder: RaysBuilder) -> None:
        if len(files) > 1 and (options.frames is None or not options.frames.has_recording):
            raise NergError(
                "frames of several recordings are distinguished by {recording} in their names "
                f"({parameter('frames')}); import the recordings one by one, or use a pattern such as "
                f"{parameter('frames', '{recording}/frame_{frame1}')}"
            )
        summaries: list[dict[str, Any]] = []
        for path in files:
            gaze = path / self.gaze_file if path.is_dir() else path
            if not gaze.is_file():
                raise NergError(
                    f"{gaze} does not exist; specify the folder of a recording, or the {self.gaze_file} in it"
                )
            recording = self.open_recording(gaze.parent, builder)
            scene = SceneGaze(options, recording, builder, summaries)
            builder.begin_source(gaze, f"{recording.person}/{gaze.name}")
            for block in self.iterate_gaze(gaze, recording, builder):
                scene.add(block)
            scene.finish(self.compared)
