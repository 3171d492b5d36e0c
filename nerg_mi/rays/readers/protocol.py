"""What a reader of tracking files is.

To add a format, write a module (in `glasses` or `headsets` where it is of one) with a class that has what
:class:`Reader` names, and an object of it in its ``READERS``; add the module to the list in
:mod:`nerg_mi.rays.readers.registry`. The command line, its help and the manual's table are made from it. A reader takes
files apart and says in which frame they are; dropping rows, converting the frame and keeping the account is the
builder's work, the same for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, TypeVar

from .builder import RaysBuilder
from .frames import Frame

O = TypeVar("O")
"""The type of a reader's options: a frozen dataclass whose fields are made by `nerg_mi.rays.readers.options.option`."""

RECORDINGS = "recordings"
"""Of a reader that was checked on recordings of people."""

DESCRIPTION = "generated files"
"""Of one that was checked on files made after the source or manual of the program that writes them."""


class Reader(Protocol[O]):
    """A format of tracking files."""

    name: str
    """Its word for ``--preset``: lower case letters, digits and underscores."""

    files: str
    """What to give, in a phrase of Markdown: the files, and the columns that they need."""

    world: str
    """The frame of its files, in a phrase of Markdown."""

    checked_on: str
    """What it was checked on: `RECORDINGS`, `DESCRIPTION`, or words of its own."""

    Options: type[O]
    """Its options; `nerg_mi.rays.readers.options.NoOptions` where it has none."""

    def frame(self, files: Sequence[Path], options: O) -> Frame:
        """The frame of what `read` adds: fixed, declared by ``options``, or found in ``files``; one for all of them."""
        ...

    def read(self, files: Sequence[Path], options: O, builder: RaysBuilder) -> None:
        """Add the rays of ``files`` (or folders), source by source, to ``builder``.

        Each file is begun with ``builder.source(path)``, and its rows are added block by block with ``builder.add``:
        times in seconds, origins and hit points in the frame and units of `frame`, directions of any length,
        confidences in [0, 1], NaN where something is missing, the 1-based ``rows`` of the file, and reasons of the
        format's own to ``drop`` some. The checks of rays see more where the file has heads (``head``) and both eyes
        (``eye_distance``); where the height 0 of the files is not the floor, ``builder.note(floor="unknown")`` says so.
        Tables are read by ``builder.read_table``, which names the columns that are not used. Where origins or
        directions are computed, ``recorded_origin`` and ``recorded_direction`` are those of the file, in which fill
        values are looked for. Lines that cannot be read are told to ``builder.on_bad`` where there is one. What
        else is worth keeping goes into the metadata with ``builder.note``; options are kept there already. Memory stays
        bounded by the blocks. Raises `NergError` for what the user can mend: a missing column or file, a damaged one,
        an option that is needed.
        """
        ...
