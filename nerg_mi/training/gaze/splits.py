"""What a training does not learn from: positions and people that a test holds out, and what a validation watches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.photos.salience import SalienceView
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.splits import purge, split_by_person, split_by_position
from nerg_mi.training.geometry.places import GazePlace

from .settings import GazeSettings, ProbeSettings
from .supervision import Supervision

# Share of the views that a validation watches.
_WATCHED = 0.12


@dataclass(frozen=True, eq=False)
class ValidationSplit:
    """What the first of a training's fits learns from, and what it is scored on."""

    # What is learnt from.
    learn: Supervision
    # What is scored; None: nothing is watched.
    watched: Supervision | None = None
    # Where its rays are scored (T, 3), in their frame; None: at its views.
    centres: np.ndarray | None = None
    # Rays and views that are not learnt from.
    rays_held_out: int = 0
    views_held_out: int = 0


def split_validation(
    supervision: Supervision, place: GazePlace, settings: GazeSettings, probes: ProbeSettings
) -> ValidationSplit:
    """Zones of positions that are watched, where ``settings`` ask for any, purged by 2R: of rays, or of views where
    there are no rays. No view within 2R of a position that is watched is learnt from.

    Raises `NergError` where too little would be left to learn from.
    """
    rays, views = supervision.rays, supervision.views
    if not settings.zones:
        return ValidationSplit(supervision)
    if rays is None:
        learn, watched = split_views(views, settings.zones, 2 * probes.radius, settings.seed + 1)
        return ValidationSplit(
            Supervision(None, tuple(learn)), Supervision(None, tuple(watched)), views_held_out=len(views) - len(learn)
        )
    split = split_by_position(
        rays,
        probes.radius,
        zones=settings.zones,
        test_probes=settings.watched,
        min_rays=settings.watched_rays or probes.min_rays,
        seed=settings.seed + 1,
    )
    kept = far_views(views, place.points_from_rays(split.test_centres), 2 * probes.radius * place.align.scale)
    return ValidationSplit(
        Supervision(rays.select(split.train), tuple(kept)),
        # All rays around the centres: what is scored is what people there really looked at.
        Supervision(rays),
        split.test_centres,
        rays_held_out=int((~split.train).sum()),
        views_held_out=len(views) - len(kept),
    )


def hold_out(
    rays: Rays, radius: float, zones: int, positions: int, seed: int = 0, min_rays: int = 64, people: float = 0.0
) -> tuple[Rays, dict]:
    """Rays to train on, when ``positions`` test positions in ``zones`` zones are held out; and an account of it (JSON).

    Every ray within 2 ``radius`` metres of a test position is left out (``rays.splits``), so that no probe of
    training comes within ``radius`` of one. With a share of ``people`` these are left out everywhere, and the test
    positions are theirs. The account holds the test ``centres`` in the rays' frame, and the names of the ``people``
    left out.
    """
    known, names = np.ones(len(rays), bool), []
    looked_at = rays
    if people:
        known, unseen = split_by_person(rays, test_share=people, seed=seed)
        names = [rays.persons[i] for i in np.unique(rays.person[unseen])]
        looked_at = rays.select(unseen)
    split = split_by_position(looked_at, radius, zones=zones, test_probes=positions, min_rays=min_rays, seed=seed)
    train = known & purge(rays, split.test_centres, 2 * radius)
    account = {
        "centres": split.test_centres.round(6).tolist(),
        "zone": split.zone.tolist(),
        "radius": radius,
        "purged_within": 2 * radius,
        "seed": seed,
        "rays": len(rays),
        "rays_to_train": int(train.sum()),
        "rays_near_tests": int(split.test.sum()),
        "people": names,
    }
    return rays.select(train), account


def split_views(
    views: Sequence[SalienceView], zones: int, distance: float, seed: int = 0
) -> tuple[list[SalienceView], list[SalienceView]]:
    """``(learn, watched)``: ``zones`` groups of neighbouring views, an eighth of all, are watched, and no other within
    ``distance`` of one is learnt from.

    Raises `NergError` when too few are left.
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


def far_views(views: Sequence[SalienceView], points: np.ndarray, distance: float) -> list[SalienceView]:
    """Those of ``views`` whose camera is farther than ``distance`` from each of ``points`` (T, 3), all in one frame."""
    return [v for v in views if np.linalg.norm(points - v.camera.center, axis=1).min(initial=np.inf) > distance]
