"""The sanity card of a dataset: what its accounts count exactly, and the rest of a stated sample."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from nerg_mi.rays.rays import Rays
from nerg_mi.rays.summary import RaysSummary, summarise

from .dataset import RayDataset

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
