"""Skeletons: files of joints, bodies with named keypoints, and the heads and gaze that follow from them."""

from __future__ import annotations

import gzip
import io
import itertools
import operator
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.atomic import replace_atomically
from nerg_mi.files.safe_read import BadLineCallback, read_line_blocks
from nerg_mi.ranges import ELEVATIONS

from .base import DESCRIPTION, UNITS, RaysBuilder, Signature, TickOption, TrackingFrame, option
from .poses import fill_values

# ---- The skeleton file: one pose a line, ``id|time|[numbers]`` ----
#
# The tracking format of the NeRG paper (Section 5.1): a person's id, an integer time or frame number, and keypoints
# (there 22) of three coordinates each, or of three and a confidence. A keypoint that was not seen is ``nan``, lies at
# exactly 0, 0, 0 or another fill value, or has no confidence. What the keypoints mean is the business of
# :mod:`nerg_mi.rays.readers.skeleton`.

KEYPOINTS = 22
_SNIFFED = 1000  # lines, of which the first one that is whole says how many numbers there are


class Layout(NamedTuple):
    """How the numbers of a line are divided."""

    keypoints: int = KEYPOINTS
    width: int = 3  # x, y, z; or 4, with a confidence

    @property
    def values(self) -> int:
        return self.keypoints * self.width

    def __str__(self) -> str:
        return f"{self.keypoints} keypoints of x, y, z" + (" and a confidence" if self.width == 4 else "")


PAPER_LAYOUT = Layout()


class SkeletonRows(NamedTuple):
    """A run of N poses of K keypoints."""

    ids: np.ndarray  # (N,) str
    times: np.ndarray  # (N,) int64, in the file's unit
    keypoints: np.ndarray  # (N, K, 3) float64, NaN where unseen
    lines: np.ndarray  # (N,) int64, the 1-based line of the file that each stands on
    confidence: np.ndarray  # (N, K) float64, of the keypoints that are wanted; one where the file has none


