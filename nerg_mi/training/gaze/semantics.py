"""What a gaze field takes over from a radiance field: its features along the observers' rays, or its weights to begin
with.

The paper's semantic variants, and its two initialisations: a trunk that starts as the radiance field's, frozen or
fine-tuned.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.field.gaze.product import GazeConfig
from nerg_mi.field.radiance import RadianceConfig, RadianceField
from nerg_mi.transport.features import accumulated, snapshot
from nerg_mi.transport.place import as_place
from nerg_mi.transport.trace import default_settings

from .settings import uniform_scale

BATCH = 1 << 18


def semantic_features(medium, origins, directions, distance, kind: str) -> np.ndarray:
    """Features (N, F), float16, of what rays see: ``accumulated`` along them, or the ``snapshot`` at ``distance`` (N,).

    ``medium``: a ``FieldMedium``; ``origins``, ``directions`` (N, 3) in its frame, unit. Raises ``NergError`` for
    another medium.
    """
    import mitsuba as mi

    place = as_place(medium)
    if place.scene is not None or place.medium is None or place.medium.feature_count == 0:
        raise NergError("semantic features are those of a radiance field; give one with --field")
    out = np.empty((len(origins), medium.feature_count), np.float16)
    with dr.suspend_grad():
        for a in range(0, len(out), BATCH):
            part = slice(a, a + BATCH)
            o, d = (
                kind_(np.ascontiguousarray(np.asarray(v[part], np.float32).T))
                for kind_, v in ((mi.Point3f, origins), (mi.Vector3f, directions))
            )
            if kind == "snapshot":
                t = mi.Float(np.ascontiguousarray(distance[part], np.float32))
                found = snapshot(medium, o + d * t, mi.Bool(True))
            else:
                found = accumulated(place, mi.Ray3f(o, d), mi.Bool(True), default_settings(medium))
            # At once: each by itself would march, or evaluate the network, again.
            dr.eval(found)
            out[part] = np.stack([np.array(f) for f in found], axis=-1)
    return out


def config_like(radiance: RadianceConfig, variant: str, activation: str, **more) -> GazeConfig:
    """Architecture of a gaze field whose trunk begins as that of a radiance field of the configuration ``radiance``."""
    return GazeConfig(
        grid=radiance.grid,
        variant=variant,
        activation=activation,
        width=radiance.width,
        geometry=radiance.geometry,
        sh_degree=radiance.sh_degree,
        emit_scale=uniform_scale(variant, activation),
        **more,
    )


def trunk_of(field: RadianceField, config: GazeConfig) -> dict:
    """Grid and position network of ``field`` by the names of a gaze field: what its features, but not its density, come
    from.

    Raises ``NergError`` where ``config`` has other sizes.
    """
    like = config_like(field.config, config.variant, config.activation)
    if (config.grid, config.position_sizes) != (like.grid, like.position_sizes):
        raise NergError("a gaze field that begins with a radiance field's weights must have its sizes")
    weights = [dr.detach(w) for w in field.density_net.weights]
    # The first output is the logarithm of the density.
    weights[-1] = weights[-1][1:, :]
    arrays = {f"grid.{k}": v for k, v in field.grid.named().items()}
    arrays |= {f"position_net.{i}": w for i, w in enumerate(weights)}
    return {k: type(v)(dr.detach(v)) for k, v in arrays.items()}
