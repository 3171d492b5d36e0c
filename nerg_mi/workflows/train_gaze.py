"""Training of a gaze field on rays."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import ModuleType

import numpy as np

from nerg_mi.alignment.check import read_similarity
from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError, blame_options, parameter
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.files.atomic import check_writable, reserve_output
from nerg_mi.formats.checkpoint import read_checkpoint
from nerg_mi.formats.fields import save_gaze
from nerg_mi.interruption import TrainingInterrupted
from nerg_mi.maths.geometry import Similarity
from nerg_mi.options import explicit_settings
from nerg_mi.photos.salience import SalienceSet, open_salience
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.dataset import hash_rays, is_dataset, load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.train import gaze_run
from nerg_mi.train.gaze_data import Supervision, TargetRequirements, check_prior_kappa, hold_out, select_far_views
from nerg_mi.train.gaze_ensemble import train_ensemble
from nerg_mi.train.gaze_folds import selects_prior_weight
from nerg_mi.train.gaze_recipes import FieldOptions, Recipe, get_recipe
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings
from nerg_mi.train.gaze_trainer import GazePlan, GazeProgress, StateSettings
from nerg_mi.train.geometry_files import check_geometry, geometry_kind, make_geometry

from .base import select_backend
from .gaze_commands import GazeOptions

# ---- Training of a gaze field ----


# ---- Gaze plan ----
#
# Check of the options, and the training plan that results from them and the recipe.


def plan_gaze(options: GazeOptions, environment: Environment, views_alone: bool = False) -> GazePlan:
    """Return the training plan for ``options`` and the geometry; ``views_alone`` tells that there are no rays.

    Raises `NergError` for contradictory options.
    """
    with blame_options(_architecture_options(options)):
        return get_recipe(options.recipe).make_plan(
            environment,
            _choices(options, environment.kind, views_alone),
            settings=explicit_settings(options, GazeSettings),
            probes=explicit_settings(options, ProbeSettings),
            init_from_field=options.init == "field",
            views_only=views_alone,
        )


def check_plan(options: GazeOptions, views_alone: bool = False) -> ProbeSettings:
    """Check the options before any time is spent; return the settings of probes, which do not depend on the geometry.

    Raises `NergError` for contradictory options and invalid values.
    """
    recipe = get_recipe(options.recipe)
    _check(options, recipe, views_alone)
    with blame_options(_architecture_options(options)):
        config = recipe.list_architectures(_choices(options, geometry_kind(options), views_alone))[0]
    recipe.make_gaze_settings(explicit_settings(options, GazeSettings), views_alone)
    probes = recipe.make_probe_settings(explicit_settings(options, ProbeSettings))
    if rows := TargetRequirements.from_config(config).prior_rows:
        check_prior_kappa(rows, probes.prior_kappa)
    return probes


def _check(options: GazeOptions, recipe: Recipe, views_alone: bool) -> None:
    """Raise `NergError` for contradictory options."""
    kind = geometry_kind(options)
    if views_alone and options.views is None:
        raise NergError(
            f"there is no training data: give a rays file, or {parameter('views')} with {parameter('salience')}, "
            "or both"
        )
    mixed = options.prior_folds or options.prior_kappa is not None or options.reaimed_hits
    if views_alone and (options.test_zones or kind == "hits" or options.align or options.semantic or mixed):
        raise NergError(
            f"{parameter('test_zones')}, {parameter('geometry', 'hits')}, {parameter('align')}, "
            f"{parameter('semantic')}, {parameter('prior_folds')}, {parameter('prior_kappa')} and "
            f"{parameter('reaimed_hits', True)} need rays; give a rays file in addition to {parameter('views')} "
            "(to hold out views, remove their images from the folder; to align views, use "
            f"{parameter('align_views')})"
        )
    if options.geometry is not None and options.align is not None:
        raise NergError(
            f"{parameter('align')} applies to {parameter('field')} and {parameter('scene')}; a geometry of hit "
            "points is in the frame of the rays"
        )
    if options.test_participants and not options.test_zones:
        raise NergError(f"{parameter('test_participants')} needs test positions: add {parameter('test_zones')}")
    if (options.views is None or options.salience is None) and (
        options.views or options.salience or options.align_views
    ):
        raise NergError(
            f"{parameter('views')} (posed photos) and {parameter('salience')} (saliency maps, or "
            "spectral-residual) must be given together"
        )
    if options.init not in ("random", "field"):
        raise NergError(f'{parameter("init")} must be "random" or "field", got "{options.init}"')
    if options.freeze and options.init != "field":
        raise NergError(
            f"{parameter('freeze', True)} needs {parameter('init', 'field')}; add it, or leave out "
            f"{parameter('freeze', True)}"
        )
    if options.field is None and (options.semantic or options.init == "field"):
        option = parameter("semantic") if options.semantic else parameter("init", "field")
        raise NergError(f"{option} needs a radiance field: add {parameter('field')}")
    explicit = {
        "activation": options.activation,
        "size": options.size,
        "semantic": options.semantic,
        "init": options.init == "field",
        "loss": options.loss,
        "integral_weight": options.integral_weight is not None,
        "normalize": options.normalize,
        "prior_folds": bool(options.prior_folds),
        "prior_kappa": options.prior_kappa is not None,
        "reaimed_hits": options.reaimed_hits is not None,
    }
    recipe.check_options([name for name, is_set in explicit.items() if is_set])
    if options.loss and options.loss not in recipe.losses:
        raise NergError(f'the loss must be one of {", ".join(recipe.losses)}, got "{options.loss}"')


def _architecture_options(options: GazeOptions) -> str:
    """Return the options that determine the architecture, for error messages."""
    uses_field = options.semantic or options.init == "field"
    return (
        f"{parameter('semantic')}, {parameter('variant')} and {parameter('init')}"
        if uses_field
        else f"{parameter('variant')} and {parameter('activation')}"
    )


def _choices(options: GazeOptions, kind: str, views_alone: bool) -> FieldOptions:
    return FieldOptions(
        variant=options.variant or "",
        activation=options.activation,
        size=options.size,
        # Views alone do not determine the integral of the density.
        normalized=options.normalize or views_alone,
        semantic=options.semantic,
        semantic_own=options.semantic_concat,
        geometry_kind=kind,
    )


# ---- Training run: from rays, saliency maps or both to a checkpoint ----


# Prior weight from which the prior dominates the field.
_DOMINANT_PRIOR = 0.5


@dataclass(frozen=True)
class GazeResult:
    """A trained gaze field."""

    # Field or ensemble.
    field: AnyGazeField
    # Provenance in its checkpoint (JSON).
    provenance: dict
    # Checkpoint, or None.
    output: Path | None
    # Whether training was interrupted.
    interrupted: bool


def train_gaze(
    rays: Rays | str | Path | None,
    output: str | Path | None = None,
    options: GazeOptions | None = None,
    reporter: Reporter = SILENT,
    volume: Path | None = None,
) -> GazeResult:
    """Train a gaze field.

    Parameters
    ----------
    rays
        Rays, their file (.npz or .parquet) or a dataset; None trains on saliency maps alone.
    output
        Checkpoint to write (.safetensors), or None. Next to it are stored the state of an unfinished training (.run),
        from which it can be resumed, and a geometry of hit points (.vol).
    options
        Geometry, recipe and settings.
    reporter
        Receives messages and progress.
    volume
        File for a geometry of hit points, if it is not stored next to ``output``.

    Raises
    ------
    NergError
        For errors that the user can correct, before any time is spent.
    TrainingInterrupted
        After Ctrl-C, when the result so far and the state have been written. The exception has the result so far.
    """
    with reserve_output(output):
        return _train(rays, None if output is None else Path(output), options or GazeOptions(), reporter, volume)


def _train(
    rays: Rays | str | Path | None, output: Path | None, options: GazeOptions, reporter: Reporter, volume: Path | None
) -> GazeResult:
    probes = check_plan(options, views_alone=rays is None)
    state = None if output is None else output.with_suffix(".run")
    if output is not None and state is not None:
        _check_outputs(options, output, state)
    elif options.resume or (options.geometry == "hits" and volume is None):
        raise NergError(
            f"{parameter('resume', True)} and {parameter('geometry', 'hits')} need an output file for the gaze "
            "field: give one"
        )
    ns = select_backend(options.mode, options.threads)
    if options.resume and not options.ensemble and (state is None or not state.is_file()):
        raise NergError(
            f'there is no state to resume: "{state}" does not exist; leave out {parameter("resume", True)} to start'
        )
    align = Similarity() if options.align is None else _read_alignment(options.align, options.force, reporter)
    if not isinstance(rays, Rays):
        reporter.progress(0.0, "reading rays")
    supervision, metadata = _supervision(rays, options, probes, align, reporter)
    volume = volume or (None if output is None else output.with_suffix(".vol"))
    environment = make_geometry(options, supervision.rays, supervision.views, volume, options.voxel_size, reporter)
    environment = replace(environment, align=align)
    check_geometry(environment, supervision.rays, _environment_option(options), options.force, reporter)
    metadata |= environment.metadata
    reporter.progress(0.0, "placing probes and tracing their depths")
    plan = plan_gaze(options, environment, views_alone=supervision.rays is None)
    if environment.kind == "none" and options.variant is None:
        choose = plan.alternatives and selects_prior_weight(plan) and supervision.rays is not None
        how = (
            "cross-validation chooses between capture alone and emit x capture"
            if choose
            else "capture alone is trained"
        )
        reporter.message(f"there is no geometry: {how}")
    if plan.initial_arrays and options.field is not None:
        metadata["begins_as"] = Path(options.field).name
    result = train_planned(
        supervision,
        environment,
        plan,
        ns,
        output,
        ensemble=options.ensemble,
        state=StateSettings(
            path=state, resume=options.resume, interval=options.save_every or float("inf"), identity=dict(metadata)
        ),
        half=options.half,
        reporter=reporter,
    )
    _report_result(result, reporter)
    if result.interrupted:
        raise TrainingInterrupted(result.field, result.provenance, state)
    return result


def train_planned(
    supervision: Supervision,
    environment: Environment,
    plan: GazePlan,
    ns: ModuleType,
    output: Path | None = None,
    *,
    ensemble: int = 0,
    state: StateSettings | None = None,
    half: bool = False,
    reporter: Reporter = SILENT,
) -> GazeResult:
    """Train a field or an ``ensemble`` as in ``plan``, and write it to ``output`` with the metadata ``state.about``.

    Without ``output`` only the state is written.
    """
    state = state or StateSettings()
    write = None
    if output is not None:
        write = lambda field, provenance: save_gaze(field, output, {**state.identity, **provenance}, half)
    train = partial(train_ensemble, ensemble) if ensemble else gaze_run.train_gaze
    on_progress = lambda progress: reporter.progress(progress.fraction, _progress(progress))
    field, provenance = train(supervision, environment, plan, ns, state=state, on_progress=on_progress, write=write)
    return GazeResult(field, {**state.identity, **provenance}, output, provenance["interrupted"])


def _environment_option(options: GazeOptions) -> str:
    """Return the option that selected the geometry."""
    return parameter("field", options.field) if options.field is not None else parameter("scene", options.scene)


def _check_outputs(options: GazeOptions, output: Path, state: Path) -> None:
    """Raise `NergError` if one of the files is not writable."""
    check_writable(output, ".safetensors")
    check_writable(state)
    if options.geometry == "hits":
        check_writable(output.with_suffix(".vol"))


def _supervision(
    rays: Rays | str | Path | None, options: GazeOptions, probes: ProbeSettings, align: Similarity, reporter: Reporter
) -> tuple[Supervision, dict]:
    """Return the training data without held-out data, and their provenance (JSON)."""
    metadata: dict = {"recipe": options.recipe}
    data = None
    if isinstance(rays, Rays):
        data = rays
    elif rays is not None:
        path, data = Path(rays), load_rays(rays, options.max_samples, options.seed)
        metadata["rays_file"] = {"file": path.name, "sha256": hash_rays(path), "persons": len(data.persons)}
        if is_dataset(path):
            metadata["rays_file"] |= {"most": options.max_samples, "seed": options.seed, "rays": len(data)}
            reporter.message(f"{len(data):,} rays of {path}")
    views = []
    if options.views is not None and options.salience is not None:
        saliency, similarity = _open_views(options, options.views, options.salience)
        views = saliency.views
        metadata |= {"salience": saliency.provenance, **similarity}
        _report_views(saliency, reporter)
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
        metadata["test"] = test
        reporter.message(
            f"{len(test['centres'])} test positions held out, {test['rays_to_train']:,} of {test['rays']:,} rays "
            "remain for training"
        )
        centres = np.array(test["centres"]) @ align.matrix[:3, :3].T + align.matrix[:3, 3]
        views = select_far_views(views, centres, 2 * probes.radius * align.scale)
    return Supervision(data, tuple(views)), metadata


def _read_alignment(path: Path, force: bool, reporter: Reporter) -> Similarity:
    """Read an alignment. Raises `NergError` for one that its evidence did not determine, unless ``force`` is set."""

    def reject(reason: str) -> None:
        if not force:
            raise NergError(f"{reason} (or add {parameter('force', True)} to train anyway)")
        reporter.warn(reason)

    return read_similarity(path, parameter("align"), "rays to field", reject)


def _open_views(options: GazeOptions, photos: Path, salience: str) -> tuple[SalienceSet, dict]:
    """Return saliency views in the frame of the scene, and the provenance of their alignment (JSON)."""
    matrix = None
    if options.align_views is not None:
        matrix = read_similarity(options.align_views, parameter("align_views"), "photos to field").matrix
    trained = None
    if options.field is not None:
        trained = read_checkpoint(options.field, "radiance")[1].get("provenance")
    saliency = open_salience(photos, salience, options.salience_unit, matrix, trained, options.allow_outside)
    return saliency, {} if matrix is None else {"align_views": matrix.tolist()}


def _report_views(saliency: SalienceSet, reporter: Reporter) -> None:
    for line in saliency.notes:
        reporter.message(line)
    without = f"; without saliency map: {', '.join(saliency.frames_without_map)}" if saliency.frames_without_map else ""
    stray = (
        f"; saliency maps without a photo: {', '.join(saliency.unmatched_files)}" if saliency.unmatched_files else ""
    )
    reporter.message(f"{len(saliency.views)} views with saliency maps{without}{stray}")


def _progress(now: GazeProgress) -> str:
    scores = "" if now.scores is None else f", validation KLD {now.scores.kld:.3f}, CC {now.scores.cc:.3f}"
    return f"{now.stage}: step {now.steps}{scores}" if now.steps else now.stage


def _report_result(result: GazeResult, reporter: Reporter) -> None:
    provenance = result.provenance
    views = provenance["salience_views"]
    counts = f"{provenance['probes_made'] - views} probes" + (f" and {views} views" if views else "")
    reporter.message(
        f"{counts}; {100 * provenance['escaped_directions']:.2f} % of the directions and "
        f"{100 * provenance['escaped_gaze']:.2f} % of the gaze hit no surface"
    )
    if "validation" in provenance:
        v = provenance["validation"]
        reporter.message(
            f"validation: KLD {v['kld']:.3f}, CC {v['cc']:.3f}, MAE {v['mae']:.4f} /sr, integral "
            f"{v['integral']:.3f}, best after {v['best_step']} steps"
        )
    reporter.message(
        f"{provenance['steps']} steps; {provenance['seconds']:.0f} s in total, {provenance['seconds_preparing']:.0f} s "
        f"for the probes{'; interrupted' if result.interrupted else ''}"
    )
    if "mix" in provenance:
        m = provenance["mix"]
        if m["variant"]:
            bits = ", ".join(f"{gain:.3f} of {name}" for name, gain in m["variants"].items())
            reporter.message(f"bits per held-out sample {bits}: the variant {m['variant']} is trained")
        if m["folds"]:
            folds = f"{m['folds']} fold{'' if m['folds'] == 1 else 's'}"
            reporter.message(
                f"cross-validation ({folds}): {m['bits_field']:+.3f} bits per sample of the field above the "
                f"position-independent prior, {m['bits']:+.3f} with {_describe_weights(m)}"
            )
            reporter.message(
                f"regions with {100 * m['regions']['80%']:.0f} % of the field's gaze contain 80 % of the held-out gaze"
            )
        else:
            reporter.message(
                "too few rays for cross-validation over participants: whether position predicts the gaze of "
                "others is unknown"
            )
        if m["mix"] >= _DOMINANT_PRIOR:
            kind = "only" if m["mix"] == 1 else "mostly"
            reporter.warn(
                f"position hardly predicts the gaze of other participants: the gaze field is {kind} the "
                "position-independent prior; record more participants, or provide the geometry of the scene"
            )
    if result.output is not None:
        reporter.message(f"wrote {result.output} ({result.output.stat().st_size / 1e6:.2f} MB)")


def _describe_weights(selection: dict) -> str:
    """Describe the weights of a mixture that cross-validation has selected."""
    prior = f"a weight of {100 * selection['mix']:.0f} % of the prior"
    if not selection["hits_weight"]:
        return prior
    return (
        f"{prior} and {100 * selection['hits_weight']:.0f} % of the re-aimed hits of observers nearby "
        f"(bandwidth {selection['hits_bandwidth']:g} m, kappa {selection['hits_kappa']:g})"
    )
