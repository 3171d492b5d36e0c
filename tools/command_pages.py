"""Command-line reference as Markdown: every command, option and default, read from the parser."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from tools.page import wrapped


def iter_commands() -> Iterator[tuple[str, Any, Any]]:
    """Yield each command that runs something: its words, such as "nerg train gaze", its parser command, and a
    context."""
    import typer

    from nerg_mi import cli

    yield from _below(typer.main.get_command(cli.build_app()), "nerg", None)


def _below(command: Any, name: str, parent: Any) -> Iterator[tuple[str, Any, Any]]:
    context = command.make_context(name, [], parent=parent, resilient_parsing=True)
    for below in getattr(command, "commands", {}):
        _, other, _ = command.resolve_command(context, [below])
        yield from _below(other, below, context)
    if not hasattr(command, "commands"):
        yield context.command_path, command, context


def format_reference() -> str:
    """Format a section per command: description, usage, arguments and options."""
    sections = []
    for path, command, context in iter_commands():
        sections += [f"## {path}", _paragraphs(command.help or "")]
        usage = " ".join([path, *command.collect_usage_pieces(context)])
        sections += [f"Usage: `{usage}`", *_lists(command, context)]
    return "\n\n".join(sections)


def _lists(command: Any, context: Any) -> Iterator[str]:
    """Yield a list of the arguments and one of the options, if there are any."""
    groups: dict[str, list[str]] = {}
    for parameter in command.params:
        record = parameter.get_help_record(context)
        if record is None or parameter.name == "help":
            continue
        meaning, default = split_default(record[1])
        text = escape_cell(_spell_range(meaning))
        if default == "required":
            text += " Required."
        elif default:
            text += f" Default: `{default}`."
        panel = getattr(parameter, "rich_help_panel", None)
        name = "Arguments" if parameter.param_type_name == "argument" else panel or "Options"
        term = record[0].replace(" range>", ">").replace("<list[", "<").replace("]>", ">")
        groups.setdefault(name, []).append(wrapped(f"- `{term}`: {text}"))
    for name, items in groups.items():
        yield f"**{name}**"
        yield "\n".join(items)


def _spell_range(meaning: str) -> str:
    """Spell a range at the end of a help text, "(0<=x<=1)", as "From 0 to 1."."""
    match = re.fullmatch(r"(.*?) \(([-+\w.]+)<=x<=([-+\w.]+)\)", meaning, re.S)
    if match is None:
        return meaning
    low, high = (re.sub(r"\.0$", "", number) for number in match.group(2, 3))
    return f"{match[1]} From {low} to {high}."


_RANGE = re.compile(r"(?:[-+\w.]+<=?)?x(?:[<>]=?[-+\w.]+)?")


def split_default(text: str) -> tuple[str, str]:
    """Split the help of a parameter into its text with the range, and its default or "required", which the parser
    appends in brackets.
    """
    match = re.fullmatch(r"(.*?)\s*\[([^\[\]]*)\]", text, re.S)
    notes = [note.strip() for note in match[2].split(";")] if match else []
    ranges = [note for note in notes if _RANGE.fullmatch(note)]
    rest = [note for note in notes if note not in ranges and note != "required"]
    if match is None or not (ranges or "required" in notes or (rest and rest[0].startswith("default:"))):
        return text, ""
    # A default in words is part of the help text, in its own brackets.
    meaning, default = split_default(match[1]) if not rest else (match[1], "; ".join(rest).removeprefix("default:"))
    meaning += "".join(f" ({note})" for note in ranges)
    return meaning, default.strip() or ("required" if "required" in notes else "")


def escape_cell(text: str) -> str:
    """Escape Markdown markup in the help text of a table cell."""
    text = " ".join(text.split())
    return re.sub(r"([*<]|(?<!\w)_|_(?!\w))", r"\\\1", text)


def _paragraphs(text: str) -> str:
    """Join the lines of each paragraph of a command's help."""
    return "\n\n".join(wrapped(escape_cell(part)) for part in re.split(r"\n\s*\n", text.strip()))
