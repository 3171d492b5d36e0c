"""One set of known cameras and pictures, written in every format and read back ray by ray."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nerg_mi.capture.cameras import pixel_directions
from nerg_mi.capture.dataset import open_dataset
from nerg_mi.capture.intrinsics import Intrinsics
from tests.reference import opencv

W, H = 14, 10
OPENCV = Intrinsics(W, H, 12.0, 12.5, 6.6, 5.3, 0.05, -0.02, 0.003, -0.002)
FISHEYE = Intrinsics(W, H, 9.0, 9.5, 6.6, 5.3, 0.03, -0.01, k3=0.002, k4=-3e-4, fisheye=True)
COUNT = 9


def cameras():
    """World poses (OpenCV: z forward, y down) on a ring that looks inwards at a tilt, and random pictures."""
    poses = []
    for k in range(COUNT):
        a = 2 * np.pi * k / COUNT
        center = np.array([3 * np.cos(a), 3 * np.sin(a), 1 + 0.1 * k])
        z = -center / np.linalg.norm(center)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        poses.append(np.column_stack([np.stack([x, np.cross(z, x), z], axis=1), center]))
    return poses


def picture(k):
    return np.random.default_rng(k).integers(0, 256, (H, W, 3)).astype(np.uint8)


def expected_rays(lens, pose):
    """Origin and unit directions (H, W, 3) by the restated models."""
    inverse = opencv.fisheye_undistort if lens.fisheye else opencv.undistort
    k = (lens.k1, lens.k2, lens.k3, lens.k4) if lens.fisheye else lens.distortion
    d = np.array(
        [[inverse(u, v, lens.fx, lens.fy, lens.cx - 0.5, lens.cy - 0.5, k) for u in range(W)] for v in range(H)]
    )
    d = d @ pose[:, :3].T
    return pose[:, 3], d / np.linalg.norm(d, axis=-1, keepdims=True)


def opengl(pose):
    return np.vstack([pose @ np.diag([1, -1, -1, 1.0]), [0, 0, 0, 1]])


def lens_keys(lens):
    keys = {
        "w": W,
        "h": H,
        "fl_x": lens.fx,
        "fl_y": lens.fy,
        "cx": lens.cx,
        "cy": lens.cy,
        "k1": lens.k1,
        "k2": lens.k2,
    }
    return {**keys, "k3": lens.k3, "k4": lens.k4} if lens.fisheye else {**keys, "p1": lens.p1, "p2": lens.p2}


def save_pictures(folder, mi, names):
    for k, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        mi.Bitmap(picture(k)).write(str(folder / name))


def nerfstudio(folder, mi, lens):
    """Turned and scaled by the writer; lens once for all."""
    save_pictures(folder, mi, [f"images/{k}.png" for k in range(COUNT)])
    turn, s = Rotation.from_euler("xyz", [90, 20, 0], degrees=True).as_matrix(), 2.0
    applied = np.vstack([np.column_stack([turn, [0.1, 0.2, 0.3]]), [0, 0, 0, 1]])
    frames = []
    for k, pose in enumerate(cameras()):
        m = applied @ opengl(pose)
        m[:3, 3] *= s
        frames.append({"file_path": f"images/{k}.png", "transform_matrix": m.tolist()})
    model = {"camera_model": "OPENCV_FISHEYE"} if lens.fisheye else {"camera_model": "OPENCV"}
    content = {
        **model,
        **lens_keys(lens),
        "applied_transform": applied[:3].tolist(),
        "applied_scale": s,
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(content))
    return "original"


def instant_ngp(folder, mi, lens):
    """Lens in every frame, frames in no order."""
    save_pictures(folder, mi, [f"images/{k}.png" for k in range(COUNT)])
    frames = [
        {"file_path": f"./images/{k}.png", "transform_matrix": opengl(p).tolist(), "sharpness": 3.0, **lens_keys(lens)}
        for k, p in enumerate(cameras())
    ]
    content = {"aabb_scale": 4, "frames": frames[::-1], **({"is_fisheye": True} if lens.fisheye else {})}
    (folder / "transforms.json").write_text(json.dumps(content))
    return "file"


COLMAP_LENS = {
    False: (4, "OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    True: (5, "OPENCV_FISHEYE", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
}


def world_to_camera(pose):
    r = pose[:, :3].T
    x, y, z, w = Rotation.from_matrix(r).as_quat()
    return (w, x, y, z), -r @ pose[:, 3]


def colmap_bin(folder, mi, lens):
    save_pictures(folder, mi, [f"images/{k}.png" for k in range(COUNT)])
    (folder / "sparse/0").mkdir(parents=True)
    model, _, names = COLMAP_LENS[lens.fisheye]
    (folder / "sparse/0/cameras.bin").write_bytes(
        struct.pack("<QiiQQ8d", 1, 7, model, W, H, *(getattr(lens, n) for n in names))
    )
    out = struct.pack("<Q", COUNT)
    for k, pose in enumerate(cameras()):
        q, t = world_to_camera(pose)
        out += struct.pack("<i7di", k + 1, *q, *t, 7) + f"{k}.png".encode() + b"\0" + struct.pack("<Q", 0)
    (folder / "sparse/0/images.bin").write_bytes(out)
    return "file"


def colmap_txt(folder, mi, lens):
    save_pictures(folder, mi, [f"images/{k}.png" for k in range(COUNT)])
    (folder / "sparse").mkdir(parents=True)
    _, model, names = COLMAP_LENS[lens.fisheye]
    numbers = " ".join(repr(getattr(lens, n)) for n in names)
    (folder / "sparse/cameras.txt").write_text(f"7 {model} {W} {H} {numbers}\n")
    lines = []
    for k, pose in enumerate(cameras()):
        q, t = world_to_camera(pose)
        lines += [f"{k + 1} " + " ".join(repr(float(v)) for v in (*q, *t)) + f" 7 {k}.png", ""]
    (folder / "sparse/images.txt").write_text("\n".join(lines) + "\n")
    return "file"


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


def test_blender_style_folders_keep_their_split(tmp_path, rgb):
    """Suffixes left out, RGBA, an angle for a lens, and three files that name the parts."""
    parts = {"train": range(5), "val": range(5, 6), "test": range(6, 9)}
    angle = 0.9
    for part, numbers in parts.items():
        (tmp_path / part).mkdir()
        frames = []
        for k in numbers:
            rgba = np.dstack([picture(k), np.full((H, W), 40 * (k % 6), np.uint8)])
            rgb.Bitmap(rgba, rgb.Bitmap.PixelFormat.RGBA).write(str(tmp_path / part / f"r_{k}.png"))
            frames.append(
                {"file_path": f"./{part}/r_{k}", "rotation": 0.1, "transform_matrix": opengl(cameras()[k]).tolist()}
            )
        (tmp_path / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    data = open_dataset(tmp_path)
    assert [v.name for v in data.train] == [f"./train/r_{k}" for k in range(5)]
    assert [v.name for v in data.held_out] == [f"./test/r_{k}" for k in range(6, 9)]
    assert (
        data.source["held_out"]["how"] == "transforms_test.json" and data.box_from == "the region that the views share"
    )
    plain = Intrinsics(W, H, *2 * [W / 2 / np.tan(angle / 2)], W / 2, H / 2)
    for view, k in zip(data.train, parts["train"]):
        _, d = expected_rays(plain, cameras()[k])
        assert np.abs(pixel_directions(view.camera.intrinsics) @ view.camera.to_world[:3, :3].T - d).max() < 1e-6
        assert np.array_equal(view.pixels[..., 3], np.full((H, W), 40 * (k % 6)))
    (tmp_path / "transforms_test.json").unlink()
    assert open_dataset(tmp_path).source["held_out"]["how"] == "transforms_val.json"


def rewrite(folder, change):
    content = json.loads((folder / "transforms.json").read_text())
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))


@pytest.fixture
def ring(tmp_path, rgb):
    instant_ngp(tmp_path, rgb, OPENCV)
    return tmp_path


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
    with pytest.raises(ValueError, match="none of the 9.*0.png"):
        open_dataset(ring, holdout=0)


def test_a_folder_of_something_else_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="COLMAP"):
        open_dataset(tmp_path)


def test_frames_held_out_are_never_trained_on(ring):
    """A test file that repeats frames of the training file takes them away from it."""
    content = json.loads((ring / "transforms.json").read_text())
    (ring / "transforms_test.json").write_text(json.dumps({**content, "frames": content["frames"][:2]}))
    data = open_dataset(ring)
    assert (len(data.train), len(data.held_out)) == (7, 2)
    assert not {v.name for v in data.train} & {v.name for v in data.held_out}
    assert sum("held out" in u.reason for u in data.unused) == 2
    assert [v.name for v in open_dataset(ring, holdout=5).held_out] == ["./images/0.png", "./images/5.png"]


def test_lists_of_file_names_split(ring):
    rewrite(
        ring, lambda c: c.update(train_filenames=[f"images/{k}.png" for k in range(5)], test_filenames=["images/8.png"])
    )
    data = open_dataset(ring)
    assert (len(data.train), [v.name for v in data.held_out]) == (5, ["./images/8.png"])
    assert "3 frames" in data.notes[0]


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


def test_coordinates_of_a_nerfstudio_training(tmp_path, rgb):
    """dataparser_transforms.json goes from the original coordinates, not from those of transforms.json."""
    nerfstudio(tmp_path, rgb, OPENCV)
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    path = tmp_path / "dataparser_transforms.json"
    path.write_text(json.dumps({"transform": np.column_stack([turn, [1, 2, 3]]).tolist(), "scale": 0.25}))
    data = open_dataset(tmp_path, holdout=0, coordinates=str(path))
    for view, pose in zip(data.train, cameras()):
        assert np.allclose(view.camera.center, 0.25 * (turn @ pose[:, 3] + [1, 2, 3]))
        assert np.allclose(view.camera.to_world[:3, :3], turn @ opengl(pose)[:3, :3])


def test_depth_finds_the_box(ring):
    """A wall 2 units from every camera along each ray: the points are where the depth says."""
    np.save(ring / "d.npy", np.full((H, W), 2.0, np.float32))
    rewrite(ring, lambda c: [f.update(depth_file_path="d.npy") for f in c["frames"]])
    data = open_dataset(ring, holdout=0)
    points = np.concatenate([(o + 2 * d).reshape(-1, 3) for o, d in (expected_rays(OPENCV, p) for p in cameras())])
    lower, upper = np.quantile(points, [0.005, 0.995], axis=0)
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
