"""``nerg train gaze``: a gaze field from rays of attention or salience images, in a trained place or one of hit
points."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.errors import NergError, chosen


def train_gaze(
    output: Annotated[Path, typer.Option("-o", "--output", help="Checkpoint to write (.safetensors).")],
    rays: Annotated[
        Path | None,
        typer.Argument(help="Rays file (.npz or .parquet), as nerg rays import writes it. None: --views alone."),
    ] = None,
    views: Annotated[Path | None, typer.Option(help="Posed photos (folder or transforms file) with salience.")] = None,
    salience: Annotated[
        str | None,
        typer.Option(help="Folder of them, called as the photos are (.png, .exr, .npy), or spectral-residual."),
    ] = None,
    salience_per: Annotated[str, typer.Option(help="What they count gaze per: pixel or steradian.")] = "pixel",
    align_views: Annotated[
        Path | None, typer.Option(help="JSON file with the 4x4 similarity from the photos' frame to the place's.")
    ] = None,
    allow_outside: Annotated[
        bool,
        typer.Option(
            "--allow-outside",
            help="Read files outside of --views' folder and that of --salience too, where they name them.",
        ),
    ] = False,
    field: Annotated[Path | None, typer.Option(help="Radiance field in which people looked around.")] = None,
    scene: Annotated[Path | None, typer.Option(help="Or: a Mitsuba scene, whose shapes they looked at.")] = None,
    geometry: Annotated[
        str | None,
        typer.Option(help='Or: "hits" makes a place from the rays\' own hit points, "none" does without any.'),
    ] = None,
    recipe: Annotated[
        str, typer.Option(help="default (generalises best), small, or paper. Sets what is not set below.")
    ] = "default",
    voxel: Annotated[
        float | None,
        typer.Option(
            help="Edge of the voxels of --geometry hits in metres.  [default: 0.08, more in very large places]"
        ),
    ] = None,
    align: Annotated[
        Path | None,
        typer.Option(help="JSON file with the 4x4 similarity from the rays' frame to the place's. Default: none."),
    ] = None,
    radius: Annotated[float | None, typer.Option(help="Radius R of a probe in metres.")] = None,
    probes: Annotated[int | None, typer.Option(help="Number of probes at most.")] = None,
    placement: Annotated[str | None, typer.Option(help="Of probes: data, grid, random or blue.")] = None,
    cap: Annotated[int | None, typer.Option(help="Rays in a probe at most, the nearest.")] = None,
    min_rays: Annotated[int | None, typer.Option(help="Rays in a probe at least.")] = None,
    kappa_rule: Annotated[
        str | None, typer.Option(help="Concentration of a ray's kernel: fixed, silverman or loo.")
    ] = None,
    kappa: Annotated[float | None, typer.Option(help="That of the rule fixed.")] = None,
    weights: Annotated[
        str | None,
        typer.Option(
            help="Of a probe's rays: equal, distance (1 - d/R), or person (all people of a probe count alike)."
        ),
    ] = None,
    directions: Annotated[int | None, typer.Option(help="Directions of a probe.")] = None,
    fresh: Annotated[
        bool, typer.Option("--fresh-directions", help="Draw the directions anew for every epoch, not once a probe.")
    ] = False,
    gaze: Annotated[str, typer.Option("--variant", help="emit, capture or emit_capture.")] = "emit_capture",
    activation: Annotated[
        str | None, typer.Option(help="Of the emit head of small and paper: softplus, exp or linear.")
    ] = None,
    size: Annotated[str | None, typer.Option(help="Of the field of small and paper: small or paper.")] = None,
    normalized: Annotated[
        bool, typer.Option("--normalized", help="Divide the field of small and paper by its integral over the sphere.")
    ] = False,
    semantic: Annotated[
        str,
        typer.Option(help="Give emit the features of --field: accumulated along the ray, or snapshot at the surface."),
    ] = "",
    semantic_own: Annotated[
        bool, typer.Option("--semantic-own", help="Besides the gaze field's own, not in their place.")
    ] = False,
    begin: Annotated[
        str, typer.Option(help="Weights of the trunk to begin with: random, or those of the radiance field (field).")
    ] = "random",
    freeze: Annotated[
        bool, typer.Option("--freeze", help="Do not train the weights that --begin field gives.")
    ] = False,
    loss: Annotated[
        str | None, typer.Option(help="Of small and paper. paper: KLD + (1 - CC) + MAE; code: MAE + 0.1 (1 - CC).")
    ] = None,
    integral: Annotated[float | None, typer.Option(help="Weight of the error of the integral over the sphere.")] = None,
    minutes: Annotated[float | None, typer.Option(help="Train for this long, both fits together.")] = None,
    steps: Annotated[int | None, typer.Option(help="Or: train for so many steps. Default: the recipe's.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Learning rate at the start.")] = None,
    weight_decay: Annotated[float | None, typer.Option(help="Decoupled weight decay.")] = None,
    zones: Annotated[
        int | None,
        typer.Option(
            help="Zones of positions watched as validation, whose best weights count; 0: none. Default: the recipe's."
        ),
    ] = None,
    refit: Annotated[bool, typer.Option(help="Train again on all rays once the best number of steps is known.")] = True,
    test_zones: Annotated[
        int, typer.Option(help="Zones of test positions that are left out of everything; 0: none.")
    ] = 0,
    test_positions: Annotated[int, typer.Option(help="Test positions in them.")] = 64,
    test_people: Annotated[
        float, typer.Option(help="Share of the people who are left out of everything besides.")
    ] = 0.0,
    ensemble: Annotated[
        int,
        typer.Option(
            help="Train so many fields on resamples of the people; the mean is the gaze, their spread its uncertainty. 0: one field."
        ),
    ] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the interrupted run of this output.")] = False,
    save_every: Annotated[
        float, typer.Option(help="Seconds between two states for --resume; 0: only one, when it ends early.")
    ] = 60.0,
    seed: Annotated[int, typer.Option(help="Seed of probes, directions, weights, batches and splits.")] = 0,
    threads: Annotated[int | None, typer.Option(help="CPU threads. Default: all.")] = None,
    half: Annotated[bool, typer.Option("--half", help="Store the weights in fp16.")] = False,
    mode: Annotated[str, typer.Option("-m", "--mode", help="Mitsuba variant.")] = "llvm_ad_rgb",
) -> None:
    """Train a gaze field on rays of attention, and report its scores at positions that were held out."""
    import drjit as dr
    import numpy as np

    from nerg_mi.field.backend import namespace
    from nerg_mi.files.atomic import check_writable
    from nerg_mi.files.checksum import file_sha256
    from nerg_mi.formats.fields import save_gaze
    from nerg_mi.rays.rays import Rays
    from nerg_mi.rendering.pictures import activate
    from nerg_mi.training.gaze.ensemble import train_ensemble
    from nerg_mi.training.gaze.recipes import gaze_recipe
    from nerg_mi.training.gaze.run import hold_out, train_gaze
    from nerg_mi.training.gaze.salience import far_views
    from nerg_mi.training.gaze.settings import GazeSettings, ProbeSettings

    if sum(v is not None for v in (field, scene, geometry)) != 1:
        raise NergError(
            "say where people looked around: one of --field FILE, --scene FILE, --geometry hits, --geometry none"
        )
    if geometry not in (None, "hits", "none"):
        raise NergError(f'--geometry must be "hits" or "none", got "{geometry}"')
    if rays is None and views is None:
        raise NergError("say what to learn from: a rays file, or --views with --salience, or both")
    if rays is None and (test_zones or geometry == "hits" or align or semantic):
        raise NergError(
            "--test-zones, --geometry hits, --align and --semantic belong to rays; give a rays file besides --views "
            "(or hold views out by leaving their images out of the folder, and align them with --align-views)"
        )
    if geometry is not None and align is not None:
        raise NergError("--align belongs to --field and --scene; a place made from rays is in the rays' own frame")
    if test_people and not test_zones:
        raise NergError("--test-people leaves people out at test positions: say where, with --test-zones")
    state = output.with_suffix(".run")
    check_writable(output, ".safetensors")
    check_writable(state)
    if geometry == "hits":
        check_writable(output.with_suffix(".vol"))
    activate(mode)
    if threads is not None:
        dr.set_thread_count(threads)
    _check_start(begin, freeze, semantic, field)
    with chosen("--variant and --activation"):
        plan = gaze_recipe(recipe, gaze, activation, size)
    if recipe == "default" and (semantic or begin == "field" or loss or normalized or integral is not None):
        raise NergError(
            "--semantic, --begin field, --loss, --integral and --normalized belong to fields of the recipes small and paper; add --recipe small"
        )
    settings = GazeSettings(
        **plan.settings
        | (plan.views_alone if rays is None else {})
        | _given(
            minutes=minutes,
            steps=steps,
            seed=seed,
            loss=loss,
            zones=zones,
            refit=refit,
            frozen=freeze,
            learning_rate=learning_rate,
            weight_decay=weight_decay,
            integral=integral,
        )
        | ({"steps": None} if minutes is not None and steps is None else {})
    )
    how = ProbeSettings(
        **plan.probes
        | _given(
            radius=radius,
            count=probes,
            placement=placement,
            cap=cap,
            min_rays=min_rays,
            kappa_rule=kappa_rule,
            kappa=kappa,
            weights=weights,
            directions=directions,
            fresh=fresh or None,
        )
    )
    if resume and not ensemble and not state.is_file():
        raise NergError(f'there is nothing to resume: "{state}" does not exist; leave out --resume to start')
    data, ns, about = None, namespace(mode), {"recipe": recipe}
    if rays is not None:
        data = Rays.load(rays)
        about |= {"rays_file": {"file": rays.name, "sha256": file_sha256(rays), "persons": len(data.persons)}}
    seen, found = _views(views, salience, salience_per, align_views, field, allow_outside)
    about |= found
    if test_zones:
        data, about["test"] = hold_out(
            data, how.radius, test_zones, test_positions, seed, max(64, how.min_rays), test_people
        )
        test = about["test"]
        typer.echo(
            f"{len(test['centres'])} test positions held out, {test['rays_to_train']:,} of {test['rays']:,} rays left"
        )
        seen = far_views(seen, np.array(test["centres"]), 2 * how.radius, _similarity(align))
    place = place_for(field, scene, geometry, data, seen, output, voxel, ns)
    about |= place.about
    if recipe == "default":
        config, initial = place.told(plan.config), None
    else:
        with chosen("--semantic, --variant and --begin"):
            config, initial = _begun(
                begin,
                place,
                plan.config,
                {
                    # Views alone do not say how much is looked altogether.
                    "semantic": semantic,
                    "semantic_own": semantic_own,
                    "normalized": normalized or rays is None,
                },
            )
        about |= {"begins_as": field.name} if initial else {}
    train = partial(train_ensemble, ensemble) if ensemble else train_gaze
    with _Bar() as bar:
        _, provenance = train(
            data,
            place.medium,
            place.box,
            config,
            settings,
            how,
            ns,
            _similarity(align),
            bar.update,
            initial,
            about=dict(about),
            state=state,
            resume=resume,
            save_every=save_every or float("inf"),
            views=seen,
            write=lambda trained, provenance: save_gaze(trained, output, {**about, **provenance}, half),
        )
    _report(provenance)
    typer.echo(f"wrote {output} ({output.stat().st_size / 1e6:.2f} MB)")
    if provenance["interrupted"]:
        raise KeyboardInterrupt(f"interrupted; go on with --resume (state in {state})")


def _given(**options) -> dict:
    return {k: v for k, v in options.items() if v is not None}


def _check_start(begin: str, freeze: bool, semantic: str, field: Path | None) -> None:
    if begin not in ("random", "field"):
        raise NergError(f'--begin must be "random" or "field", got "{begin}"')
    if freeze and begin != "field":
        raise NergError("--freeze keeps the weights that --begin field gives; add it, or leave --freeze out")
    if field is None and (semantic or begin == "field"):
        raise NergError(f"{'--semantic' if semantic else '--begin field'} needs a radiance field: give it with --field")


def _begun(begin: str, place, config, more: dict) -> tuple:
    """Configuration, and the arrays to begin with (None: random ones), of a field of the recipes small and paper."""
    config = place.told(config)
    if begin == "field":
        from nerg_mi.training.gaze.semantics import config_like, trunk_of

        config = config_like(place.medium.field.config, config.variant, config.activation, **more)
        return config, trunk_of(place.medium.field, config)
    if more["semantic"]:
        more = {**more, "geometry": place.medium.feature_count}
    return replace(config, **more), None


def _views(
    views: Path | None, salience: str | None, per: str, align: Path | None, field: Path | None, allow_outside: bool
) -> tuple[list, dict]:
    """Salience images, and what provenance says of them."""
    if views is None or salience is None:
        if views or salience or align:
            raise NergError(
                "salience needs both: --views, the posed photos, and --salience, the images' folder or spectral-residual"
            )
        return [], {}
    from nerg_mi.capture.salience.views import open_salience
    from nerg_mi.formats.checkpoint import read_checkpoint

    similarity = _similarity(align)
    trained = None if field is None else read_checkpoint(field, "radiance")[1].get("provenance")
    found = open_salience(
        views, salience, per, None if similarity is None else similarity.matrix, trained, allow_outside
    )
    for said in found.unused:
        typer.echo(said)
    typer.echo(
        f"{len(found.views)} views with salience"
        + (f"; without: {', '.join(found.missing)}" if found.missing else "")
        + (f"; images of no frame: {', '.join(found.stray)}" if found.stray else "")
    )
    return found.views, {
        "salience": found.about,
        **({} if similarity is None else {"align_views": similarity.matrix.tolist()}),
    }


def place_for(field, scene, geometry, rays, views, output: Path, voxel: float | None, ns):
    import numpy as np

    from nerg_mi.training.geometry import places

    if field is not None:
        return places.place_of_field(field, ns)
    if scene is not None:
        return places.place_of_scene(scene)
    if geometry == "none":
        origins = [v.camera.center[None] for v in views] + ([] if rays is None else [rays.origin])
        return places.place_of_nothing(np.concatenate(origins))
    path = output.with_suffix(".vol")
    place = places.place_of_hits(rays, path, voxel)
    made = place.about["geometry_file"]
    typer.echo(
        f"wrote {path}: {' x '.join(map(str, made['shape']))} voxels of {made['voxel']:.3g} m, {100 * made['solid']:.1f} % solid"
    )
    if made["beyond"]:
        typer.echo(
            f"{100 * made['beyond']:.1f} % of the hit points lie beyond this box and stand on its shell, in their true directions "
            "but too near"
        )
    return place


def _similarity(path: Path | None):
    from nerg_mi.maths.similarity import Similarity

    if path is None:
        return None
    from nerg_mi.files.bounded import plain, read_json

    matrix = read_json(path, "similarity of --align")
    try:
        return Similarity([[float(x) for x in row] for row in matrix])
    except (TypeError, ValueError, IndexError, OverflowError) as e:
        raise NergError(
            f'--align needs a JSON file with the 4 rows of a similarity from rays to field; "{path}": {plain(e)}'
        ) from e


def _report(p: dict) -> None:
    views = p["salience_views"]
    counts = f"{p['probes_made'] - views} probes" + (f" and {views} views" if views else "")
    typer.echo(
        f"{counts}; {100 * p['escaped_directions']:.2f} % of the directions meet no surface, "
        f"and {100 * p['escaped_gaze']:.2f} % of the gaze"
    )
    if "validation" in p:
        v = p["validation"]
        typer.echo(
            f"held-out positions: KLD {v['kld']:.3f}, CC {v['cc']:.3f}, MAE {v['mae']:.4f} /sr, "
            f"integral {v['integral']:.3f}, best after {v['best_step']} steps"
        )
    typer.echo(
        f"{p['steps']} steps; {p['seconds']:.0f} s in all, of it {p['seconds_preparing']:.0f} s for the probes"
        f"{'; interrupted' if p['interrupted'] else ''}"
    )


class _Bar:
    """Progress of a training, with the last validation."""

    def __enter__(self):
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        self._progress = Progress(
            TextColumn("{task.fields[stage]:<6}"),
            BarColumn(),
            TextColumn("{task.percentage:3.0f} %"),
            TimeElapsedColumn(),
            TextColumn("{task.description}"),
        )
        self._task = self._progress.add_task("", total=1.0, stage="start")
        self._progress.start()
        return self

    def update(self, state) -> None:
        scores = "" if state.scores is None else f", held out KLD {state.scores.kld:.3f}, CC {state.scores.cc:.3f}"
        self._progress.update(
            self._task,
            completed=state.done,
            stage=state.stage,
            description=f"step {state.steps}{scores}" if state.steps else "",
        )

    def __exit__(self, *error):
        self._progress.stop()
