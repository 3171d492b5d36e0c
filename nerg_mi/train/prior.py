"""Priors that do not depend on the position: of a gaze field, and of elevations, for a scene without tracking."""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import ModuleType
from typing import Annotated, cast

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.gaze import GazeField
from nerg_mi.environment.scene_loading import get_array_module
from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_base import add_prior_floor, make_prior_table, table_directions
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.kde import SphericalKde
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.maths.geometry import Box
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.maths.vmf import log_normaliser
from nerg_mi.photos.salience import SalienceView
from nerg_mi.progress import Progress, open_reporter
from nerg_mi.ranges import RAYS, SEEDS, check_ranges
from nerg_mi.tracking.dataset import hash_rays, open_rays
from nerg_mi.tracking.probes import compute_participant_weights
from nerg_mi.tracking.rays import Rays, merge_tracking

# ---- Position-independent prior: the gaze density averaged over all positions ----

DEFAULT_PRIOR_KAPPA = 30.0  # Concentration of its kernels
PRIOR_KAPPAS = (2.0, 5.0, 10.0, 20.0, 30.0, 50.0, 100.0)
"""Candidate concentrations of the prior's kernels."""
# Maximum numbers of rays in a prior, and of a participant's rays that it predicts, while its kernels are selected
_MAX_SELECTION_RAYS, _MAX_PARTICIPANT_RAYS = 1 << 14, 512
_MAX_PRIOR_RAYS = 1 << 16  # Maximum number of rays in the prior
_VIEWS_KAPPA = 50.0  # Concentration of the kernels that smooth a prior estimated from views
_LEAF_SIZE = 16  # Points per leaf of a KD-tree. The value decides ties between equally distant directions.
_ITERATIONS = 100  # Iterations of the estimate from views
_QUADRATURE_DIRECTIONS = 1 << 16  # Directions of the quadrature that normalises the table


def check_prior_kappa(rows: int, kappa: float | None) -> None:
    """Raise `NergError` if kernels of concentration ``kappa`` are narrower than half a texel of a table of ``rows``
    rows.
    """
    if kappa is not None and kappa > (max_kappa := (2 * rows / np.pi) ** 2):
        raise NergError(
            f"the position-independent prior is stored in a table of {rows} rows, which does not resolve kernels of "
            f"concentration {kappa:g}; use a concentration of at most {max_kappa:.0f}"
        )


def make_prior_from_rays(
    rays: Rays,
    rows: int,
    geometry: Environment | None = None,
    seed: int = 0,
    weights: str = "equal",
    kappa: float | None = None,
) -> np.ndarray:
    """Estimate the position-independent prior from gaze rays by kernel density estimation.

    Parameters
    ----------
    rays : Rays
        Gaze rays, in their own frame.
    rows : int
        Rows of the table.
    geometry : Environment, optional
        Its frame is the frame of the table. Default: the frame of the rays.
    seed : int
        Seed of the subsample of rays.
    weights : str
        ``"person"`` gives each participant the same total weight; other values weight each ray equally.
    kappa : float, optional
        Concentration of each ray's kernel; see `check_prior_kappa`.

    Returns
    -------
    numpy.ndarray
        Table (rows, 2 rows) as returned by ``fields.gaze_base.make_prior_table``.
    """
    check_prior_kappa(rows, kappa)
    subset = np.random.default_rng(seed).permutation(len(rays))[:_MAX_PRIOR_RAYS]
    ray_weights = compute_participant_weights(rays)[subset] if weights == "person" else None
    kappa = DEFAULT_PRIOR_KAPPA if kappa is None else kappa
    kde = SphericalKde(rays.direction[subset], np.array([0, len(subset)]), kappa, ray_weights)
    directions = table_directions(rows)
    density = kde.evaluate(directions if geometry is None else geometry.directions_to_rays(directions))[0]
    return make_prior_table(density, rows, kde.ns, fibonacci_directions(_QUADRATURE_DIRECTIONS))


