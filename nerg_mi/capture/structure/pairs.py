"""Which pictures are compared with which."""

from __future__ import annotations

from itertools import combinations

from nerg_mi.errors import NergError

MATCHING = ("auto", "exhaustive", "sequential")

EXHAUSTIVE = 100
"""Of so many pictures, by default, each is compared with each: the work grows with their square."""

# Neighbours, and after them steps of 16, 32, ...; and pictures, evenly over all, of which each is compared with each:
# they find out where a walk comes back to.
_NEIGHBOURS, _LANDMARKS = 10, 60


def chosen_pairs(count: int, matching: str = "auto") -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of ``count`` pictures in the order in which they were taken; sorted."""
    if matching not in MATCHING:
        raise NergError(f'matching must be {", ".join(MATCHING)}, got "{matching}"')
    if matching == "exhaustive" or (matching == "auto" and count <= EXHAUSTIVE):
        return list(combinations(range(count), 2))
    steps = [*range(1, _NEIGHBOURS + 1), *(1 << k for k in range(4, 32) if 1 << k < count)]
    near = {(i, i + step) for step in steps for i in range(count - step)}
    landmarks = range(0, count, -(-count // _LANDMARKS))
    return sorted(near | set(combinations(landmarks, 2)))
