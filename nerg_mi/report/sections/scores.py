"""The evaluation beside its baselines."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from nerg_mi.evaluation.gaze.results import GazeResults
from nerg_mi.evaluation.gaze.verdict import HALF, WORDS, Comparison, Verdict
from nerg_mi.report.charts import Point, interval_chart
from nerg_mi.report.html import Html, element, figure, markup, paragraph, table
from nerg_mi.report.run import Run

from .protocol import Section

COLUMNS = {"bits": "log score, bits", "CC": "CC", "KLD": "KLD, nats", "NSS": "NSS", "AUC": "AUC"}
"""The scores that are shown, and their names."""

_PANELS = ("bits", "CC", "KLD")


def _show_scores(run: Run) -> Html:
    """A part for each split."""
    parts = [
        paragraph(
            "Truth at a place is the density of the rays of people who stood there. The log score is how many bits "
            "better a ray is told than by the position-blind density, higher is better, as are CC, NSS and AUC; of "
            "KLD less is better. Intervals are of 95 %, over people. The split half, half of the people as told by "
            "the other half, is a reference and no bound.",
            kind="note",
        )
    ]
    for results, verdict in run.verdicts:
        parts += [element("h3", _title(results)), *_split(results, verdict)]
    return markup(parts)


def _title(found: GazeResults) -> str:
    words = WORDS.get(found.split, found.split)
    return f"{words[:1].upper()}{words[1:]} ({found.people} people, {found.positions} places)"


def _split(found: GazeResults, verdict: Verdict) -> list[Html]:
    shown = [element("div", verdict.sentence, class_=f"verdict {verdict.grade}")]
    panels = [(COLUMNS[s], [_point(r, s, i == 0) for i, r in enumerate(found.rows)]) for s in _PANELS]
    shown.append(
        figure(interval_chart(panels), "The field (blue) beside what needs none, with 95 % intervals over people.")
    )
    there = [c for c in COLUMNS if any(_known(r.get(c)) for r in found.rows)]
    rows = [[str(r["method"]), *(_cell(r, c) for c in there)] for r in found.rows]
    shown.append(table(["", *(COLUMNS[c] for c in there)], rows, range(1, 1 + len(there))))
    if verdict.comparisons:
        leads = table(
            ["the field beside", *(f"lead in {COLUMNS[s]}" for s in _PANELS), "so it is"],
            [_lead(c) for c in verdict.comparisons],
            range(1, 1 + len(_PANELS)),
        )
        note = "Leads are positive where the field is better; their intervals are made wider for few people."
        shown += [leads, paragraph(note, kind="note")]
    if found.persons:
        shown.append(_persons(found))
    return shown


def _persons(found: GazeResults) -> Html:
    rows = [
        [str(r["method"]), str(r.get("person", "")), f"{r.get('rays') or 0:,}", *(_number(r.get(s)) for s in _PANELS)]
        for r in found.persons
    ]
    head = ["", "person", "rays", *(COLUMNS[s] for s in _PANELS)]
    if len(rows) > 60:
        rows, head[1] = rows[:60], "person (the first 60 rows)"
    return element("details", element("summary", "Person by person"), table(head, rows, range(2, len(head))))


def _point(row: Mapping[str, Any], score: str, own: bool) -> Point:
    value = lambda key: float(row[key]) if _known(row.get(key)) else math.nan
    return Point(str(row["method"]), value(score), value(f"{score}.low"), value(f"{score}.high"), own)


def _lead(found: Comparison) -> list[str]:
    cells = [
        f"{lead.value:+.3f}" + ("" if math.isnan(lead.low) else f" [{lead.low:+.3f}, {lead.high:+.3f}]")
        for lead in found.leads
    ]
    return [found.reference, *cells, found.outcome]


def _cell(row: Mapping[str, Any], column: str) -> str:
    text = _number(row.get(column))
    if text and _known(row.get(f"{column}.low")) and _known(row.get(f"{column}.high")) and row["method"] != HALF:
        text += f" [{row[f'{column}.low']:.3f}, {row[f'{column}.high']:.3f}]"
    return text


def _number(value: object) -> str:
    return f"{value:.3f}" if _known(value) else ""


def _known(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)


def _explain_absent_scores(run: Run) -> str | None:
    if run.results:
        return None
    return "No evaluation is at hand: give the folder that nerg eval gaze wrote, or the rays with --evaluate."


SCORES = Section("scores", "Evaluation", _show_scores, _explain_absent_scores)
