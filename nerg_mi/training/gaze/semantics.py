"""What a gaze field takes over from a radiance field: its features along the observers' rays, or its weights to begin
with.

The paper's semantic variants, and its two initialisations: a trunk that starts as the radiance field's, frozen or
fine-tuned.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_product import GazeConfig
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.training.geometry.places import GazePlace
from nerg_mi.transport.field_medium import FieldMedium, accumulated, snapshot
from nerg_mi.transport.geometry import Place, default_settings

BATCH = 1 << 18
"""Rays whose features are computed in one launch."""


def semantic_features(
    place: GazePlace, origins: np.ndarray, directions: np.ndarray, distance: np.ndarray, kind: str
) -> np.ndarray:
    """Features (N, F), float16, of what rays see: ``accumulated`` along them, or the ``snapshot`` at ``distance`` (N,).

    ``origins``, ``directions`` (N, 3) in the frame of ``place``, unit. Raises `NergError` for a place that is no
    radiance field.
    """
    import mitsuba as mi

    medium = place.medium
    if not isinstance(medium, FieldMedium):
        raise NergError("semantic features are those of a radiance field; give one with --field")
    out = np.empty((len(origins), medium.feature_count), np.float16)
    with dr.suspend_grad():
        for a in range(0, len(out), BATCH):
            part = slice(a, a + BATCH)
            columns = lambda v, part=part: np.ascontiguousarray(np.asarray(v[part], np.float32).T)
            o: Any = mi.Point3f(columns(origins))
            d: Any = mi.Vector3f(columns(directions))
            if kind == "snapshot":
                t = mi.Float(np.ascontiguousarray(distance[part], np.float32))
                found = snapshot(medium, o + d * t, mi.Bool(True))
            else:
                found = accumulated(Place(medium), mi.Ray3f(o, d), mi.Bool(True), default_settings(medium))
            # At once: each by itself would march, or evaluate the network, again.
            dr.eval(found)
            out[part] = np.stack([np.array(f) for f in found], axis=-1)
    return out


def trunk_config(config: GazeConfig, radiance: RadianceConfig) -> GazeConfig:
    """``config`` with the sizes that let its trunk begin as that of a radiance field of the configuration
    ``radiance``."""
    return replace(
        config, grid=radiance.grid, width=radiance.width, geometry=radiance.geometry, sh_degree=radiance.sh_degree
    )


def initial_weights(field: RadianceField, config: GazeConfig) -> dict:
    """Grid and position network of ``field`` by the names of a gaze field: what its features, but not its density, come
    from.

    Raises `NergError` where ``config`` has other sizes.
    """
    like = trunk_config(config, field.config)
    if (config.grid, config.position_sizes) != (like.grid, like.position_sizes):
        raise NergError("a gaze field that begins with a radiance field's weights must have its sizes")
    weights = [dr.detach(w) for w in field.density_net.weights]
    # The first output is the logarithm of the density.
    weights[-1] = weights[-1][1:, :]
    arrays = {f"grid.{k}": v for k, v in field.grid.named().items()}
    arrays |= {f"position_net.{i}": w for i, w in enumerate(weights)}
    return {k: type(v)(dr.detach(v)) for k, v in arrays.items()}
