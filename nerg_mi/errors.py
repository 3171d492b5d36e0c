"""Errors that a user can fix, and their one-sentence messages."""

from __future__ import annotations

import errno
import importlib
import re
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

# ---- Parameters in messages ----
#
# A message names a parameter by `parameter`, between characters that no text contains. It is spelled where the message
# is shown: as ``steps=200`` in Python, and as ``--steps 200`` on the command line.

_MARKS = "\ue000\ue001\ue002"
_MENTION = re.compile("\ue000(\\w+)\ue001([^\ue002]*)\ue002")
Spelling: TypeAlias = Callable[[str, str], str]
"""Spells a parameter, of its name and a value; the value is "" if only the parameter is meant."""


def parameter(name: str, value: object = "") -> str:
    """Return the mention of the parameter ``name`` for a message, with a ``value`` if the message is about that."""
    return f"\ue000{name}\ue001{value}\ue002"


def spell_python(name: str, value: str) -> str:
    """Spell a parameter as a keyword argument: ``steps=200``, ``recipe="small"``."""
    is_word = value.isidentifier() and not value.isupper() and value not in ("True", "False", "None")
    text = f'"{value}"' if is_word or "=" in value or "{" in value else value
    return f"{name}={text}" if value else name


def spell_command_line(name: str, value: str, flag: str = "") -> str:
    """Spell a parameter as an option, by default that of its name: ``--steps 200``, ``--resume``, ``--no-depth``; a
    ``flag`` may have its own negative form, as ``--unbounded/--bounded``."""
    flag, _, negative = (flag or f"--{name.replace('_', '-')}").partition("/")
    if value == "False":
        return negative or f"--no-{flag[2:]}"
    return flag if value in ("", "True") else f"{flag} {value}"


def spell_parameters(text: str, spelling: Spelling = spell_python) -> str:
    """Spell the parameters that ``text`` mentions."""
    return _MENTION.sub(lambda match: spelling(match[1], match[2]), text)


class NergError(ValueError):
    """An error that the user can fix. The message is one sentence: what is wrong, and the remedy.

    The command `nerg` prints the message without a traceback and exits with code 1.

    Parameters
    ----------
    message : str
        The sentence, in which `parameter` mentions parameters.
    kind : str
        What is wrong, for programs: "mirrored", "unit", ...

    >>> import nerg_mi as nerg
    >>> try:
    ...     nerg.RadianceField.load("nowhere.safetensors")
    ... except nerg.NergError as error:
    ...     print(error)
    the checkpoint "nowhere.safetensors" does not exist: correct its name, or make one with "nerg train"
    """

    def __init__(self, message: object = "", *more: object, kind: str = "") -> None:
        super().__init__(message, *more)
        self.kind = kind

    @property
    def message(self) -> str:
        """The sentence before its parameters are spelled; ``str(error)`` spells them as in Python."""
        return str(self.args[0])

    @property
    def parameters(self) -> dict[str, str]:
        """Parameters that the sentence mentions, and their values; "" without one."""
        return dict(_MENTION.findall(self.message))

    def __str__(self) -> str:
        return clean_text(super().__str__())


class MissingFile(NergError, FileNotFoundError):
    """A file that does not exist. The message names the file."""


class UnusableLLVM(ImportError):
    """The libLLVM that Dr.Jit would load cannot run its kernels. The message names the version and the remedy."""


@contextmanager
def blame_options(options: str) -> Iterator[None]:
    """Attribute each `ValueError` of the block to ``options``, which mention parameters, as a `NergError`.

    Internal functions raise `ValueError` for invalid values because they do not know which parameter supplied them.
    """
    try:
        yield
    except NergError:
        raise
    except ValueError as error:
        raise NergError(f"{str(error).rstrip('.')}; give other values by {options}") from error


