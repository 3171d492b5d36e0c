"""``nerg train``: fields from recordings."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from nerg_mi.errors import NergError, chosen

from .train_gaze import train_gaze

app = typer.Typer(no_args_is_help=True, help="Train fields from recordings.")
app.command("gaze")(train_gaze)


@app.command("radiance")
def train_radiance(
    dataset: Annotated[Path, typer.Argument(help="Folder of posed photos, its transforms.json, or a COLMAP model.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Checkpoint to write (.safetensors).")],
    holdout: Annotated[
        int | None, typer.Option(help="Hold out every so many frames, 0 none. Default: transforms_test.json, else 8.")
    ] = None,
    size: Annotated[str, typer.Option(help="Size of the field: small, medium or paper.")] = "small",
    width: Annotated[int | None, typer.Option(help="Width of the pictures in pixels.")] = None,
    downscale: Annotated[float | None, typer.Option(help="Or: divide their size by this.")] = None,
    minutes: Annotated[float | None, typer.Option(help="Train for this long. Default: 5.")] = None,
    steps: Annotated[int | None, typer.Option(help="Or: train for so many steps.")] = None,
    aabb: Annotated[str | None, typer.Option(help="Bounds of what is seen: x0,y0,z0,x1,y1,z1.")] = None,
    scale: Annotated[
        float, typer.Option(help="Multiply all lengths by this: what a unit of the data set measures, in metres.")
    ] = 1.0,
    coordinates: Annotated[
        str,
        typer.Option(help="Of the field: file, original (applied_transform undone), or a dataparser_transforms.json."),
    ] = "file",
    allow_outside: Annotated[
        bool,
        typer.Option("--allow-outside", help="Read files outside of the data set's folder too, where it names them."),
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of the weights, rays and jitter.")] = 0,
    threads: Annotated[int | None, typer.Option(help="CPU threads. Default: all.")] = None,
    half: Annotated[bool, typer.Option("--half", help="Store the weights in fp16.")] = False,
    depth: Annotated[bool, typer.Option(help="Supervise with the data set's depth, where it has any.")] = True,
    depth_weight: Annotated[float | None, typer.Option(help="Weight of the depth's loss.")] = None,
    distortion_weight: Annotated[
        float, typer.Option(help="Weight of mip-NeRF 360's distortion loss, against fog; 0 is none.")
    ] = 0.0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the interrupted run of this output.")] = False,
    save_every: Annotated[
        float, typer.Option(help="Seconds between two states for --resume; 0: only one, when it ends early.")
    ] = 60.0,
    variant: Annotated[str, typer.Option(help="Mitsuba variant.")] = "llvm_ad_rgb",
) -> None:
    """Train a radiance field on posed pictures, and report the error on those held out."""
    import drjit as dr

    from nerg_mi.capture.dataset import open_dataset
    from nerg_mi.field.backend import namespace
    from nerg_mi.files.atomic import check_writable
    from nerg_mi.rendering.pictures import activate
    from nerg_mi.training.radiance.run import save_trained, train_radiance
    from nerg_mi.training.radiance.settings import RadianceSettings, sized_config

    state, preview = output.with_suffix(".run"), output.with_suffix(".preview.png")
    check_writable(output, ".safetensors")
    check_writable(state)
    check_writable(preview)
    activate(variant)
    if threads is not None:
        dr.set_thread_count(threads)
    if minutes is None and steps is None:
        minutes = 5.0
    weights = {"distortion_weight": distortion_weight}
    if depth_weight is not None:
        weights["depth_weight"] = depth_weight
    settings = RadianceSettings(steps=steps, minutes=minutes, seed=seed, **weights)
    if resume and not state.is_file():
        raise NergError(f'there is nothing to resume: "{state}" does not exist; leave out --resume to start')
    with chosen("--aabb") if aabb else nullcontext():
        data = open_dataset(
            dataset, holdout, width, downscale, _numbers(aabb), depth, scale, coordinates, allow_outside
        )
    config = sized_config(size, data.box)
    for line in (*data.unused, *data.notes):
        typer.echo(line)
    show = lambda corner: ", ".join(f"{x:.3g}" for x in corner)
    typer.echo(f"box: ({show(data.box.lower)}) to ({show(data.box.upper)}), {data.box_from}")
    typer.echo(data.unit)
    typer.echo(
        f"{len(data.train)} views to train on, {len(data.held_out)} held out, "
        f"{data.source['width']} x {data.source['height']} pixels"
    )
    with _Bar() as bar:
        _, provenance = train_radiance(
            data,
            config,
            settings,
            namespace(variant),
            depth,
            bar.update,
            state=state,
            resume=resume,
            save_every=save_every or float("inf"),
            preview=preview,
            write=lambda field, provenance: save_trained(field, provenance, output, half),
        )
    speed = f"; {provenance['evaluations_a_second']:.3g} field evaluations a second" if provenance["steps"] else ""
    typer.echo(f"{provenance['steps']} steps in {provenance['seconds']:.0f} s{speed}")
    if data.held_out:
        typer.echo(f"held-out PSNR: {provenance['psnr_held_out']['mean']:.2f} dB")
    for line in provenance["complaints"]:
        typer.echo(f"warning: {line}", err=True)
    typer.echo(f"wrote {output} ({output.stat().st_size / 1e6:.2f} MB)")
    if provenance["interrupted"]:
        raise KeyboardInterrupt(f"interrupted; go on with --resume (state in {state})")


def _numbers(text: str | None) -> tuple | None:
    if text is None:
        return None
    try:
        return tuple(float(x) for x in text.replace(",", " ").split())
    except ValueError as e:
        raise NergError(f'--aabb needs numbers x0,y0,z0,x1,y1,z1, got "{text}"') from e


class _Bar:
    """Progress of a training, with the time left and the last held-out error."""

    def __enter__(self):
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        self._progress = Progress(
            BarColumn(), TextColumn("{task.percentage:3.0f} %"), TimeElapsedColumn(), TextColumn("{task.description}")
        )
        self._task = self._progress.add_task("compiling", total=1.0)
        self._progress.start()
        return self

    def update(self, state) -> None:
        # Rich's own estimate follows the speed of the last moments, which pauses for looks upset.
        left = state.seconds * (1 - state.done) / max(state.done, 1e-6)
        error = f", held out {state.psnr:.2f} dB" if state.psnr is not None else ""
        self._progress.update(
            self._task, completed=state.done, description=f"{left:.0f} s left, step {state.steps}{error}"
        )

    def __exit__(self, *error):
        self._progress.stop()
