"""Frames of a synthetic video: sharp frames among blurred ones, in upright orientation."""

from __future__ import annotations

import socket
import sys
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from nerg_mi.errors import NergError
from nerg_mi.photos import video_frames as module
from nerg_mi.photos.structure import PhotoFolders
from nerg_mi.photos.video_frames import compute_sharpness, copy_frames, select_sharpest_frames

SHARP = (3, 8, 11)


def make_texture() -> np.ndarray:
    return np.kron(np.random.default_rng(0).uniform(30, 220, (12, 16)), np.ones((4, 4)))


@pytest.fixture(scope="module")
def av():
    return pytest.importorskip("av", reason='PyAV is not installed (pip install "nerg-mi[poses]")')


@pytest.fixture
def film(av, tmp_path) -> Path:
    """15 frames of 64 x 48 pixels at 10 per second; all except `SHARP` are blurred, and each has its own grey."""
    path = tmp_path / "film.mp4"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 64, 48, "yuv420p", 4_000_000
        for k in range(15):
            gray = make_texture() if k in SHARP else gaussian_filter(make_texture(), 2)
            frame = av.VideoFrame.from_ndarray(np.repeat(gray[..., None], 3, axis=2).astype(np.uint8), format="rgb24")
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
    return path


def remux(av, film, path, **metadata):
    """Copy the encoded frames of ``film`` to another container."""
    with av.open(str(film)) as source, av.open(str(path), "w") as out:
        out.metadata.update(metadata)
        stream = out.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                out.mux(packet)


def test_blur_reduces_sharpness():
    assert compute_sharpness(make_texture()) > 10 * compute_sharpness(gaussian_filter(make_texture(), 2))
    assert compute_sharpness(np.full((5, 5), 7)) == 0


def test_sharpest_frame_of_each_segment(film):
    frames = list(select_sharpest_frames(film, 3))
    assert [round(10 * frame.seconds) for frame in frames] == list(SHARP)
    for *_, pixels in frames:
        assert pixels.shape == (48, 64, 3) and pixels.dtype == np.uint8
        assert np.corrcoef(pixels[..., 1].ravel(), make_texture().ravel())[0, 1] > 0.97


def test_more_segments_than_frames(film):
    times = [frame.seconds for frame in select_sharpest_frames(film, 100, threads=1)]
    assert len(times) == 15 and times == sorted(times)


def test_frames_are_copied(film, tmp_path):
    folders, steps = PhotoFolders(tmp_path / "images", tmp_path / "small"), []
    pictures = copy_frames(film, 3, folders, 32, None, lambda *now: steps.append(now))
    assert [p.name for p in pictures] == [f"frame_{k + 1:06d}.jpg" for k in SHARP]
    assert [p.small_size for p in pictures] == [(32, 24)] * 3 and steps == [(1, 3), (2, 3), (3, 3)]
    assert [Image.open(folders.images / p.name).size for p in pictures] == [(64, 48)] * 3
    assert len(list(folders.small_images.iterdir())) == 3 and pictures[1].seconds == pytest.approx(0.8)


@pytest.mark.parametrize("name, codec", [("a.mkv", "mpeg4"), ("a.ts", "mpeg2video"), ("a.mp4", "mpeg4")])
@pytest.mark.parametrize("times", [range(6), [0, 1, 2, 5, 6, 9], [4, 7, 8, 9, 11, 12]])
def test_frames_are_numbered_in_presentation_order(av, tmp_path, name, codec, times):
    """With reordered frames, missing frames and a late first frame."""
    with av.open(str(tmp_path / name), "w") as out:
        stream = out.add_stream(codec, rate=25, options={"bf": "2"})
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 64, 48, "yuv420p", 4_000_000
        for k, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 30 + 30 * k, np.uint8), format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 25)
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
    frames = list(select_sharpest_frames(tmp_path / name, 1000, threads=1))
    assert [f.number for f in frames] == [round(f.pixels.mean() / 30) for f in frames] == list(range(1, 7))
    assert np.allclose([f.seconds for f in frames], (np.array(times) - times[0]) / 25, atol=2e-3)


