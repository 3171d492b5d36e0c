"""A dataset of rays that was written: scanned block by block, loaded as far as it fits, or sampled."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays

from .choosing import sample_rows
from .conditions import EVERYTHING, Conditions
from .layout import HEAD, split_path
from .manifest import Head, Part, Source, read_head, read_sources
from .merging import merge_counts, merge_metadata, merge_rays
from .parts import read_groups

MOST = 50_000_000
"""So many rays are loaded at once, unless another bound is given."""

RAY_BYTES = 110
"""Memory of a ray that is loaded, roughly."""


@dataclass(frozen=True, eq=False)
class RayDataset:
    """Rays in a folder that `nerg_mi.rays.dataset` has written; or those of a place, day or bucket of it.

    Nothing but the accounts is held in memory.
    """

    folder: Path
    head: Head
    sources: tuple[Source, ...]  # those that have rays in it, or that gave none at all
    parts: tuple[tuple[Source, Part], ...]  # in the order in which they are read: place, day, bucket, source, number

    @classmethod
    def open(cls, path: str | os.PathLike) -> RayDataset:
        """The dataset ``path``, or what of it lies in a folder such as ``shop.rays/place=north/day=2026-11-22``.

        Raises `NergError` for a folder that is no dataset, whose account is damaged, or which holds no such rays.
        """
        folder, chosen = split_path(path)
        if not (folder / HEAD).is_file():
            raise NergError(f"\"{path}\" is no dataset of rays; make one with 'nerg rays import ... -o NAME.rays'")
        head = read_head(folder)
        sources = read_sources(folder, head)
        parts = [
            (source, part)
            for source in sources
            for part in source.parts
            if all(str(getattr(part, key)) == value for key, value in chosen.items())
        ]
        if not parts:
            what = ", ".join(f"{key} {value}" for key, value in chosen.items())
            raise NergError(f'the dataset "{folder}" holds no rays{f" of {what}" if what else ""}; import some into it')
        if chosen:
            there = {source.id for source, _ in parts}
            sources = [source for source in sources if source.id in there]
        parts.sort(key=lambda p: (p[1].place, p[1].day, p[1].bucket, p[0].id, p[1].number))
        return cls(folder, head, tuple(sources), tuple(parts))

    def __len__(self) -> int:
        return sum(part.rays for _, part in self.parts)

    @property
    def bytes(self) -> int:
        """Of all parts."""
        return sum(part.bytes for _, part in self.parts)

    @cached_property
    def places(self) -> tuple[str, ...]:
        return tuple(sorted({part.place for _, part in self.parts}))

    @cached_property
    def days(self) -> tuple[str, ...]:
        return tuple(sorted({part.day for _, part in self.parts}))

    @cached_property
    def persons(self) -> tuple[str, ...]:
        """Names of all people of its sources, sorted."""
        return tuple(sorted({name for source in self.sources for name in source.persons}))

    @cached_property
    def cohorts(self) -> dict[str, int]:
        """Rays of each cohort, of the sources that have some."""
        return merge_counts(source.cohorts for source in self.sources)

    @property
    def metadata(self) -> dict[str, Any]:
        """What the metadata of its rays say of all of them."""
        return merge_metadata(self.sources)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of which sources and parts there are; another one as soon as rays are added or replaced."""
        named = "\n".join(f"{source.id} {part.path(source.id)} {part.rays} {part.bytes}" for source, part in self.parts)
        return hashlib.sha256(named.encode()).hexdigest()

    def of_place(self, place: str) -> RayDataset:
        """Its rays of one place, and the sources that have some there or gave none at all."""
        parts = tuple(found for found in self.parts if found[1].place == place)
        there = {source.id for source, _ in parts}
        return replace(self, parts=parts, sources=tuple(s for s in self.sources if s.id in there or not s.parts))

    def one_place(self) -> RayDataset:
        """Itself. Raises `NergError` where it holds several places, each of which has a frame of its own."""
        if len(self.places) > 1:
            raise NergError(
                f'"{self.folder}" holds {len(self.places)} places, each in a frame of its own; name one of them: '
                + ", ".join(str(self.folder / f"place={place}") for place in self.places[:8])
            )
        return self

    def scan(self, conditions: Conditions = EVERYTHING, *, hits: bool = True, whole: bool = False) -> Iterator[Rays]:
        """The rays that meet ``conditions``, in blocks of at most `GROUP_ROWS`, or with ``whole`` of a part each: all
        rays of its people of one day and source, in the order of persons and times, unless that has more than a
        million.

        Parts and row groups that cannot hold any are not read. ``hits``: whether hit points are read. Persons and
        cohorts of a block are those that occur in it; its metadata hold the frame alone. Raises `NergError` for
        people and cohorts that the dataset does not know, and for what is damaged.
        """
        self._check(conditions)
        for source, part in self.parts:
            if not conditions.may_hold(part, self.head.buckets):
                continue
            wanted = lambda first, n, bounds: conditions.may_hold_group(bounds)
            blocks = (
                kept
                for _, block in read_groups(self.folder, source, part, wanted, hits)
                if len(kept := conditions.select(block))
            )
            if whole:
                found = list(blocks)
                blocks = [merge_rays(found)] if found else []
            yield from blocks

    def _check(self, conditions: Conditions) -> None:
        """Raise `NergError` for names that are not known, and a box that is none."""
        conditions.check()
        for what, names in (
            ("person", conditions.persons),
            ("person", conditions.without_persons),
            ("cohort", conditions.cohorts),
        ):
            if names is None:
                continue
            known = set(self.persons) if what == "person" else {*self.cohorts, "unknown"}
            unknown = [name for name in names if name not in known]
            if unknown:
                some = sorted(known)
                listed = ", ".join(some[:20]) + (", ..." if len(some) > 20 else "")
                raise NergError(f"no {what} is called {', '.join(map(repr, unknown))}; there are {listed}")

    def load(self, conditions: Conditions = EVERYTHING, *, most: int = MOST, hits: bool = True) -> Rays:
        """The rays that meet ``conditions``, in memory. Raises `NergError` where they are more than ``most``, as soon
        as that is known, or of several places."""
        self.one_place()
        if not conditions.any and len(self) > most:
            raise self._too_many(f"{len(self):,}", most)
        found, count = [], 0
        for block in self.scan(conditions, hits=hits):
            found.append(block)
            count += len(block)
            if count > most:
                raise self._too_many(f"more than {count:,}", most)
        return merge_rays(found, self.metadata)

    def _too_many(self, count: str, most: int) -> NergError:
        return NergError(
            f'"{self.folder}" holds {count} such rays, and {most:,} ({most * RAY_BYTES / 1e9:.2g} GB) are loaded at '
            "most: choose some by 'nerg rays filter' (--box, --person, --from, or --sample for some of all), or name a "
            "day of it"
        )

    def sample(self, n: int, seed: int = 0, *, runs: int | None = None, hits: bool = True) -> Rays:
        """``n`` rays, each as likely as any other, in the order of the dataset; all, where there are no more.

        Row groups that hold none of them are not read. Of a large dataset a small sample has some in nearly every
        group: with ``runs`` the rays are so many runs of neighbours in this order, of fewer people, and less is read
        (see `choosing.sample_rows`). The metadata have a step ``sample``. Equal seeds give equal samples of equal
        datasets. Raises `NergError` as `load` does, but for how many rays there are.
        """
        self.one_place()
        rows = sample_rows(len(self), n, seed, runs)
        blocks, start = [], 0
        for source, part in self.parts:
            a, b = np.searchsorted(rows, [start, start + part.rays])
            here = rows[a:b] - start
            start += part.rays
            if not len(here):
                continue
            wanted = partial(_some, here)
            for first, block in read_groups(self.folder, source, part, wanted, hits):
                chosen = _within(here, first, len(block)) - first
                blocks.append(block if len(chosen) == len(block) else block.select(chosen))
        step = {} if runs is None else {"runs": runs}
        found = merge_rays(blocks, self.metadata)
        return (
            found
            if len(rows) == len(self)
            else found.with_step(step="sample", kept=len(rows), of=len(self), seed=seed, **step)
        )


def _within(rows: np.ndarray, first: int, count: int) -> np.ndarray:
    """Those of sorted ``rows`` that are of the ``count`` from ``first`` on."""
    return rows[np.searchsorted(rows, first) : np.searchsorted(rows, first + count)]


def _some(rows: np.ndarray, first: int, count: int, bounds: dict[str, tuple[Any, Any]]) -> bool:
    return len(_within(rows, first, count)) > 0
