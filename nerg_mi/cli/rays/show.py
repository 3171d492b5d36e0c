"""``nerg rays show``: the sanity card."""

from __future__ import annotations

from .arguments import RaysFile, print_card


def command(rays: RaysFile) -> None:
    """The sanity card: rays, persons, duration, rate, what was dropped, extent, eye height."""
    from nerg_mi.rays.rays import Rays
    from nerg_mi.rays.summary import summarise

    data = Rays.load(rays)
    print_card(data, summarise(data), rays)
