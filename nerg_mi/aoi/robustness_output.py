"""Conclusions of AOI statistics under other choices: their table, the choice that decides, and specification curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.figures.style import INK, Provenance, as_axes, font_size, label_axes, new_page, save, text_scale
from nerg_mi.files.atomic import make_folder, write_text
from nerg_mi.files.dataframes import ResultTables
from nerg_mi.files.values import FilePath

from .output import all_columns, write_rows
from .tables import Row

MIN_HOLDS = 0.95
"""Share of the analyses in which a conclusion must hold to survive."""

MAX_CURVES = 4
"""Maximum number of specification curves in the figure."""

MAX_P = 0.005
"""Largest p-value of a choice that is said to decide, for about ten choices."""

_NUM_BINS = 4
_COLORS = {True: "#2b6cb0", False: "#b8b8b8"}  # whether the interval excludes zero
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Conclusion:
    """A statement on a ``measure``: of the ``kind`` "areas", ``first`` exceeds ``second``; "cells", the measure of the
    ``aoi`` is larger in the cell ``first`` than in ``second``; "rank", ``first`` has the rank ``second``."""

    kind: str
    measure: str
    first: Any
    second: Any
    aoi: str = ""

    def describe(self, is_reversed: bool) -> str:
        """Return the statement in words, with ``first`` and ``second`` exchanged if it is reversed."""
        if self.kind == "rank":
            return f"{self.first} is number {self.second}"
        first, second = (self.second, self.first) if is_reversed else (self.first, self.second)
        if self.kind == "areas":
            return f"{first} > {second}"
        return f"{self.aoi}: {first.dimension} {first.value} > {second.value}"


def explain_variance(values: Sequence[Any], estimates: np.ndarray) -> float:
    """Return the fraction of the variance of ``estimates`` (N,) that one choice explains alone.

    The fraction is that of a one-way analysis of variance over the values, or over quarters of numbers, without what
    chance explains (epsilon squared), and 0 if the F test does not find it. Analyses whose value is None are not
    explained.
    """
    from scipy.special import fdtrc

    rows = np.array([v is not None for v in values]) & np.isfinite(estimates)
    deviation = estimates[np.isfinite(estimates)] - np.mean(estimates[np.isfinite(estimates)])
    total = float((deviation**2).sum())
    labels, y = np.array([v for v, is_row in zip(values, rows) if is_row]), estimates[rows]
    if len(y) and labels.dtype.kind == "f":
        edges = np.quantile(labels, np.arange(1, _NUM_BINS) / _NUM_BINS)
        labels = np.searchsorted(edges, labels)
    groups = [y[labels == value] for value in np.unique(labels)]
    # Rounding errors of equal estimates are no variance.
    if len(groups) < 2 or len(y) <= len(groups) or total <= len(estimates) * (1e-9 * np.abs(y).max()) ** 2:
        return 0.0
    between = sum(len(g) * (g.mean() - y.mean()) ** 2 for g in groups)
    within = sum(((g - g.mean()) ** 2).sum() for g in groups) / (len(y) - len(groups))
    with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0: the choice, where it is made, changes nothing
        p = fdtrc(len(groups) - 1, len(y) - len(groups), np.divide(between / (len(groups) - 1), within))
    return float(np.clip((between - (len(groups) - 1) * within) / total, 0.0, 1.0)) if p < MAX_P else 0.0


def conclusion_rows(
    estimates: Sequence[Mapping[Conclusion, Triple]], drawn: Sequence[Row], source: str
) -> RobustnessResult:
    """Return the tables of the ``estimates`` of the reference, which is the first, and of the analyses ``drawn``;
    ``source`` is that of the values, as in statistics."""
    rows, long = list[Row](), list[Row]()
    for conclusion, (reference, ref_low, ref_high) in estimates[0].items():
        is_rank = conclusion.kind == "rank"
        # Equal values have no direction, and no rank.
        if not abs(reference) > 1e-12 or (is_rank and reference != conclusion.second):
            continue
        sign = -1.0 if reference < 0 else 1.0
        values = sign * np.array([analysis[conclusion] for analysis in estimates[1:]])
        value, ends = values[:, 0], np.sort(values[:, 1:], axis=1)  # NaN without an interval
        holds = value == reference if is_rank else value > 0
        excludes = holds & (ends[:, 0] > 0)
        row: Row = {
            "conclusion": conclusion.describe(sign < 0),
            "measure": conclusion.measure,
            "source": source,
            "reference": sign * reference,
            "low": None if np.isnan(ref_low) else min(sign * ref_low, sign * ref_high),
            "high": None if np.isnan(ref_high) else max(sign * ref_low, sign * ref_high),
            "smallest": float(np.nanmin(value)) if np.isfinite(value).any() else None,
            "largest": float(np.nanmax(value)) if np.isfinite(value).any() else None,
            "holds": float(holds.mean()),
            "excludes_zero": None if is_rank else float(excludes.mean()),
        }
        row["verdict"] = _judge(row, is_rank)
        explained = {name: explain_variance([choice[name] for choice in drawn], value) for name in drawn[0]}
        decisive = max(explained, key=explained.__getitem__)
        row |= {"decides": decisive if explained[decisive] > 0 else "", "explained": explained[decisive]}
        rows.append(row)
        for k, (estimate, (low, high)) in enumerate(zip(value.tolist(), ends.tolist()), 1):
            numbers = {"estimate": estimate, "low": low, "high": high}
            cells = {name: None if np.isnan(number) else number for name, number in numbers.items()}
            long.append({"analysis": k, "conclusion": row["conclusion"], "measure": row["measure"], **cells})
    return RobustnessResult(rows, [{"analysis": k, **choice} for k, choice in enumerate(drawn, 1)], long)


def _judge(row: Row, is_rank: bool) -> str:
    """Return the verdict on a conclusion.

    "survives": the direction holds, and the interval excludes zero, in `MIN_HOLDS` of the analyses; of a rank: it
    holds. "undecided": the interval includes zero in as many analyses. "depends": anything else.
    """
    if is_rank or row["excludes_zero"] >= MIN_HOLDS:
        return "survives" if row["holds"] >= MIN_HOLDS else "depends"
    return "undecided" if row["excludes_zero"] <= 1 - MIN_HOLDS else "depends"


@dataclass(frozen=True, eq=False, repr=False)
class RobustnessResult(ResultTables):
    """Conclusions under other choices: tables as lists of dicts.

    Parameters
    ----------
    conclusions
        Conclusions of the reference, with the share of the analyses in which each ``holds`` and in which its interval
        also ``excludes_zero``, the ``verdict`` ("survives", "depends" or "undecided"), and the choice that ``decides``
        most, with the fraction of the variance that it has ``explained``.
    analyses
        Choices of each analysis.
    estimates
        Estimates of each analysis and conclusion, with their intervals.
    provenance
        Origin of the tables.
    """

    TABLES = ("conclusions", "analyses", "estimates")

    conclusions: list[Row] = field(default_factory=list)
    analyses: list[Row] = field(default_factory=list)
    estimates: list[Row] = field(default_factory=list)
    provenance: Provenance = field(default_factory=lambda: Provenance("nerg robustness"))

    @property
    def verdict(self) -> str:
        """How many differences survive, and which depend on choices, in short sentences, one a line."""
        differences = [row for row in self.conclusions if row["excludes_zero"] is not None]
        count = {name: sum(row["verdict"] == name for row in differences) for name in ("survives", "undecided")}
        if not differences:
            return "There are no areas or cells whose differences could be tested."
        lines = [
            f"{count['survives']} of {len(differences)} differences survive {len(self.analyses)} analyses with other "
            f"choices, and {count['undecided']} are undecided."
        ]
        for row in self.conclusions:
            if row["verdict"] == "depends":
                zero = "" if row["excludes_zero"] is None else f", and excludes zero in {row['excludes_zero']:.0%}"
                cause = f"; {row['decides']} decides most ({row['explained']:.0%})" if row["decides"] else ""
                lines.append(f"{row['conclusion']} ({row['measure']}) holds in {row['holds']:.0%}{zero}{cause}.")
        return "\n".join(lines)

    def draw(self, axes: Any = None) -> Any:
        """Draw specification curves of up to `MAX_CURVES` differences, those that depend on choices first.

        Parameters
        ----------
        axes : array of axes (2, K), optional
            Axes to draw K curves in, estimates above choices. Default: a new figure.

        Returns
        -------
        array of axes
            The axes.
        """
        verdicts = ("depends", "survives", "undecided")
        differences = [row for row in self.conclusions if row["excludes_zero"] is not None]
        shown = sorted(differences, key=lambda row: verdicts.index(row["verdict"]))[:MAX_CURVES]
        names = [name for name in (self.analyses or [{}])[0] if len({row[name] for row in self.analyses}) > 1]
        names.remove("analysis")
        if axes is None:
            page = new_page(180 + 260 * max(len(shown), 1), (260 + 22 * len(names)) * text_scale())
            axes = page.subplots(2, max(len(shown), 1), sharex=True, squeeze=False)
            page.subplots_adjust(
                left=0.42 / (1 + 0.6 * len(shown)), right=0.98, top=0.89, bottom=0.13, hspace=0.08, wspace=0.25
            )
        grid = as_axes(axes, 2 * max(len(shown), 1)).reshape(2, -1)
        for (top, bottom), row in zip(grid.T, shown):
            self._draw_curve(top, bottom, row, names)
        label_axes(grid[0, 0], "", "difference")
        for k, bottom in enumerate(grid[1]):
            bottom.set_yticks(range(len(names)), [name if k == 0 else "" for name in names])
        return axes

    def _draw_curve(self, top: Any, bottom: Any, row: Row, names: Sequence[str]) -> None:
        key = (row["conclusion"], row["measure"])
        estimates = [e for e in self.estimates if (e["conclusion"], e["measure"]) == key and e["estimate"] is not None]
        estimates.sort(key=lambda e: e["estimate"])
        colors = [_COLORS[e["low"] is not None and e["low"] > 0] for e in estimates]
        for k, (e, color) in enumerate(zip(estimates, colors)):
            if e["low"] is not None:
                top.plot([k, k], [e["low"], e["high"]], "-", color=color, linewidth=0.8, alpha=0.5)
        top.scatter(range(len(estimates)), [e["estimate"] for e in estimates], 5, colors, zorder=3)
        top.axhline(0, color=INK, linewidth=0.6)
        top.set_title(f"{row['conclusion']}\n{row['measure']}", fontsize=font_size(8), color=INK, loc="left")
        for height, name in enumerate(names):
            values = [self.analyses[e["analysis"] - 1][name] for e in estimates]
            levels = {v: k for k, v in enumerate(sorted({v for v in values if v is not None}))}
            positions = [k for k, v in enumerate(values) if v is not None]
            # Numbers by their ranks, so that rows are filled evenly.
            y = [height + 0.7 * (levels[values[k]] / max(len(levels) - 1, 1) - 0.5) for k in positions]
            bottom.scatter(positions, y, 2, [colors[k] for k in positions])
        label_axes(bottom, "analyses, by their estimate", "")
        top.tick_params(labelsize=font_size(7), colors=INK, length=2)

    def save(self, folder: FilePath) -> list[Path]:
        """Write the tables (CSV, Markdown and, with pyarrow, Parquet), the figure and the provenance to a folder, which
        is created. Return the files."""
        folder, files = make_folder(Path(folder)), list[Path]()
        for name in self.TABLES:
            rows = getattr(self, name)
            files += write_rows(folder, name, rows, *all_columns(rows))
        save(self.draw(), folder / "robustness.png", self.provenance)
        write_text(folder / "about.json", self.provenance.json() + "\n")
        return [*files, folder / "robustness.png", folder / "about.json"]
