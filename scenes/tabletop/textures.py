"""Procedural textures: bitmaps (h, w, 3) of sRGB values in 0..1 that tile seamlessly."""

from __future__ import annotations

import numpy as np


def parse_colors(*colors: str) -> np.ndarray:
    """Parse colours written as six hex digits to sRGB values (N, 3), or (3,) for a single colour."""
    out = np.array([[int(c[i : i + 2], 16) for i in (0, 2, 4)] for c in colors]) / 255.0
    return out[0] if len(colors) == 1 else out


def make_noise(rng, shape, cells, octaves: int = 4, fall: float = 0.5) -> np.ndarray:
    """Make smooth periodic noise of ``shape`` in 0..1.

    It consists of waves of random phase from ``cells`` (rows, columns) per side up to ``octaves`` octaves above. Each
    octave is weaker than the previous one by the factor ``fall``.
    """
    spectrum = np.fft.rfft2(rng.standard_normal(shape))
    rows, columns = np.fft.fftfreq(shape[0], 1 / shape[0]), np.fft.rfftfreq(shape[1], 1 / shape[1])
    f = np.hypot(rows[:, None] / cells[0], columns / cells[1])
    # The number of waves in an octave grows with its width, in both dimensions.
    gain = np.where((f > 0.5) & (f < 2.0**octaves), np.maximum(f, 0.5) ** (np.log2(fall) - 1), 0)
    out = np.fft.irfft2(spectrum * gain, shape)
    return np.clip(0.5 + out / (5 * out.std()), 0, 1)


def interpolate_colors(t, *colors: str) -> np.ndarray:
    """Interpolate along a ramp through ``colors`` at ``t`` in 0..1."""
    stops = parse_colors(*colors)
    at = np.linspace(0, 1, len(stops))
    return np.stack([np.interp(t, at, stops[:, k]) for k in range(3)], axis=-1)


def wood(rng, size=512, *colors) -> np.ndarray:
    """Boards along u, with rings made from stretched noise."""
    grain = make_noise(rng, (size, size), (10, 2), 5, 0.55)
    fine = make_noise(rng, (size, size), (96, 4), 2)
    rings = 0.5 + 0.5 * np.sin(34 * grain)
    return interpolate_colors(0.55 * rings + 0.25 * fine + 0.2 * grain, *(colors or ("5d371c", "8c5a30", "b98450")))


def planks(rng, size=768, rows=8) -> np.ndarray:
    """A floor of boards of different shades with dark joints."""
    out = wood(rng, size, "8d6a48", "b1895e", "caa67a")
    high = size // rows
    for row in range(rows):
        shift, cut = rng.integers(size, size=2)
        band = np.roll(out[row * high : (row + 1) * high], shift, axis=1)
        band[:, :cut] *= 1 + 0.16 * rng.uniform(-1, 1)
        band[:, cut:] *= 1 + 0.16 * rng.uniform(-1, 1)
        band[:, [cut - 2, cut - 1]] *= 0.45
        band[:2] *= 0.5
        out[row * high : (row + 1) * high] = band
    return out


def plaster(rng, size=512, color="d9d2c4", motif="c3b8a4") -> np.ndarray:
    """Wallpaper: rows of small diamonds on a slightly uneven ground."""
    y, x = np.mgrid[:size, :size] / size
    out = parse_colors(color) * (0.88 + 0.2 * make_noise(rng, (size, size), (6, 6), 5, 0.6)[..., None])
    rows = np.floor(y * 8)
    diamond = np.abs((x * 8 + 0.5 * (rows % 2)) % 1 - 0.5) + np.abs((y * 8) % 1 - 0.5)
    line = (np.abs(diamond - 0.3) < 0.035) | (diamond < 0.08)
    out[line] = 0.35 * out[line] + 0.65 * parse_colors(motif)
    return out


def weave(rng, size=512, threads=48, *colors) -> np.ndarray:
    """Cloth: threads that go over and under each other, in stripes of ``colors``."""
    colors = parse_colors(*(colors or ("6d7f8f", "8797a3", "5a6875")))
    y, x = np.mgrid[:size, :size] * threads // size
    over = (x + y) % 2
    stripe = rng.integers(len(colors), size=(2, threads))
    out = np.where(over[..., None], colors[stripe[0][x]], colors[stripe[1][y]])
    return out * (0.78 + 0.3 * make_noise(rng, (size, size), (64, 64), 3, 0.7)[..., None])


