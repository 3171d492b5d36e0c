"""Markers of motion capture: C3D files, and heads from their markers."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import translate_read_errors, check_regular_file
from nerg_mi.ranges import ELEVATIONS, ValidatedDataclass

from . import poses
from .base import DESCRIPTION, UNITS, UPS, RaysBuilder, Signature, TrackingFrame, option
from .poses import fill_values
from .skeleton import FACE, MISSING, PITCH, PlaceChecks, Places, head_poses, median_of, parse_keypoints
from .table import person_from_filename

# ---- C3D files of motion capture, read by the package c3d, an optional extra ----

_BLOCK = 1 << 13  # frames that are read at a time
# What c3d raises of a damaged file besides: it asserts, and uses parameters and variables that are not there.
_DAMAGED = (AssertionError, AttributeError, TypeError, ZeroDivisionError, UnboundLocalError)


@dataclass(frozen=True)
class MarkerHeader:
    """What a file says of its markers: their ``labels`` in order, the ``rate`` of its frames a second, how many of them
    there are, the ``unit`` of length as it is written, the axis that points ``up`` on a screen ("+Z"), or "", and the
    labels of the ``analog`` channels."""

    labels: list[str]
    rate: float
    frames: int
    unit: str
    up: str
    analog: list[str]


def read_header(path: Path) -> MarkerHeader:
    """The header of a C3D file. Raises `NergError` for what is none, and ``ImportError`` without c3d."""
    with _opened(path) as file:
        labels: list[str] = []
        for name in ("LABELS", *(f"LABELS{k}" for k in range(2, 259))):
            parameter = file.get(f"POINT:{name}")
            if parameter is None:
                break
            labels += [str(label).strip() for label in np.ravel(parameter.string_array)]
        unit, axes = file.get("POINT:UNITS"), file.get_screen_axis()
        analog = [str(label).strip() for label in np.ravel(file.analog_labels)] if file.analog_used else []
        return MarkerHeader(
            labels[: file.point_used],
            float(file.point_rate),
            file.frame_count,
            # Some write it once a marker.
            " ".join(dict.fromkeys(unit.string_value.split())) if unit is not None else "",
            axes[1].strip().upper() if axes is not None else "",
            analog,
        )


def iterate_markers(path: Path, wanted: Sequence[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Numbers of frames (n,), from 0, and positions (n, W, 3) of the ``wanted`` markers, NaN where they were not seen,
    block by block."""
    with _opened(path) as file:
        frames = (points[list(wanted)] for _, points, _ in file.read_frames(analog_transform=False))
        start = 0
        while True:
            with _without_warnings():
                block = list(itertools.islice(frames, _BLOCK))
            if not block:
                return
            yield start + np.arange(len(block)), _positions(block)
            start += len(block)


def _positions(block: list[np.ndarray]) -> np.ndarray:
    points = np.stack(block).astype(np.float64)
    unseen = (points[:, :, 3] < 0) | np.isfinite(fill_values(points[:, :, :3]))
    return np.where(unseen[:, :, None], np.nan, points[:, :, :3])


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        import c3d
    except ImportError:
        raise ImportError('C3D files need c3d, which is not installed: pip install "nerg-mi[mocap]"') from None
    check_regular_file(path, "C3D file")
    with translate_read_errors(path, "C3D file", "export it again", _DAMAGED), open(path, "rb") as file:
        if file.read(2)[1:] != b"\x50":
            raise ValueError("it does not begin as a C3D file does")
        file.seek(0)
        with _without_warnings():
            content = c3d.Reader(file)
        yield content


