"""Posed image sets as their files describe them, before images are opened, and semi-dense points of Project Aria."""

from __future__ import annotations

import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.files.safe_read import is_regular_file, read_line_blocks, resolve_path
from nerg_mi.files.values import parse_float
from nerg_mi.maths.coordinates import check_near_origin
from nerg_mi.maths.transforms import check_rigid_transforms, nearest_rotation, transform_points

from .cameras import Intrinsics
from .observed import ObservedPoints

# ---- Posed image sets ----
#
# Poses are OpenGL camera-to-world matrices (x right, y up, z back) in the coordinates and units of the data set.
# Readers do not re-centre, scale or rotate them.

LENS_KEYS = tuple("w h fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6 camera_angle_x camera_angle_y fisheye".split())
"""Keys of `PosedFrame.lens`, all floats: pixels, radians, and coefficients as in `Intrinsics`; "fisheye" is 1 for
fisheye lenses."""

MAX_POSITION = 1e12
"""Maximum distance from the origin in units. Farther away, differences of positions are lost to rounding."""

# Range of focal lengths relative to the image width: from a field of view of almost 180 to a thousandth of a degree.
_FOCAL_RANGE = 1e-3, 1e5
_MAX_COEFFICIENT, _MIN_COEFFICIENT = 1e9, 1e-30


def check_inside(root: Path | None, path: Path, file_kind: str) -> Path:
    """Return ``path`` if it is inside the folder ``root`` after all links are resolved. None: no restriction.

    Raises `NergError` otherwise: an untrusted data set must not cause files outside of it to be read.
    """
    if root is not None and not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(root)):
        raise NergError(
            f'its {file_kind} "{sanitize(path)}" is outside of the data set\'s folder "{root}"; move it there, or '
            f"allow this with {parameter('allow_outside', True)}"
        )
    return path


def normalize_name(name: str) -> str:
    """Normalise a file name, so that spellings of different systems are equal: separators, Unicode composition
    and case.
    """
    return unicodedata.normalize("NFC", str(PurePosixPath(name.replace("\\", "/")))).casefold()


class FileFinder:
    """Finds files below ``folder`` by names that another system may have spelled differently.

    Names may use backslashes, another Unicode normal form, or another case. Files must be inside of ``root``; see
    `check_inside`.
    """

    def __init__(self, folder: Path, root: Path | None):
        self.folder, self.root = folder, root
        self._listed: dict[Path, dict[str, list[str]]] = {}

    def find(self, name: str, file_kind: str) -> Path:
        """Return the file ``name``; if it does not exist, the path as spelled.

        Raises `NergError` for a file outside of the root, for a device or a pipe, and if several files differ from
        ``name`` only by case.
        """
        path = check_inside(self.root, self.folder / name, file_kind)
        if is_regular_file(path, file_kind):
            return path
        slashes = name.replace("\\", "/")
        check_inside(self.root, self.folder / slashes, file_kind)
        match = self._match(PurePosixPath(slashes), file_kind)
        return path if match is None else check_inside(self.root, match, file_kind)

    def _match(self, name: PurePosixPath, file_kind: str) -> Path | None:
        path = self.folder
        for part in () if name.is_absolute() or ".." in name.parts else name.parts:
            if not (path / part).exists():
                names = self._list_names(path).get(normalize_name(part), [])
                if len(names) > 1:
                    raise NergError(
                        f'its {file_kind} "{sanitize(part)}" matches several files, {format_names(names)}; use the '
                        "exact spelling"
                    )
                if not names:
                    return None
                part = names[0]
            path = path / part
        return path if is_regular_file(path, file_kind) else None

    def _list_names(self, folder: Path) -> dict[str, list[str]]:
        if folder not in self._listed:
            names = self._listed[folder] = {}
            for entry in sorted(os.listdir(folder)) if folder.is_dir() else ():
                names.setdefault(normalize_name(entry), []).append(entry)
        return self._listed[folder]


