"""Layout of the demo store: a deterministic scene of axis-aligned boxes.

The store is a convenience store of 8 x 6 x 3 m. Frame: x east, y north, z up, metres, the origin in the south-west
corner of the floor. Three gondolas run north-south and form four aisles; coolers fill the north wall, a wall shelf the
west wall, the counter is in the east, the door in the south wall.

Everything is opaque, diffuse and textured with colour patches of 10 to 50 cm, which a radiance field can learn from
small pictures and exact ray casts answer without ambiguity.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from nerg_mi.scenes.store import furniture
from nerg_mi.scenes.store.blocks import Region, StoreBuilder, parse_srgb

from nerg_mi.files.tables import write_json

ROOM = (8.0, 6.0, 3.0)  # metres


@dataclass(frozen=True)
class StoreLayout:
    """The finished store as arrays, in metres; see `StoreBuilder` for the fields. ``seed`` is that of its
    generation."""

    seed: int
    quads: np.ndarray
    colors: np.ndarray
    lights: np.ndarray
    solids: np.ndarray
    regions: tuple

    @property
    def aabb(self) -> np.ndarray:
        """(2, 3) bounds of the room."""
        return np.array([(0.0, 0.0, 0.0), ROOM])

    def compute_clearance(self, positions) -> np.ndarray:
        """Return the distance (P,) in metres from positions (P, 3) to the nearest solid or room surface; 0 inside a
        solid.
        """
        p = np.atleast_2d(positions)
        gap = np.maximum(self.solids[None, :, 0] - p[:, None], p[:, None] - self.solids[None, :, 1])
        solid = np.linalg.norm(np.maximum(gap, 0.0), axis=-1).min(axis=1)
        wall = np.minimum(p, np.array(ROOM) - p).min(axis=1)
        return np.maximum(np.minimum(solid, wall), 0.0)


def _add_shell(builder: StoreBuilder, rng) -> None:
    """Add floor, walls and ceiling with the light panels."""
    X, Y, Z = ROOM
    warm, grey, mat = parse_srgb("d8cfc0"), parse_srgb("b3aca2"), parse_srgb("7f95a8")
    gain = 1.0 + 0.10 * rng.uniform(-1, 1, (16, 12))
    builder.add_grid(
        2,
        1,
        0.0,
        (0, 0),
        (X, Y),
        (16, 12),
        lambda i, j: gain[i, j] * (mat if j < 2 and 11 <= i <= 14 else (warm, grey)[(i + j) % 2]),
    )
    tile = 1.0 + 0.08 * rng.uniform(-1, 1, (16, 12))
    builder.add_grid(
        2,
        -1,
        Z,
        (0, 0),
        (X, Y),
        (16, 12),
        lambda i, j: (
            None if i % 4 in (1, 2) and j % 3 == 1 else tile[i, j] * parse_srgb("dedede" if (i + j) % 2 else "cfd3d8")
        ),
    )

    # Walls in cells of 25 cm: a dado, a stripe in the colour of the wall, and a light field with vertical bands above.
    walls = {
        (0, 1, 0.0, Y): ("e9dcc3", "c4622d", "f0c48a"),
        (0, -1, X, Y): ("d5e2d0", "2f7d4f", "9cc9a3"),
        (1, 1, 0.0, X): ("dfe3ee", "2b5fa8", "9db8e0"),
        (1, -1, Y, X): ("e8d9e2", "8c2f5f", "d9a0bd"),
    }
    for (axis, sign, at, length), (field_, stripe, band) in walls.items():
        n = round(length / 0.25)
        gain = 1.0 + 0.10 * rng.uniform(-1, 1, (n, 12))
        is_band = rng.random(n) < 0.35

        def color_of(
            i, j, n=n, gain=gain, wide=is_band, base=field_, stripe=stripe, band=band, south=(axis, sign) == (1, 1)
        ):
            x = (i + 0.5) * 0.25
            if south and 6.0 < x < 7.25 and j < 8:  # the door
                return parse_srgb("3c4a57" if j in (0, 7) or i in (24, 28) else "7fa6b8") * gain[i, j]
            if j in (9,):
                return parse_srgb(stripe) * gain[i, j]
            if j < 4:
                return parse_srgb(stripe) * 0.45 * gain[i, j] + 0.12
            return parse_srgb(band if wide[i] and j < 9 else base) * gain[i, j]

        builder.add_grid(axis, sign, at, (0, 0), (length, Z), (n, 12), color_of)


def _add_poster(builder: StoreBuilder, rng, axis: int, sign: int, at: float, lo2, hi2, colors) -> tuple:
    """Add a picture board of 3 cm on a wall: a ground with bars and a bright square. Returns its box (lo, hi)."""
    other_axes = [k for k in range(3) if k != axis]
    lo, hi = np.empty(3), np.empty(3)
    lo[other_axes], hi[other_axes] = lo2, hi2
    lo[axis], hi[axis] = sorted((at, at + 0.03 * sign))
    n, m = (max(3, round((hi2[k] - lo2[k]) / 0.14)) for k in range(2))
    ground, bar, mark = (parse_srgb(c) for c in colors)
    hole = rng.integers(1, n - 1), rng.integers(1, m - 1)

    def color_of(i, j):
        if abs(i - hole[0]) <= n // 6 and abs(j - hole[1]) <= m // 6:
            return mark
        return bar if (i + 2 * j) % 5 == 0 or j == 0 else ground * (0.8 + 0.4 * j / m)

    builder.add_box(lo, hi, ground, skip={(axis, -sign)}, fronts={(axis, sign): ((n, m), color_of)})
    return lo, hi


def build_store(seed: int = 0) -> StoreLayout:
    """Build the store of a seed. The furniture is always at the same positions; goods, shades and pictures vary."""
    rng = np.random.default_rng([seed, 0x570E])
    builder = StoreBuilder()
    _add_shell(builder, rng)
    furniture.furnish(builder, rng)
    for args, name in (
        ((0, 1, 0.0, (1.2, 2.30), (3.0, 2.90), ("c4622d", "f4e3c1", "fff3b0")), None),
        ((0, -1, 8.0, (4.10, 1.20), (5.00, 2.30), ("2f7d4f", "f2f2e6", "ffd23f")), "poster_east"),
        ((0, -1, 8.0, (1.0, 2.35), (3.4, 2.85), ("b8342f", "ffffff", "ffd23f")), None),
        ((1, 1, 0.0, (3.55, 1.10), (4.55, 2.10), ("2b5fa8", "ffd23f", "e4572e")), "poster_south"),
        ((1, 1, 0.0, (4.75, 1.30), (5.65, 2.10), ("e4572e", "fff7e6", "2b5fa8")), None),
        ((1, -1, 6.0, (1.0, 2.35), (3.4, 2.85), ("2f6f8f", "e8f4f8", "ffffff")), None),
        ((1, -1, 6.0, (4.2, 2.35), (6.6, 2.85), ("8c2f5f", "f7dbe8", "ffd23f")), None),
    ):
        lo, hi = _add_poster(builder, rng, *args)
        if name:
            facing = [0, 0, 0]
            facing[args[0]] = args[1]
            builder.regions.append(Region(name, "poster", tuple(lo), tuple(hi), tuple(facing), (tuple(lo), tuple(hi))))
    return StoreLayout(
        seed=seed,
        quads=np.array(builder.quads),
        colors=np.array(builder.colors),
        lights=np.array(builder.lights),
        solids=np.array(builder.solids),
        regions=tuple(builder.regions),
    )


def write_regions(layout: StoreLayout, path) -> Path:
    """Write the bounds of the room and the areas of interest, boxes in metres, as JSON."""
    path = Path(path)
    content = {
        "units": "metres, x east, y north, z up",
        "aabb": layout.aabb.tolist(),
        "regions": [r.to_json() for r in layout.regions],
    }
    write_json(path, content)
    return path
