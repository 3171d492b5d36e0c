"""Attention on Gaussian splats, in chunks and tasks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.evaluation.metrics import cc
from nerg_mi.fields.splats import Splats, harmonics_from_colors
from nerg_mi.figures.overlay import Heat, overlay, robust_max
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.tables import write_json
from nerg_mi.formats.splats import read_splats, write_ply_splats
from nerg_mi.maths.color import decode_srgb
from nerg_mi.maths.sphere import SH_C0
from nerg_mi.rays.rays import Rays
from nerg_mi.surfaces.laplacian import SurfaceSums, merge_sums
from nerg_mi.surfaces.sources import RaySettings
from nerg_mi.surfaces.splats import MIN_VISIBLE_FRACTION, SplatSmoother, compute_splat_areas, unoccluded_areas

from .bake_chunks import (
    UNITS,
    SplatGeometry,
    SplatScene,
    load_alignment,
    check_values,
    cone_radians,
    describe_origin,
    select_source,
    make_splat_geometry,
    compute_sums,
    make_gaze_groups,
)
from .base import SILENT, Reporter, select_backend
from .scene_commands import BakeOptions

COLUMN = "attention"
"""The column of a file that holds what each Gaussian receives."""

SUFFIXES = (".ply", ".json")
"""Files that are written."""

_OF_TRIANGLES = ("shapes", "detail", "angle", "texture", "resolution")


@dataclass(frozen=True, eq=False)
class SplatBake:
    """``splats``: those that were given, in colours of ``attention`` (N,), gaze per square metre, which is one of their
    further columns, too. ``observers``: how many there were, or rays. ``summary``: all that was found, as the JSON file
    has it, with what gaze adds up to, ``total``, and how much of it meets no Gaussian, ``escaped``; of rays also
    ``on_splats`` and ``unaccounted``. ``files`` written."""

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
    """Put the gaze of ``options`` on the Gaussian splats of a file: of one observer, a path of them, or the people of
    rays, who look with a gaze field; or of the rays themselves.

    ``outputs``: files to write, by their suffixes. .ply: 3DGS as any: the given Gaussians and columns, `f_dc_*` in the
    colours of a heat map over their own, without further harmonics, and the column `COLUMN`; .json: the summary.
    ``rays``: in memory, in place of the file in ``options``. With ``options.store`` or ``options.scheduler`` some
    observers, or rays, at a time are a part, as of `bake.bake`. Raises `NergError` for what the user can mend.
    """
    options, path, start = options or BakeOptions(), Path(splats), time.perf_counter()
    paths = [Path(output) for output in outputs]
    source = _check(paths, options, rays)
    select_backend(options.mode, options.threads)
    reporter.progress(0.0, "reading")
    given = read_splats(path)
    for note in (*given.assumptions, *given.notes):
        reporter.message(f"of {path}: {note}")
    align, cone = load_alignment(options), cone_radians(options, source)
    of_rays = RaySettings(cone_sigma=cone, rays_per_cone=options.cone_samples, seed=options.seed)
    groups, factor = make_gaze_groups(options, source, rays, align, reporter)
    if source == "rays":
        scene = SplatScene(path, len(given), ray_settings=of_rays)
    else:
        scene = SplatScene(path, len(given), options.gaze, cone, of_rays)
    found = compute_sums(scene, groups, options, paths[0] if paths else path, reporter)
    sums = merge_sums(found)
    reporter.progress(0.9, "areas of Gaussians")
    spread = _SplatSpread(make_splat_geometry(given), source, options.smooth * align.scale)
    density = spread.density(sums)
    if not (density > 0).any():
        raise NergError(
            f'nobody who looks sees any of the Gaussians of "{path}"; place them in it by --observer, --path or --align'
        )
    attention = factor * density * align.scale**2
    unit = UNITS[options.unit].replace("²", "^2")
    summary = _summary(sums, source, unit, factor, attention)
    if len(found) == 2:
        summary["halves_cc"] = float(cc(spread.density(found[0]), spread.density(found[1]), spread.area))
    heat = Heat(options.vmax or robust_max(attention, attention > 0), options.cmap, decades=options.log_decades)
    about, summary["provenance"] = describe_origin(path, options)
    baked = recolor_splats(given, attention, heat)
    _tell(summary, heat.vmax, reporter)
    comments = (f"{COLUMN}: {unit}", f"colours end at {heat.vmax:.6g}", f"nerg_mi {about.json()}")
    for output in paths:
        if output.suffix.lower() == ".json":
            write_json(output, summary)
        else:
            write_ply_splats(output, baked, comments)
        size, seconds = output.stat().st_size / 1e6, time.perf_counter() - start
        reporter.message(f"wrote {output} ({size:.1f} MB, {seconds:.1f} s)")
    return SplatBake(baked, attention, sums.count, summary, tuple(paths))


def recolor_splats(splats: Splats, values: np.ndarray, heat: Heat) -> Splats:
    """``splats`` in colours that are the same from everywhere: ``values`` (N,) as ``heat`` over their own, dimmed; the
    values are their column `COLUMN`."""
    own = np.clip(0.5 + SH_C0 * splats.harmonics[:, 0].astype(np.float64), 0, 1)
    own = decode_srgb(own) if splats.color_space == "srgb" else own
    shown = overlay(own[None], np.asarray(values)[None], heat)[0]
    extra = {**splats.extra, COLUMN: np.asarray(values, np.float32)}
    return replace(splats, harmonics=harmonics_from_colors(shown), extra=extra, color_space="srgb")


class _SplatSpread:
    """From sums of a ``source`` to densities of the Gaussians of ``there``, smoothed by ``length`` scene units, or not
    if that is 0. ``area`` (N,): of both sides of each."""

    def __init__(self, there: SplatGeometry, source: str, length: float):
        self._source, self._smoother = source, None
        if source == "field" and length == 0:
            return
        self._areas = compute_splat_areas(there.splats, there.arrays, there.tolerance)
        self.area, least = self._areas.sum(axis=0), MIN_VISIBLE_FRACTION * unoccluded_areas(there.splats, there.arrays.extent)
        # A side that hardly anything is seen of has a share, which by its area would be any density.
        self._divisor = np.maximum(self._areas, least)
        if length > 0:
            self._smoother = SplatSmoother(
                there.splats.centers, there.axes, self._areas, least, length, there.tolerance
            )

    def density(self, sums: SurfaceSums) -> np.ndarray:
        """Gaze (N,) per square scene unit, as a share of all."""
        found = sums.face_sums.reshape(2, -1) / sums.weight
        if self._source == "field":
            if self._smoother is None:
                return found.sum(axis=0)
            found = found * self._areas
        if self._smoother is not None:
            found = self._smoother(found)
        # What is wholly transparent receives nothing.
        return (found / np.where(self._divisor > 0, self._divisor, 1)).sum(axis=0)


def _summary(sums: SurfaceSums, source: str, unit: str, factor: float, attention: np.ndarray) -> dict[str, Any]:
    found = {"source": source, "unit": unit, "factor": factor, "lookers": sums.count, "gaussians": len(attention)}
    found["looked_at"] = int((attention > 0).sum())
    w = sums.weight
    found |= {"total": sums.total / w, "escaped": sums.escaped / w}
    if source == "rays":
        found |= {"on_splats": sums.on_surface / w, "unaccounted": sums.unaccounted / w}
    return found


def _tell(summary: dict[str, Any], top: float, reporter: Reporter) -> None:
    count, kind = summary["lookers"], "ray" if summary["source"] == "rays" else "observer"
    reporter.message(
        f"of {summary['gaussians']:,} Gaussians {summary['looked_at']:,} are looked at by {count:,} "
        f"{kind}{'' if count == 1 else 's'}; colours end at {top:.3g} "
        f"{'1 / m^2' if summary['unit'].endswith('[1/m^2]') else 's / m^2'}"
    )
    if summary["source"] == "rays":
        reporter.message(
            f"of their gaze {summary['on_splats']:.2%} lies on Gaussians, and {summary['escaped']:.2%} meets none; "
            f"{abs(summary['unaccounted']):.1e} is unaccounted for"
        )
    else:
        reporter.message(
            f"of each one's gaze, {summary['total']:.3f} in all, {summary['escaped']:.2%} meets no Gaussian"
        )
    if "halves_cc" in summary:
        reporter.message(f"two halves of the people agree by CC {summary['halves_cc']:.3f}")


def _check(paths: list[Path], options: BakeOptions, rays: Rays | None) -> str:
    for path in paths:
        check_writable(path, *SUFFIXES)
    check_values(options)
    for entry in fields(options):
        if entry.name in _OF_TRIANGLES and getattr(options, entry.name) != entry.default:
            name = {"shapes": "shape"}.get(entry.name, entry.name)
            raise NergError(f"--{name} is of surfaces with triangles; leave it out for Gaussian splats")
    source = select_source(options, rays)
    if source == "field" and options.gaze is None:
        raise NergError(
            "splats have no gaze of their own; name a field by --gaze, which "
            '"nerg train gaze RAYS --field SPLATS" makes of rays, or take the gaze of the rays, --from rays'
        )
    return source
