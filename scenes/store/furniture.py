"""Furniture of the demo store: shelves, coolers, counter and goods.

A shelf unit is built in a local frame: u along the shelf, w out of its back towards the shopper, z up. Backs, ends and
boards are solid and closed, so that shelves are opaque and a field has training data behind every product.
"""

from __future__ import annotations

import numpy as np
from nerg_mi.scenes.store.blocks import EAST, NORTH, SOUTH, WEST, Region, StoreBuilder, parse_srgb

# Colours of the goods of a category (sRGB), and of its special offer.
GOODS = {
    "snacks": (("d94f30", "f2a33a", "f6d55c", "8c4a2f", "c92f45", "e8e0c9"), "ffd400"),
    "sweets": (("b5338a", "e86fa6", "6a3d9a", "f5b8d0", "4b2e83", "f4ede4"), "ff3d7f"),
    "noodles": (("b3261e", "f08a24", "f7e3af", "7a9e3f", "2f5d50", "d9c7a0"), "ff6a00"),
    "household": (("2b6cb0", "63b3d1", "a9d6e5", "e6eef2", "3c7a5a", "6b7f92"), "00a6ff"),
    "cosmetics": (("e8c7d0", "b284be", "7fb7be", "f3efe6", "5c6b8a", "d8899b"), "c800d8"),
    "stationery": (("38618c", "35a7a0", "f0c808", "d7d2cb", "6c757d", "d1495b"), "ff9f1c"),
    "bread": (("c68b59", "e0b074", "9c6644", "f0dcb8", "7f5539", "d9a15b"), "ffe08a"),
    "drinks": (("1d70a2", "2fae66", "d7263d", "f46036", "f3e9d2", "3b3561"), "e10600"),
    "dairy": (("e7f0f7", "7fb3d5", "f9e79f", "aed6a1", "d6c0dd", "4d88b8"), "2ec4ff"),
    "meals": (("3f7d4e", "c7b446", "b9562f", "2c3e50", "ead7b0", "8fae5d"), "66e000"),
    "magazines": (("d1495b", "edae49", "00798c", "30638e", "e5e5e5", "5f0f40"), "ffee00"),
    "offers": (("e63946", "ffb703", "fb8500", "f1faee", "2a9d8f", "8338ec"), "ff0033"),
    "counter_goods": (("9a9a9a", "c0392b", "2c3e50", "d4ac0d", "ecf0f1", "7d3c98"), "ff5500"),
}


class UnitFrame:
    """Local frame (u, w, z) of a shelf unit: its back starts at ``origin`` (x, y) and faces ``facing``."""

    def __init__(self, origin, facing):
        self.origin, self.facing = np.array(origin, float), np.array(facing[:2], float)
        self.along = np.abs(self.facing[::-1])  # u increases with x or y for any facing
        axis = int(np.argmax(np.abs(self.facing)))
        sign = int(self.facing[axis])
        self.front, self.back = (axis, sign), (axis, -sign)
        self.ends = ((1 - axis, -1), (1 - axis, 1))
        self.triple = (*map(int, facing),)

    def box(self, u, w, z):
        """Return the world box (lo, hi) of the local ranges u, w, z."""
        a, b = (self.origin + uu * self.along + ww * self.facing for uu, ww in zip(u, w))
        lo, hi = np.minimum(a, b), np.maximum(a, b)
        return np.array([*lo, z[0]]), np.array([*hi, z[1]])


def _add_product(builder: StoreBuilder, frame: UnitFrame, u, w, z, ground, label, style: int) -> None:
    """Add one product: a box whose front has a label band, an upper cap or a checked label."""
    patterns = {
        0: ((1, 3), lambda i, j: label if j == 1 else ground),
        1: ((1, 2), lambda i, j: label if j == 1 else ground),
        2: ((2, 2), lambda i, j: label if (i + j) % 2 else ground),
        3: ((1, 1), lambda i, j: ground),
    }
    lo, hi = frame.box(u, w, z)
    skip = {frame.back, (2, -1)}  # goods stand on a board, and their backs are never seen
    builder.add_box(lo, hi, ground, skip=skip, fronts={frame.front: patterns[style]}, solid=False)


