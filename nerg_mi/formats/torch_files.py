"""Files of PyTorch, read and written by torch, with what torch does not bound checked before."""

from __future__ import annotations

import io
import pickletools
import re
import warnings
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import MissingFile, NergError, import_extra, sanitize
from nerg_mi.files.atomic import write_bytes
from nerg_mi.files.safe_read import open_zip, read_member, translate_read_errors, check_regular_file

if TYPE_CHECKING:
    import torch


MAX_PICKLE_BYTES = 8 << 20
"""The pickle may have so many bytes: it holds names and shapes, the numbers are in records of their own."""

MAX_OPERATIONS = 1_000_000  # so many operations may it have

MAX_WORK = 8 * MAX_PICKLE_BYTES
"""So many values and characters may its operations take in all, what is repeated counted each time."""

MAX_EXPANDED_NUMBERS = 1 << 20  # so many numbers may a tensor have that repeats those of its storage
_TEXT = 64
# What torch.load would also make of a file, and no checkpoint of weights has: sparse and quantised tensors, devices,
# sets, byte arrays of any size, ...
_NAMES = frozenset(
    f"torch {kind}Storage"
    for kind in ("Double", "Float", "Half", "BFloat16", "Long", "Int", "Short", "Char", "Byte", "Bool")
) | {
    "collections OrderedDict",
    "torch._utils _rebuild_tensor_v2",
    "torch._utils _rebuild_parameter",
    "torch Size",
    "_codecs encode",
    "numpy dtype",
    "numpy.core.multiarray scalar",
    "numpy._core.multiarray scalar",
    "nerg.gaze_prediction NeRGVariant",
}
_FILLED = ("APPEND", "APPENDS", "SETITEM", "SETITEMS", "BUILD")


class EnumStandIn:
    """Stands for a member of an Enum of the file's own program: only its ``value`` is kept."""

    __slots__ = ("value",)

    def __init__(self, value):
        self.value = value


class _NumberType:
    """Stands for NumPy's dtype, which would take fields and offsets from a file."""

    def __init__(self, name, *_):
        if not (isinstance(name, str) and re.fullmatch(r"[biuf][1248]", name)):
            raise ValueError(f'the number type "{sanitize(name, 40)}" is not read here')
        self.name = f"<{name}"

    def __setstate__(self, state):
        """Pickles repeat the byte order here, which was little on any machine that torch runs on."""


def _number(kind: _NumberType, raw: bytes) -> int | float | bool:
    return np.frombuffer(raw, kind.name)[0].item()


_STANDINS = [
    (_NumberType, "numpy.dtype"),
    (_number, "numpy.core.multiarray.scalar"),
    (_number, "numpy._core.multiarray.scalar"),
    (EnumStandIn, "nerg.gaze_prediction.NeRGVariant"),
]


def _import_torch() -> Any:
    torch = import_extra("torch", "checkpoints of torch need torch", "torch")
    # Before, weights_only could be led to run code (CVE-2025-32434).
    if tuple(int(n) for n in re.findall(r"\d+", torch.__version__)[:2]) < (2, 6):
        raise ImportError(
            f'checkpoints need torch 2.6, and {torch.__version__} is here: pip install -U "nerg-mi[torch]"'
        )
    return torch


def read_torch(path: str | Path):
    """What ``torch.save`` put into ``path``: containers, numbers, strings and tensors, which are mapped.

    Raises `MissingFile`, and `NergError` for a file that is not such an archive, that names anything but tensors and
    plain data, or that is damaged. Of an archive that torch wrote, no member is compressed.
    """
    path = Path(path)
    if not path.exists():
        raise MissingFile(f'there is no file "{path}"; correct its name')
    check_regular_file(path, "checkpoint")
    with translate_read_errors(path, "checkpoint"), open(path, "rb") as file:
        zipped = file.read(4) == b"PK\3\4" and zipfile.is_zipfile(path)
    if not zipped:
        raise NergError(
            f'"{path}" is not a zip archive, as torch.save writes since version 1.6: load it with the torch that '
            "wrote it, and save it again with a newer one"
        )
    pickled = _check_archive(path)
    torch = _import_torch()
    try:
        check_pickle(pickled)
        with warnings.catch_warnings(), torch.serialization.safe_globals(_STANDINS):
            warnings.simplefilter("ignore")  # of pickle protocols: what torch does not read of them it refuses
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:
        # Whatever torch meets in a pickle that is none, of any class; its advice is to programmers.
        said = sanitize(str(error).partition("WeightsUnpickler error: ")[2] or error).split("\n")[0]
        raise NergError(f'"{path}" is not read, for its pickle is damaged or no checkpoint\'s: {said}') from error


