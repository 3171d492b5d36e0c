"""A camera's flight through views that were kept, as the frames of a sequence that `nerg render --frames` renders."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from nerg_mi.errors import NergError
from nerg_mi.rendering.scene_writer import numbers

from .copied_scene import CAMERA, TARGET
from .view import View

MOST = 20_000
"""Frames of a flight at most."""


def flight(views: Sequence[View], seconds: float, fps: float) -> list[View]:
    """Views ``fps`` times a second on a smooth curve through ``views``, which it passes at equal intervals.

    A cubic spline with its ends at rest; two views are joined by a line. Raises `NergError` for less than two.
    """
    if len(views) < 2:
        raise NergError("a flight needs two views at least; keep another one")
    count = round(seconds * fps) + 1
    if not 2 <= count <= MOST:
        raise NergError(f"a flight has 2 to {MOST:,} frames, and {seconds:g} s at {fps:g} a second are {count:,}")
    at = np.linspace(0, len(views) - 1, count)
    known = np.array([np.concatenate([v.origin, v.origin + v.ahead, v.up]) for v in views])
    curve = CubicSpline(np.arange(len(views)), known, bc_type="clamped")(at)
    last = views[-1]
    return [View.of(row[:3], row[3:6], row[6:], last.fov, last.aspect) for row in curve]


def frames_csv(views: Sequence[View]) -> str:
    """The text of a file of frames for a scene that `copied_scene.copied` wrote."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow([CAMERA, TARGET])
    writer.writerows([numbers(v.origin), numbers(v.target)] for v in views)
    return text.getvalue()
