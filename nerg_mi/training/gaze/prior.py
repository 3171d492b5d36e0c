"""A gaze field for a place where nobody was tracked: how high people look, learnt in other places.

Of what was tried, the elevation alone carries over from place to place (docs/gaze-evaluation.md): laws of distance,
incidence and the like that were learnt in some places say less in others than it does.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

import numpy as np

from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField, blind_table, table_directions
from nerg_mi.maths.geometry import Box
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.maths.vmf import log_normaliser
from nerg_mi.probes.probes import person_weights
from nerg_mi.rays.rays import Rays

KAPPA = 30.0
"""Concentration of the kernel of a ray."""
# Bins of the sine of the elevation; directions over which the table is scaled to integrate to one.
_BINS, _SCALED_OVER = 2048, 1 << 16


def elevation_density(places: Sequence[Rays], sine: np.ndarray, kappa: float = KAPPA) -> np.ndarray:
    """Density (N,), 1/sr, of a direction whose elevation has ``sine`` (N,): the kernel density of the rays of
    ``places``, each turned to every azimuth alike. Places count alike, and people within a place.

    The mean over azimuths of a von Mises-Fisher density of concentration ``kappa`` about a direction of sine t is
    C(κ) exp(κ (s t - 1)) I₀(κ √(1 - s²) √(1 - t²)), `maths.vmf`'s C; `ive` is I₀ with its exponent taken out.
    """
    from scipy.special import ive

    share = np.zeros(_BINS)
    for rays in places:
        weights = person_weights(rays) / len(rays) / len(places)
        share += np.histogram(rays.direction[:, 2], _BINS, (-1, 1), weights=weights)[0]
    t, s = (np.arange(_BINS) + 0.5) * 2 / _BINS - 1, np.asarray(sine, np.float64)[:, None]
    across = np.sqrt(np.maximum(1 - s**2, 0)) * np.sqrt(1 - t**2)
    return np.exp(log_normaliser(kappa) + kappa * (s * t + across - 1)) * ive(0, kappa * across) @ share


def prior_field(places: Sequence[Rays], ns: ModuleType) -> LogGazeField:
    """A gaze field that is `elevation_density` of ``places`` wherever an observer stands, with arrays of the backend
    ``ns``: in any place whose z axis points up, of any unit of length."""
    # All of it is the blind density: a network is there, and counts for nothing.
    grid = HashGridConfig(levels=1, log2_rows=4, base=2, finest=2)
    config = LogGazeConfig(grid=grid, variant="emit", width=8, layers=1, geometry="none", mix=1.0)
    rows = config.prior
    # One row of texels, for all columns.
    density = np.repeat(elevation_density(places, table_directions(rows)[:: 2 * rows, 2]), 2 * rows)
    table = blind_table(density, rows, ns, fibonacci_directions(_SCALED_OVER))
    return LogGazeField.random(config, Box((-1.0,) * 3, (1.0,) * 3), ns, prior=table)