def _check_archive(path: Path) -> bytes:
    """The pickle of an archive whose members torch can map. Raises `NergError` where a checksum is not right."""
    with open_zip(path, "checkpoint") as archive:
        members = archive.infolist()
        pickles = [m for m in members if m.filename.endswith("/data.pkl")]
        # torch does not tell capitals from small letters.
        if len(pickles) != 1 or len({m.filename.lower() for m in members}) != len(members):
            raise NergError(
                f'"{path}" is a zip archive, but not one that torch.save wrote (no data.pkl); name one of those'
            )
        if pickles[0].file_size > MAX_PICKLE_BYTES:
            raise NergError(
                f'the pickle of "{path}" has {pickles[0].file_size:,} bytes, more than the {MAX_PICKLE_BYTES:,} that are '
                "read; save its weights alone"
            )
        for member in members:
            if member.compress_type != zipfile.ZIP_STORED:
                raise NergError(
                    f'the member "{sanitize(member.filename)}" of "{path}" is compressed, as none is that torch.save '
                    "writes; pack it again without compression"
                )
        with translate_read_errors(path, "checkpoint"):
            if damaged := archive.testzip():
                raise ValueError(f'its member "{sanitize(damaged)}" is not what was written')
        return bytes(read_member(archive, pickles[0].filename, path, "checkpoint"))


def check_pickle(pickled: bytes) -> None:
    """Raise `ValueError` for a name that is not in `_NAMES`, and for more than `OPERATIONS` or `WORK`.

    Also raises `IndexError` and `KeyError`, for a damaged pickle. A value on the stack is a list of its size (1, its
    characters, and the sizes of what it was made of) and of its name, where it is a function. A container that is
    filled later remains the same list, also in the memo.
    """
    mark: list = [0, ""]
    stack: list[list] = []
    memo: dict[object, list] = {}
    work = 0
    for count, (operation, argument, _) in enumerate(pickletools.genops(pickled)):
        name, takes = operation.name, operation.stack_before
        if count >= MAX_OPERATIONS or work > MAX_WORK:
            raise ValueError(f"it has more than {MAX_OPERATIONS:,} operations, or repeats what they make too often")
        if name == "GLOBAL" and argument not in _NAMES:
            raise ValueError(f'it asks for "{sanitize(argument, 80).replace(" ", ".")}", which no weights need')
        if "PUT" in name:
            memo[argument] = stack[-1]
        elif "GET" in name:
            stack.append(memo[argument])
        elif name == "MARK":
            stack.append(mark)
        else:
            parts: list[list] = []
            below = len(takes)
            if pickletools.markobject in takes:
                below = takes.index(pickletools.markobject)
                while (part := stack.pop()) is not mark:
                    parts.append(part)
            parts = [stack.pop() for _ in range(below)][::-1] + parts
            is_filled = name in _FILLED and bool(parts)
            size = sum(part[0] for part in parts[is_filled:])
            work += size + 1
            if name in ("REDUCE", "NEWOBJ") and parts[0][1] == "_codecs encode" and size > _TEXT:
                raise ValueError("an encoded text is not read here: only the bytes of a number come so")
            if is_filled:
                parts[0][0] += size
                stack.append(parts[0])
            elif operation.stack_after:
                length = len(argument) if isinstance(argument, (str, bytes)) else 0
                stack.append([size + 1 + length, argument if name == "GLOBAL" else ""])


def is_tensor(value: object) -> bool:
    """Whether a value of a file is a tensor."""
    import torch

    return torch.is_tensor(value)


def to_numpy(tensor: torch.Tensor, path: Path) -> np.ndarray:
    """The values of a tensor of the file ``path``; bfloat16 becomes float32."""
    stored = tensor.untyped_storage().nbytes() // tensor.element_size()
    if tensor.numel() > max(stored, MAX_EXPANDED_NUMBERS):
        raise NergError(
            f'a tensor of "{path}" of shape {tuple(tensor.shape)} repeats the {stored:,} numbers that are stored; copy '
            "the file again"
        )
    with translate_read_errors(path, "checkpoint", extra_errors=(RuntimeError, TypeError)):
        tensor = tensor.detach()
        return np.array((tensor.float() if str(tensor.dtype) == "torch.bfloat16" else tensor).numpy())


def write_torch(path: str | Path, value: dict) -> None:
    """Write ``value`` (dictionaries, lists, numbers, strings and NumPy arrays) to ``path``, whole or not at all."""
    torch = _import_torch()

    def tensors(value):
        if isinstance(value, np.ndarray):
            return torch.from_numpy(value.copy())
        if isinstance(value, dict):
            return {key: tensors(part) for key, part in value.items()}
        return [tensors(part) for part in value] if isinstance(value, list) else value

    data = io.BytesIO()
    torch.save(tensors(value), data)
    write_bytes(path, data.getvalue())
