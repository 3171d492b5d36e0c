"""Readers of photos as telephones leave them, and of videos: what `nerg poses` reads before COLMAP sees it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tests.fuzz.describe import Reader

_SIZE = 64, 48
# Containers and what is in them: whether boxes, by which damage may be led; the codec; options of the writer.
_FILMS = {
    "film.mp4": (("boxes",), "mpeg4", {}),
    "parts.mp4": (("boxes",), "mpeg4", {"movflags": "frag_keyframe+empty_moov"}),
    "film.mov": (("boxes",), "libx264", {"movflags": "faststart"}),
    "film.mkv": ((), "mpeg4", {}),
    "film.avi": ((), "mjpeg", {}),
    "film.mts": ((), "libx264", {}),
    "film.mpg": ((), "mpeg2video", {}),
    "film.wmv": ((), "wmv2", {}),
}


def _pixels(k: int = 0) -> np.ndarray:
    w, h = _SIZE
    return np.kron(np.random.default_rng(k).integers(0, 255, (h // 8, w // 8, 3)), np.ones((8, 8, 1))).astype(np.uint8)


def _make_photo(name: str):
    def make(folder: Path) -> None:
        from PIL import Image

        notes = Image.Exif()
        notes[0x010F], notes[0x0110], notes[0x0112] = "Maker", "Model", 6
        details = notes.get_ifd(0x8769)
        details[0xA405], details[0x920A] = 26, 4.25
        Image.fromarray(_pixels()).save(folder / name, exif=notes)

    return make


def _read_photo(name: str):
    def read(folder: Path) -> object:
        from nerg_mi.photos.structure import encoded, read_photo, shrunk, small_size

        photo = read_photo(folder / name)
        # What is done with it where it is turned, and in any case.
        return [*(encoded(photo.image, kind) for kind in (".jpg", ".png")), shrunk(photo.image, small_size(_SIZE, 24))]

    return read


def _make_film(name: str):
    _, codec, options = _FILMS[name]

    def make(folder: Path) -> None:
        import av

        given = {"mts": "mpegts", "wmv": "asf"}.get(name.rpartition(".")[2])
        with av.open(str(folder / name), "w", format=given, options=options) as out:
            stream = out.add_stream(codec, rate=25)
            stream.width, stream.height = _SIZE
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            if codec == "libx264":
                stream.options = {"preset": "ultrafast", "x264-params": "log-level=none"}
            for k in range(6):
                out.mux(stream.encode(av.VideoFrame.from_ndarray(_pixels(k), format="rgb24")))
            out.mux(stream.encode())

    return make


def _read_film(name: str):
    def read(folder: Path) -> object:
        from PIL import Image

        from nerg_mi.photos.structure import encoded, shrunk, small_size
        from nerg_mi.photos.video_frames import sharpest_frames

        # By itself the decoder starts as many threads as there are cores.
        frames = [Image.fromarray(frame.pixels) for frame in sharpest_frames(folder / name, 3, threads=2)]
        return [(encoded(f, ".jpg"), shrunk(f, small_size(f.size, 24))) for f in frames]

    return read


STRUCTURE = [
    *(
        Reader(f"photo {name}", _make_photo(name), {name: kinds}, _read_photo(name), needs="PIL")
        for name, kinds in (("a.jpg", ()), ("a.png", ("png",)))
    ),
    *(
        Reader(f"video {name}", _make_film(name), {name: kinds}, _read_film(name), needs="av")
        for name, (kinds, _, _) in _FILMS.items()
    ),
]
