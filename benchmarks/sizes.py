"""Growth of costs for `bench.py`: with pixels, samples, observers, rays, scene extent, and rows of a field's table.

Each `Growth` has programs by size. They use the demo store unless stated otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import nerg_mi as nerg
from nerg_mi.scenes.store import SCENE_FILE
from torch_frames import camera_rays

import numpy as np

OBSERVER = (4.4, 2.8, 1.6)


@dataclass(frozen=True)
class Growth:
    """``works`` by size; ``axis``: the quantity of ``what`` that is counted; ``aim``: expected exponent."""

    what: str
    axis: str
    aim: str
    works: dict[float, Callable[[], object]]


def frames(width: int, height: int, spp: int = 1, **values) -> Callable[[], np.ndarray]:
    """A function that renders colour, depth and gaze of the store with ``spp`` samples."""
    scene = nerg.Scene.load(SCENE_FILE, width=width, height=height, aovs="depth,gaze", **values)
    return lambda: np.array(nerg.render_tensor(scene, spp=spp))


def pixels(long: bool) -> Growth:
    widths = (160, 320, 640, 1280, *((1920,) if long else ()))
    works = {w * (w * 9 // 16): frames(w, w * 9 // 16) for w in widths}
    return Growth("a frame", "pixels", "1", works)


def samples(long: bool) -> Growth:
    counts = (1, 2, 4, 8, *((16, 32) if long else ()))
    return Growth("a frame of 320 x 180", "samples a pixel", "1", {n: frames(320, 180, n) for n in counts})


def observers(long: bool) -> Growth:
    scene = nerg.Scene.load(SCENE_FILE, width=320, height=180)
    some = np.asarray(OBSERVER) + np.random.default_rng(0).uniform(-0.4, 0.4, (32, 3)) * (1, 1, 0.2)
    counts = (1, 2, 4, 8, *((16, 32) if long else ()))
    requested = partial(nerg.render, scene, quantities=["depth", "gaze"], spp=1)
    return Growth("pictures of 320 x 180", "observers", "1", {n: partial(requested, some[:n]) for n in counts})


def rays(long: bool) -> Growth:
    scene = nerg.Scene.load(SCENE_FILE, width=320, height=180)
    o, d = camera_rays(640, 360)
    order = np.random.default_rng(0).permutation(len(o))
    counts = (1 << 13, 1 << 15, 1 << 17, *((len(o),) if long else ()))
    requested = partial(nerg.trace, scene, quantities=["depth", "gaze"], observers=np.array([OBSERVER]))
    return Growth(
        "`trace` of rays in no order", "rays", "1", {n: partial(requested, o[order[:n]], d[order[:n]]) for n in counts}
    )


def hall(side: float, cell: float = 0.1) -> np.ndarray:
    """Densities (z, y, x, 1) of a hall of ``side`` by ``side`` by 3.2, with shelves of 1.6 by 0.4 every 3.2, in voxels
    of ``cell``: the same detail for any side."""
    n, h = round(side / cell), round(3.2 / cell)
    x = (np.arange(n) + 0.5) * cell
    shelf = (x[:, None] % 3.2 > 1.4) & (x[:, None] % 3.2 < 1.8) & (x[None] % 3.2 > 0.8) & (x[None] % 3.2 < 2.4)
    solid = np.zeros((h, n, n), bool)
    solid[: round(1.8 / cell)] |= shelf
    solid[0] = solid[-1] = solid[:, 0] = solid[:, -1] = solid[:, :, 0] = solid[:, :, -1] = True
    return np.where(solid, 60.0, 0.0)[..., None].astype(np.float32)


def extent(long: bool) -> Growth:
    """Depth of a hall without colour, along its diagonal from a corner; steps of a quarter of a voxel."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 320, "height": 180, "rfilter": {"type": "box"}}

    def scene(side: float):
        to_world = mi.ScalarTransform4f().scale([side, side, 3.2])
        grid = {"type": "gridvolume", "grid": mi.VolumeGrid(hall(side)), "raw": True, "filter_type": "nearest"}
        view = mi.ScalarTransform4f().look_at([0.4, 0.4, 2.4], [side, side, 1.4], [0, 0, 1])
        integrator = {"type": "nerg", "density": {**grid, "to_world": to_world}, "step": 0.025, "aovs": "depth"}
        sensor = {"type": "perspective", "fov": 75, "to_world": view, "film": film}
        return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})

    sides = (3.2, 6.4, 12.8, 25.6, *((51.2,) if long else ()))
    works = {side: partial(lambda s: np.array(nerg.render_tensor(s, spp=1)), scene(side)) for side in sides}
    return Growth("depth of a hall of 0.1 m voxels, 320 x 180", "metres", "below 1", works)


def random_points(field, count: int, seed: int = 0) -> np.ndarray:
    """Positions (3, count), uniform in the occupied cells inside the field's box."""
    bits, rng = field.occupancy.bits, np.random.default_rng(seed)
    side, n = field.box.side, bits.shape[0]
    cells = np.argwhere(bits)[:, ::-1]
    p = (cells[rng.integers(0, len(cells), 2 * count)] + rng.random((2 * count, 3))) * (side / n)
    p += np.asarray(field.box.center) - side / 2
    p = p[np.all((p > field.box.lower) & (p < field.box.upper), axis=1)]
    return np.ascontiguousarray(np.resize(p, (count, 3)).T, np.float32)


def density_work(field, p: np.ndarray):
    """A function that evaluates the density of the field at ``p`` (3, N), and waits for it."""
    import drjit as dr

    ns = field.ns
    points = ns.Array3f(*map(ns.Float, p))
    dr.eval(points)

    def evaluate():
        out = field.density(points)
        dr.eval(out)
        dr.sync_thread()
        return out

    return evaluate


def table(long: bool) -> Growth:
    """Density of random fields at the same points."""
    from nerg_mi.fields.encoding import HashGridConfig
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
    from nerg_mi.formats.fields import load_radiance

    import mitsuba as mi

    ns = namespace(mi.variant())
    store = load_radiance(SCENE_FILE.parent / "store.safetensors", ns)[0]
    p, works = random_points(store, 1 << 17), {}
    for log2_rows in (12, 14, 16, 18, *((20, 22) if long else ())):
        grid = HashGridConfig(levels=8, log2_rows=log2_rows, base=32, finest=512)
        field = RadianceNetwork.random(RadianceConfig(grid, width=32, color_hidden=1), store.box, ns)
        works[2**log2_rows] = density_work(field, p)
    return Growth("density at 131,072 points in no order", "rows a level", "below 1", works)


def growths(long: bool) -> Iterator[Growth]:
    """All of them; ``long``: larger sizes, too."""
    for make in (pixels, samples, observers, rays, extent, table):
        yield make(long)
