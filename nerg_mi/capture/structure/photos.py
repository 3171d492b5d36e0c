"""A folder of photos: which can be used, copied as they are to be looked at."""

from __future__ import annotations

import hashlib
import io
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nerg_mi.capture.posed import Unused
from nerg_mi.errors import NergError
from nerg_mi.files.atomic import write_bytes
from nerg_mi.files.bounded import plain, read_bytes, reading
from nerg_mi.files.image_header import check_image

from .pictures import Folders, Picture, encoded, small_name, small_size, write_small

SUFFIXES = (".jpg", ".jpeg", ".png")
"""Of the files that are taken for photos, in small letters."""

# Pictures that a camera writes and that are not read here: to be named, not passed over.
_OTHERS = (".heic", ".heif", ".tif", ".tiff", ".webp", ".dng", ".raw", ".cr2", ".nef", ".arw", ".avif", ".exr", ".bmp")
_ORIENTATION, _MAKE, _MODEL, _DETAILS = 0x0112, 0x010F, 0x0110, 0x8769
_FOCAL, _FOCAL_AS_35 = 0x920A, 0xA405
# The diagonal of the film of 36 x 24 mm, to which the equivalent focal length refers.
_DIAGONAL_35 = 43.267
# Modes of Pillow whose files other programs read as they are.
_KEPT = ("L", "RGB", "RGBA", "I;16")


def list_photos(folder: str | Path) -> tuple[list[Path], list[Unused]]:
    """Photos directly in ``folder``, by name, and pictures of other kinds. `NergError` where there is no photo."""
    folder = Path(folder)
    with reading(folder, "folder of photos"):
        files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    photos = [p for p in files if p.suffix.lower() in SUFFIXES]
    others = [
        Unused(p.name, "only JPEG and PNG photos are read; convert it") for p in files if p.suffix.lower() in _OTHERS
    ]
    if not photos:
        if others:
            raise NergError(
                f'"{folder}" holds {len(others)} pictures such as "{plain(others[0].name)}" but no JPEG or PNG; '
                "convert them"
            )
        below = folder / "images"
        inside = f'; did you mean "{below}"?' if below.is_dir() else "; name the folder that holds them"
        raise NergError(f'the folder "{folder}" holds no photos (.jpg, .jpeg or .png){inside}')
    return photos, others


def copy_photos(
    photos: list[Path], folders: Folders, longest: int, progress: Callable[[int, int], None]
) -> tuple[list[Picture], list[Unused]]:
    """Copy each of the ``photos`` to ``folders``, turned as its EXIF orientation says, and those that cannot be used.

    A photo that stands upright as it is stored is copied byte for byte; another is stored anew, a JPEG at quality 95, a
    PNG in 8 bits. ``longest``: side of the small copies in pixels. ``progress(done, of)`` is told after each.
    """
    pictures: list[Picture] = []
    unused: list[Unused] = []
    seen: dict[str, str] = {}
    for k, path in enumerate(photos):
        try:
            raw = read_bytes(path, "photo")
            check_image(path, "photo")
            before = seen.setdefault(hashlib.sha256(raw).hexdigest(), path.name)
            if before != path.name:
                raise NergError(f'it is the same file as "{before}"')
            pictures.append(_copied(path, raw, folders, len(pictures), longest))
        except NergError as error:
            unused.append(Unused(path.name, str(error)))
        progress(k + 1, len(photos))
    return pictures, unused


def _copied(path: Path, raw: bytes, folders: Folders, index: int, longest: int) -> Picture:
    image, orientation, made_by, as_35 = _opened(path, raw)
    stays = orientation in (0, 1) and image.mode in _KEPT
    write_bytes(folders.images / path.name, raw if stays else encoded(image, path.suffix))
    size = (image.width, image.height)
    small = small_size(size, longest)
    write_small(folders.small / small_name(index), image, small)
    focal = as_35 / _DIAGONAL_35 * float((size[0] ** 2 + size[1] ** 2) ** 0.5) if as_35 else None
    return Picture(path.name, size, small, made_by, focal)


def _opened(path: str | os.PathLike, raw: bytes) -> tuple[Any, int, tuple, float | None]:
    """The photo as it is to be looked at, the EXIF orientation of what is stored, what is told of its camera, and its
    focal length in terms of film of 36 x 24 mm."""
    from PIL import Image, ImageOps

    with warnings.catch_warnings(), reading(path, "photo", also=(Image.DecompressionBombError,)):
        # Its size was checked before, and what is odd about its notes does not matter.
        warnings.simplefilter("ignore")
        image = Image.open(io.BytesIO(raw), formats=("JPEG", "PNG"))
        image.load()
        try:
            notes = image.getexif()
            details = notes.get_ifd(_DETAILS)
            orientation = int(notes.get(_ORIENTATION, 1))
            made_by = (*(str(notes.get(k, "")) for k in (_MAKE, _MODEL)), str(details.get(_FOCAL, "")))
            as_35 = float(details.get(_FOCAL_AS_35, 0))
        except Exception:  # Pillow raises many kinds on damaged notes, without which a photo is as good
            return image, 1, (), None
        return ImageOps.exif_transpose(image), orientation, made_by, as_35 if 5 <= as_35 <= 2000 else None
