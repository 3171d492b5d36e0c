"""Coverage of 95 % intervals of AOI statistics under the error of an eye tracker, with and without its correction.

    python benchmarks/tracker_coverage.py

A data set has 20 participants, who look 150 times, every .1 s, at a wall of 6 x 4 square areas; 15 % of the gaze lies
anywhere on the wall and around it. The shares of the areas are drawn for each data set, those of its participants
around them. Inside an area the gaze is spread evenly, or within a sixth of it. The tracker has an accuracy of 1.2 and a
precision of .3 degrees, which `nerg.statistics` is told. True values are those of 4,000 participants without an error.
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import nerg_mi as nerg
from nerg_mi.aoi.settings import TrackerError, VisitRules
from timing import save_result

import numpy as np

COLUMNS, ROWS, PARTICIPANTS, LOOKS = 6, 4, 20, 150
ACCURACY, PRECISION = 1.2, 0.3
MEASURES = ("share", "hit_ratio", "time_to_first_visit")
DISTANCE = 100.0
"""Distance of the wall, so large that angles on it are even."""


class World:
    """A wall of areas that are ``width`` degrees wide, and where participants look on it."""

    def __init__(self, rng: np.random.Generator, width: float, is_even: bool) -> None:
        self.rng, self.width, self.is_even = rng, width, is_even
        column, row = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS), indexing="ij")
        self.corners = np.c_[column.ravel() - COLUMNS / 2, row.ravel() - ROWS / 2] * width
        self.shares = rng.dirichlet(np.ones(len(self.corners)))
        self.centers = self.corners + width * (0.5 + rng.uniform(-0.15, 0.15, self.corners.shape))

    def areas(self) -> dict[str, dict]:
        """Boxes of the wall, by name."""
        meters = DISTANCE * np.tan(np.radians(np.stack([self.corners, self.corners + self.width])))
        return {
            f"area {k:02d}": {"min": [DISTANCE - 0.1, -right, low], "max": [DISTANCE, -left, high]}
            for k, ((left, low), (right, high)) in enumerate(zip(*meters.tolist()))
        }

    def look(self, num: int, count: int) -> np.ndarray:
        """Angles (num, count, 2) in degrees, to the right and up, without an error."""
        rng, angles = self.rng, np.empty((num, count, 2))
        for p in range(num):
            area = rng.choice(len(self.shares), count, p=rng.dirichlet(30 * self.shares + 1e-6))
            spread = self.width * rng.random((count, 2))
            near = self.centers[area] + rng.normal(0, self.width / 12, (count, 2))
            inside = self.corners[area] + spread if self.is_even else near
            angles[p] = np.clip(inside, self.corners[area], self.corners[area] + self.width * (1 - 1e-9))
            anywhere = rng.random(count) < 0.15
            size = 1.3 * self.width * np.array([COLUMNS, ROWS])
            angles[p, anywhere] = (rng.random((anywhere.sum(), 2)) - 0.5) * size
        return angles

    def measure(self, angles: np.ndarray) -> dict[str, np.ndarray]:
        """True values of the measures by area."""
        values = defaultdict(list)
        for corner in self.corners:
            on = ((angles >= corner) & (angles < corner + self.width)).all(axis=2)
            looked = on.any(axis=1)
            values["share"].append(on.mean())
            values["hit_ratio"].append(looked.mean())
            values["time_to_first_visit"].append(0.1 * on[looked].argmax(axis=1).mean() if looked.any() else np.nan)
        return {name: np.array(value) for name, value in values.items()}


def record(angles: np.ndarray) -> nerg.Rays:
    """Rays of a recording with the angles (P, N, 2)."""
    right, up = np.moveaxis(DISTANCE * np.tan(np.radians(angles)), 2, 0)
    directions = np.stack([np.full_like(right, DISTANCE), -right, up], axis=2).reshape(-1, 3)
    return nerg.Rays.from_arrays(
        np.zeros_like(directions),
        directions / np.linalg.norm(directions, axis=1, keepdims=True),
        times=np.tile(0.1 * np.arange(angles.shape[1]), len(angles)),
        participants=np.repeat([f"p{k:03d}" for k in range(len(angles))], angles.shape[1]),
        tracking="eye",
    )


def study(width: float, is_even: bool, sets: int) -> list[list[str]]:
    """Rows of the table for one width of the areas in degrees."""
    rng, covered, errors = np.random.default_rng(int(100 * width)), defaultdict(list), defaultdict(list)
    for _ in range(sets):
        world = World(rng, width, is_even)
        truth = world.measure(world.look(4000, LOOKS))
        angles = world.look(PARTICIPANTS, LOOKS)
        angles += rng.normal(0, ACCURACY * np.sqrt(2 / np.pi), (PARTICIPANTS, 1, 2))
        angles += rng.normal(0, PRECISION * np.sqrt(1 / 2), angles.shape)
        error = TrackerError(accuracy=ACCURACY, precision=PRECISION)
        rules = VisitRules(min_visit=0.0)
        result = nerg.statistics(record(angles), world.areas(), error=error, rules=rules, resamples=399, progress=False)
        for name in MEASURES:
            corrected = [row for row in result.tracker if row["measure"] == name]
            for recorded, row, value in zip(result.aois, corrected, truth[name]):
                intervals = {
                    "recorded": (recorded[name + "_low"], recorded[name], recorded[name + "_high"]),
                    "corrected": (row["low"], row["corrected"], row["high"]),
                }
                for kind, (low, estimate, high) in intervals.items():
                    if low is not None and high is not None and np.isfinite(value):
                        covered[name, kind].append(low <= value <= high)
                        errors[name, kind].append(estimate - value)
    rows = []
    for name in MEASURES:
        row = [f"{width / ACCURACY:g}", "even" if is_even else "within a sixth", name]
        row += [f"{100 * np.mean(covered[name, kind]):.0f} %" for kind in ("recorded", "corrected")]
        row += [f"{np.sqrt(np.mean(np.square(errors[name, kind]))):.3f}" for kind in ("recorded", "corrected")]
        print(*row, sep=" | ", flush=True)
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=40, help="Number of data sets of each row. Default: %(default)s.")
    sets = parser.parse_args().sets
    rows = [row for width in (1.2, 2.4, 3.6, 6.0) for is_even in (True, False) for row in study(width, is_even, sets)]
    head = ["width of areas [accuracies]", "gaze inside", "statistic", "coverage, recorded", "coverage, corrected"]
    head += ["root mean square error, recorded", "root mean square error, corrected"]
    save_result("tracker-coverage", head, rows, "the width of the areas")


if __name__ == "__main__":
    main()
