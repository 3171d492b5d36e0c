"""Scores of a gaze field by code that shares nothing with the evaluation of the package.

    python benchmarks/independent_score.py RAYS.npz GAZE.safetensors [--prior-kappa 30]

Held-out participants at held-out positions, as `nerg eval gaze --split both`: the log density of each drawn ray for an
observer at its own origin, over the position-independent prior. The density of the field is that of the Python API; the
split, the draw of the rays, the prior, the re-aimed hits and the means are computed here, in float64 NumPy. Rays are
drawn by the rule of the evaluation, so that its row of the field and this one differ by rounding only.

Then all rays of the held-out participants are scored, up to 0.25 m from the nearest training ray and farther away,
against a stack: a mixture of the prior, rays and re-aimed hits with Gaussian weights of the distance, whose weights are
fitted by expectation maximisation to training participants that are left out, at recorded and at new positions.
"""

from __future__ import annotations

import argparse
import json
import struct
from pathlib import Path

import nerg_mi as nerg

import numpy as np

COUNTS, KAPPAS, WEIGHTS = (64, 256, 1024, 4096), (20, 50, 100, 200, 400), (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)
MAX_RAYS, NUM_TUNING_RAYS = 512, 150
WIDTHS, STACK_KAPPAS, NEW_DISTANCE = (0.1, 0.2, 0.4, 0.8, 1.6, 5.0), (10, 40, 120, 300, 800, 2000), 0.25


def read_split(path: Path) -> dict:
    """What the training of the checkpoint held out."""
    with path.open("rb") as file:
        (size,) = struct.unpack("<Q", file.read(8))
        header = json.loads(json.loads(file.read(size))["__metadata__"]["nerg"])
    return header["provenance"]["test"]


def kernel(cosine: np.ndarray, kappa: float) -> np.ndarray:
    """Von Mises-Fisher kernel in 1/sr."""
    return kappa / (2 * np.pi * -np.expm1(-2 * kappa)) * np.exp(kappa * (cosine - 1))


def prior(rays: dict, directions: np.ndarray, kappa: float) -> np.ndarray:
    """Density of all rays, with the same weight for each participant."""
    weights = 1.0 / np.bincount(rays["person"])[rays["person"]]
    rows = [kernel(rays["direction"] @ d, kappa) @ weights for d in directions]
    return np.array(rows) / weights.sum()


