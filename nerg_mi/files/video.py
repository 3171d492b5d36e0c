"""Videos that play everywhere, written frame by frame: H.264 in MP4, whole or absent."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, plain

from .atomic import replacing

CODEC = "libx264"

_QUALITY = "17"  # x264's constant rate factor: no difference is seen from about 18 down
_MOST_FPS = 1000.0
_LEAST, _MOST = 16, 8192
_NAMES = {"Software": "artist", "Comment": "comment", "Title": "title"}


def check_video(fps: float) -> None:
    """Raise `NergError` for an ``fps`` that is no rate, and `ImportError` where PyAV is missing: before long work."""
    _pyav()
    if not (np.isfinite(fps) and 0 < fps <= _MOST_FPS):
        raise NergError(f"a video has up to {_MOST_FPS:.0f} pictures a second, and {fps} were asked for; give --fps 25")


@contextmanager
def video_frames(
    path: str | os.PathLike, fps: float = 25.0, text: Mapping[str, str] | None = None
) -> Iterator[Callable[[np.ndarray], None]]:
    """A video of ``fps`` pictures a second, which are not kept in memory.

    Gives a function that writes the next frame (h, w, 3), uint8 sRGB, rows from the top; all have one size. Sides are
    even, since colours have half the resolution (yuv420p, ITU-R BT.709): nothing is resized. ``text``: what
    the header says, by PNG's names (``Comment``, ``Software``). Equal frames give equal files with the same FFmpeg.
    Raises `NergError` for sizes that cannot be shown and for no frames at all, `ImportError` where PyAV is missing.
    """
    check_video(fps)
    av = _pyav()
    container: Any = None
    stream: Any = None
    with replacing(path) as temporary:
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
            for key, value in (text or {}).items():
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
        raise NergError(f'"{path}" could not be encoded ({plain(error)}); choose another size or rate') from error


def _pyav() -> Any:
    try:
        import av
    except ImportError:
        raise ImportError('a video needs PyAV, which is not installed: pip install "nerg-mi[video]"') from None
    return av
