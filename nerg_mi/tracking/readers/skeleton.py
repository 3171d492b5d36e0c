"""Skeletons: files of keypoints, skeleton conventions, and head poses from keypoints.

Conventions (``--skeleton``), with keypoints from 0:

- ``nerg22``, the paper's: ears 2, 13; nose 11
- ``coco17``, COCO: nose 0; eyes 1, 2; ears 3, 4
- ``body25``, OpenPose: nose 0; eyes 16, 15; ears 18, 17
- ``mediapipe33``, MediaPipe Pose: nose 0; eyes 2, 5; ears 7, 8
- ``kinect32``, Azure Kinect: nose 27; eyes 28, 30; ears 29, 31
- ``kinect25``, Kinect v2: none: head 3; trunk by shoulders 4, 8 and spine

Left comes first. ``--keypoints left_ear,right_ear,left_eye+right_eye`` uses another front, by names or numbers. A
keypoint that is NaN, a fill value (0, 0, 0), or has a confidence of 0 is missing; poses without one of the head's
keypoints are dropped. The least confidence of these is the sample's. Ears nearer than 8 cm or farther than 30 cm
apart, and hips at the origin, are reported.
"""

from __future__ import annotations

import gzip
import io
import itertools
import math
import operator
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.atomic import replace_atomically
from nerg_mi.files.safe_read import BadLineCallback, read_line_blocks
from nerg_mi.ranges import ELEVATIONS

from .base import FROM_DOCUMENTATION, UNITS, RaysBuilder, Signature, TickOption, TrackingFrame, option
from .poses import find_fill_values

# ---- Skeleton files: one pose per line, ``id|time|[numbers]`` ----
#
# The tracking format of the NeRG paper (Section 5.1): the id of a participant, an integer time or frame number, and
# keypoints (22 in the paper) with three coordinates each, optionally with a confidence. A missing keypoint is ``nan``,
# is at exactly 0, 0, 0 or another fill value, or has no confidence.

NUM_KEYPOINTS = 22
_SNIFFED_LINES = 1000  # lines among which the first complete one determines the number of values


class Layout(NamedTuple):
    """Layout of the numbers of a line."""

    keypoints: int = NUM_KEYPOINTS
    width: int = 3  # 3: x, y, z; 4: with a confidence

    @property
    def num_values(self) -> int:
        return self.keypoints * self.width

    def __str__(self) -> str:
        return f"{self.keypoints} keypoints of x, y, z" + (" and a confidence" if self.width == 4 else "")


PAPER_LAYOUT = Layout()


class SkeletonRows(NamedTuple):
    """N poses of K keypoints."""

    ids: np.ndarray  # (N,) str
    times: np.ndarray  # (N,) int64, or float64 if some have fractions, in the file's unit
    keypoints: np.ndarray  # (N, K, 3) float64, NaN if missing
    lines: np.ndarray  # (N,) int64, line number in the file, from 1
    confidence: np.ndarray  # (N, K) float64, of the requested keypoints; 1 if the file has none


def write_skeleton(
    path: str | os.PathLike, ids: Sequence[str], times: np.ndarray, keypoints: np.ndarray, *, decimals: int = 6
) -> None:
    """Write poses in the given order; files with a name ending in ``.gz`` are compressed.

    Equal input gives equal bytes.

    Parameters
    ----------
    ids
        N names without ``|`` or line breaks.
    times
        (N,) integers.
    keypoints
        (N, K, 3), NaN if missing, or (N, K, 4) with confidences.
    decimals
        Digits after the point; 6 (a micrometre) rotates a head by at most 1e-5 rad.

    Raises
    ------
    ValueError
        For wrong shapes or times that are not integers.
    NergError
        For an id that the format cannot represent.
    """
    keypoints = np.asarray(keypoints, dtype=np.float64)
    times = np.asarray(times)
    n = len(ids)
    if keypoints.ndim != 3 or len(keypoints) != n or keypoints.shape[2] not in (3, 4):
        raise ValueError(f"keypoints have shape {keypoints.shape}, expected ({n}, K, 3): one pose for each id")
    if times.shape != (n,) or not np.issubdtype(times.dtype, np.integer):
        raise ValueError(
            f"times must be {n} integers (the format has no fractions), got shape {times.shape} "
            f"of {times.dtype}; multiply seconds by the frame rate and round"
        )
    for i, name in enumerate(ids):
        if not str(name).strip() or any(c in str(name) for c in "|\r\n"):
            raise NergError(f"id {name!r} of pose {i} is empty or contains '|' or a line break; rename the participant")

    flat = keypoints.reshape(n, -1)
    line_format = ", ".join([f"%.{decimals}f"] * flat.shape[1])
    with replace_atomically(path) as temporary, _open_text(temporary, Path(path).name) as out:
        for name, time, values in zip(ids, times, flat):
            out.write(f"{name}|{int(time)}|[{line_format % tuple(values)}]\n")


