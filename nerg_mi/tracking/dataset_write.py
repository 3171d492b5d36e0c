"""Writing datasets of rays: parallel import of recordings, updates, and recognition of imported sources."""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import (
    check_folder,
    file_sha256,
    lock_file,
    remove_empty_new_parents,
    replace_atomically,
    translate_write_errors,
)
from nerg_mi.files.safe_read import translate_read_errors
from nerg_mi.tasks.engines import process_pool
from nerg_mi.threads import count_cpus

from .dataset import (
    DATASET_MANIFEST,
    GROUP_ROWS,
    PART_ROWS,
    SOURCES_FOLDER,
    UNKNOWN,
    DatasetManifest,
    PartFile,
    SourceManifest,
    check_day,
    check_place,
    compute_bucket,
    read_dataset_manifest,
    read_source_manifest,
    read_source_manifests,
    source_manifest_path,
    write_dataset_manifest,
    write_source_manifest,
)
from .pseudonyms import pseudonymise
from .quality import MAX_GAP
from .rays import VECTORS, Rays, import_pyarrow, parquet_columns
from .readers.base import Reader
from .readers.registry import read_rays

# ---- Identity of sources ----
#
# A source is recognised by digests of its path, its content and the import settings.
#
# With pseudonyms, digests are HMACs keyed with their salt: without it nobody can test whether some file is a source.

_MIN_AGE = 2.0  # seconds; a more recent file may change again without a change of its modification time
_MAX_FILES = 100_000  # in a folder that is one source


@dataclass(frozen=True)
class SourceDigests:
    """Digests of sources: SHA-256, or HMAC-SHA256 with ``key``."""

    key: bytes | None = None

    def compute_digest(self, kind: str, *words: object) -> str:
        """Digest of ``words``: 32 hexadecimal digits."""
        text = json.dumps([f"dataset {kind}", *words]).encode()
        if self.key is not None:
            return hmac.new(self.key, text, hashlib.sha256).hexdigest()[:32]
        return hashlib.sha256(text).hexdigest()[:32]

    def digest_path(self, source: Path) -> str:
        """Digest of a source's path."""
        return self.compute_digest("path", os.path.realpath(source))

    def digest_stamp(self, source: Path) -> str | None:
        """Digest of a source's size and modification time; None if it was modified within `_MIN_AGE`. Raises
        `NergError` for a missing source."""
        entries = [(str(name), stat.st_size, stat.st_mtime_ns) for name, stat in _list_files(source)]
        if any(time.time() - ns / 1e9 < _MIN_AGE for _, _, ns in entries):
            return None
        return self.compute_digest("stamp", entries)

    def digest_source(self, source: Path, recipe: str) -> str:
        """Digest of a source's name, content and import settings, which is its id. Reads the whole source."""
        content = [(str(name), file_sha256(source / name)) for name, _ in _list_files(source)]
        return self.compute_digest("source", source.name, content, recipe)

    def digest_recipe(self, reader: str, options: Any, **extra: Any) -> str:
        """Digest of the import settings: the reader, its options (of files, their content), and further settings."""
        values = {}
        for option in fields(options):
            value = getattr(options, option.name)
            if isinstance(value, Path):
                value = [(str(name), file_sha256(value / name)) for name, _ in _list_files(value)]
            values[option.name] = repr(value)
        return self.compute_digest("recipe", reader, values, extra)


def _list_files(source: Path) -> list[tuple[Path, os.stat_result]]:
    """Files of a source, relative to it (an empty path for a file), with their status."""
    with translate_read_errors(source, "tracking file"):
        if not source.is_dir():
            return [(Path(), os.stat(source))]
        paths = []
        for folder, folders, names in os.walk(source):
            folders.sort()
            paths += [Path(folder, name) for name in sorted(names)]
            if len(paths) > _MAX_FILES:
                raise NergError(
                    f'the folder "{source}" has more files than the maximum of {_MAX_FILES:,}; list files in it instead'
                )
        return [(path.relative_to(source), os.stat(path)) for path in paths if path.is_file()]


