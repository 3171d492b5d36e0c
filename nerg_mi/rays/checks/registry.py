"""Which checks there are, and what all of them find."""

from __future__ import annotations

from collections.abc import Callable

from nerg_mi.rays.rays import Rays

from .directions import check_directions
from .figures import Figures
from .files import check_files
from .lengths import check_lengths
from .times import check_times

CHECKS: tuple[Callable[[Rays, Figures], list[str]], ...] = (check_files, check_lengths, check_times, check_directions)
"""What is looked for, in the order of the card; each check gives no sentence where nothing is wrong."""


def find_warnings(rays: Rays, figures: Figures) -> list[str]:
    """Sentences about what people cannot have produced, each with the likely mistake and its remedy: those of all
    `CHECKS`."""
    return [warning for check in CHECKS for warning in check(rays, figures)]
