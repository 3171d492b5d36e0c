"""What the options of a gaze training come to: whether they go together, and the plan that they make of a recipe."""

from __future__ import annotations

from nerg_mi.errors import NergError, chosen
from nerg_mi.train.gaze_data import TargetNeeds, check_kernels
from nerg_mi.train.gaze_recipes import FieldChoices, Recipe, gaze_recipe
from nerg_mi.train.gaze_settings import GazeSettings, ProbeSettings
from nerg_mi.train.gaze_trainer import GazePlan
from nerg_mi.train.geometry import GazePlace

from .gaze_places import place_kind
from .options import chosen_settings
from .options.gaze import GazeOptions


def plan_gaze(options: GazeOptions, place: GazePlace, views_alone: bool = False) -> GazePlan:
    """How ``options`` have a field trained in ``place``; ``views_alone``: there are no rays.

    Raises `NergError` for what does not go together.
    """
    with chosen(_named(options)):
        return gaze_recipe(options.recipe).plan(
            place,
            _choices(options, place.kind, views_alone),
            settings=chosen_settings(options, GazeSettings),
            probes=chosen_settings(options, ProbeSettings),
            begin=options.begin == "field",
            views_alone=views_alone,
        )


def check_plan(options: GazeOptions, views_alone: bool = False) -> ProbeSettings:
    """Find what cannot be trained before any time is spent on it; returns the settings of the probes, which do not
    depend on the place. Raises `NergError` for options that do not go together, and for values that are wrong."""
    recipe = gaze_recipe(options.recipe)
    _check(options, recipe, views_alone)
    with chosen(_named(options)):
        config = recipe.architectures(_choices(options, place_kind(options), views_alone))[0]
    recipe.gaze_settings(chosen_settings(options, GazeSettings), views_alone)
    probes = recipe.probe_settings(chosen_settings(options, ProbeSettings))
    if rows := TargetNeeds.of(config).blind_rows:
        check_kernels(rows, probes.mix_kappa)
    return probes


def _check(options: GazeOptions, recipe: Recipe, views_alone: bool) -> None:
    """Raise `NergError` for options that do not go together."""
    kind = place_kind(options)
    if views_alone and options.views is None:
        raise NergError("say what to learn from: a rays file, or --views with --salience, or both")
    mixed = options.mix_folds or options.mix_kappa is not None
    if views_alone and (options.test_zones or kind == "hits" or options.align or options.semantic or mixed):
        raise NergError(
            "--test-zones, --geometry hits, --align, --semantic, --mix-folds and --mix-kappa belong to rays; give a "
            "rays file besides --views (or hold views out by leaving their images out of the folder, and align them "
            "with --align-views)"
        )
    if options.geometry is not None and options.align is not None:
        raise NergError("--align belongs to --field and --scene; a place made from rays is in the rays' own frame")
    if options.test_people and not options.test_zones:
        raise NergError("--test-people leaves people out at test positions: say where, with --test-zones")
    if (options.views is None or options.salience is None) and (
        options.views or options.salience or options.align_views
    ):
        raise NergError(
            "salience needs both: --views, the posed photos, and --salience, the images' folder or spectral-residual"
        )
    if options.begin not in ("random", "field"):
        raise NergError(f'--begin must be "random" or "field", got "{options.begin}"')
    if options.freeze and options.begin != "field":
        raise NergError("--freeze keeps the weights that --begin field gives; add it, or leave --freeze out")
    if options.field is None and (options.semantic or options.begin == "field"):
        raise NergError(
            f"{'--semantic' if options.semantic else '--begin field'} needs a radiance field: give it with --field"
        )
    asked = {
        "activation": options.activation,
        "size": options.size,
        "semantic": options.semantic,
        "begin": options.begin == "field",
        "loss": options.loss,
        "integral": options.integral is not None,
        "normalized": options.normalized,
        "mix-folds": bool(options.mix_folds),
        "mix-kappa": options.mix_kappa is not None,
    }
    recipe.require([name for name, given in asked.items() if given])
    if options.loss and options.loss not in recipe.losses:
        raise NergError(f'the loss must be one of {", ".join(recipe.losses)}, got "{options.loss}"')


def _named(options: GazeOptions) -> str:
    """By which options the architecture was chosen."""
    given = options.semantic or options.begin == "field"
    return "--semantic, --variant and --begin" if given else "--variant and --activation"


def _choices(options: GazeOptions, kind: str, views_alone: bool) -> FieldChoices:
    return FieldChoices(
        variant=options.variant or "",
        activation=options.activation,
        size=options.size,
        # Views alone do not say how much is looked altogether.
        normalized=options.normalized or views_alone,
        semantic=options.semantic,
        semantic_own=options.semantic_own,
        place=kind,
    )
