"""Colours of a compiled field: numbers on the vertices of its blocks, fitted to the colours of its networks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
from scipy.sparse import csr_matrix

from nerg_mi.maths.arrays import copy_aligned, to_vector
from nerg_mi.maths.sphere import fibonacci_directions
from nerg_mi.maths.types import Array3f, Float

from .compilation import find_block_corners
from .encoding import encode_direction
from .radiance import RadianceNetwork
from .voxels import BLOCK_EDGE, COLOR_NUMBERS, VoxelColors, VoxelGrid

# The colours of a point along all directions are projected onto a few functions of the direction, which are the
# principal components of the colours of all points. Only the directions from which a surface is seen count: those
# against the gradient of the opacity, of which 27 kinds are told apart. The numbers of points are then fitted by values
# at vertices, whose trilinear interpolant they are compared with (SIRT, Gilbert 1972).

_BATCH = 1 << 11  # Blocks per launch
_POINTS_PER_CELL = 8  # Points in a cell of the lattice, one in each octant
_DIRECTIONS = 16  # Directions in which a point is seen
_BASIS_DIRECTIONS = 64  # The same for the points that determine the basis
_BASIS_BLOCKS = 1 << 12  # Blocks that determine it
_ITERATIONS = 8
_HIDDEN = 0.02  # Weight of directions from which a surface is not seen
_SH_DEGREE = 4
_MIN_WEIGHT = 1e-3  # Weight below which a point is not fitted
_DEPTH = 3  # Cells over which matter in front of a point counts
_NORMAL = 0.38  # Minimum component of a unit gradient along an axis to which its kind belongs: sin 22.5°


def fit_colors(
    field: RadianceNetwork, edge: int, on_progress: Callable[[float], None] = lambda fraction: None
) -> VoxelColors:
    """Colours of the networks of a compiled ``field`` on the blocks of its voxels, with ``edge`` cells of a lattice
    along the edge of a block (`voxels.LATTICE_EDGES`). Equal fields give equal colours."""
    rng, blocks = np.random.default_rng(0), _get_voxels(field).blocks
    with dr.suspend_grad():
        basis, low, high = _find_basis(field, rng)
        directions = fibonacci_directions(_DIRECTIONS)
        factors = np.einsum("mh,hck->mck", _evaluate_harmonics(field, directions), basis)
        solvers = _make_solvers(factors, directions)
        numbers = np.empty((len(blocks), (edge + 1) ** 3, COLOR_NUMBERS), np.uint8)
        for first in range(0, len(blocks), _BATCH):
            chosen = slice(first, first + _BATCH)
            block, position, weight, kind, colors = _sample_points(field, blocks[chosen], edge, directions, rng)
            values = np.empty((len(block), COLOR_NUMBERS), np.float32)
            for k in np.unique(kind):
                values[kind == k] = colors[kind == k] @ solvers[k]
            fitted = _fit_vertices(len(numbers[chosen]), edge, block, position, weight, values)
            numbers[chosen] = np.clip(np.rint((fitted - low) / (high - low) * 255), 0, 255)
            on_progress(min(1.0, (first + _BATCH) / len(blocks)))
    # Bytes in place of numbers, and the colour of zeros as the last function.
    rows = np.concatenate([basis * ((high - low) / 255), (basis @ low)[..., None]], axis=2)
    return VoxelColors(edge, numbers, rows.transpose(2, 1, 0).reshape(-1, len(rows)).astype(np.float32), field.ns)


def _get_voxels(field: RadianceNetwork) -> VoxelGrid:
    if field.voxels is None:
        raise ValueError("the field is not compiled")
    return field.voxels


def _find_basis(field: RadianceNetwork, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The functions of the direction (harmonics, 3, K), and the lowest and highest of their numbers (K,)."""
    blocks, directions = _get_voxels(field).blocks, fibonacci_directions(_BASIS_DIRECTIONS)
    some = np.sort(rng.choice(blocks, min(len(blocks), _BASIS_BLOCKS), replace=False))
    _, _, weight, kind, colors = _sample_points(field, some, 2, directions, rng)
    y = _evaluate_harmonics(field, directions)
    solvers = _make_solvers(np.einsum("mh,cd->mchd", y, np.eye(3)).reshape(len(y), 3, -1), directions)
    coefficients = np.stack([c @ solvers[k] for c, k in zip(colors, kind)]).reshape(-1, y.shape[1] * 3)
    components = np.linalg.svd(coefficients * np.sqrt(weight)[:, None], full_matrices=False)[2]
    components = np.concatenate([components, np.zeros((COLOR_NUMBERS, components.shape[1]))])[:COLOR_NUMBERS]
    values = coefficients @ components.T
    low, high = np.quantile(values, [0.0002, 0.9998], axis=0)
    margin = 0.05 * (high - low) + 1e-6
    return components.T.reshape(-1, 3, COLOR_NUMBERS), low - margin, high + margin


def _evaluate_harmonics(field: RadianceNetwork, directions: np.ndarray) -> np.ndarray:
    y = encode_direction(to_vector(field.ns.Array3f, directions), min(_SH_DEGREE, field.config.sh_degree))
    return np.stack([np.broadcast_to(c.numpy(), len(directions)) for c in y], axis=1).astype(float)


