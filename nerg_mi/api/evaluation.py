"""Evaluation of fields: on held-out data, in folds, of variants, and error against time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from uuid import uuid4

from nerg_mi.environment.trained import TrainedField
from nerg_mi.files.values import FilePath
from nerg_mi.rays.rays import Rays
from nerg_mi.workflows.gaze_commands import FoldOptions, GazeEvaluationOptions, NextLookOptions
from nerg_mi.workflows.radiance_commands import RadianceScoreOptions
from nerg_mi.workflows.scene_commands import StudyOptions

from .arguments import check_output, resolve_file
from .calls import Progress, report_progress
from .gaze import TrainedGazeField, training_geometry
from .objects import as_file, build_options, resolve_rays
from .scene import Scene
from .session import session_folder

if TYPE_CHECKING:
    from nerg_mi.evaluation.metrics import ViewScores
    from nerg_mi.fields.radiance import RadianceField
    from nerg_mi.workflows.evaluate import FoldResult, GazeEvaluation
    from nerg_mi.workflows.next_look import NextLookEvaluation
    from nerg_mi.workflows.study import StudyResult


def evaluate_radiance(
    field: FilePath | TrainedField[RadianceField],
    photos: FilePath,
    *,
    options: RadianceScoreOptions | None = None,
    progress: Progress = None,
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
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
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

    with report_progress(progress) as reporter:
        resolved = build_options(RadianceScoreOptions, "evaluate_radiance", options, overrides)
        return train_radiance.evaluate_radiance(
            as_file(field, "field"), resolve_file(photos, "photos"), resolved, reporter
        )


def evaluate_gaze(
    gaze: FilePath | TrainedGazeField,
    rays: Rays | FilePath,
    output: FilePath | None = None,
    *,
    options: GazeEvaluationOptions | None = None,
    progress: Progress = None,
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
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
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

    check_output(output)
    with report_progress(progress) as reporter:
        if options is None:
            overrides = training_geometry(gaze) | overrides
        resolved = build_options(GazeEvaluationOptions, "evaluate_gaze", options, overrides)
        data = resolve_rays(rays)
        return evaluate.evaluate_gaze(as_file(gaze, "gaze"), data, output, resolved, reporter)


def next_look(
    gaze: FilePath | TrainedGazeField,
    rays: Rays | FilePath,
    output: FilePath | None = None,
    *,
    options: NextLookOptions | None = None,
    progress: Progress = None,
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
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
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

    check_output(output)
    with report_progress(progress) as reporter:
        if options is None:
            overrides = training_geometry(gaze) | overrides
        resolved = build_options(NextLookOptions, "next_look", options, overrides)
        data = resolve_rays(rays)
        return next_look.evaluate_next_look(as_file(gaze, "gaze"), data, output, resolved, reporter)


def study(
    scene: FilePath | Scene,
    output: FilePath | None = None,
    *,
    options: StudyOptions | None = None,
    progress: Progress = None,
    **overrides: Any,
) -> StudyResult:
    """Measure the error of a scene against run time, for many settings.

    A full study takes up to half an hour.

    Parameters
    ----------
    scene : Scene, str or path
        A scene, its file, or an analytic scene with an exact solution: ``slab``, ``sphere``, ``sheets``, ``fog`` or
        ``ramp``.
    output : path, optional
        Folder for tables and plots; it is created. Default: a temporary folder, which is removed when the process ends.
    options : StudyOptions, optional
        Base options (`nerg_mi.workflows.scene_commands.StudyOptions`).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
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

    check_output(output)
    with report_progress(progress) as reporter:
        resolved = build_options(StudyOptions, "study", options, overrides)
        file = scene if isinstance(scene, str) else str(as_file(scene, "scene"))
        folder = session_folder() / f"study-{uuid4().hex[:12]}" if output is None else output
        return studies.run_study(file, folder, resolved, reporter)


def folds(
    rays: Rays | FilePath,
    output: FilePath | None = None,
    *,
    options: FoldOptions | None = None,
    progress: Progress = None,
    **overrides: Any,
) -> FoldResult:
    """Cross-validate a gaze field: train and score it several times, each time without some participants and zones.

    Parameters
    ----------
    rays : Rays or path
        The recordings.
    output : path, optional
        Folder for tables; finished folds are stored next to it (``OUTPUT.tasks``) and not computed again. Default: a
        temporary folder, which is removed when the process ends.
    options : FoldOptions, optional
        Base options (`nerg_mi.workflows.gaze_commands.FoldOptions`).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **overrides
        Single options on top of ``options``, such as ``folds=5`` or ``splits="both"``, and the environment as for
        `train_gaze`.

    Returns
    -------
    FoldResult
        Means over folds (``rows``) and scores of each fold (``each``); ``to_dataframe`` returns them as data frames.

    Raises
    ------
    NergError
        An option or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> small = {"folds": 2, "splits": "pos", "steps": 2, "probes": 8, "directions": 64, "min_rays": 8}
    >>> result = nerg.folds(rays, geometry="none", test_zones=1, test_positions=4, **small)
    >>> result.to_dataframe()["method"][0], len(result.fields)
    ('gaze field', 2)
    """
    from nerg_mi.workflows import evaluate

    check_output(output)
    with report_progress(progress) as reporter:
        resolved = build_options(FoldOptions, "folds", options, overrides)
        folder = session_folder() / f"folds-{uuid4().hex[:12]}" if output is None else output
        return evaluate.evaluate_folds(resolve_rays(rays), folder, resolved, reporter)
