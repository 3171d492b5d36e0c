"""EyeNavGS: gaze in scenes of Gaussian splats, with the settings of each scene.

- Recordings are in units of the splats and tilted by 10 to 27 degrees; the import turns them upright, into metres,
  with the floor at height 0.
- One ray per frame starts midway between the eyes, along the mean of their lines of sight, which differ by 3.1
  degrees in every row; one eye alone (``--eye left``) is 1.6 degrees off.
- Recordings whose gaze is frozen or locked to the head (about half) are left out as a whole, which the report says.
- The NTHU site has its own ``scene_setting.csv`` and no start position: there the floor is not at zero height.
  Import an environment of both sites twice.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.files.values import parse_float

from . import poses
from .base import FROM_RECORDINGS, OPENGL, FixedFrameReader, RaysBuilder, Signature, option
from .poses import rotations_from_quaternions
from .tables import TableBlock, iterate_table, read_table_columns

# ---- Scene settings ----
#
# Settings with which EyeNavGS displays a scene in VR: scale, upright rotation, and position of the play area.

# From the viewer's axes (OpenXR: y up, -z forward) to those of splats (y down, z forward), as the viewer flips cameras.
_FLIP = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class SceneSetting:
    """One row of ``scene_setting.csv``."""

    place: str
    scale: float  # scene units per metre
    quaternion: tuple[float, ...]  # x, y, z, w: rotates the scene upright
    start: tuple[float, ...]  # position of the play area, metres; zero if not in the file

    @property
    def upright_rotation(self) -> np.ndarray:
        """Rotation (3, 3) that makes the scene upright."""
        return rotations_from_quaternions(np.array([self.quaternion]))[0]

    def to_play_area(self, points: np.ndarray) -> np.ndarray:
        """Transform points (n, 3) of recordings to the play area: y up, metres, the floor at height 0."""
        start = np.array(self.start)
        return ((points - start) / self.scale + start) @ self.upright_rotation.T + start

    def compute_splats_from_area(self) -> np.ndarray:
        """4x4 matrix from the play area to the axes and units of the scene's splats."""
        start, matrix = np.array(self.start), np.eye(4)
        matrix[:3, :3] = self.scale * _FLIP @ self.upright_rotation.T
        matrix[:3, 3] = _FLIP @ (start - self.scale * (self.upright_rotation.T @ start + start))
        return matrix + 0.0


def read_scene_settings(path: Path) -> dict[str, SceneSetting]:
    """Read the settings of each scene in ``path``, by name. Raises `NergError` for an invalid file."""
    texts = ["Scene_Name", "Quaternion"]
    if "Initial_Position" in read_table_columns(path):
        texts.append("Initial_Position")
    settings = {}
    for block in iterate_table(path, ["Scale"], texts):
        for scale, cells, line in zip(block.numbers[:, 0].tolist(), block.texts.tolist(), block.lines.tolist()):
            quaternion, start = (
                _parse_numbers(cells[1], 4),
                _parse_numbers(cells[2], 3) if len(cells) > 2 else (0.0, 0.0, 0.0),
            )
            if (
                quaternion is None
                or start is None
                or not 1e-6 < scale < 1e6
                or not 0.5 < np.hypot.reduce(quaternion) < 2
            ):
                raise NergError(
                    f"{path}, line {line}: {sanitize(cells[0], 40)!r} needs a scale above 0, a quaternion x, y, z, w "
                    "and an initial position of three numbers; copy the file again"
                )
            settings[cells[0]] = SceneSetting(cells[0], scale, quaternion, start)
    return settings


def _parse_numbers(text: str, count: int) -> tuple[float, ...] | None:
    """Parse the numbers in a cell such as ``0, 1.15, 0``; None for another number of them, or too large ones."""
    try:
        numbers = tuple(parse_float(word) for word in text.split(","))
    except ValueError:
        return None
    return numbers if len(numbers) == count and all(abs(v) < 1e6 for v in numbers) else None


