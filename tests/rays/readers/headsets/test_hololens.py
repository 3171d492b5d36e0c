"""HoloLens 2's StreamRecorder."""

import numpy as np

from tests.rays.readers.reading import dropped, read

# A head that was turned by 90 degrees to its left, at a place of its own: row by row, as the recorder writes it.
HEAD = np.array([[0.0, 0, 1, 5], [0, 1, 0, 6], [-1, 0, 0, 7], [0, 0, 0, 1]])


def test_hololens(tmp_path):
    def line(t, seen, origin, direction, distance):
        hands = np.zeros(2 * (1 + 16 * 26))
        return ",".join(map(str, (t, *HEAD.ravel(), *hands, seen, *origin, 1, *direction, 0, distance)))

    path = tmp_path / "2026-01-02-101112_head_hand_eye.csv"
    path.write_text(
        "\n".join(
            [
                line(132500000000000000, 1, (1, 1.6, -2), (0, 0, -1), 2.5),
                line(132500000000200000, 0, (0, 0, 0), (0, 0, 0), 0),
                line(132500000000400000, 1, (1, 1.6, -2), (0, 1, 0), 0),
            ]
        )
    )
    rays = read("hololens", path)
    assert np.allclose(rays.t, [0, 0.04], atol=1e-5) and rays.persons == ("2026-01-02-101112",)
    assert np.allclose(rays.origin, [1, 2, 1.6]) and np.allclose(rays.direction, [[0, 1, 0], [0, 0, 1]])
    assert np.allclose(rays.head, [-1, 0, 0])  # from -z of the file's world to -x
    assert np.allclose(rays.hit, [[1, 4.5, 1.6], [np.nan] * 3], equal_nan=True) and dropped(rays) == {
        "the eyes were not seen": [[2, 2]]
    }
