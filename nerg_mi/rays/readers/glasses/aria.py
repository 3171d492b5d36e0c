"""Recordings of Project Aria's glasses, as Machine Perception Services (MPS) and Aria Digital Twin give them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain
from nerg_mi.rays.readers.builder import RaysBuilder
from nerg_mi.rays.readers.frames import Frame
from nerg_mi.rays.readers.options import option
from nerg_mi.rays.readers.parsing import poses
from nerg_mi.rays.readers.parsing.tables import iterate_table
from nerg_mi.rays.readers.protocol import RECORDINGS

from .aria_gaze import TIME, GazeSchema, cpf_in_device, device_named, gaze_in_cpf, schema_of
from .aria_trajectory import Trajectory, poses_at, up_axis

_GAP = 0.05  # seconds: gaze farther than this from a pose is left out
_SUFFIXES = (".csv", ".csv.gz")
# Names of MPS, the older ones and those of ADT after the present ones; personalized gaze before general.
_PERSONALIZED = ("personalized_eye_gaze", "calibrated_eye_gaze")
_GENERAL = ("general_eye_gaze", "generalized_eye_gaze", "generalized_gaze", "eyegaze")
_TRAJECTORIES = ("closed_loop_trajectory", "aria_trajectory")
_GAZE_FOLDERS = ("eye_gaze", "eye_gaze_vergence", ".")
_POSE_FOLDERS = (".", "slam", "trajectory", "../slam", "../trajectory", "..")
_OTHER_WORLD = "the pose is in another world (graph_uid)"
_WORLDS_NAMED = 20


@dataclass(frozen=True, kw_only=True)
class AriaOptions:
    """What the recordings do not say."""

    device: str | None = option(
        None,
        "Model of the glasses: DVT-S or DVT-L; of the second generation DVT-LL, DVT-LS, DVT-SL or DVT-SS.",
        shown="DVT-L, or DVT-LL where the gaze is of the second generation",
        recorded=False,
    )
    world: str | None = option(
        None, "The graph_uid of the world that is taken.", shown="that of the most gaze", recorded=False
    )


@dataclass
class _Recording:
    """A gaze file with the poses that belong to it."""

    gaze: Path
    schema: GazeSchema
    device: str
    person: str
    trajectory: Trajectory
    rows: Counter[str]  # of gaze that have a pose, by world


class Aria:
    """Folders of recordings, or their gaze files, with the closed loop trajectory beside them.

    Gaze angles are in the central pupil frame of the glasses; how they become directions is told at
    :func:`nerg_mi.rays.readers.glasses.aria_gaze.gaze_in_cpf`. The trajectory tells where the glasses were, a thousand
    times a second (ground truth of Aria Digital Twin: thirty); poses are interpolated to the time of the gaze, and rows
    more than 0.05 s from one are dropped. Up is against the gravity of the trajectory. A world (``graph_uid``) is a
    frame of its own: rows in another one than ``world`` are dropped. Where there is both, personalized gaze is read,
    and not the general. Where a depth is known, it makes the hit point. Times are of the device's clock, in seconds.
    The person is the recording's folder (``anna`` of ``anna/eye_gaze`` or ``mps_anna_vrs/eye_gaze``).
    """

    name = "aria"
    files = (
        "folders of Project Aria recordings as MPS or Aria Digital Twin give them, of both generations (or the gaze "
        "files in them), with `closed_loop_trajectory.csv` or `aria_trajectory.csv`"
    )
    world = "right-handed, m, up by the trajectory's gravity"
    checked_on = f"{RECORDINGS}; of the second generation gaze alone"
    Options = AriaOptions

    def frame(self, files: Sequence[Path], options: AriaOptions) -> Frame:
        if not files:
            return Frame()
        return Frame(up=up_axis(_find_trajectory(_find_gaze(files[0]))))

    def read(self, files: Sequence[Path], options: AriaOptions, builder: RaysBuilder) -> None:
        recordings = [_open(_find_gaze(given), options, builder) for given in files]
        world, up = _choose_world(recordings, options.world), up_axis(recordings[0].trajectory.path)
        # A recording that has the gravity of another world along another axis would be turned by the wrong frame.
        for recording in recordings:
            if world in recording.trajectory.tracks and recording.trajectory.up(world) != up:
                raise NergError(
                    f"{recording.trajectory.path} has {recording.trajectory.up(world)} up in the world {plain(world)}, "
                    f"and {recordings[0].trajectory.path} begins with {up} up; import recordings with one up axis "
                    "together, the others apart"
                )
        others = sum((r.rows for r in recordings), Counter())
        builder.note(
            floor="unknown",  # a world begins where the glasses were
            world=world,
            other_worlds={w: n for w, n in others.most_common(_WORLDS_NAMED + 1) if w != world},
            gaze=[
                {"file": f"{r.person}/{r.gaze.name}", "schema": r.schema.name, "device": r.device} for r in recordings
            ],
        )
        for recording in recordings:
            _add(recording, world, builder)


READERS = (Aria(),)


def _open(gaze: Path, options: AriaOptions, builder: RaysBuilder) -> _Recording:
    """The poses for the gaze file ``gaze``, which is not read yet but for its times."""
    schema, person = schema_of(gaze), _person(gaze)
    device = device_named(options.device, schema.generation)
    # Lines that cannot be read are told when all of the file is read.
    tolerant = None if builder.on_bad is None else lambda line, why: None
    blocks = [block.numbers[:, 0] * 1e-6 for block in iterate_table(gaze, [TIME], on_bad=tolerant)]
    times = np.concatenate(blocks or [np.empty(0)])
    path = _find_trajectory(gaze)
    builder.source(path, f"{person}/{path.name}")
    trajectory = Trajectory(path, times, builder.on_bad)
    builder.count_lines(trajectory.lines)
    rows = Counter({w: int((~poses_at(track, times, _GAP)[2]).sum()) for w, track in trajectory.tracks.items()})
    return _Recording(gaze, schema, device, person, trajectory, rows)


def _choose_world(recordings: Sequence[_Recording], wanted: str | None) -> str:
    """The world that is wanted, or that of the most gaze; `NergError` where a recording has none of it."""
    rows = sum((r.rows for r in recordings), Counter())
    named = ", ".join(plain(w, 40) for w, _ in rows.most_common(4))
    if wanted is not None:
        if wanted not in rows and not any(wanted in r.trajectory.tracks for r in recordings):
            raise NergError(f'there is no world "{plain(wanted, 40)}" (--world) in these recordings; there are {named}')
        return wanted
    world = min((w for r in recordings for w in r.trajectory.tracks), key=lambda w: (-rows[w], w))
    for recording in recordings:
        if world not in recording.trajectory.tracks:
            raise NergError(
                f"{recording.gaze} was recorded in another world (graph_uid) than {plain(world, 40)}, each a frame of "
                f"its own ({named}); import them apart, have MPS make one world of them (Multi-SLAM), or choose one "
                "with --world"
            )
    return world


def _add(recording: _Recording, world: str, builder: RaysBuilder) -> None:
    """Add the gaze of ``recording`` that is in ``world``."""
    tracks = recording.trajectory.tracks
    builder.source(recording.gaze, f"{recording.person}/{recording.gaze.name}")
    R, t = cpf_in_device(recording.device)
    for v, _, lines in builder.read_table(recording.gaze, recording.schema.columns):
        time = v[:, 0] * 1e-6
        eye, direction, distance = gaze_in_cpf(recording.schema, v)
        if world in tracks:
            turn, place, lost = poses_at(tracks[world], time, _GAP)
        else:
            turn, place, lost = np.broadcast_to(np.eye(3), (len(v), 3, 3)), np.zeros((len(v), 3)), np.ones(len(v), bool)
        elsewhere = np.zeros(len(v), bool)
        for other, track in tracks.items():
            if other != world and lost.any():
                elsewhere |= ~poses_at(track, time, _GAP)[2]
        origin = place + poses.rotate(turn, eye @ R.T + t)
        direction = poses.rotate(turn, direction @ R.T)
        builder.add(
            time,
            recording.person,
            origin,
            direction,
            rows=lines,
            head=turn @ R[:, 2],
            hit=origin + distance[:, None] * direction,
            drop={_OTHER_WORLD: lost & elsewhere, "there is no pose of the glasses at that time": lost},
        )


def _find_gaze(given: Path) -> Path:
    """The gaze file that is given, or that of the recording in the folder ``given``."""
    if "open_loop" in given.name or any(given.name == n + s for n, s in product(_TRAJECTORIES, _SUFFIXES)):
        raise NergError(
            f"{given} is a trajectory, and holds no gaze; give the recording's folder, which needs a closed loop "
            "trajectory as well"
        )
    if not given.is_dir():
        return given
    roots = [given, given / "mps", *sorted(p for p in given.glob("mps_*_vrs") if p.is_dir())]
    found = _first(_in_folders(roots, _GAZE_FOLDERS, [*_PERSONALIZED, *_GENERAL]))
    if found is None:
        raise NergError(
            f"there is no gaze file ({', '.join((*_PERSONALIZED, *_GENERAL))}; .csv or .csv.gz) in {given} or its "
            "folder eye_gaze; ask MPS for the eye gaze of the recording, or give the gaze file"
        )
    return found


def _find_trajectory(gaze: Path) -> Path:
    """The closed loop trajectory that belongs to a gaze file."""
    beside = _in_folders([gaze.parent], _POSE_FOLDERS, _TRAJECTORIES)
    found = _first(beside)
    if found is not None:
        return found
    if not gaze.is_file():
        raise NergError(f"there is no {gaze}; correct its name")
    if _first(_in_folders([gaze.parent], _POSE_FOLDERS, ["open_loop_trajectory"])) is not None:
        raise NergError(
            f"{gaze} has an open loop trajectory alone, which drifts and is no frame of a place; ask MPS for the "
            "closed loop trajectory (SLAM) of the recording"
        )
    raise NergError(
        f"there is no trajectory for {gaze} ({' or '.join(f'{n}.csv' for n in _TRAJECTORIES)}, .gz too, beside it, or "
        "in slam or trajectory beside its folder); ask MPS for the closed loop trajectory (SLAM) of the recording"
    )


def _in_folders(roots: Sequence[Path], folders: Sequence[str], names: Sequence[str]) -> Iterator[Path]:
    """Where such a file may be: names first, so that of two the one that is named first is found anywhere."""
    for name, root, folder, suffix in product(names, roots, folders, _SUFFIXES):
        yield root / folder / f"{name}{suffix}"


def _first(paths: Iterator[Path]) -> Path | None:
    return next((p for p in paths if p.is_file()), None)


def _person(gaze: Path) -> str:
    """The recording's folder: the first above ``gaze`` that is not one of MPS."""
    folders = (re.sub(r"^mps_(.+)_vrs$", r"\1", p) for p in reversed(gaze.resolve().parent.parts))
    return next((p for p in folders if p not in (*_GAZE_FOLDERS, "mps")), gaze.stem)
