"""COLMAP's sparse models, which way is up in them, and the poses of a set by the names of its images."""

from __future__ import annotations

import hashlib
import io
import itertools
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from nerg_mi.errors import MissingFile, NergError, sanitize, format_error
from nerg_mi.files.atomic import file_sha256
from nerg_mi.files.safe_read import is_regular_file, open_file, resolve_path, check_regular_file

from .posed import MAX_POSITION, FileFinder, MaskFile, PosedFrame, PosedImages, UnusedFrame, format_names, sort_frames
from .transforms import read_frame_poses

# ---- Colmap ----
#
# COLMAP's sparse models: ``cameras``, ``images`` and ``points3D``, as ``.bin`` or as ``.txt``.
#
# The layout of both is COLMAP's (src/colmap/scene/reconstruction_io): little-endian; world-to-camera poses as a
# quaternion (w, x, y, z) and a translation; cameras look along +z with y down; the first pixel's centre is (0.5, 0.5).

MAX_BYTES = 8 << 30
"""A file of a model may have so many bytes: ``images.bin`` of some 30,000 photos, most of it observations."""

MAX_IMAGES = 1 << 18  # a model may have so many images, and as many cameras
MAX_POINTS = 12_000_000  # and so many points

# COLMAP's numbers of its camera models, and how many parameters each has.
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
}
# Their parameters in COLMAP's order, as far as the mapping is known here; "f" is both focal lengths.
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
}
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
# Points that fewer images hold, or that project worse than so many pixels, are no evidence of a surface.
_MIN_TRACK, _MAX_ERROR = 3, 4.0
# Characters of a line that is split into words; those of observations, which are longer, are skipped.
_LONGEST = 1 << 20
# Characters of a line that are read at once.
_PIECE = 1 << 26
# Bytes of a text file in which its comments state how many records it has.
_HEADER = 1 << 12
# Bytes of the name of an image, with the zero after it.
_NAME = 1 << 12
# Points that are judged at once.
_BLOCK = 1 << 16


