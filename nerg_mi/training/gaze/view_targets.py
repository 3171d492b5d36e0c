"""From salience images to targets: each view is an observer at the camera's centre who is known in part.

What a view says holds within its frustum alone. Its directions are of equal area there, its truth is the density given
that the picture is looked at, and what is trained is the field's density given the same: normalised over the view, not
over the sphere. How much is looked outside of a picture, views say together: each surface is in many of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nerg_mi.photos.salience import SalienceView
from nerg_mi.training.geometry.places import GazePlace

from .blind import blind_of_views
from .settings import ProbeSettings
from .targets import TargetNeeds, Targets, observe

# Directions a pixel of a view, so that hardly any is left out.
_PER_PIXEL = 4


def targets_of_views(
    views: Sequence[SalienceView],
    place: GazePlace,
    settings: ProbeSettings,
    needs: TargetNeeds | None = None,
    seed: int = 0,
) -> Targets:
    """Targets of ``views`` in the frame of ``place``.

    ``settings.directions`` directions a view, each with the density of the pixel that it lies in; pixels are joined
    until each has some four. With ``settings.fresh`` the targets can ``renew`` their directions.
    """
    needs, count = needs or TargetNeeds(), settings.directions
    small = [v.reduced(max(1, count // _PER_PIXEL)) for v in views]

    def drawn(seed: int | tuple[int, int]) -> Targets:
        rng = np.random.default_rng(seed)
        directions, truth = np.empty((len(views), count, 3)), np.empty((len(views), count))
        for k, view in enumerate(small):
            directions[k], pixels = view.draw(count, rng)
            truth[k] = view.density.ravel()[pixels]
        extent = np.array([v.extent for v in views])
        truth /= truth.mean(axis=1, keepdims=True) * extent[:, None]
        positions = np.array([v.camera.center for v in views])
        targets = observe(positions, directions, truth, place, settings.depth, needs)
        return replace(targets, extent=extent.astype(np.float32))

    targets = drawn(seed)
    if settings.fresh:
        targets = replace(targets, renew=lambda epoch: drawn((seed, epoch)))
    return replace(targets, blind=blind_of_views(views, needs.blind_rows)) if needs.blind_rows else targets
