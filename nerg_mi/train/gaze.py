"""Training of a gaze field on recordings, saliency maps or both."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from nerg_mi.alignment.check import check_alignment
from nerg_mi.environment.environment import Environment, make_hit_geometry, no_geometry
from nerg_mi.environment.gaze import GazeField
from nerg_mi.environment.scene import AnyEnvironment
from nerg_mi.environment.scene_loading import get_array_module
from nerg_mi.errors import NergError, blame_options, parameter
from nerg_mi.files.atomic import check_writable, reserve_output
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.formats.alignments import AnySimilarity, open_similarity
from nerg_mi.formats.fields import save_gaze
from nerg_mi.interruption import TrainingInterrupted
from nerg_mi.maths.geometry import Similarity
from nerg_mi.maths.transforms import transform_points
from nerg_mi.photos.salience import SalienceView, open_salience
from nerg_mi.progress import SILENT, Progress, Reporter, open_reporter
from nerg_mi.ranges import (
    DIRECTIONS,
    LENGTHS,
    MINUTES,
    RAYS,
    SECONDS,
    SEEDS,
    STEPS,
    TEST_FRACTIONS,
    Range,
    check_ranges,
)
from nerg_mi.tracking.dataset import hash_rays, is_dataset, open_rays
from nerg_mi.tracking.rays import Rays

from .gaze_data import Supervision, TargetRequirements
from .gaze_ensemble import train_ensemble
from .gaze_folds import hold_out, select_far_views, selects_prior_weight
from .gaze_recipes import GazePlan, Recipe, get_recipe
from .gaze_run import StateSettings, fit_gaze
from .gaze_trainer import GazeProgress
from .prior import check_prior_kappa

_MIN_TRAIN_FRACTION = 0.5  # Fraction of the rays that the fields of the folds should be trained on
_DOMINANT_PRIOR = 0.5  # Weight from which the prior dominates the field
WORDS = ("hits", "none")
"""Environments that are named by a word: the hit points of the rays, and no geometry."""


@check_ranges
def train_gaze(
    rays: Rays | FilePath | None = None,
    environment: AnyEnvironment | FilePath = None,
    *,
    recipe: str | Recipe = "default",
    variant: Literal["emit", "capture", "emit_capture"] | None = None,
    steps: Annotated[int, STEPS] | None = None,
    minutes: Annotated[float, MINUTES] | None = None,
    seed: Annotated[int, SEEDS] = 0,
    ensemble: Annotated[int, Range(0, 1000)] = 0,
    radius: Annotated[float, LENGTHS] | None = None,
    probes: Annotated[int, Range(1, 10**6)] | None = None,
    min_rays: Annotated[int, Range(1, 10**6)] | None = None,
    directions: Annotated[int, DIRECTIONS] | None = None,
    validation_zones: Annotated[int, Range(0, 1000)] | None = None,
    prior_folds: Annotated[int, Range(0, 1000)] | None = None,
    reaimed_hits: bool | None = None,
    test_zones: Annotated[int, Range(0, 1000)] = 0,
    test_positions: Annotated[int, Range(1, 10**5)] = 64,
    test_participants: Annotated[float, TEST_FRACTIONS] = 0.0,
    views: FilePath | None = None,
    salience: FilePath | None = None,
    salience_unit: Literal["pixel", "steradian"] = "pixel",
    align_views: AnySimilarity | FilePath | None = None,
    allow_outside: bool = False,
    align: AnySimilarity | FilePath | None = None,
    force: bool = False,
    voxel_size: Annotated[float, LENGTHS] | None = None,
    max_samples: Annotated[int, RAYS] = 10_000_000,
    half: bool = False,
    save_every: Annotated[float, SECONDS] = 60.0,
    resume: bool = False,
    output: FilePath | None = None,
    progress: Progress = None,
) -> GazeField:
    """Train a gaze field on gaze rays, on saliency maps of posed photos, or on both.

    Lengths are in metres, in the frame of the rays. Settings that are not given follow from the recipe.

    Parameters
    ----------
    rays : Rays or path, optional
        Rays file (.npz or .parquet) or dataset (.rays), as nerg rays import writes it. Not needed with ``views``.
    environment : object or path
        What the participants saw: a radiance field (.safetensors), Gaussian splats, a Mitsuba scene (.xml) or a mesh
        (.ply, .obj, .glb). Without a model of the environment: "hits" builds a volume from the hit points of the rays,
        "none" uses no geometry.
    recipe : str or Recipe
        Training recipe: default (log-density with a prior; generalises best), small (emit and capture networks of small
        size) or paper (networks and losses of the NeRG paper).
    variant : str, optional
        Factors of the gaze field: emit, capture or emit_capture. Default: emit_capture; without geometry,
        cross-validation chooses emit_capture or capture.
    steps : int, optional
        Number of training steps.
    minutes : float, optional
        Training time in minutes, in place of ``steps``; includes the second fit.
    seed : int
        Seed of probes, directions, initial weights, batches and splits.
    ensemble : int
        Number of ensemble members, each trained on a bootstrap resample of the participants and images; their mean is
        the gaze, their spread its uncertainty. 0 trains a single field.
    radius : float, optional
        Radius R of a probe in metres.
    probes : int, optional
        Maximum number of probes.
    min_rays : int, optional
        Minimum number of rays in a probe.
    directions : int, optional
        Number of directions of a probe at which its density is evaluated.
    validation_zones : int, optional
        Number of position zones held out for validation (early stopping); 0 disables it.
    prior_folds : int, optional
        Only for the recipe named default: number of cross-validation folds over participants and positions that choose
        the weight of the position-independent prior; 0: no folds, the weight is 0.05.
    reaimed_hits : bool, optional
        Only for the recipe named default: mix a kernel density of the samples' hit points, seen from the observer, into
        the field, with a weight chosen by ``prior_folds``. The file then contains up to 32,768 samples without names
        and times.
    test_zones : int
        Number of zones whose positions are held out for testing; 0 holds out none.
    test_positions : int
        Maximum number of test positions, in all held-out zones together.
    test_participants : float
        Fraction of the participants that are held out for testing, in addition to the positions of ``test_zones``.
    views : path, optional
        Posed photos (folder or transforms file) that ``salience`` has saliency maps for. With them, the rays may be
        left out.
    salience : path, optional
        Folder of saliency maps, one for each photo of ``views`` and with its name (.png, .exr, .npy); or
        spectral-residual to compute them.
    salience_unit : str
        What the saliency maps are densities over: pixel or steradian.
    align_views : Alignment, similarity or path, optional
        JSON file with the 4x4 similarity from the frame of the photos of ``views`` to that of the scene. Default:
        identity.
    allow_outside : bool
        Also read files outside the folders of ``views`` and ``salience`` if these refer to them.
    align : Alignment, similarity or path, optional
        JSON file with the 4x4 similarity from the frame of the rays to that of the scene, as nerg align writes it.
        Default: identity.
    force : bool
        Train even if no gaze ray hits a surface of the scene, a sign of a wrong alignment, or if the alignment is
        undetermined.
    voxel_size : float, optional
        Edge length of the voxels of hit points in metres. Default: 0.08, more in very large scenes.
    max_samples : int
        Maximum number of samples read from a dataset; larger datasets are subsampled uniformly with ``seed``.
    half : bool
        Store the weights in half precision (fp16).
    save_every : float
        Interval in seconds between two saved states for ``resume``; 0 saves only when training is interrupted.
    resume : bool
        Resume the interrupted training of this output file.
    output : path, optional
        Gaze field to write (.safetensors). Next to it are stored an environment that has no file and, until training is
        complete, a state (.run) to resume from.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    GazeField
        The gaze field. Its ``provenance`` contains the scores on validation positions, which chose the number of steps,
        and of cross-validation, whose samples chose the weights; samples that choose nothing are those of
        ``test_zones`` (`evaluate_gaze`). Its method ``density`` returns densities of rays.

    Raises
    ------
    NergError
        An argument is invalid, which is found before any time is spent where possible.
    KeyboardInterrupt
        Ctrl-C was pressed. After the first step of the fit of a single field, and until the end of its folds, it is a
        `TrainingInterrupted`: an ``output`` has been written, and its attribute ``field`` is the field so far.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> gaze = nerg.train_gaze(rays, "none", steps=2, validation_zones=0, probes=8, directions=64)
    >>> gaze.kind, gaze.provenance["steps"]
    ('gaze', 2)
    """
    chosen = get_recipe(recipe) if rays is not None else get_recipe(recipe).without_rays()
    chosen = chosen.override(
        steps=steps,
        minutes=minutes,
        seed=seed,
        radius=radius,
        probes=probes,
        min_rays=min_rays,
        directions=directions,
        validation_zones=validation_zones,
        prior_folds=prior_folds,
        reaimed_hits=reaimed_hits,
    )
    word = find_word(environment)
    keywords = {"test_zones": test_zones, "align": align is not None, "environment": word == "hits"}
    keywords |= {"prior_folds": prior_folds, "reaimed_hits": reaimed_hits}
    needs_rays = {parameter(name): is_set for name, is_set in keywords.items()}
    needs_rays["the option semantic of the recipe"] = chosen.options.semantic
    needs_rays["the prior_kappa of the recipe"] = chosen.probes.prior_kappa is not None
    _check_data(rays is None, (views, salience, align_views), [name for name, is_set in needs_rays.items() if is_set])
    if test_participants and not test_zones:
        raise NergError(f"{parameter('test_participants')} needs test positions: add {parameter('test_zones')}")
    if word and align is not None:
        raise NergError(
            f"{parameter('align')} applies to a model of the environment; hit points are in the frame of the rays"
        )
    check_recipe(chosen, word or "field", variant or "")
    path = None if output is None else to_path(output)
    with open_reporter(progress) as reporter, reserve_output(path):
        state = _make_state(path, resume and not ensemble, resume, save_every)
        to_scene = _open_alignment(align, force, reporter)
        opened = None if word else Environment.open(environment)
        if opened is not None:
            for note in opened.notes:
                reporter.message(f"{opened.path or 'environment'}: {note}")
        data, metadata = _read_rays(rays, max_samples, seed, reporter)
        metadata = {"recipe": chosen.name, **metadata}
        saliency: tuple[SalienceView, ...] = ()
        if views is not None and salience is not None:
            trained = None if opened is None or opened.radiance is None else opened.radiance.provenance
            saliency, recorded = _open_views(
                views, salience, salience_unit, align_views, trained, allow_outside, reporter
            )
            metadata |= recorded
        if test_zones and data is not None:
            data, metadata["test"] = hold_out(
                data,
                chosen.probes.radius,
                zones=test_zones,
                positions=test_positions,
                seed=seed,
                min_rays=max(64, chosen.probes.min_rays),
                participant_fraction=test_participants,
            )
            saliency = _leave_out_views(saliency, metadata["test"], 2 * chosen.probes.radius, to_scene, reporter)
        supervision = Supervision(data, saliency)
        if opened is None:
            opened = _make_environment(word, supervision, voxel_size, reporter)
        opened = replace(opened, align=to_scene)
        check_environment(opened, data, force, reporter)
        if path is not None and opened.source is not None:
            opened = opened.save_beside(path)
            reporter.message(f"wrote {opened.path}")
        metadata |= opened.metadata
        reporter.progress(0.0, "placing probes and tracing their depths")
        plan = chosen.make_plan(opened, variant or "")
        _announce_variant(opened, variant, plan, data, reporter)
        if plan.initial_arrays and opened.path is not None:
            metadata["begins_as"] = opened.path.name
        state = replace(state, identity=dict(metadata))
        write = (lambda field, provenance: save_gaze(field, path, metadata | provenance, half)) if path else None
        fit = partial(train_ensemble, ensemble) if ensemble else fit_gaze
        on_progress = lambda now: reporter.progress(now.fraction, _describe_progress(now))
        network, provenance = fit(
            supervision, opened, plan, get_array_module(), state=state, on_progress=on_progress, write=write
        )
        field = GazeField(
            network, metadata | provenance, "in memory" if path is None else path.name, path, opened, half=half
        )
        _report_result(field, reporter)
    if provenance["interrupted"]:
        raise TrainingInterrupted(field, dict(field.provenance), state.path)
    return field


# ---- Checks before any time is spent ----


def find_word(environment: AnyEnvironment) -> str:
    """Return an environment that is one of `WORDS`, else "". Raises `NergError` if there is none."""
    if environment is None:
        raise NergError(
            f"give what the participants saw, in memory or as a file, with {parameter('environment')}; or "
            f"{parameter('environment', 'hits')} for the hit points of the rays, or {parameter('environment', 'none')}"
        )
    word = str(environment) if isinstance(environment, (str, os.PathLike)) else ""
    return word if word in WORDS else ""


def check_recipe(recipe: Recipe, kind: str, variant: str = "") -> None:
    """Raise `NergError` if a recipe does not support its own settings, or this kind of environment."""
    recipe.check()
    options = recipe.options
    names = ("semantic", "init_from_field") if options.semantic or options.init_from_field else ("activation",)
    with blame_options(f"{parameter('variant')} and the options {' and '.join(names)} of the recipe"):
        config = recipe.list_architectures(kind, variant)[0]
    if rows := TargetRequirements.from_config(config).prior_rows:
        check_prior_kappa(rows, recipe.probes.prior_kappa)


def _check_data(views_only: bool, of_views: tuple[object, object, object], needs_rays: list[str]) -> None:
    """Raise `NergError` if there is nothing to train on, or a parameter lacks the data that it applies to.

    ``needs_rays`` mentions what was given and applies to rays.
    """
    views, salience, align_views = of_views
    if views_only and views is None:
        raise NergError(
            f"there is no training data: give a rays file, or {parameter('views')} with {parameter('salience')}, "
            "or both"
        )
    if views_only and needs_rays:
        raise NergError(
            f"{', '.join(needs_rays)} need rays; give a rays file in addition to {parameter('views')} "
            f"(to hold out views, remove their images from the folder; to align views, use {parameter('align_views')})"
        )
    if (views is None or salience is None) and not (views is salience is align_views is None):
        raise NergError(
            f"{parameter('views')} (posed photos) and {parameter('salience')} (saliency maps, or spectral-residual) "
            "must be given together"
        )


def _make_state(path: Path | None, needs_state: bool, resume: bool, save_every: float) -> StateSettings:
    """Return where the state of a training is stored. Raises `NergError` for files that are missing or not writable."""
    if path is None:
        if resume:
            raise NergError(f"{parameter('resume', True)} needs the output file of the gaze field: give one")
        return StateSettings()
    state = path.with_suffix(".run")
    check_writable(path, ".safetensors")
    check_writable(state)
    if needs_state and not state.is_file():
        raise NergError(
            f'there is no state to resume: "{state}" does not exist; leave out {parameter("resume", True)} to start'
        )
    return StateSettings(path=state, resume=resume, interval=save_every or float("inf"))


# ---- Data and environment ----


def _open_alignment(align: AnySimilarity | FilePath | None, force: bool, reporter: Reporter) -> Similarity:
    """Open an alignment. Raises `NergError` for one that its evidence did not determine, unless ``force`` is set."""

    def reject(reason: str) -> None:
        if not force:
            raise NergError(f"{reason} (or add {parameter('force', True)} to train anyway)")
        reporter.warn(reason)

    return Similarity() if align is None else open_similarity(align, "rays to field", reject)


def _read_rays(
    rays: Rays | FilePath | None, max_samples: int, seed: int, reporter: Reporter
) -> tuple[Rays | None, dict]:
    """Return the rays, and the record of their file (JSON)."""
    if rays is None or isinstance(rays, Rays):
        return rays, {}
    reporter.progress(0.0, "reading rays")
    data = open_rays(rays, max_samples, seed)
    path = to_path(rays)
    record = {"file": path.name, "sha256": hash_rays(path), "persons": len(data.persons)}
    if is_dataset(path):
        record |= {"most": max_samples, "seed": seed, "rays": len(data)}
        reporter.message(f"{len(data):,} rays of {path}")
    return data, {"rays_file": record}


def _open_views(
    photos: FilePath,
    salience: FilePath,
    unit: str,
    align: AnySimilarity | FilePath | None,
    trained: Mapping[str, Any] | None,
    allow_outside: bool,
    reporter: Reporter,
) -> tuple[tuple[SalienceView, ...], dict]:
    """Return the views with saliency maps in the frame of the scene, and their record (JSON)."""
    matrix = None
    if align is not None:
        matrix = open_similarity(align, "photos to field", name="align_views").matrix
    maps = open_salience(to_path(photos), str(salience), unit, matrix, trained, allow_outside)
    for line in maps.notes:
        reporter.message(line)
    without = f"; without saliency map: {', '.join(maps.frames_without_map)}" if maps.frames_without_map else ""
    stray = f"; saliency maps without a photo: {', '.join(maps.unmatched_files)}" if maps.unmatched_files else ""
    reporter.message(f"{len(maps.views)} views with saliency maps{without}{stray}")
    aligned = {} if matrix is None else {"align_views": matrix.tolist()}
    return tuple(maps.views), {"salience": maps.provenance, **aligned}


def _leave_out_views(
    views: tuple[SalienceView, ...], test: dict, distance: float, to_scene: Similarity, reporter: Reporter
) -> tuple[SalienceView, ...]:
    """Report what is held out, the record ``test``, and return the views farther than ``distance`` from it."""
    participants = len(test["people"])
    reporter.message(
        f"{len(test['centres'])} test positions and {participants} participant{'' if participants == 1 else 's'} held "
        f"out, {test['rays_to_train']:,} of {test['rays']:,} rays remain for training"
    )
    centres = transform_points(to_scene.matrix, np.array(test["centres"]))
    return tuple(select_far_views(views, centres, distance * to_scene.scale))


def _make_environment(word: str, supervision: Supervision, voxel: float | None, reporter: Reporter) -> Environment:
    """Make the environment "hits" of the rays, or "none"."""
    rays = supervision.rays
    if word == "none":
        origins = [v.camera.center[None] for v in supervision.views] + ([] if rays is None else [rays.origin])
        return no_geometry(np.concatenate(origins))
    assert rays is not None  # as checked before
    environment = make_hit_geometry(rays, voxel)
    made = environment.metadata["geometry_file"]
    reporter.message(
        f"hit points: {' x '.join(map(str, made['shape']))} voxels of {made['voxel']:.3g} m, "
        f"{100 * made['solid']:.1f} % solid"
    )
    if made["beyond"]:
        reporter.message(
            f"{100 * made['beyond']:.1f} % of the hit points are outside this box: each was moved along its ray to "
            "the boundary, nearer than recorded"
        )
    return environment


def check_environment(environment: Environment, rays: Rays | None, force: bool, reporter: Reporter = SILENT) -> None:
    """Warn if ``rays`` do not fit the environment: gaze without hits, or heads inside objects.

    Raises `NergError` if (nearly) no gaze hits a surface, unless ``force`` is set. Hit points always fit, and without
    geometry there are no hits.
    """
    if rays is None or environment.medium is None or environment.kind == "hits":
        return
    check = check_alignment(environment.medium, rays, environment.align)
    remedy = f"estimate the alignment with nerg align, and give it as {parameter('align')}"
    if check.is_impossible and not force:
        raise NergError(
            f"{100 * check.escaped:.1f} % of the gaze hits no surface, so the rays are not aligned with the scene; "
            f"{remedy} (or add {parameter('force', True)} to continue anyway)"
        )
    doubts = check.list_warnings()
    if doubts:
        reporter.warn(f"the rays may not be aligned with the scene: {', '.join(doubts)}; {remedy}")


# ---- Messages ----


def _announce_variant(
    environment: Environment, variant: str | None, plan: GazePlan, rays: Rays | None, reporter: Reporter
) -> None:
    """Tell how the variant is chosen without geometry."""
    if environment.has_surfaces or variant is not None:
        return
    is_chosen = plan.alternatives and selects_prior_weight(plan, rays)
    how = (
        "cross-validation chooses between capture alone and emit x capture"
        if is_chosen
        else f"the variant {plan.config.variant} is trained"
    )
    reporter.message(f"there is no geometry: {how}")


def _describe_progress(now: GazeProgress) -> str:
    scores = "" if now.scores is None else f", validation KLD {now.scores.kld:.3f}, CC {now.scores.cc:.3f}"
    return f"{now.stage}: step {now.steps}{scores}" if now.steps else now.stage


def _report_result(field: GazeField, reporter: Reporter) -> None:
    provenance = field.provenance
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
            f"{v['integral']:.3f}, at positions that chose the number of steps ({v['best_step']})"
        )
    reporter.message(
        f"{provenance['steps']} steps; {provenance['seconds']:.0f} s in total, {provenance['seconds_preparing']:.0f} s "
        f"for the probes{'; interrupted' if provenance['interrupted'] else ''}"
    )
    if "mix" in provenance:
        m = provenance["mix"]
        if m["variant"]:
            bits = ", ".join(f"{gain:.3f} of {name}" for name, gain in m["variants"].items())
            reporter.message(
                f"bits per held-out sample {bits}: these samples chose the variant {m['variant']} and the weights"
            )
        if m["folds"]:
            folds = f"{m['folds']} fold{'' if m['folds'] == 1 else 's'}"
            reporter.message(
                f"cross-validation ({folds}): {m['bits_field']:+.3f} bits per sample of the field above the "
                f"position-independent prior, {m['bits']:+.3f} with {_describe_weights(m)}, which these samples chose"
                + ("" if m["bits_crossed"] is None else f"; {m['bits_crossed']:+.3f} with weights from other folds")
            )
            if m["train_fraction"] < _MIN_TRAIN_FRACTION:
                reporter.warn(
                    f"the fields of the folds were trained on only {100 * m['train_fraction']:.0f} % of the rays, so "
                    "that they are worse than this one, whose weight is too small; record more participants"
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
                "position-independent prior; record more participants, or provide a model of the environment"
            )
    if field.path is not None:
        reporter.message(f"wrote {field.path} ({field.path.stat().st_size / 1e6:.2f} MB)")


def _describe_weights(selection: dict) -> str:
    """Describe the weights of a mixture that cross-validation has selected."""
    prior = f"a weight of {100 * selection['mix']:.0f} % of the prior"
    if not selection["hits"]:
        return prior
    total = sum(weight for weight, *_ in selection["hits"])
    kernels = ", ".join(
        f"{100 * weight:.0f} % of {width:g} m and {kappa:g}" for weight, width, kappa in selection["hits"]
    )
    return f"{prior} and {100 * total:.0f} % of the re-aimed hits (bandwidths and kappas: {kernels})"
