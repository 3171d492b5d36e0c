"""Options of workflows: how an option is declared, options that come from settings, and options that workflows share.

An option is a dataclass field that `option` creates. The dataclass is defined next to the declaration of its command.
Python code reads the fields, and the command line makes an option of each of them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from nerg_mi.errors import NergError, sanitize
from nerg_mi.ranges import (
    CHANGES_RESULT,
    COORDINATES,
    FLAG,
    RANGE,
    SECONDS,
    SEEDS,
    THREADS,
    Range,
    ValidatedDataclass,
    check_number,
)
from nerg_mi.rays.event_settings import EventRules

# Key in the metadata of a field that `expose_settings` made.
_EXPOSED = "nerg_mi.exposed"

MAIN, INPUT, VIEW, MODEL, TRAINING, TEST = "Main", "Input", "View", "Model", "Training", "Test"
ANALYSIS, OUTPUT, PERFORMANCE = "Analysis", "Output", "Performance"
GROUPS = (MAIN, INPUT, VIEW, MODEL, TRAINING, TEST, ANALYSIS, OUTPUT, PERFORMANCE)
"""Groups of options in the order in which help lists them; options without a group come last."""

PANEL = "rich_help_panel"
"""The parameter of ``typer.Option`` that holds the group."""

Base = TypeVar("Base")
Class = TypeVar("Class", bound=type)


class DerivedOptions(ValidatedDataclass):
    """Base of options some of which are declared elsewhere, by `expose_settings` or `repeat_options`."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...


def option(
    default: Any,
    help: str,
    *names: str,
    within: Range | None = None,
    parse: Callable[[str, str], Any] | None = None,
    changes_result: bool = True,
    group: str = "",
    **more: Any,
) -> Any:
    """Create a field of a dataclass of options, which derives from `nerg_mi.ranges.ValidatedDataclass`.

    Parameters
    ----------
    default
        Value of the option if it is not given.
    help
        What the value is, its unit and its default, in a sentence.
    names
        Spellings on the command line ("-s", "--seed"). Without any it is ``--`` and the name of the field.
    within
        Range of the number. Each numeric option needs one.
    parse
        ``parse(text, flag)`` converts a word of the command line to the value, where the type is not enough.
    changes_result
        False for options that set where, by whom or with how many threads something is computed. They must not change
        the result: cached parts are identified without them, and computed with their defaults.
    group
        Heading under which help lists the option, one of `GROUPS`.
    more
        Further parameters of ``typer.Option``, such as ``metavar``.
    """
    metadata = {"help": help, "names": names, "parse": parse, "more": {**more, PANEL: group}}
    metadata |= {CHANGES_RESULT: changes_result, RANGE: within, FLAG: names[-1] if names else ""}
    return field(default=default, metadata=metadata)


def expose_settings(
    *kinds: type, default: str = "", without: Collection[str] = (), group: str = TRAINING
) -> Callable[[Class], Class]:
    """Class decorator, applied below ``dataclass``: adds an option for each `nerg_mi.ranges.setting` of ``kinds``.

    Parameters
    ----------
    kinds
        Dataclasses of settings. `explicit_settings` reads their options again. A field that the class declares itself
        is not replaced.
    default
        End of the help text of options that are None unless they are given. Without it, an option has the default
        of its setting.
    without
        Names of options that are not added.
    group
        Group of the options in the help.
    """

    def decorate(kind: Class) -> Class:
        for setting in (f for settings in kinds for f in fields(settings) if "help" in f.metadata):
            name, hint = setting.name, str(setting.type)
            if name in kind.__annotations__ or name in without:
                continue
            names, value = (), setting.default
            if default:
                value, hint = None, f"{hint.removesuffix(' | None')} | None"
                if "bool" in hint:
                    names = ("--{0}/--no-{0}".format(name.replace("_", "-")),)
            kind.__annotations__[name] = hint
            help = f"{setting.metadata['help']}  {default}".rstrip()
            exposed = option(value, help, *names, within=setting.metadata[RANGE], group=group)
            setattr(kind, name, field(default=value, metadata={**exposed.metadata, _EXPOSED: True}))
        return kind

    return decorate


