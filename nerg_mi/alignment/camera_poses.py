"""Alignment from cameras whose poses are known in both frames: two models of the same pictures.

Each camera gives the rotation by itself, of which the robust mean counts (L1 on the rotation group: R. Hartley et al.,
2011); scale and shift follow from the centres, robustly too, so that some wrong poses do no harm and two cameras are
enough.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.capture.posed import PosedImages
from nerg_mi.capture.sources import find_source, read_posed
from nerg_mi.errors import NergError

from .chart import ALL
from .evidence import Fit, Progress, Target, pair_covariance
from .umeyama import MIRROR, check_points, errors, fit_similarity, in_plane, move

_ROUNDS = 50
_CLEAR = 0.5
# Degrees beyond which the cameras' axes are not the same in both models.
_ASTRAY = 20.0


@dataclass(frozen=True, eq=False)
class Cameras:
    """``tracking`` and ``place``: (N, 4, 4) OpenGL camera-to-world poses of the same pictures in both frames."""

    tracking: np.ndarray
    place: np.ndarray
    source: str = "the cameras"
    notes: tuple[str, ...] = ()  # on what of the models is not used

    kind = "cameras"

    def fit(self, target: Target, progress: Progress) -> Fit:
        """The robust mean. Raises `NergError` where all cameras stand at one place."""
        a, b = self.tracking, self.place
        if len(a) < 2:
            raise NergError(f"{self.source} have {len(a)} pictures in common, and two or more are needed; add some")
        x, y = a[:, :3, 3], b[:, :3, 3]
        size = float(np.linalg.norm(np.ptp(x, axis=0)))
        if not size > 1e-6 * max(1.0, float(np.abs(x).max())):
            raise NergError(
                f"{self.source} all stand at one place, which leaves the scale open; add pictures from others"
            )
        each = b[:, :3, :3] @ np.swapaxes(a[:, :3, :3], 1, 2)
        rotation = mean_rotation(each)
        angle = np.degrees(Rotation.from_matrix(each @ rotation.T).magnitude())
        doubts = []
        if np.median(angle) > _ASTRAY:
            doubts.append(
                f"the cameras' axes disagree by {np.median(angle):.0f} degrees (median), and only their centres were "
                "used: are both models of the same convention (OpenGL poses in transforms.json, COLMAP's in a model)?"
            )
            check_points(x, y, self.source)
            matrix = fit_similarity(x, y, scale=target.scale)
        else:
            scale, shift = _scale_and_shift(x @ rotation.T, y, target.scale)
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = scale * rotation, shift
        off = errors(matrix, x, y)
        inliers = (off <= 5 * np.median(off) + 1e-9 * size) & (angle <= 5 * np.median(angle) + 1e-6)
        notes = [
            *self.notes,
            f"{len(a)} cameras in common, {int(inliers.sum())} agree: off by {100 * np.median(off):.2g} cm and "
            f"{np.median(angle):.2g} degrees (median)",
        ]
        mirrored = None
        flipped = move(MIRROR, x)
        if len(x) > 3 and not in_plane(x):
            off_flipped = errors(fit_similarity(flipped, y), flipped, y)
            if np.median(off_flipped) < _CLEAR * np.median(errors(fit_similarity(x, y), x, y)):
                mirrored = (
                    f"with the x axis negated the centres meet to {100 * np.median(off_flipped):.3g} cm, as they are "
                    f"to {100 * np.median(off):.3g} cm only"
                )
        about = {"cameras": len(a), "agreeing": int(inliers.sum())}
        kept = inliers if inliers.sum() > 2 else np.ones(len(x), bool)
        covariance = pair_covariance(x[kept], y[kept], matrix, ALL)
        return Fit(matrix, 100 * off, angle, covariance, mirrored, x, y, about, notes, doubts)


def mean_rotation(rotations: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) with the least sum of angles to ``rotations`` (N, 3, 3)."""
    # From the one that is nearest to the others, so that a few wrong ones do not lead astray.
    some = rotations[:: max(1, len(rotations) // 200)]
    between = np.arccos(np.clip((np.einsum("aij,bij->ab", some, some) - 1) / 2, -1, 1))
    mean = Rotation.from_matrix(some[int(np.argmin(np.median(between, axis=1)))])
    all_of = Rotation.from_matrix(rotations)
    for _ in range(_ROUNDS):
        away = (all_of * mean.inv()).as_rotvec()
        weight = 1 / np.maximum(np.linalg.norm(away, axis=1), 1e-4)
        step = weight @ away / weight.sum()
        mean = Rotation.from_rotvec(step) * mean
        if np.linalg.norm(step) < 1e-12:
            break
    return mean.as_matrix()


def _scale_and_shift(x: np.ndarray, y: np.ndarray, given: float | None) -> tuple[float, np.ndarray]:
    """The scale and shift that carry ``x`` to ``y``, both (N, 3), with the least sum of distances."""
    i, j = np.triu_indices(min(len(x), 200), 1)
    pick = np.linspace(0, len(x) - 1, min(len(x), 200)).astype(int)
    i, j = pick[i], pick[j]
    length = np.linalg.norm(x[i] - x[j], axis=1)
    far = length >= np.median(length)
    scale = given or float(np.median(np.linalg.norm(y[i] - y[j], axis=1)[far] / np.maximum(length[far], 1e-300)))
    shift = np.median(y - scale * x, axis=0)
    for _ in range(_ROUNDS):
        off = np.linalg.norm(scale * x + shift - y, axis=1)
        weight = 1 / np.maximum(off, 1e-6 * max(float(np.abs(y).max()), 1e-300))
        w = weight / weight.sum()
        x0, y0 = w @ x, w @ y
        if given is None:
            spread = float(w @ np.sum((x - x0) ** 2, axis=1))
            scale = float(w @ np.sum((x - x0) * (y - y0), axis=1)) / spread if spread > 0 else scale
        shift = y0 - scale * x0
    if not scale > 0:
        raise NergError(
            "the centres of the cameras run against their axes in the two frames: one of them is mirrored, or its "
            "poses are of another convention; correct one"
        )
    return scale, shift


def read_cameras(tracking: Path, place: Path) -> Cameras:
    """The poses of the pictures that two models (transforms.json, or COLMAP's) have in common, by the names of their
    files. Raises `NergError` where there are none."""
    models = [read_posed(find_source(path)) for path in (tracking, place)]
    for key in (_whole, _last):
        tables = [_by_name(model, key) for model in models]
        common = sorted(set(tables[0]) & set(tables[1]))
        if len(common) >= 2:
            a, b = (np.stack([t[name] for name in common]) for t in tables)
            notes = tuple(note for model in models for note in (*map(str, model.unused), *model.notes))
            return Cameras(a, b, f'the cameras of "{tracking}" and "{place}"', notes)
    raise NergError(
        f'"{tracking}" and "{place}" have no two pictures of the same name; give two models of the same pictures'
    )


def _by_name(model: PosedImages, key) -> dict[str, np.ndarray]:
    return {key(f.name): f.to_world for f in model.frames}


def _whole(name: str) -> str:
    return str(PurePosixPath(name.replace("\\", "/")).with_suffix(""))


def _last(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).stem
