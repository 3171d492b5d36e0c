"""`nerg demo`: the command line of `nerg_mi.jobs.demo`."""

from __future__ import annotations

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.jobs.options.pictures import DemoOptions

from .defines import Defines, parse_defines
from .options import takes
from .progress import TerminalReporter


@takes(DemoOptions, "scene", "defaults")
def demo_command(
    options: DemoOptions,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to write into; it is made.")] = Path("out/demo"),
    define: Defines = None,
) -> None:
    """Render the demo store: colour, depth, gaze, visibility, the observer's gaze sphere, occlusion, EXR, a report."""
    options = replace(options, defaults=parse_defines(define))
    from nerg_mi.jobs import demo

    with TerminalReporter() as reporter:
        demo.make_demo(out, options, reporter)
    print(f"Look at them with: {_viewer(out)}")


def _viewer(out: Path) -> str:
    """The command with which this machine shows the pictures in ``out``."""
    first = out / "occlusion.png"
    opener = "open" if sys.platform == "darwin" else "xdg-open"
    if shutil.which(opener):
        return f"{opener} {first}"
    # A machine without a desktop: any browser that reaches it will do.
    return f"python3 -m http.server --bind 127.0.0.1 --directory {out} 8000, then http://127.0.0.1:8000/{first.name}"
