"""Training a gaze field on rays: what is trained on which rays, and the run; and a field for untracked places."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.alignment.check import read_similarity
from nerg_mi.errors import NergError, blame_options
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.files.atomic import check_writable, reserve_output
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.formats.fields import save_gaze
from nerg_mi.maths.geometry import Similarity
from nerg_mi.photos.salience import SalienceSet, open_salience
from nerg_mi.rays.dataset import is_dataset, load_rays, hash_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.train import gaze_run
from nerg_mi.train.gaze_data import Supervision, TargetRequirements, check_prior_kappa, select_far_views, hold_out
from nerg_mi.train.gaze_ensemble import train_ensemble
from nerg_mi.train.gaze_log_density import ELEVATION_KAPPA, make_elevation_prior
from nerg_mi.train.gaze_recipes import FieldOptions, Recipe, get_recipe
from nerg_mi.train.gaze_run import selects_prior_weight
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings
from nerg_mi.train.gaze_trainer import GazePlan, GazeProgress, StateSettings
from nerg_mi.train.geometry import TrainingGeometry

from .base import SILENT, Reporter, select_backend
from .gaze_commands import GazeOptions, PriorOptions
from .geometry import check_geometry, make_geometry, geometry_kind
from .options import explicit_settings

# ---- Training a gaze field on rays: what is trained on which rays, and the run ----


# ---- Gaze plan ----
#
# What the options of a gaze training come to: whether they go together, and the plan that they make of a recipe.


def plan_gaze(options: GazeOptions, place: TrainingGeometry, views_alone: bool = False) -> GazePlan:
    """How ``options`` have a field trained in ``place``; ``views_alone``: there are no rays.

    Raises `NergError` for what does not go together.
    """
    with blame_options(_named(options)):
        return get_recipe(options.recipe).make_plan(
            place,
            _choices(options, place.kind, views_alone),
            settings=explicit_settings(options, GazeSettings),
            probes=explicit_settings(options, ProbeSettings),
            init_from_field=options.init == "field",
            views_only=views_alone,
        )


def check_plan(options: GazeOptions, views_alone: bool = False) -> ProbeSettings:
    """Find what cannot be trained before any time is spent on it; returns the settings of the probes, which do not
    depend on the place. Raises `NergError` for options that do not go together, and for values that are wrong."""
    recipe = get_recipe(options.recipe)
    _check(options, recipe, views_alone)
    with blame_options(_named(options)):
        config = recipe.list_architectures(_choices(options, geometry_kind(options), views_alone))[0]
    recipe.make_gaze_settings(explicit_settings(options, GazeSettings), views_alone)
    probes = recipe.make_probe_settings(explicit_settings(options, ProbeSettings))
    if rows := TargetRequirements.from_config(config).prior_rows:
        check_prior_kappa(rows, probes.mix_kappa)
    return probes


def _check(options: GazeOptions, recipe: Recipe, views_alone: bool) -> None:
    """Raise `NergError` for options that do not go together."""
    kind = geometry_kind(options)
    if views_alone and options.views is None:
        raise NergError("say what to learn from: a rays file, or --views with --salience, or both")
    mixed = options.mix_folds or options.mix_kappa is not None
    if views_alone and (options.test_zones or kind == "hits" or options.align or options.semantic or mixed):
        raise NergError(
            "--test-zones, --geometry hits, --align, --semantic, --mix-folds and --mix-kappa belong to rays; give a "
            "rays file besides --views (or hold views out by leaving their images out of the folder, and align them "
            "with --align-views)"
        )
    if options.geometry is not None and options.align is not None:
        raise NergError("--align belongs to --field and --scene; a place made from rays is in the rays' own frame")
    if options.test_participants and not options.test_zones:
        raise NergError("--test-people leaves people out at test positions: say where, with --test-zones")
    if (options.views is None or options.salience is None) and (
        options.views or options.salience or options.align_views
    ):
        raise NergError(
            "salience needs both: --views, the posed photos, and --salience, the images' folder or spectral-residual"
        )
    if options.init not in ("random", "field"):
        raise NergError(f'--begin must be "random" or "field", got "{options.init}"')
    if options.freeze and options.init != "field":
        raise NergError("--freeze keeps the weights that --begin field gives; add it, or leave --freeze out")
    if options.field is None and (options.semantic or options.init == "field"):
        raise NergError(
            f"{'--semantic' if options.semantic else '--begin field'} needs a radiance field: give it with --field"
        )
    asked = {
        "activation": options.activation,
        "size": options.size,
        "semantic": options.semantic,
        "begin": options.init == "field",
        "loss": options.loss,
        "integral": options.integral is not None,
        "normalized": options.normalize,
        "mix-folds": bool(options.mix_folds),
        "mix-kappa": options.mix_kappa is not None,
    }
    recipe.check_options([name for name, given in asked.items() if given])
    if options.loss and options.loss not in recipe.losses:
        raise NergError(f'the loss must be one of {", ".join(recipe.losses)}, got "{options.loss}"')


def _named(options: GazeOptions) -> str:
    """By which options the architecture was chosen."""
    given = options.semantic or options.init == "field"
    return "--semantic, --variant and --begin" if given else "--variant and --activation"


def _choices(options: GazeOptions, kind: str, views_alone: bool) -> FieldOptions:
    return FieldOptions(
        variant=options.variant or "",
        activation=options.activation,
        size=options.size,
        # Views alone do not say how much is looked altogether.
        normalized=options.normalize or views_alone,
        semantic=options.semantic,
        semantic_own=options.semantic_concat,
        geometry_kind=kind,
    )


# ---- The training of a gaze field: from rays of attention, salience images or both to a checkpoint ----


# From this share of the blind density on, that is most of what a field says.
_MOSTLY_BLIND = 0.5


@dataclass(frozen=True)
class GazeResult:
    """A gaze field that was trained."""

    # The field, or the ensemble.
    field: AnyGazeField
    # What its checkpoint says about the training (JSON).
    provenance: dict
    # The checkpoint; None where none was asked for.
    output: Path | None
    # Whether the run was ended early.
    interrupted: bool


def train_gaze(
    rays: Rays | str | Path | None,
    output: str | Path | None = None,
    options: GazeOptions | None = None,
    reporter: Reporter = SILENT,
) -> GazeResult:
    """Train a gaze field on ``rays`` of attention, or their file (.npz or .parquet) or dataset; None: on salience
    images alone.

    ``output``: checkpoint to write (.safetensors). Beside it are kept the state of the run while that is not done
    (.run), from which it can be resumed, and a place of hit points (.vol). After Ctrl-C the result so far and the state
    are written and ``KeyboardInterrupt`` is raised; without ``output`` the result so far is returned, as
    ``interrupted``.

    Raises `NergError` for what the user can mend, before any time is spent on it.
    """
    with reserve_output(output):
        return _train(rays, None if output is None else Path(output), options or GazeOptions(), reporter)


def _train(rays: Rays | str | Path | None, output: Path | None, options: GazeOptions, reporter: Reporter) -> GazeResult:
    probes = check_plan(options, views_alone=rays is None)
    state = None if output is None else output.with_suffix(".run")
    if output is not None and state is not None:
        _check_outputs(options, output, state)
    elif options.resume or options.geometry == "hits":
        raise NergError("a run that is resumed, and a place of hit points, need a file for the gaze field: give one")
    ns = select_backend(options.mode, options.threads)
    if options.resume and not options.ensemble and (state is None or not state.is_file()):
        raise NergError(f'there is nothing to resume: "{state}" does not exist; leave out --resume to start')
    align = Similarity() if options.align is None else read_similarity(options.align, "--align", "rays to field")
    if not isinstance(rays, Rays):
        reporter.progress(0.0, "reading rays")
    supervision, about = _supervision(rays, options, probes, align, reporter)
    volume = None if output is None else output.with_suffix(".vol")
    place = make_geometry(options, supervision.rays, supervision.views, volume, ns, options.voxel, reporter)
    place = replace(place, align=align)
    check_geometry(place, supervision.rays, _place_option(options), options.force, reporter)
    about |= place.metadata
    reporter.progress(0.0, "placing probes and tracing their depths")
    plan = plan_gaze(options, place, views_alone=supervision.rays is None)
    if place.kind == "none" and options.variant is None:
        choose = plan.alternatives and selects_prior_weight(plan) and supervision.rays is not None
        how = "folds choose between capture alone and emit x capture" if choose else "capture alone is trained"
        reporter.message(f"no surfaces are known: {how}")
    if plan.initial_arrays and options.field is not None:
        about["begins_as"] = Path(options.field).name
    result = train_planned(
        supervision,
        place,
        plan,
        ns,
        output,
        ensemble=options.ensemble,
        state=StateSettings(
            path=state, resume=options.resume, interval=options.save_every or float("inf"), identity=dict(about)
        ),
        half=options.half,
        reporter=reporter,
    )
    _tell(result, reporter)
    if result.interrupted and output is not None:
        raise KeyboardInterrupt(f"interrupted; go on with --resume (state in {state})")
    return result


def train_planned(
    supervision: Supervision,
    place: TrainingGeometry,
    plan: GazePlan,
    ns: ModuleType,
    output: Path | None = None,
    *,
    ensemble: int = 0,
    state: StateSettings | None = None,
    half: bool = False,
    reporter: Reporter = SILENT,
) -> GazeResult:
    """Train a field as ``plan`` says, or an ``ensemble`` of so many, and write it to ``output``, with ``state.about``
    among its provenance. Without ``output`` nothing is written but the state."""
    state = state or StateSettings()
    write = None
    if output is not None:
        write = lambda field, provenance: save_gaze(field, output, {**state.identity, **provenance}, half)
    train = partial(train_ensemble, ensemble) if ensemble else gaze_run.train_gaze
    tell = lambda progress: reporter.progress(progress.done, _progress(progress))
    field, provenance = train(supervision, place, plan, ns, state=state, tell=tell, write=write)
    return GazeResult(field, {**state.identity, **provenance}, output, provenance["interrupted"])


def _place_option(options: GazeOptions) -> str:
    """The option by which the place was given."""
    return f"--field {options.field}" if options.field is not None else f"--scene {options.scene}"


def _check_outputs(options: GazeOptions, output: Path, state: Path) -> None:
    """Raise `NergError` where one of the files cannot be written."""
    check_writable(output, ".safetensors")
    check_writable(state)
    if options.geometry == "hits":
        check_writable(output.with_suffix(".vol"))


def _supervision(
    rays: Rays | str | Path | None, options: GazeOptions, probes: ProbeSettings, align: Similarity, reporter: Reporter
) -> tuple[Supervision, dict]:
    """What is learnt from, without what a test holds out; and what the provenance says of it (JSON)."""
    about: dict = {"recipe": options.recipe}
    data = None
    if isinstance(rays, Rays):
        data = rays
    elif rays is not None:
        path, data = Path(rays), load_rays(rays, options.most, options.seed)
        about["rays_file"] = {"file": path.name, "sha256": hash_rays(path), "persons": len(data.persons)}
        if is_dataset(path):
            about["rays_file"] |= {"most": options.most, "seed": options.seed, "rays": len(data)}
            reporter.message(f"{len(data):,} rays of {path}")
    views = []
    if options.views is not None and options.salience is not None:
        found, similarity = _open_views(options, options.views, options.salience)
        views = found.views
        about |= {"salience": found.provenance, **similarity}
        _tell_views(found, reporter)
    if options.test_zones and data is not None:
        data, test = hold_out(
            data,
            probes.radius,
            options.test_zones,
            options.test_positions,
            options.seed,
            max(64, probes.min_rays),
            options.test_participants,
        )
        about["test"] = test
        reporter.message(
            f"{len(test['centres'])} test positions held out, {test['rays_to_train']:,} of {test['rays']:,} rays left"
        )
        centres = np.array(test["centres"]) @ align.matrix[:3, :3].T + align.matrix[:3, 3]
        views = select_far_views(views, centres, 2 * probes.radius * align.scale)
    return Supervision(data, tuple(views)), about


def _open_views(options: GazeOptions, photos: Path, salience: str) -> tuple[SalienceSet, dict]:
    """Salience images in the frame of the place, and what the provenance says of their alignment (JSON)."""
    matrix = None
    if options.align_views is not None:
        matrix = read_similarity(options.align_views, "--align-views", "photos to field").matrix
    trained = None
    if options.field is not None:
        trained = read_checkpoint(options.field, "radiance")[1].get("provenance")
    found = open_salience(photos, salience, options.salience_unit, matrix, trained, options.allow_outside)
    return found, {} if matrix is None else {"align_views": matrix.tolist()}


def _tell_views(found: SalienceSet, reporter: Reporter) -> None:
    for line in found.notes:
        reporter.message(line)
    without = f"; without: {', '.join(found.frames_without_map)}" if found.frames_without_map else ""
    stray = f"; images of no frame: {', '.join(found.unmatched_files)}" if found.unmatched_files else ""
    reporter.message(f"{len(found.views)} views with salience{without}{stray}")


def _progress(now: GazeProgress) -> str:
    scores = "" if now.scores is None else f", held out KLD {now.scores.kld:.3f}, CC {now.scores.cc:.3f}"
    return f"{now.stage}: step {now.steps}{scores}" if now.steps else now.stage


def _tell(result: GazeResult, reporter: Reporter) -> None:
    about = result.provenance
    views = about["salience_views"]
    counts = f"{about['probes_made'] - views} probes" + (f" and {views} views" if views else "")
    reporter.message(
        f"{counts}; {100 * about['escaped_directions']:.2f} % of the directions meet no surface, "
        f"and {100 * about['escaped_gaze']:.2f} % of the gaze"
    )
    if "validation" in about:
        v = about["validation"]
        reporter.message(
            f"held-out positions: KLD {v['kld']:.3f}, CC {v['cc']:.3f}, MAE {v['mae']:.4f} /sr, "
            f"integral {v['integral']:.3f}, best after {v['best_step']} steps"
        )
    reporter.message(
        f"{about['steps']} steps; {about['seconds']:.0f} s in all, of it {about['seconds_preparing']:.0f} s for the "
        f"probes{'; interrupted' if result.interrupted else ''}"
    )
    if "mix" in about:
        m = about["mix"]
        if m["variant"]:
            klds = ", ".join(f"{kld:.3f} of {name}" for name, kld in m["variants"].items())
            reporter.message(f"held-out KLD {klds}: {m['variant']} is trained")
        if m["folds"]:
            folds = f"{m['folds']} fold{'' if m['folds'] == 1 else 's'}"
            reporter.message(
                f"held out in {folds}: KLD {m['kld_field']:.3f} of the field, {m['kld_blind']:.3f} of where people "
                f"look wherever they stand; {100 * m['mix']:.0f} % of the latter are mixed in"
            )
            reporter.message(f"regions of {100 * m['regions']['80%']:.0f} % of the field's gaze held 80 % of theirs")
        else:
            reporter.message(
                "too few rays at any place to hold people out: whether position tells where others look is not known"
            )
        if m["mix"] >= _MOSTLY_BLIND:
            reporter.warn(
                "position tells little of where others look here: the gaze field is mostly where people look wherever "
                "they stand; record more people, or give the place's surfaces"
            )
    if result.output is not None:
        reporter.message(f"wrote {result.output} ({result.output.stat().st_size / 1e6:.2f} MB)")


# ---- A gaze field for a place where nobody was tracked: what people in other places say of it ----


# ---- A gaze field for a place where nobody was tracked: what people in other places say of it ----


PRIOR = "prior"
"""What the provenance of such a field names as its recipe."""


@dataclass(frozen=True)
class PriorResult:
    """``field``; its ``provenance`` (JSON), as its checkpoint ``output`` holds it, where one was asked for."""

    field: AnyGazeField
    provenance: dict
    output: Path | None


def learn_prior(
    rays: Rays | str | Path | Sequence[Rays | str | Path],
    output: str | Path | None = None,
    options: PriorOptions | None = None,
    reporter: Reporter = SILENT,
) -> PriorResult:
    """A gaze field for any place whose z axis points up, of how high people looked: ``rays``, or their files
    (.npz or .parquet) or datasets, one a place, or those of one place alone. Places count alike, and people within a
    place. It does not depend on where an observer stands, and is written to ``output`` (.safetensors) where that is
    given.

    Raises `NergError` for what the user can mend.
    """
    options, output = options or PriorOptions(), None if output is None else Path(output)
    rays = [rays] if isinstance(rays, (Rays, str, Path)) else rays
    if not rays:
        raise NergError("a prior is learnt from the rays of other places: give at least one file of them")
    if output is not None:
        check_writable(output, ".safetensors")
    ns = select_backend(options.mode)
    learnt, files = [], []
    for k, place in enumerate(rays):
        reporter.progress(k / len(rays), "reading rays")
        data = place if isinstance(place, Rays) else load_rays(place, options.max_samples, options.seed)
        of_file = {} if isinstance(place, Rays) else {"file": Path(place).name, "sha256": hash_rays(place)}
        learnt.append(data)
        files.append({**of_file, "rays": len(data), "persons": len(data.persons)})
    if empty := [str(k + 1) for k, data in enumerate(learnt) if not len(data)]:
        raise NergError(f"no ray is in place {', '.join(empty)} of those that a prior is learnt from; leave it out")
    field = make_elevation_prior(learnt, ns)
    provenance = {
        "recipe": PRIOR,
        "kappa": ELEVATION_KAPPA,
        "places": files,
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    if output is not None:
        save_gaze(field, output, provenance)
        people = sum(of["persons"] for of in files)
        many = f"{len(files)} place{'' if len(files) == 1 else 's'}"
        reporter.message(f"wrote {output}: how high {people} people looked in {many}, wherever an observer stands")
    return PriorResult(field, provenance, output)
