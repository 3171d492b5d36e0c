"""Shares of areas under the error of an eye tracker, on a plane, next to those of GazeAudit and a closed form.

    python benchmarks/tracker_gazeaudit.py

Needs ``pip install gazeaudit``. 2,000 participants in front of a wall look at one point each, on and around six
rectangles 1 to 6 degrees wide. GazeAudit assigns the points to rectangles of degrees with the probabilities of a normal
error of the same mean angle; the mean probability is the expected share, which the table ``tracker`` calls disturbed.
"""

from __future__ import annotations

import argparse

import nerg_mi as nerg
from nerg_mi.aoi.settings import TrackerError, VisitRules
from timing import save_result

import numpy as np
from scipy.stats import norm

PARTICIPANTS, DRAWS, DISTANCE = 2000, 200, 100.0
RECTANGLES = [(-7, -3, -4, -2), (-3, 0, -3, -1), (0, 6, -4, 0), (-7, -2, 0, 3), (-2, -1, 0, 1), (1, 5, 1, 4)]
"""Left, right, low and high side of each rectangle in degrees."""


def compute_shares(at: np.ndarray, accuracy: float) -> np.ndarray:
    """Expected shares (3, 6) by nerg_mi, by GazeAudit and by the normal distribution function of points (N, 2)."""
    from gazeaudit.aoi import RectangleAOI
    from gazeaudit.uncertainty import GaussianGazeErrorModel, aoi_probabilities

    right, up = DISTANCE * np.tan(np.radians(at)).T
    directions = np.stack([np.full_like(right, DISTANCE), -right, up], axis=1)
    directions = np.repeat(directions / np.linalg.norm(directions, axis=1, keepdims=True), 2, axis=0)
    rays = nerg.Rays.from_arrays(
        np.zeros_like(directions),
        directions,
        times=np.tile([0.0, 0.1], len(at)),
        participants=np.repeat([f"p{k:04d}" for k in range(len(at))], 2),
        tracking="eye",
    )
    walls, rectangles, exact = {}, [], []
    model = GaussianGazeErrorModel.from_mean_radial_error(accuracy, n_validation=9)
    sd = np.sqrt(model.covariance[0, 0])
    for k, sides in enumerate(RECTANGLES):
        left, right_side, low, high = sides
        meters = DISTANCE * np.tan(np.radians(sides))
        walls[f"rectangle {k}"] = {
            "min": [DISTANCE - 0.1, -meters[1], meters[2]],
            "max": [DISTANCE, -meters[0], meters[3]],
        }
        rectangles.append(RectangleAOI(f"rectangle {k}", left, low, right_side, high))
        across = norm.cdf(right_side, at[:, 0], sd) - norm.cdf(left, at[:, 0], sd)
        exact.append(np.mean(across * (norm.cdf(high, at[:, 1], sd) - norm.cdf(low, at[:, 1], sd))))
    error, rules = TrackerError(accuracy=accuracy, draws=DRAWS), VisitRules(min_visit=0.0)
    result = nerg.statistics(rays, walls, error=error, rules=rules, resamples=199, progress=False)
    disturbed = [row["disturbed"] for row in result.tracker if row["measure"] == "share"]
    theirs = aoi_probabilities(at, rectangles, model, draws=DRAWS, rng=0).mean()[list(walls)]
    return np.stack([disturbed, theirs, exact])


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    at, rows = np.random.default_rng(0).uniform([-9, -6], [8, 6], (PARTICIPANTS, 2)), []
    for accuracy in (0.5, 1.2, 2.5):
        disturbed, theirs, exact = compute_shares(at, accuracy)
        recorded = [np.mean(np.all([at >= r[::2], at <= r[1::2]], axis=(0, 2))) for r in np.array(RECTANGLES)]
        differences = [np.abs(values - exact).max() for values in (disturbed, theirs, recorded)]
        rows.append([f"{accuracy:g}", f"{exact.min():.4f} to {exact.max():.4f}", *(f"{d:.4f}" for d in differences)])
        print(*rows[-1], sep=" | ", flush=True)
    head = ["accuracy [degrees]", "expected shares"]
    head += [f"largest error, {name}" for name in ("nerg_mi", "GazeAudit", "error ignored")]
    save_result("tracker-gazeaudit", head, rows, "0")


if __name__ == "__main__":
    main()
