"""The errors that a user is expected to meet, told in one sentence."""

from __future__ import annotations

import errno
import importlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any


class NergError(ValueError):
    """Something the user can put right. The message is one sentence: the thing that is wrong, and the remedy.

    The command `nerg` prints it without a traceback and ends with exit code 1.

    >>> import nerg_mi as nerg
    >>> try:
    ...     nerg.load_field("nowhere.safetensors")
    ... except nerg.NergError as error:
    ...     print(error)
    the checkpoint "nowhere.safetensors" does not exist: correct its name, or make one with "nerg train"
    """


class MissingFile(NergError, FileNotFoundError):
    """A file that is not there; the message names it."""


class UnusableLLVM(ImportError):
    """The libLLVM that Dr.Jit would load cannot run its kernels. The message names the version and the remedy."""


@contextmanager
def blame_options(options: str) -> Iterator[None]:
    """A block whose values a user gave by ``options`` ("--aabb"): a `ValueError` of it is theirs to mend, as a
    `NergError`.

    Functions among themselves refuse wrong values by `ValueError`, since they do not know who gave them.
    """
    try:
        yield
    except NergError:
        raise
    except ValueError as error:
        raise NergError(f"{str(error).rstrip('.')}; give other values by {options}") from error


def import_extra(module: str, reason: str, extra: str) -> Any:
    """The module ``name`` of a library that an ``extra`` installs. Raises `ImportError`, which begins with the ``need``
    ("a mesh needs scikit-image"), where it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        raise ImportError(f'{reason}, which is not installed: pip install "nerg-mi[{extra}]"') from None


def is_user_error(error: BaseException) -> bool:
    """Whether ``error`` is one that the user can mend, or the machine's, and not a mistake in the program.

    The former are `NergError`, a library that is missing or cannot be used, what the system says of files and devices,
    and memory that does not suffice. The rest is the program's: a `ValueError`, too, says that one function of it
    called another one with wrong values.
    """
    if isinstance(error, ImportError):
        # Modules of our own are always there.
        return not (error.name or "").startswith("nerg_mi")
    if isinstance(error, OSError):
        return error.errno is not None or error.filename is not None or isinstance(error, NergError)
    return isinstance(error, (NergError, MemoryError))


_TRACEBACK = "Traceback (most recent call last):"
_MENDABLE = (
    "NergError",
    "MissingFile",
    "UnusableLLVM",
    "ValueError",
    "ImportError",
    "ModuleNotFoundError",
    "OSError",
    "FileNotFoundError",
    "PermissionError",
    "IsADirectoryError",
    "MemoryError",
)


@contextmanager
def translate_mitsuba_errors(file: str | PathLike[str] | None = None) -> Iterator[None]:
    """A block whose `RuntimeError`s are Mitsuba's, about a scene or about ``file``, as `NergError` that names it.

    It makes one of whatever a plugin's constructor raises, with the traceback as text. Where that ends in an exception
    that only a mistake of the program raises (a `TypeError`, say), the error is left as it is.
    """
    try:
        yield
    except RuntimeError as error:
        _, marker, trace = str(error).partition(_TRACEBACK)
        kind = _raised(trace).partition(":")[0].strip().rpartition(".")[2] if marker else None
        if kind is not None and kind not in _MENDABLE:
            raise
        # Mitsuba quotes most files that it cannot read, but none whose content it gets as arrays.
        said = format_error(error)
        if file is not None and Path(file).name not in said:
            said = f'"{file}" cannot be used by Mitsuba: {said}'
        raise NergError(sanitize(said, 1000)) from error
    except UnicodeDecodeError as error:
        # And what it quotes may be no text.
        raise NergError(
            "a mesh or another file of the scene is damaged: it holds what is no text; make it anew"
        ) from error


def format_error(error: BaseException) -> str:
    """What `error` says, on one line.

    Mitsuba embeds the whole Python traceback of a plugin's constructor in its message. Kept are where in the scene it
    happened (before the traceback) and what was said there (its last line).
    """
    text = str(error).strip()
    if isinstance(error, MemoryError):
        text = f"there is not enough memory{': ' + text if text else ''}; ask for less, or close other programs"
    elif isinstance(error, OSError) and error.strerror:
        said = f"{error.strerror[:1].lower()}{error.strerror[1:]}"
        if error.filename is not None:
            said = (
                f'there is no file "{error.filename}"' if error.errno == errno.ENOENT else f'"{error.filename}": {said}'
            )
        text = said
    before, marker, trace = text.partition(_TRACEBACK)
    if marker:
        text = before.rstrip() + " " + re.sub(r"^[A-Za-z_][\w.]*:\s+", "", _raised(trace))
    text = re.sub(r"^\[[\w.]+\.(cpp|h):\d+\]\s*", "", text)
    return " ".join(text.split()) or type(error).__name__


def sanitize(text: object, max_length: int = 300) -> str:
    """``text`` from a file, fit for one line of a message: control characters and what lies beyond ``most`` left
    out.
    """
    kept = "".join(c if c.isprintable() else "?" for c in str(text)[: max_length + 1])
    return kept if len(kept) <= max_length else kept[:max_length] + "..."


def _raised(trace: str) -> str:
    """The end of a traceback: the exception's class and what it says."""
    # It starts at the left margin and may run on over several lines; frames are indented.
    return re.split(r"\n(?=[A-Za-z_][\w.]*(?::\s|$))", trace)[-1].strip()
