"""What is learnt from: at least something, told apart by digests, and its support."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.maths.geometry import Similarity
from nerg_mi.train.gaze_data import Supervision, digest_rays, digest_views
from nerg_mi.train.geometry import GazePlace

from .looks import BOX, NOWHERE, RAYS, looking_at
from .views import around


def test_there_is_something_to_learn_from():
    assert Supervision(None, around(1)).views[0].name == "v0"
    with pytest.raises(ValueError, match="rays, from views"):
        Supervision(None)


def test_digests_tell_rays_and_views_apart():
    assert digest_views(around(3)) == digest_views(around(3)) != digest_views(around(3, seed=1))
    assert digest_views([]) is None
    moved = replace(RAYS, origin=RAYS.origin + 1e-6)
    later = replace(RAYS, t=RAYS.t + 1)
    assert digest_rays(RAYS) == digest_rays(later) != digest_rays(moved)
    both = Supervision(RAYS, around(3)).digest()
    assert both == {"rays": digest_rays(RAYS), "views": digest_views(around(3))}
    assert Supervision(None, around(3)).digest()["rays"] is None


def test_the_support_is_of_all_rays_in_the_frame_of_the_place():
    rays = looking_at((1.5, 0, 1.2))
    double = GazePlace(None, BOX, "none", align=Similarity([[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]))
    plain, moved = (Supervision(rays).support(0.5, place) for place in (NOWHERE, double))
    assert plain.radius == 0.5 and moved.radius == pytest.approx(1.0)
    assert plain.cells[:, 3].sum() == moved.cells[:, 3].sum() == 400
    np.testing.assert_allclose(moved.cells[:, :3], plain.cells[:, :3] * 2 + [1, 0, 0], atol=1e-5)
    assert Supervision(None, around(1)).support(0.5, NOWHERE) is None
