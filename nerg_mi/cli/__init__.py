"""The command `nerg`: finds the sub-command, runs it, and tells an expected error in one sentence.

A sub-command NAME is a line in `COMMANDS` and either a function `NAME_command` (its parameters are the options, its
docstring the help) or `NAME_app`, a `typer.Typer` with sub-commands of its own, in the module NAME. Only that module is
imported, so that `nerg --help` answers at once; for the same reason these modules import Mitsuba, NumPy and the like
inside their functions.
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any

from nerg_mi import __version__

from .ending import INTERRUPTED, CtrlC, end_of, open_streams, quiet_ctrl_c, shorten_values

with quiet_ctrl_c():
    import typer
    import typer.core

    from .completion import completed_command

COMMANDS = {
    "demo": "Render the demo store: pictures of what a gaze field is.",
    "doctor": "Say what works on this machine, and how to mend what does not.",
    "scene": "Write a scene file for a field, a mesh, a gaze field or rays, with a camera and an observer.",
    "view": "Show a place with its gaze in the browser, where the observer is dragged.",
    "render": "Render a scene file to a picture or a video.",
    "draw": "Draw a figure: a gaze sphere, occlusion, a floor plan, a contact sheet, a difference.",
    "rays": "Import tracking files as rays of attention, and look at what they hold.",
    "poses": "Find out from where photos, or frames of a video, were taken.",
    "align": "Find how tracking lies in a place: from points, a twin, cameras, or the tracking alone.",
    "train": "Train a radiance field on posed photos, or a gaze field on rays.",
    "eval": "Score a trained radiance field on held-out views, or a gaze field on held-out rays.",
    "report": "Write a report on a gaze field: one HTML file with a verdict, pictures, scores and the place in 3D.",
    "import": "Convert checkpoints of torch-ngp and of the NeRG paper's authors.",
    "export": "Write a radiance field as a mesh, points, Gaussian splats, grid volumes or a torch-ngp checkpoint.",
    "refine": "Find more closely where a radiance field holds matter, so that it renders faster.",
    "bake": "Put gaze on surfaces: how much of it each square metre receives, as colours and tables.",
    "ablate": "Train every variant of a gaze field alike, and compare them.",
    "stats": "Count attention on things, in rays and by a gaze field: numbers with intervals, and what if.",
    "jobs": "Say what is done of a long job, what is left and what is stale.",
    "worker": "Run parts of long jobs for a cluster (dask).",
    "study": "Measure error against run time: a scene at many settings, compared with what is true.",
}
"""Name of each sub-command, which is also that of its module, and the line that `nerg --help` says about it."""


# That of the parser, which typer does not name.
_UsageError: Any = typer.BadParameter.__base__

_DEBUG = ("--debug", "--traceback")


def main(arguments: list[str] | None = None) -> None:
    """Run the command line `arguments` (default: that of the process) and end the process.

    Exit codes: 0 done; 1 what the user can mend, told in one sentence; 2 a wrong command line; 70 a mistake in the
    program itself, which is said to be one; 130 interrupted. With --debug (also: --traceback, or NERG_TRACEBACK=1) the
    traceback is shown before. Whoever reads the output may go away at any time: nothing is said about that. A command
    that ends early on Ctrl-C leaves its outputs whole or absent and raises `KeyboardInterrupt`, whose message, where it
    has one, says how to go on.
    """
    open_streams()
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    asked_by_environment = os.environ.get("NERG_TRACEBACK", "0") not in ("", "0")
    debug = asked_by_environment or not set(_DEBUG).isdisjoint(arguments)
    # Allowed anywhere on the line: it is added after something went wrong, at the end.
    arguments = [a for a in arguments if a not in _DEBUG]
    with CtrlC() as ctrl_c:
        try:
            asked = completed_command(os.environ, COMMANDS) or next((a for a in arguments if a[:1] != "-"), None)
            try:
                build_app(asked, arguments)(arguments, prog_name="nerg")
            finally:
                sys.stdout.flush()
        except BaseException as error:
            interrupt = ctrl_c.behind(error)
            if interrupt is not None:
                print(str(interrupt) or "Interrupted.", file=sys.stderr)
                sys.exit(INTERRUPTED)
            if not isinstance(error, Exception):  # the end of a command
                raise
            if debug:
                traceback.print_exception(error)
            code, text = end_of(error)
            print(f"nerg: {shorten_values(text, arguments)}", file=sys.stderr)
            sys.exit(code)


def build_app(asked: str | None, arguments: Sequence[str] = ()) -> typer.Typer:
    """All commands, of which only the one `asked` for is more than its name and its line of help. Messages about a
    wrong command line repeat the beginning of what is long among its `arguments`."""

    class Commands(typer.core.TyperGroup):
        def make_context(self, *args: Any, **kwargs: Any) -> Any:
            with _shortened(arguments):
                return super().make_context(*args, **kwargs)

        def invoke(self, ctx: Any) -> Any:
            with _shortened(arguments):
                return super().invoke(ctx)

    app = typer.Typer(
        name="nerg",
        cls=Commands,
        help="Neural radiance and gaze fields for Mitsuba 3.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_global_options)
    for name, line in COMMANDS.items():
        if name != asked:
            app.command(name, help=line)(_unasked)
            continue
        command = load_command(name)
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=name, help=line)
        else:
            app.command(name)(command)
    return app


def load_command(name: str) -> Callable[..., None] | typer.Typer:
    """The function that is the sub-command ``name``, or the app of its sub-commands."""
    module = vars(importlib.import_module(f"{__name__}.{name}"))
    return module[f"{name}_app"] if f"{name}_app" in module else module[f"{name}_command"]


@contextmanager
def _shortened(arguments: Sequence[str]) -> Iterator[None]:
    """A block whose errors about the command line repeat the ends of long ``arguments``."""
    try:
        yield
    except _UsageError as error:
        error.message = shorten_values(error.message, arguments)
        raise


def _unasked() -> None:
    """Stands for a command in the list of commands; one that is run has been asked for."""


def _version(wanted: bool) -> None:
    if wanted:
        print(f"nerg {__version__}")
        raise typer.Exit()


def _global_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[bool, typer.Option(*_DEBUG, help="Show where an error arose (also: NERG_TRACEBACK=1).")] = False,
) -> None:
    pass
