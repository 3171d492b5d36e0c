"""Training of radiance fields and gaze fields."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from uuid import uuid4

from nerg_mi.environment.trained import TrainedField
from nerg_mi.errors import NergError
from nerg_mi.files.values import FilePath, to_path
from nerg_mi.interruption import TrainingInterrupted
from nerg_mi.progress import open_reporter
from nerg_mi.ranges import RAYS, SEEDS, check_ranges
from nerg_mi.rays.dataset import hash_rays, load_rays
from nerg_mi.rays.rays import Rays, merge_tracking
from nerg_mi.rendering.scene import get_array_module
from nerg_mi.train.gaze_log_density import ELEVATION_KAPPA, ELEVATION_PRIOR, make_elevation_prior
from nerg_mi.workflows.gaze_commands import GazeOptions
from nerg_mi.workflows.radiance_commands import RadianceOptions

from .arguments import check_output, resolve_file
from .calls import Progress, report_progress
from .gaze import TrainedGazeField
from .objects import build_options, copy_from_session, resolve_rays
from .session import session_folder

if TYPE_CHECKING:
    from nerg_mi.fields.radiance import RadianceField
    from nerg_mi.workflows.train_gaze import GazeResult


def train_radiance(
    photos: FilePath,
    output: FilePath | None = None,
    *,
    options: RadianceOptions | None = None,
    progress: Progress = None,
    **overrides: Any,
) -> TrainedField[RadianceField]:
    """Train a radiance field on posed photos.

    Parameters
    ----------
    photos : path
        A folder, its transforms.json, or a COLMAP model.
    output : path, optional
        Checkpoint to write (.safetensors), with a preview and, until the training is complete, a state to resume from.
    options : RadianceOptions, optional
        Base options (`nerg_mi.workflows.radiance_commands.RadianceOptions`).
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
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
        Ctrl-C was pressed. An ``output`` has been written. The attribute ``field`` of the exception is the field of the
        state so far.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> field = nerg.train_radiance(photos, steps=2, holdout=0)  # photos: a folder of posed photos
    >>> field.kind, field.provenance["steps"]
    ('radiance', 2)
    """
    from nerg_mi.workflows import train_radiance as radiance

    check_output(output)
    with report_progress(progress) as reporter:
        resolved = build_options(RadianceOptions, "train_radiance", options, overrides)
        make = lambda result: TrainedField(result.field, result.provenance, *_locate(output))
        with _converting_interrupts(make):
            return make(radiance.train_radiance(resolve_file(photos, "photos"), output, resolved, reporter))


def train_gaze(
    rays: Rays | FilePath | None,
    output: FilePath | None = None,
    *,
    options: GazeOptions | None = None,
    progress: Progress = None,
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
    progress : bool, Reporter or None
        None shows a progress bar in notebooks, True shows one anywhere, False none; a `Reporter` receives everything.
    **overrides
        Single options on top of ``options``, such as ``minutes=5``, ``recipe="small"`` or ``test_zones=3``, and
        ``geometry``: the environment that the participants saw, in memory or as a file, or ``"hits"`` or ``"none"``.
        With an ``output``, an environment in memory is written next to it.

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
        Ctrl-C was pressed, as for `train_radiance`.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> gaze = nerg.train_gaze(rays, geometry="none", steps=2, validation_zones=0, probes=8, directions=64)
    >>> gaze.kind, gaze.provenance["steps"]
    ('gaze', 2)
    """
    from nerg_mi.workflows import train_gaze as gaze

    check_output(output)
    with report_progress(progress) as reporter:
        resolved = build_options(GazeOptions, "train_gaze", options, overrides)
        volume = None
        if output is None and resolved.geometry == "hits":
            volume = session_folder() / f"hits-{uuid4().hex[:12]}.vol"
        geometry_file = resolved.field or resolved.scene or volume

        def make(result: GazeResult | TrainingInterrupted) -> TrainedGazeField:
            if output is not None and geometry_file is not None:
                copy_from_session(geometry_file, Path(output).parent)
            return _make_gaze_field(result, output, geometry_file)

        with _converting_interrupts(make):
            return make(
                gaze.train_gaze(None if rays is None else resolve_rays(rays), output, resolved, reporter, volume)
            )


@check_ranges
def train_prior(
    rays: Rays | FilePath | Sequence[Rays | FilePath],
    *,
    max_samples: Annotated[int, RAYS] = 10_000_000,
    seed: Annotated[int, SEEDS] = 0,
    progress: Progress = None,
) -> TrainedGazeField:
    """Fit an elevation prior on recordings in other scenes, for a scene without tracking.

    The prior is the distribution of gaze elevation over participants, the same at every position. It is valid in any
    scene whose z axis points up. docs/explanation/accuracy.md compares it with fields trained on tracking.

    Parameters
    ----------
    rays : Rays, path, or sequence of these
        Rays files (.npz or .parquet) or datasets (.rays), one for each scene. Scenes have equal weights, and so have
        participants within a scene.
    max_samples : int
        Maximum number of samples read from a dataset; larger datasets are subsampled uniformly with ``seed``.
    seed : int
        Seed of the subsampling.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    TrainedGazeField
        The gaze field.

    Raises
    ------
    NergError
        There are no rays, or an argument is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> prior = nerg.train_prior(rays)  # or a list of recordings, one per environment
    >>> prior.kind, len(prior.provenance["places"])
    ('gaze', 1)
    """
    sources = [rays] if isinstance(rays, (str, os.PathLike, Rays)) else rays
    if not sources:
        raise NergError("a prior needs rays of other scenes: give at least one file")
    recordings, files = [], []
    with open_reporter(progress) as reporter:
        for k, source in enumerate(sources):
            reporter.progress(k / len(sources), "reading rays")
            entry = {} if isinstance(source, Rays) else {"file": to_path(source).name, "sha256": hash_rays(source)}
            data = source if isinstance(source, Rays) else load_rays(source, max_samples, seed)
            recordings.append(data)
            files.append({**entry, "rays": len(data), "persons": len(data.persons), "tracking": data.tracking})
        if empty := [str(k + 1) for k, data in enumerate(recordings) if not len(data)]:
            raise NergError(f"there are no rays in file {', '.join(empty)} of those given; leave it out")
        field = make_elevation_prior(recordings, get_array_module())
        participants = sum(entry["persons"] for entry in files)
        reporter.message(
            f"distribution of gaze elevation of {participants} participants in {len(files)} "
            f"scene{'' if len(files) == 1 else 's'}, independent of position"
        )
    provenance = {
        "recipe": ELEVATION_PRIOR,
        "kappa": ELEVATION_KAPPA,
        "places": files,
        "tracking": merge_tracking(data.tracking for data in recordings),
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    return TrainedGazeField(field, provenance)


@contextmanager
def _converting_interrupts(make: Callable[[TrainingInterrupted], object]) -> Iterator[None]:
    """Replace the field of an interrupted training by the object that ``make`` returns."""
    try:
        yield
    except TrainingInterrupted as error:
        error.field = make(error)
        raise


def _make_gaze_field(
    result: GazeResult | TrainingInterrupted, output: FilePath | None, geometry_file: Path | None
) -> TrainedGazeField:
    return TrainedGazeField(result.field, result.provenance, *_locate(output), geometry_file)


def _locate(output: FilePath | None) -> tuple[str, Path | None]:
    """Return the name of a trained field, and its path, if it was written."""
    return ("in memory", None) if output is None else (Path(output).name, Path(output))
