"""Parts of a bake of Gaussian splats as tasks: as `tasks`, whose files and parts they have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nerg_mi.jobs.backend import select_backend
from nerg_mi.jobs.parts import Parts
from nerg_mi.surfaces.sources import Crowd, RaySettings, TrackedRays
from nerg_mi.tasks.inputs import read_input
from nerg_mi.tasks.task import Task
from nerg_mi.threads import use_share

from .splat_chunks import SplatScene, splat_chunk
from .tasks import part_of, tasks_around, write_sums

_GAZE = "of-the-job/gaze.safetensors"

_last: dict[str, SplatScene] = {}


def bake_splat_part(parameters: Mapping[str, Any], inputs: Mapping[str, Path], output: Path) -> dict[str, float]:
    """Sums over the sides of Gaussians (.npy), with the others as notes; ``parameters`` as of `tasks.bake_part`, with
    what `splat_tasks_of` says of the scene."""
    select_backend(parameters["mode"])
    use_share()
    digest, around = parameters["digest"], parameters["around"]
    if digest not in _last:
        _last.clear()
        gaze = inputs[_GAZE] if around["gaze"] else None
        of_rays = RaySettings(**around["of_rays"])
        _last[digest] = SplatScene(inputs[around["splats"]], around["count"], gaze, around["cone"], of_rays)
    return write_sums(splat_chunk(_last[digest], part_of(parameters, inputs)), output)


def splat_tasks_of(scene: SplatScene, who: Crowd | TrackedRays, mode: str, parts: Parts) -> list[Task]:
    """A task for each part of ``who``, in their order; rays are held by the store of ``parts``."""
    name = f"of-the-job/place{scene.splats.suffix.lower()}"
    inputs = [read_input(name, scene.splats)]
    if scene.gaze is not None:
        inputs.append(read_input(_GAZE, scene.gaze))
    around: dict[str, Any] = {"splats": name, "count": scene.count, "gaze": scene.gaze is not None}
    around |= {"cone": scene.cone, "of_rays": asdict(scene.of_rays)}
    return tasks_around(f"{__name__}:bake_splat_part", around, tuple(inputs), who, mode, parts)