# ---- EyeNavGS: gaze of participants in VR in captured scenes of Gaussian splats (arXiv 2506.02380) ----

_TICK = 1e-3  # seconds
_MIN_HEAD_TURNS = 5.0, 30.0  # degrees of head rotation needed to detect frozen gaze, and gaze locked to the head
# Median angle in degrees to the mean direction in the head; 7 to 13 for people who look around.
_MAX_OFF_DEGREES = 4.0
_QUATERNION_TOLERANCE = 1e-6  # of components, which have three or six decimals
_SETTINGS_FILE = "scene_setting.csv"
_MAX_PARENTS = 4  # parent folders of a recording that are searched for the settings
_PLACE_ALIASES = {"trian": "train"}
_HEAD = [f"Quaternion{a}" for a in "XYZW"]
_GAZE = [f"GazeQ{a}" for a in "XYZW"]
_COLUMNS = ["ViewIndex", *(f"Position{a}" for a in "XYZ"), *_HEAD, *_GAZE]
_TIMES = ("Timestamp", "timestep")
_FORWARD = np.array([0.0, 0.0, -1.0])
_FROZEN = "the gaze of the recording is frozen: it is constant although the head turns"
_LOCKED = "the gaze of the recording is locked to the head: it is a delayed copy of the head's direction"


@dataclass(frozen=True, kw_only=True)
class EyeNavGSOptions:
    """Options of EyeNavGS. Raises `NergError` for an unknown eye."""

    eye: str = option("both", "Eye whose gaze is imported: both (their mean), left or right.")

    def __post_init__(self) -> None:
        if self.eye not in ("both", "left", "right"):
            raise NergError(f'{parameter("eye")} is "{sanitize(self.eye, 40)}"; it must be both, left or right')


class EyeNavGS(FixedFrameReader):
    """``userN_PLACE.csv`` of both recording sites, whose columns are in different order, or folders of them; all of one
    scene.

    A frame has one row per eye, the left one first. Positions are those of the eyes, ``Quaternion`` is that of the head
    and ``GazeQ`` that of the line of sight, both x, y, z, w with -z forward, in a right-handed world with y
    approximately up. The two lines of sight differ by a constant 3 degrees (they always cross at 1.2 m), so that their
    mean is the gaze, and each single line is off by half of that. The ray starts midway between the eyes. A row without
    the row of the other eye is dropped.

    ``scene_setting.csv``, next to the recordings or in a parent folder, contains the scene's units per metre
    (``Scale``), its upright rotation (``Quaternion``; heads are upright after it, and tilted by up to 27 degrees
    before), and, from one of the sites, the position of the play area (``Initial_Position`` p): x is at
    R((x - p) / scale + p) + p in the play area, with the floor at height 0. The metadata contain the transform back to
    the axes of the splats as ``place_from_rays``. A recording with frozen gaze, or gaze locked to the head, is dropped.
    """

    name = "eyenavgs"
    files = (
        "`userN_PLACE.csv` of EyeNavGS (or folders of them), of one scene; `scene_setting.csv` next to them or in a "
        "parent folder"
    )
    frame_description = "right-handed, y up and in metres after the scene's rotation and scale"
    evidence = f"{FROM_RECORDINGS} of Rutgers; of NTHU, built from documentation"
    fixed_frame = OPENGL
    signature = Signature(columns=(("ViewIndex", "PositionX", "QuaternionX", "GazeQX"),))
    Options = EyeNavGSOptions

    def read(self, files: Sequence[Path], options: EyeNavGSOptions, builder: RaysBuilder) -> None:
        recordings = [path for file in files for path in _find_recordings(file)]
        setting, settings_by_path = None, {}
        for path in recordings:
            _check_columns(path)
            settings = _find_settings(path)
            if settings not in settings_by_path:
                builder.begin_source(settings)
                settings_by_path[settings] = read_scene_settings(settings)
                builder.count_lines(len(settings_by_path[settings]))
            place_setting = _find_place_setting(path, settings_by_path[settings], settings)
            if setting is not None and place_setting != setting:
                raise NergError(
                    f"{path} is of {sanitize(place_setting.place, 40)} and {recordings[0]} of "
                    f"{sanitize(setting.place, 40)}, or of another site's version of it, each with a frame of its own; "
                    "import them separately"
                )
            setting = place_setting
        assert setting is not None
        builder.add_metadata(
            tick=_TICK,
            place=setting.place,
            units_per_metre=setting.scale,
            place_from_rays=(setting.compute_splats_from_area() @ np.linalg.inv(OPENGL.to_rays())).tolist(),
        )
        faults = [_add_recording(path, setting, options, builder) for path in recordings]
        if all(faults):
            raise NergError(f"no recording has tracked eyes; {recordings[0]}: {faults[0]}; use other recordings")


