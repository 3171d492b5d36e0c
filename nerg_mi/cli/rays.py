"""``nerg rays``: tracking files in, rays out, and what is in them."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated, List, Optional

import typer

app = typer.Typer(no_args_is_help=True, help="Import tracking files as rays of attention, and inspect them.")


@app.command("import")
def import_rays(
    files: Annotated[List[Path], typer.Argument(help="Tracking files (CSV, CSV.gz, Parquet or skeleton files).")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Rays file to write (.npz or .parquet).")],
    preset: Annotated[Optional[str], typer.Option(help="Known recording: skeleton22, vr_supermarket.")] = None,
    columns: Annotated[
        Optional[str],
        typer.Option("--map", help='Column map: "origin=x,y,z direction=dx,dy,dz t=time person=id confidence=c hit=hx,hy,hz".'),
    ] = None,
    units: Annotated[str, typer.Option(help="Unit of length of a mapped table: m, cm or mm.")] = "m",
    up: Annotated[str, typer.Option(help="Up axis of a mapped table: y or z.")] = "z",
    hand: Annotated[str, typer.Option(help="Handedness of a mapped table: right, or left (Unity).")] = "right",
    person_from: Annotated[str, typer.Option(help="Persons of a mapped table: column or filename.")] = "column",
    min_confidence: Annotated[float, typer.Option(help="Drop rows of a mapped table below this confidence.")] = 0.0,
    tick: Annotated[float, typer.Option(help="Seconds in one unit of the file's time.")] = 1.0,
) -> None:
    """Convert tracking files to rays: right-handed, z up, metres, seconds."""
    from ..attention import presets
    from ..attention.tables import rays_from_table

    if (preset is None) == (columns is None):
        raise ValueError("say what the files are: either --preset NAME or --map COLUMNS")
    if columns is not None:
        rays = rays_from_table(
            files, columns, up=up, handedness=hand, units=units,
            person_from=person_from, min_confidence=min_confidence, tick=tick,
        )  # fmt: skip
    else:
        known = presets.preset(preset)
        declared = {"units": units != "m", "up": up != "z", "hand": hand != "right", "person-from": person_from != "column",
                    "min-confidence": min_confidence != 0.0, "tick": tick != 1.0 and "tick" not in known.options}  # fmt: skip
        unused = [f"--{option}" for option, given in declared.items() if given]
        if unused:
            raise ValueError(f"preset {preset} knows its own conventions; leave out {', '.join(unused)}")
        rays = known.read(files, **({"tick": tick} if "tick" in known.options else {}))
    rays.save(output)
    _card(rays, output)
    typer.echo(f"wrote {output}")


@app.command("show")
def show_rays(rays: Annotated[Path, typer.Argument(help="Rays file (.npz or .parquet).")]) -> None:
    """The sanity card: rays, persons, duration, rate, what was dropped, extent, eye height."""
    from ..attention.rays import Rays

    _card(Rays.load(rays), rays)


def _card(rays, path: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    from ..attention.summary import summarise

    s = summarise(rays)
    card = Table(show_header=False, box=None, title=str(path), title_justify="left")
    triple = lambda v: " ".join(f"{x:.2f}" for x in v)
    card.add_row("rays", f"{s.rays:,} of {s.rows_read:,} rows")
    card.add_row("persons", f"{s.persons}: {', '.join(rays.persons[:8])}{', ...' if len(rays.persons) > 8 else ''}")
    card.add_row("recorded time", f"{s.duration:,.1f} s at {s.rate:.4g} rays a second")
    for reason, count in s.dropped.items():
        card.add_row("dropped", f"{count:,} ({100 * count / max(s.rows_read, 1):.1f} %): {reason}; {_rows(rays, reason)}")
    card.add_row("origins", f"{triple(s.box_low)} to {triple(s.box_high)} m (right-handed, z up)")
    card.add_row("eye height", f"{s.eye_height[1]:.2f} m (5 to 95 %: {s.eye_height[0]:.2f} to {s.eye_height[2]:.2f})")
    card.add_row("speed", f"95 % below {s.speed_p95:.2f} m/s")
    if s.hit_share:
        card.add_row("hit points", f"{100 * s.hit_share:.1f} % of the rays, median distance {s.hit_distance:.2f} m")
    if s.duplicates:
        card.add_row("duplicates", f"{s.duplicates:,} rays share person and time with another")
    for warning in s.warnings:
        card.add_row("[bold]implausible[/bold]", warning)
    Console().print(card)


def _rows(rays, reason: str, most: int = 3) -> str:
    """The first lines concerned; all of them stand in the file's metadata."""
    runs = [(d["file"], a, b) for d in rays.metadata.get("dropped", []) if d["reason"] == reason for a, b in d["rows"]]
    text = ", ".join(f"{a}" if a == b else f"{a}-{b}" for _, a, b in runs[:most])
    return f"lines {text}{', ...' if len(runs) > most else ''} of {runs[0][0]}"
