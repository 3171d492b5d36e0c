"""COLMAP sparse models, estimation of the up direction, and camera poses by image name."""

from __future__ import annotations

import hashlib
import io
import itertools
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from nerg_mi.errors import MissingFile, NergError, format_error, sanitize
from nerg_mi.files.atomic import file_sha256
from nerg_mi.files.safe_read import (
    check_regular_file,
    find_other_content,
    is_regular_file,
    measure_byte_order_mark,
    open_file,
    resolve_path,
)
from nerg_mi.files.values import parse_float
from nerg_mi.maths.transforms import ROTATION_TOLERANCE

from .observed import MatchedImage, PointTable
from .posed import MAX_POSITION, FileFinder, MaskFile, PosedFrame, PosedImages, UnusedFrame, format_names, sort_frames
from .transforms import read_frame_poses

# ---- COLMAP sparse models: ``cameras``, ``images`` and ``points3D``, as ``.bin`` or ``.txt`` ----
#
# The layout is defined in src/colmap/scene/reconstruction_io of COLMAP: little-endian; world-to-camera poses as a
# quaternion (w, x, y, z) and a translation; cameras look along +z with y down; the first pixel's centre is (0.5, 0.5).

MAX_BYTES = 8 << 30
"""Maximum size of a file of a model in bytes: ``images.bin`` of about 30,000 photos, mostly observations."""

MAX_IMAGES = 1 << 18  # maximum number of images, and of cameras, of a model
MAX_POINTS = 12_000_000  # maximum number of points of a model

# Camera models by COLMAP's model number, with their numbers of parameters.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
# Parameters of the supported models in COLMAP's order; "f" sets both focal lengths.
_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fl_x fl_y cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fl_x fl_y cx cy k1 k2 k3 k4",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    # Equidistant: OPENCV_FISHEYE with coefficients of zero.
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fl_x fl_y cx cy",
}
_UNDISTORT = 'run "colmap image_undistorter" and train on its result'
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
# Points with fewer observations, or with a larger reprojection error in pixels, are not used as surface points.
_MIN_TRACK, _MAX_ERROR = 3, 4.0
# Maximum length of a line that is parsed; longer lines of observations are skipped.
_MAX_LINE = 1 << 20
# Characters of a line that are read at a time.
_READ_CHARACTERS = 1 << 26
# Bytes of a text file that contain the header comments, which state the number of records.
_HEADER_BYTES = 1 << 12
# Maximum size of an image name in bytes, including the terminating zero.
_MAX_NAME_BYTES = 1 << 12
# Points per chunk.
_BLOCK = 1 << 16
_NO_POINTS = np.zeros(0, np.int64)
# An observation in images.bin: position in the image, and number of its point, -1 for none.
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])


@dataclass(frozen=True)
class _Camera:
    """A record of ``cameras``.

    Attributes
    ----------
    model
        Name of the camera model.
    width, height
        Image size in pixels.
    parameters
        Parameters in COLMAP's order.
    """

    model: str
    width: int
    height: int
    parameters: tuple

    def to_lens(self) -> dict[str, float]:
        """Convert to the keys of `posed.LENS_KEYS`. Raises `NergError` for an unsupported model."""
        names = _PARAMETERS.get(self.model)
        if names is None:
            # COLMAP leaves panoramas as they are.
            remedy = "project the panoramas to perspective photos" if self.model == "EQUIRECTANGULAR" else _UNDISTORT
            raise NergError(
                f'its camera model "{sanitize(self.model, 40)}" is not supported; {remedy}, or use one of '
                f"{', '.join(_PARAMETERS)}"
            )
        names = names.split()
        if len(names) != len(self.parameters) or not np.all(np.isfinite(self.parameters)):
            raise NergError(f"its camera needs {len(names)} finite parameters for {self.model}, not {self.parameters}")
        lens = dict(zip(names, map(float, self.parameters)))
        if "f" in lens:
            lens["fl_x"] = lens["fl_y"] = lens.pop("f")
        if self.model.endswith("FISHEYE"):
            lens["fisheye"] = 1.0
        return {"w": float(self.width), "h": float(self.height), **lens}


