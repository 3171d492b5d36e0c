"""Salience images as supervision of a gaze field: each view is an observer at the camera's centre who is known in part.

What a view says holds within its frustum alone. Its directions are of equal area there, its truth is the density given
that the picture is looked at, and what is trained is the field's density given the same: normalised over the view, not
over the sphere. How much is looked outside of a picture, views say together: each surface is in many of them.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from nerg_mi.capture.salience.views import SalienceView
from nerg_mi.density.kde.estimate import SphericalKde
from nerg_mi.errors import NergError
from nerg_mi.field.gaze.log_density import LogGazeConfig, blind_table, table_directions
from nerg_mi.maths.box import Box
from nerg_mi.maths.similarity import Similarity
from nerg_mi.maths.sphere import fibonacci_directions

from .settings import ProbeSettings
from .supervision import Supervision, observe, supervise_rays

# Directions a pixel of a view, so that hardly any is left out.
_PER_PIXEL = 4
# Share of the views that validation watches.
_WATCHED = 0.12
_ROUNDS = 100
# Concentration of the kernels that smooth the views' blind density.
_SMOOTHING = 50.0


def supervise_views(
    views: list[SalienceView],
    medium,
    box: Box,
    settings: ProbeSettings,
    seed: int = 0,
    semantic: str = "",
    config=None,
    blind: bool = True,
) -> Supervision:
    """What ``gaze_supervision.supervise_rays`` makes of probes, of ``views`` in the field's frame.

    ``settings.directions`` directions a view, each with the density of the pixel that it lies in; pixels are joined
    until each has some four. ``blind``: make the blind density for a ``LogGazeConfig``.
    """
    log, count = isinstance(config, LogGazeConfig), settings.directions
    small = [v.reduced(max(1, count // _PER_PIXEL)) for v in views]

    def drawn(seed) -> Supervision:
        rng = np.random.default_rng(seed)
        directions, truth = np.empty((len(views), count, 3)), np.empty((len(views), count))
        for k, view in enumerate(small):
            directions[k], which = view.draw(count, rng)
            truth[k] = view.density.ravel()[which]
        extent = np.array([v.extent for v in views])
        truth /= truth.mean(axis=1, keepdims=True) * extent[:, None]
        positions = np.array([v.camera.center for v in views])
        out = observe(
            positions, directions, truth, medium, box, settings.depth, semantic, log and config.escaped == "nearest"
        )
        return replace(out, extent=extent.astype(np.float32))

    out = drawn(seed)
    if settings.fresh:
        out = replace(out, renew=lambda epoch: drawn((seed, epoch)))
    return replace(out, blind=blind_of_views(views, config.prior)) if log and blind else out


def supervise_both(
    rays,
    views,
    medium,
    box: Box,
    settings: ProbeSettings,
    align=None,
    queries=None,
    seed: int = 0,
    semantic: str = "",
    config=None,
) -> Supervision:
    """``supervise_rays`` and ``supervise_views``, of which there may be none, in one."""
    if rays is None:
        return supervise_views(views, medium, box, settings, seed, semantic, config)
    out = supervise_rays(rays, medium, box, settings, align, queries, seed, semantic, config)
    if not views:
        return out
    return together(out, supervise_views(views, medium, box, settings, seed, semantic, config, blind=False))


def together(a: Supervision, b: Supervision) -> Supervision:
    """The observers of both, with as many directions each; the blind density is that of ``a``."""
    rows = lambda name: np.concatenate([getattr(a, name), getattr(b, name)])
    out = {k: rows(k) for k in ("positions", "directions", "truth", "distance", "escaped")}
    extent = [np.full(len(s.truth), 4 * np.pi, np.float32) if s.extent is None else s.extent for s in (a, b)]
    semantic = None if a.semantic is None else rows("semantic")
    renew = None if a.renew is None else lambda epoch: together(a.renew(epoch), b.renew(epoch))
    return Supervision(**out, semantic=semantic, blind=a.blind, renew=renew, extent=np.concatenate(extent))


def blind_of_views(views: list[SalienceView], rows: int) -> np.ndarray:
    """``field.gaze.log_density.blind_table`` of what is looked at wherever the camera stands, of which each of
    ``views`` shows a part.

    The density b of greatest likelihood when view v sees b given its part, found by Hunter's (2004) iteration for
    choices among a few: b = Σ_v p_v / Σ_v 1_v / b(v). One more view, of the whole sphere, is uniform: it links those
    that share nothing. What no view shows is looked at as what lies next to it is.
    """
    from scipy.spatial import cKDTree

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
        seen = known @ (blind * area)
        blind = target / (known.T @ (1 / np.maximum(seen, 1e-30) * (seen > 0)) + 1)
        blind /= blind @ area
    shown = known.any(axis=0)
    if shown.any():
        blind = blind[np.flatnonzero(shown)[cKDTree(directions[shown]).query(directions)[1]]]
    kde = SphericalKde(directions, np.array([0, len(area)]), _SMOOTHING, blind * area)
    return blind_table(kde.evaluate(directions)[0], rows, kde.ns, fibonacci_directions(1 << 16))


def split_views(views: list[SalienceView], zones: int, distance: float, seed: int = 0) -> tuple[list, list]:
    """``(learn, watched)``: ``zones`` groups of neighbouring views, an eighth of all, are watched, and no other within
    ``distance`` of one is learnt from.

    Raises ``NergError`` when too few are left.
    """
    centres = np.array([v.camera.center for v in views])
    rng = np.random.default_rng(seed)
    chosen = [int(rng.integers(len(views)))]
    apart = np.full(len(views), np.inf)
    while len(chosen) < min(zones, len(views)):
        apart = np.minimum(apart, np.linalg.norm(centres - centres[chosen[-1]], axis=1))
        chosen.append(int(rng.choice(np.argsort(-apart)[: max(1, len(views) // 4)])))
    each = max(1, round(_WATCHED * len(views) / len(chosen)))
    near = np.linalg.norm(centres[:, None] - centres[chosen], axis=2)
    watched = np.unique(np.argsort(near, axis=0, kind="stable")[:each])
    learn = far_views(views, centres[watched], distance)
    if len(learn) < max(2, len(views) // 4):
        raise NergError(
            f"{len(learn)} of {len(views)} views are left to train on, the others are watched or within "
            f"{distance:g} of one that is; choose fewer --zones (0: none), or a smaller --radius"
        )
    return learn, [views[k] for k in watched]


def far_views(views, places: np.ndarray, distance: float, align: Similarity | None = None) -> list[SalienceView]:
    """Those of ``views`` whose camera is farther than ``distance`` from every one of ``places`` (T, 3); ``align``:
    similarity from the frame of these to that of the views."""
    if align is not None:
        places, distance = places @ align.matrix[:3, :3].T + align.matrix[:3, 3], distance * align.scale
    return [v for v in views if np.linalg.norm(places - v.camera.center, axis=1).min(initial=np.inf) > distance]


def digest_views(views) -> str | None:
    """SHA-256 of what a training takes from ``views``; None without any."""
    parts = [np.ascontiguousarray(a).tobytes() for v in views for a in (v.camera.to_world, v.share, v.solid_angle)]
    return hashlib.sha256(b"".join(parts)).hexdigest() if parts else None
