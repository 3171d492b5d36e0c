"""Gaze on surfaces: what is lost, what it costs, and how well two halves of the people agree.

    python benchmarks/bake.py [--tables conservation,error,detail,observers,smoothing,halves,supermarket] [--rays FILE]
        [--shoppers 40] [--out out/benchmarks/bake.csv]

`conservation`: rooms with and without a window, von Mises-Fisher laws of four widths, observers in the middle and a
millimetre from a wall: the share that is found neither on surfaces nor outside, and what each share is off by a sum in
double precision. `error`: of the demo store's twin in two sizes of faces, from one observer at several angles of
pieces, the differences from the finest and the time. `detail`: heat on a plane from
a point at several edges, against the Gaussian. `smoothing`: the same at several numbers of steps. `observers`: how far
the shoppers are from those that stand for them. `stand-ins`: what so many leave on the twin by the store's field,
against 32. `halves`: CC over the twin's faces between two halves of the
shoppers, by lines and by cones of 1.5 degrees, smoothed along the surface. Shoppers are simulated; `--rays` takes
others. `supermarket`: the same of the people tracked in a VR supermarket, on voxels of what their rays hit.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

EYE = (4.4, 2.8, 1.6)
TABLES = ("conservation", "error", "detail", "smoothing", "observers", "stand-ins", "halves", "supermarket")


def law(kappa: float):
    """A von Mises-Fisher law of directions, in 1/sr."""
    import drjit as dr
    import mitsuba as mi

    mean = mi.Vector3f(0.84, 0.5, -0.2)
    mean /= dr.norm(mean)
    scale = kappa / (2 * np.pi * -np.expm1(-2 * kappa))
    return lambda d: scale * dr.exp(kappa * (dr.dot(mean, d) - 1))


def box(lower, upper, without=None):
    """Vertices and triangles of a box, without one of its sides."""
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    kept = [q for k, q in enumerate(quads) if k != without]
    faces = [t for a, b, c, d in kept for t in ((a, b, c), (a, c, d))]
    return np.asarray(lower) + corners * np.subtract(upper, lower), np.array(faces)


def in_closed_form(kappa: float, eye: tuple, window: bool, count: int = 1 << 20) -> tuple[float, float, float]:
    """Shares on the room, the shelf and outside of the law of `law`, by float64 slab tests along directions of which
    each has as much of it: no line of it is shared with what is measured."""
    mean = np.array([0.84, 0.5, -0.2]) / np.linalg.norm([0.84, 0.5, -0.2])
    side = np.cross(mean, [0, 0, 1]) / np.linalg.norm(np.cross(mean, [0, 0, 1]))
    i = np.arange(count)
    cos = 1 + np.log1p((i + 0.5) / count * np.expm1(-2 * kappa)) / kappa
    turn, sin = 2 * np.pi * (i * (np.sqrt(5) - 1) / 2 % 1), np.sqrt(np.maximum(1 - cos**2, 0))
    around = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(mean, side)
    d = cos[:, None] * mean + sin[:, None] * around

    def slabs(lower, upper):
        ends = (np.array([lower, upper])[:, None] - np.asarray(eye)) / d
        return ends.min(axis=0).max(axis=1), ends.max(axis=0)

    near, far = slabs((1.5, 2, 0), (3, 2.4, 1.8))
    shelf = (near < far.min(axis=1)) & (near > 0)
    wall = slabs((0, 0, 0), (4, 3, 2.5))[1].argmin(axis=1)
    out = ~shelf & (wall == 0) & (d[:, 0] > 0) & window
    return float(1 - shelf.mean() - out.mean()), float(shelf.mean()), float(out.mean())


def conservation(args) -> list[dict]:
    from nerg_mi.surfaces.gaze_source import GazeSettings, gaze_sums, lookers_of_law
    from nerg_mi.surfaces.mesh import weld
    from nerg_mi.surfaces.target import Target

    rows, shelf = [], box((1.5, 2, 0), (3, 2.4, 1.8))
    for room, side in (("closed", None), ("with a window", 1)):
        target = Target(weld(*box((0, 0, 0), (4, 3, 2.5), side))[0], [shelf])
        for where, eye in (("middle", (1, 0.7, 1.5)), ("1 mm from a wall", (0.001, 1.3, 1.2))):
            for kappa in (1, 37, 500, 5000):
                sums = gaze_sums(target, lookers_of_law(law(kappa)), np.array([eye]), [1.0], GazeSettings())
                found = {"surfaces": sums.on_surface, "shelf": sums.elsewhere, "escaped": sums.escaped}
                exact = in_closed_form(kappa, eye, side is not None)
                off = {f"{name} off": value - true for (name, value), true in zip(found.items(), exact)}
                row = {"room": room, "observer": where, "kappa": kappa, **found, **off}
                rows.append(row | {"unaccounted": sums.unaccounted})
    return rows


def error(args) -> list[dict]:
    from nerg_mi.surfaces.gaze_source import GazeSettings, gaze_sums, lookers_of_law
    from nerg_mi.surfaces.target import Target

    rows = []
    for longest in (2.0, 0.25):
        target, best = Target(twin_surface(longest).mesh), None
        for degrees in (0.7, 1.0, 2.0, 4.0, 8.0):
            settings, seconds = GazeSettings(angle=np.radians(degrees)), []
            # The first run of all compiles, and is the one that others are compared with.
            for _ in range(1 if best is None else 3 if degrees > 1 else 1):
                start = time.process_time()
                sums = gaze_sums(target, lookers_of_law(law(37)), np.array([EYE]), [1.0], settings)
                seconds.append(time.process_time() - start)
            best = sums.face if best is None else best
            row = {"longest edge [m]": longest, "faces": len(target.mesh.faces), "angle": degrees}
            row |= {"L1": np.abs(sums.face - best).sum(), "unaccounted": sums.unaccounted}
            rows.append(row | {"CPU seconds": float(np.median(seconds))})
    return rows


def spike(cells: int, steps: int, jitter: float = 0.3) -> dict:
    """Heat on a plate of one metre from a point, with a standard deviation of 7 cm, against the Gaussian."""
    from nerg_mi.surfaces.mesh import weld
    from nerg_mi.surfaces.smoothing import Smoother

    n, s = cells + 1, 0.07
    x = np.linspace(-0.5, 0.5, n)
    p = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((n, n))], axis=-1).reshape(-1, 3)
    inner = (np.abs(p[:, :2]) < 0.499).all(axis=1)
    p[inner, :2] += np.random.default_rng(0).uniform(-jitter, jitter, (inner.sum(), 2)) / cells
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    mesh, _, _ = weld(p, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
    start = np.zeros(len(mesh.vertices))
    start[np.argmin(np.linalg.norm(mesh.vertices, axis=1))] = 1
    origin, began = mesh.vertices[start > 0][0], time.process_time()
    found = Smoother(mesh, s, steps)(start)
    seconds = time.process_time() - began
    square = ((mesh.vertices - origin) ** 2).sum(axis=1)
    exact = np.exp(-square / (2 * s * s)) / (2 * np.pi * s * s) * mesh.vertex_area
    return {"edge / s": 1 / cells / s, "steps": steps, "L1": np.abs(found - exact).sum(), "CPU seconds": seconds}


def detail(args) -> list[dict]:
    return [spike(cells, 64) for cells in (15, 30, 60, 120)]


def smoothing(args) -> list[dict]:
    return [spike(60, steps) for steps in (1, 2, 4, 8, 16, 32)]


def twin_surface(longest: float):
    from nerg_mi.formats.meshes import read_mesh_file
    from nerg_mi.scenes import store
    from nerg_mi.surfaces.mesh import weld
    from nerg_mi.surfaces.refinement import refine

    twin = read_mesh_file(Path(store.__file__).parent / "twin.ply")
    return refine(weld(twin.vertices, twin.faces)[0], longest)


def shoppers(args):
    from nerg_mi.rays.rays import Rays

    if args.rays is not None:
        return Rays.load(args.rays)
    from nerg_mi.scenes.store import layout
    from nerg_mi.scenes.store.shoppers import simulate
    from nerg_mi.scenes.store.twin import load_twin

    ids, times, origins, directions = simulate(layout.build(0), shoppers=args.shoppers, seed=0, scene=load_twin())
    names, person = np.unique(ids, return_inverse=True)
    return Rays(times / 1e3, person, tuple(names), origins, directions, np.ones(len(ids)))


def observers(args) -> list[dict]:
    from nerg_mi.surfaces.population import ray_weights, thin

    rays, rows = shoppers(args), []
    for count in (8, 32, 64, 256, 1024):
        start = time.process_time()
        found = thin(rays.origin, ray_weights(rays, "time"), count)
        row = {"observers": count, "root mean square [m]": found.mean, "95 % [m]": found.farthest}
        rows.append({**row, "CPU seconds": time.process_time() - start})
    return rows


def stand_ins(args) -> list[dict]:
    """Bakes of the store's field by fewer observers than 32, against theirs."""
    from nerg_mi.evaluation.saliency import cc
    from nerg_mi.jobs.bake import bake
    from nerg_mi.jobs.options.bake import BakeOptions
    from nerg_mi.scenes import store

    folder, rays = Path(store.__file__).parent, shoppers(args)
    rows, best = [], None
    for count in (32, 4, 8, 16):
        given = {
            "gaze": folder / "shoppers.safetensors",
            "observers": count,
            "angle": 8.0,
            "detail": 2.0,
            "mode": "llvm_ad_rgb",
        }
        start = time.process_time()
        found = bake(folder / "twin.ply", (), BakeOptions(**given), rays=rays)
        seconds = time.process_time() - start
        best = found if best is None else best
        row = {"observers": count, "L1": float(np.abs(found.share - best.share).sum())}
        shelves, theirs = (_shelf_shares(f, store) for f in (found, best))
        row |= {"CC": float(cc(found.density, best.density, found.mesh.vertex_area))}
        row |= {"share of a good, median off": float(np.median(np.abs(shelves / theirs - 1)))}
        rows.append({**row, "CPU seconds": seconds})
    return rows[1:]


