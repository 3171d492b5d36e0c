"""Bake gaze onto surfaces: from meshes, scenes or fields to files with gaze per unit area."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from nerg_mi.environment.environment import Environment
from nerg_mi.environment.scene_loading import activate_mitsuba
from nerg_mi.errors import parameter
from nerg_mi.evaluation.metrics import cc
from nerg_mi.fields.splats import Splats
from nerg_mi.figures.overlay import Heat, overlay
from nerg_mi.figures.style import Provenance, changed_arguments, find_colormap
from nerg_mi.files.atomic import check_writable, write_bytes
from nerg_mi.files.html import Summary
from nerg_mi.files.images import encode_png
from nerg_mi.files.tables import write_csv, write_json
from nerg_mi.files.values import FilePath
from nerg_mi.formats.gltf import Attribute, encode_unlit_glb
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import is_splat_file
from nerg_mi.maths.color import decode_srgb
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import LENGTHS, RAYS, SEEDS, Range, check_ranges
from nerg_mi.tasks.settings import Parallel
from nerg_mi.tracking.rays import Rays

from .bake_parts import UNITS, BakeInputs, MeshBaker, compute_sums, is_scene, load_alignment, make_gaze_groups
from .bake_splats import SplatBake, bake_splats
from .laplacian import Smoother, SurfaceSums, merge_sums
from .mesh import Mesh, RefinedMesh, import_xatlas, iter_texture_rows, unwrap_uv
from .settings import BakeColors, BakeSampling
from .sources import GazeSumSettings, RaySettings
from .targets import BakeTarget, read_target, refine_target

# ---- Output files: meshes with colours (.ply, .glb), a table of faces (.csv), and a summary (.json) ----

SUFFIXES = (".ply", ".glb", ".csv", ".json")
"""Suffixes of output files."""

_BARE = 0.3  # linear grey of a surface without gaze


@dataclass(frozen=True, eq=False)
class BakeOutput:
    """Content of the output files.

    Attributes
    ----------
    receivers
        Target surface as given.
    refined
        Subdivided target surface.
    density
        Gaze density (V,) at the vertices of ``refined``, in ``unit``.
    share
        Share of the gaze (F,) on the faces of ``refined``.
    scale
        Scene units per metre.
    heat
        Colour scale.
    provenance
        Provenance for file headers.
    summary
        Content of the JSON file.
    """

    receivers: BakeTarget
    refined: RefinedMesh
    density: np.ndarray
    share: np.ndarray
    unit: str
    scale: float
    heat: Heat
    provenance: Provenance
    summary: Mapping[str, Any]

    def input_face_shares(self) -> np.ndarray:
        """Return the share of the gaze (F',) on each face of the target surface as given."""
        return np.bincount(self.refined.parent, self.share, len(self.receivers.mesh.faces))

    def vertex_colors(self) -> np.ndarray:
        """Return sRGB colours (V, 3) of the vertices of ``refined``: heat map over a grey shaded by the normal."""
        shade = 0.75 + 0.25 * vertex_normals(self.refined.mesh) @ np.array([0.48, 0.36, 0.8])
        return _shown(self.heat, self.density, shade)


def write_output(baked: BakeOutput, path: Path, pixels: int | None) -> None:
    """Write ``baked`` to ``path`` in the format of its suffix, with a texture of ``pixels`` per side, or none."""
    WRITERS[path.suffix.lower()](baked, path, pixels)


def _ply(baked: BakeOutput, path: Path, pixels: int | None) -> None:
    mesh, normals = baked.refined.mesh, vertex_normals(baked.refined.mesh)
    colors = np.rint(255 * baked.vertex_colors()).astype(np.uint8)
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    columns: dict[str, np.ndarray] = dict(zip(names, [*mesh.vertices.T, *normals.T, *colors.T]))
    columns["value"] = baked.density
    comments = [f"value: {baked.unit}", f"nerg_mi {baked.provenance.json()}"]
    write_columns(path, columns, mesh.faces, comments=comments)


def _glb(baked: BakeOutput, path: Path, pixels: int | None) -> None:
    extras = {"unit": baked.unit, "top": baked.heat.vmax, "provenance": json.loads(baked.provenance.json())}
    mesh = baked.refined.mesh
    normals = vertex_normals(mesh)
    if pixels is None:
        rgba = np.full((len(mesh.vertices), 4), 65535, "<u2")
        rgba[:, :3] = np.rint(65535 * decode_srgb(baked.vertex_colors()))
        attributes: list[Attribute] = [
            ("POSITION", mesh.vertices.astype("<f4"), False),
            ("NORMAL", normals.astype("<f4"), False),
            ("COLOR_0", rgba, True),
            ("_VALUE", baked.density.astype("<f4"), False),
        ]
        write_bytes(path, *encode_unlit_glb(attributes, mesh.faces, extras=extras))
        return
    import mitsuba as mi

    target_mesh = baked.receivers.mesh
    charts = unwrap_uv(target_mesh, pixels)
    picture = np.zeros((pixels, pixels, 3), np.uint8)
    for rows, values, valid in iter_texture_rows(charts, baked.refined, baked.density, pixels):
        picture[rows][valid] = np.rint(255 * _shown(baked.heat, values[valid]))
    image = encode_png(mi.Bitmap(picture), {"Comment": baked.provenance.json()})
    attributes = [
        ("POSITION", target_mesh.vertices[charts.vertex].astype("<f4"), False),
        ("NORMAL", vertex_normals(target_mesh)[charts.vertex].astype("<f4"), False),
        ("TEXCOORD_0", charts.uv.astype("<f4"), False),
    ]
    write_bytes(path, *encode_unlit_glb(attributes, charts.faces, extras=extras, image=image))


def _csv(baked: BakeOutput, path: Path, pixels: int | None) -> None:
    target, square = baked.receivers, baked.scale**2
    shares, area, center = baked.input_face_shares(), target.mesh.area, target.mesh.corners.mean(axis=1)
    factor = float(baked.summary["factor"])
    columns = ("shape", "face", "x", "y", "z", "area_m2", "value", "share")

    def row(k: int) -> tuple:
        value = factor * shares[k] / area[k] * square
        numbers = (f"{v:.9g}" for v in (*center[k], area[k] / square, value, shares[k]))
        return target.names[target.shape[k]], int(target.index[k]), *numbers

    write_csv(path, (dict(zip(columns, row(k))) for k in range(len(center))), columns)


def _json(baked: BakeOutput, path: Path, pixels: int | None) -> None:
    write_json(path, dict(baked.summary), allow_nan=False)


WRITERS = {".ply": _ply, ".glb": _glb, ".csv": _csv, ".json": _json}


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Return unit normals (V, 3): area-weighted means of the normals of adjacent faces."""
    weighted = mesh.normals * mesh.area[:, None]
    sums = np.stack([np.bincount(mesh.faces.ravel(), np.repeat(c, 3), len(mesh.vertices)) for c in weighted.T], axis=1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(length > 0, sums / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])


def _shown(heat: Heat, values: np.ndarray, shade: np.ndarray | float = 1.0) -> np.ndarray:
    grey = np.broadcast_to(np.asarray(_BARE * np.asarray(shade))[..., None], (*values.shape, 3))
    if values.ndim == 1:
        return overlay(grey[None], values[None], heat)[0]
    return overlay(grey, values, heat)


# ---- Bake ----
#
# Gaze per unit area of a surface, from a gaze field or from recorded rays.


_ERROR = 2e-3  # relative; a larger error is reported
_LARGEST = 1000.0  # metres; larger surfaces are probably not in metres


@dataclass(frozen=True, eq=False, repr=False)
class Bake(Summary):
    """Result of a bake.

    Attributes
    ----------
    mesh
        Target surface in scene units, subdivided.
    density
        Gaze density (V,) at the vertices, per square metre.
    share
        Share of the gaze (F,) on the faces.
    on_surface, elsewhere, escaped
        Shares of the gaze on the target, on other shapes or in a field, and on nothing.
    total
        Integral of the gaze.
    summary
        Content of the JSON file.
    content
        Content of output files.
    texture_size
        Width and height of the texture in .glb files; None: colours of vertices.
    """

    mesh: Mesh
    density: np.ndarray
    share: np.ndarray
    on_surface: float
    elsewhere: float
    escaped: float
    total: float
    summary: dict[str, Any]
    content: BakeOutput
    texture_size: int | None = None

    def __repr__(self) -> str:
        return f"<Bake: {len(self.mesh.faces):,} triangles, {self.on_surface:.3g} of the gaze on the surface>"

    def save(self, path: str | Path) -> Path:
        """Write a file in the format of its suffix (.ply, .glb, .csv, .json). Raises `NergError` for another one."""
        path = Path(path)
        check_writable(path, *SUFFIXES)
        write_output(self.content, path, self.texture_size)
        return path

    @property
    def unaccounted(self) -> float:
        """Share of the gaze that was not assigned to anything: the numerical error of the bake."""
        return self.total - self.on_surface - self.elsewhere - self.escaped


@check_ranges
def bake(
    surface: FilePath | Any,
    *,
    gaze: FilePath | Any = None,
    rays: FilePath | Rays | None = None,
    source: Literal["field", "rays"] | None = None,
    observer: Sequence[float] | None = None,
    observer_file: FilePath | None = None,
    align: FilePath | Any = None,
    shapes: tuple[str, ...] = (),
    smooth: Annotated[float, Range(0, 10**6)] = 0.0,
    max_edge: Annotated[float, LENGTHS] | None = None,
    unit: Literal["share", "seconds"] = "share",
    split_half: bool = False,
    max_samples: Annotated[int, RAYS] | None = None,
    seed: Annotated[int, SEEDS] = 0,
    sampling: BakeSampling = BakeSampling(),
    colors: BakeColors = BakeColors(),
    parallel: Parallel = Parallel(),
    progress: Progress = None,
) -> Bake | SplatBake:
    """Compute how much gaze each square metre of a surface receives, from a gaze field or from recorded rays.

    Parameters
    ----------
    surface : path or environment in memory
        Mesh (.ply, .obj, .glb), scene (.xml), radiance field (.safetensors) or Gaussian splats.
    gaze : path or GazeField, optional
        Gaze field (.safetensors). Required unless the surface is a scene (.xml) whose integrator has a gaze field, or
        ``rays`` gives the gaze. Default: the gaze field of that scene.
    rays : path or Rays, optional
        Rays file or dataset: positions of the observers, or the gaze itself.
    source : str, optional
        Source of the gaze: field (evaluate the gaze field) or rays (the recorded rays). Default: field with ``gaze``,
        or if the scene has a gaze field and ``rays`` is not given; else rays.
    observer : sequence of float, optional
        Position x,y,z of a single observer in scene coordinates, in place of those of ``rays``.
    observer_file : path, optional
        CSV file of observers with columns x, y, z in scene coordinates and, optionally, weight: the relative weight of
        the observer's gaze in the sum over observers, 0 or more, in every row if the column exists. Without the column
        all weights are equal. Without the file, observers are those of ``observer`` or ``rays``.
    align : path, Similarity or array, optional
        JSON file with the 4x4 similarity from the frame of the rays to that of the scene, as nerg align writes it.
        Default: the alignment of the gaze field.
    shapes : tuple of str
        Name of a shape of the scene that receives gaze, while the other shapes only occlude. Default: all
        shapes.
    smooth : float
        Standard deviation in metres of smoothing along the surface; 0: no smoothing.
    max_edge : float, optional
        Maximum edge length of a triangle in metres; longer edges are split. Default: a length that yields about
        100,000 triangles.
    unit : str
        Unit of the values: share (fraction of the gaze, 1/m²) or seconds (of the rays, s/m²).
    split_half : bool
        Report the agreement between two halves of the participants (for rays).
    max_samples : int, optional
        Maximum number of samples read from a dataset; larger datasets are subsampled uniformly with ``seed``. Default:
        no limit.
    seed : int
        Seed of the random numbers for subsampling, observers and cones.
    sampling : BakeSampling
        How the gaze is sampled (`nerg_mi.surfaces.settings.BakeSampling`).
    colors : BakeColors
        Colours of files (`nerg_mi.surfaces.settings.BakeColors`).
    parallel : Parallel
        Where parts run (`nerg_mi.tasks.settings.Parallel`): groups of observers or rays. The sums are bitwise the same.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    Bake or SplatBake
        Attention per square metre and its sums, with a method ``save`` (.ply, .glb, .csv, .json; of splats .ply and
        .json).

    Raises
    ------
    NergError
        An argument or a file is invalid.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> store = files("nerg_mi.scenes.store")
    >>> gaze = store / "shoppers.safetensors"
    >>> baked = nerg.bake(store / "twin.ply", gaze=gaze, observer=(4.4, 2.8, 1.6), max_edge=1.0)
    >>> 0.9 < baked.on_surface < 1, abs(baked.unaccounted) < 0.01
    (True, True)
    """
    changed = changed_arguments(bake, locals())
    activate_mitsuba()
    find_colormap(colors.cmap)
    if colors.texture_size is not None:
        import_xatlas()
    inputs = BakeInputs(
        surface=surface,
        gaze=gaze,
        rays=rays,
        source=source,
        observer=observer,
        observer_file=None if observer_file is None else Path(observer_file),
        align=align,
        shapes=tuple(shapes),
        smooth=smooth,
        max_edge=max_edge,
        unit=unit,
        split_half=split_half,
        max_samples=max_samples,
        seed=seed,
        sampling=sampling,
        colors=colors,
    )
    with open_reporter(progress) as reporter:
        if isinstance(surface, Splats) or (isinstance(surface, (str, os.PathLike)) and is_splat_file(Path(surface))):
            return bake_splats(inputs, changed, parallel, reporter)
        return _bake_triangles(inputs, changed, parallel, reporter)


def _bake_triangles(inputs: BakeInputs, changed: Mapping[str, Any], parallel: Parallel, reporter: Reporter) -> Bake:
    source = inputs.select_source()
    reporter.progress(0.0, "reading")
    gaze = inputs.open_gaze()
    align = load_alignment(inputs, gaze, reporter)
    scene = Environment.open(inputs.surface, keep_shapes=True) if is_scene(inputs.surface) else None
    receivers = read_target(inputs.surface, scene, inputs.shapes, inputs.sampling.resolution, reporter)
    across = receivers.mesh.diagonal / align.scale
    if across > _LARGEST:
        reporter.warn(
            f"the surface is {across:,.0f} m across; if its unit is not the metre, give {parameter('align')} with "
            "the scale from metres to that unit"
        )
    refined = refine_target(receivers, inputs.max_edge, align.scale)
    mesh = refined.mesh
    reporter.message(f"{len(receivers.mesh.faces):,} triangles, subdivided into {len(mesh.faces):,}")
    sampling, cone = inputs.sampling, inputs.cone_radians(source)
    baker = MeshBaker(
        mesh,
        receivers.occluders,
        gaze.network if gaze is not None and source == "field" else None,
        None if scene is None else scene.nerg,
        GazeSumSettings(max_angle=math.radians(sampling.max_angle), cone_sigma=cone),
        RaySettings(cone_sigma=cone, rays_per_cone=sampling.cone_samples, seed=inputs.seed),
    )
    groups, factor = make_gaze_groups(inputs, source, align, reporter)
    group_sums = compute_sums(baker, groups, inputs, parallel, reporter)
    sums = merge_sums(group_sums)
    reporter.progress(0.9, "smoothing")
    smoother = Smoother(mesh, inputs.smooth * align.scale) if inputs.smooth > 0 else None
    shares, amounts = _smoothed(mesh, sums, smoother)
    weight = sums.weight
    share, amount = shares / weight, amounts / weight
    density = factor * amount / mesh.vertex_area * align.scale**2
    summary = _summary(receivers, refined.parent, sums, share, factor, inputs.unit, source)
    if len(group_sums) == 2:
        summary["halves_cc"] = _agreement(mesh, group_sums, smoother)
    colors = inputs.colors
    heat = Heat(colors.vmax or _percentile_density(mesh, density), colors.cmap, decades=colors.log_decades)
    record, summary["provenance"] = inputs.describe_origin(changed)
    baked = BakeOutput(receivers, refined, density, share, UNITS[inputs.unit], align.scale, heat, record, summary)
    _report_summary(summary, reporter)
    on, elsewhere, escaped, total = (summary[k] for k in ("on_surface", "elsewhere", "escaped", "total"))
    return Bake(mesh, density, share, on, elsewhere, escaped, total, summary, baked, colors.texture_size)


def _smoothed(mesh: Mesh, sums: SurfaceSums, smoother: Smoother | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the integrals over faces (F,) and over vertex hat functions (V,), smoothed."""
    if smoother is None:
        return sums.face_sums, sums.vertex_sums
    amount = smoother(sums.vertex_sums)
    return (amount / mesh.vertex_area)[mesh.faces].mean(axis=1) * mesh.area, amount


def _agreement(mesh: Mesh, halves: list[SurfaceSums], smoother: Smoother | None) -> float:
    """Return the correlation between the densities of two halves of the participants."""
    first, second = (_smoothed(mesh, half, smoother)[0] / mesh.area for half in halves)
    return float(cc(first, second, mesh.area))


def _percentile_density(mesh: Mesh, density: np.ndarray) -> float:
    """Return the 99.5th percentile of the density over the area with gaze."""
    seen = np.flatnonzero(density > 0)
    if not len(seen):
        return 1.0
    order = seen[np.argsort(density[seen], kind="stable")]
    area = np.cumsum(mesh.vertex_area[order])
    return float(density[order[min(np.searchsorted(area, 0.995 * area[-1]), len(order) - 1)]])


def _summary(
    receivers: BakeTarget,
    parent: np.ndarray,
    sums: SurfaceSums,
    share: np.ndarray,
    factor: float,
    unit: str,
    source: str,
) -> dict[str, Any]:
    w = sums.weight
    of_shape = np.bincount(receivers.shape[parent], share, len(receivers.names))
    return {
        "source": source,
        "unit": UNITS[unit],
        "factor": factor,
        "lookers": sums.count,
        "total": sums.total / w,
        "on_surface": float(share.sum()),
        "elsewhere": sums.elsewhere / w,
        "escaped": sums.escaped / w,
        "unaccounted": sums.unaccounted / w,
        "shapes": {name: float(value) for name, value in zip(receivers.names, of_shape)},
    }


def _report_summary(summary: dict[str, Any], reporter: Reporter) -> None:
    whom = f"{summary['lookers']:,} {'rays' if summary['source'] == 'rays' else 'observers'}"
    reporter.message(
        f"gaze of {whom}: {summary['on_surface']:.2%} on the surface, {summary['elsewhere']:.2%} on other "
        f"objects, {summary['escaped']:.2%} hits no surface; {abs(summary['unaccounted']):.1e} unaccounted for"
    )
    if abs(summary["total"] - 1) > _ERROR:
        reporter.warn(
            f"the gaze integrates to {summary['total']:.3f} over the sphere, because the field is not normalised; "
            "divide shares by this value to compare them"
        )
    if abs(summary["unaccounted"]) > _ERROR * summary["total"]:
        reporter.warn(
            f"more than 0.2 % of the gaze is unaccounted for; reduce {parameter('max_angle')} or "
            f"{parameter('max_edge')}"
        )
    if "halves_cc" in summary:
        reporter.message(f"agreement between two halves of the participants: CC {summary['halves_cc']:.3f}")
