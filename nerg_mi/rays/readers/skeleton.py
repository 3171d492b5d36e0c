"""Tracked bodies as skeletons of keypoints: their heads' rays, from between the ears through the nose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain
from nerg_mi.ranges import ANGLES

from .builder import RaysBuilder
from .frames import UNITS, Frame
from .options import TickOption, option
from .parsing.bodies import PAPER, SKELETONS, head_poses, trunk_directions
from .parsing.skeleton_file import Layout, count_values, iterate_skeleton
from .protocol import DESCRIPTION

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
    pitch: float = option(0.0, PITCH, within=ANGLES)
    units: str = option("m", "Unit of length: m, cm or mm.", recorded=False)
    up: str = option("z", "Up axis: x, y, z, -x, -y or -z.", recorded=False)
    handedness: str = option("right", "Handedness: right or left.", flag="--hand", recorded=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.skeleton is not None and self.skeleton not in SKELETONS:
            raise NergError(f'there is no skeleton "{self.skeleton}"; --skeleton is one of {", ".join(SKELETONS)}')


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
    Options = SkeletonOptions

    def frame(self, files: Sequence[Path], options: SkeletonOptions) -> Frame:
        return Frame(options.up, options.handedness, options.units)

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
                f'the sides of the heads in "{plain(self._file, 60)}" are {width:.3g} m apart (median), which no ears '
                "are: are the skeleton, the keypoints and the units those of the file?"
            )
        if distance < _AT_THE_HIPS:
            self._builder.complain(
                f'the bodies in "{plain(self._file, 60)}" stand with their hips at the origin: positions are relative '
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
            f'"{plain(path.name, 60)}" has {layout.keypoints} keypoints and was taken for {SKELETONS[name].title}'
            f"{others}: say which it is with --skeleton"
        )
    return name, layout
