"""`nerg draw`: a sub-command for each kind of figure of `nerg_mi.jobs.drawing`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from nerg_mi.jobs.drawing.registry import KINDS, Kind

from .defines import Defines, parse_defines
from .options import takes
from .progress import TerminalReporter

draw_app = typer.Typer(no_args_is_help=True, add_completion=False, rich_markup_mode=None)


def make_command(kind: Kind) -> Callable[..., None]:
    """The command of a ``kind``, with its options; of one that reads a scene, with values for that, too."""

    def plain(files: Any, output: Any, options: Any) -> None:
        _draw(kind, files, output, options)

    def of_scene(files: Any, output: Any, options: Any, define: Defines = None) -> None:
        _draw(kind, files, output, replace(options, defaults=parse_defines(define)))

    scene = any(f.name == "defaults" for f in fields(kind.options))
    command = of_scene if scene else plain
    several = kind.most > 1
    command.__annotations__ = {
        **command.__annotations__,
        "files": Annotated[
            list[Path] if several else Path, typer.Argument(help=f"{kind.takes[:1].upper()}{kind.takes[1:]}.")
        ],
        "output": Annotated[Path, typer.Option("-o", "--output", help="Picture to write: .png or .svg.")],
        "options": kind.options,
    }
    command.__doc__, command.__name__ = kind.summary, kind.name
    return takes(kind.options, "defaults")(command)


def _draw(kind: Kind, files: Path | list[Path], output: Path, options: Any) -> None:
    from nerg_mi.jobs.drawing.draw import draw_kind

    with TerminalReporter() as reporter:
        draw_kind(kind, files if isinstance(files, list) else [files], output, options, reporter)


for _kind in KINDS.values():
    draw_app.command(_kind.name)(make_command(_kind))
