"""Posed image sets as instant-ngp, nerfstudio and the Blender NeRF scenes write them: ``transforms.json``.

What differs between the three, and how it is read:

- depth: nerfstudio's ``depth_file_path`` and instant-ngp's ``depth_path``. 16-bit PNG counts millimetres
  (or ``depth_unit_scale_factor``, or ``integer_depth_scale``, scene units a step) along the viewing axis; NPY and
  EXR hold scene units along each pixel's ray. ``is_euclidean_depth`` in the file says true (ray) or false (axis) for
  all.
- masks: ``mask_path``, black left out; instant-ngp's ``dynamic_mask_NAME.png`` beside the image, white left out.
- ``applied_transform``, ``applied_scale``: what the writer did to the original coordinates; `PosedImages.original`
  undoes it. ``dataparser_transforms.json``: from there to the coordinates that nerfstudio trained in.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, sentence
from nerg_mi.files.bounded import JSON_BYTES, parse_json, plain, read_bytes

from .posed import FARTHEST, LENS_KEYS, DepthFile, Frame, MaskFile, PosedImages, Unused, inside, rigid_pose, settled

_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".PNG", ".JPG", ".JPEG", ".EXR")
_PINHOLE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE", "FULL_OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_MILLIMETRE = 1e-3
_SCALES = 1e-9, 1e9
# Keys of the file that hold for all of its frames. Others are many in some files, and would be copied for each.
_SHARED = (
    *LENS_KEYS,
    "camera_model",
    "is_fisheye",
    "is_equirectangular",
    "depth_unit_scale_factor",
    "integer_depth_scale",
    "is_euclidean_depth",
)


def read_transforms(path: str | Path, allow_outside: bool = False) -> PosedImages:
    """Read a transforms file. Frames that cannot be used are listed, not fatal.

    Images, masks and depth files that lie outside of the file's folder, links followed, are not used unless
    ``allow_outside``.

    Raises `NergError`, naming file and frame, for malformed JSON and when not a single frame can be used.
    """
    path = Path(path)
    raw = read_bytes(path, "transforms file", JSON_BYTES)
    data = _json(path, raw)
    listed = _frames(data, path)
    original = _original(data, path)
    # Millimetres are of the original coordinates.
    metre = 1.0 if original is None else 1 / float(np.cbrt(np.linalg.det(original[:3, :3])))
    frames, unused, notes = [], [], []
    shared = {k: v for k, v in data.items() if k in _SHARED or k.startswith("ftheta")}
    root = None if allow_outside else path.parent
    for index, entry in enumerate(listed):
        name = entry.get("file_path") if isinstance(entry, dict) else None
        if not isinstance(name, str):
            unused.append(Unused(f"frame {index}", 'it has no "file_path"'))
            continue
        try:
            frames.append(_frame({**shared, **entry}, entry, path.parent, name, metre, notes, root))
        except (ValueError, OverflowError, OSError) as e:
            # A name may be longer than the system allows, or hold what no name can.
            unused.append(Unused(name, sentence(e)))
    frames, unused = settled(path, frames, unused)
    held_out, spare = _splits(data, frames)
    return PosedImages(
        path,
        frames,
        unused,
        _aabb(data, path),
        hashlib.sha256(raw).hexdigest(),
        notes,
        held_out=held_out,
        spare=spare,
        original=original,
    )


def read_frame_poses(path: str | Path) -> tuple[str, list[tuple[str, np.ndarray]]]:
    """Of a transforms file, whose images need not be there: its SHA-256, and of each frame its name and its OpenGL
    camera-to-world pose (4, 4).

    `NergError` names file and frame for what is no such file, or no pose.
    """
    path = Path(path)
    raw = read_bytes(path, "transforms file", JSON_BYTES)
    found = []
    for index, entry in enumerate(_frames(_json(path, raw), path)):
        name = entry.get("file_path") if isinstance(entry, dict) else None
        if not isinstance(name, str) or "transform_matrix" not in entry:
            raise NergError(
                f'frame {index} of "{path}" has no "file_path" or no "transform_matrix"; complete or remove it'
            )
        try:
            found.append((name, rigid_pose(entry["transform_matrix"])))
        except NergError as error:
            raise NergError(f'frame "{plain(name)}" of "{path}": {error}; correct or remove it') from error
    return hashlib.sha256(raw).hexdigest(), found


def read_dataparser(path: str | Path) -> np.ndarray:
    """The similarity (4, 4) of nerfstudio's ``dataparser_transforms.json``: original coordinates to trained ones."""
    path = Path(path)
    data = _json(path, read_bytes(path, "file of nerfstudio's coordinates", JSON_BYTES))
    try:
        m, scale = np.asarray(data["transform"], np.float64), float(data["scale"])
    except (KeyError, TypeError, ValueError, OverflowError) as e:
        raise NergError(f'"{path}" needs "transform", 3 x 4 numbers, and "scale"') from e
    if not _rigid(m) or not _SCALES[0] <= scale <= _SCALES[1]:
        raise NergError(
            f'"{path}" needs "transform", a rotation and a translation of 3 x 4 numbers, and a positive "scale"'
        )
    return np.vstack([scale * m[:3], [0, 0, 0, 1]])


