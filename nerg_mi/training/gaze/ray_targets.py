"""From rays to probes to targets: around each probe directions of equal area, under a rotation of its own, so that
together the probes see what one set leaves out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.probes.probes import Probes, place_probes
from nerg_mi.rays.rays import Rays
from nerg_mi.training.geometry.places import GazePlace

from .blind import blind_of_rays
from .settings import ProbeSettings
from .targets import TargetNeeds, Targets, observe


def probes_of_rays(rays: Rays, settings: ProbeSettings, queries: np.ndarray | None = None, seed: int = 0) -> Probes:
    """Probes on ``rays``, at ``queries`` (P, 3) metres where given, else as ``settings`` places them.

    Raises `NergError` when none holds enough rays.
    """
    return place_probes(
        rays,
        settings.radius,
        placement=settings.placement,
        count=settings.count,
        spacing=settings.spacing,
        queries=queries,
        cap=settings.cap,
        min_rays=min(settings.min_rays, settings.cap),
        kappa_rule=settings.kappa_rule,
        kappa=settings.kappa,
        weights=settings.weights,
        seed=seed,
    )


def targets_of_probes(
    probes: Probes,
    place: GazePlace,
    directions: int,
    depth: str = "median",
    needs: TargetNeeds | None = None,
    seed: int | tuple[int, ...] = 0,
) -> Targets:
    """Targets of ``probes`` in as many ``directions`` each; ``depth``: kind of depth that is the surface; ``seed``: of
    the rotations. Raises `NergError` where all kernels are so narrow that they vanish between the directions."""
    turned = rotated_sets(directions, len(probes), np.random.default_rng(seed))
    truth = probes.density(turned)
    if not truth.any():
        raise NergError(
            f"the kernels of all rays vanish between {directions:,} directions; give a smaller --kappa, or more "
            "--directions"
        )
    return observe(
        place.points_from_rays(probes.positions), place.directions_from_rays(turned), truth, place, depth, needs
    )


def targets_of_rays(
    rays: Rays,
    place: GazePlace,
    settings: ProbeSettings,
    needs: TargetNeeds | None = None,
    queries: np.ndarray | None = None,
    seed: int = 0,
) -> Targets:
    """Targets of the probes on ``rays``, at ``queries`` (P, 3) metres where given. With ``settings.fresh`` they can
    ``renew`` their directions. Raises `NergError` when no probe holds enough rays."""
    needs = needs or TargetNeeds()
    probes = probes_of_rays(rays, settings, queries, seed)
    turned = lambda seed: targets_of_probes(probes, place, settings.directions, settings.depth, needs, seed)
    targets = turned(seed)
    if settings.fresh:
        targets = replace(targets, renew=lambda epoch: turned((seed, epoch)))
    if needs.blind_rows:
        blind = blind_of_rays(rays, needs.blind_rows, place, seed, settings.weights, settings.mix_kappa)
        targets = replace(targets, blind=blind)
    return targets


def rotated_sets(count: int, sets: int, rng: np.random.Generator) -> np.ndarray:
    """``sets`` Fibonacci sets of ``count`` directions, each turned by a uniform random rotation, (sets, count, 3)."""
    # Unit quaternions from normal numbers are uniform rotations (Shoemake 1992); the first is the real part.
    rotation = Rotation.from_quat(np.roll(rng.normal(size=(sets, 4)), -1, axis=1)).as_matrix()
    return np.einsum("dj,pij->pdi", fibonacci_directions(count), rotation)