READERS = (EyeNavGS(),)


def _add_recording(path: Path, setting: SceneSetting, options: EyeNavGSOptions, builder: RaysBuilder) -> str | None:
    """Add a recording's rows; returns why all were dropped, or None."""
    fault = _find_fault(path, ignores_bad_lines=builder.on_bad_line is not None)
    columns = read_table_columns(path)
    time = next((name for name in _TIMES if name in columns), _TIMES[0])
    builder.begin_source(path)
    for v, is_paired, lines in _pair_rows(builder.read_table(path, [*_COLUMNS, time])):
        eye_positions = setting.to_play_area(v[:, :, 1:4].reshape(-1, 3)).reshape(-1, 2, 3)
        directions = poses.rotations_from_quaternions(v[:, :, 8:12].reshape(-1, 4)) @ _FORWARD
        directions = (directions @ setting.upright_rotation.T).reshape(-1, 2, 3)
        side = {"both": slice(None), "left": slice(0, 1), "right": slice(1, 2)}[options.eye]
        builder.count_lines(int(is_paired.sum()))
        builder.add(
            v[:, 0 if options.eye != "right" else 1, 12] * _TICK,
            _split_file_name(path)[0],
            eye_positions[:, side].mean(axis=1),
            directions[:, side].mean(axis=1),
            rows=lines,
            tracking="eye",
            head=(poses.rotations_from_quaternions(v[:, 0, 4:8]) @ _FORWARD) @ setting.upright_rotation.T,
            eye_distance=np.where(is_paired, np.linalg.norm(eye_positions[:, 1] - eye_positions[:, 0], axis=1), np.nan),
            drop={**({fault: np.full(len(v), True)} if fault else {}), "the other eye's row is missing": ~is_paired},
        )
    return fault