def count_values(path: str | os.PathLike) -> int | None:
    """Number of values of the first line in the format; None if none of the first lines is."""
    for block in read_line_blocks(path, "skeleton file", _SNIFFED_LINES):
        bodies = [fields[2].strip() for line in block if len(fields := line.split("|")) == 3]
        return next((body.count(",") + 1 for body in bodies if body[:1] == "[" and body[-1:] == "]"), None)
    return None


def iterate_skeleton(
    path: str | os.PathLike,
    block_lines: int = 8192,
    keypoints: Sequence[int] | None = None,
    on_bad_line: BadLineCallback | None = None,
    layout: Layout = PAPER_LAYOUT,
) -> Iterator[SkeletonRows]:
    """Iterate over the poses of a file in blocks of at most ``block_lines`` lines, to bound memory (a day of a shop has
    about 2.6 million lines). Empty lines are skipped.

    Parameters
    ----------
    keypoints
        Indices of the requested keypoints of the ``layout``; the others are not converted and are NaN.
    on_bad_line
        Called with lines that are not in the format, which are skipped. Without it such a line is an error.

    Raises
    ------
    NergError
        For a damaged file and, naming file and line, for a line that is not in the format.
    """
    wanted = range(layout.keypoints) if keypoints is None else sorted(set(keypoints))
    columns = [layout.width * k + i for k in wanted for i in range(layout.width)]
    before = 0
    for block in read_line_blocks(path, "skeleton file", block_lines):
        ids: list[str] = []
        times: list[float] = []
        texts: list[str] = []
        lines: list[int] = []
        for number, line in enumerate(block, start=before + 1):
            line = line.strip()
            if not line:
                continue
            fields = _parse_line(line, layout)
            if isinstance(fields, str):
                _report_bad_line(path, number, fields, on_bad_line)
                continue
            ids.append(fields[0])
            times.append(fields[1])
            texts.append(fields[2])
            lines.append(number)
        before += len(block)
        if ids:
            rows = _parse_rows(path, ids, times, texts, lines, columns, on_bad_line, layout)
            if len(rows.ids):
                yield rows


def _parse_line(line: str, layout: Layout) -> tuple[str, float, str] | str:
    """Parse a line to the id, the time and the text of the numbers; or return a description of the error."""
    fields = line.split("|")
    if len(fields) != 3:
        return f": {len(fields)} fields separated by '|', expected id|time|[{layout.num_values} numbers]"
    body = fields[2].strip()
    if not (body.startswith("[") and body.endswith("]")):
        return ": the keypoints are not enclosed in '[' and ']'"
    if body.count(",") != layout.num_values - 1:
        return f": {body.count(',') + 1} numbers, expected {layout.num_values} ({layout})"
    try:
        time = int(fields[1]) if fields[1].strip().lstrip("+-").isdecimal() else float(fields[1])
    except ValueError:
        time = math.nan
    if math.isnan(time):
        return f": the time {sanitize(fields[1], 40)!r} is not a number"
    if not -(1 << 63) <= time < 1 << 63:
        return f": the time {sanitize(fields[1], 40)!r} is too large for 64 bits"
    return fields[0].strip(), time, body[1:-1]


def _report_bad_line(path: str | os.PathLike, line: int, reason: str, on_bad_line: BadLineCallback | None) -> None:
    if on_bad_line is None:
        raise NergError(
            f"{path}, line {line}{reason}; correct or remove the line, or skip such lines with "
            f"{parameter('skip_bad_lines', True)}"
        )
    on_bad_line(line, reason)


