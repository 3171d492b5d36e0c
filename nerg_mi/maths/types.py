"""Types for annotations: arrays, and classes of libraries that are loaded on first use.

The class of an array is decided at run time: by the backend (LLVM or CUDA) of a field, or by Mitsuba's variant.
Functions derive it from their arguments. These classes represent all of them for type checkers, and are `Any` at run
time. Each array holds one value per lane; an array with a single lane is broadcast.

Classes of Mitsuba and Matplotlib are `Any` at run time, too, so that `typing.get_type_hints` loads no library.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import Unpack as Unpack

    from drjit import ArrayBase
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
    from mitsuba import Scene as MitsubaScene
    from mitsuba import Sensor as Sensor
    from mitsuba import TensorXf as Tensor

    class Bool(ArrayBase["Bool", "Bool | bool", bool, bool, "Bool", "Bool", "Bool"]):
        """Mask; a Python bool is accepted."""

    class Float(ArrayBase["Float", "Float | UInt32 | float", float, float, "Float", "Float", Bool]):
        """Single-precision number per lane; a Python float is accepted."""

    class UInt32(ArrayBase["UInt32", "UInt32 | int", int, int, "UInt32", "UInt32", Bool]):
        """Unsigned 32-bit integer per lane; a Python int is accepted."""

    class Array3f(ArrayBase["Array3f", "Array3f | Float | float", Float, "Float | float", Float, "Array3f", Bool]):
        """Three single-precision numbers per lane, ``x``, ``y`` and ``z``: Dr.Jit's ``Array3f`` or one of Mitsuba's."""

        x: Float
        y: Float
        z: Float

        def __iter__(self) -> Iterator[Float]: ...

    class Ray3f:
        """Ray with an origin ``o``, a unit direction ``d`` and a maximum distance ``maxt``, like Mitsuba's."""

        def __init__(self, *args: Any) -> None: ...

        o: Array3f
        d: Array3f
        maxt: Float
        wavelengths: Any
else:
    Bool = Float = UInt32 = Array3f = Ray3f = Any
    Axes = Figure = MitsubaScene = Sensor = Tensor = Any
    Unpack = type  # that of `typing` needs Python 3.11; only `typing.get_type_hints` reads it here

Point3f: TypeAlias = Array3f  # Position, in the frame that the signature names

Vector3f: TypeAlias = Array3f  # Direction or displacement, in the frame that the signature names

Color: TypeAlias = Any  # Colour per lane: three numbers, or the components of the variant's ``Spectrum``


def variant_types() -> Any:
    """Mitsuba as the namespace of the variant's array types; its stubs declare other classes than those above, without
    arithmetic between them."""
    import mitsuba

    return mitsuba
