"""Bake gaze onto surfaces: from meshes, scenes or fields to files with gaze per unit area."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.evaluation.metrics import cc
from nerg_mi.figures.overlay import Heat, overlay
from nerg_mi.figures.style import Provenance
from nerg_mi.files.atomic import check_writable, write_bytes
from nerg_mi.files.images import encode_png
from nerg_mi.files.tables import write_csv, write_json
from nerg_mi.formats.gltf import Attribute, encode_unlit_glb
from nerg_mi.formats.ply import write_columns
from nerg_mi.formats.splats import is_splat_file
from nerg_mi.maths.color import decode_srgb
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.rays import Rays
from nerg_mi.surfaces.laplacian import Smoother, SurfaceSums, merge_sums
from nerg_mi.surfaces.mesh import Mesh, RefinedMesh, import_xatlas, iter_texture_rows, unwrap_uv
from nerg_mi.surfaces.sources import GazeSumSettings, RaySettings

from .bake_chunks import (
    UNITS,
    BakeScene,
    BakeTarget,
    check_values,
    compute_sums,
    cone_radians,
    describe_origin,
    load_alignment,
    make_gaze_groups,
    read_target,
    refine_target,
    select_source,
)
from .base import select_backend
from .scene_commands import BakeOptions

# ---- Output files: meshes with colours (.ply, .glb), a table of faces (.csv), and a summary (.json) ----

if TYPE_CHECKING:
    from .bake_splats import SplatBake


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


def write_output(baked: BakeOutput, path: Path, pixels: int | None) -> None:
    """Write ``baked`` to ``path`` in the format of its suffix, with a texture of ``pixels`` per side, or none."""
    WRITERS[path.suffix.lower()](baked, path, pixels)


def _ply(baked: BakeOutput, path: Path, pixels: int | None) -> None:
    mesh, normals = baked.refined.mesh, vertex_normals(baked.refined.mesh)
    colors = np.rint(255 * _colors(baked, baked.density, normals)).astype(np.uint8)
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
        rgba[:, :3] = np.rint(65535 * decode_srgb(_colors(baked, baked.density, normals)))
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


def _colors(baked: BakeOutput, values: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return sRGB colours (V, 3) of vertices: heat map over a grey that is shaded by the normal."""
    shade = 0.75 + 0.25 * normals @ np.array([0.48, 0.36, 0.8])
    return _shown(baked.heat, values, shade)


def _shown(heat: Heat, values: np.ndarray, shade: np.ndarray | float = 1.0) -> np.ndarray:
    grey = np.broadcast_to(np.asarray(_BARE * np.asarray(shade))[..., None], (*values.shape, 3))
    if values.ndim == 1:
        return overlay(grey[None], values[None], heat)[0]
    return overlay(grey, values, heat)


def check_texture(paths: list[Path], pixels: int | None) -> None:
    """Raise `NergError` if no output file can hold the texture, `ImportError` if the unwrapping library is missing."""
    if pixels is None:
        return
    if not any(path.suffix.lower() == ".glb" for path in paths):
        raise NergError(f"{parameter('texture_size')} needs a glTF output; add an output whose name ends in .glb")
    import_xatlas()


# ---- Bake ----
#
# Gaze per unit area of a surface, from a gaze field or from recorded rays.


_ERROR = 2e-3  # relative; a larger error is reported
_LARGEST = 1000.0  # metres; larger surfaces are probably not in metres


@dataclass(frozen=True, eq=False)
class Bake:
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
    files
        Written files.
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
    files: tuple[Path, ...] = ()

    def __repr__(self) -> str:
        return f"<Bake: {len(self.mesh.faces):,} triangles, {self.on_surface:.3g} of the gaze on the surface>"

    def save(self, path: str | Path) -> Path:
        """Write a file in the format of its suffix (.ply, .glb, .csv, .json). Raises `NergError` for another one."""
        path = Path(path)
        check_writable(path, *SUFFIXES)
        write_output(self.content, path, None)
        return path

    @property
    def unaccounted(self) -> float:
        """Share of the gaze that was not assigned to anything: the numerical error of the bake."""
        return self.total - self.on_surface - self.elsewhere - self.escaped


