"""The paper's ablation: every variant of a gaze field, trained alike and scored on what it saw and on what it did not.

Losses are the paper's, KLD + (1 - CC) + MAE, of densities over directions of equal area, on positions of the training
and on positions that were held out; normalised by the product of emit and capture of the same recipe. A frame is a
render of the gaze by the integrator, observer and camera in one place.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from nerg_mi.files.atomic import write_text
from nerg_mi.files.bounded import read_json
from nerg_mi.files.png import write_figure
from nerg_mi.files.tables import markdown_table, write_csv, write_json
from nerg_mi.formats.fields import save_gaze
from nerg_mi.rays.rays import Rays
from nerg_mi.training.gaze.recipes import gaze_recipe
from nerg_mi.training.gaze.run import train_gaze
from nerg_mi.training.gaze.semantics import config_like, trunk_of
from nerg_mi.training.gaze.settings import GazeSettings, ProbeSettings
from nerg_mi.training.gaze.state import digest
from nerg_mi.training.geometry.places import GazePlace

from .gaze.evaluation import GazeTest, make_test, map_scores
from .gaze.scores import gaze_field

COLUMNS = (
    "recipe",
    "variant",
    "seed",
    "steps",
    "train_loss",
    "test_loss",
    "train_relative",
    "test_relative",
    "train_KLD",
    "test_KLD",
    "train_CC",
    "test_CC",
    "train_MAE",
    "test_MAE",
    "train_seconds",
    "frame_seconds",
)


@dataclass(frozen=True)
class Variant:
    """``recipe`` of ``gaze_recipes``; ``gaze``: emit, capture or emit_capture; ``more``: of ``GazeConfig``; ``begin``:
    whether the trunk begins as the radiance field's, ``frozen``: and stays so."""

    name: str
    recipe: str
    gaze: str = "emit_capture"
    more: tuple = ()
    begin: bool = False
    frozen: bool = False


def all_variants(semantic: bool, recipes: tuple = ("default", "paper")) -> list[Variant]:
    """Of each of ``recipes`` the three variants and, where there is a radiance field (``semantic``) and the recipe has
    them, the semantic ones and the two initialisations."""
    out = []
    for recipe in recipes:
        out += [Variant(name, recipe, name) for name in ("emit", "capture", "emit_capture")]
        if semantic and recipe != "default":
            for kind in ("accumulated", "snapshot"):
                out += [
                    Variant(
                        f"semantic {kind}{', own too' * own}", recipe, more=(("semantic", kind), ("semantic_own", own))
                    )
                    for own in (False, True)
                ]
            out += [
                Variant("begins as the field, frozen", recipe, begin=True, frozen=True),
                Variant("begins as the field", recipe, begin=True),
            ]
    return out


def ablate(
    rays: Rays,
    train: Rays,
    centres: np.ndarray,
    place: GazePlace,
    variants: list[Variant],
    folder: Path,
    ns,
    seeds: int = 3,
    steps: dict | None = None,
    radius: float = 0.25,
    kappa: float = 20.0,
    min_rays: int = 64,
    render: Callable | None = None,
    say: Callable = print,
    align=None,
    truth: Callable | None = None,
    probes: int | None = None,
    refit: bool = True,
) -> list[dict]:
    """Train and score ``variants``; one row each, seed by seed (recipe ``default``: ``seeds`` of them, others one),
    with ``COLUMNS``.

    ``rays``: whose density at ``centres`` is the truth of the test; ``train``: what is trained on;
    ``truth(positions, directions)``: the true density in place of theirs, where it is known. ``steps``: by recipe, in
    place of its own. ``render(checkpoint)``: seconds a frame. ``probes``: of a training at most; ``refit``: as
    ``GazeSettings`` has it, of every recipe but the default one, which does. Checkpoints go to ``folder``, each with
    its row: what an earlier run with the same rays, place, tests and settings has left there is not trained again.
    """
    seen = train.origin[np.random.default_rng(0).permutation(len(train))[: len(centres)]]
    sets = {
        "train": make_test(train, seen, radius, kappa, min_rays=min(min_rays, 16)),
        "test": make_test(rays, centres, radius, kappa, min_rays=min_rays),
    }
    if truth is not None:
        sets = {k: replace(s, truth=truth(s.centres, s.directions)) for k, s in sets.items()}
    rows = []
    for v in variants:
        for seed in range(seeds if v.recipe == "default" else 1):
            row = _run(
                v,
                seed,
                train,
                sets,
                place,
                folder,
                ns,
                (steps or {}).get(v.recipe),
                probes,
                min_rays,
                render,
                align,
                refit,
            )
            say(
                f"{v.recipe:8s} {v.name:28s} seed {seed}: test KLD {row['test_KLD']:.3f}, CC {row['test_CC']:.3f}; {row['train_seconds']:.0f} s"
            )
            rows.append(row)
    for recipe in {v.recipe for v in variants}:
        whole = [r for r in rows if (r["recipe"], r["variant"]) == (recipe, "emit_capture")]
        for side in ("train", "test") if whole else ():
            unit = np.mean([r[f"{side}_loss"] for r in whole])
            for r in rows:
                if r["recipe"] == recipe:
                    r[f"{side}_relative"] = r[f"{side}_loss"] / unit
    return rows


