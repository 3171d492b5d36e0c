"""Arrays that users give and get, and cameras."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerg_mi.errors import NergError, sanitize
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.ranges import MAX_COORDINATE, FIELDS_OF_VIEW, Range, check_number

# ---- What comes in from NumPy, checked, and what goes out to it, labelled ----

Floats: TypeAlias = NDArray[np.float32]


def as_points(values: ArrayLike, name: str) -> Floats:
    """``values`` as (N, 3) float32; one point (3,) is one row. Raises `NergError`, which calls it ``name``."""
    try:
        array = np.asarray(values, np.float64)
    except OverflowError as error:
        raise NergError(
            f"{name} must have coordinates from {-MAX_COORDINATE:g} to {MAX_COORDINATE:g}, and one is beyond"
        ) from error
    except (TypeError, ValueError) as error:
        raise NergError(f"{name} must be numbers x, y, z, or rows of them, got {sanitize(repr(values), 60)}") from error
    array = array[None] if array.shape == (3,) else array
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        raise NergError(f"{name} must have the shape (3,) or (N, 3), got {array.shape}")
    check_coordinates(array, name)
    return np.ascontiguousarray(array, np.float32)


def as_unit_vectors(values: ArrayLike, count: int, name: str) -> Floats:
    """``values`` as ``count`` unit vectors (N, 3); one direction serves all. Raises `NergError`."""
    array = as_points(values, name).astype(np.float64)
    if len(array) not in (1, count):
        raise NergError(f"{name} must be one or as many as the origins, {count}, got {len(array)}")
    length = np.linalg.norm(array, axis=1, keepdims=True)
    if not np.all(length > 0):
        raise NergError(f"{name} must not be zero, and row {int(np.flatnonzero(length == 0)[0])} is")
    return np.ascontiguousarray(np.broadcast_to(array / length, (count, 3)), np.float32)


@dataclass(frozen=True, eq=False, repr=False)
class LabelledArrays:
    """Arrays by name: ``result["gaze"]`` and ``result.gaze`` are the same array.

    ``values``: the arrays, of which the first axes are those that ``axes`` names and a last one, where there is one
    more, the channels. ``observers`` (M, 3): the positions that the rows of the axis ``observer`` belong to; None where
    every element has an observer of its own. ``names``: those of the arrays. An array that does not depend on the
    observer is the same for all of them and cannot be written to.
    """

    values: Mapping[str, Floats]
    axes: tuple[str, ...]
    observers: Floats | None

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.values)

    def __getitem__(self, name: str) -> Floats:
        try:
            return self.values[name]
        except KeyError:
            raise KeyError(f'there is no "{name}" here, but {join_names(self.names)}; ask for it by quantities=') from None

    def __getattr__(self, name: str) -> Floats:
        # Asked while an object is copied or unpickled, when there are no values yet.
        if name.startswith("_") or name == "values":
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(error.args[0]) from None

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *self.names})

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    def __len__(self) -> int:
        return len(self.values)

    def __contains__(self, name: object) -> bool:
        return name in self.values

    def __repr__(self) -> str:
        some = next(iter(self.values.values()))
        size = ", ".join(f"{axis} {length}" for axis, length in zip(self.axes, some.shape))
        width = max(map(len, self.names))
        lines = [f"  {name:<{width}}  {value.shape}, {value.dtype}" for name, value in self.values.items()]
        return "\n".join([f"{type(self).__name__}({size})", *lines])


def broadcast_to_observers(value: Floats, observers: int) -> Floats:
    """``value`` with an axis of ``observers`` in front, read-only, without a copy."""
    return np.broadcast_to(value, (observers, *value.shape))


def join_names(names: Sequence[str]) -> str:
    """Names for a sentence."""
    return ", ".join(names)


# ---- A camera in a few numbers ----

MAX_PIXELS = 1 << 28
"""A picture may have so many pixels, as for the command `nerg render`."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera at ``origin`` that looks at ``target``.

    Positions are in scene units (metres, as a rule), and so is nothing else: ``fov`` is the angle, in degrees, between
    the left and the right border of the picture, ``up`` points to its upper border, ``width`` and ``height`` count
    pixels. Pixels are squares whose colours and other values are plain means (a box filter). Raises `NergError` for
    numbers of which no camera can be made.

    >>> import nerg_mi as nerg
    >>> nerg.Camera(origin=(7.4, 3.4, 2.2), target=(4.8, 4.2, 1.0), fov=78, width=48, height=32)
    Camera(origin=(7.4, 3.4, 2.2), target=(4.8, 4.2, 1.0), up=(0.0, 0.0, 1.0), fov=78, width=48, height=32)
    """

    origin: Sequence[float]
    target: Sequence[float]
    up: Sequence[float] = (0.0, 0.0, 1.0)
    fov: float = 60.0
    width: int = 480
    height: int = 320

    def __post_init__(self) -> None:
        for name in ("origin", "target", "up"):
            if len(as_points(value := getattr(self, name), f"{name} of a camera")) != 1 or np.ndim(value) != 1:
                raise NergError(f"{name} of a camera must be x, y, z, got {value!r}")
            object.__setattr__(self, name, tuple(float(x) for x in value))
        ahead = np.subtract(self.target, self.origin)
        if not np.any(ahead):
            raise NergError(f"a camera at {self.origin} cannot look at the same point; give it another target")
        if np.linalg.norm(np.cross(ahead, self.up)) <= 1e-6 * np.linalg.norm(ahead) * np.linalg.norm(self.up):
            raise NergError(f"a camera cannot look along its own up {self.up}; give it another up")
        check_number(self.fov, FIELDS_OF_VIEW, "the fov of a camera")
        for name in ("width", "height"):
            check_number(getattr(self, name), Range(1, MAX_PIXELS), f"the {name} of a picture", is_integer=True)
        if self.width * self.height > MAX_PIXELS:
            raise NergError(f"a picture has at most {MAX_PIXELS:,} pixels, got {self.width:,} x {self.height:,}")

    def to_dict(self, spp: int = 16) -> dict:
        """The camera as Mitsuba takes it (`mi.load_dict`), with ``spp`` samples a pixel; a variant must be set."""
        import mitsuba as mi

        return {
            "type": "perspective",
            "fov": float(self.fov),
            "fov_axis": "x",
            # Positions in double precision until Mitsuba rounds them, as in scene files.
            "to_world": mi.ScalarTransform4d().look_at(list(self.origin), list(self.target), list(self.up)),
            "sampler": {"type": "independent", "sample_count": int(spp)},
            "film": {
                "type": "hdrfilm",
                "width": int(self.width),
                "height": int(self.height),
                "rfilter": {"type": "box"},
                "component_format": "float32",
                "pixel_format": "rgb",
            },
        }
