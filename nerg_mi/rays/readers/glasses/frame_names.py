"""Which images of a model are frames of a recording's video, and when they were taken, by their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain

_FIELDS = {
    "{frame0}": r"(?P<frame0>\d{1,12})",
    "{frame1}": r"(?P<frame1>\d{1,12})",
    "{s}": r"(?P<s>\d{1,12}(?:\.\d{1,12})?)",
    "{ns}": r"(?P<ns>\d{1,20})",
}
_HOW = (
    "write the names of the video's frames with {frame0} or {frame1} (their number in the video, counted from 0 or 1), "
    "{s} (seconds from its first frame on) or {ns} (the recording's time stamps), * for what varies besides and "
    '{recording} for the recording\'s name: "frame_{frame1}"'
)


@dataclass(frozen=True)
class FrameNames:
    """``pattern``: the end of a frame's path without its suffix, with one of the fields that `_HOW` names."""

    pattern: str

    def __post_init__(self) -> None:
        if sum(self.pattern.count(field) for field in _FIELDS) != 1:
            raise NergError(f'--frames is "{plain(self.pattern, 80)}"; {_HOW}')

    @classmethod
    def parse(cls, text: str) -> FrameNames:
        return cls(text)

    def __str__(self) -> str:
        return self.pattern

    @property
    def of_recording(self) -> bool:
        """Whether names tell which recording a frame is of."""
        return "{recording}" in self.pattern

    @property
    def needs_frames(self) -> bool:
        """Whether names are turned into times by those of the video's frames."""
        return "{ns}" not in self.pattern

    def times(
        self, names: Sequence[str], recording: str, frames: np.ndarray | None, fps: float | None, start: float
    ) -> np.ndarray:
        """Seconds (N,) on the recording's clock at which images of these ``names`` were taken, NaN for those that are
        no frames of the ``recording``.

        ``frames``: seconds of the video's frames, (F,), or None where they are not there. ``fps``: numbers count frames
        of this steady rate, into which FFmpeg's filter of that name has turned the video. ``start``: what {ns} is
        counted from, in nanoseconds. Raises `NergError` where no name fits, or one counts a frame that there is not.
        """
        parts = re.split(r"(\{frame0\}|\{frame1\}|\{s\}|\{ns\}|\{recording\}|\*)", self.pattern)
        known = {**_FIELDS, "{recording}": re.escape(recording), "*": "[^/]*"}
        pattern = re.compile(r"(?:.*/)?" + "".join(known.get(p, re.escape(p)) for p in parts) + r"(?:\.[A-Za-z0-9]+)?")
        out = np.full(len(names), np.nan)
        for i, name in enumerate(names):
            found = pattern.fullmatch(name[:4096])
            if found is not None:
                ((kind, text),) = found.groupdict().items()
                out[i] = self._time(kind, text, name, frames, fps, start)
        if not np.isfinite(out).any():
            shown = ", ".join(plain(n, 60) for n in names[:3])
            raise NergError(
                f'no image of the model is called "{plain(self.pattern, 80)}" for the recording '
                f'"{plain(recording, 60)}" (its first are {shown}); correct --frames: {_HOW}'
            )
        return out

    def _time(
        self, kind: str, text: str, name: str, frames: np.ndarray | None, fps: float | None, start: float
    ) -> float:
        if kind == "ns":
            return (int(text) - int(start)) * 1e-9
        if kind == "s":
            return float(text) + (0.0 if frames is None or not len(frames) else float(frames[0]))
        index = int(text) - (kind == "frame1")
        if frames is None and fps is None:
            raise NergError(
                "the recording has no times of its video's frames, which its numbers count; put the file that has them "
                "beside the gaze (Tobii: the scene video, Neon: world_timestamps.csv), or give a steady rate with --fps"
            )
        if frames is None and index >= 0:
            return index / fps
        position = index if fps is None or frames is None else _resampled(index, frames, fps)
        if frames is None or not 0 <= position < len(frames):
            of = "" if frames is None else f", which has {len(frames)}"
            of += "" if fps is None else f" ({fps:g} a second were counted)"
            raise NergError(
                f'"{plain(name, 80)}" is frame {index} of the video, counted from 0{of}; check --frames, and --fps '
                "where not every frame was taken"
            )
        return float(frames[position])


def _resampled(index: int, frames: np.ndarray, fps: float) -> int:
    """Which of the ``frames`` (F,) FFmpeg's filter fps shows as its frame ``index``; F where there is none.

    Each frame goes to the nearest tick of the steady rate, and a tick shows the last frame that came to it or before:
    at five a second of 25, the third, eighth, thirteenth frame, 0.08 s later than a fifth of a second times the index.
    """
    ticks = np.floor((frames - frames[0]) * fps + 0.5)
    # The last frame lasts as long as the others do.
    lasting = np.median(np.diff(frames)) if len(frames) > 1 else 0.0
    if index > np.floor((frames[-1] - frames[0] + lasting) * fps + 0.5):
        return len(frames)
    return int(np.searchsorted(ticks, index, side="right")) - 1
