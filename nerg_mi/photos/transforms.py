"""Posed image sets as instant-ngp, nerfstudio and the Blender NeRF scenes write them: ``transforms.json``.

What differs between the three, and how it is read:

- poses: instant-ngp's ``from_mitsuba`` (or ``normal_mts_args``) says that cameras look along +z with x to the left.
- depth: nerfstudio's ``depth_file_path`` and instant-ngp's ``depth_path``, along the viewing axis. NPY and 16-bit PNG
  count millimetres as in nerfstudio (get_depth_image_from_path), EXR metres as Record3D writes it, of the original
  coordinates. ``depth_unit_scale_factor`` says how many metres a step is, ``integer_depth_scale`` how many units of the
  file's coordinates; ``is_euclidean_depth``: true for distances along each pixel's ray.
- masks: ``mask_path``, black left out; instant-ngp's ``dynamic_mask_NAME.png`` beside the image, white left out.
- ``applied_transform``, ``applied_scale``: what the writer did to the original coordinates; `PosedImages.original`
  undoes it. ``dataparser_transforms.json``: from there to the coordinates that nerfstudio trained in.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, sanitize, format_error
from nerg_mi.files.safe_read import MAX_JSON_BYTES, is_regular_file, parse_json, read_bytes

from .cameras import OPENGL_FROM_MITSUBA
from .posed import (
    MAX_POSITION,
    LENS_KEYS,
    DepthFile,
    FileFinder,
    MaskFile,
    PosedFrame,
    PosedImages,
    UnusedFrame,
    normalize_name,
    check_inside,
    format_names,
    rigid_pose,
    sort_frames,
)

_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr")
_PINHOLE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE", "FULL_OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_MILLIMETRE = 1e-3
_SCALES = 1e-9, 1e9
# The order of nerfstudio's distortion_params.
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
# Keys of the file that hold for all of its frames. Others are many in some files, and would be copied for each.
_SHARED = (
    *LENS_KEYS,
    *"distortion_params x_fov y_fov camera_model is_fisheye is_equirectangular from_mitsuba normal_mts_args".split(),
    *"depth_unit_scale_factor integer_depth_scale is_euclidean_depth enable_depth_loading".split(),
)
_READ = {
    *_SHARED,
    *"frames applied_transform applied_scale aabb train_filenames val_filenames test_filenames".split(),
    *"file_path transform_matrix mask_path depth_file_path depth_path".split(),
}
# Keys of nerfstudio, instant-ngp, Blender's scenes, colmap2nerf and NeRFCapture that say nothing about what pictures
# show and from where.
_HARMLESS = {
    *"orientation_override colmap_im_id aabb_scale scale offset render_aabb up sharpness sharpen rotation".split(),
    *"sharpness_discard_threshold importance_sampling n_extra_learnable_dims enable_ray_loading timestamp".split(),
    *"blur_score frame_count fps version name id".split(),
}
_DEPTH_MEANING = "depth.*(unit|scale|factor|type|near|far|min|max|offset)"
# Patterns of other keys, whatever program writes them, that change what pictures and poses mean -> the remedy. They do
# no harm with a value that is off (false, 0) or says what is read here.
_CHANGES_MEANING = {
    "^from_|convention|handed|^coord|^(pose|transform)_(type|format)|w2c|world_to_cam|^is_(opencv|colmap)|^opencv$|"
    "^extrinsic|^flip|^mirror": (
        "its poses follow another convention; write OpenGL's camera-to-world poses (x right, y up, z back) without it"
    ),
    "^rolling_shutter|^transform_matrix_(start|end)$": (
        "its cameras move while a picture is taken; write the pose of the middle row without it"
    ),
    "^(color|colour)_?space$|^gamma$|^is_linear$": "its colours are encoded otherwise; store pictures in sRGB",
    "mask.*inver|inver.*mask": "its masks mean the opposite; write masks that are white where pictures are used",
    "_transparent$|^fix_premult$": "a colour stands for nothing; store alpha in the pictures and remove it",
    "^(skew|xi|omega|b[12]|shift_[xy]|p[3-9]|s[1-4]|k([7-9]|1[0-9])|tau_[xy])$|^distortion(?!_model)|crop_radius|"
    "^(latlong|equirectangular|orthographic|projection|lens|(lens|camera)_type|distortion_model)$": (
        "its lens is not supported; undistort the pictures"
    ),
    _DEPTH_MEANING: 'it says what depth means; write "depth_unit_scale_factor" (in metres), "is_euclidean_depth"',
}
_SAME_MEANING = {"opengl", "nerfstudio", "nerf", "blender", "c2w", "camera_to_world", "cam2world", "right"}
_SAME_MEANING |= {"perspective", "pinhole", "srgb"}


def read_transforms(path: str | Path, allow_outside: bool = False) -> PosedImages:
    """Read a transforms file. Frames that cannot be used are listed, not fatal.

    Images, masks and depth files that lie outside of the file's folder, links followed, are not used unless
    ``allow_outside``.

    Raises `NergError`, naming file and frame, for malformed JSON and when not a single frame can be used.
    """
    path = Path(path)
    raw = read_bytes(path, "transforms file", MAX_JSON_BYTES)
    data = _json(path, raw)
    entries = _frames(data, path)
    original = _original(data, path)
    # Millimetres are of the original coordinates.
    metre = 1.0 if original is None else 1 / float(np.cbrt(np.linalg.det(original[:3, :3])))
    frames, unused, notes, listed = [], [], [], set()
    with_depth = any(isinstance(f, dict) and (f.get("depth_file_path") or f.get("depth_path")) for f in entries)
    unread = _unread_keys_of_file(data, path, with_depth)
    shared = {k: v for k, v in data.items() if k in _SHARED or k.startswith("ftheta")}
    finder = FileFinder(path.parent, None if allow_outside else path.parent)
    for index, entry in enumerate(entries):
        name = entry.get("file_path") if isinstance(entry, dict) else None
        if not isinstance(name, str):
            unused.append(UnusedFrame(f"frame {index}", 'it has no "file_path"'))
            continue
        try:
            image = _image_file(finder, name)
            listed.add(image)
            unread |= _unread_keys(entry, with_depth)
            frames.append(_frame({**shared, **entry}, entry, finder, name, image, metre, notes))
        except (ValueError, OverflowError, OSError) as e:
            # A name may be longer than the system allows, or hold what no name can.
            unused.append(UnusedFrame(name, format_error(e)))
    frames, unused = sort_frames(path, frames, unused)
    held_out, spare = _splits(data, frames)
    if unread:
        notes.append(f"keys of {path.name} that are not used: {format_names(sorted(unread), 12)}")
    return PosedImages(
        path,
        frames,
        unused,
        _aabb(data, path),
        hashlib.sha256(raw).hexdigest(),
        notes,
        root=path.parent,
        image_folders=frozenset(p.parent for p in listed),
        image_files=frozenset(listed),
        held_out=held_out,
        unassigned=spare,
        to_original=original,
    )


def read_frame_poses(path: str | Path) -> tuple[str, list[tuple[str, np.ndarray]]]:
    """Of a transforms file, whose images need not be there: its SHA-256, and of each frame its name and its OpenGL
    camera-to-world pose (4, 4).

    `NergError` names file and frame for what is no such file, or no pose.
    """
    path = Path(path)
    raw = read_bytes(path, "transforms file", MAX_JSON_BYTES)
    found = []
    data = _json(path, raw)
    _unread_keys_of_file(data, path, False)
    for index, entry in enumerate(_frames(data, path)):
        name = entry.get("file_path") if isinstance(entry, dict) else None
        if not isinstance(name, str) or "transform_matrix" not in entry:
            raise NergError(
                f'frame {index} of "{path}" has no "file_path" or no "transform_matrix"; complete or remove it'
            )
        try:
            _unread_keys(entry, False)
            found.append((name, _pose({**{k: data.get(k) for k in _SHARED}, **entry})))
        except NergError as error:
            raise NergError(f'frame "{sanitize(name)}" of "{path}": {error}; correct or remove it') from error
    return hashlib.sha256(raw).hexdigest(), found


def read_dataparser(path: str | Path) -> np.ndarray:
    """The similarity (4, 4) of nerfstudio's ``dataparser_transforms.json``: original coordinates to trained ones."""
    path = Path(path)
    data = _json(path, read_bytes(path, "file of nerfstudio's coordinates", MAX_JSON_BYTES))
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


