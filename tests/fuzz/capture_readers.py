"""Readers of posed image sets, images, depth, masks and saliency maps."""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path

import numpy as np

from tests.fuzz.watch import Reader

_SIZE = 8, 6
_NAMES = "a.png", "b.png", "c.png"


def _png(path: Path, values: np.ndarray) -> None:
    import mitsuba as mi

    mi.Bitmap(np.ascontiguousarray(values)).write(str(path))


def _photo(path: Path, channels: int = 3, kind=np.uint8) -> None:
    w, h = _SIZE
    shape = (h, w, channels) if channels > 1 else (h, w)
    _png(path, np.random.default_rng(0).integers(1, 200, shape).astype(kind))


def _pose(k: int) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = [0.2 * k, 0.1 * k, 2]
    return pose


def _make_transforms(folder: Path) -> None:
    (folder / "images").mkdir()
    frames = []
    for k, name in enumerate(_NAMES):
        _photo(folder / "images" / name)
        frames.append({"file_path": f"images/{name}", "transform_matrix": _pose(k).tolist()})
    np.save(folder / "depth.npy", np.full(_SIZE[::-1], 2.0, np.float32))
    _png(folder / "mask.png", np.full(_SIZE[::-1], 255, np.uint8))
    frames[1] |= {"depth_file_path": "depth.npy", "mask_path": "mask.png", "camera_model": "OPENCV", "k1": 0.01}
    data = {
        "w": 8,
        "h": 6,
        "fl_x": 9.0,
        "depth_unit_scale_factor": 1.0,
        "cx": 4.0,
        "cy": 3.0,
        "aabb": [[-2, -2, -2], [2, 2, 2]],
        "frames": frames,
        "applied_transform": np.eye(4)[:3].tolist(),
        "applied_scale": 0.5,
        "train_filenames": ["images/a.png", "images/b.png"],
        "test_filenames": ["images/c.png"],
    }
    (folder / "transforms.json").write_text(json.dumps(data))
    (folder / "dataparser_transforms.json").write_text(json.dumps({"transform": np.eye(4)[:3].tolist(), "scale": 0.5}))


def _read_dataset(folder: Path) -> object:
    from nerg_mi.photos.dataset import open_dataset

    coordinates = folder / "dataparser_transforms.json"
    return open_dataset(folder, coordinates=str(coordinates) if coordinates.is_file() else "file")


def _make_place(folder: Path) -> None:
    """A data set with enough points to distinguish the scene from its surroundings."""
    _make_colmap("bin")(folder)
    p = np.random.default_rng(0).normal(size=(130, 3)) * np.where(np.arange(130) % 5, 1, 50)[:, None]
    points = [struct.pack("<Q3d3BdQ6i", k, *xyz, 1, 2, 3, 0.5, 3, *range(6)) for k, xyz in enumerate(p)]
    (folder / "sparse" / "0" / "points3D.bin").write_bytes(struct.pack("<Q", 130) + b"".join(points))


def _read_place(folder: Path) -> object:
    from nerg_mi.photos.dataset import open_dataset

    return [open_dataset(folder, holdout=0, scale=0.5, unbounded=arguments) for arguments in (None, True, False)]


def _read_salience_set(folder: Path) -> object:
    from nerg_mi.photos.salience import open_salience

    return open_salience(folder, "spectral-residual")


def _make_colmap(suffix: str):
    def make(folder: Path) -> None:
        (folder / "images").mkdir()
        model = folder / "sparse" / "0"
        model.mkdir(parents=True)
        for name in _NAMES:
            _photo(folder / "images" / name)
        (_colmap_bin if suffix == "bin" else _colmap_txt)(model)

    return make


def _colmap_bin(model: Path) -> None:
    w, h = _SIZE
    (model / "cameras.bin").write_bytes(struct.pack("<QiiQQ8d", 1, 1, 4, w, h, 9, 9, 4, 3, 0.01, 0, 0, 0))
    out = struct.pack("<Q", len(_NAMES))
    for k, name in enumerate(_NAMES):
        out += struct.pack("<i7di", k + 1, 1, 0, 0, 0, 0.2 * k, 0.1 * k, 2, 1) + name.encode() + b"\0"
        out += struct.pack("<Qddq", 1, 1.5, 2.5, -1)
    (model / "images.bin").write_bytes(out)
    points = [
        struct.pack("<Q3d3BdQ", k, *(np.eye(3)[k % 3] * k), 1, 2, 3, 0.5, 3) + struct.pack("<6i", *range(6))
        for k in range(4)
    ]
    (model / "points3D.bin").write_bytes(struct.pack("<Q", 4) + b"".join(points))


