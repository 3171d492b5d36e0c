"""``nerg rays import``: its options are those of all readers, besides its own."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from nerg_mi.errors import NergError
from nerg_mi.ranges import THREADS
from nerg_mi.rays.readers.registry import SharedOption, preset_names, shared_options

from .arguments import Output, print_card

IMPORT_HELP = "Convert tracking files to rays: right-handed, z up, metres, seconds."


def make_import_command() -> Callable[..., None]:
    """The command with the options of all readers that are registered now."""
    options = shared_options()

    def command(**given: Any) -> None:
        settings = {o.name: given.pop(o.name) for o in options}
        _import_rays(
            **given,
            settings={name: value for name, value in settings.items() if value is not None and value is not False},
        )

    own = inspect.signature(_own_options, eval_str=True).parameters.values()
    before, after = ([p for p in own if (p.name in ("files", "output", "preset")) == first] for first in (True, False))
    parameters = [*before, *map(_parameter, options), *after]
    command.__signature__ = inspect.Signature([p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in parameters])
    command.__annotations__ = {p.name: p.annotation for p in parameters}
    return command


def _own_options(
    files: Annotated[
        list[Path], typer.Argument(help="Tracking files (CSV, CSV.gz, Parquet or skeleton files; for pupil, folders).")
    ],
    output: Output,
    preset: Annotated[str | None, typer.Option(help=f"Known recording: {', '.join(preset_names())}.")] = None,
    write_align: Annotated[
        Path | None,
        typer.Option(
            help="JSON file to write: the similarity from the rays to the files' own frame, for --align where a place "
            "is in that frame."
        ),
    ] = None,
    place_name: Annotated[
        str | None, typer.Option(help="Of a dataset: the place of all files.  [default: unknown]")
    ] = None,
    day: Annotated[
        str | None,
        typer.Option(
            help="Of a dataset: the day of all rays, as 2026-11-22.  [default: by their times, in UTC, else unknown]"
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            help="Of a dataset: processes that import files beside each other.  [default: a core each]",
            min=THREADS.low,
            max=THREADS.high,
        ),
    ] = None,
    skip_bad_lines: Annotated[
        bool,
        typer.Option(
            "--skip-bad-lines",
            help="Leave out lines that cannot be read, with an account of them: at most 1 % of a file's.",
        ),
    ] = False,
    pseudonyms: Annotated[
        bool,
        typer.Option(
            "--pseudonyms", help="Replace the names of persons, also in the names of files, by salted hashes."
        ),
    ] = False,
    salt: Annotated[
        Path | None,
        typer.Option(
            help="--pseudonyms: file of 16 random bytes or more, so that several imports agree.  "
            "[default: random, not kept]"
        ),
    ] = None,
) -> None:
    """The options of the import itself; never called."""


def _parameter(option: SharedOption) -> inspect.Parameter:
    """An option of readers as the command has it: None, or false, where it was not given."""
    flag = option.kind is bool
    return inspect.Parameter(
        option.name,
        inspect.Parameter.KEYWORD_ONLY,
        default=False if flag else None,
        annotation=Annotated[bool if flag else option.kind | None, typer.Option(option.flag, help=option.help)],
    )


def _import_rays(
    files: list[Path], output: Path, preset: str | None, write_align: Path | None, settings: dict[str, Any], **more: Any
) -> None:
    from nerg_mi.cli.progress import TerminalReporter
    from nerg_mi.jobs.tracking import ImportOptions, import_rays
    from nerg_mi.rays.readers.registry import TABLE, parse_options

    if (preset is None) == ("columns" not in settings):
        raise NergError("say what the files are: either --preset NAME or --map COLUMNS")
    reader = preset or TABLE
    options = ImportOptions(
        reader=reader, settings=parse_options(reader, settings), output=output, align_output=write_align, **more
    )
    with TerminalReporter() as reporter:
        result = import_rays(files, options, reporter)
    print_card(result.rays, result.summary, output, result.lines)
    typer.echo(f"wrote {output}")
    if write_align is not None:
        typer.echo(f"wrote {write_align}")
