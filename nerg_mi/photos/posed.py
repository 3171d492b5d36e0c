"""A posed image set as its file describes it, before a picture is opened, and the points that glasses saw of a
place."""

from __future__ import annotations

import os
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.safe_read import is_regular_file, read_line_blocks, resolve_path
from nerg_mi.maths.coordinates import check_near_origin

from .cameras import Intrinsics

# ---- A posed image set as its file describes it, before a picture is opened ----
#
# Poses are OpenGL camera-to-world matrices (x right, y up, z back) in the data set's own
# coordinates and units; readers do not re-centre, scale or turn them.

LENS_KEYS = tuple("w h fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6 camera_angle_x camera_angle_y fisheye".split())
"""Keys of `PosedFrame.lens`, all floats: pixels, radians, and coefficients as `Intrinsics` has them; "fisheye" is 1 for
fisheye lenses."""

MAX_POSITION = 1e12
"""Nothing may lie farther from the origin, in units: beyond, differences of positions are lost."""

# Focal lengths as shares of the picture's width: from a view of almost 180 degrees to one of a thousandth of a degree.
_FOCAL = 1e-3, 1e5
_BENT, _UNBENT = 1e9, 1e-30


def check_inside(root: Path | None, path: Path, file_kind: str) -> Path:
    """``path``, where it lies below the folder ``root`` once all links are followed (None: anywhere).

    Raises `NergError` otherwise: a data set of somebody else's must not make files be read that it does not hold.
    """
    if root is not None and not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(root)):
        raise NergError(
            f'its {file_kind} "{sanitize(path)}" lies outside of the data set\'s folder "{root}"; move it there, or allow this '
            "with --allow-outside"
        )
    return path


def normalize_name(name: str) -> str:
    """``name`` of a file, equal for all spellings of it by different systems: separators, composition and case."""
    return unicodedata.normalize("NFC", str(PurePosixPath(name.replace("\\", "/")))).casefold()


class FileFinder:
    """Finds files below ``folder`` by names that another system may have spelled otherwise: with backslashes, in
    another Unicode normal form, or in another case. ``root``: below which files must lie, see `inside`."""

    def __init__(self, folder: Path, root: Path | None):
        self.folder, self.root = folder, root
        self._listed: dict[Path, dict[str, list[str]]] = {}

    def find(self, name: str, file_kind: str) -> Path:
        """The file ``name``; as it is spelled, where there is none.

        Raises `NergError` for one outside of the root, for a device or a pipe, and where several files differ from
        ``name`` by case alone.
        """
        path = check_inside(self.root, self.folder / name, file_kind)
        if is_regular_file(path, file_kind):
            return path
        slashes = name.replace("\\", "/")
        check_inside(self.root, self.folder / slashes, file_kind)
        match = self._match(PurePosixPath(slashes), file_kind)
        return path if match is None else check_inside(self.root, match, file_kind)

    def _match(self, name: PurePosixPath, what: str) -> Path | None:
        path = self.folder
        for part in () if name.is_absolute() or ".." in name.parts else name.parts:
            if not (path / part).exists():
                names = self._names(path).get(normalize_name(part), [])
                if len(names) > 1:
                    raise NergError(
                        f'its {what} "{sanitize(part)}" may be each of {format_names(names)}; spell it as the file is'
                    )
                if not names:
                    return None
                part = names[0]
            path = path / part
        return path if is_regular_file(path, what) else None

    def _names(self, folder: Path) -> dict[str, list[str]]:
        if folder not in self._listed:
            names = self._listed[folder] = {}
            for entry in sorted(os.listdir(folder)) if folder.is_dir() else ():
                names.setdefault(normalize_name(entry), []).append(entry)
        return self._listed[folder]


def format_names(names: Iterable[object], max_names: int = 5) -> str:
    """The first ``most`` of ``names`` for a message, and how many more there are."""
    names = [sanitize(name, 80) for name in names]
    more = f" and {len(names) - max_names} more" if len(names) > max_names else ""
    return ", ".join(names[:max_names]) + more


@dataclass(frozen=True)
class DepthFile:
    """``unit``: scene units of one unit of the file; ``along_axis``: distances along the viewing axis (z) rather than
    along each pixel's ray."""

    path: Path
    unit: float = 1.0
    along_axis: bool = False


@dataclass(frozen=True)
class MaskFile:
    """``hides``: white marks what is left out (instant-ngp's dynamic masks), not what is used (nerfstudio, COLMAP)."""

    path: Path
    is_inverted: bool = False


