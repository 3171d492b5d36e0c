"""Kinds of events of gaze, and the limits between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

from nerg_mi.ranges import SECONDS, Range, ValidatedDataclass, setting

KINDS = {
    "fixation": "gaze rests on a point, or in a direction, of the world",
    "vor_fixation": "the same while the head turns: the eye compensates (vestibulo-ocular reflex)",
    "smooth_pursuit": "gaze moves slowly and steadily, away from any fixed point and direction",
    "saccade": "gaze moves fast, and so does the eye in the head",
    "visual_scanning": "gaze moves fast, carried along by the head",
    "blink": "pause of several missing samples, no longer than a blink",
    "loss": "other pause with missing samples",
}
"""Kinds of events, and what they are."""

FIXATIONS = ("fixation", "vor_fixation")
"""The kinds of events that are fixations, in all exports, figures and reports."""

MAX_STEP = 0.1
"""Longest interval in seconds between consecutive samples."""
_VELOCITY = Range(0, 10**6)


@dataclass(frozen=True, kw_only=True)
class EventRules(ValidatedDataclass):
    """Limits between the kinds of events. Raises `NergError` for values out of range."""

    GROUP: ClassVar[str] = "Analysis"

    velocity_threshold: float = setting(
        100.0,
        "Velocity of gaze in the world, in degrees per second, above which it is a saccade or visual scanning.",
        allowed=_VELOCITY,
    )
    eye_velocity: float = setting(
        30.0,
        "Peak velocity of the eye in the head, in degrees per second, above which fast gaze is a saccade. Without "
        "head directions, all fast gaze is.",
        allowed=_VELOCITY,
    )
    head_velocity: float = setting(
        10.0,
        "Mean velocity of the head, in degrees per second, above which a fixation is vestibulo-ocular.",
        allowed=_VELOCITY,
    )
    pursuit_velocity: float = setting(
        5.0,
        "Mean velocity of slow gaze, in degrees per second, above which it is a smooth pursuit and no fixation.",
        allowed=_VELOCITY,
    )
    pursuit_angle: float = setting(2.0, "Smallest angle of a smooth pursuit, in degrees.", allowed=Range(0, 180))
    min_fixation: float = setting(0.06, "Shortest fixation or smooth pursuit in seconds.", allowed=SECONDS)
    merge_gap: float = setting(
        0.04, "Longest slow interruption of a saccade or visual scanning in seconds.", allowed=SECONDS
    )
    max_step: float = setting(
        MAX_STEP,
        "Longest interval between consecutive samples in seconds; a longer one ends fixations, and is a pause if "
        "samples are missing.",
        allowed=SECONDS,
    )
    max_blink: float = setting(0.5, "Longest pause in seconds that is a blink.", allowed=SECONDS)

    def describe(self, dispersion: float | None = None) -> dict[str, Any]:
        """Return the definition of a fixation and its parameters, as exports record them; ``dispersion`` as for
        `nerg_mi.tracking.events.label_fixations`."""
        if dispersion is not None:
            return {
                "algorithm": "I-DT",
                "dispersion": dispersion,
                "min_fixation": self.min_fixation,
                "max_step": self.max_step,
            }
        limits = asdict(self)
        return {
            "algorithm": "velocities of gaze and head (I-VT), kinds " + " and ".join(FIXATIONS),
            "velocity": limits.pop("velocity_threshold"),
            **limits,
        }


def read_fixations(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``{"fixations": definition}`` for the ``metadata`` of rays that were reduced to fixations, which outputs
    record with their settings; empty for those of all samples."""
    steps = [step for step in metadata.get("steps", []) if step["step"] == "fixations"]
    counts = ("step", "kept", "of")
    return {"fixations": {k: v for k, v in steps[-1].items() if k not in counts}} if steps else {}
