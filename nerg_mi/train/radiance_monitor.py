"""What is shown of a radiance training while it runs: observers, preview, and curves of its evaluations."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from nerg_mi.errors import format_error
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.figures.style import make_provenance, save
from nerg_mi.figures.training import psnr_figure
from nerg_mi.files.images import write_png
from nerg_mi.files.tables import add_notes, write_csv
from nerg_mi.photos.cameras import PosedCamera, resize_by_area
from nerg_mi.photos.dataset import Dataset
from nerg_mi.photos.images import PhotoView

from .radiance_trainer import RadianceTrainer

_COMMAND = "nerg train radiance"

# ---- Observers ----


class TrainingObserver(Protocol):
    """Observes a radiance training, for example to show it.

    Both methods are called on the thread of the training, between two steps, and must not change the trainer. Their
    time is part of the time of the run.
    """

    def on_start(self, trainer: RadianceTrainer, dataset: Dataset) -> None:
        """Called before the first step."""

    def on_step(self, trainer: RadianceTrainer, history: Sequence[dict]) -> None:
        """Called after each step, with the evaluations so far (``steps``, ``seconds``, ``psnr``, ``psnr_train``)."""


class GuardedObserver:
    """Calls ``observer`` until it raises; its error is reported once by ``warn`` and does not end the training."""

    def __init__(self, observer: TrainingObserver, warn: Callable[[str], None]):
        self._observer: TrainingObserver | None = observer
        self._warn = warn

    def on_start(self, trainer: RadianceTrainer, dataset: Dataset) -> None:
        self._call(lambda observer: observer.on_start(trainer, dataset))

    def on_step(self, trainer: RadianceTrainer, history: Sequence[dict]) -> None:
        self._call(lambda observer: observer.on_step(trainer, history))

    def _call(self, function: Callable[[TrainingObserver], None]) -> None:
        if self._observer is None:
            return
        try:
            function(self._observer)
        except Exception as error:
            self._observer = None
            self._warn(
                f"the view of the training has stopped ({type(error).__name__}: {format_error(error).rstrip('.')}); "
                "the training continues without it"
            )


# ---- Preview: a held-out view as rendered now, next to its photo ----

PREVIEW_WIDTH = 400
"""Width of the rendering, and of the photo, in pixels; smaller photos are not enlarged."""

MAX_PREVIEW_FRACTION = 0.03
"""Maximum fraction of the time of a run that its previews take."""

PICTURE_STRIDE = 4
"""March stride up to which a picture is rendered faster, unless that of the training is coarser.

