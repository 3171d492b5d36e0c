"""Markers: motion capture in C3D files, and head poses from markers.

A ray runs from midway between the left and right of the head through its front; means of markers are ``LFHD+LBHD``.
Unit and up axis are those of the file (``POINT:UNITS``, ``POINT:Y_SCREEN``, whose sign is not used) unless
``--units`` or ``--up`` override them. In ``Anna:LFHD`` the participant is Anna. Frames that lack a marker are
dropped. Beyond 15 degrees at the median the report gives the ``pitch`` that levels the headband.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.safe_read import check_regular_file, translate_read_errors
from nerg_mi.ranges import ELEVATIONS, ValidatedDataclass

from . import poses
from .base import FROM_DOCUMENTATION, UNITS, UP_AXES, RaysBuilder, Signature, TrackingFrame, option
from .poses import find_fill_values
from .skeleton import (
    FACE_KEYPOINTS,
    MISSING_KEYPOINT,
    PITCH_HELP,
    GeometryChecks,
    HeadKeypoints,
    finite_median,
    head_poses,
    parse_keypoints,
)
from .table import person_from_filename

# ---- C3D files of motion capture, read with the optional package c3d ----

_BLOCK = 1 << 13  # frames read at a time
# Further exceptions of c3d for damaged files: failed assertions, and missing parameters and variables.
_DAMAGE_ERRORS = (AssertionError, AttributeError, TypeError, ZeroDivisionError, UnboundLocalError)


@dataclass(frozen=True)
class MarkerHeader:
    """Header of a C3D file: ``labels`` of the markers in order, ``rate`` in frames per second, number of ``frames``,
    ``unit`` of length as written, ``up`` axis of the screen ("+Z", or ""), and labels of the ``analog`` channels."""

    labels: list[str]
    rate: float
    frames: int
    unit: str
    up: str
    analog: list[str]


def read_header(path: Path) -> MarkerHeader:
    """Read the header of a C3D file. Raises `NergError` for an invalid file, and ``ImportError`` without c3d."""
    with _open_c3d(path) as file:
        labels: list[str] = []
        for name in ("LABELS", *(f"LABELS{k}" for k in range(2, 259))):
            group = file.get(f"POINT:{name}")
            if group is None:
                break
            labels += [str(label).strip() for label in np.ravel(group.string_array)]
        unit, axes = file.get("POINT:UNITS"), file.get_screen_axis()
        analog = [str(label).strip() for label in np.ravel(file.analog_labels)] if file.analog_used else []
        return MarkerHeader(
            labels[: file.point_used],
            float(file.point_rate),
            file.frame_count,
            # Some programs write it once per marker.
            " ".join(dict.fromkeys(unit.string_value.split())) if unit is not None else "",
            axes[1].strip().upper() if axes is not None else "",
            analog,
        )


def iterate_markers(path: Path, markers: Sequence[int]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Iterate over blocks of frame numbers (n,), from 0, and positions (n, M, 3) of M ``markers`` (indices), NaN if not
    tracked."""
    with _open_c3d(path) as file:
        frames = (points[list(markers)] for _, points, _ in file.read_frames(analog_transform=False))
        start = 0
        while True:
            with _suppress_warnings():
                block = list(itertools.islice(frames, _BLOCK))
            if not block:
                return
            yield start + np.arange(len(block)), _stack_positions(block)
            start += len(block)


def _stack_positions(block: list[np.ndarray]) -> np.ndarray:
    points = np.stack(block).astype(np.float64)
    unseen = (points[:, :, 3] < 0) | np.isfinite(find_fill_values(points[:, :, :3]))
    return np.where(unseen[:, :, None], np.nan, points[:, :, :3])


@contextmanager
def _open_c3d(path: Path) -> Iterator[Any]:
    try:
        import c3d
    except ImportError:
        raise ImportError('C3D files need c3d, which is not installed: pip install "nerg-mi[mocap]"') from None
    check_regular_file(path, "C3D file")
    with translate_read_errors(path, "C3D file", "export it again", _DAMAGE_ERRORS), open(path, "rb") as file:
        if file.read(2)[1:] != b"\x50":
            raise ValueError("it does not start like a C3D file")
        file.seek(0)
        with _suppress_warnings():
            content = c3d.Reader(file)
        yield content


