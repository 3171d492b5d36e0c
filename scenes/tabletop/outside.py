"""The view through the windows: a garden, a street with houses and trees at 30 to 200 m, and hills."""

from __future__ import annotations

import numpy as np
from nerg_mi.scenes.tabletop.mesh import MeshBuilder, rotate_about_z
from nerg_mi.scenes.tabletop.room import ROOM
from nerg_mi.scenes.tabletop.table import OBJECT_CENTER

GROUND = -1.1
"""Height of the ground outside, in metres: the room is a few steps above the garden."""
# Bearings from the table, degrees counter-clockwise from east, of the view through the east and the north window.
_BEARINGS = (-12, 148)


def add_landscape(builder: MeshBuilder, rng) -> None:
    """Add the land around the house, to the north and east, where the windows are."""
    builder.add_quad("grass", (-900, -900, GROUND - 0.02), (1800, 0, 0), (0, 1800, 0), tile=60)
    builder.add_quad("grass", (-40, -40, GROUND), (90, 0, 0), (0, 90, 0), tile=9)
    _add_garden(builder, rng)
    for distance, count, size in ((34, 5, 1.0), (62, 7, 1.15), (105, 9, 1.35), (170, 11, 1.6)):
        for bearing in np.linspace(*_BEARINGS, count) + rng.uniform(-4, 4, count):
            _add_house(builder, _ground_position(bearing, distance * rng.uniform(0.93, 1.1)), size, rng)
    for distance, count in ((26, 6), (48, 12), (85, 16), (140, 22), (200, 30)):
        for bearing in np.linspace(*_BEARINGS, count) + rng.uniform(-5, 5, count):
            _add_tree(builder, _ground_position(bearing, distance * rng.uniform(0.9, 1.1)), rng.uniform(5, 9), rng)
    for k in range(9):
        hill = _ground_position(_BEARINGS[0] + 20 * k, rng.uniform(420, 560))
        builder.add_ball("hill", hill, (150, 150, rng.uniform(32, 60)), 0.15, rng, (0, 0, 8, 4), 24)


def _ground_position(bearing: float, distance: float) -> np.ndarray:
    """Return the ground position at a ``bearing`` in degrees and a ``distance`` in metres from the table."""
    a = np.radians(bearing)
    return np.array([OBJECT_CENTER[0] + distance * np.cos(a), OBJECT_CENTER[1] + distance * np.sin(a), GROUND])


def _add_garden(builder: MeshBuilder, rng) -> None:
    north, east = ROOM[1], ROOM[0]
    builder.add_box("paving", (-2, north + 0.3, GROUND), (east + 4, north + 2.6, GROUND + 0.12), tile=1.5)
    builder.add_box("paving", (5.2, north + 2.6, GROUND), (6.4, north + 16, GROUND + 0.04), tile=1.5)
    for lo, hi in (((-12, 23.2), (4.8, 24.2)), ((6.8, 23.2), (22, 24.2)), ((20.5, -6), (21.5, 23.2))):
        builder.add_box("hedge", (*lo, GROUND), (*hi, GROUND + 1.3), tile=2.0)
    for x, y in ((1.2, 12.5), (9.6, 13.5), (14.5, 6.0), (15.0, 1.0), (-3.0, 17.0)):
        _add_tree(builder, np.array([x, y, GROUND]), rng.uniform(3.0, 4.2), rng)
    for _ in range(26):
        x, y = rng.uniform((-3, north + 3.2), (14, north + 12))
        if not 4.9 < x < 6.7:
            k = int(rng.integers(4))
            size = rng.uniform(0.15, 0.4)
            builder.add_ball("tree", (x, y, GROUND + 0.5 * size), size, 0.3, rng, (0, 0, 1, 0.6), 12)
            builder.add_ball(
                "blossom", (x, y, GROUND + 1.3 * size), 0.6 * size, 0.4, rng, (k / 4, 0, (k + 1) / 4, 1), 10
            )
    builder.add_box("wood", (10.5, north + 7.5, GROUND), (13.0, north + 9.5, GROUND + 2.0), tile=1.2)
    builder.add_box("roof", (10.3, north + 7.3, GROUND + 2.0), (13.2, north + 9.7, GROUND + 2.15), tile=1.0)
    for k in range(20):
        x = -10 + 1.7 * k
        builder.add_box("paint", (x, 26.0, GROUND), (x + 0.09, 26.08, GROUND + 1.1), tile=0.3)


def _add_house(builder: MeshBuilder, at: np.ndarray, size: float, rng) -> None:
    """Add a house of two floors with a gable roof, with a front towards the table."""
    w, d, h = size * rng.uniform(4, 6), size * rng.uniform(3.5, 5), size * rng.uniform(5, 6.5)
    yaw = np.arctan2(at[1] - OBJECT_CENTER[1], at[0] - OBJECT_CENTER[0]) + np.pi / 2 + rng.uniform(-0.4, 0.4)
    turn = rotate_about_z(yaw)
    spot = lambda *p: at + turn @ np.array(p, float)
    k = int(rng.integers(4))
    builder.add_box("facade", at - (w, d, 0), at + (w, d, h), patch=(k / 4, 0, (k + 1) / 4, 1), yaw=yaw, skip="bt")
    ridge, eaves = h + 0.75 * d, h - 0.35
    for s in (-1, 1):
        corner = spot(-w - 0.5, s * (d + 0.45), eaves)
        builder.add_quad(
            "roof", corner, turn @ (2 * w + 1, 0, 0), spot(-w - 0.5, 0, ridge) - corner, patch=(0, 0, 4, 2)
        )
        gable = [[spot(s * w, -d, h), spot(s * w, d, h)], [spot(s * w, 0, ridge), spot(s * w, 0, ridge)]]
        builder.add_surface("plaster", gable, patch=(0, 0, 2, 1))
    chimney = at + turn @ (0.4 * w, 0, 0)
    builder.add_box("roof", chimney + (-0.4, -0.4, h), chimney + (0.4, 0.4, ridge + 0.9), patch=(0, 0, 0.5, 1))


def _add_tree(builder: MeshBuilder, at: np.ndarray, high: float, rng) -> None:
    builder.add_tube("bark", [at + (0, 0, z * high) for z in (0, 0.3, 0.6)], 0.028 * high, 8)
    kind = "tree" if rng.random() < 0.6 else "oak"
    for k in range(5):
        angle, far = 2.4 * k + rng.uniform(0, 1), 0.17 * high * (k > 0)
        spot = at + (far * np.cos(angle), far * np.sin(angle), high * rng.uniform(0.5, 0.85))
        builder.add_ball(kind, spot, high * rng.uniform(0.15, 0.23), 0.3, rng, (0, 0, 2, 1), 11)
