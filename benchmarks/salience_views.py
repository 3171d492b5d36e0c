"""Gaze learnt from salience images against gaze learnt from rays, where the law behind both is known: the demo store.

    python benchmarks/salience_views.py [--places 150] [--turns 2] [--rays 150] [--out
    out/benchmarks/salience_views.csv]

Cameras stand at random places of the floor at eye height and look about, level to 25 degrees down. What each sees of
the store's attention law becomes a salience image of 64 x 48 pixels (82 x 66 degrees; what a model would say: gaze a
pixel), written with its pose as transforms.json and read back, as `nerg train gaze --views --salience` reads it. Rays
are drawn from the same law at the same places. The geometry is the store's shapes; the recipe is the default one,
unchanged, or that of `--recipe`. Test positions are at least 2R from every camera; truth is the law in closed form in
2,048 directions of equal area, over the whole sphere, of which a view shows 12 %.

`blind, of the views`: the density that the views agree on whatever the position. `blind, of the law`: the mean of the
law over the places themselves, the best of that kind.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import nerg_mi  # noqa: F401  (chooses the libLLVM, so it comes before drjit and mitsuba)

import numpy as np

WIDTH, HEIGHT, FOCAL = 64, 48, 37.0
DIRECTIONS = 2048
RADIUS = 0.25


def places(count: int, away: np.ndarray, rng) -> np.ndarray:
    """``count`` positions of eyes (count, 3), two R from each of ``away`` (N, 3)."""
    from nerg_mi.scenes.store.layout import ROOM, build
    from nerg_mi.scenes.store.shoppers import BODY, EYE_HEIGHT, floor_clearance

    at = np.stack(
        [rng.uniform(0, ROOM[0], 20000), rng.uniform(0, ROOM[1], 20000), rng.uniform(*EYE_HEIGHT, 20000)], axis=1
    )
    at = at[floor_clearance(build(), at[:, :2]) > BODY]
    if len(away):
        at = at[np.linalg.norm(at[:, None] - away, axis=2).min(axis=1) > 2 * RADIUS]
    return at[:count]


def look(position, angle: float, down: float) -> np.ndarray:
    """OpenGL camera-to-world, z up."""
    ahead = np.array([np.cos(angle) * np.cos(down), np.sin(angle) * np.cos(down), -np.sin(down)])
    right = np.array([np.sin(angle), -np.cos(angle), 0.0])
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = np.stack([right, np.cross(right, ahead), -ahead], axis=1), position
    return m


def write_views(folder: Path, law, positions: np.ndarray, rng) -> None:
    """transforms.json and maps/*.npy of one view at each of ``positions``; the maps' pictures stand for the photos."""
    from nerg_mi.capture.cameras import pixel_directions
    from nerg_mi.capture.intrinsics import Intrinsics
    from nerg_mi.capture.salience.solid_angle import pixel_solid_angles

    import mitsuba as mi

    lens = Intrinsics(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    local, solid = pixel_directions(lens).reshape(-1, 3), pixel_solid_angles(lens)
    poses = [look(p, rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, 25))) for p in positions]
    density = law.density(positions, np.stack([local @ m[:3, :3].T for m in poses]))
    (folder / "maps").mkdir()
    for k, row in enumerate(density):
        image = row.reshape(HEIGHT, WIDTH) * solid
        np.save(folder / "maps" / f"{k:04d}.npy", image.astype(np.float32))
        mi.Bitmap(np.round(255 * image / image.max()).astype(np.uint8)).write(str(folder / f"{k:04d}.png"))
    frames = [{"file_path": f"{k:04d}.png", "transform_matrix": m.tolist()} for k, m in enumerate(poses)]
    about = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(about))


def draw_rays(law, positions: np.ndarray, count: int, rng):
    """``count`` rays at each of ``positions``, of ten people in turn."""
    from nerg_mi.rays.rays import Rays

    origin = np.repeat(positions, count, axis=0)
    n = len(origin)
    return Rays(
        np.arange(n) / 5.0, np.arange(n) % 10, tuple("abcdefghij"), origin, law.sample(origin, rng), np.ones(n), None
    )


def main(argv=None) -> list[dict]:
    from output import write_rows

    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    from nerg_mi.capture.salience.views import open_salience
    from nerg_mi.evaluation.gaze import baselines
    from nerg_mi.evaluation.gaze.scores import gaze_field, print_scores, score_rows
    from nerg_mi.field.backend import namespace
    from nerg_mi.field.gaze.log_density import look_up
    from nerg_mi.jobs.gaze import train_planned
    from nerg_mi.jobs.gaze_plan import plan_gaze
    from nerg_mi.jobs.options.gaze import GazeOptions
    from nerg_mi.maths.sphere import fibonacci_directions
    from nerg_mi.scenes import store
    from nerg_mi.scenes.store.attention_law import AttentionLaw
    from nerg_mi.training.gaze.blind import blind_of_views
    from nerg_mi.training.gaze.supervision import Supervision
    from nerg_mi.training.geometry.places import place_of_scene

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--places", type=int, default=150)
    parser.add_argument("--turns", type=int, default=2, help="views at each place")
    parser.add_argument("--rays", type=int, default=150, help="rays at each place")
    parser.add_argument("--tests", type=int, default=48)
    parser.add_argument("--recipe", choices=("default", "small"), default="default")
    parser.add_argument("--steps", type=int, help="instead of the recipe's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/benchmarks/salience_views.csv"))
    args = parser.parse_args(argv)

    ns, law, rng = namespace("llvm_ad_rgb"), AttentionLaw(), np.random.default_rng(args.seed)
    tests = places(args.tests, np.empty((0, 3)), rng)
    stood = places(args.places, tests, rng)
    place = place_of_scene(Path(store.__file__).parent / "twin.xml")
    directions = fibonacci_directions(DIRECTIONS)
    truth = law.density(tests, directions)
    with tempfile.TemporaryDirectory() as name:
        write_views(Path(name), law, np.repeat(stood, args.turns, axis=0), rng)
        views = open_salience(name, Path(name) / "maps").views
    rays = draw_rays(law, stood, args.rays, rng)

    blind = blind_of_views(views, 64)
    seen = ns.Float(blind.ravel())
    vectors = lambda d: ns.Array3f(np.ascontiguousarray(d.T, np.float32))
    of_views = lambda p, d: np.tile(np.exp(np.array(look_up(seen, 64, vectors(d)))), (len(p), 1))
    of_law = law.density(stood, directions).mean(axis=0)
    methods = {
        "uniform": baselines.uniform(),
        "blind, of the views": of_views,
        "blind, of the law": lambda p, d: np.tile(of_law, (len(p), 1)),
        "4,096 nearest rays": baselines.nearest_rays(rays, 4096),
    }
    # As the command does where there are no rays; the scores of the others then compare. A log density is anyway.
    options = GazeOptions(recipe=args.recipe, normalized=True, radius=RADIUS, steps=args.steps, seed=args.seed)
    spent = {}
    for label, r, v in (
        (f"rays, {len(rays):,}", rays, ()),
        (f"views, {len(views)}", None, views),
        ("both", rays, views),
    ):
        started = time.process_time()
        trained = train_planned(Supervision(r, v), place, plan_gaze(options, place, views_alone=r is None), ns)
        spent[label] = time.process_time() - started
        print(f"{label}: {trained.provenance['steps']} steps, {spent[label]:.0f} s of CPU")
        methods[label] = gaze_field(trained.field, place.medium)
    rows = score_rows(truth, tests, directions, methods)
    print_scores(
        rows, f"{len(tests)} held-out positions against the law, over the sphere ({len(stood)} places trained on)"
    )
    write_rows(args.out, rows)
    return rows


if __name__ == "__main__":
    main()
