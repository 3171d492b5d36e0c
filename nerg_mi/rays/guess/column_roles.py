"""What the columns of a table are by their names: vectors, quaternions, matrices, angles, times, people."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

from nerg_mi.rays.readers.parsing import usual_names as usual
from nerg_mi.rays.readers.parsing.column_finder import column_words

# What may stand before the letter of an axis in one word: tx, posX, GazeQX.
_BEFORE = ("", "t", "q", "p", "d", "h", "v", "g", "pos", "rot", "dir", "vec", "quat", "gaze", "head", "hit", "eye")
_NEVER = (
    *("velocity", "vel", "speed", "acceleration", "accel", "gyro", "gravity", "magnetic", "angular", "linear"),
    *("ecef", "scale", "size", "color", "uv", "std", "var", "screen", "webcam", "px", "pixel", "norm2d", "pupil"),
    *("target", "aoi", "hand", "controller", "screenpoint", "velo"),
)
_UNITS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "sec": 1.0, "seconds": 1.0, "µs": 1e-6, "100ns": 1e-7}
_PEOPLE = (*usual.PERSONS, "pid", "participant_name", "subject_name", "user_name", "person_id", "player")
_SURE = ("confidence", "gaze_confidence", "conf", "quality")


@dataclass
class Roles:
    """Columns of a table by what they may be, each kind by its stem: the words around the letters of the axes."""

    vectors: dict[str, tuple[str, ...]] = field(default_factory=dict)  # x, y, z
    quaternions: dict[str, tuple[str, ...]] = field(default_factory=dict)  # x, y, z, w
    matrices: dict[str, tuple[str, ...]] = field(default_factory=dict)  # 12 or 16, row by row
    gravity: tuple[str, str, str] | None = None
    azel: tuple[str, str] | None = None
    yaw_pitch_roll: tuple[str, ...] | None = None  # two or three
    times: list[str] = field(default_factory=list)  # the most likely first
    person: str | None = None
    confidence: str | None = None


def find_roles(columns: Sequence[str]) -> Roles:
    """The roles that the names of ``columns`` tell; those with a comma or an equals sign, which no map can name, have
    none."""
    words = {c: column_words(c) for c in columns if c and not set(c) & set(",=")}
    roles, every = Roles(), set(words.values())
    groups: dict[str, dict[str, str]] = {}
    cells: dict[str, dict[str, str]] = {}
    gravity: dict[str, str] = {}
    for column, name in words.items():
        parts = name.split("_")
        if "gravity" in parts:
            for _, axis in _axes(parts):
                gravity.setdefault(axis, column)
        if any(part in _NEVER and not (part == "px" and name.replace("px", "pz") in every) for part in parts):
            continue
        for stem, axis in _axes(parts):
            groups.setdefault(stem, {}).setdefault(axis, column)
        found = re.fullmatch(r"(.*?)_?m?([0-3])_?([0-3])", name)
        if found:
            cells.setdefault(found[1], {})[found[2] + found[3]] = column
    for stem, found in groups.items():
        if set("xyzw") <= set(found):
            roles.quaternions[stem] = tuple(found[a] for a in "xyzw")
        elif set("xyz") <= set(found):
            roles.vectors[stem] = tuple(found[a] for a in "xyz")
    for stem, found in cells.items():
        rows = 4 if "33" in found else 3
        names = [f"{r}{c}" for r in range(rows) for c in range(4)]
        if all(n in found for n in names):
            roles.matrices[stem] = tuple(found[n] for n in names)
    if set("xyz") <= set(gravity):
        roles.gravity = gravity["x"], gravity["y"], gravity["z"]
    _find_angles(words, roles)
    ranks = {column: rank for column, name in words.items() if (rank := _time_rank(name)) is not None}
    roles.times = sorted(ranks, key=ranks.__getitem__)
    roles.person = next((c for p in _PEOPLE for c, w in words.items() if w == p), None)
    roles.confidence = next((c for p in _SURE for c, w in words.items() if w == p), None)
    return roles


def time_unit(column: str) -> float | None:
    """Seconds of the unit that a column's name states; None where it states none."""
    bracket = re.search(r"[(\[]([^)\]]{1,12})[)\]]", column)
    last = column_words(column).split("_")[-1]
    return _UNITS.get(bracket[1].strip().lower() if bracket else last)


def in_degrees(columns: Sequence[str]) -> bool | None:
    """Whether the names of angles state degrees; None where they state nothing."""
    text = " ".join(columns).lower()
    if "rad" in text:
        return False
    return True if "deg" in text else None


def _axes(parts: list[str]) -> list[tuple[str, str]]:
    """Stems and axes that a name may mean: of the last word that is, or ends with, the letter of an axis."""
    for k in range(len(parts) - 1, -1, -1):
        part = parts[k]
        if part and part[-1] in "xyzw" and part[:-1] in _BEFORE:
            return [("_".join([*parts[:k], part[:-1] + "*", *parts[k + 1 :]]), part[-1])]
    return []


def _find_angles(words: dict[str, str], roles: Roles) -> None:
    def one(what: str, avoid: tuple[str, ...] = ("left", "right", "low", "high", "std")) -> str | None:
        fits = [c for c, w in words.items() if what in w.split("_") and not set(avoid) & set(w.split("_"))]
        return fits[0] if fits else None

    azimuth, elevation = one("azimuth") or one("az"), one("elevation") or one("el")
    if azimuth and elevation:
        roles.azel = azimuth, elevation
    yaw, pitch, roll = one("yaw"), one("pitch"), one("roll")
    if yaw and pitch:
        roles.yaw_pitch_roll = (yaw, pitch, roll) if roll else (yaw, pitch)


def _time_rank(words: str) -> int | None:
    """How likely a name is that of the time, the smaller the more; None: it is none."""
    exact = ("t", "time", "timestamp", "time_s", "sample_time", "unity_time", "utc_timestamp", "timestep")
    if words in exact:
        return exact.index(words)
    parts = words.split("_")
    if not any(p in ("time", "timestamp", "timestamps", "clock", "utc") for p in parts):
        return None
    return 20 + 5 * len({"relative", "frame", "device", "raw", "duration", "delta", "dt"} & set(parts)) + len(parts)
