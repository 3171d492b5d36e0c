"""The integrator :ref:`nerg <integrator-nerg>` asked for other AOVs than its own parameters name, along any rays, and
for many observers of the same rays."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from nerg_mi.transport import observer
from nerg_mi.transport.observer import ObserverCache

from . import nerg_aovs, nerg_properties
from .nerg_pixel import Pixel


class Asked:
    """In place of the integrator ``nerg`` for a `Pixel`: but for what is asked, and who looks, all is the integrator's.

    ``aovs``: names; ``radiance``: whether colour is asked for. Raises ``NergError`` for AOVs that it cannot compute.
    ``own``: those of them that depend on the observer; ``shared``: the others.
    """

    def __init__(self, nerg, aovs: Sequence[str], radiance: bool):
        self._nerg, self.radiance = nerg, radiance
        self.aovs = nerg_aovs.read_aovs(",".join(aovs), nerg)
        self.own = [name for name in self.aovs if nerg_aovs.AOVS[name].of_observer]
        self.shared = [name for name in self.aovs if name not in self.own]
        self.demands = nerg_aovs.demands_of(self.aovs)
        self.views = nerg_properties.views_of(self.aovs, nerg.children, nerg.gaze)
        # Who looks is said with each pixel.
        self.observer = None

    def __getattr__(self, name: str):
        return getattr(self._nerg, name)

    def channels(self, aovs: Sequence[str]) -> list[str]:
        """Names of the channels of some of the AOVs."""
        return nerg_aovs.channel_names(aovs, self.medium)

    def pixel(self, scene, sensors: list, sampler, ray, active) -> AskedPixel:
        """What rays of ``sensors`` meet. Raises ``NergError`` for a scene with nothing in it."""
        self.check_place(scene)
        offset = sampler.next_1d(active) if self.jitter else None
        return AskedPixel(self, scene, sensors, ray, active, offset)

    def watcher(self, position: Sequence[float], alone: bool = False) -> Watcher:
        """An observer at ``position`` (3,). ``alone``: the only one, whom the integrator remembers."""
        return Watcher(self, position, alone)


class AskedPixel(Pixel):
    """A pixel whose AOVs are computed in parts: those that observers have in common, and those of each."""

    def channels(self, aovs: Sequence[str]) -> list:
        """All channels of some of the AOVs that were asked for."""
        return nerg_aovs.compute(list(aovs), self)

    def for_origins(self) -> AskedPixel:
        """The same rays, each for an observer at its own origin: of fields that need not be normalised for them."""
        return self.for_observer(self.camera_ray.o, [], True, ObserverCache())

    def settle(self, *more) -> None:
        """Compute now what observers have in common, and ``more``, so that their kernels begin with it."""
        rays = [self.camera_ray.o, self.ray.o, self.ray.d]
        common = [*rays, self.active, self.depth, self.surface, self.p_d, self.penetration]
        if self.counting and self.view.march is not None:
            common.append(self.view.march.density_evals)
        dr.eval(common, more)


class Watcher:
    """An observer of pixels. What is known of them is made once and kept for as long as the watcher lives, and their
    integral for as long as the integrator remembers it."""

    def __init__(self, asked: Asked, position: Sequence[float], alone: bool):
        self.p_o = mi.Point3f(*map(float, position))
        # A position that is a constant of the kernel would be compiled anew for every observer.
        dr.make_opaque(self.p_o)
        self._cache = asked.cache if alone else ObserverCache(numbers=asked.cache)
        self._has_gaze, self._gaze = "gaze" in asked.demands, None

    def pixel(self, pixel: AskedPixel) -> AskedPixel:
        """The same rays, for this observer."""
        aligned = observer.same_center(pixel.sensors, self.p_o)
        return self._watched(pixel, aligned)

    def own_pixel(self, pixel: AskedPixel) -> AskedPixel:
        """The same rays, which all begin where this observer stands."""
        return self._watched(pixel, True)

    def _watched(self, pixel: AskedPixel, aligned: bool) -> AskedPixel:
        mine = pixel.for_observer(self.p_o, [self.p_o], aligned, self._cache)
        if self._has_gaze:
            self._gaze = self._gaze or mine.gaze
            mine.gaze = self._gaze
        return mine
