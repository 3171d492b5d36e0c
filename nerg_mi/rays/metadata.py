"""The JSON document of a rays file: what of it the rest of the package relies on is checked here, once."""

from __future__ import annotations

import math
import os
from typing import Any

from nerg_mi.errors import NergError
from nerg_mi.files.bounded import is_count, parse_json

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