def import_extra(module: str, reason: str, extra: str) -> Any:
    """Import an optional module.

    Parameters
    ----------
    module
        Name of the module.
    reason
        Beginning of the error message ("a mesh needs scikit-image").
    extra
        Extra of this package that installs the module (``pip install "nerg-mi[extra]"``).

    Raises
    ------
    ImportError
        If the module is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        if is_lack_of_memory(error):
            raise
        raise ImportError(f'{reason}, which is not installed: pip install "nerg-mi[{extra}]"') from None


# What the dynamic loader, the operating system and C++ say if memory cannot be allocated.
_LACK_OF_MEMORY = re.compile(
    r"failed to map segment|cannot allocate memory|cannot create shared object descriptor|bad_alloc|"
    r"can't start new thread|unable to allocate|out of memory",
    re.IGNORECASE,
)


def is_lack_of_memory(error: BaseException) -> bool:
    """Return whether ``error`` means that memory cannot be allocated, for data or for a library."""
    is_system_error = isinstance(error, (ImportError, OSError, RuntimeError)) and not isinstance(error, NergError)
    return isinstance(error, MemoryError) or (is_system_error and bool(_LACK_OF_MEMORY.search(str(error))))


def is_user_error(error: BaseException) -> bool:
    """Return whether the user can fix ``error``; otherwise it is a bug in this package.

    The user can fix a `NergError`, a missing or unusable library, an error that the operating system reports for a file
    or device, and a lack of memory. Everything else is a bug. This includes `ValueError`, which means that one internal
    function called another one with invalid values.
    """
    if is_lack_of_memory(error):
        return True
    if isinstance(error, ImportError):
        # The modules of this package are always installed.
        return not (error.name or "").startswith("nerg_mi")
    if isinstance(error, OSError):
        return error.errno is not None or error.filename is not None or isinstance(error, NergError)
    return isinstance(error, NergError)


_TRACEBACK = "Traceback (most recent call last):"
USER_ERRORS = (
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
    """Convert each `RuntimeError` that Mitsuba raises in the block to a `NergError` that names ``file``.

    Mitsuba wraps every exception of a plugin's constructor in a `RuntimeError` whose text contains the traceback. If
    that traceback ends in an exception that only a bug raises (such as a `TypeError`), the error is not converted.

    Parameters
    ----------
    file
        File that Mitsuba loads in the block; None for a scene.
    """
    try:
        yield
    except RuntimeError as error:
        # `mi.render` wraps what an integrator raises in an error that says nothing.
        cause = error.__cause__
        while isinstance(cause, RuntimeError):
            cause = cause.__cause__
        if isinstance(cause, NergError):
            raise cause from error
        _, marker, trace = str(error).partition(_TRACEBACK)
        error_type = _read_last_exception(trace).partition(":")[0].strip().rpartition(".")[2] if marker else None
        if error_type is not None and error_type not in USER_ERRORS:
            raise
        # Mitsuba names most files that it cannot read, but not those whose content it receives as arrays.
        message = format_error(error)
        if file is not None and Path(file).name not in message:
            message = f'"{file}" cannot be loaded by Mitsuba: {message}'
        raise NergError(sanitize(message, 1000)) from error
    except UnicodeDecodeError as error:
        # Mitsuba may quote bytes of the file that are not valid UTF-8.
        raise NergError(
            "a mesh or another file of the scene is damaged: it contains bytes that are not valid text; create it again"
        ) from error


def format_error(error: BaseException) -> str:
    """Return the message of ``error`` on one line; `clean_text` spells the parameters that it mentions.

    Mitsuba embeds the complete Python traceback of a plugin's constructor in its message, and the class of its
    exception. The returned line keeps the location in the scene (the text before the traceback) and the message of the
    exception (its last line).
    """
    text = (error.message if isinstance(error, NergError) else str(error)).strip()
    if is_lack_of_memory(error):
        # The loader and the operating system name a library or a function, which is not the cause.
        text = text if isinstance(error, MemoryError) else ""
        text = f"not enough memory{': ' + text if text else ''}; reduce the size of the job, or close other programs"
    elif isinstance(error, OSError) and error.strerror:
        message = f"{error.strerror[:1].lower()}{error.strerror[1:]}"
        if error.filename is not None:
            message = (
                f'there is no file "{error.filename}"'
                if error.errno == errno.ENOENT
                else f'"{error.filename}": {message}'
            )
        text = message
    location, marker, trace = text.partition(_TRACEBACK)
    if marker:
        text = location.rstrip() + " " + re.sub(r"^[A-Za-z_][\w.]*:\s+", "", _read_last_exception(trace))
    # A `NergError` of a plugin has no traceback (`nerg_mi.registration`).
    text = re.sub(r'(?<="): (NergError|MissingFile): ', ": ", text, count=1)
    text = re.sub(r"^\[[\w.]+\.(cpp|h):\d+\]\s*", "", text)
    return " ".join(text.split()) or type(error).__name__


def sanitize(text: object, max_length: int = 300) -> str:
    """Return ``text`` from a file for use in a one-line message.

    Control characters are replaced by "?", and text beyond ``max_length`` characters is truncated.
    """
    text_out = "".join(c if c.isprintable() or c in _MARKS else "?" for c in str(text)[: max_length + 1])
    return text_out if len(text_out) <= max_length else text_out[:max_length] + "..."


_INVISIBLE = ("Cc", "Cf", "Cs")  # control characters, format characters such as reversed order, and surrogates
_ALLOWED = "\n\t\u200c\u200d"  # line breaks, tabs, and the joiners of Persian, Indic scripts and emoji


def clean_text(text: str, spelling: Spelling = spell_python) -> str:
    """Return ``text`` without characters that control a terminal or reorder what it shows; "?" replaces them.

    Every message, warning, line of progress and figure passes through this function, since names of participants, files
    and areas may contain anything. ``spelling`` spells the parameters that the text mentions.
    """
    text = spell_parameters(text, spelling)
    if text.isascii() and text.isprintable():
        return text
    return "".join("?" if unicodedata.category(c) in _INVISIBLE and c not in _ALLOWED else c for c in text)


def _read_last_exception(trace: str) -> str:
    """Return the last exception of a traceback: its class and message."""
    # The exception starts at the left margin and may span several lines; stack frames are indented.
    return re.split(r"\n(?=[A-Za-z_][\w.]*(?::\s|$))", trace)[-1].strip()
