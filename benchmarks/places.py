"""Gaze fields compared with simpler baselines by one protocol in several scenes.

    python benchmarks/places.py [--only room,vr-office] [--folds 4] [--seed 0] [--prior-folds N] [--prior-kappa K]
        [--recipe default] [--variant VARIANT] [--no-surfaces] [--against FOLDS.csv] [--out out/benchmarks/places]
    python benchmarks/places.py --uncertainty --folds 3 --zones 6 [--out out/benchmarks/uncertainty]

The scenes are recordings of a supermarket and of a VR office (with surfaces from hit points), recordings of EyeNavGS
scenes (without geometry), the demo store's shoppers in its radiance field, and four generated scenes with walls and
their own laws of attention (`generated_places.py`). In each fold, one half of the participants trains the field. The
other half is scored at 60 positions in three zones. Training data within 2R of these positions are excluded. The
baselines are those of `nerg eval gaze`, tuned on the training rays. The agreement between two halves of the held-out
participants (split half) is a reference.

The best baseline is chosen by the same scores, which favours the baselines. "Field minus best baseline" has the 95 %
interval over participants: folds share participants, so that it is that of one fold (root mean square over folds).
folds.csv has the scores of each fold, for `--against`.

``--uncertainty`` evaluates in the same folds whether a field estimates its own error. Use more zones for it, since the
positions of a zone are neighbours. The table has one row per scene: Spearman's rank correlation of low support with the
error, at new positions and at all held-out positions, with 95 % intervals from resampled zones; the mean error at all
positions and at the half with the most support; and the fraction of held-out rays in the smallest regions that contain
80 % of the predicted gaze, before and after calibration on held-out training data.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import replace
from math import isnan, nan
from pathlib import Path

from nerg_mi.files.tables import write_csv
from timing import save_result

ROOT = Path(__file__).resolve().parents[1]

Make = Callable[[Path], tuple[Path, dict]]
"""Writes the rays of a scene into a folder; returns their file and the location of the geometry: options of a fold."""


def place_parser(what: str, out: str, folds: int, only: str | None = None) -> argparse.ArgumentParser:
    """Options of a benchmark: scenes (``only``, default: all), number of ``folds``, and the output folder (below
    out/benchmarks)."""
    parser = argparse.ArgumentParser(description=what, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("NERG_DATA", ROOT.parent / "shared" / "data"))
    parser.add_argument(
        "--data",
        type=Path,
        default=data,
        help="Folder with the recordings vr_supermarket, vr_office and eyenavgs. Default: the variable NERG_DATA, else "
        "../shared/data.",
    )
    parser.add_argument(
        "--only",
        default=only,
        help=f"Names of the scenes, separated by commas. Default: {only or 'all that are available'}.",
    )
    parser.add_argument("--folds", type=int, default=folds, help="Number of folds. Default: %(default)s.")
    parser.add_argument("--threads", type=int, help="Number of CPU threads. Default: all cores.")
    parser.add_argument("--result", default=out, help="Name of the result. Default: %(default)s.")
    parser.add_argument(
        "--out", type=Path, default=Path("out/benchmarks") / out, help="Folder for the results. Default: %(default)s."
    )
    return parser


def parse(parser: argparse.ArgumentParser, argv=None) -> argparse.Namespace:
    """The parsed options; creates the output folder."""
    args = parser.parse_args(argv)
    args.out = args.out.resolve()
    args.out.mkdir(parents=True, exist_ok=True)
    return args


def parse_environments(args: argparse.Namespace) -> dict[str, Make]:
    """The generators of the requested scenes, by name. Raises ``SystemExit`` for unknown ones."""
    expected = makers(args.data)
    names = args.only.split(",") if args.only else list(expected)
    for name in names:
        if name not in expected:
            raise SystemExit(
                f'no place is called "{name}" here; there are {", ".join(expected)} (set NERG_DATA for more)'
            )
    return {name: expected[name] for name in names}


def write_place(name: str, make: Make, args: argparse.Namespace) -> tuple[Path, Path, str | Path]:
    """``(folder, rays, where)`` of a scene, below the output folder. Chooses the variant, which scenes need."""
    from nerg_mi.cli.declarations import select_backend

    select_backend("llvm_ad_rgb", args.threads)
    folder = args.out / name
    folder.mkdir(exist_ok=True)
    return folder, *make(folder)


def makers(data: Path) -> dict[str, Make]:
    """By name, functions that write the rays of a scene into a folder and return their file and the environment."""
    from generated_places import PLACES

    out: dict[str, Make] = {}
    for name, source in (("supermarket", "vr_supermarket"), ("vr-office", "vr_office")):
        if files := sorted((data / source).glob("*.csv.gz")):
            # One experiment, with the same columns in both environments
            out[name] = lambda folder, files=files: (recorded(files, "vr_supermarket", folder), "hits")
    for scene in sorted(path for path in (data / "eyenavgs").glob("*") if path.is_dir()):
        if files := sorted(scene.glob("*.csv.gz")):
            out[scene.name] = lambda folder, files=files: (recorded(files, "eyenavgs", folder), "none")
    out["store"] = store
    for make in PLACES:
        place = make()
        out[place.name] = lambda folder, place=place: generated(place, folder)
    return out


def recorded(files: list[Path], reader: str, folder: Path) -> Path:
    """Rays of recordings; readers skip recordings with frozen gaze and report them."""
    from nerg_mi.tracking.imports import import_rays

    path = folder / "rays.npz"
    import_rays(files, reader, output=path)
    return path


def store(folder: Path) -> tuple[Path, dict]:
    """The demo store's shoppers in its radiance field."""
    from nerg_mi.scenes.store import SCENE_FILE, make
    from nerg_mi.tracking.imports import import_rays

    csv = Path(make.__file__).parent / "build" / "shoppers.csv"
    if not csv.is_file():
        make.main(["--stage", "shoppers"])
    path = folder / "rays.npz"
    import_rays(csv, "skeleton", tick=0.001, output=path)
    return path, SCENE_FILE.parent / "store.safetensors"


