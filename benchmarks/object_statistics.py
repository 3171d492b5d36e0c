"""Errors of AOI statistics, compared with the ground truth of the demo store.

    python benchmarks/object_statistics.py errors      # errors against the store's law and brute-force ray casts
    python benchmarks/object_statistics.py shop        # writes shop.npz, the rays of docs/tutorials/store.md

The walks are those of the demo store's shoppers (`nerg_mi.scenes.store.shoppers`), with a position every 0.8 s (five
per second for ``shop``). Gaze directions are drawn from the store's law. Coverage of the confidence intervals:
object_coverage.py.
"""

from __future__ import annotations

import argparse

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from timing import save_result

import numpy as np

SENSORS = 4  # subsampling factor of a walk
STEP = 0.8


def made_store():
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.aoi.areas import Areas
    from nerg_mi.aoi.placed import open_placed_areas
    from nerg_mi.scenes.store import SCENE_FILE

    folder = SCENE_FILE.parent
    return open_placed_areas(folder / "shapes.xml", None, Areas.load(folder / "regions.json"))


def counting_of(placed):
    from nerg_mi.aoi.measured import AoiContext, Counting
    from nerg_mi.aoi.settings import VisitRules

    return AoiContext(placed, Counting(VisitRules(max_gap=2.0), aoi_visibility=True))


