"""OpenEXR files, written and read by the OpenEXR library.

Mitsuba's own reader brings an older copy of that library, in which overflows are known; its own writer shares Dr.Jit's
thread pool and waits for ever where that has one thread.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..errors import NergError
from .atomic import replacing
from .bounded import reading
from .image_header import check_image


def write_exr(path: str | os.PathLike, channels: Mapping[str, np.ndarray], attributes: Mapping[str, str] | None = None) -> None:
    """Write ``channels`` as a single-part scanline file, compressed without loss, whole or not at all.

    ``channels``: name, such as ``R`` or ``depth.T``, to an array (h, w) of float32, float16 or uint32; rows from the top.
    ``attributes``: text for the header. Raises `NergError` where the file cannot be written.
    """
    import OpenEXR

    names = {"compression", "type", "channels", "dataWindow", "displayWindow", "lineOrder", "screenWindowCenter", "screenWindowWidth"}
    taken = names & set(attributes or {})
    if taken:
        raise ValueError(f"the attributes {', '.join(sorted(taken))} belong to the format; give them other names")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **{k: str(v) for k, v in (attributes or {}).items()}}
    data = {name: np.ascontiguousarray(value) for name, value in channels.items()}
    with replacing(path) as temporary:
        try:
            with OpenEXR.File(header, data) as file:
                file.write(str(temporary))
        except RuntimeError as error:
            if os.strerror(errno.ENOSPC) in str(error):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from error
            raise NergError(f'"{path}" could not be written ({str(error).strip()}); choose another name or folder.') from error


def read_exr(path: str | os.PathLike, what: str = "image") -> dict[str, np.ndarray]:
    """The channels of the first part of an EXR file, arrays (h, w) by name: colours before all others of their layer (R, G,
    B, X, Y, Z, A), the rest by name.

    The size is checked in the header first. Raises `NergError` for what is damaged, too large, or stores its colours as
    luminance and two differences.
    """
    import OpenEXR

    check_image(path, what)
    # The library says so of whatever it finds wrong.
    with reading(path, what, also=(RuntimeError, TypeError)), OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.ascontiguousarray(channel.pixels) for name, channel in file.channels().items()}
    if {"RY", "BY"} <= set(channels):
        raise NergError(f'the {what} "{path}" stores luminance and colour differences (RY, BY); save it with R, G and B')
    if len({c.shape for c in channels.values()}) != 1 or any(c.ndim != 2 for c in channels.values()):
        raise NergError(f'the {what} "{path}" has channels of different sizes; save it with one value a pixel in each')
    return {name: channels[name] for name in sorted(channels, key=_channel_order)}


def _channel_order(name: str) -> str:
    """What names are sorted by, so that the colours of a layer come in the order that Mitsuba gives them."""
    layer, dot, last = name.rpartition(".")
    place = "rgbxyza".find(last.lower()) if len(last) == 1 else -1
    return name if place < 0 else f"{layer}{dot}{place}"


def bitmap_channels(bitmap) -> dict[str, np.ndarray]:
    """The channels of a Mitsuba bitmap as float32 arrays (h, w), by the names that it gives them."""
    import mitsuba as mi

    if bitmap.component_format() != mi.Struct.Type.Float32:
        bitmap = bitmap.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)
    values = np.array(bitmap)
    values = values[..., None] if values.ndim == 2 else values
    return {field.name: values[..., k] for k, field in enumerate(bitmap.struct_())}


def write_bitmap_exr(path: str | Path, bitmap) -> None:
    """Write a Mitsuba bitmap with all of its channels, as float32, and the text of its metadata."""
    attributes = {key: value for key, value in bitmap.metadata().items() if isinstance(value, (str, int, float))}
    write_exr(path, bitmap_channels(bitmap), {k: str(v) for k, v in attributes.items()})
