"""Pictures as Mitsuba reads them, also on one core."""

from __future__ import annotations

from nerg_mi.files.images import threads_for_mitsuba


def mitsuba_bitmap(path):
    """A Mitsuba bitmap of the file ``path``."""
    import mitsuba as mi

    with threads_for_mitsuba():
        return mi.Bitmap(str(path))
