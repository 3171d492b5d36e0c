"""The parser of the command line, built from the table of commands.

Only the called command is built, so that ``nerg --help`` is fast.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import Field, fields
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer
import typer.core

from nerg_mi import __version__
from nerg_mi.errors import Spelling, clean_text, parameter, sanitize, spell_command_line, spell_python
from nerg_mi.options import GROUPS as GROUPS_OF_OPTIONS
from nerg_mi.progress import TerminalReporter
from nerg_mi.ranges import KAPPAS, RANGE

from .declarations import Command, HelpView, Parameter
from .ending import shorten_values
from .signatures import make_command
from .table import ROWS, TABLE, Row

GROUPS = {
    "rays": "Import tracking files as gaze rays, and check, filter, split and plot them.",
    "train": "Train a radiance field on posed photos, or a gaze field on gaze rays.",
    "draw": "Draw a figure: a sphere, occlusion, a floor plan, a flat area, images on a page, a difference, a surface.",
    "eval": "Score a radiance field on held-out views, or a gaze field on held-out rays.",
    "export": "Export a radiance field as a mesh, points, Gaussian splats, grid volumes or a torch-ngp checkpoint.",
}
"""Help texts of the groups of commands, by their first word."""

_ORDER = (
    "demo doctor scene view render draw rays poses align train eval report import export refine compile bake "
    "stats jobs worker study"
).split()


def find_commands() -> dict[str, Row]:
    """Return all commands by name, in the order of the list."""
    place = {name: k for k, name in enumerate(_ORDER)}
    rows = sorted(TABLE, key=lambda row: place.get(row.name.split()[0], len(place)))
    return {row.name: row for row in rows}


# The base class of errors about the command line, which typer does not export.
_UsageError: Any = typer.BadParameter.__base__

DEBUG = ("--debug", "--traceback")
"""The option that prints the traceback of an error."""


def build_app(arguments: Sequence[str] = ()) -> typer.Typer:
    """Return the parser of all commands. Error messages shorten long values among ``arguments``."""
    help = "Neural radiance and gaze fields for Mitsuba 3."
    settings: dict[str, Any] = {"name": "nerg", "help": help, "pretty_exceptions_enable": False}
    return _group("", find_commands(), _global_options, arguments, **settings)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"nerg {__version__}")
        raise typer.Exit()


def _global_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    debug: Annotated[
        bool, typer.Option(*DEBUG, help="Print the traceback of an error (also: NERG_TRACEBACK=1).")
    ] = False,
) -> None:
    pass


def _group(
    prefix: str,
    entries: Mapping[str, Row],
    callback: Callable[..., None] = lambda: None,
    arguments: Sequence[str] = (),
    **settings: Any,
) -> typer.Typer:
    """Return the parser of ``entries``, whose names start with ``prefix``; a command is built when it is called."""

    lines: dict[str, str] = {}
    for name, entry in entries.items():
        first, below, _ = name.removeprefix(prefix).partition(" ")
        lines[first] = _about_group(prefix + first, entries) if below else entry.line

    class Commands(typer.core.TyperGroup):
        def format_commands(self, ctx: Any, formatter: Any) -> None:
            # The parent class cuts descriptions to one line.
            with formatter.section("Commands"):
                formatter.write_dl([(name, lines[name]) for name in self.list_commands(ctx)])

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            name, listed, rest = super().resolve_command(ctx, args)
            return name, None if listed is None else _build(f"{prefix}{name}", entries), rest

        def make_context(self, *args: Any, **kwargs: Any) -> Any:
            with _shortened(arguments):
                return super().make_context(*args, **kwargs)

        def invoke(self, ctx: Any) -> Any:
            with _shortened(arguments):
                return super().invoke(ctx)

    app = typer.Typer(cls=Commands, no_args_is_help=True, rich_markup_mode=None, **settings)
    app.callback()(callback)
    for word, line in lines.items():
        app.command(word, help=line)(_listed)
    return app


def _about_group(name: str, entries: Mapping[str, Row]) -> str:
    """Return the help line of the group ``name``; groups that are not in `GROUPS` list their commands."""
    below = [other.removeprefix(f"{name} ") for other in entries if other.startswith(f"{name} ")]
    return GROUPS.get(name) or f"Commands: {', '.join(below)}."


def _listed() -> None:
    """A placeholder for a command in the list; a command that is called is built."""


def _build(name: str, entries: Mapping[str, Row]) -> Any:
    """Return the parser of the command ``name``, or of the group of commands that start with it."""
    if name in entries:
        return build_command(make_command(entries[name]), entries[name].line)
    below = {other: entry for other, entry in entries.items() if other.startswith(f"{name} ")}
    help = _about_group(name, below)
    return typer.main.get_command(_group(f"{name} ", below, name=name, help=help, add_completion=False))


@contextmanager
def _shortened(arguments: Sequence[str]) -> Iterator[None]:
    """Within this block, errors about the command line name their value, and shorten long ``arguments``."""
    try:
        yield
    except _UsageError as error:
        flags = getattr(getattr(error, "param", None), "opts", ())
        values = [value for flag, value in zip(arguments, arguments[1:]) if flag in flags]
        values += [value for flag, _, value in (a.partition("=") for a in arguments) if flag in flags and value]
        if len(values) == 1 and values[0] not in error.message:
            error.message = f'{error.message}, got "{sanitize(values[0])}"'
        error.message = clean_text(shorten_values(error.message, arguments))
        raise


class _GroupedCommand(typer.core.TyperCommand):
    """A command whose help lists its options in groups with headings, those of its ``view``."""

    view: Callable[[Sequence[str]], HelpView] | None = None

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        ctx.meta[_ARGUMENTS] = list(args)
        return super().parse_args(ctx, args)

    def _choose_view(self, ctx: Any) -> HelpView:
        return self.view(ctx.meta.get(_ARGUMENTS, ())) if self.view is not None else HelpView()

    def format_help_text(self, ctx: Any, formatter: Any) -> None:
        super().format_help_text(ctx, formatter)
        if text := self._choose_view(ctx).text:
            formatter.write_paragraph()
            with formatter.indentation():
                formatter.write_text(text)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        view, sections = self._choose_view(ctx), dict[str, list[tuple[str, str]]]()
        for shown in self.get_params(ctx):
            record = shown.get_help_record(ctx)
            if record is not None and shown.name not in view.hidden:
                record = record[0], view.helps.get(shown.name or "", record[1])
                sections.setdefault(_heading(shown), []).append(record)
        sections |= {heading: list(records) for heading, records in view.lists.items()}
        for heading, records in sections.items():
            with formatter.section(heading):
                formatter.write_dl(records)


_ARGUMENTS = "nerg_mi.arguments"  # of the command, in click's context


def _heading(shown: Any) -> str:
    if shown.param_type_name == "argument":
        return "Arguments"
    return f"{shown.rich_help_panel} options" if shown.rich_help_panel else "Other options"


def _group_position(shown: Any) -> int:
    """Sort key: arguments first, then options by their groups."""
    if shown.param_type_name == "argument":
        return -1
    return GROUPS_OF_OPTIONS.index(shown.rich_help_panel) if shown.rich_help_panel else len(GROUPS_OF_OPTIONS)


def build_command(command: Command, line: str = "") -> Any:
    """Return the parser of ``command``; ``line`` is its help line in the list of commands."""
    app = typer.Typer(add_completion=False, rich_markup_mode=None)
    help = "\n\n".join(text for text in (command.help or line, command.more) if text)
    app.command(command.name.split()[-1], help=help, cls=_GroupedCommand)(make_callback(command))
    parser: Any = typer.main.get_command(app)
    parser.view = command.view
    # In the order of the help, also for the reference in the manual.
    parser.params.sort(key=_group_position)
    return parser


def make_callback(command: Command) -> Callable[..., None]:
    """Return the function that typer calls: its parameters are those of ``command`` and one option for each field of
    its options.

    A boolean field that is False by default becomes a flag; one that is True by default gets a ``--no-`` form. A field
    of type ``tuple[X, ...]`` or ``Mapping`` becomes a repeatable option.
    """
    kind = command.options
    every = {} if kind is None else {f.name: f for f in fields(kind)}
    more = command.parameters
    shown = {name: f for name, f in every.items() if name not in more and name not in command.without}
    parameters = {name: _parameter(name, p) for name, p in more.items()}
    parameters |= {name: _option(f, get_type_hints(kind)[name]) for name, f in shown.items()}
    spelling = _make_spelling(parameters, command.without)

    def call(**values: Any) -> None:
        if kind is not None:
            settings = {name: _value(f, parameters[name], values.pop(name)) for name, f in shown.items()}
            settings |= {name: values.pop(name) for name in more if name in every}
            values["options"] = kind(**settings)
        with TerminalReporter(spelling) as reporter:
            command.run(**values, reporter=reporter)

    call.__signature__ = inspect.Signature(list(parameters.values()))
    call.__annotations__ = {name: p.annotation for name, p in parameters.items()}
    call.__dict__["spelling"] = spelling
    return call


# Spellings of parameters in messages that advise another command, where the option is not named as the parameter.
_FLAGS = {
    "columns": "--map",
    "defaults": "--define",
    "handedness": "--hand",
    "observers": "--observer",
    "persons": "--person",
}


def _make_spelling(parameters: Mapping[str, inspect.Parameter], without: Sequence[str] = ()) -> Spelling:
    """Return the spelling of ``parameters`` in messages: options by their flags, and arguments in capital letters.

    Those that the command is ``without`` are spelled as in Python.
    """
    flags = dict(_FLAGS)
    for name, declared in parameters.items():
        (info,) = declared.annotation.__metadata__
        if isinstance(info, typer.models.OptionInfo):
            # In annotations, typer stores the first spelling as the default.
            names = [f"--{name.replace('_', '-')}", info.default, *(info.param_decls or ())]
            flags[name] = [spelling for spelling in names if isinstance(spelling, str)][-1]
        else:
            flags[name] = info.metavar or name.upper()

    def spell(name: str, value: str) -> str:
        if name in without:
            return spell_python(name, value)
        flag = flags.get(name, "")
        return spell_command_line(name, value, flag) if flag.startswith("-") or not flag else flag

    return spell


def choose_spelling(arguments: Sequence[str]) -> Spelling:
    """Return the spelling of parameters in messages of the command that ``arguments`` call."""
    for name, row in ROWS.items():
        words = name.split()
        if words == list(arguments[: len(words)]):
            return make_callback(make_command(row)).__dict__["spelling"]
    return _make_spelling({})


def _parameter(name: str, declared: Parameter) -> inspect.Parameter:
    """Return the parameter from which typer makes an argument, or an option that is not a field."""
    make = typer.Option if declared.names else typer.Argument
    default = inspect.Parameter.empty if declared.default is ... else declared.default
    hint = declared.kind | None if default is None else declared.kind
    return _keyword(name, hint, default, make(*declared.names, help=declared.help, **declared.more))


def _option(field: Field, hint: Any) -> inspect.Parameter:
    """Return the parameter from which typer makes the option of ``field``."""
    metadata, default, names = field.metadata, field.default, field.metadata["names"]
    more, within, is_parsed = metadata["more"], metadata[RANGE], metadata["parse"] is not None
    if within is KAPPAS and not is_parsed:
        # The dataclass converts an angle and checks the range.
        hint, default = str | None, None if default is None else f"{default:g}"
        more, is_parsed = more | {"metavar": "<number or angle>"}, True
    elif is_parsed:
        hint = list[str] | None if any(_is_of_several(kind) for kind in get_args(hint)) else str | None
    elif get_origin(hint) is tuple:
        hint, default = list[get_args(hint)[0]] | None, None
    elif Path in get_args(hint):
        hint = Path | None
    if hint is bool and default is False and not names:
        names = ("--" + field.name.replace("_", "-"),)
    if within is not None and not is_parsed and not _is_repeatable(hint):
        # Shown in the help; the dataclass checks the range, also for Python callers.
        more = more | {"min": within.low, "max": within.high}
    return _keyword(field.name, hint, default, typer.Option(*names, help=metadata["help"], **more))


def _keyword(name: str, hint: Any, default: Any, info: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[hint, info])


def _is_of_several(kind: Any) -> bool:
    """Whether a parsed option with values of this ``kind``, a mapping or a tuple of points, is repeated."""
    return get_origin(kind) is Mapping or (get_origin(kind) is tuple and get_origin(get_args(kind)[0]) is tuple)


def _is_repeatable(hint: Any) -> bool:
    return any(get_origin(kind) is list for kind in get_args(hint))


def _value(field: Field, declared: inspect.Parameter, value: Any) -> Any:
    """Convert the ``value`` of ``field`` from the command line."""
    parse = field.metadata["parse"]
    value = tuple(value or ()) if _is_repeatable(get_args(declared.annotation)[0]) else value
    if parse is None or value is None:
        return value
    return parse(value, parameter(field.name))
