"""Selection of video frames: the sharpest one of each of several equally long segments."""

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
from nerg_mi.files.safe_read import check_regular_file, translate_read_errors
from nerg_mi.files.video import check_video_tables

from .structure import (
    MAX_SIDE,
    PHOTO_SUFFIXES,
    PhotoCopy,
    PhotoFolders,
    encode_image,
    encode_small_image,
    fit_size,
    small_file_name,
)

FORMATS = ("mov", "matroska", "avi", "mpegts", "mpeg", "asf")
"""FFmpeg names of the supported container formats: .mp4 and .mov; .mkv and .webm; .avi; .mts; .mpg; .wmv. The other
formats of FFmpeg are images, audio and text, or playlists of files and addresses that FFmpeg would open."""

CODECS = (
    "h264 hevc av1 libdav1d vp8 libvpx vp9 libvpx-vp9 mpeg4 msmpeg4v1 msmpeg4v2 msmpeg4 mpeg1video mpeg2video "
    "mpegvideo h263 h263i h263p flv mjpeg wmv1 wmv2 wmv3 vc1 prores dnxhd cfhd dvvideo ffv1 rawvideo"
).split()
"""FFmpeg names of the decoders that may run: those of cameras, phones and converters. FFmpeg has about three
hundred. That of VVC writes out of bounds before FFmpeg 8.1.3 (CVE-2026-125244), which PyAV 18.1 does not have."""

MAX_BYTES = 16 << 30
"""Maximum size of a file in bytes, because FFmpeg scans all data that it does not understand."""

MAX_PIXELS = 8192 * 4320
"""Maximum number of pixels of a frame. No camera records more, and a decoder buffers many frames."""

# Width at which sharpness is compared, because noise dominates at full resolution, and maximum height relative to it.
_COMPARISON_WIDTH, _MAX_ASPECT = 480, 4
# Maximum number of packets without a frame: a constant, plus a number for each decoded frame. Beyond it, decoding
# fails.
_MAX_LOST_PACKETS, _MAX_LOST_PER_FRAME = 1000, 4
_REMEDY = "use a video such as .mp4 or .mov, or a folder of photos"


class SharpFrame(NamedTuple):
    """A frame of a video.

    Attributes
    ----------
    number
        Frame number in presentation order, from 1.
    seconds
        Time since the first frame.
    pixels
        (h, w, 3) uint8, sRGB.
    """

    number: int
    seconds: float
    pixels: np.ndarray


def compute_sharpness(gray: np.ndarray) -> float:
    """Compute the variance of the Laplacian of an image (h, w), which decreases with blur."""
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
    """Copy at most ``count`` frames of a video to ``folders`` as upright JPEG files with quality 95.

    Files are named by the frame number in the video, as in ``nerg rays import --frames "frame_{frame1}"``.

    Parameters
    ----------
    video
        The video file.
    count
        Number of segments, from each of which the sharpest frame is copied.
    folders
        Destination folders.
    max_side
        Maximum side of the small copies in pixels.
    threads
        Threads of the decoder; None for all.
    on_progress
        Callback ``on_progress(done, total)``.

    Raises
    ------
    NergError
        For another file.
    ImportError
        If PyAV is missing.
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
    """Yield the sharpest frame of each of ``count`` equally long segments. A segment without frames yields nothing."""
    if Path(video).suffix.lower() in PHOTO_SUFFIXES:
        raise NergError(f'"{video}" is a single photo; specify a folder with several photos of the same environment')
    ticks, tick = _read_frame_ticks(video)
    first_tick, span = int(ticks[0]), int(ticks[-1] - ticks[0])
    make_sharp_frame = lambda frame: SharpFrame(
        int(np.searchsorted(ticks, frame.pts)) + 1,
        float((frame.pts - first_tick) * tick),
        _to_upright_pixels(video, frame),
    )
    with _open_video(video) as (container, stream):
        stream.thread_type = "AUTO"
        if threads:
            stream.codec_context.thread_count = threads
        best: tuple[float, Any] | None = None
        current_segment = 0
        for frame in _iter_decoded_frames(video, container, stream):
            segment = min(count - 1, (frame.pts - first_tick) * count // span) if span else 0
            if best is not None and segment > current_segment:
                yield make_sharp_frame(best[1])
                best = None
            current_segment = max(current_segment, segment)
            with _translate_video_errors(video):
                score = compute_sharpness(_to_gray(frame))
            if best is None or score > best[0]:
                best = score, frame
        if best is None:
            raise NergError(
                f'the video "{video}" has no frame that can be decoded, of {MAX_PIXELS:,} pixels at most; convert it '
                "to "
                "H.264, or copy it again"
            )
        yield make_sharp_frame(best[1])


def _import_pyav() -> Any:
    return import_extra("av", "frames of a video need PyAV", "poses")


@contextmanager
def _translate_video_errors(video: str | Path) -> Iterator[None]:
    """Convert errors of FFmpeg on ``video`` in the block to a one-sentence error without FFmpeg's error number."""
    av = _import_pyav()
    with translate_read_errors(video, "video", _REMEDY):
        try:
            yield
        except av.FFmpegError as error:
            message = error.strerror or "it is damaged"
            # EINVAL refers to the list of formats, which the user does not know. FFmpeg returns ENOMEM above 2 GB.
            message = {
                errno.EINVAL: "its video format is not supported",
                errno.ENOMEM: "its header claims a size that exceeds the available memory",
            }.get(error.errno, message[:1].lower() + message[1:])
            raise ValueError(message) from error