def select_prior_kappa(rays: Rays, weights: str = "equal", seed: int = 0) -> float:
    """Select the concentration of the prior's kernels by leaving out participants.

    The prior of the other participants predicts each participant; with one, the first half of the rays in time predicts
    the second. The result is the geometric mean of the best of `PRIOR_KAPPAS` and `DEFAULT_PRIOR_KAPPA`: the best one
    alone varies with the training participants more than with those who are predicted.

    Parameters
    ----------
    rays : Rays
        Training rays.
    weights : str
        Weights of the rays in the prior (`make_prior_from_rays`).
    seed : int
        Seed of the subsamples.
    """
    participants, rng = np.unique(rays.person), np.random.default_rng(seed)
    tests = [rays.person == p for p in participants] if len(participants) > 1 else [rays.t > np.median(rays.t)]
    scores = []
    for test in tests:
        if test.all() or not test.any():
            continue
        held_out = rays.direction[rng.permutation(np.flatnonzero(test))[:_MAX_PARTICIPANT_RAYS]]
        train = rays.select(np.sort(rng.permutation(np.flatnonzero(~test))[:_MAX_SELECTION_RAYS]))
        ray_weights = compute_participant_weights(train) if weights == "person" else None
        mixture = np.array([0, len(train)])
        density = [SphericalKde(train.direction, mixture, k, ray_weights).evaluate(held_out)[0] for k in PRIOR_KAPPAS]
        scores.append(np.log(add_prior_floor(np.array(density, np.float64))).mean(axis=1))
    best = PRIOR_KAPPAS[int(np.mean(scores, axis=0).argmax())] if scores else DEFAULT_PRIOR_KAPPA
    return float(np.sqrt(best * DEFAULT_PRIOR_KAPPA))


def make_prior_from_views(views: Sequence[SalienceView], rows: int) -> np.ndarray:
    """Estimate the position-independent prior from salience views, each of which covers a part of the sphere.

    Returns a table (rows, 2 rows) as ``fields.gaze_base.make_prior_table`` does.

    Notes
    -----
    The estimate b maximises the likelihood if view v samples b conditioned on its visible part. It is found with the
    minorise-maximise iteration of Hunter (2004) for the Bradley-Terry and Plackett-Luce models: b = Σ_v p_v / Σ_v 1_v /
    b(v). One additional uniform view of the whole sphere connects views that do not overlap. Directions outside every
    view take the value of the nearest direction inside one.
    """
    from scipy.spatial import KDTree

    directions = table_directions(rows)
    # Solid angles of the latitude bands, which sum to exactly 4π.
    edges = np.cos(np.arange(rows + 1) * np.pi / rows)
    area = np.repeat((edges[:-1] - edges[1:]) * np.pi / rows, 2 * rows)
    density, is_visible = np.empty((len(views), len(area)), np.float32), np.empty((len(views), len(area)), bool)
    for k, view in enumerate(views):
        # Reduce the view so that its pixels are not finer than the texels.
        density[k], is_visible[k] = view.reduce(max(1, round(view.total_solid_angle / area.max()))).evaluate(directions)
    # A view that falls between the texel centres contributes nothing.
    visible_gaze = density @ area
    is_visible &= visible_gaze[:, None] > 0
    target = (density / np.maximum(visible_gaze, 1e-30)[:, None]).sum(axis=0, dtype=np.float64) + 1 / (4 * np.pi)
    prior = np.full(len(area), 1 / (4 * np.pi))
    for _ in range(_ITERATIONS):
        visible_prior = is_visible @ (prior * area)
        prior = target / (is_visible.T @ (1 / np.maximum(visible_prior, 1e-30) * (visible_prior > 0)) + 1)
        prior /= prior @ area
    is_covered = is_visible.any(axis=0)
    if is_covered.any():
        prior = prior[
            np.flatnonzero(is_covered)[KDTree(directions[is_covered], leafsize=_LEAF_SIZE).query(directions)[1]]
        ]
    kde = SphericalKde(directions, np.array([0, len(area)]), _VIEWS_KAPPA, prior * area)
    return make_prior_table(kde.evaluate(directions)[0], rows, kde.ns, fibonacci_directions(_QUADRATURE_DIRECTIONS))


# ---- Elevation prior ----
#
# A gaze field for an environment without recordings: the distribution of the gaze elevation in other environments.
#
# Among the candidates tried, only the elevation transfers between environments (docs/how-to/evaluation.md): laws
# of distance or incidence fitted in other environments predict gaze worse.

ELEVATION_KAPPA = 30.0  # Concentration of the kernel of a ray
ELEVATION_PRIOR = "prior"  # Recipe in the provenance of such a field
# Bins of the sine of the elevation
_NUM_BINS = 2048


