"""Sections of a report: the title, the text and the reason shown in place of an empty section; and the page they
form."""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from nerg_mi import __version__
from nerg_mi.environment.radiance import describe_psnr
from nerg_mi.evaluation.baselines import PRIOR
from nerg_mi.evaluation.gaze import SPLIT_HALF
from nerg_mi.evaluation.gaze_report import SPLIT_LABELS, Comparison, GazeResults, Verdict
from nerg_mi.files.html import Html, element, figure, image, key_value_table, markup, paragraph, table
from nerg_mi.tracking.quality import WARNING_LABEL, make_quality_report
from nerg_mi.tracking.rays import TRACKING
from nerg_mi.tracking_kinds import read_tracking
from nerg_mi.train.trainer import use_current_names

from .charts import Point, interval_chart
from .data import RAYS, MeanShare, ObjectAttention, Run

# ---- Section ----


@dataclass(frozen=True)
class Section:
    """One section of the page.

    ``name``: anchor; ``title``: heading; ``render(run)``: content as HTML; ``reason_absent(run)``: sentence that
    explains why the section is empty, or None if it has content.
    """

    name: str
    title: str
    render: Callable[[Run], Html]
    reason_absent: Callable[[Run], str | None] = lambda run: None


# ---- Data quality ----


def _show_data(run: Run) -> Html:
    """Show the data-quality report of the gaze samples."""
    assert run.rays is not None and run.summary is not None
    lines = make_quality_report(run.rays, run.summary)
    warned = any(name == WARNING_LABEL for name, _ in lines)
    message = (
        "Implausible values are marked below. Correct them before you use any other result of this report."
        if warned
        else "The data-quality checks found no implausible values."
    )
    return markup([paragraph(message), key_value_table(lines)])


def _explain_absent_data(run: Run) -> str | None:
    if run.rays is not None:
        return None
    trained = run.provenance.get("rays")
    count = f" The field was trained on {trained:,} gaze samples." if isinstance(trained, int) else ""
    return f"No gaze samples were given, so the report has no data-quality section.{count}"


DATA = Section("data", "The data", _show_data, _explain_absent_data)


# ---- Gaze ----


def _show_gaze(run: Run) -> Html:
    """Show the gaze in the overview, in the observer's view and on the observer's sphere."""
    figures = lambda names: [
        figure(image(p.png, p.alt), p.caption) for p in (run.pictures.get(n) for n in names) if p is not None
    ]
    basis = f" The field is {run.support_note}." if run.support_note else ""
    description = (
        f"{run.observer}{basis} Gaze densities are in 1/sr. A density times the solid angle of a region, as seen by "
        "the observer, is the probability that the observer looks at the region."
    )
    return markup(
        [paragraph(description), *figures(["gaze"]), element("div", figures(["own", "sphere"]), class_="side")]
    )


def _explain_absent_gaze(run: Run) -> str | None:
    if {"gaze", "own", "sphere"} & set(run.pictures):
        return None
    return "The gaze density is zero everywhere around the observer, so there are no images of it."


GAZE = Section("gaze", "The gaze", _show_gaze, _explain_absent_gaze)


# ---- Limits ----

_LIMIT_OF_HEADS = (
    "Head direction is not gaze direction, because the eyes rotate in the head. A field trained on head directions "
    "predicts head directions, and spreads attention too evenly over small AOIs."
)
_LIMITS = (
    "The scene is static. Objects that were moved, restocked or removed on other days are shown as they were when the "
    "scene was captured.",
    "Surfaces are off by a few centimetres along edges. Gaze that passes close to an edge may be assigned to the "
    "surface behind it.",
    "The field extrapolates at positions far from the recorded ones.",
    "Attention is the direction of gaze. It does not show what participants noticed, understood or wanted.",
    "Attention shares describe these participants in this scene. They do not explain why an AOI attracts attention.",
)


def _show_limits(run: Run) -> Html:
    """List the limits."""
    limits = _LIMITS if read_tracking(run.provenance) == "eye" else (_LIMIT_OF_HEADS, *_LIMITS)
    return element("ul", [element("li", text) for text in limits])


LIMITS = Section("limits", "Limits", _show_limits)


# ---- Areas of interest ----

_MAX_CHART_ROWS = 24


