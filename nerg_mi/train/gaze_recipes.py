"""Recipes: what a gaze field is trained with, by the data at hand."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypedDict

from nerg_mi.errors import NergError
from nerg_mi.fields.encoding import HashGridConfig
from nerg_mi.fields.gaze_base import GazeFieldConfig
from nerg_mi.fields.gaze_log_density import LogGazeConfig
from nerg_mi.fields.gaze_product import GazeConfig

from .gaze_data import initial_weights, trunk_config
from .gaze_log_density import LikelihoodTrainer
from .gaze_product import ProductTrainer
from .gaze_settings import GazeSettings, ProbeSettings, sized_gaze_config
from .gaze_trainer import GazePlan, GazeTrainer
from .geometry import GazePlace

DEFAULT = "default"
"""Name of the recipe that is taken where none is named."""


@dataclass(frozen=True, kw_only=True)
class FieldChoices:
    """What of a gaze field is chosen besides its recipe, which heeds the variant, the place and what it ``takes``."""

    # "emit", "capture" or "emit_capture"; "": one of `default_variants`.
    variant: str = ""
    # Of the emit head (`fields.gaze_product.ACTIVATIONS`); None: the recipe's.
    activation: str | None = None
    # Of the networks (`gaze_settings.SIZES`); None: the recipe's.
    size: str | None = None
    # Whether the density is divided by its integral over the sphere.
    normalized: bool = False
    # Features of a radiance field that emit is given (`fields.gaze_product.SEMANTICS`); "": none.
    semantic: str = ""
    # Whether emit has the field's own features besides.
    semantic_own: bool = False
    # Kind of the place that it is trained in (`GazePlace.kind`).
    place: str = "field"


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """One way to train a gaze field."""

    # The word it is called by.
    name: str
    # What it is, in a clause.
    summary: str
    # Makes the architecture of what is chosen, a variant among it. Raises `NergError` for a place that such a field
    # cannot be trained in.
    config: Callable[[FieldChoices], GazeFieldConfig]
    # Moves the weights of such a field.
    trainer: type[GazeTrainer]
    # Losses that it can be trained on (`gaze_settings.LOSSES`).
    losses: tuple[str, ...]
    # Keywords of `GazeSettings`, its length among them.
    settings: Mapping[str, Any]
    # Keywords of `ProbeSettings`.
    probes: Mapping[str, Any]
    # Those of ``settings`` that differ where views are all there is: what they share comes late, after a plateau.
    views_alone: Mapping[str, Any] = field(default_factory=lambda: {"patience": 10})
    # What may be chosen of it: of "activation", "size", "normalized", "semantic", "begin", "loss", "integral",
    # "mix-folds", "mix-kappa".
    takes: frozenset[str] = frozenset()
    # Whether a training is so short that an ablation repeats it with several seeds.
    quick: bool = False

    def plan(
        self,
        place: GazePlace,
        choices: FieldChoices | None = None,
        *,
        settings: Mapping[str, Any] | None = None,
        probes: Mapping[str, Any] | None = None,
        begin: bool = False,
        views_alone: bool = False,
    ) -> GazePlan:
        """How a field of this recipe is trained in ``place``.

        ``settings``, ``probes``: keywords of `GazeSettings` and `ProbeSettings` that take the place of the recipe's; of
        minutes and steps the one that is given counts. ``begin``: the trunk begins as that of the place's radiance
        field. ``views_alone``: there are no rays. Raises `NergError` where the place has no surfaces, or is no radiance
        field, and such a one is needed.
        """
        choices = replace(choices or FieldChoices(), place=place.kind)
        (config, *alternatives), initial = self.architectures(choices), None
        if begin or choices.semantic:
            option = "--begin field" if begin else "--semantic"
            if place.radiance is None:
                raise NergError(f"{option} needs a radiance field: give it with --field")
            if not isinstance(config, GazeConfig):
                raise NergError(f"a field of the recipe {self.name} does not take {option}; leave it out")
            if begin:
                config = trunk_config(config, place.radiance.config)
                initial = initial_weights(place.radiance, config)
            else:
                config = replace(config, geometry=place.radiance.config.geometry)
        return GazePlan(
            config=config,
            alternatives=tuple(alternatives),
            settings=self.gaze_settings(settings, views_alone),
            probes=self.probe_settings(probes),
            trainer=self.trainer,
            initial=initial,
        )

    def architectures(self, choices: FieldChoices) -> tuple[GazeFieldConfig, ...]:
        """That of ``choices``; without a variant those of `default_variants`, the one that is taken where nothing
        chooses first. Raises as ``config`` does."""
        variants = (choices.variant,) if choices.variant else default_variants(choices.place)
        return tuple(self.config(replace(choices, variant=variant)) for variant in variants)

    def gaze_settings(self, given: Mapping[str, Any] | None = None, views_alone: bool = False) -> GazeSettings:
        """The recipe's settings with those that are ``given`` in their place; see `plan`."""
        given = given or {}
        controls = {**self.settings, **(self.views_alone if views_alone else {}), **given}
        if given.get("minutes") is not None and given.get("steps") is None:
            controls["steps"] = None
        return GazeSettings(**controls)

    def probe_settings(self, given: Mapping[str, Any] | None = None) -> ProbeSettings:
        """The recipe's settings of probes with those that are ``given`` in their place."""
        return ProbeSettings(**{**self.probes, **(given or {})})

    def require(self, names: Collection[str]) -> None:
        """Raise `NergError` unless the recipe ``takes`` all that is chosen by these ``names``."""
        wrong = [name for name in names if name not in self.takes]
        if not wrong:
            return
        spelt = ", ".join("--begin field" if name == "begin" else f"--{name}" for name in wrong)
        others = [r.name for r in RECIPES.values() if r.takes.issuperset(names)]
        remedy = f"add --recipe {others[0]}" if others else f"leave {'it' if len(wrong) == 1 else 'them'} out"
        raise NergError(f"the recipe {self.name} has no choice of {spelt}, but ways of its own; {remedy}")


