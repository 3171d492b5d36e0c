"""The work of a bake of Gaussian splats in parts: as `chunks`, of files alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.mlp import namespace
from nerg_mi.fields.splats import Splats
from nerg_mi.formats.fields import load_gaze
from nerg_mi.formats.splats import read_splats
from nerg_mi.surfaces.laplacian import Sums
from nerg_mi.surfaces.mesh import SURFACE_OPACITY
from nerg_mi.surfaces.sources import Crowd, MakeLooker, RaySettings, TrackedRays, lookers_of_field
from nerg_mi.surfaces.splats import gaze_and_escaped, shortest_axes, splat_densities, splat_ray_sums
from nerg_mi.tasks.engines import prepare_once
from nerg_mi.transport.geometry import Place, default_settings
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_gaze import PlacedGaze
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium


@dataclass(frozen=True, eq=False)
class SplatScene:
    """All that a part needs to know besides who looks; it can be pickled, and refers to files: ``splats``, of which
    there are ``count``, and the checkpoint of the ``gaze`` field, or None. ``cone``: standard deviation in radian of
    that through which the field's gaze is seen."""

    splats: Path
    count: int
    gaze: Path | None = None
    cone: float = 0.0
    of_rays: RaySettings = field(default_factory=RaySettings)

    @property
    def nothing(self) -> Sums:
        """Of nobody."""
        return Sums.none(2 * self.count, 0)

    def sums(self, part: Crowd | TrackedRays) -> Sums:
        """Partial sums of the observers, or of the rays, of ``part``: ``face`` is, of rays, shares of gaze on the sides
        of the Gaussians, and of observers densities of theirs, which are no part of ``total``. A variant must be
        active; what is loaded is kept for the next part. Raises `NergError`."""
        there, make = prepare_once(self, self._loaded)
        if isinstance(part, TrackedRays):
            return splat_ray_sums(there.arrays, there.axes, part, self.of_rays)
        if make is None:
            raise NergError("there is no gaze field: name one by --gaze, or take the gaze of the rays, --from rays")
        sums = self.nothing
        for k, weight in enumerate(part.weights.tolist()):
            eye = part.positions[k : k + 1]
            # What is known of an observer is needed twice, and made once.
            looker = make(eye[0])
            densities = splat_densities(
                there.splats, there.place, lambda _, own=looker: own, eye, np.array([weight]), there.settings, self.cone
            )
            total, escaped = gaze_and_escaped(there.arrays, looker, eye[0], self.cone)
            sums = sums.plus(Sums(densities.ravel(), np.zeros(0), 0.0, weight * escaped, weight * total, weight, 1))
        return sums

    def _loaded(self) -> tuple[SplatPlace, MakeLooker | None]:
        import mitsuba as mi

        there = splat_place(read_splats(self.splats))
        if self.gaze is None:
            return there, None
        gaze = PlacedGaze(load_gaze(self.gaze, namespace(mi.Float))[0])
        return there, lookers_of_field(gaze, there.place, there.settings)


@dataclass(frozen=True, eq=False)
class SplatPlace:
    """Splats as they are traced: ``arrays`` of them in a ``place``, with ``settings``, and their shortest ``axes``
    (N, 3)."""

    splats: Splats
    arrays: SplatArrays
    place: Place
    settings: ObserverSettings
    axes: np.ndarray

    @property
    def tolerance(self) -> float:
        """How far apart two ideas of one surface may be, as of `ObserverSettings.tolerance`."""
        return 2 * self.settings.march.step


def splat_place(splats: Splats) -> SplatPlace:
    """That of ``splats``, in the variant in use."""
    import mitsuba as mi

    arrays = SplatArrays(splats, namespace(mi.Float))
    place = Place(SplatMedium(arrays))
    settings = ObserverSettings(march=default_settings(place), surface_opacity=SURFACE_OPACITY)
    return SplatPlace(splats, arrays, place, settings, shortest_axes(splats))
