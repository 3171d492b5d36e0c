"""What workflows have in common: how commands are declared, the Mitsuba variant, the reporter of progress, and
versions of libraries."""

from __future__ import annotations

import importlib
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, TypeVar

from nerg_mi import __version__, llvm
from nerg_mi.threads import set_thread_count

# ---- Where a job computes: the Mitsuba variant and the number of threads ----


def select_backend(mode: str | None, threads: int | None = None) -> ModuleType:
    """Make the Mitsuba variant ``mode`` the active one and return its Dr.Jit namespace, such as ``drjit.llvm.ad``.

    ``mode``: None for the best that works here; ``threads``: of the CPU, None or 0 for all. Raises `NergError` for a
    variant that does not exist or does not work.
    """
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.rendering.scene import activate_variant

    active = activate_variant(mode)
    if threads:
        set_thread_count(threads)
    return namespace(active)


# ---- Commands ----
#
# What the command line runs: functions of workflows, each declared as a command where it is defined, or by its name
# in a module that loads quickly, since help and completion import that module alone.
#
# A module with commands begins with their names and their lines in the list of commands, as in "``nerg train gaze``:
# Train a gaze field on rays of attention." The command line finds it by these lines, without importing it, so that a
# further command is a further module and nothing else.


@dataclass(frozen=True)
class Parameter:
    """What a command takes besides the fields of its options."""

    help: str
    # Of its value: Path, str, list[Path] for several, ...
    kind: Any = Path
    # ... where a value must be given.
    default: Any = ...
    # How an option is spelled; an argument has no name.
    names: tuple[str, ...] = ()
    # What else typer.Option or typer.Argument takes, such as ``metavar``.
    more: Mapping[str, Any] = field(default_factory=dict)


def argument(help: str, kind: Any = Path, *, required: bool = True, **more: Any) -> Parameter:
    """An argument, by its position on the command line; of several values where ``kind`` is a list."""
    return Parameter(help, kind, ... if required else None, more=more)


def out(help: str, kind: Any = Path, *, default: Any = ...) -> Parameter:
    """The option ``--output``, or ``-o``."""
    return Parameter(help, kind, default, ("-o", "--output"))


def extra(default: Any, help: str, kind: Any, *names: str, **more: Any) -> Parameter:
    """A further option that is no field of the command's options."""
    return Parameter(help, kind, default, names, more)


@dataclass(frozen=True)
class Command:
    """A command as `command` declares it."""

    name: str
    run: Callable[..., Any]
    help: str
    more: str
    options: type | None
    without: tuple[str, ...]
    further: Callable[[], Mapping[str, Parameter]] | None
    parameters: Mapping[str, Parameter]


COMMANDS: dict[str, Command] = {}
"""The commands of all modules that have been imported, by name."""

Run = TypeVar("Run", bound=Callable[..., Any])


def command(
    name: str,
    help: str = "",
    /,
    *,
    more: str = "",
    options: type | None = None,
    without: tuple[str, ...] = (),
    further: Callable[[], Mapping[str, Parameter]] | None = None,
    **parameters: Parameter,
) -> Callable[[Run], Run]:
    """Decorator of the function that ``nerg NAME`` runs, which stays as it is.

    It is called with keywords: the values of its parameters, ``options`` where it has any, and ``reporter``.

    Parameters
    ----------
    name
        Its words, as "train gaze".
    help
        What ``--help`` says, where that is not the line at the beginning of the module.
    more
        Further paragraphs of that.
    options
        Dataclass of which each field is an option (`nerg_mi.workflows.options.option`).
    without
        Fields of it that the command line does not set.
    further
        Gives more parameters when the command is called, for what others may register.
    parameters
        Arguments and options by the names of what they set: a field of ``options``, or a parameter of the function.
    """

    def decorate(run: Run) -> Run:
        COMMANDS[name] = Command(name, run, help, more, options, without, further, parameters)
        return run

    return decorate


def declare(name: str, function: str, help: str = "", /, **settings: Any) -> None:
    """Declare the command ``name`` as `command` does; ``function``: what it runs, as "MODULE:NAME", imported then."""

    def run(**values: Any) -> Any:
        return import_function(function)(**values)

    command(name, help, **settings)(run)


def import_function(function: str) -> Callable[..., Any]:
    """The function "MODULE:NAME"."""
    module, _, name = function.partition(":")
    return getattr(importlib.import_module(module), name)


# ---- Whom a job tells how it goes: a command's terminal, a notebook, or nobody ----


class Reporter(Protocol):
    """Listens to a job. Each method returns at once and raises nothing, but for `KeyboardInterrupt` in `progress`,
    which ends the job as Ctrl-C does."""

    def message(self, text: str) -> None:
        """A line about what was found or written."""

    def warn(self, text: str) -> None:
        """A line about what may be wrong with the result."""

    def progress(self, share: float, text: str = "") -> None:
        """How much of the work is done, from 0 to 1, and what is being done."""


class SilentReporter:
    """Listens to nothing."""

    def message(self, text: str) -> None:
        pass

    def warn(self, text: str) -> None:
        pass

    def progress(self, share: float, text: str = "") -> None:
        pass


SILENT = SilentReporter()
"""The reporter of jobs that were given none."""


# ---- What a report says about the programs that made it ----


def versions(mode: str) -> dict[str, str]:
    """Version of each program that has a part in the numbers, by name; ``mode``: the Mitsuba variant in use."""
    import drjit
    import mitsuba
    import numpy

    out = {
        "nerg_mi": __version__,
        "mitsuba": mitsuba.__version__,
        "drjit": drjit.__version__,  # pyright: ignore[reportAttributeAccessIssue] which its stubs leave out
        "numpy": numpy.__version__,
        "python": platform.python_version(),
    }
    library = llvm.find_current()
    if mode.startswith("llvm") and library is not None:
        out["libLLVM"] = ".".join(map(str, library.version))
    if mode.startswith("cuda"):
        out["cuda"] = ".".join(map(str, drjit.detail.cuda_version()))
    return out