def _run(
    v: Variant,
    seed: int,
    train: Rays,
    tests: dict[str, GazeTest],
    place: GazePlace,
    folder: Path,
    ns,
    steps,
    probes,
    min_rays,
    render,
    align,
    refit,
) -> dict:
    recipe, initial = gaze_recipe(v.recipe, v.gaze), None
    config, more = place.told(recipe.config), dict(v.more)
    if v.begin:
        config = config_like(place.medium.field.config, v.gaze, config.activation)
        initial = trunk_of(place.medium.field, config)
    elif more:
        config = replace(config, **more, geometry=place.medium.feature_count)
    fixed = {"seed": seed, "frozen": v.frozen, "refit": refit or v.recipe == "default"}
    settings = GazeSettings(**recipe.settings | fixed | ({"steps": steps} if steps else {}))
    how = ProbeSettings(**recipe.probes | ({"count": probes} if probes else {}))
    # Positions that validate are to be had wherever there are some that test.
    settings = replace(settings, watched_rays=min(settings.watched_rays or how.min_rays, min_rays))
    path = folder / f"{v.recipe}_{v.name.replace(', ', '_').replace(' ', '_')}_{seed}.safetensors"
    same = {
        "architecture": config.to_dict(),
        "settings": settings.to_dict(),
        "probes": how.to_dict(),
        "rays": digest(train),
        "tests": {k: hashlib.sha256(t.truth.tobytes()).hexdigest() for k, t in tests.items()},
        "begin": v.begin,
        **place.about,
    }
    kept = path.with_suffix(".json")
    found = read_json(kept, "kept row") if path.exists() and kept.exists() else None
    if isinstance(found, dict) and "row" in found and found.get("same") == json.loads(json.dumps(same)):
        row = found["row"]
    else:
        made = {"recipe": v.recipe, "variant": v.name, "seed": seed}
        row = made | _train(train, tests, place, config, settings, how, ns, align, initial, made, path)
        write_json(kept, {"row": row, "same": same})
    if render is not None:
        row["frame_seconds"] = render(path)
    return row


def _train(train, tests, place: GazePlace, config, settings, how, ns, align, initial, made: dict, path: Path) -> dict:
    """Train, write the checkpoint (``made``: what it is), score on ``tests``. Raises ``KeyboardInterrupt`` after
    Ctrl-C."""
    started = time.perf_counter()
    field, about = train_gaze(train, place.medium, place.box, config, settings, how, ns, align, initial=initial)
    if about["interrupted"]:
        raise KeyboardInterrupt
    row = {"steps": about["steps"], "train_seconds": time.perf_counter() - started}
    save_gaze(field, path, {**place.about, **about, **made})
    density = gaze_field(field, place.medium, align, how.depth)
    for side, test in tests.items():
        scores = map_scores(test.truth, density(test.centres, test.directions))
        row |= {f"{side}_{k}": scores[k] for k in ("KLD", "CC", "MAE")}
        row[f"{side}_loss"] = scores["KLD"] + 1 - scores["CC"] + scores["MAE"]
    return row


