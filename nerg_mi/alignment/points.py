"""Alignment from correspondences: picked points, and camera poses known in both frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.safe_read import check_regular_file, read_json, translate_read_errors
from nerg_mi.files.schema import NUMBER, Items, check_json
from nerg_mi.files.values import FilePath
from nerg_mi.maths.transforms import transform_points
from nerg_mi.photos.photo_set import Photos
from nerg_mi.photos.posed import describe_unused
from nerg_mi.tracking.readers.columns import open_named_table

from .constraints import (
    AlignmentFit,
    AlignmentTarget,
    ProgressCallback,
    angles_between,
    describe_mirror,
    pair_covariance,
)
from .similarity import (
    MIRROR,
    LocalSimilarity,
    check_points,
    fit_similarity,
    is_planar,
    leave_one_out_distances,
    residual_distances,
)

# ---- Cameras ----
#
# Alignment from cameras whose poses are known in both frames, that is from two models of the same photos.
#
# Each camera determines the rotation; the robust mean is used (L1 on the rotation group, R. Hartley et al., 2011).
# Scale and shift are fitted robustly to the camera centres, so that a few wrong poses do no harm and two cameras
# suffice.

_ROUNDS = 50
_MIRROR_RATIO = 0.5
# Median angle in degrees above which the models use different camera axes.
_MAX_AXIS_ANGLE = 20.0


@dataclass(frozen=True, eq=False)
class Cameras:
    """OpenGL camera-to-world poses (N, 4, 4) of the same photos in both frames."""

    tracking: np.ndarray
    environment: np.ndarray
    source: str = "the cameras"
    notes: tuple[str, ...] = ()  # warnings about unused content of the models

    kind = "cameras"

    def fit(self, target: AlignmentTarget, progress: ProgressCallback) -> AlignmentFit:
        """Fit the similarity robustly. Raises `NergError` if all cameras have the same position."""
        a, b = self.tracking, self.environment
        if target.turn is not None or target.shift is not None:
            raise NergError(
                f"{parameter('turn')} and {parameter('shift')} do not apply to {parameter('tracking_cameras')}, "
                "which determine both; leave them out"
            )
        if len(a) < 2:
            raise NergError(f"{self.source} have {len(a)} photos in common, but at least two are needed; add photos")
        x, y = a[:, :3, 3], b[:, :3, 3]
        size = float(np.linalg.norm(np.ptp(x, axis=0)))
        if not size > 1e-6 * max(1.0, float(np.abs(x).max())):
            raise NergError(
                f"{self.source} all have the same position, so the scale is undetermined; add photos from other "
                "positions"
            )
        rotations = b[:, :3, :3] @ np.swapaxes(a[:, :3, :3], 1, 2)
        rotation = mean_rotation(rotations)
        angle = np.degrees(Rotation.from_matrix(rotations @ rotation.T).magnitude())
        warnings = []
        if np.median(angle) > _MAX_AXIS_ANGLE:
            warnings.append(
                f"the cameras' axes disagree by {np.median(angle):.0f} degrees (median), and only their centres were "
                "used: check that both models use the same convention (OpenGL poses in transforms.json, COLMAP's "
                "in a model)"
            )
            check_points(x, y, self.source)
            matrix = fit_similarity(x, y, scale=target.scale)
        else:
            scale, shift = _fit_scale_and_shift(x @ rotation.T, y, target.scale)
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = scale * rotation, shift
        distance = residual_distances(matrix, x, y)
        inliers = (distance <= 5 * np.median(distance) + 1e-9 * size) & (angle <= 5 * np.median(angle) + 1e-6)
        notes = [
            *self.notes,
            f"{len(a)} cameras in common, {int(inliers.sum())} agree; residual {100 * np.median(distance):.2g} cm and "
            f"{np.median(angle):.2g} degrees (median)",
        ]
        mirrored = None
        flipped = transform_points(MIRROR, x)
        if len(x) > 3 and not is_planar(x):
            distance_flipped = residual_distances(fit_similarity(flipped, y), flipped, y)
            if np.median(distance_flipped) < _MIRROR_RATIO * np.median(residual_distances(fit_similarity(x, y), x, y)):
                mirrored = describe_mirror("the centres meet", np.median(distance_flipped), np.median(distance))
        metadata = {"cameras": len(a), "agreeing": int(inliers.sum())}
        mask = inliers if inliers.sum() > 2 else np.ones(len(x), bool)
        center = transform_points(matrix, x[mask]).mean(axis=0)
        covariance = pair_covariance(x[mask], y[mask], LocalSimilarity(matrix, center))
        return AlignmentFit(matrix, 100 * distance, angle, covariance, mirrored, x, y, metadata, notes, warnings)


def mean_rotation(rotations: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) with the smallest sum of angles to ``rotations`` (N, 3, 3)."""
    # Start from the medoid, which is robust to outliers.
    subset = rotations[:: max(1, len(rotations) // 200)]
    between = np.arccos(np.clip((np.einsum("aij,bij->ab", subset, subset) - 1) / 2, -1, 1))
    mean = Rotation.from_matrix(subset[int(np.argmin(np.median(between, axis=1)))])
    all_rotations = Rotation.from_matrix(rotations)
    for _ in range(_ROUNDS):
        deviation = (all_rotations * mean.inv()).as_rotvec()
        weight = 1 / np.maximum(np.linalg.norm(deviation, axis=1), 1e-4)
        step = weight @ deviation / weight.sum()
        mean = Rotation.from_rotvec(step) * mean
        if np.linalg.norm(step) < 1e-12:
            break
    return mean.as_matrix()


def _fit_scale_and_shift(x: np.ndarray, y: np.ndarray, fixed_scale: float | None) -> tuple[float, np.ndarray]:
    """Return the scale and the shift that map ``x`` to ``y``, (N, 3) each, with the smallest sum of distances."""
    i, j = np.triu_indices(min(len(x), 200), 1)
    pick = np.linspace(0, len(x) - 1, min(len(x), 200)).astype(int)
    i, j = pick[i], pick[j]
    length = np.linalg.norm(x[i] - x[j], axis=1)
    is_long = length >= np.median(length)
    scale = fixed_scale or float(
        np.median(np.linalg.norm(y[i] - y[j], axis=1)[is_long] / np.maximum(length[is_long], 1e-300))
    )
    shift = np.median(y - scale * x, axis=0)
    for _ in range(_ROUNDS):
        distance = np.linalg.norm(scale * x + shift - y, axis=1)
        weight = 1 / np.maximum(distance, 1e-6 * max(float(np.abs(y).max()), 1e-300))
        w = weight / weight.sum()
        x0, y0 = w @ x, w @ y
        if fixed_scale is None:
            spread = float(w @ np.sum((x - x0) ** 2, axis=1))
            scale = float(w @ np.sum((x - x0) * (y - y0), axis=1)) / spread if spread > 0 else scale
        shift = y0 - scale * x0
    if not scale > 0:
        raise NergError(
            "camera centres and camera axes contradict each other in the two frames: one frame is mirrored, or its "
            "poses use another convention; correct it"
        )
    return scale, shift


def read_cameras(tracking: Photos | FilePath, environment: Photos | FilePath) -> Cameras:
    """Return the poses that two models (transforms.json or COLMAP) have in common, matched by file name.

    Raises `NergError` if there are fewer than two.
    """
    models = [Photos.open(photos) for photos in (tracking, environment)]
    for key in (_path_key, _name_key):
        tables = [{key(frame.name): frame.to_world for frame in model.frames} for model in models]
        common = sorted(set(tables[0]) & set(tables[1]))
        if len(common) >= 2:
            a, b = (np.stack([t[name] for name in common]) for t in tables)
            notes = tuple(note for model in models for note in (*describe_unused(model.unused), *model.notes))
            return Cameras(a, b, f'the cameras of "{models[0].path}" and "{models[1].path}"', notes)
    raise NergError(
        f'"{models[0].path}" and "{models[1].path}" have fewer than two photos with the same name; give two models '
        "of the same photos"
    )


def _path_key(name: str) -> str:
    return str(PurePosixPath(name.replace("\\", "/")).with_suffix(""))


def _name_key(name: str) -> str:
    return PurePosixPath(name.replace("\\", "/")).stem


# ---- Picked points ----

MAX_PAIRS_BYTES = 4 << 20  # maximum size of a file of pairs
_POINT = Items(NUMBER, 3, 3)
_COLUMNS = ("x", "y", "z", "place_x", "place_y", "place_z")
_FORMAT = (
    'CSV with the columns x,y,z (tracking, metres) and place_x,place_y,place_z, or JSON [{"tracking": [x, y, z], '
    '"place": [x, y, z]}, ...]'
)


@dataclass(frozen=True, eq=False)
class Pairs:
    """The same points (N, 3) in both frames; ``source`` names them in messages, ``names`` are those of the points,
    if any."""

    tracking: np.ndarray
    environment: np.ndarray
    source: str = "the pairs"
    names: tuple[str, ...] = ()

    kind = "pairs"

    def fit(self, target: AlignmentTarget, progress: ProgressCallback) -> AlignmentFit:
        """Fit the similarity by Umeyama's method. Raises `NergError` for too few or degenerate points."""
        x, y = self.tracking, transform_points(target.to_z_up, self.environment)
        check_points(x, y, self.source, upright=target.is_upright)
        options = target.constraints
        matrix = fit_similarity(x, y, **options)
        distance, leave_one_out = residual_distances(matrix, x, y), leave_one_out_distances(x, y, **options)
        flipped = transform_points(MIRROR, x)
        # A mirrored frame is compared with turn and shift free, which refer to the declared frame.
        free: dict[str, Any] = {"upright": target.is_upright, "scale": target.scale}
        free_distance = residual_distances(fit_similarity(x, y, **free), x, y)
        mirrored_distance = residual_distances(fit_similarity(flipped, y, **free), flipped, y)
        notes = [self._describe(distance, leave_one_out)]
        mirrored = None
        if not target.is_upright and is_planar(x):
            notes.append(
                "the points lie in a plane, so a mirrored frame cannot be detected; add a point outside the plane"
            )
        elif _rms(mirrored_distance) < _MIRROR_RATIO * _rms(free_distance):
            mirrored = describe_mirror("the pairs meet", _rms(mirrored_distance), _rms(free_distance))
        finite = leave_one_out[np.isfinite(leave_one_out)]
        metadata = {
            "pairs": len(x),
            "leave_one_out_cm": {"median": _percentile_cm(finite, 50), "largest": _percentile_cm(finite, 100)},
        }
        return AlignmentFit(
            target.to_scene_frame(matrix),
            100 * distance,
            angles_between(y.mean(axis=0), transform_points(matrix, x), y),
            pair_covariance(x, y, target.parametrize(matrix, transform_points(matrix, x).mean(axis=0))),
            mirrored,
            x,
            self.environment,
            metadata,
            notes,
            self._warn_outlier(distance, leave_one_out),
        )

    def _describe(self, distance: np.ndarray, leave_one_out: np.ndarray) -> str:
        finite = leave_one_out[np.isfinite(leave_one_out)]
        cross_validation = (
            f"; leave-one-out {100 * np.median(finite):.2g} cm (median), {100 * finite.max():.2g} cm (worst)"
            if len(finite)
            else "; too few for leave-one-out residuals"
        )
        return (
            f"{len(distance)} pairs, residual {100 * np.median(distance):.2g} cm (median), "
            f"{100 * distance.max():.2g} cm (worst){cross_validation}"
        )

    def _warn_outlier(self, distance: np.ndarray, leave_one_out: np.ndarray) -> list[str]:
        """Warn about a pair that was probably picked wrong."""
        finite = np.where(np.isfinite(leave_one_out), leave_one_out, 0)
        worst = int(np.argmax(finite))
        others = np.delete(distance, worst)
        if len(distance) < 5 or not finite[worst] > 0.05:
            return []
        x, y = np.delete(self.tracking, worst, 0), np.delete(self.environment, worst, 0)
        without = residual_distances(fit_similarity(x, y), x, y)
        if not np.median(without) < 0.25 * np.median(others):
            return []
        name = f' ("{sanitize(self.names[worst], 60)}")' if self.names else ""
        return [
            f"pair {worst + 1}{name} is {100 * finite[worst]:.0f} cm from the position predicted by the others, "
            "which agree to "
            f"{100 * np.median(without):.2g} cm without it: check this pair"
        ]


def read_pairs(path: Path) -> Pairs:
    """Read point pairs from a CSV or JSON file. Raises `NergError` for a file without pairs."""
    source = f'the file "{path}"'
    check_regular_file(path, "file of pairs", MAX_PAIRS_BYTES)
    tracking, environment, names = _read_json(path) if path.suffix.lower() == ".json" else _read_csv(path)
    if not len(tracking):
        raise NergError(f"{source} contains no pairs of points; the format is {_FORMAT}")
    return Pairs(tracking, environment, source, names)


def _read_csv(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    columns, table = open_named_table(path, _COLUMNS, ["name"], optional=["name"])
    blocks = list(table)
    if not blocks:
        return np.zeros((0, 3)), np.zeros((0, 3)), ()
    numbers = np.concatenate([b.numbers for b in blocks])
    names = tuple(str(t[0]) for b in blocks for t in b.texts) if "name" in columns else ()
    return numbers[:, :3], numbers[:, 3:], names


def _read_json(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    rows: Any = read_json(path, "file of pairs", MAX_PAIRS_BYTES)
    with translate_read_errors(path, "file of pairs", f"the format is {_FORMAT}"):
        rows = check_json(rows, {"pairs": list})["pairs"] if isinstance(rows, dict) else rows
        check_json(rows, Items({"tracking": _POINT, "place": _POINT}), "pairs")
    points = [np.array([row[k] for row in rows], np.float64).reshape(-1, 3) for k in ("tracking", "place")]
    names = tuple(str(row.get("name", "")) for row in rows)
    return points[0], points[1], names if any(names) else ()


def _rms(distance: np.ndarray) -> float:
    return float(np.sqrt(np.mean(distance**2)))


def _percentile_cm(distance: np.ndarray, percent: float) -> float | None:
    return float(100 * np.percentile(distance, percent)) if len(distance) else None
