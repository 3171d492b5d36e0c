"""EyeNavGS: head and eyes in scenes of Gaussian splats, with the settings of each scene."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import resolve_path

from . import poses
from .base import OPENGL, RECORDINGS, InFrame, RaysBuilder, Signature, option
from .poses import rotations_from_quaternions
from .tables import TableBlock, iterate_table, read_table_columns

# ---- Scene settings ----
#
# How EyeNavGS put places into VR: their scale, what stands them upright, and where the play area lies in them.

# From the viewer's axes (OpenXR's: y up, -z ahead) to those of splats (y down, z ahead), as the viewer turns cameras.
_FLIP = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class SceneSetting:
    """One row of ``scene_setting.csv``."""

    place: str
    scale: float  # units of the place in a metre
    quaternion: tuple[float, ...]  # x, y, z, w: stands the place upright
    start: tuple[float, ...]  # of the play area, metres; zero where the file has none

    @property
    def upright(self) -> np.ndarray:
        """The rotation (3, 3) that stands the place upright."""
        return rotations_from_quaternions(np.array([self.quaternion]))[0]

    def to_area(self, x: np.ndarray) -> np.ndarray:
        """Points (n, 3) of recordings in the play area: y up, metres, the floor at height 0."""
        start = np.array(self.start)
        return ((x - start) / self.scale + start) @ self.upright.T + start

    def splat_from_area(self) -> np.ndarray:
        """4x4 matrix from the play area to the axes and units of the place's splats."""
        start, back = np.array(self.start), np.eye(4)
        back[:3, :3] = self.scale * _FLIP @ self.upright.T
        back[:3, 3] = _FLIP @ (start - self.scale * (self.upright.T @ start + start))
        return back + 0.0


def read_scene_settings(path: Path) -> dict[str, SceneSetting]:
    """The settings of each place in ``path``, by its name. Raises `NergError` for a file that is none."""
    texts = ["Scene_Name", "Quaternion"]
    if "Initial_Position" in read_table_columns(path):
        texts.append("Initial_Position")
    found = {}
    for block in iterate_table(path, ["Scale"], texts):
        for scale, cells, line in zip(block.numbers[:, 0].tolist(), block.texts.tolist(), block.lines.tolist()):
            quaternion, start = _numbers(cells[1], 4), _numbers(cells[2], 3) if len(cells) > 2 else (0.0, 0.0, 0.0)
            if (
                quaternion is None
                or start is None
                or not 1e-6 < scale < 1e6
                or not 0.5 < np.hypot.reduce(quaternion) < 2
            ):
                raise NergError(
                    f"{path}, line {line}: {sanitize(cells[0], 40)!r} needs a scale above 0, a quaternion x, y, z, w and "
                    "an initial position of three numbers; copy the file again"
                )
            found[cells[0]] = SceneSetting(cells[0], scale, quaternion, start)
    return found


def _numbers(text: str, count: int) -> tuple[float, ...] | None:
    """The numbers in a cell such as ``0, 1.15, 0``; None where they are not so many, or too large."""
    try:
        found = tuple(float(word) for word in text.split(","))
    except ValueError:
        return None
    return found if len(found) == count and all(abs(v) < 1e6 for v in found) else None


# ---- EyeNavGS: gaze of people in VR in real places that were kept as Gaussian splats (arXiv 2506.02380) ----

_TICK = 1e-3  # seconds
_TURNED = 5.0, 30.0  # degrees: a head that turned farther has eyes that turn in the world, and in the head
_STILL = 4.0  # degrees from their mean direction in the head, by the median; people who look about have 7 to 13
_SAME = 1e-6  # of a quaternion's numbers, which have three decimals or six
_SETTINGS = "scene_setting.csv"
_ABOVE = 4  # folders above a recording in which it is looked for
_PLACES = {"trian": "train"}
_HEAD = [f"Quaternion{a}" for a in "XYZW"]
_GAZE = [f"GazeQ{a}" for a in "XYZW"]
_COLUMNS = ["ViewIndex", *(f"Position{a}" for a in "XYZ"), *_HEAD, *_GAZE]
_TIMES = ("Timestamp", "timestep")
_FORWARD = np.array([0.0, 0.0, -1.0])
_FROZEN = "the gaze of the recording is frozen: it never changes while the head turns"
_LOCKED = "the gaze of the recording is locked to the head: it turns as the head does, some time later"


@dataclass(frozen=True, kw_only=True)
class EyeNavGSOptions:
    """Which eye looks. Raises `NergError` for an unknown word."""

    eye: str = option("both", "Line of sight: both (their mean), left or right.")

    def __post_init__(self) -> None:
        if self.eye not in ("both", "left", "right"):
            raise NergError(f'--eye is "{sanitize(self.eye, 40)}"; it is both, left or right')


