"""``nerg rays filter``: some of the rays."""

from __future__ import annotations

from typing import Annotated

import typer

from .arguments import Output, RaysFile, parse_numbers


def command(
    rays: RaysFile,
    output: Output,
    start: Annotated[float | None, typer.Option("--from", help="Rays from this time on, seconds.")] = None,
    end: Annotated[float | None, typer.Option("--to", help="Rays before this time, seconds.")] = None,
    person: Annotated[list[str] | None, typer.Option(help="Only this person; repeatable.")] = None,
    without_person: Annotated[list[str] | None, typer.Option(help="Not this person; repeatable.")] = None,
    cohort: Annotated[list[str] | None, typer.Option(help="Only this cohort; repeatable.")] = None,
    box: Annotated[str | None, typer.Option(help="Origins in this box: x0,x1,y0,y1,z0,z1, metres.")] = None,
    min_confidence: Annotated[float | None, typer.Option(help="Only rays of at least this confidence.")] = None,
    with_hit: Annotated[bool, typer.Option("--with-hit", help="Only rays whose hit point is known.")] = False,
    fixations: Annotated[
        str | None, typer.Option(help="Only rays of fixations: ivt (by velocity) or idt (by dispersion).")
    ] = None,
    velocity: Annotated[float, typer.Option(help="ivt: degrees a second that end a fixation.")] = 100.0,
    dispersion: Annotated[float, typer.Option(help="idt: degrees within which a fixation stays.")] = 3.0,
    least: Annotated[
        float | None, typer.Option(help="Shortest fixation, seconds.  [default: ivt 0.06, idt 0.1]")
    ] = None,
    one_ray: Annotated[bool, typer.Option("--one-ray", help="One ray a fixation, its mean.")] = False,
    thin: Annotated[float | None, typer.Option(help="A stop counts as at most this many seconds of rays.")] = None,
    thin_distance: Annotated[float, typer.Option(help="--thin: a stop is a stay within this many metres.")] = 0.1,
) -> None:
    """Keep some rays: conditions first, then fixations, then thinning of those who stand still."""
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.jobs.tracking import FilterOptions, filter_rays

    options = FilterOptions(
        start=start,
        end=end,
        persons=person or (),
        without_persons=without_person or (),
        cohorts=cohort or (),
        box=None if box is None else parse_numbers(box, "--box"),
        min_confidence=min_confidence,
        with_hit=with_hit,
        fixations=fixations,
        velocity=velocity,
        dispersion=dispersion,
        least=least,
        one_ray=one_ray,
        thin=thin,
        thin_distance=thin_distance,
        output=output,
    )
    with TerminalReporter() as reporter:
        filter_rays(rays, options, reporter)
    typer.echo(f"wrote {output}")