@dataclass(frozen=True)
class _ImageRecord:
    """A record of ``images``: name, number of the camera, world-to-camera quaternion (w, x, y, z) and translation, and
    the numbers of its observed points.
    """

    name: str
    camera: int
    quaternion: tuple
    translation: tuple
    points: np.ndarray = field(default_factory=lambda: _NO_POINTS)
    # Name with spaces at its ends, which separate or align columns unless a file has this name.
    padded_name: str = ""


def find_model_files(folder: str | Path) -> dict[str, Path] | None:
    """Return the files "cameras", "images" and, if it exists, "points3D" of a model in ``folder``; None if there
    is no model.
    """
    folder = Path(folder)
    for suffix in (".bin", ".txt"):
        files = {name: folder / (name + suffix) for name in ("cameras", "images", "points3D")}
        files = {name: path for name, path in files.items() if is_regular_file(path, "COLMAP file")}
        if {"cameras", "images"} <= files.keys():
            return files
    return None


def read_colmap(
    folder: str | Path,
    images: str | Path,
    masks: str | Path | None = None,
    allow_outside: bool = False,
    root: Path | None = None,
) -> PosedImages:
    """Read the COLMAP model in ``folder``, in its own world coordinates.

    Parameters
    ----------
    folder
        Folder of the model.
    images
        Folder of the images, to which the image names are relative.
    masks
        Folder of the masks (``NAME.png``).
    allow_outside
        Whether images and masks outside of the data set may be used; links are resolved.
    root
        Folder of the data set. Default: the parent folder of ``images``.

    Returns
    -------
    PosedImages
        The frames. Frames that cannot be used are listed. A note reports a text file whose stated number of records
        differs from the actual one.

    Raises
    ------
    NergError
        For a file that cannot be parsed, with the file and the record, and if no frame can be used.
    """
    folder, images = Path(folder), Path(images)
    files = _require_model(folder)
    binary = files["cameras"].suffix == ".bin"
    cameras = (_read_cameras_bin if binary else _read_cameras_txt)(files["cameras"])
    records = (_read_images_bin if binary else _read_images_txt)(files["images"], with_points="points3D" in files)
    counts, points, table = {"cameras": len(cameras), "images": len(records)}, None, None
    if "points3D" in files:
        counts["points3D"], points, numbers = _select_surface_points(
            (_read_points_bin if binary else _read_points_txt)(files["points3D"])
        )
        table = PointTable(numbers, points, _iter_matches(records, cameras))
    frames, unused = [], []
    root = root or images.parent
    limit = None if allow_outside else root
    finder, mask_finder = FileFinder(images, limit), None if masks is None else FileFinder(Path(masks), limit)
    listed_images = set()
    for record in records:
        try:
            image = finder.find(record.padded_name or record.name, "image")
            image = image if image.is_file() else finder.find(record.name, "image")
            listed_images.add(image)
            frames.append(_make_frame(record, cameras.get(record.camera), image, mask_finder, table))
        except (ValueError, OverflowError, OSError) as e:
            # A name may be too long for the system, or contain invalid characters.
            unused.append(UnusedFrame(record.name, format_error(e)))
    frames, unused = sort_frames(files["images"], frames, unused)
    notes = [] if binary else [n for k, c in counts.items() for n in _check_stated_count(files[k], c)]
    digest = _compute_digest(files)
    folders = frozenset([images, *(p for p in images.rglob("*") if p.is_dir())])
    return PosedImages(
        files["images"], frames, unused, None, digest, notes, points, root, folders, frozenset(listed_images)
    )


def count_images(folder: Path) -> int:
    """Return the number of images of the model in ``folder``; for a binary file, the number in its header."""
    path = _require_model(folder)["images"]
    if path.suffix == ".txt":
        return len(_read_images_txt(path))
    with _open_model_file(path) as file:
        return int.from_bytes(file.read(8), "little")


def read_image_names(folder: Path) -> list[str]:
    """Return the names of the images of the model in ``folder``."""
    path = _require_model(folder)["images"]
    return [record.name for record in (_read_images_bin if path.suffix == ".bin" else _read_images_txt)(path)]


