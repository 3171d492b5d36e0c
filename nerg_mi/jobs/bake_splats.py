"""Gaze written back to Gaussian splats: a density for each of them, and colours that show it."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.field.splats import Splats, harmonics_of
from nerg_mi.figures.overlay import Heat, overlay, top_of
from nerg_mi.figures.provenance import provenance
from nerg_mi.files.atomic import check_writable
from nerg_mi.formats.fields import load_gaze
from nerg_mi.formats.splats.files import read_splats
from nerg_mi.formats.splats.ply import write_ply_splats
from nerg_mi.interruption import Interruption
from nerg_mi.maths.color import decode_srgb
from nerg_mi.maths.harmonics import C0
from nerg_mi.rays.rays import Rays
from nerg_mi.surfaces.gaze_source import lookers_of_field
from nerg_mi.surfaces.splats import splat_densities
from nerg_mi.surfaces.target import SURFACE_OPACITY
from nerg_mi.transport.media.splats.arrays import SplatArrays
from nerg_mi.transport.media.splats.medium import SplatMedium
from nerg_mi.transport.observer.gaze import PlacedGaze
from nerg_mi.transport.observer.settings import ObserverSettings
from nerg_mi.transport.place import Place
from nerg_mi.transport.trace import default_settings

from .backend import select_backend
from .baking.lookers import alignment_of, check_values, find_crowd, rays_of
from .options.bake import BakeOptions
from .reporter import SILENT, Reporter

COLUMN = "attention"
"""The column of a file that holds what each Gaussian receives."""

UNIT = "share of gaze per square metre [1/m^2]"

_OF_TRIANGLES = (
    *("shapes", "bundle", "smooth", "detail", "angle", "unit", "halves", "texture", "resolution", "store", "scheduler"),
)


@dataclass(frozen=True, eq=False)
class SplatBake:
    """``splats``: those that were given, in colours of ``attention`` (N,), shares of gaze per square metre, which is
    one of their further columns, too. ``observers`` there were. ``files`` written."""

    splats: Splats
    attention: np.ndarray
    observers: int
    files: tuple[Path, ...] = ()


def bake_splats(
    splats: str | Path,
    outputs: Sequence[str | Path] = (),
    options: BakeOptions | None = None,
    reporter: Reporter = SILENT,
    rays: Rays | None = None,
) -> SplatBake:
    """Write back to the Gaussian splats of a file what each receives of the gaze of ``options``.

    Of one observer, a path of them, or the people of rays, who look with a gaze field. ``outputs``: .ply files, 3DGS
    as any: the given Gaussians and columns, `f_dc_*` in the colours of a heat map over their own, without further
    harmonics, and the column `COLUMN`. ``rays``: in memory, in place of the file in ``options``. Raises `NergError` for
    what the user can mend.
    """
    options, path, start = options or BakeOptions(), Path(splats), time.perf_counter()
    paths = [Path(output) for output in outputs]
    _check(paths, options)
    assert options.gaze is not None
    ns = select_backend(options.mode, options.threads)
    reporter.progress(0.0, "reading")
    given = read_splats(path)
    align = alignment_of(options)
    crowd = find_crowd(options, rays_of(options, rays), align, reporter)
    place = Place(SplatMedium(SplatArrays(given, ns)))
    settings = ObserverSettings(march=default_settings(place), surface_opacity=SURFACE_OPACITY)
    make = lookers_of_field(PlacedGaze(load_gaze(options.gaze, ns)[0]), place, settings)
    found, cone, count = np.zeros(len(given)), math.radians(options.cone or 0.0), len(crowd.weights)
    with Interruption() as stop:
        for k in range(count):
            stop.check()
            who = slice(k, k + 1)
            found += splat_densities(given, place, make, crowd.positions[who], crowd.weights[who], settings, cone)
            reporter.progress(0.05 + 0.85 * (k + 1) / count, f"observer {k + 1} of {count}")
    seen = found > 0
    if not seen.any():
        raise NergError(
            f'nobody who looks sees any of the Gaussians of "{path}"; place them in it by --observer, --path or --align'
        )
    attention = found * align.scale**2
    heat = Heat(options.top or top_of(attention, seen), options.cmap, decades=options.decades)
    inputs = [p for p in (path, options.gaze, options.rays, options.path, options.align) if p is not None]
    about = provenance("nerg bake", inputs, options.seed, options)
    baked = recolored(given, attention, heat)
    reporter.message(
        f"of {len(given):,} Gaussians {seen.sum():,} are looked at by {count:,} "
        f"observer{'' if count == 1 else 's'}; colours end at {heat.top:.3g} / m^2"
    )
    for output in paths:
        write_ply_splats(
            output, baked, (f"{COLUMN}: {UNIT}", f"colours end at {heat.top:.6g}", f"nerg_mi {about.json()}")
        )
        size, seconds = output.stat().st_size / 1e6, time.perf_counter() - start
        reporter.message(f"wrote {output} ({size:.1f} MB, {seconds:.1f} s)")
    return SplatBake(baked, attention, count, tuple(paths))


def recolored(splats: Splats, values: np.ndarray, heat: Heat) -> Splats:
    """``splats`` in colours that are the same from everywhere: ``values`` (N,) as ``heat`` over their own, dimmed; the
    values are their column `COLUMN`."""
    own = decode_srgb(np.clip(0.5 + C0 * splats.harmonics[:, 0].astype(np.float64), 0, 1))
    shown = overlay(own[None], np.asarray(values)[None], heat)[0]
    extra = {**splats.extra, COLUMN: np.asarray(values, np.float32)}
    return replace(splats, harmonics=harmonics_of(shown), extra=extra)


def _check(paths: list[Path], options: BakeOptions) -> None:
    for path in paths:
        check_writable(path, ".ply")
    check_values(options)
    for field in fields(options):
        if field.name in _OF_TRIANGLES and getattr(options, field.name) != field.default:
            name = {"shapes": "shape"}.get(field.name, field.name)
            raise NergError(f"--{name} is of surfaces with triangles; leave it out for Gaussian splats")
    if options.gaze is None or options.source == "rays":
        raise NergError(
            "splats are given the gaze of a field; name one by --gaze, which "
            '"nerg train gaze RAYS --field SPLATS" makes of rays'
        )
    if options.source not in (None, "field"):
        raise NergError(f'--from is field for Gaussian splats, got "{options.source}"')
