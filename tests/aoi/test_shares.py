"""Attention shares of analytic gaze densities in a hall with closed-form depths."""

from __future__ import annotations

import numpy as np
import pytest

from nerg_mi.aoi.placed import BoxAoi, assign_hits
from nerg_mi.aoi.shares import (
    COARSE,
    INITIAL_DIRECTIONS,
    SamplePoints,
    SummationRule,
    VisibilityCache,
    _AdaptiveSums,
    compute_visibility,
    find_standing_positions,
    gaze_shares,
    visible_in_fov,
)
from nerg_mi.errors import NergError
from nerg_mi.formats.boxes import Region
from nerg_mi.maths.geometry import intersect_box_numpy
from nerg_mi.maths.sphere import fibonacci_directions, indices_in_cone
from tests.refusals import mentions

LOW, HIGH = np.array([-2.0, -6.0, 0.0]), np.array([2.0, 6.0, 3.0])
AHEAD = np.array([0.6, 0.8, 0.0])
OBSERVERS = np.array([[0.3, -2.0, 1.6], [-1.0, 4.0, 1.5]])
BOXES = [
    Region.create("wall", (1.9, -3, 0), (2.1, 1, 2)),
    Region.create("a spot on it", (1.9, -0.01, 1), (2.1, 0.02, 1.03)),
    Region.create("corner", (1, 5, -0.1), (2.1, 6.1, 0.7), 10),
    Region.create("air", (0.5, 1, 1), (0.7, 1.2, 1.3)),
]


class Hall:
    """Observers who mostly look ahead; ``requested``: the number of directions of each evaluation."""

    def __init__(self):
        self.requested: list[int] = []

    def query_from(self, eye):
        def look(d):
            self.requested.append(len(d))
            with np.errstate(divide="ignore"):
                far = np.where(d > 0, (HIGH - eye) / d, np.where(d < 0, (LOW - eye) / d, np.inf)).min(axis=1)
            # The roof is open.
            far = np.where(eye[2] + far * d[:, 2] > 2.999, np.inf, far)
            return np.exp(4 * (d @ AHEAD - 1))[None], far

        return look


def exact(eye, region=None):
    """Integrals of the gaze on a box or of escaped gaze, and of all gaze, by sums over very many directions."""
    count, numbers = 1 << 18, None
    if region is not None:
        center, radius = BoxAoi(region).bounding_sphere
        away = center - eye
        # A few hundred thousand directions on the box.
        count = 1 << 23 if radius < 0.2 else count
        numbers = indices_in_cone(count, away / np.linalg.norm(away), np.arcsin(min(radius / np.linalg.norm(away), 1)))
    d = fibonacci_directions(count, numbers)
    (gaze,), depth = Hall().query_from(eye)(d)
    if region is None:
        return gaze[~np.isfinite(depth)].sum() / gaze.sum(), gaze.mean()
    return gaze[assign_hits([BoxAoi(region)], np.broadcast_to(eye, d.shape), d, depth).rows[0]].sum() / count


@pytest.fixture(scope="module")
def result():
    hall = Hall()
    members = [(0,), (1,), (2,), (3,), (0, 1, 2)]
    return hall, gaze_shares(hall.query_from, OBSERVERS, [BoxAoi(r) for r in BOXES], members, 0.0)


def test_shares_are_integrals_within_the_error(result):
    hall, shares = result
    for e, eye in enumerate(OBSERVERS):
        escaped, whole_result = exact(eye)
        for k, region in enumerate(BOXES):
            share = exact(eye, region) / whole_result
            assert abs(shares.share[e, k] - share) <= 1.5 * shares.error[e, k] + 1e-6 and share < 1
            assert shares.error[e, k] < 0.02 * share + 2e-5
            assert shares.is_hit[e, k] == (share > 0)
        assert shares.escaped[e] == pytest.approx(escaped, rel=0.01)
    # A group is a union: the spot is on the wall.
    assert np.allclose(shares.share[:, 4], shares.share[:, 0] + shares.share[:, 2], rtol=0.02)
    # The spot, 3 cm at up to six metres, needs no more directions than the whole sphere.
    assert 0 < shares.share[1, 1] < 1e-4 and sum(hall.requested) < 2 * 6 * INITIAL_DIRECTIONS


def test_observers_are_independent(result):
    _, shares = result
    alone = gaze_shares(Hall().query_from, OBSERVERS[1:], [BoxAoi(BOXES[0])], [(0,)], 0.0)
    assert alone.share[0, 0] == shares.share[1, 0] and alone.error[0, 0] == shares.error[1, 0]
    many = gaze_shares(Hall().query_from, np.tile(OBSERVERS, (20, 1)), [BoxAoi(BOXES[0])], [(0,)], 0.0)
    assert np.array_equal(many.share[:, 0], np.tile(shares.share[:, 0], 20))


