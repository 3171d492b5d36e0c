"""Reading files with a reader by its name, for tests."""

from __future__ import annotations

from nerg_mi.rays.rays import Rays
from nerg_mi.rays.readers.registry import make_options, read_rays


def read(name: str, *files, skip_bad_lines: bool = False, **options) -> Rays:
    """The rays of ``files`` by the reader ``name`` with these of its options."""
    return read_rays(name, files, make_options(name, options), skip_bad_lines=skip_bad_lines)


def dropped(rays: Rays) -> dict[str, list]:
    """Rows that were dropped, by reason."""
    return {d["reason"]: d["rows"] for d in rays.metadata["dropped"]}