@dataclass(frozen=True)
class PosedFrame:
    """One posed image. ``name``: its path as the file spells it; ``to_world``: (4, 4) OpenGL camera-to-world;
    ``lens``: its camera keys, see `LENS_KEYS`; ``ignores_exif``: both are of the pixels as they are stored, whatever
    the EXIF orientation."""

    name: str
    image: Path
    to_world: np.ndarray
    lens: dict
    depth: DepthFile | None = None
    mask: MaskFile | None = None
    ignores_exif: bool = False

    def matches_shape(self, width: int, height: int) -> bool:
        """Whether the camera is of an image of ``width`` x ``height`` pixels, or of its shape, to a hundredth."""
        w, h = self.lens.get("w", width), self.lens.get("h", height)
        return w > 0 and h > 0 and abs(w * height - h * width) <= 0.01 * h * width

    def intrinsics(self, width: int, height: int) -> Intrinsics:
        """Intrinsics for this frame's image, whose file has ``width`` x ``height`` pixels.

        Focal lengths in pixels (``fl_x``) are preferred to angles, which some writers round.
        Raises `NergError` when the file gives neither, or another shape than the image's.
        """
        lens = self.lens
        w, h = lens.get("w", width), lens.get("h", height)
        if not self.matches_shape(width, height):
            remedy = 'correct width and height ("w" and "h"), or the image'
            if self.matches_shape(height, width):
                remedy = "turn the pixels as the camera was held; other numbers would turn its rays"
            raise NergError(
                f'the image "{self.image}" has {width} x {height} pixels but its camera says {w:g} x {h:g}; {remedy}'
            )
        fx, fy = lens.get("fl_x"), lens.get("fl_y")
        if fx is None and "camera_angle_x" in lens:
            fx = w / (2 * np.tan(lens["camera_angle_x"] / 2))
        if fy is None and "camera_angle_y" in lens:
            fy = h / (2 * np.tan(lens["camera_angle_y"] / 2))
        # One focal length means square pixels.
        fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
        if fx is None or fy is None or not all(_FOCAL[0] * w <= f <= _FOCAL[1] * w for f in (fx, fy)):
            raise NergError(
                f'frame "{sanitize(self.name)}" has no usable focal length; give "fl_x" in pixels or "camera_angle_x" in '
                "radians"
            )
        if not (abs(lens.get("cx", 0)) <= 100 * w and abs(lens.get("cy", 0)) <= 100 * h):
            raise NergError(
                f'the principal point ("cx", "cy") of frame "{sanitize(self.name)}" is not near its picture; correct it'
            )
        bent = {k: lens.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")}
        if not all(abs(x) <= _BENT for x in bent.values()):
            raise NergError(
                f'the distortion of frame "{sanitize(self.name)}" has coefficients beyond {_BENT:g}; correct them'
            )
        # One that bends nothing would still be divided by where a lens is asked for its fold.
        bent = {k: x if abs(x) >= _UNBENT else 0.0 for k, x in bent.items()}
        center = lens.get("cx", w / 2), lens.get("cy", h / 2)
        stated = Intrinsics(w, h, float(fx), float(fy), *center, **bent, fisheye=bool(lens.get("fisheye")))
        return stated.resized(width, height)


@dataclass(frozen=True)
class UnusedFrame:
    """A frame that is left out, and why."""

    name: str
    reason: str

    def __str__(self) -> str:
        return f'left out "{sanitize(self.name)}": {sanitize(self.reason, 1000)}'


@dataclass(frozen=True)
class PosedImages:
    """What a file says about its frames, sorted by file name."""

    # The file.
    path: Path
    frames: list[PosedFrame]
    # Frames that cannot be used.
    unused: list[UnusedFrame]
    # (2, 3) corners of the scene box, from the file, or None.
    aabb: np.ndarray | None
    # Of the file, for provenance.
    sha256: str
    # Sentences about frames that are used with something missing.
    notes: list[str] = field(default_factory=list)
    # (N, 3) on surfaces, or None.
    points: np.ndarray | None = None
    # The data set's folder, and those of its photos.
    root: Path = Path()
    image_folders: frozenset[Path] = frozenset()
    # Image files that the file lists, whether or not their frames can be used.
    image_files: frozenset[Path] = frozenset()
    # Names of the frames that the file itself holds out, or None.
    held_out: list[str] | None = None
    # Names of the frames that it sets apart from both.
    unassigned: list[str] = field(default_factory=list)
    # (4, 4) similarity from these coordinates to those before the writer turned them (applied_transform), or None.
    to_original: np.ndarray | None = None
    # (4, 4) similarity from these coordinates to those of the file.
    to_file: np.ndarray = field(default_factory=lambda: np.eye(4))

    def transform(self, similarity: np.ndarray) -> PosedImages:
        """The same in other coordinates: ``similarity`` (4, 4), a uniform scale, a rotation and a translation."""
        scale, rotation = _parts(similarity)
        back = np.linalg.inv(similarity)
        frames = []
        for f in self.frames:
            pose = np.eye(4)
            pose[:3, :3] = rotation @ f.to_world[:3, :3]
            pose[:3, 3] = similarity[:3, :3] @ f.to_world[:3, 3] + similarity[:3, 3]
            depth = None if f.depth is None else replace(f.depth, unit=f.depth.unit * scale)
            frames.append(replace(f, to_world=pose, depth=depth))
        return replace(
            self,
            frames=frames,
            aabb=_moved_box(self.aabb, similarity),
            points=None if self.points is None else self.points @ similarity[:3, :3].T + similarity[:3, 3],
            to_original=None if self.to_original is None else self.to_original @ back,
            to_file=self.to_file @ back,
        )


def _parts(similarity: np.ndarray) -> tuple[float, np.ndarray]:
    """Scale and rotation of a similarity; `NergError` for anything else."""
    m = np.asarray(similarity, np.float64)
    scale = np.cbrt(np.linalg.det(m[:3, :3])) if m.shape == (4, 4) and np.all(np.isfinite(m)) else 0.0
    if not scale > 0 or not np.abs(m[:3, :3] @ m[:3, :3].T / scale**2 - np.eye(3)).max() <= 1e-3:
        raise NergError(
            "a change of coordinates must be a uniform scale, a rotation and a translation, without mirroring"
        )
    return float(scale), m[:3, :3] / scale


def _moved_box(box: np.ndarray | None, m: np.ndarray) -> np.ndarray | None:
    """The box around a moved box."""
    if box is None:
        return None
    corners = np.array([[box[k][a] for a, k in enumerate(pick)] for pick in np.ndindex(2, 2, 2)])
    corners = corners @ m[:3, :3].T + m[:3, 3]
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def rigid_pose(matrix: object) -> np.ndarray:
    """The (4, 4) pose that ``matrix`` means: a scale is taken out, and rounding. `NergError` for what is no pose."""
    try:
        pose = np.asarray(matrix, np.float64)
    except (TypeError, ValueError, OverflowError) as e:
        raise NergError("its pose must be a matrix of 4 x 4 numbers") from e
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
        raise NergError("its pose must be a matrix of 4 x 4 finite numbers")
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise NergError("the last row of its pose is not 0, 0, 0, 1 (is the matrix transposed?)")
    rotation = pose[:3, :3]
    if not np.abs(pose).max() <= MAX_POSITION:
        raise NergError(f"its pose has numbers beyond {MAX_POSITION:g}")
    scale = np.cbrt(np.linalg.det(rotation))
    if not scale > 0 or not np.abs(rotation @ rotation.T / scale**2 - np.eye(3)).max() <= 1e-2:
        raise NergError("its pose is not a rotation and a translation (mirrored, sheared or singular)")
    # Some writers leave a scale in the rotation, or round it: the nearest rotation is what they meant.
    u, _, vt = np.linalg.svd(rotation)
    pose = pose.copy()
    pose[:3, :3] = u @ vt
    return pose


def sort_frames(path: Path, frames: list[PosedFrame], unused: list[UnusedFrame]) -> tuple[list[PosedFrame], list[UnusedFrame]]:
    """Both in order of their names, each image file counting once. Raises `NergError` where no frame is left, and for
    cameras too far from the origin for single precision."""
    frames, repeated = drop_duplicates(sorted(frames, key=lambda f: f.name))
    unused = sorted(unused + repeated, key=lambda u: u.name)
    if not frames:
        raise _none_usable(path, unused)
    check_near_origin(np.array([frame.to_world[:3, 3] for frame in frames]), f'the cameras of "{path}"')
    return frames, unused


def drop_duplicates(frames: list[PosedFrame]) -> tuple[list[PosedFrame], list[UnusedFrame]]:
    """``frames`` with each image file once, and what was said about it again."""
    first: dict[Path, PosedFrame] = {}
    kept, unused = [], []
    for frame in frames:
        key = resolve_path(frame.image)
        if key not in first:
            first[key] = frame
            kept.append(frame)
            continue
        same = np.allclose(first[key].to_world, frame.to_world, atol=1e-6)
        more = "" if same else ", with another pose; the first counts"
        unused.append(UnusedFrame(frame.name, f"its image is listed twice{more}"))
    return kept, unused


def _none_usable(path: Path, unused: list[UnusedFrame]) -> NergError:
    """The error of a set without a single usable frame."""
    if not unused:
        return NergError(f'"{path}" lists no frames; name the file of a posed image set')
    return NergError(
        f'none of the {len(unused)} frames of "{path}" can be used; the first, "{sanitize(unused[0].name)}": '
        f"{sanitize(unused[0].reason, 1000)}"
    )


# ---- Semidense ----
#
# Semi-dense points of Project Aria: what the glasses saw of a place, in the world of the recording's trajectory.

MAX_INV_DIST_STD, MAX_DIST_STD = 0.005, 0.01
"""Points whose inverse distance (1/m) and distance (m) are known less well are left out, as in Aria's own tools."""

_NUMBERS = ("px_world", "py_world", "pz_world", "inv_dist_std", "dist_std")
_WORLD = "graph_uid"
_BLOCK = 1 << 16  # lines converted at a time
_WORLDS = 1000  # a file of more is none of points


def read_semidense(
    path: str | os.PathLike, world: str | None = None, *, max_inv_dist_std: float = MAX_INV_DIST_STD, max_dist_std: float = MAX_DIST_STD
) -> np.ndarray:
    """The points (N, 3) float32, metres, of ``semidense_points.csv.gz`` (older name ``global_points.csv.gz``) that are
    known to ``inv_dist_std`` (1/m) and ``dist_std`` (m).

    ``world``: the graph_uid whose points are taken; by default that of the most. The axes are those of the trajectory
    of that world, in MPS right-handed with z up: the frame of rays. Raises `NergError` for a file that is damaged, has
    other columns, or no point that is known so well.
    """
    found: dict[str, list[np.ndarray]] = defaultdict(list)
    with closing(read_line_blocks(path, "file of semi-dense points", _BLOCK)) as blocks:
        columns, count = None, 0
        for lines in blocks:
            if columns is None:
                columns, lines, count = _columns(path, lines[0]), lines[1:], 1
            kept = [(k, line) for k, line in enumerate(lines, count + 1) if not line.isspace()]
            count += len(lines)
            if not kept:
                continue
            values = _convert(path, kept, columns)
            well = np.flatnonzero((values[:, 3] <= max_inv_dist_std) & (values[:, 4] <= max_dist_std))
            well = well[np.isfinite(values[well, :3]).all(axis=1)]
            names = np.array([kept[i][1].split(",")[columns[1]].strip() for i in well.tolist()], dtype=object)
            for name in set(names.tolist()):
                found[name].append(values[well[names == name], :3].astype(np.float32))
            if len(found) > _WORLDS:
                raise NergError(f'"{path}" has more than {_WORLDS:,} worlds (graph_uid); have it made again by MPS')
    if not found:
        raise NergError(
            f'"{path}" holds no point that is known to {max_inv_dist_std:g} 1/m and {max_dist_std:g} m; allow larger deviations'
        )
    if world is None:
        world = max(found, key=lambda name: (sum(map(len, found[name])), name))
    if world not in found:
        named = ", ".join(sanitize(name, 40) for name in sorted(found)[:4])
        raise NergError(f'"{path}" has no point of the world "{sanitize(world, 40)}"; there are {named}')
    return np.concatenate(found[world])


def _columns(path: str | os.PathLike, header: str) -> tuple[int, ...]:
    """How many cells a line has, and where in it the world stands, and the numbers."""
    names = [name.strip() for name in header.lstrip("\ufeff").split(",")]
    missing = [name for name in (_WORLD, *_NUMBERS) if name not in names]
    if missing:
        there = ", ".join(sanitize(name, 40) for name in names[:8])
        raise NergError(
            f'"{path}" has no column {", ".join(missing)}; its columns are {there}; give semidense_points.csv.gz of an '
            "Aria recording"
        )
    return len(names), *(names.index(name) for name in (_WORLD, *_NUMBERS))


def _convert(path: str | os.PathLike, lines: Sequence[tuple[int, str]], columns: tuple[int, ...]) -> np.ndarray:
    """The numbers (n, 5) of numbered lines. Raises `NergError` naming the first line in which one is missing."""
    rows = []
    for number, line in lines:
        cells = line.split(",")
        if len(cells) != columns[0]:
            raise NergError(
                f'"{path}", line {number}: {len(cells)} cells, the header has {columns[0]}; copy the file again'
            )
        try:
            rows.append([float(cells[i]) for i in columns[2:]])
        except ValueError:
            raise NergError(f'"{path}", line {number}: {sanitize(line, 60)!r} is no point; copy the file again') from None
    return np.array(rows)