def generated(place, folder: Path) -> tuple[Path, dict]:
    scene, path = place.write(folder / "scene.xml"), folder / "rays.npz"
    place.record(scene).save(path)
    return path, scene


OURS, PRIOR, HALF = "gaze field", "position-independent prior", "split half"
# Higher is better.
SCORES = {"KLD": False, "CC": True, "bits at own origin": True}


def main(argv=None) -> None:
    parser = place_parser(__doc__, "places", folds=4)
    parser.add_argument(
        "--recipe", default="default", help="Training recipe: default, small or paper. Default: %(default)s."
    )
    parser.add_argument(
        "--variant", help="Variant of the field: emit, capture or emit_capture. Default: set by the recipe."
    )
    parser.add_argument("--seed", type=int, default=0, help="Seed of the first fold. Default: %(default)s.")
    parser.add_argument(
        "--zones", type=int, default=3, help="Number of zones of test positions in a fold. Default: %(default)s."
    )
    parser.add_argument(
        "--prior-folds",
        type=int,
        help="Number of folds that select the weight of the position-independent prior; 0: no prior. Default: set by "
        "the recipe.",
    )
    parser.add_argument(
        "--prior-kappa",
        type=float,
        help="Concentration (unitless) of the kernel of the position-independent prior. Default: set by the recipe.",
    )
    parser.add_argument("--no-surfaces", action="store_true", help="Train and score without geometry in all scenes.")
    parser.add_argument(
        "--against",
        type=Path,
        help="File folds.csv of another run; prints the scores of this run minus those of the other, fold by fold. "
        "Default: none.",
    )
    parser.add_argument(
        "--uncertainty",
        action="store_true",
        help="Evaluate whether support predicts the error of the field. Default: compare it with baselines.",
    )
    args = parse(parser, argv)
    if args.against is not None and not args.against.is_file():
        parser.error(f'"{args.against}" is not there; it is written by a run whose --out is its folder')
    each: list[dict] = []
    unsure: list[dict] = []
    kinds: list[dict] = []
    regions: list[dict] = []
    for name, make in parse_environments(args).items():
        result = evaluate(name, make, args)
        each += [
            {"place": name, **{key: row[key] for key in ("fold", "split", "method", *SCORES)}, **half_widths(row)}
            for row in result.each
        ]
        unsure += uncertainty(name, result)
        kinds += [{"place": name, **row} for row in result.verdicts]
        regions += [{"place": name, **row} for row in result.calibration]
    write_csv(args.out / "folds.csv", each)
    seeds = ", ".join(map(str, range(args.seed, args.seed + args.folds)))
    if args.uncertainty:
        save_uncertainty(args.result, unsure, seeds)
        return
    save_places(args.result, each, seeds)
    save_methods(f"{args.result}-methods", each, seeds)
    save_kinds(f"{args.result}-kinds", kinds, seeds)
    save_regions(f"{args.result}-regions", regions, seeds)
    if args.against is not None:
        show_change(each, args.against)


