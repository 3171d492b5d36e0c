"""Sets of rays: the arrays with their metadata, files of them (.npz, .parquet), selection, joining and samples."""

from __future__ import annotations

import json
import math
import os
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import replace_atomically
from nerg_mi.files.safe_read import MAX_JSON_BYTES, compute_inflation_limit, is_count, open_npz, parse_json, translate_read_errors, check_regular_file
from nerg_mi.ranges import MAX_COORDINATE

# ---- The JSON document of a rays file: what of it the rest of the package relies on is checked here, once ----

VERSION = 1


def read_metadata(document: str | bytes, path: str | os.PathLike) -> dict[str, Any]:
    """The metadata of the rays file ``path`` without their version, from the JSON ``document`` in it.

    Known keys hold what `nerg_mi.rays.rays.Rays` documents; others are passed on as they are. Raises `NergError` for
    what is no such document, or is of another version of the format.
    """
    found = parse_json(document, path, "rays file")
    if not isinstance(found, dict):
        raise not_rays(path, "its metadata are no JSON object")
    if "version" not in found:
        raise not_rays(path, 'its metadata lack "version"')
    if found.pop("version") != VERSION:
        raise NergError(
            f'the rays file "{path}" was written by another version of the format; import the tracking files again'
        )
    for key, (holds, what) in _KNOWN.items():
        if key in found and not holds(found[key]):
            raise not_rays(path, f'"{key}" of its metadata is no {what}')
    for key in ("persons", "frame"):
        if key not in found:
            raise not_rays(path, f'its metadata lack "{key}"')
    return found


def not_rays(path: str | os.PathLike, why: str) -> NergError:
    """The error of a file ``path`` that is not one of rays, and ``why`` not."""
    return NergError(f"\"{path}\" is not a rays file ({why}); make one with 'nerg rays import'")


def _names(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(v, str) for v in value)


def _objects(value: object, **keys) -> bool:
    """Whether it is a list of objects that have all of ``keys``, each passing its test; those that end in _ may be
    missing."""
    return isinstance(value, list) and all(
        isinstance(v, dict)
        and all(test(v[k.rstrip("_")]) if k.rstrip("_") in v else k.endswith("_") for k, test in keys.items())
        for v in value
    )


def _text(value: object) -> bool:
    return isinstance(value, str)


def _runs(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(v, list) and len(v) == 2 and all(map(is_count, v)) for v in value)


def _by(value: object) -> bool:
    """How rays were split, or which rule made fixations. Where test positions are named, they are N x 3 numbers."""
    if isinstance(value, str):
        return True
    if not isinstance(value, dict):
        return False
    position = value.get("position", {})
    return (
        isinstance(position, dict)
        and _number(position.get("radius", 1.0))
        and _points(position.get("test_centres", []))
    )


def _number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e12


def _points(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(v, list) and len(v) == 3 and all(map(_number, v)) for v in value)


def _frame(value: object) -> bool:
    return isinstance(value, dict) and all(isinstance(value.get(k), str) for k in ("units", "up", "handedness"))


def _transform(value: object) -> bool:
    """4 x 4 finite numbers whose upper left part can be inverted."""
    if not (isinstance(value, list) and len(value) == 4 and all(isinstance(r, list) and len(r) == 4 for r in value)):
        return False
    if not all(_number(v) for row in value for v in row):
        return False
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in value[:3])
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    return math.isfinite(determinant) and abs(determinant) > 1e-30


