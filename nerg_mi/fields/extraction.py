"""Surfaces and lattices of a radiance field as arrays for other tools.

A surface is where density crosses a threshold. It is first searched in the opacity of lattice cells, 1 - exp(-σ h),
which is bounded unlike density, and then located along lattice edges in the field itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.maths.arrays import to_vector

from .radiance import RadianceNetwork

# Points per kernel launch: a few hundred megabytes of intermediate values.
_BATCH = 1 << 21
_BISECTIONS = 8
_TILTED = 4  # Oblique directions, besides the normal, that a surface colour is averaged over

_MAX_CELLS = 1 << 30  # Densities of a lattice are stored together, in single precision


@dataclass(frozen=True)
class Lattice:
    """Centres of cubic cells of edge ``step`` that fill a box from ``lower`` on; ``shape``: cells along x, y, z."""

    lower: tuple[float, float, float]
    step: float
    shape: tuple[int, int, int]

    @staticmethod
    def for_field(field: RadianceNetwork, resolution: int) -> Lattice:
        """A lattice with ``resolution`` cells along the longest edge of the field's box, or of the core of a contracted
        box."""
        if resolution < 2:
            raise ValueError(f"a lattice needs at least 2 cells along its longest edge, got {resolution}")
        core = field.box.core
        edges = np.subtract(core.upper, core.lower)
        step = float(edges.max() / resolution)
        shape = np.maximum(np.ceil(edges / step - 1e-6).astype(int), 2)
        if (cells := math.prod(shape.tolist())) > _MAX_CELLS:
            raise NergError(
                f"a lattice of {' x '.join(map(str, shape))} cells takes {4 * cells / 1e9:.0f} GB; use a lower "
                f"{parameter('resolution')}"
            )
        # The overhang of the last cells is shared by both sides.
        lower = (np.add(core.upper, core.lower) - shape * step) / 2
        return Lattice(tuple(lower.tolist()), step, tuple(shape.tolist()))

    def points(self, index: np.ndarray) -> np.ndarray:
        """Positions of (fractional) cell indices (N, 3), in the field's units."""
        return np.asarray(self.lower) + (np.asarray(index) + 0.5) * self.step


