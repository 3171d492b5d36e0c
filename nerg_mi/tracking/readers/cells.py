"""Cells of tables: spellings of missing values, and vectors in one cell."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

# ---- Missing values ----

MISSING_WORDS = frozenset(
    (
        *("", "nan", "+nan", "-nan", "nan(ind)", "-nan(ind)", "na", "n/a", "n.a.", "<na>", "nat", "nil", "null"),
        *("(null)", "none", "undefined", "missing", "-", "--", "---", ".", "..", "?", "n. def.", "∞", "+∞", "-∞"),
        *("\N{EN DASH}", "\N{EM DASH}", "#n/a", "#na", "#nv", "#n/d", "#n/b", "#i/t"),
    )
)
"""Cells without a value, in lower case: those of statistics programs, spreadsheets, .NET and Python."""

# Errors of spreadsheets in any language, such as #NUM!, #WERT!, #¡VALOR! and #NOM?, and cells that were too narrow.
_SPREADSHEET = re.compile(r"#[¡¿]?[^\W\d_]+(?:/0)?[!?]|#{2,}")

# Microsoft's C library: 1.#QNAN, -1.#IND00, 1.#INF, also with a decimal comma, and J where it is rounded.
_MICROSOFT = re.compile(r"[+-]?1[.,]#(qnan|snan|nan|ind|inf|j)\d*", re.IGNORECASE)


def is_missing(cell: str) -> bool:
    """Whether a cell has no value: it is empty, or one of the usual words for missing, undefined or infinite."""
    cell = cell.strip().lower()
    return cell in MISSING_WORDS or bool(_SPREADSHEET.fullmatch(cell) or _MICROSOFT.fullmatch(cell))


# ---- Vectors in one cell ----
#
# Programs write (1.0, 2.0, 3.0) (Unity), X=1.0 Y=2.0 Z=3.0 (Unreal), [1. 2. 3.] (NumPy) or {"x": 1, ...} (JSON). The
# components of such a column are called as the column with .x, .y, .z and .w.

AXES = "xyzw"
_MAX_LENGTH = 200  # characters of a vector
_NUMBER = r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?"
_BRACKETS = re.compile(r"\s*[A-Za-z_]*\d?\s*(?:\((.*)\)|\[(.*)\]|\{(.*)\}|<(.*)>)\s*", re.DOTALL)
_LABEL = re.compile(r"[\"']?\b([xyzwXYZW])[\"']?\s*[:=]\s*([^\s,;:=]+(?:,\d+)?)[,;\s]*")
# A group in brackets that fills a cell: from a separator to the next.
_GROUP = r"(^|{0}) *((?:[A-Za-z_]\w*)?(?:\([^()\"]*\)|\[[^\[\]\"]*\]|\{{[^{{}}]*\}})) *(?={0}|\r|\n|$)"


def parse_vector(cell: str) -> list[float] | None:
    """The two to four numbers of a cell, NaN for missing ones; None if it is not a vector. Without brackets or names
    of axes, at least three numbers."""
    if len(cell) > _MAX_LENGTH:
        return None
    match = _BRACKETS.fullmatch(cell)
    inner = next((group for group in match.groups() if group is not None), "") if match else cell.strip()
    labels = _LABEL.findall(inner)
    if labels and not _LABEL.sub("", inner).strip():
        words = {axis.lower(): word for axis, word in labels}
        tokens = [words[axis] for axis in AXES if axis in words]
        if len(tokens) != len(labels) or set(words) != set(AXES[: len(words)]):
            return None
    else:
        tokens = _split_numbers(inner)
    if not (2 if match or labels else 3) <= len(tokens) <= 4:
        return None
    numbers = [_parse_number(token) for token in tokens]
    return None if None in numbers else [number for number in numbers if number is not None]


def _split_numbers(text: str) -> list[str]:
    """Split at semicolons, bars, commas or spaces; commas within all of the parts are decimal commas."""
    if ";" in text or "|" in text:
        return re.split(r"[;|]", text)
    parts = re.split(r",\s+", text.strip())
    if len(parts) > 1 and all(part.count(",") == 1 for part in parts):
        return parts
    parts = text.split(",")
    return parts if all(_parse_number(part) is not None for part in parts) else text.split()


def _parse_number(word: str) -> float | None:
    word = word.strip().strip("\"'")
    if is_missing(word):
        return np.nan
    return float(word.replace(",", ".")) if re.fullmatch(_NUMBER, word) else None


def parse_vectors(cells: Sequence[str], size: int) -> tuple[np.ndarray, np.ndarray]:
    """Vectors (n, size) of ``cells``, NaN for missing ones, and which cells are not vectors of this size, (n,) bool."""
    out, is_bad = np.full((len(cells), size), np.nan), np.zeros(len(cells), bool)
    is_plain = lambda cell: cell[:1] == "(" and cell[-1:] == ")" and cell.count(",") == size - 1 and "_" not in cell
    if all(map(is_plain, cells)):
        try:
            return np.array(",".join(cell[1:-1] for cell in cells).split(","), np.float64).reshape(-1, size), is_bad
        except ValueError:
            pass  # Words for missing values, or an invalid cell: convert one by one.
    for k, cell in enumerate(cells):
        if not is_missing(cell):
            vector = parse_vector(cell)
            is_bad[k] = vector is None or len(vector) != size
            if not is_bad[k]:
                out[k] = vector
    return out, is_bad


def count_components(cells: Sequence[str]) -> int:
    """Number of components if all ``cells`` that are not missing are vectors of one size; otherwise 0."""
    sizes = {len(parse_vector(cell) or ()) for cell in cells if not is_missing(cell)}
    return sizes.pop() if len(sizes) == 1 else 0


def quote_vectors(line: str, separator: str) -> str:
    """Quote the groups in brackets that fill a cell of a line, so that their separators do not split them."""
    quote = lambda match: match[1] + '"' + match[2].replace('"', '""') + '"'
    return re.sub(_GROUP.format(re.escape(separator)), quote, line)
