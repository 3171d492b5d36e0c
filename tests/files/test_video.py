"""Tests of `nerg_mi.files.video`."""

from __future__ import annotations

import struct
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.files.video import check_video_output, check_video_tables, open_video_writer, read_frame_times
from tests.files.movies import make_box, make_box_table, make_movie, make_size_table, make_track

# ---- Frame times, and MP4 files whose tables claim too many samples ----


def check_tables(path: Path, *boxes: bytes) -> None:
    path.write_bytes(b"".join(boxes))
    check_video_tables(path)


DATA = make_box(b"mdat", bytes(1000))
FILE = "film.mp4"


def test_valid_tables_pass(tmp_path):
    edits = make_box_table(b"elst", 2, bytes(40), flags=1 << 24)
    content = make_track(
        make_size_table(0, 3, bytes(12)),
        make_box_table(b"stts", 1, bytes(8)),
        make_box_table(b"stco", 1, bytes(4)),
        edits=edits,
    )
    check_tables(
        tmp_path / FILE,
        make_box(b"ftyp", b"isom"),
        DATA,
        make_box(b"moov", content, make_track(make_size_table(2, 500))),
    )
    # A box with a 64-bit size, and a box that extends to the end.
    large = struct.pack(">I4sQ", 1, b"mdat", 16 + 1000) + bytes(1000)
    check_tables(tmp_path / FILE, large, struct.pack(">I4s", 0, b"moov") + content)


def test_other_formats_pass(tmp_path):
    for data in (
        b"",
        b"RIFF",
        b"\x1aE\xdf\xa3" + bytes(50),
        b"GP" * 500,
        bytes(100),
        make_box(b"stsz", b"1"),
        b"\0\0\0\5moov",
    ):
        check_tables(tmp_path / FILE, data)


@pytest.mark.parametrize("within", [b"moov", b"free", b"udta", b"meta"])
def test_samples_need_bytes(within, tmp_path):
    head = {b"free": make_box(b"mvhd", bytes(100)), b"meta": bytes(4)}.get(within, b"")
    with pytest.raises(ValueError, match=r"claims 30,000,000 samples in [\d,]+ bytes"):
        check_tables(tmp_path / FILE, DATA, make_box(within, head, make_track(make_size_table(1, 30_000_000))))


def test_samples_of_fragments_are_summed(tmp_path):
    parts = [make_box(b"moof", make_box(b"traf", make_box_table(b"trun", 400))) for _ in range(3)]
    check_tables(tmp_path / FILE, DATA, parts[0], make_box(b"free", bytes(100)))
    with pytest.raises(ValueError, match="claims 1,200 samples"):
        check_tables(tmp_path / FILE, DATA, *parts)


def test_short_tables_are_read_like_ffmpeg(tmp_path):
    """FFmpeg reads the missing part of the header from the following bytes."""
    with pytest.raises(ValueError, match=r"claims 16,777,215 samples"):
        check_tables(
            tmp_path / FILE,
            make_box(b"moof", make_box(b"traf", make_box(b"trun", bytes(2)))) + b"\0\0\0\xff\xff\xff" + bytes(9),
        )


def test_edits_multiply_samples(tmp_path):
    for edits, passes in ((2, True), (40, False)):
        content = make_box(
            b"moov", make_track(make_size_table(1, 900), edits=make_box_table(b"elst", edits, bytes(12 * edits)))
        )
        if passes:
            check_tables(tmp_path / FILE, DATA, content)
            continue
        with pytest.raises(ValueError, match="900.*40"):
            check_tables(tmp_path / FILE, DATA, content)


@pytest.mark.parametrize("kind, size", [(b"stts", 8), (b"ctts", 8), (b"stsc", 12), (b"stss", 4), (b"stco", 4)])
def test_tables_contain_their_entries(kind, size, tmp_path):
    check_tables(tmp_path / FILE, DATA, make_box(b"moov", make_track(make_box_table(kind, 3, bytes(3 * size)))))
    with pytest.raises(ValueError, match=f'"{kind.decode()}" claims 4 entries, but contains 3'):
        check_tables(tmp_path / FILE, DATA, make_box(b"moov", make_track(make_box_table(kind, 4, bytes(3 * size)))))
    with pytest.raises(ValueError, match='"stsz".*268,435,456.*3'):
        check_tables(tmp_path / FILE, DATA, make_box(b"moov", make_track(make_size_table(0, 1 << 28, bytes(12)))))


def test_compressed_headers_are_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="is compressed"):
        check_tables(tmp_path / FILE, make_box(b"moov", make_box(b"cmov", bytes(20))))
    monkeypatch.setattr("nerg_mi.files.video._MAX_BOXES", 5)
    with pytest.raises(ValueError, match="more than 5 boxes"):
        check_tables(tmp_path / FILE, *[make_box(b"free")] * 6)


