"""Ablation of gaze-field variants trained alike, and the time per frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import translate_mitsuba_errors
from nerg_mi.figures.style import Provenance, new_page, save
from nerg_mi.files.atomic import write_text
from nerg_mi.files.tables import add_notes, format_markdown_table, write_csv, write_json
from nerg_mi.formats.splats import choose_plugin
from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_recipes import get_recipe
from nerg_mi.train.geometry import TrainingGeometry, make_volume_dict
from nerg_mi.transport.geometry import SceneGeometry

from .baselines import Baseline
from .gaze import GazeTest, compute_map_scores, make_test
from .study_scenes import make_sensor

# ---- Ablation ----
#
# The ablation of the paper: every variant of a gaze field, scored at training positions and at held-out positions.
#
# The loss is that of the paper, KLD + (1 - CC) + MAE, of densities over directions of equal area. Relative losses are
# divided by that of the product of emit and capture of the same recipe. A frame is a rendering of the gaze by the
# integrator, with the camera as the observer.

COLUMNS = tuple(
    """
    recipe variant seed steps train_loss test_loss train_relative test_relative train_KLD test_KLD train_CC
    test_CC train_MAE test_MAE train_seconds frame_seconds
    """.split()
)


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A variant of a gaze field in an ablation."""

    name: str  # Name in tables
    recipe: str  # Recipe (`train.gaze_recipes`)
    field_variant: str = "emit_capture"  # Factors: "emit", "capture" or "emit_capture"
    semantic: str = ""  # Radiance-field features as input of emit (`train.gaze_recipes.FieldOptions`); "": none
    semantic_own: bool = False  # Whether emit also has the field's own features
    init_from_field: bool = False  # Whether the trunk is initialised from the radiance field
    frozen: bool = False  # Whether these weights are not trained
    loss: str = ""  # Training loss (`train.gaze_settings.LOSSES`); "": set by the recipe

    def file_name(self, seed: int) -> str:
        """Return the checkpoint name of the training with this ``seed``."""
        return f"{self.recipe}_{self.name.replace(', ', '_').replace(' ', '_')}_{seed}.safetensors"


def list_variants(has_radiance: bool, recipes: Sequence[str] = ("default", "paper")) -> list[Variant]:
    """List the variants of each recipe: the three combinations of factors, the other losses that the recipe supports
    and, with a radiance field, the semantic variants and the two initialisations that it supports.
    """
    out = []
    for recipe in map(get_recipe, recipes):
        out += [
            Variant(name=name, recipe=recipe.name, field_variant=name) for name in ("emit", "capture", "emit_capture")
        ]
        default_loss = recipe.make_gaze_settings().loss
        out += [
            Variant(name=f"loss {loss}", recipe=recipe.name, loss=loss)
            for loss in recipe.losses
            if loss != default_loss
        ]
        if has_radiance and "semantic" in recipe.supported_options:
            out += [
                Variant(
                    name=f"semantic {kind}{', own too' * with_own}",
                    recipe=recipe.name,
                    semantic=kind,
                    semantic_own=with_own,
                )
                for kind in ("accumulated", "snapshot")
                for with_own in (False, True)
            ]
        if has_radiance and "init" in recipe.supported_options:
            out += [
                Variant(name="begins as the field, frozen", recipe=recipe.name, init_from_field=True, frozen=True),
                Variant(name="begins as the field", recipe=recipe.name, init_from_field=True),
            ]
    return out


def make_tests(
    rays: Rays,
    train: Rays,
    centres: np.ndarray,
    radius: float,
    kappa: float,
    min_rays: int,
    truth: Baseline | None = None,
) -> dict[str, GazeTest]:
    """Make the test sets of an ablation: ``train`` at training positions and ``test`` at held-out positions.

    Parameters
    ----------
    rays : Rays
        Rays whose density is the truth of the test; lengths in metres.
    train : Rays
        Training rays.
    centres : numpy.ndarray
        Held-out positions (T, 3).
    radius, kappa, min_rays
        Probe radius, kernel concentration and minimum number of rays per position.
    truth : Baseline, optional
        ``truth(positions, directions)`` returns the true density, if it is known.
    """
    train_centres = train.origin[np.random.default_rng(0).permutation(len(train))[: len(centres)]]
    tests = {
        "train": make_test(train, train_centres, radius, kappa, min_rays=min(min_rays, 16)),
        "test": make_test(rays, centres, radius, kappa, min_rays=min_rays),
    }
    if truth is not None:
        # A known density is not smoothed.
        tests = {k: replace(t, truth=truth(t.centres, t.directions), kappa=None) for k, t in tests.items()}
    return tests


