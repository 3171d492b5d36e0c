"""The photos of the table with exact depth, and the file that says where they were taken.

Writes into a folder: ``images/photo_NNN.png`` (8-bit sRGB), ``depth/photo_NNN.npy`` (float32 (h, w), metres along the
ray from the camera's centre through each pixel's centre, exact; 0 where only sky is seen) and
``transforms_depth.json``, which names both with poses and lenses as instant-ngp and nerfstudio do. A folder's reader
does not look for that name: the capture that is trained on is the COLMAP model that `sparse` writes beside it, which
knows no depth.
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
from nerg_mi.photos.cameras import PosedCamera, pixel_directions, make_sensor_dict

DEPTH_FILE = "transforms_depth.json"
"""The same photos, with their depth."""
ALBEDO_SPP = 100
"""Samples a pixel of what is painted on surfaces, in a photo."""
HOLDOUT_INTERVAL = 8
"""Every so many photos one is held out by default: it gets four times the samples, so that its noise does not limit
what it can measure."""


class Photo(NamedTuple):
    """``pixels`` (h, w, 3) uint8, sRGB; ``depth`` (h, w) float32, metres along the rays, 0 where only sky is seen."""

    name: str
    camera: PosedCamera
    pixels: np.ndarray
    depth: np.ndarray


class TabletopPhotographer:
    """Takes photos in a scene, with ``spp`` samples a pixel of the light."""

    def __init__(self, scene, spp: int = 24):
        import mitsuba as mi

        self.scene, self.spp = scene, spp
        self.guides = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal,position:position"})
        self.albedo = mi.load_dict({"type": "aov", "aovs": "albedo:albedo"})

    def render_radiance(self, camera: PosedCamera, seed: int, times: int = 1) -> np.ndarray:
        """Linear radiance (h, w, 3); ``times`` as many samples."""
        light = self._render(camera, seed, times * self.spp)
        # Equal seeds and numbers of samples: the same points of the film.
        guides = self._render(camera, seed, times * self.spp, self.guides)
        return denoise(light, guides, self.render_albedo(camera, seed + 1))

    def render_albedo(self, camera: PosedCamera, seed: int, spp: int = ALBEDO_SPP) -> np.ndarray:
        """Albedo (h, w, 3)."""
        return self._render(camera, seed, spp, self.albedo, "multijitter")

    def render_depth(self, camera: PosedCamera) -> np.ndarray:
        """Exact distances (h, w) float32 along the rays through the pixels' centres; 0 where nothing is hit."""
        directions = pixel_directions(camera.intrinsics) @ camera.to_world[:3, :3].T
        t = twin.cast_rays(camera.center, directions.reshape(-1, 3), self.scene)
        return np.where(np.isfinite(t), t, 0).astype(np.float32).reshape(directions.shape[:2])

    def _render(self, camera: PosedCamera, seed: int, spp: int, integrator=None, sampler="independent") -> np.ndarray:
        import drjit as dr
        import mitsuba as mi

        sensor = mi.load_dict(make_sensor_dict(camera) | {"sampler": {"type": sampler, "sample_count": spp}})
        params = mi.traverse(sensor)
        # As a literal every pose would compile kernels of its own.
        pose = mi.Transform4f(params["to_world"])
        dr.make_opaque(pose)
        params["to_world"] = pose
        params.update()
        integrator = integrator or self.scene.integrator()
        return np.array(mi.render(self.scene, sensor=sensor, integrator=integrator, spp=spp, seed=mi.UInt32(seed)))


def take_photos(scene, cameras: list[PosedCamera], spp: int = 24, seed: int = 0, log=print) -> list[Photo]:
    """A photo of ``scene`` by each camera; ``say``: where progress goes."""
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
        # An earlier, larger set would leave photos behind that no file lists.
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
    about = {"camera_model": "OPENCV", "depth_unit_scale_factor": 1.0, "is_euclidean_depth": True}
    write_json(folder / DEPTH_FILE, about | {"frames": frames})
    return folder / DEPTH_FILE
