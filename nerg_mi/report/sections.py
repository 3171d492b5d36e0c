"""Sections of a report, each with its title, its text and what is said where it has nothing to show, and their page."""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from nerg_mi import __version__
from nerg_mi.evaluation.gaze_report import POSITION_BLIND, SPLIT_HALF, SPLIT_LABELS, Comparison, GazeResults, Verdict
from nerg_mi.rays.quality import WARNING_LABEL, make_quality_report

from .data import ObjectAttention, Run, MeanShare
from .html import Html, Point, element, figure, image, interval_chart, markup, key_value_table, paragraph, table

# ---- What a section of a report is ----


@dataclass(frozen=True)
class Section:
    """``name``: of its anchor; ``title``; ``body(run)``: what it shows; ``absent(run)``: in a sentence why it is left
    out, or None where it is shown."""

    name: str
    title: str
    render: Callable[[Run], Html]
    absent: Callable[[Run], str | None] = lambda run: None


# ---- The data, and their card ----


def _show_data(run: Run) -> Html:
    """The sanity card of the rays."""
    assert run.rays is not None and run.summary is not None
    lines = make_quality_report(run.rays, run.summary)
    warned = any(name == WARNING_LABEL for name, _ in lines)
    words = (
        "What is marked as implausible is the likely mistake; mend it before anything else is believed."
        if warned
        else "Nothing in them is implausible."
    )
    return markup([paragraph(words), key_value_table(lines)])


def _explain_absent_data(run: Run) -> str | None:
    if run.rays is not None:
        return None
    trained = run.provenance.get("rays")
    count = f"; the field was trained on {trained:,}" if isinstance(trained, int) else ""
    return f"The rays are not at hand, so that nothing is shown of who was recorded{count}."


DATA = Section("data", "The data", _show_data, _explain_absent_data)


# ---- Gaze ----
#
# The gaze: pictures of it.


def _show_gaze(run: Run) -> Html:
    """The overview, and the observer's own view and sphere."""
    shown = lambda names: [
        figure(image(p.png, p.alt), p.caption) for p in (run.pictures.get(n) for n in names) if p is not None
    ]
    basis = f" The field is {run.support_note}." if run.support_note else ""
    words = (
        f"{run.observer}{basis} Densities are in 1/sr: what a colour stands for, times the solid angle that "
        "it covers for the observer, is the probability that they look there."
    )
    return markup([paragraph(words), *shown(["gaze"]), element("div", shown(["own", "sphere"]), class_="side")])


def _explain_absent_gaze(run: Run) -> str | None:
    if {"gaze", "own", "sphere"} & set(run.pictures):
        return None
    return "There are no pictures of the gaze, for it is nowhere above zero around the observer."


GAZE = Section("gaze", "The gaze", _show_gaze, _explain_absent_gaze)


# ---- What none of this can tell ----

_LIMITS = (
    "A head is not a gaze: eyes turn away from where a head points. A field from heads says where heads point, and "
    "shares of small things are then too even.",
    "Places are static: what was moved, restocked or stood in the way on other days is as it was when the place was "
    "made.",
    "Gaze that passes a thing on its way counts as gaze on what is behind it wherever the place's surfaces are "
    "off, which they are by a few centimetres along edges.",
    "Far from where people were recorded the field extrapolates.",
    "Attention is where gaze goes, not what was seen, understood or wanted.",
    "Shares are of these people, in this place; that a thing has more of them is no reason why.",
)


def _show_limits(run: Run) -> Html:
    """A list."""
    return element("ul", [element("li", text) for text in _LIMITS])


LIMITS = Section("limits", "Limits", _show_limits)


# ---- Named objects ----

_DRAWN = 24


def _show_objects(run: Run) -> Html:
    """A table and a chart, the most attended first."""
    order = sorted(run.objects, key=lambda o: (-o.predicted.mean, o.name))
    shown = [o for o in order if not _hidden(o, run.min_participants)]
    recorded = any(o.recorded is not None for o in order)
    shown_parts: list = [paragraph(_words(run, recorded))]
    if shown:
        shown_parts.append(figure(_chart(shown[:_DRAWN], recorded), _caption(len(shown), recorded)))
    head = ["object", "gaze by the field, %", *(["rays recorded, %", "could see it", "looked"] if recorded else [])]
    rows = [_row(o, run.min_participants, recorded) for o in [*shown, *(o for o in order if _hidden(o, run.min_participants))]]
    shown_parts.append(table(head, rows, range(1, len(head))))
    return markup(shown_parts)


def _hidden(o: ObjectAttention, least: int) -> bool:
    return o.num_could_see is not None and o.num_could_see < least


