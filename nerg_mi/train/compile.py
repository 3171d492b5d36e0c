"""Faster radiance fields: compilation, which stores the density on voxels, and a finer occupancy grid."""

from __future__ import annotations

import copy
import time
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import drjit as dr
import numpy as np

from nerg_mi.environment.radiance import RadianceField
from nerg_mi.errors import NergError, parameter
from nerg_mi.fields.color_fit import fit_colors
from nerg_mi.fields.compilation import attach_voxels, compile_density
from nerg_mi.fields.occupancy import refine_occupancy
from nerg_mi.fields.radiance import RadianceNetwork
from nerg_mi.fields.voxels import BLOCK_EDGE, COLOR_NUMBERS, LATTICE_EDGES, MAX_RESOLUTION, VoxelGrid
from nerg_mi.files.values import FilePath
from nerg_mi.maths.arrays import to_vector
from nerg_mi.maths.types import variant_types
from nerg_mi.progress import Progress, Reporter, open_reporter
from nerg_mi.ranges import LENGTHS, Range, check_ranges
from nerg_mi.transport.field_medium import FieldMedium, make_color_shader
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings

_RESOLUTIONS = [256, 512, 1024, MAX_RESOLUTION]
_RAYS = 1 << 15  # Rays by which a compiled field is compared with its field
_REPEATS = 3  # Renderings of these rays, of which the fastest one counts

# ---- Compilation ----


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
class StoredColorError:
    """Differences of stored colours from those of the networks on the same voxels, along the same rays."""

    # Cells of the lattice of colours along an edge of the unit cube of positions.
    resolution: int
    # Size of the colours in bytes.
    size: int
    # PSNR in dB, compared with the networks on the same voxels.
    psnr: float
    # Time of a rendering of colour and depth with the networks, divided by that with the stored colours.
    speedup: float


@check_ranges
def compile_field(
    field: RadianceField | FilePath,
    *,
    resolution: Annotated[int, Range(0, 2048)] = 0,
    max_depth_error: Annotated[float, LENGTHS] | None = None,
    color: bool = False,
    min_psnr: Annotated[float, Range(0, 120)] = 38.0,
    memory: Annotated[float, Range(1, 16384)] = 300.0,
    progress: Progress = None,
) -> RadianceField:
    """Evaluate the density of a radiance field on voxels once, so that frames take about half the time.

    The compiled field is compared with the field along random rays, the same for the choice of the resolution and for
    the errors that are reported. Gaze fields that were trained in the field accept the compiled one.

    Parameters
    ----------
    field : RadianceField or path
        Radiance field (.safetensors).
    resolution : int
        Number of voxels along the longest edge of the field's bounding box, a multiple of 8. 0: double it from 256 on
        until both errors are below their limits.
    max_depth_error : float, optional
        Maximum median depth error in scene units. Default: a tenth of a march step.
    color : bool
        Store colours on the voxels as well, fitted to those of the networks, so that images do not need these. It takes
        minutes, and up to 5 times the memory. If the stored colours differ from those of the networks on the same
        voxels by more than ``min_psnr``, colour still comes from the networks.
    min_psnr : float
        Minimum PSNR in dB of the colour, compared with the field itself.
    memory : float
        Maximum size of the voxels and their colours in MB.
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    RadianceField
        The compiled field. ``provenance["compiled"]`` has its resolution, its size in bytes, its depth errors in scene
        units, the PSNR of its colour in dB and the speed-up, and ``provenance["stored_color"]`` those of stored
        colours.

    Raises
    ------
    NergError
        An argument is invalid, the field is compiled already or has no matter, or the voxels would exceed ``memory``.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> field = nerg.RadianceField.load(files("nerg_mi.scenes.store") / "store.safetensors")
    >>> small = nerg.compile_field(field, resolution=128)
    >>> small.provenance["compiled"]["resolution"]
    128
    """
    original = RadianceField.open(field)
    network = original.network
    if resolution % BLOCK_EDGE:
        raise NergError(f"{parameter('resolution')} must be a multiple of {BLOCK_EDGE}, got {resolution}")
    if network.voxels is not None:
        raise NergError("this field is compiled already; compile the field that it was made from")
    network.require_density("the radiance field")
    max_depth_error = max_depth_error or 0.1 * (network.march_step or network.box.diagonal / 1024)
    resolutions = [resolution] if resolution else _RESOLUTIONS
    rays = _make_rays(network)
    reference, seconds = _render(network, rays)
    voxels = result = pixels = None
    with open_reporter(progress) as reporter:
        for k, edge in enumerate(resolutions):
            report = lambda fraction, k=k: reporter.progress((k + fraction) / len(resolutions), "compiling the density")
            start = voxels if voxels is not None and 2 * voxels.resolution == edge else None
            try:
                voxels = compile_density(network, edge, start, 1e6 * memory, report)
            except NergError as error:
                if result is None:
                    raise
                reached = result.provenance["compiled"]["resolution"]
                reporter.warn(f"{error.message}; the field is compiled at {reached}, which does not reach the aims")
                break
            compiled = attach_voxels(network, voxels)
            pixels, compiled_seconds = _render(compiled, rays)
            error = _compare(reference, pixels, voxels, seconds / compiled_seconds)
            reporter.message(
                f"{error.resolution} cells along an edge, {error.size / 1e6:.0f} MB: depth differs by "
                f"{error.depth_median:.2g} (99 %: {error.depth_99:.2g}), colour by {error.psnr:.1f} dB, "
                f"{error.speedup:.1f} times as fast"
            )
            result = original.derive(compiled, compiled=asdict(error))
            if error.psnr >= min_psnr and error.depth_median <= max_depth_error:
                break
        else:
            if not resolution:
                reporter.warn(
                    f"the aims of {parameter('min_psnr')} ({min_psnr:g} dB) and {parameter('max_depth_error')} "
                    f"({max_depth_error:.2g}) are not reached at the highest resolution"
                )
        assert result is not None and pixels is not None
        return _store_colors(result, pixels, rays, memory, min_psnr, reporter) if color else result


