"""Files that parse but contradict themselves, and paths to things that are not regular files.

`mutations` damages bytes and structure. These changes preserve the structure and change the meaning: wrong counts,
swapped axes, other units, repeated names, mirrored poses. They are drawn with NumPy and share no code with the other
generator.
"""

from __future__ import annotations

import gzip
import io
import json
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz.watch import SPECIAL, Case, Reader

SPECIAL_FRACTION = 0.06
_FACTORS = (0, -1, 1e-30, 1e-3, 0.01, 100, 1000, 1e6, 1e30, 1e38, 1e300)
_COUNTS: tuple[Callable[[int], int], ...] = (
    lambda n: 0,
    lambda n: -1,
    lambda n: n + 1,
    lambda n: n - 1,
    lambda n: 2 * n,
    lambda n: 2**31 - 1,
    lambda n: 10**12,
)
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")

Rng = np.random.Generator


def draw_cases(readers: list[Reader], inputs: Path, count: int, start: int = 0) -> Iterator[Case]:
    """Draw ``count`` cases, equally many for each target of ``readers``; ``start`` selects other cases."""
    targets = [(reader, target) for reader in readers for target in reader.targets]
    for k, (reader, target) in enumerate(targets):
        data = (inputs / reader.name / target).read_bytes()
        rng = np.random.default_rng([start, zlib.crc32(f"{reader.name} {target}".encode())])
        for _ in range(count * (k + 1) // len(targets) - count * k // len(targets)):
            if rng.random() < SPECIAL_FRACTION:
                special = str(rng.choice(SPECIAL))
                yield Case(reader.name, target, data if special == "sparse" and rng.random() < 0.5 else b"", special)
            else:
                yield Case(reader.name, target, change(data, rng))


def change(data: bytes, rng: Rng) -> bytes:
    """Apply one change of meaning to ``data``, depending on the format that its first bytes show."""
    if data[:2] == b"\x1f\x8b":
        return gzip.compress(change(gzip.decompress(data), rng), 1, mtime=0)
    if data[:2] == b"PK":
        return _change_archive(data, rng)
    if data[:6] == b"\x93NUMPY":
        return _change_npy(data, rng)
    if data[:4] == b"ply\n":
        return _change_ply(data, rng)
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        return _change_words(data, rng)
    try:
        return json.dumps(_change_json(json.loads(text), rng)).encode()
    except ValueError:
        pass
    if "\0" in text:
        return _change_words(data, rng)
    return (_change_numbers(text, rng) if text.lstrip().startswith("<") else _change_table(text, rng)).encode()


def _pick(rng: Rng, items: Any) -> Any:
    return items[int(rng.integers(len(items)))]


# --- numbers and arrays ---------------------------------------------------------------------------------------------


def _change_array(values: np.ndarray, rng: Rng) -> np.ndarray:
    """Change an array of numbers: scaled, swapped, mirrored, constant, truncated, or partly missing."""
    values = np.array(values)
    changes = ["cut", "repeat", "constant", "reverse"]
    changes += ["axes", "transpose"] if values.ndim > 1 and values.shape[-1] > 1 else []
    changes += {"f": ["scale", "missing", "mirror"], "i": ["count"], "u": ["count"]}.get(values.dtype.kind, [])
    change = _pick(rng, changes)
    with np.errstate(over="ignore", invalid="ignore"):
        match change:
            case "cut":
                return values[: len(values) // 2] if values.ndim else values
            case "repeat":
                return np.concatenate([values, values]) if values.ndim else values
            case "constant":
                return np.full_like(values, values.ravel()[0]) if values.size else values
            case "reverse":
                return values[::-1] if values.ndim else values
            case "axes":
                return np.roll(values, 1, axis=-1)
            case "transpose":
                return np.swapaxes(values, 0, -1)
            case "scale":
                return (values * _pick(rng, _FACTORS)).astype(values.dtype)
            case "missing":
                return np.where(rng.random(values.shape) < 0.5, np.nan, values).astype(values.dtype)
            case "mirror":
                signs = np.ones(values.shape[-1:] or (1,))
                signs[0] = -1
                return (values * signs).astype(values.dtype).reshape(values.shape)
            case _:
                return (values * _pick(rng, (0, 2, 100))).astype(values.dtype)


def _change_number(value: float, rng: Rng) -> float:
    if isinstance(value, int) and rng.random() < 0.7:
        return _pick(rng, _COUNTS)(value)
    return value * _pick(rng, _FACTORS)


def _change_npy(data: bytes, rng: Rng) -> bytes:
    out = io.BytesIO()
    np.save(out, _change_array(np.load(io.BytesIO(data), allow_pickle=False), rng))
    return out.getvalue()


def _change_archive(data: bytes, rng: Rng) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    a, b = (_pick(rng, sorted(members)) for _ in range(2))
    if a != b and rng.random() < 0.3:
        members[a], members[b] = members[b], members[a]
    else:
        members[a] = change(members[a], rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    return out.getvalue()


def _change_words(data: bytes, rng: Rng) -> bytes:
    """Change a number of a binary file at a position with a plausible count or length."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        kind = np.dtype(_pick(rng, ("<i4", "<u8", "<f4", "<f8")))
        places = len(out) // 4 - kind.itemsize // 4
        if places < 1:
            break
        for at in 4 * rng.integers(0, places, 50):
            value = np.frombuffer(bytes(out[at : at + kind.itemsize]), kind)[0]
            if kind.kind == "f" and 1e-6 < abs(value) < 1e6:
                with np.errstate(over="ignore"):
                    other = kind.type(_pick(rng, (-value, value * 1000, value * 1e30, np.nan)))
            elif kind.kind != "f" and 0 < value < 10**6:
                other = kind.type(_pick(rng, _COUNTS)(int(value)) % 2 ** (8 * kind.itemsize - 1))
            else:
                continue
            out[at : at + kind.itemsize] = np.array(other, kind).tobytes()
            break
    return bytes(out)


# --- documents ------------------------------------------------------------------------------------------------------


def _change_json(value: Any, rng: Rng) -> Any:
    """Change one of the arrays, numbers, names or texts of ``value``, or exchange two of its entries."""
    if isinstance(value, dict) and value:
        names = sorted(value)
        a, b = _pick(rng, names), _pick(rng, names)
        draw = rng.random()
        if draw < 0.08 and a != b:
            return value | {a: value[b], b: value[a]}
        if draw < 0.12:
            return {k: v for k, v in value.items() if k != a}
        if draw < 0.16:
            return value | {a + "_2": value[a], "schema_version": 99}
        return value | {a: _change_json(value[a], rng)}
    if isinstance(value, list) and value:
        try:
            numbers = np.array(value, float)
        except (ValueError, TypeError):
            numbers = None
        if numbers is not None and rng.random() < 0.8:
            return _change_array(numbers, rng).tolist()
        draw = rng.random()
        if draw < 0.15:
            return value + value
        if draw < 0.3:
            return value[: len(value) // 2]
        k = int(rng.integers(len(value)))
        return [*value[:k], _change_json(value[k], rng), *value[k + 1 :]]
    if isinstance(value, bool) or value is None:
        return _pick(rng, (True, False, None))
    if isinstance(value, (int, float)):
        return _change_number(value, rng)
    return _pick(
        rng, (str(value).upper(), str(value).replace("/", "\\"), str(value) + " ", ".", "/dev/zero", "missing")
    )


def _change_numbers(text: str, rng: Rng) -> str:
    """Change one or two numbers of a text, or exchange two."""
    spots = [match.span() for match in _NUMBER.finditer(text)]
    if not spots:
        return text
    for _ in range(int(rng.integers(1, 3))):
        spots = [match.span() for match in _NUMBER.finditer(text)]
        (a, b), (c, d) = sorted((_pick(rng, spots), _pick(rng, spots)))
        if b <= c and rng.random() < 0.3:
            text = text[:a] + text[c:d] + text[b:c] + text[a:b] + text[d:]
        else:
            number = text[a:b]
            value = int(number) if re.fullmatch(r"[-+]?\d+", number) else float(number)
            text = f"{text[:a]}{_change_number(value, rng)}{text[b:]}"
    return text


def _change_ply(data: bytes, rng: Rng) -> bytes:
    """Change counts, types, names and order in the header, or the numbers after it."""
    head, mark, body = data.partition(b"end_header\n")
    if rng.random() < 0.4:
        changed = _change_table(body.decode(), rng).encode() if b"format ascii" in head else _change_words(body, rng)
        return head + mark + changed
    lines = head.decode("latin1").splitlines()
    k = int(rng.integers(1, len(lines)))
    words = lines[k].split()
    properties = [i for i, line in enumerate(lines) if line.startswith("property") and " list " not in line]
    match words[0]:
        case "element":
            lines[k] = " ".join([*words[:2], str(_pick(rng, _COUNTS)(int(words[2])))])
        case "property" if rng.random() < 0.5 and properties:
            other = _pick(rng, properties)
            lines[k], lines[other] = lines[other], lines[k]
        case "property" if rng.random() < 0.5:
            lines[k] = lines[k].replace("float", "double") if "float" in lines[k] else lines[k].replace("int", "float")
        case "property":
            lines[k] = " ".join([*words[:-1], _pick(rng, ("x", "alpha", "confidence", words[-1] + "_0"))])
        case _:
            lines.insert(k, "comment a note")
    return "\n".join(lines).encode("latin1") + b"\n" + mark + body


# --- tables ---------------------------------------------------------------------------------------------------------


def _change_table(text: str, rng: Rng) -> str:
    """Change columns, rows, names, units or separators of a text table."""
    lines = text.splitlines()
    counts = {mark: sum(line.count(mark) for line in lines[:20]) for mark in ",;\t "}
    mark = max(counts, key=counts.__getitem__)
    rows = [line.split(mark) for line in lines]
    width = max(map(len, rows), default=0)
    if not counts[mark] or len(rows) < 2:
        return _change_numbers(text, rng)
    wide = [row for row in rows if len(row) == width]
    head, a, b = wide[0], int(rng.integers(width)), int(rng.integers(width))
    body = wide[1:]
    match int(rng.integers(18)):
        case 0:
            head[a], head[b] = head[b], head[a]
        case 1:
            head[a] = head[b]
        case 2:
            head[a] = _pick(rng, ("id", "valid", "time", "x", "", "unnamed: 0"))
        case 3:
            for row in wide:
                row[a : a + 1] = []
        case 4:
            for row in wide:
                row.append(row[a])
        case 5 | 6:
            factor = _pick(rng, _FACTORS)
            for row in body:
                row[a] = str(float(row[a]) * factor) if _NUMBER.fullmatch(row[a]) else row[a]
        case 7:
            value = _pick(rng, ("", "0", "-1", "nan", "NA", "9999", "1;2"))
            for row in body:
                row[a] = value
        case 8:
            for row in body[:: int(rng.integers(2, 5))]:
                row[a] = _pick(rng, ("", "0", "nan", "-", "1e400"))
        case 9:
            rows = [*rows[:1], *(rows[1 + k] for k in rng.permutation(len(rows) - 1))]
        case 10:
            rows = rows[: int(rng.integers(1, 3))]
        case 11:
            rows = [*rows, *rows]
        case 12:
            for row in rows[1:]:
                row[:] = [cell.replace(".", ",") for cell in row]
        case 13:
            mark = _pick(rng, (";", "\t", "|", ", "))
        case 14:
            rows[int(rng.integers(len(rows)))].append("7")
        case 15:
            rows = [cells for row in rows for cells in (row, [""])]
        case 16:
            for k, row in enumerate(body):
                row[a] = str(k)
        case _:
            return _pick(rng, ("\ufeff" + text, text.replace("\n", "\r\n"), text.rstrip("\n") + mark, text.upper()))
    return "\n".join(mark.join(row) for row in rows) + "\n"