def test_smaller_tolerance_uses_more_directions():
    errors, requested = [], []
    for tolerance in (0.1, 0.01, 0.001):
        hall = Hall()
        shares = gaze_shares(
            hall.query_from, OBSERVERS[:1], [BoxAoi(BOXES[0])], [(0,)], 0.0, SummationRule(rtol=tolerance)
        )
        errors.append(shares.error[0, 0])
        requested.append(sum(hall.requested))
    assert errors[0] > errors[2] and requested[0] < requested[2] < 1 << 19


def test_coarse_shares_of_many_areas_need_few_directions():
    hall = Hall()
    tiles = [Region.create("tile", (1.9, y, z), (2.1, y + 1, z + 1)) for y in range(-6, 6) for z in range(3)]
    aois, members = [BoxAoi(tile) for tile in tiles], [(k,) for k in range(len(tiles))]
    shares = gaze_shares(hall.query_from, OBSERVERS[:1], aois, members, 0.0, COARSE)
    assert (shares.error <= COARSE.rtol * shares.share + COARSE.atol).all()
    assert sum(hall.requested) < 4 * INITIAL_DIRECTIONS
    fine = gaze_shares(Hall().query_from, OBSERVERS[:1], aois, members, 0.0)
    assert (np.abs(shares.share - fine.share) <= shares.error + fine.error).all()
    is_visible = fine.share > 1e-3
    assert np.abs(shares.share / fine.share - 1)[is_visible].max() < 0.1 and is_visible.any()


@pytest.mark.nightly
def test_errors_of_thin_areas_are_maximum_errors():
    """Stripes of 2 mm on the wall, thinner than the spacing of the directions, which meet them at random. Errors from
    the scatter alone are exceeded up to twice."""
    rng = np.random.default_rng(1)
    stripes = []
    for _ in range(40):
        y, z = rng.uniform(-4, 4), rng.uniform(0.2, 1.5)
        region = Region.create("stripe", (1.99, y, z), (2.01, y + 0.002, z + rng.uniform(0.3, 1.2)))
        stripes.append(BoxAoi(region))
    members = [(k,) for k in range(len(stripes))]
    coarse, fine = (
        gaze_shares(Hall().query_from, OBSERVERS, stripes, members, 0.0, rule)
        for rule in (COARSE, SummationRule(rtol=1e-3, atol=1e-6))
    )
    assert (fine.share > 0).all() and (np.abs(coarse.share - fine.share) <= coarse.error).all()


def test_empty_inputs():
    shares = gaze_shares(Hall().query_from, OBSERVERS, [], [], 0.0)
    assert shares.share.shape == (2, 0) and (shares.integral > 0).all()
    assert gaze_shares(Hall().query_from, OBSERVERS[:0], [BoxAoi(BOXES[0])], [(0,)], 0.0).share.shape == (0, 1)
    dark = lambda eye: lambda d: (np.zeros((1, len(d))), np.ones(len(d)))
    assert gaze_shares(dark, OBSERVERS[:1], [BoxAoi(BOXES[0])], [(0,)], 0.0).share.tolist() == [[0.0]]
    broken = lambda eye: lambda d: (np.full((1, len(d)), np.nan), np.ones(len(d)))
    with pytest.raises(NergError, match="0.3.*2.0.*1.6"):
        gaze_shares(broken, OBSERVERS[:1], [BoxAoi(BOXES[0])], [(0,)], 0.0)


# ---- Visibility ----

ROOM = np.array([[0.0, 0, 0], [6, 4, 3]])
PILLAR = np.array([[2.0, 1.5, 0], [3, 2.5, 2.0]])


def room_depth(o, d):
    """A room with a pillar of 2 m height."""
    extent = intersect_box_numpy(o, d, *ROOM)[1]
    near, far = intersect_box_numpy(o, d, *PILLAR)
    extent = np.where((near < far) & (far > 0) & (near > 0), np.minimum(near, extent), extent)
    # From the inside, rays meet the inner faces of the pillar.
    return np.where((near < far) & (near <= 0) & (far > 0), np.minimum(far, extent), extent)


def aoi(name, lower, upper):
    return BoxAoi(Region.create(name, lower, upper))


def test_points_behind_a_pillar_are_hidden():
    aois = [aoi("near", [1.0, 1.9, 1], [1.2, 2.1, 1.2]), aoi("behind", [4, 1.9, 1], [4.2, 2.1, 1.2])]
    targets = SamplePoints.sample(aois, 24)
    observers = np.array([[0.2, 2.0, 1.1], [3.5, 2.0, 1.1]])
    seen = compute_visibility(targets, observers, room_depth, 0.0)
    by_thing = [[seen[e, targets.aoi_index == k].any() for k in range(2)] for e in range(2)]
    assert by_thing == [[True, False], [False, True]]
    # Back faces are not visible.
    back = (targets.normals[:, 0] > 0.5) & (targets.aoi_index == 0)
    assert back.any() and not seen[0, back].any()


