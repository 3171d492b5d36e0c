"""NumPy's files, .npy and .npz: what a header claims is compared with the bytes that are there before an array is
made.
"""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from nerg_mi.errors import NergError

from .bounded import plain, reading, size_of
from .inflating import member_into, open_member, open_zip

HEADER_BYTES = 10_000
"""The header of an array may have so many bytes."""


class Npz:
    """The arrays of an open .npz archive, each read when it is asked for.

    ``names``: of the arrays. ``archive[name]`` raises `KeyError` for a name that is not among them, and `NergError` for
    an array that is damaged or holds Python objects.
    """

    def __init__(self, archive: zipfile.ZipFile, path: str | os.PathLike, what: str):
        self._archive, self._path, self._what = archive, path, what
        self._members = {n.removesuffix(".npy"): n for n in archive.namelist()}

    @property
    def names(self) -> list[str]:
        return list(self._members)

    def __contains__(self, name: str) -> bool:
        return name in self._members

    def __getitem__(self, name: str) -> np.ndarray:
        """The array ``name``."""
        member, what = self._members[name], f'array "{plain(name)}" of the {self._what}'
        stream, size = open_member(self._archive, member, self._path, self._what)
        with stream:
            return _array(stream, size, self._path, what)

    def about(self, name: str) -> tuple[tuple[int, ...], np.dtype]:
        """Shape and type of the array ``name``, from its header."""
        member, what = self._members[name], f'array "{plain(name)}" of the {self._what}'
        stream, size = open_member(self._archive, member, self._path, self._what)
        with stream:
            shape, _, dtype = _header(stream, size, self._path, what)
        return shape, dtype


@contextmanager
def open_npz(path: str | os.PathLike, what: str = "file", most: int | None = None) -> Iterator[Npz]:
    """The arrays of the .npz archive ``path``; `NergError` for one that is damaged, or inflates to more than ``most``
    bytes (default: `inflating.inflated_limit`)."""
    with open_zip(path, what, most) as archive:
        yield Npz(archive, path, what)


def read_npz(path: str | os.PathLike, what: str = "file", most: int | None = None) -> dict[str, np.ndarray]:
    """All arrays of the .npz archive ``path`` by name; see `open_npz`."""
    with open_npz(path, what, most) as archive:
        return {name: archive[name] for name in archive.names}


def read_npy(path: str | os.PathLike, what: str = "file") -> np.ndarray:
    """The array in the .npy file ``path``. `NergError` for one that is damaged, claims more than the file holds, or
    holds Python objects, which only running code could make."""
    size = size_of(path, what)
    with reading(path, what):
        stream = open(path, "rb")
    with stream:
        return _array(stream, size, path, what)


def _array(stream, size: int, path, what: str) -> np.ndarray:
    shape, columns_first, dtype = _header(stream, size, path, what)
    with reading(path, what):
        out = np.empty(math.prod(shape), dtype)
        if out.size:
            member_into(stream, out.view(np.uint8).data, path, what)
        return out.reshape(shape[::-1]).T if columns_first else out.reshape(shape)


def _header(stream, size: int, path, what: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether the first index runs fastest, and type; the stream then stands at the first number."""
    with reading(path, what, also=(TypeError,)):
        version = np.lib.format.read_magic(stream)
        read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}.get(version)
        if read is None:
            raise NergError(
                f'the {what} "{path}" is of version {version[0]}.{version[1]} of the format, and 1.0 and 2.0 are read; '
                "write it again with numpy.save"
            )
        shape, columns_first, dtype = read(stream, max_header_size=HEADER_BYTES)
        taken = stream.tell()
    if dtype.hasobject:
        raise NergError(
            f'the {what} "{path}" holds Python objects, which are not read: they can run code; save it as numbers'
        )
    if any(n < 0 for n in shape) or len(shape) > 32 or (dtype.itemsize == 0 and math.prod(shape)):
        raise NergError(
            f'the {what} "{path}" claims the shape {plain(shape)} of {plain(dtype)}, which is none; make it anew'
        )
    need, there = math.prod(shape) * dtype.itemsize, size - taken
    if need > there:
        raise NergError(
            f'the {what} "{path}" claims the shape {plain(shape)} of {plain(dtype)}, {need:,} bytes, '
            f"and has {there:,}; copy it again, or make it anew"
        )
    return shape, columns_first, dtype
