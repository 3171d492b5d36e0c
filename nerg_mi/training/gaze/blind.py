"""The blind density that a log-density gaze field begins with: what people look at wherever they stand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_log_density import blind_table, table_directions
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.photos.salience import SalienceView
from nerg_mi.probes.kde import SphericalKde
from nerg_mi.probes.probes import person_weights
from nerg_mi.rays.rays import Rays
from nerg_mi.training.geometry.places import GazePlace

# Rays that it is made of at most.
_MOST_RAYS = 1 << 16
# Concentration of the kernels that smooth the density of views.
_VIEWS_KAPPA = 50.0
# Points in a leaf of a KD-tree, which decides between directions that are equally far.
_LEAF = 16
# Rounds of the iteration that puts it together from them.
_ROUNDS = 100
# Directions over which the table is scaled to integrate to one.
_SCALED_OVER = 1 << 16


def check_kernels(rows: int, kappa: float) -> None:
    """Raise `NergError` where kernels of this concentration are narrower than half a texel of a table of ``rows``."""
    if kappa > (most := (2 * rows / np.pi) ** 2):
        raise NergError(
            f"the blind density is kept in a table of {rows} rows, between which kernels of a concentration of "
            f"{kappa:g} vanish; let it be at most {most:.0f}"
        )


def blind_of_rays(
    rays: Rays, rows: int, place: GazePlace | None = None, seed: int = 0, weights: str = "equal", kappa: float = 10.0
) -> np.ndarray:
    """``fields.gaze_log_density.blind_table`` (rows, 2 rows) of where ``rays`` go, in the frame of ``place`` (None:
    that of the rays). ``weights``: with ``person`` all people count alike, however many rays are theirs; ``kappa``:
    concentration of the kernel of each ray; see `check_kernels`."""
    check_kernels(rows, kappa)
    which = np.random.default_rng(seed).permutation(len(rays))[:_MOST_RAYS]
    each = person_weights(rays)[which] if weights == "person" else None
    kde = SphericalKde(rays.direction[which], np.array([0, len(which)]), kappa, each)
    directions = table_directions(rows)
    density = kde.evaluate(directions if place is None else place.directions_to_rays(directions))[0]
    return blind_table(density, rows, kde.ns, fibonacci_directions(_SCALED_OVER))


def blind_of_views(views: Sequence[SalienceView], rows: int) -> np.ndarray:
    """``fields.gaze_log_density.blind_table`` (rows, 2 rows) of what is looked at wherever the camera stands, of which
    each of ``views`` shows a part.

    The density b of greatest likelihood when view v sees b given its part, found by Hunter's (2004) iteration for
    choices among a few: b = Σ_v p_v / Σ_v 1_v / b(v). One more view, of the whole sphere, is uniform: it links those
    that share nothing. What no view shows is looked at as what lies next to it is.
    """
    from scipy.spatial import KDTree

    directions = table_directions(rows)
    # Of the rows' bands, not of the texels' centres: they sum to 4π.
    edges = np.cos(np.arange(rows + 1) * np.pi / rows)
    area = np.repeat((edges[:-1] - edges[1:]) * np.pi / rows, 2 * rows)
    density, known = np.empty((len(views), len(area)), np.float32), np.empty((len(views), len(area)), bool)
    for k, view in enumerate(views):
        # Texels are coarse: a view's pixels should not be finer than they are.
        density[k], known[k] = view.reduced(max(1, round(view.extent / area.max()))).look_up(directions)
    # What lies between the texels' centres is not seen.
    found = density @ area
    known &= found[:, None] > 0
    target = (density / np.maximum(found, 1e-30)[:, None]).sum(axis=0, dtype=np.float64) + 1 / (4 * np.pi)
    blind = np.full(len(area), 1 / (4 * np.pi))
    for _ in range(_ROUNDS):
        share = known @ (blind * area)
        blind = target / (known.T @ (1 / np.maximum(share, 1e-30) * (share > 0)) + 1)
        blind /= blind @ area
    shown = known.any(axis=0)
    if shown.any():
        blind = blind[np.flatnonzero(shown)[KDTree(directions[shown], leafsize=_LEAF).query(directions)[1]]]
    kde = SphericalKde(directions, np.array([0, len(area)]), _VIEWS_KAPPA, blind * area)
    return blind_table(kde.evaluate(directions)[0], rows, kde.ns, fibonacci_directions(_SCALED_OVER))
