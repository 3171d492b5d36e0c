"""Reads what ``torch.save`` wrote, without torch and without running anything that is in the file.

A ``.pth`` file is a zip archive: ``data.pkl``, a pickle, and one record for each tensor's storage. A pickle is a
program that may call any function it names; here it may name only those below, none of which does more than
build containers, numbers and views of the stored arrays.
"""
from __future__ import annotations

import io
import pickle
import re
import zipfile
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_STORAGES = {
    "DoubleStorage": "<f8", "FloatStorage": "<f4", "HalfStorage": "<f2", "BFloat16Storage": "bfloat16",
    "LongStorage": "<i8", "IntStorage": "<i4", "ShortStorage": "<i2", "CharStorage": "i1", "ByteStorage": "u1",
    "BoolStorage": "?",
}  # fmt: skip


class _Inert:
    """What a pickle may make but not change: pickles can set attributes, and checks must still hold later."""

    __slots__ = ()

    def __setstate__(self, state):
        raise ValueError("it changes an object after making it, which no checkpoint of weights needs")


class _Function(_Inert):
    __slots__ = ("_call",)

    def __init__(self, call):
        self._call = call

    def __call__(self, *arguments):
        return self._call(*arguments)


@dataclass(frozen=True)
class _Dtype:
    name: str

    def __setstate__(self, state):
        """Pickles repeat the byte order here, which the name has told already."""


class StoredTensor(_Inert):
    """A tensor in the archive; ``numpy()`` reads it."""

    __slots__ = ("_archive", "_key", "_dtype", "_offset", "shape", "_stride")

    def __init__(self, archive: "_Archive", key: str, dtype: str, offset: int, shape: tuple, stride: tuple):
        self._archive, self._key, self._dtype, self._offset = archive, key, dtype, offset
        self.shape, self._stride = shape, stride

    def numpy(self) -> np.ndarray:
        """The values, (``shape``); bfloat16 becomes float32. Raises ``ValueError`` when the file does not hold them all."""
        raw = self._archive.record(f"data/{self._key}")
        flat = np.frombuffer(raw, "<u2" if self._dtype == "bfloat16" else self._dtype)
        if self._dtype == "bfloat16":
            flat = (flat.astype(np.uint32) << 16).view(np.float32)
        last = self._offset + sum((n - 1) * s for n, s in zip(self.shape, self._stride))
        if 0 not in self.shape and last >= len(flat):
            raise ValueError(f"a tensor of shape {self.shape} lies outside of its storage of {len(flat)} numbers")
        strides = [s * flat.itemsize for s in self._stride]
        return np.lib.stride_tricks.as_strided(flat[self._offset:], self.shape, strides, writeable=False).copy()


class _Archive:
    def __init__(self, path: Path):
        self.path, self._zip = path, zipfile.ZipFile(path)
        found = [n for n in self._zip.namelist() if n.endswith("/data.pkl")]
        if len(found) != 1:
            raise ValueError(f'"{path}" is a zip archive, but not one that torch.save wrote (no data.pkl)')
        self._folder = found[0][: -len("data.pkl")]
        if f"{self._folder}byteorder" in self._zip.namelist() and self.record("byteorder") != b"little":
            raise ValueError(f'"{path}" was written on a big-endian machine, which is not read here')

    def record(self, name: str) -> bytes:
        try:
            return self._zip.read(self._folder + name)
        except KeyError:
            raise ValueError(f'"{self.path}" lacks its record "{name}": the file is incomplete; copy it again') from None


def _whole(value) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _tensor(storage, offset, shape, stride, *rest):
    archive, key, dtype = storage
    if not (_whole(offset) and all(map(_whole, shape)) and all(map(_whole, stride)) and len(shape) == len(stride)):
        raise ValueError(f"a tensor of shape {shape} with strides {stride} from {offset} on is none")
    return StoredTensor(archive, key, dtype, offset, tuple(shape), tuple(stride))


def _numpy_dtype(name, *rest):
    if not (isinstance(name, str) and re.fullmatch(r"[<|=]?[biuf][1248]", name)):
        raise ValueError(f"the number type {name!r} is not read here")
    return _Dtype(name)


def _numpy_scalar(dtype, raw):
    if not isinstance(dtype, _Dtype):
        raise ValueError("a number of unknown type is not read here")
    return np.frombuffer(raw, dtype.name)[0].item()


def _encoded(text, encoding="latin1"):
    return str(text).encode("latin1")


class NamedValue(_Inert):
    """Stands for a member of an Enum of the file's own program: only its ``value`` is kept."""

    __slots__ = ("value",)

    def __init__(self, value):
        self.value = value


_ALLOWED = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): _Function(_tensor),
    ("torch._utils", "_rebuild_parameter"): _Function(lambda data, *rest: data),
    ("torch", "Size"): tuple,
    ("numpy", "dtype"): _Function(_numpy_dtype),
    ("numpy.core.multiarray", "scalar"): _Function(_numpy_scalar),
    ("numpy._core.multiarray", "scalar"): _Function(_numpy_scalar),
    ("_codecs", "encode"): _Function(_encoded),
    ("nerg.gaze_prediction", "NeRGVariant"): NamedValue,
}
_ALLOWED |= {("torch", name): name for name in _STORAGES}


class _Unpickler(pickle.Unpickler):
    def __init__(self, file, archive: _Archive):
        super().__init__(file, encoding="latin1")
        self._archive = archive

    def find_class(self, module, name):
        try:
            return _ALLOWED[module, name]
        except KeyError:
            raise ValueError(f'it asks for "{module}.{name}", which no checkpoint of weights needs') from None

    def persistent_load(self, pid):
        kind, storage, key, *_ = pid
        if kind != "storage" or storage not in _STORAGES or not re.fullmatch(r"\d+", str(key)):
            raise ValueError("it refers to something other than a stored array")
        return self._archive, str(key), _STORAGES[storage]


def read_torch(path: str | Path):
    """What ``torch.save`` put into ``path``: containers, numbers, strings, and ``StoredTensor`` for tensors.

    Raises ``FileNotFoundError``, and ``ValueError`` for a file that is not such an archive or that names anything but
    tensors and plain data.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f'there is no file "{path}"')
    if not zipfile.is_zipfile(path):
        raise ValueError(
            f'"{path}" is not a zip archive, as torch.save writes since version 1.6: load it with the torch that wrote it, '
            "and save it again with a newer one"
        )
    archive = _Archive(path)
    try:
        return _Unpickler(io.BytesIO(archive.record("data.pkl")), archive).load()
    except ValueError as e:
        raise ValueError(f'"{path}" is not read: {e}') from e
    except (pickle.UnpicklingError, EOFError, IndexError, KeyError, AttributeError, TypeError) as e:
        raise ValueError(f'"{path}" is damaged: its pickle cannot be read ({type(e).__name__}: {e})') from e
