"""Tests of `nerg_mi.tracking.quality`."""

from dataclasses import replace

import numpy as np
import pytest

from nerg_mi.errors import NergError, clean_text, spell_command_line
from nerg_mi.tracking import quality
from nerg_mi.tracking.events import angles_about, detect_events
from nerg_mi.tracking.quality import (
    WARNING_LABEL,
    GazeTarget,
    QualityReport,
    check_rays,
    make_quality_report,
    measure_recordings,
    summarise,
)
from nerg_mi.tracking.rays import FRAME, Rays
from tests.tracking.people import some_rays

# ---- Quality report as text ----


def card(**change):
    n = 200
    origin = np.stack([0.02 * np.arange(n), np.zeros(n), np.full(n, 1.6)], axis=1)
    values = dict(
        t=0.02 * np.arange(n),
        person=np.arange(n) // 20,
        persons=tuple("abcdefghij"),
        origin=origin,
        direction=np.tile([1.0, 0, 0], (n, 1)),
        confidence=np.ones(n),
    )
    rays = Rays(**{**values, **change})
    return make_quality_report(rays, summarise(rays))


def test_lines_of_the_quality_report():
    content = {
        "frame": dict(FRAME),
        "source_frame": {"up": "y", "handedness": "left", "units": "cm"},
        "rows_read": 210,
        "dropped": [
            {"reason": "blink", "file": "a.csv", "count": 9, "rows": [[2, 4], [7, 7], [9, 9], [11, 14]]},
            {"reason": "blink", "file": "b.csv", "count": 1, "rows": [[3, 3]]},
        ],
        "steps": [{"step": "split", "side": "test", "kept": 200, "of": 300}],
    }
    lines = dict(card(metadata=content))
    assert lines["samples"] == "200 of 210 rows" and lines["participants"] == "10: a, b, c, d, e, f, g, h, ..."
    assert lines["recorded time"] == "3.8 s, sampling rate 50 Hz"
    assert lines["dropped"] == "10 (4.8 %): blink; lines 2-4, 7, 9, ... of a.csv and of 1 more"
    assert lines["step"] == "split test: 200 of 300 rays kept" and lines["source frame"] == "y up, left-handed, cm"
    assert lines["eye height"] == "1.60 m (5 to 95 %: 1.60 to 1.60)" and lines["speed"] == "95 % below 1.00 m/s"
    assert not {"cohorts", "hit points", "duplicates", WARNING_LABEL} & set(lines)


def test_optional_lines_of_the_quality_report():
    n = 200
    hit = np.tile([9.0, 0, 1.6], (n, 1))
    hit[50:] = np.nan
    lines = dict(card(hit=hit, cohort=np.arange(n) % 2, cohorts=("new", "old"), t=np.zeros(n)))
    assert lines["cohorts"] == "new 100, old 100" and lines["hit points"].startswith("in 25.0 % of the samples")
    assert lines["recorded time"].startswith("unknown") and lines["speed"].startswith("unknown")
    assert lines["duplicates"] == "190 samples have the participant and time of another"
    assert "have the same time" in lines[WARNING_LABEL]
    slow = dict(card(t=10.0 * np.arange(n)))
    assert slow["recorded time"].startswith("none: all intervals between samples of a participant exceed 1 s")


def test_names_are_not_interpreted_as_markup():
    """Names of persons and files may look like markup of the terminal library."""
    both_eyes, ahead = np.zeros((3, 3)), np.tile([1.0, 0.0, 0.0], (3, 1))
    rays = Rays(np.arange(3.0), [0, 0, 1], ("[red]", "[/b]"), both_eyes, ahead, np.ones(3))
    shown = str(QualityReport(rays, "[bold].npz", summarise(rays)))
    assert "[bold].npz" in shown and "[red]" in shown and "[/b]" in shown


def test_printed_reports_spell_parameters_for_their_reader():
    report = check_rays(replace(walk(), t=1000 * walk().t))  # milliseconds as seconds
    assert any("unit of time" in warning for warning in report.warnings)
    assert "(tick=" in str(report) and str(report) == repr(report) == clean_text(str(report))
    assert "(--tick " in clean_text(report.to_text(), spell_command_line)


# ---- Summary ----


def walk(scale=1.0, height=1.6, n=100):
    t = np.arange(n) * 0.02
    origin = np.stack([t * scale, 0 * t, np.full(n, height)], axis=1)
    d = np.tile([1.0, 0, 0], (n, 1))
    return Rays(t, np.zeros(n), ("ann",), origin, d, np.ones(n), hit=origin + 2 * d)


def test_figures_of_a_walk():
    s = summarise(walk())
    assert (s.rays, s.persons, s.duplicates, s.warnings) == (100, 1, 0, ())
    assert np.isclose(s.sampling_rate, 50) and np.isclose(s.duration, 1.98) and np.isclose(s.speed_p95, 1)
    assert np.isclose(s.hit_distance, 2) and s.hit_fraction == 1 and np.isclose(s.eye_height[1], 1.6)