def evaluate(name: str, make: Make, args: argparse.Namespace):
    """The results of `nerg eval folds` for a scene."""
    from nerg_mi.evaluation.folds import folds
    from nerg_mi.progress import TerminalReporter
    from nerg_mi.tasks.settings import Parallel
    from nerg_mi.train.gaze_recipes import get_recipe

    folder, rays, where = write_place(name, make, args)
    recipe = get_recipe(args.recipe)
    if args.prior_kappa is not None:
        recipe = replace(recipe, probes=replace(recipe.probes, prior_kappa=args.prior_kappa))
    with TerminalReporter() as reporter:
        return folds(
            rays,
            "none" if args.no_surfaces else where,
            recipe=recipe,
            variant=args.variant,
            folds=args.folds,
            seed=args.seed,
            test_zones=args.zones,
            splits="both,people" if args.uncertainty else "both",
            prior_folds=args.prior_folds,
            output=folder / "eval",
            parallel=Parallel(threads=args.threads),
            progress=reporter,
        )


def half_widths(row: dict) -> dict:
    """Half widths of the 95 % intervals, over participants, of the field's scores minus those of ``row``."""
    ends = lambda score: (row.get(f"{score}.gap.high", nan), row.get(f"{score}.gap.low", nan))
    return {f"{score} gap half width": (ends(score)[0] - ends(score)[1]) / 2 for score in SCORES}


def interval(values) -> float:
    """Half width of 95 % of Student's t for the mean of ``values`` (F,); NaN for a single one."""
    import numpy as np
    from scipy.stats import t

    count = len(values)
    return float(t.ppf(0.975, count - 1) * np.std(values, ddof=1) / np.sqrt(count)) if count > 1 else float("nan")


def show_change(each: list[dict], before: Path) -> None:
    """Print the field of ``each`` minus that of the run with the folds.csv ``before``, scene by scene in shared
    folds."""
    import csv

    import numpy as np

    with before.open() as file:
        expected = {(r["place"], int(r["fold"])): r for r in csv.DictReader(file) if r["method"] == OURS}
    print(f"\nfield minus field of {before}")
    separate = [r for r in each if r["method"] == OURS and (r["place"], r["fold"]) in expected]
    for name in dict.fromkeys(r["place"] for r in separate):
        folds = [r for r in separate if r["place"] == name]
        less = {s: np.array([float(r[s]) - float(expected[name, r["fold"]][s]) for r in folds]) for s in SCORES}
        print(f"{name:12s}" + ", ".join(f"{s} {v.mean():+.3f} ± {interval(v):.3f}" for s, v in less.items()))


def save_places(name: str, each: list[dict], seeds: str) -> None:
    """The field's scores in each scene, those of the best baseline, and their difference."""
    import numpy as np

    table = []
    for score, is_higher_better in SCORES.items():
        for place in dict.fromkeys(row["place"] for row in each):
            rows = [row for row in each if row["place"] == place and row["method"] != HALF]
            values = {
                m: np.array([r[score] for r in rows if r["method"] == m], float)
                for m in dict.fromkeys(r["method"] for r in rows)
            }
            means = {m: v.mean() for m, v in values.items()}
            best = (max if is_higher_better else min)((m for m in means if m != OURS), key=means.__getitem__)
            less = values[OURS] - values[best]
            widths = [r[f"{score} gap half width"] for r in rows if r["method"] == best]
            half_width = np.sqrt(np.mean(np.square(widths)))
            cells = [f"{means[PRIOR]:.3f}", best, f"{means[best]:.3f}", f"{means[OURS]:.3f}"]
            cells += [f"{less.mean():+.3f} ± {half_width:.3f}", ", ".join(f"{v:+.3f}" for v in less)]
            table.append([score, place, len(less), *cells])
    head = ("score", "scene", "folds", "prior", "best baseline", "its value", "field", "field minus best baseline")
    save_result(name, (*head, "by fold"), table, seeds)


