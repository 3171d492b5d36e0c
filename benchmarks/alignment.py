"""Accuracy of each alignment method between tracking data and a scene in another frame.

    python benchmarks/alignment.py [--trials 50] [--only KIND] [--seed 0] [--shoppers 12]

The scene is the trained radiance field of the demo store. Each trial transforms it by a random similarity: a scale
from 0.14 to 7.4, a translation of about ten metres, and any rotation, or a rotation about the up axis for methods that
need to know this axis. The tracking data are those of simulated shoppers, in metres. Their hit points are computed by
ray casts at the mesh of the store, with a noise of 2 cm. The first table has one row per kind of evidence:

- ``right``: the number of trials with an accepted fit whose errors are below 10 cm (in the tracking data) and 2
  degrees;
- errors of position, rotation and scale: medians over these trials, where the position error of a trial is the median
  over head positions; ``95 %``: the 95 % quantile of the position errors of all heads, in centimetres;
- ``residual cm``: the median residual that the fit reports;
- ``mirror named``: how often mirrored tracking data (the x axis negated) are detected.

The table ``hidden`` has recordings whose hit points are hidden, of eight participants each: shoppers of the store,
participants of the places of ``generated_places.py``, and, with NERG_DATA, half of the participants of the VR
supermarket, whose surface is what the gaze of the other half meets. Up and floor are given, and the scale, the
turn, or both. The margin of the objective and the scale of its residuals were chosen on 17 trials in the same
environments, with other shoppers and generated participants, but overlapping participants of the supermarket.

The last table needs the photos of the fox (`../shared/data/fox`, or the folder of the variable NERG_DATA). It
simulates participants who stand between the cameras of the photos, in a random other frame, and aligns them by five
picked points with errors of 1 % of the extent of the camera positions.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)
from nerg_mi.alignment.constraints import AlignmentTarget, Evidence, SceneTraces, read_surface, trace_scene
from nerg_mi.alignment.icp import Twin
from nerg_mi.alignment.points import Cameras, Pairs
from nerg_mi.alignment.similarity import MIRROR, residual_distances, turn_between
from nerg_mi.alignment.tracking import Tracking
from nerg_mi.errors import NergError
from nerg_mi.maths.transforms import similarity_scale, transform_points
from nerg_mi.tracking.rays import Rays, merge_rays
from timing import save_result

import numpy as np
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data"))
HIDDEN_HEAD = (
    "environment|given|turn before, degrees|turn error, degrees|turn interval, degrees|scale error, %"
    "|scale interval, ratio|error of heads, m|interval contains the truth|accepted|accepted and wrong"
).split("|")
HEAD = (
    "evidence|also known|correct|error, cm|95 % quantile, cm|rotation error, degrees|scale error, %|residual, cm"
    "|mirroring detected|time, s"
).split("|")


@dataclass(frozen=True)
class World:
    """The store: ray casts to its field, its mesh as points, and its shoppers with their hit points."""

    traces: SceneTraces
    mesh: np.ndarray
    rays: Rays


def make_world(shoppers: int, rays: int) -> World:
    from nerg_mi.cli.declarations import select_backend
    from nerg_mi.environment.environment import Environment
    from nerg_mi.scenes.store import twin
    from nerg_mi.scenes.store.layout import build_store
    from nerg_mi.scenes.store.shoppers import simulate_shoppers

    select_backend("llvm_ad_rgb")
    folder = Path(twin.__file__).parent
    ids, times, origin, direction = simulate_shoppers(build_store(0), shoppers=shoppers, seed=5)
    persons, person = np.unique(ids, return_inverse=True)
    hit = origin + direction * twin.cast_rays(origin, direction)[:, None]
    hit += np.random.default_rng(1).normal(0, 0.02, hit.shape)
    walked = Rays(times / 1000, person, tuple(persons), origin, direction, np.ones(len(ids)), hit)
    place = Environment.open(folder / "store.safetensors")
    assert place.medium is not None
    traces = trace_scene(place.medium, np.array(place.box.lower), np.array(place.box.upper), rays)
    return World(traces, read_surface(folder / "twin.ply"), walked)


def random_similarity(rng: np.random.Generator, upright: bool) -> np.ndarray:
    turn = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)]) if upright else Rotation.random(random_state=rng)
    matrix = np.eye(4)
    matrix[:3, :3] = np.exp(rng.uniform(-2, 2)) * turn.as_matrix()
    matrix[:3, 3] = rng.normal(0, 10, 3)
    return matrix


# ----------------------------------------------------------------------------
# Evidence, from the true transform of the tracking to the scene
# ----------------------------------------------------------------------------

Maker = Callable[[World, np.ndarray, np.random.Generator, bool], tuple[Evidence, AlignmentTarget]]


def pairs(count: int, upright: bool) -> Maker:
    def make(world, truth, rng, mirrored):
        x = world.mesh[rng.permutation(len(world.mesh))[:count]]
        y = transform_points(truth, x + rng.normal(0, 0.01, x.shape))
        x = x + rng.normal(0, 0.01, x.shape)
        return Pairs(transform_points(MIRROR, x) if mirrored else x, y), AlignmentTarget(is_upright=upright)

    return make


def twin(upright: bool) -> Maker:
    def make(world, truth, rng, mirrored):
        mesh = world.mesh + rng.normal(0, 0.005, world.mesh.shape)
        return Twin(transform_points(MIRROR, mesh) if mirrored else mesh), AlignmentTarget(
            traces=world.traces.transform(truth), is_upright=upright
        )

    return make


def cameras(world, truth, rng, mirrored):
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3] = Rotation.random(40, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform((0.5, 0.5, 1.2), (7.5, 5.5, 1.9), (40, 3))
    other = poses.copy()
    turn = truth[:3, :3] / similarity_scale(truth)
    noise = Rotation.from_rotvec(rng.normal(0, np.radians(0.5), (40, 3))).as_matrix()
    other[:, :3, :3] = noise @ (turn @ poses[:, :3, :3])
    other[:, :3, 3] = transform_points(truth, poses[:, :3, 3] + rng.normal(0, 0.02, (40, 3)))
    # One in ten is an outlier.
    other[:4, :3, 3] += rng.normal(0, 5 * similarity_scale(truth), (4, 3))
    other[:4, :3, :3] = Rotation.random(4, random_state=rng).as_matrix()
    if mirrored:
        poses[:, :3, 3] = transform_points(MIRROR, poses[:, :3, 3])
    return Cameras(poses, other), AlignmentTarget(is_upright=False)


def tracking(world, truth, rng, mirrored):
    rays = world.rays
    if mirrored:
        rays = replace(
            rays,
            origin=transform_points(MIRROR, rays.origin),
            direction=transform_points(MIRROR, rays.direction),
            hit=transform_points(MIRROR, rays.hit),
        )
    return Tracking(rays), AlignmentTarget(traces=world.traces.transform(truth))


# Name, further known quantities, whether up is known, and the generator.
KINDS: dict[str, tuple[str, str, bool, Maker]] = {
    "pairs": ("5 picked points, off by 1.4 cm an axis", "", False, pairs(5, False)),
    "floor": ("2 picked points", "up", True, pairs(2, True)),
    "twin": ("twin: the store's mesh", "", False, twin(False)),
    "upright-twin": ("twin: the store's mesh", "up", True, twin(True)),
    "cameras": ("40 cameras, 4 of them wrong", "", False, cameras),
    "tracking": ("tracking with hit points", "up, floor", True, tracking),
}


SEARCHED = ("twin", "upright-twin", "tracking")


def measure(world: World, kind: str, trials: int, mirrors: int, seed: int = 0) -> dict:
    """One row; ``seed``: of the similarities and of the errors of the evidence."""
    name, expected, upright, make = KINDS[kind]
    result, off, named = [], [], []
    began = time.perf_counter()
    for k in range(trials):
        rng = np.random.default_rng([k, seed])
        truth = random_similarity(rng, upright)
        evidence, target = make(world, truth, rng, False)
        try:
            fit = evidence.fit(target, lambda *_: None)
        except NergError as error:
            print(f"{kind} {k}: {error}", flush=True)
            continue
        each = 100 * residual_distances(fit.matrix, world.rays.origin, transform_points(truth, world.rays.origin))
        turned = fit.matrix[:3, :3] @ truth[:3, :3].T / similarity_scale(fit.matrix) / similarity_scale(truth)
        angle = float(np.degrees(Rotation.from_matrix(turned).magnitude()))
        scale = 100 * abs(similarity_scale(fit.matrix) / similarity_scale(truth) - 1)
        residual = float(np.median(fit.residuals_cm))
        right = np.median(each) < 10 and angle < 2 and residual < 10 and fit.mirrored is None
        if not right:
            print(
                f"{kind} {k}: {np.median(each):.1f} cm, {angle:.1f} degrees, {fit.mirrored}, {fit.warnings}", flush=True
            )
        else:
            result.append((np.median(each), angle, scale, residual))
            off.append(each)
    seconds = (time.perf_counter() - began) / trials
    for k in range(mirrors if kind != "floor" else 0):
        rng = np.random.default_rng([k, seed])
        evidence, target = make(world, random_similarity(rng, upright), rng, True)
        try:
            named.append(evidence.fit(target, lambda *_: None).mirrored is not None)
        except NergError as error:
            named.append("mirror" in str(error))
    median = np.median(np.array(result), axis=0) if result else np.full(4, np.nan)
    return {
        "kind": kind,
        "evidence": name,
        "known besides": expected,
        "right": len(result),
        "trials": trials,
        "error cm": median[0],
        "95 %": np.percentile(np.concatenate(off), 95) if off else np.nan,
        "degrees": median[1],
        "scale %": median[2],
        "residual cm": median[3],
        "named": sum(named),
        "mirrors": len(named),
        "s": seconds,
    }


def cells(row: dict) -> list[str]:
    numbers = [f"{row[k]:.2g}" for k in ("error cm", "95 %", "degrees", "scale %", "residual cm")]
    # A given scale is not estimated.
    numbers[3] = "" if row["scale %"] < 1e-9 else numbers[3]
    named = f"{row['named']} of {row['mirrors']}" if row["mirrors"] else ""
    right = f"{row['right']} of {row['trials']}"
    return [row["evidence"], row["known besides"], right, *numbers, named, f"{row['s']:.2g}"]


def list_hidden(world: World, folder: Path) -> Iterator[tuple[str, SceneTraces | None, Rays]]:
    """Names, traces and recordings. Without traces, the surface is what the gaze of other participants meets."""
    import generated_places
    from nerg_mi.environment.environment import Environment
    from nerg_mi.tracking.readers.registry import read_rays

    yield "demo store", world.traces, world.rays
    for make in generated_places.PLACES:
        place = make()
        scene = place.write(folder / f"{place.name}.xml")
        core = Environment.open(scene)
        assert core.medium is not None
        traces = trace_scene(core.medium, np.array(core.box.core.lower), np.array(core.box.core.upper), 100_000)
        yield place.name, traces, place.record(scene, seconds=120.0, seed=1)
    files = sorted((DATA / "vr_supermarket").glob("*.csv.gz"))
    if files:
        rays = merge_rays([read_rays("vr_supermarket", file) for file in files])
        yield "VR supermarket", None, rays.select(np.isfinite(np.asarray(rays.hit)).all(axis=1))


def _traces_of_gaze(rays: Rays) -> SceneTraces:
    assert rays.hit is not None
    return SceneTraces(rays.origin, rays.hit, np.ones(len(rays), bool))


def measure_hidden(name: str, traces: SceneTraces | None, rays: Rays, fixed: str, trials: int, seed: int) -> list[str]:
    """One row: errors and intervals of recordings whose hit points are hidden; ``fixed`` names what is given."""
    rows = []
    for k in range(trials):
        rng = np.random.default_rng([k, seed, 3])
        chosen = np.isin(rays.person, rng.permutation(np.unique(rays.person))[: 5 if traces is None else 8])
        truth = random_similarity(rng, True)
        surface = _traces_of_gaze(rays.select(~chosen)) if traces is None else traces
        values = {"scale": similarity_scale(truth), "turn": turn_between(np.eye(4), truth)}
        target = AlignmentTarget(
            traces=surface.transform(truth),
            scale=values["scale"] if "scale" in fixed else None,
            turn=values["turn"] if "turn" in fixed else None,
        )
        tracked = replace(rays.select(chosen), hit=None)
        fit = Tracking(tracked).fit(target, lambda *_: None)
        assert fit.interval is not None
        turn, (low, high) = np.degrees(turn_between(fit.matrix, truth)), fit.interval.scale
        heads = residual_distances(fit.matrix, tracked.origin, transform_points(truth, tracked.origin))
        tiny = 1e-6  # rounding
        inside = (
            any(fit.interval.turn[0] - tiny <= turn + c <= fit.interval.turn[1] + tiny for c in (-360, 0, 360))
            and low <= values["scale"] * (1 + tiny)
            and values["scale"] <= high * (1 + tiny)
        )
        if fixed == "scale, turn":
            inside = bool(np.median(heads) <= fit.interval.shift)
        width = min(float(np.ptp(fit.interval.turn)), 360.0)
        scale_error = 100 * abs(similarity_scale(fit.matrix) / values["scale"] - 1)
        accepted = not fit.interval.rejection_reason()
        wrong = accepted and (abs(turn) > 10 or np.median(heads) > 1)
        initial = abs(np.degrees(values["turn"]))
        rows.append((initial, abs(turn), width, scale_error, high / low, np.median(heads), inside, accepted, wrong))
        print(
            name, fixed, k, low / values["scale"], high / values["scale"], *(f"{v:.3g}" for v in rows[-1]), flush=True
        )
    table = np.array(rows, float)
    median = np.median(table, axis=0)
    numbers = ["" if ("scale" if j > 2 else "turn") in fixed else f"{median[j]:.3g}" for j in range(5)]
    counts = [f"{int(table[:, j].sum())} of {trials}" for j in (6, 7, 8)]
    return [name, fixed, *numbers, f"{median[5]:.2g}", *counts]


def measure_fox(trials: int) -> list[list[str]] | None:
    """Participants around the fox, from five points; None without the photos."""
    path = DATA / "fox" / "transforms.json"
    if not path.is_file():
        return None
    poses = np.array([f["transform_matrix"] for f in json.loads(path.read_text())["frames"]], float)
    centers = poses[:, :3, 3]
    size = float(np.linalg.norm(np.ptp(centers, axis=0)))
    off, angle, stated = [], [], []
    for k in range(trials):
        rng = np.random.default_rng([k, 11])
        # From metres of the tracking to the units of the photos' frame.
        truth = random_similarity(rng, False)
        heads = centers[rng.integers(0, len(centers), 400)] + rng.normal(0, 0.1 * size, (400, 3))
        picked = centers.mean(axis=0) + rng.uniform(-0.7, 0.7, (5, 3)) * size
        noisy = picked + rng.normal(0, 0.01 * size, picked.shape)
        back = np.linalg.inv(truth)
        fit = Pairs(transform_points(back, picked), noisy).fit(AlignmentTarget(is_upright=False), lambda *_: None)
        off.append(np.linalg.norm(transform_points(fit.matrix, transform_points(back, heads)) - heads, axis=1) / size)
        turned = fit.matrix[:3, :3] @ truth[:3, :3].T / similarity_scale(fit.matrix) / similarity_scale(truth)
        angle.append(np.degrees(Rotation.from_matrix(turned).magnitude()))
        stated.append(np.median(fit.residuals_cm) / 100 * similarity_scale(fit.matrix) / size)
    error = np.concatenate(off)
    percent = [f"{100 * v:.2g}" for v in (np.median(error), np.percentile(error, 95), np.median(stated))]
    return [[str(trials), *percent[:2], f"{np.median(angle):.2g}", f"{np.percentile(angle, 95):.2g}", percent[2]]]


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--trials",
        type=int,
        default=50,
        help="Number of trials, each with a random similarity, for each kind of evidence. Default: %(default)s.",
    )
    parser.add_argument(
        "--searches",
        type=int,
        help=f"Number of trials for the kinds that search ({', '.join(SEARCHED)}), which take about ten seconds each. "
        "Default: --trials.",
    )
    parser.add_argument(
        "--mirrors",
        type=int,
        help="Number of additional trials with mirrored tracking data. Default: a fifth of the trials.",
    )
    parser.add_argument(
        "--only",
        action="append",
        choices=[*KINDS, "hidden", "fox"],
        help="Kind of evidence to measure; can be repeated. Default: all.",
    )
    parser.add_argument(
        "--hidden",
        type=int,
        default=2,
        help="Number of trials for each environment without hit points. Default: %(default)s.",
    )
    parser.add_argument("--seed", type=int, default=0, help="Seed of the random similarities. Default: %(default)s.")
    parser.add_argument("--shoppers", type=int, default=12, help="Number of simulated shoppers. Default: %(default)s.")
    parser.add_argument(
        "--rays",
        type=int,
        default=150_000,
        help="Number of rays by which the surfaces of the scene are sampled. Default: %(default)s.",
    )
    args = parser.parse_args(argv)

    requested = args.only or [*KINDS, "hidden", "fox"]
    counts = {kind: args.searches or args.trials if kind in SEARCHED else args.trials for kind in KINDS}
    world = make_world(args.shoppers, args.rays) if requested != ["fox"] else None
    if world is not None and "hidden" in requested:
        with tempfile.TemporaryDirectory() as folder:
            hidden = [
                measure_hidden(*place, fixed, args.hidden, args.seed)
                for place in list_hidden(world, Path(folder))
                for fixed in ("scale", "turn", "scale, turn")
            ]
        save_result("alignment-hidden", HIDDEN_HEAD, hidden, str(args.seed))
    if world is not None and [kind for kind in requested if kind in KINDS]:
        rows = []
        for kind in (k for k in KINDS if k in requested):
            mirrors = max(1, counts[kind] // 5) if args.mirrors is None else args.mirrors
            rows.append(measure(world, kind, counts[kind], mirrors, args.seed))
            print("; ".join(cells(rows[-1])), flush=True)
        save_result("alignment-evidence", HEAD, [cells(row) for row in rows], str(args.seed))
    fox = measure_fox(args.trials) if "fox" in requested else None
    if fox is not None:
        head = "trials|error, % of the cameras' spread|95 % quantile|rotation error, degrees|95 % quantile|residual, %"
        save_result("alignment-fox", head.split("|"), fox, "0")


if __name__ == "__main__":
    main()