def _stock_board(
    builder: StoreBuilder,
    rng,
    frame: UnitFrame,
    u,
    depth: float,
    z0: float,
    free_height: float,
    category: str,
    focus_u=None,
):
    """Fill one board from u[0] to u[1] with groups of equal goods; ``focus_u`` is reserved for the special offer."""
    colors, offer = GOODS[category]
    pos, previous = u[0], -1
    while pos < u[1] - 0.05:
        if focus_u and pos < focus_u[1] - 1e-6 and pos >= focus_u[0] - 1e-6:
            n = 3
            width = (focus_u[1] - focus_u[0]) / n
            for k in range(n):
                a = focus_u[0] + k * width
                box = (a, a + width), (0.02, depth - 0.01), (z0, z0 + free_height * 0.9)
                _add_product(builder, frame, *box, parse_srgb(offer), parse_srgb("ffffff"), 0)
            pos = focus_u[1]
            continue
        stop = focus_u[0] if focus_u and pos < focus_u[0] - 1e-6 else u[1]
        width = rng.uniform(0.11, 0.24)
        count = int(rng.integers(1, 4))
        if pos + count * width > stop - 0.08:  # the last group fills the rest
            count = max(1, round((stop - pos) / width))
            width = (stop - pos) / count
        pick = int(rng.choice([k for k in range(len(colors)) if k != previous]))
        previous = pick
        label_color = colors[(pick + int(rng.integers(1, len(colors)))) % len(colors)]
        height = free_height * rng.uniform(0.62, 0.92)
        front = depth - rng.uniform(0.01, 0.05)
        style = int(rng.integers(0, 4))
        for k in range(count):
            ground = np.clip(parse_srgb(colors[pick]) * rng.uniform(0.88, 1.12), 0.02, 0.9)
            a = pos + k * width
            _add_product(
                builder, frame, (a, a + width), (0.02, front), (z0, z0 + height), ground, parse_srgb(label_color), style
            )
        pos += count * width


def add_shelf_unit(
    builder: StoreBuilder,
    rng,
    frame: UnitFrame,
    width: float,
    depth: float,
    boards,
    top: float,
    bays,
    trim: str,
    prefix: str,
    kick: float = 0.12,
    focus_level: int = 2,
) -> None:
    """Add a one-sided shelf: a solid back, ends, a plinth, boards with price strips, goods, and one region per bay.

    ``boards`` are the heights of the upper faces of the boards in metres, ascending; the last compartment ends at
    ``top``. ``bays`` are the categories of the bays, which have equal widths. ``focus_level`` is the board of the
    special offers.
    """
    edge = 0.04
    trim = parse_srgb(trim)
    body = parse_srgb("c9c6bf")
    lo, hi = frame.box((0, width), (0, depth), (0, top))
    builder.solids.append(np.stack([lo, hi]))
    back = frame.box((edge, width - edge), (0.0, 0.02), (kick, top))
    builder.add_box(*back, body * 0.8, skip={frame.back, (2, -1), *frame.ends}, solid=False)
    for a in (0.0, width - edge):
        panel = frame.box((a, a + edge), (0, depth), (0, top))
        builder.add_box(*panel, trim, skip={frame.back, (2, -1)}, solid=False)
    plinth = frame.box((edge, width - edge), (0, depth), (0, kick))
    builder.add_box(*plinth, trim * 0.5, skip={frame.back, (2, -1), *frame.ends}, solid=False)
    bay_width = (width - 2 * edge) / len(bays)
    for level, z in enumerate(boards):
        thick = 0.035
        strips = max(2, round(width / 0.45))
        fronts = {frame.front: ((strips, 1), lambda i, j, s=level: (parse_srgb("f2f0e6"), trim)[(i + s) % 2])}
        if z > kick + 1e-6:
            board = frame.box((edge, width - edge), (0.02, depth), (z - thick, z))
            builder.add_box(*board, body, skip={frame.back, *frame.ends}, fronts=fronts, solid=False)
        free_height = (boards[level + 1] - thick if level + 1 < len(boards) else top) - z
        for b, category in enumerate(bays):
            u = (edge + b * bay_width, edge + (b + 1) * bay_width)
            focus = None
            if level == min(focus_level, len(boards) - 1):
                half = min(0.24, 0.4 * bay_width)
                middle = np.mean(u) + rng.uniform(-1, 1) * max(0.0, 0.5 * bay_width - half - 0.12)
                focus = (middle - half, middle + half)
                name = f"{prefix}_{category}" + (f"_{b + 1}" if bays.count(category) > 1 else "")
                region = frame.box(u, (0, depth), (0, top))
                box = frame.box(focus, (0.02, depth - 0.01), (z, z + free_height * 0.9))
                bounds = tuple(map(tuple, region))
                builder.regions.append(Region(name, category, *bounds, frame.triple, tuple(map(tuple, box))))
            _stock_board(builder, rng, frame, u, depth, z, free_height, category, focus)


