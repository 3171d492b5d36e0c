"""Named objects."""

from __future__ import annotations

import math

from nerg_mi.report.charts import Point, interval_chart
from nerg_mi.report.html import Html, figure, markup, paragraph, table
from nerg_mi.report.objects import ObjectAttention, Share
from nerg_mi.report.run import Run

from .protocol import Section

_DRAWN = 24


def _show_objects(run: Run) -> Html:
    """A table and a chart, the most attended first."""
    order = sorted(run.objects, key=lambda o: (-o.field.mean, o.name))
    shown = [o for o in order if not _hidden(o, run.least)]
    recorded = any(o.recorded is not None for o in order)
    shown_parts: list = [paragraph(_words(run, recorded))]
    if shown:
        shown_parts.append(figure(_chart(shown[:_DRAWN], recorded), _caption(len(shown), recorded)))
    head = ["object", "gaze by the field, %", *(["rays recorded, %", "could see it", "looked"] if recorded else [])]
    rows = [_row(o, run.least, recorded) for o in [*shown, *(o for o in order if _hidden(o, run.least))]]
    shown_parts.append(table(head, rows, range(1, len(head))))
    return markup(shown_parts)


def _hidden(o: ObjectAttention, least: int) -> bool:
    return o.saw is not None and o.saw < least


def _row(o: ObjectAttention, least: int, recorded: bool) -> list[str]:
    if _hidden(o, least):
        return [o.name, "hidden", *(["hidden", f"fewer than {least}", "hidden"] if recorded else [])]
    cells = [o.name, _percent(o.field)]
    if recorded and o.recorded is not None:
        cells += [_percent(o.recorded), f"{o.saw} of {o.people}", f"{o.looked}"]
    return cells


def _percent(share: Share) -> str:
    text = f"{100 * share.mean:.2f}"
    return text if math.isnan(share.low) else f"{text} [{100 * share.low:.2f}, {100 * share.high:.2f}]"


def _chart(objects: list[ObjectAttention], recorded: bool) -> Html:
    point = lambda o, s: Point(
        o.name if len(o.name) < 28 else o.name[:26] + "…", 100 * s.mean, 100 * s.low, 100 * s.high
    )
    panels = [("gaze by the field, %", [point(o, o.field) for o in objects])]
    if recorded:
        panels.append(("rays recorded, %", [point(o, o.recorded) for o in objects if o.recorded is not None]))
    return interval_chart(panels)


def _caption(count: int, recorded: bool) -> str:
    some = f" The first {_DRAWN} of {count}." if count > _DRAWN else ""
    return f"Shares of attention{', with 95 % intervals over people' if recorded else ''}.{some}"


def _words(run: Run, recorded: bool) -> str:
    if not recorded:
        return (
            f"The share of gaze that the field says an observer gives each object, at {run.eyes} "
            f"{'place' if run.eyes == 1 else 'places'}. Without rays nothing is known of people, and there are no "
            "intervals."
        )
    least = f" What fewer than {run.least} people could see is hidden." if run.least > 1 else ""
    return (
        f"The share of gaze that the field says people give each object, at {run.eyes} places where they stood, and "
        "the share of their rays that end at it. Each person counts alike; brackets are 95 % intervals over "
        "people. Who could see it stood at one of these places in view of it, or looked at it. A field is smooth: "
        "small things that many look at may have a smaller share of it than of the rays."
        f"{least}"
    )


def _explain_absent_objects(run: Run) -> str | None:
    if run.objects:
        return None
    if run.kind == "none":
        return "No objects are named, for nothing is known of the place."
    return "No objects are named: --objects FILE.json gives their boxes."


OBJECTS = Section("objects", "Named objects", _show_objects, _explain_absent_objects)
