"""Tests of `nerg_mi.alignment.points`."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import nerg_mi as nerg
from nerg_mi.alignment.constraints import AlignmentTarget
from nerg_mi.alignment.points import Cameras, Pairs, mean_rotation, read_cameras, read_pairs
from nerg_mi.alignment.similarity import MIRROR, residual_distances
from nerg_mi.errors import NergError
from nerg_mi.maths.transforms import similarity_scale

from .rooms import carried, similarity

# ---- Camera poses ----

FREE = AlignmentTarget(is_upright=False)


def both(truth, count=12, seed=0):
    """The same cameras in two frames."""
    rng = np.random.default_rng(seed)
    one = np.tile(np.eye(4), (count, 1, 1))
    one[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    one[:, :3, 3] = rng.normal(size=(count, 3))
    other = truth @ one
    other[:, :3, :3] /= similarity_scale(truth)
    return one, other


def quiet(share, text):
    pass


def test_two_cameras_suffice():
    truth = similarity(np.random.default_rng(1))
    np.testing.assert_allclose(Cameras(*both(truth, 2)).fit(FREE, quiet).matrix, truth, atol=1e-8)


def test_outlier_poses_are_ignored():
    truth = similarity(np.random.default_rng(2))
    one, other = both(truth)
    other[:3, :3, 3] += 5
    other[2:4, :3, :3] = Rotation.random(2, random_state=9).as_matrix()
    fit = Cameras(one, other).fit(FREE, quiet)
    assert residual_distances(fit.matrix, one[:, :3, 3], carried(truth, one[:, :3, 3])).max() < 1e-3
    assert fit.metadata == {"cameras": 12, "agreeing": 8}


def test_mirrored_model_is_reported():
    truth = similarity(np.random.default_rng(3))
    one, other = both(truth)
    one[:, :3, 3] = carried(MIRROR, one[:, :3, 3])
    try:
        said = Cameras(one, other).fit(FREE, quiet).mirrored
    except NergError as error:
        said = str(error)
    assert "mirrored" in said or "axis negated" in said


def test_other_camera_convention_is_reported():
    one, other = both(similarity(np.random.default_rng(4)), seed=5)
    other[:, :3, 1:3] *= -1
    assert any("convention" in d for d in Cameras(one, other).fit(FREE, quiet).warnings)


def test_degenerate_cameras_are_refused():
    one, other = both(np.eye(4))
    with pytest.raises(NergError, match="1 photos in common"):
        Cameras(one[:1], other[:1]).fit(FREE, quiet)
    one[:, :3, 3] = 1.0
    with pytest.raises(NergError, match="all have the same position"):
        Cameras(one, other).fit(FREE, quiet)


def test_mean_rotation_is_robust():
    truth = Rotation.random(random_state=1)
    value = Rotation.concatenate([truth] * 7 + [Rotation.random(random_state=k) for k in range(2, 6)])
    np.testing.assert_allclose(mean_rotation(value.as_matrix()), truth.as_matrix(), atol=1e-3)


def write_model(folder, poses, names):
    folder.mkdir()
    frames = [{"file_path": n, "transform_matrix": p.tolist()} for n, p in zip(names, poses)]
    for n in names:
        (folder / n).write_bytes(b"")
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 10.0, "w": 8, "h": 6, "frames": frames}))


def test_photos_are_matched_by_name(tmp_path):
    truth = similarity(np.random.default_rng(6))
    one, other = both(truth, 5)
    write_model(tmp_path / "a", one, ["0.png", "1.png", "2.png", "3.png", "x.png"])
    write_model(tmp_path / "b", other[::-1], ["y.png", "3.jpg", "2.jpg", "1.jpg", "0.jpg"])
    result = read_cameras(tmp_path / "a", tmp_path / "b")
    assert len(result.tracking) == 4
    np.testing.assert_allclose(result.fit(FREE, quiet).matrix, truth, atol=1e-6)
    write_model(tmp_path / "c", one, [f"{k}.tif" for k in range(10, 15)])
    with pytest.raises(NergError, match="fewer than two photos"):
        read_cameras(tmp_path / "a", tmp_path / "c")


# ---- Pairs ----

HEAD = "name,x,y,z,place_x,place_y,place_z\n"


def made(count=6, seed=0, noise=0.01):
    rng = np.random.default_rng(seed)
    truth, x = similarity(rng), rng.uniform(0, 4, (count, 3))
    return truth, x, carried(truth, x + rng.normal(0, noise, x.shape))


def test_pairs_give_alignment_and_uncertainty():
    truth, x, y = made()
    fit = Pairs(x, y).fit(FREE, quiet)
    assert residual_distances(fit.matrix, x, carried(truth, x)).max() < 0.03
    assert np.median(fit.residuals_cm) < 3 and len(fit.residuals_deg) == 6 and fit.mirrored is None
    assert fit.covariance.shape == (7, 7) and fit.metadata["leave_one_out_cm"]["largest"] > max(fit.residuals_cm)


def test_mirrored_frame_is_reported():
    _, x, y = made()
    assert "the pairs meet to" in Pairs(carried(MIRROR, x), y).fit(FREE, quiet).mirrored


def test_coplanar_points_cannot_detect_a_mirror():
    truth, x, _ = made()
    flat = x * (1, 1, 0)
    fit = Pairs(flat, carried(truth @ MIRROR, flat)).fit(FREE, quiet)
    assert fit.mirrored is None and any("in a plane" in note for note in fit.notes)


def test_outlier_pair_is_reported():
    _, x, y = made(7, noise=0.001)
    y[3] += 2.0
    (doubt,) = Pairs(x, y, names=tuple("abcdefg")).fit(FREE, quiet).warnings
    assert 'pair 4 ("d")' in doubt and "check this pair" in doubt


def test_two_pairs_with_another_up_axis():
    rng = np.random.default_rng(5)
    truth, x = similarity(rng, upright=True), rng.uniform(0, 4, (2, 3))
    turn = np.eye(4)[[0, 2, 1, 3]] * [[1], [-1], [1], [1]]
    y_up = carried(np.linalg.inv(turn) @ truth, x)
    fit = Pairs(x, y_up).fit(AlignmentTarget(to_z_up=turn, is_upright=True), quiet)
    np.testing.assert_allclose(fit.matrix, np.linalg.inv(turn) @ truth, atol=1e-9)


def test_pair_files_are_read(tmp_path):
    rows = [[1, 2, 3, 4, 5, 6], [0, 0, 1, 1, 0, 0.5]]
    (tmp_path / "p.csv").write_text(HEAD + "".join(f"n{k},{','.join(map(str, r))}\n" for k, r in enumerate(rows)))
    pairs = [{"tracking": r[:3], "place": r[3:], "name": f"n{k}"} for k, r in enumerate(rows)]
    (tmp_path / "p.json").write_text(json.dumps(pairs))
    (tmp_path / "q.json").write_text(json.dumps({"pairs": pairs}))
    for name in ("p.csv", "p.json", "q.json"):
        result = read_pairs(tmp_path / name)
        np.testing.assert_array_equal(np.c_[result.tracking, result.environment], rows)
        assert result.names == ("n0", "n1")


@pytest.mark.parametrize(
    "name, text, why",
    [
        ("a.csv", "x,y,z\n1,2,3\n", "no column place_x"),
        ("a.csv", HEAD, "no pairs"),
        ("a.json", "[]", "no pairs"),
        ("a.json", '{"a": 1}', "cannot be read"),
        ("a.json", '[{"tracking": [1, 2], "place": [1, 2]}]', "3 numbers"),
        ("a.json", "[1, 2]", "cannot be read"),
        ("a.csv", "x,y,z,place_x,place_y,place_z\n0,5,1,5,0,1,1,2,3\n", "line 2: 9 cells, the header has 6; are these"),
    ],
)
def test_invalid_files_are_refused(tmp_path, name, text, why):
    (tmp_path / name).write_text(text)
    with pytest.raises(NergError, match=why):
        read_pairs(tmp_path / name)


def test_empty_cells_are_refused(tmp_path):
    (tmp_path / "a.csv").write_text(HEAD + "a,1,2,3,4,5,\nb,0,0,0,0,0,0\nc,1,0,0,1,0,0\n")
    with pytest.raises(NergError, match="points in the frame"):
        read_pairs(tmp_path / "a.csv").fit(FREE, quiet)


# ---- The operation ----

ROWS = "0,0,0,1,0,0\n2,0,0,5,0,0\n0,1,0,1,2,0\n0,0,1,1,0,2\n"


def test_files_may_be_named_by_strings(tmp_path):
    (tmp_path / "p.csv").write_text("x,y,z,place_x,place_y,place_z\n" + ROWS)
    result = nerg.align(output=str(tmp_path / "a.json"), pairs=str(tmp_path / "p.csv"))
    np.testing.assert_allclose(result.matrix, json.loads((tmp_path / "a.json").read_text())["matrix"])
    np.testing.assert_allclose(result.matrix[:3, :3], 2 * np.eye(3), atol=1e-12)
