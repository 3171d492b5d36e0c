"""Types of the arrays in signatures.

Which class an array has is decided when a program runs: by the backend (LLVM or CUDA) that a field belongs to, or by
Mitsuba's variant. Functions derive it from their arguments. These classes stand for all of them when types are checked,
and are `Any` when the program runs. Every array holds one value a lane, and one of a single lane serves all of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Iterator

    from drjit import ArrayBase

    class Bool(ArrayBase["Bool", "Bool | bool", bool, bool, "Bool", "Bool", "Bool"]):
        """Mask. A Python bool may stand for one."""

    class Float(ArrayBase["Float", "Float | UInt32 | float", float, float, "Float", "Float", Bool]):
        """Single-precision number a lane. A Python float may stand for one."""

    class UInt32(ArrayBase["UInt32", "UInt32 | int", int, int, "UInt32", "UInt32", Bool]):
        """Unsigned 32-bit integer a lane. A Python int may stand for one."""

    class Array3f(ArrayBase["Array3f", "Array3f | Float | float", Float, "Float | float", Float, "Array3f", Bool]):
        """Three single-precision numbers a lane, ``x``, ``y`` and ``z``: Dr.Jit's ``Array3f`` or one of Mitsuba's."""

        x: Float
        y: Float
        z: Float

        def __iter__(self) -> Iterator[Float]: ...

    class Ray3f:
        """Ray with an origin ``o``, a unit direction ``d`` and a greatest distance ``maxt``, as Mitsuba's."""

        def __init__(self, *args: Any) -> None: ...

        o: Array3f
        d: Array3f
        maxt: Float
        wavelengths: Any
else:
    Bool = Float = UInt32 = Array3f = Ray3f = Any

Point3f: TypeAlias = Array3f  # Position, in the frame that the signature names

Vector3f: TypeAlias = Array3f  # Direction or displacement, in the frame that the signature names

Color: TypeAlias = Any  # Colour a lane: three numbers, or as many as the variant's ``Spectrum`` has


def variant_types() -> Any:
    """Mitsuba, as the namespace of the variant's arrays: its stubs know them as other classes than those above, and no
    arithmetic between them."""
    import mitsuba

    return mitsuba
