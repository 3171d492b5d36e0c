"""Shoppers: smooth walks through the demo store, and heads that follow the attention law.

Each shopper enters at the door, visits areas of interest in an order of their own, pays and leaves. Walks follow a
graph of waypoints through the aisles, with corners cut and lanes of their own; they never touch furniture. At 5 Hz the
head's position is noted and its direction drawn from the law at that very position, independently of all others: the
gaze field that is trained on these data has a known truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush
from pathlib import Path

import numpy as np
from nerg_mi.scenes.store.attention_law import AttentionLaw
from nerg_mi.scenes.store.layout import ROOM, StoreLayout

RATE = 5.0  # samples a second
EYE_HEIGHT = (1.5, 1.75)  # metres: height of the midpoint of the ears, which is taken as the eye's
BODY_RADIUS = 0.22  # metres that a walk keeps from furniture; sway takes back a few centimetres
DOOR = (6.6, 0.45)
AISLES = (0.93, 2.75, 4.55, 6.3)  # x of the four aisles
ROWS = (0.8, 1.9, 2.9, 3.9, 4.8)  # y of the waypoints along them; the first and last are the cross aisles


@dataclass(frozen=True)
class Walk:
    """One shopper's way: ``time`` (T,) in seconds since they entered, ``head`` (T, 3) in metres, ``standing`` (T,)
    bool."""

    time: np.ndarray
    head: np.ndarray
    is_standing: np.ndarray


def compute_floor_clearance(layout: StoreLayout, xy: np.ndarray) -> np.ndarray:
    """Distance (N,) in metres of floor positions (N, 2) from furniture of any height and from the walls; 0 inside."""
    solids = layout.solids[layout.solids[:, 0, 2] < 2.0][:, :, :2]
    gap = np.maximum(solids[None, :, 0] - xy[:, None], xy[:, None] - solids[None, :, 1])
    wall = np.minimum(xy, np.array(ROOM[:2]) - xy).min(axis=1)
    return np.maximum(np.minimum(np.linalg.norm(np.maximum(gap, 0), axis=-1).min(axis=1), wall), 0.0)


def _graph():
    """Waypoints (N, 2) and neighbours."""
    nodes, links, at = [], {}, {}

    def join(a, b):
        links.setdefault(a, set()).add(b)
        links.setdefault(b, set()).add(a)

    for i, x in enumerate(AISLES):
        for j, y in enumerate(ROWS):
            at[i, j] = len(nodes)
            nodes.append((x, y))
            if j:
                join(at[i, j - 1], at[i, j])
            if i and j in (0, len(ROWS) - 1):
                join(at[i - 1, j], at[i, j])
    for extra, near in ((DOOR, (3, 0)), ((7.45, 4.8), (3, 4))):
        nodes.append(extra)
        join(len(nodes) - 1, at[near])
    return np.array(nodes), links


def _route(nodes, links, a: int, b: int) -> list[int]:
    """Shortest way between two waypoints (Dijkstra)."""
    best, queue, before = {a: 0.0}, [(0.0, a)], {}
    while queue:
        d, n = heappop(queue)
        if n == b:
            break
        for m in links[n]:
            e = d + float(np.linalg.norm(nodes[n] - nodes[m]))
            if e < best.get(m, np.inf):
                best[m], before[m] = e, n
                heappush(queue, (e, m))
    way = [b]
    while way[-1] != a:
        way.append(before[way[-1]])
    return way[::-1]


def _cut_corners(line: np.ndarray, rounds: int = 4) -> np.ndarray:
    """Chaikin's smoothing with fixed ends: stays inside of the hull of each corner, so it never leaves an aisle."""
    for _ in range(rounds):
        a, b = line[:-1], line[1:]
        line = np.concatenate(
            [line[:1], np.stack([0.75 * a + 0.25 * b, 0.25 * a + 0.75 * b], 1).reshape(-1, 2), line[-1:]]
        )
    return line


def _resample(line: np.ndarray, step: float) -> np.ndarray:
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    s = np.arange(0.0, max(length[-1], 1e-9), step)  # at least the first point
    return np.stack([np.interp(s, length, line[:, k]) for k in range(2)], axis=1)


