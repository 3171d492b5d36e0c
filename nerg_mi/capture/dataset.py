"""A posed image set made ready: training views, held-out views and the scene box."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..field.box import Box
from ..formats.transforms import Transforms, find_transforms, read_transforms
from .bounds import scene_box
from .images import View, describe_missing, load_views, split_holdout

# A surface on a face of the box needs cells behind it: rays end at the box, and a half step before it nothing can absorb.
_PAD = 1 / 80


@dataclass(frozen=True)
class Dataset:
    """``train``, ``held_out``: views in the data set's own coordinates; ``box``: where density may be, and ``box_from``
    how that was found; ``missing``: a sentence about listed images that do not exist, or None; ``source``: for
    provenance."""

    train: list[View]
    held_out: list[View]
    box: Box
    box_from: str
    missing: str | None
    source: dict


def open_dataset(
    path: str | Path, holdout: int | None = None, width: int | None = None, downscale: float | None = None,
    aabb: tuple | None = None, depth: bool = True,
) -> Dataset:
    """Read the data set ``path`` (a folder or its transforms file).

    ``holdout``: hold out every so many frames, 0 none; None holds out the frames of a ``transforms_test.json`` beside
    the file, all others training, or every 8th where there is none. ``width``, ``downscale``: size of the
    pictures. ``aabb``: six numbers x0, y0, z0, x1, y1, z1 bounding what is seen; else "aabb" of the file, else
    a guess from the cameras. ``depth``: read the depth files that the frames name.
    """
    transforms = read_transforms(find_transforms(path))
    test = transforms.path.with_name("transforms_test.json")
    own_test = holdout is None and test.is_file() and test != transforms.path
    if own_test:
        frames, held, how = transforms.frames, read_transforms(test).frames, test.name
    else:
        every = 8 if holdout is None else holdout
        frames, held = split_holdout(transforms.frames, every)
        how = f"every {every}th frame" if every else "none"
    train = load_views(frames, width, downscale, depth)
    box, box_from = _box(transforms, train, aabb)
    source = {
        "dataset": transforms.path.resolve().parent.name,
        "transforms": transforms.path.name,
        "sha256": transforms.sha256,
        "training_frames": len(frames),
        "held_out": {"how": how, "frames": [f.name for f in held]},
        "width": train[0].color.shape[1],
        "height": train[0].color.shape[0],
    }
    return Dataset(train, load_views(held, width, downscale, depth), box, box_from, describe_missing(transforms), source)


def _box(transforms: Transforms, views: list[View], aabb) -> tuple[Box, str]:
    if aabb is not None:
        if len(aabb) != 6:
            raise ValueError(f"aabb needs the six numbers x0,y0,z0,x1,y1,z1, got {len(aabb)}")
        given, how = np.reshape(np.asarray(aabb, float), (2, 3)), "as given"
    elif transforms.aabb is not None:
        given, how = transforms.aabb, f'"aabb" of {transforms.path.name}'
    else:
        return scene_box([v.camera for v in views], object_only=all(v.has_alpha for v in views))
    tight = Box(tuple(given[0]), tuple(given[1]))
    pad = _PAD * tight.side
    return Box(tuple(given[0] - pad), tuple(given[1] + pad)), f"{how}, grown by {pad:.3g} on every side"