def carpet(rng, size=768) -> np.ndarray:
    """A rug: a border and a field of stars of different shades."""
    y, x = np.mgrid[:size, :size] / size
    a, b = (x * 8) % 1 - 0.5, (y * 6) % 1 - 0.5
    star = np.abs(a) + np.abs(b) + 0.18 * np.cos(4 * np.arctan2(b, a))
    pick = rng.integers(3, size=(6, 8))[(y * 6).astype(int), (x * 8).astype(int)]
    out = np.where((star < 0.32)[..., None], parse_colors("c9a45c", "2f5d73", "d8cbb0")[pick], parse_colors("7d2f2b"))
    out[star < 0.13] = parse_colors("1f2b3a")
    edge = np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y))
    out[edge < 0.07] = parse_colors("23364a")
    zigzag = np.abs(edge - 0.035 - 0.012 * (np.abs(((x + y) * 40) % 2 - 1) - 0.5)) < 0.006
    out[zigzag & (edge < 0.07)] = parse_colors("d8cbb0")
    return out * (0.75 + 0.35 * make_noise(rng, (size, size), (128, 128), 2)[..., None])


def ceramic(rng, size=512) -> np.ndarray:
    """A painted vase: bands of zigzags, dots and leaves, v from foot to rim."""
    y, x = np.mgrid[:size, :size] / size
    out = interpolate_colors(y, "e9e0cd", "f0e9d8") * (0.93 + 0.1 * make_noise(rng, (size, size), (8, 8))[..., None])
    blue, rust, gold = parse_colors("1f4e8c", "b5472a", "c99a2e")
    leaf = np.abs(np.sin(2 * np.pi * 6 * x)) * np.abs(np.sin(np.pi * np.clip((y - 0.38) / 0.26, 0, 1)))
    out[leaf > 0.45] = rust
    out[leaf > 0.8] = gold
    for low, high, color, waves in ((0.1, 0.2, blue, 16), (0.28, 0.35, gold, 24), (0.68, 0.76, blue, 20)):
        middle = (low + high) / 2 + (high - low) / 3 * (np.abs((x * waves) % 2 - 1) * 2 - 1)
        out[np.abs(y - middle) < 0.014] = color
        out[(np.abs(y - low) < 0.006) | (np.abs(y - high) < 0.006)] = color
    for v in (0.24, 0.82, 0.88):
        out[np.hypot(((x * 32) % 1 - 0.5) / 32, (y - v) * 0.7) < 0.009] = rust
    return out