class FieldSampler:
    """Evaluates a field at many points, in batches; densities are 0 in the empty cells of its occupancy grid."""

    def __init__(self, field: RadianceNetwork):
        self.field, self.ns = field, field.ns

    def _density(self, p, masked: bool = True):
        active = self.ns.Bool(True)
        if masked and self.field.occupancy is not None:
            active = self.field.occupancy.coarse.distance_to_occupied(self.field.box.to_cube(p)) == 0
        return dr.select(active, self.field.density(p, active), 0)

    def density(self, p: np.ndarray, masked: bool = True) -> np.ndarray:
        """Density (1/unit) at points (N, 3); ``masked`` False: the output of the networks also in empty cells."""
        with dr.suspend_grad():
            return _evaluate_in_batches(lambda q: self._density(to_vector(self.ns.Array3f, q), masked).numpy(), p)

    def density_on(self, lattice: Lattice) -> np.ndarray:
        """Density (z, y, x) at the lattice's points."""
        return self._over(lattice, 1, lambda sigma: sigma)

    def opacity_on(self, lattice: Lattice, samples: int) -> np.ndarray:
        """Opacity (z, y, x) of the lattice's cells along their edges, averaged over ``samples``³ points of each."""
        return self._over(lattice, samples, lambda sigma: 1 - dr.exp(-sigma * lattice.step))

    def _over(self, lattice: Lattice, samples: int, transform) -> np.ndarray:
        ns, (nx, ny, nz) = self.ns, lattice.shape
        out = np.zeros(nx * ny * nz, np.float32)
        with dr.suspend_grad():
            for start in range(0, out.size, _BATCH):
                count = min(_BATCH, out.size - start)
                index = dr.arange(ns.UInt32, count) + dr.opaque(ns.UInt32, start)
                cell = index % nx, index // nx % ny, index // (nx * ny)
                for k in range(samples**3):
                    offsets = [(k // samples**axis % samples + 0.5) / samples for axis in range(3)]
                    offsets = [dr.opaque(ns.Float, o) for o in offsets]
                    p = ns.Array3f(
                        *[l + (ns.Float(c) + o) * lattice.step for l, c, o in zip(lattice.lower, cell, offsets)]
                    )
                    out[start : start + count] += transform(self._density(p)).numpy()
        return (out / samples**3).reshape(nz, ny, nx)

    def color(self, p: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Colour (N, 3) in the field's colour space of points (N, 3), seen along unit ``directions`` (N, 3)."""

        def ask(q):
            features = self.field.density_features(to_vector(self.ns.Array3f, q[:, :3]))[1]
            c = self.field.color(features, to_vector(self.ns.Array3f, q[:, 3:]))
            dr.eval(c)
            return np.array(c).T if np.array(c).shape[0] == 3 else np.array(c)

        with dr.suspend_grad():
            return _evaluate_in_batches(ask, np.concatenate([p, directions], 1), 3)

    def diffuse_color(self, p: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Colour (N, 3) of surface points, averaged over the normal and directions at 45 degrees, since a field's
        colour is view-dependent."""
        first = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
        u = np.cross(normals, first)
        u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-12)
        v = np.cross(normals, u)
        total = self.color(p, -normals)
        for k in range(_TILTED):
            a = 2 * math.pi * k / _TILTED
            total += self.color(p, -(normals + math.cos(a) * u + math.sin(a) * v) / math.sqrt(2))
        return total / (1 + _TILTED)


def _evaluate_in_batches(ask, rows: np.ndarray, columns: int = 0) -> np.ndarray:
    shape = (len(rows), columns) if columns else (len(rows),)
    out = np.zeros(shape, np.float32)
    for start in range(0, len(rows), _BATCH):
        out[start : start + _BATCH] = ask(rows[start : start + _BATCH])
    return out


def surface_density(lattice: Lattice) -> float:
    """Density at which one cell of the lattice absorbs half of the light: the threshold of a surface."""
    return math.log(2) / lattice.step


def cell_opacity(density: np.ndarray, lattice: Lattice) -> np.ndarray:
    """Opacity of a cell of this density."""
    return -np.expm1(-density * lattice.step)


def find_crossings(
    sampler: FieldSampler, lattice: Lattice, index: np.ndarray, threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """Move points along lattice edges to where density crosses ``threshold``.

    Points stay where they are if the field does not cross: they come from filled holes. Behind a surface the networks
    continue with dense matter (inside of walls and objects) that no photo shows.

    Parameters
    ----------
    index : array (N, 3)
        Cell indices, fractional on one axis.

    Returns
    -------
    moved : array (N, 3)
        The moved indices.
    unobserved : array (N,)
        Where the crossing is not a surface but the border of the field's occupied cells.
    """
    away = np.abs(index - np.round(index))
    axis = np.argmax(away, axis=1)
    # Vertices on lattice points have no edge to move along.
    on_edge = away.max(1) > 1e-4
    low = np.round(index)
    low[np.arange(len(index)), axis] = np.floor(index[np.arange(len(index)), axis] + 1e-6)
    step = np.eye(3)[axis]
    first = sampler.density(lattice.points(low)) >= threshold
    crosses = on_edge & (first != (sampler.density(lattice.points(low + step)) >= threshold))
    a, b = np.zeros(len(index)), np.ones(len(index))
    for _ in range(_BISECTIONS):
        middle = 0.5 * (a + b)
        same = (sampler.density(lattice.points(low + middle[:, None] * step)) >= threshold) == first
        a, b = np.where(same, middle, a), np.where(same, b, middle)
    moved = np.where(crosses[:, None], low + (0.5 * (a + b))[:, None] * step, index)
    thin = lattice.points(low + np.where(first, 1.0, 0.0)[:, None] * step)
    return moved, crosses & (sampler.density(thin, masked=False) >= threshold)
