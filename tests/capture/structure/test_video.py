"""Frames of a video that is made here: sharp ones among blurred ones, turned as they are to be shown."""

from __future__ import annotations

import builtins
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from nerg_mi.capture.structure import video as module
from nerg_mi.capture.structure.pictures import Folders
from nerg_mi.capture.structure.video import copy_frames, sharpest_frames, sharpness
from nerg_mi.errors import NergError

SHARP = (3, 8, 11)


def texture() -> np.ndarray:
    return np.kron(np.random.default_rng(0).uniform(30, 220, (12, 16)), np.ones((4, 4)))


@pytest.fixture(scope="module")
def av():
    return pytest.importorskip("av", reason='PyAV is not installed (pip install "nerg-mi[poses]")')


@pytest.fixture
def film(av, tmp_path) -> Path:
    """15 frames of 64 x 48 pixels at 10 a second; all but those of `SHARP` are blurred, and each has its own grey."""
    path = tmp_path / "film.mp4"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 64, 48, "yuv420p", 4_000_000
        for k in range(15):
            gray = texture() if k in SHARP else gaussian_filter(texture(), 2)
            frame = av.VideoFrame.from_ndarray(np.repeat(gray[..., None], 3, axis=2).astype(np.uint8), format="rgb24")
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
    return path


def test_blur_takes_sharpness():
    assert sharpness(texture()) > 10 * sharpness(gaussian_filter(texture(), 2))
    assert sharpness(np.full((5, 5), 7)) == 0


def test_the_sharpest_of_each_stretch(film):
    found = list(sharpest_frames(film, 3))
    assert [round(10 * t) for t, _ in found] == list(SHARP)
    for _, pixels in found:
        assert pixels.shape == (48, 64, 3) and pixels.dtype == np.uint8
        assert np.corrcoef(pixels[..., 1].ravel(), texture().ravel())[0, 1] > 0.97


def test_more_stretches_than_frames(film):
    times = [t for t, _ in sharpest_frames(film, 100, threads=1)]
    assert len(times) == 15 and times == sorted(times)


def test_frames_are_copied(film, tmp_path):
    folders, steps = Folders(tmp_path / "images", tmp_path / "small"), []
    pictures = copy_frames(film, 3, folders, 32, None, lambda *now: steps.append(now))
    assert [p.name for p in pictures] == ["frame_00001.jpg", "frame_00002.jpg", "frame_00003.jpg"]
    assert [p.small for p in pictures] == [(32, 24)] * 3 and steps == [(1, 3), (2, 3), (3, 3)]
    assert [Image.open(folders.images / p.name).size for p in pictures] == [(64, 48)] * 3
    assert len(list(folders.small.iterdir())) == 3 and pictures[1].seconds == pytest.approx(0.8)


@pytest.mark.parametrize("rotation, corner", [(0, (0, 0)), (90, (1, 0)), (-90, (0, 1)), (180, (1, 1)), (-180, (1, 1))])
def test_frames_are_turned_as_they_are_shown(rotation, corner):
    """The display matrix says by how much a frame is turned, counterclockwise."""
    pixels = np.zeros((4, 6, 3), np.uint8)
    pixels[0, 0] = 255
    frame = SimpleNamespace(to_ndarray=lambda format: pixels, rotation=rotation, time=3.0)
    seconds, out = module._finished(frame, 1.0)
    assert seconds == 2 and out.shape[:2] == ((6, 4) if abs(rotation) == 90 else (4, 6))
    assert out[-1 * corner[0], -1 * corner[1], 0] == 255


def test_what_is_no_video_is_told(av, tmp_path, film):
    (tmp_path / "a.mp4").write_text("not a film")
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "one.jpg")
    raw = film.read_bytes()
    (tmp_path / "cut.mp4").write_bytes(raw[: len(raw) // 2])
    for name, said in (
        ("a.mp4", "cannot be read.*give a video"),
        ("one.jpg", "is a single photo; name the folder"),
        ("cut.mp4", "cannot be read"),
        ("nowhere.mp4", "there is no video"),
    ):
        with pytest.raises(NergError, match=said):
            list(sharpest_frames(tmp_path / name, 3))


def test_sound_alone_is_no_video(av, tmp_path):
    with av.open(str(tmp_path / "a.wav"), "w") as out:
        stream = out.add_stream("pcm_s16le", rate=8000)
        stream.layout = "mono"
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.sample_rate = 8000
        out.mux(stream.encode(frame))
    with pytest.raises(NergError, match="only sound"):
        list(sharpest_frames(tmp_path / "a.wav", 3))


def test_frames_may_not_be_too_large(film, monkeypatch):
    monkeypatch.setattr(module, "PIXELS", 64 * 48 - 1)
    with pytest.raises(NergError, match="64 x 48 pixels, and at most 3,071"):
        list(sharpest_frames(film, 3))


def test_a_damaged_stretch_is_passed_over(film, tmp_path):
    raw = bytearray(film.read_bytes())
    at = raw.index(b"mdat") + 4
    middle = at + (len(raw) - at) // 3
    raw[middle : middle + 200] = bytes(200)
    (tmp_path / "b.mp4").write_bytes(raw)
    assert len(list(sharpest_frames(tmp_path / "b.mp4", 3))) == 3


def test_without_pyav(tmp_path, monkeypatch):
    original = builtins.__import__

    def no_av(name, *given, **more):
        if name == "av":
            raise ImportError(name="av")
        return original(name, *given, **more)

    monkeypatch.setattr(builtins, "__import__", no_av)
    with pytest.raises(ImportError, match=r"PyAV, which is not installed: pip install \"nerg-mi\[poses\]\""):
        list(sharpest_frames(tmp_path / "a.mp4", 3))