def save_methods(name: str, each: list[dict], seeds: str) -> None:
    """Mean scores over folds of each method."""
    table = []
    for place, method in dict.fromkeys((r["place"], r["method"]) for r in each):
        rows = [r for r in each if (r["place"], r["method"]) == (place, method)]
        means = (sum(float(r[s]) for r in rows) / len(rows) for s in SCORES)
        table.append([place, method, *("" if isnan(mean) else f"{mean:.3f}" for mean in means)])
    save_result(name, ("scene", "method", *SCORES), table, seeds)


def save_kinds(name: str, rows: list[dict], seeds: str) -> None:
    """Mean bits over the prior at recorded and at new positions, of the field and of the baseline that is best on
    average, and their difference in each fold."""
    import numpy as np

    table = []
    for place, kind in dict.fromkeys((row["place"], row["kind"]) for row in rows):
        bits: dict[str, list[float]] = {}
        for row in rows:
            if (row["place"], row["kind"]) == (place, kind):
                bits.setdefault(row["method"], []).append(row["bits"])
        best = max((m for m in bits if m != OURS), key=lambda m: np.mean(bits[m]))
        less = np.subtract(bits[OURS], bits[best])
        means = [f"{np.mean(bits[method]):.3f}" for method in (OURS, best)]
        table.append(
            [place, kind, means[0], best, means[1], f"{less.mean():+.3f}", ", ".join(f"{v:+.3f}" for v in less)]
        )
    head = ("scene", "positions", "field", "best baseline", "its value", "field minus best baseline", "by fold")
    save_result(name, head, table, seeds)


def save_regions(name: str, rows: list[dict], seeds: str) -> None:
    """Fractions of the held-out rays in regions of the field at recorded and at new positions, means over folds; empty
    without calibration."""
    from nerg_mi.evaluation.position_scores import AWAY, RECORDED

    by, levels, table = {(row["place"], row["method"]): row for row in rows}, ("50%", "80%", "95%"), []
    for place in dict.fromkeys(row["place"] for row in rows):
        for kind in (RECORDED, AWAY):
            methods = f"{OURS}, {kind}", f"{OURS}, {kind}, calibrated"
            rows_of = [by.get((place, method)) for method in methods]
            cells = [f"{100 * row[level]:.0f}" if row else "" for row in rows_of for level in levels]
            table.append([place, kind, *cells])
    head = [*(f"{level[:-1]} %" for level in levels), *(f"{level[:-1]} %, calibrated" for level in levels)]
    save_result(name, ("scene", "positions", *head), table, seeds)


def uncertainty(name: str, result) -> list[dict]:
    """One row per signal, population ("both": new positions) and error of one scene."""
    held = {(r["split"], r["method"]): r["80%"] for r in result.calibration}
    regions = {"of 80%": held["both", OURS], "of 80%, calibrated": held.get(("both", f"{OURS}, calibrated"), nan)}
    keys = ("signal", "split", "error", "positions", "rho", "100%", "50%")
    ranks = [r for r in result.uncertainty if r["split"] != "people"]
    ends = lambda r: {key: r.get(key, nan) for key in ("rho.low", "rho.high")}
    return [{"place": name, **{key: r[key] for key in keys}, **ends(r), **regions} for r in ranks]


def save_uncertainty(name: str, rows: list[dict], seeds: str) -> None:
    by = {(r["place"], r["signal"], r["split"], r["error"]): r for r in rows}
    places = list(dict.fromkeys(r["place"] for r in rows))

    def rho(place: str, split: str, error: str) -> str:
        r = by.get((place, "support", split, error))
        if r is None or isnan(r["rho"]):
            return "too few"
        return f"{r['rho']:+.2f} [{r['rho.low']:+.2f}, {r['rho.high']:+.2f}]"

    table = []
    for place in places:
        r = by[place, "support", "both", "KLD"]
        ranks = [rho(place, "both", error) for error in ("KLD", "excess")]
        regions = ["" if isnan(r[key]) else f"{r[key]:.0%}" for key in ("of 80%", "of 80%, calibrated")]
        table.append([place, *ranks, f"{r['100%']:.2f}, {r['50%']:.2f}", *regions])
    head = ["scene", "rho, KLD", "rho, excess KLD", "KLD: all, half with most support"]
    save_result(name, [*head, "coverage of 80 % regions", "calibrated"], table, seeds)


if __name__ == "__main__":
    main()
