"""The data-quality report of a set of rays: its figures, what all checks find, and both as lines of text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import sanitize

from .checks import RECORDING_CHECKS, Figures
from .dataset import RayDataset
from .direction_checks import DIRECTION_CHECKS
from .filters import argsort_by_person_time
from .rays import Rays

# ---- Which checks there are, and what all of them find ----

CHECKS = (*RECORDING_CHECKS, *DIRECTION_CHECKS)  # What is looked for, in the order of the card


def find_warnings(figures: Figures) -> list[str]:
    """Sentences about what people cannot have produced, each with the likely mistake and its remedy: those of all
    `CHECKS`."""
    return [warning for check in CHECKS for warning in check.find(figures)]


def format_check_table() -> str:
    """The checks as a table in Markdown, for the manual."""
    rows = ["| check | looks for |", "|---|---|"]
    return "\n".join([*rows, *(f"| {check.name} | {check.looks_for} |" for check in CHECKS)]) + "\n"


# ---- The sanity card of a set of rays: what came in, and whether it is plausible ----

_BLOCK = 1 << 18  # rays looked at at a time: a summary takes little memory besides the rays
GAP = 1.0  # seconds: a longer pause of a person does not count as recorded time


@dataclass(frozen=True)
class RaysSummary:
    """Figures of :func:`summarise`, of rays in the frame of rays."""

    rays: int
    persons: int
    duration: float  # seconds recorded over all persons, without pauses above one second
    rate: float  # rays a second of a person, by the median step; NaN when no person has two times
    box_low: np.ndarray  # (3,) of the origins, metres
    box_high: np.ndarray
    eye_height: np.ndarray  # (3,) 5, 50 and 95 % of the origins' heights, metres
    speed_p95: float  # 95 % of the origins' speeds, m/s; NaN if unknown
    hit_share: float  # of the rays whose hit point is known
    hit_distance: float  # median distance of the hit points, metres; NaN without any
    duplicates: int  # rays with person and time of another
    rows_read: int  # by the import
    dropped: dict[str, int]  # rows by reason
    cohorts: dict[str, int]  # rays by cohort
    warnings: tuple[str, ...]  # about figures that people cannot produce (`nerg_mi.rays.checks`)


def summarise(rays: Rays) -> RaysSummary:
    """Figures and warnings.

    Raises `NergError` for an empty set.
    """
    if len(rays) == 0:
        raise NergError("there are no rays to summarise; select fewer away")
    order = argsort_by_person_time(rays)
    step, speed = _steps(rays, order)
    duplicates, some = int(np.count_nonzero(step == 0)), bool(step.size)
    positive = step[step > 0]
    median_step = float(np.median(positive)) if positive.size else float("nan")
    del positive
    moving = (step > 0) & (step <= GAP)
    if not moving.all():
        step, speed = step[moving], speed[moving]
    speed /= step
    speed_p95 = float(np.percentile(speed, 95, overwrite_input=True)) if speed.size else float("nan")
    del speed
    rate = 1.0 / (float(np.median(step)) if step.size else median_step)

    known, distance = _hits(rays)
    height = np.percentile(rays.origin[:, 2], [5, 50, 95])
    low, high = rays.origin.min(axis=0), rays.origin.max(axis=0)
    figures = Figures(rays, height, high - low, speed_p95, median_step if some else None, order)
    return RaysSummary(
        rays=len(rays),
        persons=int(np.count_nonzero(np.bincount(rays.person))),
        duration=float(step.sum()),
        rate=rate,
        box_low=low,
        box_high=high,
        eye_height=height,
        speed_p95=speed_p95,
        hit_share=known / len(rays),
        hit_distance=distance,
        duplicates=duplicates,
        rows_read=int(rays.metadata.get("rows_read", len(rays))),
        dropped=_count_dropped(rays.metadata),
        cohorts={name: int(np.count_nonzero(rays.cohort == k)) for k, name in enumerate(rays.cohorts)},
        warnings=tuple(find_warnings(figures)),
    )


def _steps(rays: Rays, order: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Times and distances between successive rays of a person, in ``order`` (`time_order`); as many as there are."""
    step, walked = np.empty((2, max(0, len(rays) - 1)))
    count = 0
    for a in range(0, len(step), _BLOCK):
        rows = slice(a, a + _BLOCK + 1)
        rows = rows if order is None else order[rows]
        same = np.diff(rays.person[rows]) == 0
        here = slice(count, count := count + np.count_nonzero(same))
        step[here] = np.diff(rays.t[rows])[same]
        way = np.diff(rays.origin[rows], axis=0)[same]
        walked[here] = np.sqrt(np.einsum("ij,ij->i", way, way))
    return step[:count], walked[:count]


