"""``nerg draw``: Draw a figure: a gaze sphere, occlusion, a floor plan, a contact sheet, a difference.

Figures: the table of their kinds, and drawing and writing one of any kind.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from nerg_mi.errors import MissingFile, NergError
from nerg_mi.figures.style import FORMATS, provenance, save
from nerg_mi.files.atomic import check_writable

from .base import SILENT, Reporter, argument, command, out
from .draw_files import FILE_KINDS
from .draw_scenes import SCENE_KINDS, Kind

# ---- The kinds of figures ----
#
# One more is a `Kind` in the list of its file.


KINDS: dict[str, Kind] = {kind.name: kind for kind in (*SCENE_KINDS, *FILE_KINDS)}


def find_kind(name: str) -> Kind:
    """The kind ``name``. Raises `NergError` for one that is not known."""
    if name not in KINDS:
        raise NergError(f'there is no figure "{name}"; there are {", ".join(KINDS)}')
    return KINDS[name]


# ---- Draw ----
#
# ``nerg draw``: Draw a figure: a gaze sphere, occlusion, a floor plan, a contact sheet, a difference.
#
# A figure of any kind, drawn and written.


FileName = str | os.PathLike


def draw(
    kind: str,
    files: FileName | Sequence[FileName],
    output: FileName | None = None,
    reporter: Reporter = SILENT,
    **options: Any,
) -> Any:
    """The figure of matplotlib that the command ``nerg draw KIND FILES`` draws, with its options as keywords.

    ``output``: where it is written, too (.png or .svg). Raises `NergError` for what the user can mend.
    """
    chosen = find_kind(kind)
    types = {f.name: str(f.type) for f in fields(chosen.options)}
    unknown = next((name for name in options if name not in types), None)
    if unknown is not None:
        raise NergError(f'a figure "{kind}" has no option "{unknown}"; it has {", ".join(types)}')
    options = {k: Path(v) if isinstance(v, str) and "Path" in types[k] else v for k, v in options.items()}
    several = [files] if isinstance(files, (str, os.PathLike)) else files
    return draw_kind(
        chosen,
        [Path(f) for f in several],
        None if output is None else Path(output),
        chosen.options(**options),
        reporter,
    )


def draw_kind(kind: Kind, files: Sequence[Path], output: Path | None, options: Any, reporter: Reporter = SILENT) -> Any:
    """The figure of ``kind`` of ``files``, with an object of its ``options``; written to ``output``, with its
    provenance, where that is given."""
    if output is not None:
        check_writable(output, *FORMATS)
    if not 1 <= len(files) <= kind.most:
        raise NergError(f'a figure "{kind.name}" is drawn of 1 to {kind.most} files, and {len(files)} were given')
    for path in files:
        if not path.exists():
            raise MissingFile(f'there is no file "{path}"')
    made = kind.draw(files, options, reporter)
    if output is not None:
        about = provenance(f"nerg draw {kind.name}", _inputs(made.inputs, options), made.seed, options)
        save(made.figure, output, about)
        reporter.message(f"Wrote {output} ({' x '.join(f'{v:.0f}' for v in made.figure.bbox.size)}).")
    return made.figure


def _inputs(paths: Sequence[Path], options: Any) -> list[Path]:
    """The files that were read: of a scene those that it names, too."""
    from nerg_mi.rendering.scene import files_of_scene

    found: list[Path] = []
    for path in paths:
        if path.suffix.lower() == ".xml":
            found += files_of_scene(path, getattr(options, "defaults", None))
        else:
            found.append(path)
    return found


def _declare(kind: Kind) -> None:
    """Make ``kind`` a command."""

    @command(
        f"draw {kind.name}",
        kind.summary,
        options=kind.options,
        files=argument(f"{kind.takes[:1].upper()}{kind.takes[1:]}.", list[Path] if kind.most > 1 else Path),
        output=out("Picture to write: .png or .svg."),
    )
    def draw_files(files: Path | list[Path], output: Path, options: Any, reporter: Reporter) -> None:
        draw_kind(kind, files if isinstance(files, list) else [files], output, options, reporter)


for _kind in KINDS.values():
    _declare(_kind)
