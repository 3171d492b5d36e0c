"""A posed image set made ready: training views, held-out views and the scene box."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerg_mi.errors import NergError
from nerg_mi.maths.geometry import AnyBox, Box, ContractedBox

from .bounds import Extent, depth_points, explain_wrong_depth, place_extent, unmatched
from .images import View, load_usable
from .posed import PosedImages, Unused
from .sources import read_split, up_of
from .upright import Up

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
    train: list[View]
    # To score on, never to learn from.
    held_out: list[View]
    # Where density may be, contracted where the place does not end at the box that was found.
    box: AnyBox
    # How the box was found, the end of a sentence.
    box_from: str
    # Frames that were left out, each with its reason.
    unused: list[Unused]
    # For provenance (JSON).
    source: dict
    # Sentences about frames that are used with something missing.
    notes: list[str] | tuple = ()
    # A sentence on the length of a unit.
    unit: str = ""
    # What kind of place it was taken for, and why, a sentence.
    kind: str = ""
    # Which way is up, a sentence.
    up: str = ""


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
    train, bad = load_usable(split.posed.frames, width, downscale, depth)
    if not train:
        raise NergError(
            f'none of the {len(bad)} training frames of "{split.posed.path}" can be used; the first, '
            f'"{bad[0].name}": {bad[0].reason}'
        )
    _check_depth(split.posed, train)
    held_out, bad_held = load_usable(split.held_out, width, downscale, depth)
    masks = _describe_masks([*train, *held_out])
    extent = _extent(split.posed, train, aabb, unbounded)
    alone = unmatched([v.camera for v in train], extent.box) if len(train) > 1 else []
    if len(alone) == len(train):
        raise NergError(
            f'no two of the {len(train)} training frames of "{split.posed.path}" (the first: "{train[0].name}") look '
            f"at the same place within the box {_corners(extent.box)}; check the poses, or give a box that holds what "
            "they show with --aabb"
        )
    if alone:
        bad += [Unused(train[k].name, "no other frame looks at what it shows") for k in alone]
        train = [v for k, v in enumerate(train) if k not in set(alone)]
        extent = _extent(split.posed, train, aabb, unbounded)
    unused = [*split.posed.unused, *bad, *bad_held]
    source = {
        "dataset": split.posed.path.resolve().parent.name,
        "transforms": split.posed.path.name,
        "sha256": split.posed.sha256,
        "training_frames": len(train),
        "held_out": {"how": split.rule, "frames": [v.name for v in held_out]},
        "unused": {u.name: u.reason for u in unused},
        "width": train[0].shape[1],
        "height": train[0].shape[0],
        "to_file": split.posed.to_file.tolist(),
    }
    up = up_of(split.posed)
    if up.sure:
        source["up"] = [round(float(x), 6) for x in up.direction]
    kind = f"{_KINDS[extent.kind]}: {extent.why}"
    unit = _unit(split.posed, train, extent.box.core, scale)
    return Dataset(
        train, held_out, extent.box, extent.how, unused, source, [*split.posed.notes, *masks], unit, kind, _up(up)
    )


def _check_depth(posed: PosedImages, views: list[View]) -> None:
    """Raise `NergError` for depth in other units than the cameras'."""
    seen = [(v.camera, v.depth) for v in views if v.depth is not None]
    reason = explain_wrong_depth(seen) if seen else None
    if reason is not None:
        raise NergError(
            f'the depth of "{posed.path}" does not fit its cameras: {reason}; correct "depth_unit_scale_factor", the '
            "metres of one step of its depth files (default: 0.001, of EXR 1), or leave depth out with --no-depth"
        )


def _describe_masks(views: list[View]) -> list[str]:
    """A sentence on what the masks of ``views`` leave out, where there are any."""
    fractions = [v.left_out for v in views if v.left_out is not None]
    if not fractions:
        return []
    if not any(fractions):
        return [f"the masks of all {len(fractions)} frames that have one leave out nothing: are black and white right?"]
    return [f"masks leave out {np.mean(fractions):.1%} of the pixels of {len(fractions)} frames"]


def _extent(posed: PosedImages, views: list[View], aabb, unbounded: bool | None) -> Extent:
    """Where density may be: the box that is given, or the one that is found; contracted as asked for, or as found."""
    extent = _found(posed, views, aabb)
    if unbounded is None or unbounded == extent.box.contracted:
        return extent
    core = extent.box.core
    if unbounded:
        return Extent(ContractedBox(core), extent.how, "unbounded", "as asked for")
    return Extent(core, extent.how, "room", "it is to end at its box, as asked for")


def _found(posed: PosedImages, views: list[View], aabb) -> Extent:
    if aabb is not None:
        if len(aabb) != 6:
            raise NergError(f"aabb needs the six numbers x0,y0,z0,x1,y1,z1, got {len(aabb)}")
        given, source = np.reshape(np.asarray(aabb, float), (2, 3)), "as given"
    elif posed.aabb is not None:
        given, source = posed.aabb, f'"aabb" of {posed.path.name}'
    else:
        seen = None if posed.points is not None else _depth_points(views)
        points, cutout = posed.points if seen is None else seen, all(v.has_alpha for v in views)
        return place_extent([v.camera for v in views], cutout, points, complete=seen is not None)
    tight = Box(tuple(given[0]), tuple(given[1]))
    pad = _PAD * tight.side
    box, how = Box(tuple(given[0] - pad), tuple(given[1] + pad)), f"{source}, grown by {pad:.3g} on every side"
    return Extent(box, how, "room", "it ends at its box")


def _depth_points(views: list[View]) -> np.ndarray | None:
    """World points that views with depth see, evenly over their pixels; None where a view has no depth."""
    depths = [v.depth for v in views if v.depth is not None]
    if len(depths) < len(views):
        return None
    return np.concatenate([depth_points(v.camera, t, _DEPTH_POINTS) for v, t in zip(views, depths)])


def _corners(box: AnyBox) -> str:
    return " to ".join("(" + ", ".join(f"{x:.3g}" for x in c) + ")" for c in (box.lower, box.upper))


def _up(up: Up) -> str:
    """What is known of up, and what to do where it is not +z."""
    if not up.sure:
        return f"the cameras do not agree on what is up (rolled by {up.roll:.0f} degrees, median)"
    off = float(np.degrees(np.arccos(np.clip(up.direction[2], -1, 1))))
    if off <= _LEVEL:
        return f"up is +z to {off:.1f} degrees ({up})"
    direction = ", ".join(f"{x:.2f}" for x in up.direction)
    return (
        f"up is ({direction}), {off:.0f} degrees from +z, which it is for tracking ({up}); --coordinates upright turns "
        "the place"
    )


def _unit(posed: PosedImages, views: list[View], box: AnyBox, scale: float) -> str:
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
