"""``nerg rays show``: the sanity card."""

from __future__ import annotations

from nerg_mi.cli.progress import TerminalReporter

from .arguments import RaysFile, print_card


def rays_show_command(rays: RaysFile) -> None:
    """The sanity card: rays, persons, duration, rate, what was dropped, extent, eye height.

    Of a dataset one for each place; of very many rays some figures are of a sample, as it says.
    """
    from nerg_mi.jobs.tracking import card_of

    with TerminalReporter() as reporter:
        cards = card_of(rays, reporter)
    for title, found in cards:
        print_card(found.rays, found.summary, title, found.lines)