def _show_objects(run: Run) -> Html:
    """Show a table and a chart of the AOIs, sorted by attention share."""
    order = sorted(run.objects, key=lambda o: (-o.predicted.mean, o.name))
    visible_objects = [o for o in order if not _is_hidden(o, run.min_participants)]
    recorded = any(o.recorded is not None for o in order)
    shown_parts: list = [paragraph(_objects_text(run, recorded))]
    if visible_objects:
        shown_parts.append(
            figure(
                _objects_chart(visible_objects[:_MAX_CHART_ROWS], recorded),
                _chart_caption(len(visible_objects), recorded),
            )
        )
    measured = ["share of samples, %", "participants with view", "participants with hits"] if recorded else []
    head = ["AOI", "predicted share of gaze, %", *measured]
    rows = [
        _object_row(o, run.min_participants, recorded)
        for o in [*visible_objects, *(o for o in order if _is_hidden(o, run.min_participants))]
    ]
    shown_parts.append(table(head, rows, range(1, len(head))))
    return markup(shown_parts)


def _is_hidden(o: ObjectAttention, min_participants: int) -> bool:
    return o.num_could_see is not None and o.num_could_see < min_participants


def _object_row(o: ObjectAttention, min_participants: int, recorded: bool) -> list[str]:
    if _is_hidden(o, min_participants):
        return [o.name, "hidden", *(["hidden", f"fewer than {min_participants}", "hidden"] if recorded else [])]
    cells = [o.name, _format_share(o.predicted)]
    if recorded and o.recorded is not None:
        cells += [_format_share(o.recorded), f"{o.num_could_see} of {o.num_participants}", f"{o.num_looked}"]
    return cells


def _format_share(share: MeanShare) -> str:
    text = f"{100 * share.mean:.2f}"
    return text if math.isnan(share.low) else f"{text} [{100 * share.low:.2f}, {100 * share.high:.2f}]"


def _objects_chart(objects: list[ObjectAttention], recorded: bool) -> Html:
    point = lambda o, s: Point(
        o.name if len(o.name) < 28 else o.name[:26] + "…", 100 * s.mean, 100 * s.low, 100 * s.high
    )
    panels = [("predicted share of gaze, %", [point(o, o.predicted) for o in objects])]
    if recorded:
        panels.append(("share of samples, %", [point(o, o.recorded) for o in objects if o.recorded is not None]))
    return interval_chart(panels)


def _chart_caption(count: int, recorded: bool) -> str:
    note = f" The chart shows {_MAX_CHART_ROWS} of {count} AOIs." if count > _MAX_CHART_ROWS else ""
    return f"Attention shares{' with 95 % confidence intervals over participants' if recorded else ''}.{note}"


def _objects_text(run: Run, recorded: bool) -> str:
    if not recorded:
        return (
            f"Predicted share of an observer's gaze on each AOI, averaged over {run.num_viewpoints} "
            f"{'viewpoint' if run.num_viewpoints == 1 else 'viewpoints'}. No gaze samples were given, so there "
            "are no participants "
            "and no confidence intervals."
        )
    hidden_note = (
        f" AOIs that fewer than {run.min_participants} participants could see are hidden."
        if run.min_participants > 1
        else ""
    )
    count = 0 if run.rays is None else len(run.rays)
    subset = f" (of {RAYS:,} of the {count:,} samples, evenly spaced)" if count > RAYS else ""
    return (
        f"Predicted share of gaze on each AOI, averaged over {run.num_viewpoints} viewpoints of the "
        f"participants, and the share of the recorded gaze samples that hit the AOI{subset}. Every participant has the "
        "same weight; brackets are 95 % confidence intervals over participants. A participant has a view of an AOI if "
        "it is visible from one of their viewpoints, or if one of their samples hits it. The field is smooth, so it "
        f"may underestimate the share of small AOIs that attract many samples.{hidden_note}"
    )


def _explain_absent_objects(run: Run) -> str | None:
    if run.objects:
        return None
    if run.geometry_kind == "none":
        return "AOIs need the geometry of the scene, which was not given."
    return "No AOIs were given. Name a file of AOIs."


OBJECTS = Section("objects", "Areas of interest", _show_objects, _explain_absent_objects)


# ---- Participants' positions ----


def _show_people(run: Run) -> Html:
    """Show floor plans of the participants' positions."""
    pictures = [run.pictures[name] for name in ("plan", "layout") if name in run.pictures]
    sides = [figure(image(p.png, p.alt), p.caption) for p in pictures]
    return markup([element("div", sides, class_="side"), *(paragraph(w) for w in _nearby_text(run))])


