"""Scores of a radiance field on posed photos."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from nerg_mi.environment.radiance import RadianceField, get_validation_views
from nerg_mi.errors import NergError, parameter
from nerg_mi.files.atomic import check_folder, check_writable
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.photos.dataset import Dataset, PhotoView, open_dataset
from nerg_mi.photos.images import pick_evenly
from nerg_mi.photos.photo_set import Photos
from nerg_mi.photos.posed import describe_unused
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import LENGTHS, SPP, Range, check_ranges

from .metrics import ViewScores, score_views

_LONG = 90  # Seconds of an evaluation whose duration is announced


@check_ranges
def evaluate_radiance(
    field: RadianceField | FilePath,
    photos: Photos | FilePath,
    *,
    train: bool = False,
    views: Annotated[int, Range(1, 10**6)] | None = None,
    spp: Annotated[int, SPP] = 16,
    holdout: Annotated[int, Range(0, 10**6)] | None = None,
    width: Annotated[int, Range(1, 65536)] | None = None,
    scale: Annotated[float, LENGTHS] = 1.0,
    coordinates: str = "file",
    depth: bool = True,
    allow_outside: bool = False,
    json: FilePath | None = None,
    output: FilePath | None = None,
    progress: Progress = None,
) -> ViewScores:
    """Score a radiance field on held-out views, as the integrator renders it: PSNR, SSIM and, where it is known, depth
    error.

    Photos are read as in the training. Held-out views that chose the state of the field, by its provenance, are scored
    apart: their score is too high, and no mean includes them. Poses, points and the box of a data set are usually
    estimated from all photos, the held-out ones included; the colours of a photo are fitted on its left half, and
    scored on its right half.

    Parameters
    ----------
    field : RadianceField or path
        Radiance field (.safetensors).
    photos : Photos or path
        Posed photos to compare with, or their folder, its transforms.json, or a COLMAP model.
    train : bool
        Score the training views in place of the held-out views.
    views : int, optional
        Score this number of views, evenly spaced in the order of their names, of those that did not choose the state.
        Default: all views.
    spp : int
        Samples per pixel. The noise of few samples lowers the scores.
    holdout : int, optional
        Hold out every N-th photo for testing; 0 holds out none. Default: those of transforms_test.json, else 8.
    width : int, optional
        Width in pixels to which photos are resized. Default: the width in the training of the field.
    scale : float
        Length of one unit of the data set in metres, as in the training, which does not store it.
    coordinates : str
        Coordinate frame of the field: file (as in the data set), upright (+z up), original (without applied_transform),
        or the path of a dataparser_transforms.json.
    depth : bool
        Use the depth images of the data set, if there are any.
    allow_outside : bool
        Also read files outside the folder of the data set if it refers to them.
    json : path, optional
        JSON file to write the scores to.
    output : path, optional
        Folder for the rendered images, each next to its photo.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    ViewScores
        PSNR, SSIM and, if the photos have depth, the depth error of each photo.

    Raises
    ------
    NergError
        An argument or a file is invalid, or views that would be scored were used for training.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scores = nerg.evaluate_radiance(store / "store.safetensors", photos, width=24, train=True)
    >>> len(scores.psnr) == len(scores.views), scores.psnr_mean > 20  # photos: a folder of posed photos
    (True, True)
    """
    pictures = None if output is None else to_path(output)
    if pictures is not None:
        check_folder(pictures)
    if json is not None:
        check_writable(json)
    with open_reporter(progress) as reporter:
        loaded = RadianceField.open(field)
        trained_width = loaded.provenance.get("width")
        width = width or (trained_width if isinstance(trained_width, int) else None)
        data = open_dataset(photos, holdout, width, None, depth, scale, coordinates, allow_outside)
        for line in (*describe_unused(data.unused), *data.notes):
            reporter.message(line)
        if not train:
            _refuse_trained(loaded, data)
        chosen, validation = data.train if train else data.held_out, get_validation_views(loaded.provenance)
        if views is not None:
            chosen = pick_evenly([view for view in chosen if view.name not in validation], views)
        scores = _score(loaded, chosen, validation, spp, pictures, reporter)
        scores = replace(scores, field_name=loaded.name, dataset=data.source["dataset"])
        if pictures is not None:
            reporter.message(f"wrote {len(chosen)} images to {pictures}")
        if json is not None:
            reporter.message(f"wrote {scores.save(json)}")
    return scores


def _score(
    field: RadianceField,
    views: list[PhotoView],
    validation: list[str],
    spp: int,
    pictures: Path | None,
    reporter: Reporter,
) -> ViewScores:
    """Score ``views``, and report each of them and the means."""
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
    scores = score_views(field, views, spp, pictures, scored, validation)
    row("mean", scores.psnr_mean, scores.ssim_mean)
    means = scores.validation_means
    if scores.validation:
        row("mean of validation views", means["psnr"], means["ssim"])
        reporter.message(
            f"{len(scores.validation)} of the {len(views)} views chose the state of the field (validation views); the "
            "other means leave them out"
        )
    if not math.isnan(scores.psnr_fitted_mean):
        fitted = means["psnr_fitted"]
        suffix = "" if math.isnan(fitted) else f"; of validation views {fitted:.2f} dB"
        reporter.message(
            f"PSNR of right halves, with colours fitted on left halves: {scores.psnr_fitted_mean:.2f} dB{suffix}"
        )
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
    return scores


def _refuse_trained(field: RadianceField, data: Dataset) -> None:
    """Raise `NergError` if views of the training would be scored."""
    provenance = field.provenance
    held_out = provenance.get("held_out")
    trained = held_out.get("frames") if isinstance(held_out, dict) else None
    if trained is None or provenance.get("sha256") != data.source["sha256"]:
        return
    seen = sorted({v.name for v in data.held_out} - set(trained))
    if seen:
        raise NergError(
            f"{field.label} was trained on {seen[0]} and {len(seen) - 1} other views that would be scored; use the "
            f"same {parameter('holdout')} as in training"
        )
