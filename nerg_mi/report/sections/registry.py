"""The sections, in the order in which they are shown. Another one is defined beside these and named here."""

from __future__ import annotations

from .data import DATA
from .gaze import GAZE
from .limits import LIMITS
from .objects import OBJECTS
from .people import PEOPLE
from .place import PLACE
from .protocol import Section
from .provenance import PROVENANCE
from .scores import SCORES
from .settings import SETTINGS
from .stage import STAGE
from .uncertainty import UNCERTAINTY
from .verdict import VERDICT

SECTIONS: tuple[Section, ...] = (
    VERDICT,
    PLACE,
    DATA,
    PEOPLE,
    GAZE,
    STAGE,
    OBJECTS,
    SCORES,
    UNCERTAINTY,
    SETTINGS,
    LIMITS,
    PROVENANCE,
)
