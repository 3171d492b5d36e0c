"""Tests of `nerg_mi.aoi.tracker_error`: disturbed samples, correction against closed forms, coverage, resolution."""

from __future__ import annotations

from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest

from nerg_mi.aoi.areas import Areas
from nerg_mi.aoi.robustness import robustness
from nerg_mi.aoi.settings import AoiSampling, TrackerError, VisitRules
from nerg_mi.aoi.statistics import statistics
from nerg_mi.aoi.tracker_error import Disturbance, disturb_query, turn_directions
from nerg_mi.aoi.validations import Validation, read_validation
from nerg_mi.errors import NergError
from nerg_mi.tracking.rays import Rays
from nerg_mi.tracking.selection import filter_rays
from tests.aoi.place import people, write_place
from tests.notes import find_wrong_notes
from tests.recorder import Recorder

RULES = VisitRules(min_visit=0.0)


def look(horizontal, vertical=None, times=None):
    """Return rays of participants (P) at the origin, who look at angles (P, N) in degrees from the x axis."""
    right = np.radians(np.asarray(horizontal, float))
    up = np.zeros_like(right) if vertical is None else np.radians(vertical)
    num, count = right.shape
    directions = np.stack([np.cos(up) * np.cos(right), -np.cos(up) * np.sin(right), np.sin(up)], axis=2)
    times = np.arange(count) / 10 if times is None else times
    return Rays.from_arrays(
        np.zeros((num * count, 3)),
        directions.reshape(-1, 3),
        times=np.tile(times, num),
        participants=np.repeat([f"p{k:04d}" for k in range(num)], count),
    )


def draws_of(rays, error, rules=RULES, by_participant=None):
    return list(Disturbance(error, by_participant or {}).draw(rays, rules))


def angle(a, b):
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)))


def test_directions_turn_to_the_right_and_up():
    ahead = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, -0.8]])
    angles = np.radians([[30.0, 0], [0, 40], [3, 4], [-50, 20]])
    turned = turn_directions(ahead, angles)
    assert np.allclose(turned[0], [np.cos(np.pi / 6), -np.sin(np.pi / 6), 0])
    assert np.allclose(turned[1], [0, np.cos(np.radians(40)), np.sin(np.radians(40))])
    assert np.allclose(angle(ahead, turned), np.degrees(np.linalg.norm(angles, axis=1)))
    assert np.allclose(np.linalg.norm(turned, axis=1), 1)


def test_offsets_have_the_accuracy_and_noise_the_precision():
    rays = look(np.zeros((400, 8)), times=np.r_[0:4, 1000:1004] / 1.0)  # two sessions of each participant
    offsets = draws_of(rays, TrackerError(accuracy=2.0, draws=4))
    for level, some in ((1, offsets[:4]), (2, offsets[4:])):
        angles = np.stack([angle(rays.direction, d.direction) for d in some]).reshape(4, 400, 2, 4)
        assert np.allclose(angles, angles[..., :1])
        assert angles.mean() == pytest.approx(2.0 * np.sqrt(level), rel=0.05)
        assert not np.isclose(angles[..., 0, 0], angles[..., 1, 0]).any()
    noise = np.stack([angle(rays.direction, d.direction) for d in draws_of(rays, TrackerError(precision=0.5, draws=4))])
    assert np.sqrt((noise[:4] ** 2).mean()) == pytest.approx(0.5, rel=0.03)
    assert np.sqrt((noise[4:] ** 2).mean()) == pytest.approx(0.5 * np.sqrt(2), rel=0.03)


def test_a_part_of_the_offset_changes_from_fixation_to_fixation():
    # Two fixations of five samples at 50 Hz, 20 degrees apart.
    rays = look(np.repeat([[0.0] * 5 + [20.0] * 5], 400, axis=0), times=np.arange(10) / 50)
    for part in (0.0, 0.25, 1.0):
        some = draws_of(rays, TrackerError(accuracy=2.0, fixation_part=part, draws=2))
        right = np.stack([np.degrees(np.arctan2(-d.direction[:, 1], d.direction[:, 0])) for d in some[:2]])
        offset = right.reshape(-1, 2, 5) - np.array([0.0, 20.0])[:, None]
        assert np.allclose(offset, offset[..., :1], atol=1e-3)
        assert angle(rays.direction, some[0].direction).mean() == pytest.approx(2.0, rel=0.1)
        assert np.corrcoef(offset[:, :, 0].T)[0, 1] == pytest.approx(1 - part, abs=0.1)


