"""The folder of this process, where workflows find objects in memory as files, and names of these for people."""

from __future__ import annotations

import atexit
import os
import re
import shutil
import tempfile
from pathlib import Path

CHECKSUM_DIGITS = 12
"""Digits of the checksum in the name of an object's file, as in ``environment-0123456789ab.ply``."""

_NAMES = {name: name for name in ("environment", "field", "rays", "areas")}
_NAMES |= {"gaze": "gaze field", "align": "alignment", "what_if": "changes", "surface": "baked surface"}
_folders: list[Path] = []


def session_folder() -> Path:
    """Return the folder for objects of this process; it is removed when the process ends."""
    if not _folders:
        _folders.append(Path(tempfile.mkdtemp(prefix="nerg-mi-")))
        atexit.register(_remove_folder, _folders[0], os.getpid())
    return _folders[0]


def _remove_folder(folder: Path, process: int) -> None:
    # A forked process inherits the registration, and its parent still needs the folder.
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)


def is_object(path: Path) -> bool:
    """Whether a file is that of an object in memory."""
    return bool(_folders) and _folders[0] in path.parents


def display_name(path: Path) -> str:
    """Return the name of a file for people: without its suffix and, of an object in memory, without its checksum."""
    return path.stem[: -CHECKSUM_DIGITS - 1] if is_object(path) else path.stem


def name_objects(text: str) -> str:
    """Replace files of objects in a message by what they contain, as "the environment in memory"."""
    if not _folders:
        return text
    # Copies in other folders are files of the user.
    folder = rf"(?<![\w/\\.-])\"?(?:{re.escape(f'{_folders[0]}{os.sep}')})?"
    pattern = rf"{folder}({'|'.join(_NAMES)})-[0-9a-f]{{{CHECKSUM_DIGITS}}}(?:\.\w+)+(?:/[\w.-]+)?\"?"
    return re.sub(pattern, lambda match: f"the {_NAMES[match[1]]} in memory", text)
