"""Photos of the table with exact depth, and the file with their poses.

Writes into a folder: ``images/photo_NNN.png`` (8-bit sRGB), ``depth/photo_NNN.npy`` (float32 (h, w), exact distance in
metres along the ray from the camera centre through the pixel centre; 0 for sky) and ``transforms_depth.json``, which
lists both with poses and lenses as instant-ngp and nerfstudio do. Readers of folders ignore that file name: training
uses the COLMAP model that `sparse` writes, which has no depth.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from nerg_mi.scenes.store import twin
from nerg_mi.scenes.tabletop.denoising import denoise

from nerg_mi.files.atomic import replace_atomically
from nerg_mi.files.images import write_png
from nerg_mi.files.tables import write_json
from nerg_mi.maths.color import encode_srgb
from nerg_mi.photos.cameras import PosedCamera, make_sensor_dict, pixel_directions

DEPTH_FILE = "transforms_depth.json"
"""The same photos with their depth."""
ALBEDO_SPP = 100
"""Albedo samples per pixel of a photo."""
HOLDOUT_INTERVAL = 8
"""Default interval of held-out photos. They get four times the samples, so that their noise does not limit the measured
error.
"""


class Photo(NamedTuple):
    """A photo: ``pixels`` (h, w, 3) uint8, sRGB; ``depth`` (h, w) float32, metres along the rays, 0 for sky."""

    name: str
    camera: PosedCamera
    pixels: np.ndarray
    depth: np.ndarray


class TabletopPhotographer:
    """Renders photos of a scene with ``spp`` light samples per pixel."""

    def __init__(self, scene, spp: int = 24):
        import mitsuba as mi

        self.scene, self.spp = scene, spp
        self.guides = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal,position:position"})
        self.albedo = mi.load_dict({"type": "aov", "aovs": "albedo:albedo"})

    def render_radiance(self, camera: PosedCamera, seed: int, times: int = 1) -> np.ndarray:
        """Render denoised linear radiance (h, w, 3) with ``times`` as many samples."""
        light = self._render(camera, seed, times * self.spp)
        # Equal seeds and numbers of samples give the same film samples.
        guides = self._render(camera, seed, times * self.spp, self.guides)
        return denoise(light, guides, self.render_albedo(camera, seed + 1))

    def render_albedo(self, camera: PosedCamera, seed: int, spp: int = ALBEDO_SPP) -> np.ndarray:
        """Render the albedo (h, w, 3)."""
        return self._render(camera, seed, spp, self.albedo, "multijitter")

    def render_depth(self, camera: PosedCamera) -> np.ndarray:
        """Return exact distances (h, w) float32 along the rays through the pixel centres; 0 where nothing is hit."""
        directions = pixel_directions(camera.intrinsics) @ camera.to_world[:3, :3].T
        t = twin.cast_rays(camera.center, directions.reshape(-1, 3), self.scene)
        return np.where(np.isfinite(t), t, 0).astype(np.float32).reshape(directions.shape[:2])

    def _render(self, camera: PosedCamera, seed: int, spp: int, integrator=None, sampler="independent") -> np.ndarray:
        import drjit as dr
        import mitsuba as mi

        sensor = mi.load_dict(make_sensor_dict(camera) | {"sampler": {"type": sampler, "sample_count": spp}})
        params = mi.traverse(sensor)
        # Literal poses would compile kernels for each camera.
        pose = mi.Transform4f(params["to_world"])
        dr.make_opaque(pose)
        params["to_world"] = pose
        params.update()
        integrator = integrator or self.scene.integrator()
        return np.array(mi.render(self.scene, sensor=sensor, integrator=integrator, spp=spp, seed=mi.UInt32(seed)))


def take_photos(scene, cameras: list[PosedCamera], spp: int = 24, seed: int = 0, log=print) -> list[Photo]:
    """Render a photo of ``scene`` with each camera; ``log`` receives progress messages."""
    photographer, out, start = TabletopPhotographer(scene, spp), [], time.perf_counter()
    for k, camera in enumerate(cameras):
        linear = photographer.render_radiance(camera, 2 * (10_000 * seed + k), 1 if k % HOLDOUT_INTERVAL else 4)
        pixels = np.round(255 * encode_srgb(np.clip(linear, 0, 1))).astype(np.uint8)
        out.append(Photo(f"photo_{k:03d}.png", camera, pixels, photographer.render_depth(camera)))
        if (k + 1) % 8 == 0 or k + 1 == len(cameras):
            log(f"  {k + 1} of {len(cameras)} photos, {time.perf_counter() - start:.0f} s")
    return out


def write_photos(photos: list[Photo], folder: str | Path) -> Path:
    """Write the photos, their depth and `DEPTH_FILE`; returns the path of the last."""
    import mitsuba as mi

    folder, frames = Path(folder), []
    for name in ("images", "depth"):
        # Remove photos of an earlier, larger set.
        for old in (folder / name).glob("photo_???.*"):
            old.unlink()
    for photo in photos:
        depth = f"depth/{Path(photo.name).stem}.npy"
        write_png(folder / "images" / photo.name, mi.Bitmap(np.ascontiguousarray(photo.pixels)))
        with replace_atomically(folder / depth) as temporary:
            np.save(temporary, photo.depth)
        i = photo.camera.intrinsics
        lens = {"w": i.width, "h": i.height, "fl_x": i.fx, "fl_y": i.fy, "cx": i.cx, "cy": i.cy}
        files = {"file_path": f"images/{photo.name}", "depth_file_path": depth}
        frames.append(files | lens | {"transform_matrix": photo.camera.to_world.tolist()})
    header = {"camera_model": "OPENCV", "depth_unit_scale_factor": 1.0, "is_euclidean_depth": True}
    write_json(folder / DEPTH_FILE, header | {"frames": frames})
    return folder / DEPTH_FILE
