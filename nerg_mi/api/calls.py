"""Calls of workflows by functions of the API: progress, and messages that name objects in memory."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.progress import SILENT, Progress, Reporter, SpellingReporter, is_notebook, open_reporter

from .session import name_objects


@contextmanager
def report_progress(progress: Progress) -> Iterator[Reporter]:
    """Yield the reporter of a call (`nerg_mi.progress.open_reporter`).

    Errors, warnings and messages within the block name objects in memory in place of their files.
    """
    try:
        with open_reporter(progress) as reporter:
            yield _NamingReporter(reporter)
    except NergError as error:
        error.args = (name_objects(error.message), *error.args[1:])
        raise


def show_figure(figure: Any) -> Any:
    """Return a new ``figure``, made the current one of pyplot, if that is imported, for its ``savefig`` and ``show``.

    A notebook shows what a cell returns, and would show the figure twice.
    """
    pyplot = sys.modules.get("matplotlib.pyplot")
    if pyplot is not None and not is_notebook():
        pyplot.figure(FigureClass=lambda **_: figure)
    return figure


class _NamingReporter(SpellingReporter):
    """Passes on what a workflow reports, with objects in place of their files."""

    def __init__(self, reporter: Reporter) -> None:
        super().__init__(reporter)
        self.is_silent = reporter is SILENT

    def message(self, text: str) -> None:
        super().message(name_objects(text))

    def warn(self, text: str) -> None:
        super().warn(name_objects(text))