def _pair_rows(blocks: Iterator[TableBlock]) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Pair the rows of both eyes: values (n, 2, C), left and right, whether both exist, (n,) bool (otherwise one row is
    in both environments), and the line of the first row, (n,)."""
    pending: TableBlock | None = None
    for block in blocks:
        v, lines = block.numbers, block.lines
        if pending is not None:
            v, lines, pending = np.concatenate([pending.numbers, v]), np.concatenate([pending.lines, lines]), None
        if v[-1, 0] == 0:
            # The row of the other eye may be in the next block.
            pending = TableBlock(v[-1:], np.empty((1, 0), dtype=str), lines[-1:])
            v, lines = v[:-1], lines[:-1]
        if len(v):
            yield _pair_eyes(v, lines)
    if pending is not None:
        yield _pair_eyes(pending.numbers, pending.lines)


def _pair_eyes(v: np.ndarray, lines: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    is_followed = np.r_[(v[:-1, 0] == 0) & (v[1:, 0] == 1), False]
    first = np.flatnonzero(~np.r_[False, is_followed[:-1]])
    is_paired = is_followed[first]
    return np.stack([v[first], v[first + is_paired]], axis=1), is_paired, lines[first]


def _find_fault(path: Path, ignores_bad_lines: bool) -> str | None:
    """Describe why the gaze of a recording is invalid, from the rows of the left eye; None if it is valid."""
    first: np.ndarray | None = None
    has_changes, max_turn, in_head = False, 0.0, []
    columns = ["ViewIndex", *_HEAD, *_GAZE]
    for v, _, _ in iterate_table(path, columns, on_bad_line=(lambda line, why: None) if ignores_bad_lines else None):
        v = v[(v[:, 0] == 0) & np.isfinite(v).all(axis=1), 1:]
        v = v[(np.linalg.norm(v[:, :4], axis=1) > 0.5) & (np.linalg.norm(v[:, 4:], axis=1) > 0.5)]
        if not len(v):
            continue
        start: np.ndarray = v[0] if first is None else first
        first = start
        has_changes |= bool(np.abs(v[:, 4:] - start[4:]).max() > _QUATERNION_TOLERANCE)
        # The absolute dot product of unit quaternions is the cosine of half the angle between them.
        length = np.linalg.norm(v[:, :4], axis=1) * np.linalg.norm(start[:4])
        max_turn = max(max_turn, 2 * np.degrees(np.arccos(min(1.0, np.abs(v[:, :4] @ start[:4] / length).min()))))
        head, gaze = (poses.rotations_from_quaternions(q) for q in (v[:, :4], v[:, 4:]))
        in_head.append(np.einsum("nji,nj->ni", head, gaze @ _FORWARD).astype(np.float32))
    if first is None or max_turn <= _MIN_HEAD_TURNS[0]:
        return None
    if not has_changes:
        return _FROZEN
    directions = np.concatenate(in_head)
    mean = directions.mean(axis=0, dtype=np.float64)
    off_degrees = np.degrees(np.arccos(np.clip(directions @ mean / max(np.linalg.norm(mean), 1e-12), -1, 1)))
    return _LOCKED if max_turn > _MIN_HEAD_TURNS[1] and np.median(off_degrees) < _MAX_OFF_DEGREES else None


def _find_recordings(path: Path) -> list[Path]:
    """The recordings in a folder, or the recording itself."""
    if not path.is_dir():
        return [path]
    recordings = sorted(p for p in path.iterdir() if re.fullmatch(r"user[^_]*_.*\.csv(\.gz)?", p.name))
    if not recordings:
        raise NergError(f"there is no recording (userN_PLACE.csv) in {path}; specify a folder with those of one scene")
    return recordings


def _split_file_name(path: Path) -> tuple[str, str]:
    """Split a file name: ``user101`` and ``room`` for ``user101_room.csv.gz``."""
    person, _, place = re.sub(r"\.csv(\.gz)?$", "", path.name).partition("_")
    return person, _PLACE_ALIASES.get(place, place)


def _check_columns(path: Path) -> None:
    """Raise `NergError` for a file without the columns of a recording."""
    if not path.is_file():
        raise NergError(f"{path} does not exist; correct its name")
    columns = read_table_columns(path)
    missing = [name for name in _COLUMNS if name not in columns]
    if not any(name in columns for name in _TIMES):
        missing.append(" or ".join(_TIMES))
    if missing:
        raise NergError(
            f"{path} is not a recording of EyeNavGS: it has no column {', '.join(missing)}; find its format with nerg "
            "rays guess"
        )


def _find_settings(path: Path) -> Path:
    for folder in list(resolve_path(path).parents)[: _MAX_PARENTS + 1]:
        if (folder / _SETTINGS_FILE).is_file():
            return folder / _SETTINGS_FILE
    raise NergError(
        f"there is no {_SETTINGS_FILE} next to {path} or in a parent folder, which has the scale of the scene; copy "
        "that of the same site there"
    )


def _find_place_setting(path: Path, settings: dict[str, SceneSetting], settings_path: Path) -> SceneSetting:
    place = _split_file_name(path)[1]
    if place not in settings:
        available = ", ".join(sanitize(name, 40) for name in list(settings)[:16])
        raise NergError(
            f'{path} is of "{sanitize(place, 40)}", which is not in {settings_path} (it has {available}); rename it'
        )
    return settings[place]
