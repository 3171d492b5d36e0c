"""Gaze on surfaces, for notebooks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerg_mi.workflows.base import SILENT, Reporter

from .fields import FilePath
from .options import file_of, options_of

if TYPE_CHECKING:
    from nerg_mi.rays.rays import Rays
    from nerg_mi.workflows.bake import Bake, BakeOptions


def bake(
    surface: FilePath,
    outputs: FilePath | Sequence[FilePath] = (),
    *,
    rays: Rays | FilePath | None = None,
    options: BakeOptions | None = None,
    reporter: Reporter = SILENT,
    **changes: Any,
) -> Bake:
    """How much gaze each square metre of ``surface`` receives: a mesh file, a scene file, or a radiance field's.

    ``rays``: what `load_rays` gave, or a file of them; the people whose places a gaze field is asked for, or whose gaze
    it is. ``outputs``: files to write (.ply, .glb, .csv, .json). ``changes``: options one by one
    (``gaze="gaze.safetensors"``, ``observer=(4.4, 2.8, 1.6)``, ``smooth=0.05``, ...) on top of ``options``;
    `nerg_mi.workflows.bake_options.BakeOptions` says what there is. Raises `NergError`.

    >>> from importlib.resources import files
    >>> from nerg_mi.api.bake import bake
    >>> store = files("nerg_mi.scenes.store")
    >>> baked = bake(store / "twin.ply", gaze=store / "shoppers.safetensors", observer=(4.4, 2.8, 1.6), detail=1.0)
    >>> 0.9 < baked.on_surface < 1, abs(baked.unaccounted) < 0.01
    (True, True)
    """
    from nerg_mi.rays.rays import Rays
    from nerg_mi.workflows import bake as baking
    from nerg_mi.workflows.bake_options import BakeOptions

    in_memory = rays if isinstance(rays, Rays) else None
    if rays is not None and in_memory is None:
        changes = {**changes, "rays": rays}
    job = options_of(BakeOptions, "bake", options, changes)
    files = [outputs] if isinstance(outputs, (str, Path)) or not isinstance(outputs, Sequence) else list(outputs)
    return baking.bake(file_of(surface, "surface"), [Path(str(f)) for f in files], job, reporter, in_memory)
