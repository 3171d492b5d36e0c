"""A posed image set made ready: training views, held-out views and the box of the scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.files.safe_read import resolve_path
from nerg_mi.maths.geometry import AnyBox, Box, ContractedBox, intersect_box_numpy

from . import cameras
from .cameras import PosedCamera, pixel_directions, project
from .colmap import UpEstimate
from .images import PhotoView, load_usable_views, read_split, estimate_photo_up
from .posed import PosedImages, UnusedFrame

# ---- Bounds ----
#
# What cameras looked at: the box around it, from points on its surfaces or from the cameras alone, whether the
# place ends there, and whether depth fits the cameras.


# Cameras whose axes miss their common point by less than this look at one thing.
_CONVERGING = np.radians(30)
# So few points, or so many beyond either end of an axis, are no evidence of where a place ends.
_MIN_POINTS, _OUTLIERS = 100, 0.005
# Points within this share of the longest edge beyond the box of nearly all still count, as plain parts of a place have
# few; all but this share of them at either end, which may be strays as well.
_NEAR_BY, _FEWEST = 0.5, 0.0005
# Of the points' longest edge, for what lies between them and the wall that they are on.
_MARGIN = 0.05

# Of the points: so many beyond the box are strays, more are part of the place.
_BEYOND = 0.02
# Of the points, how many the core of an unbounded place holds, and how many times larger than the box that the cameras
# bound, or smaller than the one that holds all but strays, it may then be.
_CORE, _MOST_LARGER, _LEAST_SMALLER = 0.9, 4.0, 2.5
# So many times larger may a box get that is to hold the cameras as well as the points.
_FAR_OUTSIDE = 2.0
# Of the cameras' extent, so many times as far may the median depth be.
_FARTHEST_DEPTH = 100
# Factors by which wrong units put depth too far or too near: of millimetres, centimetres, fifths of a millimetre.
_WRONG_UNITS = (1e-3, 1e-2, 0.1, 0.2, 5.0, 10.0, 100.0, 1e3)
# Views that are compared, and points of each.
_COMPARED, _COMPARED_POINTS = 16, 100
# Points agree where their distances differ by at most this; another unit is right where so many more of them agree.
_AGREEING, _MORE = 0.05, 0.2


@dataclass(frozen=True)
class SceneExtent:
    """Where a place may hold density: ``box``, contracted where the place does not end there; ``how`` the box was
    found, the end of a sentence; ``kind`` of the place, "object", "room" or "unbounded", and ``why``, a clause."""

    box: AnyBox
    source: str
    kind: str
    reason: str


def estimate_extent(
    cameras: list[PosedCamera], object_only: bool = False, points: np.ndarray | None = None, are_points_complete: bool = False
) -> SceneExtent:
    """The box around what ``cameras`` looked at, as `scene_box` finds it, and whether the place ends there.

    An object before nothing, ``object_only``, ends at its box, and so does a place without ``points`` (N, 3), on
    surfaces, and one whose points lie within its box but for a few strays. Every other is unbounded: its box is the
    core of a contracted one. So is a place whose box is over 2.5 times as large as what holds nine of ten points: a
    few of them are far away. The core holds nine tenths of the points, but is at most four times as large as the box
    that the cameras bound.

    A place that ends at its box holds its cameras too, or is contracted around its points where that would more than
    double the box. Not so where the points are ``complete``, of all that the cameras see: nothing stands before them.
    """
    box, how = estimate_box(cameras, object_only, points)
    if object_only:
        return SceneExtent(box, how, "object", "the photos show nothing behind it")
    if points is None or len(points) < _MIN_POINTS:
        return SceneExtent(box, how, "room", "no points on surfaces tell whether there is more than its box")
    beyond = float(np.mean(np.any((points < box.lower) | (points > box.upper), axis=1)))
    why = f"{100 * beyond:.1f} % of the points on surfaces lie beyond its box"
    if beyond > _BEYOND:
        # What the cameras bound has cut points off.
        away = float(np.quantile(np.abs(points - box.center).max(axis=1), _CORE))
        half = float(np.clip(away, 0.5 * box.side, 0.5 * _MOST_LARGER * box.side))
        core = Box(tuple(np.subtract(box.center, half)), tuple(np.add(box.center, half)))
        return SceneExtent(ContractedBox(core), f"{how}, nine tenths of them", "unbounded", why)
    lower, upper = np.quantile(points, [0.5 - 0.5 * _CORE, 0.5 + 0.5 * _CORE], axis=0)
    if box.side > _LEAST_SMALLER * float(np.max(upper - lower)):
        margin = _MARGIN * float(np.max(upper - lower))
        why = f"a box two fifths as large as one around all {len(points)} points holds nine tenths of them"
        core = Box(tuple(lower - margin), tuple(upper + margin))
        return SceneExtent(ContractedBox(core), f"around nine tenths of {len(points)} points on surfaces", "unbounded", why)
    return SceneExtent(box, how, "room", why) if are_points_complete else _with_cameras(box, cameras, how, why)


def _with_cameras(box: Box, cameras: list[PosedCamera], how: str, why: str) -> SceneExtent:
    """A place whose points lie within ``box``, and its ``cameras``: what stands between them and the points may have
    none, and is seen."""
    centers = np.array([c.center for c in cameras])
    lower, upper = np.minimum(box.lower, centers.min(axis=0)), np.maximum(box.upper, centers.max(axis=0))
    whole = Box(tuple(lower), tuple(upper))
    if whole.side > _FAR_OUTSIDE * box.side:
        why = f"{why}, but the cameras stand far outside of it"
        return SceneExtent(ContractedBox(box), how, "unbounded", why)
    grown = np.any(lower < box.lower) or np.any(upper > box.upper)
    return SceneExtent(whole, f"{how} and the cameras" if grown else how, "room", why)


def estimate_box(
    cameras: list[PosedCamera], object_only: bool = False, points: np.ndarray | None = None
) -> tuple[Box, str]:
    """A box in the cameras' coordinates, and a sentence saying how it was found.

    ``points`` (N, 3) on surfaces: the box that holds them but for strays, with a margin; cameras that stand around
    something also bound it, as below, because points may lie far behind it. Without points, cameras that look at a
    common point: a cube around that point, which holds the cameras and as much again behind the point as they stand
    away from it, or, with ``object_only`` (pictures with alpha, without background), the region that the frusta share.
    Other cameras stand inside of what they see: the box of their centres, grown on every side by half of its longest
    edge.
    """
    centers = np.array([c.center for c in cameras])
    axes = np.array([c.axis for c in cameras])
    focus, angle = _focus(centers, axes)
    around = None
    if len(cameras) >= 2 and np.median(angle) < _CONVERGING:
        distance = np.linalg.norm(centers - focus, axis=1)
        if object_only:
            half = float(np.max(distance * [_half_angle_tangent(c) for c in cameras]))
            around = focus - half, focus + half, "the region that the views share"
        else:
            half = 1.25 * float(distance.max())
            around = focus - half, focus + half, "around the point that the cameras look at"
    if points is not None and len(points) >= _MIN_POINTS:
        lower, upper = _without_strays(points)
        margin = _MARGIN * float(np.max(upper - lower))
        lower, upper = lower - margin, upper + margin
        if around is not None:
            lower, upper = np.maximum(lower, around[0]), np.minimum(upper, around[1])
        if np.all(upper > lower):
            return Box(tuple(lower), tuple(upper)), f"around {len(points)} points on surfaces"
    if around is not None:
        return Box(tuple(around[0]), tuple(around[1])), around[2]
    lower, upper = centers.min(axis=0), centers.max(axis=0)
    margin = 0.5 * float(np.max(upper - lower))
    if margin == 0:
        raise NergError("all cameras stand at one point, so that no scene box can be guessed; give one with --aabb")
    return Box(tuple(lower - margin), tuple(upper + margin)), "around the cameras"


def _without_strays(points: np.ndarray) -> np.ndarray:
    """Lower and upper corner (2, 3) of the box around ``points``, but for those far beyond what nearly all lie in."""
    lower, upper = np.quantile(points, [_OUTLIERS, 1 - _OUTLIERS], axis=0)
    around = _NEAR_BY * float(np.max(upper - lower))
    near = points[np.all((points >= lower - around) & (points <= upper + around), axis=1)]
    return np.quantile(near, [_FEWEST, 1 - _FEWEST], axis=0)


def _focus(centers: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Point nearest to all viewing axes (least squares), and each camera's angle to it in radians."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # Parallel axes have no nearest point; lstsq then returns the one of least norm, at large angles.
    focus = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centers), rcond=1e-6)[0]
    to = focus - centers
    length = np.maximum(np.linalg.norm(to, axis=1), 1e-12)
    return focus, np.arccos(np.clip(np.sum(to * axes, axis=1) / length, -1, 1))


def _half_angle_tangent(camera: PosedCamera) -> float:
    i = camera.intrinsics
    return min(i.width / (2 * i.fx), i.height / (2 * i.fy))


def find_unmatched(cameras: list[PosedCamera], box: AnyBox, grid: int = 4, depths: int = 12) -> list[int]:
    """Cameras that share nothing within ``box`` with any other: no sample point of their pictures is in another's.

    ``grid`` by ``grid`` pixels of each are followed through the box and looked for at ``depths`` places.
    """
    centers = np.array([c.center for c in cameras])
    order = np.arange(len(cameras))
    out = []
    for k, camera in enumerate(cameras):
        p = _samples(camera, box, grid, depths)
        # Neighbours first: one that sees a point ends the search.
        others = order[np.argsort(np.linalg.norm(centers - centers[k], axis=1), kind="stable")]
        if not any(_sees(cameras[j], p) for j in others if j != k):
            out.append(k)
    return out


def _samples(camera: PosedCamera, box: AnyBox, grid: int, depths: int) -> np.ndarray:
    """Points (N, 3) within the box on rays of the picture."""
    i = camera.intrinsics
    u, v = np.meshgrid((np.arange(grid) + 0.5) / grid * i.width, (np.arange(grid) + 0.5) / grid * i.height)
    d = cameras.image_to_directions(np.stack([(u.ravel() - i.cx) / i.fx, (v.ravel() - i.cy) / i.fy], axis=-1), i) * [1, -1, -1]
    d = d @ camera.to_world[:3, :3].T
    near, far = intersect_box_numpy(camera.center, d, box.lower, box.upper)
    near = np.maximum(near, 0)
    hit = far > near
    t = near[hit, None] + (far - near)[hit, None] * (np.arange(depths) + 0.5) / depths
    return (camera.center + t[..., None] * d[hit, None]).reshape(-1, 3)


def _sees(camera: PosedCamera, points: np.ndarray) -> bool:
    if not len(points):
        return False
    at, shown = project(points, camera)
    i = camera.intrinsics
    return bool(np.any(shown & np.all((at >= 0) & (at <= [i.width, i.height]), axis=1)))


def explain_wrong_depth(views: list[tuple[PosedCamera, np.ndarray]]) -> str | None:
    """Why depth is in other units than its camera; None where it may be in the same. ``seen``: cameras, each with its
    depth (h, w), distances along its rays.

    In the right unit views agree on where a point is. In much too large a unit all of them are at one place, compared
    with their depth, so that what merely looks alike agrees in every larger unit as well: that is no evidence.
    """
    picked = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, _COMPARED).astype(int))]
    views = [(c, d, depth_points(c, d, _COMPARED_POINTS) - c.center) for c, d in picked]
    now = _agreement(views, 1.0)
    if now <= 1 - _MORE:
        best, factor = max((_agreement(views, f), f) for f in _WRONG_UNITS)
        if best >= _MORE + max(now, _agreement(views, 10 * factor)):
            return (
                f"{best:.0%} of its points agree with the depth of other views if it is multiplied by {factor:g}, and "
                f"{now:.0%} as it is"
            )
    extent = float(np.linalg.norm(np.ptp([c.center for c, _ in views], axis=0)))
    median = float(np.median([np.median(d[d > 0]) for _, d in views if (d > 0).any()] or [0.0]))
    if extent > 0 and median > _FARTHEST_DEPTH * extent:
        return f"its median is {median:.3g} units, and the cameras spread over {extent:.3g}"
    return None


def _agreement(views: list[tuple[PosedCamera, np.ndarray, np.ndarray]], factor: float) -> float:
    """Of the points that one of ``views`` sees by its depth times ``factor``, and that are within the picture of
    another, the fraction that lies where this sees something by its own. Of each view: camera, depth (h, w), and
    points (N, 3) that it sees, from its centre."""
    points = [camera.center + factor * offset for camera, _, offset in views]
    count = agreeing = 0
    for k, (camera, depth, _) in enumerate(views):
        others = np.concatenate([np.zeros((0, 3)), *points[:k], *points[k + 1 :]])
        at, shown = project(others, camera)
        shown &= np.all((at >= 0) & (at < depth.shape[::-1]), axis=1)
        x, y = at[shown].astype(int).T
        seen, expected = factor * depth[y, x], np.linalg.norm(others[shown] - camera.center, axis=1)
        count += int((seen > 0).sum())
        agreeing += int(np.sum((seen > 0) & (np.abs(seen - expected) <= _AGREEING * expected)))
    return agreeing / count if count else 0.0


def depth_points(camera: PosedCamera, depth: np.ndarray, max_points: int) -> np.ndarray:
    """World points (N, 3) that ``camera`` sees by its ``depth`` (h, w), some ``most`` evenly over its pixels."""
    step = max(1, int(np.sqrt(depth.size / max_points)))
    t = depth[::step, ::step]
    d = pixel_directions(camera.intrinsics)[::step, ::step][t > 0] @ camera.to_world[:3, :3].T
    return camera.center + d * t[t > 0][:, None]


# ---- Dataset ----
#
# A posed image set made ready: training views, held-out views and the scene box.


# A surface on a face of the box needs cells behind it: rays end at the box, and a half step before it nothing can
# absorb.
_PAD = 1 / 80
# Of each view's depth, at most so many points help to find the box.
_DEPTH_POINTS = 2000
# Up by how cameras are held, where no floor helps, is not better known than to so many degrees.
_LEVEL = 10.0
_KINDS = {
    "object": "an object before nothing",
    "room": "a bounded place",
    "unbounded": "a place without an end, resolved best within its box and contracted around it",
}


@dataclass(frozen=True)
class Dataset:
    """Views in the coordinates asked for, and what is known of the place that they show."""

    # To train on.
    train: list[PhotoView]
    # To score on, never to learn from.
    held_out: list[PhotoView]
    # Where density may be, contracted where the place does not end at the box that was found.
    box: AnyBox
    # How the box was found, the end of a sentence.
    box_source: str
    # Frames that were left out, each with its reason.
    unused: list[UnusedFrame]
    # For provenance (JSON).
    source: dict
    # Sentences about frames that are used with something missing.
    notes: list[str] | tuple = ()
    # A sentence on the length of a unit.
    unit_note: str = ""
    # What kind of place it was taken for, and why, a sentence.
    kind_note: str = ""
    # Which way is up, a sentence.
    up_note: str = ""


def open_dataset(
    path: str | Path,
    holdout: int | None = None,
    width: int | None = None,
    downscale: float | None = None,
    aabb: tuple | None = None,
    depth: bool = True,
    scale: float = 1.0,
    coordinates: str = "file",
    allow_outside: bool = False,
    unbounded: bool | None = None,
) -> Dataset:
    """Read the data set ``path``: a folder with a transforms file or a COLMAP model, or one of these itself.

    ``holdout``, ``coordinates``, ``scale``, ``allow_outside``: as `read_split` has them. ``width``, ``downscale``: size
    of the pictures. ``aabb``: six numbers x0, y0, z0, x1, y1, z1 bounding what is seen, in the coordinates asked for;
    else "aabb" of the file, else a guess from points on surfaces (COLMAP's, or from depth) or from the cameras.
    ``unbounded``: whether there is anything to be seen beyond that box; None: what the points tell, and no where there
    are none, for a box that is given, by hand or by the file, and for pictures with alpha. ``depth``: read the depth
    files that the frames name.

    Frames that cannot be used are left out and listed; `NergError`, naming file and frame, when none can.
    """
    split = read_split(path, holdout, coordinates, scale, allow_outside)
    train, bad = load_usable_views(split.posed.frames, width, downscale, depth)
    if not train:
        raise NergError(
            f'none of the {len(bad)} training frames of "{split.posed.path}" can be used; the first, '
            f'"{bad[0].name}": {bad[0].reason}'
        )
    _check_depth(split.posed, train)
    held_out, bad_held = load_usable_views(split.held_out, width, downscale, depth)
    masks = _describe_masks([*train, *held_out])
    extent = _extent(split.posed, train, aabb, unbounded)
    alone = find_unmatched([v.camera for v in train], extent.box) if len(train) > 1 else []
    if len(alone) == len(train):
        raise NergError(
            f'no two of the {len(train)} training frames of "{split.posed.path}" (the first: "{train[0].name}") look '
            f"at the same place within the box {_corners(extent.box)}; check the poses, or give a box that holds what "
            "they show with --aabb"
        )
    if alone:
        bad += [UnusedFrame(train[k].name, "no other frame looks at what it shows") for k in alone]
        train = [v for k, v in enumerate(train) if k not in set(alone)]
        extent = _extent(split.posed, train, aabb, unbounded)
    unused = [*split.posed.unused, *bad, *bad_held]
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
    unit = _unit(split.posed, train, extent.box.core, scale)
    return Dataset(
        train, held_out, extent.box, extent.source, unused, source, [*split.posed.notes, *masks], unit, kind, _up(up)
    )


def _check_depth(posed: PosedImages, views: list[PhotoView]) -> None:
    """Raise `NergError` for depth in other units than the cameras'."""
    seen = [(v.camera, v.depth) for v in views if v.depth is not None]
    reason = explain_wrong_depth(seen) if seen else None
    if reason is not None:
        raise NergError(
            f'the depth of "{posed.path}" does not fit its cameras: {reason}; correct "depth_unit_scale_factor", the '
            "metres of one step of its depth files (default: 0.001, of EXR 1), or leave depth out with --no-depth"
        )


def _describe_masks(views: list[PhotoView]) -> list[str]:
    """A sentence on what the masks of ``views`` leave out, where there are any."""
    fractions = [v.masked_fraction for v in views if v.masked_fraction is not None]
    if not fractions:
        return []
    if not any(fractions):
        return [f"the masks of all {len(fractions)} frames that have one leave out nothing: are black and white right?"]
    return [f"masks leave out {np.mean(fractions):.1%} of the pixels of {len(fractions)} frames"]


def _extent(posed: PosedImages, views: list[PhotoView], aabb, unbounded: bool | None) -> SceneExtent:
    """Where density may be: the box that is given, or the one that is found; contracted as asked for, or as found."""
    extent = _found(posed, views, aabb)
    if unbounded is None or unbounded == extent.box.is_contracted:
        return extent
    core = extent.box.core
    if unbounded:
        return SceneExtent(ContractedBox(core), extent.source, "unbounded", "as asked for")
    return SceneExtent(core, extent.source, "room", "it is to end at its box, as asked for")


def _found(posed: PosedImages, views: list[PhotoView], aabb) -> SceneExtent:
    if aabb is not None:
        if len(aabb) != 6:
            raise NergError(f"aabb needs the six numbers x0,y0,z0,x1,y1,z1, got {len(aabb)}")
        given, source = np.reshape(np.asarray(aabb, float), (2, 3)), "as given"
    elif posed.aabb is not None:
        given, source = posed.aabb, f'"aabb" of {posed.path.name}'
    else:
        seen = None if posed.points is not None else _depth_points(views)
        points, cutout = posed.points if seen is None else seen, all(v.has_alpha for v in views)
        return estimate_extent([v.camera for v in views], cutout, points, are_points_complete=seen is not None)
    tight = Box(tuple(given[0]), tuple(given[1]))
    pad = _PAD * tight.side
    box, how = Box(tuple(given[0] - pad), tuple(given[1] + pad)), f"{source}, grown by {pad:.3g} on every side"
    return SceneExtent(box, how, "room", "it ends at its box")


def _depth_points(views: list[PhotoView]) -> np.ndarray | None:
    """World points that views with depth see, evenly over their pixels; None where a view has no depth."""
    depths = [v.depth for v in views if v.depth is not None]
    if len(depths) < len(views):
        return None
    return np.concatenate([depth_points(v.camera, t, _DEPTH_POINTS) for v, t in zip(views, depths)])


def _corners(box: AnyBox) -> str:
    return " to ".join("(" + ", ".join(f"{x:.3g}" for x in c) + ")" for c in (box.lower, box.upper))


def _up(up: UpEstimate) -> str:
    """What is known of up, and what to do where it is not +z."""
    if not up.is_reliable:
        return f"the cameras do not agree on what is up (rolled by {up.median_roll:.0f} degrees, median)"
    off = float(np.degrees(np.arccos(np.clip(up.direction[2], -1, 1))))
    if off <= _LEVEL:
        return f"up is +z to {off:.1f} degrees ({up})"
    direction = ", ".join(f"{x:.2f}" for x in up.direction)
    return (
        f"up is ({direction}), {off:.0f} degrees from +z, which it is for tracking ({up}); --coordinates upright turns "
        "the place"
    )


def _unit(posed: PosedImages, views: list[PhotoView], box: AnyBox, scale: float) -> str:
    """What is known of the length of a unit."""
    centers = np.array([v.camera.center for v in views])
    size = " x ".join(f"{u - l:.3g}" for l, u in zip(box.lower, box.upper))
    spread = " x ".join(f"{x:.3g}" for x in np.ptp(centers, axis=0))
    extent = f"the box measures {size} units, the cameras spread over {spread}"
    if scale != 1:
        return f"{extent}; a unit of the data set counts {scale:g}"
    if any(f.depth is not None for f in posed.frames):
        return f"{extent}; a unit is a metre if the depth files, by their scale factor, are in metres"
    return f"{extent}; if a unit is not a metre, give its length in metres with --scale"