def _row(o: ObjectAttention, least: int, recorded: bool) -> list[str]:
    if _hidden(o, least):
        return [o.name, "hidden", *(["hidden", f"fewer than {least}", "hidden"] if recorded else [])]
    cells = [o.name, _percent(o.predicted)]
    if recorded and o.recorded is not None:
        cells += [_percent(o.recorded), f"{o.num_could_see} of {o.num_participants}", f"{o.num_looked}"]
    return cells


def _percent(share: MeanShare) -> str:
    text = f"{100 * share.mean:.2f}"
    return text if math.isnan(share.low) else f"{text} [{100 * share.low:.2f}, {100 * share.high:.2f}]"


def _chart(objects: list[ObjectAttention], recorded: bool) -> Html:
    point = lambda o, s: Point(
        o.name if len(o.name) < 28 else o.name[:26] + "…", 100 * s.mean, 100 * s.low, 100 * s.high
    )
    panels = [("gaze by the field, %", [point(o, o.predicted) for o in objects])]
    if recorded:
        panels.append(("rays recorded, %", [point(o, o.recorded) for o in objects if o.recorded is not None]))
    return interval_chart(panels)


def _caption(count: int, recorded: bool) -> str:
    some = f" The first {_DRAWN} of {count}." if count > _DRAWN else ""
    return f"Shares of attention{', with 95 % intervals over people' if recorded else ''}.{some}"


def _words(run: Run, recorded: bool) -> str:
    if not recorded:
        return (
            f"The share of gaze that the field says an observer gives each object, at {run.num_viewpoints} "
            f"{'place' if run.num_viewpoints == 1 else 'places'}. Without rays nothing is known of people, and there are no "
            "intervals."
        )
    least = f" What fewer than {run.min_participants} people could see is hidden." if run.min_participants > 1 else ""
    return (
        f"The share of gaze that the field says people give each object, at {run.num_viewpoints} places where they stood, and "
        "the share of their rays that end at it. Each person counts alike; brackets are 95 % intervals over "
        "people. Who could see it stood at one of these places in view of it, or looked at it. A field is smooth: "
        "small things that many look at may have a smaller share of it than of the rays."
        f"{least}"
    )


def _explain_absent_objects(run: Run) -> str | None:
    if run.objects:
        return None
    if run.geometry_kind == "none":
        return "No objects are named, for nothing is known of the place."
    return "No objects are named: --objects FILE.json gives their boxes."


OBJECTS = Section("objects", "Named objects", _show_objects, _explain_absent_objects)


# ---- Where people were ----


def _show_people(run: Run) -> Html:
    """Plans of the floor."""
    shown = [run.pictures[name] for name in ("plan", "layout") if name in run.pictures]
    sides = [figure(image(p.png, p.alt), p.caption) for p in shown]
    return markup([element("div", sides, class_="side"), *(paragraph(w) for w in _company(run))])


