import gzip

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.skeleton import iterate_skeleton, read_skeleton, write_skeleton


@pytest.fixture
def poses():
    keypoints = np.random.default_rng(0).uniform(-9, 9, (7, 22, 3))
    keypoints[3, 11] = np.nan
    return list("abcabca"), np.arange(7) * 40, keypoints


@pytest.mark.parametrize("name", ["day.csv", "day.csv.gz"])
def test_round_trip(tmp_path, poses, name):
    ids, times, keypoints = poses
    path = tmp_path / name
    write_skeleton(path, ids, times, keypoints)
    rows = read_skeleton(path)
    assert list(rows.ids) == ids and np.array_equal(rows.times, times) and np.array_equal(rows.lines, np.arange(1, 8))
    assert np.allclose(rows.keypoints, keypoints, atol=5.1e-7, equal_nan=True)
    first = path.read_bytes()
    write_skeleton(path, ids, times, keypoints)
    assert path.read_bytes() == first  # no clock in the file
    assert [len(run.ids) for run in iterate_skeleton(path, chunk=3)] == [3, 3, 1]


def test_reads_the_published_layout(tmp_path):
    numbers = [float(i) for i in range(66)]
    numbers[4] = float("nan")
    path = tmp_path / "2023.csv"
    path.write_text(f"person 1|1698822000|{numbers}\n\n")
    rows = read_skeleton(path)
    assert rows.ids[0] == "person 1" and rows.times[0] == 1698822000
    assert np.array_equal(rows.keypoints[0, 11], [33, 34, 35]) and np.isnan(rows.keypoints[0, 1, 1])


@pytest.mark.parametrize(
    "line, message",
    [
        ("a|1", "line 2: 2 fields"),
        ("a|one|[" + ", ".join(["0"] * 66) + "]", "2.*'one'"),
        ("a|1|[0, 1]", "line 2: 2 numbers, expected 66"),
        ("a|1|" + ", ".join(["0"] * 66), "line 2: .* not enclosed"),
        ("a|1|[" + ", ".join(["0"] * 65 + ["x"]) + "]", "line 2: 'x' is not a number"),
    ],
)
def test_names_the_broken_line(tmp_path, poses, line, message):
    path = tmp_path / "day.csv"
    write_skeleton(path, *(v[:1] for v in poses))
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(ValueError, match=message):
        read_skeleton(path)


def test_writer_refuses(tmp_path, poses):
    ids, times, keypoints = poses
    path = tmp_path / "day.csv"
    with pytest.raises(ValueError, match="one pose for each id"):
        write_skeleton(path, ids[:3], times, keypoints)
    with pytest.raises(ValueError, match="integers"):
        write_skeleton(path, ids, times * 0.5, keypoints)
    with pytest.raises(ValueError, match="rename the person"):
        write_skeleton(path, ["a|b"] + ids[1:], times, keypoints)
    path.write_text("")
    with pytest.raises(ValueError, match="no poses"):
        read_skeleton(path)


def test_reads_gzip_of_others(tmp_path):
    path = tmp_path / "day.gz"
    with gzip.open(path, "wt") as out:
        out.write("a|1|[" + ", ".join(["1.5"] * 66) + "]\n")
    assert read_skeleton(path).keypoints.shape == (1, 22, 3)


def test_bad_lines_are_told_and_left_out(tmp_path, poses):
    path, bad_lines = tmp_path / "day.csv", []
    write_skeleton(path, *poses)
    good = path.read_text().splitlines(keepends=True)
    zeros = ", ".join(["0"] * 65)
    bad = [
        f"a|1|[{zeros}, x]\n",
        "a|1\n",
        f"a|1.5|[{zeros}, 0]\n",
        f"a|{1 << 63}|[{zeros}, 0]\n",
        f"a|1|{zeros}, 0\n",
        good[0][:300],
    ]
    path.write_text("".join(line for pair in zip(good, [*bad[:-1], "", ""]) for line in pair) + bad[-1])
    for keypoints in (None, (21, 2, 13)):
        bad_lines.clear()
        (rows,) = iterate_skeleton(path, keypoints=keypoints, on_bad=lambda line, why: bad_lines.append(line))
        assert (
            list(rows.ids) == poses[0]
            and rows.lines.tolist() == [1, 3, 5, 7, 9, 11, 12]
            and sorted(bad_lines) == [2, 4, 6, 8, 10, 13]
        )
    with pytest.raises(NergError, match="4.*2.*--skip-bad-lines"):
        read_skeleton(path)


@pytest.mark.parametrize("keypoints", [None, (0, 1, 2)])
def test_numbers_that_only_python_spells_so(tmp_path, keypoints):
    path = tmp_path / "day.csv"
    path.write_text("a|1|[" + ", ".join(["1_0"] * 66) + "]\n")
    (rows,) = iterate_skeleton(path, keypoints=keypoints)
    assert rows.keypoints[0, 0].tolist() == [10, 10, 10]
