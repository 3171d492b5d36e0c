"""The checks of recordings, in the order of the card: who, how large, and when."""

from __future__ import annotations

from .clocks import check_clocks
from .eyes import check_eyes
from .files import check_files
from .frozen import check_frozen
from .lengths import check_lengths
from .participants import check_participants
from .protocol import Check
from .times import check_times

RECORDING_CHECKS: tuple[Check, ...] = (
    check_files,
    check_participants,
    check_lengths,
    check_eyes,
    check_times,
    check_clocks,
    check_frozen,
)
