"""Where tracking lies in a place, from nothing but the tracking, where up and the floor are known: the first guess.

For every turn about the vertical and every scale, all shifts at once: hit points are counted on the place's lattice and
correlated, by fast Fourier transforms level by level, with how near its surfaces are; heads likewise with free space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from .surface import PlaceSurface

NEAR = 0.25
"""Metres within which a hit point counts as on a surface, at this stage."""

_TURNS, _CELLS, _KEPT = 36, 48, 16
_MOST = 4000


@dataclass(frozen=True, eq=False)
class Guess:
    """``matrix`` (4, 4) from the tracking to the place, and its score, 1 where all is well."""

    matrix: np.ndarray
    score: float


def scale_range(surface: PlaceSurface, points: np.ndarray) -> np.ndarray:
    """Scales to be tried for ``points`` (N, 3) that lie on surfaces: from what lets them fill the place, down to a
    third of it, since people may have walked in a part of it; in steps of eight percent."""
    size = lambda p: float(np.linalg.norm(np.subtract(*np.percentile(p, [98, 2], axis=0))[:2]))
    most = 1.25 * size(surface.points) / max(size(points), 1e-9)
    return most / 1.08 ** np.arange(15)


def search(
    surface: PlaceSurface,
    hits: np.ndarray,
    free: np.ndarray,
    scales: Sequence[float] | np.ndarray,
    floor: tuple[float, float],
    turns: int = _TURNS,
    kept: int = _KEPT,
) -> list[Guess]:
    """The best guesses, best first.

    ``hits`` (N, 3), which may be none, and ``free`` (M, 3), heads and what gaze passes, in the frame of the tracking;
    ``floor``: its height there and in the place.
    """
    rng = np.random.default_rng(0)
    some = lambda p: p[rng.permutation(len(p))[:_MOST]]
    hits, free = some(hits), some(free)
    found: list[Guess] = []
    low, high = surface.distance.lower, surface.distance.upper
    for scale in scales:
        maps = _Maps(surface, low, high, scale)
        for angle in 2 * np.pi * np.arange(turns) / turns:
            found += maps.best(hits, free, angle, floor)
    found.sort(key=lambda g: -g.score)
    return _apart(found, kept, 0.05 * surface.diagonal)


class _Maps:
    """A place on a coarse lattice, for one scale: what a point of either kind is worth in each cell."""

    def __init__(self, surface: PlaceSurface, low: np.ndarray, high: np.ndarray, scale: float):
        self.scale, self.low = scale, low
        self.cell = float(np.max((high - low)[:2])) / _CELLS
        self.shape = np.maximum(np.ceil((high - low) / self.cell).astype(int), 1)
        nodes = np.stack(np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij"), axis=-1)
        nodes = low + self.cell * (nodes.reshape(-1, 3) + 0.5)
        wide = max(NEAR * scale, 0.7 * self.cell)
        on = np.exp(-0.5 * (surface.distance.at(nodes) / wide) ** 2)
        open_ = np.exp(-0.5 * (surface.blocked.at(nodes) / wide) ** 2)
        # Twice as wide, so that what leaves it on one side does not come in on the other.
        self.size = [_fast(2 * int(n)) for n in self.shape[:2]]
        levels = lambda v: np.asarray(fft.rfft2(_by_level(v.reshape(self.shape)), self.size, axes=(1, 2)))
        self.on, self.open = levels(on), levels(open_)

    def best(self, hits: np.ndarray, free: np.ndarray, angle: float, floor: tuple[float, float]) -> list[Guess]:
        """The best shifts of a turn."""
        cos, sin = np.cos(angle), np.sin(angle)
        turn = self.scale * np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        lift = floor[1] - self.scale * floor[0]
        corner = None
        total = np.zeros(self.size)
        for points, maps in ((hits, self.on), (free, self.open)):
            if not len(points):
                continue
            moved = points @ turn.T + (0, 0, lift)
            if corner is None:
                corner = np.percentile(np.concatenate([moved, free @ turn.T + (0, 0, lift)])[:, :2], 1, axis=0)
            total += self._correlation(moved, corner, maps)
        assert corner is not None
        parts = (len(hits) > 0) + (len(free) > 0)
        out = []
        for _ in range(2):
            at = np.array(np.unravel_index(int(np.argmax(total)), total.shape))
            score = float(total[tuple(at)]) / parts
            shift = np.where(at > np.array(self.size) // 2, at - self.size, at) * self.cell
            matrix = np.eye(4)
            matrix[:3, :3] = turn
            matrix[:3, 3] = *(self.low[:2] + shift - corner), lift
            out.append(Guess(matrix, score))
            # The next one is another one.
            rows, columns = ((at[a] + np.arange(-3, 4)) % self.size[a] for a in (0, 1))
            total[np.ix_(rows, columns)] = -1
        return out

    def _correlation(self, moved: np.ndarray, corner: np.ndarray, maps: np.ndarray) -> np.ndarray:
        """Mean worth of points for every shift of ``corner`` to a cell."""
        index = np.floor((moved - (*corner, self.low[2])) / self.cell).astype(int)
        # Beyond the lattice, and in cells that wrap around, nothing is worth anything.
        inside = ((index >= (0, 0, 0)) & (index < (*self.shape[:2], self.shape[2]))).all(axis=1)
        flat = np.ravel_multi_index(tuple(index[inside].T), self.shape)
        count = np.bincount(flat, minlength=int(np.prod(self.shape))).reshape(self.shape)
        spectrum = np.asarray(fft.rfft2(_by_level(count), self.size, axes=(1, 2)))
        joint = np.einsum("zxy,zxy->xy", np.conj(spectrum), maps)
        return np.asarray(fft.irfft2(joint, self.size)) / max(len(moved), 1)


def _fast(length: int) -> int:
    """The next length that factors into 2, 3 and 5, which transforms are fast at."""
    while True:
        rest = length
        for p in (2, 3, 5):
            while rest % p == 0:
                rest //= p
        if rest == 1:
            return length
        length += 1


def _by_level(values: np.ndarray) -> np.ndarray:
    """(nx, ny, nz) as (nz, nx, ny); single precision is enough for a guess."""
    return np.ascontiguousarray(np.moveaxis(values, 2, 0), np.float32)


def close(a: np.ndarray, b: np.ndarray, distance: float) -> bool:
    """Whether two similarities (4, 4) are of the same placement: within a ``distance`` in the place, and a fifth of
    turn and scale."""
    turned = np.linalg.norm(a[:3, :3] - b[:3, :3]) < 0.2 * np.linalg.norm(b[:3, :3])
    return bool(turned and np.linalg.norm(a[:3, 3] - b[:3, 3]) < distance)


def _apart(found: list[Guess], count: int, distance: float) -> list[Guess]:
    """The first ``count`` that are not close to a better one."""
    out: list[Guess] = []
    for guess in found:
        if not any(close(guess.matrix, o.matrix, distance) for o in out):
            out.append(guess)
        if len(out) == count:
            break
    return out
