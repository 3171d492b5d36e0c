"""What the readers of tracking files found wrong with them."""

from __future__ import annotations

from nerg_mi.rays.rays import Rays

from .figures import Figures


def check_files(rays: Rays, figures: Figures) -> list[str]:
    """What the reader of the files found wrong with them."""
    return list(rays.metadata.get("complaints", []))