def _add_gondola(builder, rng, number: int, x: float, west, east, cap: str, trim: str) -> None:
    """Add a double shelf of 0.7 m with its spine at x, an end cap in the south, a picture in the north, and a sign on
    top.
    """
    y0, y1, top = 1.6, 4.2, 1.7
    boards = (0.12, 0.50, 0.82, 1.14, 1.44)
    for facing, bays, side in ((WEST, west, "west"), (EAST, east, "east")):
        add_shelf_unit(
            builder,
            rng,
            UnitFrame((x, y0), facing),
            y1 - y0,
            0.35,
            boards,
            top,
            bays,
            trim,
            f"gondola_{number}_{side}",
            focus_level=3 if side == "west" else 2,
        )
    end = UnitFrame((x - 0.35, y0), SOUTH)
    add_shelf_unit(builder, rng, end, 0.7, 0.3, (0.12, 0.55, 0.95, 1.30), top, (cap,), trim, f"endcap_{number}")
    ground, light = parse_srgb(trim), parse_srgb("f4efe2")
    builder.add_box(
        (x - 0.35, y1, 0),
        (x + 0.35, y1 + 0.03, top),
        ground,
        skip={(1, -1), (2, -1)},
        fronts={(1, 1): ((4, 8), lambda i, j: light if (i * 3 + j * 2) % 7 < 2 else ground * (0.6 + 0.08 * j))},
    )
    builder.add_box(
        (x - 0.04, 2.0, top),
        (x + 0.04, 3.8, top + 0.32),
        ground,
        skip={(2, -1)},
        fronts={(0, s): ((9, 2), lambda i, j: light if j == 1 and i % 3 else ground) for s in (-1, 1)},
    )


