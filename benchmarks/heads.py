"""How much does the direction of the head tell about gaze, and how well does a field of heads predict gaze?

    python benchmarks/heads.py [--only supermarket,room,truck] [--folds 2] [--seed 1]
        [--out out/benchmarks/heads]

In each fold half of the participants train gaze fields, without three zones, as in `next_look.py`: of their gaze, and,
without surfaces, of their gaze and of their heads. The other half is scored in these zones.

The first table is that of `nerg eval next --head`: bits per sample over the position-independent prior. ``more`` is the
head and the field together minus the head alone. The second compares the field of heads with that of gaze. In ``heads,
turned and widened`` the field of heads is convolved with the von Mises-Fisher distribution of gaze in the head that
the training participants have: its mean direction and its concentration. Intervals of 95 % are those of a fold
over participants (root mean square over folds, which share participants).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from places import OURS, PRIOR, parse, parse_environments, place_parser, write_place
from timing import print_table, write_rows

import numpy as np

HEADS, WIDENED = "heads", "heads, turned and widened"
HEAD, BOTH = "head", "head and field"
SCORES = ("KLD", "CC", "bits at own origin")
_DIRECTIONS = 1024  # of heads, in a convolution


def main(argv=None) -> None:
    parser = place_parser(__doc__, "heads", folds=2, only="supermarket,room,truck")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first fold")
    args = parse(parser, argv)
    from nerg_mi.rays.rays import Rays
    from nerg_mi.workflows.base import select_backend

    ns = select_backend("llvm_ad_rgb", args.threads)
    scores_of_head: list[dict] = []
    fields: list[dict] = []
    for name, make in parse_environments(args).items():
        folder, path, where = write_place(name, make, args)
        rays, heads = Rays.load(path), folder / "heads.npz"
        if rays.head is None:
            raise SystemExit(f'"{name}" has no directions of heads; leave it out')
        replace(rays, direction=rays.head, hit=None).save(heads)
        for seed in range(args.seed, args.seed + args.folds):
            # The last field has no surfaces, as that of heads.
            for surfaces in dict.fromkeys([where["geometry"], "none"]):
                gaze = train(folder, path, surfaces, seed, args.threads)
                scores = score_head(gaze, rays, args.threads)
                scores_of_head += [{"scene": name, "surfaces": surfaces, **row} for row in scores]
            of_heads = train(folder, heads, "none", seed, args.threads)
            fields += [{"scene": name, **row} for row in compare_fields(gaze, of_heads, rays, ns)]
    write_rows(args.out / "head.csv", scores_of_head)
    write_rows(args.out / "fields.csv", fields)
    show_head(scores_of_head)
    show_fields(fields)


def train(folder: Path, rays: Path, geometry: str, seed: int, threads: int | None) -> Path:
    """Train the field of a fold. One that an earlier run trained is used again."""
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.workflows.gaze_commands import GazeOptions
    from nerg_mi.workflows.train_gaze import train_gaze

    gaze = folder / f"{rays.stem}-{geometry}-{seed}.safetensors"
    if not gaze.is_file():
        options = GazeOptions(geometry=geometry, test_zones=3, test_participants=0.5, seed=seed, threads=threads)
        with TerminalReporter() as reporter:
            train_gaze(rays, gaze, options, reporter)
    return gaze


def score_head(gaze: Path, rays, threads: int | None) -> list[dict]:
    """Scores of `nerg eval next --head`, each with the mean direction of gaze in the head in degrees."""
    from nerg_mi.workflows.gaze_commands import NextLookOptions
    from nerg_mi.workflows.next_look import evaluate_next_look

    result = evaluate_next_look(gaze, rays, None, NextLookOptions(head=True, threads=threads))
    ahead, right, up = np.asarray(result.model.gaze_in_head)
    angles = {"right": np.degrees(np.arctan2(right, ahead)), "up": np.degrees(np.arcsin(up))}
    return [{**angles, **row} for row in result.rows]


def compare_fields(gaze: Path, heads: Path, rays, ns) -> list[dict]:
    """Scores of the fields of gaze and of heads, and of the prior, on the gaze of held-out participants at held-out
    positions."""
    from nerg_mi.evaluation.baselines import make_prior_baseline
    from nerg_mi.evaluation.gaze import FieldDensity, evaluate_gaze, make_test, select_held_out_rays
    from nerg_mi.evaluation.next_look import PastLooks, measure_gaze_in_head
    from nerg_mi.formats.fields import load_gaze
    from nerg_mi.maths.vmf import kappa_from_mean_resultant_length
    from nerg_mi.train.gaze_data import select_prior_kappa

    (field, metadata), (of_heads, metadata_of_heads) = (load_gaze(path, ns) for path in (gaze, heads))
    holdout = metadata["provenance"]["test"]
    if holdout != metadata_of_heads["provenance"]["test"]:
        raise SystemExit(f'"{gaze}" and "{heads}" hold out different data; remove both, and run again')
    train, scored, centres = select_held_out_rays(rays, holdout)
    test = make_test(scored, centres, holdout["radius"])
    in_head = measure_gaze_in_head(train)
    mean_gaze = PastLooks.from_heads(train.origin, train.head, in_head).last
    kappa = float(kappa_from_mean_resultant_length(np.einsum("ij,ij->i", mean_gaze, train.direction).mean()))
    prior = make_prior_baseline(train, kappa=select_prior_kappa(train))
    density = FieldDensity(of_heads, None)
    methods = {OURS: FieldDensity(field, None), HEADS: density, WIDENED: widen(density, in_head, kappa), PRIOR: prior}
    return [{"kappa": kappa, **row} for row in evaluate_gaze(test, methods, prior)]


def widen(heads, gaze_in_head: np.ndarray, kappa: float):
    """Density of gaze, from the density of ``heads`` and the distribution of gaze in the head."""
    from nerg_mi.evaluation.next_look import PastLooks
    from nerg_mi.maths import vmf
    from nerg_mi.maths.sphere import fibonacci_directions

    grid = fibonacci_directions(_DIRECTIONS)
    mean_gaze = PastLooks.from_heads(grid, grid, gaze_in_head).last

    def evaluate(positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
        directions = np.broadcast_to(directions, (len(positions), *directions.shape[-2:]))
        out = np.empty(directions.shape[:2])
        for row, (position, queries) in enumerate(zip(positions, directions)):
            weights = heads(position[None], grid)[0]
            kernels = np.exp(kappa * (queries @ mean_gaze.T - 1) + vmf.log_normaliser(kappa))
            out[row] = kernels @ weights / weights.sum()
        return out

    return evaluate


def average(rows: list[dict], score: str) -> str:
    """Mean over the folds, with the interval where there is one."""
    mean, low, high = (np.array([row.get(score + end, np.nan) for row in rows]) for end in ("", ".low", ".high"))
    half_width = np.sqrt(np.mean(((high - low) / 2) ** 2))
    return f"{mean.mean():+.3f} ± {half_width:.3f}" if np.isfinite(half_width) else f"{mean.mean():.3f}"


def show_head(each: list[dict]) -> None:
    table = []
    for scene, surfaces in dict.fromkeys((row["scene"], row["surfaces"]) for row in each):
        rows = [row for row in each if (row["scene"], row["surfaces"]) == (scene, surfaces)]
        by_method = {
            m: [row for row in rows if row["method"] == m] for m in dict.fromkeys(row["method"] for row in rows)
        }
        angles = [f"{np.mean([row[key] for row in rows]):+.1f}" for key in ("right", "up")]
        bits = [
            f"{np.mean([row['bits'] for row in by_method[m]]):.2f}"
            for m in ("gaze field", HEAD, "head and prior", BOTH)
        ]
        table.append([scene, surfaces, *angles, *bits, average(by_method[HEAD], "gap")])
    head = ["scene", "surfaces", "right", "up", "field", HEAD, "head and prior", BOTH, "more"]
    print_table("Bits given the direction of the head", head, table)


def show_fields(each: list[dict]) -> None:
    for score in SCORES:
        table = []
        for scene in dict.fromkeys(row["scene"] for row in each):
            rows = [row for row in each if row["scene"] == scene]
            by_method = {m: [row for row in rows if row["method"] == m] for m in (PRIOR, OURS, HEADS, WIDENED)}
            means = [f"{np.mean([row[score] for row in by_method[m]]):.3f}" for m in by_method]
            kappa = f"{np.mean([row['kappa'] for row in rows]):.0f}"
            table.append([scene, kappa, *means, *(average(by_method[m], f"{score}.gap") for m in (HEADS, WIDENED))])
        head = ["scene", "kappa", "prior", "gaze", HEADS, WIDENED, "gaze minus heads", "gaze minus widened"]
        print_table(f"{score} of fields of gaze and of heads", head, table)


if __name__ == "__main__":
    main()
