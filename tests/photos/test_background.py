"""Tests of `nerg_mi.photos.background`."""

import json

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.photos.background import remove_background
from nerg_mi.photos.cameras import Intrinsics, PosedCamera, pixel_directions
from nerg_mi.photos.dataset import open_dataset
from nerg_mi.photos.images import PhotoView

LENS = Intrinsics(24, 18, 15.0, 15.0, 12.0, 9.0)
AHEAD = -pixel_directions(LENS)[..., 2]
ROOM = [4, 3, 2.5]


def looking(center, towards):
    back = -np.asarray(towards, float) / np.linalg.norm(towards)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(back, right), back], axis=1), center
    return PosedCamera(LENS, pose)


def see(camera, size=ROOM):
    """Distances along the rays to the walls of a room with a corner at the origin."""
    d = pixel_directions(LENS) @ camera.to_world[:3, :3].T
    with np.errstate(divide="ignore"):
        return np.maximum((0 - camera.center) / d, (np.array(size) - camera.center) / d).min(axis=-1)


AROUND = [
    looking([2 + np.cos(a), 1.5 + 0.7 * np.sin(a), 1.2], [np.cos(a), np.sin(a), 0.1]) for a in np.arange(12) / 12 * 6.28
]


def views_of(cameras, depths):
    return [PhotoView("a", c, np.zeros((18, 24, 3)), d.astype(np.float32)) for c, d in zip(cameras, depths)]


def cover(fraction):
    """The pixels of the background in each view: a part of the columns, which differs between views."""
    return [np.arange(24)[None] * np.ones((18, 1)) < 24 * fraction - k % 2 for k in range(len(AROUND))]


@pytest.mark.parametrize(
    "suffix, value, unit, fraction, along_rays",
    [
        *((".npy", v, 1.0, 0.85, True) for v in (1e10, 65504.0, 100.0, np.inf, np.nan, -1.0)),
        *((".npy", v, 1.0, 0.3, False) for v in (1e11, 3.4e38, 1000.0, 100.0, 20.0)),
        *((".npy", v, 1e-3, 0.85, False) for v in (1e10, 65535.0)),
        *((".exr", v, 1.0, 0.3, False) for v in (1e10, 100.0)),
        *((".png", v, 1e-3, 0.85, False) for v in (65535, 50000, 0)),
    ],
)
def test_background_is_no_surface(tmp_path, rgb, suffix, value, unit, fraction, along_rays):
    """Box, kind of scene and depth are those of the same files with unknown depth there."""
    data = []
    for filling in (value, 0):
        frames = []
        for k, (camera, mask) in enumerate(zip(AROUND, cover(fraction))):
            depth = see(camera) * (1 if along_rays else AHEAD) / unit
            depth = np.where(mask, filling, depth).astype(np.uint16 if suffix == ".png" else np.float32)
            if suffix == ".npy":
                np.save(tmp_path / f"{k}.npy", depth)
            else:
                rgb.Bitmap(depth).write(str(tmp_path / f"{k}{suffix}"))
            rgb.Bitmap(np.full((18, 24, 3), 10 * k, np.uint8)).write(str(tmp_path / f"i{k}.png"))
            pose = camera.to_world.tolist()
            frames.append({"file_path": f"i{k}.png", "depth_file_path": f"{k}{suffix}", "transform_matrix": pose})
        content = {"fl_x": 15.0, "cx": 12.0, "cy": 9.0, "w": 24, "h": 18, "is_euclidean_depth": along_rays}
        content |= {"depth_unit_scale_factor": unit, "frames": frames}
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        data.append(open_dataset(tmp_path))
    assert not data[0].box.is_contracted and data[0].box == data[1].box
    for view, other in zip([*data[0].train, *data[0].held_out], [*data[1].train, *data[1].held_out]):
        np.testing.assert_array_equal(view.depth, other.depth)
    for line in ("depth maps", f"{np.mean(cover(fraction)):.1%}"):
        assert line in data[0].notes[-1] and line in data[1].notes[-1]
    # The largest number of a type is removed when the file is read.
    is_counted = (0 < value < 3e38 and value not in (65504, 65535)) or (value, suffix) == (65535, ".npy")
    assert ("no surface" in data[0].notes[-1]) == is_counted and "no surface" not in data[1].notes[-1]


@pytest.mark.parametrize("value", [20.0, 100.0, 1000.0, 1e10])
@pytest.mark.parametrize("along_rays", [True, False])
@pytest.mark.parametrize("rows", [18, 5])
def test_background_in_one_view_only(value, along_rays, rows):
    """All of it, or a part."""
    depths = [see(camera) for camera in AROUND]
    depths[3][:rows] = np.broadcast_to(value if along_rays else value / AHEAD, depths[3].shape)[:rows]
    views, background = remove_background(views_of(AROUND, depths))
    assert background is not None and background.fraction == pytest.approx(rows / 18 / len(AROUND))
    for k, (view, depth) in enumerate(zip(views, depths)):
        np.testing.assert_array_equal(view.depth[rows * (k == 3) :], np.float32(depth[rows * (k == 3) :]))
    assert not views[3].depth[:rows].any()


