"""Tests of `nerg_mi.aoi.predicted`."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from nerg_mi.aoi.areas import AreaGroup, Areas
from nerg_mi.aoi.changes import open_changes
from nerg_mi.aoi.placed import open_placed_areas
from nerg_mi.aoi.predicted import (
    PredictedAttention,
    Viewpoints,
    add_uncertainty,
    aggregate_by_participant,
    median_support,
    place_observers_on_floor,
    predict_attention,
    subsample_participants,
    viewpoints_at,
    warn_few_viewpoints,
    warn_missing_support,
    what_if_rows,
)
from nerg_mi.aoi.settings import AoiSampling, ObserverGrid
from nerg_mi.aoi.tables import MIN_VIEWPOINTS, MinParticipantsFilter
from nerg_mi.aoi.visits import ALL, Cell
from nerg_mi.environment.sampler import GazeSampler
from nerg_mi.errors import NergError
from nerg_mi.formats.boxes import Region
from nerg_mi.progress import SILENT
from nerg_mi.transport.geometry import SceneGeometry
from tests.notes import find_wrong_notes
from tests.recorder import Recorder

from .place import write_place

# ---- Predictions against sums over directions ----


class Law(GazeSampler):
    """Gaze that is twice as dense ahead (x > 0) as behind, with a support of seven samples."""

    def __init__(self):
        gaze = SimpleNamespace(field=SimpleNamespace(basis=None))
        super().__init__(gaze, SceneGeometry(None), None)

    def query_from(self, eye):
        return lambda d: (np.where(d[:, 0] > 0, 2.0, 1.0)[None], None)

    def support_at(self, eye):
        return 7.0

    def describe_extrapolation(self, observers):
        return ""


AHEAD = Region.create("ahead", [1, -1, -1], [2, 1, 1])
BEHIND = Region.create("behind", [-2, -1, -1], [-1, 1, 1])


def predict(*areas, sampler=None, scale=1.0, directions=1 << 15):
    """Predict the attention of `OBSERVERS` on ``areas``."""
    placed = open_placed_areas(None, None, Areas(areas), np.diag([scale, scale, scale, 1]))
    sampling = AoiSampling(margin=0.0, aoi_samples=24, directions=directions)
    return predict_attention(replace(placed, sampler=sampler or Law(), sampling=sampling), OBSERVERS, 120.0)


OBSERVERS = Viewpoints(
    np.array([[0.0, 0, 0], [0, 0, 0.2], [0, 0, 0]]),
    np.tile([1.0, 0, 0], (3, 1)),
    ("Ada", "Ada", "Bo"),
    (frozenset([ALL]), frozenset([ALL]), frozenset([ALL, Cell("zone", "z")])),
)


def test_shares_are_integrals():
    # A cube with a visible face of 2 x 2 at x = 1: a sixth of the sphere, and 2/3 of the gaze of the hemisphere.
    areas = AHEAD, BEHIND, AreaGroup("both", ("ahead", "behind"))
    result = predict(*areas)
    assert np.allclose(result.share[0], [2 / 9, 1 / 9, 3 / 9], rtol=2e-3)
    # Mean distance to a square face over its solid angle, by quadrature in its plane.
    u = (np.arange(400) + 0.5) / 200 - 1
    y, z = np.meshgrid(u, u)
    r2 = 1 + y**2 + z**2
    mean = (r2**-1.5 * np.sqrt(r2)).sum() / (r2**-1.5).sum()
    assert result.distance[0, 0] / result.share[0, 0] == pytest.approx(mean, rel=2e-3)
    assert result.visible.tolist() == [[True, False, True]] * 3 and result.support.tolist() == [7, 7, 7]
    # Distances are in metres, of which a scene of twice the size has half as many.
    in_metres = predict(*areas, scale=2.0)
    np.testing.assert_allclose(in_metres.distance, result.distance / 2)
    np.testing.assert_allclose(in_metres.share, result.share)


def test_areas_hide_others_if_there_are_no_surfaces():
    result = predict(AHEAD, Region.create("hidden", [3, -0.5, -0.5], [4, 0.5, 0.5]))
    assert result.visible.tolist() == [[True, False]] * 3 and result.share[:, 1].tolist() == [0, 0, 0]


def test_prediction_is_aggregated_by_participant():
    result = predict(AHEAD, directions=4096)
    people = aggregate_by_participant(result, OBSERVERS, ALL, {"Ada": 3.0, "Bo": 6.0}, 0.3)
    assert people.names == ("Ada", "Bo")
    share = result.share[:2].mean(axis=0)
    assert people.dwell_time[0] == pytest.approx(3 * share)
    # Ten glances, five per viewpoint.
    missed = np.prod([(1 - s) ** 5 for s in result.share[:2, 0]])
    assert people.hit_probability[0, 0] == pytest.approx(1 - missed)
    (bo,) = aggregate_by_participant(result, OBSERVERS, Cell("zone", "z"), {"Bo": 6.0}, 0.3).names
    assert bo == "Bo" and aggregate_by_participant(result, OBSERVERS, Cell("zone", "other"), {"Bo": 6.0}, 0.3) is None


class Two(Law):
    """Two ensemble members that look in opposite directions, with densities in the ratio of ten to one."""

    def query_from(self, eye):
        return lambda d: (np.array([np.where(s * d[:, 0] > 0, 10.0, 1.0) for s in (1, -1)]), None)


def test_ensemble_members():
    result = predict(AHEAD, BEHIND, sampler=Two())
    # A sixth of the sphere each: equal for the mean, and 10/11 or 1/11 of a third of a hemisphere for one member.
    assert result.members.shape == (2, 3, 2) and np.allclose(result.share[0], 1 / 6, rtol=3e-3)
    assert np.allclose(result.members[:, 0], [[10 / 33, 1 / 33], [1 / 33, 10 / 33]], rtol=3e-3)
    assert predict(AHEAD, BEHIND, directions=64).members.shape == (1, 3, 2)


def test_participants_are_subsampled():
    names = tuple(f"{k // 2:04d}" for k in range(400))
    many = Viewpoints(np.arange(1200.0).reshape(400, 3), np.ones((400, 3)), names, (frozenset([ALL]),) * 400)
    recorder = Recorder()
    some = subsample_participants(many, 50, recorder)
    assert (
        len(set(some.participants)) == 50
        and len(some.participants) == 100
        and len(some.positions) == len(some.cells) == 100
    )
    assert all(
        (some.positions[k] == many.positions[names.index(n) + k % 2]).all() for k, n in enumerate(some.participants)
    )
    back = np.arange(400)[::-1]
    turned = subsample_participants(Viewpoints(many.positions[back], many.facing, names[::-1], many.cells), 50, SILENT)
    assert set(turned.participants) == set(some.participants) and subsample_participants(many, 200, SILENT) is many
    assert "50 of 200 participants" in recorder.messages[0]


# ---- Observers without recordings ----


def test_observers_are_placed_on_the_floor(tmp_path):
    placed = open_placed_areas(write_place(tmp_path, gaze=False), None, Areas(()))
    result = place_observers_on_floor(placed, ObserverGrid())
    inside = ((result[:, :2] > (2.5, 1.0)) & (result[:, :2] < (2.9, 2.0))).all(axis=1)
    assert 330 < len(result) < 24 * 16 and not inside.any() and np.allclose(result[:, 2], 1.6)
    with pytest.raises(NergError, match="floor"):
        place_observers_on_floor(placed, ObserverGrid(floor_height=-2.0))
    with pytest.raises(NergError, match="bounds of the scene"):
        place_observers_on_floor(open_placed_areas(None, None, Areas(())), ObserverGrid())


def test_observers_have_names():
    observers = viewpoints_at(np.zeros((12, 3)))
    assert observers.participants[0] == "observer 01" and len(set(observers.participants)) == 12


# ---- Uncertainty ----

ZONE = Cell("zone", "z")

TRUST_EYES = Viewpoints(
    np.zeros((3, 3)),
    np.ones((3, 3)),
    ("Ada", "Ada", "Bo"),
    (frozenset([ALL]), frozenset([ALL, ZONE]), frozenset([ALL])),
)

TIMES = {ALL: {"Ada": 2.0, "Bo": 6.0}, ZONE: {"Ada": 1.0}}


def make_prediction(*members, support=(1.0, 8.0, 3.0)):
    each = np.array(members, float)[:, :, None]
    return PredictedAttention(each.mean(axis=0), each.mean(axis=0), each.mean(axis=0) > 0, np.array(support), each)


def rows():
    both = [{"cell": "all", "value": ""}, {"cell": "zone", "value": "z"}]
    made = [c | {"aoi": "a", "source": s, "participants": 2} for c in both for s in ("measured", "predicted")]
    return [row | {"share": 0.1, "dwell": 1.0, "hit_ratio": 0.5} for row in made]


def test_uncertainty_of_each_cell():
    result = rows()
    add_uncertainty(result, make_prediction([0.1, 0.3, 0.4], [0.2, 0.2, 0.2]), TRUST_EYES, TIMES, 0.3)
    tracked, field, _, zone = result
    assert tracked["support"] is tracked["share_spread"] is None
    assert field["support"] == 3 and zone["support"] == 8
    assert (field["viewpoints"], zone["viewpoints"], tracked["viewpoints"]) == (1.5, 1.0, None)
    # Ada's mean and Bo's, of the first member 0.3 over both, of the second 0.2.
    assert field["share_spread"] == pytest.approx(0.1 / np.sqrt(2))
    assert field["dwell_spread"] == pytest.approx((0.2 * 2 + 0.4 * 6 - 0.2 * 2 - 0.2 * 6) / 2 / np.sqrt(2))
    assert zone["share_spread"] == pytest.approx(0.1 / np.sqrt(2)) and 0 < zone["hit_ratio_spread"] < 1
    assert tracked["note"] and not field["note"] and not zone["note"]


def test_uncertainty_is_none_for_single_fields_and_suppressed_rows():
    result = rows()
    add_uncertainty(result, make_prediction([0.1, 0.3, 0.4]), TRUST_EYES, TIMES, 0.3)
    assert all(row["share_spread"] is None for row in result)
    assert all("share_spread" in row["note"] for row in result) and result[0]["note"] != result[1]["note"]
    unknown = rows()
    add_uncertainty(unknown, make_prediction([0.1, 0.3, 0.4], support=(np.nan,) * 3), TRUST_EYES, TIMES, 0.3)
    assert all("support" in row["note"] for row in unknown)
    blank = [row | {"participants": None, "share": None} for row in rows()]
    add_uncertainty(blank, make_prediction([0.1, 0.3, 0.4], [0.2, 0.2, 0.2]), TRUST_EYES, TIMES, 0.3)
    assert all(row["share_spread"] is row["support"] is None for row in blank)
    assert blank[1]["dwell_spread"] is not None
    assert all("share_spread" in r["note"] and "viewpoints" in r["note"] for r in blank)
    assert "dwell_spread" not in blank[1]["note"]


def test_missing_support_is_reported():
    recorder = Recorder()
    warn_missing_support(make_prediction([0.1, 0.3, 0.4]), recorder)
    assert recorder.messages == []
    none = make_prediction([0.1, 0.3, 0.4], support=(np.nan,) * 3)
    assert median_support(none) is None and median_support(make_prediction([1, 1, 1]), np.zeros(3, bool)) is None
    warn_missing_support(none, recorder)
    assert "does not contain training support" in recorder.messages[0] and "nerg train gaze" in recorder.messages[0]


def test_few_viewpoints_are_reported():
    recorder = Recorder()
    warn_few_viewpoints(TRUST_EYES, recorder)
    assert (
        len(recorder.messages) == 1
        and "1.5 viewpoints per participant" in recorder.messages[0]
        and "viewpoints=32 " in recorder.messages[0]
    )
    count = 2 * MIN_VIEWPOINTS
    many = Viewpoints(
        np.zeros((count, 3)), np.ones((count, 3)), ("Ada", "Bo") * MIN_VIEWPOINTS, (frozenset([ALL]),) * count
    )
    warn_few_viewpoints(many, recorder)
    warn_few_viewpoints(Viewpoints(np.zeros((0, 3)), np.zeros((0, 3)), (), ()), recorder)
    assert len(recorder.messages) == 1


# ---- What-if table ----

AREAS = Areas((Region.create("a", [0, 0, 0], [1, 1, 1]), Region.create("b", [2, 0, 0], [3, 1, 1])))
WHAT_IF_EYES = viewpoints_at(np.arange(15.0).reshape(5, 3))


def texts(share, support=5.0, members=1):
    """Ensemble members differ from the first by 0.1 times their index at the first viewpoint."""
    share = np.asarray(share, float)
    each = np.stack([share + 0.1 * k * (np.arange(len(share)) == 0)[:, None] for k in range(members)])
    return PredictedAttention(share, share, share > 0, np.full(len(share), support), each)


def rows_what_if(changes, after, floor=None, members=1):
    requested = []

    def predict(expected, observers):
        requested.append((observers, expected.areas, expected.aois))
        return after

    before = texts([[0.1, 0], [0.2, 0], [0.1, 0], [0.2, 0], [0.15, 0]], members=members)
    placed = open_placed_areas(None, None, AREAS)
    result = what_if_rows(
        open_changes(changes), placed, WHAT_IF_EYES, before, predict, floor or MinParticipantsFilter(), 199, 0
    )
    return {(r["aoi"], r["measure"]): r for r in result}, requested[0]


def test_what_if_pairs_participants():
    after = texts([[0.2, 0.1], [0.3, 0.1], [0.21, 0.1], [0.29, 0.1], [0.25, 0.1]])
    result, (observers, areas, aois) = rows_what_if({"move": [{"area": "a", "by": [5, 0, 0]}]}, after)
    share = result["a", "share"]
    assert share["before"] == pytest.approx(0.15) and share["after"] == pytest.approx(0.25)
    assert share["difference"] == pytest.approx(0.1) and 0.08 < share["low"] < 0.1 < share["high"] < 0.12
    assert share["support"] == 5 and share["source"] == "predicted" and share["participants"] == 5
    assert result["b", "visible"]["after"] == 1 and result["b", "visible"]["before"] == 0
    assert areas.boxes[0].lower[0] == 5 and observers is WHAT_IF_EYES and len(aois) == 2
    assert not find_wrong_notes(result.values()) and "difference_spread" in share["note"]
    after = texts([[0.2, 0.1], [0.3, 0.1], [0.21, 0.1], [0.29, 0.1], [0.25, 0.1]], support=np.nan, members=2)
    result, _ = rows_what_if({"move": [{"area": "a", "by": [5, 0, 0]}]}, after, members=2)
    assert not find_wrong_notes(result.values()) and result["a", "share"]["difference_spread"] is not None
    assert "support" in result["a", "share"]["note"]


def test_what_if_with_other_observers():
    after = texts([[0.5, 0.5]] * 2)
    result, (observers, *_) = rows_what_if({"observers": [[9, 9, 9], [8, 8, 8]], "shift": [0, 0, 1]}, after)
    assert observers.positions.tolist() == [[9, 9, 10], [8, 8, 9]]
    assert result["a", "share"]["after"] == pytest.approx(0.5) and result["a", "share"]["before"] == pytest.approx(0.15)


def test_what_if_suppresses_few_participants():
    floor = MinParticipantsFilter(9)
    result, _ = rows_what_if({"shift": [0, 0, 1]}, texts([[0.2, 0.1]] * 5), floor)
    assert all(r["before"] is None and r["difference"] is None for r in result.values()) and floor.num_suppressed == 4
    assert not find_wrong_notes(result.values())


def test_what_if_spread_over_members():
    after = texts([[0.2, 0.1]] * 5, members=2)
    result, _ = rows_what_if({"shift": [0, 0, 1]}, after, members=2)
    # Equal changes of both members have no spread; a change of one member has.
    assert result["a", "share"]["difference_spread"] == pytest.approx(0, abs=1e-12)
    assert result["a", "visible"]["difference_spread"] is None
    result, _ = rows_what_if({"shift": [0, 0, 1]}, replace(after, members=after.members[[0, 0]]), members=2)
    assert result["a", "share"]["difference_spread"] == pytest.approx(0.1 / 5 / np.sqrt(2))
    assert rows_what_if({"shift": [0, 0, 1]}, texts([[0.2, 0.1]] * 5))[0]["a", "share"]["difference_spread"] is None


def test_what_if_without_support():
    result, _ = rows_what_if({"shift": [0, 0, 1]}, texts([[0.2, 0.1]] * 5, np.nan))
    assert all(row["support"] is None for row in result.values())