def compute_elevation_density(
    environments: Sequence[Rays], sine: np.ndarray, kappa: float = ELEVATION_KAPPA
) -> np.ndarray:
    """Estimate the gaze density as a function of the elevation only.

    Parameters
    ----------
    environments : sequence of Rays
        Gaze rays of each environment, z up. Environments have equal weight, and so have the participants of an
        environment.
    sine : numpy.ndarray
        Sine of the elevation (N,) at which to evaluate.
    kappa : float
        Concentration of the von Mises-Fisher kernel of a ray.

    Returns
    -------
    numpy.ndarray
        Density (N,) in 1/sr.

    Notes
    -----
    The mean over azimuths of a von Mises-Fisher density of concentration κ about a direction with sine t is C(κ) exp(κ
    (s t - 1)) I₀(κ √(1 - s²) √(1 - t²)), with C of `maths.vmf`. `ive` is the exponentially scaled I₀.
    """
    from scipy.special import ive

    histogram = np.zeros(_NUM_BINS)
    for rays in environments:
        weights = compute_participant_weights(rays) / len(rays) / len(environments)
        histogram += np.histogram(rays.direction[:, 2], _NUM_BINS, (-1, 1), weights=weights)[0]
    t, s = (np.arange(_NUM_BINS) + 0.5) * 2 / _NUM_BINS - 1, np.asarray(sine, np.float64)[:, None]
    across = np.sqrt(np.maximum(1 - s**2, 0)) * np.sqrt(1 - t**2)
    return np.exp(log_normaliser(kappa) + kappa * (s * t + across - 1)) * ive(0, kappa * across) @ histogram


def make_elevation_prior(environments: Sequence[Rays], ns: ModuleType) -> LogGazeField:
    """Make a gaze field that is the elevation density of ``environments`` at every observer position.

    It can be used in any environment whose z axis points up, in any unit of length. ``ns`` is the Dr.Jit backend.
    """
    # The prior weight is 1: the networks exist but have no influence.
    grid = HashGridConfig(levels=1, log2_rows=4, base=2, finest=2)
    config = LogGazeConfig(grid=grid, variant="emit", width=8, layers=1, geometry="none", mix=1.0)
    rows = config.prior
    # Evaluate one texel per row; the density is the same in all columns.
    density = np.repeat(compute_elevation_density(environments, table_directions(rows)[:: 2 * rows, 2]), 2 * rows)
    table = make_prior_table(density, rows, ns, fibonacci_directions(_QUADRATURE_DIRECTIONS))
    return LogGazeField.random(config, Box((-1.0,) * 3, (1.0,) * 3), ns, prior=table)


@check_ranges
def train_prior(
    rays: Rays | FilePath | Sequence[Rays | FilePath],
    *,
    max_samples: Annotated[int, RAYS] = 10_000_000,
    seed: Annotated[int, SEEDS] = 0,
    progress: Progress = None,
) -> GazeField:
    """Fit an elevation prior on recordings in other scenes, for a scene without tracking.

    The prior is the distribution of gaze elevation over participants, the same at every position. It is valid in any
    scene whose z axis points up.

    Parameters
    ----------
    rays : Rays, path, or sequence of these
        Rays files (.npz or .parquet) or datasets (.rays), one for each scene. Scenes have equal weights, and so have
        participants within a scene.
    max_samples : int
        Maximum number of samples read from a dataset; larger datasets are subsampled uniformly with ``seed``.
    seed : int
        Seed of the subsampling.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    GazeField
        The gaze field.

    Raises
    ------
    NergError
        There are no rays, or an argument is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> prior = nerg.train_prior(rays)  # or a list of recordings, one per environment
    >>> prior.kind, len(prior.provenance["places"])
    ('gaze', 1)
    """
    sources = cast("Sequence[Rays | FilePath]", rays if isinstance(rays, (list, tuple)) else [rays])
    if not sources:
        raise NergError("a prior needs rays of other scenes: give at least one file")
    recordings, files = [], []
    with open_reporter(progress) as reporter:
        for k, source in enumerate(sources):
            reporter.progress(k / len(sources), "reading rays")
            entry = {} if isinstance(source, Rays) else {"file": to_path(source).name, "sha256": hash_rays(source)}
            data = open_rays(source, max_samples, seed)
            recordings.append(data)
            files.append({**entry, "rays": len(data), "persons": len(data.persons), "tracking": data.tracking})
        if empty := [str(k + 1) for k, data in enumerate(recordings) if not len(data)]:
            raise NergError(f"there are no rays in file {', '.join(empty)} of those given; leave it out")
        field = make_elevation_prior(recordings, get_array_module())
        participants = sum(entry["persons"] for entry in files)
        reporter.message(
            f"distribution of gaze elevation of {participants} participants in {len(files)} "
            f"scene{'' if len(files) == 1 else 's'}, independent of position"
        )
    provenance = {
        "recipe": ELEVATION_PRIOR,
        "kappa": ELEVATION_KAPPA,
        "places": files,
        "tracking": merge_tracking(data.tracking for data in recordings),
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    return GazeField(field, provenance)
