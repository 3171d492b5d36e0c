r"""The attention law of the demo store's shoppers: their true gaze density in closed form.

At an observer position :math:`p` the density of the direction of attention :math:`\omega`, in 1/sr, is

.. math::

    g(\omega \mid p) = \frac{A_0\, b(\omega) + \sum_k A_k(p)\, \mathrm{vMF}(\omega;\, \mu_k(p), \kappa_k(p))}
                            {A_0 + \sum_k A_k(p)},
    \qquad A_k(p) = a_k\, v_k(p)\, c_k(p)\, \frac{1}{1 + (d_k / d_0)^2}

with one target k per area of interest, the front of its eye-catcher (``focus`` in regions.json):

- :math:`a_k` its attractiveness: that of its category, times an individual factor in [0.5, 1.5);
- :math:`v_k` the fraction of 4 x 4 points on its front that are visible from p, by exact ray casts to the twin;
- :math:`d_k, \mu_k` distance and direction to the mean of its visible points; :math:`d_0` = 1.2 m;
- :math:`c_k` the cosine between :math:`-\mu_k` and the normal of the front, 0 from behind;
- :math:`1/\kappa_k = \sigma_h^2 + (w_k^2 + h_k^2) / (24\, d_k^2)`: head jitter of 8 degrees, and the mean variance per
  direction of a w x h rectangle seen from d (the small-angle variance of a vMF lobe is 1/kappa);
- :math:`b(\omega) \propto \exp(-(\omega_z - z_0)^2 / 2 s^2)`, uniform in azimuth: undirected glances, slightly below
  the horizon. Equal steps in :math:`\omega_z` are equal solid angles, so its integral over the sphere is
  :math:`2\pi` times that of a truncated normal on [-1, 1].

Each term integrates to one, hence g does, exactly. If no target is visible, g = b.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from nerg_mi.scenes.store import twin
from scipy.special import ndtr, ndtri

FOLDER = Path(__file__).resolve().parent
REGIONS = FOLDER / "regions.json"

# a_k: attractiveness of each category in a convenience store
ATTRACTIVENESS = {
    "offers": 2.2,
    "drinks": 1.6,
    "sweets": 1.4,
    "snacks": 1.3,
    "meals": 1.3,
    "magazines": 1.1,
    "coffee": 1.2,
    "till": 1.0,
    "bread": 0.9,
    "dairy": 0.8,
    "noodles": 0.8,
    "counter_goods": 0.6,
    "cosmetics": 0.6,
    "stationery": 0.4,
    "household": 0.35,
    "poster": 0.7,
}

BACKGROUND = 0.2  # A_0
FALLOFF = 1.2  # d_0, metres
JITTER = np.radians(8.0)  # sigma_h
BAND = (-0.12, 0.28)  # z_0, s
SAMPLES = 4  # points per side on the front of a target
STAND_OFF = 0.01  # metres in front of the surface, because the goods of a front are not flush
_CHUNK = 4096  # positions per batch of ray casts


@dataclass(frozen=True)
class Lobes:
    """The law at P positions as a mixture: ``weights`` (P, K + 1) with the background last; ``mu`` (P, K, 3) unit;
    ``kappa`` (P, K); ``visible`` (P, K) visible fractions.
    """

    weights: np.ndarray
    mu: np.ndarray
    kappa: np.ndarray
    visible: np.ndarray


def read_regions(path=REGIONS) -> list[dict]:
    """Read the areas of interest of a regions.json."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(
            f'"{path}" is missing; create it with: python -m nerg_mi.scenes.store.make --stage twin'
        )
    return json.loads(path.read_text())["regions"]