def _count_dropped(metadata: dict[str, Any]) -> dict[str, int]:
    """Rows that an import left out, by reason."""
    total: dict[str, int] = {}
    for entry in metadata.get("dropped", []):
        total[entry["reason"]] = total.get(entry["reason"], 0) + entry["count"]
    return total


def _hits(rays: Rays) -> tuple[int, float]:
    """How many hit points are known, and their median distance (NaN without any)."""
    if rays.hit is None:
        return 0, float("nan")
    distance, count = np.empty(len(rays)), 0
    for a in range(0, len(rays), _BLOCK):
        way = rays.hit[a : a + _BLOCK] - rays.origin[a : a + _BLOCK]
        found = np.sqrt(np.einsum("ij,ij->i", way, way))
        found = found[np.isfinite(found)]
        distance[count : count + len(found)] = found
        count += len(found)
    return count, float(np.median(distance[:count], overwrite_input=True)) if count else float("nan")


# ---- The sanity card of a set of rays in words: what `nerg_mi.rays.quality` found, line by line ----

WARNING_LABEL = "implausible"  # Name of the lines that say what is likely wrong
_PERSONS = 8  # named
_RUNS = 3  # of dropped lines, named


def make_quality_report(rays: Rays, summary: RaysSummary) -> list[tuple[str, str]]:
    """Names and texts of the card's lines. Texts hold names that come from files."""
    s = summary
    triple = lambda v: " ".join(f"{x:.2f}" for x in v)
    there = [rays.persons[p] for p in np.flatnonzero(np.bincount(rays.person))]
    lines = [
        ("rays", f"{s.rays:,} of {s.rows_read:,} rows"),
        ("persons", f"{s.persons}: {', '.join(there[:_PERSONS])}{', ...' if len(there) > _PERSONS else ''}"),
    ]
    if s.cohorts:
        lines.append(("cohorts", ", ".join(f"{name} {count:,}" for name, count in s.cohorts.items())))
    lines.append(("recorded time", _recorded(s)))
    for reason, count in s.dropped.items():
        share = 100 * count / max(s.rows_read, 1)
        lines.append(("dropped", f"{count:,} ({share:.1f} %): {reason}; {_dropped_lines(rays, reason)}"))
    for what, count in rays.metadata.get("missing", {}).items():
        lines.append(("missing", f"{count:,} {what}"))
    if rays.metadata.get("decimal") == ",":
        lines.append(("numbers", "commas are taken for decimal signs"))
    if rays.metadata.get("passes_midnight"):
        lines.append(("times", "of day without a date, which go on past midnight"))
    unused = rays.metadata.get("unused_columns", [])
    if unused:
        more = f" and {len(unused) - _PERSONS} more" if len(unused) > _PERSONS else ""
        lines.append(("not used", f"{', '.join(unused[:_PERSONS])}{more}"))
    for step in rays.metadata.get("steps", []):
        name = f"{step['step']} {step.get('side', '')}".strip()
        lines.append(("then", f"{name}: {step['kept']:,} of {step['of']:,} rays kept"))
    source = rays.metadata.get("source_frame")
    if source:
        lines.append(("from", f"{source['up']} up, {source['handedness']}-handed, {source['units']}"))
    low, middle, high = s.eye_height
    lines += [
        ("origins", f"{triple(s.box_low)} to {triple(s.box_high)} m (right-handed, z up)"),
        ("eye height", f"{middle:.2f} m (5 to 95 %: {low:.2f} to {high:.2f})"),
        ("speed", f"95 % below {s.speed_p95:.2f} m/s" if np.isfinite(s.speed_p95) else "unknown: see recorded time"),
    ]
    if s.hit_share:
        share = 100 * s.hit_share
        lines.append(("hit points", f"{share:.1f} % of the rays, median distance {s.hit_distance:.2f} m"))
    if s.duplicates:
        lines.append(("duplicates", f"{s.duplicates:,} rays share person and time with another"))
    return lines + [(WARNING_LABEL, warning) for warning in s.warnings]


