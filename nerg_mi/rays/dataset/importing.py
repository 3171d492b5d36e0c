"""The import of one source into a dataset: what a process of the pool does. Neither Mitsuba nor Dr.Jit is loaded."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.rays.pseudonyms import pseudonymise
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.readers.protocol import Reader
from nerg_mi.rays.readers.registry import read_rays

from .identity import Marks
from .manifest import Head, Source, read_source, source_path, write_source
from .writing import SourceWriter


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """How sources become rays."""

    reader: Reader[Any]
    settings: Any = None  # of the reader's Options; None: as they are by default
    skip_bad_lines: bool = False
    place: str
    day: str | None = None  # None: by the clock
    key: bytes | None = None  # the salt of pseudonyms; None: names as they are
    kept_salt: bool = True  # whether that is a file's; else it is random and kept by nobody

    @property
    def mark(self) -> str:
        """By which an import that would give other rays is told."""
        settings = self.reader.Options() if self.settings is None else self.settings
        more = {"skip_bad_lines": self.skip_bad_lines, "place": self.place, "day": self.day}
        return Marks(self.key).recipe(self.reader.name, settings, **more)


@dataclass(frozen=True, kw_only=True)
class Task:
    """One source to be imported into the dataset ``folder``."""

    folder: Path
    head: Head
    path: Path
    recipe: Recipe
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


def import_source(task: Task) -> Outcome:
    """Import one source: its parts, then its account. What a user can mend is told in the outcome; nothing else that is
    raised is held back."""
    try:
        return _import_source(task)
    except NergError as error:
        return Outcome(task.path, "", 0, error=str(error))


def _import_source(task: Task) -> Outcome:
    marks, recipe = Marks(task.recipe.key), task.recipe
    # Before it is read: what changes meanwhile is then found by the next import.
    stamp = marks.stamp(task.path)
    before, generation = task.known or ("", -1)
    try:
        writer, rest, names = _write_parts(task, marks)
    except _Unchanged as unchanged:
        found = unchanged.source
        about = replace(found, where=task.where, stamp=stamp, generation=generation + (found.id != before))
        if about != found:
            write_source(task.folder, about)
        return Outcome(task.path, found.id, found.rays, unchanged=True)
    generation += writer.source != before
    metadata, name = rest.metadata, task.path.name
    if recipe.key is not None:
        metadata, name = _without_names(rest, names, recipe, name)
    source = writer.finish(metadata, file=name, where=task.where, stamp=stamp, recipe=task.mark, generation=generation)
    return Outcome(task.path, source.id, source.rays)


class _Unchanged(Exception):
    """Ends the import of content that was imported in the same way before, as ``source``."""

    def __init__(self, source: Source) -> None:
        super().__init__(source.id)
        self.source = source


def _begin(task: Task, marks: Marks) -> SourceWriter:
    """The writer of the source's parts, by its id, for which all of it is read. Raises `_Unchanged`."""
    id = marks.source(task.path, task.mark)
    found = _whole_source(task.folder, id, task.head)
    if found is not None:
        raise _Unchanged(found)
    return SourceWriter(task.folder, id, task.head.buckets)


def _write_parts(task: Task, marks: Marks) -> tuple[SourceWriter, Rays, tuple[str, ...]]:
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


def _without_names(rest: Rays, names: tuple[str, ...], recipe: Recipe, name: str) -> tuple[dict[str, Any], str]:
    """The metadata of a source and its name, without the names of its people."""
    # What is not among the files that were read, as a folder's name, gets an alias with them.
    sources = [*rest.metadata.get("sources", []), {"file": name}]
    nobody = replace(rest.select(rest.t < rest.t), persons=names, metadata={**rest.metadata, "sources": sources})
    hidden = pseudonymise(nobody, recipe.key).metadata
    alias = pseudonymise(
        replace(nobody, metadata={"frame": rest.metadata["frame"], "sources": sources[-1:]}), recipe.key
    )
    files = [entry for entry in hidden["sources"] if "hmac_sha256" in entry]
    kept = "salt of a file" if recipe.kept_salt else "random salt, not kept"
    about = {**hidden, "sources": files, "pseudonyms": f"HMAC-SHA256, {kept}"}
    return about, alias.metadata["sources"][0]["file"]


def _whole_source(folder: Path, id: str, head: Head) -> Source | None:
    """The account of a source that was imported, if all of its parts are there."""
    path = source_path(folder, id)
    if not path.is_file():
        return None
    found = read_source(path, head)
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
