"""Posed pictures of the demo store, as a photographer with a depth camera would take them.

Writes into a folder: ``images/*.png`` (8-bit sRGB), ``depth/*.npy`` (float32 (h, w), exact distance in metres along the
ray from the camera centre through the pixel centre; 0 where nothing is hit), ``transforms.json`` and
``transforms_test.json`` (held-out views) with the conventions of instant-ngp and nerfstudio: OpenGL camera-to-world (x
right, y up, z back), in the metric frame of the store with z up. ``aabb`` are the bounds of the store.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from nerg_mi.scenes.store import cameras, twin
from nerg_mi.scenes.store.layout import StoreLayout

from nerg_mi.files.atomic import replace_atomically
from nerg_mi.files.images import write_png
from nerg_mi.files.tables import write_json

BUILD = Path(__file__).resolve().parent / "build"

# Mitsuba's cameras look along +z with x to the left; OpenGL's along -z with x to the right.
_GL_TO_MITSUBA = np.diag([-1.0, 1.0, -1.0, 1.0])


def to_mitsuba_pose(pose: np.ndarray) -> np.ndarray:
    """Convert an OpenGL camera-to-world pose to the ``to_world`` (4, 4) of a Mitsuba sensor."""
    return np.asarray(pose) @ _GL_TO_MITSUBA


class StorePhotographer:
    """Renders pictures and depths of a scene; one sensor is moved, so that nothing is recompiled."""

    def __init__(self, camera: cameras.Pinhole, scene=None, spp: int = 64):
        import mitsuba as mi

        self.camera, self.spp = camera, spp
        self.scene = twin.load_twin() if scene is None else scene
        self.sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov": camera.fov_x,
                "fov_axis": "x",
                "near_clip": 0.01,
                "far_clip": 100.0,
                "film": {
                    "type": "hdrfilm",
                    "width": camera.width,
                    "height": camera.height,
                    "rfilter": {"type": "box"},
                    "pixel_format": "rgb",
                    "component_format": "float32",
                },
                # half the noise of independent samples at the same cost
                "sampler": {"type": "multijitter", "sample_count": spp},
            }
        )
        self.params = mi.traverse(self.sensor)

    def render_picture(self, pose: np.ndarray, seed: int, spp: int | None = None) -> np.ndarray:
        """Render linear radiance (h, w, 3), float32."""
        import drjit as dr
        import mitsuba as mi

        to_world = mi.Transform4f(mi.Matrix4f(to_mitsuba_pose(pose).tolist()))
        # a literal pose would be part of the kernel, and each view would be compiled again
        dr.make_opaque(to_world)
        self.params["to_world"] = to_world
        self.params.update()
        return np.array(mi.render(self.scene, sensor=self.sensor, spp=spp or self.spp, seed=mi.UInt32(seed)))

    def render_depth(self, pose: np.ndarray) -> np.ndarray:
        """Return the distance (h, w) float32 in metres along the rays through the pixel centres; 0 where nothing is
        hit.
        """
        directions = self.camera.directions().reshape(-1, 3) @ pose[:3, :3].T
        t = twin.cast_rays(pose[:3, 3], directions, self.scene)
        return np.where(np.isfinite(t), t, 0.0).astype(np.float32).reshape(self.camera.height, self.camera.width)


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write linear radiance (h, w, 3) as 8-bit sRGB, clipped at white."""
    import mitsuba as mi

    bitmap = mi.Bitmap(np.ascontiguousarray(picture, np.float32))
    write_png(path, bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True))


def make_transforms(camera: cameras.Pinhole, layout: StoreLayout, frames: list) -> dict:
    """Make the content of a ``transforms.json``: intrinsics in pixels, frames, bounds."""
    return {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.focal,
        "fl_y": camera.focal,
        "cx": 0.5 * camera.width,
        "cy": 0.5 * camera.height,
        "k1": 0.0,
        "k2": 0.0,
        "p1": 0.0,
        "p2": 0.0,
        "depth_unit_scale_factor": 1.0,
        "is_euclidean_depth": True,
        "aabb": layout.aabb.tolist(),
        "frames": frames,
    }


def write_views(
    layout: StoreLayout,
    folder=BUILD,
    *,
    camera=None,
    train: int = 168,
    test: int = 12,
    spp: int = 64,
    seed: int = 0,
    scene=None,
    log=print,
) -> dict:
    """Choose, render and write the picture set into ``folder``.

    Parameters
    ----------
    layout : StoreLayout
        Layout of the store.
    folder : Path
        Output folder.
    camera : Pinhole, optional
        Camera of all views.
    train, test : int
        Numbers of training and held-out views.
    spp : int
        Samples per pixel of a training view. Held-out views get four times as many, so that their noise does not limit
        the measured error.
    seed : int
        Seed of the views and of the noise.
    scene : mitsuba.Scene, optional
        Scene to render; the twin by default.
    log : callable
        Receives progress messages.

    Returns
    -------
    dict
        Coverage of the views, which is also written to ``coverage.json``.
    """
    camera = camera or cameras.Pinhole()
    folder = Path(folder)
    for name in ("images", "depth"):
        # remove pictures of an earlier, larger set
        for old in (folder / name).glob("t*_???.*"):
            old.unlink()
    start = time.perf_counter()
    sets = dict(zip(("train", "test"), cameras.choose_views(layout, camera, train, test, seed, scene)))
    figures = cameras.measure_coverage(layout, camera, sets["train"], seed + 1, scene)
    log(f"chose {train} + {test} views in {time.perf_counter() - start:.1f} s")
    for name, value in figures.items():
        log(f"  {name}: {value:.1%}" if value <= 1 else f"  {name}: {value:g}")

    photographer = StorePhotographer(camera, scene, spp)
    start, done = time.perf_counter(), 0
    for kind, poses in sets.items():
        frames = []
        for k, pose in enumerate(poses):
            stem = f"{kind}_{k:03d}"
            picture = photographer.render_picture(pose, seed * 10_000 + done, spp if kind == "train" else 4 * spp)
            write_picture(folder / "images" / f"{stem}.png", picture)
            with replace_atomically(folder / "depth" / f"{stem}.npy") as temporary:
                np.save(temporary, photographer.render_depth(pose))
            files = {"file_path": f"images/{stem}.png", "depth_file_path": f"depth/{stem}.npy"}
            frames.append(files | {"transform_matrix": pose.tolist()})
            done += 1
            if done % 30 == 0:
                log(f"  {done} of {train + test} views, {time.perf_counter() - start:.0f} s")
        name = "transforms.json" if kind == "train" else "transforms_test.json"
        write_json(folder / name, make_transforms(camera, layout, frames))
    write_json(folder / "coverage.json", figures)
    log(f"rendered {done} views in {time.perf_counter() - start:.0f} s")
    return figures
