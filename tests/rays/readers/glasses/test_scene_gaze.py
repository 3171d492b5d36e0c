"""Gaze of a scene camera in the coordinates in which its place was trained."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.errors import NergError
from nerg_mi.photos.colmap import read_named_poses
from nerg_mi.photos.images import read_split
from nerg_mi.rays.quality import summarise
from tests.photos.test_named_poses import write_transforms
from tests.rays.readers.examples import EXAMPLES
from tests.rays.readers.glasses.test_place_frame import write_place
from tests.rays.readers.reading import read


@pytest.fixture
def neon(tmp_path):
    EXAMPLES["neon"].make(tmp_path)
    return tmp_path, EXAMPLES["neon"].options_in(tmp_path)


def turn_model(path, rotation, scale=1.0):
    """The model of ``path`` in other coordinates."""
    frames = json.loads(path.read_text())["frames"]
    move = np.eye(4)
    move[:3, :3] = rotation.as_matrix()
    poses = {f["file_path"]: move @ f["transform_matrix"] for f in frames}
    for pose in poses.values():
        pose[:3, 3] *= scale
    write_transforms(path, poses)


def test_an_upright_place_has_the_rays_of_its_training(neon):
    """The model lies on its side and is twice as large; training turned it upright and gave its scale."""
    folder, options = neon
    straight = read("neon", folder, **options)
    turn_model(options["poses"], Rotation.from_euler("x", 70, degrees=True), 2.0)
    for f in json.loads(options["poses"].read_text())["frames"]:
        (folder / f["file_path"]).parent.mkdir(exist_ok=True)
        (folder / f["file_path"]).write_bytes(b"")
    split = read_split(options["poses"], 0, "upright", 0.5)
    place = write_place(
        folder / "place.safetensors", to_file=split.posed.to_file.tolist(), sha256=split.posed.sha256, up=[0, 0, 1]
    )
    rays = read("neon", folder, **options, place=place)
    assert np.allclose(rays.origin, straight.origin, atol=1e-9) and "complaints" not in rays.metadata
    assert np.allclose(rays.direction, straight.direction, atol=1e-9)
    # The poses of the training itself, as capture reads them.
    frames = [f for f in split.posed.frames if f.name.startswith("scene")]
    assert np.allclose(rays.origin[0], frames[0].to_world[:3, 3], atol=0.01)
    assert read_named_poses(options["poses"]).sha256 == split.posed.sha256
    with pytest.raises(NergError, match="leave out --scale"):
        read("neon", folder, **options, place=place, scale=2.0)


def test_a_place_of_another_file_is_told(neon):
    folder, options = neon
    place = write_place(folder / "place.safetensors", to_file=np.eye(4).tolist(), sha256="00")
    rays = read("neon", folder, **options, place=place)
    assert any("another file" in c for c in rays.metadata["complaints"])
    assert any("another file" in w for w in summarise(rays).warnings)


@pytest.mark.parametrize("known", [False, True])
def test_a_place_that_lies_on_its_side_is_told(neon, known):
    """By how its cameras are held, or by what its training knew; declared, the rays are z up."""
    folder, options = neon
    straight = read("neon", folder, **options)
    turn_model(options["poses"], Rotation.from_euler("x", 90, degrees=True))
    if known:
        options["place"] = write_place(folder / "p.safetensors", to_file=np.eye(4).tolist(), up=[0, -1, 0])
    rays = read("neon", folder, **options)
    (complaint,) = rays.metadata["complaints"]
    assert "90 degrees from z" in complaint and "--up -y" in complaint and "--write-align" in complaint
    rays = read("neon", folder, **options, up="-y")
    assert "complaints" not in rays.metadata
    assert np.allclose(rays.origin, straight.origin) and np.allclose(rays.direction, straight.direction)


@pytest.mark.parametrize("name, value", [("fps", 0.0), ("gap", -1.0)])
def test_options_that_are_none(name, value):
    with pytest.raises(NergError, match=f"--{name}"):
        read("neon", "nowhere", **{name: value})


def test_one_frame_is_no_track(neon):
    folder, options = neon
    model = json.loads(options["poses"].read_text())
    options["poses"].write_text(json.dumps({"frames": model["frames"][:2]}))
    with pytest.raises(NergError, match="two are needed"):
        read("neon", folder, **options)
