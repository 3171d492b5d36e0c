"""Running ``nerg rays`` in tests, and a file of rays to run it on."""

from __future__ import annotations

import numpy as np
from typer.testing import CliRunner

from nerg_mi.cli import build_app
from nerg_mi.tracking.rays import Rays


def run(*arguments):
    return CliRunner().invoke(build_app(), ["rays", *(str(a) for a in arguments)])


def write_walk(path):
    """Four participants on a 4 x 3 m floor, a minute each, who look at a target two metres away and stop at the end."""
    rng = np.random.default_rng(0)
    n = 3000
    origin = np.concatenate(
        [np.cumsum(rng.normal(0, 0.02, (n, 3)) * (1, 1, 0.1), axis=0) % [4, 3, 9] + [0, 0, 1.6] for _ in range(4)]
    )
    d = rng.normal(size=(4 * n, 3)) * 0.02 + np.repeat(np.eye(3)[[0, 1, 0, 1]], n, axis=0)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    t = np.tile(np.arange(n) * 0.02, 4) + np.repeat(
        np.arange(4) * 1e-5, n
    )  # all times differ, so that they identify rays
    rays = Rays(t, np.repeat(np.arange(4), n), tuple("abcd"), origin, d, np.ones(4 * n), origin + 2 * d)
    rays.save(path)
    return path
