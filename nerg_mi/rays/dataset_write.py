"""Writing datasets of rays: importing recordings in parallel, updating, and recognising recordings that are there."""

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

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import check_folder, file_sha256, lock_file, remove_empty_new_parents, replace_atomically, translate_write_errors
from nerg_mi.files.safe_read import translate_read_errors
from nerg_mi.tasks.engines import process_pool

from .dataset import (
    GROUP_ROWS,
    DATASET_MANIFEST,
    PART_ROWS,
    SOURCES,
    UNKNOWN,
    DatasetManifest,
    PartFile,
    Source,
    bucket_of,
    check_day,
    check_place,
    read_dataset_manifest,
    read_source_manifest,
    read_sources,
    source_manifest_path,
    write_dataset_manifest,
    write_source,
)
from .pseudonyms import pseudonymise
from .quality import GAP
from .rays import VECTORS, Rays, column_parts, import_pyarrow
from .readers.base import Reader
from .readers.registry import read_rays

# ---- Identity ----
#
# By what a source is known again: its path, its content, and how it was read, each as a mark that tells nothing else.
#
# Where people have pseudonyms, marks are HMACs under their salt: without it nobody can find out by a mark whether some
# file was among the sources.

_FRESH = 2.0  # seconds: a file that was written just now may change without showing it in its time
_MOST_FILES = 100_000  # of a folder that is a source


@dataclass(frozen=True)
class Marks:
    """Marks of texts: SHA-256, or HMAC-SHA256 under ``key``."""

    key: bytes | None = None

    def of(self, kind: str, *words: object) -> str:
        """The mark of ``words``: 32 hexadecimal digits."""
        text = json.dumps([f"dataset {kind}", *words]).encode()
        if self.key is not None:
            return hmac.new(self.key, text, hashlib.sha256).hexdigest()[:32]
        return hashlib.sha256(text).hexdigest()[:32]

    def where(self, source: Path) -> str:
        """That of a source's path."""
        return self.of("path", os.path.realpath(source))

    def stamp(self, source: Path) -> str | None:
        """That of a source's size and time of change; None where it was changed just now. Raises `NergError` for a
        source that is not there."""
        found = [(str(name), stat.st_size, stat.st_mtime_ns) for name, stat in _files(source)]
        if any(time.time() - ns / 1e9 < _FRESH for _, _, ns in found):
            return None
        return self.of("stamp", found)

    def source(self, source: Path, recipe: str) -> str:
        """That of a source's name and content and of how it is read: its id. All of it is read."""
        content = [(str(name), file_sha256(source / name)) for name, _ in _files(source)]
        return self.of("source", source.name, content, recipe)

    def recipe(self, reader: str, options: Any, **more: Any) -> str:
        """That of how sources are read: the reader, its options (files among them by their content), and what else
        changes the rays."""
        given = {}
        for option in fields(options):
            value = getattr(options, option.name)
            if isinstance(value, Path):
                value = [(str(name), file_sha256(value / name)) for name, _ in _files(value)]
            given[option.name] = repr(value)
        return self.of("recipe", reader, given, more)


def _files(source: Path) -> list[tuple[Path, os.stat_result]]:
    """The files that a source consists of, by their names within it (nothing for a file), and what is known of them."""
    with translate_read_errors(source, "tracking file"):
        if not source.is_dir():
            return [(Path(), os.stat(source))]
        found = []
        for folder, folders, names in os.walk(source):
            folders.sort()
            found += [Path(folder, name) for name in sorted(names)]
            if len(found) > _MOST_FILES:
                raise NergError(
                    f'the folder "{source}" holds more than the {_MOST_FILES:,} files that are read; name those in it'
                )
        return [(path.relative_to(source), os.stat(path)) for path in found if path.is_file()]


# ---- Writing the parts of one source: rays by place, day and bucket, in the order of persons and times ----

BUCKETS = 16  # People of a day are in so many buckets, by a hash of their names
REACH = 8192.0  # Origins lie within so many metres of zero: float32 places them there to half a millimetre
_EPOCH = 946_684_800.0, 4_102_444_800.0  # the years 2000 to 2100
_RUNS = 1000  # So many runs of dropped rows are named of a source: accounts of thousands of sources are read at once
_WORDS = ["person", "cohort", "confidence"]


