"""``nerg ablate``: which part of a gaze field does what."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.errors import NergError


def command(
    rays: Annotated[Path, typer.Argument(help="Rays file (.npz or .parquet), as nerg rays import writes it.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder for checkpoints, table and plot.")],
    field: Annotated[Path | None, typer.Option(help="Radiance field in which people looked around.")] = None,
    scene: Annotated[Path | None, typer.Option(help="Or: a Mitsuba scene, whose shapes they looked at.")] = None,
    geometry: Annotated[
        str | None,
        typer.Option(help='Or: "hits" makes a place from the rays\' own hit points, "none" does without any.'),
    ] = None,
    recipes: Annotated[str, typer.Option(help="Recipes to ablate, separated by commas.")] = "default,paper",
    variant: Annotated[
        list[str] | None,
        typer.Option(help='Only this one, such as emit_capture or "semantic snapshot"; may be given several times.'),
    ] = None,
    seeds: Annotated[int, typer.Option(help="Seeds of the default recipe; the others have one.")] = 3,
    steps: Annotated[
        int | None, typer.Option(help="Steps of every recipe but the default one. Default: the recipe's.")
    ] = None,
    default_steps: Annotated[int | None, typer.Option(help="Steps of the default recipe. Default: its own.")] = None,
    probes: Annotated[int | None, typer.Option(help="Probes of a training at most. Default: the recipe's.")] = None,
    zones: Annotated[int, typer.Option(help="Zones of test positions.")] = 3,
    positions: Annotated[int, typer.Option(help="Test positions.")] = 60,
    people: Annotated[float, typer.Option(help="Share of the people who are held out besides.")] = 0.0,
    radius: Annotated[float, typer.Option(help="Radius of the test's probes in metres.")] = 0.25,
    kappa: Annotated[float, typer.Option(help="Concentration of the truth's kernel.")] = 20.0,
    min_rays: Annotated[int, typer.Option(help="Rays at a test position at least.")] = 64,
    law: Annotated[
        str | None,
        typer.Option(
            help='Truth in closed form, where it is known: "MODULE:CLASS", whose instances have density(positions, directions) in 1/sr.'
        ),
    ] = None,
    refit: Annotated[
        bool,
        typer.Option(
            help="Train every recipe but the default one, which always does, again on all rays for as many steps as were best on some."
        ),
    ] = True,
    cameras: Annotated[int, typer.Option(help="Cameras that a frame is timed over (the paper: 32); 0: none.")] = 4,
    size: Annotated[str, typer.Option(help="Of a frame (the paper: 1280x720).")] = "320x180",
    threads: Annotated[int | None, typer.Option(help="CPU threads. Default: all.")] = None,
    mode: Annotated[str, typer.Option("-m", "--mode", help="Mitsuba variant.")] = "llvm_ad_rgb",
) -> None:
    """Train every variant of a gaze field alike; losses on training and held-out positions, and the time of a frame."""
    import drjit as dr
    import numpy as np

    from nerg_mi.evaluation.ablation import ablate, all_variants, frame_timer, write_ablation
    from nerg_mi.evaluation.gaze.evaluation import held_out_rays
    from nerg_mi.field.backend import namespace
    from nerg_mi.files.atomic import check_folder
    from nerg_mi.rays.rays import Rays
    from nerg_mi.rendering.pictures import activate
    from nerg_mi.training.gaze.run import hold_out

    from .train_gaze import place_for

    if sum(v is not None for v in (field, scene, geometry)) != 1:
        raise NergError(
            "say where people looked around: one of --field FILE, --scene FILE, --geometry hits, --geometry none"
        )
    if geometry not in (None, "hits", "none"):
        raise NergError(f'--geometry must be "hits" or "none", got "{geometry}"')
    try:
        width, height = (int(x) for x in size.lower().split("x"))
    except ValueError as e:
        raise NergError(f'--size needs WIDTHxHEIGHT, got "{size}"') from e
    check_folder(output)
    activate(mode)
    if threads is not None:
        dr.set_thread_count(threads)
    ns, data = namespace(mode), Rays.load(rays)
    _, account = hold_out(data, radius, zones, positions, 0, min_rays, people)
    train, scored, centres = held_out_rays(data, account, "both" if people else "pos")
    place = place_for(field, scene, geometry, train, [], output / "place", None, ns)
    names = tuple(recipes.split(","))
    variants = _chosen(all_variants(place.kind == "field", names), variant)
    render = (
        frame_timer(place, np.asarray(centres), (field or output / "x").parent, cameras, width, height)
        if cameras
        else None
    )
    truth = _known_law(law).density if law else None
    chosen = {n: steps for n in names if n != "default"} | {"default": default_steps}
    rows = ablate(
        scored,
        train,
        centres,
        place,
        variants,
        output,
        ns,
        seeds,
        chosen,
        radius,
        kappa,
        min_rays,
        render,
        typer.echo,
        truth=truth,
        probes=probes,
        refit=refit,
    )
    without = f", {len(account['people'])} people held out" if people else ""
    source = f"that of {law}" if law else f"with kappa {kappa:g}"
    notes = (
        f"{len(centres)} held-out positions in {zones} zones{without}; "
        f"{len(train):,} of {len(data):,} rays trained on. Losses: KLD + (1 - CC) + MAE over 2,048 directions, truth {source}; "
        f"relative to emit_capture of the same recipe; ± is the standard deviation over seeds."
        + f" A frame: {width} x {height}, mean of {cameras} cameras."
        * bool(render)
    )
    for path in write_ablation(output, rows, notes):
        typer.echo(f"wrote {path}")


def _chosen(variants: list, names: list[str] | None) -> list:
    """Those of ``variants`` that are called one of ``names``; all without any."""
    known = list(dict.fromkeys(v.name for v in variants))
    if unknown := set(names or ()) - set(known):
        raise NergError(f'--variant must be one of {", ".join(known)} here, got "{sorted(unknown)[0]}"')
    return [v for v in variants if not names or v.name in names]


def _known_law(name: str):
    """An instance of the class that ``MODULE:CLASS`` names."""
    import importlib

    module, _, kind = name.partition(":")
    try:
        return getattr(importlib.import_module(module), kind)()
    except (ImportError, AttributeError, ValueError) as e:
        raise NergError(
            f'--law needs MODULE:CLASS that can be imported, such as nerg_mi.scenes.store.attention_law:AttentionLaw, got "{name}"'
        ) from e
