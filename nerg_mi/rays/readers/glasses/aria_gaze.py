"""Gaze files of Project Aria: three schemas told apart by their headers, and directions of their angles.

Angles are in the central pupil frame (CPF), whose origin lies midway between the eyes: x left, y up, z forward, metres.
Where that frame is on the glasses is known from their construction alone. After projectaria_tools
(``core/mps/EyeGazeReader``, ``core/calibration/DeviceCadExtrinsics``).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain
from nerg_mi.rays.readers.parsing.tables import table_columns

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
    columns = set(table_columns(path))
    if {"yaw_rads_cpf", "left_pitch_rads_cpf", "right_pitch_rads_cpf"} <= columns:
        return GEN2
    if {"left_yaw_rads_cpf", "right_yaw_rads_cpf"} <= columns:
        return VERGENCE
    if "yaw_rads_cpf" in columns:
        return LEGACY
    there = ", ".join(plain(c, 40) for c in sorted(columns)[:8]) or "none"
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
        raise NergError(f'--device "{plain(given, 40)}" {what}; choose one of {", ".join(known)}, or leave it out')
    return name


def cpf_in_device(device: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and origin (3,), metres, of CPF in the frame of a device: p_device = R p_cpf + t."""
    _, origin, y, z = _MODELS[device]
    y, z = (np.array(a) / np.linalg.norm(a) for a in (y, z))
    x = np.cross(y, z)
    x /= np.linalg.norm(x)
    device_in_cpf = np.stack([x, np.cross(z, x), z], axis=1)
    return device_in_cpf.T, -device_in_cpf.T @ np.array(origin)
