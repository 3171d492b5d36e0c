"""One set of known cameras and images, and its writers for all formats."""

from __future__ import annotations

import json
import struct

import numpy as np
from scipy.spatial.transform import Rotation

from nerg_mi.photos.cameras import Intrinsics
from tests.reference import opencv

W, H = 14, 10
OPENCV = Intrinsics(W, H, 12.0, 12.5, 6.6, 5.3, 0.05, -0.02, 0.003, -0.002)
FISHEYE = Intrinsics(W, H, 9.0, 9.5, 6.6, 5.3, 0.03, -0.01, k3=0.002, k4=-3e-4, fisheye=True)
COUNT = 9
# Keys of a transforms file; without them, NPY depth is in millimetres along the axis.
METRES_ALONG_RAYS = {"depth_unit_scale_factor": 1.0, "is_euclidean_depth": True}


def cameras():
    """World poses (OpenCV: z forward, y down) on a ring, facing inwards at a tilt, and random images."""
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
    """Return origin and unit directions (H, W, 3) of the reference lens models."""
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
    """Write a set that is rotated and scaled by the writer, with one lens for all frames."""
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
    """Write a set with a lens in each frame, and unordered frames."""
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


def rewrite(folder, change):
    """Apply ``change`` to the content of a transforms file."""
    content = json.loads((folder / "transforms.json").read_text())
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))


POSE = np.eye(4).tolist()


def frame(name, **keys):
    """An entry of a transforms file."""
    return {"file_path": name, "transform_matrix": POSE, **keys}