class EyeNavGS(InFrame):
    """``userN_PLACE.csv`` of both sites, whose columns have two orders, or folders of them; all of one place.

    A frame has a row of each eye, the left one first; positions are the eyes', ``Quaternion`` is the head's, ``GazeQ``
    the line of sight's, both x, y, z, w and looking along -z in a world that is right-handed, with y nearly up. The two
    lines of sight differ by the same 3 degrees in every row (they cross 1.2 m ahead whatever is looked at), so that
    their mean is the gaze, and one eye's alone is off by half of that; the ray begins midway between the eyes. A row
    without the other eye's is dropped.

    ``scene_setting.csv``, beside the recordings or above, has the place's units a metre (``Scale``), the rotation that
    stands it upright (``Quaternion``; heads are upright after it, and tilted by up to 27 degrees before), and, from one
    of the sites, where the viewer put the play area (``Initial_Position`` p): the play area's point of x is
    R((x - p) / scale + p) + p, with the floor at height 0. The metadata have the way back to the splats' own axes as
    ``place_from_rays``. A recording whose gaze is frozen, or stays where it is in the head, is dropped as a whole.
    """

    name = "eyenavgs"
    files = "`userN_PLACE.csv` of EyeNavGS (or folders of them), of one place; `scene_setting.csv` beside them or above"
    world = "right-handed, y up and in metres after the place's rotation and scale"
    checked_on = f"{RECORDINGS} of Rutgers; of NTHU generated files"
    fixed = OPENGL
    signature = Signature(columns=(("ViewIndex", "PositionX", "QuaternionX", "GazeQX"),))
    Options = EyeNavGSOptions

    def read(self, files: Sequence[Path], options: EyeNavGSOptions, builder: RaysBuilder) -> None:
        recordings = [path for given in files for path in _recordings(given)]
        setting, names = None, {}
        for path in recordings:
            settings = _find_settings(path)
            if settings not in names:
                builder.source(settings)
                names[settings] = read_scene_settings(settings)
                builder.count_lines(len(names[settings]))
            found = _of_place(path, names[settings], settings)
            if setting is not None and found != setting:
                raise NergError(
                    f"{path} is of {sanitize(found.place, 40)} and {recordings[0]} of {sanitize(setting.place, 40)}, or of "
                    "another site's copy of it, each a frame of its own; import them apart"
                )
            setting = found
        assert setting is not None
        builder.note(
            tick=_TICK,
            place=setting.place,
            units_per_metre=setting.scale,
            place_from_rays=(setting.splat_from_area() @ np.linalg.inv(OPENGL.to_rays())).tolist(),
        )
        faults = [_add(path, setting, options, builder) for path in recordings]
        if all(faults):
            raise NergError(f"nobody's eyes were tracked; of {recordings[0]}: {faults[0]}; give other recordings")


READERS = (EyeNavGS(),)


def _add(path: Path, setting: SceneSetting, options: EyeNavGSOptions, builder: RaysBuilder) -> str | None:
    """Add a recording's rows; why all were dropped, if they were."""
    fault = _fault(path, tolerant=builder.on_bad is not None)
    time = _time(path)
    builder.source(path)
    for v, paired, lines in _frames(builder.read_table(path, [*_COLUMNS, time])):
        eyes = setting.to_area(v[:, :, 1:4].reshape(-1, 3)).reshape(-1, 2, 3)
        sight = poses.rotations_from_quaternions(v[:, :, 8:12].reshape(-1, 4)) @ _FORWARD
        sight = (sight @ setting.upright.T).reshape(-1, 2, 3)
        side = {"both": slice(None), "left": slice(0, 1), "right": slice(1, 2)}[options.eye]
        builder.count_lines(int(paired.sum()))
        builder.add(
            v[:, 0 if options.eye != "right" else 1, 12] * _TICK,
            _person_and_place(path)[0],
            eyes[:, side].mean(axis=1),
            sight[:, side].mean(axis=1),
            rows=lines,
            head=(poses.rotations_from_quaternions(v[:, 0, 4:8]) @ _FORWARD) @ setting.upright.T,
            eye_distance=np.where(paired, np.linalg.norm(eyes[:, 1] - eyes[:, 0], axis=1), np.nan),
            drop={**({fault: np.full(len(v), True)} if fault else {}), "the other eye's row is missing": ~paired},
        )
    return fault


