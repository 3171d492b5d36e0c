"""One set of known cameras and pictures, written in every format and read back ray by ray."""

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.photos.cameras import Camera, Intrinsics, pixel_directions
from nerg_mi.photos.dataset import explain_wrong_depth, open_dataset
from tests.photos.written_sets import (
    COUNT,
    FISHEYE,
    METRES_ALONG_RAYS,
    OPENCV,
    H,
    W,
    cameras,
    colmap_bin,
    colmap_txt,
    expected_rays,
    instant_ngp,
    lens_keys,
    nerfstudio,
    opengl,
    picture,
    rewrite,
)
from tests.reference import opencv


@pytest.mark.parametrize("lens", [OPENCV, FISHEYE], ids=["opencv", "fisheye"])
@pytest.mark.parametrize("write", [nerfstudio, instant_ngp, colmap_bin, colmap_txt])
def test_every_format_gives_the_same_rays_and_pixels(tmp_path, rgb, write, lens):
    coordinates = write(tmp_path, rgb, lens)
    data = open_dataset(tmp_path, holdout=0, coordinates=coordinates)
    assert len(data.train) == COUNT and not data.unused
    for k, (view, pose) in enumerate(zip(data.train, cameras())):
        origin, d = expected_rays(lens, pose)
        ours = pixel_directions(view.camera.intrinsics) @ view.camera.to_world[:3, :3].T
        assert np.abs(ours - d).max() < 1e-6 and np.abs(view.camera.center - origin).max() < 1e-9
        assert np.array_equal(view.pixels, picture(k))


def test_frames_that_cannot_be_used_are_left_out_and_listed(ring, rgb):
    def change(content):
        frames = {f["file_path"]: f for f in content["frames"]}
        frames["./images/1.png"]["transform_matrix"][0] = [0, 0, 0, 0]
        frames["./images/2.png"]["w"] = 999
        frames["./images/4.png"]["k1"] = -9.0
        frames["./images/5.png"]["transform_matrix"] = np.diag([1, 1, 1, 1.0]).tolist()
        frames["./images/5.png"]["transform_matrix"][2][3] = -500.0
        content["frames"].append(dict(frames["./images/6.png"]))

    rewrite(ring, change)
    (ring / "images/0.png").unlink()
    (ring / "images/3.png").write_bytes(b"broken")
    data = open_dataset(ring, holdout=0)
    assert [v.name for v in data.train] == [f"./images/{k}.png" for k in (6, 7, 8)]
    reasons = {u.name: u.reason for u in data.unused}
    for k, part in {
        0: "does not exist",
        1: "singular",
        2: "14 x 10",
        3: "3.png",
        4: "inverted",
        5: "no other frame",
        6: "twice",
    }.items():
        assert part in reasons[f"./images/{k}.png"]
    assert data.source["unused"] == reasons and data.source["training_frames"] == 3
    assert str(data.unused[0]).startswith('left out "./images/')


def test_a_set_without_overlap_is_refused(ring):
    def change(content):
        for k, f in enumerate(content["frames"]):
            m = np.eye(4)
            m[0, 3] = 10 * k
            f["transform_matrix"] = m.tolist()

    rewrite(ring, change)
    with pytest.raises(ValueError, match="no two of the 9.*same place"):
        open_dataset(ring, holdout=0, aabb=(-5, -5, -3, 85, 5, 0))


def test_a_set_without_a_usable_picture_is_refused(ring):
    for path in (ring / "images").iterdir():
        path.write_bytes(b"")
    with pytest.raises(ValueError, match="9.*0.png"):
        open_dataset(ring, holdout=0)