def _json(path: Path, raw: bytes) -> dict:
    data = parse_json(raw, path, "transforms file")
    if not isinstance(data, dict):
        raise NergError(f'"{path}" is not a transforms file: it holds no JSON object; name one that does')
    return data


def _frames(data: dict, path: Path) -> list:
    if not isinstance(data.get("frames"), list):
        raise NergError(f'"{path}" is not a transforms file: it has no list "frames"; name one that has')
    return data["frames"]


def _frame(
    data: dict, entry: dict, folder: Path, name: str, metre: float, notes: list[str], root: Path | None
) -> Frame:
    """One frame; ``data``: its keys over those of the file; ``root``: below which its files must lie."""
    image = _image_file(inside(root, folder / name, "image"))
    if image is None:
        raise NergError("its image does not exist")
    inside(root, image, "image")
    if "transform_matrix" not in entry:
        raise NergError('it has no "transform_matrix"')
    pose, lens, mask = rigid_pose(entry["transform_matrix"]), _lens(data), _mask(entry, folder, image, root)
    depth = _depth(data, entry, folder, metre)
    if depth is not None:
        inside(root, depth.path, "depth file")
    if depth is not None and not depth.path.is_file():
        notes.append(f'"{plain(name)}" is used without depth: its depth file "{plain(depth.path)}" does not exist')
        depth = None
    return Frame(name, image, pose, lens, depth, mask)


def _image_file(path: Path) -> Path | None:
    """The image at ``path``, whose suffix Blender-style files leave out; None when there is none."""
    for candidate in (path, *(path.with_name(path.name + s) for s in _SUFFIXES)):
        if candidate.is_file():
            return candidate
    return None


def _mask(entry: dict, folder: Path, image: Path, root: Path | None) -> MaskFile | None:
    if entry.get("mask_path") is not None:
        mask = inside(root, folder / _path(entry, "mask_path"), "mask")
        if not mask.is_file():
            raise NergError(
                f'its mask "{plain(entry["mask_path"])}" does not exist; restore it, or remove its "mask_path"'
            )
        return MaskFile(mask)
    dynamic = image.with_name(f"dynamic_mask_{image.stem}.png")
    return MaskFile(inside(root, dynamic, "mask"), hides=True) if dynamic.is_file() else None


def _depth(data: dict, entry: dict, folder: Path, metre: float) -> DepthFile | None:
    key = next((k for k in ("depth_file_path", "depth_path") if entry.get(k) is not None), None)
    if key is None:
        return None
    path = folder / _path(entry, key)
    counted = path.suffix.lower() == ".png"
    unit, axis = (_MILLIMETRE * metre, True) if counted else (1.0, False)
    if counted and data.get("depth_unit_scale_factor") is not None:
        unit = _number(data, "depth_unit_scale_factor") * metre
    elif counted and data.get("integer_depth_scale") is not None:
        unit = _number(data, "integer_depth_scale")
    if not 0 < unit <= FARTHEST:
        raise NergError("the unit of its depth file is not a positive number")
    if data.get("is_euclidean_depth") is not None:
        axis = not data["is_euclidean_depth"]
    return DepthFile(path, unit, axis)