def _unread_keys_of_file(data: dict, path: Path, with_depth: bool) -> set[str]:
    try:
        return _unread_keys(data, with_depth)
    except NergError as error:
        raise NergError(f'"{path}": {error}') from error


def _unread_keys(entry: dict, with_depth: bool) -> set[str]:
    """Keys of the file or of a frame that are not used here; `NergError` for one that changes what the others mean."""
    unread = {str(k) for k in entry} - _READ - _HARMLESS
    for key in sorted(unread):
        for pattern, remedy in _CHANGES_MEANING.items():
            if re.search(pattern, key.casefold()) and (with_depth or pattern != _DEPTH_MEANING):
                value = entry[key]
                same = str(value).casefold() in _SAME_MEANING or value == entry.get("transform_matrix", [])
                if not (same or _is_off(value)):
                    raise NergError(
                        f'the key "{sanitize(key, 60)}" with the value {sanitize(value, 60)} is not read: {remedy}'
                    )
    return {k for k in unread if not k.startswith("ftheta")}


def _is_off(value: object) -> bool:
    """Whether ``value``, of JSON, is nothing, false or zero, or holds nothing else."""
    return all(map(_is_off, value)) if isinstance(value, list) else not value


def _pose(data: dict) -> np.ndarray:
    """OpenGL camera-to-world pose (4, 4) of a frame."""
    pose = rigid_pose(data["transform_matrix"])
    # instant-ngp takes the mere presence of the second key for the first.
    if _is_true(data, "from_mitsuba") or data.get("normal_mts_args") is not None:
        pose = pose @ OPENGL_FROM_MITSUBA
    return pose


