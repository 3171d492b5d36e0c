"""Gaze in the space of motion capture systems."""

import math

import numpy as np
import pytest

from tests.rays.readers.reading import dropped, read

HEADER = "FILE_VERSION\t2.0.0\nGAZE_VECTOR_NAME\tann (L)\nNO_OF_SAMPLES\t5\nFREQUENCY\t50\n"
HEADER += "TIME_STAMP\t2026-11-22, 10:00:00.000\t1234.5\nSTART_OFFSET\t0.04\nHW_SYNC\tYES\nFILTER\tNO\n"
NAMES = "X Pos\tY Pos\tZ Pos\tX Vec\tY Vec\tZ Vec\n"


def look(k: int, side: int = 0) -> tuple[list[float], list[float]]:
    """Who walks along x at 1 m/s, 1.6 m high, and turns 2 degrees a sample from x to the left, 10 degrees down; the
    eyes are 60 mm apart, and ``side`` is 1 for the left one, -1 for the right."""
    turn, down = math.radians(2 * k), math.radians(10)
    ahead = [math.cos(down) * math.cos(turn), math.cos(down) * math.sin(turn), -math.sin(down)]
    return [20 * k - side * 30 * math.sin(turn), side * 30 * math.cos(turn), 1600], ahead


def row(*cells) -> str:
    return "\t".join(str(c) for c in cells) + "\n"


def write(path, *, header=HEADER, names=NAMES, before=lambda k: (), side=0, lost=(), count=5):
    rows = [
        row(*before(k), *(["", "", "", 0, 0, 0] if k in lost else [*look(k, side)[0], *look(k, side)[1]]))
        for k in range(count)
    ]
    path.write_text(header + names + "".join(rows))
    return path


def assert_looks(rays, samples, start=-0.04):
    assert np.allclose(rays.t, [start + 0.02 * k for k in samples])
    origin, ahead = zip(*(look(k) for k in samples))
    assert np.allclose(rays.origin, np.array(origin) / 1000) and np.allclose(rays.direction, ahead)


@pytest.mark.parametrize("names", [NAMES, ""])
@pytest.mark.parametrize("timed", [True, False])
def test_columns_and_times_that_may_be_missing(tmp_path, names, timed):
    before = (lambda k: (k + 1, 3 + 0.02 * k)) if timed else (lambda k: ())
    named = "Sample\tTime\t" + names if names and timed else names
    rays = read("qualisys", write(tmp_path / "ann_g.tsv", names=named, before=before, lost=(2,)))
    assert_looks(rays, [0, 1, 3, 4], 3 if timed else -0.04)
    assert rays.persons == ("ann",)
    assert dropped(rays) == {"no eye was seen": [[9 + bool(names) + 2] * 2]}
    # Nothing is said of the time.
    bare = write(tmp_path / "bo_g.tsv", header="", names=named, before=before)
    if timed:
        assert len(read("qualisys", bare)) == 5
    else:
        with pytest.raises(ValueError, match="bo_g.tsv tells no time"):
            read("qualisys", bare)


def test_two_eyes_are_one_ray(tmp_path):
    left = write(tmp_path / "ann_g_1.tsv", side=1, lost=(1, 3))
    right = write(tmp_path / "ann_g_2.tsv", side=-1, lost=(3, 4), count=7)
    rays = read("qualisys", tmp_path)
    assert (
        rays.persons == ("ann",) and np.allclose(rays.t, [-0.04, -0.02, 0.0, 0.04]) and rays.metadata["rows_read"] == 5
    )
    # Midway between both; where one was not seen, the other.
    for at, (k, side) in enumerate(((0, 0), (1, -1), (2, 0), (4, 1))):
        assert np.allclose(1000 * rays.origin[at], look(k, side)[0]) and np.allclose(rays.direction[at], look(k)[1])
    assert dropped(rays) == {"no eye was seen": [[13, 13]]}
    assert [s["file"] for s in rays.metadata["sources"]] == ["ann_g_2.tsv", "ann_g_1.tsv"]
    # An eye that is given alone is read alone, and other files are other people.
    assert np.allclose(1000 * read("qualisys", right).origin[0], look(0, -1)[0])
    assert read("qualisys", left, write(tmp_path / "bo_g.tsv")).persons == ("ann", "bo")
    assert len(read("qualisys", write(tmp_path / "other.tsv"))) == 5


def test_a_line_that_is_cut_off(tmp_path):
    path = write(tmp_path / "ann_g.tsv", count=300)
    text = path.read_text().split("\n")
    text[20] = text[20][:20]
    path.write_text("\n".join(text))
    with pytest.raises(ValueError, match="ann_g.tsv.*21"):
        read("qualisys", path)
    assert_looks(read("qualisys", path, skip_bad_lines=True), [k for k in range(300) if k != 11])


def test_up_and_what_is_refused(tmp_path):
    rays = read("qualisys", write(tmp_path / "ann_g.tsv"), up="y")
    assert np.allclose(rays.origin[0], [0, -1.6, 0])
    (tmp_path / "bo_g.tsv").write_text("MARKER_NAMES\ta\n1\t2\t3\n")
    with pytest.raises(ValueError, match="bo_g.tsv has no gaze vectors"):
        read("qualisys", tmp_path / "bo_g.tsv")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="no gaze vectors .*empty"):
        read("qualisys", tmp_path / "empty")


NEON = "timestamp [ns],LF_X,gaze_origin_X,gaze_origin_Y,gaze_origin_Z,gaze_dir_X,gaze_dir_Y,gaze_dir_Z,head_dir_X\n"


def test_neon_in_motion_capture(tmp_path):
    """As the tool writes it: pandas' index first, markers beside the gaze, empty where the glasses were not found."""
    path = tmp_path / "ann" / "gaze_in_mocap_space.csv"
    path.parent.mkdir()
    start = 1_700_000_000_000_000_000
    rows = [[k, start + 5_000_000 * k, 7, *look(k)[0], *look(k)[1], 1] for k in range(4)]
    rows[2][3:] = [""] * 7
    path.write_text("," + NEON + "".join(",".join(map(str, r)) + "\n" for r in rows))
    rays = read("neon_mocap", path, up="z")
    assert rays.persons == ("ann",) and np.allclose(rays.t - 1.7e9, [0, 0.005, 0.015], atol=1e-6)
    origin, ahead = zip(*(look(k) for k in (0, 1, 3)))
    assert np.allclose(rays.origin, np.array(origin) / 1000) and np.allclose(rays.direction, ahead)
    assert dropped(rays) == {"the glasses' markers were not seen": [[4, 4]]}
    # Another name is the person's; metres with y up.
    other = path.rename(path.with_name("bo.csv"))
    metres = read("neon_mocap", other, up="y", units="m")
    assert metres.persons == ("bo",) and np.allclose(metres.origin[1], np.array(origin[1])[[0, 2, 1]] * (1, -1, 1))
    with pytest.raises(ValueError, match="say it .--up z"):
        read("neon_mocap", other)
    other.write_text(NEON.replace("timestamp [ns]", "time") + "0\n")
    with pytest.raises(ValueError, match='"timestamp .ns.".*LF_X'):
        read("neon_mocap", other, up="z")
    other.write_text(NEON.replace("gaze_dir", "dir") + "0\n")
    with pytest.raises(ValueError, match="no columns gaze_dir"):
        read("neon_mocap", other, up="z")