def _shelf_shares(found, store) -> np.ndarray:
    """Of each of the store's goods the share of faces whose centres lie in its box."""
    from nerg_mi.formats.areas.reading import read_areas

    centres = found.mesh.corners.mean(axis=1)
    boxes = read_areas(Path(store.__file__).parent / "regions.json").boxes
    within = [((centres >= b.lower) & (centres <= b.upper)).all(axis=1) for b in boxes]
    return np.array([found.share[w].sum() for w in within])


def halves(args) -> list[dict]:
    rays = shoppers(args)
    return [row for some in (8, len(rays.persons)) for row in agreement(rays, twin_surface(0.15).mesh, some)]


def supermarket(args) -> list[dict]:
    """The tracked people of the VR supermarket, on the shell of what their rays hit."""
    from nerg_mi.rays.readers.registry import read_rays

    files = sorted(args.supermarket.glob("*.csv.gz"))
    if not files:
        raise SystemExit(
            f'no recordings in "{args.supermarket}"; set NERG_DATA to the folder that holds vr_supermarket'
        )
    rays = read_rays("vr_supermarket", files)
    return agreement(rays, shell(rays.hit, 0.15), len(rays.persons))


def shell(points, edge: float, least: int = 5):
    """Outer sides of voxels with the ``edge`` that hold ``least`` of ``points`` or more, as a mesh."""
    from nerg_mi.surfaces.mesh import weld

    points = points[np.isfinite(points).all(axis=1)]
    cells, count = np.unique(np.floor(points / edge).astype(int), axis=0, return_counts=True)
    cells = cells[count >= least]
    full, (corners, triangles) = set(map(tuple, cells)), box((0, 0, 0), (1, 1, 1))
    vertices, faces = [], []
    for side in range(6):
        step = np.zeros(3, int)
        step[side // 2] = 2 * (side % 2) - 1
        bare = cells[[tuple(c) not in full for c in cells + step]]
        for two in triangles[2 * side : 2 * side + 2]:
            faces.append(sum(map(len, vertices)) + np.arange(3 * len(bare)).reshape(-1, 3))
            vertices.append((bare[:, None] + corners[two]).reshape(-1, 3) * edge)
    return weld(np.concatenate(vertices), np.concatenate(faces))[0]


def agreement(rays, mesh, some: int) -> list[dict]:
    """CC over the faces of ``mesh`` between halves of ``some`` people, by lines and by cones."""
    from nerg_mi.evaluation.saliency import cc
    from nerg_mi.jobs.baking.lookers import tracked_rays
    from nerg_mi.maths.similarity import Similarity
    from nerg_mi.surfaces.ray_source import RaySettings, TrackedRays, ray_sums
    from nerg_mi.surfaces.smoothing import Smoother
    from nerg_mi.surfaces.target import Target

    rows, who = [], tracked_rays(rays, Similarity(), "time")
    target, smoothers = Target(mesh), {s: Smoother(mesh, s) for s in (0.02, 0.05, 0.1)}
    people = np.random.default_rng(0).permutation(len(rays.persons))[:some]
    parts = [np.isin(rays.person, people[: some // 2]), np.isin(rays.person, people[some // 2 :])]
    for cone in (0.0, 1.5):
        settings = RaySettings(cone=np.radians(cone))
        both = [
            ray_sums(target, TrackedRays(who.origins[p], who.directions[p], who.weights[p]), settings) for p in parts
        ]
        row = {
            "people": some,
            "cone": cone,
            "on the surface": sum(b.on_surface for b in both) / sum(b.weight for b in both),
            "not smoothed": float(cc(*(b.face / mesh.area for b in both), mesh.area)),
        }
        for s, smoother in smoothers.items():
            maps = [(smoother(b.vertex) / mesh.vertex_area)[mesh.faces].mean(axis=1) for b in both]
            row[f"{100 * s:.0f} cm"] = float(cc(*maps, mesh.area))
        rows.append(row)
    return rows


def main(argv=None) -> None:
    from nerg_mi.files.tables import markdown_table
    from output import write_rows

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tables", default=",".join(TABLES))
    parser.add_argument("--rays", type=Path, default=None)
    parser.add_argument("--shoppers", type=int, default=40)
    data = Path(os.environ.get("NERG_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    parser.add_argument("--supermarket", type=Path, default=data / "vr_supermarket")
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/bake.csv"))
    args = parser.parse_args(argv)
    every = []
    for name in args.tables.split(","):
        rows = globals()[name.replace("-", "_")](args)
        cell = lambda v: f"{v:.3g}" if isinstance(v, float) else v
        print(
            f"{name}\n\n{markdown_table(list(rows[0]), [[cell(v) for v in row.values()] for row in rows])}\n",
            flush=True,
        )
        every += [{"table": name, **row} for row in rows]
    write_rows(args.out, every)


if __name__ == "__main__":
    main()
