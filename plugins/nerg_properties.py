"""Reading the parameters of :ref:`nerg <integrator-nerg>`."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi

from nerg_mi.errors import NergError
from nerg_mi.properties import boolean, choice, color, integer, number, vector
from nerg_mi.ranges import COORDINATES, FARTHEST, VALUES, Range
from nerg_mi.transport.depth import DEPTHS
from nerg_mi.transport.geometry import Ceiling
from nerg_mi.transport.march_primal import MarchSettings, default_growth, default_step, default_stop
from nerg_mi.transport.medium import Medium
from nerg_mi.transport.observer import VISIBILITIES, ObserverSettings, center, require_center
from nerg_mi.transport.observer_gaze import PlacedGaze
from nerg_mi.transport.quadrature import RULES, boundaries
from nerg_mi.transport.volume_medium import KnownEmpty, VolumeMedium

TEXTS = {
    "ceiling": "Height above which a place is left out of what cameras see from above it, so that a roof hides no "
    "room: rays that start higher begin where they come below it; depths still count from the camera. What observers "
    "see is not cut. (Default: none)",
    "apart": "How far apart the camera's and the observer's idea of a surface may be, in scene units; 0 stands "
    "for two march steps, or, without a field, for 1e-4 of the scene's diagonal (or of twice the larger distance of "
    "surface and observer from the origin, if that is less: a far-away sky dome does not blunt shadows). The "
    "point that the observer looks for lies this far, and as far as light goes into the surface (at most a 64th "
    "of the depth), in front of the camera's surface, so that no surface hides itself. More than 1e18 counts as "
    "that.",
    "integral_tolerance": "Error of that integral, as a share of it, below which fewer directions will do: told by the "
    "scatter of parts of the sum, which tells more than there is as a rule. 0: always as many; so it is, too, in what "
    "``dr.freeze`` records.",
    "dt_gamma": "Steps are at least this share of the distance travelled: for wide views, whose far parts need no "
    "short steps. (Default: 0, i.e. uniform steps; for a field without an end that which it was trained with)",
    "stop": "Transmittance below which what lies behind is left out: what then lacks of an expected depth is 16 times "
    "that, in mean free paths.",
    "refined": "Skip the parts of a field's occupied cells in which nothing was found when it was trained or refined "
    "(``nerg refine``); false: only its empty cells.",
}


def complete(manual: str) -> str:
    """The ``manual`` with the kinds of depth and of quadrature that are registered, and what else is said here."""
    texts = {"quadratures": RULES.manual(), "depths": DEPTHS.manual(), **TEXTS}
    for name, text in texts.items():
        manual = manual.replace(f"{{{name}}}", text)
    return manual


def read_children(props) -> dict:
    """The objects that ``props`` names, or None, and the nested ``integrator``. Raises ``NergError`` for one that is
    not what its name asks for."""
    found = {name: props.get(name, None) for name in ("field", "density", "color", "gaze", "kde", "observer")}
    if found["gaze"] is not None and not hasattr(found["gaze"], "placed_gaze"):
        raise NergError('"gaze" must be a volume of type "gazefield"')
    if found["kde"] is not None and not hasattr(found["kde"], "kde_view"):
        raise NergError('"kde" must be a volume of type "gazekde"')
    if found["observer"] is not None and not isinstance(found["observer"], mi.Sensor):
        raise NergError('"observer" must be a sensor; its to_world places the observer')
    return found | {"integrator": _nested(props)}


def _nested(props):
    found = [(name, child) for name, child in props.objects() if isinstance(child, mi.Integrator)]
    for name, _ in found:
        props.mark_queried(name)
    if len(found) > 1:
        raise NergError(f'"nerg" takes one nested integrator, got {len(found)}')
    return found[0][1] if found else None


def check_observer(observer) -> None:
    """Raise ``NergError`` for an observer (a sensor, or None) who stands nowhere, or too far away."""
    if observer is not None:
        require_center(observer, '"observer"')
        if not dr.all(dr.abs(dr.detach(center(observer))) <= FARTHEST, axis=None):
            raise NergError(
                f'"observer" stands at a position that is not finite, or beyond {FARTHEST:g}; correct its to_world'
            )


def medium_of(children: dict) -> tuple[Medium | None, KnownEmpty | None]:
    """What is marched: the ``field``, or ``density`` and ``color``, or nothing; and what of the latter is skipped."""
    field, density, paint = (children[name] for name in ("field", "density", "color"))
    if field is not None and density is not None:
        raise NergError('"nerg" takes either "field" (a volume of type "nerf") or "density" (any volume), and not both')
    if field is not None:
        if paint is not None:
            raise NergError('"color" goes with "density"; a "field" brings its own colour')
        if not hasattr(field, "medium"):
            raise NergError(
                '"field" must be a volume of type "nerf" or "splats"; give other volumes as "density" and "color"'
            )
        return field.medium(), None
    if density is None:
        if paint is not None:
            raise NergError('"color" goes with "density", which is missing')
        return None, None
    for name, volume in (("density", density), ("color", paint)):
        if volume is not None and not isinstance(volume, mi.Volume):
            raise NergError(f'"{name}" must be a volume')
    medium = VolumeMedium(density, paint)
    return medium, KnownEmpty(medium)


def gaze_of(children: dict, medium: Medium | None) -> PlacedGaze | None:
    """The gaze field, whose features the medium must have."""
    if children["gaze"] is None:
        return None
    gaze = children["gaze"].placed_gaze()
    wanted, given = gaze.field.config.features, None if children["field"] is None else medium
    if wanted and (given is None or given.feature_count != wanted):
        has = "there is none" if given is None else f"that has {given.feature_count}"
        raise NergError(f'the "gaze" field asks for {wanted} semantic features of a "field", but {has}')
    return gaze


def march_settings(props, medium: Medium | None) -> MarchSettings:
    """Of the camera's and the observer's rays."""
    step = number(props, "step", 0, Range(0, FARTHEST))
    settings = MarchSettings(
        step=step or default_step(medium),
        dt_gamma=number(props, "dt_gamma", default_growth(medium), Range(0, 1)),
        stop=number(props, "stop", default_stop(medium), Range(0, 1)),
        color_cutoff=number(props, "color_cutoff", MarchSettings.color_cutoff, Range(0, 1)),
        quadrature=choice(props, "quadrature", MarchSettings.quadrature, RULES.names()),
        coarse=number(props, "coarse", MarchSettings.coarse, Range(1, 1e6)),
        refined=boolean(props, "refined", MarchSettings.refined),
        cell_step=step or math.inf,
    )
    if medium is not None:
        boundaries(RULES.find(settings.quadrature), medium)
    return settings


def observer_settings(props, march: MarchSettings) -> ObserverSettings:
    """Of the surfaces, and of what the observer sees of them."""
    defaults = ObserverSettings(march=march)
    return ObserverSettings(
        march=march,
        depth=choice(props, "depth", defaults.depth, DEPTHS.names()),
        surface_opacity=number(props, "surface_opacity", defaults.surface_opacity, Range(0, 1)),
        visibility=choice(props, "visibility", defaults.visibility, VISIBILITIES),
        tolerance=number(props, "tolerance", defaults.tolerance, Range(0, VALUES.high)),
        map_height=integer(props, "map_height", defaults.map_height, Range(2, 16384)),
        directions=integer(props, "directions", defaults.directions, Range(64, 1 << 24)),
        integral_tolerance=number(props, "integral_tolerance", defaults.integral_tolerance, Range(0, 1)),
    )


def ceiling_of(props) -> Ceiling | None:
    """What is left out of views from above."""
    up = vector(props, "up", (0.0, 0.0, 1.0))
    return Ceiling(number(props, "ceiling", 0, COORDINATES), up) if "ceiling" in props else None


def background_of(props):
    """Radiance (Spectrum) behind everything."""
    background = mi.Color3f(color(props, "background", 0.0))
    return mi.Spectrum(mi.luminance(background) if mi.is_monochromatic else background)


def describe(nerg) -> str:
    """The integrator ``nerg`` with all its parameters, for people."""
    body: dict[str, Any] = {
        k: str(v).replace("\n", "\n  ") for k, v in nerg.children.items() if k not in ("observer", "integrator")
    }
    if nerg.observer is not None:
        body["observer"] = center(nerg.observer)
    march, seen = nerg.settings, nerg.observer_settings
    body |= {
        "occlusion": nerg.occlusion,
        "visibility": seen.visibility,
        "falloff": nerg.falloff,
        "tolerance": seen.tolerance or "2 steps",
        "map_height": seen.map_height,
        "directions": seen.directions,
        "integral_tolerance": seen.integral_tolerance,
        "depth": seen.depth,
        "surface_opacity": seen.surface_opacity,
        "radiance": nerg.radiance,
        "ceiling": "none" if nerg.ceiling is None else nerg.ceiling,
        "aovs": ",".join(nerg.aovs),
        "quadrature": march.quadrature,
        "step": march.step,
        "coarse": march.coarse,
        "dt_gamma": march.dt_gamma,
        "stop": march.stop,
        "color_cutoff": march.color_cutoff,
        "refined": march.refined,
        "jitter": nerg.jitter,
    }
    return "NergIntegrator[\n" + "".join(f"  {k} = {v},\n" for k, v in body.items()) + "]"


class Pose(mi.TraversalCallback):
    """Shows the pose of a sensor as what it is to us. Mitsuba calls it not differentiable, as silhouettes are not."""

    def __init__(self, cb, prefix):
        super().__init__()
        self.cb, self.prefix = cb, prefix

    def put(self, name, value, flags, *kind):
        if name == "to_world":
            self.cb.put(self.prefix + name, value, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous, *kind)
