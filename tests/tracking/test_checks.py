"""Tests of `nerg_mi.tracking.checks`."""

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.tracking.checks import group_medians
from nerg_mi.tracking.rays import FRAME
from tests.tracking.people import change, walk, warnings_of, watch

# ---- Clocks ----

BO = slice(3000, 6000)


@pytest.mark.parametrize("by, text", [(-20.0, "-20 s"), (3600.0, "+3,600 s"), (-3600.0, "-3,600 s")])
def test_clock_jumps_during_motion(by, text):
    said = warnings_of(change(watch(), slice(4500, 6000), t=lambda t: t + by))
    assert f"the clock of bo jumps once, by at most {text}" in said and "correct the times" in said


def test_pauses_and_consecutive_recordings_are_valid():
    rays = watch()
    # After ten minutes away, a person is at another position.
    gone = np.r_[0:1000, 1700:3000]
    assert warnings_of(change(rays, slice(1700, 3000), t=lambda t: t + 600.0).select(gone)) == ""
    # The order of files may differ from that of their times.
    later = change(rays, slice(0, 1500), t=lambda t: t + 1000.0)
    assert warnings_of(later.select(np.r_[0:1400, 1700:9000])) == ""


def test_recordings_under_one_name():
    rays = watch()
    shared = replace(rays, person=np.where(rays.person == 2, 1, rays.person))
    said = warnings_of(shared)
    assert "bo is at two positions at the same time: do several participants share a name? (person_from" in said
    between = change(shared, slice(6000, None), t=lambda t: t + 0.003)
    assert "recordings of bo overlap in time" in warnings_of(between)
    twice = rays.select(np.r_[0:9000, 3000:6000])
    assert warnings_of(twice) == "rays of bo are duplicated: was a file imported twice?"


def test_clocks_in_other_units():
    rays = watch(5)
    said = warnings_of(change(rays, BO, t=lambda t: 1000 * t))
    assert "the sampling interval of bo is 20 s, that of other participants 0.02 s" in said and "tick" in said
    said = warnings_of(change(rays, slice(4500, 6000), t=lambda t: 30 + 1000 * (t - 30)))
    assert "the sampling interval of bo changes" in said and "two units" in said


def test_clocks_with_other_epochs():
    rays = watch()
    assert "the clock of bo starts from another epoch" in warnings_of(change(rays, BO, t=lambda t: t + 1.7e9))
    assert '(clock="person")' in warnings_of(change(rays, BO, t=lambda t: t + 1.7e9))
    # Recordings of one study may be months apart.
    assert warnings_of(change(rays, BO, t=lambda t: t + 2e7)) == ""


def test_subsampled_rays_have_no_clock_warnings():
    rays = watch()
    slow = np.r_[0:3000, 3000:6000:40, 6000:9000]
    thinned = rays.select(slow).with_step(step="thin", kept=len(slow), of=len(rays))
    assert "sampling interval of" in warnings_of(rays.select(slow)) and warnings_of(thinned) == ""


# ---- Eyes ----


def said(units="m", **distances):
    rays = watch(max(3, len(distances)), 400)
    metadata = {**rays.metadata, "eye_distance": distances}
    metadata["source_frame"] = {"units": units, "up": "z", "handedness": "right"}
    return warnings_of(replace(rays, metadata=metadata))


@pytest.mark.parametrize(
    "units, metres, remedy",
    [
        ("m", 63.0, 'is the unit mm? (units="mm")'),
        ("m", 6.1, 'is the unit cm? (units="cm")'),
        ("cm", 0.00062, 'is the unit m? (units="m")'),
        ("mm", 0.065e-3, 'is the unit m? (units="m")'),
        ("m", 0.126, "is about 0.5 m: scale"),
        ("cm", 0.0315, "is about 0.02 m: scale"),
    ],
)
def test_unit_from_eye_distances(units, metres, remedy):
    assert remedy in said(units, ann=metres, bo=metres * 1.02, cy=metres * 0.99)


def test_normal_variation_of_eye_distances():
    assert said(ann=0.052, bo=0.076) == "" and "the eyes of bo are 82 mm apart" in said(ann=0.06, bo=0.082)
    # Half of several participants are not all small.
    few, several = dict(ann=0.053, bo=0.054), dict(ann=0.053, bo=0.054, cy=0.053, di=0.052, ed=0.055)
    assert said(**few) == "" and "the eyes are 53 mm apart" in said(**several)
    # Participants without rays are ignored.
    assert said(ann=0.06, zoe=63.0) == "" and said() == ""


# ---- Figures ----


@pytest.mark.parametrize("seed", range(3))
def test_medians_of_groups(seed):
    rng = np.random.default_rng(seed)
    values, group = rng.normal(size=97), rng.integers(0, 7, 97) * 2
    result = group_medians(values, group, 15)
    for g in range(15):
        mine = values[group == g]
        assert result[g] == np.median(mine) if mine.size else np.isnan(result[g])
    assert np.isnan(group_medians(np.empty(0), np.empty(0, int), 3)).all()


