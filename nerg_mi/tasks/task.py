"""Parts of a job and the keys under which their outputs are stored.

A part is a call ``work(common, value, output)``, where ``common`` is the same for all parts of the job. Both values are
plain data: frozen dataclasses of options or settings, tuples, numbers, strings, arrays and paths. The key is a digest
of all of it; a path contributes the bytes of its file. Options that are declared with ``changes_result=False`` are
reset to their defaults before the call, so that the output cannot depend on values that are not in the key.
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
"""Version of the contents of a key, and of the files in a store."""

FOLDER_SUFFIX = "/"
"""Suffix of outputs that are folders."""

RENDER_LIBRARIES = ("mitsuba", "drjit", "numpy")
"""Distributions whose versions affect images and trainings."""

MAX_PARTS = 500_000
"""Maximum number of parts of a job. A part should take a second or more, so that this is about a week of work."""

TaskFunction = Callable[[Any, Any, Path], Mapping[str, Any] | None]
"""Function that computes a part: ``work(common, value, output)`` writes the file ``output``, or fills that folder,
which exists and is empty. It may return notes: a few JSON values. It must be a module-level function, because processes
import it by name. It must be deterministic, in any process and in any order. Errors that the user can fix are
`NergError`."""


# ---- Files ----


@dataclass(frozen=True)
class FileGroup:
    """A file or folder ``path`` with all files ``members`` that are read with it.

    The members are named by their relative positions, and are written in the same layout on a worker that lacks them.
    """

    path: Path
    members: tuple[Path, ...]


@dataclass(frozen=True)
class InputFile:
    """An input file of parts.

    Attributes
    ----------
    name
        Relative path with slashes; the name in the key and in the layout on another machine.
    sha256
        Checksum (hex).
    size
        Size in bytes.
    path
        Path when the job was planned; not part of the key.
    """

    name: str
    sha256: str
    size: int
    path: str

    def __post_init__(self) -> None:
        parts = PurePosixPath(self.name).parts
        if not parts or ".." in parts or PurePosixPath(self.name).is_absolute() or "\\" in self.name:
            raise ValueError(f'the input name "{self.name}" is not a relative path without ".."')


class Checksums:
    """Cache of SHA-256 checksums of files. An entry is valid while device, inode, size and modification time are
    unchanged.
    """

    def __init__(self) -> None:
        self._digests: dict[str, tuple[tuple[int, ...], str]] = {}

    def compute(self, path: str | os.PathLike) -> str:
        """Return the SHA-256 (hex) of the file ``path``. Raises `NergError` if it cannot be read."""
        name = os.path.abspath(path)
        signature = _read_signature(name)
        previous = self._digests.get(name)
        if previous is not None and previous[0] == signature:
            return previous[1]
        digest = file_sha256(name)
        # A file that changed during the read is not cached.
        if signature is not None and _read_signature(name) == signature:
            self._digests[name] = (signature, digest)
        return digest

    def is_unchanged(self, file: InputFile) -> bool:
        """Return whether the file exists at its planned path with the same bytes."""
        try:
            return os.path.getsize(file.path) == file.size and self.compute(file.path) == file.sha256
        except (OSError, NergError):
            return False


def _read_signature(path: str) -> tuple[int, ...] | None:
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


# ---- Values ----


def rebuild_value(value: Any, change: Callable[[Any], Any] = lambda leaf: leaf) -> Any:
    """Return ``value`` with ``change`` applied to each path and string, and with options that do not affect results
    reset.

    Returns the same object if nothing changes.
    """
    if isinstance(value, (str, Path)):
        return change(value)
    if is_dataclass(value) and not isinstance(value, type):
        changes = {}
        for f in fields(value):
            old = getattr(value, f.name)
            new_value = rebuild_value(old, change) if f.metadata.get(CHANGES_RESULT, True) else f.default
            if new_value is not old:
                changes[f.name] = new_value
        return replace(value, **changes) if changes else value
    if isinstance(value, Mapping):
        table = {k: rebuild_value(v, change) for k, v in value.items()}
        return table if any(table[k] is not v for k, v in value.items()) else value
    if isinstance(value, (tuple, list)):
        items = [rebuild_value(v, change) for v in value]
        return type(value)(items) if any(a is not b for a, b in zip(items, value)) else value
    return value


def relocate_paths(value: Any, files: Iterable[InputFile], folder: Path) -> Any:
    """Return ``value`` with the paths of ``files`` replaced by their layout in ``folder``."""
    inputs = {file.path: file for file in files}

    def change(leaf: Any) -> Any:
        if isinstance(leaf, str) and leaf not in inputs:
            return leaf
        name = find_input_name(leaf, inputs)
        return leaf if name is None else type(leaf)(folder / name)

    return rebuild_value(value, change)


def _iter_members(value: Any) -> Iterator[tuple[str, Any]]:
    """Iterate over the direct members of a value by name."""
    if is_dataclass(value) and not isinstance(value, type):
        yield from ((f.name, getattr(value, f.name)) for f in fields(value))
    elif isinstance(value, Mapping):
        yield from ((str(k), v) for k, v in value.items())
    elif isinstance(value, (tuple, list)):
        yield from ((str(k), v) for k, v in enumerate(value))


def find_inputs(value: Any, checksums: Checksums, prefix: str = "value") -> dict[str, InputFile]:
    """Return the files of all `Path` and `FileGroup` objects in ``value``, by absolute path; strings are ignored.

    Members of a `FileGroup` get names relative to the group; another file is named by its position in ``value``. All
    names begin with ``prefix``. Raises `NergError` for a file that cannot be read.
    """
    groups: list[tuple[str, FileGroup]] = []
    single_paths: list[tuple[str, Path]] = []

    def visit(part: Any, trail: str) -> None:
        if isinstance(part, FileGroup):
            groups.append((trail, part))
        elif isinstance(part, Path):
            single_paths.append((trail, part))
        elif not isinstance(part, (str, np.ndarray)):
            for name, one in _iter_members(part):
                visit(one, f"{trail}/{re.sub('[^A-Za-z0-9_]', '_', name)}")

    visit(value, prefix)
    inputs: dict[str, InputFile] = {}

    def add(name: str, path: str) -> None:
        if path not in inputs:
            inputs[path] = InputFile(name, checksums.compute(path), os.path.getsize(path), path)

    for trail, group in groups:
        members, group_path = [os.path.abspath(path) for path in group.members], os.path.abspath(group.path)
        # The layout starts at the common parent folder.
        base = os.path.commonpath([*map(os.path.dirname, members), *([] if group_path in members else [group_path])])
        for path in members:
            add(f"{trail}/{Path(path).relative_to(base).as_posix()}", path)
    for trail, path in single_paths:
        if find_input_name(path, inputs) is None:
            add(f"{trail}/{path.name}", os.path.abspath(path))
    return inputs


def find_input_name(path: str | os.PathLike, inputs: Mapping[str, InputFile]) -> str | None:
    """Return the name of the file or folder ``path`` among ``inputs``, by absolute path; None if it is not among
    them.
    """
    absolute = os.path.abspath(path)
    if absolute in inputs:
        return inputs[absolute].name
    for file in inputs.values():
        relative = file.path[len(absolute) :]
        if file.path.startswith(absolute + os.sep) and file.name.endswith(relative):
            return file.name.removesuffix(relative)
    return None


def compute_value_digest(value: Any, inputs: Mapping[str, InputFile] = MappingProxyType({})) -> str:
    """Return the SHA-256 (hex) of ``value``. Paths are represented by the names and checksums of ``inputs``.

    Raises ``TypeError`` for a value of an unsupported type.
    """
    return hashlib.sha256(json.dumps(_to_plain(value, inputs), sort_keys=True).encode()).hexdigest()


def _to_plain(value: Any, inputs: Mapping[str, InputFile]) -> Any:
    """Convert ``value`` to JSON values that are equal only for equal values."""
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
        return {"class": type(value).__qualname__, "fields": {k: _to_plain(v, inputs) for k, v in _iter_members(value)}}
    if isinstance(value, Mapping):
        return {"mapping": {str(k): _to_plain(v, inputs) for k, v in value.items()}}
    if isinstance(value, (tuple, list)):
        return [_to_plain(v, inputs) for v in value]
    raise TypeError(f"a {type(value).__name__} cannot be part of a key")


# ---- Code ----

_CODE_PACKAGES = ("nerg_mi", "nerg_mi.plugins", "nerg_mi.scenes")
_EXCLUDED_PACKAGES = ("cli", "viewer", "tasks")
"""Packages that do not affect the results of parts."""


@cache
def compute_code_digest() -> str:
    """Return a digest (16 hex digits) of the source files that affect outputs.

    The version number is not sufficient: it does not change when a checkout is edited.
    """
    folders = []
    for package in _CODE_PACKAGES:
        spec = importlib.util.find_spec(package)
        # In a checkout, the second location of the package is the root, with tests and the environment.
        folders += [(package, Path(folder)) for folder in list((spec and spec.submodule_search_locations) or ())[:1]]
    return compute_sources_digest(folders)


def compute_sources_digest(folders: Iterable[tuple[str, Path]]) -> str:
    """Return a digest (16 hex digits) of all Python files of packages, except `_EXCLUDED_PACKAGES`.

    Parameters
    ----------
    folders
        Name and folder of each package.
    """
    digest = hashlib.sha256()
    for package, folder in folders:
        for file in sorted(folder.rglob("*.py")):
            name = file.relative_to(folder).as_posix()
            if name.split("/")[0] not in _EXCLUDED_PACKAGES:
                digest.update(f"{package}/{name}\0".encode() + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()[:16]


@cache
def read_processor_name() -> str:
    """Return the name of the processor, or the machine type if the name is unknown."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())[:120]


