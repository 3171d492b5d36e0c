"""Simulated shoppers: smooth walks through the demo store, and heads that follow the attention law.

Each shopper enters at the door, visits areas of interest in a random order, pays and leaves. Walks follow a graph of
waypoints through the aisles, with smoothed corners and individual lanes, and never touch furniture. At 5 Hz the head
position is recorded and its direction is sampled independently from the law at that position, so that the true gaze
field of these data is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush
from pathlib import Path

import numpy as np
from nerg_mi.scenes.store.attention_law import AttentionLaw
from nerg_mi.scenes.store.layout import ROOM, StoreLayout

RATE = 5.0  # samples per second
EYE_HEIGHT = (1.5, 1.75)  # metres: height of the midpoint of the ears, which is used as eye height
BODY_RADIUS = 0.22  # metres between a walk and furniture; sway reduces it by a few centimetres
DOOR = (6.6, 0.45)
AISLES = (0.93, 2.75, 4.55, 6.3)  # x of the four aisles
ROWS = (0.8, 1.9, 2.9, 3.9, 4.8)  # y of the waypoints along them; the first and last are the cross aisles


@dataclass(frozen=True)
class Walk:
    """Walk of one shopper: ``time`` (T,) in seconds since entering, ``head`` (T, 3) in metres, ``is_standing`` (T,)
    bool.
    """

    time: np.ndarray
    head: np.ndarray
    is_standing: np.ndarray


def compute_floor_clearance(layout: StoreLayout, xy: np.ndarray) -> np.ndarray:
    """Return the distance (N,) in metres of floor positions (N, 2) from furniture of any height and from the walls; 0
    inside.
    """
    solids = layout.solids[layout.solids[:, 0, 2] < 2.0][:, :, :2]
    gap = np.maximum(solids[None, :, 0] - xy[:, None], xy[:, None] - solids[None, :, 1])
    wall = np.minimum(xy, np.array(ROOM[:2]) - xy).min(axis=1)
    return np.maximum(np.minimum(np.linalg.norm(np.maximum(gap, 0), axis=-1).min(axis=1), wall), 0.0)


def _make_graph():
    """Return waypoints (N, 2) and their neighbours."""
    nodes, links, node_index = [], {}, {}

    def join(a, b):
        links.setdefault(a, set()).add(b)
        links.setdefault(b, set()).add(a)

    for i, x in enumerate(AISLES):
        for j, y in enumerate(ROWS):
            node_index[i, j] = len(nodes)
            nodes.append((x, y))
            if j:
                join(node_index[i, j - 1], node_index[i, j])
            if i and j in (0, len(ROWS) - 1):
                join(node_index[i - 1, j], node_index[i, j])
    for extra, neighbour in ((DOOR, (3, 0)), ((7.45, 4.8), (3, 4))):
        nodes.append(extra)
        join(len(nodes) - 1, node_index[neighbour])
    return np.array(nodes), links


def _find_route(nodes, links, a: int, b: int) -> list[int]:
    """Return the shortest path between two waypoints (Dijkstra)."""
    best, queue, previous = {a: 0.0}, [(0.0, a)], {}
    while queue:
        d, n = heappop(queue)
        if n == b:
            break
        for m in links[n]:
            e = d + float(np.linalg.norm(nodes[n] - nodes[m]))
            if e < best.get(m, np.inf):
                best[m], previous[m] = e, n
                heappush(queue, (e, m))
    path = [b]
    while path[-1] != a:
        path.append(previous[path[-1]])
    return path[::-1]


def _cut_corners(line: np.ndarray, rounds: int = 4) -> np.ndarray:
    """Apply Chaikin's smoothing with fixed ends. The result stays inside the hull of each corner, so it never leaves an
    aisle.
    """
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
    """The waypoint graph of a layout, with standing positions in front of areas of interest."""

    def __init__(self, layout: StoreLayout):
        self.layout = layout
        self.nodes, self.links = _make_graph()
        if compute_floor_clearance(layout, self.nodes).min() < BODY_RADIUS:
            raise ValueError("a waypoint is inside furniture; adapt AISLES and ROWS to this layout")

    def _is_free(self, line: np.ndarray, margin: float) -> bool:
        return compute_floor_clearance(self.layout, line).min() >= margin

    def choose_standing_position(self, region, rng) -> np.ndarray:
        """Choose a position (2,) on the floor in front of the eye-catcher of a region."""
        facing = np.array(region.facing[:2], float)
        lo, hi = np.array(region.focus)[:, :2]
        front = np.where(facing > 0, hi, np.where(facing < 0, lo, 0.5 * (lo + hi)))
        # nearby, or across a counter
        for distance_range in ((0.4, 1.1), (1.1, 2.6)):
            for _ in range(100):
                xy = front + facing * rng.uniform(*distance_range) + np.abs(facing[::-1]) * rng.normal(0, 0.25)
                if (
                    compute_floor_clearance(self.layout, xy[None])[0] > BODY_RADIUS + 0.04
                    and self.find_reachable_waypoint(xy) is not None
                ):
                    return xy
        raise ValueError(
            f'there is no standing position in front of "{region.name}"; move it away from other furniture'
        )

    def find_reachable_waypoint(self, xy: np.ndarray):
        """Return the nearest waypoint that can be reached in a straight line, or None."""
        for n in np.argsort(np.linalg.norm(self.nodes - xy, axis=1))[:6]:
            if self._is_free(_resample(np.stack([xy, self.nodes[n]]), 0.05), BODY_RADIUS):
                return int(n)
        return None

    def find_path(self, a: np.ndarray, b: np.ndarray, rng) -> np.ndarray:
        """Return a smooth path (N, 2) from a to b with clearance to furniture, in an individual lane if there is
        room."""
        route = _find_route(self.nodes, self.links, self.find_reachable_waypoint(a), self.find_reachable_waypoint(b))
        for lane in (0.2, 0.2, 0.1, 0.0):
            middle = self.nodes[route] + rng.uniform(-lane, lane, (len(route), 2))
            line = _cut_corners(np.concatenate([a[None], middle, b[None]]))
            if self._is_free(_resample(line, 0.05), BODY_RADIUS):
                return line
        raise ValueError("no path through the aisles has enough clearance; widen the aisles")


def simulate_visit(graph: WaypointGraph, rng, stops: int, weights: np.ndarray) -> Walk:
    """Simulate one visit: from the door to ``stops`` areas of interest (drawn with ``weights``), the till, and out
    again.
    """
    regions = graph.layout.regions
    targets = [regions[k] for k in rng.choice(len(regions), stops, p=weights / weights.sum())]
    targets.append(next(r for r in regions if r.category == "till"))
    speed = rng.uniform(0.6, 1.1)
    position, parts, standing = np.array(DOOR), [], []
    for region in targets:
        spot = graph.choose_standing_position(region, rng)
        line = _resample(graph.find_path(position, spot, rng), speed / RATE)
        dwell = int(RATE * np.clip(rng.exponential(13.0), 3.0, 40.0))
        parts += [line, np.repeat(spot[None], dwell, 0)]
        standing += [np.zeros(len(line), bool), np.ones(dwell, bool)]
        position = spot
    line = _resample(graph.find_path(position, np.array(DOOR), rng), speed / RATE)
    xy, standing = np.concatenate([*parts, line]), np.concatenate([*standing, np.zeros(len(line), bool)])

    # a slow sway of 2 cm, at most BODY_RADIUS / 3; heads bob slightly
    sway = np.zeros((len(xy), 3))
    decay = np.exp(-1.0 / (2.0 * RATE))
    kicks = rng.normal(0, np.sqrt(1 - decay**2), sway.shape)
    for t in range(1, len(sway)):
        sway[t] = decay * sway[t - 1] + kicks[t]
    sway = np.clip(sway * (0.02, 0.02, 0.006), -BODY_RADIUS / 3, BODY_RADIUS / 3)
    head = np.concatenate([xy, np.full((len(xy), 1), rng.uniform(*EYE_HEIGHT))], axis=1) + sway
    return Walk(np.arange(len(xy)) / RATE, head, standing)


def simulate_shoppers(layout: StoreLayout, *, shoppers: int = 100, stops=(8, 20), seed: int = 0, scene=None, law=None):
    """Simulate the visits of all shoppers.

    Returns ids (N,) str, times (N,) int64 in milliseconds, origins (N, 3) and directions (N, 3), sorted by time.
    ``stops`` is the range of the number of visited areas of interest; ``law`` is the `AttentionLaw` (default: that of
    the layout, with rays cast in ``scene``).
    """
    law = law or AttentionLaw([r.to_json() for r in layout.regions], scene)
    store = WaypointGraph(layout)
    rng = np.random.default_rng([seed, 0x5407])
    # unattractive shelves are visited too, because shoppers have a list
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
    """Write the shoppers of `simulate_shoppers` as a 22-keypoint skeleton file, with times in milliseconds."""
    from nerg_mi.tracking.readers.skeleton import keypoints_from_head, write_skeleton

    ids, times, origins, directions = simulate_shoppers(layout, **options)
    path = Path(path)
    # 0.1 mm corresponds to less than 1 mrad, far below the jitter of the law
    write_skeleton(path, ids, times, keypoints_from_head(origins, directions), decimals=4)
    nearest = compute_floor_clearance(layout, origins[:, :2]).min()
    log(f"{len(ids)} head poses of {len(np.unique(ids))} shoppers, at least {nearest:.2f} m from furniture")
    return path
