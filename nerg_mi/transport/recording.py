"""Recordings: what was traced for one image is replayed for the next ones by ``dr.freeze``.

Tracing a small image takes longer than its kernels. Dr.Jit can replay the kernels of a function with other arrays, if
it is told all arrays that the function reads; everything else is repeated as it was when the function was recorded. A
traced program reads objects: an integrator, its fields, observers. `State` divides all that they contain into arrays,
which are the inputs of a recording, and other values, which belong to its key: if one of these changes, the function is
traced again. An evaluated array that is not an input is an error of Dr.Jit, not an outdated image.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from enum import Enum
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any, ClassVar

import drjit as dr
import drjit.nn as nn
import numpy as np

from nerg_mi.fields.mlp import allow_recorded_constants

from .jit import gc_paused, is_recording

# ---- State ----

_MAX_COMPARED_BYTES = 1 << 10
"""Size up to which arrays of NumPy are compared by their values, and not by their identity."""


class NotRecordable(Exception):
    """Why a function cannot be recorded, as the end of a sentence."""


class State:
    """All that ``roots`` contain, in a fixed order.

    Attributes of Python objects are followed, except those that their class names in ``UNRECORDED``: attributes that no
    traced program reads, or that it reads only with derivatives. Those in ``COMPUTED``, which are computed when first
    read, are read before. Of objects of Mitsuba that are written in C++, Dr.Jit lists the arrays.

    Attributes
    ----------
    arrays : list
        The Dr.Jit arrays.
    natives : list
        The objects of Mitsuba.
    parameters : list
        Those of their arrays that can carry derivatives.
    key : list
        Everything else, comparable with ``==``; objects without attributes by their identity.
    held : list
        The objects that are compared by identity, which must live as long as the key.
    """

    __slots__ = ("_numbers", "arrays", "held", "key", "natives", "parameters")

    def __init__(self, roots: Iterable[Any]):
        self.arrays, self.key, self.held = list[Any](), list[Hashable](), list[Any]()
        self.natives, self.parameters = list[Any](), list[Any]()
        self._numbers: dict[int, int] = {}
        for root in roots:
            self.add(root)

    def add(self, value: Any) -> None:
        """Add a value and all that it contains."""
        kind = type(value)
        visit = _VISITS.get(kind)
        if visit is None:
            visit = _VISITS[kind] = _find_visit(kind)
        visit(self, value)

    def is_new(self, value: Any) -> bool:
        """Number ``value``, and return whether it was not numbered before."""
        count = len(self._numbers)
        number = self._numbers.setdefault(id(value), count)
        self.key.append(number)
        return number == count


_VISITS: dict[type, Callable[[State, Any], None]] = {}


def _find_visit(kind: type) -> Callable[[State, Any], None]:
    """How values of the type ``kind`` are listed."""
    if kind is float:
        return _visit_float
    if kind in (int, bool, str, bytes, type(None), complex, range) or issubclass(kind, (Enum, np.generic)):
        return _visit_plain
    if dr.is_array_v(kind):
        return _visit_array
    if issubclass(kind, (tuple, list)):
        return _visit_sequence
    if issubclass(kind, dict):
        return _visit_mapping
    if issubclass(kind, frozenset):
        return _visit_plain
    if issubclass(kind, np.ndarray):
        return _visit_numpy
    if issubclass(kind, nn.MatrixView):
        return _visit_matrix
    if kind is FunctionType:
        return _visit_function
    if issubclass(kind, (type, ModuleType, BuiltinFunctionType, MethodType)):
        return _visit_identity
    if kind.__dictoffset__:
        return _visit_object
    if any(base.__module__.partition(".")[0] == "mitsuba" for base in kind.__mro__):
        return _visit_native
    return _visit_identity


def _visit_plain(state: State, value: Any) -> None:
    # 1 == True == 1.0, which are traced differently.
    state.key += (type(value), value)


def _visit_float(state: State, value: float) -> None:
    # 0 == -0
    state.key += (value, math.copysign(1.0, value))


def _visit_array(state: State, value: Any) -> None:
    if state.is_new(value):
        state.arrays.append(value)


def _visit_sequence(state: State, value: Sequence[Any]) -> None:
    state.key += (type(value), len(value))
    for item in value:
        state.add(item)


def _visit_mapping(state: State, value: dict[Any, Any]) -> None:
    state.key += (dict, *value)
    for item in value.values():
        state.add(item)


def _visit_numpy(state: State, value: np.ndarray) -> None:
    if value.nbytes <= _MAX_COMPARED_BYTES and value.dtype != object:
        state.key += (value.shape, value.dtype.str, value.tobytes())
    else:
        _visit_identity(state, value)


def _visit_matrix(state: State, value: Any) -> None:
    state.key += (value.dtype, value.layout, value.shape, value.offset, value.stride, value.transpose)
    state.add(value.buffer)


def _visit_function(state: State, value: Any) -> None:
    _visit_identity(state, value)
    for cell in value.__closure__ or ():
        state.add(cell.cell_contents)


def _visit_identity(state: State, value: Any) -> None:
    state.key.append(id(value))
    state.held.append(value)


def _visit_object(state: State, value: Any) -> None:
    if state.is_new(value):
        kind, key = type(value), state.key
        key.append(kind)
        unrecorded = getattr(kind, "UNRECORDED", ())
        for name in getattr(kind, "COMPUTED", ()):
            getattr(value, name)
        for name, item in value.__dict__.items():
            if name not in unrecorded:
                key.append(name)
                state.add(item)


def _visit_native(state: State, value: Any) -> None:
    import mitsuba as mi

    state.natives.append(value)
    if isinstance(value, mi.Scene):
        # Emitters around the scene are as large as it is.
        box = value.bbox()
        state.key += (*map(float, box.min), *map(float, box.max))
    _list_native(state, value)


# ---- Objects of Mitsuba ----
#
# Dr.Jit lists the arrays of objects that are written in C++. Their other values belong to the key.


def _list_native(state: State, node: Any) -> None:
    """Add the identities of a ``node`` and of its children, and parameters that are not arrays; of a scene neither
    sensors nor the integrator."""
    import mitsuba as mi

    if type(node).__dictoffset__:
        # A plugin that is written in Python.
        state.add(node)
    elif state.is_new(node):
        # A scene is told by its children. It holds its integrator, and would never be freed if that held the scene.
        if not isinstance(node, mi.Scene):
            _visit_identity(state, node)
        node.traverse(_get_callback_class(mi.variant())(state, node))


@functools.cache
def _get_callback_class(variant: str) -> type:
    # Mitsuba's classes depend on the variant.
    import mitsuba as mi

    class ParameterCallback(mi.TraversalCallback):
        def __init__(self, state: State, node: Any):
            super().__init__()
            self.state, self.node = state, node

        def put(self, name: str, value: Any, flags: Any, kind: Any = None) -> None:
            if isinstance(value, mi.Object):
                if not isinstance(value, (mi.Sensor, mi.Integrator)):
                    _list_native(self.state, value)
                return
            value = value if kind is None else mi.get_property(value, kind, self.node)
            # Of transforms, the matrix.
            array = getattr(value, "matrix", value)
            if dr.is_jit_v(type(array)):
                self.state.parameters.append(array)
            else:
                self.state.key += (name, str(value))

    return ParameterCallback


_LISTED_SENSORS = ("PerspectiveCamera", "Panorama")
# Of these, Mitsuba 3.9.1 does not list all arrays.
_SAMPLED_SENSORS = ("ThinLensCamera", "OrthographicCamera")


def must_sample_rays(sensor: Any) -> bool:
    """Whether a recording cannot sample the rays of ``sensor``, which must be its inputs."""
    return kind_of_sensor(sensor) in _SAMPLED_SENSORS


def kind_of_sensor(sensor: Any) -> str:
    """The name of the class of ``sensor``."""
    # Sensors written in Python have their own class name.
    name = type(sensor).__name__
    return sensor.class_name() if name in ("Sensor", "ProjectiveCamera") else name


def _list_sensor(state: State, sensor: Any) -> None:
    """Add a ``sensor``, or its position if its rays are inputs, and what they have that is not an array."""
    import mitsuba as mi

    kind = kind_of_sensor(sensor)
    if kind not in _LISTED_SENSORS + _SAMPLED_SENSORS:
        raise NotRecordable(f"a sensor of the type {kind}")
    if sensor.get_medium() is not None:
        raise NotRecordable("a sensor inside a medium")
    if isinstance(sensor, mi.ProjectiveCamera):
        state.key += (sensor.near_clip(), sensor.far_clip())
    if kind in _LISTED_SENSORS:
        state.natives.append(sensor)
    else:
        state.arrays.append(sensor.world_transform().matrix)
    film = sensor.film()
    state.key += (kind, film.class_name(), str(film), str(film.rfilter()), film.flags())
    state.key += (sensor.needs_aperture_sample(), sensor.shutter_open(), sensor.shutter_open_time())


def _list_block(state: State, block: Any) -> None:
    """Add the values of an image ``block`` that are not arrays."""
    size, offset, rfilter = block.size(), block.offset(), block.rfilter()
    state.key += (*size, *offset, block.border_size(), block.channel_count(), block.coalesce(), block.normalize())
    state.key += (block.warn_negative(), block.warn_invalid(), None if rfilter is None else str(rfilter))


# ---- Recordings ----

_UNLISTED = "was not specified as an input variable"
"""Part of Dr.Jit's message if a function reads an array that it does not list."""

