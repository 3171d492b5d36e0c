"""What pays only where many samples are rendered of one scene: kernels that know the weights of its fields."""

from __future__ import annotations

from typing import Any

from nerg_mi.fields.constant_weights import set_constant_weights
from nerg_mi.fields.gaze_base import AnyGazeField
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.transport.field_medium import FieldMedium

from .asked import is_nerg

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