def test_draws_do_not_depend_on_the_other_sessions():
    rays = look(np.zeros((3, 8)), times=np.r_[0:4, 5000:5004] / 50)
    error = TrackerError(accuracy=1.0, precision=0.3, fixation_part=0.5, draws=2)
    for rows in (np.arange(8, 16), np.arange(4, 8), np.r_[0:4, 16:24]):
        some = draws_of(rays.select(rows), error)
        for part, whole in zip(some, draws_of(rays, error)):
            assert np.array_equal(part.direction, whole.direction[rows])


EDGE = {"right": {"min": [4.9, -50, -50], "max": [5.1, 0, 50]}}


def test_correction_matches_the_closed_form():
    # All look 1.5 degrees to the right of the edge of a wall: the share with an added error of variance v along an axis
    # is the normal distribution function of 1.5 / sqrt(v).
    rays = look(np.full((1500, 2), 1.5))
    result = statistics(rays, EDGE, rules=RULES, error=TrackerError(accuracy=2.0, draws=10), resamples=199)
    row = next(r for r in result.tracker if r["measure"] == "share")
    sd = 2.0 * np.sqrt(2 / np.pi)
    once, twice = (NormalDist(0, sd * np.sqrt(v)).cdf(1.5) for v in (1, 2))
    assert row["recorded"] == 1 and row["disturbed"] == pytest.approx(once, abs=0.01)
    assert 3 - 3 * once + twice > 1 and row["corrected"] == 1  # beyond 1, which no share is
    rays = look(np.repeat(np.linspace(-6, 6, 1500)[:, None], 2, axis=1))
    result = statistics(rays, EDGE, rules=RULES, error=TrackerError(accuracy=2.0, draws=10), resamples=199)
    for row in result.tracker:
        if row["measure"] in ("share", "hit_ratio"):
            assert row["corrected"] == pytest.approx(0.5, abs=0.01) and row["low"] < 0.5 < row["high"]


def test_shares_match_the_closed_form_on_a_plane():
    # Each participant looks at one point of a wall, on which errors of a few degrees are even: the probability of a
    # rectangle is a product of differences of the normal distribution function.
    at = np.random.default_rng(2).uniform(-4, 4, (2, 2000))
    sides = np.array([[-2.0, 1.0], [-1.0, 3.0]])  # degrees to the right, and up
    (left, right), (low, high) = 5 * np.tan(np.radians(sides))
    wall = {"rectangle": {"min": [4.99, -right, low], "max": [5.01, -left, high]}}
    rays, error = look(*np.repeat(at[:, :, None], 2, axis=2)), TrackerError(accuracy=1.5, draws=10)
    row = statistics(rays, wall, rules=RULES, error=error, resamples=199).tracker[0]
    recorded = ((at > sides[:, :1]) & (at < sides[:, 1:])).all(axis=0)
    assert row["measure"] == "share" and row["recorded"] == pytest.approx(recorded.mean(), abs=0.004)
    cdf = np.vectorize(NormalDist(0, 1.5 * np.sqrt(2 / np.pi)).cdf)
    expected = (cdf(sides[:, 1:] - at) - cdf(sides[:, :1] - at)).prod(axis=0)
    assert row["disturbed"] == pytest.approx(expected.mean(), abs=0.005)


def test_densities_with_an_error_match_the_closed_form():
    # The error multiplies a spherical harmonic of degree l by exp(-l (l + 1) sigma² / 2).
    harmonic = lambda d: 35 * d[:, 0] ** 4 - 30 * d[:, 0] ** 2 + 3
    directions = np.random.default_rng(0).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sigma = np.radians(3.0)
    densities, depth = disturb_query(lambda d: (np.stack([harmonic(d), np.ones(len(d))]), d[:, 0]), sigma)(directions)
    value = harmonic(directions)
    assert np.array_equal(depth, directions[:, 0]) and np.allclose(densities[1::2], 1)
    assert np.array_equal(densities[0], value)
    for density, level in ((densities[2], 1), (densities[4], 2)):
        assert np.allclose(density, np.exp(-10 * level * sigma**2) * value, atol=1e-3)


def test_predictions_are_corrected(tmp_path, rgb):
    scene, areas, error = write_place(tmp_path), tmp_path / "areas.json", TrackerError(accuracy=4.0, draws=2)
    options = {"sampling": AoiSampling(directions=128, aoi_samples=6), "viewpoints": 20, "resamples": 199}
    for inputs in ([scene, people()], [scene]):  # with and without participants
        plain, result = (statistics(inputs, areas, error=e, **options) for e in (TrackerError(), error))
        assert result.aois == plain.aois and not plain.tracker
        assert {r["aoi"] for r in result.resolution} <= {"the sign", "the stand"}
        rows = [r for r in result.tracker if r["source"] == "predicted"]
        assert {r["measure"] for r in rows} == {"share", "dwell", "hit_ratio"}
        shares = {(r["cell"], r["value"], r["aoi"]): r["share"] for r in result.aois if r["source"] == "predicted"}
        for row in rows:
            assert row["low"] <= row["corrected"] <= row["high"]
            if row["measure"] == "share":
                assert row["recorded"] == pytest.approx(shares[row["cell"], row["value"], row["aoi"]])
                assert row["recorded"] != row["disturbed"]


