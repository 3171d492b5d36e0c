"""Conversion and validation of arrays, labelled results, and the camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.html import Summary, summary_table
from nerg_mi.files.values import to_numbers
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.ranges import FIELDS_OF_VIEW, Range, check_number

# ---- Input arrays and labelled results ----

Floats: TypeAlias = NDArray[np.float32]


def as_points(values: ArrayLike, name: str) -> Floats:
    """Convert points to an array (N, 3) of float32.

    Parameters
    ----------
    values : array_like of shape (3,) or (N, 3)
        One point or several, in scene units.
    name : str
        Name of the argument, for messages.

    Returns
    -------
    ndarray of shape (N, 3), float32
        The points.

    Raises
    ------
    NergError
        The values are not numbers, are not finite, are too large, or have another shape.
    """
    try:
        array = to_numbers(values, name)
    except NergError as error:
        shown = sanitize(repr(values), 60)
        raise NergError(f"{name} must be x, y, z or rows of these, got {shown} ({error})") from error
    array = array[None] if array.shape == (3,) else array
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        raise NergError(f"{name} must have the shape (3,) or (N, 3), N at least 1, got {array.shape}")
    check_coordinates(array, name)
    return np.ascontiguousarray(array, np.float32)


def check_point(values: Sequence[float] | None, name: str) -> np.ndarray | None:
    """Return the three numbers of ``name`` as an array (3,), or None. Raises `NergError` for another count."""
    if values is None:
        return None
    if len(values) != 3:
        raise NergError(f"{name} must be three numbers x,y,z, got {','.join(f'{v:g}' for v in values)}")
    return np.array(values, float)


def as_unit_vectors(values: ArrayLike, count: int, name: str) -> Floats:
    """Convert directions to unit vectors.

    Parameters
    ----------
    values : array_like of shape (3,) or (count, 3)
        Directions of any length except zero; a single one is repeated.
    count : int
        Number of directions.
    name : str
        Name of the argument, for messages.

    Returns
    -------
    ndarray of shape (count, 3), float32
        Unit vectors.

    Raises
    ------
    NergError
        The number of directions is neither 1 nor ``count``, or a direction is zero.
    """
    array = as_points(values, name).astype(np.float64)
    if len(array) not in (1, count):
        raise NergError(f"the number of {name} must be 1 or that of the origins ({count}), got {len(array)}")
    length = np.linalg.norm(array, axis=1, keepdims=True)
    if not np.all(length > 0):
        raise NergError(f"{name} must not be zero, but row {int(np.flatnonzero(length == 0)[0])} is")
    return np.ascontiguousarray(np.broadcast_to(array / length, (count, 3)), np.float32)


def as_rays(origins: ArrayLike, directions: ArrayLike) -> tuple[Floats, Floats]:
    """Convert rays to origins and unit directions, broadcast against each other.

    Parameters
    ----------
    origins : array_like of shape (3,) or (N, 3)
        Origins in scene units; a single one is repeated.
    directions : array_like of shape (3,) or (N, 3)
        Directions of any length except zero; a single one is repeated.

    Returns
    -------
    origins, directions : ndarray of shape (N, 3), float32
        The rays.

    Raises
    ------
    NergError
        The numbers of origins and directions differ, or a value is invalid.
    """
    o, d = as_points(origins, "origins"), as_points(directions, "directions")
    count = max(len(o), len(d))
    if len(o) not in (1, count):
        raise NergError(f"the number of origins must be 1 or that of the directions ({count}), got {len(o)}")
    return np.ascontiguousarray(np.broadcast_to(o, (count, 3))), as_unit_vectors(directions, count, "directions")


@dataclass(frozen=True, eq=False, repr=False)
class LabelledArrays:
    """Arrays by name: ``result["gaze"]`` and ``result.gaze`` return the same array.

    Attributes
    ----------
    values : mapping of str to ndarray
        The arrays. Their first axes are ``axes``; an additional last axis contains channels. An array that does not
        depend on the observer is broadcast along the observer axis and is read-only.
    axes : tuple of str
        Names of the axes, such as ``observer``, ``row`` and ``column``.
    observers : ndarray of shape (M, 3) or None
        Positions along the axis ``observer``, in scene units. None: each element has its own observer.
    names : tuple of str
        Names of the arrays.
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
            raise KeyError(
                f'the result has no "{name}", only {join_names(self.names)}; request it with quantities='
            ) from None

    def __getattr__(self, name: str) -> Floats:
        # Copying and unpickling look up attributes before `values` exists.
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

    def to_xarray(self) -> Any:
        """Return the arrays as an ``xarray.Dataset``.

        Returns
        -------
        xarray.Dataset
            One variable per array, with its unit. The dimensions are ``axes``, and ``channel`` (R, G, B) or ``axis``
            (x, y, z) for arrays with channels. Coordinates are the indices, and the ``observer_position``
            (observer, axis).

        Raises
        ------
        NergError
            xarray is not installed.
        """
        from nerg_mi.transport.aovs import AOVS

        try:
            import xarray
        except ImportError as error:
            raise NergError(
                "to_xarray needs xarray, which is not installed; run \"pip install 'nerg-mi[dataframe]'\""
            ) from error
        variables, coordinates = {}, {}
        for name, value in self.values.items():
            extra, labels = (), None
            if value.ndim > len(self.axes):
                channels = "RGB" if name == "color" else AOVS[name].channels if name in AOVS else None
                labels = [*channels] if channels and len(channels) == value.shape[-1] else None
                spatial = labels == ["X", "Y", "Z"]
                extra = ("axis" if spatial else "channel" if name == "color" else f"{name}_channel",)
                if labels is not None:
                    coordinates[extra[0]] = [label.lower() for label in labels] if spatial else labels
            quantity = AOVS.get(name)
            unit = quantity.unit if quantity is not None else ""
            title = quantity.heading if quantity is not None else "linear colour"
            variables[name] = ((*self.axes, *extra), value, {"units": unit or "1", "long_name": title})
        shape = next(iter(self.values.values())).shape
        coordinates |= {axis: np.arange(size) for axis, size in zip(self.axes, shape)}
        if self.observers is not None and "observer" in self.axes:
            coordinates |= {"axis": ["x", "y", "z"], "observer_position": (("observer", "axis"), self.observers)}
        return xarray.Dataset(variables, coordinates)

    def __repr__(self) -> str:
        first = next(iter(self.values.values()))
        size = ", ".join(f"{axis} {length}" for axis, length in zip(self.axes, first.shape))
        width = max(map(len, self.names))
        lines = [f"  {name:<{width}}  {value.shape}, {value.dtype}" for name, value in self.values.items()]
        return "\n".join([f"{type(self).__name__}({size})", *lines])

    def _repr_html_(self) -> str | None:
        return summary_table(self.values)