_MAX_VARIANTS = 4
"""Recordings of one key: Dr.Jit also distinguishes literals, and arrays of one element."""


class _Body:
    """The function that is recorded, while it is. No pytree, so that Dr.Jit compares its identity."""

    __slots__ = ("function",)

    function: Callable[[], Any]


class _Recording:
    """The recording of functions of one key."""

    def __init__(self, held: list[Any]):
        self.has_listed_arrays = True
        self._held = held
        # Not this object: a cycle would keep its arrays until the next garbage collection.
        current = self._body = _Body()

        def run(arrays: list[Any], natives: Sequence[Any]) -> Any:
            with gc_paused(), allow_recorded_constants():
                return current.function()

        self._function: Any = dr.freeze(run, limit=_MAX_VARIANTS, warn_after=1 << 30)

    @property
    def count(self) -> int:
        """How often the function was traced."""
        return self._function.n_recordings

    def __call__(self, body: Callable[[], Any], arrays: list[Any], natives: Sequence[Any]) -> Any:
        self._body.function = body
        try:
            return self._function(arrays, natives)
        except RuntimeError as error:
            # Dr.Jit replaces the error of the function.
            cause = error.__cause__ or error
            if _UNLISTED not in str(cause):
                raise cause from None
            self.has_listed_arrays = False
            return body()
        finally:
            del self._body.function


