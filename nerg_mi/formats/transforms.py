"""Posed image sets as instant-ngp, nerfstudio and the Blender NeRF scenes write them: ``transforms.json``.

Poses are OpenGL camera-to-world matrices (x right, y up, z back) in the data set's own
coordinates and units; nothing is re-centred, scaled or turned here.
"""
from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .intrinsics import Intrinsics

_SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".PNG", ".JPG", ".JPEG")
# Keys that may stand at the top of the file or in a frame, the frame's own counting.
_LENS_KEYS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "camera_angle_x", "camera_angle_y")
_UNKNOWN_LENSES = ("k3", "k4", "k5", "k6")


@dataclass(frozen=True)
class Frame:
    """One posed image. ``name``: its path as the file spells it; ``to_world``: (4, 4) OpenGL
    camera-to-world; ``depth``: file of distances along the rays, or None; ``lens``: its camera keys."""

    name: str
    image: Path
    depth: Path | None
    to_world: np.ndarray
    lens: dict

    def intrinsics(self, width: int, height: int) -> Intrinsics:
        """Intrinsics for this frame's image, whose file has ``width`` x ``height`` pixels.

        Focal lengths in pixels (``fl_x``) are preferred to angles, which some writers round.
        Raises ``ValueError`` when the file gives neither, or another shape than the image's.
        """
        lens = self.lens
        w, h = lens.get("w", width), lens.get("h", height)
        if abs(w * height - h * width) > 0.01 * h * width:
            raise ValueError(
                f'the image "{self.image}" has {width} x {height} pixels but its transforms file says {w:g} x {h:g}; '
                'correct "w" and "h", or the image'
            )
        fx, fy = lens.get("fl_x"), lens.get("fl_y")
        if fx is None and "camera_angle_x" in lens:
            fx = w / (2 * np.tan(lens["camera_angle_x"] / 2))
        if fy is None and "camera_angle_y" in lens:
            fy = h / (2 * np.tan(lens["camera_angle_y"] / 2))
        # One focal length means square pixels.
        fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
        if fx is None or not (np.isfinite(fx) and fx > 0 and np.isfinite(fy) and fy > 0):
            raise ValueError(
                f'frame "{self.name}" has no usable focal length; give "fl_x" in pixels or "camera_angle_x" in radians'
            )
        stated = Intrinsics(
            w, h, float(fx), float(fy), lens.get("cx", w / 2), lens.get("cy", h / 2),
            *(lens.get(k, 0.0) for k in ("k1", "k2", "p1", "p2")),
        )
        return stated.resized(width, height)


@dataclass(frozen=True)
class Transforms:
    """What a transforms file says about the frames whose images exist, sorted by file name.

    ``missing``: names of the listed images that do not exist; ``aabb``: (2, 3) scene box from the
    file, or None; ``sha256``: of the file itself, for provenance.
    """

    path: Path
    frames: list[Frame]
    missing: list[str]
    aabb: np.ndarray | None
    sha256: str


def find_transforms(dataset: str | Path) -> Path:
    """The transforms file of ``dataset``, a folder or the file itself."""
    dataset = Path(dataset)
    if dataset.is_file():
        return dataset
    for name in ("transforms.json", "transforms_train.json"):
        if (dataset / name).is_file():
            return dataset / name
    raise FileNotFoundError(
        f'"{dataset}" holds neither transforms.json nor transforms_train.json; name the folder of a posed image set'
    )


def read_transforms(path: str | Path) -> Transforms:
    """Read a transforms file. Images that do not exist are listed, not fatal.

    Raises ``ValueError``, naming file and frame, for what cannot be used: malformed JSON, poses that
    are not rigid, lenses of unknown models, or not a single existing image.
    """
    path = find_transforms(path)
    raw = path.read_bytes()
    try:
        data = json.loads(raw)
    except ValueError as e:
        raise ValueError(f'"{path}" is not valid JSON: {e}') from e
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list):
        raise ValueError(f'"{path}" is not a transforms file: it has no list "frames"')

    frames, missing = [], []
    for index, entry in enumerate(data["frames"]):
        name = entry.get("file_path")
        if not isinstance(name, str):
            raise ValueError(f'frame {index} of "{path}" has no "file_path"')
        image = _image_file(path.parent / name)
        if image is None:
            missing.append(name)
            continue
        frames.append(Frame(name, image, _depth_file(entry, path, name), _pose(entry, path, name),
                            _lens({**data, **entry}, path, name)))
    if not frames:
        raise ValueError(f'none of the {len(missing)} images that "{path}" lists exists, the first being "{missing[:1]}"')
    frames.sort(key=lambda f: f.name)
    return Transforms(path, frames, sorted(missing), _aabb(data, path), hashlib.sha256(raw).hexdigest())


def _image_file(path: Path) -> Path | None:
    """The image at ``path``, whose suffix Blender-style files leave out; None when there is none."""
    for candidate in (path, *(path.with_name(path.name + s) for s in _SUFFIXES)):
        if candidate.is_file():
            return candidate
    return None


def _depth_file(entry: dict, path: Path, name: str) -> Path | None:
    if "depth_file_path" not in entry:
        return None
    depth = path.parent / entry["depth_file_path"]
    if not depth.is_file():
        raise ValueError(
            f'the depth file "{entry["depth_file_path"]}" of frame "{name}" in "{path}" does not exist; '
            'restore it, or remove its "depth_file_path"'
        )
    return depth


def _pose(entry: dict, path: Path, name: str) -> np.ndarray:
    where = f'frame "{name}" of "{path}"'
    try:
        pose = np.asarray(entry["transform_matrix"], np.float64)
    except (KeyError, TypeError, ValueError) as e:
        raise ValueError(f'{where} needs a "transform_matrix" of 4 x 4 numbers') from e
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
        raise ValueError(f'{where} needs a "transform_matrix" of 4 x 4 finite numbers')
    rotation = pose[:3, :3]
    scale = np.cbrt(np.linalg.det(rotation))
    if scale <= 0 or np.abs(rotation @ rotation.T / scale**2 - np.eye(3)).max() > 1e-2:
        raise ValueError(f"the pose of {where} is not a rotation and a translation (mirrored, sheared or singular)")
    # Some writers leave a scale in the rotation, or round it: the nearest rotation is what they meant.
    u, _, vt = np.linalg.svd(rotation)
    pose = pose.copy()
    pose[:3, :3] = u @ vt
    return pose


def _lens(data: dict, path: Path, name: str) -> dict:
    model = data.get("camera_model", "OPENCV")
    unknown = [k for k in _UNKNOWN_LENSES if data.get(k)]
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") or data.get("is_fisheye") or unknown:
        said = f"coefficients {', '.join(unknown)}" if unknown else f'"{"fisheye" if data.get("is_fisheye") else model}"'
        raise ValueError(
            f'frame "{name}" of "{path}" has a lens of unsupported model ({said}); undistort the images to '
            '"OPENCV" with k1, k2, p1, p2 or to "PINHOLE"'
        )
    lens = {}
    for key in _LENS_KEYS:
        if data.get(key) is not None:
            lens[key] = float(data[key])
    return lens


def _aabb(data: dict, path: Path) -> np.ndarray | None:
    if data.get("aabb") is None:
        return None
    box = np.asarray(data["aabb"], np.float64)
    box = box.reshape(2, 3) if box.size == 6 else box
    if box.shape != (2, 3) or not np.all(np.isfinite(box)) or not np.all(box[1] > box[0]):
        raise ValueError(f'"aabb" in "{path}" must be two corners of 3 numbers, the second above the first')
    return box
