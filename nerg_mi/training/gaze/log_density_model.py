"""The log-density gaze field's forward pass in the form that trains fastest: networks as tensor products."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr

from nerg_mi.fields.encoding import Encoding, encoding_of
from nerg_mi.fields.gaze_log_density import LogGazeConfig, LogGazeField
from nerg_mi.fields.gaze_product import softplus
from nerg_mi.fields.mlp import MLP
from nerg_mi.maths.geometry import AnyBox
from nerg_mi.training.radiance.model import stack


def log_gaze(
    config: LogGazeConfig, box: AnyBox, parameters: dict, p_od: Any, p_o: Any, r_o: Any, escaped: Any, ns: ModuleType
) -> Any:
    """Log of the unnormalised density of B observers ``p_o`` (Array3f, B lanes) along ``r_o`` (Array3f, B * D lanes, D
    for each in turn) at ``p_od``, ``escaped`` (Bool, as many) where there is no surface.

    The logarithm of what ``LogGazeField.unnormalized`` multiplies, on ``parameters`` spelt as the field spells them;
    gradients reach every entry that the variant uses.
    """
    net = lambda name: MLP([parameters[f"{name}.{i}"] for i in range(config.layers + 1)])
    # The field's own inputs.
    field = _Inputs(config, box, encoding_of(config.grid, parameters, mode=dr.ReduceMode.Expand), parameters["prior"])
    repeats = dr.width(r_o) // dr.width(p_o)
    logit = field.log_blind(r_o)
    each = dr.gather(type(p_o), p_o, dr.arange(ns.UInt32, dr.width(r_o)) // repeats)
    if config.variant != "capture":
        inputs = field.emit_inputs(p_od, each, r_o)
        emit = net("emit_net").tensor(stack(_full(inputs, r_o), ns)).array
        logit = logit + (
            emit
            if config.escaped == "nearest"
            else dr.select(
                escaped,
                dr.gather(
                    ns.Float, parameters["escaped"], dr.zeros(ns.UInt32, dr.width(r_o)), mode=dr.ReduceMode.Expand
                ),
                emit,
            )
        )
    if config.variant != "emit":
        position = [dr.repeat(v, repeats) for v in field.capture_position(p_o)]
        x = net("capture_net").tensor(stack(_full(field.capture_inputs(position, r_o), r_o), ns)).array
        logit = logit - softplus(-x)
    return logit


class _Inputs(LogGazeField):
    """The part of a field that has no networks."""

    def __init__(self, config: LogGazeConfig, box: AnyBox, grid: Encoding, prior: Any):
        self.config, self.box, self.grid, self.prior = config, box, grid, prior


def _full(rows: list, like: Any) -> list:
    """``rows`` of as many lanes as ``like``: constants have one."""
    return [r + dr.zeros(type(r), dr.width(like)) if dr.width(r) == 1 else r for r in rows]


def used_parameters(config: LogGazeConfig, parameters: dict) -> dict:
    """Those of ``parameters`` that are trained: the blind density is not, and nothing that the variant leaves out."""
    idle = {"emit": ("capture_net",), "capture": ("emit_net", "grid", "escaped")}.get(config.variant, ())
    if config.escaped == "nearest":
        idle += ("escaped",)
    return {k: v for k, v in parameters.items() if k != "prior" and not k.startswith(idle or ("-",))}
