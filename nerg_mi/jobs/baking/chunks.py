"""The work of a bake in parts: a scene's description and some of its observers, or rays, give partial sums.

A part is a plain function of what it is given: it may be computed anywhere, any number of times, with the same result.
Parts are cut by numbers of this module, not by the machine, and their sums are added in the order of the parts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.formats.fields import load_gaze
from nerg_mi.rendering.aovs import is_nerg
from nerg_mi.rendering.scene import load_scene
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
from nerg_mi.tasks.engines import prepare_once
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

    def sums(self, part: Crowd | TrackedRays) -> Sums:
        """Partial sums of the observers, or of the rays, of ``part``. A variant must be active; what is loaded is kept
        for the next part. Raises `NergError`."""
        target, make = prepare_once(self, self._loaded)
        if isinstance(part, TrackedRays):
            return ray_sums(target, part, self.of_rays)
        if make is None:
            raise NergError("there is no gaze field: name one by --gaze, or take the gaze of the rays, --from rays")
        return gaze_sums(target, make, part.positions, part.weights, self.of_gaze)

    def _loaded(self) -> tuple[Target, MakeLooker | None]:
        import mitsuba as mi

        medium, settings, falloff, gaze = None, None, 0.0, None
        if self.scene is not None:
            integrator: Any = load_scene(self.scene).integrator()
            if is_nerg(integrator):
                medium, gaze = integrator.medium, integrator.gaze
                settings, falloff = integrator.observer_settings, float(np.ravel(np.array(integrator.falloff))[0])
        target = Target(self.mesh, list(self.others), medium, settings if medium is not None else None, falloff)
        if self.gaze is not None:
            gaze = PlacedGaze(load_gaze(self.gaze, namespace(mi.Float))[0])
        return target, None if gaze is None else lookers_of_field(gaze, target.place, target.settings)


def parts_of(who: Crowd | TrackedRays) -> Iterator[Crowd | TrackedRays]:
    """``who`` in parts, always the same."""
    if isinstance(who, TrackedRays):
        for a in range(0, len(who), RAYS):
            yield who.part(a, a + RAYS)
        return
    for a in range(0, len(who.weights), OBSERVERS):
        yield Crowd(who.positions[a : a + OBSERVERS], who.weights[a : a + OBSERVERS])
