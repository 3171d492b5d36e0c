"""Posed image sets in ``transforms.json`` files of instant-ngp, nerfstudio and the Blender NeRF scenes.

Keys of a file or frame:

- Read: ``frames``, ``file_path``, ``transform_matrix``, ``w``, ``h``, ``fl_x``, ``fl_y``, ``cx``, ``cy``,
  ``camera_angle_x``, ``camera_angle_y``, ``x_fov``, ``y_fov``, ``k1`` to ``k6``, ``p1``, ``p2``,
  ``distortion_params``, ``camera_model``, ``is_fisheye``, ``mask_path``, keys of depth, ``enable_depth_loading``,
  ``aabb``, ``train_filenames``, ``val_filenames``, ``test_filenames``; ``applied_transform`` and ``applied_scale``,
  the transform that the writer applied to the original coordinates (`Photos.to_original` inverts it);
  ``from_mitsuba`` or instant-ngp's ``normal_mts_args``: cameras look along +z with x to the left.
- Ignored: ``aabb_scale``, ``scale``, ``offset``, ``render_aabb``, ``up``, ``sharpness``, ``orientation_override``,
  ``colmap_im_id``, ``rotation``, ``timestamp`` and similar.
- Refused unless off: ``rolling_shutter``, ``transform_matrix_start``, ``transform_matrix_end``,
  ``white_transparent``, ``black_transparent``, ``fix_premult``, ``latlong``, ``equirectangular``,
  ``fisheye_crop_radius``, ``skew`` and other coefficients of lenses; unknown keys that name a convention, a
  coordinate system, a kind of lens, the encoding of colours, inverted masks, or the unit or kind of depth.
- Others are named once.

``dataparser_transforms.json`` is the transform from the original coordinates to those in which nerfstudio trained.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, format_error, sanitize
from nerg_mi.files.safe_read import MAX_JSON_BYTES, is_regular_file, parse_json, read_bytes
from nerg_mi.maths.transforms import check_rigid_transforms, nearest_rotation

from .cameras import OPENGL_FROM_MITSUBA
from .posed import (
    LENS_KEYS,
    MAX_POSITION,
    DepthFile,
    FileFinder,
    MaskFile,
    PosedFrame,
    PosedImages,
    UnusedFrame,
    check_inside,
    format_names,
    normalize_name,
    rigid_pose,
    sort_frames,
)

_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr")
_PINHOLE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE", "FULL_OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_MILLIMETRE = 1e-3
_SCALE_RANGE = 1e-9, 1e9
# Order of nerfstudio's distortion_params.
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
# Keys of the file that apply to all frames. Other keys are not copied to each frame, since some files have many of
# them.
_SHARED_KEYS = (
    *LENS_KEYS,
    *"distortion_params x_fov y_fov camera_model is_fisheye is_equirectangular from_mitsuba normal_mts_args".split(),
    *"depth_unit_scale_factor integer_depth_scale is_euclidean_depth enable_depth_loading".split(),
)
_KEYS_READ = {
    *_SHARED_KEYS,
    *"frames applied_transform applied_scale aabb train_filenames val_filenames test_filenames".split(),
    *"file_path transform_matrix mask_path depth_file_path depth_path".split(),
}
# Keys of nerfstudio, instant-ngp, Blender scenes, colmap2nerf and NeRFCapture that affect neither images nor poses.
_IGNORED_KEYS = {
    *"orientation_override colmap_im_id aabb_scale scale offset render_aabb up sharpness sharpen rotation".split(),
    *"sharpness_discard_threshold importance_sampling n_extra_learnable_dims enable_ray_loading timestamp".split(),
    *"blur_score frame_count fps version name id".split(),
}
_DEPTH_PATTERN = "depth.*(unit|scale|factor|type|near|far|min|max|offset)"
# Patterns of keys that change the meaning of images or poses -> remedy. A key is accepted if its value is off (false,
# 0) or states the convention of this reader.
_REFUSED_KEYS = {
    "^from_|convention|handed|^coord|^(pose|transform)_(type|format)|w2c|world_to_cam|^is_(opencv|colmap)|^opencv$|"
    "^extrinsic|^flip|^mirror": (
        "its poses follow another convention; write OpenGL camera-to-world poses (x right, y up, z back) without this "
        "key"
    ),
    "^rolling_shutter|^transform_matrix_(start|end)$": (
        "its cameras move during the exposure; write the pose of the middle row without this key"
    ),
    "^(color|colour)_?space$|^gamma$|^is_linear$": "its colours have another encoding; store images in sRGB",
    "mask.*inver|inver.*mask": "its masks are inverted; write masks that are white for used pixels",
    "_transparent$|^fix_premult$": "a colour stands for transparency; store alpha in the images and remove this key",
    "^(skew|xi|omega|b[12]|shift_[xy]|p[3-9]|s[1-4]|k([7-9]|1[0-9])|tau_[xy])$|^distortion(?!_model)|crop_radius|"
    "^(latlong|equirectangular|orthographic|projection|lens|(lens|camera)_type|distortion_model)$": (
        "its lens is not supported; undistort the images"
    ),
    _DEPTH_PATTERN: 'it changes the meaning of depth; use "depth_unit_scale_factor" (metres), "is_euclidean_depth"',
}
_HARMLESS_VALUES = {"opengl", "nerfstudio", "nerf", "blender", "c2w", "camera_to_world", "cam2world", "right"}
_HARMLESS_VALUES |= {"perspective", "pinhole", "srgb"}


def read_transforms(path: str | Path, allow_outside: bool = False) -> PosedImages:
    """Read a transforms file. Frames that cannot be used are listed.

    ``allow_outside``: whether images, masks and depth files outside of the folder of the file may be used, after links
    are resolved. Raises `NergError` with file and frame for malformed JSON, and if no frame can be used.
    """
    path = Path(path)
    raw = read_bytes(path, "transforms file", MAX_JSON_BYTES)
    data = _parse_json_object(path, raw)
    entries = _get_frames(data, path)
    original = _read_original(data, path)
    # Millimetres refer to the original coordinates.
    units_per_metre = 1.0 if original is None else 1 / float(np.cbrt(np.linalg.det(original[:3, :3])))
    frames, unused, notes, listed_images, moved = [], [], [], set(), []
    # Frames with equal base names in different folders must not get the same photo.
    counts = Counter(_get_base_name(f["file_path"]) for f in entries if isinstance(f, dict) and "file_path" in f)
    with_depth = any(isinstance(f, dict) and (f.get("depth_file_path") or f.get("depth_path")) for f in entries)
    unused_keys = _find_unused_file_keys(data, path, with_depth)
    shared = {k: v for k, v in data.items() if k in _SHARED_KEYS or k.startswith("ftheta")}
    finder = FileFinder(path.parent, None if allow_outside else path.parent)
    for index, entry in enumerate(entries):
        name = entry.get("file_path") if isinstance(entry, dict) else None
        if not isinstance(name, str):
            unused.append(UnusedFrame(f"frame {index}", 'it has no "file_path"'))
            continue
        try:
            image, is_moved = _find_image(finder, name, counts[_get_base_name(name)] == 1)
            listed_images.add(image)
            moved += [image] if is_moved else []
            unused_keys |= _find_unused_keys(entry, with_depth)
            frames.append(_read_frame({**shared, **entry}, entry, finder, name, image, units_per_metre, notes))
        except (ValueError, OverflowError, OSError) as e:
            # A name may be too long for the system, or contain invalid characters.
            unused.append(UnusedFrame(name, format_error(e)))
    frames, unused = sort_frames(path, frames, unused)
    held_out, unassigned = _read_splits(data, frames)
    if moved:
        folder = sanitize(moved[0].parent)
        notes.append(f'{len(moved)} photos are not where {path.name} states, but in "{folder}", and used from there')
    if unused_keys:
        notes.append(f"unused keys of {path.name}: {format_names(sorted(unused_keys), 12)}")
    return PosedImages(
        path,
        frames,
        unused,
        _read_aabb(data, path),
        hashlib.sha256(raw).hexdigest(),
        notes,
        root=path.parent,
        image_folders=frozenset(p.parent for p in listed_images),
        image_files=frozenset(listed_images),
        held_out=held_out,
        unassigned=unassigned,
        to_original=original,
    )


def read_frame_poses(path: str | Path) -> tuple[str, list[tuple[str, np.ndarray]]]:
    """Read the poses of a transforms file, whose images may be missing.

    Returns the SHA-256 of the file, and the name and the OpenGL camera-to-world pose (4, 4) of each frame. Raises
    `NergError` with file and frame for another file, and for an invalid pose.
    """
    path = Path(path)
    raw = read_bytes(path, "transforms file", MAX_JSON_BYTES)
    poses = []
    data = _parse_json_object(path, raw)
    _find_unused_file_keys(data, path, False)
    for index, entry in enumerate(_get_frames(data, path)):
        name = entry.get("file_path") if isinstance(entry, dict) else None
        if not isinstance(name, str) or "transform_matrix" not in entry:
            raise NergError(
                f'frame {index} of "{path}" has no "file_path" or no "transform_matrix"; complete or remove it'
            )
        try:
            _find_unused_keys(entry, False)
            poses.append((name, _read_pose({**{k: data.get(k) for k in _SHARED_KEYS}, **entry})))
        except NergError as error:
            raise NergError(f'frame "{sanitize(name)}" of "{path}": {error}; correct or remove it') from error
    return hashlib.sha256(raw).hexdigest(), poses


def read_dataparser(path: str | Path) -> np.ndarray:
    """Read the similarity (4, 4) of nerfstudio's ``dataparser_transforms.json``: original coordinates to trained
    ones.
    """
    path = Path(path)
    data = _parse_json_object(path, read_bytes(path, "file of nerfstudio's coordinates", MAX_JSON_BYTES))
    try:
        m, scale = np.asarray(data["transform"], np.float64), float(data["scale"])
    except (KeyError, TypeError, ValueError, OverflowError) as e:
        raise NergError(f'"{path}" needs "transform", 3 x 4 numbers, and "scale"') from e
    return _make_similarity(m, scale, f'"transform" of "{path}"', f'"scale" of "{path}"')


def _parse_json_object(path: Path, raw: bytes) -> dict:
    data = parse_json(raw, path, "transforms file")
    if not isinstance(data, dict):
        raise NergError(f'"{path}" is not a transforms file: it is not a JSON object; specify a transforms file')
    return data


def _get_frames(data: dict, path: Path) -> list:
    if not isinstance(data.get("frames"), list):
        raise NergError(f'"{path}" is not a transforms file: it has no list "frames"; specify a transforms file')
    return data["frames"]


def _find_unused_file_keys(data: dict, path: Path, with_depth: bool) -> set[str]:
    try:
        return _find_unused_keys(data, with_depth)
    except NergError as error:
        raise NergError(f'"{path}": {error}') from error


def _find_unused_keys(entry: dict, with_depth: bool) -> set[str]:
    """Return the keys of the file or of a frame that are not used. Raises `NergError` for one that changes their
    meaning.
    """
    unused = {str(k) for k in entry} - _KEYS_READ - _IGNORED_KEYS
    for key in sorted(unused):
        for pattern, remedy in _REFUSED_KEYS.items():
            if re.search(pattern, key.casefold()) and (with_depth or pattern != _DEPTH_PATTERN):
                value = entry[key]
                is_harmless = str(value).casefold() in _HARMLESS_VALUES or value == entry.get("transform_matrix", [])
                if not (is_harmless or _is_off(value)):
                    raise NergError(
                        f'the key "{sanitize(key, 60)}" with the value {sanitize(value, 60)} is not supported: {remedy}'
                    )
    return {k for k in unused if not k.startswith("ftheta")}


def _is_off(value: object) -> bool:
    """Return whether a JSON ``value`` is null, false, zero or empty, or a list of such values."""
    return all(map(_is_off, value)) if isinstance(value, list) else not value


def _read_pose(data: dict) -> np.ndarray:
    """Return the OpenGL camera-to-world pose (4, 4) of a frame."""
    pose = rigid_pose(data["transform_matrix"])
    # instant-ngp treats the presence of the second key like the first key.
    if _read_flag(data, "from_mitsuba") or data.get("normal_mts_args") is not None:
        pose = pose @ OPENGL_FROM_MITSUBA
    return pose


def _read_frame(
    data: dict, entry: dict, finder: FileFinder, name: str, image: Path, units_per_metre: float, notes: list[str]
) -> PosedFrame:
    """Read one frame. ``data``: keys of the frame, with defaults from the file."""
    if not image.is_file():
        raise NergError("its image does not exist")
    if "transform_matrix" not in entry:
        raise NergError('it has no "transform_matrix"')
    pose, lens, mask = _read_pose(data), _read_lens(data), _read_mask(entry, finder, image)
    depth = _read_depth(data, entry, finder, units_per_metre)
    if depth is not None and not depth.path.is_file():
        notes.append(
            f'"{sanitize(name)}" is used without depth: its depth file "{sanitize(depth.path)}" does not exist'
        )
        depth = None
    return PosedFrame(name, image, pose, lens, depth, mask)


def _get_base_name(name: object) -> str:
    """Return the normalised last part of the path of an image."""
    return normalize_name(str(name)).rpartition("/")[2]


def _find_image(finder: FileFinder, name: str, may_move: bool) -> tuple[Path, bool]:
    """Return the image ``name``, and whether it is in another folder.

    Blender files omit the suffix. With ``may_move`` an image that does not exist may also be next to the file or in its
    folder ``images``. If no file exists, returns the path as spelled.
    """
    outside = None
    for folder in (None, "", "images/") if may_move else (None,):
        spelled = name if folder is None else folder + name.replace("\\", "/").rpartition("/")[2]
        for suffix in ("", *_SUFFIXES):
            try:
                path = finder.find(spelled + suffix, "image")
            except NergError as error:
                # Possibly the folder of another machine, which is not accessed.
                outside = outside or error
                continue
            if path.is_file():
                return path, folder is not None
    if outside is not None:
        raise outside
    return finder.folder / name, False


def _read_mask(entry: dict, finder: FileFinder, image: Path) -> MaskFile | None:
    if entry.get("mask_path") is not None:
        mask = finder.find(_read_path(entry, "mask_path"), "mask")
        if not mask.is_file():
            raise NergError(
                f'its mask "{sanitize(entry["mask_path"])}" does not exist; restore it, or remove its "mask_path"'
            )
        return MaskFile(mask)
    dynamic = image.with_name(f"dynamic_mask_{image.stem}.png")
    return (
        MaskFile(check_inside(finder.root, dynamic, "mask"), is_inverted=True)
        if is_regular_file(dynamic, "mask")
        else None
    )


def _read_depth(data: dict, entry: dict, finder: FileFinder, units_per_metre: float) -> DepthFile | None:
    """Read the depth file of a frame. ``units_per_metre``: length of a metre in units of the file."""
    key = next((k for k in ("depth_file_path", "depth_path") if entry.get(k) is not None), None)
    if key is None or not _read_flag(data, "enable_depth_loading", True):
        return None
    path = finder.find(_read_path(entry, key), "depth file")
    if data.get("depth_unit_scale_factor") is not None:
        unit = _read_number(data, "depth_unit_scale_factor") * units_per_metre
    elif data.get("integer_depth_scale") is not None:
        unit = _read_number(data, "integer_depth_scale")
    else:
        unit = (1.0 if path.suffix.lower() == ".exr" else _MILLIMETRE) * units_per_metre
    if not 0 < unit <= MAX_POSITION:
        raise NergError("the unit of its depth file is not a positive number")
    return DepthFile(path, unit, not _read_flag(data, "is_euclidean_depth"))


def _read_flag(data: dict, key: str, default: bool = False) -> bool:
    value = data.get(key)
    if value is None:
        return default
    if value not in (True, False):
        raise NergError(f'its "{key}" must be true or false, not {sanitize(value, 60)}')
    return bool(value)


def _read_path(entry: dict, key: str) -> str:
    if not isinstance(entry[key], str):
        raise NergError(f'its "{key}" is not the path of a file')
    return entry[key]


def _read_number(data: dict, key: str) -> float:
    try:
        return float(data[key])
    except (TypeError, ValueError, OverflowError) as e:
        raise NergError(f'its "{key}" is not a number') from e


def _read_lens(data: dict) -> dict:
    model = data.get("camera_model", "OPENCV")
    fisheye = _read_flag(data, "is_fisheye") or model in _FISHEYE
    if (
        model not in _PINHOLE + _FISHEYE
        or _read_flag(data, "is_equirectangular")
        or any(str(k).startswith("ftheta") for k in data)
    ):
        raise NergError(
            f'its lens model "{sanitize(model, 60)}" is not supported; undistort the images to "OPENCV" with k1, k2, '
            "p1, "
            'p2, to "OPENCV_FISHEYE" with k1 to k4, or to "PINHOLE"'
        )
    lens = {k: _read_number(data, k) for k in LENS_KEYS if k != "fisheye" and data.get(k) is not None}
    for axis in "xy":
        if data.get(f"{axis}_fov") is not None:
            lens.setdefault(f"camera_angle_{axis}", float(np.radians(_read_number(data, f"{axis}_fov"))))
    lens |= _read_distortion(data)
    if not all(np.isfinite(v) for v in lens.values()):
        raise NergError("its intrinsics are not finite")
    if not fisheye and model != "FULL_OPENCV" and any(lens.get(k) for k in ("k4", "k5", "k6")):
        raise NergError(
            "its k4, k5, k6 have different meanings in different programs; in the transforms file, set "
            '"camera_model": "FULL_OPENCV" if they belong to OpenCV\'s rational model, or undistort the images'
        )
    return {**lens, "fisheye": 1.0} if fisheye else lens


def _read_distortion(data: dict) -> dict[str, float]:
    """Read nerfstudio's distortion_params, which take precedence over named coefficients."""
    values = data.get("distortion_params")
    if values is None:
        return {}
    if not isinstance(values, list) or len(values) != len(_DISTORTION):
        raise NergError(
            f'its "distortion_params" are not a list of {len(_DISTORTION)} numbers; list {", ".join(_DISTORTION)} in '
            "this order, or leave them out"
        )
    numbers = dict(zip(_DISTORTION, values))
    return {k: _read_number(numbers, k) for k in _DISTORTION}


