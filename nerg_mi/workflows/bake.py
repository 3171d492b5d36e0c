"""Attention on surfaces: from meshes, scenes or fields to files with attention, and the files themselves."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from nerg_mi.errors import NergError
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
from nerg_mi.rays.rays import Rays
from nerg_mi.surfaces.laplacian import Smoother, SurfaceSums, merge_sums
from nerg_mi.surfaces.mesh import Mesh, RefinedMesh, iter_texture_rows, unwrap_uv, import_xatlas
from nerg_mi.surfaces.sources import GazeSumSettings, RaySettings

from .bake_chunks import (
    UNITS,
    BakeScene,
    BakeTarget,
    load_alignment,
    check_values,
    cone_radians,
    refine_target,
    describe_origin,
    read_target,
    select_source,
    compute_sums,
    make_gaze_groups,
)
from .base import SILENT, Reporter, select_backend
from .scene_commands import BakeOptions

# ---- Files of a bake: meshes with colours (.ply, .glb), a table of faces (.csv), and a summary (.json) ----

if TYPE_CHECKING:
    from .bake_splats import SplatBake


SUFFIXES = (".ply", ".glb", ".csv", ".json")
"""Files that are written."""

_BARE = 0.3  # linear grey of a surface that nobody looks at


@dataclass(frozen=True, eq=False)
class BakeOutput:
    """What is written: ``refined`` surface with ``density`` (V,) of its vertices in ``unit``, and ``share`` (F,) of its
    faces; ``receivers`` as they were given; ``scale``: scene units a metre."""

    receivers: BakeTarget
    refined: RefinedMesh
    density: np.ndarray
    share: np.ndarray
    unit: str
    scale: float
    heat: Heat
    about: Provenance
    summary: Mapping[str, Any]

    def input_face_shares(self) -> np.ndarray:
        """Share (F',) of the faces that were given."""
        return np.bincount(self.refined.parent, self.share, len(self.receivers.mesh.faces))


def write_output(baked: BakeOutput, path: Path, pixels: int | None) -> None:
    """Write ``baked`` to ``path``, by its suffix; ``pixels`` a side of a texture, None for none."""
    WRITERS[path.suffix.lower()](baked, path, pixels)


def _ply(baked: BakeOutput, path: Path, pixels: int | None) -> None:
    mesh, normals = baked.refined.mesh, vertex_normals(baked.refined.mesh)
    colors = np.rint(255 * _colors(baked, baked.density, normals)).astype(np.uint8)
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    columns: dict[str, np.ndarray] = dict(zip(names, [*mesh.vertices.T, *normals.T, *colors.T]))
    columns["value"] = baked.density
    comments = [f"value: {baked.unit}", f"nerg_mi {baked.about.json()}"]
    write_columns(path, columns, mesh.faces, comments=comments)


def _glb(baked: BakeOutput, path: Path, pixels: int | None) -> None:
    extras = {"unit": baked.unit, "top": baked.heat.vmax, "provenance": json.loads(baked.about.json())}
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

    whole = baked.receivers.mesh
    charts = unwrap_uv(whole, pixels)
    picture = np.zeros((pixels, pixels, 3), np.uint8)
    for rows, values, known in iter_texture_rows(charts, baked.refined, baked.density, pixels):
        picture[rows][known] = np.rint(255 * _shown(baked.heat, values[known]))
    image = encode_png(mi.Bitmap(picture), {"Comment": baked.about.json()})
    attributes = [
        ("POSITION", whole.vertices[charts.vertex].astype("<f4"), False),
        ("NORMAL", vertex_normals(whole)[charts.vertex].astype("<f4"), False),
        ("TEXCOORD_0", charts.uv.astype("<f4"), False),
    ]
    write_bytes(path, *encode_unlit_glb(attributes, charts.faces, extras=extras, image=image))


def _csv(baked: BakeOutput, path: Path, pixels: int | None) -> None:
    given, square = baked.receivers, baked.scale**2
    shares, area, center = baked.input_face_shares(), given.mesh.area, given.mesh.corners.mean(axis=1)
    factor = float(baked.summary["factor"])
    columns = ("shape", "face", "x", "y", "z", "area_m2", "value", "share")

    def row(k: int) -> tuple:
        value = factor * shares[k] / area[k] * square
        numbers = (f"{v:.9g}" for v in (*center[k], area[k] / square, value, shares[k]))
        return given.names[given.shape[k]], int(given.index[k]), *numbers

    write_csv(path, (dict(zip(columns, row(k))) for k in range(len(center))), columns)


def _json(baked: BakeOutput, path: Path, pixels: int | None) -> None:
    write_json(path, dict(baked.summary), allow_nan=False)


WRITERS = {".ply": _ply, ".glb": _glb, ".csv": _csv, ".json": _json}


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Unit normals (V, 3): means of the faces' around each vertex, by area; of opposite ones any."""
    weighted = mesh.normals * mesh.area[:, None]
    sums = np.stack([np.bincount(mesh.faces.ravel(), np.repeat(c, 3), len(mesh.vertices)) for c in weighted.T], axis=1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(length > 0, sums / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])


def _colors(baked: BakeOutput, values: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """sRGB (V, 3) of vertices: heat over grey that shades by the normal, so that an unlit mesh shows its shape."""
    shade = 0.75 + 0.25 * normals @ np.array([0.48, 0.36, 0.8])
    return _shown(baked.heat, values, shade)


def _shown(heat: Heat, values: np.ndarray, shade: np.ndarray | float = 1.0) -> np.ndarray:
    grey = np.broadcast_to(np.asarray(_BARE * np.asarray(shade))[..., None], (*values.shape, 3))
    if values.ndim == 1:
        return overlay(grey[None], values[None], heat)[0]
    return overlay(grey, values, heat)


def check_texture(paths: list[Path], pixels: int | None) -> None:
    """Raise `NergError` where a texture is asked for and no file takes one, `ImportError` where nothing makes it."""
    if pixels is None:
        return
    if not any(path.suffix.lower() == ".glb" for path in paths):
        raise NergError("--texture belongs to glTF; let the name of an output end in .glb")
    import_xatlas()


# ---- Bake ----
#
# Gaze on surfaces: how much of it each square metre of a mesh receives, from a gaze field or from tracked rays.


_ERROR = 2e-3  # of what there was; more is said to be too much
_LARGEST = 1000.0  # metres; no place that people were tracked in measures more


@dataclass(frozen=True, eq=False)
class Bake:
    """``mesh``: the surface in scene units, cut as finely as gaze was put on it, with ``density`` (V,) of its vertices
    per square metre, and ``share`` (F,) of gaze on its faces. ``on_surface``, ``elsewhere`` (at other shapes, or in a
    field), ``escaped`` (at nothing): shares of all gaze, and ``total``, what that is. ``summary``: all that was found,
    as the JSON file has it. ``files`` written."""

    mesh: Mesh
    density: np.ndarray
    share: np.ndarray
    on_surface: float
    elsewhere: float
    escaped: float
    total: float
    summary: dict[str, Any]
    files: tuple[Path, ...] = ()

    @property
    def unaccounted(self) -> float:
        """Gaze that was found nowhere, as a share of all: the error of the bake."""
        return self.total - self.on_surface - self.elsewhere - self.escaped


def bake(
    surface: str | Path,
    outputs: Sequence[str | Path] = (),
    options: BakeOptions | None = None,
    reporter: Reporter = SILENT,
    rays: Rays | None = None,
) -> Bake:
    """Put the gaze of ``options`` on ``surface``: a mesh (.ply, .obj, .glb), a scene (.xml), or a radiance field;
    on Gaussian splats `bake_splats.bake_splats` puts it.

    ``outputs``: files to write, by their suffixes (.ply, .glb, .csv, .json). ``rays``: in memory, in place of the file
    in ``options``. With ``options.store`` or ``options.scheduler`` some observers, or rays, at a time are a part, which
    is kept and may be made by others; the sums are the same to the bit. Raises `NergError` for what the user can mend.
    """
    options, surface, start = options or BakeOptions(), Path(surface), time.perf_counter()
    paths = [Path(path) for path in outputs]
    source = _check(surface, paths, options, rays)
    ns = select_backend(options.mode, options.threads)
    reporter.progress(0.0, "reading")
    align = load_alignment(options)
    receivers = read_target(surface, options.shapes, options.resolution, ns, reporter)
    across = receivers.mesh.diagonal / align.scale
    if across > _LARGEST:
        reporter.warn(
            f"the surface measures {across:,.0f} m across; if its unit is not the metre, give --align with the scale "
            "from metres to it"
        )
    refined = refine_target(receivers, options.max_edge, align.scale)
    mesh = refined.mesh
    reporter.message(f"{len(receivers.mesh.faces):,} triangles, cut into {len(mesh.faces):,} to hold gaze")
    cone = cone_radians(options, source)
    scene = BakeScene(
        mesh,
        receivers.others,
        options.gaze if source == "field" else None,
        surface.absolute() if surface.suffix.lower() == ".xml" else None,
        GazeSumSettings(max_angle=math.radians(options.max_angle), cone_sigma=cone),
        RaySettings(cone_sigma=cone, rays_per_cone=options.cone_samples, seed=options.seed),
    )
    groups, factor = make_gaze_groups(options, source, rays, align, reporter)
    found = compute_sums(scene, groups, options, paths[0] if paths else surface, reporter)
    sums = merge_sums(found)
    reporter.progress(0.9, "smoothing")
    smoother = Smoother(mesh, options.smooth * align.scale) if options.smooth > 0 else None
    shares, amounts = _smoothed(mesh, sums, smoother)
    weight = sums.weight
    share, amount = shares / weight, amounts / weight
    density = factor * amount / mesh.vertex_area * align.scale**2
    summary = _summary(receivers, refined.parent, sums, share, factor, options, source)
    if len(found) == 2:
        summary["halves_cc"] = _agreement(mesh, found, smoother)
    heat = Heat(options.vmax or _top(mesh, density), options.cmap, decades=options.log_decades)
    about, summary["provenance"] = describe_origin(surface, options)
    baked = BakeOutput(receivers, refined, density, share, UNITS[options.unit], align.scale, heat, about, summary)
    _tell(summary, reporter)
    for path in paths:
        reporter.progress(0.95, f"writing {path.name}")
        write_output(baked, path, options.texture_size)
        reporter.message(f"wrote {path} ({path.stat().st_size / 1e6:.1f} MB, {time.perf_counter() - start:.1f} s)")
    on, elsewhere, escaped, total = (summary[k] for k in ("on_surface", "elsewhere", "escaped", "total"))
    return Bake(mesh, density, share, on, elsewhere, escaped, total, summary, tuple(paths))


def bake_any(
    surface: Path, output: Sequence[Path], options: BakeOptions, reporter: Reporter, rays: Rays | None = None
) -> Bake | SplatBake:
    """`bake` on a mesh, and `bake_splats.bake_splats` on Gaussian splats."""
    from .bake_splats import bake_splats

    return (bake_splats if is_splat_file(surface) else bake)(surface, output, options, reporter, rays)


def _check(surface: Path, paths: list[Path], options: BakeOptions, rays: Rays | None) -> str:
    """Whose gaze it is, of `bake_chunks.SOURCES`. Raises `NergError` for options that contradict each other."""
    for path in paths:
        check_writable(path, *SUFFIXES)
    check_texture(paths, options.texture_size)
    check_values(options)
    return select_source(options, rays, surface.suffix.lower() == ".xml")


def _smoothed(mesh: Mesh, sums: SurfaceSums, smoother: Smoother | None) -> tuple[np.ndarray, np.ndarray]:
    """Integrals over faces (F,) and over hat functions (V,), after smoothing."""
    if smoother is None:
        return sums.face_sums, sums.vertex_sums
    amount = smoother(sums.vertex_sums)
    return (amount / mesh.vertex_area)[mesh.faces].mean(axis=1) * mesh.area, amount


def _agreement(mesh: Mesh, halves: list[SurfaceSums], smoother: Smoother | None) -> float:
    """Correlation of two halves' densities over the surface."""
    first, second = (_smoothed(mesh, half, smoother)[0] / mesh.area for half in halves)
    return float(cc(first, second, mesh.area))


def _top(mesh: Mesh, density: np.ndarray) -> float:
    """The density that 99.5 % of the looked-at area stays below."""
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


def _tell(summary: dict[str, Any], reporter: Reporter) -> None:
    whom = f"{summary['lookers']:,} {'rays' if summary['source'] == 'rays' else 'observers'}"
    reporter.message(
        f"of the gaze of {whom} {summary['on_surface']:.2%} lies on the surface, {summary['elsewhere']:.2%} on what "
        f"else is there, and {summary['escaped']:.2%} meets no surface; {abs(summary['unaccounted']):.1e} is "
        "unaccounted for"
    )
    if abs(summary["total"] - 1) > _ERROR:
        reporter.warn(
            f"the gaze adds up to {summary['total']:.3f} over the sphere, for the field is not normalised: divide "
            "shares by that to compare them"
        )
    if abs(summary["unaccounted"]) > _ERROR * summary["total"]:
        reporter.warn("more than 0.2 % of the gaze is unaccounted for; a smaller --angle or --detail makes that less")
    if "halves_cc" in summary:
        reporter.message(f"two halves of the people agree by CC {summary['halves_cc']:.3f}")
