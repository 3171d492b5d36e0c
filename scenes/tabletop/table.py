"""The table with a vase of flowers, books, a bowl of fruit, toy blocks and a mug."""

from __future__ import annotations

import numpy as np
from nerg_mi.scenes.tabletop.mesh import MeshBuilder

OBJECT_CENTER = np.array([4.6, 3.4, 0.93])
"""Centre of the photographed object, in metres."""
TABLE_HEIGHT = 0.75
"""Height of the table, in metres."""
_HALF_SIZE = 0.78, 0.5


def choose_book_patch(rng) -> tuple[float, float, float, float]:
    """Choose the back of one of the 32 books of `textures.spines`."""
    k = int(rng.integers(32))
    return k / 32, 0.0, (k + 1) / 32, 1.0


def add_table(builder: MeshBuilder, rng) -> None:
    """Add the table, and the objects on it at positions drawn from ``rng``."""
    x, y = OBJECT_CENTER[:2]
    w, d = _HALF_SIZE
    builder.add_box("table", (x - w, y - d, TABLE_HEIGHT - 0.045), (x + w, y + d, TABLE_HEIGHT), tile=1.1)
    builder.add_box(
        "table",
        (x - w + 0.08, y - d + 0.08, TABLE_HEIGHT - 0.13),
        (x + w - 0.08, y + d - 0.08, TABLE_HEIGHT - 0.045),
        tile=1.1,
    )
    for sx in (-1, 1):
        for sy in (-1, 1):
            leg = np.array([x + sx * (w - 0.11), y + sy * (d - 0.11), 0])
            builder.add_box("table", leg - (0.035, 0.035, 0), leg + (0.035, 0.035, TABLE_HEIGHT - 0.13), tile=0.6)
    builder.add_box("runner", (x - 0.6, y - 0.2, TABLE_HEIGHT), (x + 0.6, y + 0.2, TABLE_HEIGHT + 0.003), tile=0.3)
    for side in (-1, 1):
        seat = np.array([x + 0.25 * side, y - 0.62 * side, 0.0])
        builder.add_revolved("stool", seat, [(0.02, 0.45), (0.17, 0.45), (0.18, 0.43), (0.17, 0.41), (0.02, 0.41)], 32)
        for angle in np.arange(3) * 2 * np.pi / 3 + 0.4:
            foot = seat + (0.15 * np.cos(angle), 0.15 * np.sin(angle), 0)
            builder.add_tube(
                "table", np.linspace(foot, seat + (0.08 * np.cos(angle), 0.08 * np.sin(angle), 0.42), 4), 0.016
            )
    _add_vase(builder, np.array([x, y, TABLE_HEIGHT + 0.003]), rng)
    _add_books(builder, np.array([x - 0.36, y + 0.1, TABLE_HEIGHT + 0.003]), rng)
    _add_fruit(builder, np.array([x + 0.34, y - 0.08, TABLE_HEIGHT + 0.003]), rng)
    for k, spot in enumerate([(0.12, 0.33, 0), (0.2, 0.31, 0), (0.155, 0.325, 0.06)]):
        low = np.array([x, y, TABLE_HEIGHT]) + spot
        builder.add_box(
            "pictures", low, low + 0.06, patch=(k / 3, 0.0, (k + 1) / 3, 0.5), yaw=float(rng.uniform(0, 1.5))
        )
    _add_mug(builder, np.array([x - 0.2, y - 0.34, TABLE_HEIGHT]))