def _nearby_text(run: Run) -> list[str]:
    if not run.nearby_participants:
        return []
    radius = (run.provenance.get("probes") or {}).get("radius")
    distance = f"{radius:g} m" if isinstance(radius, (int, float)) else "half a metre"
    num_single, middle = (
        sum(n <= 1 for n in run.nearby_participants),
        sorted(run.nearby_participants)[len(run.nearby_participants) // 2],
    )
    sentence = (
        f"The median number of participants within {distance} of a viewpoint ({len(run.nearby_participants)} "
        "viewpoints) is"
    )
    if not num_single:
        return [f"{sentence} {middle}; no viewpoint has fewer than two."]
    have = "viewpoint has" if num_single == 1 else "viewpoints have"
    return [
        f"{sentence} {middle}; {num_single} {have} only one. Near such a viewpoint the field reproduces the gaze of a "
        "single participant."
    ]


def _explain_absent_people(run: Run) -> str | None:
    return None if run.rays is not None else "No gaze samples were given, so the participants' positions are unknown."


PEOPLE = Section("people", "Participants' positions", _show_people, _explain_absent_people)


# ---- Scene ----


def _show_environment(run: Run) -> Html:
    """Describe and show the scene."""
    parts = [paragraph(run.geometry_description), key_value_table(_scene_facts(run))]
    picture = run.pictures.get("color")
    if picture is not None:
        parts.append(figure(image(picture.png, picture.alt), picture.caption))
    return markup(parts)


def _scene_facts(run: Run) -> list[tuple[str, str]]:
    provenance, facts = run.radiance.get("provenance", {}), []
    box = run.radiance.get("box") or run.gaze.get("box") or {}
    if "lower" in box and "upper" in box:
        edges = [b - a for a, b in zip(box["lower"], box["upper"])]
        facts.append(("box", " × ".join(f"{e:.2f}" for e in edges) + " scene units (usually metres)"))
    if "training_frames" in provenance:
        facts.append(("training photos", f"{provenance['training_frames']}"))
    if (psnr := describe_psnr(provenance)) is not None:
        facts.append(("image quality", psnr))
    shape = (run.provenance.get("geometry_file") or {}).get("shape")
    if shape:
        facts.append(("hit points", " × ".join(map(str, shape)) + " voxels of the gaze hit points"))
    return facts


ENVIRONMENT = Section("place", "Scene", _show_environment)


# ---- Provenance ----


def _show_provenance(run: Run) -> Html:
    """Show the input files with their checksums, and the software versions."""
    parts = [
        table(["", "file", "SHA-256"], [[role, name, element("code", digest)] for role, name, digest in run.inputs])
    ]
    parts.append(key_value_table(list(run.versions.items())))
    parts.append(
        paragraph(
            "The report is reproducible: the same files, settings and versions give the same bytes. The page is "
            "self-contained and makes no network requests.",
            kind="note",
        )
    )
    return markup(parts)


PROVENANCE = Section("provenance", "Provenance", _show_provenance)


# ---- Evaluation ----

COLUMNS = {"bits": "log score, bits", "CC": "CC", "KLD": "KLD, nats", "NSS": "NSS", "AUC": "AUC"}
"""Column headers of the scores, by key."""

_PANELS = ("bits", "CC", "KLD")


def _show_scores(run: Run) -> Html:
    """Show the scores of each split."""
    parts = [
        paragraph(
            "The ground truth at a position is the density of the gaze samples recorded there. The log score is the "
            "gain in bits per sample over the position-independent baseline. Higher values of the log score, CC, NSS "
            "and AUC are better; lower values of KLD are better. Intervals are 95 % confidence intervals over "
            "participants.",
            kind="note",
        )
    ]
    for results, verdict in run.verdicts:
        parts += [element("h3", _split_title(results)), *_render_split(results, verdict)]
    return markup(parts)


def _split_title(results: GazeResults) -> str:
    title = SPLIT_LABELS.get(results.split, results.split)
    return (
        f"{title[:1].upper()}{title[1:]} ({results.num_participants} participants, {results.num_positions} positions)"
    )


def _render_split(results: GazeResults, verdict: Verdict) -> list[Html]:
    parts = [element("div", verdict.sentence, class_=f"verdict {verdict.grade}")]
    panels = [(COLUMNS[s], [_score_point(r, s, i == 0) for i, r in enumerate(results.rows)]) for s in _PANELS]
    parts.append(
        figure(
            interval_chart(panels),
            "The field (blue) and the baselines, with 95 % confidence intervals over participants.",
        )
    )
    columns = [c for c in COLUMNS if any(_is_finite(r.get(c)) for r in results.rows)]
    rows = [[str(r["method"]), *(_format_score(r, c) for c in columns)] for r in results.rows]
    parts.append(table(["", *(COLUMNS[c] for c in columns)], rows, range(1, 1 + len(columns))))
    if any(r["method"] == SPLIT_HALF for r in results.rows):
        half = (
            "The split half predicts one half of the participants from the other half; it is a reference, not an upper "
            "bound."
        )
        parts.append(paragraph(half, kind="note"))
    elif results.split_half_note:
        parts.append(paragraph(f"The split half is not shown: {results.split_half_note}.", kind="note"))
    if verdict.comparisons:
        comparison_table = table(
            ["baseline", *(f"gain in {COLUMNS[s]}" for s in _PANELS), "outcome"],
            [_comparison_row(c) for c in verdict.comparisons],
            range(1, 1 + len(_PANELS)),
        )
        note = (
            "A positive gain means that the field is better. Intervals are widened for small numbers of participants."
        )
        parts += [comparison_table, paragraph(note, kind="note")]
    if results.participant_rows:
        parts.append(_participants_table(results))
    return parts


def _participants_table(results: GazeResults) -> Html:
    rows = [
        [
            str(r["method"]),
            str(r.get("person", "")),
            f"{r.get('rays') or 0:,}",
            *(_format_number(r.get(s)) for s in _PANELS),
        ]
        for r in results.participant_rows
    ]
    head = ["", "participant", "samples", *(COLUMNS[s] for s in _PANELS)]
    if len(rows) > 60:
        rows, head[1] = rows[:60], "participant (first 60 rows)"
    return element("details", element("summary", "Scores by participant"), table(head, rows, range(2, len(head))))


def _score_point(row: Mapping[str, Any], score: str, is_highlighted: bool) -> Point:
    value = lambda key: float(row[key]) if _is_finite(row.get(key)) else math.nan
    return Point(str(row["method"]), value(score), value(f"{score}.low"), value(f"{score}.high"), is_highlighted)


def _comparison_row(comparison: Comparison) -> list[str]:
    cells = [
        f"{lead.value:+.3f}" + ("" if math.isnan(lead.low) else f" [{lead.low:+.3f}, {lead.high:+.3f}]")
        for lead in comparison.differences
    ]
    return [comparison.reference, *cells, comparison.outcome]


def _format_score(row: Mapping[str, Any], column: str) -> str:
    text = _format_number(row.get(column))
    if (
        text
        and _is_finite(row.get(f"{column}.low"))
        and _is_finite(row.get(f"{column}.high"))
        and row["method"] != SPLIT_HALF
    ):
        text += f" [{row[f'{column}.low']:.3f}, {row[f'{column}.high']:.3f}]"
    return text


def _format_number(value: object) -> str:
    return f"{value:.3f}" if _is_finite(value) else ""


def _is_finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)


