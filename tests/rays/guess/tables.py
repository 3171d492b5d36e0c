"""A walk in the frame of rays, and tables of it as many programs would write them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

N = 1500
OTHERS = {
    "z right": np.eye(3),
    "y left": np.eye(3)[[0, 2, 1]],
    "y right": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
"""From the frame of rays to others, by rows."""
FORWARD = {"z right": [1.0, 0, 0], "y left": [0, 0, 1.0], "y right": [0, 0, -1.0]}


@dataclass(frozen=True)
class Walk:
    """Half a minute at 50 Hz: ``eye`` (n, 3), ``gaze`` (n, 3) unit, the ``heading`` (n,) of the head, ``t`` seconds."""

    t: np.ndarray
    eye: np.ndarray
    gaze: np.ndarray
    heading: np.ndarray


def walk(seed: int = 0) -> Walk:
    rng = np.random.default_rng(seed)
    t = 100 + 0.02 * np.arange(N)
    heading = np.cumsum(rng.normal(0, 0.04, N))
    step = 0.02 * 1.1 * np.c_[np.cos(heading), np.sin(heading), np.zeros(N)]
    eye = np.cumsum(step, axis=0) + [3.0, -2.0, 1.62] + rng.normal(0, 0.01, (N, 3)) * [0, 0, 1]
    turned, lift = heading + rng.normal(0, 0.2, N), rng.normal(-0.15, 0.1, N)
    gaze = np.c_[np.cos(lift) * np.cos(turned), np.cos(lift) * np.sin(turned), np.sin(lift)]
    return Walk(t, eye, gaze, heading)


def frame(w: Walk, to: str, metre: float = 1.0) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Eyes, gaze and heads of a walk in another frame: rotations of the head's frame there, which looks along
    `FORWARD`."""
    m = OTHERS[to]
    ahead, up = np.c_[np.cos(w.heading), np.sin(w.heading), np.zeros(N)] @ m.T, m @ [0, 0, 1]
    f = np.array(FORWARD[to])
    # Columns of each rotation: where the head's own axes point.
    own = np.stack([f, up, np.cross(f, up)])
    there = np.stack([ahead, np.tile(up, (N, 1)), np.cross(ahead, up)], axis=2)
    return w.eye @ m.T / metre, w.gaze @ m.T, Rotation.from_matrix(there @ own)


def csv(**columns) -> str:
    names = [name.replace("__", " ") for name in columns]
    rows = zip(*(np.asarray(c).tolist() for c in columns.values()))
    return "\n".join([",".join(names), *(",".join(map(str, row)) for row in rows)]) + "\n"


def xyz(stem: str, values: np.ndarray, axes: str = "xyz") -> dict[str, np.ndarray]:
    return {f"{stem}{a}": v for a, v in zip(axes, values.T)}