def spines(rng, high=256, columns=32) -> np.ndarray:
    """The backs of ``columns`` books in a row, each with its colour, bands and title."""
    wide = 32
    out = np.empty((high, wide * columns, 3))
    for k in range(columns):
        ground = interpolate_colors(rng.random(), "7a2a26", "b9863d", "4c6b45", "2e5573", "553a5e", "c8bda5", "30343a")
        back = np.tile(ground * rng.uniform(0.75, 1.15), (high, wide, 1))
        ink = parse_colors("e8ddc0") if ground.mean() < 0.5 else parse_colors("2a2420")
        for row in rng.integers(10, high - 14, 3):
            back[row : row + rng.integers(2, 7)] = ink
        first, last = sorted(rng.integers(40, high - 40, 2))
        letters = rng.random((last - first) // 4 + 1) < 0.7
        back[first:last, 10:22][np.repeat(letters, 4)[: last - first]] = 0.8 * ink + 0.2 * ground
        back[:, :2] *= 0.6
        out[:, wide * k : wide * (k + 1)] = back
    return np.clip(out, 0, 1)


def pictures(rng, size=192) -> np.ndarray:
    """Six paintings, three per row: stripes, fields, cells, waves, discs and a hilly landscape."""
    y, x = np.mgrid[:size, :size] / size
    grid = rng.integers(6, size=(9, 9))
    palette = parse_colors("f1ead8", "c8442f", "1f4f86", "e3b23c", "22252b", "4f8a5b")
    seeds = rng.random((60, 2))
    near = np.argmin((x[..., None] - seeds[:, 0]) ** 2 + (y[..., None] - seeds[:, 1]) ** 2, axis=-1)
    field = palette[grid[(y * 9).astype(int), (x * 9).astype(int)]]
    field[((x * 9) % 1 < 0.12) | ((y * 9) % 1 < 0.12)] = palette[4]
    swirl = make_noise(rng, (size, size), (4, 4), 4)
    discs = interpolate_colors(0.3 * x, "f1ead8", "d7c8a6")
    for cx, cy, r, pick in zip(*rng.random((2, 26)), rng.uniform(0.03, 0.14, 26), rng.integers(1, 6, 26)):
        ring = np.hypot(x - cx, y - cy) / r
        discs[(ring < 1) & ((ring * 3) % 1 < 0.6)] = palette[pick]
    landscape = interpolate_colors(y, "3f5d3a", "7f9a57", "c9b37a", "d8e3ea", "8fb4d6")
    for k in range(5):
        ridge = 0.62 - 0.11 * k + 0.06 * np.interp(x[0], np.linspace(0, 1, 24), rng.random(24))
        landscape[y < ridge] = interpolate_colors(k / 4, "6f8ca3", "5f7f5e", "3e5c34")
    stripes = palette[rng.integers(6, size=40)[(np.clip(x + 0.05 * np.sin(9 * y), 0, 0.999) * 40).astype(int)]]
    waves = interpolate_colors(0.5 + 0.5 * np.sin(60 * swirl), "14304d", "d9e4e6", "c8442f")
    rows = [(stripes, field, palette[near % 6] * (0.7 + 0.4 * swirl[..., None])), (waves, discs, landscape)]
    return np.clip(np.concatenate([np.concatenate(r, axis=1) for r in rows]), 0, 1)


def foliage(rng, size=512, *colors) -> np.ndarray:
    """Leaves: light ones in front of dark gaps."""
    fine = make_noise(rng, (size, size), (40, 40), 3, 0.7)
    coarse = make_noise(rng, (size, size), (6, 6), 3)
    return interpolate_colors(0.65 * fine + 0.35 * coarse, *(colors or ("16260f", "3c5a25", "6f8f3f", "a3b765")))


def blossoms(rng, size=256) -> np.ndarray:
    """Petals: four patches of colour in a row, with streaks towards the rim."""
    grounds = ("d8402f", "e7b13a", "d9739b", "f0e6d6")
    y, x = np.mgrid[:size, :size] / size
    streak = 0.7 + 0.3 * np.abs(np.sin(2 * np.pi * 20 * x + 5 * make_noise(rng, (size, size), (6, 6))))
    out = parse_colors(*grounds)[(x * 4).astype(int)] * streak[..., None]
    out[y > 0.86] = parse_colors("5b3a12")
    return out


def grass(rng, size=768) -> np.ndarray:
    """A meadow with mown paths."""
    fine, coarse = make_noise(rng, (size, size), (96, 96), 3, 0.7), make_noise(rng, (size, size), (5, 5), 4)
    out = interpolate_colors(0.5 * fine + 0.5 * coarse, "33501f", "567a33", "86a24d", "b3b56c")
    out[make_noise(rng, (size, size), (4, 4), 3) > 0.86] *= (1.15, 1.0, 0.8)
    return np.clip(out, 0, 1)


def facades(rng, size=256) -> np.ndarray:
    """Four house fronts in a row: brick or render, with rows of windows and a door."""
    grounds = ("a4553c", "d9c9a5", "b9c4c9", "8b5e48")
    out = []
    for k, ground in enumerate(grounds):
        y, x = np.mgrid[:size, :size] / size
        front = parse_colors(ground) * (0.85 + 0.25 * make_noise(rng, (size, size), (12, 12), 4)[..., None])
        if k in (0, 3):
            rows = np.floor(y * 40)
            front[((y * 40) % 1 < 0.18) | ((x * 20 + 0.5 * (rows % 2)) % 1 < 0.08)] *= 0.75
        u, v = (x * 4) % 1, (y * 3) % 1
        frame = (np.abs(u - 0.5) < 0.27) & (np.abs(v - 0.5) < 0.32)
        pane = (np.abs(np.abs(u - 0.5) - 0.11) < 0.09) & (np.abs(v - 0.5) < 0.27)
        front[frame], front[pane] = parse_colors("efe9dc"), parse_colors("2d3a46")
        front[(np.abs(x - 0.62) < 0.07) & (y < 0.22)] = parse_colors("5b2f22")
        out.append(front)
    return np.clip(np.concatenate(out, axis=1), 0, 1)


def tiles(rng, size=256) -> np.ndarray:
    """A roof: rows of tiles of different shades."""
    y, x = np.mgrid[:size, :size] / size
    row = np.floor(y * 16).astype(int)
    column = np.floor(x * 16 + 0.5 * (row % 2)).astype(int) % 16
    shade = rng.uniform(0.7, 1.15, (16, 16))[row, column] * (0.65 + 0.35 * ((y * 16) % 1))
    return np.clip(parse_colors("9c4a35") * shade[..., None], 0, 1)


def sky(rng, high=256) -> np.ndarray:
    """The sky over the whole sphere (h, 2 h, 3), zenith first: blue that fades to the horizon, with clouds."""
    up = np.cos((np.arange(high) + 0.5) / high * np.pi)[:, None]
    clouds = make_noise(rng, (high, 2 * high), (5, 8), 5, 0.55)
    cover = np.clip((clouds - 0.52) / 0.3, 0, 1) * np.clip(up / 0.15, 0, 1) * 0.9
    blue = interpolate_colors(np.clip(np.broadcast_to(up, clouds.shape), 0, 1) ** 0.6, "dbe6ec", "a9c8e4", "6f9fd4")
    return blue * (1 - cover[..., None]) + cover[..., None] * parse_colors("f2f3f3") * (0.85 + 0.15 * clouds[..., None])
