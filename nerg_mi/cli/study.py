"""`nerg study`: the command line of `nerg_mi.evaluation.study.run`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    scene: Annotated[str, typer.Argument(help="Scene file (.xml), or slab, sphere, sheets, fog or ramp.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder to write into; it is made.")],
    scene_kind: Annotated[str, typer.Option(help="What SCENE is: auto, analytic or file.")] = "auto",
    width: Annotated[int, typer.Option(help="Width of a picture in pixels.")] = 192,
    height: Annotated[int, typer.Option(help="Height of a picture in pixels.")] = 128,
    repeats: Annotated[int, typer.Option(help="Timed renders of each setting; their median counts.")] = 5,
    quick: Annotated[bool, typer.Option("--quick", help="A few settings only, each timed once.")] = False,
    only: Annotated[str, typer.Option(metavar="REGEX", help="Only the default, and settings whose name matches.")] = "",
    define: Annotated[
        list[str] | None,
        typer.Option(
            "-D", "--define", metavar="KEY=VALUE", help="Value for a <default> of the scene file; repeatable."
        ),
    ] = None,
    variant: Annotated[
        str | None,
        typer.Option("-m", "--mode", help="Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]"),
    ] = None,
) -> None:
    """Measure error against run time: render a scene at many settings, compare each with what is true, and plot it.

    Writes study.csv (a row a setting), study.md (the same by factor), scaling.csv, study.json and two plots. A full
    study takes up to half an hour.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from nerg_mi.evaluation.study.run import run_study
    from nerg_mi.rendering import pictures as rendering

    defaults = rendering.parse_defines(define or [])
    with Progress(TextColumn("{task.description:<44}"), BarColumn(), TimeElapsedColumn()) as progress:
        bar = progress.add_task("start", total=1.0)
        result = run_study(
            scene,
            out,
            kind=scene_kind,
            width=width,
            height=height,
            repeats=repeats,
            quick=quick,
            only=only,
            defaults=defaults,
            variant=variant,
            on_step=lambda name, share: progress.update(bar, description=name, completed=share),
        )
        progress.update(bar, description="done", completed=1.0)
    for line in _summary(result.report):
        print(line)
    for path in result.files:
        print(f"wrote {path}")


def _summary(report: dict) -> list[str]:
    """The default beside the paper's marching, in words."""
    lines = []
    for pair in report["against_paper"]:
        paper, default = pair["paper"], pair["default"]
        if not lines:
            lines.append(_line(default))
        lines.append(_line(paper))
        if pair["equal_time"]:
            lines.append(
                f"  no slower: {pair['equal_time']['setting']}, depth error {pair['equal_time']['error_ratio']:.1f} times less"
            )
        if pair["equal_error"]:
            lines.append(
                f"  no worse: {pair['equal_error']['setting']}, {pair['equal_error']['time_ratio']:.1f} times faster"
            )
    return lines


def _line(row: dict) -> str:
    return (
        f"{row['setting']}: {1000 * row['seconds']:.0f} ms, {row['density_evals']:.0f} density evaluations a pixel, "
        f"depth error {row['depth_mae']:.2g} (99 %: {row['depth_p99']:.2g})"
    )
