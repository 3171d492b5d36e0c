"""Synthetic participants for tests of the checks, filters and events of rays."""

from dataclasses import replace

import numpy as np

from nerg_mi.errors import clean_text
from nerg_mi.tracking.quality import summarise
from nerg_mi.tracking.rays import FRAME, Rays
from nerg_mi.tracking.readers.base import TrackingFrame


def walk(hit=True, frame=None, seed=0):
    """Two minutes of a person who walks at eye height and looks roughly ahead, at surfaces two metres away."""
    rng = np.random.default_rng(seed)
    n = 6000
    t = np.arange(n) * 0.02
    heading = np.cumsum(rng.normal(0, 0.05, n))
    step = 0.02 * np.stack([np.cos(heading), np.sin(heading), np.zeros(n)], axis=1)
    origin = np.cumsum(step, axis=0) + [0, 0, 1.6]
    turned = heading + rng.normal(0, 0.6, n)
    d = np.stack([np.cos(turned), np.sin(turned), rng.normal(-0.2, 0.2, n)], axis=1)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    metadata = {"frame": dict(FRAME), "transform": TrackingFrame(**(frame or {})).to_rays().tolist()}
    return Rays(t, np.zeros(n), ("ann",), origin, d, np.ones(n), origin + 2 * d if hit else None, metadata)


def warnings_of(rays):
    return clean_text(" | ".join(summarise(rays).warnings))


def watch(people=3, n=3000, seed=0):
    """A minute each of participants who walk in a room of 6 x 4 m and look at one point after another: their eyes make
    a saccade every third of a second, and their heads follow."""
    rng, parts = np.random.default_rng(seed), []
    t = np.arange(n) * 0.02
    for _ in range(people):
        a, b = rng.uniform(0, 2 * np.pi, 2)
        speed = rng.uniform(0.25, 0.35)
        floor = np.stack([4 + 2.5 * np.sin(speed * t + a), 3 + 1.5 * np.sin(1.31 * speed * t + b)], axis=1)
        origin = np.column_stack([floor, np.full(n, rng.uniform(1.5, 1.75)) + 0.01 * np.sin(9 * t)])
        ahead = np.arctan2(*np.gradient(floor, axis=0).T[::-1])
        jumps = np.repeat(rng.normal(0, [[0.7, 0.3]], (n // 16 + 1, 2)), 16, axis=0)[:n]
        yaw, pitch = np.repeat(ahead[::16], 16)[:n] + jumps[:, 0], jumps[:, 1]
        far = 2 * np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=1)
        hit = np.repeat(origin[::16], 16, axis=0)[:n] + far
        d = hit - origin
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        kernel = np.hanning(41) / np.hanning(41).sum()
        head = np.stack([np.convolve(np.pad(c, 20, mode="edge"), kernel, mode="valid") for c in d.T], axis=1)
        d = d + rng.normal(0, 0.002, d.shape)
        unit = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (d, head)]
        parts.append((t, origin, unit[0], hit, unit[1]))
    t, origin, d, hit, head = (np.concatenate(column) for column in zip(*parts))
    names = ("ann", "bo", "cy", "di", "ed", "flo", "gus", "hal")[:people]
    metadata = {"frame": dict(FRAME), "transform": np.eye(4).tolist()}
    return Rays(t, np.repeat(np.arange(people), n), names, origin, d, np.ones(len(t)), hit, metadata, head=head)


def change(rays, rows, **columns):
    """``rays`` with other values in some rows."""
    new = {}
    for name, value in columns.items():
        new[name] = getattr(rays, name).copy()
        new[name][rows] = value(new[name][rows]) if callable(value) else value
    return replace(rays, **new)


def some_rays(n, **columns):
    """Rays of one person at the origin who looks along x, except for ``columns``."""
    ahead = np.tile([1.0, 0, 0], (n, 1))
    values = {"t": np.arange(n) * 0.1, "person": np.zeros(n), "origin": np.zeros((n, 3)), "direction": ahead}
    return Rays(**{**values, "persons": ("ann", "bo"), "confidence": np.ones(n), **columns})