@pytest.mark.parametrize("rotation, corner", [(0, (0, 0)), (90, (1, 0)), (-90, (0, 1)), (180, (1, 1)), (-180, (1, 1))])
def test_frames_are_rotated_upright(rotation, corner, av):
    """The display matrix contains the counterclockwise rotation of a frame."""
    pixels = np.zeros((4, 6, 3), np.uint8)
    pixels[0, 0] = 255
    frame = SimpleNamespace(to_ndarray=lambda format: pixels, rotation=rotation)
    out = module._to_upright_pixels("film.mp4", frame)
    assert out.shape[:2] == ((6, 4) if abs(rotation) == 90 else (4, 6))
    assert out[-1 * corner[0], -1 * corner[1], 0] == 255


def test_other_files_are_refused(av, tmp_path, film):
    (tmp_path / "a.mp4").write_text("not a film")
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "one.jpg")
    raw = film.read_bytes()
    (tmp_path / "cut.mp4").write_bytes(raw[: len(raw) // 2])
    for name, said in (
        ("a.mp4", "cannot be read.*use a video"),
        ("one.jpg", "is a single photo; specify a folder"),
        ("cut.mp4", "cannot be read"),
        ("nowhere.mp4", "there is no video"),
    ):
        with pytest.raises(NergError, match=said):
            list(select_sharpest_frames(tmp_path / name, 3))


def test_audio_file_is_refused(av, tmp_path):
    with av.open(str(tmp_path / "a.mp4"), "w") as out:
        stream = out.add_stream("aac", rate=8000)
        stream.layout = "mono"
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 8000
        out.mux([*stream.encode(frame), *stream.encode()])
    with pytest.raises(NergError, match="only audio"):
        list(select_sharpest_frames(tmp_path / "a.mp4", 3))


def test_frame_size_is_limited(film, monkeypatch):
    monkeypatch.setattr(module, "MAX_PIXELS", 64 * 48 - 1)
    with pytest.raises(NergError, match="no frame that can be decoded, of 3,071 pixels at most"):
        list(select_sharpest_frames(film, 3))
    with pytest.raises(NergError, match="64.*48.*3,071"):
        module._check_size(film, 64, 48)
    with pytest.raises(NergError, match="a side of at most 65,500"):
        module._check_size(film, 65_501, 1)


LISTS = {
    "a.mp4": "ffconcat version 1.0\nfile 'film.mp4'\n",
    "a.m3u8": "#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nfilm.ts\n#EXT-X-ENDLIST\n",
    "b.m3u8": "#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nhttp://127.0.0.1:{port}/film.ts\n",
    "a.sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video {port} RTP/AVP 96\n",
}


@pytest.mark.parametrize("name", LISTS)
def test_nothing_but_the_file_is_opened(name, av, film, tmp_path):
    """FFmpeg would follow playlists to other files and addresses."""
    remux(av, film, tmp_path / "film.ts")
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0)
        (tmp_path / name).write_text(LISTS[name].format(port=server.getsockname()[1]))
        with pytest.raises(NergError, match="its video format is not supported|invalid data found"):
            list(select_sharpest_frames(tmp_path / name, 3))
        with pytest.raises(BlockingIOError):
            server.accept()


def test_referenced_files_are_refused(film, tmp_path, monkeypatch):
    """Also by the check of opened files."""
    (tmp_path / "a.mp4").write_text(LISTS["a.mp4"])
    monkeypatch.setattr(module, "FORMATS", (*module.FORMATS, "concat"))
    with pytest.raises(NergError, match="cannot be read"):
        list(select_sharpest_frames(tmp_path / "a.mp4", 3))


@pytest.mark.parametrize("name", ["12:30.mp4", "http:film.mp4", "concat:a|b.mp4", "-.mp4"])
def test_a_name_is_no_address(name, film, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    film.rename(name)
    assert len(list(select_sharpest_frames(name, 3))) == 3


def test_titles_may_have_any_encoding(av, film, tmp_path):
    remux(av, film, tmp_path / "a.avi", title="XXXXXXXX")
    raw = (tmp_path / "a.avi").read_bytes()
    assert b"XXXXXXXX" in raw
    (tmp_path / "a.avi").write_bytes(raw.replace(b"XXXXXXXX", b"caf\xe9\xff\xfe\x80 "))
    assert len(list(select_sharpest_frames(tmp_path / "a.avi", 3))) == 3


def test_unknown_codecs_are_refused(film, tmp_path, av):
    raw = film.read_bytes()
    # Both in the track and in its sample description.
    (tmp_path / "a.mp4").write_bytes(raw.replace(b"mp4v", b"xyzw").replace(b"esds", b"free"))
    with pytest.raises(NergError, match="unknown codec"):
        list(select_sharpest_frames(tmp_path / "a.mp4", 3))


def test_decoders_that_cameras_do_not_need_do_not_run(av, tmp_path):
    # Among these are most of those with holes.
    with av.open(tmp_path / "a.avi", "w") as out:
        stream = out.add_stream("huffyuv", rate=25, width=64, height=64, pix_fmt="yuv422p")
        for packet in [*stream.encode(av.VideoFrame(64, 64, "yuv422p")), *stream.encode()]:
            out.mux(packet)
    with pytest.raises(NergError, match="convert it to H.264"):
        list(select_sharpest_frames(tmp_path / "a.avi", 1))
    assert not {"vvc", "magicyuv", "tdsc", "apac"} & set(module.CODECS)


def test_tables_with_excessive_claims_are_refused(film, tmp_path):
    raw = bytearray(film.read_bytes())
    at = raw.index(b"stsz") + 8
    raw[at : at + 8] = (1).to_bytes(4, "big") + (30_000_000).to_bytes(4, "big")
    (tmp_path / "a.mp4").write_bytes(raw)
    with pytest.raises(NergError, match="cannot be read: it claims 30,000,000 samples in .*; use a video"):
        list(select_sharpest_frames(tmp_path / "a.mp4", 3))


def test_ffmpeg_prints_nothing(film, tmp_path, capfd):
    raw = bytearray(film.read_bytes())
    at = raw.index(b"mdat") + 60
    raw[at : at + 500] = bytes(500)
    (tmp_path / "b.mp4").write_bytes(raw)
    list(select_sharpest_frames(tmp_path / "b.mp4", 3))
    (tmp_path / "c.mp4").write_bytes(raw[: len(raw) // 2])
    with pytest.raises(NergError, match="cannot be read: [a-z ]+; use a video"):
        list(select_sharpest_frames(tmp_path / "c.mp4", 3))
    assert capfd.readouterr() == ("", "")


def test_mostly_damaged_video_is_refused(film, monkeypatch):
    monkeypatch.setattr(module, "_MAX_LOST_PACKETS", 2)
    monkeypatch.setattr(module, "_MAX_LOST_PER_FRAME", -1)
    with pytest.raises(NergError, match="most of the video"):
        list(select_sharpest_frames(film, 3))


def test_damaged_segment_is_skipped(film, tmp_path):
    raw = bytearray(film.read_bytes())
    at = raw.index(b"mdat") + 4
    middle = at + (len(raw) - at) // 3
    raw[middle : middle + 200] = bytes(200)
    (tmp_path / "b.mp4").write_bytes(raw)
    assert len(list(select_sharpest_frames(tmp_path / "b.mp4", 3))) == 3


def test_narrow_frames_are_compared():
    frame = lambda w, h: SimpleNamespace(width=w, height=h, to_ndarray=lambda **size: size)
    for size, frames in (((1, 9), (3, 27)), ((2, 2), (3, 3)), ((3840, 2160), (480, 270)), ((64, 90_000), (64, 1920))):
        sizes = module._to_gray(frame(*size))
        assert (sizes["width"], sizes["height"]) == frames


def test_missing_pyav_names_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    (tmp_path / "a.mp4").write_bytes(b"film")
    with pytest.raises(ImportError, match=r'"nerg-mi\[poses\]\"'):
        list(select_sharpest_frames(tmp_path / "a.mp4", 3))
