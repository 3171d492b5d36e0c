"""Videos: output of frames as H.264, and the tables of MP4 files."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, BinaryIO

import numpy as np

from nerg_mi.errors import NergError, import_extra, parameter, sanitize

from .atomic import replace_atomically
from .safe_read import check_regular_file, translate_read_errors

# ---- Tables of MP4 and QuickTime files ----
#
# The tables contain the presentation times of the frames. They are checked because FFmpeg allocates an index entry for
# each sample that a table claims, and again for each edit; a table of a few bytes can claim billions of samples.

_CONTAINERS = frozenset(
    b"moov trak mdia minf stbl edts moof traf mvex udta wave tref dinf ilst gmhd".split()  # FFmpeg reads their boxes
)
# Bytes per entry of each table.
_ENTRY_BYTES = {b"stts": 8, b"ctts": 8, b"stsc": 12, b"stss": 4, b"stps": 4, b"stco": 4, b"co64": 8, b"elst": 12}
# FFmpeg may interpret the content of these boxes as a header if it has found none.
_REUSED_BOXES = (b"free", b"hoov", b"skip")
_MAX_BOXES = 1 << 20
_MAX_FRAMES = 1 << 24  # maximum number of frames of a video: three days at 60 per second
_EMPTY_EDIT = -1  # media time of an empty edit


@dataclass
class _Claims:
    samples: int = 0
    edits: int = 0
    boxes: int = 0


def check_video_tables(path: str | os.PathLike, file_kind: str = "video") -> None:
    """Raise ``ValueError`` if the boxes of ``path`` claim more samples than the file can contain. Other file
    formats pass.
    """
    length = check_regular_file(path, file_kind)
    claims = _Claims()
    with open(path, "rb") as file:
        for kind, start, end in _iter_boxes(file, 0, length, claims):
            _check_box(file, kind, start, end, claims)
    # Most files have one edit, or an empty edit and another one. A sample takes at least one byte.
    if claims.samples * max(1, claims.edits - 1) > length:
        edits = f" in {claims.edits:,} edits" if claims.edits > 1 else ""
        raise ValueError(f"it claims {claims.samples:,} samples{edits} in {length:,} bytes")


def read_frame_times(path: str | os.PathLike, file_kind: str = "video") -> np.ndarray:
    """Return the presentation times (F,) of the frames of the first video track, in seconds, in presentation order.

    Frame durations may vary. Edits shift frames and drop frames that a player does not show; the numbering agrees with
    FFmpeg's. Raises `NergError` for a file that is not MP4 or QuickTime, is damaged, or is fragmented.
    """
    with translate_read_errors(path, file_kind, "copy it again, or rewrite it with ffmpeg -i VIDEO -c copy NEW.mp4"):
        check_video_tables(path, file_kind)
        with open(path, "rb") as file:
            scale, tracks = _read_tracks(file, check_regular_file(path, file_kind))
        track = next((t for t in tracks if t.get(b"hdlr", b"")[8:12] == b"vide"), None)
        if track is None or b"stts" not in track:
            raise ValueError("it has no video track, or is not an MP4 or QuickTime file")
        times = _compute_frame_times(track, scale)
        if not times.size:
            raise ValueError("it has no frames")
        return np.sort(times)


def _read_tracks(file: BinaryIO, length: int) -> tuple[int, list[dict[bytes, bytes]]]:
    """Return the ticks per second of the movie, and the boxes of each track that describe its type and its sample
    times.
    """
    scale, tracks = 0, []
    for kind, start, end in _iter_boxes(file, 0, length, _Claims()):
        if kind == b"moof":
            raise ValueError("it is fragmented, which is not supported")
        if kind == b"trak":
            tracks.append({})
        elif kind == b"mvhd" or (tracks and kind in (b"mdhd", b"hdlr", b"stts", b"ctts", b"elst")):
            if end - start > 20 * _MAX_FRAMES:
                raise ValueError(f'its table "{kind.decode()}" has {end - start:,} bytes')
            file.seek(start)
            content = file.read(end - start)
            if kind == b"mvhd":
                scale = _read_ticks(content)
            else:
                tracks[-1].setdefault(kind, content)
    return scale, tracks


def _read_ticks(header: bytes) -> int:
    """Return the ticks per second in the header of a movie or a track."""
    ticks = struct.unpack_from(">I", header, 20 if header[0] == 1 else 12)[0]
    if not ticks:
        raise ValueError("its time scale is zero")
    return ticks


def _compute_frame_times(track: dict[bytes, bytes], scale: int) -> np.ndarray:
    """Return the presentation times of the samples of a track in seconds. ``scale``: ticks per second of the edit
    durations.
    """
    ticks = _read_ticks(track[b"mdhd"])
    durations = _expand_runs(track[b"stts"]).astype(np.int64)
    decode_times = np.cumsum(durations) - durations
    if b"ctts" in track:
        offsets = _expand_runs(track[b"ctts"])
        if len(offsets) != len(decode_times):
            raise ValueError(f"its tables list {len(decode_times):,} and {len(offsets):,} frames")
        decode_times = decode_times + offsets.view(np.int32)  # some writers store negative offsets in version 0, too
    if b"elst" not in track:
        return decode_times / ticks
    if not scale:
        raise ValueError("it has edits, but no movie time scale")
    count = struct.unpack_from(">I", track[b"elst"], 4)[0]
    entry = struct.Struct(">Qqi" if track[b"elst"][0] == 1 else ">Iii")
    times, edit_start = [np.empty(0)], 0.0
    for duration, media, rate in entry.iter_unpack(track[b"elst"][8 : 8 + count * entry.size]):
        if media != _EMPTY_EDIT:
            if rate != 1 << 16:
                raise ValueError("an edit changes the playback speed")
            # An edit with duration 0 extends to the end.
            end = media + duration / scale * ticks if duration else np.inf
            inside = decode_times[(decode_times >= media) & (decode_times < end)]
            times.append(edit_start + (inside - media) / ticks)
        edit_start += duration / scale
    return np.concatenate(times)


def _expand_runs(table: bytes) -> np.ndarray:
    """Return the values (n,) uint32 of a run-length table of (count, value) pairs."""
    count = struct.unpack_from(">I", table, 4)[0]
    runs = np.frombuffer(table, ">u4", 2 * count, 8).reshape(-1, 2)
    if runs[:, 0].sum(dtype=np.uint64) > _MAX_FRAMES:
        raise ValueError(f"it claims more than {_MAX_FRAMES:,} frames")
    return np.repeat(runs[:, 1].astype(np.uint32), runs[:, 0])


def _iter_boxes(file: BinaryIO, start: int, end: int, claims: _Claims) -> Iterator[tuple[bytes, int, int]]:
    """Iterate over the boxes from ``start`` to ``end``, nested ones included: type, start and end of the content."""
    open_ends = [end]
    while open_ends:
        if start + 8 > open_ends[-1]:
            start = open_ends.pop()
            continue
        claims.boxes += 1
        if claims.boxes > _MAX_BOXES:
            raise ValueError(f"it has more than {_MAX_BOXES:,} boxes")
        file.seek(start)
        head = file.read(16)
        if len(head) < 8:
            return
        size, kind, content = int.from_bytes(head[:4], "big"), head[4:8], start + 8
        if size == 1 and len(head) == 16:
            size, content = int.from_bytes(head[8:], "big"), start + 16
        stop = open_ends[-1] if size == 0 else min(start + size, open_ends[-1])
        if stop < content:
            # As in FFmpeg, a damaged box ends its parent.
            start = open_ends.pop()
            continue
        yield kind, content, stop
        start = stop
        if kind in _CONTAINERS or (kind in _REUSED_BOXES and head[12:] in (b"mvhd", b"cmov")):
            open_ends.append(stop)
            start = content
        elif kind == b"meta":
            open_ends.append(stop)
            # In some files, four bytes precede the boxes.
            start = content if head[12:] == b"hdlr" else content + 4


def _check_box(file: BinaryIO, kind: bytes, start: int, end: int, claims: _Claims) -> None:
    if kind == b"cmov":
        raise ValueError("its header is compressed, which is not supported")
    if kind not in _ENTRY_BYTES and kind not in (b"stsz", b"trun"):
        return
    # FFmpeg reads beyond the end of a box that is too short for its header.
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
        # If all samples have the same size, there is no table of sizes.
        uniform_size, count = count, struct.unpack_from(">I", head, 8)[0]
        claims.samples += count
        available, entry_bytes = max(0, end - start - 12), 0 if uniform_size else 4
    else:
        available, entry_bytes = (
            max(0, end - start - 8),
            20 if kind == b"elst" and flags >> 24 == 1 else _ENTRY_BYTES[kind],
        )
    if count * entry_bytes > available:
        raise ValueError(
            f'its table "{kind.decode()}" claims {count:,} entries, but contains {available // entry_bytes:,}'
        )
    if kind == b"elst":
        claims.edits = max(claims.edits, count)


# ---- Output of H.264 video in MP4, which all common players support ----

CODEC = "libx264"
_QUALITY = "17"  # constant rate factor of x264: values below about 18 are visually lossless
_MAX_FPS = 1000.0
_MIN_SIDE, _MAX_SIDE = 16, 8192
_METADATA_KEYS = {"Software": "artist", "Comment": "comment", "Title": "title"}


def check_video_output(fps: float) -> None:
    """Check before long work that a video can be written.

    Raises `NergError` if ``fps``, in frames per second, is not above 0 and at most 1000, and `ImportError` if PyAV is
    missing.
    """
    _import_pyav()
    if not (np.isfinite(fps) and 0 < fps <= _MAX_FPS):
        raise NergError(
            f"a video has at most {_MAX_FPS:.0f} frames per second, got {fps}; use for example {parameter('fps', 25)}"
        )


@contextmanager
def open_video_writer(
    path: str | os.PathLike, fps: float = 25.0, metadata: Mapping[str, str] | None = None
) -> Iterator[Callable[[np.ndarray], None]]:
    """Write a video frame by frame, atomically. Frames are not kept in memory.

    Parameters
    ----------
    path
        The file (.mp4).
    fps
        Frames per second.
    metadata
        Header text by PNG keyword (``Comment``, ``Software``, ``Title``).

    Yields
    ------
    callable
        Function that writes the next frame (h, w, 3), uint8 sRGB, top row first. All frames have the same size. The
        sides must be even because colours have half the resolution (yuv420p, ITU-R BT.709).

    Raises
    ------
    NergError
        For sizes that cannot be encoded, and if no frame is written.
    ImportError
        If PyAV is missing.

    Notes
    -----
    Equal frames give equal files with the same version of FFmpeg.
    """
    check_video_output(fps)
    av = _import_pyav()
    container: Any = None
    stream: Any = None
    with replace_atomically(path) as temporary:
        # The name and version of the library and its bit-rate estimate are left out, so that files are reproducible.
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
                    f'"{path}" has frames of {stream.width} x {stream.height} pixels, but the next frame has {width} '
                    f"x {height}: "
                    "use the same size for all frames"
                )
            picture = av.VideoFrame.from_ndarray(frame, format="rgb24")
            picture = picture.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
            with _translate_encoding_errors(path, av):
                container.mux(stream.encode(picture))

        try:
            for key, value in (metadata or {}).items():
                container.metadata[_METADATA_KEYS.get(key, key)] = value
            yield write
            if stream is None:
                raise NergError(f'"{path}" would be a video without frames: write at least one')
            with _translate_encoding_errors(path, av):
                container.mux(stream.encode(None))
        finally:
            with _translate_encoding_errors(path, av):
                container.close()


def _open_stream(container: Any, width: int, height: int, fps: float) -> Any:
    rate = Fraction(fps).limit_denominator(1001)
    stream = container.add_stream(CODEC, rate=rate, options={"crf": _QUALITY, "preset": "medium"})
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    context = stream.codec_context
    # BT.709, limited range: without these flags, players guess them from the image size.
    context.colorspace, context.color_primaries, context.color_trc, context.color_range = 1, 1, 1, 1
    # With several threads, the file would depend on the number of cores.
    context.thread_count = 1
    return stream


def _check_size(path: str | os.PathLike, width: int, height: int) -> None:
    if width % 2 or height % 2:
        raise NergError(
            f'"{path}" would have frames of {width} x {height} pixels, but widely supported videos need even '
            "sides: change the film size by one pixel"
        )
    if not (_MIN_SIDE <= min(width, height) and max(width, height) <= _MAX_SIDE):
        raise NergError(
            f'"{path}" would have frames of {width} x {height} pixels: the sides of a video must be {_MIN_SIDE} to '
            f"{_MAX_SIDE}"
        )


@contextmanager
def _translate_encoding_errors(path: str | os.PathLike, av: Any) -> Iterator[None]:
    """Convert errors of FFmpeg on ``path`` to a `NergError`; an `OSError`, such as that of a full disk, passes
    unchanged.
    """
    try:
        yield
    except av.error.FFmpegError as error:
        if isinstance(error, OSError):
            raise
        raise NergError(
            f'"{path}" could not be encoded ({sanitize(error)}); choose another size or frame rate'
        ) from error


def _import_pyav() -> Any:
    return import_extra("av", "a video needs PyAV", "video")
