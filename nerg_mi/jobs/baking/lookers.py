"""Who looks: one observer, a path of them, or the people of tracked rays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nerg_mi.alignment.check import read_similarity
from nerg_mi.errors import NergError
from nerg_mi.figures.style import find_colors
from nerg_mi.formats.checkpoint import read_metadata
from nerg_mi.jobs.gaze_places import align_of_training
from nerg_mi.jobs.options.bake import BakeOptions
from nerg_mi.jobs.reporter import Reporter
from nerg_mi.maths.coordinates import check_coordinates
from nerg_mi.maths.geometry import Similarity
from nerg_mi.ranges import VALUES
from nerg_mi.rays.dataset_open import load_rays
from nerg_mi.rays.rays import Rays
from nerg_mi.rays.readers.tables import iterate_table, table_columns
from nerg_mi.surfaces.sources import WEIGHTS, Crowd, TrackedRays, ray_weights, thin

POSITIONS = 1_000_000
"""A path has so many positions at most."""


def read_path(path: Path) -> Crowd:
    """Observers of a CSV file with columns x, y, z, and weight where they do not all count alike. Raises
    `NergError`."""
    names = ("x", "y", "z")
    columns = table_columns(path)
    missing = [name for name in names if name not in columns]
    if missing:
        raise NergError(f'the path "{path}" has no column "{missing[0]}"; it needs x, y, z and may have weight')
    weighted = "weight" in columns
    blocks = [b.numbers for b in iterate_table(path, (*names, "weight") if weighted else names)]
    rows = np.concatenate(blocks) if blocks else np.zeros((0, 3 + weighted))
    if not 0 < len(rows) <= POSITIONS:
        raise NergError(f'the path "{path}" has {len(rows):,} positions; give 1 to {POSITIONS:,}')
    check_coordinates(rows[:, :3], f'the positions of the path "{path}"')
    weights = rows[:, 3] if weighted else np.ones(len(rows))
    if not ((weights >= 0) & (weights <= VALUES.high)).all() or not weights.sum() > 0:
        raise NergError(f'the path "{path}" has weights that are no numbers, negative, or all 0; correct them')
    return Crowd(rows[:, :3], weights / weights.sum())


def rays_of(options: BakeOptions, given: Rays | None) -> Rays | None:
    """The rays that are ``given``, or those that --rays names, or None. Raises `NergError` where there are none in
    it."""
    found = given
    if found is None and options.rays is not None:
        found = load_rays(options.rays, options.most, options.seed)
    if found is not None and not len(found):
        raise NergError("there are no rays in what --rays names; give some")
    return found


def find_crowd(options: BakeOptions, rays: Rays | None, align: Similarity, reporter: Reporter) -> Crowd:
    """The observers of a gaze field, in the place. Raises `NergError` where none, or several kinds, are given."""
    given = [name for name, value in (("--observer", options.observer), ("--path", options.path)) if value is not None]
    if len(given) > 1:
        raise NergError("--observer is one place and --path are many; give one of them")
    if options.observer is not None:
        if len(options.observer) != 3:
            raise NergError(f"--observer is three numbers x,y,z, got {options.observer}")
        return Crowd(np.array([options.observer], np.float64), np.ones(1))
    if options.path is not None:
        return read_path(options.path)
    if rays is None:
        raise NergError("nobody looks: give --observer x,y,z, a --path, or the --rays of people who were there")
    crowd = thin(placed(rays.origin, align), ray_weights(rays, options.weights), options.observers, options.seed)
    reporter.message(
        f"{len(crowd.weights)} observers stand for {len(np.unique(rays.person))} people at {len(rays):,} moments, who "
        f"were {crowd.mean / align.scale:.2f} m away from them (root mean square; 95 % within "
        f"{crowd.farthest / align.scale:.2f} m)"
    )
    return crowd


def tracked_rays(rays: Rays, align: Similarity, by: str) -> TrackedRays:
    """The rays themselves in the place, with weights ``by`` one of `WEIGHTS` that add up to one."""
    directions = rays.direction @ (align.matrix[:3, :3] / align.scale).T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return TrackedRays(placed(rays.origin, align), directions, ray_weights(rays, by))


def placed(points: np.ndarray, align: Similarity) -> np.ndarray:
    """Points (N, 3) of the rays' frame in the place's."""
    return points @ align.matrix[:3, :3].T + align.matrix[:3, 3]


def check_values(options: BakeOptions) -> None:
    """Raise `NergError` for weights, a cone or a scale of colours that are none."""
    if options.weights not in WEIGHTS:
        raise NergError(f'--weights is {", ".join(WEIGHTS)}, got "{options.weights}"')
    find_colors(options.cmap)


def alignment_of(options: BakeOptions) -> Similarity:
    """From the rays to the place: what --align says, or as the gaze field was trained."""
    if options.align is not None:
        return read_similarity(options.align, "--align", "rays to place")
    return (
        Similarity() if options.gaze is None else align_of_training(read_metadata(options.gaze).get("provenance", {}))
    )
