"""Attention on things as numbers, from a notebook."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerg_mi.rays.rays import Rays
from nerg_mi.workflows.base import SILENT, Reporter

from .options import file_of, options_of

if TYPE_CHECKING:
    from nerg_mi.workflows.statistics import StatisticsResult


def stats(
    files: str | os.PathLike[str] | Rays | Sequence[str | os.PathLike[str] | Rays],
    areas: str | os.PathLike[str] | None = None,
    *,
    output: str | os.PathLike[str] | None = None,
    reporter: Reporter = SILENT,
    **options: Any,
) -> StatisticsResult:
    """Numbers of attention on areas of interest: counted in rays, and as a gaze field foretells it.

    ``files``: rays (in memory, or their file, or a dataset), a scene, a gaze field, a radiance field, in any order.
    ``areas``: a JSON file of boxes, meshes, shapes and groups (docs/statistics.md). ``output``: folder for the tables.
    ``options``: those of `nerg stats` (`nerg_mi.aoi.options.StatisticsOptions`). Gives a
    `nerg_mi.workflows.statistics.StatisticsResult`, whose tables are lists of dicts. Raises `NergError`.

    >>> import json, nerg_mi as nerg
    >>> from nerg_mi.api.statistics import stats
    >>> _ = (folder / "areas.json").write_text(json.dumps({"shelf": [[2, -1, 0], [3, 1, 2]]}))
    >>> eye, ahead = [[0.0, 0.0, 1.6]] * 3, [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    >>> rays = nerg.Rays([0.0, 0.2, 0.4], [0, 0, 0], ("Ada",), origin=eye, direction=ahead, confidence=[1.0] * 3)
    >>> row = stats(rays, folder / "areas.json").things[0]
    >>> row["thing"], round(row["share"], 3), row["reach"], row["distance"]
    ('shelf', 0.667, 1.0, 2.0)
    """
    from nerg_mi.aoi.options import StatisticsOptions
    from nerg_mi.workflows.statistics import statistics

    given = [files] if isinstance(files, (str, os.PathLike, Rays)) else list(files)
    if areas is not None:
        options["areas"] = areas
    job = options_of(StatisticsOptions, "stats", None, options)
    paths = [f if isinstance(f, Rays) else file_of(f, "files") for f in given]
    return statistics(paths, None if output is None else Path(output), job, reporter)
