"""Videos read back by FFmpeg: every frame, its colours, the rate and what the header says."""

from __future__ import annotations

import sys
from fractions import Fraction

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.video import check_video, video_frames

HEIGHT, WIDTH = 48, 80


@pytest.fixture
def av():
    return pytest.importorskip("av", reason='PyAV is not installed (pip install "nerg-mi[video]")')


def frames(count):
    """A bar that moves by 4 pixels a frame, over coloured halves."""
    for k in range(count):
        frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        frame[:, : WIDTH // 2], frame[:, WIDTH // 2 :] = (200, 30, 40), (20, 160, 220)
        frame[:, 4 * k : 4 * k + 8] = 255
        yield frame


def write(path, count=12, fps=25.0, **more):
    with video_frames(path, fps, **more) as add:
        for frame in frames(count):
            add(frame)


@pytest.mark.parametrize("fps, rate", [(25.0, Fraction(25)), (12.5, Fraction(25, 2)), (29.97, Fraction(2997, 100))])
def test_read_back(av, tmp_path, fps, rate):
    write(tmp_path / "a.mp4", fps=fps, text={"Comment": '{"seed": 1, "ü": 2}', "Software": "nerg_mi 1"})
    with av.open(str(tmp_path / "a.mp4")) as found:
        (stream,) = found.streams
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height, stream.frames) == (WIDTH, HEIGHT, 12)
        assert float(stream.average_rate) == pytest.approx(float(rate), rel=1e-4)
        assert found.metadata["comment"] == '{"seed": 1, "ü": 2}' and "nerg_mi 1" in found.metadata.values()
        # BT.709, as is written, and as players of high resolution assume.
        assert (stream.codec_context.colorspace, stream.codec_context.color_range) == (1, 1)
        shown = [
            f.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray().astype(int) for f in found.decode(stream)
        ]
    assert len(shown) == 12
    for k, (frame, wanted) in enumerate(zip(shown, frames(12))):
        # Where neighbours have one colour, since colours have half the resolution.
        inside = np.array([x for x in range(2, WIDTH - 2) if np.ptp(wanted[0, x - 2 : x + 3], axis=0).max() == 0])
        assert len(inside) > 40 and np.abs(frame[:, inside] - wanted[:, inside]).mean() < 3
        assert np.abs(frame[:, inside] - wanted[:, inside]).max() < 16
        bright = np.flatnonzero(frame.min(axis=(0, 2)) > 200)
        assert abs(bright.mean() - (4 * k + 3.5)) < 0.75


def test_equal_frames_are_equal_files(av, tmp_path):
    for k in "ab":
        write(tmp_path / f"{k}.mp4", text={"Comment": "x"})
    data = (tmp_path / "a.mp4").read_bytes()
    assert data == (tmp_path / "b.mp4").read_bytes()
    # The box of the estimated bit rate, which depends on how the encoder's threads were scheduled.
    assert b"btrt" not in data and b"mdat" in data


@pytest.mark.parametrize(
    "shape, said",
    [((49, 80), "even sides"), ((48, 81), "even sides"), ((8, 80), "16 to 8192"), ((48, 9000), "16 to 8192")],
)
def test_sizes_that_players_do_not_show(av, tmp_path, shape, said):
    with pytest.raises(NergError, match=said), video_frames(tmp_path / "a.mp4") as add:
        add(np.zeros((*shape, 3), np.uint8))
    assert not list(tmp_path.iterdir())


def test_frames_of_one_size(av, tmp_path):
    with pytest.raises(NergError, match="80.*48.*40.*48"), video_frames(tmp_path / "a.mp4") as add:
        add(np.zeros((48, 80, 3), np.uint8))
        add(np.zeros((48, 40, 3), np.uint8))
    assert not list(tmp_path.iterdir())


def test_no_frames_and_no_rate(av, tmp_path):
    with pytest.raises(NergError, match="a video without pictures"), video_frames(tmp_path / "a.mp4"):
        pass
    for fps in (0.0, -1.0, float("nan"), 1e9):
        with pytest.raises(NergError, match="give --fps 25"):
            check_video(fps)
    assert not list(tmp_path.iterdir())


def test_what_interrupts_leaves_nothing(av, tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), video_frames(tmp_path / "a.mp4") as add:
        add(next(frames(1)))
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"] and (tmp_path / "a.mp4").read_bytes() == b"old"


def test_without_pyav(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ImportError, match=r'"nerg-mi\[video\]\"'):
        check_video(25.0)
