"""Arguments that sub-commands of ``nerg rays`` have in common, and the card that they print."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from nerg_mi.rays.quality import RaysSummary
    from nerg_mi.rays.rays import Rays

RaysFile = Annotated[Path, typer.Argument(help="Rays file (.npz or .parquet), or dataset (a folder).")]
Output = Annotated[
    Path, typer.Option("-o", "--output", help="Rays file (.npz or .parquet) or dataset (.rays) to write.")
]


def print_card(rays: Rays, summary: RaysSummary, path: Path | str, lines: Sequence[tuple[str, str]] = ()) -> None:
    """The sanity card of the rays in the file ``path``, as a table on the terminal; ``lines``: further ones, before
    what is implausible."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from nerg_mi.files.safe_read import plain
    from nerg_mi.rays.quality import WARNING, card_lines

    # Names come from files: they are neither markup nor control characters of a terminal.
    safe = lambda text: escape(plain(text, 10_000))
    card = Table(show_header=False, box=None, title=safe(path), title_justify="left")
    found = card_lines(rays, summary)
    for name, text in sorted([*found, *lines], key=lambda line: line[0] == WARNING):
        card.add_row(f"[bold]{name}[/bold]" if name == WARNING else name, safe(text))
    Console().print(card)
