"""Training recipes of gaze fields, by name, and the plans that they make for an environment.

A kind of field has a module ``gaze_KIND`` for its training, which registers recipes. `load_recipes` imports these
modules.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.gaze_base import GazeHeadConfig, kinds

from .gaze_data import Supervision
from .gaze_settings import GazeSettings, ProbeSettings
from .gaze_trainer import GazeTrainer

DEFAULT_RECIPE = "default"  # Recipe that is used if none is named
_KEYWORDS = ("prior_folds", "reaimed_hits")  # Supported options that are keywords of `train_gaze`


@dataclass(frozen=True, kw_only=True)
class FieldOptions:
    """Options of a gaze field apart from its recipe.

    Each recipe uses the variant, the geometry kind and its ``supported_options``.
    """

    variant: str = ""  # "emit", "capture" or "emit_capture"; "": one of `get_default_variants`
    # Activation of the emit head (`fields.gaze_product.ACTIVATIONS`); None: set by the recipe
    activation: str | None = None
    size: str | None = None  # Name of the network size; None: set by the recipe
    normalized: bool = False  # Whether the density is divided by its integral over the sphere
    # Input of emit: features that the density network of the environment's radiance field computes, "accumulated"
    # (integrated along the ray from the observer) or "snapshot" (at the surface); "": none
    semantic: str = ""
    semantic_own: bool = False  # Whether emit also has the features of its own hash grid
    init_from_field: bool = False  # Whether training begins with the weights of that radiance field's trunk
    geometry_kind: str = "field"  # Kind of the training geometry (`Environment.kind`)


@dataclass(frozen=True, kw_only=True)
class GazePlan:
    """Architecture, settings and trainer of a training, without its data and geometry."""

    config: GazeHeadConfig  # Architecture of the field
    # Alternative architectures that folds may select (`gaze_folds.select_variant`).
    alternatives: tuple[GazeHeadConfig, ...] = ()
    settings: GazeSettings  # Optimisation settings
    probes: ProbeSettings  # How rays become probes
    trainer: type[GazeTrainer]  # Trainer class of this kind of field
    # Initial arrays by name (`GazeTrainer.init_from_radiance`); None: random initialisation.
    initial_arrays: dict[str, Any] | None = None

    def with_settings(self, **changes: Any) -> GazePlan:
        """Return the plan with changed ``settings``."""
        return replace(self, settings=replace(self.settings, **changes))

    def make_identity(self, supervision: Supervision, environment: Environment) -> dict:
        """Return the data that must match for a run to be resumed (JSON)."""
        align = environment.align
        return {
            **supervision.compute_digest(),
            "settings": self.settings.to_dict(),
            "probes": self.probes.to_dict(),
            "architecture": self.config.to_dict(),
            "box": environment.box.to_dict(),
            "align": None if align.is_identity else align.matrix.tolist(),
        }


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """A way to train a gaze field: its architecture, trainer and settings."""

    name: str  # Name of the recipe
    summary: str  # One-line description
    # Makes the architecture from options with a variant. Raises `NergError` for a geometry kind that does not support
    # such a field.
    make_config: Callable[[FieldOptions], GazeHeadConfig]
    trainer: type[GazeTrainer]  # Trainer class of such a field
    losses: tuple[str, ...]  # Supported losses (`gaze_settings.LOSSES`)
    settings: GazeSettings  # Settings of the optimisation, including the length of the training
    probes: ProbeSettings  # Settings of the targets
    options: FieldOptions = FieldOptions()  # Options of the architecture
    # Changes of ``settings`` for training on views only, whose common structure is learned late, after a plateau.
    views_only_settings: Mapping[str, Any] = field(default_factory=lambda: {"patience": 10})
    # Options and settings that the recipe supports, among "activation", "size", "normalized", "semantic",
    # "init_from_field", "loss", "integral_weight", "prior_folds", "prior_kappa", "reaimed_hits".
    supported_options: frozenset[str] = frozenset()

    def override(self, **settings: Any) -> Recipe:
        """Return the recipe with other ``settings``: fields of `ProbeSettings` and `GazeSettings`.

        ``probes`` and ``directions``, which both have, are those of `ProbeSettings`. None stands for the value of the
        recipe. If only one of minutes and steps is given, it replaces the other.
        """
        values = {name: value for name, value in settings.items() if value is not None}
        if "minutes" in values:
            values.setdefault("steps", None)
        elif "steps" in values:
            values["minutes"] = None
        names = {f.name for f in fields(ProbeSettings)}
        probes = {name: value for name, value in values.items() if name in names}
        rest = {name: value for name, value in values.items() if name not in names}
        return replace(self, probes=replace(self.probes, **probes), settings=replace(self.settings, **rest))

    def without_rays(self) -> Recipe:
        """Return the recipe for training on salience views only, which do not determine the integral of the density."""
        normalized = self.options.normalized or "normalized" in self.supported_options
        options = replace(self.options, normalized=normalized)
        return replace(self, options=options, settings=replace(self.settings, **self.views_only_settings))

    def make_plan(self, environment: Environment, variant: str = "") -> GazePlan:
        """Make the training plan of this recipe for an environment.

        Parameters
        ----------
        environment : Environment
            Geometry of the training.
        variant : str
            Factors of the density, as in `FieldOptions`.

        Raises
        ------
        NergError
            If the field needs surfaces or a radiance field and the environment has none.
        """
        options = self.options
        (config, *alternatives), initial = self.list_architectures(environment.kind, variant), None
        if options.init_from_field or options.semantic:
            what = "init_from_field" if options.init_from_field else "semantic"
            if environment.radiance is None:
                raise NergError(
                    f"the option {what} of the recipe needs a radiance field; pass one as {parameter('environment')}"
                )
            if options.init_from_field:
                config, initial = self.trainer.init_from_radiance(environment.radiance.network, config)
            else:
                config = self.trainer.configure_features(environment.radiance.network, config)
        return GazePlan(
            config=config,
            alternatives=tuple(alternatives),
            settings=self.settings,
            probes=self.probes,
            trainer=self.trainer,
            initial_arrays=initial,
        )

    def list_architectures(self, kind: str, variant: str = "") -> tuple[GazeHeadConfig, ...]:
        """Return the architectures for an environment of this ``kind``: one if a ``variant`` is given, otherwise one
        for each of `get_default_variants`.

        The first is used unless folds select another. Raises as ``make_config`` does.
        """
        options = replace(self.options, geometry_kind=kind)
        variants = (variant or options.variant,) if variant or options.variant else get_default_variants(kind)
        return tuple(self.make_config(replace(options, variant=variant)) for variant in variants)

    def check(self) -> None:
        """Raise `NergError` for options and settings that the recipe does not support."""
        options, settings = self.options, self.settings
        chosen = {
            "activation": options.activation,
            "size": options.size,
            "semantic": options.semantic,
            "init_from_field": options.init_from_field,
            "normalized": options.normalized,
            "loss": settings.loss not in self.losses,
            "integral_weight": settings.integral_weight not in (0, GazeSettings.integral_weight),
            "prior_folds": settings.prior_folds,
            "prior_kappa": self.probes.prior_kappa is not None,
            "reaimed_hits": settings.reaimed_hits,
        }
        names = [name for name, is_set in chosen.items() if is_set]
        if "loss" in names and "loss" in self.supported_options:
            raise NergError(f'the loss must be one of {", ".join(self.losses)}, got "{settings.loss}"')
        if settings.freeze and not options.init_from_field:
            raise NergError("the setting freeze of the recipe needs its option init_from_field; set both or none")
        unsupported = [name for name in names if name not in self.supported_options]
        if not unsupported:
            return
        alternatives = [r.name for r in load_recipes().values() if r.supported_options.issuperset(unsupported)]
        remedy = (
            f"use {parameter('recipe', alternatives[0])}"
            if alternatives
            else f"leave {'it' if len(unsupported) == 1 else 'them'} out"
        )
        mentions = [parameter(name) if name in _KEYWORDS else name for name in unsupported]
        raise NergError(f"the recipe {self.name} does not support {', '.join(mentions)}; {remedy}")


def get_default_variants(geometry_kind: str) -> tuple[str, ...]:
    """Return the default variants for a geometry kind: both factors.

    Without surfaces, emit would be fitted to points that do not exist, so the default is capture alone, unless folds
    find both factors better.
    """
    return ("capture", "emit_capture") if geometry_kind == "none" else ("emit_capture",)


RECIPES: dict[str, Recipe] = {}  # Registered recipes; see `load_recipes`


def register_recipe(recipe: Recipe) -> Recipe:
    """Register ``recipe`` under its name. Raises ``ValueError`` if the name is taken.

    >>> import nerg_mi as nerg
    >>> from dataclasses import replace
    >>> from nerg_mi.train.gaze_recipes import RECIPES, get_recipe
    >>> usual = get_recipe("default")
    >>> longer = replace(usual, name="longer", settings=replace(usual.settings, steps=5000))
    >>> nerg.register_recipe(longer).name  # for train_gaze(..., recipe="longer")
    'longer'
    >>> del RECIPES["longer"]
    """
    if recipe.name in RECIPES:
        raise ValueError(f'a recipe named "{recipe.name}" is already registered')
    RECIPES[recipe.name] = recipe
    return recipe


def get_recipe(name: str | Recipe = DEFAULT_RECIPE) -> Recipe:
    """Return the recipe with this ``name``, or ``name`` if it is a recipe. Raises `NergError` if there is none."""
    if isinstance(name, Recipe):
        return name
    available = load_recipes()
    if name not in available:
        raise NergError(f'the recipe must be one of {", ".join(available)}, got "{name}"')
    return available[name]


def load_recipes() -> dict[str, Recipe]:
    """Return all recipes by name, the default first, including those of every registered kind of gaze field."""
    for kind in kinds():
        module = f"{__package__}.gaze_{kind}"
        # Other packages register their recipes when they are imported.
        if importlib.util.find_spec(module) is not None:
            importlib.import_module(module)
    return dict(sorted(RECIPES.items(), key=lambda item: item[0] != DEFAULT_RECIPE))
