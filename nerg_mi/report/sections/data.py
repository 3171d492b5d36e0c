"""The data, and their card."""

from __future__ import annotations

from nerg_mi.rays.card import WARNING, card_lines
from nerg_mi.report.html import Html, markup, pairs, paragraph
from nerg_mi.report.run import Run

from .protocol import Section


def _show_data(run: Run) -> Html:
    """The sanity card of the rays."""
    assert run.rays is not None and run.summary is not None
    lines = card_lines(run.rays, run.summary)
    warned = any(name == WARNING for name, _ in lines)
    words = (
        "What is marked as implausible is the likely mistake; mend it before anything else is believed."
        if warned
        else "Nothing in them is implausible."
    )
    return markup([paragraph(words), pairs(lines)])


def _explain_absent_data(run: Run) -> str | None:
    if run.rays is not None:
        return None
    trained = run.provenance.get("rays")
    count = f"; the field was trained on {trained:,}" if isinstance(trained, int) else ""
    return f"The rays are not at hand, so that nothing is shown of who was recorded{count}."


DATA = Section("data", "The data", _show_data, _explain_absent_data)
