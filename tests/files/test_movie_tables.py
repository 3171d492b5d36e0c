"""MP4 files whose tables claim more samples than their bytes warrant."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from nerg_mi.files.movie_tables import check_movie


def box(kind: bytes, *content: bytes) -> bytes:
    joined = b"".join(content)
    return struct.pack(">I4s", 8 + len(joined), kind) + joined


def table(kind: bytes, count: int, entries: bytes = b"", flags: int = 0) -> bytes:
    return box(kind, struct.pack(">II", flags, count), entries)


def track(*tables: bytes, edits: bytes = b"") -> bytes:
    return box(b"trak", box(b"edts", edits), box(b"mdia", box(b"minf", box(b"stbl", *tables))))


def checked(path: Path, *boxes: bytes) -> None:
    path.write_bytes(b"".join(boxes))
    check_movie(path)


def sizes(same: int, count: int, entries: bytes = b"") -> bytes:
    return box(b"stsz", struct.pack(">III", 0, same, count), entries)


DATA = box(b"mdat", bytes(1000))
FILE = "film.mp4"


def test_sound_tables_pass(tmp_path):
    edits = table(b"elst", 2, bytes(40), flags=1 << 24)
    whole = track(sizes(0, 3, bytes(12)), table(b"stts", 1, bytes(8)), table(b"stco", 1, bytes(4)), edits=edits)
    checked(tmp_path / FILE, box(b"ftyp", b"isom"), DATA, box(b"moov", whole, track(sizes(2, 500))))
    # Of a size that takes eight bytes, and one that runs to the end.
    large = struct.pack(">I4sQ", 1, b"mdat", 16 + 1000) + bytes(1000)
    checked(tmp_path / FILE, large, struct.pack(">I4s", 0, b"moov") + whole)


def test_other_kinds_of_files_pass(tmp_path):
    for data in (
        b"",
        b"RIFF",
        b"\x1aE\xdf\xa3" + bytes(50),
        b"GP" * 500,
        bytes(100),
        box(b"stsz", b"1"),
        b"\0\0\0\5moov",
    ):
        checked(tmp_path / FILE, data)


@pytest.mark.parametrize("within", [b"moov", b"free", b"udta", b"meta"])
def test_samples_need_bytes(within, tmp_path):
    head = {b"free": box(b"mvhd", bytes(100)), b"meta": bytes(4)}.get(within, b"")
    with pytest.raises(ValueError, match=r"claims 30,000,000 samples in [\d,]+ bytes"):
        checked(tmp_path / FILE, DATA, box(within, head, track(sizes(1, 30_000_000))))


def test_samples_of_parts_count_together(tmp_path):
    parts = [box(b"moof", box(b"traf", table(b"trun", 400))) for _ in range(3)]
    checked(tmp_path / FILE, DATA, parts[0], box(b"free", bytes(100)))
    with pytest.raises(ValueError, match="claims 1,200 samples"):
        checked(tmp_path / FILE, DATA, *parts)


def test_tables_that_are_too_short_run_on(tmp_path):
    """FFmpeg reads their beginning from what follows."""
    with pytest.raises(ValueError, match=r"claims 16,777,215 samples"):
        checked(tmp_path / FILE, box(b"moof", box(b"traf", box(b"trun", bytes(2)))) + b"\0\0\0\xff\xff\xff" + bytes(9))


def test_edits_multiply_samples(tmp_path):
    for edits, passes in ((2, True), (40, False)):
        whole = box(b"moov", track(sizes(1, 900), edits=table(b"elst", edits, bytes(12 * edits))))
        if passes:
            checked(tmp_path / FILE, DATA, whole)
            continue
        with pytest.raises(ValueError, match="900 samples in 40 edits"):
            checked(tmp_path / FILE, DATA, whole)


@pytest.mark.parametrize("kind, size", [(b"stts", 8), (b"ctts", 8), (b"stsc", 12), (b"stss", 4), (b"stco", 4)])
def test_tables_hold_their_entries(kind, size, tmp_path):
    checked(tmp_path / FILE, DATA, box(b"moov", track(table(kind, 3, bytes(3 * size)))))
    with pytest.raises(ValueError, match=f'"{kind.decode()}" claims 4 entries, and holds 3'):
        checked(tmp_path / FILE, DATA, box(b"moov", track(table(kind, 4, bytes(3 * size)))))
    with pytest.raises(ValueError, match='"stsz" claims 268,435,456 entries, and holds 3'):
        checked(tmp_path / FILE, DATA, box(b"moov", track(sizes(0, 1 << 28, bytes(12)))))


def test_what_cannot_be_looked_into_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="is compressed"):
        checked(tmp_path / FILE, box(b"moov", box(b"cmov", bytes(20))))
    monkeypatch.setattr("nerg_mi.files.movie_tables._BOXES", 5)
    with pytest.raises(ValueError, match="more than 5 boxes"):
        checked(tmp_path / FILE, *[box(b"free")] * 6)
