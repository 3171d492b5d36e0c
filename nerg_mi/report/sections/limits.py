"""What none of this can tell."""

from __future__ import annotations

from nerg_mi.report.html import Html, element
from nerg_mi.report.run import Run

from .protocol import Section

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
