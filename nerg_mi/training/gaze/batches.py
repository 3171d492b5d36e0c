"""Targets as arrays of a backend, and the batches that are gathered from them."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError

from .losses import VANISHED
from .targets import Targets

# Below 4π by more than this share, directions are those of a view.
_WHOLE = 1 - 1e-6


@dataclass(frozen=True)
class Batch:
    """B observers with D directions each, flat: value b * D + d is observer b in direction d."""

    # Observers (Array3f, B lanes).
    p_o: Any
    # Directions (Array3f, B * D lanes), unit.
    r_o: Any
    # What they end at (Array3f, B * D lanes).
    p_od: Any
    # True densities (Float, B * D lanes), 1/sr.
    truth: Any
    # Where no surface is met (Bool, B * D lanes).
    escaped: Any
    # Solid angle in sr (Float, B lanes) that the directions of an observer are equal parts of.
    extent: Any
    # Features of a radiance field (F Floats, B * D lanes); None without any.
    semantic: list | None = None
    # Whether some of the observers are views, who are known in part.
    views: bool = False

    def integral(self, density: Any) -> Any:
        """Integral (Float, B lanes) of the ``density`` (Float, B * D lanes, 1/sr) of each observer over its extent."""
        directions = dr.width(density) // dr.width(self.extent)
        return dr.block_sum(density, directions) * (self.extent / directions)

    def given_view(self, density: Any, truth: Any = None) -> Any:
        """Densities of observers that are views, given the view: what else is looked at is not known there. Others
        stay. The result has the integral that ``truth`` has in the same directions, else one."""
        if not self.views:
            return density
        inside = self.integral(dr.maximum(density, 0))
        # A density of zeros has no scale to be taken out.
        scaled = (self.extent < 4 * np.pi * _WHOLE) & (inside > VANISHED)
        whole = 1 if truth is None else self.integral(truth)
        factor = dr.select(scaled, whole / dr.select(scaled, inside, 1), 1)
        return density * dr.repeat(factor, dr.width(density) // dr.width(self.extent))


class TargetArrays:
    """``targets`` as arrays of the backend ``ns``: ``count`` observers with ``directions`` each. Raises `NergError`
    without any observer."""

    def __init__(self, targets: Targets, ns: ModuleType):
        self.ns, self.count, self.directions = ns, *targets.truth.shape
        if self.count == 0:
            raise NergError("there are no probes to train on")
        flat = lambda v: ns.Float(np.ascontiguousarray(v, np.float32).ravel())
        self._extent = None if targets.extent is None else np.asarray(targets.extent, np.float32)
        self._positions, self._r_o = flat(targets.positions), flat(targets.directions)
        self._truth, self._distance = flat(targets.truth), flat(targets.distance)
        self._escaped = ns.Bool(np.ascontiguousarray(targets.escaped).ravel())
        self._features = 0 if targets.semantic is None else targets.semantic.shape[-1]
        if self._features:
            self._semantic = ns.Float16(np.ascontiguousarray(targets.semantic).ravel())

    def batch(self, observers: np.ndarray, directions: np.ndarray) -> Batch:
        """The ``observers`` (B,) in ``directions`` (B, D), indices of each observer's own."""
        ns = self.ns
        at = ns.UInt32(observers.astype(np.uint32))
        index = ns.UInt32((observers[:, None] * self.directions + directions).astype(np.uint32).ravel())
        p_o, r_o = dr.gather(ns.Array3f, self._positions, at), dr.gather(ns.Array3f, self._r_o, index)
        p_od = dr.gather(ns.Array3f, self._positions, index // self.directions) + r_o * dr.gather(
            ns.Float, self._distance, index
        )
        semantic = None
        if self._features:
            F = self._features
            semantic = [ns.Float(dr.gather(ns.Float16, self._semantic, index * F + k)) for k in range(F)]
        return Batch(
            p_o,
            r_o,
            p_od,
            dr.gather(ns.Float, self._truth, index),
            dr.gather(ns.Bool, self._escaped, index),
            self._solid_angles(observers),
            semantic,
            self._extent is not None,
        )

    def _solid_angles(self, observers: np.ndarray) -> Any:
        whole = np.full(len(observers), 4 * np.pi, np.float32)
        return self.ns.Float(whole if self._extent is None else self._extent[observers])