Against a stride of 1, strides of 2, 4 and 8 lose 0.01, 0.1 to 0.3, and 0.5 to 0.9 dB on photos (fox, 60 to 300 steps).
"""

# Early previews may use a part of the time for later ones.
_ADVANCE = 0.2
# Seconds that the last preview may take in a short run.
_LAST_SECONDS = 5.0
# Pixel strides of renderings that are enlarged, if full ones take too long.
_PIXEL_STRIDES = (2, 4)


class PreviewWriter:
    """Writes the preview of a training (PNG): ``view`` as rendered now, with its photo to the right.

    Parameters
    ----------
    path : Path
        File to write.
    view : PhotoView
        View to render; it is reduced to `PREVIEW_WIDTH`.

    Attributes
    ----------
    seconds : float
        Time of all previews so far.

    Notes
    -----
    In the fog of an early training a ray has hundreds of samples. Therefore a preview is rendered with the finest march
    stride that is affordable, at most `PICTURE_STRIDE` or that of the training; else with every second or fourth pixel,
    enlarged; else it is left out.
    """

    def __init__(self, path: Path, view: PhotoView):
        self.path, self.view, self.seconds = path, _reduce_view(view, PREVIEW_WIDTH), 0.0
        self._seconds_per_sample: float | None = None

    def write_if_affordable(self, trainer: RadianceTrainer) -> bool:
        """Write a preview of the averaged weights unless it would take too long; return whether it was written."""
        run_seconds = trainer.seconds / max(trainer.progress, 1e-6)
        allowed = MAX_PREVIEW_FRACTION * run_seconds * min(1.0, trainer.progress + _ADVANCE)
        strides = self._choose_strides(trainer, allowed - self.seconds)
        if strides is not None:
            self._write(trainer, None, *strides)
        return strides is not None

    def write_result(self, trainer: RadianceTrainer, field: RadianceNetwork) -> None:
        """Write the preview of ``field``, the result of the training."""
        strides = self._choose_strides(trainer, max(MAX_PREVIEW_FRACTION * trainer.seconds, _LAST_SECONDS))
        self._write(trainer, field, *(strides or _list_strides(trainer)[-1]))

    def _choose_strides(self, trainer: RadianceTrainer, allowed: float) -> tuple[int, int] | None:
        """Return the finest pixel stride and march stride that take at most ``allowed`` seconds, or None."""
        return next((s for s in _list_strides(trainer) if self._estimate_seconds(trainer, *s) <= allowed), None)

    def _estimate_seconds(self, trainer: RadianceTrainer, every: int, stride: int) -> float:
        per_sample = self._seconds_per_sample
        if per_sample is None:
            # Steps also compute derivatives, so that the first estimate is too high.
            per_sample = trainer.clock.seconds / max(trainer.clock.evaluations, 1)
        return per_sample * trainer.estimate_samples(self.view, stride) / every**2

    def _write(self, trainer: RadianceTrainer, field: RadianceNetwork | None, every: int, stride: int) -> None:
        import mitsuba as mi

        start = time.perf_counter()
        rendered = np.clip(trainer.render(self.view, every, field, stride).color, 0, 1)
        rows, columns = (np.minimum(np.arange(n) // every, m - 1) for n, m in zip(self.view.shape, rendered.shape))
        both = np.concatenate([rendered[np.ix_(rows, columns)], self.view.composite_over(0)], axis=1)
        write_png(self.path, mi.Bitmap((255 * both + 0.5).astype(np.uint8)), make_provenance(_COMMAND).text())
        seconds = time.perf_counter() - start
        self.seconds += seconds
        self._seconds_per_sample = seconds * every**2 / trainer.estimate_samples(self.view, stride)


def _list_strides(trainer: RadianceTrainer) -> list[tuple[int, int]]:
    """Return the pixel strides and march strides of a preview, the finest first."""
    coarsest = max(PICTURE_STRIDE, trainer.stride)
    strides = [*(1 << k for k in range(coarsest.bit_length()) if 1 << k < coarsest), coarsest]
    return [*((1, stride) for stride in strides), *((every, coarsest) for every in _PIXEL_STRIDES)]


def _reduce_view(view: PhotoView, width: int) -> PhotoView:
    """Return the camera and photo of ``view`` with at most ``width`` columns."""
    old_height, old_width = view.shape
    if old_width <= width:
        return PhotoView(view.name, view.camera, view.pixels)
    height = max(1, round(old_height * width / old_width))
    camera = PosedCamera(view.camera.intrinsics.resized(width, height), view.camera.to_world)
    return replace(PhotoView(view.name, camera, view.pixels), pixels=resize_by_area(view.color, width, height))


# ---- Curves of the evaluations ----

CURVE_COLUMNS = ("steps", "seconds", "psnr", "psnr_train", "every_pixel")


def get_curves_figure(table: Path) -> Path:
    """Return the name of the figure (.png) of a table of curves (.csv)."""
    return table.with_suffix(".png")


def write_curves_table(path: Path, history: Sequence[dict]) -> None:
    """Write the evaluations of a training as CSV.

    ``steps`` and ``seconds`` of training, PSNR in dB of held-out (``psnr``) and training views (``psnr_train``), and
    the pixel stride (``every_pixel``) of the evaluation. The ``note`` says why a value is missing.
    """
    rows = [{name: row.get(name) for name in CURVE_COLUMNS} for row in history]
    add_notes(rows, lambda row, column: (column, "there are no such views, or all of their pixels are masked"))
    write_csv(path, rows, (*CURVE_COLUMNS, "note"))


def write_curves_figure(path: Path, history: Sequence[dict], result: dict | None) -> None:
    """Draw the evaluations of a training as PNG, with the state ``result`` that was written, if any."""
    save(psnr_figure(history, result), path, make_provenance(_COMMAND))