def _add_counter(builder: StoreBuilder, rng) -> None:
    """Add the counter with till and impulse goods, the cabinet behind it, and the coffee corner."""
    wood, top, steel = parse_srgb("8a5a3c"), parse_srgb("ded5c4"), parse_srgb("5b6670")
    red = parse_srgb("c8402f")
    builder.add_box(
        (6.85, 1.0, 0),
        (7.35, 3.4, 0.9),
        wood,
        skip={(2, -1)},
        fronts={(0, -1): ((8, 3), lambda i, j: red if j == 1 else wood * (0.8 + 0.4 * (i % 2)))},
    )
    builder.add_box(
        (6.8, 0.95, 0.9),
        (7.4, 3.45, 0.95),
        top,
        fronts={(2, 1): ((2, 8), lambda i, j: top * (0.8 + 0.25 * ((i + j) % 2)))},
    )
    till = (6.95, 2.75, 0.95), (7.3, 3.15, 1.3)
    builder.add_box(
        *till, steel, skip={(2, -1)}, fronts={(0, -1): ((2, 2), lambda i, j: parse_srgb("9fd3c7") if j else steel)}
    )
    builder.regions.append(Region("counter_till", "till", (6.8, 2.6, 0.0), (7.4, 3.45, 1.35), WEST, till))
    lo = (6.83, 1.1)
    for level, z in enumerate((0.95, 1.17)):
        _stock_board(
            builder, rng, UnitFrame((lo[0] + 0.32, lo[1]), WEST), (0.0, 1.0), 0.3 - 0.1 * level, z, 0.2, "sweets"
        )
    builder.solids.append(np.array([(6.83, 1.1, 0.95), (7.15, 2.1, 1.4)]))
    builder.add_box((7.15, 1.1, 0.95), (7.19, 2.1, 1.45), parse_srgb("6a3d9a"), skip={(2, -1)})
    rack = (6.85, 1.3, 0.97), (7.15, 1.9, 1.37)
    builder.regions.append(Region("counter_sweets", "sweets", (6.8, 1.0, 0.9), (7.2, 2.1, 1.45), WEST, rack))
    cabinet = UnitFrame((8.0, 0.8), WEST)
    boards = (0.12, 0.6, 1.0, 1.3, 1.6)
    add_shelf_unit(
        builder, rng, cabinet, 2.8, 0.25, boards, 1.95, ("counter_goods",), "7a2b2b", "counter_wall", focus_level=3
    )
    # coffee corner in the north-east
    builder.add_box(
        (7.05, 5.35, 0),
        (8.0, 6.0, 0.92),
        parse_srgb("4a3428"),
        skip={(2, -1), (1, 1), (0, 1)},
        fronts={(1, -1): ((4, 4), lambda i, j: parse_srgb("d9a066") if (i + j) % 3 == 0 else parse_srgb("6b4a36"))},
    )
    builder.add_box(
        (7.15, 5.55, 0.92),
        (7.55, 5.95, 1.5),
        parse_srgb("26292b"),
        skip={(2, -1)},
        fronts={
            (1, -1): (
                (3, 4),
                lambda i, j: (parse_srgb("ff7a1a"), parse_srgb("26292b"), parse_srgb("a9b4b8"))[(i + j) % 3],
            )
        },
    )
    builder.add_box(
        (7.62, 5.6, 0.92),
        (7.92, 5.9, 1.25),
        parse_srgb("e8dcc8"),
        skip={(2, -1)},
        fronts={(1, -1): ((2, 3), lambda i, j: parse_srgb("b5493b") if j == 1 else parse_srgb("e8dcc8"))},
    )
    machine = (7.15, 5.55, 0.95), (7.55, 5.95, 1.5)
    builder.regions.append(Region("coffee", "coffee", (7.05, 5.35, 0.0), (8.0, 6.0, 1.5), SOUTH, machine))


def furnish(builder: StoreBuilder, rng) -> None:
    """Add all furniture to the empty room; the areas of interest are added in this order."""
    _add_gondola(builder, rng, 1, 1.85, ("snacks", "sweets"), ("noodles", "snacks"), "offers", "c2572b")
    _add_gondola(builder, rng, 2, 3.65, ("household", "cosmetics"), ("stationery", "household"), "offers", "2d6a8f")
    _add_gondola(builder, rng, 3, 5.45, ("noodles", "bread"), ("bread", "sweets"), "offers", "4d7c3a")
    bays = ("cosmetics", "stationery", "household")
    add_shelf_unit(
        builder, rng, UnitFrame((0.0, 0.7), EAST), 4.2, 0.35, (0.12, 0.55, 0.92, 1.26, 1.6), 2.0, bays, "a8792c", "wall"
    )
    # coolers: deeper, taller, dark inside frames, with a bright header
    for k, category in enumerate(("dairy", "meals", "drinks", "drinks")):
        x = 0.55 + 1.6 * k
        frame = UnitFrame((x, 6.0), SOUTH)
        boards = (0.25, 0.70, 1.10, 1.48)
        add_shelf_unit(builder, rng, frame, 1.6, 0.6, boards, 1.9, (category,), "dfe7ea", f"cooler_{k + 1}", kick=0.25)
        sign = (parse_srgb("2fa4d9"), parse_srgb("ffffff"))
        builder.add_box(
            *frame.box((0, 1.6), (0, 0.6), (1.9, 2.2)),
            sign[0],
            skip={frame.back},
            fronts={frame.front: ((8, 2), lambda i, j, k=k, sign=sign: sign[(i // 2 + j + k) % 2])},
        )
    rack = UnitFrame((1.1, 0.0), NORTH)
    add_shelf_unit(
        builder, rng, rack, 2.2, 0.28, (0.12, 0.55, 0.95), 1.35, ("magazines", "magazines"), "5a5f66", "rack"
    )
    _add_counter(builder, rng)
