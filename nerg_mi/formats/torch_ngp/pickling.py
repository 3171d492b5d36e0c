"""Writes dictionaries of arrays as ``torch.save`` does, without torch: ``torch.load(weights_only=True)`` reads them."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

import numpy as np

from nerg_mi.files.atomic import replacing

_STORAGE = {
    "<f4": "FloatStorage",
    "<f2": "HalfStorage",
    "<i4": "IntStorage",
    "<i8": "LongStorage",
    "|u1": "ByteStorage",
}


class _Writer:
    """A pickle of protocol 2, in the few opcodes that a checkpoint needs."""

    def __init__(self):
        self.out, self.storages = io.BytesIO(), []

    def _global(self, module: str, name: str) -> None:
        self.out.write(f"c{module}\n{name}\n".encode())

    def _integer(self, value: int) -> None:
        if -(2**31) <= value < 2**31:
            self.out.write(b"J" + struct.pack("<i", value))
        else:
            raw = value.to_bytes(9, "little", signed=True)
            self.out.write(b"\x8a" + bytes([len(raw)]) + raw)

    def put(self, value) -> None:
        out = self.out
        if value is None:
            out.write(b"N")
        elif isinstance(value, bool):
            out.write(b"\x88" if value else b"\x89")
        elif isinstance(value, int):
            self._integer(value)
        elif isinstance(value, float):
            out.write(b"G" + struct.pack(">d", value))
        elif isinstance(value, str):
            raw = value.encode()
            out.write(b"X" + struct.pack("<I", len(raw)) + raw)
        elif isinstance(value, (list, tuple)):
            out.write(b"](" if isinstance(value, list) else b"(")
            for v in value:
                self.put(v)
            out.write(b"e" if isinstance(value, list) else b"t")
        elif isinstance(value, dict):
            out.write(b"}(")
            for k, v in value.items():
                self.put(k)
                self.put(v)
            out.write(b"u")
        elif isinstance(value, np.ndarray):
            self._tensor(value)
        else:
            raise TypeError(f"{type(value).__name__} is not written to a checkpoint")

    def _tensor(self, value: np.ndarray) -> None:
        value = np.ascontiguousarray(value)
        storage, key = _STORAGE[value.dtype.str], str(len(self.storages))
        self.storages.append(value)
        self._global("torch._utils", "_rebuild_tensor_v2")
        self.out.write(b"((")
        self.put("storage")
        self._global("torch", storage)
        for v in (key, "cpu", int(value.size)):
            self.put(v)
        self.out.write(b"tQ")
        strides = tuple(s // value.itemsize for s in value.strides)
        for v in (0, tuple(value.shape), strides, False):
            self.put(v)
        self._global("collections", "OrderedDict")
        self.out.write(b")RtR")


def write_torch(path: str | Path, value: dict) -> None:
    """Write ``value`` (dictionaries, lists, numbers, strings and NumPy arrays) to ``path``, whole or not at all."""
    writer = _Writer()
    writer.out.write(b"\x80\x02")
    writer.put(value)
    writer.out.write(b".")
    folder = Path(path).stem
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(f"{folder}/data.pkl", writer.out.getvalue())
        archive.writestr(f"{folder}/byteorder", "little")
        for key, array in enumerate(writer.storages):
            archive.writestr(f"{folder}/data/{key}", array.tobytes())
        archive.writestr(f"{folder}/version", "3\n")
