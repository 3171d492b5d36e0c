"""Preparation of a posed image set for training: training views, held-out views and the bounding box of the scene.

Coordinates: a field keeps those of the file; nothing is centred, rotated or scaled without an option. The up
direction is estimated from how cameras are held and, with points, from a floor or table. ``--coordinates upright``
rotates the environment about its origin to +z up; ``original`` undoes nerfstudio's ``applied_transform`` and
``applied_scale``; the path of a ``dataparser_transforms.json`` uses the coordinates that nerfstudio trained in.
``--scale`` then multiplies all lengths. ``to_file`` in the checkpoint's provenance leads back.

Box: the first of ``--aabb``; ``aabb`` of the file; COLMAP's points or, if every frame has depth, its points, without
outliers and extended to the cameras; the cameras. Cameras that look at a common point bound the box around it; other
cameras are inside. A guess from cameras alone in a room in which they hardly move is too small: set ``--aabb``.

Unbounded environments: if more than 2 % of the points lie beyond that box, or a box two fifths as large would hold
nine tenths of them, the environment is unbounded. Its core, a box that holds nine tenths of the points, is resolved
as a box would be. Around it, out to 64 times its edge, positions are contracted before encoding (mip-NeRF 360,
equation 10, by the largest coordinate). Rays stay straight, and depths, positions, visibility and gaze are in scene
units. Steps are at least 1/128 of their distance from the ray's start (``dt_gamma``). Images with alpha, a declared
box, and sets without points are bounded. ``--unbounded`` and ``--bounded`` override this. Exported volumes, points
and meshes cover the box only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nerg_mi.errors import NergError, parameter
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.files.values import FilePath
from nerg_mi.maths.geometry import AnyBox, Box, ContractedBox, intersect_box_numpy
from nerg_mi.ranges import MAX_COORDINATE

from . import cameras
from .background import measure_far_plane, remove_background
from .cameras import PosedCamera, pixel_directions, project
from .colmap import UpEstimate
from .images import PhotoView, estimate_photo_up, load_usable_views, read_split
from .photo_set import Photos
from .posed import UnusedFrame

# ---- Bounding box of a scene ----
#
# The box is estimated from surface points or from the cameras alone, and the scene is classified as bounded or
# unbounded. Depth is checked against the cameras.


MAX_CONVERGENCE_ANGLE = float(np.radians(30))
"""Cameras look at a common point if the median angle between their axes and the point is below this."""

# Minimum number of points for an estimate, and the fraction of outliers at either end of an axis.
_MIN_POINTS, _OUTLIER_FRACTION = 100, 0.005
# Points within this fraction of the longest edge outside of the outlier-free box still count, because plain surfaces
# have few points, except for this fraction at either end of an axis.
_NEAR_MARGIN, _MIN_TAIL_FRACTION = 0.5, 0.0005
# Margin around the points, relative to their longest edge.
_MARGIN = 0.05

# Maximum fraction of points outside of the box that are considered strays; more points belong to the scene.
_MAX_STRAY_FRACTION = 0.02
# Fraction of the points in the core of an unbounded scene, the maximum size of the core relative to the box of the
# cameras, and the minimum size of the box of all points relative to the core.
_CORE_FRACTION, _MAX_CORE_GROWTH, _MIN_CORE_SHRINKAGE = 0.9, 4.0, 2.5
# Minimum median distance of cameras that are placed around a point from their mean, relative to that from the point.
_MIN_CAMERA_SPREAD = 0.25
# Maximum growth of the box of the points when the cameras are included.
_MAX_CAMERA_GROWTH = 2.0
# Maximum median depth relative to the extent of the cameras.
_MAX_DEPTH_RATIO = 100
# Factors of common unit errors: millimetres, centimetres, fifths of a millimetre.
_UNIT_FACTORS = (1e-3, 1e-2, 0.1, 0.2, 5.0, 10.0, 100.0, 1e3)
# Number of compared views, and points per view.
_COMPARED_VIEWS, _COMPARED_POINTS = 16, 100
# Maximum relative difference of matching distances, and the increase in matches that confirms another unit.
_DEPTH_TOLERANCE, _MIN_AGREEMENT_GAIN = 0.05, 0.2
# Minimum number of points that other views see in another unit; fewer may agree by chance.
_MIN_COMPARISONS = 20


@dataclass(frozen=True)
class SceneExtent:
    """Region that may contain density.

    Attributes
    ----------
    box
        The box; contracted if the scene extends beyond it.
    source
        How the box was determined, as the end of a sentence.
    kind
        "object", "room" or "unbounded".
    reason
        Why the scene is of this kind, as a clause.
    """

    box: AnyBox
    source: str
    kind: str
    reason: str


def estimate_extent(
    cameras: list[PosedCamera],
    object_only: bool = False,
    points: np.ndarray | None = None,
    are_points_complete: bool = False,
) -> SceneExtent:
    """Estimate the box of the scene with `estimate_box`, and whether the scene ends there.

    The scene ends at its box if it is an object (``object_only``), if there are no ``points``, or if all points except
    a few strays are in the box. Otherwise it is unbounded, and its box is the core of a contracted one. A scene is also
    unbounded if its box is over 2.5 times as large as the box of nine tenths of the points, which means that some
    points are far away. The core contains nine tenths of the points, but is at most four times as large as the box from
    the cameras. If the cameras are placed around a common point that they look at, the core also contains their box,
    because they would see a smaller core through space of low resolution.

    A bounded box also contains the cameras, or is contracted around the points if that would more than double its size.
    Cameras extend neither box nor core if ``are_points_complete``, because then nothing is between them and the points.

    Parameters
    ----------
    cameras
        Cameras of the views.
    object_only
        Whether the images show an object without background.
    points
        Surface points (N, 3).
    are_points_complete
        Whether the points cover everything that the cameras see.
    """
    box, source = estimate_box(cameras, object_only, points)
    if object_only:
        return SceneExtent(box, source, "object", "the photos show no background")
    if points is None or len(points) < _MIN_POINTS:
        return SceneExtent(
            box, source, "room", "there are no surface points to show whether the scene extends beyond its box"
        )
    # Nothing is between the cameras and complete points.
    surrounding = [] if are_points_complete else cameras
    outside_fraction = float(np.mean(np.any((points < box.lower) | (points > box.upper), axis=1)))
    reason = f"{100 * outside_fraction:.1f} % of the surface points are outside of its box"
    if outside_fraction > _MAX_STRAY_FRACTION:
        # The box from the cameras excludes some points.
        core_distance = float(np.quantile(np.abs(points - box.center).max(axis=1), _CORE_FRACTION))
        half_side = float(np.clip(core_distance, 0.5 * box.side, 0.5 * _MAX_CORE_GROWTH * box.side))
        core = Box(tuple(np.subtract(box.center, half_side)), tuple(np.add(box.center, half_side)))
        return _contract_around(core, surrounding, f"{source}, nine tenths of the points", reason)
    lower, upper = np.quantile(points, [0.5 - 0.5 * _CORE_FRACTION, 0.5 + 0.5 * _CORE_FRACTION], axis=0)
    if box.side > _MIN_CORE_SHRINKAGE * float(np.max(upper - lower)):
        margin = _MARGIN * float(np.max(upper - lower))
        reason = f"a box of two fifths of the size of the box of all {len(points)} points contains nine tenths of them"
        core = Box(tuple(lower - margin), tuple(upper + margin))
        return _contract_around(core, surrounding, f"around nine tenths of {len(points)} surface points", reason)
    return (
        SceneExtent(box, source, "room", reason)
        if are_points_complete
        else _include_cameras(box, cameras, source, reason)
    )


def _surround_a_point(cameras: list[PosedCamera]) -> bool:
    """Return whether the cameras are placed around a common point that they look at, and not only in front of it."""
    focus, angles = find_focus(cameras)
    centers = np.array([c.center for c in cameras])
    distance, spread = (np.median(np.linalg.norm(centers - p, axis=1)) for p in (focus, centers.mean(axis=0)))
    return bool(np.median(angles) < MAX_CONVERGENCE_ANGLE and spread > _MIN_CAMERA_SPREAD * distance)


def _contract_around(core: Box, cameras: list[PosedCamera], source: str, reason: str) -> SceneExtent:
    """Return an unbounded scene with the ``core``, extended to the box of cameras that are placed around a point."""
    extended = core
    if cameras and _surround_a_point(cameras):
        box = estimate_box(cameras)[0]
        extended = _unite(core, box.lower, box.upper)
    return SceneExtent(
        ContractedBox(extended), f"{source} and the cameras" if extended != core else source, "unbounded", reason
    )


def _include_cameras(box: Box, cameras: list[PosedCamera], source: str, reason: str) -> SceneExtent:
    """Extend ``box``, which contains the points, to the cameras. Visible matter between them may have no points."""
    centers = np.array([c.center for c in cameras])
    union = _unite(box, centers.min(axis=0), centers.max(axis=0))
    if union.side > _MAX_CAMERA_GROWTH * box.side:
        return _contract_around(box, cameras, source, f"{reason}, but the cameras are far outside of it")
    return SceneExtent(union, f"{source} and the cameras" if union != box else source, "room", reason)


def _unite(box: Box, lower, upper) -> Box:
    """Return the smallest box that contains ``box`` and the corners ``lower`` and ``upper``."""
    return Box(tuple(np.minimum(box.lower, lower)), tuple(np.maximum(box.upper, upper)))


def estimate_box(
    cameras: list[PosedCamera], object_only: bool = False, points: np.ndarray | None = None
) -> tuple[Box, str]:
    """Estimate the bounding box in the coordinates of the cameras. Returns the box and its source, as the end of a
    sentence.

    With surface ``points`` (N, 3), the box contains them except for strays, with a margin. Cameras that look at a
    common point also bound it, as follows, because points may be far behind it.

    Without points, and with cameras that look at a common point, the box is a cube around that point. It contains the
    cameras, and as much space behind the point. With ``object_only`` (images with alpha, without background), it is the
    region that all frusta share.

    Other cameras are inside the scene: the box is that of their centres, extended on each side by half of its longest
    edge.
    """
    centers = np.array([c.center for c in cameras])
    focus, angle = find_focus(cameras)
    bounds = None
    if len(cameras) >= 2 and np.median(angle) < MAX_CONVERGENCE_ANGLE:
        distance = np.linalg.norm(centers - focus, axis=1)
        if object_only:
            half_side = float(np.max(distance * [_half_angle_tangent(c) for c in cameras]))
            bounds = focus - half_side, focus + half_side, "the region that all views share"
        else:
            half_side = 1.25 * float(distance.max())
            bounds = focus - half_side, focus + half_side, "around the point that the cameras look at"
    if points is not None and len(points) >= _MIN_POINTS:
        lower, upper = _bound_without_strays(points)
        margin = _MARGIN * float(np.max(upper - lower))
        lower, upper = lower - margin, upper + margin
        if bounds is not None:
            lower, upper = np.maximum(lower, bounds[0]), np.minimum(upper, bounds[1])
        if np.all(upper > lower):
            return Box(tuple(lower), tuple(upper)), f"around {len(points)} surface points"
    if bounds is not None:
        return Box(tuple(bounds[0]), tuple(bounds[1])), bounds[2]
    lower, upper = centers.min(axis=0), centers.max(axis=0)
    margin = 0.5 * float(np.max(upper - lower))
    if margin == 0:
        raise NergError(
            "all cameras are at the same position, so the scene box cannot be estimated; set it with "
            f"{parameter('aabb')}"
        )
    return Box(tuple(lower - margin), tuple(upper + margin)), "around the cameras"


def _bound_without_strays(points: np.ndarray) -> np.ndarray:
    """Return the corners (2, 3) of the box of ``points``, without points far outside of the box of nearly all of
    them.
    """
    lower, upper = np.quantile(points, [_OUTLIER_FRACTION, 1 - _OUTLIER_FRACTION], axis=0)
    margin = _NEAR_MARGIN * float(np.max(upper - lower))
    near = points[np.all((points >= lower - margin) & (points <= upper + margin), axis=1)]
    return np.quantile(near, [_MIN_TAIL_FRACTION, 1 - _MIN_TAIL_FRACTION], axis=0)


def find_focus(cameras: list[PosedCamera]) -> tuple[np.ndarray, np.ndarray]:
    """Return the point nearest to all viewing axes (least squares), and the angle of each camera to it in radians."""
    centers, axes = np.array([c.center for c in cameras]), np.array([c.axis for c in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # Parallel axes have no unique nearest point; lstsq then returns the one with minimum norm, at large angles.
    focus = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centers), rcond=1e-6)[0]
    to = focus - centers
    length = np.maximum(np.linalg.norm(to, axis=1), 1e-12)
    return focus, np.arccos(np.clip(np.sum(to * axes, axis=1) / length, -1, 1))


def _half_angle_tangent(camera: PosedCamera) -> float:
    i = camera.intrinsics
    return min(i.width / (2 * i.fx), i.height / (2 * i.fy))


def find_unmatched(cameras: list[PosedCamera], box: AnyBox, grid: int = 4, depths: int = 12) -> list[int]:
    """Return the indices of cameras whose images share no point within ``box`` with any other image.

    ``grid`` by ``grid`` pixels of each image are sampled at ``depths`` distances within the box; more pixels if none
    of these shows the box, since an object may be small.
    """
    centers = np.array([c.center for c in cameras])
    order = np.arange(len(cameras))
    unmatched = []
    for k, camera in enumerate(cameras):
        samples = (_sample_rays(camera, box, size, depths) for size in (grid, 4 * grid, 16 * grid))
        p = next((points for points in samples if len(points)), np.empty((0, 3)))
        # Nearest cameras first: the search ends at the first camera that sees a point.
        neighbors = order[np.argsort(np.linalg.norm(centers - centers[k], axis=1), kind="stable")]
        if not any(_sees_any(cameras[j], p) for j in neighbors if j != k):
            unmatched.append(k)
    return unmatched


def _sample_rays(camera: PosedCamera, box: AnyBox, grid: int, depths: int) -> np.ndarray:
    """Sample points (N, 3) within the box along rays of the camera."""
    i = camera.intrinsics
    u, v = np.meshgrid((np.arange(grid) + 0.5) / grid * i.width, (np.arange(grid) + 0.5) / grid * i.height)
    d = cameras.image_to_directions(np.stack([(u.ravel() - i.cx) / i.fx, (v.ravel() - i.cy) / i.fy], axis=-1), i) * [
        1,
        -1,
        -1,
    ]
    d = d @ camera.to_world[:3, :3].T
    near, far = intersect_box_numpy(camera.center, d, box.lower, box.upper)
    near = np.maximum(near, 0)
    hit = far > near
    t = near[hit, None] + (far - near)[hit, None] * (np.arange(depths) + 0.5) / depths
    return (camera.center + t[..., None] * d[hit, None]).reshape(-1, 3)


def _sees_any(camera: PosedCamera, points: np.ndarray) -> bool:
    if not len(points):
        return False
    pixels, is_visible = project(points, camera)
    i = camera.intrinsics
    return bool(np.any(is_visible & np.all((pixels >= 0) & (pixels <= [i.width, i.height]), axis=1)))


def explain_wrong_depth(views: list[tuple[PosedCamera, np.ndarray]]) -> str | None:
    """Return why the depth does not match the units of the cameras; None if it may match.

    ``views``: cameras, each with its depth (h, w) as distances along its rays. In the correct unit, views agree on the
    positions of points. In a much too large unit, all cameras are at nearly one position relative to the depth. Similar
    views then agree in each larger unit too, which is no evidence.
    """
    selected = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, _COMPARED_VIEWS).astype(int))]
    compared = [(c, d, depth_points(c, d, _COMPARED_POINTS) - c.center) for c, d in selected]
    agreeing, count = _count_agreeing(compared, 1.0)
    agreement, best = agreeing / max(count, 1), (0.0, 0.0, 0)
    for factor in _UNIT_FACTORS if agreement <= 1 - _MIN_AGREEMENT_GAIN else ():
        scaled_agreeing, scaled_count = _count_agreeing(compared, factor)
        # In a larger unit fewer points are before other cameras, and these may agree by chance.
        if scaled_count >= _MIN_COMPARISONS and scaled_agreeing > agreeing:
            best = max(best, (scaled_agreeing / scaled_count, factor, scaled_count))
    fraction, factor, scaled_count = best
    if fraction >= _MIN_AGREEMENT_GAIN + agreement:
        larger_agreeing, larger_count = _count_agreeing(compared, 10 * factor)
        larger = larger_agreeing / larger_count if 2 * larger_count >= scaled_count else 0.0
        if fraction >= _MIN_AGREEMENT_GAIN + larger:
            return (
                f"{fraction:.0%} of its points agree with the depth of other views after multiplication by "
                f"{factor:g}, but {agreement:.0%} without it"
            )
    extent = float(np.linalg.norm(np.ptp([c.center for c, _ in views], axis=0)))
    median = float(np.median([np.median(d[d > 0]) for _, d in views if (d > 0).any()] or [0.0]))
    if extent > 0 and median > _MAX_DEPTH_RATIO * extent:
        return f"its median is {median:.3g} units, but the cameras span {extent:.3g}"
    return None


def _count_agreeing(views: list[tuple[PosedCamera, np.ndarray, np.ndarray]], factor: float) -> tuple[int, int]:
    """Return how many depth points, scaled by ``factor``, agree with the depth of other views that see them, and how
    many these see.

    Each view: camera, depth (h, w), and points (N, 3) from its depth relative to its centre.
    """
    points = [camera.center + factor * offset for camera, _, offset in views]
    count = agreeing = 0
    for k, (camera, depth, _) in enumerate(views):
        other_points = np.concatenate([np.zeros((0, 3)), *points[:k], *points[k + 1 :]])
        pixels, is_visible = project(other_points, camera)
        is_visible &= np.all((pixels >= 0) & (pixels < depth.shape[::-1]), axis=1)
        x, y = pixels[is_visible].astype(int).T
        measured, expected = factor * depth[y, x], np.linalg.norm(other_points[is_visible] - camera.center, axis=1)
        count += int((measured > 0).sum())
        agreeing += int(np.sum((measured > 0) & (np.abs(measured - expected) <= _DEPTH_TOLERANCE * expected)))
    return agreeing, count


def depth_points(camera: PosedCamera, depth: np.ndarray, max_points: int) -> np.ndarray:
    """Return about ``max_points`` world points (N, 3) from the ``depth`` (h, w) of ``camera``, evenly spaced in
    the image.
    """
    step = max(1, int(np.sqrt(depth.size / max_points)))
    t = depth[::step, ::step]
    d = pixel_directions(camera.intrinsics)[::step, ::step][t > 0] @ camera.to_world[:3, :3].T
    return camera.center + d * t[t > 0][:, None]


# ---- Data set ----

# Padding of a specified box, relative to its size. Rays end at the box, and a surface on its face needs cells behind
# it.
_RELATIVE_PADDING = 1 / 80
# Maximum number of depth points per view for the estimate of the box.
_DEPTH_POINTS_PER_VIEW = 2000
# Deviation from +z in degrees that is within the precision of the up estimate.
_MAX_TILT = 10.0
_KINDS = {
    "object": "an object without background",
    "room": "a bounded scene",
    "unbounded": "an unbounded scene, with full resolution within its box and contracted outside of it",
}


@dataclass(frozen=True)
class Dataset:
    """Views in the requested coordinates, and information about the scene."""

    # Training views.
    train: list[PhotoView]
    # Views for evaluation, which are not used in training.
    held_out: list[PhotoView]
    # Box that may contain density; contracted if the scene is unbounded.
    box: AnyBox
    # How the box was determined, as the end of a sentence.
    box_source: str
    # Unused frames with reasons.
    unused: list[UnusedFrame]
    # Provenance (JSON).
    source: dict
    # Sentences about frames that are used with missing data.
    notes: list[str] | tuple = ()
    # A sentence about the length of a unit.
    unit_note: str = ""
    # A sentence about the kind of scene, with the reason.
    kind_note: str = ""
    # A sentence about the up direction.
    up_note: str = ""


def open_dataset(
    photos: Photos | FilePath,
    holdout: int | None = None,
    width: int | None = None,
    aabb: tuple | None = None,
    depth: bool = True,
    scale: float = 1.0,
    coordinates: str = "file",
    allow_outside: bool = False,
    unbounded: bool | None = None,
) -> Dataset:
    """Read a posed image set and prepare it for training.

    Parameters
    ----------
    photos
        Posed photos, or their file as in `Photos.load`.
    holdout, coordinates, scale, allow_outside
        As in `read_split`.
    width
        Width of the images in pixels. Default: their own.
    aabb
        Bounding box x0, y0, z0, x1, y1, z1 in the requested coordinates. Default: "aabb" of the file, or an estimate
        from surface points (of COLMAP, or from depth) or from the cameras.
    depth
        Whether to read depth files.
    unbounded
        Whether the scene extends beyond the box. None: estimated from surface points; false without points, for a
        specified box, and for images with alpha.

    Returns
    -------
    Dataset
        The data set. Frames that cannot be used are listed.

    Raises
    ------
    NergError
        With file and frame, if no frame can be used.
    """
    split = read_split(photos, holdout, coordinates, scale, allow_outside)
    train, unusable = load_usable_views(split.posed.frames, width, depth)
    if not train:
        raise NergError(
            f'none of the {len(unusable)} training frames of "{split.posed.path}" can be used; the first, '
            f'"{unusable[0].name}": {unusable[0].reason}'
        )
    held_out, unusable_held_out = load_usable_views(split.held_out, width, depth)
    views, background = remove_background([*train, *held_out])
    train, held_out = views[: len(train)], views[len(train) :]
    _check_depth(split.posed, train)
    masks = _describe_masks([*train, *held_out])
    extent = _choose_extent(split.posed, train, aabb, unbounded)
    unmatched = find_unmatched([v.camera for v in train], extent.box) if len(train) > 1 else []
    if len(unmatched) == len(train):
        raise NergError(
            f'no two of the {len(train)} training frames of "{split.posed.path}" (the first: "{train[0].name}") '
            f"show the same part of the box {_format_corners(extent.box)}; check the poses, or set a box that "
            f"contains the scene with {parameter('aabb')}"
        )
    if unmatched:
        unusable += [UnusedFrame(train[k].name, "no other frame shows the same part of the scene") for k in unmatched]
        train = [v for k, v in enumerate(train) if k not in set(unmatched)]
        extent = _choose_extent(split.posed, train, aabb, unbounded)
    unused = [*split.posed.unused, *unusable, *unusable_held_out]
    source = {
        "dataset": resolve_path(split.posed.path).parent.name,
        "transforms": split.posed.path.name,
        "sha256": split.posed.sha256,
        "training_frames": len(train),
        "held_out": {"how": split.rule, "frames": [v.name for v in held_out]},
        "unused": {u.name: u.reason for u in unused},
        "width": train[0].shape[1],
        "height": train[0].shape[0],
        "to_file": split.posed.to_file.tolist(),
    }
    up = estimate_photo_up(split.posed)
    if up.is_reliable:
        source["up"] = [round(float(x), 6) for x in up.direction]
    kind = f"{_KINDS[extent.kind]}: {extent.reason}"
    unit = _describe_unit(split.posed, train, extent.box.core, scale)
    return Dataset(
        train,
        held_out,
        extent.box,
        extent.source,
        unused,
        source,
        [*split.posed.notes, *masks, *([] if background is None else [str(background)])],
        unit,
        kind,
        _describe_up(up),
    )


def _check_depth(posed: Photos, views: list[PhotoView]) -> None:
    """Raise `NergError` if the unit of the depth differs from that of the cameras, or hardly any is a surface."""
    views_with_depth = [(v.camera, v.depth) for v in views if v.depth is not None]
    reason = explain_wrong_depth(views_with_depth) if views_with_depth else None
    if reason is not None:
        background = measure_far_plane(*map(list, zip(*views_with_depth)))
        if background is not None and background.fraction > 0.5:
            raise NergError(
                f'the depth of "{posed.path}" shows hardly any surface, {background}; render the depth again so that '
                'it shows the scene, correct "depth_unit_scale_factor" if these are surfaces, or disable depth with '
                f"{parameter('depth', False)}"
            )
        raise NergError(
            f'the depth of "{posed.path}" does not match its cameras: {reason}; correct "depth_unit_scale_factor", '
            "the length of a unit of the depth files in metres (default: 0.001, for EXR 1), or disable depth with "
            f"{parameter('depth', False)}"
        )


def _describe_masks(views: list[PhotoView]) -> list[str]:
    """Return a sentence about the pixels that masks exclude, if there are any masks."""
    fractions = [v.masked_fraction for v in views if v.masked_fraction is not None]
    if not fractions:
        return []
    if not any(fractions):
        return [f"the {len(fractions)} masks exclude no pixels: are black and white swapped?"]
    return [f"masks exclude {np.mean(fractions):.1%} of the pixels of {len(fractions)} frames"]


def _choose_extent(posed: Photos, views: list[PhotoView], aabb, unbounded: bool | None) -> SceneExtent:
    """Return the specified or estimated box, contracted as requested or estimated."""
    extent = _find_extent(posed, views, aabb)
    if unbounded is None or unbounded == extent.box.is_contracted:
        return extent
    core = extent.box.core
    if unbounded:
        return SceneExtent(ContractedBox(core), extent.source, "unbounded", "as requested")
    return SceneExtent(core, extent.source, "room", "it ends at its box, as requested")


def _find_extent(posed: Photos, views: list[PhotoView], aabb) -> SceneExtent:
    if aabb is not None:
        if len(aabb) != 6:
            raise NergError(f"aabb needs the six numbers x0,y0,z0,x1,y1,z1, got {len(aabb)}")
        corners, source = np.reshape(np.asarray(aabb, float), (2, 3)), "as specified"
    elif posed.aabb is not None:
        corners, source = posed.aabb, f'"aabb" of {posed.path.name}'
    else:
        depth_points_all = None if posed.points is not None else _collect_depth_points(views)
        points, is_object_only = (
            posed.points if depth_points_all is None else depth_points_all,
            all(v.has_alpha for v in views),
        )
        return estimate_extent(
            [v.camera for v in views], is_object_only, points, are_points_complete=depth_points_all is not None
        )
    pad = _RELATIVE_PADDING * float(np.max(corners[1] - corners[0]))
    if not np.abs(corners).max() + pad <= MAX_COORDINATE:
        raise NergError(f"the box {source} has corners beyond {MAX_COORDINATE:g} units; correct it")
    if not np.all(corners[1] > corners[0]):
        raise NergError(f"the box {source} needs its lower corner first: {corners[0]} is not below {corners[1]}")
    box, how = Box(tuple(corners[0] - pad), tuple(corners[1] + pad)), f"{source}, padded by {pad:.3g} on each side"
    return SceneExtent(box, how, "room", "it ends at its box")


def _collect_depth_points(views: list[PhotoView]) -> np.ndarray | None:
    """Return world points from the depth of all views; None if a view has no depth."""
    depths = [v.depth for v in views if v.depth is not None]
    if len(depths) < len(views):
        return None
    return np.concatenate([depth_points(v.camera, t, _DEPTH_POINTS_PER_VIEW) for v, t in zip(views, depths)])


def _format_corners(box: AnyBox) -> str:
    return " to ".join("(" + ", ".join(f"{x:.3g}" for x in c) + ")" for c in (box.lower, box.upper))


def _describe_up(up: UpEstimate) -> str:
    """Describe the up direction, and what to do if it is not +z."""
    if not up.is_reliable:
        return f"the cameras do not agree on the up direction (median roll {up.median_roll:.0f} degrees)"
    off = float(np.degrees(np.arccos(np.clip(up.direction[2], -1, 1))))
    if off <= _MAX_TILT:
        return f"up is +z to {off:.1f} degrees ({up})"
    direction = ", ".join(f"{x:.2f}" for x in up.direction)
    return (
        f"up is ({direction}), {off:.0f} degrees from +z, which tracking data requires ({up}); "
        f"{parameter('coordinates', 'upright')} rotates the scene"
    )


def _describe_unit(posed: Photos, views: list[PhotoView], box: AnyBox, scale: float) -> str:
    """Describe the length of a unit."""
    centers = np.array([v.camera.center for v in views])
    size = " x ".join(f"{u - l:.3g}" for l, u in zip(box.lower, box.upper))
    spread = " x ".join(f"{x:.3g}" for x in np.ptp(centers, axis=0))
    extent = f"the box measures {size} units, the cameras span {spread}"
    if scale != 1:
        return f"{extent}; a unit of the data set is scaled to {scale:g}"
    if any(f.depth is not None for f in posed.frames):
        return f"{extent}; a unit is a metre if the scale factor of the depth files is in metres"
    return f"{extent}; if a unit is not a metre, set its length in metres with {parameter('scale')}"