def reaimed(rays: dict, origins: np.ndarray, directions: np.ndarray) -> dict[tuple[int, float], np.ndarray]:
    """Densities of the hit points of the nearest rays, seen from ``origins``, by number of rays and kappa."""
    out = {(count, kappa): np.empty(len(origins)) for count in COUNTS for kappa in KAPPAS}
    for i, (origin, direction) in enumerate(zip(origins, directions)):
        near = np.argsort(((rays["origin"] - origin) ** 2).sum(axis=1))[: COUNTS[-1]]
        offset = rays["hit"][near] - origin
        length = np.linalg.norm(offset, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            aimed = np.where((length > 0.15)[:, None], offset / length[:, None], rays["direction"][near])
        for kappa in KAPPAS:
            values = kernel(aimed @ direction, kappa)
            for count in COUNTS:
                out[count, kappa][i] = values[:count].mean()
    return out


def smoothed(rays: dict, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Densities (n, 72) of rays and of re-aimed hits for each width and kappa, at one direction of each origin."""
    out = []
    for origin, direction in zip(origins, directions):
        square = ((rays["origin"] - origin) ** 2).sum(axis=1)
        weights = np.exp((square.min() - square) / (2 * np.square(WIDTHS)[:, None]))
        offset = rays["hit"] - origin
        length = np.linalg.norm(offset, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            aimed = np.where((length > 0.15)[:, None], offset / length[:, None], rays["direction"])
        kernels = [kernel(d @ direction, kappa) for d in (rays["direction"], aimed) for kappa in STACK_KAPPAS]
        out.append((weights / weights.sum(axis=1, keepdims=True) @ np.transpose(kernels)).ravel())
    return np.array(out)


def nearest(points: np.ndarray, origins: np.ndarray) -> np.ndarray:
    """Distance of each of ``origins`` to the nearest of ``points``."""
    from scipy.spatial import KDTree

    return KDTree(points).query(origins)[0]


def fit_stack(train: dict, kappa: float, is_new: bool) -> np.ndarray:
    """Weights of the prior and of the densities of `smoothed`; each participant that is left out counts as five rays,
    and the prior and all others together as five and ten more."""
    rows, people = [], []
    for person in np.unique(train["person"]):
        left_out, others = (select(train, mask) for mask in (train["person"] == person, train["person"] != person))
        if is_new:
            centres = np.random.default_rng(person).permutation(left_out["origin"])[:3]
            distance = nearest(centres, others["origin"])
            others = select(others, distance > np.quantile(distance, 0.25))
            left_out = select(left_out, nearest(others["origin"], left_out["origin"]) > NEW_DISTANCE)
        if len(left_out["person"]):
            rays = draw(left_out, NUM_TUNING_RAYS, 0)
            base = prior(others, rays["direction"], kappa)
            rows.append(np.column_stack([base, smoothed(others, rays["origin"], rays["direction"])]))
            people.append(np.full(len(base), 5 / len(base)))
    density, worth = np.concatenate(rows), np.concatenate(people)
    pseudo = np.array([5.0, *[10 / (density.shape[1] - 1)] * (density.shape[1] - 1)])
    weights = pseudo / pseudo.sum()
    for _ in range(1000):
        joint = density * weights
        weights = pseudo + (worth / joint.sum(axis=1)) @ joint
        weights /= weights.sum()
    return weights


def select(rays: dict, mask: np.ndarray) -> dict:
    return {key: value[mask] for key, value in rays.items()}


def draw(rays: dict, count: int, seed: int) -> dict:
    """Draw rays without replacement, with the same weight for each participant (Efraimidis and Spirakis 2006)."""
    keys = (
        np.random.default_rng(seed).exponential(size=len(rays["person"])) * np.bincount(rays["person"])[rays["person"]]
    )
    return select(rays, np.sort(np.argsort(keys)[:count]))


def tune(train: dict, kappa: float) -> tuple[int, float, float]:
    """Number of rays, kappa and weight of the prior with which each participant is predicted best by the others."""
    total: dict = {}
    for person in np.unique(train["person"]):
        others = select(train, train["person"] != person)
        rays = draw(select(train, train["person"] == person), NUM_TUNING_RAYS, 0)
        base = prior(others, rays["direction"], kappa)
        for key, density in reaimed(others, rays["origin"], rays["direction"]).items():
            for m in WEIGHTS:
                setting = (*key, m)
                total[setting] = total.get(setting, 0.0) + np.log((1 - m) * density + m * base).mean()
    return max(total, key=lambda key: total[key])


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rays", type=Path, help="Rays of the training.")
    parser.add_argument("gaze", type=Path, help="Checkpoint that held out participants and positions.")
    parser.add_argument("--prior-kappa", type=float, default=30.0, help="Concentration of the prior. Default: 30.")
    args = parser.parse_args(argv)
    split, stored = read_split(args.gaze), np.load(args.rays)
    rays = {key: stored[key] for key in ("origin", "direction", "person", "hit")}
    names = np.array(json.loads(str(stored["metadata"]))["persons"])
    is_held_out, centres = np.isin(names[rays["person"]], split["people"]), np.array(split["centres"])
    distance = np.min(np.linalg.norm(rays["origin"][:, None] - centres[None], axis=2), axis=1)
    train = select(rays, ~is_held_out & (distance > split["purged_within"]))
    test = draw(select(rays, is_held_out & (distance <= split["radius"])), MAX_RAYS, 0)
    origins, directions = test["origin"], test["direction"]
    base = prior(train, directions, args.prior_kappa)
    count, kappa, m = tune(train, args.prior_kappa)
    methods = {
        "gaze field": nerg.GazeField.load(args.gaze).density(origins, directions),
        f"re-aimed hits ({count} rays, kappa {kappa}, prior weight {m})": (1 - m)
        * reaimed(train, origins, directions)[count, kappa]
        + m * base,
    }
    for name, density in methods.items():
        show(name, np.log2(density / base), test["person"])
    people = select(rays, is_held_out)
    is_far = nearest(train["origin"], people["origin"]) > NEW_DISTANCE
    for kind, mask in (("recorded positions", ~is_far), ("new positions", is_far)):
        test = draw(select(people, mask), MAX_RAYS, 0)
        origins, directions = test["origin"], test["direction"]
        field = nerg.GazeField.load(args.gaze).density(origins, directions)
        base = prior(train, directions, args.prior_kappa)
        weights = fit_stack(train, args.prior_kappa, kind == "new positions")
        stack = np.column_stack([base, smoothed(train, origins, directions)]) @ weights
        for name, bits in (("gaze field", field / base), ("stack", stack / base), ("field less stack", field / stack)):
            show(f"{kind}, {name}", np.log2(bits), test["person"])


def show(name: str, bits: np.ndarray, person: np.ndarray) -> None:
    """Print the mean of ``bits`` over rays, and over participants with an interval."""
    each = [bits[person == p].mean() for p in np.unique(person)]
    error = np.std(each, ddof=1) / np.sqrt(len(each))
    print(
        f"{name}: {bits.mean():.4f} bits per ray at own origin; of {len(each)} participants "
        f"{np.mean(each):.3f} ± {1.96 * error:.3f}"
    )


if __name__ == "__main__":
    main()