def read_image_poses(folder: str | Path) -> tuple[Path, str, list[tuple[str, np.ndarray]], list[str]]:
    """Read the poses of the model in ``folder``, whose images may be missing.

    Returns
    -------
    path
        The file of images.
    sha256
        Digest of the model, as in `PosedImages`.
    poses
        Name and OpenGL camera-to-world pose (4, 4) of each image.
    notes
        A note if a text file states another number of images.

    Raises
    ------
    NergError
        For a file that cannot be parsed, with the file and the record.
    """
    files = _require_model(Path(folder))
    path, poses = files["images"], []
    for record in (_read_images_bin if path.suffix == ".bin" else _read_images_txt)(path):
        try:
            poses.append((record.name, _make_pose(record)))
        except NergError as error:
            raise NergError(
                f'the pose of image "{sanitize(record.name)}" in the COLMAP file "{path}" is invalid ({error}); copy '
                "the COLMAP model again"
            ) from error
    notes = _check_stated_count(path, len(poses)) if path.suffix == ".txt" else []
    return path, _compute_digest(files), poses, notes


def _require_model(folder: Path) -> dict[str, Path]:
    files = find_model_files(folder)
    if files is None:
        raise MissingFile(f'"{folder}" contains no COLMAP model: neither cameras.bin and images.bin nor the .txt files')
    return files


