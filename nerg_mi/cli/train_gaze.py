"""``nerg train gaze``: a gaze field from rays of attention, in a trained place or in one made from hit points."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Optional

import typer


def train_gaze(
    rays: Annotated[Path, typer.Argument(help="Rays file (.npz or .parquet), as nerg rays import writes it.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Checkpoint to write (.safetensors).")],
    field: Annotated[Optional[Path], typer.Option(help="Radiance field in which people looked around.")] = None,
    geometry: Annotated[
        Optional[str], typer.Option(help='Without photos: "hits" makes a place from the rays\' own hit points.')
    ] = None,
    voxel: Annotated[float, typer.Option(help="Edge of its voxels in metres.")] = 0.08,
    align: Annotated[
        Optional[Path], typer.Option(help="JSON file with the 4x4 similarity from the rays' frame to the field's. Default: none.")
    ] = None,
    radius: Annotated[float, typer.Option(help="Radius R of a probe in metres.")] = 0.25,
    probes: Annotated[int, typer.Option(help="Number of probes, at random ray origins.")] = 2048,
    cap: Annotated[int, typer.Option(help="Rays in a probe at most, the nearest.")] = 1024,
    min_rays: Annotated[int, typer.Option(help="Rays in a probe at least.")] = 64,
    kappa_rule: Annotated[str, typer.Option(help="Concentration of a ray's kernel: fixed, silverman or loo.")] = "fixed",
    kappa: Annotated[float, typer.Option(help="That of the rule fixed.")] = 50.0,
    directions: Annotated[int, typer.Option(help="Directions of a probe.")] = 1024,
    gaze: Annotated[str, typer.Option("--variant", help="emit, capture or emit_capture.")] = "emit_capture",
    activation: Annotated[str, typer.Option(help="Of the emit head: softplus, exp or linear.")] = "softplus",
    size: Annotated[str, typer.Option(help="Size of the field: small or paper.")] = "small",
    semantic: Annotated[
        str, typer.Option(help="Give emit the features of --field: accumulated along the ray, or snapshot at the surface.")
    ] = "",
    semantic_own: Annotated[bool, typer.Option("--semantic-own", help="Besides the gaze field's own, not in their place.")] = False,
    begin: Annotated[str, typer.Option(help="Weights of the trunk to begin with: random, or those of the radiance field (field).")] = "random",
    freeze: Annotated[bool, typer.Option("--freeze", help="Do not train the weights that --begin field gives.")] = False,
    loss: Annotated[str, typer.Option(help="paper: KLD + (1 - CC) + MAE; code: MAE + 0.1 (1 - CC).")] = "paper",
    integral: Annotated[Optional[float], typer.Option(help="Weight of the error of the integral over the sphere.")] = None,
    minutes: Annotated[Optional[float], typer.Option(help="Train for this long, both fits together.")] = None,
    steps: Annotated[Optional[int], typer.Option(help="Or: train for so many steps. Default: 600.")] = None,
    learning_rate: Annotated[Optional[float], typer.Option(help="Learning rate at the start.")] = None,
    weight_decay: Annotated[Optional[float], typer.Option(help="Decoupled weight decay.")] = None,
    zones: Annotated[int, typer.Option(help="Zones of positions watched as validation; 0: none.")] = 3,
    refit: Annotated[bool, typer.Option(help="Train again on all rays once the best number of steps is known.")] = True,
    test_zones: Annotated[int, typer.Option(help="Zones of test positions that are left out of everything; 0: none.")] = 0,
    test_positions: Annotated[int, typer.Option(help="Test positions in them.")] = 64,
    seed: Annotated[int, typer.Option(help="Seed of probes, directions, weights, batches and splits.")] = 0,
    threads: Annotated[Optional[int], typer.Option(help="CPU threads. Default: all.")] = None,
    half: Annotated[bool, typer.Option("--half", help="Store the weights in fp16.")] = False,
    mode: Annotated[str, typer.Option("-m", "--mode", help="Mitsuba variant.")] = "llvm_ad_rgb",
) -> None:
    """Train a gaze field on rays of attention, and report its scores at positions that were held out."""
    import drjit as dr
    import mitsuba as mi

    from ..attention.collecting import file_sha256
    from ..attention.rays import Rays
    from ..field.backend import namespace
    from ..formats.fields import save_gaze
    from ..training.gaze_run import hold_out, train_gaze
    from ..training.gaze_settings import GazeSettings, ProbeSettings, sized_gaze_config

    if (field is None) == (geometry is None):
        raise ValueError("say where people looked around: either --field FILE or --geometry hits")
    if geometry not in (None, "hits"):
        raise ValueError(f'--geometry must be "hits", got "{geometry}"')
    if geometry is not None and align is not None:
        raise ValueError("--align belongs to --field; a place made from hit points is in the rays' own frame")
    mi.set_variant(mode)
    if threads is not None:
        dr.set_thread_count(threads)
    _check_start(begin, freeze, semantic, field)
    given = {"learning_rate": learning_rate, "weight_decay": weight_decay, "integral": integral}
    settings = GazeSettings(
        steps=600 if steps is None and minutes is None else steps, minutes=minutes, seed=seed, loss=loss, zones=zones,
        refit=refit, frozen=freeze, **{k: v for k, v in given.items() if v is not None},
    )  # fmt: skip
    how = ProbeSettings(radius, probes, cap, min_rays, kappa_rule, kappa, directions)
    data, ns = Rays.load(rays), namespace(mode)
    about = {"rays_file": {"file": rays.name, "sha256": file_sha256(rays), "persons": len(data.persons)}}
    if test_zones:
        data, about["test"] = hold_out(data, radius, test_zones, test_positions, seed, min_rays)
        test = about["test"]
        typer.echo(f"{len(test['centres'])} test positions held out, {test['rays_to_train']:,} of {test['rays']:,} rays left")
    if field is not None:
        medium, box, about["field_file"] = _trained_place(field, ns, file_sha256)
    else:
        medium, box, about["geometry_file"] = _place_of_hits(data, output, voxel, file_sha256)
    more, initial = {"semantic": semantic, "semantic_own": semantic_own}, None
    if begin == "field":
        from ..training.gaze_semantics import config_like, trunk_of

        config = config_like(medium.field.config, gaze, activation, **more)
        initial, about["begins_as"] = trunk_of(medium.field, config), field.name
    else:
        config = replace(sized_gaze_config(size, gaze, activation), **more)
        if semantic:
            config = replace(config, geometry=medium.feature_count)
    with _Bar() as bar:
        trained, provenance = train_gaze(data, medium, box, config, settings, how, ns, _similarity(align), bar.update, initial)
    save_gaze(trained, output, {**about, **provenance}, half)
    _report(provenance)
    typer.echo(f"wrote {output} ({output.stat().st_size / 1e6:.2f} MB)")


def _check_start(begin: str, freeze: bool, semantic: str, field: Path | None) -> None:
    if begin not in ("random", "field"):
        raise ValueError(f'--begin must be "random" or "field", got "{begin}"')
    if freeze and begin != "field":
        raise ValueError("--freeze keeps the weights that --begin field gives; add it, or leave --freeze out")
    if field is None and (semantic or begin == "field"):
        raise ValueError(f'{"--semantic" if semantic else "--begin field"} needs a radiance field: give it with --field')


def _trained_place(path: Path, ns, sha256):
    from ..formats.fields import load_radiance
    from ..transport.media import FieldMedium

    field, _ = load_radiance(path, ns)
    return FieldMedium(field), field.box, {"file": path.name, "sha256": sha256(path)}


def _place_of_hits(rays, output: Path, voxel: float, sha256):
    import mitsuba as mi

    from ..training.hit_geometry import volume_dict, voxelise_hits, write_volume
    from ..transport.media import VolumeMedium

    density, box = voxelise_hits(rays, voxel)
    path = output.with_suffix(".vol")
    output.parent.mkdir(parents=True, exist_ok=True)
    write_volume(path, density, box)
    size = " x ".join(map(str, density.shape[::-1]))
    typer.echo(f"wrote {path}: {size} voxels of {voxel:g} m, {100 * (density > 0).mean():.1f} % solid")
    return VolumeMedium(mi.load_dict(volume_dict(path))), box, {"file": path.name, "sha256": sha256(path), "voxel": voxel}


def _similarity(path: Path | None):
    from ..transport.media import Similarity

    if path is None:
        return None
    import json

    try:
        matrix = json.loads(path.read_text())
        return Similarity([[float(x) for x in row] for row in matrix])
    except (TypeError, ValueError, IndexError) as e:
        raise ValueError(f'--align needs a JSON file with the 4 rows of a similarity from rays to field; "{path}": {e}') from e


def _report(p: dict) -> None:
    typer.echo(f"{p['probes_made']} probes; {100 * p['escaped_directions']:.2f} % of the directions meet no surface, "
               f"and {100 * p['escaped_gaze']:.2f} % of the gaze")
    if "validation" in p:
        v = p["validation"]
        typer.echo(f"held-out positions: KLD {v['kld']:.3f}, CC {v['cc']:.3f}, MAE {v['mae']:.4f} /sr, "
                   f"integral {v['integral']:.3f}, best after {v['best_step']} steps")
    typer.echo(f"{p['steps']} steps; {p['seconds']:.0f} s in all, of it {p['seconds_preparing']:.0f} s for the probes"
               f"{'; interrupted' if p['interrupted'] else ''}")


class _Bar:
    """Progress of a training, with the last validation."""

    def __enter__(self):
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        self._progress = Progress(TextColumn("{task.fields[stage]:<6}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"),
                                  TimeElapsedColumn(), TextColumn("{task.description}"))
        self._task = self._progress.add_task("", total=1.0, stage="start")
        self._progress.start()
        return self

    def update(self, state) -> None:
        scores = "" if state.scores is None else f", held out KLD {state.scores.kld:.3f}, CC {state.scores.cc:.3f}"
        self._progress.update(self._task, completed=state.done, stage=state.stage,
                              description=f"step {state.steps}{scores}" if state.steps else "")

    def __exit__(self, *error):
        self._progress.stop()