def test_the_end_of_a_corridor_is_a_surface():
    """One camera sees it across its axis, and floor and walls up to it."""
    cameras = [looking([2, 1, 1.2], d) for d in ([1, 0, 0], [0, 1, 0], [0, -1, 0])]
    assert remove_background(views_of(cameras, [see(c, [22, 2, 2.5]) for c in cameras]))[1] is None


def test_several_background_values_are_removed():
    """Those at the edges of objects, which are means of surface and background, too."""
    depths = [see(camera) for camera in AROUND]
    for depth in depths:
        depth[:2], depth[2], depth[3, :5] = 1e10, 1000.0, np.linspace(1e8, 9e9, 5)
    views, background = remove_background(views_of(AROUND, depths))
    for view, depth in zip(views, depths):
        np.testing.assert_array_equal(view.depth, np.where(depth > 10, 0, np.float32(depth)))
    assert background is not None
    assert background.fraction == pytest.approx((3 * 24 + 5) / (18 * 24)) and background.unknown_fraction == 0
    assert background.nearest == pytest.approx(1000)


@pytest.mark.parametrize("sky", [1000.0, 1e4, 1e10])
@pytest.mark.parametrize("along_rays", [True, False])
def test_sky_behind_far_surfaces_is_no_surface(sky, along_rays):
    """Cameras near each other see one sphere or plane of the sky only if it is centred at all of them."""
    rng = np.random.default_rng(0)
    depths = [np.exp(rng.uniform(0, np.log(300), (18, 24))).astype(np.float32) for _ in AROUND]
    for depth in depths:
        depth[:6] = np.broadcast_to(sky if along_rays else sky / AHEAD, depth.shape)[:6]
    views, background = remove_background(views_of(AROUND, depths))
    assert background is not None and background.fraction == pytest.approx(1 / 3)
    for view, depth in zip(views, depths):
        np.testing.assert_array_equal(view.depth[6:], depth[6:])


CENTRE = [2, 2, 2]


@pytest.mark.parametrize(
    "cameras, size",
    [
        ([looking([x, 0.5, 1.2], [0, 1, 0]) for x in np.linspace(1.5, 2.5, 9)], [4, 3, 2.5]),
        ([looking(CENTRE, d) for d in ([1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0])], [4, 4, 4]),
        (AROUND, [4, 3, 2.5]),
        (AROUND, [300, 300, 300]),
    ],
    ids=["along a wall", "in a cube", "around", "outdoors"],
)
def test_walls_are_surfaces(cameras, size):
    """Also those at equal distances along the axes of several cameras, and with depth in whole millimetres."""
    for depths in ([see(c, size) for c in cameras], [np.round(see(c, size), 3) for c in cameras]):
        views = views_of(cameras, depths)
        result, background = remove_background(views)
        assert background is None
        assert all(a is b for a, b in zip(views, result))


def test_equal_depths_everywhere_are_no_background():
    views = views_of(AROUND, [np.full((18, 24), 2.0)] * len(AROUND))
    assert remove_background(views)[1] is None
    assert remove_background([PhotoView("a", AROUND[0], np.zeros((18, 24, 3)))])[1] is None


@pytest.mark.parametrize("surface", [0, 1])
@pytest.mark.parametrize("value, along_rays", [(1e10, True), (1e10, False), (1e4, False)])
def test_depth_that_is_nearly_all_background_is_refused_as_that(tmp_path, rgb, surface, value, along_rays):
    """And not for its unit."""
    frames = []
    for k, camera in enumerate(AROUND):
        depth = np.full((18, 24), value, np.float32)
        depth[:surface, :2] = (see(camera) * (1 if along_rays else AHEAD))[:surface, :2]
        np.save(tmp_path / f"{k}.npy", depth)
        rgb.Bitmap(np.full((18, 24, 3), 10 * k, np.uint8)).write(str(tmp_path / f"i{k}.png"))
        pose = camera.to_world.tolist()
        frames.append({"file_path": f"i{k}.png", "depth_file_path": f"{k}.npy", "transform_matrix": pose})
    content = {"fl_x": 15.0, "cx": 12.0, "cy": 9.0, "w": 24, "h": 18, "is_euclidean_depth": along_rays}
    content |= {"depth_unit_scale_factor": 1.0, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(NergError, match="background") as refusal:
        open_dataset(tmp_path)
    share = 1 - surface * 2 / (18 * 24)
    assert f"{share:.1%}" in str(refusal.value)
