"""The folder in which outputs of parts are kept, each named by its key, whole or absent, verified before use; and what
it remembers of jobs, so that it can be said what is done, left and stale."""

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

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import (
    check_folder,
    file_sha256,
    make_folder,
    replace_atomically,
    create_folder_atomically,
    write_bytes,
    write_text,
    translate_write_errors,
)
from nerg_mi.files.safe_read import is_count, read_json

from .task import FOLDER_SUFFIX, FORMAT, Checksums, Plan, Task, read_processor_name

LEFTOVER_AGE = 3600.0
"""Seconds after which unfinished files count as left by a process that died."""

_RECEIPT = ".receipt.json"
_SCRATCH = ".scratch-"
_KEY = re.compile(r"[0-9a-f]{64}")
_SUFFIX = re.compile(r"|/|(\.[A-Za-z0-9]+){1,2}")


@dataclass(frozen=True)
class ResultManifest:
    """That of the output of the task ``key``: its ``size`` in bytes and ``sha256`` (of a folder `digest_of`), the
    ``seconds`` that it took, the ``processor`` that made it, the ``notes`` of the work, and the SHA-256 of the
    ``inputs`` of that part alone, by their names."""

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
    """The receipt of ``output``, which ``task`` made here in so many ``seconds``."""
    inputs = {file.name: file.sha256 for file in task.files}
    return ResultManifest(task.key, *compute_digest(output), seconds, read_processor_name(), notes, task.label, task.suffix, inputs)


def read_manifest(path: str | os.PathLike) -> ResultManifest:
    """The receipt in the file ``path``. Raises `NergError` for one that is damaged or of another version."""
    content = read_json(path, "receipt", 8 << 20)
    names = {f.name for f in fields(ResultManifest)}
    if not isinstance(content, dict) or content.pop("format", None) != FORMAT or set(content) != names:
        raise NergError(f'the receipt "{path}" is not of this version; remove it, and its output is made again')
    kinds = {name: dict if name in ("notes", "inputs") else str for name in names - {"size", "seconds"}}
    whole = all(isinstance(content[name], kind) for name, kind in kinds.items())
    numbers = is_count(content["size"]) and isinstance(content["seconds"], (int, float)) and content["seconds"] >= 0
    if not (whole and numbers and _KEY.fullmatch(content["key"]) and _SUFFIX.fullmatch(content["suffix"])):
        raise NergError(f'the receipt "{path}" is damaged; remove it, and its output is made again')
    return ResultManifest(**content)


def compute_digest(output: Path) -> tuple[int, str]:
    """Bytes of an output and their SHA-256 (hex); of a folder the sum, and that of its files' names and digests. Raises
    `NergError` where it cannot be read."""
    if not output.is_dir():
        return os.stat(output).st_size if output.exists() else 0, file_sha256(output)
    digest, size = hashlib.sha256(), 0
    for file in list_files(output):
        digest.update(f"{file.relative_to(output).as_posix()}\0{file_sha256(file)}\n".encode())
        size += file.stat().st_size
    return size, digest.hexdigest()


def list_files(folder: Path) -> list[Path]:
    """All files below ``folder``, in an order that does not depend on the machine."""
    return sorted((p for p in folder.rglob("*") if p.is_file()), key=lambda p: p.relative_to(folder).as_posix())


def read_contents(output: Path) -> list[tuple[str, bytes]]:
    """Names and bytes of the files of an output; the name is empty where the output is a file."""
    if not output.is_dir():
        return [("", output.read_bytes())]
    return [(file.relative_to(output).as_posix(), file.read_bytes()) for file in list_files(output)]


