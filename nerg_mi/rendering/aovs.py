"""Rendering AOVs that the integrator of a scene may lack, and what pays only for many samples of one scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.fields.mlp import set_constant_weights
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.transport.field_medium import FieldMedium

from .bands import Channels, channels_of, render_bands, why_whole

# ---- Asked ----
#
# The integrator `nerg` of a scene asked for AOVs that its own list may lack, for the scene's own observer.


class AskedLayer:
    """What is rendered in place of a scene's own picture (`layers.Layers`): colour, and the AOVs ``names_asked``.

    Raises `NergError` for those that ``integrator``, a `nerg`, cannot compute.
    """

    def __init__(self, integrator: Any, sensor: Any, names_asked: Sequence[str]):
        self._sensor, self._context = sensor, integrator.for_aovs(names_asked, True)
        self.names = [self._context.channels(self._context.aovs)]
        self.count = len(self.names[0])

    def sample(self, scene: Any, sampler: Any, ray: Any, medium: Any, active: Any) -> Iterable[tuple]:
        camera = self._context.trace(scene, [self._sensor], sampler, ray, active)
        channels = camera.for_observer().channels(self._context.aovs)
        radiance, shown, _ = camera.radiance(scene, sampler, medium)
        return [(radiance, shown, channels)]


def is_nerg(integrator: Any) -> bool:
    """Whether an integrator, or None, is `nerg`: by name, since each change of variant makes that class anew."""
    return type(integrator).__name__ == "NergIntegrator"


def nerg_of(path: Path, scene: Any) -> Any:
    """The integrator of ``scene``, which was read from ``path``. Raises `NergError` where it is not `nerg`."""
    integrator = scene.integrator()
    if not is_nerg(integrator):
        kind = "none" if integrator is None else f'"{integrator.class_name()}"'
        raise NergError(
            f'an overlay needs the integrator "nerg", and "{path}" has {kind}; "nerg scene {path} -o new.xml" writes '
            "one around it"
        )
    return integrator


def render_asked(
    path: Path,
    scene: Any,
    sensor: Any,
    names: Sequence[str],
    spp: int = 0,
    seed: int = 0,
    on_strip: Callable[[int, int], None] | None = None,
) -> Channels:
    """Colour and the AOVs ``names`` of what ``sensor`` sees of ``scene``, which was read from ``path``.

    Raises `NergError` for a scene whose integrator is not `nerg`, for AOVs that this cannot compute, and for pictures
    that are made in one piece only (`bands.why_whole`).
    """
    integrator = nerg_of(path, scene)
    reason = why_whole(scene, sensor)
    if reason is not None:
        raise NergError(f'"{path}" cannot be rendered with an overlay because of {reason}; choose another sensor')
    layer = AskedLayer(integrator, sensor, names)
    (band,) = render_bands(scene, sensor, spp=spp, seed=seed, on_strip=on_strip, layers=layer)
    return channels_of(band.film, layer.names[0])


# ---- Long renders ----
#
# What pays only where many samples are rendered of one scene: kernels that know the weights of its fields.


SAMPLES = 1 << 27
"""From so many on a render is long: 146 pictures of 1280 x 720 pay for some seconds of compilation many times."""


def prepare_for(samples: int, scene: Any) -> bool:
    """Make ready ``scene`` for so many ``samples``, without a change of what it shows; whether there was anything to
    do."""
    integrator = scene.integrator()
    if samples < SAMPLES or not is_nerg(integrator):
        return False
    found = fields_of(integrator)
    for field in found:
        set_constant_weights(field)
    return bool(found)


def fields_of(integrator: Any) -> list[RadianceField | AnyGazeField]:
    """The trained fields of an integrator `nerg`, those that it has: of its radiance, of its gaze."""
    medium, gaze = integrator.medium, integrator.gaze
    found: list[RadianceField | AnyGazeField] = [medium.field] if isinstance(medium, FieldMedium) else []
    return found if gaze is None else [*found, gaze.field]
