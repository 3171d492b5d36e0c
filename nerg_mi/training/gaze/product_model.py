"""The gaze field's forward pass in the form that trains fastest: networks as tensor products.

An observer looks in many directions from one position: what capture needs of the position is computed once a probe.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr

from nerg_mi.fields.encoding import encode_direction, encoding_of
from nerg_mi.fields.gaze_product import GazeConfig, activate
from nerg_mi.fields.mlp import MLP
from nerg_mi.maths.arrays import sigmoid
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.training.radiance.model import stack, unstack


def gaze_density(
    config: GazeConfig,
    box: AnyBox,
    parameters: dict,
    p_od: Any,
    p_o: Any,
    r_o: Any,
    ns: ModuleType,
    semantic: list | None = None,
) -> Any:
    """Gaze (1/sr) of B observers ``p_o`` (Array3f, B lanes) along ``r_o`` (Array3f, B * D lanes, D for each in turn) at
    ``p_od``.

    The same maths as ``GazeField.evaluate`` on ``parameters`` spelt as the field spells them. Gradients reach every
    entry that the variant uses. ``semantic``: features (Floats, a lane a direction) where ``config`` wants them.
    """

    def net(name: str) -> MLP:
        count = sum(k.startswith(name + ".") for k in parameters)
        return MLP([parameters[f"{name}.{i}"] for i in range(count)])

    grid = encoding_of(config.grid, parameters, mode=dr.ReduceMode.Expand)
    position, direction = net("position_net"), net("direction_net")
    repeats = dr.width(r_o) // dr.width(p_o)

    def head(name: str, geometry: list, d: Any) -> Any:
        # Every direction of r_o is there, so that stack sees rows of one length.
        hidden = direction.tensor(stack(encode_direction(d, config.sh_degree) + geometry, ns))
        return net(name).tensor(dr.maximum(hidden, 0)).array

    def geometry(p: Any) -> list:
        return unstack(position.tensor(stack(grid(box.to_unit(p)), ns)), ns)

    def surface() -> list:
        if semantic is None:
            return geometry(p_od)
        return [g + s for g, s in zip(geometry(p_od), semantic)] if config.semantic_own else semantic

    gaze = ns.Float(1)
    if config.variant != "capture":
        gaze *= activate(head("emit_head", surface(), -r_o), config.activation) * config.emit_scale
    if config.variant != "emit":
        gaze *= sigmoid(head("capture_head", [dr.repeat(g, repeats) for g in geometry(p_o)], r_o))
    return gaze


def used_parameters(config: GazeConfig, parameters: dict) -> dict:
    """Those of ``parameters`` that the variant evaluates; the rest would only decay."""
    idle = {"emit": "capture_head", "capture": "emit_head"}.get(config.variant)
    return {k: v for k, v in parameters.items() if idle is None or not k.startswith(idle)}
