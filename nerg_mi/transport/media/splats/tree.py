"""A bounding-volume hierarchy that is walked without a stack: a complete binary tree of boxes.

Node i has the children 2 i and 2 i + 1, the root is 1, and all leaves lie on one level, so that the way from the root
is a number of bits (cf. Hapala et al. 2011, "Efficient Stack-less BVH Traversal for Ray Tracing"). Every node is split
at the median of its longest side, into halves that are one apart at most. Plain NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

COLUMNS = 8
"""Numbers a node: the lower and the upper corner of its box, the axis that it is split along, and one unused."""

_NOWHERE = np.float32(1e30)
# Boxes are this much wider than what is in them, for the rounding of rays.
_SLACK = np.float32(1e-6)


@dataclass(frozen=True)
class Tree:
    """Of N boxes."""

    # The box that stands at each place of the tree's order, (N,) int64.
    order: np.ndarray
    # The nodes from number 1 on, (2 leaves, COLUMNS) float32; what holds nothing is a point
    # beyond all distances.
    nodes: np.ndarray
    # Which place of the order a leaf holds, (leaves,) uint32.
    places: np.ndarray

    @property
    def leaves(self) -> int:
        """How many there are: a power of 2."""
        return len(self.places)


def build_tree(lower: np.ndarray, upper: np.ndarray) -> Tree:
    """The tree of N boxes with the corners ``lower`` and ``upper``, (N, 3) each, finite."""
    lower, upper = (np.asarray(v, np.float32) for v in (lower, upper))
    n = len(lower)
    depth = max(n - 1, 0).bit_length()
    centers = 0.5 * (lower.astype(np.float64) + upper)
    nodes = np.zeros((2 << depth, COLUMNS), np.float32)
    order, part, sizes = np.arange(n), np.zeros(n, np.int64), np.array([n])
    for level in range(depth):
        # Parts that have become empty are given some neighbour's box, of which nothing comes.
        starts = np.minimum(np.cumsum(sizes) - sizes, n - 1)
        here = centers[order]
        low, high = np.minimum.reduceat(here, starts), np.maximum.reduceat(here, starts)
        axis = np.argmax(high - low, axis=1)
        nodes[1 << level : 2 << level, 6] = axis
        along = axis[part]
        start = low[part, along]
        size = np.maximum(high[part, along] - start, 1e-300)
        # One sort for all parts: each has a whole number of its own.
        sorting = np.argsort(part + 0.999 * ((here[np.arange(n), along] - start) / size), kind="stable")
        order = order[sorting]
        left = (sizes + 1) // 2
        sizes = np.stack([left, sizes - left], axis=1).ravel()
        part = np.repeat(np.arange(len(sizes)), sizes)
    leaves = 1 << depth
    places = np.zeros(leaves, np.uint32)
    places[part] = np.arange(n)
    wider = _SLACK * np.maximum(np.abs(lower), np.abs(upper))
    nodes[:, :3], nodes[:, 3:6] = _NOWHERE, -_NOWHERE
    nodes[leaves + part, :3], nodes[leaves + part, 3:6] = (lower - wider)[order], (upper + wider)[order]
    for level in range(depth - 1, -1, -1):
        here, below = slice(1 << level, 2 << level), nodes[2 << level : 4 << level]
        nodes[here, :3] = np.minimum(below[::2, :3], below[1::2, :3])
        nodes[here, 3:6] = np.maximum(below[::2, 3:6], below[1::2, 3:6])
    # A ray's distances to a box without an inside would be put in order like any others: a point far away has none.
    nodes[nodes[:, 0] > nodes[:, 3], :6] = _NOWHERE
    return Tree(order, nodes, places)