def broadcast_to_observers(value: Floats, observers: int) -> Floats:
    """Broadcast ``value`` along a new first axis of length ``observers``; the result is a read-only view."""
    return np.broadcast_to(value, (observers, *value.shape))


def join_names(names: Sequence[str]) -> str:
    """Join names with commas."""
    return ", ".join(names)


# ---- Camera ----

MAX_PIXELS = 1 << 28
"""Maximum number of pixels of an image, as for `nerg render`."""


@dataclass(frozen=True)
class Camera(Summary):
    """A pinhole camera.

    Pixels are square and are averaged with a box filter.

    Parameters
    ----------
    origin : sequence of float
        Position (3,) in scene units.
    target : sequence of float
        Point (3,) in the centre of the image, in scene units.
    up : sequence of float
        Direction (3,) of the upper border of the image.
    fov : float
        Horizontal field of view in degrees.
    width, height : int
        Size of the image in pixels.

    Raises
    ------
    NergError
        A value is out of range, ``target`` equals ``origin``, or ``up`` is parallel to the viewing direction.

    Examples
    --------
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
        forward = np.subtract(self.target, self.origin)
        if not np.any(forward):
            raise NergError(f"the target of a camera must differ from its origin {self.origin}")
        if np.linalg.norm(np.cross(forward, self.up)) <= 1e-6 * np.linalg.norm(forward) * np.linalg.norm(self.up):
            raise NergError(
                f"the up direction {self.up} of a camera is parallel to its viewing direction; pass another one "
                "with up=, such as (0, 1, 0)"
            )
        check_number(self.fov, FIELDS_OF_VIEW, "the fov of a camera")
        for name in ("width", "height"):
            check_number(getattr(self, name), Range(1, MAX_PIXELS), f"the {name} of a picture", is_integer=True)
        if self.width * self.height > MAX_PIXELS:
            raise NergError(f"a picture has at most {MAX_PIXELS:,} pixels, got {self.width:,} x {self.height:,}")

    def to_dict(self, spp: int = 16) -> dict:
        """Return the camera as a dict for `mi.load_dict`, with ``spp`` samples per pixel. A Mitsuba variant must be
        active."""
        import mitsuba as mi

        return {
            "type": "perspective",
            "fov": float(self.fov),
            "fov_axis": "x",
            # In double precision until Mitsuba rounds, as in scene files.
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
