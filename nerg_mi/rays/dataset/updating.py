"""Tracking files into a dataset: what is there already is left, what has changed is replaced, and what is new is added.

Each source is imported on its own, so that an import may end at any time: the next one goes on with the sources that
have no account yet. Sources that are not named stay as they are.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import check_folder, locked, removing_empty_parents, writing
from nerg_mi.rays.io import pyarrow_modules

from .identity import Marks
from .importing import Outcome, Recipe, Task, has_parts
from .layout import BUCKETS, HEAD, SOURCES, check_day, check_place
from .manifest import Head, Source, read_head, read_sources, source_path, write_head
from .pool import run_tasks

_RANDOM = ""
"""The mark of a salt that nobody has kept."""


@dataclass
class Update:
    """What became of the sources that were named."""

    imported: int = 0  # with the rays of `rays`
    rays: int = 0
    replaced: int = 0  # of those imported: sources that have changed, or are read in another way
    unchanged: int = 0
    alike: int = 0  # of the same name and content as others: kept once
    errors: list[str] = field(default_factory=list)  # of those that could not be imported, a sentence each


def update_dataset(
    folder: Path, files: Sequence[Path], recipe: Recipe, workers: int = 1, on_done: Callable[[str], None] | None = None
) -> Update:
    """Import ``files``, each a source, into the dataset ``folder``, which is made if it is not there.

    ``workers``: processes that do it beside each other. ``on_done``: called with the name of each source as it is done.
    Raises `NergError` for what stands in the way of all; what is amiss with a source is told by the update, and the
    others are imported.
    """
    check_target(folder)
    check_place(recipe.place)
    if recipe.day is not None:
        check_day(recipe.day)
    pyarrow_modules()
    if not files:
        raise NergError("there are no tracking files to import; name one or more")
    _check_head(folder, recipe)
    # Before a folder is made: files that are not there, and options that name none.
    mark, marks = recipe.mark, Marks(recipe.key)
    named = {marks.where(path): path for path in files}
    stamps = {where: marks.stamp(path) for where, path in named.items()}
    done, is_new = Update(), not (folder / HEAD).is_file()
    with ExitStack() as ends:
        ends.enter_context(removing_empty_parents(folder / HEAD))
        head = _opened(folder, recipe)
        ends.enter_context(locked(folder / HEAD, f'another import into "{folder}" is at work; wait for its end'))
        if is_new:
            ends.callback(_remove_if_empty, folder, head)
        known = {source.where: source for source in read_sources(folder, head)}
        _clean(folder, list(known.values()))
        tasks = []
        for where, path in named.items():
            found = known.get(where)
            if found is not None and _is_same(found, mark, stamps[where]) and has_parts(folder, found):
                done.unchanged += 1
                continue
            before = None if found is None else (found.id, found.generation)
            tasks.append(Task(folder=folder, head=head, path=path, recipe=recipe, mark=mark, where=where, known=before))
        seen: set[str] = set()
        for outcome in run_tasks(tasks, workers):
            _count(done, outcome, seen)
            if on_done is not None:
                on_done(outcome.path.name)
        done.replaced = _clean(folder, read_sources(folder, head))
    return done


def _is_same(source: Source, mark: str, stamp: str | None) -> bool:
    """Whether a source is as it was imported, as far as its time of change tells."""
    return source.recipe == mark and stamp is not None and source.stamp == stamp


def _count(done: Update, outcome: Outcome, seen: set[str]) -> None:
    if outcome.error is not None:
        done.errors.append(outcome.error)
    elif outcome.source in seen:
        done.alike += 1
    elif outcome.unchanged:
        done.unchanged += 1
    else:
        done.imported += 1
        done.rays += outcome.rays
    seen.add(outcome.source)


def check_target(folder: Path) -> None:
    """Raise `NergError` where no dataset can be made or added to."""
    check_folder(folder)
    with writing(folder):
        if folder.is_dir() and not (folder / HEAD).is_file() and any(os.scandir(folder)):
            raise NergError(f'the folder "{folder}" is there and no dataset of rays: choose another name, or remove it')


def _check_head(folder: Path, recipe: Recipe) -> None:
    """Raise `NergError` where nothing can be added to the dataset, or people would have other names than there."""
    if not (folder / HEAD).is_file():
        return
    head, wanted = read_head(folder), _salt(recipe)
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


def _salt(recipe: Recipe) -> str | None:
    if recipe.key is None:
        return None
    return Marks(recipe.key).of("salt") if recipe.kept_salt else _RANDOM


def _opened(folder: Path, recipe: Recipe) -> Head:
    """The head of a dataset, which is written if there is none."""
    if not (folder / HEAD).is_file():
        write_head(folder, Head(BUCKETS, _salt(recipe)))
    return read_head(folder)


def _remove_if_empty(folder: Path, head: Head) -> None:
    """Remove the account of a new dataset into which nothing was imported, with what imports have left."""
    if read_sources(folder, head):
        return
    _clean(folder, [])
    with writing(folder):
        (folder / HEAD).unlink()
    for path in sorted(folder.rglob("*"), reverse=True):
        # What is not of an import stays.
        with suppress(OSError):
            path.rmdir()


def _clean(folder: Path, sources: Sequence[Source]) -> int:
    """Remove what imports have left that does not belong to ``sources``: accounts of replaced ones, whose number is
    given, parts of them or of sources without an account, and files that were being written."""
    accounts = {source_path(folder, source.id).name for source in sources}
    parts = {folder / part.path(source.id) for source in sources for part in source.parts}
    old = [path for path in (folder / SOURCES).glob("*.json") if path.name not in accounts]
    written = [path for path in old if not path.name.startswith(".")]
    stray = [path for path in folder.glob("place=*/day=*/bucket=*/part-*.parquet") if path not in parts]
    unfinished = [*folder.glob(".*.part.json"), *folder.glob("place=*/day=*/bucket=*/.*.part.parquet")]
    with writing(folder):
        for path in {*old, *stray, *unfinished}:
            path.unlink(missing_ok=True)
    return len(written)
