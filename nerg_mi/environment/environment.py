"""The environment that participants see: a radiance field, splats, a scene, a mesh, a volume of hit points, or none."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import MissingFile, NergError, translate_mitsuba_errors
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.fields.splats import Splats
from nerg_mi.files.atomic import file_sha256
from nerg_mi.formats.fields import load_radiance
from nerg_mi.formats.meshes import read_mesh_file
from nerg_mi.formats.splats import is_splat_file, read_splats
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.geometry import AnyBox, Box, Similarity
from nerg_mi.rays.rays import Rays
from nerg_mi.rendering.files import check_vol
from nerg_mi.rendering.scene import get_array_module, load_scene
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import SceneGeometry
from nerg_mi.transport.mitsuba_mesh import make_mesh
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium
from nerg_mi.transport.volume_medium import VolumeMedium

from .contents import DensityGrid, load_content, to_scene_children
from .hits import compute_hit_extent, make_volume_dict, voxelise_hits
from .kinds import detect_kind
from .trained import TrainedField

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

    @classmethod
    def open(cls, environment: Any) -> Environment:
        """Open what observers see; the Mitsuba variant must be active.

        Parameters
        ----------
        environment : object
            A file (radiance field, splats, mesh, Mitsuba scene, volume of hit points), a `TrainedField`, a radiance
            field, splats, a `DensityGrid`, a Mitsuba scene, or shapes as for `to_scene_children`: a mesh or scene of
            trimesh, a dict for ``mi.load_dict``, a Mitsuba shape, or several of these. An `Environment` is returned
            as it is.

        Returns
        -------
        Environment
            The environment, in its own frame (``align`` is the identity). Of a file, ``metadata`` has the checksum.

        Raises
        ------
        NergError
            The file does not exist or is damaged, or ``environment`` is something else.
        """
        import mitsuba as mi

        if isinstance(environment, Environment):
            return environment
        if isinstance(environment, (str, os.PathLike)):
            return _open_file(Path(environment))
        if isinstance(environment, TrainedField):
            if environment.path is not None:
                return _open_file(environment.path)
            environment = environment.network
        if isinstance(environment, RadianceField):
            return _open_radiance(environment, "the radiance field")
        if isinstance(environment, Splats):
            return _open_splats(environment)
        if isinstance(environment, DensityGrid):
            medium = VolumeMedium(mi.load_dict(environment.volumes()["density"].load()))
            lower, upper = medium.bounds()
            return Environment(medium, Box(tuple(lower.tolist()), tuple(upper.tolist())), "scene")
        if not isinstance(environment, mi.Scene):
            is_scene = isinstance(environment, Mapping) and environment.get("type") == "scene"
            content = environment if is_scene else {"type": "scene", **to_scene_children(environment, "environment")}
            environment = load_content(content)
        return _open_scene(environment, "the environment")

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


def _open_file(path: Path) -> Environment:
    """Open an environment in a file. Raises `NergError` for a file with anything else."""
    kind = detect_kind(path)
    if kind == "hits":
        return _open_volume(path)
    if kind in ("mesh", "scene"):
        return _open_scene_file(path, kind)
    if kind != "field":
        raise NergError(
            f'"{path}" contains {"rays" if kind == "rays" else "a gaze field"} and is no environment; give a scene, a '
            "mesh, a radiance field, splats or a volume of hit points (.vol)"
        )
    metadata = {"field_file": identify_file(path)}
    if is_splat_file(path):
        return replace(_open_splats(read_splats(path)), metadata=metadata)
    radiance, _ = load_radiance(path, get_array_module())
    return replace(_open_radiance(radiance, f'"{path}"'), metadata=metadata)


def _open_radiance(radiance: RadianceField, name: str) -> Environment:
    radiance.require_density(name)
    return Environment(FieldMedium(radiance), radiance.box, "field", radiance=radiance)


def _open_splats(splats: Splats) -> Environment:
    # Splats trained on photos have outliers far away.
    lower, upper = np.quantile(splats.centers.astype(np.float64), (_OUTLIER_FRACTION, 1 - _OUTLIER_FRACTION), axis=0)
    pad = _RELATIVE_MARGIN * max(upper - lower) + float(splats.scales.max(axis=1).mean())
    box = Box(tuple(lower - pad), tuple(upper + pad))
    medium = SplatMedium(SplatArrays(splats, get_array_module()))
    return Environment(medium, box, "field", notes=(*splats.assumptions, *splats.notes))


def _open_scene(scene: Any, name: str) -> Environment:
    """Open a Mitsuba scene: its shapes and, if its integrator is a ``nerg``, the field or volume."""
    geometry = SceneGeometry(getattr(scene.integrator(), "medium", None), scene)
    bounds = geometry.bounds()
    if bounds is None:
        raise NergError(f"{name} has no shapes and no field; pass a scene with at least one of them")
    lower, upper = bounds
    # A field needs a box with some thickness, and a plane has none.
    pad = 0.01 * max(upper - lower)
    return Environment(geometry, Box(tuple(lower - pad), tuple(upper + pad)), "scene")


def _open_scene_file(path: Path, kind: str) -> Environment:
    import mitsuba as mi

    notes: tuple[str, ...] = ()
    if kind == "mesh":
        mesh = read_mesh_file(path)
        notes = mesh.notes
        with translate_mitsuba_errors(path):
            scene = mi.load_dict({"type": "scene", "mesh": make_mesh(mesh.vertices, mesh.faces, "mesh")})
    else:
        scene = load_scene(path)
    opened = _open_scene(scene, f'the scene "{path}"')
    return replace(opened, metadata={"scene_file": identify_file(path)}, notes=notes)


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
    return _open_volume(path, size)


def _open_volume(path: Path, metadata: dict | None = None) -> Environment:
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
