"""The room: floor, walls with two window openings and a door, furniture, pictures and lamps."""

from __future__ import annotations

import numpy as np
from nerg_mi.scenes.tabletop.mesh import MeshBuilder
from nerg_mi.scenes.tabletop.table import OBJECT_CENTER, choose_book_patch

ROOM = (9.0, 7.0, 3.0)
"""Size in metres; the origin is the south-west corner of the floor."""
NORTH_WINDOW = (1.5, 0.4, 7.7, 2.65)
EAST_WINDOW = (3.5, 0.9, 6.1, 2.45)
"""Openings: from and to along the wall, metres, and heights."""
_THICK = 0.24
_BAR = 0.03


def add_room(builder: MeshBuilder, rng) -> None:
    """Add the room and its furniture without the table; books and plants vary with ``rng``."""
    _add_shell(builder)
    _add_sofa(builder)
    _add_armchair(builder)
    _add_bookcase(builder, rng)
    _add_sideboard(builder, rng)
    _add_pictures(builder)
    _add_lamps(builder)
    _add_plant(builder, np.array([8.35, 6.35, 0.0]), 1.25, rng)
    _add_plant(builder, np.array([1.1, 6.5, 0.0]), 0.75, rng)


def _add_shell(builder: MeshBuilder) -> None:
    x, y, z = ROOM
    builder.add_quad("floor", (0, 0, 0), (x, 0, 0), (0, y, 0), tile=1.4)
    builder.add_quad("ceiling", (0, 0, z), (x, 0, 0), (0, y, 0), tile=1.2)
    builder.add_quad("wall", (0, 0, 0), (x, 0, 0), (0, 0, z), tile=0.9)
    builder.add_quad("wall", (0, 0, 0), (0, y, 0), (0, 0, z), tile=0.9)
    _add_wall_with_opening(
        builder, np.array([0, y, 0.0]), np.array([1.0, 0, 0]), np.array([0, _THICK, 0]), x, NORTH_WINDOW, 5
    )
    _add_wall_with_opening(
        builder, np.array([x, 0, 0.0]), np.array([0, 1.0, 0]), np.array([_THICK, 0, 0]), y, EAST_WINDOW, 2
    )
    for lo, hi in (((0, 0, 0), (x, 0.02, 0.1)), ((0, 0, 0), (0.02, y, 0.1)), ((0, y - 0.02, 0), (x, y, 0.1))):
        builder.add_box("paint", lo, hi, tile=0.5)
    builder.add_box("wood", (7.3, 0.0, 0), (8.2, 0.05, 2.08), tile=1.0)
    for lo, hi in (
        ((7.2, 0, 0), (7.3, 0.07, 2.18)),
        ((8.2, 0, 0), (8.3, 0.07, 2.18)),
        ((7.2, 0, 2.08), (8.3, 0.07, 2.18)),
    ):
        builder.add_box("paint", lo, hi, tile=0.5)
    builder.add_ball("metal", (7.4, 0.09, 1.02), 0.035, steps=12)
    for end in (NORTH_WINDOW[0] - 0.25, NORTH_WINDOW[2] + 0.25):
        u, v = np.meshgrid(np.linspace(-0.35, 0.35, 60), np.linspace(0.03, 2.8, 3))
        folds = np.stack([end + u, y - 0.12 + 0.05 * np.sin(45 * u), v], axis=-1)
        builder.add_surface("curtain", folds, patch=(0, 0, 2, 6))
    builder.add_box("paint", (2.5, y - 0.14, 0.1), (6.7, y - 0.04, 0.36), tile=0.08)
    builder.add_box(
        "rug",
        (OBJECT_CENTER[0] - 1.6, OBJECT_CENTER[1] - 1.15, 0),
        (OBJECT_CENTER[0] + 1.6, OBJECT_CENTER[1] + 1.15, 0.012),
    )


def _add_wall_with_opening(builder: MeshBuilder, corner, along, out, length: float, opening, panes: int) -> None:
    """Add a wall from ``corner`` with an ``opening``, a reveal of depth ``out``, and ``panes`` between bars."""
    up = np.array([0, 0, 1.0])
    a, low, b, high = opening
    spot = lambda s, t: corner + s * along + t * up
    for s0, s1, t0, t1 in ((0, a, 0, ROOM[2]), (b, length, 0, ROOM[2]), (a, b, 0, low), (a, b, high, ROOM[2])):
        builder.add_quad("wall", spot(s0, t0), (s1 - s0) * along, (t1 - t0) * up, tile=0.9)
    for foot, across in (
        (spot(a, low), (b - a) * along),
        (spot(a, high), (b - a) * along),
        (spot(a, low), (high - low) * up),
        (spot(b, low), (high - low) * up),
    ):
        builder.add_quad("paint", foot, across, out, tile=0.5)
    bars = [(s, s, low, high) for s in np.linspace(a, b, panes + 1)]
    bars += [(a, b, t, t) for t in (low, low + 0.72 * (high - low), high)]
    for s0, s1, t0, t1 in bars:
        lo = spot(s0, t0) - _BAR * (along + up) + 0.35 * out
        builder.add_box("paint", lo, spot(s1, t1) + _BAR * (along + up) + 0.65 * out, tile=0.5)


