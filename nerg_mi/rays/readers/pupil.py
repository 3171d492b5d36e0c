"""Exports of Pupil Core: Pupil Player's raw data beside those of its head pose tracker."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.ranges import LENGTHS, ValidatedDataclass, Range

from . import poses
from .base import DESCRIPTION, RaysBuilder, Signature, TrackingFrame, option
from .poses import PoseTrack

_GAP = 0.1  # seconds: between head poses farther apart than this nothing is interpolated
_POSES = ["timestamp", *(f"{what}_{axis}" for what in ("rotation", "translation") for axis in "xyz")]
_NORMALS = [f"gaze_normal{eye}_{axis}" for eye in "01" for axis in "xyz"]
_CENTRES = [f"eye_center{eye}_3d_{axis}" for eye in "01" for axis in "xyz"]


@dataclass(frozen=True, kw_only=True)
class PupilOptions(ValidatedDataclass):
    """What the exports do not say."""

    marker: float | None = option(None, "Edge of a tracking marker in metres.", within=LENGTHS)  # needed
    up: str = option("y", "Up axis: x, y, z, -x, -y or -z.", recorded=False)
    min_confidence: float = option(0.6, "Drop rows below this confidence.", within=Range(0, 1))


class Pupil:
    """Folders with ``gaze_positions.csv`` and ``head_pose_tracker_poses.csv``, one a recording.

    Gaze is in the scene camera's frame in millimetres: origin, the mean of the eyeballs' centres; direction, the mean
    of their normals. The head poses (the camera's place and Rodrigues vector) are in the frame of the tracker's
    markers, whose unit is a marker's edge: ``marker`` is its length in metres, ``up`` the axis of that frame that
    points up. Poses are interpolated to the time of the gaze; rows more than 0.1 s from them are dropped, as are those
    below ``min_confidence``. The person is the recording's folder (``anna`` of ``anna/000/exports/000``).
    """

    name = "pupil"
    files = "folders exported from Pupil Player with the head pose tracker (or the `gaze_positions.csv` in them)"
    world = "that of the markers, right-handed, whose axis `--up` points up; gaze in an OpenCV camera's"
    checked_on = DESCRIPTION
    signature = Signature(
        files=(("gaze_positions.csv", "head_pose_tracker_poses.csv"),),
        columns=(("gaze_timestamp", "gaze_normal0_x", "eye_center0_3d_x"),),
        options={"--marker": "METRES"},
        question="the edge of a tracking marker in metres (--marker) and the up axis of the markers (--up)",
    )
    Options = PupilOptions

    def frame(self, files: Sequence[Path], options: PupilOptions) -> TrackingFrame:
        return TrackingFrame(up=options.up)

    def read(self, files: Sequence[Path], options: PupilOptions, builder: RaysBuilder) -> None:
        if options.marker is None or not options.marker > 0:
            raise NergError(
                "Pupil's head poses count in edges of the tracking markers; give the edge's length in metres "
                "(--marker 0.05)"
            )
        builder.note(floor="unknown")  # a marker may lie or hang anywhere
        for given in files:
            gaze = given / "gaze_positions.csv" if given.is_dir() else given
            person = _person(gaze)
            heads = _read_heads(gaze.with_name("head_pose_tracker_poses.csv"), person, builder)
            builder.source(gaze, f"{person}/{gaze.name}")
            columns = ["gaze_timestamp", "confidence", *_NORMALS, *_CENTRES]
            for v, _, lines in builder.read_table(gaze, columns):
                turn, place, lost = heads.at(v[:, 0], _GAP)
                # An eye that was not seen has no columns filled: the other one stands alone.
                direction, eye = (poses.mean_of_two(v[:, a : a + 6].reshape(-1, 2, 3)) for a in (2, 8))
                builder.add(
                    v[:, 0],
                    person,
                    options.marker * place + poses.rotate(turn, 1e-3 * eye),
                    poses.rotate(turn, direction),
                    rows=lines,
                    confidence=v[:, 1],
                    head=turn[:, :, 2],
                    drop={
                        f"confidence below {options.min_confidence:g}": v[:, 1] < options.min_confidence,
                        "there is no head pose at that time": lost,
                    },
                )


READERS = (Pupil(),)


def _read_heads(path: Path, person: str, builder: RaysBuilder) -> PoseTrack:
    """Poses of the scene camera in a recording, in marker edges."""
    if not path.is_file():
        raise NergError(f"there is no {path}; run the head pose tracker in Pupil Player and export again")
    builder.source(path, f"{person}/{path.name}")
    track = builder.read_whole(path, _POSES)
    heads = PoseTrack.of_samples(track[:, 0], track[:, 1:4], track[:, 4:])
    if heads is None:
        raise NergError(f"{path} holds {len(track)} head poses; two that are whole are needed to interpolate between")
    return heads


def _person(gaze: Path) -> str:
    """The recording's folder: the first above ``gaze`` that is neither a number nor ``exports``."""
    folders = reversed(resolve_path(gaze).parent.parts)
    return next((p for p in folders if not p.isdigit() and p != "exports"), gaze.stem)