@dataclass(frozen=True)
class _Camera:
    """A record of ``cameras``: the ``model``'s name, the size of its pictures in pixels, and the model's parameters in
    COLMAP's order."""

    model: str
    width: int
    height: int
    parameters: tuple

    def lens(self) -> dict[str, float]:
        """The same by the keys of `posed.LENS_KEYS`; `NergError` for a model that no lens here is."""
        names = _PARAMETERS.get(self.model)
        if names is None:
            raise NergError(
                f'its camera model "{self.model}" is not supported; run "colmap image_undistorter" and train on '
                f"its result, or use one of {', '.join(_PARAMETERS)}"
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


def find_model_files(folder: str | Path) -> dict[str, Path] | None:
    """The files "cameras", "images" and, where it exists, "points3D" of a model in ``folder``; None if there is
    none."""
    folder = Path(folder)
    for suffix in (".bin", ".txt"):
        files = {name: folder / (name + suffix) for name in ("cameras", "images", "points3D")}
        files = {name: path for name, path in files.items() if is_regular_file(path, "COLMAP file")}
        if {"cameras", "images"} <= files.keys():
            return files
    return None


def read_colmap(
    folder: str | Path, images: str | Path, masks: str | Path | None = None, allow_outside: bool = False
) -> PosedImages:
    """Read the model in ``folder``; its image names are relative to ``images``, its masks' to ``masks`` (``NAME.png``).

    Images and masks that lie outside of the capture, the folder that holds ``images``, links followed, are not used
    unless ``allow_outside``. In COLMAP's own world. Frames that cannot be used are listed; a text file that states
    another number of records than it has is noted. `NergError` names file and record for what cannot be parsed, and
    when no frame can be used.
    """
    folder, images = Path(folder), Path(images)
    files = _require_model(folder)
    binary = files["cameras"].suffix == ".bin"
    cameras = (_cameras_bin if binary else _cameras_txt)(files["cameras"])
    poses = (_images_bin if binary else _images_txt)(files["images"])
    frames, unused = [], []
    limit = None if allow_outside else images.parent
    finder, mask_finder = FileFinder(images, limit), None if masks is None else FileFinder(Path(masks), limit)
    listed = set()
    for name, camera, q, t in poses:
        try:
            image = finder.find(name, "image")
            listed.add(image)
            frames.append(_frame(name, cameras.get(camera), camera, q, t, image, mask_finder))
        except (ValueError, OverflowError, OSError) as e:
            # A name may be longer than the system allows, or hold what no name can.
            unused.append(UnusedFrame(name, format_error(e)))
    frames, unused = sort_frames(files["images"], frames, unused)
    counts, points = {"cameras": len(cameras), "images": len(poses)}, None
    if "points3D" in files:
        counts["points3D"], points = _trusted((_points_bin if binary else _points_txt)(files["points3D"]))
    notes = [] if binary else [n for k, c in counts.items() for n in _count_notes(files[k], c)]
    digest = _digest(files)
    folders = frozenset([images, *(p for p in images.rglob("*") if p.is_dir())])
    return PosedImages(
        files["images"], frames, unused, None, digest, notes, points, images.parent, folders, frozenset(listed)
    )


def count_images(folder: Path) -> int:
    """Number of images of the model in ``folder``, as a binary file states it."""
    path = _require_model(folder)["images"]
    if path.suffix == ".txt":
        return len(_images_txt(path))
    with _open(path) as file:
        return int.from_bytes(file.read(8), "little")


def read_image_poses(folder: str | Path) -> tuple[Path, str, list[tuple[str, np.ndarray]], list[str]]:
    """Of the model in ``folder``, whose images need not be there: its file of images, the model's SHA-256 as
    `PosedImages` has it, of each image its name and its OpenGL camera-to-world pose (4, 4), and a sentence where a text
    file states another number of images.

    `NergError` names file and record for what cannot be parsed.
    """
    files = _require_model(Path(folder))
    path, found = files["images"], []
    for name, _, q, t in (_images_bin if path.suffix == ".bin" else _images_txt)(path):
        try:
            found.append((name, _to_world(q, t)))
        except NergError as error:
            raise NergError(f'image "{sanitize(name)}" of "{path}": {error}; copy the model again') from error
    notes = _count_notes(path, len(found)) if path.suffix == ".txt" else []
    return path, _digest(files), found, notes


def _require_model(folder: Path) -> dict[str, Path]:
    files = find_model_files(folder)
    if files is None:
        raise MissingFile(f'"{folder}" holds no COLMAP model: neither cameras.bin and images.bin nor their .txt')
    return files


@contextmanager
def _open(path: Path) -> Iterator[BinaryIO]:
    """A file of a model; what it holds is read in pieces, since observations may be gigabytes."""
    with open_file(path, "COLMAP file", max_bytes=MAX_BYTES) as file:
        yield file


def _digest(files: dict[str, Path]) -> str:
    """Of the files of cameras and images. Both are read to their ends: to be computed after they were parsed."""
    digests = (bytes.fromhex(file_sha256(files[name])) for name in ("cameras", "images"))
    return hashlib.sha256(b"".join(digests)).hexdigest()


def _frame(name: str, camera: _Camera | None, number: int, q, t, image: Path, masks: FileFinder | None) -> PosedFrame:
    if camera is None:
        raise NergError(f"the model has no camera {number}")
    if not image.is_file():
        raise NergError(f'its image "{sanitize(image)}" does not exist')
    lens, mask = camera.lens(), None
    if masks is not None:
        # COLMAP appends the suffix; others replace it.
        paths = [masks.find(n, "mask") for n in (f"{name}.png", str(Path(name).with_suffix(".png")))]
        existing = [p for p in paths if p.is_file()]
        if not existing:
            raise NergError(f'its mask "{sanitize(paths[0])}" does not exist')
        mask = MaskFile(existing[0])
    return PosedFrame(name, image, _to_world(q, t), lens, mask=mask, ignores_exif=True)


def _to_world(q, t) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    norm = float(np.linalg.norm(q))
    if not (1e-6 < norm <= MAX_POSITION and np.abs(t).max() <= MAX_POSITION):
        raise NergError("its pose is not finite, or its quaternion is zero")
    back = Rotation.from_quat(np.roll(np.asarray(q, np.float64), -1)).as_matrix().T
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = back, -back @ np.asarray(t, np.float64)
    return out @ _FLIP


_Point = tuple[float, float, float, float, int]
"""Position, reprojection error and length of the track of a point."""


class _Reader:
    """Little-endian records of an open file; an end that comes too early is told with its place."""

    def __init__(self, path: Path, file: BinaryIO):
        self.path, self.file, self.at, self.size = path, file, 0, check_regular_file(path, "COLMAP file")

    def count(self, most: int, what: str) -> int:
        """The number of records, which begins the file."""
        count = self.take("Q", "its header")[0]
        _check_count(self.path, count, most, what)
        return count

    def take(self, form: str, what: str) -> tuple:
        size = struct.calcsize("<" + form)
        self.need(size, what)
        self.at += size
        return struct.unpack("<" + form, self.file.read(size))

    def need(self, size: int, what: str) -> None:
        if self.at + size > self.size:
            raise NergError(
                f'"{self.path}" ends in the middle of {what} (byte {self.at} of {self.size}); copy it again'
            )

    def skip(self, size: int, what: str) -> None:
        self.need(size, what)
        self.at += size
        self.file.seek(self.at)

    def end(self, count: int) -> None:
        """`NergError` where anything follows the ``count`` records that the header states."""
        if self.at < self.size:
            raise NergError(
                f'"{self.path}" has {self.size - self.at:,} more bytes than the {count:,} records that its header '
                "states; copy it again"
            )

    def name(self, what: str) -> str:
        raw = self.file.read(_NAME)
        end = raw.find(b"\0")
        if end < 0 and len(raw) == _NAME:
            raise NergError(f'the name of {what} of "{self.path}" has more than {_NAME - 1:,} bytes; copy it again')
        if end < 0:
            raise NergError(f'"{self.path}" ends in the middle of the name of {what}; copy it again')
        self.skip(end + 1, what)
        return raw[:end].decode("utf-8", errors="surrogateescape")


def _check_count(path: Path, count: int, most: int, what: str) -> None:
    if count > most:
        raise NergError(f'"{path}" has {count:,} {what}, more than the {most:,} that are read; give a smaller model')


def _cameras_bin(path: Path) -> dict[int, _Camera]:
    out = {}
    with _open(path) as file:
        r = _Reader(path, file)
        for k in range(r.count(MAX_IMAGES, "cameras")):
            number, model, width, height = r.take("iiQQ", f"camera record {k + 1}")
            if model not in _MODELS:
                raise NergError(
                    f'camera {number} of "{path}" has the unknown model number {model}, so that the file cannot be '
                    'read on; convert it with "colmap model_converter --output_type TXT"'
                )
            name, count = _MODELS[model]
            out[number] = _Camera(name, width, height, r.take(f"{count}d", f"camera record {k + 1}"))
        r.end(len(out))
    return out


def _images_bin(path: Path) -> list[tuple]:
    out = []
    with _open(path) as file:
        r = _Reader(path, file)
        for k in range(r.count(MAX_IMAGES, "images")):
            what = f"image record {k + 1}"
            values = r.take("i7di", what)
            name = r.name(what)
            # Per observation: x, y as doubles and the number of its point.
            r.skip(24 * r.take("Q", what)[0], what)
            out.append((name, values[8], values[1:5], values[5:8]))
        r.end(len(out))
    return out


def _points_bin(path: Path) -> Iterator[_Point]:
    with _open(path) as file:
        r = _Reader(path, file)
        count = r.count(MAX_POINTS, "points")
        for k in range(count):
            what = f"point record {k + 1}"
            values = r.take("Q3d3BdQ", what)
            r.skip(8 * values[8], what)
            yield *values[1:4], values[7], values[8]
        r.end(count)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Line numbers and lines; comments left out."""
    with _open(path) as file:
        # Names of images may be in any encoding.
        text = io.TextIOWrapper(file, encoding="utf-8", errors="surrogateescape")
        # A file without line ends must not become one line of gigabytes.
        for number, line in enumerate(iter(lambda: text.readline(_PIECE), ""), 1):
            if not line.startswith("#"):
                yield number, line.rstrip("\n")


def _rows(path: Path, most: int, what: str) -> Iterator[tuple[int, list[str]]]:
    """Numbers and words of the lines that are not empty, of which there may be ``most``."""
    count = 0
    for number, line in _lines(path):
        if len(line) > _LONGEST:
            raise NergError(
                f'line {number} of "{path}" has {len(line):,} characters, and at most {_LONGEST:,} are read; '
                "is it a COLMAP file?"
            )
        if line.strip():
            count += 1
            _check_count(path, count, most, what)
            yield number, line.split()


def _count_notes(path: Path, count: int) -> list[str]:
    """A sentence, where the header of a text file states another number than the ``count`` of its records."""
    with _open(path) as file:
        stated = re.search(rb"^#\s*Number of [a-z]+: *(\d+)", file.read(_HEADER), re.MULTILINE)
    if stated is None or int(stated[1]) == count:
        return []
    return [f'"{path}" has {count:,} records, but its header states {int(stated[1]):,}; copy it again if it was cut']


def _cameras_txt(path: Path) -> dict[int, _Camera]:
    out = {}
    for number, words in _rows(path, MAX_IMAGES, "cameras"):
        try:
            out[int(words[0])] = _Camera(words[1], int(words[2]), int(words[3]), tuple(map(float, words[4:])))
        except (ValueError, IndexError) as e:
            raise NergError(f'line {number} of "{path}" is not "CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS"') from e
    return out


def _images_txt(path: Path) -> list[tuple]:
    out, after_image = [], False
    for number, line in _lines(path):
        words = line[:_LONGEST].split()
        # The line after an image's lists its observations; it may be empty, and some writers leave it out.
        if not words or (after_image and (len(line) > _LONGEST or _are_observations(words))):
            after_image = False
            continue
        try:
            q, t = tuple(map(float, words[1:5])), tuple(map(float, words[5:8]))
            out.append((" ".join(words[9:]), int(words[8]), q, t))
            if len(q) != 4 or len(t) != 3 or not words[9:]:
                raise ValueError
        except (ValueError, IndexError) as e:
            raise NergError(f'line {number} of "{path}" is not "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"') from e
        _check_count(path, len(out), MAX_IMAGES, "images")
        after_image = True
    return out


def _are_observations(words: list[str]) -> bool:
    """Whether ``words`` are triples of X, Y and POINT3D_ID; an image's line ends with its name."""
    try:
        return len(words) % 3 == 0 and int(words[-1]) >= -1
    except ValueError:
        return False


def _points_txt(path: Path) -> Iterator[_Point]:
    for number, words in _rows(path, MAX_POINTS, "points"):
        try:
            yield float(words[1]), float(words[2]), float(words[3]), float(words[7]), (len(words) - 8) // 2
        except (ValueError, IndexError) as e:
            raise NergError(f'line {number} of "{path}" is not "POINT3D_ID X Y Z R G B ERROR TRACK"') from e


def _trusted(points: Iterator[_Point]) -> tuple[int, np.ndarray]:
    """How many ``points`` there are, and the positions (N, 3) of those that are evidence of a surface."""
    count, trusted = 0, [np.empty((0, 3))]
    while block := list(itertools.islice(points, _BLOCK)):
        table = np.array(block, np.float64)
        good = np.all(np.abs(table) <= MAX_POSITION, axis=1) & (table[:, 3] <= _MAX_ERROR) & (table[:, 4] >= _MIN_TRACK)
        trusted.append(table[good, :3])
        count += len(block)
    return count, np.concatenate(trusted)


# ---- Named poses ----
#
# Which file describes a posed image set, and its poses by the names of its images, whether or not they are there.

_MODEL_FOLDERS = ("", "sparse", "colmap/sparse")


@dataclass(frozen=True, eq=False)
class NamedPoses:
    """The N images of a posed image set, in its own coordinates."""

    path: Path  # the file that lists them
    sha256: str  # of the set, as the provenance of what is trained on it has it
    names: list[str]
    to_world: np.ndarray  # (N, 4, 4) rigid OpenGL camera-to-world: x right, y up, z back
    notes: list[str]  # sentences on what of a COLMAP model contradicts itself, and on models that are not used


def find_pose_source(dataset: str | Path) -> Path:
    """The transforms file of ``dataset``, or the folder of its COLMAP model, of several the one with the most images.
    ``dataset``: a folder, or that file itself."""
    dataset = Path(dataset)
    if dataset.exists() and not dataset.is_dir():
        check_regular_file(dataset, "posed image set")
        # A file of a COLMAP model stands for the model.
        return dataset.parent if dataset.suffix in (".bin", ".txt") else dataset
    for name in ("transforms.json", "transforms_train.json"):
        if is_regular_file(dataset / name, "transforms file"):
            return dataset / name
    for name in _MODEL_FOLDERS:
        models = _list_models(dataset / name)
        if models:
            return models[0] if len(models) == 1 else max(models, key=count_images)
    raise MissingFile(
        f'"{dataset}" holds neither transforms.json nor transforms_train.json nor a COLMAP model '
        "(sparse/0/cameras.bin); name the folder of a posed image set"
    )


def _list_models(folder: Path) -> list[Path]:
    """COLMAP's models of one reconstruction: in the numbered folders of ``folder``, and ``folder`` itself."""
    numbered = sorted((p for p in folder.glob("*") if p.name.isdecimal()), key=lambda p: int(p.name))
    return [p for p in (*numbered, folder) if find_model_files(p) is not None]


def describe_other_models(model: Path) -> list[str]:
    """A sentence on the models of the same reconstruction that are not used where the COLMAP ``model`` is."""
    models = _list_models(model.parent if model.name.isdecimal() else model)
    others = [p for p in models if resolve_path(p) != resolve_path(model)]
    if not others:
        return []
    describe = lambda p: f'"{p.name}" ({count_images(p):,} images)'
    return [
        f"of {len(models)} COLMAP models {describe(model)} is used, and not {format_names(describe(p) for p in others)}"
    ]


def read_named_poses(source: str | Path) -> NamedPoses:
    """Of a transforms file, or of the folder of a COLMAP model; `find_source` finds either.

    Raises `NergError` for what cannot be parsed, and for a file that lists nothing.
    """
    source = Path(source)
    if source.is_dir() and find_model_files(source) is not None:
        path, sha256, listed, notes = read_image_poses(source)
        notes += describe_other_models(source)
    else:
        path, (sha256, listed), notes = source, read_frame_poses(source), []
    if not listed:
        raise NergError(f'"{path}" lists no images; name the file of a posed image set')
    return NamedPoses(path, sha256, [name for name, _ in listed], np.stack([pose for _, pose in listed]), notes)


# ---- Which way is up, by what photographers do and what places have ----
#
# People hold cameras level: the horizontal axes of their pictures lie in one plane, whose normal is the vertical,
# however far a camera looks down. Places have a floor, or a table, which most things stand on: a plane of many points,
# below the cameras, whose normal is the vertical too, and by far the more exact one.


# How much the mean of the pictures' own up counts where their horizontal axes leave the vertical open.
_MEAN = 0.005
# Rolls beyond this sine count less and less (an L1 fit).
_LEVEL = 0.02
# A plane is looked for by so many triples of points; its normal may be so far from the cameras' up.
_TRIPLES, _TILT = 20_000, np.cos(np.radians(20.0))
# So thick is a plane, as a share of the points' median distance from their median; so many of the points it must hold.
_THICK, _SHARE = 0.02, 0.10
_POINTS = 4000
# Cameras that are held at larger angles than this, at the median, do not tell what is up.
_SURE = 10.0


@dataclass(frozen=True)
class UpEstimate:
    """``direction``: (3,) unit vector. ``roll``: median angle in degrees by which the horizontal axes of the pictures
    are off the horizon; ``plane``: share of the points on a plane that is level, None where there is none;
    ``between``: degrees between the plane's normal and what the cameras say."""

    direction: np.ndarray
    median_roll: float
    plane_fraction: float | None = None
    plane_angle: float | None = None

    @property
    def is_reliable(self) -> bool:
        """Whether the cameras agree."""
        return self.median_roll <= _SURE

    def __str__(self) -> str:
        cameras = f"the cameras are held level to {self.median_roll:.1f} degrees (median)"
        if self.plane_fraction is None:
            return f"{cameras}; no plane of the points is level"
        return f"{cameras}, and a plane of {self.plane_fraction:.0%} of the points is {self.plane_angle:.1f} degrees from their up"


def estimate_up(to_world: np.ndarray, points: np.ndarray) -> UpEstimate:
    """Up in the coordinates of OpenGL camera-to-world poses (N, 4, 4) and of ``points`` (M, 3) on surfaces."""
    rights, tops, centers = to_world[:, :3, 0], to_world[:, :3, 1], to_world[:, :3, 3]
    by_cameras = _level(rights, tops)
    roll = float(np.degrees(np.median(np.arcsin(np.clip(np.abs(rights @ by_cameras), 0, 1)))))
    found = _plane(points, centers, by_cameras) if len(points) >= 100 else None
    if found is None:
        return UpEstimate(by_cameras, roll)
    normal, share = found
    between = float(np.degrees(np.arccos(np.clip(normal @ by_cameras, -1, 1))))
    return UpEstimate(normal, roll, share, between)


def rotation_to_z(up: np.ndarray) -> np.ndarray:
    """The smallest rotation (3, 3) that takes the unit vector ``up`` to +z."""
    from scipy.spatial.transform import Rotation

    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3) if up[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, up[2])).as_matrix()


