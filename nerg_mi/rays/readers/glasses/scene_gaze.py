"""What readers of glasses with a scene camera have in common: where that camera was, and gaze in its frame as rays.

The poses come from a model in which frames of the scene video were registered together with the photos of the place, so
that nothing has to be aligned: rays are in the coordinates that the place was trained in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain
from nerg_mi.photos.colmap import NamedPoses, find_source, find_up, read_named_poses
from nerg_mi.ranges import LENGTHS, RATES, Checked, Range
from nerg_mi.rays.readers.builder import RaysBuilder
from nerg_mi.rays.readers.frames import Frame
from nerg_mi.rays.readers.options import option
from nerg_mi.rays.readers.parsing import poses
from nerg_mi.rays.readers.parsing.pose_track import PoseTrack

from .frame_names import FrameNames
from .place_frame import PlaceFrame
from .scene_camera import angles_between
from .timed_poses import is_timed, read_timed_poses

_OPENCV = np.diag([1.0, -1.0, -1.0])  # from an OpenCV camera's frame to an OpenGL one's
_AT_A_FRAME = 1e-6  # seconds: so near to a posed frame nothing has to be interpolated
_LEVEL = 25.0  # degrees between up as the place tells it and as it is declared
_DIFFER = 1.0  # degrees between two accounts of one gaze
_COMPARED = 1 << 20  # rows of a recording whose two accounts are compared


@dataclass(frozen=True, kw_only=True)
class SceneOptions(Checked):
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
    def frame(self) -> Frame:
        """The frame of the place, whose up is declared."""
        return Frame(up=self.up)


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
        self, options: SceneOptions, recording: Recording, builder: RaysBuilder, about: list[dict[str, Any]]
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


def _camera_track(options: SceneOptions, recording: Recording, builder: RaysBuilder) -> PoseTrack:
    """Where the camera was in the place, OpenCV's axes to the place's."""
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
                f'the poses of "{options.poses}" count from the start of the recording "{plain(recording.name, 60)}", '
                "which no file of it says; put its info.json beside the gaze"
            )
        builder.source(options.poses)
        track, count = read_timed_poses(options.poses, builder.on_bad)
        builder.count_lines(count)
        up = to_place.up
    else:
        track, up = _of_model(options, recording, to_place, builder)
    _check_up(up, options, builder)
    return _moved(track, to_place)


def _of_model(
    options: SceneOptions, recording: Recording, to_place: PlaceFrame, builder: RaysBuilder
) -> tuple[PoseTrack, np.ndarray | None]:
    """The track of the model's frames in its own coordinates, and up in the place."""
    assert options.poses is not None
    model = read_named_poses(find_source(options.poses))
    builder.source(model.path)
    for note in model.notes:
        builder.complain(note)
    if options.frames is None:
        raise NergError(
            f'which images of "{model.path}" are frames of the video, and when they were taken, has to be said, such '
            f'as --frames "frame_{{frame1}}"; its first are {", ".join(plain(n, 60) for n in model.names[:3])}'
        )
    times = options.frames.times(model.names, recording.name, recording.frames, options.fps, recording.start)
    if recording.frames is None and options.frames.needs_frames:
        rate = "" if options.fps is None else f", {options.fps:g} a second exactly"
        builder.complain(
            f"the recording has no times of its video's frames: they are counted from the start of its clock{rate}; "
            "put the file that has them beside the gaze (Tobii: the scene video, Neon: world_timestamps.csv)"
        )
    track = _track(model, times)
    if track is None:
        raise NergError(
            f'one image of "{model.path}" alone is a frame of the recording "{plain(recording.name, 60)}"; two are '
            "needed to interpolate between: register more of them"
        )
    if to_place.sha256 is not None and to_place.sha256 != model.sha256:
        builder.complain(
            f'the place was trained on another file than "{model.path.name}": are its coordinates the same? If it was '
            "registered anew, train the place on it"
        )
    if to_place.up is None:
        found = find_up(model.to_world, np.zeros((0, 3)))
        up = to_place.rotation @ found.direction if found.sure else None
    else:
        up = to_place.up
    return track, up


def _track(model: NamedPoses, times: np.ndarray) -> PoseTrack | None:
    from scipy.spatial.transform import Rotation

    vectors = Rotation.from_matrix(model.to_world[:, :3, :3] @ _OPENCV).as_rotvec()
    return PoseTrack.of_samples(times, vectors, model.to_world[:, :3, 3])


def _moved(track: PoseTrack, to_place: PlaceFrame) -> PoseTrack:
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_matrix(to_place.rotation) * Rotation.from_rotvec(track.vectors)
    return PoseTrack(track.times, turned.as_rotvec(), to_place.points(track.places))


def _check_up(up: np.ndarray | None, options: SceneOptions, builder: RaysBuilder) -> None:
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
