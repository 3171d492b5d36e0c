"""Basics of all workflows: backend selection, command declarations, and library versions."""

from __future__ import annotations

import importlib
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from nerg_mi import __version__, llvm
from nerg_mi.options import OUTPUT, PANEL
from nerg_mi.threads import set_thread_count

# ---- Backend: the Mitsuba variant and the number of threads ----


def select_backend(mode: str | None, threads: int | None = None) -> ModuleType:
    """Activate the Mitsuba variant ``mode`` and return its Dr.Jit namespace, such as ``drjit.llvm.ad``.

    ``mode`` None selects the fastest variant that works. ``threads`` is the number of CPU threads; None or 0 uses all
    cores. Raises `NergError` for a variant that does not exist or does not work.
    """
    from nerg_mi.fields.mlp import namespace
    from nerg_mi.rendering.scene import activate_variant

    active = activate_variant(mode)
    if threads:
        set_thread_count(threads)
    return namespace(active)


# ---- Commands ----
#
# A command is a function of a workflow. It is declared where it is defined, or by name in a module that is quick to
# import, because help and completion import only that module.
#
# The module docstring starts with one line for each command, as in "``nerg train gaze``: Train a gaze field on gaze
# rays ...". The command line finds commands by these lines without importing modules, so a new module adds a command
# without any other change.


@dataclass(frozen=True)
class Parameter:
    """A parameter of a command that is not a field of its options."""

    help: str
    # Type of the value: Path, str, list[Path] for several values, ...
    kind: Any = Path
    # ... marks a required value.
    default: Any = ...
    # Spellings of an option; empty for an argument.
    names: tuple[str, ...] = ()
    # Further parameters of typer.Option or typer.Argument, such as ``metavar``.
    more: Mapping[str, Any] = field(default_factory=dict)


def argument(help: str, kind: Any = Path, *, required: bool = True, **more: Any) -> Parameter:
    """Declare a positional argument; ``kind`` list[...] takes several values."""
    return Parameter(help, kind, ... if required else None, more=more)


def out(help: str, kind: Any = Path, *, default: Any = ...) -> Parameter:
    """Declare the option ``-o``, ``--output``."""
    return Parameter(help, kind, default, ("-o", "--output"), {PANEL: OUTPUT})


def extra(default: Any, help: str, kind: Any, *names: str, group: str = "", **more: Any) -> Parameter:
    """Declare an option that is not a field of the command's options."""
    return Parameter(help, kind, default, names, {**more, PANEL: group})


@dataclass(frozen=True)
class HelpView:
    """What ``--help`` shows of a command with many options, depending on its other arguments."""

    # Paragraph after the help of the command.
    text: str = ""
    # Names of parameters that are not listed.
    hidden: frozenset[str] = frozenset()
    # Help texts in place of those of the parameters, by name.
    helps: Mapping[str, str] = field(default_factory=dict)
    # Further lists of terms and descriptions, by heading.
    lists: Mapping[str, Sequence[tuple[str, str]]] = field(default_factory=dict)


@dataclass(frozen=True)
class Command:
    """A command as declared by `command`."""

    name: str
    run: Callable[..., Any]
    help: str
    more: str
    options: type | None
    without: tuple[str, ...]
    further: Callable[[], Mapping[str, Parameter]] | None
    parameters: Mapping[str, Parameter]
    view: Callable[[Sequence[str]], HelpView] | None = None


COMMANDS: dict[str, Command] = {}
"""Commands of all imported modules, by name."""

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
    view: Callable[[Sequence[str]], HelpView] | None = None,
    **parameters: Parameter,
) -> Callable[[Run], Run]:
    """Declare the decorated function as what ``nerg NAME`` runs. The function is not changed.

    The function is called with keyword arguments: the values of ``parameters``, ``options`` if there are any, and
    ``reporter``.

    Parameters
    ----------
    name
        Words of the command, as "train gaze".
    help
        Summary for ``--help``, if it differs from the line in the module docstring.
    more
        Further paragraphs for ``--help``.
    options
        Dataclass whose fields become options (`nerg_mi.options.option`).
    without
        Fields that are not exposed on the command line.
    further
        Returns additional parameters when the command is called, for options that plugins register.
    view
        Returns what ``--help`` shows with the arguments of the command line. Default: everything.
    parameters
        Arguments and options. The names are those of fields of ``options`` or of parameters of the function.
    """

    def decorate(run: Run) -> Run:
        COMMANDS[name] = Command(name, run, help, more, options, without, further, parameters, view)
        return run

    return decorate


def declare(name: str, function: str, help: str = "", /, **settings: Any) -> None:
    """Declare the command ``name`` like `command`; ``function``, as "MODULE:NAME", is imported when it runs."""

    def run(**values: Any) -> Any:
        return import_function(function)(**values)

    command(name, help, **settings)(run)


def import_function(function: str) -> Callable[..., Any]:
    """Import and return the function "MODULE:NAME"."""
    module, _, name = function.partition(":")
    return getattr(importlib.import_module(module), name)


# ---- Versions of libraries, for reports ----


def versions(mode: str) -> dict[str, str]:
    """Return the versions of all libraries that affect results, by name; ``mode`` is the active Mitsuba variant."""
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