class AttentionLaw:
    """The attention law, see the docstring of the module. Positions are in metres in the frame of the store, densities
    in 1/sr.

    ``regions`` are dicts as in regions.json (default: those of the store). ``scene`` is the twin in which rays are
    cast (default: that of the store, in the active Mitsuba variant).
    """

    def __init__(self, regions=None, scene=None):
        regions = read_regions() if regions is None else list(regions)
        self.scene = scene
        self.names = [r["name"] for r in regions]
        unknown = sorted({r["category"] for r in regions} - set(ATTRACTIVENESS))
        if unknown:
            raise ValueError(f"the categories {unknown} have no attractiveness; add them to ATTRACTIVENESS")
        # an individual factor per target: multiples of the golden ratio are evenly distributed in [0, 1)
        factor = 0.5 + np.arange(1, len(regions) + 1) * 0.6180339887498949 % 1.0
        self.attractiveness = np.array([ATTRACTIVENESS[r["category"]] for r in regions]) * factor
        self.normals = np.array([r["facing"] for r in regions], float)
        fronts, sizes = zip(*(_make_front(r) for r in regions))
        self.points = np.stack(fronts)  # (K, S, 3)
        self.spread2 = (np.square(sizes).sum(axis=1)) / 24.0  # square metres

    def compute_lobes(self, positions) -> Lobes:
        """Compute the mixture at positions (P, 3)."""
        positions = np.atleast_2d(np.asarray(positions, np.float64))
        parts = [self._compute_batch(positions[a : a + _CHUNK]) for a in range(0, len(positions), _CHUNK)]
        return Lobes(*(np.concatenate([getattr(p, k) for p in parts]) for k in ("weights", "mu", "kappa", "visible")))

    def _compute_batch(self, p) -> Lobes:
        K, S = self.points.shape[:2]
        P = len(p)
        # cast rays only at fronts that face the observer
        is_facing = np.einsum("pksc,kc->pks", p[:, None, None] - self.points[None], self.normals) > 0
        i, k, s = np.nonzero(is_facing)
        is_seen = np.zeros((P, K, S))
        if len(i):
            is_seen[i, k, s] = twin.is_visible(p[i], self.points[k, s], self.scene)
        fraction = is_seen.mean(axis=2)
        # a target without visible points has weight zero; use its centre to avoid 0/0
        point_weights = np.where(fraction[..., None] > 0, is_seen, 1.0)
        centre = np.einsum("pks,ksc->pkc", point_weights, self.points) / point_weights.sum(axis=2)[..., None]
        offset = centre - p[:, None]
        distance = np.maximum(np.linalg.norm(offset, axis=2), 1e-6)
        mu = offset / distance[..., None]
        cosine = np.maximum(-np.einsum("pkc,kc->pk", mu, self.normals), 0.0)
        strength = self.attractiveness * fraction * cosine / (1.0 + (distance / FALLOFF) ** 2)
        weights = np.concatenate([strength, np.full((P, 1), BACKGROUND)], axis=1)
        weights /= weights.sum(axis=1, keepdims=True)
        return Lobes(weights, mu, 1.0 / (JITTER**2 + self.spread2 / distance**2), fraction)

    def density(self, positions, directions) -> np.ndarray:
        """Evaluate the density (P, D) in 1/sr at positions (P, 3) for unit directions (D, 3), common to all, or (P, D,
        3).
        """
        lobes = self.compute_lobes(positions)
        directions = np.asarray(directions, np.float64)
        P = len(lobes.weights)
        directions = np.broadcast_to(directions, (P, *directions.shape[-2:]))
        out = np.empty(directions.shape[:2])
        for n in range(P):
            w, kappa = lobes.weights[n], lobes.kappa[n]
            use = np.flatnonzero(w[:-1] > 0)
            cos = directions[n] @ lobes.mu[n, use].T
            norm = kappa[use] / (2 * np.pi * -np.expm1(-2 * kappa[use]))
            out[n] = (np.exp(kappa[use] * (cos - 1.0)) * (norm * w[use])).sum(axis=1)
            out[n] += w[-1] * background_density(directions[n, :, 2])
        return out

    def sample(self, positions, rng) -> np.ndarray:
        """Draw one exact sample (P, 3) from the law at each of positions (P, 3). ``rng`` is a NumPy Generator."""
        lobes = self.compute_lobes(positions)
        P = len(lobes.weights)
        u = rng.random((P, 3))
        k = (np.cumsum(lobes.weights, axis=1) < u[:, :1] * lobes.weights.sum(axis=1, keepdims=True)).sum(axis=1)
        background = k == lobes.weights.shape[1] - 1
        row = np.flatnonzero(~background)
        mu = np.tile((0.0, 0.0, 1.0), (P, 1))
        z = sample_background(u[:, 1])
        mu[row], kappa = lobes.mu[row, k[row]], lobes.kappa[row, k[row]]
        # inversion of the vMF distribution of the cosine (Ulrich 1984; Jakob 2012)
        v = u[row, 1]
        z[row] = 1.0 + np.log(v + (1.0 - v) * np.exp(-2.0 * kappa)) / kappa
        a, b = _make_tangents(mu)
        r, phi = np.sqrt(np.maximum(1.0 - z**2, 0.0)), 2 * np.pi * u[:, 2]
        out = (r * np.cos(phi))[:, None] * a + (r * np.sin(phi))[:, None] * b + z[:, None] * mu
        return out / np.linalg.norm(out, axis=1, keepdims=True)


def background_density(z) -> np.ndarray:
    """Evaluate the background b in 1/sr at directions of height z = omega_z."""
    z0, s = BAND
    total = ndtr((1 - z0) / s) - ndtr((-1 - z0) / s)
    return np.exp(-0.5 * ((z - z0) / s) ** 2) / (np.sqrt(2 * np.pi) * s * total * 2 * np.pi)


def sample_background(u) -> np.ndarray:
    """Map uniform numbers u to heights z of samples from the background."""
    z0, s = BAND
    low, high = ndtr((-1 - z0) / s), ndtr((1 - z0) / s)
    return np.clip(z0 + s * ndtri(low + u * (high - low)), -1.0, 1.0)


def _make_front(region: dict):
    """Return points (S, 3) on the front of a region's eye-catcher, and the two sizes of the front in metres."""
    lo, hi = (np.array(region["focus"][k], float) for k in ("min", "max"))
    facing = np.array(region["facing"], float)
    axis = int(np.argmax(np.abs(facing)))
    other_axes = [k for k in range(3) if k != axis]
    t = (np.arange(SAMPLES) + 0.5) / SAMPLES
    grid = np.stack(np.meshgrid(t, t, indexing="ij"), axis=-1).reshape(-1, 2)
    points = np.empty((len(grid), 3))
    points[:, other_axes] = lo[other_axes] + grid * (hi - lo)[other_axes]
    points[:, axis] = (hi if facing[axis] > 0 else lo)[axis] + STAND_OFF * facing[axis]
    return points, (hi - lo)[other_axes]


def _make_tangents(n):
    """Return two unit vectors orthogonal to each of n (N, 3) (Duff et al. 2017)."""
    sign = np.where(n[:, 2] >= 0, 1.0, -1.0)
    a = -1.0 / (sign + n[:, 2])
    b = n[:, 0] * n[:, 1] * a
    first = np.stack([1 + sign * n[:, 0] ** 2 * a, sign * b, -sign * n[:, 0]], axis=1)
    return first, np.stack([b, sign + n[:, 1] ** 2 * a, -n[:, 1]], axis=1)