def _frames(blocks: Iterator[TableBlock]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Rows of both eyes: values (n, 2, C), left and right, whether both are there (n,) bool (else one stands in both
    places), and the lines (n,) of the first."""
    waiting: TableBlock | None = None
    for block in blocks:
        v, lines = block.numbers, block.lines
        if waiting is not None:
            v, lines, waiting = np.concatenate([waiting.numbers, v]), np.concatenate([waiting.lines, lines]), None
        if v[-1, 0] == 0:
            # Its other eye may begin the next block.
            waiting = TableBlock(v[-1:], np.empty((1, 0), dtype=str), lines[-1:])
            v, lines = v[:-1], lines[:-1]
        if len(v):
            yield _paired(v, lines)
    if waiting is not None:
        yield _paired(waiting.numbers, waiting.lines)


def _paired(v: np.ndarray, lines: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    followed = np.r_[(v[:-1, 0] == 0) & (v[1:, 0] == 1), False]
    first = np.flatnonzero(~np.r_[False, followed[:-1]])
    paired = followed[first]
    return np.stack([v[first], v[first + paired]], axis=1), paired, lines[first]


def _fault(path: Path, tolerant: bool) -> str | None:
    """Why the gaze of a recording is none, by the rows of its left eye; None where it is one."""
    first: np.ndarray | None = None
    changes, turned, in_head = False, 0.0, []
    columns = ["ViewIndex", *_HEAD, *_GAZE]
    for v, _, _ in iterate_table(path, columns, on_bad=(lambda line, why: None) if tolerant else None):
        v = v[(v[:, 0] == 0) & np.isfinite(v).all(axis=1), 1:]
        v = v[(np.linalg.norm(v[:, :4], axis=1) > 0.5) & (np.linalg.norm(v[:, 4:], axis=1) > 0.5)]
        if not len(v):
            continue
        start: np.ndarray = v[0] if first is None else first
        first = start
        changes |= bool(np.abs(v[:, 4:] - start[4:]).max() > _SAME)
        # The scalar product of unit quaternions is the cosine of half the angle between them.
        length = np.linalg.norm(v[:, :4], axis=1) * np.linalg.norm(start[:4])
        turned = max(turned, 2 * np.degrees(np.arccos(min(1.0, np.abs(v[:, :4] @ start[:4] / length).min()))))
        head, gaze = (poses.rotations_from_quaternions(q) for q in (v[:, :4], v[:, 4:]))
        in_head.append(np.einsum("nji,nj->ni", head, gaze @ _FORWARD).astype(np.float32))
    if first is None or turned <= _TURNED[0]:
        return None
    if not changes:
        return _FROZEN
    directions = np.concatenate(in_head)
    mean = directions.mean(axis=0, dtype=np.float64)
    off = np.degrees(np.arccos(np.clip(directions @ mean / max(np.linalg.norm(mean), 1e-12), -1, 1)))
    return _LOCKED if turned > _TURNED[1] and np.median(off) < _STILL else None


def _recordings(given: Path) -> list[Path]:
    """The recordings in a folder, or the one that is given."""
    if not given.is_dir():
        return [given]
    found = sorted(p for p in given.iterdir() if re.fullmatch(r"user[^_]*_.*\.csv(\.gz)?", p.name))
    if not found:
        raise NergError(f"there is no recording (userN_PLACE.csv) in {given}; give a folder of one place")
    return found


def _person_and_place(path: Path) -> tuple[str, str]:
    """``user101`` and ``room`` of ``user101_room.csv.gz``."""
    person, _, place = re.sub(r"\.csv(\.gz)?$", "", path.name).partition("_")
    return person, _PLACES.get(place, place)


def _find_settings(path: Path) -> Path:
    if not path.is_file():
        raise NergError(f"there is no {path}; correct its name")
    for folder in list(resolve_path(path).parents)[: _ABOVE + 1]:
        if (folder / _SETTINGS).is_file():
            return folder / _SETTINGS
    raise NergError(
        f"there is no {_SETTINGS} beside {path} or above, which has its place's scale; copy that of the same site there"
    )


def _of_place(path: Path, settings: dict[str, SceneSetting], where: Path) -> SceneSetting:
    place = _person_and_place(path)[1]
    if place not in settings:
        there = ", ".join(sanitize(name, 40) for name in list(settings)[:16])
        raise NergError(f'{path} is of "{sanitize(place, 40)}", of which {where} has nothing (it has {there}); rename it')
    return settings[place]


def _time(path: Path) -> str:
    """The column of times, which the sites call differently."""
    columns = read_table_columns(path)
    return next((name for name in _TIMES if name in columns), _TIMES[0])
