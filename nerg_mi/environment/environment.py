"""The environment that participants see: a radiance field, splats, a scene, a mesh, a volume of hit points, or none."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, translate_mitsuba_errors
from nerg_mi.fields.splats import Splats
from nerg_mi.files import html
from nerg_mi.files.atomic import file_sha256
from nerg_mi.files.values import FilePath, hash_arrays, normalize_name
from nerg_mi.formats.meshes import read_mesh_file, with_shading_normals
from nerg_mi.formats.splats import read_splats, write_ply_splats
from nerg_mi.formats.surfaces import write_volume
from nerg_mi.maths.geometry import AnyBox, Box, Similarity
from nerg_mi.maths.transforms import transform_points
from nerg_mi.progress import WarningReporter
from nerg_mi.tracking.rays import Rays
from nerg_mi.transport.field_medium import FieldMedium
from nerg_mi.transport.geometry import SURFACE_OPACITY, SceneGeometry, trace_depth
from nerg_mi.transport.mitsuba_mesh import make_mesh
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium
from nerg_mi.transport.volume_medium import VolumeMedium

from .bands import is_nerg
from .contents import (
    DensityGrid,
    FieldVolume,
    GridVolume,
    find_tag,
    from_trimesh,
    has_nerg,
    is_trimesh,
    load_content,
    to_scene_children,
    write_content,
)
from .hits import compute_hit_extent, make_volume_dict, voxelise_hits
from .kinds import detect_kind
from .nested_scene import DEFAULT_SPP, VIEW_PROPERTIES, nest_scene
from .radiance import RadianceField
from .rendering_files import check_vol, write_mesh
from .scene import Scene, find_content
from .scene_loading import activate_mitsuba, get_array_module, load_scene
from .scene_parts import show_directions, show_field, show_hits, show_hits_in_memory, show_mesh, show_mesh_in_memory
from .scene_writer import SceneContent
from .trained import TrainedField

_CHOICES = "give a scene, a mesh, a radiance field, splats or a volume of hit points (.vol)"

DEFAULT_DEPTH = 2.0  # Distance of the surface points if there is no geometry, in units of the field

_OUTLIER_FRACTION, _RELATIVE_MARGIN = 0.002, 0.02
"""Fraction of the Gaussians that may lie beyond each side of the box of splats, and the relative margin around the
others.
"""


@dataclass(frozen=True, eq=False, repr=False)
class Environment:
    """What observers see, and its alignment to the rays.

    >>> import nerg_mi as nerg, trimesh
    >>> room = nerg.Environment.open(trimesh.creation.box((6, 4, 3)))
    >>> room
    <Environment: scene in memory, box (-3.06, -2.06, -1.56) to (3.06, 2.06, 1.56)>
    """

    # Medium or scene in which depths are traced, in the frame of the field (`transport.geometry.trace_depth`); None: no
    # geometry.
    medium: FieldMedium | VolumeMedium | SplatMedium | SceneGeometry | None
    box: AnyBox  # Bounds of the gaze field in that frame
    kind: str  # Source: "field", "splats", "mesh", "scene", "grid", "hits" or "none"
    metadata: dict = field(default_factory=dict)  # Files and properties for the provenance (JSON)
    # Similarity from the frame of the rays, in metres, to that of the field
    align: Similarity = field(default_factory=Similarity)
    radiance: RadianceField | None = None  # Radiance field of the medium, if it is one
    # Notes on unused or assumed content of its file, one sentence each.
    notes: tuple[str, ...] = ()
    path: Path | None = None  # Its file
    source: Any = field(default=None, repr=False)  # The object that it was opened from, if it has no file
    nerg: Any = field(default=None, repr=False)  # Integrator ``nerg`` of its scene, if that has one

    @property
    def provenance(self) -> Mapping[str, Any]:
        """The provenance of its radiance field; empty without one."""
        return {} if self.radiance is None else self.radiance.provenance

    @property
    def bounds(self) -> np.ndarray:
        """Lower and upper corner (2, 3) of the bounding box, in the units of the environment."""
        return np.array([self.box.lower, self.box.upper], np.float64)

    @cached_property
    def scene_geometry(self) -> SceneGeometry:
        """The geometry as that of a scene; empty without geometry."""
        return self.medium if isinstance(self.medium, SceneGeometry) else SceneGeometry(self.medium)

    @property
    def shapes(self) -> dict[str, Any]:
        """Shapes of the scene by name; scene files need ``keep_shapes``."""
        scene = self.scene_geometry.scene
        return {} if scene is None else {normalize_name(shape.id()): shape for shape in scene.shapes()}

    @classmethod
    def open(cls, environment: Any, *, keep_shapes: bool = False) -> Environment:
        """Open what observers see.

        Parameters
        ----------
        environment : object
            A file (radiance field, splats, mesh, Mitsuba scene, volume of hit points), a `RadianceField`,
            splats, a `DensityGrid`, a `Scene`, a Mitsuba scene, or shapes as for `to_scene_children`: a mesh or
            scene of trimesh, a dict for ``mi.load_dict``, a Mitsuba shape, or several of these. An `Environment` is
            returned as it is.
        keep_shapes : bool
            Whether the shapes of scene files keep their names, in place of being merged by material, which is faster.

        Returns
        -------
        Environment
            The environment, in its own frame (``align`` is the identity). Of a file, ``metadata`` has the checksum.

        Raises
        ------
        NergError
            The file does not exist or is damaged, or ``environment`` is something else.
        """
        if isinstance(environment, Environment):
            if not keep_shapes or environment.kind != "scene" or environment.path is None:
                return environment
            return replace(_open_file(environment.path, keep_shapes), align=environment.align)
        mi = activate_mitsuba()
        if isinstance(environment, (str, os.PathLike)):
            return _open_file(Path(environment), keep_shapes)
        if isinstance(environment, TrainedField) and environment.path is not None:
            return _open_file(environment.path)
        if isinstance(environment, TrainedField) and not isinstance(environment, RadianceField):
            raise NergError(f"{environment!r} is no environment; {_CHOICES}")
        if isinstance(environment, RadianceField):
            return replace(_open_radiance(environment), source=environment)
        if isinstance(environment, Splats):
            return replace(_open_splats(environment), source=environment)
        if isinstance(environment, DensityGrid):
            medium = VolumeMedium(mi.load_dict(environment.volumes()["density"].load()))
            return Environment(medium, _find_box(medium), "grid", source=environment)
        if isinstance(environment, Scene) and environment.path is not None:
            return _open_file(environment.path, keep_shapes)
        if isinstance(environment, Scene):
            scene = environment.mitsuba
        elif isinstance(environment, mi.Scene):
            scene = environment
        else:
            is_scene = isinstance(environment, Mapping) and environment.get("type") == "scene"
            content = environment if is_scene else {"type": "scene", **to_scene_children(environment, "environment")}
            scene = load_content(content)
        return replace(_open_scene(scene, "the environment"), source=environment)

    def save(self, stem: FilePath) -> Environment:
        """Write an environment that has no file.

        Parameters
        ----------
        stem : path
            The file without its suffix, which follows from the content: .safetensors, .ply, .vol or .xml. Meshes of a
            scene are written to a folder next to it.

        Returns
        -------
        Environment
            The environment of the file; this one if it has a file, or if there is no geometry.

        Raises
        ------
        NergError
            A file cannot be written.
        """
        if self.path is not None or self.source is None:
            return self
        path = _write_source(self.source, Path(stem))
        if self.kind == "hits":
            opened = _open_file(path)
            described = {"geometry_file": opened.metadata["geometry_file"] | self.metadata["geometry_file"]}
            return replace(opened, align=self.align, metadata=described)
        kind = detect_kind(path)
        metadata = {**self.metadata, FILES[kind].key: identify_file(path)}
        return replace(self, kind=kind, path=path, source=None, metadata=metadata)

    def save_beside(self, checkpoint: Path) -> Environment:
        """Write an environment that has no file next to the ``checkpoint`` of a gaze field; returns as `save`."""
        stem = checkpoint.with_suffix("")
        return self.save(stem if self.kind == "hits" else stem.with_name(f"{stem.name}.environment"))

    @property
    def input(self) -> Any:
        """Its file, or the object that it was opened from if it has no file."""
        return self.source if self.path is None else self.path

    @property
    def has_surfaces(self) -> bool:
        """Whether there is something to see: without geometry, participants have directions only."""
        return self.kind != "none"

    @property
    def description(self) -> str:
        """What is shown, in a sentence."""
        text = FILES[self.kind].description if self.kind in FILES else _DESCRIPTIONS[self.kind]
        return text.format("in memory" if self.path is None else self.path.name)

    def to_scene_content(self, output: Path | None = None) -> SceneContent:
        """Return what shows the environment in the scene file ``output``, or in a scene in memory.

        In a scene file, the environment has a file or no geometry, and files that Mitsuba needs are written next to
        it: colours of hit points, and a mesh that it cannot read. Raises `NergError` for a file that cannot be shown.
        """
        if self.kind == "none":
            return show_directions(DEFAULT_DEPTH)
        if self.path is not None:
            return FILES[self.kind].show(self.path, output)
        assert output is None, "environments in memory are saved first"
        return _show_source(self)

    @cached_property
    def digest(self) -> str:
        """SHA-256 (hex) of the surfaces: of the weights of a field, the Gaussians, the voxels, or the shapes."""
        return hash_arrays(_list_arrays(self.medium))

    def _facts(self) -> list[tuple[str, str]]:
        name = self.path.name if self.path is not None else "in memory"
        lower, upper = (", ".join(f"{x:.3g}" for x in corner) for corner in self.bounds)
        return [("kind", self.kind), ("name", name), ("box", f"({lower}) to ({upper})")]

    def __repr__(self) -> str:
        kind, name, box = (value for _, value in self._facts())
        return f"<Environment: {kind} {name}, box {box}>"

    def _repr_html_(self) -> str:
        return html.key_value_table([*self._facts(), *(("note", note) for note in self.notes)])

    def trace_depth(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the distance (N,) to the first surface on rays (N, 3) in the frame of the field, infinite if there is
        none."""
        if self.medium is None:
            return np.full(len(origins), np.inf)
        depth, opacity = trace_depth(self.medium, origins, directions)
        return np.where((opacity >= SURFACE_OPACITY) & (depth > 0), depth, np.inf).astype(np.float64)

    def points_to_field(self, points: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) from the frame of the rays to that of the field."""
        return transform_points(self.align.matrix, points)

    def directions_to_field(self, directions: np.ndarray) -> np.ndarray:
        """Transform unit directions (..., 3) from the frame of the rays to that of the field."""
        return directions @ (self.align.matrix[:3, :3] / self.align.scale).T

    def directions_to_rays(self, directions: np.ndarray) -> np.ndarray:
        """Transform unit directions (..., 3) from the frame of the field to that of the rays."""
        # The inverse of a rotation is its transpose.
        return directions @ (self.align.matrix[:3, :3] / self.align.scale)


def _open_file(path: Path, keep_shapes: bool = False) -> Environment:
    """Open an environment in a file. Raises `NergError` for a file with anything else."""
    kind = detect_kind(path)
    if kind not in FILES:
        raise NergError(
            f'"{path}" contains {"rays" if kind == "rays" else "a gaze field"} and is no environment; {_CHOICES}'
        )
    opened = FILES[kind].open(path, keep_shapes)
    return replace(opened, kind=kind, path=path, metadata={FILES[kind].key: identify_file(path) | opened.metadata})


def _open_field_file(path: Path, keep_shapes: bool) -> Environment:
    return _open_radiance(RadianceField.load(path))


def _open_radiance(radiance: RadianceField) -> Environment:
    network = radiance.network
    network.require_density(radiance.label)
    return Environment(FieldMedium(network), network.box, "field", radiance=radiance)


def _open_splats(splats: Splats) -> Environment:
    # Splats trained on photos have outliers far away.
    lower, upper = np.quantile(splats.centers.astype(np.float64), (_OUTLIER_FRACTION, 1 - _OUTLIER_FRACTION), axis=0)
    pad = _RELATIVE_MARGIN * max(upper - lower) + float(splats.scales.max(axis=1).mean())
    box = Box(tuple(lower - pad), tuple(upper + pad))
    medium = SplatMedium(SplatArrays(splats, get_array_module()))
    return Environment(medium, box, "splats", notes=(*splats.assumptions, *splats.notes))


def _open_scene(scene: Any, name: str) -> Environment:
    """Open a Mitsuba scene: its shapes and, if its integrator is a ``nerg``, the field or volume."""
    nerg = scene.integrator() if is_nerg(scene.integrator()) else None
    geometry = SceneGeometry(None if nerg is None else nerg.medium, scene)
    bounds = geometry.bounds()
    if bounds is None:
        raise NergError(f"{name} has no shapes and no field; pass a scene with at least one of them")
    lower, upper = bounds
    # A field needs a box with some thickness, and a plane has none.
    pad = 0.01 * max(upper - lower)
    return Environment(geometry, Box(tuple(lower - pad), tuple(upper + pad)), "scene", nerg=nerg)


def _open_mesh_file(path: Path, keep_shapes: bool) -> Environment:
    import mitsuba as mi

    mesh = read_mesh_file(path)
    parts = mesh.split_parts() if keep_shapes else {}
    if len(parts) > 1:
        used = {name: np.unique(faces, return_inverse=True) for name, faces in parts.items()}
        shapes = {name: make_mesh(mesh.vertices[v], k.reshape(-1, 3), name) for name, (v, k) in used.items()}
    else:
        shapes = {"mesh": make_mesh(mesh.vertices, mesh.faces, "mesh")}
    with translate_mitsuba_errors(path):
        # Names with dots are no keys of a dict of Mitsuba.
        scene = mi.load_dict({"type": "scene"} | {f"shape_{k}": shape for k, shape in enumerate(shapes.values())})
    for shape, name in zip(shapes.values(), shapes):
        shape.set_id(name)
    return replace(_open_scene(scene, f'the scene "{path}"'), notes=mesh.notes)


def _open_scene_file(path: Path, keep_shapes: bool) -> Environment:
    return _open_scene(load_scene(path, merge=not keep_shapes), f'the scene "{path}"')


def make_hit_geometry(rays: Rays, voxel: float | None = None) -> Environment:
    """Make a volume of the hit points of ``rays``, in memory.

    ``voxel`` is the voxel edge in metres; by default `compute_hit_extent` chooses it.
    """
    mi = activate_mitsuba()
    extent = compute_hit_extent(rays, voxel)
    density, box = voxelise_hits(rays, extent=extent)
    size = {
        "shape": list(extent.shape),
        "solid": round(float((density > 0).mean()), 4),
        "voxel": extent.voxel,
        "beyond": round(extent.outside_fraction, 4),
    }
    # The corners of the file, which are single precision.
    grid = GridVolume(density, np.asarray(box.lower, np.float32), np.asarray(box.upper, np.float32))
    medium = VolumeMedium(mi.load_dict({**grid.load(), "filter_type": "nearest"}))
    return Environment(medium, _find_box(medium), "hits", {"geometry_file": size}, source=grid)


def _find_box(medium: VolumeMedium) -> Box:
    lower, upper = medium.bounds()
    return Box(tuple(lower.tolist()), tuple(upper.tolist()))


def _open_volume(path: Path, keep_shapes: bool) -> Environment:
    """Load a volume written by `make_hit_geometry`. Raises `NergError` if it is damaged."""
    import mitsuba as mi

    check_vol(path)
    box = np.fromfile(path, "<f4", 6, offset=24)
    # Mitsuba does not validate the box.
    if not (np.isfinite(box).all() and (box[:3] < box[3:]).all()):
        raise NergError(f'the hit-point volume "{path}" has an invalid bounding box; create it again')
    with translate_mitsuba_errors(path):
        medium = VolumeMedium(mi.load_dict(make_volume_dict(path)))
    return Environment(medium, _find_box(medium), "hits")


def no_geometry(origins: np.ndarray) -> Environment:
    """Return an empty geometry in which every surface point is ``DEFAULT_DEPTH`` away from the observers ``origins``
    (N, 3).
    """
    lower, upper = origins.min(axis=0) - DEFAULT_DEPTH, origins.max(axis=0) + DEFAULT_DEPTH
    return Environment(None, Box(tuple(lower.tolist()), tuple(upper.tolist())), "none", {"geometry": "none"})


@dataclass(frozen=True)
class EnvironmentFile:
    """What files of one kind contain: how they are opened, and shown in the scene file ``output``."""

    open: Callable[[Path, bool], Environment]  # of a file, and whether shapes keep their names
    show: Callable[[Path, Path | None], SceneContent]  # of a file and ``output``
    key: str  # of the file in the provenance
    description: str  # of what is shown, in a sentence with the name of the file


FILES = {
    "field": EnvironmentFile(_open_field_file, show_field, "field_file", "A radiance field trained on photos, {}."),
    "splats": EnvironmentFile(
        lambda path, keep_shapes: _open_splats(read_splats(path)), show_field, "field_file", "Gaussian splats, {}."
    ),
    "mesh": EnvironmentFile(_open_mesh_file, show_mesh, "scene_file", "The mesh {}."),
    "scene": EnvironmentFile(
        _open_scene_file, lambda path, output: nest_scene(path), "scene_file", "The Mitsuba scene {}."
    ),
    "hits": EnvironmentFile(
        _open_volume,
        show_hits,
        "geometry_file",
        "The scene consists of the hit points of rays, {}, in grey; there are no photos of it.",
    ),
}
"""Files of environments, by their kind (`kinds.detect_kind`)."""

_DESCRIPTIONS = {"grid": "A grid of densities, {}.", "none": "There is no geometry: only directions are shown."}
"""What is shown of an environment that has no file, by its kind."""


def identify_file(path: Path) -> dict[str, str]:
    """Return the name and SHA-256 of a file for the provenance (JSON)."""
    return {"file": path.name, "sha256": file_sha256(path)}


# ---- Environments in memory as files, and their content ----


def _write_source(source: Any, stem: Path) -> Path:
    """Write the object ``source`` of an environment, and return its file."""
    make_path = lambda suffix: stem.with_name(f"{stem.name}{suffix}")
    if isinstance(source, RadianceField):
        source.save(path := make_path(".safetensors"))
    elif isinstance(source, Splats):
        write_ply_splats(path := make_path(".ply"), source)
    elif isinstance(source, GridVolume):
        write_volume(path := make_path(".vol"), source.values, source.lower, source.upper)
    elif is_trimesh(source) and len(meshes := from_trimesh(source, "environment")) == 1:
        write_mesh(path := make_path(".ply"), next(iter(meshes.values())))
    elif isinstance(source, Scene):
        source.save(path := make_path(".xml"))
    else:
        write_content(path := make_path(".xml"), _list_content(source), "Shapes of an environment.")
    return path


def _show_source(environment: Environment) -> SceneContent:
    """Return what shows an environment that has no file in a scene in memory."""
    source, scene = environment.source, environment.scene_geometry.scene
    if isinstance(source, (RadianceField, Splats)):
        return SceneContent(volumes={"field": FieldVolume(source, "field")}, subject=environment.description)
    if isinstance(source, DensityGrid):
        return SceneContent(volumes=source.volumes(), subject=environment.description)
    if isinstance(source, GridVolume):
        return show_hits_in_memory(source.values, source.lower.astype(float), source.upper.astype(float))
    if is_trimesh(source) and len(meshes := from_trimesh(source, "environment")) == 1:
        return show_mesh_in_memory(with_shading_normals(next(iter(meshes.values()))))
    if isinstance(source, Scene) and source.source is not None:
        return nest_scene(*source.source)
    # Children of the integrator are loaded objects; numbers and texts are known of a dict only.
    content, nerg = find_content(source) or {}, environment.nerg
    properties = next((child for child in content.values() if find_tag(child) == "integrator"), {})
    values = {k: v for k, v in properties.items() if k != "type" and isinstance(v, (str, bool, int, float))}
    if nerg is not None:
        values |= nerg.children
    is_lit = nerg is None or "integrator" in values or (scene is not None and bool(scene.emitters()))
    return SceneContent(
        volumes={name: value for name, value in values.items() if name not in VIEW_PROPERTIES},
        shapes=to_scene_children(scene, "environment"),
        spp=DEFAULT_SPP if is_lit else SceneContent.spp,
        left_out=tuple(name for name in values if name in VIEW_PROPERTIES),
        subject=environment.description,
    )


def _list_content(source: Any) -> dict[str, Any]:
    """Return the content of the scene file of an environment."""
    import mitsuba as mi

    if isinstance(source, DensityGrid):
        return {"type": "scene", "integrator": {"type": "nerg", "aovs": "depth,opacity", **source.volumes()}}
    if isinstance(source, Mapping) and source.get("type") == "scene" and has_nerg(source):
        return dict(source)
    children = to_scene_children(source, "environment")
    lights = [name for name, child in children.items() if isinstance(child, mi.Emitter)]
    if lights:
        WarningReporter().warn(
            f"{len(lights)} lights of a Mitsuba scene are left out, since objects of Mitsuba cannot be written to a "
            "file; pass the dict or the file of the scene to keep them"
        )
    return {"type": "scene", **{name: child for name, child in children.items() if name not in lights}}


def _list_arrays(medium: Any) -> dict[str, np.ndarray]:
    """Return the arrays that determine the surfaces of a medium or a scene, by name."""
    import mitsuba as mi

    if isinstance(medium, SceneGeometry):
        arrays = {f"medium.{name}": array for name, array in _list_arrays(medium.medium).items()}
        for number, shape in enumerate(() if medium.scene is None else medium.scene.shapes()):
            for name, value in dict(mi.traverse(shape)).items():
                if name in ("faces", "vertex_positions", "to_world"):
                    arrays[f"{number}.{name}"] = np.array(getattr(value, "matrix", value))
        return arrays
    return {} if medium is None else {str(k): np.array(array) for k, array in enumerate(medium.parameters())}
