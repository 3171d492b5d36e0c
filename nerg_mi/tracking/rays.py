"""Sets of rays: arrays with metadata, their files (.npz, .parquet), selection, merging and sampling.

A gaze sample has these columns; ``.parquet`` (extra ``parquet``) names them ``origin_x`` and so on:

- ``t``: time in seconds, on any clock; ``person``: index into ``persons``
- ``origin`` (m): position of the eye, or of the head
- ``direction``: unit vector of the gaze, or of the head
- ``confidence``: 0 to 1
- ``hit`` (m), optional: the point of regard, NaN where unknown
- ``cohort``, optional: index into ``cohorts``, groups of participants
- ``head``, optional: unit vector of the head's direction, NaN where unknown

The frame is right-handed, z up, in metres. An import records the source frame, the 4x4 matrix from it, the files
with their SHA-256, the number of rows, and each dropped row with its reason. Later operations are appended to
``steps``. A sample takes 92 bytes in memory with hit points and float64.
"""

from __future__ import annotations

import json
import os
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from nerg_mi.errors import NergError, sanitize
from nerg_mi.files.atomic import replace_atomically
from nerg_mi.files.safe_read import (
    MAX_JSON_BYTES,
    check_regular_file,
    compute_inflation_limit,
    is_count,
    open_npz,
    parse_json,
    translate_read_errors,
)
from nerg_mi.files.values import to_names, to_numbers, to_seconds, unify_names
from nerg_mi.maths.transforms import check_rigid_transforms
from nerg_mi.ranges import MAX_COORDINATE

# ---- JSON metadata of a rays file: the values that this package uses are validated here ----

VERSION = 1


def read_metadata(document: str | bytes, path: str | os.PathLike) -> dict[str, Any]:
    """Parse and validate the metadata of the rays file ``path`` from its JSON ``document``; removes the version.

    Known keys have the values documented in `nerg_mi.tracking.rays.Rays`; unknown keys are kept. Raises `NergError` for
    an invalid document or another version of the format.
    """
    metadata = parse_json(document, path, "rays file")
    if not isinstance(metadata, dict):
        raise invalid_rays_file(path, "its metadata are not a JSON object")
    if "version" not in metadata:
        raise invalid_rays_file(path, 'its metadata lack "version"')
    if metadata.pop("version") != VERSION:
        raise NergError(
            f'the rays file "{path}" was written by another version of the format; import the tracking files again'
        )
    if problem := _find_metadata_problem(metadata):
        raise invalid_rays_file(path, f"in its metadata, {problem}")
    return metadata


def _find_metadata_problem(metadata: dict[str, Any]) -> str | None:
    """Return what is wrong with the values of ``metadata``, or None."""
    for key, (holds, what) in _METADATA_CHECKS.items():
        if key in metadata and not holds(metadata[key]):
            return f'"{key}" is not {what}'
    return next((f'"{key}" is missing' for key in ("persons", "frame") if key not in metadata), None)


def invalid_rays_file(path: str | os.PathLike, reason: str) -> NergError:
    """Make the error for a file ``path`` that is not a rays file, with the ``reason``."""
    return NergError(f"\"{path}\" is not a rays file ({reason}); make one with 'nerg rays import'")


def _is_text_list(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(v, str) for v in value)


def _is_object_list(value: object, **keys) -> bool:
    """Whether a value is a list of objects with all of ``keys``, each passing its test; keys ending in _ are
    optional."""
    return isinstance(value, list) and all(
        isinstance(v, dict)
        and all(test(v[k.rstrip("_")]) if k.rstrip("_") in v else k.endswith("_") for k, test in keys.items())
        for v in value
    )


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_run_list(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(v, list) and len(v) == 2 and all(map(is_count, v)) for v in value)


def _is_split_or_rule(value: object) -> bool:
    """Whether a value describes a split, with N x 3 test centres if any, or is the name of a fixation algorithm."""
    if isinstance(value, str):
        return True
    if not isinstance(value, dict):
        return False
    position = value.get("position", {})
    return (
        isinstance(position, dict)
        and _is_number(position.get("radius", 1.0))
        and _is_point_list(position.get("test_centres", []))
    )


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e12


def _is_point_list(value: object) -> bool:
    return isinstance(value, list) and all(
        isinstance(v, list) and len(v) == 3 and all(map(_is_number, v)) for v in value
    )


def _is_frame(value: object) -> bool:
    return isinstance(value, dict) and all(isinstance(value.get(k), str) for k in ("units", "up", "handedness"))


def _is_transform(value: Any) -> bool:
    """Whether a value is a 4 x 4 matrix: a rotation or reflection, a uniform scale and a translation."""
    try:
        check_rigid_transforms(value, "the transform", may_scale=True, may_mirror=True, shape=(4, 4))
    except NergError:
        return False
    return True