# ---- Jobs ----


@dataclass(frozen=True)
class Part:
    """Input ``value`` of a part, and its ``label`` for messages, which is not part of the key."""

    value: Any
    label: str = "a part"


@dataclass(frozen=True)
class Task:
    """A part as it is sent to a worker. ``files`` are the input files in its ``value``."""

    key: str
    value: Any
    files: tuple[InputFile, ...]
    suffix: str
    label: str


@dataclass(frozen=True)
class SharedContext:
    """What all tasks of a job share; sent once to each process.

    Attributes
    ----------
    work
        Function that computes a part.
    common
        Common input of all parts.
    files
        Input files in ``common``.
    code_digest
        Digest of the source code of the process that planned the job.
    """

    work: TaskFunction
    common: Any
    files: tuple[InputFile, ...]
    code_digest: str


@dataclass(frozen=True, eq=False)
class Plan:
    """The parts of a job and the function that computes them.

    Attributes
    ----------
    name
        Name of the job for the user. It stays the same when the job is started again: a plan replaces an earlier plan
        of the same name in a store.
    work
        Function that computes a part.
    common
        Common input of all parts.
    parts
        The parts, in the order in which their outputs are consumed.
    suffix
        Suffix of the outputs (".png"); `FOLDER_SUFFIX` for folders.
    libraries
        Distributions whose versions affect the outputs.
    checksums
        Cache of checksums of input files.
    """

    name: str
    work: TaskFunction
    common: Any
    parts: Sequence[Part]
    suffix: str = ""
    libraries: tuple[str, ...] = RENDER_LIBRARIES
    checksums: Checksums = field(default_factory=Checksums)

    def __post_init__(self) -> None:
        if len(self.parts) > MAX_PARTS:
            raise NergError(f"{self.name} has {len(self.parts):,} parts; the limit is {MAX_PARTS:,}; split the job")
        if "<" in self.work.__qualname__:
            raise ValueError(f'"{self.work.__qualname__}" is not a module-level function')
        if not re.fullmatch(r"|/|(\.[A-Za-z0-9]+){1,2}", self.suffix):
            raise ValueError(f'"{self.suffix}" is not a valid output suffix')

    @cached_property
    def _common_inputs(self) -> tuple[Any, dict[str, InputFile]]:
        common = rebuild_value(self.common)
        return common, find_inputs(common, self.checksums, "common")

    @cached_property
    def shared(self) -> SharedContext:
        """Context that is sent once to each process."""
        common, inputs = self._common_inputs
        return SharedContext(self.work, common, tuple(inputs.values()), compute_code_digest())

    @cached_property
    def tasks(self) -> list[Task]:
        """One task for each part. Raises `NergError` for files that cannot be read."""
        common, inputs = self._common_inputs
        job_key = {
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
            part_inputs = find_inputs(value, self.checksums, "part")
            key = compute_value_digest({**job_key, "part": compute_value_digest(value, part_inputs)})
            tasks.append(Task(key, value, tuple(part_inputs.values()), self.suffix, part.label))
        return tasks
