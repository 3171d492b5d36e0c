"""``nerg rays``: tracking files in, rays out, and what is in them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.errors import NergError

app = typer.Typer(
    no_args_is_help=True,
    help="Import tracking files as rays of attention, look at them, choose among them and split them.",
)

_Rays = Annotated[Path, typer.Argument(help="Rays file (.npz or .parquet).")]
_Output = Annotated[Path, typer.Option("-o", "--output", help="Rays file to write (.npz or .parquet).")]


@app.command("import")
def import_rays(
    files: Annotated[
        list[Path], typer.Argument(help="Tracking files (CSV, CSV.gz, Parquet or skeleton files; for pupil, folders).")
    ],
    output: _Output,
    preset: Annotated[
        str | None,
        typer.Option(
            help="Known recording: skeleton22, vr_supermarket, unity, unity_local, unity_head, varjo, hololens or pupil."
        ),
    ] = None,
    columns: Annotated[
        str | None,
        typer.Option(
            "--map",
            help='Column map: "origin=x,y,z direction=dx,dy,dz t=time person=id confidence=c hit=hx,hy,hz cohort=g"; for heads, in place '
            "of direction: xyzw=..., wxyz=..., ypr=yaw,pitch,roll or matrix=... (12 or 16 columns, instead of origin too).",
        ),
    ] = None,
    units: Annotated[
        str | None, typer.Option(help="Unit of length of a mapped table: m, cm or mm.  [default: m]")
    ] = None,
    up: Annotated[str | None, typer.Option(help="Up axis: x, y, z, -x, -y or -z.  [default: z; pupil: y]")] = None,
    hand: Annotated[
        str | None, typer.Option(help="Handedness of a mapped table: right, or left (Unity).  [default: right]")
    ] = None,
    forward: Annotated[
        str | None,
        typer.Option(
            help="Axis of a head's frame along which it looks.  [default: y up z (left-handed) or -z, else x]"
        ),
    ] = None,
    radians: Annotated[bool, typer.Option("--radians", help="Angles of a mapped table are in radians.")] = False,
    person_from: Annotated[
        str | None, typer.Option(help="Persons of a mapped table: column or filename.  [default: column]")
    ] = None,
    min_confidence: Annotated[
        float | None, typer.Option(help="Drop rows below this confidence.  [default: 0; pupil: 0.6]")
    ] = None,
    tick: Annotated[float | None, typer.Option(help="Seconds in one unit of the file's time.  [default: 1]")] = None,
    keypoints: Annotated[
        str | None, typer.Option(help="skeleton22: left ear, right ear, nose.  [default: 2,13,11]")
    ] = None,
    pitch: Annotated[
        float | None, typer.Option(help="skeleton22: degrees by which rays are turned up.  [default: 0]")
    ] = None,
    marker: Annotated[float | None, typer.Option(help="pupil: edge of a tracking marker in metres.")] = None,
    skip_bad_lines: Annotated[
        bool,
        typer.Option(
            "--skip-bad-lines",
            help="Leave out lines that cannot be read, with an account of them: at most 1 % of a file's.",
        ),
    ] = False,
    pseudonyms: Annotated[
        bool,
        typer.Option(
            "--pseudonyms", help="Replace the names of persons, also in the names of files, by salted hashes."
        ),
    ] = False,
    salt: Annotated[
        Path | None,
        typer.Option(
            help="--pseudonyms: file of 16 random bytes or more, so that several imports agree.  [default: random, not kept]"
        ),
    ] = None,
) -> None:
    """Convert tracking files to rays: right-handed, z up, metres, seconds."""
    from nerg_mi.rays.pseudonyms import pseudonymise, read_salt
    from nerg_mi.rays.readers import vr_supermarket as presets
    from nerg_mi.rays.readers.table import rays_from_table

    _check(output)
    if salt is not None and not pseudonyms:
        raise NergError("--salt belongs to --pseudonyms; add it, or leave out --salt")
    key = None if salt is None else read_salt(salt)
    if (preset is None) == (columns is None):
        raise NergError("say what the files are: either --preset NAME or --map COLUMNS")
    given = {
        "units": units,
        "up": up,
        "hand": hand,
        "forward": forward,
        "radians": radians or None,
        "person_from": person_from,
        "min_confidence": min_confidence,
        "tick": tick,
        "pitch": pitch,
        "marker": marker,
        "keypoints": keypoints,
    }
    given = {name: value for name, value in given.items() if value is not None}
    if "keypoints" in given:
        given["keypoints"] = _three_numbers(given["keypoints"])
    if columns is not None:
        foreign = [name for name in ("keypoints", "pitch", "marker") if name in given]
        if foreign:
            raise NergError(
                f"{_options(foreign)} belongs to a preset; leave it out, or give --preset in place of --map"
            )
        if given.pop("radians", False):
            given["degrees"] = False
        if "hand" in given:
            given["handedness"] = given.pop("hand")
        rays = rays_from_table(files, columns, skip_bad_lines=skip_bad_lines, **given)
    else:
        known = presets.preset(preset)
        unused = [name for name in given if name not in known.options]
        if unused:
            raise NergError(f"preset {preset} knows its own conventions; leave out {_options(unused)}")
        rays = known.read(files, skip_bad_lines=skip_bad_lines, **given)
    if pseudonyms:
        rays = pseudonymise(rays, key)
    rays.save(output)
    _card(rays, output)
    typer.echo(f"wrote {output}")


@app.command("show")
def show_rays(rays: _Rays) -> None:
    """The sanity card: rays, persons, duration, rate, what was dropped, extent, eye height."""
    from nerg_mi.rays.rays import Rays

    _card(Rays.load(rays), rays)


@app.command("filter")
def filter_rays(
    rays: _Rays,
    output: _Output,
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
    from nerg_mi.rays import filters
    from nerg_mi.rays import fixations as fix
    from nerg_mi.rays.rays import Rays

    _check(output)
    if fixations not in (None, "ivt", "idt"):
        raise NergError(f'--fixations is "{fixations}"; it is ivt or idt')
    if one_ray and fixations is None:
        raise NergError("--one-ray is of fixations; add --fixations ivt or --fixations idt")
    data = Rays.load(rays)
    what = {
        "time": None if start is None and end is None else (start, end),
        "persons": person or None,
        "without_persons": without_person or None,
        "cohorts": cohort or None,
        "box": None if box is None else _numbers(box, "--box"),
        "min_confidence": min_confidence,
        "with_hit": with_hit or None,
    }
    what = {name: value for name, value in what.items() if value is not None}
    if not what and fixations is None and thin is None:
        raise NergError(
            "say which rays to keep, for instance with --from, --person, --box, --fixations or --thin (--help lists all)"
        )
    if what:
        data = _step(data, filters.select_mask(data, **what), "filter", what)
    if fixations is not None:
        limit = {"velocity": velocity} if fixations == "ivt" else {"dispersion": dispersion}
        limit.update({} if least is None else {"least": least})
        label = (fix.ivt if fixations == "ivt" else fix.idt)(data, **limit)
        typer.echo(f"{len(set(label.tolist()) - {-1}):,} fixations ({fixations})")
        if one_ray:
            before, (data, _) = len(data), fix.fixation_rays(data, label)
            data = data.noting(step="fixations", by=fixations, one_ray=True, kept=len(data), of=before, **limit)
            typer.echo(f"fixations: one ray each, {len(data):,} of {before:,} rays")
        else:
            data = _step(data, label >= 0, "fixations", {"by": fixations, **limit})
    if thin is not None:
        data = _step(
            data, filters.thin_mask(data, thin, thin_distance), "thin", {"seconds": thin, "distance": thin_distance}
        )
    data.save(output)
    typer.echo(f"wrote {output}")


@app.command("split")
def split_rays(
    rays: _Rays,
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
    from nerg_mi.rays import splits
    from nerg_mi.rays.rays import Rays

    outputs = {side: output.with_name(f"{output.stem}-{side}{output.suffix}") for side in ("train", "test")}
    _check(*outputs.values())
    import numpy as np

    data = Rays.load(rays)
    parts, about = [], {}
    if zones:
        where = splits.split_by_position(
            data, radius, zones=zones, zone_radius=zone_radius, test_probes=positions, min_rays=min_rays, seed=seed
        )
        parts.append(where)
        about["position"] = {
            "radius": radius,
            "zones": zones,
            "zone_radius": zone_radius,
            "test_centres": where.test_centres.tolist(),
        }
    if people or person:
        held = splits.split_by_person(data, test_share=people or 0.5, test_persons=person or None, seed=seed)
        parts.append(held)
        about["person"] = {"test": sorted(data.persons[p] for p in np.unique(data.person[held[1]]))}
    if time:
        parts.append(splits.split_by_time(data, test_share=time, gap=gap, of=clock))
        about["time"] = {"share": time, "gap": gap, "of": clock}
    if not parts:
        raise NergError("say how to split: --zones 3, --people 0.5, --person NAME, --time 0.2, or several of them")
    train, test = splits.both(*parts)
    typer.echo(
        f"{train.sum():,} training rays, {test.sum():,} test rays, {(~(train | test)).sum():,} purged of {len(data):,}"
    )
    for side, mask in (("train", train), ("test", test)):
        data.select(mask).noting(step="split", side=side, seed=seed, kept=int(mask.sum()), of=len(data), by=about).save(
            outputs[side]
        )
        typer.echo(f"wrote {outputs[side]}")


@app.command("plot")
def plot_rays(
    rays: _Rays,
    output: Annotated[Path, typer.Option("-o", "--output", help="Picture to write (.png).")],
    kind: Annotated[
        str, typer.Option(help="density: rays/m² with mean directions; layout: each ray's place, with dimensions.")
    ] = "density",
    cell: Annotated[
        float | None, typer.Option(help="density: edge of a cell, metres.  [default: a fiftieth of the plan]")
    ] = None,
    test: Annotated[Path | None, typer.Option(help="layout: the test rays of a split, drawn beside.")] = None,
) -> None:
    """The floor plan: where people stood and how densely, or the layout."""
    from nerg_mi.files.atomic import check_writable
    from nerg_mi.rays.rays import Rays
    from nerg_mi.view import ray_figures
    from nerg_mi.view.figures import save

    if kind not in ("density", "layout"):
        raise NergError(f'--kind is "{kind}"; it is density or layout')
    check_writable(output, ".png")
    if kind == "density":
        if test is not None:
            raise NergError("--test is drawn in the layout; add --kind layout")
        figure = ray_figures.floor_plan(Rays.load(rays), cell)
    else:
        held = None if test is None else Rays.load(test)
        steps = [] if held is None else held.metadata.get("steps", [])
        where = next(
            (s["by"].get("position", {}) for s in steps if s["step"] == "split" and isinstance(s.get("by"), dict)), {}
        )
        figure = ray_figures.layout_figure(Rays.load(rays), held, where.get("test_centres"), where.get("radius"))
    save(figure, output)
    typer.echo(f"wrote {output}")


def _check(*outputs: Path) -> None:
    """Raise `NergError` where rays cannot be written to one of ``outputs``: before minutes of reading."""
    from nerg_mi.files.atomic import check_writable
    from nerg_mi.rays.io import SUFFIXES

    for path in outputs:
        check_writable(path, *SUFFIXES)


def _step(data, mask, step: str, what: dict):
    """The rays of a mask, in the memory of ``data``, with a line that says how many, and a note of it in their
    metadata."""
    if not mask.any():
        raise NergError(f"{step} leaves none of {len(data):,} rays; widen its conditions")
    typer.echo(f"{step}: {mask.sum():,} of {len(data):,} rays")
    of, kept = len(data), int(mask.sum())
    return data.keep_in_place(mask).noting(step=step, kept=kept, of=of, **what)


def _options(names: list[str]) -> str:
    return ", ".join("--" + name.replace("_", "-") for name in names)


def _numbers(text: str, what: str) -> list[float]:
    try:
        return [float(v) for v in text.split(",")]
    except ValueError:
        raise NergError(f"{what} is numbers with commas between them, got {text!r}") from None


def _three_numbers(text: str) -> tuple[int, ...]:
    try:
        left, right, nose = (int(v) for v in text.split(","))
    except ValueError:
        raise NergError(f"--keypoints is three numbers: left ear, right ear, nose; got {text!r}") from None
    return left, right, nose


def _card(rays, path: Path) -> None:
    import numpy as np
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from nerg_mi.files.bounded import plain
    from nerg_mi.rays.summary import GAP, summarise

    s = summarise(rays)
    # Names come from files: they are neither markup nor control characters of a terminal.
    safe = lambda text: escape(plain(text, 10_000))
    card = Table(show_header=False, box=None, title=safe(path), title_justify="left")
    row = lambda name, text: card.add_row(name, safe(text))
    triple = lambda v: " ".join(f"{x:.2f}" for x in v)
    row("rays", f"{s.rays:,} of {s.rows_read:,} rows")
    there = [rays.persons[p] for p in np.flatnonzero(np.bincount(rays.person))]
    row("persons", f"{s.persons}: {', '.join(there[:8])}{', ...' if len(there) > 8 else ''}")
    if s.cohorts:
        row("cohorts", ", ".join(f"{name} {count:,}" for name, count in s.cohorts.items()))
    if not np.isfinite(s.rate):
        recorded = "unknown: no person has rays at two times"
    elif s.duration == 0:
        recorded = (
            f"none: each ray of a person comes more than {GAP:g} s after the one before ({s.rate:.4g} rays a second)"
        )
    else:
        recorded = f"{s.duration:,.1f} s at {s.rate:.4g} rays a second"
    row("recorded time", recorded)
    for reason, count in s.dropped.items():
        row("dropped", f"{count:,} ({100 * count / max(s.rows_read, 1):.1f} %): {reason}; {_rows(rays, reason)}")
    for step in rays.metadata.get("steps", []):
        name = f"{step['step']} {step.get('side', '')}".strip()
        row("then", f"{name}: {step['kept']:,} of {step['of']:,} rays kept")
    source = rays.metadata.get("source_frame")
    if source:
        row("from", f"{source['up']} up, {source['handedness']}-handed, {source['units']}")
    row("origins", f"{triple(s.box_low)} to {triple(s.box_high)} m (right-handed, z up)")
    row("eye height", f"{s.eye_height[1]:.2f} m (5 to 95 %: {s.eye_height[0]:.2f} to {s.eye_height[2]:.2f})")
    row("speed", f"95 % below {s.speed_p95:.2f} m/s" if np.isfinite(s.speed_p95) else "unknown: see recorded time")
    if s.hit_share:
        row("hit points", f"{100 * s.hit_share:.1f} % of the rays, median distance {s.hit_distance:.2f} m")
    if s.duplicates:
        row("duplicates", f"{s.duplicates:,} rays share person and time with another")
    for warning in s.warnings:
        row("[bold]implausible[/bold]", warning)
    Console().print(card)


def _rows(rays, reason: str, most: int = 3) -> str:
    """The first lines concerned; all of them stand in the file's metadata."""
    lost = [d for d in rays.metadata.get("dropped", []) if d["reason"] == reason and d.get("rows")]
    if not lost:
        return "lines not named"
    runs = lost[0]["rows"]
    text = ", ".join(f"{a}" if a == b else f"{a}-{b}" for a, b in runs[:most])
    more = f" and of {len(lost) - 1} more" if len(lost) > 1 else ""
    return f"lines {text}{', ...' if len(runs) > most else ''} of {lost[0].get('file', '')}{more}"
