"""Draw the gaze of a wearer of Project Aria glasses on the points of the room that the glasses reconstructed.

    python examples/aria_room.py FOLDER [--out aria-room.png] [--width 640]

FOLDER is the sample recording ``mps_sample`` of projectaria_tools (data/mps_sample there, Apache-2.0). Each point
becomes a cube; each sample of gaze is a cone, for the error of the tracker and the extent of the fovea.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import nerg_mi as nerg
from nerg_mi.figures.settings import Style
from nerg_mi.photos.posed import read_semidense
from nerg_mi.surfaces.settings import BakeSampling

import numpy as np
import trimesh


def make_cubes(points: np.ndarray, size: float) -> trimesh.Trimesh:
    """A mesh of cubes with edges of ``size`` metres that contain ``points`` (N, 3), without outliers."""
    low, high = np.percentile(points, [1, 99], axis=0)
    inside = points[((points > low) & (points < high)).all(axis=1)]
    centers = size * (np.unique(np.floor(inside / size), axis=0) + 0.5)
    cube = trimesh.creation.box((size, size, size))
    vertices = centers[:, None] + cube.vertices
    faces = cube.faces + len(cube.vertices) * np.arange(len(centers))[:, None, None]
    return trimesh.Trimesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), process=False)


def main(arguments: list[str] | None = None) -> float:
    """Draw the picture, and return the share of the gaze that ends on the points."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("aria-room.png"))
    parser.add_argument("--width", type=int, default=640)
    options = parser.parse_args(arguments)
    (points,) = options.folder.rglob("global_points.csv.gz")
    room = make_cubes(read_semidense(points), 0.03)
    rays = nerg.import_rays(options.folder / "eye_gaze" / "generalized_eye_gaze.csv", "aria")
    baked = nerg.bake(room, rays=rays, sampling=BakeSampling(cone=4.0))
    height = 2 * options.width // 3
    view = {"camera": (0.5, 0.5, 1.6), "target": (-2.0, -3.5, -0.4), "width": options.width, "height": height}
    title = f"Project Aria, one wearer, {np.ptp(rays.t):.0f} s: share of gaze per square metre"
    nerg.draw_surface(baked, options.out, style=Style(title=title), **view)
    return baked.on_surface


if __name__ == "__main__":
    main()
