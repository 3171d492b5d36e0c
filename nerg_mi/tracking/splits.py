"""Splits of rays into disjoint training and test sets by position, participant or time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.html import summary_table
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.progress import Progress, open_reporter
from nerg_mi.ranges import LENGTHS, SECONDS, SEEDS, Range, check_ranges

from .dataset import open_rays
from .filters import combine_splits, split_by_person, split_by_position, split_by_time
from .rays import SUFFIXES, Rays


class RaysSplit(NamedTuple):
    """Disjoint training and test rays.

    Attributes
    ----------
    train, test : Rays
        The rays, whose metadata record the criteria of the split.
    """

    train: Rays
    test: Rays

    @property
    def purged(self) -> int:
        """Number of rays that are in neither."""
        return self.test.metadata["steps"][-1]["of"] - len(self.train) - len(self.test)

    def _repr_html_(self) -> str:
        return summary_table(self._asdict())

    def save(self, path: FilePath) -> list[Path]:
        """Write NAME-train and NAME-test with the suffix of ``path`` (.npz or .parquet), and return these files."""
        path = to_path(path)
        files = [path.with_name(f"{path.stem}-{side}{path.suffix}") for side in ("train", "test")]
        for file in files:
            check_writable(file, *SUFFIXES)
        for rays, file in zip(self, files):
            rays.save(file)
        return files


@check_ranges
def split_rays(
    rays: Rays | FilePath,
    *,
    test_zones: Annotated[int, Range(0, 1000)] = 0,
    radius: Annotated[float, LENGTHS] = 0.25,
    zone_radius: Annotated[float, Range(0, 10**6)] = 0.2,
    test_positions: Annotated[int, Range(1, 10**5)] = 150,
    min_rays: Annotated[int, Range(1, 10**6)] = 64,
    test_participants: Annotated[float, Range(0, 1)] = 0.0,
    persons: Sequence[str] = (),
    test_time: Annotated[float, Range(0, 1)] = 0.0,
    gap: Annotated[float, SECONDS] = 5.0,
    clock: Literal["all", "person"] = "all",
    seed: Annotated[int, SEEDS] = 0,
    progress: Progress = None,
) -> RaysSplit:
    """Split rays into training and test rays that share no position, participant or period.

    With several criteria, training rays are on the training side of each and test rays on the test side of each; all
    other rays are purged.

    Parameters
    ----------
    rays : Rays or path
        Rays file (.npz or .parquet) or dataset (.rays).
    test_zones : int
        Number of zones whose positions are held out; 0: no split by position.
    radius : float
        Radius R of probes in metres; training rays within 2 R of a test position are purged.
    zone_radius : float
        Radius of a zone in metres.
    test_positions : int
        Maximum number of test positions, in all held-out zones together.
    min_rays : int
        Minimum number of rays within R of a test position.
    test_participants : float
        Fraction of the participants that are held out, at random; 0: no split by participant.
    persons : sequence of str
        Participants that are held out.
    test_time : float
        Fraction of the recording time that is held out, at its end; 0: no split by time.
    gap : float
        Time in seconds before the held-out end whose rays are purged.
    clock : str
        Clock of ``test_time``: all (one for all participants), or person (one for each).
    seed : int
        Seed of zones, positions and participants.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    RaysSplit
        The rays, ``train`` and ``test``, with a method ``save``.

    Raises
    ------
    NergError
        There is no criterion, or an argument is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> train, test = nerg.split_rays(rays, test_participants=0.5)
    >>> sorted(train.participants + test.participants)
    ['Ada', 'Bob']
    """
    if not (test_zones or test_participants or persons or test_time):
        raise NergError(
            f"no criterion is given for the split; add {parameter('test_zones', 3)}, "
            f"{parameter('test_participants', 0.5)}, {parameter('persons', 'NAME')} or "
            f"{parameter('test_time', 0.2)}, or several of them"
        )
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, "reading rays")
        data = open_rays(rays)
        reporter.progress(0.01, "splitting")
        parts: list[tuple[np.ndarray, np.ndarray]] = []
        criteria: dict[str, Any] = {}
        if test_zones:
            held = split_by_position(
                data,
                radius,
                test_probes=test_positions,
                seed=seed,
                zones=test_zones,
                zone_radius=zone_radius,
                min_rays=min_rays,
            )
            parts.append(held.masks)
            criteria["position"] = {
                "radius": radius,
                "zones": test_zones,
                "zone_radius": zone_radius,
                "test_centres": held.test_centres.tolist(),
            }
        if test_participants or persons:
            sides = split_by_person(
                data, test_fraction=test_participants or 0.5, test_persons=list(persons) or None, seed=seed
            )
            parts.append(sides)
            criteria["person"] = {"test": sorted(data.persons[p] for p in np.unique(data.person[sides[1]]))}
        if test_time:
            parts.append(split_by_time(data, test_fraction=test_time, gap=gap, clock=clock))
            criteria["time"] = {"share": test_time, "gap": gap, "of": clock}
        train, test = combine_splits(*parts)
        side = lambda name, mask: data.select(mask).with_step(
            step="split", side=name, seed=seed, kept=int(mask.sum()), of=len(data), by=criteria
        )
        result = RaysSplit(side("train", train), side("test", test))
        reporter.message(
            f"{train.sum():,} training rays, {test.sum():,} test rays, {result.purged:,} purged of {len(data):,}"
        )
    return result
