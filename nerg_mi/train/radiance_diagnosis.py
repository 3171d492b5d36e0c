"""Problems of a radiance training: what went wrong, the likely causes in the photos, and the quality of the result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import parameter
from nerg_mi.photos.images import PhotoView
from nerg_mi.photos.posed import format_names

# ---- Problems of a finished training ----

MIN_STEPS = 500  # Below this, each doubling of the steps still gains several dB on photos
# Evaluations on a few views vary by some tenths of a dB
_MAX_DROP = 1.0
# Difference of training and held-out views in dB above which a field explains photos rather than the scene. It was at
# most 3.5 for sound fields of 14 captures, and 4.3 to 9.7 for fields of four others that were not.
MAX_GAP = 5.0
MIN_PSNR = 20.0  # dB on held-out views, below which shapes are hardly recognisable
SOUND_PSNR = 25.0  # dB on held-out views, from which a field is usable however much better training views are


@dataclass(frozen=True)
class Outcome:
    """What is known of a training at its end.

    Attributes
    ----------
    history
        Evaluations on the validation views in order, each with ``steps``, ``psnr`` in dB and, if known, ``psnr_train``,
        the same on training views.
    result
        Row of ``history`` that the result has; None without validation views.
    psnr
        PSNR in dB of the result on held-out views that did not choose it; None without any.
    steps, seconds
        Length of the training.
    stride
        March stride at its end, relative to rendering.
    minutes
        Time limit, or None for a run by steps.
    waiting_fraction
        Fraction of the processor time that other programs used.
    """

    history: list[dict]
    result: dict | None
    psnr: float | None
    steps: int
    stride: int
    minutes: float | None
    seconds: float = 0.0
    waiting_fraction: float = 0.0

    @property
    def gap(self) -> float:
        """PSNR of training views minus that of held-out views in dB; 0 if unknown."""
        if self.psnr is None or self.result is None or self.result.get("psnr_train") is None:
            return 0.0
        return self.result["psnr_train"] - self.psnr

    @property
    def is_poor(self) -> bool:
        """Whether the result predicts held-out views badly."""
        if self.psnr is None:
            return False
        return self.psnr < (SOUND_PSNR if self.gap > MAX_GAP else MIN_PSNR)


def find_problems(outcome: Outcome, causes: list[str]) -> list[str]:
    """Describe problems of a training in one sentence each; empty for a sound run.

    ``causes`` are likely causes of a poor result, from `find_causes`.
    """
    out, steps, history = [], outcome.steps, outcome.history
    remedy = (
        f"more {parameter('steps')}"
        if outcome.minutes is None
        else f"more {parameter('minutes')}, or {parameter('steps')}"
    )
    if steps < MIN_STEPS:
        timed = outcome.minutes is not None and outcome.seconds > 0
        rate = f" ({describe_pace(steps / outcome.seconds, outcome.waiting_fraction)})" if timed else ""
        out.append(f"only {steps} steps{rate}, but a usable field needs at least {MIN_STEPS}; use {remedy}")
    if outcome.stride > 1:
        out.append(
            f"the run ended with steps {outcome.stride} times coarser than those of rendering, because fog was not "
            f"cleared yet; use {remedy}"
        )
    # With too few steps, a lower PSNR is noise of an unfinished training.
    if steps < MIN_STEPS:
        return out
    best, last = outcome.result, history[-1]["psnr"] if history else 0.0
    if best is not None and best["psnr"] - last > _MAX_DROP:
        out.append(
            f"validation views were best at step {best['steps']} with {best['psnr']:.2f} dB, and had {last:.2f} dB "
            f"at the end: the field of that step is the result, and more {parameter('minutes')} would not improve "
            "it"
        )
    if outcome.is_poor:
        training = f", training views {outcome.gap:.1f} dB more" if outcome.gap > 0 else ""
        likely = f"; likely causes: {'; '.join(causes)}" if causes else ""
        out.append(f"held-out views have {outcome.psnr:.1f} dB{training}: this field is of poor quality{likely}")
    return out


# Fraction of the processor time that other programs use on a busy machine.
_MAX_WAITING = 0.1


def describe_pace(steps_per_second: float, waiting_fraction: float) -> str:
    """Describe a low pace and its cause, in a few words."""
    busy = waiting_fraction > _MAX_WAITING
    cause = f"other programs used {waiting_fraction:.0%} of the processor time" if busy else "this machine is slow"
    return f"{steps_per_second:.2g} per second: {cause}"


# ---- Likely causes in the photos ----

_FEW_VIEWS = 40
_MAX_FOCAL_RATIO = 1.3
_MAX_STOPS = 0.3
_MAX_OUTSIDE = 0.5
# Tiles of this many pixels whose grey values differ less than this standard deviation (of 0..1) have no texture.
_TILE, _MIN_CONTRAST, _MAX_BLANK = 16, 0.02, 0.5
# Photos with less than this fraction of the median sharpness are blurred.
_MIN_SHARPNESS, _MAX_BLURRED = 0.35, 0.1


def find_causes(views: list[PhotoView], exposure_stops: float = 0.0, outside_fraction: float = 0.0) -> list[str]:
    """Describe what in the training photos often prevents a good field, each with its remedy, most likely first.

    Parameters
    ----------
    views : list of PhotoView
        Training photos.
    exposure_stops : float
        Standard deviation of the photos' exposure in f-stops.
    outside_fraction : float
        Fraction of the validation pixels that show something beyond the bounding box.
    """
    out, blank, sharpness = [], [], []
    for view in views:
        grey = view.composite_over(0.5).mean(axis=2)
        blank.append(_measure_blank(grey))
        # The mean absolute second difference across rows and columns; 0 for tiny pictures
        sharpness.append(float(sum(np.abs(np.diff(grey, 2, axis=k)).sum() for k in (0, 1))) / max(grey.size, 1))
    if np.mean(blank) > _MAX_BLANK:
        out.append(
            f"{np.mean(blank):.0%} of the photos' area has hardly any texture: if an object was turned in front of its "
            "surroundings, mask these; else photograph more of the room"
        )
    if len(views) < _FEW_VIEWS:
        out.append(f"only {len(views)} training photos: take more, from more directions")
    if all(view.points is None and view.depth is None for view in views):
        out.append(
            "the photos have neither depth nor points of a reconstruction, which prevent fog: estimate their poses and "
            "points with `nerg poses`"
        )
    focal = [v.camera.intrinsics.fx / max(v.shape) for v in views]
    if max(focal) > _MAX_FOCAL_RATIO * min(focal):
        out.append(
            f"focal lengths differ by a factor of {max(focal) / min(focal):.2f}: keep the zoom, and pose the photos "
            "with one shared camera"
        )
    if exposure_stops > _MAX_STOPS:
        out.append(f"exposures differ by {exposure_stops:.1f} stops: lock the exposure of the camera")
    if outside_fraction > _MAX_OUTSIDE:
        out.append(
            f"{outside_fraction:.0%} of the pixels show what is beyond the bounding box: enlarge it with "
            f"{parameter('aabb')}"
        )
    blurred = [v.name for v, s in zip(views, sharpness) if s < _MIN_SHARPNESS * np.median(sharpness)]
    if len(blurred) > _MAX_BLURRED * len(views):
        out.append(f"{len(blurred)} photos are blurred: remove {format_names(blurred, 3)}")
    return out


def _measure_blank(grey: np.ndarray) -> float:
    """Return the fraction of the tiles of ``grey`` (h, w) in 0..1 without texture."""
    rows, columns = grey.shape[0] // _TILE, grey.shape[1] // _TILE
    if not rows * columns:
        return 0.0
    tiles = grey[: rows * _TILE, : columns * _TILE].reshape(rows, _TILE, columns, _TILE)
    return float(np.mean(tiles.std(axis=(1, 3)) < _MIN_CONTRAST))
