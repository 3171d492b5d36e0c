"""What a training leaves out: positions and people of a test, zones of a validation, views near either."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.maths.geometry import Similarity
from nerg_mi.train.gaze_data import Supervision, far_views, hold_out, split_validation, split_views
from nerg_mi.train.gaze_settings import GazeSettings
from nerg_mi.train.geometry import GazePlace

from .looks import BOX, NOWHERE, PROBES, RAYS, looking_at
from .views import around, lobe, view


def test_held_out_positions_are_purged():
    rays = looking_at((1.5, 0, 1.2), 3000, spread=6.0)
    kept, account = hold_out(rays, 0.25, zones=2, positions=10, min_rays=8)
    centres = np.array(account["centres"])
    apart = np.linalg.norm(kept.origin[:, None] - centres[None], axis=2)
    assert apart.min() > 0.5 and len(kept) == account["rays_to_train"] < len(rays)
    assert json.loads(json.dumps(account)) == account


def test_people_and_positions_are_held_out():
    rays = looking_at((1.5, 0, 1.2), 4000, spread=6.0)
    kept, account = hold_out(rays, 0.25, zones=2, positions=10, min_rays=8, people=0.5)
    assert len(account["people"]) == 1 and set(np.unique(kept.person)) == {1 - rays.persons.index(account["people"][0])}
    assert np.linalg.norm(kept.origin[:, None] - np.array(account["centres"])[None], axis=2).min() > 0.5


def test_watched_views_are_far_from_the_others():
    views = around(80)
    learn, watched = split_views(views, 3, 0.3, seed=4)
    assert 8 <= len(watched) <= 12 and len(learn) < 80 - len(watched)
    centres = np.array([v.camera.center for v in watched])
    assert all(np.linalg.norm(centres - v.camera.center, axis=1).min() > 0.3 for v in learn)
    with pytest.raises(ValueError, match="--zones"):
        split_views(views, 3, 5.0)
    moved = Similarity([[2, 0, 0, 1], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]])
    at = (views[0].camera.center - [1, 0, 0]) / 2
    near = far_views(views, at[None] @ moved.matrix[:3, :3].T + moved.matrix[:3, 3], 0.1 * moved.scale)
    assert views[0] not in near and far_views(near, views[0].camera.center[None], 0.2) == near


def in_a_row(count):
    """Cameras a metre apart, on a line."""
    return [view(lobe, (float(k), 0, 1.6), (0, 1, 0), name=f"v{k}") for k in range(count)]


@pytest.mark.parametrize("seed", range(12))
def test_zones_lie_far_from_one_another(seed):
    """Of two, the second is around one of the quarter of the views that is farthest from the first; an eighth is
    watched."""
    views = in_a_row(40)
    learn, watched = split_views(views, 2, 0.5, seed)
    at = sorted(int(v.name[1:]) for v in watched)
    assert {int(v.name[1:]) for v in learn} == set(range(40)) - set(at)
    gap = int(np.argmax(np.diff(at)))
    groups = [at[: gap + 1], at[gap + 1 :]]
    assert [len(g) for g in groups] == [2, 2] and all(np.ptp(g) == 1 for g in groups)
    apart = [abs(k - groups[0][0]) for k in range(40)], [abs(k - groups[1][0]) for k in range(40)]
    far = lambda of, group: max(of[k] for k in group) >= sorted(of)[-10] - 1
    assert far(apart[0], groups[1]) or far(apart[1], groups[0])


@pytest.mark.parametrize("seed", range(8))
def test_of_few_views_the_farthest_is_the_second_zone(seed):
    learn, watched = split_views(in_a_row(7), 2, 0.5, seed)
    at = sorted(int(v.name[1:]) for v in watched)
    assert len(at) == 2 and len(learn) == 5 and (at[0] == 0 or at[1] == 6)
    # From either one the other is the farthest, or the other way round.
    assert at[1] - at[0] == max(at[0], 6 - at[0]) or at[1] - at[0] == max(at[1], 6 - at[1])


def test_as_many_views_must_be_left_as_a_quarter():
    views = in_a_row(12)
    for distance in np.arange(0.5, 12.0):
        try:
            learn, _ = split_views(views, 1, distance, 3)
        except ValueError:
            break
        assert len(learn) >= 3
    left = len(far_views(views, np.array([v.camera.center for v in split_views(views, 1, 0.5, 3)[1]]), distance))
    assert left < 3


def test_without_zones_everything_is_learnt_from():
    supervision = Supervision(RAYS)
    split = split_validation(supervision, NOWHERE, GazeSettings(steps=1, zones=0), PROBES)
    assert split.learn is supervision and split.watched is None and split.rays_held_out == 0


def test_zones_of_rays_are_watched_with_all_rays_around_them():
    double = GazePlace(None, BOX, "none", align=Similarity(np.diag([2.0, 2, 2, 1])))
    settings = GazeSettings(steps=1, zones=2, watched=6)
    for place in (NOWHERE, double):
        eyes = place.points_from_rays(RAYS.origin[::60])
        views = [view(lobe, eye, (1, 0, 0), name=f"v{k}") for k, eye in enumerate(eyes)]
        split = split_validation(Supervision(RAYS, views), place, settings, PROBES)
        apart = np.linalg.norm(split.learn.rays.origin[:, None] - split.centres, axis=2)
        assert apart.min() > 2 * PROBES.radius and split.rays_held_out == len(RAYS) - len(split.learn.rays) > 0
        assert split.watched.rays is RAYS and not split.watched.views
        near = place.points_from_rays(split.centres)
        left = {v.name for v in split.learn.views}
        for v in views:
            far = np.linalg.norm(near - v.camera.center, axis=1).min() > 2 * PROBES.radius * place.align.scale
            assert (v.name in left) == far
        assert split.views_held_out == len(views) - len(left) >= 2


def test_of_views_alone_some_are_watched():
    split = split_validation(
        Supervision(None, around(80)), NOWHERE, GazeSettings(steps=1, zones=3), replace(PROBES, radius=0.15)
    )
    assert split.learn.rays is None and split.watched.rays is None and split.centres is None
    assert split.views_held_out == 80 - len(split.learn.views) >= len(split.watched.views) > 0
