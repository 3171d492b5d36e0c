"""How EyeNavGS put places into VR: their scale, what stands them upright, and where the play area lies in them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import plain
from nerg_mi.rays.readers.parsing.poses import rotations_from_quaternions
from nerg_mi.rays.readers.parsing.tables import iterate_table, table_columns

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
    if "Initial_Position" in table_columns(path):
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
                    f"{path}, line {line}: {plain(cells[0], 40)!r} needs a scale above 0, a quaternion x, y, z, w and "
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
