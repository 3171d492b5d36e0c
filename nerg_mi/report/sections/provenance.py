"""What all of this was made of, and by what."""

from __future__ import annotations

from nerg_mi.report.html import Html, element, markup, pairs, paragraph, table
from nerg_mi.report.run import Run

from .protocol import Section


def _show_provenance(run: Run) -> Html:
    """Files with their checksums, and versions of programs."""
    shown = [
        table(["", "file", "SHA-256"], [[role, name, element("code", digest)] for role, name, digest in run.inputs])
    ]
    shown.append(pairs(list(run.versions.items())))
    shown.append(
        paragraph(
            "Equal files, settings and versions make an equal report, to the byte. It holds everything that it shows "
            "and asks no network for anything.",
            kind="note",
        )
    )
    return markup(shown)


PROVENANCE = Section("provenance", "Provenance", _show_provenance)