# ---- Files ----


def test_warnings_of_readers_are_reported():
    rays = watch(3, 400)
    assert warnings_of(rays) == ""
    result = ["the two accounts of ann's gaze differ by 7 degrees: check the calibration"]
    assert warnings_of(replace(rays, metadata={**rays.metadata, "complaints": result})) == result[0]


# ---- Frozen ----


def test_frozen_gaze_of_participants_and_times():
    rays = watch()
    assert warnings_of(rays) == ""
    rows = slice(3000, 6000)
    complete = change(rays, rows, direction=rays.direction[3000])
    assert "the gaze of bo (100 % of the rays) does not move" in warnings_of(complete)
    assert "--without-person" in warnings_of(complete)
    part = change(rays, slice(4000, 5000), direction=rays.direction[4000])
    assert "bo (33 % of the rays)" in warnings_of(part) and "--start, --end" in warnings_of(part)
    # Short losses are not reported.
    assert "does not move" not in warnings_of(change(rays, slice(4000, 4100), direction=rays.direction[4000]))


# ---- Lengths ----


@pytest.mark.parametrize("scale, word", [(1000, 'units="mm"'), (100, 'units="cm"')])
def test_units(scale, word):
    rays = walk(hit=False)
    assert word in warnings_of(replace(rays, origin=rays.origin * scale))


def test_up_axis_is_suggested():
    # A file with y up that was declared with z up: heights are in y.
    rays = walk(hit=False)
    assert 'up="y"' in warnings_of(replace(rays, origin=rays.origin[:, [0, 2, 1]]))
    assert "up=-x" in warnings_of(replace(rays, origin=rays.origin[:, [2, 0, 1]] * (-1, 1, 1)))
    assert "floor is not at height 0" in warnings_of(replace(rays, origin=rays.origin - (0, 0, 1.6)))


@pytest.mark.parametrize("along", [0, 1])
def test_extents_above_a_kilometre_suggest_millimetres(along):
    """Heads at eye height: only the extent reveals the unit."""
    rays = walk(hit=False)
    for span, warned in ((999.5, False), (1000.5, True)):
        origin = rays.origin.copy()
        origin[:, along] *= span / np.ptp(origin[:, along])
        slow = replace(rays, origin=origin, t=rays.t * 40)  # nobody runs
        assert ('units="mm"' in warnings_of(slow)) == warned


def test_heights_above_an_unknown_floor():
    rays = walk(hit=False)
    low = replace(rays, origin=rays.origin - (0, 0, 1.8), metadata={**rays.metadata, "floor": "unknown"})
    assert warnings_of(low) == ""


def test_short_recordings_have_no_extent_warnings():
    down = np.array([0.1, 0.1, -1.0]) / np.linalg.norm([0.1, 0.1, -1.0])
    moment = walk(hit=False).select(slice(0, 2))
    moment = replace(moment, direction=np.tile(down, (2, 1)))
    assert warnings_of(moment) == ""


# ---- Participants who are rows ----


@pytest.mark.parametrize("rays_per_participant, is_counter", [(1, True), (2, True), (10, False), (6000, False)])
def test_one_participant_per_row(rays_per_participant, is_counter):
    rays = walk(hit=False)
    person = np.arange(len(rays)) // rays_per_participant
    rays = replace(rays, person=person, persons=tuple(map(str, range(person.max() + 1))))
    assert ("does their column count rows" in warnings_of(rays)) == is_counter
    thinned = replace(rays, metadata={"frame": dict(FRAME), "steps": [{"step": "thin", "kept": 6000, "of": 9000}]})
    assert "does their column" not in warnings_of(thinned)


def test_names_that_a_spreadsheet_has_rounded():
    rays = walk(hit=False)
    assert "spreadsheet" in warnings_of(replace(rays, persons=("1.23E+12", *rays.persons[1:])))
    assert "spreadsheet" not in warnings_of(replace(rays, persons=("1E5", *rays.persons[1:])))


# ---- Times ----


def test_times_and_steep_gaze():
    rays = walk(hit=False)
    assert "the median sampling interval is 20 s" in warnings_of(replace(rays, t=rays.t * 1000))
    # 50 Hz in microseconds, and in the ticks of .NET.
    for tick in (1e-6, 1e-7):
        assert f"tick={tick:g})" in warnings_of(replace(rays, t=rays.t / tick))
    down = np.tile([0.1, 0.1, -1.0], (len(rays), 1)) / np.linalg.norm([0.1, 0.1, -1.0])
    assert "degrees down" in warnings_of(replace(rays, direction=down))


# ---- The list of checks ----


def test_plausible_walk_has_no_warnings():
    assert warnings_of(walk()) == "" and warnings_of(walk(hit=False)) == ""
