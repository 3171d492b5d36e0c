"""Reading plugin properties: a wrong value is an error that names the property and what it may be."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from .errors import NergError, plain
from .ranges import FARTHEST, VALUES, Range, check_number


def number(props, name: str, default: float, within: Range) -> float:
    """A number ``within`` a range."""
    value = props.get(name, default)
    check_number(value, within, f'"{name}"')
    return float(value)


def integer(props, name: str, default: int, within: Range) -> int:
    """A whole number ``within`` a range."""
    value = number(props, name, default, within)
    if value != int(value):
        raise NergError(f'"{name}" must be a whole number, got {value}')
    return int(value)


def boolean(props, name: str, default: bool) -> bool:
    """true or false, and nothing that merely looks like it."""
    value = props.get(name, default)
    if not isinstance(value, bool):
        raise NergError(f'"{name}" must be true or false, got {value!r}')
    return value


def choice(props, name: str, default: str, choices: tuple[str, ...]) -> str:
    """One of ``choices``."""
    value = props.get(name, default)
    if value not in choices:
        raise NergError(f'"{name}" must be one of {", ".join(choices)}, got {value!r}')
    return value


def text(props, name: str, default: str | None = None) -> str:
    """A string; required where there is no default."""
    value = props.get(name, default)
    if not isinstance(value, str):
        found = "nothing" if value is None else repr(value)
        raise NergError(f'"{name}" must be a string, got {found}')
    return value


def color(props, name: str, default: float) -> list[float]:
    """A linear rgb colour that is finite in single precision and not negative; a number is a grey."""
    import mitsuba as mi

    value = props.get(name, default)
    if hasattr(value, "eval_3"):  # a texture: what dict scenes make of {'type': 'rgb'}
        value = value.eval_3(mi.SurfaceInteraction3f())
    if isinstance(value, (str, bool)):
        raise NergError(f'"{name}" must be a number or an rgb colour, got {value!r}')
    rgb = [float(c) for c in np.ravel(value)]
    rgb = rgb * 3 if len(rgb) == 1 else rgb
    if len(rgb) != 3 or not all(0 <= c <= VALUES.high for c in rgb):
        raise NergError(f'"{name}" must be one number or three, finite and not negative, got {value}')
    return rgb


def vector(props, name: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
    """Three coordinates."""
    value = props.get(name, None)
    try:
        found = np.asarray(default if value is None else value, float).ravel()
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (3,) or not (np.abs(found) <= FARTHEST).all():
        raise NergError(
            f'"{name}" must be three numbers from {-FARTHEST:g} to {FARTHEST:g}, got {plain(repr(value), 60)}'
        )
    x, y, z = found.tolist()
    return x, y, z


def resolved(filename: str) -> str:
    """The path of the file that a scene calls ``filename``, where it is in one of the folders that Mitsuba looks in."""
    import mitsuba as mi

    # Mitsuba's stubs know it as an object.
    file_resolver: Any = mi.file_resolver
    return str(file_resolver().resolve(filename))


def trained(props, network, load: Callable, ns: ModuleType) -> tuple[Any, dict, str]:
    """The field of a volume, its metadata and the name of its file ("" without one).

    It is ``network``, a field in memory, whose arrays must belong to the backend ``ns``; where that is None, it is read
    from the property ``filename`` by ``load(path, ns)``.
    """
    import mitsuba as mi

    if network is None:
        filename = resolved(text(props, "filename"))
        return *load(filename, ns), filename
    if any(not type(value).__module__.startswith(ns.__name__) for value in network.parameters().values()):
        raise NergError(f'the field in memory was made for another variant than "{mi.variant()}"; load it again')
    return network, {}, ""


def volume_of(plugin: Callable, name: str, network, to_world, called: str):
    """The volume that the class ``plugin``, registered as ``name``, makes of the field ``network`` in memory.

    ``to_world``: a Mitsuba transform, or None; ``called``: what stands where other volumes have the name of a file.
    """
    import mitsuba as mi

    props = mi.Properties(name)
    if to_world is not None:
        props["to_world"] = to_world
    volume = plugin(props, network)
    volume.filename = called
    return volume


def expose_parameters(field, callback) -> None:
    """Tell a scene's traversal the arrays of ``field``, each of which can be trained."""
    import mitsuba as mi

    for name, value in field.parameters().items():
        callback.put(name, value, mi.ParamFlags.Differentiable)


def transform(props, name: str) -> np.ndarray:
    """The matrix (4, 4) of a transform; the identity where there is none."""
    value = props.get(name, None)
    if value is None:
        return np.eye(4)
    if not hasattr(value, "matrix"):
        raise NergError(f'"{name}" must be a transform, got {value!r}')
    return np.array(value.matrix, float)