def format_quality_report(rays: Rays, summary: RaysSummary, title: str, lines: Sequence[tuple[str, str]] = ()) -> str:
    """The card as a table for the terminal, below a ``title``; ``lines``: further ones, before what is implausible."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    # Names come from files: they are neither markup nor control characters of a terminal.
    safe = lambda text: escape(sanitize(text, 10_000))
    card = Table(show_header=False, box=None, title=safe(title), title_justify="left")
    for name, text in sorted([*make_quality_report(rays, summary), *lines], key=lambda line: line[0] == WARNING_LABEL):
        card.add_row(f"[bold]{name}[/bold]" if name == WARNING_LABEL else name, safe(text))
    console = Console()
    with console.capture() as shown:
        console.print(card)
    return shown.get().removesuffix("\n")


def _recorded(s: RaysSummary) -> str:
    if not np.isfinite(s.rate):
        return "unknown: no person has rays at two times"
    if s.duration == 0:
        return f"none: each ray of a person comes more than {GAP:g} s after the one before ({s.rate:.4g} rays a second)"
    return f"{s.duration:,.1f} s at {s.rate:.4g} rays a second"


def _dropped_lines(rays: Rays, reason: str) -> str:
    """The first lines concerned; all of them stand in the file's metadata."""
    lost = [d for d in rays.metadata.get("dropped", []) if d["reason"] == reason and d.get("rows")]
    if not lost:
        return "lines not named"
    runs = lost[0]["rows"]
    text = ", ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in runs[:_RUNS])
    more = f" and of {len(lost) - 1} more" if len(lost) > 1 else ""
    return f"lines {text}{', ...' if len(runs) > _RUNS else ''} of {lost[0].get('file', '')}{more}"


# ---- The sanity card of a dataset: what its accounts count exactly, and the rest of a stated sample ----

SAMPLE = 1 << 20  # Of so many rays at most are the figures that no account has
_SAMPLE_RUNS = 64


def summarise_dataset(dataset: RayDataset, most: int = SAMPLE) -> tuple[Rays, RaysSummary, tuple[tuple[str, str], ...]]:
    """Rays of a dataset of one place, its figures, and lines of the card that a file has not.

    The rays are all of them, or of more than ``most`` 64 runs of neighbours: of these are the heights, the speed, the
    rate, the distance of hit points, and what is implausible. All counts, the box and the recorded time are of the
    whole dataset, those of people, cohorts and rows of all its sources. Raises `NergError` as `RayDataset.sample` does.
    """
    parts = [part for _, part in dataset.parts]
    count = len(dataset)
    rays = dataset.sample(most, runs=_SAMPLE_RUNS)
    found = summarise(rays)
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
        dropped=_count_dropped(dataset.metadata),
        cohorts=dataset.cohorts,
    )
    lines = [("dataset", _extent(dataset))]
    if len(rays) < count:
        which = f"{len(rays):,} rays in {_SAMPLE_RUNS} runs"
        lines.append(("sampled", f"eye height, speed, rate, distances and what is implausible are of {which}"))
    return rays, whole, tuple(lines)


def _extent(dataset: RayDataset) -> str:
    days = dataset.days
    spanned = days[0] if len(days) == 1 else f"{len(days)} from {days[0]} to {days[-1]}"
    some = lambda found, what: f"{len(found):,} {what}{'' if len(found) == 1 else 's'}"
    return (
        f"{some(dataset.sources, 'source')} in {some(dataset.parts, 'part')} ({dataset.bytes / 1e6:,.1f} MB), "
        f"place {', '.join(dataset.places)}, day {spanned}"
    )
