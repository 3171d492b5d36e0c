"""Rays of attention: who looked from where to where, and when.

Frame of every :class:`Rays`: right-handed, z up, metres, seconds. Readers convert into it
(:mod:`nerg_mi.rays.readers`) and record the transform that they applied in the metadata.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError
from nerg_mi.ranges import FARTHEST

from .io import COLUMNS, read_rays_file, write_rays_file

# Rows moved at a time.
_BLOCK = 1 << 18

FRAME = {"units": "m", "up": "z", "handedness": "right"}


@dataclass(frozen=True, eq=False)
class Rays:
    """N rays of attention, checked on construction.

    Raises `NergError` naming the first offending ray for NaN, zero or non-unit directions, origins that are not finite,
    origins and hit points beyond `FARTHEST`, non-finite times, and persons out of range; ``ValueError`` for arrays of
    different lengths.

    >>> import nerg_mi as nerg
    >>> eye, ahead = [[1.0, 1.0, 1.6], [1.0, 1.0, 1.6]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    >>> rays = nerg.Rays([0.0, 0.1], [0, 0], ("Ada",), origin=eye, direction=ahead, confidence=[1.0, 1.0])
    >>> len(rays.select(rays.t > 0))
    1
    """

    t: np.ndarray  # (N,) seconds, on any clock
    person: np.ndarray  # (N,) int32 index into persons; names of theirs become that
    persons: tuple[str, ...]  # names
    origin: np.ndarray  # (N, 3) metres: the eye, or the head
    direction: np.ndarray  # (N, 3) unit
    confidence: np.ndarray  # (N,) in [0, 1]
    hit: np.ndarray | None = None  # (N, 3) metres, the point looked at, NaN where unknown
    # frame (units, up, handedness), and of what was imported: source_frame, sources (file name and sha256), transform
    # (4x4 from the source's frame), rows_read, dropped (reason, count and rows of each source), missing (counts of
    # hit points that were fill values), unused_columns (names); steps done since then.
    metadata: dict[str, Any] = field(default_factory=lambda: {"frame": dict(FRAME)})
    cohort: np.ndarray | None = None  # (N,) int32 index into cohorts
    cohorts: tuple[str, ...] = ()  # names of groups of people
    head: np.ndarray | None = None  # (N, 3) float32 unit, where the head points, NaN where unknown

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)
        for name in ("persons", "cohorts"):
            names = getattr(self, name)
            if isinstance(names, str):
                raise NergError(f'{name} are several names, as in {name}=("Ada", "Bob"), got {names!r}')
            put(name, tuple(str(one) for one in names))
        for name in ("person", "cohort"):
            if getattr(self, name) is not None:
                put(name, _numbers_of(getattr(self, name), getattr(self, name + "s"), name))
        for name in ("t", "origin", "direction", "confidence", "hit", "head"):
            if (value := getattr(self, name)) is not None:
                put(name, _floats(value, name, np.float32 if name == "head" else np.float64))

        n = len(self.t)
        shapes = {
            "person": (n,),
            "origin": (n, 3),
            "direction": (n, 3),
            "confidence": (n,),
            "hit": (n, 3),
            "cohort": (n,),
            "head": (n, 3),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"{name} has shape {value.shape}, expected {shape}: one row for each of {n} times")
        if "frame" not in self.metadata:
            raise ValueError(
                'metadata lacks "frame"; state units, up axis and handedness (see nerg_mi.rays.rays.FRAME)'
            )

        # Summed without arrays of squares: of ten million rays these alone take a quarter of a gigabyte.
        length = np.sqrt(np.einsum("ij,ij->i", self.direction, self.direction))
        _refuse(~np.isfinite(length), "a direction that is not finite", "drop it before building Rays")
        _refuse(length == 0, "a zero direction", "drop it before building Rays")
        _refuse(np.abs(length - 1) > 1e-4, "a direction that is not of unit length", "divide it by its length")
        nowhere = np.asarray(~(np.abs(self.origin) <= FARTHEST).all(axis=1))
        _refuse(nowhere, f"an origin that is not finite or beyond {FARTHEST:g} m", "drop it before building Rays")
        if self.hit is not None:
            far = np.asarray((np.abs(self.hit) > FARTHEST).any(axis=1))
            _refuse(far, f"a hit point beyond {FARTHEST:g} m", "drop it, or make it NaN, which is unknown")
        _refuse(~np.isfinite(self.t), "a time that is not finite", "drop it before building Rays")
        # Before they become 32 bits wide, in which numbers that are too large would be those of somebody else.
        _refuse(~((self.person >= 0) & (self.person < len(self.persons))), "an unknown person", "extend persons")
        put("person", np.ascontiguousarray(self.person, dtype=np.int32))
        if self.cohort is not None:
            _refuse(~((self.cohort >= 0) & (self.cohort < len(self.cohorts))), "an unknown cohort", "extend cohorts")
            put("cohort", np.ascontiguousarray(self.cohort, dtype=np.int32))
        if self.head is not None:
            length = np.sqrt(np.einsum("ij,ij->i", self.head, self.head))
            _refuse(np.abs(length - 1) > 1e-4, "a head that is not of unit length", "divide it by its length")
        _refuse(~((self.confidence >= 0) & (self.confidence <= 1)), "a confidence outside [0, 1]", "rescale it")

    def __len__(self) -> int:
        return len(self.t)

    def columns(self) -> dict[str, np.ndarray]:
        """The arrays with a row a ray, by name; without those that are not there."""
        found = {name: getattr(self, name) for name in COLUMNS}
        return {name: column for name, column in found.items() if column is not None}

    def select(self, which: np.ndarray) -> Rays:
        """The rays of a boolean mask (N,) or an index array; persons and metadata are kept, so that codes and
        provenance stay comparable."""
        return replace(self, **{name: column[which] for name, column in self.columns().items()})

    def keep_in_place(self, mask: np.ndarray) -> Rays:
        """The rays of a boolean mask (N,), moved together in the memory of these, which must not be used afterwards: of
        millions of rays there are then never two copies."""
        kept = np.flatnonzero(mask)
        columns = {}
        for name, column in self.columns().items():
            for a in range(0, len(kept), _BLOCK):
                # What is read lies at or behind what is written.
                rows = kept[a : a + _BLOCK]
                column[a : a + len(rows)] = column[rows]
            columns[name] = column[: len(kept)]
        return replace(self, **columns)

    def with_step(self, **what: Any) -> Rays:
        """The same rays with a step added to the list ``steps`` of the metadata: what was done to them since the
        import."""
        return replace(self, metadata={**self.metadata, "steps": [*self.metadata.get("steps", []), what]})

    def save(self, path: str | os.PathLike) -> None:
        """Write ``.npz`` or ``.parquet``; see :mod:`nerg_mi.rays.io`."""
        cohorts = {"cohorts": list(self.cohorts)} if self.cohort is not None else {}
        write_rays_file(path, self.columns(), {**self.metadata, "persons": list(self.persons), **cohorts})

    @classmethod
    def load(cls, path: str | os.PathLike) -> Rays:
        """Read what :meth:`save` wrote, checking it as on construction. Raises `NergError` with the file's name."""
        columns, metadata = read_rays_file(path)
        persons, cohorts = metadata.pop("persons"), metadata.pop("cohorts", ())
        try:
            return cls(**columns, persons=persons, metadata=metadata, cohorts=cohorts)
        except NergError as error:
            why = str(error).split(";")[0]
            raise NergError(
                f"\"{path}\" is damaged ({why}); copy it again, or make it anew with 'nerg rays import'"
            ) from error


def _floats(values: ArrayLike, name: str, dtype: type[np.floating[Any]]) -> np.ndarray:
    try:
        return np.ascontiguousarray(values, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise NergError(f'"{name}" of rays holds what is no number ({error}); give an array of numbers') from error


def _numbers_of(values: ArrayLike, names: tuple[str, ...], what: str) -> np.ndarray:
    """``values`` (N,), numbers that count ``names`` from 0 on, or some of these names, as numbers."""
    values = np.asarray(values)
    if not any(isinstance(value, str) for value in values.ravel()[:1].tolist()):
        return values
    numbers = {name: number for number, name in enumerate(names)}
    unknown = next((value for value in values.ravel().tolist() if value not in numbers), None)
    if unknown is not None:
        raise NergError(f"{unknown!r} is a {what} of the rays and none of {what}s; name all of them in {what}s=(...)")
    return np.array([numbers[value] for value in values.ravel().tolist()], np.int32).reshape(values.shape)


def _refuse(bad: np.ndarray | np.bool_, what: str, remedy: str) -> None:
    rows = np.flatnonzero(bad)
    if rows.size:
        listed = ", ".join(map(str, rows[:5])) + (", ..." if rows.size > 5 else "")
        raise NergError(f"{rows.size} of {bad.size} rays have {what} (rays {listed}); {remedy}")
