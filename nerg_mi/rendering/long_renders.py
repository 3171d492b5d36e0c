"""What pays only where many samples are rendered of one scene: kernels that know the weights of its fields."""

from __future__ import annotations

from typing import Any

from nerg_mi.field.constant_weights import set_constant_weights

SAMPLES = 1 << 27
"""From so many on a render is long: 146 pictures of 1280 x 720. Each takes about a tenth less time then, from the
scene to the file, and the compilation some five seconds, once."""


def prepare_for(samples: int, scene: Any) -> bool:
    """Make ready ``scene``, whose integrator may be ``nerg``, for so many ``samples``, without a change of what it
    shows; whether there was anything to do."""
    if samples < SAMPLES:
        return False
    fields = [getattr(volume, "field", None) for volume in getattr(scene.integrator(), "children", {}).values()]
    found = [field for field in fields if hasattr(field, "parameters")]
    for field in found:
        set_constant_weights(field)
    return bool(found)