def _read_original(data: dict, path: Path) -> np.ndarray | None:
    """Return the similarity from the coordinates of the file to the original ones; None if the file does not
    contain it.
    """
    if data.get("applied_transform") is None and data.get("applied_scale") is None:
        return None
    matrix, scale = data.get("applied_transform"), data.get("applied_scale")
    try:
        m = np.eye(4) if matrix is None else np.asarray(matrix, np.float64)
        scale = 1.0 if scale is None else float(scale)
    except (TypeError, ValueError, OverflowError) as e:
        raise NergError(
            f'"applied_transform" of "{path}" must be a rotation and a translation, 3 x 4 numbers, and '
            '"applied_scale" a positive number'
        ) from e
    return np.linalg.inv(_make_similarity(m, scale, f'"applied_transform" of "{path}"', f'"applied_scale" of "{path}"'))


def _make_similarity(m: np.ndarray, scale: float, matrix_name: str, scale_name: str) -> np.ndarray:
    """Return the similarity (4, 4) of a rigid transform ``m`` (3 or 4, 4) that is then scaled."""
    check_rigid_transforms(m, matrix_name)
    if not np.abs(m).max() <= MAX_POSITION:
        raise NergError(f"{matrix_name} has numbers beyond {MAX_POSITION:g}; correct it")
    if not _SCALE_RANGE[0] <= scale <= _SCALE_RANGE[1]:
        raise NergError(f"{scale_name} is {scale:g}; it must be {_SCALE_RANGE[0]:g} to {_SCALE_RANGE[1]:g}")
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = scale * nearest_rotation(m[:3, :3]), scale * m[:3, 3]
    return out