class Store:
    """Outputs and their receipts below ``folder``, which is made when the first is written.

    Any number of processes may write into it at once: equal tasks have equal outputs, and each takes its place in one
    step. Raises `NergError` where nothing can be written there.
    """

    def __init__(self, folder: str | os.PathLike):
        check_folder(folder)
        self.folder = Path(os.path.abspath(folder))

    def output_path(self, key: str, suffix: str) -> Path:
        """Where the output of the task ``key`` is, or will be."""
        return self.folder / key[:2] / f"{key}{'' if suffix == FOLDER_SUFFIX else suffix}"

    def manifest_path(self, key: str) -> Path:
        """Where its receipt is, or will be."""
        return self.folder / key[:2] / f"{key}{_RECEIPT}"

    def read_manifest(self, key: str) -> ResultManifest | None:
        """The receipt of the task ``key``; None where there is none, or it is damaged or of another version: what
        cannot be verified is made again."""
        file = self.manifest_path(key)
        if not file.exists():
            return None
        try:
            receipt = read_manifest(file)
        except NergError:
            return None
        return receipt if receipt.key == key else None

    def find_valid(self, key: str, suffix: str) -> ResultManifest | None:
        """The receipt of an output that is there and has the bytes that it had when it was made; None otherwise."""
        receipt, output = self.read_manifest(key), self.output_path(key, suffix)
        if receipt is None or not output.exists():
            return None
        try:
            whole = compute_digest(output) == (receipt.size, receipt.sha256)
        except NergError:
            return None
        return receipt if whole else None

    @contextmanager
    def write_output(self, task: Task) -> Iterator[Path]:
        """The name of a new file, or folder, that becomes the output of ``task`` when the block ends."""
        output = self.output_path(task.key, task.suffix)
        if task.suffix != FOLDER_SUFFIX:
            with replace_atomically(output) as temporary:
                yield temporary
            return
        # `find` has seen no whole one there.
        shutil.rmtree(output, ignore_errors=True)
        with create_folder_atomically(output) as temporary:
            yield temporary

    def add_manifest(self, manifest: ResultManifest) -> None:
        """Write the ``receipt`` of an output that is in its place: from now on it counts as made."""
        text = json.dumps({"format": FORMAT, **asdict(manifest)}, sort_keys=True, indent=1)
        write_text(self.manifest_path(manifest.key), text + "\n")

    def import_output(self, task: Task, manifest: ResultManifest, content: Sequence[tuple[str, bytes]]) -> None:
        """Write an output that was made elsewhere, as `content_of` gave it there. Raises `NergError` where the bytes
        are not those of the ``receipt``."""
        with self.write_output(task) as temporary:
            for name, data in content:
                write_bytes(temporary / name if name else temporary, data)
            if compute_digest(temporary) != (manifest.size, manifest.sha256):
                raise NergError(f"{task.label} arrived with other bytes than it was sent with; start the job again")
        self.add_manifest(manifest)

    def remove(self, key: str, suffix: str) -> None:
        """Remove an output with its receipt, the receipt first."""
        with translate_write_errors(self.folder):
            self.manifest_path(key).unlink(missing_ok=True)
            output = self.output_path(key, suffix)
            shutil.rmtree(output) if output.is_dir() else output.unlink(missing_ok=True)

    def iter_manifests(self) -> Iterator[ResultManifest]:
        """All receipts that can be read, by their keys."""
        for file in sorted(self.folder.glob(f"[0-9a-f][0-9a-f]/*{_RECEIPT}")):
            receipt = self.read_manifest(file.name.removesuffix(_RECEIPT))
            if receipt is not None:
                yield receipt

    def find_leftovers(self, min_age: float) -> list[Path]:
        """What processes that died have left unfinished: hidden files and folders that nobody has written to for
        ``older`` seconds, outputs without a receipt, and scratch folders."""
        keys = {receipt.key for receipt in self.iter_manifests()}
        paths = [
            path
            for path in sorted(self.folder.glob("[0-9a-f][0-9a-f]/*"))
            if path.name.removesuffix(_RECEIPT).partition(".")[0] not in keys
        ]
        paths += sorted(self.folder.glob(f"{_SCRATCH}*"))
        return [path for path in paths if time.time() - path.lstat().st_mtime > min_age]

    @contextmanager
    def make_scratch_folder(self) -> Iterator[Path]:
        """A folder in the store for files that a job makes for its parts to read, removed when the block ends."""
        with TemporaryDirectory(prefix=_SCRATCH, dir=make_folder(self.folder)) as folder:
            yield Path(folder)

    # ---- Plans ----

    def save_plan(self, plan: Plan) -> Path:
        """Write down what ``plan`` needs, so that its outputs count as wanted."""
        every = [*plan.shared.files, *(file for task in plan.tasks for file in task.files)]
        # What lies in the store was made by other parts, or for these, and is made again where it has to be.
        inputs = {file.path: file.sha256 for file in every if self.folder not in Path(file.path).parents}
        common = sorted({inputs[file.path] for file in plan.shared.files if file.path in inputs})
        path = self.folder / "plans" / f"{hashlib.sha256(plan.name.encode()).hexdigest()[:16]}.json"
        keys = {task.key: task.suffix for task in plan.tasks}
        content = {"format": FORMAT, "what": plan.name, "inputs": inputs, "common": common, "keys": keys}
        write_text(path, json.dumps(content) + "\n")
        return path

    def read_plans(self) -> list[StoredPlan]:
        """All plans, by their names. Raises `NergError` for one that is damaged."""
        plans = [read_plan(path) for path in sorted(self.folder.glob("plans/*.json"))]
        return sorted(plans, key=lambda plan: plan.name)


@dataclass(frozen=True)
class StoredPlan:
    """A plan as a store has it: the ``keys`` of its tasks with their suffixes, the SHA-256 of the ``inputs`` by path,
    where they were, and those of them that all tasks read, ``common``."""

    name: str
    keys: dict[str, str]
    inputs: dict[str, str]
    common: frozenset[str]