def _frame(
    data: dict, entry: dict, finder: FileFinder, name: str, image: Path, metre: float, notes: list[str]
) -> PosedFrame:
    """One frame; ``data``: its keys over those of the file."""
    if not image.is_file():
        raise NergError("its image does not exist")
    if "transform_matrix" not in entry:
        raise NergError('it has no "transform_matrix"')
    pose, lens, mask = _pose(data), _lens(data), _mask(entry, finder, image)
    depth = _depth(data, entry, finder, metre)
    if depth is not None and not depth.path.is_file():
        notes.append(f'"{sanitize(name)}" is used without depth: its depth file "{sanitize(depth.path)}" does not exist')
        depth = None
    return PosedFrame(name, image, pose, lens, depth, mask)


def _image_file(finder: FileFinder, name: str) -> Path:
    """The image ``name``, whose suffix Blender-style files leave out; as it is spelled, where there is none."""
    paths = (finder.find(name + suffix, "image") for suffix in ("", *_SUFFIXES))
    return next((p for p in paths if p.is_file()), finder.folder / name)


def _mask(entry: dict, finder: FileFinder, image: Path) -> MaskFile | None:
    if entry.get("mask_path") is not None:
        mask = finder.find(_path(entry, "mask_path"), "mask")
        if not mask.is_file():
            raise NergError(
                f'its mask "{sanitize(entry["mask_path"])}" does not exist; restore it, or remove its "mask_path"'
            )
        return MaskFile(mask)
    dynamic = image.with_name(f"dynamic_mask_{image.stem}.png")
    return MaskFile(check_inside(finder.root, dynamic, "mask"), is_inverted=True) if is_regular_file(dynamic, "mask") else None


def _depth(data: dict, entry: dict, finder: FileFinder, metre: float) -> DepthFile | None:
    """``metre``: in units of the file's coordinates."""
    key = next((k for k in ("depth_file_path", "depth_path") if entry.get(k) is not None), None)
    if key is None or not _is_true(data, "enable_depth_loading", True):
        return None
    path = finder.find(_path(entry, key), "depth file")
    if data.get("depth_unit_scale_factor") is not None:
        unit = _number(data, "depth_unit_scale_factor") * metre
    elif data.get("integer_depth_scale") is not None:
        unit = _number(data, "integer_depth_scale")
    else:
        unit = (1.0 if path.suffix.lower() == ".exr" else _MILLIMETRE) * metre
    if not 0 < unit <= MAX_POSITION:
        raise NergError("the unit of its depth file is not a positive number")
    return DepthFile(path, unit, not _is_true(data, "is_euclidean_depth"))