def make_runs(kind: bytes, *pairs: tuple[int, int], version: int = 0) -> bytes:
    entries = b"".join(struct.pack(">Ii", *pair) for pair in pairs)
    return make_box_table(kind, len(pairs), entries, version << 24)


def make_edits(*entries: tuple[int, int, int], long: bool = False) -> bytes:
    form = ">QqI" if long else ">IiI"
    return make_box_table(b"elst", len(entries), b"".join(struct.pack(form, *e) for e in entries), long << 24)


STEADY = make_runs(b"stts", (6, 1000))
ONCE = 1 << 16  # the playback speed of an edit


@pytest.mark.parametrize(
    "tables, edited, seconds",
    [
        ([STEADY], b"", np.arange(6) / 24.95),
        # A variable frame rate with two missing frames.
        (
            [make_runs(b"stts", (2, 1000), (1, 3000), (1, 900), (1, 1000))],
            b"",
            [0, 1 / 24.95, 2 / 24.95, 5 / 24.95, 5.9 / 24.95],
        ),
        # Decoding order differs from presentation order: offsets of both signs.
        ([make_runs(b"stts", (4, 1000)), make_runs(b"ctts", (1, 0), (1, 2000), (2, -1000))], b"", np.arange(4) / 24.95),
        # An empty edit of 0.08 s, then the track from its third frame.
        ([STEADY], make_edits((80, -1, ONCE), (400, 2000, ONCE)), 0.08 + np.arange(4) / 24.95),
        # The first 0.1 s, and the track from 0.12 s on; an edit with duration 0 extends to the end.
        (
            [STEADY],
            make_edits((100, 0, ONCE), (0, 3000, ONCE), long=True),
            [*np.arange(3) / 24.95, *(0.1 + np.arange(3) / 24.95)],
        ),
    ],
)
@pytest.mark.parametrize("version", [0, 1])
def test_frame_times(tables, edited, seconds, version, tmp_path):
    path = tmp_path / FILE
    path.write_bytes(make_movie(1000, 24_950, *tables, edits=edited, version=version))
    assert np.allclose(read_frame_times(path), seconds, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "data, message",
    [
        (b"RIFF" + bytes(100), "no video track, or is not an MP4"),
        (make_movie(1000, 48_000, STEADY, kind=b"soun"), "no video track"),
        (make_movie(1000, 0, STEADY), "time scale is zero"),
        (make_movie(1000, 24_950, STEADY, edits=make_edits((100, 0, ONCE // 2))), "changes the playback speed"),
        (make_movie(1000, 24_950, STEADY, make_runs(b"ctts", (5, 0))), "list 6 and 5 frames"),
        (make_movie(1000, 24_950, make_runs(b"stts", (1 << 30, 1))), "more than 16,777,216 frames"),
        (make_movie(1000, 24_950, STEADY, edits=make_edits((100, 9000, ONCE))), "has no frames"),
        (
            make_movie(1000, 24_950, STEADY, edits=make_edits((100, 0, ONCE))).replace(b"mvhd", b"free"),
            "no movie time scale",
        ),
        (make_movie(1000, 24_950, STEADY) + make_box(b"moof"), "fragmented.*ffmpeg -i VIDEO -c copy"),
        (make_movie(1000, 24_950, make_box(b"stts", bytes(5))), "cannot be read"),
    ],
)
def test_unreadable_frame_times_are_refused(data, message, tmp_path):
    (tmp_path / FILE).write_bytes(data)
    with pytest.raises(NergError, match=f"film.mp4.*{message}"):
        read_frame_times(tmp_path / FILE)


def test_frame_times_equal_ffmpeg(tmp_path):
    """A video with constant frame rate and reordered frames that starts after 0.28 s."""
    av = pytest.importorskip("av")
    path, base = tmp_path / FILE, Fraction(1, 24_950)
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mpeg4", rate=Fraction(24_950, 1000))
        stream.width = stream.height = 32
        stream.pix_fmt, stream.time_base, stream.codec_context.time_base = "yuv420p", base, base
        stream.codec_context.max_b_frames = 2
        for k in range(12):
            frame = av.VideoFrame(32, 32, "yuv420p")
            frame.pts, frame.time_base = 7000 + 1000 * k + 300 * (k % 3), base
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    with av.open(str(path)) as video:
        shown = [frame.time for frame in video.decode(video=0)]
    assert shown[0] > 0.2 and np.allclose(read_frame_times(path), shown, rtol=0, atol=2e-5)


# ---- Videos decoded by FFmpeg: frames, colours, rate and header ----

HEIGHT, WIDTH = 48, 80


@pytest.fixture
def av():
    return pytest.importorskip("av", reason='PyAV is not installed (pip install "nerg-mi[video]")')


def make_frames(count):
    """A bar over coloured halves that moves by 4 pixels per frame."""
    for k in range(count):
        frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        frame[:, : WIDTH // 2], frame[:, WIDTH // 2 :] = (200, 30, 40), (20, 160, 220)
        frame[:, 4 * k : 4 * k + 8] = 255
        yield frame


def write_video(path, count=12, fps=25.0, **options):
    with open_video_writer(path, fps, **options) as add:
        for frame in make_frames(count):
            add(frame)


@pytest.mark.parametrize("fps, rate", [(25.0, Fraction(25)), (12.5, Fraction(25, 2)), (29.97, Fraction(2997, 100))])
def test_video_round_trip(av, tmp_path, fps, rate):
    write_video(tmp_path / "a.mp4", fps=fps, metadata={"Comment": '{"seed": 1, "ü": 2}', "Software": "nerg_mi 1"})
    with av.open(str(tmp_path / "a.mp4")) as decoded:
        (stream,) = decoded.streams
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height, stream.frames) == (WIDTH, HEIGHT, 12)
        assert float(stream.average_rate) == pytest.approx(float(rate), rel=1e-4)
        assert decoded.metadata["comment"] == '{"seed": 1, "ü": 2}' and "nerg_mi 1" in decoded.metadata.values()
        # BT.709, as written, and as players assume for high resolutions.
        assert (stream.codec_context.colorspace, stream.codec_context.color_range) == (1, 1)
        shown = [
            f.reformat(format="rgb24", src_colorspace="ITU709").to_ndarray().astype(int) for f in decoded.decode(stream)
        ]
    assert len(shown) == 12
    for k, (frame, wanted) in enumerate(zip(shown, make_frames(12))):
        # Pixels whose neighbours have the same colour, because colours have half the resolution.
        inside = np.array([x for x in range(2, WIDTH - 2) if np.ptp(wanted[0, x - 2 : x + 3], axis=0).max() == 0])
        assert len(inside) > 40 and np.abs(frame[:, inside] - wanted[:, inside]).mean() < 3
        assert np.abs(frame[:, inside] - wanted[:, inside]).max() < 16
        bright = np.flatnonzero(frame.min(axis=(0, 2)) > 200)
        assert abs(bright.mean() - (4 * k + 3.5)) < 0.75


def test_equal_frames_give_equal_files(av, tmp_path):
    """Compared by packets; the encoder occasionally uses one or two more bytes for the first packet."""
    pictures = []
    for k in "ab":
        write_video(tmp_path / f"{k}.mp4", metadata={"Comment": "x"})
        with av.open(tmp_path / f"{k}.mp4") as container:
            pictures.append(np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]))
    assert pictures[0].shape == pictures[1].shape and np.abs(pictures[0].astype(int) - pictures[1]).max() <= 8
    data = (tmp_path / "a.mp4").read_bytes()
    # No creation time.
    assert data[data.index(b"mvhd") + 8 :][:8] == bytes(8)
    # The box with the estimated bit rate, which depends on the scheduling of the encoder's threads.
    assert b"btrt" not in data and b"mdat" in data


@pytest.mark.parametrize(
    "shape, said",
    [((49, 80), "even sides"), ((48, 81), "even sides"), ((8, 80), "16 to 8192"), ((48, 9000), "16 to 8192")],
)
def test_unsupported_sizes_are_refused(av, tmp_path, shape, said):
    with pytest.raises(NergError, match=said), open_video_writer(tmp_path / "a.mp4") as add:
        add(np.zeros((*shape, 3), np.uint8))
    assert not list(tmp_path.iterdir())


def test_frames_must_have_same_size(av, tmp_path):
    with pytest.raises(NergError, match="80.*48.*40.*48"), open_video_writer(tmp_path / "a.mp4") as add:
        add(np.zeros((48, 80, 3), np.uint8))
        add(np.zeros((48, 40, 3), np.uint8))
    assert not list(tmp_path.iterdir())


def test_missing_frames_and_invalid_rate_are_refused(av, tmp_path):
    with pytest.raises(NergError, match="a video without frames"), open_video_writer(tmp_path / "a.mp4"):
        pass
    for fps in (0.0, -1.0, float("nan"), 1e9):
        with pytest.raises(NergError, match="fps=25"):
            check_video_output(fps)
    assert not list(tmp_path.iterdir())


def test_interrupted_video_leaves_no_file(av, tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), open_video_writer(tmp_path / "a.mp4") as add:
        add(next(make_frames(1)))
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"] and (tmp_path / "a.mp4").read_bytes() == b"old"


def test_missing_pyav_names_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ImportError, match=r'"nerg-mi\[video\]\"'):
        check_video_output(25.0)