def explicit_settings(options: Any, kind: type) -> dict[str, Any]:
    """Return keywords of the settings ``kind`` for its exposed fields that are set in ``options``."""
    values = {f.name: getattr(options, f.name) for f in fields(kind) if "help" in f.metadata}
    return {name: value for name, value in values.items() if value is not None}


def exposed_options(options: Any) -> dict[str, Any]:
    """Return those of ``options`` that `expose_settings` added to their class and that are set.

    They are keywords of any other options that expose the same settings.
    """
    names = [f.name for f in fields(options) if f.metadata.get(_EXPOSED)]
    return {name: value for name in names if (value := getattr(options, name)) is not None}


def repeat_options(kind: type, *names: str) -> Callable[[Class], Class]:
    """Class decorator, applied below ``dataclass``: adds the options ``names`` of ``kind`` unchanged.

    `shared_options` reads them again.
    """

    def decorate(derived: Class) -> Class:
        for name in names:
            declared = kind.__dataclass_fields__[name]
            derived.__annotations__[name] = declared.type
            setattr(derived, name, declared)
        return derived

    return decorate


def shared_options(options: Any, kind: type) -> dict[str, Any]:
    """Return keywords of the options ``kind`` that ``options`` repeat or inherit from the same base."""
    declared = type(options).__dataclass_fields__
    return {f.name: getattr(options, f.name) for f in fields(kind) if declared.get(f.name) is f}


def to_base(options: Any, kind: type[Base]) -> Base:
    """Return the fields of ``options`` that its base class ``kind`` declares, as an instance of ``kind``.

    What receives them cannot depend on the other options.
    """
    return kind(**{f.name: getattr(options, f.name) for f in fields(kind)})  # pyright: ignore[reportArgumentType]


def parse_point(text: str, flag: str) -> tuple[float, ...]:
    """Parse three comma-separated coordinates. Raises `NergError`, which names ``flag``, for any other text."""
    numbers = parse_numbers(text, flag)
    if len(numbers) != 3:
        raise NergError(f"{flag} must be three numbers x,y,z, got {sanitize(text, 60)!r}")
    for number in numbers:
        check_number(number, COORDINATES, flag)
    return numbers


def parse_numbers(text: str, flag: str) -> tuple[float, ...]:
    """Parse numbers separated by commas or spaces. Raises `NergError`, which names ``flag``, for any other text."""
    try:
        return tuple(float(v) for v in (text.split(",") if "," in text or not text else text.split()))
    except ValueError:
        raise NergError(f"{flag} must be comma-separated numbers, got {sanitize(text, 60)!r}") from None


def parse_definitions(pairs: Iterable[str], flag: str) -> dict[str, str]:
    """Parse ``["spp=4", "name=a=b"]`` into ``{"spp": "4", "name": "a=b"}``.

    Raises `NergError` for a pair without a key or without "=".
    """
    values = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not (key and equals):
            raise NergError(f"{flag} {pair} is not a definition: write KEY=VALUE")
        values[key] = value
    return values


# ---- Options that many workflows share ----


ALIGN_HELP = (
    "JSON file with the 4x4 similarity from the frame of the rays to that of the scene, as nerg align writes it.  "
    "[default: the alignment of the gaze field]"
)
"""Help of the option ``align``."""


def definitions() -> Any:
    """Declare the field ``defaults`` of workflows that render a scene: a mapping of strings, or None."""
    help = "Value of a <default> of the scene file, or of $KEY; repeatable.  [default: as in the scene file]"
    return option(None, help, "-D", "--define", parse=parse_definitions, metavar="KEY=VALUE", group=INPUT)


