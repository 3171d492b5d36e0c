"""Trainings: from recordings to fields in memory."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerg_mi.workflows.base import SILENT, Reporter

from .fields import FilePath, TrainedField
from .options import file_of, options_of, rays_of

if TYPE_CHECKING:
    from nerg_mi.fields.gaze_base import AnyGazeField
    from nerg_mi.fields.radiance import RadianceField
    from nerg_mi.rays.rays import Rays
    from nerg_mi.workflows.train_gaze import GazeOptions
    from nerg_mi.workflows.train_radiance import RadianceOptions


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
    `nerg_mi.workflows.train_radiance.RadianceOptions` says what there is. ``reporter`` is told how it goes
    (`nerg_mi.workflows.base`). What comes back has the error on held-out photos in its ``provenance``. After Ctrl-C it
    is the result so far, or ``KeyboardInterrupt`` where there is an ``output``, which is written. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> field = nerg.train_radiance(photos, steps=2, holdout=0)  # a folder of posed photos
    >>> field.kind, field.provenance["steps"]
    ('radiance', 2)
    """
    from nerg_mi.workflows import train_radiance as radiance

    job = options_of(radiance.RadianceOptions, "train_radiance", options, changes)
    result = radiance.train_radiance(file_of(photos, "photos"), output, job, reporter)
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
    `nerg_mi.workflows.train_gaze.GazeOptions` says what there is. ``output`` and ``reporter``: as for `train_radiance`.
    What comes back has its scores on held-out positions in its ``provenance``. Raises `NergError`.

    >>> import nerg_mi as nerg
    >>> gaze = nerg.train_gaze(rays, geometry="none", steps=2, zones=0, probes=8, directions=64)
    >>> gaze.kind, gaze.provenance["steps"]
    ('gaze', 2)
    """
    from nerg_mi.workflows import train_gaze as gaze
    from nerg_mi.workflows.train_gaze import GazeOptions

    job = options_of(GazeOptions, "train_gaze", options, changes)
    result = gaze.train_gaze(None if rays is None else rays_of(rays), output, job, reporter)
    return _trained(result.field, result.provenance, output)


def _trained(network: Any, provenance: dict[str, Any], output: FilePath | None) -> TrainedField[Any]:
    if output is None:
        return TrainedField(network, provenance)
    return TrainedField(network, provenance, Path(output).name, Path(output))