@contextmanager
def _without_warnings() -> Iterator[None]:
    """c3d warns of parameters that are not needed here, and of frames that are missing, which the reader counts."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


# ---- Heads by the markers of a motion capture system: C3D files ----

# Of Plug-in Gait (Vicon), and of Qualisys' markers of gait and of animation. Underscores are not compared.
_HEADS: tuple[Places, ...] = (
    FACE,
    ("LFHD+LBHD", "RFHD+RBHD", "LFHD+RFHD"),
    ("L_HDF+L_HDB", "R_HDF+R_HDB", "L_HDF+R_HDF"),
    ("HeadL", "HeadR", "HeadFront"),
)
_LEVEL = 15.0  # degrees: heads look farther up or down, at the median, only where their markers are not level
_NAMED = 12  # markers, in messages


@dataclass(frozen=True, kw_only=True)
class MarkerOptions(ValidatedDataclass):
    """Which markers are on a head, and what the file does not say of the laboratory."""

    keypoints: Places | None = option(
        None,
        "Markers at the left and the right of the head and at its front, or means of some: LFHD+LBHD.",
        shown=" or ".join(",".join(map(str, head)) for head in _HEADS),
        parse=parse_keypoints,
        recorded=False,
    )
    pitch: float = option(0.0, PITCH, within=ELEVATIONS)
    units: str | None = option(None, "Unit of length: m, cm or mm.", shown="the file's", recorded=False)
    up: str | None = option(None, "Up axis: x, y, z, -x, -y or -z.", shown="the file's, or z", recorded=False)


class C3d:
    """One ray a frame and person: from midway between the sides of a head through its front.

    Markers are chosen by their labels; of ``Anna:LFHD`` the person is Anna, otherwise the person is the file. Frames in
    which one of the head's markers was not seen are dropped. Seconds count from the first frame.
    """

    name = "c3d"
    files = "`*.c3d` of motion capture with markers on the head (`pip install 'nerg-mi[mocap]'`)"
    world = "the laboratory's, right-handed, in the file's unit, whose `POINT:Y_SCREEN` or `--up` points up"
    checked_on = DESCRIPTION
    signature = Signature(ending=".c3d")
    Options = MarkerOptions

    def frame(self, files: Sequence[Path], options: MarkerOptions) -> TrackingFrame:
        ups = {options.up} if options.up else {_up(read_header(path)) or "z" for path in files}
        if len(ups) > 1:
            raise NergError(f"the files differ in which axis points up ({', '.join(sorted(ups))}); import them apart")
        return TrackingFrame(up=next(iter(ups), "z"))

    def read(self, files: Sequence[Path], options: MarkerOptions, builder: RaysBuilder) -> None:
        for path in files:
            builder.source(path)
            header = read_header(path)
            heads = _heads(path, header, options)
            unit = _unit(path, header, options)
            up = poses.axis(self.frame([path], options).up, "up")
            if options.up is None and _up(header) is None:
                builder.complain(f'"{sanitize(path.name, 60)}" does not say which axis points up; z was taken (--up)')
            if not header.rate > 0:
                raise NergError(f'"{path}" does not say how many frames a second it has; export it again')
            places = next(iter(heads.values()))[0]
            builder.note(keypoints=list(places))
            checks = PlaceChecks(path.name, 1.0, builder)
            wanted = sorted({k for _, groups in heads.values() for group in groups for k in group})
            others = [label for k, label in enumerate(header.labels) if k not in wanted]
            builder.note_unused([*others, *(f"analog channel {label}" for label in header.analog)])
            count, elevations = 0, [np.empty(0)]
            for frames, points in iterate_markers(path, wanted):
                count += len(frames)
                for person, (_, groups) in heads.items():
                    at = [np.searchsorted(wanted, group) for group in groups]
                    left, right, front = (unit * points[:, group].mean(axis=1) for group in at)
                    origin, direction = head_poses(left, right, front, pitch=options.pitch)
                    checks.add_sides(left, right)
                    elevations.append(np.degrees(np.arcsin(np.clip(direction @ up, -1, 1))))
                    missing = np.asarray(np.isnan(points[:, np.concatenate(at)]).any(axis=(1, 2)))
                    builder.add(
                        frames / header.rate, person, origin, direction, rows=frames + 1, drop={MISSING: missing}
                    )
            if not count:
                raise NergError(f'"{path}" holds none of the {header.frames:,} frames of its header; export it again')
            # Whether frames count from 0 or 1 is not said.
            if count < header.frames - 1:
                builder.complain(
                    f'"{sanitize(path.name, 60)}" ends after {count:,} of the {header.frames:,} frames of its header: was '
                    "it copied whole?"
                )
            checks.finish()
            middle = median_of(elevations)
            if abs(middle) > _LEVEL:
                builder.complain(
                    f'the heads in "{sanitize(path.name, 60)}" point {middle:.0f} degrees up (median): are the markers at '
                    "the front of the head as high as those at its sides? "
                    f"--pitch {options.pitch - middle:.0f} levels them"
                )


READERS = (C3d(),)


def _up(header: MarkerHeader) -> str | None:
    """The axis that points up, where the file says so. Its sign is not that of up: Qualisys writes -Z of z up."""
    axis = header.up.lower()[-1:]
    return axis if axis in UPS else None


def _unit(path: Path, header: MarkerHeader, options: MarkerOptions) -> float:
    """Metres of the file's unit of length."""
    name = options.units or header.unit.lower()
    if name not in UNITS:
        problem = f'is in "{sanitize(header.unit, 20)}"' if header.unit else "names no unit of length"
        raise NergError(f'"{path}" {problem}; say whether it is in m, cm or mm (--units)')
    return UNITS[name]


def _heads(path: Path, header: MarkerHeader, options: MarkerOptions) -> dict[str, tuple[Places, list[list[int]]]]:
    """Of each person with markers on the head: these, and their numbers."""
    if not header.labels:
        raise NergError(f'"{path}" holds no markers, but {len(header.analog)} analog channels; export the markers too')
    bodies: dict[str, dict[str, int]] = {}
    for k, label in enumerate(header.labels):
        person, _, marker = label.rpartition(":")
        bodies.setdefault(person, {}).setdefault(_plainly(marker), k)
    heads = {}
    for person, markers in bodies.items():
        for places in _HEADS if options.keypoints is None else (options.keypoints,):
            groups = [[markers.get(_plainly(word)) for word in str(place).split("+")] for place in places]
            whole = [[k for k in group if k is not None] for group in groups]
            if whole == groups:
                heads[person or person_from_filename(path)] = places, whole
                break
    if not heads:
        there = [sanitize(label, 40) for label in header.labels]
        more = "" if len(there) <= _NAMED else f" and {len(there) - _NAMED} more"
        raise NergError(
            f'no markers of a head are recognised in "{path}", whose markers are {", ".join(there[:_NAMED])}{more}; '
            "name those at its left, its right and its front, as in --keypoints LTEMP,RTEMP,NOSE"
        )
    return heads


def _plainly(marker: str) -> str:
    """The label of a marker in the spelling in which labels are compared."""
    return marker.strip().replace("_", "").replace(" ", "").lower()
