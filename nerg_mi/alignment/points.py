"""Alignment from what is known in both frames: points that somebody picked, and cameras with their poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import read_json, check_regular_file
from nerg_mi.photos.colmap import find_pose_source
from nerg_mi.photos.images import read_posed_images
from nerg_mi.photos.posed import PosedImages
from nerg_mi.rays.readers.tables import iterate_table, read_table_columns

from .constraints import AlignmentFit, AlignmentTarget, Progress, angles_between, mirror_sentence, pair_covariance
from .similarity import ALL, MIRROR, check_points, residual_distances, fit_similarity, in_plane, leave_one_out, transform_points, upright_basis

# ---- Alignment from cameras whose poses are known in both frames: two models of the same pictures ----
#
# Each camera gives the rotation by itself, of which the robust mean counts (L1 on the rotation group: R. Hartley et
# al., 2011); scale and shift follow from the centres, robustly too, so that some wrong poses do no harm and two cameras
# are enough.

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

    def fit(self, target: AlignmentTarget, progress: Progress) -> AlignmentFit:
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
        off = residual_distances(matrix, x, y)
        inliers = (off <= 5 * np.median(off) + 1e-9 * size) & (angle <= 5 * np.median(angle) + 1e-6)
        notes = [
            *self.notes,
            f"{len(a)} cameras in common, {int(inliers.sum())} agree: off by {100 * np.median(off):.2g} cm and "
            f"{np.median(angle):.2g} degrees (median)",
        ]
        mirrored = None
        flipped = transform_points(MIRROR, x)
        if len(x) > 3 and not in_plane(x):
            off_flipped = residual_distances(fit_similarity(flipped, y), flipped, y)
            if np.median(off_flipped) < _CLEAR * np.median(residual_distances(fit_similarity(x, y), x, y)):
                mirrored = mirror_sentence("the centres meet", np.median(off_flipped), np.median(off))
        about = {"cameras": len(a), "agreeing": int(inliers.sum())}
        kept = inliers if inliers.sum() > 2 else np.ones(len(x), bool)
        covariance = pair_covariance(x[kept], y[kept], matrix, ALL)
        return AlignmentFit(matrix, 100 * off, angle, covariance, mirrored, x, y, about, notes, doubts)


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
    models = [read_posed_images(find_pose_source(path)) for path in (tracking, place)]
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


# ---- Alignment from points that somebody picked in both frames ----

PAIRS_BYTES = 4 << 20  # A file of pairs may have so many bytes; nobody picks so many points
_COLUMNS = ("x", "y", "z", "place_x", "place_y", "place_z")
_SHAPE = (
    'CSV with the columns x,y,z (tracking, metres) and place_x,place_y,place_z, or JSON [{"tracking": [x, y, z], '
    '"place": [x, y, z]}, ...]'
)
# A mirrored frame is told where it fits so much better.


@dataclass(frozen=True, eq=False)
class Pairs:
    """``tracking`` and ``place``: (N, 3) the same points in both frames; ``source``: whose they are, for messages;
    ``names``: of the points, or none."""

    tracking: np.ndarray
    place: np.ndarray
    source: str = "the pairs"
    names: tuple[str, ...] = ()

    kind = "pairs"

    def fit(self, target: AlignmentTarget, progress: Progress) -> AlignmentFit:
        """Umeyama's solution. Raises `NergError` for points that are too few or degenerate."""
        x, y = self.tracking, transform_points(target.to_z_up, self.place)
        check_points(x, y, self.source, upright=target.is_upright)
        options: dict[str, Any] = {"upright": target.is_upright, "scale": target.scale}
        matrix = fit_similarity(x, y, **options)
        off, left_out = residual_distances(matrix, x, y), leave_one_out(x, y, **options)
        flipped = transform_points(MIRROR, x)
        turned = fit_similarity(flipped, y, **options)
        notes = [self._describe(off, left_out)]
        mirrored = None
        if not target.is_upright and in_plane(x):
            notes.append("the points lie in a plane, so that they do not tell a mirrored frame; add one off the plane")
        elif _rms(residual_distances(turned, flipped, y)) < _CLEAR * _rms(off):
            mirrored = mirror_sentence("the pairs meet", _rms(residual_distances(turned, flipped, y)), _rms(off))
        basis = upright_basis(False) if target.is_upright else ALL
        if target.scale is not None:
            basis = basis[:, :-1]
        known = left_out[np.isfinite(left_out)]
        about = {"pairs": len(x), "leave_one_out_cm": {"median": _cm(known, 50), "largest": _cm(known, 100)}}
        return AlignmentFit(
            target.to_place(matrix),
            100 * off,
            angles_between(y.mean(axis=0), transform_points(matrix, x), y),
            pair_covariance(x, y, matrix, basis),
            mirrored,
            x,
            self.place,
            about,
            notes,
            self._doubts(off, left_out),
        )

    def _describe(self, off: np.ndarray, left_out: np.ndarray) -> str:
        known = left_out[np.isfinite(left_out)]
        left = (
            f"; each from the others: {100 * np.median(known):.2g} cm (median), {100 * known.max():.2g} cm (worst)"
            if len(known)
            else "; too few to tell one from the others"
        )
        return (
            f"{len(off)} pairs, off by {100 * np.median(off):.2g} cm (median), {100 * off.max():.2g} cm (worst){left}"
        )

    def _doubts(self, off: np.ndarray, left_out: np.ndarray) -> list[str]:
        """The pair that was picked wrong, where one stands out."""
        known = np.where(np.isfinite(left_out), left_out, 0)
        worst = int(np.argmax(known))
        rest = np.delete(off, worst)
        if len(off) < 5 or not known[worst] > 0.05:
            return []
        x, y = np.delete(self.tracking, worst, 0), np.delete(self.place, worst, 0)
        without = residual_distances(fit_similarity(x, y), x, y)
        if not np.median(without) < 0.25 * np.median(rest):
            return []
        name = f' ("{sanitize(self.names[worst], 60)}")' if self.names else ""
        return [
            f"pair {worst + 1}{name} is {100 * known[worst]:.0f} cm from where the others put it, and they agree to "
            f"{100 * np.median(without):.2g} cm without it: was it picked wrong?"
        ]