# ---- Writing the parts of one source: rays by environment, day and bucket, sorted by participant and time ----

NUM_BUCKETS = 16  # Participants are distributed over this many buckets by a hash of their names
MAX_COORDINATE = 8192.0  # metres; up to here float32 coordinates are accurate to half a millimetre
_EPOCH_RANGE = 946_684_800.0, 4_102_444_800.0  # the years 2000 to 2100
_MAX_RUNS = 1000  # Maximum number of runs of dropped rows that a manifest lists, to keep manifests small
_DICTIONARY_COLUMNS = ["person", "cohort", "confidence"]


class SourceWriter:
    """Writes the rays of a source block by block, and finally its manifest.

    ``folder`` is the dataset, ``source_id`` the id of the source.
    """

    def __init__(self, folder: Path, source_id: str, buckets: int) -> None:
        self._folder, self.source_id, self._buckets = folder, source_id, buckets
        self._parts: list[PartFile] = []
        self._persons: Counter[str] = Counter()
        self._cohorts: Counter[str] = Counter()

    def add(self, rays: Rays, place: str = UNKNOWN, day: str | None = None) -> None:
        """Write rays of the source.

        Without ``day``, the day follows from the times if these are seconds since 1970; otherwise it is unknown. Raises
        `NergError` for origins beyond `MAX_COORDINATE`, and for names that cannot be written.
        """
        if not len(rays):
            return
        max_coordinate = float(np.abs(rays.origin).max())
        if max_coordinate > MAX_COORDINATE:
            raise NergError(
                f"origins are up to {max_coordinate:.3g} m from zero, beyond the maximum of {MAX_COORDINATE:g} m "
                f"of a dataset: check the unit ({parameter('units')}), or move the origin of the frame into the "
                "environment"
            )
        for name in (*rays.persons, *rays.cohorts):
            if not _is_encodable(name):
                raise NergError(f"the name {name!r} of a person or cohort is not valid Unicode; rename it, or its file")
        bucket = np.array([compute_bucket(name, self._buckets) for name in rays.persons])[rays.person]
        # Parts are sorted by name, regardless of the order of codes.
        rank = np.argsort(np.argsort(np.array(rays.persons, dtype=object)))[rays.person]
        days = utc_days(rays.t) if day is None else None
        day_number = np.zeros(len(rays), np.int64) if days is None else days
        order = np.lexsort((rays.t, rank, bucket, day_number))
        starts = np.flatnonzero((np.diff(bucket[order]) != 0) | (np.diff(day_number[order]) != 0)) + 1
        for a, b in zip(np.r_[0, starts], np.r_[starts, len(rays)]):
            day_name = str(np.datetime64(int(day_number[order[a]]), "D")) if days is not None else day or UNKNOWN
            for start in range(a, b, PART_ROWS):
                self._write_part(rays, order[start : min(start + PART_ROWS, b)], place, day_name, int(bucket[order[a]]))

    def _write_part(self, rays: Rays, rows: np.ndarray, place: str, day: str, bucket: int) -> None:
        _, pq = import_pyarrow()
        persons, cohorts = _count_names(rays.person[rows], rays.persons), Counter()
        if rays.cohort is not None:
            cohorts = _count_names(rays.cohort[rows], rays.cohorts)
        names = list(persons)
        t, origin = rays.t[rows], rays.origin[rows].astype(np.float32).astype(np.float64)
        step = np.diff(t)[np.diff(rays.person[rows]) == 0]
        entry: dict[str, Any] = {
            "place": place,
            "day": day,
            "bucket": bucket,
            "number": len(self._parts),
            "rays": len(rows),
            "bytes": 0,
            "first": min(names),
            "last": max(names),
            "start": float(t.min()),
            "end": float(t.max()),
            "low": origin.min(axis=0).tolist(),
            "high": origin.max(axis=0).tolist(),
            "recorded": float(step[(step > 0) & (step <= MAX_GAP)].sum()),
            "duplicates": int(np.count_nonzero(step == 0)),
            "hits": 0 if rays.hit is None else int(np.isfinite(rays.hit[rows]).all(axis=1).sum()),
            "cohorts": rays.cohort is not None,
            "heads": rays.head is not None and bool(np.isfinite(rays.head[rows]).any()),
        }
        path = self._folder / PartFile(**entry).path(self.source_id)
        table = make_part_table(rays, rows)
        floats = {name: "BYTE_STREAM_SPLIT" for name in table.schema.names if name not in _DICTIONARY_COLUMNS}
        with replace_atomically(path) as temporary:
            pq.write_table(
                table,
                temporary,
                row_group_size=GROUP_ROWS,
                compression="zstd",
                use_dictionary=_DICTIONARY_COLUMNS,
                column_encoding=floats,
            )
            entry["bytes"] = temporary.stat().st_size
        self._parts.append(PartFile(**entry))
        self._persons += persons
        self._cohorts += cohorts

    def finish(self, metadata: dict[str, Any], **fields_: Any) -> SourceManifest:
        """Write the manifest of the source, which makes its parts belong to the dataset.

        ``metadata`` are those of its rays; ``fields_`` are ``file``, ``where``, ``stamp``, ``recipe`` and
        ``generation`` of `SourceManifest`.
        """
        metadata = {k: v for k, v in metadata.items() if k not in ("persons", "cohorts")}
        metadata["dropped"] = [_shorten_runs(entry) for entry in metadata.get("dropped", [])]
        source = SourceManifest(
            id=self.source_id,
            persons=dict(sorted(self._persons.items())),
            cohorts=dict(sorted(self._cohorts.items())),
            parts=self._parts,
            metadata=metadata,
            **fields_,
        )
        write_source_manifest(self._folder, source)
        return source


