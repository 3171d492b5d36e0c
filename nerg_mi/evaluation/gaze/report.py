"""What an evaluation of gaze writes: tables as Markdown, CSV and JSON, and pictures of truth and prediction."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from nerg_mi.figures.style import Provenance, find_colors, new_page, save
from nerg_mi.files.atomic import write_text
from nerg_mi.files.tables import markdown_table, write_csv, write_json
from nerg_mi.maths.sphere import Z_UP, latlong_grid
from nerg_mi.probes.probes import LEVELS, level_name

from .baselines import Baseline
from .evaluation import SCORES, GazeTest
from .uncertainty import KEPT

# Digits of the scores that have others than three.
_DIGITS = {"MAE": 4}
# Columns that hold words.
_WORDS = ("method", "person", "signal", "error")


def markdown(rows: list[dict], columns: tuple[str, ...] = ("method", *SCORES, "integral")) -> str:
    """A table of ``rows``, with intervals in brackets where they are known."""
    shown = [c for c in columns if any(c in r for r in rows)]
    numbers = [c for c in shown if c not in _WORDS]
    return markdown_table(shown, ([_cell(row, c) for c in shown] for row in rows), numbers) + "\n"


def _cell(row: dict, column: str) -> str:
    value = row.get(column)
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if not isinstance(value, float):
        return str(value)
    digits = _DIGITS.get(column, 3)
    text = f"{value:.{digits}f}"
    if f"{column}.low" in row:
        text += f" [{row[f'{column}.low']:.{digits}f}, {row[f'{column}.high']:.{digits}f}]"
    return text


def write_report(
    folder: Path,
    rows: list[dict],
    persons: list[dict],
    about: dict,
    notes: str,
    positions: list[dict] | None = None,
    ranks: list[dict] | None = None,
    regions: list[dict] | None = None,
) -> list[Path]:
    """Write ``gaze.md``, ``gaze.csv``, ``persons.csv``, ``gaze.json`` and ``positions.csv`` into ``folder``; returns
    their paths.

    ``rows``, ``persons``: a row a method, and a method and person; ``about``: what was scored (JSON); ``notes``: what
    the Markdown begins with; ``positions``, ``ranks``, ``regions``: rows of `uncertainty`.
    """
    positions, ranks, regions = positions or [], ranks or [], regions or []
    files = [folder / name for name in ("gaze.md", "gaze.csv", "persons.csv", "gaze.json", "positions.csv")]
    ours, bar = rows[0], next(r["method"] for r in reversed(rows) if r["method"] != "split half")
    difference = {k.replace(".less", ""): v for k, v in ours.items() if ".less" in k}
    differences = [{"method": f"{ours['method']} less {bar}", **difference}]
    each = markdown(persons, ("method", "person", "rays", "KLD", "CC", "NSS", "AUC", "bits", "loglik"))
    text = f"{notes}\n\n{markdown(rows)}\n{markdown(differences)}\n{uncertainty_text(ranks, regions)}"
    write_text(files[0], f"{text}## Each person\n\n{each}")
    for path, table in zip((*files[1:3], files[4]), (rows, persons, positions)):
        write_csv(path, table)
    clean = lambda table: [
        {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in r.items()} for r in table
    ]
    of_all = {"methods": rows, "persons": persons, "uncertainty": ranks, "calibration": regions}
    write_json(files[3], {**about, **{k: clean(v) for k, v in of_all.items()}}, allow_nan=False)
    return files


def uncertainty_text(ranks: list[dict], regions: list[dict]) -> str:
    """What a page says of rows of `uncertainty.rank_rows` and `uncertainty.calibration_rows`, as Markdown."""
    text = ""
    if ranks:
        shares = tuple(f"{share:.0%}" for share in KEPT)
        text += (
            "## Uncertainty\n\nrho: Spearman's rank correlation of what makes unsure (little support; a wide spread of "
            "an ensemble's members) with the error at a position: KLD, or its excess over that of half of the people "
            "under the other half. Then the mean error of the surest positions. A signal that is the same everywhere "
            f"has no rho.\n\n{markdown(ranks, ('signal', 'error', 'positions', 'rho', *shares))}\n"
        )
    if regions:
        text += (
            "## Calibration\n\nShare of the rays in the smallest regions that are said to hold so much of the gaze; "
            '"calibrated": that should hold so much, by what the training held out.'
            f"\n\n{markdown(regions, ('method', *(level_name(level) for level in LEVELS)))}\n"
        )
    return text


def side_by_side(
    test: GazeTest,
    methods: dict[str, Baseline],
    path: Path,
    count: int = 4,
    height: int = 48,
    about: Provenance | None = None,
) -> None:
    """Truth and each of ``methods`` at ``count`` test positions, as panoramas (z up) on one scale a row, in 1/sr, with
    how many rays of how many people the truth is made of."""
    d, _ = latlong_grid(2 * height, height, Z_UP)
    which = np.unique(np.linspace(0, len(test.centres) - 1, count).astype(int))
    near = np.argmax(test.directions @ d.T, axis=0)  # the truth is smooth at the scale of its directions
    pictures = [("truth", test.truth[which][:, near])] + [
        (k, np.asarray(m(test.centres[which], d))) for k, m in methods.items()
    ]
    figure = new_page(374 * len(pictures), 209 * len(which))
    figure.set_layout_engine("constrained")
    axes = figure.subplots(len(which), len(pictures), squeeze=False)
    for i, row in enumerate(axes):
        top, images = np.quantile(pictures[0][1][i], 0.995), []
        for (name, maps), axis in zip(pictures, row):
            shown = maps[i].reshape(height, 2 * height)
            images.append(axis.imshow(shown, vmin=0, vmax=top, cmap=find_colors("inferno")))
            axis.set(xticks=[], yticks=[])
            if i == 0:
                axis.set_title(name, fontsize=10)
        rays = test.counts[which[i]]
        words = f"{rays.sum():,.0f} rays of {np.count_nonzero(rays)} people"
        row[0].set_ylabel(", ".join(f"{x:.1f}" for x in test.centres[which[i]]) + f" m\n{words}", fontsize=8)
        figure.colorbar(images[-1], ax=row.tolist(), shrink=0.9).set_label("1/sr", fontsize=8)
    save(figure, path, about)
