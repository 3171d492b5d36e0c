"""Calls of workflows by functions of the API: progress, and messages that name arguments and objects in memory."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import Field, fields
from typing import Any, TypeAlias

from nerg_mi.errors import NergError
from nerg_mi.progress import SILENT, NotebookReporter, Reporter, TerminalReporter, WarningReporter, is_notebook
from nerg_mi.ranges import FLAG

from .session import name_objects

Progress: TypeAlias = "bool | Reporter | None"
"""Progress of a call: None shows a bar in notebooks, True shows one anywhere, False shows none. Warnings about the
result become Python warnings where there is no bar. A `nerg_mi.progress.Reporter` receives everything."""


@contextmanager
def report_progress(progress: Progress, *options: type) -> Iterator[Reporter]:
    """Yield the reporter of a call.

    Errors, warnings and messages within the block name the arguments of Python in place of options of the command line.

    Parameters
    ----------
    progress : bool, Reporter or None
        See `Progress`.
    *options : type
        Dataclasses of the options, by whose spellings arguments are recognised.
    """
    names: dict[str, Field[Any]] = {}
    for f in (f for kind in options for f in fields(kind)):
        names[f.metadata.get(FLAG) or f"--{f.name.replace('_', '-')}"] = f
    try:
        if progress is None or isinstance(progress, bool):
            shows = is_notebook() if progress is None else progress
            reporter = WarningReporter() if not shows else NotebookReporter() if is_notebook() else TerminalReporter()
            with reporter as opened:
                yield _ArgumentReporter(opened, names)
        elif isinstance(progress, Reporter):
            yield _ArgumentReporter(progress, names)
        else:
            raise NergError(f"progress must be True, False or a Reporter, got {type(progress).__name__}")
    except NergError as error:
        error.args = (_name_arguments(str(error), names), *error.args[1:])
        raise


def show_figure(figure: Any) -> Any:
    """Return a new ``figure``, made the current one of pyplot, if that is imported, for its ``savefig`` and ``show``.

    A notebook shows what a cell returns, and would show the figure twice.
    """
    pyplot = sys.modules.get("matplotlib.pyplot")
    if pyplot is not None and not is_notebook():
        pyplot.figure(FigureClass=lambda **_: figure)
    return figure


class _ArgumentReporter:
    """Passes on what a workflow reports, with the names of arguments."""

    def __init__(self, reporter: Reporter, names: dict[str, Field[Any]]) -> None:
        self._reporter, self._names = reporter, names
        self.is_silent = reporter is SILENT
        self.progress = reporter.progress

    def message(self, text: str) -> None:
        self._reporter.message(_name_arguments(text, self._names))

    def warn(self, text: str) -> None:
        self._reporter.warn(_name_arguments(text, self._names))


# A complete command, which remains one, or an option with its value: a placeholder, a number or a word that is a value.
_OPTION = re.compile(
    r"(?P<command>\bnerg [a-z][^;'\"]*)"
    r"|(?<![\w-])--(?P<flag>[a-z][a-z0-9-]*[a-z0-9])"
    r"(?: (?P<place>[A-Z][A-Z0-9_]*)\b| (?P<number>-?\d[\d.,]*\d|\d)(?![\w%])"
    r"| (?P<word>hits|none|field|random|ivt|idt)\b)?"
)


def _name_arguments(text: str, names: dict[str, Field[Any]]) -> str:
    """Replace options in ``text``, as ``--test-zones 3``, by arguments, as ``test_zones=3``, and files of objects."""

    def replace(match: re.Match[str]) -> str:
        if match["command"]:
            return match[0]
        declared = names.get(f"--{match['flag']}")
        name = match["flag"].replace("-", "_") if declared is None else declared.name
        if declared is not None and str(declared.type) == "bool" and not (match["place"] or match["number"]):
            return f"{name}=True" + (f" {match['word']}" if match["word"] else "")
        if match["word"]:
            return f'{name}="{match["word"]}"'
        value = match["place"] or match["number"]
        return name if value is None else f"{name}={value}"

    return name_objects(_OPTION.sub(replace, text))
