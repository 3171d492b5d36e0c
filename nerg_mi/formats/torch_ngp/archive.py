"""The zip archive that ``torch.save`` writes, and the tensors in it, read when they are asked for."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import open_zip, plain, read_member, reading

EXPANDED = 1 << 20
"""So many numbers may a tensor have that repeats those of its storage."""


class TorchArchive:
    """Records of a file of ``torch.save``, each read when it is asked for."""

    def __init__(self, path: Path):
        self.path = path
        with open_zip(path, "checkpoint") as archive:
            names = archive.namelist()
        found = [n for n in names if n.endswith("/data.pkl")]
        if len(found) != 1:
            raise NergError(
                f'"{path}" is a zip archive, but not one that torch.save wrote (no data.pkl); name one of those'
            )
        self._folder = found[0][: -len("data.pkl")]
        if f"{self._folder}byteorder" in names and self.record("byteorder") != b"little":
            raise NergError(f'"{path}" was written on a big-endian machine; save it again on another')

    def record(self, name: str, most: int | None = None) -> bytearray:
        with open_zip(self.path, "checkpoint") as archive:
            if self._folder + name not in archive.namelist():
                raise NergError(f'"{self.path}" lacks its record "{name}": the file is incomplete; copy it again')
            size = archive.getinfo(self._folder + name).file_size
            if most is not None and size > most:
                raise NergError(
                    f'the record "{name}" of "{self.path}" has {size:,} bytes, more than the {most:,} that are read'
                )
            return read_member(archive, self._folder + name, self.path, "checkpoint")


class StoredTensor:
    """A tensor in the archive, of ``shape``; ``numpy()`` reads it."""

    __slots__ = ("_archive", "_dtype", "_key", "_offset", "_stride", "shape")

    def __init__(self, key: str, dtype: str, offset: int, shape: tuple, stride: tuple):
        # The archive is given once all of the pickle is read.
        self._archive: TorchArchive | None = None
        self._key, self._dtype, self._offset, self.shape, self._stride = key, dtype, offset, shape, stride

    def numpy(self) -> np.ndarray:
        """The values, (``shape``); bfloat16 becomes float32. Raises `NergError` when the file does not hold them
        all.
        """
        if self._archive is None:
            raise RuntimeError("a tensor is read before its archive is known")
        path = self._archive.path
        raw = self._archive.record(f"data/{self._key}")
        with reading(path, "checkpoint"):
            flat = np.frombuffer(raw, "<u2" if self._dtype == "bfloat16" else self._dtype)
        if self._dtype == "bfloat16":
            flat = (flat.astype(np.uint32) << 16).view(np.float32)
        if math.prod(self.shape) == 0:
            with reading(path, "checkpoint"):
                return np.zeros(self.shape, flat.dtype)
        # A stride counts only where there is more than one.
        stride = [s if n > 1 else 0 for n, s in zip(self.shape, self._stride)]
        last = self._offset + sum((n - 1) * s for n, s in zip(self.shape, stride))
        if last >= len(flat) or math.prod(self.shape) > max(len(flat), EXPANDED):
            raise NergError(
                f'a tensor of "{path}" of shape {plain(self.shape)} lies outside of its storage of {len(flat)} '
                "numbers; copy the file again"
            )
        strides = [s * flat.itemsize for s in stride]
        with reading(path, "checkpoint"):
            return np.lib.stride_tricks.as_strided(flat[self._offset :], self.shape, strides, writeable=False).copy()
