"""The environment that participants see: a radiance field, splats, a scene, a mesh, a volume of hit points, or none."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from nerg_mi.errors import MissingFile, NergError, parameter, translate_mitsuba_errors
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.fields import load_radiance
from nerg_mi.formats.meshes import READERS as MESHES
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.splats import READERS, is_splat_file, read_splats, refuse_unsupported_splats
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.geometry import AnyBox, Box, Similarity
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.files import check_vol
from nerg_mi.rendering.scene import load_scene
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.mitsuba_mesh import make_mesh
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium
from nerg_mi.transport.volume_medium import VolumeMedium

from .hits import compute_hit_extent, make_volume_dict, voxelise_hits

DEFAULT_DEPTH = 2.0  # Distance of the surface points if there is no geometry, in units of the field

_OUTLIER_FRACTION, _RELATIVE_MARGIN = 0.002, 0.02
"""Fraction of the Gaussians that may lie beyond each side of the box of splats, and the relative margin around the
others.
"""


@dataclass(frozen=True, eq=False)
class Environment:
    """Geometry of a gaze training and its alignment to the rays."""

    # Medium or scene in which depths are traced, in the frame of the field (`transport.geometry.trace_depth`); None: no
    # geometry.
    medium: FieldMedium | VolumeMedium | SplatMedium | SceneGeometry | None
    box: AnyBox  # Bounds of the gaze field in that frame
    kind: str  # Source: "field", "scene", "hits" or "none"
    metadata: dict = field(default_factory=dict)  # Files and properties for the provenance (JSON)
    # Similarity from the frame of the rays, in metres, to that of the field
    align: Similarity = field(default_factory=Similarity)
    radiance: RadianceField | None = None  # Radiance field of the medium, if it is one
    # Notes on unused or assumed content of its file, one sentence each.
    notes: tuple[str, ...] = ()

    @property
    def scene_geometry(self) -> SceneGeometry:
        """The geometry as that of a scene; empty without geometry."""
        return self.medium if isinstance(self.medium, SceneGeometry) else SceneGeometry(self.medium)

    def points_to_field(self, points: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) from the frame of the rays to that of the field."""
        return points @ self.align.matrix[:3, :3].T + self.align.matrix[:3, 3]

    def directions_to_field(self, directions: np.ndarray) -> np.ndarray:
        """Transform unit directions (..., 3) from the frame of the rays to that of the field."""
        return directions @ (self.align.matrix[:3, :3] / self.align.scale).T

    def directions_to_rays(self, directions: np.ndarray) -> np.ndarray:
        """Transform unit directions (..., 3) from the frame of the field to that of the rays."""
        # The inverse of a rotation is its transpose.
        return directions @ (self.align.matrix[:3, :3] / self.align.scale)


def load_field_geometry(path: Path, ns: ModuleType) -> Environment:
    """Load a radiance field or Gaussian splats from ``path`` with the Dr.Jit backend ``ns``."""
    if path.suffix.lower() in READERS:
        return _load_splat_geometry(path, ns)
    refuse_unsupported_splats(path)
    radiance, _ = load_radiance(path, ns)
    radiance.require_density(f'"{path}"')
    metadata = {"field_file": identify_file(path)}
    return Environment(FieldMedium(radiance), radiance.box, "field", metadata, radiance=radiance)


def _load_splat_geometry(path: Path, ns: ModuleType) -> Environment:
    splats = read_splats(path)
    # Splats trained on photos have outliers far away.
    lower, upper = np.quantile(splats.centers.astype(np.float64), (_OUTLIER_FRACTION, 1 - _OUTLIER_FRACTION), axis=0)
    pad = _RELATIVE_MARGIN * max(upper - lower) + float(splats.scales.max(axis=1).mean())
    box = Box(tuple(lower - pad), tuple(upper + pad))
    medium, metadata = SplatMedium(SplatArrays(splats, ns)), {"field_file": identify_file(path)}
    return Environment(medium, box, "field", metadata, notes=(*splats.assumptions, *splats.notes))


