"""Frames of a video: the sharpest one of each of equally long stretches."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from nerg_mi.errors import NergError, import_extra
from nerg_mi.files.atomic import write_bytes
from nerg_mi.files.safe_read import translate_read_errors, check_regular_file
from nerg_mi.files.video import check_video_tables

from .structure import MAX_SIDE, PHOTO_SUFFIXES, PhotoFolders, PhotoCopy, encode_image, encode_small_image, small_file_name, fit_size

FORMATS = ("mov", "matroska", "avi", "mpegts", "mpeg", "asf")
"""Kinds of files, as FFmpeg calls them, that are taken for videos: of .mp4 and .mov; .mkv and .webm; .avi; .mts; .mpg;
.wmv. Its others are pictures, sound and text, or lists of further files and addresses, which it would open."""

CODECS = (
    "h264 hevc vvc av1 libdav1d vp8 libvpx vp9 libvpx-vp9 mpeg4 msmpeg4v1 msmpeg4v2 msmpeg4 mpeg1video mpeg2video "
    "mpegvideo h263 h263i h263p flv mjpeg wmv1 wmv2 wmv3 vc1 prores dnxhd cfhd dvvideo ffv1 rawvideo"
).split()
"""Decoders, as FFmpeg calls them, that may run: those of cameras, phones and converters, of its three hundred."""

MAX_BYTES = 16 << 30
"""A file may have so many bytes: FFmpeg looks through all of those that it does not understand."""

MAX_PIXELS = 8192 * 4320
"""A frame may have so many: no camera films more, and a decoder holds many frames at a time."""

# Sharpness is compared at this width: finer, it would be the noise of dark places. And at so many times it in height.
_WIDTH, _TALLEST = 480, 4
# So many packets may give no frame, and so many for each frame that was found: beyond, a video is destroyed.
_LOST, _LOST_EACH = 1000, 4
_REMEDY = "give a video such as .mp4 or .mov, or a folder of photos"


class SharpFrame(NamedTuple):
    """A frame of a video: its number in the order in which frames are shown, from 1, the seconds since the first one,
    and its pixels (h, w, 3), uint8, sRGB."""

    number: int
    seconds: float
    pixels: np.ndarray


def compute_sharpness(gray: np.ndarray) -> float:
    """Variance of the Laplacian of a picture (h, w): blur takes away what varies from pixel to pixel."""
    g = np.asarray(gray, np.float32)
    inner = g[1:-1, 1:-1]
    return float(np.var(g[:-2, 1:-1] + g[2:, 1:-1] + g[1:-1, :-2] + g[1:-1, 2:] - 4 * inner))


def copy_frames(
    video: str | Path,
    count: int,
    folders: PhotoFolders,
    max_side: int,
    threads: int | None,
    on_progress: Callable[[int, int], None],
) -> list[PhotoCopy]:
    """Copy ``count`` frames of a video, at most, to ``folders``: as JPEG at quality 95, turned as it is to be shown.

    Each is named by its number among all frames of the video, as ``nerg rays import --frames "frame_{frame1}"`` counts.
    ``longest``: side of the small copies in pixels; ``threads``: of the decoder, None for all; ``progress(done, of)``
    is told as frames are chosen. Raises `NergError` for what is no video, and ``ImportError`` without PyAV.
    """
    from PIL import Image

    pictures: list[PhotoCopy] = []
    for frame in select_sharpest_frames(video, count, threads):
        image = Image.fromarray(frame.pixels)
        name = f"frame_{frame.number:06d}.jpg"
        write_bytes(folders.images / name, encode_image(image, ".jpg"))
        small = fit_size(image.size, max_side)
        write_bytes(folders.small_images / small_file_name(len(pictures)), encode_small_image(image, small))
        pictures.append(PhotoCopy(name, image.size, small, seconds=frame.seconds))
        on_progress(len(pictures), count)
    return pictures


def select_sharpest_frames(video: str | Path, count: int, threads: int | None = None) -> Iterator[SharpFrame]:
    """The sharpest frame in each of ``count`` equally long stretches; a stretch without a frame has none."""
    if Path(video).suffix.lower() in PHOTO_SUFFIXES:
        raise NergError(f'"{video}" is a single photo; name the folder that holds it and others of the same place')
    ticks, tick = _frame_ticks(video)
    begin, span = int(ticks[0]), int(ticks[-1] - ticks[0])
    as_shown = lambda frame: SharpFrame(
        int(np.searchsorted(ticks, frame.pts)) + 1, float((frame.pts - begin) * tick), _pixels(video, frame)
    )
    with _opened(video) as (container, stream):
        stream.thread_type = "AUTO"
        if threads:
            stream.codec_context.thread_count = threads
        best: tuple[float, Any] | None = None
        stretch = 0
        for frame in _decoded(video, container, stream):
            at = min(count - 1, (frame.pts - begin) * count // span) if span else 0
            if best is not None and at > stretch:
                yield as_shown(best[1])
                best = None
            stretch = max(stretch, at)
            with _reading(video):
                score = compute_sharpness(_gray(frame))
            if best is None or score > best[0]:
                best = score, frame
        if best is None:
            raise NergError(
                f'the video "{video}" has no frame that can be decoded, of {MAX_PIXELS:,} pixels at most; convert it to '
                "H.264, or copy it again"
            )
        yield as_shown(best[1])


def _pyav() -> Any:
    return import_extra("av", "frames of a video need PyAV", "poses")


@contextmanager
def _reading(video: str | Path) -> Iterator[None]:
    """A block in which FFmpeg reads ``video``: what it says, as one sentence, without its number of the error."""
    av = _pyav()
    with translate_read_errors(video, "video", _REMEDY):
        try:
            yield
        except av.FFmpegError as error:
            said = error.strerror or "it is damaged"
            # The formats of the list are no argument of the user's. For more than 2 GB at once FFmpeg does not ask.
            said = {
                errno.EINVAL: "it is no video of a kind that is read",
                errno.ENOMEM: "it claims to be larger than there is memory for",
            }.get(error.errno, said[:1].lower() + said[1:])
            raise ValueError(said) from error


def _nothing_else(url: str, flags: int, options: dict) -> Any:
    raise ValueError("it refers to other files")


class _Source:
    """An open file for FFmpeg, without its name, which would take part in what it is taken for."""

    def __init__(self, file: BinaryIO):
        self.read, self.tell, self._file = file.read, file.tell, file

    def seek(self, offset: int, whence: int = 0) -> int:
        """As `io.IOBase.seek`; below 0 for a place that there is not, which FFmpeg tries at times."""
        try:
            return self._file.seek(offset, whence)
        except (OSError, ValueError, OverflowError):
            return -errno.EINVAL


@contextmanager
def _opened(video: str | Path) -> Iterator[tuple[Any, Any]]:
    """The container of ``video`` and its first stream of pictures.

    FFmpeg is given the open file, since it takes names such as "12:30.mp4" for addresses; it may open nothing else.
    """
    check_regular_file(video, "video", MAX_BYTES)
    av = _pyav()
    with _reading(video):
        check_video_tables(video)
        file = open(video, "rb")
    with file:
        limits = {"max_pixels": str(MAX_PIXELS), "codec_whitelist": ",".join(CODECS)}
        with _reading(video):
            container = av.open(
                _Source(file),
                "r",
                io_open=_nothing_else,
                options=limits,
                container_options={"format_whitelist": ",".join(FORMATS), "protocol_whitelist": "none"},
                # Titles are written in many alphabets.
                metadata_errors="replace",
            )
        with container:
            if not container.streams.video:
                raise NergError(f'"{video}" has no pictures, only sound; give a video, or a folder of photos')
            stream = container.streams.video[0]
            if stream.codec_context is None:
                raise NergError(f'the video "{video}" is coded in a way that is not known; convert it to H.264')
            _check_size(video, stream.codec_context.width, stream.codec_context.height)
            stream.codec_context.options = limits
            yield container, stream


def _check_size(video: str | Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE:
        raise NergError(
            f'the video "{video}" has {width:,} x {height:,} pixels, and at most {MAX_PIXELS:,} are read, a side of at '
            f"most {MAX_SIDE:,}; make it smaller"
        )


def _frame_ticks(video: str | Path) -> tuple[np.ndarray, Fraction]:
    """When each frame is shown (F,) int64, sorted, by the file's packets, undecoded; and the seconds of a tick."""
    with _opened(video) as (container, stream):
        with _reading(video):
            ticks = {p.pts for p in container.demux(stream) if p.pts is not None and not p.is_discard}
        if not ticks or not stream.time_base:
            raise NergError(f'the video "{video}" holds no frames with a time; copy it again')
        return np.array(sorted(ticks), np.int64), stream.time_base


