"""What light comes from behind a field: from shapes, lit by a nested integrator or in their plain albedo, or from the
background."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr

from nerg_mi.errors import NergError
from nerg_mi.maths.types import Bool, Color, Float, Ray3f

from .place import View

if TYPE_CHECKING:
    import mitsuba as mi


class Shading:
    """``nested``: a Mitsuba sampling integrator that lights the shapes, or None: ``path`` where the scene has emitters
    and shapes, otherwise every shape shows its albedo.

    Raises ``NergError`` for integrators whose radiance is not to be had ray by ray.
    """

    def __init__(self, nested: mi.SamplingIntegrator | None = None):
        import mitsuba as mi

        # By name: each change of variant makes that class anew.
        whole = nested is not None and any(c.__name__ == "ADIntegrator" for c in type(nested).__mro__)
        if whole or not (nested is None or isinstance(nested, mi.SamplingIntegrator)):
            raise NergError(
                f'the integrator nested in "nerg" is a {type(nested).__name__}, which cannot be asked for the radiance '
                'of one ray; use "path", "direct", "volpath" or another one that samples pixels'
            )
        self.nested, self._path = nested, None

    def radiance(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        ray: Ray3f,
        medium: mi.Medium | None,
        view: View,
        background: Color,
        hide_emitters: bool,
        active: Bool,
    ) -> tuple[Color, list[Float], Bool]:
        """``(radiance, AOVs of the nested integrator, shown)`` from behind the field, or from a place without one.

        Radiance is a linear spectrum of the variant in use. ``medium``: Mitsuba's, that the camera stands in (or None);
        ``view``: of ``ray``; ``background``: radiance where nothing is, if the scene has no environment; ``shown``:
        whether there is anything but that background, as a nested integrator says or an environment makes it.
        Derivatives are those of the nested integrator, or of the albedo; ``path`` has none.
        """
        import mitsuba as mi

        seen = active & (view.front < 1)
        environment = None if hide_emitters else scene.environment()
        if self.nested is not None:
            color, valid, aovs = self.nested.sample(scene, sampler, ray, medium, seen)
            if environment is None:
                # Directly seen emitters are shapes; where there is nothing at all, there is the background.
                color = dr.select(view.hit | valid, color, background)
            return color, aovs, seen & valid
        behind = background if environment is None else environment.eval(_beyond(mi, ray), seen)
        shown = active & (view.hit | (environment is not None))
        if view.cast is None:
            return behind, [], shown
        hit = seen & view.hit
        if len(scene.emitters()) > 0:
            # Paths are not differentiated: Dr.Jit has no reverse mode through their loop.
            with dr.suspend_grad():
                self._path = self._path or mi.load_dict({"type": "path", "hide_emitters": bool(hide_emitters)})
                shape = self._path.sample(scene, sampler, ray, None, hit)[0]
        else:
            si = view.cast.compute_surface_interaction(mi.Ray3f(ray), mi.RayFlags.All, hit)
            shape = si.bsdf().eval_diffuse_reflectance(si, hit)
        return dr.select(hit, shape, behind), [], shown

    def aov_names(self) -> list[str]:
        """Names of the AOVs that the nested integrator adds."""
        return [] if self.nested is None else list(self.nested.aov_names())


def _beyond(mi: Any, ray: Ray3f) -> Any:
    """What of an interaction an environment asks for, where ``ray`` meets nothing."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wi, si.wavelengths = -ray.d, ray.wavelengths
    return si
