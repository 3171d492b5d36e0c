"""Bake gaze onto Gaussian splats."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nerg_mi.environment.gaze import GazeField
from nerg_mi.environment.scene_loading import activate_mitsuba, get_array_module
from nerg_mi.errors import NergError, parameter
from nerg_mi.evaluation.metrics import cc
from nerg_mi.fields.gaze_base import GazeNetwork
from nerg_mi.fields.splats import Splats, harmonics_from_colors
from nerg_mi.figures.overlay import Heat, overlay, robust_max
from nerg_mi.files.atomic import check_writable
from nerg_mi.files.html import Summary
from nerg_mi.files.tables import write_json
from nerg_mi.files.values import FilePath
from nerg_mi.formats.splats import read_splats, write_ply_splats
from nerg_mi.maths.color import decode_srgb
from nerg_mi.maths.sphere import SH_C0
from nerg_mi.progress import Reporter
from nerg_mi.tasks.settings import Parallel
from nerg_mi.transport.geometry import SceneGeometry, default_march_settings
from nerg_mi.transport.observer import ObserverSettings
from nerg_mi.transport.observer_gaze import GazeFieldInstance
from nerg_mi.transport.splat_medium import SplatArrays, SplatMedium

from .bake_parts import UNITS, BakeInputs, Baker, compute_sums, load_alignment, make_gaze_groups, require_gaze
from .laplacian import SurfaceSums, merge_sums
from .settings import BakeColors, BakeSampling
from .sources import MakeObserver, RaySettings, TrackedRays, WeightedObservers, observers_from_field
from .splats import (
    MIN_VISIBLE_FRACTION,
    SplatSmoother,
    compute_splat_areas,
    integrate_gaze,
    shortest_axes,
    splat_densities,
    sum_rays_on_splats,
    unoccluded_areas,
)

COLUMN = "attention"
"""Column of the output file with the gaze per unit area of each Gaussian."""

SUFFIXES = (".ply", ".json")
"""Suffixes of output files."""

_TRIANGLE_SETTINGS = {"max_angle": BakeSampling(), "resolution": BakeSampling(), "texture_size": BakeColors()}


@dataclass(frozen=True, eq=False, repr=False)
class SplatBake(Summary):
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
    comments
        Comments of the .ply file.
    """

    splats: Splats
    attention: np.ndarray
    observers: int
    summary: dict[str, Any]
    comments: tuple[str, ...] = ()

    def save(self, path: FilePath) -> Path:
        """Write a file, and return its path. Raises `NergError` for another suffix.

        A .ply file holds the Gaussians and their columns, with `f_dc_*` set to a heat map over their colours, no higher
        harmonics, and the additional column `COLUMN`. A .json file holds the summary.
        """
        path = Path(path)
        check_writable(path, *SUFFIXES)
        if path.suffix.lower() == ".json":
            write_json(path, self.summary)
        else:
            write_ply_splats(path, self.splats, self.comments)
        return path


