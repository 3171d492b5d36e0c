"""Cameras of photos in the coordinates of a radiance field that was trained on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter, sanitize
from nerg_mi.maths.transforms import invert_similarity
from nerg_mi.photos.images import get_photo_size
from nerg_mi.photos.photo_set import Photos
from nerg_mi.photos.posed import PosedFrame

from .scene_writer import Lens, LookAt


@dataclass(frozen=True)
class PhotoCamera:
    """``eye`` and ``lens`` of the photo ``name``. ``has_distortion``: its lens has distortion, which is ignored."""

    name: str
    eye: LookAt
    lens: Lens
    has_distortion: bool


def load_photo_camera(
    photos: Path, photo: str, provenance: Mapping[str, Any], allow_outside: bool = False
) -> PhotoCamera:
    """Return the camera of a ``photo`` (its name, or its number from 0) of the data set ``photos``.

    ``provenance`` is that of the radiance field and defines the coordinates. Raises `NergError` for photos other than
    those of the training, and for an unknown photo.
    """
    return _camera(_frame(_posed(photos, provenance, allow_outside), photo))


def load_photo_cameras(
    photos: Path, provenance: Mapping[str, Any], allow_outside: bool = False, max_count: int = 200
) -> list[PhotoCamera]:
    """Return the cameras of at most ``max_count`` evenly selected photos, otherwise like `load_photo_camera`."""
    frames = _posed(photos, provenance, allow_outside).frames
    return [_camera(f) for f in frames[:: -(-len(frames) // max_count)]]


def _posed(photos: Path, provenance: Mapping[str, Any], allow_outside: bool) -> Photos:
    posed = Photos.load(photos, allow_outside)
    if "sha256" in provenance and provenance["sha256"] != posed.sha256:
        raise NergError(
            f'the field was not trained on "{posed.path}"; give the photos of its training with {parameter("photos")}'
        )
    if "to_file" in provenance:
        posed = posed.transform(invert_similarity(provenance["to_file"], '"to_file" of the field'))
    return posed


def _camera(frame: PosedFrame) -> PhotoCamera:
    i = frame.intrinsics(*get_photo_size(frame))
    origin = frame.to_world[:3, 3]
    # OpenGL cameras look along -z, y up.
    ahead, up = -frame.to_world[:3, 2], frame.to_world[:3, 1]
    offset = (float(0.5 - i.cx / i.width), float(0.5 - i.cy / i.height))
    taken = Lens(float(np.degrees(2 * np.arctan(i.width / (2 * i.fx)))), i.width / i.height, offset)
    return PhotoCamera(frame.name, LookAt(origin, origin + ahead, up), taken, i.is_distorted)


def _frame(posed: Photos, photo: str) -> PosedFrame:
    frames = posed.frames
    for f in frames:
        if photo in (f.name, f.image.name, f.image.stem):
            return f
    if photo.isdecimal() and int(photo) < len(frames):
        return frames[int(photo)]
    raise NergError(
        f'there is no photo "{sanitize(photo, 80)}" in "{posed.path}": give {parameter("photo")} a number from 0 '
        f'to {len(frames) - 1}, or a name such as "{sanitize(frames[0].name, 80)}"'
    )
