"""Training recipes of gaze fields, by name.

A kind of field has a module ``gaze_KIND`` for its training, which registers recipes. `load_recipes` imports these
modules.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from nerg_mi.environment.environment import Environment
from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.gaze_base import GazeHeadConfig, kinds

from .gaze_settings import GazeSettings, ProbeSettings
from .gaze_trainer import GazePlan, GazeTrainer

DEFAULT_RECIPE = "default"  # Recipe that is used if none is named


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
    semantic: str = ""  # Radiance-field features as input of emit (`fields.gaze_product.SEMANTICS`); "": none
    semantic_own: bool = False  # Whether emit also has the field's own features
    geometry_kind: str = "field"  # Kind of the training geometry (`Environment.kind`)


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
    settings: Mapping[str, Any]  # Keywords of `GazeSettings`, including the length of the training
    probes: Mapping[str, Any]  # Keywords of `ProbeSettings`
    # Changes of ``settings`` for training on views only, whose common structure is learned late, after a plateau.
    views_only_settings: Mapping[str, Any] = field(default_factory=lambda: {"patience": 10})
    # Options that the recipe supports, among "activation", "size", "normalize", "semantic", "init", "loss",
    # "integral_weight", "prior_folds", "prior_kappa", "reaimed_hits".
    supported_options: frozenset[str] = frozenset()

    def make_plan(
        self,
        geometry: Environment,
        options: FieldOptions | None = None,
        *,
        settings: Mapping[str, Any] | None = None,
        probes: Mapping[str, Any] | None = None,
        init_from_field: bool = False,
        views_only: bool = False,
    ) -> GazePlan:
        """Make the training plan of this recipe for a geometry.

        Parameters
        ----------
        geometry : Environment
            Training geometry.
        options : FieldOptions, optional
            Options of the field.
        settings, probes : mapping, optional
            Keywords of `GazeSettings` and `ProbeSettings` that override the recipe. If only one of minutes and steps is
            given, it replaces the other.
        init_from_field : bool
            Initialise the trunk with the weights of the radiance field of the geometry.
        views_only : bool
            Train on salience views without rays.

        Raises
        ------
        NergError
            If the field needs surfaces or a radiance field and the geometry has none.
        """
        options = replace(options or FieldOptions(), geometry_kind=geometry.kind)
        (config, *alternatives), initial = self.list_architectures(options), None
        if init_from_field or options.semantic:
            option = parameter("init", "field") if init_from_field else parameter("semantic")
            if geometry.radiance is None:
                raise NergError(f"{option} needs a radiance field; pass one with {parameter('field')}")
            if ("init" if init_from_field else "semantic") not in self.supported_options:
                raise NergError(f"the recipe {self.name} does not support {option}; leave it out")
            if init_from_field:
                config, initial = self.trainer.init_from_radiance(geometry.radiance, config)
            else:
                config = self.trainer.configure_features(geometry.radiance, config)
        return GazePlan(
            config=config,
            alternatives=tuple(alternatives),
            settings=self.make_gaze_settings(settings, views_only),
            probes=self.make_probe_settings(probes),
            trainer=self.trainer,
            initial_arrays=initial,
        )

    def list_architectures(self, options: FieldOptions) -> tuple[GazeHeadConfig, ...]:
        """Return the architectures for ``options``: one if a variant is given, otherwise one for each of
        `get_default_variants`.

        The first is used unless folds select another. Raises as ``make_config`` does.
        """
        variants = (options.variant,) if options.variant else get_default_variants(options.geometry_kind)
        return tuple(self.make_config(replace(options, variant=variant)) for variant in variants)

    def make_gaze_settings(self, overrides: Mapping[str, Any] | None = None, views_only: bool = False) -> GazeSettings:
        """Return the settings of the recipe with ``overrides``; see `make_plan`."""
        overrides = overrides or {}
        values = {**self.settings, **(self.views_only_settings if views_only else {}), **overrides}
        if overrides.get("minutes") is not None and overrides.get("steps") is None:
            values["steps"] = None
        return GazeSettings(**values)

    def make_probe_settings(self, overrides: Mapping[str, Any] | None = None) -> ProbeSettings:
        """Return the probe settings of the recipe with ``overrides``."""
        return ProbeSettings(**{**self.probes, **(overrides or {})})

    def check_options(self, names: Collection[str]) -> None:
        """Raise `NergError` unless the recipe supports all options with these ``names``."""
        unsupported = [name for name in names if name not in self.supported_options]
        if not unsupported:
            return
        spelling = ", ".join(parameter(n, "field" if n == "init" else "") for n in unsupported)
        alternatives = [r.name for r in load_recipes().values() if r.supported_options.issuperset(names)]
        remedy = (
            f"add {parameter('recipe', alternatives[0])}"
            if alternatives
            else f"leave {'it' if len(unsupported) == 1 else 'them'} out"
        )
        raise NergError(f"the recipe {self.name} does not support {spelling}; {remedy}")


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
    >>> longer = replace(usual, name="longer", settings={**usual.settings, "steps": 5000})
    >>> nerg.register_recipe(longer).name  # for train_gaze(..., recipe="longer")
    'longer'
    >>> del RECIPES["longer"]
    """
    if recipe.name in RECIPES:
        raise ValueError(f'a recipe named "{recipe.name}" is already registered')
    RECIPES[recipe.name] = recipe
    return recipe


def get_recipe(name: str = DEFAULT_RECIPE) -> Recipe:
    """Return the recipe with this ``name``. Raises `NergError` if there is none."""
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
