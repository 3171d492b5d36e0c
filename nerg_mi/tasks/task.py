"""Parts of long work: what each of them depends on, and the key by which its output is found again.

A part is ``work(common, value, output)``, where ``common`` is the same for all parts of a job. Both are plain values:
frozen dataclasses of options or settings, tuples, numbers, texts, arrays and paths. The key is the digest of all of it,
of paths by the bytes that lie there; options that are declared with ``changes_result=False`` are reset to their
defaults before, so that the work cannot depend on what its key leaves out.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import platform
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache, cached_property
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import file_sha256
from nerg_mi.ranges import CHANGES_RESULT

FORMAT = 2
"""Version of what a key is made of, and of the files in a store."""

FOLDER_SUFFIX = "/"
"""The suffix of outputs that are folders."""

RENDER_LIBRARIES = ("mitsuba", "drjit", "numpy")
"""Distributions on whose versions pictures and trainings depend."""

MAX_PARTS = 500_000
"""So many parts a job may have; each should last a second or more, so that this is a week of work."""

TaskFunction = Callable[[Any, Any, Path], Mapping[str, Any] | None]
"""What runs a part: ``work(common, value, output)`` writes the file ``output``, or fills that folder, which is there
and empty. It may return notes, a few values as JSON has them. A function of a module, since processes find it by its
name. Output and notes are the same for the same arguments, in any process and in any order; an error that the user can
correct is a `NergError`."""


# ---- Files ----


@dataclass(frozen=True)
class FileGroup:
    """A file, or folder, ``path``, with ``all`` files that are read because of it: they are named by where they lie to
    each other, and laid out alike where a worker has to be sent them."""

    path: Path
    members: tuple[Path, ...]


@dataclass(frozen=True)
class InputFile:
    """A file that parts read: its ``name`` in the key and in a layout elsewhere, a relative path with slashes; the
    ``sha256`` (hex) and number (``size``) of its bytes; and the ``path`` where it was when the job was planned, which
    is not in the key."""

    name: str
    sha256: str
    size: int
    path: str

    def __post_init__(self) -> None:
        parts = PurePosixPath(self.name).parts
        if not parts or ".." in parts or PurePosixPath(self.name).is_absolute() or "\\" in self.name:
            raise ValueError(f'an input is called "{self.name}", and it needs a relative path that goes down only')


class Checksums:
    """SHA-256 of files, each computed once while device, inode, size and time of change stay what they are."""

    def __init__(self) -> None:
        self._before: dict[str, tuple[tuple[int, ...], str]] = {}

    def compute(self, path: str | os.PathLike) -> str:
        """Hex digest of the file ``path``. Raises `NergError` for what cannot be read."""
        name = os.path.abspath(path)
        signature = _signature(name)
        before = self._before.get(name)
        if before is not None and before[0] == signature:
            return before[1]
        digest = file_sha256(name)
        # A file that changes meanwhile is read again next time.
        if signature is not None and _signature(name) == signature:
            self._before[name] = (signature, digest)
        return digest

    def is_unchanged(self, file: InputFile) -> bool:
        """Whether the file lies where it was planned, with the same bytes."""
        try:
            return os.path.getsize(file.path) == file.size and self.compute(file.path) == file.sha256
        except (OSError, NergError):
            return False


def _signature(path: str) -> tuple[int, ...] | None:
    try:
        at = os.stat(path)
    except OSError:
        return None
    return at.st_dev, at.st_ino, at.st_size, at.st_mtime_ns


# ---- Values ----


def rebuild_value(value: Any, change: Callable[[Any], Any] = lambda leaf: leaf) -> Any:
    """``value`` with each of its paths and texts through ``change``, and with options that do not change a result at
    their defaults; itself where nothing of it differs."""
    if isinstance(value, (str, Path)):
        return change(value)
    if is_dataclass(value) and not isinstance(value, type):
        new = {}
        for f in fields(value):
            old = getattr(value, f.name)
            one = rebuild_value(old, change) if f.metadata.get(CHANGES_RESULT, True) else f.default
            if one is not old:
                new[f.name] = one
        return replace(value, **new) if new else value
    if isinstance(value, Mapping):
        table = {k: rebuild_value(v, change) for k, v in value.items()}
        return table if any(table[k] is not v for k, v in value.items()) else value
    if isinstance(value, (tuple, list)):
        items = [rebuild_value(v, change) for v in value]
        return type(value)(items) if any(a is not b for a, b in zip(items, value)) else value
    return value


def relocate_paths(value: Any, files: Iterable[InputFile], folder: Path) -> Any:
    """``value`` with the paths of ``files`` where they are laid out by their names, in ``folder``."""
    inputs = {file.path: file for file in files}

    def change(leaf: Any) -> Any:
        if isinstance(leaf, str) and leaf not in inputs:
            return leaf
        name = find_input_name(leaf, inputs)
        return leaf if name is None else type(leaf)(folder / name)

    return rebuild_value(value, change)


def _members(value: Any) -> Iterator[tuple[str, Any]]:
    """The values in a value, by their names."""
    if is_dataclass(value) and not isinstance(value, type):
        yield from ((f.name, getattr(value, f.name)) for f in fields(value))
    elif isinstance(value, Mapping):
        yield from ((str(k), v) for k, v in value.items())
    elif isinstance(value, (tuple, list)):
        yield from ((str(k), v) for k, v in enumerate(value))


def find_inputs(value: Any, checksums: Checksums, prefix: str = "value") -> dict[str, InputFile]:
    """The files of all paths in ``value``, by their whole paths. One that a `Files` lists has its name there; each
    other one is a file of its inside. Raises `NergError` for a file that cannot be read."""
    groups: list[tuple[str, FileGroup]] = []
    alone: list[tuple[str, Path]] = []

    def visit(part: Any, trail: str) -> None:
        if isinstance(part, FileGroup):
            groups.append((trail, part))
        elif isinstance(part, Path):
            alone.append((trail, part))
        elif not isinstance(part, (str, np.ndarray)):
            for name, one in _members(part):
                visit(one, f"{trail}/{re.sub('[^A-Za-z0-9_]', '_', name)}")

    visit(value, prefix)
    inputs: dict[str, InputFile] = {}

    def add(name: str, path: str) -> None:
        if path not in inputs:
            inputs[path] = InputFile(name, checksums.compute(path), os.path.getsize(path), path)

    for trail, group in groups:
        every, whole = [os.path.abspath(path) for path in group.members], os.path.abspath(group.path)
        # A layout begins at the folder that all have in common.
        above = os.path.commonpath([*map(os.path.dirname, every), *([] if whole in every else [whole])])
        for path in every:
            add(f"{trail}/{Path(path).relative_to(above).as_posix()}", path)
    for trail, path in alone:
        if find_input_name(path, inputs) is None:
            add(f"{trail}/{path.name}", os.path.abspath(path))
    return inputs


def find_input_name(path: str | os.PathLike, inputs: Mapping[str, InputFile]) -> str | None:
    """What the file, or folder, ``path`` is called among ``inputs``, by whole paths; None where it is not there."""
    whole = os.path.abspath(path)
    if whole in inputs:
        return inputs[whole].name
    for file in inputs.values():
        below = file.path[len(whole) :]
        if file.path.startswith(whole + os.sep) and file.name.endswith(below):
            return file.name.removesuffix(below)
    return None


def compute_value_digest(value: Any, inputs: Mapping[str, InputFile] = MappingProxyType({})) -> str:
    """SHA-256 (hex) of ``value``, of which paths are the names and bytes of ``inputs``. Raises ``TypeError`` for what
    has no digest."""
    return hashlib.sha256(json.dumps(_plain(value, inputs), sort_keys=True).encode()).hexdigest()


def _plain(value: Any, inputs: Mapping[str, InputFile]) -> Any:
    """``value`` as JSON, equal for equal values only."""
    if value is None or isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, Path) or (isinstance(value, str) and value in inputs):
        file = inputs.get(os.path.abspath(value))
        return {"file": find_input_name(value, inputs) if file is None else [file.name, file.sha256]}
    if isinstance(value, str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray) and not value.dtype.hasobject:
        digest = hashlib.sha256(np.ascontiguousarray(value).data).hexdigest()
        return {"array": [value.dtype.str, list(value.shape), digest]}
    if is_dataclass(value) and not isinstance(value, type):
        return {"class": type(value).__qualname__, "fields": {k: _plain(v, inputs) for k, v in _members(value)}}
    if isinstance(value, Mapping):
        return {"mapping": {str(k): _plain(v, inputs) for k, v in value.items()}}
    if isinstance(value, (tuple, list)):
        return [_plain(v, inputs) for v in value]
    raise TypeError(f"a {type(value).__name__} cannot be part of a key")


# ---- Code ----

_ROOMS = ("nerg_mi", "nerg_mi.plugins", "nerg_mi.scenes")
_LEAVE_OUT = ("cli", "viewer", "tasks")
"""Packages without influence on what a part computes."""


@cache
def compute_code_digest() -> str:
    """Hex digest (16 digits) of the sources that outputs are made by: a version number alone stays what it is while a
    checkout changes."""
    folders = []
    for room in _ROOMS:
        spec = importlib.util.find_spec(room)
        folders += [(room, Path(place)) for place in (spec and spec.submodule_search_locations) or ()]
    return compute_sources_digest(folders)


def compute_sources_digest(folders: Iterable[tuple[str, Path]]) -> str:
    """Hex digest (16 digits) of all Python files in packages, each a name and its folder, except `_LEAVE_OUT`."""
    digest = hashlib.sha256()
    for room, folder in folders:
        for file in sorted(folder.rglob("*.py")):
            name = file.relative_to(folder).as_posix()
            if name.split("/")[0] not in _LEAVE_OUT:
                digest.update(f"{room}/{name}\0".encode() + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]


@cache
def read_processor_name() -> str:
    """What this machine calls its processor, or its kind where it does not say."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())[:120]


