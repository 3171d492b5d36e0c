"""OpenEXR files, written by the OpenEXR library.

Mitsuba's own writer shares Dr.Jit's thread pool and waits for ever where that has one thread.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..errors import NergError
from .atomic import replacing


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