_KNOWN = {
    "persons": (_names, "list of names"),
    "cohorts": (_names, "list of names"),
    "frame": (_frame, "frame of units, up and handedness"),
    "source_frame": (_frame, "frame of units, up and handedness"),
    "transform": (_transform, "4 x 4 matrix that can be inverted"),
    "rows_read": (is_count, "number of rows"),
    "sources": (lambda v: _objects(v, file=_text, sha256_=_text), "list of files"),
    "dropped": (
        lambda v: _objects(v, reason=_text, count=is_count, file_=_text, rows_=_runs),
        "list of reasons and counts",
    ),
    "steps": (
        lambda v: _objects(v, step=_text, kept=is_count, of=is_count, by_=_by),
        "list of steps with their counts",
    ),
    "complaints": (_names, "list of sentences"),
    "unused_columns": (_names, "list of names"),
    "missing": (lambda v: isinstance(v, dict) and all(map(is_count, v.values())), "list of what is missing and counts"),
    "eye_distance": (
        lambda v: isinstance(v, dict) and all(_number(d) and d >= 0 for d in v.values()),
        "list of persons and their distances in metres",
    ),
    "floor": (_text, "word"),
    "tick": (lambda v: _number(v) and v > 0, "time in seconds"),
}


# ---- Rays on disk: ``.npz`` (NumPy alone) or ``.parquet`` (through pyarrow) ----
#
# Both hold the same columns and one JSON document of metadata. Vectors are (N, 3) arrays in the ``.npz`` and three
# columns ``name_x, name_y, name_z`` in the Parquet table, where other tools expect them.

SUFFIXES = (".npz", ".parquet")
_REQUIRED = ("t", "person", "origin", "direction", "confidence")
_OPTIONAL = ("hit", "cohort", "head")
COLUMNS = (*_REQUIRED, *_OPTIONAL)  # Columns of rays, one row each; hit points, cohorts and heads may be missing
VECTORS = ("origin", "direction", "hit", "head")
# Columns of numbers of names; all others are measurements.
_CODES = ("person", "cohort")
# Memory of a ray with all columns.
_BYTES = 108
# Numbers on either side of a column's middle by which it is told whether it shrinks.
_SAMPLE = 1 << 15


def write_rays_file(path: str | os.PathLike, columns: dict[str, np.ndarray], metadata: dict[str, Any]) -> None:
    """Write columns of N rows (``t``, ``person``, ``origin``, ``direction``,
    ``confidence``, optionally ``hit``, ``cohort`` and ``head``) and JSON-serialisable metadata, whole or not at all.

    Raises `NergError` for another suffix and for metadata that `read_rays_file` would refuse, and ``ImportError`` with
    the remedy where Parquet is asked for without pyarrow.
    """
    document = json.dumps({"version": VERSION, **metadata})
    try:
        read_metadata(document, path)
    except NergError as error:
        # What is written can be read again.
        raise NergError(f"these rays cannot be kept: {error}") from error
    if _suffix(path) == ".npz":
        # What savez_compressed writes, with a faster level of zlib, and stored what hardly shrinks: millions of rays in
        # seconds.
        with replace_atomically(path) as temporary, zipfile.ZipFile(temporary, "w", compresslevel=1) as archive:
            for name, value in {"metadata": np.array(document), **columns}.items():
                archive.compression = zipfile.ZIP_DEFLATED if _shrinks(value) else zipfile.ZIP_STORED
                with archive.open(f"{name}.npy", "w", force_zip64=True) as out:
                    np.lib.format.write_array(out, value, allow_pickle=False)
        return
    pa, pq = import_pyarrow()
    table = {}
    for name, value in columns.items():
        if name in VECTORS:
            table.update({f"{name}_{axis}": value[:, i] for i, axis in enumerate("xyz")})
        else:
            table[name] = value
    with replace_atomically(path) as temporary:
        pq.write_table(pa.table(table).replace_schema_metadata({"nerg_mi": document}), temporary, compression="zstd")


def _shrinks(value: np.ndarray) -> bool:
    """Whether deflate makes a column smaller by a fifth, as far as a sample from its middle tells."""
    flat = value.reshape(-1)
    middle = len(flat) // 2
    sample = np.ascontiguousarray(flat[max(0, middle - _SAMPLE) : middle + _SAMPLE]).tobytes()
    return len(zlib.compress(sample, 1)) < 0.8 * len(sample)