def _path(entry: dict, key: str) -> str:
    if not isinstance(entry[key], str):
        raise NergError(f'its "{key}" is not the path of a file')
    return entry[key]


def _number(data: dict, key: str) -> float:
    try:
        return float(data[key])
    except (TypeError, ValueError, OverflowError) as e:
        raise NergError(f'its "{key}" is not a number') from e


def _lens(data: dict) -> dict:
    model = data.get("camera_model", "OPENCV")
    fisheye = bool(data.get("is_fisheye")) or model in _FISHEYE
    if (
        model not in _PINHOLE + _FISHEYE
        or data.get("is_equirectangular")
        or any(str(k).startswith("ftheta") for k in data)
    ):
        raise NergError(
            f'its lens model "{plain(model, 60)}" is not supported; undistort the images to "OPENCV" with k1, k2, p1, '
            'p2, to "OPENCV_FISHEYE" with k1 to k4, or to "PINHOLE"'
        )
    lens = {k: _number(data, k) for k in LENS_KEYS if k != "fisheye" and data.get(k) is not None}
    if not all(np.isfinite(v) for v in lens.values()):
        raise NergError("its intrinsics are not finite")
    if not fisheye and model != "FULL_OPENCV" and any(lens.get(k) for k in ("k4", "k5", "k6")):
        raise NergError(
            'its k4, k5, k6 mean different things to different programs; name "camera_model": "FULL_OPENCV" if '
            "they are OpenCV's rational model, or undistort the images"
        )
    return {**lens, "fisheye": 1.0} if fisheye else lens


def _original(data: dict, path: Path) -> np.ndarray | None:
    """Similarity from the file's coordinates to the original ones; None where the file does not tell."""
    if data.get("applied_transform") is None and data.get("applied_scale") is None:
        return None
    matrix, scale = data.get("applied_transform"), data.get("applied_scale")
    try:
        m = np.eye(4) if matrix is None else np.asarray(matrix, np.float64)
        scale = 1.0 if scale is None else float(scale)
    except (TypeError, ValueError, OverflowError):
        m, scale = np.zeros(0), 0.0
    if not _rigid(m) or not _SCALES[0] <= scale <= _SCALES[1]:
        raise NergError(
            f'"applied_transform" of "{path}" must be a rotation and a translation, 3 x 4 numbers, and '
            '"applied_scale" positive'
        )
    return np.linalg.inv(np.vstack([scale * m[:3], [0, 0, 0, 1]]))


def _rigid(m: np.ndarray) -> bool:
    """Whether ``m`` is a rotation and a translation, in 3 x 4 or 4 x 4 numbers."""
    if m.shape not in ((3, 4), (4, 4)) or not np.abs(m).max() <= FARTHEST:
        return False
    return bool(np.abs(m[:3, :3] @ m[:3, :3].T - np.eye(3)).max() < 1e-3 and np.linalg.det(m[:3, :3]) > 0)


def _splits(data: dict, frames: list[Frame]) -> tuple[list[str] | None, list[str]]:
    """Held-out and spare frames by nerfstudio's lists of file names."""
    listed = {
        k: {Path(x).as_posix() for x in data[f"{k}_filenames"] if isinstance(x, str)}
        for k in ("train", "val", "test")
        if isinstance(data.get(f"{k}_filenames"), list)
    }
    if not listed:
        return None, []
    test = listed.get("test") or listed.get("val", set())
    train = listed.get("train")
    held = [f.name for f in frames if Path(f.name).as_posix() in test]
    spare = [
        f.name for f in frames if f.name not in held and train is not None and Path(f.name).as_posix() not in train
    ]
    return held, spare


def _aabb(data: dict, path: Path) -> np.ndarray | None:
    if data.get("aabb") is None:
        return None
    try:
        box = np.asarray(data["aabb"], np.float64)
    except (TypeError, ValueError, OverflowError):
        box = np.zeros(0)
    box = box.reshape(2, 3) if box.size == 6 else box
    if box.shape != (2, 3) or not np.abs(box).max() <= FARTHEST or not np.all(box[1] > box[0]):
        raise NergError(f'"aabb" in "{path}" must be two corners of 3 numbers, the second above the first')
    return box