_MAX_TRACED = 6
"""How often a recording may be traced; behind that, its arrays change in a way that cannot be replayed."""


class Recorder:
    """Recordings of several functions and structures, the least recently used of which are dropped.

    A function is traced as usual when its key is seen for the first time, so that single images cost nothing; it is
    recorded the second time, and then replayed.
    """

    def __init__(self, is_enabled: bool = True, max_recordings: int = 16):
        self.is_enabled, self._max_recordings = is_enabled, max_recordings
        self._recordings: dict[Hashable, _Recording] = {}
        # Why the last function was not recorded; "" if it was. Reasons that were reported.
        self.reason, self._reported = "", set[str]()
        self.is_replaying = False

    def run(
        self,
        body: Callable[[], Any],
        key: Hashable,
        list_inputs: Callable[[], Sequence[Any]],
        numbers: Sequence[Any],
        sensor: Any = None,
        blocks: Sequence[Any] = (),
    ) -> Any:
        """Return ``body()``, a pytree of Dr.Jit arrays or None, or the same from a recording.

        Parameters
        ----------
        key : Hashable
            What ``body`` depends on besides the other arguments.
        list_inputs : callable
            Returns the objects that ``body`` reads.
        numbers : sequence of arrays
            Further arrays that it reads.
        sensor : mi.Sensor, optional
            A sensor that it reads.
        blocks : sequence of mi.ImageBlock
            Image blocks that it adds to.
        """
        try:
            if not self.is_enabled:
                raise NotRecordable("a recorder that is switched off, as it is on graphics cards")
            state = State(list_inputs())
            if sensor is not None:
                _list_sensor(state, sensor)
            for block in blocks:
                _list_block(state, block)
        except NotRecordable as error:
            self.reason = str(error)
            return body()
        arrays = [*numbers, *state.arrays]
        with dr.resume_grad():
            has_gradients = dr.grad_enabled(arrays, state.parameters)
        if is_recording() or has_gradients:
            self.reason = "derivatives or another recording"
            return body()
        full_key = key, dr.expand_threshold(), dr.thread_count(), tuple(state.key)
        recording = self._recordings.pop(full_key, None)
        self._store(full_key, recording or _Recording(state.held))
        if recording is None:
            return body()
        if not recording.has_listed_arrays:
            self.reason = "a plugin of Mitsuba whose arrays Dr.Jit cannot list"
            return body()
        if recording.count >= _MAX_TRACED:
            self.reason = "arrays whose kind changes from image to image"
            return body()
        self.is_replaying = True
        try:
            return recording(body, arrays, [*blocks, *state.natives])
        finally:
            self.is_replaying = False

    def _store(self, key: Hashable, recording: _Recording) -> None:
        self._recordings[key] = recording
        while len(self._recordings) > self._max_recordings:
            del self._recordings[next(iter(self._recordings))]

    def take_reason(self) -> str:
        """Why the last function was not recorded, the first time that this is asked; "" otherwise."""
        reason = "" if self.reason in self._reported else self.reason
        self._reported.add(self.reason)
        return reason

    def clear(self) -> None:
        """Drop all recordings."""
        self._recordings.clear()


class FrozenChildren:
    """Exposes the ``objects`` of an integrator to ``dr.freeze`` alone, and not to the ``recorder``, which knows what it
    reads: it takes Dr.Jit longer to list all their arrays than to replay a small image."""

    DRJIT_STRUCT: ClassVar[dict[str, None]] = {"exposed": None}

    def __init__(self, objects: dict[str, Any], recorder: Recorder):
        self.objects, self._recorder = objects, recorder

    @property
    def exposed(self) -> dict[str, Any]:
        # Otherwise, Dr.Jit passes the integrator to an operation with derivatives, and would list them twice a step.
        is_frozen = dr.flag(dr.JitFlag.EnableObjectTraversal)
        return self.objects if is_frozen and not self._recorder.is_replaying else {}

    @exposed.setter
    def exposed(self, value: dict[str, Any]) -> None:
        """Dr.Jit assigns to the objects themselves."""
