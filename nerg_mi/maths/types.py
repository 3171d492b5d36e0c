"""Names of the arrays in signatures.

Which class an array has is decided when a program runs: by the backend (LLVM or CUDA) that a field belongs to, or by
Mitsuba's variant. Types derive from arguments, and no class of either can be named here; what can be said is how an
array is made up. Every array holds one value a lane, and one of a single lane serves all of them.
"""

from __future__ import annotations

from typing import Any, TypeAlias

Float: TypeAlias = Any
"""Single-precision number a lane. A Python float may stand for one."""

Bool: TypeAlias = Any
"""Mask. A Python bool may stand for one."""

UInt32: TypeAlias = Any
"""Unsigned 32-bit integer a lane. A Python int may stand for one."""

Array3f: TypeAlias = Any
"""Three single-precision numbers a lane, ``x``, ``y`` and ``z``: Dr.Jit's ``Array3f`` or one of Mitsuba's."""

Point3f: TypeAlias = Array3f
"""Position, in the frame that the signature names."""

Vector3f: TypeAlias = Array3f
"""Direction or displacement, in the frame that the signature names."""

Color: TypeAlias = Any
"""Colour a lane: three numbers, or as many as the variant's ``Spectrum`` has."""

Ray3f: TypeAlias = Any
"""Ray with an origin ``o``, a unit direction ``d`` and a greatest distance ``maxt``, as Mitsuba's."""