def read_pairs(path: Path) -> Pairs:
    """The pairs in a CSV or JSON file. Raises `NergError` for a file that holds none."""
    source = f'the file "{path}"'
    check_regular_file(path, "file of pairs", PAIRS_BYTES)
    tracking, place, names = _read_json(path) if path.suffix.lower() == ".json" else _read_csv(path)
    if not len(tracking):
        raise NergError(f"{source} holds no pairs of points; it is {_SHAPE}")
    return Pairs(tracking, place, source, names)


def _read_csv(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    columns = read_table_columns(path)
    missing = [name for name in _COLUMNS if name not in columns]
    if missing:
        raise NergError(f'the file of pairs "{path}" has no column {", ".join(missing)}; it is {_SHAPE}')
    texts = ["name"] if "name" in columns else []
    blocks = list(iterate_table(path, _COLUMNS, texts))
    if not blocks:
        return np.zeros((0, 3)), np.zeros((0, 3)), ()
    numbers = np.concatenate([b.numbers for b in blocks])
    names = tuple(str(t[0]) for b in blocks for t in b.texts) if texts else ()
    return numbers[:, :3], numbers[:, 3:], names


def _read_json(path: Path) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    rows: Any = read_json(path, "file of pairs", PAIRS_BYTES)
    rows = rows.get("pairs") if isinstance(rows, dict) else rows
    try:
        points = [np.array([[float(v) for v in row[k]] for row in rows]) for k in ("tracking", "place")]
        if rows and any(p.shape != (len(rows), 3) for p in points):
            raise ValueError("a point has three coordinates")
        names = tuple(str(row.get("name", "")) for row in rows)
    except (TypeError, ValueError, KeyError, IndexError, AttributeError, OverflowError) as error:
        raise NergError(f'the file of pairs "{path}" cannot be used ({sanitize(error)}); it is {_SHAPE}') from error
    return points[0].reshape(-1, 3), points[1].reshape(-1, 3), names if any(names) else ()


def _rms(off: np.ndarray) -> float:
    return float(np.sqrt(np.mean(off**2)))


def _cm(off: np.ndarray, percent: float) -> float | None:
    return float(100 * np.percentile(off, percent)) if len(off) else None
