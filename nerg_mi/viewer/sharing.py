"""Shares of attention of named areas and shapes, in steps between which other work is done."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from nerg_mi.api.attention import box_shares, mesh_shares
from nerg_mi.api.scene import Scene
from nerg_mi.formats.regions import Region
from nerg_mi.statistics.shares import ROUGH

from .refining import rough_integrals

FACES = 1 << 17
"""Faces of shapes whose shares are counted in one step, but for a shape that has more."""


def shares_in_steps(
    scene: Scene, at: np.ndarray, regions: Sequence[Region], shapes: Sequence[str]
) -> Iterator[dict[str, float]]:
    """The share of the observer at ``at`` (3,) of each of ``regions``, together, then of the meshes whose ids are
    ``shapes``, so many at a time as a step can count."""
    if regions:
        boxes = box_shares(scene, regions, np.asarray(at, np.float32)[None], rule=ROUGH).share[0]
        yield dict(zip([region.name for region in regions], boxes.tolist()))
    for names in shape_groups(scene, shapes):
        with rough_integrals(scene):
            meshes = mesh_shares(scene, names, at, divisions=1, two_sided=True)
        yield dict(zip(names, meshes.tolist()))


def shape_groups(scene: Scene, shapes: Sequence[str]) -> Iterator[list[str]]:
    """The ids ``shapes`` in groups of `FACES` faces at most, but for a shape that has more by itself."""
    faces = {shape.id(): shape.face_count() for shape in scene.mitsuba.shapes() if shape.is_mesh()}
    group: list[str] = []
    for name in shapes:
        if group and sum(faces[n] for n in [*group, name]) > FACES:
            yield group
            group = []
        group.append(name)
    if group:
        yield group