def _parse_rows(
    path: str | os.PathLike,
    ids: list[str],
    times: list[float],
    texts: list[str],
    lines: list[int],
    columns: list[int],
    on_bad_line: BadLineCallback | None,
    layout: Layout,
) -> SkeletonRows:
    # Convert all lines at once, and search for the bad line only if that fails.
    pick = operator.itemgetter(*columns)
    try:
        numbers = _parse_numbers(texts, columns, pick, has_all=len(columns) == layout.num_values)
    except ValueError:
        good_rows = []
        for i, (line, text) in enumerate(zip(lines, texts)):
            word = next((w for w in pick(text.split(",")) if not _is_number(w)), None)
            if word is None:
                good_rows.append(i)
            else:
                _report_bad_line(path, line, f": {sanitize(word.strip(), 60)!r} is not a number", on_bad_line)
        ids, times, texts, lines = ([column[i] for i in good_rows] for column in (ids, times, texts, lines))
        # NumPy accepts fewer notations than Python.
        numbers = _parse_numbers(texts, columns, pick, has_all=False)
    values = np.full((len(ids), layout.num_values), np.nan)
    values[:, columns] = numbers
    values = values.reshape(len(ids), *layout)
    points, confidence = values[:, :, :3], values[:, :, 3] if layout.width == 4 else np.ones(values.shape[:2])
    points[np.isfinite(find_fill_values(points)) | ~(confidence > 0)] = np.nan
    # Integers keep all their digits.
    ticks = np.array(times, dtype=np.int64 if all(isinstance(time, int) for time in times) else np.float64)
    return SkeletonRows(np.array(ids, dtype=str), ticks, points, np.array(lines, dtype=np.int64), confidence)


def _parse_numbers(texts: list[str], columns: list[int], pick: operator.itemgetter, has_all: bool) -> np.ndarray:
    if has_all:
        return np.loadtxt(texts, delimiter=",", comments=None, dtype=np.float64, ndmin=2)
    # Faster than loadtxt's usecols, which also converts the other columns.
    words = itertools.chain.from_iterable(pick(text.split(",")) for text in texts)
    return np.fromiter(map(float, words), dtype=np.float64, count=len(texts) * len(columns)).reshape(-1, len(columns))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


@contextmanager
def _open_text(path: Path, name: str) -> Iterator[IO[str]]:
    """Open a text file for writing; compressed if its final ``name`` ends in ``.gz``."""
    with path.open("wb") as raw:
        if not name.endswith(".gz"):
            with io.TextIOWrapper(raw, encoding="utf-8", newline="\n") as out:
                yield out
            return
        # With its final name and without a time, so that equal poses give equal bytes.
        with io.TextIOWrapper(gzip.GzipFile(name, "wb", fileobj=raw, mtime=0), encoding="utf-8", newline="\n") as out:
            yield out


# ---- Skeleton conventions, head poses from keypoints, and bodies for given head poses ----
#
# The paper's proxy for gaze (Section 5.1): a ray from the midpoint of the ears through the nose.

# These are documented in the paper: columns 6:9, 39:42 and 33:36 of the file.
LEFT_EAR, RIGHT_EAR, NOSE = 2, 13, 11


@dataclass(frozen=True)
class Skeleton:
    """A convention of keypoints: their number, and the indices (from 0) of those that define the pose of a body.

    Left and right are those of the participant. ``full_confidence`` is the confidence of a reliably detected keypoint.
    """

    title: str
    keypoints: int
    joints: Mapping[str, int]
    full_confidence: float = 1.0

    def find_keypoints(self, name: int | str) -> list[int]:
        """Indices of the keypoints of which ``name`` is the mean: an index, a name, or several of these, joined by "+".

        Raises `NergError` listing the available keypoints.
        """
        words = [self.joints.get(word.strip(), word.strip()) for word in str(name).split("+")]
        numbers = [int(k) if str(k).isdecimal() and len(str(k)) < 9 else self.keypoints for k in words]
        if max(numbers) >= self.keypoints:
            raise NergError(
                f'there is no keypoint "{name}" in {self.title}; use indices from 0 to '
                f"{self.keypoints - 1}, or the names {', '.join(self.joints)} ({parameter('keypoints')})"
            )
        return numbers