def score_density(tests: dict[str, GazeTest], density: Baseline) -> dict[str, float]:
    """Score ``density(positions, directions)`` in 1/sr on each of ``tests``, including the loss of the paper."""
    row = {}
    for side, test in tests.items():
        scores = compute_map_scores(test.truth, test.smooth(density(test.centres, test.directions)))
        row |= {f"{side}_{k}": scores[k] for k in ("KLD", "CC", "MAE")}
        row[f"{side}_loss"] = scores["KLD"] + 1 - scores["CC"] + scores["MAE"]
    return row


def add_relative_losses(rows: list[dict]) -> None:
    """Add the loss relative to the mean of emit_capture of the same recipe to each of ``rows``, if it exists."""
    for recipe in {r["recipe"] for r in rows}:
        reference_rows = [r for r in rows if (r["recipe"], r["variant"]) == (recipe, "emit_capture")]
        for side in ("train", "test") if reference_rows else ():
            unit = np.mean([r[f"{side}_loss"] for r in reference_rows])
            for r in rows:
                if r["recipe"] == recipe:
                    r[f"{side}_relative"] = r[f"{side}_loss"] / unit


def summarise(rows: list[dict]) -> list[dict]:
    """Summarise rows by recipe and variant: means over seeds, and standard deviations (``.spread``)."""
    out = []
    for key in dict.fromkeys((r["recipe"], r["variant"]) for r in rows):
        group = [r for r in rows if (r["recipe"], r["variant"]) == key]
        row = {"recipe": key[0], "variant": key[1], "seeds": len(group)}
        for k in COLUMNS[3:]:
            values = [r[k] for r in group if k in r]
            if values:
                row[k] = float(np.mean(values))
                if len(values) > 1 and k.startswith(("train_", "test_")) and not k.endswith("seconds"):
                    row[f"{k}.spread"] = float(np.std(values, ddof=1))
        out.append(row)
    return out


def format_table(summary: list[dict]) -> str:
    """Format ``summary`` as Markdown: relative and absolute losses, scores at held-out positions, and times."""
    columns = [f"{side}_{kind}" for kind in ("relative", "loss") for side in ("train", "test")]
    columns += ["test_KLD", "test_CC", "test_MAE", "train_seconds", "frame_seconds"]
    head, lines = ["recipe", "variant", "seeds", "steps", *(k.replace("_", " ") for k in columns)], []
    for r in summary:
        cells = []
        for k in columns:
            digits = 4 if k.endswith("MAE") else 3
            spread = f" ± {r[f'{k}.spread']:.{digits}f}" if f"{k}.spread" in r else ""
            cells.append(f"{r[k]:.{digits}f}{spread}" if k in r else "")
        lines.append([r["recipe"], r["variant"], r["seeds"], f"{r['steps']:.0f}", *cells])
    return format_markdown_table(head, lines, head[2:]) + "\n"


def write_ablation(folder: Path, rows: list[dict], notes: str, provenance: Provenance | None = None) -> list[Path]:
    """Write ``ablation.md`` (below ``notes``), ``.csv``, ``.json`` and the plot ``.png`` into ``folder``; returns the
    paths. Each of ``rows`` gets a ``note`` on missing values.
    """
    add_notes(rows, _explain_missing, COLUMNS)
    summary, files = summarise(rows), [folder / f"ablation.{e}" for e in ("md", "csv", "json", "png")]
    write_text(files[0], f"{notes}\n\n{format_table(summary)}")
    add_notes(summary, _explain_missing, COLUMNS[3:])
    write_csv(files[1], rows, (*COLUMNS, "note"))
    write_json(files[2], {"rows": rows, "summary": summary})
    save(_figure(summary), files[3], provenance)
    return files