def _add_sofa(builder: MeshBuilder) -> None:
    builder.add_box("sofa", (0.1, 1.3, 0.08), (1.0, 3.7, 0.4), tile=0.5)
    builder.add_box("sofa", (0.1, 1.3, 0.4), (0.34, 3.7, 0.86), tile=0.5)
    for y in (1.3, 3.5):
        builder.add_box("sofa", (0.1, y, 0.4), (1.0, y + 0.2, 0.62), tile=0.5)
    for k, y in enumerate((1.55, 2.2, 2.85)):
        builder.add_box(
            "cushion" if k != 1 else "runner", (0.36, y, 0.41), (0.5, y + 0.48, 0.8), tile=0.4, yaw=0.06 * (k - 1)
        )
    builder.add_box("wood", (1.45, 2.0, 0.34), (2.0, 3.0, 0.38), tile=0.8)
    for x in (1.5, 1.91):
        for y in (2.05, 2.91):
            builder.add_box("wood", (x, y, 0), (x + 0.04, y + 0.04, 0.34), tile=0.5)
    builder.add_box("pictures", (1.6, 2.3, 0.38), (1.82, 2.6, 0.395), patch=(1 / 3, 0.5, 2 / 3, 1), yaw=0.3)


def _add_armchair(builder: MeshBuilder) -> None:
    turn = dict(tile=0.4, yaw=0.0)
    builder.add_box("cushion", (2.0, 5.45, 0.1), (2.85, 6.3, 0.42), **turn)
    builder.add_box("cushion", (2.0, 6.12, 0.42), (2.85, 6.32, 0.95), **turn)
    for x in (1.9, 2.82):
        builder.add_box("cushion", (x, 5.45, 0.1), (x + 0.14, 6.3, 0.6), **turn)
    builder.add_box("sofa", (2.2, 6.0, 0.43), (2.65, 6.12, 0.8), **turn)


def _add_bookcase(builder: MeshBuilder, rng) -> None:
    """Add shelves along the south wall, full of books with gaps and a few vases."""
    x0, x1, deep, high = 2.2, 6.4, 0.32, 2.2
    builder.add_box("wood", (x0, 0.02, 0), (x1, 0.04, high), tile=0.9)
    for x in np.linspace(x0, x1, 5):
        builder.add_box("wood", (x - 0.015, 0.02, 0), (x + 0.015, deep, high), tile=0.9)
    levels = np.linspace(0.06, high - 0.02, 7)
    for z in levels:
        builder.add_box("wood", (x0, 0.02, z - 0.02), (x1, deep, z), tile=0.9)
    for z in levels[:-1]:
        x = x0 + 0.03
        while x < x1 - 0.1:
            thick, tall = rng.uniform(0.025, 0.06), rng.uniform(0.2, 0.31)
            if np.any(np.abs(x + thick / 2 - np.linspace(x0, x1, 5)) < thick / 2 + 0.02):
                x += 0.015
            elif rng.random() < 0.035:
                if rng.random() < 0.5 and x + 0.26 < x1:
                    builder.add_ball("mug", (x + 0.12, 0.18, z + 0.1), (0.07, 0.07, 0.1), 0.1, rng, steps=12)
                x += 0.24
            else:
                front = deep - rng.uniform(0.02, 0.07)
                builder.add_box(
                    "books", (x, 0.05, z), (x + thick, front, z + tall), patch=choose_book_patch(rng), skip="sb"
                )
                x += thick + 0.002


