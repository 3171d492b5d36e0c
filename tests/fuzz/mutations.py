"""Damage to files, drawn by hypothesis: to their bytes, and to their structure."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator

from hypothesis import strategies as st

EXTREMES = (
    0,
    1,
    -1,
    2,
    127,
    255,
    256,
    32767,
    65535,
    65536,
    10**6,
    10**9,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**60,
    2**63 - 1,
    2**64 - 1,
)
_VALUES = (
    None,
    True,
    False,
    0,
    -1,
    1,
    0.5,
    1e-300,
    1e308,
    float("nan"),
    float("inf"),
    2**31,
    10**9,
    2**60,
    10**40,
    "",
    "a",
    "\0",
    "../../../etc/passwd",
    "x" * 300,
    [],
    {},
    [[]],
    [1, 2, 3],
    [[1e308] * 4] * 4,
    {"a": {"b": []}},
)
_WORDS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e999",
    "99999999999999999999",
    "2147483648",
    "-0.0",
    "",
    "a",
    "\0",
    "é",
    '"',
    ",",
    "\t",
    "1" * 400,
)


def mutate(data: bytes, kinds: tuple[str, ...]) -> st.SearchStrategy[bytes]:
    """Damage ``data``: one to three times in its bytes, or equally often for each of ``kinds``, in its structure."""
    mutations = [_bytes, *(_STRUCTURES[k] for k in kinds for _ in range(2))]
    return st.sampled_from(mutations).flatmap(lambda mutate: mutate(data))


@st.composite
def _bytes(draw, data: bytes) -> bytes:
    for _ in range(draw(_ONE_TO_THREE)):
        data = draw(_DAMAGES)(draw, data)
    return data


def _choose_position(draw, data: bytes) -> int:
    """Draw a position in ``data``: often near its start, where headers are, or its end, where archives list their
    members.
    """
    limit = len(data)
    near = min(limit, 200)
    at = draw(st.integers(0, 2 * near + min(limit, 2 * near)))
    if at <= near:
        return at
    return limit - (at - near) if at <= 2 * near else (at - 2 * near) * limit // max(min(limit, 2 * near), 1)


def _flip_bits(draw, data: bytes) -> bytes:
    out = bytearray(data)
    for _ in range(draw(_ONE_TO_THREE)):
        if out:
            out[min(_choose_position(draw, data), len(out) - 1)] ^= 1 << draw(_BIT)
    return bytes(out)


def _truncate(draw, data: bytes) -> bytes:
    return data[: _choose_position(draw, data)]


def _insert_bytes(draw, data: bytes) -> bytes:
    at = _choose_position(draw, data)
    return data[:at] + draw(_SOME_BYTES) * draw(_REPEATS) + data[at:]


def _overwrite(draw, data: bytes) -> bytes:
    """Set an integer of one to eight bytes to an extreme value."""
    at, size = _choose_position(draw, data), draw(_SIZES)
    value = draw(_EXTREME) % (1 << 8 * size)
    return data[:at] + value.to_bytes(size, draw(_ORDER)) + data[at + size :]


def _move_block(draw, data: bytes) -> bytes:
    """Remove or duplicate a piece."""
    a, b = sorted((_choose_position(draw, data), _choose_position(draw, data)))
    return data[:a] + data[b:] if draw(_COIN) else data[:b] + data[a:]


# Created once, because creating a strategy takes longer than drawing from it.
_ONE_TO_THREE, _BIT, _COIN, _SOME_BYTES = (
    st.integers(1, 3),
    st.integers(0, 7),
    st.booleans(),
    st.binary(min_size=1, max_size=8),
)
_REPEATS, _SIZES = st.sampled_from([1, 1, 1, 10, 1000]), st.sampled_from([1, 2, 4, 8])
_ORDER, _EXTREME = st.sampled_from(["little", "big"]), st.sampled_from(EXTREMES)
_DAMAGES = st.sampled_from([_flip_bits, _truncate, _insert_bytes, _overwrite, _move_block])
_TENTH, _EIGHTH, _VALUE = st.integers(0, 9), st.integers(0, 7), st.sampled_from(_VALUES)


# --- structures -------------------------------------------------------------------------------------------------------


@st.composite
def _json(draw, data: bytes) -> bytes:
    return _change_json(draw, json.loads(data))


def _change_json(draw, value) -> bytes:
    deep = draw(st.integers(0, 30))
    if deep == 0:
        count = draw(st.sampled_from([100, 5000, 200_000]))
        return draw(st.sampled_from([b"[" * count, b"[" * count + b"]" * count, b'{"a":' * count]))
    for _ in range(draw(_ONE_TO_THREE)):
        value = _change_value(draw, value)
    text = json.dumps(value)
    return text.encode()


def _change_value(draw, value):
    """Replace, remove or rename a part of ``value``."""
    if isinstance(value, dict) and value and draw(_EIGHTH):
        key = draw(st.sampled_from(sorted(value)))
        what, rest = draw(_TENTH), {k: v for k, v in value.items() if k != key}
        if what == 0:
            return rest
        if what == 1:
            return {**rest, key + "x": value[key]}
        return {**rest, key: _change_value(draw, value[key])}
    if isinstance(value, list) and value and draw(_EIGHTH):
        k = draw(st.integers(0, len(value) - 1))
        what = draw(_TENTH)
        if what == 0:
            return value[:k] + value[k + 1 :]
        if what == 1:
            return value[:k] + [value[k]] * 2 + value[k:]
        return [*value[:k], _change_value(draw, value[k]), *value[k + 1 :]]
    return draw(_VALUE)


@st.composite
def _text(draw, data: bytes) -> bytes:
    text = data.decode("utf-8", "surrogateescape")
    for _ in range(draw(_ONE_TO_THREE)):
        spots = [m.span() for m in re.finditer(r"[-+.\w]+", text)]
        if not spots:
            break
        a, b = draw(st.sampled_from(spots))
        word = draw(st.sampled_from([*_WORDS, *map(str, EXTREMES)]))
        what = draw(st.integers(0, 5))
        text = text[:a] + (text[a:b] + " " + word if what == 0 else "" if what == 1 else word) + text[b:]
    return text.encode("utf-8", "surrogateescape")


@st.composite
def _npy(draw, data: bytes) -> bytes:
    """Change the header of an array."""
    size = struct.unpack_from("<H", data, 8)[0]
    head = data[10 : 10 + size].decode("latin1")
    number, values = (
        str(draw(_EXTREME)),
        ("'|O'", "'<U0'", "'<f8'", "'<i1'", "'|V100000'", "[('a', '<f4')]", "1", "''"),
    )
    mutations = [
        lambda: re.sub(r"\d+", number, head, count=draw(_ONE_TO_THREE)),
        lambda: re.sub(r"'descr': '[^']*'", f"'descr': {draw(st.sampled_from(values))}", head),
        lambda: re.sub(
            r"\(.*\)", draw(st.sampled_from(["()", "(-1,)", f"({number}, {number})", "(1,) * 9", "(" * 90])), head
        ),
        lambda: head.replace("False", draw(st.sampled_from(["True", "None", "1", "__import__('os')"]))),
        lambda: draw(
            st.sampled_from(
                [head.replace("'shape'", "'form'"), "{" * 100 + "\n", head + " " * 20_000, "-" * 3000 + "1"]
            )
        ),
    ]
    head = draw(st.sampled_from(mutations))()
    return data[:8] + struct.pack("<H", len(head) % 65536) + head.encode("latin1") + data[10 + size :]


@st.composite
def _gzip(draw, data: bytes) -> bytes:
    inner = gzip.decompress(data)
    if draw(st.integers(0, 20)) == 0:
        inner += b"0" * draw(st.sampled_from([10**6, 30 * 10**6]))
    return gzip.compress(draw(st.sampled_from([_text, _bytes]).flatmap(lambda mutate: mutate(inner))), 1, mtime=0)


@st.composite
def _zip(draw, data: bytes) -> bytes:
    """Damage, rename, remove or extend a member, or change the member list."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {n: archive.read(n) for n in archive.namelist()}
    names = sorted(members)
    # Members that describe others are damaged more often.
    likely = [n for n in names if n.endswith((".pkl", ".json")) for _ in range(2 * len(names))]
    name, what = draw(st.sampled_from([*names, *likely])), draw(st.integers(0, 11))
    if what == 0:
        members.pop(name)
    elif what == 1:
        members[draw(st.sampled_from(["x", "../x", "/x", "data.pkl", "a/data.pkl", "x.npy", "é" * 40]))] = members.pop(
            name
        )
    elif what == 2:
        members[name] += bytes(draw(st.sampled_from([1000, 10**6, 30 * 10**6])))
    elif members[name].startswith(b"\x93NUMPY") and what < 9:
        members[name] = draw(_npy(members[name]))
    else:
        members[name] = draw(_bytes(members[name]))
    out = io.BytesIO()
    with zipfile.ZipFile(
        out, "w", draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])), compresslevel=1
    ) as archive:
        for key in sorted(members):
            archive.writestr(zipfile.ZipInfo(key), members[key], archive.compression)
    data = out.getvalue()
    if what in (10, 11):
        at = data.rindex(b"PK\1\2") + draw(st.sampled_from([8, 10, 16, 20, 24, 28, 42]))
        claim = draw(st.sampled_from([b"\xff\xff", b"\xff\xff\xff\x7f", b"\0\0", b"\0\0\0\x40", b"\1\0"]))
        data = data[:at] + claim + data[at + len(claim) :]
    return data