def _company(run: Run) -> list[str]:
    if not run.nearby_participants:
        return []
    radius = (run.provenance.get("probes") or {}).get("radius")
    within = f"{radius:g} m" if isinstance(radius, (int, float)) else "half a metre"
    alone, middle = sum(n <= 1 for n in run.nearby_participants), sorted(run.nearby_participants)[len(run.nearby_participants) // 2]
    words = f"At the {len(run.nearby_participants)} places that were looked from, the median number of people within {within} is"
    if not alone:
        return [f"{words} {middle}, and nowhere fewer than two."]
    return [
        f"{words} {middle}; at {alone} of them there was only one person. What a field says of a place where one "
        "person stood is what one person did."
    ]


def _explain_absent_people(run: Run) -> str | None:
    return None if run.rays is not None else "The rays are not at hand, so that it is not known where people were."


PEOPLE = Section("people", "Where people were", _show_people, _explain_absent_people)


# ---- The place ----


def _show_place(run: Run) -> Html:
    """What it is and what it looks like."""
    shown = [paragraph(run.geometry_description), key_value_table(_facts(run))]
    picture = run.pictures.get("color")
    if picture is not None:
        shown.append(figure(image(picture.png, picture.alt), picture.caption))
    return markup(shown)


def _facts(run: Run) -> list[tuple[str, str]]:
    about, facts = run.radiance.get("provenance", {}), []
    box = run.radiance.get("box") or run.gaze.get("box") or {}
    if "lower" in box and "upper" in box:
        edges = [b - a for a, b in zip(box["lower"], box["upper"])]
        facts.append(("box", " × ".join(f"{e:.2f}" for e in edges) + " scene units (metres, as a rule)"))
    if "training_frames" in about:
        facts.append(("photos", f"{about['training_frames']} that it was trained on"))
    held = about.get("psnr_held_out")
    if isinstance(held, dict) and held.get("mean") is not None:
        facts.append(("likeness", f"{held['mean']:.1f} dB PSNR on {len(held.get('views', ()))} photos held out"))
    shape = (run.provenance.get("geometry_file") or {}).get("shape")
    if shape:
        facts.append(("hit points", " × ".join(map(str, shape)) + " voxels made of what people looked at"))
    return facts


PLACE = Section("place", "The place", _show_place)


# ---- What all of this was made of, and by what ----


def _show_provenance(run: Run) -> Html:
    """Files with their checksums, and versions of programs."""
    shown = [
        table(["", "file", "SHA-256"], [[role, name, element("code", digest)] for role, name, digest in run.inputs])
    ]
    shown.append(key_value_table(list(run.versions.items())))
    shown.append(
        paragraph(
            "Equal files, settings and versions make an equal report, to the byte. It holds everything that it shows "
            "and asks no network for anything.",
            kind="note",
        )
    )
    return markup(shown)


PROVENANCE = Section("provenance", "Provenance", _show_provenance)


# ---- The evaluation beside its baselines ----

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
    words = SPLIT_LABELS.get(found.split, found.split)
    return f"{words[:1].upper()}{words[1:]} ({found.num_participants} people, {found.num_positions} places)"


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
    if found.participant_rows:
        shown.append(_persons(found))
    return shown


def _persons(found: GazeResults) -> Html:
    rows = [
        [str(r["method"]), str(r.get("person", "")), f"{r.get('rays') or 0:,}", *(_number(r.get(s)) for s in _PANELS)]
        for r in found.participant_rows
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
        for lead in found.differences
    ]
    return [found.reference, *cells, found.outcome]


def _cell(row: Mapping[str, Any], column: str) -> str:
    text = _number(row.get(column))
    if text and _known(row.get(f"{column}.low")) and _known(row.get(f"{column}.high")) and row["method"] != SPLIT_HALF:
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


# ---- What the field was trained with, and what the report was made with ----

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
    shown = [element("h3", "Training"), key_value_table(facts)]
    for key, title in (("settings", "Its settings"), ("probes", "Its probes")):
        rows = _flat(about.get(key, {}))
        if rows:
            shown.append(element("details", element("summary", title), key_value_table(rows)))
    architecture = _flat(run.gaze.get("architecture", {}))
    if architecture:
        shown.append(element("details", element("summary", "Its field"), key_value_table(architecture)))
    if run.settings:
        shown += [element("h3", "This report"), key_value_table(list(run.settings.items()))]
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


# ---- The place in 3D ----


def _show_stage(run: Run) -> Html:
    """The viewer with its data, and the picture that stands for it without scripts and without WebGL. On paper all of
    it is left out, for the picture is in the section before."""
    assert run.stage is not None
    still = run.pictures.get("gaze") or run.pictures.get("color")
    picture = None if still is None else image(still.png, still.alt, "still")
    everyone = [f"the mean of all {run.stage_observers}"] if run.stage_observers != 1 else []
    names = [*everyone, *(f"observer {k + 1}" for k in range(run.stage_observers))]
    choices = [element("option", name, value=k) for k, name in enumerate(names)]
    kinds = [("gaze", "gaze"), ("paths", "people's paths"), ("boxes", "named objects")]
    there = {"gaze": run.stage_observers, "paths": run.stage_paths, "boxes": run.stage_boxes}
    switches = [
        element("label", element("input", type="checkbox", name=name, checked=True), " ", words)
        for name, words in kinds
        if there[name] or name == "gaze"
    ]
    controls = element(
        "div",
        element("label", "Gaze of ", element("select", choices)),
        element("output"),
        switches,
        element("button", "Back to the start", type="button"),
        class_="controls",
    )
    canvas = element("canvas", aria_label="The place in 3D with the gaze of observers", role="img")
    data = element("script", Html(run.stage), type="application/json", id="stage-data")
    words = (
        f"{run.stage_points:,} points of surfaces as they were seen from where people can stand. Drag to turn, "
        "shift and drag to move, the wheel comes closer; backs of surfaces are left out, so that one looks into "
        "rooms from outside. Blue marks are observers. Where scripts or WebGL are off, a picture stands for it."
        f"{f' The gaze is {run.support_note}.' if run.support_note else ''}"
    )
    return markup([paragraph(words), element("div", controls, canvas, picture, data)])


def _explain_absent_stage(run: Run) -> str | None:
    return None if run.stage is not None else "There is no 3D scene, for nothing is known of the place's surfaces."


STAGE = Section("stage", "In 3D", _show_stage, _explain_absent_stage)


# ---- What is uncertain, and how that is known ----


def _show_uncertainty(run: Run) -> Html:
    """Of the scores, of the field, and of single places."""
    members = len(run.gaze.get("architecture", {}).get("members", ()))
    shown = [
        paragraph(
            "Which people came is what is most uncertain: intervals of scores and shares are over people, of whom "
            "each is taken whole. They say nothing of other places, other days or other crowds."
        )
    ]
    spread = run.pictures.get("spread")
    if spread is not None:
        shown.append(paragraph(f"The field is the mean of {members} fields, each trained on a resample of the people."))
        shown.append(figure(image(spread.png, spread.alt), spread.caption))
    else:
        shown.append(
            paragraph(
                "This is a single field, which says nothing of its own uncertainty; nerg train gaze --ensemble 5 "
                "trains one that does."
            )
        )
    validation = run.provenance.get("validation")
    if isinstance(validation, dict) and {"cc", "kld", "zones", "probes"} <= set(validation):
        shown.append(
            paragraph(
                f"While it was trained, {validation['probes']} probes in {validation['zones']} zones were watched: "
                f"CC {validation['cc']:.3f}, KLD {validation['kld']:.3f}. The length of the training was chosen by "
                "them, so that they are no test."
            )
        )
    return markup(shown)


UNCERTAINTY = Section("uncertainty", "Uncertainty", _show_uncertainty)


# ---- The verdict, before all else ----


def _show_verdict(run: Run) -> Html:
    """A sentence for each evaluation, and what it rests on."""
    shown = [element("div", verdict.sentence, class_=f"verdict {verdict.grade}") for _, verdict in run.verdicts]
    results = run.results[0]
    basis = (
        f"By {results.num_participants} people at {results.num_positions} places that were kept from the training. What decides is "
        "whether the 95 % interval over people of the lead in log score, CC and KLD leaves out zero; two of three must "
        f"agree and none may object. {POSITION_BLIND.capitalize()} is where people look wherever they stand. The strongest "
        "baseline is the one with the highest log score."
    )
    half = next((v.split_half_fraction for _, v in run.verdicts if v.split_half_fraction is not None), None)
    way = (
        ""
        if half is None
        else (
            f" Of the way in CC from position-blind to what half of these people say of the other half, the field goes "
            f"{100 * half:.0f} %{'' if half <= 1 else ': further, for half of so few people tell little'}."
        )
    )
    return markup([*shown, paragraph(basis, way, kind="note"), *(paragraph(d, kind="note") for d in run.warnings)])


def _explain_absent_verdict(run: Run) -> str | None:
    if run.results:
        return None
    held_out = "test" in run.provenance
    remedy = (
        "nerg eval gaze scores it" if held_out else "a training with --test-zones and --test-people keeps some back"
    )
    return (
        "There is no verdict, for no evaluation is at hand: nothing is said here of how well the field predicts; "
        f"{remedy}."
    )


VERDICT = Section("verdict", "Verdict", _show_verdict, _explain_absent_verdict)


# ---- The sections, in the order in which they are shown ----
#
# Another one is defined beside these and named here.

SECTIONS: tuple[Section, ...] = (
    VERDICT,
    PLACE,
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
# The page: its sections in order, what they need to be shown, and a policy by which it loads nothing.


def render_page(run: Run) -> str:
    """The whole document. Equal runs give equal text."""
    style, script = (_part(name) for name in ("style.css", "viewer.js"))
    scripts = [script] if run.stage is not None else []
    policy = "; ".join(
        [
            "default-src 'none'",
            "img-src data:",
            f"style-src {_hash(style)}",
            f"script-src {' '.join(map(_hash, scripts)) or chr(39) + 'none' + chr(39)}",
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
        element("header", element("h1", run.title), paragraph("Where people look, as a field: a report.", kind="lead")),
        element("nav", links),
        *(_section(s, run) for s in SECTIONS),
        *(element("script", Html(text)) for text in scripts),
    ]
    document = [element("head", head), "\n", element("body", element("main", body))]
    return "<!DOCTYPE html>\n" + element("html", markup(document), lang="en") + "\n"


def _section(section, run: Run) -> Html:
    absent = section.absent(run)
    body = paragraph(absent, kind="absent") if absent else section.render(run)
    return element("section", element("h2", section.title), body, id=section.name)


def _part(name: str) -> str:
    return files("nerg_mi.report").joinpath(name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
