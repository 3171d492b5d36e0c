"""The sections, in the order in which they are shown. Another one is a file beside these, named here."""

from __future__ import annotations

from . import data, gaze, limits, objects, people, place, provenance, scores, settings, stage, uncertainty, verdict

SECTIONS = tuple(
    module.SECTION
    for module in (
        verdict,
        place,
        data,
        people,
        gaze,
        stage,
        objects,
        scores,
        uncertainty,
        settings,
        limits,
        provenance,
    )
)
