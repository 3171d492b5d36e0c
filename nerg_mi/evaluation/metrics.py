"""Metrics of images and of densities over directions."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.environment.contents import FieldVolume
from nerg_mi.environment.radiance import RadianceField
from nerg_mi.errors import NergError, parameter, translate_mitsuba_errors
from nerg_mi.figures.overlay import srgb, write_png
from nerg_mi.figures.style import existing_files, make_provenance
from nerg_mi.files.atomic import make_folder
from nerg_mi.files.dataframes import ResultTables
from nerg_mi.files.names import make_portable_names
from nerg_mi.files.tables import add_notes, write_json
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.maths.arrays import check_weights
from nerg_mi.maths.color import color_corrected_psnr, mean_ignoring_nan, psnr
from nerg_mi.photos.cameras import PosedCamera, make_sensor_dict, pixel_directions
from nerg_mi.photos.images import PhotoView, apply_lens, make_pinhole_camera

# ---- Images ----
#
# Quality of a radiance field's renderings compared with posed photos: PSNR, SSIM, depth.
#
# Renderings use the `nerg` integrator with its defaults, through ``mi.render``. A photo with lens distortion is not
# resampled; the lens is applied to the rendering.


# Wang et al. 2004: window of 11 x 11 pixels, Gaussian with σ = 1.5; constants for values in 0..1.
_RADIUS, _SIGMA, _C1, _C2 = 5, 1.5, 0.01**2, 0.03**2


def ssim(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Compute the structural similarity (Wang et al. 2004) of values in 0..1, (h, w, c), averaged over channels.

    The mean is over the windows inside the picture and ``mask`` (h, w), if given; NaN if there are none.
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
    is_inside = (
        np.ones((height, width), bool) if mask is None else np.asarray(minimum_filter(mask, 2 * _RADIUS + 1), bool)
    )
    inner = (slice(_RADIUS, -_RADIUS),) * 2
    scores = score[inner][is_inside[inner]]
    return float(scores.mean()) if scores.size else float("nan")


@dataclass(frozen=True)
class DepthScore:
    """Depth errors over pixels with known depth.

    ``median`` and ``mean`` are absolute errors in scene units. ``outlier_fraction`` is the fraction of pixels whose
    error exceeds 10 % of the known depth, or which have no surface. ``opacity`` is the mean opacity, and
    ``translucent_fraction`` the fraction of pixels with an opacity below 0.9.
    """

    median: float
    mean: float
    outlier_fraction: float
    opacity: float
    translucent_fraction: float


def compute_depth_score(depth: np.ndarray, opacity: np.ndarray, truth: np.ndarray) -> DepthScore | None:
    """Score ``depth`` (h, w), 0 where there is none, against ``truth`` (h, w), 0 where unknown; None if no depth is
    known.
    """
    has_truth = truth > 0
    if not has_truth.any():
        return None
    # A hole counts with its depth of 0.
    error = np.abs(depth[has_truth] - truth[has_truth])
    alpha = opacity[has_truth]
    return DepthScore(
        float(np.median(error)),
        float(error.mean()),
        float(np.mean(error > 0.1 * truth[has_truth])),
        float(alpha.mean()),
        float(np.mean(alpha < 0.9)),
    )


@dataclass(frozen=True)
class RenderedView:
    """Rendering of a view.

    ``color`` (h, w, 3) is sRGB over black, composited as a photo with alpha; ``depth`` (h, w) the integrator's default,
    the median, from the camera centre in scene units; ``opacity`` (h, w); ``mask`` the pixels that could be rendered.
    """

    color: np.ndarray
    depth: np.ndarray
    opacity: np.ndarray
    mask: np.ndarray


_MAX_LAUNCH = 1 << 23  # Maximum samples per launch, to limit memory


class FieldRenderer:
    """Renders a radiance field, or its file, with the cameras of a data set. Needs a Mitsuba variant."""

    def __init__(self, field: RadianceField | FilePath, spp: int = 16):
        import mitsuba as mi

        self.spp = spp
        with translate_mitsuba_errors(None if isinstance(field, RadianceField) else field):
            integrator = {"type": "nerg", "field": FieldVolume(field, "field").load(), "aovs": "depth,opacity"}
            self.scene = mi.load_dict({"type": "scene", "integrator": integrator})

    def __call__(self, camera: PosedCamera, seed: int = 0) -> RenderedView:
        """Render the view of ``camera`` with ``spp`` rays per pixel."""
        import drjit as dr
        import mitsuba as mi

        i = camera.intrinsics
        is_pinhole = not i.is_distorted and abs(i.fx / i.fy - 1) < 1e-9
        source = camera if is_pinhole else make_pinhole_camera(camera)
        sensor_params = make_sensor_dict(source)
        sensor_params["sampler"] = {"type": "multijitter", "sample_count": self.spp}
        with translate_mitsuba_errors():
            sensor = mi.load_dict(sensor_params)
        params = mi.traverse(sensor)
        to_world: Any = params["to_world"]
        # Literal poses would compile kernels for each camera.
        pose = mi.Transform4f(to_world)
        dr.make_opaque(pose)
        params["to_world"] = pose
        params.update()
        launch_spp = max(_MAX_LAUNCH // (source.intrinsics.width * source.intrinsics.height), 1)
        out = np.zeros(())
        for first in range(0, self.spp, launch_spp):
            count = min(launch_spp, self.spp - first)
            with translate_mitsuba_errors():
                part = mi.render(self.scene, sensor=sensor, spp=count, seed=mi.UInt32(seed + first))
                out = out + np.array(part, np.float64) * (count / self.spp)
            # Mitsuba handles Ctrl-C while it renders.
            if self.scene.integrator().should_stop():
                raise KeyboardInterrupt
        opacity = np.clip(out[..., 4], 0, 1)
        safe_opacity = np.maximum(opacity, 1e-6)[..., None]
        color = opacity[..., None] * srgb(out[..., :3] / safe_opacity)
        # Rays start at the near plane, and depth is measured from there.
        along = -pixel_directions(source.intrinsics)[..., 2]
        depth = np.where(opacity > 0, out[..., 3] + sensor_params["near_clip"] / along, 0)
        if is_pinhole:
            return RenderedView(color, depth, opacity, np.ones(opacity.shape, bool))
        stacked, mask = apply_lens(np.dstack([color, depth, opacity]).astype(np.float32), source, camera)
        return RenderedView(np.clip(stacked[..., :3], 0, 1), stacked[..., 3], np.clip(stacked[..., 4], 0, 1), mask)


_NO_SCORE = {
    "psnr": "all pixels are masked",
    "ssim": f"no window of {2 * _RADIUS + 1} x {2 * _RADIUS + 1} pixels without masked ones",
    "psnr_fitted": "all pixels of a half are masked",
}


@dataclass(frozen=True, repr=False)
class ViewScores(ResultTables):
    """Scores of a field on posed photos."""

    TABLES = ("rows",)

    views: list[str]  # Names of the views, in the order of the lists below
    width: int  # Size of the first photo in pixels
    height: int
    spp: int  # Rays per pixel
    psnr: list[float]  # PSNR of each view in dB; NaN if fully masked
    ssim: list[float]  # SSIM of each view; NaN if it has no window of 11 x 11 pixels
    # PSNR of the right half of each view in dB after fitting its colours on the left half; NaN without pixels.
    psnr_fitted: list[float]
    # Means over the views with true depth that did not choose the state; None if there are none.
    depth: DepthScore | None
    # Names of those ``views`` that chose the state of the field; they have means of their own.
    validation: list[str] = field(default_factory=list)
    # Names of the field and of the photos.
    field_name: str = ""
    dataset: str = ""

    @property
    def rows(self) -> list[dict]:
        """One row per view, with whether it chose the state; the ``note`` says why scores are missing."""
        columns = self.views, self.psnr, self.ssim, self.psnr_fitted, [v in self.validation for v in self.views]
        names = "view", "psnr", "ssim", "psnr_fitted", "chose_state"
        rows: list[dict[str, Any]] = [dict(zip(names, row)) for row in zip(*columns)]
        add_notes(rows, lambda row, column: (column, _NO_SCORE.get(column, "")))
        return rows

    @property
    def psnr_mean(self) -> float:
        """Mean over the views in dB, except those that chose the state."""
        return self._compute_mean(self.psnr)

    @property
    def psnr_fitted_mean(self) -> float:
        """Mean with fitted colours in dB, over the same views."""
        return self._compute_mean(self.psnr_fitted)

    @property
    def ssim_mean(self) -> float:
        """Mean over those of the same views that have windows."""
        return self._compute_mean(self.ssim)

    @property
    def validation_means(self) -> dict[str, float]:
        """Means of ``psnr``, ``ssim`` and ``psnr_fitted`` over the views that chose the state."""
        return {name: self._compute_mean(getattr(self, name), True) for name in ("psnr", "ssim", "psnr_fitted")}

    def _compute_mean(self, scores: list[float], is_validation: bool = False) -> float:
        return mean_ignoring_nan([s for v, s in zip(self.views, scores) if (v in self.validation) == is_validation])

    def save(self, path: FilePath) -> Path:
        """Write the scores, their means and notes on missing scores (.json), with the depth error if there is one.

        Raises `NergError` if the file cannot be written.
        """
        names = ["dataset", "views", "width", "height", "spp", "psnr", "psnr_mean", "ssim", "ssim_mean"]
        names += ["psnr_fitted", "psnr_fitted_mean", "validation", "validation_means"]
        out = {"field": self.field_name} | {name: getattr(self, name) for name in names}
        out |= {"notes": [row["note"] for row in self.rows]}
        write_json(to_path(path), out if self.depth is None else out | {"depth": asdict(self.depth)})
        return to_path(path)


def score_views(
    field: RadianceField | FilePath,
    views: list[PhotoView],
    spp: int = 16,
    picture_folder: Path | None = None,
    on_view: Callable[[str, float, float], None] = lambda name, psnr, ssim: None,
    validation: Collection[str] = (),
) -> ViewScores:
    """Score a radiance field on ``views``.

    Parameters
    ----------
    field : RadianceField or path
        The radiance field.
    views : list of PhotoView
        Posed photos.
    spp : int
        Rays per pixel.
    picture_folder : Path, optional
        Folder for pictures of each rendering, with the photo to its right.
    on_view : callable
        Called with the name, PSNR in dB and SSIM of each view.
    validation : collection of str
        Names of views that chose the state of the field, which may include others than ``views``.

    Raises
    ------
    NergError
        If there are no views.
    """
    if not views:
        raise NergError(
            f"the data set has no held-out views to score; use {parameter('holdout', 8)}, or "
            f"{parameter('train', True)} to score training views"
        )
    render, rows, depths = FieldRenderer(field, spp), [], []
    text: dict[str, str] = {}
    if picture_folder is not None:
        make_folder(picture_folder)
        text = make_provenance(
            "nerg eval radiance", existing_files(getattr(field, "path", field)), None, {"spp": spp}
        ).text()
    names = make_portable_names(Path(view.name).stem for view in views)
    for k, view in enumerate(views):
        rendered, truth = render(view.camera, k), view.composite_over(0)
        mask = rendered.mask if view.mask is None else rendered.mask & view.mask
        alpha = view.color[..., 3] if view.has_alpha else None
        fitted = color_corrected_psnr(rendered.color, truth, alpha, mask)
        rows.append((psnr(rendered.color, truth, mask), ssim(rendered.color, truth, mask), fitted))
        if view.depth is not None and view.name not in validation:
            depths.append(compute_depth_score(rendered.depth, rendered.opacity, np.where(mask, view.depth, 0)))
        if picture_folder is not None:
            both = np.concatenate([rendered.color, truth], axis=1)
            write_png(picture_folder / f"{names[k]}.png", both, text)
        on_view(view.name, *rows[-1][:2])
    depth_scores = [d for d in depths if d is not None]
    return ViewScores(
        views=[v.name for v in views],
        width=views[0].shape[1],
        height=views[0].shape[0],
        spp=spp,
        psnr=[r[0] for r in rows],
        ssim=[r[1] for r in rows],
        psnr_fitted=[r[2] for r in rows],
        depth=_mean_depth_score(depth_scores) if depth_scores else None,
        validation=[v.name for v in views if v.name in validation],
    )


def _mean_depth_score(scores: list[DepthScore]) -> DepthScore:
    return DepthScore(**{f.name: float(np.mean([getattr(d, f.name) for d in scores])) for f in fields(DepthScore)})


# ---- Scores of gaze densities, weighted by solid angle ----
#
# Definitions of saliency research (pysaliency, Kümmerer et al. 2018), weighted by the solid angle of each direction: on
# a latitude-longitude picture the unweighted KLD of a test pair is 0.69 instead of the correct 1.01.
#
# Maps are arrays (..., D) with directions along the last axis; scores have the leading shape. ``weights`` (D,) or
# broadcastable are solid angles in any unit; ``None`` means equal areas. All results are float64 and finite: constant
# and zero maps give a number, not NaN.

EPS = 1e-20  # Relative to the mean of a map: far below any relevant density, far above underflow


def kld(
    truth: np.ndarray, prediction: np.ndarray, weights: np.ndarray | None = None, *, eps: float = EPS
) -> np.ndarray:
    """Compute the Kullback-Leibler divergence KL(truth || prediction) in nats; 0 is best.

    Both are normalised to their integral after shifting negative values to zero by the minimum of the map, as in
    pysaliency. ``eps``, relative to the uniform density, is added to both and bounds the penalty of a zero prediction.
    With a sparse truth the score depends on it, so state it if it is not the default.
    """
    w = _normalise_weights(truth, prediction, weights)
    p, q = _normalise_density(truth, w) + eps, _normalise_density(prediction, w) + eps
    return np.sum(w * p * (np.log(p) - np.log(q)), axis=-1) / (1.0 + eps)


def cc(truth: np.ndarray, prediction: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Compute Pearson's correlation with weighted means, in [-1, 1]; 0 if either map is constant."""
    w = _normalise_weights(truth, prediction, weights)
    x, y = _standardise(truth, w), _standardise(prediction, w)
    return np.clip(np.sum(w * x * y, axis=-1), -1.0, 1.0)