def read_rays_file(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Columns and metadata as :func:`write_rays_file` took them.

    Numbers of any width are read; other columns are not. Room is made for what the file's bytes warrant, column by
    column. Raises `NergError` when the file is damaged, is no rays file, or lacks a column.
    """
    if _suffix(path) == ".npz":
        columns, document = _read_npz(path)
    else:
        columns, document = _read_parquet(path)
    return columns, read_metadata(document, path)


def _read_npz(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], str]:
    with open_npz(path, "rays file") as archive:
        there = {name: archive.read_header(name) for name in archive.names if name in COLUMNS}
        _check_columns(path, {name: (shape, dtype.kind) for name, (shape, dtype) in there.items()})
        if "metadata" not in archive:
            raise not_rays(path, "it lacks the metadata")
        shape, dtype = archive.read_header("metadata")
        if shape != () or dtype.kind != "U" or dtype.itemsize > 4 * MAX_JSON_BYTES:
            raise not_rays(path, "its metadata are no text")
        with translate_read_errors(path, "rays file"):
            document = str(archive["metadata"])
        return {name: archive[name] for name in there}, document


def _read_parquet(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], bytes]:
    pa, _ = import_pyarrow()
    with translate_read_errors(path, "rays file", extra_errors=(pa.ArrowException,)), open_parquet(path, "rays file") as table:
        about, schema = table.metadata, table.schema_arrow
        there = {}
        for name in COLUMNS:
            if all(part in schema.names for part in column_parts(name)):
                kinds = "".join(sorted({_arrow_kind(pa, schema.field(part).type) for part in column_parts(name)}))
                shape = (about.num_rows, 3) if name in VECTORS else (about.num_rows,)
                there[name] = shape, {"fi": "f"}.get(kinds, kinds)
        _check_columns(path, there)
        document = (schema.metadata or {}).get(b"nerg_mi")
        if document is None:
            raise not_rays(path, "it lacks the metadata")
        columns = {
            name: np.empty(shape, np.int64 if name in _CODES else np.float64) for name, (shape, _) in there.items()
        }
        at = 0
        for batch in table.iter_batches(
            batch_size=1 << 17, columns=[part for name in there for part in column_parts(name)]
        ):
            for name, column in columns.items():
                for i, part in enumerate(column_parts(name)):
                    values = batch.column(batch.schema.get_field_index(part))
                    if values.null_count and name in _CODES:
                        raise not_rays(path, f'its column "{part}" has cells without a value')
                    into = column[at : at + batch.num_rows]
                    (into[:, i] if name in VECTORS else into)[...] = values.to_numpy(zero_copy_only=False)
            at += batch.num_rows
        if at != about.num_rows:
            raise not_rays(path, f"it holds {at:,} of the {about.num_rows:,} rays that it claims")
    return columns, document


def column_parts(name: str) -> list[str]:
    """Columns of a Parquet table that hold the column ``name`` of rays."""
    return [f"{name}_{axis}" for axis in "xyz"] if name in VECTORS else [name]


def _arrow_kind(pa: Any, kind: Any) -> str:
    return "f" if pa.types.is_floating(kind) else "i" if pa.types.is_integer(kind) else "O"


def _check_columns(path: str | os.PathLike, there: dict[str, tuple[tuple[int, ...], str]]) -> None:
    """Raise `NergError` where columns of these shapes and kinds (NumPy's letters) do not make rays, or are more than
    the file's bytes warrant."""
    missing = [name for name in _REQUIRED if name not in there]
    if missing:
        raise not_rays(path, f"it lacks {', '.join(missing)}")
    n = (there["t"][0] or (0,))[0]
    for name, (shape, kind) in there.items():
        wanted = (n, 3) if name in VECTORS else (n,)
        if shape != wanted:
            raise not_rays(path, f"{name} has the shape {shape}, where {wanted} is expected")
        if kind not in (("i", "u") if name in _CODES else ("f", "i", "u")):
            raise not_rays(path, f"{name} is not {'whole numbers' if name in _CODES else 'numbers'}")
    # Narrow numbers become wide ones, and equal values may be stored once: what counts is the memory that rays take.
    size = check_regular_file(path, "rays file")
    if _BYTES * n > compute_inflation_limit(size):
        raise _not_warranted(path, "rays file", n, size)


def open_parquet(path: str | os.PathLike, what: str, row_bytes: int = 0) -> Any:
    """The open Parquet file ``path``; `NergError` for one that is damaged, or claims more than its bytes warrant: equal
    values are stored once, so that what counts is also what its rows, of ``row_bytes`` or more, become."""
    pa, pq = import_pyarrow()
    size = check_regular_file(path, what)
    with translate_read_errors(path, what, extra_errors=(pa.ArrowException,)):
        table = pq.ParquetFile(path)
        about = table.metadata
        claimed = sum(about.row_group(i).total_byte_size for i in range(about.num_row_groups))
    if max(claimed, row_bytes * about.num_rows) > compute_inflation_limit(size):
        raise _not_warranted(path, what, about.num_rows, size)
    return table


def _not_warranted(path: str | os.PathLike, what: str, rows: int, size: int) -> NergError:
    kind = "rays" if what == "rays file" else "rows"
    return NergError(
        f'the {what} "{path}" claims {rows:,} {kind}, which its {size:,} bytes do not warrant; copy it again'
    )


def _suffix(path: str | os.PathLike) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise NergError(f"{path}: rays are kept as .npz or .parquet; choose a name with one of these endings")
    return suffix


def import_pyarrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ImportError(
            "Parquet needs pyarrow, which is not installed; run \"pip install 'nerg-mi[parquet]'\" or use a .npz file"
        ) from error
    return pyarrow, pyarrow.parquet


# ---- Rays of attention: who looked from where to where, and when ----
#
# Frame of every :class:`Rays`: right-handed, z up, metres, seconds. Readers convert into it
# (:mod:`nerg_mi.rays.readers`) and record the transform that they applied in the metadata.

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
        for name, value in self.columns().items():
            shape = (n, 3) if name in VECTORS else (n,)
            if value.shape != shape:
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
        nowhere = np.asarray(~(np.abs(self.origin) <= MAX_COORDINATE).all(axis=1))
        _refuse(nowhere, f"an origin that is not finite or beyond {MAX_COORDINATE:g} m", "drop it before building Rays")
        if self.hit is not None:
            far = np.asarray((np.abs(self.hit) > MAX_COORDINATE).any(axis=1))
            _refuse(far, f"a hit point beyond {MAX_COORDINATE:g} m", "drop it, or make it NaN, which is unknown")
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
        return {name: column for name in COLUMNS if (column := getattr(self, name)) is not None}

    def select(self, which: np.ndarray) -> Rays:
        """The rays of a boolean mask (N,) or an index array; persons and metadata are kept, so that codes and
        provenance stay comparable."""
        return replace(self, **{name: column[which] for name, column in self.columns().items()})

    def filter_in_place(self, mask: np.ndarray) -> Rays:
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
        """Write ``.npz`` or ``.parquet``; see :mod:`nerg_mi.rays.rays`."""
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


# ---- Which rays start near a place: a spatial index of millions of origins ----

_INDEX_BLOCK = 1 << 21  # neighbours held at a time: memory stays bounded


class Neighbours(NamedTuple):
    """The rays near each of Q places, place after place."""

    indices: np.ndarray  # (n,) of rays; of a place, nearest first
    distances: np.ndarray  # (n,) metres
    offsets: np.ndarray  # (Q + 1,): place q has indices[offsets[q]:offsets[q + 1]]


class RayIndex:
    """A k-d tree of ray origins. ``rays``: a set of rays, or origins (N, 3) in metres."""

    def __init__(self, rays: Rays | np.ndarray) -> None:
        from scipy.spatial import KDTree

        origin = rays.origin if isinstance(rays, Rays) else np.asarray(rays, dtype=np.float64)
        self.count = len(origin)
        # Without balancing: half the time to build, and as fast to ask. The order of rays that are equally far depends
        # on the size of the leaves, and with it the bits of what is made of them.
        self._tree = KDTree(origin, leafsize=16, balanced_tree=False)

    def query(self, places: np.ndarray, most: int, radius: float = np.inf) -> Neighbours:
        """The ``most`` nearest rays of each of ``places`` (Q, 3), within ``radius`` metres (those at exactly R
        count)."""
        places = np.asarray(places, dtype=np.float64).reshape(-1, 3)
        if most < 1 or not radius > 0:
            raise ValueError(f"most {most}, radius {radius}: ask for at least one ray within a positive radius")
        most = min(most, self.count)
        # A hair more than R: scipy leaves out what lies at the bound.
        bound = np.nextafter(radius, np.inf) if np.isfinite(radius) else np.inf
        step = max(1, _INDEX_BLOCK // most)
        indices, distances, counts = [], [], []
        for start in range(0, len(places), step):
            part = places[start : start + step]
            answer = self._tree.query(part, k=most, distance_upper_bound=bound, workers=-1)
            d, i = (np.asarray(v).reshape(len(part), most) for v in answer)
            found = np.isfinite(d)
            indices.append(i[found])
            distances.append(d[found])
            counts.append(found.sum(axis=1))
        offsets = np.concatenate([[0], np.cumsum(np.concatenate(counts))]) if counts else np.zeros(1, np.int64)
        join = lambda parts, kind: np.concatenate(parts) if parts else np.empty(0, kind)
        return Neighbours(join(indices, np.int64), join(distances, np.float64), offsets.astype(np.int64))


# ---- Rays of several blocks as one ----

_EMPTY = np.zeros((0, 3))


def merge_rays(blocks: Iterable[Rays], metadata: dict[str, Any] | None = None) -> Rays:
    """The rays of all ``blocks``, in this order, with the sorted persons and cohorts that occur.

    Blocks without hit points or heads get NaN, and those without cohorts the cohort "unknown", where others have some.
    """
    held = [(block.columns(), block.persons, block.cohorts, len(block)) for block in map(_compact, blocks)]
    metadata = {"frame": dict(FRAME)} if metadata is None else metadata
    if not held:
        none = _EMPTY[:, 0]
        return Rays(none, np.zeros(0, np.int32), (), _EMPTY, _EMPTY, none, metadata=metadata)
    persons = tuple(sorted({name for _, names, _, _ in held for name in names}))
    grouped = any("cohort" in columns for columns, *_ in held)
    alike = {"unknown"} if any("cohort" not in columns for columns, *_ in held) else set()
    cohorts = tuple(sorted({name for _, _, names, _ in held for name in names} | alike)) if grouped else ()
    place, group = ({name: k for k, name in enumerate(names)} for names in (persons, cohorts))
    for columns, known, groups, n in held:
        columns["person"] = _renumbered(columns["person"], known, place)
        if grouped:
            codes, groups = (
                (columns["cohort"], groups) if "cohort" in columns else (np.zeros(n, np.int32), ("unknown",))
            )
            columns["cohort"] = _renumbered(codes, groups, group)
        for name, kind in (("hit", np.float64), ("head", np.float32)):
            if name not in columns and any(name in other for other, *_ in held):
                columns[name] = np.full((n, 3), np.nan, kind)
    # Column by column, so that no more than one is there twice.
    joined = {
        name: np.concatenate([columns.pop(name) for columns, *_ in held]) for name in COLUMNS if name in held[0][0]
    }
    return Rays(**joined, persons=persons, cohorts=cohorts, metadata=metadata)


_MERGED = ("sources", "dropped", "rows_read", "complaints", "eye_distance", "missing", "unused_columns")


def merge_metadata(each: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What holds for all of several, what was dropped of any, and how many rows were read; ``steps`` that all have."""
    first = each[0] if each else {"frame": dict(FRAME)}
    same = {k: v for k, v in first.items() if k not in _MERGED and all(other.get(k) == v for other in each)}
    listed = lambda key: [entry for other in each for entry in other.get(key, [])]
    where_any = {
        "missing": merge_counts(other.get("missing", {}) for other in each),
        "unused_columns": list(dict.fromkeys(listed("unused_columns"))),
        "complaints": list(dict.fromkeys(listed("complaints"))),
        "eye_distance": {name: metres for other in each for name, metres in other.get("eye_distance", {}).items()},
    }
    return {
        **same,
        **{key: value for key, value in where_any.items() if value},
        "frame": first["frame"],
        "sources": listed("sources"),
        "rows_read": sum(other.get("rows_read", 0) for other in each),
        "dropped": listed("dropped"),
    }


def merge_counts(counts: Iterable[dict[str, int]]) -> dict[str, int]:
    """Sums by name, in the order of names."""
    total: Counter[str] = Counter()
    for each in counts:
        total.update(each)
    return dict(sorted(total.items()))


def _compact(rays: Rays) -> Rays:
    """The same rays, without the names of people and cohorts that have none of them."""
    persons, cohorts = _used(rays.person, rays.persons), _used(rays.cohort, rays.cohorts)
    if persons == rays.persons and cohorts == rays.cohorts:
        return rays
    cohort = None if rays.cohort is None else _places(rays.cohort)
    return replace(rays, person=_places(rays.person), persons=persons, cohort=cohort, cohorts=cohorts)


def _used(codes: np.ndarray | None, names: tuple[str, ...]) -> tuple[str, ...]:
    return () if codes is None else tuple(names[k] for k in np.flatnonzero(np.bincount(codes)).tolist())


def _places(codes: np.ndarray) -> np.ndarray:
    """The codes (N,) among those that occur."""
    return (np.cumsum(np.bincount(codes) > 0) - 1)[codes]


def _renumbered(codes: np.ndarray, names: Sequence[str], place: dict[str, int]) -> np.ndarray:
    return np.array([place[name] for name in names], np.int32)[codes]


# ---- Which of very many rays are taken as a sample, without room for all of their numbers ----


def sample_rows(count: int, n: int, seed: int = 0, runs: int | None = None) -> np.ndarray:
    """``n`` of the numbers from 0 to ``count`` - 1, sorted (n,) int64; all, where there are no more.

    Every number is as likely as any other. Without ``runs`` so is every set of ``n`` of them. With it they are so many
    runs of neighbours, wherever these begin: less has to be read for them, and they tell less, since neighbours are
    alike.
    """
    rng = np.random.default_rng(seed)
    if n >= count:
        return np.arange(count)
    if runs is not None and runs < n:
        length = n // runs
        # Cells of equal length on a circle that is turned at random.
        cells = _distinct(count // length, runs, rng)
        start = (rng.integers(count) + cells * length) % count
        return np.sort((start[:, None] + np.arange(length)).ravel() % count)
    if n > count // 2:
        keep = np.ones(count, bool)
        keep[_distinct(count, count - n, rng)] = False
        return np.flatnonzero(keep)
    return _distinct(count, n, rng)


def _distinct(count: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """``n`` different numbers below ``count``, sorted: drawn until there are enough, and of too many some are left out
    at random."""
    found = np.zeros(0, np.int64)
    while len(found) < n:
        # Sorted, where numpy.unique would make a table of hashes: several times as fast.
        found = np.sort(np.concatenate([found, rng.integers(0, count, n - len(found) + 16)]))
        found = found[np.r_[True, found[1:] != found[:-1]]]
    return np.delete(found, rng.choice(len(found), len(found) - n, replace=False))
