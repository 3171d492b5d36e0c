"""Opening rays of either kind, a file or a dataset, and the quality report of a dataset."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from nerg_mi.files.atomic import file_sha256

from .dataset import MOST, RayDataset, is_dataset
from .quality import RaysSummary, summarise
from .rays import Rays

# ---- Card ----
#
# The sanity card of a dataset: what its accounts count exactly, and the rest of a stated sample.


SAMPLE = 1 << 20
"""Of so many rays at most are the figures that no account has."""

_RUNS = 64


def summarise_dataset(dataset: RayDataset, most: int = SAMPLE) -> tuple[Rays, RaysSummary, tuple[tuple[str, str], ...]]:
    """Rays of a dataset of one place, its figures, and lines of the card that a file has not.

    The rays are all of them, or of more than ``most`` 64 runs of neighbours: of these are the heights, the speed, the
    rate, the distance of hit points, and what is implausible. All counts, the box and the recorded time are of the
    whole dataset, those of people, cohorts and rows of all its sources. Raises `NergError` as `RayDataset.sample` does.
    """
    parts = [part for _, part in dataset.parts]
    count = len(dataset)
    rays = dataset.sample(most, runs=_RUNS)
    found = summarise(rays)
    reading = Counter[str]()
    for entry in dataset.metadata["dropped"]:
        reading[entry["reason"]] += entry["count"]
    whole = replace(
        found,
        rays=count,
        persons=len(dataset.persons),
        duration=sum(part.recorded for part in parts),
        box_low=np.min([part.low for part in parts], axis=0),
        box_high=np.max([part.high for part in parts], axis=0),
        hit_share=sum(part.hits for part in parts) / count,
        duplicates=sum(part.duplicates for part in parts),
        rows_read=max(count, dataset.metadata["rows_read"]),
        dropped=dict(reading),
        cohorts=dataset.cohorts,
    )
    lines = [("dataset", _extent(dataset))]
    if len(rays) < count:
        lines.append(
            (
                "sampled",
                f"eye height, speed, rate, distances and what is implausible are of {len(rays):,} rays in {_RUNS} runs",
            )
        )
    return rays, whole, tuple(lines)


def _extent(dataset: RayDataset) -> str:
    days = dataset.days
    spanned = days[0] if len(days) == 1 else f"{len(days)} from {days[0]} to {days[-1]}"
    some = lambda found, what: f"{len(found):,} {what}{'' if len(found) == 1 else 's'}"
    return (
        f"{some(dataset.sources, 'source')} in {some(dataset.parts, 'part')} ({dataset.bytes / 1e6:,.1f} MB), "
        f"place {', '.join(dataset.places)}, day {spanned}"
    )


# ---- Opening ----
#
# Rays from what a user names: a file of them, or a dataset.


def load_rays(path: str | os.PathLike, most: int | None = None, seed: int = 0) -> Rays:
    """The rays of a file, or of a dataset or a part of it (``shop.rays/place=north``).

    ``most``: of a dataset, take so many at most: of more, a sample by ``seed`` in which each is as likely as any other.
    None: all, of which there may be 50 million. Raises `NergError` for what is neither, or damaged.
    """
    if not Path(path).is_dir():
        return Rays.load(path)
    found = RayDataset.open(path)
    if most is not None and len(found) > most:
        return found.sample(most, seed)
    return found.load(most=MOST if most is None else most)


def rays_digest(path: str | os.PathLike) -> str:
    """SHA-256 of a file of rays, or that of which rays a dataset holds."""
    return RayDataset.open(path).digest if is_dataset(path) else file_sha256(Path(path))
