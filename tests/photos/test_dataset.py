"""Tests of `nerg_mi.photos.dataset`."""

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.maths.geometry import Box
from nerg_mi.photos.cameras import Intrinsics, PosedCamera, pixel_directions
from nerg_mi.photos.dataset import estimate_box, estimate_extent, explain_wrong_depth, find_unmatched, open_dataset
from tests.photos.written_sets import (
    COUNT,
    FISHEYE,
    METRES_ALONG_RAYS,
    OPENCV,
    H,
    W,
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
from tests.photos.written_sets import cameras as cameras_
from tests.reference import opencv

# ---- Scene box around an object, in a room and around points; cameras without overlap ----

LENS = Intrinsics(10, 10, 10.0, 10.0, 5.0, 5.0)


def make_camera_looking_at(center, at):
    z = np.subtract(center, at) / np.linalg.norm(np.subtract(center, at))
    x = np.cross([0, 0.3, 1.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), center
    return PosedCamera(LENS, pose)


def directions(count, seed=4):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


AROUND = [make_camera_looking_at(np.array([1, 2, 3]) + 4 * d, [1, 2, 3]) for d in directions(20)]
INSIDE = [
    make_camera_looking_at(c, c + d) for c, d in zip(np.random.default_rng(4).uniform(0, 4, (20, 3)), directions(20))
]


def test_around_an_object():
    box, _ = estimate_box(AROUND)
    assert np.allclose(box.center, [1, 2, 3], atol=1e-6) and box.side == pytest.approx(10)
    assert estimate_box(AROUND, object_only=True)[0].side == pytest.approx(4)


def test_in_a_room():
    box, how = estimate_box(INSIDE)
    assert "around the cameras" in how
    assert np.all(np.array(box.lower) < 0) and np.all(np.array(box.upper) > 4)


def test_at_one_point():
    with pytest.raises(ValueError, match="aabb"):
        estimate_box([make_camera_looking_at(np.zeros(3), d) for d in directions(5)])


def walls(count=4000):
    """Points on the walls of a room of 6 x 5 x 3."""
    p = np.random.default_rng(5).uniform(0, 1, (count, 3))
    side = np.random.default_rng(6).integers(0, 3, count)
    p[np.arange(count), side] = np.round(p[np.arange(count), side])
    return p * [6, 5, 3] - 1


def test_points_on_the_walls_of_a_room_give_its_box():
    """Stray points behind mirrors and windows do not extend it; the walls are inside of it by a few percent."""
    strays = np.random.default_rng(7).uniform(-60, 60, (12, 3))
    box, how = estimate_box(INSIDE, points=np.concatenate([walls(), strays]))
    assert "points" in how
    assert np.all(np.array(box.lower) < -1) and np.all(np.array(box.lower) > -1.5)
    assert np.all(np.array(box.upper) > [5, 4, 2]) and np.all(np.array(box.upper) < [5.5, 4.5, 2.5])


def test_points_far_behind_an_object_do_not_count():
    far = 300 * directions(500, 8)
    near = np.array([1, 2, 3]) + directions(2000, 9)
    box, _ = estimate_box(AROUND, points=np.concatenate([far, near]))
    assert box.side == pytest.approx(10)
    assert estimate_box(AROUND, points=near)[0].side == pytest.approx(2.2, rel=0.02)


def test_few_points_are_ignored():
    assert "cameras" in estimate_box(INSIDE, points=walls(50))[1]


def test_camera_without_overlap_is_detected():
    box = Box((-3, -3, -3), (5, 7, 9))
    assert find_unmatched(AROUND, box) == []
    away = make_camera_looking_at(np.array([1, 2, 8.9]), [1, 2, 30])
    ring = [
        make_camera_looking_at(np.array([1 + 4 * np.cos(a), 2 + 4 * np.sin(a), 3]), [1, 2, 3])
        for a in np.arange(0, 6, 0.5)
    ]
    assert find_unmatched([*ring[:4], away, *ring[4:]], Box((-3, -3, -3), (5, 7, 40))) == [4]
    outside = make_camera_looking_at(np.array([100.0, 0, 0]), [200, 0, 0])
    assert find_unmatched([*AROUND, outside], box) == [20]


@pytest.mark.parametrize("size", [0.5, 0.1])
def test_cameras_around_a_small_object_see_it(size):
    """It is between the pixels that are sampled first."""
    box = Box(*(tuple(np.array([1, 2, 3]) + sign * size / 2) for sign in (-1, 1)))
    assert find_unmatched(AROUND, box) == []


def test_object_without_background_ends_at_box():
    extent = estimate_extent(AROUND, object_only=True)
    assert extent.kind == "object" and not extent.box.is_contracted and extent.box == estimate_box(AROUND, True)[0]


def test_room_ends_at_walls_despite_strays():
    strays = np.random.default_rng(7).uniform(-60, 60, (12, 3))
    extent = estimate_extent(INSIDE, points=np.concatenate([walls(), strays]))
    assert extent.kind == "room" and not extent.box.is_contracted and "0.3 % of the surface points" in extent.reason


def test_scene_with_points_outside_of_box_is_unbounded():
    near, far = (
        1 + np.random.default_rng(8).uniform(0, 2, (900, 3)),
        np.random.default_rng(9).uniform(-90, 90, (100, 3)),
    )
    extent = estimate_extent(AROUND, points=np.concatenate([near, far]))
    assert extent.kind == "unbounded" and extent.box.is_contracted and "% of the surface points are" in extent.reason
    # Nine tenths of the points are in the box from the cameras, whose longest edge is that of the core.
    box = estimate_box(AROUND, points=np.concatenate([near, far]))[0]
    assert extent.box.side == pytest.approx(box.side) and np.allclose(extent.box.center, box.center)


def test_core_contains_nine_tenths_of_points():
    points = np.random.default_rng(9).uniform(-20, 20, (4000, 3)) + [1, 2, 3]
    extent = estimate_extent(AROUND, points=points)
    inside = np.all((points > extent.box.core.lower) & (points < extent.box.core.upper), axis=1)
    assert extent.kind == "unbounded" and inside.mean() == pytest.approx(0.9, abs=0.01)
    assert estimate_extent(AROUND, points=points * 100).box.side == pytest.approx(4 * 10)


def test_distant_points_make_scene_unbounded():
    far = np.random.default_rng(10).uniform(-400, 400, (200, 3))
    extent = estimate_extent(INSIDE, points=np.concatenate([walls(3800), far]))
    assert extent.kind == "unbounded" and "nine tenths" in extent.source and extent.box.side < 12


def test_scene_without_points_ends_at_box():
    for cameras in (AROUND, INSIDE):
        extent = estimate_extent(cameras)
        assert extent.kind == "room" and extent.box == estimate_box(cameras)[0] and "no surface points" in extent.reason


def test_core_contains_cameras_around_it():
    """Otherwise cameras see a small object through contracted space."""
    near = [1, 2, 3] + 0.3 * directions(900, 9)
    scattered = [1, 2, 3] + np.random.default_rng(9).uniform(-3, 3, (60, 3))
    for points in (near, np.concatenate([near, scattered])):
        extent = estimate_extent(AROUND, points=points)
        assert extent.box.is_contracted and extent.source.endswith("and the cameras")
        assert extent.box.core == estimate_box(AROUND)[0]
    extent = estimate_extent(AROUND, points=points, are_points_complete=True)
    assert extent.box.is_contracted and extent.box.side < 2 and "cameras" not in extent.source


def facing(distance):
    """Cameras side by side in front of a wall with points, in the plane y = 0."""
    cameras = [
        make_camera_looking_at(np.array([x, -distance, 1.0]), np.array([x, 0.0, 1.0])) for x in np.linspace(-1, 1, 9)
    ]
    points = np.random.default_rng(0).uniform([-2, -0.1, 0], [2, 0.1, 2], (2000, 3))
    return cameras, points


def test_box_includes_cameras():
    """Visible matter may have no points: a plain wall, or a blurred frame at the border of a photo."""
    cameras, points = facing(2)
    centers = np.array([c.center for c in cameras])
    extent = estimate_extent(cameras, points=points)
    assert extent.kind == "room" and extent.source.endswith("and the cameras") and not extent.box.is_contracted
    for p in np.concatenate([centers, 0.5 * (centers + [0, 0, 1])]):
        assert np.all(p >= np.subtract(extent.box.lower, 1e-9)) and np.all(p <= extent.box.upper)
    # The wall ends at its points.
    assert extent.box.upper[1] < 0.4


def test_distant_cameras_make_scene_unbounded():
    cameras, points = facing(30)
    extent = estimate_extent(cameras, points=points)
    assert extent.kind == "unbounded" and extent.box.is_contracted and "far outside" in extent.reason
    assert extent.box.core.side < 6


def test_complete_points_exclude_cameras():
    cameras, points = facing(2)
    box = estimate_extent(cameras, points=points, are_points_complete=True).box
    assert box == estimate_box(cameras, points=points)[0] and box.lower[1] > -1


def test_cameras_inside_do_not_change_box():
    centers = np.random.default_rng(4).uniform(0, 1.5, (20, 3))
    cameras = [make_camera_looking_at(c, c + d) for c, d in zip(centers, directions(20))]
    extent = estimate_extent(cameras, points=walls())
    assert extent.box == estimate_box(cameras, points=walls())[0] and "cameras" not in extent.source


def test_near_outliers_are_included_and_strays_are_not():
    """Plain surfaces have few points, which are not strays."""
    few, strays = np.tile([[8.0, 2, 0.5]], (12, 1)), np.full((3, 3), 40.0)
    box, _ = estimate_box(INSIDE, points=np.concatenate([walls(), few, strays]))
    assert 8 < box.upper[0] < 9 and box.upper[1] < 5 and box.upper[2] < 3


# ---- One set of known cameras and images, written in each format and compared ray by ray ----


@pytest.mark.parametrize("lens", [OPENCV, FISHEYE], ids=["opencv", "fisheye"])
@pytest.mark.parametrize("write", [nerfstudio, instant_ngp, colmap_bin, colmap_txt])
def test_every_format_gives_the_same_rays_and_pixels(tmp_path, rgb, write, lens):
    coordinates = write(tmp_path, rgb, lens)
    data = open_dataset(tmp_path, holdout=0, coordinates=coordinates)
    assert len(data.train) == COUNT and not data.unused
    for k, (view, pose) in enumerate(zip(data.train, cameras_())):
        origin, d = expected_rays(lens, pose)
        ours = pixel_directions(view.camera.intrinsics) @ view.camera.to_world[:3, :3].T
        assert np.abs(ours - d).max() < 1e-6 and np.abs(view.camera.center - origin).max() < 1e-9
        assert np.array_equal(view.pixels, picture(k))


def test_unusable_frames_are_listed(ring, rgb):
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
        1: "determinant is 0",
        2: "14 x 10",
        3: "3.png",
        4: "inverted",
        5: "no other frame",
        6: "twice",
    }.items():
        assert part in reasons[f"./images/{k}.png"]
    assert data.source["unused"] == reasons and data.source["training_frames"] == 3
    assert str(data.unused[0]).startswith('not used: "./images/')


def test_a_set_without_overlap_is_refused(ring):
    def change(content):
        for k, f in enumerate(content["frames"]):
            m = np.eye(4)
            m[0, 3] = 10 * k
            f["transform_matrix"] = m.tolist()

    rewrite(ring, change)
    with pytest.raises(ValueError, match="no two of the 9.*same part"):
        open_dataset(ring, holdout=0, aabb=(-5, -5, -3, 85, 5, 0))


def test_a_set_without_a_usable_picture_is_refused(ring):
    for path in (ring / "images").iterdir():
        path.write_bytes(b"")
    with pytest.raises(ValueError, match="9.*0.png"):
        open_dataset(ring, holdout=0)


def test_masks_and_depth_are_resized(ring, rgb):
    """The border of a mask excludes all pixels that it touches; millimetres along the axis become distances along
    rays.
    """
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
    assert "metre" in data.unit_note
    rgb.Bitmap(np.zeros((H, W), np.uint8)).write(str(ring / "mask.png"))
    with pytest.raises(ValueError, match="all pixels"):
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
    assert "is scaled to 0.5" in data.unit_note and np.allclose(data.source["to_file"], np.diag([2, 2, 2, 1]))
    centers = np.array([v.camera.center for v in open_dataset(ring, holdout=0).train])
    assert np.allclose([v.camera.center for v in open_dataset(ring, holdout=0, scale=0.5).train], centers / 2)
    corners = open_dataset(ring, aabb=(0, 0, 0, 1, 1, 1))
    assert np.allclose(corners.box.side, 1.025)
    for wrong in (
        {"aabb": (0, 0, 0)},
        {"aabb": (0, 0, 1, 1, 1, 0.999)},
        {"aabb": (0, 0, 0, 1, 1, 1e9)},
        {"scale": 0.0},
        {"coordinates": "elsewhere"},
        {"coordinates": "original"},
    ):
        with pytest.raises(ValueError):
            open_dataset(ring, **wrong)


def test_box_is_estimated_from_depth(ring):
    """A wall at a distance of 2 units from each camera along each ray; the points follow from the depth."""
    np.save(ring / "d.npy", np.full((H, W), 2.0, np.float32))
    rewrite(ring, lambda c: [f.update(METRES_ALONG_RAYS, depth_file_path="d.npy") for f in c["frames"]])
    data = open_dataset(ring, holdout=0)
    points = np.concatenate([(o + 2 * d).reshape(-1, 3) for o, d in (expected_rays(OPENCV, p) for p in cameras_())])
    lower, upper = np.quantile(points, [0.0005, 0.9995], axis=0)
    assert "surface points" in data.box_source
    assert np.allclose(data.box.lower, lower - 0.05 * np.max(upper - lower), atol=1e-3)
    assert data.train[0].depth.dtype == np.float32 and "box" not in open_dataset(ring, depth=False).box_source


def test_rays_of_fox_are_unchanged(recorded):
    """Compared with a reference implementation of OpenCV's model at some pixels of some frames."""
    folder = recorded("fox")
    data = open_dataset(folder, width=135)
    assert (len(data.train), len(data.held_out), len(data.unused)) == (43, 7, 17)
    content = json.loads((folder / "transforms.json").read_text())
    frames = {f["file_path"]: np.array(f["transform_matrix"]) for f in content["frames"]}
    k = [content[n] for n in ("k1", "k2", "p1", "p2")] + [0, 0, 0, 0]
    for view in data.train[::10]:
        d = pixel_directions(view.camera.intrinsics) @ view.camera.to_world[:3, :3].T
        for column, row in ((0, 0), (134, 239), (60, 100)):
            # Pixel centres of the image at an eighth of the size, in pixels of the large one.
            u, v = (column + 0.5) * 8 - 0.5, (row + 0.5) * 8 - 0.5
            ray = opencv.undistort(u, v, content["fl_x"], content["fl_y"], content["cx"] - 0.5, content["cy"] - 0.5, k)
            ray = frames[view.name][:3, :3] @ (ray * [1, -1, -1])
            assert np.allclose(d[row, column], ray / np.linalg.norm(ray), atol=1e-6)


@pytest.fixture(scope="module")
def depth_views():
    """Cameras inside a room of 4 x 3 x 2.5 m, with depth (distances along rays, metres)."""
    seen = []
    for k in range(12):
        a = 2 * np.pi * k / 12
        z = np.array([-np.cos(a), -np.sin(a), -0.1])
        z /= np.linalg.norm(z)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        pose = np.column_stack([np.stack([x, np.cross(z, x), z], axis=1), [2 + np.cos(a), 1.5 + 0.7 * np.sin(a), 1.2]])
        camera = PosedCamera(Intrinsics(24, 18, 15.0, 15.0, 12.0, 9.0), opengl(pose))
        d = pixel_directions(camera.intrinsics) @ camera.to_world[:3, :3].T
        with np.errstate(divide="ignore"):
            walls = np.maximum((0 - camera.center) / d, ([4, 3, 2.5] - camera.center) / d)
        seen.append((camera, walls.min(axis=-1)))
    return seen


@pytest.mark.parametrize("factor", [1.0, 1.05, 1.5, 0.7])
def test_consistent_depth_passes(depth_views, factor):
    assert explain_wrong_depth([(c, factor * d) for c, d in depth_views]) is None


@pytest.mark.parametrize("factor", [1e-3, 1e-2, 0.1, 0.2, 5.0, 100.0, 1e3])
def test_depth_in_other_units_is_explained(depth_views, factor):
    reason = explain_wrong_depth([(c, factor * d) for c, d in depth_views])
    assert reason is not None and f"multiplication by {1 / factor:g}, " in reason


@pytest.mark.parametrize("factor", [1e-3, 0.1])
def test_depth_of_an_object_in_other_units_is_explained(factor):
    """In units that are too large, few points of it are before other cameras, and these agree by chance."""
    views = []
    for k in (*range(1, 8), *range(9, 12)):
        a = 2 * np.pi * k / 12
        pose = make_camera_looking_at(np.array([3 * np.cos(a), 3 * np.sin(a), 0.8 + 0.1 * (k % 3)]), [0, 0, 0]).to_world
        camera = PosedCamera(Intrinsics(32, 24, 30.0, 31.0, 15.5, 12.25), pose)
        d = pixel_directions(camera.intrinsics) @ pose[:3, :3].T
        with np.errstate(divide="ignore"):
            ends = np.sort([(side - camera.center) / d for side in (-0.5, 0.5)], axis=0)
        near, far = ends[0].max(axis=-1), ends[1].min(axis=-1)
        views.append((camera, np.where(near < far, near, 0)))
    assert explain_wrong_depth(views) is None
    reason = explain_wrong_depth([(c, factor * d) for c, d in views])
    assert reason is not None and f"multiplication by {1 / factor:g}, " in reason


def test_constant_depth_is_no_evidence(depth_views):
    """It agrees in any unit in which the distances between cameras are small."""
    assert explain_wrong_depth([(c, np.full_like(d, 0.1)) for c, d in depth_views]) is None
    assert "median is 1e+03 units" in explain_wrong_depth([(c, np.full_like(d, 1000.0)) for c, d in depth_views])


def test_points_that_agree_by_chance_are_no_evidence():
    """Cameras in a room look outwards, and their depth does not overlap: farther out it would, in four points."""
    views = []
    for k in range(8):
        a = 2 * np.pi * k / 8
        center, z = np.array([0.8 * np.cos(a), 0.6 * np.sin(a), 1.5]), np.array([np.cos(a), np.sin(a), -0.15])
        z /= np.linalg.norm(z)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        pose = np.column_stack([np.stack([x, np.cross(z, x), z], axis=1), center])
        camera = PosedCamera(Intrinsics(48, 32, 30.0, 30.0, 24.0, 16.0), opengl(pose))
        d = pixel_directions(camera.intrinsics) @ camera.to_world[:3, :3].T
        with np.errstate(divide="ignore"):
            depth = np.maximum(([-3, -2, 0] - center) / d, ([3, 2, 3] - center) / d).min(axis=-1)
        depth[:, :19] = 0
        views.append((camera, depth))
    assert explain_wrong_depth(views) is None


def test_depth_far_outside_of_the_cameras_is_refused(ring):
    np.save(ring / "d.npy", np.full((H, W), 2000.0, np.float32))
    rewrite(ring, lambda c: [f.update(depth_file_path="d.npy") for f in c["frames"]])
    assert np.allclose(np.median(open_dataset(ring).train[0].depth), 2.0, rtol=0.2)
    rewrite(ring, lambda c: c.update(depth_unit_scale_factor=1.0))
    with pytest.raises(NergError, match="depth_unit_scale_factor.*depth=False"):
        open_dataset(ring)
    assert open_dataset(ring, depth=False).train


@pytest.mark.parametrize("lens", [OPENCV, FISHEYE], ids=["opencv", "fisheye"])
def test_masked_fraction_is_noted(tmp_path, rgb, lens):
    """Also if it is zero, which the dark corners of a fisheye must not hide."""
    instant_ngp(tmp_path, rgb, lens)
    rewrite(tmp_path, lambda c: [f.update(mask_path="mask.png") for f in c["frames"]])
    mask = np.full((H, W), 255, np.uint8)
    rgb.Bitmap(mask).write(str(tmp_path / "mask.png"))
    assert f"the {COUNT} masks exclude no pixels" in open_dataset(tmp_path).notes[-1]
    mask[:, : W // 2] = 0
    rgb.Bitmap(mask).write(str(tmp_path / "mask.png"))
    assert open_dataset(tmp_path).notes[-1] == f"masks exclude 50.0% of the pixels of {COUNT} frames"


def test_rotated_photo_excludes_frame_with_reason(ring, rgb):
    """Exchanging width and height would train on rotated rays."""
    rgb.Bitmap(np.ascontiguousarray(np.rot90(picture(0)))).write(str(ring / "images/0.png"))
    data = open_dataset(ring, holdout=0)
    assert (
        len(data.train) == COUNT - 1 and "rotate the pixels to the orientation of the camera" in data.unused[0].reason
    )