@st.composite
def _safetensors(draw, data: bytes) -> bytes:
    """Change the header, or the metadata in it."""
    size = struct.unpack_from("<Q", data)[0]
    header = json.loads(data[8 : 8 + size])
    if "__metadata__" in header and draw(st.integers(0, 4)):
        entries = header["__metadata__"]
        header["__metadata__"] = {**entries, "nerg": _change_json(draw, json.loads(entries["nerg"])).decode()}
        raw = json.dumps(header).encode()
    else:
        raw = _change_json(draw, header)
    return struct.pack("<Q", len(raw)) + raw + data[8 + size :]


@st.composite
def _png(draw, data: bytes) -> bytes:
    """Damage, remove or duplicate a chunk, with a valid checksum."""
    chunks, at = [], 8
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    k, what = draw(st.integers(0, len(chunks) - 1)), draw(_EIGHTH)
    kind, content = chunks[k]
    if kind == b"IDAT" and what > 4:
        content = zlib.compress(draw(_bytes(zlib.decompress(content))))
    elif what > 1:
        content = draw(_bytes(content))
    chunks[k : k + 1] = [] if what == 0 else [(kind, content)] * (2 if what == 1 else 1)
    pieces = [(len(c).to_bytes(4, "big"), t + c, zlib.crc32(t + c).to_bytes(4, "big")) for t, c in chunks]
    return data[:8] + b"".join(b"".join(p) for p in pieces)