@contextmanager
def _open_model_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file of a model. It is read in pieces, because observations may take gigabytes."""
    with open_file(path, "COLMAP file", max_bytes=MAX_BYTES) as file:
        yield file


def _compute_digest(files: dict[str, Path]) -> str:
    """Compute the digest of the files of cameras and images. Both are read completely, so call this after parsing
    them.
    """
    digests = (bytes.fromhex(file_sha256(files[name])) for name in ("cameras", "images"))
    return hashlib.sha256(b"".join(digests)).hexdigest()


def _iter_matches(records: list[_ImageRecord], cameras: dict[int, _Camera]) -> Iterator[MatchedImage]:
    """Iterate over the images that have a valid pose and lens; the others are reported as unused frames."""
    for record in records:
        try:
            center, lens = _make_pose(record)[:3, 3], cameras[record.camera].to_lens()
        except (NergError, KeyError):
            continue
        if lens["fl_x"] > 0:
            yield MatchedImage(center, lens["fl_x"], record.points)


def _make_frame(
    record: _ImageRecord, camera: _Camera | None, image: Path, masks: FileFinder | None, table: PointTable | None
) -> PosedFrame:
    name = record.name
    if camera is None:
        raise NergError(f"the model has no camera {record.camera}")
    if not image.is_file():
        raise NergError(f'its image "{sanitize(image)}" does not exist')
    lens, mask = camera.to_lens(), None
    if masks is not None:
        # COLMAP appends the suffix; other programs replace it.
        paths = [masks.find(n, "mask") for n in (f"{name}.png", str(Path(name).with_suffix(".png")))]
        existing = [p for p in paths if p.is_file()]
        if not existing:
            raise NergError(f'its mask "{sanitize(paths[0])}" does not exist')
        mask = MaskFile(existing[0])
    try:
        pose = _make_pose(record)
    except NergError as error:
        raise NergError(f"its pose is {error}") from error
    points = None if table is None else table.select(record.points)
    return PosedFrame(name, image, pose, lens, mask=mask, ignores_exif=True, points=points)


def _make_pose(record: _ImageRecord) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    q, t = record.quaternion, record.translation
    length = float(np.linalg.norm(q))
    if not (np.isfinite(length) and np.abs(t).max() <= MAX_POSITION):
        raise NergError("not finite")
    if not abs(length - 1) <= ROTATION_TOLERANCE:
        raise NergError(f"no rotation: the length of its quaternion is {length:.4g} instead of 1")
    back = Rotation.from_quat(np.roll(np.asarray(q, np.float64), -1)).as_matrix().T
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = back, -back @ np.asarray(t, np.float64)
    return out @ _FLIP


_Point = tuple[float, float, float, float, int, int]
"""Position (x, y, z), reprojection error, track length and number of a point."""


class _RecordReader:
    """Reader of little-endian records. A truncated file raises an error with the position."""

    def __init__(self, path: Path, file: BinaryIO):
        self.path, self.file, self.offset, self.size = path, file, 0, check_regular_file(path, "COLMAP file")

    def read_count(self, limit: int, records: str) -> int:
        """Read the number of records at the start of the file."""
        count = self.read_values("Q", "its header")[0]
        _check_count(self.path, count, limit, records)
        return count

    def read_values(self, form: str, record: str) -> tuple:
        size = struct.calcsize("<" + form)
        self.check_remaining(size, record)
        self.offset += size
        return struct.unpack("<" + form, self.file.read(size))

    def check_remaining(self, size: int, record: str) -> None:
        if self.offset + size > self.size:
            raise NergError(f'"{self.path}" ends within {record} (byte {self.offset} of {self.size}); copy it again')

    def read_array(self, dtype: np.dtype, count: int, record: str) -> np.ndarray:
        size = dtype.itemsize * count
        self.check_remaining(size, record)
        self.offset += size
        return np.frombuffer(self.file.read(size), dtype)

    def skip(self, size: int, record: str) -> None:
        self.check_remaining(size, record)
        self.offset += size
        self.file.seek(self.offset)

    def check_end(self, count: int) -> None:
        """Raise `NergError` if data follows the ``count`` records of the header."""
        if self.offset < self.size:
            raise NergError(
                f'"{self.path}" has {self.size - self.offset:,} bytes after the {count:,} records that its header '
                "states; copy it again"
            )

    def read_name(self, record: str) -> str:
        raw = self.file.read(_MAX_NAME_BYTES)
        end = raw.find(b"\0")
        if end < 0 and len(raw) == _MAX_NAME_BYTES:
            raise NergError(
                f'the name of {record} of "{self.path}" has more than {_MAX_NAME_BYTES - 1:,} bytes; copy it again'
            )
        if end < 0:
            raise NergError(f'"{self.path}" ends within the name of {record}; copy it again')
        self.skip(end + 1, record)
        return raw[:end].decode("utf-8", errors="surrogateescape")


def _check_count(path: Path, count: int, limit: int, records: str) -> None:
    if count > limit:
        raise NergError(f'"{path}" has {count:,} {records}, the limit is {limit:,}; use a smaller model')


def _add_camera(cameras: dict[int, _Camera], number: int, camera: _Camera, path: Path) -> None:
    """Add a camera. Raises `NergError` if there is another one with its number, as in two models that were joined."""
    if cameras.setdefault(number, camera) != camera:
        raise NergError(
            f'"{path}" has two cameras with the number {number} and different lenses; join models with '
            '"colmap model_merger", which renumbers them'
        )


def _read_cameras_bin(path: Path) -> dict[int, _Camera]:
    out = {}
    with _open_model_file(path) as file:
        r = _RecordReader(path, file)
        for k in range(r.read_count(MAX_IMAGES, "cameras")):
            number, model, width, height = r.read_values("iiQQ", f"camera record {k + 1}")
            if model not in _MODELS:
                raise NergError(
                    f'camera {number} of "{path}" has the unknown model number {model}, so the rest of the file '
                    f"cannot be read; {_UNDISTORT}"
                )
            name, count = _MODELS[model]
            parameters = r.read_values(f"{count}d", f"camera record {k + 1}")
            _add_camera(out, number, _Camera(name, width, height, parameters), path)
        r.check_end(len(out))
    return out


def _read_images_bin(path: Path, with_points: bool = False) -> list[_ImageRecord]:
    out = []
    with _open_model_file(path) as file:
        r = _RecordReader(path, file)
        for k in range(r.read_count(MAX_IMAGES, "images")):
            record = f"image record {k + 1}"
            values = r.read_values("i7di", record)
            name = r.read_name(record)
            count, points = r.read_values("Q", record)[0], _NO_POINTS
            if with_points:
                points = _read_observed_points(r, count, record)
            else:
                r.skip(_OBSERVATION.itemsize * count, record)
            out.append(_ImageRecord(name, values[8], values[1:5], values[5:8], points))
        r.check_end(len(out))
    return out


def _read_observed_points(r: _RecordReader, count: int, record: str) -> np.ndarray:
    """Read the numbers of the points of ``count`` observations, most of which usually have none."""
    points = [_NO_POINTS]
    while count > 0:
        block = r.read_array(_OBSERVATION, min(count, _BLOCK), record)["point"]
        points.append(np.unique(block[block >= 0]))
        count -= len(block)
    return np.concatenate(points)


def _read_points_bin(path: Path) -> Iterator[_Point]:
    with _open_model_file(path) as file:
        r = _RecordReader(path, file)
        count = r.read_count(MAX_POINTS, "points")
        for k in range(count):
            record = f"point record {k + 1}"
            values = r.read_values("Q3d3BdQ", record)
            r.skip(8 * values[8], record)
            yield *values[1:4], values[7], values[8], values[0]
        r.check_end(count)


def _iter_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Iterate over line numbers and lines, without comments."""
    with _open_model_file(path) as file:
        file.seek(measure_byte_order_mark(file.read(4), path, "COLMAP file"))
        # Image names may have any encoding.
        text = io.TextIOWrapper(file, encoding="utf-8", errors="surrogateescape")
        # A file without line ends must not be read as one line of gigabytes.
        for number, line in enumerate(iter(lambda: text.readline(_READ_CHARACTERS), ""), 1):
            if not line.startswith("#"):
                yield number, line.rstrip("\n")


