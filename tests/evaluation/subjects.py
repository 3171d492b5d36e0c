"""Subjects of studies that are not rendered."""

from __future__ import annotations

from typing import Any

from nerg_mi.evaluation.study_subject import StudySubject


def make_subject(extent: float, **attributes: Any) -> StudySubject:
    """Return a subject whose settings can be listed, with a grid of other resolutions."""
    subject = StudySubject()
    for name, value in {"extent": extent, "can_resample": True, **attributes}.items():
        setattr(subject, name, value)
    return subject