def _refuse_other_files(url: str, flags: int, options: dict) -> Any:
    raise ValueError("it refers to other files")


class _Source:
    """An open file for FFmpeg without a name, because FFmpeg also uses the name to guess the format."""

    def __init__(self, file: BinaryIO):
        self.read, self.tell, self._file = file.read, file.tell, file

    def seek(self, offset: int, whence: int = 0) -> int:
        """As `io.IOBase.seek`, but returns a negative number for an invalid position, which FFmpeg tries at times."""
        try:
            return self._file.seek(offset, whence)
        except (OSError, ValueError, OverflowError):
            return -errno.EINVAL


@contextmanager
def _open_video(video: str | Path) -> Iterator[tuple[Any, Any]]:
    """Open the container of ``video`` and its first video stream.

    FFmpeg receives the open file, because it interprets names such as "12:30.mp4" as addresses. It may not open other
    files.
    """
    check_regular_file(video, "video", MAX_BYTES)
    av = _import_pyav()
    with _translate_video_errors(video):
        check_video_tables(video)
        file = open(video, "rb")
    with file:
        limits = {"max_pixels": str(MAX_PIXELS), "codec_whitelist": ",".join(CODECS)}
        with _translate_video_errors(video):
            container = av.open(
                _Source(file),
                "r",
                io_open=_refuse_other_files,
                options=limits,
                container_options={"format_whitelist": ",".join(FORMATS), "protocol_whitelist": "none"},
                # Titles may have any encoding.
                metadata_errors="replace",
            )
        with container:
            if not container.streams.video:
                raise NergError(f'"{video}" contains no video, only audio; use a video, or a folder of photos')
            stream = container.streams.video[0]
            if stream.codec_context is None:
                raise NergError(f'the video "{video}" has an unknown codec; convert it to H.264')
            _check_size(video, stream.codec_context.width, stream.codec_context.height)
            stream.codec_context.options = limits
            yield container, stream


def _check_size(video: str | Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS or max(width, height) > MAX_SIDE:
        raise NergError(
            f'the video "{video}" has {width:,} x {height:,} pixels; the limit is {MAX_PIXELS:,}, with a side of at '
            f"most {MAX_SIDE:,}; reduce its resolution"
        )


def _read_frame_ticks(video: str | Path) -> tuple[np.ndarray, Fraction]:
    """Return the presentation times (F,) int64 of the frames, sorted, from the undecoded packets, and the seconds
    per tick.
    """
    with _open_video(video) as (container, stream):
        with _translate_video_errors(video):
            ticks = {p.pts for p in container.demux(stream) if p.pts is not None and not p.is_discard}
        if not ticks or not stream.time_base:
            raise NergError(f'the video "{video}" contains no frames with a timestamp; copy it again')
        return np.array(sorted(ticks), np.int64), stream.time_base


def _iter_decoded_frames(video: str | Path, container: Any, stream: Any) -> Iterator[Any]:
    """Iterate over decoded frames with a time in ticks of ``stream``. Damaged packets are skipped, as players do."""
    av = _import_pyav()
    packets = container.demux(stream)
    num_lost = num_decoded = 0
    while num_lost <= _MAX_LOST_PACKETS + _MAX_LOST_PER_FRAME * num_decoded:
        with _translate_video_errors(video):
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
        num_decoded += len(frames)
        num_lost += not frames
    raise NergError(f'most of the video "{video}" cannot be decoded; convert it to H.264, or copy it again')


def _to_gray(frame: Any) -> np.ndarray:
    """Convert a frame to grey, at most `_COMPARISON_WIDTH` wide and `_MAX_ASPECT` times as high."""
    width = max(3, min(_COMPARISON_WIDTH, frame.width))
    height = min(max(3, round(frame.height * width / frame.width)), _MAX_ASPECT * _COMPARISON_WIDTH)
    return frame.to_ndarray(format="gray", width=width, height=height, interpolation="AREA")


def _to_upright_pixels(video: str | Path, frame: Any) -> np.ndarray:
    """Convert a frame to upright pixels (h, w, 3)."""
    with _translate_video_errors(video):
        pixels = frame.to_ndarray(format="rgb24")
        return np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90)))