def bake_splats(inputs: BakeInputs, changed: Mapping[str, Any], parallel: Parallel, reporter: Reporter) -> SplatBake:
    """Bake gaze onto Gaussian splats; ``changed`` are settings for the provenance. Raises `NergError`."""
    source = _select_source(inputs)
    reporter.progress(0.0, "reading")
    gaussians, name = inputs.surface, "the splats"
    if not isinstance(gaussians, Splats):
        path = Path(inputs.surface)
        gaussians, name = read_splats(path), f'"{path}"'
        for note in (*gaussians.assumptions, *gaussians.notes):
            reporter.message(f"{path}: {note}")
    gaze = inputs.open_gaze()
    align, cone = load_alignment(inputs, gaze, reporter), inputs.cone_radians(source)
    of_rays = RaySettings(cone_sigma=cone, rays_per_cone=inputs.sampling.cone_samples, seed=inputs.seed)
    groups, factor = make_gaze_groups(inputs, source, align, reporter)
    if source == "rays" or gaze is None:
        baker = SplatBaker(gaussians, ray_settings=of_rays)
    else:
        baker = SplatBaker(gaussians, gaze.network, cone, of_rays)
    group_sums = compute_sums(baker, groups, inputs, parallel, reporter)
    sums = merge_sums(group_sums)
    reporter.progress(0.9, "areas of Gaussians")
    spread = _SplatDensity(baker, source, inputs.smooth * align.scale)
    density = spread.density(sums)
    if not (density > 0).any():
        raise NergError(
            f"no observer sees any of the Gaussians of {name}; move the observers with {parameter('observer')}, "
            f"{parameter('observer_file')} or {parameter('align')}"
        )
    attention = factor * density * align.scale**2
    unit = UNITS[inputs.unit].replace("²", "^2")
    summary = _summary(sums, source, unit, factor, attention)
    if len(group_sums) == 2:
        summary["halves_cc"] = float(cc(spread.density(group_sums[0]), spread.density(group_sums[1]), spread.area))
    colors = inputs.colors
    heat = Heat(colors.vmax or robust_max(attention, attention > 0), colors.cmap, decades=colors.log_decades)
    record, summary["provenance"] = inputs.describe_origin(changed)
    baked = recolor_splats(gaussians, attention, heat)
    _report_summary(summary, heat.vmax, reporter)
    comments = (f"{COLUMN}: {unit}", f"colours end at {heat.vmax:.6g}", f"nerg_mi {record.json()}")
    return SplatBake(baked, attention, sums.count, summary, comments)


def recolor_splats(splats: Splats, values: np.ndarray, heat: Heat) -> Splats:
    """Return ``splats`` with view-independent colours: ``values`` (N,) as ``heat`` over their own, dimmed colours.

    The values are also stored in the column `COLUMN`.
    """
    base_color = np.clip(0.5 + SH_C0 * splats.harmonics[:, 0].astype(np.float64), 0, 1)
    base_color = decode_srgb(base_color) if splats.color_space == "srgb" else base_color
    shown = overlay(base_color[None], np.asarray(values)[None], heat)[0]
    extra = {**splats.extra, COLUMN: np.asarray(values, np.float32)}
    return replace(splats, harmonics=harmonics_from_colors(shown), extra=extra, color_space="srgb")


