"""Workflows as functions: training, evaluation, alignment, import of recordings, statistics and baking."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerg_mi.aoi.options import StatisticsOptions
from nerg_mi.errors import NergError
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows.base import SILENT, Reporter
from nerg_mi.workflows.gaze_commands import (
    AblationOptions,
    GazeEvaluationOptions,
    GazeOptions,
    NextLookOptions,
    PriorOptions,
)
from nerg_mi.workflows.radiance_commands import CompileOptions, RadianceOptions, RadianceScoreOptions
from nerg_mi.workflows.rays_commands import AlignOptions, RaysImportOptions
from nerg_mi.workflows.scene_commands import BakeOptions, StudyOptions

from .gaze import TrainedGazeField
from .scene import (
    FilePath,
    TrainedField,
    build_options,
    check_names,
    load_field,
    resolve_checkpoint,
    resolve_file,
    resolve_rays,
)

if TYPE_CHECKING:
    from nerg_mi.alignment.check import Alignment
    from nerg_mi.aoi.output import StatisticsResult
    from nerg_mi.evaluation.metrics import ViewScores
    from nerg_mi.fields.radiance import RadianceField
    from nerg_mi.workflows.ablation import AblationResult
    from nerg_mi.workflows.bake import Bake
    from nerg_mi.workflows.bake_splats import SplatBake
    from nerg_mi.workflows.evaluate import GazeEvaluation
    from nerg_mi.workflows.next_look import NextLookEvaluation
    from nerg_mi.workflows.study import StudyResult
    from nerg_mi.workflows.train_gaze import GazeResult, PriorResult


# ---- Alignment ----


def align(
    rays: Rays | FilePath | None = None,
    output: FilePath | None = None,
    *,
    options: AlignOptions | None = None,
    reporter: Reporter = SILENT,
    **overrides: Any,
) -> Alignment:
    """Estimate the similarity transform from the frame of recordings to the frame of an environment.

    Parameters
    ----------
    rays : Rays or path, optional
        Recordings (z up, metres). Not needed if other evidence is given.
    output : path, optional
        Alignment file (.json) to write, for the option ``align`` of `train_gaze`, together with a picture.
    options : AlignOptions, optional
        Base options (`nerg_mi.workflows.rays_commands.AlignOptions`).
    reporter : Reporter
        Receives the progress.
    **overrides
        Single options on top of ``options``: the environment (``field``, ``scene``, ``surface``), the evidence
        (``pairs``, ``tracking_surface``, ``tracking_cameras`` with
        ``scene_cameras``; by default the recordings alone), and known parts
        (``up``, ``scale``, ...).

    Returns
    -------
    Alignment
        The transform and its quality.

    Raises
    ------
    NergError
        The evidence is insufficient, the frames are mirrored, or the fit is bad.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> rows = "0,0,0,1,0,0\\n2,0,0,5,0,0\\n0,1,0,1,2,0\\n0,0,1,1,0,2\\n"
    >>> _ = (folder / "pairs.csv").write_text("x,y,z,place_x,place_y,place_z\\n" + rows)
    >>> alignment = nerg.align(pairs=folder / "pairs.csv")
    >>> (alignment.matrix.round(6) + 0.0)[0].tolist()
    [2.0, 0.0, 0.0, 1.0]
    """
    from nerg_mi.workflows import align as alignment

    resolved = build_options(AlignOptions, "align", options, overrides)
    return alignment.align(None if rays is None else resolve_rays(rays), output, resolved, reporter).alignment


# ---- Baking ----


def bake(
    surface: FilePath,
    outputs: FilePath | Sequence[FilePath] = (),
    *,
    rays: Rays | FilePath | None = None,
    options: BakeOptions | None = None,
    reporter: Reporter = SILENT,
    **overrides: Any,
) -> Bake | SplatBake:
    """Compute the attention per area on a surface.

    Parameters
    ----------
    surface : path
        A mesh file, a scene file, a radiance field, or a file of Gaussian splats.
    outputs : path or sequence of path
        Files to write (.ply, .glb, .csv, .json).
    rays : Rays or path, optional
        Recordings. With a gaze field they provide the positions of the observers; otherwise they are the gaze to bake.
    options : BakeOptions, optional
        Base options (`nerg_mi.workflows.scene_commands.BakeOptions`).
    reporter : Reporter
        Receives the progress.
    **overrides
        Single options on top of ``options``, such as ``gaze="gaze.safetensors"``, ``observer=(4.4, 2.8, 1.6)`` or
        ``smooth=0.05``.

    Returns
    -------
    Bake or SplatBake
        Attention per square metre and its sums.

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> gaze = store / "shoppers.safetensors"
    >>> baked = nerg.bake(store / "twin.ply", gaze=gaze, observer=(4.4, 2.8, 1.6), max_edge=1.0)
    >>> 0.9 < baked.on_surface < 1, abs(baked.unaccounted) < 0.01
    (True, True)
    """
    from nerg_mi.rays.rays import Rays
    from nerg_mi.workflows import bake as baking

    in_memory = rays if isinstance(rays, Rays) else None
    if rays is not None and in_memory is None:
        overrides = {**overrides, "rays": rays}
    resolved = build_options(BakeOptions, "bake", options, overrides)
    files = [outputs] if isinstance(outputs, (str, Path)) or not isinstance(outputs, Sequence) else list(outputs)
    return baking.bake_any(
        resolve_file(surface, "surface"), [Path(str(f)) for f in files], resolved, reporter, in_memory
    )


# ---- Evaluation ----


def evaluate_radiance(
    field: FilePath | TrainedField[RadianceField],
    photos: FilePath,
    *,
    options: RadianceScoreOptions | None = None,
    reporter: Reporter = SILENT,
    **overrides: Any,
) -> ViewScores:
    """Evaluate a radiance field on posed photos.

    Parameters
    ----------
    field : TrainedField or path
        The radiance field.
    photos : path
        Posed photos, as for `train_radiance`. By default the held-out photos are used.
    options : RadianceScoreOptions, optional
        Base options (`nerg_mi.workflows.radiance_commands.RadianceScoreOptions`).
    reporter : Reporter
        Receives the progress.
    **overrides
        Single options on top of ``options``, such as ``spp=16`` or ``pictures="folder"``.

    Returns
    -------
    ViewScores
        PSNR, SSIM and, if the photos have depth, the depth error of each photo.

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scores = nerg.evaluate_radiance(store / "store.safetensors", photos, width=24, train=True)
    >>> len(scores.psnr) == len(scores.views), scores.psnr_mean > 20  # photos: a folder of posed photos
    (True, True)
    """
    from nerg_mi.workflows import train_radiance

    resolved = build_options(RadianceScoreOptions, "evaluate_radiance", options, overrides)
    with resolve_checkpoint(field, "field") as path:
        return train_radiance.evaluate_radiance(path, resolve_file(photos, "photos"), resolved, reporter)


def evaluate_gaze(
    gaze: FilePath | TrainedGazeField,
    rays: Rays | FilePath,
    output: FilePath | None = None,
    *,
    options: GazeEvaluationOptions | None = None,
    reporter: Reporter = SILENT,
    **overrides: Any,
) -> GazeEvaluation:
    """Evaluate a gaze field on held-out positions and participants, and compare it with baselines.

    Parameters
    ----------
    gaze : TrainedField or path
        The gaze field, trained with ``test_zones``.
    rays : Rays or path
        The recordings of its training.
    output : path, optional
        Folder for tables and pictures; it is created.
    options : GazeEvaluationOptions, optional
        Base options (`nerg_mi.workflows.gaze_commands.GazeEvaluationOptions`).
    reporter : Reporter
        Receives the progress.
    **overrides
        Single options on top of ``options``, such as ``split="pos"`` or ``resamples=200``.

    Returns
    -------
    GazeEvaluation
        Scores of the field and the baselines.

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> held_out = {"test_zones": 1, "test_positions": 4, "geometry": "none", "validation_zones": 0}
    >>> small = {"steps": 2, "probes": 8, "directions": 64}
    >>> gaze = nerg.train_gaze(rays, **held_out, **small)
    >>> scores = nerg.evaluate_gaze(gaze, rays, directions=64, resamples=2, min_rays=8)
    >>> scores.rows[0]["method"], scores.split
    ('gaze field', 'pos')
    """
    from nerg_mi.workflows import evaluate

    resolved = build_options(GazeEvaluationOptions, "evaluate_gaze", options, overrides)
    data = resolve_rays(rays)
    with resolve_checkpoint(gaze, "gaze") as path:
        return evaluate.evaluate_gaze(path, data, output, resolved, reporter)


def next_look(
    gaze: FilePath | TrainedGazeField,
    rays: Rays | FilePath,
    output: FilePath | None = None,
    *,
    options: NextLookOptions | None = None,
    reporter: Reporter = SILENT,
    **overrides: Any,
) -> NextLookEvaluation:
    """Fit the density of a participant's next look, given the last looks, the elapsed time and a gaze field.

    The weights of the density are fitted to training participants at held-out positions. It is scored on held-out
    participants there, and compared with the last look alone and the field alone.

    Parameters
    ----------
    gaze : TrainedGazeField or path
        The gaze field, trained with ``test_zones`` and ``test_participants``.
    rays : Rays or path
        The recordings of its training.
    output : path, optional
        Folder for tables and weights; it is created.
    options : NextLookOptions, optional
        Base options (`nerg_mi.workflows.gaze_commands.NextLookOptions`).
    reporter : Reporter
        Receives the progress.
    **overrides
        Single options on top of ``options``, such as ``elapsed=(0.5, 1, 2)``, and the geometry as for `evaluate_gaze`.

    Returns
    -------
    NextLookEvaluation
        Scores (``rows``), and the ``model`` (`nerg_mi.evaluation.next_look.NextLook`), whose method ``sample``
        simulates the looks of a participant along a trajectory.

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> held_out = {"test_zones": 1, "test_positions": 4, "test_participants": 0.5}
    >>> small = {"geometry": "none", "validation_zones": 0, "steps": 2, "probes": 8, "directions": 64, "min_rays": 8}
    >>> gaze = nerg.train_gaze(rays, **held_out, **small)
    >>> result = nerg.next_look(gaze, rays, elapsed=(1.0, 4.0), earlier=5, max_looks=32)
    >>> result.rows[0]["method"], result.model.knots.tolist()
    ('next look', [1.0, 4.0])
    >>> walk = [(1.0 + 0.5 * t, 2.0, 1.6) for t in range(4)]
    >>> result.model.sample(range(4), walk, gaze.density).shape
    (4, 3)
    """
    from nerg_mi.workflows import next_look

    resolved = build_options(NextLookOptions, "next_look", options, overrides)
    data = resolve_rays(rays)
    with resolve_checkpoint(gaze, "gaze") as path:
        return next_look.evaluate_next_look(path, data, output, resolved, reporter)


def ablate(
    rays: Rays | FilePath,
    output: FilePath,
    *,
    options: AblationOptions | None = None,
    reporter: Reporter = SILENT,
    **overrides: Any,
) -> AblationResult:
    """Train several variants of a gaze field under equal conditions, and compare their scores and rendering times.

    Parameters
    ----------
    rays : Rays or path
        The recordings.
    output : path
        Folder for checkpoints, table and plot; it is created. Checkpoints of an earlier run are reused.
    options : AblationOptions, optional
        Base options (`nerg_mi.workflows.gaze_commands.AblationOptions`).
    reporter : Reporter
        Receives the progress.
    **overrides
        Single options on top of ``options``, such as ``recipes="small"`` or ``seeds=1``, and the environment as for
        `train_gaze`.

    Returns
    -------
    AblationResult
        One row per variant.

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> small = {"recipes": "default", "variant": ("emit",), "seeds": 1, "default_steps": 2}
    >>> small |= {"probes": 8, "timing_cameras": 0}
    >>> test = {"test_zones": 1, "test_positions": 4, "min_rays": 8}
    >>> result = nerg.ablate(rays, folder / "ablation", geometry="none", **small, **test)
    >>> [row["variant"] for row in result.rows]
    ['emit']
    """
    from nerg_mi.workflows import ablation

    resolved = build_options(AblationOptions, "ablate", options, overrides)
    return ablation.ablate(resolve_rays(rays), output, resolved, reporter)


def study(
    scene: FilePath,
    output: FilePath,
    *,
    options: StudyOptions | None = None,
    reporter: Reporter = SILENT,
    **overrides: Any,
) -> StudyResult:
    """Measure the error of a scene against run time, for many settings.

    A full study takes up to half an hour.

    Parameters
    ----------
    scene : str or path
        A scene file, or an analytic scene with an exact solution: ``slab``, ``sphere``, ``sheets``, ``fog`` or
        ``ramp``.
    output : path
        Folder for tables and plots; it is created.
    options : StudyOptions, optional
        Base options (`nerg_mi.workflows.scene_commands.StudyOptions`).
    reporter : Reporter
        Receives the progress.
    **overrides
        Single options on top of ``options``, such as ``quick=True`` or ``only="depth"``.

    Returns
    -------
    StudyResult
        Errors and run times, and the written files.

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> result = nerg.study("slab", folder / "study", quick=True, width=8, height=8)
    >>> result.files[0].name
    'study.csv'
    """
    from nerg_mi.workflows import study as studies

    resolved = build_options(StudyOptions, "study", options, overrides)
    return studies.run_study(
        str(scene if isinstance(scene, str) else resolve_file(scene, "scene")), output, resolved, reporter
    )


# ---- Attention statistics ----


def stats(
    files: str | os.PathLike[str] | Rays | Sequence[str | os.PathLike[str] | Rays],
    areas: str | os.PathLike[str] | None = None,
    *,
    output: str | os.PathLike[str] | None = None,
    reporter: Reporter = SILENT,
    **options: Any,
) -> StatisticsResult:
    """Compute attention statistics of areas of interest, from recordings and as predicted by a gaze field.

    Parameters
    ----------
    files : Rays, path, or sequence of these
        Recordings (in memory, files or datasets), a scene, a gaze field and a radiance field, in any order.
    areas : path, optional
        JSON file of areas of interest: boxes, meshes, shapes and groups (docs/how-to/statistics.md).
    output : path, optional
        Folder for the tables.
    reporter : Reporter
        Receives the progress.
    **options
        Options of `nerg stats` (`nerg_mi.aoi.options.StatisticsOptions`).

    Returns
    -------
    StatisticsResult
        Tables as lists of dicts.

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import json, nerg_mi as nerg
    >>> _ = (folder / "areas.json").write_text(json.dumps({"shelf": [[2, -1, 0], [3, 1, 2]]}))
    >>> eye, ahead = [[0.0, 0.0, 1.6]] * 3, [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    >>> rays = nerg.Rays([0.0, 0.2, 0.4], [0, 0, 0], ("Ada",), origin=eye, direction=ahead, confidence=[1.0] * 3)
    >>> row = nerg.stats(rays, folder / "areas.json").aois[0]
    >>> row["aoi"], round(row["share"], 3), row["hit_ratio"], row["distance"]
    ('shelf', 0.667, 1.0, 2.0)
    """
    from nerg_mi.workflows.statistics import statistics

    inputs = [files] if isinstance(files, (str, os.PathLike, Rays)) else list(files)
    if areas is not None:
        options["aois"] = areas
    resolved = build_options(StatisticsOptions, "stats", None, options)
    paths = [f if isinstance(f, Rays) else resolve_file(f, "files") for f in inputs]
    return statistics(paths, None if output is None else Path(output), resolved, reporter)


# ---- Import of recordings ----


def import_rays(
    files: FilePath | Sequence[FilePath],
    reader: str = "table",
    *,
    output: FilePath | None = None,
    reporter: Reporter = SILENT,
    **options: Any,
) -> Rays:
    """Import gaze recordings.

    Parameters
    ----------
    files : path or sequence of path
        Recordings.
    reader : str
        Name of the format, as for ``nerg rays import --preset``. ``table`` reads any CSV or Parquet table with the
        option ``columns``.
    output : path, optional
        File to write (.npz or .parquet), or a dataset (.rays).
    reporter : Reporter
        Receives the progress.
    **options
        Options of the reader; ``skip_bad_lines``, ``pseudonyms`` and ``salt``; and for a dataset ``environment``,
        ``day`` and ``workers`` (`nerg_mi.workflows.rays_commands.RaysImportOptions`).

    Returns
    -------
    Rays
        The gaze samples, right-handed with z up, in metres and seconds. Their ``metadata`` contains the number of
        dropped samples by reason. A large dataset is subsampled (`nerg_mi.workflows.rays.ImportResult`).

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> _ = (folder / "day.csv").write_text("t,who,x,y,z,dx,dy,dz\\n0.0,Ada,1,1,1.6,1,0,0\\n0.1,Ada,1,1,1.6,0,1,0\\n")
    >>> columns = "origin=x,y,z direction=dx,dy,dz t=t person=who"
    >>> rays = nerg.import_rays(folder / "day.csv", columns=columns)
    >>> len(rays), rays.persons
    (2, ('Ada',))
    """
    from nerg_mi.rays.readers.base import list_options
    from nerg_mi.rays.readers.registry import get_reader, list_reader_names, make_options
    from nerg_mi.workflows import rays
    from nerg_mi.workflows.rays import current_import_keywords

    options = current_import_keywords(options)
    file_list = [files] if isinstance(files, (str, os.PathLike)) or not isinstance(files, Sequence) else files
    if not all(isinstance(file, (str, os.PathLike)) for file in file_list):
        raise NergError(
            f"import_rays reads files, given as strings or paths, got {type(files).__name__}; write a table to a file "
            '(df.to_csv("day.csv")) and pass the names of its columns (columns="origin=x,y,z ...")'
        )
    reader_options = list_options(get_reader(reader).Options)
    import_options = {f.name for f in fields(RaysImportOptions)} - {"reader", "settings", "output"}
    all_reader_options = {
        option.name for name in list_reader_names() for option in list_options(get_reader(name).Options)
    }
    check_names("import_rays", options, sorted(all_reader_options | import_options))
    paths = [resolve_file(file, "files") for file in file_list]
    import_values = {name: value for name, value in options.items() if name in import_options}
    parsers = {option.name: option.parse for option in reader_options}
    reader_values = {name: value for name, value in options.items() if name not in import_options}
    for name, value in reader_values.items():
        # Values can be strings, as on the command line.
        if isinstance(value, str) and (parser := parsers.get(name)) is not None:
            reader_values[name] = parser(value)
    resolved = RaysImportOptions(
        reader=reader, settings=make_options(reader, reader_values), output=output, **import_values
    )
    return rays.import_rays(paths, resolved, reporter).rays


# ---- Training ----


def train_radiance(
    photos: FilePath,
    output: FilePath | None = None,
    *,
    options: RadianceOptions | None = None,
    reporter: Reporter = SILENT,
    **overrides: Any,
) -> TrainedField[RadianceField]:
    """Train a radiance field on posed photos.

    After Ctrl-C, the current state is returned if there is no ``output``.

    Parameters
    ----------
    photos : path
        A folder, its transforms.json, or a COLMAP model.
    output : path, optional
        Checkpoint to write (.safetensors), with a preview and, until the training is complete, a state to resume from.
    options : RadianceOptions, optional
        Base options (`nerg_mi.workflows.radiance_commands.RadianceOptions`).
    reporter : Reporter
        Receives the progress (`nerg_mi.workflows.base`).
    **overrides
        Single options on top of ``options``, such as ``minutes=5`` or ``size="medium"``.

    Returns
    -------
    TrainedField
        The radiance field. Its ``provenance`` contains the error on held-out photos.

    Raises
    ------
    NergError
        An option or a file is invalid.
    KeyboardInterrupt
        Ctrl-C was pressed and there is an ``output``, which has been written.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> field = nerg.train_radiance(photos, steps=2, holdout=0)  # photos: a folder of posed photos
    >>> field.kind, field.provenance["steps"]
    ('radiance', 2)
    """
    from nerg_mi.workflows import train_radiance as radiance

    resolved = build_options(RadianceOptions, "train_radiance", options, overrides)
    result = radiance.train_radiance(resolve_file(photos, "photos"), output, resolved, reporter)
    if output is None:
        return TrainedField(result.field, result.provenance)
    return TrainedField(result.field, result.provenance, Path(output).name, Path(output))


def compile_field(
    field: TrainedField[RadianceField] | FilePath,
    output: FilePath | None = None,
    *,
    options: CompileOptions | None = None,
    reporter: Reporter = SILENT,
    **overrides: Any,
) -> TrainedField[RadianceField]:
    """Evaluate the density of a radiance field on voxels once, so that frames take about half the time.

    Colour still comes from the networks of the field. Gaze fields that were trained in the field accept the result.

    Parameters
    ----------
    field : TrainedField or path
        The field. The object is not changed.
    output : path, optional
        Checkpoint to write (.safetensors).
    options : CompileOptions, optional
        Base options (`nerg_mi.workflows.radiance_commands.CompileOptions`).
    reporter : Reporter
        Receives the progress, and the errors, the size and the speed of each resolution.
    **overrides
        Single options on top of ``options``, such as ``resolution=512``, ``min_psnr=35`` or ``memory=100`` (MB).

    Returns
    -------
    TrainedField
        The compiled field. ``provenance["compiled"]`` has its resolution, its size in bytes, its depth errors in scene
        units, the PSNR of its colour in dB and the speed-up, along random rays.

    Raises
    ------
    NergError
        An option is invalid, the field is compiled already, or the voxels would exceed ``memory``.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> field = nerg.load_field(files("nerg_mi.scenes.store") / "store.safetensors")
    >>> small = nerg.compile_field(field, resolution=128)
    >>> small.provenance["compiled"]["resolution"]
    128
    """
    from nerg_mi.workflows.compile import compile_field as compile_network

    resolved = build_options(CompileOptions, "compile_field", options, overrides)
    original = load_field(field) if isinstance(field, (str, os.PathLike)) else field
    result = compile_network(original.network, resolved, reporter)
    compiled = TrainedField(result.field, {**original.provenance, "compiled": asdict(result.error)})
    if output is None:
        return compiled
    return TrainedField(compiled.network, compiled.provenance, Path(output).name, compiled.save(output))


def train_gaze(
    rays: Rays | FilePath | None,
    output: FilePath | None = None,
    *,
    options: GazeOptions | None = None,
    reporter: Reporter = SILENT,
    **overrides: Any,
) -> TrainedGazeField:
    """Train a gaze field on recordings, on salience images of posed photos, or on both.

    Parameters
    ----------
    rays : Rays, path or None
        Recordings. None: salience images alone (options ``views`` and ``salience``).
    output : path, optional
        Checkpoint to write (.safetensors), as for `train_radiance`.
    options : GazeOptions, optional
        Base options (`nerg_mi.workflows.gaze_commands.GazeOptions`).
    reporter : Reporter
        Receives the progress.
    **overrides
        Single options on top of ``options``, such as ``minutes=5``, ``recipe="small"`` or ``test_zones=3``, and the
        environment: ``field="field.safetensors"``, ``scene="scene.xml"`` (or a mesh), or ``geometry="hits"`` or
        ``"none"``.

    Returns
    -------
    TrainedGazeField
        The gaze field. Its ``provenance`` contains the scores on held-out positions, and its method ``density`` returns
        densities of rays.

    Raises
    ------
    NergError
        An option or a file is invalid.
    KeyboardInterrupt
        Ctrl-C was pressed and there is an ``output``, which has been written.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> gaze = nerg.train_gaze(rays, geometry="none", steps=2, validation_zones=0, probes=8, directions=64)
    >>> gaze.kind, gaze.provenance["steps"]
    ('gaze', 2)
    """
    from nerg_mi.workflows import train_gaze as gaze

    resolved = build_options(GazeOptions, "train_gaze", options, overrides)
    result = gaze.train_gaze(None if rays is None else resolve_rays(rays), output, resolved, reporter)
    return _make_gaze_field(result, output, resolved.field or resolved.scene)


def train_prior(
    rays: Rays | FilePath | Sequence[Rays | FilePath],
    output: FilePath | None = None,
    *,
    options: PriorOptions | None = None,
    reporter: Reporter = SILENT,
    **overrides: Any,
) -> TrainedGazeField:
    """Fit a gaze field for an environment without recordings: the distribution of gaze elevations in other
    environments.

    Parameters
    ----------
    rays : Rays, path, or sequence of these
        Recordings, one item per environment. Environments have equal weights.
    output : path, optional
        Checkpoint to write (.safetensors).
    options : PriorOptions, optional
        Base options (`nerg_mi.workflows.gaze_commands.PriorOptions`).
    reporter : Reporter
        Receives the progress.
    **overrides
        Single options on top of ``options``, such as ``seed=1``.

    Returns
    -------
    TrainedGazeField
        The gaze field.

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> prior = nerg.train_prior(rays)  # or a list of recordings, one per environment
    >>> prior.kind, len(prior.provenance["places"])
    ('gaze', 1)
    """
    from nerg_mi.workflows import train_gaze as gaze

    resolved = build_options(PriorOptions, "train_prior", options, overrides)
    environments = [rays] if isinstance(rays, (str, os.PathLike, Rays)) else rays
    inputs = [item if isinstance(item, Rays) else resolve_file(item, "rays") for item in environments]
    result = gaze.learn_prior(inputs, output, resolved, reporter)
    return _make_gaze_field(result, output, None)


def _make_gaze_field(
    result: GazeResult | PriorResult, output: FilePath | None, geometry_file: Path | None
) -> TrainedGazeField:
    path = None if output is None else Path(output)
    name = "in memory" if path is None else path.name
    return TrainedGazeField(result.field, result.provenance, name, path, geometry_file)
