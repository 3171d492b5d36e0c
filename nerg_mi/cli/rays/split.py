"""``nerg rays split``: training and test rays that share none."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .arguments import RaysFile


def command(
    rays: RaysFile,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Rays file; -train and -test are put before its ending.")
    ],
    zones: Annotated[int, typer.Option(help="By position: zones held out; 0: not by position.")] = 0,
    radius: Annotated[
        float, typer.Option(help="By position: R of probes, metres; rays within 2R of a test position are purged.")
    ] = 0.25,
    zone_radius: Annotated[float, typer.Option(help="By position: radius of a zone, metres.")] = 0.2,
    positions: Annotated[int, typer.Option(help="By position: test positions in the zones.")] = 150,
    min_rays: Annotated[int, typer.Option(help="By position: rays that a test position has within R.")] = 64,
    people: Annotated[float, typer.Option(help="By person: share held out, at random; 0: not by person.")] = 0.0,
    person: Annotated[list[str] | None, typer.Option(help="By person: this one is held out; repeatable.")] = None,
    time: Annotated[float, typer.Option(help="By time: share at the end that is held out; 0: not by time.")] = 0.0,
    gap: Annotated[float, typer.Option(help="By time: seconds purged before the end part.")] = 5.0,
    clock: Annotated[str, typer.Option(help="By time: all (one clock), or person (each their own).")] = "all",
    seed: Annotated[int, typer.Option(help="Seed of zones, positions and people.")] = 0,
) -> None:
    """Split into training and test rays that share none: by position, person, time, or several of them at once.

    Of several, training rays are on the training side of each and test rays on the test side of each; the rest is
    purged.
    """
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.jobs.tracking import SplitOptions, split_rays

    train, test = (output.with_name(f"{output.stem}-{side}{output.suffix}") for side in ("train", "test"))
    options = SplitOptions(
        zones=zones,
        radius=radius,
        zone_radius=zone_radius,
        positions=positions,
        min_rays=min_rays,
        people=people,
        persons=person or (),
        time=time,
        gap=gap,
        clock=clock,
        seed=seed,
        train_output=train,
        test_output=test,
    )
    with TerminalReporter() as reporter:
        split_rays(rays, options, reporter)
    typer.echo(f"wrote {train}")
    typer.echo(f"wrote {test}")
