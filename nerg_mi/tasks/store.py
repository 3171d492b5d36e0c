"""The folder that stores outputs of tasks. Each output is named by its key, written atomically, and verified before
use.

The store also records the plans of jobs, so that `nerg jobs` can report completed, missing and stale outputs.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import (
    check_folder,
    create_folder_atomically,
    file_sha256,
    make_folder,
    replace_atomically,
    translate_write_errors,
    write_bytes,
    write_text,
)
from nerg_mi.files.safe_read import is_count, read_json

from .task import FOLDER_SUFFIX, FORMAT, Checksums, Plan, Task, read_processor_name

LEFTOVER_AGE = 3600.0
"""Age in seconds from which unfinished files are attributed to a process that died."""

_MANIFEST_SUFFIX = ".receipt.json"
_SCRATCH_PREFIX = ".scratch-"
_KEY = re.compile(r"[0-9a-f]{64}")
_SUFFIX = re.compile(r"|/|(\.[A-Za-z0-9]+){1,2}")


@dataclass(frozen=True)
class ResultManifest:
    """Manifest of the output of a task.

    Attributes
    ----------
    key
        Key of the task.
    size
        Size of the output in bytes.
    sha256
        Checksum of the output; for a folder, see `compute_digest`.
    seconds
        Run time of the task.
    processor
        Name of the processor that computed it.
    notes
        Notes that the task function returned.
    label
        Name of the part in messages.
    suffix
        Suffix of the output.
    inputs
        SHA-256 of the input files of this part alone, by name.
    """

    key: str
    size: int
    sha256: str
    seconds: float
    processor: str
    notes: Mapping[str, Any]
    label: str
    suffix: str
    inputs: Mapping[str, str]


def make_manifest(task: Task, output: Path, seconds: float, notes: Mapping[str, Any]) -> ResultManifest:
    """Make the manifest of ``output``, which ``task`` has written on this machine."""
    inputs = {file.name: file.sha256 for file in task.files}
    return ResultManifest(
        task.key, *compute_digest(output), seconds, read_processor_name(), notes, task.label, task.suffix, inputs
    )


def read_manifest(path: str | os.PathLike) -> ResultManifest:
    """Read the manifest in the file ``path``. Raises `NergError` if it is damaged or has another version."""
    content = read_json(path, "receipt", 8 << 20)
    names = {f.name for f in fields(ResultManifest)}
    if not isinstance(content, dict) or content.pop("format", None) != FORMAT or set(content) != names:
        raise NergError(
            f'the manifest "{path}" was written by another version; remove it, and its output is computed again'
        )
    types = {name: dict if name in ("notes", "inputs") else str for name in names - {"size", "seconds"}}
    has_valid_types = all(isinstance(content[name], kind) for name, kind in types.items())
    has_valid_numbers = (
        is_count(content["size"]) and isinstance(content["seconds"], (int, float)) and content["seconds"] >= 0
    )
    if not (
        has_valid_types
        and has_valid_numbers
        and _KEY.fullmatch(content["key"])
        and _SUFFIX.fullmatch(content["suffix"])
    ):
        raise NergError(f'the manifest "{path}" is damaged; remove it, and its output is computed again')
    return ResultManifest(**content)


def compute_digest(output: Path) -> tuple[int, str]:
    """Return the size of an output in bytes and its SHA-256 (hex).

    For a folder, the size is the sum over its files, and the digest covers the names and digests of the files. Raises
    `NergError` if the output cannot be read.
    """
    if not output.is_dir():
        return os.stat(output).st_size if output.exists() else 0, file_sha256(output)
    digest, size = hashlib.sha256(), 0
    for file in list_files(output):
        digest.update(f"{file.relative_to(output).as_posix()}\0{file_sha256(file)}\n".encode())
        size += file.stat().st_size
    return size, digest.hexdigest()


def list_files(folder: Path) -> list[Path]:
    """List all files below ``folder`` in an order that does not depend on the machine."""
    return sorted((p for p in folder.rglob("*") if p.is_file()), key=lambda p: p.relative_to(folder).as_posix())


def read_contents(output: Path) -> list[tuple[str, bytes]]:
    """Read the files of an output as (name, bytes) pairs. The name is empty if the output is a file."""
    if not output.is_dir():
        return [("", output.read_bytes())]
    return [(file.relative_to(output).as_posix(), file.read_bytes()) for file in list_files(output)]


class Store:
    """Outputs and their manifests below ``folder``, which is created by the first write.

    Several processes may write at the same time: equal tasks have equal outputs, and each output is renamed into place
    atomically. Raises `NergError` if the folder is not writable.
    """

    def __init__(self, folder: str | os.PathLike):
        check_folder(folder)
        self.folder = Path(os.path.abspath(folder))

    def output_path(self, key: str, suffix: str) -> Path:
        """Return the path of the output of the task ``key``, whether or not it exists."""
        return self.folder / key[:2] / f"{key}{'' if suffix == FOLDER_SUFFIX else suffix}"

    def manifest_path(self, key: str) -> Path:
        """Return the path of the manifest of the task ``key``, whether or not it exists."""
        return self.folder / key[:2] / f"{key}{_MANIFEST_SUFFIX}"

    def read_manifest(self, key: str) -> ResultManifest | None:
        """Read the manifest of the task ``key``; None if it is missing, damaged or of another version."""
        file = self.manifest_path(key)
        if not file.exists():
            return None
        try:
            manifest = read_manifest(file)
        except NergError:
            return None
        return manifest if manifest.key == key else None

    def find_valid(self, key: str, suffix: str) -> ResultManifest | None:
        """Return the manifest of an output if the output exists and matches its checksum; otherwise None."""
        manifest, output = self.read_manifest(key), self.output_path(key, suffix)
        if manifest is None or not output.exists():
            return None
        try:
            is_intact = compute_digest(output) == (manifest.size, manifest.sha256)
        except NergError:
            return None
        return manifest if is_intact else None

    @contextmanager
    def write_output(self, task: Task) -> Iterator[Path]:
        """Yield the path of a new file or folder, which becomes the output of ``task`` at the end of the block."""
        output = self.output_path(task.key, task.suffix)
        if task.suffix != FOLDER_SUFFIX:
            with replace_atomically(output) as temporary:
                yield temporary
            return
        # `find_valid` has found no intact output there.
        shutil.rmtree(output, ignore_errors=True)
        with create_folder_atomically(output) as temporary:
            yield temporary

    def add_manifest(self, manifest: ResultManifest) -> None:
        """Write the manifest of an output that is in place. From now on, the task counts as done."""
        text = json.dumps({"format": FORMAT, **asdict(manifest)}, sort_keys=True, indent=1)
        write_text(self.manifest_path(manifest.key), text + "\n")

    def import_output(self, task: Task, manifest: ResultManifest, content: Sequence[tuple[str, bytes]]) -> None:
        """Write an output that was computed elsewhere and read with `read_contents`.

        Raises `NergError` if its bytes do not match the ``manifest``.
        """
        with self.write_output(task) as temporary:
            for name, data in content:
                write_bytes(temporary / name if name else temporary, data)
            if compute_digest(temporary) != (manifest.size, manifest.sha256):
                raise NergError(f"{task.label} was corrupted in transfer; start the job again")
        self.add_manifest(manifest)

    def remove(self, key: str, suffix: str) -> None:
        """Remove an output and its manifest, the manifest first."""
        with translate_write_errors(self.folder):
            self.manifest_path(key).unlink(missing_ok=True)
            output = self.output_path(key, suffix)
            shutil.rmtree(output) if output.is_dir() else output.unlink(missing_ok=True)

    def iter_manifests(self) -> Iterator[ResultManifest]:
        """Iterate over all readable manifests in the order of their keys."""
        for file in sorted(self.folder.glob(f"[0-9a-f][0-9a-f]/*{_MANIFEST_SUFFIX}")):
            manifest = self.read_manifest(file.name.removesuffix(_MANIFEST_SUFFIX))
            if manifest is not None:
                yield manifest

    def find_leftovers(self, min_age: float) -> list[Path]:
        """Return what terminated processes have left, if it was not modified for ``min_age`` seconds.

        Leftovers are hidden temporary files and folders, outputs without a manifest, and scratch folders.
        """
        keys = {receipt.key for receipt in self.iter_manifests()}
        paths = [
            path
            for path in sorted(self.folder.glob("[0-9a-f][0-9a-f]/*"))
            if path.name.removesuffix(_MANIFEST_SUFFIX).partition(".")[0] not in keys
        ]
        paths += sorted(self.folder.glob(f"{_SCRATCH_PREFIX}*"))
        return [path for path in paths if time.time() - path.lstat().st_mtime > min_age]

    @contextmanager
    def make_scratch_folder(self) -> Iterator[Path]:
        """Create a folder in the store for files that a job writes and its parts read. It is removed at the end
        of the block.
        """
        with TemporaryDirectory(prefix=_SCRATCH_PREFIX, dir=make_folder(self.folder)) as folder:
            yield Path(folder)

    # ---- Plans ----

    def save_plan(self, plan: Plan) -> Path:
        """Record the requirements of ``plan``, so that its outputs do not count as stale."""
        files = [*plan.shared.files, *(file for task in plan.tasks for file in task.files)]
        # Files in the store are outputs of other parts or scratch files, which are computed again if necessary.
        inputs = {file.path: file.sha256 for file in files if self.folder not in Path(file.path).parents}
        common = sorted({inputs[file.path] for file in plan.shared.files if file.path in inputs})
        path = self.folder / "plans" / f"{hashlib.sha256(plan.name.encode()).hexdigest()[:16]}.json"
        keys = {task.key: task.suffix for task in plan.tasks}
        content = {"format": FORMAT, "what": plan.name, "inputs": inputs, "common": common, "keys": keys}
        write_text(path, json.dumps(content) + "\n")
        return path

    def read_plans(self) -> list[StoredPlan]:
        """Read all plans, sorted by name. Raises `NergError` for a damaged one."""
        plans = [read_plan(path) for path in sorted(self.folder.glob("plans/*.json"))]
        return sorted(plans, key=lambda plan: plan.name)


@dataclass(frozen=True)
class StoredPlan:
    """A plan in a store.

    Attributes
    ----------
    name
        Name of the job.
    keys
        Suffix of the output of each task by key.
    inputs
        SHA-256 of the input files by path.
    common
        SHA-256 of the input files that all tasks read.
    """

    name: str
    keys: dict[str, str]
    inputs: dict[str, str]
    common: frozenset[str]


def read_plan(path: str | os.PathLike) -> StoredPlan:
    """Read the plan in the file ``path``. Raises `NergError` if it is damaged or has another version."""
    content = read_json(path, "plan")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise NergError(
            f'the plan "{path}" was written by another version of nerg_mi; remove the store and start the job again'
        )
    mappings = [content.get("inputs"), content.get("keys")]
    is_valid = isinstance(content.get("what"), str) and isinstance(content.get("common"), list)
    is_valid = is_valid and all(isinstance(t, dict) and all(isinstance(v, str) for v in t.values()) for t in mappings)
    is_valid = is_valid and all(isinstance(digest, str) for digest in content["common"])
    # Outputs are read and removed by these names, so they must not lead out of the store.
    is_valid = is_valid and all(_KEY.fullmatch(k) and _SUFFIX.fullmatch(v) for k, v in content["keys"].items())
    if not is_valid:
        raise NergError(f'the plan "{path}" is damaged; remove it and start its job again')
    return StoredPlan(content["what"], content["keys"], content["inputs"], frozenset(content["common"]))


# ---- Status of a store ----


@dataclass(frozen=True)
class JobStatus:
    """Progress of one job.

    Attributes
    ----------
    name
        Name of the job.
    total
        Number of parts.
    done
        Number of completed parts.
    bytes
        Size of the completed outputs.
    seconds
        Run time of the completed parts.
    changed
        Input files that have changed since.
    missing
        Input files that do not exist any more.
    outdated
        Number of completed parts that used changed files.
    """

    name: str
    total: int
    done: int
    bytes: int
    seconds: float
    changed: tuple[str, ...]
    missing: tuple[str, ...]
    outdated: int

    @property
    def remaining(self) -> int:
        """Number of parts that are not complete."""
        return self.total - self.done


@dataclass(frozen=True)
class StoreStatus:
    """Contents of a store.

    Attributes
    ----------
    jobs
        Status of each job.
    stale
        Outputs that no current plan requires, and outputs that were computed from files that have changed since.
    leftovers
        Files and folders that terminated processes have left.
    bytes
        Size of all outputs.
    leftover_bytes
        Size of the leftovers.
    """

    jobs: tuple[JobStatus, ...]
    stale: tuple[ResultManifest, ...]
    leftovers: tuple[Path, ...]
    bytes: int
    leftover_bytes: int

    @property
    def stale_bytes(self) -> int:
        """Size of the stale outputs."""
        return sum(manifest.size for manifest in self.stale)


def read_status(store: Store, age: float = LEFTOVER_AGE) -> StoreStatus:
    """Read the status of ``store``. Unfinished files count as leftovers after ``age`` seconds.

    Outputs are not verified; that happens before they are used. Raises `NergError` if there is no store, or its plans
    cannot be read.
    """
    plans = store.read_plans()
    if not plans and not any(store.folder.glob("[0-9a-f][0-9a-f]")):
        raise NergError(
            f'"{store.folder}" contains no parts of jobs; specify the folder that was passed as {parameter("store")}'
        )
    manifests = {receipt.key: receipt for receipt in store.iter_manifests()}
    checksums = Checksums()
    jobs, required = [], set[str]()
    for plan in plans:
        job, current = _check_job(plan, manifests, checksums)
        jobs.append(job)
        required |= current
    leftovers = tuple(store.find_leftovers(age))
    stale = tuple(receipt for key, receipt in manifests.items() if key not in required)
    size = sum(receipt.size for receipt in manifests.values())
    return StoreStatus(tuple(jobs), stale, leftovers, size, sum(map(_count_bytes, leftovers)))


def _check_job(
    plan: StoredPlan, manifests: dict[str, ResultManifest], checksums: Checksums
) -> tuple[JobStatus, set[str]]:
    """Return the status of a plan, and the keys of its tasks that are not outdated."""
    missing, changed, digests, unchanged = [], [], set[str](), set[str]()
    for path, digest in plan.inputs.items():
        if not Path(path).is_file():
            # Whether the file has changed is unknown.
            missing.append(path)
        elif checksums.compute(path) != digest:
            changed.append(path)
            digests.add(digest)
            continue
        unchanged.add(digest)
    # Another file may still have the same bytes.
    digests -= unchanged
    done = [manifests[key] for key in plan.keys if key in manifests]
    outdated = {r.key for r in done if digests & plan.common or digests & set(r.inputs.values())}
    size, seconds = sum(receipt.size for receipt in done), sum(receipt.seconds for receipt in done)
    status = JobStatus(
        plan.name, len(plan.keys), len(done), size, seconds, tuple(changed), tuple(missing), len(outdated)
    )
    return status, set(plan.keys) - outdated


def delete_stale(store: Store, status: StoreStatus) -> int:
    """Remove the stale outputs and leftovers of ``status`` from ``store``. Returns the number of freed bytes."""
    for manifest in status.stale:
        store.remove(manifest.key, manifest.suffix)
    for path in status.leftovers:
        with translate_write_errors(path):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    return status.stale_bytes + status.leftover_bytes


def _count_bytes(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.lstat().st_size for file in files if file.is_file())