def test_predicted_effects_of_changes_are_corrected(tmp_path, rgb):
    """As the predictions of the areas before, and of those after the change."""
    scene, areas, error = write_place(tmp_path), tmp_path / "areas.json", TrackerError(accuracy=4.0, draws=2)
    options = {"sampling": AoiSampling(directions=128, aoi_samples=6), "viewpoints": 20, "resamples": 199}
    changes = {"move": [{"area": "the sign", "by": [0, 0.5, 0.2]}]}
    inputs = [scene, people(cohorts=False)]
    plain = statistics(inputs, areas, what_if=changes, **options)
    result = statistics(inputs, areas, what_if=changes, error=error, **options)
    moved = replace(
        Areas.load(areas),
        areas=tuple(
            replace(a, lower=(4.0, 2.0, 1.2), upper=(4.2, 3.0, 2.2)) if a.name == "the sign" else a
            for a in Areas.load(areas).areas
        ),
    )
    after = statistics(inputs, moved, error=error, **options)
    assert [r for r in result.what_if if r["measure"] != "corrected_share"] == plain.what_if
    corrected = {r["aoi"]: r for r in result.what_if if r["measure"] == "corrected_share"}
    assert set(corrected) == {"the sign", "the stand", "both"} and not find_wrong_notes(result.what_if)
    for key, tables in (("before", result), ("after", after)):
        shares = {r["aoi"]: r for r in tables.tracker if (r["source"], r["measure"]) == ("predicted", "share")}
        for name, row in corrected.items():
            assert row[key] == pytest.approx(shares[name]["corrected"], rel=1e-6), (key, name)
    row = corrected["the sign"]
    assert row["difference"] == pytest.approx(row["after"] - row["before"], abs=1e-9)
    assert row["low"] < row["difference"] < row["high"] and row["p"] <= row["p_adjusted"]
    assert all(file.is_file() for file in result.save(tmp_path / "out"))


def test_a_part_of_the_offset_without_fixations_is_reported_once():
    slow, fast = (look(np.zeros((3, 20)), times=np.arange(20) / rate) for rate in (5, 50))
    error = TrackerError(accuracy=1.0, fixation_part=0.5, draws=2)

    def list_warnings(rays, error, analyse=statistics, **options):
        recorder = Recorder()
        analyse(rays, EDGE, error=error, resamples=199, progress=recorder, **options)
        return [text for text in recorder.warnings if "fixation_part=0.5" in text]

    (text,) = list_warnings(slow, error)
    assert "0.2 s apart" in text and list_warnings(slow, error, robustness, analyses=10) == [text]
    assert not list_warnings(fast, error) and not list_warnings(slow, replace(error, fixation_part=0.0))
    # Each sample is a fixation.
    merged = filter_rays(fast.with_tracking("eye"), fixations="ivt", merge_fixations=True)
    assert not list_warnings(merged, error)
    (text,) = list_warnings(fast, replace(error, accuracy=0.0))
    assert "no effect" in text and "accuracy" in text


def simulate(rng, shares, num, count, spread, sd, noise):
    """Return true and recorded angles (P, N, 2) in degrees; the columns of a wall, each 3 degrees wide, get
    ``shares``."""
    true, recorded = np.empty((num, count, 2)), np.empty((num, count, 2))
    for p in range(num):
        column = rng.choice(len(shares), count, p=rng.dirichlet(30 * shares))
        true[p] = np.c_[3 * (column - len(shares) / 2 + 0.5) + rng.uniform(-1, 1, count) * spread, np.zeros(count)]
        recorded[p] = true[p] + rng.normal(0, sd, 2) + rng.normal(0, noise, (count, 2))
    return true, recorded


@pytest.mark.slow
def test_intervals_cover_the_true_shares():
    rng, error = np.random.default_rng(1), TrackerError(accuracy=1.2, precision=0.3, draws=8)
    num_areas, edges = 6, np.tan(np.radians(np.arange(-9, 10, 3)))
    walls = {f"column {k}": {"min": [0.99, -edges[k + 1], -5], "max": [1.0, -edges[k], 5]} for k in range(num_areas)}
    covered, naive = [], []
    for _ in range(30):
        shares = rng.dirichlet(np.ones(num_areas))
        scale = 1.2 * np.sqrt(2 / np.pi), 0.3 / np.sqrt(2)
        angles = simulate(rng, shares, 20, 40, 1.5, *scale)[1]
        result = statistics(look(angles[..., 0], angles[..., 1]), walls, rules=RULES, error=error, resamples=199)
        rows = [r for r in result.tracker if r["measure"] == "share"]
        listed = [(r, share, a) for r, share, a in zip(rows, shares, result.aois) if r["low"] is not None]
        covered += [r["low"] <= share <= r["high"] for r, share, _ in listed]
        naive += [a["share_low"] <= share <= a["share_high"] for _, share, a in listed]
    assert 0.9 < np.mean(covered) < 0.99 and np.mean(naive) < 0.8


