"""Files of gaze vectors."""

import numpy as np
import pytest

from nerg_mi.rays.readers import poses
from nerg_mi.rays.readers.poses import iterate_gaze_vectors

HEAD = "FREQUENCY\t10\nSTART_OFFSET\t1\n"


def test_blocks_are_one_file(tmp_path, monkeypatch):
    path = tmp_path / "a_g.tsv"
    path.write_text("\ufeff" + HEAD + "".join(f"{k}\t0\t1600\t1\t0\tNaN\n" for k in range(7)) + "\n\n")
    monkeypatch.setattr(poses, "_BLOCK", 3)
    blocks = list(iterate_gaze_vectors(path))
    assert len(blocks) > 2
    times, vectors, samples, lines = (np.concatenate(v) for v in zip(*blocks))
    assert np.allclose(times, 0.1 * np.arange(7) - 1) and samples.tolist() == list(range(7))
    assert (
        lines.tolist() == list(range(3, 10))
        and vectors[:, 0].tolist() == list(range(7))
        and np.isnan(vectors[:, 5]).all()
    )


def test_columns_in_any_order_and_named_after_what_looks(tmp_path):
    names = ["Sample", "Time", *(f"ann {a} Vec" for a in "XYZ"), *(f"ann {a} Pos" for a in "XYZ")]
    (tmp_path / "a_g.tsv").write_text("\t".join(names) + "\n1\t0.5\t1\t2\t3\t4\t5\t6\n")
    (block,) = iterate_gaze_vectors(tmp_path / "a_g.tsv")
    assert block.times.tolist() == [0.5] and block.vectors.tolist() == [[4, 5, 6, 1, 2, 3]]


@pytest.mark.parametrize("rate", ["FREQUENCY\tEXT\n", "FREQUENCY\t0\n", ""])
def test_times_that_nothing_tells(tmp_path, rate):
    (tmp_path / "a_g.tsv").write_text(rate + "1\t2\t3\t4\t5\t6\n")
    with pytest.raises(ValueError, match="tells no time"):
        list(iterate_gaze_vectors(tmp_path / "a_g.tsv"))


def test_bad_lines_count_as_samples(tmp_path):
    (tmp_path / "a_g.tsv").write_text(
        HEAD + "1\t2\t3\t4\t5\t6\n1\t2\t3\t4\t5\t6\t7\n1\t2\t3\t4\t5\tx\n1\t2\t3\t4\t5\t6\n"
    )
    told = []
    (block,) = iterate_gaze_vectors(tmp_path / "a_g.tsv", lambda line, why: told.append(line))
    assert told == [4, 5] and np.allclose(block.times, [-1, -0.7]) and block.samples.tolist() == [0, 3]
    with pytest.raises(ValueError, match="4.*1.2.*7.*6"):
        list(iterate_gaze_vectors(tmp_path / "a_g.tsv"))