def _iter_rows(path: Path, limit: int, records: str) -> Iterator[tuple[int, list[str]]]:
    """Iterate over the numbers and words of non-empty lines, of which there may be at most ``limit``."""
    count = 0
    for number, line in _iter_lines(path):
        if len(line) > _MAX_LINE:
            raise NergError(
                f'line {number} of "{path}" has {len(line):,} characters; the limit is {_MAX_LINE:,}; '
                "is it a COLMAP file?"
            )
        if line.strip():
            count += 1
            _check_count(path, count, limit, records)
            yield number, line.split()


def _check_stated_count(path: Path, count: int) -> list[str]:
    """Return a note if the header of a text file states another number than the ``count`` of its records."""
    with _open_model_file(path) as file:
        stated = re.search(rb"^#\s*Number of [a-z]+: *(\d+)", file.read(_HEADER_BYTES), re.MULTILINE)
    if stated is None or int(stated[1]) == count:
        return []
    return [
        f'"{path}" has {count:,} records, but its header states {int(stated[1]):,}; copy it again if it was truncated'
    ]


def _bad_line(path: Path, number: int, words: list[str], expected: str) -> NergError:
    line = sanitize(" ".join(words), 80)
    return NergError(
        f'line {number} of "{path}" is "{line}" instead of "{expected}", with decimal points; export the model again'
    )


def _read_cameras_txt(path: Path) -> dict[int, _Camera]:
    out = {}
    for number, words in _iter_rows(path, MAX_IMAGES, "cameras"):
        try:
            index = int(words[0])
            camera = _Camera(words[1], int(words[2]), int(words[3]), tuple(map(parse_float, words[4:])))
        except (ValueError, IndexError) as e:
            raise _bad_line(path, number, words, "CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS") from e
        _add_camera(out, index, camera, path)
    return out


