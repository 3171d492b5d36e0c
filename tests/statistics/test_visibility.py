"""What could be seen, and isovists, where both are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.errors import NergError
from nerg_mi.formats.areas import Region
from nerg_mi.maths.geometry import box_interval
from nerg_mi.statistics.visibility import CellsInView, Targets, in_view, isovists, standing, unhidden
from nerg_mi.statistics.visits import Box

ROOM = np.array([[0.0, 0, 0], [6, 4, 3]])
PILLAR = np.array([[2.0, 1.5, 0], [3, 2.5, 2.0]])


def room_depth(o, d):
    """A room with a pillar that reaches to 2 m."""
    reach = box_interval(o, d, *ROOM)[1]
    near, far = box_interval(o, d, *PILLAR)
    reach = np.where((near < far) & (far > 0) & (near > 0), np.minimum(near, reach), reach)
    # From within one meets the pillar's inner faces.
    return np.where((near < far) & (near <= 0) & (far > 0), np.minimum(far, reach), reach)


def thing(name, lower, upper):
    return Box(Region.of(name, lower, upper))


def test01_what_is_behind_a_pillar_is_hidden():
    things = [thing("near", [1.0, 1.9, 1], [1.2, 2.1, 1.2]), thing("behind", [4, 1.9, 1], [4.2, 2.1, 1.2])]
    targets = Targets.of(things, 24)
    eyes = np.array([[0.2, 2.0, 1.1], [3.5, 2.0, 1.1]])
    seen = unhidden(targets, eyes, room_depth, 0.0)
    by_thing = [[seen[e, targets.thing == k].any() for k in range(2)] for e in range(2)]
    assert by_thing == [[True, False], [False, True]]
    # A face that is turned away is not seen, whatever is between.
    back = (targets.normals[:, 0] > 0.5) & (targets.thing == 0)
    assert back.any() and not seen[0, back].any()


def test02_the_view_is_a_cone():
    targets = Targets.of([thing("a", [3.0, -0.05, -0.05], [3.1, 0.05, 0.05])], 6)
    eyes = np.zeros((4, 3))
    turns = np.radians([0, 29.0, 31.5, 180])
    ahead = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(4)])
    seen = np.ones((4, len(targets.points)), bool)
    assert in_view(targets, eyes, ahead, seen, 60.0)[:, 0].tolist() == [True, True, False, False]
    assert in_view(targets, eyes, ahead, seen, 360.0).all()
    assert not in_view(targets, eyes, ahead, ~seen, 360.0).any()


def test03_against_a_loop():
    rng = np.random.default_rng(0)
    things = [thing(str(k), c, c + 0.3) for k, c in enumerate(rng.uniform(0.2, 2.5, (5, 3)))]
    targets = Targets.of(things, 20)
    eyes, d = rng.uniform(0.2, 2.5, (30, 3)), rng.normal(size=(30, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    seen = rng.random((30, len(targets.points))) < 0.2
    found = in_view(targets, eyes, d, seen, 100.0)
    for i in range(30):
        for k in range(5):
            expected = False
            for s in np.flatnonzero(targets.thing == k):
                away = targets.points[s] - eyes[i]
                angle = np.degrees(np.arccos(np.clip(away @ d[i] / np.linalg.norm(away), -1, 1)))
                expected |= bool(seen[i, s]) and angle <= 50
            assert found[i, k] == expected


def test04_cells_are_traced_once_and_forgotten_without_harm():
    targets = Targets.of([thing("a", [4, 1.9, 1], [4.2, 2.1, 1.2])], 24)
    asked = []

    def depth(o, d):
        asked.append(len(o))
        return room_depth(o, d)

    cells = CellsInView(targets, depth, 0.1, 0.0)
    eyes = np.random.default_rng(1).uniform(0.1, 1.4, (50, 3))
    points, of = cells.seen(eyes)
    middle = (np.floor(eyes / 0.1) + 0.5) * 0.1
    assert np.array_equal(points[of], unhidden(targets, middle, room_depth, 0.0))
    before = len(asked)
    assert np.array_equal(cells.seen(eyes[:9])[0][cells.seen(eyes[:9])[1]], points[of][:9]) and len(asked) == before
    cells.MOST = 0
    cells.seen(eyes[:2])
    again, whose = cells.seen(eyes)
    assert np.array_equal(again[whose], points[of]) and len(asked) > before
    with pytest.raises(NergError, match="--cell"):
        CellsInView(targets, depth, 0.0, 0.0)


def test05_the_isovist_of_a_room_is_its_floor():
    empty = lambda o, d: box_interval(o, d, *ROOM)[1]
    found = isovists(np.array([[1.0, 1, 1.6], [3, 2, 1.6]]), empty, Targets.of([], 4), 0.0, 100.0, directions=7200)
    assert np.allclose(found.area, 24, rtol=2e-3) and np.allclose(found.perimeter, 20, rtol=2e-3)
    assert np.allclose(found.nearest, [1, 2], atol=1e-3)
    assert np.allclose(found.farthest, [np.hypot(5, 3), np.hypot(3, 2)], rtol=1e-3)


def test06_a_pillar_takes_its_shadow():
    # From (1, 2): the pillar from y 1.5 to 2.5 at x = 2 hides the strip between the lines through its corners.
    found = isovists(np.array([[1.0, 2.0, 1.6]]), room_depth, Targets.of([], 4), 0.0, 100.0, directions=14400)
    # Lines of slope 1/2 from the eye meet the walls y = 0 and 4 at x = 5, and x = 6 beyond these: the shadow is the
    # region |y - 2| < (x - 1) / 2, 2 < x, within the room: a trapezium to x = 5 and a rectangle behind.
    shadow = (1 + 4) / 2 * 3 + 4 * 1
    assert found.area[0] == pytest.approx(24 - shadow, rel=3e-3)


def test07_where_one_can_stand():
    found = standing(*ROOM, 0.5, 1.6, room_depth, 0.0)
    assert len(found) == 12 * 8 - 4 and np.allclose(found[:, 2], 1.6)
    inside = ((found[:, :2] > PILLAR[0, :2]) & (found[:, :2] < PILLAR[1, :2])).all(axis=1)
    assert not inside.any()
    # Above a low thing nobody stands either, since the floor is not below; there is no floor at -1.
    low = lambda o, d: np.minimum(room_depth(o, d), np.where((d[:, 2] < 0) & (o[:, 0] < 1), o[:, 2] - 0.5, np.inf))
    assert (standing(*ROOM, 0.5, 1.6, low, 0.0)[:, 0] > 1).all()
    assert len(standing(*ROOM, 0.5, 1.6, room_depth, -1.0)) == 0
    with pytest.raises(NergError, match="--step"):
        standing(*ROOM, 1e-4, 1.6, room_depth, 0.0)
