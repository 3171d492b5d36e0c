"""Tests of nerg_mi.maths.transforms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.maths.transforms import check_rigid_transforms, invert_similarity


def make_poses(count=5):
    matrices = np.tile(np.eye(4), (count, 1, 1))
    matrices[:, :3, :3] = Rotation.random(count, random_state=1).as_matrix()
    matrices[:, :3, 3] = np.random.default_rng(2).normal(size=(count, 3))
    return matrices


def test_rigid_transforms_pass():
    matrices = make_poses()
    check_rigid_transforms(matrices, "pose")
    check_rigid_transforms(matrices[0], "pose")
    check_rigid_transforms(matrices[:, :3], "pose")
    check_rigid_transforms(np.round(matrices, 3).astype(np.float32), "pose")
    matrices[:, :3, :3] *= 0.01
    check_rigid_transforms(matrices, "alignment", may_scale=True)
    check_rigid_transforms(np.empty((0, 4, 4)), "pose")


def change(matrix, rows, columns, value):
    matrix[rows, columns] = value
    return matrix


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda m: m.T, "transposed"),
        (lambda m: change(m, 3, slice(None), [0.3, 0.2, 0.1, 0.7]), "0.3, 0.2, 0.1, 0.7"),
        (lambda m: change(m, 3, 3, 0), "last row is 0, 0, 0, 0"),
        (lambda m: m @ np.diag([1, 1, -1, 1]), "mirrored"),
        (lambda m: m @ np.diag([2, 1, 1, 1]), "not a rotation"),
        (lambda m: m @ np.diag([1, 0, 1, 1]), "not a rotation"),
        (lambda m: change(m, 0, 0, np.nan), "not finite"),
        (lambda m: change(m, 1, 3, np.inf), "not finite"),
        (lambda m: change(m, 0, slice(0, 3), m[0, :3] + 0.1), "not a rotation"),
    ],
)
@pytest.mark.parametrize("may_scale", [False, True])
def test_other_matrices_are_refused_by_name(spoil, words, may_scale):
    matrices = make_poses()
    matrices[3] = spoil(matrices[3].copy())
    with pytest.raises(NergError, match="head.*matrix 3.*" + words):
        check_rigid_transforms(matrices, "head", may_scale=may_scale)
    with pytest.raises(NergError, match="head.*line 5.*" + words):
        check_rigid_transforms(matrices, "head", lambda row: f"line {row + 2}", may_scale=may_scale)
    with pytest.raises(NergError, match="head.*" + words):
        check_rigid_transforms(matrices[3], "head", may_scale=may_scale)


def test_scale_is_named():
    matrix = make_poses()[0] @ np.diag([2.5, 2.5, 2.5, 1])
    with pytest.raises(NergError, match=r"scale of 2\.5"):
        check_rigid_transforms(matrix, "pose")


@pytest.mark.parametrize("shape", [(3, 3), (16,), (2, 4, 3), (1, 2, 4, 4)])
def test_other_shapes_are_refused(shape):
    with pytest.raises(NergError, match="pose has the shape"):
        check_rigid_transforms(np.ones(shape), "pose")


@pytest.mark.parametrize("values", [[[1, 0], [0]], "abc", None, np.eye(4) * 1j, [["1", "0", "0", "0"]] * 4])
def test_values_that_are_no_numbers_are_refused(values):
    with pytest.raises(NergError, match="pose"):
        check_rigid_transforms(values, "pose")


def test_reflections_pass_only_where_frames_may_be_mirrored():
    matrix = 0.01 * make_poses()[0] @ np.diag([1, 1, -1, 1])
    matrix[3] = 0, 0, 0, 1
    check_rigid_transforms(matrix, "frame", may_scale=True, may_mirror=True)
    with pytest.raises(NergError, match="mirrored"):
        check_rigid_transforms(matrix, "frame", may_scale=True)
    for other, words in ((matrix.T, "transposed"), (matrix @ np.diag([1, 2, 1, 1]), "not a rotation")):
        with pytest.raises(NergError, match=words):
            check_rigid_transforms(other, "frame", may_scale=True, may_mirror=True)


def test_inverse_of_similarity():
    matrix = make_poses()[0] @ np.diag([2, 2, 2, 1])
    np.testing.assert_allclose(invert_similarity(matrix.tolist(), "frame") @ matrix, np.eye(4), atol=1e-12)
    for other in (np.zeros((4, 4)), matrix[:3], matrix.T, make_poses(), {}):
        with pytest.raises(NergError, match="frame"):
            invert_similarity(other, "frame")