def _level(rights: np.ndarray, tops: np.ndarray) -> np.ndarray:
    """The direction to which most horizontal axes are perpendicular, on the side of the pictures' tops."""
    mean = tops[0] * 0.0
    weights = np.ones(len(tops))
    for _ in range(20):
        mean = weights @ tops
        mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
        weights = 1 / np.maximum(np.linalg.norm(tops - mean, axis=1), _LEVEL)
    up = mean
    for _ in range(20):
        weights = 1 / np.maximum(np.abs(rights @ up), _LEVEL)
        spread = (rights * weights[:, None]).T @ rights / weights.sum()
        vectors = np.linalg.eigh(spread + _MEAN * (np.eye(3) - np.outer(mean, mean)))[1]
        up = vectors[:, 0] if vectors[:, 0] @ mean >= 0 else -vectors[:, 0]
    return up


def _plane(points: np.ndarray, centers: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Normal of the level plane below the cameras with most points, and their share; None where none has enough."""
    rng = np.random.default_rng(0)
    points = points if len(points) <= _POINTS else rng.choice(points, _POINTS, replace=False)
    middle = np.median(points, axis=0)
    thick = _THICK * float(np.median(np.linalg.norm(points - middle, axis=1)))
    a, b, c = points[rng.integers(0, len(points), (3, _TRIPLES))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(length, 1e-300)[:, None]
    normals *= np.where(normals @ up < 0, -1.0, 1.0)[:, None]
    level = (length > 0) & (normals @ up > _TILT)
    best: tuple[int, np.ndarray, float] | None = None
    for normal, offset in zip(normals[level], np.sum(normals * a, axis=1)[level]):
        if np.mean(centers @ normal > offset) < 0.9:
            continue
        held = int(np.count_nonzero(np.abs(points @ normal - offset) < thick))
        if best is None or held > best[0]:
            best = held, normal, offset
    if best is None or best[0] < _SHARE * len(points):
        return None
    _, normal, offset = best
    for _ in range(3):
        on = points[np.abs(points @ normal - offset) < thick]
        _, spread, axes = np.linalg.svd(on - on.mean(axis=0), full_matrices=False)
        if spread[1] < 0.2 * spread[0]:
            return None  # an edge, through which many planes go
        normal = axes[2] if axes[2] @ up > 0 else -axes[2]
        offset = float(on.mean(axis=0) @ normal)
    if normal @ up < _TILT:
        return None
    return normal, float(np.mean(np.abs(points @ normal - offset) < thick))
