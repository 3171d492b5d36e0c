"""Measures: of images, and of densities over directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.figures.overlay import srgb, write_png
from nerg_mi.figures.style import make_provenance
from nerg_mi.files.atomic import make_folder
from nerg_mi.maths.color import mean_ignoring_nan, psnr, color_corrected_psnr
from nerg_mi.photos.cameras import PosedCamera, pixel_directions, make_sensor_dict
from nerg_mi.photos.images import PhotoView, make_pinhole_camera, apply_lens

# ---- Images ----
#
# How well a radiance field's pictures equal posed pictures: PSNR, SSIM, depth.
#
# Pictures are rendered by the `nerg` integrator at its defaults, through ``mi.render``. A photo with lens distortion is
# left as it is; the rendering is bent to its lens.


# Wang et al. 2004: window of 11 x 11 pixels, a Gaussian of 1.5; constants for values in 0..1.
_RADIUS, _SIGMA, _C1, _C2 = 5, 1.5, 0.01**2, 0.03**2


def ssim(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Structural similarity (Wang et al. 2004) of values in 0..1, (h, w, c), the mean over channels.

    Averaged over the windows that lie in the picture and, where one is given, in ``mask`` (h, w); NaN if there is none.
    """
    from scipy.ndimage import correlate1d, minimum_filter

    height, width = truth.shape[:2]
    x = np.arange(-_RADIUS, _RADIUS + 1)
    window = np.exp(-0.5 * (x / _SIGMA) ** 2)
    window /= window.sum()
    blur = lambda a: correlate1d(correlate1d(a, window, 0), window, 1)
    a, b = np.clip(picture, 0, 1).astype(np.float64), np.asarray(truth, np.float64)
    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b, covariance = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2, blur(a * b) - mean_a * mean_b
    score = (2 * mean_a * mean_b + _C1) * (2 * covariance + _C2)
    score /= (mean_a**2 + mean_b**2 + _C1) * (var_a + var_b + _C2)
    whole = np.ones((height, width), bool) if mask is None else np.asarray(minimum_filter(mask, 2 * _RADIUS + 1), bool)
    inner = (slice(_RADIUS, -_RADIUS),) * 2
    kept = score[inner][whole[inner]]
    return float(kept.mean()) if kept.size else float("nan")


@dataclass(frozen=True)
class DepthScore:
    """Over pixels whose true depth is known: ``median``, ``mean``: of the absolute error, scene units; ``off``: share
    that is wrong by more than a tenth (or empty); ``opacity``: mean, and ``translucent``: share below 0.9."""

    median: float
    mean: float
    outlier_fraction: float
    opacity: float
    translucent_fraction: float


def compute_depth_score(depth: np.ndarray, opacity: np.ndarray, truth: np.ndarray) -> DepthScore | None:
    """Score of ``depth`` (h, w), 0 where there is none, against ``truth`` (h, w), 0 where unknown; None if nowhere
    known."""
    known = truth > 0
    if not known.any():
        return None
    # A hole is as wrong as its depth of 0 says.
    error = np.abs(depth[known] - truth[known])
    alpha = opacity[known]
    return DepthScore(
        float(np.median(error)),
        float(error.mean()),
        float(np.mean(error > 0.1 * truth[known])),
        float(alpha.mean()),
        float(np.mean(alpha < 0.9)),
    )


@dataclass(frozen=True)
class RenderedView:
    """``color`` (h, w, 3): sRGB before black, composited as a picture with alpha is; ``depth`` (h, w): the
    integrator's default, the median, from the camera's centre, scene units; ``opacity`` (h, w); ``mask``: pixels that
    could be rendered."""

    color: np.ndarray
    depth: np.ndarray
    opacity: np.ndarray
    mask: np.ndarray


_LAUNCH = 1 << 23  # Samples that are rendered at once: the memory for those of a whole picture may not be there


