"""Recipes: what a gaze field is trained with, by the data at hand.

A kind of field has a module ``gaze_KIND`` for its training, which registers recipes; `recipes` loads it.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.fields.gaze_base import GazeHeadConfig, kinds

from .gaze_settings import GazeSettings, ProbeSettings
from .gaze_trainer import GazePlan, GazeTrainer
from .geometry import TrainingGeometry

DEFAULT_RECIPE = "default"  # Name of the recipe that is taken where none is named


@dataclass(frozen=True, kw_only=True)
class FieldOptions:
    """What of a gaze field is chosen besides its recipe, which heeds the variant, the place and what it ``takes``."""

    variant: str = ""  # "emit", "capture" or "emit_capture"; "": one of `default_variants`
    activation: str | None = None  # Of the emit head (`fields.gaze_product.ACTIVATIONS`); None: the recipe's
    size: str | None = None  # Of the networks, a word; None: the recipe's
    normalized: bool = False  # Whether the density is divided by its integral over the sphere
    semantic: str = ""  # Features of a radiance field that emit is given (`fields.gaze_product.SEMANTICS`); "": none
    semantic_own: bool = False  # Whether emit has the field's own features besides
    geometry_kind: str = "field"  # Kind of the place that it is trained in (`GazePlace.kind`)


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """One way to train a gaze field."""

    name: str  # The word it is called by
    summary: str  # What it is, in a clause
    # Makes the architecture of what is chosen, a variant among it. Raises `NergError` for a place that such a field
    # cannot be trained in.
    make_config: Callable[[FieldOptions], GazeHeadConfig]
    trainer: type[GazeTrainer]  # Moves the weights of such a field
    losses: tuple[str, ...]  # Losses that it can be trained on (`gaze_settings.LOSSES`)
    settings: Mapping[str, Any]  # Keywords of `GazeSettings`, its length among them
    probes: Mapping[str, Any]  # Keywords of `ProbeSettings`
    # Those of ``settings`` that differ where views are all there is: what they share comes late, after a plateau.
    views_only_settings: Mapping[str, Any] = field(default_factory=lambda: {"patience": 10})
    # What may be chosen of it: of "activation", "size", "normalized", "semantic", "begin", "loss", "integral",
    # "mix-folds", "mix-kappa".
    supported_options: frozenset[str] = frozenset()
    is_quick: bool = False  # Whether a training is so short that an ablation repeats it with several seeds

    def make_plan(
        self,
        geometry: TrainingGeometry,
        options: FieldOptions | None = None,
        *,
        settings: Mapping[str, Any] | None = None,
        probes: Mapping[str, Any] | None = None,
        init_from_field: bool = False,
        views_only: bool = False,
    ) -> GazePlan:
        """How a field of this recipe is trained in ``place``.

        ``settings``, ``probes``: keywords of `GazeSettings` and `ProbeSettings` that take the place of the recipe's; of
        minutes and steps the one that is given counts. ``begin``: the trunk begins as that of the place's radiance
        field. ``views_alone``: there are no rays. Raises `NergError` where the place has no surfaces, or is no radiance
        field, and such a one is needed.
        """
        options = replace(options or FieldOptions(), geometry_kind=geometry.kind)
        (config, *alternatives), initial = self.list_architectures(options), None
        if init_from_field or options.semantic:
            option = "--begin field" if init_from_field else "--semantic"
            if geometry.radiance is None:
                raise NergError(f"{option} needs a radiance field: give it with --field")
            if ("begin" if init_from_field else "semantic") not in self.supported_options:
                raise NergError(f"a field of the recipe {self.name} does not take {option}; leave it out")
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
        """That of ``choices``; without a variant those of `default_variants`, the one that is taken where nothing
        chooses first. Raises as ``config`` does."""
        variants = (options.variant,) if options.variant else get_default_variants(options.geometry_kind)
        return tuple(self.make_config(replace(options, variant=variant)) for variant in variants)

    def make_gaze_settings(self, overrides: Mapping[str, Any] | None = None, views_only: bool = False) -> GazeSettings:
        """The recipe's settings with those that are ``given`` in their place; see `plan`."""
        overrides = overrides or {}
        controls = {**self.settings, **(self.views_only_settings if views_only else {}), **overrides}
        if overrides.get("minutes") is not None and overrides.get("steps") is None:
            controls["steps"] = None
        return GazeSettings(**controls)

    def make_probe_settings(self, overrides: Mapping[str, Any] | None = None) -> ProbeSettings:
        """The recipe's settings of probes with those that are ``given`` in their place."""
        return ProbeSettings(**{**self.probes, **(overrides or {})})

    def check_options(self, names: Collection[str]) -> None:
        """Raise `NergError` unless the recipe ``takes`` all that is chosen by these ``names``."""
        wrong = [name for name in names if name not in self.supported_options]
        if not wrong:
            return
        spelt = ", ".join("--begin field" if name == "begin" else f"--{name}" for name in wrong)
        others = [r.name for r in load_recipes().values() if r.supported_options.issuperset(names)]
        remedy = f"add --recipe {others[0]}" if others else f"leave {'it' if len(wrong) == 1 else 'them'} out"
        raise NergError(f"the recipe {self.name} has no choice of {spelt}, but ways of its own; {remedy}")


def get_default_variants(geometry_kind: str) -> tuple[str, ...]:
    """The factors of a field in a kind of ``place``: both. Where no surfaces are known, emit learns of things that are
    not there: capture alone, unless folds find both better."""
    return ("capture", "emit_capture") if geometry_kind == "none" else ("emit_capture",)


RECIPES: dict[str, Recipe] = {}  # Recipes that are registered so far; see `recipes`


def register_recipe(recipe: Recipe) -> Recipe:
    """Make ``recipe`` one that can be chosen by its name. Raises ``ValueError`` for a name that is taken.

    >>> import nerg_mi as nerg
    >>> from dataclasses import replace
    >>> from nerg_mi.train.gaze_recipes import RECIPES, gaze_recipe
    >>> usual = gaze_recipe("default")
    >>> longer = replace(usual, name="longer", settings={**usual.settings, "steps": 5000})
    >>> nerg.register_recipe(longer).name  # for train_gaze(..., recipe="longer"), and for nerg ablate
    'longer'
    >>> del RECIPES["longer"]
    """
    if recipe.name in RECIPES:
        raise ValueError(f'there is a recipe "{recipe.name}" already')
    RECIPES[recipe.name] = recipe
    return recipe


def get_recipe(name: str = DEFAULT_RECIPE) -> Recipe:
    """The recipe ``name``. Raises `NergError` where there is none."""
    found = load_recipes()
    if name not in found:
        raise NergError(f'the recipe must be one of {", ".join(found)}, got "{name}"')
    return found[name]


def load_recipes() -> dict[str, Recipe]:
    """Every recipe by its name, that of the default first, with those of every kind of gaze field."""
    for kind in kinds():
        module = f"{__package__}.gaze_{kind}"
        # Kinds of other packages register their recipes where these are imported.
        if importlib.util.find_spec(module) is not None:
            importlib.import_module(module)
    return dict(sorted(RECIPES.items(), key=lambda item: item[0] != DEFAULT_RECIPE))
