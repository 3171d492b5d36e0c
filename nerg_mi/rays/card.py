"""The sanity card of a set of rays in words: what `nerg_mi.rays.summary` found, line by line."""

from __future__ import annotations

import numpy as np

from .rays import Rays
from .summary import GAP, RaysSummary

WARNING = "implausible"
"""Name of the lines that say what is likely wrong."""

_PERSONS = 8  # named
_RUNS = 3  # of dropped lines, named


def card_lines(rays: Rays, summary: RaysSummary) -> list[tuple[str, str]]:
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
    return lines + [(WARNING, warning) for warning in s.warnings]


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
