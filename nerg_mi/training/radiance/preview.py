"""Pictures of a field by the trainer's own marcher, for the error that is watched while it trains."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from nerg_mi.fields.radiance import RadianceField, mean_features
from nerg_mi.photos.cameras import pixel_directions
from nerg_mi.photos.images import View
from nerg_mi.transport.quadrature import mean_depth_share

from .compositing import ray_sum
from .losses import composite
from .sampling import StepTable, rays_in_box, visible_samples

# Candidates (rays times steps) in flight at once.
_CHUNK = 2**22


@dataclass
class Preview:
    """``color`` (h, w, 3) sRGB before the background, ``opacity`` (h, w), ``depth`` (h, w): expected distance in
    scene units, 0 where nothing absorbs; of every ``every``-th pixel of a view, from ``every // 2`` on."""

    color: np.ndarray
    opacity: np.ndarray
    depth: np.ndarray


def render_view(
    field: RadianceField,
    occupied,
    table: StepTable,
    view: View,
    near: float,
    background: float = 0.0,
    every: int = 1,
    stop: float = 1e-3,
) -> Preview:
    """March every ``every``-th pixel of ``view`` through ``field``.

    ``occupied``: mask of points (Array3f, mask) in cells that may hold density; ``near``: where rays start, scene
    units.
    """
    ns = field.ns
    d = pixel_directions(view.camera.intrinsics)[every // 2 :: every, every // 2 :: every]
    shape = d.shape[:2]
    d = (d.reshape(-1, 3) @ view.camera.to_world[:3, :3].T).astype(np.float32)
    parts = []
    size = max(1, _CHUNK // table.steps)
    with dr.suspend_grad():
        for first in range(0, len(d), size):
            parts.append(_march(field, occupied, table, view.camera.center, d[first : first + size], near, stop, ns))
    color, opacity, moment = (np.concatenate([p[k] for p in parts]) for k in range(3))
    color = color + (1 - opacity[:, None]) * background
    depth = np.where(opacity > 0, moment / np.where(opacity > 0, opacity, 1), 0)
    return Preview(color.reshape(*shape, 3), opacity.reshape(shape), depth.reshape(shape))


def _march(field, occupied, table, center, d, near: float, stop: float, ns):
    count = len(d)
    direction = ns.Array3f(d.T)
    origin = ns.Array3f(*[ns.Float(np.full(count, c, np.float32)) for c in center])
    rays = rays_in_box(origin, direction, field.box, near)
    offset = ns.Float(np.full(count, 0.5, np.float32))
    samples, _ = visible_samples(rays, table, offset, occupied, field.density, stop)
    if samples is None:
        return np.zeros((count, 3)), np.zeros(count), np.zeros(count)
    sigma, features = field.density_features(samples.p)
    deferred = field.config.deferred
    parts = features if deferred else list(field.color(features, dr.gather(ns.Array3f, direction, samples.ray)))
    weight, tau, sums, opacity = composite(sigma, parts, samples)
    color = [opacity * c for c in field.color(mean_features(sums, opacity), direction)] if deferred else sums
    moment = ray_sum(weight * (samples.t + samples.length * mean_depth_share(tau)), samples.segments)
    return np.stack([c.numpy() for c in color], axis=1), opacity.numpy(), moment.numpy()