def coordinates(help: str, *names: str, group: str = VIEW) -> Any:
    """Declare a field of several coordinates, or None."""
    return option(None, help, *names, parse=parse_numbers, within=COORDINATES, group=group)


def up_axis() -> Any:
    """Declare the field ``up``: the upward direction of a scene, or None."""
    return coordinates("Up direction of the scene, x,y,z.  [default: as its files state, else 0,0,1]", group=INPUT)


def random_seed(use: str) -> Any:
    """Declare the field ``seed`` of a workflow that draws random numbers for ``use``."""
    return option(0, f"Seed of the random numbers for {use}.", within=SEEDS, group=PERFORMANCE)


def best_variant() -> Any:
    """Declare the field ``mode``: a Mitsuba variant, or None for the fastest that works."""
    help = "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]"
    return option(None, help, "-m", "--mode", group=PERFORMANCE)


def llvm_variant() -> Any:
    """Declare the field ``mode`` of workflows that run on the CPU by default."""
    return option(
        "llvm_ad_rgb", "Mitsuba variant, such as llvm_ad_rgb or cuda_ad_rgb.", "-m", "--mode", group=PERFORMANCE
    )


def cpu_threads(note: str = "") -> Any:
    """Declare the field ``threads``; ``note`` is appended to its help."""
    help = f"Number of CPU threads{note}.  [default: all cores]"
    return option(None, help, within=THREADS, changes_result=False, group=PERFORMANCE)


# ---- Options of workflows that run in parts, each of which is stored ----


@dataclass(frozen=True, kw_only=True)
class PartOptions(ValidatedDataclass):
    """Where finished parts of a job are stored, and what computes them."""

    store: Path | None = option(
        None,
        "Folder that stores finished parts; running the command again resumes from them.  "
        "[default: OUTPUT.tasks if --scheduler is given, else nothing is stored]",
        changes_result=False,
        group=PERFORMANCE,
    )
    scheduler: str | None = option(
        None,
        "What computes the parts: local, local:N for N processes, or a dask cluster at tcp://HOST:PORT or "
        "tls://HOST:PORT.  [default: local if --store is given]",
        changes_result=False,
        group=PERFORMANCE,
    )
    worker_wait: float = option(
        600.0,
        "Time in seconds to wait for workers of a dask cluster while none can run the parts.",
        within=SECONDS,
        changes_result=False,
        group=PERFORMANCE,
    )

    @property
    def in_parts(self) -> bool:
        """Whether the job runs in parts."""
        return self.store is not None or self.scheduler is not None


# ---- Options that give the geometry around the participants ----


@dataclass(frozen=True, kw_only=True)
class GeometryOptions(ValidatedDataclass):
    """The geometry that the participants saw: exactly one of these options."""

    field: Path | None = option(
        None,
        "Radiance field (.safetensors) or Gaussian splats of the environment that the participants saw.",
        group=INPUT,
    )
    scene: Path | None = option(
        None, "Mitsuba scene (.xml) or mesh (.ply, .obj, .glb) of that environment, in place of --field.", group=INPUT
    )
    geometry: str | None = option(
        None,
        'Without a model of the environment: "hits" builds a volume from the hit points of the rays, "none" uses no '
        "geometry.",
        group=INPUT,
    )


DETAILS_OF_EVENTS = ("eye_velocity", "head_velocity", "pursuit_velocity", "pursuit_angle", "merge_gap", "max_blink")
"""Fields of `EventOptions` that only ``nerg rays events`` has as options; elsewhere they are set in Python."""


@dataclass(frozen=True, kw_only=True)
@expose_settings(EventRules, group=ANALYSIS)
class EventOptions(DerivedOptions):
    """How events are told apart (`nerg_mi.rays.event_settings.EventRules`)."""

    def event_rules(self) -> EventRules:
        """Return the limits between the kinds of events. Raises `NergError` for values out of range."""
        return EventRules(**explicit_settings(self, EventRules))