PAPER_SKELETON = "nerg22"
SKELETONS = {
    PAPER_SKELETON: Skeleton(
        "the NeRG paper's skeleton", NUM_KEYPOINTS, {"left_ear": LEFT_EAR, "right_ear": RIGHT_EAR, "nose": NOSE}
    ),
    "coco17": Skeleton(
        "COCO-17",
        17,
        {"nose": 0, "left_eye": 1, "right_eye": 2, "left_ear": 3, "right_ear": 4}
        | {"left_shoulder": 5, "right_shoulder": 6, "left_hip": 11, "right_hip": 12},
    ),
    "body25": Skeleton(
        "BODY_25 of OpenPose",
        25,
        {"nose": 0, "right_eye": 15, "left_eye": 16, "right_ear": 17, "left_ear": 18}
        | {"right_shoulder": 2, "left_shoulder": 5, "right_hip": 9, "left_hip": 12},
    ),
    "mediapipe33": Skeleton(
        "the pose of MediaPipe",
        33,
        {"nose": 0, "left_eye": 2, "right_eye": 5, "left_ear": 7, "right_ear": 8}
        | {"left_shoulder": 11, "right_shoulder": 12, "left_hip": 23, "right_hip": 24},
    ),
    "kinect32": Skeleton(
        "Azure Kinect",
        32,
        {"nose": 27, "left_eye": 28, "left_ear": 29, "right_eye": 30, "right_ear": 31, "head": 26, "pelvis": 0}
        | {"left_shoulder": 5, "right_shoulder": 12, "left_hip": 18, "right_hip": 22},
        full_confidence=2.0,
    ),
    "kinect25": Skeleton(
        "Kinect v2",
        25,
        {"head": 3, "pelvis": 0, "left_shoulder": 4, "right_shoulder": 8, "left_hip": 12, "right_hip": 16},
        full_confidence=2.0,
    ),
}
"""Conventions by name. Of several with the same number of keypoints, the first is the default."""

EAR_DISTANCE = 0.15  # metres between the ears of an adult
NOSE_DISTANCE = 0.12  # metres from the midpoint of the ears to the tip of the nose
EAR_HEIGHT = 1.58  # metres; height of the ears in _BODY

# The other nineteen keypoints are unnamed in the published code. Bodies made here use a standing adult:
# (to the left, forward, height) in metres.
_BODY = {
    0: (0.10, 0.00, 0.08),
    1: (0.12, 0.17, 0.02),
    3: (0.25, 0.02, 1.05),  # left ankle, toe, elbow
    5: (0.10, -0.06, 0.03),
    6: (0.10, 0.00, 0.90),
    7: (0.10, 0.03, 0.48),  # left heel, hip, knee
    8: (0.19, 0.00, 1.36),
    9: (0.26, 0.15, 0.88),
    10: (0.00, 0.00, 1.40),  # left shoulder, wrist; neck
    12: (-0.10, 0.00, 0.08),
    14: (-0.25, 0.02, 1.05),
    16: (-0.10, -0.06, 0.03),  # right ankle, elbow, heel
    17: (-0.10, 0.00, 0.90),
    18: (-0.10, 0.03, 0.48),
    19: (-0.19, 0.00, 1.36),  # right hip, knee, shoulder
    20: (-0.26, 0.15, 0.88),
    21: (0.00, 0.00, 1.15),  # right wrist; chest
}
_LEFT_EYE, _RIGHT_EYE = 4, 15