@contextmanager
def _suppress_warnings() -> Iterator[None]:
    """Suppress warnings of c3d about unused parameters, and about missing frames, which the reader counts itself."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


# ---- Head poses from markers in C3D files ----

# Marker sets of Plug-in Gait (Vicon), and of Qualisys for gait and animation. Underscores are ignored.
_HEAD_MARKERS: tuple[HeadKeypoints, ...] = (
    FACE_KEYPOINTS,
    ("LFHD+LBHD", "RFHD+RBHD", "LFHD+RFHD"),
    ("L_HDF+L_HDB", "R_HDF+R_HDB", "L_HDF+R_HDF"),
    ("HeadL", "HeadR", "HeadFront"),
)
_MAX_TILT = 15.0  # degrees; a larger median elevation means that the markers are not level
_MAX_LISTED_MARKERS = 12  # in messages


@dataclass(frozen=True, kw_only=True)
class MarkerOptions(ValidatedDataclass):
    """Markers of the head, and what the file does not contain."""

    keypoints: HeadKeypoints | None = option(
        None,
        "Markers at the left and right side of the head and at its front, or means of several: LFHD+LBHD.",
        default_text=" or ".join(",".join(map(str, head)) for head in _HEAD_MARKERS),
        parse=parse_keypoints,
        is_recorded=False,
    )
    pitch: float = option(0.0, PITCH_HELP, within=ELEVATIONS, flag="")
    units: str | None = option(None, "Unit of length: m, cm or mm.", default_text="the file's", is_recorded=False)
    up: str | None = option(None, "Up axis: x, y, z, -x, -y or -z.", default_text="the file's, or z", is_recorded=False)


class C3d:
    """One ray per frame and participant, from midway between the sides of the head through its front.

    Markers are selected by their labels; ``Anna:LFHD`` belongs to the participant Anna, labels without a prefix to the
    participant named like the file. Frames with a missing head marker are dropped. Times are seconds from the first
    frame.
    """

    name = "c3d"
    files = "`*.c3d` of motion capture with markers on the head (`pip install 'nerg-mi[mocap]'`)"
    frame_description = "that of the laboratory, right-handed, in the file's unit; `POINT:Y_SCREEN` or `--up` points up"
    evidence = FROM_DOCUMENTATION
    signature = Signature(ending=".c3d")
    Options = MarkerOptions

    def frame(self, files: Sequence[Path], options: MarkerOptions) -> TrackingFrame:
        ups = {options.up} if options.up else {_find_up_axis(read_header(path)) or "z" for path in files}
        if len(ups) > 1:
            raise NergError(f"the files have different up axes ({', '.join(sorted(ups))}); import them separately")
        return TrackingFrame(up=next(iter(ups), "z"))

    def read(self, files: Sequence[Path], options: MarkerOptions, builder: RaysBuilder) -> None:
        for path in files:
            builder.begin_source(path)
            header = read_header(path)
            heads = _find_heads(path, header, options)
            unit = _find_unit(path, header, options)
            up = poses.parse_axis(self.frame([path], options).up, "up")
            if options.up is None and _find_up_axis(header) is None:
                builder.add_warning(
                    f'"{sanitize(path.name, 60)}" does not specify the up axis; z is assumed ({parameter("up")})'
                )
            if not header.rate > 0:
                raise NergError(f'"{path}" has no frame rate; export it again')
            head_markers = next(iter(heads.values()))[0]
            builder.add_metadata(keypoints=list(head_markers))
            checks = GeometryChecks(path.name, 1.0, builder)
            marker_numbers = sorted({k for _, groups in heads.values() for group in groups for k in group})
            unused = [label for k, label in enumerate(header.labels) if k not in marker_numbers]
            builder.add_unused_columns([*unused, *(f"analog channel {label}" for label in header.analog)])
            count, elevations = 0, [np.empty(0)]
            for frames, points in iterate_markers(path, marker_numbers):
                count += len(frames)
                for person, (_, groups) in heads.items():
                    indices = [np.searchsorted(marker_numbers, group) for group in groups]
                    left, right, front = (unit * points[:, group].mean(axis=1) for group in indices)
                    origin, direction = head_poses(left, right, front, pitch=options.pitch)
                    checks.add_sides(left, right)
                    elevations.append(np.degrees(np.arcsin(np.clip(direction @ up, -1, 1))))
                    missing = np.asarray(np.isnan(points[:, np.concatenate(indices)]).any(axis=(1, 2)))
                    builder.add(
                        frames / header.rate,
                        person,
                        origin,
                        direction,
                        rows=frames + 1,
                        tracking="head",
                        drop={MISSING_KEYPOINT: missing},
                    )
            if not count:
                raise NergError(f'"{path}" has none of the {header.frames:,} frames of its header; export it again')
            # Frames may be counted from 0 or 1.
            if count < header.frames - 1:
                builder.add_warning(
                    f'"{sanitize(path.name, 60)}" ends after {count:,} of the {header.frames:,} frames of its header: '
                    "is the copy complete?"
                )
            checks.finish()
            median_elevation = finite_median(elevations)
            if abs(median_elevation) > _MAX_TILT:
                builder.add_warning(
                    f'the heads in "{sanitize(path.name, 60)}" point {median_elevation:.0f} degrees up (median): '
                    "are the markers at the front of the head as high as those at its sides? "
                    f"{parameter('pitch', f'{options.pitch - median_elevation:.0f}')} makes them level"
                )


READERS = (C3d(),)


def _find_up_axis(header: MarkerHeader) -> str | None:
    """The up axis in the file, or None. Its sign is ignored: Qualisys writes -Z for z up."""
    axis = header.up.lower()[-1:]
    return axis if axis in UP_AXES else None


def _find_unit(path: Path, header: MarkerHeader, options: MarkerOptions) -> float:
    """Unit of length of the file, in metres."""
    name = options.units or header.unit.lower()
    if name not in UNITS:
        problem = f'has the unit "{sanitize(header.unit, 20)}"' if header.unit else "has no unit of length"
        raise NergError(f'"{path}" {problem}; specify m, cm or mm ({parameter("units")})')
    return UNITS[name]


def _find_heads(
    path: Path, header: MarkerHeader, options: MarkerOptions
) -> dict[str, tuple[HeadKeypoints, list[list[int]]]]:
    """Find the head markers of each participant: their names, and their indices."""
    if not header.labels:
        raise NergError(
            f'"{path}" has no markers, but {len(header.analog)} analog channels; export the markers as well'
        )
    bodies: dict[str, dict[str, int]] = {}
    for k, label in enumerate(header.labels):
        person, _, marker = label.rpartition(":")
        bodies.setdefault(person, {}).setdefault(_normalise_label(marker), k)
    heads = {}
    for person, markers in bodies.items():
        for marker_set in _HEAD_MARKERS if options.keypoints is None else (options.keypoints,):
            groups = [
                [markers.get(_normalise_label(word)) for word in str(marker_name).split("+")]
                for marker_name in marker_set
            ]
            complete = [[k for k in group if k is not None] for group in groups]
            if complete == groups:
                heads[person or person_from_filename(path)] = marker_set, complete
                break
    if not heads:
        available = [sanitize(label, 40) for label in header.labels]
        suffix = "" if len(available) <= _MAX_LISTED_MARKERS else f" and {len(available) - _MAX_LISTED_MARKERS} more"
        raise NergError(
            f'no known head markers in "{path}"; its markers are '
            f"{', '.join(available[:_MAX_LISTED_MARKERS])}{suffix}; name those at the left, the right and the "
            f"front of the head, as in {parameter('keypoints', 'LTEMP')},RTEMP,NOSE"
        )
    return heads


def _normalise_label(marker: str) -> str:
    """Normalise the label of a marker for comparison."""
    return marker.strip().replace("_", "").replace(" ", "").lower()
