"""The cameras of photos that a radiance field was trained on, in the field's coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError, plain
from nerg_mi.photos.images import find_source, read_photo, read_posed
from nerg_mi.photos.posed import Frame, PosedImages
from nerg_mi.rendering.scene_writer import Eye, Lens


@dataclass(frozen=True)
class PhotoCamera:
    """``eye`` and ``lens`` of the photo ``name``; ``bent``: whether its lens distorts, which no such camera does."""

    name: str
    eye: Eye
    lens: Lens
    bent: bool


def camera_of_photo(photos: Path, photo: str, provenance: dict, allow_outside: bool = False) -> PhotoCamera:
    """The camera of the ``photo`` (its name, or its number from 0 on) of the data set ``photos``.

    ``provenance``: of the radiance field, which says in which coordinates it was trained. Raises `NergError` for
    photos that it was not trained on and for one that is not among them.
    """
    return _camera(_frame(_posed(photos, provenance, allow_outside), photo))


def cameras_of_photos(
    photos: Path, provenance: dict, allow_outside: bool = False, most: int = 200
) -> list[PhotoCamera]:
    """The cameras of the data set ``photos``, of ``most`` of them at most, evenly chosen; otherwise as
    `camera_of_photo`."""
    frames = _posed(photos, provenance, allow_outside).frames
    return [_camera(f) for f in frames[:: -(-len(frames) // most)]]


def _posed(photos: Path, provenance: dict, allow_outside: bool) -> PosedImages:
    posed = read_posed(find_source(photos), allow_outside)
    if "sha256" in provenance and provenance["sha256"] != posed.sha256:
        raise NergError(f'"{posed.path}" is not what the field was trained on; give those photos with --photos')
    if "to_file" in provenance:
        posed = posed.moved(np.linalg.inv(np.asarray(provenance["to_file"], np.float64)))
    return posed


def _camera(frame: Frame) -> PhotoCamera:
    lens = frame.lens
    size = (round(lens["w"]), round(lens["h"])) if "w" in lens and "h" in lens else _size(frame)
    i = frame.intrinsics(*size)
    origin = frame.to_world[:3, 3]
    # OpenGL cameras look along -z, with y up.
    ahead, up = -frame.to_world[:3, 2], frame.to_world[:3, 1]
    offset = (float(0.5 - i.cx / i.width), float(0.5 - i.cy / i.height))
    taken = Lens(float(np.degrees(2 * np.arctan(i.width / (2 * i.fx)))), i.width / i.height, offset)
    return PhotoCamera(frame.name, Eye(origin, origin + ahead, up), taken, i.is_distorted)


def _size(frame: Frame) -> tuple[int, int]:
    height, width = read_photo(frame).shape[:2]
    return width, height


def _frame(posed: PosedImages, photo: str) -> Frame:
    frames = posed.frames
    for f in frames:
        if photo in (f.name, f.image.name, f.image.stem):
            return f
    if photo.isdecimal() and int(photo) < len(frames):
        return frames[int(photo)]
    raise NergError(
        f'there is no photo "{plain(photo, 80)}" in "{posed.path}": give --photo a number from 0 to {len(frames) - 1}, '
        f'or a name such as "{plain(frames[0].name, 80)}"'
    )
