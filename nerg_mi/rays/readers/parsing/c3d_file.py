"""C3D files of motion capture, read by the package c3d, an optional extra."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.files.bounded import reading, size_of

from .fill_values import fill_values

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
    size_of(path, "C3D file")
    with reading(path, "C3D file", "export it again", _DAMAGED), open(path, "rb") as file:
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
