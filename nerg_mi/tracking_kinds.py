"""What was tracked, eyes or heads, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

TRACKING_NOTES = {"head": "directions of heads", "mixed": "partly directions of heads"}
"""What rays that are not all gaze are, by the kind of their tracking (`nerg_mi.tracking.rays.TRACKING`)."""


def read_tracking(provenance: Mapping[str, Any]) -> str:
    """What was tracked in the recordings of a checkpoint's ``provenance``: "eye", "head", "mixed" or "unknown", as in
    checkpoints of earlier versions."""
    tracking = provenance.get("tracking")
    return tracking if isinstance(tracking, str) and tracking in ("eye", *TRACKING_NOTES) else "unknown"
