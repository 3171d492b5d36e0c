"""Occupancy as torch-ngp keeps it: bits of 128^3 cells in Morton order, a cube a cascade."""

from __future__ import annotations

from types import ModuleType

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.occupancy import CascadeGrid, OccupancyGrid, levels_of

from .state_dict import StateDict

_CELLS = 128


def read_occupancy(state: StateDict, bound: float, ns: ModuleType, mean_density) -> OccupancyGrid | CascadeGrid | None:
    """From the bitfield, or else from the density grid; None for a field that was trained without either."""
    levels = levels_of(bound)
    density = state["density_grid"].reshape(levels, -1) if "density_grid" in state else None
    if "density_bitfield" in state:
        bits = np.unpackbits(state["density_bitfield"], bitorder="little").astype(bool)
    elif density is not None:
        # torch-ngp's own rule, with the threshold of its command line.
        bits = density.ravel() > min(float(np.maximum(density, 0).mean()), 10)
    else:
        return None
    if bits.size != levels * _CELLS**3:
        raise NergError(
            f'"{state.path}" has {bits.size} density bits where a bound of {bound:g} has {levels} x 128^3; '
            "take another checkpoint of its training"
        )
    bits = bits.reshape(levels, -1)
    if density is not None and not bits.all():
        # The largest density that the grid calls empty: cells never seen hold -1.
        threshold = max(float(density[~bits].max()), 0.0)
    else:
        threshold = min(float(mean_density), 10.0) if isinstance(mean_density, (int, float)) else 0.0
    if not np.isfinite(threshold):
        raise NergError(f'the densities of "{state.path}" are not finite: its training has diverged')
    ordered = bits[:, morton_order()].reshape(levels, _CELLS, _CELLS, _CELLS)
    return OccupancyGrid(ordered[0], ns, threshold) if levels == 1 else CascadeGrid(ordered, bound, ns, threshold)


def morton_order(cells: int = _CELLS) -> np.ndarray:
    """Morton index of every cell of a cube, listed x fastest, then y, then z; bits of x lowest, (cells^3,)."""
    spread = np.zeros(cells, np.int64)
    for bit in range(cells.bit_length() - 1):
        spread |= (np.arange(cells) >> bit & 1) << 3 * bit
    return (spread[:, None, None] << 2 | spread[:, None] << 1 | spread).ravel()


def bitfield(occupancy, bound: float) -> np.ndarray:
    """Bits of all cascades in Morton order, packed; every bit is set where nothing is known."""
    levels = levels_of(bound)
    if occupancy is None:
        bits = np.ones((levels, _CELLS, _CELLS, _CELLS), bool)
    elif isinstance(occupancy, CascadeGrid) and (occupancy.bound, occupancy.resolution) == (bound, _CELLS):
        bits = occupancy.bits
    elif isinstance(occupancy, OccupancyGrid):
        bits = np.stack([_overlapped(occupancy.bits, min(2.0**k, bound) / bound) for k in range(levels)])
    else:
        raise NergError(
            f"cascades of {occupancy.resolution}^3 cells to a bound of {occupancy.bound:g} have no torch-ngp form"
        )
    packed = np.zeros((levels, _CELLS**3), bool)
    packed[:, morton_order()] = bits.reshape(levels, -1)
    return np.packbits(packed.ravel(), bitorder="little")


def _overlapped(bits: np.ndarray, share: float) -> np.ndarray:
    """Which cells of 128^3 over the middle ``share`` of the cube overlap an occupied cell of ``bits``."""
    n = len(bits)
    edges = (np.linspace(-share, share, _CELLS + 1) + 1) / 2 * n
    first = np.clip(np.floor(edges[:-1] + 1e-9).astype(int), 0, n - 1)
    last = np.clip(np.ceil(edges[1:] - 1e-9).astype(int), 1, n)
    for axis in range(3):
        counts = np.concatenate([np.zeros_like(bits.take([0], axis), int), np.cumsum(bits, axis, dtype=int)], axis)
        bits = counts.take(last, axis) > counts.take(first, axis)
    return bits
