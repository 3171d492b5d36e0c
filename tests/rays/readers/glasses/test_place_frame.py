"""The coordinates of a place that was trained."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.formats.checkpoint import write_checkpoint
from nerg_mi.rays.readers.scene_glasses import PlaceFrame


def write_place(path, **provenance):
    write_checkpoint(path, "radiance", {"a": np.zeros(1, np.float32)}, {"provenance": provenance})
    return path


def test_the_place_is_what_the_file_was_turned_into(tmp_path):
    to_place = np.eye(4)
    to_place[:3, :3] = 0.3 * Rotation.from_euler("xyz", [1, 2, 3]).as_matrix()
    to_place[:3, 3] = 1, 2, 3
    path = write_place(tmp_path / "p.safetensors", to_file=np.linalg.inv(to_place).tolist(), up=[0, 1, 0], sha256="ab")
    found, points = PlaceFrame.of_checkpoint(path), np.random.default_rng(0).normal(size=(9, 3))
    assert np.allclose(found.points(points), points @ to_place[:3, :3].T + to_place[:3, 3])
    assert np.isclose(found.scale, 0.3) and np.allclose(found.rotation, to_place[:3, :3] / 0.3)
    assert found.up is not None and found.up.tolist() == [0, 1, 0] and found.sha256 == "ab"
    assert np.allclose(PlaceFrame.scaled(2.0).points(points), 2 * points)


@pytest.mark.parametrize(
    "provenance, message",
    [
        ({}, "does not say in which coordinates"),
        ({"to_file": [1, 2]}, "does not say in which coordinates"),
        ({"to_file": np.diag([1.0, 2, 1, 1]).tolist()}, "no similarity"),
        ({"to_file": np.diag([1.0, -1, 1, 1]).tolist()}, "no similarity"),
        ({"to_file": np.zeros((4, 4)).tolist()}, "no similarity"),
    ],
)
def test_places_that_do_not_tell(tmp_path, provenance, message):
    with pytest.raises(NergError, match=message):
        PlaceFrame.of_checkpoint(write_place(tmp_path / "p.safetensors", **provenance))


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, 1e12])
def test_scales_that_are_none(scale):
    with pytest.raises(NergError, match="--scale"):
        PlaceFrame.scaled(scale)