def test_field_of_view_is_a_cone():
    targets = SamplePoints.sample([aoi("a", [3.0, -0.05, -0.05], [3.1, 0.05, 0.05])], 6)
    observers = np.zeros((4, 3))
    turns = np.radians([0, 29.0, 31.5, 180])
    ahead = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(4)])
    seen = np.ones((4, len(targets.points)), bool)
    assert visible_in_fov(targets, observers, ahead, seen, 60.0)[:, 0].tolist() == [True, True, False, False]
    assert visible_in_fov(targets, observers, ahead, seen, 360.0).all()
    assert not visible_in_fov(targets, observers, ahead, ~seen, 360.0).any()


def test_visibility_matches_a_loop():
    rng = np.random.default_rng(0)
    aois = [aoi(str(k), c, c + 0.3) for k, c in enumerate(rng.uniform(0.2, 2.5, (5, 3)))]
    targets = SamplePoints.sample(aois, 20)
    observers, d = rng.uniform(0.2, 2.5, (30, 3)), rng.normal(size=(30, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    seen = rng.random((30, len(targets.points))) < 0.2
    result = visible_in_fov(targets, observers, d, seen, 100.0)
    for i in range(30):
        for k in range(5):
            expected = False
            for s in np.flatnonzero(targets.aoi_index == k):
                away = targets.points[s] - observers[i]
                angle = np.degrees(np.arccos(np.clip(away @ d[i] / np.linalg.norm(away), -1, 1)))
                expected |= bool(seen[i, s]) and angle <= 50
            assert result[i, k] == expected


def test_visibility_cache():
    targets = SamplePoints.sample([aoi("a", [4, 1.9, 1], [4.2, 2.1, 1.2])], 24)
    requested = []

    def depth(o, d):
        requested.append(len(o))
        return room_depth(o, d)

    cells = VisibilityCache(targets, depth, 0.1, 0.0)
    observers = np.random.default_rng(1).uniform(0.1, 1.4, (50, 3))
    points, index = cells.get_visibility(observers)
    middle = (np.floor(observers / 0.1) + 0.5) * 0.1
    assert np.array_equal(points[index], compute_visibility(targets, middle, room_depth, 0.0))
    before = len(requested)
    assert (
        np.array_equal(
            cells.get_visibility(observers[:9])[0][cells.get_visibility(observers[:9])[1]], points[index][:9]
        )
        and len(requested) == before
    )
    cells.MAX_BYTES = 0
    cells.get_visibility(observers[:2])
    again, whose = cells.get_visibility(observers)
    assert np.array_equal(again[whose], points[index]) and len(requested) > before
    with pytest.raises(NergError, match="cell"):
        VisibilityCache(targets, depth, 0.0, 0.0)


def test_standing_positions():
    result = find_standing_positions(*ROOM, 0.5, 1.6, room_depth, 0.0)
    assert len(result) == 12 * 8 - 4 and np.allclose(result[:, 2], 1.6)
    inside = ((result[:, :2] > PILLAR[0, :2]) & (result[:, :2] < PILLAR[1, :2])).all(axis=1)
    assert not inside.any()
    # There is no standing position above a low object, and none for a floor at -1.
    low = lambda o, d: np.minimum(room_depth(o, d), np.where((d[:, 2] < 0) & (o[:, 0] < 1), o[:, 2] - 0.5, np.inf))
    assert (find_standing_positions(*ROOM, 0.5, 1.6, low, 0.0)[:, 0] > 1).all()
    assert len(find_standing_positions(*ROOM, 0.5, 1.6, room_depth, -1.0)) == 0
    with pytest.raises(NergError, check=mentions("grid_step")):
        find_standing_positions(*ROOM, 1e-4, 1.6, room_depth, 0.0)


def test_errors_of_shares_contain_that_of_the_whole_integral(monkeypatch):
    """A share is a / b, so its error is that of a over b, and the share times that of b over b, in quadrature."""
    sums = object.__new__(_AdaptiveSums)
    sums.observers, sums.seen = np.zeros((1, 3)), np.ones((1, 1), bool)
    sums.distance, sums.escaped = np.zeros((1, 1)), np.zeros(1)
    monkeypatch.setattr(sums, "_integrals", lambda: (np.array([[[0.5, 2.0]]]), np.array([[0.01, 0.3]])))
    shares = sums.shares()
    assert shares.share[0, 0] == pytest.approx(0.25)
    assert shares.error[0, 0] == pytest.approx(np.hypot(0.01 / 2, 0.25 * 0.3 / 2))