_METADATA_CHECKS = {
    "persons": (_is_text_list, "a list of names"),
    "cohorts": (_is_text_list, "a list of names"),
    "frame": (_is_frame, "a frame with units, up and handedness"),
    "source_frame": (_is_frame, "a frame with units, up and handedness"),
    **dict.fromkeys(
        ("transform", "place_from_rays"),
        (_is_transform, "a 4 x 4 matrix of a rotation, a uniform scale and a translation"),
    ),
    "rows_read": (is_count, "a number of rows"),
    "sources": (lambda v: _is_object_list(v, file=_is_text, sha256_=_is_text), "a list of files"),
    "dropped": (
        lambda v: _is_object_list(v, reason=_is_text, count=is_count, file_=_is_text, rows_=_is_run_list),
        "a list of reasons and counts",
    ),
    "steps": (
        lambda v: _is_object_list(v, step=_is_text, kept=is_count, of=is_count, by_=_is_split_or_rule),
        "a list of steps with their counts",
    ),
    "complaints": (_is_text_list, "a list of sentences"),
    "unused_columns": (_is_text_list, "a list of names"),
    "missing": (
        lambda v: isinstance(v, dict) and all(map(is_count, v.values())),
        "a mapping of what is missing to counts",
    ),
    "eye_distance": (
        lambda v: isinstance(v, dict) and all(_is_number(d) and d >= 0 for d in v.values()),
        "a mapping of participants to distances in metres",
    ),
    "floor": (_is_text, "text"),
    "tracking": (lambda v: isinstance(v, str) and v in TRACKING, "eye, head, mixed or unknown"),
    "tracking_by_person": (
        lambda v: isinstance(v, dict) and all(isinstance(kind, str) and kind in TRACKING for kind in v.values()),
        "a mapping of participants to eye, head, mixed or unknown",
    ),
    "tick": (lambda v: _is_number(v) and v > 0, "a time in seconds"),
}


# ---- Rays on disk: ``.npz`` (only needs NumPy) or ``.parquet`` (needs pyarrow) ----
#
# Both contain the same columns and one JSON document of metadata. Vectors are (N, 3) arrays in the ``.npz``, and three
# columns ``name_x, name_y, name_z`` in the Parquet table, as other tools expect.

SUFFIXES = (".npz", ".parquet")
_REQUIRED = ("t", "person", "origin", "direction", "confidence")
_OPTIONAL = ("hit", "cohort", "head")
COLUMNS = (*_REQUIRED, *_OPTIONAL)  # Columns of rays, one row per ray; hits, cohorts and heads are optional
VECTORS = ("origin", "direction", "hit", "head")
# Columns of codes, which index lists of names; all others are measurements.
_CODE_COLUMNS = ("person", "cohort")
# Memory of a ray with all columns, bytes.
_RAY_BYTES = 108
# Values on either side of a column's middle that are compressed to test whether the column is compressible.
_SAMPLE_VALUES = 1 << 15


def write_rays_file(path: str | os.PathLike, columns: dict[str, np.ndarray], metadata: dict[str, Any]) -> None:
    """Write columns of N rows and JSON-serialisable metadata atomically.

    Columns are ``t``, ``person``, ``origin``, ``direction``, ``confidence``, and optionally ``hit``, ``cohort`` and
    ``head``. Raises `NergError` for an unsupported suffix and for metadata that `read_rays_file` would reject, and
    ``ImportError`` for Parquet without pyarrow.
    """
    document = json.dumps({**metadata, "version": VERSION})
    # Only write what can be read again.
    written = parse_json(document, path, "rays file")
    assert isinstance(written, dict)
    if problem := _find_metadata_problem(written):
        raise NergError(f"the metadata of these rays are invalid: {problem}")
    if _check_suffix(path) == ".npz":
        # Like savez_compressed, but with a faster level of zlib, and without compression where it has little effect:
        # takes seconds for millions of rays.
        with replace_atomically(path) as temporary, zipfile.ZipFile(temporary, "w", compresslevel=1) as archive:
            for name, value in {"metadata": np.array(document), **columns}.items():
                archive.compression = zipfile.ZIP_DEFLATED if _is_compressible(value) else zipfile.ZIP_STORED
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


def _is_compressible(value: np.ndarray) -> bool:
    """Whether deflate reduces a sample from the middle of a column by at least a fifth."""
    flat = value.reshape(-1)
    centre = len(flat) // 2
    sample = np.ascontiguousarray(flat[max(0, centre - _SAMPLE_VALUES) : centre + _SAMPLE_VALUES]).tobytes()
    return len(zlib.compress(sample, 1)) < 0.8 * len(sample)


