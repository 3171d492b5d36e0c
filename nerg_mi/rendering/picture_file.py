"""Picture files that are written from the top in pieces: .exr with all channels of a film, .png with its colour."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from nerg_mi.files.atomic import check_writable, replacing
from nerg_mi.files.images import bitmap_channels, encode_png, exr_rows

FORMATS = (".exr", ".png")

_DITHER = 256
"""Rows after which the pattern repeats that Mitsuba adds where it rounds to 8 bits."""


@contextmanager
def picture_rows(
    path: str | Path, width: int, height: int, text: Mapping[str, str] | None = None
) -> Iterator[Callable[[object, int], None]]:
    """A picture file of ``width`` x ``height`` pixels, whole or absent.

    Gives a function that writes the next rows: the first ``rows`` of a Mitsuba bitmap. Float32 in .exr, tonemapped to
    sRGB in .png. ``text``: what the header says, by PNG's names.
    """
    check_writable(path, *FORMATS)
    if Path(path).suffix.lower() == ".exr":
        with exr_rows(path, width, height, text) as write:
            yield lambda bitmap, rows: write({name: values[:rows] for name, values in bitmap_channels(bitmap).items()})
        return
    # Opened first, so that a folder that cannot be written to is found before anything is rendered.
    with replacing(path) as temporary:
        display = DisplayRows(width, height)
        yield display.add
        temporary.write_bytes(encode_png(display.bitmap(), text))


class DisplayRows:
    """The colour of a picture of ``width`` x ``height`` pixels in 8 bits, tonemapped to sRGB, put together from the
    top."""

    def __init__(self, width: int, height: int):
        self._pixels, self._done = np.empty((height, width, 3), np.uint8), 0
        self._waiting, self._format = [], None

    def add(self, bitmap, rows: int) -> None:
        """Add the first ``rows`` of a Mitsuba bitmap."""
        import mitsuba as mi

        # With AOVs the bitmap has many channels, of which the colour is the layer without a name.
        if bitmap.pixel_format() == mi.Bitmap.PixelFormat.MultiChannel:
            bitmap = dict(bitmap.split())["<root>"]
        self._format = bitmap.pixel_format()
        self._waiting.append(np.array(bitmap)[:rows])
        known = sum(len(part) for part in self._waiting)
        ready = known if self._done + known == len(self._pixels) else known // _DITHER * _DITHER
        if ready:
            values = np.concatenate(self._waiting)
            self._convert(values[:ready])
            self._waiting = [values[ready:].copy()]

    def _convert(self, values: np.ndarray) -> None:
        import mitsuba as mi

        bitmap = mi.Bitmap(values, pixel_format=self._format).convert(
            mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True
        )
        self._pixels[self._done : self._done + len(values)] = np.array(bitmap)
        self._done += len(values)

    def bitmap(self):
        """All of it as a Mitsuba bitmap. Raises ``ValueError`` while rows are missing."""
        import mitsuba as mi

        return mi.Bitmap(self.pixels())

    def pixels(self) -> np.ndarray:
        """All of it (height, width, 3), uint8. Raises ``ValueError`` while rows are missing."""
        if self._done != len(self._pixels):
            raise ValueError(f"{self._done} of {len(self._pixels)} rows were written")
        return self._pixels
