"""Reads what ``torch.save`` wrote, without torch and without running anything that is in the file.

A ``.pth`` file is a zip archive: ``data.pkl``, a pickle, and one record for each tensor's storage. A pickle is a
program that may call any function it names. Here it is not handed to Python's own machine but read by a small one,
which knows the opcodes of containers, numbers and strings, and for the functions below does what they stand for.
Nothing that it puts together can be called, holds the archive, or can be changed by the pickle once it is made; nothing
is hashed but plain keys, and no more is built than the pickle has bytes for.
"""

from __future__ import annotations

import pickletools
import re
import zipfile
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.files.safe_read import is_count, plain, reading, size_of

from .archive import StoredTensor, TorchArchive

PICKLE_BYTES = 8 << 20
"""The pickle may have so many bytes: it holds names and shapes, the numbers are in records of their own."""

OPERATIONS = 1_000_000
"""So many opcodes may it have."""

_STORAGES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "BFloat16Storage": "bfloat16",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}


class NamedValue:
    """Stands for a member of an Enum of the file's own program: only its ``value`` is kept."""

    __slots__ = ("value",)

    def __init__(self, value):
        self.value = value


# What stands for a global name of the pickle, a stored array and a number type while the pickle is read.


@dataclass(frozen=True)
class _Global:
    module: str
    name: str


@dataclass(frozen=True)
class _Storage:
    key: str
    dtype: str


@dataclass(frozen=True)
class _Dtype:
    name: str


def _tensor(storage, offset, shape, stride, *rest) -> StoredTensor:
    if not isinstance(storage, _Storage):
        raise ValueError("a tensor without a stored array is not read here")
    whole = isinstance(shape, tuple) and isinstance(stride, tuple) and all(map(is_count, (offset, *shape, *stride)))
    if not whole or len(shape) != len(stride) or len(shape) > 32:
        raise ValueError(f"a tensor of shape {_short(shape)} with strides {_short(stride)} is none")
    return StoredTensor(storage.key, storage.dtype, offset, shape, stride)


def _numpy_dtype(name, *rest) -> _Dtype:
    if not (isinstance(name, str) and re.fullmatch(r"[<|=]?[biuf][1248]", name)):
        raise ValueError(f"the number type {_short(name)} is not read here")
    return _Dtype(name)


def _numpy_scalar(dtype, raw):
    if not isinstance(dtype, _Dtype) or not isinstance(raw, bytes):
        raise ValueError("a number of unknown type is not read here")
    return np.frombuffer(raw, dtype.name)[0].item()


def _encoded(text, encoding="latin1") -> bytes:
    # Only the bytes of a number come so; a long text could be copied over and over.
    if not isinstance(text, str) or len(text) > 64:
        raise ValueError("an encoded text is not read here")
    return text.encode("latin1")


def _ordered(*arguments) -> OrderedDict:
    if arguments:
        raise ValueError("a dictionary that is made from another is not read here")
    return OrderedDict()


def _size(numbers=()) -> tuple:
    if not isinstance(numbers, (tuple, list)) or len(numbers) > 32:
        raise ValueError("a size of more than 32 numbers is none")
    return tuple(numbers)


_ALLOWED = {
    ("collections", "OrderedDict"): _ordered,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): lambda data, *rest: data,
    ("torch", "Size"): _size,
    ("numpy", "dtype"): _numpy_dtype,
    ("numpy.core.multiarray", "scalar"): _numpy_scalar,
    ("numpy._core.multiarray", "scalar"): _numpy_scalar,
    ("_codecs", "encode"): _encoded,
    ("nerg.gaze_prediction", "NeRGVariant"): NamedValue,
}


def _short(value: object) -> str:
    """What a value is, without looking into containers: those of a pickle can hold themselves."""
    if isinstance(value, tuple) and len(value) <= 8 and all(isinstance(v, (int, float, str)) for v in value):
        return plain(value, 80)
    return plain(value, 40) if isinstance(value, (str, int, float)) else f"a {type(value).__name__}"


