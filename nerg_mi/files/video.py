"""Videos: frames in and out, and the tables of MP4 files."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, BinaryIO

import numpy as np

from nerg_mi.errors import NergError, import_extra, sanitize

from .atomic import replace_atomically
from .safe_read import translate_read_errors, check_regular_file

# ---- Movie tables ----
#
# The tables of an MP4 or QuickTime file: when its frames are shown, and whether they claim more samples than its bytes
# warrant, for which FFmpeg would make room.
#
# FFmpeg writes a line of its index for each sample that a table tells of, and again for each edit: a few bytes of a
# table can tell of billions.

_CONTAINERS = frozenset(
    b"moov trak mdia minf stbl edts moof traf mvex udta wave tref dinf ilst gmhd".split()  # whose boxes FFmpeg reads
)
# Tables by the bytes of an entry.
_ENTRIES = {b"stts": 8, b"ctts": 8, b"stsc": 12, b"stss": 4, b"stps": 4, b"stco": 4, b"co64": 8, b"elst": 12}
# FFmpeg takes these for what they hold where it finds no header.
_LEFT_OVER = (b"free", b"hoov", b"skip")
_BOXES = 1 << 20
_FRAMES = 1 << 24  # of a video, at most: three days at 60 a second
_EMPTY = -1  # the media time of an edit that shows nothing


@dataclass
class _Claims:
    samples: int = 0
    edits: int = 0
    boxes: int = 0


def check_video_tables(path: str | os.PathLike, file_kind: str = "video") -> None:
    """Raise ``ValueError`` where the boxes of ``path`` claim more than its bytes warrant; other kinds of files pass."""
    length = check_regular_file(path, file_kind)
    claims = _Claims()
    with open(path, "rb") as file:
        for kind, start, end in _boxes(file, 0, length, claims):
            _look(file, kind, start, end, claims)
    # Most edits are one, or two of which the first is empty. No sample takes less than a byte.
    if claims.samples * max(1, claims.edits - 1) > length:
        edits = f" in {claims.edits:,} edits" if claims.edits > 1 else ""
        raise ValueError(f"it claims {claims.samples:,} samples{edits} in {length:,} bytes")


def read_frame_times(path: str | os.PathLike, file_kind: str = "video") -> np.ndarray:
    """Seconds (F,) at which the frames of the first track of pictures are shown, in the order in which they are.

    Durations of frames may vary. Edits shift frames, and leave out those that a player does not show, as FFmpeg numbers
    them. Raises `NergError` for what is no MP4 or QuickTime file, is damaged, or whose frames are in fragments.
    """
    with translate_read_errors(path, file_kind, "copy it again, or rewrite it with ffmpeg -i VIDEO -c copy NEW.mp4"):
        check_video_tables(path, file_kind)
        with open(path, "rb") as file:
            scale, tracks = _tracks(file, check_regular_file(path, file_kind))
        track = next((t for t in tracks if t.get(b"hdlr", b"")[8:12] == b"vide"), None)
        if track is None or b"stts" not in track:
            raise ValueError("it has no track of pictures, or is no MP4 or QuickTime file")
        shown = _shown(track, scale)
        if not shown.size:
            raise ValueError("it has no frames")
        return np.sort(shown)


def _tracks(file: BinaryIO, length: int) -> tuple[int, list[dict[bytes, bytes]]]:
    """Ticks a second of the movie, and the boxes of each track that say what it is and when its samples are shown."""
    scale, tracks = 0, []
    for kind, start, end in _boxes(file, 0, length, _Claims()):
        if kind == b"moof":
            raise ValueError("its frames are in fragments, which are not read")
        if kind == b"trak":
            tracks.append({})
        elif kind == b"mvhd" or (tracks and kind in (b"mdhd", b"hdlr", b"stts", b"ctts", b"elst")):
            if end - start > 20 * _FRAMES:
                raise ValueError(f'its table "{kind.decode()}" has {end - start:,} bytes')
            file.seek(start)
            content = file.read(end - start)
            if kind == b"mvhd":
                scale = _ticks(content)
            else:
                tracks[-1].setdefault(kind, content)
    return scale, tracks


def _ticks(header: bytes) -> int:
    """Ticks a second of the header of a movie or of a track."""
    ticks = struct.unpack_from(">I", header, 20 if header[0] == 1 else 12)[0]
    if not ticks:
        raise ValueError("its clock has no ticks")
    return ticks


def _shown(track: dict[bytes, bytes], scale: int) -> np.ndarray:
    """Seconds at which the samples of a track are shown; ``scale``: ticks a second of its edits' durations."""
    ticks = _ticks(track[b"mdhd"])
    durations = _runs(track[b"stts"]).astype(np.int64)
    at = np.cumsum(durations) - durations
    if b"ctts" in track:
        offsets = _runs(track[b"ctts"])
        if len(offsets) != len(at):
            raise ValueError(f"its tables tell of {len(at):,} and of {len(offsets):,} frames")
        at = at + offsets.view(np.int32)  # negative ones are written in version 0 too
    if b"elst" not in track:
        return at / ticks
    if not scale:
        raise ValueError("its edits count by a clock that it lacks")
    count = struct.unpack_from(">I", track[b"elst"], 4)[0]
    entry = struct.Struct(">Qqi" if track[b"elst"][0] == 1 else ">Iii")
    shown, begin = [np.empty(0)], 0.0
    for duration, media, rate in entry.iter_unpack(track[b"elst"][8 : 8 + count * entry.size]):
        if media != _EMPTY:
            if rate != 1 << 16:
                raise ValueError("an edit changes its speed")
            # An edit of no duration runs to the end.
            end = media + duration / scale * ticks if duration else np.inf
            inside = at[(at >= media) & (at < end)]
            shown.append(begin + (inside - media) / ticks)
        begin += duration / scale
    return np.concatenate(shown)


