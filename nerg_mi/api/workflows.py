"""Workflows as calls: training, evaluation, alignment, import of tracking, statistics and bakes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerg_mi.aoi.options import StatisticsOptions
from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows.base import SILENT, Reporter
from nerg_mi.workflows.gaze_commands import AblationOptions, GazeEvaluationOptions, GazeOptions, PriorOptions
from nerg_mi.workflows.radiance_commands import RadianceOptions, RadianceScoreOptions
from nerg_mi.workflows.rays_commands import AlignOptions, RaysImportOptions
from nerg_mi.workflows.scene_commands import BakeOptions, StudyOptions

from .scene import FilePath, TrainedField, check_names, resolve_checkpoint, resolve_file, build_options, resolve_rays

if TYPE_CHECKING:
    from nerg_mi.alignment.check import Alignment
    from nerg_mi.aoi.output import StatisticsResult
    from nerg_mi.evaluation.metrics import ViewScores
    from nerg_mi.fields.gaze_base import AnyGazeField
    from nerg_mi.fields.radiance import RadianceField
    from nerg_mi.workflows.ablation import AblationResult
    from nerg_mi.workflows.bake import Bake
    from nerg_mi.workflows.bake_splats import SplatBake
    from nerg_mi.workflows.evaluate import GazeEvaluation
    from nerg_mi.workflows.study import StudyResult


# ---- How tracking lies in a place ----


def align(
    rays: Rays | FilePath | None = None,
    output: FilePath | None = None,
    *,
    options: AlignOptions | None = None,
    reporter: Reporter = SILENT,
    **changes: Any,
) -> Alignment:
    """Find the similarity from the frame of ``rays`` (z up, metres) to that of a place.

    ``rays``: what `load_rays` or `import_rays` gave, or a file of them; not needed where other evidence is given.
    ``output``: alignment to write besides (.json), which ``align=`` of `train_gaze` takes, with a picture beside it.
    ``changes``: options one by one on top of ``options``: the place (``field=``, ``scene=``, ``surface=``), evidence
    (``pairs=``, ``twin=``, ``cameras=`` with ``place_cameras=``; none of them: the tracking alone), and what is known
    (``up=``, ``scale=``, ...); `nerg_mi.workflows.rays_commands.AlignOptions` says what there is. Raises `NergError`
    for evidence that leaves it open, for a mirrored frame and for a bad fit.

    >>> import nerg_mi as nerg
    >>> rows = "0,0,0,1,0,0\\n2,0,0,5,0,0\\n0,1,0,1,2,0\\n0,0,1,1,0,2\\n"
    >>> _ = (folder / "pairs.csv").write_text("x,y,z,place_x,place_y,place_z\\n" + rows)
    >>> found = nerg.align(pairs=folder / "pairs.csv")
    >>> (found.matrix.round(6) + 0.0)[0].tolist()
    [2.0, 0.0, 0.0, 1.0]
    """
    from nerg_mi.workflows import align as alignment

    job = build_options(AlignOptions, "align", options, changes)
    return alignment.align(None if rays is None else resolve_rays(rays), output, job, reporter).alignment


# ---- Gaze on surfaces, for notebooks ----


def bake(
    surface: FilePath,
    outputs: FilePath | Sequence[FilePath] = (),
    *,
    rays: Rays | FilePath | None = None,
    options: BakeOptions | None = None,
    reporter: Reporter = SILENT,
    **changes: Any,
) -> Bake | SplatBake:
    """How much gaze each square metre of ``surface`` receives: a mesh file, a scene file, a radiance field's surface,
    or a file of Gaussian splats.

    ``rays``: what `load_rays` gave, or a file of them; the people whose places a gaze field is asked for, or whose gaze
    it is. ``outputs``: files to write (.ply, .glb, .csv, .json). ``changes``: options one by one
    (``gaze="gaze.safetensors"``, ``observer=(4.4, 2.8, 1.6)``, ``smooth=0.05``, ...) on top of ``options``;
    `nerg_mi.workflows.scene_commands.BakeOptions` says what there is. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> baked = nerg.bake(store / "twin.ply", gaze=store / "shoppers.safetensors", observer=(4.4, 2.8, 1.6), detail=1.0)
    >>> 0.9 < baked.on_surface < 1, abs(baked.unaccounted) < 0.01
    (True, True)
    """
    from nerg_mi.rays.rays import Rays
    from nerg_mi.workflows import bake as baking

    in_memory = rays if isinstance(rays, Rays) else None
    if rays is not None and in_memory is None:
        changes = {**changes, "rays": rays}
    job = build_options(BakeOptions, "bake", options, changes)
    files = [outputs] if isinstance(outputs, (str, Path)) or not isinstance(outputs, Sequence) else list(outputs)
    return baking.bake_any(resolve_file(surface, "surface"), [Path(str(f)) for f in files], job, reporter, in_memory)


# ---- Scores of fields, and what settings cost ----


def evaluate_radiance(
    field: FilePath | TrainedField[RadianceField],
    photos: FilePath,
    *,
    options: RadianceScoreOptions | None = None,
    reporter: Reporter = SILENT,
    **changes: Any,
) -> ViewScores:
    """Score a radiance field on posed photos: PSNR, SSIM and, where their depth is known, its error.

    ``field``: a checkpoint, or a field in memory. ``photos``: as for `train_radiance`; those that were held out are
    scored. ``changes``: options one by one (``spp=16``, ``pictures="folder"``, ...) on top of ``options``;
    `nerg_mi.workflows.radiance_commands.RadianceScoreOptions` says what there is. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scores = nerg.evaluate_radiance(store / "store.safetensors", photos, width=24, train=True)
    >>> len(scores.psnr) == len(scores.views), scores.psnr_mean > 20  # of a folder of posed photos
    (True, True)
    """
    from nerg_mi.workflows import train_radiance

    job = build_options(RadianceScoreOptions, "evaluate_radiance", options, changes)
    with resolve_checkpoint(field, "field") as path:
        return train_radiance.evaluate_radiance(path, resolve_file(photos, "photos"), job, reporter)


def evaluate_gaze(
    gaze: FilePath | TrainedField[AnyGazeField],
    rays: Rays | FilePath,
    output: FilePath | None = None,
    *,
    options: GazeEvaluationOptions | None = None,
    reporter: Reporter = SILENT,
    **changes: Any,
) -> GazeEvaluation:
    """Score a gaze field at positions and of people that it was not trained on, beside what needs no field.

    ``gaze``: a checkpoint that was trained with ``test_zones``, or what that training gave. ``rays``: those that it
    was trained on, or their file. ``output``: folder for tables and pictures, which is made. ``changes``: options
    one by one (``split="pos"``, ``resamples=200``, ...) on top of ``options``;
    `nerg_mi.workflows.gaze_commands.GazeEvaluationOptions` says what there is. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> held_out = {"test_zones": 1, "test_positions": 4, "geometry": "none", "zones": 0}
    >>> small = {"steps": 2, "probes": 8, "directions": 64}
    >>> gaze = nerg.train_gaze(rays, **held_out, **small)
    >>> scores = nerg.evaluate_gaze(gaze, rays, directions=64, resamples=2, min_rays=8)
    >>> scores.rows[0]["method"], scores.split
    ('gaze field', 'pos')
    """
    from nerg_mi.workflows import evaluate

    job = build_options(GazeEvaluationOptions, "evaluate_gaze", options, changes)
    data = resolve_rays(rays)
    with resolve_checkpoint(gaze, "gaze") as path:
        return evaluate.evaluate_gaze(path, data, output, job, reporter)


def ablate(
    rays: Rays | FilePath,
    output: FilePath,
    *,
    options: AblationOptions | None = None,
    reporter: Reporter = SILENT,
    **changes: Any,
) -> AblationResult:
    """Train every variant of a gaze field alike, and compare their scores and the time of a frame.

    ``rays``: what `load_rays` or `import_rays` gave, or a file of them. ``output``: folder for checkpoints, table and
    plot, which is made; what an earlier run has left there is not trained again. Where people looked around is said as
    for `train_gaze`. ``changes``: options one by one (``recipes="small"``, ``seeds=1``, ...) on top of ``options``;
    `nerg_mi.workflows.gaze_commands.AblationOptions` says what there is. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> small = {"recipes": "default", "variant": ("emit",), "seeds": 1, "default_steps": 2, "probes": 8, "cameras": 0}
    >>> test = {"zones": 1, "positions": 4, "min_rays": 8}
    >>> result = nerg.ablate(rays, folder / "ablation", geometry="none", **small, **test)
    >>> [row["variant"] for row in result.rows]
    ['emit']
    """
    from nerg_mi.workflows import ablation

    job = build_options(AblationOptions, "ablate", options, changes)
    return ablation.ablate(resolve_rays(rays), output, job, reporter)


def study(
    scene: FilePath,
    output: FilePath,
    *,
    options: StudyOptions | None = None,
    reporter: Reporter = SILENT,
    **changes: Any,
) -> StudyResult:
    """Measure error against run time: a scene at many settings, each compared with what is true.

    ``scene``: a scene file, or one with a known truth: ``slab``, ``sphere``, ``sheets``, ``fog`` or ``ramp``.
    ``output``: folder for tables and plots, which is made. ``changes``: options one by one (``quick=True``,
    ``only="depth"``, ...) on top of ``options``; `nerg_mi.workflows.scene_commands.StudyOptions` says what there is. A
    full study takes up to half an hour. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> result = nerg.study("slab", folder / "study", quick=True, width=8, height=8)
    >>> result.files[0].name
    'study.csv'
    """
    from nerg_mi.workflows import study as studies

    job = build_options(StudyOptions, "study", options, changes)
    return studies.run_study(str(scene if isinstance(scene, str) else resolve_file(scene, "scene")), output, job, reporter)


# ---- Attention on things as numbers, from a notebook ----


def stats(
    files: str | os.PathLike[str] | Rays | Sequence[str | os.PathLike[str] | Rays],
    areas: str | os.PathLike[str] | None = None,
    *,
    output: str | os.PathLike[str] | None = None,
    reporter: Reporter = SILENT,
    **options: Any,
) -> StatisticsResult:
    """Numbers of attention on areas of interest: counted in rays, and as a gaze field foretells it.

    ``files``: rays (in memory, or their file, or a dataset), a scene, a gaze field, a radiance field, in any order.
    ``areas``: a JSON file of boxes, meshes, shapes and groups (docs/how-to/statistics.md). ``output``: folder for the tables.
    ``options``: those of `nerg stats` (`nerg_mi.aoi.options.StatisticsOptions`). Gives a
    `nerg_mi.aoi.output.StatisticsResult`, whose tables are lists of dicts. Raises `NergError`.

    >>> import json, nerg_mi as nerg
    >>> _ = (folder / "areas.json").write_text(json.dumps({"shelf": [[2, -1, 0], [3, 1, 2]]}))
    >>> eye, ahead = [[0.0, 0.0, 1.6]] * 3, [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    >>> rays = nerg.Rays([0.0, 0.2, 0.4], [0, 0, 0], ("Ada",), origin=eye, direction=ahead, confidence=[1.0] * 3)
    >>> row = nerg.stats(rays, folder / "areas.json").things[0]
    >>> row["thing"], round(row["share"], 3), row["reach"], row["distance"]
    ('shelf', 0.667, 1.0, 2.0)
    """
    from nerg_mi.workflows.statistics import statistics

    given = [files] if isinstance(files, (str, os.PathLike, Rays)) else list(files)
    if areas is not None:
        options["areas"] = areas
    job = build_options(StatisticsOptions, "stats", None, options)
    paths = [f if isinstance(f, Rays) else resolve_file(f, "files") for f in given]
    return statistics(paths, None if output is None else Path(output), job, reporter)


# ---- Tracking files in, rays out ----


def import_rays(
    files: FilePath | Sequence[FilePath],
    reader: str = "table",
    *,
    output: FilePath | None = None,
    reporter: Reporter = SILENT,
    **options: Any,
) -> Rays:
    """Read tracking files as rays of attention: right-handed, z up, metres, seconds.

    ``files``: one or several. ``reader``: the format's name, as for ``nerg rays import --preset``; ``table`` reads any
    CSV or Parquet table through the option ``columns``. ``output``: rays file to write besides (.npz or .parquet), or a
    dataset (.rays), of which large ones are given as a sample (`nerg_mi.workflows.rays.ImportResult`).
    ``options``: those of the reader, and ``skip_bad_lines``, ``pseudonyms`` and ``salt``, of a dataset ``place_name``,
    ``day`` and ``workers`` (`nerg_mi.workflows.rays_commands.RaysImportOptions`). What was dropped, and why, is in the
    rays' ``metadata``. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> _ = (folder / "day.csv").write_text("t,who,x,y,z,dx,dy,dz\\n0.0,Ada,1,1,1.6,1,0,0\\n0.1,Ada,1,1,1.6,0,1,0\\n")
    >>> columns = "origin=x,y,z direction=dx,dy,dz t=t person=who"
    >>> rays = nerg.import_rays(folder / "day.csv", columns=columns)
    >>> len(rays), rays.persons
    (2, ('Ada',))
    """
    from nerg_mi.rays.readers.base import list_options
    from nerg_mi.rays.readers.registry import make_options, get_reader, list_reader_names
    from nerg_mi.workflows import rays

    several = [files] if isinstance(files, (str, os.PathLike)) or not isinstance(files, Sequence) else files
    if not all(isinstance(file, (str, os.PathLike)) for file in several):
        raise NergError(
            f"import_rays reads files, named by strings or paths, got {type(files).__name__}; "
            'write a table to a file (df.to_csv("day.csv")), and name its columns (columns="origin=x,y,z ...")'
        )
    of_readers = list_options(get_reader(reader).Options)
    ours = {f.name for f in fields(RaysImportOptions)} - {"reader", "settings", "output"}
    every = {option.name for name in list_reader_names() for option in list_options(get_reader(name).Options)}
    check_names("import_rays", options, sorted(every | ours))
    paths = [resolve_file(file, "files") for file in several]
    of_job = {name: value for name, value in options.items() if name in ours}
    parse = {option.name: option.parse for option in of_readers}
    of_reader = {name: value for name, value in options.items() if name not in ours}
    for name, value in of_reader.items():
        # Values may be written as for the command.
        if isinstance(value, str) and (read := parse.get(name)) is not None:
            of_reader[name] = read(value)
    job = RaysImportOptions(reader=reader, settings=make_options(reader, of_reader), output=output, **of_job)
    return rays.import_rays(paths, job, reporter).rays


# ---- Trainings: from recordings to fields in memory ----


def train_radiance(
    photos: FilePath,
    output: FilePath | None = None,
    *,
    options: RadianceOptions | None = None,
    reporter: Reporter = SILENT,
    **changes: Any,
) -> TrainedField[RadianceField]:
    """Train a radiance field on posed photos.

    ``photos``: a folder, its transforms.json, or a COLMAP model. ``output``: checkpoint to write besides
    (.safetensors), with a preview and, while the training is not done, a state to resume from. ``changes``: options one
    by one (``minutes=5``, ``size="medium"``, ...) on top of ``options``;
    `nerg_mi.workflows.radiance_commands.RadianceOptions` says what there is. ``reporter`` is told how it goes
    (`nerg_mi.workflows.base`). What comes back has the error on held-out photos in its ``provenance``. After Ctrl-C it
    is the result so far, or ``KeyboardInterrupt`` where there is an ``output``, which is written. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> field = nerg.train_radiance(photos, steps=2, holdout=0)  # a folder of posed photos
    >>> field.kind, field.provenance["steps"]
    ('radiance', 2)
    """
    from nerg_mi.workflows import train_radiance as radiance

    job = build_options(RadianceOptions, "train_radiance", options, changes)
    result = radiance.train_radiance(resolve_file(photos, "photos"), output, job, reporter)
    return _trained(result.field, result.provenance, output)


def train_gaze(
    rays: Rays | FilePath | None,
    output: FilePath | None = None,
    *,
    options: GazeOptions | None = None,
    reporter: Reporter = SILENT,
    **changes: Any,
) -> TrainedField[AnyGazeField]:
    """Train a gaze field on rays of attention, on salience images of posed photos, or on both.

    ``rays``: what `load_rays` or `import_rays` gave, or a file of them; None: salience images alone (``views=``,
    ``salience=``). Where people looked around is said by one of the options ``field="field.safetensors"``,
    ``scene="scene.xml"`` (or a mesh) and ``geometry="hits"`` or ``"none"``. ``changes``: these and other options one by
    one (``minutes=5``, ``recipe="small"``, ``test_zones=3``, ...) on top of ``options``;
    `nerg_mi.workflows.gaze_commands.GazeOptions` says what there is. ``output`` and ``reporter``: as for
    `train_radiance`. What comes back has its scores on held-out positions in its ``provenance``. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> gaze = nerg.train_gaze(rays, geometry="none", steps=2, zones=0, probes=8, directions=64)
    >>> gaze.kind, gaze.provenance["steps"]
    ('gaze', 2)
    """
    from nerg_mi.workflows import train_gaze as gaze

    job = build_options(GazeOptions, "train_gaze", options, changes)
    result = gaze.train_gaze(None if rays is None else resolve_rays(rays), output, job, reporter)
    return _trained(result.field, result.provenance, output)


def train_prior(
    rays: Rays | FilePath | Sequence[Rays | FilePath],
    output: FilePath | None = None,
    *,
    options: PriorOptions | None = None,
    reporter: Reporter = SILENT,
    **changes: Any,
) -> TrainedField[AnyGazeField]:
    """Make a gaze field for a place where nobody was tracked, of how high people look in others.

    ``rays``: those of each other place, in memory or their files; places count alike. ``output``: checkpoint to write
    besides (.safetensors). ``changes``: options one by one (``seed=1``, ...) on top of ``options``;
    `nerg_mi.workflows.gaze_commands.PriorOptions` says what there is. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> prior = nerg.train_prior(rays)  # or a list of them, one a place
    >>> prior.kind, len(prior.provenance["places"])
    ('gaze', 1)
    """
    from nerg_mi.workflows import train_gaze as gaze

    job = build_options(PriorOptions, "train_prior", options, changes)
    several = [rays] if isinstance(rays, (str, os.PathLike, Rays)) else rays
    places = [place if isinstance(place, Rays) else resolve_file(place, "rays") for place in several]
    result = gaze.learn_prior(places, output, job, reporter)
    return _trained(result.field, result.provenance, output)


def _trained(network: Any, provenance: dict[str, Any], output: FilePath | None) -> TrainedField[Any]:
    if output is None:
        return TrainedField(network, provenance)
    return TrainedField(network, provenance, Path(output).name, Path(output))
