"""A folder of photos: which can be used, copied as they are to be looked at."""

from __future__ import annotations

import hashlib
import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerg_mi.capture.posed import Unused, inside
from nerg_mi.errors import NergError
from nerg_mi.files.atomic import write_bytes
from nerg_mi.files.bounded import plain, read_bytes, reading
from nerg_mi.files.image_header import check_image

from .pictures import SIDE, Folders, Picture, encoded, shrunk, small_name, small_size

SUFFIXES = (".jpg", ".jpeg", ".png")
"""Of the files that are taken for photos, in small letters."""

# Pictures that a camera writes and that are not read here: to be named, not passed over.
_OTHERS = (".heic", ".heif", ".tif", ".tiff", ".webp", ".dng", ".raw", ".cr2", ".nef", ".arw", ".avif", ".exr", ".bmp")
_ORIENTATION, _MAKE, _MODEL, _DETAILS = 0x0112, 0x010F, 0x0110, 0x8769
_FOCAL, _FOCAL_AS_35 = 0x920A, 0xA405
# The diagonal of the film of 36 x 24 mm, to which the equivalent focal length refers.
_DIAGONAL_35 = 43.267
# So many pixels a photo may have that its bytes do not warrant, and so many bytes: those of large panoramas.
_PIXELS, _BYTES = 1 << 26, 1 << 28
# EXIF orientation -> what makes it upright, as Pillow calls it.
_TURNS = dict(
    zip(range(2, 9), "FLIP_LEFT_RIGHT ROTATE_180 FLIP_TOP_BOTTOM TRANSPOSE ROTATE_270 TRANSVERSE ROTATE_90".split())
)
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
        hint = f'; did you mean "{below}"?' if below.is_dir() else "; name the folder that holds them"
        raise NergError(f'the folder "{folder}" holds no photos (.jpg, .jpeg or .png){hint}')
    return photos, others


def copy_photos(
    photos: list[Path],
    folders: Folders,
    longest: int,
    progress: Callable[[int, int], None],
    allow_outside: bool = False,
) -> tuple[list[Picture], list[Unused]]:
    """Copy each of the ``photos`` to ``folders``, turned as its EXIF orientation says, and those that cannot be used.

    A photo that stands upright as it is stored is copied byte for byte; another is stored anew, a JPEG at quality 95, a
    PNG in 8 bits. ``longest``: side of the small copies in pixels. ``progress(done, of)`` is told after each.
    ``allow_outside``: follow links that lead out of the photos' folder.
    """
    pictures: list[Picture] = []
    unused: list[Unused] = []
    seen: dict[str, str] = {}
    for k, path in enumerate(photos):
        try:
            if not path.name.isprintable():
                raise NergError("its name holds what is no character, which COLMAP cannot store; rename it")
            pictures.append(_copied(path, folders, len(pictures), longest, seen, allow_outside))
        except NergError as error:
            unused.append(Unused(path.name, str(error)))
        progress(k + 1, len(photos))
    return pictures, unused


def _copied(
    path: Path, folders: Folders, index: int, longest: int, seen: dict[str, str], allow_outside: bool
) -> Picture:
    """``seen``: names of the photos before by their content, to which this one is added."""
    photo = read_photo(path if allow_outside else inside(path.parent, path, "photo"))
    image, name = photo.image, path.name
    before = seen.setdefault(hashlib.sha256(photo.raw).hexdigest(), name)
    if before != name:
        raise NergError(f'it is the same file as "{before}"')
    write_bytes(folders.images / name, photo.raw if photo.stays else encoded(image, path.suffix))
    size = (image.width, image.height)
    small = small_size(size, longest)
    write_bytes(folders.small / small_name(index), shrunk(image, small))
    focal = photo.as_35 / _DIAGONAL_35 * float((size[0] ** 2 + size[1] ** 2) ** 0.5) if photo.as_35 else None
    return Picture(name, size, small, photo.made_by, focal)


@dataclass(frozen=True)
class Photo:
    """``raw``: the bytes of the file; ``image``: of Pillow, as it is to be looked at; ``stays``: whether that
    is how it is stored; ``made_by``: what its notes tell of its camera; ``as_35``: its focal length in terms of film of
    36 x 24 mm."""

    raw: bytes
    image: Any
    stays: bool
    made_by: tuple = ()
    as_35: float | None = None


def read_photo(path: Path) -> Photo:
    """The photo ``path``; `NergError` for what is none, is damaged, or claims more pixels than its bytes warrant."""
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile

    # Pillow takes four bytes a pixel, and as many again to turn it.
    header = check_image(path, "photo", _PIXELS, _BYTES)
    kind = header.kind
    if max(header.size) > SIDE:
        raise NergError(f'the photo "{path}" has a side of {max(header.size):,} pixels, more than {SIDE:,}; cut it')
    if kind not in ("jpeg", "png"):
        raise NergError(f'the photo "{path}" is of the kind "{kind}", whatever its name; convert it to JPEG or PNG')
    raw = read_bytes(path, "photo", _BYTES)
    with warnings.catch_warnings(), reading(path, "photo"):
        # What is odd about its notes does not matter.
        warnings.simplefilter("ignore")
        # Not by Image.open, which has a limit of its own, below what telephones take by now.
        image = (JpegImageFile if kind == "jpeg" else PngImageFile)(io.BytesIO(raw))
        image.load()
        orientation, made_by, as_35 = _notes(image)
        turn = _TURNS.get(orientation)
        upright = image if turn is None else image.transpose(_transpose(turn))
    return Photo(raw, upright, turn is None and image.mode in _KEPT, made_by, as_35)


def _notes(image: Any) -> tuple[int, tuple, float | None]:
    """The EXIF orientation, what is told of the camera, and the focal length in terms of film of 36 x 24 mm."""
    try:
        notes = image.getexif()
        details = notes.get_ifd(_DETAILS)
        orientation = int(notes.get(_ORIENTATION, 1))
        made_by = (*(str(notes.get(k, "")) for k in (_MAKE, _MODEL)), str(details.get(_FOCAL, "")))
        as_35 = float(details.get(_FOCAL_AS_35, 0))
    except Exception:  # Pillow raises many kinds on damaged notes, without which a photo is as good
        return 1, (), None
    return orientation, made_by, as_35 if 5 <= as_35 <= 2000 else None


def _transpose(name: str) -> Any:
    from PIL import Image

    return Image.Transpose[name]
