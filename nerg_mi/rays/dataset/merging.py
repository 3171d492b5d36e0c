"""Rays of several blocks or sources as one, and what their metadata say of all of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from nerg_mi.rays.io import COLUMNS
from nerg_mi.rays.rays import FRAME, Rays

from .manifest import Source

_MERGED = ("sources", "dropped", "rows_read", "complaints", "eye_distance", "missing", "unused_columns")
_EMPTY = np.zeros((0, 3))


def merge_rays(blocks: Iterable[Rays], metadata: dict[str, Any] | None = None) -> Rays:
    """The rays of all ``blocks``, in this order, with the sorted persons and cohorts that occur.

    Blocks without hit points or heads get NaN, and those without cohorts the cohort "unknown", where others have some.
    """
    held = [(block.columns(), block.persons, block.cohorts, len(block)) for block in map(_compact, blocks)]
    metadata = {"frame": dict(FRAME)} if metadata is None else metadata
    if not held:
        none = _EMPTY[:, 0]
        return Rays(none, np.zeros(0, np.int32), (), _EMPTY, _EMPTY, none, metadata=metadata)
    persons = tuple(sorted({name for _, names, _, _ in held for name in names}))
    grouped = any("cohort" in columns for columns, *_ in held)
    alike = {"unknown"} if any("cohort" not in columns for columns, *_ in held) else set()
    cohorts = tuple(sorted({name for _, _, names, _ in held for name in names} | alike)) if grouped else ()
    place, group = ({name: k for k, name in enumerate(names)} for names in (persons, cohorts))
    for columns, known, groups, n in held:
        columns["person"] = _renumbered(columns["person"], known, place)
        if grouped:
            codes, groups = (
                (columns["cohort"], groups) if "cohort" in columns else (np.zeros(n, np.int32), ("unknown",))
            )
            columns["cohort"] = _renumbered(codes, groups, group)
        for name, kind in (("hit", np.float64), ("head", np.float32)):
            if name not in columns and any(name in other for other, *_ in held):
                columns[name] = np.full((n, 3), np.nan, kind)
    # Column by column, so that no more than one is there twice.
    joined = {
        name: np.concatenate([columns.pop(name) for columns, *_ in held]) for name in COLUMNS if name in held[0][0]
    }
    return Rays(**joined, persons=persons, cohorts=cohorts, metadata=metadata)


def _compact(rays: Rays) -> Rays:
    """The same rays, without the names of people and cohorts that have none of them."""
    persons, cohorts = _used(rays.person, rays.persons), _used(rays.cohort, rays.cohorts)
    if persons == rays.persons and cohorts == rays.cohorts:
        return rays
    cohort = None if rays.cohort is None else _places(rays.cohort)
    return replace(rays, person=_places(rays.person), persons=persons, cohort=cohort, cohorts=cohorts)


def _used(codes: np.ndarray | None, names: tuple[str, ...]) -> tuple[str, ...]:
    return () if codes is None else tuple(names[k] for k in np.flatnonzero(np.bincount(codes)).tolist())


def _places(codes: np.ndarray) -> np.ndarray:
    """The codes (N,) among those that occur."""
    return (np.cumsum(np.bincount(codes) > 0) - 1)[codes]


def _renumbered(codes: np.ndarray, names: Sequence[str], place: dict[str, int]) -> np.ndarray:
    return np.array([place[name] for name in names], np.int32)[codes]


def merge_metadata(sources: Sequence[Source]) -> dict[str, Any]:
    """What holds for all sources, what was dropped of any, and how many rows were read; ``steps`` that all have had."""
    about = [source.metadata for source in sources]
    first = about[0] if about else {"frame": dict(FRAME)}
    same = {k: v for k, v in first.items() if k not in _MERGED and all(other.get(k) == v for other in about)}
    eyes = {name: metres for other in about for name, metres in other.get("eye_distance", {}).items()}
    complaints = list(dict.fromkeys(sentence for other in about for sentence in other.get("complaints", [])))
    missing = merge_counts(other.get("missing", {}) for other in about)
    unused = list(dict.fromkeys(name for other in about for name in other.get("unused_columns", [])))
    return {
        **same,
        **({"missing": missing} if missing else {}),
        **({"unused_columns": unused} if unused else {}),
        **({"complaints": complaints} if complaints else {}),
        **({"eye_distance": eyes} if eyes else {}),
        "frame": first["frame"],
        "sources": [entry for other in about for entry in other.get("sources", [])],
        "rows_read": sum(other.get("rows_read", 0) for other in about),
        "dropped": [entry for other in about for entry in other.get("dropped", [])],
    }


def merge_counts(counts: Iterable[dict[str, int]]) -> dict[str, int]:
    """Sums by name, in the order of names."""
    total: Counter[str] = Counter()
    for found in counts:
        total.update(found)
    return dict(sorted(total.items()))
