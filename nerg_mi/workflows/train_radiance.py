"""Training of radiance fields on posed photos, and scores on held-out photos."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

from nerg_mi.errors import NergError, blame_options, parameter
from nerg_mi.evaluation.metrics import ViewScores, score_views
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.atomic import check_folder, check_writable, reserve_output
from nerg_mi.files.tables import write_json
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.formats.fields import save_radiance
from nerg_mi.interruption import TrainingInterrupted
from nerg_mi.options import explicit_settings
from nerg_mi.photos.dataset import Dataset, open_dataset
from nerg_mi.photos.images import pick_evenly
from nerg_mi.photos.posed import describe_unused
from nerg_mi.progress import SILENT, Reporter, duration
from nerg_mi.train import radiance_run
from nerg_mi.train.radiance_monitor import GuardedObserver, TrainingObserver, get_curves_figure
from nerg_mi.train.radiance_settings import RadianceSettings, make_radiance_config

from .base import import_function, select_backend
from .radiance_commands import RadianceOptions, RadianceScoreOptions

# ---- Training and evaluation of radiance fields ----


# Seconds of an evaluation whose duration is announced.
_LONG = 90
# Smaller differences of exposure, in stops, are invisible and not reported.
_STOPS = 0.05


@dataclass(frozen=True)
class RadianceResult:
    """A trained radiance field.

    Attributes
    ----------
    field
        Field with its occupancy grid.
    provenance
        Provenance in its checkpoint (JSON).
    output
        Checkpoint, or None.
    interrupted
        Whether training was interrupted.
    """

    field: RadianceField
    provenance: dict
    output: Path | None
    interrupted: bool

    @property
    def psnr(self) -> float | None:
        """Mean PSNR in dB on the held-out views; None if there are none, or if masks remove them completely."""
        held_out = self.provenance.get("psnr_held_out")
        return None if held_out is None else held_out["mean"]


def train_radiance(
    dataset: str | Path,
    output: str | Path | None = None,
    options: RadianceOptions | None = None,
    reporter: Reporter = SILENT,
) -> RadianceResult:
    """Train a radiance field on posed photos.

    Parameters
    ----------
    dataset
        Posed photos: their folder, its transforms.json, or a COLMAP model.
    output
        Checkpoint to write (.safetensors), or None. Next to it are stored a preview (.preview.png), the evaluations on
        held-out views (.curves.csv and .curves.png) and, until training is finished, its state (.run), from which it
        can be resumed.
    options
        Size of the field, and settings.
    reporter
        Receives messages and progress.

    Raises
    ------
    NergError
        For errors that the user can correct, before any time is spent.
    TrainingInterrupted
        After Ctrl-C, when the result so far and the state have been written. The exception has the result so far.
    """
    options = options or RadianceOptions()
    with reserve_output(output), _open_page(options, reporter) as observer:
        return _train(dataset, None if output is None else Path(output), options, reporter, observer)


def _train(
    photos: str | Path,
    output: Path | None,
    options: RadianceOptions,
    reporter: Reporter,
    observer: TrainingObserver | None,
) -> RadianceResult:
    state = preview = curves = None
    if output is not None:
        state, preview = output.with_suffix(".run"), output.with_suffix(".preview.png")
        curves = output.with_suffix(".curves.csv")
        check_writable(output, ".safetensors")
        for path in (state, preview, curves, get_curves_figure(curves)):
            check_writable(path)
    ns = select_backend(options.mode, options.threads)
    settings = _settings(options)
    if options.resume and (state is None or not state.is_file()):
        raise NergError(
            f'there is no state to resume: "{state}" does not exist; leave out {parameter("resume", True)} to start'
        )
    reporter.progress(0.0, "reading photos")
    data = _open(photos, options)
    _report_data(data, reporter)
    field, provenance = radiance_run.train_field(
        data,
        make_radiance_config(options.size, data.box, options.deferred),
        settings,
        ns,
        options.depth,
        lambda now: reporter.progress(*_progress(now)),
        state=state,
        resume=options.resume,
        save_every=options.save_every or float("inf"),
        preview=preview,
        curves=curves,
        observer=observer,
        write=None if output is None else lambda field, metadata: save_radiance(field, output, metadata, options.half),
        on_warning=reporter.warn,
    )
    result = RadianceResult(field, provenance, output, provenance["interrupted"])
    _report_result(result, reporter)
    if result.interrupted:
        raise TrainingInterrupted(field, provenance, state)
    return result


@contextmanager
def _open_page(options: RadianceOptions, reporter: Reporter) -> Iterator[TrainingObserver | None]:
    """Yield the observer that shows the training in the browser, or None without the option ``view``."""
    if not options.view:
        yield None
        return
    open_training_page = import_function("nerg_mi.viewer.training:open_training_page")
    with open_training_page(options.port, reporter) as page:
        yield GuardedObserver(page, reporter.warn)


def _settings(options: RadianceOptions) -> RadianceSettings:
    explicit = explicit_settings(options, RadianceSettings)
    if options.steps is None:
        explicit.setdefault("minutes", 5.0)
    return RadianceSettings(**explicit)


def _open(photos: str | Path, options: RadianceOptions) -> Dataset:
    with blame_options(parameter("aabb")) if options.aabb else nullcontext():
        return open_dataset(
            photos,
            options.holdout,
            options.width,
            options.downscale,
            options.aabb,
            options.depth,
            options.scale,
            options.coordinates,
            options.allow_outside,
            options.unbounded,
        )


def _report_data(data: Dataset, reporter: Reporter) -> None:
    corner, core = lambda values: ", ".join(f"{x:.3g}" for x in values), data.box.core
    for line in (*describe_unused(data.unused), *data.notes):
        reporter.message(line)
    reporter.message(
        f"assumed scene type: {data.kind_note}; change it with {parameter('unbounded', True)}, "
        f"{parameter('bounded')} or {parameter('aabb')}"
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


def _report_result(result: RadianceResult, reporter: Reporter) -> None:
    provenance = result.provenance
    speed = f"; {provenance['evaluations_a_second']:.3g} field evaluations per second" if provenance["steps"] else ""
    reporter.message(f"{provenance['steps']} steps in {provenance['seconds']:.0f} s{speed}")
    if result.psnr is not None:
        fitted = provenance["psnr_held_out"]["mean_fitted"]
        halves = "" if fitted is None else f"; on right halves, with colours fitted on left halves: {fitted:.2f} dB"
        reporter.message(f"held-out PSNR: {result.psnr:.2f} dB{halves}")
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
    if result.output is not None:
        reporter.message(f"wrote {result.output} ({result.output.stat().st_size / 1e6:.2f} MB)")
        if provenance["psnr_watched"]["history"]:
            curves = result.output.with_suffix(".curves.csv")
            reporter.message(f"wrote {result.output.with_suffix('.preview.png')}")
            reporter.message(f"wrote {curves} and {get_curves_figure(curves)}")


def evaluate_radiance(
    field: str | Path, photos: str | Path, options: RadianceScoreOptions | None = None, reporter: Reporter = SILENT
) -> ViewScores:
    """Compute PSNR, SSIM and, if the ``photos`` have depth, depth error of the radiance field as rendered by the
    integrator.

    Raises `NergError` for errors that the user can correct, such as views that were used for training.
    """
    options = options or RadianceScoreOptions()
    pictures = None if options.pictures is None else Path(options.pictures)
    if pictures is not None:
        check_folder(pictures)
    if options.json_file is not None:
        check_writable(options.json_file)
    select_backend(options.mode, options.threads)
    provenance = read_checkpoint(field, "radiance")[1].get("provenance", {})
    trained_width = provenance.get("width") if isinstance(provenance.get("width"), int) else None
    data = open_dataset(
        photos,
        options.holdout,
        options.width or trained_width,
        None,
        None,
        options.depth,
        options.scale,
        options.coordinates,
        options.allow_outside,
    )
    for line in (*describe_unused(data.unused), *data.notes):
        reporter.message(line)
    if not options.train:
        _refuse_trained(field, provenance, data)
    views = data.train if options.train else data.held_out
    if options.views is not None:
        views = pick_evenly(views, options.views)
    done, start = 0, time.perf_counter()

    def row(name: str, psnr: float, ssim: float) -> None:
        similarity = "-" if math.isnan(ssim) else f"{ssim:.4f}"
        likeness = "-" if math.isnan(psnr) else f"{psnr:.2f}"
        reporter.message(f"{name[-32:]:32s} {likeness:>8s} {similarity:>7s}")

    def scored(name: str, psnr: float, ssim: float) -> None:
        nonlocal done
        done += 1
        row(name, psnr, ssim)
        expected = (time.perf_counter() - start) * len(views)
        if done == 1 and expected > _LONG:
            reporter.message(
                f"scoring {len(views)} views will take about {expected / 60:.0f} minutes; {parameter('views', 8)} "
                "scores 8 of them"
            )
        reporter.progress(done / len(views), f"{done} of {len(views)} views")

    reporter.message(f"{'view':32s} {'PSNR dB':>8s} {'SSIM':>7s}")
    scores = score_views(field, views, options.spp, pictures, scored)
    row("mean", scores.psnr_mean, scores.ssim_mean)
    if not math.isnan(scores.psnr_fitted_mean):
        reporter.message(f"PSNR of right halves, with colours fitted on left halves: {scores.psnr_fitted_mean:.2f} dB")
    if any(map(math.isnan, scores.ssim)):
        reporter.warn(
            f"views of {scores.width} x {scores.height} pixels are smaller than the 11 x 11 window of SSIM; "
            f"increase {parameter('width')}"
        )
    if scores.depth is not None:
        d = scores.depth
        reporter.message(
            f"depth: median error {d.median:.4f} units, {d.outlier_fraction:.1%} of the pixels off by more than 10 %; "
            f"opacity {d.opacity:.3f}, {d.translucent_fraction:.1%} of the pixels below 0.9"
        )
    if pictures is not None:
        reporter.message(f"wrote {len(views)} images to {pictures}")
    if options.json_file is not None:
        provenance = {"field": Path(field).name, "dataset": data.source["dataset"]}
        write_json(options.json_file, provenance | scores.to_dict())
        reporter.message(f"wrote {options.json_file}")
    return scores


def evaluate_beside(field: Path, dataset: Path, options: RadianceScoreOptions, reporter: Reporter) -> None:
    """Call `evaluate_radiance`, with images next to the ``field`` unless another folder is given."""
    options = replace(options, pictures=options.pictures or field.with_suffix(".eval"))
    evaluate_radiance(field, dataset, options, reporter)


def _refuse_trained(field: str | Path, provenance: dict, data: Dataset) -> None:
    """Raise `NergError` if views of the training would be scored."""
    held_out = provenance.get("held_out")
    trained = held_out.get("frames") if isinstance(held_out, dict) else None
    if trained is None or provenance.get("sha256") != data.source["sha256"]:
        return
    seen = sorted({v.name for v in data.held_out} - set(trained))
    if seen:
        raise NergError(
            f'"{field}" was trained on {seen[0]} and {len(seen) - 1} other views that would be scored; use the '
            f"same {parameter('holdout')} as in training"
        )