class Walks:
    """A pool of walks with the law's mixture at each position, from which directions are drawn."""

    def __init__(self, count: int, seed: int = 11, every: int = SENSORS):
        from nerg_mi.scenes.store import layout, shoppers
        from nerg_mi.scenes.store.attention_law import AttentionLaw

        plan = layout.build_store()
        self.law = AttentionLaw()
        store, rng = shoppers.WaypointGraph(plan), np.random.default_rng([seed, 1])
        weights = 0.5 + self.law.attractiveness
        self.heads, self.times = [], []
        for _ in range(count):
            visit = shoppers.simulate_visit(store, rng, int(rng.integers(8, 21)), weights)
            self.heads.append(visit.head[::every])
            self.times.append(visit.time[::every])
        self.lengths = np.array([len(h) for h in self.heads])
        self.start = np.r_[0, np.cumsum(self.lengths)]
        self.origin = np.concatenate(self.heads)
        self.time = np.concatenate(self.times)
        self.lobes = self.law.compute_lobes(self.origin)

    def draw(self, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Directions at the positions ``rows``: the law's own sampling, from a precomputed mixture."""
        from nerg_mi.scenes.store.attention_law import Lobes

        lobes = self.lobes
        some = Lobes(lobes.weights[rows], lobes.mu[rows], lobes.kappa[rows], lobes.visible[rows])
        self.law.compute_lobes = lambda positions: some
        try:
            return self.law.sample(self.origin[rows], rng)
        finally:
            del self.law.compute_lobes

    def rays(self, who: np.ndarray, rng: np.random.Generator):
        """Rays of these walks, each of one participant."""
        from nerg_mi.tracking.rays import Rays

        rows = np.concatenate([np.arange(self.start[w], self.start[w + 1]) for w in who])
        person = np.repeat(np.arange(len(who)), self.lengths[who])
        names = tuple(f"{k:04d}" for k in range(len(who)))
        ones = np.ones(len(rows))
        return Rays(self.time[rows], person, names, self.origin[rows], self.draw(rows, rng), ones)


def errors() -> None:
    from nerg_mi.aoi.measured import count_block
    from nerg_mi.aoi.placed import assign_hits
    from nerg_mi.aoi.predicted import Viewpoints, predict_attention
    from nerg_mi.aoi.shares import SamplePoints
    from nerg_mi.aoi.tables import Participants
    from nerg_mi.aoi.visits import ALL
    from nerg_mi.maths.sphere import fibonacci_directions
    from nerg_mi.scenes.store import twin

    placed = made_store()
    areas, shapes = placed.areas, placed.aois
    walks = Walks(12, seed=5)
    counting = counting_of(placed)
    rng = np.random.default_rng(1)
    rays = walks.rays(np.arange(12), rng)
    people = Participants.from_sums(count_block(rays, counting), ALL, True)
    # Brute force: one ray at a time against the twin, each box by its six planes, sums by plain loops.
    depth = twin.cast_rays(rays.origin, rays.direction)
    dwell = np.zeros((12, len(areas.names)))
    reached = np.zeros_like(dwell)
    for i in range(len(rays)):
        last = i + 1 == len(rays) or rays.person[i + 1] != rays.person[i]
        weight = STEP if last else rays.t[i + 1] - rays.t[i]
        for k, box in enumerate(areas.boxes):
            near, far = -np.inf, np.inf
            for axis in range(3):
                d, o = rays.direction[i, axis], rays.origin[i, axis]
                one, two = sorted(((box.lower[axis] - o) / d, (box.upper[axis] - o) / d))
                near, far = max(near, one), min(far, two)
            if near < far and far > 0 and near - 0.03 <= depth[i] < far + 0.03:
                dwell[rays.person[i], k] += weight
                reached[rays.person[i], k] = 1
    largest = np.abs(people.dwell_time - dwell).max()
    table = [["dwell time [s] per participant and AOI", "plain loops, ray casts to the twin", f"{largest:.2g}"]]
    largest = np.abs(people.hit_probability - reached).max()
    table.append(["hit ratio per participant and AOI", "the same", f"{largest:.2g}"])
    # Fractions of the law, by quadrature over the sphere at some positions, next to the field's and a large sample.
    rows = np.linspace(0, len(walks.origin) - 1, 160).round().astype(int)
    d = fibonacci_directions(8192)
    positions = walks.origin[rows]
    density = walks.law.density(positions, d)
    o, along = np.repeat(positions, len(d), axis=0), np.tile(d, (len(positions), 1))
    law = np.zeros((len(rows), len(areas.names)))
    far = np.zeros_like(law)
    for a in range(0, len(positions), 40):
        part = slice(a * len(d), (a + 40) * len(d))
        result = assign_hits(shapes, o[part], along[part], twin.cast_rays(o[part], along[part]), 0.03)
        weight = density[a : a + 40].ravel() * (4 * np.pi / len(d))
        for k, (at, distance) in enumerate(zip(result.rows, result.distance)):
            law[a : a + 40, k] = np.bincount(at // len(d), weights=weight[at], minlength=40)
            far[a : a + 40, k] = np.bincount(at // len(d), weights=weight[at] * distance, minlength=40)
    # Many draws at the same positions, through the same counting of rays.
    draws = 400
    many = np.tile(rows, draws)
    directions = walks.draw(many, rng)
    from nerg_mi.tracking.rays import Rays

    sampled = Rays(
        np.repeat(np.arange(draws), len(rows)) * 1.0,
        np.tile(np.arange(len(rows)), draws),
        tuple(f"{k:04d}" for k in range(len(rows))),
        walks.origin[many],
        directions,
        np.ones(len(many)),
    )
    landed = counting.assign_hits(sampled)
    counted = np.array([len(at) for at in landed.rows]) / len(many)
    shares = law.mean(axis=0)
    sigma = np.sqrt(shares * (1 - shares) / len(many))
    off = np.abs(counted - shares)
    worst = off / sigma
    errors = f"{worst.max():.1f} standard errors (median {np.median(worst):.1f})"
    error = f"{off.max():.2g} of {shares.max():.2g}, {errors}"
    table.append([f"share of {draws * len(rows):,} rays", "quadrature of the ground truth", error])
    mean = far.sum(axis=0) / law.sum(axis=0)
    near = np.array([v.mean() for v in landed.distance])
    off = np.abs(near - mean)
    table.append(["mean distance [m] of these", "the same", f"{off.max():.2g} (median {np.median(off):.2g})"])
    at = Viewpoints(
        positions,
        np.tile([1.0, 0, 0], (len(positions), 1)),
        tuple(map(str, range(len(positions)))),
        (frozenset([ALL]),) * len(positions),
    )
    reported = predict_attention(placed, at, 360.0)
    error = np.abs(reported.share.mean(axis=0) - shares)
    r = np.corrcoef(reported.share.mean(axis=0), shares)[0, 1]
    middle = f"median {np.median(error):.2g} of {np.median(shares):.2g}; r {r:.3f}"
    table.append(["share by the field", "the same", f"{error.max():.2g} ({middle})"])
    off = np.abs(reported.distance.sum(axis=0) / reported.share.sum(axis=0) - mean)
    table.append(["mean distance [m] by the field", "the same", f"{off.max():.2g} (median {np.median(off):.2g})"])
    # Visibility: exact ray casts from the participants' positions, against cells of 10 cm.
    some = np.linspace(0, len(rays) - 1, 1500).round().astype(int)
    selected = rays.select(some)
    seen = counting.visibility(selected)
    targets = SamplePoints.sample(shapes, 48)
    exact = np.zeros_like(seen)
    for n in range(len(selected)):
        away = targets.points - selected.origin[n]
        length = np.linalg.norm(away, axis=1)
        front = (away * targets.normals).sum(axis=1) < 0
        within = away @ selected.direction[n] >= np.cos(np.radians(60)) * length
        free = np.zeros(len(length), bool)
        ask = np.flatnonzero(front & within)
        if len(ask):
            free[ask] = twin.is_visible(selected.origin[n], targets.points[ask], tolerance=0.03)
        exact[n] = np.bincount(targets.aoi_index, weights=free, minlength=exact.shape[1]) > 0
    agree = (seen == exact).mean()
    error = f"{100 * (1 - agree):.2f} % differ"
    table.append([f"visible or not, {seen.size:,} pairs", "ray casts from the recorded positions", error])
    largest = np.abs(seen.mean(axis=0) - exact.mean(axis=0)).max()
    table.append(["visible share per AOI", "the same", f"{largest:.2g}"])
    save_result("statistics-errors", ("statistic", "reference", "maximum error"), table, "1, 5")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("errors", "shop"), help="Table to print, or file to write; see above.")
    if parser.parse_args().what == "errors":
        errors()
        return
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    Walks(20, seed=7, every=1).rays(np.arange(20), np.random.default_rng(0)).save("shop.npz")


if __name__ == "__main__":
    main()