@pytest.mark.parametrize("rays, word", [(walk(20), "walking pace"), (walk(0.001, 0.0016), "larger")])
def test_likely_mistakes_are_reported(rays, word):
    assert any(word in w for w in summarise(rays).warnings)


def test_no_rays():
    with pytest.raises(NergError, match="no rays"):
        summarise(walk().select(np.zeros(100, dtype=bool)))


@pytest.mark.parametrize("block", [7, 64, 1 << 18])
def test_figures_do_not_depend_on_order_or_block_size(monkeypatch, block):
    """Compare with the definitions, on rays of three participants in any order, with pauses, duplicates and missing
    hits."""
    monkeypatch.setattr(quality, "_BLOCK", block)
    rng = np.random.default_rng(0)
    n = 500
    person, t = rng.integers(0, 3, n), np.round(rng.uniform(0, 60, n), 1)
    origin, d = rng.random((n, 3)), np.tile([1.0, 0, 0], (n, 1))
    hit = np.where(rng.random((n, 1)) < 0.3, np.nan, origin + rng.random((n, 1)) * d)
    rays = Rays(t, person, ("a", "b", "c", "nobody"), origin, d, np.ones(n), hit)
    result = summarise(rays)
    step, speed = [], []
    for p in range(3):
        mine = np.flatnonzero(person == p)
        mine = mine[np.argsort(t[mine], kind="stable")]
        dt = np.diff(t[mine])
        step.append(dt)
        moving = (dt > 0) & (dt <= 1)
        speed.append(np.linalg.norm(np.diff(origin[mine], axis=0), axis=1)[moving] / dt[moving])
    step, speed = np.concatenate(step), np.concatenate(speed)
    moving = step[(step > 0) & (step <= 1)]
    assert result.duration == pytest.approx(moving.sum()) and result.sampling_rate == pytest.approx(
        1 / moving[moving <= 1.5 * np.median(moving)].mean()
    )
    assert result.speed_p95 == pytest.approx(np.percentile(speed, 95)) and result.duplicates == (step == 0).sum() > 0
    distance = np.linalg.norm(hit - origin, axis=1)
    assert result.hit_fraction == np.isfinite(distance).mean() and result.hit_distance == pytest.approx(
        np.nanmedian(distance)
    )
    assert result.persons == 3


def test_sampling_rate_of_sparse_rays():
    """Rays every two seconds have a sampling rate, but no recorded time."""
    ahead = np.tile([1.0, 0, 0], (9, 1))
    rays = Rays(np.arange(9) * 2.0, np.zeros(9, int), ("a",), np.full((9, 3), 1.6), ahead, np.ones(9))
    result = summarise(rays)
    assert result.sampling_rate == pytest.approx(0.5) and result.duration == 0 and np.isnan(result.speed_p95)
    assert "tick=0.001" in clean_text(result.warnings[-1])
    alone = summarise(rays.select([0]))
    assert (
        np.isnan(alone.sampling_rate)
        and alone.duplicates == 0
        and not any("tick" in w or "t=" in w for w in alone.warnings)
    )


# ---- Data quality of each recording ----


