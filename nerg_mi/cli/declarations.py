"""How a command is declared, and the Mitsuba variant that it runs with."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nerg_mi.options import OUTPUT, PANEL
from nerg_mi.threads import set_thread_count

# ---- Backend: the Mitsuba variant and the number of threads ----


def select_backend(mode: str | None, threads: int | None = None, *, allow_scalar: bool = False) -> None:
    """Activate the Mitsuba variant ``mode``.

    ``mode`` None selects the fastest variant that works. ``threads`` is the number of CPU threads; None or 0 uses all
    cores. Raises `NergError` for a variant that does not exist or does not work, and for scalar variants unless
    ``allow_scalar``, since fields need Dr.Jit.
    """
    from nerg_mi.environment.scene_loading import activate_variant
    from nerg_mi.fields.mlp import namespace

    active = activate_variant(mode)
    if threads:
        set_thread_count(threads)
    if not allow_scalar:
        namespace(active)


# ---- Commands ----
#
# A command is a row of `nerg_mi.cli.table`.


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
    """A command, as `nerg_mi.cli.signatures.make_command` makes it of a row."""

    name: str
    run: Callable[..., Any]
    help: str
    more: str
    options: type | None
    without: tuple[str, ...]
    parameters: Mapping[str, Parameter]
    view: Callable[[Sequence[str]], HelpView] | None = None


def import_function(function: str) -> Callable[..., Any]:
    """Import and return the function "MODULE:NAME"."""
    module, _, name = function.partition(":")
    return getattr(importlib.import_module(module), name)