def _store_colors(
    compiled: RadianceField,
    reference: np.ndarray,
    rays: tuple[np.ndarray, np.ndarray],
    memory: float,
    min_psnr: float,
    reporter: Reporter,
) -> RadianceField:
    """The ``compiled`` field with colours on the finest lattice within ``memory`` if they are within ``min_psnr`` of
    its own, which the ``rays`` have in the ``reference`` (N, 5); else itself, with a warning."""
    network = copy.copy(compiled.network)
    voxels = network.voxels = copy.copy(network.voxels)
    assert voxels is not None
    sizes = {edge: COLOR_NUMBERS * (edge + 1) ** 3 * len(voxels.blocks) for edge in LATTICE_EDGES}
    edge = next((edge for edge, size in sizes.items() if voxels.size + size <= 1e6 * memory), None)
    if edge is None:
        reporter.warn(
            f"colours would take {min(sizes.values()) / 1e6:.0f} MB next to voxels of {voxels.size / 1e6:.0f} MB, and "
            f"are not stored; use a lower resolution or a higher {parameter('memory')} (now {memory:g} MB)"
        )
        return compiled
    colors = fit_colors(network, edge, lambda fraction: reporter.progress(fraction, "fitting the colours"))
    _, seconds = _render(network, rays)
    voxels.colors = colors
    pixels, stored_seconds = _render(network, rays)
    psnr, resolution = _compute_psnr(reference, pixels), edge * voxels.resolution // BLOCK_EDGE
    error = StoredColorError(resolution, colors.size, psnr, seconds / stored_seconds)
    text = (
        f"colours on {resolution} cells along an edge, {colors.size / 1e6:.0f} MB: {psnr:.1f} dB compared with the "
        f"networks; {_RAYS:,} rays take {1e3 * stored_seconds:.3g} ms, with the networks {1e3 * seconds:.3g} ms"
    )
    if psnr < min_psnr:
        reporter.warn(
            f"{text}; the networks are kept, since {parameter('min_psnr')} is {min_psnr:g} dB: use a higher "
            f"resolution, or more {parameter('memory')}"
        )
        return compiled
    reporter.message(text)
    return compiled.derive(network, stored_color=asdict(error))


def _make_rays(field: RadianceNetwork) -> tuple[Any, Any]:
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


def _render(field: RadianceNetwork, rays: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, float]:
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
    median, high = np.quantile(difference, [0.5, 0.99]).tolist() if both.any() else (0.0, 0.0)
    return CompiledError(voxels.resolution, voxels.size, median, high, _compute_psnr(reference, compiled), speedup)


def _compute_psnr(reference: np.ndarray, compiled: np.ndarray) -> float:
    mse = float(np.mean((reference[:, :3] - compiled[:, :3]) ** 2, dtype=np.float64))
    return float(-10 * np.log10(max(mse, 1e-12)))


# ---- Refinement of the occupancy grid ----


def refine_field(field: RadianceField | FilePath, *, progress: Progress = None) -> RadianceField:
    """Compute a finer occupancy grid of a radiance field, so that it renders with fewer evaluations.

    Training and nerg import compute this grid already; the function is for older files. The weights do not change, and
    gaze fields that were trained in the field accept the new one.

    Parameters
    ----------
    field : RadianceField or path
        Radiance field (.safetensors).
    progress : bool, Reporter or None
        Progress and messages (`nerg_mi.progress.Progress`).

    Returns
    -------
    RadianceField
        The field with the finer grid.

    Raises
    ------
    NergError
        The field has no occupancy grid, or one of nested cubes.

    Examples
    --------
    >>> import nerg_mi as nerg
    >>> from importlib.resources import files
    >>> field = nerg.RadianceField.load(files("nerg_mi.scenes.store") / "store.safetensors")
    >>> fine = nerg.refine_field(field)
    >>> fine.network.occupancy.occupied_fraction < field.network.occupancy.coarse.occupied_fraction
    True
    """
    original = RadianceField.open(field)
    before = original.network.occupancy
    if before is None:
        raise NergError(f'"{original.name}" has no occupancy grid to refine: rays are marched through its whole box')
    with open_reporter(progress) as reporter:
        reporter.progress(0.0, f"refining {original.name}")
        grid = refine_occupancy(original.network)
        if grid is None:
            raise NergError(
                f'the occupancy grid of "{original.name}" consists of nested cubes, which cannot be refined: use the '
                "field as it is"
            )
        reporter.message(
            f"occupied: {100 * grid.occupied_fraction:.2f} % of the box, before "
            f"{100 * before.coarse.occupied_fraction:.2f} %; a random line misses an optical depth of "
            f"{grid.missed_optical_depth:.1e}"
        )
    network = copy.copy(original.network)
    network.occupancy = grid
    return original.derive(network)