class FieldRenderer:
    """Renders the field in a checkpoint as the cameras of a data set see it. Needs a Mitsuba variant."""

    def __init__(self, field: str | Path, spp: int = 16):
        import mitsuba as mi

        self.spp = spp
        integrator = {"type": "nerg", "field": {"type": "nerf", "filename": str(field)}, "aovs": "depth,opacity"}
        with translate_mitsuba_errors(field):
            self.scene = mi.load_dict({"type": "scene", "integrator": integrator})

    def __call__(self, camera: PosedCamera, seed: int = 0) -> RenderedView:
        """``camera``'s picture, ``spp`` rays a pixel."""
        import drjit as dr
        import mitsuba as mi

        i = camera.intrinsics
        plain = not i.is_distorted and abs(i.fx / i.fy - 1) < 1e-9
        source = camera if plain else make_pinhole_camera(camera)
        about = make_sensor_dict(source)
        about["sampler"] = {"type": "multijitter", "sample_count": self.spp}
        with translate_mitsuba_errors():
            sensor = mi.load_dict(about)
        params = mi.traverse(sensor)
        to_world: Any = params["to_world"]
        # As a literal every pose would compile kernels of its own.
        pose = mi.Transform4f(to_world)
        dr.make_opaque(pose)
        params["to_world"] = pose
        params.update()
        each = max(_LAUNCH // (source.intrinsics.width * source.intrinsics.height), 1)
        out = np.zeros(())
        for first in range(0, self.spp, each):
            count = min(each, self.spp - first)
            with translate_mitsuba_errors():
                part = mi.render(self.scene, sensor=sensor, spp=count, seed=mi.UInt32(seed + first))
                out = out + np.array(part, np.float64) * (count / self.spp)
            # Mitsuba takes Ctrl-C while it renders.
            if self.scene.integrator().should_stop():
                raise KeyboardInterrupt
        opacity = np.clip(out[..., 4], 0, 1)
        some = np.maximum(opacity, 1e-6)[..., None]
        color = opacity[..., None] * srgb(out[..., :3] / some)
        # Rays start at the near plane; depth is counted from there.
        along = -pixel_directions(source.intrinsics)[..., 2]
        depth = np.where(opacity > 0, out[..., 3] + about["near_clip"] / along, 0)
        if plain:
            return RenderedView(color, depth, opacity, np.ones(opacity.shape, bool))
        stacked, mask = apply_lens(np.dstack([color, depth, opacity]).astype(np.float32), source, camera)
        return RenderedView(np.clip(stacked[..., :3], 0, 1), stacked[..., 3], np.clip(stacked[..., 4], 0, 1), mask)


@dataclass(frozen=True)
class ViewScores:
    """Scores of a field on posed pictures."""

    views: list[str]  # Names of the views; the lists below are in their order
    width: int  # Of the first view's picture, in pixels
    height: int
    spp: int  # Rays a pixel
    psnr: list[float]  # Of each view, in dB; NaN of one that its mask leaves nothing of
    ssim: list[float]  # Of each view; NaN of one that holds no window of 11 x 11 pixels
    # Of the right half of each view in dB, its colours fitted on the left half; NaN where it has no pixel.
    psnr_fitted: list[float]
    depth: DepthScore | None  # Means over the views with true depth; None where there are none

    @property
    def psnr_mean(self) -> float:
        """The mean over the views, in dB."""
        return mean_ignoring_nan(self.psnr)

    @property
    def psnr_fitted_mean(self) -> float:
        """The mean over the views whose colours could be fitted, in dB."""
        return mean_ignoring_nan(self.psnr_fitted)

    @property
    def ssim_mean(self) -> float:
        """The mean over the views that have one."""
        return mean_ignoring_nan(self.ssim)

    def to_dict(self) -> dict:
        """For JSON: the fields and the means; without ``depth`` where it is None."""
        names = ["views", "width", "height", "spp", "psnr", "psnr_mean", "ssim", "ssim_mean"]
        names += ["psnr_fitted", "psnr_fitted_mean"]
        out = {name: getattr(self, name) for name in names}
        return out if self.depth is None else out | {"depth": asdict(self.depth)}


def score_views(
    field: str | Path,
    views: list[PhotoView],
    spp: int = 16,
    picture_folder: Path | None = None,
    on_view: Callable[[str, float, float], None] = lambda name, psnr, ssim: None,
) -> ViewScores:
    """Scores of the field in a checkpoint on ``views``; writes each picture beside its truth into the folder
    ``pictures``. ``on_view`` is told each view's name, PSNR in dB and SSIM. Raises `NergError` without any view."""
    if not views:
        raise NergError("there are no views to score; the data set holds none out, so give --holdout 8 or --train")
    render, rows, depths = FieldRenderer(field, spp), [], []
    text: dict[str, str] = {}
    if picture_folder is not None:
        make_folder(picture_folder)
        text = make_provenance("nerg eval radiance", [field], None, {"spp": spp}).text()
    for k, view in enumerate(views):
        seen, truth = render(view.camera, k), view.composite_over(0)
        mask = seen.mask if view.mask is None else seen.mask & view.mask
        alpha = view.color[..., 3] if view.has_alpha else None
        fitted = color_corrected_psnr(seen.color, truth, alpha, mask)
        rows.append((psnr(seen.color, truth, mask), ssim(seen.color, truth, mask), fitted))
        if view.depth is not None:
            depths.append(compute_depth_score(seen.depth, seen.opacity, np.where(mask, view.depth, 0)))
        if picture_folder is not None:
            both = np.concatenate([seen.color, truth], axis=1)
            write_png(picture_folder / f"{Path(view.name).stem}.png", both, text)
        on_view(view.name, *rows[-1][:2])
    known = [d for d in depths if d is not None]
    return ViewScores(
        views=[v.name for v in views],
        width=views[0].shape[1],
        height=views[0].shape[0],
        spp=spp,
        psnr=[r[0] for r in rows],
        ssim=[r[1] for r in rows],
        psnr_fitted=[r[2] for r in rows],
        depth=_mean_depth_score(known) if known else None,
    )


def _mean_depth_score(scores: list[DepthScore]) -> DepthScore:
    return DepthScore(**{f.name: float(np.mean([getattr(d, f.name) for d in scores])) for f in fields(DepthScore)})


# ---- Scores of gaze densities, weighted by solid angle ----
#
# Definitions of saliency research (pysaliency, Kümmerer et al. 2018), which on a sphere need the solid angle of each
# direction: on a latitude-longitude picture the unweighted KLD of a known pair is 0.69 where the true one is 1.01.
#
# Maps are arrays (..., D), directions along the last axis; scores have the leading shape. ``weights`` (D,) or
# broadcastable: solid angles, in any unit; ``None`` says that all directions are of equal area. Everything is float64
# and defined: maps that are constant or zero give a number, not NaN.

EPS = 1e-20  # Of a map's mean: far below any density that matters, far above underflow


def kld(
    truth: np.ndarray, prediction: np.ndarray, weights: np.ndarray | None = None, *, eps: float = EPS
) -> np.ndarray:
    """Kullback-Leibler divergence KL(truth || prediction) in nats; 0 is best.

    Both are divided by their integral; negative values are lifted to zero by the map's minimum, as pysaliency does.
    ``eps``, in units of the uniform density, is added to both, and bounds what a prediction of zero costs: a sparse
    truth makes the score depend on it, so name it where it is not the default.
    """
    w = _shares(truth, prediction, weights)
    p, q = _relative(truth, w) + eps, _relative(prediction, w) + eps
    return np.sum(w * p * (np.log(p) - np.log(q)), axis=-1) / (1.0 + eps)


def cc(truth: np.ndarray, prediction: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Pearson's correlation with weighted means, in [-1, 1]; 0 when either map
    is constant (there is nothing to agree with)."""
    w = _shares(truth, prediction, weights)
    x, y = _standardised(truth, w), _standardised(prediction, w)
    return np.clip(np.sum(w * x * y, axis=-1), -1.0, 1.0)


def sim(truth: np.ndarray, prediction: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Histogram intersection of the two normalised densities, in [0, 1]; 1 is
    best. Not range-normalised first, as pysaliency and unlike Salient360."""
    w = _shares(truth, prediction, weights)
    return np.sum(w * np.minimum(_relative(truth, w), _relative(prediction, w)), axis=-1)


def mae(truth: np.ndarray, prediction: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Mean absolute difference over the sphere in the maps' unit, 1/sr; 4π times it is relative to uniform. Not
    normalised, so it sees a wrong integral; it grows with κ."""
    w = _shares(truth, prediction, weights)
    return np.sum(w * np.abs(np.asarray(truth, np.float64) - np.asarray(prediction, np.float64)), axis=-1)


def nss(density: np.ndarray, at_gaze: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Normalised scanpath saliency of each gaze: (value - mean) / standard deviation of the map (population, weighted).
    Average it over gazes.

    ``density`` (..., D); ``at_gaze`` (..., K): the map's values where people looked (rays or fixations, not a blurred
    map). Returns (..., K); 0 for a constant map.
    """
    w = _shares(density, density, weights)
    density, at_gaze = np.asarray(density, np.float64), np.asarray(at_gaze, np.float64)
    mean, deviation = _moments(density, w)
    return np.where(deviation > 0, (at_gaze - mean) / np.where(deviation > 0, deviation, 1.0), 0.0)


def _shares(a: np.ndarray, b: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    """Weights that sum to one along the last axis."""
    shape, other = np.shape(a), np.shape(b)
    if not shape or not other or shape[-1] != other[-1]:
        raise ValueError(f"maps of shape {shape} and {other} do not have the same directions along the last axis")
    if weights is None:
        return np.full(shape[-1], 1.0 / shape[-1])
    w = np.asarray(weights, dtype=np.float64)
    if w.shape[-1:] != shape[-1:] or not (w >= 0).all() or not (w.sum(axis=-1) > 0).all():
        raise ValueError(
            f"weights of shape {w.shape} must be non-negative solid angles of the {shape[-1]} directions, not all zero"
        )
    return w / w.sum(axis=-1, keepdims=True)


def _relative(density: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Density over its mean, that is in units of the uniform density of the same
    integral; a map of zeros is uniform."""
    density = np.asarray(density, dtype=np.float64)
    density = density - np.minimum(density.min(axis=-1, keepdims=True), 0.0)
    # Scaled by the maximum first: the mean of tiny values may underflow.
    top = density.max(axis=-1, keepdims=True)
    density = np.where(top > 0, density / np.where(top > 0, top, 1.0), 1.0)
    mean = np.sum(w * density, axis=-1, keepdims=True)
    return np.where(mean > 0, density / np.where(mean > 0, mean, 1.0), 1.0)


def _moments(values: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean and population standard deviation, (..., 1); a deviation within rounding of a constant is zero."""
    # In units of the largest: squares of the values themselves under- or overflow beyond 1e±154.
    top = _largest(values)
    values = values / top
    mean = np.sum(w * values, axis=-1, keepdims=True)
    deviation = np.sqrt(np.sum(w * (values - mean) ** 2, axis=-1, keepdims=True))
    return mean * top, np.where(deviation > 1e-13, deviation, 0.0) * top


def _largest(values: np.ndarray) -> np.ndarray:
    """Largest magnitude along the last axis, (..., 1); 1 where all are zero."""
    top = np.abs(values).max(axis=-1, keepdims=True)
    return np.where(top > 0, top, 1.0)


def _standardised(values: np.ndarray, w: np.ndarray) -> np.ndarray:
    values = np.asarray(values, dtype=np.float64)
    values = values / _largest(values)
    mean, deviation = _moments(values, w)
    return np.where(deviation > 0, (values - mean) / np.where(deviation > 0, deviation, 1.0), 0.0)