def noisy(n: int = 900, seed: int = 0) -> Rays:
    """Two participants at 100 Hz, who look at a point for a second each, with noise and missing samples."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / 100
    t = t[rng.random(n) > 0.1]
    azimuth, elevation = 20 * np.floor(t), 5 * (np.floor(t) % 3)
    angles = np.radians(np.stack([azimuth, elevation]) + rng.normal(0, 0.05, (2, len(t))))
    d = np.stack([np.cos(angles[0]) * np.cos(angles[1]), np.sin(angles[0]) * np.cos(angles[1]), np.sin(angles[1])], 1)
    person = np.r_[np.zeros(len(t)), np.ones(len(t))]
    return some_rays(2 * len(t), t=np.r_[t, t + 2], person=person, direction=np.r_[d, d[:, [1, 0, 2]]])


TARGETS = [GazeTarget(0, 0.9, (2.0, 0.02, 0.1)), GazeTarget(3.1, 3.8, (2.0, 4.0, 1.0), "ann")]


def test_recordings_as_etdqualitizer_measures_them():
    etd = pytest.importorskip("ETDQualitizer")
    rays = noisy()
    events = detect_events(rays)
    first, second = measure_recordings(rays, TARGETS, events)
    for person, one in enumerate((first, second)):
        rows = np.flatnonzero(rays.person == person)
        d, t = rays.direction[rows], rays.t[rows]
        recording = etd.DataQuality(d[:, 0], d[:, 1], t, "degrees")
        assert np.isclose(one.effective_frequency, recording.effective_frequency(), rtol=1e-12)
        assert np.isclose(one.data_loss, recording.data_loss_from_expected(one.frequency), rtol=1e-9)
        assert np.isclose(one.duration, recording.get_duration()) and one.samples == len(rows)
        precision = []
        for k in np.flatnonzero(np.isin(events.first, rows) & (events.kind == "fixation")):
            span = slice(events.first[k], events.last[k] + 1)
            angles = angles_about(rays.direction[span], np.tile(events.direction[k], (span.stop - span.start, 1)))
            fixation = etd.DataQuality(*angles.T, rays.t[span], "degrees")
            precision.append([fixation.precision_RMS_S2S()[0], fixation.precision_STD()[0]])
        assert one.fixations == len(precision) >= 8
        np.testing.assert_allclose([one.rms_s2s, one.std], np.median(precision, axis=0), rtol=1e-9)
        # Both targets are as seen from the origin, where the eyes are.
        offsets = []
        for target in TARGETS[: 2 - person]:
            at = (t >= target.start) & (t <= target.end)
            if at.any():
                ahead = np.tile(np.array(target.point) / np.linalg.norm(target.point), (at.sum(), 1))
                offsets.append(etd.accuracy(*angles_about(d[at], ahead).T, 0, 0)[0])
        assert one.targets == len(offsets)
        if offsets:
            assert np.isclose(one.accuracy, np.mean(offsets), rtol=1e-9)


def test_recordings_by_hand():
    """Noise of 0.05 degrees: its STD over both axes, and RMS-S2S, which is the square root of 2 larger."""
    first, second = measure_recordings(noisy(6000))
    assert first.participant == "ann" and second.start == pytest.approx(2.0, abs=0.05)
    assert first.frequency == pytest.approx(100) and first.data_loss == pytest.approx(10, abs=1.5)
    assert first.effective_frequency == pytest.approx(90, abs=1.5)
    assert first.std == pytest.approx(0.05 * np.sqrt(2), rel=0.05)
    assert first.rms_s2s == pytest.approx(0.1, rel=0.05)
    assert first.targets == 0 and np.isnan(first.accuracy)


def test_accuracy_by_hand():
    """An eye that moves, and gaze that passes a point at 3 degrees to the right and 4 above."""
    n, rng = 50, np.random.default_rng(0)
    origin = rng.normal(0, 1, (n, 3)) + [0, 0, 20.0]
    point = (10.0, 3.0, 21.0)
    ahead = np.array(point) - origin
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    a, e = np.radians([3.0, 4.0])
    d = np.cos(e) * (np.cos(a) * ahead + np.sin(a) * right) + np.sin(e) * np.cross(right, ahead)
    (quality,) = measure_recordings(some_rays(n, origin=origin, direction=d), [GazeTarget(-1, 10, point)])
    assert quality.targets == 1
    assert quality.accuracy == pytest.approx(np.degrees(np.arccos(np.cos(a) * np.cos(e))))


def test_quality_of_recordings_that_are_too_short():
    one, two = (measure_recordings(some_rays(n))[0] for n in (1, 2))
    assert np.isnan([one.frequency, one.duration, one.data_loss, one.rms_s2s]).all() and one.samples == 1
    assert two.frequency == pytest.approx(10) and two.data_loss == pytest.approx(0, abs=1e-9)
    with pytest.raises(NergError, match="target"):
        GazeTarget(2, 1, (0, 0, 0))


@pytest.mark.parametrize("start", [0.0, 12.34, 5e4, 1.7e9])
@pytest.mark.parametrize("rate", [60, 90, 120, 1000])
def test_rounding_is_no_data_loss(start, rate):
    """Nor an angle: gaze rests in one direction; one sample of 600 is a loss."""
    t = start + np.arange(600) / rate
    d = np.tile([0.6, 0.64, 0.48], (600, 1))
    (quality,) = measure_recordings(some_rays(600, t=t, direction=d))
    assert (quality.data_loss, quality.rms_s2s, quality.std) == (0, 0, 0) and quality.fixations > 0
    (quality,) = measure_recordings(some_rays(599, t=np.delete(t, 300), direction=d[1:]))
    assert quality.data_loss == pytest.approx(100 / 600, rel=0.1)
    # Samples that are closer than their median interval are no negative loss.
    (quality,) = measure_recordings(some_rays(600, t=np.sort(np.r_[t[:400], t[:200] + 0.5 / rate])))
    assert quality.data_loss >= 0


@pytest.mark.parametrize("rate", [60, 72, 90, 120, 240, 1000])
def test_rates_of_times_in_milliseconds(rate):
    """The median interval at 60 Hz in whole milliseconds is 17 ms, which is 58.8 Hz."""
    t = np.floor(np.arange(600) / rate * 1000) / 1000
    t[400:] += 2.0  # a gap
    rays = some_rays(len(t), t=t)
    assert summarise(rays).sampling_rate == pytest.approx(rate, rel=2e-3)
    (recording,) = measure_recordings(rays)
    assert recording.frequency == pytest.approx(rate, rel=2e-3)
    expected = 100 * (1 - 600 / rate / (t[-1] + 1 / rate))
    assert recording.data_loss == pytest.approx(expected, abs=0.3)