def _explain_absent_scores(run: Run) -> str | None:
    if run.results:
        return None
    return "No evaluation was given. Name the output folder of nerg eval gaze, or give gaze samples to evaluate."


SCORES = Section("scores", "Evaluation", _show_scores, _explain_absent_scores)


# ---- Settings ----

_PROVENANCE_LABELS = {
    "recipe": "recipe",
    "steps": "steps",
    "seconds": "seconds",
    "rays": "training samples",
    "probes_made": "probes",
    "escaped_directions": "share of directions without a surface",
    "escaped_gaze": "share of gaze without a surface",
    "made": "created",
}
"""Labels of the scalar provenance entries, by key."""


def _show_settings(run: Run) -> Html:
    """Show tables of settings. Participant names, such as those held out, are replaced by their number."""
    provenance = run.provenance
    facts = [
        (label, _format_setting(provenance[key])) for key, label in _PROVENANCE_LABELS.items() if key in provenance
    ]
    test = provenance.get("test")
    if "rays" in provenance:
        facts.append(("tracking", TRACKING[read_tracking(provenance)]))
    if isinstance(test, dict):
        facts.append(("held out", _describe_held_out(test)))
    parts = [element("h3", "Training"), key_value_table(facts)]
    named = use_current_names(provenance)
    for key, title in (("settings", "Training settings"), ("probes", "Probes")):
        rows = _flatten_settings(named.get(key, {}))
        if rows:
            parts.append(element("details", element("summary", title), key_value_table(rows)))
    architecture = _flatten_settings(run.gaze.get("architecture", {}))
    if architecture:
        parts.append(element("details", element("summary", "Field architecture"), key_value_table(architecture)))
    if run.settings:
        parts += [element("h3", "This report"), key_value_table(list(run.settings.items()))]
    return markup(parts)


