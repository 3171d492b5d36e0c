"""Pupil Core: raw data exported by Pupil Player, with poses of its head pose tracker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.ranges import LENGTHS, Range, ValidatedDataclass

from . import poses
from .base import FROM_DOCUMENTATION, RaysBuilder, Signature, TrackingFrame, option
from .poses import PoseTrack

_MAX_GAP = 0.1  # seconds; larger gaps between head poses are not interpolated
_POSE_COLUMNS = ["timestamp", *(f"{what}_{axis}" for what in ("rotation", "translation") for axis in "xyz")]
_NORMAL_COLUMNS = [f"gaze_normal{eye}_{axis}" for eye in "01" for axis in "xyz"]
_CENTRE_COLUMNS = [f"eye_center{eye}_3d_{axis}" for eye in "01" for axis in "xyz"]


@dataclass(frozen=True, kw_only=True)
class PupilOptions(ValidatedDataclass):
    """Options for what the exports do not contain."""

    marker: float | None = option(None, "Edge of a tracking marker in metres.", within=LENGTHS)  # required
    up: str = option("y", "Up axis: x, y, z, -x, -y or -z.", is_recorded=False)
    min_confidence: float = option(0.6, "Drop rows below this confidence.", within=Range(0, 1))


class Pupil:
    """Folders with ``gaze_positions.csv`` and ``head_pose_tracker_poses.csv``, one per recording.

    Gaze is in the scene camera's frame in millimetres: the origin is the mean of the eyeballs' centres, the direction
    the mean of their normals. Head poses (position and Rodrigues vector of the camera) are in the frame of the
    tracker's markers, whose unit is the edge of a marker: ``marker`` is its length in metres, ``up`` the up axis of
    that frame. Poses are interpolated to the times of the gaze; rows more than 0.1 s from a pose are dropped, and rows
    below ``min_confidence``. The participant is the recording's folder (``anna`` for ``anna/000/exports/000``).
    """

    name = "pupil"
    files = "folders exported from Pupil Player with the head pose tracker (or the `gaze_positions.csv` in them)"
    frame_description = "that of the markers, right-handed; `--up` points up; gaze in that of an OpenCV camera"
    evidence = FROM_DOCUMENTATION
    signature = Signature(
        files=(("gaze_positions.csv", "head_pose_tracker_poses.csv"),),
        columns=(("gaze_timestamp", "gaze_normal0_x", "eye_center0_3d_x"),),
        options={"--marker": "METRES"},
        question=(
            f"the edge of a tracking marker in metres ({parameter('marker')}) and the up axis of the markers "
            f"({parameter('up')})"
        ),
    )
    Options = PupilOptions

    def frame(self, files: Sequence[Path], options: PupilOptions) -> TrackingFrame:
        return TrackingFrame(up=options.up)

    def read(self, files: Sequence[Path], options: PupilOptions, builder: RaysBuilder) -> None:
        if options.marker is None or not options.marker > 0:
            raise NergError(
                "Pupil's head poses are in units of the edge of a tracking marker; set its length in metres "
                f"({parameter('marker', 0.05)})"
            )
        builder.add_metadata(floor="unknown")  # markers may be anywhere
        for path in files:
            gaze = path / "gaze_positions.csv" if path.is_dir() else path
            person = _find_person(gaze)
            heads = _read_head_poses(gaze.with_name("head_pose_tracker_poses.csv"), person, builder)
            builder.begin_source(gaze, f"{person}/{gaze.name}")
            columns = ["gaze_timestamp", "confidence", *_NORMAL_COLUMNS, *_CENTRE_COLUMNS]
            for v, _, lines in builder.read_table(gaze, columns):
                rotation, position, has_no_pose = heads.interpolate(v[:, 0], _MAX_GAP)
                # An eye that was not tracked is empty: the other one is used alone.
                direction, eye = (poses.average_eyes(v[:, a : a + 6].reshape(-1, 2, 3)) for a in (2, 8))
                builder.add(
                    v[:, 0],
                    person,
                    options.marker * position + poses.rotate(rotation, 1e-3 * eye),
                    poses.rotate(rotation, direction),
                    rows=lines,
                    tracking="eye",
                    confidence=v[:, 1],
                    head=rotation[:, :, 2],
                    drop={
                        f"confidence below {options.min_confidence:g} (option min_confidence)": v[:, 1]
                        < options.min_confidence,
                        "there is no head pose at that time": has_no_pose,
                    },
                )


READERS = (Pupil(),)


def _read_head_poses(path: Path, person: str, builder: RaysBuilder) -> PoseTrack:
    """Read the poses of the scene camera in a recording, in marker edges."""
    if not path.is_file():
        raise NergError(f"{path} does not exist; run the head pose tracker in Pupil Player and export again")
    builder.begin_source(path, f"{person}/{path.name}")
    track = builder.read_all(path, _POSE_COLUMNS)
    heads = PoseTrack.from_samples(track[:, 0], track[:, 1:4], track[:, 4:])
    if heads is None:
        raise NergError(f"{path} has {len(track)} head poses; interpolation needs at least two complete ones")
    return heads


def _find_person(gaze: Path) -> str:
    """The recording's folder: the first above ``gaze`` that is neither a number nor ``exports``."""
    folders = reversed(resolve_path(gaze).parent.parts)
    return next((p for p in folders if not p.isdigit() and p != "exports"), gaze.stem)