def _add_sideboard(builder: MeshBuilder, rng) -> None:
    builder.add_box("wood", (8.5, 0.7, 0.12), (8.98, 2.9, 0.75), tile=0.9)
    for y in np.linspace(0.7, 2.9, 5)[1:-1]:
        builder.add_box("dark", (8.495, y - 0.006, 0.16), (8.5, y + 0.006, 0.71))
    for y in np.linspace(0.7, 2.9, 9)[1::2]:
        builder.add_ball("metal", (8.48, y, 0.45), 0.018, steps=8)
    builder.add_box("dark", (8.62, 0.8, 0), (8.9, 2.8, 0.12))
    builder.add_revolved("vase", np.array([8.75, 1.1, 0.75]), [(0.05, 0), (0.1, 0.12), (0.05, 0.26), (0.06, 0.3)], 32)
    for k in range(6):
        low = np.array([8.62, 2.0 + 0.06 * k, 0.75])
        builder.add_box("books", low, low + (0.2, 0.05, rng.uniform(0.2, 0.28)), patch=choose_book_patch(rng))
    builder.add_ball("orange", (8.75, 1.6, 0.86), 0.11, steps=20)


def _add_pictures(builder: MeshBuilder) -> None:
    """Add framed paintings: west above the sofa, east above the sideboard, south next to the bookcase."""
    west = [(0, (1.35, 1.25, 2.35, 2.15)), (1, (2.6, 1.25, 3.5, 2.15)), (2, (4.3, 1.0, 5.6, 2.2))]
    for k, (a, low, b, high) in west:
        _add_framed_picture(builder, k, (0.0, a, low), (0.04, b, high), (0.042, a, low), (0, b - a, 0), high - low)
    _add_framed_picture(builder, 3, (8.96, 0.9, 1.2), (9.0, 2.7, 2.25), (8.957, 0.9, 1.2), (0, 1.8, 0), 1.05)
    _add_framed_picture(builder, 4, (0.7, 0.0, 1.15), (1.8, 0.04, 2.25), (0.7, 0.042, 1.15), (1.1, 0, 0), 1.1)
    _add_framed_picture(builder, 5, (6.55, 0.0, 1.3), (7.05, 0.04, 1.9), (6.55, 0.042, 1.3), (0.5, 0, 0), 0.6)


def _add_framed_picture(builder: MeshBuilder, k: int, lo, hi, corner, along, high: float) -> None:
    """Add painting ``k`` on the box ``lo`` to ``hi``, with a rim of five centimetres."""
    builder.add_box("dark", lo, hi)
    unit = np.asarray(along) / np.linalg.norm(along)
    row, column = divmod(k, 3)
    patch = (column / 3, row / 2, (column + 1) / 3, (row + 1) / 2)
    start = np.asarray(corner) + 0.05 * unit + (0, 0, 0.05)
    builder.add_quad("pictures", start, along - 0.1 * unit, (0, 0, high - 0.1), patch=patch)


def _add_lamps(builder: MeshBuilder) -> None:
    x, y = OBJECT_CENTER[:2]
    builder.add_quad("panel", (x - 1.7, y - 1.4, 2.96), (3.4, 0, 0), (0, 2.8, 0))
    builder.add_box("paint", (x - 1.75, y - 1.45, 2.94), (x + 1.75, y - 1.4, 3.0), tile=0.5)
    builder.add_box("paint", (x - 1.75, y + 1.4, 2.94), (x + 1.75, y + 1.45, 3.0), tile=0.5)
    builder.add_box("paint", (x - 1.75, y - 1.4, 2.94), (x - 1.7, y + 1.4, 3.0), tile=0.5)
    builder.add_box("paint", (x + 1.7, y - 1.4, 2.94), (x + 1.75, y + 1.4, 3.0), tile=0.5)
    builder.add_revolved("dark", np.array([0.55, 4.4, 0.0]), [(0.001, 0.03), (0.16, 0.03), (0.17, 0.0)], 32)
    builder.add_tube("dark", [(0.55, 4.4, z) for z in (0.0, 0.5, 1.0, 1.6)], 0.014)
    builder.add_revolved("shade", np.array([0.55, 4.4, 1.45]), [(0.2, 0.0), (0.13, 0.32)], 32)


def _add_plant(builder: MeshBuilder, at: np.ndarray, high: float, rng) -> None:
    builder.add_revolved("bowl", at, [(0.12, 0), (0.17, 0.3 * high), (0.15, 0.3 * high), (0.145, 0.27 * high)], 32)
    builder.add_revolved("soil", at, [(0.001, 0.27 * high), (0.15, 0.27 * high)], 24)
    builder.add_tube("bark", [at + (0, 0, z * high) for z in (0.25, 0.5, 0.8)], 0.018)
    for _ in range(16):
        spot = at + (*rng.normal(0, 0.11, 2), high * rng.uniform(0.55, 1.05))
        builder.add_ball("tree", spot, rng.uniform(0.07, 0.13), 0.5, rng, patch=(0, 0, 0.5, 0.3), steps=12)
