"""What the field was trained with, and what the report was made with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from nerg_mi.report.html import Html, element, markup, pairs
from nerg_mi.report.run import Run

from .protocol import Section

_ABOUT = {
    "recipe": "recipe",
    "steps": "steps",
    "seconds": "seconds",
    "rays": "rays trained on",
    "probes_made": "probes",
    "escaped_directions": "share of directions that meet no surface",
    "escaped_gaze": "share of gaze that meets none",
    "made": "made",
}
"""Entries of the provenance that are numbers or words, and their names."""


def _show_settings(run: Run) -> Html:
    """Tables of settings. What names people, such as who was held out, is counted and not shown."""
    about = run.provenance
    facts = [(words, _shown(about[key])) for key, words in _ABOUT.items() if key in about]
    test = about.get("test")
    if isinstance(test, dict):
        facts.append(("held out", _held_out(test)))
    shown = [element("h3", "Training"), pairs(facts)]
    for key, title in (("settings", "Its settings"), ("probes", "Its probes")):
        rows = _flat(about.get(key, {}))
        if rows:
            shown.append(element("details", element("summary", title), pairs(rows)))
    architecture = _flat(run.gaze.get("architecture", {}))
    if architecture:
        shown.append(element("details", element("summary", "Its field"), pairs(architecture)))
    if run.settings:
        shown += [element("h3", "This report"), pairs(list(run.settings.items()))]
    return markup(shown)


def _held_out(test: Mapping[str, Any]) -> str:
    parts = [f"{len(test.get('centres', ()))} positions"]
    if test.get("people"):
        parts.append(f"{len(test['people'])} people")
    if isinstance(test.get("purged_within"), (int, float)):
        parts.append(f"and every ray within {test['purged_within']:g} m of these positions")
    return ", ".join(parts)


def _flat(found: object, prefix: str = "") -> list[tuple[str, str]]:
    """Numbers, words and flags of ``found``, those of its parts by "part.name"; lists are counted where they are
    long."""
    rows = []
    for key, value in found.items() if isinstance(found, dict) else ():
        name = f"{prefix}{key}"
        rows += _flat(value, f"{name}.") if isinstance(value, dict) else [(name, _shown(value))]
    return rows


def _shown(value: object) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "none"}[value]
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        short = len(value) <= 6 and all(isinstance(v, (int, float)) for v in value)
        return ", ".join(f"{v:g}" for v in value) if short else f"{len(value)} entries"
    return str(value)[:200]


SETTINGS = Section("settings", "Settings", _show_settings)
