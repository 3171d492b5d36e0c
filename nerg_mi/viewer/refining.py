"""A picture that is refined in steps: small at once, then in full, then with more samples a pixel.

It is a generator, so that whoever drives it can stop between two bands of rays. Its values are those of the integrator
`nerg` (`nerg_mi.api.trace`).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from nerg_mi.api.queries import trace
from nerg_mi.api.scene import Scene
from nerg_mi.transport.geometry import Ceiling

from .view import View

BAND_SECONDS = 0.35
"""A band of rays should take so long at most: what is more urgent waits for its end."""

SIZES = tuple(1 << k for k in range(13, 18))
"""Numbers of rays in a band."""

DIRECTIONS = 1 << 12
"""Of the integral over an observer's sphere that a normalised gaze field is divided by: right to some thousandths, in a
tenth of the time that the settings of a scene take."""

SHARES = (4, 2, 1)
"""The picture is computed first with a quarter of its columns and rows, then with half of them, then with all."""


@dataclass(frozen=True, eq=False)
class Picture:
    """``values`` (height, width) or (height, width, channels) by quantity, means of ``samples`` a pixel; ``seconds``
    since it was begun; ``share``: one of `SHARES`; ``whole``: whether this is the last."""

    values: dict[str, np.ndarray]
    samples: int
    seconds: float
    share: int
    whole: bool


class Pace:
    """How many rays a band has, one of `SIZES`, learnt from the time of those before."""

    def __init__(self) -> None:
        self._at = 0
        self._slow = 0

    @property
    def rays(self) -> int:
        """So many."""
        return SIZES[self._at]

    def learn(self, seconds: float) -> None:
        """A band of `rays` took so long."""
        # Once is chance, or a kernel that was compiled.
        self._slow = self._slow + 1 if seconds > 1.5 * BAND_SECONDS else 0
        if self._slow > 1:
            self._at, self._slow = max(self._at - 1, 0), 0
        elif seconds < 0.4 * BAND_SECONDS:
            self._at = min(self._at + 1, len(SIZES) - 1)


def refine(
    scene: Scene,
    view: View,
    observer: np.ndarray | None,
    quantities: Sequence[str],
    width: int,
    spp: int,
    pace: Pace,
    *,
    ceiling: Ceiling | None = None,
    seed: int = 0,
) -> Iterator[Picture | None]:
    """Pictures of ``quantities``, each better than the one before; None after each band of one.

    ``observer`` (3,): whose gaze it is; None: that of whoever stands at the camera. ``width`` in pixels and ``spp``
    samples a pixel of the last. ``ceiling``: what is left out of views from above, whatever the scene says of it.
    """
    start = time.perf_counter()
    random = np.random.default_rng(seed)
    sums: dict[str, np.ndarray] = {}
    for share in SHARES:
        columns = max(width // share, 1)
        rows = max(view.height(width) // share, 1)
        samples = spp if share == 1 else 1
        for sample in range(samples):
            within = random.random((rows * columns, 2)) if sample or samples > 1 else np.full((rows * columns, 2), 0.5)
            directions = view.rays(columns, rows, within)
            parts: list[dict[str, np.ndarray]] = []
            done = 0
            while done < len(directions):
                began = time.perf_counter()
                part, size = directions[done : done + pace.rays], pace.rays
                turn = seed + 7919 * sample + done
                # The last and largest picture is that of the scene's own settings.
                with rough_integrals(scene, share > 1), cut(scene, ceiling):
                    found = _traced(scene, view.origin, filled(part, size), quantities, observer, turn)
                parts.append({name: v[: len(part)] for name, v in found.items()})
                pace.learn(time.perf_counter() - began)
                done += len(part)
                yield None
            values = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
            shaped = {name: v.reshape(rows, columns, *v.shape[1:]).astype(np.float64) for name, v in values.items()}
            sums = shaped if sample == 0 else {name: sums[name] + v for name, v in shaped.items()}
            number = sample + 1
            # Each one twice as good as the one before; others would only be sent.
            if number == samples or number & (number - 1) == 0:
                means = {name: (v / number).astype(np.float32) for name, v in sums.items()}
                whole = share == 1 and number == samples
                yield Picture(means, number, time.perf_counter() - start, share, whole)


@contextmanager
def rough_integrals(scene: Scene, rough: bool = True) -> Iterator[None]:
    """Let gaze fields be integrated over `DIRECTIONS` alone within the block, where ``rough``."""
    integrator = scene.integrator
    own = integrator.observer_settings
    if rough and own.directions > DIRECTIONS:
        integrator.observer_settings = replace(own, directions=DIRECTIONS)
    try:
        yield
    finally:
        integrator.observer_settings = own


@contextmanager
def cut(scene: Scene, ceiling: Ceiling | None) -> Iterator[None]:
    """Leave out what is above the ``ceiling`` within the block."""
    integrator = scene.integrator
    own = integrator.ceiling
    integrator.ceiling = ceiling
    try:
        yield
    finally:
        integrator.ceiling = own


def filled(directions: np.ndarray, size: int) -> np.ndarray:
    """``directions`` with the last one again and again, up to ``size``."""
    missing = size - len(directions)
    return np.concatenate([directions, np.repeat(directions[-1:], missing, axis=0)]) if missing > 0 else directions


def _traced(
    scene: Scene,
    origin: np.ndarray,
    directions: np.ndarray,
    quantities: Sequence[str],
    observer: np.ndarray | None,
    seed: int,
) -> dict[str, np.ndarray]:
    """Quantities (N,) or (N, channels) of rays from ``origin``."""
    eyes = origin if observer is None else observer
    found = trace(scene, origin[None], directions, list(quantities), observers=eyes[None], seed=seed)
    return {name: np.asarray(found[name][0]) for name in quantities}