def test_masks_and_depth_arrive_at_the_chosen_size(ring, rgb):
    """A mask's border leaves out every pixel that it touches; millimetres along the axis become distances along
    rays."""
    mask = np.full((H, W), 255, np.uint8)
    mask[:, 5:] = 0
    rgb.Bitmap(mask).write(str(ring / "mask.png"))
    rgb.Bitmap(np.full((H // 2, W // 2), 2500, np.uint16)).write(str(ring / "depth.png"))
    rewrite(ring, lambda c: [f.update(mask_path="mask.png", depth_file_path="depth.png") for f in c["frames"]])
    data = open_dataset(ring, width=7)
    view = data.train[0]
    assert view.mask.shape == (5, 7) and view.mask[:, :2].all() and not view.mask[:, 2:].any()
    ahead = -pixel_directions(view.camera.intrinsics)[..., 2]
    assert np.allclose(view.depth * ahead, 2.5, rtol=1e-5) and view.pixels.dtype == np.uint16
    assert "metre" in data.unit
    rgb.Bitmap(np.zeros((H, W), np.uint8)).write(str(ring / "mask.png"))
    with pytest.raises(ValueError, match="every pixel"):
        open_dataset(ring)


def test_corners_that_a_fisheye_does_not_show_are_masked(ring):
    small = replace(FISHEYE, fx=2.0, fy=2.0, k1=-0.1, k2=0.0, k3=0.0, k4=0.0)
    rewrite(ring, lambda c: (c.update(is_fisheye=True), [f.update(lens_keys(small)) for f in c["frames"]]))
    view = open_dataset(ring, holdout=0).train[0]
    assert not view.mask[0, 0] and view.mask[H // 2, W // 2] and 0.1 < view.mask.mean() < 0.9


def test_box_unit_and_scale(ring):
    box = [[-1, -1, -1], [1, 2, 1]]
    rewrite(ring, lambda c: c.update(aabb=box))
    data = open_dataset(ring, scale=0.5)
    assert np.allclose(data.box.lower, [-0.51875] * 3) and np.allclose(data.box.upper, [0.51875, 1.01875, 0.51875])
    assert "counts 0.5" in data.unit and np.allclose(data.source["to_file"], np.diag([2, 2, 2, 1]))
    centers = np.array([v.camera.center for v in open_dataset(ring, holdout=0).train])
    assert np.allclose([v.camera.center for v in open_dataset(ring, holdout=0, scale=0.5).train], centers / 2)
    given = open_dataset(ring, aabb=(0, 0, 0, 1, 1, 1))
    assert np.allclose(given.box.side, 1.025)
    for wrong in ({"aabb": (0, 0, 0)}, {"scale": 0.0}, {"coordinates": "elsewhere"}, {"coordinates": "original"}):
        with pytest.raises(ValueError):
            open_dataset(ring, **wrong)


def test_depth_finds_the_box(ring):
    """A wall 2 units from every camera along each ray: the points are where the depth says."""
    np.save(ring / "d.npy", np.full((H, W), 2.0, np.float32))
    rewrite(ring, lambda c: [f.update(METRES_ALONG_RAYS, depth_file_path="d.npy") for f in c["frames"]])
    data = open_dataset(ring, holdout=0)
    points = np.concatenate([(o + 2 * d).reshape(-1, 3) for o, d in (expected_rays(OPENCV, p) for p in cameras())])
    lower, upper = np.quantile(points, [0.0005, 0.9995], axis=0)
    assert "points on surfaces" in data.box_from
    assert np.allclose(data.box.lower, lower - 0.05 * np.max(upper - lower), atol=1e-3)
    assert data.train[0].depth.dtype == np.float32 and "box" not in open_dataset(ring, depth=False).box_from


def test_the_fox_has_the_rays_that_it_always_had(recorded):
    """OpenCV's model, restated, at some pixels of some frames."""
    folder = recorded("fox")
    data = open_dataset(folder, width=135)
    assert (len(data.train), len(data.held_out), len(data.unused)) == (43, 7, 17)
    content = json.loads((folder / "transforms.json").read_text())
    frames = {f["file_path"]: np.array(f["transform_matrix"]) for f in content["frames"]}
    k = [content[n] for n in ("k1", "k2", "p1", "p2")] + [0, 0, 0, 0]
    for view in data.train[::10]:
        d = pixel_directions(view.camera.intrinsics) @ view.camera.to_world[:3, :3].T
        for column, row in ((0, 0), (134, 239), (60, 100)):
            # Pixel centres of the picture at an eighth of the size, in the large one.
            u, v = (column + 0.5) * 8 - 0.5, (row + 0.5) * 8 - 0.5
            ray = opencv.undistort(u, v, content["fl_x"], content["fl_y"], content["cx"] - 0.5, content["cy"] - 0.5, k)
            ray = frames[view.name][:3, :3] @ (ray * [1, -1, -1])
            assert np.allclose(d[row, column], ray / np.linalg.norm(ray), atol=1e-6)


@pytest.fixture(scope="module")
def seen_by_depth():
    """Cameras and depth (distances along rays, metres) of a room of 4 x 3 x 2.5 m that they walk about in."""
    seen = []
    for k in range(12):
        a = 2 * np.pi * k / 12
        z = np.array([-np.cos(a), -np.sin(a), -0.1])
        z /= np.linalg.norm(z)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        pose = np.column_stack([np.stack([x, np.cross(z, x), z], axis=1), [2 + np.cos(a), 1.5 + 0.7 * np.sin(a), 1.2]])
        camera = Camera(Intrinsics(24, 18, 15.0, 15.0, 12.0, 9.0), opengl(pose))
        d = pixel_directions(camera.intrinsics) @ camera.to_world[:3, :3].T
        with np.errstate(divide="ignore"):
            walls = np.maximum((0 - camera.center) / d, ([4, 3, 2.5] - camera.center) / d)
        seen.append((camera, walls.min(axis=-1)))
    return seen


@pytest.mark.parametrize("factor", [1.0, 1.05, 1.5, 0.7])
def test_depth_that_fits_its_cameras(seen_by_depth, factor):
    assert explain_wrong_depth([(c, factor * d) for c, d in seen_by_depth]) is None


@pytest.mark.parametrize("factor", [1e-3, 1e-2, 0.1, 0.2, 5.0, 100.0, 1e3])
def test_depth_in_other_units_than_the_cameras_is_explained(seen_by_depth, factor):
    reason = explain_wrong_depth([(c, factor * d) for c, d in seen_by_depth])
    assert reason is not None and f"multiplied by {1 / factor:g}, " in reason


def test_depth_that_all_views_have_alike_is_no_evidence(seen_by_depth):
    """It agrees in any unit that makes the cameras' distances small."""
    assert explain_wrong_depth([(c, np.full_like(d, 0.1)) for c, d in seen_by_depth]) is None
    assert "median is 1e+03 units" in explain_wrong_depth([(c, np.full_like(d, 1000.0)) for c, d in seen_by_depth])


def test_depth_far_outside_of_the_cameras_is_refused(ring):
    np.save(ring / "d.npy", np.full((H, W), 2000.0, np.float32))
    rewrite(ring, lambda c: [f.update(depth_file_path="d.npy") for f in c["frames"]])
    assert np.allclose(np.median(open_dataset(ring).train[0].depth), 2.0, rtol=0.2)
    rewrite(ring, lambda c: c.update(depth_unit_scale_factor=1.0))
    with pytest.raises(NergError, match="depth_unit_scale_factor.*--no-depth"):
        open_dataset(ring)
    assert open_dataset(ring, depth=False).train


@pytest.mark.parametrize("lens", [OPENCV, FISHEYE], ids=["opencv", "fisheye"])
def test_what_masks_leave_out_is_said(tmp_path, rgb, lens):
    """Where it is nothing as well, which a fisheye's dark corners do not hide."""
    instant_ngp(tmp_path, rgb, lens)
    rewrite(tmp_path, lambda c: [f.update(mask_path="mask.png") for f in c["frames"]])
    mask = np.full((H, W), 255, np.uint8)
    rgb.Bitmap(mask).write(str(tmp_path / "mask.png"))
    assert f"the masks of all {COUNT} frames that have one leave out nothing" in open_dataset(tmp_path).notes[-1]
    mask[:, : W // 2] = 0
    rgb.Bitmap(mask).write(str(tmp_path / "mask.png"))
    assert open_dataset(tmp_path).notes[-1] == f"masks leave out 50.0% of the pixels of {COUNT} frames"


def test_a_turned_photo_costs_its_frame_by_that_reason(ring, rgb):
    """Swapping width and height would train on turned rays."""
    rgb.Bitmap(np.ascontiguousarray(np.rot90(picture(0)))).write(str(ring / "images/0.png"))
    data = open_dataset(ring, holdout=0)
    assert len(data.train) == COUNT - 1 and "turn the pixels as the camera was held" in data.unused[0].reason
