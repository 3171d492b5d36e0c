"""Where people looked around: what a gaze field's depths are traced in, and the frame that it lives in."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.errors import MissingFile, NergError, mitsuba_says
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.checksum import file_sha256
from nerg_mi.formats.fields import load_radiance
from nerg_mi.formats.meshes import READERS as MESHES
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.splats.files import READERS, is_splats, read_splats, refuse_others
from nerg_mi.formats.volumes import write_volume
from nerg_mi.maths.geometry import AnyBox, Box, Similarity
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.mesh_file import check_vol
from nerg_mi.rendering.pictures import load_scene
from nerg_mi.surfaces.mesh import mitsuba_mesh
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import Place
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium
from nerg_mi.transport.volume_medium import VolumeMedium

from .hit_extent import hit_extent
from .hit_geometry import volume_dict, voxelise_hits

NOWHERE = 2.0
"""How far away everything is taken to be where no geometry is known, in the field's units."""


_STRAY, _AROUND = 0.002, 0.02
"""Share of Gaussians that may lie beyond each side of the box of splats, and what is added around the others."""


@dataclass(frozen=True, eq=False)
class GazePlace:
    """Where people looked around, and how their frame lies in it."""

    # What depths are traced in, in the field's frame (`transport.geometry.trace_depth`); None where nothing is known.
    medium: FieldMedium | VolumeMedium | SplatMedium | Place | None
    # Where a gaze field lives, in that frame.
    box: AnyBox
    # What it was made of: "field", "scene", "hits" or "none".
    kind: str
    # For the provenance (JSON): the file, and what it is.
    about: dict = field(default_factory=dict)
    # From the rays' frame, in metres, to the field's.
    align: Similarity = field(default_factory=Similarity)
    # The radiance field that the medium shows, where it is one.
    radiance: RadianceField | None = None
    # What its file holds that is not used, and what had to be guessed of it: a sentence each.
    notes: tuple[str, ...] = ()

    def points_from_rays(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the rays' frame in the field's."""
        return points @ self.align.matrix[:3, :3].T + self.align.matrix[:3, 3]

    def directions_from_rays(self, directions: np.ndarray) -> np.ndarray:
        """Unit directions (..., 3) of the rays' frame in the field's."""
        return directions @ (self.align.matrix[:3, :3] / self.align.scale).T

    def directions_to_rays(self, directions: np.ndarray) -> np.ndarray:
        """Unit directions (..., 3) of the field's frame in the rays'."""
        # The inverse of a rotation is its transpose.
        return directions @ (self.align.matrix[:3, :3] / self.align.scale)


def place_of_field(path: Path, ns: ModuleType) -> GazePlace:
    """A trained radiance field, or Gaussian splats, read from ``path`` with arrays of the backend ``ns``."""
    if path.suffix.lower() in READERS:
        return _place_of_splats(path, ns)
    refuse_others(path)
    radiance, _ = load_radiance(path, ns)
    about = {"field_file": file_identity(path)}
    return GazePlace(FieldMedium(radiance), radiance.box, "field", about, radiance=radiance)


def _place_of_splats(path: Path, ns: ModuleType) -> GazePlace:
    splats = read_splats(path)
    # Of splats that photos have trained a few lie far outside of the place.
    lower, upper = np.quantile(splats.centers.astype(np.float64), (_STRAY, 1 - _STRAY), axis=0)
    pad = _AROUND * max(upper - lower) + float(splats.scales.max(axis=1).mean())
    box = Box(tuple(lower - pad), tuple(upper + pad))
    medium, about = SplatMedium(SplatArrays(splats, ns)), {"field_file": file_identity(path)}
    return GazePlace(medium, box, "field", about, notes=(*splats.guesses, *splats.notes))


def place_of_scene(path: Path) -> GazePlace:
    """The shapes of a Mitsuba scene, and the field or volume of its integrator where that is a ``nerg``; or a mesh
    (.ply, .obj, .glb).

    Raises `NergError` for a scene with neither.
    """
    scene = _scene_of_mesh(path) if path.suffix.lower() in MESHES else load_scene(path)
    place = Place(getattr(scene.integrator(), "medium", None), scene)
    bounds = place.bounds()
    if bounds is None:
        raise NergError(
            f'the scene "{path}" has neither shapes nor a field in which people could have looked around; '
            "name one that has"
        )
    lower, upper = bounds
    # A plane has no thickness, and a field needs some.
    pad = 0.01 * max(upper - lower)
    return GazePlace(place, Box(tuple(lower - pad), tuple(upper + pad)), "scene", {"scene_file": file_identity(path)})


def _scene_of_mesh(path: Path) -> Any:
    import mitsuba as mi

    if path.suffix.lower() in READERS and is_splats(path):
        raise NergError(f'"{path}" holds Gaussian splats, which are a field: give it by --field')
    mesh = read_mesh_file(path)
    with mitsuba_says():
        return mi.load_dict({"type": "scene", "mesh": mitsuba_mesh(mesh.vertices, mesh.faces, "mesh")})


def place_of_hits(rays: Rays, path: Path, voxel: float | None = None) -> GazePlace:
    """A volume made of the rays' hit points, written to ``path`` (.vol); ``voxel``: edge of its voxels in metres, by
    default what `hit_extent` chooses."""
    extent = hit_extent(rays, voxel)
    density, box = voxelise_hits(rays, extent=extent)
    write_volume(path, density, box.lower, box.upper)
    size = {
        "shape": list(extent.shape),
        "solid": round(float((density > 0).mean()), 4),
        "voxel": extent.voxel,
        "beyond": round(extent.beyond, 4),
    }
    return place_of_volume(path, size)


def place_of_volume(path: Path, about: dict | None = None) -> GazePlace:
    """A volume that ``place_of_hits`` has written. Raises `NergError` for one that is missing or damaged."""
    import mitsuba as mi

    if not path.exists():
        raise MissingFile(f'the place of hit points "{path}" does not exist; it is written beside the gaze field')
    check_vol(path)
    box = np.fromfile(path, "<f4", 6, offset=24)
    # Mitsuba makes some box of any six numbers.
    if not (np.isfinite(box).all() and (box[:3] < box[3:]).all()):
        raise NergError(f'the place of hit points "{path}" has no box with a lower and an upper corner; make it anew')
    with mitsuba_says():
        medium = VolumeMedium(mi.load_dict(volume_dict(path)))
    lower, upper = medium.bounds()
    return GazePlace(
        medium,
        Box(tuple(lower.tolist()), tuple(upper.tolist())),
        "hits",
        {"geometry_file": {**file_identity(path), **(about or {})}},
    )


def place_of_nothing(origins: np.ndarray) -> GazePlace:
    """No geometry: everything is ``NOWHERE`` away from whoever looks from one of ``origins`` (N, 3)."""
    lower, upper = origins.min(axis=0) - NOWHERE, origins.max(axis=0) + NOWHERE
    return GazePlace(None, Box(tuple(lower.tolist()), tuple(upper.tolist())), "none", {"geometry": "none"})


def file_identity(path: Path) -> dict[str, str]:
    """Name and SHA-256 of a file, for the provenance (JSON)."""
    return {"file": path.name, "sha256": file_sha256(path)}
