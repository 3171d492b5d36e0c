"""Pictures as structure from motion takes them: upright copies for the capture, small ones to find features in."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SIDE = 65_500
"""Longest side of a picture in pixels: that of a JPEG file."""

# As good as telephones write them; colours are not stored more coarsely than brightness.
_JPEG = dict(format="JPEG", quality=95, subsampling=0)


@dataclass(frozen=True)
class Picture:
    """A picture of the capture. ``name``: its file in ``images/``; ``size``, ``small``: width and height of it and of
    the copy that features are found in, in pixels; ``made_by``: what else pictures of one camera have in common (its
    maker, model and focal length, as far as it is told); ``focal``: focal length in pixels of ``size``, None where it
    is not known; ``seconds``: when a video showed it."""

    name: str
    size: tuple[int, int]
    small: tuple[int, int]
    made_by: tuple = ()
    focal: float | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class Folders:
    """Where copies go: ``images`` of the capture, and ``small``, whose files are called by `small_name`."""

    images: Path
    small: Path


def small_name(index: int) -> str:
    """File of the small copy of the so-many-th picture: no letter of its own name can be in the way of COLMAP."""
    return f"{index:06d}.png"


def small_size(size: tuple[int, int], longest: int) -> tuple[int, int]:
    """``size`` with a longer side of at most ``longest`` pixels."""
    factor = min(1.0, longest / max(size))
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def encoded(image: Any, suffix: str) -> bytes:
    """A Pillow image as the bytes of a PNG or JPEG file, by its ``suffix``."""
    out = io.BytesIO()
    _rgb(image).save(out, **(dict(format="PNG") if suffix.lower() == ".png" else _JPEG))
    return out.getvalue()


def _rgb(image: Any) -> Any:
    # Pillow copies a picture that is RGB already.
    return image if image.mode == "RGB" else image.convert("RGB")


def shrunk(image: Any, size: tuple[int, int]) -> bytes:
    """A Pillow image at ``size``, by averaging, as the bytes of a PNG file."""
    from PIL import Image

    out = io.BytesIO()
    small = _rgb(image)
    if small.size != size:
        small = small.resize(size, Image.Resampling.LANCZOS)
    small.save(out, format="PNG", compress_level=1)
    return out.getvalue()


def cameras_of(pictures: Iterable[Picture], share: bool = True) -> list[int]:
    """Number, from 0, of the camera of each picture: those of equal size, maker, model and focal length ``share`` one.

    A telephone held upright and held across has two: each with its principal point at the centre of its pictures.
    """
    found: dict[object, int] = {}
    return [
        found.setdefault((p.size, p.made_by) if share else k, len(found) if share else k)
        for k, p in enumerate(pictures)
    ]
