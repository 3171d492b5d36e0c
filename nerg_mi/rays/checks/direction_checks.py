"""The checks of directions and their frames, in the order of the card."""

from __future__ import annotations

from .directions import check_directions
from .frames import check_frames
from .head import check_head
from .holding import check_holding
from .locked import check_locked
from .protocol import Check

DIRECTION_CHECKS: tuple[Check, ...] = (check_locked, check_head, check_holding, check_directions, check_frames)