def sim(truth: np.ndarray, prediction: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Compute the histogram intersection of the normalised densities, in [0, 1]; 1 is best.

    Maps are not range-normalised first, as in pysaliency and unlike Salient360.
    """
    w = _normalise_weights(truth, prediction, weights)
    return np.sum(w * np.minimum(_normalise_density(truth, w), _normalise_density(prediction, w)), axis=-1)


def mae(truth: np.ndarray, prediction: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Compute the mean absolute difference over the sphere in the unit of the maps, 1/sr; times 4π it is relative to
    uniform.

    Maps are not normalised, so a wrong integral counts; the value grows with κ.
    """
    w = _normalise_weights(truth, prediction, weights)
    return np.sum(w * np.abs(np.asarray(truth, np.float64) - np.asarray(prediction, np.float64)), axis=-1)


def nss(density: np.ndarray, at_gaze: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Compute the normalised scanpath saliency of each gaze sample: (value - mean) / standard deviation of the map.

    Parameters
    ----------
    density : numpy.ndarray
        Map (..., D).
    at_gaze : numpy.ndarray
        Values (..., K) of the map at gaze samples (rays or fixations, not a blurred map).
    weights : numpy.ndarray, optional
        Solid angles.

    Returns
    -------
    numpy.ndarray
        Scores (..., K) to be averaged over samples; 0 for a constant map.
    """
    w = _normalise_weights(density, density, weights)
    density, at_gaze = np.asarray(density, np.float64), np.asarray(at_gaze, np.float64)
    mean, deviation = _compute_moments(density, w)
    return np.where(deviation > 0, (at_gaze - mean) / np.where(deviation > 0, deviation, 1.0), 0.0)


def auc(at_gaze: np.ndarray, values: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Compute the area under the ROC curve of each gaze sample: the fraction of ``values`` below its value.

    Parameters
    ----------
    at_gaze : numpy.ndarray
        Values (K,) of a map at gaze samples.
    values : numpy.ndarray
        Values (M,) of the map everywhere (AUC-Judd with a threshold at each value), or at nonfixations (sAUC).
    weights : numpy.ndarray, optional
        Solid angles (M,) of the values.

    Returns
    -------
    numpy.ndarray
        Fractions (K,) to be averaged over samples; ties count half.
    """
    values = np.asarray(values, np.float64)
    w = _normalise_weights(values, values, weights)
    order = np.argsort(values, kind="stable")
    cumulative = np.r_[0.0, np.cumsum(w[order])]
    position = lambda side: np.searchsorted(values[order], np.asarray(at_gaze, np.float64), side)
    return 0.5 * (cumulative[position("left")] + cumulative[position("right")])


def information_gain(at_gaze: np.ndarray, prior_at_gaze: np.ndarray) -> np.ndarray:
    """Compute the information gain of each gaze sample in bits: the log2 of its density over that of the baseline.

    Both densities (...) are normalised; a density of 0 counts as ``EPS``.
    """
    gain = np.log2(np.maximum(at_gaze, EPS)) - np.log2(np.maximum(prior_at_gaze, EPS))
    return np.asarray(gain, np.float64)


def _normalise_weights(a: np.ndarray, b: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    """Return weights that sum to one along the last axis."""
    shape, other = np.shape(a), np.shape(b)
    if not shape or not other or shape[-1] != other[-1]:
        raise ValueError(f"maps of shape {shape} and {other} must have the same directions along the last axis")
    if weights is None:
        return np.full(shape[-1], 1.0 / shape[-1])
    w = check_weights(weights, shape[-1])
    return w / w.sum(axis=-1, keepdims=True)


def _normalise_density(density: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the density relative to the uniform density of the same integral; a map of zeros is uniform."""
    density = np.asarray(density, dtype=np.float64)
    if np.isinf(density).any():
        raise NergError("a map of a score has an infinite value; it must be finite")
    density = density - np.minimum(density.min(axis=-1, keepdims=True), 0.0)
    # Scale by the maximum first, because the mean of tiny values may underflow.
    top = density.max(axis=-1, keepdims=True)
    density = np.where(top > 0, density / np.where(top > 0, top, 1.0), 1.0)
    mean = np.sum(w * density, axis=-1, keepdims=True)
    return np.where(mean > 0, density / np.where(mean > 0, mean, 1.0), 1.0)


def _compute_moments(values: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted mean and population standard deviation, (..., 1).

    A deviation within the rounding error of a constant is zero.
    """
    # Relative to the largest value, because squares of values beyond 1e±154 under- or overflow.
    top = _max_magnitude(values)
    values = values / top
    mean = np.sum(w * values, axis=-1, keepdims=True)
    deviation = np.sqrt(np.sum(w * (values - mean) ** 2, axis=-1, keepdims=True))
    return mean * top, np.where(deviation > 1e-13, deviation, 0.0) * top


def _max_magnitude(values: np.ndarray) -> np.ndarray:
    """Return the largest magnitude along the last axis, (..., 1); 1 if all are zero."""
    top = np.abs(values).max(axis=-1, keepdims=True)
    return np.where(top > 0, top, 1.0)


def _standardise(values: np.ndarray, w: np.ndarray) -> np.ndarray:
    values = np.asarray(values, dtype=np.float64)
    values = values / _max_magnitude(values)
    mean, deviation = _compute_moments(values, w)
    return np.where(deviation > 0, (values - mean) / np.where(deviation > 0, deviation, 1.0), 0.0)
