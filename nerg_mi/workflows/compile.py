"""``nerg compile``: evaluate the density of a radiance field on voxels once, so that it renders faster."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.fields.compilation import attach_voxels, compile_density
from nerg_mi.fields.radiance import RadianceField
from nerg_mi.fields.voxels import BLOCK_EDGE, MAX_RESOLUTION, VoxelGrid
from nerg_mi.files.atomic import check_writable, file_sha256
from nerg_mi.formats.checkpoint import read_checkpoint, write_checkpoint
from nerg_mi.formats.fields import encode_occupancy, encode_voxels, load_radiance
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.types import variant_types
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.transport.field_medium import FieldMedium, make_color_shader
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings

from .base import select_backend
from .radiance_commands import CompileOptions

_FIRST_RESOLUTION = 256
_RAYS = 1 << 15  # Rays by which a compiled field is compared with its field
_REPEATS = 3  # Renderings of these rays, of which the fastest one counts


@dataclass(frozen=True)
class CompiledError:
    """Differences of a compiled field from the field itself, along random rays that start in empty space."""

    # Cells along an edge of the unit cube of positions.
    resolution: int
    # Size of the voxels in bytes.
    size: int
    # Absolute depth difference in scene units: median and 99 % quantile.
    depth_median: float
    depth_99: float
    # PSNR of the colour in the field's colour space, in dB.
    psnr: float
    # Time of the field's rendering of colour and depth, divided by that of the compiled field.
    speedup: float


@dataclass(frozen=True)
class Compilation:
    """A compiled ``field``, its ``error``, and those of all resolutions that were tried."""

    field: RadianceField
    error: CompiledError
    tried: list[CompiledError]


def compile_field(
    field: RadianceField, options: CompileOptions | None = None, reporter: Reporter = SILENT
) -> Compilation:
    """Compile ``field``, whose own object is not changed.

    Without a ``resolution``, it is doubled until the depth and the colour are accurate enough, or until the voxels
    would exceed ``memory``. Raises `NergError` if the first resolution does so, for a resolution that is not a multiple
    of 8, and for a field that is compiled or has no matter.
    """
    options = options or CompileOptions()
    if options.resolution % BLOCK_EDGE:
        raise NergError(f"the resolution must be a multiple of {BLOCK_EDGE}, got {options.resolution}")
    if field.voxels is not None:
        raise NergError("this field is compiled already; compile the field that it was made from")
    field.require_density("the radiance field")
    max_depth_error = options.max_depth_error or 0.1 * (field.march_step or field.box.diagonal / 1024)
    resolutions = [options.resolution] if options.resolution else _list_resolutions()
    rays = _make_rays(field)
    reference, seconds = _render(field, rays)
    tried: list[CompiledError] = []
    result, voxels = None, None
    for k, resolution in enumerate(resolutions):
        report = lambda fraction, k=k: reporter.progress((k + fraction) / len(resolutions), "compiling the density")
        start = voxels if voxels is not None and 2 * voxels.resolution == resolution else None
        try:
            voxels = compile_density(field, resolution, start, 1e6 * options.memory, report)
        except NergError as error:
            if result is None:
                raise
            reporter.warn(f"{error}; the field is compiled at {tried[-1].resolution}, which does not reach the aims")
            break
        result = attach_voxels(field, voxels)
        compiled, compiled_seconds = _render(result, rays)
        tried.append(_compare(reference, compiled, voxels, seconds / compiled_seconds))
        reporter.message(_describe(tried[-1]))
        if tried[-1].psnr >= options.min_psnr and tried[-1].depth_median <= max_depth_error:
            break
    else:
        if not options.resolution:
            reporter.warn(
                f"the aims of --min-psnr ({options.min_psnr:g} dB) and --max-depth-error ({max_depth_error:.2g}) are "
                "not reached at the highest resolution"
            )
    assert result is not None
    return Compilation(result, tried[-1], tried)


def _list_resolutions() -> list[int]:
    resolutions = [_FIRST_RESOLUTION]
    while 2 * resolutions[-1] <= MAX_RESOLUTION:
        resolutions.append(2 * resolutions[-1])
    return resolutions


def _make_rays(field: RadianceField) -> tuple[Any, Any]:
    """Origins and unit directions of random rays that start in empty space of the core of ``field``."""
    rng, ns = np.random.default_rng(0), field.ns
    core, occupancy = field.box.core, field.occupancy
    points = rng.uniform(core.lower, core.upper, (8 * _RAYS, 3)).astype(np.float32)
    if occupancy is not None:
        empty = occupancy.distance_to_occupied(field.box.to_cube(to_vector(ns.Array3f, points))).numpy() > 0
        # Without empty space, as in fog, rays start anywhere.
        points = points[empty] if empty.sum() >= _RAYS else points
    directions = rng.normal(size=(_RAYS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return points[:_RAYS], directions.astype(np.float32)


def _render(field: RadianceField, rays: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, float]:
    """Colour times opacity, opacity and depth (N, 5) of rays, and the seconds of a rendering of them."""
    mi: Any = variant_types()
    medium = FieldMedium(field)
    geometry = SceneGeometry(medium)
    settings = default_march_settings(geometry)
    o, d = (to_vector(mi.Point3f, part) for part in rays)
    shader, fastest = make_color_shader(medium, mi.Color3f), np.inf
    active = dr.full(mi.Bool, True, len(rays[0]))
    channels: list[Any] = []
    for _ in range(_REPEATS):
        begin = time.perf_counter()
        with dr.suspend_grad():
            ray = mi.Ray3f(o, mi.Vector3f(d))
            hit = geometry.trace(ray, active, settings, color=shader)
            local = medium.ray_to_local(ray.o, ray.d)
            assert hit.march is not None
            color: Any = shader.resolve_color(medium, hit.march.color, hit.medium_opacity, local, active)
            channels = [*color, hit.opacity, hit.depth("median", hit.opacity > 0)]
            dr.eval(channels)
            dr.sync_thread()
        fastest = min(fastest, time.perf_counter() - begin)
    return np.stack([np.broadcast_to(c.numpy(), len(rays[0])) for c in channels], axis=1), fastest


def _compare(reference: np.ndarray, compiled: np.ndarray, voxels: VoxelGrid, speedup: float) -> CompiledError:
    both = (reference[:, 3] >= 0.5) & (compiled[:, 3] >= 0.5)
    difference = np.abs(reference[both, 4] - compiled[both, 4])
    mse = float(np.mean((reference[:, :3] - compiled[:, :3]) ** 2, dtype=np.float64))
    median, high = np.quantile(difference, [0.5, 0.99]).tolist() if both.any() else (0.0, 0.0)
    return CompiledError(voxels.resolution, voxels.size, median, high, -10 * np.log10(max(mse, 1e-12)), speedup)


def _describe(error: CompiledError) -> str:
    return (
        f"{error.resolution} cells along an edge, {error.size / 1e6:.0f} MB: depth differs by {error.depth_median:.2g} "
        f"(99 %: {error.depth_99:.2g}), colour by {error.psnr:.1f} dB, {error.speedup:.1f} times as fast"
    )


def compile_checkpoint(
    field: str | Path, output: str | Path, options: CompileOptions | None = None, reporter: Reporter = SILENT
) -> Compilation:
    """Write the radiance field in ``field`` to ``output`` with its density in voxels, otherwise unchanged.

    The new file stores the checksum of the old one, so that gaze fields that were trained in it accept the new file.
    Raises `NergError` for errors that the user can correct.
    """
    options, field, output, start = options or CompileOptions(), Path(field), Path(output), time.perf_counter()
    check_writable(output, ".safetensors")
    loaded, _ = load_radiance(field, select_backend(options.mode))
    result = compile_field(loaded, options, reporter)
    tensors, meta = read_checkpoint(field, "radiance")
    assert result.field.voxels is not None
    arrays, voxels = encode_voxels(result.field.voxels)
    origin = meta.get("refined_from") or file_sha256(field)
    metadata = {key: value for key, value in meta.items() if key not in ("format", "kind")}
    provenance = meta.get("provenance", {}) | {"compiled": asdict(result.error)}
    metadata |= {"voxels": voxels, "refined_from": origin, "provenance": provenance}
    if result.field.box.is_contracted and result.field.occupancy is not None:
        occupancy_arrays, metadata["occupancy"] = encode_occupancy(result.field.occupancy)
        arrays |= occupancy_arrays
    write_checkpoint(output, "radiance", tensors | arrays, metadata)
    seconds = time.perf_counter() - start
    reporter.message(f"wrote {output} ({output.stat().st_size / 1e6:.0f} MB) in {seconds:.1f} s")
    return result