def _log_density(choices: FieldChoices) -> LogGazeConfig:
    return LogGazeConfig(
        grid=HashGridConfig(levels=5, log2_rows=14, base=2, finest=32),
        variant=choices.variant,
        sh_degree=3,
        mix=0.05,
        **surroundings(choices.place),
    )


def default_variants(place: str) -> tuple[str, ...]:
    """The factors of a field in a kind of ``place``: both. Where no surfaces are known, emit learns of things that are
    not there: capture alone, unless folds find both better."""
    return ("capture", "emit_capture") if place == "none" else ("emit_capture",)


class Surroundings(TypedDict):
    """What a log density is told of where it is."""

    # What its directions without a surface are (`LogGazeConfig.escaped`).
    escaped: str
    # Whether there are surfaces (`LogGazeConfig.geometry`).
    geometry: str


def surroundings(place: str) -> Surroundings:
    """What a log density is told of a kind of ``place``: one of hit points has holes, through which nobody saw whom it
    was made from; no place has no surfaces."""
    return {
        "escaped": "nearest" if place == "hits" else "constant",
        "geometry": "none" if place == "none" else "surface",
    }


def _product(size: str, activation: str) -> Callable[[FieldChoices], GazeConfig]:
    def config(choices: FieldChoices) -> GazeConfig:
        plain = sized_gaze_config(choices.size or size, choices.variant, choices.activation or activation)
        if choices.place == "none":
            raise NergError(
                "a gaze field of this recipe needs surfaces; without any geometry only a log density trains, "
                f"such as that of the recipe {DEFAULT}"
            )
        return replace(
            plain, normalized=choices.normalized, semantic=choices.semantic, semantic_own=choices.semantic_own
        )

    return config


_OF_PRODUCTS = frozenset({"activation", "size", "normalized", "semantic", "begin", "loss", "integral"})

RECIPES: dict[str, Recipe] = {}
"""Every recipe, by its name."""


def register(recipe: Recipe) -> Recipe:
    """Make ``recipe`` one that can be chosen by its name. Raises ``ValueError`` for a name that is taken."""
    if recipe.name in RECIPES:
        raise ValueError(f'there is a recipe "{recipe.name}" already')
    RECIPES[recipe.name] = recipe
    return recipe


def gaze_recipe(name: str = DEFAULT) -> Recipe:
    """The recipe ``name``. Raises `NergError` where there is none."""
    if name not in RECIPES:
        raise NergError(f'the recipe must be one of {", ".join(RECIPES)}, got "{name}"')
    return RECIPES[name]


register(
    Recipe(
        name=DEFAULT,
        summary="a log density, normalised over the sphere, trained by the likelihood of rays; generalises best",
        config=_log_density,
        trainer=LikelihoodTrainer,
        losses=("likelihood",),
        # No zones: fits without those that a validation takes, and all around them, lack most of the probes. The
        # decay and the few harmonics keep longer trainings from following the people at hand: two or three times
        # the steps end alike.
        settings={
            "steps": 160,
            "zones": 0,
            "loss": "likelihood",
            "integral": 0.0,
            "probes": 24,
            "directions": 512,
            "rays": 64,
            "learning_rate": 3e-3,
            "final_rate": 0.1,
            "hold": 0.5,
            "weight_decay": 4.0,
            "average": 0.95,
            "watched_rays": 64,
            "mix_folds": 5,
        },
        # Evenly over where people stood: as many at each place as there are rays would follow where people linger.
        # By person, not by time: whoever stays long at a place says little of others.
        probes={
            "placement": "blue",
            "spacing": 0.08,
            "count": 1024,
            "min_rays": 1,
            "kappa": 30.0,
            "mix_kappa": 10.0,
            "directions": 2048,
            "weights": "person",
        },
        views_alone={"steps": 200, "zones": 3, "patience": 10},
        takes=frozenset({"mix-folds", "mix-kappa"}),
        quick=True,
    )
)
register(
    Recipe(
        name="small",
        summary="emit times capture on a small grid, on the paper's losses and the integral over the sphere",
        config=_product("small", "softplus"),
        trainer=ProductTrainer,
        losses=("paper", "code"),
        settings={"steps": 600},
        probes={},
        takes=_OF_PRODUCTS,
    )
)
register(
    Recipe(
        name="paper",
        summary="the paper's networks, losses and probes, as many steps as 50 epochs have",
        config=_product("paper", "linear"),
        trainer=ProductTrainer,
        losses=("paper", "code"),
        settings={
            "steps": 12_800,
            "loss": "paper",
            "integral": 0.0,
            "probes": 16,
            "directions": 1024,
            "learning_rate": 1e-3,
            "final_rate": 0.1,
            "hold": 0.0,
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
        takes=_OF_PRODUCTS,
    )
)
