"""Values of depth maps that are no surface: the background of renderers and simulators."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np

from .cameras import PosedCamera, pixel_directions
from .images import PhotoView

# Values above a gap in the distribution of all depths are no surface. Gap: ratio of two successive depths. Such values
# are also farther than a multiple of the extent of the cameras, unless the gap is large.
_GAP, _CAMERA_EXTENTS, _LARGE_GAP = 10.0, 100.0, 1e3
# Minimum fraction of the depths below the gap.
_MIN_SURFACE_FRACTION = 0.01
# Maximum number of depths per view from which the gap is found.
_SAMPLES = 20_000
# A maximum is repeated if more pixels than this fraction of a view have it, to rounding error, and more than have other
# depths within a hundredth of it.
_MIN_REPEATED_FRACTION, _ROUNDING, _NEARBY = 1e-3, 1e-5, 1e-2
# A repeated maximum is no surface, also in one view only, if all other depths are below this fraction of it: surfaces
# that continue to a wall have depths in between.
_MAX_OTHER = 0.5
# Errors of camera positions as a fraction of the extent of the cameras.
_POSE_ERROR = 0.05
# Maximum number of views that are compared for a repeated maximum.
_COMPARED_VIEWS = 64


@dataclass(frozen=True)
class DepthBackground:
    """Pixels of depth maps without a surface.

    Attributes
    ----------
    fraction
        Fraction of the pixels of all depth maps with a value that is no surface.
    unknown_fraction
        Fraction of the pixels without a value.
    nearest
        Smallest such value in scene units.
    """

    fraction: float
    unknown_fraction: float
    nearest: float

    def __str__(self) -> str:
        parts = []
        if self.fraction:
            parts.append(f"{self.fraction:.1%} are background and no surface (depths from {self.nearest:.4g} units on)")
        if self.unknown_fraction:
            parts.append(f"{self.unknown_fraction:.1%} have no value")
        return f"pixels of the depth maps: {', '.join(parts)}"


def remove_background(views: Sequence[PhotoView]) -> tuple[list[PhotoView], DepthBackground | None]:
    """Set depths that are no surface to 0, which means unknown.

    These are depths far beyond the extent of the cameras and all other depths, such as 1e10, and the far plane of a
    renderer: a maximum that is repeated exactly, in views in which it cannot be one surface, or far beyond all other
    depths. Returns the views, and
    which fraction has no surface; None if all pixels have one, and without depth maps.
    """
    index = [k for k, view in enumerate(views) if view.depth is not None]
    cameras, depths = [views[k].camera for k in index], [np.asarray(views[k].depth) for k in index]
    unknown, removed, nearest = sum(d.size - np.count_nonzero(d) for d in depths), 0, np.inf
    while (masks := _find_background(cameras, depths)) is not None:
        for k, mask in masks.items():
            removed, nearest = removed + np.count_nonzero(mask), min(nearest, float(depths[k][mask].min()))
            depths[k] = np.where(mask, 0, depths[k])
    if not (removed or unknown):
        return list(views), None
    changed = {k: replace(views[k], depth=depth) for k, depth in zip(index, depths)}
    size = sum(d.size for d in depths)
    return [changed.get(k, view) for k, view in enumerate(views)], DepthBackground(
        removed / size, unknown / size, nearest
    )


def _find_background(cameras: list[PosedCamera], depths: list[np.ndarray]) -> dict[int, np.ndarray] | None:
    """Return masks (h, w) of pixels that are no surface by number of the view; None if there are none."""
    limit = _find_gap(cameras, depths)
    masks = {k: d >= limit for k, d in enumerate(depths) if d.max(initial=0) >= limit}
    masks = masks or _find_far_plane(cameras, depths)
    # If all depths are equal, none of them is the background of the others.
    count, total = sum(map(np.count_nonzero, masks.values())), sum(map(np.count_nonzero, depths))
    return masks if 0 < count <= (1 - _MIN_SURFACE_FRACTION) * total else None


def measure_far_plane(cameras: list[PosedCamera], depths: list[np.ndarray]) -> DepthBackground | None:
    """Return which fraction of depth maps has a maximum that is no surface, however few pixels show one; None if the
    maximum is a surface."""
    masks, size = _find_far_plane(cameras, depths), sum(d.size for d in depths)
    if not masks:
        return None
    removed, finite = (sum(map(np.count_nonzero, arrays)) for arrays in (masks.values(), depths))
    return DepthBackground(removed / size, 1 - finite / size, min(float(depths[k][m].min()) for k, m in masks.items()))


def _find_far_plane(cameras: list[PosedCamera], depths: list[np.ndarray]) -> dict[int, np.ndarray]:
    """Return the masks of a repeated maximum that is no surface, by distance across the image or along the rays."""
    ahead = cache(lambda intrinsics: -pixel_directions(intrinsics)[..., 2].astype(np.float32))
    masks = _find_repeated_maximum(cameras, depths, lambda k: depths[k] * ahead(cameras[k].intrinsics), _is_plane)
    return masks or _find_repeated_maximum(cameras, depths, lambda k: depths[k], _is_sphere)


def _find_gap(cameras: list[PosedCamera], depths: list[np.ndarray]) -> float:
    """Return the smallest depth above a gap in the distribution of all depths; infinite if there is none."""
    pooled = [d[d > 0][:: max(1, d.size // _SAMPLES)] for d in depths]
    values = np.sort(np.concatenate([np.zeros(0), *pooled]))
    first = int(np.ceil(_MIN_SURFACE_FRACTION * len(values)))
    if first < 1 or first >= len(values):
        return np.inf
    lower, upper = values[first - 1 : -1], values[first:]
    extent = _measure_extent(cameras)
    is_far = (upper > _CAMERA_EXTENTS * extent) & (extent > 0)
    gaps = np.flatnonzero(((upper >= _GAP * lower) & is_far) | (upper >= _LARGE_GAP * lower))
    # A depth between the sampled ones is background, too, as at the edge of an object.
    return float(_GAP * lower[gaps[0]]) if len(gaps) else np.inf


def _find_repeated_maximum(
    cameras: list[PosedCamera],
    depths: list[np.ndarray],
    measure: Callable[[int], np.ndarray],
    is_surface: Callable[[PosedCamera, PosedCamera, float, float], bool],
) -> dict[int, np.ndarray]:
    """Return the masks of the pixels with the largest ``measure`` of all views, if two views or the other depths
    exclude that it is a surface.

    ``measure`` returns the distance (h, w) of a kind in a view, and ``is_surface`` whether pixels of two cameras with
    one distance of this kind may show the same surface, up to a tolerance.
    """
    largest = [float(measure(k).max(initial=0)) for k in range(len(depths))]
    limit = max(largest, default=0.0) * (1 - _ROUNDING)
    masks, repeated, below = {}, [], 0.0
    for k in np.flatnonzero(np.array(largest) >= limit).tolist() if limit > 0 else []:
        values = measure(k)
        masks[k] = values >= limit
        below = max(below, float(values[~masks[k]].max(initial=0)))
        count, nearby = np.count_nonzero(masks[k]), np.count_nonzero(values >= (1 - _NEARBY) * limit)
        if count > max(1, _MIN_REPEATED_FRACTION * values.size) and 2 * count > nearby:
            repeated.append(cameras[k])
    others = [m for m in largest if m < limit]
    if repeated and 0 < max(below, *others, 0.0) < _MAX_OTHER * limit:
        return masks
    pairs = combinations(repeated[:_COMPARED_VIEWS], 2)
    # Errors of poses are a part of the extent of the cameras, also for surfaces far beyond it.
    tolerance = min(_NEARBY * limit, _POSE_ERROR * _measure_extent(cameras))
    return masks if not all(is_surface(a, b, limit, tolerance) for a, b in pairs) else {}


def _measure_extent(cameras: list[PosedCamera]) -> float:
    """Return the diagonal of the box of the cameras, 0 without any."""
    return float(np.linalg.norm(np.ptp([c.center for c in cameras], axis=0))) if cameras else 0.0


def _is_plane(a: PosedCamera, b: PosedCamera, depth: float, tolerance: float) -> bool:
    """Return whether planes at ``depth`` across the axes of two cameras may be one wall, or two of a square room."""
    cosine = float(a.axis @ b.axis)
    if cosine > 0.9999:
        return abs(float((b.center - a.center) @ a.axis)) <= tolerance
    return abs(cosine) < 0.01 or cosine < -0.9999


def _is_sphere(a: PosedCamera, b: PosedCamera, depth: float, tolerance: float) -> bool:
    """Return whether spheres of radius ``depth`` around two cameras may be one."""
    return float(np.linalg.norm(a.center - b.center)) <= tolerance
