"""Attention shares of areas and shapes for the viewer, first preliminary ones and then final ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from nerg_mi.aoi.attention import compute_shares, make_shape_aois
from nerg_mi.aoi.placed import MARGIN, Aoi, BoxAoi
from nerg_mi.aoi.shares import COARSE, SummationRule
from nerg_mi.environment.scene import Scene
from nerg_mi.formats.boxes import Region

SHAPES_PER_STEP = 16
"""Maximum number of shapes whose attention shares are computed in one step."""

PRELIMINARY_SHARE_RULE = SummationRule(rtol=1, atol=1)
"""Accuracy of the first attention shares."""


@dataclass(frozen=True)
class AttentionShare:
    """An attention ``share``, from 0 to 1, and the estimate of its maximum ``error``."""

    share: float
    error: float

    @property
    def is_final(self) -> bool:
        """Whether the error is within the tolerance."""
        return self.error <= COARSE.rtol * self.share + COARSE.atol


def iter_attention_shares(
    scene: Scene,
    observer: np.ndarray,
    regions: Sequence[Region],
    shapes: Sequence[str],
    shape_aois: Sequence[Aoi] | None = None,
) -> Iterator[dict[str, AttentionShare]]:
    """Compute the attention shares of areas and shapes in steps: first preliminary ones, then within `COARSE`.

    Parameters
    ----------
    scene : Scene
        The scene, with a gaze field.
    observer : ndarray of shape (3,)
        Position of the observer in scene units.
    regions : sequence of Region
        Areas of interest.
    shapes : sequence of str
        Ids of meshes, which are seen from both sides.
    shape_aois : sequence of Aoi, optional
        The result of `make_shape_aois` for ``shapes``.

    Yields
    ------
    dict of str to AttentionShare
        Shares of the observer's gaze by name.
    """
    areas = [(region.name, BoxAoi(region), MARGIN) for region in regions]
    meshes = make_shape_aois(scene, shapes) if shape_aois is None else shape_aois
    groups = [areas] if areas else []
    groups += [
        [(name, aoi, 0.0) for name, aoi in zip(shapes[a : a + SHAPES_PER_STEP], meshes[a : a + SHAPES_PER_STEP])]
        for a in range(0, len(shapes), SHAPES_PER_STEP)
    ]
    position = np.asarray(observer, np.float32)[None]
    for rule in (PRELIMINARY_SHARE_RULE, COARSE):
        for group in groups:
            shares = compute_shares(scene, [aoi for _, aoi, _ in group], position, margin=group[0][2], rule=rule)
            yield {
                name: AttentionShare(share, error)
                for (name, *_), share, error in zip(group, shares.share[0].tolist(), shares.error[0].tolist())
            }
