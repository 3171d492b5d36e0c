"""What `nerg eval gaze` has written, read again: the file ``gaze.json`` of its folder."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerg_mi.errors import NergError, plain
from nerg_mi.files.bounded import is_count, read_json

MOST = 4 << 20
"""So many bytes of such a file are read at most."""

_ROWS = 20_000
_WORD = 200


@dataclass(frozen=True)
class GazeResults:
    """``gaze``: name of the scored checkpoint, and its ``sha256`` ("" where it is not known); ``split``;
    ``positions`` and ``people`` of the test; ``rows``: a row a method, the field's first; ``persons``: a row a method
    and person; ``kappa``: of the truth's kernel."""

    gaze: str
    sha256: str
    split: str
    positions: int
    people: int
    kappa: float
    rows: tuple[dict[str, Any], ...]
    persons: tuple[dict[str, Any], ...]


def read_results(path: str | Path) -> GazeResults:
    """The results in ``path``. Raises `NergError` for a file that holds none."""
    found = read_json(path, "evaluation", MOST)
    if not isinstance(found, dict):
        raise _damaged(path, "it is no JSON object")
    missing = [k for k in ("gaze", "split", "positions", "methods") if k not in found]
    if missing:
        raise _damaged(path, f'it lacks "{missing[0]}"')
    rows, persons = _rows(found["methods"], path, "methods"), _rows(found.get("persons", []), path, "persons")
    if not rows or not is_count(found["positions"]):
        raise _damaged(path, 'its "methods" or "positions" are none')
    people = found.get("people", len({r.get("person") for r in persons}))
    kappa = found.get("kappa", math.nan)
    words = [found["gaze"], found["split"], found.get("gaze_sha256", "")]
    if not is_count(people) or not _is_number(kappa) or not all(isinstance(w, str) and len(w) <= _WORD for w in words):
        raise _damaged(path, "something in it is no number or no name")
    return GazeResults(words[0], words[2], words[1], found["positions"], people, float(kappa), rows, persons)


def _rows(given: object, path: str | Path, name: str) -> tuple[dict[str, Any], ...]:
    """Rows of names, numbers and missing numbers, each with the name of a method."""
    if not isinstance(given, list) or len(given) > _ROWS:
        raise _damaged(path, f'its "{name}" are no list of at most {_ROWS:,} rows')
    for row in given:
        if not isinstance(row, dict) or not isinstance(row.get("method"), str):
            raise _damaged(path, f'a row of its "{name}" names no method')
        for key, value in row.items():
            text = key in ("method", "person")
            if not (isinstance(value, str) and len(value) <= _WORD if text else value is None or _is_number(value)):
                raise _damaged(path, f'"{plain(key, 40)}" of a row of its "{name}" is {plain(value, 40)}')
    return tuple(given)


def _is_number(value: object) -> bool:
    return (
        isinstance(value, (int, float)) and not isinstance(value, bool) and -1e300 < value < 1e300
    ) or value != value


def _damaged(path: str | Path, why: str) -> NergError:
    return NergError(f'"{path}" is no evaluation of a gaze field ({why}); make one with "nerg eval gaze"')