class WaypointGraph:
    """The waypoint graph of a layout, and where one stands to look at an area of interest."""

    def __init__(self, layout: StoreLayout):
        self.layout = layout
        self.nodes, self.links = _graph()
        if compute_floor_clearance(layout, self.nodes).min() < BODY_RADIUS:
            raise ValueError("A waypoint stands in furniture; AISLES and ROWS do not fit this layout.")

    def _free(self, line: np.ndarray, margin: float) -> bool:
        return compute_floor_clearance(self.layout, line).min() >= margin

    def choose_standing_position(self, region, rng) -> np.ndarray:
        """A place (2,) on the floor in front of a region's eye-catcher."""
        facing = np.array(region.facing[:2], float)
        lo, hi = np.array(region.focus)[:, :2]
        front = np.where(facing > 0, hi, np.where(facing < 0, lo, 0.5 * (lo + hi)))
        # from close by, or across a counter
        for reach in ((0.4, 1.1), (1.1, 2.6)):
            for _ in range(100):
                xy = front + facing * rng.uniform(*reach) + np.abs(facing[::-1]) * rng.normal(0, 0.25)
                if compute_floor_clearance(self.layout, xy[None])[0] > BODY_RADIUS + 0.04 and self.find_reachable_waypoint(xy) is not None:
                    return xy
        raise ValueError(f'Nobody can stand in front of "{region.name}"; move it away from other furniture.')

    def find_reachable_waypoint(self, xy: np.ndarray):
        """The nearest waypoint that one can reach in a straight line, or None."""
        for n in np.argsort(np.linalg.norm(self.nodes - xy, axis=1))[:6]:
            if self._free(_resample(np.stack([xy, self.nodes[n]]), 0.05), BODY_RADIUS):
                return int(n)
        return None

    def find_path(self, a: np.ndarray, b: np.ndarray, rng) -> np.ndarray:
        """A smooth line (N, 2) from a to b that keeps clear of furniture; a lane of its own where there is room."""
        route = _route(self.nodes, self.links, self.find_reachable_waypoint(a), self.find_reachable_waypoint(b))
        for lane in (0.2, 0.2, 0.1, 0.0):
            middle = self.nodes[route] + rng.uniform(-lane, lane, (len(route), 2))
            line = _cut_corners(np.concatenate([a[None], middle, b[None]]))
            if self._free(_resample(line, 0.05), BODY_RADIUS):
                return line
        raise ValueError("No way through the aisles keeps clear of the furniture; widen them.")


def simulate_visit(graph: WaypointGraph, rng, stops: int, weights: np.ndarray) -> Walk:
    """One visit: from the door to ``stops`` areas of interest (drawn with ``weights``), the till, and out again."""
    regions = graph.layout.regions
    picks = [regions[k] for k in rng.choice(len(regions), stops, p=weights / weights.sum())]
    picks.append(next(r for r in regions if r.category == "till"))
    speed = rng.uniform(0.6, 1.1)
    here, parts, standing = np.array(DOOR), [], []
    for region in picks:
        spot = graph.choose_standing_position(region, rng)
        line = _resample(graph.find_path(here, spot, rng), speed / RATE)
        dwell = int(RATE * np.clip(rng.exponential(13.0), 3.0, 40.0))
        parts += [line, np.repeat(spot[None], dwell, 0)]
        standing += [np.zeros(len(line), bool), np.ones(dwell, bool)]
        here = spot
    line = _resample(graph.find_path(here, np.array(DOOR), rng), speed / RATE)
    xy, standing = np.concatenate([*parts, line]), np.concatenate([*standing, np.zeros(len(line), bool)])

    # nobody stands still: a slow sway of 2 cm, at most BODY / 3; heads bob a little
    sway = np.zeros((len(xy), 3))
    keep = np.exp(-1.0 / (2.0 * RATE))
    kicks = rng.normal(0, np.sqrt(1 - keep**2), sway.shape)
    for t in range(1, len(sway)):
        sway[t] = keep * sway[t - 1] + kicks[t]
    sway = np.clip(sway * (0.02, 0.02, 0.006), -BODY_RADIUS / 3, BODY_RADIUS / 3)
    head = np.concatenate([xy, np.full((len(xy), 1), rng.uniform(*EYE_HEIGHT))], axis=1) + sway
    return Walk(np.arange(len(xy)) / RATE, head, standing)


def simulate_shoppers(layout: StoreLayout, *, shoppers: int = 100, stops=(8, 20), seed: int = 0, scene=None, law=None):
    """Everybody's visit. Returns ids (N,) str, times (N,) int64 in milliseconds, origins (N, 3), directions (N, 3),
    sorted by time. ``stops``: least and largest number of areas of interest that a shopper visits; ``law``: the
    `AttentionLaw` (default: that of the layout, with rays cast at ``scene``)."""
    law = law or AttentionLaw([r.to_json() for r in layout.regions], scene)
    store = WaypointGraph(layout)
    rng = np.random.default_rng([seed, 0x5407])
    # unattractive shelves are visited too: shoppers come with a list
    weights = 0.5 + law.attractiveness
    ids, times, heads = [], [], []
    for n in range(shoppers):
        visit = simulate_visit(store, rng, int(rng.integers(stops[0], stops[1] + 1)), weights)
        arrival = 200 * int(rng.integers(0, 5 * 3600))
        ids.append(np.full(len(visit.time), f"shopper-{n:03d}"))
        times.append(arrival + np.round(1000 * visit.time).astype(np.int64))
        heads.append(visit.head)
    ids, times, heads = (np.concatenate(v) for v in (ids, times, heads))
    order = np.lexsort((ids, times))
    ids, times, heads = ids[order], times[order], heads[order]
    return ids, times, heads, law.sample(heads, rng)


def write_shoppers(layout: StoreLayout, path, *, log=print, **options) -> Path:
    """Write `simulate`'s shoppers as a 22-keypoint skeleton file; one unit of its time is a millisecond."""
    from nerg_mi.rays.readers.skeleton import keypoints_from_head, write_skeleton

    ids, times, origins, directions = simulate_shoppers(layout, **options)
    path = Path(path)
    # 0.1 mm turns a head by less than 1 mrad, far below the law's jitter
    write_skeleton(path, ids, times, keypoints_from_head(origins, directions), decimals=4)
    nearest = compute_floor_clearance(layout, origins[:, :2]).min()
    log(f"{len(ids)} head poses of {len(np.unique(ids))} shoppers, at least {nearest:.2f} m from furniture")
    return path