def _read_splits(data: dict, frames: list[PosedFrame]) -> tuple[list[str] | None, list[str]]:
    """Return the held-out frames and the unassigned frames by nerfstudio's lists of file names."""
    listed_names = {
        k: {normalize_name(x) for x in data[f"{k}_filenames"] if isinstance(x, str)}
        for k in ("train", "val", "test")
        if isinstance(data.get(f"{k}_filenames"), list)
    }
    if not listed_names:
        return None, []
    test = listed_names.get("test") or listed_names.get("val", set())
    train = listed_names.get("train")
    held_out = [f.name for f in frames if normalize_name(f.name) in test]
    unassigned = [
        f.name for f in frames if f.name not in held_out and train is not None and normalize_name(f.name) not in train
    ]
    return held_out, unassigned


def _read_aabb(data: dict, path: Path) -> np.ndarray | None:
    if data.get("aabb") is None:
        return None
    try:
        box = np.asarray(data["aabb"], np.float64)
    except (TypeError, ValueError, OverflowError):
        box = np.zeros(0)
    box = box.reshape(2, 3) if box.size == 6 else box
    if box.shape != (2, 3) or not np.abs(box).max() <= MAX_POSITION or not np.all(box[1] > box[0]):
        raise NergError(f'"aabb" in "{path}" must be two corners of 3 numbers, the lower corner first')
    return box