def _decoded(video: str | Path, container: Any, stream: Any) -> Iterator[Any]:
    """Frames that have a time, in ticks of the ``stream``; packets that are damaged are passed over, as players do."""
    av = _pyav()
    packets = container.demux(stream)
    lost = found = 0
    while lost <= _LOST + _LOST_EACH * found:
        with _reading(video):
            packet = next(packets, None)
        if packet is None:
            return
        try:
            frames = packet.decode()
        except av.FFmpegError:
            frames = []
        for frame in frames:
            _check_size(video, frame.width, frame.height)
            if frame.pts is not None and frame.time_base == stream.time_base:
                yield frame
        found += len(frames)
        lost += not frames
    raise NergError(f'most of the video "{video}" cannot be decoded; convert it to H.264, or copy it again')


def _gray(frame: Any) -> np.ndarray:
    """The frame in gray, at most `_WIDTH` wide and `_TALLEST` times as high."""
    width = max(3, min(_WIDTH, frame.width))
    height = min(max(3, round(frame.height * width / frame.width)), _TALLEST * _WIDTH)
    return frame.to_ndarray(format="gray", width=width, height=height, interpolation="AREA")


def _pixels(video: str | Path, frame: Any) -> np.ndarray:
    """The frame (h, w, 3) as it is to be looked at."""
    with _reading(video):
        pixels = frame.to_ndarray(format="rgb24")
        return np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90)))