def _add_vase(builder: MeshBuilder, foot: np.ndarray, rng) -> None:
    height = np.linspace(0, 1, 40)
    # the outline through a foot, a belly, a neck and a rim
    radius = np.interp(height, [0, 0.03, 0.35, 0.72, 0.92, 1], [0.05, 0.056, 0.095, 0.052, 0.036, 0.048])
    radius = np.convolve(np.pad(radius, 3, mode="edge"), np.full(7, 1 / 7), "valid")
    builder.add_revolved("vase", foot, np.stack([radius, 0.24 * height], axis=-1), 64)
    builder.add_revolved("soil", foot, [(0.001, 0.225), (0.04, 0.225)], 24)
    for k in range(13):
        angle, tip_radius = 2.4 * k + rng.uniform(-0.3, 0.3), rng.uniform(0.03, 0.15)
        tip = np.array(
            [tip_radius * np.cos(angle), tip_radius * np.sin(angle), rng.uniform(0.3, 0.46) - 0.5 * tip_radius]
        )
        t = np.linspace(0, 1, 9)[:, None]
        stem = foot + (0, 0, 0.2) + t**1.6 * tip * (1, 1, 0) + t * (0, 0, tip[2] - 0.2)
        builder.add_tube("leaf", stem, 0.0035, 6)
        flower = stem[-1]
        size = rng.uniform(0.022, 0.036)
        k4 = int(rng.integers(4))
        builder.add_ball("blossom", flower, (size, size, 0.75 * size), 0.35, rng, (k4 / 4, 0, (k4 + 1) / 4, 1), 14)
        _add_leaf(builder, stem[rng.integers(3, 7)], angle + rng.uniform(-1, 1), rng.uniform(0.07, 0.12))


def _add_leaf(builder: MeshBuilder, stalk: np.ndarray, angle: float, length: float) -> None:
    """Add a leaf that bends down, folded along its middle."""
    t, s = np.meshgrid(np.linspace(0, 1, 10), np.linspace(-1, 1, 5), indexing="ij")
    wide = 0.17 * np.sin(np.pi * np.clip(t, 0.03, 0.97)) * s
    out, up = t, 0.55 * t - 0.75 * t**2 + 0.5 * np.abs(wide)
    c, d = np.cos(angle), np.sin(angle)
    blade = np.stack([c * out - d * wide, d * out + c * wide, up], axis=-1)
    builder.add_surface("leaf", stalk + length * blade)


def _add_books(builder: MeshBuilder, at: np.ndarray, rng) -> None:
    height = 0.0
    for yaw in (0.15, 0.4, 0.02):
        thick, wide, deep = rng.uniform(0.025, 0.04), rng.uniform(0.2, 0.24), rng.uniform(0.14, 0.17)
        low = at + (-wide / 2, -deep / 2, height)
        builder.add_box("books", low, low + (wide, deep, thick), patch=choose_book_patch(rng), yaw=yaw)
        height += thick


def _add_fruit(builder: MeshBuilder, at: np.ndarray, rng) -> None:
    bowl = [(0.05, 0.0), (0.055, 0.012), (0.1, 0.03), (0.135, 0.06), (0.145, 0.085), (0.137, 0.085), (0.12, 0.06)]
    builder.add_revolved("bowl", at, [*bowl, (0.09, 0.035), (0.002, 0.025)], 48)
    for k in range(6):
        angle, ring = k * 2 * np.pi / 5, 0.075 if k < 5 else 0.0
        ball = at + (ring * np.cos(angle), ring * np.sin(angle), 0.075 if k < 5 else 0.12)
        builder.add_ball(("apple", "orange", "lemon")[k % 3], ball, (0.04, 0.04, 0.037), 0.04, rng, steps=18)


def _add_mug(builder: MeshBuilder, at: np.ndarray) -> None:
    builder.add_revolved("mug", at, [(0.002, 0.002), (0.038, 0.002), (0.041, 0.01), (0.041, 0.095), (0.037, 0.095)], 40)
    builder.add_revolved("soil", at, [(0.001, 0.08), (0.038, 0.08)], 24)
    angle = np.linspace(-1.4, 1.4, 12)
    handle = np.stack([-0.03 - 0.03 * np.cos(angle), 0 * angle, 0.05 + 0.03 * np.sin(angle)], axis=-1)
    builder.add_tube("mug", at + handle, 0.006)
