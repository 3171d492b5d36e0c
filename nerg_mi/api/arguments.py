"""Checks of the arguments of API functions before any computation: names of options, and files."""

from __future__ import annotations

import difflib
import os
from collections.abc import Collection, Iterable
from pathlib import Path

from nerg_mi.errors import MissingFile, NergError

from .arrays import join_names

_SYNONYMS = {
    "environment": "geometry",
    "areas": "aois",
    "participants": "persons",
    "without_participants": "without_persons",
}
"""Names of options that are those of other arguments, and the options."""


def check_names(function: str, names: Iterable[str], allowed: Collection[str], noun: str = "option") -> None:
    """Check names of options.

    Parameters
    ----------
    function : str
        Name of the API function, for messages.
    names : iterable of str
        Names to check.
    allowed : collection of str
        Allowed names.
    noun : str
        What the names stand for, for messages.

    Raises
    ------
    NergError
        A name is not allowed; the message suggests a similar one.
    """
    for name in names:
        if name not in allowed:
            near = [n for n in (_SYNONYMS.get(name),) if n in allowed] or difflib.get_close_matches(name, allowed, n=1)
            meant = f'did you mean "{near[0]}"?' if near else f"available: {join_names(list(allowed))}"
            raise NergError(f'{function} has no {noun} "{name}"; {meant}')


def check_output(value: object, name: str = "output") -> None:
    """Check the name of a file or folder to write, if there is one. Raises `NergError` for anything else.

    Outputs follow the first argument, so that a second object in memory is taken for one.
    """
    if value is not None and not isinstance(value, (str, os.PathLike)):
        raise NergError(
            f'"{name}" must be a file or folder to write, given as a string or a path, got {type(value).__name__}; '
            "pass an object by the name of its argument (geometry=, gaze=), or in a list with the first input"
        )


def resolve_file(value: object, name: str) -> Path:
    """Return the file that an argument names.

    Parameters
    ----------
    value : object
        A string, a path, or a field or scene that has a file.
    name : str
        Name of the argument, for messages.

    Returns
    -------
    Path
        The existing file.

    Raises
    ------
    NergError
        The file does not exist, or ``value`` is something else.
    """
    path = getattr(value, "path", None) or value
    if not isinstance(path, (str, os.PathLike)):
        remedy = "; save it and pass the file" if hasattr(value, "save") else ""
        raise NergError(f'"{name}" must be a file, given as a string or a path, got {type(value).__name__}{remedy}')
    if not os.path.exists(path):
        raise MissingFile(f'the file "{os.fspath(path)}" of "{name}" does not exist; correct the path')
    return Path(path)
