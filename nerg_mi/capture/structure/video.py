"""Frames of a video: the sharpest one of each of equally long stretches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.atomic import write_bytes
from nerg_mi.files.bounded import reading, size_of
from nerg_mi.files.image_header import PIXELS

from .photos import SUFFIXES
from .pictures import Folders, Picture, encoded, shrunk, small_name, small_size

# Sharpness is compared at this width: finer, it would be the noise of dark places.
_WIDTH = 480


def sharpness(gray: np.ndarray) -> float:
    """Variance of the Laplacian of a picture (h, w): blur takes away what varies from pixel to pixel."""
    g = np.asarray(gray, np.float32)
    inner = g[1:-1, 1:-1]
    return float(np.var(g[:-2, 1:-1] + g[2:, 1:-1] + g[1:-1, :-2] + g[1:-1, 2:] - 4 * inner))


def copy_frames(
    video: str | Path,
    count: int,
    folders: Folders,
    longest: int,
    threads: int | None,
    progress: Callable[[int, int], None],
) -> list[Picture]:
    """Copy ``count`` frames of a video, at most, to ``folders``: as JPEG at quality 95, turned as it is to be shown.

    ``longest``: side of the small copies in pixels; ``threads``: of the decoder, None for all; ``progress(done, of)``
    is told as frames are chosen. Raises `NergError` for what is no video, and ``ImportError`` without PyAV.
    """
    from PIL import Image

    pictures: list[Picture] = []
    for seconds, pixels in sharpest_frames(video, count, threads):
        image = Image.fromarray(pixels)
        name = f"frame_{len(pictures) + 1:05d}.jpg"
        write_bytes(folders.images / name, encoded(image, ".jpg"))
        small = small_size(image.size, longest)
        write_bytes(folders.small / small_name(len(pictures)), shrunk(image, small))
        pictures.append(Picture(name, image.size, small, seconds=seconds))
        progress(len(pictures), count)
    return pictures


def sharpest_frames(video: str | Path, count: int, threads: int | None = None) -> Iterator[tuple[float, np.ndarray]]:
    """Seconds from the first frame on, and pixels (h, w, 3) uint8, sRGB, of the sharpest frame in each of ``count``
    equally long stretches; a stretch without a frame has none."""
    if Path(video).suffix.lower() in SUFFIXES:
        raise NergError(f'"{video}" is a single photo; name the folder that holds it and others of the same place')
    begin, end = _span(video)
    with closing(_open(video)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        if threads:
            stream.codec_context.thread_count = threads
        best: tuple[float, Any] | None = None
        stretch = 0
        for frame in _decoded(video, container, stream):
            at = 0 if end <= begin else min(count - 1, int((frame.time - begin) / (end - begin) * count))
            if best is not None and at > stretch:
                yield _finished(best[1], begin)
                best = None
            stretch = max(stretch, at)
            score = sharpness(_gray(frame))
            if best is None or score > best[0]:
                best = score, frame
        if best is None:
            raise NergError(f'no frame of the video "{video}" can be decoded; convert it to H.264, or copy it again')
        yield _finished(best[1], begin)


def _pyav() -> Any:
    try:
        import av
    except ImportError:
        raise ImportError('frames of a video need PyAV, which is not installed: pip install "nerg-mi[poses]"') from None
    return av


def _open(video: str | Path) -> Any:
    av = _pyav()
    size_of(video, "video")
    with reading(video, "video", "give a video such as .mp4 or .mov, or a folder of photos", also=(av.FFmpegError,)):
        container = av.open(str(video))
        if not container.streams.video:
            container.close()
            raise NergError(f'"{video}" has no pictures, only sound; give a video, or a folder of photos')
        context = container.streams.video[0].codec_context
        _check_size(video, context.width, context.height)
        return container


def _check_size(video: str | Path, width: int, height: int) -> None:
    if width * height > PIXELS:
        raise NergError(
            f'the video "{video}" has {width:,} x {height:,} pixels, and at most {PIXELS:,} are read; make it smaller'
        )


def _span(video: str | Path) -> tuple[float, float]:
    """Seconds at which the first and the last frame are shown, by the file's packets, undecoded."""
    av = _pyav()
    with closing(_open(video)) as container:
        stream = container.streams.video[0]
        with reading(video, "video", also=(av.FFmpegError,)):
            shown = [p.pts for p in container.demux(stream) if p.pts is not None]
        if not shown:
            raise NergError(f'the video "{video}" holds no frames; copy it again')
        return float(min(shown) * stream.time_base), float(max(shown) * stream.time_base)


def _decoded(video: str | Path, container: Any, stream: Any) -> Iterator[Any]:
    """Frames with a time; packets that are damaged are passed over, as players do."""
    av = _pyav()
    packets = container.demux(stream)
    while True:
        with reading(video, "video", also=(av.FFmpegError,)):
            packet = next(packets, None)
        if packet is None:
            return
        try:
            frames = packet.decode()
        except av.FFmpegError:
            continue
        for frame in frames:
            if frame.time is not None:
                _check_size(video, frame.width, frame.height)
                yield frame


def _gray(frame: Any) -> np.ndarray:
    width = min(_WIDTH, frame.width)
    height = max(3, round(frame.height * width / frame.width))
    return frame.to_ndarray(format="gray", width=width, height=height, interpolation="AREA")


def _finished(frame: Any, begin: float) -> tuple[float, np.ndarray]:
    pixels = frame.to_ndarray(format="rgb24")
    return frame.time - begin, np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90)))