def _read_images_txt(path: Path, with_points: bool = False) -> list[_ImageRecord]:
    out, follows_image = [], False
    for number, line in _iter_lines(path):
        words = line[:_MAX_LINE].split()
        # The line after an image lists its observations. It may be empty, and some writers omit it.
        if not words or (follows_image and (len(line) > _MAX_LINE or _are_observations(words))):
            if with_points and follows_image and words:
                out[-1] = replace(out[-1], points=_parse_points(path, number, line))
            follows_image = False
            continue
        try:
            q, t = tuple(map(parse_float, words[1:5])), tuple(map(parse_float, words[5:8]))
            if len(q) != 4 or len(t) != 3 or not words[9:]:
                raise ValueError
            # Names may contain several spaces, and tabs.
            padded_name = re.split(r"\s+", line.lstrip(), maxsplit=8)[8][len(words[8]) + 1 :]
            out.append(_ImageRecord(padded_name.strip(), int(words[8]), q, t, padded_name=padded_name))
        except (ValueError, IndexError) as e:
            raise _bad_line(path, number, words, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME") from e
        _check_count(path, len(out), MAX_IMAGES, "images")
        follows_image = True
    return out


def _parse_points(path: Path, number: int, line: str) -> np.ndarray:
    """Return the numbers of the points in a line of observations; -1 for none."""
    try:
        return np.array(line.split()[2::3], np.int64)
    except (ValueError, OverflowError) as e:
        raise NergError(f'line {number} of "{path}" is not a list of "X Y POINT3D_ID"') from e


def _are_observations(words: list[str]) -> bool:
    """Return whether ``words`` are triples of X, Y and POINT3D_ID. The line of an image ends with its name instead."""
    try:
        return len(words) % 3 == 0 and int(words[-1]) >= -1
    except ValueError:
        return False


def _read_points_txt(path: Path) -> Iterator[_Point]:
    for number, words in _iter_rows(path, MAX_POINTS, "points"):
        try:
            position = parse_float(words[1]), parse_float(words[2]), parse_float(words[3])
            yield *position, parse_float(words[7]), (len(words) - 8) // 2, int(words[0])
        except (ValueError, IndexError) as e:
            raise NergError(f'line {number} of "{path}" is not "POINT3D_ID X Y Z R G B ERROR TRACK"') from e


def _select_surface_points(points: Iterator[_Point]) -> tuple[int, np.ndarray, np.ndarray]:
    """Return the number of ``points``, and the positions (N, 3) and numbers (N,) of the reliable ones."""
    count, selected, numbers = 0, [np.empty((0, 3))], [np.zeros(0, np.int64)]
    while block := list(itertools.islice(points, _BLOCK)):
        table = np.array([point[:5] for point in block], np.float64)
        is_reliable = (
            np.all(np.abs(table) <= MAX_POSITION, axis=1) & (table[:, 3] <= _MAX_ERROR) & (table[:, 4] >= _MIN_TRACK)
        )
        selected.append(table[is_reliable, :3])
        # 64 bits, which float64 does not hold. As in the observations, the largest number becomes -1, for none.
        numbers.append(np.array([point[5] % 2**64 for point in block], np.uint64).view(np.int64)[is_reliable])
        count += len(block)
    return count, np.concatenate(selected), np.concatenate(numbers)


# ---- Poses by image name; the images may be missing ----

_MODEL_FOLDERS = ("", "sparse", "colmap/sparse")


@dataclass(frozen=True, eq=False)
class NamedPoses:
    """The N images of a posed image set, in its own coordinates."""

    path: Path  # the file that lists the images
    sha256: str  # digest of the set, which is also in the provenance of fields that are trained on it
    names: list[str]
    to_world: np.ndarray  # (N, 4, 4) rigid OpenGL camera-to-world: x right, y up, z back
    notes: list[str]  # notes on contradictions within a COLMAP model, and on models that are not used


_ESTIMATE = ', estimate the poses of photos or a video with "nerg poses" (find_poses)'


def find_pose_source(dataset: str | Path) -> Path:
    """Return the transforms file of ``dataset``, or the folder of its COLMAP model; of several models, the one with
    most images.

    ``dataset``: a folder, or the file itself.
    """
    dataset = Path(dataset)
    if not dataset.exists():
        raise MissingFile(f'there is no posed image set "{dataset}"; correct its name')
    if not dataset.is_dir():
        check_regular_file(dataset, "posed image set")
        if dataset.suffix.lower() not in (".bin", ".txt", ".json"):
            reason = find_other_content(dataset) or "is no posed image set"
            raise NergError(f'"{dataset}" {reason}; specify a folder, a transforms file or a COLMAP model{_ESTIMATE}')
        # A file of a COLMAP model selects the model.
        return dataset.parent if dataset.suffix in (".bin", ".txt") else dataset
    for name in ("transforms.json", "transforms_train.json"):
        if is_regular_file(dataset / name, "transforms file"):
            return dataset / name
    for name in _MODEL_FOLDERS:
        models = _list_models(dataset / name)
        if models:
            return models[0] if len(models) == 1 else max(models, key=count_images)
    raise MissingFile(
        f'"{dataset}" contains neither transforms.json nor transforms_train.json nor a COLMAP model '
        f"(sparse/0/cameras.bin); specify the folder of a posed image set{_ESTIMATE}, or convert an export of "
        'Polycam, Record3D, Metashape or RealityCapture with "ns-process-data" of nerfstudio'
    )


def _list_models(folder: Path) -> list[Path]:
    """List the models of one reconstruction: in the numbered subfolders of ``folder``, and in ``folder`` itself."""
    numbered = sorted((p for p in folder.glob("*") if p.name.isdecimal()), key=lambda p: int(p.name))
    return [p for p in (*numbered, folder) if find_model_files(p) is not None]


def describe_other_models(model: Path) -> list[str]:
    """Return a note on the other models of the reconstruction that contains the COLMAP ``model``."""
    models = _list_models(model.parent if model.name.isdecimal() else model)
    other_models = [p for p in models if resolve_path(p) != resolve_path(model)]
    if not other_models:
        return []
    describe = lambda p: f'"{p.name}" ({count_images(p):,} images)'
    return [
        f"of {len(models)} COLMAP models, {describe(model)} is used, but not "
        f"{format_names(describe(p) for p in other_models)}"
    ]


def read_named_poses(source: str | Path) -> NamedPoses:
    """Read the poses of a transforms file, or of the folder of a COLMAP model; `find_pose_source` finds either.

    Raises `NergError` for a file that cannot be parsed, and for a file without images.
    """
    source = Path(source)
    if source.is_dir() and find_model_files(source) is not None:
        path, sha256, frames, notes = read_image_poses(source)
        notes += describe_other_models(source)
    else:
        path, (sha256, frames), notes = source, read_frame_poses(source), []
    if not frames:
        raise NergError(f'"{path}" lists no images; specify the file of a posed image set')
    return NamedPoses(path, sha256, [name for name, _ in frames], np.stack([pose for _, pose in frames]), notes)


# ---- Estimation of the up direction ----
#
# Photographers hold cameras level: the horizontal axes of the images are in one plane, whose normal is the vertical, no
# matter how far the cameras look down. Most environments also have a floor or a table: a plane of many points below the
# cameras. Its normal is a much more precise estimate of the vertical.


# Weight of the mean up axis of the images, which decides if the horizontal axes leave the vertical undetermined.
_TOP_WEIGHT = 0.005
# Sine of the roll angle above which the fit is an L1 fit.
_ROLL_SCALE = 0.02
# Number of random point triples of the plane search, and the maximum angle between the normal and the cameras' up.
_NUM_TRIPLES, _MIN_COSINE = 20_000, np.cos(np.radians(20.0))
# Thickness of a plane relative to the median distance of the points from their median, and the minimum fraction of the
# points on it.
_PLANE_THICKNESS, _MIN_PLANE_FRACTION = 0.02, 0.10
_MAX_PLANE_POINTS = 4000
# Maximum median roll in degrees of a reliable estimate from the cameras.
_MAX_ROLL = 10.0


@dataclass(frozen=True)
class UpEstimate:
    """Estimate of the up direction.

    Attributes
    ----------
    direction
        Unit vector (3,).
    median_roll
        Median angle in degrees between the horizontal axes of the images and the horizon.
    plane_fraction
        Fraction of the points on a level plane; None without a plane.
    plane_angle
        Angle in degrees between the normal of the plane and the estimate from the cameras.
    """

    direction: np.ndarray
    median_roll: float
    plane_fraction: float | None = None
    plane_angle: float | None = None

    @property
    def is_reliable(self) -> bool:
        """Whether the cameras agree."""
        return self.median_roll <= _MAX_ROLL

    def __str__(self) -> str:
        cameras = f"the cameras are held level to {self.median_roll:.1f} degrees (median)"
        if self.plane_fraction is None:
            return f"{cameras}; the points contain no level plane"
        return (
            f"{cameras}, and a plane of {self.plane_fraction:.0%} of the points is {self.plane_angle:.1f} degrees from "
            "the up direction of the cameras"
        )


def estimate_up(to_world: np.ndarray, points: np.ndarray) -> UpEstimate:
    """Estimate the up direction from OpenGL camera-to-world poses (N, 4, 4) and surface ``points`` (M, 3)."""
    rights, tops, centers = to_world[:, :3, 0], to_world[:, :3, 1], to_world[:, :3, 3]
    camera_up = _estimate_camera_up(rights, tops)
    roll = float(np.degrees(np.median(np.arcsin(np.clip(np.abs(rights @ camera_up), 0, 1)))))
    plane = _fit_level_plane(points, centers, camera_up) if len(points) >= 100 else None
    if plane is None:
        return UpEstimate(camera_up, roll)
    normal, fraction = plane
    angle = float(np.degrees(np.arccos(np.clip(normal @ camera_up, -1, 1))))
    return UpEstimate(normal, roll, fraction, angle)


def rotation_to_z(up: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (3, 3) that maps the unit vector ``up`` to +z."""
    from scipy.spatial.transform import Rotation

    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, up[2])).as_matrix()


def _estimate_camera_up(rights: np.ndarray, tops: np.ndarray) -> np.ndarray:
    """Estimate the direction that is perpendicular to most horizontal axes, on the side of the tops of the images."""
    mean = tops[0] * 0.0
    weights = np.ones(len(tops))
    for _ in range(20):
        mean = weights @ tops
        mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
        weights = 1 / np.maximum(np.linalg.norm(tops - mean, axis=1), _ROLL_SCALE)
    up = mean
    for _ in range(20):
        weights = 1 / np.maximum(np.abs(rights @ up), _ROLL_SCALE)
        spread = (rights * weights[:, None]).T @ rights / weights.sum()
        vectors = np.linalg.eigh(spread + _TOP_WEIGHT * (np.eye(3) - np.outer(mean, mean)))[1]
        up = vectors[:, 0] if vectors[:, 0] @ mean >= 0 else -vectors[:, 0]
    return up


def _fit_level_plane(points: np.ndarray, centers: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Fit the level plane below the cameras with most points. Returns its normal and the fraction of the points
    on it, or None.
    """
    rng = np.random.default_rng(0)
    points = points if len(points) <= _MAX_PLANE_POINTS else rng.choice(points, _MAX_PLANE_POINTS, replace=False)
    center = np.median(points, axis=0)
    thickness = _PLANE_THICKNESS * float(np.median(np.linalg.norm(points - center, axis=1)))
    a, b, c = points[rng.integers(0, len(points), (3, _NUM_TRIPLES))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(length, 1e-300)[:, None]
    normals *= np.where(normals @ up < 0, -1.0, 1.0)[:, None]
    level = (length > 0) & (normals @ up > _MIN_COSINE)
    best: tuple[int, np.ndarray, float] | None = None
    for normal, offset in zip(normals[level], np.sum(normals * a, axis=1)[level]):
        if np.mean(centers @ normal > offset) < 0.9:
            continue
        count = int(np.count_nonzero(np.abs(points @ normal - offset) < thickness))
        if best is None or count > best[0]:
            best = count, normal, offset
    if best is None or best[0] < _MIN_PLANE_FRACTION * len(points):
        return None
    _, normal, offset = best
    for _ in range(3):
        inliers = points[np.abs(points @ normal - offset) < thickness]
        _, spread, axes = np.linalg.svd(inliers - inliers.mean(axis=0), full_matrices=False)
        if spread[1] < 0.2 * spread[0]:
            return None  # points on a line, which many planes contain
        normal = axes[2] if axes[2] @ up > 0 else -axes[2]
        offset = float(inliers.mean(axis=0) @ normal)
    if normal @ up < _MIN_COSINE:
        return None
    return normal, float(np.mean(np.abs(points @ normal - offset) < thickness))
