"""Small logs of headsets, as the programs that their readers name write them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

ARETT_HEAD = (
    "eyeDataTimestamp,eyeDataRelativeTimestamp,frameTimestamp,isCalibrationValid,gazeHasValue,"
    "gazeOrigin_x,gazeOrigin_y,gazeOrigin_z,gazeDirection_x,gazeDirection_y,gazeDirection_z,"
    "gazePointHit,gazePoint_x,gazePoint_y,gazePoint_z,gazePoint_target_name,infoText"
)


def xyz(stem: str, axes: str = "xyz") -> list[str]:
    return [f"{stem}{axis}" for axis in axes]


def csv(head: list[str] | str, rows) -> str:
    head = head if isinstance(head, str) else ",".join(head)
    return "\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n"


def arett(origin, direction, hit, seen, calibrated) -> str:
    """``hit`` (n, 3), NaN where nothing was met."""
    rows = []
    for k, (o, d, h) in enumerate(zip(origin, direction, hit)):
        met = bool(np.isfinite(h).all())
        there = [*o, *d] if seen[k] else [""] * 6
        point = [*h, '"wall, left"'] if met else ["", "", "", ""]
        rows.append([1_700_000_000_000 + 33 * k, 33 * k, 33 * k, calibrated[k], seen[k], *there, met, *point, ""])
    return csv(ARETT_HEAD, rows)


def sranipal(t_ms, head, turn: Rotation, eyes: dict[str, tuple], style: str = "verbose_data.{}.{}.{}") -> str:
    """``eyes``: by side (combined, left, right) origins in mm and directions (n, 3), and masks (n,), of the SDK."""
    columns, names = [t_ms, *np.transpose(head), *turn.as_quat().T], ["time_stamp(ms)", *xyz("head_pos_")]
    names += xyz("head_rot_", "xyzw")
    for side, (origin, direction, mask) in eyes.items():
        part = "combined.eye_data" if side == "combined" and "verbose" in style else side
        names += [style.format(part, "gaze_origin_mm", a) for a in "xyz"]
        names += [style.format(part, "gaze_direction_normalized", a) for a in "xyz"]
        names.append(style.format(part, "eye_data_validata_bit_mask", "").rstrip("._"))
        columns += [*np.transpose(origin), *np.transpose(direction), mask]
    return csv(names, zip(*columns))


def openxr(t_ns, place, turn: Rotation, flags, active) -> str:
    head = ["time", *xyz("gaze_position_"), *xyz("gaze_orientation_", "xyzw"), "location_flags", "is_active"]
    return csv(head, zip(t_ns, *np.transpose(place), *turn.as_quat().T, flags, active))


def quest(t, left, right, turns: tuple[Rotation, Rotation], sure: tuple, rig: tuple | None = None) -> str:
    """Places and rotations of both eyes, their confidences, and place and rotation of the rig."""
    head, columns = ["Time"], [t]
    for side, place, turn, confidence in zip(("Left", "Right"), (left, right), turns, sure):
        head += [*xyz(f"{side}EyePosition", "XYZ"), *xyz(f"{side}EyeRotation", "XYZW"), f"{side}EyeConfidence"]
        columns += [*np.transpose(place), *turn.as_quat().T, confidence]
    if rig is not None:
        head += [*xyz("RigPosition", "XYZ"), *xyz("RigRotation", "XYZW")]
        columns += [*np.transpose(rig[0]), *rig[1].as_quat().T]
    return csv(head, zip(*columns))


def motive(t, bodies: dict[str, tuple], units="Meters", rotation="Quaternion", space="Global") -> str:
    """Bodies by name, each with its places (n, 3) and rotations; a marker and an error are beside each."""
    axes = [*(("Rotation", a) for a in "XYZW"), *(("Position", a) for a in "XYZ"), ("Mean Marker Error", "")]
    columns = [("Rigid Body", name, *axis) for name in bodies for axis in axes]
    columns += [("Rigid Body Marker", f"{name}:Marker1", "Position", a) for name in bodies for a in "XYZ"]
    kinds, names, whats, letters = zip(*columns)
    cells = [np.c_[turn.as_quat(), place, np.full(len(t), 1e-4)] for place, turn in bodies.values()]
    rows = np.hstack([*cells, *(place for place, _ in bodies.values())])
    about = f"Format Version,1.23,Take Name,T,Rotation Type,{rotation},Length Units,{units},Coordinate Space,{space}"
    above = [["", "Type", *kinds], ["", "Name", *names], ["", "ID", *["1"] * len(kinds)], ["", "", *whats]]
    samples = ([k, *row] for k, row in enumerate(np.c_[t, rows].tolist()))
    head = [about, "", *map(",".join, above), ",".join(["Frame", "Time (Seconds)", *letters])]
    return csv("\n".join(head), (["" if v != v else v for v in row] for row in samples))


_N = 6
_K = np.arange(_N)
_EYES = np.c_[0.1 * _K, np.full(_N, 1.6), np.zeros(_N)]
_STILL = Rotation.from_quat(np.tile([0.0, 0, 0, 1], (_N, 1)))
_AHEAD = np.tile([0.0, 0, 1], (_N, 1))

ARETT = {"ann.csv": arett(_EYES, _AHEAD, _EYES + 2 * _AHEAD, [True] * _N, [True] * _N)}
SRANIPAL = {"ann.csv": sranipal(20 * _K, _EYES, _STILL, {"combined": (0 * _EYES, _AHEAD, np.full(_N, 3))})}
OPENXR = {"ann.csv": openxr(10_000_000 * _K, _EYES, _STILL, np.full(_N, 15), np.ones(_N, int))}
QUEST = {"ann.csv": quest(0.02 * _K, _EYES, _EYES, (_STILL, _STILL), (np.ones(_N), np.ones(_N)))}
MOTIVE = motive(0.01 * _K, {"Head": (_EYES, _STILL)})