def read_rays_file(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read columns and metadata as :func:`write_rays_file` writes them.

    Accepts numbers of any width and ignores other columns. Memory is limited by the size of the file. Raises
    `NergError` if the file is damaged, not a rays file, or lacks a column.
    """
    if _check_suffix(path) == ".npz":
        columns, document = _read_npz(path)
    else:
        columns, document = _read_parquet(path)
    return columns, read_metadata(document, path)


def _read_npz(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], str]:
    with open_npz(path, "rays file") as archive:
        available = {name: archive.read_header(name) for name in archive.names if name in COLUMNS}
        _check_columns(path, {name: (shape, dtype.kind) for name, (shape, dtype) in available.items()})
        if "metadata" not in archive:
            raise invalid_rays_file(path, "it lacks the metadata")
        shape, dtype = archive.read_header("metadata")
        if shape != () or dtype.kind != "U" or dtype.itemsize > 4 * MAX_JSON_BYTES:
            raise invalid_rays_file(path, "its metadata are not text")
        with translate_read_errors(path, "rays file"):
            document = str(archive["metadata"])
        return {name: archive[name] for name in available}, document


def _read_parquet(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], bytes]:
    pa, _ = import_pyarrow()
    with (
        translate_read_errors(path, "rays file", extra_errors=(pa.ArrowException,)),
        open_parquet(path, "rays file") as table,
    ):
        file_metadata, schema = table.metadata, table.schema_arrow
        available = {}
        for name in COLUMNS:
            if all(part in schema.names for part in parquet_columns(name)):
                kinds = "".join(sorted({_arrow_kind(pa, schema.field(part).type) for part in parquet_columns(name)}))
                shape = (file_metadata.num_rows, 3) if name in VECTORS else (file_metadata.num_rows,)
                available[name] = shape, {"fi": "f"}.get(kinds, kinds)
        _check_columns(path, available)
        document = (schema.metadata or {}).get(b"nerg_mi")
        if document is None:
            raise invalid_rays_file(path, "it lacks the metadata")
        columns = {
            name: np.empty(shape, np.int64 if name in _CODE_COLUMNS else np.float64)
            for name, (shape, _) in available.items()
        }
        num_read = 0
        for batch in table.iter_batches(
            batch_size=1 << 17, columns=[part for name in available for part in parquet_columns(name)]
        ):
            for name, column in columns.items():
                for i, part in enumerate(parquet_columns(name)):
                    values = batch.column(batch.schema.get_field_index(part))
                    if values.null_count and name in _CODE_COLUMNS:
                        raise invalid_rays_file(path, f'its column "{part}" has empty cells')
                    target = column[num_read : num_read + batch.num_rows]
                    (target[:, i] if name in VECTORS else target)[...] = values.to_numpy(zero_copy_only=False)
            num_read += batch.num_rows
        if num_read != file_metadata.num_rows:
            raise invalid_rays_file(
                path, f"it contains {num_read:,} of the {file_metadata.num_rows:,} rays that it declares"
            )
    return columns, document


def parquet_columns(name: str) -> list[str]:
    """Names of the Parquet columns that contain the column ``name`` of rays."""
    return [f"{name}_{axis}" for axis in "xyz"] if name in VECTORS else [name]


def _arrow_kind(pa: Any, kind: Any) -> str:
    return "f" if pa.types.is_floating(kind) else "i" if pa.types.is_integer(kind) else "O"


def _check_columns(path: str | os.PathLike, available: dict[str, tuple[tuple[int, ...], str]]) -> None:
    """Raise `NergError` if columns of these shapes and kinds (NumPy's letters) are not those of rays, or if they would
    take more memory than the size of the file permits."""
    missing = [name for name in _REQUIRED if name not in available]
    if missing:
        raise invalid_rays_file(path, f"it lacks {', '.join(missing)}")
    n = (available["t"][0] or (0,))[0]
    for name, (shape, kind) in available.items():
        expected = (n, 3) if name in VECTORS else (n,)
        if shape != expected:
            raise invalid_rays_file(path, f"{name} has shape {shape}, expected {expected}")
        if kind not in (("i", "u") if name in _CODE_COLUMNS else ("f", "i", "u")):
            raise invalid_rays_file(path, f"{name} is not {'integers' if name in _CODE_COLUMNS else 'numbers'}")
    # Compare the memory of the decoded rays: narrow numbers are widened, and equal values may be stored once.
    size = check_regular_file(path, "rays file")
    if _RAY_BYTES * n > compute_inflation_limit(size):
        raise _oversized_file(path, "rays file", n, size)


def open_parquet(path: str | os.PathLike, what: str, row_bytes: int = 0) -> Any:
    """Open the Parquet file ``path``. Raises `NergError` if it is damaged, or if it would take more memory than its
    size permits; its rows take at least ``row_bytes`` each when decoded, since equal values may be stored once."""
    pa, pq = import_pyarrow()
    size = check_regular_file(path, what)
    with translate_read_errors(path, what, extra_errors=(pa.ArrowException,)):
        table = pq.ParquetFile(path)
        file_metadata = table.metadata
        claimed_bytes = sum(file_metadata.row_group(i).total_byte_size for i in range(file_metadata.num_row_groups))
    if max(claimed_bytes, row_bytes * file_metadata.num_rows) > compute_inflation_limit(size):
        raise _oversized_file(path, what, file_metadata.num_rows, size)
    return table


def _oversized_file(path: str | os.PathLike, what: str, rows: int, size: int) -> NergError:
    kind = "rays" if what == "rays file" else "rows"
    return NergError(
        f'the {what} "{path}" declares {rows:,} {kind}, too many for its size of {size:,} bytes; copy it again'
    )


def _check_suffix(path: str | os.PathLike) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise NergError(f"{path}: rays are saved as .npz or .parquet; use a name with one of these suffixes")
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


# ---- Rays: gaze samples as an origin and a direction ----
#
# All :class:`Rays` are in one common frame: right-handed, z up, metres, seconds. Readers convert to it
# (:mod:`nerg_mi.tracking.readers`) and record the transform in the metadata.

# Rows copied at a time.
_BLOCK = 1 << 18

FRAME = {"units": "m", "up": "z", "handedness": "right"}

TRACKING = {
    "eye": "gaze (eye tracking)",
    "head": "directions of heads (head tracking), not gaze",
    "mixed": "gaze of some samples, and directions of heads of others",
    "unknown": "not stated: gaze, or directions of heads",
}
"""What directions are; unknown in files of earlier versions. Those of heads have no fixations and saccades."""


def check_tracking(tracking: str) -> str:
    """Return ``tracking``. Raises `NergError` unless it is one of `TRACKING`."""
    if not isinstance(tracking, str) or tracking not in TRACKING:
        raise NergError(f"tracking must be one of {', '.join(TRACKING)}, got {sanitize(repr(tracking), 40)}")
    return tracking


def merge_tracking(kinds: Iterable[str]) -> str:
    """Return what directions of several kinds are together: "mixed" if some, but not all, are of heads."""
    kinds = set(kinds) or {"unknown"}
    return kinds.pop() if len(kinds) == 1 else "mixed" if kinds & {"head", "mixed"} else "unknown"


@dataclass(frozen=True, eq=False, repr=False)
class Rays:
    """N gaze samples as rays, validated on construction.

    Raises `NergError` naming the first invalid ray for NaN, zero or non-unit directions, origins that are not finite,
    origins and hit points beyond `MAX_COORDINATE`, non-finite times, and codes out of range; ``ValueError`` for arrays
    of different lengths.

    >>> import nerg_mi as nerg
    >>> eye, ahead = [[1.0, 1.0, 1.6], [1.0, 1.0, 1.6]], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    >>> rays = nerg.Rays([0.0, 0.1], [0, 0], ("Ada",), origin=eye, direction=ahead, confidence=[1.0, 1.0])
    >>> len(rays.select(rays.t > 0))
    1
    """

    t: np.ndarray  # (N,) seconds, on any clock
    person: np.ndarray  # (N,) int32 index into persons; names are converted to indices
    persons: tuple[str, ...]  # names of participants
    origin: np.ndarray  # (N, 3) metres: position of the eye, or of the head
    direction: np.ndarray  # (N, 3) unit
    confidence: np.ndarray  # (N,) in [0, 1]
    hit: np.ndarray | None = None  # (N, 3) metres: point of regard on a surface, NaN if unknown
    # frame (units, up, handedness), tracking (of `TRACKING`), if it is mixed tracking_by_person and, after an import:
    # source_frame, sources (file name and sha256), transform (4x4 from the source's frame), rows_read, dropped
    # (reason, count and rows of each source), missing (counts of hit points that were fill values), unused_columns
    # (names), steps (processing since the import).
    metadata: dict[str, Any] = field(default_factory=lambda: {"frame": dict(FRAME)})
    cohort: np.ndarray | None = None  # (N,) int32 index into cohorts
    cohorts: tuple[str, ...] = ()  # names of groups of participants
    head: np.ndarray | None = None  # (N, 3) float32 unit: direction of the head, NaN if unknown

    def __post_init__(self) -> None:
        set_field = lambda name, value: object.__setattr__(self, name, value)
        for name in ("persons", "cohorts"):
            names = getattr(self, name)
            if isinstance(names, str):
                raise NergError(f'{name} needs a sequence of names, as in {name}=("Ada", "Bob"), got {names!r}')
            texts, index = unify_names(names)
            set_field(name, texts)
            column = name.removesuffix("s")
            if getattr(self, column) is not None:
                set_field(column, _to_codes(getattr(self, column), texts, index, column))
        for name in ("t", "origin", "direction", "confidence", "hit", "head"):
            if (value := getattr(self, name)) is not None:
                what = f'"{name}" of rays'
                if name == "t":
                    set_field(name, to_seconds(value, what))
                else:
                    dtype = np.float32 if name == "head" else np.float64
                    set_field(name, to_numbers(value, what, dtype, flags=name == "confidence"))

        n = len(self.t)
        for name, value in self.columns().items():
            shape = (n, 3) if name in VECTORS else (n,)
            if value.shape != shape:
                raise ValueError(f"{name} has shape {value.shape}, expected {shape}: one row for each of {n} times")
        if "frame" not in self.metadata:
            raise ValueError(
                'metadata lacks "frame"; state units, up axis and handedness (see nerg_mi.tracking.rays.FRAME)'
            )

        # einsum avoids arrays of squares, which take a quarter of a gigabyte for ten million rays.
        length = np.sqrt(np.einsum("ij,ij->i", self.direction, self.direction))
        _refuse_rows(~np.isfinite(length), "a direction that is not finite", "drop it before building Rays")
        _refuse_rows(length == 0, "a zero direction", "drop it before building Rays")
        _refuse_rows(np.abs(length - 1) > 1e-4, "a direction that is not of unit length", "divide it by its length")
        is_out_of_range = np.asarray(~(np.abs(self.origin) <= MAX_COORDINATE).all(axis=1))
        _refuse_rows(
            is_out_of_range,
            f"an origin that is not finite or beyond {MAX_COORDINATE:g} m",
            "drop it before building Rays",
        )
        if self.hit is not None:
            is_too_far = np.asarray((np.abs(self.hit) > MAX_COORDINATE).any(axis=1))
            _refuse_rows(
                is_too_far, f"a hit point beyond {MAX_COORDINATE:g} m", "drop it, or make it NaN, which is unknown"
            )
        _refuse_rows(~np.isfinite(self.t), "a time that is not finite", "drop it before building Rays")
        # Validate before the conversion to 32 bits, in which large codes would wrap to valid ones.
        _refuse_rows(
            ~((self.person >= 0) & (self.person < len(self.persons))), "an unknown participant", "extend persons"
        )
        set_field("person", np.ascontiguousarray(self.person, dtype=np.int32))
        if self.cohort is not None:
            _refuse_rows(
                ~((self.cohort >= 0) & (self.cohort < len(self.cohorts))), "an unknown cohort", "extend cohorts"
            )
            set_field("cohort", np.ascontiguousarray(self.cohort, dtype=np.int32))
        if self.head is not None:
            length = np.sqrt(np.einsum("ij,ij->i", self.head, self.head))
            _refuse_rows(np.abs(length - 1) > 1e-4, "a head that is not of unit length", "divide it by its length")
        _refuse_rows(~((self.confidence >= 0) & (self.confidence <= 1)), "a confidence outside [0, 1]", "rescale it")

    def __len__(self) -> int:
        return len(self.t)

    def __getitem__(self, selection: Any) -> Rays:
        """Select rays by a boolean mask (N,), an array of indices, a slice or one index."""
        index = selection if isinstance(selection, slice) else np.atleast_1d(np.asarray(selection))
        if not isinstance(index, slice):
            if index.dtype.kind not in "biu" and index.size:
                raise NergError(f"rays are selected by a mask, indices or a slice, got {type(selection).__name__}")
            if index.dtype.kind == "b" and index.shape != (len(self),):
                raise NergError(f"the mask has the shape {index.shape}, expected {(len(self),)}: one value per ray")
            index = index if index.size else index.astype(np.int64)
        return self.select(index)

    @property
    def tracking(self) -> str:
        """What the directions are: ``eye`` (gaze), ``head``, ``mixed`` (some of both) or ``unknown``."""
        tracking = self.metadata.get("tracking", "unknown")
        # Selected rays may be of one kind.
        return merge_tracking(self.tracking_by_person.values()) if tracking == "mixed" and len(self) else tracking

    @property
    def tracking_by_person(self) -> dict[str, str]:
        """What the directions of each participant with rays are."""
        tracking = self.metadata.get("tracking", "unknown")
        kinds = self.metadata.get("tracking_by_person", {}) if tracking == "mixed" else {}
        return {name: kinds.get(name, tracking) for name in self.participants}

    @property
    def participants(self) -> tuple[str, ...]:
        """Names of the participants that have rays."""
        return _used_names(self.person, self.persons)

    def __repr__(self) -> str:
        return _import("in_memory").describe_rays(self)

    def _repr_html_(self) -> str | None:
        """The data-quality report, for notebooks."""
        return _import("quality").check_rays(self)._repr_html_() if len(self) else None

    @classmethod
    def from_arrays(
        cls,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        times: ArrayLike,
        participants: str | ArrayLike = "participant",
        hits: ArrayLike | None = None,
        heads: ArrayLike | None = None,
        confidence: ArrayLike | None = None,
        cohorts: str | ArrayLike | None = None,
        tracking: str | None = None,
        up: str = "z",
        handedness: str = "right",
        units: str = "m",
    ) -> Rays:
        """Make rays of arrays.

        Rows without a position, a direction, a time or a participant are dropped. The metadata contain their number by
        reason, which the data-quality report shows (``repr`` of `nerg_mi.check_rays`).

        Parameters
        ----------
        origins : array_like of shape (N, 3)
            Positions of the eye or of the head.
        directions : array_like of shape (N, 3)
            Directions of any length except zero.
        times : array_like of shape (N,)
            Times on any clock: numbers in seconds, durations, or dates, which become seconds since 1970 in UTC.
        participants : str or array_like of shape (N,)
            Name or number of the participant of each ray, or one name for all.
        hits : array_like of shape (N, 3), optional
            Points of regard on surfaces, NaN where they are unknown.
        heads : array_like of shape (N, 3), optional
            Directions of the head, NaN where they are unknown.
        confidence : array_like of shape (N,), optional
            Confidence from 0 to 1. Default: 1.
        cohorts : str or array_like of shape (N,), optional
            Name of the group of participants of each ray.
        tracking : str, optional
            What the directions are: ``eye`` (gaze) or ``head``, which has no fixations and is not exported as eye
            tracking. Default: ``eye`` with ``heads``, otherwise ``unknown``.
        up, handedness, units : str
            Frame of the arrays: the up axis (``x``, ``y``, ``z``, ``-x``, ``-y``, ``-z``), ``right`` or ``left``, and
            ``m``, ``cm`` or ``mm``. Unity has ``up="y", handedness="left"``.

        Returns
        -------
        Rays
            The rays, right-handed with z up, in metres and seconds.

        Raises
        ------
        NergError
            An array has another shape or contains no numbers (text, truth values, complex numbers), or no row gives a
            ray.

        Examples
        --------
        >>> import nerg_mi as nerg
        >>> rays = nerg.Rays.from_arrays([[1, 1, 1.6]] * 3, [[2, 0, 0], [0, 1, 0], [float("nan")] * 3], times=[0, 1, 2])
        >>> rays, rays.metadata["dropped"][0]["reason"]
        (<Rays: 2 of 1 participant, t 0 to 1 s>, 'direction is missing')
        """
        return _import("in_memory").from_arrays(
            origins,
            directions,
            times=times,
            participants=participants,
            hits=hits,
            heads=heads,
            confidence=confidence,
            cohorts=cohorts,
            tracking=tracking,
            frame=(up, handedness, units),
        )

    @classmethod
    def from_dataframe(
        cls,
        table: Any,
        columns: Mapping[str, str | Sequence[str]] | None = None,
        *,
        tracking: str | None = None,
        up: str = "z",
        handedness: str = "right",
        units: str = "m",
    ) -> Rays:
        """Make rays of a data frame of pandas, polars, Arrow or another library that narwhals supports.

        Parameters
        ----------
        table : data frame
            One row per sample. Times may be numbers in seconds, dates or durations.
        columns : mapping, optional
            Columns by role: ``time``, ``participant``, ``origin``, ``direction``, ``hit``, ``head``, ``confidence``,
            ``cohort`` and ``tracking``; positions and directions have three columns, or one whose cells are vectors.
            ``time``, ``origin`` and ``direction`` are required; without ``participant`` all rows are of one. A column
            with several levels is named by a tuple. Default: the columns of `to_dataframe`.
        tracking, up, handedness, units : str
            What the directions are, and their frame, as in `from_arrays`.

        Returns
        -------
        Rays
            The rays; rows are dropped as in `from_arrays`, and unused columns are listed in the data-quality report.

        Raises
        ------
        NergError
            A column does not exist or contains other values.

        Examples
        --------
        >>> import nerg_mi as nerg, pandas as pd
        >>> table = pd.DataFrame({"t": [0, 0.1], "who": "Ada", "x": 1, "y": 2, "z": 1.6, "u": [1, 0], "v": 1, "w": 0})
        >>> columns = {"time": "t", "participant": "who", "origin": ["x", "y", "z"], "direction": ["u", "v", "w"]}
        >>> nerg.Rays.from_dataframe(table, columns)
        <Rays: 2 of 1 participant, t 0 to 0.1 s>
        """
        return _import("in_memory").from_dataframe(table, columns, tracking, (up, handedness, units))

    @classmethod
    def concatenate(cls, rays: Iterable[Rays]) -> Rays:
        """Concatenate several sets of rays in this order.

        The metadata are merged: sources, dropped rows and counts are those of all, and other values are kept where they
        are equal. Rays without hit points or heads get NaN, and those without cohorts the cohort "unknown", if others
        have some. A participant who is in several sets is one participant, which a warning names.

        Parameters
        ----------
        rays : iterable of Rays
            The sets, in one frame.

        Returns
        -------
        Rays
            All rays.

        Raises
        ------
        NergError
            There are none, one is not `Rays`, or their frames or alignments to an environment differ.

        Examples
        --------
        >>> import nerg_mi as nerg
        >>> make = lambda name: nerg.Rays.from_arrays([[1, 1, 1.6]], [[1, 0, 0]], times=[0], participants=name)
        >>> nerg.Rays.concatenate([make("Ada"), make("Bob")])
        <Rays: 2 of 2 participants, t 0 to 0 s>
        """
        return _import("in_memory").concatenate(rays)

    def to_dataframe(self, library: str | None = None) -> Any:
        """Return a data frame with one row per ray.

        Parameters
        ----------
        library : str, optional
            ``pandas``, ``polars`` or ``pyarrow``. Default: the first of these that is installed.

        Returns
        -------
        data frame
            Columns ``time`` (s), ``participant``, ``origin_x`` to ``origin_z`` (m), ``direction_x`` to ``direction_z``,
            ``confidence``, and if the rays have them ``hit_x`` to ``hit_z``, ``cohort``, ``head_x`` to ``head_z``, and
            ``tracking``.

        Raises
        ------
        NergError
            The library is unknown or not installed.

        Examples
        --------
        >>> import nerg_mi as nerg
        >>> rays = nerg.Rays.from_arrays([[1, 1, 1.6]] * 2, [[1, 0, 0], [0, 1, 0]], times=[0, 1])
        >>> list(rays.to_dataframe()["direction_y"])
        [0.0, 1.0]
        """
        return _import("in_memory").to_dataframe(self, library)

    def columns(self) -> dict[str, np.ndarray]:
        """Arrays with one row per ray, by name, without absent ones."""
        return {name: column for name in COLUMNS if (column := getattr(self, name)) is not None}

    def select(self, selection: np.ndarray | slice) -> Rays:
        """Select rays by a boolean mask (N,) or an index array. Keeps persons and metadata, so that codes and
        provenance remain comparable."""
        return replace(self, **{name: column[selection] for name, column in self.columns().items()})

    def filter_in_place(self, mask: np.ndarray) -> Rays:
        """Select rays by a boolean mask (N,), moving them within the arrays of this object, which must not be used
        afterwards. Avoids a second copy of millions of rays."""
        selected = np.flatnonzero(mask)
        columns = {}
        for name, column in self.columns().items():
            for a in range(0, len(selected), _BLOCK):
                # The rows read are at or behind those written.
                rows = selected[a : a + _BLOCK]
                column[a : a + len(rows)] = column[rows]
            columns[name] = column[: len(selected)]
        return replace(self, **columns)

    def with_step(self, **entry: Any) -> Rays:
        """Add an entry to ``steps`` of the metadata, the processing since the import; returns a new object."""
        return replace(self, metadata={**self.metadata, "steps": [*self.metadata.get("steps", []), entry]})

    def with_tracking(self, tracking: str) -> Rays:
        """Return the same rays, whose directions are gaze (``eye``) or directions of heads (``head``): for files of
        earlier versions. Raises `NergError` for another value.

        >>> import nerg_mi as nerg
        >>> rays = nerg.Rays.from_arrays([[1, 1, 1.6]], [[1, 0, 0]], times=[0])
        >>> rays.tracking, rays.with_tracking("head").tracking
        ('unknown', 'head')
        """
        metadata = {k: v for k, v in self.metadata.items() if k != "tracking_by_person"}
        return replace(self, metadata={**metadata, "tracking": check_tracking(tracking)})

    def save(self, path: str | os.PathLike) -> None:
        """Write ``.npz`` or ``.parquet``; see :mod:`nerg_mi.tracking.rays`."""
        cohorts = {"cohorts": list(self.cohorts)} if self.cohort is not None else {}
        write_rays_file(path, self.columns(), {**self.metadata, "persons": list(self.persons), **cohorts})

    @classmethod
    def load(cls, path: str | os.PathLike, max_rays: int | None = None, seed: int = 0) -> Rays:
        """Load recorded gaze samples.

        Parameters
        ----------
        path : path
            A file (.npz or .parquet) written by ``nerg rays import``, `import_rays` or `save`, a dataset (.rays), or a
            partition of one (``shop.rays/place=north``).
        max_rays : int, optional
            Maximum number of samples of a dataset; larger datasets are sampled uniformly. Default: all, at most 50
            million.
        seed : int
            Seed of that sample.

        Returns
        -------
        Rays
            The samples, right-handed with z up, in metres and seconds.

        Raises
        ------
        NergError
            The file does not exist or is damaged.

        Examples
        --------
        >>> import nerg_mi as nerg
        >>> rays = nerg.Rays(t=[0, 0.1], person=[0, 0], persons=("Ada",), origin=[[1, 1, 1.6]] * 2,
        ...                  direction=[[1, 0, 0], [0, 1, 0]], confidence=[1, 1])
        >>> rays.save(folder / "rays.npz")
        >>> len(nerg.Rays.load(folder / "rays.npz"))
        2
        """
        if os.path.isdir(path):
            return _import("dataset").open_rays(path, max_rays, seed)
        columns, metadata = read_rays_file(path)
        persons, cohorts = metadata.pop("persons"), metadata.pop("cohorts", ())
        try:
            return cls(**columns, persons=persons, metadata=metadata, cohorts=cohorts)
        except NergError as error:
            reason = str(error).split(";")[0]
            raise NergError(
                f"\"{path}\" is damaged ({reason}); copy it again, or create it again with 'nerg rays import'"
            ) from error


def _import(name: str) -> Any:
    """Import a module of this package that builds on this one, and is therefore only imported when it is used."""
    return import_module(f"nerg_mi.tracking.{name}")


def _to_codes(values: ArrayLike, names: tuple[str, ...], index: np.ndarray | None, what: str) -> np.ndarray:
    """Convert ``values`` (N,), which are codes or names among ``names``, to codes; ``index`` are the new codes, if some
    names were unified."""
    array = np.asarray(values)
    if any(isinstance(value, str) for value in array.ravel()[:1].tolist()):
        numbers = {name: number for number, name in enumerate(names)}
        texts = to_names(array, what).ravel().tolist()
        unknown = next((text for text in texts if text not in numbers), None)
        if unknown is not None:
            raise NergError(f"{unknown!r} is a {what} of the rays but not in {what}s; list all names in {what}s=(...)")
        return np.array([numbers[text] for text in texts], np.int32).reshape(array.shape)
    if array.dtype.kind not in "iu":
        codes = to_numbers(values, f'"{what}" of rays')
        _refuse_rows(codes != np.floor(codes), f"a {what} that is no index into {what}s", "use whole numbers, or names")
        array = codes
    if index is None:
        return array
    _refuse_rows(~((array >= 0) & (array < len(index))), f"an unknown {what}", f"extend {what}s")
    return index[array.astype(np.int64)]


def _refuse_rows(bad: np.ndarray | np.bool_, what: str, remedy: str) -> None:
    rows = np.flatnonzero(bad)
    if rows.size:
        listed = ", ".join(map(str, rows[:5])) + (", ..." if rows.size > 5 else "")
        raise NergError(f"{rows.size} of {bad.size} rays have {what} (rays {listed}); {remedy}")


# ---- Spatial index of ray origins ----

_INDEX_BLOCK = 1 << 21  # neighbours held at a time, to bound memory


class Neighbours(NamedTuple):
    """Rays near each of Q points, concatenated."""

    indices: np.ndarray  # (n,) of rays; nearest first within each point
    distances: np.ndarray  # (n,) metres
    offsets: np.ndarray  # (Q + 1,): point q has indices[offsets[q]:offsets[q + 1]]


class RayIndex:
    """A k-d tree of ray origins: those of a set of rays, or an array (N, 3) in metres."""

    def __init__(self, rays: Rays | np.ndarray) -> None:
        from scipy.spatial import KDTree

        origin = rays.origin if isinstance(rays, Rays) else np.asarray(rays, dtype=np.float64)
        self.count = len(origin)
        # An unbalanced tree is built in half the time and queried as fast. Do not change the leaf size: it determines
        # the order of equally distant rays, and so the last bits of all results.
        self._tree = KDTree(origin, leafsize=16, balanced_tree=False)

    def query(self, points: np.ndarray, max_count: int, radius: float = np.inf) -> Neighbours:
        """Find the ``max_count`` nearest rays of each of ``points`` (Q, 3), within ``radius`` metres (inclusive)."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        if max_count < 1 or not radius > 0:
            raise ValueError(f"max_count {max_count}, radius {radius}: both must be positive")
        max_count = min(max_count, self.count)
        # SciPy excludes points at the bound itself.
        bound = np.nextafter(radius, np.inf) if np.isfinite(radius) else np.inf
        step = max(1, _INDEX_BLOCK // max_count)
        indices, distances, counts = [], [], []
        for start in range(0, len(points), step):
            part = points[start : start + step]
            answer = self._tree.query(part, k=max_count, distance_upper_bound=bound, workers=-1)
            d, i = (np.asarray(v).reshape(len(part), max_count) for v in answer)
            is_found = np.isfinite(d)
            indices.append(i[is_found])
            distances.append(d[is_found])
            counts.append(is_found.sum(axis=1))
        offsets = np.concatenate([[0], np.cumsum(np.concatenate(counts))]) if counts else np.zeros(1, np.int64)
        concatenate = lambda parts, kind: np.concatenate(parts) if parts else np.empty(0, kind)
        return Neighbours(concatenate(indices, np.int64), concatenate(distances, np.float64), offsets.astype(np.int64))


# ---- Merging rays ----

_EMPTY = np.zeros((0, 3))


def merge_rays(blocks: Iterable[Rays], metadata: dict[str, Any] | None = None) -> Rays:
    """Concatenate ``blocks`` in this order, with the sorted persons and cohorts that occur.

    Blocks without hit points or heads get NaN, and blocks without cohorts the cohort "unknown", if others have some.
    """
    compacted = list(map(_compact, blocks))
    parts = [(block.columns(), block.persons, block.cohorts, len(block)) for block in compacted]
    metadata = {"frame": dict(FRAME)} if metadata is None else metadata
    if any(map(len, compacted)):
        # More precise than that of all sources, of which some may not be selected.
        tracking = merge_tracking(block.tracking for block in compacted if len(block))
        metadata = metadata if tracking == "unknown" else {**metadata, "tracking": tracking}
        if tracking == "mixed":
            kinds = [entry for block in compacted for entry in block.tracking_by_person.items()]
            by_person = {name: merge_tracking(kind for other, kind in kinds if other == name) for name, _ in kinds}
            metadata = {**metadata, "tracking_by_person": by_person}
    del compacted  # so that a column is freed once it is joined
    if not parts:
        no_values = _EMPTY[:, 0]
        return Rays(no_values, np.zeros(0, np.int32), (), _EMPTY, _EMPTY, no_values, metadata=metadata)
    persons = tuple(sorted({name for _, names, _, _ in parts for name in names}))
    has_cohorts = any("cohort" in columns for columns, *_ in parts)
    filler = {"unknown"} if any("cohort" not in columns for columns, *_ in parts) else set()
    cohorts = tuple(sorted({name for _, _, names, _ in parts for name in names} | filler)) if has_cohorts else ()
    person_codes, cohort_codes = ({name: k for k, name in enumerate(names)} for names in (persons, cohorts))
    for columns, person_names, cohort_names, n in parts:
        columns["person"] = _renumber(columns["person"], person_names, person_codes)
        if has_cohorts:
            codes, cohort_names = (
                (columns["cohort"], cohort_names) if "cohort" in columns else (np.zeros(n, np.int32), ("unknown",))
            )
            columns["cohort"] = _renumber(codes, cohort_names, cohort_codes)
        for name, kind in (("hit", np.float64), ("head", np.float32)):
            if name not in columns and any(name in other for other, *_ in parts):
                columns[name] = np.full((n, 3), np.nan, kind)
    # Column by column, so that at most one column exists twice.
    joined = {
        name: np.concatenate([columns.pop(name) for columns, *_ in parts]) for name in COLUMNS if name in parts[0][0]
    }
    return Rays(**joined, persons=persons, cohorts=cohorts, metadata=metadata)


_MERGED_KEYS = (
    "tracking",
    "tracking_by_person",
    "sources",
    "dropped",
    "rows_read",
    "complaints",
    "eye_distance",
    "missing",
    "unused_columns",
)


def merge_metadata(documents: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Merge metadata: values that are equal in all documents, and the dropped rows, sources and counts of all."""
    first = documents[0] if documents else {"frame": dict(FRAME)}
    same = {k: v for k, v in first.items() if k not in _MERGED_KEYS and all(other.get(k) == v for other in documents)}
    join_lists = lambda key: [entry for other in documents for entry in other.get(key, [])]
    combined = {
        "missing": merge_counts(other.get("missing", {}) for other in documents),
        "unused_columns": list(dict.fromkeys(join_lists("unused_columns"))),
        "complaints": list(dict.fromkeys(join_lists("complaints"))),
        "eye_distance": {name: metres for other in documents for name, metres in other.get("eye_distance", {}).items()},
    }
    return {
        **same,
        **{key: value for key, value in combined.items() if value},
        "frame": first["frame"],
        "tracking": merge_tracking(other.get("tracking", "unknown") for other in documents),
        "sources": join_lists("sources"),
        "rows_read": sum(other.get("rows_read", 0) for other in documents),
        "dropped": join_lists("dropped"),
    }


def merge_counts(counts: Iterable[dict[str, int]]) -> dict[str, int]:
    """Sums by name, sorted by name."""
    total: Counter[str] = Counter()
    for entry in counts:
        total.update(entry)
    return dict(sorted(total.items()))


def _compact(rays: Rays) -> Rays:
    """The same rays without names of participants and cohorts that have no rays."""
    persons, cohorts = _used_names(rays.person, rays.persons), _used_names(rays.cohort, rays.cohorts)
    if persons == rays.persons and cohorts == rays.cohorts:
        return rays
    cohort = None if rays.cohort is None else _compact_codes(rays.cohort)
    return replace(rays, person=_compact_codes(rays.person), persons=persons, cohort=cohort, cohorts=cohorts)


def _used_names(codes: np.ndarray | None, names: tuple[str, ...]) -> tuple[str, ...]:
    return () if codes is None else tuple(names[k] for k in np.flatnonzero(np.bincount(codes)).tolist())


def _compact_codes(codes: np.ndarray) -> np.ndarray:
    """Codes (N,) into the list of those that occur."""
    return (np.cumsum(np.bincount(codes) > 0) - 1)[codes]


def _renumber(codes: np.ndarray, names: Sequence[str], new_codes: dict[str, int]) -> np.ndarray:
    return np.array([new_codes[name] for name in names], np.int32)[codes]


# ---- Sampling of rows, without memory for all row numbers ----


def sample_rows(count: int, n: int, seed: int = 0, runs: int | None = None) -> np.ndarray:
    """Sample ``n`` of the numbers 0 to ``count`` - 1 without replacement, sorted, (n,) int64; all if ``n`` is larger.

    Each number has the same probability. Without ``runs``, so has each set of ``n`` numbers; with it the sample
    consists of that many runs of neighbours, which are faster to read but correlated.
    """
    rng = np.random.default_rng(seed)
    if n >= count:
        return np.arange(count)
    if runs is not None and runs < n:
        length = n // runs
        # Cells of equal length on a circle with a random offset.
        cells = _draw_distinct(count // length, runs, rng)
        start = (rng.integers(count) + cells * length) % count
        return np.sort((start[:, None] + np.arange(length)).ravel() % count)
    if n > count // 2:
        keep = np.ones(count, bool)
        keep[_draw_distinct(count, count - n, rng)] = False
        return np.flatnonzero(keep)
    return _draw_distinct(count, n, rng)


def _draw_distinct(count: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draw ``n`` different numbers below ``count``, sorted: draws until there are enough, then removes the excess at
    random."""
    drawn = np.zeros(0, np.int64)
    while len(drawn) < n:
        # Sorting is several times as fast as numpy.unique, which uses a hash table.
        drawn = np.sort(np.concatenate([drawn, rng.integers(0, count, n - len(drawn) + 16)]))
        drawn = drawn[np.r_[True, drawn[1:] != drawn[:-1]]]
    return np.delete(drawn, rng.choice(len(drawn), len(drawn) - n, replace=False))