def frame_timer(
    place: GazePlace,
    centres: np.ndarray,
    folder: Path,
    cameras: int = 4,
    width: int = 320,
    height: int = 180,
    seed: int = 0,
) -> Callable | None:
    """``render(checkpoint)``: mean seconds a frame of ``cameras`` at random ``centres``, looking about level; None
    where there is nothing to render, and for a scene of shapes that also has a field. The first render of each
    checkpoint, which compiles, does not count; the integral of a normalised field does, since each camera has one of
    its own."""
    import mitsuba as mi

    if place.kind == "none" or (place.kind == "scene" and place.medium.medium is not None):
        return None
    rng = np.random.default_rng(seed)
    eyes, angles = centres[rng.integers(0, len(centres), cameras)], rng.uniform(0, 2 * np.pi, cameras)

    def render(path: Path) -> float:
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {
                    "type": "nerg",
                    "aovs": "gaze",
                    "radiance": False,
                    "gaze": {"type": "gazefield", "filename": str(path)},
                    **_around(place),
                },
                **_shapes(place),
            }
        )
        times = []
        for eye, angle in [(eyes[0], angles[0]), *zip(eyes, angles)]:
            target = eye + (np.cos(angle), np.sin(angle), -0.1)
            sensor = mi.load_dict(
                {
                    "type": "perspective",
                    "fov": 70,
                    "to_world": mi.ScalarTransform4f().look_at(eye.tolist(), target.tolist(), [0, 0, 1]),
                    "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
                    "sampler": {"type": "independent", "sample_count": 1},
                }
            )
            started = time.perf_counter()
            np.array(mi.render(scene, sensor=sensor, spp=1))
            times.append(time.perf_counter() - started)
        return float(np.mean(times[1:]))

    def _around(place):
        if place.kind == "field":
            return {"field": {"type": "nerf", "filename": str(folder / place.about["field_file"]["file"])}}
        if place.kind == "hits":
            from nerg_mi.training.geometry.hit_geometry import volume_dict

            return {"density": volume_dict(folder / place.about["geometry_file"]["file"])}
        return {}

    def _shapes(place):
        return {f"shape{i}": s for i, s in enumerate(place.medium.scene.shapes())} if place.kind == "scene" else {}

    return render


def summarise(rows: list[dict]) -> list[dict]:
    """A row a recipe and variant: means over seeds, and the spread (standard deviation) of what differs between
    them."""
    out = []
    for key in dict.fromkeys((r["recipe"], r["variant"]) for r in rows):
        found = [r for r in rows if (r["recipe"], r["variant"]) == key]
        row = {"recipe": key[0], "variant": key[1], "seeds": len(found)}
        for k in COLUMNS[3:]:
            values = [r[k] for r in found if k in r]
            if values:
                row[k] = float(np.mean(values))
                if len(values) > 1 and k.startswith(("train_", "test_")) and not k.endswith("seconds"):
                    row[f"{k}.spread"] = float(np.std(values, ddof=1))
        out.append(row)
    return out


def table(summary: list[dict]) -> str:
    """Markdown: losses relative to emit_capture of the same recipe, scores on held-out positions, seconds."""
    shown = (
        "train_relative",
        "test_relative",
        "test_loss",
        "test_KLD",
        "test_CC",
        "test_MAE",
        "train_seconds",
        "frame_seconds",
    )
    head, lines = ["recipe", "variant", "seeds", "steps", *(k.replace("_", " ") for k in shown)], []
    for r in summary:
        cells = []
        for k in shown:
            digits = 4 if k.endswith("MAE") else 3
            spread = f" ± {r[f'{k}.spread']:.{digits}f}" if f"{k}.spread" in r else ""
            cells.append(f"{r[k]:.{digits}f}{spread}" if k in r else "")
        lines.append([r["recipe"], r["variant"], r["seeds"], f"{r['steps']:.0f}", *cells])
    return markdown_table(head, lines, head[2:]) + "\n"


def write_ablation(folder: Path, rows: list[dict], notes: str) -> list[Path]:
    """``ablation.md``, ``.csv``, ``.json`` and the plot ``ablation.png``; returns their paths."""
    summary, files = summarise(rows), [folder / f"ablation.{e}" for e in ("md", "csv", "json", "png")]
    write_text(files[0], f"{notes}\n\n{table(summary)}")
    write_csv(files[1], rows, COLUMNS)
    write_json(files[2], {"rows": rows, "summary": summary})
    _plot(summary, files[3])
    return files


def _plot(summary: list[dict], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(1.5 + 1.0 * len(summary), 4), layout="constrained")
    x = np.arange(len(summary))
    for side, shift, colour in (("train", -0.2, "#9db7d5"), ("test", 0.2, "#2f5f93")):
        bars = [r.get(f"{side}_relative", np.nan) for r in summary]
        # One seed has no spread, which is not one of zero.
        spread = [r.get(f"{side}_relative.spread", np.nan) for r in summary]
        axis.bar(x + shift, bars, 0.4, yerr=spread, label=f"{side} probes", color=colour, capsize=3)
    axis.axhline(1, color="0.5", lw=0.8)
    axis.set_xticks(x, [f"{r['variant']}\n({r['recipe']})" for r in summary], fontsize=8, rotation=30, ha="right")
    axis.set_ylabel("KLD + (1 - CC) + MAE, emit_capture = 1")
    figure.legend(loc="outside upper right", ncols=2)
    write_figure(path, figure, dpi=120)
    plt.close(figure)
