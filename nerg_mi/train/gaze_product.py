"""Training of the product gaze field, emit times capture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGrid, HashGridConfig, encode_direction
from nerg_mi.fields.gaze_product import GazeConfig, ProductHead, activate
from nerg_mi.fields.mlp import MLP, stack, unstack
from nerg_mi.fields.radiance import RadianceConfig, RadianceNetwork
from nerg_mi.maths.arrays import sigmoid
from nerg_mi.maths.geometry import AnyBox

from .gaze_data import GazeBatch
from .gaze_recipes import DEFAULT_RECIPE, FieldOptions, Recipe, register_recipe
from .gaze_settings import LOSSES, GazeSettings, ProbeSettings
from .gaze_trainer import GazeTrainer, compute_gaze_loss

# ---- Product model ----
#
# Forward pass with the networks as tensor products, which trains fastest.
#
# Capture's position features are computed once per probe, because its directions share the position.


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
    """Evaluate the gaze density; the same model as ``ProductHead.evaluate``.

    Parameters
    ----------
    config : GazeConfig
        Configuration of the field.
    box : AnyBox
        Bounds of the field.
    parameters : dict
        Parameter arrays by their names in the field. Gradients reach every entry that ``config.variant`` uses.
    p_od : Array3f
        Surface points (B * D lanes).
    p_o : Array3f
        Observer positions (B lanes).
    r_o : Array3f
        Unit vectors from the observers to the surface points (B * D lanes), D for each observer in turn.
    ns : module
        Dr.Jit backend of the arrays, such as ``drjit.llvm.ad``.
    semantic : list of Float, optional
        Radiance-field features (B * D lanes) if ``config`` uses them.

    Returns
    -------
    Float
        Gaze density in 1/sr (B * D lanes).
    """

    def net(name: str) -> MLP:
        count = sum(k.startswith(name + ".") for k in parameters)
        return MLP([parameters[f"{name}.{i}"] for i in range(count)])

    grid = HashGrid.from_parameters(config.grid, parameters, mode=dr.ReduceMode.Expand)
    position, direction = net("position_net"), net("direction_net")
    repeats = dr.width(r_o) // dr.width(p_o)

    def head(name: str, geometry: list, d: Any) -> Any:
        # All rows have the width of r_o, as stack requires.
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


# ---- Training of a product gaze field (equation 1) on the losses of the paper ----


class ProductTrainer(GazeTrainer):
    """Trains a ``ProductHead``; see ``GazeTrainer``."""

    @classmethod
    def init_from_radiance(cls, radiance: RadianceNetwork, config: GazeConfig) -> tuple[GazeConfig, dict]:
        return match_trunk_config(config, radiance.config), extract_initial_weights(radiance)

    @classmethod
    def configure_features(cls, radiance: RadianceNetwork, config: GazeConfig) -> GazeConfig:
        return replace(config, geometry=radiance.config.geometry)

    def init_field(self) -> ProductHead:
        return ProductHead.random(self.config, self.box, self.ns, self.settings.seed)

    def select_trainable(self, parameters: dict) -> dict:
        """Select the ``parameters`` that the variant evaluates. The others would only decay."""
        unused = {"emit": "capture_head", "capture": "emit_head"}.get(self.config.variant)
        return {k: v for k, v in parameters.items() if unused is None or not k.startswith(unused)}

    def draw_batch(self) -> GazeBatch:
        s, data = self.settings, self.data
        count, D = min(s.probes, data.num_observers), min(s.directions, data.num_directions)
        observers = self.rng.choice(data.num_observers, count, replace=False)
        if D < data.num_directions:
            directions = np.argpartition(self.rng.random((count, data.num_directions)), D, axis=1)[:, :D]
        else:
            directions = np.broadcast_to(np.arange(D), (count, D))
        return data.gather_batch(observers, directions)

    def compute_loss(self, batch: GazeBatch) -> Any:
        s, D = self.settings, dr.width(batch.r_o) // dr.width(batch.p_o)
        density = self.evaluate_density(batch, self.current_parameters())
        total = compute_gaze_loss(density, batch.truth, D, **LOSSES[s.loss]).total
        if s.integral_weight:
            # Compare with the truth in the same directions, so that a subset of directions causes no bias.
            total += s.integral_weight * dr.mean(dr.square(batch.integrate(density - batch.truth)))
        return total

    def evaluate_density(self, batch: GazeBatch, parameters: dict) -> Any:
        semantic = batch.semantic if self.config.semantic else None
        density = evaluate_gaze_density(
            self.config, self.box, parameters, batch.p_od, batch.p_o, batch.r_o, self.ns, semantic
        )
        return batch.condition_on_view(density, batch.truth)

    def validation_objective(self, kld: float, cc: float, mae: float, off: float) -> float:
        w = LOSSES[self.settings.loss]
        return w["kld"] * kld + w["cc"] * (1 - cc) + w["mae"] * mae + self.settings.integral_weight * off


# ---- The two initialisations of the paper: a trunk with the weights of the radiance field, frozen or fine-tuned ----


def match_trunk_config(config: GazeConfig, radiance: RadianceConfig) -> GazeConfig:
    """Return ``config`` with the trunk sizes of the radiance-field configuration ``radiance``."""
    return replace(
        config, grid=radiance.grid, width=radiance.width, geometry=radiance.geometry, sh_degree=radiance.sh_degree
    )


def extract_initial_weights(field: RadianceNetwork) -> dict:
    """Return the grid and position network of ``field`` under the parameter names of a gaze field."""
    weights = [dr.detach(w) for w in field.density_net.weights]
    # Drop the first output, which is the log density.
    weights[-1] = weights[-1][1:, :]
    arrays = {f"grid.{k}": v for k, v in field.grid.named().items()}
    arrays |= {f"position_net.{i}": w for i, w in enumerate(weights)}
    return {k: type(v)(dr.detach(v)) for k, v in arrays.items()}


# ---- Sizes ----
#
# Named architectures of a product gaze field (equation 1) and their initial scale.


# (levels, log2 rows, base and finest resolution, width, geometry features). "paper" has the sizes of the paper, 10.6
# million parameters; "small" generalises to held-out positions and takes 0.4 MB as fp16.
_SIZES = {"small": (8, 14, 4, 128, 64, 15), "paper": (16, 19, 16, 512, 64, 15)}


def make_gaze_config(size: str = "small", variant: str = "emit_capture", activation: str = "softplus") -> GazeConfig:
    """Return the architecture of a ``size``, ``small`` or ``paper``. Raises `NergError` for another size."""
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
    """Return the ``emit_scale`` with which zero weights give the uniform density, 1/(4π).

    Weight decay pulls networks without biases towards zero. If zero had another integral, the networks would spend
    their weights on the scale and fit the probes much less well.
    """
    at_zero = {"softplus": math.log(2.0), "exp": 1.0}.get(activation)
    if at_zero is None:
        return 1.0
    return 1 / (4 * math.pi * at_zero * (0.5 if variant == "emit_capture" else 1.0))


# ---- Recipes ----


def _make_product_config(size: str, activation: str) -> Callable[[FieldOptions], GazeConfig]:
    def config(options: FieldOptions) -> GazeConfig:
        base = make_gaze_config(options.size or size, options.variant, options.activation or activation)
        if options.geometry_kind == "none":
            raise NergError(
                "a product gaze field needs surfaces to train on; without geometry use a log-density recipe such as "
                f"{DEFAULT_RECIPE}"
            )
        return replace(
            base, normalized=options.normalized, semantic=options.semantic, semantic_own=options.semantic_own
        )

    return config


_PRODUCT_OPTIONS = frozenset(
    {"activation", "size", "normalized", "semantic", "init_from_field", "loss", "integral_weight"}
)

register_recipe(
    Recipe(
        name="small",
        summary="emit times capture on a small grid, with the losses of the paper and an integral penalty",
        make_config=_make_product_config("small", "softplus"),
        trainer=ProductTrainer,
        losses=("paper", "code"),
        settings=GazeSettings(steps=600),
        probes=ProbeSettings(),
        supported_options=_PRODUCT_OPTIONS,
    )
)
register_recipe(
    Recipe(
        name="paper",
        summary="networks, losses and probes of the paper, trained for the equivalent of 50 epochs",
        make_config=_make_product_config("paper", "linear"),
        trainer=ProductTrainer,
        losses=("paper", "code"),
        settings=GazeSettings(
            steps=12_800,
            loss="paper",
            integral_weight=0.0,
            probes=16,
            directions=1024,
            learning_rate=1e-3,
            lr_final_ratio=0.1,
            lr_hold_fraction=0.0,
            weight_decay=0.0,
        ),
        # Bandwidth and minimum number of rays are those of the authors' code.
        probes=ProbeSettings(
            radius=0.1, probes=4096, max_rays=1024, kappa_rule="silverman", directions=1024, min_rays=8
        ),
        supported_options=_PRODUCT_OPTIONS,
    )
)
