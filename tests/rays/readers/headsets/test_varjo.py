"""Varjo's log."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from tests.rays.readers.reading import dropped, read

TURN = Rotation.from_euler("YX", [90, 30], degrees=True)  # of Unity: to the right, then down


def test_varjo(tmp_path):
    q = ", ".join(f"{v:.6f}" for v in TURN.as_quat())
    path = tmp_path / "2026-01-02.csv"
    path.write_text(
        "Frame;CaptureTime;HMDPosition;HMDRotation;GazeStatus;CombinedGazeForward;CombinedGazePosition\n"
        f"1;1700000000000000000;(1.000, 1.600, 2.000);({q});VALID;(0.000, 0.500, 1.000);(0.000, 0.000, 0.100)\n"
        f"2;1700000000005000000;(1.000, 1.600, 2.000);({q});INVALID;;\n"
        f"3;1700000000010000000;(1.000, 1.600, 2.000);({q});VALID;(0.000, 0.000, 1.000);(0.000, 0.000, 0.000)\n"
    )
    rays = read("varjo", path)
    assert np.allclose(rays.t, [0, 0.01], atol=1e-6) and dropped(rays) == {"GazeStatus is not VALID": [[3, 3]]}
    ahead = np.array([3**0.5 / 2, 0, -0.5])
    assert [s["file"] for s in rays.metadata["sources"]] == ["2026-01-02.csv"]
    assert np.allclose(rays.head, ahead, atol=1e-6)
    assert np.allclose(rays.direction[1], ahead, atol=1e-6) and np.allclose(
        rays.origin, [[1, 2, 1.6] + 0.1 * ahead, [1, 2, 1.6]], atol=1e-6
    )
    path.write_text(path.read_text().replace("(0.000, 0.500, 1.000)", "(0.000, oops)"))
    with pytest.raises(ValueError, match="line 2, column 'CombinedGazeForward'"):
        read("varjo", path)


def test_a_vector_that_is_cut_off(tmp_path):
    """Of Varjo's cells: told by line and column, or left out and counted."""
    head = "CaptureTime;HMDPosition;HMDRotation;CombinedGazePosition;CombinedGazeForward;GazeStatus\n"
    row = "{};(0, 1.6, 0);(0, 0, 0, 1);(0, 0, 0);(0, 0, 1);VALID\n"
    path = tmp_path / "ann.csv"
    path.write_text(
        head + "1;(0, 1.6;(0, 0, 0, 1);(0, 0;(0, 0, 1);VALID\n" + "".join(row.format(i * 10**7) for i in range(5))
    )
    with pytest.raises(NergError, match="2.*'HMDPosition'.*--skip-bad-lines"):
        read("varjo", path)
    rays = read("varjo", path, skip_bad_lines=True)
    assert (
        len(rays) == 5
        and rays.t[0] == 0
        and rays.metadata["dropped"][0]["rows"] == [[2, 2]]
        and rays.metadata["rows_read"] == 6
    )
    path.write_text(head + "".join(row.format(i * 10**7) for i in range(5)) + "50000000;(0, 1.6, 0);(0, 0")
    rays = read("varjo", path, skip_bad_lines=True)
    assert len(rays) == 5 and rays.metadata["dropped"][0]["rows"] == [[7, 7]]


@pytest.mark.parametrize("status, kept", [("2", 1), ("1", 0), ("valid", 1), ("3", None), ("Visible", None)])
def test_codes_of_the_status(tmp_path, status, kept):
    path = tmp_path / "v.csv"
    row = "{};(0, 1.6, 0);(0, 0, 0, 1);(0, 0, 0);(0, 0, 1);{}\n"
    path.write_text(
        "CaptureTime;HMDPosition;HMDRotation;CombinedGazePosition;CombinedGazeForward;GazeStatus\n"
        + row.format(0, "VALID")
        + row.format(10**7, status)
    )
    if kept is None:
        with pytest.raises(ValueError, match=f"GazeStatus '{status.upper()}', whose meaning is not certain"):
            read("varjo", path)
    else:
        assert len(read("varjo", path)) == 1 + kept