def _describe_held_out(test: Mapping[str, Any]) -> str:
    parts = [f"{len(test.get('centres', ()))} positions"]
    if test.get("people"):
        parts.append(f"{len(test['people'])} participants")
    if isinstance(test.get("purged_within"), (int, float)):
        parts.append(f"and all samples within {test['purged_within']:g} m of these positions")
    return ", ".join(parts)


def _flatten_settings(settings: object, prefix: str = "") -> list[tuple[str, str]]:
    """Flatten nested settings into ``(name, text)`` rows; nested names are joined by dots, long lists become their
    length."""
    rows = []
    for key, value in settings.items() if isinstance(settings, dict) else ():
        name = f"{prefix}{key}"
        rows += _flatten_settings(value, f"{name}.") if isinstance(value, dict) else [(name, _format_setting(value))]
    return rows


def _format_setting(value: object) -> str:
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


# ---- 3D view ----


def _show_stage(run: Run) -> Html:
    """Show the 3D viewer with its data, and a fallback image for browsers without scripts or WebGL.

    The viewer is hidden in print, where the gaze section shows the same image.
    """
    assert run.stage is not None
    still = run.pictures.get("gaze") or run.pictures.get("color")
    picture = None if still is None else image(still.png, still.alt, "still")
    mean_option = [f"mean of all {run.stage_observers} observers"] if run.stage_observers != 1 else []
    names = [*mean_option, *(f"observer {k + 1}" for k in range(run.stage_observers))]
    choices = [element("option", name, value=k) for k, name in enumerate(names)]
    kinds = [("gaze", "gaze"), ("paths", "participants' paths"), ("boxes", "AOIs")]
    counts = {"gaze": run.stage_observers, "paths": run.stage_paths, "boxes": run.stage_boxes}
    switches = [
        element("label", element("input", type="checkbox", name=name, checked=True), " ", description)
        for name, description in kinds
        if counts[name] or name == "gaze"
    ]
    controls = element(
        "div",
        element("label", "Gaze of ", element("select", choices)),
        element("output"),
        switches,
        element("button", "Reset view", type="button"),
        class_="controls",
    )
    canvas = element("canvas", aria_label="3D view of the scene with the observers' gaze", role="img")
    data = element("script", Html(run.stage), type="application/json", id="stage-data")
    description = (
        f"{run.stage_points:,} surface points, sampled from panoramas at viewpoints. Drag to rotate, Shift-drag to "
        "pan, and use the wheel to zoom. Back faces are hidden, so that rooms can be seen from outside. Blue marks are "
        "observers. Browsers without scripts or WebGL show an image instead."
        f"{f' The gaze is {run.support_note}.' if run.support_note else ''}"
    )
    return markup([paragraph(description), element("div", controls, canvas, picture, data)])


def _explain_absent_stage(run: Run) -> str | None:
    return None if run.stage is not None else "The 3D view needs the geometry of the scene, which was not given."


STAGE = Section("stage", "3D view", _show_stage, _explain_absent_stage)


# ---- Uncertainty ----


def _show_uncertainty(run: Run) -> Html:
    """Explain the uncertainty of the scores and of the field."""
    members = len(run.gaze.get("architecture", {}).get("members", ()))
    parts = [
        paragraph(
            "Confidence intervals of scores and shares treat the participant as the sampling unit. They do not cover "
            "other scenes, other days or other populations."
        )
    ]
    spread = run.pictures.get("spread")
    if spread is not None:
        parts.append(
            paragraph(
                f"The field is the mean of {members} members, each trained on a bootstrap resample of the participants."
            )
        )
        parts.append(figure(image(spread.png, spread.alt), spread.caption))
    else:
        parts.append(
            paragraph(
                "A single field does not report its own uncertainty. Train an ensemble (nerg train gaze --ensemble 5) "
                "to estimate it."
            )
        )
    validation = run.provenance.get("validation")
    if isinstance(validation, dict) and {"cc", "kld", "zones", "probes"} <= set(validation):
        parts.append(
            paragraph(
                f"Early stopping used {validation['probes']} validation probes in {validation['zones']} zones: "
                f"CC {validation['cc']:.3f}, KLD {validation['kld']:.3f}. These are not test scores, because the "
                "number "
                "of training steps was selected on them."
            )
        )
    return markup(parts)