def head_poses(
    left: np.ndarray, right: np.ndarray, front: np.ndarray, *, pitch: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Compute head poses as rays from midway between the sides of the head (ears) through its front (nose).

    Parameters
    ----------
    left, right, front
        (N, 3) each.
    pitch
        Degrees by which the direction is rotated upwards about the line through the sides. A nose is below the ears, so
        that a level head otherwise points down.

    Returns
    -------
    origin
        (N, 3) in the unit of the input.
    direction
        (N, 3) unit; NaN if a point is NaN, or the front is midway between the sides.

    References
    ----------
    NeRG, Section 5.1.
    """
    left, right, front = (np.asarray(v, dtype=np.float64) for v in (left, right, front))
    origin = 0.5 * (left + right)
    direction = _normalise(front - origin)
    if pitch:
        # Only the component perpendicular to the line through the sides is rotated.
        side = _normalise(left - right)
        along = np.sum(direction * side, axis=1, keepdims=True) * side
        angle = np.radians(pitch)
        direction = along + np.cos(angle) * (direction - along) + np.sin(angle) * np.cross(direction, side)
    return origin, direction


def compute_trunk_directions(left: np.ndarray, right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Facing directions of trunks, (N, 3) unit: perpendicular to the line of the shoulders ``left``, ``right`` (N, 3)
    and to ``up`` (N, 3) along the spine; NaN if undefined."""
    return _normalise(np.cross(left - right, up))


def _normalise(v: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(v, axis=1, keepdims=True)
    return np.divide(v, length, out=np.full_like(v, np.nan), where=length > 0)


def keypoints_from_head(
    origin: np.ndarray,
    direction: np.ndarray,
    *,
    floor: float = 0.0,
    ear_distance: float = EAR_DISTANCE,
    nose_distance: float = NOSE_DISTANCE,
) -> np.ndarray:
    """Make standing bodies whose ears and nose have exactly the given head poses.

    The head has no roll; the body faces in the direction of the head, and is scaled to its height.

    Parameters
    ----------
    origin
        (N, 3) metres, z up: midpoint of the ears.
    direction
        (N, 3) of any length.
    floor
        Height of the floor in metres.
    ear_distance, nose_distance
        Metres between the ears, and from their midpoint to the nose.

    Returns
    -------
    numpy.ndarray
        Keypoints (N, 22, 3), of which :func:`head_poses` equals the input up to rounding.

    Raises
    ------
    ValueError
        For a zero or non-finite direction or origin.
    """
    origin = np.atleast_2d(np.asarray(origin, dtype=np.float64))
    direction = np.atleast_2d(np.asarray(direction, dtype=np.float64))
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    bad = np.flatnonzero(~(np.isfinite(length[:, 0]) & (length[:, 0] > 0) & np.isfinite(origin).all(axis=1)))
    if bad.size:
        raise ValueError(f"head pose {bad[0]} has a zero or non-finite direction or origin; drop it first")
    forward = direction / length

    # The left direction is horizontal; a head that looks straight up or down is assumed to face +x.
    flat = forward * (1.0, 1.0, 0.0)
    flat_length = np.linalg.norm(flat, axis=1, keepdims=True)
    heading = np.where(flat_length > 1e-9, flat / np.maximum(flat_length, 1e-9), (1.0, 0.0, 0.0))
    left = np.stack([-heading[:, 1], heading[:, 0], np.zeros(len(heading))], axis=1)
    crown = np.cross(forward, left)

    out = np.empty((len(origin), NUM_KEYPOINTS, 3))
    out[:, LEFT_EAR] = origin + 0.5 * ear_distance * left
    out[:, RIGHT_EAR] = origin - 0.5 * ear_distance * left
    out[:, NOSE] = origin + nose_distance * forward
    eye_centre = origin + 0.75 * nose_distance * forward + 0.25 * nose_distance * crown
    out[:, _LEFT_EYE] = eye_centre + 0.2 * ear_distance * left
    out[:, _RIGHT_EYE] = eye_centre - 0.2 * ear_distance * left

    scale = (origin[:, 2:] - floor) / EAR_HEIGHT
    foot = np.concatenate([origin[:, :2], np.full((len(origin), 1), float(floor))], axis=1)
    for k, (aside, ahead, height) in _BODY.items():
        out[:, k] = foot + scale * (aside * left + ahead * heading) + scale * height * np.array([0.0, 0.0, 1.0])
    return out


# ---- Tracked bodies: rays of their heads from skeletons ----

HeadKeypoints = tuple[int | str, int | str, int | str]
"""Left side, right side and front of a head: keypoints or markers, or means of several, joined by "+"."""

FACE_KEYPOINTS: HeadKeypoints = ("left_ear", "right_ear", "nose")
PITCH_HELP = "Degrees by which rays are rotated upwards, since a nose is below the ears."
MISSING_KEYPOINT = "a keypoint of the head is missing"
"""Reason for dropping a pose with a keypoint that is NaN, at exactly 0, 0, 0 or without confidence."""

_TRUNK_KEYPOINTS = ("left_shoulder", "right_shoulder", "head", "pelvis")
_EAR_DISTANCES = (0.08, 0.3)  # metres; plausible distances between the sides of a head
_MAX_HIP_OFFSET = 1e-3  # metres from the origin to the hips, if positions are relative to them


def parse_keypoints(text: str) -> HeadKeypoints:
    """Parse ``"2,13,11"`` or ``"left_ear,right_ear,left_eye+right_eye"``. Raises `NergError` for other text."""
    words = [word.strip() for word in text.split(",")]
    if len(words) != 3 or not all(words):
        raise NergError(f"{parameter('keypoints')} needs three keypoints: left ear, right ear, nose; got {text!r}")
    left, right, front = (int(word) if word.isdecimal() else word for word in words)
    return left, right, front


@dataclass(frozen=True, kw_only=True)
class SkeletonOptions(TickOption):
    """Options for the convention of the skeleton, the keypoints of the head, and the frame."""

    skeleton: str | None = option(
        None,
        f"Convention of the keypoints: {', '.join(SKELETONS)}.",
        default_text="by the number of keypoints",
        is_recorded=False,
    )
    keypoints: HeadKeypoints | None = option(
        None,
        "Left ear, right ear, nose: indices from 0 or names, or means of several, as left_eye+right_eye.",
        default_text=",".join(map(str, FACE_KEYPOINTS)),
        parse=parse_keypoints,
        is_recorded=False,
    )
    pitch: float = option(0.0, PITCH_HELP, within=ELEVATIONS, flag="")
    units: str = option("m", "Unit of length: m, cm or mm.", is_recorded=False)
    up: str = option("z", "Up axis: x, y, z, -x, -y or -z.", is_recorded=False)
    handedness: str = option("right", "Handedness: right or left.", flag="--hand", is_recorded=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.skeleton is not None and self.skeleton not in SKELETONS:
            raise NergError(
                f'there is no skeleton "{self.skeleton}"; use one of {", ".join(SKELETONS)} ({parameter("skeleton")})'
            )


def _recognize(line: str) -> str | None:
    words = line.split("|")
    return "its lines are id|time|[keypoints]" if len(words) == 3 and words[2].lstrip().startswith("[") else None


class SkeletonFile:
    """One ray per pose: from the midpoint of the ears through the nose (NeRG, Section 5.1).

    The file's time is multiplied by ``tick``; see `head_poses` for ``pitch``. Poses with one of these keypoints
    missing are dropped. A skeleton without a face (Kinect v2) gives the direction of the trunk, with a warning. A
    skeleton that was selected by its number of keypoints gives a warning as well.
    """

    name = "skeleton"
    files = (
        "keypoints of persons: lines `id|time|[numbers]`, one pose each, x, y, z (or x, y, z, confidence): the 22 of "
        "the NeRG paper's tracking, COCO-17, BODY_25 of OpenPose, MediaPipe's 33, Azure Kinect's 32 or Kinect v2's 25; "
        "rays go from the midpoint of the ears through the nose"
    )
    frame_description = "declared: `--up`, `--hand`, `--units`"
    evidence = FROM_DOCUMENTATION
    signature = Signature(
        line=_recognize,
        question=(
            f"the unit of the time ({parameter('tick')}); the quality report suggests one for the sampling rate of "
            "a device"
        ),
    )
    Options = SkeletonOptions

    def frame(self, files: Sequence[Path], options: SkeletonOptions) -> TrackingFrame:
        return TrackingFrame(options.up, options.handedness, options.units)

    def read(self, files: Sequence[Path], options: SkeletonOptions, builder: RaysBuilder) -> None:
        for path in files:
            builder.begin_source(path)
            name, layout = _find_skeleton(path, options, builder)
            skeleton = SKELETONS[name]
            keypoints: tuple[int | str, ...] = options.keypoints or (
                FACE_KEYPOINTS if "nose" in skeleton.joints else _TRUNK_KEYPOINTS
            )
            groups = [skeleton.find_keypoints(place) for place in keypoints]
            if len({tuple(sorted(group)) for group in groups}) < len(groups):
                raise NergError(
                    f"the keypoints {', '.join(map(str, keypoints))} are not all different ({parameter('keypoints')})"
                )
            head = [k for group in groups for k in group]
            hips = [skeleton.joints[hip] for hip in ("left_hip", "right_hip") if hip in skeleton.joints]
            builder.add_metadata(skeleton=name, keypoints=list(keypoints))
            names = {k: joint for joint, k in skeleton.joints.items()}
            builder.add_unused_columns(
                names.get(k, f"keypoint {k}") for k in range(skeleton.keypoints) if k not in head
            )
            if keypoints == _TRUNK_KEYPOINTS:
                builder.add_warning(
                    f"{skeleton.title} has no keypoints of the face: rays have the facing direction of the trunk, "
                    "which may differ from that of the head"
                )
            checks = GeometryChecks(path.name, UNITS[options.units], builder)
            for rows in iterate_skeleton(
                path, keypoints=[*head, *hips], on_bad_line=builder.on_bad_line, layout=layout
            ):
                left, right, front = (rows.keypoints[:, group].mean(axis=1) for group in groups[:3])
                if keypoints == _TRUNK_KEYPOINTS:
                    origin = front
                    direction = compute_trunk_directions(left, right, front - rows.keypoints[:, groups[3]].mean(axis=1))
                else:
                    origin, direction = head_poses(left, right, front, pitch=options.pitch)
                    checks.add_sides(left, right)
                if hips:
                    checks.add_hips(rows.keypoints[:, hips].mean(axis=1))
                missing = np.asarray(np.isnan(rows.keypoints[:, head]).any(axis=(1, 2)))
                confidence = rows.confidence[:, head].min(axis=1)
                # Kinect has confidence levels, the first of which are guesses.
                scaled_confidence = (
                    np.minimum(confidence / skeleton.full_confidence, 1) if skeleton.full_confidence > 1 else confidence
                )
                builder.add(
                    rows.times * options.tick,
                    rows.ids,
                    origin,
                    direction,
                    rows=rows.lines,
                    tracking="head",
                    confidence=scaled_confidence,
                    drop={MISSING_KEYPOINT: missing},
                )
            checks.finish()


READERS = (SkeletonFile(),)


class GeometryChecks:
    """Checks of the width of heads, and of the position of bodies in the environment; ``unit`` is in metres."""

    def __init__(self, file: str, unit: float, builder: RaysBuilder) -> None:
        self._file, self._unit, self._builder = file, unit, builder
        self._widths: list[np.ndarray] = []
        self._hips: list[np.ndarray] = []

    def add_sides(self, left: np.ndarray, right: np.ndarray) -> None:
        """Add the positions of the sides of heads, (n, 3) each."""
        self._widths.append(self._unit * np.linalg.norm(left - right, axis=1))

    def add_hips(self, between: np.ndarray) -> None:
        """Add the midpoints of the hips of bodies, (n, 3)."""
        self._hips.append(self._unit * np.linalg.norm(between, axis=1))

    def finish(self) -> None:
        """Add warnings about implausible heads or bodies."""
        width, distance = (finite_median(values) for values in (self._widths, self._hips))
        if not np.isnan(width) and not _EAR_DISTANCES[0] < width < _EAR_DISTANCES[1]:
            self._builder.add_warning(
                f'the sides of the heads in "{sanitize(self._file, 60)}" are {width:.3g} m apart (median), which is '
                "not plausible: are the skeleton, the keypoints and the units those of the file?"
            )
        if distance < _MAX_HIP_OFFSET:
            self._builder.add_warning(
                f'the bodies in "{sanitize(self._file, 60)}" have their hips at the origin: positions are relative to '
                "the hips, and the file does not contain where participants were"
            )


def finite_median(values: list[np.ndarray]) -> float:
    """Median of the finite values; NaN if there are none."""
    finite = np.concatenate([v[np.isfinite(v)] for v in values] or [np.empty(0)])
    return float(np.median(finite)) if finite.size else np.nan


def _find_skeleton(path: Path, options: SkeletonOptions, builder: RaysBuilder) -> tuple[str, Layout]:
    """Find the name of the skeleton by the number of values per line of ``path``, and the layout of its lines."""
    values = count_values(path)
    if values is None:
        # The lines are reported as bad when they are read.
        return options.skeleton or PAPER_SKELETON, Layout(SKELETONS[options.skeleton or PAPER_SKELETON].keypoints)
    names = [options.skeleton] if options.skeleton else list(SKELETONS)
    matches = [
        (name, layout)
        for name in names
        for layout in (Layout(SKELETONS[name].keypoints, width) for width in (3, 4))
        if layout.num_values == values
    ]
    if not matches:
        available = ", ".join(f"{name} ({SKELETONS[name].keypoints})" for name in names)
        raise NergError(
            f'the lines of "{path}" have {values} numbers, which matches no known skeleton: '
            f"{available}, each with 3 numbers (x, y, z) or 4 (with a confidence); write the keypoints of one of these"
        )
    name, layout = matches[0]
    if options.skeleton is None and name != PAPER_SKELETON:
        alternatives = "".join(f" (or {other}, with the same number)" for other, _ in matches[1:])
        builder.add_warning(
            f'"{sanitize(path.name, 60)}" has {layout.keypoints} keypoints; {SKELETONS[name].title} is '
            f"assumed{alternatives}: set it with {parameter('skeleton')}"
        )
    return name, layout
