"""What is uncertain, and how that is known."""

from __future__ import annotations

from nerg_mi.report.html import Html, figure, image, markup, paragraph
from nerg_mi.report.run import Run

from .protocol import Section


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
