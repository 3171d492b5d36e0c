"""The page: its sections in order, what they need to be shown, and a policy by which it loads nothing."""

from __future__ import annotations

import base64
import hashlib
from importlib.resources import files

from nerg_mi import __version__

from .html import Html, element, markup, paragraph
from .run import Run
from .sections.registry import SECTIONS


def page(run: Run) -> str:
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
        *([element("meta", name="provenance", content=run.made)] if run.made else []),
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
    body = paragraph(absent, kind="absent") if absent else section.body(run)
    return element("section", element("h2", section.title), body, id=section.name)


def _part(name: str) -> str:
    return files("nerg_mi.report").joinpath(name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
