"""`nerg render`: the command line of `nerg_mi.rendering.pictures`."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer


def command(
    scene: Annotated[Path, typer.Argument(help="Mitsuba scene file (.xml).")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Picture to write: .exr (all channels) or .png (colour).")
    ],
    define: Annotated[
        list[str] | None,
        typer.Option(
            "-D", "--define", metavar="KEY=VALUE", help="Value for $KEY or a <default> of the scene; repeatable."
        ),
    ] = None,
    sensor: Annotated[int, typer.Option("-s", "--sensor", help="Index of the sensor, counted from 0.")] = 0,
    variant: Annotated[
        str | None,
        typer.Option("-m", "--mode", help="Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]"),
    ] = None,
    spp: Annotated[int, typer.Option("--spp", min=0, help="Samples a pixel; 0: as the scene says.")] = 0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the random numbers.")] = 0,
    threads: Annotated[int, typer.Option("-t", "--threads", min=0, help="Worker threads; 0: one a core.")] = 0,
    memory: Annotated[
        float, typer.Option("--memory", help="GB that rendering may take; larger pictures are made in bands.")
    ] = 1.0,
) -> None:
    """Render a scene file to an EXR or PNG file, with the integrator that the scene names.

    An EXR file holds all channels in float32, those of the AOVs among them; a PNG file holds the colour, tonemapped to
    sRGB.
    """
    from nerg_mi.rendering import pictures as rendering

    defaults = rendering.parse_defines(define or [])
    with _bar() as (bar, task):
        report = rendering.render_file(
            scene,
            output,
            defaults=defaults,
            sensor=sensor,
            variant=variant,
            spp=spp,
            seed=seed,
            threads=threads,
            memory=memory,
            on_progress=lambda done, total: bar.update(task, completed=done, total=total),
        )
    print(report)


@contextmanager
def _bar():
    """A progress bar in samples on the terminal, with rate and time left; elsewhere none."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, TaskProgressColumn, TimeRemainingColumn
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task):
            speed = task.finished_speed or task.speed
            return Text("" if speed is None else f"{speed:,.0f} samples/s")

    console = Console(stderr=True)
    columns = BarColumn(), TaskProgressColumn(), Rate(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        yield bar, bar.add_task("render", total=None)