class SourceWriter:
    """Takes the rays of a source, block by block, and writes them; then its account.

    ``folder``: the dataset; ``source``: the source's id.
    """

    def __init__(self, folder: Path, source: str, buckets: int) -> None:
        self._folder, self.source, self._buckets = folder, source, buckets
        self._parts: list[PartFile] = []
        self._persons: Counter[str] = Counter()
        self._cohorts: Counter[str] = Counter()

    def add(self, rays: Rays, place: str = UNKNOWN, day: str | None = None) -> None:
        """Write more rays of the source. ``day``: None: by their times, if these are seconds since 1970, else unknown.

        Raises `NergError` for origins beyond `REACH`, and what cannot be written.
        """
        if not len(rays):
            return
        far = float(np.abs(rays.origin).max())
        if far > REACH:
            raise NergError(
                f"origins lie up to {far:.3g} m from zero, and a dataset places them to {REACH:g} m: check the unit "
                "(--units), or move zero into the place"
            )
        for name in (*rays.persons, *rays.cohorts):
            if not _is_text(name):
                raise NergError(
                    f"the name {name!r} of a person or cohort is no text; rename it, or the file that it is of"
                )
        bucket = np.array([bucket_of(name, self._buckets) for name in rays.persons])[rays.person]
        # Parts are in the order of names, whatever that of their numbers.
        rank = np.argsort(np.argsort(np.array(rays.persons, dtype=object)))[rays.person]
        found = days_of(rays.t) if day is None else None
        number = np.zeros(len(rays), np.int64) if found is None else found
        order = np.lexsort((rays.t, rank, bucket, number))
        new = np.flatnonzero((np.diff(bucket[order]) != 0) | (np.diff(number[order]) != 0)) + 1
        for a, b in zip(np.r_[0, new], np.r_[new, len(rays)]):
            name = str(np.datetime64(int(number[order[a]]), "D")) if found is not None else day or UNKNOWN
            for start in range(a, b, PART_ROWS):
                self._write(rays, order[start : min(start + PART_ROWS, b)], place, name, int(bucket[order[a]]))

    def _write(self, rays: Rays, rows: np.ndarray, place: str, day: str, bucket: int) -> None:
        _, pq = import_pyarrow()
        persons, cohorts = _counts(rays.person[rows], rays.persons), Counter()
        if rays.cohort is not None:
            cohorts = _counts(rays.cohort[rows], rays.cohorts)
        names = list(persons)
        t, origin = rays.t[rows], rays.origin[rows].astype(np.float32).astype(np.float64)
        step = np.diff(t)[np.diff(rays.person[rows]) == 0]
        about: dict[str, Any] = {
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
            "recorded": float(step[(step > 0) & (step <= GAP)].sum()),
            "duplicates": int(np.count_nonzero(step == 0)),
            "hits": 0 if rays.hit is None else int(np.isfinite(rays.hit[rows]).all(axis=1).sum()),
            "cohorts": rays.cohort is not None,
            "heads": rays.head is not None and bool(np.isfinite(rays.head[rows]).any()),
        }
        path = self._folder / PartFile(**about).path(self.source)
        table = table_of(rays, rows)
        floats = {name: "BYTE_STREAM_SPLIT" for name in table.schema.names if name not in _WORDS}
        with replace_atomically(path) as temporary:
            pq.write_table(
                table,
                temporary,
                row_group_size=GROUP_ROWS,
                compression="zstd",
                use_dictionary=_WORDS,
                column_encoding=floats,
            )
            about["bytes"] = temporary.stat().st_size
        self._parts.append(PartFile(**about))
        self._persons += persons
        self._cohorts += cohorts

    def finish(self, metadata: dict[str, Any], **about: Any) -> Source:
        """Write the account of the source, by which its parts belong to the dataset.

        ``metadata``: those of its rays. ``about``: ``file``, ``where``, ``stamp``, ``recipe`` and ``generation`` of
        `Source`.
        """
        metadata = {k: v for k, v in metadata.items() if k not in ("persons", "cohorts")}
        metadata["dropped"] = [_shortened(entry) for entry in metadata.get("dropped", [])]
        source = Source(
            id=self.source,
            persons=dict(sorted(self._persons.items())),
            cohorts=dict(sorted(self._cohorts.items())),
            parts=self._parts,
            metadata=metadata,
            **about,
        )
        write_source(self._folder, source)
        return source