def bake(
    surface: str | Path,
    outputs: Sequence[str | Path] = (),
    options: BakeOptions | None = None,
    reporter: Reporter = SILENT,
    rays: Rays | None = None,
) -> Bake:
    """Bake the gaze of ``options`` onto ``surface``: a mesh (.ply, .obj, .glb), a scene (.xml) or a radiance field.

    `bake_splats.bake_splats` does the same for Gaussian splats.

    Parameters
    ----------
    surface
        File of the target surface.
    outputs
        Files to write; the suffix selects the format (.ply, .glb, .csv, .json).
    options
        Source of the gaze, sampling and colours. With ``options.store`` or ``options.scheduler`` groups of observers or
        rays are parts that are stored and may run elsewhere; the sums are bitwise the same.
    reporter
        Receives messages and progress.
    rays
        Rays in memory, in place of the file in ``options``.

    Raises
    ------
    NergError
        For errors that the user can correct.
    """
    options, surface, start = options or BakeOptions(), Path(surface), time.perf_counter()
    paths = [Path(path) for path in outputs]
    source = _check(surface, paths, options, rays)
    ns = select_backend(options.mode, options.threads)
    reporter.progress(0.0, "reading")
    align = load_alignment(options, reporter)
    receivers = read_target(surface, options.shapes, options.resolution, ns, reporter)
    across = receivers.mesh.diagonal / align.scale
    if across > _LARGEST:
        reporter.warn(
            f"the surface is {across:,.0f} m across; if its unit is not the metre, give {parameter('align')} with "
            "the scale from metres to that unit"
        )
    refined = refine_target(receivers, options.max_edge, align.scale)
    mesh = refined.mesh
    reporter.message(f"{len(receivers.mesh.faces):,} triangles, subdivided into {len(mesh.faces):,}")
    cone = cone_radians(options, source)
    scene = BakeScene(
        mesh,
        receivers.occluders,
        options.gaze if source == "field" else None,
        surface.absolute() if surface.suffix.lower() == ".xml" else None,
        GazeSumSettings(max_angle=math.radians(options.max_angle), cone_sigma=cone),
        RaySettings(cone_sigma=cone, rays_per_cone=options.cone_samples, seed=options.seed),
    )
    groups, factor = make_gaze_groups(options, source, rays, align, reporter)
    group_sums = compute_sums(scene, groups, options, paths[0] if paths else surface, reporter)
    sums = merge_sums(group_sums)
    reporter.progress(0.9, "smoothing")
    smoother = Smoother(mesh, options.smooth * align.scale) if options.smooth > 0 else None
    shares, amounts = _smoothed(mesh, sums, smoother)
    weight = sums.weight
    share, amount = shares / weight, amounts / weight
    density = factor * amount / mesh.vertex_area * align.scale**2
    summary = _summary(receivers, refined.parent, sums, share, factor, options, source)
    if len(group_sums) == 2:
        summary["halves_cc"] = _agreement(mesh, group_sums, smoother)
    heat = Heat(options.vmax or _percentile_density(mesh, density), options.cmap, decades=options.log_decades)
    record, summary["provenance"] = describe_origin(surface, options)
    baked = BakeOutput(receivers, refined, density, share, UNITS[options.unit], align.scale, heat, record, summary)
    _report_summary(summary, reporter)
    for path in paths:
        reporter.progress(0.95, f"writing {path.name}")
        write_output(baked, path, options.texture_size)
        reporter.message(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB, {time.perf_counter() - start:.1f} s)")
    on, elsewhere, escaped, total = (summary[k] for k in ("on_surface", "elsewhere", "escaped", "total"))
    return Bake(mesh, density, share, on, elsewhere, escaped, total, summary, baked, tuple(paths))


def bake_any(
    surface: Path, output: Sequence[Path], options: BakeOptions, reporter: Reporter, rays: Rays | None = None
) -> Bake | SplatBake:
    """Call `bake` for meshes, scenes and fields, and `bake_splats.bake_splats` for Gaussian splats."""
    from .bake_splats import bake_splats

    return (bake_splats if is_splat_file(surface) else bake)(surface, output, options, reporter, rays)


def _check(surface: Path, paths: list[Path], options: BakeOptions, rays: Rays | None) -> str:
    """Return the source of the gaze, one of `bake_chunks.SOURCES`. Raises `NergError` for contradictory options."""
    for path in paths:
        check_writable(path, *SUFFIXES)
    check_texture(paths, options.texture_size)
    check_values(options)
    return select_source(options, rays, surface.suffix.lower() == ".xml")


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
    options: BakeOptions,
    source: str,
) -> dict[str, Any]:
    w = sums.weight
    of_shape = np.bincount(receivers.shape[parent], share, len(receivers.names))
    return {
        "source": source,
        "unit": UNITS[options.unit],
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
