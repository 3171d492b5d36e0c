import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.alignment.constraints import Target
from nerg_mi.alignment.points import Cameras, mean_rotation, read_cameras
from nerg_mi.alignment.similarity import MIRROR, errors, scale_of
from nerg_mi.errors import NergError

from .rooms import carried, similarity

FREE = Target(upright=False)


def both(truth, count=12, seed=0):
    """The same cameras in two frames."""
    rng = np.random.default_rng(seed)
    one = np.tile(np.eye(4), (count, 1, 1))
    one[:, :3, :3] = Rotation.random(count, random_state=seed).as_matrix()
    one[:, :3, 3] = rng.normal(size=(count, 3))
    other = truth @ one
    other[:, :3, :3] /= scale_of(truth)
    return one, other


def quiet(share, text):
    pass


def test_two_cameras_are_enough():
    truth = similarity(np.random.default_rng(1))
    np.testing.assert_allclose(Cameras(*both(truth, 2)).fit(FREE, quiet).matrix, truth, atol=1e-8)


def test_wrong_poses_do_no_harm():
    truth = similarity(np.random.default_rng(2))
    one, other = both(truth)
    other[:3, :3, 3] += 5
    other[2:4, :3, :3] = Rotation.random(2, random_state=9).as_matrix()
    fit = Cameras(one, other).fit(FREE, quiet)
    assert errors(fit.matrix, one[:, :3, 3], carried(truth, one[:, :3, 3])).max() < 1e-3
    assert fit.about == {"cameras": 12, "agreeing": 8}


def test_a_mirrored_model_is_named():
    truth = similarity(np.random.default_rng(3))
    one, other = both(truth)
    one[:, :3, 3] = carried(MIRROR, one[:, :3, 3])
    try:
        said = Cameras(one, other).fit(FREE, quiet).mirrored
    except NergError as error:
        said = str(error)
    assert "mirrored" in said or "axis negated" in said


def test_another_convention_is_told():
    one, other = both(similarity(np.random.default_rng(4)), seed=5)
    other[:, :3, 1:3] *= -1
    assert any("convention" in d for d in Cameras(one, other).fit(FREE, quiet).doubts)


def test_cameras_that_leave_it_open_are_refused():
    one, other = both(np.eye(4))
    with pytest.raises(NergError, match="1 pictures in common"):
        Cameras(one[:1], other[:1]).fit(FREE, quiet)
    one[:, :3, 3] = 1.0
    with pytest.raises(NergError, match="all stand at one place"):
        Cameras(one, other).fit(FREE, quiet)


def test_the_mean_rotation_is_the_median_of_most():
    truth = Rotation.random(random_state=1)
    given = Rotation.concatenate([truth] * 7 + [Rotation.random(random_state=k) for k in range(2, 6)])
    np.testing.assert_allclose(mean_rotation(given.as_matrix()), truth.as_matrix(), atol=1e-3)


def write_model(folder, poses, names):
    folder.mkdir()
    frames = [{"file_path": n, "transform_matrix": p.tolist()} for n, p in zip(names, poses)]
    for n in names:
        (folder / n).write_bytes(b"")
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 10.0, "w": 8, "h": 6, "frames": frames}))


def test_pictures_are_known_again_by_their_names(tmp_path):
    truth = similarity(np.random.default_rng(6))
    one, other = both(truth, 5)
    write_model(tmp_path / "a", one, ["0.png", "1.png", "2.png", "3.png", "x.png"])
    write_model(tmp_path / "b", other[::-1], ["y.png", "3.jpg", "2.jpg", "1.jpg", "0.jpg"])
    found = read_cameras(tmp_path / "a", tmp_path / "b")
    assert len(found.tracking) == 4
    np.testing.assert_allclose(found.fit(FREE, quiet).matrix, truth, atol=1e-6)
    write_model(tmp_path / "c", one, [f"{k}.tif" for k in range(10, 15)])
    with pytest.raises(NergError, match="no two pictures of the same name"):
        read_cameras(tmp_path / "a", tmp_path / "c")