def _is_true(data: dict, key: str, default: bool = False) -> bool:
    value = data.get(key)
    if value is None:
        return default
    if value not in (True, False):
        raise NergError(f'its "{key}" must be true or false, not {sanitize(value, 60)}')
    return bool(value)


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
    fisheye = _is_true(data, "is_fisheye") or model in _FISHEYE
    if (
        model not in _PINHOLE + _FISHEYE
        or _is_true(data, "is_equirectangular")
        or any(str(k).startswith("ftheta") for k in data)
    ):
        raise NergError(
            f'its lens model "{sanitize(model, 60)}" is not supported; undistort the images to "OPENCV" with k1, k2, p1, '
            'p2, to "OPENCV_FISHEYE" with k1 to k4, or to "PINHOLE"'
        )
    lens = {k: _number(data, k) for k in LENS_KEYS if k != "fisheye" and data.get(k) is not None}
    for axis in "xy":
        if data.get(f"{axis}_fov") is not None:
            lens.setdefault(f"camera_angle_{axis}", float(np.radians(_number(data, f"{axis}_fov"))))
    lens |= _distortion(data)
    if not all(np.isfinite(v) for v in lens.values()):
        raise NergError("its intrinsics are not finite")
    if not fisheye and model != "FULL_OPENCV" and any(lens.get(k) for k in ("k4", "k5", "k6")):
        raise NergError(
            'its k4, k5, k6 mean different things to different programs; name "camera_model": "FULL_OPENCV" if '
            "they are OpenCV's rational model, or undistort the images"
        )
    return {**lens, "fisheye": 1.0} if fisheye else lens


def _distortion(data: dict) -> dict[str, float]:
    """nerfstudio's distortion_params, which it takes in place of the coefficients by name."""
    values = data.get("distortion_params")
    if values is None:
        return {}
    if not isinstance(values, list) or len(values) != len(_DISTORTION):
        raise NergError(f'its "distortion_params" must be the numbers {", ".join(_DISTORTION)}')
    numbers = dict(zip(_DISTORTION, values))
    return {k: _number(numbers, k) for k in _DISTORTION}


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
    if m.shape not in ((3, 4), (4, 4)) or not np.abs(m).max() <= MAX_POSITION:
        return False
    return bool(np.abs(m[:3, :3] @ m[:3, :3].T - np.eye(3)).max() < 1e-3 and np.linalg.det(m[:3, :3]) > 0)


def _splits(data: dict, frames: list[PosedFrame]) -> tuple[list[str] | None, list[str]]:
    """Held-out and spare frames by nerfstudio's lists of file names."""
    listed = {
        k: {normalize_name(x) for x in data[f"{k}_filenames"] if isinstance(x, str)}
        for k in ("train", "val", "test")
        if isinstance(data.get(f"{k}_filenames"), list)
    }
    if not listed:
        return None, []
    test = listed.get("test") or listed.get("val", set())
    train = listed.get("train")
    held = [f.name for f in frames if normalize_name(f.name) in test]
    spare = [f.name for f in frames if f.name not in held and train is not None and normalize_name(f.name) not in train]
    return held, spare


def _aabb(data: dict, path: Path) -> np.ndarray | None:
    if data.get("aabb") is None:
        return None
    try:
        box = np.asarray(data["aabb"], np.float64)
    except (TypeError, ValueError, OverflowError):
        box = np.zeros(0)
    box = box.reshape(2, 3) if box.size == 6 else box
    if box.shape != (2, 3) or not np.abs(box).max() <= MAX_POSITION or not np.all(box[1] > box[0]):
        raise NergError(f'"aabb" in "{path}" must be two corners of 3 numbers, the second above the first')
    return box