def _colmap_txt(model: Path) -> None:
    w, h = _SIZE
    (model / "cameras.txt").write_text(f"# cameras\n1 OPENCV {w} {h} 9 9 4 3 0.01 0 0 0\n")
    rows = [f"{k + 1} 1 0 0 0 {0.2 * k} {0.1 * k} 2 1 {name}\n1.5 2.5 -1\n" for k, name in enumerate(_NAMES)]
    (model / "images.txt").write_text("".join(rows))
    (model / "points3D.txt").write_text("".join(f"{k} {k} 1 2 9 9 9 0.5 1 0 2 0 3 0\n" for k in range(4)))


def _picture(name: str):
    def make(folder: Path) -> None:
        from nerg_mi.files.images import write_exr

        w, h = _SIZE
        random = np.random.default_rng(0)
        if name.endswith(".exr"):
            write_exr(
                folder / name, {c: random.random((h, w)).astype(np.float32) for c in ("R", "G", "B", "A", "depth.T")}
            )
        elif name.endswith(".npy"):
            np.save(folder / name, random.random((h, w)).astype(np.float32))
        else:
            values = random.integers(0, 200, (h, w, 3))
            _png(
                folder / name,
                values.astype(np.uint16 if "16" in name else np.uint8)[..., : 1 if "16" in name else 3].squeeze(),
            )

    return make


def _read_picture(name: str):
    def read(folder: Path) -> object:
        from nerg_mi.errors import NergError
        from nerg_mi.photos.images import read_depth, read_image, read_mask
        from nerg_mi.photos.posed import DepthFile, MaskFile
        from nerg_mi.photos.salience import read_salience

        path, out = folder / name, []
        readers = [
            lambda: read_image(path),
            lambda: read_depth(DepthFile(path)),
            lambda: read_mask(MaskFile(path), _SIZE[::-1]),
            lambda: read_salience(path),
        ]
        refused = None
        for reader in readers:
            # If one reader refuses the input, the next one may accept it.
            try:
                out.append(reader())
            except NergError as error:
                refused = error
        if not out:
            raise refused
        return out

    return read


_POINTS = "semidense_points.csv.gz"


def _make_points(folder: Path) -> None:
    head = "uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std"
    rows = [f"{k},world{k % 3 == 0},{0.1 * k:.3f},{k % 7},-1.5,0.00{k % 9},0.0{k % 3}" for k in range(60)]
    (folder / _POINTS).write_bytes(gzip.compress("\n".join([head, *rows, ""]).encode(), mtime=0))
    (folder / _POINTS.removesuffix(".gz")).write_text("\n".join([head, *rows, ""]))


def _read_points(name: str):
    def read(folder: Path) -> object:
        from nerg_mi.photos.posed import read_semidense

        return read_semidense(folder / name)

    return read


_TEXTS = {"sparse/0/cameras.txt": ("text",), "sparse/0/images.txt": ("text",), "sparse/0/points3D.txt": ("text",)}
_BINARIES = {"sparse/0/cameras.bin": (), "sparse/0/images.bin": (), "sparse/0/points3D.bin": ()}
_SET = {"transforms.json": ("json",), "dataparser_transforms.json": ("json",)}

CAPTURES = [
    Reader("transforms", _make_transforms, _SET, _read_dataset),
    Reader("salience of a set", _make_transforms, {"transforms.json": ("json",)}, _read_salience_set),
    Reader("COLMAP binary", _make_colmap("bin"), _BINARIES, _read_dataset),
    Reader("COLMAP text", _make_colmap("txt"), _TEXTS, _read_dataset),
    Reader("COLMAP place", _make_place, {"sparse/0/points3D.bin": (), "sparse/0/images.bin": ()}, _read_place),
    *(
        Reader(f"semi-dense points {name}", _make_points, {name: kinds}, _read_points(name))
        for name, kinds in ((_POINTS, ("gzip",)), (_POINTS.removesuffix(".gz"), ("text",)))
    ),
    *(
        Reader(f"picture {name}", _picture(name), {name: kinds}, _read_picture(name))
        for name, kinds in (
            ("a.png", ("png",)),
            ("a16.png", ("png",)),
            ("a.jpg", ()),
            ("a.exr", ()),
            ("a.npy", ("npy",)),
        )
    ),
]
