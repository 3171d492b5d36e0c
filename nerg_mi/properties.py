"""Reading plugin properties: a wrong value is an error that names the property and what it may be."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, cast

import numpy as np

from .errors import NergError, sanitize
from .ranges import MAX_COORDINATE, POSITIVE_VALUES, Range, check_number


def read_number(props, name: str, default: float, allowed: Range) -> float:
    """A number ``within`` a range."""
    value = props.get(name, default)
    check_number(value, allowed, f'"{name}"')
    return float(value)


def read_integer(props, name: str, default: int, allowed: Range) -> int:
    """A whole number ``within`` a range."""
    value = read_number(props, name, default, allowed)
    if value != int(value):
        raise NergError(f'"{name}" must be a whole number, got {value}')
    return int(value)


def read_boolean(props, name: str, default: bool) -> bool:
    """true or false, and nothing that merely looks like it."""
    value = props.get(name, default)
    if not isinstance(value, bool):
        raise NergError(f'"{name}" must be true or false, got {value!r}')
    return value


def read_choice(props, name: str, default: str, choices: tuple[str, ...]) -> str:
    """One of ``choices``."""
    value = props.get(name, default)
    if value not in choices:
        raise NergError(f'"{name}" must be one of {", ".join(choices)}, got {value!r}')
    return value


def read_string(props, name: str, default: str | None = None) -> str:
    """A string; required where there is no default."""
    value = props.get(name, default)
    if not isinstance(value, str):
        found = "nothing" if value is None else repr(value)
        raise NergError(f'"{name}" must be a string, got {found}')
    return value


def read_color(props, name: str, default: float) -> list[float]:
    """A linear rgb colour that is finite in single precision and not negative; a number is a grey."""
    import mitsuba as mi

    value = props.get(name, default)
    if hasattr(value, "eval_3"):  # a texture: what dict scenes make of {'type': 'rgb'}
        value = value.eval_3(mi.SurfaceInteraction3f())
    if isinstance(value, (str, bool)):
        raise NergError(f'"{name}" must be a number or an rgb colour, got {value!r}')
    rgb = [float(c) for c in np.ravel(value)]
    rgb = rgb * 3 if len(rgb) == 1 else rgb
    if len(rgb) != 3 or not all(0 <= c <= POSITIVE_VALUES.high for c in rgb):
        raise NergError(f'"{name}" must be one number or three, finite and not negative, got {value}')
    return rgb


def read_vector(props, name: str, default: tuple[float, float, float]) -> tuple[float, float, float]:
    """Three coordinates."""
    value = props.get(name, None)
    try:
        found = np.asarray(default if value is None else value, float).ravel()
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (3,) or not (np.abs(found) <= MAX_COORDINATE).all():
        raise NergError(
            f'"{name}" must be three numbers from {-MAX_COORDINATE:g} to {MAX_COORDINATE:g}, got {sanitize(repr(value), 60)}'
        )
    x, y, z = found.tolist()
    return x, y, z


def resolve_scene_file(filename: str) -> str:
    """The path of the file that a scene calls ``filename``, where it is in one of the folders that Mitsuba looks in."""
    import mitsuba as mi

    # Mitsuba's stubs know it as an object.
    file_resolver: Any = mi.file_resolver
    return str(file_resolver().resolve(filename))


def load_network(props, network, load: Callable, ns: ModuleType) -> tuple[Any, dict, str]:
    """The field of a volume, its metadata and the name of its file ("" without one).

    It is ``network``, a field in memory, whose arrays must belong to the backend ``ns``; where that is None, it is read
    from the property ``filename`` by ``load(path, ns)``.
    """
    import mitsuba as mi

    if network is None:
        filename = resolve_scene_file(read_string(props, "filename"))
        return *load(filename, ns), filename
    if any(not type(value).__module__.startswith(ns.__name__) for value in network.parameters().values()):
        raise NergError(f'the field in memory was made for another variant than "{mi.variant()}"; load it again')
    return network, {}, ""


def make_volume_class() -> Any:
    """The base class of plugins that are volumes of one ``field``, whose ``parameters()`` can be trained: made for the
    variant in use, as all classes of Mitsuba are."""
    import mitsuba as mi

    class FieldVolume(mi.Volume):
        field: Any
        plugin: str  # the name as which it is registered

        @staticmethod
        def check(network) -> None:
            """Raise ``NergError`` unless ``network`` is a field of this kind."""
            raise NotImplementedError

        @classmethod
        def from_network(cls, network, to_world=None, name: str = "in memory"):
            """The volume of a field in memory, for a scene that is made from Python; ``to_world``: a Mitsuba transform,
            ``name``: what it is called where others have a file's name."""
            cls.check(network)
            props = mi.Properties(cls.plugin)
            if to_world is not None:
                props["to_world"] = to_world
            volume: Any = cast("Any", cls)(props, network)
            volume.filename = name
            return volume

        def bounds(self) -> tuple[np.ndarray, np.ndarray]:
            """Lower and upper corner, (3,) each, in the scene."""
            return cast("Any", self).medium().bounds()

        def describe(self) -> dict[str, Any]:
            """What the volume is, for people."""
            raise NotImplementedError

        def bbox(self):
            lower, upper = self.bounds()
            return mi.ScalarBoundingBox3f(lower.tolist(), upper.tolist())

        def channel_count(self):
            return 1

        def eval(self, it, active=True):
            # What media ask for; one density for all wavelengths.
            return cast("Any", mi).UnpolarizedSpectrum(self.eval_1(it, active))

        def traverse(self, cb):
            for name, value in self.field.parameters().items():
                cb.put(name, value, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys=()):
            self.field.pack()

        def to_string(self):
            return f"{type(self).__name__}[\n" + ",\n".join(f"  {k} = {v}" for k, v in self.describe().items()) + "\n]"

    return FieldVolume


def read_transform(props, name: str) -> np.ndarray:
    """The matrix (4, 4) of a transform; the identity where there is none."""
    value = props.get(name, None)
    if value is None:
        return np.eye(4)
    if not hasattr(value, "matrix"):
        raise NergError(f'"{name}" must be a transform, got {value!r}')
    return np.array(value.matrix, float)
