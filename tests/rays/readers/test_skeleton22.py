"""Skeleton files as rays."""

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.rays.readers.parsing.bodies import RIGHT_EAR, head_poses, keypoints_from_head
from nerg_mi.rays.readers.parsing.skeleton_file import write_skeleton
from nerg_mi.rays.readers.skeleton22 import parse_keypoints
from tests.rays.readers.parsing.test_bodies import heads
from tests.rays.readers.reading import read


def test_rays_of_a_file(tmp_path):
    origin, direction = heads(50)
    body = keypoints_from_head(origin, direction)
    body[7, RIGHT_EAR] = np.nan
    path = tmp_path / "day.csv.gz"
    write_skeleton(path, [f"p{i % 3}" for i in range(50)], np.arange(50), body)
    rays = read("skeleton22", path, tick=0.1)
    keep = np.arange(50) != 7
    assert len(rays) == 49 and rays.persons == ("p0", "p1", "p2") and rays.hit is None
    assert np.allclose(rays.t, np.arange(50)[keep] * 0.1)
    assert np.abs(rays.direction - direction[keep]).max() < 2e-5  # micrometres in the file
    assert rays.metadata["dropped"] == [
        {"reason": "origin is missing", "file": "day.csv.gz", "count": 1, "rows": [[8, 8]]}
    ]
    assert rays.metadata["preset"] == "skeleton22" and rays.metadata["keypoints"] == [2, 13, 11]


def test_other_keypoints_and_pitch(tmp_path):
    origin, direction = (v[2:] for v in heads(40))
    body = keypoints_from_head(origin, direction)
    swapped = body[:, ::-1]
    path = tmp_path / "day.csv"
    write_skeleton(path, ["ann"] * 38, np.arange(38), swapped)
    rays = read("skeleton22", path, keypoints=(19, 8, 10), pitch=10)
    assert np.allclose(rays.direction, head_poses(body, pitch=10)[1], atol=2e-5) and rays.metadata["pitch"] == 10
    path.write_text(path.read_text().replace(f"{swapped[3, 8, 0]:.6f}", "left"))
    with pytest.raises(ValueError, match="line 4: 'left' is not a number"):
        read("skeleton22", path, keypoints=(19, 8, 10))


def test_keypoints_of_the_command_line():
    assert parse_keypoints("19,8,10") == (19, 8, 10)
    for text in ("1,2", "1,2,3,4", "a,b,c"):
        with pytest.raises(NergError, match="--keypoints is three numbers"):
            parse_keypoints(text)