def format_names(names: Iterable[object], max_names: int = 5) -> str:
    """Format the first ``max_names`` of ``names`` for a message, with the number of the others."""
    names = [sanitize(name, 80) for name in names]
    remainder = f" and {len(names) - max_names} more" if len(names) > max_names else ""
    return ", ".join(names[:max_names]) + remainder


@dataclass(frozen=True)
class DepthFile:
    """A depth file.

    Attributes
    ----------
    path
        The file.
    unit
        Scene units per unit of the file.
    along_axis
        Whether distances are along the viewing axis (z) rather than along the ray of each pixel.
    """

    path: Path
    unit: float = 1.0
    along_axis: bool = False


@dataclass(frozen=True)
class MaskFile:
    """A mask file. ``is_inverted``: white marks excluded pixels (dynamic masks of instant-ngp), not used ones
    (nerfstudio, COLMAP).
    """

    path: Path
    is_inverted: bool = False


@dataclass(frozen=True)
class PosedFrame:
    """One posed image.

    Attributes
    ----------
    name
        Path as the file spells it.
    image
        Path of the image.
    to_world
        OpenGL camera-to-world matrix (4, 4).
    lens
        Camera values by key, see `LENS_KEYS`.
    depth
        Depth file, or None.
    mask
        Mask file, or None.
    ignores_exif
        Whether pose and lens refer to the stored pixels, regardless of the EXIF orientation.
    points
        Surface points that a reconstruction matched in the image, or None.
    """

    name: str
    image: Path
    to_world: np.ndarray
    lens: dict
    depth: DepthFile | None = None
    mask: MaskFile | None = None
    ignores_exif: bool = False
    points: ObservedPoints | None = None

    def matches_shape(self, width: int, height: int) -> bool:
        """Return whether the camera has the aspect ratio of an image of ``width`` x ``height`` pixels, to one
        hundredth.
        """
        w, h = self.lens.get("w", width), self.lens.get("h", height)
        return w > 0 and h > 0 and abs(w * height - h * width) <= 0.01 * h * width

    def intrinsics(self, width: int, height: int) -> Intrinsics:
        """Return the intrinsics for the image of this frame, whose file has ``width`` x ``height`` pixels.

        Focal lengths in pixels (``fl_x``) take precedence over angles, which some writers round. Raises `NergError` if
        the file contains neither, or another aspect ratio than that of the image.
        """
        lens = self.lens
        w, h = lens.get("w", width), lens.get("h", height)
        if not self.matches_shape(width, height):
            remedy = 'correct width and height ("w" and "h"), or the image'
            if self.matches_shape(height, width):
                remedy = "rotate the pixels to the orientation of the camera"
            raise NergError(
                f'the image "{self.image}" has {width} x {height} pixels, but its camera has {w:g} x {h:g}; {remedy}'
            )
        fx, fy = lens.get("fl_x"), lens.get("fl_y")
        if fx is None and "camera_angle_x" in lens:
            fx = w / (2 * np.tan(lens["camera_angle_x"] / 2))
        if fy is None and "camera_angle_y" in lens:
            fy = h / (2 * np.tan(lens["camera_angle_y"] / 2))
        # A single focal length implies square pixels.
        fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
        if fx is None or fy is None or not all(_FOCAL_RANGE[0] * w <= f <= _FOCAL_RANGE[1] * w for f in (fx, fy)):
            raise NergError(
                f'frame "{sanitize(self.name)}" has no usable focal length; set "fl_x" in pixels or "camera_angle_x" '
                "in "
                "radians"
            )
        if not (abs(lens.get("cx", 0)) <= 100 * w and abs(lens.get("cy", 0)) <= 100 * h):
            raise NergError(
                f'the principal point ("cx", "cy") of frame "{sanitize(self.name)}" is too far from its image; '
                "correct it"
            )
        coefficients = {k: lens.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")}
        if not all(abs(x) <= _MAX_COEFFICIENT for x in coefficients.values()):
            raise NergError(
                f'the distortion of frame "{sanitize(self.name)}" has coefficients beyond {_MAX_COEFFICIENT:g}; '
                "correct them"
            )
        # Negligible coefficients are set to 0, because the search for the fold of the lens divides by them.
        coefficients = {k: x if abs(x) >= _MIN_COEFFICIENT else 0.0 for k, x in coefficients.items()}
        center = lens.get("cx", w / 2), lens.get("cy", h / 2)
        stated = Intrinsics(w, h, float(fx), float(fy), *center, **coefficients, fisheye=bool(lens.get("fisheye")))
        return stated.resized(width, height)


@dataclass(frozen=True)
class UnusedFrame:
    """A frame that is not used, with the reason."""

    name: str
    reason: str

    def __str__(self) -> str:
        return f'not used: "{sanitize(self.name)}": {sanitize(self.reason, 1000)}'


def describe_unused(unused: Iterable[UnusedFrame]) -> list[str]:
    """Describe unused frames in one line for each reason, with their number and first names.

    Reasons that differ only in quoted names, such as those of missing files, are the same; the first one is shown.
    """
    groups: dict[str, list[UnusedFrame]] = {}
    for frame in unused:
        groups.setdefault(re.sub(r'"[^"]*"', '""', frame.reason), []).append(frame)
    return [
        str(first)
        if not others
        else f"{len(others) + 1} frames are not used: {format_names(u.name for u in (first, *others))}; the first: "
        f"{sanitize(first.reason, 1000)}"
        for first, *others in groups.values()
    ]


AnyImages = TypeVar("AnyImages", bound="PosedImages")


@dataclass(frozen=True, repr=False, eq=False)
class PosedImages:
    """A posed image set, as its file describes it; frames are sorted by file name."""

    # The file.
    path: Path
    frames: list[PosedFrame]
    # Unusable frames.
    unused: list[UnusedFrame]
    # Corners (2, 3) of the scene box in the file, or None.
    aabb: np.ndarray | None
    # Digest of the file, for provenance.
    sha256: str
    # Sentences about frames that are used with missing data.
    notes: list[str] = field(default_factory=list)
    # Surface points (N, 3), or None.
    points: np.ndarray | None = None
    # Folder of the data set, and folders of its photos.
    root: Path = Path()
    image_folders: frozenset[Path] = frozenset()
    # Image files that the file lists, including those of unusable frames.
    image_files: frozenset[Path] = frozenset()
    # Names of the frames that the file holds out, or None.
    held_out: list[str] | None = None
    # Names of the frames that are neither in the training nor in the test list of the file.
    unassigned: list[str] = field(default_factory=list)
    # Similarity (4, 4) from these coordinates to those before the writer's applied_transform, or None.
    to_original: np.ndarray | None = None
    # Similarity (4, 4) from these coordinates to those of the file.
    to_file: np.ndarray = field(default_factory=lambda: np.eye(4))

    def transform(self: AnyImages, similarity: np.ndarray) -> AnyImages:
        """Transform to other coordinates by ``similarity`` (4, 4): a uniform scale, a rotation and a translation."""
        m = check_rigid_transforms(similarity, "the transform of coordinates", may_scale=True)
        scale = float(np.cbrt(np.linalg.det(m[:3, :3])))
        rotation = m[:3, :3] / scale
        back = np.linalg.inv(similarity)
        frames = []
        for f in self.frames:
            pose = np.eye(4)
            pose[:3, :3] = rotation @ f.to_world[:3, :3]
            pose[:3, 3] = similarity[:3, :3] @ f.to_world[:3, 3] + similarity[:3, 3]
            depth = None if f.depth is None else replace(f.depth, unit=f.depth.unit * scale)
            points = None if f.points is None else f.points.transform(similarity)
            frames.append(replace(f, to_world=pose, depth=depth, points=points))
        return replace(
            self,
            frames=frames,
            aabb=_transform_box(self.aabb, similarity),
            points=None if self.points is None else transform_points(similarity, self.points),
            to_original=None if self.to_original is None else self.to_original @ back,
            to_file=self.to_file @ back,
        )


def _transform_box(box: np.ndarray | None, m: np.ndarray) -> np.ndarray | None:
    """Return the bounding box of a transformed box."""
    if box is None:
        return None
    corners = np.array([[box[k][a] for a, k in enumerate(pick)] for pick in np.ndindex(2, 2, 2)])
    corners = transform_points(m, corners)
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def rigid_pose(matrix: object) -> np.ndarray:
    """Convert ``matrix`` to a rigid pose (4, 4) by removing scale and rounding errors. Raises `NergError` for an
    invalid pose.
    """
    # Some writers leave a scale in the rotation, or round it; use the nearest rotation.
    pose = check_rigid_transforms(matrix, "its pose", may_scale=True)
    if np.abs(pose).max() > MAX_POSITION:
        raise NergError(f"its pose has numbers beyond {MAX_POSITION:g}")
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = nearest_rotation(pose[:3, :3]), pose[:3, 3]
    return out


def sort_frames(
    path: Path, frames: list[PosedFrame], unused: list[UnusedFrame]
) -> tuple[list[PosedFrame], list[UnusedFrame]]:
    """Sort frames and unused frames by name, and keep one frame per image file.

    Raises `NergError` if no frame remains, and for cameras too far from the origin for single precision.
    """
    frames, repeated = drop_duplicates(sorted(frames, key=lambda f: f.name))
    unused = sorted(unused + repeated, key=lambda u: u.name)
    if not frames:
        raise _make_unusable_error(path, unused)
    check_near_origin(np.array([frame.to_world[:3, 3] for frame in frames]), f'the cameras of "{path}"')
    return frames, unused


def drop_duplicates(frames: list[PosedFrame]) -> tuple[list[PosedFrame], list[UnusedFrame]]:
    """Return ``frames`` with each image file once, and the duplicates."""
    first: dict[Path, PosedFrame] = {}
    unique, unused = [], []
    for frame in frames:
        key = resolve_path(frame.image)
        if key not in first:
            first[key] = frame
            unique.append(frame)
            continue
        same = np.allclose(first[key].to_world, frame.to_world, atol=1e-6)
        detail = "" if same else ", with a different pose; the first one is used"
        unused.append(UnusedFrame(frame.name, f"its image is listed twice{detail}"))
    return unique, unused


def _make_unusable_error(path: Path, unused: list[UnusedFrame]) -> NergError:
    """Make the error for a set without usable frames."""
    if not unused:
        return NergError(f'"{path}" lists no frames; specify the file of a posed image set')
    return NergError(
        f'none of the {len(unused)} frames of "{path}" can be used; the first, "{sanitize(unused[0].name)}": '
        f"{sanitize(unused[0].reason, 1000)}"
    )


# ---- Semi-dense points of Project Aria, in the world of the trajectory of a recording ----

MAX_INV_DIST_STD, MAX_DIST_STD = 0.005, 0.01
"""Maximum standard deviations of the inverse distance (1/m) and the distance (m) of used points, as in Aria's tools."""

_NUMBER_COLUMNS = ("px_world", "py_world", "pz_world", "inv_dist_std", "dist_std")
_WORLD_COLUMN = "graph_uid"
_BLOCK = 1 << 16  # lines per block
_MAX_WORLDS = 1000  # maximum number of worlds in a file


def read_semidense(
    path: str | os.PathLike,
    world: str | None = None,
    *,
    max_inv_dist_std: float = MAX_INV_DIST_STD,
    max_dist_std: float = MAX_DIST_STD,
) -> np.ndarray:
    """Read the points (N, 3) float32, in metres, of ``semidense_points.csv.gz`` (formerly ``global_points.csv.gz``).

    Parameters
    ----------
    path
        The file.
    world
        The graph_uid of the points. Default: the one with most points. The axes are those of the trajectory of this
        world, in MPS right-handed with z up, the frame of gaze samples.
    max_inv_dist_std
        Maximum standard deviation of the inverse distance in 1/m.
    max_dist_std
        Maximum standard deviation of the distance in m.

    Raises
    ------
    NergError
        For a file that is damaged, has other columns, or has no point of this precision.
    """
    points_by_world: dict[str, list[np.ndarray]] = defaultdict(list)
    with closing(read_line_blocks(path, "file of semi-dense points", _BLOCK)) as blocks:
        columns, count = None, 0
        for lines in blocks:
            if columns is None:
                columns, lines, count = _find_columns(path, lines[0]), lines[1:], 1
            numbered_lines = [(k, line) for k, line in enumerate(lines, count + 1) if not line.isspace()]
            count += len(lines)
            if not numbered_lines:
                continue
            values = _convert(path, numbered_lines, columns)
            is_precise = np.flatnonzero((values[:, 3] <= max_inv_dist_std) & (values[:, 4] <= max_dist_std))
            is_precise = is_precise[np.isfinite(values[is_precise, :3]).all(axis=1)]
            names = np.array(
                [numbered_lines[i][1].split(",")[columns[1]].strip() for i in is_precise.tolist()], dtype=object
            )
            for name in set(names.tolist()):
                points_by_world[name].append(values[is_precise[names == name], :3].astype(np.float32))
            if len(points_by_world) > _MAX_WORLDS:
                raise NergError(
                    f'"{path}" has more than {_MAX_WORLDS:,} worlds (graph_uid); re-run MPS on the recording'
                )
    if not points_by_world:
        raise NergError(
            f'"{path}" contains no point with deviations up to {max_inv_dist_std:g} 1/m and {max_dist_std:g} m; allow '
            "larger deviations"
        )
    if world is None:
        world = max(points_by_world, key=lambda name: (sum(map(len, points_by_world[name])), name))
    if world not in points_by_world:
        existing = ", ".join(sanitize(name, 40) for name in sorted(points_by_world)[:4])
        raise NergError(f'"{path}" has no point of the world "{sanitize(world, 40)}"; existing worlds: {existing}')
    return np.concatenate(points_by_world[world])


def _find_columns(path: str | os.PathLike, header: str) -> tuple[int, ...]:
    """Return the number of cells of a line, and the positions of the world and of the numbers."""
    names = [name.strip() for name in header.split(",")]
    missing = [name for name in (_WORLD_COLUMN, *_NUMBER_COLUMNS) if name not in names]
    if missing:
        existing = ", ".join(sanitize(name, 40) for name in names[:8])
        raise NergError(
            f'"{path}" has no column {", ".join(missing)}; its columns are {existing}; use semidense_points.csv.gz of '
            "an "
            "Aria recording"
        )
    return len(names), *(names.index(name) for name in (_WORLD_COLUMN, *_NUMBER_COLUMNS))


def _convert(path: str | os.PathLike, lines: Sequence[tuple[int, str]], columns: tuple[int, ...]) -> np.ndarray:
    """Convert numbered lines to numbers (n, 5). Raises `NergError` with the first line that lacks a number."""
    rows = []
    for number, line in lines:
        cells = line.split(",")
        if len(cells) != columns[0]:
            raise NergError(
                f'"{path}", line {number}: {len(cells)} cells, the header has {columns[0]}; copy the file again'
            )
        try:
            rows.append([parse_float(cells[i]) for i in columns[2:]])
        except ValueError:
            raise NergError(
                f'"{path}", line {number}: {sanitize(line, 60)!r} is not a point; copy the file again'
            ) from None
    return np.array(rows)
