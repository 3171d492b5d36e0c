"""`nerg demo`: the command line of `nerg_mi.jobs.demo`."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Annotated

import typer

from .defines import Defines, parse_defines
from .mode import BestMode
from .progress import TerminalReporter


def command(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to write into; it is made.")] = Path("out/demo"),
    width: Annotated[int, typer.Option(help="Width of a picture in pixels; pictures are 3:2.")] = 600,
    spp: Annotated[int, typer.Option("--spp", help="Samples a pixel.")] = 8,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random numbers.")] = 0,
    define: Defines = None,
    mode: BestMode = None,
) -> None:
    """Render the demo store: colour, depth, gaze, visibility, the observer's gaze sphere, occlusion, EXR, run.json."""
    defaults = parse_defines(define)
    from nerg_mi.jobs import demo

    options = demo.DemoOptions(defaults=defaults, width=width, spp=spp, seed=seed, mode=mode)
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
