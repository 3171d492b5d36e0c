"""What a prior is learnt from and scored on: of each place of `places.py` probes of everybody, and folds in which half
of the people are scored where nobody whom a density learns from stood within 2R."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prior_features import DistanceMaps

import numpy as np

RADIUS = 0.25
# Positions and directions of a fold's test, and rays at each; of the probes that a law is learnt from.
_POSITIONS, _DIRECTIONS, _RAYS = 45, 1024, 64
_PROBES, _LEARNT = 96, 512
_KAPPA_LEARNT, _KAPPA_TRUE, _ALL_BLIND = 30.0, 20.0, 6.0


@dataclass(frozen=True, eq=False)
class Fold:
    """People who are scored, and those who may be learnt from (the pool), away from where the others are scored.

    ``test``: what is scored; ``features`` (P, D, F) in its directions, ``ray_features`` (P, K, F) along ``at``
    (P, K, 3); ``ahead`` (P, K): cosines to where heads pointed, None where that is not known; ``known``: share of its
    directions that meet a surface; ``pool``: rays; ``probes``: densities of each person of the pool around positions of
    theirs, and ``probe_features`` there; ``place``.
    """

    test: Any
    features: np.ndarray
    at: np.ndarray
    ahead: np.ndarray | None
    ray_features: np.ndarray
    known: float
    pool: Any
    probes: Any
    probe_features: np.ndarray
    place: Any

    @property
    def people(self) -> list[int]:
        """Those of the pool who have probes, as numbers of its rays."""
        return [self.pool.persons.index(name) for name in self.probes.persons]

    def learnt(self, people: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Which probes have rays of ``people``, (P,) bool, and their densities there, each person counting alike."""
        which = [self.people.index(p) for p in people]
        here = self.probes.counts[:, which] > 0
        has = here.any(axis=1)
        share = here[has] / here[has].sum(axis=1, keepdims=True)
        return has, np.einsum("pn,pnd->pd", share, self.probes.parts[has][:, which])


@dataclass(frozen=True, eq=False)
class PriorPlace:
    """A place: ``features`` (P, D, F) and densities ``truth`` (P, D) at probes of everybody, the log of the blind
    density there (P, D), and its ``folds``; ``flat`` where no geometry is known: the one feature is the elevation.
    ``ahead``: mean cosine between gaze and head, NaN where heads are not known; ``rays`` of everybody."""

    name: str
    flat: bool
    ahead: float
    features: np.ndarray
    truth: np.ndarray
    log_blind: np.ndarray
    folds: list[Fold]
    rays: Any


def prior_place(name: str, make: Callable[[Path], tuple[Path, dict]], folds: int, folder: Path) -> PriorPlace:
    """The place ``name`` that ``make`` writes into ``folder``, with so many ``folds``: halves that change sides."""
    from nerg_mi.density.probes import place_probes
    from nerg_mi.field.backend import namespace
    from nerg_mi.jobs.gaze_places import make_place
    from nerg_mi.jobs.options.place import PlaceOptions
    from nerg_mi.rays.rays import Rays
    from nerg_mi.rays.splits import split_by_person
    from nerg_mi.training.gaze.ray_targets import rotated_sets
    from prior_law import blind

    folder.mkdir(parents=True, exist_ok=True)
    path, where = make(folder)
    rays = Rays.load(path)
    # Surfaces of hit points are those of the pool: nothing of those who are scored is known.
    place_of = lambda some, tag: make_place(PlaceOptions(**where), some, (), folder / f"{tag}.vol", namespace("llvm"))
    common = place_of(rays, "all")
    probes = place_probes(
        rays,
        RADIUS,
        placement="blue",
        spacing=0.08,
        count=_PROBES,
        kappa_rule="fixed",
        kappa=_KAPPA_LEARNT,
        weights="person",
        centre="query",
    )
    turned = rotated_sets(_LEARNT, len(probes), np.random.default_rng(0))
    found = []
    for k in range(folds):
        # Two folds share a division of the people, and each scores the other half.
        scored = split_by_person(rays, seed=k // 2)[k % 2]
        pool = rays.select(~scored)
        found.append(_fold(rays.select(scored), pool, common if "geometry" not in where else place_of(pool, f"{k}"), k))
    features = features_at(common, probes.positions, turned)
    truth = probes.density(turned)
    return PriorPlace(
        name,
        common.kind == "none",
        float("nan") if rays.head is None else float(np.nanmean((rays.head * rays.direction).sum(axis=1))),
        features,
        truth,
        blind(rays.direction, rays.person, _ALL_BLIND, turned),
        found,
        rays,
    )


def features_at(place: Any, centres: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Features (P, D, F) in ``directions`` (D, 3) or (P, D, 3): the elevation alone where no geometry is known."""
    if place.medium is None:
        spread = np.broadcast_to(directions, (len(centres), *directions.shape[-2:]))
        return spread[..., 2:3].astype(np.float32)
    return DistanceMaps(place, centres).features(directions)


def _fold(scored, pool, place, seed: int) -> Fold:
    from nerg_mi.evaluation.gaze.evaluation import make_test
    from nerg_mi.rays.splits import purge, split_by_position

    cut = split_by_position(scored, RADIUS, zones=3, test_probes=_POSITIONS, min_rays=64, min_train=0, seed=seed)
    test = make_test(scored, cut.test_centres, RADIUS, _KAPPA_TRUE, directions=_DIRECTIONS, seed=seed)
    away = pool.select(purge(pool, test.centres, 2 * RADIUS))
    rng, people = np.random.default_rng(seed), np.unique(away.person)
    each = max(4, 120 // len(people))
    own = lambda p: away.origin[rng.permutation(np.flatnonzero(away.person == p))[:each]]
    centres = np.concatenate([own(p) for p in people])
    probes = make_test(away, centres, RADIUS, _KAPPA_TRUE, directions=_LEARNT, min_rays=16, seed=seed)
    at, known = test.at[:, :_RAYS], 1.0
    if place.medium is None:
        features, ray_features = (features_at(place, test.centres, d) for d in (test.directions, at))
    else:
        maps = DistanceMaps(place, test.centres)
        features, ray_features, known = maps.features(test.directions), maps.features(at), float(maps.known.mean())
    probe_features = features_at(place, probes.centres, probes.directions)
    return Fold(
        test, features, at, cosines_to_heads(scored, at), ray_features, known, away, probes, probe_features, place
    )


def cosines_to_heads(rays, at: np.ndarray) -> np.ndarray | None:
    """Cosines (P, K) between directions ``at`` (P, K, 3), which are some of the rays', and where the heads pointed."""
    from scipy.spatial import KDTree

    if rays.head is None:
        return None
    which = KDTree(rays.direction).query(at.reshape(-1, 3))[1]
    return (rays.head[which] * rays.direction[which]).sum(axis=1).reshape(at.shape[:2])
