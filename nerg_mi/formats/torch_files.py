"""PyTorch files, read and written with torch, with checks of sizes that torch does not limit."""

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
from nerg_mi.files.safe_read import check_regular_file, open_zip, read_member, translate_read_errors

if TYPE_CHECKING:
    import torch


MAX_PICKLE_BYTES = 8 << 20
"""Maximum size of the pickle in bytes. It contains names and shapes; the numbers are in separate records."""

MAX_OPERATIONS = 1_000_000  # maximum number of operations of the pickle

MAX_WORK = 8 * MAX_PICKLE_BYTES
"""Maximum number of values and characters that the operations use in total, counted for each use."""

MAX_EXPANDED_NUMBERS = 1 << 20  # maximum number of elements of a tensor that is larger than its storage
_MAX_ENCODED_TEXT = 64
# All other names are refused, although torch.load would accept some of them: sparse and quantised tensors, devices,
# sets, byte arrays of any size. Checkpoints of weights do not contain them.
_ALLOWED_NAMES = frozenset(
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
_FILL_OPERATIONS = ("APPEND", "APPENDS", "SETITEM", "SETITEMS", "BUILD")


class EnumStandIn:
    """Replacement for a member of an Enum of another program; only its ``value`` is stored."""

    __slots__ = ("value",)

    def __init__(self, value):
        self.value = value


class _DtypeStandIn:
    """Replacement for NumPy's dtype, which would accept fields and offsets from the file."""

    def __init__(self, name, *_):
        if not (isinstance(name, str) and re.fullmatch(r"[biuf][1248]", name)):
            raise ValueError(f'the number type "{sanitize(name, 40)}" is not supported')
        self.name = f"<{name}"

    def __setstate__(self, state):
        """Ignore the state. It repeats the byte order, which is little-endian on all machines that torch supports."""


def _decode_number(kind: _DtypeStandIn, raw: bytes) -> int | float | bool:
    return np.frombuffer(raw, kind.name)[0].item()


_STAND_INS = [
    (_DtypeStandIn, "numpy.dtype"),
    (_decode_number, "numpy.core.multiarray.scalar"),
    (_decode_number, "numpy._core.multiarray.scalar"),
    (EnumStandIn, "nerg.gaze_prediction.NeRGVariant"),
]


def _import_torch() -> Any:
    torch = import_extra("torch", "checkpoints of torch need torch", "torch")
    # In earlier versions, files can make torch run code in spite of weights_only (CVE-2025-32434, CVE-2026-24747) and
    # damage memory (CVE-2026-4538).
    if tuple(int(n) for n in re.findall(r"\d+", torch.__version__)[:2]) < (2, 11):
        raise ImportError(
            f"checkpoints need torch 2.11 or newer, but {torch.__version__} is installed: pip install -U "
            '"nerg-mi[torch]"'
        )
    return torch


def read_torch(path: str | Path):
    """Read what ``torch.save`` wrote to ``path``: containers, numbers, strings and memory-mapped tensors.

    Raises `MissingFile` if the file does not exist, and `NergError` if it is not an uncompressed archive of torch, is
    damaged, or contains anything but tensors and plain data.
    """
    path = Path(path)
    if not path.exists():
        raise MissingFile(f'the file "{path}" does not exist; correct its name')
    check_regular_file(path, "checkpoint")
    with translate_read_errors(path, "checkpoint"), open(path, "rb") as file:
        zipped = file.read(4) == b"PK\3\4" and zipfile.is_zipfile(path)
    if not zipped:
        raise NergError(
            f'"{path}" is not a zip archive, the format of torch.save since version 1.6: load it with the torch '
            "version that "
            "wrote it, and save it again with a newer version"
        )
    pickled = _check_archive(path)
    torch = _import_torch()
    try:
        check_pickle(pickled)
        with warnings.catch_warnings(), torch.serialization.safe_globals(_STAND_INS):
            warnings.simplefilter("ignore")  # warnings about pickle protocols; torch refuses unsupported ones anyway
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:
        # torch raises many classes for a damaged pickle; its advice is for programmers and is removed.
        message = sanitize(str(error).partition("WeightsUnpickler error: ")[2] or error).split("\n")[0]
        raise NergError(
            f'"{path}" cannot be read: its pickle is damaged or not that of a checkpoint: {message}'
        ) from error


def _check_archive(path: Path) -> bytes:
    """Return the pickle of an archive whose members torch can map. Raises `NergError` for a wrong checksum."""
    with open_zip(path, "checkpoint") as archive:
        members = archive.infolist()
        pickles = [m for m in members if m.filename.endswith("/data.pkl")]
        # torch compares member names without case.
        if len(pickles) != 1 or len({m.filename.lower() for m in members}) != len(members):
            raise NergError(
                f'"{path}" is a zip archive, but not from torch.save (no data.pkl); specify a torch checkpoint'
            )
        if pickles[0].file_size > MAX_PICKLE_BYTES:
            raise NergError(
                f'the pickle of "{path}" has {pickles[0].file_size:,} bytes; the limit is {MAX_PICKLE_BYTES:,}; '
                "save the weights alone"
            )
        for member in members:
            if member.compress_type != zipfile.ZIP_STORED:
                raise NergError(
                    f'the member "{sanitize(member.filename)}" of "{path}" is compressed, but torch.save writes '
                    "uncompressed "
                    "members; pack it again without compression"
                )
        with translate_read_errors(path, "checkpoint"):
            if damaged := archive.testzip():
                raise ValueError(f'its member "{sanitize(damaged)}" does not match its checksum')
        return bytes(read_member(archive, pickles[0].filename, path, "checkpoint"))


def check_pickle(pickled: bytes) -> None:
    """Check a pickle before it is executed.

    Raises `ValueError` for a name that is not in `_ALLOWED_NAMES`, and for more than `MAX_OPERATIONS` or `MAX_WORK`. A
    damaged pickle also raises `IndexError` or `KeyError`.

    Notes
    -----
    The stack is simulated. An entry is a list of its size (1, plus its characters, plus the sizes of its parts) and its
    name if it is a function. A container that is filled later remains the same list, also in the memo.
    """
    mark: list = [0, ""]
    stack: list[list] = []
    memo: dict[object, list] = {}
    work = 0
    for count, (operation, argument, _) in enumerate(pickletools.genops(pickled)):
        name, stack_arguments = operation.name, operation.stack_before
        if count >= MAX_OPERATIONS or work > MAX_WORK:
            raise ValueError(f"it has more than {MAX_OPERATIONS:,} operations, or repeats what they make too often")
        if name == "GLOBAL" and argument not in _ALLOWED_NAMES:
            raise ValueError(
                f'it uses "{sanitize(argument, 80).replace(" ", ".")}", which checkpoints of weights do not need'
            )
        if "PUT" in name:
            memo[argument] = stack[-1]
        elif "GET" in name:
            stack.append(memo[argument])
        elif name == "MARK":
            stack.append(mark)
        else:
            parts: list[list] = []
            num_arguments = len(stack_arguments)
            if pickletools.markobject in stack_arguments:
                num_arguments = stack_arguments.index(pickletools.markobject)
                while (part := stack.pop()) is not mark:
                    parts.append(part)
            parts = [stack.pop() for _ in range(num_arguments)][::-1] + parts
            is_filled = name in _FILL_OPERATIONS and bool(parts)
            size = sum(part[0] for part in parts[is_filled:])
            work += size + 1
            if name in ("REDUCE", "NEWOBJ") and parts[0][1] == "_codecs encode" and size > _MAX_ENCODED_TEXT:
                raise ValueError("an encoded text is longer than the bytes of a number, which is not supported")
            if is_filled:
                parts[0][0] += size
                stack.append(parts[0])
            elif operation.stack_after:
                length = len(argument) if isinstance(argument, (str, bytes)) else 0
                stack.append([size + 1 + length, argument if name == "GLOBAL" else ""])


def is_tensor(value: object) -> bool:
    """Return whether a value of a file is a tensor."""
    import torch

    return torch.is_tensor(value)


def to_numpy(tensor: torch.Tensor, path: Path) -> np.ndarray:
    """Convert a tensor of the file ``path`` to NumPy; bfloat16 becomes float32."""
    stored = tensor.untyped_storage().nbytes() // tensor.element_size()
    if tensor.numel() > max(stored, MAX_EXPANDED_NUMBERS):
        raise NergError(
            f'a tensor of "{path}" of shape {tuple(tensor.shape)} is larger than its storage of {stored:,} numbers; '
            "copy "
            "the file again"
        )
    with translate_read_errors(path, "checkpoint", extra_errors=(RuntimeError, TypeError)):
        tensor = tensor.detach()
        return np.array((tensor.float() if str(tensor.dtype) == "torch.bfloat16" else tensor).numpy())


def write_torch(path: str | Path, value: dict) -> None:
    """Write ``value`` (dictionaries, lists, numbers, strings and NumPy arrays) to ``path`` atomically."""
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