def write_skeleton(
    path: str | os.PathLike, ids: Sequence[str], times: np.ndarray, keypoints: np.ndarray, *, decimals: int = 6
) -> None:
    """Write poses in the order given; a name ending in ``.gz`` is compressed.

    ``ids``: N names without ``|`` or line breaks. ``times``: (N,) integers. ``keypoints``: (N, K, 3), NaN where unseen,
    or (N, K, 4) with confidences. ``decimals``: digits after the point; 6 (a micrometre) turns a head by at most 1e-5
    rad. Equal input gives equal bytes. Raises ``ValueError`` for wrong shapes, times that are not integers, or an id
    that the format cannot hold.
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
            raise NergError(f"id {name!r} of pose {i} is empty or holds '|' or a line break; rename the person")

    flat = keypoints.reshape(n, -1)
    form = ", ".join([f"%.{decimals}f"] * flat.shape[1])
    with replace_atomically(path) as temporary, _written(temporary, Path(path).name) as out:
        for name, time, values in zip(ids, times, flat):
            out.write(f"{name}|{int(time)}|[{form % tuple(values)}]\n")


def count_values(path: str | os.PathLike) -> int | None:
    """How many numbers the first line has that follows the format; None where none of the first lines does."""
    for block in read_line_blocks(path, "skeleton file", _SNIFFED):
        bodies = [fields[2].strip() for line in block if len(fields := line.split("|")) == 3]
        return next((body.count(",") + 1 for body in bodies if body[:1] == "[" and body[-1:] == "]"), None)
    return None


def iterate_skeleton(
    path: str | os.PathLike,
    chunk: int = 8192,
    keypoints: Sequence[int] | None = None,
    on_bad: BadLineCallback | None = None,
    layout: Layout = PAPER_LAYOUT,
) -> Iterator[SkeletonRows]:
    """Yield the poses of a file in runs of at most ``chunk`` lines, so that
    memory stays bounded (a day of a store is some 2.6 million lines).

    ``keypoints``: which of those of the ``layout`` are wanted; the others are counted but not converted, and come out
    NaN. Empty lines are skipped. Raises `NergError` for a damaged file and, naming file and line, for a line that does
    not follow the format; where ``on_bad`` is given, that is told of such lines, which are left out.
    """
    wanted = range(layout.keypoints) if keypoints is None else sorted(set(keypoints))
    columns = [layout.width * k + i for k in wanted for i in range(layout.width)]
    before = 0
    for block in read_line_blocks(path, "skeleton file", chunk):
        ids: list[str] = []
        times: list[int] = []
        texts: list[str] = []
        lines: list[int] = []
        for number, line in enumerate(block, start=before + 1):
            line = line.strip()
            if not line:
                continue
            found = _fields(line, layout)
            if isinstance(found, str):
                _refuse(path, number, found, on_bad)
                continue
            ids.append(found[0])
            times.append(found[1])
            texts.append(found[2])
            lines.append(number)
        before += len(block)
        if ids:
            rows = _rows(path, ids, times, texts, lines, columns, on_bad, layout)
            if len(rows.ids):
                yield rows


def _fields(line: str, layout: Layout) -> tuple[str, int, str] | str:
    """Id, time and the text of the numbers of a line; or what is wrong with it."""
    fields = line.split("|")
    if len(fields) != 3:
        return f": {len(fields)} fields separated by '|', expected id|time|[{layout.values} numbers]"
    body = fields[2].strip()
    if not (body.startswith("[") and body.endswith("]")):
        return ": the keypoints are not enclosed in '[' and ']'"
    if body.count(",") != layout.values - 1:
        return f": {body.count(',') + 1} numbers, expected {layout.values} ({layout})"
    try:
        time = int(fields[1])
    except ValueError:
        return f": the time {sanitize(fields[1], 40)!r} is not an integer"
    if not -(1 << 63) <= time < 1 << 63:
        return f": the time {sanitize(fields[1], 40)!r} is too large for 64 bits"
    return fields[0].strip(), time, body[1:-1]


def _refuse(path: str | os.PathLike, line: int, why: str, on_bad: BadLineCallback | None) -> None:
    if on_bad is None:
        raise NergError(
            f"{path}, line {line}{why}; mend or remove the line, or leave such lines out with --skip-bad-lines"
        )
    on_bad(line, why)


def read_skeleton(path: str | os.PathLike, layout: Layout = PAPER_LAYOUT) -> SkeletonRows:
    """All poses of a file at once; see :func:`iterate_skeleton` for the errors."""
    runs = list(iterate_skeleton(path, layout=layout))
    if not runs:
        raise NergError(f"{path} holds no poses; expected lines id|time|[{layout.values} numbers]")
    return SkeletonRows(*(np.concatenate(column) for column in zip(*runs)))


def _rows(
    path: str | os.PathLike,
    ids: list[str],
    times: list[int],
    texts: list[str],
    lines: list[int],
    columns: list[int],
    on_bad: BadLineCallback | None,
    layout: Layout,
) -> SkeletonRows:
    # One conversion for the whole run; only when it fails is the line searched for.
    pick = operator.itemgetter(*columns)
    try:
        found = _numbers(texts, columns, pick, fast=len(columns) == layout.values)
    except ValueError:
        kept = []
        for i, (line, text) in enumerate(zip(lines, texts)):
            word = next((w for w in pick(text.split(",")) if not _is_number(w)), None)
            if word is None:
                kept.append(i)
            else:
                _refuse(path, line, f": {sanitize(word.strip(), 60)!r} is not a number", on_bad)
        ids, times, texts, lines = ([column[i] for i in kept] for column in (ids, times, texts, lines))
        # NumPy knows fewer spellings than Python.
        found = _numbers(texts, columns, pick, fast=False)
    values = np.full((len(ids), layout.values), np.nan)
    values[:, columns] = found
    values = values.reshape(len(ids), *layout)
    points, confidence = values[:, :, :3], values[:, :, 3] if layout.width == 4 else np.ones(values.shape[:2])
    points[np.isfinite(fill_values(points)) | ~(confidence > 0)] = np.nan
    return SkeletonRows(
        np.array(ids, dtype=str), np.array(times, dtype=np.int64), points, np.array(lines, dtype=np.int64), confidence
    )


def _numbers(texts: list[str], columns: list[int], pick: operator.itemgetter, fast: bool) -> np.ndarray:
    if fast:
        return np.loadtxt(texts, delimiter=",", comments=None, dtype=np.float64, ndmin=2)
    # Faster than loadtxt's usecols, which converts what it leaves out.
    words = itertools.chain.from_iterable(pick(text.split(",")) for text in texts)
    return np.fromiter(map(float, words), dtype=np.float64, count=len(texts) * len(columns)).reshape(-1, len(columns))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


@contextmanager
def _written(path: Path, name: str) -> Iterator[IO[str]]:
    """A text file to write, compressed where ``name``, that which it will have, ends in ``.gz``."""
    with path.open("wb") as raw:
        if not name.endswith(".gz"):
            with io.TextIOWrapper(raw, encoding="utf-8", newline="\n") as out:
                yield out
            return
        # With its later name in it and no time: equal poses give equal bytes, whenever they are written.
        with io.TextIOWrapper(gzip.GzipFile(name, "wb", fileobj=raw, mtime=0), encoding="utf-8", newline="\n") as out:
            yield out


# ---- Skeletons by the names of their keypoints, the head poses that they give, and bodies for given head poses ----
#
# The paper's proxy for gaze (Section 5.1): a ray from the midpoint of the ears through the nose.

# Of the paper's skeleton these are documented: columns 6:9, 39:42 and 33:36 of the file.
LEFT_EAR, RIGHT_EAR, NOSE = 2, 13, 11


@dataclass(frozen=True)
class Skeleton:
    """A convention of keypoints: how many there are, and the numbers, from 0, of those by which a body is oriented.

    Left and right are the person's. ``sure``: the confidence from which a keypoint was seen for certain.
    """

    title: str
    keypoints: int
    joints: Mapping[str, int]
    sure: float = 1.0

    def numbers(self, place: int | str) -> list[int]:
        """The keypoints of which ``place`` is the mean: a number, a name, or several of either, joined by "+".

        Raises `NergError` naming those there are.
        """
        words = [self.joints.get(word.strip(), word.strip()) for word in str(place).split("+")]
        numbers = [int(k) if str(k).isdecimal() and len(str(k)) < 9 else self.keypoints for k in words]
        if max(numbers) >= self.keypoints:
            raise NergError(
                f'there is no keypoint "{place}" in {self.title}; name them by their numbers, 0 to '
                f"{self.keypoints - 1}, or as {', '.join(self.joints)} (--keypoints)"
            )
        return numbers


PAPER = "nerg22"
SKELETONS = {
    PAPER: Skeleton(
        "the NeRG paper's skeleton", KEYPOINTS, {"left_ear": LEFT_EAR, "right_ear": RIGHT_EAR, "nose": NOSE}
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
        sure=2.0,
    ),
    "kinect25": Skeleton(
        "Kinect v2",
        25,
        {"head": 3, "pelvis": 0, "left_shoulder": 4, "right_shoulder": 8, "left_hip": 12, "right_hip": 16},
        sure=2.0,
    ),
}
"""By name. Of several with as many keypoints, the first is the one that is meant without a name."""

EAR_DISTANCE = 0.15  # metres between the ears of an adult
NOSE_DISTANCE = 0.12  # metres from the midpoint of the ears to the tip of the nose
EAR_HEIGHT = 1.58  # metres: the height for which _BODY is written

# The other nineteen keypoints are unnamed in the published code. Bodies made
# here fill them as a standing adult: (to the left, forward, height) in metres.
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
    """Rays of the heads: from midway between their sides, which are the ears, through their front, the nose.

    ``left``, ``right``, ``front``: (N, 3). ``pitch``: degrees by which a ray is turned up about the line through the
    sides, since a nose lies below the ears and a level head then seems to look down. Returns ``origin`` (N, 3) in the
    unit given and ``direction`` (N, 3), unit; where a side or the front is NaN or the front lies midway between the
    sides, the direction is NaN. NeRG, Section 5.1.
    """
    left, right, front = (np.asarray(v, dtype=np.float64) for v in (left, right, front))
    origin = 0.5 * (left + right)
    direction = _unit(front - origin)
    if pitch:
        # Only the part across the sides turns; their line need not be square to the front.
        side = _unit(left - right)
        along = np.sum(direction * side, axis=1, keepdims=True) * side
        angle = np.radians(pitch)
        direction = along + np.cos(angle) * (direction - along) + np.sin(angle) * np.cross(direction, side)
    return origin, direction


def trunk_directions(left: np.ndarray, right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Where trunks face, (N, 3) unit: square to the line of the shoulders ``left``, ``right`` (N, 3) and to ``up``
    (N, 3), along the spine; NaN where that is nowhere."""
    return _unit(np.cross(left - right, up))


