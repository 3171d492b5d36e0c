"""Readers of plugin properties. An invalid value raises an error that names the property and its valid values."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, cast

import numpy as np

from nerg_mi.errors import NergError, sanitize
from nerg_mi.ranges import MAX_COORDINATE, POSITIVE_VALUES, Range, check_number


def read_number(props, name: str, default: float, allowed: Range) -> float:
    """Read a number in the range ``allowed``."""
    value = props.get(name, default)
    check_number(value, allowed, f'"{name}"')
    return float(value)


def read_integer(props, name: str, default: int, allowed: Range) -> int:
    """Read an integer in the range ``allowed``."""
    value = read_number(props, name, default, allowed)
    if value != int(value):
        raise NergError(f'"{name}" must be a whole number, got {value}')
    return int(value)


def read_boolean(props, name: str, default: bool) -> bool:
    """Read true or false. Other values, such as 0 and 1, are errors."""
    value = props.get(name, default)
    if not isinstance(value, bool):
        raise NergError(f'"{name}" must be true or false, got {value!r}')
    return value


def read_choice(props, name: str, default: str, choices: tuple[str, ...]) -> str:
    """Read one of the strings ``choices``."""
    value = props.get(name, default)
    if value not in choices:
        raise NergError(f'"{name}" must be one of {", ".join(choices)}, got {value!r}')
    return value


def read_string(props, name: str, default: str | None = None) -> str:
    """Read a string. Without a ``default`` the property is required."""
    value = props.get(name, default)
    if not isinstance(value, str):
        shown = "nothing" if value is None else repr(value)
        raise NergError(f'"{name}" must be a string, got {shown}')
    return value


def read_color(props, name: str, default: float) -> list[float]:
    """Read a linear RGB colour, finite in single precision and not negative. A single number is a grey."""
    import mitsuba as mi

    value = props.get(name, default)
    if hasattr(value, "eval_3"):  # a texture, which is how dict scenes store {'type': 'rgb'}
        value = value.eval_3(mi.SurfaceInteraction3f())
    if isinstance(value, (str, bool)):
        raise NergError(f'"{name}" must be a number or an rgb colour, got {value!r}')
    rgb = [float(c) for c in np.ravel(value)]
    rgb = rgb * 3 if len(rgb) == 1 else rgb
    if len(rgb) != 3 or not all(0 <= c <= POSITIVE_VALUES.high for c in rgb):
        raise NergError(f'"{name}" must be one or three finite, non-negative numbers, got {value}')
    return rgb


def read_vector(props, name: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
    """Read three coordinates."""
    value = props.get(name, None)
    try:
        coordinates = np.asarray(default if value is None else value, float).ravel()
    except (TypeError, ValueError):
        coordinates = np.empty(0)
    if coordinates.shape != (3,) or not (np.abs(coordinates) <= MAX_COORDINATE).all():
        raise NergError(
            f'"{name}" must be three numbers from {-MAX_COORDINATE:g} to {MAX_COORDINATE:g}, got '
            f"{sanitize(repr(value), 60)}"
        )
    x, y, z = coordinates.tolist()
    return x, y, z


def resolve_scene_file(filename: str) -> str:
    """Return the path of the file that a scene calls ``filename``, searched in the folders of Mitsuba's file
    resolver.
    """
    import mitsuba as mi

    # Mitsuba's stubs declare it as an object.
    file_resolver: Any = mi.file_resolver
    return str(file_resolver().resolve(filename))


def load_network(props, network, load: Callable, ns: ModuleType) -> tuple[Any, dict, str]:
    """Return the field of a volume, its metadata, and its file name ("" without a file).

    Parameters
    ----------
    props
        Properties of the plugin.
    network
        A field in memory, whose arrays must belong to the backend ``ns``. If None, the field is read from the file in
        the property ``filename``.
    load
        Function ``load(path, ns)`` that reads the file.
    ns
        Dr.Jit module of the active backend.

    Raises
    ------
    NergError
        If the field in memory belongs to another variant.
    """
    import mitsuba as mi

    if network is None:
        filename = resolve_scene_file(read_string(props, "filename"))
        return *load(filename, ns), filename
    if any(not type(value).__module__.startswith(ns.__name__) for value in network.parameters().values()):
        raise NergError(f'the field in memory was created for another variant than "{mi.variant()}"; load it again')
    return network, {}, ""


def make_volume_class() -> Any:
    """Return the base class of plugins that are volumes of one ``field`` with trainable ``parameters()``.

    The class is created for the active variant, as all classes of Mitsuba are.
    """
    import mitsuba as mi

    class NetworkVolume(mi.Volume):
        field: Any
        plugin: str  # name of the registered plugin

        @staticmethod
        def check(network) -> None:
            """Raise `NergError` unless ``network`` is a field of the plugin's kind."""
            raise NotImplementedError

        @classmethod
        def from_network(cls, network, to_world=None, name: str = "in memory"):
            """Create the volume of a field in memory, for a scene that is built in Python.

            Parameters
            ----------
            network
                The field.
            to_world
                Mitsuba transform.
            name
                Name that replaces the file name in messages.
            """
            cls.check(network)
            props = mi.Properties(cls.plugin)
            if to_world is not None:
                props["to_world"] = to_world
            volume: Any = cast("Any", cls)(props, network)
            volume.filename = name
            return volume

        def bounds(self) -> tuple[np.ndarray, np.ndarray]:
            """Return the lower and upper corner, (3,) each, in scene coordinates."""
            return cast("Any", self).medium().bounds()

        def describe(self) -> dict[str, Any]:
            """Return the properties of the volume for its printed representation."""
            raise NotImplementedError

        def bbox(self):
            lower, upper = self.bounds()
            return mi.ScalarBoundingBox3f(lower.tolist(), upper.tolist())

        def channel_count(self):
            return 1

        def eval(self, it, active=True):
            # Media evaluate a spectrum; the density is the same for all wavelengths.
            return cast("Any", mi).UnpolarizedSpectrum(self.eval_1(it, active))

        def traverse(self, cb):
            for name, value in self.field.parameters().items():
                cb.put(name, value, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys=()):
            self.field.pack()

        def to_string(self):
            return f"{type(self).__name__}[\n" + ",\n".join(f"  {k} = {v}" for k, v in self.describe().items()) + "\n]"

    return NetworkVolume


def read_transform(props, name: str) -> np.ndarray:
    """Return the matrix (4, 4) of a transform; the identity if the property is missing."""
    value = props.get(name, None)
    if value is None:
        return np.eye(4)
    if not hasattr(value, "matrix"):
        raise NergError(f'"{name}" must be a transform, got {value!r}')
    return np.array(value.matrix, float)