def test_small_areas_and_close_neighbours_are_named():
    areas = {
        "page": {"min": [1.99, -0.5, -0.01], "max": [2.0, 0.5, 0.01]},  # .57 degrees high, 28 wide
        "door": {"min": [1.99, 0.6, -1.0], "max": [2.0, 1.6, 1.0]},
        "sign": {"min": [1.99, -0.5, 0.06], "max": [2.0, 0.5, 0.4]},
    }
    result = statistics(look(np.zeros((3, 4))), areas, rules=RULES, error=TrackerError(accuracy=4.0), resamples=199)
    rows = {(r["aoi"], r["neighbour"]): r["extent"] for r in result.resolution}
    assert set(rows) == {("page", ""), ("page", "sign")}
    assert rows["page", ""] == pytest.approx(np.degrees(2 * np.arctan(0.01 / 2)), rel=0.05)
    assert rows["page", "sign"] == pytest.approx(np.degrees(np.arctan(0.23 / 2)), rel=0.1)


def test_a_table_replaces_the_error_of_participants(tmp_path):
    file = tmp_path / "validation.csv"
    file.write_text("participant,accuracy,precision\np0001,3,0\np0001,1,0\n")
    rays = look(np.zeros((2, 4)))
    some = draws_of(rays, TrackerError(draws=2), by_participant=read_validation(file))
    moved = angle(rays.direction, some[0].direction)
    assert (moved[:4] == 0).all() and (moved[4:] > 0).all()
    recorder = Recorder()
    result = statistics(rays, EDGE, rules=RULES, validation=file, resamples=199, progress=recorder)
    assert result.tracker and any('"p0000"' in text for text in recorder.warnings)
    recorder = Recorder()
    robustness(rays, EDGE, rules=RULES, validation=file, analyses=10, progress=recorder)
    assert any('"p0000"' in text for text in recorder.warnings)


@pytest.mark.parametrize("analyse", [statistics, robustness])
def test_a_table_of_other_participants_is_refused(tmp_path, analyse):
    file = tmp_path / "validation.csv"
    file.write_text("participant,accuracy,precision\nann,3,0\n")
    with pytest.raises(NergError, match="p0001"):
        analyse(look(np.zeros((2, 4))), EDGE, rules=RULES, validation=file, resamples=199, progress=False)


def test_a_session_has_the_nearest_validation():
    rays = look(np.zeros((1, 8)), times=np.r_[10:14, 1000:1004] / 1.0)
    validations = {"p0000": [Validation(998.0, 0.0, np.nan), Validation(14.0, 2.0, 0.0)]}
    disturbance = Disturbance(TrackerError(precision=0.5, draws=2), validations)
    assert disturbance.mean_accuracy == 1
    assert disturbance.sigma == pytest.approx(np.radians(np.sqrt((2.0**2 * 2 / np.pi + 0.5**2 / 2) / 2)))
    moved = angle(rays.direction, next(disturbance.draw(rays, RULES)).direction)
    assert np.allclose(moved[:4], moved[0]) and moved[0] > 0
    assert len(np.unique(moved[4:])) == 4 and (moved[4:] < 2).all()


def test_without_an_error_nothing_is_added():
    result = statistics(look(np.zeros((3, 4))), EDGE, rules=RULES, resamples=199)
    assert not result.tracker and not result.resolution
    disturbed = statistics(look(np.zeros((3, 4))), EDGE, rules=RULES, error=TrackerError(accuracy=1.0), resamples=199)
    assert result.aois == disturbed.aois and result.transitions == disturbed.transitions


def test_participants_below_the_minimum_are_suppressed():
    rays = look(np.zeros((3, 4)))
    result = statistics(rays, EDGE, rules=RULES, error=TrackerError(accuracy=1.0), resamples=199, min_participants=4)
    assert all(r["corrected"] is None and r["recorded"] is None and r["note"] for r in result.tracker)


def test_values_without_a_visit_have_a_note():
    rays = look(np.full((4, 4), -60.0))
    result = statistics(rays, EDGE, rules=RULES, error=TrackerError(accuracy=1.0), resamples=199)
    (row,) = [r for r in result.tracker if r["measure"] == "time_to_first_visit"]
    assert row["corrected"] is None and row["note"]
