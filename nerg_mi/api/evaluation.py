"""Scores of fields, and what settings cost."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from nerg_mi.workflows.base import SILENT, Reporter

from .fields import FilePath, TrainedField
from .options import checkpoint_of, file_of, options_of, rays_of

if TYPE_CHECKING:
    from nerg_mi.evaluation.metrics import ViewScores
    from nerg_mi.fields.gaze_base import AnyGazeField
    from nerg_mi.fields.radiance import RadianceField
    from nerg_mi.rays.rays import Rays
    from nerg_mi.workflows.ablation import AblationOptions, AblationResult
    from nerg_mi.workflows.evaluate import GazeEvaluation
    from nerg_mi.workflows.geometry import GazeEvaluationOptions
    from nerg_mi.workflows.study import StudyOptions, StudyResult
    from nerg_mi.workflows.train_radiance import RadianceScoreOptions


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
    `nerg_mi.workflows.train_radiance.RadianceScoreOptions` says what there is. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> scores = nerg.evaluate_radiance(store / "store.safetensors", photos, width=24, train=True)
    >>> len(scores.psnr) == len(scores.views), scores.psnr_mean > 20  # of a folder of posed photos
    (True, True)
    """
    from nerg_mi.workflows import train_radiance

    job = options_of(train_radiance.RadianceScoreOptions, "evaluate_radiance", options, changes)
    with checkpoint_of(field, "field") as path:
        return train_radiance.evaluate_radiance(path, file_of(photos, "photos"), job, reporter)


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
    `nerg_mi.workflows.geometry.GazeEvaluationOptions` says what there is. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> held_out = {"test_zones": 1, "test_positions": 4, "geometry": "none", "zones": 0}
    >>> small = {"steps": 2, "probes": 8, "directions": 64}
    >>> gaze = nerg.train_gaze(rays, **held_out, **small)
    >>> scores = nerg.evaluate_gaze(gaze, rays, directions=64, resamples=2, min_rays=8)
    >>> scores.rows[0]["method"], scores.split
    ('gaze field', 'pos')
    """
    from nerg_mi.workflows import evaluate
    from nerg_mi.workflows.geometry import GazeEvaluationOptions

    job = options_of(GazeEvaluationOptions, "evaluate_gaze", options, changes)
    data = rays_of(rays)
    with checkpoint_of(gaze, "gaze") as path:
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
    `nerg_mi.workflows.ablation.AblationOptions` says what there is. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> small = {"recipes": "default", "variant": ("emit",), "seeds": 1, "default_steps": 2, "probes": 8, "cameras": 0}
    >>> test = {"zones": 1, "positions": 4, "min_rays": 8}
    >>> result = nerg.ablate(rays, folder / "ablation", geometry="none", **small, **test)
    >>> [row["variant"] for row in result.rows]
    ['emit']
    """
    from nerg_mi.workflows import ablation
    from nerg_mi.workflows.ablation import AblationOptions

    job = options_of(AblationOptions, "ablate", options, changes)
    return ablation.ablate(rays_of(rays), output, job, reporter)


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
    ``only="depth"``, ...) on top of ``options``; `nerg_mi.workflows.study.StudyOptions` says what there is. A full
    study takes up to half an hour. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> result = nerg.study("slab", folder / "study", quick=True, width=8, height=8)
    >>> result.files[0].name
    'study.csv'
    """
    from nerg_mi.workflows import study as studies

    job = options_of(studies.StudyOptions, "study", options, changes)
    return studies.run_study(str(scene if isinstance(scene, str) else file_of(scene, "scene")), output, job, reporter)
