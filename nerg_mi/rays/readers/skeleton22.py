"""The NeRG paper's tracking: skeletons of 22 keypoints, looked from by the ears and through the nose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError

from .builder import RaysBuilder
from .frames import RAYS, Frame
from .options import TickOption, option
from .parsing.bodies import LEFT_EAR, NOSE, RIGHT_EAR, head_poses
from .parsing.skeleton_file import iterate_skeleton
from .protocol import DESCRIPTION


def parse_keypoints(text: str) -> tuple[int, int, int]:
    """``"2,13,11"`` as three numbers. Raises `NergError` for other texts."""
    try:
        left, right, nose = (int(v) for v in text.split(","))
    except ValueError:
        raise NergError(f"--keypoints is three numbers: left ear, right ear, nose; got {text!r}") from None
    return left, right, nose


@dataclass(frozen=True, kw_only=True)
class SkeletonOptions(TickOption):
    """Which keypoints are a head, and how it is held."""

    keypoints: tuple[int, int, int] = option(
        (LEFT_EAR, RIGHT_EAR, NOSE),
        "Left ear, right ear, nose.",
        shown=f"{LEFT_EAR},{RIGHT_EAR},{NOSE}",
        parse=parse_keypoints,
    )
    pitch: float = option(0.0, "Degrees by which rays are turned up, since a nose lies below the ears.")


class Skeleton22:
    """One ray a pose: from the midpoint of the ears through the nose (NeRG, Section 5.1).

    The file's integer time is multiplied by ``tick``; how ``pitch`` turns is told at `head_poses`. Poses without ears
    or nose are dropped.
    """

    name = "skeleton22"
    files = "`id|time|[66 floats]`, the NeRG paper's tracking: from the midpoint of the ears through the nose"
    world = "z up, right, m"
    checked_on = DESCRIPTION
    Options = SkeletonOptions

    def frame(self, files: Sequence[Path], options: SkeletonOptions) -> Frame:
        return RAYS

    def read(self, files: Sequence[Path], options: SkeletonOptions, builder: RaysBuilder) -> None:
        left, right, nose = options.keypoints
        for path in files:
            builder.source(path)
            for rows in iterate_skeleton(path, keypoints=options.keypoints, on_bad=builder.on_bad):
                origin, direction = head_poses(rows.keypoints, ears=(left, right), nose=nose, pitch=options.pitch)
                builder.add(rows.times * options.tick, rows.ids, origin, direction, rows=rows.lines)


READERS = (Skeleton22(),)
