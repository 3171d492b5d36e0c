"""What a call of the library is given, looked at before any work: names of options first, then files."""

from __future__ import annotations

import difflib
import os
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeVar

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.rays.rays import Rays

from .arrays import listed
from .fields import TrainedField
from .variant import active_mitsuba

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Options = TypeVar("Options", bound="DataclassInstance")

_WRITTEN = {"pictures", "json_file", "store"}
"""Options that name a file or a folder which is written."""


def options_of(kind: type[Options], job: str, given: Options | None, changes: dict[str, Any]) -> Options:
    """An object of the dataclass ``kind``: ``given`` (or the defaults) with ``changes``, for the variant in use. Files
    may be named by strings.

    Raises `NergError` for an option that the ``job`` has not, naming those that it has, and for a file that is missing
    or is none.
    """
    types = {f.name: str(f.type) for f in fields(kind)}
    if "mode" in changes:
        raise NergError(f"{job} works in the variant that is set; call mi.set_variant({changes['mode']!r}) before it")
    check_names(job, changes, [name for name in types if name != "mode"])
    if "mode" in types:
        changes = {**changes, "mode": active_mitsuba().variant()}
    options = replace(kind() if given is None else given, **changes)
    files = {k: getattr(options, k) for k, of in types.items() if "Path" in of}
    return replace(
        options, **{k: Path(v) if k in _WRITTEN else file_of(v, k) for k, v in files.items() if v is not None}
    )


def check_names(job: str, given: Iterable[str], known: Collection[str], what: str = "option") -> None:
    """Raise `NergError` for a name ``given`` that is none of those ``known``."""
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            meant = f'did you mean "{near[0]}"?' if near else f"it has {listed(list(known))}"
            raise NergError(f'{job} has no {what} "{name}"; {meant}')


def file_of(value: object, name: str) -> Path:
    """The file or folder that the argument ``name`` is: a string, a path, or a field or scene that has a file.

    Raises `NergError` for one that is missing, and for anything else.
    """
    path = getattr(value, "path", None) or value
    if not isinstance(path, (str, os.PathLike)):
        remedy = "save it, and give the file" if hasattr(value, "save") else "give its name"
        raise NergError(f'"{name}" is a file, named by a string or a path, got {type(value).__name__}; {remedy}')
    if not os.path.exists(path):
        raise MissingFile(f'there is no file "{os.fspath(path)}", which "{name}" names; correct its name')
    return Path(path)


def rays_of(value: object) -> Rays | Path:
    """Rays in memory as they are, or their file. Raises `NergError` for anything else."""
    if isinstance(value, Rays):
        return value
    if not isinstance(value, (str, os.PathLike)):
        raise NergError(
            f"rays are what load_rays and import_rays give, or a file of theirs, got {type(value).__name__}; "
            "import_rays makes rays of a table (.csv, .parquet)"
        )
    return file_of(value, "rays")


@contextmanager
def checkpoint_of(value: object, name: str) -> Iterator[Path]:
    """The checkpoint of a field that is the argument ``name``: its file, or one that is written for the block."""
    if isinstance(value, TrainedField) and value.path is None:
        with TemporaryDirectory() as folder:
            yield value.save(Path(folder) / f"{value.kind}.safetensors")
        return
    yield file_of(value, name)
