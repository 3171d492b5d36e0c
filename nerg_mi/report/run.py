"""What a report is made of: everything that is at hand of one gaze field, computed and drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from nerg_mi.evaluation.gaze.results import GazeResults
from nerg_mi.evaluation.gaze.verdict import Verdict, judge
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.summary import RaysSummary

from .objects import ObjectAttention


@dataclass(frozen=True)
class Picture:
    """A PNG file, what it shows in words (``alt``) and what is said below it."""

    png: bytes
    alt: str
    caption: str


@dataclass(frozen=True, eq=False)
class Run:
    """One gaze field and what is known of it; None or empty is what is not at hand.

    ``gaze``, ``radiance``: metadata of its checkpoint and of the radiance field's; ``place``: what the place is, in a
    sentence, and its ``kind`` ("field", "scene", "hits", "mesh" or "none"). ``rays`` and ``results`` have no names of
    people but those that may be shown. ``pictures`` by what they show: "color", "gaze", "own", "sphere", "depth",
    "spread", "plan", "layout". ``stage``: the packed 3D scene (`stage.pack`). ``inputs``: role, name and SHA-256 of
    each file.
    """

    title: str
    gaze: Mapping[str, Any]
    place: str
    kind: str
    radiance: Mapping[str, Any] = field(default_factory=dict)
    observer: str = ""
    rays: Rays | None = None
    summary: RaysSummary | None = None
    results: tuple[GazeResults, ...] = ()
    # Remarks on them: of another name, of an earlier version.
    doubts: tuple[str, ...] = ()
    objects: tuple[ObjectAttention, ...] = ()
    # From how many places of people objects were looked for.
    eyes: int = 0
    # Shares of objects that fewer people could see are not shown.
    least: int = 1
    # For each looked-from place of people, how many people were within its radius.
    company: tuple[int, ...] = ()
    pictures: Mapping[str, Picture] = field(default_factory=dict)
    stage: str | None = None
    # How many observers, paths and points the 3D scene has.
    stage_observers: int = 0
    stage_paths: int = 0
    stage_points: int = 0
    stage_boxes: int = 0
    inputs: tuple[tuple[str, str, str], ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)
    # What the report was made with, by the option's name.
    settings: Mapping[str, str] = field(default_factory=dict)
    # Rays and people that the gaze rests on, in words, "" where that is not known.
    basis: str = ""
    # Where all of this comes from (`figures.style`), as JSON.
    made: str = ""
    # ``objects`` of the observer alone, where one was named; of people otherwise.
    observed_objects: tuple[ObjectAttention, ...] = ()

    @property
    def provenance(self) -> Mapping[str, Any]:
        """What the gaze field was trained on and with."""
        return self.gaze.get("provenance", {})

    @property
    def verdicts(self) -> list[tuple[GazeResults, Verdict]]:
        """The verdict on each evaluation."""
        return [(r, judge(r.rows, r.split, r.people, r.positions)) for r in self.results]