def read_plan(path: str | os.PathLike) -> StoredPlan:
    """The plan in the file ``path``. Raises `NergError` for one that is damaged or of another version."""
    content = read_json(path, "plan")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise NergError(
            f'the plan "{path}" was written by another version of nerg_mi; remove its store, and start the job again'
        )
    texts = [content.get("inputs"), content.get("keys")]
    good = isinstance(content.get("what"), str) and isinstance(content.get("common"), list)
    good = good and all(isinstance(t, dict) and all(isinstance(v, str) for v in t.values()) for t in texts)
    good = good and all(isinstance(digest, str) for digest in content["common"])
    # Outputs are looked for, and removed, by these names: none may lead out of the store.
    good = good and all(_KEY.fullmatch(k) and _SUFFIX.fullmatch(v) for k, v in content["keys"].items())
    if not good:
        raise NergError(f'the plan "{path}" is damaged; remove it, and start its job again')
    return StoredPlan(content["what"], content["keys"], content["inputs"], frozenset(content["common"]))


# ---- What is done, left and stale ----


@dataclass(frozen=True)
class JobStatus:
    """How far one job is: ``done`` of ``total`` parts, with ``bytes`` of output that took ``seconds`` to make;
    ``changed``: its inputs that have other bytes by now, ``gone``: those that are not there any more; ``outdated``:
    parts that are done and were made of what was changed."""

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
        """Parts that are not there yet."""
        return self.total - self.done


@dataclass(frozen=True)
class StoreStatus:
    """``jobs`` of a store; ``stale``: outputs that no job asks for any more, as it was started last, and those that
    were made of files that were changed since; ``leftovers``: what processes that died have left; ``bytes`` of all
    outputs."""

    jobs: tuple[JobStatus, ...]
    stale: tuple[ResultManifest, ...]
    leftovers: tuple[Path, ...]
    bytes: int
    leftover_bytes: int

    @property
    def stale_bytes(self) -> int:
        """Bytes that removing what is stale gives back."""
        return sum(receipt.size for receipt in self.stale)


def read_status(store: Store, age: float = LEFTOVER_AGE) -> StoreStatus:
    """What ``store`` holds; unfinished files count as leftovers after ``age`` seconds. Outputs are not read: whether
    they are whole is verified before they are used. Raises `NergError` where there is no store, or its plans cannot be
    read."""
    plans = store.read_plans()
    if not plans and not any(store.folder.glob("[0-9a-f][0-9a-f]")):
        raise NergError(f'"{store.folder}" holds no parts of jobs; name the folder that was given as --store')
    receipts = {receipt.key: receipt for receipt in store.iter_manifests()}
    checksums = Checksums()
    jobs, wanted = [], set[str]()
    for plan in plans:
        job, current = _job(plan, receipts, checksums)
        jobs.append(job)
        wanted |= current
    leftovers = tuple(store.find_leftovers(age))
    stale = tuple(receipt for key, receipt in receipts.items() if key not in wanted)
    size = sum(receipt.size for receipt in receipts.values())
    return StoreStatus(tuple(jobs), stale, leftovers, size, sum(map(_size, leftovers)))


def _job(plan: StoredPlan, receipts: dict[str, ResultManifest], checksums: Checksums) -> tuple[JobStatus, set[str]]:
    """How far a plan is, and the keys of what it asks for that is not out of date."""
    gone, changed, digests, others = [], [], set[str](), set[str]()
    for path, digest in plan.inputs.items():
        if not Path(path).is_file():
            # Nobody can say whether it was changed.
            gone.append(path)
        elif checksums.compute(path) != digest:
            changed.append(path)
            digests.add(digest)
            continue
        others.add(digest)
    # Another file may still have the same bytes.
    digests -= others
    done = [receipts[key] for key in plan.keys if key in receipts]
    outdated = {r.key for r in done if digests & plan.common or digests & set(r.inputs.values())}
    size, seconds = sum(receipt.size for receipt in done), sum(receipt.seconds for receipt in done)
    account = JobStatus(
        plan.name, len(plan.keys), len(done), size, seconds, tuple(changed), tuple(gone), len(outdated)
    )
    return account, set(plan.keys) - outdated


def remove_stale(store: Store, status: StoreStatus) -> int:
    """Remove from ``store`` what ``account`` says is stale or left over; gives the bytes that became free."""
    for receipt in status.stale:
        store.remove(receipt.key, receipt.suffix)
    for path in status.leftovers:
        with translate_write_errors(path):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    return status.stale_bytes + status.leftover_bytes


def _size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.lstat().st_size for file in files if file.is_file())
