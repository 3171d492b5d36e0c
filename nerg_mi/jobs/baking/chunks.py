"""The work of a bake in parts: a scene's description and some of its observers, or rays, give partial sums.

A part is a plain function of what it is given: it may be computed anywhere, any number of times, with the same result.
Parts are cut by numbers of this module, not by the machine, and their sums are added in the order of the parts.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.fields import load_gaze
from nerg_mi.rendering.asked import is_nerg
from nerg_mi.rendering.pictures import load_scene
from nerg_mi.rendering.scene_file import files_of_scene
from nerg_mi.surfaces.laplacian import Sums
from nerg_mi.surfaces.mesh import Mesh, Target, Triangles
from nerg_mi.surfaces.sources import (
    Crowd,
    GazeSettings,
    MakeLooker,
    RaySettings,
    TrackedRays,
    gaze_sums,
    lookers_of_field,
    ray_sums,
)
from nerg_mi.transport.observer_gaze import PlacedGaze

OBSERVERS = 4
"""Observers of a part."""

RAYS = 1 << 16
"""Rays of a part."""


@dataclass(frozen=True, eq=False)
class BakeScene:
    """All that a part needs to know besides who looks; it can be pickled, and refers to ``gaze`` and ``scene`` by file.

    ``mesh`` receives, ``others`` hide it. ``gaze``: the field's checkpoint, None for that of the ``scene`` file, whose
    field stands around the meshes; None for a place of meshes alone.
    """

    mesh: Mesh
    others: tuple[Triangles, ...] = ()
    gaze: Path | None = None
    scene: Path | None = None
    of_gaze: GazeSettings = field(default_factory=GazeSettings)
    of_rays: RaySettings = field(default_factory=RaySettings)

    @property
    def nothing(self) -> Sums:
        """Of nobody."""
        return Sums.none(len(self.mesh.faces), len(self.mesh.vertices))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of everything, the files' bytes included."""
        found = hashlib.sha256()
        for vertices, faces in ((self.mesh.vertices, self.mesh.faces), *self.others):
            found.update(np.ascontiguousarray(vertices, "<f8").tobytes() + b"|")
            found.update(np.ascontiguousarray(faces, "<i8").tobytes() + b"|")
        files = [] if self.scene is None else files_of_scene(self.scene)
        sums = [None if path is None else file_sha256(path) for path in (self.gaze, *files)]
        found.update(repr((sums, self.of_gaze, self.of_rays)).encode())
        return found.hexdigest()


@dataclass(frozen=True, eq=False)
class _Ready:
    digest: str
    variant: str
    target: Target
    make: MakeLooker | None


_last: list[_Ready] = []


def bake_chunk(scene: BakeScene, part: Crowd | TrackedRays) -> Sums:
    """Partial sums of the observers, or of the rays, of ``part``. A variant must be active; what is loaded for a scene
    is kept for its next part. Raises `NergError`."""
    ready = _prepared(scene)
    if isinstance(part, TrackedRays):
        return ray_sums(ready.target, part, scene.of_rays)
    if ready.make is None:
        raise NergError("there is no gaze field: name one by --gaze, or take the gaze of the rays, --from rays")
    return gaze_sums(ready.target, ready.make, part.positions, part.weights, scene.of_gaze)


def parts_of(who: Crowd | TrackedRays) -> Iterator[Crowd | TrackedRays]:
    """``who`` in parts, always the same."""
    if isinstance(who, TrackedRays):
        for a in range(0, len(who), RAYS):
            yield who.part(a, a + RAYS)
        return
    for a in range(0, len(who.weights), OBSERVERS):
        yield Crowd(who.positions[a : a + OBSERVERS], who.weights[a : a + OBSERVERS])


def _prepared(scene: BakeScene) -> _Ready:
    import mitsuba as mi

    variant = str(mi.variant())
    if _last and (_last[0].digest, _last[0].variant) == (scene.digest, variant):
        return _last[0]
    _last.clear()
    medium, settings, falloff, gaze = None, None, 0.0, None
    if scene.scene is not None:
        integrator: Any = load_scene(scene.scene).integrator()
        if is_nerg(integrator):
            medium, gaze = integrator.medium, integrator.gaze
            settings, falloff = integrator.observer_settings, float(np.ravel(np.array(integrator.falloff))[0])
    target = Target(scene.mesh, list(scene.others), medium, settings if medium is not None else None, falloff)
    if scene.gaze is not None:
        gaze = PlacedGaze(load_gaze(scene.gaze, namespace(mi.Float))[0])
    make = None if gaze is None else lookers_of_field(gaze, target.place, target.settings)
    _last.append(_Ready(scene.digest, variant, target, make))
    return _last[0]
