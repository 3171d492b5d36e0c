"""OptiTrack Motive: heads as rigid bodies in its CSV export, with a header of several lines.

The head is the only rigid body, the one that is named like a head, or ``--rigid-body``.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.safe_read import read_line_blocks
from nerg_mi.ranges import ValidatedDataclass

from . import poses
from .base import FROM_DOCUMENTATION, RaysBuilder, Signature, TrackingFrame, option
from .table import person_from_filename

_HEADER_LINES = 40
_UNITS = {"meters": "m", "centimeters": "cm", "millimeters": "mm"}
_HEAD_NAMES = re.compile(r"head|hmd|helmet|glasses|\bcap\b", re.IGNORECASE)
_POSE_COLUMNS = [("Rotation", axis) for axis in "XYZW"] + [("Position", axis) for axis in "XYZ"]
_DEFAULT_FORWARD = "-z"


@dataclass(frozen=True, kw_only=True)
class MotiveOptions(ValidatedDataclass):
    """Options for what the export does not contain. Raises `NergError` for an invalid axis."""

    up: str = option("y", "Up axis: x, y, z, -x, -y or -z.", is_recorded=False)
    forward: str | None = option(
        None, "Forward axis of the head's frame.", default_text=_DEFAULT_FORWARD, is_recorded=False
    )
    rigid_body: str | None = option(
        None, "Name of the rigid body of the head.", default_text="the only one, or the only one named like a head"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        poses.parse_axis(self.forward_axis, "forward")

    @property
    def forward_axis(self) -> str:
        """Forward axis of the head's frame."""
        return self.forward or _DEFAULT_FORWARD


@dataclass(frozen=True)
class MotiveLayout:
    columns: list[str]  # names composed from the header lines
    bodies: dict[str, list[str]]  # columns of the pose (7) of each rigid body
    units: str
    line: int  # of the first sample


class Motive:
    """Rigid bodies (and bones) in the global frame, which is right-handed with y up in Motive; ``--up`` sets another
    axis convention of the export.

    The head is the rigid body with the given name, by default the only one, or the only one named like a head. Its axes
    are those of the moment when it was defined, which the file does not contain: -z is assumed to be forward. Samples
    in which the body was not tracked are empty and are dropped. The participant is the file name.
    """

    name = "motive"
    files = "CSV export of OptiTrack's Motive with header and rigid bodies (rotation type quaternion): heads"
    frame_description = "right-handed, `--up` (y in Motive), unit of the file"
    evidence = FROM_DOCUMENTATION
    signature = Signature(
        line=lambda line: "its first line is that of Motive's export" if line.startswith("Format Version,") else None,
        question=f"the forward axis of the head's rigid body ({parameter('forward')}; default -z)",
    )
    Options = MotiveOptions

    def frame(self, files: Sequence[Path], options: MotiveOptions) -> TrackingFrame:
        units = {_read_layout(path).units for path in files} or {"m"}
        if len(units) > 1:
            raise NergError(f"the files have different units ({' and '.join(sorted(units))}); import them separately")
        return TrackingFrame(up=options.up, units=units.pop())

    def read(self, files: Sequence[Path], options: MotiveOptions, builder: RaysBuilder) -> None:
        forward = poses.parse_axis(options.forward_axis, "forward")
        builder.add_metadata(forward=options.forward_axis)
        for path in files:
            layout = _read_layout(path)
            body = _choose_body(path, layout, options.rigid_body)
            if options.forward is None:
                builder.add_warning(
                    f"the file does not contain the forward axis of the rigid body {sanitize(body, 40)!r}: "
                    f"{_DEFAULT_FORWARD} is assumed; check it, and set it ({parameter('forward')}, also for "
                    f"{_DEFAULT_FORWARD})"
                )
            builder.begin_source(path)
            numbers = [layout.columns[1], *layout.bodies[body]]
            blocks = builder.read_table(
                path, numbers, header=layout.columns, first_line=layout.line, also_used=layout.columns[:1]
            )
            for v, _, lines in blocks:
                builder.add(
                    v[:, 0],
                    person_from_filename(path),
                    v[:, 5:8],
                    poses.rotations_from_quaternions(v[:, 1:5]) @ forward,
                    rows=lines,
                    tracking="head",
                    drop={
                        "the rigid body was not tracked": np.asarray(np.isnan(v[:, 1:]).any(axis=1)),
                        **poses.find_unusable_quaternions(v[:, 1:5]),
                    },
                )


READERS = (Motive(),)


def _choose_body(path: Path, layout: MotiveLayout, requested: str | None) -> str:
    names = list(layout.bodies)
    matches = [n for n in names if n == requested] if requested else names
    if not requested and len(matches) > 1:
        matches = [n for n in names if _HEAD_NAMES.search(n)]
    if len(matches) == 1:
        return matches[0]
    names_text = ", ".join(sanitize(n, 40) for n in names[:12]) or "none"
    raise NergError(
        f"{path} has the rigid bodies {names_text}; name the head's with {parameter('rigid_body')}, or export its "
        "rotation"
    )


def _read_layout(path: Path) -> MotiveLayout:
    """Read the header lines. Raises `NergError` for another file or kind of export."""
    with closing(read_line_blocks(path, "table", _HEADER_LINES)) as blocks:
        rows = list(csv.reader(next(blocks, [])))
    rows = [[cell.strip() for cell in row] for row in rows]
    header_row = next((k for k, row in enumerate(rows) if row[:1] == ["Frame"]), None)
    if header_row is None or len(rows[header_row]) < 2 or rows[0][:1] != ["Format Version"]:
        raise NergError(
            f'{path} is not an export of Motive: it needs a first line "Format Version,..." and a line "Frame,Time '
            '(Seconds),..."; export it as CSV with its header'
        )
    metadata = dict(zip(rows[0][::2], rows[0][1::2]))
    for key, needed in (("Rotation Type", "Quaternion"), ("Coordinate Space", "Global")):
        if metadata.get(key) != needed:
            raise NergError(
                f"{path} has the {key.lower()} {sanitize(metadata.get(key, 'none'), 40)!r}; export it "
                f"again with {needed}"
            )
    units = _UNITS.get(metadata.get("Length Units", "").lower())
    if units is None:
        raise NergError(
            f"{path} has the length units {sanitize(metadata.get('Length Units', 'none'), 40)!r}; export it in meters, "
            "centimeters or millimeters"
        )
    # Header lines about each column, identified by their second cell; the line above the axes has no name.
    axes, width = rows[header_row], len(rows[header_row])
    rows_by_kind = {row[1]: [*row, *[""] * width] for row in rows[1:header_row] if len(row) > 2}
    if not {"Type", "Name", ""} <= set(rows_by_kind):
        raise NergError(f"{path} has no lines of types, names and properties; export it with its header")
    columns, bodies = list(axes[:2]), {}
    for k in range(2, width):
        kind, name, prop, axis = rows_by_kind["Type"][k], rows_by_kind["Name"][k], rows_by_kind[""][k], axes[k]
        columns.append(" ".join(filter(None, (name, kind, prop, axis))))
        if kind in ("Rigid Body", "Bone"):
            bodies.setdefault(name, {})[prop, axis] = columns[-1]
    complete = {
        name: [cells[key] for key in _POSE_COLUMNS]
        for name, cells in bodies.items()
        if set(_POSE_COLUMNS) <= set(cells)
    }
    return MotiveLayout(columns, complete, units, header_row + 2)
