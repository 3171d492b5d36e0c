"""Bake gaze onto Gaussian splats."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.evaluation.metrics import cc
from nerg_mi.fields.splats import Splats, harmonics_from_colors
from nerg_mi.figures.overlay import Heat, overlay, robust_max
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.tables import write_json
from nerg_mi.formats.splats import read_splats, write_ply_splats
from nerg_mi.maths.color import decode_srgb
from nerg_mi.maths.sphere import SH_C0
from nerg_mi.progress import SILENT, Reporter
from nerg_mi.rays.rays import Rays
from nerg_mi.surfaces.laplacian import SurfaceSums, merge_sums
from nerg_mi.surfaces.sources import RaySettings
from nerg_mi.surfaces.splats import MIN_VISIBLE_FRACTION, SplatSmoother, compute_splat_areas, unoccluded_areas

from .bake_chunks import (
    UNITS,
    SplatGeometry,
    SplatScene,
    check_values,
    compute_sums,
    cone_radians,
    describe_origin,
    load_alignment,
    make_gaze_groups,
    make_splat_geometry,
    select_source,
)
from .base import select_backend
from .scene_commands import BakeOptions

COLUMN = "attention"
"""Column of the output file with the gaze per unit area of each Gaussian."""

SUFFIXES = (".ply", ".json")
"""Suffixes of output files."""

_TRIANGLE_OPTIONS = ("shapes", "max_edge", "max_angle", "texture_size", "resolution")


@dataclass(frozen=True, eq=False)
class SplatBake:
    """Result of a bake of Gaussian splats.

    Attributes
    ----------
    splats
        The Gaussians, coloured by ``attention``, which is also an additional column.
    attention
        Gaze per square metre (N,).
    observers
        Number of observers or rays.
    summary
        Content of the JSON file: among others ``total``, the integral of the gaze, and ``escaped``, the share that hits
        no Gaussian; for rays also ``on_splats`` and ``unaccounted``.
    files
        Written files.
    """

    splats: Splats
    attention: np.ndarray
    observers: int
    summary: dict[str, Any]
    files: tuple[Path, ...] = ()


def bake_splats(
    splats: str | Path,
    outputs: Sequence[str | Path] = (),
    options: BakeOptions | None = None,
    reporter: Reporter = SILENT,
    rays: Rays | None = None,
) -> SplatBake:
    """Bake the gaze of ``options`` onto Gaussian splats.

    Parameters
    ----------
    splats
        File of the Gaussians.
    outputs
        Files to write. A .ply file holds the Gaussians and their columns, with `f_dc_*` set to a heat map over their
        colours, no higher harmonics, and the additional column `COLUMN`. A .json file holds the summary.
    options
        Source of the gaze, sampling and colours. With ``options.store`` or ``options.scheduler`` parts are stored, as
        in `bake.bake`.
    reporter
        Receives messages and progress.
    rays
        Rays in memory, in place of the file in ``options``.

    Raises
    ------
    NergError
        For errors that the user can correct.
    """
    options, path, start = options or BakeOptions(), Path(splats), time.perf_counter()
    paths = [Path(output) for output in outputs]
    source = _check(paths, options, rays)
    select_backend(options.mode, options.threads)
    reporter.progress(0.0, "reading")
    gaussians = read_splats(path)
    for note in (*gaussians.assumptions, *gaussians.notes):
        reporter.message(f"{path}: {note}")
    align, cone = load_alignment(options, reporter), cone_radians(options, source)
    of_rays = RaySettings(cone_sigma=cone, rays_per_cone=options.cone_samples, seed=options.seed)
    groups, factor = make_gaze_groups(options, source, rays, align, reporter)
    if source == "rays":
        scene = SplatScene(path, len(gaussians), ray_settings=of_rays)
    else:
        scene = SplatScene(path, len(gaussians), options.gaze, cone, of_rays)
    group_sums = compute_sums(scene, groups, options, paths[0] if paths else path, reporter)
    sums = merge_sums(group_sums)
    reporter.progress(0.9, "areas of Gaussians")
    spread = _SplatDensity(make_splat_geometry(gaussians), source, options.smooth * align.scale)
    density = spread.density(sums)
    if not (density > 0).any():
        raise NergError(
            f'no observer sees any of the Gaussians of "{path}"; move the observers with {parameter("observer")}, '
            f"{parameter('observer_file')} or {parameter('align')}"
        )
    attention = factor * density * align.scale**2
    unit = UNITS[options.unit].replace("²", "^2")
    summary = _summary(sums, source, unit, factor, attention)
    if len(group_sums) == 2:
        summary["halves_cc"] = float(cc(spread.density(group_sums[0]), spread.density(group_sums[1]), spread.area))
    heat = Heat(options.vmax or robust_max(attention, attention > 0), options.cmap, decades=options.log_decades)
    record, summary["provenance"] = describe_origin(path, options)
    baked = recolor_splats(gaussians, attention, heat)
    _report_summary(summary, heat.vmax, reporter)
    comments = (f"{COLUMN}: {unit}", f"colours end at {heat.vmax:.6g}", f"nerg_mi {record.json()}")
    for output in paths:
        if output.suffix.lower() == ".json":
            write_json(output, summary)
        else:
            write_ply_splats(output, baked, comments)
        size, seconds = output.stat().st_size / 1e6, time.perf_counter() - start
        reporter.message(f"wrote {output} ({size:.1f} MB, {seconds:.1f} s)")
    return SplatBake(baked, attention, sums.count, summary, tuple(paths))


def recolor_splats(splats: Splats, values: np.ndarray, heat: Heat) -> Splats:
    """Return ``splats`` with view-independent colours: ``values`` (N,) as ``heat`` over their own, dimmed colours.

    The values are also stored in the column `COLUMN`.
    """
    base_color = np.clip(0.5 + SH_C0 * splats.harmonics[:, 0].astype(np.float64), 0, 1)
    base_color = decode_srgb(base_color) if splats.color_space == "srgb" else base_color
    shown = overlay(base_color[None], np.asarray(values)[None], heat)[0]
    extra = {**splats.extra, COLUMN: np.asarray(values, np.float32)}
    return replace(splats, harmonics=harmonics_from_colors(shown), extra=extra, color_space="srgb")


class _SplatDensity:
    """Converts sums of a ``source`` to densities on Gaussians, smoothed by ``length`` scene units if it is not 0.

    ``area`` (N,) is the area of both sides of each Gaussian.
    """

    def __init__(self, geometry: SplatGeometry, source: str, length: float):
        self._source, self._smoother = source, None
        if source == "field" and length == 0:
            return
        self._areas = compute_splat_areas(geometry.splats, geometry.arrays, geometry.tolerance)
        self.area, min_area = (
            self._areas.sum(axis=0),
            MIN_VISIBLE_FRACTION * unoccluded_areas(geometry.splats, geometry.arrays.extent),
        )
        # A side that is nearly hidden would get an arbitrary density from its small area.
        self._divisor = np.maximum(self._areas, min_area)
        if length > 0:
            self._smoother = SplatSmoother(
                geometry.splats.centers, geometry.axes, self._areas, min_area, length, geometry.tolerance
            )

    def density(self, sums: SurfaceSums) -> np.ndarray:
        """Return the gaze density (N,) per square scene unit, as a share of all gaze."""
        shares = sums.face_sums.reshape(2, -1) / sums.weight
        if self._source == "field":
            if self._smoother is None:
                return shares.sum(axis=0)
            shares = shares * self._areas
        if self._smoother is not None:
            shares = self._smoother(shares)
        # A transparent Gaussian receives nothing.
        return (shares / np.where(self._divisor > 0, self._divisor, 1)).sum(axis=0)


def _summary(sums: SurfaceSums, source: str, unit: str, factor: float, attention: np.ndarray) -> dict[str, Any]:
    summary = {"source": source, "unit": unit, "factor": factor, "lookers": sums.count, "gaussians": len(attention)}
    summary["looked_at"] = int((attention > 0).sum())
    w = sums.weight
    summary |= {"total": sums.total / w, "escaped": sums.escaped / w}
    if source == "rays":
        summary |= {"on_splats": sums.on_surface / w, "unaccounted": sums.unaccounted / w}
    return summary


def _report_summary(summary: dict[str, Any], top: float, reporter: Reporter) -> None:
    count, kind = summary["lookers"], "ray" if summary["source"] == "rays" else "observer"
    reporter.message(
        f"{summary['looked_at']:,} of {summary['gaussians']:,} Gaussians receive gaze from {count:,} "
        f"{kind}{'' if count == 1 else 's'}; colours end at {top:.3g} "
        f"{'1 / m^2' if summary['unit'].endswith('[1/m^2]') else 's / m^2'}"
    )
    if summary["source"] == "rays":
        reporter.message(
            f"{summary['on_splats']:.2%} of the gaze is on Gaussians, {summary['escaped']:.2%} hits none; "
            f"{abs(summary['unaccounted']):.1e} unaccounted for"
        )
    else:
        reporter.message(
            f"the gaze integrates to {summary['total']:.3f}, of which {summary['escaped']:.2%} hits no Gaussian"
        )
    if "halves_cc" in summary:
        reporter.message(f"agreement between two halves of the participants: CC {summary['halves_cc']:.3f}")


def _check(paths: list[Path], options: BakeOptions, rays: Rays | None) -> str:
    for path in paths:
        check_writable(path, *SUFFIXES)
    check_values(options)
    for entry in fields(options):
        if entry.name in _TRIANGLE_OPTIONS and getattr(options, entry.name) != entry.default:
            raise NergError(f"{parameter(entry.name)} does not apply to Gaussian splats; leave it out")
    source = select_source(options, rays)
    if source == "field" and options.gaze is None:
        raise NergError(
            f'no gaze field is given: add {parameter("gaze", "FILE")} ("nerg train gaze RAYS --field SPLATS" '
            f"trains one), or use the recorded gaze with {parameter('source', 'rays')}"
        )
    return source