_NESTED = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"moof", b"traf", b"mvex", b"udta")


@st.composite
def _boxes(draw, data: bytes) -> bytes:
    """Damage, remove, rename or duplicate a box of an MP4 file, and adjust the sizes of its parents."""
    return _change_boxes(draw, data)


def _change_boxes(draw, data: bytes) -> bytes:
    boxes, at = [], 0
    while at + 8 <= len(data):
        size = max(8, int.from_bytes(data[at : at + 4], "big"))
        boxes.append((data[at + 4 : at + 8], data[at + 8 : at + size]))
        at += size
    if not boxes:
        return draw(_bytes(data))
    # Boxes that describe the others are damaged more often.
    likely = [k for k, (kind, _) in enumerate(boxes) if kind in _NESTED for _ in range(4)]
    k, what = draw(st.sampled_from([*range(len(boxes)), *likely])), draw(st.integers(0, 11))
    kind, content = boxes[k]
    if kind in _NESTED and what > 1:
        content = _change_boxes(draw, content)
    elif what == 2:
        kind = draw(st.sampled_from([b"free", b"stsz", b"trun", b"cmov", b"meta", b"wide", bytes(4), *_NESTED]))
    elif what > 7 and len(content) >= 8:
        # In most boxes, numbers are aligned to four bytes.
        at = 4 * draw(st.integers(0, len(content) // 4 - 1))
        content = content[:at] + (draw(_EXTREME) % (1 << 32)).to_bytes(4, "big") + content[at + 4 :]
    elif what > 2:
        content = draw(_bytes(content))
    boxes[k : k + 1] = [] if what == 0 else [(kind, content)] * (2 if what == 1 else 1)
    return b"".join((len(c) + 8).to_bytes(4, "big") + t + c for t, c in boxes)


_STRUCTURES = {"json": _json, "text": _text, "npy": _npy, "gzip": _gzip, "zip": _zip, "safetensors": _safetensors} | {
    "png": _png,
    "boxes": _boxes,
}


# ---- Every value of a JSON document, one after another ----

_OTHER_VALUES = (None, {}, [], "x", -1, 1e300, float("nan"), float("inf"), True, [[0.0]], 1 << 70)


def iter_damaged_documents(document: object) -> Iterator[object]:
    """Iterate over copies of a JSON ``document`` in which one value is missing or replaced by each of `_OTHER_VALUES`.

    Of lists, only the first item is damaged.
    """
    yield from _OTHER_VALUES
    if isinstance(document, (dict, list)) and document:
        items = list(document.items()) if isinstance(document, dict) else [(0, document[0])]
        for key, value in items:
            copy = dict(document) if isinstance(document, dict) else list(document)
            del copy[key]
            yield copy
            for other in iter_damaged_documents(value):
                copy = dict(document) if isinstance(document, dict) else list(document)
                copy[key] = other
                yield copy