def _unit(v: np.ndarray) -> np.ndarray:
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
    """Standing bodies whose ears and nose give exactly these head poses.

    ``origin``: (N, 3) metres, z up, the midpoint of the ears. ``direction``: (N, 3), need not be unit. ``floor``:
    height of the floor in metres. Returns keypoints (N, 22, 3) with :func:`head_poses` of them equal to the input to
    rounding. The head is not tilted sideways; the body faces where the head faces and is scaled to its height. Raises
    ``ValueError`` for a zero or non-finite direction.
    """
    origin = np.atleast_2d(np.asarray(origin, dtype=np.float64))
    direction = np.atleast_2d(np.asarray(direction, dtype=np.float64))
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    bad = np.flatnonzero(~(np.isfinite(length[:, 0]) & (length[:, 0] > 0) & np.isfinite(origin).all(axis=1)))
    if bad.size:
        raise ValueError(f"head pose {bad[0]} has a zero or non-finite direction or origin; drop it first")
    forward = direction / length

    # Left is horizontal; a head that looks straight up or down has no heading of its own, and faces +x.
    flat = forward * (1.0, 1.0, 0.0)
    flat_length = np.linalg.norm(flat, axis=1, keepdims=True)
    heading = np.where(flat_length > 1e-9, flat / np.maximum(flat_length, 1e-9), (1.0, 0.0, 0.0))
    left = np.stack([-heading[:, 1], heading[:, 0], np.zeros(len(heading))], axis=1)
    crown = np.cross(forward, left)

    out = np.empty((len(origin), KEYPOINTS, 3))
    out[:, LEFT_EAR] = origin + 0.5 * ear_distance * left
    out[:, RIGHT_EAR] = origin - 0.5 * ear_distance * left
    out[:, NOSE] = origin + nose_distance * forward
    eyes = origin + 0.75 * nose_distance * forward + 0.25 * nose_distance * crown
    out[:, _LEFT_EYE] = eyes + 0.2 * ear_distance * left
    out[:, _RIGHT_EYE] = eyes - 0.2 * ear_distance * left

    scale = (origin[:, 2:] - floor) / EAR_HEIGHT
    foot = np.concatenate([origin[:, :2], np.full((len(origin), 1), float(floor))], axis=1)
    for k, (aside, ahead, height) in _BODY.items():
        out[:, k] = foot + scale * (aside * left + ahead * heading) + scale * height * np.array([0.0, 0.0, 1.0])
    return out


