"""Gaze in the space of a motion capture system: Qualisys' gaze vectors, and Pupil Labs' Neon located by any system."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, plain

from .base import DESCRIPTION, Frame, RaysBuilder, Signature, option
from .columns import ColumnFinder
from .poses import iterate_gaze_vectors
from .table import person_from_filename

_EYE = re.compile(r"_g(_[12])?$")


@dataclass(frozen=True, kw_only=True)
class QualisysOptions:
    """How the laboratory's space was calibrated."""

    up: str = option("z", "Up axis: x, y, z, -x, -y or -z.", recorded=False)


class Qualisys:
    """``*_g.tsv`` of QTM, or ``*_g_1.tsv`` and ``*_g_2.tsv`` of two eyes; a folder has all of those in it.

    Columns ``X Pos`` to ``Z Vec``, in millimetres and in the laboratory's frame (right-handed; z is up where its
    calibration was left as it is), and where they were exported a sample's number and time; else samples are counted at
    the header's ``FREQUENCY`` from ``-START_OFFSET``. Column names may be missing. The files of two eyes become one
    ray: from midway between them, along the mean of their directions; where one of them was not seen, the other's
    alone. The person is the file's name before ``_g``.
    """

    name = "qualisys"
    files = "gaze vectors of Qualisys Track Manager, `*_g.tsv` or `*_g_1.tsv` and `*_g_2.tsv`, or folders of them"
    world = "the laboratory's, right-handed, mm, whose axis `--up` points up"
    checked_on = DESCRIPTION
    signature = Signature(
        line=lambda line: "its first line names a gaze vector" if line.startswith("GAZE_VECTOR_NAME\t") else None
    )
    Options = QualisysOptions

    def frame(self, files: Sequence[Path], options: QualisysOptions) -> Frame:
        return Frame(up=options.up, units="mm")

    def read(self, files: Sequence[Path], options: QualisysOptions, builder: RaysBuilder) -> None:
        paths = list(dict.fromkeys(path for given in files for path in _gaze_files(given)))
        for path in paths:
            left, right = (path.with_name(_EYE.sub(eye, path.stem) + path.suffix) for eye in ("_g_1", "_g_2"))
            if left == right or path not in (left, right) or not {left, right} <= set(paths):
                _add_eye(path, None, builder)
            elif path == left:
                _add_eye(left, _whole(right, builder), builder)


def _gaze_files(given: Path) -> list[Path]:
    if not given.is_dir():
        return [given]
    found = sorted(p for p in given.iterdir() if p.suffix.lower() == ".tsv" and _EYE.search(p.stem))
    if not found:
        raise NergError(f"there are no gaze vectors (*_g.tsv) in {given}; export them from QTM (TSV, eye tracker)")
    return found


def _whole(path: Path, builder: RaysBuilder) -> np.ndarray:
    """Positions and directions of an eye by the number of the sample (n, 6); NaN where there is none."""
    builder.source(path)
    blocks = list(iterate_gaze_vectors(path, builder.on_bad))
    whole = np.full((max((int(block.samples[-1]) + 1 for block in blocks), default=0), 6), np.nan)
    for block in blocks:
        whole[block.samples] = block.vectors
        builder.count_lines(len(block.lines))
    return whole


def _add_eye(path: Path, other: np.ndarray | None, builder: RaysBuilder) -> None:
    """Add the samples of an eye, with those of the ``other`` one (n, 6)."""
    builder.source(path)
    for block in iterate_gaze_vectors(path, builder.on_bad):
        eyes = block.vectors[:, None]
        if other is not None:
            beside = np.full(block.vectors.shape, np.nan)
            there = block.samples < len(other)
            beside[there] = other[block.samples[there]]
            eyes = np.stack([block.vectors, beside], axis=1)
        seen = np.isfinite(eyes).all(axis=2) & (np.abs(eyes[:, :, 3:]).max(axis=2) > 0)
        share = seen / np.maximum(seen.sum(axis=1, keepdims=True), 1)
        known = np.where(seen[:, :, None], eyes, 1.0)
        direction = known[:, :, 3:] / np.linalg.norm(known[:, :, 3:], axis=2, keepdims=True)
        builder.add(
            block.times,
            _EYE.sub("", path.stem),
            (share[:, :, None] * known[:, :, :3]).sum(axis=1),
            (share[:, :, None] * direction).sum(axis=1),
            rows=block.lines,
            drop={"no eye was seen": ~seen.any(axis=1)},
        )


@dataclass(frozen=True, kw_only=True)
class NeonMocapOptions:
    """What the table does not say of the laboratory."""

    up: str | None = option(None, "Up axis: x, y, z, -x, -y or -z.", recorded=False)  # needed
    units: str = option("mm", "Unit of length: m, cm or mm.", recorded=False)


class NeonMocap:
    """``gaze_in_mocap_space.csv``, which Pupil Labs' neon_mocap_localization makes of Neon's gaze and the poses of its
    markers, whatever the name it is given.

    ``gaze_origin_X`` to ``gaze_dir_Z`` in the motion capture's frame and unit, ``timestamp [ns]`` since 1970; samples
    without markers are empty and dropped. The axis that points ``up`` has to be said, since systems differ (z in
    Qualisys and Vicon, y in OptiTrack). The person is the folder where the file has its usual name, else the file.
    """

    name = "neon_mocap"
    files = "`gaze_in_mocap_space.csv` of Pupil Labs' neon_mocap_localization"
    world = "the motion capture's, right-handed: `--up`, `--units`"
    checked_on = DESCRIPTION
    signature = Signature(
        columns=(("timestamp [ns]", "gaze_origin_X", "gaze_origin_Y", "gaze_origin_Z", "gaze_dir_X"),),
        options={"--up": "UP"},
        question="the up axis of the motion capture (--up)",
    )
    Options = NeonMocapOptions

    def frame(self, files: Sequence[Path], options: NeonMocapOptions) -> Frame:
        return Frame(up=options.up or "z", units=options.units)

    def read(self, files: Sequence[Path], options: NeonMocapOptions, builder: RaysBuilder) -> None:
        if options.up is None:
            raise NergError(
                "motion capture systems differ in which axis points up; say it (--up z of Qualisys and Vicon, "
                "--up y of OptiTrack)"
            )
        for path in files:
            columns = ColumnFinder(path)
            time = columns.find("timestamp_[ns]")
            if time is None:
                there = ", ".join(plain(c, 40) for c in columns.columns[:8])
                raise NergError(f'{path} has no column "timestamp [ns]"; its columns are {there}')
            names = [time, *columns.vector("gaze_origin"), *columns.vector("gaze_dir")]
            builder.source(path)
            usual = path.name.startswith("gaze_in_mocap_space")
            person = path.resolve().parent.name if usual else person_from_filename(path)
            for v, _, lines in builder.read_table(path, names):
                lost = np.asarray(np.isnan(v[:, 1:]).any(axis=1))
                builder.add(
                    v[:, 0] * 1e-9,
                    person or path.stem,
                    v[:, 1:4],
                    v[:, 4:7],
                    rows=lines,
                    drop={"the glasses' markers were not seen": lost},
                )


READERS = (Qualisys(), NeonMocap())