def _runs(table: bytes) -> np.ndarray:
    """The values (n,) uint32 of a table of runs: how often, and which value."""
    count = struct.unpack_from(">I", table, 4)[0]
    runs = np.frombuffer(table, ">u4", 2 * count, 8).reshape(-1, 2)
    if runs[:, 0].sum(dtype=np.uint64) > _FRAMES:
        raise ValueError(f"it claims more than {_FRAMES:,} frames")
    return np.repeat(runs[:, 1].astype(np.uint32), runs[:, 0])


def _boxes(file: BinaryIO, start: int, end: int, claims: _Claims) -> Iterator[tuple[bytes, int, int]]:
    """Each box from ``start`` to ``end``, with those within it: its kind, and where its content starts and ends."""
    open_ends = [end]
    while open_ends:
        if start + 8 > open_ends[-1]:
            start = open_ends.pop()
            continue
        claims.boxes += 1
        if claims.boxes > _BOXES:
            raise ValueError(f"it is divided into more than {_BOXES:,} boxes")
        file.seek(start)
        head = file.read(16)
        if len(head) < 8:
            return
        size, kind, content = int.from_bytes(head[:4], "big"), head[4:8], start + 8
        if size == 1 and len(head) == 16:
            size, content = int.from_bytes(head[8:], "big"), start + 16
        stop = open_ends[-1] if size == 0 else min(start + size, open_ends[-1])
        if stop < content:
            # As FFmpeg does: what is damaged ends what it lies in.
            start = open_ends.pop()
            continue
        yield kind, content, stop
        start = stop
        if kind in _CONTAINERS or (kind in _LEFT_OVER and head[12:] in (b"mvhd", b"cmov")):
            open_ends.append(stop)
            start = content
        elif kind == b"meta":
            open_ends.append(stop)
            # Of some, four bytes come before the boxes.
            start = content if head[12:] == b"hdlr" else content + 4


def _look(file: BinaryIO, kind: bytes, start: int, end: int, claims: _Claims) -> None:
    if kind == b"cmov":
        raise ValueError("its header is compressed, which is not read")
    if kind not in _ENTRIES and kind not in (b"stsz", b"trun"):
        return
    # FFmpeg reads on where a box is too short for what begins it.
    file.seek(start)
    head = file.read(12)
    if len(head) < 8:
        return
    flags, count = struct.unpack_from(">II", head)
    if kind == b"trun":
        claims.samples += count
        return
    if kind == b"stsz":
        if len(head) < 12:
            return
        # Of one size for all, no other is told.
        same, count = count, struct.unpack_from(">I", head, 8)[0]
        claims.samples += count
        room, bytes_each = max(0, end - start - 12), 0 if same else 4
    else:
        room, bytes_each = max(0, end - start - 8), 20 if kind == b"elst" and flags >> 24 == 1 else _ENTRIES[kind]
    if count * bytes_each > room:
        raise ValueError(f'its table "{kind.decode()}" claims {count:,} entries, and holds {room // bytes_each:,}')
    if kind == b"elst":
        claims.edits = max(claims.edits, count)


