"""The product head, emit times capture, in training."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.fields.encoding import encode_direction, encoding_of
from nerg_mi.fields.gaze_product import GazeConfig, GazeField, activate
from nerg_mi.fields.mlp import MLP
from nerg_mi.maths.arrays import sigmoid
from nerg_mi.maths.geometry import AnyBox

from .gaze_data import Batch
from .gaze_settings import LOSSES, gaze_loss
from .gaze_trainer import GazeTrainer
from .radiance_losses import stack, unstack

# ---- Product model ----
#
# The gaze field's forward pass in the form that trains fastest: networks as tensor products.
#
# An observer looks in many directions from one position: what capture needs of the position is computed once a probe.


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


# ---- Training a gaze field that is a product (equation 1), on the paper's losses ----


class ProductTrainer(GazeTrainer):
    """A run of a ``GazeField``; see ``GazeTrainer``."""

    def untrained(self) -> GazeField:
        return GazeField.random(self.config, self.box, self.ns, self.settings.seed)

    def trainable(self, parameters: dict) -> dict:
        return used_parameters(self.config, parameters)

    def backward(self) -> None:
        s, data = self.settings, self.data
        count, D = min(s.probes, data.count), min(s.directions, data.directions)
        observers = self.rng.choice(data.count, count, replace=False)
        if D < data.directions:
            directions = np.argpartition(self.rng.random((count, data.directions)), D, axis=1)[:, :D]
        else:
            directions = np.broadcast_to(np.arange(D), (count, D))
        batch = data.batch(observers, directions)
        density = self.density(batch, self.current())
        self.loss = gaze_loss(density, batch.truth, D, **LOSSES[s.loss])
        total = self.loss.total
        if s.integral:
            # Against the truth in the same directions, so that drawing few of them is no bias.
            total += s.integral * dr.mean(dr.square(batch.integral(density - batch.truth)))
        dr.backward(total)

    def density(self, batch: Batch, parameters: dict) -> Any:
        semantic = batch.semantic if self.config.semantic else None
        density = gaze_density(self.config, self.box, parameters, batch.p_od, batch.p_o, batch.r_o, self.ns, semantic)
        return batch.given_view(density, batch.truth)

    def judge(self, kld: float, cc: float, mae: float, off: float) -> float:
        w = LOSSES[self.settings.loss]
        return w["kld"] * kld + w["cc"] * (1 - cc) + w["mae"] * mae + self.settings.integral * off