def days_of(t: np.ndarray) -> np.ndarray | None:
    """Days since 1970 (N,) int64 of times (N,), where all of them are seconds since then in the years 2000 to 2099;
    None for another clock. Days are those of UTC."""
    if not len(t) or t.min() < _EPOCH[0] or t.max() >= _EPOCH[1]:
        return None
    return (t // 86_400).astype(np.int64)


def schema() -> Any:
    """The columns of a part, as pyarrow has them."""
    pa, _ = import_pyarrow()
    names = pa.dictionary(pa.int32(), pa.string())
    kinds = dict(t=pa.float64(), person=names, origin=pa.float32(), direction=pa.float32(), confidence=pa.float64())
    kinds |= dict(hit=pa.float32(), cohort=names, head=pa.float32())
    return pa.schema([(part, kind) for name, kind in kinds.items() for part in column_parts(name)])


def table_of(rays: Rays, rows: np.ndarray) -> Any:
    """The rays ``rows`` (n,), in this order, as a table of `schema`."""
    pa, _ = import_pyarrow()
    columns: dict[str, Any] = {"t": rays.t[rows], "confidence": rays.confidence[rows]}
    for name in VECTORS:
        value = getattr(rays, name)
        value = np.full((len(rows), 3), np.nan) if value is None else value[rows]
        columns |= dict(zip(column_parts(name), np.ascontiguousarray(value.T, np.float32)))
    columns["person"] = _names(pa, rays.person[rows], rays.persons)
    if rays.cohort is None:
        columns["cohort"] = pa.nulls(len(rows), schema().field("cohort").type)
    else:
        columns["cohort"] = _names(pa, rays.cohort[rows], rays.cohorts)
    kinds = schema()
    return pa.table([columns[name] for name in kinds.names], schema=kinds)


def _names(pa: Any, codes: np.ndarray, names: tuple[str, ...]) -> Any:
    """Names as a dictionary of those that occur."""
    there = np.bincount(codes, minlength=len(names)) > 0
    known = pa.array([names[k] for k in np.flatnonzero(there)], pa.string())
    return pa.DictionaryArray.from_arrays(pa.array((np.cumsum(there) - 1)[codes].astype(np.int32)), known)


def _is_text(name: str) -> bool:
    """Whether Parquet can hold a name: file names may hold bytes that are no characters."""
    try:
        return bool(name.encode())
    except UnicodeEncodeError:
        return False


def _counts(codes: np.ndarray, names: tuple[str, ...]) -> Counter[str]:
    counts = np.bincount(codes, minlength=len(names))
    return Counter({names[k]: int(counts[k]) for k in np.flatnonzero(counts)})


def _shortened(entry: dict[str, Any]) -> dict[str, Any]:
    """The account of dropped rows of which the first runs alone are named."""
    rows = entry.get("rows", [])
    if len(rows) <= _RUNS:
        return entry
    more = sum(last - first + 1 for first, last in rows[_RUNS:])
    return {**entry, "rows": rows[:_RUNS], "rows_not_named": entry.get("rows_not_named", 0) + more}


# ---- The import of one source into a dataset: what a process of the pool does ----
#
# Neither Mitsuba nor Dr.Jit is loaded.


@dataclass(frozen=True, kw_only=True)
class ImportRecipe:
    """How sources become rays."""

    reader: Reader[Any]
    settings: Any = None  # of the reader's Options; None: as they are by default
    skip_bad_lines: bool = False
    place: str
    day: str | None = None  # None: by the clock
    key: bytes | None = None  # the salt of pseudonyms; None: names as they are
    is_salt_stored: bool = True  # whether that is a file's; else it is random and kept by nobody

    @property
    def mark(self) -> str:
        """By which an import that would give other rays is told."""
        settings = self.reader.Options() if self.settings is None else self.settings
        more = {"skip_bad_lines": self.skip_bad_lines, "place": self.place, "day": self.day}
        return Marks(self.key).recipe(self.reader.name, settings, **more)


@dataclass(frozen=True, kw_only=True)
class ImportTask:
    """One source to be imported into the dataset ``folder``."""

    folder: Path
    head: DatasetManifest
    path: Path
    recipe: ImportRecipe
    mark: str  # of the recipe
    where: str  # mark of the path
    known: tuple[str, int] | None = None  # id and generation of the account of this path, if there is one


@dataclass(frozen=True)
class Outcome:
    """What a task came to."""

    path: Path
    source: str  # the account's id
    rays: int
    # Whether the same content was imported in the same way before.
    unchanged: bool = False
    # In a sentence why nothing was imported.
    error: str | None = None


def import_source(task: ImportTask) -> Outcome:
    """Import one source: its parts, then its account. What a user can mend is told in the outcome; nothing else that is
    raised is held back."""
    marks, recipe = Marks(task.recipe.key), task.recipe
    before, generation = task.known or ("", -1)
    stamp: str | None = None
    try:
        # Before it is read: what changes meanwhile is then found by the next import.
        stamp = marks.stamp(task.path)
        writer, rest, names = _write_parts(task, marks)
        generation += writer.source != before
        metadata, name = rest.metadata, task.path.name
        if recipe.key is not None:
            metadata, name = _without_names(rest, names, recipe, name)
        about = {"where": task.where, "stamp": stamp, "recipe": task.mark, "generation": generation}
        source = writer.finish(metadata, file=name, **about)
    except _Unchanged as unchanged:
        source = unchanged.source
        about = replace(source, where=task.where, stamp=stamp, generation=generation + (source.id != before))
        if about != source:
            write_source(task.folder, about)
        return Outcome(task.path, source.id, source.rays, unchanged=True)
    except NergError as error:
        return Outcome(task.path, "", 0, error=str(error))
    return Outcome(task.path, source.id, source.rays)


class _Unchanged(Exception):
    """Ends the import of content that was imported in the same way before, as ``source``."""

    def __init__(self, source: Source) -> None:
        super().__init__(source.id)
        self.source = source


def _begin(task: ImportTask, marks: Marks) -> SourceWriter:
    """The writer of the source's parts, by its id, for which all of it is read. Raises `_Unchanged`."""
    id = marks.source(task.path, task.mark)
    found = _whole_source(task.folder, id, task.head)
    if found is not None:
        raise _Unchanged(found)
    return SourceWriter(task.folder, id, task.head.buckets)


def _write_parts(task: ImportTask, marks: Marks) -> tuple[SourceWriter, Rays, tuple[str, ...]]:
    """Write the rays of a source, but for the account.

    Returns the writer, the last rays, with the metadata of all, and the names of the people. Raises `_Unchanged`.
    """
    recipe = task.recipe
    # What was imported before is likely unchanged. Something new may be no recording: first rays are read from it.
    writer = None if task.known is None else _begin(task, marks)

    def take(rays: Rays) -> None:
        nonlocal writer
        writer = writer or _begin(task, marks)
        writer.add(rays if recipe.key is None else pseudonymise(rays, recipe.key), recipe.place, recipe.day)
        names.update(rays.persons)
        # Of somebody who is in several blocks, that of the first.
        for name, metres in rays.metadata.get("eye_distance", {}).items():
            eyes.setdefault(name, metres)

    names, eyes = set[str](), dict[str, float]()
    rest = read_rays(recipe.reader, task.path, recipe.settings, skip_bad_lines=recipe.skip_bad_lines, on_rays=take)
    take(rest)
    rest = replace(rest, metadata={**rest.metadata, **({"eye_distance": eyes} if eyes else {})})
    assert writer is not None
    return writer, rest, tuple(sorted(names))


def _without_names(rest: Rays, names: tuple[str, ...], recipe: ImportRecipe, name: str) -> tuple[dict[str, Any], str]:
    """The metadata of a source and its name, without the names of its people."""
    # What is not among the files that were read, as a folder's name, gets an alias with them.
    sources = [*rest.metadata.get("sources", []), {"file": name}]
    nobody = replace(rest.select(rest.t < rest.t), persons=names, metadata={**rest.metadata, "sources": sources})
    hidden = pseudonymise(nobody, recipe.key).metadata
    alias = pseudonymise(
        replace(nobody, metadata={"frame": rest.metadata["frame"], "sources": sources[-1:]}), recipe.key
    )
    files = [entry for entry in hidden["sources"] if "hmac_sha256" in entry]
    kept = "salt of a file" if recipe.is_salt_stored else "random salt, not kept"
    about = {**hidden, "sources": files, "pseudonyms": f"HMAC-SHA256, {kept}"}
    return about, alias.metadata["sources"][0]["file"]


def _whole_source(folder: Path, id: str, head: DatasetManifest) -> Source | None:
    """The account of a source that was imported, if all of its parts are there."""
    path = source_manifest_path(folder, id)
    if not path.is_file():
        return None
    found = read_source_manifest(path, head)
    return found if has_parts(folder, found) else None


def has_parts(folder: Path, source: Source) -> bool:
    """Whether the files of all parts of a source are there, as large as they were."""
    for part in source.parts:
        try:
            if os.stat(folder / part.path(source.id)).st_size != part.bytes:
                return False
        except FileNotFoundError:
            return False
    return True


# ---- Processes that import sources beside each other, and end with the one that has started them ----


def run_tasks(tasks: Sequence[ImportTask], workers: int) -> Iterator[Outcome]:
    """The outcomes of tasks as they come, from ``workers`` processes, or from this one where that is one.

    Raises `NergError` where a process was ended from outside.
    """
    workers = min(workers, len(tasks))
    if workers <= 1:
        yield from map(import_source, tasks)
        return
    with process_pool(workers, _set_threads, max(1, (os.cpu_count() or 1) // workers)) as pool:
        try:
            for done in as_completed([pool.submit(import_source, task) for task in tasks]):
                yield done.result()
        except BrokenProcessPool as error:
            raise NergError(
                "a process that imported was ended, or could not start: give fewer --workers if memory was short; in a "
                'script, call it below if __name__ == "__main__"; what is finished is kept'
            ) from error


def _set_threads(count: int) -> None:
    try:
        import pyarrow
    except ImportError:
        return  # said where it is used
    pyarrow.set_cpu_count(count)


# ---- Updating ----
#
# Tracking files into a dataset: what is there already is left, what has changed is replaced, and what is new is added.
#
# Each source is imported on its own, so that an import may end at any time: the next one goes on with the sources that
# have no account yet. Sources that are not named stay as they are.

_RANDOM = ""  # The mark of a salt that nobody has kept


@dataclass
class DatasetUpdate:
    """What became of the sources that were named."""

    num_imported: int = 0  # with the rays of `rays`
    num_rays: int = 0
    num_replaced: int = 0  # of those imported: sources that have changed, or are read in another way
    num_unchanged: int = 0
    num_duplicates: int = 0  # of the same name and content as others: kept once
    errors: list[str] = field(default_factory=list)  # of those that could not be imported, a sentence each


def update_dataset(
    folder: Path,
    files: Sequence[Path],
    recipe: ImportRecipe,
    workers: int = 1,
    on_done: Callable[[str], None] | None = None,
) -> DatasetUpdate:
    """Import ``files``, each a source, into the dataset ``folder``, which is made if it is not there.

    ``workers``: processes that do it beside each other. ``on_done``: called with the name of each source as it is done.
    Raises `NergError` for what stands in the way of all; what is amiss with a source is told by the update, and the
    others are imported.
    """
    check_target(folder)
    check_place(recipe.place)
    if recipe.day is not None:
        check_day(recipe.day)
    import_pyarrow()
    if not files:
        raise NergError("there are no tracking files to import; name one or more")
    _check_head(folder, recipe)
    # Before a folder is made: files that are not there, and options that name none.
    mark, marks = recipe.mark, Marks(recipe.key)
    named = {marks.where(path): path for path in files}
    stamps = {where: marks.stamp(path) for where, path in named.items()}
    done, is_new = DatasetUpdate(), not (folder / DATASET_MANIFEST).is_file()
    with ExitStack() as ends:
        ends.enter_context(remove_empty_new_parents(folder / DATASET_MANIFEST))
        if is_new:
            write_dataset_manifest(folder, DatasetManifest(BUCKETS, _salt(recipe)))
        head = read_dataset_manifest(folder)
        ends.enter_context(lock_file(folder / DATASET_MANIFEST, f'another import into "{folder}" is at work; wait for its end'))
        if is_new:
            ends.callback(_remove_if_empty, folder, head)
        known = {source.where: source for source in read_sources(folder, head)}
        _clean(folder, list(known.values()))
        tasks = []
        for where, path in named.items():
            found = known.get(where)
            stamp = stamps[where]
            same = found is not None and found.recipe == mark and stamp is not None and found.stamp == stamp
            if found is not None and same and has_parts(folder, found):
                done.num_unchanged += 1
                continue
            before = None if found is None else (found.id, found.generation)
            tasks.append(
                ImportTask(folder=folder, head=head, path=path, recipe=recipe, mark=mark, where=where, known=before)
            )
        seen: set[str] = set()
        for outcome in run_tasks(tasks, workers):
            _count(done, outcome, seen)
            if on_done is not None:
                on_done(outcome.path.name)
        done.num_replaced = _clean(folder, read_sources(folder, head))
    return done


def _count(done: DatasetUpdate, outcome: Outcome, seen: set[str]) -> None:
    if outcome.error is not None:
        done.errors.append(outcome.error)
    elif outcome.source in seen:
        done.num_duplicates += 1
    elif outcome.unchanged:
        done.num_unchanged += 1
    else:
        done.num_imported += 1
        done.num_rays += outcome.rays
    seen.add(outcome.source)


def check_target(folder: Path) -> None:
    """Raise `NergError` where no dataset can be made or added to."""
    check_folder(folder)
    with translate_write_errors(folder):
        if folder.is_dir() and not (folder / DATASET_MANIFEST).is_file() and any(os.scandir(folder)):
            raise NergError(f'the folder "{folder}" is there and no dataset of rays: choose another name, or remove it')


def _check_head(folder: Path, recipe: ImportRecipe) -> None:
    """Raise `NergError` where nothing can be added to the dataset, or people would have other names than there."""
    if not (folder / DATASET_MANIFEST).is_file():
        return
    head, wanted = read_dataset_manifest(folder), _salt(recipe)
    if head.closed:
        raise NergError(f'"{folder}" was filtered from another dataset: import into that one, and filter it again')
    if head.salt == _RANDOM:
        raise NergError(
            f'the people of "{folder}" have pseudonyms under a random salt that nobody has kept, and nothing can be '
            "added: import all files into a new dataset, with --salt FILE if more will come"
        )
    if head.salt != wanted:
        remedy = "leave out --pseudonyms" if head.salt is None else "give the same --pseudonyms --salt FILE"
        raise NergError(f'the people of "{folder}" would be called otherwise than those there: {remedy}')


def _salt(recipe: ImportRecipe) -> str | None:
    if recipe.key is None:
        return None
    return Marks(recipe.key).of("salt") if recipe.is_salt_stored else _RANDOM


def _remove_if_empty(folder: Path, head: DatasetManifest) -> None:
    """Remove the account of a new dataset into which nothing was imported, with what imports have left."""
    if read_sources(folder, head):
        return
    _clean(folder, [])
    with translate_write_errors(folder):
        (folder / DATASET_MANIFEST).unlink()
    for path in sorted(folder.rglob("*"), reverse=True):
        # What is not of an import stays.
        with suppress(OSError):
            path.rmdir()


def _clean(folder: Path, sources: Sequence[Source]) -> int:
    """Remove what imports have left that does not belong to ``sources``: accounts of replaced ones, whose number is
    given, parts of them or of sources without an account, and files that were being written."""
    accounts = {source_manifest_path(folder, source.id).name for source in sources}
    parts = {folder / part.path(source.id) for source in sources for part in source.parts}
    old = [path for path in (folder / SOURCES).glob("*.json") if path.name not in accounts]
    written = [path for path in old if not path.name.startswith(".")]
    stray = [path for path in folder.glob("place=*/day=*/bucket=*/part-*.parquet") if path not in parts]
    unfinished = [*folder.glob(".*.part.json"), *folder.glob("place=*/day=*/bucket=*/.*.part.parquet")]
    with translate_write_errors(folder):
        for path in {*old, *stray, *unfinished}:
            path.unlink(missing_ok=True)
    return len(written)
