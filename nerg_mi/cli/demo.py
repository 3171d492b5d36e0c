"""`nerg demo`: the command line of `nerg_mi.view.demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to write into; it is made.")] = Path("out/demo"),
    width: Annotated[int, typer.Option(help="Width of a picture in pixels; pictures are 3:2.")] = 600,
    spp: Annotated[int, typer.Option("--spp", help="Samples a pixel.")] = 8,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random numbers.")] = 0,
    define: Annotated[
        list[str] | None,
        typer.Option(
            "-D", "--define", metavar="KEY=VALUE", help="Value for a <default> of the scene, such as eye or falloff."
        ),
    ] = None,
    variant: Annotated[
        str | None,
        typer.Option("-m", "--mode", help="Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]"),
    ] = None,
) -> None:
    """Render the demo store: colour, depth, gaze, visibility, the observer's gaze sphere, occlusion, EXR, run.json."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from nerg_mi.rendering import pictures as rendering
    from nerg_mi.view import demo

    columns = TextColumn("{task.description:<18}"), BarColumn(), TimeElapsedColumn()
    with Progress(*columns) as progress:
        bar = progress.add_task("start", total=len(demo.STAGES))
        result = demo.run_demo(
            out,
            defaults=rendering.parse_defines(define or []),
            width=width,
            spp=spp,
            seed=seed,
            variant=variant,
            on_stage=lambda name: progress.update(bar, description=name, completed=demo.STAGES.index(name)),
        )
        progress.update(bar, description="done", completed=len(demo.STAGES))
    for path in result.files:
        print(f"wrote {path}")
    print(f"Look at them with: {demo.look(out)}")