def load_scene_geometry(path: Path) -> Environment:
    """Load a Mitsuba scene or a mesh (.ply, .obj, .glb).

    The geometry consists of the shapes of the scene and, if its integrator is a ``nerg``, of the field or volume.
    Raises `NergError` for a scene with neither.
    """
    scene, notes = _load_mesh_scene(path) if path.suffix.lower() in MESHES else (load_scene(path), ())
    scene_geometry = SceneGeometry(getattr(scene.integrator(), "medium", None), scene)
    bounds = scene_geometry.bounds()
    if bounds is None:
        raise NergError(f'the scene "{path}" has no shapes and no field; pass a scene with at least one of them')
    lower, upper = bounds
    # A field needs a box with some thickness, and a plane has none.
    pad = 0.01 * max(upper - lower)
    box, metadata = Box(tuple(lower - pad), tuple(upper + pad)), {"scene_file": identify_file(path)}
    return Environment(scene_geometry, box, "scene", metadata, notes=notes)


def _load_mesh_scene(path: Path) -> tuple[Any, tuple[str, ...]]:
    """Load the mesh in ``path`` as a scene, with notes on unused content of the file."""
    import mitsuba as mi

    if path.suffix.lower() in READERS and is_splat_file(path):
        raise NergError(f'"{path}" contains Gaussian splats, not a mesh; pass it with {parameter("field")}')
    mesh = read_mesh_file(path)
    with translate_mitsuba_errors(path):
        return mi.load_dict({"type": "scene", "mesh": make_mesh(mesh.vertices, mesh.faces, "mesh")}), mesh.notes


def make_hit_geometry(rays: Rays, path: Path, voxel: float | None = None) -> Environment:
    """Make a volume of the hit points of ``rays`` and write it to ``path`` (.vol).

    ``voxel`` is the voxel edge in metres; by default `compute_hit_extent` chooses it.
    """
    extent = compute_hit_extent(rays, voxel)
    density, box = voxelise_hits(rays, extent=extent)
    write_volume(path, density, box.lower, box.upper)
    size = {
        "shape": list(extent.shape),
        "solid": round(float((density > 0).mean()), 4),
        "voxel": extent.voxel,
        "beyond": round(extent.outside_fraction, 4),
    }
    return load_volume_geometry(path, size)


def load_volume_geometry(path: Path, metadata: dict | None = None) -> Environment:
    """Load a volume written by `make_hit_geometry`. Raises `NergError` if it is missing or damaged."""
    import mitsuba as mi

    if not path.exists():
        raise MissingFile(f'the hit-point volume "{path}" does not exist; it is stored next to the gaze field')
    check_vol(path)
    box = np.fromfile(path, "<f4", 6, offset=24)
    # Mitsuba does not validate the box.
    if not (np.isfinite(box).all() and (box[:3] < box[3:]).all()):
        raise NergError(f'the hit-point volume "{path}" has an invalid bounding box; create it again')
    with translate_mitsuba_errors(path):
        medium = VolumeMedium(mi.load_dict(make_volume_dict(path)))
    lower, upper = medium.bounds()
    return Environment(
        medium,
        Box(tuple(lower.tolist()), tuple(upper.tolist())),
        "hits",
        {"geometry_file": {**identify_file(path), **(metadata or {})}},
    )


def no_geometry(origins: np.ndarray) -> Environment:
    """Return an empty geometry in which every surface point is ``DEFAULT_DEPTH`` away from the observers ``origins``
    (N, 3).
    """
    lower, upper = origins.min(axis=0) - DEFAULT_DEPTH, origins.max(axis=0) + DEFAULT_DEPTH
    return Environment(None, Box(tuple(lower.tolist()), tuple(upper.tolist())), "none", {"geometry": "none"})


def identify_file(path: Path) -> dict[str, str]:
    """Return the name and SHA-256 of a file for the provenance (JSON)."""
    return {"file": path.name, "sha256": file_sha256(path)}
