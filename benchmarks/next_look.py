"""How well do the last looks, or the direction of the head, predict gaze, alone and together with a gaze field?

    python benchmarks/next_look.py [looks] [--only supermarket,generated-office,room] [--folds 3] [--seed 1]
        [--out out/benchmarks/next_look]
    python benchmarks/next_look.py heads --only supermarket,room,truck --folds 2

**looks** (default): in each fold half of the participants train a gaze field, without three zones, and determine the
weights of the next look (`nerg eval next`) in these zones, where the other half is scored. Bits per look over the
position-independent prior: means over folds, and `more`: the next look minus the better of the last look and the field
by the same scores, which favours these, with 95 % of Student's t over folds. The components were chosen on a fold of
seed 0, without truck, whose participants are scored here in other folds.

For generated scenes, `law` is what the target of the look one elapsed time before adds to the exact gaze field of the
law of attention, and `law, preferences` what it adds together with the participant's preferences: mutual information of
targets, which directions cannot exceed.

**heads**: how much does the direction of the head tell about gaze, and how well does a field of heads predict gaze?
In each fold half of the participants train gaze fields, without three zones, of their gaze, and, without surfaces, of
their gaze and of their heads. The other half is scored in these zones.

The first table is that of `nerg eval next --head`: bits per sample over the position-independent prior. ``more`` is the
head and the field together minus the head alone. The second compares the field of heads with that of gaze. In ``heads,
turned and widened`` the field of heads is convolved with the von Mises-Fisher distribution of gaze in the head that
the training participants have: its mean direction and its concentration. Intervals of 95 % are those of a fold
over participants (root mean square over folds, which share participants). The components given the head were chosen on
the folds of seed 1, which are among the scored ones.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from generated_places import NEW_TARGET_PROBABILITY, PLACES, RATE, draw_preferences
from places import OURS, PRIOR, interval, parse, parse_environments, place_parser, write_place
from timing import save_result

import numpy as np

METHODS = {
    "field": "gaze field",
    "last look": "last look",
    "next look": "next look",
    "no products": "next look without products",
    "no heading": "next look without heading",
    "no field": "next look with the prior as field",
}


def main(argv=None) -> None:
    parser = place_parser(__doc__, "next_look", folds=3)
    parser.add_argument("--seed", type=int, default=1, help="seed of the first fold")
    parser.add_argument("mode", nargs="?", default="looks", choices=("looks", "heads"), help="what predicts gaze")
    args = parse(parser, argv)
    {"looks": run_looks, "heads": run_heads}[args.mode](args)


def run_looks(args) -> None:
    """Print the table of looks."""
    each: list[dict] = []
    for name, make in parse_environments(args).items():
        folder, rays, where = write_place(name, make, args)
        for seed in range(args.seed, args.seed + args.folds):
            each += evaluate(name, folder, rays, where, seed, args.threads)
    bounds = {place.name: place for place in (make() for make in PLACES)}
    rows = []
    for name, elapsed in dict.fromkeys((row["place"], row["elapsed"]) for row in each):
        folds = [row for row in each if (row["place"], row["elapsed"]) == (name, elapsed)]
        mean = {key: np.mean([row[key] for row in folds]) for key in METHODS}
        more = [row["next look"] - max(row["field"], row["last look"]) for row in folds]
        row = {"place": name, "elapsed": f"{elapsed:g} s"} | {key: f"{value:.2f}" for key, value in mean.items()}
        row["more"] = f"{np.mean(more):+.2f} ± {interval(more):.2f}"
        if name in bounds:
            law = compute_law_gain(bounds[name], args.out / name / "scene.xml", elapsed)
            row |= {"law": f"{law[0]:.2f}", "law, preferences": f"{law[1]:.2f}"}
        rows.append(row)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    save_result("next-look", columns, [[row.get(key, "") for key in columns] for row in rows], list_seeds(args))


def list_seeds(args) -> str:
    """The seeds of the folds, as a result states them."""
    return ", ".join(map(str, range(args.seed, args.seed + args.folds)))


def train(folder: Path, rays: Path, where: str | Path, seed: int, threads: int | None) -> Path:
    """Train the field of a fold. One that an earlier run trained is used again."""
    from nerg_mi.progress import TerminalReporter
    from nerg_mi.train.gaze import train_gaze

    gaze = folder / f"{rays.stem}-{where if where in ('hits', 'none') else 'surfaces'}-{seed}.safetensors"
    if not gaze.is_file():
        set_up(threads)
        with TerminalReporter() as reporter:
            train_gaze(rays, where, test_zones=3, test_participants=0.5, seed=seed, output=gaze, progress=reporter)
    return gaze


def set_up(threads: int | None) -> None:
    """Activate the variant, with this number of threads."""
    from nerg_mi.cli.declarations import select_backend

    select_backend("llvm_ad_rgb", threads)


def evaluate(name: str, folder: Path, rays: Path, where: str | Path, seed: int, threads: int | None) -> list[dict]:
    """Bits of each method and elapsed time in a fold."""
    from nerg_mi.evaluation.next_look_scores import next_look
    from nerg_mi.progress import TerminalReporter

    gaze = train(folder, rays, where, seed, threads)
    with TerminalReporter() as reporter:
        result = next_look(gaze, rays, where, progress=reporter)
    rows: dict[float, dict] = {}
    for row in result.rows:
        rows.setdefault(row["elapsed"], {"place": name, "fold": seed, "elapsed": row["elapsed"]})[row["method"]] = row
    return [
        {key: row[key] for key in ("place", "fold", "elapsed")} | {k: row[m]["bits"] for k, m in METHODS.items()}
        for row in rows.values()
    ]


def compute_law_gain(place, scene: Path, elapsed: float) -> tuple[float, float]:
    """Bits that the target one elapsed time before adds to the law at the position, without and with the participant's
    preferences."""
    count, rng = round(elapsed * RATE), np.random.default_rng(1)
    targets: list = []
    place.record(scene, targets=targets)
    gains = []
    for weight, preferences, target in targets:
        share = lambda factor, weight=weight: weight * factor / (weight * factor).sum(axis=1, keepdims=True)
        others = [np.r_[draw_preferences(rng, len(place.things)), 1.0, 1.0] for _ in range(64)]
        preferred, population = share(preferences), np.mean([share(p) for p in others], axis=0)
        now = np.arange(count, len(target))
        last, next_ = target[now - count], target[now]
        # A target that is no longer visible is dropped.
        stays = np.all([weight[now - k, last] > 0 for k in range(count)], axis=0)
        stay = np.where(stays, (1 - NEW_TARGET_PROBABILITY) ** count, 0.0)
        for law in (population, preferred):
            chance = (1 - stay) * law[now, next_] + stay * (next_ == last)
            gains.append(np.log2(chance / population[now, next_]).mean())
    return float(np.mean(gains[::2])), float(np.mean(gains[1::2]))


# ---- Heads ----

HEADS, WIDENED = "heads", "heads, turned and widened"
HEAD, BOTH = "head", "head and field"
SCORES = ("KLD", "CC", "bits at own origin")
_DIRECTIONS = 1024  # of heads, in a convolution


def run_heads(args) -> None:
    """Print the tables of heads."""
    from nerg_mi.cli.declarations import select_backend
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.tracking.rays import Rays

    select_backend("llvm_ad_rgb", args.threads)
    ns = namespace("llvm_ad_rgb")
    scores_of_head: list[dict] = []
    fields: list[dict] = []
    for name, make in parse_environments(args).items():
        folder, path, where = write_place(name, make, args)
        rays, heads = Rays.load(path), folder / "heads.npz"
        if rays.head is None:
            raise SystemExit(f'"{name}" has no directions of heads; leave it out')
        replace(rays, direction=rays.head, hit=None).with_tracking("head").save(heads)
        for seed in range(args.seed, args.seed + args.folds):
            # The last field has no surfaces, as that of heads.
            for surfaces in dict.fromkeys([where, "none"]):
                gaze = train(folder, path, surfaces, seed, args.threads)
                scores = score_head(gaze, rays)
                scores_of_head += [{"scene": name, "surfaces": surfaces, **row} for row in scores]
            of_heads = train(folder, heads, "none", seed, args.threads)
            fields += [{"scene": name, **row} for row in compare_fields(gaze, of_heads, rays, ns)]
    seeds = list_seeds(args)
    show_head(scores_of_head, seeds)
    show_fields(fields, seeds)


def score_head(gaze: Path, rays) -> list[dict]:
    """Scores of `nerg eval next --head`, each with the mean direction of gaze in the head in degrees."""
    from nerg_mi.evaluation.next_look_scores import next_look

    result = next_look(gaze, rays, head=True)
    ahead, right, up = np.asarray(result.model.gaze_in_head)
    angles = {"right": np.degrees(np.arctan2(right, ahead)), "up": np.degrees(np.arcsin(up))}
    return [{**angles, **row} for row in result.rows]


def compare_fields(gaze: Path, heads: Path, rays, ns) -> list[dict]:
    """Scores of the fields of gaze and of heads, and of the prior, on the gaze of held-out participants at held-out
    positions."""
    from nerg_mi.evaluation.baselines import make_prior_baseline
    from nerg_mi.evaluation.gaze import FieldDensity, make_test, score_methods, select_held_out_rays
    from nerg_mi.evaluation.next_look import PastLooks, measure_gaze_in_head
    from nerg_mi.formats.fields import load_gaze
    from nerg_mi.maths.vmf import kappa_from_mean_resultant_length
    from nerg_mi.train.prior import select_prior_kappa

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
    return [{"kappa": kappa, **row} for row in score_methods(test, methods, prior)]


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


def show_head(each: list[dict], seeds: str) -> None:
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
    save_result("heads-bits", head, table, seeds)


def show_fields(each: list[dict], seeds: str) -> None:
    table = []
    for score in SCORES:
        for scene in dict.fromkeys(row["scene"] for row in each):
            rows = [row for row in each if row["scene"] == scene]
            by_method = {m: [row for row in rows if row["method"] == m] for m in (PRIOR, OURS, HEADS, WIDENED)}
            means = [f"{np.mean([row[score] for row in by_method[m]]):.3f}" for m in by_method]
            kappa = f"{np.mean([row['kappa'] for row in rows]):.0f}"
            table.append(
                [score, scene, kappa, *means, *(average(by_method[m], f"{score}.gap") for m in (HEADS, WIDENED))]
            )
    head = ["score", "scene", "kappa", "prior", "gaze", HEADS, WIDENED, "gaze minus heads", "gaze minus widened"]
    save_result("heads-fields", head, table, seeds)


if __name__ == "__main__":
    main()
