"""The verdict, before all else."""

from __future__ import annotations

from nerg_mi.evaluation.gaze.verdict import BLIND
from nerg_mi.report.html import Html, element, markup, paragraph
from nerg_mi.report.run import Run

from .protocol import Section


def _show_verdict(run: Run) -> Html:
    """A sentence for each evaluation, and what it rests on."""
    shown = [element("div", verdict.sentence, class_=f"verdict {verdict.grade}") for _, verdict in run.verdicts]
    results = run.results[0]
    basis = (
        f"By {results.people} people at {results.positions} places that were kept from the training. What decides is "
        "whether the 95 % interval over people of the lead in log score, CC and KLD leaves out zero; two of three must "
        f"agree and none may object. {BLIND.capitalize()} is where people look wherever they stand. The strongest "
        "baseline is the one with the highest log score."
    )
    half = next((v.half for _, v in run.verdicts if v.half is not None), None)
    way = (
        ""
        if half is None
        else (
            f" Of the way in CC from position-blind to what half of these people say of the other half, the field goes "
            f"{100 * half:.0f} %{'' if half <= 1 else ': further, for half of so few people tell little'}."
        )
    )
    return markup([*shown, paragraph(basis, way, kind="note"), *(paragraph(d, kind="note") for d in run.doubts)])


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
