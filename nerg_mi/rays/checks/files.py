"""What the readers of tracking files found wrong with them."""

from __future__ import annotations

from .figures import Figures
from .protocol import check


@check("what the reader of the files found wrong with them, as it read them")
def check_files(figures: Figures) -> list[str]:
    return list(figures.rays.metadata.get("complaints", []))
