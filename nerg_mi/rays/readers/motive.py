"""Heads as rigid bodies in OptiTrack's Motive: its CSV export, whose columns are named by several lines."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import read_line_blocks

from . import poses
from .base import DESCRIPTION, RaysBuilder, Signature, TrackingFrame, option
from .table import person_from_filename

_HEAD_LINES = 40
_UNITS = {"meters": "m", "centimeters": "cm", "millimeters": "mm"}
_HEADS = re.compile(r"head|hmd|helmet|glasses|\bcap\b", re.IGNORECASE)
_POSE = [("Rotation", axis) for axis in "XYZW"] + [("Position", axis) for axis in "XYZ"]
_FORWARD = "-z"


@dataclass(frozen=True, kw_only=True)
class MotiveOptions:
    """What the export does not say. Raises `NergError` for an axis that is none."""

    up: str = option("y", "Up axis: x, y, z, -x, -y or -z.", recorded=False)
    forward: str | None = option(None, "Axis of a head's frame along which it looks.", shown=_FORWARD, recorded=False)
    rigid_body: str | None = option(None, "Name of the rigid body that is the head.", shown="the only one, or its name")

    def __post_init__(self) -> None:
        poses.axis(self.looks_along, "forward")

    @property
    def looks_along(self) -> str:
        """The axis of the head's frame along which it looks."""
        return self.forward or _FORWARD


@dataclass(frozen=True)
class MotiveLayout:
    columns: list[str]  # names made of the lines above
    bodies: dict[str, list[str]]  # columns of the pose (7) of each rigid body
    units: str
    line: int  # of the first sample


class Motive:
    """Samples of rigid bodies (and bones) in the global frame, which Motive has right-handed with y up; another axis
    convention of the export is said by ``--up``.

    The head is the rigid body of this name, by default the only one, or the only one that is called so. Its own axes
    are those of the moment when it was defined, which no file tells: it is taken to look along -z. Samples in which the
    body was not tracked are empty and dropped. The person is the file's name.
    """

    name = "motive"
    files = "CSV export of OptiTrack's Motive with header and rigid bodies (rotation type quaternion): heads"
    world = "right-handed, `--up` (y in Motive), unit of the file"
    checked_on = DESCRIPTION
    signature = Signature(
        line=lambda line: (
            "its first line is that of Motive's export" if line.lstrip("\ufeff").startswith("Format Version,") else None
        ),
        question="the axis along which the head's rigid body looks (--forward; -z if nothing is said)",
    )
    Options = MotiveOptions

    def frame(self, files: Sequence[Path], options: MotiveOptions) -> TrackingFrame:
        units = {_read_layout(path).units for path in files} or {"m"}
        if len(units) > 1:
            raise NergError(f"the files are in {' and '.join(sorted(units))}; import them apart")
        return TrackingFrame(up=options.up, units=units.pop())

    def read(self, files: Sequence[Path], options: MotiveOptions, builder: RaysBuilder) -> None:
        forward = poses.axis(options.looks_along, "forward")
        builder.note(forward=options.looks_along)
        for path in files:
            layout = _read_layout(path)
            body = _choose(path, layout, options.rigid_body)
            if options.forward is None:
                builder.complain(
                    f"no file tells along which of its axes the rigid body {sanitize(body, 40)!r} looks: {_FORWARD} was "
                    f"taken; say it (--forward, {_FORWARD} too) once you have checked it"
                )
            builder.source(path)
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
                    drop={"the rigid body was not tracked": np.asarray(np.isnan(v[:, 1:]).any(axis=1))},
                )


READERS = (Motive(),)


def _choose(path: Path, layout: MotiveLayout, wanted: str | None) -> str:
    names = list(layout.bodies)
    fits = [n for n in names if n == wanted] if wanted else names
    if not wanted and len(fits) > 1:
        fits = [n for n in names if _HEADS.search(n)]
    if len(fits) == 1:
        return fits[0]
    shown = ", ".join(sanitize(n, 40) for n in names[:12]) or "none"
    raise NergError(f"{path} has the rigid bodies {shown}; name the head's with --rigid-body, or export its rotation")


def _read_layout(path: Path) -> MotiveLayout:
    """What the lines above the samples tell. Raises `NergError` for another file, or another export."""
    with closing(read_line_blocks(path, "table", _HEAD_LINES)) as blocks:
        rows = list(csv.reader(line.lstrip("\ufeff") for line in next(blocks, [])))
    rows = [[cell.strip() for cell in row] for row in rows]
    at = next((k for k, row in enumerate(rows) if row[:1] == ["Frame"]), None)
    if at is None or len(rows[at]) < 2 or rows[0][:1] != ["Format Version"]:
        raise NergError(
            f'{path} is no export of Motive: it needs a first line "Format Version,..." and a line "Frame,Time '
            '(Seconds),..."; export it as CSV with its header'
        )
    metadata = dict(zip(rows[0][::2], rows[0][1::2]))
    for key, needed in (("Rotation Type", "Quaternion"), ("Coordinate Space", "Global")):
        if metadata.get(key) != needed:
            raise NergError(
                f"{path} has the {key.lower()} {sanitize(metadata.get(key, 'none'), 40)!r}; export it again with {needed}"
            )
    units = _UNITS.get(metadata.get("Length Units", "").lower())
    if units is None:
        raise NergError(
            f"{path} has the length units {sanitize(metadata.get('Length Units', 'none'), 40)!r}; export it in meters, "
            "centimeters or millimeters"
        )
    # Lines that name something of each column, by their second cell; that above the axes has no name.
    axes, width = rows[at], len(rows[at])
    named = {row[1]: [*row, *[""] * width] for row in rows[1:at] if len(row) > 2}
    if not {"Type", "Name", ""} <= set(named):
        raise NergError(f"{path} has no lines of types, names and properties; export it with its header")
    columns, bodies = list(axes[:2]), {}
    for k in range(2, width):
        kind, name, what, axis = named["Type"][k], named["Name"][k], named[""][k], axes[k]
        columns.append(" ".join(filter(None, (name, kind, what, axis))))
        if kind in ("Rigid Body", "Bone"):
            bodies.setdefault(name, {})[what, axis] = columns[-1]
    whole = {name: [cells[key] for key in _POSE] for name, cells in bodies.items() if set(_POSE) <= set(cells)}
    return MotiveLayout(columns, whole, units, at + 2)