@dataclass(frozen=True, eq=False)
class SplatBaker(Baker):
    """Sums the gaze on Gaussian splats.

    For rays, ``face_sums`` holds shares of gaze on both sides of the Gaussians. For observers it holds densities, which
    are not part of ``total``.

    Attributes
    ----------
    splats
        The Gaussians.
    gaze
        Gaze field, or None.
    cone
        Standard deviation of the gaze cone of a field in radians.
    """

    splats: Splats
    gaze: GazeNetwork | None = None
    cone: float = 0.0
    ray_settings: RaySettings = field(default_factory=RaySettings)

    @property
    def empty_sums(self) -> SurfaceSums:
        return SurfaceSums.zeros(2 * len(self.splats), 0)

    def sums(self, part: WeightedObservers | TrackedRays) -> SurfaceSums:
        if isinstance(part, TrackedRays):
            return sum_rays_on_splats(self.arrays, self.axes, part, self.ray_settings)
        make, sums = self.make_observer, self.empty_sums
        for k, weight in enumerate(part.weights.tolist()):
            eye = part.positions[k : k + 1]
            # The observer is used twice.
            observer = make(eye[0])
            densities = splat_densities(
                self.splats,
                self.geometry,
                lambda _, bound=observer: bound,
                eye,
                np.array([weight]),
                self.settings,
                self.cone,
            )
            total, escaped = integrate_gaze(self.arrays, observer, eye[0], self.cone)
            sums = sums.add(
                SurfaceSums(densities.ravel(), np.zeros(0), 0.0, weight * escaped, weight * total, weight, 1)
            )
        return sums

    @cached_property
    def make_observer(self) -> MakeObserver:
        """Makes observers of the gaze field."""
        return observers_from_field(require_gaze(self.observed[1]), self.geometry, self.settings)

    @cached_property
    def arrays(self) -> SplatArrays:
        """The Gaussians in the active variant."""
        return SplatArrays(self.splats, get_array_module())

    @cached_property
    def geometry(self) -> SceneGeometry:
        """The Gaussians as they are traced."""
        return SceneGeometry(SplatMedium(self.arrays))

    @cached_property
    def settings(self) -> ObserverSettings:
        """How rays are traced."""
        return ObserverSettings(march=default_march_settings(self.geometry))

    @cached_property
    def axes(self) -> np.ndarray:
        """Shortest axes (N, 3) of the Gaussians."""
        return shortest_axes(self.splats)

    @property
    def tolerance(self) -> float:
        """Distance within which two estimates of a surface agree, see `ObserverSettings.tolerance`."""
        return 2 * self.settings.march.step

    @cached_property
    def observed(self) -> tuple[SceneGeometry, GazeFieldInstance | None]:
        return self.geometry, None if self.gaze is None else GazeFieldInstance(self.gaze)

    def plan(self, inputs: BakeInputs, folder: Path) -> PlannedSplatBake:
        path = inputs.surface
        if not isinstance(path, (str, os.PathLike)):
            path = folder / "splats.ply"
            write_ply_splats(path, self.splats)
        mode = str(activate_mitsuba().variant())
        return PlannedSplatBake(Path(path), self.plan_gaze(inputs, folder), self.cone, self.ray_settings, mode)


@dataclass(frozen=True)
class PlannedSplatBake:
    """Inputs that all parts share: those of a `SplatBaker`, with files."""

    splats: Path
    gaze: Path | None
    cone: float
    ray_settings: RaySettings
    mode: str

    def open(self) -> SplatBaker:
        """Load the files."""
        gaze = None if self.gaze is None else GazeField.load(self.gaze).network
        return SplatBaker(read_splats(self.splats), gaze, self.cone, self.ray_settings)


class _SplatDensity:
    """Converts sums of a ``source`` to densities on Gaussians, smoothed by ``length`` scene units if it is not 0.

    ``area`` (N,) is the area of both sides of each Gaussian.
    """

    def __init__(self, baker: SplatBaker, source: str, length: float):
        self._source, self._smoother = source, None
        if source == "field" and length == 0:
            return
        splats, arrays, tolerance = baker.splats, baker.arrays, baker.tolerance
        self._areas = compute_splat_areas(splats, arrays, tolerance)
        self.area = self._areas.sum(axis=0)
        min_area = MIN_VISIBLE_FRACTION * unoccluded_areas(splats, arrays.extent)
        # A side that is nearly hidden would get an arbitrary density from its small area.
        self._divisor = np.maximum(self._areas, min_area)
        if length > 0:
            self._smoother = SplatSmoother(splats.centers, baker.axes, self._areas, min_area, length, tolerance)

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


def _select_source(inputs: BakeInputs) -> str:
    """Return the source of the gaze. Raises `NergError` for arguments that splats do not have."""
    wrong = [name for name in ("shapes", "max_edge") if getattr(inputs, name)]
    for name, default in _TRIANGLE_SETTINGS.items():
        settings = inputs.colors if isinstance(default, BakeColors) else inputs.sampling
        wrong += [name] if getattr(settings, name) != getattr(default, name) else []
    if wrong:
        raise NergError(f"{parameter(wrong[0])} does not apply to Gaussian splats; leave it out")
    source = inputs.select_source()
    if source == "field" and inputs.gaze is None:
        raise NergError(
            f'no gaze field is given: add {parameter("gaze", "FILE")} ("nerg train gaze RAYS --environment SPLATS" '
            f"trains one), or use the recorded gaze with {parameter('source', 'rays')}"
        )
    return source
