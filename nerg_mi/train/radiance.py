"""Training of a radiance field on posed photos."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from nerg_mi.environment.radiance import RadianceField
from nerg_mi.environment.scene_loading import get_array_module
from nerg_mi.errors import NergError, blame_options, parameter
from nerg_mi.files.atomic import check_writable, reserve_output
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.formats.fields import save_radiance
from nerg_mi.interruption import TrainingInterrupted
from nerg_mi.photos.dataset import Dataset, open_dataset
from nerg_mi.photos.photo_set import Photos
from nerg_mi.photos.posed import describe_unused
from nerg_mi.progress import Progress, Reporter, duration, open_reporter
from nerg_mi.ranges import LENGTHS, MINUTES, SECONDS, SEEDS, STEPS, Range, check_ranges

from . import radiance_run
from .radiance_monitor import GuardedObserver, TrainingObserver, get_curves_figure
from .radiance_settings import RadianceSettings, make_radiance_config

_STOPS = 0.05  # Smaller differences of exposure, in stops, are invisible and not reported
_MINUTES = 5.0  # Length of a training by default


@check_ranges
def train_radiance(
    photos: Photos | FilePath,
    *,
    minutes: Annotated[float, MINUTES] | None = None,
    steps: Annotated[int, STEPS] | None = None,
    seed: Annotated[int, SEEDS] = 0,
    size: str = "small",
    deferred: bool = False,
    aabb: Sequence[float] | None = None,
    unbounded: bool | None = None,
    photo_colors: bool = True,
    holdout: Annotated[int, Range(0, 10**6)] | None = None,
    width: Annotated[int, Range(1, 65536)] | None = None,
    scale: Annotated[float, LENGTHS] = 1.0,
    coordinates: str = "file",
    depth: bool = True,
    allow_outside: bool = False,
    half: bool = False,
    resume: bool = False,
    save_every: Annotated[float, SECONDS] = 60.0,
    view: bool = False,
    port: Annotated[int, Range(0, 65535)] = 8080,
    settings: RadianceSettings | None = None,
    output: FilePath | None = None,
    progress: Progress = None,
) -> RadianceField:
    """Train a radiance field on posed photos and report the error on held-out views.

    Up to four of the held-out views, and at most half of them, choose the state of the training that is the result, if
    an earlier one is better. The error that is reported is that of the others; the one of those is printed next to it.

    Parameters
    ----------
    photos : Photos or path
        Posed photos, or their folder, its transforms.json, or a COLMAP model.
    minutes : float, optional
        Training time in minutes. Default: 5, unless ``steps`` is given.
    steps : int, optional
        Number of training steps, in place of ``minutes``.
    seed : int
        Seed of initial weights, rays and jitter.
    size : str
        Size of the field: small, medium or paper.
    deferred : bool
        Deferred shading: evaluate the colour network once per ray and not at each sample, for faster rendering.
    aabb : sequence of float, optional
        Axis-aligned bounding box of the scene, x0,y0,z0,x1,y1,z1, in the frame of the field. Default: derived from the
        points and cameras.
    unbounded : bool, optional
        Whether there is anything to see beyond the bounding box. Default: derived from the points; bounded without any.
    photo_colors : bool
        Fit the exposure and white balance of each photo.
    holdout : int, optional
        Hold out every N-th photo for testing; 0 holds out none. Default: those of transforms_test.json, else 8.
    width : int, optional
        Width in pixels to which photos are resized. Default: the width of the photos.
    scale : float
        Length of one unit of the data set in metres; all lengths are multiplied by it.
    coordinates : str
        Coordinate frame of the field: file (as in the data set), upright (+z up), original (without applied_transform),
        or the path of a dataparser_transforms.json.
    depth : bool
        Use the depth images of the data set, if there are any.
    allow_outside : bool
        Also read files outside the folder of the data set if it refers to them.
    half : bool
        Store the weights in half precision (fp16).
    resume : bool
        Resume the interrupted training of this output file.
    save_every : float
        Interval in seconds between two saved states for ``resume``; 0 saves only when training is interrupted.
    view : bool
        Show the field in the browser while it trains, for up to a tenth of the time. The page is served to this machine
        only. Needs viser: pip install "nerg-mi[viewer]".
    port : int
        Port to serve the page of ``view`` at; 0: any free port.
    settings : RadianceSettings, optional
        Settings of the optimisation, of which ``minutes``, ``steps``, ``seed`` and ``photo_colors`` are replaced.
    output : path, optional
        Radiance field to write (.safetensors). Next to it are stored a preview (.preview.png), the evaluations on
        held-out views (.curves.csv and .curves.png) and, until training is complete, a state (.run) to resume from.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    RadianceField
        The radiance field. Its ``provenance`` contains the error on held-out photos (``psnr_held_out``), and the names
        of those that chose its state (``validation_views``).

    Raises
    ------
    NergError
        An argument or a file is invalid, which is found before any time is spent where possible.
    KeyboardInterrupt
        Ctrl-C was pressed. An ``output`` has been written. The attribute ``field`` of the exception is the field of the
        state so far.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> field = nerg.train_radiance(photos, steps=2, holdout=0)  # photos: a folder of posed photos
    >>> field.kind, field.provenance["steps"]
    ('radiance', 2)
    """
    chosen = _make_settings(settings, minutes, steps, seed, photo_colors)
    path = None if output is None else to_path(output)
    with reserve_output(path), open_reporter(progress) as reporter, _open_page(view, port, reporter) as observer:
        files: dict[str, Path] = {}
        if path is not None:
            check_writable(path, ".safetensors")
            curves = path.with_suffix(".curves.csv")
            files = {"state": path.with_suffix(".run"), "preview": path.with_suffix(".preview.png"), "curves": curves}
            for file in (get_curves_figure(curves), *files.values()):
                check_writable(file)
        if resume and ("state" not in files or not files["state"].is_file()):
            raise NergError(
                f'there is no state to resume: "{files.get("state")}" does not exist; leave out '
                f"{parameter('resume', True)} to start"
            )
        reporter.progress(0.0, "reading photos")
        box = None if aabb is None else tuple(aabb)
        with blame_options(parameter("aabb")) if box else nullcontext():
            data = open_dataset(photos, holdout, width, box, depth, scale, coordinates, allow_outside, unbounded)
        _report_data(data, reporter)
        network, provenance = radiance_run.train_field(
            data,
            make_radiance_config(size, data.box, deferred),
            chosen,
            get_array_module(),
            depth,
            lambda now: reporter.progress(*_progress(now)),
            resume=resume,
            save_every=save_every or float("inf"),
            observer=observer,
            write=None if path is None else lambda field, metadata: save_radiance(field, path, metadata, half),
            on_warning=reporter.warn,
            **files,
        )
        field = RadianceField(network, provenance, "in memory" if path is None else path.name, path, half=half)
        _report_result(field, reporter)
    if provenance["interrupted"]:
        raise TrainingInterrupted(field, provenance, files.get("state"))
    return field


def _make_settings(
    settings: RadianceSettings | None, minutes: float | None, steps: int | None, seed: int, photo_colors: bool
) -> RadianceSettings:
    """Return the settings of a training, with the length that is given."""
    if minutes is not None and steps is not None:
        raise NergError(f"{parameter('minutes')} and {parameter('steps')} are alternatives; give one of them")
    if settings is None or minutes is not None or steps is not None:
        settings = replace(
            settings or RadianceSettings(minutes=_MINUTES),
            steps=steps,
            minutes=minutes if minutes is not None or steps is not None else _MINUTES,
        )
    return replace(settings, seed=seed, photo_colors=photo_colors)


@contextmanager
def _open_page(view: bool, port: int, reporter: Reporter) -> Iterator[TrainingObserver | None]:
    """Yield the observer that shows the training in the browser, or None without ``view``."""
    if not view:
        yield None
        return
    pages: Any = importlib.import_module("nerg_mi.viewer.training")  # which needs an extra
    with pages.open_training_page(port, reporter) as page:
        yield GuardedObserver(page, reporter.warn)


def _report_data(data: Dataset, reporter: Reporter) -> None:
    corner, core = lambda values: ", ".join(f"{x:.3g}" for x in values), data.box.core
    for line in (*describe_unused(data.unused), *data.notes):
        reporter.message(line)
    reporter.message(
        f"assumed scene type: {data.kind_note}; change it with {parameter('unbounded', True)}, "
        f"{parameter('unbounded', False)} or {parameter('aabb')}"
    )
    reporter.message(f"box: ({corner(core.lower)}) to ({corner(core.upper)}), {data.box_source}")
    if points := sum(len(view.points) for view in data.train if view.points is not None):
        reporter.message(f"the COLMAP model has {points:,} observations of points in the training views")
    reporter.message(data.unit_note)
    reporter.message(data.up_note)
    reporter.message(
        f"{len(data.train)} training views, {len(data.held_out)} held out, {data.source['width']} x "
        f"{data.source['height']} pixels"
    )


_PHASES = {
    "extracting": "extracting the occupancy",
    "scoring": "scoring the held-out views",
    "writing": "writing the field",
}


def _progress(now: radiance_run.RadianceProgress) -> tuple[float, str]:
    """Return the completed fraction of the command, and the present phase in words."""
    if now.phase != "training":
        return now.fraction, _PHASES[now.phase]
    # Never 0, because the last phase still runs.
    left = duration(max(now.remaining, 1.0))
    error = f", held out {now.psnr:.2f} dB" if now.psnr is not None else ""
    return now.fraction, f"training, {left} left, step {now.steps}{error}"


def _report_result(field: RadianceField, reporter: Reporter) -> None:
    provenance = field.provenance
    speed = f"; {provenance['evaluations_a_second']:.3g} field evaluations per second" if provenance["steps"] else ""
    reporter.message(f"{provenance['steps']} steps in {provenance['seconds']:.0f} s{speed}")
    if (held_out := provenance.get("psnr_held_out")) is not None:
        num_validation = len(provenance["validation_views"])
        count = len(held_out["views"]) - num_validation
        reporter.message(f"PSNR of {count} held-out views: {_describe_psnr(held_out)}")
        if num_validation:
            reporter.message(
                f"PSNR of {num_validation} other held-out views, which chose the state: "
                f"{_describe_psnr(held_out['validation'])}"
            )
    if provenance.get("photo_stops", 0) >= _STOPS:
        reporter.message(
            f"the exposures of the photos differ by {provenance['photo_stops']:.2f} stops (standard deviation)"
        )
    if "beyond_box" in provenance:
        reporter.message(
            f"{provenance['beyond_box']:.0%} of the validation pixels show what is beyond the bounding box"
        )
    for complaint in provenance["complaints"]:
        reporter.warn(complaint)
    if field.path is not None:
        reporter.message(f"wrote {field.path} ({field.path.stat().st_size / 1e6:.2f} MB)")
        if provenance["psnr_watched"]["history"]:
            curves = field.path.with_suffix(".curves.csv")
            reporter.message(f"wrote {field.path.with_suffix('.preview.png')}")
            reporter.message(f"wrote {curves} and {get_curves_figure(curves)}")


def _describe_psnr(scores: dict[str, float | None]) -> str:
    """Describe the mean PSNR of views, and that with fitted colours."""
    mean, fitted = scores["mean"], scores["mean_fitted"]
    halves = "" if fitted is None else f"; on right halves, with colours fitted on left halves: {fitted:.2f} dB"
    return "unknown, because all pixels are masked" if mean is None else f"{mean:.2f} dB{halves}"
