"""Options of workflows: how one is declared, which are settings, too, and those that several workflows share.

An option is a field that `option` makes of a dataclass, which stands where its command is declared: a notebook reads it
there, and the command line makes its option of it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from nerg_mi.errors import NergError, sanitize
from nerg_mi.ranges import CHANGES_RESULT, COORDINATES, FLAG, RANGE, THREADS, ValidatedDataclass, Range, check_number

# Key in the metadata of a field that `exposes` made.
_EXPOSED = "nerg_mi.exposed"

Base = TypeVar("Base")
Class = TypeVar("Class", bound=type)


class DerivedOptions(ValidatedDataclass):
    """Base of options of which some are declared elsewhere, by `exposes` or `repeats`."""

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...


def option(
    default: Any,
    help: str,
    *names: str,
    within: Range | None = None,
    parse: Callable[[str, str], Any] | None = None,
    changes_result: bool = True,
    **more: Any,
) -> Any:
    """A field of a dataclass of options, which derives from `nerg_mi.ranges.Checked`.

    ``default``: its value where none is given; ``help``: what it means, in one line. ``names``: how the command spells
    it ("-s", "--seed"), where that is not ``--`` and the field's name; ``within``: the range of its numbers, which each
    option that has any needs; ``parse(text, flag)``: its value from a word of the command line, where the type alone
    does not tell; ``changes_result``: False for where, by whom or with how many threads something is computed, which
    must not change what comes of it: parts of a job are kept without it, and run with the default; ``more``:
    what else ``typer.Option`` takes, such as ``metavar``.
    """
    about = {"help": help, "names": names, "parse": parse, "more": more, CHANGES_RESULT: changes_result}
    return field(default=default, metadata={**about, RANGE: within, FLAG: names[-1] if names else ""})


def expose_settings(*kinds: type, default: str = "", without: Collection[str] = ()) -> Callable[[Class], Class]:
    """Decorator of a class, under ``dataclass``: gives it an option for each `nerg_mi.ranges.setting` of ``kinds``.
    `exposed_options` reads those that it gave.

    Parameters
    ----------
    kinds
        Dataclasses of settings, for which `chosen_settings` reads the options again. A field that the class declares
        itself stays as it is.
    default
        Ends the help of options that are None until they are set, where something else decides. Without it an option
        has the default of its setting.
    without
        Options that it leaves out.
    """

    def decorate(kind: Class) -> Class:
        for setting in (f for settings in kinds for f in fields(settings) if "help" in f.metadata):
            about, name, hint = setting.metadata, setting.metadata["option"] or setting.name, str(setting.type)
            if name in kind.__annotations__ or name in without:
                continue
            names, value = about["names"], setting.default
            if default:
                value, hint = None, f"{hint.removesuffix(' | None')} | None"
                if "bool" in hint:
                    flag = (names[-1] if names else f"--{name.replace('_', '-')}").removeprefix("--")
                    names = (f"--{flag}/--no-{flag}",)
            kind.__annotations__[name] = hint
            exposed = option(value, f"{about['help']} {default}".rstrip(), *names, within=about[RANGE])
            setattr(kind, name, field(default=value, metadata={**exposed.metadata, _EXPOSED: True}))
        return kind

    return decorate


def explicit_settings(options: Any, kind: type) -> dict[str, Any]:
    """Keywords of the settings ``kind``, for those of its exposed fields that are set in ``options``."""
    exposed = {f.name: f.metadata["option"] or f.name for f in fields(kind) if "help" in f.metadata}
    values = {name: getattr(options, option) for name, option in exposed.items()}
    return {name: value for name, value in values.items() if value is not None}


def exposed_options(options: Any) -> dict[str, Any]:
    """Those of ``options`` that `exposes` gave their class, and that are set: keywords of other options that expose the
    same settings."""
    names = [f.name for f in fields(options) if f.metadata.get(_EXPOSED)]
    return {name: value for name in names if (value := getattr(options, name)) is not None}


def repeat_options(kind: type, *names: str) -> Callable[[Class], Class]:
    """Decorator of a class, under ``dataclass``: gives it the options ``names`` of ``kind``, as they are there, which
    `shared_options` reads again."""

    def decorate(derived: Class) -> Class:
        for name in names:
            declared = kind.__dataclass_fields__[name]
            derived.__annotations__[name] = declared.type
            setattr(derived, name, declared)
        return derived

    return decorate


def shared_options(options: Any, kind: type) -> dict[str, Any]:
    """Keywords of the options ``kind``, for those that ``options`` repeat or have from the same base."""
    declared = type(options).__dataclass_fields__
    return {f.name: getattr(options, f.name) for f in fields(kind) if declared.get(f.name) is f}


def to_base(options: Any, kind: type[Base]) -> Base:
    """The fields of ``options`` that the dataclass ``kind`` has, of which theirs is derived: who is given it cannot
    depend on the others."""
    return kind(**{f.name: getattr(options, f.name) for f in fields(kind)})  # pyright: ignore[reportArgumentType]


def parse_point(text: str, flag: str) -> tuple[float, ...]:
    """Three coordinates with commas between them. Raises `NergError` naming ``flag`` for other texts."""
    numbers = parse_numbers(text, flag)
    if len(numbers) != 3:
        raise NergError(f"{flag} is three numbers x,y,z, got {sanitize(text, 60)!r}")
    for number in numbers:
        check_number(number, COORDINATES, flag)
    return numbers


def parse_numbers(text: str, flag: str) -> tuple[float, ...]:
    """Numbers with commas, or spaces, between them. Raises `NergError` naming ``flag`` for other texts."""
    try:
        return tuple(float(v) for v in (text.split(",") if "," in text or not text else text.split()))
    except ValueError:
        raise NergError(f"{flag} is numbers with commas between them, got {sanitize(text, 60)!r}") from None


def parse_definitions(pairs: Iterable[str], flag: str) -> dict[str, str]:
    """``["spp=4", "name=a=b"]`` as ``{"spp": "4", "name": "a=b"}``.

    Raises `NergError` for a pair without a key or without "=".
    """
    values = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not (key and equals):
            raise NergError(f'"-D {pair}" is no definition: write -D key=value')
        values[key] = value
    return values


# ---- Options that many workflows have ----


def definitions() -> Any:
    """The field ``defaults`` of options of what renders a scene: a mapping of texts, or None."""
    help = "Value for $KEY or a <default> of the scene; repeatable."
    return option(None, help, "-D", "--define", parse=parse_definitions, metavar="KEY=VALUE")


def coordinates(help: str, *names: str) -> Any:
    """A field of several coordinates, or None."""
    return option(None, help, *names, parse=parse_numbers, within=COORDINATES)


def best_variant() -> Any:
    """The field ``mode`` of options: a Mitsuba variant, or None for the best that works."""
    return option(None, "Mitsuba variant.  [default: cuda_ad_rgb if it works, else llvm_ad_rgb]", "-m", "--mode")


def llvm_variant() -> Any:
    """The field ``mode`` of options of what runs on the processor by default."""
    return option("llvm_ad_rgb", "Mitsuba variant.", "-m", "--mode")


def cpu_threads(more: str = "") -> Any:
    """The field ``threads`` of options."""
    return option(None, f"CPU threads. Default: all{more}.", within=THREADS, changes_result=False)


# ---- Options of jobs that are done in parts, each of which is kept ----


@dataclass(frozen=True, kw_only=True)
class PartOptions(ValidatedDataclass):
    """Where finished parts of a job are kept, and who makes them."""

    store: Path | None = option(
        None,
        "Keep finished parts in this folder, and go on from them.  [default: OUTPUT.tasks, with --scheduler]",
        changes_result=False,
    )
    scheduler: str | None = option(
        None,
        "Who makes the parts: local, local:N for N processes, or a cluster at tcp://HOST:PORT or tls://HOST:PORT.  "
        "[default: local, with --store]",
        changes_result=False,
    )

    @property
    def in_parts(self) -> bool:
        """Whether the job is to be done in parts at all."""
        return self.store is not None or self.scheduler is not None


# ---- Options that say where people looked around ----


@dataclass(frozen=True, kw_only=True)
class GeometryOptions(ValidatedDataclass):
    """Exactly one of them is given."""

    field: Path | None = option(None, "Radiance field, or Gaussian splats, in which people looked around.")
    scene: Path | None = option(None, "Or: a Mitsuba scene, or a mesh (.ply, .obj, .glb), whose shapes they looked at.")
    geometry: str | None = option(
        None, 'Or: "hits" makes a place from the rays\' own hit points, "none" does without any.'
    )
