"""From the coordinates of a model's file to those in which a place was trained from it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import read_checkpoint


@dataclass(frozen=True, eq=False)
class PlaceFrame:
    """``scale``: length in the place of one unit of the file; ``rotation`` (3, 3), ``shift`` (3,) in the place's units:
    place = scale rotation file + shift. ``up``: (3,) in the place, where its training knew it. ``sha256``: of the model
    that it was trained on."""

    scale: float
    rotation: np.ndarray
    shift: np.ndarray
    up: np.ndarray | None = None
    sha256: str | None = None

    @classmethod
    def scaled(cls, scale: float) -> PlaceFrame:
        """The file's own coordinates, in another unit. Raises `NergError` for what is no scale."""
        if not (np.isfinite(scale) and 1e-9 <= scale <= 1e9):
            raise NergError(f"the length of the model's unit in metres is a positive number, got {scale} (--scale)")
        return cls(scale, np.eye(3), np.zeros(3))

    @classmethod
    def of_checkpoint(cls, path: Path) -> PlaceFrame:
        """As the provenance of a radiance checkpoint tells. Raises `NergError` for one that does not."""
        about = read_checkpoint(path, "radiance")[1].get("provenance")
        about = about if isinstance(about, dict) else {}
        try:
            to_file = np.array(about["to_file"], np.float64).reshape(4, 4)
            up = None if about.get("up") is None else np.array(about["up"], np.float64).reshape(3)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise NergError(
                f'the place "{path}" does not say in which coordinates it was trained; give --scale in place of '
                "--place if it was trained in those of its file, or train it anew"
            ) from error
        scale = float(np.cbrt(np.linalg.det(to_file[:3, :3]))) if np.isfinite(to_file).all() else 0.0
        rotation = to_file[:3, :3].T / scale if scale > 1e-9 else np.zeros((3, 3))
        if not np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3:
            raise NergError(f'the coordinates that the place "{path}" names are no similarity; train it anew')
        sha256 = about.get("sha256")
        up = up if up is not None and np.isfinite(up).all() and np.linalg.norm(up) > 0.5 else None
        return cls(
            1 / scale, rotation, -rotation @ to_file[:3, 3] / scale, up, sha256 if isinstance(sha256, str) else None
        )

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the file in the place."""
        return self.scale * points @ self.rotation.T + self.shift