# ---- Tracked bodies as skeletons of keypoints: their heads' rays, from between the ears through the nose ----

Places = tuple[int | str, int | str, int | str]
"""The left and the right side of a head, and its front: keypoints or markers, or means of some, joined by "+"."""

FACE: Places = ("left_ear", "right_ear", "nose")
PITCH = "Degrees by which rays are turned up, since a nose lies below the ears."
MISSING = "a keypoint of the head is missing"
"""Why a pose is dropped, whose keypoint is NaN, lies at exactly 0, 0, 0 or has no confidence."""

_TRUNK = ("left_shoulder", "right_shoulder", "head", "pelvis")
_EARS = (0.08, 0.3)  # metres: sides of a head are not nearer to each other, nor farther apart
_AT_THE_HIPS = 1e-3  # metres from the origin to between the hips: positions are relative to them


def parse_keypoints(text: str) -> Places:
    """``"2,13,11"`` or ``"left_ear,right_ear,left_eye+right_eye"`` as three places. Raises `NergError` for others."""
    words = [word.strip() for word in text.split(",")]
    if len(words) != 3 or not all(words):
        raise NergError(f"--keypoints is three places: left ear, right ear, nose; got {text!r}")
    left, right, front = (int(word) if word.isdecimal() else word for word in words)
    return left, right, front


