"""Targets of a gaze field: observers, directions around each, the true densities there and the surfaces that they meet.

Rays become targets by way of probes (``ray_targets``), views directly (``view_targets``). The place is frozen while
gaze is trained and each observer keeps its directions, so every depth is traced once, before the training.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerg_mi.fields.gaze_base import GazeFieldConfig
from nerg_mi.training.geometry.places import GazePlace
from nerg_mi.training.geometry.surfaces import surface_distances

from .semantics import semantic_features


@dataclass(frozen=True)
class TargetNeeds:
    """What a kind of gaze field is shown besides directions, densities and distances."""

    # Features of a radiance field (`fields.gaze_product.SEMANTICS`); "": none.
    semantic: str = ""
    # Whether directions that meet no surface end at the depth of those around them, not on the box.
    fill: bool = False
    # Rows of the table of the blind density that the field begins with; 0: it needs none.
    blind_rows: int = 0

    @staticmethod
    def of(config: GazeFieldConfig) -> TargetNeeds:
        """What a field of the configuration ``config`` needs."""
        return TargetNeeds(config.semantic, config.fills_escaped, config.prior)


@dataclass(frozen=True, eq=False)
class Targets:
    """P observers with D directions each, parts of equal solid angle, in the field's frame and units; float32."""

    # Positions (P, 3) of the observers, p_o.
    positions: np.ndarray
    # Unit directions (P, D, 3), r_o.
    directions: np.ndarray
    # True densities (P, D), 1/sr.
    truth: np.ndarray
    # Distances (P, D) from p_o to p_od.
    distance: np.ndarray
    # Where no surface was met (P, D), bool.
    escaped: np.ndarray
    # Features (P, D, F) of a radiance field, float16, for a gaze field that wants them.
    semantic: np.ndarray | None = None
    # Table of the log of the density of all rays whatever their position (`fields.gaze_log_density.blind_table`).
    blind: np.ndarray | None = None
    # The same observers in other directions, for the epoch that is given, where each epoch has its own.
    renew: Callable[[int], Targets] | None = None
    # Corners of the box of observers that capture's encoding spans; None: that of the positions.
    heads: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    # Solid angle (P,), sr, of which the D directions are parts and over which the truth integrates to one; None: 4π.
    extent: np.ndarray | None = None

    @property
    def escape_share(self) -> float:
        """Share of the directions that meet no surface."""
        return float(self.escaped.mean())

    @property
    def escaped_gaze(self) -> float:
        """Share of the true gaze that goes where no surface is."""
        gaze = self.truth if self.extent is None else self.truth * self.extent[:, None]
        return float((gaze * self.escaped).sum() / gaze.sum())


def observe(
    positions: np.ndarray,
    directions: np.ndarray,
    truth: np.ndarray,
    place: GazePlace,
    depth: str = "median",
    needs: TargetNeeds | None = None,
) -> Targets:
    """Targets of observers (P, 3) whose density in ``directions`` (P, D, 3) is ``truth`` (P, D), all in the frame of
    ``place``, with the surfaces that they see there; ``depth``: kind of depth that is the surface.

    Raises `NergError` where ``needs`` asks for features of a place that is no radiance field.
    """
    needs = needs or TargetNeeds()
    distance, escaped = surface_distances(place, positions, directions, depth, needs.fill)
    features = None
    if needs.semantic:
        origins = np.repeat(positions, directions.shape[1], axis=0)
        features = semantic_features(place, origins, directions.reshape(-1, 3), distance.ravel(), needs.semantic)
        features = features.reshape(*directions.shape[:2], -1)
    narrow = lambda v: v.astype(np.float32, copy=False)
    return Targets(narrow(positions), narrow(directions), narrow(truth), distance, escaped, features)


def concatenate(a: Targets, b: Targets) -> Targets:
    """The observers of both, with as many directions each; the blind density is that of ``a``."""
    rows = lambda name: np.concatenate([getattr(a, name), getattr(b, name)])
    out: dict[str, Any] = {k: rows(k) for k in ("positions", "directions", "truth", "distance", "escaped")}
    extent = [np.full(len(t.truth), 4 * np.pi, np.float32) if t.extent is None else t.extent for t in (a, b)]
    semantic = None if a.semantic is None else rows("semantic")
    renew, of_a, of_b = None, a.renew, b.renew
    if of_a is not None and of_b is not None:
        renew = lambda epoch: concatenate(of_a(epoch), of_b(epoch))
    return Targets(**out, semantic=semantic, blind=a.blind, renew=renew, extent=np.concatenate(extent))