class _Machine:
    """Reads one pickle. ``tensors``: all that it made."""

    _MARK = object()
    _PUSHED = frozenset(
        (
            "INT",
            "BININT",
            "BININT1",
            "BININT2",
            "LONG1",
            "BINFLOAT",
            "BINUNICODE",
            "SHORT_BINUNICODE",
            "BINUNICODE8",
            "BINBYTES",
            "SHORT_BINBYTES",
            "BINBYTES8",
            "BINSTRING",
            "SHORT_BINSTRING",
        )
    )
    _CONSTANTS: ClassVar = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
    _EMPTY: ClassVar = {"EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple, "MARK": lambda: _Machine._MARK}
    _TUPLES: ClassVar = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}

    def __init__(self):
        self.stack: list = []
        self.memo: dict = {}
        self.tensors: list[StoredTensor] = []

    def run(self, data: bytes | bytearray):
        """What the pickle ``data`` stands for. Raises ``ValueError`` and ``IndexError`` for what is not allowed or
        none.
        """
        for count, (op, value, _) in enumerate(pickletools.genops(bytes(data))):
            if count >= OPERATIONS:
                raise ValueError(f"it has more than {OPERATIONS:,} operations")
            if op.name == "STOP":
                return self.stack.pop()
            self._do(op.name, value)
        raise ValueError("it has no end")

    def _do(self, name: str, value) -> None:
        stack = self.stack
        if name in self._PUSHED:
            stack.append(value)
        elif name in self._CONSTANTS:
            stack.append(self._CONSTANTS[name])
        elif name in self._EMPTY:
            stack.append(self._EMPTY[name]())
        elif name in self._TUPLES:
            self._tuple(self._TUPLES[name])
        elif name == "TUPLE":
            stack.append(tuple(self._marked()))
        elif name in ("BINPUT", "LONG_BINPUT"):
            self.memo[value] = stack[-1]
        elif name == "MEMOIZE":
            self.memo[len(self.memo)] = stack[-1]
        elif name in ("BINGET", "LONG_BINGET"):
            stack.append(self._remembered(value))
        elif name in ("APPEND", "APPENDS"):
            items = [stack.pop()] if name == "APPEND" else self._marked()
            self._container(list).extend(items)
        elif name in ("SETITEM", "SETITEMS"):
            self._set(self._marked() if name == "SETITEMS" else [stack.pop(), stack.pop()][::-1])
        elif name == "GLOBAL":
            self._name(*value.split(" ", 1))
        elif name == "STACK_GLOBAL":
            last, first = stack.pop(), stack.pop()
            self._name(first, last)
        elif name in ("REDUCE", "NEWOBJ"):
            arguments = stack.pop()
            stack.append(self._made(stack.pop(), arguments))
        elif name == "BUILD":
            self._build()
        elif name == "BINPERSID":
            stack.append(_stored(stack.pop()))
        elif name not in ("PROTO", "FRAME"):
            raise ValueError(f"its operation {name} is not one that checkpoints need")

    def _marked(self) -> list:
        at = len(self.stack) - 1
        while self.stack[at] is not self._MARK:
            at -= 1
            if at < 0:
                raise ValueError("it collects from a place that it has not marked")
        out = self.stack[at + 1 :]
        del self.stack[at:]
        return out

    def _tuple(self, count: int) -> None:
        if len(self.stack) < count:
            raise IndexError("it collects more than it holds")
        items = tuple(self.stack[-count:])
        del self.stack[-count:]
        self.stack.append(items)

    def _remembered(self, index: int):
        if index not in self.memo:
            raise ValueError(f"it recalls the value {index}, which it has not kept")
        return self.memo[index]

    def _container(self, kind: type):
        if not isinstance(self.stack[-1], kind):
            raise ValueError("it fills something that is no container")
        return self.stack[-1]

    def _set(self, items: list) -> None:
        if len(items) % 2:
            raise ValueError("a key lacks its value")
        into = self._container(dict)
        for key, value in zip(items[::2], items[1::2]):
            # Hashing a tuple of tuples that share their parts would take for ever.
            if not isinstance(key, (str, int, float, bytes, type(None))):
                raise ValueError(f"a key of a dictionary is a {type(key).__name__}")
            into[key] = value

    def _name(self, module, name) -> None:
        known = isinstance(module, str) and isinstance(name, str)
        if not known or not ((module, name) in _ALLOWED or (module == "torch" and name in _STORAGES)):
            raise ValueError(f'it asks for "{_short(module)}.{_short(name)}", which no checkpoint of weights needs')
        self.stack.append(_Global(module, name))

    def _made(self, function, arguments):
        call = _ALLOWED.get((function.module, function.name)) if isinstance(function, _Global) else None
        if call is None or not isinstance(arguments, tuple):
            raise ValueError("it calls something that is no function")
        try:
            made = call(*arguments)
        except TypeError as error:
            raise ValueError(f"it calls {function.name} with {len(arguments)} arguments") from error
        if isinstance(made, StoredTensor):
            self.tensors.append(made)
        return made

    def _build(self) -> None:
        self.stack.pop()
        # Pickles repeat a number type's byte order here, and torch notes the versions of a state dictionary's modules.
        if not isinstance(self.stack[-1], (_Dtype, OrderedDict)):
            raise ValueError("it changes an object after making it, which no checkpoint of weights needs")


def _stored(pid) -> _Storage:
    kind, storage, key = pid[:3] if isinstance(pid, tuple) and len(pid) >= 3 else (None, None, None)
    named = storage.name if isinstance(storage, _Global) and storage.module == "torch" else None
    if kind != "storage" or named not in _STORAGES or not isinstance(key, str) or not re.fullmatch(r"[0-9]{1,12}", key):
        raise ValueError("it refers to something other than a stored array")
    return _Storage(key, _STORAGES[named])


def read_torch(path: str | Path):
    """What ``torch.save`` put into ``path``: containers, numbers, strings, and ``StoredTensor`` for tensors.

    Raises `MissingFile`, and `NergError` for a file that is not such an archive or that names anything but tensors and
    plain data.
    """
    path = Path(path)
    if not path.exists():
        raise MissingFile(f'there is no file "{path}"; correct its name')
    size_of(path, "checkpoint")
    with reading(path, "checkpoint"):
        zipped = zipfile.is_zipfile(path)
    if not zipped:
        raise NergError(
            f'"{path}" is not a zip archive, as torch.save writes since version 1.6: load it with the torch that '
            "wrote it, and save it again with a newer one"
        )
    archive, machine = TorchArchive(path), _Machine()
    data = archive.record("data.pkl", PICKLE_BYTES)
    try:
        out = machine.run(data)
    except (ValueError, IndexError, KeyError, OverflowError, MemoryError, RecursionError, AttributeError) as e:
        raise NergError(f'"{path}" is not read, for its pickle is damaged or no checkpoint\'s: {plain(e)}') from e
    for tensor in machine.tensors:
        tensor._archive = archive
    return out