# ---- Jobs ----


@dataclass(frozen=True)
class Part:
    """A part's inside ``value``, and what people call it (``label``), which is not in its key."""

    value: Any
    label: str = "a part"


@dataclass(frozen=True)
class Task:
    """A part as it is sent to who runs it: ``files`` are those in its ``value``."""

    key: str
    value: Any
    files: tuple[InputFile, ...]
    suffix: str
    label: str


@dataclass(frozen=True)
class SharedContext:
    """What all tasks of a job have in common, sent once to each process: ``files`` are those in ``common``; ``code``:
    the `code_digest` of who planned."""

    work: TaskFunction
    common: Any
    files: tuple[InputFile, ...]
    code_digest: str


@dataclass(frozen=True, eq=False)
class Plan:
    """The ``parts`` of a job in the order in which their outputs are taken, and their ``work`` with what they have in
    ``common``. ``what`` the job is, as its user calls it, which stays the same when the job is started again: another
    plan of that name replaces this one in a store. ``suffix``: of the outputs (".png"), `FOLDER` for folders;
    ``libraries``: distributions on whose versions the output depends."""

    name: str
    work: TaskFunction
    common: Any
    parts: Sequence[Part]
    suffix: str = ""
    libraries: tuple[str, ...] = RENDER_LIBRARIES
    checksums: Checksums = field(default_factory=Checksums)

    def __post_init__(self) -> None:
        if len(self.parts) > MAX_PARTS:
            raise NergError(f"{self.name} has {len(self.parts):,} parts, and at most {MAX_PARTS:,} are planned; divide it")
        if "<" in self.work.__qualname__:
            raise ValueError(f'"{self.work.__qualname__}" is not a function of a module')
        if not re.fullmatch(r"|/|(\.[A-Za-z0-9]+){1,2}", self.suffix):
            raise ValueError(f'"{self.suffix}" is not the suffix of an output')

    @cached_property
    def _common(self) -> tuple[Any, dict[str, InputFile]]:
        common = rebuild_value(self.common)
        return common, find_inputs(common, self.checksums, "common")

    @cached_property
    def shared(self) -> SharedContext:
        """What is sent once to each process."""
        common, inputs = self._common
        return SharedContext(self.work, common, tuple(inputs.values()), compute_code_digest())

    @cached_property
    def tasks(self) -> list[Task]:
        """A task for each part. Raises `NergError` for files that cannot be read."""
        common, inputs = self._common
        basis = {
            "format": FORMAT,
            "work": f"{self.work.__module__}:{self.work.__qualname__}",
            "common": compute_value_digest(common, inputs),
            "suffix": self.suffix,
            "code": compute_code_digest(),
            "versions": {name: version(name) for name in self.libraries},
        }
        tasks = []
        for part in self.parts:
            value = rebuild_value(part.value)
            inside = find_inputs(value, self.checksums, "part")
            key = compute_value_digest({**basis, "part": compute_value_digest(value, inside)})
            tasks.append(Task(key, value, tuple(inside.values()), self.suffix, part.label))
        return tasks
