"""A gaze field for a place where nobody was tracked: what people in other places say of it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.files.atomic import check_writable
from nerg_mi.formats.fields import save_gaze
from nerg_mi.rays.dataset_open import load_rays, rays_digest
from nerg_mi.rays.rays import Rays
from nerg_mi.train.gaze_log_density import KAPPA, prior_field

from .base import SILENT, Reporter, select_backend
from .gaze_commands import PriorOptions

# ---- A gaze field for a place where nobody was tracked: what people in other places say of it ----


RECIPE = "prior"
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
        data = place if isinstance(place, Rays) else load_rays(place, options.most, options.seed)
        of_file = {} if isinstance(place, Rays) else {"file": Path(place).name, "sha256": rays_digest(place)}
        learnt.append(data)
        files.append({**of_file, "rays": len(data), "persons": len(data.persons)})
    if empty := [str(k + 1) for k, data in enumerate(learnt) if not len(data)]:
        raise NergError(f"no ray is in place {', '.join(empty)} of those that a prior is learnt from; leave it out")
    field = prior_field(learnt, ns)
    provenance = {
        "recipe": RECIPE,
        "kappa": KAPPA,
        "places": files,
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    if output is not None:
        save_gaze(field, output, provenance)
        people = sum(of["persons"] for of in files)
        many = f"{len(files)} place{'' if len(files) == 1 else 's'}"
        reporter.message(f"wrote {output}: how high {people} people looked in {many}, wherever an observer stands")
    return PriorResult(field, provenance, output)