@dataclass(frozen=True, kw_only=True)
class SkeletonOptions(TickOption):
    """Which skeleton the keypoints are of, which of them are a head, and how it is held."""

    skeleton: str | None = option(
        None, f"Convention of the keypoints: {', '.join(SKELETONS)}.", shown="by their number", recorded=False
    )
    keypoints: Places | None = option(
        None,
        "Left ear, right ear, nose: numbers from 0 or names, or means of some, as left_eye+right_eye.",
        shown=",".join(map(str, FACE)),
        parse=parse_keypoints,
        recorded=False,
    )
    pitch: float = option(0.0, PITCH, within=ELEVATIONS)
    units: str = option("m", "Unit of length: m, cm or mm.", recorded=False)
    up: str = option("z", "Up axis: x, y, z, -x, -y or -z.", recorded=False)
    handedness: str = option("right", "Handedness: right or left.", flag="--hand", recorded=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.skeleton is not None and self.skeleton not in SKELETONS:
            raise NergError(f'there is no skeleton "{self.skeleton}"; --skeleton is one of {", ".join(SKELETONS)}')


def _recognize(line: str) -> str | None:
    words = line.split("|")
    return "its lines are id|time|[keypoints]" if len(words) == 3 and words[2].lstrip().startswith("[") else None


class SkeletonFile:
    """One ray a pose: from the midpoint of the ears through the nose (NeRG, Section 5.1).

    The file's integer time is multiplied by ``tick``; `head_poses` says how ``pitch`` turns. Poses in which one
    of these keypoints is missing are dropped. A skeleton without a face (Kinect v2) gives the trunk's direction, which
    is said, as is a skeleton that was taken by the number of its keypoints.
    """

    name = "skeleton"
    files = (
        "`id|time|[numbers]`, a pose a line, x, y, z (or x, y, z, confidence) of each keypoint: the 22 of the NeRG "
        "paper's tracking, COCO-17, BODY_25 of OpenPose, MediaPipe's 33, Azure Kinect's 32 or Kinect v2's 25; from the "
        "midpoint of the ears through the nose"
    )
    world = "declared: `--up`, `--hand`, `--units`"
    checked_on = DESCRIPTION
    signature = Signature(
        line=_recognize, question="the unit of the time (--tick); the card tells which would give a device's rate"
    )
    Options = SkeletonOptions

    def frame(self, files: Sequence[Path], options: SkeletonOptions) -> TrackingFrame:
        return TrackingFrame(options.up, options.handedness, options.units)

    def read(self, files: Sequence[Path], options: SkeletonOptions, builder: RaysBuilder) -> None:
        for path in files:
            builder.source(path)
            name, layout = _skeleton_of(path, options, builder)
            skeleton = SKELETONS[name]
            places: tuple[int | str, ...] = options.keypoints or (FACE if "nose" in skeleton.joints else _TRUNK)
            groups = [skeleton.numbers(place) for place in places]
            if len({tuple(sorted(group)) for group in groups}) < len(groups):
                raise NergError(f"the places {', '.join(map(str, places))} are not all different (--keypoints)")
            head = [k for group in groups for k in group]
            hips = [skeleton.joints[hip] for hip in ("left_hip", "right_hip") if hip in skeleton.joints]
            builder.note(skeleton=name, keypoints=list(places))
            names = {k: joint for joint, k in skeleton.joints.items()}
            builder.note_unused(names.get(k, f"keypoint {k}") for k in range(skeleton.keypoints) if k not in head)
            if places == _TRUNK:
                builder.complain(
                    f"{skeleton.title} has no keypoints of the face: rays point where the trunk faces, square to the "
                    "shoulders and the spine, and the head may be turned"
                )
            checks = PlaceChecks(path.name, UNITS[options.units], builder)
            for rows in iterate_skeleton(path, keypoints=[*head, *hips], on_bad=builder.on_bad, layout=layout):
                left, right, front = (rows.keypoints[:, group].mean(axis=1) for group in groups[:3])
                if places == _TRUNK:
                    origin = front
                    direction = trunk_directions(left, right, front - rows.keypoints[:, groups[3]].mean(axis=1))
                else:
                    origin, direction = head_poses(left, right, front, pitch=options.pitch)
                    checks.add_sides(left, right)
                if hips:
                    checks.add_hips(rows.keypoints[:, hips].mean(axis=1))
                missing = np.asarray(np.isnan(rows.keypoints[:, head]).any(axis=(1, 2)))
                confidence = rows.confidence[:, head].min(axis=1)
                # Kinect has levels, of which the first ones are guesses.
                sure = np.minimum(confidence / skeleton.sure, 1) if skeleton.sure > 1 else confidence
                builder.add(
                    rows.times * options.tick,
                    rows.ids,
                    origin,
                    direction,
                    rows=rows.lines,
                    confidence=sure,
                    drop={MISSING: missing},
                )
            checks.finish()


READERS = (SkeletonFile(),)


class PlaceChecks:
    """Whether the heads of a file are as wide as heads, and its bodies in a place: both in ``unit`` metres."""

    def __init__(self, file: str, unit: float, builder: RaysBuilder) -> None:
        self._file, self._unit, self._builder = file, unit, builder
        self._widths: list[np.ndarray] = []
        self._hips: list[np.ndarray] = []

    def add_sides(self, left: np.ndarray, right: np.ndarray) -> None:
        """Add the sides of heads, (n, 3) each."""
        self._widths.append(self._unit * np.linalg.norm(left - right, axis=1))

    def add_hips(self, between: np.ndarray) -> None:
        """Add the points between the hips of bodies, (n, 3)."""
        self._hips.append(self._unit * np.linalg.norm(between, axis=1))

    def finish(self) -> None:
        """Say on the card what no heads or bodies in a place can be."""
        width, distance = (median_of(values) for values in (self._widths, self._hips))
        if not np.isnan(width) and not _EARS[0] < width < _EARS[1]:
            self._builder.complain(
                f'the sides of the heads in "{sanitize(self._file, 60)}" are {width:.3g} m apart (median), which no ears '
                "are: are the skeleton, the keypoints and the units those of the file?"
            )
        if distance < _AT_THE_HIPS:
            self._builder.complain(
                f'the bodies in "{sanitize(self._file, 60)}" stand with their hips at the origin: positions are relative '
                "to them, and where people were is not in the file"
            )


def median_of(values: list[np.ndarray]) -> float:
    """The median of those that are not NaN; NaN where there are none."""
    finite = np.concatenate([v[np.isfinite(v)] for v in values] or [np.empty(0)])
    return float(np.median(finite)) if finite.size else np.nan


def _skeleton_of(path: Path, options: SkeletonOptions, builder: RaysBuilder) -> tuple[str, Layout]:
    """The name of the skeleton whose keypoints the lines of ``path`` hold, and how these lines are divided."""
    values = count_values(path)
    if values is None:
        # The lines themselves are refused, one by one.
        return options.skeleton or PAPER, Layout(SKELETONS[options.skeleton or PAPER].keypoints)
    names = [options.skeleton] if options.skeleton else list(SKELETONS)
    fits = [
        (name, layout)
        for name in names
        for layout in (Layout(SKELETONS[name].keypoints, width) for width in (3, 4))
        if layout.values == values
    ]
    if not fits:
        there = ", ".join(f"{name} ({SKELETONS[name].keypoints})" for name in names)
        raise NergError(
            f'the lines of "{path}" have {values} numbers, which are the keypoints of no skeleton that is read: '
            f"{there}, each with 3 numbers (x, y, z) or 4 (and a confidence)"
        )
    name, layout = fits[0]
    if options.skeleton is None and name != PAPER:
        others = "".join(f" (or {other}, with as many)" for other, _ in fits[1:])
        builder.complain(
            f'"{sanitize(path.name, 60)}" has {layout.keypoints} keypoints and was taken for {SKELETONS[name].title}'
            f"{others}: say which it is with --skeleton"
        )
    return name, layout
