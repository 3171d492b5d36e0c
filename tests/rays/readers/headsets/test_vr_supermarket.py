"""Recordings of the VR supermarket."""

import numpy as np

from nerg_mi.probes.probes import place_probes
from tests.rays.readers.reading import dropped, read


def test_real_supermarket(recorded):
    files = sorted(recorded("vr_supermarket").glob("*.csv.gz"))[:2]
    rays = read("vr_supermarket", *files)
    assert rays.persons == ("user10", "user11") and 0.85 < len(rays) / rays.metadata["rows_read"] < 0.97
    # The gaze ray points at the recorded hit: the frame was decoded right.
    hit = np.isfinite(rays.hit).all(axis=1)
    to_hit = rays.hit[hit] - rays.origin[hit]
    to_hit /= np.linalg.norm(to_hit, axis=1, keepdims=True)
    angle = np.degrees(2 * np.arcsin(0.5 * np.linalg.norm(to_hit - rays.direction[hit], axis=1)))
    assert np.median(angle) < 1e-3 and np.percentile(angle, 99) < 0.05
    assert 0.97 < hit.mean() < 1
    # Gaze is about where heads point.
    assert np.median(np.einsum("ij,ij->i", rays.head, rays.direction)) > np.cos(np.radians(20))
    assert 1.2 < np.median(rays.origin[:, 2]) < 1.8  # z is up: eye heights
    probes = place_probes(rays, 0.25, count=64, min_rays=8, cap=100_000)
    assert 200 < np.median(probes.counts) < 2000


def test_frame_eyes_and_openness(tmp_path):
    """A camera that is turned by 90 degrees about Unity's y, against the formula by hand."""
    names = [f"ctw_{i}{j}" for i in range(3) for j in range(4)]
    names += "ray_x ray_y ray_z eye_x eye_y eye_z xc yc zc opennessl opennessr time".split()
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    pose = np.hstack([turn, [[1.0], [1.6], [2.0]]]).ravel()
    rows = [
        [*pose, 0, 0, 2, 0.01, 0, 0.1, "", "", "", *openness, 0.02 * k]
        for k, openness in enumerate([(0.9, 0.8), (0.9, 0.5), (1.2, 1.1), ("", 1)])
    ]
    path = tmp_path / "gaze_user7_x.csv"
    path.write_text("\n".join(",".join(map(str, row)) for row in [names, *rows]) + "\n")
    rays = read("vr_supermarket", path)
    assert rays.persons == ("user7",) and np.allclose(rays.t, [0, 0.04]) and np.allclose(rays.confidence, [0.8, 1])
    assert np.allclose(rays.direction, (turn @ (0, 0, -1))[[0, 2, 1]]) and np.isnan(rays.hit).all()
    assert np.allclose(rays.head, (turn @ (0, 0, -1))[[0, 2, 1]])
    assert np.allclose(rays.origin, ((1, 1.6, 2) + turn @ (0.01, 0, -0.1))[[0, 2, 1]])
    assert dropped(rays) == {
        "an eye is closed (openness at most 0.5)": [[3, 3]],
        "confidence is missing or outside [0, 1]": [[5, 5]],
    }
    assert len(read("vr_supermarket", path, min_openness=0.4)) == 3


def test_single_mirrored_rows_and_fill_values(tmp_path):
    names = [f"ctw_{i}{j}" for i in range(3) for j in range(4)]
    names += "ray_x ray_y ray_z eye_x eye_y eye_z xc yc zc opennessl opennessr time".split()
    rows = []
    for k in range(6):
        turn = np.diag([1.0, 1, -1]) if k != 2 else np.eye(3)
        pose = np.hstack([turn, [[1.0], [1.6], [2.0 + k]]]).ravel()
        rows.append([*pose, *([-1, -1, -1] if k == 4 else [0, 0, 1]), 0, 0, 0, "", "", "", 1, 1, 0.02 * k])
    path = tmp_path / "gaze_user7_x.csv"
    path.write_text("\n".join(",".join(map(str, row)) for row in [names, *rows]) + "\n")
    assert dropped(read("vr_supermarket", path)) == {
        "the head's matrix is mirrored against those of most rows": [[4, 4]],
        "direction is the fill value -1, -1, -1": [[6, 6]],
    }
