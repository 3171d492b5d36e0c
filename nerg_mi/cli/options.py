"""Options of commands, made of the typed options of jobs.

A job's options are a dataclass whose fields tell their defaults and meanings (``nerg_mi.jobs.options``). A command that
takes it as one parameter shows an option for each of its fields.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import Field, fields
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from nerg_mi.ranges import RANGE


def takes(kind: type, *leave_out: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator of a command with a parameter of the dataclass ``kind``: in its place the command line has one option
    for each field, but for those called ``leave_out``, which keep their defaults.

    A field that is True or False and False by default is a flag that sets it; one that is True by default can be
    unset by ``--no-``. A field of type ``tuple[X, ...]`` may be given several times.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True).parameters
        given_as = next(name for name, p in own.items() if p.annotation is kind)
        generated = {f.name: _parameter(f, kind) for f in fields(kind) if f.name not in leave_out}
        told = {f.name: f.metadata for f in fields(kind) if f.name not in leave_out}
        parameters: list[inspect.Parameter] = []
        for name, parameter in own.items():
            shown = generated.values() if name == given_as else [parameter]
            parameters += [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in shown]

        def call(**given: Any) -> None:
            chosen = {name: given.pop(name) for name in generated}
            values = {name: _value(generated[name], told[name], value) for name, value in chosen.items()}
            command(**given, **{given_as: kind(**values)})

        call.__name__, call.__qualname__, call.__module__ = command.__name__, command.__qualname__, command.__module__
        call.__doc__ = command.__doc__
        call.__signature__ = inspect.Signature(parameters)
        call.__annotations__ = {p.name: p.annotation for p in parameters}
        return call

    return decorate


def _parameter(field: Field, kind: type) -> inspect.Parameter:
    """The parameter that typer makes the option of ``field`` of."""
    hint, about, default = get_type_hints(kind)[field.name], field.metadata, field.default
    names = about["names"]
    if about["parse"] is not None:
        hint = str | None
    elif get_origin(hint) is tuple:
        hint, default = list[get_args(hint)[0]] | None, None
    if hint is bool and default is False and not names:
        names = ("--" + field.name.replace("_", "-"),)
    more = dict(about["more"])
    if about[RANGE] is not None and about["parse"] is None and get_origin(hint) is not list:
        # Shown in the help; the dataclass checks it, as for Python.
        more |= {"min": about[RANGE].low, "max": about[RANGE].high}
    info = typer.Option(*names, help=about["help"], **more)
    return inspect.Parameter(
        field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[hint, info]
    )


def _value(parameter: inspect.Parameter, told: Mapping[str, Any], given: Any) -> Any:
    """What the command line ``given`` to a ``parameter`` means for its field, of which ``told`` is the metadata."""
    if told["parse"] is not None:
        flag = told["names"][-1] if told["names"] else "--" + parameter.name.replace("_", "-")
        return None if given is None else told["parse"](given, flag)
    return tuple(given or ()) if _listed(parameter.annotation) else given


def _listed(annotation: Any) -> bool:
    """Whether an annotation that ``_parameter`` made is one of an option that may be given several times."""
    return any(get_origin(kind) is list for kind in get_args(get_args(annotation)[0]))