UNCERTAINTY = Section("uncertainty", "Uncertainty", _show_uncertainty)


# ---- Verdict ----


def _show_verdict(run: Run) -> Html:
    """Show the verdict on each evaluation and the rule behind it."""
    verdicts = [element("div", verdict.sentence, class_=f"verdict {verdict.grade}") for _, verdict in run.verdicts]
    results = run.results[0]
    basis = (
        f"Evaluated on {SPLIT_LABELS.get(results.split, results.split)} ({results.num_participants} participants, "
        f"{results.num_positions} positions). A gain counts "
        "if its 95 % confidence interval over participants excludes zero. The verdict needs a gain in two of the three "
        f"scores (log score, CC, KLD) and a loss in none. The {PRIOR} is a baseline that ignores the "
        "observer's position. The strongest baseline is the one with the highest log score."
    )
    half = next((v.split_half_fraction for _, v in run.verdicts if v.split_half_fraction is not None), None)
    half_note = (
        ""
        if half is None
        else (
            f" The field covers {100 * half:.0f} % of the difference in CC between the position-independent "
            "baseline and "
            f"the split-half score{'' if half <= 1 else ', which is low because each half has few participants'}."
        )
    )
    return markup(
        [*verdicts, paragraph(basis, half_note, kind="note"), *(paragraph(d, kind="note") for d in run.warnings)]
    )


def _explain_absent_verdict(run: Run) -> str | None:
    if run.results:
        return None
    held_out = "test" in run.provenance
    remedy = "Score the field with nerg eval gaze" if held_out else "Hold out zones and participants in the training"
    return (
        f"No evaluation was given, so this report does not state how well the field predicts held-out data. {remedy}."
    )


VERDICT = Section("verdict", "Verdict", _show_verdict, _explain_absent_verdict)


# ---- Order of the sections ----
#
# Define a new section above and add it here.

SECTIONS: tuple[Section, ...] = (
    VERDICT,
    ENVIRONMENT,
    DATA,
    PEOPLE,
    GAZE,
    STAGE,
    OBJECTS,
    SCORES,
    UNCERTAINTY,
    SETTINGS,
    LIMITS,
    PROVENANCE,
)


# ---- Page ----
#
# The page holds its styles and scripts. Its content security policy forbids loading anything else.


def render_page(run: Run) -> str:
    """Return the HTML document of ``run``; equal runs give equal text."""
    style, script = (
        (files("nerg_mi.reports") / name).read_text(encoding="utf-8") for name in ("style.css", "viewer.js")
    )
    scripts = [script] if run.stage is not None else []
    policy = "; ".join(
        [
            "default-src 'none'",
            "img-src data:",
            f"style-src {_csp_hash(style)}",
            f"script-src {' '.join(map(_csp_hash, scripts)) or chr(39) + 'none' + chr(39)}",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )
    head = [
        Html('<meta charset="utf-8">'),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="referrer", content="no-referrer"),
        element("meta", name="generator", content=f"nerg_mi {__version__}"),
        *([element("meta", name="provenance", content=run.provenance_json)] if run.provenance_json else []),
        element("title", run.title),
        element("style", Html(style)),
    ]
    links = [element("a", s.title, href=f"#{s.name}") for s in SECTIONS]
    body = [
        element("header", element("h1", run.title), paragraph("Report on a gaze field", kind="lead")),
        element("nav", links),
        *(_render_section(s, run) for s in SECTIONS),
        *(element("script", Html(text)) for text in scripts),
    ]
    document = [element("head", head), "\n", element("body", element("main", body))]
    return "<!DOCTYPE html>\n" + element("html", markup(document), lang="en") + "\n"


def _render_section(section, run: Run) -> Html:
    absent = section.reason_absent(run)
    body = paragraph(absent, kind="absent") if absent else section.render(run)
    return element("section", element("h2", section.title), body, id=section.name)


def _csp_hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
