"""The product head, emit times capture, in training."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig, encode_direction, encoding_from_parameters
from nerg_mi.fields.gaze_product import GazeConfig, GazeField, activate
from nerg_mi.fields.mlp import MLP
from nerg_mi.fields.radiance import RadianceConfig, RadianceField
from nerg_mi.maths.arrays import sigmoid
from nerg_mi.maths.geometry import AnyBox

from .gaze_data import GazeBatch
from .gaze_recipes import DEFAULT_RECIPE, FieldOptions, Recipe, register_recipe
from .gaze_settings import LOSSES
from .gaze_trainer import GazeTrainer, compute_gaze_loss
from .radiance_losses import stack, unstack

# ---- Product model ----
#
# The gaze field's forward pass in the form that trains fastest: networks as tensor products.
#
# An observer looks in many directions from one position: what capture needs of the position is computed once a probe.


def evaluate_gaze_density(
    config: GazeConfig,
    box: AnyBox,
    parameters: dict,
    p_od: Any,
    p_o: Any,
    r_o: Any,
    ns: ModuleType,
    semantic: list | None = None,
) -> Any:
    """Gaze (1/sr) of B observers ``p_o`` (Array3f, B lanes) along ``r_o`` (Array3f, B * D lanes, D for each) at
    ``p_od``.

    The same maths as ``GazeField.evaluate`` on ``parameters`` spelt as the field spells them. Gradients reach every
    entry that the variant uses. ``semantic``: features (Floats, a lane a direction) where ``config`` wants them.
    """

    def net(name: str) -> MLP:
        count = sum(k.startswith(name + ".") for k in parameters)
        return MLP([parameters[f"{name}.{i}"] for i in range(count)])

    grid = encoding_from_parameters(config.grid, parameters, mode=dr.ReduceMode.Expand)
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


def select_trainable_parameters(config: GazeConfig, parameters: dict) -> dict:
    """Those of ``parameters`` that the variant evaluates; the rest would only decay."""
    idle = {"emit": "capture_head", "capture": "emit_head"}.get(config.variant)
    return {k: v for k, v in parameters.items() if idle is None or not k.startswith(idle)}


# ---- Training a gaze field that is a product (equation 1), on the paper's losses ----


class ProductTrainer(GazeTrainer):
    """A run of a ``GazeField``; see ``GazeTrainer``."""

    @classmethod
    def init_from_radiance(cls, radiance: RadianceField, config: GazeConfig) -> tuple[GazeConfig, dict]:
        config = match_trunk_config(config, radiance.config)
        return config, extract_initial_weights(radiance, config)

    @classmethod
    def configure_features(cls, radiance: RadianceField, config: GazeConfig) -> GazeConfig:
        return replace(config, geometry=radiance.config.geometry)

    def init_field(self) -> GazeField:
        return GazeField.random(self.config, self.box, self.ns, self.settings.seed)

    def select_trainable(self, parameters: dict) -> dict:
        return select_trainable_parameters(self.config, parameters)

    def backward(self) -> None:
        s, data = self.settings, self.data
        count, D = min(s.probes, data.num_observers), min(s.directions, data.num_directions)
        observers = self.rng.choice(data.num_observers, count, replace=False)
        if D < data.num_directions:
            directions = np.argpartition(self.rng.random((count, data.num_directions)), D, axis=1)[:, :D]
        else:
            directions = np.broadcast_to(np.arange(D), (count, D))
        batch = data.gather_batch(observers, directions)
        density = self.evaluate_density(batch, self.current_parameters())
        self.loss = compute_gaze_loss(density, batch.truth, D, **LOSSES[s.loss])
        total = self.loss.total
        if s.integral:
            # Against the truth in the same directions, so that drawing few of them is no bias.
            total += s.integral * dr.mean(dr.square(batch.integrate(density - batch.truth)))
        dr.backward(total)

    def evaluate_density(self, batch: GazeBatch, parameters: dict) -> Any:
        semantic = batch.semantic if self.config.semantic else None
        density = evaluate_gaze_density(self.config, self.box, parameters, batch.p_od, batch.p_o, batch.r_o, self.ns, semantic)
        return batch.condition_on_view(density, batch.truth)

    def validation_objective(self, kld: float, cc: float, mae: float, off: float) -> float:
        w = LOSSES[self.settings.loss]
        return w["kld"] * kld + w["cc"] * (1 - cc) + w["mae"] * mae + self.settings.integral * off


# ---- The paper's two initialisations: a trunk that starts as the radiance field's, frozen or fine-tuned ----


def match_trunk_config(config: GazeConfig, radiance: RadianceConfig) -> GazeConfig:
    """``config`` with the sizes that let its trunk begin as that of a field of the configuration ``radiance``."""
    return replace(
        config, grid=radiance.grid, width=radiance.width, geometry=radiance.geometry, sh_degree=radiance.sh_degree
    )


def extract_initial_weights(field: RadianceField, config: GazeConfig) -> dict:
    """Grid and position network of ``field`` by the names of a gaze field: what its features come from, not its
    density.

    Raises `NergError` where ``config`` has other sizes.
    """
    like = match_trunk_config(config, field.config)
    if (config.grid, config.position_sizes) != (like.grid, like.position_sizes):
        raise NergError("a gaze field that begins with a radiance field's weights must have its sizes")
    weights = [dr.detach(w) for w in field.density_net.weights]
    # The first output is the logarithm of the density.
    weights[-1] = weights[-1][1:, :]
    arrays = {f"grid.{k}": v for k, v in field.grid.named().items()}
    arrays |= {f"position_net.{i}": w for i, w in enumerate(weights)}
    return {k: type(v)(dr.detach(v)) for k, v in arrays.items()}


# ---- Sizes ----
#
# Architectures of a gaze field that is a product (equation 1), by one word, and the scale that they begin with.


# (levels, log2 rows, base and finest resolution, width, geometry features). "paper" has the paper's sizes, 10.6 million
# entries; "small" is what generalises to positions that nobody trained on, and stores in 0.4 MB as fp16.
_SIZES = {"small": (8, 14, 4, 128, 64, 15), "paper": (16, 19, 16, 512, 64, 15)}


def make_gaze_config(size: str = "small", variant: str = "emit_capture", activation: str = "softplus") -> GazeConfig:
    """Architecture of a ``size``: ``small`` or ``paper``. Raises `NergError` for another word."""
    if size not in _SIZES:
        raise NergError(f'size must be one of {", ".join(_SIZES)}, got "{size}"')
    levels, rows, base, finest, width, geometry = _SIZES[size]
    grid = HashGridConfig(levels=levels, log2_rows=rows, base=base, finest=finest)
    return GazeConfig(
        grid=grid,
        variant=variant,
        activation=activation,
        width=width,
        geometry=geometry,
        emit_scale=compute_uniform_scale(variant, activation),
    )


def compute_uniform_scale(variant: str, activation: str) -> float:
    """The ``emit_scale`` with which weights of zero are the uniform density, 1/(4π).

    Networks without biases fall to zero under weight decay. Were that a density of another integral, they would have to
    spend weight on the scale alone, and do: fields that must fight for it follow their probes much less well.
    """
    at_zero = {"softplus": math.log(2.0), "exp": 1.0}.get(activation)
    if at_zero is None:
        return 1.0
    return 1 / (4 * math.pi * at_zero * (0.5 if variant == "emit_capture" else 1.0))


# ---- Recipes ----


def _product(size: str, activation: str) -> Callable[[FieldOptions], GazeConfig]:
    def config(choices: FieldOptions) -> GazeConfig:
        plain = make_gaze_config(choices.size or size, choices.variant, choices.activation or activation)
        if choices.geometry_kind == "none":
            raise NergError(
                "a gaze field of this recipe needs surfaces; without any geometry only a log density trains, "
                f"such as that of the recipe {DEFAULT_RECIPE}"
            )
        return replace(
            plain, normalized=choices.normalized, semantic=choices.semantic, semantic_own=choices.semantic_own
        )

    return config


_OF_PRODUCTS = frozenset({"activation", "size", "normalized", "semantic", "begin", "loss", "integral"})

register_recipe(
    Recipe(
        name="small",
        summary="emit times capture on a small grid, on the paper's losses and the integral over the sphere",
        make_config=_product("small", "softplus"),
        trainer=ProductTrainer,
        losses=("paper", "code"),
        settings={"steps": 600},
        probes={},
        supported_options=_OF_PRODUCTS,
    )
)
register_recipe(
    Recipe(
        name="paper",
        summary="the paper's networks, losses and probes, as many steps as 50 epochs have",
        make_config=_product("paper", "linear"),
        trainer=ProductTrainer,
        losses=("paper", "code"),
        settings={
            "steps": 12_800,
            "loss": "paper",
            "integral": 0.0,
            "probes": 16,
            "directions": 1024,
            "learning_rate": 1e-3,
            "lr_final_ratio": 0.1,
            "lr_hold_fraction": 0.0,
            "weight_decay": 0.0,
        },
        # Bandwidth and least number of rays are those of the authors' code.
        probes={
            "radius": 0.1,
            "count": 4096,
            "cap": 1024,
            "kappa_rule": "silverman",
            "directions": 1024,
            "min_rays": 8,
        },
        supported_options=_OF_PRODUCTS,
    )
)
