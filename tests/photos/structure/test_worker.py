"""Structure from motion of photos whose poses are known, in the process in which it runs."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import numpy as np
import pytest

from nerg_mi.photos.colmap import read_colmap
from nerg_mi.photos.structure import Folders, Settings, copy_photos, list_photos, pose_errors, reconstruct
from tests.photos.structure import rendered

if importlib.util.find_spec("pycolmap") is None:
    pytest.skip('pycolmap is not installed (pip install "nerg-mi[poses]")', allow_module_level=True)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    return rendered.write_photos(tmp_path_factory.mktemp("photos"))


def found(photos, work):
    """A reconstruction, its model as it is read, and what was told on the way."""
    folders, steps = Folders(work / "images", work / "small"), []
    folders.images.mkdir()
    folders.small.mkdir()
    pictures, _ = copy_photos(list_photos(photos)[0], folders, 320, lambda *now: None)
    made = reconstruct(pictures, work, Settings(threads=1), lambda *now: steps.append(now))
    return made, made and read_colmap(work / "sparse" / "0", folders.images), steps


@pytest.fixture(scope="module")
def first(photos, tmp_path_factory):
    """A folder, and what was found of the photos in it."""
    work = tmp_path_factory.mktemp("first")
    return work, found(photos, work)


def test_poses_and_lens_are_found(first):
    made, model, steps = first[1]
    assert made.parts == [[f"{k}.png" for k in range(8)]] and 0 < made.error < 0.5 and made.points > 300
    assert list(dict.fromkeys(stage for stage, _, _ in steps)) == ["features", "matching", "mapping"]
    assert steps[-1] == ("mapping", 8, 8)
    poses = np.array([f.to_world for f in model.frames])
    assert np.allclose(poses, made.to_world)
    errors = pose_errors(poses, rendered.poses())
    assert errors.rotation.max() < 1 and errors.position.max() < 0.01
    # The model stands upright, and its points are those of a floor and a box on it.
    truth = errors.similarity[:3, :3] / np.cbrt(np.linalg.det(errors.similarity[:3, :3]))
    assert np.degrees(np.arccos(truth[2, 2])) < 1 and made.up.sure and made.up.plane > 0.3
    points = model.points @ errors.similarity[:3, :3].T + errors.similarity[:3, 3]
    low, high = np.quantile(points[:, 2], [0.02, 0.98])
    assert low == pytest.approx(0, abs=0.03) and high == pytest.approx(0.7, abs=0.05)
    lens = model.frames[0].intrinsics(320, 240)
    assert lens.fx == lens.fy == pytest.approx(rendered.FOCAL, rel=0.02) and abs(lens.k1) < 0.05
    assert len(made.surface) == len(made.colors) and made.colors.dtype == np.uint8


def test_equal_photos_give_equal_poses_whatever_their_size(photos, first, tmp_path):
    """The second time with small copies of the same pixels, of photos that are larger: of the same place."""
    from PIL import Image

    (tmp_path / "large").mkdir()
    for path in photos.iterdir():
        Image.open(path).resize((960, 720), Image.Resampling.NEAREST).save(tmp_path / "large" / path.name)
    work, models = [first[0], tmp_path / "b", tmp_path / "c"], [first[1][1]]
    for at, folder in zip(work[1:], (photos, tmp_path / "large")):
        at.mkdir()
        models.append(found(folder, at)[1])
    files = [[(at / "sparse" / "0" / f"{k}.bin").read_bytes() for k in ("images", "points3D")] for at in work[:2]]
    assert files[0] == files[1]
    large, small = models[2].frames[0].intrinsics(960, 720), models[0].frames[0].intrinsics(320, 240)
    assert large.fx == pytest.approx(3 * small.fx, rel=0.02) and large.cx == 480
    errors = pose_errors(*(np.array([f.to_world for f in m.frames]) for m in (models[2], models[0])))
    assert errors.rotation.max() < 0.5 and errors.position.max() < 0.01


def test_nothing_that_fits_together(tmp_path):
    from PIL import Image

    (tmp_path / "photos").mkdir()
    for k in range(3):
        Image.fromarray(np.full((60, 80, 3), 80 * k, np.uint8)).save(tmp_path / "photos" / f"{k}.png")
    assert found(tmp_path / "photos", tmp_path)[0] is None


def test_it_speaks_lines_of_json_alone(photos, tmp_path):
    """What libraries print, and why it ends, goes to the standard error."""
    command = [sys.executable, "-m", "nerg_mi.photos.structure_worker", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1 and done.stdout == "" and "job.json" in done.stderr