def _explain_missing(row: Mapping[str, Any], column: str) -> tuple[str, str]:
    if column.endswith(".spread"):
        return column, "of a single seed"
    if column == "frame_seconds":
        return column, "frames are not timed"
    return column, "there is no emit_capture of the same recipe"


def _figure(summary: list[dict]) -> Any:
    """Draw the relative losses at training and held-out positions as bars, a pair per variant."""
    figure = new_page(180 + 120 * len(summary), 480)
    figure.set_layout_engine("constrained")
    axis = figure.subplots()
    x = np.arange(len(summary))
    for side, shift, colour in (("train", -0.2, "#9db7d5"), ("test", 0.2, "#2f5f93")):
        bars = [r.get(f"{side}_relative", np.nan) for r in summary]
        # A single seed has an unknown spread, not zero.
        spread = [r.get(f"{side}_relative.spread", np.nan) for r in summary]
        axis.bar(x + shift, bars, 0.4, yerr=spread, label=f"{side} probes", color=colour, capsize=3)
    axis.axhline(1, color="0.5", lw=0.8)
    axis.set_xticks(x, [f"{r['variant']}\n({r['recipe']})" for r in summary], fontsize=8, rotation=30, ha="right")
    axis.set_ylabel("KLD + (1 - CC) + MAE, emit_capture = 1")
    figure.legend(loc="outside upper right", ncols=2)
    return figure


# ---- Rendering time of a gaze frame with the camera as the observer ----


def make_frame_timer(
    geometry: TrainingGeometry,
    centres: np.ndarray,
    folder: Path,
    cameras: int = 4,
    width: int = 320,
    height: int = 180,
    seed: int = 0,
) -> Callable[[Path], float] | None:
    """Return ``render(checkpoint)``, which measures the mean rendering time of a frame in seconds.

    Parameters
    ----------
    geometry : TrainingGeometry
        Geometry to render. The result is None without geometry, and for a scene of shapes that also has a field.
    centres : numpy.ndarray
        Candidate camera positions (T, 3).
    folder : Path
        Folder of the file of the geometry.
    cameras : int
        Number of random cameras, which look nearly horizontally.
    width, height : int
        Size of the frame in pixels.
    seed : int
        Seed of the cameras.

    Notes
    -----
    The first frame of each checkpoint, which compiles kernels, is not counted. The integral of a normalised field is
    counted, because each camera has its own.
    """
    import mitsuba as mi

    if geometry.kind == "none" or (isinstance(geometry.medium, SceneGeometry) and geometry.medium.medium is not None):
        return None
    rng = np.random.default_rng(seed)
    origins, angles = centres[rng.integers(0, len(centres), cameras)], rng.uniform(0, 2 * np.pi, cameras)

    def render(checkpoint: Path) -> float:
        integrator = {"type": "nerg", "aovs": "gaze", "radiance": False, **_medium(geometry, folder)}
        integrator["gaze"] = {"type": "gazefield", "filename": str(checkpoint)}
        with translate_mitsuba_errors(checkpoint):
            scene = mi.load_dict({"type": "scene", "integrator": integrator, **_shapes(geometry)})
        times = []
        for eye, angle in [(origins[0], angles[0]), *zip(origins, angles)]:
            target = eye + (np.cos(angle), np.sin(angle), -0.1)
            sensor = mi.load_dict(make_sensor(eye.tolist(), target.tolist(), 70, width, height))
            started = time.perf_counter()
            np.array(mi.render(scene, sensor=sensor))
            times.append(time.perf_counter() - started)
        return float(np.mean(times[1:]))

    return render


def _medium(place: TrainingGeometry, folder: Path) -> dict:
    """Return the medium of ``geometry`` as plugin parameters of the integrator."""
    if place.kind == "field":
        path = folder / place.metadata["field_file"]["file"]
        return {"field": {"type": choose_plugin(path), "filename": str(path)}}
    if place.kind == "hits":
        return {"density": make_volume_dict(folder / place.metadata["geometry_file"]["file"])}
    return {}


def _shapes(place: TrainingGeometry) -> dict:
    """Return the shapes of ``geometry`` as children of a scene."""
    scene = place.medium.scene if isinstance(place.medium, SceneGeometry) else None
    return {} if scene is None else {f"shape{i}": s for i, s in enumerate(scene.shapes())}