def utc_days(t: np.ndarray) -> np.ndarray | None:
    """Days since 1970 (N,) int64 in UTC of times (N,), if all are seconds since 1970 in the years 2000 to 2099;
    otherwise None."""
    if not len(t) or t.min() < _EPOCH_RANGE[0] or t.max() >= _EPOCH_RANGE[1]:
        return None
    return (t // 86_400).astype(np.int64)


def part_schema() -> Any:
    """Schema of a part."""
    pa, _ = import_pyarrow()
    names = pa.dictionary(pa.int32(), pa.string())
    kinds = dict(t=pa.float64(), person=names, origin=pa.float32(), direction=pa.float32(), confidence=pa.float64())
    kinds |= dict(hit=pa.float32(), cohort=names, head=pa.float32())
    return pa.schema([(part, kind) for name, kind in kinds.items() for part in parquet_columns(name)])


def make_part_table(rays: Rays, rows: np.ndarray) -> Any:
    """Make a table with `part_schema` of the rays ``rows`` (n,), in this order."""
    pa, _ = import_pyarrow()
    columns: dict[str, Any] = {"t": rays.t[rows], "confidence": rays.confidence[rows]}
    for name in VECTORS:
        value = getattr(rays, name)
        value = np.full((len(rows), 3), np.nan) if value is None else value[rows]
        columns |= dict(zip(parquet_columns(name), np.ascontiguousarray(value.T, np.float32)))
    columns["person"] = _make_dictionary(pa, rays.person[rows], rays.persons)
    if rays.cohort is None:
        columns["cohort"] = pa.nulls(len(rows), part_schema().field("cohort").type)
    else:
        columns["cohort"] = _make_dictionary(pa, rays.cohort[rows], rays.cohorts)
    kinds = part_schema()
    return pa.table([columns[name] for name in kinds.names], schema=kinds)


def _make_dictionary(pa: Any, codes: np.ndarray, names: tuple[str, ...]) -> Any:
    """Names as a dictionary array of those that occur."""
    is_used = np.bincount(codes, minlength=len(names)) > 0
    used_names = pa.array([names[k] for k in np.flatnonzero(is_used)], pa.string())
    return pa.DictionaryArray.from_arrays(pa.array((np.cumsum(is_used) - 1)[codes].astype(np.int32)), used_names)


def _is_encodable(name: str) -> bool:
    """Whether Parquet can store a name: file names may contain bytes that are not valid Unicode."""
    try:
        return bool(name.encode())
    except UnicodeEncodeError:
        return False


def _count_names(codes: np.ndarray, names: tuple[str, ...]) -> Counter[str]:
    counts = np.bincount(codes, minlength=len(names))
    return Counter({names[k]: int(counts[k]) for k in np.flatnonzero(counts)})


def _shorten_runs(entry: dict[str, Any]) -> dict[str, Any]:
    """Limit the list of dropped rows to the first `_MAX_RUNS` runs."""
    rows = entry.get("rows", [])
    if len(rows) <= _MAX_RUNS:
        return entry
    num_unlisted = sum(last - first + 1 for first, last in rows[_MAX_RUNS:])
    return {**entry, "rows": rows[:_MAX_RUNS], "rows_not_named": entry.get("rows_not_named", 0) + num_unlisted}


# ---- Import of one source into a dataset, in a worker process ----
#
# Workers load neither Mitsuba nor Dr.Jit.


@dataclass(frozen=True, kw_only=True)
class ImportRecipe:
    """Settings of an import."""

    reader: Reader[Any]
    settings: Any = None  # the reader's Options; None: the defaults
    skip_bad_lines: bool = False
    place: str
    day: str | None = None  # None: from the times
    key: bytes | None = None  # salt of pseudonyms; None: no pseudonyms
    is_salt_stored: bool = True  # whether the salt is from a file; otherwise it is random and discarded

    @property
    def digest(self) -> str:
        """Digest of all settings that change the rays."""
        settings = self.reader.Options() if self.settings is None else self.settings
        extra = {"skip_bad_lines": self.skip_bad_lines, "place": self.place, "day": self.day}
        return SourceDigests(self.key).digest_recipe(self.reader.name, settings, **extra)


@dataclass(frozen=True, kw_only=True)
class ImportTask:
    """Import of one source into the dataset ``folder``."""

    folder: Path
    head: DatasetManifest
    path: Path
    recipe: ImportRecipe
    recipe_digest: str
    path_digest: str
    previous: tuple[str, int] | None = None  # id and generation of the manifest of this path, if there is one


@dataclass(frozen=True)
class ImportOutcome:
    """Outcome of a task."""

    path: Path
    source: str  # id of the source
    rays: int
    # Whether the same content was already imported with the same settings.
    is_unchanged: bool = False
    # The reason, if nothing was imported.
    error: str | None = None


def import_source(task: ImportTask) -> ImportOutcome:
    """Import one source: its parts, then its manifest. Errors that the user can fix are in the outcome; all other
    exceptions propagate."""
    digests, recipe = SourceDigests(task.recipe.key), task.recipe
    previous_id, generation = task.previous or ("", -1)
    stamp: str | None = None
    try:
        # Before reading: the next import then detects changes during this one.
        stamp = digests.digest_stamp(task.path)
        writer, last_rays, names = _write_parts(task, digests)
        generation += writer.source_id != previous_id
        metadata, name = last_rays.metadata, task.path.name
        if recipe.key is not None:
            metadata, name = _pseudonymise_metadata(last_rays, names, recipe, name)
        entry = {"where": task.path_digest, "stamp": stamp, "recipe": task.recipe_digest, "generation": generation}
        source = writer.finish(metadata, file=name, **entry)
    except _Unchanged as unchanged:
        source = unchanged.source
        entry = replace(source, where=task.path_digest, stamp=stamp, generation=generation + (source.id != previous_id))
        if entry != source:
            write_source_manifest(task.folder, entry)
        return ImportOutcome(task.path, source.id, source.rays, is_unchanged=True)
    except NergError as error:
        message = str(error)
        return ImportOutcome(
            task.path, "", 0, error=message if task.path.name in message else f"{task.path}: {message}"
        )
    return ImportOutcome(task.path, source.id, source.rays)


class _Unchanged(Exception):
    """Ends the import of content that was already imported with the same settings, as ``source``."""

    def __init__(self, source: SourceManifest) -> None:
        super().__init__(source.id)
        self.source = source


def _make_writer(task: ImportTask, digests: SourceDigests) -> SourceWriter:
    """Make the writer of the source, whose id requires reading the whole source. Raises `_Unchanged`."""
    id = digests.digest_source(task.path, task.recipe_digest)
    manifest = _find_complete_source(task.folder, id, task.head)
    if manifest is not None:
        raise _Unchanged(manifest)
    return SourceWriter(task.folder, id, task.head.buckets)


def _write_parts(task: ImportTask, digests: SourceDigests) -> tuple[SourceWriter, Rays, tuple[str, ...]]:
    """Write the parts of a source.

    Returns the writer, the last rays, which have the metadata of all, and the names of the participants. Raises
    `_Unchanged`.
    """
    recipe = task.recipe
    # A known path is likely unchanged: hash it first. A new file may not be a recording: read its first rays first.
    writer = None if task.previous is None else _make_writer(task, digests)

    def write_block(rays: Rays) -> None:
        nonlocal writer
        writer = writer or _make_writer(task, digests)
        writer.add(rays if recipe.key is None else pseudonymise(rays, recipe.key), recipe.place, recipe.day)
        names.update(rays.persons)
        # Of a participant in several blocks, the value of the first.
        for name, metres in rays.metadata.get("eye_distance", {}).items():
            eye_distances.setdefault(name, metres)

    names, eye_distances = set[str](), dict[str, float]()
    last_rays = read_rays(
        recipe.reader, task.path, recipe.settings, skip_bad_lines=recipe.skip_bad_lines, on_rays=write_block
    )
    write_block(last_rays)
    last_rays = replace(
        last_rays, metadata={**last_rays.metadata, **({"eye_distance": eye_distances} if eye_distances else {})}
    )
    assert writer is not None
    return writer, last_rays, tuple(sorted(names))


def _pseudonymise_metadata(
    last_rays: Rays, names: tuple[str, ...], recipe: ImportRecipe, name: str
) -> tuple[dict[str, Any], str]:
    """Metadata and name of a source, without names of participants."""
    # A name that is not among the files read, such as that of a folder, gets an alias as well.
    sources = [*last_rays.metadata.get("sources", []), {"file": name}]
    empty = replace(
        last_rays.select(last_rays.t < last_rays.t), persons=names, metadata={**last_rays.metadata, "sources": sources}
    )
    hidden = pseudonymise(empty, recipe.key, is_salt_stored=recipe.is_salt_stored).metadata
    alias = pseudonymise(
        replace(empty, metadata={"frame": last_rays.metadata["frame"], "sources": sources[-1:]}), recipe.key
    )
    files = [entry for entry in hidden["sources"] if "hmac_sha256" in entry]
    metadata = {**hidden, "sources": files}
    return metadata, alias.metadata["sources"][0]["file"]


def _find_complete_source(folder: Path, id: str, head: DatasetManifest) -> SourceManifest | None:
    """The manifest of an imported source, if all of its parts exist."""
    path = source_manifest_path(folder, id)
    if not path.is_file():
        return None
    manifest = read_source_manifest(path, head)
    return manifest if has_all_parts(folder, manifest) else None


def has_all_parts(folder: Path, source: SourceManifest) -> bool:
    """Whether the files of all parts of a source exist and have the expected size."""
    for part in source.parts:
        try:
            if os.stat(folder / part.path(source.id)).st_size != part.bytes:
                return False
        except FileNotFoundError:
            return False
    return True


# ---- Parallel import in worker processes, which end with the parent process ----


def run_tasks(tasks: Sequence[ImportTask], workers: int) -> Iterator[ImportOutcome]:
    """Run tasks and iterate over their outcomes as they finish, in ``workers`` processes, or in this one for 1.

    Raises `NergError` if a worker process was killed.
    """
    workers = min(workers, len(tasks))
    if workers <= 1:
        yield from map(import_source, tasks)
        return
    with process_pool(workers, _set_threads, max(1, count_cpus() // workers)) as pool:
        try:
            for done in as_completed([pool.submit(import_source, task) for task in tasks]):
                yield done.result()
        except BrokenProcessPool as error:
            raise NergError(
                f"a worker process was killed or could not start: use fewer {parameter('workers')} if memory was "
                'short; in a script, import below if __name__ == "__main__"; finished sources are kept'
            ) from error


def _set_threads(count: int) -> None:
    try:
        import pyarrow
    except ImportError:
        return  # reported where pyarrow is used
    pyarrow.set_cpu_count(count)


# ---- Updating ----
#
# Unchanged sources are skipped, changed sources are replaced, new sources are added.
#
# Each source is imported on its own, so that an interrupted import can be continued: the next one imports the sources
# without a manifest. Sources that are not listed remain.

_RANDOM_SALT = ""  # Digest of a discarded salt


@dataclass
class DatasetUpdate:
    """Result of an update, for the listed sources."""

    num_imported: int = 0  # number of sources, with `num_rays` in total
    num_rays: int = 0
    num_replaced: int = 0  # of those imported: changed sources, or sources imported with other settings
    num_unchanged: int = 0
    num_duplicates: int = 0  # with the name and content of another source: stored once
    errors: list[str] = field(default_factory=list)  # messages of sources that could not be imported
    empty: list[Path] = field(default_factory=list)  # imported sources of which all rows were dropped


def update_dataset(
    folder: Path,
    files: Sequence[Path],
    recipe: ImportRecipe,
    workers: int = 1,
    on_done: Callable[[str], None] | None = None,
) -> DatasetUpdate:
    """Import ``files``, each a source, into the dataset ``folder``, which is created if necessary.

    Parameters
    ----------
    workers
        Number of processes.
    on_done
        Called with the name of each source when it is done.

    Raises
    ------
    NergError
        For errors that concern all sources. Errors of single sources are in the result, and the others are imported.
    """
    check_output_folder(folder)
    check_place(recipe.place)
    if recipe.day is not None:
        check_day(recipe.day)
    import_pyarrow()
    if not files:
        raise NergError("there are no tracking files to import; list one or more")
    _check_compatible(folder, recipe)
    # Before the folder is created: detects missing files and invalid options.
    recipe_digest, digests = recipe.digest, SourceDigests(recipe.key)
    paths = {digests.digest_path(path): path for path in files}
    stamps = {path_digest: digests.digest_stamp(path) for path_digest, path in paths.items()}
    update, is_new = DatasetUpdate(), not (folder / DATASET_MANIFEST).is_file()
    with ExitStack() as ends:
        ends.enter_context(remove_empty_new_parents(folder / DATASET_MANIFEST))
        if is_new:
            write_dataset_manifest(folder, DatasetManifest(NUM_BUCKETS, _digest_salt(recipe)))
        head = read_dataset_manifest(folder)
        ends.enter_context(
            lock_file(folder / DATASET_MANIFEST, f'another import into "{folder}" is running; wait for its end')
        )
        if is_new:
            ends.callback(_remove_if_empty, folder, head)
        manifests = {source.where: source for source in read_source_manifests(folder, head)}
        _remove_leftovers(folder, list(manifests.values()))
        tasks = []
        for path_digest, path in paths.items():
            manifest = manifests.get(path_digest)
            stamp = stamps[path_digest]
            is_same = (
                manifest is not None
                and manifest.recipe == recipe_digest
                and stamp is not None
                and manifest.stamp == stamp
            )
            if manifest is not None and is_same and has_all_parts(folder, manifest):
                update.num_unchanged += 1
                continue
            previous = None if manifest is None else (manifest.id, manifest.generation)
            tasks.append(
                ImportTask(
                    folder=folder,
                    head=head,
                    path=path,
                    recipe=recipe,
                    recipe_digest=recipe_digest,
                    path_digest=path_digest,
                    previous=previous,
                )
            )
        imported_ids: set[str] = set()
        for outcome in run_tasks(tasks, workers):
            _count_outcome(update, outcome, imported_ids)
            if on_done is not None:
                on_done(outcome.path.name)
        update.num_replaced = _remove_leftovers(folder, read_source_manifests(folder, head))
    return update


def _count_outcome(update: DatasetUpdate, outcome: ImportOutcome, imported_ids: set[str]) -> None:
    if outcome.error is not None:
        update.errors.append(outcome.error)
    elif outcome.source in imported_ids:
        update.num_duplicates += 1
    elif outcome.is_unchanged:
        update.num_unchanged += 1
    else:
        update.num_imported += 1
        update.num_rays += outcome.rays
        update.empty += [] if outcome.rays else [outcome.path]
    imported_ids.add(outcome.source)


def check_output_folder(folder: Path) -> None:
    """Raise `NergError` if no dataset can be created in or added to the folder."""
    check_folder(folder)
    with translate_write_errors(folder):
        if folder.is_dir() and not (folder / DATASET_MANIFEST).is_file() and any(os.scandir(folder)):
            raise NergError(f'the folder "{folder}" exists but is not a dataset: use another name, or remove it')


def _check_compatible(folder: Path, recipe: ImportRecipe) -> None:
    """Raise `NergError` if nothing can be added to the dataset, or if names would not match those in it."""
    if not (folder / DATASET_MANIFEST).is_file():
        return
    head, salt_digest = read_dataset_manifest(folder), _digest_salt(recipe)
    if head.closed:
        raise NergError(f'"{folder}" was filtered from another dataset: import into that one, and filter it again')
    if head.salt == _RANDOM_SALT:
        raise NergError(
            f'the pseudonyms in "{folder}" have a random salt that was discarded, so that nothing can be added: '
            f"import all files into a new dataset, with {parameter('salt', 'FILE')} to add more later"
        )
    if head.salt != salt_digest:
        remedy = (
            f"leave out {parameter('pseudonyms', True)}"
            if head.salt is None
            else f"use {parameter('pseudonyms', True)} and the same {parameter('salt', 'FILE')}"
        )
        raise NergError(f'participants would get other names than those in "{folder}": {remedy}')


def _digest_salt(recipe: ImportRecipe) -> str | None:
    if recipe.key is None:
        return None
    return SourceDigests(recipe.key).compute_digest("salt") if recipe.is_salt_stored else _RANDOM_SALT


def _remove_if_empty(folder: Path, head: DatasetManifest) -> None:
    """Remove the manifest of a new dataset without imported sources, and leftovers of imports."""
    if read_source_manifests(folder, head):
        return
    _remove_leftovers(folder, [])
    with translate_write_errors(folder):
        (folder / DATASET_MANIFEST).unlink()
    for path in sorted(folder.rglob("*"), reverse=True):
        # Other files remain.
        with suppress(OSError):
            path.rmdir()


def _remove_leftovers(folder: Path, sources: Sequence[SourceManifest]) -> int:
    """Remove files of imports that do not belong to ``sources``: replaced manifests, parts of those or without a
    manifest, and unfinished files. Returns the number of replaced manifests."""
    manifest_names = {source_manifest_path(folder, source.id).name for source in sources}
    parts = {folder / part.path(source.id) for source in sources for part in source.parts}
    replaced = [path for path in (folder / SOURCES_FOLDER).glob("*.json") if path.name not in manifest_names]
    finished = [path for path in replaced if not path.name.startswith(".")]
    stray = [path for path in folder.glob("place=*/day=*/bucket=*/part-*.parquet") if path not in parts]
    unfinished = [*folder.glob(".*.part.json"), *folder.glob("place=*/day=*/bucket=*/.*.part.parquet")]
    with translate_write_errors(folder):
        for path in {*replaced, *stray, *unfinished}:
            path.unlink(missing_ok=True)
    return len(finished)