def _make_solvers(factors: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Matrices (27, 3 M, K) from the colours of a point in M ``directions`` to its numbers, the weighted least squares
    for ``factors`` (M, 3, K), for each kind of surface (`_sample_points`)."""
    rows, out = factors.reshape(-1, factors.shape[2]), []
    for k in range(27):
        normal = np.array([k % 3, k // 3 % 3, k // 9]) - 1.0
        normal /= max(np.linalg.norm(normal), 1)
        # Edges of surfaces are also seen from behind. In fog every direction counts.
        weight = np.repeat(np.clip(directions @ normal + 0.2, _HIDDEN, 1) if k != 13 else np.ones(len(directions)), 3)
        scaled = rows * weight[:, None]
        out.append(np.linalg.solve(scaled.T @ rows + 1e-3 * np.eye(rows.shape[1]), scaled.T).T)
    return np.stack(out).astype(np.float32)


def _sample_points(
    field: RadianceNetwork, blocks: np.ndarray, edge: int, directions: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Points with matter, spread over the cells of the lattices of ``blocks``.

    Returns
    -------
    block : (N,) index into ``blocks``.
    position : (N, 3) in the block, 0..1.
    weight : (N,) fraction of light that a step absorbs.
    kind : (N,) ternary digits of the gradient of the opacity, x first: 0 falls, 1 is about constant, 2 rises.
    colors : (N, 3 M) along the M directions.
    """
    resolution = _get_voxels(field).resolution
    ns, n, per_block = field.ns, resolution // BLOCK_EDGE, _POINTS_PER_CELL * edge**3
    lane = dr.arange(ns.UInt32, len(blocks) * per_block)
    cell, block = lane % per_block // _POINTS_PER_CELL, lane // per_block
    jitter = to_vector(ns.Array3f, rng.random((len(blocks) * per_block, 3), np.float32))
    octant = 0.5 * (ns.Array3f(lane & 1, lane >> 1 & 1, lane >> 2 & 1) + jitter)
    position = (ns.Array3f(cell % edge, cell // edge % edge, cell // edge**2) + octant) / edge
    index = dr.gather(ns.UInt32, ns.UInt32(copy_aligned(blocks, np.uint32)), block)
    u = (find_block_corners(index, n, ns) + position) / n
    weight, inwards = _estimate_visibility(field, resolution, u)
    kind = sum(
        3**axis * (1 + dr.select(c > _NORMAL, 1, 0) - dr.select(c < -_NORMAL, 1, 0)) for axis, c in enumerate(inwards)
    )
    seen: Any = dr.compress(weight > _MIN_WEIGHT)
    if dr.width(seen) == 0:
        seen = ns.UInt32(0)
    pick = lambda value: dr.gather(type(value), value, seen)
    features = field.density_features(field.box.from_unit(pick(u)))[1]
    dr.eval(features)
    colors = np.empty((dr.width(seen), 3 * len(directions)), np.float32)
    for k, d in enumerate(directions.tolist()):
        color = field.color(features, ns.Array3f(*(dr.opaque(ns.Float, c) for c in d)))
        colors[:, 3 * k : 3 * k + 3] = color.numpy().T
    return (*(pick(value).numpy().T for value in (block, position, weight, kind)), colors)


def _estimate_visibility(field: RadianceNetwork, resolution: int, u: Array3f) -> tuple[Float, Array3f]:
    """Fraction of the light that a step at points ``u`` absorbs of what arrives from the side of less matter, some
    cells away, and the unit gradient of the opacity there; 0 without one."""
    ns, step = field.ns, field.march_step or field.box.diagonal / 1024
    # The core of a contracted box is the middle half of the unit cube.
    side = field.box.core.cube_side * (2 if field.box.is_contracted else 1)
    density = lambda u: field.density(field.box.from_unit(u)) * step
    cell, slopes = dr.opaque(ns.Float, 1 / resolution), []
    for axis in range(3):
        shift = ns.Array3f(*(cell if k == axis else ns.Float(0) for k in range(3)))
        slopes.append(dr.exp(-density(u - shift)) - dr.exp(-density(u + shift)))
    inwards = dr.normalize(ns.Array3f(*slopes) + 1e-6)
    tau, count = ns.Float(0), max(1, round(_DEPTH * side / resolution / step))
    for k in range(count):
        tau += density(u - inwards * dr.opaque(ns.Float, (k + 0.5) * _DEPTH / (count * resolution)))
    dr.eval(tau)
    return (1 - dr.exp(-density(u))) * dr.exp(-tau), inwards


def _fit_vertices(
    count: int, edge: int, block: np.ndarray, position: np.ndarray, weight: np.ndarray, values: np.ndarray
) -> np.ndarray:
    """Values (count, vertices, K) whose trilinear interpolants at the ``position`` (N, 3) in the ``block`` (N,) of
    points are close to their ``values`` (N, K), with ``weight`` (N,)."""
    vertices = (edge + 1) ** 3
    cell = np.clip((position * edge).astype(np.int32), 0, edge - 1)
    inside = position * edge - cell
    corners = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)])
    # (N, 8): the vertices of the cell of each point, and their weights.
    shares = np.where(corners, inside[:, None], 1 - inside[:, None]).prod(axis=2).astype(np.float32)
    columns = (cell[:, None] + corners) @ np.array([1, edge + 1, (edge + 1) ** 2]) + block[:, None] * vertices
    a = csr_matrix(
        (shares.ravel(), columns.ravel(), np.arange(0, 8 * len(block) + 1, 8)), (len(block), count * vertices)
    )
    weighted = csr_matrix((a.data * np.repeat(weight, 8), a.indices, a.indptr), a.shape).T.tocsr()
    total = weighted @ np.ones(len(block), np.float32)
    # Vertices without points take the mean of their block.
    sums = np.stack([np.bincount(block, v * weight, count) for v in [np.ones(len(block)), *values.T]], axis=1)
    means = sums[:, 1:] / np.maximum(sums[:, :1], 1e-12)
    fitted = np.repeat(means, vertices, axis=0).astype(np.float32)
    for _ in range(_ITERATIONS):
        fitted += weighted @ (values - a @ fitted) / np.maximum(total, 1e-6)[:, None]
    return fitted.reshape(count, vertices, -1)