# ---- Video ----
#
# Videos that play everywhere, written frame by frame: H.264 in MP4, whole or absent.

CODEC = "libx264"
_QUALITY = "17"  # x264's constant rate factor: no difference is seen from about 18 down
_MOST_FPS = 1000.0
_LEAST, _MOST = 16, 8192
_NAMES = {"Software": "artist", "Comment": "comment", "Title": "title"}


def check_video_output(fps: float) -> None:
    """Raise `NergError` for an ``fps`` that is no rate, and `ImportError` where PyAV is missing: before long work."""
    _pyav()
    if not (np.isfinite(fps) and 0 < fps <= _MOST_FPS):
        raise NergError(f"a video has up to {_MOST_FPS:.0f} pictures a second, and {fps} were asked for; give --fps 25")


@contextmanager
def open_video_writer(
    path: str | os.PathLike, fps: float = 25.0, metadata: Mapping[str, str] | None = None
) -> Iterator[Callable[[np.ndarray], None]]:
    """A video of ``fps`` pictures a second, which are not kept in memory.

    Gives a function that writes the next frame (h, w, 3), uint8 sRGB, rows from the top; all have one size. Sides are
    even, since colours have half the resolution (yuv420p, ITU-R BT.709): nothing is resized. ``text``: what
    the header says, by PNG's names (``Comment``, ``Software``). Equal frames give equal files with the same FFmpeg.
    Raises `NergError` for sizes that cannot be shown and for no frames at all, `ImportError` where PyAV is missing.
    """
    check_video_output(fps)
    av = _pyav()
    container: Any = None
    stream: Any = None
    with replace_atomically(path) as temporary:
        # Without the name and version of the writing library, and its estimate of the bit rate, files stay equal.
        flags = {"movflags": "+faststart", "fflags": "+bitexact", "write_btrt": "0"}
        container = av.open(str(temporary), "w", format="mp4", options=flags)

        def write(frame: np.ndarray) -> None:
            nonlocal stream
            frame = np.ascontiguousarray(frame, np.uint8)
            height, width = frame.shape[:2]
            if stream is None:
                _check_size(path, width, height)
                stream = _open_stream(container, width, height, fps)
            if (width, height) != (stream.width, stream.height):
                raise NergError(
                    f'"{path}" has pictures of {stream.width} x {stream.height} pixels, and one of {width} x {height} '
                    "follows: give all of them one size"
                )
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            picture = picture.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
            with _encoding(path, av):
                container.mux(stream.encode(picture))

        try:
            for key, value in (metadata or {}).items():
                container.metadata[_NAMES.get(key, key)] = value
            yield write
            if stream is None:
                raise NergError(f'"{path}" would be a video without pictures: give at least one')
            with _encoding(path, av):
                container.mux(stream.encode(None))
        finally:
            with _encoding(path, av):
                container.close()


def _open_stream(container: Any, width: int, height: int, fps: float) -> Any:
    rate = Fraction(fps).limit_denominator(1001)
    stream = container.add_stream(CODEC, rate=rate, options={"crf": _QUALITY, "preset": "medium"})
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    context = stream.codec_context
    # BT.709, limited range: what players otherwise guess by the size of the picture.
    context.colorspace, context.color_primaries, context.color_trc, context.color_range = 1, 1, 1, 1
    # More of them give another file on machines with another number of cores.
    context.thread_count = 1
    return stream


def _check_size(path: str | os.PathLike, width: int, height: int) -> None:
    if width % 2 or height % 2:
        raise NergError(
            f'"{path}" would have pictures of {width} x {height} pixels, and a video that plays everywhere needs even '
            "sides: change the film's size by one pixel"
        )
    if not (_LEAST <= min(width, height) and max(width, height) <= _MOST):
        raise NergError(
            f'"{path}" would have pictures of {width} x {height} pixels: give a video sides of {_LEAST} to {_MOST}'
        )


@contextmanager
def _encoding(path: str | os.PathLike, av: Any) -> Iterator[None]:
    """What FFmpeg says of ``path`` as one sentence; an `OSError`, such as that of a full disk, stays one."""
    try:
        yield
    except av.error.FFmpegError as error:
        if isinstance(error, OSError):
            raise
        raise NergError(f'"{path}" could not be encoded ({sanitize(error)}); choose another size or rate') from error


def _pyav() -> Any:
    return import_extra("av", "a video needs PyAV", "video")
